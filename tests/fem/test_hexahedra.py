"""The solution on the voxel grid, against its dense twin and against what must be true of it."""

import naive
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from threadpoolctl import threadpool_limits

import tetopt
from tetopt.fem import elasticity
from tetopt.fem.hexahedra import (
    element_stiffness,
    free_stiffness,
    solve_between_plates,
    stiffness_product,
)
from tetopt.geometry.box import upright_axis

STRAIGHT = np.diag([1.5, 0.7, 0.9])
SHEARED = np.array([[1.5, 0.3, -0.2], [0.1, 2.0, 0.4], [0.2, -0.3, 0.8]])
TURNED = SHEARED[[2, 0, 1]]  # its upright axis is the second
# One voxel thick across and along the plates, with the longest axis first, in the middle, last.
SHAPES = [
    ((3, 2, 5), SHEARED),
    ((5, 3, 4), TURNED),
    ((2, 7, 3), STRAIGHT),
    ((4, 1, 3), SHEARED),
    ((6, 5, 1), STRAIGHT),
]
SHAPES += [((5, 6), SHEARED[:2, :2]), ((7, 4), STRAIGHT[:2, :2][::-1]), ((1, 3), SHEARED[:2, :2])]


def modulus_of(shape, linear, contrast=10.0):
    affine = np.eye(len(shape) + 1)
    affine[:-1, :-1] = linear
    return tetopt.Image(contrast ** np.random.default_rng(0).uniform(0.0, 1.0, shape), affine)


def nodes_of(modulus):
    """Random displacements of the nodes, and which of them are not on the plates."""
    u = np.random.default_rng(1).normal(size=(*(s + 1 for s in modulus.shape), modulus.ndim))
    is_free = np.ones(u.shape, dtype=bool)
    np.moveaxis(is_free, upright_axis(modulus.affine), 0)[[0, -1]] = False
    return u, is_free


@pytest.mark.parametrize("nu", [-0.3, 0.45])
@pytest.mark.parametrize(("shape", "linear"), SHAPES)
def test_product_matrix_and_solution_are_those_of_the_dense_matrix(shape, linear, nu):
    """The matrix is symmetric to the last bit, and the plates keep their displacements."""
    modulus = modulus_of(shape, linear)
    dense = naive.grid_stiffness(
        shape, modulus.data, element_stiffness(modulus.affine[:-1, :-1], nu)
    )
    u, is_free = nodes_of(modulus)
    free = np.flatnonzero(is_free)
    assert_allclose(stiffness_product(modulus, nu, u).ravel(), dense @ u.ravel(), atol=1e-12)
    K = free_stiffness(modulus, nu).toarray()
    assert_allclose(K, dense[np.ix_(free, free)], atol=1e-13)
    assert_array_equal(K, K.T)
    direct = (u * ~is_free).ravel()
    direct[free] = np.linalg.solve(dense[np.ix_(free, free)], -(dense[free] @ direct))
    ours = u.copy()
    solve_between_plates(modulus, nu, ours)
    assert_allclose(ours.ravel(), direct, atol=1e-11 * np.abs(direct).max())
    assert_array_equal(ours[~is_free], u[~is_free])


def multigrid_alone(monkeypatch):
    monkeypatch.setattr(elasticity, "DIRECT_DOFS", {2: 0, 3: 0})


@pytest.mark.parametrize(
    ("shape", "linear", "nu", "contrast"),
    [
        ((11, 12, 9), SHEARED, 0.45, 10.0),
        ((20, 18, 4), np.diag([0.45, 0.45, 6.0]), 0.3, 10.0),
        ((10, 11, 9), STRAIGHT, 0.3, 1e4),
        ((50, 40), np.eye(2), 0.3, 10.0),
    ],
)
def test_multigrid_and_factorisation_agree(monkeypatch, shape, linear, nu, contrast):
    """Random moduli, long voxels, and four orders of magnitude."""
    modulus = modulus_of(shape, linear, contrast)
    direct, _ = nodes_of(modulus)
    u = direct.copy()
    assert solve_between_plates(modulus, nu, direct) == 0
    multigrid_alone(monkeypatch)
    assert 3 < solve_between_plates(modulus, nu, u) < 80
    assert_allclose(u, direct, atol=1e-7 * np.abs(direct).max())


def test_same_bits_on_any_number_of_threads(monkeypatch):
    """BLAS shares inner products of more than 10,000 numbers."""
    multigrid_alone(monkeypatch)
    modulus = modulus_of((16, 17, 15), SHEARED)
    solutions = []
    for threads in (1, 4):
        solutions.append(nodes_of(modulus)[0])
        with threadpool_limits(threads):
            solve_between_plates(modulus, 0.3, solutions[-1])
    assert_array_equal(*solutions)


def test_says_when_it_is_not_solved(monkeypatch):
    multigrid_alone(monkeypatch)
    monkeypatch.setattr(elasticity, "cg", lambda K, load, **_: (np.zeros(len(load)), 1000))
    modulus = modulus_of((5, 4, 4), STRAIGHT)
    with pytest.raises(RuntimeError, match=r"not solved: the residual .* mN exceeds"):
        solve_between_plates(modulus, 0.3, nodes_of(modulus)[0])
