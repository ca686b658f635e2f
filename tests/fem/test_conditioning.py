"""Eigenvalues against full matrices, iteration counts against a loop of ten lines, and how both
scale.
"""

import numpy as np
import pytest
from refusals import refusal
from scipy.sparse import diags_array

from tetopt import Image, lattice_mesh
from tetopt.fem.conditioning import cg_iterations, conditioning, lambda_max, lambda_min
from tetopt.fem.elasticity import box_faces, compression


def system(n, blocks, *, is_bonded=True, order=1, contrast=10.0):
    """A box of random moduli, its top fixed and its bottom pushed."""
    image = Image(np.zeros((4, 5, 6)[:n]))
    mesh = lattice_mesh(image, blocks=blocks)
    young = np.exp(np.random.default_rng(1).uniform(0.0, np.log(contrast), len(mesh.cells)))
    low, high = box_faces(image, mesh)
    push = np.zeros(n)
    push[-1] = 0.1
    return compression(
        mesh,
        young,
        0.45,
        fixed_nodes=high,
        pushed_nodes=low,
        displacement=push,
        is_bonded=is_bonded,
        order=order,
    ).system


def plain_cg(K, b, rtol):
    """Conjugate gradients with the diagonal as preconditioner, out of the textbook."""
    x, residual = np.zeros(len(b)), b.copy()
    direction, old = np.zeros(len(b)), 1.0
    for step in range(10 * len(b)):
        if np.linalg.norm(residual) <= rtol * np.linalg.norm(b):
            return step
        z = residual / K.diagonal()
        new = residual @ z
        direction = z + (new / old if step else 0.0) * direction
        step_length = new / (direction @ (K @ direction))
        x += step_length * direction
        residual = residual - step_length * (K @ direction)
        old = new
    raise AssertionError("not converged")


# Eigenvalues


@pytest.mark.parametrize("method", ["direct", "amg"])
@pytest.mark.parametrize(
    ("n", "blocks", "is_bonded", "order"),
    [
        (2, (8, 7), True, 1),
        (3, (3, 3, 3), False, 1),
        (3, (1, 1, 1), True, 1),
        (3, (1, 1, 2), True, 2),
    ],
)
def test_eigenvalues_are_those_of_the_full_matrix(n, blocks, is_bonded, order, method):
    equations = system(n, blocks, is_bonded=is_bonded, order=order)
    values = np.linalg.eigvalsh(equations.K_ff.toarray())
    extremes = conditioning(equations, method=method)
    assert extremes.lambda_max == pytest.approx(values[-1], rel=1e-9)
    assert extremes.lambda_min == pytest.approx(values[0], rel=1e-7)
    assert extremes.cond == pytest.approx(np.linalg.cond(equations.K_ff.toarray()), rel=1e-6)
    assert extremes.cond == extremes.lambda_max / extremes.lambda_min
    assert abs(extremes.cg_iterations - cg_iterations(equations.K_ff, equations.load)) <= 1


@pytest.mark.parametrize("n_free", [1, 2, 31, 32, 33, 34, 200])
def test_known_spectrum(n_free):
    """A diagonal matrix, from dofs so few that they are done as a full matrix to those done by
    Lanczos.
    """
    K = diags_array(np.arange(1.0, n_free + 1.0)).tocsr()
    assert lambda_max(K) == pytest.approx(n_free, rel=1e-12)
    assert lambda_min(K) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("method", ["direct", "amg"])
def test_the_same_in_every_run(method):
    equations = system(3, (5, 5, 5))
    np.random.seed(1)  # noqa: NPY002  neither asks nor moves the global generator
    first = conditioning(equations, method=method)
    second = conditioning(equations, method=method)
    # BLAS may round by where an array lies in memory
    assert second[:3] == pytest.approx(first[:3], rel=1e-11)
    assert abs(second.cg_iterations - first.cg_iterations) <= 1
    drawn = np.random.random()  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    assert drawn == np.random.random()  # noqa: NPY002


# Iterations


@pytest.mark.parametrize("rtol", [1e-2, 1e-6, 1e-10])
@pytest.mark.parametrize(("n", "blocks", "is_bonded"), [(2, (9, 8), True), (3, (3, 3, 3), False)])
def test_count_is_that_of_the_textbook(n, blocks, is_bonded, rtol):
    equations = system(n, blocks, is_bonded=is_bonded)
    expected = plain_cg(equations.K_ff, equations.load, rtol)
    assert expected > 0
    assert cg_iterations(equations.K_ff, np.zeros_like(equations.load)) == 0
    # Sums are rounded in another order, which shows after a hundred steps.
    assert abs(cg_iterations(equations.K_ff, equations.load, rtol) - expected) <= expected // 100


# Messages


def test_what_has_no_condition():
    image = Image(np.zeros((2, 2, 2)))
    mesh = lattice_mesh(image, "five-tet", blocks=(1, 1, 1))
    low, high = box_faces(image, mesh)
    held = {"fixed_nodes": high, "pushed_nodes": low, "displacement": [0.0, 0.0, 0.1]}
    pressed = compression(mesh, 1.0, 0.3, **held)
    with refusal("conditioning: every node is fixed or pushed"):
        conditioning(pressed.system)
    with refusal("method: expected auto"):
        conditioning(system(2, (2, 2)), method="lu")


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of scipy, when the residual is down to 0
def test_no_convergence_is_an_error():
    equations = system(2, (9, 8))
    with pytest.raises(
        RuntimeError,
        match=r"^conditioning: conjugate gradients did not reach 1e-300 of the load in \d+ steps$",
    ):
        cg_iterations(equations.K_ff, equations.load, 1e-300)
    # As bad a preconditioner as can be: the matrix itself.
    ill = system(2, (30, 30), contrast=1e6).K_ff
    with pytest.raises(
        RuntimeError,
        match=r"^conditioning: the smallest eigenvalue did not converge, because a solve did not$",
    ):
        lambda_min(ill, ill)
