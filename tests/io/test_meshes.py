"""Meshes through VTU files: every bit comes back, other readers agree, and one line for every
bad file.
"""

import logging
import re
import warnings

import meshio
import numpy as np
import pytest
import pyvista
from numpy.testing import assert_allclose, assert_array_equal

from tetopt.errors import InputError
from tetopt.geometry.quadratic import cell_edges, quadratic
from tetopt.geometry.simplex import volumes
from tetopt.image import Image
from tetopt.io.formats import save_mesh
from tetopt.io.meshes import load_mesh
from tetopt.mesh import Mesh
from tetopt.model.fields import cell_fields
from tetopt.model.sets import MOST_LETTERS
from tetopt.start.lattice import lattice_mesh

OPTIONS = {"k_D": 0.2, "n_t": None, "crop": "ä"}
ABOUT = {
    "tetopt": "0.1.0",
    "image": "Schädel [1].nii.gz",
    "image_sha256": "ab" * 32,
    "options": OPTIONS,
}
FIELDS = ["mean", "variance", "n_voxels", "min", "max", "volume", "rho", "min_dihedral"]


def image_of(n):
    return Image(
        np.random.default_rng(0).normal(size=(5, 6, 7)[:n]), np.diag([*(0.7, 1.1, 2.3)[:n], 1.0])
    )


def bent(n):
    """A lattice with every node moved to coordinates that use all 53 bits."""
    mesh = lattice_mesh(image_of(n), blocks=(2, 2, 2)[:n])
    return Mesh(
        mesh.points + np.random.default_rng(1).normal(0.0, 0.05, mesh.points.shape), mesh.cells
    )


def write_grid(path, cells, points):
    """A VTU file of cells by VTK type, as another program might write it."""
    pyvista.UnstructuredGrid(
        {k: np.asarray(v) for k, v in cells.items()}, np.asarray(points, dtype=float)
    ).save(path)


# Node 4 makes one tetrahedron more on top of the first one; node 5 is used by no cell.
POINTS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [9, 9, 9]]
LINE, TRIANGLE, QUAD, TETRA, HEXAHEDRON, QUADRATIC = 3, 5, 9, 10, 12, 24

VTU = """<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian">
<UnstructuredGrid><Piece NumberOfPoints="5" NumberOfCells="1"><Points>
<DataArray type="Float64" NumberOfComponents="3" format="ascii">
0 0 0 1 0 0 0 1 0 0 0 {z} 5 5 5</DataArray></Points>
<Cells><DataArray type="Int64" Name="connectivity" format="ascii">{nodes}</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">4</DataArray>
<DataArray type="UInt8" Name="types" format="ascii">10</DataArray></Cells>
</Piece></UnstructuredGrid></VTKFile>"""


# --------------------------------------------------------------------------------------------------
# There and back


@pytest.mark.parametrize("n", [2, 3])
def test_every_bit_comes_back(tmp_path, n):
    mesh, image = bent(n), image_of(n)
    fields = cell_fields(mesh, image)
    assert list(fields) == FIELDS
    save_mesh(tmp_path / "a.vtu", mesh, fields, ABOUT)
    back = load_mesh(tmp_path / "a.vtu")
    assert back.mesh.points.tobytes() == mesh.points.tobytes()
    assert_array_equal(back.mesh.cells, mesh.cells)
    assert back.n_turned == 0
    assert list(back.cell_data) == FIELDS
    for name, expected in fields.items():
        assert back.cell_data[name].dtype == expected.dtype
        assert back.cell_data[name].tobytes() == expected.tobytes()
    image = meshio.read(tmp_path / "a.vtu").field_data["image"]
    assert image.tobytes().decode() == ABOUT["image"]
    assert [p.name for p in tmp_path.iterdir()] == ["a.vtu"]


