"""Zarr folders: each voxel with its value and place; one line for what cannot be read."""

import json
import os
import shutil
import sys
from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import assert_done
from commands import assert_refused as assert_command_refused
from numpy.testing import assert_allclose, assert_array_equal
from readers import OBLIQUE, ramp, read_warned
from refusals import assert_refused, refusal

from tetopt.contents.phantom import load_phantom
from tetopt.image import Image
from tetopt.io import zarr_images
from tetopt.io.images import file_shape, load_image, save_image, sha256, status_checksum
from tetopt.io.zarr_images import save_zarr
from tetopt.system import budget

zarr = pytest.importorskip("zarr")
numcodecs = pytest.importorskip("numcodecs")

RAS = {"x": "left-to-right", "y": "posterior-to-anterior", "z": "inferior-to-superior"}


def axes_of(names, unit="micrometer", turned=RAS):
    kinds = {"t": "time", "c": "channel"}
    axes = [{"name": name, "type": kinds.get(name, "space")} for name in names]
    for axis in axes:
        if axis["type"] == "space":
            axis |= {"unit": unit} if unit else {}
            axis |= (
                {"orientation": {"type": "anatomical", "value": turned[axis["name"]]}}
                if turned
                else {}
            )
    return axes


def transforms(scale, shift=None):
    return [{"type": "scale", "scale": scale}] + (
        [{"type": "translation", "translation": shift}] if shift else []
    )


def write_ome(path, levels, axes, after=None, fmt=3, **options):
    """An OME-Zarr image; levels are of (voxels, transforms)."""
    group = zarr.open_group(path, mode="w", zarr_format=fmt)
    for number, (voxels, _) in enumerate(levels):
        options.setdefault("chunks", tuple(min(size, 4) for size in voxels.shape))
        group.create_array(str(number), data=voxels, **options)
    datasets = [
        {"path": str(k), "coordinateTransformations": each} for k, (_, each) in enumerate(levels)
    ]
    scales = {"axes": axes, "datasets": datasets}
    if after:
        scales["coordinateTransformations"] = after
    group.attrs.update(
        {"ome": {"version": "0.5", "multiscales": [scales]}}
        if fmt == 3
        else {"multiscales": [scales]}
    )
    return path


def small_ome(folder, shape=(3, 3, 3), unit="millimeter", dtype=np.int16, **options):
    """An OME-Zarr image of one level, voxels of 1 mm."""
    levels = [(ramp(*shape, dtype=dtype), transforms([1, 1, 1]))]
    return write_ome(folder / "a.zarr", levels, axes_of("xyz", unit), **options)


@pytest.mark.parametrize("fmt", [2, 3])
@pytest.mark.parametrize("dtype", [">u2", "<f4"])
def test_ome_zarr_keeps_values_and_place(tmp_path, fmt, dtype):
    voxels = ramp(6, 5, 4, dtype=dtype)
    place = transforms([300.0, 200.0, 100.0], [3.0, 2.0, 1.0])
    path = write_ome(tmp_path / "a.zarr", [(voxels, place)], axes_of("zyx"), fmt=fmt)
    image, part = load_image(path), load_image(path, crop=[(1, 5), (2, 4), (0, 3)])
    assert_array_equal(image.data, voxels)
    assert_array_equal(part.data, voxels[1:5, 2:4, 0:3])
    expected = [[0, 0, 0.1, 0.001], [0, 0.2, 0, 0.002], [0.3, 0, 0, 0.003], [0, 0, 0, 1]]
    assert_allclose(image.affine, expected, rtol=1e-15)
    assert_allclose(part.affine[:3, 3], image.to_world([1, 2, 0]))


def test_places_on_the_network_are_refused():
    for path in ("s3://bucket/a.zarr", "https://host/a.zarr", "gs://bucket/a.zarr"):
        assert_refused(Path(path), "got a URL")


