"""A model pressed by scikit-fem: sets by name, moduli cell by cell, and the energy of our own solver."""

import numpy as np
import pytest
from models import our_compression, sample_model, with_one_ratio

from tetopt.model.model import in_space, in_units

skfem = pytest.importorskip("skfem", reason="no scikit-fem (pip install scikit-fem)")
elasticity = pytest.importorskip("skfem.models.elasticity")

NU = 0.4


def pressed(model):
    """Displacement (N, n) and strain energy by scikit-fem, loads as in the model."""
    mesh, n = model.to_skfem(), model.mesh.ndim
    linear, constant = {
        2: (skfem.ElementTriP1(), skfem.ElementTriP0()),
        3: (skfem.ElementTetP1(), skfem.ElementTetP0()),
    }[n]
    basis = skfem.Basis(mesh, skfem.ElementVector(linear), intorder=1)
    table = model.materials
    law = elasticity.lame_parameters if n == 3 else elasticity.plane_stress
    on_cells = basis.with_element(constant)
    lame, mu = (np.asarray(on_cells.interpolate(c[table.of_cell])) for c in law(table.young, table.nu))
    K = elasticity.linear_elasticity(lame, mu).assemble(basis)
    u, fixed = basis.zeros(), []
    for load in model.loads:
        nodal = basis.get_dofs(load.set_name).nodal
        for d in range(n):
            u[nodal[f"u^{d + 1}"]] = load.numbers[d]
            fixed.append(nodal[f"u^{d + 1}"])
    u = skfem.solve(*skfem.condense(K, x=u, D=np.concatenate(fixed)))
    return u[basis.nodal_dofs].T, 0.5 * float(u @ K @ u)


@pytest.mark.parametrize("n", [3, 2])
def test_the_energy_is_that_of_our_own_solver(n):
    """Measured: within 1e-15 of it."""
    model = with_one_ratio(sample_model(n, None), NU)
    ours = our_compression(model, NU)
    u, energy = pressed(model)
    assert np.abs(u - ours.u).max() < 1e-12
    assert energy == pytest.approx(ours.strain_energy, rel=1e-12)
    assert energy > 1.0


def test_in_other_axes_and_units_it_is_the_same_thing():
    """Each material with its own ratio; 1 mJ is 1000 uJ."""
    model = sample_model()
    u, energy = pressed(model)
    turned, other = pressed(in_units(in_space(model, "lps"), "MPa"))
    assert np.abs(turned * [-1.0, -1.0, 1.0] - u).max() < 1e-12
    assert 1e3 * other == pytest.approx(energy, rel=1e-12)
