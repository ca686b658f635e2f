"""Curved quadratic cells solved: patch tests, integrals, scikit-fem's numbers, and Lame's
sphere.
"""

import meshio
import numpy as np
import pytest
import skfem
from meshes import with_bent_edges
from models import ball_mesh
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal
from scipy.spatial import cKDTree
from skfem.io import from_meshio
from skfem.models.elasticity import lame_parameters, linear_elasticity, plane_stress
from test_solution import uneven

from tetopt import Image, Mesh, lattice_mesh, solve
from tetopt.fem.elasticity import (
    constrain_nodes,
    gauss_strains,
    gauss_volumes,
    solve_system,
    stiffness,
    strains,
)
from tetopt.fem.reference import compare
from tetopt.fem.solution import node_means, solution_fields, weight_forces
from tetopt.geometry.quadratic import curved_rule, numbered_edges, quadratic
from tetopt.model.build import build_model
from tetopt.model.loads import facet_forces, facet_weights, parse_load
from tetopt.model.model import element_facets, elements
from tetopt.model.sets import Sets, boundary_rows, box_of, standard_sets


def nodes_and_cells(mesh):
    return quadratic(mesh.points, mesh.cells, mesh.midpoints)


def test_a_linear_displacement_is_reproduced(n):
    """Isoparametric cells hold it exactly; with a rule that integrates their pull, inner nodes
    find it.
    """
    mesh = with_bent_edges(uneven(n)[0], 0.06)
    nodes, cells = nodes_and_cells(mesh)
    outer = np.unique(element_facets(cells, boundary_rows(mesh)))
    is_outer = np.isin(np.arange(len(nodes)), outer)
    slope = np.random.default_rng(5).normal(size=(n, n))
    exact = nodes @ slope.T
    prescribed = np.where(is_outer[:, None], exact, 0.0)
    u = solve_system(
        constrain_nodes(
            mesh, 3.0, 0.3, np.repeat(is_outer[:, None], n, axis=1), prescribed, order=2
        )
    )
    assert 0.1 < (~is_outer).mean() < 0.9
    assert_allclose(u, exact, atol=1e-11 * np.abs(exact).max())
    strain = 0.5 * (slope + slope.T)
    assert_allclose(
        gauss_strains(mesh, u), np.broadcast_to(strain, (len(cells), *_shape(n), n, n)), atol=1e-9
    )
    assert_allclose(strains(mesh, u), np.broadcast_to(strain, (len(cells), n, n)), atol=1e-9)
    at_nodes = node_means(mesh, gauss_strains(mesh, u))
    assert_allclose(at_nodes, np.broadcast_to(strain, (len(nodes), n, n)), atol=1e-9)


def _shape(n):
    return (len(curved_rule(n)[1]),)


def test_forces_add_up_to_volumes_and_areas(n):
    """Weight to the curved volume, which is also the flux of x / n; a pressure all around to
    nothing; a traction to the curved area, that of many flat facets.
    """
    mesh = with_bent_edges(ball_mesh(n), 0.04)
    nodes, rows = nodes_and_cells(mesh)[0], boundary_rows(mesh)
    sets = Sets({"boundary": rows}, {})
    size = gauss_volumes(mesh, 2).sum()
    assert abs(size / gauss_volumes(Mesh(mesh.points, mesh.cells), 2).sum() - 1.0) > 1e-5
    gravity = np.arange(1.0, n + 1.0)
    weight = weight_forces(mesh, np.full(len(mesh.cells), 2.0), gravity, 2)
    assert_allclose(weight.sum(axis=0), 2e-9 * size * gravity, rtol=1e-12)
    which, forces = facet_forces(mesh, sets, parse_load("pressure:boundary:-1", n), 2)
    assert_allclose(forces.sum(axis=0), 0.0, atol=1e-9 * np.abs(forces).sum())
    assert (forces * nodes[which]).sum() / n == pytest.approx(size, rel=1e-12)
    local, weights = facet_weights(mesh, rows, 2)
    assert weights.sum() == pytest.approx(_area(nodes[local], n), rel=1e-4)


def _area(nodes, n):
    """The area (length) of curved facets, of 40 steps along each side."""
    steps = np.linspace(0.0, 1.0, 41)
    if n == 2:
        a, b = 1.0 - steps, steps
        curve = np.einsum("as,fai->fsi", [a * (2 * a - 1), b * (2 * b - 1), 4 * a * b], nodes)
        return np.linalg.norm(np.diff(curve, axis=1), axis=2).sum()
    u, v = np.meshgrid(steps, steps, indexing="ij")
    a, b, c = 1.0 - u, u * (1.0 - v), u * v  # a square on the triangle
    shapes = [a * (2 * a - 1), b * (2 * b - 1), c * (2 * c - 1), 4 * a * b, 4 * b * c, 4 * a * c]
    place = np.einsum("ast,fai->fsti", shapes, nodes)
    one, other = place[:, 1:, 1:] - place[:, :-1, :-1], place[:, 1:, :-1] - place[:, :-1, 1:]
    return 0.5 * np.linalg.norm(np.cross(one, other), axis=3).sum()


