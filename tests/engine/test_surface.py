"""Masks, labels and several contrasts through the whole optimisation."""

from itertools import pairwise

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shapes import OBLIQUE, channels, distance, grid, shaped

import tetopt
from tetopt.contents.content import content
from tetopt.contents.domain import levels
from tetopt.energy.discretization import unexplained_variance
from tetopt.energy.sampling import cell_of_voxel, channel_grid, moment_sums, overlap_of, to_ticks
from tetopt.engine.complex import build
from tetopt.engine.fast import MOST_OFFSET_FRACTION, Run
from tetopt.engine.loop import side_ticks
from tetopt.engine.sliding import level_at, put_on_surface
from tetopt.engine.state import objective_of, sides_of
from tetopt.geometry.check import manifold_problems
from tetopt.geometry.topology import boundary_facets, components
from tetopt.measure.fidelity import cell_labels, label_fidelity, mask_fidelity
from tetopt.start.clip import lattice_within


def times_covered(image, mesh):
    """How many cells hold each voxel centre, told apart by turns of the rows' starting places."""
    unit = tetopt.Image(np.ones(image.shape), image.affine)
    total = tetopt.cell_moments(unit, mesh).n_voxels.sum()
    return total, int((cell_of_voxel(image, mesh) >= 0).sum())


def check(image, mask, mesh, min_dihedral=12.0, is_between=None):
    """The mesh fills the mask. Nodes are off its surface by what facets cut off, so that these lie
    on it on average.

    Nodes `is_between` (N,) labels may be a tenth of a voxel off.
    """
    assert tetopt.check_mesh(mesh, is_whole=False) == []
    total, covered = times_covered(image, mesh)
    assert total == covered  # no voxel in two cells
    if mesh.ndim == 3:
        assert tetopt.quality(mesh.points, mesh.cells).min_dihedral >= min_dihedral - 1e-9
    # Boundary nodes lie on the box's faces or on the surface.
    index = image.to_index(mesh.points)
    outer = np.unique(boundary_facets(mesh.cells))
    on_box = ((index == -0.5) | (index == np.array(image.shape) - 0.5)).any(axis=1)
    around = content(image, mask=mask)  # the mask's own box, on which its level is smoothed
    off = np.abs(
        levels(around.region.level, around.image.to_index(mesh.points[outer[~on_box[outer]]]))
    )
    facets = mesh.points[boundary_facets(mesh.cells)]
    edge = np.linalg.norm(facets[:, 0] - facets[:, 1], axis=1).mean() / image.voxel_volume ** (
        1.0 / image.ndim
    )
    near = np.full(len(mesh.points), MOST_OFFSET_FRACTION * edge) + (
        0.0 if is_between is None else 0.1 * is_between
    )
    assert np.mean(off < near[outer[~on_box[outer]]]) > 0.97
    assert off.max() < 0.7
    is_on_box = on_box[boundary_facets(mesh.cells)].all(axis=1)
    middles = facets[~is_on_box].mean(axis=1)
    of_middles = levels(around.region.level, around.image.to_index(middles)).mean()
    corners = levels(
        around.region.level, around.image.to_index(facets[~is_on_box].reshape(-1, image.ndim))
    ).mean()
    # A quadratic function's mean over a facet is 3/4 of that at its middle and 1/4 of that at its
    # corners; 2/3 in 2-D.
    share = 2.0 / 3.0 if image.ndim == 2 else 0.75
    assert abs(share * of_middles + (1.0 - share) * corners) < 0.03


def hard_E_D(target, mesh):
    """E_D from the voxels, one by one: squares around the cells' means, and those on the wrong
    side of the mask.
    """
    owner = cell_of_voxel(target.image, mesh).ravel()
    is_in = owner >= 0
    squares = 0.0
    for values in channels(target).reshape(target.n_channels, -1).astype(float):
        count = np.maximum(np.bincount(owner[is_in], minlength=len(mesh.cells)), 1)
        mean = np.bincount(owner[is_in], values[is_in], len(mesh.cells)) / count
        squares += ((values[is_in] - mean[owner[is_in]]) ** 2).sum()
    if target.region is not None:
        squares += target.wrong_side * (is_in != target.region.inside.ravel()).sum()
    return squares * target.unit * target.image.voxel_volume


