"""Our MFEM files pressed by MFEM itself: sets by name, moduli by attribute, and the energy of
our own solver.
"""

import numpy as np
import pytest
from models import sample_model, with_one_ratio
from numpy.testing import assert_allclose

from tetopt.fem.elasticity import lame_constants
from tetopt.fem.solution import solve
from tetopt.io.mfem import mfem

ser = pytest.importorskip("mfem.ser", reason="no PyMFEM (pip install mfem)")

NU = 0.4


def pressed(path, model, is_turned):
    """Displacement (N, n) and strain energy by MFEM, of the mesh in a file with the constants
    and loads of a model.
    """
    mesh = ser.Mesh(str(path), 1, int(is_turned))
    n = mesh.Dimension()
    space = ser.FiniteElementSpace(
        mesh, ser.H1_FECollection(model.order, n), n, ser.Ordering.byVDIM
    )
    lame, mu = ser.Vector(mesh.attributes.Max()), ser.Vector(mesh.attributes.Max())
    for k, constants in enumerate(np.transpose(lame_constants(model.materials.young, NU, n)), 1):
        for attribute in mesh.attribute_sets.GetAttributeSet(f"material_{k}").ToList():
            lame[attribute - 1], mu[attribute - 1] = constants.tolist()
    lame_of, mu_of = ser.PWConstCoefficient(lame), ser.PWConstCoefficient(mu)
    # the first loses its prescribed rows and columns
    form, whole = ser.BilinearForm(space), ser.BilinearForm(space)
    for each in (form, whole):
        each.AddDomainIntegrator(ser.ElasticityIntegrator(lame_of, mu_of))
        each.Assemble()

    u, prescribed = ser.GridFunction(space), ser.intArray()
    u.Assign(0.0)
    for load in model.loads:
        marker = mesh.bdr_attribute_sets.GetAttributeSetMarker(load.set_name)
        u.ProjectBdrCoefficient(
            ser.VectorConstantCoefficient(ser.Vector(load.numbers.tolist())), marker
        )
        dofs = ser.intArray()
        space.GetEssentialTrueDofs(marker, dofs)
        prescribed.Append(dofs)
    force = ser.LinearForm(space)
    force.Assemble()
    K, X, B = ser.OperatorPtr(), ser.Vector(), ser.Vector()
    form.FormLinearSystem(prescribed, u, force, K, X, B)
    matrix = ser.OperatorHandle2SparseMatrix(K)
    ser.PCG(matrix, ser.GSSmoother(matrix), B, X, 0, 2000, 1e-24, 0.0)  # of the residual's square
    form.RecoverFEMSolution(X, force, u)
    return u.GetDataArray().reshape(-1, n).copy(), 0.5 * whole.InnerProduct(u, u)


@pytest.mark.parametrize("is_turned", [False, True], ids=["as it is", "turned for refinement"])
def test_the_energy_is_that_of_our_own_solver(n, order, is_turned, tmp_path):
    model = with_one_ratio(sample_model(n), NU)._replace(order=order)
    path = tmp_path / "model.mfem"
    path.write_bytes(mfem(model))
    u, energy = pressed(path, model, is_turned)
    ours = solve(model)
    n_corners = len(model.mesh.points)  # MFEM has its own order of edges
    assert_allclose(u[:n_corners], ours.u[:n_corners], rtol=0, atol=1e-10)
    assert len(u) == len(ours.u)
    assert energy == pytest.approx(ours.strain_energy, rel=1e-10)
