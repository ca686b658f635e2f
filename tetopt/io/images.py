"""Reading of images: NIfTI, MGZ, NRRD, MetaImage, DICOM and 2-D pictures, each to an `Image` in
RAS+ millimetres.
"""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import io
import math
import os
import re
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import nibabel
import numpy as np
from numpy.typing import NDArray

from tetopt.contents.padding import replace_padding
from tetopt.errors import InputError, Remark, prefix_errors, warn
from tetopt.image import Image
from tetopt.io.nifti import NIFTI
from tetopt.io.other_images import ARRAYS, GRIDS, LEGACY, VTI
from tetopt.io.read_dicom import DICOM, is_dicom
from tetopt.io.read_itk import ITK
from tetopt.io.stacks import PICTURES, SLICES, check_spacing, slice_files
from tetopt.io.volumes import Reader, Request, collect_notes, note, one_line, plane_affine
from tetopt.io.zarr_images import (
    METADATA_FILES,
    ZARR,
    ZARR_SUFFIX,
    image_folder,
    is_zarr,
    save_zarr,
)
from tetopt.system.files import check_suffix, save_bytes
from tetopt.system.incoming import irregular

Bounds = Sequence[tuple[int | None, int | None]]
"""One half-open (start, stop) range of voxel indices per axis; None means an open end."""

OUTPUT_SUFFIXES = (".nii", ".nii.gz", ".mgz", ".nrrd")
NRRD_TYPES = {"u1": "uint8", "i2": "int16", "i4": "int32", "f4": "float"}  # others are double

GZIP_LEVEL = 1  # nibabel's compression level
MOST_OF_NIFTI_1 = 32767  # voxels along an axis, of 16 bits; NIfTI-2 allows more
BEGINNING_BYTES = 512  # of a file: HTML pages begin with a tag, after at most some blanks
WEB_BEGINNINGS = (b"<!doctype html", b"<html", b"<head", b"<body")
GZIP_BEGINNING = b"\x1f\x8b"
PACKED_NAMES = {".mgh": ".mgz"} | {each: f"{each}.gz" for each in (".nii", ".hdr", ".img")}


