"""The ``tetopt`` command line: its commands, exit codes and warnings."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

import tetopt
from tetopt import InputError
from tetopt.cli.compare import baseline_command, compare_command, paper_command
from tetopt.cli.console import out, show_error, show_warning
from tetopt.cli.convert import convert_command
from tetopt.cli.fem import fem_command
from tetopt.cli.mesh import demo_command, mesh_command
from tetopt.cli.options import from_records
from tetopt.cli.phantom import phantom_command
from tetopt.cli.quality import quality_command
from tetopt.cli.segment import segment_command
from tetopt.cli.surface import surface_command
from tetopt.cli.view import view_command

app = typer.Typer(
    name="tetopt",
    help="From a medical volume straight to an image-aligned tetrahedral mesh, without segmentation.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
COMMANDS: dict[str, Callable[..., int]] = {  # in the order of the help
    "mesh": mesh_command,
    "quality": quality_command,
    "convert": convert_command,
    "surface": surface_command,
    "view": view_command,
    "phantom": phantom_command,
    "fem": fem_command,
    "segment": segment_command,
    "paper": paper_command,
    "baseline": baseline_command,
    "compare": compare_command,
    "demo": demo_command,
}
for _name, _command in COMMANDS.items():
    app.command(_name)(from_records(_command))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit code: 0 done, 1 a promise of the mesh missed, 2 an input to mend, 130 Ctrl-C."""
    with warnings.catch_warnings():
        warnings.showwarning = show_warning
        logging.getLogger("matplotlib").setLevel(logging.ERROR)  # its font-cache notice is not the user's business
        try:
            arguments = list(sys.argv[1:] if argv is None else argv)
            return app(args=arguments, obj=arguments, standalone_mode=False) or 0
        except (InputError, OSError) as error:  # also a full disk, a folder that may not be written to
            show_error(error)
            return 2
        except typer.Exit as ended:
            return ended.exit_code
        except (typer.Abort, KeyboardInterrupt):  # newer versions of typer return 130 themselves
            return 130
        except Exception as error:
            if type(error).__module__.split(".")[0] not in ("click", "typer") or not hasattr(error, "format_message"):
                raise
            if error.format_message():  # empty after the help that a bare `tetopt` prints
                show_error(f"{error.format_message()} (see --help)")
            return 2


def _version(is_requested: bool) -> None:
    if is_requested:
        out.print(f"tetopt {tetopt.__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass
