"""Untrusted files: whatever they hold, one line, in time, and nothing allocated that a header
announces.
"""

import gzip
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import exit_code
from numpy.testing import assert_array_equal
from refusals import assert_refused, refusal

import tetopt
from tetopt.contents.phantom import load_phantom
from tetopt.errors import InputError
from tetopt.io import apart
from tetopt.io.apart import read_apart
from tetopt.io.images import load_image, parse_crop, parse_slice, sha256
from tetopt.io.itk_headers import check_header
from tetopt.io.meshes import load_mesh
from tetopt.job.option_values import file_and_volume
from tetopt.job.solver_files import parse_bins
from tetopt.model.label_names import labels_named
from tetopt.model.mappings import load_mapping
from tetopt.system import budget, incoming
from tetopt.system.incoming import json_of, text_of, toml_of

pytestmark = pytest.mark.apart
pytest.importorskip("SimpleITK")

POINTS = struct.pack("<12d", 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1)
PACKED = zlib.compress(POINTS)


# --------------------------------------------------------------------------------------------------
# The child that reads


def echo(path, value):
    return {
        "path": path,
        "value": value,
        "turned": np.arange(24).reshape(2, 3, 4).T,
        "texts": np.array(["ä", "b\0c"]),
    }


def arrays(path):
    return [
        np.empty((0, 3)),
        np.array(7.5),
        np.array([True]),
        np.arange(6, dtype=">i2").reshape(2, 3),
        np.float32(2.0),
    ]


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


def limits(path):
    import resource  # not on Windows

    return [
        resource.getrlimit(getattr(resource, f"RLIMIT_{name}"))[0] for name in ("CPU", "CORE", "AS")
    ]


@pytest.fixture
def some_file(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    path = tmp_path / "a file ä.vtu"
    path.write_bytes(b"x")
    return path


def test_what_a_child_reads_comes_back(some_file):
    value = [1, None, "ä"]
    back = read_apart(echo, some_file, value, library="a test")
    expected = echo(str(some_file), value)
    for name in ("turned", "texts"):
        assert_array_equal(back.pop(name), expected.pop(name))
    assert back == expected
    back = read_apart(arrays, some_file, library="a test")
    for array, expected in zip(back, arrays(""), strict=True):
        assert_array_equal(array, expected)
        assert np.shape(array) == np.shape(expected)
    assert read_apart(writing, some_file, library="a test") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="limits are Linux's")
def test_a_child_has_limits(some_file):
    """The time also as the kernel's, since this process may be gone; and a scan is in no core
    file.
    """
    seconds, core, n_bytes = read_apart(limits, some_file, library="a test")
    assert (seconds, core) == (60, 0)
    assert 2**31 < n_bytes < 2**33


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (crash, r"a test crashed on this file \(SIGABRT; .* copy or export it again"),
        (greedy, r"needs more than 2\.1 GB of memory"),
        (stumbling, r"truncated or damaged; copy it again \(KeyError: 'what\\nis this'\)"),
        (endless, "a test did not read it within 1 s"),
    ],
)
def test_a_child_that_fails_is_one_line(some_file, monkeypatch, read, words):
    monkeypatch.setattr(apart, "LEAST_SECONDS", 60.0 if read is not endless else 1.0)
    with refusal(words):
        read_apart(read, some_file, library="a test")


