"""Zarr arrays and OME-Zarr images, of folders on this machine: what axes, scale and translation say of the voxels.

NGFF 0.4 and 0.5 (https://ngff.openmicroscopy.org) tell of axes, units, scales and translations; the order of the
array's axes in space is kept as that of the indices. Nothing is read of the voxels here; chunks are counted.
"""

from __future__ import annotations

import itertools
import math
import os
import stat
import warnings
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tetopt.errors import InputError
from tetopt.image import Image, checked_affine
from tetopt.io.text import plain
from tetopt.io.volumes import DAMAGED_FILE, VoxelsInFile, one_line, volume_index
from tetopt.io.zarr_codecs import PACKERS, bounded
from tetopt.system.budget import check_memory
from tetopt.system.extras import install_hint
from tetopt.system.files import folder_written_whole
from tetopt.system.incoming import LARGEST_NUMBER, TEXT_BYTES, irregular

ZARR_SUFFIX = ".zarr"
NODE_FILES = ("zarr.json", ".zarray", ".zgroup")  # one of which every array and group of Zarr has, of version 3 and 2
METADATA_FILES = (*NODE_FILES, ".zattrs", ".zmetadata")
MOST_CHUNKS = 2**24  # of one image: as many names are looked up in a minute or two; 2048^3 voxels have 4,096 of 128^3
MOST_SPARSE = 1000  # chunks to each that is there: an image of nothing would be long work
# Of a chunk's file: headers of codecs, and for each voxel a number of 8 bytes and what shards and codecs add to it.
PACKED_BYTES, PACKED_VOXEL_BYTES = 2**16, 32
CHUNK_EDGE = 128  # voxels, of what is written: 4 MB of 16 bits, and a part of a mesh reads a few
MOST_LEVELS = 64  # of a multiscale: each is at least half of the one before
# NGFF's units of length, names of UDUNITS-2, in mm.
MM_PER_LENGTH = {
    "yoctometer": 1e-21, "zeptometer": 1e-18, "attometer": 1e-15, "femtometer": 1e-12, "picometer": 1e-9,
    "angstrom": 1e-7, "nanometer": 1e-6, "micrometer": 1e-3, "millimeter": 1.0, "centimeter": 10.0, "decimeter": 100.0,
    "meter": 1e3, "hectometer": 1e5, "kilometer": 1e6, "megameter": 1e9, "gigameter": 1e12, "terameter": 1e15,
    "petameter": 1e18, "exameter": 1e21, "zettameter": 1e24, "yottameter": 1e27, "inch": 25.4, "foot": 304.8,
    "yard": 914.4, "mile": 1609344.0, "parsec": 3.0856775814913674e19,
}  # fmt: skip
# Where an axis leads in RAS+, by its orientation (NGFF's RFC-4): row of the affine and sign.
WAYS_OF_BODY = {
    "left-to-right": (0, 1.0), "right-to-left": (0, -1.0), "posterior-to-anterior": (1, 1.0),
    "anterior-to-posterior": (1, -1.0), "inferior-to-superior": (2, 1.0), "superior-to-inferior": (2, -1.0),
}  # fmt: skip
ARRAY_AXES = 32  # of an array, the fewest that a numpy which is supported can have
# Numbers to as many numbers. Others, such as numcodecs' pickle, can make a file run whatever it likes.
KNOWN_CODECS = (
    *PACKERS, "bytes", "endian", "transpose", "sharding_indexed", "crc32c", "shuffle", "delta", "bitround",
    "fixedscaleoffset", "quantize", "astype",
)  # fmt: skip


class ZarrLevel(NamedTuple):
    """One array of an image and what is known of its place."""

    folder: Path
    array: Any
    names: tuple[str, ...]  # of all axes
    space: tuple[int, ...]  # which three axes are those of space, in their order
    affine: NDArray[np.float64]  # (4, 4), of the indices along these three -> world, mm

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along the three axes in space."""
        return tuple(int(self.array.shape[axis]) for axis in self.space)

    @property
    def others(self) -> tuple[int, ...]:
        """The axes that are none of space."""
        return tuple(axis for axis in range(len(self.names)) if axis not in self.space)


def is_zarr(path: Path) -> bool:
    """Whether it is a folder of Zarr's, by its name or by what lies in it."""
    return path.is_dir() and (path.name.lower().endswith(ZARR_SUFFIX) or is_node(path))


