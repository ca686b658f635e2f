"""Elasticity: patch tests, closed forms, laws, the other library's answer, and what may not be
solved.
"""

import warnings
from itertools import combinations

import numpy as np
import pytest
import skfem
from hypothesis import given
from hypothesis import strategies as st
from meshes import ALL_SMALL, random_affine, random_rotation, split_box
from models import cell_energies
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree
from skfem.helpers import ddot, sym_grad, trace

from tetopt import Image, InputError, Mesh, lattice_mesh
from tetopt.fem import elasticity
from tetopt.fem.elasticity import (
    box_faces,
    compression,
    constrain_nodes,
    multigrid,
    solve_system,
    stiffness,
    strains,
)
from tetopt.fem.rigidity import check_held, rigid_modes
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.simplex import orient_cells, volumes
from tetopt.geometry.topology import boundary_facets, facets
from tetopt.start.carve import part_of

seeds = st.integers(0, 2**32 - 1)
dimensions = st.sampled_from([2, 3])


def block(sides, blocks, kind=None):
    """A lattice on the box from 0 to `sides`, mm."""
    n = len(sides)
    affine = np.eye(n + 1)
    affine[:n, :n] = np.diag(sides)
    affine[:n, n] = 0.5 * np.array(sides)
    image = Image(np.zeros((1,) * n), affine)
    return image, lattice_mesh(image, kind, blocks=blocks)


def distorted(mesh, rng, fraction=0.2):
    """The mesh with its inner nodes shifted by a fraction of the shortest edge."""
    points = mesh.points.copy()
    inner = np.setdiff1d(np.arange(len(points)), boundary_facets(mesh.cells))
    corners = points[mesh.cells]
    shortest = min(
        np.linalg.norm(corners[:, a] - corners[:, b], axis=1).min()
        for a, b in combinations(range(corners.shape[1]), 2)
    )
    step = rng.normal(size=(len(inner), mesh.ndim))
    points[inner] += fraction * shortest * step / np.linalg.norm(step, axis=1, keepdims=True)
    return Mesh(points, mesh.cells)


def random_mesh(rng, n, n_nodes=12):
    """A conforming mesh of uneven valence with thin cells, somewhere in space."""
    points, cells = split_box(rng, (3,) * n, n_nodes, step=0.25)
    return Mesh(points @ random_rotation(rng, n).T + rng.uniform(-20.0, 20.0, n), cells)


def squeezed(mesh, image, young, nu, strain=0.01, **options):
    """Top fixed, bottom pushed up by `strain` of the height along the last world axis."""
    low, high = box_faces(image, mesh)
    displacement = strain * (mesh.points[high].mean(axis=0) - mesh.points[low].mean(axis=0))
    return compression(
        mesh, young, nu, fixed_nodes=high, pushed_nodes=low, displacement=displacement, **options
    )


# The stiffness matrix


def textbook_stiffness(mesh, young, nu):
    """Cell by cell v B^T C B in Voigt's notation, with B from the inverse of the matrix of
    corner coordinates.
    """
    n = mesh.ndim
    pairs = [(d, d) for d in range(n)] + list(combinations(range(n), 2))
    if n == 2:
        C = np.array([[1.0, nu, 0.0], [nu, 1.0, 0.0], [0.0, 0.0, (1.0 - nu) / 2.0]]) / (1.0 - nu**2)
    else:
        C = np.diag([1.0 - 2.0 * nu] * 3 + [(1.0 - 2.0 * nu) / 2.0] * 3)
        C[:3, :3] += nu
        C /= (1.0 + nu) * (1.0 - 2.0 * nu)
    K = np.zeros((mesh.points.size, mesh.points.size))
    for cell, modulus in zip(mesh.cells, young, strict=True):
        slopes = np.linalg.inv(np.column_stack([np.ones(n + 1), mesh.points[cell]]))[1:]  # (n, n+1)
        B = np.zeros((len(pairs), n * (n + 1)))
        for row, (i, j) in enumerate(pairs):
            B[row, i::n] = slopes[j]
            B[row, j::n] = slopes[i]
        dofs = (cell[:, None] * n + np.arange(n)).ravel()
        v = abs(np.linalg.det(np.diff(mesh.points[cell], axis=0))) / (2.0 if n == 2 else 6.0)
        K[np.ix_(dofs, dofs)] += v * modulus * B.T @ C @ B
    return K


@pytest.mark.parametrize("nu", [-0.5, 0.3])
@pytest.mark.parametrize("case", ALL_SMALL)
def test_stiffness_is_the_textbook_s(case, nu):
    mesh = Mesh(*case)
    young = np.random.default_rng(1).uniform(1.0, 9.0, len(mesh.cells))
    expected = textbook_stiffness(mesh, young, nu)
    assert_allclose(
        stiffness(mesh, young, nu).toarray(), expected, atol=1e-13 * np.abs(expected).max()
    )


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("n", [2, 3])
def test_stiffness_is_scikit_fem_s(n, order):
    """Node by node: scikit-fem's dofs are matched to ours by where they lie."""
    mesh, nu = random_mesh(np.random.default_rng(5), n, 20), 0.45
    young = np.random.default_rng(6).uniform(1.0, 9.0, len(mesh.cells))
    K, place = skfem_stiffness(mesh, young, nu, order)
    points = mesh.points if order == 1 else quadratic(mesh.points, mesh.cells)[0]
    distance, ours = cKDTree(points).query(place)
    assert distance.max() < 1e-12
    assert len(np.unique(ours)) == len(points)
    dofs = (ours[:, None] * n + np.arange(n)).ravel()
    actual = stiffness(mesh, young, nu, order).toarray()[np.ix_(dofs, dofs)]
    assert_allclose(actual, K, atol=1e-12 * np.abs(K).max())


