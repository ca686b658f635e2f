"""``tetopt surface``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape

from tetopt import InputError
from tetopt.cli.console import log, out, show_error, show_warning
from tetopt.cli.inputs import cell_field, check_no_input, label_table, read_mesh
from tetopt.cli.options import LabelNamesOption, MeshArgument, NumberOptions, SpaceOption, option
from tetopt.geometry.simplex import volumes
from tetopt.geometry.surface import surface_of
from tetopt.geometry.topology import largest_component
from tetopt.io.files import checked_output, save_json
from tetopt.io.meshes import MeshFile
from tetopt.io.surfaces import SURFACE_SUFFIXES, checked_surface, save_surface
from tetopt.model.labels import label_words, labels_named
from tetopt.model.model import SPACES
from tetopt.report.tables import new_table


def surface_command(
    mesh_path: MeshArgument,
    output: Annotated[Path, option("OUT.stl", "Surface to write, STL or PLY.", "-o", "--output")],
    below: Annotated[float | None, option("T", "Of the largest connected set of cells with a mean below T.")] = None,
    label: Annotated[str | None, option("L", "Of all cells with this label, by number or name.")] = None,
    cell_set: Annotated[str | None, option("NAME", "Of a named set of cells.", "--set")] = None,
    space: SpaceOption = "ras",
    label_names: LabelNamesOption = None,
    *,
    numbers: NumberOptions,
) -> int:
    """Write the boundary of a structure in a mesh, watertight; print its volume and area."""
    output = checked_output(output, SURFACE_SUFFIXES, numbers.force)
    json_path = numbers.checked()
    check_no_input(output, mesh_path)
    if sum(choice is not None for choice in (below, label, cell_set)) != 1:
        raise InputError("surface: give one of --below, --label and --set")
    if space not in SPACES:
        raise InputError(f"--space: expected {' or '.join(SPACES)}, got {space}")
    loaded = read_mesh(mesh_path)
    if loaded.mesh.ndim != 3:
        raise InputError(f"{mesh_path}: expected tetrahedra, whose boundary is a surface, found triangles")
    names = label_table(label_names, loaded).names
    if label is not None:
        chosen = _with_label(loaded, mesh_path, labels_named(label, names), names)
    else:
        chosen = _chosen(loaded, mesh_path, below, cell_set)
    surface = surface_of(loaded.mesh.points, loaded.mesh.cells, chosen)
    save_surface(output, surface, mesh_path.name, space)
    written = checked_surface(output)
    table = new_table("", escape(output.name))
    table.add_row("cells", str(len(chosen)))
    table.add_row("triangles", str(len(surface.triangles)))
    table.add_row("closed surfaces", str(written.n_pieces))
    table.add_row("volume, mm3", f"{written.volume:.6g}")
    table.add_row("of the cells, mm3", f"{volumes(loaded.mesh.points, loaded.mesh.cells[chosen]).sum():.6g}")
    table.add_row("area, mm2", f"{written.area:.6g}")
    if surface.n_parted:
        log.print(
            f"{surface.n_parted} nodes and edges where the structure touches itself were parted, by "
            f"{surface.largest_shift:.2g} mm at most, so that each edge is in two triangles"
        )
    if json_path is not None:
        measured = {"volume_mm3": written.volume, "area_mm2": written.area, "n_pieces": written.n_pieces}
        parted = {"n_parted": surface.n_parted, "largest_shift_mm": surface.largest_shift}
        files = {"mesh": mesh_path.name, "surface": output.name}
        save_json(json_path, files | {"is_watertight": written.is_watertight} | measured | parted)
    out.print(table)
    if not (written.is_watertight and written.is_winding_consistent and written.volume > 0.0):
        show_error(f"{output}: not watertight, by trimesh; please report this")
        return 1
    out.print("checked with trimesh: watertight, normals out")
    return 0


def _with_label(loaded: MeshFile, path: Path, chosen: list[int], names: dict[int, str]) -> NDArray[np.int64]:
    """Numbers of the cells of these labels."""
    labels = cell_field(loaded, path, "label")
    cells = np.flatnonzero(np.isin(labels, chosen))
    if len(cells) == 0:
        known = ", ".join(label_words(each, names) for each in np.unique(labels)[:20].astype(np.int64).tolist())
        words = " or ".join(label_words(each, names) for each in chosen)
        raise InputError(f"{path}: no cell has label {words}; there are {known}")
    return cells


def _chosen(loaded: MeshFile, path: Path, below: float | None, cell_set: str | None) -> NDArray[np.int64]:
    """Numbers of the cells that make up the structure."""
    if cell_set is not None:
        if cell_set not in loaded.sets.cells:
            known = ", ".join(loaded.sets.cells) or "none"
            raise InputError(f'{path}: has no set of cells "{cell_set}"; it has {known}')
        return loaded.sets.cells[cell_set]
    assert below is not None
    mean = cell_field(loaded, path, "mean")
    chosen = largest_component(loaded.mesh.cells, mean < below)
    if len(chosen) == 0:
        raise InputError(f"{path}: no cell has a mean below {below:g}, they go from {mean.min():g} up")
    if len(chosen) == len(mean):
        show_warning(f"every cell has a mean below {below:g}: this is the mesh's own boundary")
    return chosen
