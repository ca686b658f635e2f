"""Reading of DICOM by pydicom, in a separate process: series of slices, files of many frames, and
segmentations.

A file has one frame or many; each frame states where it lies, itself or by what the file states of
all. The frames of one volume, of one file or of a whole series, are sorted by position and checked
in one place (`_place_frames`): parallel, evenly spaced, one of each position. A segmentation leaves
out empty frames, so its slices may be missing.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.padding import replace_padding
from tetopt.errors import InputError
from tetopt.io.apart import read_apart
from tetopt.io.text import count_text, plain
from tetopt.io.units import note_size
from tetopt.io.volumes import (
    UNREADABLE_FILE,
    Reader,
    Request,
    Voxels,
    check_room,
    exact_type,
    note,
    one_line,
    volume_index,
)
from tetopt.model.label_names import LabelTable
from tetopt.system.arrays import Floats, Ints, Json, Shape
from tetopt.system.extras import install_hint
from tetopt.system.incoming import irregular

# Slices may deviate from an even spacing by this fraction of it, because positions are often
# rounded.
_UNEVEN_FRACTION = 0.05
_SAME_PLACE_MM = 1e-3  # slices closer to each other share one position
_SAME_DIRECTION = 1e-4  # of direction cosines
# In a folder without DICOM files: subfolders searched, files tried in each, and subfolders listed
# in the message.
WALKED_FOLDERS, TRIED_FILES, LISTED_FOLDERS = 1000, 3, 8
# How files without DICOM's mark begin: a tag of group 8, or that group's length.
FIRST_TAGS = re.compile(rb"\x08\0(\0\0(UL\x04\0|\x04\0\0\0)|[\x01\x05\x08\x12-\x18]\0)")
LISTED_OVERLAPS = 3  # pairs of segments in a message
SEGMENT_FRACTION = 0.5  # of a voxel: from this fraction on, it belongs to a segment
VOXELS = ("PixelData", "FloatPixelData", "DoubleFloatPixelData")
# Tags by which dimensions order frames in space, or segments; others distinguish volumes, such as
# echoes.
SPATIAL_DIMENSIONS = (
    0x00200032,
    0x00200037,
    0x00209056,
    0x00209057,
    0x00209113,
    0x00209128,
    0x0062000B,
)
AXIAL_DIRECTIONS = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)  # of rows and columns that are not stated
# empty slices between the frames of a segmentation, for each slice with one; more are reported
MOST_EMPTY = 10
ALONE = "put the files of one into a separate folder"
NO_PLACES = (
    "does not state where its {} frames lie (cine, or an old kind of file); convert it with a "
    "program that knows, such as dcm2niix, or export a series of slices"
)


class DicomFile(NamedTuple):
    """A file with voxels."""

    name: str  # subject of messages
    tags: Any  # pydicom's Dataset

    @property
    def n_frames(self) -> int:
        """Number of frames by the header, at least 1."""
        return max(int(self.tags.get("NumberOfFrames") or 1), 1)

    @property
    def size(self) -> tuple[int, int]:
        """Numbers of columns and rows."""
        return int(self.tags.Columns), int(self.tags.Rows)

    @property
    def is_segmentation(self) -> bool:
        """Whether its frames are of segments, and not of a scan."""
        return "SegmentSequence" in self.tags


class Frame(NamedTuple):
    """A plane of voxels, by what its file states; lengths in mm, LPS."""

    name: str  # subject of messages
    file: DicomFile
    number: int  # among the frames of the file, from 0
    place: tuple[float, ...]  # of its first voxel; empty if unknown
    # directions of its rows (along which columns are counted), and of its columns
    axes: tuple[float, ...]
    pixel: tuple[float, ...]  # between rows, and between columns; empty if unknown
    step: float  # to the next slice; 0 if unknown
    thickness: float  # 0 if unknown
    scale: tuple[float, float]  # slope and intercept of its values
    volume: tuple[str, int]  # stack, and time
    others: Shape  # indices of other dimensions than these and the position
    segment: int


def read_dicom(path: Path, request: Request) -> Voxels:
    """Return data and affine of a file, or of the one series in a folder; InputError without a
    leading path.
    """
    data, affine = _read(image_of, path, request.volume)
    note_size(data.shape, affine, np.ones(3))  # DICOM's unit is the mm
    return data, affine


# any folder, and files with DICOM's mark, as scanners name files without a suffix
DICOM = Reader((".dcm",), read_dicom, is_this=lambda path: path.is_dir() or is_dicom(path))


def read_segments_table(path: Path) -> LabelTable:
    """Return names and colours of the segments in a file; none for other kinds of DICOM."""
    rows = _read(segments_of, path)
    names, colours = ({row[0]: row[part] for row in rows if row[part]} for part in (1, 2))
    return LabelTable(names, {number: tuple(parts) for number, parts in colours.items()})


def frame_of_reference(path: Path) -> str | None:
    """Return the UID of the frame of reference of a file or a folder's first; None if not DICOM
    or without one.
    """
    first = next(dicom_files(path), None)
    return None if first is None else _read(frame_of, first)


def dicom_files(path: Path) -> Iterator[Path]:
    """Yield the DICOM files in a folder, by name, or the file itself if it is one."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return (file for file in files if file.is_file() and is_dicom(file))


