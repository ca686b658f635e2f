"""`tetopt convert`, `tetopt surface`, `tetopt mesh` for solvers and from a mesh of the user's,
as a user types them.
"""

import json
import re
import sys
import tempfile
import webbrowser

import meshio
import numpy as np
import pytest
import pyvista
import trimesh
from commands import exit_code, labelled_lattice_words, numbers_in
from models import sample_image

import tetopt
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.topology import boundary_facets, largest_component
from tetopt.io.formats import FORMATS
from tetopt.model.averages import cell_young
from tetopt.model.loads import parse_load

pytestmark = pytest.mark.full
MAPPING = "1 + h/7"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An image, its labels, a lattice of 60 nodes with both, and the same mesh as gmsh's and LPS
    files.
    """
    path = tmp_path_factory.mktemp("convert")
    mesh = labelled_lattice_words(path)
    assert exit_code(*mesh, "-o", path / "a.vtu") == 0
    return path


def test_a_mesh_s_file_has_its_sets_and_its_box(folder):
    loaded = tetopt.load_mesh(folder / "a.vtu")
    image = tetopt.load_image(folder / "a.nii.gz")
    assert loaded.box.shape == image.shape
    np.testing.assert_array_equal(loaded.box.affine, image.affine)
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
    np.testing.assert_array_equal(
        loaded.sets.cells["label_1"], np.flatnonzero(loaded.cell_data["label"] == 1)
    )
    low, high = loaded.cell_data["min"], loaded.cell_data["max"]
    assert (low <= loaded.cell_data["mean"] + 1e-9).all()
    assert (high >= loaded.cell_data["mean"] - 1e-9).all()
    assert (low < high).any()


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_is_written(folder, tmp_path, suffix, capsys):
    out = tmp_path / f"out{suffix}"
    more = (
        []
        if FORMATS[suffix].is_surface
        else ["--young", MAPPING, "--bins", "3", "--set", "dark=below:20"]
    )
    assert exit_code("convert", folder / "a.vtu", out, *more, "--space", "lps") == 0
    assert out.stat().st_size > 900
    said = capsys.readouterr().out
    units = "" if FORMATS[suffix].is_surface else ", kPa, "
    assert f"{out}: {FORMATS[suffix].what}, LPS+ mm{units}" in said
    if more:
        assert "3 materials" in said or "6 materials" in said or "4 materials" in said
        assert "modulus error" in said
        assert "dark_surface" in said
    assert list(tmp_path.rglob("*")) == [out]
    assert exit_code("convert", folder / "a.vtu", out) == 2  # is there already


@pytest.fixture(scope="module")
def quadratic_path(folder):
    """The same mesh of order 2, with a displacement of every node."""
    path = folder / "quadratic.vtu"
    assert (
        exit_code(
            "convert",
            folder / "a.vtu",
            path,
            "--order",
            "2",
            "--young",
            MAPPING,
            "--load",
            "compress:5%",
        )
        == 0
    )
    grid = pyvista.read(path)
    grid.point_data["displacement"] = np.asarray(grid.points) ** 2
    grid.save(path)
    return path


def test_convert_keeps_the_order_unless_told_otherwise(folder, quadratic_path, tmp_path, capsys):
    mesh = tetopt.load_mesh(folder / "a.vtu").mesh
    n_corners, n_all = len(mesh.points), len(quadratic(mesh.points, mesh.cells)[0])
    capsys.readouterr()
    for suffix in (".vtu", ".msh", ".inp", ".stl"):
        form = FORMATS[suffix]
        out, numbers = tmp_path / f"kept{suffix}", tmp_path / f"kept{suffix}.json"
        assert exit_code("convert", quadratic_path, out, "--json", numbers) == 0
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
        loaded = tetopt.load_mesh(tmp_path / name)
        assert loaded.order == 2
        points = quadratic(loaded.mesh.points, loaded.mesh.cells)[0]
        np.testing.assert_array_equal(loaded.point_data["displacement"], points**2)
    assert exit_code("convert", quadratic_path, tmp_path / "linear.vtu", "--order", "1") == 0
    loaded = tetopt.load_mesh(tmp_path / "linear.vtu")
    assert loaded.order == 1
    np.testing.assert_array_equal(loaded.point_data["displacement"], mesh.points**2)


def test_forces_that_hold_sets_go_on_with_the_results_in_their_own_axes_and_units(
    quadratic_path, tmp_path
):
    grid, text = pyvista.read(quadratic_path), json.dumps({"left": [1.5, 0.0, -2.0]})
    for name in ("reactions", "reactions_step2", "reactions of mine"):
        grid.field_data[name] = np.frombuffer(text.encode(), dtype=np.uint8)
    grid.save(tmp_path / "a.vtu")
    for options, is_kept in (([], True), (["--units", "MPa"], False)):
        assert (
            exit_code("convert", tmp_path / "a.vtu", tmp_path / "b.vtu", "--force", *options) == 0
        )
        loaded = tetopt.load_mesh(tmp_path / "b.vtu")
        for name in ("reactions", "reactions_step2"):
            assert loaded.text(name) == (text if is_kept else None)
        assert loaded.text("reactions of mine") is None


def test_commands_take_a_quadratic_mesh(folder, quadratic_path, tmp_path, capsys):
    """Each says of it what it says of the corners' mesh."""
    mesh = tetopt.load_mesh(folder / "a.vtu").mesh
    n_all = len(quadratic(mesh.points, mesh.cells)[0])
    texts = []
    for path in (folder / "a.vtu", quadratic_path):
        numbers = tmp_path / f"{path.stem}.json"
        assert (
            exit_code("quality", path, "--image", folder / "a.nii.gz", "--check", "--json", numbers)
            == 0
        )
        texts.append(capsys.readouterr().out)
        labels = tmp_path / f"{path.stem}.nii.gz"
        assert exit_code("segment", folder / "a.nii.gz", path, "-o", labels, "--classes", "2") == 0
        surface = tmp_path / f"{path.stem}.stl"
        assert exit_code("surface", path, "--label", "1", "-o", surface) == 0
        assert exit_code("view", path, "--html", tmp_path / f"{path.stem}.html") == 0
        started, improved = (
            ["--start", path, "--iterations", "1"],
            tmp_path / f"{path.stem}_improved.json",
        )
        output = ["-o", tmp_path / f"{path.stem}.msh", "--json", improved]
        assert exit_code("mesh", folder / "a.nii.gz", *output, *started) == 0
        capsys.readouterr()
    assert re.search(rf"^nodes +{n_all} \({len(mesh.points)} corners\)\n", texts[1], re.MULTILINE)
    assert re.search(rf"^nodes +{len(mesh.points)}\ncells", texts[0], re.MULTILINE)
    linear, both = (numbers_in(tmp_path / f"{name}.json") for name in ("a", "quadratic"))
    assert linear["quality"] == both["quality"]
    assert linear["fit"] == both["fit"]
    assert (both["size"]["n_nodes_in_all"], linear["size"]["n_nodes_in_all"]) == (
        n_all,
        len(mesh.points),
    )
    improved = [numbers_in(tmp_path / f"{name}_improved.json") for name in ("a", "quadratic")]
    assert improved[0]["mesh_sha256"] == improved[1]["mesh_sha256"]
    assert improved[1]["size"]["order"] == 2  # as the mesh read
    for name in ("nii.gz", "stl"):
        assert (tmp_path / f"a.{name}").stat().st_size == (
            tmp_path / f"quadratic.{name}"
        ).stat().st_size


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".msh2"])
def test_a_mesh_in_metres_is_read_in_millimetres(folder, tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    assert exit_code("convert", folder / "a.vtu", path, "--units", "Pa") == 0
    metres = meshio.gmsh.read(path) if suffix == ".msh2" else meshio.read(path)
    back, first = tetopt.load_mesh(path), tetopt.load_mesh(folder / "a.vtu")
    np.testing.assert_allclose(metres.points, first.mesh.points / 1000.0, rtol=1e-14, atol=1e-17)
    np.testing.assert_allclose(back.mesh.points, first.mesh.points, rtol=1e-14, atol=1e-14)
    if "volume" in back.cell_data:
        np.testing.assert_allclose(back.cell_data["volume"], first.cell_data["volume"], rtol=1e-13)


@pytest.mark.parametrize(
    ("name", "options", "kept"),
    [
        ("a.msh", [], ["label"]),
        ("a.msh", ["--fields", "mean"], ["label", "mean"]),
        ("a.vtu", ["--fields", "none"], ["label"]),
        ("a.msh", ["--fields", "all"], None),
        ("a.vtu", [], None),
    ],
)
def test_fields_of_cells_are_written_as_asked(folder, tmp_path, name, options, kept, capsys):
    assert exit_code("convert", folder / "a.vtu", tmp_path / name, *options) == 0
    said, every = capsys.readouterr().err, tetopt.load_mesh(folder / "a.vtu").cell_data
    assert sorted(tetopt.load_mesh(tmp_path / name).cell_data) == sorted(
        every if kept is None else kept
    )
    assert ("8 fields of cells are not written" in said) == (name == "a.msh" and not options)


def test_vtu_there_and_back_with_materials_sets_and_loads(folder, tmp_path):
    options = [
        "--young",
        MAPPING,
        "--nu",
        "0=0.45,1=0.3",
        "--load",
        "compress:5%",
        "--set",
        "dark=below:20",
    ]
    options += ["--json", tmp_path / "b.json"]
    assert (
        exit_code(
            "convert",
            folder / "a.vtu",
            tmp_path / "b.vtu",
            *options,
            "--units",
            "MPa",
            "--space",
            "lps",
        )
        == 0
    )
    first, loaded = tetopt.load_mesh(folder / "a.vtu"), tetopt.load_mesh(tmp_path / "b.vtu")
    numbers = numbers_in(tmp_path / "b.json")
    assert numbers["materials"]["count"] == len(
        np.unique(np.column_stack([loaded.cell_data[k] for k in ("young", "nu")]), axis=0)
    )
    assert numbers["sets"]["cells"]["dark"] == len(loaded.sets.cells["dark"])
    assert numbers["loads"][0] == "hold:superior"
    assert loaded.space == "lps"
    assert loaded.mesh.points.tobytes() == first.mesh.points.tobytes()  # turned back
    np.testing.assert_array_equal(loaded.mesh.cells, first.mesh.cells)
    means = first.cell_data["mean"]
    # in kPa again
    np.testing.assert_allclose(loaded.cell_data["young"], 1.0 + means / 7.0, rtol=1e-14)
    raw = pyvista.read(tmp_path / "b.vtu").cell_data["young"]
    np.testing.assert_allclose(raw, (1.0 + means / 7.0) / 1000.0, rtol=1e-15)
    np.testing.assert_array_equal(
        loaded.cell_data["nu"], np.where(first.cell_data["label"] == 1, 0.3, 0.45)
    )
    for kind in (0, 1):
        for name, members in first.sets[kind].items():
            np.testing.assert_array_equal(loaded.sets[kind][name], members)
    np.testing.assert_array_equal(
        loaded.sets.cells["dark"], largest_component(first.mesh.cells, means < 20)
    )
    assert str(loaded.field_data["units"][0]) == "MPa"
    loads = json.loads(str(loaded.field_data["loads"][0]))
    assert [word.rpartition(":")[0] for word in loads] == ["hold", "move:inferior"]
    # And on, in kPa and RAS again, what was painted, set and loaded kept.
    assert exit_code("convert", tmp_path / "b.vtu", tmp_path / "c.vtu") == 0
    again = tetopt.load_mesh(tmp_path / "c.vtu")
    np.testing.assert_allclose(again.cell_data["young"], 1.0 + means / 7.0, rtol=1e-14)
    np.testing.assert_array_equal(again.cell_data["nu"], loaded.cell_data["nu"])
    kept = json.loads(again.text("loads"))
    x, y, z = map(float, loads[1].rpartition(":")[2].split(","))
    assert kept == ["hold:superior", f"move:inferior:{-x + 0.0},{-y + 0.0},{z}"]
    assert again.space == "ras"
    assert list(again.sets.cells) == list(loaded.sets.cells)
    assert again.box.shape == first.box.shape


def test_an_image_gives_the_mean_of_the_mapping(folder, tmp_path):
    """Of a curved mapping, which is not the mapping of the mean; the geometric one unless
    another is asked for.
    """
    image = ["--image", folder / "a.nii.gz"]
    for name, more in (("mean", []), ("image", [*image, "--average", "mean"]), ("default", image)):
        assert (
            exit_code(
                "convert", folder / "a.vtu", tmp_path / f"{name}.vtu", "--young", "1 + h**2", *more
            )
            == 0
        )
    young = {
        name: tetopt.load_mesh(tmp_path / f"{name}.vtu").cell_data["young"]
        for name in ("mean", "image", "default")
    }
    loaded = tetopt.load_mesh(folder / "a.vtu")
    fields, mesh = loaded.cell_data, loaded.mesh
    np.testing.assert_allclose(young["image"] - young["mean"], fields["variance"], atol=1e-9)
    assert fields["variance"].max() > 10
    expected = cell_young(
        tetopt.load_image(folder / "a.nii.gz"), mesh, lambda h: 1.0 + h**2, "geometric"
    )
    np.testing.assert_allclose(young["default"], expected, rtol=1e-12)


def test_a_file_has_one_modulus_a_cell_of_those_at_gauss_points(folder, tmp_path, capsys):
    for average in ("geometric", "gauss"):
        options = [
            "--young",
            MAPPING,
            "--average",
            average,
            "--image",
            folder / "a.nii.gz",
            "--order",
            "2",
        ]
        assert exit_code("convert", folder / "a.vtu", tmp_path / f"{average}.vtu", *options) == 0
        assert ("one modulus per cell, its geometric mean" in capsys.readouterr().out) == (
            average == "gauss"
        )
        assert exit_code("convert", tmp_path / f"{average}.vtu", tmp_path / f"{average}.inp") == 0
        assert ("VTK files also have one per Gauss point" in capsys.readouterr().out) == (
            average == "gauss"
        )
    first, second = (
        tetopt.load_mesh(tmp_path / f"{each}.vtu").cell_data["young"]
        for each in ("geometric", "gauss")
    )
    np.testing.assert_array_equal(first, second)


def test_results_of_other_moduli_or_loads_are_left_out(folder, tmp_path, capsys):
    first, solved = tmp_path / "a.vtu", tmp_path / "solved.vtu"
    assert (
        exit_code("convert", folder / "a.vtu", first, "--young", "2", "--load", "compress:5%") == 0
    )
    assert exit_code("fem", first, "-o", solved) == 0
    fields = {"displacement", "von_mises", "stress_nodes"}
    said = (
        "dropped results computed with other moduli or loads: strain, stress, von_mises, "
        "displacement,"
    )
    for options in ([], ["--young", "3"], ["--load", "compress:4%"]):
        capsys.readouterr()
        assert exit_code("convert", solved, tmp_path / "b.vtu", "--force", *options) == 0
        assert (said in capsys.readouterr().err) == bool(options)
        loaded = tetopt.load_mesh(tmp_path / "b.vtu")
        kept = fields & {*loaded.cell_data, *loaded.point_data}
        assert kept == (set() if options else fields)
        assert ("reactions" in loaded.field_data) == (not options)
    assert (
        exit_code(
            "mesh",
            folder / "a.nii.gz",
            "--start",
            solved,
            "-o",
            tmp_path / "c.vtu",
            "--iterations",
            "1",
        )
        == 0
    )
    assert "moduli, loads and results of the input mesh are not kept" in capsys.readouterr().err
    assert not fields & {*tetopt.load_mesh(tmp_path / "c.vtu").point_data}


def test_the_error_of_bins_goes_on(folder, tmp_path, capsys):
    assert (
        exit_code(
            "convert", folder / "a.vtu", tmp_path / "a.vtu", "--young", MAPPING, "--bins", "3"
        )
        == 0
    )
    line = next(
        line
        for line in capsys.readouterr().out.splitlines()
        if line.startswith("bins: modulus error")
    )
    for source, out in (("a.vtu", "b.vtu"), ("b.vtu", "b.inp")):
        assert (
            exit_code(
                "convert", tmp_path / source, tmp_path / out, "--json", tmp_path / f"{out}.json"
            )
            == 0
        )
        assert line in capsys.readouterr().out.splitlines()
        assert numbers_in(tmp_path / f"{out}.json")["materials"]["binning"]["mean"] > 0.0
    assert exit_code("convert", tmp_path / "b.vtu", tmp_path / "c.vtu", "--young", "2") == 0
    assert "modulus error" not in capsys.readouterr().out


def test_what_formats_do_not_hold_as_it_is_is_said(folder, tmp_path, capsys):
    """Loads that no reader of gmsh's brings back, label 0, groups that are not complete, numbers
    of no label.
    """
    (tmp_path / "names.csv").write_text("label,name\n1,liver\n")
    more = ["--young", "2", "--load", "compress:5%", "--label-names", tmp_path / "names.csv"]
    last = int(tetopt.load_mesh(folder / "a.vtu").cell_data["label"].max())
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
        assert exit_code("convert", folder / "a.vtu", tmp_path / f"a{suffix}") == 0
        plain = capsys.readouterr().out
        assert all((words in plain) == (words in expected) for words in (*expected, group, short))
        assert exit_code("convert", folder / "a.vtu", tmp_path / f"b{suffix}", *more) == 0
        assert (f"loads in {suffix} files are not read back" in capsys.readouterr().out) == (
            ".msh" in suffix
        )
        assert "not read back" not in plain
        assert "2001" not in plain
        if suffix in (".mfem", ".mesh"):
            assert (
                exit_code("convert", folder / "a.vtu", tmp_path / f"c{suffix}", "--young", MAPPING)
                == 0
            )
            assert "number from 2001 on (label_1, label_0)" in " ".join(
                capsys.readouterr().out.split()
            )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--young", "3500"], "young is 3500 to 3500 kPa, stiffer than soft tissue"),
        (["--young", "0.003"], "young is at most 0.003 kPa, softer than any tissue"),
        (["--young", "3", "--density", "1.06"], "density is at most 1.06 kg/m3 (water: 1000)"),
        (
            ["--young", "3", "--density", "1060", "--load", "gravity:0,0,-9.81"],
            "gravity is 9.81 mm/s2",
        ),
        (
            ["--young", "0=17e6,1=1e5", "--density", "1=1000,0=1.2", "--load", "gravity:0,0,-9810"],
            None,
        ),
    ],
)
def test_quantities_in_other_units_are_said(folder, tmp_path, options, said, capsys):
    image = [
        "mesh",
        folder / "a.nii.gz",
        "--spacing",
        "8",
        "--iterations",
        "0",
        "-o",
        tmp_path / "b.inp",
    ]
    for words in (
        ["convert", folder / "a.vtu", tmp_path / "a.inp"],
        *([image] if "gravity:0,0,-9.81" in options else []),
    ):
        assert exit_code(*words, *options) == 0
        err = " ".join(capsys.readouterr().err.split())
        assert err.count(": if it is in ") == (said is not None)
        assert said is None or f"warning: {said}" in err


