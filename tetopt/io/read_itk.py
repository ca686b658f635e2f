"""Reading of NRRD, MetaImage and DICOM by SimpleITK, in a separate process after checks of headers and names."""

from __future__ import annotations

import importlib.util
import math
import os
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.apart import read_apart
from tetopt.io.contradictions import notes_of_metaimage, notes_of_nrrd, notes_of_rest
from tetopt.io.itk_headers import checked_header
from tetopt.io.units import mm_of_axes, notes_of_size
from tetopt.io.volumes import UNREADABLE_FILE, one_line, volume_index
from tetopt.system.extras import install_hint
from tetopt.system.incoming import irregular

# ITK chooses its reader by the case-sensitive suffix; naming the reader also opens SCAN.MHA.
ITK_READERS = {
    ".nrrd": "NrrdImageIO",
    ".nhdr": "NrrdImageIO",
    ".mha": "MetaImageIO",
    ".mhd": "MetaImageIO",
    ".dcm": "GDCMImageIO",
}
# DICOM slices may deviate from an even spacing by this fraction of it, because positions are often rounded.
_UNEVEN_FRACTION = 0.05
_SAME_PLACE_MM = 1e-3  # slices closer to each other share one position
SPATIAL_KINDS = ("domain", "space", "???", "none")  # of NRRD's axes; others are times, colours, vectors
# In a folder without DICOM files: subfolders searched, files tried in each, and subfolders listed in the message.
WALKED_FOLDERS, TRIED_FILES, LISTED_FOLDERS = 1000, 3, 8


