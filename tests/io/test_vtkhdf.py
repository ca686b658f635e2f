"""Models as VTKHDF files, by our reader and VTK's; others' in pieces; and what strangers may put into HDF5."""

import sys
import time

import h5py
import numpy as np
import pytest
from models import quadratic_model, sample_model

from tetopt.errors import InputError
from tetopt.io.formats import save_model
from tetopt.io.meshes import load_mesh
from tetopt.io.vtk import vtu
from tetopt.io.vtkhdf import hdf_arrays, vtkhdf

pytestmark = pytest.mark.usefixtures("here")


def in_parts(model, n_parts=3):
    """The model with its cells scattered over parts, so that a piece is no run of them."""
    part = np.random.default_rng(n_parts).integers(-1, n_parts - 1, len(model.mesh.cells))
    return model._replace(cell_data=model.cell_data | {"part": part})


def same(back, other):
    """Whether two files gave the same mesh with the same data and sets, to the bit and in the same order."""
    assert back.mesh.points.tobytes() == other.mesh.points.tobytes()
    assert back.mesh.cells.tobytes() == other.mesh.cells.tobytes()
    assert (back.order, back.space, back.box, back.notes) == (other.order, other.space, other.box, other.notes)
    for mine, theirs in zip((back.cell_data, back.point_data, back.field_data, *back.sets), (
        other.cell_data, other.point_data, other.field_data, *other.sets
    ), strict=True):  # fmt: skip
        assert list(mine) == list(theirs)
        for name, values in theirs.items():
            assert mine[name].dtype == values.dtype
            assert mine[name].tobytes() == values.tobytes()
    return True


@pytest.mark.parametrize(("make", "n"), [(sample_model, 2), (quadratic_model, 3)])
def test_it_gives_back_the_same_mesh(tmp_path, make, n):
    model = in_parts(make(n))
    (tmp_path / "a.vtu").write_bytes(vtu(model))
    save_model(tmp_path / "a.vtkhdf", model)
    assert same(load_mesh(tmp_path / "a.vtkhdf"), load_mesh(tmp_path / "a.vtu"))


def test_the_same_model_is_the_same_bytes():
    model = in_parts(sample_model())
    begin = int(time.time())
    whole = vtkhdf(model)
    assert vtkhdf(model) == whole
    seconds = range(begin, int(time.time()) + 1)
    assert not any(second.to_bytes(4, "little") in whole for second in seconds)  # when it was written is nowhere
    assert len(whole) < 8 * len(vtu(model))


def test_many_cells_are_packed(tmp_path):
    model = sample_model()
    n_columns = 2000
    model = model._replace(cell_data={"zeros": np.zeros((len(model.mesh.cells), n_columns))})
    assert len(vtkhdf(model)) < 8 * n_columns * len(model.mesh.cells) / 10


# Pieces of others


def write_pieces(path, pieces):
    """A file as a parallel program writes it: of each piece its points, its cells as rows of points, and data."""
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array([2, 0])
        root.attrs["Type"] = np.bytes_("UnstructuredGrid")
        root["NumberOfPoints"] = [len(points) for points, *_ in pieces]
        root["NumberOfCells"] = [len(cells) for _, cells, *_ in pieces]
        root["NumberOfConnectivityIds"] = [cells.size for _, cells, *_ in pieces]
        root["Points"] = np.concatenate([points for points, *_ in pieces])
        root["Types"] = np.concatenate([np.full(len(cells), 10, np.uint8) for _, cells, *_ in pieces])
        root["Connectivity"] = np.concatenate([cells.ravel() for _, cells, *_ in pieces])
        root["Offsets"] = np.concatenate([4 * np.arange(len(cells) + 1) for _, cells, *_ in pieces])
        for group, column in (("PointData", 2), ("CellData", 3)):
            into = root.create_group(group)
            for name in pieces[0][column]:
                into[name] = np.concatenate([piece[column][name] for piece in pieces])


def components_of(model):
    """The cells of each part, and of each of their points the coordinates; all with data."""
    for part in np.unique(model.cell_data["part"]):
        chosen = np.flatnonzero(model.cell_data["part"] == part)
        nodes, local = np.unique(model.mesh.cells[chosen], return_inverse=True)
        yield model.mesh.points[nodes], local.reshape(-1, 4), {"node": nodes}, {"cell": chosen}


