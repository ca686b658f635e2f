"""Slow, obvious twins of the package's kernels, in plain Python.

Whatever the contract promises exactly is computed exactly here: with Fractions, or with whole
numbers of any size. Nothing is imported from the package but the size of its fixed-point grid,
which is part of the contract.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations, product
from math import factorial

import numba
import numpy as np

from tetopt.energy.sampling import sampling_grid

IS_COMPILED = not numba.config.DISABLE_JIT


# Linear algebra


def determinant(rows):
    """By expansion along the first row; exact for ints and Fractions."""
    if len(rows) == 1:
        return rows[0][0]
    minors = ([row[:k] + row[k + 1 :] for row in rows[1:]] for k in range(len(rows)))
    return sum((-1) ** k * rows[0][k] * determinant(minor) for k, minor in enumerate(minors))


def sign(x):
    return (x > 0) - (x < 0)


def minus(p, q):
    return [a - b for a, b in zip(p, q, strict=True)]


def dot(p, q):
    return sum(a * b for a, b in zip(p, q, strict=True))


def exactly(points):
    """The rows of a float array as lists of Fractions; no rounding."""
    return [[Fraction(float(x)) for x in row] for row in points]


def signed_volume(corners):
    """Of one simplex, (n+1) rows of n numbers; exact for Fractions."""
    edges = [minus(corner, corners[0]) for corner in corners[1:]]
    return Fraction(determinant(edges)) / factorial(len(edges))


def squared_lengths(corners):
    """Of the edges of one simplex."""
    return [dot(minus(p, q), minus(p, q)) for p, q in combinations(corners, 2)]


def circumcentres(points, cells):
    """Centres of the circumscribed spheres, (M, n) float64; flat cells raise LinAlgError.

    With the edges e_k from the first node as rows, the centre c relative to it solves 2 e_k . c =
    |e_k|^2.
    """
    corners = points[cells]
    edges = corners[:, 1:] - corners[:, :1]
    right = (edges**2).sum(axis=2)
    return corners[:, 0] + np.linalg.solve(2.0 * edges, right[..., None])[..., 0]


# Energies


def E_G_as_printed(points, cells):
    """Eq. (1): 1/(n+1) sum_i x_i^2 |Omega_i| - integral of x^2, the origin at the mean of the
    points; exact.

    The integral of x^2 over a simplex of volume v with the corners c_0 .. c_n is
    v / ((n+1)(n+2)) (|sum of c_k|^2 + sum of |c_k|^2).
    """
    points = exactly(points)
    n = len(points[0])
    origin = [sum(axis) / len(points) for axis in zip(*points, strict=True)]
    points = [minus(p, origin) for p in points]
    star_volume = [Fraction(0)] * len(points)
    integral = Fraction(0)
    for cell in cells:
        corners = [points[a] for a in cell]
        v = signed_volume(corners)
        total = [sum(axis) for axis in zip(*corners, strict=True)]
        integral += v * (dot(total, total) + sum(dot(c, c) for c in corners)) / ((n + 1) * (n + 2))
        for a in cell:
            star_volume[a] += v
    return float(
        sum(dot(p, p) * v for p, v in zip(points, star_volume, strict=True)) / (n + 1) - integral
    )


def E_G_gradient(points, cells):
    """By the complex step, which is exact: E_G is a polynomial of the coordinates."""
    n = points.shape[1]
    gradient = np.zeros_like(points)
    for node, axis in np.ndindex(points.shape):
        x = points.astype(complex)
        x[node, axis] += 1e-30j
        corners = x[cells[(cells == node).any(axis=1)]]
        v = np.linalg.det(corners[:, 1:] - corners[:, :1]) / factorial(n)
        squares = sum(
            ((corners[:, i] - corners[:, k]) ** 2).sum(axis=1)
            for i, k in combinations(range(n + 1), 2)
        )
        gradient[node, axis] = (v * squares).sum().imag / 1e-30 / ((n + 1) * (n + 2))
    return gradient


def volume_and_E_G(corners):
    """Unsigned volume and E_G of one cell, (n+1) rows of n floats; exact up to the last
    rounding.
    """
    corners = exactly(corners)
    n = len(corners) - 1
    v = abs(signed_volume(corners))
    return float(v), float(v * sum(squared_lengths(corners)) / ((n + 1) * (n + 2)))


# Sampling


def ticks(image, points):
    """Nodes on the sampling's fixed-point grid, as whole numbers of 2**-bits voxel, and bits."""
    bits = sampling_grid(image, points).bits
    return [
        [round(Fraction(float(x)) * 2**bits) for x in row] for row in image.to_index(points)
    ], bits


