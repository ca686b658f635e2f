"""Thin labels in meshes: sampled cells, volumes kept by a bias, sheets that are not torn."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_array
from scipy.spatial import ConvexHull
from test_labelling import across_of, lattice

import tetopt
from tetopt.contents.memberships import labels_at, memberships
from tetopt.engine import labelling
from tetopt.engine.fast import BAND_FRACTION, MOST_OFFSET_FRACTION, Run
from tetopt.engine.label_state import FEWEST_CENTRES, PART_CENTRES, SAMPLED_FRACTION, cell_contents
from tetopt.engine.labelling import Contents, label_cells, label_voxels
from tetopt.engine.sliding import fill_offsets
from tetopt.geometry.simplex import volumes
from tetopt.measure.interfaces import label_interfaces

NO_COMPONENTS = [np.array([10**6] * 50)] * 3


def shell_image(size, thickness, radius):
    r = np.linalg.norm(np.indices((size,) * 3) - 0.5 * (size - 1) + 0.13, axis=0)
    return tetopt.Image(1.0 + (r >= radius) + (r >= radius + thickness))


def contact(mesh, of_cell, a, b):
    """Area of the facets between cells of two labels."""
    across = across_of(mesh.cells, len(mesh.points))
    cell, k = np.nonzero((across >= 0) & (of_cell[:, None] == a) & (of_cell[across] == b))
    other = np.array(
        [np.delete(mesh.cells[c], j) for c, j in zip(cell, k, strict=True)], dtype=int
    ).reshape(-1, 3)
    x = mesh.points[other]
    return 0.5 * np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1).sum()


def labels_of(members, index):
    """Rows of labels at index positions."""
    return labels_at(members, index, np.arange(len(index))[:, None], np.ones((1, 1)))[:, 0]


def test_a_place_has_the_label_of_its_smallest_level():
    """As by interpolation of every label's level; at voxels' centres the partition itself."""
    rng = np.random.default_rng(4)
    members = memberships(tetopt.Image(rng.integers(0, 3, (7, 6, 8)).astype(float)))
    index = rng.uniform(0.0, 1.0, (500, 3)) * (np.array([7, 6, 8]) - 1)
    centres = np.argwhere(members.partition >= 0)
    assert np.array_equal(labels_of(members, centres.astype(float)), members.partition.ravel())
    levels = np.array(
        [map_coordinates(members.levels[c], index.T, order=1) for c in members.channel]
    )
    expected = levels.argmin(axis=0)
    # A label is looked for among those of the voxels around; by levels alone another one may be as
    # near.
    is_near = np.array(
        [
            row in members.partition[tuple(slice(int(i), int(i) + 2) for i in at)]
            for row, at in zip(expected, index, strict=True)
        ]
    )
    assert is_near.mean() > 0.95
    assert np.mean(labels_of(members, index)[is_near] == expected[is_near]) > 0.995  # but ties


@pytest.mark.parametrize("shape", [(9, 8), (7, 6, 8)])
def test_cells_among_voxels_of_one_label_have_it_everywhere(shape):
    """Labels at places in cells are those at the same places by themselves, whatever the cells
    are among.
    """
    n, rng = len(shape), np.random.default_rng(6)
    members = memberships(tetopt.Image((np.indices(shape).sum(axis=0) > 9).astype(float)))
    corners = rng.uniform(-0.2, 1.0, (200, 1, n)) * shape + rng.uniform(-1.0, 1.0, (200, n + 1, n))
    cells = np.arange(200 * (n + 1)).reshape(200, n + 1)
    there = labels_at(members, corners.reshape(-1, n), cells, PART_CENTRES[n])
    assert np.array_equal(
        there.ravel(), labels_of(members, (PART_CENTRES[n] @ corners).reshape(-1, n))
    )
    assert 10 < (there != there[:, :1]).any(axis=1).sum() < 180


def test_small_cells_are_filled_by_levels_not_by_centres():
    """A plane that cuts small cells: what they hold of each side is the plane's, not one
    voxel's.
    """
    image = tetopt.Image((np.indices((8, 8, 8))[0] >= 4).astype(float) + 1.0)
    mesh = tetopt.lattice_mesh(image, spacing=1.6)
    members = memberships(image)
    counts = cell_contents(
        image, members, mesh, label_voxels(members.partition, image.spacing, 2)
    ).counts
    size = volumes(mesh.points, mesh.cells)
    assert counts.sum(axis=1) == pytest.approx(size)
    places = PART_CENTRES[3] @ mesh.points[mesh.cells]
    above = (places[:, :, 0] > 3.5).mean(axis=1)  # index -0.5 is the side of the box
    assert counts.toarray()[:, 1] == pytest.approx(above * size)
    assert ((above > 0.0) & (above < 1.0)).any()


@pytest.mark.parametrize("spacing", [1.7, 5.5])
def test_contents_of_cells_are_those_of_a_plain_count(spacing):
    """Cells with many centres hold those, others samples, in their volume; and centres that
    samples hardly show.
    """
    data = np.random.default_rng(3).integers(1, 4, (12, 13, 14)).astype(float)
    data[:6], data[8, 8, 8] = 1.0, 4.0
    image = tetopt.Image(data)
    mesh, members = tetopt.lattice_mesh(image, spacing=spacing), memberships(image)
    voxels = label_voxels(members.partition, image.spacing, 4)
    contents = cell_contents(image, members, mesh, voxels)
    counts = contents.counts
    owner, aim = tetopt.cell_of_voxel(image, mesh), np.zeros(counts.shape)
    n_owned = np.bincount(owner.ravel(), minlength=len(aim))
    is_few = n_owned < FEWEST_CENTRES
    there = labels_at(members, image.to_index(mesh.points), mesh.cells, PART_CENTRES[3])
    share = volumes(mesh.points, mesh.cells) / np.where(is_few, len(PART_CENTRES[3]), n_owned)
    for cell in range(len(aim)):
        for label in there[cell] if is_few[cell] else members.partition[owner == cell]:
            aim[cell, label] += share[cell]
    seen = aim.sum(axis=0)
    for place, label in np.ndenumerate(members.partition):
        if (
            seen[label] < SAMPLED_FRACTION * (members.partition == label).sum()
            and is_few[owner[place]]
        ):
            aim[owner[place], label] += 1.0
    assert is_few.any()
    assert is_few.all() == (spacing < 2.0)
    assert counts.has_sorted_indices
    assert counts.toarray() == pytest.approx(aim, abs=1e-12)
    assert contents.contacts.is_place.sum() == len(np.unique(owner.ravel()[voxels.places]))


def test_labels_have_their_volume_in_cells_of_about_as_many_centres_as_are_counted():
    """Some of these cells have more centres than their volume, others fewer; only the former's
    are counted.
    """
    image = tetopt.Image(np.random.default_rng(1).integers(0, 2, (24, 24, 24)).astype(float))
    mesh, members = tetopt.lattice_mesh(image, spacing=5.9), memberships(image)
    n_owned = np.bincount(tetopt.cell_of_voxel(image, mesh).ravel())
    assert 0.2 < (n_owned < FEWEST_CENTRES).mean() < 0.8
    contents = cell_contents(
        image, members, mesh, label_voxels(members.partition, image.spacing, 2)
    )
    assert contents.counts.sum(axis=1) == pytest.approx(mesh.cell_volumes)


def slab(n, cubes):
    """A lattice with a slab in it: points, cells, those across, sizes, and how much of each cell
    a thin label fills.
    """
    points, cells = lattice(n, cubes)
    middle = points[cells].mean(axis=1)
    is_slab = np.abs(middle[:, 0] - middle[:, 0].mean()) < 1.0
    share = np.where(is_slab, 0.32 + 0.12 * np.sin(7.0 * middle[:, -1]), 0.0)
    return points, cells, across_of(cells, len(points)), volumes(points, cells), share


@pytest.mark.parametrize("n", [2, 3])
def test_a_thin_label_keeps_its_volume(monkeypatch, n):
    """A label that fills a third of the cells of a slab gets a third of these, or none without a
    bias.
    """
    monkeypatch.setattr(labelling, "TENSION_FRACTION", 1e-3)
    points, cells, across, size, share = slab(n, 4)
    counts = csr_array(np.column_stack([(1.0 - share) * size, share * size]))
    kept, lost = (
        label_cells(points, cells, across, Contents(counts), NO_COMPONENTS[:2], keeps)
        for keeps in (True, False)
    )
    aim = (share * size).sum()
    assert size[kept == 1].sum() == pytest.approx(aim, rel=0.35)
    assert (lost == 1).sum() <= 1


@pytest.mark.parametrize("fullest", [0.15, 0.25, 0.35, 0.44])
def test_a_slab_thinner_than_cells_keeps_its_volume(monkeypatch, fullest):
    """A label that fills up to a sixth, or nearly half, of each of its cells: not 1.7 times what
    it fills.
    """
    monkeypatch.setattr(labelling, "TENSION_FRACTION", 1e-3)
    points, cells, across, size, share = slab(3, 6)
    share *= fullest / share.max()
    counts = csr_array(np.column_stack([(1.0 - share) * size, share * size]))
    made = label_cells(points, cells, across, Contents(counts), NO_COMPONENTS[:2])
    assert size[made == 1].sum() / (share * size).sum() == pytest.approx(1.0, abs=0.2)


def test_pairs_that_do_not_touch():
    """Two labels beside a third, and one place where they touch."""
    partition = np.zeros((8, 6, 6), dtype=np.int64)
    partition[3:5], partition[5:] = 1, 2
    voxels = label_voxels(partition, np.ones(3), 3)
    assert voxels.is_apart.tolist() == [
        [False, False, True],
        [False, False, False],
        [True, False, False],
    ]
    assert len(voxels.places) == 0
    partition[3:5, 2, 2] = 2
    voxels = label_voxels(partition, np.ones(3), 3)
    assert voxels.is_apart[0, 2]
    number = np.arange(partition.size).reshape(partition.shape)
    assert voxels.places.tolist() == [number[2, 2, 2], number[3, 2, 2]]


@pytest.mark.full
@pytest.mark.parametrize(("thickness", "percent"), [(3.0, 2.0), (1.5, 8.0)])
def test_a_shell_of_one_cell_is_whole(thickness, percent):
    """Volume, one component, no hole, and hardly any contact of what lies within and without."""
    image = shell_image(36, thickness, 10.0)
    result = tetopt.mesh_image(
        tetopt.content(image, image, weights=[0.0]),
        sizes=tetopt.Sizes(edge_size=8.0, cells_across=1),
        iterations=8,
    )
    volume = 4.0 / 3.0 * np.pi * ((10.0 + thickness) ** 3 - 10.0**3)
    size = volumes(result.mesh.points, result.mesh.cells)
    assert size[result.labels == 2].sum() == pytest.approx(volume, rel=0.01 * percent)
    rows = label_interfaces(image, result.mesh, result.labels)
    assert [row.mesh_euler for row in rows] == [2, 4, 4]  # two spheres around the shell: no hole
    assert contact(result.mesh, result.labels, 1, 3) < 1e-3 * rows[1].area
    assert dict(result.violated) == {}


def meshed_label(inside, nodes, is_flat=True, order=1, keep_volumes=True):
    """The content of one label beside another, its mesh, and how well the label is met."""
    image = tetopt.Image(inside.astype(float))
    content = tetopt.content(image, image, weights=[0.0], keep_volumes=keep_volumes)._replace(
        is_flat=is_flat
    )
    result = tetopt.mesh_image(content, nodes, order=order)
    return content, result, tetopt.label_fidelity(image, result.mesh, result.labels)[1]


def off_surface(content, result):
    """How far nodes between the two labels are off their surface, voxels."""
    n_labels = [
        np.unique(result.labels[(result.mesh.cells == k).any(axis=1)]).size
        for k in range(len(result.mesh.points))
    ]
    at = content.image.to_index(result.mesh.points[np.array(n_labels) == 2]).T
    one, other = (
        map_coordinates(level, at, order=1, mode="nearest") for level in content.memberships.levels
    )
    return 0.5 * np.abs(one - other)


BALL = (
    np.linalg.norm(
        np.indices((40, 28, 28)) - np.array([20, 13.4, 13.4])[:, None, None, None], axis=0
    )
    < 9.0
)


def test_facets_on_a_ball_do_not_cut_it_off():
    """Nodes are off the surface by what facets cut off, and within a band around that place."""
    content, result, fidelity = meshed_label(BALL, 250)
    bound, without, inscribed = meshed_label(BALL, 250, is_flat=False)
    assert np.mean(off_surface(bound, without) < 0.01) > 0.9  # all but a few that cannot get there
    edge = tetopt.quality(result.mesh.points, result.mesh.cells).max_edge
    off = off_surface(content, result)
    assert np.median(off) > 0.05
    assert np.mean(off < (BAND_FRACTION + MOST_OFFSET_FRACTION) * edge) > 0.9
    assert inscribed.mesh_volume / inscribed.volume < 0.955
    assert fidelity.mesh_volume / fidelity.volume == pytest.approx(1.0, abs=0.015)
    assert 1.0 - fidelity.dice < 0.7 * (1.0 - inscribed.dice)


@pytest.mark.parametrize("nodes", [300, 1200])
@pytest.mark.parametrize("radii", [(8.0, 8.0, 8.0), (12.0, 7.0, 6.0)])
def test_a_round_mask_has_its_volume_at_every_size(radii, nodes):
    x = (np.indices((32, 24, 24)) - np.array([15.6, 11.3, 11.4])[:, None, None, None]) / np.array(
        radii
    )[:, None, None, None]
    mask = tetopt.Image(((x**2).sum(axis=0) < 1.0).astype(float))
    mesh = tetopt.mesh_image(tetopt.content(mask, mask=mask), nodes, iterations=10).mesh
    volume = 4.0 / 3.0 * np.pi * np.prod(radii)
    assert volumes(mesh.points, mesh.cells).sum() == pytest.approx(volume, rel=0.015)


def test_offsets_are_the_sagitta_of_facets():
    """On an octahedron around a ball: a facet's mean of the distance to the surface, minus that
    at its corners.
    """
    radius, image = 8.0, tetopt.Image(np.zeros((25, 25, 25)))
    inside = tetopt.Image(
        (np.linalg.norm(np.indices((25,) * 3) - 12.0, axis=0) < radius).astype(float)
    )
    content = tetopt.content(image, mask=inside)
    level = (
        np.linalg.norm(np.indices(content.image.shape) - 0.5 * (content.image.shape[0] - 1), axis=0)
        - radius
    )
    content = content._replace(region=content.region._replace(level=level.astype(np.float32)))
    middle = content.image.to_world(0.5 * (np.array(content.image.shape) - 1.0))
    corners = radius * np.vstack([np.eye(3), -np.eye(3)])
    points = middle + np.vstack([np.zeros((1, 3)), corners])
    cells = np.array([[0, *face] for face in ConvexHull(corners).simplices + 1])
    turned = volumes(points, cells) < 0.0
    cells[turned] = cells[turned][:, [0, 2, 1, 3]]
    state = Run(content, tetopt.Mesh(points, cells), 0.5).state
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
    rod = np.linalg.norm(np.indices((40, 28, 28))[1:] - 13.4, axis=0) < 2.5
    fidelity = meshed_label(rod, nodes)[2]
    assert fidelity.mesh_volume == pytest.approx(fidelity.volume, rel=0.025)


def test_labels_do_not_meet_outside_a_mask():
    """A label whose halves are linked beyond the mask only, around one that separates them
    within.
    """
    partition = np.zeros((9, 6, 6), dtype=np.int64)
    partition[4, :3] = 1
    within = np.where(np.arange(6)[:, None] < 3, partition, -1)
    whole, inside = (label_voxels(rows, np.ones(3), 2) for rows in (partition, within))
    assert [each.tolist() for each in whole.components] == [[306], [18]]
    assert [each.tolist() for each in inside.components] == [[72, 72], [18]]
    assert not inside.is_apart.any()
