"""Reading of meshes in Abaqus, FEBio, medit and XDMF files; materials only of tetopt's own files,
whose units are known.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from tetopt.errors import InputError
from tetopt.geometry.topology import boundary_facets
from tetopt.interop.conversions import CELL_DIMENSIONS, CORNER_KINDS
from tetopt.io.abaqus import ALL_ELEMENTS, FACE_NUMBERS
from tetopt.io.apart import read_apart
from tetopt.io.gmsh import own_comments
from tetopt.io.raw import Group, Raw, by_corners, main_kind
from tetopt.io.read_gmsh import of_ours, places_of
from tetopt.io.text import list_names
from tetopt.model.label_names import LABEL_FIELD, TABLE_TEXT, LabelTable, table_words
from tetopt.model.model import STRESS_UNITS, WATER_DENSITY
from tetopt.model.sets import facet_triples
from tetopt.system.arrays import Arrays, Floats, Ints, Json

# Abaqus' and FEBio's cells by their number of nodes
CELLS_BY_COUNT = {
    **{"solid 4": "tetra", "solid 10": "tetra10", "solid 6": "wedge", "solid 8": "hexahedron"},
    **{"solid 15": "wedge15", "solid 20": "hexahedron20", "face 3": "triangle"},
    **{"face 6": "triangle6", "face 4": "quad", "face 8": "quad8", "solid 5": "pyramid"},
}
ABAQUS_SOLID = r"D?C3D(\d+)"
ABAQUS_FACE = r"(?:CP[ESEG]+|CAX|DC2D|DS|S|STRI|M3D|SFM3D|R3D)(\d+)"
# Elements that are no cells, which are left out: beams, trusses, springs, masses, connectors
ABAQUS_OTHERS = (
    r"B[23]\d|PIPE|ELBOW|FRAME|T[23]D|DC1D|SPRING|DASHPOT|MASS|ROTARYI|HEATCAP|CONN|GAP|DGAP|"
    r"IT[ST]|JOINT|DCOUP|RB[23]D|R2D|RAX|SAX|MAX|DSAX|D$"
)
FEBIO_OTHERS = r"line|truss|beam"
MEDIT_KINDS = {
    **{"Edges": "line", "Triangles": "triangle", "Tetrahedra": "tetra", "EdgesP2": "line3"},
    **{"TrianglesP2": "triangle6", "TetrahedraP2": "tetra10", "Quadrilaterals": "quad"},
    **{"Hexahedra": "hexahedron", "Prisms": "wedge", "Pyramids": "pyramid"},
}
MOST_MEMBERS = 10**8  # of a generated set
# Abaqus' cards of nodes and elements that are not in the file itself, or are in other axes
GENERATED = ("INCLUDE", "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM")


class FileNumbers(NamedTuple):
    """Nodes, elements and sets of a file, by their numbers."""

    nodes: list[tuple[Ints, Floats]]
    elements: list[tuple[str, Ints, Ints]]  # type, numbers, numbers of nodes (K, w)
    cells: dict[str, Ints]  # sets of elements
    points: dict[str, Ints]  # sets of nodes
    facets: dict[str, list[tuple[Ints, int]]]  # surfaces: elements, and Abaqus' face of them
    triangles: dict[str, Ints]  # surfaces: numbers of nodes, (K, 3)
    parts: dict[str, str]  # the material of a set of elements
    constants: dict[str, dict[str, Floats]]  # of a material, by name: one number, or one a cell
    others: dict[str, int]  # numbers of elements that are no cells, by type


def read_inp(path: Path) -> Raw:
    """Read an Abaqus or CalculiX input file."""
    text = path.read_text("utf-8", "replace")
    lines = [line[3:] for line in text.splitlines() if line.startswith("** ")]
    raw = _raw_of(_abaqus(text), lines)
    words = "its last line has no end, so that the file may have been cut short"
    is_whole = text.rstrip(" \t").endswith("\n")
    return raw._replace(notes=(*raw.notes, *[words] * (not is_whole)))


def read_feb(path: Path) -> Raw:
    """Read an FEBio input file."""
    text = path.read_text("utf-8", "replace")
    try:
        root = ElementTree.fromstring(text.encode())
    except ElementTree.ParseError as error:
        raise InputError(f"damaged, or not an FEBio file ({error})") from error
    comment = re.search(r"<!--\n(.*?)-->", text, re.DOTALL)
    return _raw_of(_febio(root), comment[1].splitlines() if comment else [])


def read_medit(path: Path) -> Raw:
    """Read a medit file, whose references are cell data "medit:ref"."""
    text = path.read_text("utf-8", "replace")
    lines = [line[2:] for line in text.splitlines() if line.startswith("# ")]
    parts = re.split(r"^\s*([A-Za-z]\w*)", re.sub("#.*", "", text), flags=re.MULTILINE)
    sections: dict[str, Floats] = {}
    for keyword, numbers in zip(parts[1::2], map(_numbers, parts[2::2]), strict=True):
        if keyword in sections:  # one more section of a keyword has more rows of it
            count, *rest = sections[keyword]
            numbers = np.concatenate([numbers[:1] + count, rest, numbers[1:]])
        sections[keyword] = numbers
    if not {"Dimension", "Vertices"} <= sections.keys():
        raise InputError("expected a medit mesh as text, with Dimension and Vertices")
    n = int(sections["Dimension"][0])
    points = _in_space(_rows(sections["Vertices"], n + 1)[:, :n])
    cells = {}
    refs = {}
    for keyword, kind in MEDIT_KINDS.items():
        if keyword in sections and (count := int(sections[keyword][0])):
            rows = _rows(sections[keyword], (len(sections[keyword]) - 1) // count).astype(np.int64)
            cells[kind], refs[kind] = rows[:, :-1] - 1, rows[:, -1]
    raw = by_corners(Raw(points, cells, {"medit:ref": refs}, {}, {}, [], "ras"))
    cell_word, side_word = ("Tetrahedra", "Triangles") if n == 3 else ("Triangles", "Edges")
    words = {cell_word: "cells", side_word: "facets"}
    pattern = re.compile(rf"({cell_word}|{side_word})(?:P2)? ref ")
    ours = [pattern.sub(lambda match: f"entity of {words[match[1]]} ", line) for line in lines]
    if (comments := own_comments(ours)) is None:
        return raw
    tags = raw.cell_data["medit:ref"]
    return _with_labels(
        of_ours(raw._replace(cell_data={"gmsh:geometrical": tags}), comments), lines
    )


def read_xdmf(path: Path) -> Raw:
    """Read an XDMF file through meshio in a child, and the sets of tetopt's."""
    fields = read_apart(_xdmf_fields, path, library="meshio")
    lines = fields.pop("lines")
    groups = [Group(*group) for group in fields.pop("groups")]
    return _with_texts(Raw(**fields, groups=groups), lines)


