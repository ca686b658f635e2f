"""Compare tetopt with conventional pipelines; the same as `tetopt compare`.

python scripts/compare_pipelines.py T1.nii.gz -o OUT
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from tetopt.cli import main as tetopt


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``tetopt compare`` with these arguments; return its exit code."""
    return tetopt(["compare", *(sys.argv[1:] if argv is None else argv)])


if __name__ == "__main__":
    sys.exit(main())
