"""The ``tetopt`` command line: its commands, exit codes and warnings."""

from __future__ import annotations

import atexit
import gc
import logging
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

import tetopt
from tetopt.cli.console import (
    open_streams,
    print_line,
    say,
    settle_streams,
    show_error,
    show_event,
    warnings_once,
)
from tetopt.cli.ending import INTERRUPTED_CODE, signal_code, signals_heard, tell_end
from tetopt.errors import InputError, error_words
from tetopt.job.events import listen_with
from tetopt.system.files import Outputs, check_places, outputs_of_command
from tetopt.system.interpreter import THREADS_NAME

# Commands in the order of the help, with the modules that define NAME_command; only the running
# command's is loaded.
COMMANDS = {
    "mesh": "mesh",
    "cohort": "cohort",
    "quality": "quality",
    "convert": "convert",
    "surface": "surface",
    "view": "view",
    "fem": "fem",
    "segment": "segment",
    "compare": "compare",
    "demo": "mesh",
    "phantom": "phantom",
    "warm-up": "warm_up",
}
ASIDE = ("demo", "phantom", "warm-up")  # below the commands on a user's own files
ASIDE_PANEL = "To try, and to prepare"

# The options that the help of a command with many shows; `--help-all` shows all.
OF_RUNS = (
    "mask mask_label background labels merge label_names nodes target_error edge_size cells_across "
    "order young nu fields loads max_seconds threads"
)
OF_MESHES = (
    "image_path labels label_field label_names mesh_units young nu density fields sets loads order"
)
SHOWN_OPTIONS = {
    "mesh": f"output json_path figures force dry_run {OF_RUNS}".split(),
    "cohort": f"output suffix participants mesh_format write_table dry_run retry_failed workers "
    f"scheduler {OF_RUNS}".split(),
    "convert": "results_path transform inverse units space written_fields like warp json_path "
    f"force {OF_MESHES}".split(),
    "fem": f"compress output mask json_path force {OF_MESHES}".split(),
}
HELP_ALL = "--help-all"
# new objects, and collections of a generation; Python's own are 700, 10, 10
COLLECTED_AT = 50_000, 20, 20
# numba's threading layers, and modules
LAYER_POOLS = {"omp": "omppool", "tbb": "tbbpool", "workqueue": "workqueue"}
LAYER_KINDS = ("default", "safe", "threadsafe", "forksafe")
MOST_DIGITS = 4  # of a number of threads: no machine has more


class _Plain:
    """A part of the command line whose help shows no metavar for switches, which take no value."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, with the metavar removed from switches."""
        parameters: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for each in parameters:
            if getattr(each, "is_flag", False):
                each.metavar = ""
        return parameters


class _Command(_Plain, TyperCommand):
    """A command, whose help shows its `SHOWN_OPTIONS` if it has some."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters; those that the help does not show are hidden."""
        parameters = super().get_params(ctx)
        shown = SHOWN_OPTIONS.get(str(self.name))
        if shown is None:
            return parameters
        for each in parameters:
            is_option = getattr(each, "param_type_name", "") == "option" and each.name != "help"
            each.hidden = is_option and each.name not in shown and HELP_ALL not in ctx.obj
        return parameters

    def get_help_option_names(self, ctx: Any) -> list[str]:
        """Return the names of the help in an order that does not change."""
        return sorted(super().get_help_option_names(ctx))