def _xdmf_fields(path: str) -> Json:
    """Return the fields of a `Raw`, and lines of text."""
    import meshio

    try:
        file = meshio.read(path)
    except (Exception, SystemExit) as error:  # meshio can raise any error, and exits for others
        why = "expected one uniform grid" if isinstance(error, SystemExit) else str(error)
        words = "save it as .vtu, by ParaView or meshio convert"
        raise InputError(f"cannot be read as one XDMF mesh ({why}); {words}") from error
    cells: dict[str, Ints] = {}
    cell_data: dict[str, Arrays] = {name: {} for name in file.cell_data}
    for kind in dict.fromkeys(block.type for block in file.cells):
        those = [k for k, block in enumerate(file.cells) if block.type == kind]
        cells[kind] = np.concatenate([file.cells[k].data for k in those]).astype(np.int64)
        for name, values in file.cell_data.items():
            cell_data[name][kind] = np.concatenate([values[k] for k in those])
    points = np.zeros((len(file.points), 3))
    points[:, : file.points.shape[1]] = file.points
    raw = by_corners(Raw(points, cells, cell_data, dict(file.point_data), {}, [], "ras"))
    root = ElementTree.parse(path).getroot()
    about = "./Domain/Grid/Information[@Name='about']"
    lines = [each.get("Value", "") for each in root.findall(about)]
    members: dict[str, Ints] = {}
    facets: dict[str, Ints] = {}
    if own_comments(lines) is not None:
        kind = main_kind(raw)
        width = CELL_DIMENSIONS[kind]
        for name, nodes in _sets_by_tags(root, "cells", width + 1):
            members[name] = _row_places(raw.cells[kind], nodes)
        for name, nodes in _sets_by_tags(root, "facets", width):
            is_turned = name.endswith(" turned")
            name = name.removesuffix(" turned")
            nodes = nodes[:, ::-1] if is_turned else nodes
            facets[name] = np.concatenate([facets.get(name, nodes[:0]), nodes])
    return _with_groups(raw, members, facets)._asdict() | {"lines": lines}


