"""Outputs: asked for before the work, written whole or not at all, with the permissions of any
other file.
"""

import errno
import json
import math
import os
import stat
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from attacks import content

from tetopt.errors import InputError
from tetopt.system.files import (
    check_output,
    check_places,
    check_space,
    folder_written_whole,
    name_files,
    output_place,
    outputs_of_command,
    results_folder,
    save_bytes,
    save_json,
    save_text,
    written_whole,
)

VTU = (".vtu",)
NIFTI = (".nii", ".nii.gz")


@pytest.fixture
def old(tmp_path):
    """An output that is there."""
    path = tmp_path / "mesh.vtu"
    path.write_text("old")
    return path


def failing(*words):
    """A function that fails as the system does."""

    def fail(*_, **__):
        raise OSError(*words)

    return fail


def assert_refused(path, match, suffixes=VTU, **options):
    """`check_output` says why in one line that starts with the path, and touches nothing."""
    with pytest.raises(InputError, match=match) as caught:
        check_output(path, suffixes, **options)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "A.NII.GZ", "v1.2.nii.gz", "Schädel.nii"])
def test_a_new_file_may_be_written(tmp_path, name):
    path = tmp_path / name
    assert check_output(path, NIFTI) == check_output(str(path), NIFTI, force=True) == path
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a", "nii", "a.gz", "a.nii.gz.part"])
def test_other_suffixes_are_refused(tmp_path, name):
    assert_refused(tmp_path / name, "ending in .nii or .nii.gz", NIFTI, force=True)


def test_an_existing_file_is_refused_without_force(old):
    assert_refused(old, "already exists; pass `force`")
    assert check_output(old, VTU, force=True) == old
    assert old.read_text() == "old"


def test_a_folder_that_is_none_and_a_file_that_is_one_are_refused(old, tmp_path):
    assert_refused(tmp_path / "no" / "mesh.vtu", "folder does not exist", force=True)
    assert_refused(old / "mesh.vtu", "folder does not exist")
    assert content(tmp_path) == {"mesh.vtu": b"old"}
    (tmp_path / "b.vtu").mkdir()
    assert_refused(tmp_path / "b.vtu", "found a folder", force=True)


def test_a_folder_that_takes_no_file_is_refused(tmp_path, monkeypatch):
    """Whatever its rights say, a file is made there: root may write everywhere, but not on a
    full disk.
    """
    monkeypatch.setattr(tempfile, "mkstemp", failing(errno.EROFS, "Read-only file system"))
    assert_refused(tmp_path / "mesh.vtu", "folder is not writable: Read-only file system")


@pytest.mark.parametrize("name", ["m" * 252 + ".vtu", "m\0.vtu"])
def test_a_name_that_cannot_be_is_refused(tmp_path, name):
    assert_refused(tmp_path / name, "cannot be written: (File name too long|.*embedded null)")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes in folders")
def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "mesh.vtu")
    assert_refused(tmp_path / "mesh.vtu", "found a device, a pipe", force=True)
    (tmp_path / "a.vtu").symlink_to("b.vtu")
    (tmp_path / "b.vtu").symlink_to("a.vtu")
    assert_refused(tmp_path / "a.vtu", "a circular link|Too many levels", force=True)


def test_a_folder_that_cannot_be_made_is_refused(old, tmp_path):
    for name, words in (
        ("new/../" + "a" * 300, "cannot create the folder for the results"),
        ("new/../a\0b", "cannot create the folder for the results"),
        ("new/../mesh.vtu/b", "cannot create the folder for the results"),
        ("mesh.vtu", "found a file"),
    ):
        with pytest.raises(InputError, match=words), outputs_of_command():
            results_folder(tmp_path / name)
    assert content(tmp_path) == {"mesh.vtu": b"old"}


@pytest.mark.parametrize("is_there", [True, False])
def test_a_link_is_written_through(tmp_path, is_there):
    """And stays; one whose target is not there yet makes that."""
    (tmp_path / "far").mkdir()
    target, link = tmp_path / "far" / "a.vtu", tmp_path / "a.vtu"
    link.symlink_to("far/a.vtu")
    if is_there:
        target.write_text("old")
    assert_refused(link, "already exists; pass `force`")
    check_output(link, VTU, force=True)
    save_bytes(link, b"new")
    assert content(tmp_path)["a.vtu"] == "far/a.vtu"
    assert content(tmp_path)["far/a.vtu"] == b"new"
    (tmp_path / "c.vtu").symlink_to(tmp_path / "no" / "c.vtu")
    assert_refused(tmp_path / "c.vtu", "a link to .*its folder does not exist", force=True)


