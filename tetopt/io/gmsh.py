"""Meshes for gmsh and all that reads its files: MSH 4.1 and 2.2, as text.

Cells: each is in one physical group, as dolfinx wants it: that of its material, "material_1", ..., or without materials
that of its cell set, and "unnamed" if it has none. A cell set that overlaps one before it, or is called as a facet set
is, is no group then (dolfinx and meshio know groups by name alone). The entity of a cell tells all of its sets: the
$Comments say which entities make up each.

Facets: each set is a physical group of triangles, in 2-D of lines, and such groups overlap. In 4.1 a facet is one
element, in an entity that belongs to all of its groups; in 2.2, where an element has one group, it is an element of
each of its sets, which is what gmsh does when it writes 2.2. Groups are numbered from the smallest. dolfinx keeps one
group of each facet, that of the smallest number: nothing then is left of "boundary", and a face of the box lacks what
is also in a smaller set; our XDMF files lose nothing there. A facet inside the mesh that two sets hold from opposite
sides is turned, in 4.1, as in the first of them. The nodes of a group are those of its elements.

Views ($ElementData), in 4.1 only, as meshio 5.3.5 reads no 2.2 that has them: the cell data, "young" and "nu" of the
materials in place of cell data of these names, and each cell set as 0 and 1. Facets have the values of the cell that
they are held by, since meshio takes no view that leaves elements out. $NodeData are the point data. Of 3 columns either
is a vector, by which gmsh deforms, of 9 a tensor; data of other numbers of columns are one view a column.

More than 1000 materials are no groups, only views; in 2.2 they are refused.

The $Comments also tell coordinates, units, each material's constants, and the loads, which MSH has no place for. Our
own reader goes by them, see `own_comments`.
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.tags import (
    as_columns,
    cell_tags,
    check_apart,
    facet_tags,
    material_names,
    remarks,
    tag_lines,
    without_data,
)
from tetopt.io.text import comment_lines, names_apart, rows
from tetopt.model.fields import node_field
from tetopt.model.model import Model, element_facets, elements
from tetopt.model.sets import facet_triples

# gmsh's numbers for elements of a dimension and an order: line, triangle, tetrahedron, and again.
ELEMENT_TYPES = {(1, 1): 1, (2, 1): 2, (3, 1): 4, (1, 2): 8, (2, 2): 9, (3, 2): 11}
TET10_ORDER = np.array([0, 1, 2, 3, 4, 5, 6, 7, 9, 8])  # gmsh has the midpoint of edge (2, 3) before that of (1, 3)
VIEW_SHAPES = ((3,), (9,))  # of a row: a view holds vectors and tensors
UNNAMED_GROUP = "unnamed"  # the group of cells that are in no other
MOST_MATERIAL_GROUPS = 1000  # gmsh takes minutes to open a 2.2 file with 200,000, meshio hours for a 4.1


class Part(NamedTuple):
    """The elements of one dimension."""

    dim: int
    numbers: NDArray[np.int64]  # (E,) from 1
    rows: NDArray[np.int64]  # (E,) cells, or (E, 2) facets
    entities: NDArray[np.int64]  # (E,) the entity of each, from 1
    groups_of: list[list[int]]  # the physical groups of each entity, ascending
    names: list[str]  # of the groups, from 1
    sets: dict[str, list[int]]  # the entities that make up each set


class OwnComments(NamedTuple):
    """What the comments of a file of ours tell."""

    space: str
    texts: dict[str, str]  # "units", "image", "image_sha256", as far as known
    constants: dict[str, tuple[float, float]]  # young and nu of each material that is a group
    entities: dict[str, list[int]]  # those that make up each of these materials and each cell set


def own_comments(lines: list[str]) -> OwnComments | None:
    """What `gmsh41` and `gmsh22` wrote into the comments; None if others wrote them."""
    coordinates = [line for line in lines if line.startswith("coordinates: ")]
    if not coordinates or not lines[0].startswith("tetopt"):
        return None
    texts: dict[str, str] = {}
    constants: dict[str, tuple[float, float]] = {}
    entities: dict[str, list[int]] = {}
    for line in lines:
        if match := re.fullmatch(r"units: mm, (\w+), .*", line):
            texts["units"] = match[1]
        elif match := re.fullmatch(r"image: (.*), sha256 (\w+)", line):
            texts |= {"image": match[1]} | ({} if match[2] == "unknown" else {"image_sha256": match[2]})
        elif match := re.fullmatch(r"(material_\d+): young (\S+) \w+, nu (\S+)", line):
            constants[match[1]] = float(match[2]), float(match[3])
        elif match := re.fullmatch(r"entity of cells (\d+): (.*)", line):
            for name in match[2].split():
                entities.setdefault(name, []).append(int(match[1]))
    return OwnComments("lps" if coordinates[0].startswith("coordinates: LPS") else "ras", texts, constants, entities)


def gmsh41(model: Model) -> bytes:
    """An MSH 4.1 file; see the module for what is where.

    Elements 1 to M are the cells in their order; they stand entity by entity.

    Raises
    ------
    InputError
        A set that is called as a group of cells or as cell data are.
    """
    grouped, comments = model, []
    if _n_materials(model) > MOST_MATERIAL_GROUPS:
        grouped = model._replace(materials=None)
        comments = [f"{_n_materials(model)} materials: in the views young, {model.units}, and nu; not groups"]
    points, cells = _geometry(model)
    parts = [_by_entity(part) for part in (_cells(grouped), _facets_once(model)) if len(part.numbers)]
    comments = remarks(grouped) + comments
    for part, what in zip(parts, ("cells", "facets"), strict=False):
        comments += tag_lines(part.sets, f"entity of {what}")
    counts = {part.dim: len(part.groups_of) for part in parts}
    n_elements = sum(len(part.numbers) for part in parts)
    return _file(
        "4.1 0 8",
        comments,
        parts,
        _section(
            "Entities",
            f"{' '.join(str(counts.get(dim, 0)) for dim in range(4))}\n",
            *(_entity_lines(model, part) for part in reversed(parts)),
        ),
        _section(
            "Nodes",
            f"1 {len(points)} 1 {len(points)}\n{model.mesh.ndim} 1 0 {len(points)}\n",
            rows(np.arange(1, len(points) + 1)),
            rows(points),
        ),
        _section(
            "Elements",
            f"{sum(counts.values())} {n_elements} 1 {n_elements}\n",
            *(_element_blocks(model, cells, part) for part in parts),
        ),
        *_views(model, parts),
    )


def gmsh22(model: Model) -> bytes:
    """A MSH 2.2 file, without cell data; see the module for what is where.

    Elements 1 to M are the cells, in their order; then come the facets, set by set.

    Raises
    ------
    InputError
        As `gmsh41`, or more than 1000 materials.
    """
    if _n_materials(model) > MOST_MATERIAL_GROUPS:
        raise InputError(
            f"gmsh 2.2: expected at most {MOST_MATERIAL_GROUPS} materials, as each becomes a group, got "
            f"{_n_materials(model)}; group them with --bins 32, or name the file .msh"
        )
    points, cells = _geometry(model)
    parts = [part for part in (_cells(model), _facets_each(model)) if len(part.numbers)]
    return _file(
        "2.2 0 8",
        [*remarks(model), *without_data(model), *tag_lines(parts[0].sets, "entity of cells")],
        parts,
        _section("Nodes", f"{len(points)}\n", rows(np.arange(1, len(points) + 1), points)),
        _section(
            "Elements",
            f"{sum(len(part.numbers) for part in parts)}\n",
            *(_element_lines(model, cells, part) for part in parts),
        ),
    )


def _n_materials(model: Model) -> int:
    return 0 if model.materials is None else len(model.materials.young)


def _file(header: str, comments: list[str], parts: list[Part], *sections: str) -> bytes:
    names = [f'{part.dim} {tag} "{name}"\n' for part in reversed(parts) for tag, name in enumerate(part.names, 1)]
    return "".join(
        [
            _section("MeshFormat", f"{header}\n"),
            _section("Comments", comment_lines(comments)),
            _section("PhysicalNames", f"{len(names)}\n", *names),
            *sections,
        ]
    ).encode("utf-8", "backslashreplace")


def _section(name: str, *parts: str) -> str:
    return f"${name}\n{''.join(parts)}$End{name}\n"


def _geometry(model: Model) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (P, 3) and cells, as `elements`."""
    points, cells = elements(model)
    return np.column_stack([points, np.zeros((len(points), 3 - model.mesh.ndim))]), cells