def _sets_by_tags(root: ElementTree.Element, grid: str, width: int) -> Iterator[tuple[str, Ints]]:
    """Yield each set of a grid of tags, with the corners of its cells or facets, (K, w)."""
    for inner in root.iterfind(f".//Grid[@Name='{grid}']"):
        texts = [inner.findtext(f"{part}/DataItem", "") for part in ("Topology", "Attribute")]
        nodes, tags = (_numbers(text).astype(np.int64) for text in texts)
        nodes = nodes.reshape(len(tags), -1)[:, :width]
        for each in inner.findall("Information"):
            of_set = np.array(each.get("Value", "").split(), dtype=np.int64)
            yield each.get("Name", ""), nodes[np.isin(tags, of_set)]


def _row_places(rows: Ints, some: Ints) -> Ints:
    """Return the place of each of some rows among distinct ones."""
    number = np.unique(np.concatenate([rows, some]), axis=0, return_inverse=True)[1].ravel()
    return places_of(number[: len(rows)], number[len(rows) :])


# Abaqus


def _abaqus(text: str) -> FileNumbers:
    """Return what an input file lists."""
    file = FileNumbers([], [], {}, {}, {}, {}, {}, {}, {})
    material = ""
    spelling: dict[tuple[str, str], str] = {}
    text = re.sub(r"^\*\*.*\n?", "", text, flags=re.MULTILINE)
    for block in re.split(r"^\*", text, flags=re.MULTILINE)[1:]:
        card, options, body = _card(block, spelling)
        is_turned = card == "NODE" and options.get("SYSTEM", "R").upper() != "R"
        if card in GENERATED or is_turned or (card == "INSTANCE" and body.strip()):
            card += ", SYSTEM" * is_turned
            raise InputError(f"cannot be read with *{card}; export one mesh with all its nodes")
        if card == "NODE":
            rows = np.atleast_2d(_rows_of_lines(body))
            file.nodes.append((rows[:, 0].astype(np.int64), _in_space(rows[:, 1:4])))
            _add(file.points, options.get("NSET"), file.nodes[-1][0])
        elif card == "ELEMENT":
            _add_elements(file, options, body)
        elif card in ("ELSET", "NSET") and card in options:
            sets = file.cells if card == "ELSET" else file.points
            _add(sets, options[card], _set_members(body, sets, is_range="GENERATE" in options))
        elif card == "SURFACE" and options.get("TYPE", "ELEMENT").upper() == "ELEMENT":
            faces = file.facets.setdefault(options["NAME"], [])
            for element, face in re.findall(r"^\s*([^,\n]+?)\s*,\s*S(\d)", body, re.MULTILINE):
                faces.append((_set_members(element, file.cells), int(face)))
        elif card == "MATERIAL":
            material = options.get("NAME", "")
        elif card in ("ELASTIC", "DENSITY"):
            values = _numbers(body.replace(",", " "))
            names = ("young", "nu") if card == "ELASTIC" else ("density",)
            if len(values) == len(names):  # more depend on temperature
                constants = file.constants.setdefault(material, {})
                constants |= dict(zip(names, values[:, None], strict=True))
        elif card == "SOLID SECTION" and "ELSET" in options:
            file.parts[options["ELSET"]] = options.get("MATERIAL", "")
    # sections may stand before their sets
    parts = {_set_name(name, file.cells): material for name, material in file.parts.items()}
    return file._replace(parts=parts)