def test_a_mesh_of_gmsh_s_is_measured_and_painted(folder, tmp_path, capsys):
    first = tetopt.load_mesh(folder / "a.vtu").mesh
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
    meshio.gmsh.write(tmp_path / "g.msh", other, fmt_version="2.2", binary=True)
    loaded = tetopt.load_mesh(tmp_path / "g.msh")
    assert loaded.mesh.points.tobytes() == first.points.tobytes()
    assert loaded.n_left == len(skin)
    assert len(loaded.sets.facets["skin"]) == len(skin)
    assert len(loaded.sets.cells["tissue"]) == len(first.cells)
    assert exit_code("quality", tmp_path / "g.msh", "--image", folder / "a.nii.gz", "--check") == 0
    said = capsys.readouterr()
    assert "fills the box" in said.out
    assert f"{len(skin)} cells of lower dimension" in said.err
    assert exit_code("convert", tmp_path / "g.msh", tmp_path / "g.inp", "--young", MAPPING) == 2
    assert "the mesh has no cell means; give the image (--image)" in capsys.readouterr().err
    assert not (tmp_path / "g.inp").exists()
    # which needs none
    assert exit_code("convert", tmp_path / "g.msh", tmp_path / "c.inp", "--young", "3") == 0
    assert "1 material, Young's modulus 3 kPa" in capsys.readouterr().out
    options = ["--image", folder / "a.nii.gz", "--young", MAPPING, "--load", "compress:1%"]
    assert exit_code("convert", tmp_path / "g.msh", tmp_path / "g.inp", *options) == 0
    text = (tmp_path / "g.inp").read_text()
    assert "*STATIC" in text
    for name in (
        "*NSET, NSET=skin",
        "*ELSET, ELSET=tissue",
        "*NSET, NSET=left",
        "*SURFACE, NAME=boundary",
    ):
        assert f"{name}\n" in text or f"{name}," in text


