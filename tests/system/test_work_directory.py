"""Work directories: for the owner alone, refused with anything of others in them, removed without following links."""

import stat
from contextlib import ExitStack

import pytest
from attacks import KINDS, content, outside, planted

from tetopt.errors import InputError
from tetopt.system import work_directory
from tetopt.system.files import save_text
from tetopt.system.incoming import own_bytes
from tetopt.system.work_directory import Layout, check_files, create, discard, opened

LAYOUT = Layout("a test", r"lock|mesh-\d+\.npz", {r"round-\d+": r"part-\d+\.npz", "scratch": None})


@pytest.fixture(params=[True, False], ids=["descriptors", "paths"])
def work(tmp_path, request, monkeypatch):
    """A work directory with something of each kind; as on Windows, too, which has no descriptors of folders."""
    monkeypatch.setattr(work_directory, "HAS_DESCRIPTORS", request.param)
    folder = tmp_path / "work"
    create(folder, LAYOUT)
    for name in ("mesh-1.npz", ".mesh-2.npz.abcd_123.npz", "round-0/part-0.npz", "scratch/any/thing"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    return folder


def checked(folder):
    with opened(folder, LAYOUT) as work:
        work.check()


def locked(folder, what="it"):
    with ExitStack() as stack:
        stack.enter_context(opened(folder, LAYOUT)).lock(stack, "lock", is_shared=False, what=what)


def test_it_is_the_owners_alone_and_its_own_files_are_taken(work):
    assert stat.S_IMODE(work.stat().st_mode) == 0o700
    checked(work)
    before = content(work)
    create(work, LAYOUT)
    assert content(work) == before


def test_an_empty_folder_becomes_one(tmp_path):
    (tmp_path / "empty").mkdir(mode=0o755)
    create(tmp_path / "empty", LAYOUT)
    checked(tmp_path / "empty")
    assert stat.S_IMODE((tmp_path / "empty").stat().st_mode) == 0o700


def test_a_run_that_was_killed_as_it_created_it_is_not_in_the_way(tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / ".tetopt-manifest.abcd_123").write_text("half")
    checked(tmp_path / "work")
    create(tmp_path / "work", LAYOUT)
    checked(tmp_path / "work")
    assert (tmp_path / "work" / "tetopt-manifest").read_text().startswith("{")


# Where there is something wrong, and with what.
PLACES = [(name, kind) for name in ("mesh-1.npz", "lock", "tetopt-manifest") for kind in KINDS if kind != "file"]
PLACES += [("round-0/part-0.npz", kind) for kind in KINDS if kind != "file"]
PLACES += [(name, kind) for name in ("round-0", "scratch") for kind in KINDS if kind != "folder"]
PLACES += [(name, kind) for name in ("notes.txt", "round-0/notes.txt", ".notes.abcd_123.txt") for kind in KINDS]


@pytest.mark.parametrize(("name", "kind"), PLACES)
def test_what_is_not_tetopts_is_one_line_and_stays(work, name, kind):
    elsewhere = outside(work.parent)
    planted(kind, work / name, elsewhere)
    before = content(work.parent)
    create(work, LAYOUT)
    with pytest.raises(InputError, match=rf"^{work / name.partition('/')[0]}[^\n]*; move it away and run this again$"):
        checked(work)
    assert content(work.parent) == before
    discard(work, LAYOUT)
    assert content(elsewhere) == {key.partition("/")[2]: value for key, value in before.items() if "outside/" in key}


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "folder"])
def test_it_is_no_link_or_file_itself(work, kind):
    elsewhere = outside(work.parent)
    planted(kind, work, elsewhere)
    before = content(work.parent)
    create(work, LAYOUT)
    for act in (checked, lambda path: discard(path, LAYOUT), lambda path: check_files(path, "a test")):
        with pytest.raises(InputError, match=f"^{work}: expected a folder, got "):
            act(work)
    assert content(work.parent) == before


@pytest.mark.parametrize("manifest", [None, "", "{}", "[" * 9000, '{"work": "another"}', "x" * 20_000, b"\xff\xfe"])
def test_without_its_manifest_it_is_not_ours(work, manifest):
    """Such as one of a version before there was a manifest, or the user's, with a file called lock."""
    (work / "lock").touch()
    if manifest is None:
        (work / "tetopt-manifest").unlink()
    else:
        (work / "tetopt-manifest").write_bytes(manifest.encode() if isinstance(manifest, str) else manifest)
    before = content(work)
    create(work, LAYOUT)
    with pytest.raises(InputError, match=rf"^{work}[^\n]*; move it away and run this again$"):
        checked(work)
    assert content(work) == before


def test_a_lock_with_a_second_name_is_not_written_to(work):
    elsewhere = outside(work.parent)
    planted("hard link", work / "lock", elsewhere)
    with pytest.raises(InputError, match=rf"^{work / 'lock'}: expected a file without hard links"):
        locked(work)
    assert (elsewhere / "notes.txt").read_text() == "years of work"


def test_a_lock_says_whose_it_is(work):
    with ExitStack() as stack:
        stack.enter_context(opened(work, LAYOUT)).lock(stack, "lock", is_shared=False, what="it")
        with pytest.raises(InputError, match=r"^it: another run is writing there \(process \d+ on "):
            locked(work)
    locked(work)


def test_what_is_removed_is_what_is_listed(work):
    elsewhere = outside(work.parent)
    (work / "scratch" / "link").symlink_to(elsewhere)
    (work / "thesis.txt").write_text("mine")
    before = content(elsewhere)
    assert discard(work, LAYOUT) == ["thesis.txt"]
    assert content(work) == {"thesis.txt": b"mine"}
    assert content(elsewhere) == before
    (work / "thesis.txt").unlink()
    create(work, LAYOUT)
    assert discard(work, LAYOUT) == []
    assert not work.exists()


@pytest.mark.parametrize("name", ["mesh-3.npz", "tetopt-manifest"])
def test_files_that_a_killed_run_was_writing_are_its_own(work, monkeypatch, name):
    """As `written_whole` names them, whatever else it may come to call them."""
    monkeypatch.setattr("os.unlink", lambda *_, **__: None)
    monkeypatch.setattr("os.replace", lambda *_: 1 / 0)
    before = set(content(work))
    with pytest.raises(ZeroDivisionError):
        save_text(work / name, "half")
    assert len(set(content(work)) - before) == 1
    checked(work)


@pytest.mark.parametrize("kind", ["file link", "device link", "pipe", "folder", "long"])
def test_own_files_are_regular_and_of_bounded_size(tmp_path, kind):
    path = tmp_path / "numbers.json"
    path.write_bytes(b"1234")
    assert own_bytes(path, 4) == b"1234"
    if kind != "long":
        planted(kind, path, outside(tmp_path))
    with pytest.raises(InputError, match=f"^{path}: expected "):
        own_bytes(path, 3)
