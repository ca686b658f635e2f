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
    assert_refused,
    exit_code,
    in_copy_of,
    labelled_lattice_words,
    numbers_in,
)
from models import sample_image
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt import E_D, Image, load_image, load_mesh, save_image, save_mesh
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.topology import boundary_facets, largest_component
from tetopt.io.formats import FORMATS
from tetopt.model.averages import cell_young
from tetopt.model.loads import parse_load

pytestmark = pytest.mark.full
MAPPING = "1+h/7"


here = in_copy_of("folder")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An image, its labels, a lattice of 60 nodes with both, and the same mesh as gmsh's and LPS
    files.
    """
    path = tmp_path_factory.mktemp("convert")
    mesh = labelled_lattice_words(path)
    assert_done(*mesh, "-o", path / "mesh.vtu")
    return path


def test_a_mesh_s_file_has_its_sets_and_its_box():
    loaded = load_mesh("mesh.vtu")
    image = load_image("a.nii.gz")
    assert loaded.box.shape == image.shape
    assert_array_equal(loaded.box.affine, image.affine)
    assert set(loaded.sets.facets) == {
        "boundary",
        "left",
        "right",
        "posterior",
        "anterior",
        "inferior",
        "superior",
        "interface_0_1",
    }
    assert set(loaded.sets.cells) == {"label_0", "label_1"}
    assert_array_equal(loaded.sets.cells["label_1"], np.flatnonzero(loaded.cell_data["label"] == 1))
    low, high = loaded.cell_data["min"], loaded.cell_data["max"]
    assert (low <= loaded.cell_data["mean"] + 1e-9).all()
    assert (high >= loaded.cell_data["mean"] - 1e-9).all()
    assert (low < high).any()


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_is_written(here, suffix, capsys):
    out = f"out{suffix}"
    assert_done(
        f"convert mesh.vtu {out} --young {MAPPING} --bins 3 --set dark=below:20 --space lps"
    )
    assert Path(out).stat().st_size > 900
    said = capsys.readouterr().out
    assert f"{out}: {FORMATS[suffix].what}, LPS+ mm, kPa, " in said
    assert "3 materials" in said or "6 materials" in said or "4 materials" in said
    assert "modulus error" in said
    assert "dark_surface" in said
    assert here() == [out]
    assert exit_code(f"convert mesh.vtu {out}") == 2  # is there already


@pytest.fixture(scope="module")
def quadratic_path(folder):
    """The same mesh of order 2, with a displacement of every node."""
    path = folder / "quadratic.vtu"
    assert_done(
        "convert",
        folder / "mesh.vtu",
        f"{path} --order 2 --young {MAPPING} --load compress:5%",
    )
    grid = pyvista.read(path)
    grid.point_data["displacement"] = np.asarray(grid.points) ** 2
    grid.save(path)
    return path


def test_convert_keeps_the_order_unless_told_otherwise(quadratic_path, capsys):
    mesh = load_mesh("mesh.vtu").mesh
    n_corners, n_all = len(mesh.points), len(quadratic(mesh.points, mesh.cells)[0])
    capsys.readouterr()
    for suffix in (".vtu", ".msh", ".inp"):
        form = FORMATS[suffix]
        out, numbers = f"kept{suffix}", f"kept{suffix}.json"
        assert_done(f"convert {quadratic_path} {out} --json {numbers}")
        order = 2 if form.has_quadratic else 1
        assert numbers_in(numbers)["size"] == {
            "order": order,
            "n_nodes": n_corners,
            "n_nodes_in_all": n_all if order == 2 else n_corners,
            "n_cells": len(mesh.cells),
        }
        said = " ".join("".join(capsys.readouterr()).split())
        if order == 2:
            assert f"{n_corners} corner nodes, {n_all} in all, {len(mesh.cells)} cells" in said
        assert "has no quadratic cells" not in said
    for name in ("kept.vtu", "kept.msh"):
        loaded = load_mesh(name)
        assert loaded.order == 2
        points = quadratic(loaded.mesh.points, loaded.mesh.cells)[0]
        assert_array_equal(loaded.point_data["displacement"], points**2)
    assert_done(f"convert {quadratic_path} linear.vtu --order 1")
    loaded = load_mesh("linear.vtu")
    assert loaded.order == 1
    assert_array_equal(loaded.point_data["displacement"], mesh.points**2)


def test_forces_that_hold_sets_go_on_with_the_results_in_their_own_axes_and_units(quadratic_path):
    grid, text = pyvista.read(quadratic_path), json.dumps({"left": [1.5, 0.0, -2.0]})
    for name in ("reactions", "reactions_step2", "reactions of mine"):
        grid.field_data[name] = np.frombuffer(text.encode(), dtype=np.uint8)
    grid.save("a.vtu")
    for options, is_kept in (("", True), ("--units MPa", False)):
        assert_done(f"convert a.vtu b.vtu --force {options}")
        loaded = load_mesh("b.vtu")
        for name in ("reactions", "reactions_step2"):
            assert loaded.text(name) == (text if is_kept else None)
        assert loaded.text("reactions of mine") is None


def test_commands_take_a_quadratic_mesh(quadratic_path, capsys):
    """Each says of it what it says of the corners' mesh."""
    mesh = load_mesh("mesh.vtu").mesh
    n_all = len(quadratic(mesh.points, mesh.cells)[0])
    texts = []
    for name in ("mesh", "quadratic"):
        assert_done(f"quality {name}.vtu --image a.nii.gz --check --json {name}.json")
        texts.append(capsys.readouterr().out)
        assert_done(f"segment a.nii.gz {name}.vtu -o {name}.nii.gz --classes 2")
        assert_done(f"surface {name}.vtu --label 1 -o {name}.stl")
        assert_done(f"view {name}.vtu --html {name}.html")
        improved = f"--start {name}.vtu --iterations 1 -o {name}.msh --json {name}_improved.json"
        assert_done(f"mesh a.nii.gz {improved}")
        capsys.readouterr()
    assert re.search(rf"^nodes +{n_all} \({len(mesh.points)} corners\)\n", texts[1], re.MULTILINE)
    assert re.search(rf"^nodes +{len(mesh.points)}\ncells", texts[0], re.MULTILINE)
    linear, both = (numbers_in(f"{name}.json") for name in ("mesh", "quadratic"))
    assert linear["quality"] == both["quality"]
    assert linear["fit"] == both["fit"]
    assert (both["size"]["n_nodes_in_all"], linear["size"]["n_nodes_in_all"]) == (
        n_all,
        len(mesh.points),
    )
    improved = [numbers_in(f"{name}_improved.json") for name in ("mesh", "quadratic")]
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
def test_fields_of_cells_are_written_as_asked(name, options, kept, capsys):
    assert_done(f"convert mesh.vtu {name} {options}")
    said, every = capsys.readouterr().err, load_mesh("mesh.vtu").cell_data
    assert sorted(load_mesh(name).cell_data) == sorted(every if kept is None else kept)
    assert ("8 fields of cells are not written" in said) == (name == "a.msh" and not options)


