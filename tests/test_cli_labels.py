"""Labels by name, and the sets that a file gets, as a user types them."""

import json

import nibabel
import numpy as np
import PIL.Image
import pytest
import pyvista
from commands import exit_code, labelled_lattice_words, numbers_in

import tetopt
from tetopt.contents.labels import BACKGROUND_COLOUR, LABEL_PALETTE, hex_colour
from tetopt.job.model import MANY_INTERFACES

pytestmark = pytest.mark.full

TABLE = "label,name,color\n0,soft tissue,\n1,bright/ball [é],#ff8000\n9,spleen,#00ff00\n"
FACES = {"boundary", "left", "right", "posterior", "anterior", "inferior", "superior"}
INTERFACE = "interface_soft_tissue_bright_ball_e"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An image, its labels, a table of them, and a lattice of 60 nodes with and without names."""
    path = tmp_path_factory.mktemp("labels")
    mesh = labelled_lattice_words(path)
    (path / "t.csv").write_text(TABLE, encoding="utf-8")
    assert exit_code(*mesh, "-o", path / "plain.vtu") == 0
    named = ["--label-names", path / "t.csv", "--json", path / "named.json"]
    assert exit_code(*mesh, "-o", path / "named.vtu", *named) == 0
    return path


def refused(capsys, *words):
    """What the command says of words that it refuses."""
    capsys.readouterr()
    assert exit_code(*words) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_a_mesh_s_file_keeps_the_table(folder):
    loaded, plain = (tetopt.load_mesh(folder / name) for name in ("named.vtu", "plain.vtu"))
    table = loaded.label_table
    assert table.names == {0: "soft tissue", 1: "bright/ball [é]", 9: "spleen"}
    grey = hex_colour(BACKGROUND_COLOUR)
    assert table.colours == {0: grey, 1: (1.0, 128 / 255, 0.0), 9: (0.0, 1.0, 0.0)}
    assert set(loaded.sets.cells) == {"soft_tissue", "bright_ball_e"}
    assert set(loaded.sets.facets) == {*FACES, INTERFACE}
    np.testing.assert_array_equal(loaded.sets.facets[INTERFACE], plain.sets.facets["interface_0_1"])
    assert plain.label_table == ({}, {0: grey, 1: hex_colour(LABEL_PALETTE[0])})
    numbers = numbers_in(folder / "named.json")
    assert numbers["label_names"] == {"0": "soft tissue", "1": "bright/ball [é]"}
    assert list(numbers["label_table"]) == ["0", "1"]  # those that the image has


@pytest.mark.deep
def test_a_label_has_one_colour_in_pictures_page_and_file(folder, tmp_path):
    """Without a table of colours, and with one."""
    words = [
        "mesh",
        folder / "a.nii.gz",
        "--labels",
        folder / "l.nii.gz",
        "--spacing",
        "8",
        "--iterations",
        "0",
    ]
    for more, colour in (([], LABEL_PALETTE[0]), (["--label-names", folder / "t.csv"], "#ff8000")):
        assert (
            exit_code(
                *words, *more, "-o", tmp_path / "a.vtu", "--figures", tmp_path / "r", "--force"
            )
            == 0
        )
        assert exit_code("convert", tmp_path / "a.vtu", tmp_path / "b.vtu", "--force") == 0
        for name in ("a.vtu", "b.vtu"):
            assert tetopt.load_mesh(tmp_path / name).label_table.colours[1] == hex_colour(colour)
        picture = np.asarray(PIL.Image.open(tmp_path / "r" / "labels.png"))[..., :3].reshape(-1, 3)
        tones = np.rint(255.0 * np.array(hex_colour(colour)))
        assert (np.abs(picture - tones).max(axis=1) <= 1).sum() > 1000
        assert exit_code("view", tmp_path / "b.vtu", "--html", tmp_path / "v.html", "--force") == 0
        assert f'[1, "{colour}"]' in (tmp_path / "v.html").read_text()


def test_the_table_prints_names(folder, capsys):
    words = ["--image", folder / "a.nii.gz", "--labels", folder / "l.nii.gz"]
    for mesh, more in (("named.vtu", []), ("plain.vtu", ["--label-names", folder / "t.csv"])):
        assert exit_code("quality", folder / mesh, *words, *more, "--json", folder / "q.json") == 0
        assert "1 bright/ball [é]" in capsys.readouterr().out
        assert numbers_in(folder / "q.json")["label_names"] == {
            "0": "soft tissue",
            "1": "bright/ball [é]",
        }
        (folder / "q.json").unlink()
    assert exit_code("quality", folder / "plain.vtu", *words) == 0
    assert "bright" not in capsys.readouterr().out


def test_a_label_without_cells_is_named(folder, tmp_path, capsys):
    labels = tetopt.load_image(folder / "l.nii.gz")
    data = labels.data.copy()
    data[1, 1, 1] = 9.0
    tetopt.save_image(tmp_path / "l.nii.gz", tetopt.Image(data, labels.affine))
    words = [
        "mesh",
        folder / "a.nii.gz",
        "--labels",
        tmp_path / "l.nii.gz",
        "--label-names",
        folder / "t.csv",
    ]
    assert (
        exit_code(
            *words,
            "--spacing",
            "8",
            "--iterations",
            "0",
            "--free-volumes",
            "-o",
            tmp_path / "a.vtu",
        )
        == 0
    )
    assert (
        "no cell has label 9 (spleen), of fewer than 200 voxels in the mesh"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize("mesh", ["named.vtu", "plain.vtu"])
def test_mappings_and_loads_by_name(folder, tmp_path, mesh, capsys):
    more = [] if mesh == "named.vtu" else ["--label-names", folder / "t.csv"]
    young = ["--young", "bright/ball [é]=5,spleen=3,*=20", "--nu", "Bright_Ball_E=0.3,*=0.4"]
    load = ["--load", f"hold:{INTERFACE}", "--load", "pressure:inferior:1"]
    assert exit_code("convert", folder / mesh, tmp_path / "a.vtu", *young, *load, *more) == 0
    said = capsys.readouterr().out
    assert "  5 kPa, nu 0.3: bright/ball [é]\n  20 kPa, nu 0.4: soft tissue\n" in said
    loaded = tetopt.load_mesh(tmp_path / "a.vtu")
    is_bright = loaded.cell_data["label"] == 1
    np.testing.assert_array_equal(loaded.cell_data["young"], np.where(is_bright, 5.0, 20.0))
    np.testing.assert_array_equal(loaded.cell_data["nu"], np.where(is_bright, 0.3, 0.4))
    assert set(loaded.sets.facets) == {*FACES, INTERFACE}
    assert set(loaded.sets.cells) == {"soft_tissue", "bright_ball_e"}
    # by what the file keeps
    assert exit_code("convert", tmp_path / "a.vtu", tmp_path / "b.inp") == 0
    text = (tmp_path / "b.inp").read_text()
    assert f"*NSET, NSET={INTERFACE}\n" in text
    assert "ELSET=bright_ball_e\n" in text
    assert "label_1" not in text
    assert (
        exit_code(
            "fem", tmp_path / "a.vtu", "-o", tmp_path / "s.vtu", "--json", tmp_path / "s.json"
        )
        == 0
    )
    assert INTERFACE in numbers_in(tmp_path / "s.json")["steps"][0]["reactions"]
    assert tetopt.load_mesh(tmp_path / "s.vtu").label_table.names[9] == "spleen"


def test_an_improved_mesh_keeps_the_names(folder, tmp_path, capsys):
    words = ["mesh", folder / "a.nii.gz", "--labels", folder / "l.nii.gz", "--iterations", "0"]
    assert exit_code(*words, "--start", folder / "named.vtu", "-o", tmp_path / "a.vtu") == 0
    loaded = tetopt.load_mesh(tmp_path / "a.vtu")
    assert loaded.label_table.names[9] == "spleen"
    assert set(loaded.sets.cells) == {"soft_tissue", "bright_ball_e"}
    assert "dropped sets" not in capsys.readouterr().err


def test_another_table_renames(folder, tmp_path):
    (tmp_path / "other.csv").write_text("label,name\n1,ball\n")
    out = tmp_path / "a.vtu"
    assert (
        exit_code("convert", folder / "named.vtu", out, "--label-names", tmp_path / "other.csv")
        == 0
    )
    loaded = tetopt.load_mesh(out)
    assert set(loaded.sets.cells) == {"label_0", "ball"}
    assert set(loaded.sets.facets) == {*FACES, "interface_0_ball"}


def test_loads_of_a_file_keep_the_set_that_they_name(folder, tmp_path):
    words = ["--young", "5", "--load", "hold:interface_0_1", "--load", "pressure:left:1"]
    assert exit_code("convert", folder / "plain.vtu", tmp_path / "a.vtu", *words) == 0
    named = ["--label-names", folder / "t.csv"]
    assert exit_code("convert", tmp_path / "a.vtu", tmp_path / "b.vtu", *named) == 0
    loaded = tetopt.load_mesh(tmp_path / "b.vtu")
    assert set(loaded.sets.facets) == {*FACES, INTERFACE, "interface_0_1"}
    assert "hold:interface_0_1" in json.loads(loaded.text("loads"))
    assert exit_code("fem", tmp_path / "b.vtu") == 0


def test_surface_and_view_by_name(folder, tmp_path):
    for number, words in enumerate((["1"], ["bright/ball [é]"], ["bright_ball_e"])):
        assert (
            exit_code(
                "surface", folder / "named.vtu", "-o", tmp_path / f"{number}.stl", "--label", *words
            )
            == 0
        )
    first, *others = ((tmp_path / f"{number}.stl").read_bytes()[80:] for number in range(3))
    assert others == [first, first]
    assert exit_code("view", folder / "named.vtu", "--html", tmp_path / "v.html") == 0
    page = (tmp_path / "v.html").read_text(encoding="utf-8")
    assert INTERFACE in page
    assert "interface_0_1" not in page


def test_what_is_refused(folder, tmp_path, capsys):
    mesh, out, names = folder / "named.vtu", tmp_path / "a.vtu", ["--label-names", folder / "t.csv"]
    said = refused(capsys, "convert", mesh, out, "--young", "bright ball=5,*=20")
    assert 'label "bright ball": no label has this name; did you mean bright_ball_e' in said
    said = refused(capsys, "convert", folder / "plain.vtu", out, "--young", "liver=5,*=20")
    assert "labels have no names; give a table of names (--label-names)" in said
    said = refused(capsys, "surface", mesh, "-o", tmp_path / "a.stl", "--label", "spleen")
    assert "no cell has label 9 (spleen); the mesh has 0 (soft tissue), 1 (bright/ball [é])" in said
    said = refused(
        capsys,
        "convert",
        mesh,
        out,
        "--young",
        "5",
        "--load",
        "hold:interface_soft_tissue_bright_ball",
    )
    assert f"did you mean {INTERFACE}?" in said
    other = "hold:interface_bright_ball_e_soft_tissue"
    # the same nodes from the other side
    assert exit_code("convert", mesh, out, "--young", "5", "--load", other) == 0
    assert json.loads(tetopt.load_mesh(out).text("loads")) == [f"hold:{INTERFACE}"]
    out.unlink()
    image, labels = folder / "a.nii.gz", ["--labels", folder / "l.nii.gz"]
    plan = ["mesh", image, "-o", out, "--spacing", "8", "--iterations", "0"]
    assert "--label-names: needs --labels" in refused(capsys, *plan, *names)
    assert "did you mean spleen" in refused(
        capsys, *plan, *labels, *names, "--young", "splen=5,*=20"
    )
    assert "--label-names: needs --labels" in refused(capsys, "quality", mesh, *names)
    assert "--label-names: needs --labels" in refused(
        capsys, "compare", image, "-o", tmp_path / "c", *names
    )
    (tmp_path / "bad.csv").write_text("label,name\n1,a\n1,b\n")
    for words in (
        ["convert", mesh, out],
        ["fem", mesh, "--young", "1", "--load", "compress:1%"],
        ["view", mesh, "--html", tmp_path / "a.html"],
    ):
        assert "bad.csv, line 3: label 1" in refused(
            capsys, *words, "--label-names", tmp_path / "bad.csv"
        )
    assert [path.name for path in tmp_path.iterdir()] == ["bad.csv"]


# The sets that a file gets


@pytest.mark.parametrize(
    ("words", "facets", "cells"),
    [
        (["--sets", "all"], {*FACES, "interface_0_1"}, {"label_0", "label_1"}),
        ([], {*FACES, "interface_0_1"}, {"label_0", "label_1"}),
        (["--sets", "none"], set(), set()),
        (["--sets", "labels"], set(), {"label_0", "label_1"}),
        (["--sets", "interfaces, boundary"], {*FACES, "interface_0_1"}, set()),
        (["--sets", "none", "--set", "dark=below:20"], {"dark_surface"}, {"dark"}),
        (
            [
                "--sets",
                "none",
                "--young",
                "5",
                "--load",
                "hold:interface_0_1",
                "--load",
                "pressure:left:1",
            ],
            {"interface_0_1", "left"},
            set(),
        ),
    ],
)
def test_chosen_sets(folder, tmp_path, capsys, words, facets, cells):
    out, numbers = tmp_path / "a.vtu", tmp_path / "a.json"
    assert exit_code("convert", folder / "plain.vtu", out, *words, "--json", numbers) == 0
    loaded = tetopt.load_mesh(out)
    assert set(loaded.sets.facets) == facets
    assert set(loaded.sets.cells) == cells
    assert set(numbers_in(numbers)["sets"]["facets"]) == facets
    assert {name for name in pyvista.read(out).point_data if name.startswith("on_")} == {
        f"on_{each}" for each in facets
    }
    assert "not written as sets" not in capsys.readouterr().err
    mesh = [
        "mesh",
        folder / "a.nii.gz",
        "--labels",
        folder / "l.nii.gz",
        "--spacing",
        "8",
        "--iterations",
        "0",
    ]
    assert exit_code(*mesh, "-o", out, "--force", *words) == 0
    assert set(tetopt.load_mesh(out).sets.facets) == facets
    if "--load" in words:
        assert exit_code("fem", out, "-o", tmp_path / "s.vtu", "--sets", "labels") == 0
        solved = tetopt.load_mesh(tmp_path / "s.vtu").sets
        assert (set(solved.facets), set(solved.cells)) == (facets, {"label_0", "label_1"})


def test_sets_that_are_none(folder, tmp_path, capsys):
    mesh = folder / "plain.vtu"
    said = refused(capsys, "convert", mesh, tmp_path / "a.vtu", "--sets", "labels,faces")
    assert (
        '--sets: expected some of labels, interfaces, boundary, or all, or none, got "faces"'
        in said
    )
    assert "leave out --young, --bins, --set, --sets" in refused(
        capsys, "convert", mesh, tmp_path / "a.stl", "--sets", "all"
    )
    words = ["fem", mesh, "--young", "1", "--load", "compress:5%"]
    assert "--sets: no file is written; add -o" in refused(capsys, *words, "--sets", "all")
    assert list(tmp_path.iterdir()) == []


def test_many_interfaces_are_not_written_into_vtu(folder, tmp_path, capsys):
    loaded = tetopt.load_mesh(folder / "plain.vtu")
    labels = np.arange(len(loaded.mesh.cells)) % 60
    tetopt.save_mesh(tmp_path / "many.vtu", loaded.mesh, {"label": labels})
    assert exit_code("convert", tmp_path / "many.vtu", tmp_path / "a.vtu") == 0
    said, kept = capsys.readouterr().err, tetopt.load_mesh(tmp_path / "a.vtu").sets
    assert "interfaces are not written as sets (--sets all writes them)" in said
    assert not [name for name in kept.facets if name.startswith("interface_")]
    assert len(kept.cells) == 60
    assert exit_code("convert", tmp_path / "many.vtu", tmp_path / "all.vtu", "--sets", "all") == 0
    every = tetopt.load_mesh(tmp_path / "all.vtu").sets.facets
    assert len(every) > MANY_INTERFACES + 7
    # they are there anyway
    assert exit_code("convert", tmp_path / "a.vtu", tmp_path / "b.inp", "--young", "1") == 0
    name = list(every)[-1]
    assert f"NSET={name}\n" in (tmp_path / "b.inp").read_text()
    words = ["--young", "1", "--load", f"hold:{name}", "--force"]
    assert exit_code("convert", tmp_path / "a.vtu", tmp_path / "a2.vtu", *words) == 0
    (tmp_path / "some.csv").write_text("label,name\n1,liver\n")
    named = ["--label-names", tmp_path / "some.csv", "--young", "liver=5,*=2", "--sets", "none"]
    capsys.readouterr()
    assert exit_code("convert", tmp_path / "a.vtu", tmp_path / "c.inp", *named) == 0
    assert (
        "\n  2 kPa, nu 0.45: 0, 2, 3, 4, 5, 6, 7, 8 and 51 more\n  5 kPa, nu 0.45: liver\n"
        in capsys.readouterr().out
    )
    assert exit_code("convert", folder / "named.vtu", tmp_path / "d.inp", "--young", "1+0.1*h") == 0
    assert ", nu 0.45: " not in capsys.readouterr().out  # a label is of many materials
    assert [
        each for each in tetopt.load_mesh(tmp_path / "a2.vtu").sets.facets if "interface" in each
    ] == [name]


def test_one_label_that_is_image_and_labels_is_reported_once_and_without_empty_tables(
    tmp_path, capsys
):
    path, mesh = tmp_path / "ball.nii", tmp_path / "a.vtu"
    ball = (np.linalg.norm(np.indices((16, 16, 16)) - 7.5, axis=0) < 5.0).astype(np.uint8)
    image = nibabel.Nifti1Image(ball, np.eye(4))
    image.header["xyzt_units"] = 5
    nibabel.save(image, path)
    words = [
        "mesh",
        path,
        "--labels",
        path,
        "--background",
        "0",
        "--nodes",
        "400",
        "--iterations",
        "2",
        "-o",
        mesh,
    ]
    assert exit_code(*words) == 0
    out, err = capsys.readouterr()
    assert err.count("its unit of length has the unknown code 5") == 1
    assert exit_code("quality", mesh, "--image", path, "--labels", path) == 0
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