def is_node(path: Path) -> bool:
    """Whether it is an array or a group of Zarr, by what lies in it."""
    return any((path / name).exists() for name in NODE_FILES)


def open_zarr(level: ZarrLevel, volume: int | None) -> Image:
    """One volume of a level, of which nothing is read.

    Raises
    ------
    InputError
        Without the path before it: several volumes and no `volume`, or one out of range.
    """
    words = ", ".join(f"{level.names[axis]} ({level.array.shape[axis]})" for axis in level.others)
    # The last axis runs fastest, as in the file.
    index = volume_index([level.array.shape[axis] for axis in level.others[::-1]], volume, words)[::-1]
    picks: list[int | slice] = [slice(0, int(size)) for size in level.array.shape]
    for axis, at in zip(level.others, index, strict=True):
        picks[axis] = at
    voxels = VoxelsInFile(level.folder, bounded(level.array), tuple(picks), level.array.chunks)
    return Image.stored(voxels, level.affine)


def zarr_levels(path: Path, notes: list[str]) -> list[ZarrLevel]:
    """The arrays of an image, the finest first: those of OME-Zarr's first multiscale, or one by itself.

    Raises
    ------
    InputError
        Without the path before it: zarr is not installed; the folder, or what its metadata tells, is no image in three
        dimensions with a scale.
    """
    node = _node(path)
    if hasattr(node, "shape"):
        return [_single(path, node)]
    attributes = node.attrs.asdict()
    ome = attributes.get("ome", attributes)
    scales = ome.get("multiscales") if isinstance(ome, dict) else None
    if not isinstance(scales, list) or not scales or not isinstance(scales[0], dict):
        inside = sorted(child.name for child in path.iterdir() if is_node(child))
        listed = f"; name what is in it: {', '.join(inside[:8])}" if inside else ", and nothing in it"
        raise InputError(f"a group of Zarr without an OME-Zarr image (multiscales){listed}")
    datasets, axes = scales[0].get("datasets"), scales[0].get("axes")
    if not isinstance(datasets, list) or not 0 < len(datasets) <= MOST_LEVELS:
        raise _unusable("datasets", datasets, "a list of its arrays")
    if not isinstance(axes, list) or not all(isinstance(axis, dict) for axis in axes):
        raise _unusable("axes", axes, "a list of axes with names, as NGFF 0.4 and 0.5 have it")
    after = scales[0].get("coordinateTransformations", [])
    places = _Places(axes)
    levels = [_level(path, each, after, axes, places) for each in datasets]
    own = _own_affine(levels[0].array)
    if own is None:
        notes += places.notes
        return levels
    # NGFF 0.5 knows no rotations: the levels are where the first one's own attribute puts them.
    turn = own @ np.linalg.inv(levels[0].affine)
    return [levels[0]._replace(affine=own), *(each._replace(affine=turn @ each.affine) for each in levels[1:])]


def save_zarr(path: Path, image: Image, voxels: Any, dtype: DTypeLike) -> tuple[float, float]:
    """Write an OME-Zarr image (NGFF 0.5, Zarr's format 3) chunk by chunk, whole or not at all.

    Its axes are named x, y, z in the order of the indices. Scale and translation are the lengths of a voxel's edges and
    the first voxel's place, which NGFF has no more than; the attribute "affine" of the array has it all.

    Parameters
    ----------
    path : Path
        Replaces a folder of Zarr's that is there; ask `tetopt.system.files.checked_output` first.
    image : Image
        Whose place they have, three-dimensional.
    voxels : Any
        What gives them for a tuple of slices, chunk after chunk.
    dtype : dtype
        That they are stored in; rounded to whole numbers if it is of these.

    Returns
    -------
    tuple of float
        The least value and the largest.

    Raises
    ------
    InputError
        zarr is not installed; not three axes; values beyond the dtype's.
    OSError
        As `tetopt.system.files.folder_written_whole`.
    """
    zarr = _library()
    if image.ndim != 3:
        raise InputError(f"{path}: expected a volume to write as Zarr, got a {image.ndim}-D image; write it as .nii.gz")
    low, high = np.inf, -np.inf
    with folder_written_whole(path) as folder:
        group = zarr.open_group(folder, mode="w", zarr_format=3)
        array = group.create_array(
            "0", shape=image.shape, chunks=[min(size, CHUNK_EDGE) for size in image.shape], dtype=dtype, fill_value=0,
            dimension_names=["x", "y", "z"], attributes={"affine": image.affine.tolist()},
            config={"write_empty_chunks": True},
        )  # fmt: skip
        group.attrs.update({"ome": {"version": "0.5", "multiscales": [_multiscale(image)]}})
        for corner in itertools.product(*(range(0, size, CHUNK_EDGE) for size in image.shape)):
            ends = [min(at + CHUNK_EDGE, size) for at, size in zip(corner, image.shape, strict=True)]
            box = tuple(slice(*each) for each in zip(corner, ends, strict=True))
            block = _stored_values(path, np.asarray(voxels[box]), array.dtype)
            low, high = min(low, float(block.min())), max(high, float(block.max()))
            array[box] = block
    return low, high


