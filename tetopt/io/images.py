"""Reading of images: NIfTI, MGZ, NRRD, MetaImage, DICOM and 2-D pictures, each to an `Image` in
RAS+ millimetres.
"""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import io
import logging
import math
import os
import re
import threading
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from nibabel import imageglobals
from nibabel.filebasedimages import ImageFileError
from nibabel.freesurfer.mghformat import MGHError
from nibabel.spatialimages import HeaderDataError, SpatialImage
from nibabel.wrapstruct import WrapStructError
from numpy.typing import NDArray

from tetopt.errors import InputError, Remark, warn
from tetopt.image import Image, shifted_affine
from tetopt.io.apart import DEFLATE_RATIO
from tetopt.io.contradictions import notes_of_nifti, notes_of_rest
from tetopt.io.itk_headers import HEADED_SUFFIXES, data_files, header_sizes
from tetopt.io.pictures import PICTURE_SUFFIXES
from tetopt.io.read_dicom import DICOM_SUFFIX, is_dicom, read_dicom
from tetopt.io.read_itk import ITK_READERS, read_itk
from tetopt.io.readback import save_checked
from tetopt.io.stacks import check_spacing, read_pictures, read_slices, slice_files
from tetopt.io.units import mm_of_axes, notes_of_size
from tetopt.io.volumes import (
    DAMAGED_FILE,
    TOO_LONG,
    TRAILING_BYTES,
    UNREADABLE_FILE,
    check_room,
    one_line,
    volume_index,
)
from tetopt.io.zarr_images import (
    METADATA_FILES,
    ZARR_SUFFIX,
    ZarrLevel,
    check_chunks,
    image_folder,
    is_zarr,
    read_chunks,
    save_zarr,
    zarr_levels,
    zarr_picks,
)
from tetopt.system.files import check_suffix
from tetopt.system.incoming import irregular

Bounds = Sequence[tuple[int | None, int | None]]
"""One half-open (start, stop) range of voxel indices per axis; None means an open end."""

OUTPUT_SUFFIXES = (".nii", ".nii.gz")
_NIBABEL_SUFFIXES = (".nii.gz", ".nii", ".mgz", ".mgh")

# Errors that the two libraries raise for damaged files.
_READER_ERRORS = (OSError, EOFError, ValueError, TypeError, KeyError)
_NIBABEL_HEADER_ERRORS = (
    *_READER_ERRORS,
    ImageFileError,
    HeaderDataError,
    WrapStructError,
    OverflowError,
    MGHError,
)
PLANES_BYTES = 2**28  # of an uncompressed file, read at a time for a crop of it
GZIP_LEVEL = 1  # nibabel's compression level
MOST_OF_NIFTI_1 = 32767  # voxels along an axis, of 16 bits; NIfTI-2 allows more
HEAD_BYTES_NIFTI = 1024  # read from a file: the longest header has 540
EXTENSION_BYTES = 2**26  # 67 MB before the voxels: a NIfTI file's extensions are texts
MGH_FLAG = slice(28, 30)  # the bytes of an MGH header that are 0 if it has no sizes and directions
BEGINNING_BYTES = 512  # of a file: HTML pages begin with a tag, after at most some blanks
WEB_BEGINNINGS = (b"<!doctype html", b"<html", b"<head", b"<body")
GZIP_BEGINNING = b"\x1f\x8b"


