"""How kernels are compiled: records by address, units through symbols, several processes, the
cache.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from typing import NamedTuple

import numba
import numpy as np
import pytest

from tetopt.system import cache, kernel_cache, kernels
from tetopt.system.kernel_types import by_value
from tetopt.system.kernels import (
    Bools1,
    Floats1,
    Floats2,
    Floats3,
    Ints1,
    entry,
    helper,
    own,
    pack_record,
    run,
    unit,
)

compiled_only = pytest.mark.skipif(
    numba.config.DISABLE_JIT, reason="NUMBA_DISABLE_JIT is set: nothing is compiled"
)
linked_only = pytest.mark.skipif(
    kernel_cache.IS_PLAIN, reason="kernels are plain functions of numba's"
)


class Part(NamedTuple):
    values: Floats2
    is_on: Bools1
    count: int
    weight: float
    is_heavy: bool


class Room(NamedTuple):
    places: Floats3


class Whole(NamedTuple):
    name: int
    part: Part
    others: list[Part]
    out: Floats1
    threads: Ints1


@unit
def row_sum(part: Part, i: int) -> tuple[float, int]:
    total = 0.0
    for k in range(part.values.shape[1]):
        total += part.values[i, k]
    return (part.weight * total if part.is_heavy and part.is_on[i] else total), part.count


@helper
def both_sums(whole: Whole, i: int) -> float:
    return row_sum(whole.part, i)[0] + 10.0 * row_sum(own(whole.others), i)[0]


@unit
def fill(whole: Whole, number: int) -> None:
    whole.out[number] = both_sums(whole, number) + whole.name
    whole.threads[number] = own(whole.others).count


@entry
def all_sums(whole: Whole, n: int) -> float:
    total = 0.0
    for i in range(n):
        total += both_sums(whole, i)
    return total


def part(seed, n=7):
    rng = np.random.default_rng(seed)
    return Part(
        rng.normal(size=(n, 3)), rng.random(n) < 0.5, int(seed), float(rng.random()), bool(seed % 2)
    )


def whole():
    others = [part(10 + thread) for thread in range(numba.get_num_threads())]
    return Whole(-4, part(3), others, np.zeros(7), np.zeros(7, dtype=np.int64))


def expected_sum(part, i):
    total = part.values[i].sum()
    return part.weight * total if part.is_heavy and part.is_on[i] else total


@pytest.mark.kernel
def test_kernels_read_records():
    work = whole()
    sums = np.array(
        [
            [expected_sum(work.part, i) + 10.0 * expected_sum(other, i) for i in range(7)]
            for other in work.others
        ]
    )
    assert all_sums(work, 7) == pytest.approx(sums[0].sum(), rel=1e-14)
    for i in range(7):
        value, count = row_sum(work.part, i)
        assert (value, count) == (pytest.approx(expected_sum(work.part, i), rel=1e-14), 3)
    run(fill, 7, work)
    assert work.out == pytest.approx(sums[work.threads - 10, range(7)] - 4.0, rel=1e-14)


@unit
def n_done(out: Floats1) -> int:
    return int(np.sum(out))


@unit
def wait_or_do(whole: Whole, number: int) -> None:
    """The first number waits for all others, at most some seconds."""
    trials = 0
    while number == 0 and trials < 100_000_000 and n_done(whole.out) < len(whole.out) - 1:
        trials += 1
    whole.out[number] = 1.0 if trials < 100_000_000 else -1.0


@linked_only
@pytest.mark.skipif(numba.get_num_threads() < 2, reason="needs two threads")
def test_threads_take_what_is_left():
    """No number waits for a thread that is busy with another."""
    work = whole()
    run(wait_or_do, 7, work)
    assert work.out.tolist() == [1.0] * 7


@compiled_only
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"part": part(1)._replace(values=np.zeros((3, 7)).T)}, "Part.values: expected array"),
        ({"part": part(1)._replace(values=np.zeros(7))}, "Part.values: expected array"),
        ({"part": part(1)._replace(values=np.zeros((7, 3), "f4"))}, "Part.values: expected array"),
        ({"part": Room(np.zeros((1, 1, 1)))}, "Whole.part: expected .*Part"),
        ({"others": [Room(np.zeros((1, 1, 1)))]}, "Whole.others: expected .*Part"),
    ],
)
def test_another_record_is_refused(change, words):
    """Kernels would read its memory as that of the one they are for."""
    with pytest.raises(TypeError, match=words):
        pack_record(whole()._replace(**change))
    with pytest.raises(TypeError, match=r"fill: expected .*Whole.*, got .*Room"):
        run(fill, 3, Room(np.zeros((1, 1, 1))))


@linked_only
def test_a_key_of_another_version_is_read(monkeypatch):
    """numba reads all keys of a file of its cache; one may name a record that there is no more."""
    record_type = kernels.links().record_type
    here = pickle.dumps(record_type(Room))
    assert pickle.loads(here) is record_type(Room)
    renamed = here.replace(b"Room", b"Rope")
    assert len(renamed) == len(here)
    assert isinstance(pickle.loads(renamed), numba.types.Opaque)
    monkeypatch.setattr("tetopt.system.kernel_links.checksum", lambda: "another")
    assert isinstance(pickle.loads(here), numba.types.Opaque)


@compiled_only
def test_a_record_keeps_what_it_points_to():
    """Its arrays may have no other owner."""
    laid_out = pack_record(whole())
    fresh = [np.full((7, 3), -1.0) for _ in range(1000)]  # over what was freed, if it was
    assert all_sums(laid_out, 7) == all_sums(whole(), 7)
    assert len(fresh) == 1000


@compiled_only
def test_roots_are_what_no_kernel_calls():
    here = {kernel.__name__ for kernel in kernels.roots() if kernel.__module__ == __name__}
    assert here == {"fill", "all_sums", "wait_or_do"}


def test_by_value_is_a_named_tuple_of_its_arrays():
    assert by_value(Room) == numba.typeof(Room(np.zeros((1, 1, 1))))
    assert by_value(Part) == numba.typeof(part(1))


MODULE = """
from __future__ import annotations
from typing import NamedTuple
from tetopt.system.kernels import Floats1, entry, unit

