"""`tetopt convert`, `tetopt surface`, `tetopt mesh` for solvers and from a mesh of the user's,
as a user types them.
"""

import json
import re
import sys
import tempfile
import webbrowser
from pathlib import Path

import meshio
import numpy as np
import pytest
import pyvista
import trimesh
from commands import (
    assert_done,
    assert_refuses,
    in_copy_of,
    labelled_lattice_words,
    numbers_in,
    refusals,
    run_command,
)
from models import sample_image
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt import Image, load_image, load_mesh, save_image, save_mesh
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.topology import boundary_facets, largest_component
from tetopt.io.formats import FORMATS
from tetopt.model.averages import cell_young

pytestmark = pytest.mark.full
MAPPING = "1+h/7"


here = in_copy_of("folder")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An image, its labels, a lattice of 60 nodes with both and without fields, the same of order
    2 with a displacement of every node, and the image elsewhere.
    """
    path = tmp_path_factory.mktemp("convert")
    assert_done(*labelled_lattice_words(path), f"-o {path}/mesh.vtu")
    order_2 = f"{path}/quadratic.vtu"
    words = f"{order_2} --order 2 --young {MAPPING} --load compress:5%"
    assert_done(f"convert {path}/mesh.vtu {words}")
    grid = pyvista.read(order_2)
    grid.point_data["displacement"] = np.asarray(grid.points) ** 2
    grid.save(order_2)
    mesh, image = load_mesh(order_2).mesh, sample_image(3)
    save_mesh(f"{path}/bare.vtu", mesh)
    corners = mesh.points[mesh.cells[5]]
    within = np.vstack([mesh.points, corners.mean(axis=0)])  # once more a cell, but for a node
    more = np.append(mesh.cells[5, :3], len(mesh.points))
    save_mesh(f"{path}/thrice.vtu", tetopt.Mesh(within, np.vstack([mesh.cells, more])))
    away = image.affine.copy()
    away[:3, 3] += 500.0
    save_image(f"{path}/away.nii.gz", Image(image.data, away))
    return path


def fields_in(path):
    """The fields of cells of a mesh's file."""
    return load_mesh(path).cell_data


def test_a_mesh_s_file_has_its_sets_and_its_box():
    loaded, image = load_mesh("mesh.vtu"), load_image("a.nii.gz")
    assert loaded.box.shape == image.shape
    assert_array_equal(loaded.box.affine, image.affine)
    faces = {"left", "right", "posterior", "anterior", "inferior", "superior"}
    assert set(loaded.sets.facets) == faces | {"boundary", "interface_0_1"}
    assert set(loaded.sets.cells) == {"label_0", "label_1"}
    fields = loaded.cell_data
    assert_array_equal(loaded.sets.cells["label_1"], np.flatnonzero(fields["label"] == 1))
    assert (fields["min"] <= fields["mean"] + 1e-9).all()
    assert (fields["max"] >= fields["mean"] - 1e-9).all()
    assert (fields["min"] < fields["max"]).any()


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_is_written(here, suffix):
    out, more = f"out{suffix}", f"--young {MAPPING} --bins 3 --set dark=below:20 --space lps"
    said = run_command(f"convert mesh.vtu {out} {more}").out
    assert Path(out).stat().st_size > 900
    assert f"{out}: {FORMATS[suffix].what}, LPS+ mm, kPa, " in said
    assert re.search("[346] materials", said)
    assert "modulus error" in said
    assert "dark_surface" in said
    assert here() == [out]
    assert_refuses(f"convert mesh.vtu {out}", out)  # is there already


def test_convert_keeps_the_order_unless_told_otherwise():
    mesh = load_mesh("mesh.vtu").mesh
    n_corners, n_all = len(mesh.points), len(quadratic(mesh.points, mesh.cells)[0])
    size, n_cells = {"n_nodes": n_corners}, len(mesh.cells)
    for name, order in (("a.vtu", 2), ("a.msh", 2), ("a.inp", 2), ("b.vtu", 1)):
        words = "--order 1" if order == 1 else ""
        said = run_command(f"convert quadratic.vtu {name} {words} --json a.json --force")
        size |= {"order": order, "n_nodes_in_all": n_all if order == 2 else n_corners}
        assert numbers_in("a.json")["size"] == size | {"n_cells": n_cells}
        said = " ".join("".join(said).split())
        words = f"{n_corners} corner nodes, {n_all} in all, {n_cells} cells"
        assert (words in said) == (order == 2)
        assert "has no quadratic cells" not in said
    assert_array_equal(load_mesh("b.vtu").point_data["displacement"], mesh.points**2)


