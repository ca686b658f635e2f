"""Images that may exceed memory: Zarr folders and uncompressed files, opened without reading
their voxels.
"""

from __future__ import annotations

import hashlib
import math
import re
from pathlib import Path

import numpy as np
from nibabel.volumeutils import apply_read_scaling
from numpy.typing import NDArray

from tetopt.errors import InputError, warn
from tetopt.image import Image
from tetopt.io.images import (
    Bounds,
    check_beginning,
    checked_bounds,
    cropped_in_file,
    folder_checksum,
    image_files,
    named_error,
    nibabel_voxels,
    os_errors_named,
)
from tetopt.io.volumes import VoxelsInFile, check_room
from tetopt.io.zarr_images import (
    METADATA_FILES,
    ZARR_SUFFIX,
    check_chunks,
    is_zarr,
    open_zarr,
    zarr_levels,
)

STORED_SUFFIXES = (ZARR_SUFFIX, ".nii")


def open_stored(
    path: str | Path, *, volume: int | None = None, crop: Bounds | None = None
) -> Image:
    """Open an image whose voxels stay in their file.

    Parameters
    ----------
    path : str or Path
        A Zarr folder: an OME-Zarr image (NGFF 0.4, 0.5; Zarr format 2 or 3), whose first multiscale
        level is used, or an array with the attribute "affine". Or an uncompressed NIfTI file
        (.nii).
    volume : int, optional
        One of several volumes, from 0: for files as in `tetopt.load_image`, for Zarr along its axes
        of time, channels and others; the last varies fastest.
    crop : sequence of three (start, stop), optional
        Keep a box of voxels, as in `tetopt.load_image`.

    Returns
    -------
    Image
        Its voxels and affine equal those of `tetopt.load_image` to the last bit. A box that cannot
        be read raises an InputError that names the voxels.

    Raises
    ------
    InputError
        ``"<path>: ..."``: the reasons of `tetopt.load_image`; the file cannot be read in parts, or
        is on the network; Zarr metadata are damaged, without a scale, do not have three spatial
        axes, or have units that are not lengths; values are not real numbers; codecs are unknown;
        chunks without a fill value are missing, or all chunks.

    Warns
    -----
    UserWarning
        The image has no orientation or no unit; chunks with a fill value are missing; the size of
        its box is unusual.

    See Also
    --------
    load_image : Read all voxels.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> tetopt.save_image("ball.nii", image)
    >>> stored = tetopt.open_stored("ball.nii")
    >>> len(tetopt.octree_mesh(stored, 300).points) == len(tetopt.octree_mesh(image, 300).points)
    True
    """
    check_local(path)
    path = Path(path)
    notes: list[str] = []
    try:
        image = _opened(path, volume, notes)
        if crop is not None:
            image = cropped_in_file(image, checked_bounds(image.shape, crop))
        if image.voxels.chunks is not None:
            check_chunks(image.voxels, notes)
    except InputError as error:
        raise named_error(path, error) from error
    for note in notes:
        warn(f"{path}: {note}")
    return image


def coarse_image(
    path: str | Path, most_voxels: float, *, volume: int | None = None
) -> Image | None:
    """Open the finest level of an OME-Zarr image with at most `most_voxels` voxels, for pictures.

    Its voxels stay in the file until they are drawn, but are read once here to detect errors.
    Returns None for an image without such a level, and for files without levels.

    Raises
    ------
    InputError
        For the reasons of `open_stored`.
    """
    path = Path(path)
    try:
        levels = zarr_levels(path, []) if is_zarr(path) else []
        few = [level for level in levels if math.prod(level.shape) <= most_voxels]
        if not few:
            return None
        image = open_zarr(max(few, key=lambda level: math.prod(level.shape)), volume)
        check_chunks(image.voxels, [])
        check_room(image.shape, image.voxels.dtype.itemsize)
        image.box((0, 0, 0), image.shape)
        return image
    except InputError as error:
        raise named_error(path, error) from error


def stored_checksum(path: str | Path) -> str:
    """Return a SHA-256 that changes with an image, without reading its voxels.

    For a Zarr folder it covers names, lengths and modification times of all files, and the contents
    of metadata files. For a file, and the data files of a header, it covers name, length and
    modification time. Two copies of an image have different checksums; `tetopt.io.images.sha256` is
    the same for both, but takes as long as reading them.

    Raises
    ------
    InputError
        For the reasons of `tetopt.io.images.sha256`.
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


def check_local(path: str | Path) -> None:
    """Raise InputError for a URL, even if a `Path` has changed its slashes."""
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(path)):
        raise InputError(f"{path}: expected a local file or folder, got a URL; download it first")


def _opened(path: Path, volume: int | None, notes: list[str]) -> Image:
    with os_errors_named():
        if is_zarr(path):
            return open_zarr(zarr_levels(path, notes)[0], volume)
        if path.is_dir():
            raise InputError(
                "expected a Zarr folder, got another folder; convert it to .zarr or .nii first"
            )
    name = check_beginning(path)
    if name.endswith(".nii"):
        return _mapped_nifti(path, volume, notes)
    raise InputError(
        "cannot be read in parts; unpack or convert it to .zarr or uncompressed .nii first"
    )


class _Scaled:
    """A mapped array with nibabel's scaling of values; nibabel's own thin slices take 30 times
    as long.
    """

    def __init__(self, mapped: np.memmap, slope: float, inter: float) -> None:
        self.mapped, self.shape, self.dtype = mapped, mapped.shape, mapped.dtype
        self.slope, self.inter = np.float64(slope), np.float64(inter)

    def __getitem__(self, picks: tuple[int | slice, ...]) -> NDArray:
        return apply_read_scaling(np.array(self.mapped[picks]), self.slope, self.inter)


def _mapped_nifti(path: Path, volume: int | None, notes: list[str]) -> Image:
    proxy, index, affine = nibabel_voxels(path, volume, notes)
    if len(proxy.shape) < 3:
        raise InputError(f"expected a 3-D image, got {proxy.shape} voxels")
    shape = tuple(int(size) for size in proxy.shape)
    with os_errors_named():
        mapped = np.memmap(path, proxy.dtype, "r", int(proxy.offset), shape, order="F")
    scaled = _Scaled(mapped, proxy.slope, proxy.inter)
    voxels = VoxelsInFile(path, scaled, (*(slice(0, size) for size in shape[:3]), *index))
    voxels.dtype = voxels[(slice(0, 1),) * 3].dtype  # of scaled values
    return Image.stored(voxels, affine)