class Row(NamedTuple):
    x: Floats1
"""
UNIT = """
@unit
def step_{0}(row: Row, i: int) -> float:
    return row.x[i] + {0}.0 + {1}
"""
PROGRAM = """
import os, sys
import numpy as np
import some_kernels as k
from tetopt.system import kernels
os.cpu_count = lambda: 2
started, start = [], kernels.start_child
kernels.start_child = lambda *words: started.append(1) or start(*words)
kernels.link([k.step_7])
kernels.link([k.step_7])  # compiles nothing again
cached = [f.was_cached for f in (k.step_0, k.step_3, k.step_7)]
print(k.step_7(k.Row(np.ones(3)), 2), len(started), cached)
"""


def ran(folder, program, cache=None, **names):
    """A program in a process of its own that imports from a folder, in whose `cache` kernels are
    kept.
    """
    paths = os.pathsep.join([str(folder), *filter(None, sys.path)])
    environment = (
        os.environ
        | {"NUMBA_CACHE_DIR": str(cache or folder / "cache"), "PYTHONPATH": paths}
        | names
    )
    command = [sys.executable, "-c", program]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True, cwd=folder
    )


WAITING = """
import os, tetopt.workers, numba
numba.set_num_threads(1)
print(os.environ["OMP_WAIT_POLICY"], numba.threading_layer())
"""


@pytest.mark.parametrize("chosen", [{}, {"OMP_WAIT_POLICY": "active"}])
def test_threads_wait_without_spinning(tmp_path, monkeypatch, chosen):
    """Unless the user wants them to: on a busy machine, spinning threads take the time of those
    that compute.
    """
    monkeypatch.delenv("OMP_WAIT_POLICY")  # of this process, which imported tetopt
    shown = ran(tmp_path, WAITING, OMP_DISPLAY_ENV="verbose", **chosen)
    policy, layer = shown.stdout.split()
    assert policy == chosen.get("OMP_WAIT_POLICY", "passive")
    if layer != "omp" or "GOMP" not in shown.stderr:
        pytest.skip("threads of another library than GNU's OpenMP")
    # in the library, whoever loaded it
    assert ("GOMP_SPINCOUNT = '0'" in shown.stderr) == (not chosen)


@pytest.mark.deep
@linked_only
def test_processes_share_what_is_to_be_compiled(tmp_path):
    """The first kernel that the cache lacks is compiled here, the others by two processes; a
    second run loads them.
    """
    units = [UNIT.format(n, f"step_{n - 1}(row, i)" if n else "0.0") for n in range(8)]
    (tmp_path / "some_kernels.py").write_text(MODULE + "".join(units))
    said = [ran(tmp_path, PROGRAM).stdout.strip() for _ in range(2)]
    assert said == ["36.0 2 [False, True, True]", "36.0 0 [True, True, True]"]


@compiled_only
def test_the_cache_knows_all_sources(monkeypatch):
    """numba's own key is the code of one function; here what it closes over is of all kernels."""

    def version():
        return kernels._version_function(row_sum.function).__closure__[0].cell_contents

    assert row_sum.symbol.endswith(version())
    monkeypatch.setattr(kernels, "checksum", lambda: "other")
    assert version() == "other"


