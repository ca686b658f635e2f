"""Volumes that memory cannot mesh: a refusal by the header, with a crop and a level that fit."""

import os
import re
from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import run_command

import tetopt
import tetopt.io.nifti
from tetopt.io.images import parse_crop, smaller_words
from tetopt.job import aligned
from tetopt.system import budget

EDGE = 2000
FREE = 10**10
NRRD = """NRRD0004
type: short
dimension: 3
space: left-posterior-superior
sizes: {0} {0} {0}
space directions: (1,0,0) (0,1,0) (0,0,1)
kinds: domain domain domain
endian: little
encoding: raw
space origin: (0,0,0)

"""
META = """ObjectType = Image
NDims = 3
DimSize = {0} {0} {0}
ElementType = MET_SHORT
ElementSpacing = 1 1 1
ElementDataFile = LOCAL
"""


def write_header(path: Path, edge=EDGE):
    """A file of `edge`^3 voxels of 16 bits, of which only the header takes room on the disk."""
    head = (NRRD if path.suffix == ".nrrd" else META).format(edge).encode()
    if path.suffix == ".nii":
        header = nibabel.Nifti2Header()
        header.set_data_dtype(np.int16)
        header.set_data_shape((edge, edge, edge))
        header.set_sform(np.eye(4), 1)
        header.set_xyzt_units("mm")
        header["vox_offset"] = 544
        head = header.binaryblock + bytes(4)
    path.write_bytes(head)
    os.truncate(path, len(head) + 2 * edge**3)
    assert path.stat().st_blocks < 100


def write_pyramid(path: Path, edge=EDGE):
    """An OME-Zarr image of three levels, of which the first 64^3 voxels are written."""
    zarr = pytest.importorskip("zarr")
    group, datasets = zarr.open_group(path, mode="w"), []
    for level in range(3):
        shape, name = (edge >> level,) * 3, str(level)
        kind = {"chunks": (8,) * 3, "dtype": "i2", "fill_value": 0}
        array, n = group.create_array(name, shape=shape, **kind), min(edge >> level, 64)
        array[:n, :n, :n] = np.arange(n**3).reshape(n, n, n) % 1000
        place = [{"type": "scale", "scale": [float(2**level)] * 3}]
        datasets.append({"path": name, "coordinateTransformations": place})
    axes = [{"name": name, "type": "space", "unit": "millimeter"} for name in "zyx"]
    scales = [{"axes": axes, "datasets": datasets}]
    group.attrs.update({"ome": {"version": "0.5", "multiscales": scales}})


def refusal(path, *words):
    """The one line with which a run is refused."""
    out, err = run_command("mesh", path, "-o", path.with_suffix(".vtu"), *words, code=2)
    assert (out, err.count("\n")) == ("", 1)
    return err


@pytest.mark.parametrize("suffix", [".nii", ".nrrd", ".mha", ".zarr"])
def test_a_volume_is_refused_before_its_voxels_are_read(suffix, tmp_path, monkeypatch):
    """By the header alone: nothing of the image is allocated or opened."""
    path = tmp_path / f"large{suffix}"
    (write_pyramid if suffix == ".zarr" else write_header)(path)
    monkeypatch.setattr(budget, "available_bytes", lambda: FREE)
    monkeypatch.setattr(aligned, "load_image", lambda *_, **__: pytest.fail("read"))
    said = refusal(path)
    assert re.search(r"2000 x 2000 x 2000 voxels: needs about 22\d GB .* only 10 GB is free", said)
    assert re.search(r"use --crop \d+:\d+,\d+:\d+,\d+:\d+ \(6\d\d x 6\d\d x 6\d\d voxels\)", said)
    level = f"use its level {path}/2 (500 x 500 x 500 voxels)"
    assert (level if suffix == ".zarr" else "resample it to voxels 2.9 times as long") in said


