"""``tetopt view``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.markup import escape

from tetopt import InputError
from tetopt.cli.console import out
from tetopt.cli.inputs import label_table, read_image, read_mesh, warn_of_other_image
from tetopt.cli.options import BoxPart, ForceOption, LabelNamesOption, option
from tetopt.cli.solver import all_sets
from tetopt.incoming import json_of
from tetopt.io.files import checked_output
from tetopt.io.meshes import MeshFile
from tetopt.model.fields import cell_fields
from tetopt.model.sets import facet_triples


def view_command(
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="VTU, VTK or gmsh MSH file of tetrahedra.")],
    image_path: Annotated[Path | None, option("IMAGE", "Show its slice behind the mesh's section.", "--image")] = None,
    html: Annotated[Path | None, option("OUT.html", "Write one page for a browser, open no window.", "--html")] = None,
    label_names: LabelNamesOption = None,
    *,
    part: BoxPart,
    force: ForceOption = False,
) -> int:
    """Look at a mesh, or at results on it: cut, colour by any field, threshold, deform; in a window or a page.

    A mesh with displacements is drawn deformed, by a factor that a slider changes; of quadratic cells the corners are.
    """
    if html is not None:
        html = checked_output(html, (".html",), force)
    loaded = read_mesh(mesh_path)
    mesh, fields = loaded.mesh, dict(loaded.cell_data)
    image = None
    if image_path is not None:
        image = read_image(image_path, part)
        if image.ndim != mesh.ndim:
            raise InputError(f"{image_path}: expected a {mesh.ndim}-D image, as the mesh is, got a {image.ndim}-D one")
        warn_of_other_image(loaded, mesh_path, image_path)
        if "mean" not in fields:
            fields = cell_fields(mesh, image) | fields
    table, former = label_table(label_names, loaded), label_table(None, loaded).names
    sets = all_sets(mesh, loaded.box, fields, loaded.sets, table.names, former, is_told=False).facets
    triples = {name: facet_triples(mesh.cells, rows) for name, rows in sets.items()}
    from tetopt.report.exhibit import exhibit  # matplotlib and pyvista are slow to load, and only needed here

    shown = exhibit(mesh, fields, image, mesh_path.name, triples, loaded.point_data, _reactions(loaded), table)
    if html is None:
        from tetopt.report.window import show

        show(shown)
        return 0
    from tetopt.report.explore import save_explorer

    save_explorer(html, shown)
    out.print(escape(f"{html}: open it in a browser; {html.stat().st_size / 1e6:.1f} MB, needs nothing else"))
    return 0


def _reactions(loaded: MeshFile) -> dict[int, dict[str, list[float]]]:
    """The forces that hold sets, mN by step, that a file of `tetopt fem` states."""
    reactions = {}
    for key in loaded.field_data:
        match = re.fullmatch(r"reactions(?:_step(\d{1,9}))?", key)
        if match is None:
            continue
        try:
            by_set = json_of(loaded.text(key) or "{}")
            forces = {str(name): [float(x) for x in force] for name, force in by_set.items() if len(force) == 3}
        except (TypeError, ValueError, AttributeError):  # another program's
            continue
        if np.isfinite([*forces.values()]).all():
            reactions[int(match[1] or 1)] = forces
    return reactions