def skfem_stiffness(mesh, young, nu, order):
    """scikit-fem's matrix with dofs node by node, and where its nodes lie."""
    n = mesh.ndim
    element = {
        (2, 1): skfem.ElementTriP1,
        (3, 1): skfem.ElementTetP1,
        (2, 2): skfem.ElementTriP2,
        (3, 2): skfem.ElementTetP2,
    }[n, order]()
    Kind, constant = {
        2: (skfem.MeshTri, skfem.ElementTriP0),
        3: (skfem.MeshTet, skfem.ElementTetP0),
    }[n]
    bare = Kind(mesh.points.T.copy(), mesh.cells.T.copy())
    basis = skfem.Basis(bare, skfem.ElementVector(element), intorder=2 * order - 1 + (order == 1))
    narrowing = 1.0 - nu**2 if n == 2 else (1.0 + nu) * (1.0 - 2.0 * nu)

    @skfem.BilinearForm
    def form(u, v, w):
        stress_free = w.young * nu / narrowing * trace(sym_grad(u)) * trace(sym_grad(v))
        return stress_free + w.young / (1.0 + nu) * ddot(sym_grad(u), sym_grad(v))

    K = form.assemble(basis, young=basis.with_element(constant()).interpolate(young))
    # Of a vector element the first component's dofs name the nodes; the others of a node follow it.
    first = np.concatenate(
        [
            np.atleast_2d(basis.nodal_dofs)[0],
            basis.edge_dofs[0] if n == 3 and order == 2 else [],
            basis.facet_dofs[0] if n == 2 and order == 2 else [],
        ]
    ).astype(int)
    dofs = (first[:, None] + np.arange(n)).ravel()
    return K.toarray()[np.ix_(dofs, dofs)], basis.doflocs[:, first].T


@given(seeds, dimensions, st.floats(-0.9, 0.49))
def test_stiffness_is_symmetric_and_rigid_motions_are_its_null_space(seed, n, nu):
    """To the last bit symmetric; eigenvalues >= 0, of which exactly 3 or 6 vanish, on the rigid
    motions.
    """
    rng = np.random.default_rng(seed)
    mesh = random_mesh(rng, n)
    K = stiffness(mesh, rng.uniform(1.0, 9.0, len(mesh.cells)), nu)
    assert (K != K.T).nnz == 0
    values, vectors = np.linalg.eigh(K.toarray())
    r = n * (n + 1) // 2
    assert values[0] > -1e-12 * values[-1]
    assert values[r - 1] < 1e-12 * values[-1] < 1e-9 * values[-1] < values[r]
    modes = rigid_modes(mesh.points)
    assert modes.shape == (mesh.points.size, r)
    assert np.linalg.matrix_rank(modes) == r
    null = vectors[:, :r]
    assert_allclose(null @ (null.T @ modes), modes, atol=1e-8)
    assert_allclose(
        (modes[:, n:] ** 2).sum(axis=0).sum(), n * len(mesh.points) * (n - 1) / 2 * 2 / n
    )


def test_stiffness_adds_up():
    """K is linear in the moduli; a mesh of two pieces has the two matrices on its diagonal."""
    rng = np.random.default_rng(2)
    mesh = random_mesh(rng, 3)
    one, two = rng.uniform(1.0, 9.0, (2, len(mesh.cells)))
    total = stiffness(mesh, one + 2.0 * two, 0.4)
    parts = stiffness(mesh, one, 0.4) + 2.0 * stiffness(mesh, two, 0.4)
    assert_allclose(total.toarray(), parts.toarray(), atol=1e-12 * total.max())
    pair = Mesh(
        np.vstack([mesh.points, mesh.points + 99.0]),
        np.vstack([mesh.cells, mesh.cells + len(mesh.points)]),
    )
    both = stiffness(pair, np.concatenate([one, two]), 0.4).toarray()
    size = mesh.points.size
    assert_allclose(both[:size, :size], stiffness(mesh, one, 0.4).toarray(), rtol=1e-15)
    assert_allclose(both[size:, size:], stiffness(mesh, two, 0.4).toarray(), atol=1e-9 * both.max())
    assert not both[:size, size:].any()


# Patch test


