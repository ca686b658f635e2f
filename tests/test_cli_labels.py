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
    in_copy_of,
    labelled_lattice_words,
    numbers_in,
    refusals,
    run_command,
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
LATTICE = "mesh a.nii.gz --labels l.nii.gz --spacing 8 --iterations 0"


here = in_copy_of("folder")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An image, its labels, tables of them, and a lattice of 60 nodes with and without names."""
    path = tmp_path_factory.mktemp("labels")
    mesh = labelled_lattice_words(path)
    (path / "t.csv").write_text(TABLE, encoding="utf-8")
    (path / "bad.csv").write_text("label,name\n1,a\nx,b\n")
    assert_done(*mesh, f"-o {path}/plain.vtu")
    names = f"--label-names {path}/t.csv --json {path}/named.json"
    assert_done(*mesh, f"-o {path}/named.vtu {names}")
    return path


def sets_in(path):
    """The names of sets of facets and of cells."""
    sets = load_mesh(path).sets
    return set(sets.facets), set(sets.cells)


NAMED = {*FACES, INTERFACE}, {"soft_tissue", "bright_ball_e"}


def test_a_mesh_s_file_keeps_the_table():
    loaded, plain = (load_mesh(name) for name in ("named.vtu", "plain.vtu"))
    grey = hex_colour(BACKGROUND_COLOUR)
    assert loaded.label_table == (
        {0: "soft tissue", 1: "bright/ball [é]", 9: "spleen"},
        {0: grey, 1: (1.0, 128 / 255, 0.0), 9: (0.0, 1.0, 0.0)},
    )
    assert plain.label_table == ({}, {0: grey, 1: hex_colour(LABEL_PALETTE[0])})
    assert sets_in("named.vtu") == NAMED
    assert_array_equal(loaded.sets.facets[INTERFACE], plain.sets.facets["interface_0_1"])
    numbers = numbers_in("named.json")
    assert numbers["label_names"] == {"0": "soft tissue", "1": "bright/ball [é]"}
    assert list(numbers["label_table"]) == ["0", "1"]  # those that the image has


@pytest.mark.deep
def test_a_label_has_one_colour_in_pictures_page_and_file():
    """Without a table of colours, and with one."""
    for more, colour in (("", LABEL_PALETTE[0]), ("--label-names t.csv", "#ff8000")):
        assert_done(f"{LATTICE} {more} -o a.vtu --figures r --force")
        assert_done("convert a.vtu b.vtu --force")
        for name in ("a.vtu", "b.vtu"):
            assert load_mesh(name).label_table.colours[1] == hex_colour(colour)
        picture = np.asarray(PIL.Image.open("r/labels.png"))[..., :3].reshape(-1, 3)
        tones = np.rint(255.0 * np.array(hex_colour(colour)))
        assert (np.abs(picture - tones).max(axis=1) <= 1).sum() > 1000
        assert_done("view b.vtu --html v.html --force")
        assert f'[1, "{colour}"]' in Path("v.html").read_text()


def test_the_table_prints_names():
    for mesh, more, is_named in (
        ("named.vtu", "", True),
        ("plain.vtu", "--label-names t.csv", True),
        ("plain.vtu", "", False),
    ):
        words = f"--image a.nii.gz --labels l.nii.gz {more} --json q.json --force"
        assert ("1 bright/ball [é]" in run_command(f"quality {mesh} {words}").out) == is_named
        names = {"0": "soft tissue", "1": "bright/ball [é]"} if is_named else {}
        assert numbers_in("q.json").get("label_names", {}) == names


def test_a_label_without_cells_is_named():
    labels = tetopt.load_image("l.nii.gz")
    data = labels.data.copy()
    data[1, 1, 1] = 9.0
    tetopt.save_image("l.nii.gz", tetopt.Image(data, labels.affine))
    said = run_command(f"{LATTICE} --label-names t.csv --free-volumes -o a.vtu").err
    assert "no cell has label 9 (spleen), of fewer than 200 voxels in the mesh" in said


@pytest.mark.parametrize("mesh", ["named.vtu", "plain.vtu --label-names t.csv"])
def test_mappings_and_loads_by_name(mesh):
    young = "--young 'bright/ball [é]=5,spleen=3,*=20' --nu Bright_Ball_E=0.3,*=0.4"
    loads = f"--load hold:{INTERFACE} --load pressure:inferior:1"
    name, _, more = mesh.partition(" ")
    said = run_command(f"convert {name} a.vtu {more} {young} {loads}").out
    assert "  5 kPa, nu 0.3: bright/ball [é]\n  20 kPa, nu 0.4: soft tissue\n" in said
    fields = load_mesh("a.vtu").cell_data
    for name, values in (("young", (5.0, 20.0)), ("nu", (0.3, 0.4))):
        assert_array_equal(fields[name], np.where(fields["label"] == 1, *values))
    assert sets_in("a.vtu") == NAMED
    # by what the file keeps
    assert_done("convert a.vtu b.inp")
    text = Path("b.inp").read_text()
    assert f"*NSET, NSET={INTERFACE}\n" in text
    assert "ELSET=bright_ball_e\n" in text
    assert "label_1" not in text
    assert_done("fem a.vtu -o s.vtu --json s.json")
    assert INTERFACE in numbers_in("s.json")["steps"][0]["reactions"]
    assert load_mesh("s.vtu").label_table.names[9] == "spleen"


def test_an_improved_mesh_keeps_the_names():
    words = "mesh a.nii.gz --labels l.nii.gz --iterations 0 --start named.vtu -o a.vtu"
    assert "dropped sets" not in run_command(words).err
    assert load_mesh("a.vtu").label_table.names[9] == "spleen"
    assert sets_in("a.vtu")[1] == NAMED[1]


def test_another_table_renames():
    """But for sets that loads name."""
    Path("other.csv").write_text("label,name\n1,ball\n")
    assert_done("convert named.vtu a.vtu --label-names other.csv")
    assert sets_in("a.vtu") == ({*FACES, "interface_0_ball"}, {"label_0", "ball"})
    loads = "--load hold:interface_0_1 --load pressure:left:1"
    assert_done(f"convert plain.vtu b.vtu --young 5 {loads}")
    assert_done("convert b.vtu c.vtu --label-names t.csv")
    assert sets_in("c.vtu")[0] == {*FACES, INTERFACE, "interface_0_1"}
    assert "hold:interface_0_1" in json.loads(load_mesh("c.vtu").text("loads"))
    assert_done("fem c.vtu")
    # the same nodes from the other side
    other = "hold:interface_bright_ball_e_soft_tissue"
    assert_done(f"convert named.vtu d.vtu --young 5 --load {other}")
    assert json.loads(load_mesh("d.vtu").text("loads")) == [f"hold:{INTERFACE}"]


def test_surface_and_view_by_name():
    files = []
    for word in ("1", "'bright/ball [é]'", "bright_ball_e"):
        assert_done(f"surface named.vtu -o a.stl --force --label {word}")
        files.append(Path("a.stl").read_bytes()[80:])
    assert files[0] == files[1] == files[2]
    assert_done("view named.vtu --html v.html")
    page = Path("v.html").read_text(encoding="utf-8")
    assert INTERFACE in page
    assert "interface_0_1" not in page


test_refused = refusals(
    f"""