def test_energies_are_those_of_scikit_fem(n):
    mesh = with_bent_edges(uneven(n)[0], 0.05)
    nodes, cells = nodes_and_cells(mesh)
    kind, element, law = {
        2: ("triangle6", skfem.ElementTriP2(), plane_stress),
        3: ("tetra10", skfem.ElementTetP2(), lame_parameters),
    }[n]
    points, weights = curved_rule(n)
    rule = points[:, 1:].T.copy(), weights / (2.0 if n == 2 else 6.0)
    theirs = from_meshio(meshio.Mesh(nodes, [(kind, cells)]))
    basis = skfem.Basis(theirs, skfem.ElementVector(element), quadrature=rule)
    K = linear_elasticity(*law(2.0, 0.3)).assemble(basis)
    of_edges = basis.facet_dofs if n == 2 else basis.edge_dofs
    dofs = np.concatenate([basis.nodal_dofs, of_edges], axis=1)
    distance, node = cKDTree(nodes).query(basis.doflocs[:, dofs[0]].T)
    assert distance.max() < 1e-9
    u, v = np.random.default_rng(2).normal(size=nodes.shape), basis.zeros()
    v[dofs] = u[node].T
    energy = u.ravel() @ (stiffness(mesh, 2.0, 0.3, order=2) @ u.ravel())
    assert energy == pytest.approx(v @ (K @ v), rel=1e-10)


def test_moduli_and_fields_of_curved_cells(n):
    """Moduli of the parts of cells: as many as corners, spread over the rule; all alike they are
    one modulus.
    """
    mesh = with_bent_edges(uneven(n)[0], 0.05)
    parts = np.random.default_rng(4).uniform(1.0, 2.0, (len(mesh.cells), n + 1))
    assert_array_equal(
        stiffness(mesh, np.full(parts.shape, 2.0), 0.3, 2).data, stiffness(mesh, 2.0, 0.3, 2).data
    )
    stiff, soft = (
        stiffness(mesh, values, 0.3, 2).diagonal().sum() for values in (parts, parts.min(axis=1))
    )
    assert soft < stiff < stiffness(mesh, parts.max(axis=1), 0.3, 2).diagonal().sum()
    loads = ["traction:boundary:" + ",".join("1" * n), "spring:boundary:1"]
    model = build_model(
        mesh,
        young=2.0,
        nu=0.3,
        loads=loads,
        order=2,
        known_sets=Sets({"boundary": boundary_rows(mesh)}, {}),
    )
    mixed = solve(model._replace(gauss_young=parts))
    assert mixed.young.shape == mixed.strain.shape[:2] == (len(mesh.cells), *_shape(n))
    assert_allclose(mixed.young.mean(axis=0).mean(), parts.mean(), rtol=0.02)
    assert mixed.strain_energy + mixed.spring_energy == pytest.approx(mixed.work, rel=1e-8)
    fields = solution_fields(mesh, mixed)
    assert fields.point_data["stress_nodes"].shape == (len(elements(model)[0]), n * n)
    at_nodes = solve(model._replace(node_young=np.full(len(mesh.points), 2.0)))
    assert_allclose(at_nodes.u, solve(model).u, rtol=1e-9, atol=1e-12)


def lame_solution(is_curved, blocks):
    """A quarter of a ring from 1 to 2 mm under pressure from within, in plane stress; and the
    largest error of Lame's displacement, over the largest displacement.
    """
    young, nu, pressure = 3.0, 0.45, 0.2
    affine = np.diag([1.0, np.pi / 2.0, 1.0])
    affine[:2, 2] = 1.5, np.pi / 4.0
    image = Image(np.zeros((1, 1)), affine)
    box = lattice_mesh(image, blocks=(blocks, 2 * blocks))
    r, angle = box.points.T
    points = r[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    ends = numbered_edges(box.cells)[0]
    middles = points[ends].mean(axis=1)
    if is_curved:
        around = np.ptp(r[ends], axis=1) < 1e-9
        length = np.linalg.norm(middles[around], axis=1)
        middles[around] *= (r[ends[around, 0]] / length)[:, None]
    loads = ["move:y_min:free,0", "move:y_max:0,free", f"pressure:x_min:{pressure}"]
    sets = standard_sets(box, box_of(image))
    mesh = Mesh(points, box.cells, middles)
    solution = solve(build_model(mesh, young=young, nu=nu, loads=loads, known_sets=sets, order=2))
    along = pressure / (3.0 * young) * ((1.0 - nu) * r + (1.0 + nu) * 4.0 / r)
    error = np.abs((solution.u[: len(r)] * points).sum(axis=1) / r - along).max() / along.max()
    assert solution.strain_energy == pytest.approx(solution.work, rel=1e-8)
    return error, solution


def test_a_curved_ring_is_nearer_to_lame():
    straight, curved = (
        [lame_solution(is_curved, blocks)[0] for blocks in (2, 4)] for is_curved in (False, True)
    )
    assert all(0.0 < 3.0 * ours < theirs for ours, theirs in zip(curved, straight, strict=True))
    assert curved[0] / curved[1] > 3.0
    assert_allclose(lame_solution(True, 2)[1].applied, 0.2, rtol=2e-3)


def test_folded_cells_and_voxel_references_are_refused():
    mesh = ball_mesh()
    edges = numbered_edges(mesh.cells)[0]
    midpoints = mesh.points[edges].mean(axis=1)
    folded = midpoints.copy()
    folded[7] += 5.0 * (mesh.points[edges[7, 1]] - mesh.points[edges[7, 0]])
    with refusal(r"mesh: \d+ of \d+ quadratic cells are folded by their mid-edge nodes"):
        stiffness(Mesh(mesh.points, mesh.cells, folded), 1.0, 0.3, order=2)
    # which has no mid-edge nodes
    stiffness(Mesh(mesh.points, mesh.cells, folded), 1.0, 0.3, order=1)
    curved = Mesh(mesh.points, mesh.cells, midpoints)
    u = np.zeros((len(mesh.points) + len(edges), 3))
    with refusal("compare: expected straight edges"):
        compare(None, curved, u, 1.0, None)
