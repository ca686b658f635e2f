"""Meshes as other programs write them: pieces, ghosts, labels by other names, values by number."""

import numpy as np
import pytest
import pyvista
from commands import assert_done, exit_code
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

from tetopt import Image, cell_fields, load_mesh, save_image
from tetopt.geometry.quadratic import quadratic
from tetopt.interop.conversions import VTK_KINDS
from tetopt.start.lattice import lattice_mesh

SHAPES = [(n, order) for n in (2, 3) for order in (1, 2)]


def image_of(n):
    """Of 12 mm a side, from 0."""
    affine = np.diag([1.0] * (n + 1))
    affine[:n, n] = 0.5
    return Image(np.random.default_rng(0).normal(size=(12,) * n), affine)


def box_mesh(n):
    return lattice_mesh(image_of(n), blocks=(2,) * n)


def nodes_of(mesh, order):
    """Nodes in space, and cells of the order."""
    nodes, cells = (mesh.points, mesh.cells) if order == 1 else quadratic(mesh.points, mesh.cells)
    return np.column_stack([nodes, np.zeros((len(nodes), 3 - mesh.ndim))]), cells


def grid_of(points, cells, n, order=1, **data):
    grid = pyvista.UnstructuredGrid({VTK_KINDS[n, order]: cells}, points)
    for name, values in data.items():
        grid.cell_data[name] = values
    return grid


def pieces(n, order, by=0.0):
    """Two halves of a box, each with nodes of its own; those of the second are off by `by`."""
    points, cells = nodes_of(box_mesh(n), order)
    parts = np.array_split(cells, 2)
    used, first = np.unique(parts[0], return_inverse=True)
    others, second = np.unique(parts[1], return_inverse=True)
    both = np.vstack([first.reshape(parts[0].shape), second.reshape(parts[1].shape) + len(used)])
    return np.vstack([points[used], points[others] + by]), both


@pytest.mark.parametrize(("n", "order"), SHAPES)
@pytest.mark.parametrize("by", [0.0, 1e-7])
def test_cells_that_repeat_are_left_out(n, order, by, here):
    """With the nodes of others, or as copies with nodes of their own; the first one's values."""
    points, cells = nodes_of(box_mesh(n), order)
    others = cells[2:5, ::-1] if by == 0.0 and order == 1 else cells[2:5] + len(points)
    both = np.vstack([cells, others])
    grid_of(np.vstack([points, points + by * (np.arange(3) < n)]), both, n, order).save("a.vtu")
    grid = pyvista.read("a.vtu")
    grid.cell_data["x"] = np.arange(len(both))
    grid.save("a.vtu")
    loaded = load_mesh("a.vtu")
    assert_array_equal(loaded.mesh.cells, box_mesh(n).cells)
    assert_array_equal(loaded.cell_data["x"], np.arange(len(cells)))
    words = "left out 3 cells that repeat the nodes of others; their x differ: using the first"
    assert words in loaded.notes


@pytest.mark.parametrize(("n", "order"), SHAPES)
@pytest.mark.parametrize("suffix", [".vtu", ".vtk"])
@pytest.mark.parametrize("by", [0.0, 1e-7])
def test_pieces_share_their_nodes(n, order, suffix, by, here):
    points, cells = pieces(n, order, by * (np.arange(3) < n))
    grid = grid_of(points, cells, n, order)
    grid.point_data["x"] = points[:, 0]
    grid.save(f"a{suffix}")
    loaded, mesh = load_mesh(f"a{suffix}"), box_mesh(n)
    whole = nodes_of(mesh, order)[0]
    assert len(loaded.mesh.points) == len(mesh.points)
    assert len(loaded.point_data["x"]) == len(whole)
    n_merged = len(points) - len(whole)
    assert any(f"merged {n_merged} nodes" in note for note in loaded.notes)
    assert not any("pieces" in note for note in loaded.notes)
    assert loaded.mesh.midpoints is None
    assert_allclose(loaded.mesh.cell_volumes.sum(), 12.0**n)
    assert_allclose(loaded.point_data["x"][: len(mesh.points)], loaded.mesh.points[:, 0])