def test_vtu_there_and_back_with_materials_sets_and_loads():
    options = (
        f"--young {MAPPING} --nu 0=0.45,1=0.3 --load compress:5% --set dark=below:20 --json b.json"
    )
    assert_done(f"convert mesh.vtu b.vtu {options} --units MPa --space lps")
    first, loaded = load_mesh("mesh.vtu"), load_mesh("b.vtu")
    numbers = numbers_in("b.json")
    assert numbers["materials"]["count"] == len(
        np.unique(np.column_stack([loaded.cell_data[k] for k in ("young", "nu")]), axis=0)
    )
    assert numbers["sets"]["cells"]["dark"] == len(loaded.sets.cells["dark"])
    assert numbers["loads"][0] == "hold:superior"
    assert loaded.space == "lps"
    assert loaded.mesh.points.tobytes() == first.mesh.points.tobytes()  # turned back
    assert_array_equal(loaded.mesh.cells, first.mesh.cells)
    means = first.cell_data["mean"]
    # in kPa again
    assert_allclose(loaded.cell_data["young"], 1.0 + means / 7.0, rtol=1e-14)
    raw = pyvista.read("b.vtu").cell_data["young"]
    assert_allclose(raw, (1.0 + means / 7.0) / 1000.0, rtol=1e-15)
    assert_array_equal(loaded.cell_data["nu"], np.where(first.cell_data["label"] == 1, 0.3, 0.45))
    for kind in (0, 1):
        for name, members in first.sets[kind].items():
            assert_array_equal(loaded.sets[kind][name], members)
    assert_array_equal(loaded.sets.cells["dark"], largest_component(first.mesh.cells, means < 20))
    assert str(loaded.field_data["units"][0]) == "MPa"
    loads = json.loads(str(loaded.field_data["loads"][0]))
    assert [word.rpartition(":")[0] for word in loads] == ["hold", "move:inferior"]
    # And on, in kPa and RAS again, what was painted, set and loaded kept.
    assert_done("convert b.vtu c.vtu")
    again = load_mesh("c.vtu")
    assert_allclose(again.cell_data["young"], 1.0 + means / 7.0, rtol=1e-14)
    assert_array_equal(again.cell_data["nu"], loaded.cell_data["nu"])
    kept = json.loads(again.text("loads"))
    x, y, z = map(float, loads[1].rpartition(":")[2].split(","))
    assert kept == ["hold:superior", f"move:inferior:{-x + 0.0},{-y + 0.0},{z}"]
    assert again.space == "ras"
    assert list(again.sets.cells) == list(loaded.sets.cells)
    assert again.box.shape == first.box.shape


