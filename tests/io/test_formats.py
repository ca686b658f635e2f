"""All formats alike: chosen by the suffix, and well-formed whatever things are called."""

import re
import warnings
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
from models import sample_model

import tetopt
from tetopt import InputError
from tetopt.geometry.surface import surface_of
from tetopt.io.formats import FORMATS, file_bytes, save_mesh, save_model
from tetopt.io.surfaces import checked_surface, save_surface
from tetopt.io.text import plain
from tetopt.model.sets import Sets

XML_SUFFIXES = (".vtu", ".xdmf", ".feb", ".scn")
# What every format with a place for names can hold, and what none can: by what that is called instead.
KEPT = [
    "<x>",
    'a"b',
    "a&b;&lt;",
    "it's",
    "-->",
    "]]>",
    "a b",
    "Größe",
    "名前",
    "=cmd|' /C calc'!A0",
    "%s%n",
    "$Nodes",
    "\\n",
]
SHOWN = {
    "x\x1b[31m": r"x\x1b[31m", "z\0q": r"z\x00q", "line\nbreak\r\t": r"line\nbreak\r\t", "\u202egnp": r"\u202egnp",
    "a\u2028b": r"a\u2028b", "\udcff": r"\udcff", "\ufffe": r"\ufffe", "": "unnamed", " ": "unnamed_2",
}  # fmt: skip
IMAGE = 'a"<b>&-->\n*NODE\n$EndComments\r\0\x1b]0;title\x07\u202e\udcff é ' + 300 * "x" + ".nii"


def hostile_model(suffix):
    model = sample_model()._replace(loads=())
    names = [*KEPT, *SHOWN]
    values = np.arange(len(model.mesh.cells), dtype=float)
    cell_data = {name: values + number for number, name in enumerate(names)}
    point_data = {} if suffix == ".feb" else {name: model.mesh.points[:, 0] + k for k, name in enumerate(names)}
    return model._replace(cell_data=cell_data, point_data=point_data, about={"tetopt": "0.1.0\n!", "image": IMAGE})


def saved(path, model):
    """Written, with warnings on names as those of the tests, and as bytes."""
    with pytest.warns(UserWarning, match="names that it cannot hold"):
        save_model(path, model)
    return path.read_bytes()


@pytest.mark.parametrize("suffix", FORMATS)
def test_no_name_breaks_a_file(suffix, tmp_path):
    """Each file is of text without control characters but line breaks, or tells no name at all but in bytes."""
    text = saved(tmp_path / f"a{suffix}", hostile_model(suffix))
    head = text[: text.index(b"CELLS")] if suffix == ".vtk" else text[:80] if suffix == ".stl" else text
    head = head[: head.index(b"end_header")] if suffix == ".ply" else head
    if suffix == ".vtk":
        head = b"\n".join(re.findall(rb"\n([\x20-\x7e]+ \d+ \d+ (?:double|vtktypeint64|unsigned_char|int))\n", text))
    shown = head.decode()
    assert plain(shown.replace("\n", "")) == shown.replace("\n", "")
    if suffix in XML_SUFFIXES:
        ElementTree.fromstring(text)


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh"])
def test_names_come_back(suffix, tmp_path):
    """As they were where they are printable text, else as Python escapes them; gmsh has no quotes in its names."""
    model = hostile_model(suffix)
    saved(tmp_path / f"a{suffix}", model)
    back = tetopt.load_mesh(tmp_path / f"a{suffix}")
    expected = {name: name for name in KEPT} | SHOWN
    if suffix == ".msh":
        expected['a"b'] = "a'b"
    assert {*expected.values()} == back.cell_data.keys() - {"young", "nu", "material"}
    assert {*expected.values()} == back.point_data.keys()
    for name, new in expected.items():
        for values, written in ((back.cell_data, model.cell_data), (back.point_data, model.point_data)):
            assert np.array_equal(np.sort(values[new]), np.sort(written[name]))  # .msh has another order
    assert {name: len(rows) for name, rows in back.sets.facets.items()} == {
        name: len(rows) for name, rows in model.sets.facets.items()
    }
    image = back.text("image")
    assert image == (plain(" ".join(IMAGE.split())) if suffix == ".msh" else IMAGE.replace("\udcff", "\\udcff"))


@pytest.mark.parametrize("suffix", [".xdmf", ".feb"])
def test_names_come_back_from_xml(suffix, tmp_path):
    model = hostile_model(suffix)
    root = ElementTree.fromstring(saved(tmp_path / f"a{suffix}", model))
    tag, key = ("Attribute", "Name") if suffix == ".xdmf" else ("ElementData", "name")
    assert {each.get(key) for each in root.iter(tag)} >= {*KEPT, *SHOWN.values()}


