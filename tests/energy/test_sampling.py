"""Voxels to cells: the contract to the last voxel, against rational arithmetic, and what follows
from it.
"""

from itertools import permutations

import naive
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import delaunay_box, dimensions, random_affine, seeds, split_box
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import Delaunay
from threads import assert_same_bits

from tetopt import Image, InputError, Mesh, cell_moments, cell_of_voxel, lattice_mesh
from tetopt.energy.sampling import (
    cell_moments_and_ranges,
    from_ticks,
    moment_sums,
    nearest_values,
    orientations,
    sampling_grid,
    to_ticks,
)
from tetopt.geometry.simplex import orient_cells

pytestmark = pytest.mark.kernel


def random_image(rng, shape, affine=None):
    """Noise around a large mean: whole numbers, float32 or float64."""
    data = rng.normal(1000.0, 50.0, shape)
    return Image((np.rint(data), data.astype(np.float32), data)[rng.integers(3)], affine)


def placed(image, index, cells):
    """The mesh of nodes given in index coordinates, whatever the affine's hand."""
    points = image.to_world(index)
    return Mesh(points, orient_cells(points, cells))


def random_case(seed, n, *, is_snapped):
    """A random image and a conforming mesh of its box."""
    rng = np.random.default_rng(seed)
    shape = tuple(int(s) for s in rng.integers(1, 9 if n == 2 else 6, n))
    image = random_image(rng, shape, random_affine(rng, n))
    n_nodes = int(rng.integers(0, 16 if n == 2 else 8))
    if is_snapped:
        return image, placed(image, *split_box(rng, shape, n_nodes, rng.choice([0.5, 0.25])))
    return image, placed(image, *delaunay_box(rng, shape, n_nodes))


def assert_owners(image, mesh):
    """That they are the twin's; return them."""
    owner = cell_of_voxel(image, mesh)
    assert_array_equal(owner, naive.cell_of_voxel(image, mesh))
    return owner


# The rule of ties, by hand


def test_centres_on_the_walls_of_a_cube_s_six_cells():
    """The cell of axes (a, b, c) holds x_a > x_b > x_c; among equal indices the shift makes the
    last axis largest.
    """
    image = Image(np.zeros((5, 5, 5)))
    mesh = placed(image, *split_box(np.random.default_rng(0), (5, 5, 5), 0))
    number = {axes: cell for cell, axes in enumerate(permutations(range(3)))}
    for voxel, cell in np.ndenumerate(cell_of_voxel(image, mesh)):
        axes = sorted(range(3), key=lambda axis: (voxel[axis], axis), reverse=True)
        assert cell == number[tuple(axes)]


# The twin


@given(seeds, dimensions, st.booleans())
def test_owners_are_the_twin_s(seed, n, is_snapped):
    """Also with nodes on centres, corners and halves of voxels: every kind of tie."""
    assert_owners(*random_case(seed, n, is_snapped=is_snapped))


@pytest.mark.parametrize("shape", [(3, 90), (90, 4), (40, 50), (14, 12, 16), (2, 3, 90)])
def test_owners_with_ties_that_floats_get_wrong_are_the_twin_s(shape):
    """Nodes on centres far apart: lines and planes of slopes like 7/49 pass through other
    centres.
    """
    image, n_nodes = Image(np.zeros(shape)), 5 if len(shape) == 3 else 12
    assert_owners(image, placed(image, *split_box(np.random.default_rng(2), shape, n_nodes, 1)))


@given(seeds, dimensions)
def test_owners_near_a_tie_are_the_twin_s(seed, n):
    """Inner nodes a few ticks off the halves, as far as no cell turns over: floats cannot tell,
    integers must.
    """
    rng = np.random.default_rng(seed)
    image = Image(np.zeros((4,) * n))
    index, cells = split_box(rng, image.shape, 5)
    grid = sampling_grid(image, index)
    for node in np.flatnonzero(((index > -0.5) & (index < 3.5)).all(axis=1)):
        moved = index.copy()
        moved[node] += rng.integers(-2, 3, n) * 2.0**-grid.bits
        if (orientations(to_ticks(moved, grid), cells) == 1).all():
            index = moved
    assert_owners(image, placed(image, index, cells))


