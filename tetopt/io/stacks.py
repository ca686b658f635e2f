"""Volumes of slices: TIFF stacks by tifffile, and folders with one picture per slice by Pillow, in
a separate process.

Axes are placed as by ITK and 3D Slicer, without a mirror: index (column, row, slice), the first
voxel at the origin, columns to the left, rows to the back and slices to the top. In RAS+ mm, x and
y are negative.
"""

from __future__ import annotations

import importlib.util
import logging
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError, prefix_errors
from tetopt.io.apart import read_apart
from tetopt.io.pictures import MOST_PIXELS, PICTURE_SUFFIXES, frame_of, read_picture
from tetopt.io.read_dicom import is_dicom
from tetopt.io.text import plain
from tetopt.io.units import mm_of_unit
from tetopt.io.volumes import (
    UNREADABLE_FILE,
    Reader,
    Request,
    Voxels,
    check_room,
    exact_type,
    note,
    one_line,
)
from tetopt.system.arrays import Floats, Shape
from tetopt.system.extras import install_hint
from tetopt.system.incoming import irregular

TIFF_SUFFIXES = (".tif", ".tiff")
MM_OF_RESOLUTION = {2: 25.4, 3: 10.0}  # TIFF's ResolutionUnit: inch, cm
SAME_SIZE = 1e-3  # relative: rounded voxel sizes
SCREEN_DPI = (72.0, 96.0)  # written by default, of no meaning
MOST_CHANNELS = 7  # of an ImageJ composite; tifffile calls the slices of a plain stack channels
IMAGEJ_LINE, IMAGEJ_NONE = "0", "20"  # numbers of ImageJ's curves from stored to calibrated values
ORIENTATION_TAG = 274  # of TIFF
FLIPPED_AXES = {
    1: (),
    2: (2,),
    3: (1, 2),
    4: (1,),
}  # axes of (slices, rows, columns) that run the other way, as in Pillow
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
        raise InputError(
            f'spacing_mm: expected one number or three, such as "0.02,0.02,0.05", got "{text}"'
        ) from None


def spacing_of(spacing_mm: float | Sequence[float], n: int) -> Floats:
    """Return n voxel sizes, mm, from one or n; InputError unless they are positive."""
    sizes = np.atleast_1d(np.asarray(spacing_mm, dtype=np.float64))
    if sizes.shape not in ((1,), (n,)) or not (np.isfinite(sizes) & (sizes > 0.0)).all():
        raise InputError(
            f"`spacing_mm`: expected one positive number or {n}, mm, got {sizes.tolist()}"
        )
    return np.broadcast_to(sizes, n).copy()


def check_spacing(spacing_mm: float | Sequence[float] | None, own: Floats) -> None:
    """Raise InputError if `spacing_mm` differs from the file's own voxel sizes, mm; NaN for
    unknown ones.
    """
    if spacing_mm is None:
        return
    sizes = spacing_of(spacing_mm, len(own))
    if (np.abs(sizes - own) > SAME_SIZE * own).any():
        raise InputError(
            f"the file has voxels of {_sizes(own)} mm, but `spacing_mm` is {_sizes(sizes)}; omit "
            "it or correct the file"
        )


class Tiff(NamedTuple):
    """What tifffile reads of a file."""

    voxels: NDArray | None  # (columns, rows, slices); None for a page, which Pillow reads
    sizes: Sequence[float | None] = (None,) * 3  # mm, along columns, rows and slices
    is_calibrated: bool = False  # whether the sizes are more than those of a print
    scale: Sequence[float] = (1.0, 0.0)  # slope and intercept of values


def read_pictures(path: Path, request: Request) -> Voxels:
    """Return data and affine of a picture, or of a TIFF file's stack of pages; InputError
    without a leading path.
    """
    tiff = Tiff(None)
    if _is_for_tifffile(path.name):
        is_page = request.volume is not None
        tiff = Tiff(
            *read_apart(_stack_of, path, is_page, value_bytes=MOST_PIXELS, library="tifffile")
        )
    steps = _steps(tiff, 2 if tiff.voxels is None else 3, request.spacing_mm)
    if tiff.voxels is None:
        data, affine = read_picture(path, request.volume)
        affine[:2] *= 1.0 if steps is None else steps[:, None]
        return _scale_values(data, tiff.scale), affine
    if steps is None:
        raise InputError(_no_sizes(f"stack of {tiff.voxels.shape[2]}", tiff))
    return _scale_values(tiff.voxels, tiff.scale), _affine(steps)


