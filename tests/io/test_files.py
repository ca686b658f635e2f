"""Outputs: asked for before the work, written whole or not at all, with the permissions of any other file."""

import json
import math
import os
import stat
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from tetopt.errors import InputError
from tetopt.io.files import checked_output, save_json, written_whole

VTU = (".vtu",)
NIFTI = (".nii", ".nii.gz")


def assert_refused(path, match, suffixes=VTU, **options):
    """`checked_output` says why in one line that starts with the path, and touches nothing."""
    with pytest.raises(InputError, match=match) as caught:
        checked_output(path, suffixes, **options)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_new_file_may_be_written(tmp_path):
    path = tmp_path / "mesh.vtu"
    assert checked_output(path, VTU) == path
    assert checked_output(str(path), VTU, force=True) == path
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "A.NII.GZ", "v1.2.nii.gz", "Schädel.nii"])
def test_suffix_of_any_case(tmp_path, name):
    assert checked_output(tmp_path / name, NIFTI) == tmp_path / name


@pytest.mark.parametrize("name", ["a", "a.nii.zip", "nii", "a.vtu", "a.gz", "a.nii.gz.part"])
def test_other_suffixes_are_refused(tmp_path, name):
    assert_refused(tmp_path / name, "ends in .nii or .nii.gz", NIFTI)
    assert_refused(tmp_path / name, "ends in .nii or .nii.gz", NIFTI, force=True)


def test_an_existing_file_is_refused_without_force(tmp_path):
    path = tmp_path / "mesh.vtu"
    path.write_text("old")
    assert_refused(path, "exists already; pass --force")
    assert checked_output(path, VTU, force=True) == path
    assert path.read_text() == "old"


def test_a_missing_folder_is_refused_and_not_made(tmp_path):
    path = tmp_path / "no" / "mesh.vtu"
    assert_refused(path, "folder does not exist", force=True)
    assert not path.parent.exists()


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    assert_refused(tmp_path / "file" / "mesh.vtu", "folder does not exist")


def test_a_folder_in_place_of_the_file_is_refused(tmp_path):
    (tmp_path / "mesh.vtu").mkdir()
    assert_refused(tmp_path / "mesh.vtu", "found a folder", force=True)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_is_refused(tmp_path):
    tmp_path.chmod(0o555)
    try:
        assert_refused(tmp_path / "mesh.vtu", "cannot be written to")
    finally:
        tmp_path.chmod(0o755)


# --------------------------------------------------------------------------------------------------
# Whole or not at all


def test_the_file_appears_only_at_the_end(tmp_path):
    path = tmp_path / "image.nii.gz"
    with written_whole(path) as temporary:
        assert temporary.parent == tmp_path  # of the same file system, so that the renaming is atomic
        assert temporary.name.endswith(".nii.gz")  # from which writers tell the format
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, OSError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("old", [None, "old"])
def test_an_ended_block_leaves_what_was_there(tmp_path, error, old):
    path = tmp_path / "mesh.vtu"
    if old is not None:
        path.write_text(old)
    with pytest.raises(error), written_whole(path) as temporary:  # noqa: PT012
        temporary.write_text("half of the ne")
        raise error
    assert [p.read_text() for p in tmp_path.iterdir()] == ([] if old is None else [old])


def test_an_old_file_is_replaced_whole(tmp_path):
    path = tmp_path / "mesh.vtu"
    path.write_text("old and longer")
    with written_whole(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old and longer"
    assert path.read_text() == "new"


def test_a_writer_that_removes_its_file_leaves_the_old_one(tmp_path):
    path = tmp_path / "mesh.vtu"
    path.write_text("old")
    with pytest.raises(FileNotFoundError), written_whole(path) as temporary:
        temporary.unlink()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["m" * 250 + ".vtu", "m." + "v" * 244 + ".vtu", "ä" * 120 + ".vtu"])
def test_names_as_long_as_they_can_be(tmp_path, name):
    with written_whole(tmp_path / name) as temporary:
        temporary.write_text("new")
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664), (0o027, 0o640)])
def test_permissions_follow_the_umask(tmp_path, mask, mode):
    before = os.umask(mask)
    try:
        with written_whole(tmp_path / "a.json") as temporary:
            temporary.write_text("new")
        assert os.umask(mask) == mask  # left as it was
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == mode


# --------------------------------------------------------------------------------------------------
# JSON


class Row(NamedTuple):
    step: int
    E: float


def test_json_takes_what_runs_are_made_of(tmp_path):
    path = tmp_path / "a.json"
    value = {
        "integer": np.int64(2**53 + 1),
        "single": np.float32(0.5),
        "double": np.float64(0.1),
        "yes": np.bool_(True),
        "array": np.arange(4).reshape(2, 2),
        "rows": [Row(0, 1.0), Row(1, math.inf)],
        "tuple": (1, "Schädel", None),
        "path": Path("a") / "b",
        3: {"deep": (np.array([np.nan, 1.0]),)},
        "nan": math.nan,
        "minus": -np.float64(np.inf),
        "scalar array": np.array(7),
    }
    save_json(path, value)
    text = path.read_text(encoding="utf-8")

    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    assert json.loads(text, parse_constant=refuse) == {
        "integer": 2**53 + 1,
        "single": 0.5,
        "double": 0.1,
        "yes": True,
        "array": [[0, 1], [2, 3]],
        "rows": [{"step": 0, "E": 1.0}, {"step": 1, "E": None}],
        "tuple": [1, "Schädel", None],
        "path": str(Path("a") / "b"),
        "3": {"deep": [[None, 1.0]]},
        "nan": None,
        "minus": None,
        "scalar array": 7,
    }
    assert text.endswith("}\n")
    assert list(tmp_path.iterdir()) == [path]


def test_json_keeps_every_bit_of_a_float(tmp_path):
    values = np.random.default_rng(0).normal(size=100) * 10.0 ** np.arange(-50, 50)
    save_json(tmp_path / "a.json", {"values": values})
    assert json.loads((tmp_path / "a.json").read_text())["values"] == values.tolist()


def test_json_that_cannot_be_written_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    save_json(path, {"old": 1})
    with pytest.raises(TypeError):
        save_json(path, {"new": object()})
    assert json.loads(path.read_text()) == {"old": 1}
    assert list(tmp_path.iterdir()) == [path]