def test_modules_of_the_current_folder_are_not_run(tmp_path):
    """An untrusted folder may hold a numpy.py: the child that reads must not take it for numpy."""
    (tmp_path / "a.vtu").write_bytes(b"x")
    for name in ("numpy", "json", "vtkmodules", "xml"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w')\n")
    program = (
        "import tetopt\ntry:\n    tetopt.load_mesh('a.vtu')\nexcept tetopt.InputError as "
        "error:\n    print(error)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(tetopt.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-P", "-c", program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env=environment,
        check=True,
    )
    assert done.stdout.startswith("a.vtu: damaged")
    assert not (tmp_path / "executed").exists()


# --------------------------------------------------------------------------------------------------
# VTK


def vtu(*, points="4", compressor="", extra="", data=POINTS, head=b""):
    """A tetrahedron, its points appended."""
    text = f"""<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian"
 header_type="UInt64" {compressor}><UnstructuredGrid>{extra}
<Piece NumberOfPoints="{points}" NumberOfCells="1"><Points>
<DataArray type="Float64" Name="Points" NumberOfComponents="3" format="appended" offset="0"/>
</Points>
<Cells><DataArray type="Int64" Name="connectivity" format="ascii">0 1 2 3</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">4</DataArray>
<DataArray type="UInt8" Name="types" format="ascii">10</DataArray></Cells>
</Piece></UnstructuredGrid>
<AppendedData encoding="raw">_"""
    return text.encode() + head + data + b"</AppendedData></VTKFile>"


ZLIB = 'compressor="vtkZLibDataCompressor"'
TUPLES = (
    '<FieldData><DataArray type="Float64" Name="a" NumberOfTuples="{}" '
    'format="ascii">1</DataArray></FieldData>'
)


def legacy(points=4, cells=1, numbers=5, more=""):
    """The same as a legacy file."""
    return (
        f"# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {points} double\n"
        f"0 0 0 1 0 0 0 1 0 0 0 1\nCELLS {cells} {numbers}\n4 0 1 2 3\nCELL_TYPES "
        f"{cells}\n10\n{more}"
    ).encode()


# Entities of ten of the one before, as the name of an array.
ENTITIES = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
DOCTYPE = f'<?xml version="1.0"?><!DOCTYPE VTKFile [<!ENTITY a0 "ha">{ENTITIES}]>'
LAUGHS = vtu(head=struct.pack("<Q", 96)).replace(b'<?xml version="1.0"?>', DOCTYPE.encode())
LAUGHS = LAUGHS.replace(b'Name="Points"', b'Name="&a9;"')
VTK_BOMBS = {
    "points.vtu": (vtu(points=2**62, head=struct.pack("<Q", 2**63)), "damaged"),
    "minus.vtu": (vtu(points=-4, head=struct.pack("<Q", 96)), "damaged"),
    "digits.vtu": (vtu(points="+", head=struct.pack("<Q", 96)), "damaged, or not a VTK mesh"),
    "tuples.vtu": (vtu(extra=TUPLES.format(2**62), head=struct.pack("<Q", 96)), "damaged"),
    "blocks.vtu": (
        vtu(compressor=ZLIB, head=struct.pack("<4Q", 2**62, 96, 0, 50), data=PACKED),
        "VTK crashed on",
    ),
    "sizes.vtu": (
        vtu(compressor=ZLIB, head=struct.pack("<4Q", 1, 2**36, 0, 50), data=PACKED),
        "VTK crashed on",
    ),
    "entity.vtu": (LAUGHS, "damaged"),
    "empty.vtu": (b"", "damaged"),
    "points.vtk": (legacy(points=2**31 - 1), "damaged, or not a VTK mesh .*allocate"),
    "cells.vtk": (legacy(cells=2**60), "damaged"),
    "minus.vtk": (legacy(points=-1), "damaged"),
    "numbers.vtk": (legacy(numbers=2**31 - 1), "damaged"),
    "field.vtk": (
        legacy(more="POINT_DATA 4\nFIELD f 1\na 1 2147483647 double\n1 2 3\n"),
        "damaged",
    ),
    "name.vtk": (
        legacy(more=f"FIELD f 1\n{'a' * 100_000} 1 1 double\n1\n"),
        "VTK crashed on this file .SIG",
    ),
}


@pytest.mark.parametrize("name", VTK_BOMBS)
def test_vtk_bombs(here, name):
    raw, words = VTK_BOMBS[name]
    (here / name).write_bytes(raw)
    assert_refused(name, words, load_mesh)


@pytest.mark.parametrize(
    ("name", "raw"), [("a.vtu", vtu(head=struct.pack("<Q", 96))), ("a.vtk", legacy())]
)
def test_the_bombs_are_else_good(here, name, raw):
    (here / name).write_bytes(raw)
    assert len(load_mesh(name).mesh.cells) == 1


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (
            legacy(numbers=4).replace(b"4 0 1 2 3", b"3 0 1 2"),
            "damaged: tetra cells have 4 nodes each, but some have a different number",
        ),
        (legacy().replace(b"\n10\n", b"\n99\n"), "no cells of type 99|damaged"),
    ],
)
def test_cells_of_another_number_of_nodes(here, raw, words):
    (here / "a.vtk").write_bytes(raw)
    assert_refused("a.vtk", words, load_mesh)


# --------------------------------------------------------------------------------------------------
# What is no regular file


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes with a name")
@pytest.mark.parametrize(
    "name",
    ["a.vtu", "a.msh", "a.nii", "a.nii.gz", "a.nrrd", "a.dcm", "a.png", "a.xyz"],
)
def test_a_pipe_does_not_block(here, name):
    os.mkfifo(here / name)
    for load in (load_mesh,) if name in ("a.vtu", "a.msh") else (load_image, sha256):
        assert_refused(name, "expected a regular file, got a pipe", load)
    if name == "a.dcm":
        assert_refused(here, "a.dcm is a pipe")


def test_a_device_is_no_image():
    if not Path("/dev/zero").exists():
        pytest.skip("no /dev/zero")
    assert_refused("/dev/zero", "got a device")


# --------------------------------------------------------------------------------------------------
# Images


def mha(ndims="3", sizes="3 4 5", kind="MET_UCHAR", file="LOCAL", more="", data=bytes(60)):
    head = f"ObjectType = Image\nNDims = {ndims}\nDimSize = {sizes}\nElementType = {kind}\n{more}"
    head += f"ElementDataFile = {file}\n"
    return head.encode() + data


def nrrd(dimension="3", sizes="3 4 5", kind="uchar", more="", encoding="raw", data=bytes(60)):
    head = (
        f"NRRD0004\ntype: {kind}\ndimension: {dimension}\nsizes: {sizes}\nencoding: "
        f"{encoding}\n{more}\n"
    )
    return head.encode() + data


PACKED_MHA = "CompressedData = True\n"
ITK_BOMBS = {
    "good.mha": (mha(), None),
    "zlib.mha": (mha(more=PACKED_MHA, data=zlib.compress(bytes(60))), None),
    "gzip.mha": (mha(more=PACKED_MHA, data=gzip.compress(bytes(60))), None),
    "half.mha": (
        mha(sizes="3 4 10", more=PACKED_MHA, data=zlib.compress(bytes(60))),
        "declares 120 bytes of voxels, but 60 are packed",
    ),
    "flat.mha": (mha(more=PACKED_MHA), "truncated or damaged; copy it again .*while decompressing"),
    "good.nrrd": (nrrd(), None),
    "axes.mha": (mha(ndims="-1"), "expected 1 to 8 axes, got -1"),
    "many.mha": (mha(ndims="1000000000"), "expected 1 to 8 axes"),
    "fewer.mha": (mha(sizes="3 4"), "expected 3 sizes, got 3 4"),
    "minus.mha": (mha(sizes="3 4 -5"), "expected 3 sizes"),
    "huge.mha": (
        mha(sizes="32767 32767 32767"),
        r"declares 32767 x 32767 x 32767 voxels, 3.518e\+13 bytes, but the file",
    ),
    "packed.mha": (mha(sizes="32767 32767 32767", more=PACKED_MHA), "declares 32767 x"),
    "channels.mha": (
        mha(more="ElementNumberOfChannels = 999999999\n"),
        "declares 3 x 4 x 5 voxels, 6e.10 bytes",
    ),
    "type.mha": (mha(kind="MET_OTHER"), "unknown voxel type MET_OTHER"),
    "colon.mha": (mha(more="DimSize : 3 2 2 =\n"), "not an image of this kind"),
    "none.mha": (b"NDims = 3\n", "its header has no DimSize"),
    "axes.nrrd": (nrrd(dimension="-1"), "expected 1 to 8 axes, got -1"),
    "huge.nrrd": (nrrd(sizes="99999999999 9 9"), "declares 99999999999 x 9 x 9 voxels"),
    "packed.nrrd": (nrrd(sizes="32767 32767 32767", encoding="gzip"), "declares 32767 x"),
    "long.nrrd": (nrrd(sizes="9" * 5000), "expected 3 sizes"),
}


@pytest.mark.parametrize("name", ITK_BOMBS)
@pytest.mark.filterwarnings("ignore:.*the image is 0 everywhere")
def test_itk_bombs(here, name):
    raw, words = ITK_BOMBS[name]
    (here / name).write_bytes(raw)
    if words is None:
        assert load_image(name).shape == (3, 4, 5)
    else:
        assert_refused(name, words)


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "../a.raw",
        "folder/a.raw",
        "..",
        "http://x/a.raw",
        "a\\b.raw",
        "a%03d.raw 1 9 1",
        "",
    ],
)
def test_voxels_lie_beside_their_header(tmp_path, name):
    """Else the bytes of any file of the machine come back to the sender, as cells of a mesh."""
    inner = tmp_path / "inner"
    (inner / "folder").mkdir(parents=True)
    for path in (tmp_path / "a.raw", inner / "folder" / "a.raw"):
        path.write_bytes(bytes(range(60)))
    (inner / "one.raw").write_bytes(bytes(range(60)))
    files = [name, f"LIST\n{name or '..'}", f"LIST\none.raw\n{name or '..'}"]
    headers = [("a.mhd", mha(file=each, data=b"")) for each in files]
    fields = [*(f"data file: {each}\n" for each in files), f"DATA FILE: {name}\n"]
    headers += [("a.nhdr", nrrd(more=field, data=b"")) for field in fields]
    for header, raw in headers:
        (inner / header).write_bytes(raw)
        assert_refused(inner / header, "named without a folder|damaged")


