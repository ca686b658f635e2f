"""``tetopt surface``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rich.markup import escape

from tetopt.cli.console import print_line, print_table
from tetopt.cli.options import MeshArgument, NumberOptions
from tetopt.commands.boundary import SurfacePart, write_surface
from tetopt.io.surfaces import SURFACE_SUFFIXES
from tetopt.job.options import Option
from tetopt.report.tables import new_table
from tetopt.system.files import check_output


def surface_command(
    mesh_path: MeshArgument,
    output: Annotated[
        Path, Option("OUT.stl", "Surface to write: STL, PLY, VTP or VTK.", letter="o")
    ],
    *,
    part: SurfacePart,
    numbers: NumberOptions,
) -> int:
    """Write the boundary of a structure in a mesh, watertight, or interfaces of its labels;
    print volume and area.
    """
    output = check_output(output, SURFACE_SUFFIXES, numbers.force)
    numbers.check()
    written = write_surface(mesh_path, output, part)
    table = new_table(*map(escape, written.heads))
    for row in written.rows:
        table.add_row(*map(escape, row))
    print_table(table)
    for line in written.lines:
        print_line(line)
    numbers.save(written.numbers)
    return 0 if written.is_sound else 1