def load_image(
    path: str | Path,
    *,
    volume: int | None = None,
    slice_: tuple[int, int] | None = None,
    crop: Bounds | None = None,
    spacing_mm: float | Sequence[float] | None = None,
) -> Image:
    """Read an image from a file, or from a folder of Zarr or of DICOM slices, in RAS+ millimetres.

    The suffix, in any case, decides the format: nibabel reads NIfTI and MGZ; SimpleITK (the extra
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
    in slices from its first to its last frame. A picture has 1 mm pixels, index (row, column),
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
        Keep a box of voxels, see `cropped`; one range per axis of the volume. Both `slice_` and
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
        `slice_` or `crop` is invalid; values are RGB, complex, NaN or infinite; an axis is empty;
        the affine is singular.

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
    notes: list[str] = []
    try:
        with os_errors_named():
            is_folder = is_zarr(path)
        if is_folder:
            level = zarr_levels(path, notes)[0]
            check_spacing(spacing_mm, np.linalg.norm(level.affine[:3, :3], axis=0))
            image = _part_of_zarr(level, volume, slice_, crop, notes)
        elif (
            crop is not None
            and slice_ is None
            and check_beginning(path).endswith(_NIBABEL_SUFFIXES)
        ):
            image = _crop_of_nibabel(path, volume, crop, notes)
            check_spacing(spacing_mm, image.spacing)
        else:
            image = part_of(Image(*_read(path, volume, notes, spacing_mm)), slice_, crop)
    except InputError as error:
        raise named_error(path, error) from error
    for note in notes:
        warn(f"{path}: {note}")
    low = image.data.min()
    if low == image.data.max():
        warn(f"{path}: the image is {low:g} everywhere, so E_D is 0 everywhere", Remark)
    return image


def named_error(path: Path, error: InputError) -> InputError:
    """Return the error as one line that begins with the path."""
    words = one_line(error)
    return InputError(words if words.startswith(str(path)) else f"{path}: {words}")


def file_shape(path: str | Path) -> tuple[int, ...] | None:
    """Return the lengths of all axes of a file's voxels, from its header; for NRRD they may include
    components.

    Returns None for a picture or DICOM, which would have to be read. For Zarr the three spatial
    axes come first.

    Raises
    ------
    InputError
        For the reasons of `load_image`, as far as the header shows them.
    """
    path = Path(path)
    name = path.name.lower()
    try:
        with os_errors_named():
            if is_zarr(path):
                level = zarr_levels(path, [])[0]
                return (*level.shape, *(int(level.array.shape[axis]) for axis in level.others))
            if not name.endswith((*_NIBABEL_SUFFIXES, *HEADED_SUFFIXES)) or path.is_dir():
                return None
            check_beginning(path)
            if name.endswith(HEADED_SUFFIXES):
                return header_sizes(path)
            _checked_head(path, name.endswith((".gz", ".mgz")))
            with _nibabel_heard():
                return tuple(int(size) for size in _nibabel_file(path).shape)
    except InputError as error:
        raise InputError(f"{path}: {one_line(error)}") from error


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
    levels = zarr_levels(path, []) if is_zarr(path) else []
    few = [level for level in levels if math.prod(level.shape) <= most_voxels]
    other = f"resample it to voxels {math.ceil(10.0 / factor) / 10.0:g} times as long"
    if few:
        finest = max(few, key=lambda level: math.prod(level.shape))
        other = f"use its level {finest.folder} ({_sides_words(finest.shape)} voxels)"
    return f"use `crop` {box} ({_sides_words(kept)} voxels) or the like, or {other}"


def _sides_words(sides: Sequence[int]) -> str:
    return " x ".join(map(str, sides))


def save_image(path: str | Path, image: Image) -> None:
    """Write NIfTI, with the full affine as sform, or OME-Zarr, in mm, whole or not at all.

    Whole numbers are stored as 8-, 16- or 32-bit integers if they fit, others as float32 or
    float64. An axis with more voxels than NIfTI-1 supports makes it a NIfTI-2 file.

    A 2-D image becomes a 2-D file in the plane z = 0, which `load_image` reads back unchanged.
    Replaces an existing file; call `tetopt.system.files.checked_output` first.
    `tetopt.io.zarr_images.save_zarr` writes a Zarr folder (.zarr) of a 3-D image.

    Parameters
    ----------
    path : str or Path
        Its name ends in .nii, .nii.gz or .zarr.
    image : Image
        Two- or three-dimensional.

    Raises
    ------
    InputError
        The name has another suffix; the reasons of `save_zarr`.
    OSError
        For the reasons of `tetopt.io.readback.save_checked`.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> tetopt.save_image("ball.nii.gz", image)
    >>> bool((tetopt.load_image("ball.nii.gz").data == image.data).all())
    True
    """
    path = check_suffix(path, (*OUTPUT_SUFFIXES, ZARR_SUFFIX))
    if path.name.lower().endswith(ZARR_SUFFIX):
        save_zarr(path, image.affine, image.data, _for_file(image.data).dtype)
        return
    save_voxels(path, _for_file(image.data), image)


def save_voxels(path: Path, values: NDArray, image: Image) -> None:
    """Write the values (*shape) or vectors (*shape, K) of an image's voxels as NIfTI, like
    `save_image`, NaN included.

    Vectors are along the fifth axis, with the intent "vector".
    """
    n, affine, is_vector = image.ndim, np.eye(4), values.ndim > image.ndim
    affine[:n, :n] = image.affine[:-1, :-1]
    affine[:n, 3] = image.affine[:-1, -1]
    kind = nibabel.Nifti1Image if max(image.shape) <= MOST_OF_NIFTI_1 else nibabel.Nifti2Image
    shape = (*image.shape, *(1,) * (4 - n), values.shape[-1]) if is_vector else image.shape
    file = kind(values.reshape(shape), affine)
    file.header.set_xyzt_units("mm")
    if is_vector:
        file.header.set_intent("vector")
    whole = file.to_bytes()
    if path.suffix.lower() == ".gz":
        packed = io.BytesIO()
        with gzip.GzipFile("", "wb", GZIP_LEVEL, packed, mtime=0) as stream:
            stream.write(whole)
        whole = packed.getvalue()
    save_checked(path, whole)


def _for_file(data: NDArray[np.floating]) -> NDArray:
    """Convert small whole numbers to integers, so that programs recognise labels; return other
    data unchanged.
    """
    low, high = data.min(), data.max()
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
        np.take(image.data, index, axis=axis), _plane_affine(columns, image.to_world(corner))
    )


def _check_slice(shape: tuple[int, ...], axis: int, index: int) -> None:
    if len(shape) != 3:
        raise InputError(f"slice: expected a 3-D image, got a {len(shape)}-D one; omit the slice")
    if axis not in (0, 1, 2):
        raise InputError(f"slice: expected axis 0, 1 or 2, got {axis}")
    if not 0 <= index < shape[axis]:
        raise InputError(
            f"slice: expected an index from 0 to {shape[axis] - 1} along axis {axis}, got {index}"
        )


def cropped(image: Image, bounds: Bounds) -> Image:
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
    >>> small = cropped(Image(np.zeros((40, 50))), [(10, 30), (None, None)])
    >>> small.shape, small.to_world([0, 0])
    ((20, 50), array([10.,  0.]))
    """
    return image.box(*zip(*checked_bounds(image.shape, bounds), strict=True))


