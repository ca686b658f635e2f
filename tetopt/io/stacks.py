"""Volumes of slices: TIFF stacks by tifffile, and folders with one picture per slice by Pillow, in a separate process.

Axes are placed as by ITK and 3D Slicer, without a mirror: index (column, row, slice), the first voxel at the origin,
columns to the left, rows to the back and slices to the top. In RAS+ mm, x and y are negative.
"""

from __future__ import annotations

import importlib.util
import logging
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.apart import read_apart
from tetopt.io.contradictions import SAME_SIZE
from tetopt.io.pictures import MOST_PIXELS, PICTURE_SUFFIXES, frame_of, read_picture
from tetopt.io.read_dicom import is_dicom
from tetopt.io.text import plain
from tetopt.io.units import mm_of_unit
from tetopt.io.volumes import UNREADABLE_FILE, check_room, one_line
from tetopt.system.extras import install_hint
from tetopt.system.incoming import irregular

TIFF_SUFFIXES = (".tif", ".tiff")
MM_OF_RESOLUTION = {2: 25.4, 3: 10.0}  # TIFF's ResolutionUnit: inch, cm
SCREEN_DPI = (72.0, 96.0)  # written by default, of no meaning
MOST_CHANNELS = 7  # of an ImageJ composite; tifffile calls the slices of a plain stack channels
AXIS_WORDS = {"C": "channels", "S": "colours", "T": "time points"}


def parse_spacing(text: str) -> tuple[float, ...]:
    """Parse voxel sizes from a command line: one number, or one per axis, separated by commas.

    Raises
    ------
    InputError
        The text does not have this form.

    Examples
    --------
    >>> parse_spacing("0.02"), parse_spacing("0.02, 0.02, 0.05")
    ((0.02,), (0.02, 0.02, 0.05))
    """
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        raise InputError(f'spacing_mm: expected one number or three, such as "0.02,0.02,0.05", got "{text}"') from None


def spacing_of(spacing_mm: float | Sequence[float], n: int) -> NDArray[np.float64]:
    """Return n voxel sizes, mm, from one or n; InputError unless they are positive."""
    sizes = np.atleast_1d(np.asarray(spacing_mm, dtype=np.float64))
    if sizes.shape not in ((1,), (n,)) or not (np.isfinite(sizes) & (sizes > 0.0)).all():
        raise InputError(f"`spacing_mm`: expected one positive number or {n}, mm, got {sizes.tolist()}")
    return np.broadcast_to(sizes, n).copy()


def check_spacing(spacing_mm: float | Sequence[float] | None, own: NDArray[np.float64]) -> None:
    """Raise InputError if `spacing_mm` differs from the file's own voxel sizes, mm; NaN for unknown ones."""
    if spacing_mm is None:
        return
    sizes = spacing_of(spacing_mm, len(own))
    if (np.abs(sizes - own) > SAME_SIZE * own).any():
        raise InputError(
            f"the file has voxels of {_sizes(own)} mm, but `spacing_mm` is {_sizes(sizes)}; omit it or correct the file"
        )


def read_pictures(
    path: Path, volume: int | None, notes: list[str], spacing_mm: float | Sequence[float] | None
) -> tuple[NDArray, NDArray[np.float64]]:  # fmt: skip
    """Return data and affine of a picture, or of a TIFF file's stack of pages; InputError without a leading path."""
    data, own, is_calibrated = None, [], False
    is_tiff = path.name.lower().endswith(TIFF_SUFFIXES)
    if is_tiff and volume is None and importlib.util.find_spec("tifffile") is not None:
        data, own, is_calibrated, said = read_apart(_stack_of, path, value_bytes=MOST_PIXELS, library="tifffile")
        notes += said
    if data is None:
        data, affine = read_picture(path, volume, notes)
        affine[:2] *= 1.0 if spacing_mm is None else spacing_of(spacing_mm, 2)[:, None]
        return data, affine
    stated = np.array([np.nan if mm is None else mm for mm in own])
    if spacing_mm is None:
        if not is_calibrated or np.isnan(stated).any():
            raise InputError(
                f"this stack of {data.shape[2]} slices states no voxel size ({_sizes(stated)} mm); give it by "
                "`spacing_mm`, mm: one number, or three"
            )
        return data, _affine(stated)
    sizes = spacing_of(spacing_mm, 3)
    if is_calibrated:
        check_spacing(spacing_mm, stated)
    elif (np.abs(sizes - stated) > SAME_SIZE * stated).any():
        notes.append(f"its resolution tags say {_sizes(stated)} mm; `spacing_mm` is used, {_sizes(sizes)}")
    return data, _affine(sizes)


