"""Output of the commands: `log` on standard error, `out`, the result, on standard output.
Neither ends a run.
"""

from __future__ import annotations

import errno
import os
import re
import sys
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import IO, TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from tetopt.io.text import plain

if TYPE_CHECKING:
    from tetopt.job.events import Event

LINE_WIDTH = 100  # characters in a line, but for words that are longer
# characters: the remedy stands at the end, the value found may be a line of a million
LONGEST_ERROR = 480
# Options whose arguments have other names in the heads of the library's messages.
HEADS = {
    "smallest": "size_min",
    "longest": "edge_max",
    "field": "sizing",
    "octree": "nodes",
    "modulus": "young",
}
OPTION_NAMES: dict[str, str] = {}  # of the command that runs, by the arguments that messages name
# warnings that the command has printed; None outside of one
_SHOWN: ContextVar[set[str] | None] = ContextVar("shown", default=None)


class _Stream:
    """A stream that escapes characters it cannot encode, and discards everything once a write
    has failed.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write if possible; return the number of characters."""
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        self._try(
            lambda: self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        )
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
        # closed, or written to by the code that a signal interrupted
        except (ValueError, RuntimeError):
            pass


_unprinted: list[str] = []  # reasons why standard output lost text


def _silence(stream: Any) -> None:
    """Discard a stream's buffer and all that is written to it later."""
    # the stream was replaced by a program's own
    with suppress(OSError, ValueError, AttributeError):
        number = stream.fileno()
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, number)
        os.close(null)


class _Console(Console):
    """A console that shows foreign control characters, and whose stream may be closed, full or
    gone.
    """

    @property
    def file(self) -> IO[str]:
        """The stream, whose failures end nothing."""
        stream: Any = super().file
        is_ours = isinstance(stream, _Stream)
        return stream if is_ours else _Stream(stream)  # type: ignore[return-value]

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file

    def render_str(self, text: str, **options: Any) -> Text:
        """Render a text of a message or a table, with control characters, as of file names,
        shown.
        """
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
            # the lowest free number is this one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            # as long as the process
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


def settle_streams() -> str | None:
    """Flush the streams, so that Python cannot fail at exit; return the reason why standard
    output lost text.
    """
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            _Stream(stream).flush()
    reason = _unprinted[0] if _unprinted else None
    _unprinted.clear()
    return reason


def width_of(console: Console) -> int:
    """Return the width of printed lines: that of the terminal, but at most `LINE_WIDTH`."""
    return min(console.width, LINE_WIDTH) if console.is_terminal else LINE_WIDTH


def wrap_text(text: str, console: Console) -> list[str]:
    """Break a line between words, where it is wider than allowed; long words, as paths, are kept
    whole.
    """
    width = width_of(console)
    return textwrap.wrap(
        text, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    ) or [""]


def print_line(text: str) -> None:
    """Print a line of the result on standard output, wrapped."""
    for line in wrap_text(plain(text), out):
        out.print(escape(line))


def show_error(message: object, arguments: Sequence[str] = ()) -> None:
    """Print an error with the command's names for options: on one line of limited length, which
    a terminal wraps.
    """
    line = plain(in_options(str(message), arguments))
    if len(line) > LONGEST_ERROR:  # it quotes a file
        line = f"{line[: LONGEST_ERROR // 2]} ... {line[-LONGEST_ERROR // 3 :]}"
    _say(f"tetopt: {line}", "tetopt:", "bold red", is_wrapped=log.is_terminal)


def _say(line: str, head: str = "", style: str = "", is_wrapped: bool = True) -> None:
    """Print a line on standard error, its head in a style."""
    first, *rest = wrap_text(line, log) if is_wrapped else [line]
    if head and first.startswith(head):
        log.print(f"[{style}]{head}[/]{escape(first.removeprefix(head))}")
    else:
        log.print(escape(first))
    for each in rest:
        log.print(escape(each))


def in_options(message: str, arguments: Sequence[str] = ()) -> str:
    """Replace a message's names of arguments by the command's options: those between backticks,
    and that at its head, perhaps after a file's, if it is an option among the `arguments`.
    """
    if "`" in message:
        from tetopt.job.options import JobOptions, kinds_of, option_name

        names = {
            name: f"--{option_name(name, kind)}" for name, kind in kinds_of(JobOptions).items()
        }
        names |= OPTION_NAMES
        message = re.sub(r"`(\w+)`", lambda match: names.get(match[1], match[0]), message)
    parts = message.split(": ")
    for place, name in enumerate(parts[:2]):
        option = f"--{HEADS.get(name, name).replace('_', '-').lower()}"
        if any(word.partition("=")[0] == option for word in arguments):
            return ": ".join([*parts[:place], option, *parts[place + 1 :]])
    return message