def test_values_that_differ_at_merged_nodes_are_told(here):
    points, cells = pieces(3, 1)
    grid = grid_of(points, cells, 3)
    grid.point_data["jump"] = np.arange(len(points), dtype=float)
    grid.save("a.vtu")
    assert any("jump" in note for note in load_mesh("a.vtu").notes)


@pytest.mark.parametrize("size", [1e-6, 1e-4])
def test_nodes_of_tiny_cells_stay_apart(size, here):
    points, cells = nodes_of(box_mesh(3), 1)
    grid_of(100.0 + size * points, cells, 3).save("a.vtu")
    loaded = load_mesh("a.vtu")
    assert len(loaded.mesh.points) == len(points)
    assert len(loaded.notes) == 1
    assert "mesh_units" in loaded.notes[0]  # the size alone is told


@pytest.mark.parametrize(
    "command", ["quality a.vtu", "convert a.vtu b.vtu", "surface a.vtu -o b.stl --label 1"]
)
def test_pieces_that_stay_apart_are_told(command, here, capsys):
    points, cells = nodes_of(box_mesh(3), 1)
    both = np.vstack([points, points + 12.5])
    grid_of(both, np.vstack([cells, cells + len(points)]), 3, label=np.ones(2 * len(cells))).save(
        "a.vtu"
    )
    exit_code(command)
    assert "2 pieces" in capsys.readouterr().err


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("by", [0.0, 0.3])
def test_cells_that_touch_without_common_nodes_are_told(n, by, here):
    """A finer box beside or in a coarser one: corners are merged, other nodes hang."""
    coarse, fine = (lattice_mesh(image_of(n), blocks=(k,) * n) for k in (1, 2))
    parts = [nodes_of(mesh, 1) for mesh in (coarse, fine)]
    points = np.vstack([parts[0][0], parts[1][0] + (12.0 - by) * (np.arange(3) == 0)])
    cells = np.vstack([parts[0][1], parts[1][1] + len(parts[0][0])])
    grid_of(points, cells, n).save("a.vtu")
    assert any("touch or overlap" in note for note in load_mesh("a.vtu").notes)
    grid_of(*parts[1], n).save("a.vtu")
    assert load_mesh("a.vtu").notes == ()


def test_labels_by_majority_are_told(here, capsys):
    image = image_of(3)
    save_image("i.nii.gz", image)
    save_image("l.nii.gz", Image((np.indices((12, 12, 12))[0] > 5).astype(np.uint8), image.affine))
    points, cells = nodes_of(box_mesh(3), 1)
    for data, is_told in (({}, True), ({"label": np.ones(len(cells))}, False)):
        grid_of(points, cells, 3, **data).save("a.vtu")
        assert_done("quality i.nii.gz a.vtu --labels l.nii.gz")
        assert ("majority of voxels" in capsys.readouterr().out) == is_told


def test_a_mesh_of_a_part_without_a_mask_is_told(here, capsys):
    save_image("i.nii.gz", image_of(3))
    points, cells = nodes_of(box_mesh(3), 1)
    for part, is_told in ((cells, False), (cells[:50], True)):
        grid_of(points, part, 3).save("a.vtu")
        assert_done("convert i.nii.gz a.vtu b.vtu --young h**2+1 --force")
        assert ("--mask" in capsys.readouterr().err) == is_told


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("bits", "is_left"), [(1, True), (32, True), (33, True), (2, False)])
def test_ghosts_are_left_out(bits, is_left, order, here):
    mesh = box_mesh(3)
    points, cells = nodes_of(mesh, order)
    ghosts = np.zeros(len(cells), dtype=np.uint8)
    ghosts[3:7] = bits
    grid_of(points, cells, 3, order, vtkGhostType=ghosts, x=np.arange(len(cells))).save("a.vtu")
    loaded = load_mesh("a.vtu")
    stays = (ghosts == 0) | (not is_left)
    assert_array_equal(loaded.cell_data["x"], np.flatnonzero(stays))
    assert_allclose(loaded.mesh.cell_volumes, mesh.cell_volumes[stays])
    assert any("4 ghost" in note for note in loaded.notes) == is_left