@pytest.mark.parametrize(
    "name",
    ["distorted criss-cross", "split square", "distorted bcc", "distorted five-tet", "split cube"],
)
def test_patch(name):
    """A linear displacement of the boundary is that of every inner node; all cells have its
    strain, no node a force.
    """
    rng, nu = np.random.default_rng(7), 0.45
    mesh = {
        "distorted criss-cross": lambda: distorted(block((2.0, 3.0), (4, 5))[1], rng),
        "split square": lambda: random_mesh(rng, 2, 40),
        "distorted bcc": lambda: distorted(block((2.0, 3.0, 2.0), (4, 4, 3), "bcc")[1], rng),
        "distorted five-tet": lambda: distorted(
            block((2.0, 3.0, 2.0), (4, 4, 4), "five-tet")[1], rng
        ),
        "split cube": lambda: random_mesh(rng, 3, 40),
    }[name]()
    n = mesh.ndim
    is_boundary = np.zeros(mesh.points.shape, dtype=bool)
    is_boundary[boundary_facets(mesh.cells)] = True
    assert (~is_boundary[:, 0]).sum() >= 5
    slope, shift = rng.normal(size=(n, n)), rng.normal(size=n)
    field = mesh.points @ slope.T + shift
    system = constrain_nodes(mesh, 7.0, nu, is_boundary, np.where(is_boundary, field, np.nan))
    u = solve_system(system)
    assert_allclose(u, field, atol=1e-11 * np.abs(field).max())
    assert_array_equal(u[is_boundary], field[is_boundary])
    strain = 0.5 * (slope + slope.T)
    expected = np.broadcast_to(strain, (len(mesh.cells), n, n))
    assert_allclose(strains(mesh, u), expected, atol=1e-8)
    force = (system.K @ u.ravel()).reshape(-1, n)
    assert np.abs(force[~is_boundary]).max() < 1e-10 * np.abs(force).max()


# Closed forms


@pytest.mark.parametrize("method", ["direct", "amg"])
@pytest.mark.parametrize("nu", [0.0, 0.45])
@pytest.mark.parametrize("sides", [(2.0, 5.0), (2.0, 3.0, 5.0)])
def test_uniform_block_between_smooth_plates(sides, nu, method):
    """Uniaxial stress, sides free: E_strain = 1/2 E eps^2 V, the force E eps A; it widens by nu
    eps.
    """
    n = len(sides)
    image, mesh = block(sides, (3,) * n)
    pressed = squeezed(
        distorted(mesh, np.random.default_rng(0)), image, 4.0, nu, is_bonded=False, method=method
    )
    assert pressed.strain_energy == pytest.approx(0.5 * 4.0 * 0.01**2 * np.prod(sides), rel=1e-9)
    expected = np.zeros(n)
    expected[-1] = 4.0 * 0.01 * np.prod(sides[:-1])
    assert_allclose(pressed.reaction, expected, atol=1e-8 * expected[-1])
    along = np.diag([nu * 0.01] * (n - 1) + [-0.01])
    assert_allclose(
        strains(distorted(mesh, np.random.default_rng(0)), pressed.u),
        np.broadcast_to(along, (len(mesh.cells), n, n)),
        atol=1e-10,
    )


@pytest.mark.parametrize("is_bonded", [True, False])
@pytest.mark.parametrize("sides", [(3.0, 6.0), (3.0, 2.0, 6.0)])
def test_two_layers_in_series(sides, is_bonded):
    """At nu = 0 the bar is a chain of springs: stress = shortening / (L_1/E_1 + L_2/E_2), bonded
    or not.
    """
    image, mesh = block(sides, (3,) * len(sides), None if len(sides) == 2 else "five-tet")
    is_top = mesh.points[mesh.cells].mean(axis=1)[:, -1] > 4.0
    pressed = squeezed(mesh, image, np.where(is_top, 2.0, 12.0), 0.0, is_bonded=is_bonded)
    stress = 0.06 / (2.0 / 2.0 + 4.0 / 12.0)
    area = np.prod(sides[:-1])
    assert pressed.strain_energy == pytest.approx(0.5 * stress * area * 0.06, rel=1e-11)
    assert pressed.reaction[-1] == pytest.approx(stress * area, rel=1e-11)
    along = strains(mesh, pressed.u)[:, -1, -1]
    assert_allclose(along, np.where(is_top, -stress / 2.0, -stress / 12.0), rtol=1e-9)


@pytest.mark.parametrize("n", [2, 3])
def test_block_in_a_rigid_frame(n):
    """No side may widen: E (1 - nu) / ((1 + nu)(1 - 2 nu)) replaces E in 3-D, E / (1 - nu^2) in
    plane stress.
    """
    nu = 0.4
    _, mesh = block((2.0,) * n, (3,) * n)
    # each wall holds the component across it
    wall = (mesh.points < 1e-9) | (mesh.points > 2.0 - 1e-9)
    field = np.zeros_like(mesh.points)
    field[:, -1] = -0.01 * mesh.points[:, -1]
    u = solve_system(constrain_nodes(mesh, 3.0, nu, wall, field))
    assert_allclose(u, field, atol=1e-13)
    modulus = 3.0 / (1.0 - nu**2) if n == 2 else 3.0 * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))
    assert cell_energies(mesh, 3.0, nu, u).sum() == pytest.approx(
        0.5 * modulus * 1e-4 * 2.0**n, rel=1e-12
    )


# Laws of the compression