def parse_crop(text: str) -> list[tuple[int | None, int | None]]:
    """Parse crop bounds from a command line, one start:stop per axis, for `cropped`.

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

    For a header with separate data files it includes these. For a Zarr folder it covers all files
    in it and its subfolders, each after its name and length;
    `status_checksum` is a cheaper checksum.

    Raises
    ------
    InputError
        The file or folder is missing or cannot be read.
    """
    path = Path(path)
    digest = hashlib.sha256()
    with os_errors_named(path):
        if is_zarr(path):
            return folder_checksum(path, lambda _: True)
        for file in image_files(path):
            _digest_file(digest, file)
    return digest.hexdigest()


def status_checksum(path: str | Path) -> str:
    """Return a SHA-256 that changes with an image, without reading its voxels.

    For a Zarr folder it covers names, lengths and modification times of all files, and the contents
    of metadata files. For a file, and the data files of a header, it covers name, length and
    modification time. Two copies of an image have different checksums; `sha256` is the same for
    both, but takes as long as reading them.

    Raises
    ------
    InputError
        For the reasons of `sha256`.
    """
    path = Path(path)
    with os_errors_named(path):
        if is_zarr(path):
            return folder_checksum(path, lambda file: file.name in METADATA_FILES)
        words = []
        for file in image_files(path):
            status = file.stat()
            words.append(f"{file.name}\0{status.st_size}\0{status.st_mtime_ns}\0")
    return hashlib.sha256("".join(words).encode("utf-8", "surrogateescape")).hexdigest()