def test_a_link_that_is_turned_during_the_run_changes_nothing(old, tmp_path):
    link = tmp_path / "l.vtu"
    link.symlink_to("mesh.vtu")
    with outputs_of_command():
        check_output(link, VTU, force=True)
        link.unlink()
        link.symlink_to("b")
        save_bytes(link, b"new")
    assert content(tmp_path) == {"mesh.vtu": b"new", "l.vtu": "b"}


# --------------------------------------------------------------------------------------------------
# Within a command


def test_a_new_output_appears_and_may_be_written_again(tmp_path):
    path = tmp_path / "a.vtu"
    with outputs_of_command() as outputs:
        check_output(path, VTU)
        for text in (b"new", b"newer"):
            save_bytes(path, text)
            assert path.read_bytes() == text
    assert outputs.written == [path]  # told once
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("has_links", [True, False])
@pytest.mark.parametrize("name", ["a.vtu", "a.b.vtu", "m" * 251 + ".vtu"])
def test_a_file_that_appears_stays_and_the_output_is_beside_it(
    tmp_path, monkeypatch, has_links, name
):
    """Also where files have one name only; and what is written again replaces the output."""
    if not has_links:
        monkeypatch.setattr(os, "link", failing(errno.EPERM, "Operation not permitted"))
    path = tmp_path / name
    with outputs_of_command() as outputs:
        check_output(path, VTU)
        path.write_bytes(b"other")
        for text in (b"new", b"newer"):
            save_bytes(path, text)
        beside = output_place(path)
        with pytest.raises(InputError, match="appeared") as told:
            check_places(outputs)
    assert (beside != path, beside.suffix, str(beside) in str(told.value)) == (True, ".vtu", True)
    assert content(tmp_path) == {name: b"other", beside.name: b"newer"}
    assert outputs.written == [beside]
    with outputs_of_command() as outputs:
        check_output(path, VTU, force=True)
        save_bytes(path, b"forced")
        check_places(outputs)
    assert path.read_bytes() == b"forced"


def test_a_folder_that_appears_stays_too(tmp_path):
    path = tmp_path / "a.zarr"
    with outputs_of_command():
        check_output(path, (".zarr",), is_ours=Path.is_dir)
        path.mkdir()
        (path / "x").write_bytes(b"other")
        with folder_written_whole(path) as folder:
            (folder / "x").write_bytes(b"new")
        assert output_place(path) == tmp_path / "a_1.zarr"
    assert (path / "x").read_bytes() == b"other"
    assert (tmp_path / "a_1.zarr" / "x").read_bytes() == b"new"
    assert len(os.listdir(tmp_path)) == 2