@pytest.mark.parametrize(
    ("name", "raw", "words"),
    [
        (
            "a.nhdr",
            nrrd(more="data file: LIST 3 :=\n../a.raw\n", data=b""),  # ":=" after a field is no key
            "named without a folder",
        ),
        (
            "a.nhdr",
            # and more comments than are read here
            nrrd(more=("#".ljust(99) + "\n") * 11_000 + "data file: ../a.raw\n", data=b""),
            "a header of more than 1048576 bytes",
        ),
        (
            "a.mhd",
            mha(file="LIST\n" + "one.raw\n" * 140_000 + "/etc/passwd", data=b""),
            "a header of more than 1048576 bytes with separate data files",
        ),
    ],
)
def test_no_header_hides_where_its_voxels_are(tmp_path, name, raw, words):
    (tmp_path / "inner").mkdir()
    for path in (tmp_path / "a.raw", tmp_path / "inner" / "one.raw"):
        path.write_bytes(bytes(60))
    (tmp_path / "inner" / name).write_bytes(raw)
    assert_refused(tmp_path / "inner" / name, words)


@pytest.mark.parametrize("n_slices", [1, 4])
def test_slices_of_a_list_that_are_missing(here, n_slices):
    """ITK would read the others, and leave what it likes in their place."""
    names = [f"{number}.raw" for number in range(n_slices)]
    for name in names:
        (here / name).write_bytes(bytes(12))
    (here / "a.mhd").write_bytes(mha(sizes="3 4 500", file="\n".join(["LIST", *names]), data=b""))
    assert_refused("a.mhd", "truncated or damaged")


@pytest.mark.parametrize(
    ("name", "raw"),
    [
        ("a.mhd", mha(file="a b.raw", data=b"")),
        ("a.nhdr", nrrd(more="data file: a b.raw\n", data=b"")),
    ],
)
def test_voxels_beside_their_header_are_read(here, name, raw):
    voxels = here / "a b.raw"
    voxels.write_bytes(bytes(range(60)))
    (here / name).write_bytes(raw)
    assert_array_equal(load_image(name).data.ravel(order="F"), np.arange(60))
    if hasattr(os, "mkfifo"):
        voxels.unlink()
        os.mkfifo(voxels)
        assert_refused(name, 'its data file "a b.raw" is a pipe')


def nifti(path, shape=(3, 4, 5), offset=352.0, data=bytes(60)):
    """A NIfTI file whose header may tell of anything."""
    header = nibabel.Nifti1Header()
    header.set_data_dtype(np.uint8)
    header["dim"][: len(shape) + 1] = [len(shape), *shape]
    header["vox_offset"], header["magic"] = offset, b"n+1"
    raw = header.binaryblock + bytes(4) + data
    path.write_bytes(gzip.compress(raw) if path.suffix == ".gz" else raw)
    return path


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
@pytest.mark.filterwarnings("ignore:.*the image is 0 everywhere")
def test_nifti_bombs(tmp_path, name):
    assert load_image(nifti(tmp_path / name)).shape == (3, 4, 5)
    for words, options in (
        (r"declares 32767 x 32767 x 32767 voxels, 3.518e\+13", {"shape": (32767,) * 3}),
        ("damaged", {"shape": (3, 4, -5)}),
        ("its voxels would begin at byte 1e.30", {"offset": 1e30}),
        ("its voxels would begin at byte nan", {"offset": np.nan}),
    ):
        assert_refused(nifti(tmp_path / name, **options), words)


@pytest.mark.parametrize("name", ["a.nii.gz", "a.nrrd"])
def test_a_volume_that_does_not_fit_memory(tmp_path, monkeypatch, name):
    path = tmp_path / name
    nifti(path) if name == "a.nii.gz" else path.write_bytes(nrrd())
    monkeypatch.setattr(budget, "available_bytes", lambda: 60 * 9 - 1)
    assert_refused(
        path,
        "its 3 x 4 x 5 voxels: needs about .* of memory, .* is free; crop or resample it first",
    )


