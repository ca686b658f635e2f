"""CalculiX runs what `tetopt.io.abaqus` writes, and finds what our own elements find."""

import re
import shutil
import subprocess
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from models import (
    LOAD_CASES,
    cell_energies,
    fibre_model,
    loaded_model,
    pulled_cube,
    sample_model,
    young_of,
)
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt import Mesh
from tetopt.fem.solution import solve
from tetopt.geometry.quadratic import quadratic, quadratic_facet_nodes
from tetopt.geometry.simplex import volumes
from tetopt.io.abaqus import abaqus
from tetopt.model.loads import parse_loads
from tetopt.model.materials import bin_moduli, materials
from tetopt.model.model import Model, in_space, in_units
from tetopt.model.sets import box_of, facet_triples, nodes_of, standard_sets, with_requested

CCX = shutil.which("ccx")
pytestmark = pytest.mark.skipif(
    CCX is None, reason="no CalculiX: ccx is not on the PATH (apt install calculix-ccx)"
)

NU = 0.45
PRINTED = 6e-7  # half a unit of the seventh digit, which is the last that CalculiX prints, at most
LOADS = {"compression": ["compress:5%"], "shear": ["hold:superior", "move:inferior:1.7,-0.9,2.3"]}


class Answer(NamedTuple):
    """What CalculiX printed."""

    # by quantity and set: rows of item and values; of sums, one row
    tables: dict[tuple[str, str], np.ndarray]
    u: np.ndarray  # (N, 3) of the .frd file
    output: str


def answer(raw, folder):
    """Runs CalculiX on an input file; any error or warning that it prints fails the test."""
    (folder / "job.inp").write_bytes(raw)
    run = subprocess.run(
        [CCX, "job"], cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )
    output = run.stdout + run.stderr
    assert run.returncode == 0, output
    assert "Job finished" in output, output
    assert not re.search("error|warning", output, re.IGNORECASE), output
    return Answer(
        tables((folder / "job.dat").read_text()),
        displacements((folder / "job.frd").read_text()),
        output,
    )


def tables(text):
    """The blocks of a .dat file; of several steps with the same requests, the last."""
    blocks = {}
    for part in re.split(r"\n(?= [a-z])", text)[1:]:
        head, _, body = part.partition("\n")
        quantity, name = re.match(r" (.*?) (?:\(.*\) )?for set (\S+)", head).groups()
        blocks[quantity, name.lower()] = np.array(
            [line.split() for line in body.split("\n") if line], dtype=float
        )
    return blocks


def displacements(text):
    """Node lines of the block DISP of an .frd file: -1, node, three numbers, in fixed columns."""
    block = text[text.rindex("DISP ") :]
    lines = [line for line in block[: block.index("\n -3")].splitlines() if line.startswith(" -1")]
    return np.array([[float(line[k : k + 12]) for k in (13, 25, 37)] for line in lines])


@cache
def pressed_model(loading="compression"):
    """Two stiff spheres in a soft block: some hundred nodes, 16 materials of one ratio."""
    image = tetopt.load_phantom("two_spheres").image(voxel_mm=4.0)
    mesh = tetopt.lattice_mesh(image, nodes=400)
    fields = tetopt.cell_fields(mesh, image)
    sets = standard_sets(mesh, box_of(image), (fields["mean"] > 15.0).astype(np.int64))
    sets = with_requested(
        mesh, sets, ["dark-cells=below:20", "Patch=point:40,0,0:15"], fields["mean"]
    )
    table = bin_moduli(
        materials(0.5 + fields["mean"] / 7.0, NU, len(mesh.cells)),
        volumes(mesh.points, mesh.cells),
        16,
    )
    return Model(
        mesh,
        fields,
        sets,
        table,
        parse_loads(LOADS[loading], mesh, sets),
        about={"image": "two spheres & ü"},
    )


def energy(printed):
    return float(printed.tables["total internal energy", "all_cells"].squeeze())


def assert_printed(values, expected, digits=PRINTED):
    """Equal as far as printed: relative to the largest."""
    assert_allclose(values, expected, rtol=0.0, atol=digits * np.abs(expected).max())


