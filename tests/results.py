"""What CalculiX solved for the result files in tests/io/frd: a small model of either order, and its steps."""

from functools import cache
from pathlib import Path

import numpy as np
from meshes import FIVE_TET_CUBE
from models import sample_image, young_of
from scipy.sparse.linalg import spsolve

import tetopt
from tetopt import Mesh
from tetopt.fem.elasticity import constrained
from tetopt.geometry.quadratic import quadratic, quadratic_facet_nodes
from tetopt.io.abaqus import abaqus
from tetopt.model.build import model_of
from tetopt.model.model import in_space, in_units
from tetopt.model.sets import facet_triples

NU = 0.3
FOLDER = Path(__file__).parent / "io" / "frd"
# By order: units and axes of the input file, and what moves "superior" in each step, mm, RAS+.
CASES = {
    1: ("kPa", "ras", ([1.7, -0.9, 2.3], [0.0, 0.4, -0.8])),
    2: ("MPa", "lps", ([0.6, 0.2, -1.1],)),
}


@cache
def solved_model(order):
    """An oblique lattice of 14 nodes, or a box of five quadratic cells; a modulus each cell, the bottom held."""
    mesh = tetopt.lattice(sample_image(), nodes=14)
    if order == 2:
        points, cells = FIVE_TET_CUBE
        mesh = Mesh(points * [20.0, 25.0, 31.0] + [-31.7, 12.3, 101.1], cells)
    young = 1.0 + np.arange(len(mesh.cells)) % 5
    return model_of(mesh, young=young, nu=NU, loads=["hold:inferior", move(CASES[order][2][0])], order=order)


def move(vector):
    return f"move:superior:{','.join(map(str, vector))}"


def input_file(order):
    """The bytes that CalculiX reads."""
    units, space, vectors = CASES[order]
    model = solved_model(order)
    first, *others = (
        abaqus(in_units(in_space(model._replace(loads=loads_of(model, vector)), space), units)).decode()
        for vector in vectors
    )
    steps = [text[text.index("*STEP") :].replace("*BOUNDARY", "*BOUNDARY, OP=NEW") for text in others]
    return "".join([first, *steps]).encode()


def loads_of(model, vector):
    """The model's loads with "superior" moved so."""
    return tuple(
        load._replace(numbers=np.array(vector)) if load.set_name == "superior" else load for load in model.loads
    )


def our_displacement(order, step):
    """At the nodes of the order, by our own elements."""
    model = solved_model(order)
    nodes = len(quadratic(model.mesh.points, model.mesh.cells)[0]) if order == 2 else len(model.mesh.points)
    is_given, values = np.zeros((nodes, 3), dtype=bool), np.zeros((nodes, 3))
    cells = quadratic(model.mesh.points, model.mesh.cells)[1] if order == 2 else model.mesh.cells
    for load in loads_of(model, CASES[order][2][step - 1]):
        at = np.unique(
            (quadratic_facet_nodes if order == 2 else facet_triples)(cells, model.sets.facets[load.set_name])
        )
        is_given[at], values[at] = True, load.numbers
    K = constrained(model.mesh, young_of(model), NU, is_given, values, order=order).K
    free, u = np.flatnonzero(~is_given), values.ravel()
    u[free] = spsolve(K[free][:, free].tocsc(), -(K @ u)[free])
    return u.reshape(-1, 3)
