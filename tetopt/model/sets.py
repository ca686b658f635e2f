"""Named sets of facets and cells for boundary conditions and materials.

A facet is a row (cell, k): the facet of that cell opposite its local node k. This defines its outer
side, and thus the side of an interface. There are no sets of nodes: `nodes_of` gives the nodes of a
facet set.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tetopt.errors import InputError
from tetopt.geometry.box import ON_SIDE_VOXELS, box_sides, facets_on_sides, world_axes
from tetopt.geometry.simplex import area_normals, outward_facet_nodes
from tetopt.geometry.topology import connected_sets, facets, largest_component
from tetopt.image import Image, transform_vectors
from tetopt.mesh import Mesh
from tetopt.system.arrays import Bools, Floats, Ints, Json, Shape

BOUNDARY_SET = "boundary"  # all facets that belong to only one cell
MASK_SURFACE_SET = "mask_surface"  # boundary facets that are not on the faces of the image's box
# fraction of the extent: a side off the box is the outermost tenth (a tenth of a ball's surface)
SIDE_DEPTH = 0.1
# In RAS+: the sides of smaller and of larger world coordinate. The two axes of a slice may be any
# of the three.
FACE_NAMES: dict[int, tuple[tuple[str, str], ...]] = {
    2: (("x_min", "x_max"), ("y_min", "y_max")),
    3: (("left", "right"), ("posterior", "anterior"), ("inferior", "superior")),
}
# in a name: enough for an interface of two long names; Abaqus and CalculiX allow 80
MOST_LETTERS = 72
INTERFACE_PREFIX = "interface_"  # of names of facet sets between two labels
SIDE_KINDS = ("outer", "inner")  # of a difference of sets
# names that all formats support
SET_NAME = re.compile(rf"[A-Za-z][A-Za-z0-9_-]{{0,{MOST_LETTERS - 1}}}")
# Names that labels must not have: those of other labels, interfaces, and names that formats use
# themselves.
RESERVED_NAME = re.compile(r"label_\d+|interface_.*|material_\d+|unnamed|all_cells", re.IGNORECASE)


Names = Mapping[int, str]  # of labels


class Sets(NamedTuple):
    """Sets by name; all names differ by more than case, as some formats have one list of names.

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

    facets: dict[str, Ints]
    cells: dict[str, Ints]


class Box(NamedTuple):
    """An image's domain without its voxels: from index -0.5 to shape - 0.5.

    Parameters
    ----------
    shape : tuple of int
        Number of voxels along each axis.
    affine : (n+1, n+1) float64
        From index to world coordinates in mm.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> box = tetopt.Box(image.shape, image.affine)
    >>> "left" in tetopt.build_model(mesh, box=box).sets.facets
    True
    """

    shape: Shape
    affine: Floats


def standard_names(ndim: int) -> set[str]:
    """Return the names of the standard sets on the boundary."""
    return {BOUNDARY_SET, MASK_SURFACE_SET, *(name for pair in FACE_NAMES[ndim] for name in pair)}


def facet_triples(cells: Ints, rows: Ints) -> Ints:
    """Return the nodes of facets (K, 2), (K, n) int64, oriented outwards from their cell.

    In 3-D the normal (b - a) x (c - a) of a row (a, b, c) points outwards; in 2-D the right side of
    a -> b is outside.
    """
    return cells[rows[:, :1], outward_facet_nodes(cells.shape[1] - 1)[rows[:, 1]]]


def is_set(values: NDArray, ends: Shape) -> bool:
    """Return whether values are ascending rows of integers from 0 to below `ends`."""
    if values.dtype.kind not in "iu":
        return False
    try:
        numbers = np.ravel_multi_index(tuple(values.reshape(-1, len(ends)).T), ends)
    except (TypeError, ValueError):
        return False
    return bool((np.diff(numbers) > 0).all())


def area_vectors(mesh: Mesh, rows: Ints) -> Floats:
    """Return the outward area vectors of facets (K, 2), (K, n), mm2 (in 2-D mm)."""
    return area_normals(mesh.points[facet_triples(mesh.cells, rows)])


def nodes_of(mesh: Mesh, rows: Ints) -> Ints:
    """Return the nodes of a facet set, (P,) int64, ascending."""
    return np.unique(facet_triples(mesh.cells, rows))