def test_an_image_gives_the_mean_of_the_mapping():
    """Of a curved mapping, which is not the mapping of the mean; the geometric one unless
    another is asked for.
    """
    image = "--image a.nii.gz"
    for name, more in (("mean", ""), ("image", f"{image} --average mean"), ("default", image)):
        assert_done(f"convert mesh.vtu {name}.vtu --young 1+h**2 {more}")
    young = {
        name: load_mesh(f"{name}.vtu").cell_data["young"] for name in ("mean", "image", "default")
    }
    loaded = load_mesh("mesh.vtu")
    fields, mesh = loaded.cell_data, loaded.mesh
    assert_allclose(young["image"] - young["mean"], fields["variance"], atol=1e-9)
    assert fields["variance"].max() > 10
    expected = cell_young(load_image("a.nii.gz"), mesh, lambda h: 1.0 + h**2, "geometric")
    assert_allclose(young["default"], expected, rtol=1e-12)


def test_a_file_has_one_modulus_a_cell_of_those_at_gauss_points(capsys):
    for average in ("geometric", "gauss"):
        options = f"--young {MAPPING} --average {average} --image a.nii.gz --order 2"
        assert_done(f"convert mesh.vtu {average}.vtu {options}")
        assert ("one modulus per cell, its geometric mean" in capsys.readouterr().out) == (
            average == "gauss"
        )
        assert_done(f"convert {average}.vtu {average}.inp")
        assert ("VTK files also have one per Gauss point" in capsys.readouterr().out) == (
            average == "gauss"
        )
    first, second = (load_mesh(f"{each}.vtu").cell_data["young"] for each in ("geometric", "gauss"))
    assert_array_equal(first, second)


def test_results_of_other_moduli_or_loads_are_left_out(capsys):
    assert_done("convert mesh.vtu a.vtu --young 2 --load compress:5%")
    assert_done("fem a.vtu -o solved.vtu")
    fields = {"displacement", "von_mises", "stress_nodes"}
    said = (
        "dropped results computed with other moduli or loads: strain, stress, von_mises, "
        "displacement,"
    )
    for options in ("", "--young 3", "--load compress:4%"):
        capsys.readouterr()
        assert_done(f"convert solved.vtu b.vtu --force {options}")
        assert (said in capsys.readouterr().err) == bool(options)
        loaded = load_mesh("b.vtu")
        kept = fields & {*loaded.cell_data, *loaded.point_data}
        assert kept == (set() if options else fields)
        assert ("reactions" in loaded.field_data) == (not options)
    assert_done("mesh a.nii.gz --start solved.vtu -o c.vtu --iterations 1")
    assert "moduli, loads and results of the input mesh are not kept" in capsys.readouterr().err
    assert not fields & {*load_mesh("c.vtu").point_data}


def test_the_error_of_bins_goes_on(capsys):
    assert_done(f"convert mesh.vtu a.vtu --young {MAPPING} --bins 3")
    line = next(
        line
        for line in capsys.readouterr().out.splitlines()
        if line.startswith("bins: modulus error")
    )
    for source, out in (("a.vtu", "b.vtu"), ("b.vtu", "b.inp")):
        assert_done(f"convert {source} {out} --json {out}.json")
        assert line in capsys.readouterr().out.splitlines()
        assert numbers_in(f"{out}.json")["materials"]["binning"]["mean"] > 0.0
    assert_done("convert b.vtu c.vtu --young 2")
    assert "modulus error" not in capsys.readouterr().out


def test_what_formats_do_not_hold_as_it_is_is_said(capsys):
    """Loads that no reader of gmsh's brings back, label 0, groups that are not complete, numbers
    of no label.
    """
    Path("names.csv").write_text("label,name\n1,liver\n")
    last = int(load_mesh("mesh.vtu").cell_data["label"].max())
    group, short = (
        f"label 0 is physical group {last + 1}",
        "facets of smaller sets are missing from boundary",
    )
    for suffix, expected in {
        ".msh": [group],
        ".msh2": [group, short],
        ".mfem": [f"label 0 is attribute {last + 1}"],
        ".mesh": [f"label 0 is reference {last + 1}"],
        ".vtu": [],
    }.items():
        assert_done(f"convert mesh.vtu a{suffix}")
        plain = capsys.readouterr().out
        assert all((words in plain) == (words in expected) for words in (*expected, group, short))
        assert_done(
            f"convert mesh.vtu b{suffix} --young 2 --load compress:5% --label-names names.csv"
        )
        assert (f"loads in {suffix} files are not read back" in capsys.readouterr().out) == (
            ".msh" in suffix
        )
        assert "not read back" not in plain
        assert "2001" not in plain
        if suffix in (".mfem", ".mesh"):
            assert_done(f"convert mesh.vtu c{suffix} --young {MAPPING}")
            assert "number from 2001 on (label_1, label_0)" in " ".join(
                capsys.readouterr().out.split()
            )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--young 3500", "young is 3500 to 3500 kPa, stiffer than soft tissue"),
        ("--young 0.003", "young is at most 0.003 kPa, softer than any tissue"),
        ("--young 3 --density 1.06", "density is at most 1.06 kg/m3 (water: 1000)"),
        (
            "--young 3 --density 1060 --load gravity:0,0,-9.81",
            "gravity is 9.81 mm/s2",
        ),
        (
            "--young 0=17e6,1=1e5 --density 1=1000,0=1.2 --load gravity:0,0,-9810",
            None,
        ),
    ],
)
def test_quantities_in_other_units_are_said(options, said, capsys):
    commands = ["convert mesh.vtu a.inp"]
    if "gravity:0,0,-9.81" in options.split():
        commands.append("mesh a.nii.gz --spacing 8 --iterations 0 -o b.inp")
    for command in commands:
        assert_done(f"{command} {options}")
        err = capsys.readouterr().err
        assert err.count(": if it is in ") == (said is not None)
        assert said is None or f"warning: {said}" in err


