"""Files of strangers: whatever they hold, one line, in time, and nothing allocated that a header promises."""

import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

import tetopt
from tetopt.errors import InputError
from tetopt.io import apart
from tetopt.io.apart import read_apart
from tetopt.io.meshes import load_mesh

POINTS = struct.pack("<12d", 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1)
PACKED = zlib.compress(POINTS)


def refused(load, path, words):
    """The one line of a refusal."""
    with pytest.raises(InputError, match=words) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


# --------------------------------------------------------------------------------------------------
# The child that reads


def echo(path, value):
    return {"path": path, "value": value, "turned": np.arange(24).reshape(2, 3, 4).T, "texts": np.array(["ä", "b\0c"])}


def arrays(path):
    return [np.empty((0, 3)), np.array(7.5), np.array([True]), np.arange(6, dtype=">i2").reshape(2, 3), np.float32(2.0)]


def crash(path):
    os.abort()


def endless(path):
    while True:
        pass


def greedy(path):
    return np.ones(2**40)


def stumbling(path):
    raise KeyError("what\nis this")


def writing(path):
    os.write(1, b"VTK says what it pleases")
    print("and Python too")
    return 1


@pytest.fixture
def some_file(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    path = tmp_path / "a file ä.vtu"
    path.write_bytes(b"x")
    return path


def test_what_a_child_reads_comes_back(some_file):
    back = read_apart(echo, some_file, [1, None, "ä"], library="a test")
    assert (back["path"], back["value"]) == (str(some_file), [1, None, "ä"])
    np.testing.assert_array_equal(back["turned"], np.arange(24).reshape(2, 3, 4).T)
    assert back["texts"].tolist() == ["ä", "b\0c"]
    for array, expected in zip(read_apart(arrays, some_file, library="a test"), arrays(""), strict=True):
        np.testing.assert_array_equal(array, expected)
        assert np.shape(array) == np.shape(expected)
    assert read_apart(writing, some_file, library="a test") == 1


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (crash, r"a test crashed at this file \(SIGABRT; .* copy or export it again"),
        (greedy, r"needs more than 2\.1 GB of memory"),
        (stumbling, r"truncated or damaged; copy it again \(KeyError: 'what\\nis this'\)"),
        (endless, "was not read within 1 s by a test"),
    ],
)
def test_a_child_that_fails_is_one_line(some_file, monkeypatch, read, words):
    monkeypatch.setattr(apart, "LEAST_SECONDS", 60.0 if read is not endless else 1.0)
    with pytest.raises(InputError, match=words) as caught:
        read_apart(read, some_file, library="a test")
    assert "\n" not in str(caught.value)


def test_modules_of_the_current_folder_are_not_run(tmp_path):
    """A stranger's folder may hold a numpy.py: the child that reads must not take it for numpy."""
    (tmp_path / "a.vtu").write_bytes(b"x")
    for name in ("numpy", "json", "vtkmodules", "xml"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w')\n")
    program = (
        "import tetopt\ntry:\n    tetopt.load_mesh('a.vtu')\nexcept tetopt.InputError as error:\n    print(error)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(tetopt.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-P", "-c", program], cwd=tmp_path, capture_output=True, text=True, env=environment, check=True
    )
    assert done.stdout.startswith("a.vtu: damaged")
    assert not (tmp_path / "executed").exists()


# --------------------------------------------------------------------------------------------------
# VTK


def vtu(*, points="4", compressor="", extra="", data=POINTS, head=b""):
    """A tetrahedron, its points appended."""
    text = f"""<?xml version="1.0"?><VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian"
 header_type="UInt64" {compressor}><UnstructuredGrid>{extra}<Piece NumberOfPoints="{points}" NumberOfCells="1"><Points>
<DataArray type="Float64" Name="Points" NumberOfComponents="3" format="appended" offset="0"/></Points>
<Cells><DataArray type="Int64" Name="connectivity" format="ascii">0 1 2 3</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">4</DataArray>
<DataArray type="UInt8" Name="types" format="ascii">10</DataArray></Cells></Piece></UnstructuredGrid>
<AppendedData encoding="raw">_"""
    return text.encode() + head + data + b"</AppendedData></VTKFile>"