convert named.vtu a.vtu --young 'bright ball=5,*=20'
    label "bright ball": no label has this name; did you mean bright_ball_e
convert plain.vtu a.vtu --young liver=5,*=20
    labels have no names; give a table of names (--label-names)
surface named.vtu -o a.stl --label spleen
    no cell has label 9 (spleen); the mesh has 0 (soft tissue), 1 (bright/ball [é])
convert named.vtu a.vtu --young 5 --load hold:interface_soft_tissue_bright_ball
    did you mean {INTERFACE}?
mesh a.nii.gz -o a.vtu --spacing 8 --iterations 0 --label-names t.csv
    --label-names: needs --labels
mesh a.nii.gz -o a.vtu --spacing 8 --label-names t.csv --labels l.nii.gz --young splen=5,*=20
    did you mean spleen
quality named.vtu --label-names t.csv
    --label-names: needs --labels
compare a.nii.gz -o c --label-names t.csv
    --label-names: needs --labels
convert named.vtu a.vtu --label-names bad.csv
    bad.csv
fem named.vtu --young 1 --load compress:1% --label-names bad.csv
    bad.csv
view named.vtu --html a.html --label-names bad.csv
    bad.csv
convert plain.vtu a.vtu --sets labels,faces
    --sets: expected some of labels, interfaces, boundary, or all, or none, got "faces"