def test_a_mesh_of_gmsh_s_is_measured_and_painted(capsys):
    first = load_mesh("mesh.vtu").mesh
    skin = boundary_facets(first.cells)
    other = meshio.Mesh(
        first.points,
        [("triangle", skin), ("tetra", first.cells)],
        cell_data={
            "gmsh:physical": [np.full(len(skin), 7), np.full(len(first.cells), 8)],
            "gmsh:geometrical": [np.full(len(skin), 7), np.full(len(first.cells), 8)],
        },
        field_data={"skin": np.array([7, 2]), "tissue": np.array([8, 3])},
    )
    meshio.gmsh.write("g.msh", other, fmt_version="2.2", binary=True)
    loaded = load_mesh("g.msh")
    assert loaded.mesh.points.tobytes() == first.points.tobytes()
    assert loaded.n_left == len(skin)
    assert len(loaded.sets.facets["skin"]) == len(skin)
    assert len(loaded.sets.cells["tissue"]) == len(first.cells)
    assert_done("quality g.msh --image a.nii.gz --check")
    said = capsys.readouterr()
    assert "fills the box" in said.out
    assert f"{len(skin)} cells of lower dimension" in said.err
    assert exit_code(f"convert g.msh g.inp --young {MAPPING}") == 2
    assert "the mesh has no cell means; give the image (--image)" in capsys.readouterr().err
    assert not Path("g.inp").exists()
    # which needs none
    assert_done("convert g.msh c.inp --young 3")
    assert "1 material, Young's modulus 3 kPa" in capsys.readouterr().out
    options = ["--image a.nii.gz --young", MAPPING, "--load compress:1%"]
    assert_done("convert g.msh g.inp", *options)
    text = Path("g.inp").read_text()
    assert "*STATIC" in text
    for name in (
        "*NSET, NSET=skin",
        "*ELSET, ELSET=tissue",
        "*NSET, NSET=left",
        "*SURFACE, NAME=boundary",
    ):
        assert f"{name}\n" in text or f"{name}," in text


# From a mesh of the user's


def test_a_mesh_is_improved_and_its_boundary_kept(capsys):
    assert_done("convert mesh.vtu a.vtu --set top=plane:0,0,118:0,0,1:5")
    assert_done("mesh a.nii.gz -o b.vtu --start a.vtu --iterations 4 --json b.json")
    assert "start of" in capsys.readouterr().err
    before, after = (load_mesh(name) for name in ("a.vtu", "b.vtu"))
    sides = [
        {
            frozenset(map(tuple, corners))
            for corners in mesh.points[boundary_facets(mesh.cells)].tolist()
        }
        for mesh in (before.mesh, after.mesh)
    ]
    assert sides[0] == sides[1]  # to the last bit
    assert len(after.sets.facets["top"]) == len(before.sets.facets["top"]) > 0
    image = sample_image(3)
    assert E_D(image, after.mesh) < 0.95 * E_D(image, before.mesh)
    numbers = numbers_in("b.json")
    assert numbers["options"]["start"] == "a.vtu"
    assert numbers["options"]["boundary"] == "fixed"
    assert numbers["sets"]["facets"]["top"] == len(after.sets.facets["top"])


@pytest.mark.parametrize(
    ("more", "match"),
    [
        ("--nodes 100", "--start and --nodes"),
        ("--mask l.nii.gz", "--start and --mask"),
        ("--edge-size 3", "--edge-size: needs a graded mesh"),
        ("--method paper", "only with --method fast"),
    ],
)
def test_options_that_ask_for_another_mesh(more, match, capsys):
    assert_refused(capsys, f"mesh a.nii.gz -o b.vtu --start mesh.vtu {more}", match)


def test_a_mesh_beside_the_image(capsys):
    image = sample_image(3)
    away = image.affine.copy()
    away[:3, 3] += 500.0
    save_image("away.nii.gz", Image(image.data, away))
    assert_refused(capsys, "mesh away.nii.gz -o b.vtu --start mesh.vtu", "lies outside the image")


