"""Surface of a structure in a mesh's file, or between labels; written, read back and measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from tetopt.commands.beside import cell_field
from tetopt.errors import InputError
from tetopt.geometry.manifold import OUTSIDE_LABEL, LabelSurfaces, label_surfaces, surface_ridges
from tetopt.geometry.surface import Surface, extract_surface
from tetopt.geometry.topology import facets, largest_component
from tetopt.io.surfaces import LABELLED_SUFFIXES, SurfaceCheck, check_surface, save_surface
from tetopt.job.events import note, report_violation, warning
from tetopt.job.mesh_file import label_table, read_mesh
from tetopt.job.options import LabelNamesOption, MeshPart, Option, SpaceOption
from tetopt.measure.fidelity import FacetSurface, surface_areas
from tetopt.model.file import MeshFile
from tetopt.model.label_names import LABEL_FIELD, label_words, labels_named
from tetopt.model.model import SPACES
from tetopt.model.sets import FACE_NAMES, Names, boundary_rows, face_sets
from tetopt.system.arrays import Ints, Json

MOST_LISTED = 12  # interfaces in the table; the file of numbers has all


@dataclass(frozen=True, kw_only=True)
class SurfacePart(MeshPart):
    """Surface of a mesh to write, and its coordinates."""

    below: Annotated[
        float | None,
        Option("T", "Surface of the largest connected set of cells with means below T."),
    ] = None
    label: Annotated[
        str | None, Option("L", "Surface of all cells with this label, by number or name.")
    ] = None
    cell_set: Annotated[str | None, Option("NAME", "Surface of a named set of cells.", "set")] = (
        None
    )
    boundary: Annotated[
        bool, Option(None, "Surface of the whole mesh; with `interfaces`, add it to these.")
    ] = False
    interface: Annotated[
        str | None, Option("J,K", "Interface of two labels, normals out of J; may be open.")
    ] = None
    interfaces: Annotated[
        bool,
        Option(
            None,
            "All interfaces of labels as one surface, each triangle with the labels on both sides.",
        ),
    ] = False
    space: SpaceOption = "ras"
    label_names: LabelNamesOption = None


class WrittenSurface(NamedTuple):
    """Description of a surface that was written."""

    numbers: Json  # as `tetopt surface --json` writes them
    heads: tuple[str, ...]  # of a table
    rows: Sequence[tuple[str, ...]]
    lines: list[str]  # below it
    is_sound: bool = True


def write_surface(mesh: Path, output: Path, part: SurfacePart) -> WrittenSurface:
    """Write the boundary of a structure in a mesh's file, watertight, or interfaces of its labels.

    Raises
    ------
    InputError
        The request is not for one surface; the surface does not exist; the file cannot hold it.
    """
    _check_part(part, output)
    loaded = read_mesh(mesh, part)
    if loaded.mesh.ndim != 3:
        raise InputError(f"{mesh}: expected tetrahedra, whose boundary is a surface, got triangles")
    names = label_table(part.label_names, loaded).names
    write = _write_interfaces if part.interfaces or part.interface is not None else _write_closed
    written = write(loaded, mesh, output, part, names)
    if loaded.mesh.midpoints is not None:
        note(f"{mesh}: its cells are curved; the triangles are flat, between the corners of cells")
    return written._replace(numbers={"mesh": mesh.name, "surface": output.name} | written.numbers)


def _check_part(part: SurfacePart, output: Path) -> None:
    """Raise InputError unless one surface is requested, and the file can hold it."""
    chosen = [
        part.below is not None,
        part.label is not None,
        part.cell_set is not None,
        part.interface is not None,
    ]
    if sum([*chosen, part.boundary or part.interfaces]) != 1:
        raise InputError(
            "surface: give exactly one of `below`, `label`, `cell_set`, `boundary`, `interface` "
            "and `interfaces` (`boundary` may be added to `interfaces`)"
        )
    if part.interfaces and output.suffix.lower() not in LABELLED_SUFFIXES:
        raise InputError(
            f"{output}: STL cannot store the labels of triangles; use "
            f"{' or '.join(LABELLED_SUFFIXES)}"
        )
    if part.space not in SPACES:
        raise InputError(f"`space`: expected {' or '.join(SPACES)}, got {part.space}")


def _write_closed(
    loaded: MeshFile, path: Path, output: Path, part: SurfacePart, names: Names
) -> WrittenSurface:
    """Write the boundary of a structure, or of the whole mesh, and read it back."""
    if part.label is not None:
        chosen = _with_label(loaded, path, labels_named(part.label, names), names)
    else:
        chosen = _structure_cells(loaded, path, part)
    surface = extract_surface(loaded.mesh.points, loaded.mesh.cells, chosen)
    save_surface(output, surface, path.name, part.space)
    written = check_surface(output)
    rows = [
        ("cells", str(len(chosen))),
        ("triangles", str(len(surface.triangles))),
        ("closed surfaces", str(written.n_pieces)),
        ("volume, mm3", f"{written.volume:.6g}"),
        ("volume of the cells, mm3", f"{loaded.mesh.cell_volumes[chosen].sum():.6g}"),
        ("area, mm2", f"{written.area:.6g}"),
    ]
    if surface.n_parted:
        note(
            f"{surface.n_parted} nodes and edges where the structure touches itself were "
            "separated, by "
            f"{surface.largest_shift:.2g} mm at most, so that each edge has two triangles"
        )
    is_sound = written.is_watertight and written.is_winding_consistent and written.volume > 0.0
    if not is_sound:
        report_violation(f"{output}: not watertight according to trimesh; please report this")
    measured = {
        "volume_mm3": written.volume,
        "area_mm2": written.area,
        "n_pieces": written.n_pieces,
    }
    parted = {"n_parted": surface.n_parted, "largest_shift_mm": surface.largest_shift}
    lines = ["checked with trimesh: watertight, normals out"] if is_sound else []
    numbers = {"is_watertight": is_sound} | measured | parted
    return WrittenSurface(numbers, ("", output.name), rows, lines, is_sound)


def _write_interfaces(
    loaded: MeshFile, path: Path, output: Path, part: SurfacePart, names: Names
) -> WrittenSurface:
    """Write the mesh's facets between labels, with normals out of the smaller label, and read
    them back.
    """
    labels = cell_field(loaded, path, LABEL_FIELD).astype(np.int64)
    every = label_surfaces(facets(loaded.mesh.cells), labels)
    sides = every.label, every.beyond
    if part.interface is not None:
        one, other = _two_sides(part.interface, names)
        rows = np.flatnonzero(np.isin(sides[0], one) & np.isin(sides[1], other))
        if len(rows) == 0:
            words = " and ".join(
                " or ".join(label_words(k, names) for k in side) for side in (one, other)
            )
            raise InputError(f"{path}: no facet lies between labels {words}")
    else:
        is_outer = (sides[1] == OUTSIDE_LABEL) & part.boundary
        rows = np.flatnonzero((sides[0] != OUTSIDE_LABEL) & ((sides[0] < sides[1]) | is_outer))
        if len(rows) == 0:
            raise InputError(
                f"{path}: all cells have one label, so there are no interfaces; use `boundary`"
            )
    shown = LabelSurfaces(*(each[rows] for each in every))
    of_triangle = {"label_inside": shown.label, "label_outside": shown.beyond}
    used, triangles = np.unique(shown.nodes, return_inverse=True)
    surface = Surface(loaded.mesh.points[used], triangles.reshape(-1, 3), 0, 0.0)
    is_labelled = output.suffix.lower() in LABELLED_SUFFIXES
    save_surface(output, surface, path.name, part.space, of_triangle if is_labelled else None)
    return _of_interfaces(output, surface, shown, names, check_surface(output))


def _of_interfaces(
    output: Path,
    surface: Surface,
    shown: LabelSurfaces,
    names: Names,
    written: SurfaceCheck,
) -> WrittenSurface:
    """Return area and triangles of each pair of labels, and the numbers for the file of numbers."""
    areas = surface_areas(FacetSurface(surface.points, surface.triangles))
    # For all triangles together, whatever their labels: an edge of a rim has one, an edge of a seam
    # three or more.
    together = LabelSurfaces(np.zeros_like(shown.label), shown.beyond, shown.nodes)
    n_facets = surface_ridges(together).n_facets
    pairs, which, counts = np.unique(
        np.column_stack([shown.label, shown.beyond]),
        axis=0,
        return_inverse=True,
        return_counts=True,
    )
    of_pair = np.bincount(which.ravel(), areas)
    rows = []
    for k in np.argsort(-of_pair, kind="stable")[:MOST_LISTED]:
        inside, beyond = pairs[k].tolist()
        words = "outside" if beyond == OUTSIDE_LABEL else label_words(beyond, names)
        rows.append(
            (f"{label_words(inside, names)} to {words}", str(counts[k]), f"{of_pair[k]:.6g}")
        )
    if len(pairs) > 1:
        rows.append((f"all {len(pairs)}", str(len(areas)), f"{areas.sum():.6g}"))
    rim = int((n_facets == 1).sum())
    seam = int((n_facets > 2).sum())
    last = (
        f"{rim} edges in one triangle, {seam} in more than two; area in the file: "
        f"{written.area:.6g} mm2"
    )
    of_pairs = [
        {
            "label_inside": pairs[k, 0],
            "label_outside": pairs[k, 1],
            "n_triangles": counts[k],
            "area_mm2": of_pair[k],
        }
        for k in range(len(pairs))
    ]
    edges = {"n_rim_edges": rim, "n_seam_edges": seam}
    numbers = {"area_mm2": written.area, "n_triangles": len(areas), **edges, "interfaces": of_pairs}
    return WrittenSurface(numbers, (output.name, "triangles", "area, mm2"), rows, [last])


def _two_sides(text: str, names: Names) -> tuple[list[int], list[int]]:
    """Parse "J,K" into the labels on both sides of the interface."""
    sides = text.split(",")
    if len(sides) != 2:
        raise InputError(
            f'`interface`: expected two labels as J,K, by number or name, got "{text}"'
        )
    one = labels_named(sides[0], names)
    other = labels_named(sides[1], names)
    if set(one) & set(other):
        raise InputError(f'`interface`: expected two different labels, got "{text}"')
    return one, other


def _with_label(loaded: MeshFile, path: Path, chosen: list[int], names: Names) -> Ints:
    """Return the numbers of the cells with these labels."""
    labels = cell_field(loaded, path, LABEL_FIELD)
    cells = np.flatnonzero(np.isin(labels, chosen))
    if len(cells) == 0:
        known = ", ".join(
            label_words(each, names) for each in np.unique(labels)[:20].astype(np.int64).tolist()
        )
        words = " or ".join(label_words(each, names) for each in chosen)
        raise InputError(f"{path}: no cell has label {words}; the mesh has {known}")
    return cells


def _structure_cells(loaded: MeshFile, path: Path, part: SurfacePart) -> Ints:
    """Return the numbers of the structure's cells."""
    if part.cell_set is not None:
        if part.cell_set not in loaded.sets.cells:
            known = ", ".join(loaded.sets.cells) or "none"
            raise InputError(f'{path}: has no cell set "{part.cell_set}"; it has {known}')
        return loaded.sets.cells[part.cell_set]
    if part.below is None:
        return np.arange(len(loaded.mesh.cells))
    mean = cell_field(loaded, path, "mean")
    chosen = largest_component(loaded.mesh.cells, mean < part.below)
    if len(chosen) == 0:
        raise InputError(
            f"{path}: no cell has a mean below {part.below:g}; the smallest is {mean.min():g}"
        )
    of_faces = face_sets(loaded.mesh, boundary_rows(loaded.mesh), loaded.box)
    touched = [
        name for name in chain(*FACE_NAMES[3]) if np.isin(of_faces[name][:, 0], chosen).any()
    ]
    if touched and len(chosen) < len(mean):
        note(
            f"the largest connected component below {part.below:g} touches the box's faces "
            f"{', '.join(touched)} and "
            "may be the air around the body; use `label` or `cell_set` to select a structure"
        )
    if len(chosen) == len(mean):
        warning(f"every cell has a mean below {part.below:g}: the surface is the mesh's boundary")
    return chosen
