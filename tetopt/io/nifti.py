"""Reading of NIfTI, as single files and as pairs (.hdr, .img), and of MGH, plain or in gzip.

nibabel reads the headers and scales the voxels. Files are opened here, so that sizes are checked
before memory is allocated, and a gzip file is unpacked only once, to the checksum at its end.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import logging
import math
import re
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from nibabel import imageglobals
from nibabel.arrayproxy import ArrayProxy
from nibabel.freesurfer.mghformat import MGHError, MGHHeader
from nibabel.nifti1 import Nifti1PairHeader
from nibabel.nifti2 import Nifti2PairHeader
from nibabel.spatialimages import HeaderDataError
from nibabel.spm99analyze import Spm99AnalyzeHeader
from nibabel.wrapstruct import WrapStructError
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.fields.field import Convention
from tetopt.image import shifted_affine
from tetopt.io.apart import DEFLATE_RATIO
from tetopt.io.contradictions import note_other_place, note_rest
from tetopt.io.units import mm_of_axes, note_size
from tetopt.io.volumes import (
    DAMAGED_FILE,
    TOO_LONG,
    TRAILING_BYTES,
    UNREADABLE_FILE,
    Reader,
    Request,
    Voxels,
    check_room,
    note,
    one_line,
    plane_affine,
    volume_index,
)
from tetopt.system.arrays import Floats, Shape
from tetopt.system.incoming import irregular

NIFTI_HEAD_BYTES = 1024  # read from a file: the longest header has 540
EXTENSION_BYTES = 2**26  # 67 MB before the voxels: a NIfTI file's extensions are texts
PLANES_BYTES = 2**28  # of a file, read at a time for a crop of it
MGH_FLAG = slice(28, 30)  # the bytes of an MGH header that are 0 if it has no sizes and directions
CIFTI_INTENTS = range(3000, 3100)  # of NIfTI-2 files without a grid of voxels
MATRIX_INTENT = 1005  # of NIfTI: components of a symmetric matrix
PACKED_SUFFIXES = (".gz", ".mgz")
CARET = re.compile(rb"<CaretExtension.*?</CaretExtension>", re.DOTALL)  # names of labels
PAIR = re.compile(r"(.*)\.(hdr|img)(\.gz)?", re.IGNORECASE | re.DOTALL)
HEADER_KINDS: dict[str, tuple[Any, ...]] = {
    ".nii": (nibabel.Nifti1Header, nibabel.Nifti2Header),
    ".hdr": (Nifti1PairHeader, Nifti2PairHeader, Spm99AnalyzeHeader),
    ".mgh": (MGHHeader,),
    ".mgz": (MGHHeader,),
}
# Errors for damaged files.
FILE_ERRORS = (OSError, EOFError, zlib.error)
DATA_ERRORS = (*FILE_ERRORS, ValueError, TypeError, OverflowError)
HEADER_ERRORS = (*DATA_ERRORS, KeyError, HeaderDataError, WrapStructError, MGHError)


def read_nibabel(path: Path, request: Request) -> Voxels:
    """Return data and affine, 2-D or 3-D; InputError without a leading path."""
    header_file, voxel_file = _files_of(path)
    header, head = _header_of(header_file)
    shape = _shape_of(header)
    affine = _affine_of(header, shape, head)
    volume_index(shape[3:], request.volume)
    bounds = request.box(shape[:3])
    data = _voxels(voxel_file, header, shape, request.volume or 0, bounds)
    start = [first for first, _ in bounds]
    affine = shifted_affine(affine, start + [0] * (3 - len(start))) if any(start) else affine
    if data.ndim == 2:
        return data, plane_affine(affine[:3, :2], affine[:3, 3])
    return data, affine


def _affine_of(header: Any, shape: Shape, head: bytes) -> Floats:
    _note_place(header, shape, head)
    lengths = _units(header)
    affine = np.array(header.get_best_affine(), dtype=np.float64)
    affine[:3] *= 1.0 if lengths is None else lengths[:, None]
    note_size(shape, affine, lengths)
    return affine


def nifti_components(path: Path) -> tuple[NDArray, Floats, Convention]:
    """Return all volumes of a file, along the fourth axis or beyond, as components.

    The standard has rows of the lower triangle in files whose intent is a symmetric matrix (1005),
    and nowhere axes.
    """
    header_file, voxel_file = _files_of(path)
    header, head = _header_of(header_file)
    shape = _shape_of(header)
    affine = _affine_of(header, shape, head)
    is_matrix = (
        isinstance(header, nibabel.Nifti1Header) and int(header["intent_code"]) == MATRIX_INTENT
    )
    # volumes follow one another like planes
    planes = (*shape[:2], math.prod(shape[2:]))
    data = _voxels(voxel_file, header, planes, 0, [(0, size) for size in planes])
    data = data.reshape((*shape[:3], -1), order="F")
    return data, affine, Convention(order="lower" if is_matrix else None)


def nibabel_shape(path: Path) -> Shape:
    """Return the lengths of all axes in the header."""
    return _shape_of(_header_of(_files_of(path)[0])[0])


def label_text(path: Path) -> str:
    """Return the XML of names of labels in a header's extensions, whatever their codes; empty
    without any.
    """
    file, other = _files_of(path)
    header, _ = _header_of(file)
    if not isinstance(header, nibabel.Nifti1Header):
        return ""
    size = EXTENSION_BYTES if file != other else int(header["vox_offset"])
    match = CARET.search(_begin_of(file, size))
    return "" if match is None else match[0].decode("utf-8", "replace")


def _shape_of(header: Any) -> Shape:
    return tuple(int(size) for size in header.get_data_shape())


def other_file(path: Path) -> list[Path]:
    """Return the other file of a pair; empty for single files.

    Raises
    ------
    InputError
        Without a leading path: it is missing.
    """
    match = PAIR.fullmatch(path.name)
    if match is None:
        return []
    stem = match[1]
    kind = match[2].lower()
    packed = (match[3] or "").lower()
    other = "img" if kind == "hdr" else "hdr"
    # With the same packing first; of .IMG, .HDR.
    for suffix in (f".{other}{packed}", f".{other}", f".{other}.gz"):
        for name in (stem + suffix, stem + suffix.upper()):
            if (file := path.with_name(name)).exists():
                if (what := irregular(file)) is not None:
                    raise InputError(f'its other file "{name}" is {what}; expected a regular file')
                return [file]
    has = "voxels" if other == "img" else "header, with its place and voxel sizes,"
    raise InputError(
        f"expected two files: its {has} should be in {stem}.{other} (or {stem}.{other}.gz) next "
        "to it; copy both"
    )


NIFTI = Reader(
    (".nii.gz", ".nii", ".mgz", ".mgh", ".hdr", ".img", ".hdr.gz", ".img.gz"),
    read_nibabel,
    shape=nibabel_shape,
    other_files=other_file,
    reads_crop=True,
    components=nifti_components,
)


def _files_of(path: Path) -> tuple[Path, Path]:
    """Return the file with the header and the file with the voxels."""
    files = [path, *other_file(path)]
    if ".hdr" not in path.name.lower()[-7:]:
        files.reverse()
    return files[0], files[-1]


@contextlib.contextmanager
def _note_nibabel() -> Iterator[None]:
    """Note nibabel's log messages of this thread, which are then not printed."""
    thread = threading.get_ident()

    def keep(record: logging.LogRecord) -> bool:
        if record.thread != thread:
            return True
        if record.levelno >= logging.WARNING:
            word = one_line(record.getMessage())
            note(f"nibabel repaired its header ({word}); check its voxel sizes and position")
        return False

    imageglobals.logger.addFilter(keep)
    try:
        yield
    finally:
        imageglobals.logger.removeFilter(keep)


