"""Conversion of meshes to and from other libraries, on plain arrays, so that `tetopt.mesh` and file
readers share it.

The libraries are imported only where they are needed: a mesh by itself needs none of them.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import os
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError, prefix_errors
from tetopt.geometry.simplex import orient_cells
from tetopt.interop.notebook import in_kernel
from tetopt.system.arrays import Arrays, Floats, Ints, Json, plain_array
from tetopt.system.extras import install_hint

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkFieldData, vtkUnstructuredGrid

# The dimension of each cell type that a mesh may contain, or that may lie on it.
CELL_DIMENSIONS = {
    "vertex": 0,
    "poly_vertex": 0,
    "line": 1,
    "poly_line": 1,
    "triangle": 2,
    "tetra": 3,
}
# The linear type of each quadratic cell type, by the names of pyvista and meshio. All number nodes
# as VTK does.
CORNER_KINDS = {
    "quadratic_edge": "line",
    "quadratic_triangle": "triangle",
    "quadratic_tetra": "tetra",
    "line3": "line",
    "triangle6": "triangle",
    "tetra10": "tetra",
}
# VTK's arbitrary-order types with their number of nodes, as dolfinx writes them, and the equivalent
# fixed-order types.
LAGRANGE_KINDS = {
    "lagrange_curve 2": "line",
    "lagrange_triangle 3": "triangle",
    "lagrange_tetrahedron 4": "tetra",
    "lagrange_curve 3": "quadratic_edge",
    "lagrange_triangle 6": "quadratic_triangle",
    "lagrange_tetrahedron 10": "quadratic_tetra",
}
# Nodes per cell of the types with a fixed number; pyvista's other types are missing here and are
# rejected by name.
NODES_OF_KIND = {
    "vertex": 1,
    "line": 2,
    "triangle": 3,
    "tetra": 4,
    "quadratic_edge": 3,
    "quadratic_triangle": 6,
    "quadratic_tetra": 10,
}
# VTK's cell types, by dimension and order
VTK_KINDS = {(2, 1): 5, (3, 1): 10, (2, 2): 22, (3, 2): 24}
# and meshio's
MESHIO_KINDS = {(2, 1): "triangle", (3, 1): "tetra", (2, 2): "triangle6", (3, 2): "tetra10"}
PACKAGES = {"skfem": "scikit-fem"}  # libraries whose package name differs from their import name

Fields = Mapping[str, ArrayLike]  # by name, one row per cell or per node


class Simplices(NamedTuple):
    """The cells of the highest dimension in a mesh, and their corners."""

    points: Floats  # (N, n), the points that the cells use, in their original order
    cells: Ints  # (M, n+1), reoriented where they were inverted
    used: Ints  # (N,) indices of these points among all points
    n_turned: int


def library(name: str, caller: str) -> Any:
    """Import a library by its import name; InputError if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = PACKAGES.get(name, name)
        raise InputError(
            f"{caller}: {package} is not installed; {install_hint(package)}"
        ) from error


# --- from others


def corner_kinds(kinds: Collection[str]) -> dict[str, str]:
    """Map quadratic cell types to the linear type of their corners, unless that type occurs too."""
    renamed = {kind: CORNER_KINDS[kind] for kind in kinds if kind in CORNER_KINDS}
    return {kind: corner for kind, corner in renamed.items() if corner not in kinds}


def kind_of_cells(kinds: Collection[str]) -> str:
    """Return "tetra" or "triangle", the type of highest dimension; quadratic types are renamed by
    `corner_kinds`.

    Raises
    ------
    InputError
        Neither type occurs, another type occurs, or the cells have both orders.
    """
    unknown = sorted(set(kinds) - set(CELL_DIMENSIONS))
    if both := sorted(CORNER_KINDS[name] for name in unknown if name in CORNER_KINDS):
        raise InputError(
            f"expected cells of one order, found {both[0]} cells of both order 1 and order 2"
        )
    if unknown:
        raise InputError(
            f"expected tetrahedra or triangles, of order 1 or 2, found {', '.join(unknown)}"
        )
    kind = max(kinds, key=lambda name: CELL_DIMENSIONS[name], default="none")
    if kind not in ("tetra", "triangle"):
        raise InputError(
            f"expected tetrahedra or triangles, found {', '.join(sorted(kinds)) or 'no cells'}"
        )
    return kind