def test_a_mask_keeps_what_lies_outside_out_of_the_means():
    image = load_image("a.nii.gz")
    save_image("m.nii.gz", Image(1.0 * (image.data < 30), image.affine))
    means = []
    for name, more in (("all", ""), ("part", "--mask m.nii.gz")):
        assert_done(f"convert mesh.vtu {name}.vtu --image a.nii.gz {more}")
        means.append(load_mesh(f"{name}.vtu").cell_data["mean"])
    assert means[0].max() > 40
    assert means[1].max() < 30


def test_an_image_of_another_box_is_rejected_unless_registered(capsys):
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
    for name in ("finer", "half_off"):
        assert_done(f"{convert} {name}.nii")
        assert "mesh.vtu was built from a different image" in capsys.readouterr().err
    expected = "moved.nii: expected the box of mesh.vtu's image, a.nii.gz, .* pass --registered"
    fem = f"fem moved.nii mesh.vtu --young {MAPPING} --load compress:1%"
    for words in (f"{convert} moved.nii", fem):
        assert_refused(capsys, words, expected)
        assert_done(f"{words} --registered")
        said = capsys.readouterr().err
        assert "mesh.vtu was built from a different image" in said
        assert (
            "% of the nodes lie outside the image or its mask: cells there take the nearest "
            "voxel's value" in said
        )
    assert exit_code(f"{convert} far.nii --registered") == 2
    assert "no node lies in the image's box" in capsys.readouterr().err


def test_values_of_labels_that_no_cell_has_are_said(capsys):
    """Once for each quantity, and in a run only of the final mesh."""
    mesh = "mesh a.nii.gz --labels l.nii.gz --spacing 8 --iterations 0 -o m.inp"
    for words in ("convert mesh.vtu a.inp", "fem mesh.vtu", mesh):
        assert_done(f"{words} --young 1=2,9=5,*=1 --nu 7=0.4,9=0.3,*=0.2 --load compress:1%")
        said = re.findall("warning: (values by label: .*)", capsys.readouterr().err)
        assert said == [
            "values by label: no cell has label 9 (1 of 2); the mesh has 0, 1",
            "values by label: no cell has label 7, 9 (2 of 2); the mesh has 0, 1",
        ]


def test_an_optimised_mesh_is_kept_whatever_is_refused_after_it(capsys):
    options = "--spacing 8 --iterations 1 --young 3 --set p=point:0,0,0:0.01"
    assert exit_code(f"mesh a.nii.gz -o a.inp {options}") == 2
    said = capsys.readouterr().err.splitlines()
    assert "no boundary facet lies within 0.01 mm" in said[-1]
    assert "the optimised mesh is in a.vtu" in said[-1]
    assert len(load_mesh("a.vtu").mesh.cells) > 100
    assert not Path("a.inp").exists()
    before = Path("a.vtu").read_bytes()
    for number in (1, 2):  # and nothing is ever replaced by such a mesh, with --force neither
        assert exit_code(f"mesh a.nii.gz -o a.inp {options} --force") == 2
        assert f"a_optimised_{number}.vtu" in capsys.readouterr().err
    assert Path("a.vtu").read_bytes() == before


def test_loads_on_what_only_the_final_mesh_may_have_are_no_early_error(here):
    """On an interface of labels, or a set that is asked for; but a set that can never be is one."""
    base = "mesh a.nii.gz --labels l.nii.gz --young 2 --iterations 1"
    loads = "--load hold:interface_0_1 --load move:inferior:1,0,0"
    assert_done(f"{base} --nodes 300 -o a.inp {loads}")
    loads = "--set top=plane:0,0,118:0,0,1:9 --load hold:top --load move:inferior:1,0,0"
    assert_done(f"{base} --nodes 90 -o b.inp {loads}")
    for wrong in (
        "--load move:nosuch:1,0,0",
        "--load compress:99%",
        "--set left=below:20",
    ):
        assert exit_code(f"{base} --nodes 90 -o c.inp {loads} {wrong}") == 2
    assert here() == ["a.inp", "b.inp"]


