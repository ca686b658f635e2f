"""Files of order 2 pressed by others as they read them: dolfinx (XDMF), scikit-fem through meshio
(VTU, gmsh).

MFEM is in `test_pymfem`, CalculiX in `test_calculix`.
"""

import subprocess

import numpy as np
import pytest
from models import quadratic_model, with_one_ratio, with_two_sides
from numpy.testing import assert_allclose
from scipy.spatial import KDTree
from test_dolfinx import BEFORE, environment, python_with_dolfinx, same_rows, snippet

from tetopt.fem.solution import solve
from tetopt.geometry.quadratic import quadratic
from tetopt.io.formats import save_model
from tetopt.io.meshes import load_mesh
from tetopt.model.sets import facet_triples

NU = 0.4

# Each set's facets as the places of their corners, and the strain energy, of elements of the mesh's
# own order.
DOLFINX = """
import json

import ufl
from dolfinx.io import VTKFile
from dolfinx.fem.petsc import LinearProblem

corners = mesh.topology.connectivity(dim, 0).array.reshape(-1, dim + 1)
nodes = getattr(mesh.geometry.dofmap, "array", mesh.geometry.dofmap).reshape(len(corners), -1)
original_node = np.array(mesh.geometry.input_global_indices)
original_cell = mesh.topology.original_cell_index
node_of_vertex = np.empty(corners.max() + 1, dtype=int)
node_of_vertex[corners] = original_node[nodes[:, : dim + 1]]
vertices = mesh.topology.connectivity(dim - 1, 0).array.reshape(-1, dim)
points, cells = np.empty_like(mesh.geometry.x[:, :dim]), np.empty(nodes.shape, dtype=int)
points[original_node], cells[original_cell] = mesh.geometry.x[:, :dim], original_node[nodes]
read = {"points": points, "cells": cells}
for each in root.findall(".//Grid[@Name='facets']/Information"):
    name = each.get("Name")
    read["facets " + name] = node_of_vertex[vertices[members(facet_tags, "facets", name)]]
for each in root.findall(".//Grid[@Name='cells']/Information"):
    name = each.get("Name")
    read["cells " + name] = np.array(original_cell)[members(cell_tags, "cells", name)]

vector = ("Lagrange", 2, (dim,))
if hasattr(ufl, "VectorElement"):
    vector = ufl.VectorElement("Lagrange", mesh.ufl_cell(), 2)
V = fem.functionspace(mesh, vector)
bcs = []
for name, numbers in json.load(open("loads.json")).items():
    dofs = fem.locate_dofs_topological(V, dim - 1, members(facet_tags, "facets", name))
    bcs.append(fem.dirichletbc(np.array(numbers, dtype=float), dofs, V))
lame = young * nu / ((1 + nu) * (1 - 2 * nu) if dim == 3 else 1 - nu**2)  # plane stress in 2-D
mu = young / (2 * (1 + nu))
dx = ufl.dx(metadata={"quadrature_degree": 2})

def product(u, v):
    strain = ufl.sym(ufl.grad(u))
    stress = lame * ufl.tr(strain) * ufl.Identity(dim) + 2 * mu * strain
    return ufl.inner(stress, ufl.sym(ufl.grad(v))) * dx

u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
nothing = ufl.inner(fem.Constant(mesh, np.zeros(dim)), v) * dx
options = {"ksp_type": "preonly", "pc_type": "lu"}
u = LinearProblem(product(u, v), nothing, bcs, petsc_options=options).solve()
read["energy"] = fem.assemble_scalar(fem.form(0.5 * product(u, u)))
np.savez("read.npz", **read)
u.name = "displacement"
with VTKFile(MPI.COMM_WORLD, "pressed.pvd", "w") as file:
    file.write_function([u])
"""


def pressed_model(n):
    """A model of one ratio and order 2, with an interface that two sets hold from either side."""
    model = with_two_sides(with_one_ratio(quadratic_model(n, None), NU))
    return model._replace(point_data={"warmth": model.point_data["warmth"]})


