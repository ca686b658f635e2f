"""Thin labels in meshes: sampled cells, volumes kept by a bias, sheets that are not torn."""

from functools import partial

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_array
from scipy.spatial import ConvexHull
from shapes import ball_image, distance, grid, labels_alone
from test_labelling import across_of, lattice

import tetopt
from tetopt import Image, mesh_image
from tetopt.contents.memberships import labels_at, memberships
from tetopt.engine import labelling
from tetopt.engine.fast import BAND_FRACTION, MOST_OFFSET_FRACTION, Run
from tetopt.engine.label_state import FEWEST_CENTRES, PART_CENTRES, SAMPLED_FRACTION, cell_contents
from tetopt.engine.labelling import Contents, label_cells, label_voxels
from tetopt.engine.sliding import fill_offsets
from tetopt.geometry.simplex import orient_cells, volumes
from tetopt.geometry.topology import facets
from tetopt.measure.interfaces import label_interfaces

NO_COMPONENTS = [np.array([10**6] * 50)] * 3


def contact(mesh, of_cell, a, b):
    """Area of the facets between cells of two labels."""
    sides = facets(mesh.cells)
    is_between = (np.sort(of_cell[sides.cells], axis=1) == (a, b)).all(axis=1)
    x = mesh.points[sides.nodes[is_between & (sides.n_cells == 2)]]
    return 0.5 * np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1).sum()


def labels_of(members, index):
    """Rows of labels at index positions."""
    return labels_at(members, index, np.arange(len(index))[:, None], np.ones((1, 1)))[:, 0]


def test_a_place_has_the_label_of_its_smallest_level():
    """As by interpolation of every label's level; at voxels' centres the partition itself."""
    rng = np.random.default_rng(4)
    members = memberships(Image(rng.integers(0, 3, (7, 6, 8)).astype(float)))
    index = rng.uniform(0.0, 1.0, (500, 3)) * (np.array([7, 6, 8]) - 1)
    centres = np.argwhere(members.partition >= 0)
    assert np.array_equal(labels_of(members, centres.astype(float)), members.partition.ravel())
    of_channel = members.levels[members.channel]
    expected = np.argmin([map_coordinates(each, index.T, order=1) for each in of_channel], axis=0)
    # A label is looked for among those of the voxels around; by levels alone another one may be as
    # near.
    around = np.array(list(np.ndindex(2, 2, 2)))
    i, j, k = (index.astype(int)[:, None] + around).transpose(2, 0, 1)
    is_near = (members.partition[i, j, k] == expected[:, None]).any(axis=1)
    assert is_near.mean() > 0.95
    assert np.mean(labels_of(members, index)[is_near] == expected[is_near]) > 0.995  # but ties


@pytest.mark.parametrize("shape", [(9, 8), (7, 6, 8)])
def test_cells_among_voxels_of_one_label_have_it_everywhere(shape):
    """Labels at places in cells are those at the same places by themselves, whatever the cells
    are among.
    """
    n, rng = len(shape), np.random.default_rng(6)
    members = memberships(Image((np.indices(shape).sum(axis=0) > 9).astype(float)))
    corners = rng.uniform(-0.2, 1.0, (200, 1, n)) * shape + rng.uniform(-1.0, 1.0, (200, n + 1, n))
    cells = np.arange(200 * (n + 1)).reshape(200, n + 1)
    there = labels_at(members, corners.reshape(-1, n), cells, PART_CENTRES[n])
    places = (PART_CENTRES[n] @ corners).reshape(-1, n)
    assert np.array_equal(there.ravel(), labels_of(members, places))
    assert 10 < (there != there[:, :1]).any(axis=1).sum() < 180


def contents_of(image, spacing):
    """A lattice, the memberships of an image of labels, information on their voxels, and what the
    lattice's cells have of them.
    """
    mesh, members = tetopt.lattice_mesh(image, spacing=spacing), memberships(image)
    voxels = label_voxels(members.partition, image.spacing, len(members.labels))
    return mesh, members, voxels, cell_contents(image, members, mesh, voxels)


def test_small_cells_are_filled_by_levels_not_by_centres():
    """A plane that cuts small cells: what they hold of each side is the plane's, not one
    voxel's.
    """
    mesh, _, _, contents = contents_of(Image(1.0 + (np.indices((8, 8, 8))[0] >= 4)), 1.6)
    assert contents.counts.sum(axis=1) == pytest.approx(mesh.cell_volumes)
    places = PART_CENTRES[3] @ mesh.points[mesh.cells]
    above = (places[:, :, 0] > 3.5).mean(axis=1)  # index -0.5 is the side of the box
    assert contents.counts.toarray()[:, 1] == pytest.approx(above * mesh.cell_volumes)
    assert ((above > 0.0) & (above < 1.0)).any()