@pytest.mark.full
@pytest.mark.parametrize(
    ("kind", "is_graded"),
    [
        ("ball", True),
        ("hole", True),
        ("handle", True),
        ("sheet", True),
        ("pieces", False),
        ("touching", False),
    ],
)
def test_masks(kind, is_graded):
    image, mask = shaped(kind, OBLIQUE if kind == "ball" else None)
    target = content(image, mask=mask)
    if is_graded:
        result = tetopt.mesh_image(target, 900, iterations=5)
        assert len(result.mesh.points) == pytest.approx(900, rel=0.02)
    else:
        start = lattice_within(target.image, target.region, nodes=900)
        result = tetopt.optimize(target, start, iterations=5)
        E = [row.E for row in result.history]
        assert all(later <= earlier for earlier, later in pairwise(E))
        assert E[-1] < E[0]
    check(image, mask, result.mesh)
    last = result.history[-1]
    assert last.E_D == pytest.approx(hard_E_D(target, result.mesh), rel=1e-9)
    fidelity = mask_fidelity(mask, result.mesh)
    assert fidelity.mesh_components == fidelity.components
    assert fidelity.mesh_euler == fidelity.euler
    assert fidelity.dice > 0.95
    if kind != "sheet":
        assert fidelity.distance_mean < 0.25
        assert fidelity.distance_p95 < 0.6
        assert fidelity.reverse_p95 < 0.8
    else:
        assert fidelity.mesh_volume == pytest.approx(fidelity.volume, rel=0.1)


@pytest.mark.full
def test_a_mask_in_2d():
    at = grid((60, 70))
    mask = np.hypot(at[..., 0] - 29.3, at[..., 1] - 36.1) < 22.0
    mask &= np.hypot(at[..., 0] - 35.0, at[..., 1] - 40.0) > 6.0
    affine = np.array([[0.8, 0.3, 5.0], [-0.2, 1.5, -7.0], [0.0, 0.0, 1.0]])
    image = tetopt.Image(np.sin(0.3 * at[..., 0]) + (at[..., 1] > 30), affine)
    target = content(image, mask=tetopt.Image(1.0 * mask, affine))
    result = tetopt.mesh_image(target, 300)
    check(image, tetopt.Image(1.0 * mask, affine), result.mesh)
    assert len(result.mesh.points) == pytest.approx(300, rel=0.02)
    assert result.history[-1].E_D == pytest.approx(hard_E_D(target, result.mesh), rel=1e-9)
    assert mask_fidelity(tetopt.Image(1.0 * mask, affine), result.mesh).distance_mean < 0.25


def test_the_boundary_may_be_fixed():
    image, mask = shaped("ball")
    target = content(image, mask=mask)
    start = lattice_within(target.image, target.region, nodes=600)
    result = tetopt.optimize(
        target, start, k_D=0.5, iterations=3, min_dihedral=0.0, boundary="fixed"
    )
    outer = np.unique(boundary_facets(start.cells))
    assert_allclose(result.mesh.points[outer], start.points[outer], atol=1e-5)
    assert np.abs(result.mesh.points - start.points).max() > 0.3


@pytest.mark.full
def test_what_lies_beyond_the_mask_does_not_matter():
    image, mask = shaped("ball")
    other = tetopt.Image(
        np.where(mask.data > 0, image.data, 1e4 * np.random.default_rng(0).random(image.shape))
    )
    meshes = [
        tetopt.mesh_image(content(each, mask=mask), 300, iterations=3).mesh
        for each in (image, other)
    ]
    assert_array_equal(meshes[0].points, meshes[1].points)
    assert_array_equal(meshes[0].cells, meshes[1].cells)


