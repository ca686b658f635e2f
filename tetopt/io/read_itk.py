"""Reading of NRRD and MetaImage by SimpleITK, in a separate process after checks of headers and
names.
"""

from __future__ import annotations

import importlib.util
import math
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.fields.field import Convention
from tetopt.io.apart import read_apart
from tetopt.io.contradictions import note_metaimage, note_nrrd, note_rest
from tetopt.io.itk_headers import (
    LIST_KINDS,
    NRRD_SUFFIXES,
    SPACE_KINDS,
    VoxelHeader,
    check_header,
    header_sizes,
    list_header,
    other_axes,
    read_header,
)
from tetopt.io.segments import labels_of_layers, segments_of
from tetopt.io.units import mm_of_axes, note_size
from tetopt.io.volumes import UNREADABLE_FILE, Reader, Request, Voxels, one_line, volume_index
from tetopt.system.arrays import Floats
from tetopt.system.extras import install_hint

# ITK chooses its reader by the case-sensitive suffix; naming the reader also opens SCAN.MHA.
ITK_READERS = {
    ".nrrd": "NrrdImageIO",
    ".nhdr": "NrrdImageIO",
    ".mha": "MetaImageIO",
    ".mhd": "MetaImageIO",
}
SURE_CONFIDENCE = 0.5  # of a tensor, in NRRD's masked ones from 0 to 1
LEAST_FRAME = 1e-6  # of a measurement frame's vectors, relative to their box, chosen
OTHER_READERS = {".gipl": "GiplImageIO", ".gz": "GiplImageIO", ".vtk": "VTKImageIO"}


def read_itk(path: Path, request: Request) -> Voxels:
    """Return data and affine of a file; InputError without a leading path."""
    header, size = _checked_header(path)
    segments = segments_of(header.texts)
    others = other_axes(header)
    is_list = not segments and bool(others) and set(others.values()) <= set(LIST_KINDS)
    data, affine = _read(path, header, size, request.volume, bool(segments), is_list)
    return labels_of_layers(data, segments) if segments else data, affine


def itk_components(path: Path) -> tuple[NDArray, Floats, Convention]:
    """Return the components of a file, on an axis of NRRD or MetaImage's channels, wherever the
    confidence of a masked tensor is a half or more, else NaN.

    NRRD's measurement frame maps components to its space; without it, axes are not stated.
    """
    header, size = _checked_header(path)
    others = other_axes(header)
    turn = _measurement_turn(header.fields)
    data, affine = _read(path, header, size, None, True, bool(others))
    kind = next(iter(others.values()), "")
    if kind == "3d-masked-symmetric-matrix":
        data = np.where(data[..., :1] >= SURE_CONFIDENCE, data[..., 1:], np.nan)
    order = "upper" if kind.endswith("symmetric-matrix") else None
    return data, affine, Convention(order=order, turn=turn)


def _measurement_turn(fields: dict[str, str]) -> Floats | None:
    """Return the matrix from a header's measurement frame to RAS+; None if it states none."""
    if (words := fields.get("measurementframe")) is None:
        return None
    space = fields.get("space", "").lower().removesuffix("-time")
    letters = space if len(space) == 3 else "".join(word[0] for word in space.split("-"))
    numbers = re.findall(r"[^\s(),]+", words)
    try:
        if re.fullmatch("[rl][ap][si]", letters) is None:
            raise ValueError(f"no axes of a body: {letters}")
        columns = np.array(numbers, dtype=np.float64).reshape(3, 3)
        sizes = np.linalg.norm(columns, axis=1)
        is_finite = np.isfinite(columns).all()
        if not (is_finite and abs(np.linalg.det(columns)) > LEAST_FRAME * sizes.prod()):
            raise ValueError("vectors in one plane, or not finite")
    except ValueError as error:
        raise InputError(
            "measurement frame: expected three vectors, not in one plane, in a space such as "
            f'left-posterior-superior, got {words[:80]} in "{space[:40]}"'
        ) from error
    return columns.T * [[1.0 if letter in "ras" else -1.0] for letter in letters]