def test_ghosts_that_repeat_cells_of_another_piece(here):
    """As parallel programs write them: the second piece has copies of cells of the first."""
    points, cells = pieces(3, 1)
    copied = cells[:5]
    used, again = np.unique(copied, return_inverse=True)
    ghosts = np.zeros(len(cells) + 5, dtype=np.uint8)
    ghosts[-5:] = 1
    both = np.vstack([cells, again.reshape(5, 4) + len(points)])
    grid_of(np.vstack([points, points[used]]), both, 3, vtkGhostType=ghosts).save("a.vtu")
    mesh = load_mesh("a.vtu").mesh
    assert_allclose(mesh.cell_volumes.sum(), 12.0**3)
    assert len(mesh.points) == len(box_mesh(3).points)


NAMES = ["medit:ref", "gmsh:physical", "labels", "RegionId", "MaterialIDs", "subdomains", "Tissue"]
NAMES += ["material id", "MatID", "Label"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", ["i4", "f4", "i8"])
def test_labels_by_a_known_name(name, kind, here):
    points, cells = nodes_of(box_mesh(3), 1)
    values = np.arange(len(cells)) % 3
    grid_of(points, cells, 3, size=np.ones(len(cells)), **{name: values.astype(kind)}).save("a.vtu")
    loaded = load_mesh("a.vtu")
    assert_array_equal(loaded.labels, values)
    assert any(name in note for note in loaded.notes)


def test_fields_that_are_no_labels(here):
    """Fractions, numbers below 0, and bins of a modulus are no tissues."""
    points, cells = nodes_of(box_mesh(3), 1)
    some = np.arange(len(cells))
    grid_of(
        points, cells, 3, region=some / 2, tissue=some - 1, young=1.0 + some, material=some
    ).save("a.vtu")
    assert load_mesh("a.vtu").labels is None


@pytest.mark.parametrize(
    ("own", "is_told"),
    [
        (lambda some: some / 2, True),
        (lambda some: some - 1, True),
        (lambda some: np.where(some < 9, np.nan, some), True),
        (lambda some: np.column_stack([some, some]), True),
        (lambda some: 0 * some, False),
    ],
)
def test_a_damaged_label_is_no_label(own, is_told, here):
    points, cells = nodes_of(box_mesh(3), 1)
    some = np.arange(len(cells))
    grid_of(points, cells, 3, label=own(some), region=some % 3).save("a.vtu")
    loaded = load_mesh("a.vtu")
    assert_array_equal(loaded.labels, some % 3)
    assert any("region" in note for note in loaded.notes)
    assert any('"label"' in note for note in loaded.notes) == is_told


def test_a_column_of_labels(here):
    import meshio

    mesh = box_mesh(3)
    labels = 1 + np.arange(len(mesh.cells)) % 3
    data = {"label": [labels[:, None]], "region": [labels + 1]}
    meshio.Mesh(mesh.points, [("tetra", mesh.cells)], cell_data=data).write(
        "a.xdmf", data_format="XML"
    )
    assert_array_equal(load_mesh("a.xdmf").labels, labels)


def test_a_named_field_of_labels(here, capsys):
    points, cells = nodes_of(box_mesh(3), 1)
    own = np.arange(len(cells)) % 3
    grid_of(points, cells, 3, labels=own, organ=own + 4, volume=own / 2).save("a.vtu")
    assert_array_equal(load_mesh("a.vtu", label_field="organ").labels, own + 4)
    assert_done("convert a.vtu b.vtu --label-field organ")
    assert set(load_mesh("b.vtu").labels) == {4, 5, 6}
    for name in ("volume", "nothing"):
        with refusal(f"label_field.*{name}.*organ"):
            load_mesh("a.vtu", label_field=name)
        assert exit_code("quality a.vtu --label-field", name) == 2
        assert "--label-field" in capsys.readouterr().err


# --------------------------------------------------------------------------------------------------
# gmsh's values


def text_of(*columns):
    rows = zip(*(np.reshape(each, (len(each), -1)).tolist() for each in columns), strict=True)
    return "".join(" ".join(str(x) for part in row for x in part) + "\n" for row in rows).encode()


def bytes_of(*columns):
    kinds = [
        (f"c{k}", "<i4" if np.asarray(each).dtype.kind == "i" else "<f8", np.shape(each)[1:])
        for k, each in enumerate(columns)
    ]
    table = np.zeros(len(columns[0]), kinds)
    for k, each in enumerate(columns):
        table[f"c{k}"] = each
    return table.tobytes()


def write_22(path, mesh, numbers, views, is_binary):
    """Nodes and tetrahedra with `numbers`, and one triangle on them before these."""
    write = bytes_of if is_binary else text_of
    end = b"\n" * is_binary
    at_nodes = 10 + np.arange(len(mesh.points))
    parts = [(2, [5], mesh.cells[:1, :3]), (4, numbers, mesh.cells)]
    body = b"$MeshFormat\n2.2 %d 8\n" % is_binary + (b"\1\0\0\0\n" if is_binary else b"")
    body += b"$EndMeshFormat\n$Nodes\n%d\n" % len(mesh.points) + write(at_nodes, mesh.points) + end
    body += b"$EndNodes\n$Elements\n%d\n" % (1 + len(mesh.cells))
    for kind, own, cells in parts:
        own = np.array(own)
        two = np.full((len(own), 2), 1)
        if is_binary:
            body += bytes_of(np.array([[kind, len(own), 2]])) + bytes_of(own, two, cells + 10)
        else:
            head = np.tile([kind, 2], (len(own), 1))
            body += text_of(own, head, two, cells + 10)
    body += end + b"$EndElements\n"
    for section, name, own, values in views:
        width = values[0].size
        body += b'$%s\n1\n"%s"\n1\n0.0\n3\n0\n%d\n%d\n' % (section, name, width, len(own))
        body += write(np.array(own), values) + end + b"$End%s\n" % section
    path.write_bytes(body)


@pytest.mark.parametrize("is_binary", [False, True])
def test_values_belong_to_numbers(is_binary, here):
    """Elements in any order with any numbers, rows of views in another; NaN where there is none."""
    mesh = box_mesh(3)
    rng = np.random.default_rng(0)
    numbers = 100 + rng.permutation(len(mesh.cells))
    rows, few = rng.permutation(len(mesh.cells)), np.arange(0, len(mesh.cells), 3)
    x = mesh.points[mesh.cells].mean(axis=1)
    views = [
        (b"ElementData", b"x", numbers[rows], x[rows, 0]),
        (b"ElementData", b"part", numbers[few], x[few]),
        (b"ElementData", b"skin", [5], np.ones(1)),
        (b"NodeData", b"y", [13, 11], np.array([3.5, 1.5])),
    ]
    write_22(here / "a.msh", mesh, numbers, views, is_binary)
    loaded = load_mesh("a.msh")
    order = np.argsort(numbers)  # of the cells as they are read
    assert_array_equal(loaded.mesh.points, mesh.points)
    assert_array_equal(loaded.mesh.cells, mesh.cells[order])
    assert_array_equal(loaded.cell_data["x"], x[order, 0])
    is_in = np.isin(order, few)
    assert_array_equal(loaded.cell_data["part"][is_in], x[order][is_in])
    assert np.isnan(loaded.cell_data["part"][~is_in]).all()
    assert "skin" not in loaded.cell_data
    assert_array_equal(loaded.point_data["y"][[1, 3]], [1.5, 3.5])
    assert np.isnan(np.delete(loaded.point_data["y"], [1, 3])).all()
    assert len(loaded.sets.facets) == 1


def test_partial_values_are_missing_voxels(here):
    mesh, image = box_mesh(3), image_of(3)
    save_image("i.nii.gz", image)
    few = np.arange(0, len(mesh.cells), 2)
    views = [(b"ElementData", b"x", 100 + few, np.ones(len(few)))]
    write_22(here / "a.msh", mesh, 100 + np.arange(len(mesh.cells)), views, False)
    assert_done("convert a.msh x.nii.gz --like i.nii.gz --fields x")
    import nibabel

    values = nibabel.load("x.nii.gz").get_fdata()
    assert 0.2 < np.isnan(values).mean() < 0.8
    assert set(values[np.isfinite(values)]) == {1.0}


@pytest.mark.parametrize("version", ["1.0", "4.0"])
def test_other_versions_of_gmsh_are_refused(version, here):
    (here / "a.msh").write_text(f"$MeshFormat\n{version} 0 8\n$EndMeshFormat\n")
    with refusal("2.2 or 4.1.*msh41"):
        load_mesh("a.msh")


@pytest.mark.parametrize("section", ["Nodes", "Elements", "ElementData"])
def test_cut_sections_of_gmsh_are_named(section, here):
    mesh = box_mesh(3)
    numbers = 100 + np.arange(len(mesh.cells))
    views = [(b"ElementData", b"x", numbers, np.ones(len(numbers)))]
    write_22(here / "a.msh", mesh, numbers, views, False)
    text = (here / "a.msh").read_text()
    (here / "a.msh").write_text(text[: text.index(f"$End{section}") - 9])
    with refusal(f"[$]{section}"):
        load_mesh("a.msh")


# --------------------------------------------------------------------------------------------------
# Units


def save_beside_image(n, mm, order=1, origin=0.0, part=1.0):
    """A box in a unit of `mm`, a.vtu, of a part of an image, i.nii.gz or i.png; both from an
    origin.
    """
    image = image_of(n)
    affine = image.affine.copy()
    affine[:n, n] += origin
    save_image("i.nii.gz", Image(image.data, affine))
    points, cells = nodes_of(box_mesh(n), order)
    grid_of((part * points + origin * (np.arange(3) < n)) / mm, cells, n, order).save("a.vtu")


UNITS = {"m": 1000.0, "cm": 10.0, "um": 1e-3}
COMMANDS = {
    "quality": "quality i.nii.gz a.vtu",
    "convert": "convert i.nii.gz a.vtu b.vtu --young h**2+1",
    "start": "mesh i.nii.gz --start a.vtu -o b.vtu --iterations 0",
}


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("origin", [0.0, -6.0, 30.0])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_mesh_in_another_unit_is_told_or_refused(unit, origin, command, here, capsys):
    save_beside_image(3, UNITS[unit], origin=origin)
    code = exit_code(COMMANDS[command])
    said = " ".join(capsys.readouterr().err.split())
    assert f"--mesh-units {unit}" in said
    assert said.count("times as long as the image") <= 1
    assert code == 2 or (unit, origin) != ("m", 0.0)
    assert exit_code(COMMANDS[command], f"--mesh-units {unit} --force") in (0, 1)
    assert "--mesh-units" not in capsys.readouterr().err


@pytest.mark.parametrize(("n", "order"), SHAPES)
def test_units_of_a_mesh_in_python(n, order, here):
    save_beside_image(n, 10.0, order)
    mesh = load_mesh("a.vtu", mesh_units="cm").mesh
    assert_allclose(mesh.points, box_mesh(n).points)
    with refusal("mesh_units.*cm.*inch"):
        load_mesh("a.vtu", mesh_units="inch")
    with pytest.warns(UserWarning, match="mesh_units` cm"):
        cell_fields(load_mesh("a.vtu").mesh, image_of(n))


@pytest.mark.parametrize("part", [0.2, 0.1])
@pytest.mark.parametrize("origin", [0.0, 30.0])
def test_a_mesh_of_a_part_of_the_image_is_in_mm(part, origin, here, capsys):
    save_beside_image(3, 1.0, origin=origin, part=part)
    exit_code("quality i.nii.gz a.vtu")
    said = capsys.readouterr().err
    assert "--mesh-units" not in said or (part, origin) == (0.1, 0.0)  # as if in cm


# --------------------------------------------------------------------------------------------------
# Other programs' files

ELEMENTS = {"C3D4": 1, "C3D4H": 1, "C3D10M": 2, "DC3D10": 2, "CPS3": 1, "CPE6": 2, "S3R": 1}


def lines_of(rows, separator=", "):
    return "".join(separator.join(map(str, row)) + "\n" for row in rows)


@pytest.mark.parametrize("kind", ELEMENTS)
def test_abaqus_of_others(kind, here):
    """Numbers with gaps, broken lines, generated sets, sets of sets, surfaces, two sections."""
    n, order = 3 if "3D" in kind else 2, ELEMENTS[kind]
    mesh = box_mesh(n)
    points, cells = nodes_of(mesh, order)
    at = 10 * np.arange(len(points)) + 5
    numbers = 100 + 2 * np.arange(len(cells))
    rows = "".join(
        f"{number}, "
        + ", ".join(map(str, at[cell][:4]))
        + ",\n" * (len(cell) > 4)
        + ", ".join(map(str, at[cell][4:]))
        + "\n"
        for number, cell in zip(numbers, cells, strict=True)
    )
    last = numbers[len(cells) // 2 - 1]
    low = np.flatnonzero(points[:, 0] == 0.0)
    (here / "a.inp").write_text(
        "*Heading\n by hand\n** a comment\n*Part, name=p\n*Node\n"
        + lines_of(zip(at, *points.T[: max(n, 2)].tolist(), strict=True))
        + f"*Element, type={kind}\n{rows}"
        + f"*Elset, elset=One, generate\n100, {last}, 2\n*Elset, elset=Two\n"
        + lines_of([[x] for x in numbers[len(cells) // 2 :]])
        + "*Elset, elset=Both\nOne, Two\n*Nset, nset=held\n"
        + lines_of([[x] for x in at[low]])
        + ("*Surface, type=ELEMENT, name=Skin\nOne, S1\n" if n == 3 else "")
        + "*Solid Section, elset=One, material=m\n,\n*Solid Section, elset=Two, material=m\n,\n"
        + "*End Part\n*Material, name=m\n*Elastic\n7., 0.3\n"
    )
    loaded = load_mesh("a.inp")
    assert_allclose(loaded.mesh.points, mesh.points)
    assert_array_equal(loaded.mesh.cells, mesh.cells)
    assert loaded.order == order
    half = len(cells) // 2
    sets = loaded.sets
    assert_array_equal(sets.cells["One"], np.arange(half))
    assert_array_equal(sets.cells["Both"], np.arange(len(cells)))
    assert_array_equal(loaded.labels, 1 + (np.arange(len(cells)) >= half))
    assert len(sets.facets["held"]) == 8 if n == 3 else 2
    assert n == 2 or len(sets.facets["Skin"]) > 0
    assert "young" not in loaded.cell_data  # in an unknown unit


@pytest.mark.parametrize(
    ("extra", "word"),
    [
        ("*Include, input=other.inp\n", "INCLUDE"),
        ("*Instance, name=i, part=p\n 0., 0., 9.\n*End Instance\n", "INSTANCE"),
        ("*Node\n1, 9., 9., 9.\n", "repeat"),
        ("*Element, type=C3D8\n9, 1, 2, 3, 4, 1, 2, 3, 4\n", "hexahedr"),
        ("*Element, type=C3D5\n9, 1, 2, 3, 4, 1\n", "pyramid"),
        ("*Element, type=COH3D8\n9, 1, 2, 3, 4, 1, 2, 3, 4\n", "COH3D8"),
        ("*Element, type=CIN3D8\n9, 1, 2, 3, 4, 1, 2, 3, 4\n", "CIN3D8"),
        ("*Element, type=C3D27\n9, 1, 2, 3, 4, 1, 2, 3, 4\n", "C3D27"),
        ("*System\n1., 0., 0.\n", "SYSTEM"),
        ("*Node, system=C\n999, 9., 9., 9.\n", "SYSTEM"),
        ("*Element, type=C3D4\n999, 1, 2", "C3D4"),
        ("*Node\n998, 9., 9., 9.\n999, 9.", "lines of 4"),
        ("*Elset, elset=a\nOther\n", "Other"),
        ("*Solid section, elset=None, material=m\n,\n", "None"),
    ],
)
def test_abaqus_that_is_not_one_flat_mesh_is_refused(extra, word, here):
    write_abaqus(here / "a.inp", extra)
    with refusal(word):
        load_mesh("a.inp")


def write_abaqus(path, extra, change=lambda nodes: nodes):
    """A box of tetrahedra, whose lines of nodes are changed."""
    points, cells = nodes_of(box_mesh(3), 1)
    numbers = np.arange(1, len(points) + 1)
    nodes = lines_of(zip(numbers, *points.T.tolist(), strict=True))
    rows = lines_of(zip(range(1, len(cells) + 1), *(cells + 1).T.tolist(), strict=True))
    path.write_text(f"*Node\n{change(nodes)}*Element, type=C3D4\n{rows}{extra}")


AGAIN = ", ".join(map(str, box_mesh(3).cells[3] + 1))


@pytest.mark.parametrize(
    ("extra", "members"),
    [
        ("*Elset, elset=One\n1, 2\n*Elset, elset=ONE\n5\n", [0, 1, 4]),
        ("*Elset, elset=a\n1, 2\n*Elset, elset=One\nA, 5\n", [0, 1, 4]),
        ("*Elset, elset=One, generate\n1, 3\n5, 9, 2\n11, 12\n", [0, 1, 2, 4, 6, 8, 10, 11]),
        ("*Elset, elset=One, generate\n5, 9, 2\n11, 12\n", [4, 6, 8, 10, 11]),
        ("*Elset,\n  elset=One\n1, 2\n", [0, 1]),
        (f"*Element, type=C3D4, elset=One\n999, {AGAIN}\n", [3]),
    ],
)
def test_sets_of_abaqus(extra, members, here):
    write_abaqus(here / "a.inp", extra)
    assert_array_equal(load_mesh("a.inp").sets.cells["One"], members)


@pytest.mark.parametrize(
    ("extra", "word"),
    [
        ("*Element, type=T3D2, elset=rods\n9001, 1, 2\n9002, 2, 3\n", "2 of type T3D2"),
        ("*Element, type=SPRINGA\n9001, 1, 2\n", "1 of type SPRINGA"),
        ("*Elset, elset=One\n1, 99999\n", "One"),
        ("*Elset, elset=One\n1, 2", "cut short"),
    ],
)
def test_what_an_abaqus_file_lacks_is_told(extra, word, here):
    write_abaqus(here / "a.inp", extra)
    assert any(word in note for note in load_mesh("a.inp").notes)


def test_whole_abaqus_files_have_no_notes(here):
    write_abaqus(here / "a.inp", "*Solid section, material=m\n,\n  ")
    assert load_mesh("a.inp").notes == ()


def test_sections_of_abaqus_in_another_case_are_labels(here):
    last = len(box_mesh(3).cells)
    sets = f"*Elset, elset=Skin, generate\n1, 9\n*Elset, elset=Bone, generate\n10, {last}\n"
    sections = "*Solid section, elset=SKIN, material=M\n,\n*Solid section, elset=bone, material=M\n"
    write_abaqus(here / "a.inp", sets + sections)
    assert_array_equal(load_mesh("a.inp").labels, 1 + (np.arange(last) >= 9))


@pytest.mark.parametrize(
    "change",
    [
        lambda nodes: nodes.replace(", 0.0", ", "),
        lambda nodes: nodes.replace(".0", ".D0"),
        lambda nodes: nodes.replace(".0", ".0d+00"),
        lambda nodes: nodes.replace("\n", ",\n"),
    ],
)
def test_numbers_of_abaqus(change, here):
    write_abaqus(here / "a.inp", "", change)
    assert_allclose(load_mesh("a.inp").mesh.points, box_mesh(3).points)


def test_sections_of_medit_add_up(here):
    mesh = box_mesh(3)
    half = len(mesh.cells) // 2
    text = f"MeshVersionFormatted 1\nDimension 3\nVertices\n{len(mesh.points)}\n"
    text += lines_of([*point, 0] for point in mesh.points.tolist()).replace(",", "")
    for cells in (mesh.cells[:half], mesh.cells[half:]):
        rows = lines_of([*cell, 1] for cell in (cells + 1).tolist()).replace(",", "")
        text += f"Tetrahedra\n{len(cells)}\n{rows}"
    (here / "a.mesh").write_text(f"{text}End\n")
    assert_array_equal(load_mesh("a.mesh").mesh.cells, mesh.cells)


def test_xdmf_of_two_grids_is_refused(here):
    import meshio

    mesh = box_mesh(3)
    meshio.Mesh(mesh.points, [("tetra", mesh.cells)]).write("a.xdmf", data_format="XML")
    text = (here / "a.xdmf").read_text()
    grid = text[text.index("<Grid") : text.index("</Grid>") + 7]
    (here / "a.xdmf").write_text(text.replace(grid, grid + grid))
    with refusal("uniform grid"):
        load_mesh("a.xdmf")


@pytest.mark.parametrize("suffix", [".mesh", ".xdmf"])
@pytest.mark.parametrize("n", [2, 3])
def test_meshes_by_meshio(suffix, n, here):
    import meshio

    mesh = box_mesh(n)
    labels = 1 + np.arange(len(mesh.cells)) % 3
    kind = {2: "triangle", 3: "tetra"}[n]
    name = {".mesh": "medit:ref", ".xdmf": "subdomains"}[suffix]
    points = mesh.points if suffix == ".mesh" else nodes_of(mesh, 1)[0]
    options = {"data_format": "XML"} if suffix == ".xdmf" else {}
    file = meshio.Mesh(points, [(kind, mesh.cells)], cell_data={name: [labels]})
    file.write(f"a{suffix}", **options)
    loaded = load_mesh(f"a{suffix}")
    assert_allclose(loaded.mesh.points, mesh.points)
    assert_array_equal(loaded.mesh.cells, mesh.cells)
    assert_array_equal(loaded.labels, labels)


@pytest.mark.parametrize("version", ["2.5", "4.0"])
@pytest.mark.parametrize("names", ["ab", "aab"])
def test_febio_of_others(version, names, here):
    """Parts in blocks, of which several may have one name."""
    mesh = box_mesh(3)
    blocks = np.array_split(np.arange(len(mesh.cells)), len(names))
    write_febio(here / "a.feb", version, zip(names, blocks, strict=True))
    loaded = load_mesh("a.feb")
    assert_allclose(loaded.mesh.points, mesh.points)
    assert_array_equal(loaded.mesh.cells, mesh.cells)
    assert_array_equal(loaded.sets.cells["few"], [0, 1])
    assert len(loaded.sets.facets["skin"]) == 1
    assert_array_equal(loaded.labels, 1 + (np.arange(len(mesh.cells)) >= blocks[-1][0]))


def test_other_cells_of_febio_are_refused(here):
    cell = '<Elements type="pyra5" name="q"><elem id="900">3,4,5,6,7</elem></Elements>'
    write_febio(here / "a.feb", "4.0", [("a", np.arange(40))], cell)
    with refusal("pyramid"):
        load_mesh("a.feb")


def write_febio(path, version, blocks, extra=""):
    mesh = box_mesh(3)
    section = "Geometry" if version == "2.5" else "Mesh"
    text = f'<febio_spec version="{version}"><{section}><Nodes name="all">'
    for k, x in enumerate(mesh.points.tolist()):
        text += f'<node id="{k + 3}">{",".join(map(str, x))}</node>'
    text += "</Nodes>"
    for name, those in blocks:
        text += f'<Elements type="tet4" mat="1" name="{name}">'
        for k in those:
            text += f'<elem id="{k + 1}">{",".join(map(str, mesh.cells[k] + 3))}</elem>'
        text += "</Elements>"
    members = "".join(f'<e id="{k}"/>' for k in (1, 2)) if version == "2.5" else "1,2"
    corners = ",".join(str(x) for x in mesh.cells[0][[1, 2, 3]] + 3)
    text += f'{extra}<ElementSet name="few">{members}</ElementSet>'
    text += f'<Surface name="skin"><tri3 id="1">{corners}</tri3></Surface>'
    path.write_text(f"{text}</{section}></febio_spec>")


@pytest.mark.parametrize("name", ["a.inp", "a.feb", "a.mesh", "a.xdmf"])
@pytest.mark.parametrize(
    "text",
    [
        "",
        "nonsense",
        "*Node\n1, x, 2\n",
        "*Node\n1, 2, 2\n*Element, type=C3D4\n1, 1, 1\n*Surface, type=ELEMENT\n",
        "*Elset, elset=a, generate\n1, 99999999999999, 1\n",
        "<a><b/></a>",
        "<a><Nodes><node id='x'>1,2</node><node id='2'>1</node></Nodes></a>",
        "Dimension 3\nVertices\n9\n",
        "Dimension 3\nVertices\n1e18 1\n",
        "Dimension inf\nVertices\n1 1 1 1 0\nTetrahedra\n1\n",
    ],
)
def test_files_that_hold_no_mesh(name, text, here):
    (here / name).write_text(text)
    with refusal(name):
        load_mesh(name)


def test_swapped_files_are_told(here, capsys):
    points, cells = nodes_of(box_mesh(3), 1)
    grid_of(points, cells, 3).save("m.vtu")
    assert exit_code("convert x.inp m.vtu") == 2
    assert "MESH comes first" in " ".join(capsys.readouterr().err.split())