ZLIB = 'compressor="vtkZLibDataCompressor"'
TUPLES = '<FieldData><DataArray type="Float64" Name="a" NumberOfTuples="{}" format="ascii">1</DataArray></FieldData>'


def legacy(points=4, cells=1, numbers=5, more=""):
    """The same as a legacy file."""
    return (
        f"# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {points} double\n"
        f"0 0 0 1 0 0 0 1 0 0 0 1\nCELLS {cells} {numbers}\n4 0 1 2 3\nCELL_TYPES {cells}\n10\n{more}"
    ).encode()


VTK_BOMBS = {
    "points.vtu": (vtu(points=2**62, head=struct.pack("<Q", 2**63)), f"NumberOfPoints is {2**62}, its .* at most"),
    "minus.vtu": (vtu(points=-4, head=struct.pack("<Q", 96)), "NumberOfPoints is -4"),
    "tuples.vtu": (vtu(extra=TUPLES.format(2**62), head=struct.pack("<Q", 96)), "NumberOfTuples is"),
    "blocks.vtu": (vtu(compressor=ZLIB, head=struct.pack("<4Q", 2**62, 96, 0, 50), data=PACKED), "VTK crashed at"),
    "sizes.vtu": (vtu(compressor=ZLIB, head=struct.pack("<4Q", 1, 2**36, 0, 50), data=PACKED), "VTK crashed at"),
    "entity.vtu": (b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "b">]><VTKFile/>', "document type or entities"),
    "points.vtk": (legacy(points=2**31 - 1), "POINTS is 2147483647, its 146 bytes can hold 146 at most"),
    "cells.vtk": (legacy(cells=2**60), "CELLS is"),
    "minus.vtk": (legacy(points=-1), "POINTS is -1"),
    "numbers.vtk": (legacy(numbers=2**31 - 1), "damaged"),
    "field.vtk": (legacy(more="POINT_DATA 4\nFIELD f 1\na 1 2147483647 double\n1 2 3\n"), "is 2147483647"),
    "name.vtk": (legacy(more=f"FIELD f 1\n{'a' * 100_000} 1 1 double\n1\n"), "VTK crashed at this file .SIG"),
}


@pytest.mark.parametrize("name", VTK_BOMBS)
def test_vtk_bombs(tmp_path, name):
    raw, words = VTK_BOMBS[name]
    (tmp_path / name).write_bytes(raw)
    refused(load_mesh, tmp_path / name, words)


@pytest.mark.parametrize(("name", "raw"), [("a.vtu", vtu(head=struct.pack("<Q", 96))), ("a.vtk", legacy())])
def test_the_bombs_are_else_good(tmp_path, name, raw):
    (tmp_path / name).write_bytes(raw)
    assert len(load_mesh(tmp_path / name).mesh.cells) == 1


def test_cells_of_another_number_of_nodes(tmp_path):
    (tmp_path / "a.vtk").write_bytes(legacy(numbers=4).replace(b"4 0 1 2 3", b"3 0 1 2"))
    refused(load_mesh, tmp_path / "a.vtk", r"damaged: cells of 4 nodes \(tetra\) have another number")
    (tmp_path / "a.vtk").write_bytes(legacy().replace(b"\n10\n", b"\n99\n"))
    refused(load_mesh, tmp_path / "a.vtk", "no cells of type 99|damaged")


# --------------------------------------------------------------------------------------------------
# What is no regular file


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes with a name")
@pytest.mark.parametrize("name", ["a.vtu", "a.msh"])
def test_a_pipe_does_not_block(tmp_path, name):
    os.mkfifo(tmp_path / name)
    refused(load_mesh, tmp_path / name, "expected a regular file, got a pipe")
