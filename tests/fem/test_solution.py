"""Models solved: closed forms, another library's answer for each kind of load, laws, and what
cannot be solved.
"""

import os
import subprocess
import sys

import numpy as np
import pytest
import skfem
from meshes import random_rotation, split_box
from numpy.testing import assert_allclose, assert_array_equal
from scipy.sparse import diags_array
from scipy.spatial import cKDTree
from skfem.helpers import ddot, dot, sym_grad, trace

from tetopt import Image, InputError, Mesh, lattice_mesh
from tetopt.fem import solution as module
from tetopt.fem.conditioning import conditioning
from tetopt.fem.elasticity import (
    compression,
    constrain_nodes,
    gauss_strains,
    multigrid,
    solve_system,
    strains,
)
from tetopt.fem.solution import node_means, solution_fields, solve, von_mises
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.simplex import orient_cells, volumes
from tetopt.model.build import build_model
from tetopt.model.loads import Load, facet_weights
from tetopt.model.model import element_facets, in_units
from tetopt.model.sets import Sets, boundary_rows, box_of, facet_triples, nodes_of, standard_sets

BOTH = [(n, order) for n in (2, 3) for order in (1, 2)]


def bar(n, blocks=2, length=6.0):
    """A box of 2 x (2 x) `length` mm whose faces are sets, the last axis its length."""
    sides = np.array([2.0] * (n - 1) + [length])
    affine = np.eye(n + 1)
    affine[:n, :n] = np.diag(sides)
    affine[:n, n] = 0.5 * sides
    image = Image(np.zeros((1,) * n), affine)
    mesh = lattice_mesh(
        image, None if n == 2 else "five-tet", blocks=(blocks,) * (n - 1) + (2 * blocks,)
    )
    return mesh, standard_sets(mesh, box_of(image))


def nodes_of_order(mesh, order):
    return mesh.points if order == 1 else quadratic(mesh.points, mesh.cells)[0]


def uneven(n, seed=3):
    """A mesh of thin cells, turned in space, with the box's faces as sets, and a modulus, ratio
    and density a cell.
    """
    rng = np.random.default_rng(seed)
    points, cells = split_box(rng, (3,) * n, 14, step=0.25)
    turned = np.eye(n + 1)
    turned[:n, :n], turned[:n, n] = random_rotation(rng, n), rng.uniform(-20.0, 20.0, n)
    image = Image(np.zeros((3,) * n), turned)
    mesh = Mesh(points @ turned[:n, :n].T + turned[:n, n], cells)
    number = len(cells)
    values = {
        "young": rng.uniform(1.0, 9.0, number),
        "nu": rng.uniform(0.2, 0.45, number),
        "density": rng.uniform(800.0, 1900.0, number),
    }
    return mesh, standard_sets(mesh, box_of(image)), values


# The same by another library, which does everything by itself