def boundary_rows(mesh: Mesh) -> Ints:
    """Return all facets that belong to only one cell, (B, 2) int64, ascending."""
    shared = facets(mesh.cells)
    return np.argwhere(shared.n_cells[shared.of_cell] == 1)


def standard_sets(
    mesh: Mesh,
    box: Box | None = None,
    labels: NDArray[np.integer] | None = None,
    names: Names | None = None,
    own: Mapping[str, Ints] | None = None,
) -> Sets:
    """Return the standard sets of a mesh.

    Parameters
    ----------
    mesh : Mesh
    box : Box, optional
        The box of the meshed image; each pair of faces is named after the world axis of its index
        axis (`tetopt.geometry.box.world_axes`): "left" is the side of smaller x in RAS+. By default
        the axis-aligned bounding box of the mesh.
    labels : (M,) integers, optional
        Label of each cell.
    names : mapping of label to text, optional
        Names of labels.
    own : mapping of (K, 2) int64, optional
        The mesh's own sets of facets; they replace sides defined by the extent of the mesh.

    Returns
    -------
    Sets
        Facets "boundary", "left", "right", "posterior", "anterior", "inferior", "superior" (in 2-D
        "x_min", "x_max", "y_min", "y_max"), and, with a box, "mask_surface" for the boundary off
        its faces; sets without facets are omitted. A side is the boundary on that face of the box;
        if there is none, as on an organ within the box, it is the set of facets in the outermost
        tenth of the mesh along the world axis that mainly face in this direction. With labels, the
        result includes `label_sets`.

    Raises
    ------
    InputError
        Labels are not one whole number from 0 for each cell.
    """
    boundary = boundary_rows(mesh)
    faces = face_sets(mesh, boundary, box)
    for name, rows in _extent_sets(mesh, boundary).items():
        if len(faces[name]) == 0:
            faces[name] = (own or {}).get(name, rows)
    named = {BOUNDARY_SET: boundary, **faces}
    of_labels = Sets({}, {}) if labels is None else label_sets(mesh, labels, names or {})
    return Sets(
        {name: rows for name, rows in named.items() if len(rows)} | of_labels.facets,
        of_labels.cells,
    )


def label_sets(mesh: Mesh, labels: NDArray[np.integer], names: Names) -> Sets:
    """Return the cells of each label, and the facets between two labels, as rows of cells with the
    smaller label.

    They are named "label_1", ..., "interface_1_2", ..., or after the names of labels: see
    `label_set_names` and `interface_names`.

    Raises
    ------
    InputError
        Labels are not one whole number from 0 for each cell.
    """
    labels = _check_labels(labels, mesh)
    of_label = label_set_names(np.unique(labels).tolist(), names)
    facet_rows = _interfaces(mesh, labels)
    of_pair = interface_names(facet_rows, of_label)
    return Sets(
        {of_pair[pair]: rows for pair, rows in facet_rows.items()},
        {name: np.flatnonzero(labels == label) for label, name in of_label.items()},
    )