# From a mesh of the user's


def test_a_mesh_is_improved_and_its_boundary_kept(folder, tmp_path, capsys):
    assert (
        exit_code(
            "convert", folder / "a.vtu", tmp_path / "a.vtu", "--set", "top=plane:0,0,118:0,0,1:5"
        )
        == 0
    )
    options = ["--start", tmp_path / "a.vtu", "--iterations", "4", "--json", tmp_path / "b.json"]
    assert exit_code("mesh", folder / "a.nii.gz", "-o", tmp_path / "b.vtu", *options) == 0
    assert "start of" in capsys.readouterr().err
    before, after = (tetopt.load_mesh(tmp_path / name) for name in ("a.vtu", "b.vtu"))
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
    assert tetopt.E_D(image, after.mesh) < 0.95 * tetopt.E_D(image, before.mesh)
    numbers = numbers_in(tmp_path / "b.json")
    assert numbers["options"]["start"] == "a.vtu"
    assert numbers["options"]["boundary"] == "fixed"
    assert numbers["sets"]["facets"]["top"] == len(after.sets.facets["top"])


@pytest.mark.parametrize(
    ("more", "match"),
    [
        (["--nodes", "100"], "--start and --nodes"),
        (["--mask", "l.nii.gz"], "--start and --mask"),
        (["--edge-size", "3"], "--edge-size: needs a graded mesh"),
        (["--method", "paper"], "only with --method fast"),
    ],
)
def test_options_that_ask_for_another_mesh(folder, tmp_path, more, match, capsys):
    more = [folder / each if each.endswith(".gz") else each for each in more]
    assert (
        exit_code(
            "mesh",
            folder / "a.nii.gz",
            "-o",
            tmp_path / "b.vtu",
            "--start",
            folder / "a.vtu",
            *more,
        )
        == 2
    )
    assert match in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_mesh_beside_the_image(folder, tmp_path, capsys):
    image = sample_image(3)
    away = image.affine.copy()
    away[:3, 3] += 500.0
    tetopt.save_image(tmp_path / "away.nii.gz", tetopt.Image(image.data, away))
    assert (
        exit_code(
            "mesh", tmp_path / "away.nii.gz", "-o", tmp_path / "b.vtu", "--start", folder / "a.vtu"
        )
        == 2
    )
    assert "lies outside the image" in capsys.readouterr().err