def test_forces_that_hold_sets_go_on_with_the_results_in_their_own_axes_and_units():
    grid, text = pyvista.read("quadratic.vtu"), json.dumps({"left": [1.5, 0.0, -2.0]})
    for name in ("reactions", "reactions_step2", "reactions of mine"):
        grid.field_data[name] = np.frombuffer(text.encode(), dtype=np.uint8)
    grid.save("a.vtu")
    for options, kept in (("", text), ("--units MPa", None)):
        assert_done(f"convert a.vtu b.vtu --force {options}")
        loaded = load_mesh("b.vtu")
        assert loaded.text("reactions") == loaded.text("reactions_step2") == kept
        assert loaded.text("reactions of mine") is None


def test_commands_take_a_quadratic_mesh():
    """Each says of it what it says of the corners' mesh."""
    mesh = load_mesh("mesh.vtu").mesh
    n_corners, n_all = len(mesh.points), len(quadratic(mesh.points, mesh.cells)[0])
    numbers, improved = [], []
    for name, words in (("mesh", n_corners), ("quadratic", rf"{n_all} \({n_corners} corners\)")):
        check = f"quality {name}.vtu --image a.nii.gz --check --json {name}.json"
        assert re.search(rf"^nodes +{words}\ncells", run_command(check).out, re.MULTILINE)
        assert_done(f"segment a.nii.gz {name}.vtu -o {name}.nii.gz --classes 2")
        assert_done(f"surface {name}.vtu --label 1 -o {name}.stl")
        assert_done(f"view {name}.vtu --html {name}.html")
        more = f"--start {name}.vtu --iterations 1 -o {name}.msh --json {name}_improved.json"
        assert_done(f"mesh a.nii.gz {more}")
        numbers.append(numbers_in(f"{name}.json"))
        improved.append(numbers_in(f"{name}_improved.json"))
    for key in ("quality", "fit"):
        assert numbers[0][key] == numbers[1][key]
    assert [each["size"]["n_nodes_in_all"] for each in numbers] == [n_corners, n_all]
    assert improved[0]["mesh_sha256"] == improved[1]["mesh_sha256"]
    assert improved[1]["size"]["order"] == 2  # as the mesh read
    for name in ("nii.gz", "stl"):
        assert Path(f"mesh.{name}").stat().st_size == Path(f"quadratic.{name}").stat().st_size


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".msh2"])
def test_a_mesh_in_metres_is_read_in_millimetres(suffix):
    path = f"a{suffix}"
    assert_done(f"convert mesh.vtu {path} --units Pa")
    metres = meshio.gmsh.read(path) if suffix == ".msh2" else meshio.read(path)
    back, first = load_mesh(path), load_mesh("mesh.vtu")
    assert_allclose(metres.points, first.mesh.points / 1000.0, rtol=1e-14, atol=1e-17)
    assert_allclose(back.mesh.points, first.mesh.points, rtol=1e-14, atol=1e-14)
    if "volume" in back.cell_data:
        assert_allclose(back.cell_data["volume"], first.cell_data["volume"], rtol=1e-13)


@pytest.mark.parametrize(
    ("name", "options", "kept"),
    [
        ("a.msh", "", ["label"]),
        ("a.msh", "--fields mean", ["label", "mean"]),
        ("a.vtu", "--fields none", ["label"]),
        ("a.msh", "--fields all", None),
        ("a.vtu", "", None),
    ],
)
def test_fields_of_cells_are_written_as_asked(name, options, kept):
    said = run_command(f"convert mesh.vtu {name} {options}").err
    assert sorted(fields_in(name)) == sorted(kept or fields_in("mesh.vtu"))
    assert ("8 fields of cells are not written" in said) == (name == "a.msh" and not options)


def test_materials_sets_and_loads_are_those_of_python():
    """In tests/io/test_writers.py all of the model is in the file, and is read from it."""
    words = f"--young {MAPPING} --nu 0=0.45,1=0.3 --load compress:5% --set dark=below:20"
    words = words.replace(MAPPING, f'"{MAPPING} kPa"')
    assert_done(f"convert mesh.vtu b.inp {words} --json b.json --units MPa --space lps")
    about = {"young": MAPPING, "nu": "0=0.45,1=0.3", "loads": ["compress:5%"]}
    model = tetopt.build_model(
        load_mesh("mesh.vtu"),
        **about,
        sets=["dark=below:20"],
        about={"tetopt": tetopt.__version__},
    )
    tetopt.save_model("ours.inp", model, units="MPa", space="lps")
    assert Path("b.inp").read_text() == Path("ours.inp").read_text()
    numbers = numbers_in("b.json")
    assert numbers["materials"]["count"] == len(model.materials.young)
    assert numbers["sets"]["cells"]["dark"] == len(model.sets.cells["dark"])
    assert numbers["loads"][0] == "hold:superior"


