"""Reading of meshes by suffix, and their cleaning."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError, prefix_errors
from tetopt.geometry.check import LENGTH_UNITS
from tetopt.geometry.quadratic import numbered_edges
from tetopt.interop.conversions import (
    CELL_DIMENSIONS,
    cells_of_rows,
    kind_of_cells,
    rows_by_kind,
    simplices_of,
)
from tetopt.io.clean import (
    apart_words,
    with_labels,
    with_merged_nodes,
    without_copies,
    without_ghosts,
)
from tetopt.io.raw import Raw, by_corners
from tetopt.io.read_gmsh import read_msh
from tetopt.io.read_solver import read_feb, read_inp, read_medit, read_xdmf
from tetopt.io.read_vtk import read_vtk
from tetopt.io.text import plain
from tetopt.io.units import LONGEST_BOX, SHORTEST_BOX
from tetopt.io.vtk import box_in, sets_in
from tetopt.mesh import Mesh
from tetopt.model.fields import (
    KINDS_TEXT,
    field_kinds,
    half_turned_fields,
    is_stress,
    scaled_fields,
)
from tetopt.model.file import (
    MASK_TEXT,
    MOVED,
    MOVED_FROM_MASK,
    PLACE_TEXT,
    MeshFile,
    is_moved_from,
    text_in,
)
from tetopt.model.model import ON_PREFIX, STRESS_UNITS, half_turn
from tetopt.model.sets import SET_NAME, Sets, free_name, rows_of
from tetopt.system.arrays import Arrays, Ints
from tetopt.system.incoming import regular_file

# of an edge: a mid-edge node closer to its middle is rounded, as in files with few digits
STRAIGHT_FRACTION = 1e-6


def load_mesh(
    path: str | Path, *, label_field: str | None = None, mesh_units: str | None = None
) -> MeshFile:
    """Read triangles or tetrahedra, linear or quadratic, from a file of a known suffix.

    Cells that VTK marks as ghosts are left out, nodes that coincide within rounding are merged,
    cells that repeat the nodes of others are left out, and labels are taken from a cell field with
    a known name, such as "RegionId"; notes list this.

    Parameters
    ----------
    path : str or Path
        Its suffix is one of `tetopt.io.meshes.MESH_SUFFIXES`: .vtu, .vtk, .msh, .msh2, .inp
        (Abaqus, CalculiX), .feb (FEBio), .mesh (medit), .xdmf.
    label_field : str, optional
        Name of the cell field with the labels.
    mesh_units : {"m", "cm", "mm", "um"}, optional
        The file's unit of length, by default the one that it states, or mm.

    Returns
    -------
    MeshFile
        The mesh, its data by name, sets, and notes on reoriented and dropped items.

    Raises
    ------
    InputError
        The file is missing or unreadable; it has no cells, or other cell types; triangles lie
        outside the plane; cells are flat; the named field is not one of labels.

    See Also
    --------
    save_mesh : Write a mesh.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> tetopt.save_mesh("ball.vtu", mesh, tetopt.cell_fields(mesh, image))
    >>> file = tetopt.load_mesh("ball.vtu")
    >>> bool((file.mesh.points == mesh.points).all()), file.cell_data["mean"].shape
    (True, (1200,))
    """
    if mesh_units not in (None, *LENGTH_UNITS):
        raise InputError(f"`mesh_units`: expected {', '.join(LENGTH_UNITS)}, got {mesh_units!r}")
    path = regular_file(path, "mesh file")
    raw = _read(path)
    stress_name = text_in(raw.field_data, "units")
    stress = STRESS_UNITS.get(stress_name or "kPa")
    mm = (1.0 if stress is None else stress.mm) if mesh_units is None else LENGTH_UNITS[mesh_units]
    if mm != 1.0:
        raw = raw._replace(points=raw.points * mm)
    with prefix_errors(path):
        raw = without_ghosts(raw)
        kind = kind_of_cells(raw.cells)
        n = CELL_DIMENSIONS[kind]
        raw = without_copies(with_merged_nodes(raw, kind), kind)
        points = half_turn(raw.points) if n == 3 and raw.space == "lps" else raw.points
        picked = simplices_of(points, raw.cells[kind], raw.middles.get(kind))
        middles, is_curved, of_edges = _middles(raw, kind)
        mesh = Mesh(picked.points, picked.cells, points[middles, :n] if is_curved else None)
        used = picked.used
        sets, of_sets = (
            _sets_of_groups(raw, mesh, kind, used) if raw.groups else sets_in(raw.field_data, mesh)
        )
        shown = {f"{ON_PREFIX}{name}" for name in sets.facets}  # which repeat the sets
        at_nodes = {name: values for name, values in raw.point_data.items() if name not in shown}
        of_cells = {name: values[kind] for name, values in raw.cell_data.items() if kind in values}
        (cell_data, point_data), notes = _numbers(raw, n, mm, of_cells, at_nodes)
        cell_data, of_labels = with_labels(cell_data, len(mesh.cells), label_field)
    field_data, moved = _without_former_place(raw.field_data, mesh)
    return MeshFile(
        mesh,
        cell_data,
        field_data,
        picked.n_turned,
        sum(len(others) for name, others in raw.cells.items() if name != kind),
        sets,
        box_in(field_data, n),
        raw.space,
        (
            *raw.notes,
            *notes,
            *of_sets,
            *of_edges,
            *of_labels,
            *moved,
            *apart_words(mesh, is_ours=not {MASK_TEXT, "options"}.isdisjoint(field_data)),
            *(() if stress_name or mesh_units else _size_words(mesh)),
        ),
        2 if kind in raw.middles else 1,
        {name: values[np.concatenate([used, middles])] for name, values in point_data.items()},
    )


def _read(path: Path) -> Raw:
    """Read a file by its suffix."""
    suffix = path.suffix.lower()
    if suffix == ".pvtu":
        raise InputError(f"{path}: cannot read .pvtu; save the mesh as .vtu in ParaView")
    if suffix not in MESH_SUFFIXES:
        raise InputError(
            f"{path}: expected a {', '.join(MESH_SUFFIXES[:-1])} or {MESH_SUFFIXES[-1]} mesh; save "
            "it as .vtu (ParaView), or as .msh (gmsh)"
        )
    try:
        return MESH_READERS[suffix](path)
    except InputError as error:
        raise InputError(f"{path}: {plain(str(error))}") from error
    except (ValueError, LookupError, OverflowError) as error:  # of texts that are damaged
        words = f"damaged, or not a {suffix} mesh ({type(error).__name__})"
        raise InputError(f"{path}: {words}") from error


def _without_former_place(field_data: Arrays, mesh: Mesh) -> tuple[Arrays, tuple[str, ...]]:
    """Return a file's texts, without those of the run that built the mesh if nodes were moved
    since; and a note on this.
    """
    words = text_in(field_data, PLACE_TEXT) or ""
    if not words.startswith(MOVED) and not is_moved_from(words, mesh):
        return {name: each for name, each in field_data.items() if name != PLACE_TEXT}, ()
    had_mask = MASK_TEXT in field_data or words == MOVED_FROM_MASK
    lost = (MASK_TEXT, "options", "violated", "box")
    texts = {name: each for name, each in field_data.items() if name not in lost}
    texts[PLACE_TEXT] = np.array([MOVED_FROM_MASK if had_mask else MOVED])
    remedy = "; its mask no longer fits: pass `mask`" if had_mask else ""
    return texts, (f"its nodes were moved after meshing{remedy}",)


def _size_words(mesh: Mesh) -> tuple[str, ...]:
    """Return a remark on a mesh without a stated unit that is hardly a body's in mm."""
    longest = float(np.ptp(mesh.points, axis=0).max())
    words = f"the mesh is {longest:.3g} mm long; if its unit is not mm, pass `mesh_units`"
    return () if SHORTEST_BOX <= longest <= LONGEST_BOX else (words,)