def read_slices(
    path: Path, names: list[str], notes: list[str], spacing_mm: float | Sequence[float] | None
) -> tuple[NDArray, NDArray[np.float64]]:  # fmt: skip
    """Return data and affine of a folder of slices, in their order; InputError without a leading path."""
    if spacing_mm is None:
        raise InputError(
            f"this folder of {len(names)} slices states no voxel size; give it by `spacing_mm`: one number, or three"
        )
    series, said = _series(names)
    notes += said
    size = sum((path / name).stat().st_size for name in series)
    data = read_apart(_slices_of, path, series, size=size, value_bytes=MOST_PIXELS, library="Pillow")
    return data, _affine(spacing_of(spacing_mm, 3))


def slice_files(path: Path) -> list[str]:
    """Return the names of the pictures in a folder; none if it also has DICOM files, which they may show."""
    names = []
    for file in path.iterdir():
        if file.name.startswith(".") or irregular(file) is not None:
            continue
        if file.name.lower().endswith(PICTURE_SUFFIXES):
            names.append(file.name)
            continue
        if is_dicom(file):
            return []
    return names


def _series(names: list[str]) -> tuple[list[str], list[str]]:
    """Return the names of one series in the order of their numbers, and notes; InputError for a gap or two series."""
    parts = {name: re.split(r"(\d+)", name) for name in names}
    forms = {name: tuple(part.lower() for part in each[::2]) for name, each in parts.items()}
    form, count = Counter(forms.values()).most_common(1)[0]
    others = sorted(name for name in names if forms[name] != form)
    if count < 2 or len(others) > 1:
        raise InputError(
            f"expected one series of numbered slices, got {', '.join(sorted(names)[:4])} and others; put one series "
            "into its own folder"
        )
    numbers = {name: [int(digits) for digits in parts[name][1::2]] for name in names if forms[name] == form}
    table = np.array(list(numbers.values()), dtype=object)
    varying = [k for k in range(table.shape[1]) if len(set(table[:, k])) > 1]
    if len(varying) != 1:
        raise InputError(f"expected one number that counts the slices in names such as {names[0]}, got {len(varying)}")
    order = sorted(numbers, key=lambda name: numbers[name][varying[0]])
    counts = [numbers[name][varying[0]] for name in order]
    steps = np.diff(counts)
    if (gaps := np.flatnonzero(steps != steps.min())).size or steps.min() == 0:
        k = int(gaps[0]) if gaps.size else int(np.argmin(steps))
        raise InputError(
            f"expected evenly numbered slices, got {order[k]} followed by {order[k + 1]}; a slice is missing or doubled"
        )
    notes = [f"{others[0]} does not belong to the series of {order[0]} and is left out"] if others else []
    notes += [f"its slices are numbered in steps of {steps[0]}; `spacing_mm` is their distance"] if steps[0] > 1 else []
    return order, notes


