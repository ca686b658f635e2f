"""Outlines of written files: is one well-formed, and is all there? Every line of numbers is counted, none of them read.

XML goes through expat, without its blocks of numbers where these are lines of our own.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from io import BytesIO
from itertools import pairwise
from typing import NamedTuple
from urllib.parse import unquote
from xml.parsers import expat

STL_HEAD_BYTES, STL_TRIANGLE_BYTES = 84, 50  # the format's own: header and count, then each triangle
PLY_VERTEX_BYTES, PLY_FACE_BYTES = 24, 13  # three doubles; a count and three nodes, before labels of 4 bytes each
GMSH_DATA_LINES = 8  # of a view before its values: the name and the tags, as `tetopt.io.gmsh` writes them
VTK_BYTES = {  # of VTK's types of numbers, in its words
    "unsigned_char": 1, "char": 1, "short": 2, "unsigned_short": 2, "int": 4, "unsigned_int": 4, "float": 4,
    "double": 8, "long": 8, "unsigned_long": 8, "vtktypeint64": 8, "vtktypeuint64": 8,
}  # fmt: skip
# Where a block of lines of numbers begins in our files of XML; and in which element or attribute.
FEBIO_BLOCK = re.compile(rb"<(\w+) [^<>]*>\n(?=<(?:node|elem|tri\d) )")
XDMF_BLOCK = re.compile(rb'<(DataItem) [^<>]*Format="XML">\n')


class Outline(NamedTuple):
    """What a file holds; None for what it does not tell."""

    n_points: int | None = None
    n_cells: int | None = None
    facet_sets: frozenset[str] | None = None  # and perhaps others' names
    cell_sets: frozenset[str] | None = None


def check_outline(suffix: str, whole: bytes, expected: Outline) -> Outline:
    """AssertionError unless the bytes are a whole file of the suffix's format that holds what is expected."""
    try:
        outline = OUTLINES[suffix](whole)
    except (ValueError, LookupError, expat.ExpatError) as error:
        raise AssertionError(f"{suffix} is not well-formed: {error}") from error
    for count, target in ((outline.n_points, expected.n_points), (outline.n_cells, expected.n_cells)):
        assert None in (count, target) or count == target, f"{suffix} holds {count} instead of {target}"
    for those, names in ((outline.facet_sets, expected.facet_sets), (outline.cell_sets, expected.cell_sets)):
        assert None in (those, names) or names <= those, f"{suffix} lacks the sets {names - those}"
    return outline


# XML


def vtk_xml_outline(whole: bytes) -> Outline:
    """Of a VTU or VTP file, from its tags."""
    tags = _tags([whole])
    piece = next(attributes for tag, attributes in tags if tag == "Piece")
    names = [attributes["Name"] for tag, attributes in tags if tag == "DataArray" and "Name" in attributes]
    return _of_vtk(int(piece["NumberOfPoints"]), int(piece.get("NumberOfCells", piece.get("NumberOfPolys", -1))), names)


def febio_outline(whole: bytes) -> Outline:
    """Of an FEBio file, without reading into the lines of items, each of which is an element."""
    skeleton, blocks = _without_blocks(whole, FEBIO_BLOCK, b"\n</")
    tags = _tags(skeleton)
    n_points = next(count for name, count in blocks if name == "Nodes")
    n_cells = sum(count for name, count in blocks if name == "Elements")
    facet_sets, cell_sets = (
        frozenset(attributes["name"] for tag, attributes in tags if tag == kind) for kind in ("Surface", "ElementSet")
    )
    return Outline(n_points, n_cells, facet_sets, cell_sets)