@pytest.mark.parametrize(("words", "average"), [("", "geometric"), ("--average mean", "mean")])
def test_an_image_gives_an_average_of_the_mapping(words, average):
    """Of a curved mapping; the geometric one unless another is asked for."""
    assert_done(f"convert mesh.vtu a.vtu --young 1+h**2 --image a.nii.gz {words}")
    loaded, image = load_mesh("a.vtu"), load_image("a.nii.gz")
    expected = cell_young(image, loaded.mesh, lambda h: 1.0 + h**2, average)
    assert_allclose(loaded.cell_data["young"], expected, rtol=1e-12)


def test_a_file_has_one_modulus_a_cell_of_those_at_gauss_points():
    for average in ("geometric", "gauss"):
        options = f"--young {MAPPING} --average {average} --image a.nii.gz --order 2"
        first = run_command(f"convert mesh.vtu {average}.vtu {options}").out
        second = run_command(f"convert {average}.vtu {average}.inp").out
        is_told = ("one modulus per cell, its geometric mean" in first, "Gauss point" in second)
        assert is_told == 2 * (average == "gauss",)
    assert_array_equal(fields_in("geometric.vtu")["young"], fields_in("gauss.vtu")["young"])


def test_results_of_other_moduli_or_loads_are_left_out():
    assert_done("convert mesh.vtu a.vtu --young 2 --load compress:5%")
    assert_done("fem a.vtu -o solved.vtu")
    fields = {"displacement", "von_mises", "stress_nodes"}
    words = (
        "dropped results computed with other moduli or loads: strain, stress, von_mises, "
        "displacement,"
    )
    for options in ("", "--young 3", "--load compress:4%"):
        said = run_command(f"convert solved.vtu b.vtu --force {options}").err
        loaded = load_mesh("b.vtu")
        assert (words in said) == bool(options)
        kept = fields & {*loaded.cell_data, *loaded.point_data}
        assert kept == (set() if options else fields)
        assert ("reactions" in loaded.field_data) == (not options)
    said = run_command("mesh a.nii.gz --start solved.vtu -o c.vtu --iterations 1").err
    assert "moduli, loads and results of the input mesh are not kept" in said
    assert not fields & {*load_mesh("c.vtu").point_data}


def test_the_error_of_bins_goes_on():
    said = run_command(f"convert mesh.vtu a.vtu --young {MAPPING} --bins 3").out
    (line,) = re.findall("^bins: modulus error.*\n", said, re.MULTILINE)
    for source, out in (("a.vtu", "b.vtu"), ("b.vtu", "b.inp")):
        assert line in run_command(f"convert {source} {out} --json {out}.json").out
        assert numbers_in(f"{out}.json")["materials"]["binning"]["mean"] > 0.0
    assert "modulus error" not in run_command("convert b.vtu c.vtu --young 2").out


def test_what_formats_do_not_hold_as_it_is_is_said():
    """Loads that no reader of gmsh's brings back, label 0, groups that are not complete, numbers
    of no label.
    """
    Path("names.csv").write_text("label,name\n1,liver\n")
    group, short = (
        "label 0 is physical group 2",
        "facets of smaller sets are missing from boundary",
    )
    for suffix, expected in {
        ".msh": {group},
        ".msh2": {group, short},
        ".mfem": {"label 0 is attribute 2"},
        ".mesh": {"label 0 is reference 2"},
        ".vtu": set(),
    }.items():
        convert = f"convert mesh.vtu a{suffix} --force"
        plain = run_command(convert).out
        every = expected | {group, short, "not read back", "2001"}
        assert {words for words in every if words in plain} == expected
        words = f"{convert} --young 2 --load compress:5% --label-names names.csv"
        said = f"loads in {suffix} files are not read back" in run_command(words).out
        assert said == (".msh" in suffix)
        if suffix in (".mfem", ".mesh"):
            said = run_command(f"{convert} --young {MAPPING}").out
            assert "number from 2001 on (label_1, label_0)" in " ".join(said.split())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--young 3500", "young is 3500 to 3500 kPa, stiffer than soft tissue"),
        ("--young 0.003", "young is at most 0.003 kPa, softer than any tissue"),
        ("--young 3 --density 1.06", "density is at most 1.06 kg/m3 (water: 1000)"),
        ("--young 3 --density 1060 --load gravity:0,0,-9.81", "gravity is 9.81 mm/s2"),
        ("--young 0=17e6,1=1e5 --density 1=1000,0=1.2 --load gravity:0,0,-9810", None),
    ],
)
def test_quantities_in_other_units_are_said(options, said):
    commands = ["convert mesh.vtu a.inp"]
    if "gravity:0,0,-9.81" in options.split():
        commands.append("mesh a.nii.gz --spacing 8 --iterations 0 -o b.inp")
    for command in commands:
        err = run_command(f"{command} {options}").err
        assert err.count(": if it is in ") == (said is not None)
        assert said is None or f"warning: {said}" in err


