"""All formats alike: chosen by the suffix, and well-formed whatever things are called."""

import re
import warnings
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
from models import quadratic_model, sample_model
from refusals import refusal
from test_writers import READERS

import tetopt
from tetopt.cli import main
from tetopt.geometry.surface import extract_surface
from tetopt.io import formats
from tetopt.io.formats import FORMATS, file_bytes, save_mesh, save_model
from tetopt.io.surfaces import save_surface
from tetopt.io.text import plain
from tetopt.model.sets import Sets

CORNER = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), np.array([[0, 1, 2, 3]])
# What every format with a place for names can hold, and what none can: by what that is called
# instead.
KEPT = [
    # words of formats
    "METADATA",
    "SCALARS",
    "POINTS",
    "CELL_DATA",
    "FIELD",
    "LOOKUP_TABLE",
    "$EndNodes",
    "*NODE",
    "End",
    "NumberOfPoints='1e99'",
    '<Piece NumberOfCells="7">',
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
    "x\x1b[31m": r"x\x1b[31m",
    "z\0q": r"z\x00q",
    "line\nbreak\r\t": r"line\nbreak\r\t",
    "\u202egnp": r"\u202egnp",
    "a\u2028b": r"a\u2028b",
    "\udcff": r"\udcff",
    "\ufffe": r"\ufffe",
    "": "unnamed",
    " ": "unnamed_2",
}
IMAGE = (
    'a"<b>&-->\n*NODE\n\nVertices\n7\n$EndComments\r\0\x1b]0;title\x07\u202e\udcff é '
    + 300 * "x"
    + ".nii"
)


def hostile_model(suffix):
    model = sample_model()._replace(loads=())
    names = [*KEPT, *SHOWN]
    values = np.arange(len(model.mesh.cells), dtype=float)
    cell_data = {name: values + number for number, name in enumerate(names)}
    point_data = (
        {}
        if suffix == ".feb"
        else {name: model.mesh.points[:, 0] + k for k, name in enumerate(names)}
    )
    return model._replace(
        cell_data=cell_data, point_data=point_data, about={"tetopt": "0.1.0\n!", "image": IMAGE}
    )


def found(path, model):
    """How many points and cells a reader finds in a file, and the names of the sets of facets
    and cells.
    """
    suffix = path.suffix
    if suffix == ".inp":
        file, sets = meshio.read(path), tetopt.load_mesh(path).sets
        return len(file.points), len(file.cells[0].data), *sets
    if suffix in (".feb", ".xdmf", ".mfem", ".mesh"):
        read = READERS[suffix](path.read_bytes(), model)
        names = (
            [name for name in each if len(each[name])] for each in (read.facets, read.cell_sets)
        )
        return len(read.points), len(read.cells), *names
    file = tetopt.load_mesh(path)
    return len(file.mesh.points), len(file.mesh.cells), *file.sets


def assert_whole(path, model):
    """A reader, for most formats not of tetopt's, finds all of the mesh and the sets."""

    n_points, n_cells, *names = found(path, model)
    assert (n_points, n_cells) == (len(model.mesh.points), len(model.mesh.cells))
    for those, sets in zip(names, model.sets, strict=True):
        assert set(sets) <= set(those)


def saved(path, model):
    """Written, with warnings on names as those of the tests, and as bytes."""
    with pytest.warns(UserWarning, match="names the format does not support"):
        save_model(path, model)
    return path.read_bytes()


@pytest.mark.parametrize("suffix", FORMATS)
def test_no_name_breaks_a_file(suffix, tmp_path):
    """Each file is of text without control characters but line breaks, or tells no name at all
    but in bytes.
    """
    model = hostile_model(suffix)
    text = saved(tmp_path / f"a{suffix}", model)
    assert_whole(tmp_path / f"a{suffix}", model)
    head = text[: text.index(b"CELLS")] if suffix == ".vtk" else text
    if suffix == ".vtk":
        head = b"\n".join(
            re.findall(
                rb"\n([\x20-\x7e]+ \d+ \d+ (?:double|vtktypeint64|unsigned_char|int))\n", text
            )
        )
    shown = head.decode()
    assert plain(shown.replace("\n", "")) == shown.replace("\n", "")
    if suffix == ".xdmf":
        names = {each.get("Name") for each in ElementTree.fromstring(text).iter("Attribute")}
        assert names >= {*KEPT, *SHOWN.values()}