def orientations(corners_of_cells):
    """Sign of each simplex's volume."""
    return [sign(signed_volume(corners)) for corners in corners_of_cells]


def barycentric_functions(corners):
    """For each corner k the affine function (gradient, constant), up to a positive factor its
    barycentric coordinate.

    It is the determinant of the simplex with corner k replaced by the point, times the simplex's
    orientation.
    """
    n = len(corners) - 1

    def value(k, point):
        moved = [point if i == k else corner for i, corner in enumerate(corners)]
        return determinant([minus(corner, moved[0]) for corner in moved[1:]])

    hand = sign(value(0, corners[0]))
    functions = []
    for k in range(n + 1):
        constant = value(k, [0] * n)
        steps = [value(k, [int(d == axis) for d in range(n)]) - constant for axis in range(n)]
        functions.append(([hand * step for step in steps], hand * constant))
    return functions


def holds(functions, point):
    """Whether the point, shifted by (eps^3, eps^2, eps) along the axes (2-D: (eps^2, eps)), is
    inside a simplex.

    A barycentric coordinate that is 0 takes the sign of its change under the shift, the last axis
    first.
    """
    for gradient, constant in functions:
        side = dot(gradient, point) + constant
        for change in reversed(gradient):
            side = side or change
        if side <= 0:
            return False
    return True


def owners(image, mesh):
    """The cells that hold each voxel centre: a list for each voxel, by index. The contract says
    at most one.
    """
    grid_points, bits = ticks(image, mesh.points)
    holders = {voxel: [] for voxel in product(*map(range, image.shape))}
    for number, cell in enumerate(mesh.cells):
        corners = [grid_points[a] for a in cell]
        functions = barycentric_functions(corners)
        ranges = []
        for axis, size in zip(zip(*corners, strict=True), image.shape, strict=True):
            ranges.append(range(max(0, min(axis) >> bits), min(size, (max(axis) >> bits) + 2)))
        for voxel in product(*ranges):
            if holds(functions, [i << bits for i in voxel]):
                holders[voxel].append(number)
    return holders


def cell_of_voxel(image, mesh):
    """`owners` as an array; fails where a voxel centre has two."""
    owner = np.full(image.shape, -1)
    for voxel, cells in owners(image, mesh).items():
        assert len(cells) <= 1, f"voxel {voxel} belongs to the cells {cells}"
        if cells:
            owner[voxel] = cells[0]
    return owner


def moment_sums(image, owner, n_cells, shift):
    """Count, sum of h - shift and sum of its square over each cell, from the cells of the
    voxels; exact inside.
    """
    sums = [[Fraction(0)] * 3 for _ in range(n_cells)]
    for voxel, cell in np.ndenumerate(owner):
        if cell >= 0:
            h = Fraction(float(image.data[voxel])) - Fraction(shift)
            sums[cell] = [s + term for s, term in zip(sums[cell], (1, h, h * h), strict=True)]
    return np.array(sums, dtype=np.float64)


# Topology


def too_long(points, cells, target):
    """Nodes with an edge over sqrt 2 times the mean of the targets at its ends."""
    is_one = [False] * len(points)
    for cell in cells:
        for a, b in combinations(cell, 2):
            length = sum((p - q) ** 2 for p, q in zip(points[a], points[b], strict=True)) ** 0.5
            if length > 2.0**0.5 * (target[a] + target[b]) / 2.0:
                is_one[a] = is_one[b] = True
    return is_one