def xdmf_outline(whole: bytes) -> Outline:
    """Of an XDMF file, whose lists are as long as they say."""
    skeleton, blocks = _without_blocks(whole, XDMF_BLOCK, b"</DataItem>")
    tags = _tags(skeleton)
    lengths = [int(each["Dimensions"].split()[0]) for tag, each in tags if tag == "DataItem" and "Dimensions" in each]
    if [count for _, count in blocks] != lengths:
        raise ValueError("a list is not as long as it says")
    names: dict[str, list[str]] = {"": []}
    grid = ""
    for tag, attributes in tags:
        if tag == "Grid":
            grid = attributes["Name"]
            names[grid] = []
        elif tag == "Information":
            names[grid].append(attributes["Name"])
    n_cells, n_points = lengths[:2]
    return Outline(n_points, n_cells, frozenset(names.get("facets", ())), frozenset(names.get("cells", ())))


def _tags(pieces: Iterable[bytes]) -> list[tuple[str, dict[str, str]]]:
    """All elements of XML, each with its attributes; ExpatError if it is not well-formed."""
    tags: list[tuple[str, dict[str, str]]] = []
    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda tag, attributes: tags.append((tag, attributes))
    for piece in pieces:
        parser.Parse(piece, False)
    parser.Parse(b"", True)
    return tags


def _without_blocks(whole: bytes, opening: re.Pattern[bytes], end: bytes) -> tuple[list[bytes], list[tuple[str, int]]]:
    """A file in parts, without the blocks of lines after each match of `opening`; of each block its name and length."""
    parts, blocks, at = [], [], 0
    while match := opening.search(whole, at):
        stop = whole.index(end, match.end())
        parts.append(whole[at : match.end()])
        blocks.append((match[1].decode(), whole.count(b"\n", match.end(), stop + 1)))
        at = stop
    return [*parts, whole[at:]], blocks


# Binary files


def vtk_outline(whole: bytes) -> Outline:
    """Of a binary legacy VTK file, array by array to its end."""
    counts, names, at, n_rows, n_left = {"POINTS": 0, "CELLS": 0}, [], 0, 0, 0
    for _ in range(4):  # the version, the title, BINARY, DATASET
        at = whole.index(b"\n", at) + 1
    while at < len(whole):
        line = _line_at(whole, at)
        at += 1 + len(line)
        key, *words = line.split() or [""]
        n_bytes = 0
        if n_left and key:  # an array of field data, which may be called anything
            names.append(unquote(key))
            n_bytes, n_left = int(words[0]) * int(words[1]) * VTK_BYTES[words[2]], n_left - 1
        elif key == "FIELD":
            n_left = int(words[1])
        elif key in ("CELL_DATA", "POINT_DATA"):
            n_rows = int(words[0])
        elif key == "POINTS":
            counts[key], n_bytes = int(words[0]), 3 * int(words[0]) * VTK_BYTES[words[1]]
        elif key in ("CELLS", "POLYGONS"):
            counts["CELLS"], n_bytes = int(words[0]), 4 * int(words[1])
        elif key == "CELL_TYPES":
            n_bytes = 4 * int(words[0])
        elif key == "SCALARS":
            at += 1 + len(_line_at(whole, at))  # the table of colours
            n_bytes = n_rows * int([*words, "1"][2]) * VTK_BYTES[words[1]]
        elif key == "COLOR_SCALARS":  # of bytes
            n_bytes = n_rows * int(words[1])
        elif key:
            raise ValueError(f"{key} is of no kind that is known")
        at += n_bytes
    if at > len(whole):
        raise ValueError("it ends within an array")
    return _of_vtk(counts["POINTS"], counts["CELLS"], names)


def vtkhdf_outline(whole: bytes) -> Outline:
    """Of a VTKHDF file, each of whose arrays is as long as its pieces say; in several, points are listed repeatedly."""
    import h5py

    try:
        with h5py.File(BytesIO(whole), "r") as file:
            root = file["VTKHDF"]
            points, cells, nodes = (root[f"NumberOf{name}"][()] for name in ("Points", "Cells", "ConnectivityIds"))
            n_points, n_cells = int(points.sum()), int(cells.sum())
            lengths = {"Points": n_points, "Types": n_cells, "Connectivity": nodes.sum(), "Offsets": (cells + 1).sum()}
            lengths |= {f"PointData/{name}": n_points for name in root["PointData"]}
            lengths |= {f"CellData/{name}": n_cells for name in root["CellData"]}
            if odd := [name for name, length in lengths.items() if len(root[name]) != length]:
                raise ValueError(f"{odd[0]} is not as long as it says")
            return _of_vtk(n_points if len(points) == 1 else None, n_cells, root["FieldData"])
    except OSError as error:  # of HDF5, about bytes in memory
        raise ValueError(str(error)) from error


