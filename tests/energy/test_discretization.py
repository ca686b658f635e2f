"""E_D: closed forms on voxels, the analytic sphere, the law of total variance, and Eq. (4)."""

from math import pi

import naive
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import TWO_TRIANGLES, delaunay_box, random_affine, split_box

from tetopt import (
    E_D,
    Image,
    Mesh,
    cell_moments,
    cell_of_voxel,
    content,
    lattice_mesh,
    load_phantom,
)
from tetopt.energy.discretization import cell_E_D, combine_energies, unexplained_variance
from tetopt.geometry.simplex import orient_cells, volumes

kernel = pytest.mark.kernel

seeds = st.integers(0, 2**32 - 1)
dimensions = st.sampled_from([2, 3])


def random_case(seed, n):
    """A random image and a conforming mesh of its box."""
    rng = np.random.default_rng(seed)
    shape = tuple(int(s) for s in rng.integers(2, 9 if n == 2 else 6, n))
    image = Image(rng.normal(100.0, 10.0, shape), random_affine(rng, n))
    make = split_box if rng.random() < 0.5 else delaunay_box
    index, cells = make(rng, shape, int(rng.integers(0, 8)))
    points = image.to_world(index)
    return image, Mesh(points, orient_cells(points, cells))


# Constant images


@given(seeds, dimensions)
@kernel
def test_E_D_of_a_constant_image_is_0(seed, n):
    """Exactly 0: the term of a constant image is left out of Eq. (4), and noise divided by noise
    must not come in.
    """
    rng = np.random.default_rng(seed)
    _, mesh = random_case(seed, n)
    image, _ = random_case(seed, n)
    value = rng.normal() * 10.0 ** rng.integers(-6, 7)
    constant = Image(np.full(image.shape, value), image.affine)
    assert cell_E_D(constant, mesh).tolist() == [0] * len(mesh.cells)
    assert E_D(constant, mesh) == 0


@kernel
def test_E_D_of_a_constant_image_whose_mean_is_rounded_is_0():
    """The mean of 600 times this value is another float: 4e-16 less."""
    image = Image(np.full((10, 10, 6), 1.3509650502241122))
    assert np.mean(image.data) != image.data[0, 0, 0]
    assert E_D(image, lattice_mesh(image, blocks=(1, 1, 1))) == 0


@kernel
def test_E_D_of_an_image_constant_in_every_cell_is_0():
    """Two cells, 3 and 7: the mesh is aligned with the image, the goal of the whole method."""
    mesh = Mesh(TWO_TRIANGLES[0] * 8 - 0.5, TWO_TRIANGLES[1])
    image = Image(np.zeros((8, 8)))
    aligned = Image(np.where(cell_of_voxel(image, mesh) == 0, 3.0, 7.0))
    assert E_D(aligned, mesh) == pytest.approx(0, abs=1e-12)
    assert cell_moments(aligned, mesh).mean.tolist() == [3, 7]


# Closed forms