@pytest.mark.parametrize("name", ["{", "{0:>9}", "%s%n"])
def test_braces_in_names_end_no_process(name, here):
    """VTK's writer of legacy files reads them as marks of its own, and ends the process."""
    model = sample_model()._replace(loads=())
    values = {
        name: np.arange(len(model.mesh.cells), dtype=float),
        "a": np.ones(len(model.mesh.cells)),
    }
    at_nodes = {name: model.mesh.points[:, 0], f"{name}2": model.mesh.points}
    model = model._replace(cell_data=values, point_data=at_nodes, about={name: "x"})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they are called otherwise
        save_model("a.vtk", model)
    back = tetopt.load_mesh("a.vtk").cell_data
    assert any(each.ndim == 1 and sorted(each) == sorted(values[name]) for each in back.values())


@pytest.mark.full
@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh"])
def test_names_come_back(suffix, here):
    """As they were where they are printable text, else as Python escapes them; gmsh has no
    quotes.
    """
    model = hostile_model(suffix)
    saved(here / f"a{suffix}", model)
    back = tetopt.load_mesh(f"a{suffix}")
    quote = "'" if suffix == ".msh" else '"'
    expected = {name: name.replace('"', quote) for name in KEPT} | SHOWN
    assert {*expected.values()} == back.cell_data.keys() - {"young", "nu", "material"}
    assert {*expected.values()} == back.point_data.keys()
    for name, new in expected.items():
        for values, written in (
            (back.cell_data, model.cell_data),
            (back.point_data, model.point_data),
        ):
            # .msh has another order
            assert np.array_equal(np.sort(values[new]), np.sort(written[name]))
    assert {name: len(rows) for name, rows in back.sets.facets.items()} == {
        name: len(rows) for name, rows in model.sets.facets.items()
    }
    image = back.text("image")
    assert image == (
        plain(" ".join(IMAGE.split())) if suffix == ".msh" else IMAGE.replace("\udcff", "\\udcff")
    )


def test_two_names_never_become_one():
    """Whatever a name becomes, no data are lost: it is numbered where another is called so."""
    mesh = sample_model().mesh
    values = np.arange(len(mesh.cells), dtype=float)
    data = {"a\\n": values, "a\n": values + 1, 'q"': values + 2, "q'": values + 3}
    data |= {"pair": np.column_stack([values, values]), "pair_1": values + 4}
    long = {300 * "é" + str(k): values + k for k in range(3)}
    model = sample_model()._replace(cell_data=data | long, loads=())
    with pytest.warns(UserWarning, match=r"support: a\\n_2"):
        names = set(
            re.findall(r'\$ElementData\n1\n"([^"]*)"', file_bytes(Path("a.msh"), model).decode())
        )
    assert len(names - {"young", "nu", "material", *model.sets.cells}) == 10


@pytest.mark.parametrize("suffix", [".vtk", ".msh", ".feb"])
def test_names_of_any_length(suffix, here):
    mesh = sample_model().mesh
    values = np.arange(len(mesh.cells), dtype=float)
    names = ["x" * 240, "x" * 241, "x" * 100_000, "名" * 100]
    model = sample_model()._replace(
        cell_data={name: values + k for k, name in enumerate(names)}, loads=()
    )
    saved(here / f"a{suffix}", model)
    if suffix != ".feb":
        back = tetopt.load_mesh(f"a{suffix}").cell_data
        assert [each for each in back if each[0] in "x名"] == [
            "x" * 240,
            "x" * 240 + "_2",
            "x" * 240 + "_3",
            "名" * 26,
        ]


@pytest.mark.parametrize("name", ["a b", "", "1a", "x" * 73, "a\n", "ä"])
@pytest.mark.parametrize("suffix", [".inp"])
def test_sets_that_some_format_cannot_name_are_refused(name, suffix, here):
    model = sample_model()._replace(loads=())
    sets = Sets(model.sets.facets | {name: model.sets.facets["boundary"]}, model.sets.cells)
    with refusal(r"expected set names of up to 72 letters") as error:
        save_model(f"a{suffix}", model._replace(sets=sets))
    assert plain(str(error.value)) == str(error.value)
    assert list(here.iterdir()) == []


