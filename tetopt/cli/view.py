"""``tetopt view``."""

from __future__ import annotations

import os
import re
import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import Annotated

import numpy as np

from tetopt import InputError
from tetopt.cli.console import print_line
from tetopt.cli.options import FilesArgument, ForceOption, ShownOptions, mesh_and_image
from tetopt.commands.beside import check_part, voxels_of
from tetopt.job.events import warnings_heard
from tetopt.job.field_files import read_fields
from tetopt.job.mesh_file import label_table, read_mesh
from tetopt.job.option_values import number_of
from tetopt.job.options import BoxPart, MaskedPart, MaskPart, Option
from tetopt.model.build import with_cell_fields
from tetopt.model.fields import cell_fields
from tetopt.model.file import MeshFile, sets_beside
from tetopt.model.sets import facet_triples
from tetopt.system.files import check_output
from tetopt.system.incoming import json_of


def view_command(
    paths: FilesArgument,
    image_path: Annotated[
        Path | None, Option("IMAGE", "Show this image's slice behind the mesh's section.", "image")
    ] = None,
    *,
    how: ShownOptions,
    part: BoxPart,
    region: MaskPart,
    force: ForceOption = False,
) -> int:
    """View a mesh or its results in the browser: cut, colour by any field, threshold, deform.

    A mesh with displacements is drawn deformed, scaled by a slider; quadratic cells are drawn by
    their corners.
    """
    html = None if how.html is None else check_output(how.html, (".html",), force)
    limits = None if how.limits is None else _limits(how.limits)
    mesh_path, image_path = mesh_and_image(paths, image_path)
    counted = MaskedPart(**vars(part), **vars(region))
    check_part(image_path, counted)
    loaded = read_mesh(mesh_path, region)
    mesh = loaded.mesh
    fields = dict(loaded.cell_data)
    what = voxels_of(loaded, mesh_path, image_path, counted).content
    image = None if what is None else what.given
    if what is not None and "mean" not in fields:
        fields = cell_fields(mesh, what) | fields
    with warnings_heard():
        own_mask = None if what is None else what.own_mask
        fields, _ = with_cell_fields(mesh, read_fields(how.fields), own_mask, fields, {})
    table = label_table(how.label_names, loaded)
    former = label_table(None, loaded).names
    sets = sets_beside(mesh, loaded.box, fields, loaded.sets, table.names, former)[0].facets
    triples = {name: facet_triples(mesh.cells, rows) for name, rows in sets.items()}
    # matplotlib and pyvista load slowly and are needed only here
    from tetopt.report.exhibit import exhibit, opened_on
    from tetopt.report.explore import save_explorer

    shown = exhibit(
        mesh, fields, image, mesh_path.name, triples, loaded.point_data, _reactions(loaded), table
    )
    page = Path(tempfile.mkdtemp(prefix="tetopt-")) / "view.html" if html is None else html
    save_explorer(page, opened_on(shown, how.show or _only_labels(loaded), limits))
    words = "opened in the browser" if html is None and _is_opened(page) else "open it in a browser"
    print_line(f"{page}: {words}; {page.stat().st_size / 1e6:.1f} MB, self-contained")
    return 0


def _is_opened(page: Path) -> bool:
    """Open a page in the browser, and return whether it opened; on Linux without a screen none
    opens, as it would be one in this terminal.
    """
    has_screen = (
        not sys.platform.startswith("linux")
        or os.environ.get("DISPLAY")
        or os.environ.get("WAYLAND_DISPLAY")
    )
    return bool(has_screen) and webbrowser.open(page.as_uri())


def _limits(text: str) -> tuple[float, float]:
    """Parse the two numbers of --range."""
    parts = text.split(",")
    if len(parts) != 2:
        raise InputError(f'--range: expected LOW,HIGH, such as 0,120, got "{text}"')
    return number_of("--range", parts[0]), number_of("--range", parts[1])


def _only_labels(loaded: MeshFile) -> str | None:
    """Return the field of labels if the mesh was built from labels alone, as means of label numbers
    are meaningless.

    A mesh with results on its nodes opens with these.
    """
    weights = loaded.table("inputs").get("weights")
    are_alone = isinstance(weights, list) and len(weights) > 0 and not any(weights)
    return "label" if are_alone and "label" in loaded.cell_data and not loaded.point_data else None


def _reactions(loaded: MeshFile) -> dict[int, dict[str, list[float]]]:
    """Return the reactions of sets, mN, by step, from a file of `tetopt fem`."""
    reactions = {}
    for key in loaded.field_data:
        match = re.fullmatch(r"reactions(?:_step(\d{1,9}))?", key)
        if match is None:
            continue
        try:
            by_set = json_of(loaded.text(key) or "{}")
            forces = {
                str(name): [float(x) for x in force]
                for name, force in by_set.items()
                if len(force) == 3
            }
        except (TypeError, ValueError, AttributeError):  # written by another program
            continue
        if np.isfinite([*forces.values()]).all():
            reactions[int(match[1] or 1)] = forces
    return reactions
