"""E_D: closed forms on voxels, the analytic sphere, the law of total variance, and Eq. (4)."""

import naive
import numpy as np
import pytest
from hypothesis import given
from meshes import delaunay_box, dimensions, random_affine, seeds, split_box

from tetopt import (
    E_D,
    Image,
    Mesh,
    cell_moments,
    content,
    lattice_mesh,
)
from tetopt.energy.discretization import cell_E_D, combine_energies, unexplained_variance
from tetopt.geometry.simplex import orient_cells


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
@pytest.mark.kernel
def test_E_D_of_a_constant_image_is_0(seed, n):
    """Exactly 0: the term of a constant image is left out of Eq. (4), and noise divided by noise
    must not come in.
    """
    rng = np.random.default_rng(seed)
    image, mesh = random_case(seed, n)
    value = rng.normal() * 10.0 ** rng.integers(-6, 7)
    constant = Image(np.full(image.shape, value), image.affine)
    assert (cell_E_D(constant, mesh) == 0.0).all()
    assert E_D(constant, mesh) == 0


@pytest.mark.kernel
def test_E_D_of_a_constant_image_whose_mean_is_rounded_is_0():
    """The mean of 600 times this value is another float: 4e-16 less."""
    image = Image(np.full((10, 10, 6), 1.3509650502241122))
    assert np.mean(image.data) != image.data[0, 0, 0]
    assert E_D(image, lattice_mesh(image, blocks=(1, 1, 1))) == 0


# Closed forms


# The law of total variance


@given(seeds, dimensions)
@pytest.mark.kernel
def test_E_D_is_the_sum_of_squares_around_each_cell_s_mean(seed, n):
    image, mesh = random_case(seed, n)
    owner, data = naive.cell_of_voxel(image, mesh), image.data.astype(np.float64)
    squares = [
        ((data[owner == j] - data[owner == j].mean()) ** 2).sum() if (owner == j).any() else 0.0
        for j in range(len(mesh.cells))
    ]
    of_cells = cell_E_D(image, mesh)
    np.testing.assert_allclose(of_cells / image.voxel_volume, squares, rtol=1e-9, atol=1e-8)
    assert E_D(image, mesh) == pytest.approx(of_cells.sum(), rel=1e-15)


@pytest.mark.kernel
def test_unexplained_is_what_cells_leave_of_the_variance_of_their_voxels():
    """Of a mesh with empty cells that covers a half of the image; of two equal contrasts the same
    as of one.
    """
    image = Image(np.random.default_rng(0).normal(5.0, 1.0, (6, 5, 4)))
    whole = lattice_mesh(image, blocks=(1, 1, 12))
    mesh = Mesh(whole.points, whole.cells[: len(whole.cells) // 2])
    assert (cell_moments(image, mesh).n_voxels == 0).any()
    within = image.data[naive.cell_of_voxel(image, mesh) >= 0].astype(np.float64)
    expected = E_D(image, mesh) / (within.var() * within.size)
    assert 0.1 < expected < 0.9
    assert unexplained_variance(content(image), mesh) == pytest.approx(expected, rel=1e-9)
    assert unexplained_variance(content([image] * 2), mesh) == pytest.approx(expected, rel=1e-3)
    assert unexplained_variance(content(Image(np.ones((6, 5, 4)))), mesh) is None


@pytest.mark.parametrize(
    ("energies", "k_D", "expected"),
    [
        ((3.0, 5.0, 3.0, 5.0), 0.3, 1.0),
        ((6.0, 5.0, 3.0, 10.0), 0.25, 0.75 * 2 + 0.25 * 0.5),
        ((6.0, 5.0, 3.0, 10.0), 0.0, 2.0),
        ((6.0, 5.0, 3.0, 10.0), 1.0, 0.5),
        ((6.0, 0.0, 3.0, 0.0), 0.25, 1.5),  # a constant image is left out
        ((3.0, 0.0, 3.0, 0.0), 0.25, 0.75),
    ],
)
def test_combined_is_normalised_by_the_initial_mesh(energies, k_D, expected):
    assert combine_energies(*energies, k_D) == pytest.approx(expected, rel=1e-15)


# Eq. (4)
