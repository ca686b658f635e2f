"""Models solved: closed forms, another library's answer for each kind of load, laws, and what
cannot be solved.
"""

import numpy as np
import pytest
import skfem
from meshes import random_rotation, split_box
from models import LOAD_CASES, load_words
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal
from scipy.sparse import diags_array
from scipy.spatial import cKDTree
from skfem.models.elasticity import lame_parameters, linear_elasticity, plane_stress
from test_elasticity import block
from threadpoolctl import threadpool_limits

from tetopt import Image, Mesh, lattice_mesh
from tetopt.fem import solution as module
from tetopt.fem.elasticity import (
    gauss_strains,
    strains,
)
from tetopt.fem.solution import node_means, solution_fields, solve, von_mises
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.simplex import volumes
from tetopt.model.build import build_model
from tetopt.model.loads import Load
from tetopt.model.model import in_space, in_units, mass_densities
from tetopt.model.sets import Sets, box_of, standard_sets

BOTH = [(n, order) for n in (2, 3) for order in (1, 2)]


def bar(n):
    """A box of 2 x (2 x) 6 mm whose faces are sets, the last axis its length."""
    kind = None if n == 2 else "five-tet"
    image, mesh = block((2.0,) * (n - 1) + (6.0,), (2,) * (n - 1) + (4,), kind)
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


def skfem_solution(model):
    """Places and displacements (N, n) of scikit-fem's nodes, and the strain energy.

    Its own forms on sets by their names. Springs are to the ground at the nodes, as those of every
    solver we write for, so that their matrix is lumped.
    """
    mesh, n, table = model._replace(order=1).to_skfem(), model.mesh.ndim, model.materials
    shape = "Tet" if n == 3 else "Tri"
    constant, linear = (getattr(skfem, f"Element{shape}P{degree}")() for degree in (0, 1))
    element = skfem.ElementVector(getattr(skfem, f"Element{shape}P{model.order}")())
    basis = skfem.Basis(mesh, element, intorder=2 * model.order - 2 or 1)
    whole = skfem.Basis(mesh, element, intorder=2)

    def on_cells(values, basis=basis):
        return np.asarray(basis.with_element(constant).interpolate(values[table.of_cell]))

    young = on_cells(table.young)
    if model.node_young is not None:
        young = np.asarray(basis.with_element(linear).interpolate(model.node_young))
    law = lame_parameters if n == 3 else plane_stress
    K = linear_elasticity(*law(young, on_cells(table.nu))).assemble(basis)
    push = skfem.LinearForm(lambda v, w: (w.force * v).sum(axis=0))
    forces, springs, u, prescribed = basis.zeros(), basis.zeros(), basis.zeros(), []
    for load in model.loads:
        vector = load.numbers[:, None, None]
        if load.kind == "gravity":
            forces += push.assemble(whole, force=on_cells(mass_densities(model), whole) * vector)
            continue
        if load.kind == "displacement":
            dofs = basis.get_dofs(load.set_name)
            for d in np.flatnonzero(np.isfinite(load.numbers)):
                prescribed.append(dofs.all([f"u^{d + 1}"]))
                u[prescribed[-1]] = load.numbers[d]
            continue
        side = skfem.FacetBasis(mesh, element, facets=mesh.boundaries[load.set_name], intorder=2)
        stress = vector * (
            -side.normals if load.kind == "pressure" else np.ones(side.normals.shape)
        )
        target = springs if load.kind == "spring" else forces
        target += push.assemble(side, force=np.asarray(stress))
    dofs = np.unique(np.concatenate(prescribed)) if prescribed else np.empty(0, dtype=np.int64)
    stiffness = (K + diags_array(springs)).tocsr()
    u = skfem.solve(*skfem.condense(stiffness, forces, x=u, D=dofs))
    by_node = basis.nodal_dofs
    if model.order == 2:
        by_node = np.concatenate([by_node, basis.edge_dofs if n == 3 else basis.facet_dofs], axis=1)
    return basis.doflocs[:, by_node[0]].T, u[by_node].T, 0.5 * float(u @ K @ u)


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