def _nodes(model: Model, cells: NDArray[np.int64], part: Part) -> NDArray[np.int64]:
    """The nodes of each element, from 0, in gmsh's order."""
    if part.rows.ndim == 1:
        return cells[part.rows][:, TET10_ORDER] if cells.shape[1] == 10 else cells[part.rows]
    return element_facets(cells, part.rows)


# Which elements there are


def _cells(model: Model) -> Part:
    """Every cell; an entity is what is of the same material and in the same sets."""
    tagged = cell_tags(model)
    if model.materials is None:
        names, group = _disjoint_sets(model)
    else:
        names, group = material_names(model, model.sets.facets), model.materials.of_cell + 1
    _, first = np.unique(tagged.tags, return_index=True)
    groups_of = [[number] for number in group[first].tolist()]
    return Part(model.mesh.ndim, tagged.items + 1, tagged.items, tagged.tags, groups_of, names, tagged.tags_of)


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


def _facets_once(model: Model) -> Part:
    """Every facet of a set; an entity is what is in the same sets."""
    names = list(_from_smallest(model))
    tagged = facet_tags(model.mesh, model.sets.facets)
    groups_of: list[list[int]] = [[] for _ in range(tagged.tags.max(initial=0))]
    for group, name in enumerate(names, 1):
        for tag in tagged.tags_of[name]:
            groups_of[tag - 1].append(group)
    numbers = len(model.mesh.cells) + 1 + np.arange(len(tagged.items))
    return Part(model.mesh.ndim - 1, numbers, tagged.items, tagged.tags, groups_of, names, tagged.tags_of)


