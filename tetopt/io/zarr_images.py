"""Zarr arrays and OME-Zarr images in local folders: axes, scales and translations of voxels.

NGFF 0.4 and 0.5 (https://ngff.openmicroscopy.org) define axes, units, scales and translations;
indices keep the order of the array's spatial axes. The zarr library reads metadata and voxels, and
refuses what it does not understand.
"""

from __future__ import annotations

import itertools
import math
import os
import stat
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.image import check_affine, check_kind, shifted_affine
from tetopt.io.apart import read_apart
from tetopt.io.text import plain
from tetopt.io.units import mm_of_axes, note_size
from tetopt.io.volumes import (
    Reader,
    Request,
    Voxels,
    check_room,
    collect_notes,
    note,
    one_line,
    volume_index,
)
from tetopt.system.arrays import Floats, Json, Shape
from tetopt.system.budget import check_memory
from tetopt.system.extras import install_hint
from tetopt.system.files import folder_written_whole
from tetopt.system.incoming import TEXT_BYTES, irregular

ZARR_SUFFIX = ".zarr"
# every Zarr array and group, of version 3 or 2, has one of these
NODE_FILES = ("zarr.json", ".zarray", ".zgroup")
METADATA_FILES = (*NODE_FILES, ".zattrs", ".zmetadata")
# in an image: their names are looked up in a minute or two; 2048^3 voxels have 4,096 of 128^3
MOST_CHUNKS = 2**24
# In a chunk's file: headers of codecs, and per voxel a number of 8 bytes and the overhead of shards
# and codecs.
PACKED_BYTES, PACKED_VOXEL_BYTES = 2**16, 32
# voxels, in written files: 4 MB of 16 bits, and a crop reads a few chunks
CHUNK_EDGE = 128
# Row of the affine and sign of an axis in RAS+, by its orientation (NGFF's RFC-4) or name.
WAYS = {
    "left-to-right": (0, 1.0),
    "right-to-left": (0, -1.0),
    "posterior-to-anterior": (1, 1.0),
    "anterior-to-posterior": (1, -1.0),
    "inferior-to-superior": (2, 1.0),
    "superior-to-inferior": (2, -1.0),
    "x": (0, 1.0),
    "y": (1, 1.0),
    "z": (2, 1.0),
}
ARRAY_AXES = 32  # at most in an array, the limit of the oldest supported numpy
MOST_FOLDERS = 3  # between a level and its image: "0", or "scale0/image"
MOST_LEVELS = 64  # in a multiscale: more than halving any volume can give
# Errors on metadata of another structure: a list in place of a table, a missing entry, a text in
# place of a number.
STRUCTURE_ERRORS = (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError)


Pick = int | list[int]  # of an axis: an index, or start and stop


class ZarrLevel(NamedTuple):
    """One array of an image, with its placement."""

    folder: Path
    array: Any
    names: tuple[str, ...]  # of all axes
    space: Shape  # the three spatial axes, in order
    affine: Floats  # (4, 4), from indices along these three axes to world, mm

    @property
    def shape(self) -> Shape:
        """Number of voxels along the three spatial axes."""
        return tuple(int(self.array.shape[axis]) for axis in self.space)

    @property
    def others(self) -> Shape:
        """The axes that are not spatial."""
        return tuple(axis for axis in range(len(self.names)) if axis not in self.space)


class _Axes(NamedTuple):
    """The axes of a multiscale."""

    names: tuple[str, ...]
    space: list[int]  # numbers of the spatial axes
    rows: list[int]  # of the affine, for each spatial axis
    steps: Floats  # mm along this row per unit of the axis
    mm: Floats | None  # lengths of units, if there are any


def is_zarr(path: Path) -> bool:
    """Return whether a path is a Zarr folder, by its name or its contents."""
    return path.is_dir() and (path.name.lower().endswith(ZARR_SUFFIX) or is_node(path))