def _set_name(word: str, sets: dict[str, Ints]) -> str:
    """Return the name of the set that a word names, in any case, or as INSTANCE.SET."""
    names = {name.casefold(): name for name in sets}
    key = word.casefold()
    key = key if key in names else key.rpartition(".")[2]
    if key not in names:
        raise InputError(f'damaged: expected a set, found "{word}", which it does not have')
    return names[key]


def _card(block: str, spelling: dict[tuple[str, str], str]) -> tuple[str, dict[str, str], str]:
    """Return a keyword, its options and the lines of data; names have their first `spelling`,
    as Abaqus knows no case.
    """
    head, _, body = block.partition("\n")
    while head.rstrip().endswith(",") and re.match(r"\s*[A-Za-z]", body):
        more, _, body = body.partition("\n")
        head += more
    card, *words = (word.strip().strip('"') for word in head.split(","))
    card = card.upper()
    options = {}
    for key, _, value in (word.partition("=") for word in words):
        key, value = key.strip().upper(), value.strip().strip('"')
        of = card if key == "NAME" else key
        options[key] = spelling.setdefault((of, value.casefold()), value)
    return card, options, body


def _add_elements(file: FileNumbers, options: dict[str, str], body: str) -> None:
    """Add the cells of a card, or the number of its elements that are none."""
    word = options.get("TYPE", "")
    kind = _abaqus_kind(word)
    numbers = _numbers(body.replace(",", " ")).astype(np.int64)
    if kind is None:
        n_more = len(re.findall(r",[ \t]*$", body, re.MULTILINE))  # lines that go on
        n_lines = sum(bool(line.strip()) for line in body.splitlines())
        file.others[word] = file.others.get(word, 0) + n_lines - n_more
        _add(file.cells, options.get("ELSET"), numbers[:0])
        return
    name, n_nodes = kind
    if len(numbers) % (1 + n_nodes):
        raise InputError(f"damaged: expected {1 + n_nodes} numbers for each element of {word}")
    element, *nodes = numbers.reshape(-1, 1 + n_nodes).T
    file.elements.append((name, element, np.column_stack(nodes)))
    _add(file.cells, options.get("ELSET"), element)


def _abaqus_kind(word: str) -> tuple[str, int] | None:
    """Return the type of cells and its number of nodes; None for springs, beams and the like."""
    for what, pattern in (("solid", ABAQUS_SOLID), ("face", ABAQUS_FACE)):
        if match := re.match(pattern, word.upper()):
            count = {"65": 6}.get(match[1], match[1])  # STRI65
            if (kind := CELLS_BY_COUNT.get(f"{what} {count}")) is not None:
                return kind, int(count)
    if re.match(ABAQUS_OTHERS, word.upper()) is None:
        raise _unknown_type(word)
    return None


def _unknown_type(word: str) -> InputError:
    return InputError(
        f'expected tetrahedra or triangles, of order 1 or 2, found elements of type "{word}"'
    )


def _add(sets: dict[str, Ints], name: str | None, members: Ints) -> None:
    """Add members to a set, if it has a name."""
    if name is not None:
        sets[name] = np.unique(np.concatenate([sets.get(name, members), members]))


def _set_members(body: str, sets: dict[str, Ints], is_range: bool = False) -> Ints:
    """Return the numbers in lines of numbers and names of sets."""
    if is_range:
        lines = [line.replace(",", " ") for line in body.splitlines() if line.strip()]
        rows = [_numbers(line).astype(np.int64).tolist() for line in lines]
        ranges = [range(first, last + 1, *step) for first, last, *step in rows]
        if sum(map(len, ranges)) > MOST_MEMBERS:
            raise InputError(f"damaged: a set of more than {MOST_MEMBERS:.0e} members")
        return np.concatenate([np.arange(each.start, each.stop, each.step) for each in ranges])
    words = [word.strip().strip('"') for word in re.split(r"[,\n]", body)]
    numbers = [int(word) for word in words if word.isdecimal()]
    named = [sets[_set_name(word, sets)] for word in words if word and not word.isdecimal()]
    return np.concatenate([np.array(numbers, dtype=np.int64), *named])