def _facets_each(model: Model) -> Part:
    """The facets of each set, one set after the other, each an entity."""
    sets = _from_smallest(model)
    members = np.concatenate([np.empty((0, 2), dtype=np.int64), *sets.values()])
    entities = np.repeat(np.arange(1, len(sets) + 1), [len(facet_rows) for facet_rows in sets.values()])
    numbers = len(model.mesh.cells) + 1 + np.arange(len(members))
    of_set = {name: [k] for k, name in enumerate(sets, 1)}
    return Part(model.mesh.ndim - 1, numbers, members, entities, list(of_set.values()), list(sets), of_set)


def _from_smallest(model: Model) -> dict[str, NDArray[np.int64]]:
    return dict(sorted(model.sets.facets.items(), key=lambda item: len(item[1])))


def _by_entity(part: Part) -> Part:
    order = np.argsort(part.entities, kind="stable")
    return part._replace(numbers=part.numbers[order], rows=part.rows[order], entities=part.entities[order])


# Sections


def _starts(part: Part) -> NDArray[np.int64]:
    """Where each entity starts in a part that is in their order."""
    return np.searchsorted(part.entities, np.arange(1, len(part.groups_of) + 1))


def _entity_lines(model: Model, part: Part) -> str:
    """Number, bounding box, physical groups, and no bounding entities."""
    mesh = model.mesh
    corners = mesh.points[mesh.cells[part.rows] if part.rows.ndim == 1 else facet_triples(mesh.cells, part.rows)]
    boxes = np.zeros((len(part.groups_of), 2, 3))
    boxes[:, 0, : mesh.ndim] = np.minimum.reduceat(corners.min(axis=1), _starts(part))
    boxes[:, 1, : mesh.ndim] = np.maximum.reduceat(corners.max(axis=1), _starts(part))
    return "".join(
        f"{tag} {' '.join(map(repr, box))} {len(groups)} {' '.join(map(str, groups))} 0\n"
        for tag, (box, groups) in enumerate(zip(boxes.reshape(-1, 6).tolist(), part.groups_of, strict=True), 1)
    )


def _element_blocks(model: Model, cells: NDArray[np.int64], part: Part) -> str:
    lines = rows(part.numbers, _nodes(model, cells, part) + 1).splitlines(keepends=True)
    ends = np.append(_starts(part), len(lines)).tolist()
    kind = ELEMENT_TYPES[part.dim, model.order]
    return "".join(
        f"{part.dim} {k + 1} {kind} {stop - start}\n{''.join(lines[start:stop])}"
        for k, (start, stop) in enumerate(pairwise(ends))
    )


def _element_lines(model: Model, cells: NDArray[np.int64], part: Part) -> str:
    """Number, type, two tags: group, entity; nodes."""
    kind = np.full(len(part.numbers), ELEMENT_TYPES[part.dim, model.order])
    group = np.array([groups[0] for groups in part.groups_of])[part.entities - 1]
    return rows(part.numbers, kind, np.full_like(kind, 2), group, part.entities, _nodes(model, cells, part) + 1)


def _views(model: Model, parts: list[Part]) -> list[str]:
    """The $ElementData sections, with the elements in the order of the file: meshio goes by that."""
    numbers = np.concatenate([part.numbers for part in parts])
    of_cell = np.concatenate([part.rows if part.rows.ndim == 1 else part.rows[:, 0] for part in parts])
    of_cells = [_view("ElementData", name, numbers, values[of_cell]) for name, values in _fields(model).items()]
    at_nodes = {name: node_field(values, model.mesh, model.order) for name, values in model.point_data.items()}
    points = np.arange(1, len(elements(model)[0]) + 1)
    return of_cells + [_view("NodeData", name, points, values) for name, values in _view_columns(at_nodes).items()]


def _view(section: str, name: str, numbers: NDArray[np.int64], values: NDArray) -> str:
    n_columns = values[0].size
    return _section(section, f'1\n"{name}"\n1\n0.0\n3\n0\n{n_columns}\n{len(numbers)}\n', rows(numbers, values))


def _view_columns(fields: dict[str, NDArray]) -> dict[str, NDArray[np.float64]]:
    """Fields as views hold them: numbers, vectors and tensors; the columns of others one by one."""
    names = names_apart(fields, lambda name: name.replace('"', "'"))  # which gmsh knows no way to write
    return as_columns({names[name]: values.astype(np.float64) for name, values in fields.items()}, VIEW_SHAPES)


def _fields(model: Model) -> dict[str, NDArray[np.float64]]:
    """All that there is of each cell, (M,), (M, 3) or (M, 9) float64, by name."""
    fields = dict(model.cell_data)
    if model.materials is not None:
        of_cell = model.materials.of_cell
        fields |= {"young": model.materials.young[of_cell], "nu": model.materials.nu[of_cell]}
    check_apart(list(fields), model.sets.cells)
    for name, members in model.sets.cells.items():
        fields[name] = np.isin(np.arange(len(model.mesh.cells)), members)
    return _view_columns(fields)