def test_a_mesh_of_gmsh_s_is_measured_and_painted():
    first = load_mesh("mesh.vtu").mesh
    skin = boundary_facets(first.cells)
    groups = [np.full(len(skin), 7), np.full(len(first.cells), 8)]
    other = meshio.Mesh(
        first.points,
        [("triangle", skin), ("tetra", first.cells)],
        cell_data={"gmsh:physical": groups, "gmsh:geometrical": groups},
        field_data={"skin": np.array([7, 2]), "tissue": np.array([8, 3])},
    )
    meshio.gmsh.write("g.msh", other, fmt_version="2.2", binary=True)
    said = run_command("quality g.msh --image a.nii.gz --check")
    assert "fills the box" in said.out
    assert f"{len(skin)} cells of lower dimension" in said.err
    said = run_command(f"convert g.msh g.inp --young {MAPPING}", code=2).err
    assert "the mesh has no cell means; give the image (--image)" in said
    assert not Path("g.inp").exists()
    # which needs none
    said = run_command("convert g.msh c.inp --young 3").out
    assert "1 material, Young's modulus 3 kPa" in said
    assert_done(f"convert g.msh g.inp --image a.nii.gz --young {MAPPING} --load compress:1%")
    text = Path("g.inp").read_text()
    assert "*STATIC" in text
    for name in ("*NSET, NSET=skin", "*ELSET, ELSET=tissue", "*NSET, NSET=left"):
        assert re.search(f"{re.escape(name)}[\n,]", text)
    assert "*SURFACE, NAME=boundary," in text


# From a mesh of the user's


def test_a_mesh_is_improved_and_its_boundary_kept():
    assert_done("convert mesh.vtu a.vtu --set top=plane:0,0,118:0,0,1:5")
    said = run_command("mesh a.nii.gz -o b.vtu --start a.vtu --iterations 4 --json b.json").err
    assert "start of" in said
    before, after = (load_mesh(name) for name in ("a.vtu", "b.vtu"))
    sides = [
        {
            frozenset(map(tuple, facet))
            for facet in mesh.points[boundary_facets(mesh.cells)].tolist()
        }
        for mesh in (before.mesh, after.mesh)
    ]
    assert sides[0] == sides[1]  # to the last bit
    numbers = numbers_in("b.json")
    options, n_top = numbers["options"], numbers["sets"]["facets"]["top"]
    assert (options["start"], options["boundary"]) == ("a.vtu", "fixed")
    assert n_top == len(after.sets.facets["top"]) == len(before.sets.facets["top"]) > 0


def test_a_mask_keeps_what_lies_outside_out_of_the_means():
    image, largest = load_image("a.nii.gz"), []
    save_image("m.nii.gz", Image(1.0 * (image.data < 30), image.affine))
    for more in ("", "--mask m.nii.gz"):
        assert_done(f"convert mesh.vtu a.vtu --force --image a.nii.gz {more}")
        largest.append(fields_in("a.vtu")["mean"].max())
    assert largest[1] < 30 < 40 < largest[0]


def test_an_image_of_another_box_is_rejected_unless_registered():
    """A finer grid of the same box, to a voxel, is another contrast; more of the world may be
    another subject.
    """
    image = load_image("a.nii.gz")
    grids = {"finer": (0.5, 0.0), "half_off": (0.25, 0.5), "moved": (1.0, 2.0), "far": (1.0, 99.0)}
    for name, (step, shift) in grids.items():
        data = np.repeat(image.data, round(1 / step), axis=0)
        affine = image.affine @ np.diag([step, 1.0, 1.0, 1.0])
        affine[:3, 3] = image.to_world([0.5 * step - 0.5 + shift, 0.0, 0.0])
        save_image(f"{name}.nii", Image(data, affine))
    convert = f"convert mesh.vtu a.inp --young {MAPPING} --force --image"
    another = "mesh.vtu was built from a different image"
    for name in ("finer", "half_off"):
        assert another in run_command(f"{convert} {name}.nii").err
    fem = f"fem moved.nii mesh.vtu --young {MAPPING} --load compress:1%"
    outside = "% of the nodes lie outside the image or its mask: cells there take the nearest"
    for words in (f"{convert} moved.nii", fem):
        expected = "moved.nii: expected the box of mesh.vtu's image, a.nii.gz, "
        assert_refuses(words, f"{expected}.* pass --registered")
        said = run_command(f"{words} --registered").err
        assert another not in said
        assert outside in said
    said = run_command(f"{convert} far.nii --registered", code=2).err
    assert "no node is in the image's box" in said


def test_values_of_labels_that_no_cell_has_are_said():
    """Once for each quantity, and in a run only of the final mesh."""
    mesh = "mesh a.nii.gz --labels l.nii.gz --spacing 8 --iterations 0 -o m.inp"
    values = "--young 1=2,9=5,*=1 --nu 7=0.4,9=0.3,*=0.2 --load compress:1%"
    for words in ("convert mesh.vtu a.inp", "fem mesh.vtu", mesh):
        said = re.findall("warning: values by label: (.*)", run_command(f"{words} {values}").err)
        assert said == [
            "no cell has label 9 (1 of 2); the mesh has 0, 1",
            "no cell has label 7, 9 (2 of 2); the mesh has 0, 1",
        ]


