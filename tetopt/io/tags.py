"""What mesh formats share that know numbers for materials and sets, and comments for the rest.

`numbered_parts` gives each cell and each facet of a set one number. Where cells have labels, that of a cell is its
label; label 0, which formats take for none, has the number after the largest label. Otherwise it is that of its
material, or without materials that of its cell set. What sets, or materials, divide has a number for each of its parts,
behind all others. The numbers of facets differ from those of cells. For a given R, those of the box's faces,
"mask_surface" and "boundary", up to 2 R - 1, are the same for every mesh; interfaces and other sets count from R + 1 in
their order, so that their numbers depend on the sets that the mesh has. R is 1000, or the power of ten that is above
all labels. Parts have those from 2 R + 1 on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.topology import facets
from tetopt.io.text import free_text
from tetopt.mesh import Mesh
from tetopt.model.labels import TABLE_TEXT, labels_of, table_of_words
from tetopt.model.loads import load_words
from tetopt.model.model import Model, described
from tetopt.model.sets import BOUNDARY_SET, FACE_NAMES, MASK_SURFACE_SET, MOST_LETTERS, free_name, label_set_names

UNNAMED_GROUP = "unnamed"  # the group of cells that are in no other
LEAST_ROOM = 1000  # so many numbers are the labels' alone
LARGEST_GROUP = 10**8 - 1  # of labels: twice the power of ten behind it still fits into the format's 32 bits


class Tagged(NamedTuple):
    """Overlapping sets as tags, one an item, for formats that know no more: an item's tag tells all of its sets."""

    items: NDArray[np.int64]  # (T,) or (T, 2): every cell or facet that is in any set, ascending
    tags: NDArray[np.int64]  # (T,) from 1
    tags_of: dict[str, list[int]]  # the tags that make up each set


class Part(NamedTuple):
    """The elements of one dimension. Entities and groups of them are gmsh's; other formats have entities alone."""

    dim: int
    numbers: NDArray[np.int64]  # (E,) from 1
    rows: NDArray[np.int64]  # (E,) cells, or (E, 2) facets
    entities: NDArray[np.int64]  # (E,) the number of each one's entity
    groups_of: dict[int, list[int]]  # the numbers of each entity's physical groups, the smallest set first; ascending
    names: dict[int, str]  # of the groups by number
    sets: dict[str, list[int]]  # the entities that make up each set


def tagged(sets: dict[str, NDArray[np.int64]]) -> Tagged:
    """One tag for each combination of sets that some item is in, from 1 in the order of the first such items.

    Examples
    --------
    >>> tagged_items = tagged({"a": np.array([4, 7]), "b": np.array([7, 9])})
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


def cell_tags(model: Model, labels: NDArray[np.int64] | None = None) -> Tagged:
    """Every cell, with one tag for each combination of a label, a material ("material_1", ...) and cell sets.

    Without `labels` (M,) tags go by material: they are the materials' numbers from 1 where no set divides one.

    Raises
    ------
    InputError
        A cell set that is called as a material is.
    """
    names = material_names(model, model.sets.cells)
    combined = tagged(model.sets.cells)
    combination = np.zeros(len(model.mesh.cells), dtype=np.int64)
    combination[combined.items] = combined.tags
    material = np.zeros_like(combination) if model.materials is None else model.materials.of_cell
    columns = [np.zeros_like(combination) if labels is None else labels, material, combination]
    kinds, which = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
    ends = np.cumsum(np.bincount(kinds[:, 1], minlength=len(names)))[:-1]
    of_material = np.split(np.argsort(kinds[:, 1], kind="stable") + 1, ends)
    tags_of = {name: tags.tolist() for name, tags in zip(names, of_material, strict=False)}  # without names, one part
    for name, tags in combined.tags_of.items():
        tags_of[name] = (np.flatnonzero(np.isin(kinds[:, 2], tags)) + 1).tolist()
    return Tagged(np.arange(len(material)), which.ravel() + 1, tags_of)


def facet_tags(mesh: Mesh, sets: dict[str, NDArray[np.int64]]) -> Tagged:
    """`tagged` of facet sets, where a facet that sets hold from both of its sides is one item.

    It is held as by the first set that has it; items are in the order of the facets' nodes.
    """
    of_cell = facets(mesh.cells).of_cell
    numbers = {name: of_cell[rows[:, 0], rows[:, 1]] for name, rows in sets.items()}
    combined = tagged(numbers)
    if not sets:
        return combined._replace(items=np.empty((0, 2), dtype=np.int64))
    _, first = np.unique(np.concatenate(list(numbers.values())), return_index=True)
    return combined._replace(items=np.concatenate(list(sets.values()))[first])


def group_of_zero(labels: NDArray[np.int64]) -> int:
    """The number of label 0, since formats take 0 for none: the first behind all labels."""
    return int(labels.max()) + 1


def group_labels(model: Model) -> NDArray[np.int64] | None:
    """The cells' labels (M,), if they have any; InputError for one that is too large for a number of 32 bits."""
    labels = labels_of(model.cell_data, len(model.mesh.cells))
    if labels is not None and labels.max() > LARGEST_GROUP:
        raise InputError(f"expected labels up to {LARGEST_GROUP}, got {labels.max()}; renumber them from 1")
    return labels