def _of_vtk(n_points: int | None, n_cells: int, names: Iterable[str]) -> Outline:
    """Sets are field data, see `tetopt.io.vtk`."""
    sets: dict[str, set[str]] = {"facets": set(), "cells": set()}
    for name in names:
        prefix, colon, rest = name.partition(":")
        if colon and prefix in sets:
            sets[prefix].add(rest)
    return Outline(n_points, n_cells, frozenset(sets["facets"]), frozenset(sets["cells"]))


def stl_outline(whole: bytes) -> Outline:
    """Of a binary STL file, whose size tells how many triangles it has."""
    count = int.from_bytes(whole[STL_HEAD_BYTES - 4 : STL_HEAD_BYTES], "little")
    if len(whole) != STL_HEAD_BYTES + STL_TRIANGLE_BYTES * count:
        raise ValueError(f"{len(whole)} bytes for {count} triangles")
    return Outline(n_cells=count)


def ply_outline(whole: bytes) -> Outline:
    """Of a binary PLY file as `tetopt.io.surfaces` writes it."""
    head, _, body = whole.partition(b"end_header\n")
    n_points, n_faces = (int(re.findall(rb"(?m)^element %b (\d+)$" % kind, head)[0]) for kind in (b"vertex", b"face"))
    n_labels = len(re.findall(rb"(?m)^property int \S+$", head))
    if len(body) != PLY_VERTEX_BYTES * n_points + (PLY_FACE_BYTES + 4 * n_labels) * n_faces:
        raise ValueError(f"{len(body)} bytes for {n_points} nodes and {n_faces} triangles")
    return Outline(n_points, n_faces)


# Lines


def abaqus_outline(whole: bytes) -> Outline:
    """Of an Abaqus file, card by card."""
    n_points = n_cells = 0
    names: dict[str, set[str]] = {"*SURFACE, NAME": set(), "*ELSET, ELSET": set()}
    for card, _, count in _blocks(whole, b"\n*"):
        key, _, rest = card.partition("=")
        if card == "*NODE":
            n_points += count
        elif card.startswith("*ELEMENT, TYPE=C3D"):
            n_cells += count
        elif key in names:
            names[key].add(rest.partition(",")[0])
    return Outline(n_points, n_cells, frozenset(names["*SURFACE, NAME"]), frozenset(names["*ELSET, ELSET"]))


def gmsh_outline(whole: bytes) -> Outline:
    """Of an MSH file, section by section, of which nodes, elements and views are as long as they say."""
    marks = list(_blocks(whole, b"\n$"))
    sections = marks[::2]
    for (opening, *_), (closing, _, n_between) in zip(sections, marks[1::2], strict=True):
        if closing != f"$End{opening[1:]}" or n_between:
            raise ValueError(f"{opening} ends with {closing}")
    start = {name: at for name, at, _ in reversed(sections)}
    heads = {name: _line_at(whole, at).split() for name, at in start.items()}
    is_new = heads["$MeshFormat"][0] == "4.1"
    n_points = int(heads["$Nodes"][1 if is_new else 0])
    n_blocks, n_elements = map(int, heads["$Elements"][:2] if is_new else ["0", *heads["$Elements"]])
    lengths = {"$Nodes": 2 + 2 * n_points if is_new else 1 + n_points, "$Elements": 1 + n_blocks + n_elements}
    lengths |= {"$ElementData": GMSH_DATA_LINES + n_elements, "$NodeData": GMSH_DATA_LINES + n_points}
    lengths |= {name: 1 + sum(map(int, heads.get(name, ()))) for name in ("$Entities", "$PhysicalNames")}
    if any(count != lengths.get(name, count) for name, _, count in sections):
        raise ValueError("a section is not as long as it says")
    names = whole[start["$PhysicalNames"] : whole.index(b"\n$End", start["$PhysicalNames"])].decode().splitlines()
    return Outline(n_points, None, frozenset(name.split('"')[1] for name in names[1:]))