@given(seeds, dimensions, st.booleans())
def test_energies_and_forces_balance(seed, n, is_bonded):
    """E_strain is half of force times way, and the sum over the cells; no force is left over,
    nor on free nodes.
    """
    rng = np.random.default_rng(seed)
    image, mesh = block(tuple(rng.uniform(1.0, 5.0, n)), (2,) * n)
    mesh = distorted(mesh, rng)
    young = rng.uniform(1.0, 9.0, len(mesh.cells))
    low, high = box_faces(image, mesh)
    push = rng.normal(size=n)
    pressed = compression(
        mesh, young, 0.4, fixed_nodes=high, pushed_nodes=low, displacement=push, is_bonded=is_bonded
    )
    assert pressed.strain_energy == pytest.approx(0.5 * pressed.reaction @ push, rel=1e-9)
    assert pressed.strain_energy == pytest.approx(
        cell_energies(mesh, young, 0.4, pressed.u).sum(), rel=1e-10
    )
    force = (stiffness(mesh, young, 0.4) @ pressed.u.ravel()).reshape(-1, n)
    largest = np.abs(force).max()
    assert_allclose(pressed.reaction, force[low].sum(axis=0), atol=1e-9 * largest)
    assert_allclose(force[high].sum(axis=0), -pressed.reaction, atol=1e-9 * largest)
    inner = np.setdiff1d(np.arange(len(force)), np.concatenate([low, high]))
    assert np.abs(force[inner]).max() < 1e-9 * largest
    if is_bonded:
        assert_array_equal(pressed.u[high], np.zeros((len(high), n)))
        assert_array_equal(pressed.u[low], np.broadcast_to(push, (len(low), n)))
    else:  # plates only push along their way, also at the nodes that stop the rigid motion
        direction = push / np.linalg.norm(push)
        plates = np.concatenate([low, high])
        across = force[plates] - np.outer(force[plates] @ direction, direction)
        assert np.abs(across).max() < 1e-8 * largest
        assert_allclose(pressed.u[high] @ direction, 0.0, atol=1e-12)
        assert_allclose(pressed.u[low] @ direction, np.linalg.norm(push), rtol=1e-12)


@given(seeds, dimensions, st.booleans())
def test_rotated(seed, n, is_bonded):
    """Rotate, compress, rotate back: the same displacement; smooth plates leave the rigid motion
    to choose.
    """
    rng = np.random.default_rng(seed)
    image, mesh = block(tuple(rng.uniform(1.0, 5.0, n)), (2,) * n)
    young = rng.uniform(1.0, 9.0, len(mesh.cells))
    low, high = box_faces(image, mesh)
    turn = random_rotation(rng, n)
    push = rng.normal(size=n)
    options = {"fixed_nodes": high, "pushed_nodes": low, "is_bonded": is_bonded}
    plain = compression(mesh, young, 0.3, displacement=push, **options)
    turned = Mesh(mesh.points @ turn.T + 3.0, mesh.cells)
    other = compression(turned, young, 0.3, displacement=turn @ push, **options)
    assert_allclose(other.u @ turn, plain.u, atol=1e-9 * np.abs(plain.u).max())
    assert other.strain_energy == pytest.approx(plain.strain_energy, rel=1e-10)
    assert_allclose(other.reaction @ turn, plain.reaction, atol=1e-9 * np.abs(plain.reaction).max())


# Refinement


# A cell's children, each node as the middle of two of the cell's: its corners cut off, and what is
# left; that is an octahedron in 3-D, cut in four around the diagonal between the middles of 0 1 and
# 2 3.
CHILDREN = {
    2: [
        [(0, 0), (0, 1), (0, 2)],
        [(0, 1), (1, 1), (1, 2)],
        [(0, 2), (1, 2), (2, 2)],
        [(0, 1), (1, 2), (0, 2)],
    ],
    3: [[tuple(sorted((k, other))) for other in range(4)] for k in range(4)]
    + [
        [(0, 1), (2, 3), one, other]
        for one, other in [((0, 2), (0, 3)), ((0, 3), (1, 3)), ((1, 3), (1, 2)), ((1, 2), (0, 2))]
    ],
}