def load_image(
    path: str | Path,
    *,
    volume: int | None = None,
    slice_: tuple[int, int] | None = None,
    crop: Bounds | None = None,
    spacing_mm: float | Sequence[float] | None = None,
) -> Image:
    """Read an image from a file, or from a folder of Zarr or of DICOM slices, in RAS+ millimetres.

    The suffix, in any case, decides the format: nibabel reads NIfTI, also
    as a pair (.hdr, .img), and MGZ; SimpleITK (the extra
    ``tetopt[itk]``) reads NRRD and MetaImage; pydicom (``tetopt[dicom]``) reads DICOM; Pillow reads
    2-D pictures and folders with one of them per slice, tifffile (``tetopt[tiff]``) TIFF stacks
    with the calibration of ImageJ or OME; zarr (``tetopt[zarr]``) reads OME-Zarr and Zarr arrays,
    and only the requested part: an OME-Zarr image (NGFF 0.4, 0.5; Zarr format 2 or 3), whose first
    multiscale level is used, or an array with the attribute "affine". Axes of length 1 beyond the
    third are dropped.

    NIfTI's scaling, its sform (or else qform) and its spatial unit are applied. ITK's LPS
    coordinates are converted to RAS. The slices of a DICOM series, and the frames of a DICOM file,
    are sorted and placed by their own positions, so that the shear of a tilted gantry is kept; each
    is rescaled as it states. A DICOM segmentation gives the numbers of its segments, 0 elsewhere,
    in slices from its first to its last frame. Padding of CT gets the value of the air beside it,
    with a warning (`tetopt.contents.padding`). A picture has 1 mm pixels, index (row, column),
    world x to the right and y up, and y = 0 at the centres of its bottom row.

    Parameters
    ----------
    path : str or Path
        A file, a Zarr folder, or a folder with one DICOM series.
    volume : int, optional
        The volume of a 4-D file or frame of a picture, from 0; only this one is held in memory.
        With more than four axes the fourth varies fastest, as in the file; for Zarr the last of the
        non-spatial axes.
    slice_ : (axis, index), optional
        Return one slice of a 3-D volume as a 2-D image, see `image_slice`.
    crop : sequence of (start, stop), optional
        Keep a box of voxels, see `crop_image`; one range per axis of the volume. Both `slice_` and
        `crop` count voxels of the uncropped volume, and the slice must lie inside the crop.
    spacing_mm : float or sequence of float, optional
        Voxel sizes, mm, of a TIFF stack or a folder of slices that states none, one number or one
        per axis (column, row, slice); or the pixel size of a picture, by default 1 mm.

    Returns
    -------
    Image
        Two-dimensional for a picture, a 2-D file or with `slice_`; otherwise three-dimensional.

    Raises
    ------
    InputError
        ``"<path>: ..."``: the file is missing, unreadable, empty, of unknown format, truncated or
        damaged; a library is needed and not installed; a folder has no DICOM series or several;
        DICOM slices or frames are not parallel, evenly spaced and one per position, or do not state
        where they lie; Zarr metadata are damaged, without a scale, do not have three spatial axes,
        or have units that are not lengths; codecs are unknown; chunks without a fill value are
        missing, or all chunks; a stack states no voxel size, or another than `spacing_mm`; slices
        are missing or differ; there are several volumes and no `volume`, or it is out of range;
        `slice_` or `crop` is invalid; values are RGB, complex, infinite or all NaN; an axis is
        empty; the affine is singular.

    Warns
    -----
    UserWarning
        The image is constant, so its discretization error is 0 on every mesh; the file has no
        orientation; its header was repaired; its box is longer than 3 m or shorter than 1 mm,
        except for pictures; chunks that stand for a value are missing.

    See Also
    --------
    save_image : Write an image.
    load_label_table : Read names and colours of labels.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> tetopt.save_image("ball.nii.gz", image)
    >>> tetopt.load_image("ball.nii.gz").shape
    (16, 16, 16)
    >>> tetopt.load_image("ball.nii.gz", crop=[(2, 14)] * 3).shape
    (12, 12, 12)
    >>> tetopt.load_image("ball.nii.gz", slice_=(2, 8)).shape
    (16, 16)
    """
    path = Path(path)
    with errors_named(path), collect_notes() as notes:
        reader = reader_of(path)
        is_part = reader.reads_crop if slice_ is None else reader.reads_slice
        parts = (slice_, crop) if is_part else (None, None)
        request = Request(volume, spacing_mm, lambda shape: _box_of(shape, *parts))
        data, affine = reader.read(path, request)
        if reader.has_spacing:
            check_spacing(spacing_mm, np.linalg.norm(affine[:-1, :-1], axis=0))
        image = Image(data, affine)
        data, words = replace_padding(image.data)
        if words:
            note(words)
            image = Image(data, affine)
        if not is_part:
            image = part_of(image, slice_, crop)
        elif slice_ is not None:
            image = image_slice(image, slice_[0], 0)
    for words in notes:
        warn(f"{path}: {words}")
    low = image.data.min()
    if low == image.data.max():
        warn(f"{path}: the image is {low:g} everywhere, so E_D is 0 everywhere", Remark)
    return image


def file_shape(path: str | Path) -> tuple[int, ...] | None:
    """Return the lengths of all axes of a file's voxels, from its header; for NRRD they may include
    components.

    Returns None for a picture or DICOM, which would have to be read, and for a missing file. For
    Zarr the three spatial axes come first.

    Raises
    ------
    InputError
        For the reasons of `load_image`, as far as the header shows them.
    """
    path = Path(path)
    with errors_named(path):
        return reader_of(path).shape(path) if path.exists() else None


def smaller_words(path: Path, bounds: Sequence[tuple[int, int]], most_voxels: float) -> str:
    """Advise how to mesh at most so many voxels of a box of an image: a crop in its middle, and a
    coarser level of an OME-Zarr image or larger voxels.
    """
    sides = [stop - start for start, stop in bounds]
    factor = (max(most_voxels, 1.0) / math.prod(sides)) ** (1.0 / len(sides))
    kept = [max(int(side * factor), 1) for side in sides]
    starts = [
        start + (side - n) // 2 for (start, _), side, n in zip(bounds, sides, kept, strict=True)
    ]
    box = ",".join(f"{start}:{start + n}" for start, n in zip(starts, kept, strict=True))
    levels = reader_of(path).levels(path)
    few = [name for name, shape in levels.items() if math.prod(shape) <= most_voxels]
    other = f"resample it to voxels {math.ceil(10.0 / factor) / 10.0:g} times as long"
    if few:
        finest = max(few, key=lambda name: math.prod(levels[name]))
        other = f"use its level {finest} ({_sides_words(levels[finest])} voxels)"
    return f"use `crop` {box} ({_sides_words(kept)} voxels) or the like, or {other}"


