"""Reading of gmsh files, 2.2 and 4.1, as text or binary; values belong to the numbers of nodes and
elements.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.interop.conversions import CELL_DIMENSIONS
from tetopt.io.apart import read_apart
from tetopt.io.gmsh import TET10_ORDER, OwnComments, own_comments
from tetopt.io.raw import Group, Raw, by_corners, main_kind
from tetopt.io.text import free_text
from tetopt.model.label_names import LABEL_FIELD, TABLE_TEXT, LabelTable, table_words
from tetopt.system.arrays import Arrays, Floats, Ints, Json
from tetopt.system.budget import check_memory, memory_words

BYTES_A_LETTER = 4  # of memory per byte of a gmsh file: its text twice, and its numbers
# Names of unnamed groups, by dimension; their number is appended.
DEFAULT_LABELS = {1: "edge", 2: "surface", 3: "volume"}
# gmsh's types of elements, with their numbers of nodes; those that no mesh may have are refused by
# name later
ELEMENT_KINDS = {
    15: ("vertex", 1),
    1: ("line", 2),
    2: ("triangle", 3),
    4: ("tetra", 4),
    8: ("line3", 3),
    9: ("triangle6", 6),
    11: ("tetra10", 10),
    3: ("quad", 4),
    5: ("hexahedron", 8),
    6: ("wedge", 6),
    7: ("pyramid", 5),
}
FEWEST_ROWS = 64  # that are compared at once, to find elements of one type


class _Elements(NamedTuple):
    """Elements of one type."""

    kind: str
    numbers: Ints  # (K,) in the file
    physical: Ints  # (K,)
    geometrical: Ints  # (K,)
    nodes: Ints  # (K, w) numbers of nodes


class _Numbers:
    """The numbers of a section, of text or binary, one after the other."""

    def __init__(self, section: bytes, order: str | None) -> None:
        """Read from the start; `order` is that of bytes, None for text."""
        self._section = section
        self._order = order
        self._text = np.fromstring(section, sep=" ") if order is None else np.empty(0)
        self._at = 0

    def rows(
        self, count: int, n_ints: int, n_floats: int = 0, size: int = 4
    ) -> tuple[Ints, Floats]:
        """Return the next rows of integers, of `size` bytes each, and of floats."""
        width = n_ints + n_floats
        start = self._at
        if self._order is None:
            self._at += count * width
            rows = self._text[start : self._at].reshape(count, width)
            return rows[:, :n_ints].astype(np.int64), rows[:, n_ints:]
        kind = np.dtype(
            [
                ("ints", f"{self._order}i{size}", (n_ints,)),
                ("floats", f"{self._order}f8", (n_floats,)),
            ]
        )
        self._at += count * kind.itemsize
        table = np.frombuffer(self._section, kind, count, start)
        return table["ints"].astype(np.int64), table["floats"].astype(np.float64)

    def ints(self, count: int, size: int = 4) -> list[int]:
        """Return the next integers."""
        return [int(each) for each in self.rows(1, count, size=size)[0][0]]

    def rest(self) -> Ints:
        """Return all integers of four bytes, (K,)."""
        if self._order is None:
            return self._text.astype(np.int64)
        n_bytes = len(self._section) // 4 * 4
        return np.frombuffer(self._section[:n_bytes], f"{self._order}i4").astype(np.int64)


def read_msh(path: Path) -> Raw:
    """Read a gmsh file in a child with limits, as a header may state any size.

    All its errors become InputErrors, without a leading path.
    """
    size = path.stat().st_size
    check_memory(BYTES_A_LETTER * size, f"{memory_words(size)} of a gmsh mesh", "save it as .vtu")
    fields = read_apart(_fields_of, path, library="numpy")
    groups = [Group(*group) for group in fields.pop("groups")]
    return Raw(**fields, groups=groups)


def _fields_of(path: str) -> Json:
    """Return the fields of a `Raw`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # numpy's, of text with other things than numbers
            raw = _msh(Path(path).read_bytes())
    except InputError:
        raise
    except Exception as error:  # damaged sections can raise any error
        raise InputError(f"cannot be read as a gmsh mesh ({type(error).__name__})") from error
    return raw._asdict()