def image_folder(level: Path) -> Path | None:
    """Return the folder that may be the OME-Zarr image of a level; None if there is none."""
    folders = [folder for folder in level.parents[:MOST_FOLDERS] if is_node(folder)]
    return folders[0] if folders and is_node(level) else None


def is_node(path: Path) -> bool:
    """Return whether a folder is a Zarr array or group, by its contents."""
    return any((path / name).exists() for name in NODE_FILES)


def read_zarr(path: Path, request: Request) -> Voxels:
    """Return data and affine of the requested box of the finest level, of which nothing else is
    read.
    """
    level = zarr_levels(path)[0]
    bounds = request.box(level.shape)
    shape = [stop - start for start, stop in bounds]
    picks = zarr_picks(level, request.volume, bounds)
    value_bytes = level.array.dtype.itemsize
    check_room(shape, value_bytes)
    check_chunks(level, picks)
    n_bytes = math.prod(shape) * value_bytes
    # in a child process, as compiled codecs trust the headers of chunks
    values = read_apart(
        _values, level.folder, picks, size=n_bytes, value_bytes=n_bytes, library="zarr"
    )
    return values, shifted_affine(level.affine, [start for start, _ in bounds])


def zarr_shape(path: Path) -> Shape:
    """Return the number of voxels along the three spatial axes, then the lengths of the others."""
    level = zarr_levels(path)[0]
    return (*level.shape, *(int(level.array.shape[axis]) for axis in level.others))


ZARR = Reader(
    (ZARR_SUFFIX,),
    read_zarr,
    is_this=is_zarr,
    shape=zarr_shape,
    levels=lambda path: {str(level.folder): level.shape for level in zarr_levels(path)},
    reads_crop=True,
    reads_slice=True,
)


def zarr_picks(
    level: ZarrLevel, volume: int | None, bounds: Sequence[tuple[int, int]]
) -> list[Pick]:
    """Return the index of a box of one volume of a level, along all axes of its array.

    Raises
    ------
    InputError
        Without a leading path: there are several volumes and no `volume`, or it is out of range.
    """
    words = ", ".join(f"{level.names[axis]} ({level.array.shape[axis]})" for axis in level.others)
    # The last axis varies fastest, as in the file.
    trailing = [level.array.shape[axis] for axis in level.others[::-1]]
    picks: dict[int, Pick] = dict(
        zip(level.others[::-1], volume_index(trailing, volume, words), strict=True)
    )
    picks |= {axis: list(ends) for axis, ends in zip(level.space, bounds, strict=True)}
    return [picks[axis] for axis in range(len(picks))]


def _values(folder: str, index: list[Pick]) -> NDArray:
    """Return a part of an array, in the child."""
    array = _node(Path(folder))
    try:
        return np.asarray(
            array[tuple(slice(*pick) if isinstance(pick, list) else pick for pick in index)]
        )
    except MemoryError:
        raise
    except Exception as error:  # codecs raise any error on damaged chunks
        place = ", ".join(
            f"{pick[0]}:{pick[1]}" if isinstance(pick, list) else str(pick) for pick in index
        )
        raise InputError(
            f"its voxels {place} cannot be read ({one_line(error)[:200]}); copy it again"
        ) from error