def _stored_values(path: Path, block: NDArray, dtype: np.dtype) -> NDArray:
    """Values as they are stored; InputError where they do not fit."""
    if dtype.kind not in "iu":
        return block.astype(dtype)
    block, limits = np.rint(block), np.iinfo(dtype)
    if block.min() < limits.min or block.max() > limits.max:
        raise InputError(
            f"{path}: expected values from {limits.min} to {limits.max}, as {dtype} holds them, got {block.min():g} to "
            f"{block.max():g}; scale them"
        )
    return block.astype(dtype)


def _multiscale(image: Image) -> dict[str, Any]:
    """NGFF's words for one array of voxels."""
    axes = [{"name": name, "type": "space", "unit": "millimeter"} for name in "xyz"]
    transforms = [
        {"type": "scale", "scale": image.spacing.tolist()},
        {"type": "translation", "translation": image.affine[:3, 3].tolist()},
    ]
    return {"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": transforms}]}


def _library() -> Any:
    try:
        import zarr
        import zarr.storage
    except ImportError as error:
        raise InputError(f"a folder of Zarr needs the zarr library; {install_hint('blocks', 'zarr')}") from error
    return zarr


def _level(path: Path, dataset: Any, after: Any, axes: list[dict], places: _Places) -> ZarrLevel:
    """One dataset of a multiscale."""
    name = dataset.get("path") if isinstance(dataset, dict) else None
    if not isinstance(name, str):
        raise _unusable("path", name, "the name of an array within the folder")
    parts = PurePosixPath(name).parts
    if not parts or ".." in parts or parts[0] == "/" or "\\" in name or ":" in name or "\0" in name:
        raise _unusable("path", name, "the name of an array within the folder")
    folder = path.joinpath(*parts)
    if not is_node(folder):
        raise InputError(f'{DAMAGED_FILE} (its array "{plain(name)}" is not there)')
    array = _node(folder)
    if not hasattr(array, "shape"):
        raise _unusable("path", name, "the name of an array")
    if len(array.shape) != len(axes):
        raise InputError(f"its metadata names {len(axes)} axes, its array has {len(array.shape)}; mend the metadata")
    _check_array(array)
    scale, shift = _scale_and_shift([dataset.get("coordinateTransformations"), after], len(axes))
    return ZarrLevel(folder, array, places.names, places.space, places.affine(scale, shift))


def _single(path: Path, array: Any) -> ZarrLevel:
    """An array by itself, whose first three axes are those of space."""
    if len(array.shape) < 3:
        raise InputError(f"expected an array of three axes, got shape {array.shape}; stacks of slices have three")
    _check_array(array)
    affine = _own_affine(array)
    if affine is None:
        raise InputError(
            "an array of Zarr without a scale; name the folder of the OME-Zarr image that it is of, or give it the "
            'attribute "affine", 4 x 4 numbers from index to world in mm'
        )
    names = tuple(f"axis {axis}" for axis in range(len(array.shape)))
    return ZarrLevel(path, array, names, (0, 1, 2), affine)


def _own_affine(array: Any) -> NDArray[np.float64] | None:
    """What the attribute "affine" of an array says, (4, 4), of its axes in space in their order."""
    affine = array.attrs.asdict().get("affine")
    return None if affine is None else checked_affine(affine, 3)


