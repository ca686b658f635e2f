"""Elasticity: patch tests, closed forms, laws, the other library's answer, and what may not be
solved.
"""

import re
from contextlib import nullcontext
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import random_affine, random_rotation, split_box
from models import cell_energies
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

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
from tetopt.geometry.topology import boundary_facets
from tetopt.model.model import element_facets
from tetopt.model.sets import boundary_rows

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


# Patch test


def test_patch(n, order):
    """A linear displacement of the boundary is that of every inner node; all cells have its
    strain, no node a force.
    """
    rng, nu = np.random.default_rng(7), 0.45
    mesh = random_mesh(rng, n, 40)
    points, cells = (mesh.points, mesh.cells) if order == 1 else quadratic(mesh.points, mesh.cells)
    is_boundary = np.zeros(points.shape, dtype=bool)
    is_boundary[np.unique(element_facets(cells, boundary_rows(mesh)))] = True
    assert (~is_boundary[:, 0]).sum() >= 5
    slope, shift = rng.normal(size=(n, n)), rng.normal(size=n)
    field = points @ slope.T + shift
    prescribed = np.where(is_boundary, field, np.nan)
    system = constrain_nodes(mesh, 7.0, nu, is_boundary, prescribed, order=order)
    u = solve_system(system)
    assert_allclose(u, field, atol=1e-11 * np.abs(field).max())
    assert_array_equal(u[is_boundary], field[is_boundary])
    expected = np.broadcast_to(0.5 * (slope + slope.T), (len(mesh.cells), n, n))
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
    mesh = distorted(mesh, np.random.default_rng(0))
    pressed = squeezed(mesh, image, 4.0, nu, is_bonded=False, method=method)
    assert pressed.strain_energy == pytest.approx(0.5 * 4.0 * 0.01**2 * np.prod(sides), rel=1e-9)
    force = 4.0 * 0.01 * np.prod(sides[:-1])
    assert_allclose(pressed.reaction, force * np.eye(n)[-1], atol=1e-8 * force)
    along = np.diag([nu * 0.01] * (n - 1) + [-0.01])
    assert_allclose(strains(mesh, pressed.u), np.tile(along, (len(mesh.cells), 1, 1)), atol=1e-10)


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
    push, pressed = rng.normal(size=n), []
    for turn, shift in ((np.eye(n), 0.0), (random_rotation(rng, n), 3.0)):
        turned = Mesh(mesh.points @ turn.T + shift, mesh.cells)
        options = {"fixed_nodes": high, "pushed_nodes": low, "displacement": turn @ push}
        found = compression(turned, young, 0.3, is_bonded=is_bonded, **options)
        pressed.append((found.u @ turn, found.reaction @ turn, found.strain_energy))
    for one, other in zip(*pressed, strict=True):
        assert_allclose(other, one, rtol=1e-10, atol=1e-9 * np.abs(one).max())


# Solvers


@pytest.mark.full
@pytest.mark.parametrize(
    ("sides", "blocks", "order"),
    [((4.0, 5.0), (36, 45), 1), ((4.0, 3.0, 5.0), (7, 6, 8), 1), ((4.0, 3.0, 5.0), (3, 3, 4), 2)],
)
@pytest.mark.parametrize("is_bonded", [True, False])
def test_multigrid_and_factorisation_agree(sides, blocks, order, is_bonded):
    rng = np.random.default_rng(8)
    image, mesh = block(sides, blocks)
    mesh = distorted(mesh, rng)
    young = np.exp(rng.uniform(0.0, np.log(1000.0), len(mesh.cells)))
    options = {"is_bonded": is_bonded, "order": order}
    direct, amg = (
        squeezed(mesh, image, young, 0.45, method=method, **options) for method in ("direct", "amg")
    )
    assert len(amg.system.free) > 1000
    assert_allclose(amg.u, direct.u, atol=1e-8 * np.abs(direct.u).max())
    assert amg.strain_energy == pytest.approx(direct.strain_energy, rel=1e-10)


@pytest.mark.parametrize(("is_bonded", "order"), [(True, 1), (False, 1), (True, 2)])
def test_a_multigrid_cycle_is_symmetric_and_positive(is_bonded, order):
    """What conjugate gradients need of a preconditioner, and near the inverse."""
    image, mesh = block((2.0, 1.0, 3.0), (2, 2, 3) if order == 1 else (1, 1, 2))
    system = squeezed(mesh, image, 2.0, 0.4, is_bonded=is_bonded, order=order).system
    cycle = multigrid(system)
    dense = np.column_stack([cycle @ unit for unit in np.eye(len(system.free))])
    assert_allclose(dense, dense.T, atol=1e-12 * np.abs(dense).max())
    assert np.linalg.eigvalsh(dense)[0] > 0.0
    assert np.linalg.eigvals(dense @ system.K_ff.toarray()).real.min() > 0.1 / order


def test_auto_takes_multigrid_for_large_meshes(monkeypatch):
    image, mesh = block((2.0, 1.0, 3.0), (3, 3, 3))
    direct, called = squeezed(mesh, image, 2.0, 0.4), []
    monkeypatch.setattr(
        elasticity, "multigrid", lambda system: called.append(1) or multigrid(system)
    )
    for spare in (0, 1):
        dofs = {2: 0, 3: len(direct.system.free) - spare}
        monkeypatch.setattr(elasticity, "DIRECT_DOFS", dofs)
        assert_allclose(squeezed(mesh, image, 2.0, 0.4).u, direct.u, atol=1e-10)
        assert len(called) == spare


