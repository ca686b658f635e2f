"""Named sets of facets and cells, which boundary conditions and materials are given to.

A facet is a row (cell, k): the facet of that cell opposite its local node k, so that its outer side is known, and with
it which side of an interface is meant. Nodes need no sets of their own: those of a facet set are `nodes_of` it.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError
from tetopt.geometry.box import ON_SIDE_VOXELS, box_sides, facets_on_sides, world_axes
from tetopt.geometry.simplex import outward_facet_nodes
from tetopt.geometry.topology import facets, largest_component
from tetopt.image import Image, transformed
from tetopt.mesh import Mesh

BOUNDARY_SET = "boundary"  # every facet of one cell only
MASK_SURFACE_SET = "mask_surface"  # those of them off the faces of the image's box
SIDE_DEPTH = 0.1  # of a mesh's extent: a side that is off the box is the outermost tenth (a tenth of a ball's surface)
# By RAS+: the side of smaller and of larger world coordinate. A slice's two axes may be any of the three.
FACE_NAMES: dict[int, tuple[tuple[str, str], ...]] = {
    2: (("x_min", "x_max"), ("y_min", "y_max")),
    3: (("left", "right"), ("posterior", "anterior"), ("inferior", "superior")),
}
MOST_LETTERS = 72  # of a name: room for an interface of two long ones; Abaqus and CalculiX take 80
SET_NAME = re.compile(rf"[A-Za-z][A-Za-z0-9_-]{{0,{MOST_LETTERS - 1}}}")  # what every format can carry
# What labels' names are not to be taken for: other labels, interfaces, and what formats call their own.
RESERVED_NAME = re.compile(r"label_\d+|interface_.*|material_\d+|unnamed|all_cells", re.IGNORECASE)


class Sets(NamedTuple):
    """Sets by name; all names differ, and by more than case, as some formats have one list of names for everything.

    Parameters
    ----------
    facets : dict of (K, 2) int64
        Rows (cell, local node opposite), ascending.
    cells : dict of (K,) int64
        Ascending.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> sets = tetopt.build_model(mesh, image).sets
    >>> list(sets.facets)
    ['boundary', 'left', 'right', 'posterior', 'anterior', 'inferior', 'superior']
    >>> sets.facets["left"].shape
    (50, 2)
    """

    facets: dict[str, NDArray[np.int64]]
    cells: dict[str, NDArray[np.int64]]


class Box(NamedTuple):
    """An image's domain without its voxels: from index -0.5 to shape - 0.5.

    Parameters
    ----------
    shape : tuple of int
        Number of voxels along each axis.
    affine : (n+1, n+1) float64
        Index -> world mm.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> box = tetopt.Box(image.shape, image.affine)
    >>> "left" in tetopt.build_model(mesh, box=box).sets.facets
    True
    """

    shape: tuple[int, ...]
    affine: NDArray[np.float64]


def standard_names(ndim: int) -> set[str]:
    """The names of the sets on the boundary of every mesh."""
    return {BOUNDARY_SET, MASK_SURFACE_SET, *(name for pair in FACE_NAMES[ndim] for name in pair)}


def facet_triples(cells: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Nodes of the facets (K, 2), (K, n) int64, turned to face out of their cell.

    In 3-D the normal (b - a) x (c - a) of a row (a, b, c) points out; in 2-D the right side of a -> b lies outside.
    """
    return cells[rows[:, :1], outward_facet_nodes(cells.shape[1] - 1)[rows[:, 1]]]