@pytest.mark.parametrize(
    ("units", "in_units"),
    [
        (
            "MPa",
            ["spring:left:0.0005", "1/pressure:inferior:0.00025", "1/gravity:0.0,-8.0,-9810.0"],
        ),
        ("Pa", ["spring:left:500000.0", "1/pressure:inferior:250.0", "1/gravity:0.0,-0.008,-9.81"]),
    ],
)
def test_loads_of_all_kinds_density_and_moduli_at_nodes_go_on(units, in_units):
    """Through other units and LPS and back, into the same CalculiX file as from the first one."""
    loads = """--load hold:superior --load spring:left:0.5 --load 1/pressure:inferior:0.25
        --load 1/gravity:0,8,-9810 --load 2/traction:inferior:0.5,-2,0.125
        --load 2/move:inferior:free,1,free"""
    mapping = f"--young {MAPPING} --density 1000+h --average nodes --image a.nii.gz"
    assert_done(f"convert mesh.vtu a.vtu {mapping} {loads}")
    assert_done(f"convert a.vtu b.vtu --units {units} --space lps")
    texts = [json.loads(load_mesh(path).text("loads")) for path in ("a.vtu", "b.vtu")]
    assert texts[1][1:4] == in_units
    size = 1e-3 if units == "Pa" else 1.0
    assert_allclose(
        pyvista.read("b.vtu").points * [-1, -1, 1],
        pyvista.read("a.vtu").points * size,
        rtol=1e-14,
        atol=1e-300,
    )
    assert_done("convert b.vtu c.vtu")
    again, before = load_mesh("c.vtu"), load_mesh("a.vtu")
    assert_allclose(again.point_data["young_nodes"], before.point_data["young_nodes"], rtol=1e-14)
    assert_array_equal(again.cell_data["density"], before.cell_data["density"])
    assert again.cell_data["density"].min() >= 1000.0
    for kept, text in zip(json.loads(again.text("loads")), texts[0], strict=True):
        (load, original) = (parse_load(words, 3) for words in (kept, text))
        assert (load.kind, load.set_name, load.step) == (
            original.kind,
            original.set_name,
            original.step,
        )
        assert_allclose(load.numbers, original.numbers, rtol=1e-14)
    for name, path in (("c.inp", "c.vtu"), ("first.inp", "a.vtu")):
        assert_done(f"convert {path} {name}")
    steps = [Path(name).read_text().partition("*STEP")[2] for name in ("c.inp", "first.inp")]
    assert steps[0].count("*STEP") == 1
    assert "*INITIAL CONDITIONS, TYPE=TEMPERATURE" in Path("c.inp").read_text()
    numbers = [np.array(re.findall(r"-?\d+\.\d+(?:e-?\d+)?", step), dtype=float) for step in steps]
    assert_allclose(*numbers, rtol=1e-12)
    # Other moduli take the place of those at the nodes.
    assert_done("convert a.vtu d.vtu --bins 3")
    assert "young_nodes" not in load_mesh("d.vtu").point_data


def test_large_deformation_and_means_over_cells_are_said(capsys):
    mapping = f"--young {MAPPING} --average nodes --image a.nii.gz --load compress:5%"
    assert_done(f"convert mesh.vtu a.inp {mapping} --nonlinear")
    assert "*STEP, NLGEOM" in Path("a.inp").read_text()
    assert "linear within cells" in capsys.readouterr().out
    assert_done(f"convert mesh.vtu a.feb {mapping}")
    assert "one modulus per cell: the mean" in capsys.readouterr().out


@pytest.mark.parametrize("text", ['[["left", null]]', "[" * 100_000, "3"])
def test_loads_of_another_kind_in_a_file_are_left(text):
    grid = pyvista.read("mesh.vtu")
    grid.field_data["loads"] = np.frombuffer(text.encode(), dtype=np.uint8)
    grid.save("a.vtu")
    assert_done("convert a.vtu b.inp --young 2")
    assert "*STEP" not in Path("b.inp").read_text()


def test_loads_run_or_are_said_to_be_in_comments(capsys):
    for suffix in (".inp", ".feb", ".xdmf"):
        options = "--young 3 --load compress:5%"
        assert_done(f"convert mesh.vtu a{suffix} {options}")
        is_said = "the format defines no analysis step" in capsys.readouterr().out
        assert is_said == (suffix == ".xdmf"), suffix


def test_numbers_of_loads_are_printed_without_rounding_errors_and_kept_with_them(capsys):
    options = f"--young 3 --load hold:inferior --load move:superior:0,0,{0.1 * 3!r}"
    assert_done(f"convert mesh.vtu b.vtu {options}")
    assert "\nload: move:superior:0.0,0.0,0.3\n" in capsys.readouterr().out
    model = tetopt.build_model(load_mesh("b.vtu"))
    assert model.loads[1].numbers.tolist() == [0.0, 0.0, 0.1 * 3]
    assert "move:superior:0.0,0.0,0.3<" in model._repr_html_()


# Bad input: one line, exit 2, nothing left behind