def test_field_data_that_is_no_text_stays(tmp_path):
    grid = bent(3).to_pyvista()
    grid.field_data["numbers"] = np.array([1.5, 2.5])
    grid.field_data["bytes"] = np.array([255, 254], dtype=np.uint8)
    grid.field_data["string"] = ["of VTK"]
    grid.save(tmp_path / "a.vtu")
    back = load_mesh(tmp_path / "a.vtu").field_data
    assert {name: values.tolist() for name, values in back.items()} == {
        "numbers": [1.5, 2.5],
        "bytes": [255, 254],
        "string": ["of VTK"],
    }


def test_fields_of_a_mesh_without_an_image():
    mesh = Mesh([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]], [[0, 1, 2, 3]])
    fields = cell_fields(mesh)
    assert list(fields) == ["volume", "rho", "min_dihedral"]
    assert_allclose(fields["volume"], [8 / 6])
    # 54.7 degrees
    assert_allclose(fields["min_dihedral"], [np.degrees(np.arccos(1 / np.sqrt(3)))])
    # Inradius 2 / (3 + sqrt 3), circumradius sqrt 3.
    assert_allclose(fields["rho"], [2 / (3 + np.sqrt(3)) / np.sqrt(3)])


# --------------------------------------------------------------------------------------------------
# Files of other programs


def test_inverted_cells_are_turned_and_counted(tmp_path):
    cells = [[0, 1, 2, 3], [1, 2, 3, 4]]
    expected = [volumes(np.array(POINTS, dtype=float), np.array([c]))[0] for c in cells]
    assert min(expected) > 0.0
    for turned in ([0], [1], [0, 1]):
        swapped = [[c[1], c[0], *c[2:]] if k in turned else c for k, c in enumerate(cells)]
        write_grid(tmp_path / "a.vtu", {TETRA: swapped}, POINTS)
        back = load_mesh(tmp_path / "a.vtu")
        assert back.n_turned == len(turned)
        assert_allclose(volumes(back.mesh.points, back.mesh.cells), expected)
        assert_array_equal(np.sort(back.mesh.cells, axis=1), np.sort(cells, axis=1))


# --------------------------------------------------------------------------------------------------
# Cells of order 2


def quadratic_grid(n):
    """A grid of VTK's quadratic cells as another program might number them: middle nodes before
    corners, from last to first, some cells inverted; and its mesh, with the file's node of each
    of our nodes.
    """
    mesh = bent(n)
    ours, of_cell = quadratic(mesh.points, mesh.cells)
    place = len(ours) - 1 - np.arange(len(ours))  # in the file
    nodes = place[of_cell]
    # Exchanging corners 0 and 1 exchanges the edges that end there.
    turn = {2: [1, 0, 2, 3, 5, 4], 3: [1, 0, 2, 3, 4, 6, 5, 8, 7, 9]}[n]
    nodes[::3] = nodes[::3][:, turn]
    points = np.zeros((len(ours), 3))
    points[place, :n] = ours
    return pyvista.UnstructuredGrid({QUADRATIC - 2 * (n == 2): nodes}, points), mesh, place