def read_slices(path: Path, request: Request) -> Voxels:
    """Return data and affine of a folder of slices, in their order; InputError without a leading
    path.
    """
    series = _series(slice_files(path))
    size = sum((path / name).stat().st_size for name in series)
    tiff = Tiff(
        *read_apart(
            _slices_of,
            path,
            series,
            request.spacing_mm is not None,
            size=size,
            value_bytes=MOST_PIXELS,
            library="Pillow",
        )
    )
    steps = _steps(tiff, 3, request.spacing_mm)
    assert tiff.voxels is not None
    assert steps is not None
    return _scale_values(tiff.voxels, tiff.scale), _affine(steps)


PICTURES = Reader(PICTURE_SUFFIXES, read_pictures, has_spacing=False)
SLICES = Reader((), read_slices, is_this=lambda path: bool(slice_files(path)), has_spacing=False)


def _is_for_tifffile(name: str) -> bool:
    has_library = importlib.util.find_spec("tifffile") is not None
    return name.lower().endswith(TIFF_SUFFIXES) and has_library


def _steps(tiff: Tiff, n: int, spacing_mm: float | Sequence[float] | None) -> Floats | None:
    """Return n voxel sizes, mm, as the file or `spacing_mm` states; None without any. InputError
    if they differ.
    """
    stated = np.array([np.nan if mm is None else mm for mm in tiff.sizes[:n]])
    if spacing_mm is None:
        return None if not tiff.is_calibrated or np.isnan(stated).any() else stated
    sizes = spacing_of(spacing_mm, n)
    if tiff.is_calibrated:
        check_spacing(spacing_mm, stated)
    elif (np.abs(sizes - stated) > SAME_SIZE * stated).any():
        note(f"its resolution tags say {_sizes(stated)} mm; `spacing_mm` is used, {_sizes(sizes)}")
    return sizes


def _no_sizes(what: str, tiff: Tiff) -> str:
    stated = _sizes(np.array([np.nan if mm is None else mm for mm in tiff.sizes]))
    return (
        f"this {what} slices states no voxel size ({stated} mm); give it by `spacing_mm`, "
        "mm: one number, or three"
    )


def _scale_values(values: NDArray, scale: Sequence[float]) -> NDArray:
    slope, intercept = scale
    if (slope, intercept) == (1.0, 0.0):
        return values
    values = values.astype(exact_type(8 * values.itemsize, [(slope, intercept)]))
    values *= slope
    values += intercept
    return values


def slice_files(path: Path) -> list[str]:
    """Return the names of the pictures in a folder; none if it also has DICOM files, which they
    may show.
    """
    names = []
    for file in path.iterdir() if path.is_dir() else ():
        if file.name.startswith(".") or irregular(file) is not None:
            continue
        if file.name.lower().endswith(PICTURE_SUFFIXES):
            names.append(file.name)
            continue
        if is_dicom(file):
            return []
    return names


def _series(names: list[str]) -> list[str]:
    """Return the names of one series in the order of their numbers; InputError for a gap or two
    series.
    """
    parts = {name: re.split(r"(\d+)", name) for name in names}
    forms = {name: tuple(part.lower() for part in each[::2]) for name, each in parts.items()}
    form, count = Counter(forms.values()).most_common(1)[0]
    others = sorted(name for name in names if forms[name] != form)
    if count < 2 or len(others) > 1:
        raise InputError(
            f"expected one series of numbered slices, got {', '.join(sorted(names)[:4])} and "
            "others; put one series into its own folder"
        )
    numbers = {
        name: [int(digits) for digits in parts[name][1::2]] for name in names if forms[name] == form
    }
    table = np.array(list(numbers.values()), dtype=object)
    varying = [k for k in range(table.shape[1]) if len(set(table[:, k])) > 1]
    if len(varying) != 1:
        raise InputError(
            f"expected one number that counts the slices in names such as {names[0]}, got "
            f"{len(varying)}"
        )
    order = sorted(numbers, key=lambda name: numbers[name][varying[0]])
    counts = [numbers[name][varying[0]] for name in order]
    steps = np.diff(counts)
    if (gaps := np.flatnonzero(steps != steps.min())).size or steps.min() == 0:
        k = int(gaps[0]) if gaps.size else int(np.argmin(steps))
        raise InputError(
            f"expected evenly numbered slices, got {order[k]} followed by {order[k + 1]}; a "
            "slice is missing or doubled"
        )
    if others:
        note(f"{others[0]} does not belong to the series of {order[0]} and is left out")
    if steps[0] > 1:
        note(f"its slices are numbered in steps of {steps[0]}; `spacing_mm` is their distance")
    return order