def test_sets_that_differ_by_case_alone_are_refused(here):
    model = sample_model()._replace(loads=())
    sets = Sets(model.sets.facets, model.sets.cells | {"BOUNDARY": np.array([0])})
    with refusal("two sets have the name BOUNDARY"):
        save_model("a.vtu", model._replace(sets=sets))


@pytest.mark.parametrize("suffix", [*FORMATS, ".VTU", ".Inp"])
def test_a_mesh_is_written_by_its_suffix(suffix, tmp_path):
    """What `save_mesh` writes is what the suffix says, or nothing."""
    mesh, path = sample_model().mesh, tmp_path / f"a{suffix}"
    if suffix == ".feb":
        with refusal("material"):
            save_mesh(path, mesh)
        assert not path.exists()
        return
    save_mesh(path, mesh)
    heads = {
        ".vtu": b"<?xml",
        ".vtk": b"# vtk",
        ".xdmf": b"<?xml",
        ".msh": b"$MeshFormat\n4.1",
        ".inp": b"** tetopt",
        ".msh2": b"$MeshFormat\n2.2",
        ".mfem": b"MFEM",
        ".mesh": b"MeshVersion",
    }
    assert path.read_bytes().startswith(heads[suffix.lower()])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a", r"unknown suffix; known suffixes are \.vtu .*, \.inp"),
        ("a.vtu.gz", r"unknown suffix; known suffixes are \.vtu .*, \.inp"),
        ("a.stl", r"a\.stl: .*tetopt surface --boundary"),
        ("a.PLY", r"a\.PLY: .*tetopt surface --boundary"),
    ],
)
def test_a_suffix_of_no_format_is_refused(name, words, here):
    with refusal(words):
        save_mesh(name, sample_model().mesh)
    assert list(here.iterdir()) == []


def test_a_pvtu_is_refused_by_the_name_of_what_replaces_it(here):
    (here / "a.PVTU").write_text("<VTKFile/>")
    with refusal(r"a\.PVTU: cannot read \.pvtu; save the mesh as \.vtu"):
        tetopt.load_mesh("a.PVTU")


def test_labels_of_a_surface_that_its_file_cannot_name_are_refused(here):
    mesh = sample_model().mesh
    surface = extract_surface(mesh.points, mesh.cells, np.arange(len(mesh.cells)))
    for suffix in (".ply", ".vtp", ".vtk"):
        with refusal(r'got "a\\nproperty int b"'):
            save_surface(
                f"a{suffix}",
                surface,
                labels={"a\nproperty int b": np.zeros(len(surface.triangles), int)},
            )
    assert list(here.iterdir()) == []


# Formats of one's own


@pytest.fixture
def registered(monkeypatch):
    """Points as text under `.pts`; formats are as they were afterwards."""
    monkeypatch.setitem(FORMATS, ".pts", None)
    tetopt.register_format(
        ".PTS", lambda model: f"é {model.units} {model.mesh.points.tolist()}\n", "points"
    )


