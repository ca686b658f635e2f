"""Meshes for gmsh and programs that read its files: MSH 4.1 and 2.2, as text.

Cells: each cell is in one physical group, as dolfinx requires. If cells have labels, the number of
the group is the label, and its name is that of the label's set; gmsh has no group 0, so label 0
gets the number after the largest label. If a label exceeds 99,999,999, groups number the labels
from 1, and the $Comments list the label of each group. Otherwise the group is that of its material,
"material_1", ..., or without materials that of its cell set, or "unnamed" without a set; a cell set
that overlaps a previous one, or has the name of a facet set, then has no group (dolfinx and meshio
know groups only by name). An entity has the number of its group; only if sets, or in 2.2 materials,
divide a group does it have several entities, numbered after all groups. The $Comments list the
entities of each set.

Facets: each facet is one element, in an entity that belongs to the groups of all of its sets. The
numbers of facet groups differ from those of cell groups. For a given R, those of the box's faces,
"mask_surface" and "boundary", up to 2 R - 1, are the same for every mesh; interfaces and other sets
are numbered from R + 1 in order, so that their numbers depend on the sets of the mesh. R is 1000,
or a power of ten above all labels. An entity lists the smallest set first, the only one that meshio
shows as "gmsh:physical". In 2.2 an element has only one group, that of its smallest set: a group
such as "boundary" then lacks facets that are also in a smaller set, and the $Comments describe the
whole set. dolfinx keeps one group of each facet, that with the smallest number; the XDMF files lose
nothing there. A facet inside the mesh that two sets hold from opposite sides is oriented as in the
first of them. The nodes of a group are those of its elements.

Views ($ElementData), only in 4.1, as meshio 5.3.5 cannot read 2.2 files with views: the cell data,
and "young" and "nu" of the materials instead of cell data of these names. Facets have the values of
the cell that they belong to, because meshio requires views of all elements. $NodeData contains the
point data. Data with 3 columns are vectors, by which gmsh deforms the mesh, with 9 columns tensors;
others become one view per column.

More than 1000 materials are only views, not groups; in 2.2 they are rejected.

The $Comments also contain coordinates, units, each material's constants, and the loads, for which
MSH has no place. tetopt's own reader uses them, see `own_comments`.
"""

from __future__ import annotations

import json
import re
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.tags import (
    Part,
    as_columns,
    group_labels,
    group_of_zero,
    number_parts,
    remarks,
    renumbered_labels,
    tag_lines,
    without_data,
    without_labels,
)
from tetopt.io.text import comment_lines, names_apart, rows
from tetopt.model.fields import KINDS_TEXT
from tetopt.model.file import MASK_TEXT, MOVED, PLACE_TEXT
from tetopt.model.model import Model, element_facets, elements, kind_lines
from tetopt.model.sets import facet_triples
from tetopt.system.arrays import Arrays, Floats, Ints

# gmsh's numbers for elements by dimension and order: line, triangle, tetrahedron of order 1, then
# of order 2.
ELEMENT_TYPES = {(1, 1): 1, (2, 1): 2, (3, 1): 4, (1, 2): 8, (2, 2): 9, (3, 2): 11}
# gmsh lists the midpoint of edge (2, 3) before that of (1, 3)
TET10_ORDER = np.array([0, 1, 2, 3, 4, 5, 6, 7, 9, 8])
VIEW_SHAPES = ((3,), (9,))  # of a row: views can hold vectors and tensors
LABEL_COMMENT = "physical groups of cells are the labels; label 0 is {}"
MATERIAL_COMMENT = r"(material_\d+): young (\S+) \w+, nu ([^,\s]+)(?:, density (\S+) kg/m3)?"
NUMBER_COMMENT = "physical group {} is label {}"
TEXTS = (MASK_TEXT, "violated", PLACE_TEXT)  # in the comments
# with 200,000, gmsh takes minutes to open a 2.2 file, and meshio hours for a 4.1 file
MOST_MATERIAL_GROUPS = 1000


class OwnComments(NamedTuple):
    """The comments of a file of tetopt's."""

    space: str
    texts: dict[str, str]  # "units", "image", "image_sha256", "mask", "violated", if known
    # young, nu and density (NaN for none) of each material defined by entities
    constants: dict[str, tuple[float, ...]]
    cells: dict[str, list[int]]  # entities of each of these materials and of each cell set
    facets: dict[str, list[int]]  # entities of each facet set
    zero: int | None = None  # the group of label 0, if groups are labels
    # by group, if labels are too large for groups; never modified
    labels: dict[int, int] = {}  # noqa: RUF012