def _checked_header(path: Path) -> tuple[VoxelHeader, int]:
    """Return a file's header, checked, and the number of bytes of all its files."""
    check_itk()
    header, size = check_header(path)
    if path.suffix.lower() in NRRD_SUFFIXES:
        note_nrrd(header.fields, header.sizes)
    else:
        note_metaimage(header.fields)
    if header.ratio == 1 and header.skip.isdecimal():  # neither packed nor text
        rest = size - header.n_bytes - int(header.skip) - header.value_bytes
        note_rest(rest, header.sizes, header.value_bytes // max(math.prod(header.sizes), 1))
    return header, size


def _read(
    path: Path, header: VoxelHeader, size: int, volume: int | None, has_layers: bool, is_list: bool
) -> Voxels:
    """Return the data, with layers or components on a last axis, and the affine in mm."""
    units = [header.fields.get("DistanceUnits", "").strip("?")] * 3
    is_nrrd = path.suffix.lower() in NRRD_SUFFIXES
    lengths = _nrrd_units(header.fields) if is_nrrd else mm_of_axes(units, "DistanceUnits")
    others = other_axes(header)
    if is_list and len(others) > 1:
        raise InputError(f"expected one axis beside those of space, got {len(others)}")
    with tempfile.TemporaryDirectory() as folder:
        source = path
        if is_list and (len(header.files) < 2):
            source = Path(folder, "list.nhdr")
            source.write_text(list_header(path, header, *others), "latin-1")
        data, affine = read_apart(
            volume_of,
            source,
            volume,
            has_layers,
            is_list,
            size=size,
            value_bytes=header.value_bytes,
            library="SimpleITK",
        )
    n = len(affine) - 1
    affine[:n] *= 1.0 if lengths is None else lengths[:n, None]
    note_size(data.shape, affine, lengths)
    return data, affine


def check_itk() -> None:
    """Raise InputError without SimpleITK."""
    if importlib.util.find_spec("SimpleITK") is None:
        raise InputError(f"its format needs SimpleITK; {install_hint('SimpleITK')}")


ITK = Reader(
    tuple(ITK_READERS),
    read_itk,
    shape=header_sizes,
    other_files=lambda path: read_header(path).files,
    components=itk_components,
)


def _nrrd_units(fields: dict[str, str]) -> Floats | None:
    """Return the lengths of units along the world axes, mm; None if there are none."""
    name, key = ("space units", "spaceunits") if "spaceunits" in fields else ("units", "units")
    if key not in fields:
        return None
    kinds = fields.get("kinds", "").split()
    words = re.findall(r'"((?:[^"\\]|\\.)*)"', fields[key])
    if key == "units":  # of the array's axes, which are the world's without a space
        words = [
            word
            for k, word in enumerate(words)
            if k >= len(kinds) or kinds[k].lower() in SPACE_KINDS
        ]
    if len(words) < 2:
        raise InputError(
            f"{name}: expected a unit in quotation marks per axis, got {fields[key][:80]}"
        )
    return mm_of_axes(words[:3], name)


# In the child


def volume_of(path: str, volume: int | None, has_layers: bool, is_list: bool) -> Voxels:
    """Return data, with layers on a last axis if it has them, and affine; the volumes of a list
    are components.
    """
    import SimpleITK as sitk

    try:
        reader = sitk.ImageFileReader()
        reader.SetFileName(path)
        reader.SetImageIO((ITK_READERS | OTHER_READERS)[Path(path).suffix.lower()])
        reader.ReadImageInformation()
        count = reader.GetNumberOfComponents()
        if count > 1 and not (has_layers or is_list):
            raise InputError(
                f"expected one number per voxel, got {count} (RGB or vectors); convert it to grey "
                "first"
            )
        size = reader.GetSize()
        index = volume_index((count,) if is_list and not has_layers else size[3:], volume)
        if index and not is_list:
            reader.SetExtractSize([*size[:3], *(0 for _ in index)])
            reader.SetExtractIndex([0, 0, 0, *index])
        data = sitk.GetArrayFromImage(reader.Execute())
        if has_layers or is_list:  # components vary fastest
            data = np.moveaxis(data.reshape(*size[::-1], count), -1, 0)
            data = data[index[0]] if is_list and not has_layers else data
        return data.T, _ras_affine(reader)
    except RuntimeError as error:
        # The innermost cause comes last; the "Reason:" after it is an unrelated errno.
        words = re.split(r"ERROR: (?:\w+ ?\(0x[0-9a-f]+\): )?|\[nrrd\] ", one_line(error))[-1]
        words = words.split(" Reason: ")[0]
        raise InputError(f"{UNREADABLE_FILE} (SimpleITK: {words})") from error


def _ras_affine(source: Any) -> Floats:
    """Return the RAS affine of a SimpleITK image or reader (LPS), for its first three axes or
    its two.
    """
    n = min(source.GetDimension(), 3)
    direction = np.reshape(source.GetDirection(), (source.GetDimension(),) * 2)
    affine = np.eye(n + 1)
    affine[:n, :n] = direction[:n, :n] * source.GetSpacing()[:n]
    affine[:n, n] = source.GetOrigin()[:n]
    affine[:2] *= -1.0
    return affine
