"""``python -m tetopt.bids``: `tetopt cohort` with the arguments that every BIDS app takes, as in a
container.

K. J. Gorgolewski et al., BIDS apps, PLoS Computational Biology 13(3), e1005209 (2017).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NoReturn

import tetopt
from tetopt.cli import main as run_command
from tetopt.cli.console import open_streams, show_error
from tetopt.errors import InputError

LEVELS = ("participant", "group")
USAGE = (
    "python -m tetopt.bids BIDS_DIR OUT {participant,group} [--participant-label L ...] "
    "[options of tetopt cohort]"
)
ABOUT = """
Mesh the images of a BIDS dataset. participant: mesh the given subjects, or all; several such runs,
each with its own subjects, may write to the same OUT at the same time. group: write the table and
the page of all subjects in OUT. Options of `tetopt cohort`, including those of `tetopt mesh`,
follow the level (python -m tetopt cohort --help); their names may contain underscores instead of
hyphens.
"""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; expected: {USAGE}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the app and return the exit code, that of `tetopt cohort`."""
    open_streams()
    try:
        words = cohort_words(sys.argv[1:] if argv is None else argv)
    except InputError as error:
        show_error(str(error))
        return 2
    return run_command(words)


def cohort_words(arguments: Sequence[str]) -> list[str]:
    """Convert a BIDS app's arguments to those of the `tetopt` command.

    Raises
    ------
    InputError
        The arguments do not begin with a folder, a folder and a level.

    Examples
    --------
    >>> cohort_words(["/data", "/out", "participant", "--participant_label", "01", "--max_gb", "8"])
    ['cohort', '/data', '--output=/out', '--participant-label=01', '--max-gb', '8']
    """
    hyphened = [_with_hyphens(word) for word in arguments]
    places = [place for place, word in enumerate(hyphened) if word in LEVELS]
    # a folder may have a level's name
    end = next((place for place in places if place > 1), len(hyphened) - 1) + 1
    known = _parser()
    known.add_argument("bids_dir")
    known.add_argument("out")
    known.add_argument("level", choices=LEVELS)
    if not places:  # help or the version may be requested
        known.parse_args(hyphened)
    first = known.parse_args(hyphened[:end])
    last, others = _parser().parse_known_args(hyphened[end:])
    words = ["cohort", first.bids_dir, f"--output={first.out}"]
    for each in (first, last):
        words += [f"--participant-label={label}" for label in each.participant_label]
        words += [f"--session-label={label}" for label in each.session_label]
    return [*words, *(["--collect"] if first.level == "group" else []), *others]


def _parser() -> _Parser:
    """Parser of the options that `tetopt cohort` does not have, or spells differently."""
    parser = _Parser(
        usage=USAGE, description=ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.allow_abbrev = False
    parser.add_argument(
        "--participant-label",
        nargs="+",
        default=[],
        metavar="L",
        help="subjects, with or without sub-",
    )
    parser.add_argument(
        "--session-label", nargs="+", default=[], metavar="L", help="sessions, with or without ses-"
    )
    for name in ("--skip-bids-validation", "--skip-bids-validator"):
        parser.add_argument(
            name,
            action="store_true",
            help="accepted for compatibility; datasets are never validated",
        )
    parser.add_argument("-v", "--version", action="version", version=f"tetopt {tetopt.__version__}")
    return parser


def _with_hyphens(word: str) -> str:
    """Replace underscores by hyphens in a word of the command line if it is an option's name."""
    if not word.startswith("--"):
        return word
    name, equals, value = word.partition("=")
    return name.replace("_", "-") + equals + value


if __name__ == "__main__":
    sys.exit(main())