def test_an_optimised_mesh_is_kept_whatever_is_refused_after_it():
    """And nothing is ever replaced by such a mesh, with --force neither."""
    options = "--spacing 8 --iterations 1 --young 3 --set p=point:0,0,0:0.01"
    kept = {}
    for name in ("a", "a_optimised_1", "a_optimised_2"):
        said = run_command(f"mesh a.nii.gz -o a.inp {options} --force", code=2).err.splitlines()
        assert "no facet lies within 0.01 mm" in said[-1]
        assert f"the optimised mesh is in {name}.vtu" in said[-1]
        assert len(load_mesh(f"{name}.vtu").mesh.cells) > 100
        kept[name] = Path(f"{name}.vtu").read_bytes()
    assert {name: Path(f"{name}.vtu").read_bytes() for name in kept} == kept
    assert not Path("a.inp").exists()


def test_loads_on_what_only_the_final_mesh_may_have_are_no_early_error(here):
    """On an interface of labels, or a set that is asked for; but a set that can never be is one."""
    base = "mesh a.nii.gz --labels l.nii.gz --young 2 --iterations 1"
    loads = "--load hold:interface_0_1 --load move:inferior:1,0,0"
    assert_done(f"{base} --nodes 300 -o a.inp {loads}")
    loads = "--set top=plane:0,0,118:0,0,1:9 --load hold:top --load move:inferior:1,0,0"
    assert_done(f"{base} --nodes 90 -o b.inp {loads}")
    for wrong, said in (
        ("--load move:nosuch:1,0,0", "nosuch"),
        ("--load compress:99%", "99"),
        ("--set left=below:20", "left"),
    ):
        assert_refuses(f"{base} --nodes 90 -o c.inp {loads} {wrong}", said)
    assert here() == ["a.inp", "b.inp"]


def step_numbers(text):
    """The numbers of an input file's steps."""
    found = re.findall(r"-?\d+\.\d+(?:e-?\d+)?", text.partition("*STEP")[2])
    return np.array(found, dtype=float)


MODULI = {  # texts of 2 MPa where it counts, beside their unit in the option
    "2": "MPa",
    "0.002 GPa": "kPa",
    "2000000 Pa": "MPa",
    "where(h < 1e9, 0*h + 2, 7)": "MPa",
    "where(h < 1e9, 0*h + 2, 7) MPa": "Pa",
    "0:2,100:2": "MPa",
    "0:2,100:2 MPa": "kPa",
    "0=2,1=2": "MPa",
    "0=2 MPa,1=2000 kPa": "Pa",
    "plain.csv": "MPa",
    "named.csv": "kPa",
    "named.toml": "Pa",
}


@pytest.mark.parametrize(("text", "units"), MODULI.items())
def test_moduli_and_pressures_are_in_the_unit_of_the_file_or_their_own(text, units):
    """What Python builds in kPa, and what is printed in the file's unit."""
    Path("plain.csv").write_text("label,young\n0,2\n*,2\n")
    Path("named.csv").write_text("label;Young [MPa]\n0;2\n*;2\n")
    Path("named.toml").write_text('label = ["*"]\nyoung_MPa = [2]\n')
    number = {"kPa": 500.0, "MPa": 0.5, "Pa": 5e5}[units]
    loads = f"--load hold:superior --load pressure:inferior:{number}"
    loads += ' --load "traction:left:1,2,3 kPa" --load "spring:right:5 Pa/mm"'
    printed = run_command(f'convert mesh.vtu a.inp --units {units} --young "{text}" {loads}').out
    model = tetopt.build_model(
        load_mesh("mesh.vtu"),
        young=2000.0,
        loads=[
            "hold:superior",
            "pressure:inferior:500",
            "traction:left:1,2,3",
            "spring:right:.005",
        ],
        about={"tetopt": tetopt.__version__},
    )
    assert_allclose(model.materials.young, 2000.0)
    tetopt.save_model("b.inp", model, units=units)
    ours, theirs = (Path(name).read_text() for name in ("a.inp", "b.inp"))
    assert re.findall(r"\*ELASTIC\n.*", ours) == re.findall(r"\*ELASTIC\n.*", theirs)
    assert_allclose(step_numbers(ours), step_numbers(theirs), rtol=1e-12)
    shown = {"kPa": "2000", "MPa": "2", "Pa": "2e+06"}[units]
    assert f"Young's modulus {shown} {units}" in printed
    assert f"pressure:inferior:{number} {units}" in printed.replace("e5 ", "00000.0 ")


def test_units_of_some_values_only_are_refused():
    assert_refuses('convert mesh.vtu a.inp --young "0=2,1=3 MPa"', "unit")


