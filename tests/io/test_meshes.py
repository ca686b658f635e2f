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
from refusals import assert_refused

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


def grid_of(cells, points):
    """Cells by VTK type, as another program might have them."""
    return pyvista.UnstructuredGrid(
        {k: np.asarray(v) for k, v in cells.items()}, np.asarray(points, dtype=float)
    )


def of_order(mesh, order):
    """Nodes in space, and cells."""
    nodes, cells = quadratic(mesh.points, mesh.cells) if order == 2 else (mesh.points, mesh.cells)
    return np.column_stack([nodes, np.zeros((len(nodes), 3 - mesh.ndim))]), cells


# Node 4 makes one tetrahedron more on top of the first one; node 5 is used by no cell.
POINTS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [9, 9, 9]]
TETRAHEDRA = [[0, 1, 2, 3], [1, 2, 3, 4]]
LINE, TRIANGLE, QUAD, TETRA, HEXAHEDRON, QUADRATIC = 3, 5, 9, 10, 12, 24

VTU = """<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian">
<UnstructuredGrid><Piece NumberOfPoints="5" NumberOfCells="1"><Points>
<DataArray type="Float64" NumberOfComponents="3" format="ascii">
0 0 0 1 0 0 0 1 0 0 0 {z} 5 5 5</DataArray></Points>
<Cells><DataArray type="Int64" Name="connectivity" format="ascii">{nodes}</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">{count}</DataArray>
<DataArray type="UInt8" Name="types" format="ascii">{kind}</DataArray></Cells>
</Piece></UnstructuredGrid></VTKFile>"""


# --------------------------------------------------------------------------------------------------
# There and back


def test_every_bit_comes_back(here, n):
    mesh = bent(n)
    fields = cell_fields(mesh, image_of(n))
    assert list(fields) == FIELDS
    save_mesh("a.vtu", mesh, fields, ABOUT)
    back = load_mesh("a.vtu")
    assert back.mesh.points.tobytes() == mesh.points.tobytes()
    assert_array_equal(back.mesh.cells, mesh.cells)
    assert back.n_turned == 0
    assert list(back.cell_data) == FIELDS
    for name, expected in fields.items():
        assert back.cell_data[name].dtype == expected.dtype
        assert back.cell_data[name].tobytes() == expected.tobytes()
    image = meshio.read("a.vtu").field_data["image"]
    assert image.tobytes().decode() == ABOUT["image"]
    assert [p.name for p in here.iterdir()] == ["a.vtu"]


def test_field_data_that_is_no_text_stays(here):
    grid = bent(3).to_pyvista()
    values = {"numbers": [1.5, 2.5], "bytes": [255, 254], "string": ["of VTK"]}
    for name, kind in (("numbers", float), ("bytes", np.uint8), ("string", str)):
        grid.field_data[name] = np.array(values[name], dtype=kind)
    grid.save("a.vtu")
    back = load_mesh("a.vtu").field_data
    assert {name: each.tolist() for name, each in back.items()} == values


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


def test_inverted_cells_are_turned_and_counted(here):
    cells = TETRAHEDRA
    expected = volumes(np.array(POINTS, dtype=float), np.array(cells))
    assert min(expected) > 0.0
    for turned in ([0], [1], [0, 1]):
        swapped = [[c[1], c[0], *c[2:]] if k in turned else c for k, c in enumerate(cells)]
        grid_of({TETRA: swapped}, POINTS).save("a.vtu")
        back = load_mesh("a.vtu")
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


