"""The matrix-free solution on the voxel grid, against its assembled twin and against what must be true of it."""

from itertools import product

import naive
import numpy as np
import pytest

import tetopt
from tetopt.fem import voxel_kernels
from tetopt.fem.voxels import (
    block_means,
    coarser,
    element_stiffness,
    grid_of,
    interpolated,
    multigrid_of,
    preconditioned,
    solve_voxels,
    stiffness_product,
)

kernel = pytest.mark.kernel

STRAIGHT = np.diag([1.5, 0.7, 0.9])
SHEARED = np.array([[1.5, 0.3, -0.2], [0.1, 2.0, 0.4], [0.2, -0.3, 0.8]])
TURNED = SHEARED[[2, 0, 1]]  # its upright axis is the second
# Odd and even numbers, one voxel thick across and along the plates, with the longest axis first, in the middle, last.
SHAPES = [((3, 2, 5), SHEARED), ((5, 3, 4), TURNED), ((2, 7, 3), STRAIGHT), ((4, 1, 3), SHEARED), ((6, 5, 1), STRAIGHT)]
SHAPES += [((5, 6), SHEARED[:2, :2]), ((7, 4), STRAIGHT[:2, :2][::-1]), ((1, 3), SHEARED[:2, :2])]


def grid_and_oracle(shape, linear, nu, contrast=10.0, seed=0):
    """A grid of random moduli, its dense stiffness, and where the image's dofs are free."""
    n = len(shape)
    affine = np.eye(n + 1)
    affine[:n, :n] = linear
    rng = np.random.default_rng(seed)
    image = tetopt.Image(contrast ** rng.uniform(0.0, 1.0, shape), affine)
    grid = grid_of(image, nu)
    K = naive.grid_stiffness(shape, image.data.astype(np.float64), element_stiffness(image.affine[:n, :n], nu))
    is_free = np.ones((*(s + 1 for s in shape), n), dtype=bool)
    upright = int(np.argmax(np.abs(linear[-1]) / np.linalg.norm(linear, axis=0)))
    np.moveaxis(is_free, upright, 0)[[0, -1]] = False
    return grid, K, is_free.ravel()


def field(grid, values):
    """Dofs of the image as a field of nodes."""
    u = grid.nodes()
    inner = grid.in_image(u)
    inner[:] = np.reshape(values, inner.shape)
    return u


@kernel
@pytest.mark.parametrize(("shape", "linear"), SHAPES)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_product_is_the_matrix(shape, linear, dtype):
    grid, K, _ = grid_and_oracle(shape, linear, 0.4)
    values = np.random.default_rng(1).normal(size=len(K))
    if dtype == np.float64:
        out = stiffness_product(grid, field(grid, values))
    else:
        terms = voxel_kernels.element_terms(element_stiffness(grid.jacobian, grid.nu))
        out = grid.nodes().astype(dtype)
        terms = terms._replace(value=terms.value.astype(dtype))
        voxel_kernels.add_product(out, field(grid, values).astype(dtype), grid.young.astype(dtype), terms)
    tolerance = 1e-13 if dtype == np.float64 else 1e-5
    np.testing.assert_allclose(grid.in_image(out).ravel(), K @ values, atol=tolerance * np.abs(K).max() * 10)


@kernel
def test_rows_longer_than_a_chunk(monkeypatch):
    """Chunks of a row, and slabs of planes, join without a seam."""
    shape = (2 * voxel_kernels.SLAB_PLANES + 1, voxel_kernels.CHUNK_VOXELS + 2)
    grid, _, _ = grid_and_oracle((3, 2), STRAIGHT[:2, :2], 0.3)
    rng = np.random.default_rng(0)
    grid = grid._replace(young=rng.uniform(1.0, 2.0, (shape[0], 1, shape[1])))
    slope = rng.normal(size=(2, 2))
    index = np.stack(np.meshgrid(*(np.arange(s + 1.0) for s in shape), indexing="ij"))
    u = np.einsum("ij,jkl->ikl", slope @ grid.jacobian, index)[:, :, None]
    out = stiffness_product(grid, u)
    # A linear field strains each voxel alike: the energy is that of each, times its modulus.
    corners = np.array(list(product((0.0, 1.0), repeat=2))) @ (slope @ grid.jacobian).T
    each = np.einsum("ai,abij,bj->", corners, element_stiffness(grid.jacobian, 0.3), corners)
    assert voxel_kernels.product(u, out) == pytest.approx(each * grid.young.sum(), rel=1e-12)