def test_chunks_that_are_missing(tmp_path):
    path = small_ome(tmp_path, (8, 4, 4))
    (path / "0" / "c" / "1" / "0" / "0").unlink()
    said = read_warned(path)[1]
    assert "1 of its 2 chunks are missing; their voxels get its fill value, 0" in said[0]
    shutil.rmtree(path / "0" / "c")
    assert_refused(path, "all of its 2 chunks are missing")


def test_a_phantom_in_chunks_comes_back(tmp_path, monkeypatch):
    monkeypatch.setattr(zarr_images, "CHUNK_EDGE", 16)
    phantom, options = (
        load_phantom("layered_oblique"),
        {"voxel_mm": [2, 2, 3], "blur_mm": 1.0, "noise_sd": 5.0},
    )
    whole, path = phantom.image(**options), tmp_path / "a.zarr"
    values = np.rint(whole.data).astype(np.int16)
    save_zarr(path, whole.affine, values)
    image = load_image(path)
    assert_array_equal(image.data, values)
    array = zarr.open(path / "0", mode="r")
    assert (array.chunks, array.dtype) == ((16, 16, 16), np.int16)
    # sheared, which scale and translation are not
    assert_array_equal(image.affine, whole.affine)
    assert [each.name for each in tmp_path.iterdir()] == ["a.zarr"]


def test_a_slice_is_refused(tmp_path):
    with refusal("expected a 3-D image for Zarr, got a 2-D one"):
        save_zarr(tmp_path / "a.zarr", np.eye(3), ramp(4, 4))


@pytest.mark.parametrize("dtype", ["u1", "i2", "f4", "f8"])
def test_an_image_written_as_zarr_comes_back(here, dtype):
    """Also what is nothing but the fill value, which zarr leaves out by itself."""
    data = (
        np.zeros((4, 5, 6))
        if dtype == "u1"
        else ramp(4, 5, 6) * -10.0 + (0.1 if dtype == "f8" else 0)
    )
    image = Image(data if dtype != "f4" else np.float32(data) / 4, OBLIQUE)
    save_image("a.zarr", image)
    stored = load_image("a.zarr")
    assert zarr.open(here / "a.zarr" / "0", mode="r").dtype == dtype
    assert stored.data.tobytes() == image.data.tobytes()
    assert stored.affine.tobytes() == image.affine.tobytes()


def test_a_full_disk_leaves_the_old_folder(here, monkeypatch):
    def fail(array, box, values):
        raise OSError(28, "No space left on device")

    image = Image(ramp(4, 4, 4))
    save_image("a.zarr", image)
    before = sha256(here / "a.zarr")
    monkeypatch.setattr(zarr.Array, "__setitem__", fail)
    for name in ("a.zarr", "b.zarr"):
        with pytest.raises(OSError, match=f"cannot be written: No space left on device.*{name}"):
            save_zarr(here / name, image.affine, ramp(4, 4, 4))
    assert sha256(here / "a.zarr") == before
    assert [each.name for each in here.iterdir()] == ["a.zarr"]


def test_the_old_folder_comes_back_where_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    path, image = tmp_path / "a.zarr", Image(ramp(4, 4, 4))
    save_image(path, image)
    before, rename = sha256(path), os.rename

    def refused(old, new):
        if new == path and (Path(old) / "zarr.json").exists() and Path(old).name != "old":
            raise OSError(13, "Permission denied")
        rename(old, new)

    monkeypatch.setattr(os, "rename", refused)
    with pytest.raises(OSError, match="cannot be written: Permission denied"):
        save_image(path, Image(ramp(4, 4, 4) + 1))
    assert sha256(path) == before
    assert [each.name for each in tmp_path.iterdir()] == ["a.zarr"]