@pytest.mark.parametrize("size", [2, 3, 10])
@kernel
def test_E_D_of_a_linear_image_on_two_triangles(size):
    """h = i. The upper cell has size - i voxels of value i, the lower has i (see the rule of
    ties).
    """
    s = size
    image = Image(
        np.broadcast_to(np.arange(s, dtype=float)[:, None], (s, s)), np.diag([2.0, 3.0, 1.0])
    )
    mesh = Mesh(image.to_world(TWO_TRIANGLES[0] * s - 0.5), TWO_TRIANGLES[1])
    n_lower, n_upper = s * (s - 1) / 2, s * (s + 1) / 2
    # upper: of size - i
    sum_lower, sum_upper = (s - 1) * s * (2 * s - 1) / 6, s * (s + 1) * (2 * s + 1) / 6
    expected = [
        6 * (n_upper**2 - sum_upper**2 / n_upper),
        6 * (n_lower**2 - sum_lower**2 / n_lower),
    ]
    assert cell_E_D(image, mesh) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("n", "kind", "gradient", "order"),
    [
        (2, "criss-cross", (1.0, 0.5), 4),
        (3, "bcc", (1.0, 0.5, -0.25), 2),
        (3, "five-tet", (1.0, 0.5, -0.25), 2),
    ],
)
def test_E_D_of_a_linear_image_converges_with_the_voxels(n, kind, gradient, order):
    """h = g . x over one block of 1 mm^n cut into s^n voxels.

    The exact E_D of a linear h is sum_j v_j sum over nodes (h_i - hbar)^2 / ((n+1)(n+2)). Voxels
    miss the variance inside themselves, about s^-2, and cells have ragged sides: order 2. In the
    criss-cross, where the tie of each diagonal goes to one of two equal cells, the two effects
    cancel, and the order is 4.
    """
    errors = []
    for size in (16, 32, 64):
        affine = np.diag([1 / size] * n + [1.0])
        grid = Image(np.zeros((size,) * n, dtype=np.uint8), affine)
        centres = grid.to_world(np.moveaxis(np.indices(grid.shape), 0, -1))
        image = Image(centres @ np.array(gradient), affine)
        mesh = lattice_mesh(image, kind, blocks=(1,) * n)
        h = (mesh.points @ np.array(gradient))[mesh.cells]
        spread = ((h - h.mean(axis=1, keepdims=True)) ** 2).sum(axis=1) / ((n + 1) * (n + 2))
        exact = (volumes(mesh.points, mesh.cells) * spread).sum()
        errors.append(abs(E_D(image, mesh) / exact - 1))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert rates == pytest.approx([order, order], abs=0.1)
    assert errors[-1] < 1e-3


def test_E_D_of_the_sphere_is_the_analytic_one():
    """A ball of radius r = 20 mm and contrast c = 80 in a box of V = 64^3 mm^3, cut into 12 cells
    by its centre.

    By symmetry every cell has the ball's fraction f = 4/3 pi r^3 / V, so E_D = V f (1 - f) c^2.

    Voxels on the sphere hold a mean, and their own variance is lost: c^2 p (1 - p) each, p the
    ball's fraction of the voxel. Integrated along the normal u a voxel loses E|u . (X - Y)| / 2, X
    and Y random in it: 1/6 for a voxel face on, 0.2887 / sqrt(pi) = 0.163 for the sum of many
    coordinates. Taken as 0.1645 +- 0.002, times 4 pi r^2 c^2, it is 2.83 % of E_D, sure to 0.04 %.
    The cells are ragged: centres lie on their walls, counts differ by 7 %, and means by less than
    1; what lies between them is (1/80)^2 ~ 0.02 % of E_D. So 0.1 % in all.
    """
    image = load_phantom("sphere").image()
    assert image.volume == pytest.approx(64**3)
    r, contrast, V = 20.0, 80.0, 64.0**3
    mesh = lattice_mesh(image, "bcc", blocks=(1, 1, 1))
    assert len(mesh.cells) == 12
    f = 4 / 3 * pi * r**3 / V
    analytic = V * f * (1 - f) * contrast**2
    lost = 0.1645 * 4 * pi * r**2 * contrast**2
    sampled = E_D(image, mesh)
    assert sampled == pytest.approx(analytic, rel=0.03)
    assert sampled == pytest.approx(analytic - lost, rel=1e-3)


# The law of total variance


@given(seeds, dimensions)
@kernel
def test_E_D_is_at_most_the_image_s_variance_times_its_volume(seed, n):
    """What is left out is the variance between the cells' means."""
    image, mesh = random_case(seed, n)
    moments = cell_moments(image, mesh)
    whole = image.data.astype(np.float64).var() * image.volume
    between = (
        moments.n_voxels * (moments.mean - image.data.mean()) ** 2
    ).sum() * image.voxel_volume
    assert E_D(image, mesh) == pytest.approx(whole - between, rel=1e-9, abs=1e-9 * whole)
    assert 0 <= E_D(image, mesh) <= whole * (1 + 1e-12)