class _Group(_Plain, TyperGroup):
    pass


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return the exit code.

    0: done; 1: the mesh violates a requirement; 2: an invalid input, or an output, including
    standard output, that could not be written; 130, 143 and 129: ended by Ctrl-C, SIGTERM and
    SIGHUP.
    """
    # Commands load 400,000 objects that stay: fewer collections save 0.1 s, and none at exit 0.25
    # s.
    gc.set_threshold(*COLLECTED_AT)
    atexit.register(gc.freeze)
    open_streams()
    with (
        warnings_once(),
        outputs_of_command() as outputs,
        signals_heard(),
        listen_with(show_event),
    ):
        # its font-cache notice does not concern the user
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        code = _run(list(sys.argv[1:] if argv is None else argv), outputs)
    if reason := settle_streams():
        show_error(
            f"standard output cannot be written ({reason}); the printed output is incomplete"
        )
        code = code or 2
    return code


def _run(arguments: list[str], outputs: Outputs) -> int:
    """Run the command and return the exit code; print errors, and the outputs written in spite
    of them.
    """
    try:
        code = _app(arguments)(args=arguments, obj=arguments, standalone_mode=False) or 0
        check_places(outputs)
        return tell_end() if code in (INTERRUPTED_CODE, signal_code()) else code
    except (InputError, OSError, MemoryError) as error:
        show_error(error_words(error), arguments)
        if outputs.written:
            say(f"written before the error: {', '.join(map(str, outputs.written))}")
        return 2
    except typer.Exit as ended:
        return ended.exit_code
    except (typer.Abort, KeyboardInterrupt):  # newer versions of typer return 130 themselves
        return tell_end()
    except SystemExit:  # typer and rich exit so if the pipe for their help has closed
        return 0
    except Exception as error:
        if type(error).__module__.split(".")[0] not in ("click", "typer") or not hasattr(
            error, "format_message"
        ):
            raise
        if error.format_message():  # empty after the help that a bare `tetopt` prints
            show_error(f"{error.format_message()} (see --help)")
        return 2


def _app(arguments: Sequence[str]) -> typer.Typer:
    """Build the command line; only the command that the arguments name is loaded, the others are
    placeholders.
    """
    app = typer.Typer(
        name="tetopt",
        help="Turn a medical volume directly into an image-aligned tetrahedral mesh, without a "
        "segmentation.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        cls=_Group,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_common)
    # no option before it takes a value
    chosen = next((word for word in arguments if not word.startswith("-")), None)
    for name in COMMANDS:
        if name == chosen:
            about: dict[str, Any] = {}
            if name in SHOWN_OPTIONS:
                about["context_settings"] = {"help_option_names": ["-h", "--help", HELP_ALL]}
                about["epilog"] = f"{HELP_ALL} shows all options."
            app.command(name, cls=_Command, **about)(loaded_command(name))
        else:
            panel = ASIDE_PANEL if name in ASIDE else None
            app.command(name, help=help_line(name), rich_help_panel=panel)(lambda: None)
    return app


def help_line(name: str) -> str:
    """Return the first line of a command's docstring, read from its module's source, as
    importing it takes a second.
    """
    source = Path(__file__).with_name(f"{COMMANDS[name]}.py").read_text(encoding="utf-8")
    return (
        source.partition(f"def {name.replace('-', '_')}_command(")[2]
        .split('"""')[1]
        .splitlines()[0]
    )


def loaded_command(name: str) -> Callable[..., Any]:
    """Return the function of a command in the form that typer expects.

    Raises
    ------
    InputError
        An environment variable of the libraries that it loads has an invalid value.
    """
    _check_environment()
    from tetopt.cli.options import from_records  # this import loads the modules of its defaults

    return from_records(
        getattr(import_module(f"tetopt.cli.{COMMANDS[name]}"), f"{name.replace('-', '_')}_command")
    )


def _check_environment() -> None:
    """Raise InputError for an environment variable with which numba or matplotlib would fail in
    the middle of a run.
    """
    threads = os.environ.get(THREADS_NAME, "").strip()
    if threads and not (threads.isdecimal() and len(threads) <= MOST_DIGITS and int(threads) >= 1):
        raise InputError(
            f"{THREADS_NAME}: expected a whole number of threads from 1 to {10**MOST_DIGITS - 1}, "
            f"got {threads[:20]}; set a valid number, or unset it"
        )
    names = [
        name
        for name in os.environ
        if name.startswith("NUMBA_") and name not in ("NUMBA_CACHE_DIR", THREADS_NAME)
    ]
    names += ["MPLBACKEND"] if os.environ.get("MPLBACKEND") else []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # numba's for a value that is no number
            config = import_module("numba").config if names != ["MPLBACKEND"] and names else None
            import_module("matplotlib") if "MPLBACKEND" in names else None
    except Exception as error:
        words = str(error).partition("; supported values")[0].splitlines()[0].rstrip(".")
        raise InputError(f"environment: {words}; check {', '.join(names)}") from error
    if config is None:
        return
    able = [name for name, pool in LAYER_POOLS.items() if _is_importable(f"numba.np.ufunc.{pool}")]
    if config.THREADING_LAYER not in (*able, *LAYER_KINDS):
        expected = ", ".join((*able, *LAYER_KINDS))
        raise InputError(
            f"NUMBA_THREADING_LAYER: expected {expected}, got {config.THREADING_LAYER[:20]}; or "
            "unset it"
        )
    if sorted(config.THREADING_LAYER_PRIORITY) != sorted(LAYER_POOLS):
        raise InputError(
            f"NUMBA_THREADING_LAYER_PRIORITY: expected {' '.join(LAYER_POOLS)} in any order, or "
            "none"
        )


def _is_importable(name: str) -> bool:
    try:
        import_module(name)
    except ImportError:  # as tbbpool without TBB
        return False
    return True


def _version(is_requested: bool) -> None:
    if is_requested:
        print_line(f"tetopt {tetopt.__version__}")
        raise typer.Exit


def _common(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    pass