def dicom_file(path: Path) -> Path | None:
    """Return the path if it is a DICOM file, or the only one in this folder; otherwise None."""
    files = list(islice(dicom_files(path), 2))
    return files[0] if len(files) == 1 else None


def _read(read: Callable[..., Any], path: Path, *rest: Any) -> Any:
    if importlib.util.find_spec("pydicom") is None:
        raise InputError(
            f"DICOM needs pydicom; {install_hint('pydicom', 'python-gdcm')}, or dcm2niix "
            "converts it"
        )
    size = None
    if path.is_dir():
        files = sorted(path.iterdir())
        for file in files:
            other = None if file.is_symlink() and not file.exists() else irregular(file)
            if other not in (None, "a folder"):
                raise InputError(
                    f"{file.name} is {other}; move it out of the folder of DICOM files"
                )
        tree = (Path(name, file) for name, _, names in _walk(path) for file in names)
        size = sum(file.stat().st_size for file in tree if file.is_file())
    return read_apart(read, path, *rest, size=size, library="pydicom")


# In the child


def image_of(path: str, volume: int | None) -> Voxels:
    """Return data and affine."""
    files = _series(Path(path))
    is_segmentation = any(file.is_segmentation for file in files)
    if is_segmentation and len(files) > 1:
        raise InputError(
            f"expected one segmentation, got {len(files)} DICOM files of a series with one; {ALONE}"
        )
    for file in files:
        _check_voxels(file)
        _check_bits(file)
    _check_sizes(files)
    _check_world(files)
    frames = _one_volume([frame for file in files for frame in _frames(file)], volume)
    affine, slices = _place_frames(frames, is_sparse=is_segmentation)
    shape = (int(slices.max()) + 1, *files[0].size[::-1])
    check_room(shape[::-1], np.dtype(np.float32).itemsize)
    data = (_number_segments if is_segmentation else _rescale_frames)(frames, slices, shape)
    return data.T, affine


def segments_of(path: str) -> list[tuple[int, str, list[float]]]:
    """Return number, name and colour of each segment; a name that several segments have gets
    their numbers.
    """
    rows = []
    for file in _series(Path(path)):
        for number, segment in _segments(file).items():
            lab = segment.get("RecommendedDisplayCIELabValue")
            rows.append(
                (number, _name(segment), [] if lab is None else _srgb([int(part) for part in lab]))
            )
    count = Counter(name for _, name, _ in rows)
    return [
        (number, name if count[name] == 1 or not name else f"{name} {number}", tone)
        for number, name, tone in rows
    ]


def frame_of(path: str) -> str | None:
    """Return the UID of a file's frame of reference."""
    import pydicom

    with _errors_of("the file"):
        return _world(pydicom.dcmread(path, force=True, stop_before_pixels=True))


def _world(tags: Any) -> str | None:
    return plain(str(tags.get("FrameOfReferenceUID") or "")) or None


def _segments(file: DicomFile) -> dict[int, Any]:
    """Return what a file states of each segment, by number."""
    segments: dict[int, Any] = {}
    for each in file.tags.get("SegmentSequence") or ():
        first = segments.setdefault(int(each.SegmentNumber), each)
        if first is not each:
            raise InputError(
                f'{file.name} has two segments {each.SegmentNumber}, "{_name(first)}" and '
                f'"{_name(each)}"; export it '
                "again"
            )
    return segments


def _name(segment: Any) -> str:
    return plain(one_line(segment.get("SegmentLabel") or segment.get("SegmentDescription") or ""))


def _srgb(lab: Sequence[int]) -> list[float]:
    """Convert DICOM's CIELAB, 16 bits a part, to sRGB, 0 to 1; white is D65's, as in the
    programs that write it.
    """
    lightness, a, b = np.array(lab) / 65535.0 * [100.0, 255.0, 255.0] - [0.0, 128.0, 128.0]
    y = (lightness + 16.0) / 116.0
    f = np.array([y + a / 500.0, y, y - b / 200.0])
    xyz = np.where(f > 6.0 / 29.0, f**3, (f - 4.0 / 29.0) * 108.0 / 841.0) * [0.95047, 1.0, 1.08883]
    linear = (
        np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
        @ xyz
    )
    gamma = 1.055 * np.maximum(linear, 0.0) ** (1.0 / 2.4) - 0.055
    return np.clip(np.where(linear > 0.0031308, gamma, 12.92 * linear), 0.0, 1.0).tolist()


# Files