def _affine(sizes: Floats) -> Floats:
    return np.diag([-sizes[0], -sizes[1], sizes[2], 1.0])


def _sizes(sizes: Floats) -> str:
    return " x ".join("unknown" if np.isnan(size) else f"{size:.6g}" for size in sizes)


# In the child


def _slices_of(path: str, names: list[str], has_spacing: bool) -> Tiff:
    """Return the voxels of pictures of one size, type and calibration."""
    data: NDArray | None = None
    first = Tiff(None)
    for k, name in enumerate(names):
        file = str(Path(path) / name)
        with prefix_errors(plain(name)):
            tiff = _stack_of(file, True) if _is_for_tifffile(name) else Tiff(None)
            first = tiff if k == 0 else first
            if not has_spacing and (not tiff.is_calibrated or None in tiff.sizes):
                break
            pixels = frame_of(file, None)
        if data is None:
            check_room((*pixels.shape, len(names)), pixels.dtype.itemsize)
            data = np.empty((len(names), *pixels.shape), pixels.dtype)
        if pixels.shape != data.shape[1:] or pixels.dtype != data.dtype:
            raise InputError(
                f"{plain(name)}: expected {data.shape[1]} x {data.shape[2]} pixels of "
                f"{data.dtype}, as in "
                f"{plain(names[0])}, got {pixels.shape[0]} x {pixels.shape[1]} of {pixels.dtype}"
            )
        calibrations = [(each.scale, each.is_calibrated and each.sizes) for each in (tiff, first)]
        if calibrations[0] != calibrations[1]:
            raise InputError(
                f"{plain(name)}: expected the pixel size and calibration of {plain(names[0])}, "
                "got others"
            )
        data[k] = pixels
    else:
        assert data is not None
        return first._replace(voxels=data.T)
    raise InputError(_no_sizes(f"folder of {len(names)}", first))


def _stack_of(path: str, is_page: bool) -> Tiff:
    """Return the voxels of a file's pages, and what the first one states; no voxels of one page,
    or with `is_page`.
    """
    import tifffile

    words: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        words.append(one_line(record.getMessage())[:200])
        return False

    logging.getLogger("tifffile").addFilter(keep)
    try:
        # Metadata may name other files.
        file = tifffile.TiffFile(path, _multifile=False, is_mmstack=False, is_ndtiff=False)
    except tifffile.TiffFileError as error:
        raise InputError(f"{UNREADABLE_FILE} (tifffile: {one_line(error)[:200]})") from error
    with file:
        first = file.pages.first
        tiff = _tiff_of(first)
        if is_page:
            return tiff
        series = file.series
        axes = _stack_axes(file)
        n_slices = int(_ome_pixels(first.description).get("SizeZ", 1))
        if len(file.pages) == 1 and set(axes) <= set("YXS") and not words and n_slices == 1:
            return tiff
        if words:
            raise InputError(f"truncated or damaged; copy it again ({words[0]})")
        shape = _stack_shape(file, axes)
        flips = _axes_to_flip(first)
        check_room(shape, series[0].dtype.itemsize)
        parts = [_values(each) for each in series]
        data = (parts[0] if len(parts) == 1 else np.stack(parts)).reshape(shape)
        if words:
            raise InputError(f"truncated or damaged; copy it again ({words[0]})")
        return tiff._replace(voxels=np.flip(data, flips).T)


def _stack_axes(file: Any) -> dict[str, int]:
    """Return the lengths of a file's axes, if above 1, by tifffile's letters, also those of OME."""
    pixels = _ome_pixels(file.pages.first.description)
    series = file.series[0]
    axes = zip(series.axes, series.shape, strict=True)
    of_ome = ((name, pixels.get(f"Size{name}", 1)) for name in "CT")
    return {name: int(size) for name, size in (*axes, *of_ome) if int(size) > 1}