def stars(cells, n_nodes):
    """The cells of each node, ascending."""
    return [
        [number for number, cell in enumerate(cells) if node in cell] for node in range(n_nodes)
    ]


def facets(cells):
    """From the sorted nodes of each distinct facet to the cells that share it, ascending."""
    shared = {}
    for number, cell in enumerate(cells):
        for left_out in cell:
            shared.setdefault(tuple(sorted(int(a) for a in cell if a != left_out)), []).append(
                number
            )
    return shared


def node_colours(cells, n_nodes):
    """Greedy in node order: the least colour that no node in a common cell already has."""
    colours = {}
    for node in range(n_nodes):
        seen = {colours.get(int(other)) for cell in cells if node in cell for other in cell}
        colours[node] = min(set(range(n_nodes)) - seen)
    return [colours[node] for node in range(n_nodes)]


def components(cells):
    """Number of the facet-connected set of each cell, by flooding from the first cell that has
    none.
    """
    neighbours = {number: set() for number in range(len(cells))}
    for shared in facets(cells).values():
        for one in shared:
            neighbours[one].update(shared)
    number = [-1] * len(cells)
    for first in range(len(cells)):
        if number[first] < 0:
            now = max(number) + 1
            front = [first]
            while front:
                cell = front.pop()
                if number[cell] < 0:
                    number[cell] = now
                    front += neighbours[cell]
    return number


# Cuts


def plane_cut(points, cells, height):
    """From each cell with nodes on both sides (height >= 0, height < 0) to the points where its
    edges cross 0.
    """
    points, height = exactly(points), [Fraction(float(z)) for z in height]
    crossings = {}
    for number, cell in enumerate(cells):
        places = []
        for a, b in combinations(cell, 2):
            if (height[a] >= 0) != (height[b] >= 0):
                fraction = height[a] / (height[a] - height[b])
                places.append(
                    [
                        float((1 - fraction) * p + fraction * q)
                        for p, q in zip(points[a], points[b], strict=True)
                    ]
                )
        if places:
            crossings[number] = places
    return crossings


# The voxel grid


def grid_stiffness(shape, young, element):
    """Dense stiffness of a grid of voxels, nodes at their corners in C order, dofs node by node.

    `element` (2^n, 2^n, n, n) is of modulus 1, its corners as `product((0, 1), repeat=n)`.
    """
    n = len(shape)
    nodes = tuple(s + 1 for s in shape)
    K = np.zeros((int(np.prod(nodes)) * n,) * 2)
    for voxel in np.ndindex(*shape):
        ids = [
            int(np.ravel_multi_index(np.add(voxel, c), nodes)) for c in product((0, 1), repeat=n)
        ]
        for (a, i), (b, k) in product(enumerate(ids), repeat=2):
            K[i * n : i * n + n, k * n : k * n + n] += young[voxel] * element[a, b]
    return K


def interpolation(fine, coarse):
    """Dense linear interpolation from coarse + 1 nodes to fine + 1 on the same length."""
    P = np.zeros((fine + 1, coarse + 1))
    for node in range(fine + 1):
        for other in range(coarse + 1):
            P[node, other] = max(
                Fraction(0), 1 - abs(Fraction(node * coarse, max(fine, 1)) - other)
            )
    return P


def block_means(data, shape):
    """Means over the voxels of a coarser grid on the same box, cut voxels by their fraction;
    exact shares.
    """
    for axis, new in enumerate(shape):
        old = data.shape[axis]
        fractions = np.zeros((new, old))
        for row, column in product(range(new), range(old)):
            low, high = (
                max(Fraction(row * old, new), column),
                min(Fraction((row + 1) * old, new), column + 1),
            )
            fractions[row, column] = max(Fraction(0), high - low) * Fraction(new, old)
        data = np.moveaxis(np.tensordot(fractions, data, axes=(1, axis)), 0, axis)
    return data


