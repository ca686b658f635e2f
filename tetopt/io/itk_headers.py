"""The headers of NRRD and MetaImage, read here before SimpleITK reads the file: sizes, and which file has the voxels.

A header may name any file of the machine, whose bytes become voxels of the mesh that goes back to its sender. What
else is wrong with one, SimpleITK finds, in a child with limits.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import NamedTuple

from tetopt.errors import InputError
from tetopt.io.apart import DEFLATE_RATIO
from tetopt.io.volumes import DAMAGED_FILE, TOO_LONG, TRAILING_BYTES, UNREADABLE_FILE, check_room
from tetopt.system.incoming import irregular

HEADED_SUFFIXES = (".nrrd", ".nhdr", ".mha", ".mhd")  # of files whose headers are read here
HEADER_BYTES = 2**20  # of a header: 3D Slicer's with all its words have 10,000
MOST_AXES = 8  # of a file: more than space, time, and what is measured
VALUE_LETTERS = 32  # of text, for a byte of a value at most
# Of a value, by words in the names of its type; the first that fits.
VALUE_BYTES = {"char|int8": 1, "short|int16": 2, "long.?long|double|64": 8, "": 4}
BZIP2_RATIO = 50_000  # bzip2 packs zeros 45,000 times
READ_IN_PARTS = "crop or resample it first, or convert it to .zarr or uncompressed .nii, of which parts are read"


class _Words(NamedTuple):
    """What a format calls the fields that matter here."""

    mark: str  # between name and value
    axes: str
    sizes: str
    kind: str
    data: str
    skip: str


NRRD = _Words(":", "dimension", "sizes", "type", "datafile", "byteskip")
META_IMAGE = _Words("=", "NDims", "DimSize", "ElementType", "ElementDataFile", "HeaderSize")


class VoxelHeader(NamedTuple):
    """What a header tells."""

    sizes: list[int]
    value_bytes: int  # all voxels
    files: list[str]  # that have the voxels; none if they follow the header
    ratio: int  # the most that a byte of the file can become
    is_skipping: bool  # whether any number of bytes lies before the voxels


def checked_header(path: Path) -> tuple[int, int]:
    """Bytes of all files of the image, and of all its voxels.

    Raises
    ------
    InputError
        Without the path before it: a header that cannot be read, or tells of more than memory or the files can
        have, or of far less; a data file that is not beside the header, or no regular file.
    """
    header = _header(path)
    n_bytes = sum(file.stat().st_size for file in (path, *_data_files(path, header)))
    check_room(header.sizes, header.value_bytes // max(math.prod(header.sizes), 1), READ_IN_PARTS)
    if header.value_bytes > n_bytes * header.ratio:  # ITK takes what is missing of packed voxels for 0
        sizes = " x ".join(map(str, header.sizes))
        raise InputError(f"{DAMAGED_FILE} (its header tells of {sizes} voxels, the file has {n_bytes} bytes)")
    most = VALUE_LETTERS * header.value_bytes + TRAILING_BYTES
    if n_bytes > most and not header.is_skipping:  # its checksum would be made of all of it
        raise InputError(TOO_LONG.format(most))
    return n_bytes, header.value_bytes


def data_files(path: Path) -> list[Path]:
    """The files beside a header that have its voxels; InputError as `checked_header`, none where they follow it."""
    return _data_files(path, _header(path))


def _data_files(path: Path, header: VoxelHeader) -> list[Path]:
    for name in header.files:
        _check_beside(path, name)
    return [path.parent / name for name in header.files]


def header_sizes(path: Path) -> tuple[int, ...]:
    """Lengths of the axes as the header has them; InputError as `checked_header`, as far as the header alone tells."""
    return tuple(_header(path).sizes)


def _check_beside(path: Path, name: str) -> None:
    """InputError unless the name is that of a regular file in the header's folder."""
    if name in ("", ".", "..") or re.search(r"[/\\:\0%*?]", name):
        raise InputError(f'its voxels are in "{name}"; only a file beside the header, by its bare name, is read')
    try:
        other = irregular(path.parent / name)
    except OSError as error:
        raise InputError(f'{UNREADABLE_FILE} (its data file "{name}": {error.strerror})') from error
    if other is not None:
        raise InputError(f'its data file "{name}" is {other}; expected a regular file')


def _header(path: Path) -> VoxelHeader:
    with path.open("rb") as stream:
        head = stream.read(HEADER_BYTES)
    is_nrrd = path.suffix.lower() in (".nrrd", ".nhdr")
    if is_nrrd and not head.startswith(b"NRRD"):
        raise InputError(UNREADABLE_FILE)
    words = NRRD if is_nrrd else META_IMAGE
    lines = [line.rstrip("\r") for line in head.decode("latin-1").split("\n")]
    fields, files = _fields(lines[is_nrrd:], words)
    if len(head) == HEADER_BYTES and (files or (is_nrrd and "" not in lines)):  # what follows might name others
        raise InputError(f"{UNREADABLE_FILE} (a header of more than {HEADER_BYTES} bytes)")
    for key in (words.axes, words.sizes, words.kind, "encoding" if is_nrrd else words.data):
        if key not in fields:
            raise InputError(f"{UNREADABLE_FILE} (its header has no {key})")
    sizes, channels = fields[words.sizes].split(), fields.get("ElementNumberOfChannels", "1")
    if not all(re.fullmatch(r"\d{1,18}", each) for each in (*sizes, channels)):
        raise InputError(f"{UNREADABLE_FILE} (sizes {fields[words.sizes][:80]}, {channels[:20]} channels)")
    if fields[words.axes] != str(len(sizes)) or not 0 < len(sizes) <= MOST_AXES:
        raise InputError(
            f"{UNREADABLE_FILE} (expected 1 to {MOST_AXES} axes, with a size each, got {fields[words.axes][:80]} axes "
            f"and {len(sizes)} sizes)"
        )
    item = next(n for names, n in VALUE_BYTES.items() if re.search(names, fields[words.kind].lower()))
    value_bytes = math.prod(map(int, sizes)) * int(channels) * item
    ratio = BZIP2_RATIO if fields.get("encoding", "").lower() in ("bz2", "bzip2") else DEFLATE_RATIO
    return VoxelHeader([*map(int, sizes)], value_bytes, files, ratio, fields.get(words.skip, "0") != "0")


def _fields(lines: list[str], words: _Words) -> tuple[dict[str, str], list[str]]:
    """What a header's fields say, by name, and the files that have the voxels."""
    fields: dict[str, str] = {}
    files: list[str] = []
    for number, line in enumerate(lines, 1):
        key, mark, value = line.partition(words.mark)
        if words is NRRD:
            if not line:
                break
            if line.startswith("#") or value.startswith("="):  # "key:=value"; of a field's value ":=" is a part
                continue
            key = key.lower().replace(" ", "")
        elif (key.strip() and not mark) or ":" in key:  # which ITK takes for the end of a key, too
            raise InputError(UNREADABLE_FILE)
        key, value = key.strip(), value.strip()
        fields[key] = value
        if key == words.data and value.upper().startswith("LIST"):
            return fields, files + [each.strip() for each in lines[number:] if each.strip()]
        if key == words.data and (words is NRRD or value.upper() != "LOCAL"):
            files.append(value)
        if key == words.data and words is META_IMAGE:
            break
    return fields, files
