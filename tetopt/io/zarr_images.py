"""Zarr arrays and OME-Zarr images in local folders: axes, scales and translations of voxels.

NGFF 0.4 and 0.5 (https://ngff.openmicroscopy.org) define axes, units, scales and translations; indices keep the order
of the array's spatial axes. Voxels are not read here; chunks are counted.
"""

from __future__ import annotations

import itertools
import math
import os
import stat
import warnings
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tetopt.errors import InputError
from tetopt.image import Image, checked_affine
from tetopt.io.apart import read_apart
from tetopt.io.contradictions import SAME_SIZE, SAME_VOXELS, sizes_words
from tetopt.io.text import plain
from tetopt.io.units import mm_of_axes, notes_of_size
from tetopt.io.volumes import DAMAGED_FILE, VoxelsInFile, one_line, volume_index
from tetopt.system.budget import check_memory
from tetopt.system.extras import install_hint
from tetopt.system.files import folder_written_whole
from tetopt.system.incoming import LARGEST_NUMBER, TEXT_BYTES, irregular

ZARR_SUFFIX = ".zarr"
NODE_FILES = ("zarr.json", ".zarray", ".zgroup")  # every Zarr array and group, of version 3 or 2, has one of these
METADATA_FILES = (*NODE_FILES, ".zattrs", ".zmetadata")
MOST_CHUNKS = 2**24  # in an image: their names are looked up in a minute or two; 2048^3 voxels have 4,096 of 128^3
MOST_SPARSE = 1000  # chunks per existing chunk: an almost empty image would take long
# In a chunk's file: headers of codecs, and per voxel a number of 8 bytes and the overhead of shards and codecs.
PACKED_BYTES, PACKED_VOXEL_BYTES = 2**16, 32
CHUNK_EDGE = 128  # voxels, in written files: 4 MB of 16 bits, and a part of a mesh reads a few chunks
MOST_LEVELS = 64  # in a multiscale: more than halving any volume can give
# Direction of an axis in RAS+, by its orientation (NGFF's RFC-4): row of the affine and sign.
WAYS_OF_BODY = {
    "left-to-right": (0, 1.0), "right-to-left": (0, -1.0), "posterior-to-anterior": (1, 1.0),
    "anterior-to-posterior": (1, -1.0), "inferior-to-superior": (2, 1.0), "superior-to-inferior": (2, -1.0),
}  # fmt: skip
ARRAY_AXES = 32  # at most in an array, the limit of the oldest supported numpy
# Codecs from numbers to as many numbers. Others, such as numcodecs' pickle, would let a file run any code.
KNOWN_CODECS = (
    "blosc", "zstd", "lz4", "gzip", "zlib", "bz2", "lzma", "bytes", "endian", "transpose", "sharding_indexed", "crc32c",
    "shuffle", "delta", "bitround", "fixedscaleoffset", "quantize", "astype",
)  # fmt: skip


