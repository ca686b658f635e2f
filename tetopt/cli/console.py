"""What the commands say: `log` on standard error, `out`, the result, on standard output."""

from __future__ import annotations

import os
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

WIDEST_TABLE = 500  # characters in a line


class _Console(Console):
    """A console that falls silent when the reader of its pipe has gone, and lets the command end in its own way."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


log = _Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)
out = _Console(highlight=False, soft_wrap=True, emoji=False)


def show_error(message: object) -> None:
    """Say what is wrong, on one line."""
    log.print(f"[bold red]tetopt:[/] {escape(str(message))}")


def show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Say a warning on one line; also in place of `warnings.showwarning`."""
    log.print(f"[yellow]tetopt: warning:[/] {escape(str(message))}")


def print_fidelity(measured: dict[str, Any]) -> None:
    """How well sizes, contrasts, mask and labels are met, as far as `measured` has them (`tetopt.report.summary`)."""
    # numba and more come with these
    from tetopt.report.tables import label_differences, label_table, mask_table, sizes_in_words

    if "edges_over_target" in measured:
        out.print(escape(sizes_in_words(measured["edges_over_target"])))
    for row in measured.get("contrasts", []):
        share = "constant" if row["E_D_share_of_variance"] is None else f"{row['E_D_share_of_variance']:.5f}"
        out.print(escape(f"{row['image']}: weight {row['weight']:g}, share of its own variance in cells {share}"))
    if "mask" in measured:
        print_wide(mask_table(measured["mask"]))
    if "labels" in measured:
        rows, interfaces, names = measured["labels"], measured["interfaces"], measured.get("label_names", {})
        print_wide(label_table(rows, interfaces, names))
        for line in label_differences(rows, interfaces, names):
            out.print(escape(line))


def print_wide(table: Table) -> None:
    """A table as wide as it is, also where a pipe has no width."""
    width = out.measure(table, options=out.options.update(width=WIDEST_TABLE)).maximum
    _Console(file=out.file, width=max(out.width, width), highlight=False, emoji=False).print(table)