def _sides_words(sides: Sequence[int]) -> str:
    return " x ".join(map(str, sides))


def save_image(path: str | Path, image: Image) -> None:
    """Write an image as NIfTI, MGZ, NRRD or OME-Zarr, in mm, whole or not at all.

    NIfTI has the full affine as sform. Whole numbers are stored as 8-, 16- or 32-bit integers if
    they fit, others as float32 or float64. An axis with more voxels than NIfTI-1 supports makes it
    a NIfTI-2 file.

    A 2-D image becomes a 2-D file in the plane z = 0, which `load_image` reads back unchanged.
    Replaces an existing file; call `tetopt.system.files.check_output` first.
    `tetopt.io.zarr_images.save_zarr` writes a Zarr folder (.zarr) of a 3-D image.

    Parameters
    ----------
    path : str or Path
        Its name ends in .nii, .nii.gz, .mgz, .nrrd or .zarr.
    image : Image
        Two- or three-dimensional; for MGZ (in single precision), NRRD and Zarr 3-D.

    Raises
    ------
    InputError
        The name has another suffix; a 2-D image not as NIfTI; the reasons of `save_zarr`.
    OSError
        For the reasons of `tetopt.system.files.save_bytes`.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> tetopt.save_image("ball.nii.gz", image)
    >>> bool((tetopt.load_image("ball.nii.gz").data == image.data).all())
    True
    """
    path = check_suffix(path, (*OUTPUT_SUFFIXES, ZARR_SUFFIX))
    if path.name.lower().endswith(ZARR_SUFFIX):
        save_zarr(path, image.affine, _for_file(image.data))
    else:
        save_voxels(path, _for_file(image.data), image)


def save_voxels(path: Path, values: NDArray, image: Image) -> None:
    """Write the values (*shape) or vectors (*shape, K) of an image's voxels like `save_image`, NaN
    included.

    Vectors are along the fifth axis of NIfTI, with the intent "vector", the fourth of MGZ, and the
    first of NRRD.
    """
    suffix = path.suffix.lower()
    if suffix in (".mgz", ".nrrd") and image.ndim == 2:
        raise InputError(f"{path}: expected .nii or .nii.gz for a 2-D image")
    if suffix == ".nrrd":
        save_bytes(path, _nrrd_bytes(values, image))
        return
    if suffix == ".mgz":
        is_kept = values.dtype in (np.uint8, np.int16, np.int32)
        kept = values if is_kept else values.astype(np.float32)
        save_bytes(path, _pack(nibabel.MGHImage(kept, image.affine).to_bytes()))
        return
    n = image.ndim
    affine = np.eye(4)
    is_vector = values.ndim > image.ndim
    affine[:n, :n] = image.affine[:-1, :-1]
    affine[:n, 3] = image.affine[:-1, -1]
    kind = nibabel.Nifti1Image if max(image.shape) <= MOST_OF_NIFTI_1 else nibabel.Nifti2Image
    shape = (*image.shape, *(1,) * (4 - n), values.shape[-1]) if is_vector else image.shape
    file = kind(values.reshape(shape), affine)
    file.header.set_xyzt_units("mm")
    if is_vector:
        file.header.set_intent("vector")
    whole = file.to_bytes()
    save_bytes(path, _pack(whole) if suffix == ".gz" else whole)


def _pack(whole: bytes) -> bytes:
    packed = io.BytesIO()
    with gzip.GzipFile("", "wb", GZIP_LEVEL, packed, mtime=0) as stream:
        stream.write(whole)
    return packed.getvalue()


def _nrrd_bytes(values: NDArray, image: Image) -> bytes:
    """Return an NRRD file of a volume, in LPS, which all its readers know."""
    affine = np.diag([-1.0, -1.0, 1.0, 1.0]) @ image.affine
    *steps, origin = (f"({','.join(map(repr, each))})" for each in affine[:3].T.tolist())
    kinds = "domain domain domain"
    if values.ndim > 3:
        values, kinds = np.moveaxis(values, -1, 0), f"vector {kinds}"
        steps.insert(0, "none")
    kind = NRRD_TYPES.get(values.dtype.str[1:], "double")
    data = values.astype(values.dtype.newbyteorder("<") if kind != "double" else "<f8")
    head = (
        f"NRRD0004\ntype: {kind}\ndimension: {values.ndim}\nspace: left-posterior-superior\n"
        f"sizes: {' '.join(map(str, values.shape))}\nspace directions: {' '.join(steps)}\n"
        f"kinds: {kinds}\nendian: little\nencoding: gzip\nspace origin: {origin}\n\n"
    )
    return head.encode() + _pack(data.tobytes(order="F"))


