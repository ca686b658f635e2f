"""Loads as written on a command line: supports, displacements, pressures, tractions, springs and
gravity, in steps.

Each step is a separate load case from the undeformed state; a load without a step belongs to all
steps. Loads on facets act on their nodes by `facet_weights`, which solvers and writers share, so
that all of them solve the same equations.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from itertools import zip_longest
from typing import NamedTuple

import numpy as np

from tetopt.errors import InputError, Remark, warn
from tetopt.geometry.quadratic import (
    curved_rule,
    quadratic,
    quadratic_facet_nodes,
    shape_slopes,
    shape_values,
)
from tetopt.geometry.topology import facets
from tetopt.mesh import Mesh
from tetopt.model.mappings import MODULUS_UNITS, without_unit
from tetopt.model.sets import (
    BOUNDARY_SET,
    FACE_NAMES,
    Sets,
    area_vectors,
    facet_triples,
    finite_numbers,
    nodes_of,
    place_of,
)
from tetopt.system.arrays import Floats, Ints

# the sum of area vectors of a flat set is at least this fraction of its area
PLANE_FRACTION = 1.0 - 1e-6
SMALL_SIDE = 0.25  # of the area that a mesh shows to a side: a loaded side with less is reported
FACING_DEGREES = 50  # of facets of a suggested set: more than those of steps, at 45
MOST_COMPRESSION_PERCENT = 50.0  # more is beyond a linear step
FREE_WORD = "free"  # a component of move:SET:X,Y,Z that is not prescribed
# By kind: the form of the arguments, the count of numbers (n: one per dimension), and their unit.
LOAD_FORMS = {
    "move": ("SET:X,Y,Z", "n", "mm or free"),
    "pressure": ("SET:P", "1", "kPa"),
    "traction": ("SET:X,Y,Z", "n", "kPa"),
    "spring": ("SET:K", "1", "kPa/mm"),
    "gravity": ("X,Y,Z", "n", "mm/s2"),
}
# of a load's numbers in print, which hides rounding such as in 9.450000000000001
SHOWN_LOAD_DIGITS = 10
FACET_FORCES = ("pressure", "traction", "spring")  # kinds that act on facets from outside


class Load(NamedTuple):
    """One load, of one kind.

    - "displacement": the nodes of the set move by `numbers` (n,), mm; 0 fixes them, NaN leaves a
      component free.
    - "pressure": (1,) kPa, acts inwards on the facets, along their undeformed normals.
    - "traction": (n,) kPa, force per undeformed area along the world's axes.
    - "spring": (1,) kPa/mm, stiffness per area of the set's surroundings, the same in all
      directions.
    - "gravity": (n,) mm/s2, acts on all cells; their materials need a density.

    Parameters
    ----------
    kind : {"displacement", "pressure", "traction", "spring", "gravity"}
        See above.
    set_name : str
        A facet set; "" for gravity.
    numbers : (n,) or (1,) float64
        In the model's units and space.
    step : int
        0: in all steps; 1, 2, ...: in that step only.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> loads = ["hold:inferior", "pressure:superior:0.1"]
    >>> model = tetopt.build_model(mesh, image, young="0.1*h", nu=0.45, loads=loads)
    >>> support, pressure = model.loads
    >>> support.kind, support.set_name, support.numbers.tolist()
    ('displacement', 'inferior', [0.0, 0.0, 0.0])
    >>> pressure.kind, pressure.numbers.tolist()
    ('pressure', [0.1])
    """

    kind: str
    set_name: str
    numbers: Floats
    step: int = 0


def parse_loads(
    texts: Iterable[str], mesh: Mesh, sets: Sets, units: str = "kPa"
) -> tuple[Load, ...]:
    """Parse loads.

    Parameters
    ----------
    texts : iterable of str
        "hold:SET"; "move:SET:X,Y,Z", mm, where a component may be "free"; "compress:5%", which
        fixes the side with the largest z and moves the opposite one towards it by 5 % of the
        distance between the two, as `tetopt fem` does; "pressure:SET:P", kPa, inwards;
        "traction:SET:X,Y,Z", kPa; "spring:SET:K", kPa/mm; "gravity:X,Y,Z", mm/s2. The prefix "2/"
        puts a load into step 2 only; without a prefix it is in all steps. Forces on the same facets
        add up. A unit may follow the numbers in kPa: "pressure:SET:0.2 MPa".
    mesh : Mesh
    sets : Sets
    units : {"kPa", "MPa", "Pa", "GPa"}
        Instead of kPa, of numbers without a unit.

    Raises
    ------
    InputError
        Invalid words or numbers; an unknown set; missing step numbers; a component of a node's
        displacement that is prescribed twice in a step; forces on facets between two cells.

    Warns
    -----
    UserWarning
        A loaded side has less than a quarter of the area that the mesh shows to it, as where the
        image's box cuts off a brain's stem, or lies beside the opposite, loaded side, as the tip of
        a vertebra's spinous process does.
    """
    loads = tuple(load for text in texts for load in _loads(text, mesh, sets, units))
    check_steps(loads)
    for load in loads:
        if load.kind in FACET_FORCES:
            _check_outer(load, mesh, sets)
    for step in range(1, count_of_steps(loads) + 1):
        _check_apart(
            [load for load in in_step(loads, step) if load.kind == "displacement"], mesh, sets
        )
    names = {load.set_name for load in loads}
    for pair in FACE_NAMES[mesh.ndim]:
        sides = [name for name in pair if name in names]
        sides.sort(key=lambda name: float(np.abs(area_vectors(mesh, sets.facets[name])).sum()))
        for name, other in zip_longest(sides, sides[1:]):
            _warn_of_side(name, other, mesh, sets)
    return loads


def count_of_steps(loads: Iterable[Load]) -> int:
    """Return the number of steps: 1 if no load belongs to a single step."""
    return max([1, *(load.step for load in loads)])


def in_step(loads: Iterable[Load], step: int) -> tuple[Load, ...]:
    """Return the loads of a step, from 1: its own and those of all steps."""
    return tuple(load for load in loads if load.step in (0, step))


def check_steps(loads: Iterable[Load]) -> None:
    """Raise InputError if a step number is missing; step 1 may have only the loads of all steps."""
    steps = {load.step for load in loads}
    numbers = sorted(steps | {1} if 0 in steps else steps)[0 in steps :]
    for expected, number in enumerate(numbers, start=1):
        if number != expected:
            raise InputError(
                f"load: some loads are in step {numbers[-1]}, but none in step {expected}; "
                "number steps from 1"
            )


def parse_load(text: str, ndim: int, units: str = "kPa") -> Load:
    """Parse a load, see `parse_loads`, without looking up sets; "compress" is kept as a kind, in
    percent.

    Raises
    ------
    InputError
        Invalid words or numbers.
    """
    step, words = _step_of(text)
    kind, _, rest = words.partition(":")
    if kind == "hold":
        return Load("displacement", rest, np.zeros(ndim), step)
    if kind == "compress":
        percent = finite_numbers(rest.removesuffix("%"))
        if (
            not rest.endswith("%")
            or len(percent) != 1
            or not 0.0 < percent[0] <= MOST_COMPRESSION_PERCENT
        ):
            limits = f"above 0 and up to {MOST_COMPRESSION_PERCENT:g}"
            raise InputError(f'load: expected compress:P% with P {limits}, got "{text}"')
        return Load(kind, "", percent, step)
    if kind not in LOAD_FORMS:
        forms = ", ".join(f"{each}:{form}" for each, (form, _, _) in LOAD_FORMS.items())
        raise InputError(f'load: expected compress:5%, hold:SET, {forms}, got "{text}"')
    form, size, unit = LOAD_FORMS[kind]
    if kind in FACET_FORCES:
        rest, units = without_unit(rest.removesuffix("/mm") if kind == "spring" else rest, units)
        unit = unit.replace("kPa", units)
    name, _, numbers_text = rest.rpartition(":") if "SET" in form else ("", "", rest)
    count = ndim if size == "n" else 1
    numbers = _parse_movement(numbers_text) if kind == "move" else finite_numbers(numbers_text)
    if len(numbers) != count or (kind == "move" and np.isnan(numbers).all()):
        what = f"{count} finite number{'s' * (count > 1)} in {unit}"
        raise InputError(f'load: expected {kind}:{form} with {what}, got "{text}"')
    if kind == "spring" and numbers[0] <= 0.0:
        raise InputError(f'load: expected spring:{form} with a stiffness above 0, got "{text}"')
    if kind in FACET_FORCES:
        numbers = numbers * MODULUS_UNITS[units]
    return Load("displacement" if kind == "move" else kind, name, numbers, step)


def load_words(load: Load, digits: int = 17, units: str = "") -> str:
    """Format a load for `parse_loads`, exactly by default, or with fewer significant digits for
    display; with `units`, numbers of that unit state it.

    Examples
    --------
    >>> load_words(Load("displacement", "left", np.array([0.5, np.nan, 0.0]), 2))
    '2/move:left:0.5,free,0.0'
    >>> load_words(Load("pressure", "left", np.array([0.1 * 3])), SHOWN_LOAD_DIGITS)
    'pressure:left:0.3'
    """
    prefix = f"{load.step}/" if load.step else ""
    if load.kind == "displacement" and (load.numbers == 0.0).all():
        return f"{prefix}hold:{load.set_name}"
    kind = "move" if load.kind == "displacement" else load.kind
    name = "" if load.kind == "gravity" else f"{load.set_name}:"
    numbers = [
        FREE_WORD if np.isnan(number) else repr(float(f"{number:.{digits}g}"))
        for number in load.numbers.tolist()
    ]
    unit = LOAD_FORMS[kind][2].replace("kPa", units) if load.kind in FACET_FORCES and units else ""
    return f"{prefix}{kind}:{name}{','.join(numbers)} {unit}".rstrip()


def _step_of(text: str) -> tuple[int, str]:
    """Return the step, 0 for all, and the text after it."""
    prefix, slash, words = text.partition("/")
    if not slash or ":" in prefix:
        return 0, text
    if not re.fullmatch("[1-9][0-9]{0,3}", prefix):
        raise InputError(
            f'load: expected a step of 1 or more before the slash, as in 2/{words}, got "{text}"'
        )
    return int(prefix), words


def _parse_movement(text: str) -> Floats:
    """Parse comma-separated numbers, NaN for the word free; empty for any other text."""
    parts = [part.strip() for part in text.split(",")]
    is_free = np.array([part == FREE_WORD for part in parts])
    numbers = finite_numbers(
        ",".join("0" if free else part for part, free in zip(parts, is_free, strict=True))
    )
    return np.where(is_free, np.nan, numbers) if len(numbers) else numbers


def _loads(text: str, mesh: Mesh, sets: Sets, units: str) -> list[Load]:
    load = parse_load(text, mesh.ndim, units)
    if load.kind == "compress":
        return _compression(load, mesh, sets)
    return [
        load if load.kind == "gravity" else load._replace(set_name=known_set(load.set_name, sets))
    ]


def known_set(name: str, sets: Sets) -> str:
    """Return the name of the facet set that a load names, in any case, or from an interface's other
    side.

    Raises
    ------
    InputError
        No facet set has this name.
    """
    if (place := place_of(name, sets)) is not None:
        return place[0]
    if name in sets.cells:
        first = ", ".join(list(sets.facets)[:8])
        raise InputError(f'load: "{name}" is a set of cells; give a set of facets, such as {first}')
    similar = difflib.get_close_matches(name, sets.facets, 1)
    hint = f"did you mean {similar[0]}?" if similar else f"known sets are {', '.join(sets.facets)}"
    raise InputError(f'load: no set of facets "{name}"; {hint}')


def _compression(load: Load, mesh: Mesh, sets: Sets) -> list[Load]:
    low, high = FACE_NAMES[mesh.ndim][-1]
    if missing := [name for name in (low, high) if name not in sets.facets]:
        raise InputError(
            f"load: compress moves {low} towards {high}, but the mesh has no facets "
            f"{' or '.join(missing)}; use "
            f"hold:SET and move:SET:X,Y,Z with sets of {', '.join(sets.facets)}"
        )
    push = 0.01 * float(load.numbers[0]) * _across(mesh, sets, low, high)
    return [
        Load("displacement", high, np.zeros(mesh.ndim), load.step),
        Load("displacement", low, push, load.step),
    ]


def _across(mesh: Mesh, sets: Sets, low: str, high: str) -> Floats:
    """Return the vector from the outermost node of one side to that of the opposite, along
    `_upwards`, (n,) mm.
    """
    upwards = _upwards(mesh, sets, low, high)
    bottom, top = (
        (mesh.points[nodes_of(mesh, sets.facets[name])] * upwards).sum(axis=1)
        for name in (low, high)
    )
    return upwards * float(top.max() - bottom.min()) + 0.0  # + 0.0: no -0


def _upwards(mesh: Mesh, sets: Sets, low: str, high: str) -> Floats:
    """Return the direction from one side to the opposite, (n,): the normal of a flat side, else
    the world's axis.
    """
    for name, sign in ((low, -1.0), (high, 1.0)):
        areas = area_vectors(mesh, sets.facets[name])
        total = sign * areas.sum(axis=0)
        size = float(np.sqrt((total**2).sum()))
        if size >= PLANE_FRACTION * float(np.sqrt((areas**2).sum(axis=1)).sum()):
            return np.asarray(total / size)
    return np.eye(mesh.ndim)[-1]


def _warn_of_side(name: str, other: str | None, mesh: Mesh, sets: Sets) -> None:
    """Warn of a side with a small part of the area that the whole mesh shows in its direction, or
    beside the other, larger, loaded one.
    """
    areas = area_vectors(mesh, sets.facets[name])
    total = areas.sum(axis=0)
    size = float(np.sqrt((total**2).sum()))
    if size == 0.0 or BOUNDARY_SET not in sets.facets:
        return
    normal = total / size
    share = size / float(
        np.maximum((area_vectors(mesh, sets.facets[BOUNDARY_SET]) * normal).sum(axis=1), 0.0).sum()
    )
    points = mesh.points[nodes_of(mesh, sets.facets[name])]
    low, high = points.min(axis=0), points.max(axis=0)
    corners = np.stack([mesh.points.min(axis=0), mesh.points.max(axis=0)])
    problems = []
    if share < SMALL_SIDE:
        problems.append(f"has {100.0 * share:.2g} % of the area that the mesh shows to that side")
    if other is not None:
        there = mesh.points[nodes_of(mesh, sets.facets[other])]
        across = np.linalg.svd(normal[None])[2][1:, None]  # (n-1, 1, n), directions
        middle, places = (points.mean(axis=0) * across).sum(axis=2), (there * across).sum(axis=2)
        if (middle < places.min(axis=1, keepdims=True)).any() or (
            middle > places.max(axis=1, keepdims=True)
        ).any():
            problems.append(f'lies beside "{other}"')
            beside = np.stack([there.min(axis=0), there.max(axis=0)])
            corners = np.where(np.abs(normal) < np.abs(normal).max(), beside, corners)
    if problems:
        extent = ", ".join(
            f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=False)
        )
        step = 10.0 ** np.floor(np.log10(np.ptp(corners, axis=0).max()) - 1.0)
        corners = step * np.stack([np.floor(corners[0] / step), np.ceil(corners[1] / step)])
        texts = [",".join(f"{x + 0.0:.4g}" for x in vector) for vector in (normal, *corners)]
        warn(
            f'load: set "{name}" {" and ".join(problems)}: {len(areas)} facets of '
            f"{np.sqrt((areas**2).sum(axis=1)).sum():.4g} mm{mesh.ndim - 1}, {extent} mm; hold or "
            "move a larger set of the same region instead, such as `sets` "
            f'"base=facing:{texts[0]}:{FACING_DEGREES} & box:{texts[1]}:{texts[2]}"',
            Remark,
        )


def _check_outer(load: Load, mesh: Mesh, sets: Sets) -> None:
    rows = sets.facets[load.set_name]
    shared = facets(mesh.cells)
    if inner := int((shared.n_cells[shared.of_cell[rows[:, 0], rows[:, 1]]] > 1).sum()):
        raise InputError(
            f'load: {inner} of the {len(rows)} facets of "{load.set_name}" lie between two '
            "cells, where no external "
            f"{load.kind} can act; use a boundary set, mesh only one side (`mask`), or move the set"
        )


def _check_apart(loads: list[Load], mesh: Mesh, sets: Sets) -> None:
    is_prescribed = np.zeros(mesh.points.shape, dtype=bool)
    for load in loads:
        nodes = nodes_of(mesh, sets.facets[load.set_name])
        components = ~np.isnan(load.numbers)
        twice = (is_prescribed[nodes] & components).any(axis=1)
        if twice.any():
            raise InputError(
                f'load: {int(twice.sum())} nodes of set "{load.set_name}" already have a '
                "prescribed displacement from "
                "another set; use disjoint sets, such as `sets` NAME=plane:X,Y,Z:NX,NY,NZ:D"
            )
        is_prescribed[nodes] |= components


# Forces on facets


def facet_weights(mesh: Mesh, rows: Ints, order: int) -> tuple[Ints, Floats]:
    """Return the nodes of facets and the integrals of their shape functions over the facets, (K, w)
    each.

    These are the nodal weights of a constant traction, mm2 (in 2-D mm, per mm of thickness); see
    Zienkiewicz and Taylor, The Finite Element Method, volume 1, on consistent nodal forces.

    Parameters
    ----------
    mesh : Mesh
    rows : (K, 2) int64
        Facets, see `tetopt.model.sets`.
    order : {1, 2}
        Nodes of order 2 are rows of `tetopt.geometry.quadratic.quadratic`. In 3-D the midpoints of
        a facet's edges get a third of its area each, and the corners nothing; in 2-D the length L
        of an edge is divided by Simpson's rule, L/6, L/6 and 4 L/6 in the middle. For order 1 all
        corners get the same part. Curved facets are integrated with
        `tetopt.geometry.quadratic.curved_rule`.
    """
    if order == 2 and mesh.midpoints is not None:
        nodes, shapes, normals = _curved_facets(mesh, rows)
        return nodes, np.einsum("qa,qk->ka", shapes, np.sqrt((normals**2).sum(axis=2)))
    areas = np.sqrt((area_vectors(mesh, rows) ** 2).sum(axis=1))
    if order == 1:
        nodes = facet_triples(mesh.cells, rows)
        fractions = np.full(mesh.ndim, 1.0 / mesh.ndim)
    else:
        nodes = quadratic_facet_nodes(quadratic(mesh.points, mesh.cells)[1], rows)
        fractions = np.array(
            [0.0] * 3 + [1.0 / 3.0] * 3 if mesh.ndim == 3 else [1.0 / 6.0, 1.0 / 6.0, 4.0 / 6.0]
        )
    return nodes, areas[:, None] * fractions


def _curved_facets(mesh: Mesh, rows: Ints) -> tuple[Ints, Floats, Floats]:
    """Return the nodes (K, w) of curved facets of order 2, shape functions (Q, w) at quadrature
    points, and outward normals (Q, K, n) there, scaled to the area (in 2-D the length) that each
    point represents.
    """
    points, cells = quadratic(mesh.points, mesh.cells, mesh.midpoints)
    nodes = quadratic_facet_nodes(cells, rows)
    places, weights = curved_rule(mesh.ndim - 1)
    normals = np.empty((len(places), len(rows), mesh.ndim))
    for q, (slopes, weight) in enumerate(zip(shape_slopes(places, 2), weights, strict=True)):
        arms = np.einsum("ab,kai->bki", slopes[:, 1:] - slopes[:, :1], points[nodes])
        normals[q] = weight * (
            0.5 * np.cross(*arms) if mesh.ndim == 3 else arms[0, :, ::-1] * (1.0, -1.0)
        )
    return nodes, shape_values(places, 2), normals


def facet_forces(mesh: Mesh, sets: Sets, load: Load, order: int = 1) -> tuple[Ints, Floats]:
    """Return the nodes (P,), ascending, and nodal forces (P, n) of a pressure or traction, mN for a
    load in kPa.

    Nodes with zero weight are omitted.
    """
    rows = sets.facets[load.set_name]
    if load.kind == "pressure" and order == 2 and mesh.midpoints is not None:
        nodes, shapes, normals = _curved_facets(mesh, rows)
        return _sum_rows(
            nodes.ravel(),
            -load.numbers * np.einsum("qa,qki->kai", shapes, normals).reshape(-1, mesh.ndim),
        )
    nodes, weights = facet_weights(mesh, rows, order)
    if load.kind == "pressure":
        areas = area_vectors(mesh, rows)
        stress = -load.numbers * areas / np.sqrt((areas**2).sum(axis=1))[:, None]
    else:
        stress = np.broadcast_to(load.numbers, (len(rows), mesh.ndim))
    forces = weights[:, :, None] * stress[:, None, :]
    return _sum_rows(nodes[weights != 0.0], forces[weights != 0.0])


def spring_constants(mesh: Mesh, sets: Sets, load: Load, order: int = 1) -> tuple[Ints, Floats]:
    """Return the springs to the ground: nodes (P,), ascending, and stiffness (P,), mN/mm for a
    load in kPa/mm.
    """
    nodes, weights = facet_weights(mesh, sets.facets[load.set_name], order)
    which, total = _sum_rows(nodes[weights != 0.0], weights[weights != 0.0][:, None])
    return which, load.numbers[0] * total[:, 0]


def _sum_rows(nodes: Ints, values: Floats) -> tuple[Ints, Floats]:
    """Return the distinct nodes, ascending, and the sum of the rows of each, (P, w)."""
    distinct, which = np.unique(nodes, return_inverse=True)
    columns = [
        np.bincount(which.ravel(), weights=column, minlength=len(distinct)) for column in values.T
    ]
    return distinct, np.stack(columns, axis=1)