class ZarrLevel(NamedTuple):
    """One array of an image, with its placement."""

    folder: Path
    array: Any
    names: tuple[str, ...]  # of all axes
    space: tuple[int, ...]  # the three spatial axes, in order
    affine: NDArray[np.float64]  # (4, 4), from indices along these three axes to world, mm

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along the three spatial axes."""
        return tuple(int(self.array.shape[axis]) for axis in self.space)

    @property
    def others(self) -> tuple[int, ...]:
        """The axes that are not spatial."""
        return tuple(axis for axis in range(len(self.names)) if axis not in self.space)


def is_zarr(path: Path) -> bool:
    """Return whether a path is a Zarr folder, by its name or its contents."""
    return path.is_dir() and (path.name.lower().endswith(ZARR_SUFFIX) or is_node(path))


def is_node(path: Path) -> bool:
    """Return whether a folder is a Zarr array or group, by its contents."""
    return any((path / name).exists() for name in NODE_FILES)


def open_zarr(level: ZarrLevel, volume: int | None) -> Image:
    """Open one volume of a level, without reading voxels.

    Raises
    ------
    InputError
        Without a leading path: there are several volumes and no `volume`, or it is out of range.
    """
    words = ", ".join(f"{level.names[axis]} ({level.array.shape[axis]})" for axis in level.others)
    # The last axis varies fastest, as in the file.
    index = volume_index([level.array.shape[axis] for axis in level.others[::-1]], volume, words)[::-1]
    picks: list[int | slice] = [slice(0, int(size)) for size in level.array.shape]
    for axis, at in zip(level.others, index, strict=True):
        picks[axis] = at
    voxels = VoxelsInFile(level.folder, _guarded(level.array), tuple(picks), level.array.chunks)
    return Image.stored(voxels, level.affine)


def read_chunks(voxels: VoxelsInFile) -> NDArray:
    """Read all of these voxels in a child process, as compiled codecs trust the headers of chunks.

    Raises
    ------
    InputError
        Without a leading path: chunks are damaged, or a codec crashes on them.
    """
    picks = [[pick.start, pick.stop] if isinstance(pick, slice) else pick for pick in voxels.picks]
    n_bytes = math.prod(voxels.shape) * voxels.dtype.itemsize
    values: NDArray = read_apart(_values, voxels.path, picks, size=n_bytes, value_bytes=n_bytes, library="zarr")
    return values


def _values(folder: str, picks: list[list[int] | int]) -> NDArray:
    """Return a part of an array, in the child."""
    parts = tuple(slice(*pick) if isinstance(pick, list) else pick for pick in picks)
    voxels = VoxelsInFile(Path(folder), _guarded(_node(Path(folder))), parts)
    return voxels[tuple(slice(0, size) for size in voxels.shape)]


def zarr_levels(path: Path, notes: list[str]) -> list[ZarrLevel]:
    """Return the arrays of an image, the finest first: those of OME-Zarr's first multiscale, or a single array.

    Raises
    ------
    InputError
        Without a leading path: zarr is not installed; the folder or its metadata do not describe a 3-D image with a
        scale.
    """
    node = _node(path)
    if hasattr(node, "shape"):
        return [_single(path, node)]
    attributes = node.attrs.asdict()
    ome = attributes.get("ome", attributes)
    scales = ome.get("multiscales") if isinstance(ome, dict) else None
    if not isinstance(scales, list) or not scales or not isinstance(scales[0], dict):
        inside = sorted(child.name for child in path.iterdir() if is_node(child))
        listed = f"; choose one of its members: {', '.join(inside[:8])}" if inside else ", and it is empty"
        raise InputError(f"this Zarr group has no OME-Zarr image (multiscales){listed}")
    datasets, axes = scales[0].get("datasets"), scales[0].get("axes")
    if not isinstance(datasets, list) or not 0 < len(datasets) <= MOST_LEVELS:
        raise _unusable("datasets", datasets, "a list of its arrays")
    if not isinstance(axes, list) or not all(isinstance(axis, dict) for axis in axes):
        raise _unusable("axes", axes, "a list of axes with names, as in NGFF 0.4 and 0.5")
    after = scales[0].get("coordinateTransformations", [])
    places = _Places(axes)
    levels = [_level(path, each, after, axes, places) for each in datasets]
    own = _own_affine(levels[0].array)
    if own is None:
        notes += places.notes + notes_of_size(levels[0].shape, levels[0].affine, places.mm)
        return levels
    notes += _notes_of_own(own, levels[0].affine)
    notes += notes_of_size(levels[0].shape, own, np.ones(3))
    # NGFF 0.5 has no rotations: the attribute of the first level places all levels.
    turn = own @ np.linalg.inv(levels[0].affine)
    return [levels[0]._replace(affine=own), *(each._replace(affine=turn @ each.affine) for each in levels[1:])]


def save_zarr(path: Path, image: Image, voxels: Any, dtype: DTypeLike) -> tuple[float, float]:
    """Write an OME-Zarr image (NGFF 0.5, Zarr's format 3) chunk by chunk, whole or not at all.

    Its axes are named x, y, z in the order of the indices. Scale and translation are the lengths of a voxel's edges and
    the position of the first voxel, which is all that NGFF supports; the attribute "affine" has the whole affine.

    Parameters
    ----------
    path : Path
        Replaces an existing Zarr folder; call `tetopt.system.files.checked_output` first.
    image : Image
        Gives the placement; three-dimensional.
    voxels : Any
        Returns voxels for a tuple of slices, chunk by chunk.
    dtype : dtype
        Type for storage; values are rounded for an integer type.

    Returns
    -------
    tuple of float
        The smallest and the largest value.

    Raises
    ------
    InputError
        zarr is not installed; the image is not 3-D; values exceed the range of the dtype.
    OSError
        For the reasons of `tetopt.system.files.folder_written_whole`.
    """
    zarr = _library()
    if image.ndim != 3:
        raise InputError(f"{path}: expected a 3-D image for Zarr, got a {image.ndim}-D one; use .nii.gz")
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


def _guarded(array: Any) -> Any:
    """Return the same array, of chunks with at least the length that Blosc, which reads beyond their end, expects."""
    if "blosc" not in _codec_names(array.metadata.to_dict()):
        return array
    zarr = _library()
    store = _guarded_store(array.shards is not None)(array.store_path.store.root, read_only=True)
    return zarr.Array(zarr.AsyncArray(metadata=array.metadata, store_path=zarr.storage.StorePath(store, array.path)))


@cache
def _guarded_store(has_shards: bool) -> Any:
    """Return the class of a folder of chunks, or of shards, which end in an index of them."""
    from zarr.abc.store import SuffixByteRequest
    from zarr.storage import LocalStore

    class GuardedStore(LocalStore):
        async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
            value = await super().get(key, prototype, byte_range)
            is_index = isinstance(byte_range, SuffixByteRequest) or (has_shards and byte_range is None)
            if value is None or is_index or key.rpartition("/")[2] in METADATA_FILES:
                return value
            length = int.from_bytes(value.to_bytes()[12:16], "little")
            if len(value) < length:  # a checksum may follow
                raise ValueError(f"a chunk has {len(value)} bytes, its Blosc header {length}")
            return value

    return GuardedStore


def _stored_values(path: Path, block: NDArray, dtype: np.dtype) -> NDArray:
    """Convert values for storage; InputError if they do not fit."""
    if dtype.kind not in "iu":
        return block.astype(dtype)
    block, limits = np.rint(block), np.iinfo(dtype)
    if block.min() < limits.min or block.max() > limits.max:
        raise InputError(
            f"{path}: expected values from {limits.min} to {limits.max} for {dtype}, got {block.min():g} to "
            f"{block.max():g}; scale them"
        )
    return block.astype(dtype)


def _multiscale(image: Image) -> dict[str, Any]:
    """Return NGFF's multiscale metadata for one array of voxels."""
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
        raise InputError(f"Zarr folders need the zarr library; {install_hint('zarr', 'zarr')}") from error
    return zarr


def _level(path: Path, dataset: Any, after: Any, axes: list[dict], places: _Places) -> ZarrLevel:
    """Return one dataset of a multiscale."""
    name = dataset.get("path") if isinstance(dataset, dict) else None
    if not isinstance(name, str):
        raise _unusable("path", name, "the name of an array within the folder")
    parts = PurePosixPath(name).parts
    if not parts or ".." in parts or parts[0] == "/" or "\\" in name or ":" in name or "\0" in name:
        raise _unusable("path", name, "the name of an array within the folder")
    folder = path.joinpath(*parts)
    if not is_node(folder):
        raise InputError(f'{DAMAGED_FILE} (its array "{plain(name)}" is missing)')
    array = _node(folder)
    if not hasattr(array, "shape"):
        raise _unusable("path", name, "the name of an array")
    if len(array.shape) != len(axes):
        raise InputError(f"its metadata has {len(axes)} axes, its array {len(array.shape)}; correct the metadata")
    _check_array(array)
    scale, shift = _scale_and_shift([dataset.get("coordinateTransformations"), after], len(axes))
    return ZarrLevel(folder, array, places.names, places.space, places.affine(scale, shift))


def _single(path: Path, array: Any) -> ZarrLevel:
    """Return a single array, whose first three axes are spatial."""
    if len(array.shape) < 3:
        raise InputError(f"expected an array with three axes, got shape {array.shape}")
    _check_array(array)
    affine = _own_affine(array)
    if affine is None:
        raise InputError(
            "this Zarr array has no scale; give the folder of its OME-Zarr image, or give it the "
            'attribute "affine", 4 x 4 numbers from index to world in mm'
        )
    names = tuple(f"axis {axis}" for axis in range(len(array.shape)))
    return ZarrLevel(path, array, names, (0, 1, 2), affine)


def _own_affine(array: Any) -> NDArray[np.float64] | None:
    """Return the attribute "affine" of an array, (4, 4), for its spatial axes in order."""
    affine = array.attrs.asdict().get("affine")
    return None if affine is None else checked_affine(affine, 3)


def _notes_of_own(own: NDArray[np.float64], scaled: NDArray[np.float64]) -> list[str]:
    """Return a warning if scale and translation, which state no directions, differ from an affine."""
    sizes = [np.linalg.norm(each[:3, :3], axis=0) for each in (own, scaled)]
    is_near = np.allclose(own[:3, 3], scaled[:3, 3], atol=SAME_VOXELS * sizes[0].min())
    if is_near and np.allclose(sizes[0], sizes[1], rtol=SAME_SIZE):
        return []
    words = [
        f"voxels of {sizes_words(size)} mm at ({', '.join(f'{x:.6g}' for x in each[:3, 3])})"
        for size, each in zip(sizes, (own, scaled), strict=True)
    ]
    return [f'its attribute "affine" has {words[0]}, its scale and translation {words[1]}; the first is used, check it']


def _node(path: Path) -> Any:
    """Open the array or group in a folder with zarr."""
    zarr = _library()
    for name in METADATA_FILES:
        file = path / name
        if file.exists() and ((other := irregular(file)) is not None or file.stat().st_size > TEXT_BYTES):
            raise InputError(f"its {name} is {other or 'too long'}; expected JSON text")
    if not is_node(path):
        raise InputError(f"no Zarr array in this folder: expected one of {', '.join(NODE_FILES)}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about other files in the folder
            # From 3.4 on zarr reads chunks of no voxels as chunks of one, with a warning.
            warnings.filterwarnings("error", message="(?s).*stored chunk shape .* is invalid")
            return zarr.open(zarr.storage.LocalStore(path, read_only=True), mode="r", use_consolidated=False)
    except Exception as error:  # zarr raises any error on damaged metadata; a missing codec is named
        raise InputError(f"its Zarr metadata cannot be read ({plain(one_line(error)[:200])}); copy it again") from error


def _check_array(array: Any) -> None:
    """Raise InputError for values that are not numbers, no voxels, unsupported codecs and chunks larger than memory."""
    dtype = array.dtype
    if getattr(dtype, "kind", "") not in tuple("buif") or dtype.names is not None:
        raise InputError(f"expected one real number per voxel, got {plain(str(dtype))}; convert it first")
    if len(array.shape) > ARRAY_AXES:
        raise InputError(f"expected at most {ARRAY_AXES} axes, got {len(array.shape)}; write it again with fewer")
    if 0 in (*array.shape, *array.chunks, *(array.shards or ())):
        raise InputError(f"expected voxels along every axis, got shape {array.shape} in chunks of {array.chunks}")
    names = _codec_names(array.metadata.to_dict())
    unknown = sorted({name for name in names if name not in KNOWN_CODECS})
    if unknown:
        raise InputError(f"unsupported codecs in its chunks: {plain(', '.join(unknown))}; write it again with others")
    shape = " x ".join(str(size) for size in array.chunks)
    n_bytes = math.prod(array.chunks) * dtype.itemsize
    check_memory(n_bytes, f"one of its chunks of {shape} voxels", "write it again with smaller chunks")


def _codec_names(metadata: Any) -> list[str]:
    """Return the names of all codecs of chunks, including those within shards, without the library's prefix."""
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
    """Check that the chunks of these voxels exist and are regular files.

    Writers omit chunks that contain only the fill value; therefore some missing chunks only add to `notes`, but if all
    are missing it is an error.

    Raises
    ------
    InputError
        Without a leading path: the chunks are invalid.
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
        raise InputError(f"expected at most {MOST_CHUNKS} chunks, got {n_chunks}; write it again with larger chunks")
    folder = str(voxels.path)
    for place in itertools.product(*ranges):
        name = array.metadata.encode_chunk_key(place)
        try:
            status = os.stat(f"{folder}/{name}")
        except (FileNotFoundError, NotADirectoryError):
            n_missing += 1
            continue
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"its chunk {name} is not a regular file; copy its data into a file")
        if status.st_size > most_bytes:
            raise InputError(f"its chunk {name} has {status.st_size} bytes, more than {most_bytes}; copy it again")
    if n_missing == 0:
        return
    if n_missing == n_chunks:
        raise InputError(f"all of its {n_chunks} chunks are missing; copy it again, with its whole folder")
    if n_chunks > MOST_SPARSE * (n_chunks - n_missing):
        raise InputError(
            f"only {n_chunks - n_missing} of its {n_chunks} chunks exist; copy it again, or crop it to them"
        )
    fill = array.fill_value
    if fill is None or not np.isfinite(fill):
        raise InputError(f"{n_missing} of its {n_chunks} chunks are missing, and it has no fill value; copy it again")
    notes.append(
        f"{n_missing} of its {n_chunks} chunks are missing; their voxels get its fill value, {fill:g}; "
        "copy it again if it should have values there"
    )


class _Places:
    """The spatial axes of a multiscale, with their directions and units."""

    def __init__(self, axes: list[dict]) -> None:
        self.notes: list[str] = []
        self.names = tuple(plain(str(axis.get("name"))) for axis in axes)
        kinds = [axis.get("type", "space" if axis.get("name") in ("x", "y", "z") else None) for axis in axes]
        self.space = tuple(number for number, kind in enumerate(kinds) if kind == "space")
        if len(self.space) != 3:
            raise InputError(
                f"expected three spatial axes, got {len(self.space)} among {', '.join(self.names)}; only 3-D Zarr "
                "images are supported"
            )
        inside = [axes[number] for number in self.space]
        self.mm = _mm_of(inside, self.notes)
        ways = [WAYS_OF_BODY.get(_orientation(axis)) for axis in inside]
        self.ways = [way for way in ways if way is not None]
        if len(self.ways) < 3:
            letters = [str(axis.get("name")).lower() for axis in inside]
            if sorted(letters) != ["x", "y", "z"]:
                raise _unusable("names of axes", ", ".join(letters), "x, y and z, or axes with an orientation")
            self.ways = [("xyz".index(letter), 1.0) for letter in letters]
            self.notes.append(
                "has no orientation: assuming x, y and z are right, anterior and superior; if left/right "
                "matters, give its axes an orientation (NGFF's RFC-4)"
            )
        if len({row for row, _ in self.ways}) < 3:
            raise _unusable("orientation", [_orientation(axis) for axis in inside], "three different directions")

    def affine(self, scale: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the affine from index to world mm, (4, 4), for a scale and translation in the units of the axes."""
        affine = np.zeros((4, 4))
        affine[3, 3] = 1.0
        lengths = np.ones(3) if self.mm is None else self.mm
        for column, (axis, (row, sign), mm) in enumerate(zip(self.space, self.ways, lengths, strict=True)):
            affine[row, column] = sign * mm * scale[axis]
            affine[row, 3] = sign * mm * shift[axis]
        return checked_affine(affine, 3)


def _mm_of(axes: list[dict], notes: list[str]) -> NDArray[np.float64] | None:
    """Return the lengths of the axes' units, mm; None if no axis has one."""
    units = [axis.get("unit") for axis in axes]
    for unit in units:
        if not isinstance(unit, str | None):
            raise _unusable("unit", unit, "one of NGFF's lengths, such as micrometer or millimeter")
    if not any(units):
        notes.append("has no unit on its axes: assuming mm")
    return mm_of_axes([unit or "" for unit in units], "its OME-Zarr metadata: unit", notes)


def _orientation(axis: dict) -> str:
    value = axis.get("orientation")
    return str(value.get("value") if isinstance(value, dict) else value)


def _scale_and_shift(lists: list[Any], n_axes: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Combine successive scales and translations."""
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
        raise InputError("its metadata has no scale, so its voxel size is unknown; correct the metadata")
    return scale, shift


def _unusable(what: str, value: Any, expected: str) -> InputError:
    return InputError(f"its OME-Zarr metadata: {what}: expected {expected}, got {plain(repr(value)[:80])}")