@pytest.mark.parametrize("loading", [*LOADS, "a material for each cell"])
def test_energy_displacement_and_reactions_are_our_own(loading, tmp_path):
    """All of a model's moduli and ratios reach their cells."""
    model = pressed_model(loading) if loading in LOADS else sample_model(bins=None)
    printed, own, table = answer(abaqus(model), tmp_path), solve(model), model.materials
    force = (own.system.K @ own.u.ravel()).reshape(-1, 3)
    assert_allclose(energy(printed), own.strain_energy, rtol=PRINTED)
    assert_printed(printed.u, own.u, 6e-6)  # .frd has a digit less
    by_cell = printed.tables["internal energy", "all_cells"]
    assert_array_equal(by_cell[:, 0], np.arange(1, len(model.mesh.cells) + 1))
    energies = cell_energies(model.mesh, young_of(model), table.nu[table.of_cell], own.u)
    assert_printed(by_cell[:, 1], energies)
    for name in ("superior", "inferior"):
        nodes = nodes_of(model.mesh, model.sets.facets[name])
        assert_array_equal(printed.tables["forces", name][:, 0], nodes + 1)
        assert_printed(printed.tables["forces", name][:, 1:], force[nodes])
        assert_printed(printed.tables["total force", name].ravel(), force[nodes].sum(axis=0))


@pytest.mark.parametrize(
    ("model", "units", "space", "energy_unit", "length"),
    [
        (lambda: pressed_model("shear"), "Pa", "ras", 1e6, np.ones(3) * 1e3),  # uJ in a J
        (
            lambda: loaded_model("all", order=2, moduli="nodes"),
            "MPa",
            "lps",
            1e3,
            np.array([-1.0, -1.0, 1.0]),
        ),
    ],
)
def test_units_and_axes_are_those_of_the_file(model, units, space, energy_unit, length, tmp_path):
    printed = answer(abaqus(in_units(in_space(model(), space), units)), tmp_path)
    own = solve(model())
    assert_allclose(energy_unit * energy(printed), own.strain_energy, rtol=2.0 * PRINTED)
    assert_printed(printed.u * length, own.u, 1e-5)


def test_every_set_arrives(order, tmp_path):
    """Asked for by name, CalculiX lists the members of node and element sets, though surfaces
    share their names.
    """
    model = pressed_model()._replace(order=order)
    cells = quadratic(model.mesh.points, model.mesh.cells)[1] if order == 2 else model.mesh.cells
    requests = [f"*NODE PRINT, NSET={name}\nU\n" for name in model.sets.facets]
    requests += [f"*EL PRINT, ELSET={name}\nELSE\n" for name in model.sets.cells]
    raw = abaqus(model).replace(b"*END STEP", "".join([*requests, "*END STEP"]).encode())
    printed = answer(raw, tmp_path).tables
    for name, rows in model.sets.facets.items():
        nodes = np.unique((quadratic_facet_nodes if order == 2 else facet_triples)(cells, rows))
        assert_array_equal(printed["displacements", name.lower()][:, 0], nodes + 1)
    for name, members in model.sets.cells.items():
        assert_array_equal(printed["internal energy", name.lower()][:, 0], members + 1)


def test_pressure_on_each_surface_pushes_its_facets_inwards(tmp_path):
    """Of 1 kPa on a facet, each of its nodes takes a third; nodes on a held side also bear what
    holds them.
    """
    model = pressed_model()
    mesh, every = model.mesh, f"*NSET, NSET=every, GENERATE\n1, {len(model.mesh.points)}\n"
    for name, rows in model.sets.facets.items():
        side = "superior" if name == "inferior" else "inferior"
        step = f"*STEP\n*STATIC\n*BOUNDARY\n{side}, 1, 3\n*DSLOAD\n{name}, P, 1.0\n"
        requests = "*NODE FILE\nU\n*NODE PRINT, NSET=every\nRF\n*END STEP\n"
        raw = abaqus(model._replace(loads=())) + f"{every}{step}{requests}".encode()
        printed = answer(raw, tmp_path).tables["forces", "every"][:, 1:]
        triples = facet_triples(mesh.cells, rows)
        a, b, c = np.moveaxis(mesh.points[triples], 1, 0)
        expected = np.zeros_like(mesh.points)
        np.add.at(expected, triples, -np.cross(b - a, c - a)[:, None] / 6.0)
        is_free = ~np.isin(np.arange(len(expected)), nodes_of(mesh, model.sets.facets[side]))
        assert np.abs(expected[is_free]).max() > 1.0
        assert_printed(printed[is_free], expected[is_free], 1e-5)


def test_numbers_of_full_length_arrive(tmp_path):
    """A mesh near 0, where 17 digits and an exponent would be cut off: as stiff as it is without
    rounding.
    """
    model = pressed_model()
    shrunk = Mesh(model.mesh.points * (np.pi * 1e-6), model.mesh.cells)
    assert max(len(repr(x)) for x in shrunk.points.ravel().tolist()) > 20
    loads = tuple(load._replace(numbers=load.numbers * (np.pi * 1e-6)) for load in model.loads)
    small = model._replace(mesh=shrunk, loads=loads)
    assert_allclose(
        energy(answer(abaqus(small), tmp_path)), solve(small).strain_energy, rtol=PRINTED
    )


# Every kind of load, both orders, moduli of cells and moduli that vary within them