@pytest.mark.parametrize("n", [2, 3])
def test_quadratic_cells_become_their_corners(tmp_path, n):
    """Point data come back in our order of edges, whatever that of the file, where corners are
    turned round, too.
    """
    grid, mesh, place = quadratic_grid(n)
    expected = np.random.default_rng(2).normal(size=(len(place), 3))
    field = np.empty_like(expected)
    field[place] = expected
    grid.point_data["displacement"] = field
    grid.point_data["name"] = ["x"] * len(place)
    grid.cell_data["k"] = np.arange(grid.n_cells)
    grid.save(tmp_path / "a.vtu")
    back = load_mesh(tmp_path / "a.vtu")
    assert (back.order, back.n_left, back.n_turned) == (2, 0, len(range(0, grid.n_cells, 3)))
    assert back.notes == ("dropped point data that are not numbers: name",)
    assert back.cell_data["k"].tolist() == list(range(grid.n_cells))
    # the corners in the order of the file, as ours are read
    nodes = np.argsort(place[: len(mesh.points)])
    assert_array_equal(back.mesh.points, mesh.points[nodes])
    places = quadratic(back.mesh.points, back.mesh.cells)[0]
    own = {
        tuple(point): row
        for point, row in zip(quadratic(mesh.points, mesh.cells)[0].round(9), expected, strict=True)
    }
    assert back.point_data["displacement"].tolist() == [
        own[tuple(point)].tolist() for point in places.round(9)
    ]


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("n", [2, 3])
def test_cells_of_vtk_s_lagrange_kinds(tmp_path, n, order):
    """As dolfinx writes them, whatever the order: with so few nodes they are numbered as the
    kinds of fixed size.
    """
    mesh = bent(n)
    nodes, cells = quadratic(mesh.points, mesh.cells) if order == 2 else (mesh.points, mesh.cells)
    points = np.column_stack([nodes, np.zeros((len(nodes), 3 - n))])
    sides = cells[:2, :2] if order == 1 else np.column_stack([cells[:2, :2], cells[:2, n + 1]])
    blocks = [(sides, 68), (cells, {2: 69, 3: 71}[n])]
    listed = [
        np.column_stack([np.full(len(rows), rows.shape[1]), rows]).ravel() for rows, _ in blocks
    ]
    kinds = np.concatenate([np.full(len(rows), kind) for rows, kind in blocks])
    grid = pyvista.UnstructuredGrid(np.concatenate(listed), kinds, points)
    grid.cell_data["k"] = np.arange(grid.n_cells)
    grid.save(tmp_path / "a.vtu")
    back = load_mesh(tmp_path / "a.vtu")
    assert (back.order, back.n_left, back.notes) == (order, 2, ())
    assert back.mesh.points.tobytes() == mesh.points.tobytes()
    assert_array_equal(back.mesh.cells, mesh.cells)
    assert back.cell_data["k"].tolist() == list(range(2, len(cells) + 2))


def test_cells_of_order_3_are_refused(tmp_path, assert_refused):
    points = np.random.default_rng(0).normal(size=(20, 3))
    pyvista.UnstructuredGrid(np.array([20, *range(20)]), np.array([71]), points).save(
        tmp_path / "a.vtu"
    )
    assert_refused(tmp_path / "a.vtu", "of order 1 or 2, found lagrange_tetrahedron")


@pytest.mark.parametrize("file_format", ["vtu", "vtk", "gmsh", "gmsh22"])
@pytest.mark.parametrize(("n", "order"), [(3, 1), (2, 2), (3, 2)])
def test_files_of_meshio(tmp_path, n, order, file_format):
    mesh = bent(n)
    nodes, cells = quadratic(mesh.points, mesh.cells) if order == 2 else (mesh.points, mesh.cells)
    points = np.column_stack([nodes, np.zeros((len(nodes), 3 - n))])
    path = tmp_path / f"a.{'msh' if file_format.startswith('gmsh') else file_format}"
    kind = {4: "tetra", 6: "triangle6", 10: "tetra10"}[cells.shape[1]]
    data = {"u": points + 1.0}, {"k": [np.arange(len(cells))]}
    meshio.write(path, meshio.Mesh(points, [(kind, cells)], *data), file_format)
    back = load_mesh(path)
    assert back.mesh.points.tobytes() == mesh.points.tobytes()
    assert_array_equal(back.mesh.cells, mesh.cells)
    assert (back.order, back.notes) == (order, ())
    assert_array_equal(back.point_data["u"], points + 1.0)
    assert_array_equal(back.cell_data["k"], np.arange(len(cells)))