def read_itk(path: Path, volume: int | None, notes: list[str]) -> tuple[NDArray, NDArray[np.float64]]:
    """Return data and affine of a file; InputError without a leading path."""
    _check_installed()
    if path.suffix.lower() == ".dcm":
        data, affine = read_apart(_volume_of, path, volume, library="SimpleITK")
        return data, affine
    header, size = checked_header(path)
    is_nrrd = path.suffix.lower() in (".nrrd", ".nhdr")
    about = notes_of_nrrd(dict(header.stated), header.sizes) if is_nrrd else notes_of_metaimage(header.stated)
    if header.ratio == 1 and header.skip.isdecimal():  # neither packed nor text
        rest = size - header.n_bytes - int(header.skip) - header.value_bytes
        about += notes_of_rest(rest, header.sizes, header.value_bytes // max(math.prod(header.sizes), 1))
    lengths = (_nrrd_units if is_nrrd else _metaimage_units)(dict(header.stated), about)
    data, affine = read_apart(_volume_of, path, volume, size=size, value_bytes=header.value_bytes, library="SimpleITK")
    n = len(affine) - 1
    affine[:n] *= 1.0 if lengths is None else lengths[:n, None]
    notes += about + notes_of_size(data.shape, affine, lengths)
    return data, affine


def _nrrd_units(fields: dict[str, str], notes: list[str]) -> NDArray[np.float64] | None:
    """Return the lengths of units along the world axes, mm; None if there are none."""
    name, key = ("space units", "spaceunits") if "spaceunits" in fields else ("units", "units")
    if key not in fields:
        return None
    kinds = fields.get("kinds", "").split()
    words = re.findall(r'"((?:[^"\\]|\\.)*)"', fields[key])
    if key == "units":  # of the array's axes, which are the world's without a space
        words = [word for k, word in enumerate(words) if k >= len(kinds) or kinds[k].lower() in SPATIAL_KINDS]
    if len(words) < 2:
        raise InputError(f"{name}: expected a unit in quotation marks per axis, got {fields[key][:80]}")
    return mm_of_axes(words[:3], name, notes)


def _metaimage_units(fields: dict[str, str], notes: list[str]) -> NDArray[np.float64] | None:
    words = [fields.get("DistanceUnits", "").strip("?")] * 3
    return mm_of_axes(words, "DistanceUnits", notes)


def read_dicom_folder(path: Path, volume: int | None) -> tuple[NDArray, NDArray[np.float64]]:
    """Return data and affine of the one DICOM series in a folder; InputError without a leading path."""
    _check_installed()
    files = sorted(path.iterdir())
    for file in files:
        other = None if file.is_symlink() and not file.exists() else irregular(file)
        if other not in (None, "a folder"):  # GDCM opens everything and would block
            raise InputError(f"{file.name} is {other}; move it out of the folder of DICOM files")
    size = sum(file.stat().st_size for file in files if file.is_file())
    data, affine = read_apart(_series_of, path, volume, size=size, library="SimpleITK")
    return data, affine


def _check_installed() -> None:
    if importlib.util.find_spec("SimpleITK") is None:
        raise InputError(f"NRRD, MetaImage and DICOM need SimpleITK; {install_hint('itk', 'SimpleITK')}")


# In the child


def _volume_of(path: str, volume: int | None) -> tuple[NDArray, NDArray[np.float64]]:
    import SimpleITK as sitk

    try:
        reader = sitk.ImageFileReader()
        reader.SetFileName(path)
        reader.SetImageIO(ITK_READERS[Path(path).suffix.lower()])
        reader.ReadImageInformation()
        _check_components(reader.GetNumberOfComponents())
        size = reader.GetSize()
        index = volume_index(size[3:], volume)
        if index:
            reader.SetExtractSize([*size[:3], *(0 for _ in index)])
            reader.SetExtractIndex([0, 0, 0, *index])
        return sitk.GetArrayFromImage(reader.Execute()).T, _ras_affine(reader)
    except RuntimeError as error:
        raise _in_words(error) from error


def _series_of(path: str, volume: int | None) -> tuple[NDArray, NDArray[np.float64]]:
    import SimpleITK as sitk

    try:
        reader = sitk.ImageSeriesReader()
        files = _series_files(Path(path), reader)
        reader.SetFileNames(files)
        # Keep the position of each slice readable.
        reader.MetaDataDictionaryArrayUpdateOn()
        image = reader.Execute()
        _check_components(image.GetNumberOfComponentsPerPixel())
        index = volume_index(image.GetSize()[3:], volume)
        affine = _ras_affine(image)
        _place_slices(affine, reader, len(files))
        data: NDArray = sitk.GetArrayFromImage(image).T
        return data[(slice(None),) * 3 + index] if index else data, affine
    except RuntimeError as error:
        raise _in_words(error) from error


def _in_words(error: RuntimeError) -> InputError:
    # The innermost cause comes last; the "Reason:" after it is an unrelated errno.
    words = re.split(r"ERROR: (?:\w+ ?\(0x[0-9a-f]+\): )?|\[nrrd\] ", one_line(error))[-1]
    return InputError(f"{UNREADABLE_FILE} (SimpleITK: {words.split(' Reason: ')[0]})")


def _series_files(path: Path, reader: Any) -> tuple[str, ...]:
    """Return the files of the one DICOM series in a folder, in the order of their positions."""
    files = sorted(file for file in path.iterdir() if file.is_file())
    series = {uid: reader.GetGDCMSeriesFileNames(str(path), uid) for uid in reader.GetGDCMSeriesIDs(str(path))}
    known = {Path(file).name for names in series.values() for file in names}
    for file in files:
        # GDCM silently skips damaged files, which would shorten the volume.
        if file.name not in known and file.name.upper() != "DICOMDIR" and _is_dicom(file):
            raise InputError(f"the DICOM file {file.name} is truncated or damaged; copy it again")
    if not series:
        folders = islice(_dicom_folders(path), LISTED_FOLDERS)
        if below := ", ".join(f"{folder.relative_to(path)} ({count} files)" for folder, count in folders):
            raise InputError(f"no DICOM series in this folder itself; choose one of its subfolders: {below}")
        raise InputError("no DICOM series in this folder or its subfolders; check the path")
    if len(series) > 1:
        listed = ", ".join(f"{uid} ({len(names)} files)" for uid, names in series.items())
        raise InputError(f"expected one DICOM series, got {len(series)}; put one into its own folder: {listed}")
    return next(iter(series.values()))


def _dicom_folders(path: Path) -> Iterator[tuple[Path, int]]:
    """Yield subfolders that contain DICOM files, within limits, with their numbers of files."""
    for name, folders, files in islice(os.walk(path), WALKED_FOLDERS):
        folders.sort()  # the order in which the walk continues
        first = [Path(name, file) for file in sorted(files)[:TRIED_FILES]]
        if any(file.is_file() and _is_dicom(file) for file in first):
            yield Path(name), len(files)


def _is_dicom(path: Path) -> bool:
    """Return whether a DICOM file's mark follows a preamble of 128 bytes."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def _place_slices(affine: NDArray[np.float64], reader: Any, n_slices: int) -> None:
    """Write the slice axis to `affine` from the slices' own positions, if the files have them.

    ITK orthogonalises the axes of a tilted gantry and only warns of a missing slice; both would silently move anatomy.
    """
    position, orientation = "0020|0032", "0020|0037"
    slices = range(n_slices)
    if n_slices < 2 or not all(reader.HasMetaDataKey(i, tag) for i in slices for tag in (position, orientation)):
        return
    turns = np.array([_numbers(reader.GetMetaData(i, orientation), 6) for i in slices])
    if not np.allclose(turns, turns[0], rtol=0.0, atol=1e-4):
        raise InputError("the DICOM slices are not parallel (a localizer?); choose another series")
    points = np.array([_numbers(reader.GetMetaData(i, position), 3) for i in slices]) * [-1.0, -1.0, 1.0]
    n_places = len(np.unique(np.rint(points / _SAME_PLACE_MM), axis=0))
    if n_places < n_slices:
        raise InputError(
            f"the {n_slices} slices of this DICOM series have {n_places} position{'s' * (n_places > 1)}: it has "
            "several volumes (times, echoes or repeats); convert it to a 4-D NIfTI file, or put the slices of one "
            "volume into a separate folder"
        )
    step = (points[-1] - points[0]) / (n_slices - 1)
    off = np.linalg.norm(points - points[0] - np.arange(n_slices)[:, None] * step, axis=1)
    if off.max() > _UNEVEN_FRACTION * np.linalg.norm(step):
        raise InputError(
            f"the DICOM slices are not evenly spaced ({_unevenness(points, off)}); export the series again, or "
            "resample it to NIfTI"
        )
    affine[:3, 2] = step


def _unevenness(points: NDArray[np.float64], off: NDArray[np.float64]) -> str:
    """Describe where slices at `points`, (n, 3), mm, are uneven: an unusual step, or else the largest `off` (n,)."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    usual = float(np.median(steps))
    is_other = np.abs(steps - usual) > _UNEVEN_FRACTION * usual
    if not is_other.any():
        return f"slice {off.argmax()}, counted from 0, is {off.max():.3g} mm off its even place between first and last"
    k = int(np.abs(steps - usual).argmax())
    where = "elsewhere" if is_other.sum() == 1 else "at most places"
    return (
        f"a step of {steps[k]:.3g} mm between slices {k} and {k + 1}, counted from 0, and {usual:.3g} mm {where}: "
        "one is missing, or several volumes are mixed"
    )


def _numbers(value: str, count: int) -> list[float]:
    """Parse the numbers in a DICOM tag."""
    try:
        numbers = [float(number) for number in value.split("\\")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f'expected {count} numbers for the position of a DICOM slice, got "{value}"; export it again')
    return numbers


def _check_components(count: int) -> None:
    if count > 1:
        raise InputError(f"expected one number per voxel, got {count} (RGB or vectors); convert it to grey first")


def _ras_affine(source: Any) -> NDArray[np.float64]:
    """Return the RAS affine of a SimpleITK image or reader (LPS), for its first three axes or its two."""
    n = min(source.GetDimension(), 3)
    direction = np.reshape(source.GetDirection(), (source.GetDimension(),) * 2)
    affine = np.eye(n + 1)
    affine[:n, :n] = direction[:n, :n] * source.GetSpacing()[:n]
    affine[:n, n] = source.GetOrigin()[:n]
    affine[:2] *= -1.0
    return affine