@given(seeds, dimensions)
def test_owners_in_cells_far_larger_than_the_image_are_the_twin_s(seed, n):
    """A mesh that reaches up to 800,000 voxels around: few bits, facets almost parallel to rows,
    and still exact.
    """
    rng = np.random.default_rng(seed)
    image = random_image(rng, (5, 4, 3)[:n])
    reach = 10.0 ** rng.uniform(2, 5.9)
    points = np.vstack([rng.uniform(-reach, reach, (8, n)), rng.uniform(-1, 5, (4, n))])
    try:
        mesh = placed(image, points, Delaunay(points).simplices)
        cell_of_voxel(image, mesh)
    except InputError:
        return  # a cell flat to within a tick
    assert_owners(image, mesh)


@given(seeds, dimensions)
def test_orientations_are_exact(seed, n):
    """Coordinates up to 2^28 and volumes down to one unit, against whole numbers of any size."""
    rng = np.random.default_rng(seed)
    reach = 2 ** int(rng.integers(2, 29))
    ticks = np.zeros((40, 3), dtype=np.int64)
    ticks[:, 3 - n :] = rng.integers(-reach, reach, (40, n), endpoint=True)
    ticks[:8] = reach * np.sign(ticks[:8])  # corners of the range
    cells = np.array([rng.permutation(40)[: n + 1] for _ in range(30)])
    for cell in cells[:20]:  # the last node all but on the plane of the others
        flat = ticks[cell[:n]].astype(np.float64)
        weights = rng.dirichlet(np.ones(n))
        ticks[cell[n], 3 - n :] = np.rint(weights @ flat)[3 - n :] + rng.integers(-1, 2, n)
    ticks = np.clip(ticks, -reach, reach)
    expected = naive.orientations([ticks[cell, 3 - n :].tolist() for cell in cells])
    assert orientations(ticks, cells).tolist() == expected


# Every voxel in one cell


def test_counts_on_a_long_thin_image():
    """100,000 voxels in a row leave 11 bits for the fraction."""
    image = Image(np.zeros((2, 100_000 if naive.IS_COMPILED else 5_000), dtype=np.float32))
    mesh = placed(image, *delaunay_box(np.random.default_rng(0), image.shape, 40))
    assert cell_moments(image, mesh).n_voxels.sum() == image.data.size
    assert (cell_of_voxel(image, mesh) >= 0).all()


# Moments


@pytest.mark.parametrize("high", [1, 46340, 92681, 92682, 3_000_001, 2.0**40, 0.5, 1e-30])
def test_moment_sums_of_all_sizes_of_numbers(high):
    """0 and `high` in random places: whole numbers whose sums of squares fit 31 bits, and not,
    and fractions.
    """
    rng = np.random.default_rng(0)
    image = Image(np.where(rng.random((3, 4, 5)) < 0.5, 0, high))
    mesh = placed(image, *split_box(rng, image.shape, 4))
    grid = sampling_grid(image, mesh.points)
    sums = moment_sums(grid, to_ticks(image.to_index(mesh.points), grid), mesh.cells)
    twin = naive.moment_sums(image, naive.cell_of_voxel(image, mesh), len(mesh.cells), grid.shift)
    assert_allclose(sums, twin, rtol=1e-14, atol=1e-14 * high**2)