def refined(mesh, young):
    """Every cell cut into 2^n of the same volume, its nodes kept; children inherit the modulus."""
    n_nodes = len(mesh.points)
    ends = np.array(CHILDREN[mesh.ndim])  # (2^n, n+1, 2)
    pairs = np.sort(mesh.cells[:, ends], axis=-1).reshape(-1, 2)
    keys, number = np.unique(pairs @ [n_nodes, 1], return_inverse=True)
    points = 0.5 * (mesh.points[keys // n_nodes] + mesh.points[keys % n_nodes])
    fine = Mesh(points, orient_cells(points, number.reshape(-1, mesh.ndim + 1)))
    assert_allclose(
        volumes(fine.points, fine.cells).reshape(len(young), -1),
        np.repeat(volumes(mesh.points, mesh.cells)[:, None] / len(ends), len(ends), axis=1),
        rtol=1e-9,
    )
    assert facets(fine.cells).n_cells.max() == 2
    return fine, np.repeat(young, len(ends))


@pytest.mark.full
@pytest.mark.parametrize("is_bonded", [True, False])
@pytest.mark.parametrize("n", [2, 3])
def test_energy_falls_to_its_limit_under_refinement(n, is_bonded):
    """Where displacements are prescribed, E_strain is the least over all the mesh can do: nested
    meshes only lower it.

    A stiff inclusion in a soft block, nu 0.3, of which refinement keeps the moduli. Each halving
    gains less than 0.6 of the one before (0.7 in 3-D); corners keep it from the 1/4 of smooth
    solutions.
    """
    image, mesh = block((1.0, 1.5, 1.0)[:n], (2, 3, 2)[:n], None if n == 2 else "five-tet")
    centre = mesh.points[mesh.cells].mean(axis=1)
    is_stiff = ((centre - np.array([0.5, 0.75, 0.5][:n])) ** 2).sum(axis=1) < 0.09
    young = np.where(is_stiff, 20.0, 1.0)
    assert 0 < is_stiff.sum() < len(is_stiff)
    energies = []
    for _ in range(5 if n == 2 else 3):
        energies.append(squeezed(mesh, image, young, 0.3, is_bonded=is_bonded).strain_energy)
        mesh, young = refined(mesh, young)
    steps = -np.diff(energies)
    assert (steps > 0.0).all()
    assert (steps[1:] < (0.6 if n == 2 else 0.7) * steps[:-1]).all()
    assert energies[0] < 2.0 * energies[-1]


# Solvers


@pytest.mark.full
@pytest.mark.parametrize("is_bonded", [True, False])
@pytest.mark.parametrize("sides", [(4.0, 5.0), (4.0, 3.0, 5.0)])
def test_multigrid_and_factorisation_agree(sides, is_bonded):
    rng = np.random.default_rng(8)
    image, mesh = block(sides, (36, 45) if len(sides) == 2 else (7, 6, 8))
    mesh = distorted(mesh, rng)
    young = np.exp(rng.uniform(0.0, np.log(1000.0), len(mesh.cells)))
    direct = squeezed(mesh, image, young, 0.45, is_bonded=is_bonded, method="direct")
    amg = squeezed(mesh, image, young, 0.45, is_bonded=is_bonded, method="amg")
    assert len(amg.system.free) > 2000
    assert_allclose(amg.u, direct.u, atol=1e-8 * np.abs(direct.u).max())
    assert amg.strain_energy == pytest.approx(direct.strain_energy, rel=1e-12)


@pytest.mark.full
@pytest.mark.parametrize("is_bonded", [True, False])
def test_a_multigrid_cycle_is_symmetric_and_positive(is_bonded):
    """What conjugate gradients need of a preconditioner."""
    image, mesh = block((2.0, 1.0, 3.0), (3, 2, 3))
    system = squeezed(mesh, image, 2.0, 0.4, is_bonded=is_bonded).system
    cycle = multigrid(system)
    dense = np.column_stack([cycle @ unit for unit in np.eye(len(system.free))])
    assert_allclose(dense, dense.T, atol=1e-12 * np.abs(dense).max())
    assert np.linalg.eigvalsh(dense)[0] > 0.0
    assert np.linalg.eigvals(dense @ system.K_ff.toarray()).real.min() > 0.1  # near the inverse


def test_auto_takes_multigrid_for_large_meshes(monkeypatch):
    image, mesh = block((2.0, 1.0, 3.0), (3, 3, 3))
    direct = squeezed(mesh, image, 2.0, 0.4)
    called = []
    monkeypatch.setattr(
        elasticity, "multigrid", lambda system: called.append(1) or multigrid(system)
    )
    monkeypatch.setattr(elasticity, "DIRECT_DOFS", {2: 0, 3: len(direct.system.free)})
    squeezed(mesh, image, 2.0, 0.4)
    assert called == []
    monkeypatch.setattr(elasticity, "DIRECT_DOFS", {2: 0, 3: len(direct.system.free) - 1})
    assert_allclose(squeezed(mesh, image, 2.0, 0.4).u, direct.u, atol=1e-10)
    assert called == [1]


@pytest.mark.parametrize("method", ["direct", "amg"])
def test_an_unsolved_system_is_an_error(method, monkeypatch):
    image, mesh = block((2.0, 1.0, 3.0), (3, 3, 3))
    monkeypatch.setattr(elasticity, "RESIDUAL_FRACTION", 1e-30)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(
            RuntimeError, match=r"^elasticity: not solved: the residual .* mN exceeds .* mN$"
        ):
            squeezed(mesh, image, 2.0, 0.4, method=method)


# The box's faces


@given(seeds, dimensions)
def test_faces_of_any_affine(seed, n):
    """Oblique, sheared, flipped: both faces are found, by index coordinates; the top lies higher
    along z (y in 2-D).
    """
    rng = np.random.default_rng(seed)
    image = Image(np.zeros(rng.integers(2, 9, n)), random_affine(rng, n))
    blocks = tuple(int(b) for b in rng.integers(1, 4, n))
    mesh = lattice_mesh(image, blocks=blocks)
    index = image.to_index(mesh.points)
    directions = image.affine[:n, :n] / image.spacing
    axis = int(np.argmax(np.abs(directions[-1])))
    low, high = box_faces(image, mesh)
    ends = [
        np.flatnonzero(index[:, axis] < -0.499),
        np.flatnonzero(index[:, axis] > image.shape[axis] - 0.501),
    ]
    assert sorted([low.tolist(), high.tolist()]) == sorted(e.tolist() for e in ends)
    assert len(low) == len(high) == np.prod([b + 1 for k, b in enumerate(blocks) if k != axis])
    shift = mesh.points[high].mean(axis=0) - mesh.points[low].mean(axis=0)
    assert_allclose(np.abs(shift), np.abs(image.affine[:n, axis]) * image.shape[axis], rtol=1e-9)
    assert shift[-1] > 0.0


def test_default_axis_is_the_one_along_z():
    """A sagittal scan: index axes go back, up and left; the second is z, and runs down."""
    affine = np.array([[0.0, 0, -2, 5], [-1, 0, 0, 9], [0, -1.5, 0, 3], [0, 0, 0, 1]])
    image = Image(np.zeros((6, 4, 5)), affine)
    mesh = lattice_mesh(image, blocks=(2, 2, 2))
    low, high = box_faces(image, mesh)
    assert mesh.points[low, 2] == pytest.approx(3.0 - 1.5 * 3.5)
    assert mesh.points[high, 2] == pytest.approx(3.0 + 1.5 * 0.5)


def test_the_bottom_is_pushed_up_in_a_flipped_image():
    """By a tenth of five slices of 2 mm, whichever comes first."""
    for direction in (1.0, -1.0):
        image = Image(np.zeros((3, 4, 5)), np.diag([1.0, 1.0, 2.0 * direction, 1.0]))
        assert_allclose(elasticity.push_of(image, 10.0), [0.0, 0.0, 1.0], atol=1e-15)


def test_top_is_up_even_where_the_upright_axis_leans_more_than_it_rises():
    """Sheared: the third axis goes 0.9 to the left for every 0.4 up, and the others not up at
    all.
    """
    affine = np.array([[1.0, 0, -0.9, 0], [0, 1, 0, 0], [0, 0, 0.4, 0], [0, 0, 0, 1]])
    image = Image(np.zeros((3, 3, 3)), affine)
    mesh = lattice_mesh(image, blocks=(1, 1, 1))
    low, high = box_faces(image, mesh)
    assert_allclose(mesh.points[low, 2], -0.2, rtol=1e-12)
    assert_allclose(mesh.points[high, 2], 1.0, rtol=1e-12)


def test_a_node_just_off_the_face_is_not_on_it():
    image, mesh = block((1.0, 1.0), (2, 2))
    points = mesh.points.copy()
    low = box_faces(image, mesh)[0]
    points[low[0], 1] += 0.9e-6
    points[low[1], 1] += 1.1e-6
    assert_array_equal(box_faces(image, Mesh(points, mesh.cells))[0], np.delete(low, 1))


# Is it held?


@given(seeds, dimensions)
def test_check_held_knows_every_singular_matrix(seed, n):
    """Holes cut at random into a lattice, dofs held at random: refused if and only if K_ff has
    an eigenvalue 0.
    """
    rng = np.random.default_rng(seed)
    _, mesh = block((1.0,) * n, (2,) * n, None if n == 2 else "five-tet")
    cells = mesh.cells[rng.random(len(mesh.cells)) < rng.uniform(0.2, 0.9)]
    if len(cells) == 0:
        return
    used, cells = np.unique(cells, return_inverse=True)
    mesh = Mesh(
        mesh.points[used] + rng.normal(size=(len(used), n)) * 0.02, cells.reshape(-1, n + 1)
    )
    is_prescribed = rng.random(mesh.points.shape) < rng.choice([0.1, 0.3, 0.6])
    free = np.flatnonzero(~is_prescribed.ravel())
    if len(free) == 0:
        return
    values = np.linalg.eigvalsh(stiffness(mesh, 1.0, 0.3).toarray()[np.ix_(free, free)])
    is_singular = bool(values[0] < 1e-10 * values[-1])
    if is_singular:
        with pytest.raises(InputError):
            check_held(mesh.points, mesh.cells, is_prescribed)
    else:
        check_held(mesh.points, mesh.cells, is_prescribed)


@pytest.mark.parametrize("n_triangles", [39, 250])  # as a full matrix, and sparse
def test_the_loose_one_among_many_is_named(n_triangles):
    """Separate triangles, each held by two corners and one by a single corner, about which it
    turns.
    """
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    points = (corners + 3.0 * np.arange(n_triangles)[:, None, None] * [1.0, 0.0]).reshape(-1, 2)
    cells = np.arange(len(points)).reshape(-1, 3)
    is_prescribed = np.zeros(points.shape, dtype=bool)
    is_prescribed[cells[:, :2]] = True
    check_held(points, cells, is_prescribed)
    is_prescribed[cells[7, 1]] = False
    with pytest.raises(InputError) as error:
        check_held(points, cells, is_prescribed)
    assert str(error.value) == (
        "mesh: 1 cells around cell 7 (node 21) can still rotate or slide as a whole, as too few "
        "nodes connect them; "
        "fix more nodes or keep the largest facet-connected set"
    )


def test_a_tetrahedron_on_a_hinge_is_named():
    """It shares an edge with the held rest and turns about it; held by one more node it is fine."""
    image, mesh = block((1.0, 1.0, 1.0), (2, 2, 2), "five-tet")
    low, high = box_faces(image, mesh)
    a, b = high[0], high[1]
    tip = np.array([[-0.5, 0.2, 2.0], [-0.9, 0.9, 1.5]])
    n_points = len(mesh.points)
    points = np.vstack([mesh.points, tip])
    hinged = np.array([[a, b, n_points, n_points + 1]])
    if volumes(points, hinged)[0] < 0.0:
        hinged = hinged[:, [0, 1, 3, 2]]
    mesh = Mesh(points, np.vstack([mesh.cells, hinged]))
    options = {"pushed_nodes": low, "displacement": [0.0, 0.0, 0.1]}
    # Fixed at the rest's top but for the hinge's two nodes: they are free, and so is the turn about
    # them.
    with pytest.raises(InputError) as error:
        compression(mesh, 1.0, 0.3, fixed_nodes=high[2:], **options)
    assert (
        f"1 cells around cell {len(mesh.cells) - 1} (node {mesh.cells[-1, 0]}) can still rotate"
        in str(error.value)
    )
    compression(mesh, 1.0, 0.3, fixed_nodes=[*high[2:], n_points], **options)


def test_smooth_plates_do_not_hold_two_columns():
    image, mesh = block((3.0, 1.0), (3, 1))
    centre = mesh.points[mesh.cells].mean(axis=1)[:, 0]
    columns = part_of(mesh, (centre < 1.0) | (centre > 2.0))
    squeezed(columns, image, 1.0, 0.3)
    with pytest.raises(InputError, match=r"can still rotate or slide as a whole"):
        squeezed(columns, image, 1.0, 0.3, is_bonded=False)


# Messages


def message_of(call, *arguments):
    with pytest.raises(InputError) as error:
        call(*arguments)
    return str(error.value)


PLATE = Mesh([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [0.0, 2.0]], [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"young": [1.0, 0.0]},
            "above 0 kPa, got 1 invalid values, the first 0 in cell 1; give empty space a small "
            "modulus",
        ),
        (
            {"young": [np.nan, -2.5]},
            "got 2 invalid values, the first nan in cell 0, -2.5 in cell 1",
        ),
        (
            {"young": [1.0, 2.0, 3.0]},
            "young: expected one modulus for each of 2 cells, got shape (3,)",
        ),
        ({"young": "soft"}, "young: expected one modulus for each cell, got 'soft'"),
        (
            {"nu": 0.5},
            "nu: expected -1 < nu < 0.5, got 0.5; for nearly incompressible tissue use 0.45 to "
            "0.49",
        ),
        ({"nu": np.nan}, "nu: expected -1 < nu < 0.5, got nan"),
        ({"fixed_nodes": []}, "fixed_nodes: expected at least one node, got none"),
        (
            {"fixed_nodes": [2.0, 3.0]},
            "fixed_nodes: expected a list of node numbers, got float64 of shape (2,)",
        ),
        ({"pushed_nodes": [0, 4]}, "pushed_nodes: node numbers must lie in 0..3, got 0..4"),
        (
            {"pushed_nodes": [0, 1, 3, 2]},
            "fixed_nodes and pushed_nodes: 2 nodes are in both, the first [2, 3]",
        ),
        (
            {"displacement": [0.0, 0.0]},
            "displacement: expected 2 finite numbers in mm, not all 0, got [0.0, 0.0]",
        ),
        (
            {"displacement": [0.0, np.nan]},
            "displacement: expected 2 finite numbers in mm, not all 0, got [0.0, nan]",
        ),
        ({"method": "lu"}, "method: expected auto, direct or amg, got 'lu'"),
    ],
)
def test_messages_of_compression(changes, message):
    options = {
        "fixed_nodes": [2, 3],
        "pushed_nodes": [0],
        "displacement": [0.0, 0.1],
        "young": [1.0, 2.0],
        "nu": 0.3,
    }
    options |= changes
    young, nu = options.pop("young"), options.pop("nu")
    assert message in message_of(lambda: compression(PLATE, young, nu, **options))


