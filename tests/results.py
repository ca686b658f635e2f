"""What CalculiX solved for the result files in tests/io/frd: a small model of either order, and
its steps.
"""

from functools import cache
from pathlib import Path

import numpy as np
from meshes import FIVE_TET_CUBE
from models import sample_image

import tetopt
from tetopt import Mesh
from tetopt.fem.solution import solve as tetopt_solution
from tetopt.io.abaqus import abaqus
from tetopt.model.build import build_model
from tetopt.model.model import in_space, in_units

NU = 0.3
FOLDER = Path(__file__).parent / "io" / "frd"
# By order: units and axes of the input file, and what moves "superior" in each step, mm, RAS+.
CASES = {
    1: ("kPa", "ras", ([1.7, -0.9, 2.3], [0.0, 0.4, -0.8])),
    2: ("MPa", "lps", ([0.6, 0.2, -1.1],)),
}


@cache
def solved_model(order):
    """An oblique lattice of 14 nodes, or a box of five quadratic cells; a modulus each cell, the
    bottom held.
    """
    mesh = tetopt.lattice_mesh(sample_image(), nodes=14)
    if order == 2:
        points, cells = FIVE_TET_CUBE
        mesh = Mesh(points * [20.0, 25.0, 31.0] + [-31.7, 12.3, 101.1], cells)
    young = 1.0 + np.arange(len(mesh.cells)) % 5
    moves = [
        f"{k}/move:superior:{','.join(map(str, u))}" for k, u in enumerate(CASES[order][2], start=1)
    ]
    return build_model(mesh, young=young, nu=NU, loads=["hold:inferior", *moves], order=order)


def input_file(order):
    """The bytes that CalculiX reads."""
    units, space, _ = CASES[order]
    return abaqus(in_units(in_space(solved_model(order), space), units))


@cache
def our_displacement(order, step):
    """At the nodes of the order, by our own elements."""
    return tetopt_solution(solved_model(order), step).u