def test_quadratic_cells_become_their_corners(here, n):
    """Point data come back in our order of edges, whatever that of the file, where corners are
    turned round, too.
    """
    grid, mesh, place = quadratic_grid(n)
    nodes = quadratic(mesh.points, mesh.cells)[0]
    grid.point_data["place"] = np.zeros_like(grid.points)
    grid.point_data["place"][place, :n] = nodes
    grid.point_data["name"] = ["x"] * len(place)
    grid.cell_data["k"] = np.arange(grid.n_cells)
    grid.save("a.vtu")
    back = load_mesh("a.vtu")
    assert (back.order, back.n_left, back.n_turned) == (2, 0, len(range(0, grid.n_cells, 3)))
    assert back.notes == ("dropped point data that are not numbers: name",)
    assert back.cell_data["k"].tolist() == list(range(grid.n_cells))
    # the corners in the order of the file, as ours are read
    assert_array_equal(back.mesh.points, mesh.points[np.argsort(place[: len(mesh.points)])])
    assert_allclose(
        back.point_data["place"][:, :n], quadratic(back.mesh.points, back.mesh.cells)[0], rtol=1e-14
    )


def test_cells_of_vtk_s_lagrange_kinds(here, n, order):
    """As dolfinx writes them, whatever the order: with so few nodes they are numbered as the
    kinds of fixed size.
    """
    mesh = bent(n)
    points, cells = of_order(mesh, order)
    sides = cells[:2, [0, 1, n + 1][: order + 1]]
    listed = [[len(row), *row] for row in [*sides, *cells]]
    kinds = [68] * 2 + [{2: 69, 3: 71}[n]] * len(cells)
    grid = pyvista.UnstructuredGrid(np.concatenate(listed), np.array(kinds), points)
    grid.cell_data["k"] = np.arange(grid.n_cells)
    grid.save("a.vtu")
    back = load_mesh("a.vtu")
    assert (back.order, back.n_left, back.notes) == (order, 2, ())
    assert back.mesh.points.tobytes() == mesh.points.tobytes()
    assert_array_equal(back.mesh.cells, mesh.cells)
    assert back.cell_data["k"].tolist() == list(range(2, len(cells) + 2))


@pytest.mark.parametrize("file_format", ["vtu", "vtk", "gmsh", "gmsh22"])
@pytest.mark.parametrize(("n", "order"), [(3, 1), (2, 2), (3, 2)])
def test_files_of_meshio(tmp_path, n, order, file_format):
    mesh = bent(n)
    points, cells = of_order(mesh, order)
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


def test_curved_edges_are_kept_and_told(here, n):
    grid, mesh, place = quadratic_grid(n)
    edges = np.unique(np.sort(mesh.cells[:, cell_edges(n)], axis=2).reshape(-1, 2), axis=0)
    length = np.linalg.norm(np.diff(mesh.points[edges], axis=1)[:, 0], axis=1)
    middles = place[len(mesh.points) :]
    for number, fraction in ((3, 0.99e-6), (5, 1.01e-6), (7, 0.25)):
        grid.points[middles[number], 0] += fraction * length[number]
    grid.save("a.vtu")
    back = load_mesh("a.vtu")
    words = f"2 of {len(edges)} edges are curved by up to {0.25 * length[7]:.2g} mm"
    assert back.notes == (words,)
    in_file = np.asarray(grid.points)[middles, :n]
    assert sorted(back.mesh.midpoints.tolist()) == sorted(in_file.tolist())
    sizes = [volumes(each.points, each.cells).sum() for each in (back.mesh, mesh)]
    assert_allclose(*sizes)


def test_rounded_midpoints_of_a_file_in_single_precision_are_not_curved(here):
    mesh = bent(3)
    nodes, cells = quadratic(mesh.points + 100.0, mesh.cells)
    pyvista.UnstructuredGrid({QUADRATIC: cells}, nodes.astype(np.float32)).save("a.vtu")
    assert load_mesh("a.vtu").notes == ()


def test_two_middle_nodes_of_one_edge_are_told(here):
    points, cells = quadratic(np.array(POINTS[:5]), np.array(TETRAHEDRA))
    cells[1, 4] = len(points)  # of the edge 1 2, which cell 0 has, too
    grid_of({QUADRATIC: cells}, [*points, [0.5, 0.5, 0.01]]).save("a.vtu")
    words = "1 edges have different mid-edge nodes in their cells: using one of them"
    assert words in load_mesh("a.vtu").notes


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
def test_every_physical_group_becomes_a_set_of_a_valid_name(here, is_binary):
    write_msh41(here / "a.msh", is_binary)
    back = load_mesh("a.msh")
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


