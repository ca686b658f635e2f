"""Eigenvalues against full matrices, iteration counts against a loop of ten lines, and how both
scale.
"""

import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array

from tetopt import Image, InputError, Mesh, lattice_mesh
from tetopt.fem.conditioning import cg_iterations, conditioning, lambda_max, lambda_min
from tetopt.fem.elasticity import box_faces, compression


def system(n, blocks, *, is_bonded=True, factor=1.0, size=1.0, contrast=10.0, nu=0.45):
    """A box of random moduli, its top fixed and its bottom pushed."""
    image = Image(np.zeros((4, 5, 6)[:n]))
    mesh = lattice_mesh(image, blocks=blocks)
    young = np.exp(np.random.default_rng(1).uniform(0.0, np.log(contrast), len(mesh.cells)))
    low, high = box_faces(image, mesh)
    push = np.zeros(n)
    push[-1] = 0.1 * size
    return compression(
        Mesh(size * mesh.points, mesh.cells),
        factor * young,
        nu,
        fixed_nodes=high,
        pushed_nodes=low,
        displacement=push,
        is_bonded=is_bonded,
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
    ("n", "blocks", "is_bonded"), [(2, (8, 7), True), (3, (3, 3, 3), False), (3, (2, 2, 3), True)]
)
def test_eigenvalues_are_those_of_the_full_matrix(n, blocks, is_bonded, method):
    equations = system(n, blocks, is_bonded=is_bonded)
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


def test_a_tiny_mesh():
    equations = system(3, (1, 1, 1))
    assert equations.K_ff.shape == (3, 3)
    values = np.linalg.eigvalsh(equations.K_ff.toarray())
    for method in ("auto", "direct", "amg"):
        extremes = conditioning(equations, method=method)
        assert extremes[:2] == pytest.approx((values[-1], values[0]), rel=1e-13)
        assert 1 <= extremes.cg_iterations <= 3


@pytest.mark.full
def test_multigrid_and_factorisation_agree_on_a_larger_mesh():
    equations = system(3, (8, 8, 8), contrast=1000.0)
    assert len(equations.free) > 2500
    direct, amg = (conditioning(equations, method=method) for method in ("direct", "amg"))
    assert amg.lambda_min == pytest.approx(direct.lambda_min, rel=1e-8)
    assert amg.lambda_max == pytest.approx(direct.lambda_max, rel=1e-11)
    assert abs(amg.cg_iterations - direct.cg_iterations) <= 1


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


# Laws


@pytest.mark.parametrize("n", [2, 3])
def test_scaling(n):
    """Moduli scale eigenvalues and not cond; sizes scale them by s^(n-2); the count knows
    neither.
    """
    blocks = (6, 5, 4)[:n]
    base = conditioning(system(n, blocks))
    stiff = conditioning(system(n, blocks, factor=1000.0))
    large = conditioning(system(n, blocks, size=7.0))
    assert stiff.lambda_max == pytest.approx(1000.0 * base.lambda_max, rel=1e-9)
    assert stiff.lambda_min == pytest.approx(1000.0 * base.lambda_min, rel=1e-9)
    assert large.lambda_max == pytest.approx(7.0 ** (n - 2) * base.lambda_max, rel=1e-9)
    assert stiff.cond == pytest.approx(base.cond, rel=1e-9)
    assert large.cond == pytest.approx(base.cond, rel=1e-9)
    assert abs(stiff.cg_iterations - base.cg_iterations) <= 1
    assert abs(large.cg_iterations - base.cg_iterations) <= 1