@pytest.mark.parametrize("n", [2, 3])
def test_save_mesh_of_order_2(tmp_path, n):
    """Point data of every node, and of the corners alone, which are interpolated."""
    mesh = bent(n)
    points = quadratic(mesh.points, mesh.cells)[0]
    data = {"displacement": points * 0.5, "corners": mesh.points}
    save_mesh(tmp_path / "a.vtu", mesh, {"k": np.arange(len(mesh.cells))}, ABOUT, data, order=2)
    back = load_mesh(tmp_path / "a.vtu")
    assert (back.order, back.notes, back.text("image")) == (2, (), ABOUT["image"])
    assert back.cell_data["k"].tolist() == list(range(len(mesh.cells)))
    assert back.point_data["displacement"].tobytes() == (points * 0.5).tobytes()
    assert_allclose(back.point_data["corners"], points, rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("n", [2, 3])
def test_curved_edges_are_kept_and_told(tmp_path, n):
    grid, mesh, place = quadratic_grid(n)
    ends = np.sort(mesh.cells[:, cell_edges(n)], axis=2).reshape(-1, 2)
    edges = np.unique(ends, axis=0)
    length = np.linalg.norm(np.diff(mesh.points[edges], axis=1)[:, 0], axis=1)
    first = len(mesh.points)
    for number, fraction in ((3, 0.99e-6), (5, 1.01e-6), (7, 0.25)):
        grid.points[place[first + number], 0] += fraction * length[number]
    grid.save(tmp_path / "a.vtu")
    back = load_mesh(tmp_path / "a.vtu")
    (note,) = back.notes
    off = f"{0.25 * length[7]:.2g}"
    assert note == f"2 of {len(edges)} edges are curved by up to {off} mm"
    in_file = np.asarray(grid.points)[place[first:], :n]
    assert sorted(back.mesh.midpoints.tolist()) == sorted(in_file.tolist())
    assert_allclose(
        volumes(back.mesh.points, back.mesh.cells).sum(), volumes(mesh.points, mesh.cells).sum()
    )


def test_rounded_midpoints_of_a_file_in_single_precision_are_not_curved(tmp_path):
    mesh = bent(3)
    nodes, cells = quadratic(mesh.points + 100.0, mesh.cells)
    pyvista.UnstructuredGrid({QUADRATIC: cells}, nodes.astype(np.float32)).save(tmp_path / "a.vtu")
    assert load_mesh(tmp_path / "a.vtu").notes == ()


def test_two_middle_nodes_of_one_edge_are_told(tmp_path):
    points, cells = quadratic(*map(np.array, (POINTS[:5], [[0, 1, 2, 3], [1, 2, 3, 4]])))
    cells[1, 4] = len(points)  # of the edge 1 2, which cell 0 has, too
    grid = pyvista.UnstructuredGrid({QUADRATIC: cells}, np.vstack([points, [0.5, 0.5, 0.0]]))
    grid.save(tmp_path / "a.vtu")
    assert load_mesh(tmp_path / "a.vtu").notes == (
        "1 edges have different mid-edge nodes in their cells: using one of them",
    )


# --------------------------------------------------------------------------------------------------
# gmsh's physical groups


LONG = "x" * 77
NAMES = {
    (2, 1): "my left",
    (2, 2): "Skin",
    (2, 5): f"{LONG}a",
    (2, 6): f"{LONG}b",
    (2, 8): "1st",
    (2, 9): "nothing",
    (2, 10): "my_left",
    (3, 2): "skin",
    (3, 3): "Skin",
    (3, 8): "Höhle",
    (3, 9): "ok-1",
}
TRIANGLES = [[0, 1, 2], [1, 2, 4]]  # opposite local node 3 of cell 0 and local node 2 of cell 1
TETRAHEDRA = [[0, 1, 2, 3], [1, 2, 3, 4]]
# Of each triangle, and of each tetrahedron, which are an entity each; the sign is an orientation. 4
# and 7 have no name.
GROUPS = {2: [[1, 2, -4, 5], [2, 6, 8, 10]], 3: [[2, 3, 9], [7, 8]]}


def write_msh41(path, is_binary):
    """The two tetrahedra and triangles of these groups, and a point with its own, after gmsh's
    manual.
    """
    size, integer, real = np.uint64, np.int32, np.float64
    parts = []

    def add(dtype, *values):
        array = np.array(values, dtype=dtype)
        parts.append(
            array.tobytes() if is_binary else (" ".join(map(repr, array.tolist())) + "\n").encode()
        )

    def text(words):
        parts.append(words.encode())

    text(f"$MeshFormat\n4.1 {int(is_binary)} 8\n")
    if is_binary:
        add(integer, 1)
    text("\n$EndMeshFormat\n$PhysicalNames\n")
    text(
        f"{len(NAMES)}\n" + "".join(f'{dim} {tag} "{name}"\n' for (dim, tag), name in NAMES.items())
    )
    text("$EndPhysicalNames\n$Entities\n")
    add(size, 1, 0, 2, 2)
    for dim, tag, groups in [
        (0, 1, [1]),
        *((dim, k + 1, GROUPS[dim][k]) for dim in (2, 3) for k in (0, 1)),
    ]:
        add(integer, tag)
        add(real, *([0.5, 1e300, 0.0] if dim == 0 else [0.5, -2.5, 0.0, 1e300, 1.0, 1.0]))
        add(size, len(groups))
        add(integer, *groups)
        if dim:
            add(size, 2)
            add(integer, 7, -8)
    text("\n$EndEntities\n$Nodes\n")
    add(size, 1, 5, 1, 5)
    add(integer, 3, 1, 0)
    add(size, 5, 1, 2, 3, 4, 5)
    add(real, *np.ravel(POINTS[:5]))
    text("\n$EndNodes\n$Elements\n")
    add(size, 4, 4, 1, 4)
    for dim, kind, elements in ((2, 2, TRIANGLES), (3, 4, TETRAHEDRA)):
        for k, nodes in enumerate(elements):
            add(integer, dim, k + 1, kind)
            add(size, 1, 10 * dim + k, *(node + 1 for node in nodes))
    text("\n$EndElements\n")
    path.write_bytes(b"".join(parts))


@pytest.mark.parametrize("is_binary", [False, True])
def test_every_physical_group_becomes_a_set_of_a_valid_name(tmp_path, is_binary):
    write_msh41(tmp_path / "a.msh", is_binary)
    back = load_mesh(tmp_path / "a.msh")
    assert_array_equal(back.mesh.cells, TETRAHEDRA)
    first, second = [0, 3], [1, 2]  # rows of the triangles
    assert {name: rows.tolist() for name, rows in back.sets.facets.items()} == {
        "Skin": [first, second],
        "surface_4": [first],
        "my_left": [second],
        "my_left_2": [first],
        "x" * MOST_LETTERS: [first],
        f"{'x' * (MOST_LETTERS - 2)}_2": [second],
        "set_1st": [second],
    }
    assert {name: members.tolist() for name, members in back.sets.cells.items()} == {
        "skin_2": [0],
        "Skin_3": [0],
        "ok-1": [0],
        "volume_7": [1],
        "H_hle": [1],
    }
    assert set(back.notes) == {
        'renamed group "my left" to set my_left_2',
        f'renamed group "{LONG}a" to set {LONG[:MOST_LETTERS]}',
        f'renamed group "{LONG}b" to set {LONG[: MOST_LETTERS - 2]}_2',
        'renamed group "1st" to set set_1st',
        'renamed group "skin" to set skin_2',
        'renamed group "Skin" to set Skin_3',
        'renamed group "Höhle" to set H_hle',
    }


MSH22 = """$MeshFormat
2.2 0 8
$EndMeshFormat
{names}$Nodes
4
1 0 0 0
2 1 0 0
3 0 1 0
4 1 1 0
$EndNodes
$Elements
{n}
{elements}
$EndElements
"""


def write_msh22(path, elements, names=""):
    path.write_text(MSH22.format(names=names, n=len(elements), elements="\n".join(elements)))


def test_groups_without_a_name_in_2d(tmp_path):
    """A path of three boundary edges and one that is none, two triangles, one of them in no
    group.
    """
    edges = ["1 1 2 3 1 1 2", "2 1 2 3 1 2 4", "3 1 2 0 1 4 3", "4 1 2 6 1 1 4"]
    write_msh22(tmp_path / "a.msh2", [*edges, "5 2 2 0 1 1 2 3", "6 2 2 4 1 2 4 3"])
    back = load_mesh(tmp_path / "a.msh2")
    assert {name: rows.tolist() for name, rows in back.sets.facets.items()} == {
        "edge_3": [[0, 2], [1, 2]]
    }
    assert {name: members.tolist() for name, members in back.sets.cells.items()} == {
        "surface_4": [1]
    }
    assert back.notes == ('dropped group "edge_6": it contains no facets of cells',)


def test_groups_of_materials_give_way_to_moduli(tmp_path):
    """Of a file of ours that gmsh has written again, without the comments but with the views."""
    names = '$PhysicalNames\n2\n2 1 "material_1"\n2 2 "left"\n$EndPhysicalNames\n'
    write_msh22(tmp_path / "a.msh", ["1 2 2 1 1 1 2 3", "2 2 2 2 1 2 4 3"], names)
    assert set(load_mesh(tmp_path / "a.msh").sets.cells) == {"material_1", "left"}
    with (tmp_path / "a.msh").open("a") as file:
        file.write('$ElementData\n1\n"young"\n1\n0.0\n3\n0\n1\n2\n1 2.5\n2 3.5\n$EndElementData\n')
    back = load_mesh(tmp_path / "a.msh")
    assert back.cell_data["young"].tolist() == [2.5, 3.5]
    assert set(back.sets.cells) == {"left"}


# --------------------------------------------------------------------------------------------------
# Bad files


@pytest.fixture
def assert_refused(capfd, caplog):
    """`load_mesh` raises InputError in one line, and neither VTK nor pyvista says a word of its
    own.

    Under pytest what pyvista sends to the root logger is caught before it reaches the screen, so
    look there, too.
    """

    def check(path, match):
        before = list(logging.getLogger().filters)
        with (
            warnings.catch_warnings(record=True) as warned,
            pytest.raises(InputError, match=match) as caught,
        ):
            load_mesh(path)
        assert warned == []
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)
        assert capfd.readouterr() == ("", "")
        assert caplog.records == []
        assert logging.getLogger().filters == before

    return check


