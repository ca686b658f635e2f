"""Surfaces of labels: cubes, rings and shells whose numbers are known, an independent program's
numbers, slow twins.
"""

from collections import Counter
from itertools import combinations

import numpy as np
import pytest
import pyvista
from label_rows import surface_of
from meshes import both_dimensions, random_affine
from scipy.sparse.csgraph import connected_components
from shapes import OBLIQUE, ball_image, distance, grid, shaped

import tetopt
from tetopt.geometry.simplex import centroids, orient_cells
from tetopt.measure.fidelity import (
    FacetSurface,
    LabelExtent,
    LabelFidelity,
    LabelPieces,
    cell_labels,
    label_fidelity,
    surface_areas,
)
from tetopt.measure.interfaces import (
    area_at_volume,
    label_interfaces,
    smooth_surface,
    voxel_cavities,
    voxel_euler,
)
from tetopt.report.tables import label_differences
from tetopt.start.carve import part_of


def blocky(labels, affine=None):
    """An image of labels, a mesh with a block of cells in each voxel, and the label of each
    cell.
    """
    image = tetopt.Image(labels, affine)
    mesh = tetopt.lattice_mesh(
        image, "criss-cross" if image.ndim == 2 else "five-tet", blocks=image.shape
    )
    return image, mesh, cell_labels(image, mesh)


def rows_of(labels, affine=None):
    return label_interfaces(*blocky(labels, affine))


def labelled(shape, *values):
    """Labels in voxels of 0, by (value, voxels or parts)."""
    labels = np.zeros(shape)
    for value, *parts in values:
        for part in parts:
            labels[part] = value
    return labels


def broken(row):
    return row[6:10]  # edges, those of two labels; nodes, those of two labels


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        (labelled((5, 5, 5), (1, (1, 1, 1), (2, 2, 1))), [(1, 1, 0, 0)] * 2),
        (labelled((5, 5, 5), (1, (1, 1, 1), (2, 2, 2))), [(0, 0, 1, 1)] * 2),
        (labelled((5, 5, 5), (1, (1, 1, 1), (2, 1, 1))), [(0,) * 4] * 2),
        (labelled((5, 5), (1, (1, 1), (2, 2))), [(1, 1, 0, 0)] * 2),
        # a ring of four labels is no ring of two
        (
            labelled((5, 5, 5), (1, (1, 1, 1), (2, 2, 1)), (2, (1, 2, 1))),
            [(0,) * 4, (1, 0, 0, 0), (0,) * 4],
        ),
        (
            labelled((5, 5, 5), (1, (1, 1, 1), (2, 2, 2)), (2, (1, 1, 2))),
            [(1, 0, 0, 0), (0, 0, 1, 0), (0,) * 4],
        ),
        # at a wall of the box two cubes, their background and the outside are three
        (labelled((5, 5, 5), (1, (0, 1, 1), (0, 2, 2))), [(1, 1, 0, 0)] * 2),
        (labelled((2, 2, 1), (1, (0, 0), (1, 1))), [(1, 1, 0, 0)] * 2),
    ],
)
def test_two_cubes_that_share_an_edge_or_a_corner(labels, expected):
    """Of both labels' surfaces."""
    assert [broken(row) for row in rows_of(labels)] == expected


def test_the_outside_is_all_around_two_cubes_alone():
    image, mesh, of_cell = blocky(labelled((1, 4, 4), (1, (0, 1, 1), (0, 2, 2))))
    alone = part_of(mesh, of_cell == 1)
    ones = label_interfaces(image, alone, np.ones(len(alone.cells)))[1]
    assert broken(ones) == (1, 1, 0, 0)


def test_areas_are_those_of_closed_surfaces():
    """With their faces on the box, in the mesh and in the voxels."""
    for row in rows_of(labelled((10, 10, 10), (1, np.s_[:]), (2, np.s_[:, :5]))):
        assert row.area == pytest.approx(400.0)
        assert row.area_ratio == pytest.approx(1.2, abs=0.05)  # nets round edges