# Labels of cells


def faces_of(cells):
    """All simplices of some cells, their nodes as frozensets."""
    return {
        frozenset(map(int, part))
        for cell in cells
        for k in range(len(cell))
        for part in combinations(cell, k + 1)
    }


def euler(simplices):
    return sum((-1) ** (len(simplex) - 1) for simplex in simplices)


def is_disc(shared, n):
    """Whether simplices on the surface of a cell of n + 1 corners are a disc: of facets, with
    Euler number 1.
    """
    walls = [simplex for simplex in shared if len(simplex) == n]
    return all(any(simplex <= wall for wall in walls) for simplex in shared) and euler(shared) == 1


def keeps_topology(cells, labels, cell, label):
    """Of the old label and the new: what a cell shares with it, and with all others and the
    outside, is a disc each.
    """
    n = cells.shape[1] - 1
    outer = [sorted(nodes) for nodes, sides in facets(cells).items() if len(sides) == 1]
    rest = [
        (nodes, own)
        for number, (nodes, own) in enumerate(zip(cells, labels, strict=True))
        if number != cell
    ]
    mine = faces_of([cells[cell]])
    groups = []
    for one in (labels[cell], label):
        groups.append([nodes for nodes, own in rest if own == one])
        groups.append([nodes for nodes, own in rest if own != one] + outer)
    return all(is_disc(mine & faces_of(group), n) for group in groups)


def fans(cells, chosen, face, is_outside):
    """Sets of the chosen cells around a node or edge that hang together by facets around it, or
    by the outside.
    """
    around = [number for number, cell in enumerate(cells) if face <= set(cell.tolist())]
    left = {number for number in around if number in chosen}
    links = []
    for nodes, sides in facets(cells[around]).items():
        if face <= set(nodes):
            sides = [around[i] for i in sides]
            links.append(sides if len(sides) == 2 else [*sides, -1])
    if is_outside and any(-1 in link for link in links):
        left.add(-1)
    count = 0
    while left:
        count, front = count + 1, [left.pop()]
        while front:
            last = front.pop()
            new = {number for link in links if last in link for number in link} & left
            left -= new
            front += new
    return count


def pinched(cells, labels, label):
    """Nodes of each edge and node at which the cells of a label, or all others, are several
    fans.
    """
    own, others = (
        set(np.flatnonzero((labels == label) == is_own).tolist()) for is_own in (True, False)
    )
    at = faces_of(cells[sorted(own)]) & faces_of(cells[sorted(others)])
    faces = [face for face in at if len(face) < cells.shape[1] - 1]
    return {
        face
        for face in faces
        if fans(cells, own, face, False) > 1 or fans(cells, others, face, True) > 1
    }


def nonmanifold(cells, labels):
    """From the nodes of each edge and node that is `pinched` for a label to the labels there."""
    bad = set().union(*(pinched(cells, labels, label) for label in set(labels.tolist())))
    return {
        face: {int(labels[i]) for i, cell in enumerate(cells) if face <= set(cell.tolist())}
        for face in bad
    }


def labelling_energy(voxels, tension, cells, labels):
    """Volume of voxels (M, K) that are not of their cell's label, and tension (M, n+1) of facets
    between labels.
    """
    energy = sum(row.sum() - row[label] for row, label in zip(voxels, labels, strict=True))
    for nodes, sides in facets(cells).items():
        if len(sides) == 2 and labels[sides[0]] != labels[sides[1]]:
            k = next(k for k, node in enumerate(cells[sides[0]]) if node not in nodes)
            energy += tension[sides[0], k]
    return energy