def test_groups_without_a_name_in_2d(here):
    """A path of three boundary edges and one that is none, two triangles, one of them in no
    group.
    """
    edges = ["1 1 2 3 1 1 2", "2 1 2 3 1 2 4", "3 1 2 0 1 4 3", "4 1 2 6 1 1 4"]
    write_msh22(here / "a.msh2", [*edges, "5 2 2 0 1 1 2 3", "6 2 2 4 1 2 4 3"])
    back = load_mesh("a.msh2")
    assert {name: rows.tolist() for name, rows in back.sets.facets.items()} == {
        "edge_3": [[0, 2], [1, 2]]
    }
    assert {name: members.tolist() for name, members in back.sets.cells.items()} == {
        "surface_4": [1]
    }
    words = 'dropped group "edge_6": it contains no facets of cells'
    assert back.notes == (words, 'labels are those of cell field "gmsh:physical"')


def test_groups_of_materials_give_way_to_moduli(tmp_path):
    """Of a file of ours that gmsh has written again, without the comments but with the views."""
    path, elements = tmp_path / "a.msh", ["1 2 2 1 1 1 2 3", "2 2 2 2 1 2 4 3"]
    write_msh22(
        path, elements, '$PhysicalNames\n2\n2 1 "material_1"\n2 2 "left"\n$EndPhysicalNames\n'
    )
    assert set(load_mesh(path).sets.cells) == {"material_1", "left"}
    view = '$ElementData\n1\n"young"\n1\n0.0\n3\n0\n1\n2\n1 2.5\n2 3.5\n$EndElementData\n'
    path.write_text(path.read_text() + view)
    back = load_mesh(path)
    assert back.cell_data["young"].tolist() == [2.5, 3.5]
    assert set(back.sets.cells) == {"left"}


# --------------------------------------------------------------------------------------------------
# Bad files


def bad_grid(cells):
    return lambda path: grid_of(cells, POINTS).save(path)


def bad_text(nodes="0 1 2 3", z="1", kind="10"):
    text = VTU.format(nodes=nodes, z=z, kind=kind, count={"10": 4, "24": 10}[kind])
    return lambda path: path.write_text(text)


def order_3(path):
    points = np.random.default_rng(0).normal(size=(20, 3))
    pyvista.UnstructuredGrid(np.array([20, *range(20)]), np.array([71]), points).save(path)


def damaged_at(name):
    """A file with some letters of one array exchanged."""

    def write(path):
        save_mesh(path, bent(3), cell_fields(bent(3)), ABOUT)
        text = path.read_text()
        block = re.search(rf'Name="{name}"[^>]*>\s*(\S+)\s*<', text)
        middle = (block.start(1) + block.end(1)) // 2
        path.write_text(text[: middle - 4] + "AAAAAAAA" + text[middle + 4 :])

    return write


def cut_at(fraction):
    def write(path):
        save_mesh(path, bent(3), cell_fields(bent(3)), ABOUT)
        whole = path.read_bytes()
        path.write_bytes(whole[: int(len(whole) * fraction)])

    return write


def raw(content):
    return lambda path: path.write_bytes(content)


