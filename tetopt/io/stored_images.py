"""Images that need not fit into memory: folders of Zarr and files that are not compressed, opened but not read."""

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
    folder_checksum,
    image_files,
    named_error,
    nibabel_voxels,
    notes_of_size,
    os_errors_named,
)
from tetopt.io.itk_headers import HEADED_SUFFIXES
from tetopt.io.volumes import VoxelsInFile, check_room
from tetopt.io.zarr_images import METADATA_FILES, ZARR_SUFFIX, check_chunks, is_zarr, open_zarr, zarr_levels

STORED_SUFFIXES = (ZARR_SUFFIX, ".nii")
_PACKED_SUFFIXES = (".nii.gz", ".mgz", ".mgh", ".zarr.zip")


def open_stored(path: str | Path, *, volume: int | None = None, crop: Bounds | None = None) -> Image:
    """An image whose voxels are left where they are.

    Parameters
    ----------
    path : str or Path
        A folder of Zarr: an OME-Zarr image (NGFF 0.4, 0.5; Zarr's format 2 or 3), of whose multiscale the first level
        is taken, or an array with the attribute "affine". An uncompressed file of NIfTI (.nii).
    volume : int, optional
        Which of several, from 0: of a file as in `tetopt.load_image`, of Zarr along its axes of time, channels
        and others, of which the last runs fastest.
    crop : sequence of three (start, stop), optional
        Keep a box of voxels, as in `tetopt.load_image`.

    Returns
    -------
    Image
        What it reads of a file is what `tetopt.load_image` has there, to the bit, and so is the affine. A box that
        cannot be read is an InputError that names the voxels.

    Raises
    ------
    InputError
        ``"<path>: ..."`` in one line: as `tetopt.load_image`; a kind of file that cannot be read in parts; a place on
        the network; Zarr's metadata damaged, without a scale, with other than three axes in space or units that are no
        lengths; values that are no real numbers; codecs that are not known; chunks that are missing where nothing says
        what stands for them, or all of them.

    Warns
    -----
    UserWarning
        No orientation, no unit; chunks that are missing and have a fill value; a box of an odd size.

    See Also
    --------
    load_image : Reads all voxels.

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
        notes += notes_of_size(image)
        if crop is not None:
            image = _cropped(image, checked_bounds(image.shape, crop))
        if image.voxels.chunks is not None:
            check_chunks(image.voxels, notes)
    except InputError as error:
        raise named_error(path, error) from error
    for note in notes:
        warn(f"{path}: {note}")
    return image


def coarse_image(path: str | Path, most_voxels: float, *, volume: int | None = None) -> Image | None:
    """For pictures: the finest level of an OME-Zarr image of at most so many voxels, in its own place.

    Its voxels stay in the file until they are drawn, but are read once, so that what is wrong with them shows. None of
    an image without such a level, and of files that have no levels.

    Raises
    ------
    InputError
        As `open_stored`.
    """
    check_local(path)
    path = Path(path)
    try:
        if not is_zarr(path):
            return None
        few = [level for level in zarr_levels(path, []) if math.prod(level.shape) <= most_voxels]
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
    """SHA-256 of what shows whether an image has changed, without its voxels being read.

    Of a folder of Zarr: names, lengths and times of the last change of all its files, and what is in those of metadata.
    Of a file, and of those beside a header that have its voxels: name, length and time. Two copies of an image have two
    of these; `tetopt.io.images.sha256` is the same for both, and takes as long as reading them.

    Raises
    ------
    InputError
        As `tetopt.io.images.sha256`.
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
    """InputError for a place on the network, whatever becomes of its slashes in a `Path`."""
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(path)):
        raise InputError(f"{path}: is not on this machine; download it, only folders and files here are read")


def _opened(path: Path, volume: int | None, notes: list[str]) -> Image:
    with os_errors_named():
        if is_zarr(path):
            return open_zarr(zarr_levels(path, notes)[0], volume)
        if path.is_dir():
            raise InputError("a folder that is none of Zarr's; convert it to .zarr or .nii first")
    name = check_beginning(path)
    if name.endswith(".nii"):
        return _mapped_nifti(path, volume, notes)
    if name.endswith(HEADED_SUFFIXES):
        raise InputError("is read whole, not in parts; convert it to .zarr or uncompressed .nii first")
    if name.endswith(_PACKED_SUFFIXES):
        raise InputError("is compressed, and cannot be read in parts; unpack it, or convert it to .zarr, first")
    raise InputError(f"cannot be read in parts; expected {', '.join(STORED_SUFFIXES)}")


def _cropped(image: Image, ranges: list[tuple[int, int]]) -> Image:
    affine = image.affine.copy()
    affine[:-1, -1] = image.to_world([start for start, _ in ranges])
    return Image.stored(image.voxels.within(ranges), affine)


class _Scaled:
    """A mapped array whose values are scaled as nibabel scales them; its own slices take 30 times as long, if thin."""

    def __init__(self, mapped: np.memmap, slope: float, inter: float) -> None:
        self.mapped, self.shape, self.dtype = mapped, mapped.shape, mapped.dtype
        self.slope, self.inter = np.float64(slope), np.float64(inter)

    def __getitem__(self, picks: tuple[int | slice, ...]) -> NDArray:
        return apply_read_scaling(np.array(self.mapped[picks]), self.slope, self.inter)


def _mapped_nifti(path: Path, volume: int | None, notes: list[str]) -> Image:
    proxy, index, affine = nibabel_voxels(path, volume, notes)
    if len(proxy.shape) < 3:
        raise InputError(f"expected a volume, got a plane of {proxy.shape} voxels")
    shape = tuple(int(size) for size in proxy.shape)
    with os_errors_named():
        mapped = np.memmap(path, proxy.dtype, "r", int(proxy.offset), shape, order="F")
    scaled = _Scaled(mapped, proxy.slope, proxy.inter)
    voxels = VoxelsInFile(path, scaled, (*(slice(0, size) for size in shape[:3]), *index))
    voxels.dtype = voxels[(slice(0, 1),) * 3].dtype  # scaled, which its own does not tell
    return Image.stored(voxels, affine)
