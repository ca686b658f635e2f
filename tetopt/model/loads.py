"""Loads as written on a command line: sets that are held or moved, their nodes bonded."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.mesh import Mesh
from tetopt.model.sets import FACE_NAMES, Sets, facet_triples, finite_numbers, nodes_of

MOST_COMPRESSION_PERCENT = 50.0  # a linear step presses no further


class Load(NamedTuple):
    """The nodes of a facet set are displaced by so much, in all directions: 0 holds them."""

    set_name: str
    displacement: NDArray[np.float64]  # (n,) mm


def parse_loads(texts: Iterable[str], mesh: Mesh, sets: Sets) -> tuple[Load, ...]:
    """Loads from words.

    Parameters
    ----------
    texts : iterable of str
        "hold:SET"; "move:SET:X,Y,Z", mm; or "compress:5%", which holds the face of the box with the largest z and moves
        the opposite one towards it by 5 % of the distance between the two, as `tetopt fem` does.
    mesh : Mesh
    sets : Sets

    Raises
    ------
    InputError
        Other words, a set that is not there, or a node that would go two ways.
    """
    loads = tuple(load for text in texts for load in _loads(text, mesh, sets))
    if loads and not any(load.displacement.any() for load in loads):
        raise InputError("load: everything is held and nothing moves; add move:SET:X,Y,Z")
    if len(loads) == 1:
        raise InputError(f'load: nothing but "{loads[0].set_name}" is loaded, and all would move along; add hold:SET')
    is_held = np.zeros(len(mesh.points), dtype=bool)
    for load in loads:
        nodes = nodes_of(mesh, sets.facets[load.set_name])
        if is_held[nodes].any():
            raise InputError(
                f'load: {int(is_held[nodes].sum())} nodes of set "{load.set_name}" are in another loaded set, too, and '
                "cannot go both ways; take sets apart, such as --set NAME=plane:X,Y,Z:NX,NY,NZ:D"
            )
        is_held[nodes] = True
    return loads


class LoadRequest(NamedTuple):
    """A load that a user asks for."""

    kind: str  # "hold", "move" or "compress"
    name: str  # of the set; "" of a compression
    numbers: NDArray[np.float64]  # displacement, mm, or per cent


def parse_load(text: str, ndim: int) -> LoadRequest:
    """A load from words, see `parse_loads`, before any set is looked for.

    Raises
    ------
    InputError
        Other words or numbers.
    """
    kind, _, rest = text.partition(":")
    if kind == "hold":
        return LoadRequest(kind, rest, np.zeros(ndim))
    if kind == "move":
        name, _, vector = rest.rpartition(":")
        numbers = finite_numbers(vector)
        if numbers.shape != (ndim,):
            raise InputError(f'load: expected move:SET: and {ndim} numbers in mm, got "{text}"')
        return LoadRequest(kind, name, numbers)
    if kind == "compress":
        percent = finite_numbers(rest.removesuffix("%"))
        if not rest.endswith("%") or len(percent) != 1 or not 0.0 < percent[0] <= MOST_COMPRESSION_PERCENT:
            limits = f"above 0 and up to {MOST_COMPRESSION_PERCENT:g}"
            raise InputError(f'load: expected compress:P% with P {limits}, got "{text}"')
        return LoadRequest(kind, "", percent)
    raise InputError(f'load: expected compress:5%, hold:SET or move:SET:X,Y,Z, got "{text}"')


def _loads(text: str, mesh: Mesh, sets: Sets) -> list[Load]:
    request = parse_load(text, mesh.ndim)
    if request.kind == "compress":
        return _compression(float(request.numbers[0]), mesh, sets)
    return [Load(known_set(request.name, sets), request.numbers)]


def known_set(name: str, sets: Sets) -> str:
    """The name of a facet set.

    Raises
    ------
    InputError
        There is none of that name.
    """
    if name in sets.facets:
        return name
    if name in sets.cells:
        first = ", ".join(list(sets.facets)[:8])
        raise InputError(f'load: "{name}" is a set of cells; give one of facets, such as {first}')
    similar = [each for each in sets.facets if each.lower() == name.lower()]
    similar = similar or difflib.get_close_matches(name, sets.facets, 1)
    hint = f"did you mean {similar[0]}?" if similar else f"there are {', '.join(sets.facets)}"
    raise InputError(f'load: there is no set of facets "{name}"; {hint}')


def _compression(percent: float, mesh: Mesh, sets: Sets) -> list[Load]:
    low, high = FACE_NAMES[mesh.ndim][-1]
    if missing := [name for name in (low, high) if name not in sets.facets]:
        raise InputError(
            f"load: the mesh has no facets on the box's face {' and '.join(missing)}; give hold:SET and move:SET:X,Y,Z "
            f"of {', '.join(sets.facets)}"
        )
    return [Load(high, np.zeros(mesh.ndim)), Load(low, 0.01 * percent * _across(mesh, sets, low, high))]


def _across(mesh: Mesh, sets: Sets, low: str, high: str) -> NDArray[np.float64]:
    """From one of two parallel faces to the other along their normal, (n,) mm."""
    corners = mesh.points[facet_triples(mesh.cells, sets.facets[low])]
    edges = corners[:, 1:] - corners[:, :1]
    areas = np.cross(edges[:, 0], edges[:, 1]) if mesh.ndim == 3 else edges[:, 0, ::-1] * np.array([1.0, -1.0])
    inward = -areas.sum(axis=0)
    inward /= np.sqrt((inward**2).sum())
    across = mesh.points[nodes_of(mesh, sets.facets[high])[0]] - corners[0, 0]
    return inward * float((across * inward).sum()) + 0.0  # + 0.0: no -0