@pytest.mark.parametrize("moduli", ["cells", "nodes"])
@pytest.mark.parametrize("case", LOAD_CASES)
def test_each_load_is_what_fem_makes_of_it(case, order, moduli, tmp_path):
    model = loaded_model(case, order=order, moduli=moduli)
    printed, own = answer(abaqus(model), tmp_path), solve(model)
    assert_allclose(energy(printed), own.strain_energy, rtol=PRINTED)
    assert own.strain_energy > 1.0
    assert_printed(printed.u, own.u, 6e-6)
    # what CalculiX prints leaves out what acts on the held nodes themselves
    if case in ("gravity", "all"):
        return
    for name in {load.set_name for load in model.loads if load.kind == "displacement"}:
        total = printed.tables["total force", name].ravel()
        assert_allclose(
            total, own.reactions[name], rtol=0.0, atol=1e-5 * np.abs(own.reactions[name]).max()
        )


STEPS = [
    *("hold:superior", "spring:anterior:0.05", "1/pressure:inferior:0.3", "1/gravity:0,0,-9810"),
    *("2/traction:inferior:0.1,-0.2,0.25", "3/move:inferior:1,free,0.5", "3/pressure:anterior:0.2"),
    *("4/gravity:1000,0,0", "5/pressure:left:0.1"),
]


def test_each_step_is_a_case_of_its_own(order, tmp_path):
    """Nothing of a step is left in the next: pressures, forces, weights and displacements come
    and go.
    """
    model = loaded_model(STEPS, order=order)
    answer(abaqus(model), tmp_path)
    totals = re.findall(
        r"total internal energy.*\n\s*\n\s*(\S+)", (tmp_path / "job.dat").read_text()
    )
    blocks = (tmp_path / "job.frd").read_text().split(" DISP ")[1:]
    assert len(totals) == len(blocks) == 5
    for step, (total, block) in enumerate(zip(totals, blocks, strict=True), 1):
        own = solve(model, step)
        assert_allclose(float(total), own.strain_energy, rtol=PRINTED)
        assert_printed(displacements(f" DISP {block}"), own.u, 6e-6)


def test_a_model_that_only_holds_rests(tmp_path):
    """The step is there for loads of the user's own."""
    printed = answer(abaqus(loaded_model(["hold:superior"])), tmp_path)
    assert energy(printed) == 0.0
    assert not printed.u.any()


# Fibres


def test_a_cube_of_turned_fibres_has_the_strain_of_the_closed_form(order, tmp_path):
    cube = pulled_cube(order)
    held = [f"{node + 1}, {dof + 1}\n" for node, dof in np.argwhere(cube.is_held)]
    pulls = [f"{i + 1}, {j + 1}, {cube.forces[i, j]:.13g}\n" for i, j in np.argwhere(cube.forces)]
    step = ["*STEP\n*STATIC\n*BOUNDARY\n", *held, "*CLOAD\n", *pulls]
    every = f"*NSET, NSET=every, GENERATE\n1, {len(cube.u)}\n"
    requests = "*NODE FILE\nU\n*NODE PRINT, NSET=every\nU\n*END STEP\n"
    raw = abaqus(cube.model) + "".join([every, *step, requests]).encode()
    printed = answer(raw, tmp_path).tables["displacements", "every"][:, 1:]
    assert_printed(printed, cube.u, 1e-6)


@pytest.mark.parametrize("bins", [None, 8])
def test_fibres_of_each_cell_are_those_of_fem(bins, order, tmp_path):
    """Beside cells without a direction; and by groups of directions."""
    model = fibre_model(bins)._replace(order=order)
    printed, own = answer(abaqus(model), tmp_path), solve(model)
    assert_allclose(energy(printed), own.strain_energy, rtol=PRINTED)
    assert_printed(printed.u, own.u, 6e-6)


# Large deformation


@pytest.mark.parametrize("moduli", ["cells", "nodes"])
@pytest.mark.parametrize("kind", ["compress", "pressure"])
def test_large_deformation_begins_as_the_linear_step(kind, order, moduli, tmp_path):
    """A hundredth of the load: the same within a few per cent of that hundredth; the whole of it
    runs, and differs.
    """
    energies = []
    for fraction in (0.01, 1.0):
        pressed = ["hold:superior", f"pressure:inferior:{0.1 * fraction}"]
        words = {"compress": [f"compress:{20.0 * fraction}%"], "pressure": pressed}
        model = loaded_model(words[kind], order=order, moduli=moduli)
        printed = answer(abaqus(model._replace(is_nonlinear=True)), tmp_path)
        energies.append(energy(printed) / solve(model).strain_energy)
    assert abs(energies[0] - 1.0) < 0.01
    assert abs(energies[1] - 1.0) > 5.0 * abs(energies[0] - 1.0)
