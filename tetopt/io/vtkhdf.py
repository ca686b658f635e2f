"""Meshes and models as VTKHDF files, which ParaView (from 5.12 on) and pyvista read: an HDF5 file, packed, in pieces.

Version 2.0 of the format, type UnstructuredGrid (docs.vtk.org, "VTKHDF file format"): group VTKHDF with the pieces'
sizes (NumberOfPoints, NumberOfCells, NumberOfConnectivityIds) and their arrays one after another (Points, Connectivity,
Offsets, Types), and the groups PointData, CellData and FieldData, in which is what `tetopt.io.vtk` says of .vtu, in
pieces as `tetopt.io.pieces` cuts them. HDF5 has no slash in a name: data have "_" for it.
VTK 9.7 reads field data from files of one piece alone; of several it shows sets by their point data `on_NAME`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.extras import install_hint
from tetopt.io.apart import DEFLATE_RATIO, read_apart
from tetopt.io.pieces import MOST_PIECES, joined, model_pieces
from tetopt.io.raw import RawGrid
from tetopt.io.read_vtk import checked_grid
from tetopt.io.text import plain, short_name
from tetopt.model.model import Model

if TYPE_CHECKING:
    import h5py

FORMAT_VERSION = (2, 0)  # of what is written: the first with pieces as they are read since; 1 and 2 are read
CHUNK_BYTES = 2**19  # half of the cache that HDF5 has for a data set's chunks
LEAST_PACKED = 2**12  # bytes of an array that is packed: the index of its chunks takes half of that
BLOCK_BYTES = 2**24  # that the file grows by in memory
# HDF5's own filters that a reader needs no further library for, by number: deflate, shuffle, Fletcher's checksum.
DEFLATE_FILTER, PLAIN_FILTERS = 1, (1, 2, 3)
COUNT_NAMES = ("NumberOfPoints", "NumberOfCells", "NumberOfConnectivityIds")
DATA_GROUPS = {"PointData": "point_data", "CellData": "cell_data", "FieldData": "field_data"}


def check_h5py() -> None:
    """InputError if h5py is not installed."""
    try:
        import h5py  # noqa: F401
    except ImportError:
        raise InputError(f".vtkhdf files need h5py: {install_hint('blocks', 'h5py')}, or take .vtu") from None


def hdf_name(name: str) -> str:
    """A `short_name` as HDF5 can hold it.

    Examples
    --------
    >>> hdf_name("kPa/mm"), hdf_name(".")
    ('kPa_mm', '_')
    """
    name = short_name(name).replace("/", "_")
    return "_" if name == "." else name


def vtkhdf(model: Model) -> bytes:
    """A VTKHDF file, exact, packed; always the same bytes of the same model.

    Raises
    ------
    InputError
        h5py is not installed; as `tetopt.io.pieces.model_pieces`.
    """
    check_h5py()
    import h5py

    pieces = list(model_pieces(model))
    options: Any = {"backing_store": False, "block_size": BLOCK_BYTES, "libver": ("earliest", "v110")}
    with h5py.File("in memory", "w", driver="core", **options) as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array(FORMAT_VERSION, dtype=np.int64)
        root.attrs["Type"] = np.bytes_("UnstructuredGrid")
        arrays = ("points", "cell_types", "connectivity")
        for name, field in zip(COUNT_NAMES, arrays, strict=True):
            _write(root, name, np.array([len(getattr(piece, field)) for piece in pieces], dtype=np.int64))
        for name, field in zip(("Points", "Types", "Connectivity", "Offsets"), (*arrays, "offsets"), strict=True):
            _write(root, name, np.concatenate([getattr(piece, field) for piece in pieces]))
        for group, field in DATA_GROUPS.items():
            into = root.create_group(group, track_order=True)
            data = [getattr(piece, field) for piece in pieces]
            for name, values in data[0].items():
                whole = values if field == "field_data" else np.concatenate([each[name] for each in data])
                _write(into, name, whole)
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
    """The mesh in a VTKHDF file, its pieces joined, see `tetopt.io.pieces.joined`.

    Raises
    ------
    InputError
        Without the path before it: a damaged file, or one that HDF5 crashes at; another data set, or one with steps of
        time; links, data in other files, filters that are not HDF5's own; h5py is not installed.
    """
    check_h5py()
    if path.stat().st_size == 0:
        raise InputError("damaged: the file is empty")
    pieces = read_apart(hdf_pieces, path, library="HDF5")
    return joined([checked_grid("UnstructuredGrid", "", each) for each in pieces])


# In the child


def hdf_pieces(path: str) -> list[dict[str, Any]]:
    """The arrays of a `RawGrid` for each piece that has cells."""
    import h5py

    try:
        with h5py.File(os.fsencode(path), "r", locking=False) as file:
            return _pieces_in(_Guarded(file, os.path.getsize(path)))
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError, TypeError, KeyError) as error:  # HDF5's own, of all kinds
        raise InputError(f"damaged, or not an HDF5 file ({plain(' '.join(str(error).split()))[:300]})") from error


class _Guarded:
    """A stranger's HDF5 file, of which no more is opened than what lies in it, unpacked no further than it may."""

    def __init__(self, file: h5py.File, size: int) -> None:
        self.root = file
        self.size = size

    def member(self, group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
        """What a group calls by a name, None if nothing; a link that leads elsewhere is not followed."""
        import h5py
        from h5py import h5d, h5l

        encoded = name.encode("utf-8", "surrogateescape")
        if not group.id.links.exists(encoded):
            return None
        if group.id.links.get_info(encoded).type != h5l.TYPE_HARD:
            raise InputError(f'"{plain(name)}" is a link to elsewhere, which is not followed; save the file again')
        each = group[name]
        if isinstance(each, h5py.Dataset):
            plan = each.id.get_create_plist()
            if plan.get_layout() == h5d.VIRTUAL or plan.get_external_count():
                raise InputError(f'"{plain(name)}" lies in another file, which is not read; save the file again')
        return each

    def group(self, parent: h5py.Group, name: str) -> h5py.Group | None:
        import h5py

        each = self.member(parent, name)
        if each is not None and not isinstance(each, h5py.Group):
            raise InputError(f'damaged: "{name}" is no group')
        return each

    def array(self, group: h5py.Group, name: str) -> NDArray:
        """A data set's numbers or texts, of one or two axes.

        Raises
        ------
        InputError
            It is none, of other values, or larger than what the file holds of it can be.
        """
        import h5py

        each, shown = self.member(group, name), plain(name)
        if not isinstance(each, h5py.Dataset) or each.shape is None or each.ndim not in (1, 2):
            raise InputError(f'damaged: "{shown}" is no array of one or two axes')
        plan = each.id.get_create_plist()
        filters = [plan.get_filter(k)[0] for k in range(plan.get_nfilters())]
        if not set(filters) <= set(PLAIN_FILTERS) or filters.count(DEFLATE_FILTER) > 1:
            raise InputError(f'"{shown}" is packed in a way that is not read; save the file with gzip, or none')
        # In Python's own numbers: those of a damaged file overflow any other.
        n_bytes = int(np.prod([int(size) for size in each.shape], dtype=object)) * each.dtype.itemsize
        stored = int(each.id.get_storage_size())
        if stored > self.size or n_bytes > stored * (DEFLATE_RATIO if DEFLATE_FILTER in filters else 1):
            raise InputError(
                f'damaged: "{shown}" is of {n_bytes} bytes, the file has {stored} for it, in {self.size} of all'
            )
        if h5py.check_string_dtype(each.dtype) is not None:
            return np.array(each.asstr(errors="backslashreplace")[()], dtype=np.str_)
        if each.dtype.kind not in "iufb":
            raise InputError(f'"{shown}" holds neither numbers nor texts ({each.dtype}); leave it out of the file')
        return np.asarray(each[()], dtype=each.dtype.newbyteorder("="))

    def counts(self, root: h5py.Group, name: str) -> list[int]:
        """One of the pieces' sizes."""
        values = self.array(root, name)
        if values.ndim != 1 or values.dtype.kind not in "iu" or not 0 < len(values) <= MOST_PIECES or min(values) < 0:
            raise InputError(f"damaged: {name} is not the number of each piece, of up to {MOST_PIECES}")
        return [int(value) for value in values]


def _pieces_in(file: _Guarded) -> list[dict[str, Any]]:
    root = file.group(file.root, "VTKHDF")
    if root is None:
        raise InputError("expected a VTKHDF file, found HDF5 without a group VTKHDF")
    kind, version = root.attrs.get("Type", b"nothing"), np.ravel(root.attrs.get("Version", 0))
    kind = kind.decode("utf-8", "replace") if isinstance(kind, bytes) else str(kind)
    if kind != "UnstructuredGrid":
        raise InputError(f"expected an unstructured grid, found {plain(kind)[:40]}; damaged?")
    if version.dtype.kind not in "iu" or int(version[0]) not in (1, FORMAT_VERSION[0]):
        raise InputError("expected VTKHDF of version 1 or 2, found another; save it by an older program, or as .vtu")
    if file.member(root, "Steps") is not None:
        raise InputError("expected one mesh, found steps of time; save one of them")
    n_points, n_cells, n_nodes = (file.counts(root, name) for name in COUNT_NAMES)
    if not len(n_points) == len(n_cells) == len(n_nodes):
        raise InputError("damaged: it has not as many pieces of points as of cells")
    points = file.array(root, "Points")
    arrays = {"points": (points, n_points), "cell_types": (file.array(root, "Types"), n_cells)}
    arrays["connectivity"] = (file.array(root, "Connectivity"), n_nodes)
    arrays["offsets"] = (file.array(root, "Offsets"), [n + 1 for n in n_cells])
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind != "f":
        raise InputError("damaged: its points have not three coordinates each")
    if any(values.ndim != 1 or values.dtype.kind not in "iu" for name, (values, _) in arrays.items() if name[0] != "p"):
        raise InputError("damaged: its cells are no lists of whole numbers")
    kinds = {"points": np.float64, "cell_types": np.uint8, "connectivity": np.int64, "offsets": np.int64}
    cut = {name: _cut(values.astype(kinds[name]), counts, name) for name, (values, counts) in arrays.items()}
    data: dict[str, dict[str, Any]] = {}
    for name, field in DATA_GROUPS.items():
        group = file.group(root, name)
        data[field] = {} if group is None else {str(each): file.array(group, each) for each in group}
    for field, counts in (("point_data", n_points), ("cell_data", n_cells)):
        data[field] = {name: _cut(values, counts, name) for name, values in data[field].items()}
    chosen = [k for k, n in enumerate(n_cells) if n] or [0]
    of_pieces = [
        {name: parts[k] for name, parts in cut.items()}
        | {field: {name: parts[k] for name, parts in data[field].items()} for field in ("point_data", "cell_data")}
        | {"field_data": {}}
        for k in chosen
    ]
    of_pieces[0]["field_data"] = data["field_data"]
    return of_pieces


def _cut(values: NDArray, counts: list[int], name: str) -> list[NDArray]:
    """The pieces' parts of an array; InputError if it has not as many rows as they have."""
    if sum(counts) != len(values):
        raise InputError(f'damaged: "{plain(name)}" has {len(values)} rows, its pieces {sum(counts)}')
    return np.split(values, np.cumsum(counts)[:-1])