def test_only_a_folder_of_zarr_is_replaced(here, capfd):
    command = ["phantom sphere --voxel-mm 8 -o"]
    assert_done(*command, "a.zarr")
    before = sorted(Path("a.zarr").rglob("*"))
    assert_command_refused(capfd, [*command, "a.zarr"], "already exists; pass --force")
    assert_done(*command, "a.zarr --force")
    assert sorted(Path("a.zarr").rglob("*")) == before
    Path("b.zarr").mkdir()
    for path in ("b.zarr/precious", "c.zarr"):
        Path(path).write_text("mine")
    for words, match in (
        ("c.zarr --force", "expected a folder to write, found something else"),
        ("b.zarr --force", "expected a file to write, found an unrelated folder"),
        ("no/c.zarr", "its folder does not exist"),
    ):
        assert_command_refused(capfd, [*command, words], match)
    assert_command_refused(capfd, "phantom disc_2d -o d.zarr", "expected a 3-D image for Zarr")


# What the rest of the package asks of a folder of Zarr


@pytest.fixture(scope="module")
def pyramid(tmp_path_factory):
    """Two channels, two levels and an anisotropic place."""
    voxels = ramp(2, 6, 5, 4)
    levels = [
        (voxels, transforms([1, 3, 2, 1], [0, 30, 20, 10])),
        (voxels[:, ::2, ::2, ::2], transforms([1, 6, 4, 2], [0, 30, 20, 10])),
    ]
    folder = tmp_path_factory.mktemp("pyramid")
    return write_ome(folder / "a.ome.zarr", levels, axes_of("czyx", "millimeter")), voxels


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"crop": [(1, 5), (None, 3), (2, None)]},
        {"slice_": (1, 2)},
        {"slice_": (0, 3), "crop": [(1, 5), (1, 3), (0, 2)]},
    ],
)
def test_loaded_as_a_nifti_file_of_the_same_voxels(pyramid, here, options):
    path, voxels = pyramid
    affine = [[0, 0, 1, 10], [0, 2, 0, 20], [3, 0, 0, 30], [0, 0, 0, 1]]
    nibabel.save(nibabel.Nifti1Image(voxels[1], np.array(affine)), "a.nii")
    image, other = load_image(path, volume=1, **options), load_image("a.nii", **options)
    assert_array_equal(image.data, other.data)
    assert_allclose(image.affine, other.affine, rtol=1e-15)


def test_only_the_box_that_is_asked_for_is_read(pyramid, tmp_path):
    """A chunk that is damaged is seen only where it is needed, and told with the voxels that
    cannot be read.
    """
    path = tmp_path / "a.zarr"
    shutil.copytree(pyramid[0], path)
    chunk = path / "0" / "c" / "0" / "1" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:9])
    assert load_image(path, volume=0, crop=[(0, 4), (None, None), (None, None)]).shape == (4, 5, 4)
    for low in (0, 4):
        words = rf"its voxels 0, {low}:6, 0:5, 0:4 cannot be read \(.*\); copy it"
        assert_refused(
            path, words, volume=0, crop=[(low or None, None), (None, None), (None, None)]
        )


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({}, r"2 volumes along c \(2\); choose one from 0 to 1"),
        ({"volume": 2}, "got 2: the file has 2 volumes"),
        ({"volume": 0, "crop": [(0, 9), (0, 1), (0, 1)]}, "crop: expected 0 <= start"),
        ({"volume": 0, "crop": [(0, 1)]}, "crop: expected 3 ranges"),
        ({"volume": 0, "slice_": (3, 1)}, "slice: expected axis 0"),
        ({"volume": 0, "slice_": (0, 6)}, "slice: expected an index from"),
        (
            {"volume": 0, "slice_": (0, 1), "crop": [(2, 5), (1, 3), (0, 2)]},
            "slice: index 1 along axis 0 is outside",
        ),
    ],
)
def test_bad_parts_of_a_folder(pyramid, options, match):
    assert_refused(pyramid[0], match, **options)