def test_a_mask_keeps_what_lies_outside_out_of_the_means(folder, tmp_path):
    image = tetopt.load_image(folder / "a.nii.gz")
    tetopt.save_image(tmp_path / "m.nii.gz", tetopt.Image(1.0 * (image.data < 30), image.affine))
    means = []
    for name, more in (("all", []), ("part", ["--mask", tmp_path / "m.nii.gz"])):
        assert (
            exit_code(
                "convert",
                folder / "a.vtu",
                tmp_path / f"{name}.vtu",
                "--image",
                folder / "a.nii.gz",
                *more,
            )
            == 0
        )
        means.append(tetopt.load_mesh(tmp_path / f"{name}.vtu").cell_data["mean"])
    assert means[0].max() > 40
    assert means[1].max() < 30


def test_an_image_of_another_box_is_rejected_unless_registered(folder, tmp_path, capsys):
    """A finer grid of the same box, to a voxel, is another contrast; more of the world may be
    another subject.
    """
    image = tetopt.load_image(folder / "a.nii.gz")
    grids = {"finer": (0.5, 0.0), "half_off": (0.25, 0.5), "moved": (1.0, 2.0), "far": (1.0, 99.0)}
    for name, (step, shift) in grids.items():
        data = np.repeat(image.data, round(1 / step), axis=0)
        affine = image.affine @ np.diag([step, 1.0, 1.0, 1.0])
        affine[:3, 3] = image.to_world([0.5 * step - 0.5 + shift, 0.0, 0.0])
        tetopt.save_image(tmp_path / f"{name}.nii", tetopt.Image(data, affine))
    mapping = ["--young", MAPPING]
    convert = ["convert", folder / "a.vtu", tmp_path / "a.inp", *mapping, "--force", "--image"]
    for name in ("finer", "half_off"):
        assert exit_code(*convert, tmp_path / f"{name}.nii") == 0
        assert "a.vtu was built from a different image" in capsys.readouterr().err
    expected = (
        r"tetopt: .*moved.nii: expected the box of .*a.vtu's image, a.nii.gz, .* mm, "
        r"got .* pass --registered\n"
    )
    fem = ["fem", tmp_path / "moved.nii", folder / "a.vtu", *mapping, "--load", "compress:1%"]
    for words in ([*convert, tmp_path / "moved.nii"], fem):
        assert exit_code(*words) == 2
        assert re.fullmatch(expected, capsys.readouterr().err)
        assert exit_code(*words, "--registered") == 0
        said = capsys.readouterr().err
        assert "a.vtu was built from a different image" in said
        assert (
            "% of the nodes lie outside the image or its mask: cells there take the nearest "
            "voxel's value" in said
        )
    assert exit_code(*convert, tmp_path / "far.nii", "--registered") == 2
    assert "no node lies in the image's box" in capsys.readouterr().err


