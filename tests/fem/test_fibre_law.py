"""Transversely isotropic cells: the law written out, a cube in closed form, what is refused."""

import numpy as np
import pytest
from meshes import random_rotation
from models import fibre_compliance, fibre_model, pulled_cube
from numpy.testing import assert_allclose
from refusals import refusal

from tetopt import Mesh
from tetopt.fem.elasticity import (
    Outside,
    constrain_nodes,
    fibre_tensor,
    gauss_strains,
    solve_system,
    stiffness,
)
from tetopt.fem.solution import solve
from tetopt.geometry.quadratic import of_order
from tetopt.geometry.simplex import volume_gradients, volumes
from tetopt.model.materials import Along, along_of
from tetopt.model.model import element_facets
from tetopt.model.sets import boundary_rows

MODULI = ("young", "nu", "young_along", "shear_along")
# makes a compliance invertible, and is 0 on symmetric matrices
EYE = np.eye(3)
ROTATIONS = np.einsum("ik,jl->ijkl", EYE, EYE) - np.einsum("il,jk->ijkl", EYE, EYE)


def law_of(table):
    """The elasticity tensors of cells, (M, 3, 3, 3, 3): the inverses of their compliances."""
    moduli = table._asdict() | table.along._asdict()
    compliances = [
        fibre_compliance(fibre, *(moduli[name][k] for name in MODULI))
        for fibre, k in zip(table.along.fibre, table.of_cell, strict=True)
    ]
    inverses = np.array([np.linalg.tensorinv(each + ROTATIONS) for each in compliances])
    return 0.5 * (inverses + inverses.swapaxes(3, 4))


def test_the_law_is_the_inverse_of_the_compliance(order):
    model = fibre_model()._replace(order=order)
    own = solve(model)
    expected = np.einsum("cijkl,cqkl->cqij", law_of(model.materials), own.strain)
    assert_allclose(own.stress, expected, atol=1e-12 * np.abs(expected).max())
    assert_allclose(own.work, own.strain_energy, rtol=1e-9)


def test_stiffness_is_symmetric_and_that_of_the_law():
    model = fibre_model()
    mesh, table = model.mesh, model.materials
    young, nu = table.young[table.of_cell], table.nu[table.of_cell]
    K = stiffness(mesh, young, nu, along=along_of(table))
    assert (K != K.T).nnz == 0
    v = volumes(mesh.points, mesh.cells)
    g = volume_gradients(mesh.points, mesh.cells) / v[:, None, None]
    blocks = np.einsum("caj,cijkl,cbl,c->caibk", g, law_of(table), g, v)
    expected = np.zeros((mesh.points.size,) * 2)
    for cell, block in zip(mesh.cells, blocks, strict=True):
        dofs = (3 * cell[:, None] + np.arange(3)).ravel()
        expected[np.ix_(dofs, dofs)] += block.reshape(12, 12)
    assert_allclose(K.toarray(), expected, atol=1e-12 * np.abs(expected).max())


def test_cells_of_isotropic_moduli_are_isotropic():
    model = fibre_model()
    n_cells = len(model.mesh.cells)
    along = Along(3.0, 3.0 / 2.8, model.materials.along.fibre)
    K = stiffness(model.mesh, np.full(n_cells, 3.0), 0.4, along=along).toarray()
    expected = stiffness(model.mesh, 3.0, 0.4).toarray()
    assert_allclose(K, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("turn", [np.eye(3), random_rotation(np.random.default_rng(3), 3)])
def test_a_cube_of_turned_fibres_has_the_strain_of_the_closed_form(turn, order):
    """Under a uniform stress; the same with dofs along the columns of a rotation, all prescribed
    on the boundary.
    """
    cube = pulled_cube(order)
    mesh, table = cube.model.mesh, cube.model.materials
    young, nu = (values[table.of_cell] for values in (table.young, table.nu))
    outside = Outside(cube.forces, np.zeros(len(cube.u)))
    options = {"order": order, "outside": outside, "along": along_of(table)}
    system = constrain_nodes(mesh, young, nu, cube.is_held, 0.0 * cube.u, **options)
    u = solve_system(system)
    assert_allclose(u, cube.u, atol=1e-9 * np.abs(cube.u).max())
    tensor = fibre_tensor(young, nu, options["along"])
    stress = np.einsum("cijkl,cqkl->cqij", tensor, gauss_strains(mesh, u))
    assert_allclose(stress, np.broadcast_to(cube.stress, stress.shape), atol=1e-9)
    nodes = element_facets(of_order(mesh.points, mesh.cells, order)[1], boundary_rows(mesh))
    held = np.zeros(cube.u.shape, dtype=bool)
    held[nodes] = True
    options = {"order": order, "frame": turn, "along": along_of(table)}
    system = constrain_nodes(mesh, young, nu, held, cube.u @ turn, **options)
    assert not held.all()
    assert_allclose(solve_system(system), cube.u, atol=1e-9 * np.abs(cube.u).max())
    forces = (system.K @ (cube.u @ turn).ravel()).reshape(cube.u.shape) @ turn.T
    assert_allclose(forces, cube.forces, atol=1e-9 * np.abs(cube.forces).max())


def test_what_is_no_material_is_refused():
    model = fibre_model()
    fibre = model.materials.along.fibre
    for nu, along, words in (
        (0.4, Along(1.5, 1.0, fibre), r"young_along: .*above 2 nu\^2 young / \(1 - nu\)"),
        (0.4, Along(9.0, 0.0, fibre), "shear_along: expected moduli above 0"),
        (0.4, Along(9.0, 1.0, fibre[:-1]), "fibre: expected three numbers for each of"),
        (0.4, Along(9.0, 1.0, 0.0 * fibre), "fibre: expected directions, got only 0 or NaN"),
    ):
        with refusal(words):
            stiffness(model.mesh, 3.0, nu, along=along)
    with refusal("young: expected one modulus for each cell with fibres"):
        moduli = np.full((len(fibre), 4), 3.0) + np.eye(4)[0]
        stiffness(model.mesh, moduli, 0.4, order=2, along=Along(9.0, 1.0, fibre))
    flat = Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    with refusal("fibre: expected three numbers"):
        stiffness(flat, 3.0, 0.4, along=Along(9.0, 1.0, np.array([[1.0, 0.0]])))