def test_what_does_not_fit_into_memory_is_not_read(pyramid, monkeypatch):
    monkeypatch.setattr(budget, "available_bytes", lambda: 1000)
    assert_refused(pyramid[0], "its 6 x 5 x 4 voxels: needs about", volume=0)
    assert load_image(pyramid[0], volume=0, crop=[(0, 2)] * 3).shape == (2, 2, 2)


def test_shape_of_a_folder_begins_with_space(pyramid, here):
    assert file_shape(pyramid[0]) == (6, 5, 4, 2)
    (here / "b.zarr").mkdir()
    assert_refused("b.zarr", "no Zarr array in this folder", file_shape)


def test_checksums_of_a_folder(pyramid, tmp_path):
    path = shutil.copytree(pyramid[0], tmp_path / "a.zarr")
    whole, cheap = sha256(path), status_checksum(path)
    assert whole == sha256(pyramid[0])
    assert cheap == status_checksum(path)
    chunk = path / "0" / "c" / "0" / "1" / "0" / "0"
    voxels = chunk.read_bytes()
    chunk.write_bytes(bytes([*voxels[:-1], voxels[-1] ^ 1]))
    assert sha256(path) != whole
    assert status_checksum(path) != cheap  # by its time
    chunk.write_bytes(voxels)
    chunk.rename(chunk.with_name("7"))
    assert sha256(path) != whole  # names count
    (path / "again").symlink_to(path)  # ends
    sha256(path)
    os.mkfifo(path / "pipe")
    assert_refused(
        path / "pipe", "expected a regular file, got a pipe", lambda _: status_checksum(path)
    )
    (path / "pipe").unlink()
    (path / "link").symlink_to("nowhere")
    # not the whole folder
    assert_refused(path / "link", "no such file", lambda _: sha256(path))


def test_cheap_checksum_of_a_file(here):
    path = here / "a.nii"
    nibabel.save(nibabel.Nifti1Image(ramp(3, 3, 3), np.eye(4)), path)
    before = status_checksum(path)
    os.utime(path, ns=(0, 12345))
    assert status_checksum(path) != before
    assert_refused("b.nii", "no such file", status_checksum)


def test_coarse_levels_of_an_oblique_image(tmp_path):
    """The finest level's own affine turns the others with it."""
    levels = [
        (ramp(4, 4, 4), transforms([1, 1, 1])),
        (ramp(2, 2, 2), transforms([2, 2, 2], [0.5] * 3)),
    ]
    path = write_ome(tmp_path / "a.zarr", levels, axes_of("xyz", "millimeter", turned=None))
    zarr.open(path / "0").attrs["affine"] = OBLIQUE.tolist()
    image, coarse = load_image(path), load_image(path / "1")
    assert_array_equal(image.affine, OBLIQUE)
    assert_allclose(coarse.to_world([0, 0, 0]), image.to_world([0.5, 0.5, 0.5]))
    assert_allclose(coarse.to_world([1, 1, 1]), image.to_world([2.5, 2.5, 2.5]))


def test_a_level_is_placed_by_its_image(pyramid, tmp_path):
    """By its own folder, also with another name of it; the image's metadata count in checksums."""
    path, voxels = shutil.copytree(pyramid[0], tmp_path / "a.zarr"), pyramid[1]
    coarse = load_image(path / "1", volume=1)
    assert_array_equal(coarse.data, voxels[1, ::2, ::2, ::2])
    expected = [[0, 0, 2, 10], [0, 4, 0, 20], [6, 0, 0, 30], [0, 0, 0, 1]]
    assert_array_equal(coarse.affine, expected)
    assert (
        load_image(path / "0", volume=1).affine.tolist()
        == load_image(path, volume=1).affine.tolist()
    )
    before = sha256(path / "1"), status_checksum(path / "1")
    changed(path, set_in("datasets", 1, "coordinateTransformations", transforms([1, 6, 4, 3])))
    assert sha256(path / "1") != before[0]
    assert status_checksum(path / "1") != before[1]
    changed(path, lambda scales, _: scales["datasets"].pop())
    assert_refused(path / "1", "this Zarr array has no scale", volume=1)