def test_values_of_labels_that_no_cell_has_are_said(folder, tmp_path, capsys):
    """Once for each quantity, and in a run only of the final mesh."""
    mapping = ["--young", "1=2,9=5,*=1", "--nu", "7=0.4,9=0.3,*=0.2"]
    mesh = [*labelled_lattice_words(tmp_path), "-o", tmp_path / "m.inp"]
    for words in (
        ["convert", folder / "a.vtu", tmp_path / "a.inp"],
        ["fem", folder / "a.vtu"],
        mesh,
    ):
        assert exit_code(*words, *mapping, "--load", "compress:1%") == 0
        said = re.findall("warning: (values by label: .*)", capsys.readouterr().err)
        assert said == [
            "values by label: no cell has label 9 (1 of 2); the mesh has 0, 1",
            "values by label: no cell has label 7, 9 (2 of 2); the mesh has 0, 1",
        ]


def test_an_optimised_mesh_is_kept_whatever_is_refused_after_it(folder, tmp_path, capsys):
    options = ["--spacing", "8", "--iterations", "1", "--young", "3", "--set", "p=point:0,0,0:0.01"]
    assert exit_code("mesh", folder / "a.nii.gz", "-o", tmp_path / "a.inp", *options) == 2
    said = capsys.readouterr().err.splitlines()
    assert "no boundary facet lies within 0.01 mm" in said[-1]
    assert f"the optimised mesh is in {tmp_path / 'a.vtu'}" in said[-1]
    assert len(tetopt.load_mesh(tmp_path / "a.vtu").mesh.cells) > 100
    assert not (tmp_path / "a.inp").exists()
    before = (tmp_path / "a.vtu").read_bytes()
    for number in (1, 2):  # and nothing is ever replaced by such a mesh, with --force neither
        assert (
            exit_code("mesh", folder / "a.nii.gz", "-o", tmp_path / "a.inp", *options, "--force")
            == 2
        )
        assert str(tmp_path / f"a_optimised_{number}.vtu") in capsys.readouterr().err
    assert (tmp_path / "a.vtu").read_bytes() == before


