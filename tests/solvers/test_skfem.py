"""A model loaded by scikit-fem: sets by name, moduli cell by cell, and the energy of our own
solver.
"""

import numpy as np
import pytest
from models import LOAD_CASES, loaded_model, sample_model
from scipy.sparse import diags
from scipy.spatial import KDTree

from tetopt.fem.solution import solve
from tetopt.model.model import elements, in_space, in_units, mass_densities

skfem = pytest.importorskip("skfem", reason="no scikit-fem (pip install scikit-fem)")
elasticity = pytest.importorskip("skfem.models.elasticity")


# Every kind of load, by scikit-fem's own forms on sets taken by their names


def loaded(model):
    """Places (N, n) and displacements (N, n) of scikit-fem's nodes, and the strain energy."""
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
    law = elasticity.lame_parameters if n == 3 else elasticity.plane_stress
    K = elasticity.linear_elasticity(*law(young, on_cells(table.nu))).assemble(basis)
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
        ones = np.ones_like(side.normals)
        stress = {
            "pressure": -vector * side.normals,
            "traction": vector * ones,
            "spring": vector * ones,
        }[load.kind]
        target = springs if load.kind == "spring" else forces
        target += push.assemble(side, force=np.asarray(stress))
    dofs = np.unique(np.concatenate(prescribed)) if prescribed else np.empty(0, dtype=np.int64)
    u = skfem.solve(*skfem.condense((K + diags(springs)).tocsr(), forces, x=u, D=dofs))
    by_node = basis.nodal_dofs
    if model.order == 2:
        by_node = np.concatenate([by_node, basis.edge_dofs if n == 3 else basis.facet_dofs], axis=1)
    return basis.doflocs[:, by_node[0]].T, u[by_node].T, 0.5 * float(u @ K @ u)


@pytest.mark.parametrize("moduli", ["cells", "nodes"])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("n", [3, 2])
@pytest.mark.parametrize("case", LOAD_CASES)
def test_each_load_is_what_fem_makes_of_it(case, n, order, moduli):
    model = loaded_model(case, n, order, moduli)
    own, (places, u, energy) = solve(model), loaded(model)
    distance, node = KDTree(elements(model)[0]).query(places)
    assert distance.max() < 1e-9
    assert len(np.unique(node)) == len(own.u)
    assert np.abs(u - own.u[node]).max() < 1e-10 * np.abs(own.u).max()
    assert energy == pytest.approx(own.strain_energy, rel=1e-10)


def test_in_other_axes_and_units_it_is_the_same_thing():
    """Each material with its own ratio; 1 mJ is 1000 uJ."""
    model = sample_model()
    _, u, energy = loaded(model)
    _, turned, other = loaded(in_units(in_space(model, "lps"), "MPa"))
    assert energy > 1.0
    assert np.abs(turned * [-1.0, -1.0, 1.0] - u).max() < 1e-12
    assert 1e3 * other == pytest.approx(energy, rel=1e-12)