def test_no_more_levels_are_opened_than_halving_gives(tmp_path):
    path = small_ome(tmp_path)
    changed(path, lambda scales, _: scales.update(datasets=1000 * scales["datasets"]))
    assert len(zarr_images.zarr_levels(path)) == zarr_images.MOST_LEVELS


# Folders that are no image


def changed(path, change):
    """The metadata of a group of Zarr 3, changed by a function of its multiscale and all of it."""
    file = path / "zarr.json"
    table = json.loads(file.read_text())
    change(table["attributes"]["ome"]["multiscales"][0], table)
    file.write_text(json.dumps(table))


def set_in(*keys):
    """A function that sets what is under these keys, but for the last, to the last, in a
    multiscale.
    """

    def change(scales, _):
        *way, key, value = keys
        for each in way:
            scales = scales[each]
        scales[key] = value

    return change


PLACE = ("datasets", 0, "coordinateTransformations")
OTHER = r"its OME-Zarr metadata does not follow NGFF 0\.4 or 0\.5 \("
MISSING = "its Zarr metadata cannot be read .*; copy it again"
BAD_METADATA = {
    "no multiscales": (
        lambda _, table: table["attributes"].clear(),
        "this Zarr group has no OME-Zarr image .* 0",
    ),
    "empty": (
        lambda _, table: table["attributes"]["ome"].update(multiscales=[]),
        "has no OME-Zarr image",
    ),
    "attributes of another kind": (
        lambda _, table: table["attributes"].update(ome=[1]),
        "has no OME-Zarr image",
    ),
    "no datasets": (set_in("datasets", []), OTHER),
    "empty datasets": (set_in("datasets", [{}] * 65), f"{OTHER}KeyError: 'path'"),
    "NGFF 0.3": (set_in("axes", ["z", "y", "x"]), OTHER),
    "NGFF 0.2": (lambda scales, _: scales.pop("axes"), f"{OTHER}KeyError: 'axes'"),
    "too few axes": (
        set_in("axes", axes_of("xyz")[:2] + axes_of("c")),
        "expected three spatial axes, got 2",
    ),
    "too many axes": (set_in("axes", axes_of("txyz")), OTHER),
    "an axis without a scale": (set_in(*PLACE, transforms([1, 1, 1, 1])), OTHER),
    "axes of other names": (
        set_in("axes", [dict(each, name="q", orientation=None) for each in axes_of("xyz")]),
        "axes: expected x, y and z, or three different orientations, got q, q, q",
    ),
    "one direction twice": (
        set_in("axes", axes_of("xyx")),
        "expected x, y and z, or three different orientations",
    ),
    "unit": (
        set_in("axes", axes_of("xyz", "second")),
        'unit: expected a length such as "mm" or "um", got "second"',
    ),
    "unit of no text": (set_in("axes", axes_of("xyz", ["mm"])), OTHER),
    "no scale": (set_in(*PLACE, []), "has no scale"),
    "a file of scales": (
        set_in(*PLACE, [{"type": "scale", "path": "x"}]),
        f"{OTHER}KeyError: 'scale'",
    ),
    "short scale": (set_in(*PLACE, transforms([1, 1])), OTHER),
    "scale of texts": (set_in(*PLACE, transforms(["a", "1", "1"])), OTHER),
    "scale of nothing": (set_in(*PLACE, transforms([0, 1, 1])), "affine: it is singular"),
    "scale beyond floats": (
        set_in(*PLACE, transforms([float("inf"), 1, 1])),
        "affine: expected finite",
    ),
    "whole number beyond floats": (set_in(*PLACE, transforms([10**400, 1, 1])), OTHER),
    "rotation": (
        set_in(*PLACE, [{"type": "rotation"}]),
        "expected scales and translations, got rotation",
    ),
    "way out": (set_in("datasets", 0, "path", "../b.zarr"), MISSING),
    "absolute": (set_in("datasets", 0, "path", "/etc"), MISSING),
    "no path": (set_in("datasets", 0, {}), f"{OTHER}KeyError: 'path'"),
    "link to elsewhere": (set_in("datasets", 0, "path", "s3://a/b"), MISSING),
    "array that is not there": (set_in("datasets", 0, "path", "no\nthing"), MISSING),
    "group in place of an array": (set_in("datasets", 0, "path", ""), OTHER),
}