@pytest.mark.parametrize("spacing", [1.7, 5.5])
def test_contents_of_cells_are_those_of_a_plain_count(spacing):
    """Cells with many centres hold those, others samples, in their volume; and centres that
    samples hardly show.
    """
    data = np.random.default_rng(3).integers(1, 4, (12, 13, 14)).astype(float)
    data[:6], data[8, 8, 8] = 1.0, 4.0
    image = Image(data)
    mesh, members, voxels, contents = contents_of(image, spacing)
    counts = contents.counts
    owner, aim = tetopt.cell_of_voxel(image, mesh), np.zeros(counts.shape)
    n_owned = np.bincount(owner.ravel(), minlength=len(aim))
    is_few = n_owned < FEWEST_CENTRES
    there = labels_at(members, image.to_index(mesh.points), mesh.cells, PART_CENTRES[3])
    share = mesh.cell_volumes / np.where(is_few, len(PART_CENTRES[3]), n_owned)
    for cell in range(len(aim)):
        for label in there[cell] if is_few[cell] else members.partition[owner == cell]:
            aim[cell, label] += share[cell]
    is_missed = aim.sum(axis=0) < SAMPLED_FRACTION * np.bincount(members.partition.ravel())
    for place, label in np.ndenumerate(members.partition):
        if is_missed[label] and is_few[owner[place]]:
            aim[owner[place], label] += 1.0
    assert is_few.any()
    assert is_few.all() == (spacing < 2.0)
    assert counts.has_sorted_indices
    assert counts.toarray() == pytest.approx(aim, abs=1e-12)
    assert contents.contacts.is_place.sum() == len(np.unique(owner.ravel()[voxels.places]))


@pytest.mark.parametrize(
    ("n", "cubes", "fullest", "tolerance"),
    [
        (2, 4, 0.44, 0.35),
        (3, 4, 0.44, 0.35),
        (3, 6, 0.15, 0.2),
        (3, 6, 0.25, 0.2),
        (3, 6, 0.35, 0.2),
        (3, 6, 0.44, 0.2),
    ],
)
def test_a_thin_label_keeps_its_volume(monkeypatch, n, cubes, fullest, tolerance):
    """A label that fills up to a sixth, or nearly half, of each of the cells of a slab: not 1.7
    times what it fills, and, where it fills a third of them, none without a bias.
    """
    monkeypatch.setattr(labelling, "TENSION_FRACTION", 1e-3)
    points, cells = lattice(n, cubes)
    size, middle = volumes(points, cells), points[cells].mean(axis=1)
    is_slab = np.abs(middle[:, 0] - middle[:, 0].mean()) < 1.0
    share = np.where(is_slab, 0.32 + 0.12 * np.sin(7.0 * middle[:, -1]), 0.0)
    share *= fullest / share.max()
    contents = Contents(csr_array(np.column_stack([(1.0 - share) * size, share * size])))
    across = across_of(cells, len(points))
    solve = partial(label_cells, points, cells, across, contents, NO_COMPONENTS[:2])
    kept = size[solve(True) == 1].sum() / (share * size).sum()
    assert kept == pytest.approx(1.0, abs=tolerance)
    if cubes == 4:
        assert (solve(False) == 1).sum() <= 1


def test_pairs_that_do_not_touch():
    """Two labels beside a third, and one place where they touch. A label whose halves are linked
    beyond a mask only, around one that separates them within.
    """
    partition = np.zeros((8, 6, 6), dtype=np.int64)
    partition[3:5], partition[5:] = 1, 2
    voxels = label_voxels(partition, np.ones(3), 3)
    apart = np.zeros((3, 3), dtype=bool)
    apart[0, 2] = apart[2, 0] = True
    assert np.array_equal(voxels.is_apart, apart)
    assert len(voxels.places) == 0
    partition[3:5, 2, 2] = 2
    voxels = label_voxels(partition, np.ones(3), 3)
    assert voxels.is_apart[0, 2]
    number = np.arange(partition.size).reshape(partition.shape)
    assert voxels.places.tolist() == [number[2, 2, 2], number[3, 2, 2]]
    partition = np.zeros((9, 6, 6), dtype=np.int64)
    partition[4, :3] = 1
    within = np.where(np.arange(6)[:, None] < 3, partition, -1)
    whole, inside = (label_voxels(rows, np.ones(3), 2) for rows in (partition, within))
    assert [each.tolist() for each in whole.components] == [[306], [18]]
    assert [each.tolist() for each in inside.components] == [[72, 72], [18]]
    assert not inside.is_apart.any()


@pytest.mark.full
@pytest.mark.parametrize(("thickness", "percent"), [(3.0, 2.0), (1.5, 8.0)])
def test_a_shell_of_one_cell_is_whole(thickness, percent):
    """Volume, one component, no hole, and hardly any contact of what lies within and without."""
    r = distance((30,) * 3, *[14.37] * 3)
    image = Image(1.0 + (r >= 8.0) + (r >= 8.0 + thickness))
    sizes = tetopt.Sizes(edge_size=8.0, cells_across=1)
    result = mesh_image(labels_alone(image), sizes=sizes, iterations=8)
    volume = 4.0 / 3.0 * np.pi * ((8.0 + thickness) ** 3 - 8.0**3)
    of_shell = result.mesh.cell_volumes[result.labels == 2].sum()
    assert of_shell == pytest.approx(volume, rel=0.01 * percent)
    rows = label_interfaces(image, result.mesh, result.labels)
    assert [row.mesh_euler for row in rows] == [2, 4, 4]  # two spheres around the shell: no hole
    assert contact(result.mesh, result.labels, 1, 3) < 1e-3 * rows[1].area
    assert dict(result.violated) == {}


