"""``tetopt compare``: comparison with the conventional pipelines."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.text import Text

from tetopt.cli.console import print_line, print_table
from tetopt.cli.options import ForceOption, ImageArgument
from tetopt.job.options import Option
from tetopt.report.tables import new_table
from tetopt.study.compare_table import short_table
from tetopt.study.options import CompareOptions


def compare_command(
    context: typer.Context,
    image_path: ImageArgument,
    output: Annotated[Path, Option("DIR", "Folder for the results.", letter="o")],
    options: CompareOptions,
    force: ForceOption = False,
) -> int:
    """Compare tetopt with the conventional pipelines on a volume: fidelity, shape, simulation
    accuracy, time.
    """
    from tetopt.study.compare_files import compare_image

    command = f"tetopt {' '.join(map(shlex.quote, context.obj))}"
    report = compare_image(image_path, output, options, command, force=force)
    columns, rows, notes = short_table(report)
    table = new_table("", *(Text(column.heading.replace(" ", "\n")) for column in columns))
    for row in rows:
        table.add_row(escape(row.title), *([text for text, _ in row.cells] or ["failed"]))
    print_table(table)
    for line in notes:
        print_line(line)
    for row in rows:
        if row.failure is not None:
            print_line(f"{row.title}: {row.failure}")
    print_line(
        f"{output / 'report.html'}: {len(report.options.pipelines)} pipelines, "
        f"{report.seconds:.0f} s"
    )
    return 0