def _series(path: Path) -> list[DicomFile]:
    """Open the file, or the files of the one series in a folder, in the order of their names."""
    if not path.is_dir():
        file = _open_dicom(path, "the file")
        if file is None:
            raise InputError(UNREADABLE_FILE)
        if words := _no_voxels(file):
            raise InputError(f"{file.name} {words}")
        return [file]
    series: dict[str, list[DicomFile]] = {}
    skipped = list[str]()
    for each in list(dicom_files(path)) or _files_below(path):
        if each.name.upper() == "DICOMDIR":
            continue
        if (file := _open_dicom(each, f"the DICOM file {each.name}")) is None:
            continue
        if (words := _no_voxels(file)) and "Rows" in file.tags:
            raise InputError(f"{file.name} {words}")
        if words:
            skipped.append(f"skipped {each.name}, which {words.partition(';')[0]}")
            continue
        series.setdefault(str(file.tags.get("SeriesInstanceUID", "")), []).append(file)
    if not series:
        folders = islice(_dicom_folders(path), LISTED_FOLDERS)
        if below := ", ".join(
            f"{folder.relative_to(path)} ({count} files)" for folder, count in folders
        ):
            raise InputError(
                f"no DICOM series in this folder itself; choose one of its subfolders: {below}"
            )
        first = f" ({skipped[0]})" if skipped else ""
        raise InputError(f"no DICOM series in this folder or its subfolders{first}; check the path")
    if len(series) > 1:
        listed = ", ".join(f"{uid} ({len(files)} files)" for uid, files in series.items())
        raise InputError(
            f"expected one DICOM series, got {len(series)}; put one into its own folder: {listed}"
        )
    note(*skipped)
    return next(iter(series.values()))


def _files_below(path: Path) -> list[Path]:
    """Return the DICOM files in subfolders, if the first of each is of one series."""
    import pydicom

    parts = [list(dicom_files(folder)) for folder, _ in _dicom_folders(path)]
    with _errors_of("a file in a subfolder"):
        heads = [pydicom.dcmread(part[0], force=True, stop_before_pixels=True) for part in parts]
    is_one = len({str(head.get("SeriesInstanceUID", "")) for head in heads}) == 1
    return [file for part in parts for file in part] if is_one else []