def test_a_missing_file(tmp_path, assert_refused):
    assert_refused(tmp_path / "no.vtu", "no such file")
    assert_refused(tmp_path, "got a folder")


@pytest.mark.parametrize("name", ["a.stl", "a"])
def test_another_suffix(tmp_path, name, assert_refused):
    (tmp_path / name).write_bytes(b"x")
    assert_refused(tmp_path / name, r"expected a \.vtu, \.vtk, \.msh or \.msh2 mesh$")


@pytest.mark.deep
@pytest.mark.parametrize("name", ["a.vtu", "a.vtk"])
@pytest.mark.parametrize(
    "raw",
    [b"", b"\n", b"no mesh at all", bytes(range(256)) * 20, b"<?xml version='1.0'?><html></html>"],
    ids=["empty", "newline", "words", "bytes", "html"],
)
def test_garbage(tmp_path, name, raw, assert_refused):
    (tmp_path / name).write_bytes(raw)
    assert_refused(tmp_path / name, "damaged|cannot be read|UTF-8")


@pytest.mark.apart
@pytest.mark.full
@pytest.mark.parametrize("fraction", [0.1, 0.9])
def test_truncated(tmp_path, fraction, assert_refused):
    save_mesh(tmp_path / "a.vtu", bent(3), cell_fields(bent(3)), ABOUT)
    whole = (tmp_path / "a.vtu").read_bytes()
    (tmp_path / "a.vtu").write_bytes(whole[: int(len(whole) * fraction)])
    assert_refused(tmp_path / "a.vtu", "damaged")