def _node(path: Path) -> Any:
    """The array or group in a folder, as zarr reads it."""
    zarr = _library()
    for name in METADATA_FILES:
        file = path / name
        if file.exists() and ((other := irregular(file)) is not None or file.stat().st_size > TEXT_BYTES):
            raise InputError(f"its {name} is {other or 'longer than any'}; expected a text of JSON")
    if not is_node(path):
        raise InputError(f"no array of Zarr in this folder: it has none of {', '.join(NODE_FILES)}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what else lies in the folder
            # From 3.4 on zarr reads chunks of no voxels as chunks of one, with a warning.
            warnings.filterwarnings("error", message="(?s).*stored chunk shape .* is invalid")
            return zarr.open(zarr.storage.LocalStore(path, read_only=True), mode="r", use_consolidated=False)
    except Exception as error:  # zarr raises whatever comes up at damaged metadata; a codec that is missing is named
        raise InputError(f"its Zarr metadata cannot be read ({plain(one_line(error)[:200])}); copy it again") from error


def _check_array(array: Any) -> None:
    """InputError for values that are no numbers, no voxels, codecs that are not read and chunks beyond memory."""
    dtype = array.dtype
    if getattr(dtype, "kind", "") not in tuple("buif") or dtype.names is not None:
        raise InputError(f"expected one real number a voxel, got {plain(str(dtype))}; convert it first")
    if len(array.shape) > ARRAY_AXES:
        raise InputError(f"expected at most {ARRAY_AXES} axes, got {len(array.shape)}; write it again with fewer")
    if 0 in (*array.shape, *array.chunks, *(array.shards or ())):
        raise InputError(f"every axis needs a voxel, got shape {array.shape} in chunks of {array.chunks}")
    names = _codec_names(array.metadata.to_dict())
    unknown = sorted({name for name in names if name not in KNOWN_CODECS})
    if unknown:
        raise InputError(f"its chunks are packed by {plain(', '.join(unknown))}, which is not read; write it again")
    packers = [name for name in names if name in PACKERS]
    if len(packers) > 1:
        raise InputError(f"its chunks are packed several times, by {', '.join(packers)}; write it again")
    shape = " x ".join(str(size) for size in array.chunks)
    n_bytes = math.prod(array.chunks) * dtype.itemsize
    check_memory(n_bytes, f"one of its chunks of {shape} voxels", "write it again in smaller ones")


def _codec_names(metadata: Any) -> list[str]:
    """Names of all that packs the chunks, those within shards among them, without the library's before them."""
    names = []
    for key in ("compressor", "filters", "codecs", "index_codecs"):
        each = metadata.get(key) or ()
        for codec in [each] if isinstance(each, dict) else each:
            table = codec if isinstance(codec, dict) else codec.get_config()
            names.append(str(table.get("name", table.get("id"))).removeprefix("numcodecs."))
            if isinstance(table.get("configuration"), dict):
                names += _codec_names(table["configuration"])
    return names


def check_chunks(voxels: VoxelsInFile, notes: list[str]) -> None:
    """Look whether the files of the chunks that these voxels are in are there, and are files.

    Writers leave out chunks of nothing but the fill value, so that some that are missing are no error, but one of the
    `notes`; all are.

    Raises
    ------
    InputError
        Without the path before it: chunks that cannot be.
    """
    array = voxels.array
    edges = array.shards or array.chunks
    ranges = [
        range(pick.start // size, -(-pick.stop // size)) if isinstance(pick, slice) else [pick // size]
        for pick, size in zip(voxels.picks, edges, strict=True)
    ]
    most_bytes = PACKED_BYTES + PACKED_VOXEL_BYTES * math.prod(edges)
    n_chunks, n_missing = math.prod(map(len, ranges)), 0
    if n_chunks > MOST_CHUNKS:
        raise InputError(f"expected at most {MOST_CHUNKS} chunks, got {n_chunks}; write it again in larger ones")
    folder = str(voxels.path)
    for place in itertools.product(*ranges):
        name = array.metadata.encode_chunk_key(place)
        try:
            status = os.stat(f"{folder}/{name}")
        except (FileNotFoundError, NotADirectoryError):
            n_missing += 1
            continue
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"its chunk {name} is no regular file; copy what it gives into a file")
        if status.st_size > most_bytes:
            raise InputError(f"its chunk {name} has {status.st_size} bytes, at most {most_bytes} can be; copy it again")
    if n_missing == 0:
        return
    if n_missing == n_chunks:
        raise InputError(f"none of its {n_chunks} chunks is there; copy it again, with all that is in its folder")
    if n_chunks > MOST_SPARSE * (n_chunks - n_missing):
        raise InputError(
            f"only {n_chunks - n_missing} of its {n_chunks} chunks are there; copy it again, or crop it to them"
        )
    fill = array.fill_value
    if fill is None or not np.isfinite(fill):
        raise InputError(
            f"{n_missing} of its {n_chunks} chunks are missing, and it has no value for them; copy it again"
        )
    notes.append(
        f"{n_missing} of its {n_chunks} chunks are not there, and their voxels are taken as {fill:g}, its fill value; "
        "copy it again if it should have values there"
    )


class _Places:
    """What a multiscale's axes say: which are those of space, and where they lead."""

    def __init__(self, axes: list[dict]) -> None:
        self.notes: list[str] = []
        self.names = tuple(plain(str(axis.get("name"))) for axis in axes)
        kinds = [axis.get("type", "space" if axis.get("name") in ("x", "y", "z") else None) for axis in axes]
        self.space = tuple(number for number, kind in enumerate(kinds) if kind == "space")
        if len(self.space) != 3:
            raise InputError(
                f"expected three axes in space, got {len(self.space)} of axes {', '.join(self.names)}; only volumes "
                "are meshed from Zarr"
            )
        inside = [axes[number] for number in self.space]
        self.mm = [_mm_of(axis, self.notes) for axis in inside]
        ways = [WAYS_OF_BODY.get(_orientation(axis)) for axis in inside]
        self.ways = [way for way in ways if way is not None]
        if len(self.ways) < 3:
            letters = [str(axis.get("name")).lower() for axis in inside]
            if sorted(letters) != ["x", "y", "z"]:
                raise _unusable("names of axes", ", ".join(letters), "x, y and z, or axes with an orientation")
            self.ways = [("xyz".index(letter), 1.0) for letter in letters]
            self.notes.append(
                "has no orientation: x, y and z of its axes are taken as right, anterior and superior; if left/right "
                "matters, give its axes an orientation (NGFF's RFC-4)"
            )
        if len({row for row, _ in self.ways}) < 3:
            raise _unusable("orientation", [_orientation(axis) for axis in inside], "three different directions")

    def affine(self, scale: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.float64]:
        """Index -> world mm, (4, 4), of axes with this scale and translation in their own units."""
        affine = np.zeros((4, 4))
        affine[3, 3] = 1.0
        for column, (axis, (row, sign), mm) in enumerate(zip(self.space, self.ways, self.mm, strict=True)):
            affine[row, column] = sign * mm * scale[axis]
            affine[row, 3] = sign * mm * shift[axis]
        return checked_affine(affine, 3)


def _mm_of(axis: dict, notes: list[str]) -> float:
    """How many mm an axis's unit is."""
    unit = axis.get("unit")
    if unit is None:
        note = "has no unit on its axes: its scale is taken as mm"
        if note not in notes:
            notes.append(note)
        return 1.0
    if not isinstance(unit, str) or unit not in MM_PER_LENGTH:
        raise _unusable("unit", unit, "a length as NGFF names it, such as micrometer or millimeter")
    return MM_PER_LENGTH[unit]


def _orientation(axis: dict) -> str:
    value = axis.get("orientation")
    return str(value.get("value") if isinstance(value, dict) else value)


def _scale_and_shift(lists: list[Any], n_axes: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What scales and translations, one after the other, come to together."""
    scale, shift, has_scale = np.ones(n_axes), np.zeros(n_axes), False
    for transforms in lists:
        for each in transforms if isinstance(transforms, list) else []:
            kind = each.get("type") if isinstance(each, dict) else None
            if kind == "identity":
                continue
            if kind not in ("scale", "translation"):
                raise _unusable("coordinateTransformations", kind, "scales and translations")
            values = each.get(kind)
            is_row = isinstance(values, list) and len(values) == n_axes
            if not is_row or not all(type(value) in (int, float) and abs(value) < LARGEST_NUMBER for value in values):
                raise _unusable(kind, values, f"{n_axes} numbers")
            if kind == "scale":
                scale, shift, has_scale = scale * values, shift * values, True
            else:
                shift = shift + values
    if not has_scale:
        raise InputError("its metadata has no scale, so that the size of its voxels is not known; mend the metadata")
    return scale, shift


def _unusable(what: str, value: Any, expected: str) -> InputError:
    return InputError(f"its OME-Zarr metadata: {what}: expected {expected}, got {plain(repr(value)[:80])}")