@pytest.mark.parametrize("method", ["direct", "amg"])
@pytest.mark.filterwarnings("ignore")
def test_an_unsolved_system_is_an_error(method, monkeypatch):
    image, mesh = block((2.0, 1.0, 3.0), (3, 3, 3))
    monkeypatch.setattr(elasticity, "RESIDUAL_FRACTION", 1e-30)
    with pytest.raises(RuntimeError, match=r"not solved: the residual .* mN exceeds .* mN$"):
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
    axis = int(np.argmax(np.abs(image.affine[n - 1, :n] / image.spacing)))
    along, length = image.to_index(mesh.points)[:, axis], image.shape[axis]
    low, high = box_faces(image, mesh)
    ends = [np.flatnonzero(along < -0.499), np.flatnonzero(along > length - 0.501)]
    assert sorted([low.tolist(), high.tolist()]) == sorted(e.tolist() for e in ends)
    assert len(low) == len(high) == np.prod([b + 1 for k, b in enumerate(blocks) if k != axis])
    shift = mesh.points[high].mean(axis=0) - mesh.points[low].mean(axis=0)
    assert_allclose(np.abs(shift), np.abs(image.affine[:n, axis]) * length, rtol=1e-9)
    assert shift[-1] > 0.0


def test_the_bottom_is_pushed_up_in_a_flipped_image():
    """By a tenth of five slices of 2 mm, whichever comes first."""
    for direction in (1.0, -1.0):
        image = Image(np.zeros((3, 4, 5)), np.diag([1.0, 1.0, 2.0 * direction, 1.0]))
        assert_allclose(elasticity.push_of(image, 10.0), [0.0, 0.0, 1.0], atol=1e-15)


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
    used, cells = np.unique(cells, return_inverse=True)
    points = mesh.points[used] + rng.normal(size=(len(used), n)) * 0.02
    is_prescribed = rng.random(points.shape) < rng.choice([0.1, 0.3, 0.6])
    free = np.flatnonzero(~is_prescribed.ravel())
    if len(free) == 0:  # or no cells
        return
    mesh = Mesh(points, cells.reshape(-1, n + 1))
    values = np.linalg.eigvalsh(stiffness(mesh, 1.0, 0.3).toarray()[np.ix_(free, free)])
    is_singular = values[0] < 1e-10 * values[-1]
    with pytest.raises(InputError) if is_singular else nullcontext():
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
    with refusal(r"^mesh: 1 cells around cell 7 \(node 21\) can still rotate or slide as a whole"):
        check_held(points, cells, is_prescribed)


# Messages


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
            "nu: expected -1 < nu < 0.5, got 2 invalid values, the first 0.5 in cell 0, 0.5 in "
            "cell 1; for nearly incompressible tissue use 0.45 to 0.49",
        ),
        ({"nu": np.nan}, "-1 < nu < 0.5, got 2 invalid values, the first nan in cell 0"),
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
    with refusal(re.escape(message)):
        compression(PLATE, **options | changes)


def test_messages_of_meshes_that_are_not_held():
    points = np.vstack([PLATE.points, PLATE.points + 10.0, PLATE.points + 20.0])
    pieces = Mesh(points, np.vstack([PLATE.cells, PLATE.cells + 4, PLATE.cells + 8]))
    options = {"fixed_nodes": [2, 3], "pushed_nodes": [0, 1], "displacement": [0.0, 0.1]}
    # One fixed and one pushed node, smooth plates: it turns until they are apart by the way.
    turning = options | {"fixed_nodes": [2], "pushed_nodes": [1], "is_bonded": False}
    for mesh, held, words in (
        (
            pieces,
            options,
            "^mesh: 2 components have no node that is fixed, displaced or on a spring; the first "
            "has 2 cells",
        ),
        (
            Mesh(points, PLATE.cells),
            options,
            r"^mesh: 8 nodes belong to no cell, the first \[4, 5, 6, 7, 8\]",
        ),
        (PLATE, turning, "can still rotate or slide as a whole"),
    ):
        with refusal(words):
            compression(mesh, 1.0, 0.3, **held)
    nothing = np.zeros((4, 2))
    with refusal("it can move freely"):
        constrain_nodes(PLATE, 1.0, 0.3, nothing > 1, nothing)


def test_messages_of_constrained():
    is_held, values = np.zeros((4, 2), dtype=bool), np.zeros((4, 2))
    is_held[:2] = True
    values[3] = np.nan  # not prescribed, so it does not count
    constrain_nodes(PLATE, 1.0, 0.3, is_held, values)
    values[1, 0] = np.inf
    for chosen, given_values, words in (
        (is_held, values, "prescribed: displacements must be finite, but node 1 has [inf, 0.0]"),
        (is_held[:, 0], values, "is_prescribed: expected shape (4, 2), one row per node, got (4,)"),
        (is_held, values[:3], "prescribed: expected shape (4, 2), one row per node, got (3, 2)"),
    ):
        with refusal(re.escape(words)):
            constrain_nodes(PLATE, 1.0, 0.3, chosen, given_values)


def test_messages_of_box_faces():
    image, mesh = block((1.0, 1.0, 1.0), (2, 2, 2))
    half = Mesh(0.5 * mesh.points, mesh.cells)
    off = "mesh: no node lies on the image's face at index 0.5 of axis 2; the mesh extends from "
    for each, words in (
        (PLATE, "same dimension, got a 2-D mesh and a 3-D image"),
        (half, f"{off}-0.5 to 0"),
    ):
        with refusal(words):
            box_faces(image, each)