# FEBio


def _febio(root: ElementTree.Element) -> FileNumbers:
    """Return what a file lists, of versions 2 to 4."""
    file = FileNumbers([], [], {}, {}, {}, {}, {}, {}, {})
    for nodes in root.iter("Nodes"):
        file.nodes.append((_ids(nodes), _of_children(nodes)))
    domains = {each.get("name"): each.get("mat", "") for each in root.iter("SolidDomain")}
    for block in root.iter("Elements"):
        word = block.get("type", "")
        match = re.fullmatch(r"(?:(tet|hex|penta|pyra)|(?:tri|quad|q))(\d+).*", word.lower())
        kind = (
            CELLS_BY_COUNT.get(f"{'solid' if match[1] else 'face'} {match[2]}") if match else None
        )
        if not len(block):
            continue
        if kind is not None:
            file.elements.append((kind, _ids(block), _of_children(block).astype(np.int64)))
            name = block.get("name", f"part {len(file.parts) + 1}")
            file.parts[name] = name
            blocks = [file.cells[name]] if name in file.cells else []
            file.cells[name] = np.concatenate([*blocks, _ids(block)])
            file.constants[name] = _febio_constants(root, name, domains.get(name, ""))
        elif re.match(FEBIO_OTHERS, word.lower()):
            file.others[word] = file.others.get(word, 0) + len(block)
        else:
            raise _unknown_type(word)
    for what, sets in (("ElementSet", file.cells), ("NodeSet", file.points)):
        for each in root.iter(what):
            members = _ids(each) if len(each) else _numbers((each.text or "").replace(",", " "))
            _add(sets, each.get("name"), members.astype(np.int64))
    for surface in root.iter("Surface"):
        rows = [child.text or "" for child in surface if child.tag.startswith("tri")]
        if rows:
            corners = [row.split(",")[:3] for row in rows]
            file.triangles[surface.get("name", "surface")] = np.array(corners, dtype=np.int64)
    return file


def _febio_constants(root: ElementTree.Element, part: str, material: str) -> dict[str, Floats]:
    """Return the constants of a part, or those of its cells, in their order in the file."""
    constants = {}
    for each in root.iterfind(f".//Material/material[@name='{material}']"):
        for name, tag in (("young", "E"), ("nu", "v"), ("density", "density")):
            child = each.find(tag)
            if child is not None and child.get("type") == "map":
                path = f".//ElementData[@name='{child.text}'][@elem_set='{part}']"
                child = root.find(path)
                constants[name] = np.empty(0) if child is None else _of_children(child)[:, 0]
            elif child is not None:
                constants[name] = _numbers(child.text or "")
    return constants


def _ids(block: ElementTree.Element) -> Ints:
    return np.array([int(each.get("id", 0)) for each in block], dtype=np.int64)


def _of_children(block: ElementTree.Element) -> Floats:
    """Return the numbers in each child's text, a row for each."""
    return np.array([(each.text or "").split(",") for each in block], dtype=np.float64)


# Numbers as places: the contents of a mesh's file