def test_messages_of_meshes_that_are_not_held():
    points = np.vstack([PLATE.points, PLATE.points + 10.0, PLATE.points + 20.0])
    pieces = Mesh(points, np.vstack([PLATE.cells, PLATE.cells + 4, PLATE.cells + 8]))
    options = {"fixed_nodes": [2, 3], "pushed_nodes": [0, 1], "displacement": [0.0, 0.1]}
    words = message_of(lambda: compression(pieces, 1.0, 0.3, **options))
    assert words.startswith(
        "mesh: 2 components have no node that is fixed, displaced or on a spring; the first has "
        "2 cells"
    )
    words = message_of(lambda: compression(Mesh(points, PLATE.cells), 1.0, 0.3, **options))
    assert words.startswith("mesh: 8 nodes belong to no cell, the first [4, 5, 6, 7, 8]")
    nothing = np.zeros((4, 2))
    assert "it can move freely" in message_of(
        lambda: constrain_nodes(PLATE, 1.0, 0.3, nothing > 1, nothing)
    )
    # One fixed and one pushed node, smooth plates: it turns until they are apart by the way.
    options |= {"fixed_nodes": [2], "pushed_nodes": [1], "is_bonded": False}
    assert "can still rotate or slide as a whole" in message_of(
        lambda: compression(PLATE, 1.0, 0.3, **options)
    )


