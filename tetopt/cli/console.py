"""Output of the commands: `log` on standard error, `out`, the result, on standard output. Neither ends a run."""

from __future__ import annotations

import errno
import os
import re
import sys
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from tetopt.io.text import plain

if TYPE_CHECKING:
    from tetopt.job.events import Event

WIDEST_TABLE = 500  # characters in a line
LONGEST_ERROR = 480  # characters: the remedy stands at the end, the value found may be a line of a million
PARAMETER_OPTIONS = {  # by parameters of the library's functions, the command line's names
    **{
        name: f"--{name.replace('_', '-').lower()}"
        for name in (
            "k_D", "min_dihedral", "shape_power", "target_error", "label_weight", "smooth_interfaces", "n_t",
            "retessellate", "gradation", "boundary", "iterations", "nodes", "weights",
        )
    },
    "smallest": "--size-min", "edge_size": "--edge-size", "longest": "--edge-max", "field": "--sizing",
}  # fmt: skip
PARAMETER_PATTERN = re.compile(rf"^(?:{'|'.join(PARAMETER_OPTIONS)})(?=:)")
OPTION_NAMES: dict[str, str] = {}  # of the command that runs, by the arguments that messages name


class _Stream:
    """A stream that escapes characters it cannot encode, and discards everything once a write has failed."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write if possible; return the number of characters."""
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        self._try(lambda: self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding)))
        return len(text)

    def flush(self) -> None:
        """Flush if possible."""
        self._try(self._stream.flush)

    def _try(self, action: Any) -> None:
        try:
            action()
        except OSError as error:  # full, or the reader of the pipe has gone
            if error.errno != errno.EPIPE and self._stream is sys.stdout:
                _unprinted.append(error.strerror or str(error))
            _silence(self._stream)
        except (ValueError, RuntimeError):  # closed, or written to by the code that a signal interrupted
            pass


_unprinted: list[str] = []  # reasons why standard output lost text


def _silence(stream: Any) -> None:
    """Discard a stream's buffer and all that is written to it later."""
    with suppress(OSError, ValueError, AttributeError):  # the stream was replaced by a program's own
        number = stream.fileno()
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, number)
        os.close(null)


class _Console(Console):
    """A console that shows foreign control characters, and whose stream may be closed, full or gone."""

    @property
    def file(self) -> IO[str]:
        """The stream, whose failures end nothing."""
        stream: Any = super().file
        return stream if isinstance(stream, _Stream) else _Stream(stream)  # type: ignore[return-value]

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file

    def render_str(self, text: str, **options: Any) -> Text:
        """Render a text of a message or a table, with control characters, as of file names, shown."""
        return super().render_str(plain(text), **options)


log = _Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)
out = _Console(highlight=False, soft_wrap=True, emoji=False)


def open_streams() -> None:
    """Open the null device in place of closed standard input, output or error.

    Otherwise the next file that is opened takes their number and receives the libraries' output.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest free number is this one
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, as long as the process


def settle_streams() -> str | None:
    """Flush the streams, so that Python cannot fail at exit; return the reason why standard output lost text."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            _Stream(stream).flush()
    reason = _unprinted[0] if _unprinted else None
    _unprinted.clear()
    return reason


def show_error(message: object) -> None:
    """Print an error on one line of limited length, with the command's names for options."""
    line = plain(in_options(str(message)))
    if len(line) > LONGEST_ERROR:  # it quotes a file
        line = f"{line[: LONGEST_ERROR // 2]} ... {line[-LONGEST_ERROR // 3 :]}"
    log.print(f"[bold red]tetopt:[/] {escape(line)}")


def in_options(message: str) -> str:
    """Replace a message's names of arguments, at its head and between backticks, by the command's options."""
    return PARAMETER_PATTERN.sub(lambda name: PARAMETER_OPTIONS[name[0]], with_hyphens(message))


def with_hyphens(message: str) -> str:
    """Replace a message's arguments between backticks by the command's options."""
    if "`" not in message:
        return message
    from tetopt.job.options import JobOptions, kinds_of, option_name

    names = {name: f"--{option_name(name, kind)}" for name, kind in kinds_of(JobOptions).items()} | OPTION_NAMES
    return re.sub(r"`(\w+)`", lambda match: names.get(match[1], match[0]), message)


def say(text: str) -> None:
    """Print a line of the library."""
    log.print(escape(with_hyphens(text)))


def show_event(event: Event) -> None:
    """Print a note, a warning, or a violated requirement."""
    if event.kind == "note":
        say(event.text)
    elif event.kind == "warning":
        show_warning(event.text)
    elif event.kind == "violated":
        show_error(event.text)


def show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning on one line; replaces `warnings.showwarning`."""
    log.print(f"[yellow]tetopt: warning:[/] {escape(plain(with_hyphens(str(message))))}")


def print_fidelity(measured: dict[str, Any], ndim: int, word: str = "mask") -> None:
    """Print how well the mesh fits sizes, contrasts, mask and labels, as far as `measured` (`tetopt.report.summary`).

    `ndim` is the mesh's dimension; `word` is the name of the mask.
    """
    # these import numba and more
    from tetopt.report.tables import label_differences, label_table, mask_table, sizes_in_words

    if "edges_over_target" in measured:
        out.print(escape(sizes_in_words(measured["edges_over_target"])))
    for row in measured.get("contrasts", []):
        fraction = "constant" if row["E_D_fraction_of_variance"] is None else f"{row['E_D_fraction_of_variance']:.5f}"
        out.print(escape(f"{row['image']}: weight {row['weight']:g}, unexplained variance {fraction}"))
    if "mask" in measured:
        print_wide(mask_table(measured["mask"], ndim, word))
    if "labels" in measured and "interfaces" in measured:
        rows, interfaces, names = measured["labels"], measured["interfaces"], measured.get("label_names", {})
        print_wide(label_table(rows, interfaces, names, ndim))
        for line in label_differences(rows, interfaces, names):
            out.print(escape(line))
    _print_thin(measured, ndim)


def _print_thin(measured: dict[str, Any], ndim: int) -> None:
    """Print the thinnest labels, in cells, and false contacts of labels."""
    from tetopt.report.tables import contact_table, contacts_in_words, thin_table

    names = measured.get("label_names", {})
    if "labels" in measured:
        print_wide(thin_table(measured["labels"], names))
    if "contacts" in measured:
        if (table := contact_table(measured["contacts"], names, ndim)) is not None:
            print_wide(table)
        out.print(escape(contacts_in_words(measured["contact_totals"], ndim)))


def print_wide(table: Table) -> None:
    """Print a table at its full width, also into a pipe, which has no width."""
    width = out.measure(table, options=out.options.update(width=WIDEST_TABLE)).maximum
    _Console(file=out.file, width=max(out.width, width), highlight=False, emoji=False).print(table)
