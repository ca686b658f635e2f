"""Small valid files of every kind that tetopt reads, made here and nowhere copied from; what is
mutated.
"""

import contextlib
import io
import os
import zlib
from pathlib import Path
from typing import NamedTuple

import meshio
import nibabel
import numpy as np
import PIL.Image

import tetopt
from tetopt.cli.app import main

VOXELS = 12  # along each axis: an octree of some fifty nodes
EDGE_MM = (2.0, 2.0, 3.0)  # of a voxel
MEMBER_BYTES = 1 << 26  # of zeros in one member of the bomb
SPARSE_SIZE = 1 << 37  # bytes of a file that is nearly all hole
N_MEMBERS = 200  # 13 GB of zeros in 13 MB, since gzip's members may follow one another

PHANTOM = b"""name = "cyst"
description = "A soft cyst in a stiff plate"
size_mm = [24, 24, 24]
voxel_mm = 2
center_mm = [1, 2, 3]
axes = [[1, 0, 0], [0, 1, 0], [0.1, 0, 1]]
background = { intensity = 80, label = 0 }
blur_mm = 1.0
noise_sd = 2.0
seed = 3

[[shape]]
kind = "ellipsoid"
name = "cyst"
center_mm = [3, 2, 1]
radii_mm = [7, 5, 6]
rotation_deg = [10, 20, 30]
intensity = 10
label = 1

[[shape]]
kind = "layer"
normal = [0, 0, 1]
offset_mm = 9
thickness_mm = 3
intensity = 40
label = 2
"""
TABLES = {
    "lut.txt": b"# labels\n0 Unknown 0 0 0 0\n1 left-lung 10 20 30 0\n2 liver 40 50 60 0\n",
    "snap.txt": b'0 0 0 0 0 0 0 "Clear"\n1 255 0 0 1 1 1 "left lung"\n2 0 255 0 1 1 1 "liver"\n',
    "dseg.tsv": b"index\tname\tcolor\n1\tleft lung\t#ff0000\n2\tliver\t#00ff00\n",
    "slicer.csv": b"LabelValue,Name,Color_R,Color_G,Color_B,Color_A\n1,lung,10,20,30,255\n"
    b"2,liver,40,50,60,255\n",
}
MAPPINGS = {
    "mapping.toml": b'label = ["0", "1", "*"]\n'
    b"young = [1.0, 2.5, 9]\nnu = [0.3, 0.4, 0.45]\ndensity = [1000, 1100, 900]\n",
    "mapping.csv": b"intensity,young,nu\n0,1.0,0.3\n50,2.0,0.35\n100,5.5,0.4\n",
    "byname.csv": b"name,young,nu\nleft lung,1.0,0.3\nliver,2.0,0.35\n*,5.5,0.4\n",
}


class Seeds(NamedTuple):
    """The valid files by name, and the bomb."""

    files: dict[str, bytes]
    bomb: bytes


def affine():
    """Voxels of unequal size, somewhere in the world."""
    matrix = np.diag([*EDGE_MM, 1.0])
    matrix[:3, 3] = -5.0, 7.0, 11.0
    return matrix


def write_seeds(folder: Path):
    """Write all of them into a folder; run in a child, since libraries start threads and tetopt
    compiles.
    """
    index = np.indices((VOXELS,) * 3)
    inside = ((index - 5.0) ** 2).sum(axis=0) < 14.0
    data = (20.0 + 60.0 * inside + index[0]).astype(np.int16)
    labels = (inside + (index[2] > 8) * 2 * ~inside).astype(np.uint8)
    place = affine()
    _write_nibabel(folder, data, labels, inside, place)
    _write_itk(folder, data)
    _write_zarr(folder, data, place)
    for name in ("p.png", "p.tif", "p.bmp", "p.jpg"):
        PIL.Image.fromarray(data[:, :, 5].astype(np.uint8)).save(folder / name)
    for name, content in ({"phantom.toml": PHANTOM} | TABLES | MAPPINGS).items():
        (folder / name).write_bytes(content)
    with contextlib.chdir(folder):
        _write_meshes()