def test_no_output_is_an_input_or_another_output(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.vtu").write_text("an input")
    Path("l.vtu").symlink_to("a.vtu")
    os.link("a.vtu", "h.vtu")
    for output, named in (
        ("a.vtu", ["a.vtu", "a.vtu"]),
        ("a.vtu", ["a.vtu", "./a.vtu"]),
        ("l.vtu", ["l.vtu", "a.vtu"]),
        ("h.vtu", ["a.vtu", "h.vtu"]),
        ("new.vtu", ["new.vtu", tmp_path / "new.vtu"]),
        ("a.vtu", [tmp_path, "a.vtu", tmp_path / "a.vtu"]),
    ):
        with outputs_of_command():
            name_files([None, 3, [Path(name) for name in named]])
            assert_refused(
                Path(output), "is also an input or another output of this command", force=True
            )
    with outputs_of_command():
        name_files([Path("a.vtu"), Path("b.vtu")])
        check_output("a.vtu", VTU, force=True)
        check_output("b.vtu", VTU)


# --------------------------------------------------------------------------------------------------
# Whole or not at all


@pytest.mark.parametrize("name", ["image.nii.gz", "..nii.gz", ".nii.gz", "a.b.nii.gz"])
def test_the_file_appears_only_at_the_end(tmp_path, name):
    path = tmp_path / name
    with written_whole(path) as temporary:
        # of the same file system, so that the renaming is atomic
        assert temporary.parent == tmp_path
        assert temporary.name.endswith(".nii.gz")  # from which writers tell the format
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError, ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("name", ["mesh.vtu", "new.vtu"])
def test_an_ended_block_leaves_what_was_there(old, tmp_path, error, name):
    with pytest.raises(error), written_whole(tmp_path / name) as temporary:  # noqa: PT012
        temporary.write_text("half of the ne")
        raise error
    assert content(tmp_path) == {"mesh.vtu": b"old"}


def test_a_writer_that_removes_its_file_leaves_the_old_one(old, tmp_path):
    with pytest.raises(FileNotFoundError), written_whole(old) as temporary:
        temporary.unlink()
    assert content(tmp_path) == {"mesh.vtu": b"old"}


@pytest.mark.parametrize(
    "name", ["m" * 250 + ".vtu", "m." + "v" * 244 + ".vtu", "ä" * 120 + ".vtu"]
)
def test_names_as_long_as_they_can_be(tmp_path, name):
    with written_whole(tmp_path / name) as temporary:
        temporary.write_text("new")
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o027, 0o640)])
def test_permissions_follow_the_umask(tmp_path, mask, mode):
    before = os.umask(mask)
    try:
        with written_whole(tmp_path / "a.json") as temporary:
            temporary.write_text("new")
        assert os.umask(mask) == mask  # left as it was
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == mode


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such rights")
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444])
def test_a_replaced_file_keeps_its_rights(old, mode, monkeypatch):
    """Patient data that nobody else may read stays so; what nobody may write is replaced by its
    owner, too.
    """
    open_file = os.open

    def opened(file, flags, *rest, **options):  # as for anybody but root
        if flags & os.O_RDWR and os.path.exists(file) and not os.stat(file).st_mode & stat.S_IWUSR:
            raise PermissionError(errno.EACCES, "Permission denied", file)
        return open_file(file, flags, *rest, **options)

    monkeypatch.setattr(os, "open", opened)
    old.chmod(mode)
    save_bytes(old, b"new")
    assert old.read_text() == "new"
    assert stat.S_IMODE(old.stat().st_mode) == mode


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root has every group"
)
def test_a_replaced_file_keeps_its_group(old, monkeypatch):
    os.chown(old, -1, 12345)
    old.chmod(0o660)
    save_bytes(old, b"new")
    assert (old.stat().st_gid, stat.S_IMODE(old.stat().st_mode)) == (12345, 0o660)
    # another group must not get what that one was allowed
    monkeypatch.setattr(os, "chown", failing(errno.EPERM, "Operation not permitted"))
    save_bytes(old, b"newer")
    assert old.stat().st_gid != 12345
    assert stat.S_IMODE(old.stat().st_mode) == 0o600


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    steps, replace = [], os.replace
    monkeypatch.setattr(
        os, "fsync", lambda handle: steps.append(stat.S_IFMT(os.fstat(handle).st_mode))
    )
    monkeypatch.setattr(os, "replace", lambda *names: (steps.append("name"), replace(*names)))
    save_bytes(tmp_path / "a.json", b"new")
    assert steps == [stat.S_IFREG, "name", *([] if os.name == "nt" else [stat.S_IFDIR])]


def test_an_error_names_the_file_and_a_full_disk_the_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "write_bytes", failing(errno.ENOSPC, "No space left on device"))
    words = r"cannot be written: No space left on device; it needs 3 bytes, \d+ are free"
    with pytest.raises(OSError, match=words) as caught:
        save_bytes(tmp_path / "mesh.vtu", b"new")
    assert caught.value.filename == str(tmp_path / "mesh.vtu")
    assert content(tmp_path) == {}


def test_space_is_asked_for(tmp_path):
    check_space(tmp_path / "a.vtu", 1)
    with pytest.raises(InputError, match=r"a.vtu: needs at least 10{18} bytes, but only \d+ are"):
        check_space(tmp_path / "a.vtu", 10**18)


@pytest.mark.skipif(sys.platform != "linux", reason="names are of bytes on Linux alone")
def test_text_of_names_that_are_not_utf_8_is_written(tmp_path):
    name = os.fsdecode(b"caf\xe9")
    save_text(tmp_path / f"{name}.html", f"of {name} Grösse")
    assert (tmp_path / f"{name}.html").read_text(encoding="utf-8") == "of caf\\udce9 Grösse"
    save_json(tmp_path / f"{name}.json", {name: Path(name)})
    assert json.loads((tmp_path / f"{name}.json").read_text()) == {"caf\\udce9": "caf\\udce9"}


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


def test_json_that_cannot_be_written_leaves_the_old_file(old, tmp_path):
    with pytest.raises(TypeError):
        save_json(old, {"new": object()})
    assert content(tmp_path) == {"mesh.vtu": b"old"}