def _for_file(data: NDArray[np.floating]) -> NDArray:
    """Convert small whole numbers to integers, so that programs recognise labels; return other
    data unchanged.
    """
    low = data.min()
    high = data.max()
    for dtype in (np.uint8, np.int16, np.int32):
        if (
            np.iinfo(dtype).min <= low
            and high <= np.iinfo(dtype).max
            and np.array_equal(np.rint(data), data)
        ):
            return data.astype(dtype)
    return data


def image_slice(image: Image, axis: int, index: int) -> Image:
    """Return one slice of a 3-D image as a 2-D image, preserving all lengths and angles in the
    slice.

    A slice in the plane of two world axes keeps these two world coordinates. Otherwise the frame of
    the plane is Q of the QR factorisation of the affine's two in-plane columns, with each axis of Q
    signed so that its largest component is positive; a voxel's 2-D coordinates are Q^T times its
    3-D ones.

    Parameters
    ----------
    image : Image
        Three-dimensional.
    axis : int
        The array axis to drop: 0, 1 or 2.
    index : int
        Voxel index along `axis`, from 0.

    Raises
    ------
    InputError
        The image is 2-D, or `axis` or `index` is out of range.

    Examples
    --------
    >>> image = Image(np.zeros((4, 5, 6)), np.diag([2.0, 2.0, 3.0, 1.0]))
    >>> image_slice(image, 1, 0).affine
    array([[2., 0., 0.],
           [0., 3., 0.],
           [0., 0., 1.]])
    """
    _check_slice(image.shape, axis, index)
    corner = np.zeros(3)
    corner[axis] = index
    columns = np.delete(image.affine[:3, :3], axis, axis=1)
    return Image(
        np.take(image.data, index, axis=axis), plane_affine(columns, image.to_world(corner))
    )


def _check_slice(shape: Sequence[int], axis: int, index: int) -> None:
    if len(shape) != 3:
        raise InputError(f"slice: expected a 3-D image, got a {len(shape)}-D one; omit the slice")
    if axis not in (0, 1, 2):
        raise InputError(f"slice: expected axis 0, 1 or 2, got {axis}")
    if not 0 <= index < shape[axis]:
        raise InputError(
            f"slice: expected an index from 0 to {shape[axis] - 1} along axis {axis}, got {index}"
        )


def crop_image(image: Image, bounds: Bounds) -> Image:
    """Return the voxels inside a box of indices; every voxel keeps its world position.

    Parameters
    ----------
    image : Image
        In n dimensions.
    bounds : sequence of n (start, stop)
        Half-open ranges of voxel indices, 0 <= start < stop <= size; None for an open end.

    Raises
    ------
    InputError
        The number of ranges is not n, or a range is empty or leaves the image.

    Examples
    --------
    >>> small = crop_image(Image(np.zeros((40, 50))), [(10, 30), (None, None)])
    >>> small.shape, small.to_world([0, 0])
    ((20, 50), array([10.,  0.]))
    """
    return image.box(*zip(*check_bounds(image.shape, bounds), strict=True))


def parse_crop(text: str) -> list[tuple[int | None, int | None]]:
    """Parse crop bounds from a command line, one start:stop per axis, for `crop_image`.

    Raises
    ------
    InputError
        The text does not have this form.

    Examples
    --------
    >>> parse_crop("10:100,:,5:")
    [(10, 100), (None, None), (5, None)]
    """
    bounds = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9]{0,18})\s*:\s*([0-9]{0,18})\s*", part)
        if match is None:
            raise InputError(
                'crop: expected start:stop in voxels for each axis, such as "10:100,:,5:", got '
                f'"{one_line(text)[:80]}"'
            )
        start, stop = (int(end) if end else None for end in match.groups())
        bounds.append((start, stop))
    return bounds