def image_files(path: Path) -> list[Path]:
    """Return the files of an image other than Zarr: the file itself, data files of a header, or
    those in a folder.

    Raises
    ------
    InputError
        With the path: it is neither a regular file nor a folder.
    """
    if (other := irregular(path)) not in (None, "a folder"):
        raise InputError(
            f"{path}: expected a regular file, got {other}; copy its content into a file"
        )
    # A DICOM series is read from the folder itself, not from its subfolders; so is its checksum.
    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    if path.name.lower().endswith(HEADED_SUFFIXES):
        with contextlib.suppress(InputError):  # an unreadable header has no data files
            files += data_files(path)
    return files


def folder_checksum(path: Path, is_read: Callable[[Path], bool]) -> str:
    """Return the SHA-256 of the relative names, lengths and contents of all files in a folder, in
    order.

    For files that are not read, by `is_read`, the time of their last change replaces their
    contents. Links are followed, but no folder is visited twice. For a level of an OME-Zarr image,
    the image's metadata count, too.
    """
    digest, known = hashlib.sha256(), set()
    files: dict[str, Path] = {}
    for folder, folders, names in os.walk(path, followlinks=True, onerror=_raised):
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
    for name, file in sorted(files.items()):
        if (other := irregular(file)) is not None:
            raise InputError(
                f"{file}: expected a regular file, got {other}; copy its content into a file"
            )
        status = file.stat()
        digest.update(f"{name}\0{status.st_size}\0".encode("utf-8", "surrogateescape"))
        if is_read(file):
            _digest_file(digest, file)
        else:
            digest.update(f"{status.st_mtime_ns}\0".encode())
    return digest.hexdigest()


def _digest_file(digest: Any, file: Path) -> None:
    with file.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)


def _raised(error: OSError) -> None:
    raise error


# Choice of the reader


def _read(
    path: Path, volume: int | None, notes: list[str], spacing_mm: float | Sequence[float] | None
) -> tuple[NDArray, NDArray[np.float64]]:
    """Return data and affine of the file, 2-D or 3-D; `Image` checks them. Warnings are added to
    `notes`.
    """
    with os_errors_named():
        if path.is_dir() and (names := slice_files(path)):
            return read_slices(path, names, notes, spacing_mm)
    if path.name.lower().endswith(PICTURE_SUFFIXES):
        check_beginning(path)
        return read_pictures(path, volume, notes, spacing_mm)
    data, affine = _read_placed(path, volume, notes)
    check_spacing(spacing_mm, np.linalg.norm(affine[:-1, :-1], axis=0))
    return data, affine


def has_own_spacing(path: Path) -> bool:
    """Return whether a file's format states voxel sizes: all do but pictures, stacks and folders
    of slices.
    """
    with os_errors_named(path):
        return not (
            slice_files(path) if path.is_dir() else path.name.lower().endswith(PICTURE_SUFFIXES)
        )


def _read_placed(
    path: Path, volume: int | None, notes: list[str]
) -> tuple[NDArray, NDArray[np.float64]]:
    with os_errors_named():
        if path.is_dir():
            return read_dicom(path, volume, notes)
    name = check_beginning(path)
    for suffix, read in READERS.items():
        if name.endswith(suffix):
            return read(path, volume, notes)
    if is_dicom(path):  # scanners name files without a suffix
        return read_dicom(path, volume, notes)
    known = ", ".join((*READERS, *PICTURE_SUFFIXES, ZARR_SUFFIX))
    raise InputError(
        f"unknown image format; expected {known}, or a folder of DICOM files or of slices"
    )


def check_beginning(path: Path) -> str:
    """Return the file's name in lower case; InputError if its first bytes do not fit the format."""
    with os_errors_named():
        if (other := irregular(path)) is not None:
            raise InputError(f"expected a regular file, got {other}; copy its content into a file")
        with path.open("rb") as stream:
            beginning = stream.read(BEGINNING_BYTES)
    if not beginning:
        raise InputError("the file is empty; copy or export it again")
    if beginning.removeprefix(b"\xef\xbb\xbf").lstrip().lower().startswith(WEB_BEGINNINGS):
        raise InputError("this is an HTML page, not an image; download the file again")
    name = path.name.lower()
    if name.endswith((".nii", ".mgh")) and beginning.startswith(GZIP_BEGINNING):
        ending = ".nii.gz" if name.endswith(".nii") else ".mgz"
        raise InputError(f"this is a gzip file; rename it to {path.stem}{ending}")
    return name