def test_loads_on_what_only_the_final_mesh_may_have_are_no_early_error(folder, tmp_path):
    """On an interface of labels, or a set that is asked for; but a set that can never be is one."""
    base = [
        "mesh",
        folder / "a.nii.gz",
        "--labels",
        folder / "l.nii.gz",
        "--young",
        "2",
        "--iterations",
        "1",
    ]
    loads = ["--load", "hold:interface_0_1", "--load", "move:inferior:1,0,0"]
    assert exit_code(*base, "--nodes", "300", "-o", tmp_path / "a.inp", *loads) == 0
    loads = [
        "--set",
        "top=plane:0,0,118:0,0,1:9",
        "--load",
        "hold:top",
        "--load",
        "move:inferior:1,0,0",
    ]
    assert exit_code(*base, "--nodes", "90", "-o", tmp_path / "b.inp", *loads) == 0
    for wrong in (
        ["--load", "move:nosuch:1,0,0"],
        ["--load", "compress:99%"],
        ["--set", "left=below:20"],
    ):
        assert exit_code(*base, "--nodes", "90", "-o", tmp_path / "c.inp", *loads, *wrong) == 2
    assert {path.name for path in tmp_path.iterdir()} == {"a.inp", "b.inp"}


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
def test_loads_of_all_kinds_density_and_moduli_at_nodes_go_on(folder, tmp_path, units, in_units):
    """Through other units and LPS and back, into the same CalculiX file as from the first one."""
    words = [
        *("hold:superior", "spring:left:0.5", "1/pressure:inferior:0.25", "1/gravity:0,8,-9810"),
        *("2/traction:inferior:0.5,-2,0.125", "2/move:inferior:free,1,free"),
    ]
    loads = [part for word in words for part in ("--load", word)]
    mapping = [
        "--young",
        MAPPING,
        "--density",
        "1000 + h",
        "--average",
        "nodes",
        "--image",
        folder / "a.nii.gz",
    ]
    first, second = tmp_path / "a.vtu", tmp_path / "b.vtu"
    assert exit_code("convert", folder / "a.vtu", first, *mapping, *loads) == 0
    assert exit_code("convert", first, second, "--units", units, "--space", "lps") == 0
    texts = [json.loads(tetopt.load_mesh(path).text("loads")) for path in (first, second)]
    assert texts[1][1:4] == in_units
    size = 1e-3 if units == "Pa" else 1.0
    np.testing.assert_allclose(
        pyvista.read(second).points * [-1, -1, 1],
        pyvista.read(first).points * size,
        rtol=1e-14,
        atol=1e-300,
    )
    assert exit_code("convert", second, tmp_path / "c.vtu") == 0
    again, before = tetopt.load_mesh(tmp_path / "c.vtu"), tetopt.load_mesh(first)
    np.testing.assert_allclose(
        again.point_data["young_nodes"], before.point_data["young_nodes"], rtol=1e-14
    )
    np.testing.assert_array_equal(again.cell_data["density"], before.cell_data["density"])
    assert again.cell_data["density"].min() >= 1000.0
    for kept, text in zip(json.loads(again.text("loads")), texts[0], strict=True):
        (load, original) = (parse_load(words, 3) for words in (kept, text))
        assert (load.kind, load.set_name, load.step) == (
            original.kind,
            original.set_name,
            original.step,
        )
        np.testing.assert_allclose(load.numbers, original.numbers, rtol=1e-14)
    for name, path in (("c.inp", tmp_path / "c.vtu"), ("first.inp", first)):
        assert exit_code("convert", path, tmp_path / name) == 0
    steps = [(tmp_path / name).read_text().partition("*STEP")[2] for name in ("c.inp", "first.inp")]
    assert steps[0].count("*STEP") == 1
    assert "*INITIAL CONDITIONS, TYPE=TEMPERATURE" in (tmp_path / "c.inp").read_text()
    numbers = [np.array(re.findall(r"-?\d+\.\d+(?:e-?\d+)?", step), dtype=float) for step in steps]
    np.testing.assert_allclose(*numbers, rtol=1e-12)
    # Other moduli take the place of those at the nodes.
    assert exit_code("convert", first, tmp_path / "d.vtu", "--bins", "3") == 0
    assert "young_nodes" not in tetopt.load_mesh(tmp_path / "d.vtu").point_data


def test_large_deformation_and_means_over_cells_are_said(folder, tmp_path, capsys):
    mapping = [
        "--young",
        MAPPING,
        "--average",
        "nodes",
        "--image",
        folder / "a.nii.gz",
        "--load",
        "compress:5%",
    ]
    assert exit_code("convert", folder / "a.vtu", tmp_path / "a.inp", *mapping, "--nonlinear") == 0
    assert "*STEP, NLGEOM" in (tmp_path / "a.inp").read_text()
    assert "linear within cells" in capsys.readouterr().out
    assert exit_code("convert", folder / "a.vtu", tmp_path / "a.feb", *mapping) == 0
    assert "one modulus per cell: the mean" in capsys.readouterr().out


@pytest.mark.parametrize("text", ['[["left", null]]', "[" * 100_000, "3"])
def test_loads_of_another_kind_in_a_file_are_left(folder, tmp_path, text):
    grid = pyvista.read(folder / "a.vtu")
    grid.field_data["loads"] = np.frombuffer(text.encode(), dtype=np.uint8)
    grid.save(tmp_path / "a.vtu")
    assert exit_code("convert", tmp_path / "a.vtu", tmp_path / "b.inp", "--young", "2") == 0
    assert "*STEP" not in (tmp_path / "b.inp").read_text()


def test_loads_run_or_are_said_to_be_in_comments(folder, tmp_path, capsys):
    for suffix in (".inp", ".feb", ".xdmf"):
        options = ["--young", "3", "--load", "compress:5%"]
        assert exit_code("convert", folder / "a.vtu", tmp_path / f"a{suffix}", *options) == 0
        is_said = "the format defines no analysis step" in capsys.readouterr().out
        assert is_said == (suffix == ".xdmf"), suffix


def test_numbers_of_loads_are_printed_without_rounding_errors_and_kept_with_them(
    folder, tmp_path, capsys
):
    options = [
        "--young",
        "3",
        "--load",
        "hold:inferior",
        "--load",
        f"move:superior:0,0,{0.1 * 3!r}",
    ]
    assert exit_code("convert", folder / "a.vtu", tmp_path / "b.vtu", *options) == 0
    assert "\nload: move:superior:0.0,0.0,0.3\n" in capsys.readouterr().out
    model = tetopt.build_model(tetopt.load_mesh(tmp_path / "b.vtu"))
    assert model.loads[1].numbers.tolist() == [0.0, 0.0, 0.1 * 3]
    assert "move:superior:0.0,0.0,0.3<" in model._repr_html_()


# Bad input: one line, exit 2, nothing left behind