@given(seeds, dimensions, st.booleans())
def test_moments_are_numpy_s_over_each_cell_s_voxels(seed, n, is_snapped):
    image, mesh = random_case(seed, n, is_snapped=is_snapped)
    moments, owner = cell_moments(image, mesh), cell_of_voxel(image, mesh)
    both, (low, high) = cell_moments_and_ranges(image, mesh)
    assert [a.tobytes() for a in both] == [a.tobytes() for a in moments]
    data = image.data.astype(np.float64)
    for cell, (n_voxels, mean, variance) in enumerate(zip(*moments, strict=True)):
        h = data[owner == cell]
        assert n_voxels == len(h)
        if n_voxels:
            assert mean == pytest.approx(h.mean(), rel=1e-13)
            assert variance == pytest.approx(h.var(), rel=1e-10, abs=1e-9)
        span = (h.min(), h.max()) if n_voxels else (mean, mean)
        assert (low[cell], high[cell]) == span


@pytest.mark.parametrize(("offset", "contrast"), [(1e8, 1.0), (-1e8, 1.0), (0.4, 1e-6)])
def test_variance_of_a_small_contrast_on_a_large_mean(offset, contrast):
    """Two values in turn, a 1e-8th or a millionth apart: sums of h^2 would lose most digits of
    the variance.
    """
    image = Image(offset + contrast * (np.indices((8, 8)).sum(axis=0) % 2))
    mesh = lattice_mesh(image, blocks=(1, 1))
    owner = cell_of_voxel(image, mesh)
    exact = [image.data[owner == cell].astype(np.float64).var() for cell in range(4)]
    assert cell_moments(image, mesh).variance == pytest.approx(exact, rel=1e-6, abs=0)


# Cells without a voxel, and voxels without a cell


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("seed", range(2))
def test_cells_without_voxel_centres_have_the_centroid_s_value(seed, n):
    """And a variance of 0 to the last bit, in images whose sums of squares round."""
    rng = np.random.default_rng(seed)
    image = Image(rng.normal(1000.0, 50.0, (4,) * n), random_affine(rng, n))
    mesh = placed(image, *delaunay_box(rng, image.shape, 60))
    moments = cell_moments(image, mesh)
    is_empty = moments.n_voxels == 0
    assert is_empty.any()
    index = image.to_index(mesh.points[mesh.cells].mean(axis=1))
    nearest = np.clip(np.rint(index).astype(int), 0, np.array(image.shape) - 1)[is_empty]
    assert_array_equal(moments.mean[is_empty], image.data[tuple(nearest.T)].astype(np.float64))
    assert (moments.variance[is_empty] == 0).all()


def test_nearest_values_clip_to_the_border():
    image = Image(np.arange(6.0).reshape(2, 3), np.diag([2.0, 3.0, 1.0]))
    values = nearest_values(image, np.array([[0, 0], [0.9, 1.4], [1.1, 1.6], [-99, 99], [99, -99]]))
    assert (values.tolist(), values.dtype) == ([0, 0, 4, 2, 3], np.float64)


@given(seeds, dimensions)
def test_a_mesh_partly_outside_counts_what_is_inside(seed, n):
    rng = np.random.default_rng(seed)
    shape = (5, 4, 4)[:n]
    image = random_image(rng, shape)
    index, cells = split_box(rng, shape, 4)
    shift = rng.integers(-6, 7, n) / 2
    mesh = placed(image, index + shift, cells)
    owner = assert_owners(image, mesh)
    counts = np.bincount(owner[owner >= 0], minlength=len(cells))
    assert_array_equal(cell_moments(image, mesh).n_voxels, counts)
    # The box is shifted by halves, so its walls may run through centres: those in [low, high) are
    # inside.
    from_low = np.moveaxis(np.indices(shape), 0, -1) - shift + 0.5
    assert_array_equal(owner >= 0, ((from_low >= 0) & (from_low < shape)).all(axis=-1))


# Laws


@given(seeds, dimensions)
def test_the_order_of_the_cells_changes_not_a_bit(seed, n):
    rng = np.random.default_rng(seed)
    image, mesh = random_case(seed, n, is_snapped=True)
    order = rng.permutation(len(mesh.cells))
    other = Mesh(mesh.points, mesh.cells[order])
    for ours, theirs in zip(cell_moments(image, mesh), cell_moments(image, other), strict=True):
        assert_array_equal(ours[order], theirs)
    assert_array_equal(order[cell_of_voxel(image, other)], cell_of_voxel(image, mesh))