# Where the cache is.


@pytest.fixture
def place(monkeypatch, tmp_path):
    """Where the cache is, of a name for its folder in the environment, below one that can be
    written; a folder beside the package and one of the user.
    """

    def find(chosen, beside="file/__pycache__", own="file"):
        cache.place_cache.cache_clear()
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(chosen))
        monkeypatch.setattr(cache, "BESIDE", tmp_path / beside)
        monkeypatch.setattr(cache, "_user_cache", lambda: tmp_path / own)
        return cache.place_cache()

    (tmp_path / "file").touch()  # in which no folder can be made, not even by root
    yield find
    cache.place_cache.cache_clear()


def test_a_cache_that_can_be_written_is_left_alone(place, tmp_path):
    folder = tmp_path / "not" / "yet"
    assert place(folder) == (folder, None)
    assert os.environ["NUMBA_CACHE_DIR"] == str(folder)


@pytest.mark.parametrize("chosen", ["", "file/kernels"])
def test_without_a_folder_kernels_are_kept_for_one_run(place, tmp_path, chosen):
    """The package and the home, or the chosen folder, cannot be written, whatever the rights of
    their folders say.
    """
    folder, notice = place(chosen and tmp_path / chosen)
    assert "recompiles the kernels, which takes half a minute" in notice
    assert (chosen or "__pycache__") in notice
    assert "set NUMBA_CACHE_DIR" in notice
    assert "\n" not in notice
    assert os.environ["NUMBA_CACHE_DIR"] == str(folder) != str(tmp_path / chosen)
    os.rmdir(folder)


def test_with_nowhere_to_write_nothing_is_kept(place, monkeypatch, tmp_path):
    def refuse(**_):
        raise FileNotFoundError("no usable temporary directory")

    monkeypatch.setattr(cache.tempfile, "mkdtemp", refuse)
    folder, notice = place(tmp_path / "file" / "kernels")
    assert folder is None
    assert "recompiles the kernels, which takes a minute" in notice
    assert cache.own_folder("kernels") is None


@pytest.mark.skipif(os.name != "posix", reason="rights of folders")
def test_a_folder_that_everybody_may_write_is_no_cache(place, tmp_path):
    """What numba reads there is code."""
    tmp_path.chmod(0o777)
    folder, notice = place(tmp_path)
    assert f"{tmp_path} is world-writable" in notice
    assert folder != tmp_path
    os.rmdir(folder)
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__").chmod(0o777)
    mask = os.umask(0)
    try:
        assert place("", "__pycache__", "own") == (tmp_path / "own" / "numba", None)
    finally:
        os.umask(mask)
    assert (tmp_path / "own" / "numba").stat().st_mode & 0o777 == 0o755
    assert cache.own_folder("kernels").stat().st_mode & 0o777 == 0o700