@pytest.mark.parametrize(
    ("out", "more", "match"),
    [
        ("a.foo", [], "unknown suffix; known suffixes are .vtu (VTK, ParaView), .vtk"),
        ("a.inp", ["--young", "1 + x"], 'cannot use "x"'),
        (
            "a.inp",
            ["--young", "0:1,100:5,50:3"],
            "--young: intensities must increase, got 100 and then 50",
        ),
        ("a.inp", ["--young", "2", "--nu", "0:x"], "--nu: expected pairs intensity:value"),
        (
            "a.inp",
            ["--young", "h+1", "--average", "gauss"],
            "--average: gauss averages over voxels and needs an image; pass",
        ),
        ("a.inp", ["--young", "0"], "young: expected moduli above 0 kPa"),
        ("a.inp", ["--young", "2", "--nu", "0.5"], "-1 < nu < 0.5"),
        ("a.inp", ["--nu", "0.3"], "--nu: needs --young"),
        ("a.inp", ["--young", "1=2"], "the mesh also has 0 (1 more)"),
        ("a.inp", ["--crop", "1:3,:,:"], "--crop: needs --image"),
        ("a.inp", ["--registered"], "--registered: needs --image"),
        (
            "a.inp",
            ["--young", "2", "--load", "gravity:0,0,-9810"],
            "gravity: the cells have no density",
        ),
        ("a.vtu", ["--young", "2", "--nonlinear"], "--nonlinear is for .inp, .feb only"),
        ("a.inp", ["--young", "2", "--load", "pressure:nowhere:1"], 'no set of facets "nowhere"'),
        ("a.inp", ["--young", "2", "--load", "pressure:interface_0_1:1"], "lie between two cells"),
        ("a.inp", ["--bins", "4"], "no moduli to group"),
        ("a.inp", ["--average", "mean"], "--average: needs --young"),
        (
            "a.inp",
            ["--young", "h+1", "--average", "voigt"],
            "average: expected mean, geometric, harmonic, hill",
        ),
        ("a.inp", ["--young", "h+1", "--bins", "0"], "--bins: expected K"),
        (
            "a.inp",
            ["--fields", "mean"],
            "--fields: expected none, mean, all and a file .vtu, .vtk, .xdmf, .msh",
        ),
        ("a.vtu", ["--fields", "some"], "--fields: expected none, mean, all"),
        ("a.inp", ["--units", "psi"], "--units: expected one of kPa, MPa, Pa, got psi"),
        ("a.inp", ["--space", "xyz"], "--space: expected ras or lps"),
        ("a.inp", ["--order", "3"], "--order: expected 1 or 2"),
        ("a.stl", ["--order", "2"], "--order 2 is for .vtu, .vtk, "),
        ("a.inp", ["--load", "compress:5%"], "loads need materials"),
        ("a.inp", ["--set", "x=above:3"], "expected NAME=below:T"),
        ("a.feb", [], "needs a material; give a modulus mapping (--young)"),
        ("a.stl", ["--young", "2"], "contains only the boundary"),
        ("a.inp", ["--mask", "m.nii.gz"], "--mask: needs --image"),
    ],
)
def test_conversions_that_are_refused(folder, tmp_path, out, more, match, capsys):
    assert exit_code("convert", folder / "a.vtu", tmp_path / out, *more) == 2
    said = capsys.readouterr().err
    assert match in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_mesh_whose_cells_are_there_several_times_is_no_solver_s(folder, tmp_path, capsys):
    mesh = tetopt.load_mesh(folder / "a.vtu").mesh
    tetopt.save_mesh(
        tmp_path / "thrice.vtu",
        tetopt.Mesh(mesh.points, np.vstack([mesh.cells, mesh.cells[[5, 5]]])),
    )
    assert exit_code("convert", tmp_path / "thrice.vtu", tmp_path / "out.inp") == 2
    assert re.search(r"thrice\.vtu: at \d+ facets cells overlap", capsys.readouterr().err)
    assert not (tmp_path / "out.inp").exists()


def test_what_will_not_do_is_said_before_the_optimisation(folder, tmp_path, capsys):
    for out, more in (
        ("a.inp", ["--young", "h - 20"]),
        ("a.inp", ["--young", "2", "--load", "hold:skin"]),
        ("a.inp", ["--load", "compress:5%"]),
        ("a.feb", []),
        ("a.inp", ["--set", "foo"]),
        ("a.inp", ["--set", "low=below:-5"]),
        ("a.inp", ["--set", "low=below:20", "--young", "h - 20"]),
        ("a.inp", ["--set", "all_cells=below:20", "--young", "2"]),
        (
            "a.inp",
            ["--labels", folder / "l.nii.gz", "--young", "2", "--load", "pressure:interface_0_1:1"],
        ),
    ):
        assert (
            exit_code("mesh", folder / "a.nii.gz", "-o", tmp_path / out, "--spacing", "8", *more)
            == 2
        )
        said = capsys.readouterr().err
        assert said.count("\n") == 1, said
    for out in ("a.inp", "a.feb", "a.stl"):
        more = [] if out == "a.stl" else ["--young", "2"]
        assert (
            exit_code(
                "mesh",
                folder / "a.nii.gz",
                "--slice",
                "k=3",
                "-o",
                tmp_path / out,
                "--nodes",
                "60",
                *more,
            )
            == 2
        )
        assert "triangles" in capsys.readouterr().err
    flat = [
        "mesh",
        folder / "a.nii.gz",
        "--slice",
        "k=3",
        "-o",
        tmp_path / "a.vtu",
        "--nodes",
        "60",
    ]
    assert exit_code(*flat, "--space", "lps") == 2
    assert "omit --space" in capsys.readouterr().err
    assert (
        exit_code(
            "mesh",
            folder / "a.nii.gz",
            "--target-error",
            "0.3",
            "-o",
            tmp_path / "a.inp",
            "--load",
            "foo",
        )
        == 2
    )
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


# Surfaces


@pytest.mark.parametrize(("what", "suffix"), [("below", "stl"), ("label", "ply"), ("set", "stl")])
def test_the_surface_of_a_structure(folder, tmp_path, what, suffix, capsys):
    loaded = tetopt.load_mesh(folder / "a.vtu")
    chosen = {
        "below": largest_component(loaded.mesh.cells, loaded.cell_data["mean"] < 12),
        "label": np.flatnonzero(loaded.cell_data["label"] == 1),
        "set": loaded.sets.cells["label_0"],
    }[what]
    value = {"below": "12", "label": "1", "set": "label_0"}[what]
    out = tmp_path / f"s.{suffix}"
    assert (
        exit_code(
            "surface",
            folder / "a.vtu",
            f"--{what}",
            value,
            "-o",
            out,
            "--json",
            tmp_path / "s.json",
        )
        == 0
    )
    said = capsys.readouterr().out
    assert "watertight, normals out" in said
    surface = trimesh.load_mesh(out)
    assert surface.is_watertight
    assert surface.volume == pytest.approx(loaded.cell_data["volume"][chosen].sum(), rel=1e-3)
    numbers = numbers_in(tmp_path / "s.json")
    assert numbers["volume_mm3"] == pytest.approx(surface.volume)
    assert numbers["area_mm2"] == pytest.approx(surface.area)
    assert f"{surface.volume:.6g}" in said
    assert f"{surface.area:.6g}" in said