def _middles(raw: Raw, kind: str) -> tuple[Ints, bool, tuple[str, ...]]:
    """Return the mid-edge nodes (E,) in the order of `quadratic`, none for order 1; whether any
    edge is curved; and notes on curved edges and on dropped mid-edge nodes.
    """
    if kind not in raw.middles:
        return np.empty(0, dtype=np.int64), False, ()
    edges, number = numbered_edges(raw.cells[kind])
    nodes = np.empty(len(edges), dtype=np.int64)
    notes = []
    nodes[number] = raw.middles[kind]
    if n_torn := len(np.unique(number[nodes[number] != raw.middles[kind]])):
        notes.append(
            f"{n_torn} edges have different mid-edge nodes in their cells: using one of them"
        )
    start, end = np.moveaxis(raw.points[edges], 1, 0)
    off = np.linalg.norm(raw.points[nodes] - 0.5 * (start + end), axis=1)
    straight = STRAIGHT_FRACTION * np.linalg.norm(end - start, axis=1)
    if (raw.points.astype(np.float32) == raw.points).all():  # single precision rounds midpoints
        straight += np.finfo(np.float32).eps * np.abs(raw.points).max()
    if n_curved := int((~(off <= straight)).sum()):
        notes.append(f"{n_curved} of {len(edges)} edges are curved by up to {off.max():.2g} mm")
    return nodes, n_curved > 0, tuple(notes)