def skfem_solution(model, step=1):
    """Displacements in the order of our nodes, by scikit-fem: its assembly, its integrals over
    facets and cells.

    Springs are to the ground at the nodes, as those of every solver we write for, so that their
    matrix is lumped; all other loads are integrals of shape functions.
    """
    n, order, mesh = model.mesh.ndim, model.order, model._replace(order=1).to_skfem()
    element = {
        (2, 1): skfem.ElementTriP1,
        (3, 1): skfem.ElementTetP1,
        (2, 2): skfem.ElementTriP2,
        (3, 2): skfem.ElementTetP2,
    }[n, order]()
    constant = skfem.ElementTriP0() if n == 2 else skfem.ElementTetP0()
    linear = skfem.ElementTriP1() if n == 2 else skfem.ElementTetP1()
    basis = skfem.Basis(mesh, skfem.ElementVector(element), intorder=2)
    table = model.materials
    of_cell = {"nu": table.nu[table.of_cell]}
    of_cell["density"] = (
        np.zeros_like(of_cell["nu"]) if table.density is None else table.density[table.of_cell]
    )
    fields = {
        name: basis.with_element(constant).interpolate(values) for name, values in of_cell.items()
    }
    if model.node_young is None:
        fields["young"] = basis.with_element(constant).interpolate(table.young[table.of_cell])
    else:  # at the middle of cells of order 1, as a constant strain only sees the mean
        fields["young"] = basis.with_element(linear).interpolate(model.node_young)

    @skfem.BilinearForm
    def stiffness(u, v, w):
        narrowing = 1.0 - w.nu**2 if n == 2 else (1.0 + w.nu) * (1.0 - 2.0 * w.nu)
        spread = w.young * w.nu / narrowing * trace(sym_grad(u)) * trace(sym_grad(v))
        return spread + w.young / (1.0 + w.nu) * ddot(sym_grad(u), sym_grad(v))

    K = stiffness.assemble(basis, **fields).tolil()
    f, prescribed, dofs = basis.zeros(), basis.zeros(), []
    for load in model.loads:
        if load.step not in (0, step):
            continue
        on_set = None if load.kind == "gravity" else basis.boundary(load.set_name)
        if load.kind == "displacement":
            of_set = basis.get_dofs(load.set_name)
            for d in range(n):
                if not np.isnan(load.numbers[d]):
                    chosen = of_set.all(f"u^{d + 1}")
                    prescribed[chosen] = load.numbers[d]
                    dofs.append(chosen)
        elif load.kind == "pressure":
            f += skfem.LinearForm(lambda v, w, load=load: -load.numbers[0] * dot(w.n, v)).assemble(
                on_set
            )
        elif load.kind == "traction":
            f += skfem.LinearForm(
                lambda v, w, load=load: sum(load.numbers[d] * v[d] for d in range(n))
            ).assemble(on_set)
        elif load.kind == "gravity":
            weight = skfem.LinearForm(
                lambda v, w, load=load: (
                    1e-9 * w.density * sum(load.numbers[d] * v[d] for d in range(n))
                )
            )
            f += weight.assemble(basis, density=fields["density"])
        else:
            fraction = skfem.LinearForm(
                lambda v, w: v[0] + v[1] + (v[2] if n == 3 else 0.0)
            ).assemble(on_set)
            K.setdiag(K.diagonal() + load.numbers[0] * fraction)
    u = skfem.solve(
        *skfem.condense(
            K.tocsr(), f, x=prescribed, D=np.unique(np.concatenate(dofs or [np.empty(0, int)]))
        )
    )
    distance, ours = cKDTree(nodes_of_order(model.mesh, model.order)).query(basis.doflocs.T)
    assert distance.max() < 1e-10
    result = np.empty((len(u) // n, n))
    for rows in (basis.nodal_dofs, basis.edge_dofs if n == 3 else basis.facet_dofs):
        for d in range(n if order == 2 or rows is basis.nodal_dofs else 0):
            result[ours[rows[d]], d] = u[rows[d]]
    return result


LOADS = {
    "displacement": ["hold:inferior", "move:superior:0.1,free,0.05"],
    "pressure": ["hold:inferior", "pressure:superior:0.3"],
    "traction": ["hold:inferior", "traction:superior:0.1,-0.2,0.3"],
    "spring": ["spring:inferior:2.5", "traction:superior:0.1,-0.2,0.3"],
    "gravity": ["hold:inferior", "gravity:0,3000,-9810"],
    "all": [
        "hold:inferior",
        "move:superior:free,free,0.1",
        "pressure:left:0.3",
        "pressure:left:0.1",
        "gravity:0,0,-9810",
        "traction:right:0,0.2,-0.1",
        "spring:right:2.0",
        "spring:anterior:0.5",
    ],
}
FACES = {
    "left": "x_min",
    "right": "x_max",
    "posterior": "x_min",
    "anterior": "x_max",
    "inferior": "y_min",
    "superior": "y_max",
}


def words_of(loads, n):
    """Loads for a mesh of dimension n: in a plane y takes the place of z, and there are two
    components.
    """
    if n == 3:
        return loads
    changed = []
    for load in loads:
        parts = [FACES.get(part, part) for part in load.split(":")]
        numbers = parts[-1].split(",")
        changed.append(
            ":".join([*parts[:-1], ",".join(numbers[::2] if len(numbers) == 3 else numbers)])
        )
    return changed


def model_with(mesh, sets, loads, order, **values):
    return build_model(mesh, **values, loads=words_of(loads, mesh.ndim), known_sets=sets)._replace(
        order=order
    )


@pytest.mark.parametrize(
    ("kind", "n", "order"),
    [
        *((kind, 3, 1) for kind in LOADS),
        *(("all", n, order) for n, order in BOTH if n + order != 4),
    ],
)
def test_each_kind_of_load_as_scikit_fem_has_it(kind, n, order):
    mesh, sets, values = uneven(n)
    model = model_with(mesh, sets, LOADS[kind], order, **values)
    solution = solve(model)
    expected = skfem_solution(model)
    assert np.abs(solution.u - expected).max() < 1e-9 * np.abs(expected).max()
    assert np.abs(expected).max() > 1e-3


@pytest.mark.parametrize(("n", "order"), [(2, 2), (3, 1)])
def test_moduli_at_the_nodes_as_scikit_fem_has_them(n, order):
    """Linear within each cell. Both take the n + 1 points that are exact for degree 2."""
    mesh, sets, values = uneven(n)
    model = model_with(mesh, sets, LOADS["pressure"], order, **values)
    model = model._replace(node_young=np.random.default_rng(1).uniform(1.0, 9.0, len(mesh.points)))
    u, expected = solve(model).u, skfem_solution(model)
    assert np.abs(u - expected).max() < 1e-9 * np.abs(expected).max()
    assert np.abs(u - solve(model._replace(node_young=None)).u).max() > 0.1 * np.abs(u).max()


# Closed forms


@pytest.mark.parametrize(("n", "order"), BOTH)
def test_a_bar_under_traction(n, order):
    """Free to narrow, held along its length alone: stress 0.5 kPa everywhere, for either order."""
    mesh, sets = bar(n)
    at = mesh.points[:, : n - 1].min(axis=0)
    loads = ["move:inferior:free,free,0", "traction:superior:0,0,0.5", "move:left:0,free,free"]
    loads += ["move:posterior:free,0,free"] if n == 3 else []
    solution = solve(model_with(mesh, sets, loads, order, young=4.0, nu=0.3))
    places = nodes_of_order(mesh, order)
    expected = np.column_stack([-0.3 * 0.125 * (places[:, : n - 1] - at), 0.125 * places[:, -1]])
    assert_allclose(solution.u, expected, atol=1e-12)
    stress = np.zeros((n, n))
    stress[-1, -1] = 0.5
    assert_allclose(solution.stress, np.broadcast_to(stress, solution.stress.shape), atol=1e-12)
    assert_allclose(von_mises(solution.stress), 0.5, rtol=1e-12)
    area = 2.0 ** (n - 1)
    assert solution.strain_energy == pytest.approx(0.5 * 0.5 * 0.125 * area * 6.0, rel=1e-12)
    assert_allclose(
        solution.reactions[words_of(["hold:inferior"], n)[0][5:]][-1], -0.5 * area, rtol=1e-12
    )


@pytest.mark.parametrize(("n", "order"), BOTH)
def test_a_bar_under_its_own_weight(n, order):
    """nu = 0: it hangs down by rho g (L z - z^2 / 2) / E, quadratic along it: exact at nodes, and
    all over for order 2.

    Linear cells are exact at the nodes of meshes that are the same in every layer; ours are not.
    """
    density, g, young, length = 1500.0, 9810.0, 0.5, 6.0
    mesh, sets = bar(n)
    loads = ["hold:inferior", f"gravity:0,0,{g}"]
    solution = solve(model_with(mesh, sets, loads, order, young=young, nu=0.0, density=density))
    weight = 1e-9 * density * g
    z = nodes_of_order(mesh, order)[:, -1]
    error = np.abs(solution.u[:, -1] - weight * (length * z - 0.5 * z**2) / young).max()
    largest = weight * length**2 / (2.0 * young)
    assert error < (1e-12 if order == 2 else 0.03) * largest
    volume = length * 2.0 ** (n - 1)
    assert_allclose(solution.applied[-1], weight * volume, rtol=1e-12)
    held_by = words_of(["hold:inferior"], n)[0][5:]
    assert_allclose(solution.reactions[held_by][-1], -weight * volume, rtol=1e-10)
    if order == 2:
        energy = 0.5 * weight**2 / young * length**3 / 3.0 * 2.0 ** (n - 1)
        assert solution.strain_energy == pytest.approx(energy, rel=1e-12)
        stress = weight * (length - nodes_of_order(mesh, 2)[:, -1])
        assert_allclose(
            node_means(mesh, solution.stress)[:, -1, -1], stress, atol=1e-12 * stress.max()
        )


@pytest.mark.parametrize(("n", "order"), BOTH)
def test_a_stiff_block_on_a_bed_of_springs(n, order):
    """It sinks by the force over area times stiffness, and the springs carry all of it."""
    mesh, sets = bar(n, length=2.0)
    loads = ["spring:inferior:2.0", "traction:superior:0.1,0,-0.5"]
    solution = solve(model_with(mesh, sets, loads, order, young=1e5, nu=0.3))
    force = 2.0 ** (n - 1) * np.array([0.1, 0.0, -0.5])
    bed = words_of(["hold:inferior"], n)[0][5:]
    assert_allclose(solution.reactions[bed], -force[[0, 2] if n == 2 else slice(3)], atol=1e-8)
    low = nodes_of_order(mesh, order)[:, -1] < 1e-9
    sunk = np.average(solution.u[low, -1], weights=spring_fractions(mesh, sets, bed, order)[low])
    assert sunk == pytest.approx(-0.25, rel=1e-4)
    assert solution.spring_energy > 0.999 * solution.work


def spring_fractions(mesh, sets, name, order):
    fractions = np.zeros(len(nodes_of_order(mesh, order)))
    chosen, weights = facet_weights(mesh, sets.facets[name], order)
    np.add.at(fractions, chosen, weights)
    return fractions


# Laws


@pytest.mark.parametrize(("n", "order"), BOTH)
def test_patch_with_moduli_and_ratios_of_one_kind(n, order):
    """A linear displacement of all faces is that of every node; no reaction is left inside."""
    mesh, sets, _ = uneven(n)
    slope = np.random.default_rng(5).normal(size=(n, n)) * 0.01
    points, cells = (mesh.points, mesh.cells) if order == 1 else quadratic(mesh.points, mesh.cells)
    on_boundary = np.zeros(points.shape, dtype=bool)
    on_boundary[np.unique(element_facets(cells, sets.facets["boundary"]))] = True
    system = constrain_nodes(mesh, 3.0, 0.45, on_boundary, points @ slope.T, order=order)
    u = solve_system(system)
    assert_allclose(u, points @ slope.T, atol=1e-11)
    assert (~on_boundary[:, 0]).sum() > 5
    force = (system.K @ u.ravel()).reshape(u.shape)
    assert np.abs(force[~on_boundary]).max() < 1e-10 * np.abs(force).max()


@pytest.mark.parametrize(("n", "order"), BOTH)
def test_steps_and_superposition(n, order):
    """Loads of no step are in all; solutions add up as loads do, so do reactions; energies are
    those of the work.
    """
    mesh, sets, values = uneven(n)
    common = ["hold:inferior", "spring:right:0.7"]
    forces = ["pressure:left:0.3", "traction:superior:0.1,0.3,-0.2", "gravity:0,500,-9810"]
    model = model_with(
        mesh,
        sets,
        [*common, *(f"{k}/{words}" for k, words in enumerate(forces, 1))],
        order,
        **values,
    )
    steps = [solve(model, step) for step in (1, 2, 3)]
    whole = solve(model_with(mesh, sets, [*common, *forces], order, **values))
    assert_allclose(sum(s.u for s in steps), whole.u, atol=1e-10 * np.abs(whole.u).max())
    assert_allclose(sum(s.applied for s in steps), whole.applied, atol=1e-10)
    for name, force in whole.reactions.items():
        scale = np.abs(force).max()
        assert_allclose(sum(s.reactions[name] for s in steps), force, atol=1e-9 * scale)
    for solution in (*steps, whole):
        assert solution.strain_energy + solution.spring_energy == pytest.approx(
            solution.work, rel=1e-9
        )
        assert min(solution.strain_energy, solution.spring_energy) > 0.0
        total = sum(solution.reactions.values()) + solution.applied
        assert np.abs(total).max() < 1e-9 * np.abs(list(solution.reactions.values())).max()


@pytest.mark.full
@pytest.mark.parametrize("order", [1, 2])
def test_the_work_of_what_is_moved(order):
    """Pushed faces: half of reaction times way; a free component has no reaction."""
    mesh, sets, values = uneven(3)
    model = model_with(
        mesh, sets, ["hold:inferior", "move:superior:0.2,free,-0.1"], order, **values
    )
    solution = solve(model)
    reaction = solution.reactions["superior"]
    assert solution.work == pytest.approx(0.5 * (0.2 * reaction[0] - 0.1 * reaction[2]), rel=1e-10)
    assert solution.strain_energy == pytest.approx(solution.work, rel=1e-10)
    assert reaction[1] == 0.0
    assert solution.spring_energy == 0.0


@pytest.mark.full
@pytest.mark.parametrize("order", [1, 2])
def test_it_is_the_compression(order):
    mesh, sets, values = uneven(3)
    ours = solve(model_with(mesh, sets, ["compress:5%"], order, **values))
    low, high = (nodes_of(mesh, sets.facets[name]) for name in ("inferior", "superior"))
    push = ours.u[low[0]]
    options = {"fixed_nodes": high, "pushed_nodes": low, "displacement": push, "order": order}
    pressed = compression(mesh, values["young"], values["nu"], **options)
    assert_allclose(ours.u, pressed.u, atol=1e-12)
    assert ours.strain_energy == pytest.approx(pressed.strain_energy, rel=1e-11)
    assert_allclose(ours.reactions["inferior"], pressed.reaction, rtol=1e-9)


def test_units_do_not_matter():
    mesh, sets, values = uneven(3)
    model = model_with(mesh, sets, LOADS["all"], 1, **values)
    ours, other = solve(model), solve(in_units(model, "MPa"))
    assert_allclose(other.u, ours.u, rtol=1e-9, atol=1e-12)
    assert other.strain_energy == pytest.approx(ours.strain_energy, rel=1e-9)


@pytest.mark.full
@pytest.mark.parametrize("n", [2, 3])
def test_quadratic_cells_converge_faster(n):
    """A bending cantilever: of the fine quadratic solution, errors of energy fall as h^2 and, of
    order 2, faster.
    """
    loads = ["hold:inferior", "traction:superior:0.1,0,0"]

    def energy(blocks, order):
        mesh, sets = bar(n, blocks)
        return solve(model_with(mesh, sets, loads, order, young=4.0, nu=0.3)).strain_energy

    fine = energy(12 if n == 2 else 5, 2)
    errors = {order: [1.0 - energy(blocks, order) / fine for blocks in (1, 2)] for order in (1, 2)}
    assert min(min(each) for each in errors.values()) > 0.0  # too stiff, from below
    assert errors[2][1] < 0.1 * errors[1][1]
    assert errors[2][0] < errors[1][1]  # coarser by half, with fewer nodes than the linear one
    assert errors[2][0] / errors[2][1] > errors[1][0] / errors[1][1]


def test_any_number_of_free_pieces_on_springs():
    """Two bars apart, one held and one on springs alone."""
    mesh, sets = bar(2)
    n_points = len(mesh.points)
    pair = Mesh(
        np.vstack([mesh.points, 50.0 + mesh.points]), np.vstack([mesh.cells, mesh.cells + n_points])
    )
    later, low, high = np.array([[len(mesh.cells), 0]]), sets.facets["y_min"], sets.facets["y_max"]
    both = {"first": low, "second": low + later, "top": high + later}
    loads = ["hold:first", "spring:second:3", "pressure:top:0.2"]
    model = build_model(pair, young=2.0, nu=0.3, loads=loads, known_sets=Sets(both, {}))
    solution = solve(model)
    assert np.abs(solution.u[: len(mesh.points)]).max() == 0.0
    assert_allclose(solution.reactions["second"], [0.0, 0.4], atol=1e-12)
    with pytest.raises(InputError) as error:
        solve(model._replace(loads=(model.loads[0], model.loads[2])))
    n_cells = len(mesh.cells)
    assert str(error.value) == (
        "mesh: 1 components have no node that is fixed, displaced or on a spring; the first has "
        f"{n_cells} cells "
        f"around cell {n_cells} (node {pair.cells[n_cells, 0]}); fix it or remove it"
    )


# Iterative


@pytest.mark.parametrize("nu", [0.3, 0.45])
def test_multigrid_of_order_2_is_symmetric_and_positive(nu):
    mesh, sets = bar(3, 1)
    rng = np.random.default_rng(0)
    young = np.exp(rng.uniform(0.0, np.log(1e3), len(mesh.cells)))
    model = model_with(
        mesh,
        sets,
        ["hold:inferior", "pressure:superior:0.1", "spring:left:0.1"],
        2,
        young=young,
        nu=nu,
    )
    system = solve(model).system
    cycle = multigrid(system)
    dense = np.column_stack([cycle @ unit for unit in np.eye(len(system.free))])
    assert_allclose(dense, dense.T, atol=1e-12 * np.abs(dense).max())
    assert np.linalg.eigvalsh(dense)[0] > 0.0
    assert np.linalg.eigvals(dense @ system.K_ff.toarray()).real.min() > 0.02


@pytest.mark.full
@pytest.mark.parametrize("n", [2, 3])
def test_multigrid_and_factorisation_agree_with_order_2(n):
    mesh, sets = bar(n, 12 if n == 2 else 4)
    young = np.exp(np.random.default_rng(0).uniform(0.0, np.log(1e3), len(mesh.cells)))
    loads = [words for words in LOADS["all"] if not words.startswith("gravity")]
    model = model_with(mesh, sets, loads, 2, young=young, nu=0.45)
    direct, amg = (solve(model, method=method) for method in ("direct", "amg"))
    assert direct.n_iterations == 0
    assert 5 < amg.n_iterations < 80
    assert_allclose(amg.u, direct.u, atol=1e-8 * np.abs(direct.u).max())
    assert amg.strain_energy == pytest.approx(direct.strain_energy, rel=1e-10)


@pytest.mark.parametrize("method", ["direct", "amg"])
def test_conditioning_of_order_2(method):
    mesh, sets = bar(3, 1)
    model = model_with(
        mesh,
        sets,
        ["hold:inferior", "pressure:superior:0.1", "spring:left:0.1"],
        2,
        young=3.0,
        nu=0.4,
    )
    system = solve(model).system
    values = np.linalg.eigvalsh(system.K_ff.toarray())
    extremes = conditioning(system, method=method)
    assert extremes.lambda_max == pytest.approx(values[-1], rel=1e-9)
    assert extremes.lambda_min == pytest.approx(values[0], rel=1e-7)


# Fields


@pytest.mark.parametrize(("n", "order"), [(2, 1), (3, 2)])
def test_fields(n, order):
    """Names, shapes and what they are: means of cells, and means by volume around nodes."""
    mesh, sets, values = uneven(n)
    model = model_with(mesh, sets, LOADS["all"], order, **values)
    solution = solve(model)
    fields = solution_fields(mesh, solution)
    n_nodes = len(nodes_of_order(mesh, order))
    assert {name: each.shape for name, each in fields.point_data.items()} == {
        "displacement": (n_nodes, n),
        "strain_nodes": (n_nodes, n * n),
        "stress_nodes": (n_nodes, n * n),
        "von_mises_nodes": (n_nodes,),
    }
    assert set(fields.cell_data) == {"strain", "stress", "von_mises"}
    assert_array_equal(fields.cell_data["strain"].reshape(-1, n, n), strains(mesh, solution.u))
    second = solution_fields(mesh, solution, 2)
    assert set(second.cell_data) == {"strain_step2", "stress_step2", "von_mises_step2"}
    assert_array_equal(second.point_data["displacement_step2"], solution.u)
    # Each cell's stress by the law of its own material, of its own mean strain.
    strain = fields.cell_data["strain"].reshape(-1, n, n)
    young, nu = values["young"][:, None, None], values["nu"][:, None, None]
    narrowing = 1.0 - nu**2 if n == 2 else (1.0 + nu) * (1.0 - 2.0 * nu)
    trace_of = np.einsum("cii->c", strain)[:, None, None]
    stress = young * nu / narrowing * trace_of * np.eye(n) + young / (1.0 + nu) * strain
    assert_allclose(
        fields.cell_data["stress"].reshape(-1, n, n), stress, atol=1e-10 * np.abs(stress).max()
    )


@pytest.mark.parametrize("n", [2, 3])
def test_strain_at_nodes_of_a_quadratic_displacement(n):
    """It is linear all over the mesh, so that what each cell says of a node is the same, and
    exact.
    """
    mesh, _, _ = uneven(n)
    points = quadratic(mesh.points, mesh.cells)[0]
    points = points - points.mean(axis=0)
    mesh = Mesh(mesh.points - mesh.points.mean(axis=0), mesh.cells)
    points = quadratic(mesh.points, mesh.cells)[0]
    rng = np.random.default_rng(4)
    form = rng.normal(size=(n, n, n))
    form = form + form.swapaxes(1, 2)
    u = np.einsum("ijk,pj,pk->pi", form, points, points)
    slope = 2.0 * np.einsum("ijk,pk->pij", form, points)
    at_nodes = node_means(mesh, gauss_strains(mesh, u))
    assert_allclose(at_nodes, 0.5 * (slope + slope.swapaxes(1, 2)), atol=1e-8)


def test_means_at_nodes_are_by_volume():
    """A cell of 1 and one of 3 times its area share two nodes."""
    mesh = Mesh([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [3.0, 1.0]], [[0, 1, 2], [1, 3, 2]])
    v = volumes(mesh.points, mesh.cells)
    means = node_means(mesh, np.array([[10.0], [20.0]]))
    shared = (10.0 * v[0] + 20.0 * v[1]) / v.sum()
    assert_allclose(means, [10.0, shared, shared, 20.0])


def test_von_mises():
    """Pulled along one axis it is that stress; sheared sqrt(3) times; under pressure alone
    nothing; plane or not.
    """
    pulled, sheared = np.diag([2.0, 0.0, 0.0]), np.zeros((3, 3))
    sheared[0, 1] = sheared[1, 0] = 1.5
    assert_allclose(
        von_mises(np.array([pulled, sheared, -4.0 * np.eye(3)])), [2.0, 1.5 * 3**0.5, 0.0]
    )
    assert_allclose(von_mises(np.array([pulled[:2, :2], sheared[:2, :2]])), [2.0, 1.5 * 3**0.5])
    assert_allclose(von_mises(-4.0 * np.eye(2)), 4.0)


# Refusals


def refused(model, step=1):
    with pytest.raises(InputError) as error:
        solve(model, step)
    return str(error.value)


def test_what_cannot_be_solved():
    mesh, sets = bar(3)
    loads = ["hold:inferior", "2/pressure:superior:1", "1/gravity:0,0,1"]
    model = model_with(mesh, sets, loads, 1, young=2.0, nu=0.3, density=1.0)
    assert refused(model, 3) == "step: expected 1 to 2, got 3"
    assert refused(model, 0) == "step: expected 1 to 2, got 0"
    assert (
        refused(model._replace(materials=None)) == "model: the cells have no moduli; give `young`"
    )
    weightless = model._replace(materials=model.materials._replace(density=None))
    assert (
        refused(weightless)
        == "gravity: the cells have no density; give `density` in kg/m3, such as 1000"
    )
    other = model._replace(loads=(*model.loads, Load("torque", "superior", np.ones(3))))
    assert (
        refused(other)
        == 'load: expected displacement, pressure, traction, spring or gravity, got "torque"'
    )
    adrift = model._replace(loads=model.loads[1:])
    assert refused(adrift) == (
        "mesh: no displacement or spring constrains it, so it can move freely; fix or support at "
        "least one set, "
        "for example with hold:SET or spring:SET:K"
    )
    sliding = model_with(
        mesh, sets, ["move:inferior:free,free,0", "pressure:superior:1"], 1, young=2.0
    )
    assert refused(sliding).startswith(f"mesh: {len(mesh.cells)} cells around cell 0 ")
    assert "can still rotate or slide as a whole" in refused(sliding)


def test_forces_that_do_not_balance_are_an_error(monkeypatch):
    """If the matrix were not what it should be: a spring that is not accounted for."""
    mesh, sets = bar(2)
    model = model_with(
        mesh, sets, ["hold:inferior", "traction:superior:0,0,0.5"], 1, young=4.0, nu=0.3
    )
    plain = module.constrain_nodes

    def with_leak(*arguments, **options):
        system = plain(*arguments, **options)
        leak = diags_array(np.full(system.K.shape[0], 1e-6)).tocsr()
        return system._replace(
            K=system.K + leak, K_ff=system.K_ff + leak[system.free][:, system.free]
        )

    monkeypatch.setattr(module, "constrain_nodes", with_leak)
    with pytest.raises(
        RuntimeError,
        match=r"^elasticity: forces and reactions do not balance: the remainder .* mN exceeds",
    ):
        solve(model)


# What a set's reaction is made of


def test_reactions_of_a_set_add_up():
    """Held along single axes by two loads, and on springs besides: one force, which balances the
    others.
    """
    mesh, sets = bar(3)
    words = [
        "move:inferior:0,0,free",
        "move:inferior:free,free,0.1",
        "spring:inferior:2",
        "traction:superior:1,0,3",
    ]
    for order in (1, 2):
        solution = solve(build_model(mesh, young=10.0, known_sets=sets, loads=words, order=order))
        assert list(solution.reactions) == ["inferior"]
        # The springs pull by 2 kPa/mm * 0.1 mm on 4 mm2; the support's part is what is left.
        assert_allclose(solution.reactions["inferior"], [-4.0, 0.0, -12.0], atol=1e-7)


CHILD = """
import hashlib
import numpy as np
import tetopt
from tetopt.fem.solution import solution_fields, solve
from tetopt.model.build import build_model

image = tetopt.Image(np.random.default_rng(0).uniform(1.0, 50.0, (12, 12, 12)))
mesh = tetopt.lattice_mesh(image, nodes=4200)
model = build_model(mesh, image, young="1 + h", loads=["compress:5%"])
solution = solve(model)
fields = solution_fields(model.mesh, solution)
assert solution.n_iterations > 5 and len(solution.system.free) > 10_000
nodal = fields.point_data["stress_nodes"]
numbers = [solution.u, solution.stress, nodal, *solution.reactions.values()]
digest = hashlib.sha256(b"".join(each.tobytes() for each in numbers)).hexdigest()
print(digest, repr(solution.strain_energy))
"""


@pytest.mark.deep
def test_the_same_bits_on_any_number_of_blas_threads():
    """BLAS and LAPACK share long sums among threads, and round otherwise; a solution by
    multigrid does not.
    """
    results = set()
    for threads in ("1", "2"):
        environment = dict(os.environ) | dict.fromkeys(
            ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), threads
        )
        words = [sys.executable, "-c", CHILD]
        done = subprocess.run(words, env=environment, capture_output=True, check=True, text=True)
        results.add(done.stdout)
    assert len(results) == 1


@pytest.mark.parametrize("order", [1, 2])
def test_a_hollow_sphere_under_pressure_from_within(order):
    """Lame's solution: u_r = p a^3 / (E (b^3 - a^3)) ((1 - 2 nu) r + (1 + nu) b^3 / (2 r^2)), and
    its stresses.

    An eighth of it, held across the three planes of symmetry. Facets are flat, which quadratic
    cells do not change: their error falls with the square of the facets' size.
    """
    inner, outer, young, nu, pressure = 1.0, 2.0, 3.0, 0.45, 0.2
    loads = [
        "move:x:0,free,free",
        "move:y:free,0,free",
        "move:z:free,free,0",
        f"pressure:inner:{pressure}",
    ]
    factor = pressure * inner**3 / (outer**3 - inner**3)
    errors = []
    for blocks in (4, 8):
        mesh, sets = eighth_of_a_shell(inner, outer, blocks, blocks // 2)
        model = build_model(mesh, young=young, nu=nu, loads=loads, known_sets=sets)._replace(
            order=order
        )
        solution = solve(model)
        r = np.linalg.norm(mesh.points, axis=1)
        along = factor / young * ((1.0 - 2.0 * nu) * r + (1.0 + nu) * outer**3 / (2.0 * r**2))
        errors.append(
            np.abs((solution.u[: len(r)] * mesh.points).sum(axis=1) / r - along).max() / along.max()
        )
    assert errors[1] < (0.04 if order == 2 else 0.5)
    assert errors[0] / errors[1] > (3.0 if order == 2 else 1.5)
    # The trace of the stress is the same everywhere.
    trace_of = np.einsum("cqii->cq", solution.stress)
    assert trace_of.mean() == pytest.approx(3.0 * factor, rel=0.03 if order == 2 else 0.4)


def eighth_of_a_shell(inner, outer, around, across):
    """An eighth of a hollow sphere, and its sides as sets: the lattice of a triangle times the
    radii.
    """
    corners = [(i, j) for i in range(around + 1) for j in range(around + 1 - i)]
    number = {corner: k for k, corner in enumerate(corners)}
    flat = [
        (number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in corners if i + j < around
    ]
    flat += [
        (number[i + 1, j], number[i + 1, j + 1], number[i, j + 1])
        for i, j in corners
        if i + j < around - 1
    ]
    directions = np.array([(around - i - j, i, j) for i, j in corners], dtype=float)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = inner * (outer / inner) ** (np.arange(across + 1) / across)
    points = (radii[:, None, None] * directions).reshape(-1, 3)
    cells, size = [], len(corners)
    for layer in range(across):
        # prisms cut alike on the sides that they share
        for a, b, c in (sorted(triangle) for triangle in flat):
            low, high = layer * size, (layer + 1) * size
            cells += [
                [low + a, low + b, low + c, high + c],
                [low + a, low + b, high + b, high + c],
                [low + a, high + a, high + b, high + c],
            ]
    mesh = Mesh(points, orient_cells(points, np.array(cells)))
    rows = boundary_rows(mesh)
    triples = mesh.points[facet_triples(mesh.cells, rows)]
    distance = np.linalg.norm(triples, axis=2)
    sides = {
        "inner": (distance < inner + 1e-9).all(axis=1),
        "outer": (distance > outer - 1e-9).all(axis=1),
    }
    sides |= {"xyz"[d]: (np.abs(triples[:, :, d]) < 1e-12).all(axis=1) for d in range(3)}
    assert sum(each.sum() for each in sides.values()) == len(rows)
    return mesh, Sets({name: rows[is_on] for name, is_on in sides.items()}, {})


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("order", [1, 2])
def test_a_confined_plate_under_pressure(n, order):
    """Sides held sideways: strain p (1 + nu)(1 - 2 nu) / (E (1 - nu)), in plane stress p (1 -
    nu^2) / E.
    """
    mesh, sets = bar(n)
    young, nu, pressure = 3.0, 0.4, 0.5
    loads = ["move:left:0,free,free", "move:right:0,free,free", "move:inferior:free,free,0"]
    loads += ["move:posterior:free,0,free", "move:anterior:free,0,free"] if n == 3 else []
    model = model_with(
        mesh, sets, [*loads, f"pressure:superior:{pressure}"], order, young=young, nu=nu
    )
    solution = solve(model)
    compliance = (
        (1.0 - nu**2) / young if n == 2 else (1.0 + nu) * (1.0 - 2.0 * nu) / (young * (1.0 - nu))
    )
    expected = np.zeros_like(solution.u)
    expected[:, -1] = -compliance * pressure * nodes_of_order(mesh, order)[:, -1]
    assert_allclose(solution.u, expected, atol=1e-12)
    wall = solution.reactions[words_of(["hold:left"], n)[0][5:]]
    sideways = nu if n == 2 else nu / (1.0 - nu)  # of the pressure
    assert_allclose(wall[0], sideways * pressure * 6.0 * 2.0 ** (n - 2), rtol=1e-10)


def test_near_incompressible_cells_of_order_1_lock():
    loads = ["hold:inferior", "traction:superior:0.1,0,0"]
    mesh, sets = bar(3)
    moved = {
        (order, nu): np.abs(solve(model_with(mesh, sets, loads, order, young=4.0, nu=nu)).u).max()
        for order in (1, 2)
        for nu in (0.3, 0.499)
    }
    assert moved[2, 0.499] > 0.75 * moved[2, 0.3]
    assert moved[1, 0.499] < 0.6 * moved[1, 0.3]