def test_a_void_that_the_mesh_leaves_out_is_a_cavity():
    """A shell around a void of the mask, with an island in it; beside it a block with a cavity
    of label 0.
    """
    labels = np.ones((7, 7, 12))
    labels[3, 3, 9] = 0.0
    inside = np.ones(labels.shape, dtype=bool)
    inside[1:6, 1:6, 1:6], inside[3, 3, 3] = False, True
    mask = tetopt.Image(inside)
    image, mesh, of_cell = blocky(labels)
    place = np.rint(image.to_index(centroids(mesh.points, mesh.cells))).astype(int)
    is_in = inside[tuple(place.T)]
    part = part_of(mesh, is_in)
    zero, one = label_interfaces(image, part, of_cell[is_in], mask)
    assert (one.cavities, one.mesh_cavities, zero.cavities, zero.mesh_cavities) == (2, 2, 0, 0)
    assert (one.euler, one.mesh_euler) == (2 * (2 + 2), 2 * (2 + 2))
    rows = label_fidelity(image, part, of_cell[is_in], mask)
    assert [
        (row.label, row.extent.voxels, row.overlap.dice, row.extent.is_lost) for row in rows
    ] == [
        (0, 1, 1.0, False),
        (1, inside.sum() - 1, 1.0, False),
    ]
    lost = label_fidelity(image, part, np.ones(is_in.sum()), mask)[0]
    assert (lost.extent.voxels, lost.extent.is_lost, lost.overlap.dice) == (1, True, 0.0)
    for measure in (label_interfaces, label_fidelity):
        with pytest.raises(tetopt.InputError, match="mask: expected the labels' shape"):
            measure(image, part, of_cell[is_in], tetopt.Image(inside[1:]))


@pytest.mark.parametrize(
    ("kind", "of_inside", "of_background"), [("hole", (4, 1), (6, 1)), ("handle", (0, 0), (2, 1))]
)
def test_euler_numbers(kind, of_inside, of_background):
    """Euler numbers and cavities of a shell and a torus; and of what is around them."""
    _, mask = shaped(kind, OBLIQUE)
    for row, expected in zip(rows_of(mask.data, OBLIQUE), (of_background, of_inside), strict=True):
        assert (row.euler, row.cavities) == (row.mesh_euler, row.mesh_cavities) == expected
        assert broken(row) == (0, 0, 0, 0)


@pytest.mark.parametrize(
    ("hole", "cavities"), [((2, 2, 2), 1), ((1, 1, 1), 0), ((1, 1, 2), 0), ((3, 3, 3), 0)]
)
def test_a_cavity_is_open_where_corners_meet(hole, cavities):
    """A hollow cube with a voxel taken out of a corner: what is within touches what is around,
    in a point.
    """
    inside = np.s_[1:4, 1:4, 1:4]
    row = rows_of(labelled((5, 5, 5), (1, inside), (0, (2, 2, 2), hole)))[1]
    assert (row.cavities, row.mesh_cavities) == (cavities, cavities)
    assert row.euler == row.mesh_euler


@both_dimensions
@pytest.mark.parametrize("seed", range(2))
def test_cells_that_are_voxels_have_their_numbers(n, seed):
    """Random labels, in which everything touches everything at edges and corners."""
    rng = np.random.default_rng(seed)
    rows = rows_of(rng.integers(0, 3, (6, 7, 5)[:n]), random_affine(rng, n))
    assert [row.mesh_euler for row in rows] == [row.euler for row in rows]
    assert [row.mesh_cavities for row in rows] == [row.cavities for row in rows]
    assert len({row.euler for row in rows}) > 1


def naive_counts(cells, of_cell, label):
    """`broken`, found one by one."""
    n = cells.shape[1] - 1
    sets = [set(cell) for cell in cells.tolist()]

    def once(chosen):
        """The facets that one of the cells has alone."""
        counts = Counter(frozenset(f) for cell in chosen for f in combinations(cell, n))
        return [facet for facet, count in counts.items() if count == 1]

    surface = once(cells[of_cell == label].tolist())
    boundary = once(cells.tolist())

    def are_two(parts):
        """How many of these edges or nodes have two labels around, the outside being one."""
        labels = [{of_cell[m] for m, cell in enumerate(sets) if part <= cell} for part in parts]
        is_outer = [any(part <= facet for facet in boundary) for part in parts]
        return sum(len(around) + outer == 2 for around, outer in zip(labels, is_outer, strict=True))

    edges = Counter(frozenset(edge) for facet in surface for edge in combinations(facet, n - 1))
    crowded = [edge for edge, count in edges.items() if count > 2]
    pinched = []
    for node in frozenset().union(*surface):
        own = [facet for facet in surface if node in facet]
        links = [[len(a & b) >= n - 1 for b in own] for a in own]
        if connected_components(np.array(links))[0] > 1:
            pinched.append({node})
    return len(crowded), are_two(crowded), len(pinched), are_two(pinched)