def _raw_of(file: FileNumbers, lines: list[str]) -> Raw:
    """Return the contents with places for numbers; elements ascend by number."""
    if not file.nodes or not file.elements:
        raise InputError("expected nodes, and elements of cells, found none")
    numbers, points = (np.concatenate(each) for each in zip(*file.nodes, strict=True))
    if len(np.unique(numbers)) < len(numbers):
        raise InputError("expected one part, but numbers of nodes repeat; export one flat mesh")
    place = partial(_node_places, numbers)
    cells = {}
    ids = {}
    for kind in dict.fromkeys(kind for kind, _, _ in file.elements):
        those = [each for each in file.elements if each[0] == kind]
        order = np.argsort(np.concatenate([each[1] for each in those]), kind="stable")
        cells[kind] = place(np.concatenate([each[2] for each in those])[order])
        ids[CORNER_KINDS.get(kind, kind)] = np.concatenate([each[1] for each in those])[order]
    raw = by_corners(Raw(points, cells, {}, {}, {}, [], "ras"))
    kind = main_kind(raw)
    is_ours = own_comments(lines) is not None
    parts = {name: places_of(ids[kind], file.cells.get(name, numbers[:0])) for name in file.parts}
    own = (
        {ALL_ELEMENTS, *file.parts, *file.parts.values()} - _label_sets(lines).keys()
        if is_ours
        else set()
    )
    members = {
        name: np.unique(places_of(ids[kind], those))
        for name, those in file.cells.items()
        if name not in own
    }
    facets = _facets_of(file, raw, kind, ids[kind], place)
    raw = _with_texts(_with_groups(raw, members, facets), lines)
    raw = raw._replace(notes=(*raw.notes, *_lost_words(file, ids)))
    constants = {name: file.constants.get(each, {}) for name, each in file.parts.items()}
    return _with_materials(raw, kind, parts, constants)


def _lost_words(file: FileNumbers, ids: dict[str, Ints]) -> Iterator[str]:
    """Yield notes on elements that are no cells, and on sets of others than the file's cells."""
    if file.others:
        counts = [f"{count} of type {word}" for word, count in file.others.items()]
        yield f"left out elements that are no cells: {', '.join(counts)}"
    numbers = np.concatenate(list(ids.values()))
    n_lost = {name: int((~np.isin(those, numbers)).sum()) for name, those in file.cells.items()}
    if any(n_lost.values()):
        names = [name for name, count in n_lost.items() if count]
        yield (
            f"left out {sum(n_lost.values())} members of {list_names(names)}, which are none of "
            "its cells"
        )


def _facets_of(
    file: FileNumbers, raw: Raw, kind: str, ids: Ints, place: Callable[[Ints], Ints]
) -> dict[str, Ints]:
    """Return the corners of the facets, (K, n), of surfaces, and of sets of nodes on the
    boundary.
    """
    corners = raw.cells[kind]
    facets = {name: place(nodes) for name, nodes in file.triangles.items()}
    if kind == "tetra":  # Abaqus' faces of triangles are edges of shells
        opposite = np.argsort(FACE_NUMBERS)
        for name, faces in file.facets.items():
            rows = [
                np.column_stack(
                    [cells[cells >= 0], np.full((cells >= 0).sum(), opposite[face - 1])]
                )
                for cells, face in ((places_of(ids, those), face) for those, face in faces)
                if 1 <= face <= len(opposite)
            ]
            if rows:
                facets[name] = facet_triples(corners, np.concatenate(rows))
    outer = boundary_facets(corners) if file.points else corners
    for name, nodes in file.points.items():
        is_in = np.isin(outer, place(nodes)).all(axis=1)
        if name not in facets and is_in.any():
            facets[name] = outer[is_in]
    return facets


def _with_groups(raw: Raw, members: dict[str, Ints], facets: dict[str, Ints]) -> Raw:
    """Return the contents with sets of cells, and of facets by their corners."""
    kind = main_kind(raw)
    groups = [Group(name, kind, those[those >= 0]) for name, those in members.items()]
    cells = dict(raw.cells)
    if facets:
        side = "triangle" if kind == "tetra" else "line"
        starts = np.cumsum([0, *map(len, facets.values())]).tolist()
        cells[side] = np.concatenate(list(facets.values()))
        groups += [
            Group(name, side, np.arange(start, end))
            for name, start, end in zip(facets, starts, starts[1:], strict=False)
        ]
    return raw._replace(cells=cells, groups=[group for group in groups if len(group.members)])


def _with_texts(raw: Raw, lines: list[str]) -> Raw:
    """Return the contents with the space, texts and labels in the comments of a file of
    tetopt's; others unchanged.
    """
    comments = own_comments(lines)
    if comments is None:
        return raw
    texts = {name: np.array([text]) for name, text in comments.texts.items()}
    return _with_labels(
        raw._replace(space=comments.space, field_data=raw.field_data | texts), lines
    )