def _msh(text: bytes) -> Raw:
    """Read a file's contents."""
    head = _section(text, "MeshFormat")
    version, is_binary = head.split(maxsplit=3)[:2]
    if not version.startswith((b"2", b"4.1")):
        raise InputError(
            f"gmsh's format {version.decode('ascii', 'replace')}: expected 2.2 or 4.1; save it by "
            "gmsh FILE.msh -save -format msh41 -o NEW.msh"
        )
    # a binary file has the integer 1 after its first line
    order = None if is_binary == b"0" else ">" if head.endswith(b"\1") else "<"
    is_4 = version.startswith(b"4")
    entities = _section(text, "Entities")
    groups_of: dict[tuple[int, int], list[int]] | None = {} if is_4 else None
    if is_4 and entities:
        groups_of = _groups_of_entities(_Numbers(entities, order))
    nodes = _section(text, "Nodes")
    elements = _section(text, "Elements")
    if not nodes or not elements:
        raise InputError(f"damaged: it has no ${'Elements' if nodes else 'Nodes'}")
    if groups_of is None:
        numbers, points = _nodes_2(nodes, order)
        blocks = list(_elements_2(elements, order))
    else:
        numbers, points = _nodes_4(_Numbers(nodes, order))
        blocks = list(_elements_4(_Numbers(elements, order), groups_of))
    raw = by_corners(_with_views(_raw(numbers, points, blocks), text, order, numbers, blocks))
    tags = raw.cell_data["gmsh:physical" if groups_of is None else "gmsh:geometrical"]
    groups = _groups(raw.cells, tags, _physical_names(text), groups_of)
    comments = own_comments(_section(text, "Comments").decode("utf-8", "replace").splitlines())
    raw = _label_cells(raw._replace(groups=groups), comments)
    return raw if comments is None else of_ours(raw, comments)


def _raw(numbers: Ints, points: Floats, blocks: list[_Elements]) -> Raw:
    """Return the nodes, with their numbers, and the elements by type, ascending by number."""
    cells = {}
    tags: dict[str, Arrays] = {"gmsh:physical": {}, "gmsh:geometrical": {}}
    for kind in dict.fromkeys(block.kind for block in blocks):
        those = [block for block in blocks if block.kind == kind]
        order = np.argsort(np.concatenate([block.numbers for block in those]), kind="stable")
        cells[kind] = places_of(numbers, np.concatenate([block.nodes for block in those])[order])
        if (cells[kind] < 0).any():
            raise InputError("damaged: its elements use nodes that it does not have")
        if kind == "tetra10":
            cells[kind] = cells[kind][:, TET10_ORDER]
        for name, by_kind in tags.items():
            values = [getattr(block, name.removeprefix("gmsh:")) for block in those]
            by_kind[kind] = np.concatenate(values)[order]
    return Raw(points, cells, tags, {}, {}, [], "ras")


def _with_views(
    raw: Raw, text: bytes, order: str | None, nodes: Ints, blocks: list[_Elements]
) -> Raw:
    """Return the contents with the values of views, at the numbers of their nodes and elements;
    others have NaN.
    """
    cell_data, point_data = dict(raw.cell_data), dict(raw.point_data)
    numbers = {
        kind: np.sort(np.concatenate([block.numbers for block in blocks if block.kind == kind]))
        for kind in raw.cells
    }
    for name, listed, values in _views(text, "ElementData", order):
        at = {kind: _at_numbers(those, listed, values) for kind, those in numbers.items()}
        by_kind = {kind: rows for kind, rows in at.items() if rows is not None}
        cell_data[free_text(name, cell_data)] = by_kind
    for name, listed, values in _views(text, "NodeData", order):
        if (rows := _at_numbers(nodes, listed, values)) is not None:
            point_data[free_text(name, point_data)] = rows
    lost = b"\n$ElementNodeData" in text
    words = "dropped data of the nodes of elements ($ElementNodeData)"
    return raw._replace(cell_data=cell_data, point_data=point_data, notes=(words,) * lost)


