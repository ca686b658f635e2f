"""Work directories: for the owner alone, of one run at a time, and the user's is not taken for
one or removed.
"""

import os
import stat
import subprocess
import sys

import pytest
from attacks import KINDS, content, outside, planted

from tetopt.errors import InputError
from tetopt.system.work_directory import check, create, lock_directory


@pytest.fixture
def work(tmp_path):
    create(tmp_path / "work")
    (tmp_path / "work" / "mesh-1.npz").write_text("nodes")
    return tmp_path / "work"


def test_it_is_the_owners_alone_and_made_once(work):
    assert stat.S_IMODE(work.stat().st_mode) == 0o700
    before = content(work)
    create(work)
    assert content(work) == before


def test_an_empty_folder_becomes_one(tmp_path):
    """Such as that of a run that was killed as it made it."""
    (tmp_path / "empty").mkdir(mode=0o755)
    check(tmp_path / "empty")
    create(tmp_path / "empty")
    (tmp_path / "empty" / "state.json").touch()
    check(tmp_path / "empty")
    assert stat.S_IMODE((tmp_path / "empty").stat().st_mode) == 0o700


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_none_is_one_line_and_stays(tmp_path, kind):
    planted(kind, tmp_path / "work", outside(tmp_path))
    before = content(tmp_path)
    for act in (check, create, lambda path: lock_directory(path, None).__enter__()):
        with pytest.raises(
            InputError,
            match=rf"^{tmp_path}/work: expected [^\n]*; move it away and run this again$",
        ):
            act(tmp_path / "work")
    assert content(tmp_path) == before


def test_a_lock_says_whose_it_is_and_ends_with_its_process(work):
    code = (
        "import sys, time; from pathlib import Path; from tetopt.system.work_directory "
        "import lock_directory\n"
    )
    code += (
        "with lock_directory(Path(sys.argv[1]), None): print(); sys.stdout.flush(); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code, work], stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        words = rf"^{work}: another run is writing there \(process {other.pid} on .*\); wait until"
        try:
            for keys in (None, ["a"]):
                with pytest.raises(InputError, match=words), lock_directory(work, keys):
                    pass
        finally:
            other.kill()
    with lock_directory(work, None):
        pass


def test_runs_of_other_keys_share_it(work):
    refused = {
        ("b",): rf"b: another run is writing there \(process {os.getpid()} ",
        None: r"another run is [^\n]*process\)",
    }
    with lock_directory(work, ["a", "b"]), lock_directory(work, ["c"]):
        for keys, words in refused.items():
            with pytest.raises(InputError, match=f"^{work}: {words}"), lock_directory(work, keys):
                pass
    assert (work / "tetopt-lock").read_text() == (work / "b.lock").read_text() == ""


def test_a_lock_that_is_a_link_empties_no_file(work, tmp_path):
    mine = tmp_path / "mine.txt"
    mine.write_text("of the user")
    for name, keys in (("tetopt-lock", None), ("a.lock", ["a"])):
        (work / name).unlink(missing_ok=True)
        (work / name).symlink_to(mine)
        with (
            pytest.raises(InputError, match=f"{name}: expected a regular file, got a link"),
            lock_directory(work, keys),
        ):
            pass
        assert mine.read_text() == "of the user"
        (work / name).unlink()
        (work / "tetopt-lock").touch()
