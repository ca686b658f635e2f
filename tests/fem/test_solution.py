"""Models solved: closed forms, another library's answer for each kind of load, laws, and what cannot be solved."""

import numpy as np
import pytest
import skfem
from meshes import random_rotation, split_box
from scipy.spatial import cKDTree
from skfem.helpers import ddot, dot, sym_grad, trace

from tetopt import Image, Mesh, lattice
from tetopt.fem.solution import solved_model
from tetopt.geometry.quadratic import quadratic
from tetopt.model.build import model_of
from tetopt.model.sets import box_of, standard_sets

BOTH = [(n, order) for n in (2, 3) for order in (1, 2)]


def bar(n, blocks=2, length=6.0):
    """A box of 2 x (2 x) `length` mm whose faces are sets, the last axis its length."""
    sides = np.array([2.0] * (n - 1) + [length])
    affine = np.eye(n + 1)
    affine[:n, :n] = np.diag(sides)
    affine[:n, n] = 0.5 * sides
    image = Image(np.zeros((1,) * n), affine)
    mesh = lattice(image, None if n == 2 else "five-tet", blocks=(blocks,) * (n - 1) + (2 * blocks,))
    return mesh, standard_sets(mesh, box_of(image))


def bar_model(n, loads, order, *, young=4.0, nu=0.3, density=None, blocks=2, length=6.0):
    mesh, sets = bar(n, blocks, length)
    return model_with(mesh, sets, loads, order, young=young, nu=nu, density=density)


def nodes(model):
    return model.mesh.points if model.order == 1 else quadratic(model.mesh.points, model.mesh.cells)[0]


def uneven(n, seed=3):
    """A mesh of thin cells, turned in space, with the box's faces as sets, and a modulus, ratio and density a cell."""
    rng = np.random.default_rng(seed)
    points, cells = split_box(rng, (3,) * n, 30, step=0.25)
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
    """Displacements in the order of our nodes, by scikit-fem: its assembly, its integrals over facets and cells.

    Springs are to the ground at the nodes, as those of every solver we write for, so that their matrix is lumped; all
    other loads are integrals of shape functions.
    """
    n, order, mesh = model.mesh.ndim, model.order, model._replace(order=1).to_skfem()
    element = {
        (2, 1): skfem.ElementTriP1, (3, 1): skfem.ElementTetP1, (2, 2): skfem.ElementTriP2, (3, 2): skfem.ElementTetP2
    }[n, order]()  # fmt: skip
    constant = skfem.ElementTriP0() if n == 2 else skfem.ElementTetP0()
    linear = skfem.ElementTriP1() if n == 2 else skfem.ElementTetP1()
    basis = skfem.Basis(mesh, skfem.ElementVector(element), intorder=2)
    table = model.materials
    of_cell = {"nu": table.nu[table.of_cell]}
    of_cell["density"] = np.zeros_like(of_cell["nu"]) if table.density is None else table.density[table.of_cell]
    fields = {name: basis.with_element(constant).interpolate(values) for name, values in of_cell.items()}
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
            f += skfem.LinearForm(lambda v, w, load=load: -load.numbers[0] * dot(w.n, v)).assemble(on_set)
        elif load.kind == "traction":
            f += skfem.LinearForm(lambda v, w, load=load: sum(load.numbers[d] * v[d] for d in range(n))).assemble(
                on_set
            )
        elif load.kind == "gravity":
            weight = skfem.LinearForm(
                lambda v, w, load=load: 1e-9 * w.density * sum(load.numbers[d] * v[d] for d in range(n))
            )
            f += weight.assemble(basis, density=fields["density"])
        else:
            share = skfem.LinearForm(lambda v, w: v[0] + v[1] + (v[2] if n == 3 else 0.0)).assemble(on_set)
            K.setdiag(K.diagonal() + load.numbers[0] * share)
    u = skfem.solve(
        *skfem.condense(K.tocsr(), f, x=prescribed, D=np.unique(np.concatenate(dofs or [np.empty(0, int)])))
    )
    distance, ours = cKDTree(nodes(model)).query(basis.doflocs.T)
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
    "all": ["hold:inferior", "move:superior:free,free,0.1", "pressure:left:0.3", "pressure:left:0.1",
            "gravity:0,0,-9810", "traction:right:0,0.2,-0.1", "spring:right:2.0", "spring:anterior:0.5"],
}  # fmt: skip
FACES = {"left": "x_min", "right": "x_max", "posterior": "x_min", "anterior": "x_max", "inferior": "y_min",
         "superior": "y_max"}  # fmt: skip


def words_of(loads, n):
    """Loads for a mesh of dimension n: in a plane y takes the place of z, and there are two components."""
    if n == 3:
        return loads
    changed = []
    for load in loads:
        parts = [FACES.get(part, part) for part in load.split(":")]
        numbers = parts[-1].split(",")
        changed.append(":".join([*parts[:-1], ",".join(numbers[::2] if len(numbers) == 3 else numbers)]))
    return changed


def model_with(mesh, sets, loads, order, **values):
    return model_of(mesh, **values, loads=words_of(loads, mesh.ndim), known_sets=sets)._replace(order=order)


@pytest.mark.parametrize(("n", "order"), BOTH)
@pytest.mark.parametrize("kind", LOADS)
def test_each_kind_of_load_as_scikit_fem_has_it(kind, n, order):
    mesh, sets, values = uneven(n)
    model = model_with(mesh, sets, LOADS[kind], order, **values)
    solution = solved_model(model)
    expected = skfem_solution(model)
    assert np.abs(solution.u - expected).max() < 1e-9 * np.abs(expected).max()
    assert np.abs(expected).max() > 1e-3


@pytest.mark.parametrize(("n", "order"), BOTH)
def test_moduli_at_the_nodes_as_scikit_fem_has_them(n, order):
    """Linear within each cell. Both take the n + 1 points that are exact for degree 2."""
    mesh, sets, values = uneven(n)
    model = model_with(mesh, sets, LOADS["pressure"], order, **values)
    model = model._replace(node_young=np.random.default_rng(1).uniform(1.0, 9.0, len(mesh.points)))
    u, expected = solved_model(model).u, skfem_solution(model)
    assert np.abs(u - expected).max() < 1e-9 * np.abs(expected).max()
    assert np.abs(u - solved_model(model._replace(node_young=None)).u).max() > 0.1 * np.abs(u).max()