def area_vectors(mesh: Mesh, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Outward normals of facets (K, 2), as long as each is large, (K, n), mm2 (in 2-D mm)."""
    corners = mesh.points[facet_triples(mesh.cells, rows)]
    edges = corners[:, 1:] - corners[:, :1]
    if mesh.ndim == 3:
        return 0.5 * np.cross(edges[:, 0], edges[:, 1])
    return edges[:, 0, ::-1] * np.array([1.0, -1.0])


def nodes_of(mesh: Mesh, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """The nodes of a facet set, (P,) int64, ascending."""
    return np.unique(facet_triples(mesh.cells, rows))


def boundary_rows(mesh: Mesh) -> NDArray[np.int64]:
    """Every facet that belongs to one cell only, (B, 2) int64, ascending."""
    shared = facets(mesh.cells)
    return np.argwhere(shared.n_cells[shared.of_cell] == 1)


def standard_sets(
    mesh: Mesh,
    box: Box | None = None,
    labels: NDArray[np.integer] | None = None,
    names: Mapping[int, str] | None = None,
    own: Mapping[str, NDArray[np.int64]] | None = None,
) -> Sets:
    """The sets that every mesh comes with.

    Parameters
    ----------
    mesh : Mesh
    box : Box, optional
        The box of the image that the mesh was made from, whose faces are named by the world axis that each is nearest
        to: "left" is the side of smaller x in RAS+. By default the box along the world's axes around the mesh.
    labels : (M,) integers, optional
        Label of each cell.
    names : mapping of label to text, optional
        What labels are called.
    own : mapping of (K, 2) int64, optional
        Sets of facets that the mesh brings along; they replace sides by its own extent.

    Returns
    -------
    Sets
        Facets "boundary", "left", "right", "posterior", "anterior", "inferior", "superior" (in 2-D "x_min", "x_max",
        "y_min", "y_max"), and, with a box, "mask_surface" for the boundary off its faces; sets without facets are
        left out. A side is the boundary on that face of the box; where there is none, as on an organ within the box,
        the facets of the outermost tenth of the mesh along the world axis that face that way more than any other.
        With labels also those of `label_sets`.

    Raises
    ------
    InputError
        Labels that are not one whole number from 0 for each cell.
    """
    boundary = boundary_rows(mesh)
    faces = face_sets(mesh, boundary, box)
    for name, rows in _extent_sets(mesh, boundary).items():
        if len(faces[name]) == 0:
            faces[name] = (own or {}).get(name, rows)
    named = {BOUNDARY_SET: boundary, **faces}
    of_labels = Sets({}, {}) if labels is None else label_sets(mesh, labels, names)
    return Sets({name: rows for name, rows in named.items() if len(rows)} | of_labels.facets, of_labels.cells)


def label_sets(mesh: Mesh, labels: NDArray[np.integer], names: Mapping[int, str] | None = None) -> Sets:
    """Cells of each label, and facets between each two, as rows of the cells with the smaller one.

    They are called "label_1", ..., "interface_1_2", ..., with a name for a number where a label has one: see
    `label_set_names` and `interface_names`.

    Raises
    ------
    InputError
        Labels that are not one whole number from 0 for each cell.
    """
    labels = _checked_labels(labels, mesh)
    of_label = label_set_names(np.unique(labels).tolist(), names or {})
    facet_rows = _interfaces(mesh, labels)
    of_pair = interface_names(facet_rows, of_label)
    return Sets(
        {of_pair[pair]: rows for pair, rows in facet_rows.items()},
        {name: np.flatnonzero(labels == label) for label, name in of_label.items()},
    )


def label_set_names(labels: Iterable[int], names: Mapping[int, str]) -> dict[int, str]:
    """What the set of each label's cells is called: its name, as far as every format can carry it, or "label_5".

    All names differ by more than case, and do not depend on which of the labels of `names` are there: where two would
    be the same, or one is another set's, the label's number follows each.

    Examples
    --------
    >>> label_set_names([5, 6, 7, 8], {5: "left lung", 6: "Rib (a)", 7: "rib/a"})
    {5: 'left_lung', 6: 'Rib_a_6', 7: 'rib_a_7', 8: 'label_8'}
    """
    plain = {label: _plain_name(name) for label, name in names.items()}
    counts = Counter(name.lower() for name in plain.values())
    counts.update(2 * [*standard_names(2), *standard_names(3)])
    of_label = {}
    for label in labels:
        name, default = plain.get(label, ""), f"label_{label}"
        if name.lower() == default:
            name = default
        elif name and (counts[name.lower()] > 1 or RESERVED_NAME.fullmatch(name)):
            name = f"{name[: MOST_LETTERS - 1 - len(str(label))]}_{label}"
            name = default if counts[name.lower()] or RESERVED_NAME.fullmatch(name) else name
        of_label[label] = name or default
    return of_label


def _plain_name(name: str) -> str:
    """The name in letters that every format can carry; nothing if none of it is left."""
    letters = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    joined = re.sub(r"[^A-Za-z0-9-]+", "_", letters).strip("_-")
    return (joined if joined[:1].isalpha() or not joined else f"label_{joined}")[:MOST_LETTERS]


def interface_names(pairs: Iterable[tuple[int, int]], of_label: Mapping[int, str]) -> dict[tuple[int, int], str]:
    """What the facets between each two labels are called: "interface_liver_spleen", by numbers "interface_1_5".

    `of_label` is as of `label_set_names`. Numbers stand where a label has no name, and where the names are too long
    together or would be the same for two pairs.
    """
    parts = {label: str(label) if name == f"label_{label}" else name for label, name in of_label.items()}
    named = {(a, b): f"interface_{parts[a]}_{parts[b]}" for a, b in pairs}
    counts = Counter(name.lower() for name in named.values())
    return {
        (a, b): name if counts[name.lower()] == 1 and len(name) <= MOST_LETTERS else f"interface_{a}_{b}"
        for (a, b), name in named.items()
    }


def face_sets(mesh: Mesh, boundary: NDArray[np.int64], box: Box | None) -> dict[str, NDArray[np.int64]]:
    """The boundary's facets on each face of the box, and, with a box, those on none of them."""
    n = mesh.ndim
    if box is None:
        low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
        places, faces, tolerance = mesh.points, np.column_stack([low, high]), ON_SIDE_VOXELS * (high - low).max()
        axes, directions = tuple(range(n)), np.ones(n)
    else:
        inverse = np.asarray(np.linalg.inv(box.affine[:n, :n]), dtype=np.float64)
        places = transformed(mesh.points - box.affine[:n, n], inverse)
        faces, tolerance = box_sides(box.shape), ON_SIDE_VOXELS
        axes = world_axes(box.affine)
        directions = box.affine[list(axes), range(n)]
    is_on = facets_on_sides(places, facet_triples(mesh.cells, boundary), faces, tolerance)  # (B, n, 2)
    sets: dict[str, NDArray[np.int64]] = {}
    for name_pair in FACE_NAMES[n]:
        axis = axes.index(FACE_NAMES[n].index(name_pair))
        sides = is_on[:, axis].T if directions[axis] > 0.0 else is_on[:, axis, ::-1].T
        sets |= {name: boundary[side] for name, side in zip(name_pair, sides, strict=True)}
    return sets if box is None else {**sets, MASK_SURFACE_SET: boundary[~np.any(is_on, axis=(1, 2))]}


def _extent_sets(mesh: Mesh, boundary: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """The boundary's facets in the outermost tenth of the mesh along each world axis, of those that face that way.

    No facet is on two sides: each faces the side that its normal is nearest to.
    """
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    centres = mesh.points[facet_triples(mesh.cells, boundary)].mean(axis=1)
    areas, fraction = area_vectors(mesh, boundary), (centres - low) / (high - low)
    faced = np.abs(areas).argmax(axis=1)
    sets = {}
    for axis, (name_low, name_high) in enumerate(FACE_NAMES[mesh.ndim]):
        is_faced = faced == axis
        sets[name_low] = boundary[is_faced & (areas[:, axis] < 0.0) & (fraction[:, axis] <= SIDE_DEPTH)]
        sets[name_high] = boundary[is_faced & (areas[:, axis] > 0.0) & (fraction[:, axis] >= 1.0 - SIDE_DEPTH)]
    return sets


def _interfaces(mesh: Mesh, labels: NDArray[np.int64]) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Facets between each two labels, the smaller first, as rows of its cells."""
    shared = facets(mesh.cells)
    of_cell = shared.cells[shared.of_cell]  # (M, n+1, 2)
    own = np.arange(len(mesh.cells))[:, None]
    other = np.where(of_cell[..., 0] == own, of_cell[..., 1], of_cell[..., 0])
    there = np.where(other >= 0, labels[other], -1)
    rows = np.argwhere(there > labels[:, None])
    values, rank = np.unique(labels, return_inverse=True)
    other_rank = np.searchsorted(values, there[rows[:, 0], rows[:, 1]])
    pairs, which = np.unique(rank.ravel()[rows[:, 0]] * len(values) + other_rank, return_inverse=True)
    ends = np.cumsum(np.bincount(which.ravel(), minlength=len(pairs)))[:-1]
    parts = np.split(rows[np.argsort(which.ravel(), kind="stable")], ends) if len(pairs) else []
    kinds = zip(values[pairs // len(values)].tolist(), values[pairs % len(values)].tolist(), strict=True)
    return dict(zip(kinds, parts, strict=True))


def _checked_labels(labels: ArrayLike, mesh: Mesh) -> NDArray[np.int64]:
    array = np.asarray(labels)
    if array.shape != (len(mesh.cells),):
        raise InputError(f"labels: expected one for each of {len(mesh.cells)} cells, got shape {array.shape}")
    whole = array.astype(np.int64)
    if (whole != array).any() or whole.min() < 0:
        raise InputError(f"labels: expected whole numbers from 0, got {array.min():g} to {array.max():g}")
    return whole


# Sets that a user asks for


def with_requested(mesh: Mesh, sets: Sets, requests: Iterable[str], mean: NDArray[np.float64] | None) -> Sets:
    """`sets` and those that are requested in words.

    Parameters
    ----------
    mesh : Mesh
    sets : Sets
    requests : iterable of str
        "NAME=below:T", the cells of the largest facet-connected set with a mean below T (Fig. 3(f) of the paper), with
        the facets around them, "NAME_surface"; "NAME=point:X,Y,Z:D" and "NAME=plane:X,Y,Z:NX,NY,NZ:D", boundary facets
        all of whose nodes lie within D mm of a point, or of a plane through a point with a normal; world mm, RAS+.
    mean : (M,) float64, optional
        Mean intensity of each cell.

    Raises
    ------
    InputError
        Other words, a name that is taken or that a format cannot carry, no means, or a set without members.
    """
    for text in requests:
        request = parse_set(text, mesh.ndim)
        check_free_names(request, sets)
        if request.kind == "below":
            cells = _cells_below(mesh, request, mean)
            surface = {f"{request.name}_surface": enclosing_facets(mesh, cells)}
            sets = Sets(sets.facets | surface, sets.cells | {request.name: cells})
        else:
            sets = Sets(sets.facets | {request.name: _facets_within(mesh, request)}, sets.cells)
    return sets


class SetRequest(NamedTuple):
    """A set that a user asks for."""

    name: str
    kind: str
    vectors: list[NDArray[np.float64]]  # the numbers between the colons

    def names(self) -> tuple[str, ...]:
        """The names that it takes."""
        return (self.name, f"{self.name}_surface") if self.kind == "below" else (self.name,)


def parse_set(text: str, ndim: int) -> SetRequest:
    """A set from words, see `with_requested`.

    Raises
    ------
    InputError
        Other words, other numbers, or a name that a format cannot carry.
    """
    name, equals, what = text.partition("=")
    kind, _, rest = what.partition(":")
    shapes = {"below": ("T", [1]), "point": ("X,Y,Z:D", [ndim, 1]), "plane": ("X,Y,Z:NX,NY,NZ:D", [ndim, ndim, 1])}
    if not equals or kind not in shapes:
        raise InputError(f'set: expected NAME=below:T, NAME=point:X,Y,Z:D or NAME=plane:X,Y,Z:NX,NY,NZ:D, got "{text}"')
    if not SET_NAME.fullmatch(name):
        raise InputError(
            f'set: a name is a letter, then up to {MOST_LETTERS - 1} letters, digits, _ and -, got "{name}"'
        )
    form, counts = shapes[kind]
    parts = rest.split(":")
    if len(parts) != len(counts):
        raise InputError(f'set {name}: expected {kind}:{form}, got "{rest}"')
    vectors = [_numbers(name, part, count) for part, count in zip(parts, counts, strict=True)]
    if kind != "below" and vectors[-1][0] < 0.0:
        raise InputError(f"set {name}: expected a distance of 0 or more, got {vectors[-1][0]:g}")
    if kind == "plane" and not vectors[1].any():
        raise InputError(f"set {name}: the plane's normal must not be 0")
    return SetRequest(name, kind, vectors)


def enclosing_facets(mesh: Mesh, cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """The facets between some cells and all else, as rows of those cells, (K, 2) int64."""
    part = Mesh(mesh.points, mesh.cells[cells])
    rows = boundary_rows(part)
    return np.column_stack([cells[rows[:, 0]], rows[:, 1]])


def check_free_names(request: SetRequest, sets: Sets) -> None:
    """InputError if a set that is requested takes a name that there is."""
    taken = {other.lower(): other for other in (*sets.facets, *sets.cells)}
    for name in request.names():
        if name.lower() in taken:
            raise InputError(f'set: there is a set "{taken[name.lower()]}" already; call it otherwise than "{name}"')


def _cells_below(mesh: Mesh, request: SetRequest, mean: NDArray[np.float64] | None) -> NDArray[np.int64]:
    name, threshold = request.name, float(request.vectors[0][0])
    if mean is None:
        raise InputError(f"set {name}: the mesh has no means; give the image they come from (`image`)")
    chosen = largest_component(mesh.cells, mean < threshold)
    if len(chosen) == 0:
        raise InputError(f"set {name}: no cell has a mean below {threshold:g}, they go from {mean.min():g} up")
    return chosen


def _facets_within(mesh: Mesh, request: SetRequest) -> NDArray[np.int64]:
    """Boundary facets all of whose nodes lie within the distance of the point or plane."""
    offset = mesh.points - request.vectors[0]
    if request.kind == "point":
        distance = np.sqrt((offset**2).sum(axis=1))
    else:
        normal = request.vectors[1] / np.abs(request.vectors[1]).max()  # whose square neither overflows nor vanishes
        distance = np.abs((offset * (normal / np.linalg.norm(normal))).sum(axis=1))
    reach = float(request.vectors[-1][0])
    rows = boundary_rows(mesh)
    farthest = distance[facet_triples(mesh.cells, rows)].max(axis=1)
    if not (farthest <= reach).any():
        raise InputError(
            f"set {request.name}: no facet of the boundary lies within {reach:g} mm; the nearest does within "
            f"{farthest.min():.4g} mm"
        )
    return rows[farthest <= reach]


def _numbers(name: str, text: str, count: int) -> NDArray[np.float64]:
    numbers = finite_numbers(text)
    if len(numbers) != count:
        raise InputError(f'set {name}: expected {count} number{"s" * (count > 1)}, got "{text}"')
    return numbers


def finite_numbers(text: str) -> NDArray[np.float64]:
    """The numbers between commas, float64; none if there is anything else, or one that is not finite."""
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        return np.empty(0)
    return numbers if np.isfinite(numbers).all() else np.empty(0)


# Sets that come with a mesh


def rows_of(mesh: Mesh, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows (cell, k), ascending, of facets given by their nodes (K, n); what is no facet is left out.

    A facet between two cells is held by the one that its nodes, as those of `facet_triples`, face out of.
    """
    shared = facets(mesh.cells)
    distinct, which = np.unique(np.concatenate([shared.nodes, np.sort(nodes, axis=1)]), axis=0, return_inverse=True)
    place = np.full(len(distinct), -1)
    place[which.ravel()[: len(shared.nodes)]] = np.arange(len(shared.nodes))
    number, listed = np.unique(place[which.ravel()[len(shared.nodes) :]], return_index=True)
    number, listed = number[number >= 0], nodes[listed[number >= 0]]

    def held_by(cell: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.column_stack([cell, (shared.of_cell[cell] == number[:, None]).argmax(axis=1)])

    first, second = shared.cells[number].T
    rows = held_by(first)
    rolled = [np.roll(listed, k, axis=1) for k in range(1 if mesh.ndim == 2 else 3)]  # which face the same way
    faces_out = np.any([(facet_triples(mesh.cells, rows) == each).all(axis=1) for each in rolled], axis=0)
    rows = np.where((faces_out | (second < 0))[:, None], rows, held_by(second))
    return rows[np.lexsort(rows.T[::-1])]


def surviving_sets(before: Mesh, sets: Sets, mesh: Mesh) -> Sets:
    """Those facet sets of the mesh `before` of which `mesh` still has every facet, as its own rows.

    Facets are the same if their nodes lie in the same places. Where an optimisation kept the boundary, these are the
    sets on the boundary. Cell sets do not survive, since the cells are others.
    """
    place = {point.tobytes(): number for number, point in enumerate(mesh.points)}
    now = np.array([place.get(point.tobytes(), -1) for point in before.points])
    survivors = {name: rows_of(mesh, now[facet_triples(before.cells, rows)]) for name, rows in sets.facets.items()}
    return Sets({name: rows for name, rows in survivors.items() if len(rows) == len(sets.facets[name])}, {})


def free_name(label: str, taken: set[str]) -> str:
    """A name like `label` that every format can carry and that differs from those taken by more than case."""
    name = re.sub(r"[^A-Za-z0-9_-]", "_", label)
    stem = (name if name[0].isalpha() else f"set_{name}")[:MOST_LETTERS]
    name, number = stem, 1
    while name.lower() in taken:
        number += 1
        name = f"{stem[: MOST_LETTERS - 1 - len(str(number))]}_{number}"
    return name


def merged_sets(standard: Sets, own: Sets) -> tuple[Sets, dict[str, str]]:
    """The standard sets and a mesh's own; and the new names of those of its own whose names were taken.

    A set of its own that is the same as the standard one of its name is that one.
    """
    parts: tuple[dict[str, NDArray[np.int64]], ...] = (dict(standard.facets), dict(standard.cells))
    renamed = {}
    for kind, members_by_name in enumerate((own.facets, own.cells)):
        for name, members in members_by_name.items():
            if np.array_equal(standard[kind].get(name, np.empty(0)), members):
                continue
            free = free_name(name, {each.lower() for part in parts for each in part})
            parts[kind][free] = members
            if free != name:
                renamed[name] = free
    return Sets(*parts), renamed


def box_text(box: Box) -> dict[str, Any]:
    """What `tetopt.io.vtk.box_in` reads, for a mesh's `about`."""
    return {"shape": list(box.shape), "affine": box.affine.tolist()}


def box_of(image: Image) -> Box:
    """The box that an image fills."""
    return Box(image.shape, image.affine)