def mfem_outline(whole: bytes) -> Outline:
    """Of an MFEM mesh."""
    parts = dict(part.partition(b"\n")[::2] for part in whole.split(b"\n\n"))
    keys = list(parts)
    n_points, n_lines = _counted(parts[b"vertices"])
    n_cells, _ = _listed(parts[b"elements"])
    _listed(parts[b"boundary"])
    if b"nodes" in parts:  # of order 2, whose rows follow their head
        n_points = 2 + parts[keys[keys.index(b"nodes") + 1]].count(b"\n")
    elif n_lines != 1 + n_points:
        raise ValueError("its vertices are not as many as it says")
    if keys[-1].strip() != b"mfem_mesh_end":
        raise ValueError("it has no end")
    return Outline(n_points, n_cells, *(_mfem_sets(parts[key]) for key in (b"bdr_attribute_sets", b"attribute_sets")))


def _mfem_sets(part: bytes) -> frozenset[str]:
    count, *texts = part.decode().split('"')
    tags = [text.split() for text in texts[1::2]]
    if int(count) != len(tags) or any(len(numbers) != 1 + int(numbers[0]) for numbers in tags):
        raise ValueError("a set has not as many attributes as it says")
    return frozenset(texts[::2])


def medit_outline(whole: bytes) -> Outline:
    """Of a medit mesh, whose sets are words in its comments."""
    parts = dict(part.partition(b"\n")[::2] for part in whole.split(b"\n\n"))
    keys = list(parts)
    first = keys.index(b"Vertices")  # then come cells, and facets
    (n_points, _), (n_cells, _), _ = (_listed(parts[key]) for key in keys[first : first + 3])
    if keys[-1].strip() != b"End":
        raise ValueError("it has no end")
    comments = whole[: whole.index(b"\nVertices\n")].decode()
    facet_sets, cell_sets = (
        frozenset(" ".join(re.findall(rf"(?m)^# {key.decode()} ref \d+: (.*)$", comments)).split())
        for key in (keys[first + 2], keys[first + 1])
    )
    return Outline(n_points, n_cells, facet_sets, cell_sets)


def _blocks(whole: bytes, mark: bytes) -> Iterator[tuple[str, int, int]]:
    """Each line that begins with `mark`, a line break and what follows it; where the next begins, and how many there
    are up to the next mark."""
    starts = [-1] if whole.startswith(mark[1:]) else []
    at = -1
    while (at := whole.find(mark, at + 1)) >= 0:
        starts.append(at)
    for start, end in pairwise([*starts, len(whole) - 1]):
        line = _line_at(whole, start + 1)
        body = start + 2 + len(line.encode())
        yield line, body, whole.count(b"\n", body, end + 1)


def _line_at(whole: bytes, start: int) -> str:
    return whole[start : whole.index(b"\n", start)].decode()


def _counted(part: bytes) -> tuple[int, int]:
    """The number that a part begins with, and how many lines follow it."""
    return int(part.partition(b"\n")[0]), part.count(b"\n")


def _listed(part: bytes) -> tuple[int, int]:
    """As `_counted`; ValueError if these are not the same."""
    number, n_lines = _counted(part)
    if number != n_lines:
        raise ValueError(f"a list of {number} has {n_lines} lines")
    return number, n_lines


OUTLINES = {  # by suffix
    ".vtkhdf": vtkhdf_outline,
    ".vtu": vtk_xml_outline, ".vtp": vtk_xml_outline, ".vtk": vtk_outline, ".xdmf": xdmf_outline,
    ".msh": gmsh_outline, ".msh2": gmsh_outline, ".inp": abaqus_outline, ".feb": febio_outline,
    ".mfem": mfem_outline, ".mesh": medit_outline, ".stl": stl_outline, ".ply": ply_outline,
}  # fmt: skip
