"""Labels by name, and the sets that a file gets, as a user types them."""

import json
from pathlib import Path

import nibabel
import numpy as np
import PIL.Image
import pytest
import pyvista
from commands import (
    assert_done,
    assert_refused,
    exit_code,
    in_copy_of,
    labelled_lattice_words,
    numbers_in,
)
from numpy.testing import assert_array_equal

import tetopt
from tetopt import load_mesh
from tetopt.contents.labels import BACKGROUND_COLOUR, LABEL_PALETTE, hex_colour
from tetopt.job.solver_files import MANY_INTERFACES

pytestmark = pytest.mark.full

TABLE = "label,name,color\n0,soft tissue,\n1,bright/ball [é],#ff8000\n9,spleen,#00ff00\n"
FACES = {"boundary", "left", "right", "posterior", "anterior", "inferior", "superior"}
INTERFACE = "interface_soft_tissue_bright_ball_e"


here = in_copy_of("folder")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An image, its labels, a table of them, and a lattice of 60 nodes with and without names."""
    path = tmp_path_factory.mktemp("labels")
    mesh = labelled_lattice_words(path)
    (path / "t.csv").write_text(TABLE, encoding="utf-8")
    assert_done(*mesh, "-o", path / "plain.vtu")
    named = ["--label-names", path / "t.csv", "--json", path / "named.json"]
    assert_done(*mesh, "-o", path / "named.vtu", *named)
    return path


def refused(capsys, *words):
    """What the command says of words that it refuses."""
    capsys.readouterr()
    assert exit_code(*words) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_a_mesh_s_file_keeps_the_table():
    loaded, plain = (load_mesh(name) for name in ("named.vtu", "plain.vtu"))
    table = loaded.label_table
    assert table.names == {0: "soft tissue", 1: "bright/ball [é]", 9: "spleen"}
    grey = hex_colour(BACKGROUND_COLOUR)
    assert table.colours == {0: grey, 1: (1.0, 128 / 255, 0.0), 9: (0.0, 1.0, 0.0)}
    assert set(loaded.sets.cells) == {"soft_tissue", "bright_ball_e"}
    assert set(loaded.sets.facets) == {*FACES, INTERFACE}
    assert_array_equal(loaded.sets.facets[INTERFACE], plain.sets.facets["interface_0_1"])
    assert plain.label_table == ({}, {0: grey, 1: hex_colour(LABEL_PALETTE[0])})
    numbers = numbers_in("named.json")
    assert numbers["label_names"] == {"0": "soft tissue", "1": "bright/ball [é]"}
    assert list(numbers["label_table"]) == ["0", "1"]  # those that the image has


@pytest.mark.deep
def test_a_label_has_one_colour_in_pictures_page_and_file():
    """Without a table of colours, and with one."""
    words = "mesh a.nii.gz --labels l.nii.gz --spacing 8 --iterations 0"
    for more, colour in (("", LABEL_PALETTE[0]), ("--label-names t.csv", "#ff8000")):
        assert_done(f"{words} {more} -o a.vtu --figures r --force")
        assert_done("convert a.vtu b.vtu --force")
        for name in ("a.vtu", "b.vtu"):
            assert load_mesh(name).label_table.colours[1] == hex_colour(colour)
        picture = np.asarray(PIL.Image.open("r/labels.png"))[..., :3].reshape(-1, 3)
        tones = np.rint(255.0 * np.array(hex_colour(colour)))
        assert (np.abs(picture - tones).max(axis=1) <= 1).sum() > 1000
        assert_done("view b.vtu --html v.html --force")
        assert f'[1, "{colour}"]' in Path("v.html").read_text()


def test_the_table_prints_names(capsys):
    words = "--image a.nii.gz --labels l.nii.gz"
    for mesh, more in (("named.vtu", ""), ("plain.vtu", "--label-names t.csv")):
        assert_done(f"quality {mesh} {words} {more} --json q.json")
        assert "1 bright/ball [é]" in capsys.readouterr().out
        assert numbers_in("q.json")["label_names"] == {
            "0": "soft tissue",
            "1": "bright/ball [é]",
        }
        Path("q.json").unlink()
    assert_done(f"quality plain.vtu {words}")
    assert "bright" not in capsys.readouterr().out


def test_a_label_without_cells_is_named(capsys):
    labels = tetopt.load_image("l.nii.gz")
    data = labels.data.copy()
    data[1, 1, 1] = 9.0
    tetopt.save_image("l.nii.gz", tetopt.Image(data, labels.affine))
    words = "mesh a.nii.gz --labels l.nii.gz --label-names t.csv"
    assert_done(f"{words} --spacing 8 --iterations 0 --free-volumes -o a.vtu")
    assert (
        "no cell has label 9 (spleen), of fewer than 200 voxels in the mesh"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize("mesh", ["named.vtu", "plain.vtu"])
def test_mappings_and_loads_by_name(mesh, capsys):
    more = [] if mesh == "named.vtu" else ["--label-names t.csv"]
    young = "--young 'bright/ball [é]=5,spleen=3,*=20' --nu Bright_Ball_E=0.3,*=0.4"
    assert_done(
        f"convert {mesh} a.vtu {young} --load hold:{INTERFACE} --load pressure:inferior:1", *more
    )
    said = capsys.readouterr().out
    assert "  5 kPa, nu 0.3: bright/ball [é]\n  20 kPa, nu 0.4: soft tissue\n" in said
    loaded = load_mesh("a.vtu")
    is_bright = loaded.cell_data["label"] == 1
    assert_array_equal(loaded.cell_data["young"], np.where(is_bright, 5.0, 20.0))
    assert_array_equal(loaded.cell_data["nu"], np.where(is_bright, 0.3, 0.4))
    assert set(loaded.sets.facets) == {*FACES, INTERFACE}
    assert set(loaded.sets.cells) == {"soft_tissue", "bright_ball_e"}
    # by what the file keeps
    assert_done("convert a.vtu b.inp")
    text = Path("b.inp").read_text()
    assert f"*NSET, NSET={INTERFACE}\n" in text
    assert "ELSET=bright_ball_e\n" in text
    assert "label_1" not in text
    assert_done("fem a.vtu -o s.vtu --json s.json")
    assert INTERFACE in numbers_in("s.json")["steps"][0]["reactions"]
    assert load_mesh("s.vtu").label_table.names[9] == "spleen"


def test_an_improved_mesh_keeps_the_names(capsys):
    assert_done("mesh a.nii.gz --labels l.nii.gz --iterations 0 --start named.vtu -o a.vtu")
    loaded = load_mesh("a.vtu")
    assert loaded.label_table.names[9] == "spleen"
    assert set(loaded.sets.cells) == {"soft_tissue", "bright_ball_e"}
    assert "dropped sets" not in capsys.readouterr().err


def test_another_table_renames():
    Path("other.csv").write_text("label,name\n1,ball\n")
    assert_done("convert named.vtu a.vtu --label-names other.csv")
    loaded = load_mesh("a.vtu")
    assert set(loaded.sets.cells) == {"label_0", "ball"}
    assert set(loaded.sets.facets) == {*FACES, "interface_0_ball"}


def test_loads_of_a_file_keep_the_set_that_they_name():
    assert_done(
        "convert plain.vtu a.vtu --young 5 --load hold:interface_0_1 --load pressure:left:1"
    )
    assert_done("convert a.vtu b.vtu --label-names t.csv")
    loaded = load_mesh("b.vtu")
    assert set(loaded.sets.facets) == {*FACES, INTERFACE, "interface_0_1"}
    assert "hold:interface_0_1" in json.loads(loaded.text("loads"))
    assert_done("fem b.vtu")


def test_surface_and_view_by_name():
    for number, word in enumerate(("1", "'bright/ball [é]'", "bright_ball_e")):
        assert_done(f"surface named.vtu -o {number}.stl --label {word}")
    first, *others = (Path(f"{number}.stl").read_bytes()[80:] for number in range(3))
    assert others == [first, first]
    assert_done("view named.vtu --html v.html")
    page = Path("v.html").read_text(encoding="utf-8")
    assert INTERFACE in page
    assert "interface_0_1" not in page


def test_what_is_refused(capsys):
    mesh, out = "named.vtu", "a.vtu"
    assert_refused(
        capsys,
        f"convert {mesh} {out} --young 'bright ball=5,*=20'",
        'label "bright ball": no label has this name; did you mean bright_ball_e',
    )
    assert_refused(
        capsys,
        f"convert plain.vtu {out} --young liver=5,*=20",
        "labels have no names; give a table of names (--label-names)",
    )
    assert_refused(
        capsys,
        f"surface {mesh} -o a.stl --label spleen",
        "no cell has label 9 (spleen); the mesh has 0 (soft tissue), 1 (bright/ball [é])",
    )
    assert_refused(
        capsys,
        f"convert {mesh} {out} --young 5 --load hold:interface_soft_tissue_bright_ball",
        f"did you mean {INTERFACE}?",
    )
    other = "hold:interface_bright_ball_e_soft_tissue"
    # the same nodes from the other side
    assert_done(f"convert {mesh} {out} --young 5 --load {other}")
    assert json.loads(load_mesh(out).text("loads")) == [f"hold:{INTERFACE}"]
    Path(out).unlink()
    plan = f"mesh a.nii.gz -o {out} --spacing 8 --iterations 0 --label-names t.csv"
    needs = "--label-names: needs --labels"
    assert_refused(capsys, plan, needs)
    assert_refused(capsys, f"{plan} --labels l.nii.gz --young splen=5,*=20", "did you mean spleen")
    assert_refused(capsys, f"quality {mesh} --label-names t.csv", needs)
    assert_refused(capsys, "compare a.nii.gz -o c --label-names t.csv", needs)
    Path("bad.csv").write_text("label,name\n1,a\n1,b\n")
    for words in (
        f"convert {mesh} {out}",
        f"fem {mesh} --young 1 --load compress:1%",
        f"view {mesh} --html a.html",
    ):
        assert_refused(capsys, f"{words} --label-names bad.csv", "bad.csv, line 3: label 1")


# The sets that a file gets


@pytest.mark.parametrize(
    ("words", "facets", "cells"),
    [
        ("--sets all", {*FACES, "interface_0_1"}, {"label_0", "label_1"}),
        ("", {*FACES, "interface_0_1"}, {"label_0", "label_1"}),
        ("--sets none", set(), set()),
        ("--sets labels", set(), {"label_0", "label_1"}),
        ("--sets 'interfaces, boundary'", {*FACES, "interface_0_1"}, set()),
        ("--sets none --set dark=below:20", {"dark_surface"}, {"dark"}),
        (
            "--sets none --young 5 --load hold:interface_0_1 --load pressure:left:1",
            {"interface_0_1", "left"},
            set(),
        ),
    ],
)
def test_chosen_sets(capsys, words, facets, cells):
    assert_done(f"convert plain.vtu a.vtu {words} --json a.json")
    loaded = load_mesh("a.vtu")
    assert set(loaded.sets.facets) == facets
    assert set(loaded.sets.cells) == cells
    assert set(numbers_in("a.json")["sets"]["facets"]) == facets
    assert {name for name in pyvista.read("a.vtu").point_data if name.startswith("on_")} == {
        f"on_{each}" for each in facets
    }
    assert "not written as sets" not in capsys.readouterr().err
    assert_done(
        f"mesh a.nii.gz --labels l.nii.gz --spacing 8 --iterations 0 -o a.vtu --force {words}"
    )
    assert set(load_mesh("a.vtu").sets.facets) == facets
    if "--load" in words:
        assert_done("fem a.vtu -o s.vtu --sets labels")
        solved = load_mesh("s.vtu").sets
        assert (set(solved.facets), set(solved.cells)) == (facets, {"label_0", "label_1"})


def test_sets_that_are_none(capsys):
    assert_refused(
        capsys,
        "convert plain.vtu a.vtu --sets labels,faces",
        '--sets: expected some of labels, interfaces, boundary, or all, or none, got "faces"',
    )

    assert_refused(
        capsys,
        "fem plain.vtu --young 1 --load compress:5% --sets all",
        "--sets: no file is written; add -o",
    )


def test_many_interfaces_are_not_written_into_vtu(capsys):
    loaded = load_mesh("plain.vtu")
    labels = np.arange(len(loaded.mesh.cells)) % 60
    tetopt.save_mesh("many.vtu", loaded.mesh, {"label": labels})
    assert_done("convert many.vtu a.vtu")
    said, kept = capsys.readouterr().err, load_mesh("a.vtu").sets
    assert "interfaces are not written as sets (--sets all writes them)" in said
    assert not [name for name in kept.facets if name.startswith("interface_")]
    assert len(kept.cells) == 60
    assert_done("convert many.vtu all.vtu --sets all")
    every = load_mesh("all.vtu").sets.facets
    assert len(every) > MANY_INTERFACES + 7
    # they are there anyway
    assert_done("convert a.vtu b.inp --young 1")
    name = list(every)[-1]
    assert f"NSET={name}\n" in Path("b.inp").read_text()
    assert_done(f"convert a.vtu a2.vtu --young 1 --load hold:{name} --force")
    Path("some.csv").write_text("label,name\n1,liver\n")
    named = "--label-names some.csv --young liver=5,*=2 --sets none"
    capsys.readouterr()
    assert_done(f"convert a.vtu c.inp {named}")
    assert (
        "\n  2 kPa, nu 0.45: 0, 2, 3, 4, 5, 6, 7, 8 and 51 more\n  5 kPa, nu 0.45: liver\n"
        in capsys.readouterr().out
    )
    assert_done("convert named.vtu d.inp --young 1+0.1*h")
    assert ", nu 0.45: " not in capsys.readouterr().out  # a label is of many materials
    assert [each for each in load_mesh("a2.vtu").sets.facets if "interface" in each] == [name]


def test_one_label_that_is_image_and_labels_is_reported_once_and_without_empty_tables(capsys):
    ball = (np.linalg.norm(np.indices((16, 16, 16)) - 7.5, axis=0) < 5.0).astype(np.uint8)
    image = nibabel.Nifti1Image(ball, np.eye(4))
    image.header["xyzt_units"] = 5
    nibabel.save(image, "ball.nii")
    words = "mesh ball.nii --labels ball.nii --background 0 --nodes 400 --iterations 2 -o a.vtu"
    assert_done(words)
    out, err = capsys.readouterr()
    assert err.count("its unit of length has the unknown code 5") == 1
    assert_done("quality a.vtu --image ball.nii --labels ball.nii")
    again = capsys.readouterr().out
    for text in (out, again):
        assert "thin labels" not in text
        assert "contact" not in text
        assert "the foreground's surface" in text
        assert "the mask's surface" not in text
    counts = [
        [
            line.split()[-1]
            for line in text.splitlines()
            if line.startswith("cells without a voxel centre")
        ]
        for text in (out, again)
    ]
    assert counts[0] == counts[1] != []
