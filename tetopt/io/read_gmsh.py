"""Reading of gmsh files through meshio, which loses some groups; these are looked up here."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.interop.conversions import CELL_DIMENSIONS
from tetopt.io.apart import read_apart
from tetopt.io.gmsh import OwnComments, own_comments
from tetopt.io.raw import Group, Raw, by_corners
from tetopt.model.label_names import LABEL_FIELD, TABLE_TEXT, LabelTable, table_words
from tetopt.system.arrays import Arrays, Ints, Json
from tetopt.system.budget import check_memory, memory_words

if TYPE_CHECKING:
    import meshio

BYTES_A_LETTER = 4  # of memory per byte of a gmsh file: its text twice, and its numbers
# Names of unnamed groups, by dimension; their number is appended.
DEFAULT_LABELS = {1: "edge", 2: "surface", 3: "volume"}


def read_msh(path: Path) -> Raw:
    """Read a gmsh file through meshio, in a child with limits, as it allocates the sizes in a
    header.

    All its errors become InputErrors, without a leading path.
    """
    size = path.stat().st_size
    check_memory(BYTES_A_LETTER * size, f"{memory_words(size)} of a gmsh mesh", "save it as .vtu")
    fields = read_apart(_fields_of, path, library="meshio")
    groups = [Group(*group) for group in fields.pop("groups")]
    return Raw(**fields, groups=groups)


def _fields_of(path: str) -> Json:
    """Return the fields of a `Raw`."""
    import meshio

    try:
        file = meshio.gmsh.read(path)
        raw = _msh(file, Path(path).read_bytes())
    except (Exception, SystemExit) as error:  # meshio and damaged sections can raise any error
        raise InputError(f"cannot be read as a gmsh mesh ({type(error).__name__})") from error
    return raw._asdict()


def _msh(file: meshio.Mesh, text: bytes) -> Raw:
    """Convert a file as read by meshio, and add groups that meshio loses."""
    kinds = list(dict.fromkeys(block.type for block in file.cells))
    of_kind = {
        kind: [k for k, block in enumerate(file.cells) if block.type == kind] for kind in kinds
    }
    cells = {
        kind: np.concatenate([file.cells[k].data for k in blocks]).astype(np.int64)
        for kind, blocks in of_kind.items()
    }
    cell_data = {
        name: {
            kind: np.concatenate([values[k] for k in blocks]) for kind, blocks in of_kind.items()
        }
        for name, values in file.cell_data.items()
    }
    points = np.zeros((len(file.points), 3))
    points[:, : file.points.shape[1]] = file.points
    point_data = {
        name: values for name, values in file.point_data.items() if not name.startswith("gmsh:")
    }
    raw = by_corners(Raw(points, cells, cell_data, point_data, {}, [], "ras"))
    groups = _groups(raw.cells, raw.cell_data, _physical_names(text), _groups_of_entities(text))
    comments = own_comments(_section(text, "Comments").decode("utf-8", "replace").splitlines())
    raw = _label_cells(raw._replace(groups=groups), comments)
    return raw if comments is None else _of_ours(raw, comments)


def _label_cells(raw: Raw, comments: OwnComments | None) -> Raw:
    """Use the numbers and names of groups as labels of cells, if each cell is in one group.

    Not done if there are other labels already, or if the groups of a file of tetopt's are not
    labels.
    """
    kind = _kind_of_cells(raw)
    groups = [group for group in raw.groups if group.kind == kind]
    are_materials = any(re.fullmatch(r"material_\d+|unnamed", group.label) for group in groups)
    is_other = are_materials if comments is None else comments.zero is None
    labels, n_groups = np.zeros((2, len(raw.cells[kind])), dtype=np.int64)
    for group in groups:
        labels[group.members] = group.number
        n_groups[group.members] += 1
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


def _kind_of_cells(raw: Raw) -> str:
    """Return the cell type of highest dimension."""
    return max(raw.cells, key=lambda name: CELL_DIMENSIONS.get(name, -1))


def _of_ours(raw: Raw, comments: OwnComments) -> Raw:
    """Apply the comments of a file of tetopt's: groups and views become cell sets and materials."""
    kind = _kind_of_cells(raw)
    members = _members(raw, kind, comments.cells)
    constants = np.full((2, len(raw.cells[kind])), np.nan)
    for name in comments.constants.keys() & members.keys():
        constants[:, members[name]] = np.array(comments.constants[name])[:, None]
    is_painted = bool(comments.constants) and np.isfinite(constants).all()
    painted = {"young": {kind: constants[0]}, "nu": {kind: constants[1]}} if is_painted else {}
    sets = [Group(name, kind, of_set) for name, of_set in members.items()]
    # in 2.2 a facet is in only one group
    for side in {group.kind for group in raw.groups} - {kind}:
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
    cell_data: dict[str, Arrays],
    names: dict[tuple[int, int], str],
    groups_of: dict[tuple[int, int], list[int]] | None,
) -> list[Group]:
    """Return physical groups with members, named or unnamed."""
    tags = cell_data.get("gmsh:physical" if groups_of is None else "gmsh:geometrical", {})
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
    """Return the text between the first lines $NAME and $EndNAME; names of groups may contain
    such words.
    """
    head = f"${name}".encode()
    start = 0 if text.startswith(head) else text.find(b"\n" + head) + 1
    if not text.startswith(head, start):
        return b""
    before = text.index(b"\n", start)
    return text[before + 1 : text.find(f"\n$End{name}".encode(), before)]


def _physical_names(text: bytes) -> dict[tuple[int, int], str]:
    """Return the names of physical groups by dimension and number; several may have the same
    name.
    """
    lines = _section(text, "PhysicalNames").decode("utf-8", "replace").splitlines()
    matches = [re.fullmatch(r'\s*(\d+)\s+(-?\d+)\s+"?(.*?)"?\s*', line) for line in lines]
    return {(int(line[1]), abs(int(line[2]))): line[3] for line in matches if line is not None}


def _groups_of_entities(text: bytes) -> dict[tuple[int, int], list[int]] | None:
    """Return the physical groups of each entity, by dimension and number; None before version
    4.1.
    """
    version, is_binary, size = _section(text, "MeshFormat").split(maxsplit=3)[:3]
    if not version.startswith(b"4") or version == b"4.0":
        return None
    section = _section(text, "Entities")
    take = _numbers(section) if is_binary == b"1" else _words(section)
    n_bytes = f"<u{int(size)}"
    groups_of = {}
    for dim, count in enumerate(take(n_bytes, 4) if section else []):
        for _ in range(count):
            (tag,) = take("<i4", 1)
            take("<f8", 3 if dim == 0 else 6)  # a point, or a box
            groups_of[dim, tag] = take("<i4", take(n_bytes, 1)[0])
            if dim > 0:
                take("<i4", take(n_bytes, 1)[0])  # the bounding entities
    return groups_of


def _numbers(section: bytes) -> Callable[[str, int], list[int]]:
    """Return a function that reads the next numbers of a dtype."""
    at = 0

    def take(dtype: str, count: int) -> list[int]:
        nonlocal at
        values = np.frombuffer(section, dtype, count, at)
        at += values.nbytes
        return values.tolist()

    return take


def _words(section: bytes) -> Callable[[str, int], list[int]]:
    """Do the same as `_numbers` for text."""
    words = iter(section.split())
    return lambda dtype, count: [int(float(word)) for word in islice(words, count)]
