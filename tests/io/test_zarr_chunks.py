"""Zarr of all codecs, and chunks that lie: of their own length, of what they unpack to, of how
many there are.
"""

import json
import struct
import zlib

import numcodecs
import numpy as np
import pytest
import zarr
from numcodecs import AsType, Blosc, Delta, GZip, Shuffle, Zlib
from numpy.testing import assert_array_equal
from refusals import assert_refused
from zarr.codecs import BloscCodec, Crc32cCodec, GzipCodec, ZstdCodec

from tetopt.errors import InputError
from tetopt.io.images import load_image

VALUES = np.arange(1000, dtype="i2").reshape(10, 10, 10)
PACKERS = ("blosc", "zstd", "lz4", "gzip", "zlib", "bz2", "lzma")
LINE = (
    "its voxels .* cannot be read|its chunk .* copy it again|zarr crashed|more than 2.1 GB "
    "of memory"
)
SLOW = pytest.mark.slow
pytestmark = [
    pytest.mark.apart,
    pytest.mark.filterwarnings("ignore"),
]  # of sizes of boxes, and codecs that Zarr 3 has not specified


def packer(name):
    return numcodecs.get_codec({"id": name})


def written(path, fmt, **options):
    """An image of 10^3 voxels in chunks of 4^3, and the file of its first chunk."""
    array = zarr.create_array(
        path,
        data=VALUES,
        chunks=(4, 4, 4),
        zarr_format=fmt,
        fill_value=0,
        attributes={"affine": np.eye(4).tolist()},
        **options,
    )
    return path / array.metadata.encode_chunk_key((0, 0, 0))


KINDS = {
    **{f"2 {name}": (2, {"compressors": packer(name)}) for name in PACKERS},
    "2 none": (2, {"compressors": None}),
    "2 filters": (2, {"compressors": Zlib(), "filters": [Delta("<i2", "<i4"), Shuffle(4)]}),
    "2 other numbers": (2, {"compressors": Blosc(), "filters": [AsType("<i8", "<i2")]}),
    "3 blosc": (3, {"compressors": BloscCodec(cname="lz4")}),
    "3 zstd": (3, {"compressors": ZstdCodec()}),
    "3 gzip": (3, {"compressors": GzipCodec()}),
    "3 checksum": (3, {"compressors": [BloscCodec(), Crc32cCodec()]}),
    "3 shards": (3, {"compressors": BloscCodec(), "shards": (8, 8, 8)}),
}


@pytest.mark.parametrize("kind", KINDS)
def test_voxels_come_back(here, kind):
    fmt, options = KINDS[kind]
    written(here / "a.zarr", fmt, **options)
    assert_array_equal(load_image("a.zarr").data, VALUES)
    assert_array_equal(
        load_image("a.zarr", crop=[(1, 9), (2, 6), (3, 10)]).data,
        VALUES[1:9, 2:6, 3:],
    )


@pytest.mark.deep
@pytest.mark.parametrize(
    "kind", ["2 blosc", *(pytest.param(each, marks=SLOW) for each in ("3 blosc", "3 shards"))]
)
@pytest.mark.parametrize(
    ("offset", "number"),
    [
        (3, 0),
        (4, 2**31 - 1),
        (4, 2000),
        (4, 127),
        (4, 0),
        (8, 0),
        (8, 2**31),
        (12, 2**31 - 1),
        (12, 100_000),
        (12, 0),
    ],
)
def test_a_blosc_header_that_lies(here, kind, offset, number):
    """Blosc may read beyond the chunk's end, which only the child survives: a line, or the right
    voxels.
    """
    fmt, options = KINDS[kind]
    chunk = written(here / "a.zarr", fmt, **options)
    content = bytearray(chunk.read_bytes())
    struct.pack_into("<B" if offset == 3 else "<I", content, offset, number)
    chunk.write_bytes(content)
    try:
        assert_array_equal(load_image("a.zarr").data, VALUES)
    except InputError:
        assert_refused("a.zarr", LINE)


@pytest.mark.deep
@pytest.mark.parametrize(
    "name",
    [pytest.param(each, marks=() if each in ("blosc", "gzip") else SLOW) for each in PACKERS],
)
def test_chunks_that_are_cut(here, name):
    chunk = written(here / "a.zarr", 2, compressors=packer(name))
    content = chunk.read_bytes()
    for length in (0, 1, 4, 5, 6, 15, 16, len(content) - 1):
        chunk.write_bytes(content[:length])
        assert_refused("a.zarr", LINE)


@pytest.mark.parametrize("fmt", [2, 3])
def test_a_bomb_is_refused_in_one_line(here, fmt):
    """A chunk of 32 MB for 128 bytes."""
    chunk = written(here / "a.zarr", fmt, compressors=GZip() if fmt == 2 else GzipCodec())
    chunk.write_bytes(zlib.compress(bytes(2**25), wbits=31))
    assert_refused("a.zarr", LINE)


def changed(path, fmt, **values):
    """The same with other numbers in its metadata."""
    file = path / ("zarr.json" if fmt == 3 else ".zarray")
    metadata = json.loads(file.read_text())
    if fmt == 3 and "chunks" in values:
        metadata["chunk_grid"]["configuration"]["chunk_shape"] = values.pop("chunks")
    file.write_text(json.dumps(metadata | values))


@pytest.mark.parametrize("fmt", [2, 3])
@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"chunks": [0, 4, 4]}, "expected 3 to 32 axes with voxels|chunk shape .* is invalid"),
        ({"shape": [1] * 62 + [10] * 3, "chunks": [1] * 62 + [4] * 3}, "expected 3 to 32 axes"),
        ({"shape": [2000] * 3}, "expected at most 16777216 chunks, got 125000000|memory"),
        ({"shape": [10**6] * 3, "chunks": [10**6] * 3}, "one of its chunks .* memory"),
    ],
)
def test_metadata_that_promises_too_much(here, fmt, values, words):
    written(here / "a.zarr", fmt)
    changed(here / "a.zarr", fmt, **values)
    assert_refused("a.zarr", words)


def test_a_chunk_of_any_length(here):
    chunk = written(here / "a.zarr", 2, compressors=None)
    with chunk.open("r+b") as file:
        file.truncate(2**40)  # a hole, which takes no room
    assert_refused("a.zarr", "its chunk 0.0.0 is not a regular file of at most")