def test_a_file_s_loads_keep_their_unit():
    """`--units` is of what the command names."""
    assert_done("convert mesh.vtu a.vtu --young 3 --load hold:superior --load pressure:left:0.5")
    assert_done("convert a.vtu b.vtu --units MPa")
    assert_done("convert b.vtu c.vtu --units Pa --young 3000")
    assert load_mesh("c.vtu").cell_data["young"][0] == pytest.approx(3.0)
    assert json.loads(load_mesh("c.vtu").text("loads"))[1] == "pressure:left:500.0"
    assert_refuses("convert mesh.vtu d.inp --young 2 --load 'pressure:left:1 psi'", "kPa")


@pytest.mark.parametrize("units", ["MPa", "Pa"])
def test_loads_of_all_kinds_density_and_moduli_at_nodes_go_on(units):
    """Through other units and LPS and back, into the same CalculiX file as from the first one."""
    loads = """--load hold:superior --load spring:left:0.5 --load 1/pressure:inferior:0.25
        --load 1/gravity:0,8,-9810 --load 2/traction:inferior:0.5,-2,0.125
        --load 2/move:inferior:free,1,free"""
    mapping = f"--young {MAPPING} --density 1000+h --average nodes --image a.nii.gz"
    assert_done(f"convert mesh.vtu a.vtu {mapping} {loads}")
    assert_done(f"convert a.vtu b.vtu --units {units} --space lps")
    assert_done("convert b.vtu c.vtu")
    first, again = load_mesh("a.vtu"), load_mesh("c.vtu")
    assert_allclose(again.point_data["young_nodes"], first.point_data["young_nodes"], rtol=1e-14)
    assert_array_equal(again.cell_data["density"], first.cell_data["density"])
    assert again.cell_data["density"].min() >= 1000.0
    files, numbers = [], []
    for name in "ac":
        assert_done(f"convert {name}.vtu {name}.inp")
        files.append(Path(f"{name}.inp").read_text())
        numbers.append(step_numbers(files[-1]))
    assert_allclose(*numbers, rtol=1e-12)
    assert files[1].count("*STEP") == 2
    assert "*INITIAL CONDITIONS, TYPE=TEMPERATURE" in files[1]
    # Other moduli take the place of those at the nodes.
    assert_done("convert a.vtu d.vtu --bins 3")
    assert "young_nodes" not in load_mesh("d.vtu").point_data


def test_large_deformation_and_means_over_cells_are_said():
    mapping = f"--young {MAPPING} --average nodes --image a.nii.gz --load compress:5%"
    said = run_command(f"convert mesh.vtu a.inp {mapping} --nonlinear").out
    assert "linear within cells" in said
    assert "*STEP, NLGEOM" in Path("a.inp").read_text()
    assert "one modulus per cell: the mean" in run_command(f"convert mesh.vtu a.feb {mapping}").out


@pytest.mark.parametrize("text", ['[["left", null]]', "[" * 100_000, "3"])
def test_loads_of_another_kind_in_a_file_are_left(text):
    grid = pyvista.read("mesh.vtu")
    grid.field_data["loads"] = np.frombuffer(text.encode(), dtype=np.uint8)
    grid.save("a.vtu")
    assert_done("convert a.vtu b.inp --young 2")
    assert "*STEP" not in Path("b.inp").read_text()


def test_loads_run_or_are_said_to_be_in_comments():
    for suffix in (".inp", ".feb", ".xdmf"):
        said = run_command(f"convert mesh.vtu a{suffix} --young 3 --load compress:5%").out
        assert ("the format defines no analysis step" in said) == (suffix == ".xdmf"), suffix


def test_numbers_of_loads_are_printed_without_rounding_errors_and_kept_with_them():
    options = f"--young 3 --load hold:inferior --load move:superior:0,0,{0.1 * 3!r}"
    said = run_command(f"convert mesh.vtu b.vtu {options}").out
    assert "\nload: move:superior:0.0,0.0,0.3\n" in said
    model = tetopt.build_model(load_mesh("b.vtu"))
    assert model.loads[1].numbers.tolist() == [0.0, 0.0, 0.1 * 3]
    assert "move:superior:0.0,0.0,0.3<" in model._repr_html_()


# Bad input: one line, exit 2, nothing left behind