@pytest.mark.deep
def test_compilers_run_no_modules_of_the_current_folder(tmp_path, monkeypatch):
    for name in ("numpy", "json", "tempfile"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    words = []
    kernels._compile_apart(kernels.ALL_KERNELS[:1], 0, tmp_path, words.append)
    assert words[0].endswith("of 1")
    assert not (tmp_path / "executed").exists()


# What the cache holds, or cannot take.

USE = """
import sys, warnings
warnings.showwarning = lambda message, *_: print("warned:", message)
import numpy as np
import some_kernels as k
from tetopt.system import kernels
kernels._compile_apart = lambda *_: None  # what is compiled is compiled here
{before}
kernels.link([k.step_2])
cached = [f.was_cached for f in (k.step_0, k.step_1, k.step_2)]
print(k.step_2(k.Row(np.ones(3)), 2), k.plain(2.0), cached)
"""
PLAIN = """
from tetopt.system.kernel_cache import njit

@njit(cache=True)
def plain(x):
    return x + 1.0
"""


@pytest.fixture
def use(tmp_path):
    """A function that uses four kernels in a process of its own, after some statements; what
    that said.
    """
    units = [UNIT.format(n, f"step_{n - 1}(row, i)" if n else "0.0") for n in range(3)]
    (tmp_path / "some_kernels.py").write_text(MODULE + "".join(units) + PLAIN)

    def used(before=""):
        return ran(tmp_path, USE.format(before=before)).stdout.splitlines()

    used.folder = tmp_path / "cache"
    return used


COMPILED, LOADED = "6.0 3.0 [False, False, False]", "6.0 3.0 [True, True, True]"


DAMAGES = {
    "empty": lambda content: b"",
    "truncated": lambda content: content[: len(content) // 2],
    "of a byte at the end": lambda content: content[:-1],
    "zeros": lambda content: bytes(len(content)),
    "of other code": lambda content: b"not a pickle",
}


@pytest.mark.deep
@linked_only
def test_damaged_files_of_the_cache_are_compiled_anew(use):
    """An index or code, of a unit or of a function of numba's own: said once, mended, and the
    numbers are right.
    """
    assert use() == [COMPILED]
    assert use() == [LOADED]
    for first, suffix in enumerate(("nbi", "nbc")):
        paths = sorted(use.folder.rglob(f"some_kernels.*.{suffix}"))
        assert len(paths) == 4 + first  # one is called from Python, too
        for path, damage in zip(paths, list(DAMAGES.values())[first:], strict=False):
            path.write_bytes(damage(path.read_bytes()))
        *said, result = use()
        assert result == COMPILED
        assert said
        assert all(line.startswith("warned: recompiling kernels: the cache ") for line in said)
        assert use() == [LOADED]


@pytest.mark.deep
@linked_only
def test_a_full_disk_or_no_folder_keeps_nothing(use):
    folder = str(use.folder)
    for before in (
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))",
        f"import shutil; shutil.rmtree({folder!r}); open({folder!r}, 'w').close()",
    ):
        notice, numbers = use(before)
        assert numbers == COMPILED
        assert "cannot be kept" in notice
        assert not list(use.folder.rglob("*.tmp*"))


def link(path):
    path.rename(path.with_name("elsewhere"))
    path.symlink_to(path.with_name("elsewhere"))


UNTRUSTED = {
    "of its group": lambda path: path.chmod(0o770),
    "that all enter": lambda path: path.chmod(0o701),
    "a link": link,
    "another user's": lambda path: os.chown(path, 12345, -1),
}


@pytest.mark.skipif(os.name != "posix", reason="rights of files")
@pytest.mark.parametrize(
    "what", [what for what in UNTRUSTED if os.geteuid() == 0 or what != "another user's"]
)
def test_what_others_can_have_written_is_not_loaded(place, tmp_path, what):
    """It is code. Nobody else enters a folder that only its owner may enter."""
    place(tmp_path)
    folder = cache.own_folder("kernels")
    assert folder.stat().st_mode & 0o777 == 0o700
    (folder / "one.nbc").touch()
    (folder / "one.nbc").chmod(0o666)
    assert cache.own_folder("kernels") == folder
    UNTRUSTED[what](folder)
    with pytest.raises(PermissionError, match=f"another user could have written those in {folder}"):
        cache.own_folder("kernels")


