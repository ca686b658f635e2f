"""One model for the tests of every format and solver: materials, overlapping sets, a load,
labels, an oblique box.
"""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from meshes import with_bent_edges
from scipy.sparse import diags_array
from scipy.sparse.linalg import spsolve
from shapes import grid

import tetopt
from tetopt.fem.elasticity import lame_constants, stiffness, strains
from tetopt.geometry.quadratic import cell_edges, of_order, quadratic
from tetopt.geometry.simplex import volumes
from tetopt.io.formats import file_bytes
from tetopt.model.label_names import TABLE_TEXT, LabelTable, table_words
from tetopt.model.loads import Load, facet_forces, parse_loads
from tetopt.model.materials import Along, bin_moduli, materials
from tetopt.model.model import Model, in_space, in_units
from tetopt.model.sets import (
    Sets,
    box_of,
    enclosing_facets,
    standard_sets,
    with_requested,
)

ABOUT = {"tetopt": "0.1.0", "image": "two spheres & <more>.nii.gz", "image_sha256": "ab" * 32}


def bytes_of(name, model):
    """What save_model writes, in the model's own axes and units."""
    return file_bytes(Path(name), model, space=model.space, units=model.units)


@cache
def sample_image(n=3):
    """Two values with a gradient, turned and shifted in the world."""
    shape = (9, 8, 7)[:n]
    index = grid(shape)
    ball = ((index - np.array([4, 3, 3])[:n]) ** 2).sum(axis=-1) < 6
    affine = np.eye(n + 1)
    turn = np.array([[0.96, -0.28, 0.0], [0.28, 0.96, 0.0], [0.0, 0.0, 1.0]])[:n, :n]
    affine[:n, :n] = turn * np.array([2.0, 2.5, 3.0])[:n]
    affine[:n, n] = np.array([-31.7, 12.3, 101.1])[:n]
    return tetopt.Image(50.0 * ball + index.sum(axis=-1), affine)


@cache
def ball_mesh(n=3):
    """A ball (a disk) of 40 mm around (30, 30, 30) mm: a lattice of a cube, each shell of it
    made round.
    """
    cube = tetopt.lattice_mesh(tetopt.Image(np.zeros((20,) * n)), blocks=(6,) * n)
    offset = cube.points - cube.points.mean(axis=0)
    length = np.sqrt((offset**2).sum(axis=1, keepdims=True))
    round_ = (
        offset * np.abs(offset).max(axis=1, keepdims=True) / np.where(length > 0.0, length, 1.0)
    )
    return tetopt.Mesh(30.0 + 2.0 * round_, cube.cells)


@cache
def sample_model(n=3, bins=3):
    """A model in RAS and kPa with `bins` materials (None: as many as cells have), a compression
    by 5 %.
    """
    image = sample_image(n)
    mesh = tetopt.lattice_mesh(image, nodes=60)
    fields = tetopt.cell_fields(mesh, image)
    labels = (fields["mean"] > 25.0).astype(np.int64)
    fields["label"] = labels
    sets = standard_sets(mesh, box_of(image), labels)
    corner = ",".join(str(x) for x in mesh.points[0])
    sets = with_requested(
        mesh, sets, ["dark=below:20", f"corner=point:{corner}:12"], fields["mean"]
    )
    table = materials(1.0 + fields["mean"] / 7.0, np.where(labels == 1, 0.3, 0.45), len(mesh.cells))
    if bins is not None:
        table = bin_moduli(table, volumes(mesh.points, mesh.cells), bins)
    loads = parse_loads(["compress:5%"], mesh, sets)
    return Model(mesh, fields, sets, table, loads, about=dict(ABOUT))


def unlabelled(model):
    return model._replace(
        cell_data={name: values for name, values in model.cell_data.items() if name != "label"}
    )


def labelled_model(n=3):
    """Cells of the labels 0, 2, 3 and 7 with their sets, 7 by name; a set of the user's within
    one.
    """
    model = sample_model(n)._replace(materials=None, loads=())
    height = model.mesh.points[model.mesh.cells].mean(axis=1)[:, -1]
    labels = np.array([0, 2, 3, 7])[np.searchsorted(np.quantile(height, [0.25, 0.5, 0.75]), height)]
    names = {7: "Right kidney"}
    sets = standard_sets(model.mesh, box_of(sample_image(n)), labels, names)
    return model._replace(
        cell_data=model.cell_data | {"label": labels},
        sets=sets,
        about=ABOUT | {TABLE_TEXT: table_words(LabelTable(names, {}))},
    )


@cache
def quadratic_model(n=3, bins=3):
    """The same of order 2, with point data of every node ("displacement") and of the corners
    alone ("warmth").
    """
    model, rng = sample_model(n, bins), np.random.default_rng(n)
    n_nodes = len(quadratic(model.mesh.points, model.mesh.cells)[0])
    fields = {
        "displacement": rng.normal(size=(n_nodes, n)),
        "warmth": rng.normal(size=len(model.mesh.points)),
    }
    return model._replace(order=2, point_data=fields)