@pytest.mark.parametrize("name", ["a.nii.gz", "a.nii"])
def test_a_file_that_goes_on(tmp_path, name):
    """Only as much is unpacked, or read for the checksum, as the header tells of, and what may
    lie behind that.
    """
    path = nifti(tmp_path / name, data=bytes(2**25))
    assert_refused(path, "it continues far after the last voxel")


SKIPPED = {"a.mha": "", "a.mhd": f"HeaderSize = {2**25}\n", "a.nrrd": f"byte skip: {2**25}\n"}


@pytest.mark.parametrize("name", SKIPPED)
def test_voxels_after_a_header_that_go_on(tmp_path, name):
    """A hole takes no place on the disk, and minutes in a checksum; what a header skips may be
    long.
    """
    path, data = tmp_path / name, tmp_path / ("a.raw" if name == "a.mhd" else name)
    for more in {SKIPPED[name], ""}:
        if name == "a.mhd":
            data.write_bytes(bytes(60))
        path.write_bytes(
            nrrd(more=more)
            if name == "a.nrrd"
            else mha(file=data.name if name == "a.mhd" else "LOCAL", more=more)
        )
        assert check_header(path)[0].value_bytes == 60
        os.truncate(data, 2**25 + 400)
        if more:
            assert check_header(path)[0].value_bytes == 60
        else:
            assert_refused(path, "it continues far after the last voxel")


def chunk(kind, data):
    """A part of a PNG file."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        # Pillow goes by what a file holds, and gives PostScript to Ghostscript.
        (
            b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n",
            "unknown to Pillow",
        ),
        (
            b"\x89PNG\r\n\x1a\n"
            + chunk(b"IHDR", struct.pack(">IIBBBBB", 2**20, 2**20, 8, 0, 0, 0, 0))
            + chunk(b"IDAT", zlib.compress(b"")),
            "expected at most 1073741824 pixels, got 1048576 x 1048576",
        ),
    ],
)
def test_pictures_that_are_bombs(here, raw, words):
    (here / "a.png").write_bytes(raw)
    assert_refused("a.png", words)


# --------------------------------------------------------------------------------------------------
# Texts, tables and options


def test_texts_are_bounded(here, monkeypatch):
    (here / "a.toml").write_text("x = 1\n")
    assert toml_of(here / "a.toml", "table") == {"x": 1}
    monkeypatch.setattr(incoming, "TEXT_BYTES", 5)
    assert_refused("a.toml", "expected a table of at most", text_of, noun="table")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"x = {'9' * 5000}", "expected TOML, got "),
        (f"x = 0x{'f' * 5000}", "expected TOML, got "),
        (f"x = [1, {{y = {'9' * 400}}}]", "expected TOML, got a number of 400 digits"),
        (f"x = {'[' * 10_000}", "nested too deeply|expected TOML"),
        ("x", "expected TOML"),
    ],
)
def test_toml_without_end(here, text, words):
    (here / "a.toml").write_text(text)
    assert_refused("a.toml", words, toml_of, noun="table")
    for load in (load_phantom, load_mapping):
        with pytest.raises(InputError) as caught:
            load(here / "a.toml")
        assert len(str(caught.value)) < 400


@pytest.mark.parametrize("text", ["9" * 5000, "9" * 400, "[" * 100_000, '{"a": 1'])
def test_json_without_end(text):
    with pytest.raises(ValueError):
        json_of(text)


def test_numbers_of_thousands_of_digits_among_options():
    digits = "9" * 5000
    for parse in (parse_bins, parse_crop, parse_slice):
        for text in (digits, f"{digits}:", f"2={digits}"):
            with pytest.raises(InputError) as caught:
                parse(text)
            assert len(str(caught.value)) < 300
    assert file_and_volume(Path(f"a.nii:{digits}"))[1] is None
    with pytest.raises(InputError):
        labels_named(digits, {1: "liver"})


@pytest.mark.parametrize("digits", [30, 400, 5000])
def test_numbers_of_many_digits_on_the_command_line(tmp_path, capfd, digits):
    words = ["mesh", tmp_path / "no.nii", "-o", tmp_path / "a.vtu", "--nodes", "9" * digits]
    assert exit_code(*words) == 2
    assert capfd.readouterr().err.count("\n") <= 2