def simplices_of(points: Floats, cells: Ints, middles: Ints | None) -> Simplices:
    """Convert cells over points in space to the arrays of a mesh.

    Parameters
    ----------
    points : (P, 3) float64
        May include points that no cell uses.
    cells : (M, 4) or (M, 3) int64
        Corners of tetrahedra, or of triangles in the plane z = 0.
    middles : (M, 6 or 3) int64, optional
        The mid-edge nodes of cells of order 2.

    Raises
    ------
    InputError
        Cells refer to missing nodes, or triangles lie outside the plane.
    """
    n = cells.shape[1] - 1
    nodes = cells if middles is None else np.column_stack([cells, middles])
    if nodes.min() < 0 or nodes.max() >= len(points):
        raise InputError(
            f"its cells use nodes {nodes.min()}..{nodes.max()}, but it has 0..{len(points) - 1}; "
            "damaged?"
        )
    if n == 2 and np.any(points[nodes, 2] != 0.0):
        raise InputError(
            "a triangle mesh must lie in the plane z = 0; surfaces in space are not supported"
        )
    used, compact = np.unique(cells, return_inverse=True)
    corners = points[used, :n]
    compact = compact.reshape(cells.shape)
    with np.errstate(invalid="ignore"):  # infinite coordinates, which Mesh rejects with a message
        turned = orient_cells(corners, compact)
    return Simplices(corners, turned, used, int((turned != compact).any(axis=1).sum()))


def rows_by_kind(sizes: Ints, cell_types: NDArray[np.uint8]) -> dict[str, Ints]:
    """Group cells, given their numbers of nodes and VTK types, by pyvista's names of the types.

    Cells of arbitrary order are grouped with the fixed-size type that they are equivalent to.
    """
    import pyvista

    stride = int(sizes.max()) + 1
    sorts, which = np.unique(cell_types.astype(np.int64) * stride + sizes, return_inverse=True)
    parts: dict[str, list[Ints]] = {}
    for number, sort in enumerate(sorts.tolist()):
        vtk_type, size = divmod(sort, stride)
        try:
            name = pyvista.CellType(vtk_type).name.lower()
        except ValueError:
            raise InputError(f"damaged: VTK has no cells of type {vtk_type}") from None
        kind = LAGRANGE_KINDS.get(f"{name} {size}", name)
        parts.setdefault(kind, []).append(np.flatnonzero(which.ravel() == number))
    return {kind: np.sort(np.concatenate(rows)) for kind, rows in parts.items()}


def cells_of_rows(
    connectivity: Ints,
    offsets: Ints,
    rows_of_kind: Mapping[str, Ints],
) -> dict[str, Ints]:
    """Return the nodes of VTK's cells, (M, w) for each type; polylines of varying length keep
    their first nodes.
    """
    sizes = np.diff(offsets)
    cells = {}
    for kind, chosen in rows_of_kind.items():
        width = int(sizes[chosen].min())
        if kind in NODES_OF_KIND and (sizes[chosen] != NODES_OF_KIND[kind]).any():
            raise InputError(
                f"damaged: {kind} cells have {NODES_OF_KIND[kind]} nodes each, but some have a "
                "different number"
            )
        cells[kind] = connectivity[offsets[chosen][:, None] + np.arange(width)]
    return cells