def places_of(numbers: Ints, those: Ints) -> Ints:
    """Return the place of each of those numbers among distinct ones, -1 if it is not there."""
    order = np.argsort(numbers, kind="stable")
    place = order[np.searchsorted(numbers, those, sorter=order).clip(max=len(numbers) - 1)]
    return np.where(numbers[place] == those, place, -1)


def _at_numbers(numbers: Ints, listed: Ints, values: Floats) -> Floats | None:
    """Return the values at all numbers, NaN for those that are not listed; None if none is."""
    place = places_of(listed, numbers) if len(listed) else np.full(len(numbers), -1)
    if (place < 0).all():
        return None
    rows = values[place]
    rows[place < 0] = np.nan
    return rows


def _views(text: bytes, section: str, order: str | None) -> Iterator[tuple[str, Ints, Floats]]:
    """Yield the name of each view, the numbers of its nodes or elements, (K,), and their values,
    (K,) or (K, c).
    """
    for body in _sections(text, section):
        rest = body + b"\n"
        heads = []
        for _ in range(3):  # texts, floats and integers
            count, _, rest = rest.partition(b"\n")
            *lines, rest = rest.split(b"\n", int(count))
            heads.append(lines)
        name = heads[0][0].decode("utf-8", "replace").strip().strip('"') if heads[0] else section
        n_columns, n_rows = int(heads[2][1]), int(heads[2][2])
        numbers, values = _Numbers(rest, order).rows(n_rows, 1, n_columns)
        yield name, numbers[:, 0], values[:, 0] if n_columns == 1 else values


def _nodes_2(section: bytes, order: str | None) -> tuple[Ints, Floats]:
    """Return the numbers (N,) and points (N, 3) of nodes in 2.2."""
    count, _, rest = section.partition(b"\n")
    numbers, points = _Numbers(rest, order).rows(int(count), 1, 3)
    return numbers[:, 0], points


def _nodes_4(take: _Numbers) -> tuple[Ints, Floats]:
    """Return the numbers (N,) and points (N, 3) of nodes in 4.1."""
    numbers = []
    points = []
    for _ in range(take.ints(4, 8)[0]):
        dim, _, is_parametric = take.ints(3)
        count = take.ints(1, 8)[0]
        numbers.append(take.rows(count, 1, size=8)[0][:, 0])
        points.append(take.rows(count, 0, 3 + dim * is_parametric)[1][:, :3])
    return np.concatenate(numbers), np.concatenate(points)


def _elements_2(section: bytes, order: str | None) -> Iterator[_Elements]:
    """Yield the elements in 2.2, one run of a type after the other."""
    count, _, rest = section.partition(b"\n")
    values = _Numbers(rest, order).rest()
    left = int(count)
    at = 0
    while left > 0:
        # text: number, type, tags; binary: type, elements that follow, tags, then their numbers
        first, second, n_tags = values[at : at + 3].tolist()
        kind, n_nodes = _kind(first if order else second)
        width = n_tags + n_nodes
        if order is None:
            rows = _alike_rows(values[at:], 3 + width, slice(1, 3))
            at += rows.size
            rows = np.delete(rows, [1, 2], axis=1)
        elif second == 1:
            rows = _alike_rows(values[at:], 4 + width, slice(0, 3))
            at += rows.size
            rows = rows[:, 3:]
        else:
            at += 3
            rows = values[at : at + second * (1 + width)].reshape(second, 1 + width)
            at += rows.size
        rows = rows[:left]
        left -= len(rows)
        tags = np.column_stack([rows[:, 1 : 1 + n_tags], np.zeros((len(rows), 2), np.int64)])
        yield _Elements(kind, rows[:, 0], tags[:, 0], tags[:, 1], rows[:, 1 + n_tags :])


