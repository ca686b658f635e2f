"""Reproduce the paper's figures and table; the same as `tetopt paper`.

python scripts/reproduce_paper.py -o OUT
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from tetopt.cli import main as tetopt


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``tetopt paper`` with these arguments; return its exit code."""
    return tetopt(["paper", *(sys.argv[1:] if argv is None else argv)])


if __name__ == "__main__":
    sys.exit(main())