def _begin_of(path: Path, n_bytes: int) -> bytes:
    """Return the first bytes of a file, unpacked."""
    try:
        is_packed = path.name.lower().endswith(PACKED_SUFFIXES)
        with gzip.open(path) if is_packed else path.open("rb") as stream:
            return stream.read(n_bytes)
    except FILE_ERRORS as error:
        raise _of_gzip(error) from error


@_note_nibabel()
def _header_of(path: Path) -> tuple[Any, bytes]:
    """Return nibabel's header, checked and repaired, and the first bytes of the file."""
    head = _begin_of(path, NIFTI_HEAD_BYTES)
    suffix = path.name.lower().removesuffix(".gz")[-4:]
    try:
        for kind in HEADER_KINDS[suffix]:
            if kind is not MGHHeader and not kind.may_contain_header(head):
                continue
            # Extensions are not read: only their length matters.
            header = kind.from_fileobj(io.BytesIO(head[: kind.template_dtype.itemsize]))
            if isinstance(header, nibabel.Nifti1Header):
                _check_nifti(header)
            elif kind is not MGHHeader and path.with_suffix(".mat").exists():
                raise InputError(
                    "an Analyze image whose place is in a .mat file; convert it to NIfTI with SPM"
                )
            return header, head
    except InputError:
        raise
    except HEADER_ERRORS as error:
        raise InputError(f"{UNREADABLE_FILE} ({one_line(error)})") from error
    raise InputError(UNREADABLE_FILE)


def _check_nifti(header: Any) -> None:
    is_cifti = int(header["intent_code"]) in CIFTI_INTENTS
    if is_cifti and isinstance(header, nibabel.Nifti2Header):
        raise InputError("expected an image on a voxel grid, got a Cifti2Image")
    offset = float(header["vox_offset"])
    if not 0.0 <= offset <= EXTENSION_BYTES:
        raise InputError(f"{DAMAGED_FILE} (its voxels would begin at byte {offset:g})")