def without_labels(model: Model) -> Model:
    """The model without the labels, where numbers tell them."""
    of_cells = model.cell_data.items()
    return (
        model if group_labels(model) is None else model._replace(cell_data={k: v for k, v in of_cells if k != "label"})
    )


def numbered_parts(model: Model) -> tuple[Part, Part]:
    """The cells, and the facets that are in sets; see the module for their numbers.

    Raises
    ------
    InputError
        A set that is called as a material, a label or the cells of no set are; a label beyond `LARGEST_GROUP`.
    """
    labels, n_facets = group_labels(model), len(model.sets.facets)
    names, group = _cell_groups(model, labels)
    room = LEAST_ROOM
    while room <= max(names, default=0) or room <= n_facets + 2 * model.mesh.ndim + 2:
        room *= 10
    of_cells = cell_tags(model, labels)
    _, first = np.unique(of_cells.tags, return_index=True)
    cells = _part(model.mesh.ndim, of_cells, [[each] for each in group[first].tolist()], names, 1, 2 * room)
    return cells, _facets(model, room)


def _part(dim: int, of_items: Tagged, groups_of: list[list[int]], names: dict[int, str], first: int, room: int) -> Part:
    """The elements, numbered from `first`, of each tag an entity.

    It has the number of its first group; where that is several, each has one from `room` on.
    """
    counts, free = Counter(groups[0] for groups in groups_of), count(room + 1)
    number = np.array([groups[0] if counts[groups[0]] == 1 else next(free) for groups in groups_of], dtype=np.int64)
    sets = {name: number[np.array(tags, dtype=np.int64) - 1].tolist() for name, tags in of_items.tags_of.items()}
    numbers = first + np.arange(len(of_items.items))
    by_number = dict(sorted(zip(number.tolist(), groups_of, strict=True)))
    return Part(dim, numbers, of_items.items, number[of_items.tags - 1], by_number, names, sets)


def _cell_groups(model: Model, labels: NDArray[np.int64] | None) -> tuple[dict[int, str], NDArray[np.int64]]:
    """The names of the cells' groups by number, ascending, and the number of each cell's."""
    if labels is not None:
        kinds = np.unique(labels).tolist()
        called = label_set_names(kinds, table_of_words(model.about.get(TABLE_TEXT)).names)
        zero = group_of_zero(labels)
        others = {
            name: members
            for name, members in model.sets.cells.items()
            if not any(
                name == called[kind] and np.array_equal(members, np.flatnonzero(labels == kind)) for kind in kinds
            )
        }
        check_apart(list(called.values()), {**model.sets.facets, **others})
        return dict(sorted((kind or zero, called[kind]) for kind in kinds)), np.where(labels == 0, zero, labels)
    if model.materials is None:
        listed, group = _disjoint_sets(model)
    else:
        listed, group = material_names(model, model.sets.facets), model.materials.of_cell + 1
    return dict(enumerate(listed, 1)), group


def _disjoint_sets(model: Model) -> tuple[list[str], NDArray[np.int64]]:
    """Cell sets that do not overlap those before, and the number from 1 of each cell's, or of "unnamed"."""
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
    """Every facet of a set; an entity is what is in the same sets."""
    sets = model.sets.facets
    last = [*(name for pair in FACE_NAMES[model.mesh.ndim] for name in pair), MASK_SURFACE_SET, BOUNDARY_SET]
    of_box = dict(zip(last, count(2 * room - len(last)), strict=False))
    free = count(room + 1)
    number = {name: of_box[name] if name in of_box else next(free) for name in sets}
    of_facets = facet_tags(model.mesh, sets)
    groups_of: list[list[int]] = [[] for _ in range(of_facets.tags.max(initial=0))]
    for name in sorted(sets, key=lambda name: (len(sets[name]), number[name])):
        for tag in of_facets.tags_of[name]:
            groups_of[tag - 1].append(number[name])
    names = {number[name]: name for name in sorted(sets, key=number.__getitem__)}
    return _part(model.mesh.ndim - 1, of_facets, groups_of, names, len(model.mesh.cells) + 1, 2 * room)