@kernel
@pytest.mark.parametrize(("shape", "linear"), [SHAPES[0], SHAPES[5]])
def test_product_and_cycle_are_symmetric(shape, linear):
    """x.Ay = y.Ax, x.My = y.Mx up to single precision, and M is positive."""
    grid, _, _ = grid_and_oracle(shape, linear, 0.4)
    rng = np.random.default_rng(2)
    hierarchy = multigrid_of(grid._replace(young=np.tile(grid.young, (2, len(shape) - 1, 2))))
    assert len(hierarchy.levels) > 1
    x, y = (rng.normal(size=hierarchy.levels[0].x.shape) for _ in range(2))
    np.moveaxis(x, 1 + grid.plates, 0)[[0, -1]] = 0.0
    np.moveaxis(y, 1 + grid.plates, 0)[[0, -1]] = 0.0
    My = preconditioned(hierarchy, y, 1.0).copy()
    Mx = preconditioned(hierarchy, x, 1.0).copy()
    assert voxel_kernels.product(x, My) == pytest.approx(voxel_kernels.product(y, Mx), rel=1e-4)
    assert voxel_kernels.product(x, Mx) > 0.0
    assert not np.moveaxis(Mx, 1 + grid.plates, 0)[[0, -1]].any()


@kernel
@pytest.mark.parametrize(("fine", "coarse"), [(7, 4), (8, 4), (3, 2), (2, 1), (5, 5), (1, 1)])
def test_transfers_against_dense_ones(fine, coarse):
    """Along each axis its own; restriction is the transpose."""
    rng = np.random.default_rng(fine)
    shapes = np.array([(fine, coarse), (4, 2), (5, 3)])
    ways = tuple(voxel_kernels.transfer(*pair) for pair in shapes.tolist())
    P = [naive.interpolation(*pair) for pair in shapes.tolist()]
    e = rng.normal(size=(3, *(shapes[:, 1] + 1))).astype(np.float32)
    r = rng.normal(size=(3, *(shapes[:, 0] + 1))).astype(np.float32)
    d, x, back = np.empty_like(r), r.copy(), np.empty_like(e)
    voxel_kernels.prolong(d, x, e, ways)
    np.testing.assert_allclose(d, np.einsum("ai,bj,ck,dijk->dabc", *P, e), atol=1e-5)
    np.testing.assert_array_equal(x, r + d)
    voxel_kernels.restrict(back, r, ways)
    np.testing.assert_allclose(back, np.einsum("ai,bj,ck,dabc->dijk", *P, r), atol=1e-5)


