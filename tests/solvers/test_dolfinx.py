"""Our XDMF files in FEniCSx: read by the program in the writer's docstring, every bit of it, and
loaded there.
"""

import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from models import (
    LOAD_CASES,
    bytes_of,
    loaded_model,
    sample_model,
    with_one_ratio,
    with_two_sides,
)
from scipy.spatial import KDTree

import tetopt.io.xdmf
from tetopt.fem.solution import solve
from tetopt.model.model import elements
from tetopt.model.sets import facet_triples

NU = 0.4

# For dolfinx before 0.7
BEFORE = """
from dolfinx import fem

if not hasattr(fem, "functionspace"):
    fem.functionspace = fem.FunctionSpace
"""

# What was read, in the file's own numbers
READ = """
connected = mesh.topology.connectivity(dim, 0).array.reshape(-1, dim + 1)
nodes = getattr(mesh.geometry.dofmap, "array", mesh.geometry.dofmap).reshape(-1, dim + 1)
original_node = np.array(mesh.geometry.input_global_indices)
node_of_vertex = np.empty(connected.max() + 1, dtype=int)
node_of_vertex[connected] = original_node[nodes]
original_cell = np.array(mesh.topology.original_cell_index)

def in_order(order, values):
    result = np.empty_like(values)
    result[order] = values
    return result

def names(grid):
    return [each.get("Name") for each in root.findall(f".//Grid[@Name='{grid}']/Information")]

facet_vertices = mesh.topology.connectivity(dim - 1, 0).array.reshape(-1, dim)
read = {
    "points": in_order(original_node, mesh.geometry.x[:, :dim]),
    "cells": in_order(original_cell, original_node[nodes]),
    "young": in_order(original_cell, young.x.array),
    "nu": in_order(original_cell, nu.x.array),
    "material": in_order(original_cell, material_tags.values[np.argsort(material_tags.indices)]),
    "order": original_cell,
}
for name in names("facets"):
    read["facets " + name] = node_of_vertex[facet_vertices[members(facet_tags, "facets", name)]]
for name in names("cells"):
    read["cells " + name] = original_cell[members(cell_tags, "cells", name)]
np.savez("read.npz", **read)
"""


def pressed_model(n):
    """A model of one ratio, with sets that overlap: the interface from both sides, and cells
    twice.
    """
    model = with_two_sides(with_one_ratio(sample_model(n, None), NU))
    cell_sets = model.sets.cells | {"bright_cells": model.sets.cells["label_1"]}
    return model._replace(sets=model.sets._replace(cells=cell_sets))


def environment():
    """Without what makes another Python import our packages."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


def python_with_dolfinx():
    """dolfinx comes by conda or with the system, seldom into a virtual environment."""
    looked = "import importlib.util, sys; sys.exit(importlib.util.find_spec('dolfinx') is None)"
    for python in (sys.executable, "/usr/bin/python3"):
        if (
            os.path.exists(python)
            and subprocess.run([python, "-c", looked], env=environment()).returncode == 0
        ):
            return python
    return pytest.skip("no Python with dolfinx (FEniCSx), as Debian's python3-dolfinx brings it")


def snippet(first="from xml.etree", then="Before 0.7"):
    """A program in the docstring."""
    text = tetopt.io.xdmf.__doc__
    return textwrap.dedent(text[text.index(f"    {first}") : text.index(f"\n{then}")])


@pytest.fixture(scope="module", params=[3, 2])
def answer(request, tmp_path_factory):
    """The model and what dolfinx made of its file."""
    folder, model = tmp_path_factory.mktemp("dolfinx"), pressed_model(request.param)
    folder.joinpath("model.xdmf").write_bytes(bytes_of("model.xdmf", model))
    program = snippet().replace('"superior"', f'"{model.loads[0].set_name}"')
    run(BEFORE + program + READ, folder)
    with np.load(folder / "read.npz") as read:
        return model, dict(read)


def run(program, folder):
    """Has dolfinx run a program in a folder."""
    folder.joinpath("run.py").write_text(program)
    done = subprocess.run(
        [python_with_dolfinx(), "run.py"],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
    )
    if "CompileError" in done.stderr:
        pytest.skip("dolfinx finds no C compiler for its forms")
    assert done.returncode == 0, done.stderr


def same_rows(triples, expected):
    """Whether two lists hold the same rows in any order, the nodes of a row too."""
    triples, expected = (np.sort(rows, axis=1) for rows in (triples, expected))
    return np.array_equal(triples[np.lexsort(triples.T)], expected[np.lexsort(expected.T)])


def test_dolfinx_reads_mesh_and_moduli_exactly_though_in_another_order(answer):
    model, read = answer
    assert np.array_equal(read["points"], model.mesh.points)
    assert np.array_equal(np.sort(read["cells"], axis=1), np.sort(model.mesh.cells, axis=1))
    assert (np.sort(read["order"]) == np.arange(len(model.mesh.cells))).all()
    assert (np.diff(read["order"]) < 0).any()  # or else nothing is said about the order
    table = model.materials
    assert np.array_equal(read["young"], table.young[table.of_cell])
    assert np.array_equal(read["nu"], table.nu[table.of_cell])
    assert np.array_equal(read["material"], table.of_cell + 1)


def test_dolfinx_finds_every_set_by_its_name(answer):
    model, read = answer
    facets = {
        name: facet_triples(model.mesh.cells, rows) for name, rows in model.sets.facets.items()
    }
    for name, triples in facets.items():
        assert same_rows(read[f"facets {name}"], triples), name
    for name, cells in model.sets.cells.items():
        assert np.array_equal(np.sort(read[f"cells {name}"]), cells), name
    assert same_rows(read["facets bright turned"], facets["interface_0_1"])


# Every kind of load: the docstring's second program applies it

LOADED = """
import ufl