def test_a_level_and_a_crop_that_fit_are_read(tmp_path, monkeypatch):
    """Those that the refusal names."""
    path = tmp_path / "small.zarr"
    write_pyramid(path, 64)
    monkeypatch.setattr(budget, "available_bytes", lambda: 251_600_000)  # of it 250.6 for no voxel
    said = refusal(path, "--nodes 100 --crop 0:60,0:60,0:60")
    assert "use its level " + str(path / "1") in said
    box = parse_crop(re.search(r"--crop (\S+) ", said)[1])
    assert tetopt.load_image(path, crop=box).shape == (33, 33, 33)
    coarse = tetopt.load_image(path / "1")
    assert coarse.shape == (32, 32, 32)
    np.testing.assert_array_equal(coarse.spacing, 2.0)


def test_a_crop_that_fits_lies_in_the_box(tmp_path):
    write_header(tmp_path / "a.nii", 40)
    words = smaller_words(tmp_path / "a.nii", [(100, 140), (0, 40), (10, 50)], 8000.0)
    assert words.startswith("use `crop` 110:130,10:30,20:40 (20 x 20 x 20 voxels)")
    assert words.endswith("resample it to voxels 2 times as long")


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.mgz"])
def test_a_crop_is_read_without_the_other_voxels(name, tmp_path, monkeypatch):
    """Of one of two volumes, rescaled; in blocks of planes; the same bits as of the whole."""
    values = np.arange(2 * 9 * 8 * 7, dtype=np.int16).reshape(9, 8, 7, 2)
    affine = np.array([[0, -1.5, 0, 3], [2, 0, 0.1, 4], [0, 0, 3, 5], [0, 0, 0, 1.0]])
    if name.endswith("mgz"):
        file = nibabel.MGHImage(values, affine)
    else:
        file = nibabel.Nifti1Image(values, affine)
        file.header.set_slope_inter(0.5, -3.0)
    nibabel.save(file, tmp_path / name)
    bounds = [(2, 7), (None, 5), (1, None)]
    whole = tetopt.io.images.crop_image(tetopt.load_image(tmp_path / name, volume=1), bounds)
    for planes in (1, 2**28):
        monkeypatch.setattr(tetopt.io.nifti, "PLANES_BYTES", planes)
        part = tetopt.load_image(tmp_path / name, volume=1, crop=bounds)
        assert part.data.tobytes() == whole.data.tobytes()
        assert part.affine.tobytes() == whole.affine.tobytes()


def test_a_crop_of_a_volume_larger_than_memory(tmp_path, monkeypatch):
    """16 GB of zeros on the disk's paper, of which a thousandth is read."""
    write_header(tmp_path / "large.nii")
    monkeypatch.setattr(budget, "available_bytes", lambda: 10**8)
    with pytest.warns(UserWarning, match="0 everywhere"):
        image = tetopt.load_image(tmp_path / "large.nii", crop=[(5, 105), (0, 90), (7, 12)])
    assert image.shape == (100, 90, 5)


def test_a_mask_s_run_is_refused_by_its_reader(tmp_path, monkeypatch):
    """As only the mask's surroundings are meshed; reading takes 10 bytes for each voxel."""
    path = tmp_path / "large.nii"
    write_header(path, 400)
    monkeypatch.setattr(budget, "available_bytes", lambda: 400**3 * 9)
    said = refusal(path, "--background 5")
    assert "its 400 x 400 x 400 voxels: needs about 0.64 GB" in said


@pytest.mark.parametrize("free", [None, 10**9, 1000])
def test_voxels_are_divided_whatever_memory_is_free(free, monkeypatch):
    """Up to a number of voxels, and with a note beyond."""
    if free is not None:
        monkeypatch.setattr(budget, "available_bytes", lambda: free)
    said = []
    monkeypatch.setattr(aligned, "note", said.append)
    image = tetopt.Image(np.zeros((8, 8, 8)), np.diag([2.0, 2.0, 2.0, 1.0]))
    labels = {Path("l.nii"): tetopt.Image(np.zeros((16, 16, 16)))}
    assert aligned._divisions(image, labels, None) == (2, 2, 2)
    monkeypatch.setattr(aligned, "MOST_DIVIDED", 4 * 8**3)
    assert aligned._divisions(image, labels, None) == (1, 2, 2)
    assert said[1].endswith("divided by 1 x 2 x 2 instead of 2 x 2 x 2, for at most 2048 voxels")