@pytest.mark.deep
@linked_only
def test_a_cache_that_goes_while_it_is_used_is_made_again(use):
    assert use() == [COMPILED]
    said = use(f"k.step_0.link(); import shutil; shutil.rmtree({str(use.folder)!r})")
    assert said == ["6.0 3.0 [True, False, False]"]


@compiled_only
def test_what_another_run_compiles_is_waited_for(tmp_path, monkeypatch):
    """Else two first runs at once compile everything twice."""
    fcntl = pytest.importorskip("fcntl")
    words, clock = [], [0.0]
    with (tmp_path / kernels.LOCK_NAME).open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)

        def sleep(seconds):
            clock[0] += 1
            if clock[0] == 3:
                fcntl.flock(other, fcntl.LOCK_UN)

        monkeypatch.setattr(kernels.time, "sleep", sleep)
        with kernels._only_compiler(tmp_path, words.append) as has_waited:
            assert has_waited
    assert words == ["waiting for another run, which compiles the kernels"] * 3
    with kernels._only_compiler(tmp_path, words.append) as has_waited:
        assert not has_waited
    with kernels._only_compiler(tmp_path / "none", words.append) as has_waited:
        assert not has_waited


BEYOND = """
from __future__ import annotations
from typing import NamedTuple
import numpy as np
from tetopt.system.kernels import Floats1, entry, run, unit

class Row(NamedTuple):
    x: Floats1
    offset: int

@unit
def value(row: Row, i: int) -> float:
    return row.x[i + row.offset]

@unit
def zero(row: Row, i: int) -> None:
    row.x[i + row.offset] = 0.0

@entry
def own(row: Row) -> float:
    return row.x[row.offset]

@entry
def of_unit(row: Row) -> float:
    return value(row, 0)

def caught(call, row):
    try:
        call(row)
    except (IndexError, MemoryError):  # `run` knows no causes and takes each for the latter
        return True
    return False

calls = own, of_unit, lambda row: value(row, 0), lambda row: run(zero, 4, row)

def main():
    memory = np.ones(64)
    print([[caught(call, Row(memory[:4], offset)) for call in calls] for offset in (0, 9)])
"""


@pytest.mark.deep
@compiled_only
def test_an_index_beyond_its_array_is_caught_where_each_is_checked(tmp_path):
    """Also after kernels without checks were kept in the same cache; these are not run then."""
    (tmp_path / "beyond.py").write_text(BEYOND)
    program = "import beyond; beyond.main()"
    said = [
        ran(tmp_path, program, NUMBA_BOUNDSCHECK=is_checked).stdout.strip() for is_checked in "011"
    ]
    survived, checked = str([[False] * 4, [False] * 4]), str([[False] * 4, [True] * 4])
    assert said == [survived, checked, checked]


# Memory.

LARGE_UNIT = """
from __future__ import annotations
import sys
from typing import NamedTuple
import numpy as np
from tetopt.system import kernels
from tetopt.system.kernels import Floats1, entry, run, unit

class Row(NamedTuple):
    x: Floats1
    n: int

@unit
def large(row: Row, i: int) -> None:
    more = np.ones(row.n)
    row.x[i] = more[i]

@entry
def over_it(row: Row) -> float:
    large(row, 0)
    return row.x[0]

@unit
def doubled(x: Floats1, i: int) -> float:
    return 2.0 * x[i]

@entry
def last_doubled(x: Floats1) -> float:
    return doubled(x, len(x) - 1)
"""


