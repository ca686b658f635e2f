"""What mesh formats share that know numbers for materials and sets, and comments for the rest."""

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
from tetopt.model.loads import count_of_steps, load_words
from tetopt.model.model import Model, described
from tetopt.model.sets import MOST_LETTERS, free_name, label_set_names


class Tagged(NamedTuple):
    """Overlapping sets as tags, one an item, for formats that know no more: an item's tag tells all of its sets."""

    items: NDArray[np.int64]  # (T,) or (T, 2): every cell or facet that is in any set, ascending
    tags: NDArray[np.int64]  # (T,) from 1
    tags_of: dict[str, list[int]]  # the tags that make up each set


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


def check_one_step(model: Model, form: str) -> None:
    """InputError for several steps, where each would go on from the one before."""
    if (count := count_of_steps(model.loads)) > 1:
        raise InputError(f"{form}: a file is one step, got {count}; write one for each, with its loads alone")


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


def tag_lines(tags_of: dict[str, list[int]], what: str) -> list[str]:
    """What each tag stands for, one line a tag."""
    names: dict[int, list[str]] = {}
    for name, tags in tags_of.items():
        for tag in tags:
            names.setdefault(tag, []).append(name)
    return [f"{what} {tag}: {' '.join(names[tag])}" for tag in sorted(names)]