@pytest.mark.full
def test_same_bits_on_any_number_of_threads():
    image, mask = shaped("touching")
    labels = tetopt.Image(np.rint(distance(image.shape, 0, 14, 16) / 5.0))
    target = content([image, tetopt.Image(image.data**2)], labels, mask)
    most = numba.get_num_threads()
    meshes = []
    try:
        for threads in (1, most):
            numba.set_num_threads(threads)
            meshes.append(tetopt.mesh_image(target, 400, iterations=3).mesh)
    finally:
        numba.set_num_threads(most)
    assert_array_equal(meshes[0].points, meshes[1].points)
    assert_array_equal(meshes[0].cells, meshes[1].cells)


def test_a_lift_that_lays_cells_over_one_another_is_undone(monkeypatch):
    """Cells stay flat then; the mesh is the one before the lift."""
    image, mask = shaped("handle")
    target = content(image, mask=mask)._replace(is_flat=False)  # nodes need not follow the surface
    start = lattice_within(target.image, target.region, nodes=150)
    lifted = tetopt.optimize(target, start, iterations=2, min_dihedral=35.0)
    monkeypatch.setattr(Run, "_overlapping", lambda self, state: np.ones(100, dtype=bool))
    monkeypatch.setattr(Run, "mend_surfaces", lambda self, carves, min_dihedral: 0)
    kept = tetopt.optimize(target, start, iterations=2, min_dihedral=35.0)
    angles = [
        tetopt.quality(each.mesh.points, each.mesh.cells).min_dihedral for each in (lifted, kept)
    ]
    assert angles[1] < angles[0]
    assert all(later <= earlier for earlier, later in pairwise(row.E for row in kept.history))
    assert kept.history[-1].E_D == pytest.approx(hard_E_D(target, kept.mesh), rel=1e-9)
    assert tetopt.check_mesh(kept.mesh) == []


@pytest.mark.full
def test_cells_that_overlap_across_a_gap_are_taken_out():
    """Two balls, one of them moved into the other by some voxels."""
    image, mask = shaped("pieces")
    target = content(image, mask=mask)
    mesh = tetopt.mesh_image(target, 400, iterations=1).mesh
    number = components(mesh.cells)
    far = np.unique(mesh.cells[number == 1])
    near = np.unique(mesh.cells[number == 0])
    way = mesh.points[near].mean(axis=0) - mesh.points[far].mean(axis=0)
    points = mesh.points.copy()
    points[far] += (1.0 - 10.0 / np.linalg.norm(way)) * way
    moved = tetopt.Mesh(points, mesh.cells)
    n_shared = overlap_of(target.image, moved).n_voxels
    assert n_shared > 20
    run = Run(target, moved, 0.5)
    n_gone = run.mend_surfaces(True)
    assert overlap_of(target.image, run.mesh()) is None
    assert 0 < n_gone < 0.3 * len(mesh.cells)
    assert manifold_problems(run.mesh()) == []
    record = run.record(0, 0.0, False, 0.0)
    assert record.n_cells == len(run.mesh().cells)
    assert record.n_voxels == tetopt.cell_moments(target.image, run.mesh()).n_voxels.sum()
    untouched = Run(target, moved, 0.5)
    assert untouched.mend_surfaces(False) == 0
    assert overlap_of(target.image, untouched.mesh()).n_voxels == n_shared


# Labels.


def test_an_interface_that_touches_itself_is_mended_by_labels_alone():
    """Two cells with one node in common get the other label."""
    labels = corners()
    target = content(labels, labels, weights=[0.0])
    mesh = tetopt.mesh_image(target, 400, iterations=1).mesh
    run = Run(target, mesh, 0.5)
    run.give_labels()
    assert manifold_problems(mesh, run.labels()) == []
    of_cell = run.state.complex.labels
    whole = [
        n
        for n in range(len(mesh.points))
        if len(set(of_cell[np.flatnonzero((mesh.cells == n).any(axis=1))])) == 1
    ]
    n_cells = np.bincount(mesh.cells.ravel())
    node = max(whole, key=lambda n: n_cells[n])
    star = np.flatnonzero((mesh.cells == node).any(axis=1))
    shared = (mesh.cells[star][:, :, None, None] == mesh.cells[star]).any(axis=1).sum(axis=2)
    pair = star[np.argwhere(shared == 1)[0]]
    of_cell[pair] = (of_cell[pair] + 1) % len(target.memberships.labels)
    assert any("touches itself" in line for line in manifold_problems(mesh, run.labels()))
    assert run.mend_surfaces(True) == 0
    assert manifold_problems(run.mesh(), run.labels()) == []
    assert_array_equal(run.mesh().points, mesh.points)