def test_the_same_bits_on_one_and_two_threads():
    image = Image(np.random.default_rng(0).normal(size=(30, 31, 32)))
    mesh = lattice_mesh(image, blocks=(6, 6, 6))
    assert len(mesh.cells) > 1000
    assert_same_bits(lambda: cell_moments(image, mesh))


# The fixed-point grid


@given(seeds, dimensions)
def test_ticks_are_the_nearest_and_stay_below_2_to_the_28(seed, n):
    rng = np.random.default_rng(seed)
    reach = 2.0 ** rng.uniform(0, 19.5)
    image = Image(np.zeros((3,) * n))
    index = rng.uniform(-reach, reach, (20, n))
    grid = sampling_grid(image, index)
    ticks = to_ticks(index, grid)
    assert ticks.shape == (20, 3)
    assert np.abs(ticks).max() < 2**28
    assert grid.bits >= 8
    twin, bits = naive.ticks(image, index)
    assert (bits, ticks[:, 3 - n :].tolist()) == (grid.bits, twin)
    back = from_ticks(ticks, grid, n)
    assert np.abs(back - index).max() <= 2.0 ** -(grid.bits + 1)
    assert_array_equal(to_ticks(back, grid), ticks)


# Messages


@pytest.mark.parametrize(("of_image", "of_mesh"), [(2, 3), (3, 2)])
@pytest.mark.parametrize("function", [cell_moments, cell_of_voxel])
def test_mesh_and_image_of_different_dimension_are_refused(function, of_image, of_mesh):
    image, other = (Image(np.zeros((3,) * n)) for n in (of_image, of_mesh))
    with pytest.raises(InputError, match=f"a {of_mesh}-D mesh and a {of_image}-D image"):
        function(image, lattice_mesh(other, blocks=(1,) * of_mesh))


@pytest.mark.parametrize("function", [cell_moments, cell_of_voxel])
@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_cells_flat_or_inverted_at_the_grid_s_resolution_are_refused(function, hand):
    """A height of 1e-9 voxel is 0 ticks: positive in the world, flat in the grid."""
    image = Image(np.zeros((4, 4)), np.diag([hand, 1.0, 1.0]))
    flat = Mesh([[0, 0], [2, 0], [1, 1], [1, -1e-9]], [[0, 1, 2], [0, 3, 1]])
    with pytest.raises(InputError, match=r"1 cells are flat .* such as \[1\]"):
        function(image, flat)


@pytest.mark.parametrize("function", [cell_moments, cell_of_voxel])
def test_a_mesh_in_other_units_is_refused(function):
    image = Image(np.zeros((4, 4, 4)))
    mesh = lattice_mesh(image, blocks=(1, 1, 1))
    assert function(image, Mesh(mesh.points + 2.0**20 - 8, mesh.cells)) is not None
    with pytest.raises(InputError, match=r"reaches 2\.1e\+06 voxels .* mm"):
        function(image, Mesh(mesh.points + 2.0**21, mesh.cells))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_float32_and_float64_give_the_same(dtype):
    """In float32 values are stored, not summed."""
    rng = np.random.default_rng(7)
    data = rng.integers(0, 4096, (9, 9, 9)) / 16
    stored = Image(data)
    object.__setattr__(stored, "data", data.astype(dtype))
    mesh = placed(stored, *split_box(rng, data.shape, 6))
    owner = cell_of_voxel(stored, mesh)
    for cell, (count, mean, variance) in enumerate(zip(*cell_moments(stored, mesh), strict=True)):
        if count:
            h = data[owner == cell]
            assert mean == pytest.approx(h.mean(), rel=1e-13)
            assert variance == pytest.approx(h.var(), rel=1e-11, abs=1e-10)