def _numbers(
    raw: Raw, ndim: int, mm: float, cell_data: Arrays, point_data: Arrays
) -> tuple[list[Arrays], tuple[str, ...]]:
    """Return numeric cell data and point data in RAS+, kPa and mm, and notes on dropped data; `mm`
    is the length of the file's unit.
    """
    fields = []
    notes = []
    for what, values_of in (("cell", cell_data), ("point", point_data)):
        numbers = {
            name: values for name, values in values_of.items() if values.dtype.kind in "biuf"
        }
        if others := ", ".join(name for name in values_of if name not in numbers):
            notes.append(f"dropped {what} data that are not numbers: {others}")
        fields.append(numbers)
    name = text_in(raw.field_data, "units") or "kPa"
    if (units := STRESS_UNITS.get(name)) is not None:
        fields = [scaled_fields(each, units.kPa, mm, ndim) for each in fields]
    elif lost := [name for each in fields for name in each if is_stress(name)]:
        lost += ["nu", "material", "density"] if "young" in lost else []
        fields = [
            {name: values for name, values in each.items() if name not in lost} for each in fields
        ]
        words = f'unit is none of {", ".join(STRESS_UNITS)}: "{name}"'
        notes.append(f"dropped moduli and stresses, as their {words}")
    if raw.space == "lps" and ndim == 3:
        kinds = field_kinds(text_in(raw.field_data, KINDS_TEXT))
        fields = [half_turned_fields(each, kinds) for each in fields]
    return fields, tuple(notes)


def _sets_of_groups(raw: Raw, mesh: Mesh, kind: str, used: Ints) -> tuple[Sets, tuple[str, ...]]:
    """Return gmsh's groups of cells and of facets as sets, and notes on renamed ones."""
    place = np.full(len(raw.points), -1)
    place[used] = np.arange(len(used))
    sets = Sets({}, {})
    notes = []
    taken: set[str] = set()
    n = CELL_DIMENSIONS[kind]
    groups = [group for group in raw.groups if n - 1 <= CELL_DIMENSIONS[group.kind] <= n]
    if "young" in raw.cell_data:  # materials are rebuilt from it, with the names of these groups
        groups = [group for group in groups if re.fullmatch(r"material_\d+", group.label) is None]
    # Groups with valid names come first, so that they keep them.
    for group in sorted(groups, key=lambda group: SET_NAME.fullmatch(group.label) is None):
        name = free_name(group.label, taken)
        if group.kind == kind:
            sets.cells[name] = group.members
        else:
            rows = rows_of(mesh, place[raw.cells[group.kind][group.members]])
            if len(rows) == 0:
                notes.append(f'dropped group "{group.label}": it contains no facets of cells')
                continue
            sets.facets[name] = rows
        taken.add(name.lower())
        if name != group.label:
            notes.append(f'renamed group "{group.label}" to set {name}')
    return sets, tuple(notes)


def _read_vtk(path: Path) -> Raw:
    grid = read_vtk(path)
    rows_of_kind = rows_by_kind(np.diff(grid.offsets), grid.cell_types)
    cells = cells_of_rows(grid.connectivity, grid.offsets, rows_of_kind)
    cell_data = {
        name: {kind: values[chosen] for kind, chosen in rows_of_kind.items()}
        for name, values in grid.cell_data.items()
    }
    field_data = {name: _decode_text(values) for name, values in grid.field_data.items()}
    # e.g. vtkGhostType
    own = {name: values for name, values in grid.point_data.items() if not name.startswith("vtk")}
    raw = Raw(
        grid.points,
        cells,
        cell_data,
        own,
        field_data,
        [],
        _space(path, field_data),
        notes=grid.notes,
    )
    return by_corners(raw)


def _space(path: Path, field_data: Arrays) -> str:
    """Return "lps" if the file states this, as written by tetopt or 3D Slicer, else "ras"."""
    words = " ".join(text_in(field_data, name) or "" for name in ("space", "SPACE"))
    if path.suffix.lower() == ".vtk":
        with path.open("rb") as file:
            file.readline()
            words += file.readline(256).partition(b"SPACE=")[2][:3].decode("latin-1")
    return "lps" if "lps" in words.lower() else "ras"


def _decode_text(values: NDArray) -> NDArray:
    """Decode UTF-8 bytes, as tetopt writes texts, to an array of one string; return other values
    unchanged.
    """
    if values.dtype != np.uint8:
        return values
    try:
        return np.array([values.tobytes().decode()])
    except UnicodeDecodeError:
        return values


MESH_READERS: dict[str, Callable[[Path], Raw]] = {
    ".vtu": _read_vtk,
    ".vtk": _read_vtk,
    ".msh": read_msh,
    ".msh2": read_msh,
    ".inp": read_inp,
    ".feb": read_feb,
    ".mesh": read_medit,
    ".xdmf": read_xdmf,
}
MESH_SUFFIXES = tuple(MESH_READERS)
