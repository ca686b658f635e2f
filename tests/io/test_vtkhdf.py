"""Models as VTKHDF files: in pieces and whole, by our reader and VTK's; and what strangers may put into HDF5."""

import sys
import time

import h5py
import numpy as np
import pytest
import pyvista
from models import quadratic_model, sample_model

from tetopt.cli import main
from tetopt.errors import InputError
from tetopt.io.formats import save_model
from tetopt.io.meshes import load_mesh
from tetopt.io.pieces import MOST_PIECES, joined, model_pieces
from tetopt.io.vtk import vtu
from tetopt.io.vtkhdf import hdf_pieces, vtkhdf


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


@pytest.mark.parametrize("suffix", [".vtkhdf", ".pvtu"])
@pytest.mark.parametrize(("make", "n"), [(sample_model, 2), (quadratic_model, 3)])
def test_pieces_give_back_the_same_mesh(tmp_path, make, n, suffix):
    """Cells and points of a piece are scattered over the whole, and yet all comes back in its order."""
    model = in_parts(make(n))
    (tmp_path / "a.vtu").write_bytes(vtu(model))
    save_model(tmp_path / f"a{suffix}", model)
    assert same(load_mesh(tmp_path / f"a{suffix}"), load_mesh(tmp_path / "a.vtu"))


def test_other_readers_see_the_pieces(tmp_path):
    model = in_parts(sample_model())
    save_model(tmp_path / "a.vtkhdf", model)
    pieces = pyvista.read(tmp_path / "a.vtkhdf")
    assert [np.unique(piece.cell_data["part"]).tolist() for piece in pieces] == [[-1], [0], [1]]
    for piece in pieces:
        chosen, nodes = piece.cell_data["GlobalCellIds"], piece.point_data["GlobalPointIds"]
        np.testing.assert_array_equal(piece.points, model.mesh.points[nodes])
        np.testing.assert_array_equal(nodes[piece.cells_dict[10]], model.mesh.cells[chosen])
        np.testing.assert_array_equal(piece.cell_data["mean"], model.cell_data["mean"][chosen])
        assert piece.n_points == len(np.unique(model.mesh.cells[chosen]))  # none that it does not use
    assert sum(piece.n_cells for piece in pieces) == len(model.mesh.cells)


def test_other_readers_see_one_piece(tmp_path):
    model = sample_model()
    save_model(tmp_path / "a.vtkhdf", model)
    grid = pyvista.read(tmp_path / "a.vtkhdf")
    np.testing.assert_array_equal(grid.points, model.mesh.points)
    np.testing.assert_array_equal(grid.cells_dict[10], model.mesh.cells)
    np.testing.assert_array_equal(grid.field_data["facets:boundary"], model.sets.facets["boundary"])
    assert "GlobalPointIds" not in grid.point_data


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


@pytest.mark.parametrize(
    "part",
    [lambda n: np.arange(n) + 0.5, lambda n: np.full(n, np.nan), lambda n: np.ones((n, 3)), lambda n: np.full(n, 7)],
    ids=["halves", "NaN", "vectors", "one"],
)
def test_what_is_no_part_cuts_nothing(part):
    model = sample_model()
    model = model._replace(cell_data=model.cell_data | {"part": part(len(model.mesh.cells))})
    assert len(list(model_pieces(model))) == 1


def test_too_many_parts_are_refused(monkeypatch):
    monkeypatch.setattr("tetopt.io.pieces.MOST_PIECES", 2)
    assert MOST_PIECES > 2
    with pytest.raises(InputError, match=r'^cell data "part": expected at most 2 parts, got 3; call it otherwise'):
        list(model_pieces(in_parts(sample_model())))


def test_data_that_are_called_as_ours_keep_their_values(tmp_path):
    """They are numbered where the pieces' own have their name."""
    model = in_parts(sample_model())
    values = np.arange(len(model.mesh.cells))[::-1].copy()
    save_model(tmp_path / "a.vtkhdf", model._replace(cell_data=model.cell_data | {"GlobalCellIds": values}))
    back = load_mesh(tmp_path / "a.vtkhdf")
    np.testing.assert_array_equal(back.cell_data["GlobalCellIds_2"], values)
    np.testing.assert_array_equal(back.mesh.cells, model.mesh.cells)


# Pieces of others


def stripped(piece, *names):
    return piece._replace(
        point_data={name: values for name, values in piece.point_data.items() if name not in names},
        cell_data={name: values for name, values in piece.cell_data.items() if name not in names},
    )


def test_pieces_without_numbers_are_joined_where_points_lie_at_one_place():
    model = in_parts(sample_model())
    pieces = [stripped(each, "GlobalPointIds", "GlobalCellIds") for each in model_pieces(model)]
    whole = joined(pieces)
    assert len(whole.points) == len(model.mesh.points)
    order = np.argsort(model.cell_data["part"], kind="stable")
    places = whole.points[whole.connectivity].reshape(-1, 4, 3)
    np.testing.assert_array_equal(places, model.mesh.points[model.mesh.cells[order]])
    np.testing.assert_array_equal(whole.cell_data["mean"], model.cell_data["mean"][order])
    first = np.unique(whole.connectivity, return_index=True)[1]
    assert (whole.connectivity[np.sort(first)] >= 0).all()


def test_points_at_one_place_in_one_piece_stay_apart():
    """As on the two lips of a slit, which the next piece goes on from."""
    piece = next(model_pieces(sample_model()))
    slit = piece._replace(points=np.concatenate([piece.points, piece.points[:1]]), point_data={})
    slit.connectivity[-4:] = [len(piece.points), 1, 2, 3]
    whole = joined([slit, slit])
    assert len(whole.points) == len(slit.points)
    np.testing.assert_array_equal(whole.connectivity.reshape(2, -1), [slit.connectivity] * 2)