def _affine(sizes: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.diag([-sizes[0], -sizes[1], sizes[2], 1.0])


def _sizes(sizes: NDArray[np.float64]) -> str:
    return " x ".join("unknown" if np.isnan(size) else f"{size:.6g}" for size in sizes)


# In the child


def _slices_of(path: str, names: list[str]) -> NDArray:
    """Return the voxels (columns, rows, slices) of pictures of one size and type."""
    data: NDArray | None = None
    for k, name in enumerate(names):
        try:
            pixels = frame_of(str(Path(path) / name), None)
        except InputError as error:
            raise InputError(f"{plain(name)}: {error}") from error
        if data is None:
            check_room((*pixels.shape, len(names)), pixels.dtype.itemsize)
            data = np.empty((len(names), *pixels.shape), pixels.dtype)
        if pixels.shape != data.shape[1:] or pixels.dtype != data.dtype:
            raise InputError(
                f"{plain(name)}: expected {data.shape[1]} x {data.shape[2]} pixels of {data.dtype}, as in "
                f"{plain(names[0])}, got {pixels.shape[0]} x {pixels.shape[1]} of {pixels.dtype}"
            )
        data[k] = pixels
    assert data is not None
    return data.T


def _stack_of(path: str) -> tuple[NDArray | None, list[float | None], bool, list[str]]:
    """Return voxels (columns, rows, slices), voxel sizes, whether they are calibrated, and notes; None for one page."""
    import tifffile

    words: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        words.append(one_line(record.getMessage())[:200])
        return False

    logging.getLogger("tifffile").addFilter(keep)
    try:
        # Metadata of these kinds may name other files.
        file = tifffile.TiffFile(path, _multifile=False, is_ome=False, is_mmstack=False, is_ndtiff=False)
    except tifffile.TiffFileError as error:
        raise InputError(f"{UNREADABLE_FILE} (tifffile: {one_line(error)[:200]})") from error
    with file:
        series = file.series
        first = file.pages.first
        pixels = _ome_pixels(first.description)
        if len(series) > 1:
            shapes = ", ".join(" x ".join(map(str, each.shape)) for each in series[:4])
            raise InputError(f"expected slices of one size and type, got {shapes}; export one stack")
        axes = {name: int(size) for name, size in zip(series[0].axes, series[0].shape, strict=True) if size > 1}
        axes |= {name: int(pixels.get(f"Size{name}", 1)) for name in "CT" if int(pixels.get(f"Size{name}", 1)) > 1}
        if len(file.pages) == 1 and set(axes) <= set("YXS") and not words and int(pixels.get("SizeZ", 1)) == 1:
            return None, [], False, []
        notes = []
        is_imagej = first.description.startswith("ImageJ=")
        if is_imagej and set(axes) == set("CYX") and axes["C"] > MOST_CHANNELS and "\nspacing=" in first.description:
            notes.append(f"its {axes.pop('C')} channels have a slice spacing: they are read as slices")
        if wrong := [f"{axes[name]} {word}" for name, word in AXIS_WORDS.items() if name in axes]:
            raise InputError(f"expected a stack of grey slices, got {' and '.join(wrong)}; export one part")
        shape = [int(size) for size in series[0].shape if size > 1]
        if words or len(shape) != 3 or not {"Y", "X"} <= set(axes):
            said = words[0] if words else f"axes {series[0].axes} of {series[0].shape}"
            raise InputError(f"expected a stack of slices of one size, got {said}; export it again")
        if "SizeZ" in pixels and int(pixels["SizeZ"]) != shape[0]:
            raise InputError(
                f"expected the {pixels['SizeZ']} slices of its OME metadata, got {shape[0]}; export it again"
            )
        if first.photometric == 3 and not is_imagej:
            raise InputError("expected grey slices, got a palette of colours; convert it to grey first")
        check_room(shape, series[0].dtype.itemsize)
        data = _values(series[0]).reshape(shape)
        if first.photometric == 0:
            notes.append("its photometric says that 0 is white; values are kept as stored")
        if words:
            raise InputError(f"truncated or damaged; copy it again ({words[0]})")
        own = _ome_sizes(pixels) if pixels else _imagej_sizes(first) if is_imagej else None
        return data.T, own or _resolution(first), own is not None, notes


def _values(series: Any) -> NDArray:
    try:
        values: NDArray = series.asarray()
    except Exception as error:  # tifffile raises any error, also for a missing codec
        if "imagecodecs" in str(error):
            raise InputError(f"its compression needs imagecodecs; {install_hint('tiff', 'imagecodecs')}") from error
        raise InputError(f"truncated or damaged; copy it again (tifffile: {one_line(error)[:200]})") from error
    return values.astype(np.float32) if values.dtype == np.float16 else values


def _ome_pixels(description: str) -> dict[str, str]:
    """Return the attributes of OME-XML's first Pixels element; empty without one."""
    if "OME" not in description[:2000] or "<" not in description[:100]:
        return {}
    try:
        root = ElementTree.fromstring(description)
    except ElementTree.ParseError:
        return {}
    element = next((each for each in root.iter() if each.tag.endswith("}Pixels")), None)
    return {} if element is None else dict(element.attrib)


def _ome_sizes(pixels: dict[str, str]) -> list[float | None]:
    sizes = []
    for axis in "XYZ":
        mm = mm_of_unit(pixels.get(f"PhysicalSize{axis}Unit", "um"), f"PhysicalSize{axis}Unit")
        sizes.append(_product(pixels.get(f"PhysicalSize{axis}"), mm))
    return sizes


def _imagej_sizes(page: Any) -> list[float | None] | None:
    """Return ImageJ's calibration, mm; None if it has no unit of length."""
    fields: dict[str, str] = {}
    for line in page.description.splitlines():
        key, _, fields[key] = line.partition("=")
    if "unit" not in fields or mm_of_unit(fields["unit"]) is None:
        return None
    units = [mm_of_unit(fields.get(name) or fields["unit"], name) for name in ("unit", "yunit", "zunit")]
    steps = [_pixels_per_unit(page, axis) for axis in "XY"]
    in_plane = [None if mm is None or not step else mm / step for mm, step in zip(units[:2], steps, strict=True)]
    return [*in_plane, _product(fields.get("spacing"), units[2])]


def _resolution(page: Any) -> list[float | None]:
    unit = page.tags.get("ResolutionUnit")
    mm = MM_OF_RESOLUTION.get(2 if unit is None else int(unit.value))
    steps = [_pixels_per_unit(page, axis) for axis in "XY"]
    if mm is None or not all(steps) or (mm == MM_OF_RESOLUTION[2] and set(steps) <= {1.0, *SCREEN_DPI}):
        return [None] * 3
    return [*(mm / step for step in steps), None]


def _pixels_per_unit(page: Any, axis: str) -> float:
    tag = page.tags.get(f"{axis}Resolution")
    over, under = (0, 1) if tag is None else tag.value
    return over / under if under else 0.0


def _product(text: str | None, mm: float | None) -> float | None:
    """Return a length in mm; None unless it is positive."""
    try:
        number = float(text or "nan")
    except ValueError:
        return None
    return None if mm is None or not 0.0 < number < np.inf else number * mm
