"""Moduli of cells, averaged over their voxels.

Eq. (2) uses the *mean of the modulus field* over each cell. A mapping from intensity to modulus is
therefore applied to the voxels first, and then averaged; the mapping of the mean intensity differs
from this wherever the mapping is nonlinear and the cell is not uniform.

The arithmetic mean is the modulus of a mixture under uniform strain (Voigt, Annalen der Physik 274,
1889, 573-587), an upper bound; the harmonic mean is the modulus under uniform stress (Reuss, ZAMM
9, 1929, 49-58), a lower bound (Hill, Proc. Phys. Soc. A 65, 1952, 349-354, who averages the two).
Power means lie between them; power 0 is the geometric mean (Lichtenecker, Physikalische Zeitschrift
27, 1926, 115-158).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np

from tetopt.energy.sampling import (
    cell_of_voxel,
    linear_values,
    nearest_values,
    nearest_voxels,
    ranges_of,
    without_gaps,
)
from tetopt.errors import InputError
from tetopt.geometry.quadratic import gauss_rule
from tetopt.geometry.simplex import centroids, volume_gradients, volumes
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.formula import Named
from tetopt.model.mappings import ModulusMapping, finite_values, young_from
from tetopt.system.arrays import Bools, Floats, Ints

DEFAULT_AVERAGE = "gauss"  # of moduli (docs/understand/moduli.md); the paper's figures keep Eq. (2)
# in absolute value; beyond it a power mean is almost the largest or the smallest value
LARGEST_POWER = 10.0
VOXELS_PER_CHUNK = 2**20  # whose positions in their cells are computed at once, 100 MB
# along an edge of a cell, for the average "linear": of cells 6 voxels wide or wider, whose values
# have 2,600 places in a tetrahedron
MOST_PLACES = 24
EMPTY_FRACTION = 0.02  # of the cells: a note on more without a voxel

Images = Image | Mapping[str, Image]  # the image, or those that a formula names, without gaps


class Average(NamedTuple):
    """A way to average several moduli; returned by `parse_average`."""

    words: str  # as a user writes it
    # of the power mean; None: Hill's average, halfway between the powers 1 and -1
    power: float | None
    # one average per cell, per node, or per Gauss point of a cell; or per cell, linear in between
    # voxel centres
    place: Literal["cells", "nodes", "gauss", "linear"] = "cells"


AVERAGES = {
    each.words: each
    for each in (
        Average("mean", 1.0),
        Average("geometric", 0.0),
        Average("harmonic", -1.0),
        Average("hill", None),
        Average("gauss", 0.0, "gauss"),
        Average("nodes", 0.0, "nodes"),
        Average("linear", 1.0, "linear"),
    )
}


def parse_average(text: str) -> Average:
    """Parse an average.

    Parameters
    ----------
    text : str
        "mean" (Eq. (2), Voigt; power 1), "geometric" (power 0), "harmonic" (Reuss; power -1),
        "power:P" with P from -10 to 10, "hill" (halfway between mean and harmonic), "gauss"
        (geometric around each Gauss point of a cell), "nodes" (geometric around each node, and
        linear between nodes) or "linear" (the mean of the image linear between voxel centres).

    Raises
    ------
    InputError
        The text has another form.

    Examples
    --------
    >>> parse_average("power:-0.5").power
    -0.5
    """
    text = text.strip()
    if text in AVERAGES:
        return AVERAGES[text]
    word, _, number = text.partition(":")
    try:
        power = float(number) if word == "power" else np.nan
    except ValueError:
        power = np.nan
    if not abs(power) <= LARGEST_POWER:
        raise InputError(
            f"average: expected {', '.join(AVERAGES)}, or power:P with P from {-LARGEST_POWER:g} "
            f'to {LARGEST_POWER:g}, such as power:0.5, got "{text}"'
        )
    return Average(f"power:{power:g}", power)


def young_image(image: Image, mapping: ModulusMapping) -> Image:
    """Return the modulus field, kPa: `young_from` of every voxel, with the affine of the image.

    It can be meshed instead of the image, so that the cells follow the moduli.

    Raises
    ------
    InputError
        For the reasons of `young_from`.
    """
    return Image(young_from(mapping, image.data), image.affine)


def cell_young(
    image: Images, mesh: Mesh, mapping: ModulusMapping = None, average: str = "mean"
) -> Floats:
    """Return the modulus of each cell, (M,) float64, kPa: an average of the modulus field over it.

    Parameters
    ----------
    image : Image, or dict of str to Image
        The source of intensities, or of all values that a formula names, on any grids. Of several
        images, the average is over the voxels of the finest (least volume of a voxel, then the
        first name), at whose centres the others are linear.
    mesh : Mesh
    mapping : callable, (K, 2) table or None
        From intensity, or for several images a `tetopt.model.formula.Formula`, to kPa, see
        `tetopt.model.mappings.mapped_values`.
    average : str
        See `parse_average`. "mean" is Eq. (2). "nodes" gives the mean of `node_young` over the
        cell's corners, and thus over the cell; "gauss" gives the geometric mean. "linear" is
        Eq. (2) for images that are linear between voxel centres, by the rule of `_linear_means`.

    A cell without a voxel centre gets the modulus at its centroid, see
    `tetopt.energy.sampling.cell_moments`. Every average lies within the range of the cell's voxels;
    if their moduli are equal, it is exactly that modulus.

    Raises
    ------
    InputError
        For the reasons of `parse_average`, `young_from` and `tetopt.energy.sampling.cell_of_voxel`;
        a modulus of 0 in the mesh, except for power means with a power above 0.
    """
    parsed = parse_average(average)
    if parsed.place == "nodes":
        return gauss_young(node_young(image, mesh, mapping), mesh, 1)[:, 0]
    if parsed.place == "linear":
        return _linear_means(image, mesh, lambda values: young_from(mapping, values))
    field, owner = _moduli(image, mesh, mapping, parsed)
    return _of_cells(field, mesh, owner, parsed.power)


def cell_values(
    image: Images, mesh: Mesh, mapping: ModulusMapping, *, is_linear: bool = False
) -> Floats:
    """Return the mean over each cell of another quantity, such as Poisson's ratio or density; it
    may be negative.

    Images and mapping are as in `cell_young`, the average is "mean", or "linear" if `is_linear`.

    Raises
    ------
    InputError
        For the reasons of `finite_values` and `tetopt.energy.sampling.cell_of_voxel`.
    """
    if is_linear:
        return _linear_means(image, mesh, lambda values: finite_values(mapping, values))
    seen = _see_voxels(image, mesh)
    field = Image(finite_values(mapping, seen.values), seen.affine)
    return _of_cells(field, mesh, seen.owner, 1.0)


def node_young(image: Images, mesh: Mesh, mapping: ModulusMapping = None) -> Floats:
    """Return the modulus of each node, (N,) float64, kPa, for moduli that are linear within cells.

    This is the geometric mean of the voxels in the cells around the node, each weighted by the
    node's hat function at its centre; if no voxel has its centre there, it is the modulus of the
    voxel nearest to the node.

    Raises
    ------
    InputError
        For the reasons of `young_from` and `tetopt.energy.sampling.cell_of_voxel`; a modulus of 0
        in the mesh.
    """
    field, owner = _moduli(image, mesh, mapping, parse_average("nodes"))
    n_nodes = len(mesh.points)
    weight = np.zeros(n_nodes)
    total = np.zeros(n_nodes)
    for voxels, hats in _places(field, mesh, owner):
        nodes = mesh.cells[owner[voxels]].ravel()
        logarithms = np.log(field.data.ravel()[voxels])[:, None]
        weight += np.bincount(nodes, hats.ravel(), minlength=n_nodes)
        total += np.bincount(nodes, (hats * logarithms).ravel(), minlength=n_nodes)
    # Clipped to the range of the surrounding voxels, so that equal moduli stay exact.
    low = np.full(n_nodes, np.inf)
    high = np.full(n_nodes, -np.inf)
    low_of_cell, high_of_cell = ranges_of(owner, field.data.ravel(), len(mesh.cells))
    for corner in mesh.cells.T:
        np.minimum.at(low, corner, low_of_cell)
        np.maximum.at(high, corner, high_of_cell)
    is_empty = weight <= 0.0
    young = np.clip(np.exp(total / np.where(is_empty, 1.0, weight)), low, high)
    young[is_empty] = nearest_values(field, mesh.points[is_empty])
    return young


def element_young(
    image: Images, mesh: Mesh, mapping: ModulusMapping = None, average: str = "mean", order: int = 1
) -> Floats:
    """Return moduli for `tetopt.fem.elasticity.stiffness`: `cell_young` (M,), or at Gauss points
    (M, Q), kPa.

    Moduli at Gauss points are returned for "nodes", see `gauss_young`, and for "gauss" with order
    2. There each Gauss point lies near one corner and has the geometric mean of the cell's voxels
    nearest to that corner in barycentric coordinates, or without any, that of the whole cell. A
    quadratic cell thus has one modulus per corner, independent of its neighbours, as it must be at
    an interface.

    Raises
    ------
    InputError
        For the reasons of `cell_young`.
    """
    parsed = parse_average(average)
    if parsed.place == "nodes":
        return gauss_young(node_young(image, mesh, mapping), mesh, order)
    if parsed.place != "gauss" or order == 1:
        return cell_young(image, mesh, mapping, average)
    field, owner = _moduli(image, mesh, mapping, parsed)
    places, _ = gauss_rule(mesh.ndim, order)
    part = np.full(len(owner), -1)
    for voxels, hats in _places(field, mesh, owner):
        part[voxels] = len(places) * owner[voxels] + np.argmax(hats, axis=1)
    young, is_empty = _averages(field, part, 0.0, len(mesh.cells) * len(places))
    shape = len(mesh.cells), len(places)
    return np.where(
        is_empty.reshape(shape), _of_cells(field, mesh, owner, 0.0)[:, None], young.reshape(shape)
    )


def gauss_young(node_young: Floats, mesh: Mesh, order: int) -> Floats:
    """Interpolate nodal moduli (N,), kPa, to the Gauss points (M, Q) of cells of the given order.

    Moduli are linear within a cell, like temperature-dependent moduli in Abaqus and CalculiX.
    """
    places, _ = gauss_rule(mesh.ndim, order, mesh.midpoints is not None)
    corners = node_young[mesh.cells]
    # Clipped to their range, so that equal moduli stay exact.
    low = corners.min(axis=1, keepdims=True)
    high = corners.max(axis=1, keepdims=True)
    return np.clip(np.einsum("qa,ca->cq", places, corners), low, high)


def finest_of(images: Mapping[str, Image]) -> str:
    """Return the name of the image of the least volume of a voxel, the first of equal ones."""
    return min(sorted(images), key=lambda name: images[name].voxel_volume)


class _Seen(NamedTuple):
    """What mappings are applied to, on the voxels of one grid."""

    values: Floats | Named  # in the grid's shape
    affine: Floats
    owner: Ints  # (V,) the cell of each voxel, -1 outside


def _see_voxels(image: Images, mesh: Mesh) -> _Seen:
    """Return the values on the voxels of the finest grid, with unused ones replaced.

    Averages use voxels in cells, and those nearest to nodes and centroids, which stand in for cells
    without voxels. All other voxels get the value of a used one, because a mapping need not be
    defined for the air around an organ.
    """
    if isinstance(image, Image):
        grid = image = without_gaps(image, mesh)
    else:
        grid = image[finest_of(image)]
    owner = cell_of_voxel(grid, mesh).ravel()
    is_seen = owner >= 0
    if not is_seen.all():
        for points in (mesh.points, centroids(mesh.points, mesh.cells)):
            is_seen[np.ravel_multi_index(tuple(nearest_voxels(grid, points).T), grid.shape)] = True
    used = np.flatnonzero(is_seen)

    def values(each: Image) -> Any:
        data = each.data.ravel()
        if each.shape != grid.shape or not np.array_equal(each.affine, grid.affine):
            data = np.empty(len(owner))
            for start in range(0, len(used), VOXELS_PER_CHUNK):
                part = used[start : start + VOXELS_PER_CHUNK]
                index = np.stack(np.unravel_index(part, grid.shape), axis=1)
                data[part] = linear_values(each, grid.to_world(index))
        if len(used) < len(data):
            data = np.where(is_seen, data, data[used[0]])
        return data.reshape(grid.shape)

    if isinstance(image, Image):
        return _Seen(values(image), grid.affine, owner)
    return _Seen({name: values(each) for name, each in image.items()}, grid.affine, owner)


def _linear_means(image: Images, mesh: Mesh, mapped: Callable[[Floats | Named], Floats]) -> Floats:
    """Return the mean over each straight cell, (M,), of a mapping of images that are linear between
    voxel centres.

    A cell that is w voxels wide, along the axis of a grid where it is widest, has k places along
    each edge: twice the next whole number above 2 w, at most `MOST_PLACES`.
    """
    images = {"": without_gaps(image, mesh)} if isinstance(image, Image) else image
    width = np.max(
        [
            np.ptp(each.to_index(mesh.points)[mesh.cells], axis=1).max(axis=1)
            for each in images.values()
        ],
        axis=0,
    )
    n_places = np.minimum(2 * np.floor(2.0 * width).astype(np.int64) + 2, MOST_PLACES)
    means = np.empty(len(mesh.cells))
    for k in np.unique(n_places).tolist():
        places = _equal_places(mesh.ndim, k)
        cells = np.flatnonzero(n_places == k)
        n_at_once = max(1, VOXELS_PER_CHUNK // len(places))
        for start in range(0, len(cells), n_at_once):
            part = cells[start : start + n_at_once]
            corners = mesh.points[mesh.cells[part]]
            points = np.einsum("qa,cad->cqd", places, corners).reshape(-1, mesh.ndim)
            values = {name: linear_values(each, points) for name, each in images.items()}
            rows = mapped(values[""] if isinstance(image, Image) else values)
            rows = rows.reshape(len(part), len(places))
            means[part] = np.clip(rows.mean(axis=1), rows.min(axis=1), rows.max(axis=1))
    return means


def _equal_places(n: int, k: int) -> Floats:
    """Return places of equal weight in a simplex, barycentric, (Q, n+1), k along each edge: a
    lattice around the centroid, of the size with which it is exact for quadratic functions.
    """
    lattice = [each for each in product(range(k), repeat=n + 1) if sum(each) == k - 1]
    around = np.array(lattice) - (k - 1) / (n + 1)
    size = np.sqrt(n / ((n + 1) ** 2 * (n + 2)) / (around**2).mean())
    return 1.0 / (n + 1) + size * around


def _places(image: Image, mesh: Mesh, owner: Ints) -> Iterator[tuple[Ints, Floats]]:
    """Yield the numbers (K,) of voxels in the mesh and their cells' hat functions there, (K,
    n+1), in chunks.
    """
    inside = np.flatnonzero(owner >= 0)
    slopes = (
        volume_gradients(mesh.points, mesh.cells) / volumes(mesh.points, mesh.cells)[:, None, None]
    )
    middle = centroids(mesh.points, mesh.cells)
    for start in range(0, len(inside), VOXELS_PER_CHUNK):
        voxels = inside[start : start + VOXELS_PER_CHUNK]
        cell = owner[voxels]
        centres = image.to_world(
            np.stack(np.unravel_index(voxels, image.shape), axis=1).astype(np.float64)
        )
        hats = np.einsum("kai,ki->ka", slopes[cell], centres - middle[cell]) + 1.0 / (mesh.ndim + 1)
        yield voxels, np.maximum(hats, 0.0)  # rounding could give values below 0


def _moduli(
    image: Images, mesh: Mesh, mapping: ModulusMapping, average: Average
) -> tuple[Image, Ints]:
    """Return the modulus field, with unused voxels as in `_see_voxels`, and the cell of each voxel.

    Raises InputError if an average would be 0 because of a single modulus of 0.
    """
    seen = _see_voxels(image, mesh)
    field, owner = Image(young_from(mapping, seen.values), seen.affine), seen.owner
    if average.power is not None and average.power > 0.0:
        return field, owner
    empty = np.flatnonzero((owner >= 0) & (field.data.ravel() == 0.0))
    if len(empty):
        index = np.array(np.unravel_index(empty[0], field.shape))
        place = ", ".join(f"{x:.5g}" for x in field.to_world(index))
        raise InputError(
            f"average: expected moduli above 0 kPa for {average.words}, got 0 in {len(empty)} "
            f"voxels of the mesh, e.g. at ({place}) mm; give empty "
            'space a small modulus, as in `young` "max(3*h, 0.1)", or use `average` mean'
        )
    return field, owner


def _of_cells(field: Image, mesh: Mesh, owner: Ints, power: float | None) -> Floats:
    """Return the average over each cell; a cell without a voxel centre gets the value of the
    voxel at its centroid.
    """
    averages, is_empty = _averages(field, owner, power, len(mesh.cells))
    averages[is_empty] = nearest_values(field, centroids(mesh.points, mesh.cells[is_empty]))
    return averages


def _averages(field: Image, owner: Ints, power: float | None, n_parts: int) -> tuple[Floats, Bools]:
    """Return the power mean, or Hill's average, of the voxels of each part, and whether the part
    has none.

    `owner` holds the number of a part, or -1, for each voxel.
    """
    inside = owner >= 0
    part = owner[inside]
    values = field.data.ravel()[inside].astype(np.float64)
    n_voxels = np.bincount(part, minlength=n_parts)
    ranges = ranges_of(owner, field.data.ravel(), n_parts)
    if power is None:
        averages = 0.5 * sum(_powers(part, values, n_voxels, ranges, each) for each in (1.0, -1.0))
    else:
        averages = _powers(part, values, n_voxels, ranges, power)
    # Clipped to their range, so that a cell of equal values has exactly that value: constants stay
    # one material.
    return np.clip(averages, *ranges), n_voxels == 0


def _powers(
    part: Ints,
    values: Floats,
    n_voxels: Ints,
    ranges: tuple[Floats, Floats],
    power: float,
) -> Floats:
    """Return the power mean of the values of each part, (K,); arbitrary for a part without
    values.
    """
    count = np.maximum(n_voxels, 1)
    if power == 1.0:
        # Summed voxel by voxel. `cell_moments` subtracts sums over rows, and their rounding errors
        # would swamp the soft cells of a field that spans ten orders of magnitude.
        return np.bincount(part, weights=values, minlength=len(count)) / count
    # Ratios to the dominant value, so that powers lie between 0 and 1; minus 1, so that powers near
    # 0 keep their digits in the logarithm.
    largest = ranges[1] if power > 0.0 else ranges[0]
    largest = np.where((n_voxels > 0) & (largest > 0.0), largest, 1.0)
    with np.errstate(divide="ignore"):  # a modulus of 0, allowed for powers above 0
        ratios = np.log(values / largest[part])
        less_one = ratios if power == 0.0 else np.expm1(power * ratios)
        means = np.bincount(part, weights=less_one, minlength=len(count)) / count
        return largest * np.exp(means if power == 0.0 else np.log1p(means) / power)