def _pick_cells(caller: str, points: ArrayLike, cells: Mapping[str, Ints]) -> Simplices:
    """Select the tetrahedra, or else the triangles, from cells by type; cells of order 2 by
    their corners.
    """
    try:
        places = np.asarray(points)
        places = np.asarray(places, dtype=None if places.dtype.kind == "c" else np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{caller}: expected points of real numbers ({error})") from error
    if places.dtype.kind == "c" or places.ndim != 2 or places.shape[1] not in (2, 3):
        words = f"got {places.dtype} of shape {places.shape}"
        raise InputError(f"{caller}: expected points with two or three real coordinates, {words}")
    in_space = np.zeros((len(places), 3))
    in_space[:, : places.shape[1]] = places
    renamed = corner_kinds(cells)
    with prefix_errors(caller):
        kind = kind_of_cells([renamed.get(name, name) for name in cells])
        name = next(name for name in cells if renamed.get(name, name) == kind)
        n_corners = CELL_DIMENSIONS[kind] + 1
        # one mid-edge node per edge
        width = n_corners if name == kind else n_corners * (n_corners + 1) // 2
        nodes = np.asarray(cells[name])
        if (
            nodes.dtype.kind not in "iu"
            or nodes.ndim != 2
            or nodes.shape[1] != width
            or len(nodes) == 0
        ):
            raise InputError(
                f"expected {name} cells of {width} integers each, got {nodes.dtype} of shape "
                f"{nodes.shape}"
            )
        nodes = nodes.astype(np.int64)
        return simplices_of(in_space, nodes[:, :n_corners], nodes[:, n_corners:])


def from_pyvista(grid: Any) -> Simplices:
    """Return the simplices of a pyvista or VTK grid; see `tetopt.mesh.Mesh.from_pyvista`."""
    pyvista = library("pyvista", "from_pyvista")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkDataSet

    if not isinstance(grid, vtkDataSet):
        raise InputError(f"from_pyvista: expected a pyvista or VTK grid, got {type(grid).__name__}")
    shown = pyvista.wrap(grid)
    whole = (
        shown if isinstance(shown, pyvista.UnstructuredGrid) else shown.cast_to_unstructured_grid()
    )
    if whole.n_cells == 0:
        raise InputError("from_pyvista: expected tetrahedra or triangles, found no cells")
    listed = whole.GetCells()
    offsets = vtk_to_numpy(listed.GetOffsetsArray()).astype(np.int64)
    rows = rows_by_kind(np.diff(offsets), np.asarray(whole.celltypes))
    cells = cells_of_rows(
        vtk_to_numpy(listed.GetConnectivityArray()).astype(np.int64), offsets, rows
    )
    return _pick_cells("from_pyvista", whole.points, cells)


def from_meshio(mesh: Any) -> Simplices:
    """Return the simplices of a `meshio.Mesh`; see `tetopt.mesh.Mesh.from_meshio`."""
    meshio = library("meshio", "from_meshio")
    if not isinstance(mesh, meshio.Mesh):
        raise InputError(
            f"from_meshio: expected a meshio.Mesh, got {type(mesh).__name__}; meshio.read(path) "
            "reads one"
        )
    cells: dict[str, Ints] = {}
    for block in mesh.cells:
        if len(block.data):
            earlier = [cells[block.type]] if block.type in cells else []
            cells[block.type] = np.concatenate([*earlier, block.data])
    return _pick_cells("from_meshio", mesh.points, cells)


def from_skfem(mesh: Any) -> Simplices:
    """Return the simplices of a scikit-fem mesh; see `tetopt.mesh.Mesh.from_skfem`."""
    skfem = library("skfem", "from_skfem")
    if (
        not isinstance(mesh, skfem.Mesh)
        or len(mesh.t) != mesh.dim() + 1
        or mesh.dim() not in (2, 3)
    ):
        kind = type(mesh).__name__
        raise InputError(f"from_skfem: expected a scikit-fem MeshTri or MeshTet, got {kind}")
    return _pick_cells(
        "from_skfem", mesh.p.T, {"tetra" if mesh.dim() == 3 else "triangle": mesh.t.T}
    )


# --- to others


def check_fields(what: str, fields: Fields | None, n_rows: int | None = None) -> Arrays:
    """Return arrays of numbers by name; InputError unless each has `n_rows` rows, by default any
    number.
    """
    if not isinstance(fields, Mapping | None):
        raise InputError(f"{what}: expected a dict of arrays by name, got {type(fields).__name__}")
    arrays: Arrays = {}
    for name, rows in (fields or {}).items():
        line = f"{what}: {name!a}: expected an array of numbers"
        line += "" if n_rows is None else f" with {n_rows} rows"
        try:
            values = plain_array(f"{what}: {name!a}", rows)
        except InputError:
            raise
        except (TypeError, ValueError) as error:  # rows of different lengths
            raise InputError(f"{line}, got {type(rows).__name__} ({error})") from error
        is_long = values.ndim > 0 and n_rows in (None, len(values))
        if values.dtype.kind not in "biuf" or not is_long or values.size == 0:
            raise InputError(f"{line}, got {values.dtype} of shape {values.shape}")
        if not isinstance(name, str):
            raise InputError(f"{what}: expected strings as names, got {name!a}")
        arrays[name] = values
    return arrays


def vtk_grid(
    points: Floats,
    cells: Ints,
    kind: int,
    cell_data: Mapping[str, NDArray],
    point_data: Mapping[str, NDArray],
) -> vtkUnstructuredGrid:
    """Build a VTK grid from cells of one VTK type, with data; points in the plane get z = 0."""
    # VTK without pyvista, imported only here: even the shortest run writes files.
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid

    places = np.zeros((len(points), 3))
    places[:, : points.shape[1]] = points
    nodes = vtkPoints()
    nodes.SetData(numpy_to_vtk(places, deep=True))
    listed = vtkCellArray()
    listed.SetData(
        cells.shape[1],
        numpy_to_vtkIdTypeArray(np.ascontiguousarray(cells, dtype=np.int64).ravel(), deep=True),
    )
    grid = vtkUnstructuredGrid()
    grid.SetPoints(nodes)
    grid.SetCells(kind, listed)
    for fields, arrays in ((grid.GetCellData(), cell_data), (grid.GetPointData(), point_data)):
        for name, values in arrays.items():
            add_array(fields, name, values)
    return grid


def add_array(fields: vtkFieldData, name: str, values: NDArray) -> None:
    """Add an array of numbers; programs show the first one on cells or on points by default."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkDataSetAttributes

    values = np.asarray(values)
    # VTK assumes the machine's byte order, whatever the dtype says, and floats of four or eight
    # bytes.
    is_odd = values.dtype.kind == "f" and values.dtype.itemsize not in (4, 8)
    values = values.astype(np.float64 if is_odd else values.dtype.newbyteorder("="), copy=False)
    values = values.reshape(len(values), math.prod(values.shape[1:])) if values.ndim > 1 else values
    array = numpy_to_vtk(
        np.ascontiguousarray(values.view(np.uint8) if values.dtype == bool else values), deep=True
    )
    array.SetName(name)
    fields.AddArray(array)
    if isinstance(fields, vtkDataSetAttributes) and fields.GetScalars() is None:
        fields.SetActiveScalars(name)


def to_pyvista(
    points: Floats,
    cells: Ints,
    kind: int,
    cell_data: Fields | None,
    point_data: Fields | None,
) -> Any:
    """Convert cells of one VTK type and their data to a `pyvista.UnstructuredGrid`."""
    pyvista = library("pyvista", "to_pyvista")
    on_cells = check_fields("cell_data", cell_data, len(cells))
    on_points = check_fields("point_data", point_data, len(points))
    return pyvista.wrap(vtk_grid(points, cells, kind, on_cells, on_points))


def to_meshio(
    points: Floats,
    cells: Ints,
    kind: str,
    cell_data: Fields | None,
    point_data: Fields | None,
) -> Any:
    """Convert cells of one meshio type and their data to a `meshio.Mesh`; arrays are copied."""
    meshio = library("meshio", "to_meshio")
    on_cells = check_fields("cell_data", cell_data, len(cells))
    on_points = check_fields("point_data", point_data, len(points))
    return meshio.Mesh(
        points.copy(),
        [(kind, cells.copy())],
        point_data={name: values.copy() for name, values in on_points.items()},
        cell_data={name: [values.copy()] for name, values in on_cells.items()},
    )


def to_skfem(points: Floats, cells: Ints) -> Any:
    """Convert a mesh to a `skfem.MeshTri` or `skfem.MeshTet`."""
    skfem = library("skfem", "to_skfem")
    kind = skfem.MeshTet if points.shape[1] == 3 else skfem.MeshTri
    # Contiguous arrays: otherwise scikit-fem copies them and warns about it.
    return kind(np.ascontiguousarray(points.T), np.ascontiguousarray(cells.T))


def to_trimesh(points: Floats, triangles: Ints) -> Any:
    """Convert triangles in space, and the points that they use, to a `trimesh.Trimesh`."""
    trimesh = library("trimesh", "to_trimesh")
    used, faces = np.unique(triangles, return_inverse=True)
    return trimesh.Trimesh(points[used], faces.reshape(triangles.shape), process=False)


def show_grid(
    grid: Any,
    name: str | None,
    screenshot: str | Path | None,
    off_screen: bool | None,
    look: Json,
) -> Any:
    """Show a pyvista grid, coloured by the named field; see `tetopt.mesh.Mesh.plot`."""
    pyvista = library("pyvista", "plot")
    if off_screen is None:
        has_none = sys.platform == "linux" and not (
            os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        )
        off_screen = pyvista.OFF_SCREEN or (has_none and not in_kernel())
    plotter = pyvista.Plotter(off_screen=off_screen or screenshot is not None)
    colour = {"scalars": name} if name is not None else {"color": "lightblue"}
    plotter.add_mesh(grid, **({"show_edges": True} | colour | look))
    if grid.bounds[4] == grid.bounds[5]:  # a 2-D mesh
        plotter.view_xy()
    if off_screen or screenshot is not None:
        try:
            return plotter.screenshot(
                None if screenshot is None else str(screenshot), return_img=True
            )
        except (OSError, ValueError) as error:  # no such folder, or an unknown picture format
            words = " ".join(str(error).split())
            raise InputError(f"plot: {screenshot}: cannot write the picture ({words})") from error
        finally:
            plotter.close()
    has_trame = importlib.util.find_spec("trame") is not None
    plotter.show(jupyter_backend="static" if in_kernel() and not has_trame else None)
    return None