def zarr_levels(path: Path) -> list[ZarrLevel]:
    """Return the arrays of an image, the finest first: those of OME-Zarr's first multiscale, from
    a level on if `path` is one of them, or a single array.

    Raises
    ------
    InputError
        Without a leading path: zarr is not installed; the folder or its metadata do not describe a
        3-D image with a scale.
    """
    node = _node(path)
    if hasattr(node, "shape"):
        _check_array(node)
        if (affine := _own_affine(node)) is None:
            if (folder := image_folder(path)) is not None:
                levels = zarr_levels(folder)
                names = [level.folder for level in levels]
                if path in names:
                    return levels[names.index(path) :]
            raise InputError(
                "this Zarr array has no scale; give the folder of its OME-Zarr image, or give it "
                'the attribute "affine", 4 x 4 numbers from index to world in mm'
            )
        return [
            ZarrLevel(
                path, node, tuple(f"axis {axis}" for axis in range(node.ndim)), (0, 1, 2), affine
            )
        ]
    attributes = node.attrs.asdict()
    ome = attributes.get("ome", attributes)
    if not isinstance(ome, dict) or not ome.get("multiscales"):
        inside = sorted(child.name for child in path.iterdir() if is_node(child))
        listed = (
            f"; choose one of its members: {', '.join(inside[:8])}"
            if inside
            else ", and it is empty"
        )
        raise InputError(f"this Zarr group has no OME-Zarr image (multiscales){listed}")
    try:
        return _levels(path, ome["multiscales"][0])
    except InputError:
        raise
    except STRUCTURE_ERRORS as error:
        words = f"{type(error).__name__}: {plain(one_line(error)[:80])}"
        raise InputError(
            f"its OME-Zarr metadata does not follow NGFF 0.4 or 0.5 ({words}); write it again"
        ) from error


def save_zarr(path: Path, affine: Floats, values: NDArray) -> None:
    """Write an OME-Zarr image (NGFF 0.5, Zarr's format 3), whole or not at all.

    Its axes are named x, y, z in the order of the indices. Scale and translation are the lengths of
    a voxel's edges and the position of the first voxel, which is all that NGFF supports; the
    attribute "affine" has the whole affine.

    Parameters
    ----------
    path : Path
        Replaces an existing Zarr folder; call `tetopt.system.files.check_output` first.
    affine : (4, 4) array
        Placement of the voxels.
    values : array
        The voxels, three-dimensional, in the type for storage.

    Raises
    ------
    InputError
        zarr is not installed; the image is not 3-D.
    OSError
        For the reasons of `tetopt.system.files.folder_written_whole`.
    """
    zarr = _library()
    if values.ndim != 3:
        raise InputError(
            f"{path}: expected a 3-D image for Zarr, got a {values.ndim}-D one; use .nii.gz"
        )
    axes = [{"name": name, "type": "space", "unit": "millimeter"} for name in "xyz"]
    place = [
        {"type": "scale", "scale": np.sqrt((affine[:3, :3] ** 2).sum(axis=0)).tolist()},
        {"type": "translation", "translation": affine[:3, 3].tolist()},
    ]
    scales = {"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": place}]}
    with folder_written_whole(path) as folder:
        group = zarr.open_group(folder, mode="w", zarr_format=3)
        array = group.create_array(
            "0",
            shape=values.shape,
            chunks=[min(size, CHUNK_EDGE) for size in values.shape],
            dtype=values.dtype,
            fill_value=0,
            dimension_names=["x", "y", "z"],
            attributes={"affine": affine.tolist()},
            config={"write_empty_chunks": True},
        )
        group.attrs.update({"ome": {"version": "0.5", "multiscales": [scales]}})
        array[:] = values


def _library() -> Any:
    try:
        import zarr
        import zarr.storage
    except ImportError as error:
        raise InputError(f"Zarr folders need the zarr library; {install_hint('zarr')}") from error
    return zarr