@pytest.mark.parametrize(
    ("more", "match"),
    [
        ([], "one of --below, --label, --set, --boundary, --interface"),
        (["--below", "-3"], "no cell has a mean below -3"),
        (["--label", "7"], "no cell has label 7; the mesh has 0, 1"),
        (["--set", "skin"], 'no cell set "skin"; it has label_0, label_1'),
        (["--label", "1", "--space", "x"], "expected ras or lps"),
        (["--interfaces"], "STL cannot store the labels of triangles; use .ply or .vtp or .vtk"),
        (["--interface", "0"], 'two labels as J,K, by number or name, got "0"'),
        (["--interface", "1,1"], 'two different labels, got "1,1"'),
        (["--interface", "0,7"], "no facet lies between labels 0 and 7"),
    ],
)
def test_surfaces_that_are_refused(folder, tmp_path, more, match, capsys):
    assert exit_code("surface", folder / "a.vtu", "-o", tmp_path / "s.stl", *more) == 2
    assert match in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_field_that_is_not_there(folder, tmp_path, capsys):
    tetopt.save_mesh(tmp_path / "bare.vtu", tetopt.load_mesh(folder / "a.vtu").mesh)
    for more in (["--below", "3"], ["--label", "1"], ["--interface", "0,1"]):
        assert exit_code("surface", tmp_path / "bare.vtu", "-o", tmp_path / "s.stl", *more) == 2
        assert "; it has none" in capsys.readouterr().err
    assert exit_code("surface", folder / "a.vtu", "-o", tmp_path / "s.obj", "--label", "1") == 2
    assert "ending in .stl or .ply or .vtp or .vtk" in capsys.readouterr().err


# Looking


def test_a_page_to_look_at(folder, tmp_path, capsys):
    options = ["--image", folder / "a.nii.gz", "--html", tmp_path / "a.html"]
    assert exit_code("view", folder / "a.vtu", *options) == 0
    page = (tmp_path / "a.html").read_text()
    assert "self-contained" in capsys.readouterr().out
    assert "interface_0_1" in page
    assert "min_dihedral" in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert exit_code("view", folder / "a.vtu", "--html", tmp_path / "a.html") == 2
    assert exit_code("view", folder / "a.vtu", "--html", tmp_path / "a.png") == 2


def test_a_page_opens_on_the_field_and_the_range_asked_for(folder, tmp_path, capsys):
    words = ["view", folder / "a.vtu", "--html", tmp_path / "a.html"]
    assert exit_code(*words, "--field", "rho", "--range", "0.1,0.3") == 0
    data = json.loads(
        re.search(r'id="data">(.*?)</script>', (tmp_path / "a.html").read_text(), re.DOTALL).group(
            1
        )
    )
    assert (data["fields"][0]["name"], data["fields"][0]["limits"]) == ("rho", [0.1, 0.3])
    capsys.readouterr()
    for options, message in (
        (["--field", "young"], '--field: the mesh has no field "young"; it has mean'),
        (["--range", "3"], "--range: expected LOW,HIGH, such as 0,120"),
        (["--range", "low,3"], '--range: expected a number, got "low"'),
        (["--range", "3,2"], "--range: expected LOW,HIGH with LOW below HIGH"),
    ):
        assert exit_code(*words[:3], tmp_path / "b.html", *options) == 2
        assert message in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["a.html"]


@pytest.mark.parametrize(("display", "answer"), [("", True), (":0", False), (":0", True)])
def test_the_page_is_opened_or_it_is_said_where_it_is(
    folder, tmp_path, monkeypatch, capsys, display, answer
):
    """Never a browser of the terminal's, which would take it over."""
    opened = []
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(webbrowser, "open", lambda address: [opened.append(address), answer][1])
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert exit_code("view", folder / "a.vtu") == 0
    (page,) = tmp_path.rglob("*.html")
    said = "".join(capsys.readouterr().out.split())
    words = "opened in the browser" if display and answer else "open it in a browser"
    assert f"{page}: {words};".replace(" ", "") in said
    assert opened == ([page.as_uri()] if display else [])
    monkeypatch.undo()
    assert exit_code("view", folder / "a.vtu", "--html", tmp_path / "b.html") == 0
    assert page.read_bytes() == (tmp_path / "b.html").read_bytes()


def test_the_air_around_is_said_of_a_surface(folder, tmp_path, capsys):
    mean = tetopt.load_mesh(folder / "a.vtu").cell_data["mean"]
    threshold = float(np.median(mean))
    assert (
        exit_code("surface", folder / "a.vtu", "-o", tmp_path / "a.stl", "--below", threshold) == 0
    )
    assert "touches the box's faces left" in capsys.readouterr().err
    assert exit_code("surface", folder / "a.vtu", "-o", tmp_path / "b.stl", "--label", "1") == 0
    assert "touches" not in capsys.readouterr().err


def test_a_table_of_other_labels_is_said(folder, tmp_path, capsys):
    table = tmp_path / "names.csv"
    for text, is_said in (
        ("label,name\n7,liver\n", True),
        ("label,name\n7,liver\n1,lung\n", False),
    ):
        table.write_text(text)
        for words in (
            ["view", folder / "a.vtu", "--html", tmp_path / "a.html"],
            [
                "quality",
                folder / "a.vtu",
                "--image",
                folder / "a.nii.gz",
                "--labels",
                folder / "l.nii.gz",
            ],
        ):
            force = [] if words[0] == "quality" else ["--force"]
            assert exit_code(*words, *force, "--label-names", table) == 0
            assert (
                "contains none of the mesh's labels, 0, 1" in capsys.readouterr().err
            ) == is_said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--slice", "k=99"], "a.nii.gz: --slice: expected an index from"),
        (["--nodes", "6"], "tetopt: --nodes: expected a whole number of nodes"),
        (["--load", "hold:nowhere", "--young", "2"], 'tetopt: --load: no set of facets "nowhere"'),
        (["--edge-size", "-1"], "tetopt: --edge-size: expected a length above 0 mm"),
    ],
)
def test_refusals_name_the_option_that_was_given(folder, tmp_path, options, said, capsys):
    assert exit_code("mesh", folder / "a.nii.gz", "-o", tmp_path / "a.vtu", *options) == 2
    assert said in capsys.readouterr().err