def _write_nibabel(folder, data, labels, inside, place):
    for name, kind in (
        ("i.nii", nibabel.Nifti1Image),
        ("i2.nii", nibabel.Nifti2Image),
        ("i.mgz", None),
    ):
        image = (
            nibabel.MGHImage(data.astype(np.float32), place) if kind is None else kind(data, place)
        )
        if kind is not None:
            image.header.set_xyzt_units("mm")
        nibabel.save(image, folder / name)
    nibabel.save(nibabel.MGHImage(data.astype(np.int32), place), folder / "i.mgh")
    nibabel.save(nibabel.Nifti1Image(data, place), folder / "i.nii.gz")
    nibabel.save(nibabel.Nifti1Image(data.astype(np.float64), place), folder / "f.nii")
    nibabel.save(nibabel.Nifti1Image(np.stack([data, data + 1], axis=3), place), folder / "i4.nii")
    nibabel.save(nibabel.Nifti1Image(labels, place), folder / "labels.nii")
    nibabel.save(nibabel.Nifti1Image(inside.astype(np.uint8), place), folder / "mask.nii")
    nibabel.save(
        nibabel.Nifti1Image(np.full(data.shape, 9.0, np.float32), place), folder / "sizes.nii"
    )


def _write_itk(folder, data):
    import SimpleITK

    image = SimpleITK.GetImageFromArray(data.T)
    image.SetSpacing(EDGE_MM)
    image.SetOrigin((5.0, -7.0, 11.0))
    SimpleITK.ProcessObject.SetGlobalDefaultNumberOfThreads(1)
    for name in ("i.nrrd", "i.nhdr", "i.mha", "i.mhd"):
        SimpleITK.WriteImage(image, str(folder / name))
    SimpleITK.WriteImage(image, str(folder / "z.mha"), useCompression=True)
    SimpleITK.WriteImage(image, str(folder / "z.nrrd"), useCompression=True)
    writer = SimpleITK.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k in range(4):
        plane = SimpleITK.GetImageFromArray(data.T[k])
        plane.SetSpacing(EDGE_MM[:2])
        tags = {
            "0008|0060": "MR",
            "0020|000d": "1.2.3",
            "0020|000e": "1.2.3.4",
            "0008|0018": f"1.2.3.4.{k + 1}",
            "0008|0016": "1.2.840.10008.5.1.4.1.1.4",
            "0020|0013": str(k + 1),
            "0010|0010": "Nobody",
            "0020|0032": f"5\\-7\\{11 + 3 * k}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0018|0050": "3",
        }
        for tag, value in tags.items():
            plane.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"s{k}.dcm"))
        writer.Execute(plane)