@given(seeds, dimensions)
@kernel
def test_splitting_cells_does_not_raise_E_D(seed, n):
    """Every cell cut into n + 1 by its centroid; the parts' E_D together is no more than the
    cell's.
    """
    image, mesh = random_case(seed, n)
    centres = mesh.points[mesh.cells].mean(axis=1)
    numbers = len(mesh.points) + np.arange(len(mesh.cells))
    parts = np.repeat(mesh.cells[:, None], n + 1, axis=1)
    parts[:, np.arange(n + 1), np.arange(n + 1)] = numbers[:, None]
    finer = Mesh(np.vstack([mesh.points, centres]), parts.reshape(-1, n + 1))
    whole, split = cell_E_D(image, mesh), cell_E_D(image, finer).reshape(-1, n + 1).sum(axis=1)
    assert (split <= whole * (1 + 1e-9) + 1e-9 * image.voxel_volume).all()


@given(seeds, dimensions)
@kernel
def test_E_D_scales_with_contrast_squared_and_volume(seed, n):
    image, mesh = random_case(seed, n)
    brighter = Image(3.0 * image.data.astype(np.float64) - 7.0, image.affine)
    np.testing.assert_allclose(
        cell_E_D(brighter, mesh), 9 * cell_E_D(image, mesh), rtol=1e-9, atol=1e-6
    )
    scaling = np.diag([2.0] * n + [1.0])
    larger = Image(image.data, scaling @ image.affine)
    np.testing.assert_allclose(
        cell_E_D(larger, Mesh(2.0 * mesh.points, mesh.cells)),
        2**n * cell_E_D(image, mesh),
        rtol=1e-9,
        atol=1e-6,
    )


@given(seeds, dimensions)
@kernel
def test_E_D_is_the_sum_of_squares_around_each_cell_s_mean(seed, n):
    image, mesh = random_case(seed, n)
    owner = naive.cell_of_voxel(image, mesh)
    data = image.data.astype(np.float64)
    expected = [
        ((data[owner == j] - data[owner == j].mean()) ** 2).sum() if (owner == j).any() else 0.0
        for j in range(len(mesh.cells))
    ]
    np.testing.assert_allclose(
        cell_E_D(image, mesh),
        np.array(expected) * image.voxel_volume,
        rtol=1e-9,
        atol=1e-8 * image.voxel_volume,
    )
    assert E_D(image, mesh) == pytest.approx(cell_E_D(image, mesh).sum(), rel=1e-15)


@kernel
def test_unexplained_is_what_cells_leave_of_the_variance_of_their_voxels():
    """Of a mesh with empty cells that covers a part of the image."""
    image, mesh = part_of_noise()
    assert (cell_moments(image, mesh).n_voxels == 0).any()
    within = image.data[naive.cell_of_voxel(image, mesh) >= 0].astype(np.float64)
    expected = E_D(image, mesh) / (within.var() * within.size)
    assert 0.1 < expected < 0.9
    assert unexplained_variance(content(image), mesh) == pytest.approx(expected, rel=1e-9)
    assert unexplained_variance(content(Image(np.ones((6, 5, 4)))), mesh) is None


@kernel
def test_unexplained_of_two_equal_contrasts_is_that_of_one():
    image, mesh = part_of_noise()
    one = unexplained_variance(content(image), mesh)
    assert unexplained_variance(content([image, image]), mesh) == pytest.approx(one, rel=1e-3)


def part_of_noise():
    """An image of noise, and cells in a half of it, some without a voxel."""
    image = Image(np.random.default_rng(0).normal(5.0, 1.0, (6, 5, 4)))
    whole = lattice_mesh(image, blocks=(1, 1, 12))
    return image, Mesh(whole.points, whole.cells[: len(whole.cells) // 2])


# Eq. (4)


def test_combined_is_normalised_by_the_initial_mesh():
    assert combine_energies(3.0, 5.0, 3.0, 5.0, 0.3) == pytest.approx(1)
    assert combine_energies(6.0, 5.0, 3.0, 10.0, 0.25) == pytest.approx(0.75 * 2 + 0.25 * 0.5)
    assert combine_energies(6.0, 5.0, 3.0, 10.0, 0.0) == 2
    assert combine_energies(6.0, 5.0, 3.0, 10.0, 1.0) == 0.5


def test_combined_leaves_out_the_image_of_a_constant_one():
    assert combine_energies(6.0, 0.0, 3.0, 0.0, 0.25) == 1.5
    assert combine_energies(3.0, 0.0, 3.0, 0.0, 0.25) == 0.75
