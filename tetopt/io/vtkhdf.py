"""Meshes and models as VTKHDF files, which ParaView (from 5.12 on) and pyvista read: compressed HDF5 files.

Version 2.0 of the format, type UnstructuredGrid (docs.vtk.org, "VTKHDF file format"): the group VTKHDF has the sizes of
pieces (NumberOfPoints, NumberOfCells, NumberOfConnectivityIds) and their concatenated arrays (Points, Connectivity,
Offsets, Types), and the groups PointData, CellData and FieldData, with the contents that `tetopt.io.vtk` describes for
.vtu. HDF5 does not allow slashes in names: they are replaced by "_". Files are written as one piece, because VTK 9.7
does not read field data of several; files of other programs may have several.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.interop.conversions import VTK_KINDS
from tetopt.io.apart import DEFLATE_RATIO, read_apart
from tetopt.io.raw import RawGrid
from tetopt.io.read_vtk import checked_grid, plain_arrays
from tetopt.io.text import plain, short_name
from tetopt.io.vtk import model_grid
from tetopt.model.model import Model
from tetopt.system.extras import install_hint

if TYPE_CHECKING:
    import h5py

FORMAT_VERSION = (2, 0)  # for writing: the first with the present layout of pieces; versions 1 and 2 can be read
CHUNK_BYTES = 2**19  # half of HDF5's cache for a data set's chunks
LEAST_PACKED = 2**12  # smallest array that is compressed, bytes: the index of its chunks takes half of that
BLOCK_BYTES = 2**24  # growth of the file in memory
# HDF5's built-in filters, which need no other library, by number: deflate, shuffle, Fletcher's checksum.
DEFLATE_FILTER, PLAIN_FILTERS = 1, (1, 2, 3)
MOST_PIECES = 2**16  # in a file: more than the cores of any cluster job
GHOST_FIELD, DUPLICATE_BIT = "vtkGhostType", 1  # VTK's mark of cells that belong to another piece
COUNT_NAMES = ("NumberOfPoints", "NumberOfCells", "NumberOfConnectivityIds")
ARRAYS = {"Points": "points", "Types": "cell_types", "Connectivity": "connectivity", "Offsets": "offsets"}
ARRAY_KINDS = {"Points": np.float64, "Types": np.uint8, "Connectivity": np.int64, "Offsets": np.int64}
DATA_GROUPS = {"PointData": "point_data", "CellData": "cell_data", "FieldData": "field_data"}


def check_h5py() -> None:
    """Raise InputError if h5py is not installed."""
    try:
        import h5py  # noqa: F401
    except ImportError:
        raise InputError(f".vtkhdf files need h5py: {install_hint('blocks', 'h5py')}, or use .vtu") from None


def hdf_name(name: str) -> str:
    """Return a `short_name` that HDF5 supports.

    Examples
    --------
    >>> hdf_name("kPa/mm"), hdf_name(".")
    ('kPa_mm', '_')
    """
    name = short_name(name).replace("/", "_")
    return "_" if name == "." else name


def vtkhdf(model: Model) -> bytes:
    """Return a VTKHDF file, exact and compressed; the same model always gives the same bytes.

    Raises
    ------
    InputError
        h5py is not installed.
    """
    check_h5py()
    import h5py

    types = np.full(len(model.mesh.cells), VTK_KINDS[model.mesh.ndim, model.order], dtype=np.uint8)
    grid = RawGrid(**plain_arrays(model_grid(model)), cell_types=types)
    options: Any = {"backing_store": False, "block_size": BLOCK_BYTES, "libver": ("earliest", "v110")}
    with h5py.File("in memory", "w", driver="core", **options) as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array(FORMAT_VERSION, dtype=np.int64)
        root.attrs["Type"] = np.bytes_("UnstructuredGrid")
        sizes = (len(grid.points), len(grid.cell_types), len(grid.connectivity))
        for name, size in zip(COUNT_NAMES, sizes, strict=True):
            _write(root, name, np.array([size], dtype=np.int64))
        for name, field in ARRAYS.items():
            _write(root, name, getattr(grid, field))
        for group, field in DATA_GROUPS.items():
            into = root.create_group(group, track_order=True)
            for name, values in getattr(grid, field).items():
                _write(into, name, values)
        file.flush()
        return bytes(file.id.get_file_image())


def _write(group: h5py.Group, name: str, values: NDArray) -> None:
    options: dict[str, Any] = {}
    if values.nbytes >= LEAST_PACKED:
        rows = max(1, CHUNK_BYTES // (values.nbytes // len(values)))
        options = {"chunks": (min(rows, len(values)), *values.shape[1:]), "compression": "gzip", "compression_opts": 1}
        options["shuffle"] = values.dtype.itemsize > 1
    group.create_dataset(name, data=values, track_times=False, **options)


def read_vtkhdf(path: Path) -> RawGrid:
    """Read the mesh in a VTKHDF file.

    Pieces are joined at points in the same place: the k-th point of one piece there is the k-th of the others. Cells
    that belong to another piece (VTK's ghosts) are dropped.

    Raises
    ------
    InputError
        Without a leading path: the file is damaged, or HDF5 crashes on it; it has another data set, or time steps; it
        has links, data in other files, or filters that are not built into HDF5; h5py is not installed.
    """
    check_h5py()
    if path.stat().st_size == 0:
        raise InputError("damaged: the file is empty")
    return checked_grid("UnstructuredGrid", "", read_apart(hdf_arrays, path, library="HDF5"))


# In the child


def hdf_arrays(path: str) -> dict[str, Any]:
    """Return the arrays of a `RawGrid`, by name."""
    import h5py

    try:
        with h5py.File(os.fsencode(path), "r", locking=False) as file:
            return _arrays_in(_Guarded(file, os.path.getsize(path)))
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError, TypeError, KeyError) as error:  # HDF5's errors of all kinds
        raise InputError(f"damaged, or not an HDF5 file ({plain(' '.join(str(error).split()))[:300]})") from error


class _Guarded:
    """An untrusted HDF5 file: only data within the file are read, and decompressed up to a limit."""

    def __init__(self, file: h5py.File, size: int) -> None:
        self.root = file
        self.size = size

    def member(self, group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
        """Return a named member of a group, None if it is missing; links are not followed."""
        import h5py
        from h5py import h5d, h5l

        encoded = name.encode("utf-8", "surrogateescape")
        if not group.id.links.exists(encoded):
            return None
        if group.id.links.get_info(encoded).type != h5l.TYPE_HARD:
            raise InputError(f'expected data for "{plain(name)}", got a link; save the file again without links')
        each = group[name]
        if isinstance(each, h5py.Dataset):
            plan = each.id.get_create_plist()
            if plan.get_layout() == h5d.VIRTUAL or plan.get_external_count():
                raise InputError(f'"{plain(name)}" is stored in another file; save all data in one file')
        return each

    def group(self, parent: h5py.Group, name: str) -> h5py.Group | None:
        import h5py

        each = self.member(parent, name)
        if each is not None and not isinstance(each, h5py.Group):
            raise InputError(f'damaged: "{name}" is not a group')
        return each

    def array(self, group: h5py.Group, name: str) -> NDArray:
        """Return the numbers or texts of a data set with one or two axes.

        Raises
        ------
        InputError
            It is not a data set, has other values, or is larger than its stored bytes allow.
        """
        import h5py

        each, shown = self.member(group, name), plain(name)
        if not isinstance(each, h5py.Dataset) or each.shape is None or each.ndim not in (1, 2):
            raise InputError(f'damaged: "{shown}" is not an array with one or two axes')
        plan = each.id.get_create_plist()
        filters = [plan.get_filter(k)[0] for k in range(plan.get_nfilters())]
        if not set(filters) <= set(PLAIN_FILTERS) or filters.count(DEFLATE_FILTER) > 1:
            raise InputError(f'"{shown}" has an unsupported compression; save the file with gzip or uncompressed')
        # Python's integers: sizes in a damaged file overflow any others.
        n_bytes = int(np.prod([int(size) for size in each.shape], dtype=object)) * each.dtype.itemsize
        stored = int(each.id.get_storage_size())
        if stored > self.size or n_bytes > stored * (DEFLATE_RATIO if DEFLATE_FILTER in filters else 1):
            raise InputError(
                f'damaged: "{shown}" declares {n_bytes} bytes, of which {stored} are in a file of {self.size}'
            )
        if h5py.check_string_dtype(each.dtype) is not None:
            return np.array(each.asstr(errors="backslashreplace")[()], dtype=np.str_)
        if each.dtype.kind not in "iufb":
            raise InputError(f'"{shown}" has neither numbers nor strings ({each.dtype}); remove it from the file')
        return np.asarray(each[()], dtype=each.dtype.newbyteorder("="))

    def counts(self, root: h5py.Group, name: str) -> list[int]:
        """Return one of the sizes of pieces."""
        values = self.array(root, name)
        if values.ndim != 1 or values.dtype.kind not in "iu" or not 0 < len(values) <= MOST_PIECES or min(values) < 0:
            raise InputError(f"damaged: expected one number in {name} for each of up to {MOST_PIECES} pieces")
        return [int(value) for value in values]


def _arrays_in(file: _Guarded) -> dict[str, Any]:
    root = file.group(file.root, "VTKHDF")
    if root is None:
        raise InputError("expected a VTKHDF file, found an HDF5 file without the group VTKHDF")
    kind, version = root.attrs.get("Type", b"nothing"), np.ravel(root.attrs.get("Version", 0))
    kind = kind.decode("utf-8", "replace") if isinstance(kind, bytes) else str(kind)
    if kind != "UnstructuredGrid":
        raise InputError(f"expected an unstructured grid, found {plain(kind)[:40]}; damaged?")
    if version.dtype.kind not in "iu" or int(version[0]) not in (1, FORMAT_VERSION[0]):
        raise InputError("expected VTKHDF version 1 or 2, found another version; save it as .vtu")
    if file.member(root, "Steps") is not None:
        raise InputError("expected one mesh, found time steps; save one of them")
    n_points, n_cells, n_nodes = (file.counts(root, name) for name in COUNT_NAMES)
    if not len(n_points) == len(n_cells) == len(n_nodes):
        raise InputError("damaged: the numbers of pieces of points and of cells differ")
    counts = dict(zip(ARRAYS, (n_points, n_cells, n_nodes, [n + 1 for n in n_cells]), strict=True))
    arrays = {name: file.array(root, name) for name in ARRAYS}
    if arrays["Points"].ndim != 2 or arrays["Points"].shape[1] != 3 or arrays["Points"].dtype.kind != "f":
        raise InputError("damaged: its points do not have three coordinates each")
    if any(arrays[name].ndim != 1 or arrays[name].dtype.kind not in "iu" for name in ARRAYS if name != "Points"):
        raise InputError("damaged: its cells are not lists of integers")
    arrays = {name: _fitting(arrays[name], counts[name], name).astype(kind) for name, kind in ARRAY_KINDS.items()}
    data: dict[str, dict[str, NDArray]] = {}
    for name, field in DATA_GROUPS.items():
        group = file.group(root, name)
        data[field] = {} if group is None else {str(each): file.array(group, each) for each in group}
    for field, sizes in (("point_data", n_points), ("cell_data", n_cells)):
        data[field] = {name: _fitting(values, sizes, name) for name, values in data[field].items()}
    return _joined(arrays, counts, data)


def _fitting(values: NDArray, counts: list[int], name: str) -> NDArray:
    """Return the array; InputError unless it has as many rows as all pieces together."""
    if sum(counts) != len(values):
        raise InputError(f'damaged: "{plain(name)}" has {len(values)} rows, its pieces {sum(counts)}')
    return values


def _joined(
    arrays: dict[str, NDArray], counts: dict[str, list[int]], data: dict[str, dict[str, NDArray]]
) -> dict[str, Any]:
    """Renumber the points and cells of all pieces consecutively, see `read_vtkhdf`."""
    points, types, nodes, offsets = (arrays[name] for name in ARRAYS)
    n_points, _, n_nodes, n_offsets = (np.array(counts[name], dtype=np.int64) for name in ARRAYS)
    ends = np.cumsum(n_offsets)
    if (offsets[ends - n_offsets] != 0).any() or (offsets[ends - 1] != n_nodes).any():
        raise InputError("damaged: its cells or data are inconsistent")
    sizes = np.delete(np.diff(offsets), ends[:-1] - 1)
    if len(n_points) > 1:
        if ((nodes < 0) | (nodes >= np.repeat(n_points, n_nodes))).any():
            raise InputError("damaged: cells use nodes that their piece does not have")
        first, number = _same_by_place(points, np.repeat(np.arange(len(n_points)), n_points))
        nodes = number[nodes + np.repeat(np.cumsum(n_points) - n_points, n_nodes)]
        points = points[first]
        data["point_data"] = {name: values[first] for name, values in data["point_data"].items()}
    ghost = data["cell_data"].pop(GHOST_FIELD, np.zeros(len(types), dtype=np.uint8))
    if ghost.ndim == 1 and ghost.dtype.kind in "iu" and (sizes >= 0).all():
        is_own = (ghost & DUPLICATE_BIT) == 0
        nodes, types, sizes = nodes[np.repeat(is_own, sizes)], types[is_own], sizes[is_own]
        data["cell_data"] = {name: values[is_own] for name, values in data["cell_data"].items()}
    starts = np.concatenate([[0], np.cumsum(sizes)])
    return {"points": points, "cell_types": types, "connectivity": nodes, "offsets": starts} | data


def _same_by_place(points: NDArray[np.float64], piece: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray]:
    """Return the first occurrence of each distinct point, and the number of the distinct point of each original one."""
    _, place = np.unique(points, axis=0, return_inverse=True)
    run = place.ravel() * (piece[-1] + 1) + piece
    order = np.argsort(run, kind="stable")
    rank = np.empty(len(points), dtype=np.int64)  # among points of its piece in this place
    rank[order] = np.arange(len(points)) - np.searchsorted(run[order], run[order])
    key = np.column_stack([place.ravel(), rank]) @ np.array([len(points), 1])
    return np.unique(key, return_index=True, return_inverse=True)[1:]