@pytest.mark.parametrize(
    ("out", "more", "match"),
    [
        ("a.foo", "", "unknown suffix; known suffixes are .vtu (VTK, ParaView), .vtk"),
        ("a.inp", "--young '1 + x'", 'cannot use "x"'),
        (
            "a.inp",
            "--young 0:1,100:5,50:3",
            "--young: intensities must increase, got 100 and then 50",
        ),
        ("a.inp", "--young 2 --nu 0:x", "--nu: expected pairs intensity:value"),
        (
            "a.inp",
            "--young h+1 --average gauss",
            "--average: gauss averages over voxels and needs an image; pass",
        ),
        ("a.inp", "--young 0", "young: expected moduli above 0 kPa"),
        ("a.inp", "--young 2 --nu 0.5", "-1 < nu < 0.5"),
        ("a.inp", "--nu 0.3", "--nu: needs --young"),
        ("a.inp", "--young 1=2", "the mesh also has 0 (1 more)"),
        ("a.inp", "--crop 1:3,:,:", "--crop: needs --image"),
        ("a.inp", "--registered", "--registered: needs --image"),
        (
            "a.inp",
            "--young 2 --load gravity:0,0,-9810",
            "gravity: the cells have no density",
        ),
        ("a.vtu", "--young 2 --nonlinear", "--nonlinear is for .inp, .feb only"),
        ("a.inp", "--young 2 --load pressure:nowhere:1", 'no set of facets "nowhere"'),
        ("a.inp", "--young 2 --load pressure:interface_0_1:1", "lie between two cells"),
        ("a.inp", "--bins 4", "no moduli to group"),
        ("a.inp", "--average mean", "--average: needs --young"),
        (
            "a.inp",
            "--young h+1 --average voigt",
            "average: expected mean, geometric, harmonic, hill",
        ),
        ("a.inp", "--young h+1 --bins 0", "--bins: expected K"),
        (
            "a.inp",
            "--fields mean",
            "--fields: expected none, mean, all and a file .vtu, .vtk, .xdmf, .msh",
        ),
        ("a.vtu", "--fields some", "--fields: expected none, mean, all"),
        ("a.inp", "--units psi", "--units: expected one of kPa, MPa, Pa, got psi"),
        ("a.inp", "--space xyz", "--space: expected ras or lps"),
        ("a.inp", "--order 3", "--order: expected 1 or 2"),
        ("a.inp", "--load compress:5%", "loads need materials"),
        ("a.inp", "--set x=above:3", "expected NAME=below:T"),
        ("a.feb", "", "needs a material; give a modulus mapping (--young)"),
        ("a.stl", "", "known suffixes are .vtu (VTK, ParaView), "),
        ("a.inp", "--mask m.nii.gz", "--mask: needs --image"),
    ],
)
def test_conversions_that_are_refused(out, more, match, capsys):
    assert_refused(capsys, f"convert mesh.vtu {out} {more}", match)


def test_a_mesh_whose_cells_are_there_several_times_is_no_solver_s(capsys):
    mesh = load_mesh("mesh.vtu").mesh
    save_mesh(
        "thrice.vtu",
        tetopt.Mesh(mesh.points, np.vstack([mesh.cells, mesh.cells[[5, 5]]])),
    )
    words = r"thrice\.vtu: at \d+ facets cells overlap"
    assert_refused(capsys, "convert thrice.vtu out.inp", words)


def test_what_will_not_do_is_said_before_the_optimisation(capsys):
    for out, more in (
        ("a.inp", "--young 'h - 20'"),
        ("a.inp", "--young 2 --load hold:skin"),
        ("a.inp", "--load compress:5%"),
        ("a.feb", ""),
        ("a.inp", "--set foo"),
        ("a.inp", "--set low=below:-5"),
        ("a.inp", "--set low=below:20 --young 'h - 20'"),
        ("a.inp", "--set all_cells=below:20 --young 2"),
        (
            "a.inp",
            "--labels l.nii.gz --young 2 --load pressure:interface_0_1:1",
        ),
    ):
        assert_refused(capsys, f"mesh a.nii.gz -o {out} --spacing 8 {more}", "")
    for out in ("a.inp", "a.feb"):
        mesh = f"mesh a.nii.gz --slice k=3 -o {out} --nodes 60 --young 2"
        assert_refused(capsys, mesh, "triangles")
    assert_refused(
        capsys, "mesh a.nii.gz --slice k=3 -o a.vtu --nodes 60 --space lps", "omit --space"
    )
    assert_refused(capsys, "mesh a.nii.gz --target-error 0.3 -o a.inp --load foo", "foo")


# Surfaces


@pytest.mark.parametrize(("what", "suffix"), [("below", "stl"), ("label", "ply"), ("set", "stl")])
def test_the_surface_of_a_structure(what, suffix, capsys):
    loaded = load_mesh("mesh.vtu")
    chosen = {
        "below": largest_component(loaded.mesh.cells, loaded.cell_data["mean"] < 12),
        "label": np.flatnonzero(loaded.cell_data["label"] == 1),
        "set": loaded.sets.cells["label_0"],
    }[what]
    value = {"below": "12", "label": "1", "set": "label_0"}[what]
    out = f"s.{suffix}"
    assert_done(f"surface mesh.vtu --{what} {value} -o {out} --json s.json")
    said = capsys.readouterr().out
    assert "watertight, normals out" in said
    surface = trimesh.load_mesh(out)
    assert surface.is_watertight
    assert surface.volume == pytest.approx(loaded.cell_data["volume"][chosen].sum(), rel=1e-3)
    numbers = numbers_in("s.json")
    assert numbers["volume_mm3"] == pytest.approx(surface.volume)
    assert numbers["area_mm2"] == pytest.approx(surface.area)
    assert f"{surface.volume:.6g}" in said
    assert f"{surface.area:.6g}" in said