@pytest.mark.deep
@pytest.mark.parametrize("name", ["Points", "connectivity", "types", "options"])
def test_one_damaged_array(tmp_path, name, assert_refused):
    save_mesh(tmp_path / "a.vtu", bent(3), cell_fields(bent(3)), ABOUT)
    text = (tmp_path / "a.vtu").read_text()
    block = re.search(rf'Name="{name}"[^>]*>\s*(\S+)\s*<', text)
    middle = (block.start(1) + block.end(1)) // 2
    (tmp_path / "a.vtu").write_text(text[: middle - 4] + "AAAAAAAA" + text[middle + 4 :])
    assert_refused(tmp_path / "a.vtu", "damaged")


def test_another_vtk_data_set(tmp_path, assert_refused):
    pyvista.Sphere().save(tmp_path / "a.vtk")
    assert_refused(tmp_path / "a.vtk", "found PolyData")


@pytest.mark.full
@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ({TETRA: [[0, 1, 2, 3]], QUAD: [[0, 1, 4, 2]]}, "found quad"),
        (
            {TETRA: [[0, 1, 2, 3]], QUADRATIC: [[0, 1, 2, 4, 4, 5, 0, 1, 2, 3]]},
            "expected cells of one order, found tetra cells of both order 1 and order 2",
        ),
        ({QUADRATIC - 2: [[0, 1, 2, 3, 4, 5]]}, "plane z = 0"),
        ({QUADRATIC: [[0, 1, 2, 2, 4, 5, 4, 5, 4, 5]]}, "1 of 1 are flat"),
        ({LINE: [[0, 1]]}, "found line"),
        ({QUAD: [[0, 1, 4, 2]]}, "found quad"),
        ({HEXAHEDRON: [[0, 1, 2, 3, 4, 5, 0, 1]]}, "found hexahedron"),
    ],
)
def test_other_and_mixed_cells(tmp_path, cells, words, assert_refused):
    write_grid(tmp_path / "a.vtu", cells, POINTS)
    assert_refused(tmp_path / "a.vtu", words)