def _label_sets(lines: list[str]) -> dict[str, int]:
    """Return the label of each set of cells in the comments of a file of tetopt's."""
    matches = (re.fullmatch(r"label (\d+): (\S+)", line) for line in lines)
    return {match[2]: int(match[1]) for match in matches if match is not None}


def _with_labels(raw: Raw, lines: list[str]) -> Raw:
    """Return the contents with the labels that the comments name, if all cells have one."""
    kind = main_kind(raw)
    labels = np.full(len(raw.cells[kind]), -1)
    label_of = _label_sets(lines)
    for group in raw.groups:
        if group.kind == kind and group.label in label_of:
            labels[group.members] = label_of[group.label]
    if LABEL_FIELD not in raw.cell_data and (labels >= 0).all():
        raw = raw._replace(cell_data=raw.cell_data | {LABEL_FIELD: {kind: labels}})
    names = {label: name for name, label in label_of.items() if name != f"label_{label}"}
    table = np.array([json.dumps(table_words(LabelTable(names, {})))])
    return raw._replace(field_data=raw.field_data | ({TABLE_TEXT: table} if names else {}))


def _with_materials(
    raw: Raw, kind: str, parts: dict[str, Ints], constants: dict[str, dict[str, Floats]]
) -> Raw:
    """Return the contents with the moduli of a file of tetopt's, or with the parts of another
    program's as labels.
    """
    fields: Arrays = {}
    count = len(raw.cells[kind])
    if "units" in raw.field_data:
        for name in ("young", "nu", "density"):
            values = np.full(count, np.nan)
            for part, members in parts.items():
                if len(each := constants[part].get(name, np.empty(0))) in (1, len(members)):
                    values[members] = each
            if np.isfinite(values).all():
                fields[name] = values
        if "density" in fields:
            water = STRESS_UNITS[str(raw.field_data["units"][0])].water
            fields["density"] = fields["density"] / water * WATER_DENSITY
    elif len(parts) > 1:
        labels = np.zeros(count, dtype=np.int64)
        for label, members in enumerate(parts.values(), 1):
            labels[members[members >= 0]] = label
        fields["regions"] = labels
    return raw._replace(
        cell_data=raw.cell_data | {name: {kind: values} for name, values in fields.items()}
    )


def _node_places(numbers: Ints, nodes: Ints) -> Ints:
    """Return the places of nodes by number; InputError if the file has one of them not."""
    places = places_of(numbers, nodes)
    if (places < 0).any():
        raise InputError("damaged: its elements or sets use nodes that it does not have")
    return places


def _numbers(text: str) -> Floats:
    """Return the numbers in a text; InputError for anything else."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.fromstring(text.replace("D", "E").replace("d", "e"), sep=" ")  # Fortran's
        except (ValueError, DeprecationWarning) as error:
            raise InputError(
                f"damaged: expected numbers ({' '.join(text.split())[:40]})"
            ) from error


def _rows(values: Floats, width: int) -> Floats:
    """Return the rows after their count."""
    count = int(values[0])
    if len(values) != 1 + count * width:
        raise InputError(f"damaged: expected {count} rows of {width} numbers")
    return values[1:].reshape(count, width)


def _rows_of_lines(body: str) -> Floats:
    """Return the numbers of lines with commas, a row for each line; blank ones are 0, also after
    a last comma.
    """
    lines = [line for each in body.splitlines() if (line := each.strip())]
    width = 1 + max((line.removesuffix(",").count(",") for line in lines), default=0)
    lines = [line + "," * (width - line.count(",") if line.endswith(",") else 1) for line in lines]
    values = _numbers(re.sub(r",[ \t]*(?=,)", " 0", "\n".join(lines)).replace(",", " "))
    if any(line.count(",") != width for line in lines) or len(values) != len(lines) * width:
        raise InputError(f"damaged: expected lines of {width} numbers")
    return values.reshape(-1, width)


def _in_space(points: Floats) -> Floats:
    return np.column_stack([points, np.zeros((len(points), 3 - points.shape[1]))])