@pytest.mark.full
@pytest.mark.parametrize("case", BAD_METADATA)
def test_metadata_that_is_of_no_image(tmp_path, case):
    path = small_ome(tmp_path)
    change, match = BAD_METADATA[case]
    changed(path, change)
    assert_refused(path, match)


@pytest.mark.deep
@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", '{"zarr_format": 9}', "\\0", '{"a": ' + "[" * 100_000]
)
@pytest.mark.parametrize("name", ["zarr.json", "0/zarr.json", "0/.zarray", ".zgroup"])
def test_metadata_that_is_damaged(tmp_path, name, text):
    fmt = 3 if name.endswith("json") else 2
    path = small_ome(tmp_path, fmt=fmt)
    (path / name).write_text(text)
    assert_refused(path, ".")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"dtype": "complex64"}, "expected real numbers, got dtype complex"),
        ({"dtype": "bool"}, None),
        ({"dtype": "float16"}, None),
        ({"dtype": "S3"}, r"expected real numbers, got dtype \|S3"),
        ({"dtype": [("r", "u1"), ("g", "u1")]}, "expected one number per voxel, got .*'r'"),
        ({"compressors": [numcodecs.Pickle()], "dtype": "i2"}, "pickle"),
        ({"filters": [numcodecs.Pickle()], "dtype": "i2"}, "pickle"),
        ({"filters": [numcodecs.Delta("i2")], "dtype": "i2"}, None),
        ({"compressors": [numcodecs.LZ4()], "dtype": "i2"}, None),
        ({"chunks": (1, 1, 1), "dtype": "i2"}, None),
    ],
)
def test_kinds_of_values_and_codecs(tmp_path, options, match):
    """What is packed by a codec that runs what the file says must not be unpacked."""
    path = tmp_path / "a.zarr"
    array = zarr.create_array(
        path, shape=(3, 3, 3), zarr_format=2, fill_value=None, **{"chunks": (2, 2, 2)} | options
    )
    array.attrs["affine"] = np.eye(4).tolist()
    if match:
        assert_refused(path, match)
    else:
        array[:] = np.ones((3, 3, 3), array.dtype)
        assert load_image(path).data.sum() == 27


def test_a_codec_that_is_missing_is_named(tmp_path):
    path = small_ome(tmp_path)
    file = path / "0" / "zarr.json"
    file.write_text(file.read_text().replace('"zstd"', '"jpeg2000"'))
    assert_refused(path, "Zarr metadata cannot be read .*jpeg2000")


def test_arrays_by_themselves(here):
    voxels = ramp(3, 4, 5, 2)
    array = zarr.create_array(here / "a", data=voxels, chunks=(2, 2, 2, 1))
    assert_refused(here / "a", 'this Zarr array has no scale; .* attribute "affine"')
    array.attrs["affine"] = OBLIQUE.tolist()
    assert_refused(here / "a", r"2 volumes along axis 3 \(2\)")
    image = load_image("a", volume=1)
    assert_array_equal(image.data, voxels[..., 1])
    assert_array_equal(image.affine, OBLIQUE)
    for affine, match in (
        (np.eye(3).tolist(), "expected shape"),
        ("x", "expected a"),
        (np.zeros((4, 4)).tolist(), "last"),
    ):
        array.attrs["affine"] = affine
        assert_refused(here / "a", match, volume=1)
    zarr.create_array(here / "b.zarr", shape=(3, 4), dtype="i2")
    assert_refused("b.zarr", r"expected 3 to 32 axes with voxels, got shape \(3, 4\)")