def _stack_shape(file: Any, axes: dict[str, int]) -> list[int]:
    """Return the numbers of slices, rows and columns; InputError unless the pages are one stack."""
    series = file.series
    description = file.pages.first.description
    # A program may write a page at a time, each as a picture of its own.
    is_apart = all((each.kind, each.axes) == ("shaped", "YX") for each in series)
    if len({(each.shape, each.dtype) for each in series}) > 1 or (len(series) > 1 and not is_apart):
        shapes = ", ".join(" x ".join(map(str, each.shape)) for each in series[:4])
        raise InputError(f"expected slices of one size and type, got {shapes}; export one stack")
    is_imagej = description.startswith("ImageJ=") and "\nspacing=" in description
    if is_imagej and set(axes) == set("CYX") and axes["C"] > MOST_CHANNELS:
        note(f"its {axes.pop('C')} channels have a slice spacing: they are read as slices")
    if wrong := [f"{axes[name]} {word}" for name, word in AXIS_WORDS.items() if name in axes]:
        raise InputError(
            f"expected a stack of grey slices, got {' and '.join(wrong)}; export one part"
        )
    shape = [int(size) for size in (len(series), *series[0].shape) if size > 1]
    if len(shape) != 3 or not {"Y", "X"} <= set(axes):
        said = f"axes {series[0].axes} of {series[0].shape}"
        raise InputError(f"expected a stack of slices of one size, got {said}; export it again")
    if (pixels := _ome_pixels(description)) and series[0].kind != "ome":
        raise InputError(
            f"expected the {pixels.get('SizeZ')} slices of its OME metadata, which are in other "
            "files, or not as it says; export it again as one file"
        )
    return shape


def _axes_to_flip(page: Any) -> Shape:
    """Return the axes of a stack that run the other way; InputError for colours, or swapped
    axes.
    """
    if page.photometric == 3 and not page.description.startswith("ImageJ="):
        raise InputError("expected grey slices, got a palette of colours; convert it to grey first")
    tag = page.tags.get(ORIENTATION_TAG)
    orientation = 1 if tag is None else int(tag.value)
    if orientation not in FLIPPED_AXES:
        raise InputError(f"its Orientation {orientation} swaps rows and columns; export it upright")
    return FLIPPED_AXES[orientation]


def _tiff_of(page: Any) -> Tiff:
    """Return what a page states of its voxels."""
    if page.photometric == 0:
        note("its photometric says that 0 is white; values are kept as stored")
    fields: dict[str, str] = {}
    for line in page.description.splitlines() if page.description.startswith("ImageJ=") else ():
        key, _, fields[key] = line.partition("=")
    pixels = _ome_pixels(page.description)
    own = _ome_sizes(pixels) if pixels else _imagej_sizes(page, fields)
    is_unsigned = page.dtype is not None and page.dtype.kind == "u"
    scale = _imagej_scale(fields) if is_unsigned else (1.0, 0.0)
    return Tiff(None, own or _resolution(page), own is not None, scale)


def _imagej_scale(fields: dict[str, str]) -> tuple[float, float]:
    """Return slope and intercept of ImageJ's calibration, if it is a straight line; others are
    noted.
    """
    curve = fields.get("cf", IMAGEJ_LINE if {"c0", "c1"} <= fields.keys() else IMAGEJ_NONE)
    if curve == IMAGEJ_LINE:
        try:
            slope = float(fields["c1"])
            intercept = float(fields["c0"])
            if slope and np.isfinite([slope, intercept]).all():
                return slope, intercept
        except (KeyError, ValueError):
            pass
    if curve != IMAGEJ_NONE:
        note(
            "its values are as stored: ImageJ's calibration of them is no straight line and is "
            "not applied"
        )
    return 1.0, 0.0


def _values(series: Any) -> NDArray:
    try:
        values: NDArray = series.asarray()
    except Exception as error:  # tifffile raises any error, also for a missing codec
        if "imagecodecs" in str(error):
            raise InputError(
                f"its compression needs imagecodecs; {install_hint('imagecodecs')}"
            ) from error
        raise InputError(
            f"truncated or damaged; copy it again (tifffile: {one_line(error)[:200]})"
        ) from error
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


def _imagej_sizes(page: Any, fields: dict[str, str]) -> list[float | None] | None:
    """Return ImageJ's calibration, mm; None if it has no unit of length."""
    if "unit" not in fields or mm_of_unit(fields["unit"]) is None:
        return None
    units = [
        mm_of_unit(fields.get(name) or fields["unit"], name) for name in ("unit", "yunit", "zunit")
    ]
    steps = [_pixels_per_unit(page, axis) for axis in "XY"]
    in_plane = [
        None if mm is None or not step else mm / step
        for mm, step in zip(units[:2], steps, strict=True)
    ]
    return [*in_plane, _product(fields.get("spacing"), units[2])]


def _resolution(page: Any) -> list[float | None]:
    unit = page.tags.get("ResolutionUnit")
    mm = MM_OF_RESOLUTION.get(2 if unit is None else int(unit.value))
    steps = [_pixels_per_unit(page, axis) for axis in "XY"]
    if (
        mm is None
        or not all(steps)
        or (mm == MM_OF_RESOLUTION[2] and set(steps) <= {1.0, *SCREEN_DPI})
    ):
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