def corners(shape=(24, 24, 24)):
    """Eight cubes of which four labels meet in an edge, eight in a point; and a label of one
    voxel.
    """
    at = grid(shape) >= 12
    labels = 1.0 + at[..., 0] + 2 * at[..., 1] + 4 * at[..., 2]
    labels[5, 5, 5] = 20
    return tetopt.Image(labels)


@pytest.mark.full
def test_labels_that_meet_in_edges_and_points():
    labels = corners()
    target = content(labels, labels, weights=[0.0])
    result = tetopt.mesh_image(target, 700, iterations=10)
    assert tetopt.check_mesh(result.mesh, labels) == []
    assert tetopt.quality(result.mesh.points, result.mesh.cells).min_dihedral >= 12.0 - 1e-9
    assert result.history[-1].E_D == pytest.approx(
        hard_E_D(target, result.mesh), rel=1e-9, abs=1e-9
    )
    rows = {row.label: row for row in label_fidelity(labels, result.mesh, result.labels)}
    for label in range(1, 9):
        assert rows[label].dice > 0.995
        assert rows[label].components == 1
        # beside the edge where four meet a cell may stand alone
        assert rows[label].mesh_components <= 3
    assert sum(row.mesh_volume for row in rows.values()) == pytest.approx(labels.volume)
    assert rows[20].is_lost or rows[20].mesh_volume < 4.0  # one voxel among 13,824


@pytest.mark.full
def test_labels_and_an_image_share_the_cells():
    """With labels cells keep to both: the image alone does not see the labels, nor they its
    step.
    """
    shape = (26, 26, 26)
    at = grid(shape)
    image = tetopt.Image(100.0 * (at[..., 0] > 12.3))
    labels = tetopt.Image(1.0 * (at[..., 1] > 9.4))
    fraction = {}
    for weight in (None, 1.0):
        target = content(image) if weight is None else content(image, labels, label_weight=weight)
        mesh = tetopt.mesh_image(target, 300).mesh
        dice = min(row.dice for row in label_fidelity(labels, mesh))
        fraction[weight] = dice, tetopt.E_D(image, mesh) / (np.var(image.data) * image.volume)
    assert fraction[None][0] < 0.98
    assert fraction[1.0][0] > 0.99
    assert fraction[1.0][1] < 0.02


@pytest.mark.full
def test_contrasts_of_different_scales_are_all_seen():
    """Steps along three axes, one in each contrast: cells keep to each, whatever its scale."""
    at = grid((24, 24, 24))
    images = [
        tetopt.Image(scale * (at[..., d] > 7.5 + 3 * d)) for d, scale in enumerate((1.0, 1e-4, 3e4))
    ]
    target = content(images)
    result = tetopt.mesh_image(target, 400)
    assert result.history[-1].E_D == pytest.approx(hard_E_D(target, result.mesh), rel=1e-9)
    for image in images:
        assert (
            tetopt.E_D(image, result.mesh) < 0.02 * np.var(image.data, dtype=float) * image.volume
        )
    alone = tetopt.mesh_image(images[0], 400).mesh
    assert (
        tetopt.E_D(images[1], alone) > 0.05 * np.var(images[1].data, dtype=float) * images[1].volume
    )


