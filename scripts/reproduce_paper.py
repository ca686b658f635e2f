"""Reproduce the paper's figures and table: paper.json, pictures, and a page of the numbers.

python scripts/reproduce_paper.py -o OUT
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from paper.report import reproduce

import tetopt
from tetopt.job.events import Event, listen_with


def main(argv: Sequence[str] | None = None) -> int:
    """Run every experiment; return 0, or 2 after a one-line message about an invalid input."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the results")
    parser.add_argument("--image", type=Path, help="brain MR volume (default: nilearn's MNI152 T1)")
    parser.add_argument("--labels", type=Path, help="tissue labels of the image, for Dice")
    parser.add_argument(
        "--seeds", type=int, default=200, help="number of random meshes for Fig. 1 (%(default)s)"
    )
    parser.add_argument("--force", action="store_true", help="replace the files of an earlier run")
    options = parser.parse_args(argv)
    try:
        with listen_with(_say):
            page, seconds = reproduce(**vars(options))
    except tetopt.InputError as error:
        print(f"reproduce_paper.py: {error}", file=sys.stderr)
        return 2
    print(f"{page}: the paper's numbers next to tetopt's; {seconds:.0f} s")
    return 0


def _say(event: Event) -> None:
    print(event.text, file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