def test_finer_meshes_contrast_and_near_incompressibility_are_worse_conditioned():
    """cond grows as 1/h^2: by nearly 4 when h is halved."""
    coarse, fine = (conditioning(system(2, (b, b), contrast=1.0, nu=0.3)) for b in (10, 20))
    assert 3.5 < fine.cond / coarse.cond < 4.2
    assert fine.cg_iterations > 1.5 * coarse.cg_iterations
    assert conditioning(system(2, (10, 10), contrast=100.0, nu=0.3)).cond > 3.0 * coarse.cond
    assert (
        conditioning(system(3, (5, 5, 5), nu=0.499)).cond
        > 10.0 * conditioning(system(3, (5, 5, 5), nu=0.3)).cond
    )


def test_a_flat_cell_raises_lambda_max():
    """The paper's reason to look at lambda: a node moved to 1/1000 of the way from its facet."""
    image = Image(np.zeros((4, 4, 4)))
    mesh = lattice_mesh(image, blocks=(2, 2, 2))
    low, high = box_faces(image, mesh)
    options = {"fixed_nodes": high, "pushed_nodes": low, "displacement": [0.0, 0.0, 0.1]}
    before = conditioning(compression(mesh, 1.0, 0.3, **options).system)
    inner = len(mesh.points) - 1  # a cube's centre
    points = mesh.points.copy()
    cell = mesh.cells[(mesh.cells == inner).any(axis=1)][0]
    points[inner] = 0.999 * points[cell[cell != inner]].mean(axis=0) + 0.001 * points[inner]
    after = conditioning(compression(Mesh(points, mesh.cells), 1.0, 0.3, **options).system)
    assert after.lambda_max > 50.0 * before.lambda_max
    assert after.cond > 50.0 * before.cond


# Iterations


@pytest.mark.parametrize("rtol", [1e-2, 1e-6, 1e-10])
@pytest.mark.parametrize(("n", "blocks", "is_bonded"), [(2, (9, 8), True), (3, (3, 3, 3), False)])
def test_count_is_that_of_the_textbook(n, blocks, is_bonded, rtol):
    equations = system(n, blocks, is_bonded=is_bonded)
    expected = plain_cg(equations.K_ff, equations.load, rtol)
    assert expected > 0
    # Sums are rounded in another order, which shows after a hundred steps.
    assert abs(cg_iterations(equations.K_ff, equations.load, rtol) - expected) <= expected // 100


@pytest.mark.full
def test_count_of_easy_systems():
    """One step for a diagonal matrix, whatever is on it; three for three eigenvalues; none for
    no load.
    """
    b = np.random.default_rng(0).normal(size=300)
    assert cg_iterations(diags_array(np.arange(1.0, 301.0)).tocsr(), b) == 1
    householder = np.eye(300) - 2.0 * np.outer(b, b) / (b @ b)
    flat = np.random.default_rng(1).choice([-1.0, 1.0], (300, 300))
    turn, _ = np.linalg.qr(flat @ householder)
    K = turn @ np.diag(np.repeat([1.0, 2.0, 5.0], 100)) @ turn.T
    scale = np.sqrt(np.diag(K))
    K = K / scale[:, None] / scale  # unit diagonal: Jacobi does nothing
    assert cg_iterations(csr_array(K), b) == plain_cg(K, b, 1e-10)
    assert cg_iterations(csr_array(K), np.zeros(300)) == 0


# Messages


def test_nothing_to_solve():
    image = Image(np.zeros((2, 2, 2)))
    mesh = lattice_mesh(image, "five-tet", blocks=(1, 1, 1))
    low, high = box_faces(image, mesh)
    pressed = compression(
        mesh, 1.0, 0.3, fixed_nodes=high, pushed_nodes=low, displacement=[0.0, 0.0, 0.1]
    )
    with pytest.raises(InputError) as error:
        conditioning(pressed.system)
    assert str(error.value) == (
        "conditioning: every node is fixed or pushed, so there is nothing to solve; use a finer "
        "mesh"
    )


def test_unknown_method():
    with pytest.raises(InputError) as error:
        conditioning(system(2, (2, 2)), method="lu")
    assert str(error.value) == "method: expected auto, direct or amg, got 'lu'"


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