def parse_slice(text: str) -> tuple[int, int]:
    """Parse an array axis (0, 1, 2 or i, j, k) and voxel index from a command line, for
    `image_slice`.

    Raises
    ------
    InputError
        The text does not have this form.

    Examples
    --------
    >>> parse_slice("2=90"), parse_slice("k=90")
    ((2, 90), (2, 90))
    """
    match = re.fullmatch(r"\s*([012ijk])\s*=\s*([0-9]{1,18})\s*", text)
    if match is None:
        raise InputError(
            "slice: expected an array axis (0, 1, 2 or i, j, k) and a voxel index, "
            f'such as "2=90" or "k=90", got "{one_line(text)[:80]}"'
        )
    axis, index = match.groups()
    return "012ijk".index(axis) % 3, int(index)


def sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file, or of the contents of a folder's files joined in the order of
    their names.

    For a header with separate data files it includes these, for one file of a pair the other. For a
    Zarr folder it covers all files in it and its subfolders, each after its name and length;
    `status_checksum` is a cheaper checksum.

    Raises
    ------
    InputError
        The file or folder is missing or cannot be read.
    """
    path = Path(path)
    digest = hashlib.sha256()
    with errors_named(path):
        has_names = is_zarr(path)
        for name, file in image_files(path).items():
            if has_names:
                digest.update(f"{name}\0{file.stat().st_size}\0".encode("utf-8", "surrogateescape"))
            with file.open("rb") as stream:
                hashlib.file_digest(stream, lambda: digest)
    return digest.hexdigest()


def status_checksum(path: str | Path) -> str:
    """Return a SHA-256 that changes with an image, without reading its voxels.

    It covers names, lengths and modification times of all files that `sha256` reads. Two copies of
    an image have different checksums; `sha256` is the same for both, but takes as long as reading
    them.

    Raises
    ------
    InputError
        For the reasons of `sha256`.
    """
    path = Path(path)
    with errors_named(path):
        status = ((name, file.stat()) for name, file in image_files(path).items())
        words = "".join(f"{name}\0{each.st_size}\0{each.st_mtime_ns}\0" for name, each in status)
    return hashlib.sha256(words.encode("utf-8", "surrogateescape")).hexdigest()


def image_files(path: Path) -> dict[str, Path]:
    """Return the files of an image by name: the file itself with the data files of a header or the
    other one of a pair, or those in a folder; for Zarr also those in its subfolders.

    Raises
    ------
    InputError
        With the path: one is neither a regular file nor a folder.
    """
    if is_zarr(path):
        return _zarr_files(path)
    _check_regular(path, (None, "a folder"))
    files = [path]
    if path.is_dir():  # a DICOM series is in the folder itself or, without any, in subfolders
        files = sorted(p for p in path.iterdir() if p.is_file())
        if not (slice_files(path) or any(map(is_dicom, files))):
            below = sorted(p for p in path.rglob("*") if p.parent != path and p.is_file())
            files += filter(is_dicom, below)
    with contextlib.suppress(InputError):  # an unreadable header has no other files
        for reader in _named_readers(path):
            files += reader.other_files(path)
    where = path if path.is_dir() else path.parent
    return {file.relative_to(where).as_posix(): file for file in files}


def _check_regular(path: Path, kinds: Sequence[str | None] = (None,)) -> None:
    if (other := irregular(path)) not in kinds:
        raise InputError(
            f"{path}: expected a regular file, got {other}; copy its content into a file"
        )


def _zarr_files(path: Path) -> dict[str, Path]:
    """Return all files in a folder by their relative names, in order.

    Links are followed, but no folder is visited twice. For a level of an OME-Zarr image, the
    image's metadata count, too.
    """
    known = set()
    files: dict[str, Path] = {}
    for folder, folders, names in os.walk(path, followlinks=True, onerror=_raise_error):
        status = os.stat(folder)
        if (status.st_dev, status.st_ino) in known:
            folders.clear()
            continue
        known.add((status.st_dev, status.st_ino))
        files |= {
            (Path(folder) / name).relative_to(path).as_posix(): Path(folder) / name
            for name in names
        }
    if (image := image_folder(path)) is not None:
        files |= {f"../{name}": image / name for name in METADATA_FILES if (image / name).exists()}
    for file in files.values():
        _check_regular(file)
    return dict(sorted(files.items()))


def _raise_error(error: OSError) -> None:
    raise error


# Choice of the reader

CONVERTERS = (  # of some formats that are not read
    "mrconvert (.mif), dcm2niix (.par), Fiji (.czi, .lif, .nd2: OME-TIFF), numpy (.mat, .h5: "
    ".npy), or 3D Slicer"
)
READERS = (NIFTI, ITK, ZARR, GRIDS, LEGACY, VTI, ARRAYS, SLICES, DICOM, PICTURES)
# of folders, the first that recognises it


def reader_of(path: Path) -> Reader:
    """Return the reader of a file or folder: by the suffix of a file, otherwise by contents.

    Raises
    ------
    InputError
        With the path: its format is unknown, or its first bytes do not fit it.
    """
    with errors_named(path):
        if not path.is_dir():
            _check_beginning(path)
        recognised = (reader for reader in READERS if reader.is_this(path))
        if (reader := next(chain(_named_readers(path), recognised), None)) is not None:
            return reader
        known = ", ".join(suffix for reader in READERS for suffix in reader.suffixes)
        raise InputError(
            f"unknown image format; expected {known}, or a folder of DICOM files or of slices; "
            f"convert it, for example with {CONVERTERS}"
        )


def _named_readers(path: Path) -> list[Reader]:
    """Return the reader of a file's suffix, if any."""
    is_file = not path.is_dir()
    name = path.name.lower()
    return [reader for reader in READERS if is_file and name.endswith(reader.suffixes)]