order, is_nodal = {order}, {is_nodal}
if hasattr(fem, "VectorFunctionSpace"):
    V = fem.VectorFunctionSpace(mesh, ("Lagrange", order))
else:
    V = fem.functionspace(mesh, ("Lagrange", order, (dim,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
"""

AT_NODES = """
def flat(table):
    return getattr(table, "array", table).reshape(-1)

if is_nodal:
    text = root.find(".//Grid[@Name='mesh']/Attribute[@Name='young_nodes']/DataItem").text
    young = fem.Function(fem.functionspace(mesh, ("Lagrange", 1)))
    node = np.array(mesh.geometry.input_global_indices)[flat(mesh.geometry.dofmap)]
    values = np.array(text.split(), dtype=float)[node]
    young.x.array[flat(young.function_space.dofmap.list)] = values
"""

SOLVE_LOADED = """
from dolfinx.fem import petsc
from petsc4py import PETSc

lame = young * nu / ((1 + nu) * (1 - 2 * nu) if dim == 3 else 1 - nu**2)  # plane stress in 2-D
mu = young / (2 * (1 + nu))
dx = ufl.dx(degree=2 * order - 2 if order == 2 else 1)

def product(u, v):
    strain = ufl.sym(ufl.grad(u))
    stress = lame * ufl.tr(strain) * ufl.Identity(dim) + 2 * mu * strain
    return ufl.inner(stress, ufl.sym(ufl.grad(v))) * dx

def total(forms):
    nothing = ufl.inner(fem.Constant(mesh, np.zeros(dim)), v) * ufl.dx
    return petsc.assemble_vector(fem.form(sum(forms, nothing)))

stiffness, push, diagonal = fem.form(product(u, v)), total(forces), total(springs)
petsc.set_bc(diagonal, conditions, None, 0.0)
A = petsc.assemble_matrix(stiffness, conditions)
A.assemble()
A.setDiagonal(A.getDiagonal() + diagonal)
A.assemble()
petsc.apply_lifting(push, [stiffness], [conditions])
petsc.set_bc(push, conditions)
solver = PETSc.KSP().create(mesh.comm)
solver.setOperators(A)
solver.setType("preonly")
solver.getPC().setType("lu")
solution = fem.Function(V)
solver.solve(push, solution.vector if hasattr(solution, "vector") else solution.x.petsc_vec)
solution.x.scatter_forward()
energy = fem.assemble_scalar(fem.form(0.5 * product(solution, solution)))
np.savez("solved.npz", energy=energy, places=V.tabulate_dof_coordinates()[:, :dim],
         u=solution.x.array.reshape(-1, dim))
"""

CASES = [
    *((case, 3, order, "cells") for case in LOAD_CASES for order in (1, 2)),
    *(("all", n, order, moduli) for n, moduli in ((3, "nodes"), (2, "cells")) for order in (1, 2)),
]


@pytest.fixture(scope="module")
def solved_cases(tmp_path_factory):
    """The folder of what dolfinx solved, a folder a case, all in one process."""
    folder, programs = tmp_path_factory.mktemp("loads"), []
    for number, (case, n, order, moduli) in enumerate(CASES):
        (folder / str(number)).mkdir()
        model = loaded_model(case, n, 1, moduli)
        (folder / str(number) / "model.xdmf").write_bytes(bytes_of("model.xdmf", model))
        reading = snippet().replace('"superior"', '"boundary"')
        applying = snippet("import ufl", "Moduli that are linear")
        loaded = LOADED.format(order=order, is_nodal=moduli == "nodes")
        programs.append(f"{BEFORE}{reading}{loaded}{applying}{AT_NODES}{SOLVE_LOADED}")
    each = (
        "import os\nfor number, program in enumerate({}):\n    os.chdir({!r} + "
        "str(number))\n    exec(program, {{}})\n"
    )
    run(each.format(programs, f"{folder}/"), folder)
    return folder


@pytest.mark.parametrize(
    "number", range(len(CASES)), ids=lambda number: "-".join(map(str, CASES[number]))
)
def test_each_load_is_what_fem_makes_of_it(solved_cases, number):
    """Displacements found by their places, which dolfinx orders otherwise."""
    case, n, order, moduli = CASES[number]
    own = solve(model := loaded_model(case, n, order, moduli))
    with np.load(solved_cases / str(number) / "solved.npz") as answer:
        points, _ = elements(model)
        distance, node = KDTree(points).query(answer["places"])
        assert distance.max() < 1e-9
        assert len(np.unique(node)) == len(points)
        assert np.abs(answer["u"] - own.u[node]).max() < 1e-10 * np.abs(own.u).max()
        assert float(answer["energy"]) == pytest.approx(own.strain_energy, rel=1e-10)