def _write_zarr(folder, data, place):
    """Arrays by themselves, of both formats and each packer, in two chunks; and an OME-Zarr
    image by tetopt.
    """
    import numcodecs
    import zarr
    from zarr import codecs

    of_format_2 = {
        "blosc": numcodecs.Blosc("lz4", 5, numcodecs.Blosc.SHUFFLE),
        "bits": numcodecs.Blosc("zstd", 1, 2),
        "zstd": numcodecs.Zstd(),
        "lz4": numcodecs.LZ4(),
        "zlib": numcodecs.Zlib(),
        "gzip": numcodecs.GZip(),
        "bz2": numcodecs.BZ2(),
        "lzma": numcodecs.LZMA(),
        "bare": None,
    }
    of_format_3 = {
        "blosc": codecs.BloscCodec(typesize=2, cname="zstd", shuffle="bitshuffle"),
        "zstd": codecs.ZstdCodec(),
        "gzip": codecs.GzipCodec(),
        "shards": codecs.BloscCodec(typesize=2),
    }
    half = (data.shape[0] // 2, *data.shape[1:])
    for number, packers in ((2, of_format_2), (3, of_format_3)):
        for name, packer in packers.items():
            array = zarr.create_array(
                folder / f"{name}{number}.zarr",
                shape=data.shape,
                dtype=data.dtype,
                zarr_format=number,
                chunks=(half[0] // 2, *half[1:]) if name == "shards" else half,
                compressors=packer,
                shards=half if name == "shards" else None,
                attributes={"affine": place.tolist()},
            )
            array[...] = data
    tetopt.save_image(folder / "ome.zarr", tetopt.Image(data, place))


def _write_meshes():
    """By tetopt itself, and again by meshio and VTK in other encodings."""
    base = [
        "mesh",
        "i.nii",
        "--nodes",
        "50",
        "--iterations",
        "2",
        "--labels",
        "labels.nii",
        "--label-names",
        "lut.txt",
    ]
    loads = [
        "--young",
        "1+0.1*h",
        "--load",
        "hold:superior",
        "--load",
        "pressure:inferior:0.1",
        "--bins",
        "4",
    ]
    _tetopt(*base, *loads, "-o", "m.vtu", "--json", "m.json")
    for name in ("m.vtk", "m.msh", "m.msh2", "m.inp"):
        _tetopt("convert", "m.vtu", name)
    for name in ("q.vtu", "q.msh"):
        _tetopt("convert", "m.vtu", name, "--order", "2")
    _tetopt("fem", "m.vtu", "-o", "solved.vtu")
    _tetopt(
        "mesh", "i.nii", "--slice", "k=5", "--nodes", "40", "--iterations", "1", "-o", "flat.vtu"
    )
    mesh = meshio.read("m.vtu")
    bare = meshio.Mesh(
        mesh.points,
        mesh.cells,
        cell_data={"mean": mesh.cell_data["mean"], "label": mesh.cell_data["label"]},
    )
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        meshio.vtu.write("ascii.vtu", bare, binary=False)
        meshio.vtu.write("inline.vtu", bare, binary=True, compression=None)
        meshio.vtu.write("zlib.vtu", bare, binary=True)
        meshio.vtk.write("ascii.vtk", bare, binary=False)
        meshio.gmsh.write("ascii41.msh", meshio.Mesh(mesh.points, mesh.cells), "4.1", binary=False)
        meshio.gmsh.write("ascii22.msh", meshio.Mesh(mesh.points, mesh.cells), "2.2", binary=False)
        meshio.gmsh.write("binary41.msh", meshio.Mesh(mesh.points, mesh.cells), "4.1", binary=True)
    import pyvista

    grid = pyvista.read("m.vtu")
    for name, is_binary in (("appended.vtu", True), ("vtk51.vtk", True), ("ascii51.vtk", False)):
        grid.save(name, binary=is_binary)
    Path("job.frd").write_bytes(frd_of(mesh))


def _tetopt(*words):
    with contextlib.redirect_stdout(None):
        code = main(list(words))
    if code != 0:
        raise SystemExit(
            f"the harness's own seed could not be made: exit {code} of tetopt {' '.join(words)}"
        )


def frd_of(mesh):
    """Displacements at a mesh's nodes as CalculiX writes them, one step, in text."""
    lines = ["    1C", "    1UUSER", f"    2C{'':18}{len(mesh.points):12d}{'':37}1"]
    for k, (x, y, z) in enumerate(mesh.points, start=1):
        lines.append(f" -1{k:10d}{x:12.5E}{y:12.5E}{z:12.5E}")
    cells = mesh.cells_dict["tetra"]
    lines += [" -3", f"    3C{'':18}{len(cells):12d}{'':37}1"]
    for k, cell in enumerate(cells, start=1):
        lines += [f" -1{k:10d}    3    0    1", " -2" + "".join(f"{node + 1:10d}" for node in cell)]
    lines += [" -3", "    1PSTEP                         1           1           1"]
    lines += [f"  100CL  101 1.000000000{len(mesh.points):12d}{'':21}0    1           1"]
    lines += [" -4  DISP        4    1"]
    lines += [f" -5  D{k}          1    2    {k}    0" for k in (1, 2, 3)] + [
        " -5  ALL         1    2    0    0    1ALL"
    ]
    for k in range(1, len(mesh.points) + 1):
        lines.append(f" -1{k:10d}{0.001 * k:12.5E}{-0.002:12.5E}{0.0:12.5E}")
    return "\n".join([*lines, " -3", " 9999", ""]).encode()


def load_seeds(folder: Path) -> Seeds:
    """What `write_seeds` has left."""
    files = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    member = (
        b"".join(packer.compress(bytes(1 << 20)) for _ in range(MEMBER_BYTES >> 20))
        + packer.flush()
    )
    return Seeds(files, member * N_MEMBERS)


def special(path: Path, kind: str):
    """What is no regular file, at a path."""
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "zero":
            path.symlink_to("/dev/zero")
        case "loop":
            path.symlink_to(path.name)
        case "folder":
            path.mkdir()
        case "stdin":
            path.symlink_to("/dev/stdin")
        case "gone":
            path.symlink_to("nowhere")