def _node(path: Path, name: str = "") -> Any:
    """Open the array or group in a folder, or its member of this name."""
    zarr = _library()
    for file in (path / name / each for each in METADATA_FILES):
        if file.exists() and (
            (other := irregular(file)) is not None or file.stat().st_size > TEXT_BYTES
        ):
            raise InputError(f"its {file.name} is {other or 'too long'}; expected JSON text")
    if not is_node(path):
        raise InputError(f"no Zarr array in this folder: expected one of {', '.join(NODE_FILES)}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about other files in the folder
            # From 3.4 on zarr reads chunks of no voxels as chunks of one, with a warning.
            warnings.filterwarnings("error", message="(?s).*stored chunk shape .* is invalid")
            store = zarr.storage.LocalStore(path, read_only=True)
            return zarr.open(store, path=name, mode="r", use_consolidated=False)
    # zarr raises any error on damaged metadata; a missing codec or array is named
    except Exception as error:
        raise InputError(
            f"its Zarr metadata cannot be read ({plain(one_line(error)[:200])}); copy it again"
        ) from error


def _levels(path: Path, scales: Json) -> list[ZarrLevel]:
    """Return the arrays of a multiscale; errors of `STRUCTURE_ERRORS` if it has another
    structure than NGFF's.
    """
    with collect_notes() as notes:  # of no concern to an image with its own affine
        axes = _axes_of(scales["axes"])
    after = scales.get("coordinateTransformations", [])
    levels = [_level(path, each, after, axes) for each in scales["datasets"][:MOST_LEVELS]]
    own = _own_affine(levels[0].array)
    if own is None:
        note(*notes)
        note_size(levels[0].shape, levels[0].affine, axes.mm)
        return levels
    note_size(levels[0].shape, own, np.ones(3))
    # NGFF 0.5 has no rotations: the attribute of the first level places all levels.
    turn = own @ np.linalg.inv(levels[0].affine)
    return [
        levels[0]._replace(affine=own),
        *(each._replace(affine=turn @ each.affine) for each in levels[1:]),
    ]


def _level(path: Path, dataset: Json, after: Sequence[dict], axes: _Axes) -> ZarrLevel:
    """Return one dataset of a multiscale, with the transformations `after` its own."""
    array = _node(path, dataset["path"])
    _check_array(array)
    scale, shift = _scale_and_shift([*dataset["coordinateTransformations"], *after], array.ndim)
    affine = np.zeros((4, 4))
    affine[axes.rows, range(3)] = axes.steps * scale[axes.space]
    affine[axes.rows, 3] = axes.steps * shift[axes.space]
    affine[3, 3] = 1.0
    return ZarrLevel(
        path / array.path, array, axes.names, tuple(axes.space), check_affine(affine, 3)
    )


def _axes_of(axes: list[Json]) -> _Axes:
    """Return the axes of a multiscale."""
    names = tuple(plain(str(axis.get("name"))) for axis in axes)
    kinds = [
        axis.get("type", "space" if axis.get("name") in ("x", "y", "z") else None) for axis in axes
    ]
    space = [number for number, kind in enumerate(kinds) if kind == "space"]
    words = ", ".join(names)
    if len(space) != 3:
        raise InputError(
            f"expected three spatial axes, got {len(space)} among {words}; only 3-D images are "
            "supported"
        )
    units = [axes[number].get("unit") or "" for number in space]
    if not any(units):
        note("has no unit on its axes: assuming mm")
    mm = mm_of_axes(units, "its OME-Zarr metadata: unit")
    ways = [WAYS.get((axes[number].get("orientation") or {}).get("value", "")) for number in space]
    if None in ways:
        ways = [WAYS.get(names[number].lower()) for number in space]
        note(
            "has no orientation: assuming x, y and z are right, anterior and superior; if "
            "left/right matters, give its axes an orientation (NGFF's RFC-4)"
        )
    rows, signs = zip(*(way or (None, 0.0) for way in ways), strict=True)
    if set(rows) != {0, 1, 2}:
        raise _unusable("axes", words, "x, y and z, or three different orientations")
    return _Axes(names, space, list(rows), np.array(signs) * (1.0 if mm is None else mm), mm)


def _scale_and_shift(transforms: list[Json], n: int) -> tuple[Floats, Floats]:
    """Combine successive scales and translations of n axes."""
    scale = np.ones(n)
    shift = np.zeros(n)
    has_scale = False
    for each in transforms:
        kind = each["type"]
        if kind == "scale":
            values = np.array(each[kind], dtype=np.float64).reshape(n)
            with np.errstate(invalid="ignore"):  # infinite scales are refused with the affine
                scale = scale * values
                shift = shift * values
                has_scale = True
        elif kind == "translation":
            shift = shift + np.array(each[kind], dtype=np.float64).reshape(n)
        elif kind != "identity":
            raise _unusable("coordinateTransformations", kind, "scales and translations")
    if not has_scale:
        raise InputError(
            "its metadata has no scale, so its voxel size is unknown; correct the metadata"
        )
    return scale, shift


def _unusable(what: str, value: object, expected: str) -> InputError:
    return InputError(
        f"its OME-Zarr metadata: {what}: expected {expected}, got {plain(str(value)[:80])}"
    )


def _own_affine(array: Any) -> Floats | None:
    """Return the attribute "affine" of an array, (4, 4), for its spatial axes in order."""
    affine = array.attrs.asdict().get("affine")
    return None if affine is None else check_affine(affine, 3)


def _check_array(array: Any) -> None:
    """Raise InputError for values that are not numbers, no voxels, and chunks larger than
    memory.
    """
    check_kind(array.dtype)
    if not 3 <= array.ndim <= ARRAY_AXES or 0 in (
        *array.shape,
        *array.chunks,
        *(array.shards or ()),
    ):
        raise InputError(
            f"expected 3 to {ARRAY_AXES} axes with voxels, got shape {array.shape} in chunks of "
            f"{array.chunks}"
        )
    shape = " x ".join(str(size) for size in array.chunks)
    n_bytes = math.prod(array.chunks) * array.dtype.itemsize
    check_memory(
        n_bytes, f"one of its chunks of {shape} voxels", "write it again with smaller chunks"
    )


def check_chunks(level: ZarrLevel, picks: Sequence[Pick]) -> None:
    """Check that the files of these voxels' chunks are regular, and not longer or shorter than they
    can be.

    Writers omit chunks that contain only the fill value; therefore some missing chunks are only
    noted, but if all are missing it is an error.

    Raises
    ------
    InputError
        Without a leading path: the chunks are invalid.
    """
    array = level.array
    edges = array.shards or array.chunks
    ranges = [
        range(pick[0] // size, -(-pick[1] // size)) if isinstance(pick, list) else [pick // size]
        for pick, size in zip(picks, edges, strict=True)
    ]
    most_bytes = PACKED_BYTES + PACKED_VOXEL_BYTES * math.prod(edges)
    n_chunks = math.prod(map(len, ranges))
    n_missing = 0
    if n_chunks > MOST_CHUNKS:
        raise InputError(
            f"expected at most {MOST_CHUNKS} chunks, got {n_chunks}; write it again with larger "
            "chunks"
        )
    is_blosc = not array.shards and "Blosc" in "".join(
        type(each).__name__ for each in array.compressors[-1:]
    )
    for place in itertools.product(*ranges):
        name = array.metadata.encode_chunk_key(place)
        file = f"{level.folder}/{name}"
        try:
            status = os.stat(file)
        except (FileNotFoundError, NotADirectoryError):
            n_missing += 1
            continue
        if not stat.S_ISREG(status.st_mode) or status.st_size > most_bytes:
            raise InputError(
                f"its chunk {name} is not a regular file of at most {most_bytes} bytes; copy it "
                "again"
            )
        if is_blosc and status.st_size < _blosc_length(file):
            raise InputError(
                f"its chunk {name} has {status.st_size} bytes, fewer than it begins with; copy "
                "it again"
            )
    if n_missing == n_chunks:
        raise InputError(
            f"all of its {n_chunks} chunks are missing; copy it again, with its whole folder"
        )
    if n_missing > 0:
        note(
            f"{n_missing} of its {n_chunks} chunks are missing; their voxels get its fill value, "
            f"{array.fill_value or 0:g}; copy it again if it should have values there"
        )


def _blosc_length(file: str) -> int:
    """Return the length of a chunk by Blosc's header; the codec reads beyond the end of a
    shorter one.
    """
    with open(file, "rb") as stream:
        return int.from_bytes(stream.read(16)[12:], "little")