@both_dimensions
def test_edges_and_nodes_against_a_slow_twin(n):
    rng = np.random.default_rng(n)
    image, mesh, of_cell = blocky(rng.integers(0, 3, (5, 4, 3)[:n]))
    of_cell[rng.random(len(of_cell)) < 0.1] = 1  # some that cells of a voxel do not share
    rows = label_interfaces(image, mesh, of_cell)
    twin = [naive_counts(mesh.cells, of_cell, row.label) for row in rows]
    assert [broken(row) for row in rows] == twin
    assert max(row.nonmanifold_edges for row in rows) >= 3


def test_a_ball_of_cells():
    """Area of the polyhedron over that of the nets of the ball's voxels, grown to their volume."""
    sphere = pyvista.Icosphere(radius=12.0, nsub=4)
    points = np.vstack([np.asarray(sphere.points, dtype=np.float64), np.zeros(3)]) + 15.2
    cells = np.column_stack([sphere.regular_faces, np.full(sphere.n_cells, len(points) - 1)])
    mesh = tetopt.Mesh(points, orient_cells(points, cells))
    labels, true = ball_image((32,) * 3, (15.2,) * 3, 12.0), 4 * np.pi * 12.0**2
    background, ball = label_interfaces(labels, mesh, np.ones(len(cells)))
    assert ball.area == pytest.approx(sphere.area, rel=1e-6)
    assert ball.area_ratio == pytest.approx(true / ball.smooth_area, rel=2e-3)
    assert ball.smooth_area == pytest.approx(true, rel=0.005)
    assert (ball.folded, ball.mesh_euler, ball.n_facets) == (0.0, 2, len(cells))
    assert np.isnan([background.area_ratio, background.folded]).all()
    assert (background.area, background.n_facets, background.mesh_euler) == (0.0, 0, 0)


@both_dimensions
def test_small_labels_have_no_ratio(n):
    """Their nets collapse: of a single voxel to nothing."""
    _, cube, voxel = rows_of(labelled((9,) * n, (1, (np.s_[1:7],) * n), (2, (8,) * n)))
    assert cube.area_ratio == cube.area / cube.smooth_area > 1.0
    assert np.isnan(voxel.area_ratio)
    assert voxel.area == pytest.approx(2.0 * n)
    assert voxel.smooth_area < 0.1


@pytest.mark.parametrize("radius", [4.0, 6.0, 9.0])
def test_area_of_smooth_shapes(radius):
    """Balls, rods with round ends, and the disc of a plane in a ball, in voxels of 0.5 mm."""
    middle, axis = np.array([31.3, 31.7, 31.45]), np.array([1.0, 2.0, 3.0]) / 14.0**0.5
    at = grid((64, 64, 64)) - middle
    along = at @ axis
    ball = np.linalg.norm(at, axis=-1) < radius
    rod = np.linalg.norm(at - np.clip(along, -20.0, 20.0)[..., None] * axis, axis=-1) < radius
    affine, round_ends = np.diag([0.5, 0.5, 0.5, 1.0]), np.pi * radius**2
    for inside, area in (ball, round_ends), (rod, round_ends + 10.0 * 2.0 * np.pi * radius):
        nets = smooth_surface(np.pad(inside, 1), affine)
        assert area_at_volume(nets, inside.sum() / 8.0) == pytest.approx(area, rel=0.02)
        assert surface_areas(nets).sum() < 0.98 * area
    plane = smooth_surface(np.pad(along < 0.0, 1), affine)
    off = plane.points[plane.facets].mean(axis=1) - 0.5 * (middle + 1.0)
    is_near = np.linalg.norm(off, axis=-1) < 12.0
    assert surface_areas(plane)[is_near].sum() == pytest.approx(np.pi * 12.0**2, rel=0.02)


def test_a_circle_of_pixels():
    off = distance((40, 40), 19.3, 19.3)
    disc, ring = off < 15.0, np.abs(off - 12.0) < 3.0
    nets = smooth_surface(disc, np.diag([0.5, 0.5, 1.0]))
    assert surface_areas(nets).sum() == pytest.approx(2 * np.pi * 7.5, rel=0.02)
    assert (voxel_euler(disc), voxel_euler(ring), voxel_cavities(ring)) == (2, 0, 0)