def test_messages_of_constrained():
    is_held, values = np.zeros((4, 2), dtype=bool), np.zeros((4, 2))
    is_held[:2] = True
    values[3] = np.nan  # not prescribed, so it does not count
    constrain_nodes(PLATE, 1.0, 0.3, is_held, values)
    values[1, 0] = np.inf
    for chosen, prescribed, words in (
        (is_held, values, "prescribed: displacements must be finite, but node 1 has [inf, 0.0]"),
        (is_held[:, 0], values, "is_prescribed: expected shape (4, 2), one row per node, got (4,)"),
        (is_held, values[:3], "prescribed: expected shape (4, 2), one row per node, got (3, 2)"),
    ):
        assert words in message_of(
            lambda *given: constrain_nodes(PLATE, 1.0, 0.3, *given), chosen, prescribed
        )


def test_messages_of_box_faces():
    image, mesh = block((1.0, 1.0, 1.0), (2, 2, 2))
    assert "same dimension, got a 2-D mesh and a 3-D image" in message_of(box_faces, image, PLATE)
    words = message_of(box_faces, image, Mesh(0.5 * mesh.points, mesh.cells))
    assert words.startswith(
        "mesh: no node lies on the image's face at index 0.5 of axis 2; the mesh extends from "
        "-0.5 to 0"
    )