def curved_model(n=3):
    """`quadratic_model` with curved edges."""
    model = quadratic_model(n)
    return model._replace(mesh=with_bent_edges(model.mesh, 0.05))


def all_nodes(values, mesh):
    """A field of the corners with the mean of an edge's ends at its middle, as the docstrings
    say it.
    """
    nodes, cells = quadratic(mesh.points, mesh.cells)
    filled = np.concatenate([values, np.empty(len(nodes) - len(values))])
    for cell in cells:
        for node, (a, b) in zip(cell[mesh.ndim + 1 :], cell_edges(mesh.ndim), strict=True):
            filled[node] = 0.5 * (values[cell[a]] + values[cell[b]])
    return filled


@cache
def fibre_model(bins=None):
    """The sample model with a direction in each cell but a few, and moduli of two labels along
    them; shear and a pull.
    """
    model, rng = sample_model(bins=bins), np.random.default_rng(5)
    mesh, labels = model.mesh, model.labels
    fibre = rng.normal(size=(len(mesh.cells), 3))
    fibre[::50] = np.nan
    stiff, shear = np.where(labels == 1, 9.0, 7.0), np.where(labels == 1, 2.5, 1.5)
    along = Along(stiff, shear, fibre)
    table = materials(np.where(labels == 1, 3.0, 2.0), 0.4, len(mesh.cells), 1000.0, along)
    if bins is not None:
        table = bin_moduli(table, volumes(mesh.points, mesh.cells), bins)
    loads = parse_loads(["hold:superior", "traction:inferior:0.02,0.05,0.04"], mesh, model.sets)
    return model._replace(materials=table, loads=loads)


def fibre_compliance(fibre, young, nu, young_along, shear_along):
    """The compliance (3, 3, 3, 3) of fibres along a vector, from engineering constants in their
    axes; of one of 0, with isotropic constants, in the world's.
    """
    E, G = (young_along, young, young), young / (2.0 * (1.0 + nu))
    S = np.zeros((3, 3, 3, 3))
    for i in range(3):
        S[i, i, i, i] = 1.0 / E[i]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        ratio = -nu / (young_along if i == 0 else young)
        S[i, i, j, j] = S[j, j, i, i] = ratio
        for a, b in ((i, j), (j, i)):
            S[a, b, a, b] = S[a, b, b, a] = 0.25 / (shear_along if i == 0 else G)
    first = fibre / np.linalg.norm(fibre) if np.any(fibre) else np.eye(3)[0]
    axes = np.vstack([first, np.linalg.svd(first[None])[2][1:]])
    return np.einsum("ia,jb,kc,ld,ijkl->abcd", axes, axes, axes, axes, S)


class PulledCube(NamedTuple):
    """A cube of one material with fibres under a uniform stress, held so that it only strains."""

    model: Model  # without loads
    is_held: np.ndarray  # (N, 3)
    forces: np.ndarray  # (N, 3) mN
    u: np.ndarray  # (N, 3) mm, in closed form
    stress: np.ndarray  # (3, 3) kPa


def pulled_cube(order, fibre=(0.6, -0.3, 0.74)):
    """A corner rests, and one along x and one along y only move away from it and in their plane."""
    side, constants = 20.0, (3.0, 0.4, 9.0, 2.5)
    affine = np.diag([side, side, side, 1.0])
    affine[:3, 3] = 0.5 * side
    image = tetopt.Image(np.zeros((1, 1, 1)), affine)
    mesh = tetopt.lattice_mesh(image, blocks=(3, 3, 3))
    sets = standard_sets(mesh, box_of(image))
    n_cells = len(mesh.cells)
    along = Along(*constants[2:], np.tile(fibre, (n_cells, 1)))
    table = materials(*constants[:2], n_cells, along=along)
    model = Model(mesh, {}, sets, table, order=order)
    stress = np.array([[0.10, 0.02, -0.03], [0.02, -0.05, 0.04], [-0.03, 0.04, 0.20]])
    points = of_order(mesh.points, mesh.cells, order)[0]
    forces = np.zeros_like(points)
    for name, axis, sign in SIDES:
        load = Load("traction", name, sign * stress[axis])
        nodes, of_face = facet_forces(mesh, sets, load, order)
        forces[nodes] += of_face
    strain = np.einsum("ijkl,kl->ij", fibre_compliance(np.array(fibre), *constants), stress)
    slope = np.triu(2.0 * strain, 1) + np.diag(np.diag(strain))
    is_held = np.zeros(points.shape, dtype=bool)
    for corner, dofs in (((0, 0, 0), 3), ((side, 0, 0), 2), ((0, side, 0), 1)):
        is_held[np.flatnonzero(np.isclose(points, corner).all(axis=1)), 3 - dofs :] = True
    return PulledCube(model, is_held, forces, points @ slope.T, stress)


SIDES = (
    *(("left", 0, -1.0), ("right", 0, 1.0), ("posterior", 1, -1.0), ("anterior", 1, 1.0)),
    *(("inferior", 2, -1.0), ("superior", 2, 1.0)),
)