def test_other_programs_read_hostile_names(tmp_path):
    for suffix in (".vtu", ".msh", ".mesh"):
        model = hostile_model(suffix)
        saved(tmp_path / f"a{suffix}", model)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mesh = meshio.read(tmp_path / f"a{suffix}")
        assert sum(len(block.data) for block in mesh.cells if block.type == "tetra") == len(model.mesh.cells)
    for suffix in (".stl", ".ply"):
        saved(tmp_path / f"a{suffix}", hostile_model(suffix))
        assert checked_surface(tmp_path / f"a{suffix}").is_watertight


def test_two_names_never_become_one():
    """Whatever a name becomes, no data are lost: it is numbered where another is called so."""
    mesh = sample_model().mesh
    values = np.arange(len(mesh.cells), dtype=float)
    data = {"a\\n": values, "a\n": values + 1, 'q"': values + 2, "q'": values + 3}
    data |= {"pair": np.column_stack([values, values]), "pair_1": values + 4}
    long = {300 * "é" + str(k): values + k for k in range(3)}
    model = sample_model()._replace(cell_data=data | long, loads=())
    with pytest.warns(UserWarning, match=r"called a\\n_2"):
        columns = set(re.findall(r'<ElementData name="([^"]*)"', file_bytes(Path("a.feb"), model).decode()))
    assert len(columns) == 10


@pytest.mark.parametrize("suffix", [".vtk", ".msh", ".feb"])
def test_names_of_any_length(suffix, tmp_path):
    mesh = sample_model().mesh
    values = np.arange(len(mesh.cells), dtype=float)
    names = ["x" * 240, "x" * 241, "x" * 100_000, "名" * 100]
    model = sample_model()._replace(cell_data={name: values + k for k, name in enumerate(names)}, loads=())
    saved(tmp_path / f"a{suffix}", model)
    if suffix != ".feb":
        back = tetopt.load_mesh(tmp_path / f"a{suffix}").cell_data
        assert [each for each in back if each[0] in "x名"] == ["x" * 240, "x" * 240 + "_2", "x" * 240 + "_3", "名" * 26]


@pytest.mark.parametrize("name", ["a b", "<x>", "", "1a", "x" * 73, "a\n", "ä"])
@pytest.mark.parametrize("suffix", FORMATS)
def test_sets_that_some_format_cannot_name_are_refused(name, suffix, tmp_path):
    model = sample_model()._replace(loads=())
    sets = Sets(model.sets.facets | {name: model.sets.facets["boundary"]}, model.sets.cells)
    with pytest.raises(InputError, match=r"the name of a set is a letter, then up to 71 letters") as error:
        save_model(tmp_path / f"a{suffix}", model._replace(sets=sets))
    assert plain(str(error.value)) == str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_sets_that_differ_by_case_alone_are_refused(tmp_path):
    model = sample_model()._replace(loads=())
    sets = Sets(model.sets.facets, model.sets.cells | {"BOUNDARY": np.array([0])})
    with pytest.raises(InputError, match="two sets are called BOUNDARY"):
        save_model(tmp_path / "a.vtu", model._replace(sets=sets))


@pytest.mark.parametrize("suffix", [*FORMATS, ".VTU", ".Inp"])
def test_a_mesh_is_written_by_its_suffix(suffix, tmp_path):
    """What `save_mesh` writes is what the suffix says, or nothing."""
    mesh, path = sample_model().mesh, tmp_path / f"a{suffix}"
    if suffix in (".feb", ".scn"):
        with pytest.raises(InputError, match="material"):
            save_mesh(path, mesh)
        assert not path.exists()
        return
    save_mesh(path, mesh)
    heads = {
        ".vtu": b"<?xml", ".vtk": b"# vtk", ".xdmf": b"<?xml", ".msh": b"$MeshFormat\n4.1", ".inp": b"** tetopt",
        ".msh2": b"$MeshFormat\n2.2", ".mfem": b"MFEM", ".mesh": b"MeshVersion", ".stl": b"tetopt", ".ply": b"ply",
    }  # fmt: skip
    assert path.read_bytes().startswith(heads[suffix.lower()])


@pytest.mark.parametrize("name", ["a", "a.vtux", "a.csv", "a.nii.gz", "a.vtu.gz"])
def test_a_suffix_of_no_format_is_refused(name, tmp_path):
    with pytest.raises(InputError, match=r"unknown suffix; known are \.vtu .*, \.inp"):
        save_mesh(tmp_path / name, sample_model().mesh)
    assert list(tmp_path.iterdir()) == []


def test_labels_of_a_surface_that_its_file_cannot_name_are_refused(tmp_path):
    mesh = sample_model().mesh
    surface = surface_of(mesh.points, mesh.cells, np.arange(len(mesh.cells)))
    for suffix in (".ply", ".vtp", ".vtk"):
        with pytest.raises(InputError, match=r'got "a\\nproperty int b"'):
            save_surface(
                tmp_path / f"a{suffix}", surface, labels={"a\nproperty int b": np.zeros(len(surface.triangles), int)}
            )
    assert list(tmp_path.iterdir()) == []