def cheapest_way(cells, costs, sources, ends):
    """Least cost of the cells between the sources and the nearest end, from facet to facet, by
    relaxing all of them.
    """
    way = {number: 0.0 if number in sources else np.inf for number in range(len(cells))}
    pairs = [sides for sides in facets(cells).values() if len(sides) == 2]
    for _ in cells:
        for one, other in [*pairs, *([b, a] for a, b in pairs)]:
            way[other] = min(way[other], way[one] + (0.0 if other in ends else costs[other]))
    return min(way[end] for end in ends)


# Memberships of labels


def distances_across(inside):
    """Of each voxel to the nearest centre of the other kind, cut off at 8."""
    voxels = list(np.ndindex(inside.shape))
    distance = np.zeros(inside.shape)
    for p in voxels:
        others = [
            sum((a - b) ** 2 for a, b in zip(p, q, strict=True))
            for q in voxels
            if inside[q] != inside[p]
        ]
        distance[p] = min(8.0, min(others) ** 0.5)
    return distance


def blurred(values, sigma, is_padded=False):
    """By a Gaussian cut off at 3 sigma; beyond the sides the nearest value goes on, or 0 where
    it is padded.
    """
    reach = int(3.0 * sigma + 0.5)
    weights = [np.exp(-0.5 * (k / sigma) ** 2) for k in range(-reach, reach + 1)]
    for axis, n in enumerate(values.shape):
        result = np.zeros(values.shape)
        for p in np.ndindex(values.shape):
            for k, weight in zip(range(-reach, reach + 1), weights, strict=True):
                i = p[axis] + k
                if 0 <= i < n or not is_padded:
                    q = (*p[:axis], min(max(i, 0), n - 1), *p[axis + 1 :])
                    result[p] += weight / sum(weights) * values[q]
        values = result
    return values


def largest_around(values, reach):
    """The largest value in the cube of voxels at most `reach` away along each axis."""
    result = np.zeros(values.shape)
    for p in np.ndindex(values.shape):
        cube = tuple(slice(max(i - reach, 0), i + reach + 1) for i in p)
        result[p] = max(values[cube].ravel())
    return result


