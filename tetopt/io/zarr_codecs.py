"""Decompression of Zarr chunks to exactly the number of bytes that the array requires.

Codecs trust the header of a chunk: Blosc reads beyond its end, others allocate any amount of memory. Therefore sizes
are checked here, and streams are decompressed only up to the expected size.
"""

from __future__ import annotations

import asyncio
import bz2
import lzma
import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

BLOSC_HEADER = struct.Struct("<4B3I")  # versions, flags, size of an item; total, block and chunk sizes
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
LZMA_BYTES = 2**28  # of memory in addition to the voxels: its highest preset takes 65 MB
PACKERS = ("blosc", "zstd", "lz4", "gzip", "zlib", "bz2", "lzma")


def unpacked(name: str, packed: bytes, n_bytes: int) -> bytes:
    """Return the content of a chunk; ValueError if it is damaged or does not have `n_bytes` bytes."""
    streams: dict[str, Callable[[], Any]] = {
        "gzip": lambda: zlib.decompressobj(zlib.MAX_WBITS | 16),
        "zlib": zlib.decompressobj,
        "bz2": bz2.BZ2Decompressor,
        "lzma": lambda: lzma.LZMADecompressor(memlimit=n_bytes + LZMA_BYTES),
    }
    if name in streams:
        stream = streams[name]()
        value = stream.decompress(packed, n_bytes + 1)
        if not stream.eof and len(value) <= n_bytes:
            raise ValueError("a chunk ends too soon")
    else:
        import numcodecs

        claim = {"blosc": _blosc_bytes, "zstd": _zstd_bytes, "lz4": _lz4_bytes}[name](packed)
        if claim not in (n_bytes, None):
            raise ValueError(f"a chunk declares {claim} bytes, the array {n_bytes}")
        place = np.zeros(n_bytes, np.uint8)
        numcodecs.get_codec({"id": name}).decode(packed, out=place)
        value = place.tobytes()
    if len(value) != n_bytes:
        count = f"more than {n_bytes}" if len(value) > n_bytes else str(len(value))
        raise ValueError(f"a chunk unpacks to {count} bytes, but the array declares {n_bytes}")
    return value


def _blosc_bytes(packed: bytes) -> int:
    """Return the size in a chunk's header after checking its other fields: Blosc itself checks no lengths."""
    if len(packed) < BLOSC_HEADER.size:
        raise ValueError("a chunk ends within its Blosc header")
    *_, item, n_bytes, block, length = BLOSC_HEADER.unpack_from(packed)
    if length != len(packed) or item == 0 or not 0 < block <= n_bytes:
        raise ValueError(f"a chunk of {len(packed)} bytes has a Blosc header of {length}, in blocks of {block}")
    return n_bytes


def _zstd_bytes(packed: bytes) -> int | None:
    """Return the size in the header of the first frame (RFC 8878), if given."""
    if packed[:4] != ZSTD_MAGIC or len(packed) < 6:
        raise ValueError("a chunk is not a Zstandard frame")
    flags = packed[4]
    is_single = flags >> 5 & 1
    begin = 5 + (not is_single) + (0, 1, 2, 4)[flags & 3]
    length = (is_single, 2, 4, 8)[flags >> 6]
    claim = int.from_bytes(packed[begin : begin + length], "little") + (256 if length == 2 else 0)
    return claim if length else None


def _lz4_bytes(packed: bytes) -> int:
    if len(packed) < 5:
        raise ValueError("a chunk is too short for LZ4")
    return int.from_bytes(packed[:4], "little")


def bounded(array: Any) -> Any:
    """Return the same zarr array, with chunks decompressed by `unpacked`."""
    import zarr

    metadata = array.metadata
    if metadata.zarr_format == 3:
        metadata = replace(metadata, codecs=_bounded_codecs(metadata.codecs))
    elif metadata.compressor is not None:
        item = array.dtype.itemsize
        for each in metadata.filters or ():  # in the order of encoding; some change the type of numbers
            config = each.get_config()
            stored = config.get("encode_dtype") or config.get("astype")
            item = np.dtype(stored).itemsize if stored else item
        metadata = replace(metadata, compressor=_classes()[1](metadata.compressor, item * math.prod(array.chunks)))
    return zarr.Array(zarr.AsyncArray(metadata=metadata, store_path=array.store_path))


def _bounded_codecs(codecs: Any) -> tuple[Any, ...]:
    """Wrap the codecs of format 3, including those within shards."""
    from zarr.codecs import ShardingCodec

    changed = []
    for codec in codecs:
        if isinstance(codec, ShardingCodec):
            inner: dict[str, Any] = {name: _bounded_codecs(getattr(codec, name)) for name in ("codecs", "index_codecs")}
            codec = replace(codec, **inner)
        elif _name_of(codec) in PACKERS:
            codec = _classes()[0](codec)
        changed.append(codec)
    return tuple(changed)


def _name_of(codec: Any) -> str:
    return str(codec.to_dict()["name"]).removeprefix("numcodecs.")


@cache
def _classes() -> tuple[Any, Any]:
    """Return codec classes for formats 3 and 2; zarr is imported only when used."""
    from numcodecs.abc import Codec
    from zarr.abc.codec import BytesBytesCodec

    @dataclass(frozen=True)
    class Bounded(BytesBytesCodec):
        inner: Any
        is_fixed_size = False

        def to_dict(self) -> dict[str, Any]:
            return dict(self.inner.to_dict())

        def evolve_from_array_spec(self, array_spec: Any) -> Any:
            return replace(self, inner=self.inner.evolve_from_array_spec(array_spec))

        async def _decode_single(self, chunk_bytes: Any, chunk_spec: Any) -> Any:
            n_bytes = math.prod(chunk_spec.shape) * chunk_spec.dtype.item_size
            name = _name_of(self.inner)
            value = await asyncio.to_thread(unpacked, name, chunk_bytes.to_bytes(), n_bytes)
            return chunk_spec.prototype.buffer.from_bytes(value)

        def compute_encoded_size(self, input_byte_length: int, _chunk_spec: Any) -> int:
            raise NotImplementedError

    class BoundedCompressor(Codec):
        codec_id = "bounded"  # zarr looks for it in the class

        def __init__(self, inner: Any, n_bytes: int) -> None:
            self.codec_id, self.n_bytes = inner.codec_id, n_bytes

        def encode(self, buf: Any) -> Any:
            raise NotImplementedError

        def decode(self, buf: Any, out: Any = None) -> Any:
            return unpacked(self.codec_id, bytes(buf), self.n_bytes)

    return Bounded, BoundedCompressor