FULL, DEEP, APART = pytest.mark.full, pytest.mark.deep, pytest.mark.apart
UNKNOWN = r"expected a \.vtu, .* or \.xdmf mesh; .*\.vtu"
GARBAGE = [
    b"",
    b"\n",
    b"no mesh at all",
    bytes(range(256)) * 20,
    b"<?xml version='1.0'?><html></html>",
]
REFUSED = [
    ("no.vtu", lambda path: None, "no such file", ()),
    ("a.vtu", lambda path: path.mkdir(), "got a folder", ()),
    *((name, raw(b"x"), UNKNOWN, ()) for name in ("a.stl", "a")),
    *(
        (name, raw(content), "damaged|cannot be read|UTF-8", DEEP)
        for name in ("a.vtu", "a.vtk")
        for content in GARBAGE
    ),
    *(("a.vtu", cut_at(fraction), "damaged", [APART, FULL]) for fraction in (0.1, 0.9)),
    *(
        ("a.vtu", damaged_at(name), "damaged", DEEP)
        for name in ("Points", "connectivity", "types", "options")
    ),
    ("a.vtk", lambda path: pyvista.Sphere().save(path), "found PolyData", ()),
    ("a.vtu", order_3, "of order 1 or 2, found lagrange_tetrahedron", ()),
    ("a.vtu", bad_grid({TETRA: [[0, 1, 2, 3]], QUAD: [[0, 1, 4, 2]]}), "found quad", FULL),
    (
        "a.vtu",
        bad_grid({TETRA: [[0, 1, 2, 3]], QUADRATIC: [[0, 1, 2, 4, 4, 5, 0, 1, 2, 3]]}),
        "expected cells of one order, found tetra cells of both order 1 and order 2",
        FULL,
    ),
    ("a.vtu", bad_grid({QUADRATIC - 2: [[0, 1, 2, 3, 4, 5]]}), "plane z = 0", FULL),
    ("a.vtu", bad_grid({QUADRATIC: [[0, 1, 2, 2, 4, 5, 4, 5, 4, 5]]}), "1 of 1 are flat", FULL),
    ("a.vtu", bad_grid({LINE: [[0, 1]]}), "found line", FULL),
    ("a.vtu", bad_grid({QUAD: [[0, 1, 4, 2]]}), "found quad", FULL),
    ("a.vtu", bad_grid({HEXAHEDRON: [[0, 1, 2, 3, 4, 5, 0, 1]]}), "found hexahedron", FULL),
    ("a.vtu", bad_text(z="0"), "1 of 1 are flat", FULL),
    ("a.vtu", bad_text("0 1 2 2"), "1 of 1 are flat", FULL),
    *(
        ("a.vtu", bad_text(z=z), "expected finite coordinates, but node 3", FULL)
        for z in ("nan", "inf")
    ),
    ("a.vtu", bad_text("0 1 2 7"), "nodes 0..7, but it has 0..4", FULL),
    ("a.vtu", bad_text("0 1 2 -1"), "nodes -1..2, but it has 0..4", FULL),
    ("a.vtu", bad_text("0 1 2"), "damaged", [APART, FULL]),
    # a middle node that there is not
    (
        "a.vtu",
        bad_text("0 1 2 3 4 4 4 4 4 9", kind="24"),
        "nodes 0..9, but it has 0..4; damaged",
        (),
    ),
]


@pytest.mark.parametrize(
    ("name", "write", "words"), [pytest.param(*row, marks=marks) for *row, marks in REFUSED]
)
def test_files_that_are_no_mesh(here, name, write, words, capfd, caplog):
    """Neither VTK nor pyvista says a word of its own.

    Under pytest what pyvista sends to the root logger is caught before it reaches the screen, so
    look there, too.
    """
    write(here / name)
    before = list(logging.getLogger().filters)
    with warnings.catch_warnings(record=True) as warned:
        assert_refused(name, words, load_mesh)
    assert warned == []
    assert capfd.readouterr() == ("", "")
    assert caplog.records == []
    assert logging.getLogger().filters == before


def test_triangles_on_tetrahedra_are_left_out_and_counted(here):
    grid = grid_of({TRIANGLE: [[0, 1, 2], [1, 2, 3]], TETRA: [[0, 1, 2, 3]]}, POINTS[:5])
    # in the order of the file, which pyvista has sorted
    grid.cell_data["k"] = np.array([7.0, 8.0, 9.0])
    kinds = grid.celltypes.tolist()
    grid.save("a.vtu")
    back = load_mesh("a.vtu")
    assert (len(back.mesh.cells), len(back.mesh.points), back.n_left) == (1, 4, 2)
    assert back.cell_data["k"].tolist() == [[7.0, 8.0, 9.0][kinds.index(TETRA)]]