test_refused = refusals(
    r"""
convert mesh.vtu a.foo
    unknown suffix; known suffixes are .vtu (VTK, ParaView), .vtk
convert mesh.vtu a.inp --young '1 + x'
    cannot use "x"
convert mesh.vtu a.inp --young 0:1,100:5,50:3
    --young: intensities must increase, got 100 and then 50
convert mesh.vtu a.inp --young 2 --nu 0:x
    --nu: expected pairs intensity:value
convert mesh.vtu a.inp --young h+1 --average gauss
    --average: gauss averages over voxels and needs an image; pass
convert mesh.vtu a.inp --young 0
    young: expected moduli above 0 kPa
convert mesh.vtu a.inp --young 2 --nu 0.5
    -1 < nu < 0.5
convert mesh.vtu a.inp --nu 0.3
    --nu: needs --young
convert mesh.vtu a.inp --young 1=2
    the mesh also has 0 (1 more)
convert mesh.vtu a.inp --crop 1:3,:,:
    --crop: needs --image
convert mesh.vtu a.inp --registered
    --registered: needs --image
convert mesh.vtu a.inp --young 2 --load gravity:0,0,-9810
    gravity: the cells have no density
convert mesh.vtu a.vtu --young 2 --nonlinear
    --nonlinear is for .inp, .feb only
convert mesh.vtu a.inp --young 2 --load pressure:nowhere:1
    no set of facets "nowhere"
convert mesh.vtu a.inp --young 2 --load pressure:interface_0_1:1
    lie between two cells
convert mesh.vtu a.inp --bins 4
    no moduli to group
convert mesh.vtu a.inp --average mean
    --average: needs --young
convert mesh.vtu a.inp --young h+1 --average voigt
    average: expected mean, geometric, harmonic, hill
convert mesh.vtu a.inp --young h+1 --bins 0
    --bins: expected K
convert mesh.vtu a.inp --fields mean
    --fields: expected none, mean, all and a file .vtu, .vtk, .xdmf, .msh
convert mesh.vtu a.vtu --fields some
    --fields: expected none, mean, all
convert mesh.vtu a.inp --units psi
    --units: expected one of kPa, MPa, Pa, got psi
convert mesh.vtu a.inp --space xyz
    --space: expected ras or lps
convert mesh.vtu a.inp --order 3
    --order: expected 1 or 2
convert mesh.vtu a.inp --load compress:5%
    loads need materials
convert mesh.vtu a.inp --set x=above:3
    expected NAME=below:T
convert mesh.vtu a.feb
    needs a material; give a modulus mapping (--young)
convert mesh.vtu a.stl
    a.stl: no mesh's file, but a surface's; tetopt surface --boundary writes it
convert mesh.vtu a.inp --mask m.nii.gz
    --mask: needs --image
mesh a.nii.gz -o b.vtu --start mesh.vtu --nodes 100
    --start and --nodes
mesh a.nii.gz -o b.vtu --start mesh.vtu --mask l.nii.gz
    --start and --mask
mesh a.nii.gz -o b.vtu --start mesh.vtu --edge-size 3
    --edge-size: needs a graded mesh
mesh a.nii.gz -o b.vtu --start mesh.vtu --method paper
    only with --method fast
surface mesh.vtu -o s.stl
    one of --below, --label, --set, --boundary, --interface
surface mesh.vtu -o s.stl --below -3
    no cell has a mean below -3
surface mesh.vtu -o s.stl --label 7
    no cell has label 7; the mesh has 0, 1
surface mesh.vtu -o s.stl --set skin
    no cell set "skin"; it has label_0, label_1
surface mesh.vtu -o s.stl --label 1 --space x
    expected ras or lps
surface mesh.vtu -o s.stl --interfaces
    STL cannot store the labels of triangles; use .ply or .vtp or .vtk
surface mesh.vtu -o s.stl --interface 0
    two labels as J,K, by number or name, got "0"
surface mesh.vtu -o s.stl --interface 1,1
    two different labels, got "1,1"
surface mesh.vtu -o s.stl --interface 0,7
    no facet lies between labels 0 and 7
mesh a.nii.gz -o a.vtu --slice k=99
    a.nii.gz: --slice: expected an index from
mesh a.nii.gz -o a.vtu --nodes 6
    tetopt: --nodes: expected a whole number of nodes
mesh a.nii.gz -o a.vtu --load hold:nowhere --young 2
    tetopt: --load: no set of facets "nowhere"
mesh a.nii.gz -o a.vtu --edge-size -1
    tetopt: --edge-size: expected a length above 0 mm
mesh away.nii.gz -o b.vtu --start mesh.vtu
    lies outside the image
convert thrice.vtu out.inp
    thrice\.vtu: at \d+ facets cells overlap
mesh a.nii.gz -o a.inp --spacing 8 --young 'h - 20'
    young
mesh a.nii.gz -o a.inp --spacing 8 --young 2 --load hold:skin
    skin
mesh a.nii.gz -o a.inp --spacing 8 --load compress:5%
    loads need materials
mesh a.nii.gz -o a.feb --spacing 8
    --young
mesh a.nii.gz -o a.inp --spacing 8 --set foo
    foo
mesh a.nii.gz -o a.inp --spacing 8 --set low=below:-5
    below
mesh a.nii.gz -o a.inp --spacing 8 --set low=below:20 --young 'h - 20'
    young
mesh a.nii.gz -o a.inp --spacing 8 --set all_cells=below:20 --young 2
    all_cells
mesh a.nii.gz -o a.inp --spacing 8 --labels l.nii.gz --young 2 --load pressure:interface_0_1:1
    interface_0_1
mesh a.nii.gz --slice k=3 -o a.inp --nodes 60 --young 2
    triangles
mesh a.nii.gz --slice k=3 -o a.feb --nodes 60 --young 2
    triangles
mesh a.nii.gz --slice k=3 -o a.vtu --nodes 60 --space lps
    omit --space
mesh a.nii.gz --target-error 0.3 -o a.inp --load foo
    foo
surface bare.vtu -o s.stl --below 3
    ; it has none
surface bare.vtu -o s.stl --label 1
    ; it has none
surface bare.vtu -o s.stl --interface 0,1
    ; it has none
surface mesh.vtu -o s.obj --label 1
    ending in .stl or .ply or .vtp or .vtk
view mesh.vtu --html a.png
    a.png
view mesh.vtu --html b.html --show young
    --show: the mesh has no field "young"; it has label, mean
view mesh.vtu --html b.html --range 3
    --range: expected LOW,HIGH, such as 0,120
view mesh.vtu --html b.html --range low,3
    --range: expected a number, got "low"
view mesh.vtu --html b.html --range 3,2
    --range: expected LOW,HIGH with LOW below HIGH
"""
)