def _walk(path: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    for name, folders, files in islice(os.walk(path), WALKED_FOLDERS):
        folders.sort()  # the order in which the walk continues
        yield name, folders, files


def _dicom_folders(path: Path) -> Iterator[tuple[Path, int]]:
    """Yield subfolders that contain DICOM files, within limits, with their numbers of files."""
    for name, _, files in _walk(path):
        first = [Path(name, file) for file in sorted(files)[:TRIED_FILES]]
        if any(file.is_file() and is_dicom(file) for file in first):
            yield Path(name), len(files)


def is_dicom(path: Path) -> bool:
    """Return whether the file has DICOM's mark after 128 bytes, or begins with a first tag, as
    older files do.
    """
    with path.open("rb") as stream:
        head = stream.read(132)
    return head[128:] == b"DICM" or FIRST_TAGS.match(head) is not None


def _open_dicom(path: Path, name: str) -> DicomFile | None:
    """Open a file whole; None if it is not DICOM."""
    import pydicom

    with _errors_of(name):
        tags = pydicom.dcmread(path, force=True)
        if (
            "SOPClassUID" not in tags
            and "Rows" not in tags
            and "DirectoryRecordSequence" not in tags
        ):
            if tags.preamble is None:
                return None
            raise InputError(f"{name} is truncated or damaged; copy it again")
        # an older file, or one without its first part
        if "TransferSyntaxUID" not in tags.file_meta:
            is_implicit, _ = tags.original_encoding
            plain = (
                pydicom.uid.ImplicitVRLittleEndian
                if is_implicit
                else pydicom.uid.ExplicitVRLittleEndian
            )
            tags.file_meta.TransferSyntaxUID = plain
        return DicomFile(name, tags)


@contextlib.contextmanager
def _errors_of(name: str) -> Iterator[None]:
    """Name the file in errors; libraries raise any error on damaged files."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        words = f"{type(error).__name__}: {one_line(error)[:200]}"
        raise InputError(f"{name} is truncated or damaged; copy it again ({words})") from error


def _no_voxels(file: DicomFile) -> str:
    """Describe a file without voxels as a predicate; empty if it has some."""
    tags = file.tags
    if any(keyword in tags for keyword in VOXELS):
        return ""
    if "DirectoryRecordSequence" in tags:
        return "is a DICOMDIR, a list of files; give the folder with one series"
    if "Rows" in tags:
        return "has no pixel data; copy or export it again"
    kind = getattr(tags.get("SOPClassUID"), "name", "DICOM object")
    if "ROIContourSequence" in tags:
        return (
            f"is of the kind {kind}: contours, no voxels; convert them to a label image, as "
            "3D Slicer can"
        )
    return f"is of the kind {kind}, without voxels; give the images themselves"


def _check_voxels(file: DicomFile) -> None:
    """Raise InputError unless the voxels are numbers that can be decoded here."""
    from pydicom.pixels import get_decoder

    tags = file.tags
    with _errors_of(file.name):
        if (count := int(tags.get("SamplesPerPixel") or 1)) > 1:
            raise InputError(
                f"{file.name} has {count} numbers per voxel (RGB or vectors); convert it to grey "
                "first"
            )
        if tags.get("PhotometricInterpretation") == "PALETTE COLOR" and not file.is_segmentation:
            raise InputError(f"{file.name} has colours from a palette; convert it to grey first")
        if "MOSAIC" in (tags.get("ImageType") or ()):
            raise InputError(
                f"{file.name} is a mosaic: its slices lie side by side in one picture; dcm2niix "
                "converts it"
            )
        syntax = tags.file_meta.TransferSyntaxUID
        try:
            is_known = get_decoder(syntax).is_available
        except NotImplementedError:
            is_known = False
        if not is_known:
            hint = f"{install_hint('python-gdcm')}, or decompress it with gdcmconv or dcmdjpeg"
            raise InputError(
                f"{file.name} is compressed as {syntax.name}, which cannot be decoded here; {hint}"
            )
        n_bytes = max(len(tags[keyword].value) for keyword in VOXELS if keyword in tags)
        columns, rows = file.size
        least = (
            8 * file.n_frames
            if syntax.is_compressed
            else -(-file.n_frames * rows * columns * int(tags.BitsAllocated) // 8)
        )
        if not min(columns, rows, n_bytes) > 0 or least > n_bytes:
            raise InputError(
                f"{file.name} is truncated or damaged: its header declares {file.n_frames} x "
                f"{rows} x {columns} "
                f"voxels, at least {least:.4g} bytes, but it has {n_bytes}; copy it again"
            )
        if not syntax.is_compressed and n_bytes > least + 2:  # one or two may be padding
            note(
                "more bytes of voxels than its header declares: the rest is ignored; check Rows, "
                "Columns, NumberOfFrames"
            )


def _check_bits(file: DicomFile) -> None:
    """Raise InputError unless the highest bit of values fits their number of bits; note lower
    bits that are left.
    """
    with _errors_of(file.name):
        low = _low_bits(file)
        tags = file.tags
        is_compressed = tags.file_meta.TransferSyntaxUID.is_compressed
        if low < 0 or (low and (is_compressed or int(tags.HighBit) >= int(tags.BitsAllocated))):
            raise InputError(
                f"{file.name} states BitsAllocated {tags.BitsAllocated}, BitsStored "
                f"{tags.BitsStored} and HighBit "
                f"{tags.HighBit}, which contradict each other; export it again"
            )
        if low:
            note(f"its HighBit is {tags.HighBit}: the lowest {low} bits of its values are left out")


def _check_sizes(files: list[DicomFile]) -> None:
    """Raise InputError for files of different numbers of pixels."""
    sizes = Counter(file.size for file in files)
    most, count = sizes.most_common(1)[0]
    for file in files:
        if file.size != most:
            here, there = ("{} x {}".format(*size) for size in (file.size, most))
            raise InputError(
                f"{file.name} has {here} pixels, and {count} others of its series have {there} (is "
                "it a localizer?); move it out of the folder"
            )


def _check_world(files: list[DicomFile]) -> None:
    """Raise InputError for files whose positions are in different frames of reference."""
    stated: dict[str, DicomFile] = {}
    for file in files:
        if uid := _world(file.tags):
            stated.setdefault(uid, file)
    if len(stated) > 1:
        (one, first), (other, second) = list(stated.items())[:2]
        raise InputError(
            f"{second.name} and {first.name} have different frames of reference ({other} and "
            f"{one}): the patient was "
            "moved between them; put the slices of one into a separate folder"
        )


# Frames


def _frames(file: DicomFile) -> list[Frame]:
    """Return the frames of a file, as their functional groups state, or else the file."""
    with _errors_of(file.name):
        tags = file.tags
        n = file.n_frames
        shared = (tags.get("SharedFunctionalGroupsSequence") or [{}])[0]
        own = tags.get("PerFrameFunctionalGroupsSequence") or []
        if own and len(own) != n:
            raise InputError(
                f"{file.name} has {n} frames, but states where {len(own)} lie; export it again"
            )
        is_plain = not own and n > 1
        places = _stack_frames(file) if is_plain and not file.is_segmentation else None
        frames = [_frame(file, k, (own[k] if own else {}, shared)) for k in range(n)]
        return (
            frames
            if places is None
            else [f._replace(place=p) for f, p in zip(frames, places, strict=True)]
        )


def _frame(file: DicomFile, index: int, groups: tuple[Any, ...]) -> Frame:
    name = f"frame {index + 1} of {file.name}" if file.n_frames > 1 else file.name
    tags = file.tags

    def stated(keyword: str, sequence: str, default: Any = None) -> Any:
        """Return a tag of the frame's own groups, of the shared ones, or of the file."""
        for group in groups:
            items = group.get(sequence)
            if items and items[0].get(keyword) is not None:
                return items[0].get(keyword)
        value = tags.get(keyword)
        return default if value is None else value

    def numbers(keyword: str, sequence: str, count: int) -> tuple[float, ...]:
        return _numbers(name, keyword, lambda: stated(keyword, sequence), count)

    def number(keyword: str, sequence: str, default: float = 0.0) -> float:
        return next(iter(numbers(keyword, sequence, 1)), default)

    pixel: tuple[float, ...] = ()
    for keyword in ("PixelSpacing", "ImagerPixelSpacing", "NominalScannedPixelSpacing"):
        pixel = pixel or numbers(keyword, "PixelMeasuresSequence", 2)
    content = "FrameContentSequence"
    indices = stated("DimensionIndexValues", content, ())
    indices = [int(value) for value in (indices if np.iterable(indices) else [indices])]
    dimensions = [
        int(each.DimensionIndexPointer) for each in tags.get("DimensionIndexSequence") or ()
    ]
    pairs = zip(dimensions, indices, strict=True) if len(dimensions) == len(indices) else ()
    rescaling = "PixelValueTransformationSequence"
    slope = number("RescaleSlope", rescaling, 1.0)
    if "DoseGridScaling" in tags:
        slope = float(tags.DoseGridScaling)
    return Frame(
        name,
        file,
        index,
        place=numbers("ImagePositionPatient", "PlanePositionSequence", 3),
        axes=numbers("ImageOrientationPatient", "PlaneOrientationSequence", 6),
        pixel=pixel,
        step=number("SpacingBetweenSlices", "PixelMeasuresSequence"),
        thickness=number("SliceThickness", "PixelMeasuresSequence"),
        scale=(slope, number("RescaleIntercept", rescaling)),
        volume=(
            str(stated("StackID", content, "")),
            int(stated("TemporalPositionIndex", content, 0)),
        ),
        others=tuple(value for tag, value in pairs if tag not in SPATIAL_DIMENSIONS),
        segment=int(stated("ReferencedSegmentNumber", "SegmentIdentificationSequence", 0)),
    )


def _numbers(name: str, keyword: str, source: Callable[[], Any], count: int) -> tuple[float, ...]:
    """Return the numbers of a tag, none if it is missing; pydicom converts their texts only when
    asked.
    """
    try:
        value = source()
        if value is None or value == "":
            return ()
        numbers = [
            float(each)
            for each in (value if np.iterable(value) and not isinstance(value, str) else [value])
        ]
    except (ValueError, TypeError, OverflowError):
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        plural = "s" * (count > 1)
        raise InputError(
            f"{name}: expected {count} finite number{plural} for its {keyword}; export it again"
        )
    return tuple(numbers)


def _stack_frames(file: DicomFile) -> list[tuple[float, ...]]:
    """Return the places of frames without functional groups, where the file states a distance
    between them.
    """
    tags = file.tags
    n = file.n_frames
    detectors = tags.get("DetectorInformationSequence") or []
    for each in detectors if len(detectors) == 1 else ():  # nuclear medicine
        for keyword in ("ImagePositionPatient", "ImageOrientationPatient"):
            if keyword in each and keyword not in tags:
                tags[keyword] = each[keyword]
    first = _frame(file, 0, ())
    offsets = _numbers(
        file.name, "GridFrameOffsetVector", lambda: tags.get("GridFrameOffsetVector"), n
    )
    pointer = tags.get("FrameIncrementPointer")
    pointers = (
        [int(each) for each in (pointer if np.iterable(pointer) else [pointer])]
        if pointer is not None
        else []
    )
    # slices, and not times, angles, phases or energies
    is_of_slices = not pointers or pointers == [0x00540080]
    if not first.place or not first.axes or not (offsets or (first.step and is_of_slices)):
        raise InputError(f"{file.name} {NO_PLACES.format(n)}")
    along = np.cross(first.axes[:3], first.axes[3:])
    if not offsets:
        note(
            f"its frames are put {first.step:.4g} mm apart along the slices' normal, as "
            "SpacingBetweenSlices states"
        )
        order = _numbers(file.name, "SliceVector", lambda: tags.get("SliceVector"), n) or range(
            1, n + 1
        )
        offsets = tuple(first.step * (float(k) - 1.0) for k in order)
    elif offsets[0] != 0.0:  # they are places along the patient's axis
        if (
            abs(along[2]) < 1.0 - _SAME_DIRECTION
            or abs(offsets[0] - first.place[2]) > _SAME_PLACE_MM
        ):
            raise InputError(
                f"{file.name} has a GridFrameOffsetVector that is not of its position; export it "
                "again"
            )
        along = np.array([0.0, 0.0, 1.0])
        offsets = tuple(each - offsets[0] for each in offsets)
    return [tuple((np.array(first.place) + each * along).tolist()) for each in offsets]


def _one_volume(frames: list[Frame], volume: int | None) -> list[Frame]:
    """Return the frames of one volume: of one stack and time, and of one echo or the like where
    frames repeat.
    """
    is_repeated = len({(frame.volume, frame.place, frame.segment) for frame in frames}) < len(
        frames
    )
    keys = [(*frame.volume, frame.others if is_repeated else ()) for frame in frames]
    volumes = sorted(set(keys))
    (chosen,) = volume_index((len(volumes),), volume)
    return [frame for frame, key in zip(frames, keys, strict=True) if key == volumes[chosen]]


# Places


def _place_frames(frames: list[Frame], *, is_sparse: bool) -> tuple[Floats, Ints]:
    """Return the affine of frames, by their own positions, and the slice of each; InputError unless
    they are those of a volume.

    The slice axis is that of the positions, not orthogonal to the others in a tilted gantry. With
    `is_sparse`, frames may share a slice, and slices may have none.
    """
    first = frames[0]
    axes = np.array(first.axes or AXIAL_DIRECTIONS).reshape(2, 3)
    if not np.allclose(axes @ axes.T, np.eye(2), rtol=0.0, atol=0.02):
        raise InputError(
            f"{first.name}: expected the directions of its axes to be orthogonal, got {first.axes}"
        )
    _check_alike(frames)
    if not first.pixel:
        note("states no size of pixels: 1 mm is assumed")
    between_rows, between_columns = first.pixel or (1.0, 1.0)
    if min(between_rows, between_columns) <= 0.0:
        raise InputError(
            f"{first.name}: expected pixels larger than 0, got {between_rows:g} x "
            f"{between_columns:g} mm"
        )
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    if unplaced := next((frame for frame in frames if not frame.place), None):
        if len(frames) > 1:
            raise InputError(
                f"{unplaced.name} does not state where it lies; convert or export the series again"
            )
        note("states no position: its first voxel is put at the world's origin")
    points = np.array([frame.place or (0.0, 0.0, 0.0) for frame in frames])
    normal = np.cross(*axes)
    ranks = _ranks(points, normal)
    places = points[np.unique(ranks, return_index=True)[1]]
    if len(places) < len(points) and not is_sparse:
        raise _several_volumes(frames, len(places))
    if len(places) == 1:
        step = normal * _thickness(first)
        slices = np.zeros(1, dtype=np.int64)
    else:
        step, slices = _steps(places, first, is_sparse)
        _check_step(step, normal, first)
    affine = np.eye(4)
    affine[:3, :3] = np.column_stack([axes[0] * between_columns, axes[1] * between_rows, step])
    affine[:3, 3] = places[0]
    affine[:2] *= -1.0  # LPS to RAS
    return affine, slices[ranks]


def _check_alike(frames: list[Frame]) -> None:
    """Raise InputError for frames of other directions or pixels than the first one's."""
    first = frames[0]
    for frame in frames[1:]:
        if len(frame.axes) != len(first.axes) or not np.allclose(
            frame.axes, first.axes, rtol=0.0, atol=_SAME_DIRECTION
        ):
            raise InputError(
                f"the DICOM slices are not parallel (a localizer?): {frame.name} and {first.name} "
                "have different directions; choose another series"
            )
        if len(frame.pixel) != len(first.pixel) or not np.allclose(
            frame.pixel, first.pixel, rtol=1e-3, atol=0.0
        ):
            raise InputError(
                f"{frame.name} and {first.name} have pixels of different sizes; choose another "
                "series"
            )


def _several_volumes(frames: list[Frame], n_places: int) -> InputError:
    n = len(frames)
    remedy = "put the slices of one volume into a separate folder, or "
    if all(frame.file.n_frames == n for frame in frames):
        remedy = ""
    elif all(frame.file.n_frames == n_places for frame in frames):
        remedy = "give one of its files, or "
    return InputError(
        f"the {n} slices of this DICOM series have {count_text(n_places, 'position')}: it has "
        f"several volumes (times, echoes or repeats); {remedy}convert it to a 4-D NIfTI file "
        "(dcm2niix)"
    )


def _ranks(points: Floats, normal: Floats) -> Ints:
    """Return the rank of each point, (n, 3), along the normal; the same for those at one place."""
    order = np.argsort(points @ normal, kind="stable")
    is_new = np.linalg.norm(np.diff(points[order], axis=0), axis=1) > _SAME_PLACE_MM
    ranks = np.empty(len(points), dtype=np.int64)
    ranks[order] = np.concatenate([[0], np.cumsum(is_new)])
    return ranks


def _steps(places: Floats, first: Frame, is_sparse: bool) -> tuple[Floats, Ints]:
    """Return the step between slices, and the slice of each place, (n, 3), in their order: the
    next one or, if sparse, a multiple of the stated or of the least distance. InputError if they
    are uneven.
    """
    along = np.linalg.norm(places - places[0], axis=1)
    nearest = float(np.diff(along).min())
    tried = [np.arange(len(places))]
    if is_sparse:
        lengths = (abs(first.step), nearest)
        tried = [np.rint(along / length) for length in lengths if length > _SAME_PLACE_MM]
    for slices in tried:
        step = (places[-1] - places[0]) / slices[-1]
        off = np.linalg.norm(places - places[0] - slices[:, None] * step, axis=1)
        if (np.diff(slices) > 0).all() and off.max() <= _UNEVEN_FRACTION * np.linalg.norm(step):
            if np.diff(slices).min() > 1:
                note(
                    f"its slices are {abs(first.step):.4g} mm apart as it states, but its frames "
                    f"{nearest:.4g} mm or more: those between are empty"
                )
            elif (n_empty := int(slices[-1]) + 1 - len(slices)) > MOST_EMPTY * len(slices):
                note(
                    f"its frames lie in {len(slices)} slices, far apart: {n_empty} slices between "
                    "them are empty; check that they are of one scan"
                )
            return step, slices.astype(np.int64)
    what = (
        "the frames of this segmentation are not at multiples of one distance"
        if is_sparse
        else "the DICOM slices are not evenly spaced"
    )
    raise InputError(
        f"{what} ({_unevenness(places, off)}); export the series again, or resample it to NIfTI"
    )


def _thickness(frame: Frame) -> float:
    """Return the extent of the only slice along its normal."""
    length = abs(frame.step) or frame.thickness
    if length <= 0.0:
        note("has one slice and states no thickness: 1 mm is assumed")
        return 1.0
    return length


def _check_step(step: Floats, normal: Floats, first: Frame) -> None:
    """Raise InputError for slices beside each other; note a step other than the one stated."""
    across = float(step @ normal)
    if across <= _SAME_PLACE_MM:
        raise InputError(
            "the DICOM slices lie beside each other, not above each other; choose another series"
        )
    lengths = (across, float(np.linalg.norm(step)))
    stated = abs(first.step)
    if stated and all(abs(length / stated - 1.0) > _UNEVEN_FRACTION for length in lengths):
        note(
            f"its slices lie {lengths[1]:.4g} mm apart by their positions, which are used; "
            f"SpacingBetweenSlices is {stated:.4g} mm"
        )
    thickness = first.thickness
    if (
        first.file.is_segmentation
        and not stated
        and 0.0 < thickness * (1.0 + _UNEVEN_FRACTION) < lengths[0]
    ):
        note(
            f"its slices lie {lengths[1]:.4g} mm apart by their positions, which are used; "
            f"SliceThickness is {thickness:.4g} mm, so slices between them may be missing"
        )


def _unevenness(points: Floats, off: Floats) -> str:
    """Describe where slices at `points`, (n, 3), mm, are uneven: an unusual step, or else the
    largest `off` (n,).
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    usual = float(np.median(steps))
    is_other = np.abs(steps - usual) > _UNEVEN_FRACTION * usual
    if not is_other.any():
        return (
            f"slice {off.argmax()}, counted from 0, is {off.max():.3g} mm off its even place "
            "between first and last"
        )
    k = int(np.abs(steps - usual).argmax())
    where = "elsewhere" if is_other.sum() == 1 else "at most places"
    return (
        f"a step of {steps[k]:.3g} mm between slices {k} and {k + 1}, counted from 0, and "
        f"{usual:.3g} mm {where}: one is missing, or several volumes are mixed"
    )


# Voxels


def _planes(frames: list[Frame]) -> Iterator[NDArray]:
    """Yield the stored values of frames of one file, (rows, columns)."""
    from pydicom.pixels import iter_pixels

    file = frames[0].file
    indices = [frame.number for frame in frames]
    if (
        int(file.tags.BitsAllocated) == 1
        and not file.tags.file_meta.TransferSyntaxUID.is_compressed
    ):
        yield from _unpack_bits(file, indices)
        return
    if low := _low_bits(file):  # pydicom takes the highest bit to be that of the number of bits
        file.tags.BitsStored += low
    is_all = indices == list(range(file.n_frames))  # read in one go
    options: Json = {"raw": True, "allow_excess_frames": False}
    count = 0
    with _errors_of(file.name):
        for plane in iter_pixels(file.tags, indices=None if is_all else indices, **options):
            yield plane >> low if low else plane
            count += 1
    if count < len(frames):
        raise InputError(
            f"{file.name} is truncated or damaged: {count} of its frames are complete; copy it "
            "again"
        )


def _unpack_bits(file: DicomFile, indices: list[int]) -> Iterator[NDArray]:
    """Yield frames of single bits, which follow each other without padding; pydicom reads bytes
    too few for some.
    """
    columns, rows = file.size
    packed = np.frombuffer(file.tags.PixelData, np.uint8)
    size = rows * columns
    for index in indices:
        first = index * size
        end = (index + 1) * size
        bits = np.unpackbits(packed[first // 8 : -(-end // 8)], bitorder="little")
        yield bits[first % 8 :][:size].reshape(rows, columns)


def _low_bits(file: DicomFile) -> int:
    """Return the number of bits below the values."""
    tags = file.tags
    return (
        int(tags.HighBit) + 1 - int(tags.BitsStored)
        if "HighBit" in tags and "BitsStored" in tags
        else 0
    )


def _rescale_frames(frames: list[Frame], slices: Ints, shape: tuple[int, int, int]) -> NDArray:
    """Return the values of frames, each rescaled as it states."""
    if any("ModalityLUTSequence" in frame.file.tags for frame in frames):
        note("its values are as stored: its table of values (ModalityLUTSequence) is not applied")
    bits = max(int(frame.file.tags.BitsAllocated) for frame in frames)
    data = np.empty(shape, dtype=exact_type(bits, {frame.scale for frame in frames}))
    is_padding = np.zeros(shape, dtype=bool)
    places = iter(slices.tolist())
    for _, of_file in groupby(frames, key=lambda frame: id(frame.file)):
        those = list(of_file)
        for frame, plane in zip(those, _planes(those), strict=True):
            place = next(places)
            data[place] = plane * frame.scale[0] + frame.scale[1]
            if (value := frame.file.tags.get("PixelPaddingValue")) is not None:
                ends = sorted([value, frame.file.tags.get("PixelPaddingRangeLimit", value)])
                is_padding[place] = (plane >= ends[0]) & (plane <= ends[1])
    if frames[0].file.tags.get("Modality") != "CT":
        return data
    data, words = replace_padding(data, is_padding)
    note(words)
    return data


def _number_segments(frames: list[Frame], slices: Ints, shape: tuple[int, int, int]) -> NDArray:
    """Return the segments' numbers; where segments overlap, the larger number, or the larger
    fraction.
    """
    tags = frames[0].file.tags
    order = np.lexsort([np.array([frame.segment for frame in frames]), slices])
    frames = [frames[k] for k in order]
    slices = slices[order]
    names = {number: _name(each) for number, each in _segments(frames[0].file).items()}
    for one, other, k, before in zip(frames[1:], frames, slices[1:], slices, strict=False):
        if (one.segment, k) == (other.segment, before):
            raise InputError(
                f"{one.name} and {other.name} have one segment and position; export it again"
            )
    data = np.zeros(shape, dtype=np.uint16)
    if tags.get("SegmentationType") == "LABELMAP":
        for k, plane in zip(slices, _planes(frames), strict=True):
            data[k] = plane
        _clear(data, {0, int(tags.get("PixelPaddingValue") or 0)}, names)
        return data
    if unnamed := next((frame for frame in frames if frame.segment not in names), None):
        raise InputError(f"{unnamed.name} states no segment of the file; export it again")
    whole = 1
    if tags.get("SegmentationType") == "FRACTIONAL":
        whole = int(tags.MaximumFractionalValue)
        note(
            "its segments are fractions: voxels belong to the largest, if it is "
            f"{SEGMENT_FRACTION:g} or more"
        )
    return _write_segments(frames, slices, data, whole, names)


def _clear(data: NDArray, outside: set[int], names: dict[int, str]) -> None:
    """Set voxels `outside` of all segments to 0, and those of other values without a segment,
    which are noted.
    """
    values, counts = np.unique(data, return_counts=True)
    unknown = {
        k: n
        for k, n in zip(values.tolist(), counts.tolist(), strict=True)
        if k not in outside | names.keys()
    }
    if unknown:
        note(
            f"{sum(unknown.values())} voxels have values of no segment ({list(unknown)[:8]}) and "
            "get label 0"
        )
    data[np.isin(data, [*outside, *unknown])] = 0


def _write_segments(
    frames: list[Frame],
    slices: Ints,
    data: NDArray,
    whole: int,
    names: dict[int, str],
) -> NDArray:
    """Write numbers of segments to `data`, for frames in the order of slices and segments; note
    overlaps.
    """
    overlaps: Counter[tuple[int, int]] = Counter()
    planes = _planes(frames)
    for k in np.unique(slices):
        those = [frame.segment for frame, each in zip(frames, slices, strict=True) if each == k]
        stack = np.stack(list(islice(planes, len(those))))
        is_in = stack >= SEGMENT_FRACTION * whole
        largest = len(those) - 1 - np.where(is_in, stack, 0)[::-1].argmax(axis=0)
        data[k] = np.where(is_in.any(axis=0), np.array(those)[largest], 0)
        is_several = is_in[:, is_in.sum(axis=0) > 1].astype(np.int64)
        shared = is_several @ is_several.T
        overlaps.update(
            {(those[i], those[j]): int(shared[i, j]) for i, j in np.argwhere(np.triu(shared, 1))}
        )
    if overlaps:
        text = "; ".join(
            f"{a} ({names[a]}) and {b} ({names[b]}) in {count} voxels"
            for (a, b), count in overlaps.most_common(LISTED_OVERLAPS)
        )
        more = (
            f"; and {len(overlaps) - LISTED_OVERLAPS} more pairs"
            if len(overlaps) > LISTED_OVERLAPS
            else ""
        )
        kept = "larger number" if whole == 1 else "larger fraction, or number"
        note(f"segments overlap, and the {kept} is kept: {text}{more}")
    return data
