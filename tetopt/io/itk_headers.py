"""Checks of NRRD and MetaImage headers before SimpleITK reads the file: sizes and data files.

ITK trusts headers: ``NDims = -1`` ends the process, memory is allocated before a file is found to
be too short, and a header may name any file of the machine, whose bytes would become voxels of a
mesh that goes back to the sender.
"""

from __future__ import annotations

import math
import re
import zlib
from pathlib import Path
from typing import NamedTuple

from tetopt.errors import InputError
from tetopt.io.apart import DEFLATE_RATIO
from tetopt.io.volumes import (
    DAMAGED_FILE,
    TOO_LONG,
    TRAILING_BYTES,
    UNREADABLE_FILE,
    check_room,
    one_line,
)
from tetopt.system.incoming import irregular

NRRD_SUFFIXES = (".nrrd", ".nhdr")
HEADER_BYTES = 2**20  # at most in a header: 3D Slicer's long ones have 10,000
MOST_AXES = 8  # more than space, time and components
TEXT_RATIO = 4  # "0 " becomes 8 bytes
VALUE_LETTERS = 32  # letters of text per byte of a value, at most
BLOCK_BYTES = 2**14  # unpacked at a time, to 17 MB at most
BZIP2_RATIO = 50_000  # bzip2 compresses zeros 45,000 times
TRUE = ("true", "1")  # of MetaImage
RATIOS = {  # by NRRD's encoding; others are bzip2
    **dict.fromkeys(("raw", "hex"), 1),
    **dict.fromkeys(("txt", "text", "ascii"), TEXT_RATIO),
    **dict.fromkeys(("gz", "gzip"), DEFLATE_RATIO),
}
VALUE_BYTES = {  # types of NRRD without "unsigned", "_t" and the like, and those of MetaImage
    **dict.fromkeys(("char", "int8"), 1),
    **dict.fromkeys(("short", "int16"), 2),
    **dict.fromkeys(("int", "int32", "long", "float"), 4),
    **dict.fromkeys(("longlong", "long long", "int64", "double"), 8),
}


class Names(NamedTuple):
    """Names of a format's fields, the first four of which every header has, and its mark after
    them.
    """

    axes: str
    sizes: str
    kind: str
    needed: str
    files: str
    skip: str
    mark: str


NRRD_NAMES = Names("dimension", "sizes", "type", "encoding", "datafile", "byteskip", ":")
METAIMAGE_NAMES = Names(
    "NDims", "DimSize", "ElementType", "ElementDataFile", "ElementDataFile", "HeaderSize", "="
)


SPACE_KINDS = ("domain", "space", "???", "none")  # of NRRD's axes
LIST_KINDS = (*SPACE_KINDS, "list", "time")  # of an axis of volumes; others are components


class VoxelHeader(NamedTuple):
    """The contents of a header."""

    fields: dict[str, str]  # those of NRRD in lower case without blanks; the last of each name
    texts: dict[str, str]  # key:=value pairs of NRRD
    sizes: list[int]
    value_bytes: int  # all voxels
    files: list[Path]  # data files, beside the header; empty if the voxels follow it
    ratio: int  # maximum expansion of a byte of the file
    skip: str  # bytes before the voxels, as written; -1 if the voxels are at the end
    n_bytes: int  # of the header itself, if voxels follow