def meshed_label(image, nodes, is_flat=True, order=1):
    """The content of one label beside another, its mesh, and how well the label is met."""
    content = labels_alone(image)._replace(is_flat=is_flat)
    result = mesh_image(content, nodes, order=order)
    return content, result, tetopt.label_fidelity(image, result.mesh, result.labels)[1]


def off_surface(content, result):
    """How far nodes between the two labels are off their surface, voxels."""
    is_between = np.intersect1d(*(result.mesh.cells[result.labels == label] for label in (0, 1)))
    at = content.image.to_index(result.mesh.points[is_between]).T
    one, other = (
        map_coordinates(level, at, order=1, mode="nearest") for level in content.memberships.levels
    )
    return 0.5 * np.abs(one - other)


BALL = ball_image((40, 28, 28), (20, 13.4, 13.4), 9.0)


def test_facets_on_a_ball_do_not_cut_it_off():
    """Nodes are off the surface by what facets cut off, and within a band around that place."""
    content, result, fidelity = meshed_label(BALL, 250)
    bound, without, inscribed = meshed_label(BALL, 250, is_flat=False)
    assert np.mean(off_surface(bound, without) < 0.01) > 0.9  # all but a few that cannot get there
    edge = tetopt.quality(result.mesh.points, result.mesh.cells).max_edge
    off = off_surface(content, result)
    assert np.median(off) > 0.05
    assert np.mean(off < (BAND_FRACTION + MOST_OFFSET_FRACTION) * edge) > 0.9
    assert inscribed.extent.mesh_volume / inscribed.extent.volume < 0.955
    assert fidelity.extent.mesh_volume / fidelity.extent.volume == pytest.approx(1.0, abs=0.015)
    assert 1.0 - fidelity.overlap.dice < 0.7 * (1.0 - inscribed.overlap.dice)


@pytest.mark.parametrize("nodes", [300, 1200])
@pytest.mark.parametrize("radii", [(8.0, 8.0, 8.0), (12.0, 7.0, 6.0)])
def test_a_round_mask_has_its_volume_at_every_size(radii, nodes):
    r = np.linalg.norm((grid((32, 24, 24)) - [15.6, 11.3, 11.4]) / radii, axis=-1)
    mask = Image(1.0 * (r < 1.0))
    mesh = mesh_image(tetopt.content(mask, mask=mask), nodes, iterations=10).mesh
    assert mesh.cell_volumes.sum() == pytest.approx(4 / 3 * np.pi * np.prod(radii), rel=0.015)


def test_offsets_are_the_sagitta_of_facets():
    """On an octahedron around a ball: a facet's mean of the distance to the surface, minus that
    at its corners.
    """
    radius, image = 8.0, Image(np.zeros((25, 25, 25)))
    content = tetopt.content(image, mask=ball_image(image.shape, (12.0,) * 3, radius))
    middle = 0.5 * (np.array(content.image.shape) - 1.0)
    level = (distance(content.image.shape, *middle) - radius).astype(np.float32)
    content = content._replace(region=content.region._replace(level=level))
    corners = radius * np.vstack([np.eye(3), -np.eye(3)])
    points = content.image.to_world(middle) + np.vstack([np.zeros((1, 3)), corners])
    cells = np.array([[0, *face] for face in ConvexHull(corners).simplices + 1])
    mesh = tetopt.Mesh(points, orient_cells(points, cells))
    state = Run(content, mesh, 0.5).state
    fill_offsets(state, np.full(7, 100.0))
    u, v = np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 201))
    u, v = u[u + v <= 1.0], v[u + v <= 1.0]
    cut = np.linalg.norm(np.column_stack([u, v, 1.0 - u - v]), axis=1).mean() * radius - radius
    assert state.complex.offset[0] == 0.0
    assert state.complex.offset[1:] == pytest.approx(-cut, rel=0.05)
    fill_offsets(state, np.full(7, 0.2))
    assert state.complex.offset[1:] == pytest.approx(0.2)


def test_corners_of_curved_cells_are_on_the_surface():
    content, result, _ = meshed_label(BALL, 600, order=2)
    assert np.mean(off_surface(content, result) < 0.01) > 0.8


@pytest.mark.parametrize("nodes", [400, 600])
def test_a_thin_rod_has_its_volume(nodes):
    """Cells of its own cannot make up for what facets cut off: nodes off the surface do."""
    rod = np.broadcast_to(distance((28, 28), 13.4, 13.4) < 2.5, (40, 28, 28))
    fidelity = meshed_label(Image(1.0 * rod), nodes)[2]
    assert fidelity.extent.mesh_volume == pytest.approx(fidelity.extent.volume, rel=0.025)