@pytest.mark.filterwarnings("ignore")  # of a mesh as coarse as this
def test_a_registered_format_is_written_alike_by_all(registered, here, capsys):
    mesh = sample_model().mesh
    tetopt.save_mesh("a.vtu", mesh)
    tetopt.save_mesh("a.pts", mesh)
    whole = (here / "a.pts").read_text("utf-8")
    assert whole == f"é kPa {mesh.points.tolist()}\n"
    assert main(["convert", str(here / "a.vtu"), str(here / "b.pts")]) == 0
    assert "points, RAS+ mm" in capsys.readouterr().out
    assert (here / "b.pts").read_text("utf-8") == whole
    tetopt.save_image("a.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=8))
    tetopt.run(tetopt.Job(images=here / "a.nii.gz", output=here / "c.pts", nodes=60, iterations=0))
    tetopt.run(tetopt.Job(images=here / "a.nii.gz", output=here / "c.vtu", nodes=60, iterations=0))
    points = tetopt.load_mesh("c.vtu").mesh.points
    assert (here / "c.pts").read_text("utf-8") == f"é kPa {points.tolist()}\n"


def test_what_a_registered_format_does_not_hold_is_refused(registered, here):
    with refusal(r"a\.pts: only \.vtu, .* support quadratic cells"):
        save_model("a.pts", quadratic_model())
    assert list(here.iterdir()) == []


def test_a_format_that_fails_leaves_the_old_file(registered, here):
    (here / "a.pts").write_text("old")

    def broken(model):
        raise RuntimeError("broken")

    tetopt.register_format(".pts", broken)
    with pytest.raises(RuntimeError, match="broken"):
        save_model("a.pts", sample_model())
    assert [path.read_text() for path in here.iterdir()] == ["old"]


@pytest.mark.parametrize("suffix", [".INP", "pts", "", ".a/b", ".p\n"])
def test_suffixes_that_no_format_can_have(suffix):
    with refusal(r"^suffix: (\.\w+ is a built-in format|expected a dot)"):
        tetopt.register_format(suffix, str)
    assert suffix not in FORMATS.keys() - formats.BUILT_IN


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_order_of_bytes_in_memory_is_not_the_file_s(suffix):
    """Data that come big-endian, as from NIfTI and MGH."""
    model = sample_model()
    swapped = model._replace(
        cell_data={
            name: values.astype(values.dtype.newbyteorder(">"))
            for name, values in model.cell_data.items()
        }
    )
    assert file_bytes(Path(f"a{suffix}"), swapped) == file_bytes(Path(f"a{suffix}"), model)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", FORMATS)
def test_a_million_cells(suffix, here):
    image = tetopt.Image(np.zeros((60, 60, 60)))
    mesh = tetopt.lattice_mesh(image, blocks=(59, 59, 59))
    assert len(mesh.cells) > 10**6
    model = tetopt.build_model(mesh, image, young="2+h", loads=["compress:2%"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of nearly incompressible cells
        save_model(f"a{suffix}", model)
    assert_whole(here / f"a{suffix}", model)


@pytest.mark.parametrize("suffix", [".vtu"])
def test_a_disk_that_loses_bytes_is_noticed(suffix, tmp_path, monkeypatch):
    path, model = tmp_path / f"a{suffix}", sample_model()
    path.write_bytes(b"old")
    write = Path.write_bytes
    monkeypatch.setattr(
        Path, "write_bytes", lambda self, whole: write(self, whole[:-1] + bytes([whole[-1] ^ 1]))
    )
    with pytest.raises(OSError, match="the file reads back differently"):
        save_model(path, model)
    assert path.read_bytes() == b"old"


def bad_models():
    """What does not fit the sample's mesh, by the words of the refusal."""
    model = sample_model()
    n_cells, n_points, table = len(model.mesh.cells), len(model.mesh.points), model.materials
    ones, rows = np.ones(n_cells), model.sets.facets["left"]
    for values in (
        ones[1:],
        np.append(ones, 1.0),
        3.0,
        np.array(3.0),
        None,
        ones[:, None][:, :0],
        ones * 1j,
        np.full(n_cells, "a"),
        np.full(n_cells, None),
        np.zeros(n_cells, "M8[s]"),
        [10**30] * n_cells,
        [[1, 2], *[[1]] * (n_cells - 1)],
        np.ma.masked_less(np.arange(n_cells), 2),
    ):
        yield "cell_data: 'a': ", model._replace(cell_data={"a": values})
    yield "cell_data: expected strings as names", model._replace(cell_data={3: ones})
    yield "cell_data: expected a dict", model._replace(cell_data=[ones])
    for values in (np.ones(n_points - 1), np.ones(n_points + 1), np.full(n_points, "a"), 3.0):
        yield "point.data: ", model._replace(point_data={"a": values})
    for values in (
        rows + np.array([n_cells, 0]),
        rows - np.array([n_cells, 0]),
        rows + np.array([0, 4]),
        rows[:, 0],
        rows[::-1],
        rows[[0, 0]],
        rows[:0],
        rows.astype(float),
        rows == 1,
        np.column_stack([rows, rows[:, 1]]),
        3,
    ):
        yield "set 'a': expected facets", model._replace(sets=Sets({"a": values}, {}), loads=())
    for values in ([], [n_cells], [-1], [2, 1], [1, 1], ones == 1.0, [0.5], [[1]], 3, "a"):
        yield "set 'a': expected cells", model._replace(sets=Sets({}, {"a": values}), loads=())
    yield "load: ", model._replace(sets=Sets({}, {}))
    for of_cell in (
        table.of_cell[1:],
        table.of_cell + 1,
        table.of_cell - 1,
        table.of_cell.astype(float),
    ):
        yield "materials: ", model._replace(materials=table._replace(of_cell=of_cell))
    for name in ("young", "nu", "density"):
        yield (
            f"materials: expected a finite {name}",
            model._replace(materials=table._replace(**{name: np.nan * table.young})),
        )
    yield "rows of moduli", model._replace(node_young=np.ones(n_points - 1))
    yield "about: ", model._replace(about={"a": ones})


@pytest.mark.parametrize("suffix", FORMATS)
def test_data_that_do_not_fit_leave_the_old_file(suffix, tmp_path):
    """In every format, also in those that do not hold them: no file that cannot be read, and no
    cut rows.
    """
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")
    for words, model in bad_models():
        with refusal(words):
            save_model(path, model)
        assert [each.name for each in tmp_path.iterdir()] == [path.name]
        assert path.read_bytes() == b"old"


@pytest.mark.filterwarnings("ignore:.*linear elements")
@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".xdmf", ".msh", ".feb"])
def test_integers_are_kept_or_refused(suffix, here):
    model = sample_model()
    for value in (2**53, 2**53 + 1, 2**63 + 1):
        data = {"a": np.full(len(model.mesh.cells), value, dtype=np.uint64)}
        if value > (2**63 if suffix in (".vtu", ".xdmf") else 2**53):
            with refusal(f"expected integers up to .* in 'a', got {value}"):
                save_model(f"a{suffix}", model._replace(cell_data=data))
        else:
            save_model(f"a{suffix}", model._replace(cell_data=data))
            if suffix in (".vtu", ".vtk", ".msh"):
                assert int(tetopt.load_mesh(f"a{suffix}").cell_data["a"][0]) == value


@pytest.mark.filterwarnings("ignore:.*linear elements")
def test_lists_and_tables_are_written_by_all(here):
    """A list is an array, also for sets; rows of more than one axis are flattened."""
    model = sample_model()
    cells = len(model.mesh.cells)
    data = {"a": list(range(cells)), "b": np.ones((cells, 3, 3)), "c": np.arange(cells) > 3}
    model = model._replace(cell_data=data, sets=Sets({"x": [[0, 1]]}, {"y": [3, 5]}), loads=())
    for suffix in FORMATS:
        save_model(f"a{suffix}", model)
    back = tetopt.load_mesh("a.vtu")
    assert back.cell_data["a"].tolist() == data["a"]
    assert back.cell_data["b"].shape == (cells, 9)
    assert (back.sets.facets["x"].tolist(), back.sets.cells["y"].tolist()) == ([[0, 1]], [3, 5])


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".vtp", ".vtk"])
def test_a_surface_that_does_not_fit_leaves_the_old_file(suffix, here):
    surface = extract_surface(*CORNER, [0])
    (here / f"a{suffix}").write_bytes(b"old")
    bad = [
        {"surface": surface._replace(triangles=surface.triangles + 1)},
        {"surface": surface._replace(triangles=surface.triangles.astype(float))},
        {"surface": surface._replace(points=surface.points * np.nan)},
        {"surface": surface._replace(points=surface.points[:, :2])},
        {"space": "xyz"},
    ]
    values = np.arange(4)
    labels = (values[1:], values[:, None], values + 2**31, values * 0.5, values.astype(str), 3)
    bad += [{"labels": {"a": each}} for each in labels if suffix != ".stl"]
    for options in bad:
        with refusal("expected"):
            save_surface(f"a{suffix}", **{"surface": surface} | options)
        assert (here / f"a{suffix}").read_bytes() == b"old"