def own_comments(lines: list[str]) -> OwnComments | None:
    """Parse the comments of `gmsh41` and `gmsh22`; None for those of other programs."""
    coordinates = [line for line in lines if line.startswith("coordinates: ")]
    if not coordinates or not lines[0].startswith("tetopt"):
        return None
    texts: dict[str, str] = {}
    constants: dict[str, tuple[float, ...]] = {}
    entities: dict[str, dict[str, list[int]]] = {"cells": {}, "facets": {}}
    zero = None
    labels = {}
    for line in lines:
        if match := re.fullmatch(r"units: m+, (\w+), .*", line):
            texts["units"] = match[1]
        elif match := re.fullmatch(r"image: (.*), sha256 (\w+)", line):
            texts |= {"image": match[1]} | (
                {} if match[2] == "unknown" else {"image_sha256": match[2]}
            )
        elif match := re.fullmatch(MATERIAL_COMMENT, line):
            constants[match[1]] = tuple(float(each or "nan") for each in match.groups()[1:])
        elif match := re.fullmatch(r"entity of (cells|facets) (\d+): (.*)", line):
            for name in match[3].split():
                entities[match[1]].setdefault(name, []).append(int(match[2]))
        elif match := re.fullmatch(
            rf"({'|'.join((*TEXTS, KINDS_TEXT))}): (\{{.*\}}|\d+ nodes.*|{MOVED}.*)", line
        ):
            texts[match[1]] = match[2]
        elif match := re.fullmatch(LABEL_COMMENT.format(r"(\d+)"), line):
            zero = int(match[1])
        elif match := re.fullmatch(NUMBER_COMMENT.format(r"(\d+)", r"(\d+)"), line):
            labels[int(match[1])] = int(match[2])
    space = "lps" if coordinates[0].startswith("coordinates: LPS") else "ras"
    return OwnComments(space, texts, constants, entities["cells"], entities["facets"], zero, labels)


def incomplete_groups(model: Model) -> list[str]:
    """Return the facet sets whose group in 2.2 lacks facets that are also in a smaller set."""
    _, facets = number_parts(model)
    in_several = [groups[1:] for groups in facets.groups_of.values()]
    return [
        facets.names[number]
        for number in sorted({each for groups in in_several for each in groups})
    ]


def gmsh41(model: Model) -> bytes:
    """Return an MSH 4.1 file; the module describes its layout.

    Elements 1 to M are the cells in their order; they are written entity by entity.

    Raises
    ------
    InputError
        A set has the name of a group of cells.
    """
    grouped = model
    comments = []
    if _n_materials(model) > MOST_MATERIAL_GROUPS:
        grouped = model._replace(materials=None)
        comments = [
            f"{_n_materials(model)} materials: in the views young, {model.units}, and nu; not "
            "groups"
        ]
    labels = group_labels(model)
    # entities are labels, and moduli are views
    if labels is not None and not _is_of_labels(grouped, labels):
        grouped = grouped._replace(materials=None)
    points, cells = _geometry(model)
    parts = [_by_entity(part) for part in _parts(grouped)]
    remarked = [*remarks(model if labels is not None else grouped), *_text_comments(model)]
    comments = [*remarked, *kind_lines(model), *comments, *_entity_comments(model, parts)]
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
            f"1 {len(points)} 1 {len(points)}\n{model.mesh.ndim} {min(parts[0].groups_of)} 0 "
            f"{len(points)}\n",
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
    """Return an MSH 2.2 file, without cell data; the module describes its layout.

    Elements 1 to M are the cells, in their order; the facets follow.

    Raises
    ------
    InputError
        For the reasons of `gmsh41`; there are more than 1000 materials.
    """
    if _n_materials(model) > MOST_MATERIAL_GROUPS:
        raise InputError(
            f"gmsh 2.2: expected at most {MOST_MATERIAL_GROUPS} materials, as each becomes a "
            f"group, got {_n_materials(model)}; group them with `bins` 32, or use .msh"
        )
    points, cells = _geometry(model)
    parts = _parts(model)
    return _file(
        "2.2 0 8",
        [
            *remarks(model),
            *_text_comments(model),
            *without_data(without_labels(model)),
            *_entity_comments(model, parts),
        ],
        parts,
        _section("Nodes", f"{len(points)}\n", rows(np.arange(1, len(points) + 1), points)),
        _section(
            "Elements",
            f"{sum(len(part.numbers) for part in parts)}\n",
            *(_element_lines(model, cells, part) for part in parts),
        ),
    )


def _text_comments(model: Model) -> list[str]:
    """Return comments on the mask that the mesh was built within, and on requirements that its
    run violated, if any.
    """
    texts = {name: model.about[name] for name in TEXTS if name in model.about}
    return [
        f"{name}: {text if isinstance(text, str) else json.dumps(text)}"
        for name, text in texts.items()
    ]


def _n_materials(model: Model) -> int:
    return 0 if model.materials is None else len(model.materials.young)


def _file(header: str, comments: list[str], parts: list[Part], *sections: str) -> bytes:
    names = [
        f'{part.dim} {number} "{name}"\n'
        for part in reversed(parts)
        for number, name in part.names.items()
    ]
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


def _geometry(model: Model) -> tuple[Floats, Ints]:
    """Return points (P, 3) and cells, see `elements`."""
    points, cells = elements(model)
    return np.column_stack([points, np.zeros((len(points), 3 - model.mesh.ndim))]), cells


def _nodes(model: Model, cells: Ints, part: Part) -> Ints:
    """Return the nodes of each element, from 0, in gmsh's order."""
    if part.rows.ndim == 1:
        return cells[part.rows][:, TET10_ORDER] if cells.shape[1] == 10 else cells[part.rows]
    return element_facets(cells, part.rows)