@pytest.mark.full
def test_labels_within_a_mask():
    image, mask = shaped("ball")
    labels = tetopt.Image(1.0 + (grid(image.shape)[..., 2] > 16))
    target = content(image, labels, mask)
    result = tetopt.mesh_image(target, 600, iterations=5)
    mesh = result.mesh
    is_between = np.isin(
        np.arange(len(mesh.points)),
        np.intersect1d(*(mesh.cells[result.labels == k] for k in (1, 2))),
    )
    check(image, mask, mesh, is_between=is_between)
    of_cell = cell_labels(labels, mesh)
    assert set(of_cell) == {1, 2}
    owner = cell_of_voxel(image, mesh)
    inside = (owner >= 0) & (mask.data > 0)
    assert (of_cell[owner[inside]] == labels.data[inside]).mean() > 0.98


@pytest.mark.full
def test_an_error_wanted_within_a_mask():
    image, mask = shaped("ball")
    target = content(image, mask=mask)
    result = tetopt.mesh_image(target, target_error=0.2, iterations=6)
    # of the variance of the voxels in cells, which quality reports, too
    assert 0.1 < result.fraction <= 0.2
    assert result.fraction == unexplained_variance(target, result.mesh)


# The surface's kernels.


@pytest.mark.kernel
def test_level_between_voxels():
    rng = np.random.default_rng(0)
    for shape in ((4, 5, 6), (1, 5, 6), (2, 2, 2)):
        level = rng.normal(size=shape).astype(np.float32)
        at = rng.uniform(-1.0, 6.0, size=(30, 3))
        values = [level_at(level, *place) for place in at]
        assert_allclose(values, levels(level, np.clip(at, 0, np.array(shape) - 1.0)), atol=1e-6)


@pytest.mark.kernel
def test_put_on_surface():
    """Onto a sphere: nearly the nearest point of it, along the box's faces for nodes that lie
    there.
    """
    shape = (24, 24, 24)
    image = tetopt.Image(np.zeros(shape), OBLIQUE)
    region_level = (distance(shape, 11.0, 12.0, -3.0) - 9.0).astype(np.float32)
    points = np.random.default_rng(0).uniform(3.0, 20.0, size=(40, 3))
    points[20:, 2] = -0.5
    target = content(image)
    grid_ = channel_grid(target, image.to_world(points))
    ticks = to_ticks(points, grid_)
    before = ticks.copy()
    matrix = image.affine[:3, :3].copy()
    is_frozen = np.zeros((40, 4), dtype=bool)
    is_frozen[20:, 2] = is_frozen[:, 3] = True
    objective, sides = (
        objective_of(grid_, matrix, 3.0),
        sides_of(grid_, matrix, side_ticks(grid_), False, region_level),
    )
    state = build(np.empty((0, 4), dtype=np.int64), ticks, is_frozen, objective, sides)
    normal = np.zeros((7, 3))
    reached = np.array([put_on_surface(normal, state, k) for k in range(40)])
    assert reached.mean() > 0.8
    there = ticks[reached] * 2.0**-grid_.bits
    assert np.abs(levels(region_level, there)).max() < 1.5e-3
    assert_array_equal(ticks[20:, 2], before[20:, 2])


@pytest.mark.kernel
def test_no_facet_turns_over():
    """A plate with a narrow gap in it: nodes do not slide across onto the other side."""
    mask = np.zeros((20, 20, 20))
    mask[3:17, 3:17, 4:9] = 1.0
    mask[3:17, 3:17, 10:15] = 1.0
    mask[3:6, 3:17, 9] = 1.0
    rng = np.random.default_rng(0)
    image = tetopt.Image(rng.normal(size=mask.shape))
    target = content(image, mask=tetopt.Image(mask))
    start = lattice_within(target.image, target.region, spacing=3.0)
    iterations = 1 if numba.config.DISABLE_JIT else 4  # a second or twelve, as plain Python
    result = tetopt.optimize(target, start, k_D=0.9, iterations=iterations, min_dihedral=0.0)
    total, covered = times_covered(image, result.mesh)
    assert total == covered
    grid_ = channel_grid(target, result.mesh.points)
    sums = moment_sums(
        grid_, to_ticks(target.image.to_index(result.mesh.points), grid_), result.mesh.cells
    )
    assert sums[:, 0].sum() == total