def test_chunks_that_cannot_be(tmp_path, monkeypatch):
    path = small_ome(tmp_path, (8, 4, 4), dtype="f4", fill_value=np.nan)
    chunk = path / "0" / "c" / "1" / "0" / "0"
    packed = chunk.read_bytes()
    for damaged in (b"", packed[:7], packed[:-3], b"\0" * len(packed)):
        chunk.write_bytes(damaged)
        assert_refused(path, "its (voxels 0:8, 0:4, 0:4 cannot be read|chunk c/1/0/0 has)")
    chunk.unlink()
    os.mkfifo(chunk)
    assert_refused(path, "its chunk c/1/0/0 is not a regular file")
    chunk.unlink()
    assert np.isnan(load_image(path).data[4:]).all()  # no values
    assert read_warned(path, crop=[(0, 4)] * 3)[1] == []  # which do not need it
    monkeypatch.setattr(zarr_images, "MOST_CHUNKS", 1)
    assert_refused(path, "expected at most 1 chunks, got 2")
    monkeypatch.setattr(budget, "available_bytes", lambda: 100)
    assert_refused(path, "one of its chunks of 4 x 4 x 4 voxels: needs about")


def test_raw_chunks_and_shards_that_are_cut(tmp_path):
    for options in ({"compressors": None}, {"chunks": (2, 2, 2), "shards": (4, 4, 4)}):
        path = small_ome(tmp_path, (4, 4, 4), **options)
        part = load_image(path, crop=[(1, 3), (0, 4), (2, 4)])
        assert_array_equal(part.data, ramp(4, 4, 4)[1:3, :, 2:])
        chunk = path / "0" / "c" / "0" / "0" / "0"
        chunk.write_bytes(chunk.read_bytes()[:-5])
        assert_refused(path, "cannot be read")


def test_metadata_that_is_no_file(here):
    (here / "a.zarr").mkdir()
    os.mkfifo(here / "a.zarr" / "zarr.json")
    assert_refused("a.zarr", "its zarr.json is a pipe")


def test_without_the_library(pyramid, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    assert_refused(pyramid[0], 'Zarr folders need the zarr library; pip install "zarr(>=[0-9.]+)?"')


def test_what_axes_do_not_say(tmp_path):
    """Where left and right are, and the unit: taken, and said; types of axes, by their names."""
    axes = [{"name": name} for name in "zyx"]
    place, after = transforms([3, 2, 1], [1, 1, 1]), transforms([2, 2, 2], [5, 6, 7])
    path = write_ome(tmp_path / "a.zarr", [(ramp(3, 4, 5), place)], axes, after)
    image, said = read_warned(path)
    words = " ".join(said)
    assert "has no orientation: assuming x, y and z are right, anterior and superior" in words
    assert "has no unit on its axes: assuming mm" in words
    assert_array_equal(image.affine, [[0, 0, 2, 9], [0, 4, 0, 8], [6, 0, 0, 7], [0, 0, 0, 1]])


def test_orientation_turns_axes_to_ras(tmp_path):
    """NGFF's RFC-4, whatever the names are: the first axis goes to the back, the second to the
    left, the third down.
    """
    turned = {"x": "anterior-to-posterior", "y": "right-to-left", "z": "superior-to-inferior"}
    levels = [(ramp(3, 4, 5), transforms([1, 2, 3], [7, 8, 9]))]
    path = write_ome(tmp_path / "a.zarr", levels, axes_of("xyz", "millimeter", turned))
    assert_array_equal(
        load_image(path).affine, [[0, -2, 0, -8], [-1, 0, 0, -7], [0, 0, -3, -9], [0, 0, 0, 1]]
    )