def test_dolfinx(n, tmp_path):
    """Nodes to the last bit, sets by name, and the energy: measured within 4e-14 of ours. Its
    own file is read, too.
    """
    python, model = python_with_dolfinx(), pressed_model(n)
    save_model(tmp_path / "model.xdmf", model)
    loads = {load.set_name: load.numbers.tolist() for load in model.loads}
    tmp_path.joinpath("loads.json").write_text(str(loads).replace("'", '"'))
    program = snippet().replace('"superior"', f'"{model.loads[0].set_name}"')
    tmp_path.joinpath("read.py").write_text(BEFORE + program + DOLFINX)
    done = subprocess.run(
        [python, "read.py"], cwd=tmp_path, env=environment(), capture_output=True, text=True
    )
    if "CompileError" in done.stderr:
        pytest.skip("dolfinx finds no C compiler for its forms")
    assert done.returncode == 0, done.stderr
    points, cells = quadratic(model.mesh.points, model.mesh.cells)
    with np.load(tmp_path / "read.npz") as read:
        assert np.array_equal(read["points"], points)
        assert np.array_equal(np.sort(read["cells"], axis=1), np.sort(cells, axis=1))
        for name, rows in model.sets.facets.items():
            assert same_rows(read[f"facets {name}"], facet_triples(model.mesh.cells, rows)), name
        for name, members in model.sets.cells.items():
            assert np.array_equal(np.sort(read[f"cells {name}"]), members), name
        ours = solve(model)
        assert float(read["energy"]) == pytest.approx(ours.strain_energy, rel=1e-11)
    # of VTK's Lagrange cells, in dolfinx's order of nodes
    pressed = load_mesh(tmp_path / "pressed_p0_000000.vtu")
    assert (pressed.order, list(pressed.point_data)) == (2, ["displacement"])
    back = quadratic(pressed.mesh.points, pressed.mesh.cells)[0]
    off, node = KDTree(back).query(points)
    assert off.max() < 1e-12
    assert_allclose(pressed.point_data["displacement"][node, :n], ours.u, rtol=0, atol=1e-11)


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_scikit_fem_through_meshio(n, suffix, tmp_path):
    """Its quadratic mesh of meshio's cells, sets from the file's point data: displacement and
    energy are ours.
    """
    meshio, skfem = pytest.importorskip("meshio"), pytest.importorskip("skfem")
    elasticity = pytest.importorskip("skfem.models.elasticity")
    model, path = pressed_model(n), tmp_path / f"model.{suffix}"
    save_model(path, model)
    file = meshio.read(path)
    plain = meshio.Mesh(file.points[:, :n], file.cells)
    mesh = pytest.importorskip("skfem.io").from_meshio(plain)
    assert isinstance(mesh, skfem.MeshTet2 if n == 3 else skfem.MeshTri2)
    basis = skfem.Basis(
        mesh,
        skfem.ElementVector(skfem.ElementTetP2() if n == 3 else skfem.ElementTriP2()),
        intorder=2,
    )
    on_cells = basis.with_element(skfem.ElementTetP0() if n == 3 else skfem.ElementTriP0())
    law = elasticity.lame_parameters if n == 3 else elasticity.plane_stress
    moduli = law(file.cell_data["young"][0].astype(float).ravel(), NU)
    K = elasticity.linear_elasticity(
        *(np.asarray(on_cells.interpolate(each)) for each in moduli)
    ).assemble(basis)
    ours = solve(model)
    u, prescribed, of_node = basis.zeros(), [], []
    for d, dofs in enumerate(
        np.hstack([basis.nodal_dofs, basis.edge_dofs if n == 3 else basis.facet_dofs])
    ):
        off, node = KDTree(file.points[:, :n]).query(basis.doflocs[:, dofs].T)
        assert off.max() < 1e-12
        of_node.append(dofs[np.argsort(node)])
        for load in model.loads:
            on_set = dofs[file.point_data[f"on_{load.set_name}"][node].ravel() == 1]
            u[on_set] = load.numbers[d]
            prescribed.append(on_set)
    u = skfem.solve(*skfem.condense(K, x=u, D=np.concatenate(prescribed)))
    assert 0.5 * float(u @ K @ u) == pytest.approx(ours.strain_energy, rel=1e-11)
    assert_allclose(u[np.array(of_node)].T, ours.u, rtol=0, atol=1e-11)