# Surfaces


@pytest.mark.parametrize(("what", "suffix"), [("below", "stl"), ("label", "ply"), ("set", "stl")])
def test_the_surface_of_a_structure(what, suffix):
    loaded = load_mesh("mesh.vtu")
    value, chosen = {
        "below": (12, largest_component(loaded.mesh.cells, loaded.cell_data["mean"] < 12)),
        "label": (1, loaded.cell_data["label"] == 1),
        "set": ("label_0", loaded.sets.cells["label_0"]),
    }[what]
    said = run_command(f"surface mesh.vtu --{what} {value} -o s.{suffix} --json s.json").out
    assert "watertight, normals out" in said
    surface = trimesh.load_mesh(f"s.{suffix}")
    assert surface.is_watertight
    assert surface.volume == pytest.approx(loaded.cell_data["volume"][chosen].sum(), rel=1e-3)
    numbers = numbers_in("s.json")
    for size, name in ((surface.volume, "volume_mm3"), (surface.area, "area_mm2")):
        assert numbers[name] == pytest.approx(size)
        assert f"{size:.6g}" in said


# Looking


def page_data(path):
    """What a page to look at holds of its mesh."""
    return json.loads(re.search(r'id="data">(.*?)</script>', path.read_text(), re.DOTALL).group(1))


def test_a_page_to_look_at():
    said = run_command("view mesh.vtu --image a.nii.gz --html a.html").out
    assert "self-contained" in said
    page = Path("a.html").read_text()
    assert "interface_0_1" in page
    assert "min_dihedral" in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert_refuses("view mesh.vtu --html a.html", "a.html")
    assert_done("view mesh.vtu --html b.html --show rho --range 0.1,0.3")
    field = page_data(Path("b.html"))["fields"][0]
    assert (field["name"], field["limits"]) == ("rho", [0.1, 0.3])


@pytest.mark.parametrize(("display", "answer"), [("", True), (":0", False), (":0", True)])
def test_the_page_is_opened_or_it_is_said_where_it_is(tmp_path, monkeypatch, display, answer):
    """Never a browser of the terminal's, which would take it over."""
    opened = []
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(webbrowser, "open", lambda address: [opened.append(address), answer][1])
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    said = "".join(run_command("view mesh.vtu").out.split())
    (page,) = tmp_path.rglob("*.html")
    words = "opened in the browser" if display and answer else "open it in a browser"
    assert f"{page}: {words};".replace(" ", "") in said
    assert opened == ([page.as_uri()] if display else [])
    monkeypatch.undo()
    assert_done("view mesh.vtu --html b.html")
    assert page.read_bytes() == Path("b.html").read_bytes()


def test_the_air_around_is_said_of_a_surface():
    threshold = np.median(fields_in("mesh.vtu")["mean"])
    said = run_command(f"surface mesh.vtu -o a.stl --below {threshold}").err
    assert "touches the box's faces left" in said
    assert "touches" not in run_command("surface mesh.vtu -o b.stl --label 1").err


def test_a_table_of_other_labels_is_said():
    for rows, is_said in (("7,liver\n", True), ("7,liver\n1,lung\n", False)):
        Path("names.csv").write_text(f"label,name\n{rows}")
        for words in (
            "view mesh.vtu --html a.html --force",
            "quality mesh.vtu --image a.nii.gz --labels l.nii.gz",
        ):
            said = run_command(f"{words} --label-names names.csv").err
            assert ("contains none of the mesh's labels, 0, 1" in said) == is_said