def say(text: str) -> None:
    """Print a line of the library."""
    _say(plain(in_options(text)))


def show_event(event: Event) -> None:
    """Print a note, a warning, or a violated requirement."""
    if event.kind == "note":
        say(event.text)
    elif event.kind == "warning":
        show_warning(event.text)
    elif event.kind == "violated":
        _say(f"tetopt: {plain(in_options(event.text))}", "tetopt:", "bold red")


def show_warning(message: str) -> None:
    """Print a warning; each text once in a command."""
    shown = _SHOWN.get()
    if shown is None or message not in shown:
        _say(f"tetopt: warning: {plain(in_options(message))}", "tetopt: warning:", "yellow")
    if shown is not None:
        shown.add(message)


@contextmanager
def warnings_once() -> Iterator[None]:
    """Print Python's warnings and those of runs, each text once within this context: a file may be
    image and labels, and several functions compare a mesh with the image.
    """
    token = _SHOWN.set(set())
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: show_warning(str(message))
            yield
    finally:
        _SHOWN.reset(token)


def print_verdict(
    violated: Iterable[str],
    words: str,
    measured: dict[str, Any],
    mask_word: str,
    which: str = "all requirements",
) -> None:
    """Print a command's last lines: what requirements allow of mask and labels, whether they are
    met, the mesh.
    """
    from tetopt.job.advice import beyond_requirements  # imports numba

    names = ", ".join(violated)
    beyond = beyond_requirements(measured, mask_word)
    for line in beyond.values():
        print_line(line)
    met = f"{which} are met" + (f", but {' and '.join(beyond)} (above)" if beyond else "")
    print_line(f"requirements not met: {names}; {words}" if names else f"{met}; {words}")


def print_fidelity(
    measured: dict[str, Any], ndim: int, word: str = "mask", every: bool = False
) -> None:
    """Print how well the mesh fits sizes, contrasts, mask and labels, as far as `measured`
    (`tetopt.measure.measures`).

    `ndim` is the mesh's dimension; `word` is the name of the mask; `every` prints all labels and
    all their measures.
    """
    # these import numba and more
    from tetopt.report.tables import mask_table, sizes_in_words

    if "edges_over_target" in measured:
        print_line(sizes_in_words(measured["edges_over_target"]))
    for row in measured.get("contrasts", []):
        fraction = (
            "constant"
            if row["E_D_fraction_of_variance"] is None
            else f"{row['E_D_fraction_of_variance']:.5f}"
        )
        print_line(
            f"{row['image']}: weight {row['weight']:g}, unexplained variance of this image "
            f"{fraction}"
        )
    if "mask" in measured:
        print_table(mask_table(measured["mask"], ndim, word))
    if "labels" in measured and "interfaces" in measured:
        _print_labels(measured, ndim, every)
    _print_thin(measured, ndim)


def _print_labels(measured: dict[str, Any], ndim: int, every: bool) -> None:
    """Print the labels: the worst, or every one with all measures."""
    from tetopt.model.label_names import count_of_labels
    from tetopt.report.tables import label_differences, label_table, surface_table, worst_labels

    names = measured.get("label_names", {})
    places = worst_labels(measured["labels"], *([None] if every else []))
    rows = [measured["labels"][place] for place in places]
    print_table(label_table(rows, names, ndim))
    if len(places) < len(measured["labels"]):
        n_all = count_of_labels([row.label for row in measured["labels"]], " labels")
        which = f"the {len(places)} of {n_all} that fit worst, by Dice or volume"
        print_line(f"{which}; `tetopt quality --all` prints all")
    if every:
        print_table(surface_table(rows, names))
    for line in label_differences(rows, names):
        print_line(line)


def _print_thin(measured: dict[str, Any], ndim: int) -> None:
    """Print the thinnest labels, in cells, and false contacts of labels."""
    from tetopt.report.tables import contact_table, contacts_in_words, thin_table

    names = measured.get("label_names", {})
    tables = (
        thin_table(measured.get("labels", []), names),
        contact_table(measured.get("contacts", []), names, ndim),
    )
    for table in tables:
        if table is not None:
            print_table(table)
    if measured.get("contacts"):
        print_line(contacts_in_words(measured["contact_totals"], ndim))


def print_table(table: Table) -> None:
    """Print a table in the width of the terminal, or in 100 columns into a pipe, which has no
    width; wider if words or numbers would be cut.
    """
    console = _Console(file=out.file, width=width_of(out), highlight=False, emoji=False)
    for column in table.columns:
        if column.no_wrap and column.max_width is None:  # whole numbers, words of the header
            words = [*map(str, column.cells), *str(column.header).split()]
            column.no_wrap, column.min_width = False, max(map(len, words))
    console.print(table, crop=False)