# Elements


def _parts(model: Model) -> list[Part]:
    """Return the cells and, if they are in sets, the facets."""
    return [part for part in number_parts(model) if len(part.numbers)]


def _is_of_labels(model: Model, labels: Ints) -> bool:
    """Return whether all cells of a label have one material."""
    if model.materials is None:
        return True
    pairs = np.unique(np.column_stack([labels, model.materials.of_cell]), axis=0)
    return len(pairs) == len(np.unique(labels))


def _entity_comments(model: Model, parts: list[Part]) -> list[str]:
    """Return comments on the entities of each set and, if groups are labels, a comment on that."""
    labels = group_labels(model)
    lines = [] if labels is None else [LABEL_COMMENT.format(group_of_zero(labels))]
    lines += [NUMBER_COMMENT.format(*each) for each in renumbered_labels(model).items()]
    for part, what in zip(parts, ("cells", "facets"), strict=False):
        lines += tag_lines(part.sets, f"entity of {what}")
    return lines


def _by_entity(part: Part) -> Part:
    order = np.argsort(part.entities, kind="stable")
    return part._replace(
        numbers=part.numbers[order], rows=part.rows[order], entities=part.entities[order]
    )


# Sections


def _starts(part: Part) -> Ints:
    """Return the start of each entity in a part sorted by entity."""
    return np.searchsorted(part.entities, list(part.groups_of))


def _entity_lines(model: Model, part: Part) -> str:
    """Return lines of number, bounding box, physical groups, and no bounding entities."""
    mesh = model.mesh
    corners = mesh.points[
        mesh.cells[part.rows] if part.rows.ndim == 1 else facet_triples(mesh.cells, part.rows)
    ]
    boxes = np.zeros((len(part.groups_of), 2, 3))
    boxes[:, 0, : mesh.ndim] = np.minimum.reduceat(corners.min(axis=1), _starts(part))
    boxes[:, 1, : mesh.ndim] = np.maximum.reduceat(corners.max(axis=1), _starts(part))
    return "".join(
        f"{tag} {' '.join(map(repr, box))} {len(groups)} {' '.join(map(str, groups))} 0\n"
        for (tag, groups), box in zip(
            part.groups_of.items(), boxes.reshape(-1, 6).tolist(), strict=True
        )
    )


def _element_blocks(model: Model, cells: Ints, part: Part) -> str:
    lines = rows(part.numbers, _nodes(model, cells, part) + 1).splitlines(keepends=True)
    ends = np.append(_starts(part), len(lines)).tolist()
    kind = ELEMENT_TYPES[part.dim, model.order]
    return "".join(
        f"{part.dim} {number} {kind} {stop - start}\n{''.join(lines[start:stop])}"
        for number, (start, stop) in zip(part.groups_of, pairwise(ends), strict=True)
    )


def _element_lines(model: Model, cells: Ints, part: Part) -> str:
    """Return lines of number, type, two tags (group, entity) and nodes."""
    kind = np.full(len(part.numbers), ELEMENT_TYPES[part.dim, model.order])
    place = np.searchsorted(list(part.groups_of), part.entities)
    group = np.array([groups[0] for groups in part.groups_of.values()])[place]
    return rows(
        part.numbers,
        kind,
        np.full_like(kind, 2),
        group,
        part.entities,
        _nodes(model, cells, part) + 1,
    )


def _views(model: Model, parts: list[Part]) -> list[str]:
    """Return the $ElementData sections, with elements in the order of the file, on which meshio
    relies.
    """
    numbers = np.concatenate([part.numbers for part in parts])
    of_cell = np.concatenate(
        [part.rows if part.rows.ndim == 1 else part.rows[:, 0] for part in parts]
    )
    of_cells = [
        _view("ElementData", name, numbers, values[of_cell])
        for name, values in _fields(model).items()
    ]
    points = np.arange(1, len(elements(model)[0]) + 1)
    return of_cells + [
        _view("NodeData", name, points, values)
        for name, values in _view_columns(model.point_data).items()
    ]


def _view(section: str, name: str, numbers: Ints, values: NDArray) -> str:
    n_columns = values[0].size
    return _section(
        section, f'1\n"{name}"\n1\n0.0\n3\n0\n{n_columns}\n{len(numbers)}\n', rows(numbers, values)
    )


def _view_columns(fields: Arrays) -> dict[str, Floats]:
    """Convert fields to views: numbers, vectors and tensors; others column by column."""
    names = names_apart(fields, lambda name: name.replace('"', "'"))  # gmsh cannot escape quotes
    return as_columns(
        {names[name]: values.astype(np.float64) for name, values in fields.items()}, VIEW_SHAPES
    )


def _fields(model: Model) -> dict[str, Floats]:
    """Return cell data and moduli, (M,), (M, 3) or (M, 9) float64, by name."""
    fields = dict(model.cell_data)
    if model.materials is not None:
        own = model.materials.fields()
        fields |= {name: own[name] for name in own if name not in ("material", "density")}
    return _view_columns(fields)
