"""Masks, labels and several contrasts through the whole optimisation."""

from itertools import pairwise

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shapes import OBLIQUE, channels, distance, grid, labels_alone, shaped

import tetopt
from tetopt import Image, cell_moments, check_mesh, mesh_image, optimize, quality
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
    unit = Image(np.ones(image.shape), image.affine)
    total = cell_moments(unit, mesh).n_voxels.sum()
    return total, int((cell_of_voxel(image, mesh) >= 0).sum())


def check(image, mask, mesh, min_dihedral=12.0, is_between=0.0):
    """The mesh fills the mask. Nodes are off its surface by what facets cut off, so that these lie
    on it on average.

    Nodes `is_between` (N,) labels may be a tenth of a voxel off.
    """
    assert check_mesh(mesh, is_whole=False) == []
    total, covered = times_covered(image, mesh)
    assert total == covered  # no voxel in two cells
    if mesh.ndim == 3:
        assert quality(mesh.points, mesh.cells).min_dihedral >= min_dihedral - 1e-9
    # Boundary nodes lie on the box's faces or on the surface.
    index = image.to_index(mesh.points)
    facets = boundary_facets(mesh.cells)
    on_box = ((index == -0.5) | (index == np.array(image.shape) - 0.5)).any(axis=1)
    around = content(image, mask=mask)  # the mask's own box, on which its level is smoothed

    def level_of(points):
        return levels(around.region.level, around.image.to_index(points))

    outer = np.setdiff1d(facets, np.flatnonzero(on_box))
    off = np.abs(level_of(mesh.points[outer]))
    corners = mesh.points[facets]
    edge = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1).mean()
    edge /= image.voxel_volume ** (1.0 / image.ndim)
    near = MOST_OFFSET_FRACTION * edge + 0.1 * is_between * np.ones(len(mesh.points))
    assert np.mean(off < near[outer]) > 0.97
    assert off.max() < 0.7
    corners = corners[~on_box[facets].all(axis=1)]
    # A quadratic function's mean over a facet is 3/4 of that at its middle and 1/4 of that at its
    # corners; 2/3 in 2-D.
    share = 2.0 / 3.0 if image.ndim == 2 else 0.75
    of_middles = level_of(corners.mean(axis=1)).mean()
    of_corners = level_of(corners.reshape(-1, image.ndim)).mean()
    assert abs(share * of_middles + (1.0 - share) * of_corners) < 0.03


def assert_E_D(target, result):
    """E_D of the last row is that of the voxels, one by one: squares around the cells' means, and
    those on the wrong side of the mask.
    """
    mesh = result.mesh
    owner = cell_of_voxel(target.image, mesh).ravel()
    is_in = owner >= 0
    squares = 0.0
    for values in channels(target).reshape(target.n_channels, -1).astype(float):
        count = np.maximum(np.bincount(owner[is_in], minlength=len(mesh.cells)), 1)
        mean = np.bincount(owner[is_in], values[is_in], len(mesh.cells)) / count
        squares += ((values[is_in] - mean[owner[is_in]]) ** 2).sum()
    if target.region is not None:
        squares += target.wrong_side * (is_in != target.region.inside.ravel()).sum()
    E_D = squares * target.unit * target.image.voxel_volume
    assert result.history[-1].E_D == pytest.approx(E_D, rel=1e-9, abs=1e-9)


def assert_falls(result):
    E = [row.E for row in result.history]
    assert all(later <= earlier for earlier, later in pairwise(E))


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
        result = mesh_image(target, 900, iterations=5)
        assert len(result.mesh.points) == pytest.approx(900, rel=0.02)
    else:
        start = lattice_within(target.image, target.region, nodes=900)
        result = optimize(target, start, iterations=5)
        assert_falls(result)
        assert result.history[-1].E < result.history[0].E
    check(image, mask, result.mesh)
    assert_E_D(target, result)
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
    affine = np.array([[0.8, 0.3, 5.0], [-0.2, 1.5, -7.0], [0.0, 0.0, 1.0]])
    is_in = (distance(at.shape[:2], 29.3, 36.1) < 22.0) & (distance(at.shape[:2], 35, 40) > 6.0)
    mask = Image(1.0 * is_in, affine)
    image = Image(np.sin(0.3 * at[..., 0]) + (at[..., 1] > 30), affine)
    target = content(image, mask=mask)
    result = mesh_image(target, 300)
    check(image, mask, result.mesh)
    assert len(result.mesh.points) == pytest.approx(300, rel=0.02)
    assert_E_D(target, result)
    assert mask_fidelity(mask, result.mesh).distance_mean < 0.25


def masked_ball():
    """The image, mask and content of a ball."""
    image, mask = shaped("ball")
    return image, mask, content(image, mask=mask)