def _check_beginning(path: Path) -> None:
    """Raise InputError if the first bytes of a file do not fit its format."""
    _check_regular(path)
    with path.open("rb") as stream:
        beginning = stream.read(BEGINNING_BYTES)
    if not beginning:
        raise InputError("the file is empty; copy or export it again")
    if beginning.removeprefix(b"\xef\xbb\xbf").lstrip().lower().startswith(WEB_BEGINNINGS):
        raise InputError("this is an HTML page, not an image; download the file again")
    packed = PACKED_NAMES.get(path.suffix.lower())
    if packed is not None and beginning.startswith(GZIP_BEGINNING):
        raise InputError(f"this is a gzip file; rename it to {path.stem}{packed}")


@contextlib.contextmanager
def errors_named(path: Path) -> Iterator[None]:
    """Turn system errors and InputErrors into InputErrors of one line that begins with the path, or
    with the file's name.
    """
    try:
        yield
    except InputError as error:
        with prefix_errors(path):
            raise InputError(one_line(error)) from error
    except OSError as error:
        words = f"cannot be opened ({error.strerror or error})"
        if isinstance(error, FileNotFoundError):
            is_url = re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(error.filename))
            words = (
                "expected a local file or folder, got a URL; download it first"
                if is_url
                else "no such file or folder; check the path"
            )
        elif isinstance(error, PermissionError):
            words = "permission denied; make the file readable for your account"
        raise InputError(f"{error.filename or path}: {words}") from error


# Geometry of parts


def part_of(image: Image, slice_: tuple[int, int] | None, crop: Bounds | None) -> Image:
    """Crop and slice an image; slices first, with the same result, so that indices need no
    shift.
    """
    if slice_ is None:
        return image if crop is None else crop_image(image, crop)
    bounds = _box_of(image.shape, slice_, crop)
    plane = image_slice(image, *slice_)
    return crop_image(plane, bounds[: slice_[0]] + bounds[slice_[0] + 1 :])


def _box_of(
    shape: Sequence[int], slice_: tuple[int, int] | None, crop: Bounds | None
) -> list[tuple[int, int]]:
    """Return the box of indices that a crop and a slice have in common."""
    bounds = [(0, size) for size in shape] if crop is None else check_bounds(shape, crop)
    if slice_ is not None:
        axis, index = slice_
        _check_slice(shape, axis, index)
        start, stop = bounds[axis]
        if not start <= index < stop:
            raise InputError(
                f"slice: index {index} along axis {axis} is outside the crop {start}:{stop}"
            )
        bounds[axis] = (index, index + 1)
    return bounds


def check_bounds(shape: Sequence[int], bounds: Bounds) -> list[tuple[int, int]]:
    """Return the bounds with open ends filled in, after checking them."""
    if len(bounds) != len(shape):
        raise InputError(f"crop: expected {len(shape)} ranges for shape {shape}, got {len(bounds)}")
    ranges = []
    for axis, ((start, stop), size) in enumerate(zip(bounds, shape, strict=True)):
        start = 0 if start is None else start
        stop = size if stop is None else stop
        if not 0 <= start < stop <= size:
            raise InputError(
                f"crop: expected 0 <= start < stop <= {size} along axis {axis}, got {start}:{stop}"
            )
        ranges.append((start, stop))
    return ranges