fem plain.vtu --young 1 --load compress:5% --sets all
    --sets: no file is written; add -o
"""
)


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
def test_chosen_sets(words, facets, cells):
    said = run_command(f"convert plain.vtu a.vtu {words} --json a.json").err
    assert "not written as sets" not in said
    assert sets_in("a.vtu") == (facets, cells)
    assert set(numbers_in("a.json")["sets"]["facets"]) == facets
    fields = {name for name in pyvista.read("a.vtu").point_data if name.startswith("on_")}
    assert fields == {f"on_{each}" for each in facets}
    assert_done(f"{LATTICE} -o a.vtu --force {words}")
    assert sets_in("a.vtu")[0] == facets
    if "--load" in words:
        assert_done("fem a.vtu -o s.vtu --sets labels")
        assert sets_in("s.vtu") == (facets, {"label_0", "label_1"})


def test_many_interfaces_are_not_written_into_vtu():
    mesh = load_mesh("plain.vtu").mesh
    tetopt.save_mesh("many.vtu", mesh, {"label": np.arange(len(mesh.cells)) % 60})
    said = run_command("convert many.vtu a.vtu").err
    assert "interfaces are not written as sets (--sets all writes them)" in said
    facets, cells = sets_in("a.vtu")
    assert not [name for name in facets if name.startswith("interface_")]
    assert len(cells) == 60
    assert_done("convert many.vtu all.vtu --sets all")
    every = list(load_mesh("all.vtu").sets.facets)
    assert len(every) > MANY_INTERFACES + 7
    # they are there anyway
    assert_done("convert a.vtu b.inp --young 1")
    assert f"NSET={every[-1]}\n" in Path("b.inp").read_text()
    assert_done(f"convert a.vtu a2.vtu --young 1 --load hold:{every[-1]}")
    assert [each for each in sets_in("a2.vtu")[0] if "interface" in each] == [every[-1]]
    Path("some.csv").write_text("label,name\n1,liver\n")
    named = "--label-names some.csv --young liver=5,*=2 --sets none"
    words = "\n  2 kPa, nu 0.45: 0, 2, 3, 4, 5, 6, 7, 8 and 51 more\n  5 kPa, nu 0.45: liver\n"
    assert words in run_command(f"convert a.vtu c.inp {named}").out
    said = run_command("convert named.vtu d.inp --young 1+0.1*h").out
    assert ", nu 0.45: " not in said  # a label is of many materials


def test_one_label_that_is_image_and_labels_is_reported_once_and_without_empty_tables():
    ball = (np.linalg.norm(np.indices((16, 16, 16)) - 7.5, axis=0) < 5.0).astype(np.uint8)
    image = nibabel.Nifti1Image(ball, np.eye(4))
    image.header["xyzt_units"] = 5
    nibabel.save(image, "ball.nii")
    words = "mesh ball.nii --labels ball.nii --background 0 --nodes 400 --iterations 2 -o a.vtu"
    out, err = run_command(words)
    assert err.count("its unit of length has the unknown code 5") == 1
    counts = []
    for text in (out, run_command("quality a.vtu --image ball.nii --labels ball.nii").out):
        for words in ("thin labels", "contact", "the mask's surface"):
            assert words not in text
        assert "the foreground's surface" in text
        (line,) = [each for each in text.splitlines() if "cells without a voxel centre" in each]
        counts.append(line.split()[-1])
    assert counts[0] == counts[1]