@pytest.mark.parametrize("moduli", ["cells", "nodes"])
@pytest.mark.parametrize("case", LOAD_CASES)
def test_each_kind_of_load_as_scikit_fem_has_it(case, n, order, moduli):
    """Moduli at the nodes are linear within each cell."""
    mesh, sets, values = uneven(n)
    model = model_with(mesh, sets, load_words(case, n), order, **values)
    if moduli == "nodes":
        at_nodes = np.random.default_rng(1).uniform(1.0, 9.0, len(mesh.points))
        model = model._replace(node_young=at_nodes)
    own, (places, u, energy) = solve(model), skfem_solution(model)
    distance, node = cKDTree(nodes_of_order(mesh, order)).query(places)
    assert distance.max() < 1e-9
    assert len(np.unique(node)) == len(own.u)
    assert_allclose(u, own.u[node], atol=1e-9 * np.abs(own.u).max())
    assert energy == pytest.approx(own.strain_energy, rel=1e-9)
    assert np.abs(u).max() > 1e-3


# Closed forms


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


# Laws


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


def test_units_and_axes_do_not_matter():
    """Here and in scikit-fem; 1 mJ is 1000 uJ."""
    mesh, sets, values = uneven(3)
    model = model_with(mesh, sets, load_words("all"), 1, **values)
    turned = in_units(in_space(model, "lps"), "MPa")
    one, other = solve(model), solve(in_units(model, "MPa"))
    (_, u, energy), (_, turned_u, turned_energy) = map(skfem_solution, (model, turned))
    assert_allclose(other.u, one.u, rtol=1e-9, atol=1e-12)
    assert_allclose(turned_u * [-1.0, -1.0, 1.0], u, rtol=1e-9, atol=1e-12)
    assert other.strain_energy == pytest.approx(one.strain_energy, rel=1e-9)
    assert 1e3 * turned_energy == pytest.approx(energy, rel=1e-9)


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


# Fields


@pytest.mark.parametrize(("n", "order"), [(2, 1), (3, 2)])
def test_fields(n, order):
    """Names, shapes and what they are: means of cells, and means by volume around nodes."""
    mesh, sets, values = uneven(n)
    model = model_with(mesh, sets, load_words("all", n), order, **values)
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


def test_strain_at_nodes_of_a_quadratic_displacement(n):
    """It is linear all over the mesh, so that what each cell says of a node is the same, and
    exact.
    """
    mesh, _, _ = uneven(n)
    mesh = Mesh(mesh.points - mesh.points.mean(axis=0), mesh.cells)
    points = quadratic(mesh.points, mesh.cells)[0]
    form = np.random.default_rng(4).normal(size=(n, n, n))
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


def test_what_cannot_be_solved():
    mesh, sets = bar(3)
    loads = ["hold:inferior", "2/pressure:superior:1", "1/gravity:0,0,1"]
    model = model_with(mesh, sets, loads, 1, young=2.0, nu=0.3, density=1.0)
    sliding = ["move:inferior:free,free,0", "pressure:superior:1"]
    torque = Load("torque", "superior", np.ones(3))
    for each, step, words in (
        (model, 3, "step: .* 1 to 2, got 3"),
        (model, 0, "step: .* 1 to 2, got 0"),
        (model._replace(materials=None), 1, "`young`"),
        (model._replace(materials=model.materials._replace(density=None)), 1, "gravity: .*density"),
        (model._replace(loads=(*model.loads, torque)), 1, 'load: .*"torque"'),
        (model._replace(loads=model.loads[1:]), 1, "it can move freely"),
        (
            model_with(mesh, sets, sliding, 1, young=2.0),
            1,
            f"{len(mesh.cells)} cells around cell 0 .* can still rotate or slide",
        ),
    ):
        with refusal(words):
            solve(each, step)


@pytest.mark.deep
def test_the_same_bits_on_any_number_of_blas_threads():
    """BLAS and LAPACK share long sums among threads, and round otherwise; a solution by
    multigrid does not.
    """
    image = Image(np.random.default_rng(0).uniform(1.0, 50.0, (12, 12, 12)))
    mesh = lattice_mesh(image, nodes=4200)
    model = build_model(mesh, image, young="1 + h", loads=["compress:5%"])
    results = set()
    for threads in (1, 2):
        with threadpool_limits(threads):
            solution = solve(model)
            nodal = solution_fields(model.mesh, solution).point_data["stress_nodes"]
        assert solution.n_iterations > 5
        assert len(solution.system.free) > 10_000
        numbers = [solution.u, solution.stress, nodal, *solution.reactions.values()]
        results.add((*(each.tobytes() for each in numbers), solution.strain_energy))
    assert len(results) == 1


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