def test_triangles_on_tetrahedra_are_left_out_and_counted(tmp_path):
    grid = pyvista.UnstructuredGrid(
        {TRIANGLE: np.array([[0, 1, 2], [1, 2, 3]]), TETRA: np.array([[0, 1, 2, 3]])},
        np.array(POINTS[:5], dtype=float),
    )
    # in the order of the file, which pyvista has sorted
    grid.cell_data["k"] = np.array([7.0, 8.0, 9.0])
    kinds = grid.celltypes.tolist()
    grid.save(tmp_path / "a.vtu")
    back = load_mesh(tmp_path / "a.vtu")
    assert (len(back.mesh.cells), len(back.mesh.points), back.n_left) == (1, 4, 2)
    assert back.cell_data["k"].tolist() == [[7.0, 8.0, 9.0][kinds.index(TETRA)]]


@pytest.mark.full
@pytest.mark.parametrize(
    ("nodes", "z", "match"),
    [
        ("0 1 2 3", "0", "1 of 1 are flat"),
        ("0 1 2 2", "1", "1 of 1 are flat"),
        ("0 1 2 3", "nan", "expected finite coordinates, but node 3"),
        ("0 1 2 3", "inf", "expected finite coordinates, but node 3"),
        ("0 1 2 7", "1", "nodes 0..7, but it has 0..4"),
        ("0 1 2 -1", "1", "nodes -1..2, but it has 0..4"),
        pytest.param("0 1 2", "1", "damaged", marks=pytest.mark.apart),
    ],
)
def test_bad_cells(tmp_path, nodes, z, match, assert_refused):
    (tmp_path / "a.vtu").write_text(VTU.format(nodes=nodes, z=z))
    assert_refused(tmp_path / "a.vtu", match)


def test_a_middle_node_that_there_is_not(tmp_path, assert_refused):
    text = VTU.format(nodes="0 1 2 3 4 4 4 4 4 9", z="1")
    text = text.replace('"ascii">10<', '"ascii">24<').replace('"ascii">4<', '"ascii">10<')
    (tmp_path / "a.vtu").write_text(text)
    assert_refused(tmp_path / "a.vtu", "nodes 0..9, but it has 0..4; damaged")