def test_numbers_that_are_not_the_points_own_are_no_numbers():
    """As where a program numbers each piece from 0 on: coordinates decide, and the numbers stay as data."""
    model = in_parts(sample_model())
    pieces = [
        piece._replace(
            point_data=piece.point_data | {"GlobalPointIds": np.arange(len(piece.points))},
            cell_data=piece.cell_data | {"GlobalCellIds": np.arange(len(piece.cell_types))},
        )
        for piece in model_pieces(model)
    ]
    whole = joined(pieces)
    assert len(whole.points) == len(model.mesh.points)
    assert "GlobalPointIds" in whole.point_data
    assert "GlobalCellIds" in whole.cell_data


def test_ghosts_are_left_out_and_lost_data_told():
    model = in_parts(sample_model())
    pieces = list(model_pieces(model))
    ghost = pieces[0]._replace(
        cell_data=pieces[0].cell_data | {"vtkGhostType": np.ones(len(pieces[0].cell_types), "u1")}
    )
    none = np.zeros(len(pieces[1].cell_types), "u1")
    pieces[1] = stripped(pieces[1]._replace(cell_data=pieces[1].cell_data | {"vtkGhostType": none}), "mean")
    whole = joined([*pieces, ghost])
    assert len(whole.cell_types) == len(model.mesh.cells)
    assert whole.notes == ("data left out, as not every piece has them, of one type: mean",)
    assert "mean" not in whole.cell_data


# Strangers' files


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
    "soft": (linked(h5py.SoftLink("/VTKHDF/CellData/volume")), '"mean" is a link to elsewhere'),
    "external": (linked(h5py.ExternalLink("/etc/passwd", "/")), '"mean" is a link to elsewhere'),
    "whole group": (linked(h5py.ExternalLink("b.h5", "/"), "PointData"), '"PointData" is a link to elsewhere'),
    "virtual": (virtual, '"mean" lies in another file'),
    "outside": (outside, '"mean" lies in another file'),
    "bomb": (empty_bomb, 'damaged: "mean" is of 8796093022208 bytes, the file has 0 for it'),
    "lzf": (changed("CellData/mean", np.zeros(192), compression="lzf"), '"mean" is packed in a way that is not read'),
    "compound": (changed("CellData/mean", np.zeros(192, "i4,f8")), '"mean" holds neither numbers nor texts'),
    "short": (changed("CellData/mean", np.zeros(191)), 'damaged: "mean" has 191 rows, its pieces 192'),
    "three axes": (changed("CellData/mean", np.zeros((192, 2, 2))), "no array of one or two axes"),
    "counts": (changed("NumberOfCells", [192, 0]), "damaged"),
    "overflow": (changed("NumberOfCells", [2**62, 2**62, 2**63 - 1]), "damaged"),
    "minus": (changed("NumberOfCells", [-1, 97, 96]), "damaged: NumberOfCells is not"),
    "planar": (changed("Points", np.zeros((4, 2))), "not three coordinates"),
    "floats": (changed("Types", np.zeros(192)), "no lists of whole numbers"),
    "group": (linked(np.zeros(3), "PointData"), '"PointData" is no group'),
    "no cells": (lambda root: root.pop("Connectivity"), '"Connectivity" is no array'),
    "steps": (steps, "found steps of time"),
    "image": (attribute("Type", np.bytes_("ImageData")), "expected an unstructured grid, found ImageData"),
    "version": (attribute("Version", [3, 0]), "version 1 or 2"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_no_file_needs_is_refused(file_path, name):
    change, words = BAD[name]
    with h5py.File(file_path, "r+") as file:
        change(file["VTKHDF"])
    with pytest.raises(InputError, match=words) as caught:
        hdf_pieces(str(file_path))
    assert "\n" not in str(caught.value)


def test_texts_of_others_are_read(file_path):
    with h5py.File(file_path, "r+") as file:
        file["VTKHDF/FieldData"]["note"] = ["Größe", "b"]
    assert hdf_pieces(str(file_path))[0]["field_data"]["note"].tolist() == ["Größe", "b"]


def test_a_file_cut_off_and_cells_beyond_their_points(file_path):
    whole = file_path.read_bytes()
    with h5py.File(file_path, "r+") as file:
        file["VTKHDF/Connectivity"][0] = 10**6
    with pytest.raises(InputError, match=r"a\.vtkhdf: damaged: cells of piece 0 use nodes that it does not hold"):
        load_mesh(file_path)
    file_path.write_bytes(whole[:-100])
    with pytest.raises(InputError, match="damaged, or not an HDF5 file") as caught:
        load_mesh(file_path)
    assert "\n" not in str(caught.value)


def test_commands_take_it(file_path, tmp_path, capfd):
    """Both ways, and nothing is lost on the way back."""
    assert main(["convert", str(file_path), str(tmp_path / "b.vtu")]) == 0
    assert main(["convert", str(tmp_path / "b.vtu"), str(tmp_path / "b.vtkhdf")]) == 0
    assert same(load_mesh(tmp_path / "b.vtkhdf"), load_mesh(tmp_path / "b.vtu"))
    assert main(["quality", str(tmp_path / "b.vtkhdf")]) == 0
    assert "192 cells" in " ".join(capfd.readouterr().out.split())


def test_without_h5py_a_line_says_what_to_install(file_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    for call in (lambda: load_mesh(file_path), lambda: vtkhdf(sample_model())):
        with pytest.raises(
            InputError, match=r'\.vtkhdf files need h5py: pip install "h5py(>=[0-9.]+)?", or take \.vtu'
        ):
            call()