@pytest.mark.parametrize(
    ("more", "match"),
    [
        ("", "one of --below, --label, --set, --boundary, --interface"),
        ("--below -3", "no cell has a mean below -3"),
        ("--label 7", "no cell has label 7; the mesh has 0, 1"),
        ("--set skin", 'no cell set "skin"; it has label_0, label_1'),
        ("--label 1 --space x", "expected ras or lps"),
        ("--interfaces", "STL cannot store the labels of triangles; use .ply or .vtp or .vtk"),
        ("--interface 0", 'two labels as J,K, by number or name, got "0"'),
        ("--interface 1,1", 'two different labels, got "1,1"'),
        ("--interface 0,7", "no facet lies between labels 0 and 7"),
    ],
)
def test_surfaces_that_are_refused(more, match, capsys):
    assert_refused(capsys, f"surface mesh.vtu -o s.stl {more}", match)


def test_a_field_that_is_not_there(capsys):
    save_mesh("bare.vtu", load_mesh("mesh.vtu").mesh)
    for more in ("--below 3", "--label 1", "--interface 0,1"):
        assert_refused(capsys, f"surface bare.vtu -o s.stl {more}", "; it has none")
    assert_refused(
        capsys, "surface mesh.vtu -o s.obj --label 1", "ending in .stl or .ply or .vtp or .vtk"
    )


# Looking


def test_a_page_to_look_at(capsys):
    assert_done("view mesh.vtu --image a.nii.gz --html a.html")
    page = Path("a.html").read_text()
    assert "self-contained" in capsys.readouterr().out
    assert "interface_0_1" in page
    assert "min_dihedral" in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert exit_code("view mesh.vtu --html a.html") == 2
    assert exit_code("view mesh.vtu --html a.png") == 2


def test_a_page_opens_on_the_field_and_the_range_asked_for(capsys):
    assert_done("view mesh.vtu --html a.html --field rho --range 0.1,0.3")
    data = json.loads(
        re.search(r'id="data">(.*?)</script>', Path("a.html").read_text(), re.DOTALL).group(1)
    )
    assert (data["fields"][0]["name"], data["fields"][0]["limits"]) == ("rho", [0.1, 0.3])
    for options, message in (
        ("--field young", '--field: the mesh has no field "young"; it has mean'),
        ("--range 3", "--range: expected LOW,HIGH, such as 0,120"),
        ("--range low,3", '--range: expected a number, got "low"'),
        ("--range 3,2", "--range: expected LOW,HIGH with LOW below HIGH"),
    ):
        assert_refused(capsys, f"view mesh.vtu --html b.html {options}", message)


@pytest.mark.parametrize(("display", "answer"), [("", True), (":0", False), (":0", True)])
def test_the_page_is_opened_or_it_is_said_where_it_is(
    tmp_path, monkeypatch, capsys, display, answer
):
    """Never a browser of the terminal's, which would take it over."""
    opened = []
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(webbrowser, "open", lambda address: [opened.append(address), answer][1])
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert_done("view mesh.vtu")
    (page,) = tmp_path.rglob("*.html")
    said = "".join(capsys.readouterr().out.split())
    words = "opened in the browser" if display and answer else "open it in a browser"
    assert f"{page}: {words};".replace(" ", "") in said
    assert opened == ([page.as_uri()] if display else [])
    monkeypatch.undo()
    assert_done("view mesh.vtu --html b.html")
    assert page.read_bytes() == Path("b.html").read_bytes()


def test_the_air_around_is_said_of_a_surface(capsys):
    mean = load_mesh("mesh.vtu").cell_data["mean"]
    threshold = float(np.median(mean))
    assert_done(f"surface mesh.vtu -o a.stl --below {threshold}")
    assert "touches the box's faces left" in capsys.readouterr().err
    assert_done("surface mesh.vtu -o b.stl --label 1")
    assert "touches" not in capsys.readouterr().err


def test_a_table_of_other_labels_is_said(capsys):
    for text, is_said in (
        ("label,name\n7,liver\n", True),
        ("label,name\n7,liver\n1,lung\n", False),
    ):
        Path("names.csv").write_text(text)
        for words in (
            "view mesh.vtu --html a.html --force",
            "quality mesh.vtu --image a.nii.gz --labels l.nii.gz",
        ):
            assert_done(f"{words} --label-names names.csv")
            assert (
                "contains none of the mesh's labels, 0, 1" in capsys.readouterr().err
            ) == is_said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--slice k=99", "a.nii.gz: --slice: expected an index from"),
        ("--nodes 6", "tetopt: --nodes: expected a whole number of nodes"),
        ("--load hold:nowhere --young 2", 'tetopt: --load: no set of facets "nowhere"'),
        ("--edge-size -1", "tetopt: --edge-size: expected a length above 0 mm"),
    ],
)
def test_refusals_name_the_option_that_was_given(options, said, capsys):
    assert_refused(capsys, f"mesh a.nii.gz -o a.vtu {options}", said)
