"""Shared code of mesh formats that have numbers for materials and sets, and comments for other
data.

`number_parts` gives each cell and each facet of a set one number. If cells have labels, the
number of a cell is its label; label 0, which formats treat as none, gets the number after the
largest label. If a label exceeds `LARGEST_GROUP`, labels are numbered from 1, and comments list the
label of each number. Otherwise it is the number of the cell's material, or without materials that
of its cell set. If sets or materials divide such a group, each of its parts has its own number,
after all others. The numbers of facets differ from those of cells. For a given R, those of the
box's faces, "mask_surface" and "boundary", up to 2 R - 1, are the same for every mesh; interfaces
and other sets are numbered from R + 1 in order, so that their numbers depend on the sets of the
mesh. R is 1000, or a power of ten above all labels. Parts are numbered from 2 R + 1.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container
from itertools import count
from typing import NamedTuple

import numpy as np

from tetopt.errors import InputError
from tetopt.geometry.topology import facets
from tetopt.io.text import comment_lines, free_text
from tetopt.mesh import Mesh
from tetopt.model.label_names import LABEL_FIELD
from tetopt.model.loads import load_words
from tetopt.model.model import Model, header_lines
from tetopt.model.sets import (
    BOUNDARY_SET,
    FACE_NAMES,
    MASK_SURFACE_SET,
    MOST_LETTERS,
    Names,
    free_name,
    label_set_names,
)
from tetopt.system.arrays import Arrays, Ints, Shape

UNNAMED_GROUP = "unnamed"  # the group of cells in no other group
LEAST_ROOM = 1000  # numbers reserved for labels
# largest label used as a number: twice the next power of ten still fits into 32 bits
LARGEST_GROUP = 10**8 - 1


class Tagged(NamedTuple):
    """Overlapping sets as one tag per item, for formats that allow only one: the tag identifies
    all sets of an item.
    """

    items: Ints  # (T,) or (T, 2): all cells or facets in sets, ascending
    tags: Ints  # (T,) from 1
    tags_of: dict[str, list[int]]  # the tags of each set


class Part(NamedTuple):
    """The elements of one dimension. Entities and groups are gmsh's terms; other formats have
    only entities.
    """

    dim: int
    numbers: Ints  # (E,) from 1
    rows: Ints  # (E,) cells, or (E, 2) facets
    entities: Ints  # (E,) the number of each element's entity
    # by entity, ascending: the numbers of its physical groups, the smallest set first
    groups_of: dict[int, list[int]]
    names: Names  # of the groups, by number
    sets: dict[str, list[int]]  # the entities of each set


def tag_sets(sets: dict[str, Ints]) -> Tagged:
    """Return one tag for each combination of sets that occurs, from 1 in the order of first
    occurrence.

    Examples
    --------
    >>> tagged_items = tag_sets({"a": np.array([4, 7]), "b": np.array([7, 9])})
    >>> tagged_items.items.tolist(), tagged_items.tags.tolist(), tagged_items.tags_of
    ([4, 7, 9], [1, 2, 3], {'a': [1, 2], 'b': [2, 3]})
    """
    if not sets:
        return Tagged(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), {})
    items, which = np.unique(np.concatenate(list(sets.values())), axis=0, return_inverse=True)
    of_set = np.repeat(np.arange(len(sets)), [len(members) for members in sets.values()])
    is_in = np.zeros((len(items), len(sets)), dtype=bool)
    is_in[which.ravel(), of_set] = True
    kinds, first, kind = np.unique(is_in, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(kinds), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(1, len(kinds) + 1)
    tags_of = {name: np.sort(rank[kinds[:, k]]).tolist() for k, name in enumerate(sets)}
    return Tagged(items, rank[kind.ravel()], tags_of)


def cell_tags(model: Model, labels: Ints | None) -> Tagged:
    """Return all cells, with one tag for each combination of label, material ("material_1", ...)
    and cell sets.

    Without `labels` (M,), tags follow materials: they are the materials' numbers from 1 if no set
    divides one.

    Raises
    ------
    InputError
        A cell set has the name of a material.
    """
    names = material_names(model, model.sets.cells)
    combined = tag_sets(model.sets.cells)
    combination = np.zeros(len(model.mesh.cells), dtype=np.int64)
    combination[combined.items] = combined.tags
    material = np.zeros_like(combination) if model.materials is None else model.materials.of_cell
    columns = [np.zeros_like(combination) if labels is None else labels, material, combination]
    kinds, which = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
    ends = np.cumsum(np.bincount(kinds[:, 1], minlength=len(names)))[:-1]
    of_material = np.split(np.argsort(kinds[:, 1], kind="stable") + 1, ends)
    # one part without names
    tags_of = {name: tags.tolist() for name, tags in zip(names, of_material, strict=False)}
    for name, tags in combined.tags_of.items():
        tags_of[name] = (np.flatnonzero(np.isin(kinds[:, 2], tags)) + 1).tolist()
    return Tagged(np.arange(len(material)), which.ravel() + 1, tags_of)


def facet_tags(mesh: Mesh, sets: dict[str, Ints]) -> Tagged:
    """Return `tag_sets` for facet sets; a facet that sets hold from both of its sides is one item.

    It is listed as in the first set that contains it; items are in the order of the facets' nodes.
    """
    of_cell = facets(mesh.cells).of_cell
    numbers = {name: of_cell[rows[:, 0], rows[:, 1]] for name, rows in sets.items()}
    combined = tag_sets(numbers)
    if not sets:
        return combined._replace(items=np.empty((0, 2), dtype=np.int64))
    _, first = np.unique(np.concatenate(list(numbers.values())), return_index=True)
    return combined._replace(items=np.concatenate(list(sets.values()))[first])


def group_of_zero(labels: Ints) -> int:
    """Return the number of label 0, the first after all labels, because 0 means none in the
    formats.
    """
    return int(labels.max()) + 1


def group_labels(model: Model) -> Ints | None:
    """Return the numbers of the cells' labels (M,), if any: the labels, unless there are
    `renumbered_labels`.
    """
    labels = model.labels
    if labels is None or not (renumbered := renumbered_labels(model)):
        return labels
    return np.searchsorted([0, *renumbered.values()], labels)


def renumbered_labels(model: Model) -> dict[int, int]:
    """Return the label of each number from 1, if a label exceeds `LARGEST_GROUP`; else none."""
    labels = model.labels
    if labels is None or labels.max() <= LARGEST_GROUP:
        return {}
    return dict(enumerate(np.unique(labels[labels > 0]).tolist(), 1))


def without_labels(model: Model) -> Model:
    """Return the model without labels if numbers represent them."""
    of_cells = model.cell_data.items()
    return (
        model
        if group_labels(model) is None
        else model._replace(cell_data={k: v for k, v in of_cells if k != LABEL_FIELD})
    )


def number_parts(model: Model) -> tuple[Part, Part]:
    """Return the cells, and the facets in sets; the module describes their numbers.

    Raises
    ------
    InputError
        A set has the name of a material, a label or the group of other cells.
    """
    labels = group_labels(model)
    n_facets = len(model.sets.facets)
    names, group = _cell_groups(model, labels)
    room = LEAST_ROOM
    while room <= max(names, default=0) or room <= n_facets + 2 * model.mesh.ndim + 2:
        room *= 10
    of_cells = cell_tags(model, labels)
    _, first = np.unique(of_cells.tags, return_index=True)
    cells = _part(
        model.mesh.ndim, of_cells, [[each] for each in group[first].tolist()], names, 1, 2 * room
    )
    return cells, _facets(model, room)


def _part(
    dim: int,
    of_items: Tagged,
    groups_of: list[list[int]],
    names: Names,
    first: int,
    room: int,
) -> Part:
    """Return the elements, numbered from `first`, with one entity for each tag.

    An entity has the number of its first group; if the group has several entities, they are
    numbered after `room`.
    """
    counts = Counter(groups[0] for groups in groups_of)
    free = count(room + 1)
    number = np.array(
        [groups[0] if counts[groups[0]] == 1 else next(free) for groups in groups_of],
        dtype=np.int64,
    )
    sets = {
        name: number[np.array(tags, dtype=np.int64) - 1].tolist()
        for name, tags in of_items.tags_of.items()
    }
    numbers = first + np.arange(len(of_items.items))
    by_number = dict(sorted(zip(number.tolist(), groups_of, strict=True)))
    return Part(dim, numbers, of_items.items, number[of_items.tags - 1], by_number, names, sets)


def _cell_groups(model: Model, labels: Ints | None) -> tuple[dict[int, str], Ints]:
    """Return the names of the cells' groups by number, ascending, and the number of each cell's
    group.
    """
    if labels is not None:
        kinds = np.unique(labels).tolist()
        own = [renumbered_labels(model).get(kind, kind) for kind in kinds]
        of_label = label_set_names(own, model.label_names)
        called = {kind: of_label[label] for kind, label in zip(kinds, own, strict=True)}
        zero = group_of_zero(labels)
        others = {
            name: members
            for name, members in model.sets.cells.items()
            if not any(
                name == called[kind] and np.array_equal(members, np.flatnonzero(labels == kind))
                for kind in kinds
            )
        }
        check_apart(list(called.values()), {**model.sets.facets, **others})
        return dict(sorted((kind or zero, called[kind]) for kind in kinds)), np.where(
            labels == 0, zero, labels
        )
    if model.materials is None:
        listed, group = _disjoint_sets(model)
    else:
        listed = material_names(model, model.sets.facets)
        group = model.materials.of_cell + 1
    return dict(enumerate(listed, 1)), group


def _disjoint_sets(model: Model) -> tuple[list[str], Ints]:
    """Return cell sets that do not overlap previous ones, and the number, from 1, of each cell's
    set or "unnamed".
    """
    names: list[str] = []
    number = np.zeros(len(model.mesh.cells), dtype=np.int64)
    for name, members in model.sets.cells.items():
        if name not in model.sets.facets and not number[members].any():
            names.append(name)
            number[members] = len(names)
    if (number == 0).any():
        check_apart([UNNAMED_GROUP], {**model.sets.facets, **model.sets.cells})
        names.append(UNNAMED_GROUP)
        number[number == 0] = len(names)
    return names, number


def _facets(model: Model, room: int) -> Part:
    """Return all facets in sets; facets in the same sets form an entity."""
    sets = model.sets.facets
    last = [
        *(name for pair in FACE_NAMES[model.mesh.ndim] for name in pair),
        MASK_SURFACE_SET,
        BOUNDARY_SET,
    ]
    of_box = dict(zip(last, count(2 * room - len(last)), strict=False))
    free = count(room + 1)
    number = {name: of_box[name] if name in of_box else next(free) for name in sets}
    of_facets = facet_tags(model.mesh, sets)
    groups_of: list[list[int]] = [[] for _ in range(of_facets.tags.max(initial=0))]
    for name in sorted(sets, key=lambda name: (len(sets[name]), number[name])):
        for tag in of_facets.tags_of[name]:
            groups_of[tag - 1].append(number[name])
    names = {number[name]: name for name in sorted(sets, key=number.__getitem__)}
    return _part(
        model.mesh.ndim - 1, of_facets, groups_of, names, len(model.mesh.cells) + 1, 2 * room
    )


def material_names(model: Model, taken: dict[str, Ints]) -> list[str]:
    """Return names "material_1", ... of the model's materials; InputError if a set in `taken`
    has such a name.
    """
    count = 0 if model.materials is None else len(model.materials.young)
    names = [f"material_{k}" for k in range(1, count + 1)]
    check_apart(names, taken)
    return names


def named_materials(model: Model) -> list[str]:
    """Return names of the model's materials by labels: "liver", or "label_5" for a label without a
    name.

    A material of several whole labels gets their joined names; materials that divide a label get
    its name and a number. The others, which are parts of several labels, are "material_1", ...
    """
    names = material_names(model, {})
    labels = model.labels
    if model.materials is None or labels is None:
        return names
    called = label_set_names(np.unique(labels).tolist(), model.label_names)
    labels_in: dict[int, list[int]] = {}
    for material, label in np.unique(
        np.column_stack([model.materials.of_cell, labels]), axis=0
    ).tolist():
        labels_in.setdefault(material, []).append(label)
    n_materials = Counter(label for those in labels_in.values() for label in those)
    own = {called[label]: np.flatnonzero(labels == label) for label in called}
    number_in = {name: count(1) for name in own}
    taken = {name.lower() for name in (*model.sets.facets, *model.sets.cells, *called.values())}
    for material, those in labels_in.items():
        name = "_".join(called[label] for label in those)
        is_whole = all(n_materials[label] == 1 for label in those)
        if len(name) > MOST_LETTERS or not (is_whole or len(those) == 1):
            continue
        is_set = is_whole and len(those) == 1 and name not in model.sets.facets
        if not is_set or not np.array_equal(model.sets.cells.get(name, own[name]), own[name]):
            name = free_name(name if is_whole else f"{name}_{next(number_in[name])}", taken)
        names[material] = name
        taken.add(name.lower())
    return names


def check_apart(names: list[str], taken: dict[str, Ints]) -> None:
    """Raise InputError if a set has a name that the file uses for something else."""
    lower = {name.lower() for name in names}
    if both := [name for name in taken if name.lower() in lower]:
        raise InputError(
            f'set {both[0]}: the file uses the name "{both[0]}" for something else; rename the set'
        )


def remarks(model: Model) -> list[str]:
    """Return lines for the header of a mesh file: `header_lines`, each material's constants, the
    loads.
    """
    lines = header_lines(model)
    if model.materials is not None:
        young = model.materials.young
        nu = model.materials.nu
        density = model.materials.density
        masses = [""] * len(young)
        if density is not None:
            masses = [f", density {each!r} kg/m3" for each in density.tolist()]
        rows = zip(young.tolist(), nu.tolist(), masses, strict=True)
        lines += [
            f"material_{k}: young {each!r} {model.units}, nu {ratio!r}{mass}"
            for k, (each, ratio, mass) in enumerate(rows, 1)
        ]
    lines += [f"load (not supported by this format): {load_words(load)}" for load in model.loads]
    return lines


def without_data(model: Model) -> list[str]:
    """Return lines for the header of a file whose format does not support cell data and point
    data.
    """
    left_out = {"cell data": model.cell_data, "point data": model.point_data}
    return [
        f"{what} (not supported by this format): {', '.join(data)}"
        for what, data in left_out.items()
        if data
    ]


def as_columns(fields: Arrays, shapes: Container[Shape]) -> Arrays:
    """Split cell or point data into scalars by name: columns are numbered NAME_0, NAME_1, ...

    Rows with one of the `shapes` are kept whole. A column with the name of another field is
    renamed.
    """
    whole = {
        name for name, values in fields.items() if values.ndim == 1 or values.shape[1:] in shapes
    }
    columns: Arrays = {}
    for name, values in fields.items():
        if name in whole:
            columns[name] = values
            continue
        for k, column in enumerate(values.reshape(len(values), -1).T):
            columns[free_text(f"{name}_{k}", {*whole, *columns})] = column
    return columns


def all_sets(part: Part) -> dict[str, list[int]]:
    """Return the entities of each set, and of each label that is not a set, by name."""
    groups = {
        name: number
        for number, name in part.names.items()
        if name not in part.sets and name != UNNAMED_GROUP
    }
    return part.sets | {
        name: [each for each, those in part.groups_of.items() if number in those]
        for name, number in groups.items()
    }


def label_lines(model: Model, cells: Part, what: str) -> list[str]:
    """Describe how the numbers of cells, called `what` ("attribute"), represent labels, for the
    header and the run.
    """
    labels = group_labels(model)
    if labels is None:
        return []
    divided = sorted({group for number, (group,) in cells.groups_of.items() if number != group})
    renumbered = renumbered_labels(model)
    zero = group_of_zero(labels)
    lines = [f"the {what} of a cell is its label"]
    if renumbered:
        lines[0] = (
            f"the {what} of a cell numbers its label from 1, as labels above {LARGEST_GROUP} do "
            "not fit"
        )
        lines += [f"{what} {number} is label {label}" for number, label in renumbered.items()]
    if zero in cells.names and zero not in divided:
        lines.append(f"label 0 is {what} {zero}, because 0 means none")
    if divided:
        first = min(cells.groups_of.keys() - cells.names)
        names = ", ".join(cells.names[group] for group in divided)
        lines[0] += (
            f", unless a set or material divides it: then each part has a number from {first} on "
            f"({names})"
        )
    return lines


def part_comments(
    model: Model, cells: Part, sides: Part, label_word: str, cell_word: str, side_word: str
) -> str:
    """Return the comments of a file that has one number for each cell and each facet, and no
    other data; the words are the format's for a cell's label, and for these numbers.
    """
    lines = [
        *remarks(model),
        *without_data(without_labels(model)),
        *label_lines(model, cells, label_word),
        *tag_lines(all_sets(cells), cell_word),
        *tag_lines(sides.sets, side_word),
    ]
    return comment_lines(lines, "# ")


def tag_lines(tags_of: dict[str, list[int]], what: str) -> list[str]:
    """Return one line for each tag, with its sets."""
    names: dict[int, list[str]] = {}
    for name, tags in tags_of.items():
        for tag in tags:
            names.setdefault(tag, []).append(name)
    return [f"{what} {tag}: {' '.join(names[tag])}" for tag in sorted(names)]