def test_one_modulus_for_all():
    mesh = random_mesh(np.random.default_rng(2), 2)
    assert (
        stiffness(mesh, 3.0, 0.3) != stiffness(mesh, np.full(len(mesh.cells), 3.0), 0.3)
    ).nnz == 0


@given(seeds, dimensions)
def test_strains_of_a_linear_field(seed, n):
    rng = np.random.default_rng(seed)
    mesh = random_mesh(rng, n)
    slope = rng.normal(size=(n, n))
    strain = strains(mesh, mesh.points @ slope.T)
    assert_allclose(strain, np.broadcast_to(0.5 * (slope + slope.T), strain.shape), atol=1e-9)
    assert_array_equal(strain, strain.transpose(0, 2, 1))


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
@pytest.mark.parametrize("sides", [(4.0, 5.0), (4.0, 3.0, 5.0)])
def test_two_moduli_side_by_side_between_smooth_plates(sides, nu):
    """Columns of one strain: 1/2 eps^2 (E_1 V_1 + E_2 V_2), whatever nu, since both widen alike."""
    image, mesh = block(sides, (4,) * len(sides), None if len(sides) == 2 else "five-tet")
    is_left = mesh.points[mesh.cells].mean(axis=1)[:, 0] < sides[0] / 4.0
    pressed = squeezed(mesh, image, np.where(is_left, 1.0, 10.0), nu, is_bonded=False)
    expected = 0.5 * 0.01**2 * np.prod(sides) * (0.25 * 1.0 + 0.75 * 10.0)
    assert pressed.strain_energy == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize("n", [2, 3])
def test_pure_shear_of_one_block(n):
    """Every node is held, so there is nothing to solve: 1/2 mu gamma^2 V."""
    image, mesh = block((1.0, 2.0, 3.0)[:n], (1,) * n, None if n == 2 else "five-tet")
    push = np.zeros(n)
    push[0] = 0.1
    low, high = box_faces(image, mesh)
    if n == 2:  # its centre is free: hold it, too, where the shear takes it
        mesh = Mesh(mesh.points[:4], [[low[0], low[1], high[1]], [low[0], high[1], high[0]]])
    pressed = compression(mesh, 5.0, 0.25, fixed_nodes=high, pushed_nodes=low, displacement=push)
    assert len(pressed.system.free) == 0
    height, volume = mesh.points[:, -1].max(), volumes(mesh.points, mesh.cells).sum()
    assert pressed.strain_energy == pytest.approx(
        0.5 * 2.0 * (0.1 / height) ** 2 * volume, rel=1e-13
    )


@pytest.mark.parametrize("is_bonded", [True, False])
@pytest.mark.parametrize("n", [2, 3])
def test_scaling(n, is_bonded):
    """Energy is linear in the moduli, quadratic in the push; a mesh s times as large at equal
    strain has s^n of it.
    """
    rng = np.random.default_rng(4)
    image, mesh = block((1.0, 2.0, 3.0)[:n], (2,) * n)
    young = rng.uniform(1.0, 9.0, len(mesh.cells))
    low, high = box_faces(image, mesh)
    push = np.array([0.1, -0.2, 0.3])[:n]

    def energy(size=1.0, factor=1.0, push=push):
        scaled = Mesh(size * mesh.points, mesh.cells)
        return compression(
            scaled,
            factor * young,
            0.45,
            fixed_nodes=high,
            pushed_nodes=low,
            displacement=push,
            is_bonded=is_bonded,
        ).strain_energy

    base = energy()
    assert energy(factor=7.0) == pytest.approx(7.0 * base, rel=1e-10)
    assert energy(push=-3.0 * push) == pytest.approx(9.0 * base, rel=1e-10)
    assert energy(size=5.0, push=5.0 * push) == pytest.approx(5.0**n * base, rel=1e-10)
    assert energy(size=5.0) == pytest.approx(5.0 ** (n - 2) * base, rel=1e-10)


def test_holding_more_and_stiffening_take_more_energy():
    """Smooth plates allow all that bonded ones do; a stiffer cell anywhere costs; nu narrows
    what is free.
    """
    rng = np.random.default_rng(9)
    image, mesh = block((2.0, 3.0, 2.5), (3, 3, 3))
    young = rng.uniform(1.0, 9.0, len(mesh.cells))
    bonded = squeezed(mesh, image, young, 0.4).strain_energy
    assert squeezed(mesh, image, young, 0.4, is_bonded=False).strain_energy < 0.99 * bonded
    for cell in rng.choice(len(mesh.cells), 5, replace=False):
        stiffer = young.copy()
        stiffer[cell] *= 2.0
        assert squeezed(mesh, image, stiffer, 0.4).strain_energy > bonded * (1.0 + 1e-6)
    # Voigt and Reuss: between smooth plates the energy lies between those of equal stress and equal
    # strain.
    v = volumes(mesh.points, mesh.cells) / 15.0
    smooth = squeezed(mesh, image, young, 0.0, is_bonded=False).strain_energy / (
        0.5 * 0.01**2 * 15.0
    )
    assert 1.0 / (v / young).sum() < smooth < (v * young).sum()