@contextlib.contextmanager
def os_errors_named(path: Path | None = None) -> Iterator[None]:
    """Turn system errors into InputErrors; with `path`, they begin with the file's name or the
    path.
    """
    try:
        yield
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
        raise InputError(words if path is None else f"{error.filename or path}: {words}") from error


# NIfTI and MGZ


def _read_nibabel(
    path: Path, volume: int | None, notes: list[str]
) -> tuple[NDArray, NDArray[np.float64]]:
    proxy, index, affine = nibabel_voxels(path, volume, notes)
    check_room(proxy.shape, proxy.dtype.itemsize)
    try:
        data = np.asanyarray(proxy[(slice(None),) * 3 + index] if index else proxy)
    except MemoryError as error:
        raise InputError(
            f"its {proxy.shape} voxels do not fit into memory; resample it first"
        ) from error
    except (OSError, EOFError, zlib.error, ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{DAMAGED_FILE} ({one_line(error)})") from error
    if data.ndim == 2:
        return data, _plane_affine(affine[:3, :2], affine[:3, 3])
    return data, affine


def _crop_of_nibabel(path: Path, volume: int | None, crop: Bounds, notes: list[str]) -> Image:
    """Return a crop of a file, of which only its planes are read, some at a time."""
    proxy, index, affine = nibabel_voxels(path, volume, notes)
    if len(proxy.shape) < 3:
        return part_of(Image(*_read_nibabel(path, volume, [])), None, crop)
    bounds = checked_bounds(tuple(proxy.shape[:3]), crop)
    check_room([stop - start for start, stop in bounds], proxy.dtype.itemsize)
    *within, (first, last) = bounds
    box = tuple(slice(*ends) for ends in within)
    n_planes = max(PLANES_BYTES // (math.prod(proxy.shape[:2]) * proxy.dtype.itemsize), 1)
    if path.name.lower().endswith((".gz", ".mgz")):  # read from its beginning each time
        n_planes = last - first
        check_room((*proxy.shape[:2], n_planes), proxy.dtype.itemsize)
    try:
        parts = [
            np.asanyarray(
                proxy[(slice(None), slice(None), slice(k, min(k + n_planes, last)), *index)]
            )[box]
            for k in range(first, last, n_planes)
        ]
    except MemoryError as error:
        raise InputError("its voxels do not fit into memory; crop it to fewer") from error
    except (OSError, EOFError, zlib.error, ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{DAMAGED_FILE} ({one_line(error)})") from error
    data = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)
    return Image(data, shifted_affine(affine, [start for start, _ in bounds]))


# By suffix; each returns data and affine for a path and a volume, and adds notes.
READERS: dict[str, Callable[[Path, int | None, list[str]], tuple[NDArray, NDArray[np.float64]]]] = {
    **dict.fromkeys(_NIBABEL_SUFFIXES, _read_nibabel),
    **dict.fromkeys(ITK_READERS, read_itk),
    DICOM_SUFFIX: read_dicom,
}


def nibabel_voxels(
    path: Path, volume: int | None, notes: list[str]
) -> tuple[Any, tuple[int, ...], NDArray[np.float64]]:
    """Return nibabel's proxy of the voxels, the index beyond the third axis, and the affine in
    mm, (4, 4).
    """
    is_packed = path.name.lower().endswith((".gz", ".mgz"))
    head = _checked_head(path, is_packed)
    with _nibabel_heard() as words:
        file = _nibabel_file(path)
    notes += [
        f"nibabel repaired its header ({word}); check its voxel sizes and position"
        for word in words
    ]
    notes += _notes_of_place(file, head)
    lengths = _units(file, notes)
    affine = np.array(file.affine, dtype=np.float64)
    affine[:3] *= 1.0 if lengths is None else lengths[:, None]
    notes += notes_of_size(file.shape, affine, lengths)
    index = volume_index(file.shape[3:], volume)
    _check_size(path, file, 0 if volume is None else volume, is_packed, notes)
    return file.dataobj, index, affine


def _checked_head(path: Path, is_packed: bool) -> bytes:
    """Return the file's first bytes, unpacked; InputError if it should be a gzip file, or has
    excessive extensions.

    nibabel reads extensions whole together with the header, before their sizes can be checked.
    """
    try:
        with gzip.open(path) if is_packed else path.open("rb") as stream:
            head = stream.read(HEAD_BYTES_NIFTI)
    except (OSError, EOFError, zlib.error) as error:
        raise _of_gzip(error) from error
    for header in (nibabel.Nifti1Header, nibabel.Nifti2Header):
        if path.name.lower().endswith((".nii", ".nii.gz")) and header.may_contain_header(head):
            offset = float(header(head[: header.sizeof_hdr], check=False)["vox_offset"])
            if not 0.0 <= offset <= EXTENSION_BYTES:
                raise InputError(f"{DAMAGED_FILE} (its voxels would begin at byte {offset:g})")
    return head


@contextlib.contextmanager
def _nibabel_heard() -> Iterator[list[str]]:
    """Collect nibabel's log messages of this thread, which are then not printed."""
    words: list[str] = []
    thread = threading.get_ident()

    def keep(record: logging.LogRecord) -> bool:
        if record.thread != thread:
            return True
        if record.levelno >= logging.WARNING:
            words.append(one_line(record.getMessage()))
        return False

    imageglobals.logger.addFilter(keep)
    try:
        yield words
    finally:
        imageglobals.logger.removeFilter(keep)


def _notes_of_place(file: SpatialImage, head: bytes) -> list[str]:
    """Return warnings for a header without orientation, which nibabel guesses."""
    if isinstance(file, nibabel.MGHImage):
        if any(head[MGH_FLAG]):
            return []
        return [
            "has no orientation: its voxel sizes (1 mm), position and left/right are nibabel's "
            "guess"
        ]
    header: Any = file.header
    notes = notes_of_nifti(header, file.shape)
    if int(header["sform_code"]) or int(header["qform_code"]):
        return notes
    guess = "has no orientation: position and left/right are nibabel's guess"
    return [f"{guess}; if they matter, convert it again with its sform or qform", *notes]


def _nibabel_file(path: Path) -> SpatialImage:
    """Open a file of one of three formats with its header; nibabel alone would try many more."""
    path = path.absolute()  # nibabel expands a leading ~ to the home folder
    try:
        if nibabel.Cifti2Image.path_maybe_image(path)[0]:
            raise InputError("expected an image on a voxel grid, got a Cifti2Image")
        for kind in (nibabel.Nifti1Image, nibabel.Nifti2Image, nibabel.MGHImage):
            if kind.path_maybe_image(path)[0]:
                return kind.from_filename(path)
    except InputError:
        raise
    except FileNotFoundError as error:
        # The file exists: nibabel looked for its suffix in another case.
        raise InputError(
            "nibabel cannot read a suffix in mixed case; rename it to lower case"
        ) from error
    except _NIBABEL_HEADER_ERRORS as error:
        raise InputError(f"{UNREADABLE_FILE} ({one_line(error)})") from error
    raise InputError(UNREADABLE_FILE)


def _check_size(
    path: Path, file: SpatialImage, volume: int, is_packed: bool, notes: list[str]
) -> None:
    """Raise InputError unless the file can hold all volumes up to the requested one, before
    memory is allocated.
    """
    proxy: Any = file.dataobj
    volume_bytes = math.prod(file.shape[:3]) * proxy.dtype.itemsize
    n_bytes, size = proxy.offset + (volume + 1) * volume_bytes, path.stat().st_size
    if min(file.shape) < 0 or n_bytes > size * (DEFLATE_RATIO if is_packed else 1):
        raise InputError(
            f"{DAMAGED_FILE} (its header declares {' x '.join(str(each) for each in file.shape)} "
            "voxels, "
            f"{n_bytes:.4g} bytes, but the file has {size})"
        )
    whole = proxy.offset + math.prod(file.shape[3:]) * volume_bytes
    if is_packed:
        size = _check_gzip(path, whole + TRAILING_BYTES)
    elif size > whole + TRAILING_BYTES:  # its checksum would cover all of it
        raise InputError(TOO_LONG.format(whole + TRAILING_BYTES))
    if isinstance(file, nibabel.Nifti1Pair):  # MGH has tags there
        notes += notes_of_rest(size - whole, file.shape, proxy.dtype.itemsize)


def _check_gzip(path: Path, most: int) -> int:
    """Unpack the whole file once, in blocks, and return its size: nibabel stops before the
    checksum at its end.
    """
    n_bytes = 0
    try:
        with gzip.open(path) as stream:
            while block := stream.read(1 << 20):
                n_bytes += len(block)
                if n_bytes > most:
                    raise InputError(TOO_LONG.format(most))
        return n_bytes
    except (OSError, EOFError, zlib.error) as error:
        raise _of_gzip(error) from error


def _of_gzip(error: Exception) -> InputError:
    if "Not a gzipped file" in str(error):
        return InputError(
            "not a gzip file; if it is not compressed, remove .gz (or z) from its name"
        )
    return InputError(f"{DAMAGED_FILE} ({one_line(error)})")


def _units(file: SpatialImage, notes: list[str]) -> NDArray[np.float64] | None:
    """Return the length of the file's unit, mm, for each axis; None if it states none."""
    header: Any = file.header
    if not isinstance(file, nibabel.Nifti1Pair):
        return None
    try:
        unit = header.get_xyzt_units()[0]
    except KeyError:
        notes.append(
            f"its unit of length has the unknown code {header['xyzt_units'] % 8}: assuming mm"
        )
        return None
    return mm_of_axes([unit.replace("unknown", "")] * 3, "xyzt_units", notes)


# Geometry of parts


def part_of(image: Image, slice_: tuple[int, int] | None, crop: Bounds | None) -> Image:
    """Crop and slice an image; slices first, with the same result, so that indices need no
    shift.
    """
    if slice_ is None:
        return image if crop is None else cropped(image, crop)
    plane = image_slice(image, *slice_)
    if crop is None:
        return plane
    bounds = checked_bounds(image.shape, crop)
    _check_in_crop(bounds, *slice_)
    return cropped(plane, [each for axis, each in enumerate(bounds) if axis != slice_[0]])


def _part_of_zarr(
    level: ZarrLevel,
    volume: int | None,
    slice_: tuple[int, int] | None,
    crop: Bounds | None,
    notes: list[str],
) -> Image:
    """Do the same for a Zarr image, of which only this part is read."""
    bounds = checked_bounds(level.shape, [(None, None)] * 3 if crop is None else crop)
    if slice_ is not None:
        axis, index = slice_
        _check_slice(level.shape, axis, index)
        _check_in_crop(bounds, axis, index)
        bounds[axis] = (index, index + 1)
    shape, picks = [stop - start for start, stop in bounds], zarr_picks(level, volume, bounds)
    check_room(shape, level.array.dtype.itemsize)
    check_chunks(level, picks, notes)
    affine = shifted_affine(level.affine, [start for start, _ in bounds])
    part = Image(read_chunks(level, picks, math.prod(shape)), affine)
    return part if slice_ is None else image_slice(part, slice_[0], 0)


def _check_in_crop(bounds: list[tuple[int, int]], axis: int, index: int) -> None:
    start, stop = bounds[axis]
    if not start <= index < stop:
        raise InputError(
            f"slice: index {index} along axis {axis} is outside the crop {start}:{stop}"
        )


def checked_bounds(shape: tuple[int, ...], bounds: Bounds) -> list[tuple[int, int]]:
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


def _plane_affine(columns: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the 2-D affine (3, 3) of a plane in 3-D with voxel steps `columns` (3, 2) and first
    voxel `origin`, mm.
    """
    if not np.isfinite(columns).all():
        raise InputError(f"affine: expected finite entries, got {columns.tolist()}")
    spanned = np.flatnonzero(columns.any(axis=1))
    if len(spanned) == 2:  # the plane of two world axes keeps their coordinates
        frame = np.eye(3)[:, spanned]
    else:
        frame, _ = np.linalg.qr(columns)
        frame *= np.sign(frame[np.abs(frame).argmax(axis=0), [0, 1]])
    affine = np.eye(3)
    affine[:2, :2] = frame.T @ columns
    affine[:2, 2] = frame.T @ origin
    return affine