def test_the_boundary_may_be_fixed():
    _, _, target = masked_ball()
    start = lattice_within(target.image, target.region, nodes=600)
    result = optimize(target, start, k_D=0.5, iterations=3, min_dihedral=0.0, boundary="fixed")
    outer = np.unique(boundary_facets(start.cells))
    moved = np.abs(result.mesh.points - start.points)
    assert moved[outer].max() < 1e-5
    assert moved.max() > 0.3


@pytest.mark.full
def test_what_lies_beyond_the_mask_does_not_matter():
    image, mask, target = masked_ball()
    noise = 1e4 * np.random.default_rng(0).random(image.shape)
    other = content(Image(np.where(mask.data > 0, image.data, noise)), mask=mask)
    one, two = (mesh_image(each, 300, iterations=3).mesh for each in (target, other))
    assert_array_equal(one.points, two.points)
    assert_array_equal(one.cells, two.cells)


def test_a_lift_that_lays_cells_over_one_another_is_undone(monkeypatch):
    """Cells stay flat then; the mesh is the one before the lift."""
    image, mask = shaped("handle")
    target = content(image, mask=mask)._replace(is_flat=False)  # nodes need not follow the surface
    start = lattice_within(target.image, target.region, nodes=150)
    lifted = optimize(target, start, iterations=2, min_dihedral=35.0)
    monkeypatch.setattr(Run, "_overlapping", lambda self, state: np.ones(100, dtype=bool))
    monkeypatch.setattr(Run, "mend_surfaces", lambda self, carves, min_dihedral: 0)
    kept = optimize(target, start, iterations=2, min_dihedral=35.0)
    high, low = (quality(each.mesh.points, each.mesh.cells).min_dihedral for each in (lifted, kept))
    assert low < high
    assert_falls(kept)
    assert_E_D(target, kept)
    assert check_mesh(kept.mesh) == []


@pytest.mark.full
def test_cells_that_overlap_across_a_gap_are_taken_out():
    """Two balls, one of them moved into the other by some voxels."""
    image, mask = shaped("pieces")
    target = content(image, mask=mask)
    mesh = mesh_image(target, 400, iterations=1).mesh
    number = components(mesh.cells)
    near, far = (np.unique(mesh.cells[number == k]) for k in (0, 1))
    way = mesh.points[near].mean(axis=0) - mesh.points[far].mean(axis=0)
    points = mesh.points.copy()
    points[far] += (1.0 - 10.0 / np.linalg.norm(way)) * way
    moved = tetopt.Mesh(points, mesh.cells)
    n_shared = overlap_of(target.image, moved).n_voxels
    assert n_shared > 20
    run, untouched = Run(target, moved, 0.5), Run(target, moved, 0.5)
    assert 0 < run.mend_surfaces(True) < 0.3 * len(mesh.cells)
    mended, record = run.mesh(), run.record(0, 0.0, False, 0.0)
    assert overlap_of(target.image, mended) is None
    assert manifold_problems(mended) == []
    assert record.n_cells == len(mended.cells)
    assert record.n_voxels == cell_moments(target.image, mended).n_voxels.sum()
    assert untouched.mend_surfaces(False) == 0
    assert overlap_of(target.image, untouched.mesh()).n_voxels == n_shared


# Labels.


def test_an_interface_that_touches_itself_is_mended_by_labels_alone():
    """Two cells with one node in common get the other label."""
    target = labels_alone(corners())
    mesh = mesh_image(target, 400, iterations=1).mesh
    run = Run(target, mesh, 0.5)
    run.give_labels()
    assert manifold_problems(mesh, run.labels()) == []
    of_cell = run.state.complex.labels
    stars = [np.flatnonzero((mesh.cells == n).any(axis=1)) for n in range(len(mesh.points))]
    star = max((cells for cells in stars if len(set(of_cell[cells])) == 1), key=len)
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
    return Image(labels)


@pytest.mark.full
def test_labels_that_meet_in_edges_and_points():
    labels = corners()
    target = labels_alone(labels)
    result = mesh_image(target, 700, iterations=10)
    assert check_mesh(result.mesh, labels) == []
    assert quality(result.mesh.points, result.mesh.cells).min_dihedral >= 12.0 - 1e-9
    assert_E_D(target, result)
    rows = {row.label: row for row in label_fidelity(labels, result.mesh, result.labels)}
    for label in range(1, 9):
        assert rows[label].overlap.dice > 0.995
        assert rows[label].pieces.components == 1
        # beside the edge where four meet a cell may stand alone
        assert rows[label].pieces.mesh_components <= 3
    assert sum(row.extent.mesh_volume for row in rows.values()) == pytest.approx(labels.volume)
    assert rows[20].extent.is_lost or rows[20].extent.mesh_volume < 4.0  # one voxel among 13,824