def _note_place(header: Any, shape: Shape, head: bytes) -> None:
    """Note a header without orientation, which nibabel guesses, or with two."""
    if not isinstance(header, nibabel.Nifti1Header):
        if not isinstance(header, MGHHeader):
            note(
                "an Analyze image, whose format does not tell left from right: assuming x to the "
                "left, as nibabel does; if it matters, convert it to NIfTI"
            )
        elif not any(head[MGH_FLAG]):
            note(
                "has no orientation: its voxel sizes (1 mm), position and left/right are "
                "nibabel's guess"
            )
        return
    if not (int(header["sform_code"]) or int(header["qform_code"])):
        note(
            "has no orientation: position and left/right are nibabel's guess; if they matter, "
            "convert it again with its sform or qform"
        )
    note_other_place(header, shape)


def _units(header: Any) -> Floats | None:
    """Return the length of the file's unit, mm, for each axis; None if it states none."""
    if not isinstance(header, nibabel.Nifti1Header):
        return None
    try:
        unit = header.get_xyzt_units()[0]
    except KeyError:
        note(f"its unit of length has the unknown code {header['xyzt_units'] % 8}: assuming mm")
        return None
    return mm_of_axes([unit.replace("unknown", "")] * 3, "xyzt_units")


def _voxels(
    path: Path,
    header: Any,
    shape: Shape,
    volume: int,
    bounds: list[tuple[int, int]],
) -> NDArray:
    """Return the scaled values of a box of a volume; InputError unless the file can hold all up to
    this volume, before memory is allocated.
    """
    dtype = header.get_data_dtype()
    offset = int(header.get_data_offset())
    size = path.stat().st_size
    volume_bytes = math.prod(shape[:3]) * dtype.itemsize
    whole = offset + math.prod(shape[3:]) * volume_bytes
    begin = offset + volume * volume_bytes
    end = begin + volume_bytes
    is_packed = path.name.lower().endswith(PACKED_SUFFIXES)
    too_short = InputError(
        f"{DAMAGED_FILE} (its header declares {' x '.join(map(str, shape))} voxels, {end:.4g} "
        f"bytes, but the file has {size})"
    )
    if min(shape) < 0 or end > size * (DEFLATE_RATIO if is_packed else 1):
        raise too_short
    # The planes of the box are read, or of a 2-D image its columns.
    first, last = bounds[-1]
    sides = (*shape[: len(bounds) - 1], last - first)
    step = math.prod(sides[:-1]) * dtype.itemsize
    check_room(sides if is_packed else [stop - start for start, stop in bounds], dtype.itemsize)
    begin += first * step
    source: io.BytesIO | str
    if is_packed:
        size, source = _unpack_gzip(
            path, begin, begin + (last - first) * step, whole + TRAILING_BYTES
        )
        begin = 0
    else:
        source = str(path.absolute())  # nibabel expands a leading ~ to the home folder
    if size > whole + TRAILING_BYTES:  # its checksum would cover all of it
        raise InputError(TOO_LONG.format(whole + TRAILING_BYTES))
    if end > size:
        raise too_short
    if not isinstance(header, MGHHeader):  # MGH has tags there
        note_rest(size - whole, shape, dtype.itemsize)
    try:
        slope, inter = header.get_slope_inter()
        scale = (1.0 if slope is None else slope, 0.0 if inter is None else inter)
        proxy = ArrayProxy(source, (sides, dtype, begin, *scale))
        if sides == tuple(stop - start for start, stop in bounds):
            return np.asanyarray(proxy)
        within = tuple(slice(*ends) for ends in bounds[:-1])
        n_planes = max(PLANES_BYTES // step, 1)
        parts = [
            np.asanyarray(proxy[..., k : k + n_planes])[within]
            for k in range(0, last - first, n_planes)
        ]
        return np.concatenate(parts, axis=-1)
    except MemoryError as error:
        raise InputError("its voxels do not fit into memory; crop it to fewer") from error
    except (*DATA_ERRORS, HeaderDataError) as error:
        raise InputError(f"{DAMAGED_FILE} ({one_line(error)})") from error


def _unpack_gzip(path: Path, begin: int, end: int, most: int) -> tuple[int, io.BytesIO]:
    """Unpack a gzip file to its end, in blocks; return its size and its bytes from `begin` to
    `end`.

    Nothing is kept of the rest, and nothing is unpacked beyond `most`.
    """
    n_bytes = 0
    part = io.BytesIO()
    try:
        with gzip.open(path) as stream:
            while n_bytes <= most and (block := stream.read(1 << 20)):
                part.write(block[max(begin - n_bytes, 0) : max(end - n_bytes, 0)])
                n_bytes += len(block)
        return n_bytes, part
    except FILE_ERRORS as error:
        raise _of_gzip(error) from error


def _of_gzip(error: Exception) -> InputError:
    if "Not a gzipped file" in str(error):
        return InputError(
            "not a gzip file; if it is not compressed, remove .gz (or z) from its name"
        )
    return InputError(f"{DAMAGED_FILE} ({one_line(error)})")