def volume_by_voxels(level, inside, missing, area):
    """Add to blocks of two voxels what their level lacks of the label, and the surface's area,
    voxel by voxel.
    """
    mean, square = level, np.zeros(level.shape)
    for axis, n in enumerate(level.shape):
        filtered = np.zeros(level.shape)
        for p in np.ndindex(level.shape):
            before, after = (
                (*p[:axis], min(max(p[axis] + k, 0), n - 1), *p[axis + 1 :]) for k in (-1, 1)
            )
            filtered[p] = 0.75 * mean[p] + 0.125 * (mean[before] + mean[after])
            square[p] += max(abs(level[p] - level[before]), abs(level[after] - level[p])) ** 2
        mean = filtered
    for p in np.ndindex(level.shape):
        distance = mean[p] / min(max(square[p] ** 0.5, 0.3), 1.0)
        block = tuple(i // 2 for i in p)
        missing[block] += inside[p] - min(max(0.5 - distance, 0.0), 1.0)
        area[block] += abs(distance) < 0.5


def volume_between_centres(level, inside, missing, area):
    """The same by the octants (quadrants) of each cube (square) of voxel centres on both sides
    of the surface.
    """
    corners = list(product((0, 1), repeat=level.ndim))
    for p in np.ndindex(*(n - 1 for n in level.shape)):
        voxels = [tuple(i + j for i, j in zip(p, corner, strict=True)) for corner in corners]
        if len({level[voxel] > 0.0 for voxel in voxels}) == 1:
            continue
        for middle, voxel in zip(corners, voxels, strict=True):
            value, rise = 0.0, np.zeros(level.ndim)
            for corner, at in zip(corners, voxels, strict=True):
                weight = [0.75 if i == j else 0.25 for i, j in zip(corner, middle, strict=True)]
                value += np.prod(weight) * level[at]
                for axis, side in enumerate(corner):
                    rise[axis] += (
                        (2 * side - 1) * np.prod(weight[:axis] + weight[axis + 1 :]) * level[at]
                    )
            slope = max(np.linalg.norm(rise), 0.3)
            distance, block = 2.0 * value / slope, tuple(i // 2 for i in voxel)
            missing[block] += (inside[voxel] - min(max(0.5 - distance, 0.0), 1.0)) / len(corners)
            area[block] += 2.0 * (abs(distance) < 0.5) / (len(corners) * slope)


def volume_missing(level, inside, add_volume):
    """By how much a level is to be lowered in each voxel, so that it has the label's volume
    within 3 voxels.
    """
    blocks = tuple(-(-n // 2) for n in level.shape)
    missing, area = np.zeros(blocks), np.zeros(blocks)
    add_volume(level, inside, missing, area)
    missing, area = blurred(missing, 1.5, True), blurred(area, 1.5, True)
    lowered = np.where(area > 0.01 * 2**level.ndim, missing / np.maximum(area, 1e-3), 0.0)
    result = np.zeros(level.shape)
    for p in np.ndindex(level.shape):  # multilinear between the blocks' centres
        for corner in product((0, 1), repeat=level.ndim):
            weight, q = 1.0, []
            for i, n, c in zip(p, blocks, corner, strict=True):
                at = min(max((i + 0.5) / 2 - 0.5, 0.0), n - 1.0)
                low = int(at)
                weight *= at - low if c else 1.0 - (at - low)
                q.append(min(low + c, n - 1))
            result[p] += weight * lowered[tuple(q)]
    return result


def smooth_level(inside):
    """The level of a label on voxels that are nearly cubes, or of a mask."""
    distance = distances_across(inside)
    sign = np.where(inside, -1.0, 1.0)
    size = distance - 0.5
    least = np.maximum(size - 1.0, 0.05)
    most = np.where(size <= 0.5, 0.95, size + 1.0)
    reach = np.minimum(largest_around(distance * inside, 6), largest_around(distance * ~inside, 6))
    fraction = np.clip((reach - 4.0) / 3.0, 0.0, 1.0)
    level = sign * size
    for _ in range(4):
        fine, broad = (
            (once := blurred(level, sigma)) + blurred(level - once, sigma) for sigma in (1.0, 3.0)
        )
        smooth = fine + fraction * (broad - fine)
        smooth = smooth - volume_missing(smooth, inside, volume_by_voxels)
        level = sign * np.clip(sign * smooth, least, most)
    level = level - volume_missing(level, inside, volume_between_centres)
    level = sign * np.clip(sign * level, least, most)
    return np.clip(level, -6.0, 6.0)


# Sums over blocks


def row_totals(field, block_of_row, ends, totals):
    """Sums of a box of voxels over each plane's blocks of rows and columns, added to `totals`,
    voxel after voxel.
    """
    totals = [[list(row) for row in plane] for plane in totals]
    for p, plane in enumerate(field):
        for r, row in enumerate(plane):
            for k, value in enumerate(row):
                block = next(c for c in range(len(ends) - 1) if ends[c] <= k < ends[c + 1])
                totals[p][block_of_row[r]][block] += float(value)
    return totals


def facet_distance(p, corners):
    """From a point to a segment, or a triangle: at its foot if that is inside, else to the
    nearest edge.
    """
    if len(corners) == 2:
        a, b = corners
        along = b - a
        t = np.clip((p - a) @ along / max(along @ along, 1e-300), 0.0, 1.0)
        return np.linalg.norm(p - a - t * along)
    nearest = min(facet_distance(p, corners[[i, k]]) for i, k in ((0, 1), (1, 2), (2, 0)))
    frame = (corners[1:] - corners[0]).T
    if np.linalg.matrix_rank(frame, tol=1e-7) < 2:
        return nearest
    u, v = np.linalg.lstsq(frame, p - corners[0], rcond=None)[0]
    if min(u, v, 1.0 - u - v) < 0.0:
        return nearest
    return np.linalg.norm(p - corners[0] - frame @ [u, v])