FENCE = """
import warnings
warnings.showwarning = lambda message, *_: print("warned:", message)
import llvmlite.binding, numba
numba.njit(lambda: None)()  # numba itself has loaded what goes now
{before}
from large_unit import *
try:
    run(large, 4, Row(np.zeros(4), 1 << 45))
except MemoryError as error:
    print(error)
row = Row(np.zeros(4), 4)
row.x.flags.writeable = False  # numba takes it for another type
run(large, 4, row)
replaced = over_it(row._replace(x=np.ones(4)))
print(over_it(row), row.x, last_doubled(np.ones(3)), replaced, kernels.links() is None)
"""
UNKNOWN_SYMBOLS = """
add = llvmlite.binding.add_symbol
llvmlite.binding.add_symbol = lambda name, address: None if {!r} in name else add(name, address)
"""
CHANGES = (
    ("", None),
    ("import os; os.environ['TETOPT_PLAIN_NUMBA'] = '1'", None),
    ("del numba.extending.NativeValue", "ImportError: cannot import name 'NativeValue'"),
    (
        UNKNOWN_SYMBOLS.format("tetopt"),
        "RuntimeError: the linker has no symbol tetopt.system.kernels._multiply",
    ),
    # That of a later unit, when others have been linked and have run.
    (
        UNKNOWN_SYMBOLS.format("doubled"),
        "RuntimeError: the linker has no symbol large_unit.doubled",
    ),
    ("del numba.core.caching.FunctionCache", " load_overload, "),
)


@pytest.mark.deep
@compiled_only
def test_kernels_hold_where_numba_has_changed(tmp_path):
    """They are plain functions of numba's then, as on request: the same numbers; one line if nobody
    asked for it.

    All share one folder for their caches.
    """
    (tmp_path / "large_unit.py").write_text(LARGE_UNIT)
    for before, reason in CHANGES:
        said = ran(
            tmp_path, FENCE.format(before=before), cache=tmp_path, TETOPT_PLAIN_NUMBA=""
        ).stdout
        *notices, failure, numbers = sorted(
            said.splitlines(), key=lambda line: not line.startswith("warned")
        )
        assert failure == "large: 4 of 4 calls could not allocate their arrays"
        assert numbers == f"1.0 [1. 1. 1. 1.] 2.0 1.0 {before != ''}"
        assert len(notices) == (reason is not None)
        assert all(
            line.startswith("warned: kernels take longer to compile") and reason in line
            for line in notices
        )
    assert {path.parts[-3].partition("-")[0] for path in tmp_path.rglob("*.nbi")} == {
        "linked",
        "plain",
    }


SMALL_RUN = """
import hashlib
import tetopt
from tetopt.system import kernels

image = tetopt.load_phantom("two_spheres").image(voxel_mm=3)
labels = tetopt.Image((image.data > image.data.mean()).astype("int64"), image.affine)
for target in (image, tetopt.content(image, labels=labels)):
    mesh = tetopt.mesh_image(target, 400, iterations=3).mesh
    print(hashlib.sha256(mesh.points.tobytes() + mesh.cells.tobytes()).hexdigest())
print(kernels.links() is None)
"""


@pytest.mark.slow
def test_a_mesh_has_the_same_bits_without_the_inside_of_numba():
    """On two threads, of an image and of labels. All kernels are compiled plain first: minutes."""
    linked, plain = (
        subprocess.run(
            [sys.executable, "-c", SMALL_RUN],
            env=os.environ | {"TETOPT_PLAIN_NUMBA": value, "NUMBA_NUM_THREADS": "2"},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.split()
        for value in "01"
    )
    assert len(set(linked)) == 3
    assert (linked[:2], linked[2], plain[2]) == (plain[:2], "False", "True")


THREADS = """
import sys, threading
from large_unit import *

hook = sys.unraisablehook
begin, failed, seen = threading.Barrier(4), [0, 0, 0, 0], []

def work(number):
    row = Row(np.zeros(64), 64 if number % 2 else 1 << 45)
    begin.wait()
    for _ in range(100):
        try:
            run(large, 64, row) if number < 2 else over_it(row)
        except MemoryError:
            failed[number] += 1
        seen.append(sys.unraisablehook is hook)

threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
for each in threads: each.start()
for each in threads: each.join()
print(failed, all(seen))
"""


@pytest.mark.deep
@compiled_only
# the latter ends a process that loops in two threads
@pytest.mark.parametrize("layer", ["default", "workqueue"])
def test_each_thread_of_python_gets_its_own_errors(tmp_path, layer):
    (tmp_path / "large_unit.py").write_text(LARGE_UNIT)
    done = ran(tmp_path, THREADS, cache=tmp_path, NUMBA_THREADING_LAYER=layer)
    assert done.stdout == "[100, 0, 100, 0] True\n"
    assert done.stderr == ""