def unexplained(image, mesh):
    """E_D as a fraction of that without a mesh."""
    return tetopt.E_D(image, mesh) / (np.var(image.data, dtype=float) * image.volume)


@pytest.mark.full
def test_labels_and_an_image_share_the_cells():
    """With labels cells keep to both: the image alone does not see the labels, nor they its
    step.
    """
    at = grid((26, 26, 26))
    image, labels = (
        Image(100.0 * (at[..., 0] > 12.3)),
        Image(1.0 * (at[..., 1] > 9.4)),
    )
    alone, both = (
        mesh_image(each, 300).mesh
        for each in (content(image), content(image, labels, label_weight=1.0))
    )
    least = [
        min(row.overlap.dice for row in label_fidelity(labels, mesh)) for mesh in (alone, both)
    ]
    assert least[0] < 0.98
    assert least[1] > 0.99
    assert unexplained(image, both) < 0.02


@pytest.mark.full
def test_contrasts_of_different_scales_are_all_seen():
    """Steps along three axes, one in each contrast: cells keep to each, whatever its scale."""
    at = grid((24, 24, 24))
    images = [Image(scale * (at[..., d] > 7.5 + 3 * d)) for d, scale in enumerate((1.0, 1e-4, 3e4))]
    target = content(images)
    result = mesh_image(target, 400)
    assert_E_D(target, result)
    assert max(unexplained(image, result.mesh) for image in images) < 0.02
    assert unexplained(images[1], mesh_image(images[0], 400).mesh) > 0.05


@pytest.mark.full
def test_labels_within_a_mask():
    image, mask, _ = masked_ball()
    labels = Image(1.0 + (grid(image.shape)[..., 2] > 16))
    result = mesh_image(content(image, labels, mask), 600, iterations=5)
    mesh, is_between = result.mesh, np.zeros(len(result.mesh.points))
    is_between[np.intersect1d(*(mesh.cells[result.labels == k] for k in (1, 2)))] = 1.0
    check(image, mask, mesh, is_between=is_between)
    of_cell = cell_labels(labels, mesh)
    assert set(of_cell) == {1, 2}
    owner = cell_of_voxel(image, mesh)
    inside = (owner >= 0) & (mask.data > 0)
    assert (of_cell[owner[inside]] == labels.data[inside]).mean() > 0.98


@pytest.mark.full
def test_an_error_wanted_within_a_mask():
    _, _, target = masked_ball()
    result = mesh_image(target, target_error=0.2, iterations=6)
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
    image = Image(np.zeros((24, 24, 24)), OBLIQUE)
    level = (distance(image.shape, 11.0, 12.0, -3.0) - 9.0).astype(np.float32)
    points = np.random.default_rng(0).uniform(3.0, 20.0, size=(40, 3))
    points[20:, 2] = -0.5
    grid_ = channel_grid(content(image), image.to_world(points))
    ticks = to_ticks(points, grid_)
    before, matrix = ticks.copy(), image.affine[:3, :3].copy()
    is_frozen = np.zeros((40, 4), dtype=bool)
    is_frozen[20:, 2] = is_frozen[:, 3] = True
    sides = sides_of(grid_, matrix, side_ticks(grid_), False, level)
    no_cells = np.empty((0, 4), dtype=np.int64)
    state = build(no_cells, ticks, is_frozen, objective_of(grid_, matrix, 3.0), sides)
    normal = np.zeros((7, 3))
    reached = np.array([put_on_surface(normal, state, k) for k in range(40)])
    assert reached.mean() > 0.8
    there = ticks[reached] * 2.0**-grid_.bits
    assert np.abs(levels(level, there)).max() < 1.5e-3
    assert_array_equal(ticks[20:, 2], before[20:, 2])


@pytest.mark.kernel
def test_no_facet_turns_over():
    """A plate with a narrow gap in it: nodes do not slide across onto the other side."""
    mask = np.zeros((20, 20, 20))
    mask[3:17, 3:17, 4:15] = 1.0
    mask[6:17, 3:17, 9] = 0.0
    image = Image(np.random.default_rng(0).normal(size=mask.shape))
    target = content(image, mask=Image(mask))
    start = lattice_within(target.image, target.region, spacing=3.0)
    iterations = 1 if numba.config.DISABLE_JIT else 4  # a second or twelve, as plain Python
    mesh = optimize(target, start, k_D=0.9, iterations=iterations, min_dihedral=0.0).mesh
    total, covered = times_covered(image, mesh)
    assert total == covered
    grid_ = channel_grid(target, mesh.points)
    ticks = to_ticks(target.image.to_index(mesh.points), grid_)
    assert moment_sums(grid_, ticks, mesh.cells)[:, 0].sum() == total