@kernel
def test_steps_of_the_iteration():
    """Smoothing, conjugate gradients' two updates and the inner product, by numpy."""
    rng = np.random.default_rng(5)
    x, r, p, q = (rng.normal(size=(3, 4, 3, 5)) for _ in range(4))
    total, left = x + 0.3 * p, r - 0.3 * q
    assert voxel_kernels.advance(x, r, p, q, 0.3) == pytest.approx((left**2).sum(), rel=1e-13)
    np.testing.assert_allclose(x, total, rtol=1e-13)
    np.testing.assert_allclose(r, left, rtol=1e-13)
    z = q.astype(np.float32)
    assert voxel_kernels.product(r, z) == pytest.approx((r * z).sum(), rel=1e-12)
    direction = z + 0.7 * p
    voxel_kernels.turn(p, z, 0.7)
    np.testing.assert_allclose(p, direction, rtol=1e-13)
    d, y, f, weight = (rng.normal(size=z.shape).astype(np.float32) for _ in range(4))
    scale = np.array([1.0, 2.0, 3.0], dtype=np.float32)
    step = 0.2 * d + 2.4 * weight[0] * scale[:, None, None, None] * f
    after = y + step
    voxel_kernels.smooth(d, y, f, weight[0], scale, (0.2, 2.4))
    np.testing.assert_allclose(d, step, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(y, after, rtol=1e-4, atol=1e-6)


@kernel
@pytest.mark.parametrize(("shape", "linear"), SHAPES)
@pytest.mark.parametrize("nu", [-0.3, 0.45])
def test_solution_is_the_direct_one(shape, linear, nu):
    """To 1e-8 of the largest displacement, for every shape; the plates keep theirs."""
    grid, K, is_free = grid_and_oracle(shape, linear, nu)
    prescribed = np.random.default_rng(3).normal(size=len(K)) * ~is_free
    direct = prescribed.copy()
    free = np.flatnonzero(is_free)
    direct[free] = np.linalg.solve(K[np.ix_(free, free)], -(K[free] @ prescribed))
    u = field(grid, prescribed)
    solve_voxels(grid, u)
    ours = grid.in_image(u).ravel()
    np.testing.assert_allclose(ours, direct, atol=1e-8 * np.abs(direct).max())
    np.testing.assert_array_equal(ours[~is_free], prescribed[~is_free])


def big(shape, linear, nu, contrast, seed=4):
    """A grid that is too large for a dense matrix, and the plates' displacements."""
    n = len(shape)
    affine = np.eye(n + 1)
    affine[:n, :n] = linear
    rng = np.random.default_rng(seed)
    place = np.stack(np.meshgrid(*(np.linspace(-1.0, 1.0, s) for s in shape), indexing="ij"))
    is_hard = rng.uniform(size=shape) < 0.3 if contrast < 1e3 else (place**2).sum(axis=0) < 0.3
    data = np.where(is_hard, contrast, 1.0)
    grid = grid_of(tetopt.Image(data, affine), nu)
    u = grid.nodes()
    np.moveaxis(u, 1 + grid.plates, 0)[0] = rng.normal(size=(n, 1, 1))
    return grid, u


@pytest.mark.full
@pytest.mark.parametrize(
    ("shape", "linear", "nu", "contrast", "iterations"),
    [
        ((19, 23, 17), STRAIGHT, 0.45, 10.0, 60),
        ((19, 23, 17), np.eye(3), 0.3, 1.0, 20),
        ((40, 37, 6), np.diag([0.45, 0.45, 6.0]), 0.3, 10.0, 60),
        ((19, 23, 17), np.eye(3), 0.3, 1e4, 100),
        ((100, 80), np.eye(2), 0.3, 10.0, 40),
    ],
)
def test_iterations_do_not_grow_with_the_grid(shape, linear, nu, contrast, iterations):
    """Random moduli, the worst for coarse grids; long voxels; a ball that is harder by four orders of magnitude."""
    grid, u = big(shape, linear, nu, contrast)
    work = solve_voxels(grid, u)
    assert 3 < work.iterations < iterations
    assert work.residual < 1e-9


@kernel
@pytest.mark.parametrize(("shape", "linear"), [((3, 5, 4), SHEARED), ((5, 6), SHEARED[:2, :2])])
def test_patch(shape, linear):
    """One modulus, and plates that move as a linear field of uniaxial stress does: the solution is that field.

    The free sides bear no stress if the strain is of pull along the plates' normal, whatever the shear of the voxels,
    as long as they stand upright: those of the affine's axes along the sides.
    """
    n, nu = len(shape), 0.3
    upright = np.diag(np.diag(linear))
    grid, _, _ = grid_and_oracle(shape, upright, nu)
    grid = grid._replace(young=np.full_like(grid.young, 7.0))
    slope = np.diag([*(-nu,) * (n - 1), 1.0]) * 0.01
    index = np.stack(np.meshgrid(*(np.arange(s + 1.0) for s in shape), indexing="ij"), axis=-1)
    exact = index @ upright.T @ slope.T
    u = field(grid, exact)
    np.moveaxis(u, 1 + grid.plates, 0)[1:-1] = 0.0
    solve_voxels(grid, u)
    np.testing.assert_allclose(grid.in_image(u), exact, atol=1e-9 * np.abs(exact).max())


@kernel
@pytest.mark.parametrize("shape", [(7, 10, 9), (5, 1, 6)])
def test_block_means_against_exact_fractions(shape):
    data = np.random.default_rng(6).normal(size=shape)
    for new in (tuple((s + 1) // 2 for s in shape), tuple(max(1, s - 2) for s in shape), shape):
        np.testing.assert_allclose(block_means(data, new), naive.block_means(data, new), atol=1e-13)


def test_short_axes_are_coarsened_first():
    """Slices 6 mm apart wait for the pixels; two voxels stay between the plates."""
    grid, _ = big((40, 37, 6), np.diag([0.45, 0.45, 6.0]), 0.3, 10.0)
    shapes = [grid.young.shape]
    while coarser(grid) != grid.young.shape:
        grid = grid.coarsened(coarser(grid))
        shapes.append(grid.young.shape)
    slices = grid.plates
    assert [shape[slices] for shape in shapes[:5]] == [6, 6, 6, 6, 3]
    assert shapes[-1][slices] == 2
    assert np.prod(shapes[-1]) == 2


@kernel
def test_interpolated_is_exact_for_linear_fields():
    grid, _, _ = grid_and_oracle((5, 4, 6), SHEARED, 0.3)
    half = grid.coarsened(tuple(s // 2 for s in grid.young.shape))
    rng = np.random.default_rng(7)
    slope = rng.normal(size=(3, 3))

    def linear(g):
        index = np.stack(np.meshgrid(*(np.arange(s + 1.0) for s in g.young.shape), indexing="ij"))
        return np.einsum("ij,jklm->iklm", slope @ g.jacobian, index)

    np.testing.assert_allclose(interpolated(linear(half), half, grid), linear(grid), atol=1e-5)


@pytest.mark.full
def test_same_bits_on_any_number_of_threads():
    import numba

    grid, u = big((23, 19, 21), SHEARED, 0.3, 10.0)
    solutions = []
    for threads in (1, numba.config.NUMBA_NUM_THREADS):
        numba.set_num_threads(threads)
        solutions.append(u.copy())
        solve_voxels(grid, solutions[-1])
    np.testing.assert_array_equal(*solutions)


def test_says_when_it_is_not_solved(monkeypatch):
    grid, u = big((9, 9, 9), STRAIGHT, 0.3, 10.0)
    monkeypatch.setattr("tetopt.fem.voxels.ITERATION_LIMIT", 2)
    with pytest.raises(RuntimeError, match=r"reference: not solved: the residual .* mN exceeds"):
        solve_voxels(grid, u)