def label_set_names(labels: Iterable[int], names: Names) -> dict[int, str]:
    """Return the name of each label's set of cells: the label's name in letters that all formats
    support, or "label_5".

    All names differ by more than case and do not depend on which labels of `names` are present: if
    two would be equal, or one is the name of another set, the label's number is appended.

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
        name = plain.get(label, "")
        default = f"label_{label}"
        if name.lower() == default:
            name = default
        elif name and (counts[name.lower()] > 1 or RESERVED_NAME.fullmatch(name)):
            name = f"{name[: MOST_LETTERS - 1 - len(str(label))]}_{label}"
            name = default if counts[name.lower()] or RESERVED_NAME.fullmatch(name) else name
        of_label[label] = name or default
    return of_label


def _plain_name(name: str) -> str:
    """Reduce a name to letters that all formats support; may be empty."""
    letters = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    joined = re.sub(r"[^A-Za-z0-9-]+", "_", letters).strip("_-")
    return (joined if joined[:1].isalpha() or not joined else f"label_{joined}")[:MOST_LETTERS]


def interface_names(
    pairs: Iterable[tuple[int, int]], of_label: Names
) -> dict[tuple[int, int], str]:
    """Return the names of interfaces between labels: "interface_liver_spleen", or by number
    "interface_1_5".

    `of_label` is the result of `label_set_names`. Numbers are used for a label without a name, and
    if the names are too long together or the same for two pairs.
    """
    parts = {
        label: str(label) if name == f"label_{label}" else name for label, name in of_label.items()
    }
    named = {(a, b): f"interface_{parts[a]}_{parts[b]}" for a, b in pairs}
    counts = Counter(name.lower() for name in named.values())
    return {
        (a, b): name
        if counts[name.lower()] == 1 and len(name) <= MOST_LETTERS
        else f"interface_{a}_{b}"
        for (a, b), name in named.items()
    }


def face_sets(mesh: Mesh, boundary: Ints, box: Box | None) -> dict[str, Ints]:
    """Return the boundary facets on each face of the box, and, with a box, those on no face."""
    n = mesh.ndim
    if box is None:
        low = mesh.points.min(axis=0)
        high = mesh.points.max(axis=0)
        places = mesh.points
        faces = np.column_stack([low, high])
        tolerance = ON_SIDE_VOXELS * (high - low).max()
        axes = tuple(range(n))
        directions = np.ones(n)
    else:
        inverse = np.asarray(np.linalg.inv(box.affine[:n, :n]), dtype=np.float64)
        places = transform_vectors(mesh.points - box.affine[:n, n], inverse)
        faces = box_sides(box.shape)
        tolerance = ON_SIDE_VOXELS
        axes = world_axes(box.affine)
        directions = box.affine[list(axes), range(n)]
    # (B, n, 2)
    is_on = facets_on_sides(places, facet_triples(mesh.cells, boundary), faces, tolerance)
    sets: dict[str, Ints] = {}
    for name_pair in FACE_NAMES[n]:
        axis = axes.index(FACE_NAMES[n].index(name_pair))
        sides = is_on[:, axis].T if directions[axis] > 0.0 else is_on[:, axis, ::-1].T
        sets |= {name: boundary[side] for name, side in zip(name_pair, sides, strict=True)}
    return (
        sets if box is None else {**sets, MASK_SURFACE_SET: boundary[~np.any(is_on, axis=(1, 2))]}
    )


def _extent_sets(mesh: Mesh, boundary: Ints) -> dict[str, Ints]:
    """Return the boundary facets in the outermost tenth of the mesh along each world axis that face
    this direction.

    No facet belongs to two sides: each faces the direction nearest to its normal.
    """
    low = mesh.points.min(axis=0)
    high = mesh.points.max(axis=0)
    centres = mesh.points[facet_triples(mesh.cells, boundary)].mean(axis=1)
    areas = area_vectors(mesh, boundary)
    fraction = (centres - low) / (high - low)
    faced = np.abs(areas).argmax(axis=1)
    sets = {}
    for axis, (name_low, name_high) in enumerate(FACE_NAMES[mesh.ndim]):
        is_faced = faced == axis
        sets[name_low] = boundary[
            is_faced & (areas[:, axis] < 0.0) & (fraction[:, axis] <= SIDE_DEPTH)
        ]
        sets[name_high] = boundary[
            is_faced & (areas[:, axis] > 0.0) & (fraction[:, axis] >= 1.0 - SIDE_DEPTH)
        ]
    return sets


def _interfaces(mesh: Mesh, labels: Ints) -> dict[tuple[int, int], Ints]:
    """Return the facets between each pair of labels, as rows of cells with the smaller one,
    which comes first.
    """
    shared = facets(mesh.cells)
    of_cell = shared.cells[shared.of_cell]  # (M, n+1, 2)
    own = np.arange(len(mesh.cells))[:, None]
    other = np.where(of_cell[..., 0] == own, of_cell[..., 1], of_cell[..., 0])
    there = np.where(other >= 0, labels[other], -1)
    rows = np.argwhere(there > labels[:, None])
    values, rank = np.unique(labels, return_inverse=True)
    other_rank = np.searchsorted(values, there[rows[:, 0], rows[:, 1]])
    pairs, which = np.unique(
        rank.ravel()[rows[:, 0]] * len(values) + other_rank, return_inverse=True
    )
    ends = np.cumsum(np.bincount(which.ravel(), minlength=len(pairs)))[:-1]
    parts = np.split(rows[np.argsort(which.ravel(), kind="stable")], ends) if len(pairs) else []
    kinds = zip(
        values[pairs // len(values)].tolist(), values[pairs % len(values)].tolist(), strict=True
    )
    return dict(zip(kinds, parts, strict=True))


def _check_labels(labels: ArrayLike, mesh: Mesh) -> Ints:
    array = np.asarray(labels)
    if array.shape != (len(mesh.cells),):
        raise InputError(
            f"labels: expected one for each of {len(mesh.cells)} cells, got shape {array.shape}"
        )
    whole = array.astype(np.int64)
    if (whole != array).any() or whole.min() < 0:
        raise InputError(
            f"labels: expected whole numbers from 0, got {array.min():g} to {array.max():g}"
        )
    return whole


# Sets requested by the user


def with_requested(mesh: Mesh, sets: Sets, requests: Iterable[str], mean: Floats | None) -> Sets:
    """Add requested sets to `sets`.

    Parameters
    ----------
    mesh : Mesh
    sets : Sets
    requests : iterable of str
        "NAME=below:T", the cells of the largest facet-connected set with a mean below T (Fig. 3(f)
        of the paper), and the facets around them, "NAME_surface"; "NAME=point:X,Y,Z:D" and
        "NAME=plane:X,Y,Z:NX,NY,NZ:D", boundary facets with all nodes within D mm of a point, or of
        a plane through a point with a normal; "NAME=facing:NX,NY,NZ:A", those whose outward normal
        is within A degrees of a direction; "NAME=box:X,Y,Z:X,Y,Z", those with all nodes in a box
        between two corners; world mm, RAS+. "NAME=A-B-C", the facets of set A that are in no other
        of these, and "NAME=outer:A-B", "NAME=inner:A-B", its outer or inner connected parts
        (`_is_inner`). "interface_b_a" is "interface_a_b" seen from b. "NAME=A & B", of any of these
        but the first, the facets in all of them.
    mean : (M,) float64, optional
        Mean intensity of each cell.

    Raises
    ------
    InputError
        A request is invalid; its name is in use or not supported by all formats; the mesh has no
        means; a set is empty.
    """
    for text in requests:
        request = parse_set(text, mesh.ndim)
        check_free_names(request, sets)
        if request.kind == "below":
            cells = _cells_below(mesh, request, mean)
            surface = {f"{request.name}_surface": enclosing_facets(mesh, cells)}
            sets = Sets(sets.facets | surface, sets.cells | {request.name: cells})
        else:
            sets = Sets(sets.facets | {request.name: _facets_of(mesh, request, sets)}, sets.cells)
    return sets


class SetRequest(NamedTuple):
    """A set requested by the user."""

    name: str
    kind: str
    vectors: list[Floats]  # the numbers between the colons
    difference: str = ""  # "A-B-C", of sets of facets
    parts: tuple[SetRequest, ...] = ()  # whose facets in common it has

    def names(self) -> tuple[str, ...]:
        """Return the names of the sets that it creates."""
        return (self.name, f"{self.name}_surface") if self.kind == "below" else (self.name,)


def parse_set(text: str, ndim: int) -> SetRequest:
    """Parse a requested set, see `with_requested`.

    Raises
    ------
    InputError
        Invalid words or numbers, or a name that is not supported by all formats.
    """
    name, equals, what = text.partition("=")
    if equals and "&" in what:
        all_of = tuple(parse_set(f"{name}={part.strip()}", ndim) for part in what.split("&"))
        if any(part.kind == "below" for part in all_of):
            raise InputError(f'set {name}: expected sets of facets beside &, got "{what}"')
        return SetRequest(name, "", [], parts=all_of)
    kind, _, rest = what.partition(":")
    shapes = {
        "below": ("T", [1]),
        "point": ("X,Y,Z:D", [ndim, 1]),
        "plane": ("X,Y,Z:NX,NY,NZ:D", [ndim, ndim, 1]),
        "facing": ("NX,NY,NZ:DEGREES", [ndim, 1]),
        "box": ("X,Y,Z:X,Y,Z", [ndim, ndim]),
    }
    is_difference = kind in SIDE_KINDS or (":" not in what and what.strip("- ") != "")
    if not equals or not (kind in shapes or is_difference):
        forms = ", ".join(f"NAME={each}:{form}" for each, (form, _) in shapes.items())
        raise InputError(
            f"set: expected {forms}, NAME=A-B, NAME=outer:A-B, NAME=inner:A-B or NAME=A & B of "
            f'sets A, B, ..., got "{text}"'
        )
    if not SET_NAME.fullmatch(name):
        raise InputError(
            f"set: expected a name of up to {MOST_LETTERS} letters, digits, _ or -, the first a "
            f'letter, got "{name}"'
        )
    if is_difference:
        difference = rest if kind in SIDE_KINDS else what
        if not all(part.strip() for part in difference.split("-")):
            raise InputError(
                f'set {name}: expected names of sets, such as boundary-inlet, got "{difference}"'
            )
        return SetRequest(name, kind if kind in SIDE_KINDS else "", [], difference)
    form, counts = shapes[kind]
    parts = rest.split(":")
    if len(parts) != len(counts):
        raise InputError(f'set {name}: expected {kind}:{form}, got "{rest}"')
    vectors = [_numbers(name, part, count) for part, count in zip(parts, counts, strict=True)]
    if kind not in ("below", "box") and vectors[-1][0] < 0.0:
        what = "an angle" if kind == "facing" else "a distance"
        raise InputError(f"set {name}: expected {what} of 0 or more, got {vectors[-1][0]:g}")
    if kind in ("plane", "facing") and not vectors[-2].any():
        raise InputError(f"set {name}: expected a normal other than 0, got 0")
    return SetRequest(name, kind, vectors)


def enclosing_facets(mesh: Mesh, cells: Ints) -> Ints:
    """Return the facets that enclose some cells, as rows of these cells, (K, 2) int64."""
    part = Mesh(mesh.points, mesh.cells[cells])
    rows = boundary_rows(part)
    return np.column_stack([cells[rows[:, 0]], rows[:, 1]])


def _facets_of(mesh: Mesh, request: SetRequest, sets: Sets) -> Ints:
    """Return the facets (K, 2) of a request: those of sets, within places, or in all its parts.

    Of an interface and places, these are facets of the interface.
    """
    rows = None
    ordered = sorted(request.parts or (request,), key=lambda part: not part.difference)
    for part in ordered:
        if part.difference:
            of_sets = _of_sets(mesh, part, sets)
            number = (mesh.ndim + 1, 1)
            rows = of_sets if rows is None else rows[np.isin(rows @ number, of_sets @ number)]
        else:
            rows = _facets_within(mesh, part, boundary_rows(mesh) if rows is None else rows)
    assert rows is not None
    if len(rows) == 0:
        raise InputError(f"set {request.name}: its parts have no facet in common")
    return rows


def _of_sets(mesh: Mesh, request: SetRequest, sets: Sets) -> Ints:
    """Return the facets (K, 2) of a difference of sets, or of its outer or inner parts."""
    first, *others = (
        rows_of(mesh, facet_triples(mesh.cells, sets.facets[name])[:, ::-1])
        if is_turned
        else sets.facets[name]
        for name, is_turned in places_in(request, sets)
    )
    number = (mesh.ndim + 1, 1)
    gone = np.concatenate([first[:0] @ number, *(rows @ number for rows in others)])
    rows = first[~np.isin(first @ number, gone)]
    if request.kind and len(rows):
        rows = rows[_is_inner(mesh, rows) == (request.kind == "inner")]
    if len(rows) == 0:
        raise InputError(
            f"set {request.name}: {request.kind or 'the difference'} {request.difference} has no "
            "facet"
        )
    return rows


def places_in(request: SetRequest, sets: Sets) -> list[tuple[str, bool]]:
    """Return `place_of` the sets in "A-B-C"; as a name may contain "-", the longest known ones."""
    parts = request.difference.split("-")
    places = []
    while parts:
        for k in range(len(parts), 0, -1):
            if (place := place_of("-".join(parts[:k]).strip(), sets)) is not None:
                break
        else:
            raise InputError(
                f'set {request.name}: no set of facets begins "{"-".join(parts).strip()}"; the '
                f"mesh has {', '.join(sets.facets)}"
            )
        places.append(place)
        parts = parts[k:]
    return places


def place_of(name: str, sets: Sets) -> tuple[str, bool] | None:
    """Return the set of facets of this name, in any case, and whether it names its labels in the
    other order.
    """
    for known in sets.facets:
        if known.lower() == name.lower():
            return known, False
    interfaces = [each for each in sets.facets if each.startswith(INTERFACE_PREFIX)]
    turned = [each for each in interfaces if name.lower() in map(str.lower, _turned_names(each))]
    if len(turned) > 1:
        raise InputError(
            f'set: "{name}" may be the other side of {" or ".join(turned)}; rename the labels'
        )
    return (turned[0], True) if turned else None


def _turned_names(name: str) -> list[str]:
    """Return the names "interface_b_a" of an interface "interface_a_b", whose labels' names may
    contain "_".
    """
    parts = name.removeprefix(INTERFACE_PREFIX).split("_")
    return [f"{INTERFACE_PREFIX}{'_'.join([*parts[k:], *parts[:k]])}" for k in range(1, len(parts))]


def _is_inner(mesh: Mesh, rows: Ints) -> Bools:
    """Return which facets (K, 2) belong to an inner part: parts are linked by edges (in 2-D by
    nodes).

    The facets of an inner part, such as a lumen or a cavity, closed or open, face its own middle.
    """
    nodes = facet_triples(mesh.cells, rows)
    n = mesh.ndim
    sides = [np.sort(np.delete(nodes, k, axis=1), axis=1) for k in range(n)]
    of_side = np.unique(np.concatenate(sides), axis=0, return_inverse=True)[1].reshape(n, -1).T
    order = np.argsort(of_side.ravel(), kind="stable")
    facet = order // n
    side = of_side.ravel()[order]
    is_same = side[1:] == side[:-1]
    n_parts, part = connected_sets(facet[:-1][is_same], facet[1:][is_same], len(rows))
    centres = mesh.points[nodes].mean(axis=1)
    vectors = area_vectors(mesh, rows)
    areas = np.linalg.norm(vectors, axis=1)
    middle = np.stack(
        [
            np.bincount(part, areas * x, n_parts) / np.bincount(part, areas, n_parts)
            for x in centres.T
        ],
        1,
    )
    outward = ((centres - middle[part]) * vectors).sum(axis=1)
    return np.asarray(np.bincount(part, outward, n_parts)[part] < 0.0)


def check_free_names(request: SetRequest, sets: Sets) -> None:
    """Raise InputError if a requested set has a name that is in use."""
    taken = {other.lower(): other for other in (*sets.facets, *sets.cells)}
    for name in request.names():
        if name.lower() in taken:
            raise InputError(
                f'set: a set "{taken[name.lower()]}" already exists; choose a name other than '
                f'"{name}"'
            )


def _cells_below(mesh: Mesh, request: SetRequest, mean: Floats | None) -> Ints:
    name = request.name
    threshold = float(request.vectors[0][0])
    if mean is None:
        raise InputError(f"set {name}: the mesh has no cell means; give the image (`image`)")
    chosen = largest_component(mesh.cells, mean < threshold)
    if len(chosen) == 0:
        raise InputError(
            f"set {name}: no cell has a mean below {threshold:g}; the lowest is {mean.min():g}"
        )
    return chosen


def _facets_within(mesh: Mesh, request: SetRequest, rows: Ints) -> Ints:
    """Return those of some facets (K, 2) with all nodes near a point, a plane or in a box, or that
    face a direction.
    """
    if len(rows) == 0:
        return rows
    nodes = facet_triples(mesh.cells, rows)
    reach, unit = float(request.vectors[-1][0]), "mm"
    if request.kind == "facing":
        areas, direction = area_vectors(mesh, rows), _unit(request.vectors[0])
        sizes = np.sqrt((areas**2).sum(axis=1))
        cosines = (areas * direction).sum(axis=1) / np.where(sizes > 0.0, sizes, 1.0)
        farthest, unit = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))), "degrees"
    else:
        offset = mesh.points - request.vectors[0]
        if request.kind == "box":
            low, high = np.sort(request.vectors, axis=0)
            distance = np.maximum(low - mesh.points, mesh.points - high).max(axis=1)
            reach = 0.0
        elif request.kind == "point":
            distance = np.sqrt((offset**2).sum(axis=1))
        else:
            distance = np.abs((offset * _unit(request.vectors[1])).sum(axis=1))
        farthest = distance[nodes].max(axis=1)
    if not (farthest <= reach).any():
        raise InputError(
            f"set {request.name}: no facet lies within {reach:g} {unit} of {request.kind}; the "
            f"nearest one lies within {farthest.min():.4g} {unit}"
        )
    return rows[farthest <= reach]


def _unit(vector: Floats) -> Floats:
    """Return a vector of length 1; the squares neither overflow nor vanish."""
    scaled = vector / np.abs(vector).max()
    return np.asarray(scaled / np.linalg.norm(scaled))


def _numbers(name: str, text: str, count: int) -> Floats:
    numbers = finite_numbers(text)
    if len(numbers) != count:
        raise InputError(f'set {name}: expected {count} number{"s" * (count > 1)}, got "{text}"')
    return numbers


def finite_numbers(text: str) -> Floats:
    """Parse comma-separated numbers, float64; empty for any other text, or if one is not finite."""
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        return np.empty(0)
    return numbers if np.isfinite(numbers).all() else np.empty(0)


# Sets that come with a mesh


def rows_of(mesh: Mesh, nodes: Ints) -> Ints:
    """Return the rows (cell, k), ascending, of facets given by their nodes (K, n); others are
    ignored.

    A facet between two cells belongs to the one from which its nodes, oriented as in
    `facet_triples`, point outwards.
    """
    shared = facets(mesh.cells)
    distinct, which = np.unique(
        np.concatenate([shared.nodes, np.sort(nodes, axis=1)]), axis=0, return_inverse=True
    )
    place = np.full(len(distinct), -1)
    place[which.ravel()[: len(shared.nodes)]] = np.arange(len(shared.nodes))
    number, listed = np.unique(place[which.ravel()[len(shared.nodes) :]], return_index=True)
    number, listed = number[number >= 0], nodes[listed[number >= 0]]

    def held_by(cell: Ints) -> Ints:
        return np.column_stack([cell, (shared.of_cell[cell] == number[:, None]).argmax(axis=1)])

    first, second = shared.cells[number].T
    rows = held_by(first)
    # the same orientation
    rolled = [np.roll(listed, k, axis=1) for k in range(1 if mesh.ndim == 2 else 3)]
    faces_out = np.any(
        [(facet_triples(mesh.cells, rows) == each).all(axis=1) for each in rolled], axis=0
    )
    rows = np.where((faces_out | (second < 0))[:, None], rows, held_by(second))
    return rows[np.lexsort(rows.T[::-1])]


def regions_of(labels: Ints | None, sets: Sets, n_cells: int) -> Ints | None:
    """Return the first cell of each cell's region, (M,): cells of one label in the same cell sets;
    None without either.
    """
    columns = [] if labels is None else [labels]
    columns += [np.isin(np.arange(n_cells), rows).astype(int) for rows in sets.cells.values()]
    if not columns:
        return None
    _, first, region = np.unique(
        np.column_stack(columns), axis=0, return_index=True, return_inverse=True
    )
    return first[region.ravel()]


def surviving_sets(before: Mesh, sets: Sets, mesh: Mesh, regions: Ints | None = None) -> Sets:
    """Return the facet sets of the mesh `before` whose facets all exist in `mesh`, as rows of
    `mesh`, and the cell sets if `mesh` kept its regions.

    Facets are the same if their nodes have the same positions. If an optimisation kept the
    boundary, these are the sets on the boundary. `regions` (M,) are the regions of the cells of
    `mesh` (`regions_of`); otherwise the cells change.
    """
    place = {point.tobytes(): number for number, point in enumerate(mesh.points)}
    now = np.array([place.get(point.tobytes(), -1) for point in before.points])
    survivors = {
        name: rows_of(mesh, now[facet_triples(before.cells, rows)])
        for name, rows in sets.facets.items()
    }
    facets = {name: rows for name, rows in survivors.items() if len(rows) == len(sets.facets[name])}
    if regions is None:
        return Sets(facets, {})
    of_cells = {name: np.flatnonzero(np.isin(regions, each)) for name, each in sets.cells.items()}
    return Sets(facets, of_cells)


def free_name(label: str, taken: set[str]) -> str:
    """Return a name like `label` that all formats support and that differs from those taken by
    more than case.
    """
    name = re.sub(r"[^A-Za-z0-9_-]", "_", label)
    stem = (name if name[0].isalpha() else f"set_{name}")[:MOST_LETTERS]
    name = stem
    number = 1
    while name.lower() in taken:
        number += 1
        name = f"{stem[: MOST_LETTERS - 1 - len(str(number))]}_{number}"
    return name


def merged_sets(standard: Sets, own: Sets) -> tuple[Sets, dict[str, str]]:
    """Merge the standard sets with a mesh's own; return also the new names of own sets whose names
    were in use.

    An own set that equals the standard set of the same name is merged with it.
    """
    parts: tuple[dict[str, Ints], ...] = (dict(standard.facets), dict(standard.cells))
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


def box_text(box: Box) -> Json:
    """Return the text for a mesh's `about` that `tetopt.io.vtk.box_in` reads."""
    return {"shape": list(box.shape), "affine": box.affine.tolist()}


def box_of(image: Image) -> Box:
    """Return the box that an image fills."""
    return Box(image.shape, image.affine)