def test_the_numbers_of_an_independent_program():
    """Areas, folds and edges as a few lines of numpy and pyvista have them, of random patches of
    three labels.
    """
    rng = np.random.default_rng(7)
    affine = random_affine(rng, 3)
    coarse = rng.integers(0, 3, (4, 4, 4))
    image = tetopt.Image(np.kron(coarse, np.ones((5, 4, 6))), affine)
    mesh = tetopt.lattice_mesh(image, nodes=900)
    # no angle of just 60
    mesh = tetopt.Mesh(mesh.points + rng.normal(0.0, 0.01, mesh.points.shape), mesh.cells)
    of_cell = cell_labels(image, mesh)
    for row in label_interfaces(image, mesh, of_cell):
        cells, points = mesh.cells[of_cell == row.label], mesh.points
        triangles = cells[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
        _, which, count = np.unique(
            np.sort(triangles, axis=1), axis=0, return_inverse=True, return_counts=True
        )
        triangles = triangles[count[which.ravel()] == 1]
        normals = np.cross(*(points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2)))
        area = np.linalg.norm(normals, axis=1)
        sides = {}
        for number, triangle in enumerate(np.sort(triangles, axis=1).tolist()):
            for edge in combinations(triangle, 2):
                sides.setdefault(edge, []).append(normals[number] / area[number])
        cosines = [pair[0] @ pair[1] for pair in sides.values() if len(pair) == 2]
        padded = np.pad((image.data == row.label).astype(np.uint8), 1)
        grid = pyvista.ImageData(dimensions=padded.shape)
        grid.point_data["v"] = padded.ravel(order="F")
        ours = smooth_surface(padded == 1, affine)
        nets = grid.contour_labels(
            scalars="v", smoothing=True, output_mesh_type="triangles", boundary_style="external"
        )
        at = np.asarray(nets.points, dtype=np.float64) @ affine[:3, :3].T
        smooth = surface_areas(FacetSurface(at, nets.faces.reshape(-1, 4)[:, 1:])).sum()
        assert row.area == pytest.approx(area.sum() / 2)
        assert surface_areas(ours).sum() == pytest.approx(smooth, rel=1e-5)
        assert row.smooth_area == area_at_volume(ours, padded.sum() * image.voxel_volume)
        assert row.area_ratio == pytest.approx(area.sum() / 2 / row.smooth_area)
        assert row.folded == pytest.approx(np.mean(np.array(cosines) < 0.5))
        assert row.nonmanifold_edges == sum(len(side) > 2 for side in sides.values()) > 0
        assert row.n_facets == len(triangles)


def test_one_label_a_cell():
    image, mesh, of_cell = blocky(labelled((5, 5, 5), (1, (1, 1, 1))))
    with pytest.raises(tetopt.InputError, match="625 cells"):
        label_interfaces(image, mesh, of_cell[1:])
    with pytest.raises(tetopt.InputError, match="is it a label image"):
        label_interfaces(tetopt.Image(image.data + 0.5), mesh, of_cell)


def test_differences_in_words():
    """Only those that there are, of labels that have cells."""

    def rows(label, pieces, eulers, cavities, n_cells=9, mesh_volume=10.0):
        names = "euler", "mesh_euler", "cavities", "mesh_cavities"
        surface = surface_of(label, **dict(zip(names, (*eulers, *cavities), strict=True)))
        extent = LabelExtent(volume=10.0, mesh_volume=mesh_volume, n_cells=n_cells)
        return LabelFidelity(label, extent, LabelPieces(*pieces), surface=surface)

    each = [
        rows(1, (1, 1), (2, 2), (0, 0)),
        rows(5, (1, 3), (2, 4), (0, 0)),
        rows(6, (2, 1), (4, 6), (0, 2)),
        rows(7, (1, 1), (-2, 2), (0, 0)),
        rows(8, (1, 0), (2, 0), (0, 0), n_cells=0),
        rows(9, (1, 1), (2, 2), (0, 0), mesh_volume=3.8),
        rows(10, (1, 1), (2, 2), (0, 0), mesh_volume=8.1),
    ]
    assert label_differences(each, {5: "liver [left]"}) == [
        "label 5 (liver [left]): 1 hole more",
        "label 6: 2 cavities more",
        "label 7: 2 holes fewer",
    ]