def young_of(model):
    """The modulus of each cell."""
    return model.materials.young[model.materials.of_cell]


def with_one_ratio(model, nu):
    """The model with one Poisson's ratio for all cells, as `tetopt.fem` wants it."""
    return model._replace(materials=materials(young_of(model), nu, len(model.mesh.cells)))


def with_two_sides(model):
    """The model with the interface also as a set that holds it from its other side."""
    bright = enclosing_facets(model.mesh, model.sets.cells["label_1"])
    return model._replace(sets=Sets(model.sets.facets | {"bright": bright}, model.sets.cells))


# Models by what a writer has to tell of them
SAMPLES = {
    "3-D": sample_model,
    "2-D": lambda: sample_model(2),
    "as many materials as cells": lambda: sample_model(3, None),
    "as many materials as cells, 2-D": lambda: sample_model(2, None),
    "no labels": lambda: unlabelled(sample_model()),
    "two sides": lambda: with_two_sides(sample_model()),
    "two sides, 2-D": lambda: with_two_sides(sample_model(2)),
    "LPS, MPa": lambda: in_units(in_space(sample_model(), "lps"), "MPa"),
    "quadratic": lambda: with_two_sides(quadratic_model()),
    "quadratic, 2-D": lambda: with_two_sides(quadratic_model(2)),
    "curved": lambda: curved_model(),
    "curved, 2-D": lambda: curved_model(2),
    "label sets only": lambda: sample_model()._replace(
        sets=standard_sets(sample_model().mesh, labels=sample_model().cell_data["label"]), loads=()
    ),
    "bare": lambda: sample_model()._replace(
        cell_data={}, sets=Sets({}, {}), materials=None, loads=(), about={}
    ),
}


def cell_energies(mesh, young, nu, u):
    """Strain energy of each cell, uJ, from the strain and the two Lame constants."""
    strain = strains(mesh, u)
    lame, mu = lame_constants(np.broadcast_to(young, len(mesh.cells)), nu, mesh.ndim)
    spread = np.einsum("cii->c", strain) ** 2
    return volumes(mesh.points, mesh.cells) * (
        0.5 * lame * spread + mu * (strain**2).sum(axis=(1, 2))
    )


def each_once(nodes):
    """Rows of nodes without their order."""
    return sorted(map(tuple, np.sort(nodes, axis=1).tolist()))


# What a model can be loaded by, each kind alone and together; on what `sample_model` has, in 3-D
# and in 2-D.
LOAD_CASES = {
    "compression": ["compress:5%"],
    "free components": ["hold:{high}", "move:{low}:{free},1.5"],
    "pressure": ["hold:{high}", "pressure:{low}:0.3"],
    "traction": ["hold:{high}", "traction:{low}:{pull},0.25"],
    "spring": ["spring:{high}:0.2", "pressure:{low}:0.3"],
    "gravity": ["hold:{high}", "gravity:{pull},-9810"],
    "all": [
        "hold:{high}",
        "spring:{side}:0.05",
        "pressure:boundary:0.1",
        "pressure:{low}:0.1",
        "gravity:{pull},-9810",
        "traction:{low}:{pull},0.25",
        "traction:{side}:{pull},0.5",
    ],
}


def load_words(case, n=3):
    """The words of a load case."""
    names = {
        "high": "superior",
        "low": "inferior",
        "side": "left",
        "free": "free,free",
        "pull": "0.1,-0.2",
    }
    if n == 2:
        names = {"high": "y_max", "low": "y_min", "side": "x_min", "free": "free", "pull": "0.1"}
    return [words.format(**names) for words in LOAD_CASES[case]]


def loaded_model(case, n=3, order=1, moduli="cells"):
    """`sample_model` under a load case, or under other words; cells of two densities, moduli of
    cells or of nodes.
    """
    model = sample_model(n)
    table = model.materials
    density = np.where(model.cell_data["label"] == 1, 1500.0, 1000.0)
    table = materials(young_of(model), table.nu[table.of_cell], len(model.mesh.cells), density)
    words = load_words(case, n) if isinstance(case, str) else case
    loads = parse_loads(words, model.mesh, model.sets)
    nodal = (
        np.random.default_rng(7).uniform(1.0, 9.0, len(model.mesh.points))
        if moduli == "nodes"
        else None
    )
    return model._replace(materials=table, loads=loads, order=order, node_young=nodal)


def displaced(model, is_prescribed, prescribed, forces, springs):
    """Displacement (N, 3) of nodes under what a file says of them, by our matrix and a plain
    factorisation.
    """
    of_cell = model.materials.of_cell
    K = stiffness(
        model.mesh, model.materials.young[of_cell], model.materials.nu[of_cell], model.order
    )
    K = (K + diags_array(np.repeat(springs, 3))).tocsr()
    u, free = (
        np.where(is_prescribed, prescribed, 0.0).ravel(),
        np.flatnonzero(~is_prescribed.ravel()),
    )
    u[free] = spsolve(K[free][:, free], forces.ravel()[free] - (K @ u)[free])
    return u.reshape(-1, 3)