def _alike_rows(values: Ints, width: int, columns: slice) -> Ints:
    """Return the first rows of a width, as many as have the first one's numbers in some columns."""
    count = FEWEST_ROWS
    while True:
        rows = values[: min(count, len(values) // width) * width].reshape(-1, width)
        is_alike = (rows[:, columns] == rows[0, columns]).all(axis=1)
        if not is_alike.all():
            return rows[: int(is_alike.argmin())]
        if len(rows) < count:
            return rows
        count *= 2


def _elements_4(take: _Numbers, groups_of: dict[tuple[int, int], list[int]]) -> Iterator[_Elements]:
    """Yield the elements in 4.1, by entity; their group is the entity's first one, 0 for none."""
    for _ in range(take.ints(4, 8)[0]):
        dim, tag, number = take.ints(3)
        kind, n_nodes = _kind(number)
        rows = take.rows(take.ints(1, 8)[0], 1 + n_nodes, size=8)[0]
        group = abs((groups_of.get((dim, tag)) or [0])[0])
        groups, entities = np.full((2, len(rows)), [[group], [tag]])
        yield _Elements(kind, rows[:, 0], groups, entities, rows[:, 1:])


def _kind(number: int) -> tuple[str, int]:
    """Return the name and the number of nodes of gmsh's type of elements."""
    if number not in ELEMENT_KINDS:
        raise InputError(
            "expected tetrahedra or triangles, of order 1 or 2, found elements of gmsh's type "
            f"{number}"
        )
    return ELEMENT_KINDS[number]


def _label_cells(raw: Raw, comments: OwnComments | None) -> Raw:
    """Use the numbers and names of groups as labels of cells, if each cell is in one group.

    Not done if there are other labels already, or if the groups of a file of tetopt's are not
    labels.
    """
    kind = main_kind(raw)
    groups = [group for group in raw.groups if group.kind == kind]
    are_materials = any(re.fullmatch(r"material_\d+|unnamed", group.label) for group in groups)
    is_other = are_materials if comments is None else comments.zero is None
    labels, n_groups = np.zeros((2, len(raw.cells[kind])), dtype=np.int64)
    for group in groups:
        labels[group.members] = group.number
        n_groups[group.members] += 1
    if (n_groups > 1).any():  # the first of several groups is no label
        raw = raw._replace(
            cell_data={k: each for k, each in raw.cell_data.items() if k != "gmsh:physical"}
        )
    if is_other or not (n_groups == 1).all():
        return raw
    zero = None if comments is None else comments.zero
    of_group = {} if comments is None else comments.labels
    labels = np.array([of_group.get(number, number) for number in labels.tolist()], dtype=np.int64)
    labels[labels == zero] = 0
    if LABEL_FIELD in raw.cell_data and not np.array_equal(
        raw.cell_data[LABEL_FIELD][kind], labels
    ):
        return raw
    names = {}
    for group in groups:
        label = of_group.get(group.number, group.number)
        if group.label not in (f"label_{label}", "label_0"):
            names[0 if label == zero else label] = group.label
    words = json.dumps(table_words(LabelTable(names, {})))
    table = {TABLE_TEXT: np.array([words])} if names else {}
    cell_data = raw.cell_data | {LABEL_FIELD: {kind: labels}}
    return raw._replace(cell_data=cell_data, field_data=raw.field_data | table)


def of_ours(raw: Raw, comments: OwnComments) -> Raw:
    """Apply the comments of a file of tetopt's: groups and views become cell sets and materials."""
    kind = main_kind(raw)
    members = _members(raw, kind, comments.cells)
    constants = np.full((3, len(raw.cells[kind])), np.nan)
    for name in comments.constants.keys() & members.keys():
        constants[:, members[name]] = np.array(comments.constants[name])[:, None]
    painted = {
        name: {kind: values}
        for name, values in zip(("young", "nu", "density"), constants, strict=True)
        if np.isfinite(values).all()
    }
    sets = [Group(name, kind, of_set) for name, of_set in members.items()]
    # in 2.2 a facet is in only one group
    for side in raw.cells.keys() - {kind}:
        sets += [
            Group(name, side, of_set)
            for name, of_set in _members(raw, side, comments.facets).items()
        ]
    labels_of_sets = {each.label for each in sets}
    dropped = ("gmsh:physical", "gmsh:geometrical")
    return raw._replace(
        cell_data={
            name: values
            for name, values in (painted | raw.cell_data).items()
            if name not in dropped
        },
        field_data=raw.field_data
        | {name: np.array([text]) for name, text in comments.texts.items()},
        groups=[
            group
            for group in raw.groups
            if group.kind != kind and group.label not in labels_of_sets
        ]
        + sets,
        space=comments.space,
    )


def _members(raw: Raw, kind: str, entities_of: dict[str, list[int]]) -> dict[str, Ints]:
    """Return the elements of a type in each set, ascending, given the entities of the set.

    When gmsh saves a file again, it keeps tetopt's comments and entities, but not all of their
    elements.
    """
    entity = _by_value(raw.cell_data["gmsh:geometrical"][kind])
    blocks_of = {
        name: [entity[each] for each in numbers if each in entity]
        for name, numbers in entities_of.items()
    }
    return {name: np.sort(np.concatenate(parts)) for name, parts in blocks_of.items() if parts}


def _groups(
    cells: dict[str, Ints],
    tags: Arrays,
    names: dict[tuple[int, int], str],
    groups_of: dict[tuple[int, int], list[int]] | None,
) -> list[Group]:
    """Return physical groups with members, named or unnamed."""
    groups = []
    for kind, dim in CELL_DIMENSIONS.items():
        if dim not in DEFAULT_LABELS or len(tags.get(kind, ())) != len(cells.get(kind, ())):
            continue
        parts: dict[int, list[Ints]] = {}
        for value, members in _by_value(tags.get(kind, np.empty(0))).items():
            for group in [value] if groups_of is None else groups_of.get((dim, value), []):
                parts.setdefault(abs(group), []).append(members)  # the sign is an orientation
        parts.pop(0, None)  # 0 means no group
        for tag, blocks in sorted(parts.items()):
            label = names.get((dim, tag)) or f"{DEFAULT_LABELS[dim]}_{tag}"
            groups.append(Group(label, kind, np.sort(np.concatenate(blocks)), tag))
    return groups


def _by_value(tags: NDArray) -> dict[int, Ints]:
    """Return the positions of each value, ascending."""
    order = np.argsort(tags, kind="stable")
    values, starts = np.unique(tags[order], return_index=True)
    # split returns one part for no values
    return dict(zip(values.tolist(), np.split(order, starts[1:]), strict=False))


def _section(text: bytes, name: str) -> bytes:
    """Return the first section of a name; empty if there is none."""
    return next(_sections(text, name), b"")


def _sections(text: bytes, name: str) -> Iterator[bytes]:
    """Yield the text between each pair of lines $NAME and $EndNAME; names of groups may contain
    such words.
    """
    head = f"\n${name}".encode()
    text = b"\n" + text if text.startswith(head[1:]) else text
    start = text.find(head)
    while start >= 0:
        before = text.index(b"\n", start + 1)
        end = text.find(f"\n$End{name}".encode(), before)
        if end < 0:
            raise InputError(f"damaged: ${name} does not end")
        yield text[before + 1 : end]
        start = text.find(head, max(end, before))


def _physical_names(text: bytes) -> dict[tuple[int, int], str]:
    """Return the names of physical groups by dimension and number; several may have the same
    name.
    """
    lines = _section(text, "PhysicalNames").decode("utf-8", "replace").splitlines()
    matches = [re.fullmatch(r'\s*(\d+)\s+(-?\d+)\s+"?(.*?)"?\s*', line) for line in lines]
    return {(int(line[1]), abs(int(line[2]))): line[3] for line in matches if line is not None}


def _groups_of_entities(take: _Numbers) -> dict[tuple[int, int], list[int]]:
    """Return the physical groups of each entity in 4.1, by dimension and number."""
    groups_of = {}
    for dim, count in enumerate(take.ints(4, 8)):
        for _ in range(count):
            (tag,) = take.ints(1)
            take.rows(1, 0, 3 if dim == 0 else 6)  # a point, or a box
            groups_of[dim, tag] = take.ints(take.ints(1, 8)[0])
            if dim > 0:
                take.ints(take.ints(1, 8)[0])  # the bounding entities
    return groups_of