def check_header(path: Path) -> tuple[VoxelHeader, int]:
    """Return the header, and the number of bytes of all files of the image.

    Raises
    ------
    InputError
        Without a leading path: the header cannot be read or declares more than the files contain; a
        data file is not next to the header, or is not a regular file.
    """
    header = read_header(path)
    n_bytes = _check_bytes(path, header)
    if header.ratio == DEFLATE_RATIO and path.suffix.lower() not in NRRD_SUFFIXES:
        _check_packed(path, header)
    check_room(header.sizes, header.value_bytes // max(math.prod(header.sizes), 1))
    return header, n_bytes


def _check_bytes(path: Path, header: VoxelHeader) -> int:
    """Return the number of bytes of all files of the image; InputError if its header declares
    more, or far fewer.
    """
    n_bytes = sum(file.stat().st_size for file in (path, *header.files))
    if header.value_bytes > n_bytes * header.ratio:
        sizes = " x ".join(str(size) for size in header.sizes)
        raise InputError(
            f"{DAMAGED_FILE} (its header declares {sizes} voxels, "
            f"{header.value_bytes:.4g} bytes, but the file has {n_bytes})"
        )
    longest = VALUE_LETTERS if header.ratio == TEXT_RATIO else 2  # packed ones may be longer
    skipped = int(header.skip) if header.skip.isdecimal() else 0
    most = header.n_bytes + skipped + longest * header.value_bytes + TRAILING_BYTES
    if n_bytes > most:  # its checksum would cover all of it
        raise InputError(TOO_LONG.format(most))
    return n_bytes


def _check_packed(path: Path, header: VoxelHeader) -> None:
    """Raise InputError if a MetaImage has fewer packed bytes than declared: ITK returns what was
    in memory for them.
    """
    n_bytes = 0
    try:
        for file in header.files or [path]:
            inflater = zlib.decompressobj(32 + zlib.MAX_WBITS)  # of zlib or gzip
            with file.open("rb") as stream:
                stream.seek(header.n_bytes if file == path else int(header.skip))
                while n_bytes < header.value_bytes and (block := stream.read(BLOCK_BYTES)):
                    n_bytes += len(inflater.decompress(block))
    except (ValueError, zlib.error) as error:  # ValueError: a place before the file's beginning
        raise InputError(f"{DAMAGED_FILE} ({one_line(error)})") from error
    if n_bytes < header.value_bytes:
        raise InputError(
            f"{DAMAGED_FILE} (its header declares {header.value_bytes} bytes of voxels, but "
            f"{n_bytes} are packed)"
        )


def header_sizes(path: Path) -> tuple[int, ...]:
    """Return the lengths of the axes in the header, those of space first, as images have them;
    InputError for the reasons of `check_header` in the header.
    """
    header = read_header(path)
    others = other_axes(header)
    return tuple(header.sizes[k] for k in sorted(range(len(header.sizes)), key=others.__contains__))


def other_axes(header: VoxelHeader) -> dict[int, str]:
    """Return the axes that are none of space, with their kinds in NRRD, as far as stated."""
    n_axes = len(header.sizes)
    kinds = header.fields.get("kinds", "").lower().split()
    directions = re.findall(r"none|\(", header.fields.get("spacedirections", "").lower())
    kinds = kinds if len(kinds) == n_axes else ["???"] * n_axes
    directions = directions if len(directions) == n_axes else [""] * n_axes
    return {
        k: kinds[k] for k in range(n_axes) if kinds[k] not in SPACE_KINDS or directions[k] == "none"
    }


def list_header(path: Path, header: VoxelHeader, axis: int) -> str:
    """Return an NRRD header for the same voxels in which an axis is a list, which ITK reads as
    components, wherever it is.
    """
    with path.open("rb") as stream:
        head = stream.read(header.n_bytes).decode("latin-1")
    lines = [
        line
        for line in head.splitlines()
        if line and line.partition(":")[0].lower().replace(" ", "") not in ("kinds", "datafile")
    ]
    if not header.files:
        lines.append(f"line skip: {head.count(chr(10))}")
    (file,) = header.files or [path]
    kinds = ("list" if k == axis else "domain" for k in range(len(header.sizes)))
    return "\n".join([*lines, f"kinds: {' '.join(kinds)}", f"data file: {file.absolute()}", "", ""])


def read_header(path: Path) -> VoxelHeader:
    """Return the header of a file; InputError for the reasons of `check_header` in the header."""
    with path.open("rb") as stream:
        head = stream.read(HEADER_BYTES)
    header, names = _parse_head(head, path.suffix.lower() in NRRD_SUFFIXES)
    if names and len(head) == HEADER_BYTES:  # the rest might name other files
        raise InputError(
            f"{UNREADABLE_FILE} (a header of more than {HEADER_BYTES} bytes with separate data "
            "files)"
        )
    return header._replace(files=[_file_beside(path, name) for name in names])


def _file_beside(path: Path, name: str) -> Path:
    """Return the regular file of this name in the header's folder; InputError if there is none."""
    if name in ("", ".", "..") or re.search(r"[/\\:\0%*?]", name):
        raise InputError(
            f'expected a data file next to the header, named without a folder, got "{name}"'
        )
    try:
        other = irregular(path.parent / name)
    except OSError as error:
        raise InputError(f'{UNREADABLE_FILE} (its data file "{name}": {error.strerror})') from error
    if other is not None:
        raise InputError(f'its data file "{name}" is {other}; expected a regular file')
    return path.parent / name


def _parse_head(head: bytes, is_nrrd: bool) -> tuple[VoxelHeader, list[str]]:
    """Parse the first bytes of a file as a header; return it, and the names of data files."""
    names = NRRD_NAMES if is_nrrd else METAIMAGE_NAMES
    fields, texts, files, n_bytes = _lines(head, names)
    for key in names[:4]:
        if key not in fields:
            raise InputError(f"{UNREADABLE_FILE} (its header has no {key})")
    axes = fields[names.axes]
    if re.fullmatch(r"\d{1,3}", axes) is None or not 1 <= int(axes) <= MOST_AXES:
        raise InputError(f"{UNREADABLE_FILE} (expected 1 to {MOST_AXES} axes, got {axes[:80]})")
    stated = fields[names.sizes]
    words = stated.split()
    if len(words) != int(axes) or not all(re.fullmatch(r"\d{1,18}", word) for word in words):
        raise InputError(f"{UNREADABLE_FILE} (expected {axes} sizes, got {stated[:80]})")
    sizes = list(map(int, words))
    channels = "1" if is_nrrd else fields.get("ElementNumberOfChannels", "1")
    if re.fullmatch(r"\d{1,9}", channels) is None:
        raise InputError(f"{UNREADABLE_FILE} (ElementNumberOfChannels = {channels[:80]})")
    if is_nrrd:
        ratio = RATIOS.get(fields["encoding"].lower(), BZIP2_RATIO)
    elif fields.get("CompressedData", "").lower() in TRUE:
        ratio = DEFLATE_RATIO
    else:
        ratio = 1 if fields.get("BinaryData", "True").lower() in TRUE else TEXT_RATIO
    value_bytes = math.prod(sizes) * int(channels) * _value_bytes(fields[names.kind])
    skip = fields.get(names.skip, "0")
    return VoxelHeader(fields, texts, sizes, value_bytes, [], ratio, skip, n_bytes), files


def _lines(head: bytes, names: Names) -> tuple[dict[str, str], dict[str, str], list[str], int]:
    """Return the fields, NRRD's key:=value pairs, the data files, and the number of
    bytes of the header.
    """
    is_nrrd = names is NRRD_NAMES
    fields: dict[str, str] = {}
    texts: dict[str, str] = {}
    files: list[str] = []
    raw = head.split(b"\n")
    lines = [line.decode("latin-1").rstrip("\r") for line in raw]
    if is_nrrd and not head.startswith(b"NRRD"):
        raise InputError(UNREADABLE_FILE)
    if is_nrrd and len(head) == HEADER_BYTES and "" not in lines:
        raise InputError(f"{UNREADABLE_FILE} (a header of more than {HEADER_BYTES} bytes)")
    for number, line in enumerate(lines):
        if is_nrrd and not line:
            break
        if is_nrrd and (number == 0 or line.startswith("#")):
            continue
        key, mark, value = line.partition(names.mark)
        if is_nrrd and value.startswith("="):  # "key:=value", which is not a field; in UTF-8
            texts[key] = value[1:].encode("latin-1").decode("utf-8", "replace")
            continue
        key = key.strip()
        value = value.strip()
        if is_nrrd:
            key = key.lower().replace(" ", "")
        elif (key and not mark) or ":" in key:  # ITK also ends a key at a colon
            raise InputError(UNREADABLE_FILE)
        fields[key] = value
        if key == names.files:
            is_list = value.upper().startswith("LIST")
            if is_list:
                files += [each.strip() for each in lines[number + 1 :] if each.strip()]
            elif is_nrrd or value.upper() != "LOCAL":
                files.append(value)
            if is_list or not is_nrrd:
                break
    return fields, texts, files, len(b"\n".join(raw[: number + 1])) + 1


def _value_bytes(kind: str) -> int:
    """Return the number of bytes of a value of a type."""
    name = kind[4:].replace("_", " ").lower() if kind.startswith("MET_") else kind
    name = re.sub("^(unsigned |signed |u)|(_t| int)$", "", name)
    if name not in VALUE_BYTES:
        raise InputError(f"{UNREADABLE_FILE} (unknown voxel type {kind[:80]})")
    return VALUE_BYTES[name]