def check_whole(back, model):
    """All points once, and each cell on those that it was on."""
    assert len(back.mesh.points) == len(model.mesh.points)
    np.testing.assert_array_equal(back.mesh.points, model.mesh.points[back.point_data["node"]])
    np.testing.assert_array_equal(back.point_data["node"][back.mesh.cells], model.mesh.cells[back.cell_data["cell"]])
    assert sorted(back.cell_data["cell"]) == list(range(len(model.mesh.cells)))


def test_pieces_are_joined_where_points_lie_at_one_place(tmp_path):
    model = in_parts(sample_model())
    pieces = list(components_of(model))
    no_cells = (np.empty((0, 3)), np.empty((0, 4), np.int64))
    nothing = (*no_cells, *({name: values[:0] for name, values in data.items()} for data in pieces[0][2:]))
    write_pieces(tmp_path / "a.vtkhdf", [nothing, *pieces, nothing])
    assert sum(len(points) for points, *_ in pieces) > len(model.mesh.points)
    check_whole(load_mesh(tmp_path / "a.vtkhdf"), model)


def test_points_at_one_place_in_one_piece_stay_apart(tmp_path):
    """As on the two lips of a slit, which the next piece goes on from."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [0, 0, -1]])
    lips = (points, np.array([[0, 1, 2, 3], [4, 2, 1, 5]]), {}, {})
    write_pieces(tmp_path / "a.vtkhdf", [lips, lips])
    back = hdf_arrays(str(tmp_path / "a.vtkhdf"))
    assert len(back["points"]) == len(points)
    cells = back["connectivity"].reshape(2, 2, 4)
    np.testing.assert_array_equal(cells[0], cells[1])
    assert cells[0, 0, 0] != cells[0, 1, 0]
    np.testing.assert_array_equal(back["points"][cells[0]], points[lips[1]])


@pytest.mark.parametrize("n_pieces", [1, 4])
def test_ghosts_are_left_out(tmp_path, n_pieces):
    model = in_parts(sample_model())
    own = list(components_of(model)) if n_pieces > 1 else [
        (model.mesh.points, model.mesh.cells, {"node": np.arange(len(model.mesh.points))},
         {"cell": np.arange(len(model.mesh.cells))})
    ]  # fmt: skip
    marked = [(p, c, at, of | {"vtkGhostType": np.zeros(len(c), np.uint8)}) for p, c, at, of in own]
    points, cells, at, of = marked[0]
    twice = (points, np.vstack([cells[:5], cells]), at, {
        "cell": np.r_[of["cell"][:5], of["cell"]], "vtkGhostType": np.r_[np.ones(5), np.zeros(len(cells))].astype("u1")
    })  # fmt: skip
    write_pieces(tmp_path / "a.vtkhdf", [twice, *marked[1:]])
    back = load_mesh(tmp_path / "a.vtkhdf")
    check_whole(back, model)
    assert "vtkGhostType" not in back.cell_data


def test_pieces_that_do_not_fit_together_are_refused(tmp_path):
    pieces = list(components_of(in_parts(sample_model())))
    points, cells, *data = pieces[1]
    beyond = cells.copy()
    beyond[0, 0] = len(points)
    write_pieces(tmp_path / "a.vtkhdf", [pieces[0], (points, beyond, *data), pieces[2]])
    with pytest.raises(InputError, match=r"a\.vtkhdf: damaged: cells use nodes that their piece does not have"):
        load_mesh(tmp_path / "a.vtkhdf")
    write_pieces(tmp_path / "a.vtkhdf", pieces)
    with h5py.File(tmp_path / "a.vtkhdf", "r+") as file:
        file["VTKHDF/Offsets"][len(pieces[0][1]) + 1] = 4
    with pytest.raises(InputError, match=r"a\.vtkhdf: damaged: its cells or data are inconsistent"):
        load_mesh(tmp_path / "a.vtkhdf")


# Untrusted files


@pytest.fixture
def file_path(tmp_path):
    path = tmp_path / "a.vtkhdf"
    path.write_bytes(vtkhdf(in_parts(sample_model())))
    return path


def changed(name, values, **options):
    def change(root):
        del root[name]
        root.create_dataset(name, data=values, **options)

    return change


def virtual(root):
    layout = h5py.VirtualLayout(shape=(192,), dtype="f8")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", shape=(192,))
    del root["CellData/mean"]
    root["CellData"].create_virtual_dataset("mean", layout)


def outside(root):
    del root["CellData/mean"]
    root["CellData"].create_dataset("mean", shape=(192,), dtype="f8", external=[("/etc/passwd", 0, 192 * 8)])


def linked(link, name="CellData/mean"):
    def change(root):
        del root[name]
        root[name] = link

    return change


def steps(root):
    root.create_group("Steps")


def attribute(name, value):
    def change(root):
        root.attrs[name] = value

    return change


def empty_bomb(root):
    del root["CellData/mean"]
    root["CellData"].create_dataset("mean", shape=(2**40,), dtype="f8", chunks=(2**16,), compression="gzip")


BAD = {
    "soft": (linked(h5py.SoftLink("/VTKHDF/CellData/volume")), 'expected data for "mean", got a link'),
    "external": (linked(h5py.ExternalLink("/etc/passwd", "/")), 'expected data for "mean", got a link'),
    "whole group": (linked(h5py.ExternalLink("b.h5", "/"), "PointData"), 'expected data for "PointData", got a link'),
    "virtual": (virtual, '"mean" is stored in another file'),
    "outside": (outside, '"mean" is stored in another file'),
    "bomb": (empty_bomb, 'damaged: "mean" declares 8796093022208 bytes, of which 0 are in'),
    "lzf": (changed("CellData/mean", np.zeros(192), compression="lzf"), '"mean" has an unsupported compression'),
    "compound": (changed("CellData/mean", np.zeros(192, "i4,f8")), '"mean" has neither numbers nor strings'),
    "short": (changed("CellData/mean", np.zeros(191)), 'damaged: "mean" has 191 rows, its pieces 192'),
    "three axes": (changed("CellData/mean", np.zeros((192, 2, 2))), "not an array with one or two axes"),
    "counts": (changed("NumberOfCells", [192, 0]), "damaged"),
    "overflow": (changed("NumberOfCells", [2**62, 2**62, 2**63 - 1]), "damaged"),
    "minus": (changed("NumberOfCells", [-1, 97, 96]), "damaged: expected one number in NumberOfCells"),
    "planar": (changed("Points", np.zeros((4, 2))), "do not have three coordinates"),
    "floats": (changed("Types", np.zeros(192)), "not lists of integers"),
    "group": (linked(np.zeros(3), "PointData"), '"PointData" is not a group'),
    "no cells": (lambda root: root.pop("Connectivity"), '"Connectivity" is not an array'),
    "steps": (steps, "found time steps"),
    "image": (attribute("Type", np.bytes_("ImageData")), "expected an unstructured grid, found ImageData"),
    "version": (attribute("Version", [3, 0]), "version 1 or 2"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_no_file_needs_is_refused(file_path, name):
    change, words = BAD[name]
    with h5py.File(file_path, "r+") as file:
        change(file["VTKHDF"])
    with pytest.raises(InputError, match=words) as caught:
        hdf_arrays(str(file_path))
    assert "\n" not in str(caught.value)


def test_texts_of_others_are_read(file_path):
    with h5py.File(file_path, "r+") as file:
        file["VTKHDF/FieldData"]["note"] = ["Größe", "b"]
    assert hdf_arrays(str(file_path))["field_data"]["note"].tolist() == ["Größe", "b"]


def test_a_file_cut_off_and_cells_beyond_their_points(file_path):
    whole = file_path.read_bytes()
    with h5py.File(file_path, "r+") as file:
        file["VTKHDF/Connectivity"][0] = 10**6
    with pytest.raises(InputError, match=r"a\.vtkhdf: .*node"):
        load_mesh(file_path)
    file_path.write_bytes(whole[:-100])
    with pytest.raises(InputError, match="damaged, or not an HDF5 file") as caught:
        load_mesh(file_path)
    assert "\n" not in str(caught.value)


def test_without_h5py_a_line_says_what_to_install(file_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    for call in (lambda: load_mesh(file_path), lambda: vtkhdf(sample_model())):
        with pytest.raises(InputError, match=r'\.vtkhdf files need h5py: pip install "h5py(>=[0-9.]+)?", or use \.vtu'):
            call()