def material_names(model: Model, taken: dict[str, NDArray[np.int64]]) -> list[str]:
    """ "material_1", ... of the model's materials; InputError if a set among `taken` is called that."""
    names = [] if model.materials is None else [f"material_{k + 1}" for k in range(len(model.materials.young))]
    check_apart(names, taken)
    return names


def named_materials(model: Model) -> list[str]:
    """Names of the model's materials by their labels: "liver", or "label_5" of one without a name.

    A material of several whole labels has their names joined, and those that divide a label have its name and a number.
    What remains, as of materials that are parts of several labels, is "material_1", ...
    """
    names = material_names(model, {})
    labels = labels_of(model.cell_data, len(model.mesh.cells))
    if model.materials is None or labels is None:
        return names
    called = label_set_names(np.unique(labels).tolist(), table_of_words(model.about.get(TABLE_TEXT)).names)
    labels_in: dict[int, list[int]] = {}
    for material, label in np.unique(np.column_stack([model.materials.of_cell, labels]), axis=0).tolist():
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


def check_apart(names: list[str], taken: dict[str, NDArray[np.int64]]) -> None:
    """InputError if a set is called as something else in the file is."""
    lower = {name.lower() for name in names}
    if both := [name for name in taken if name.lower() in lower]:
        raise InputError(f'set {both[0]}: the file calls something else "{both[0]}"; call the set otherwise')


def remarks(model: Model) -> list[str]:
    """Lines for the head of a mesh file: `described`, each material's constants, the loads."""
    lines = described(model)
    if model.materials is not None:
        pairs = zip(model.materials.young.tolist(), model.materials.nu.tolist(), strict=True)
        density = [] if model.materials.density is None else model.materials.density.tolist()
        masses = [f", density {each!r} kg/m3" for each in density] or [""] * len(model.materials.young)
        lines += [
            f"material_{k}: young {young!r} {model.units}, nu {nu!r}{mass}"
            for k, ((young, nu), mass) in enumerate(zip(pairs, masses, strict=True), 1)
        ]
    lines += [f"load, which this format has no place for: {load_words(load)}" for load in model.loads]
    return lines


def without_data(model: Model) -> list[str]:
    """Lines for the head of a file whose format has no place for cell data and point data."""
    left_out = {"cell data": model.cell_data, "point data": model.point_data}
    return [f"{what}, which this format has no place for: {', '.join(data)}" for what, data in left_out.items() if data]


def as_columns(fields: dict[str, NDArray], shapes: Container[tuple[int, ...]] = ()) -> dict[str, NDArray]:
    """Cell or point data as scalars by name: the columns of what has several are numbered, NAME_0, NAME_1, ...

    Rows of one of the `shapes` stay as they are. A column that is then called as another field is takes another name.
    """
    whole = {name for name, values in fields.items() if values.ndim == 1 or values.shape[1:] in shapes}
    columns: dict[str, NDArray] = {}
    for name, values in fields.items():
        if name in whole:
            columns[name] = values
            continue
        for k, column in enumerate(values.reshape(len(values), -1).T):
            columns[free_text(f"{name}_{k}", {*whole, *columns})] = column
    return columns


def all_sets(part: Part) -> dict[str, list[int]]:
    """The entities that make up each set, and each label whose cells are no set, by name."""
    groups = {name: number for number, name in part.names.items() if name not in part.sets and name != UNNAMED_GROUP}
    return part.sets | {
        name: [each for each, those in part.groups_of.items() if number in those] for name, number in groups.items()
    }


def label_lines(model: Model, cells: Part, what: str) -> list[str]:
    """How the numbers of cells, each `what` ("attribute"), tell labels, in words for the file's head and the run."""
    labels = group_labels(model)
    if labels is None:
        return []
    divided = sorted({group for number, (group,) in cells.groups_of.items() if number != group})
    zero, lines = group_of_zero(labels), [f"the {what} of a cell is its label"]
    if zero in cells.names and zero not in divided:
        lines.append(f"label 0 is {what} {zero}, since 0 means none")
    if divided:
        first, names = min(cells.groups_of.keys() - cells.names), ", ".join(cells.names[group] for group in divided)
        lines[0] += f", but where a set or material divides it: each part has a number from {first} on ({names})"
    return lines


def tag_lines(tags_of: dict[str, list[int]], what: str) -> list[str]:
    """What each tag stands for, one line a tag."""
    names: dict[int, list[str]] = {}
    for name, tags in tags_of.items():
        for tag in tags:
            names.setdefault(tag, []).append(name)
    return [f"{what} {tag}: {' '.join(names[tag])}" for tag in sorted(names)]
