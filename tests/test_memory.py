"""Memory is asked for before it is taken: what there is, what things need, and one line where
that is too much.
"""

from __future__ import annotations

import re
import warnings
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from commands import assert_refuses, numbers_in, run_command
from models import sample_image

import tetopt
from tetopt.cli import run as cli_run
from tetopt.cli import warm_up
from tetopt.contents.content import content, plain
from tetopt.contents.memberships import memberships
from tetopt.energy.sampling import sampling_grid
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.engine.meshing import process_bytes
from tetopt.fem.elasticity import stiffness
from tetopt.fem.reference import reference
from tetopt.job.events import listen_with, progress, start_stage
from tetopt.job.mesh_stage import left_words, watch_run
from tetopt.start.memory import (
    BOUND_MARGIN,
    CHANNEL_BYTES,
    MESHED_CELL_BYTES,
    bytes_of,
    meshing_bytes,
    next_bytes,
)
from tetopt.start.octree import _block_limits, _blocks_by_depth
from tetopt.start.sums import channels_of
from tetopt.system import budget

GIB = 1 << 30


@pytest.fixture
def system(monkeypatch, tmp_path):
    """A machine of 8 GiB whose control groups the test writes, in /proc and /sys/fs/cgroup."""
    monkeypatch.setattr(budget, "PROC_FOLDER", tmp_path / "proc")
    monkeypatch.setattr(budget, "GROUP_FOLDER", tmp_path / "group")
    monkeypatch.setattr(budget, "resource", None)

    def write(path, text):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)

    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=8 * GIB))
    return write


def test_the_machine_and_its_groups_limit_memory(system):
    """The least of all is what there is: of the machine, of version 2 and 1, of a group and
    those above it.
    """
    assert budget.available_bytes() == 8 * GIB
    system("proc/self/cgroup", "0::/job/step\n")
    assert budget.available_bytes() == 8 * GIB
    system("group/job/memory.max", f"{4 * GIB}\n")
    system("group/job/memory.current", f"{3 * GIB}\n")
    system("group/job/memory.stat", f"anon 5\ninactive_file {GIB // 2}\n")
    assert budget.available_bytes() == GIB + GIB // 2
    system("group/job/step/memory.max", "max\n")
    system("group/job/step/memory.current", f"{3 * GIB}\n")
    system("group/job/step/memory.stat", "inactive_file 0\n")
    assert budget.available_bytes() == GIB + GIB // 2
    system("proc/self/cgroup", "3:cpu,memory:/docker/abc\n")
    assert budget.available_bytes() == 8 * GIB
    system("group/memory/memory.usage_in_bytes", f"{3 * GIB}\n")
    system("group/memory/memory.stat", "total_inactive_file 0\n")
    for limit, available in ((2 * GIB, 0), ((1 << 63) - 4096, 8 * GIB)):
        system("group/memory/memory.limit_in_bytes", f"{limit}\n")
        assert budget.available_bytes() == available


def test_memory_is_known_here():
    assert budget.available_bytes() > 10**7
    assert 10**7 < budget.resident_bytes() <= budget.peak_bytes()


def test_words_have_units():
    for size, words in ((2.5e9, "2.5 GB"), (1.26e8, "0.126 GB"), (7.5e6, "7.5 MB")):
        assert budget.memory_words(size) == words


@pytest.mark.parametrize(
    ("n_bytes", "limit", "words"),
    [(1000, None, "of memory, but only 0.001 MB is free"), (600, 1000, "in total, but only")],
)
def test_a_limit_counts_what_there_is(monkeypatch, n_bytes, limit, words):
    monkeypatch.setattr(budget, "available_bytes", lambda: 1000)
    monkeypatch.setattr(budget, "resident_bytes", lambda: 400)
    with budget.limit_memory(limit):
        budget.check_memory(n_bytes, "a", "b")
        with pytest.raises(tetopt.InputError, match=f"^a: needs about 0.001 MB .*{words}.*; b$"):
            budget.check_memory(n_bytes + 1, "a", "b")
        if limit is not None:
            budget.check_memory(n_bytes + 1, "a", "b", can_stop=True)
    for n_used, is_over in ((600, False), (601, True)):
        assert budget.MemoryLimit(1000, n_used).is_reached() == is_over


IMAGE = tetopt.Image(
    np.random.default_rng(0).integers(1, 4, (9, 8, 7)).astype(float), np.diag([1.0, 1.0, 3.0, 1.0])
)
LATTICE = tetopt.lattice_mesh(IMAGE, blocks=(2, 2, 2))
LIMITS, CHANNELS = _block_limits(plain(IMAGE), 100, None), channels_of(plain(IMAGE))
TASKS = {
    r"lattice: .* nodes: needs.*use at most \d+ nodes$": lambda: tetopt.lattice_mesh(
        IMAGE, spacing=0.1
    ),
    "octree: .* blocks: needs.*allow longer edges, or crop": lambda: _blocks_by_depth(
        plain(IMAGE), CHANNELS, (4, 4, 4), LIMITS
    ),
    "phantom 'sphere': .* voxels: needs.*use larger": lambda: tetopt.load_phantom("sphere").image(),
    "image: 2 sums of 9 x 8 x 7 voxels: needs.*crop the image": lambda: sampling_grid(
        IMAGE, LATTICE.points
    ),
    "labels: 3 labels on 1512 .*division by 1 x 1 x 3.*: needs.*smooth": lambda: memberships(
        IMAGE, (1, 1, 3)
    ),
    "elasticity: the stiffness of .* cells with 10 nodes each: needs.*coarser": lambda: stiffness(
        LATTICE, 1.0, 0.3, 2
    ),
    "reference: 2160 degrees of freedom: needs.*`reference_dofs`": lambda: reference(IMAGE, 0.3),
    r"^octree: 100 nodes: needs.*use at most \d+$": lambda: tetopt.mesh_image(IMAGE, 100),
    "^an image of 9 x 8 x 7 voxels: needs.*`crop`": lambda: tetopt.mesh_image(IMAGE, start=LATTICE),
}


@pytest.mark.parametrize("words", TASKS)
def test_what_needs_more_than_there_is_does_not_begin(monkeypatch, words):
    monkeypatch.setattr(budget, "available_bytes", lambda: 1000)
    with pytest.raises(
        tetopt.InputError,
        match=words.replace("needs", "needs about .* but only 0.001 MB is free; "),
    ):
        TASKS[words]()


def test_what_is_kept_of_voxels_counts():
    """Channels of a content, and a mask, take memory besides the image."""
    ones = tetopt.Image(np.ones((6, 5, 4)))
    kinds = [plain(IMAGE), content(IMAGE, mask=tetopt.Image(np.ones(IMAGE.shape), IMAGE.affine))]
    first, masked = (bytes_of(kind, 0) for kind in kinds)
    assert masked - first == pytest.approx(BOUND_MARGIN * CHANNEL_BYTES * IMAGE.data.size)
    assert bytes_of(plain(ones), 50) - bytes_of(plain(ones), 0) == pytest.approx(
        300 * BOUND_MARGIN * MESHED_CELL_BYTES
    )
    assert next_bytes(0) == 0.0
    assert 0.0 < next_bytes(1000) < meshing_bytes(0, 0, 1000)


def test_a_whole_process_holds_what_it_reads():
    """Besides meshing: the image's voxels, and those of a mask and of labels' levels."""
    mask, labels = (
        tetopt.Image(np.ones(IMAGE.shape), IMAGE.affine),
        tetopt.Image(np.rint(IMAGE.data), IMAGE.affine),
    )
    bare, masked, labelled = (content(IMAGE), content(IMAGE, mask=mask), content(IMAGE, labels))
    beside = [(process_bytes(each, 50) - bytes_of(each, 50)) for each in (bare, masked, labelled)]
    assert beside[0] < beside[1] < beside[2]
    assert process_bytes(bare, 0) > 1.5e8


@pytest.mark.full
def test_a_run_ends_before_the_limit_with_the_mesh_reached(here, monkeypatch):
    """`--max-gb`: the image alone, or the initial mesh, is refused at once, else what is reached
    is written, and said why.
    """
    tetopt.save_image("a.nii.gz", sample_image(3))
    words = "mesh a.nii.gz -o a.vtu --json a.json --nodes 60 --iterations 2 --force --max-gb"
    only = "GB of memory in total, but only 1 MB is allowed; use --crop"
    assert_refuses(f"{words} 0.001", only)
    for value in ("0", "-1", "nan"):
        assert_refuses(f"{words} {value}", "--max-gb: expected more than 0")
    run_command(f"{words} 100")
    numbers = numbers_in("a.json")
    assert numbers["ended"] in ("iterations", "converged")
    assert numbers["options"]["max_gb"] == 100.0
    assert 0 < numbers["memory"]["peak_bytes"]
    assert 0 < numbers["memory"]["predicted_bytes"]
    with monkeypatch.context() as patch:
        patch.setattr("tetopt.start.octree.OCTREE_NODE_BYTES", 1e9)
        monkeypatch.setattr(budget, "available_bytes", lambda: 1 << 50)
        said = run_command(f"{words} 10", code=2).err
    assert "60 nodes: needs" in said
    assert "only 10 GB is allowed" in said
    monkeypatch.setattr(budget.MemoryLimit, "is_reached", lambda self: True)
    said = run_command(f"{words} 100", code=None).err
    assert "memory limit reached: the current mesh is kept" in said
    assert numbers_in("a.json")["ended"] == "max_gb"
    assert tetopt.check_mesh(tetopt.load_mesh("a.vtu").mesh) == []


# What is said meanwhile, where there is no terminal.


@pytest.fixture
def log(monkeypatch):
    """The lines that are printed, and a clock, s."""
    lines, clock = [], [0.0]
    monkeypatch.setattr(cli_run.log, "print", lines.append)
    monkeypatch.setattr(cli_run.time, "perf_counter", lambda: clock[0])
    return lines, clock


def test_lines_are_rare_and_the_first_is_said_at_once(monkeypatch, log):
    """Each waits twice as long as the one before."""
    lines, clock = log
    at_once, later = cli_run.rare_lines(is_first_said=True), cli_run.rare_lines()
    for second in range(71):
        clock[0] = float(second)
        at_once(f"a {second}")
        later(f"b {second}")
    assert lines == ["a 0", "b 10", "a 20", "b 30", "a 60", "b 70"]
    monkeypatch.setattr(type(cli_run.log), "is_terminal", True)
    clock[0] = 1000.0
    at_once("on a terminal there is a bar")
    assert len(lines) == 6


def test_compiling_and_long_iterations_are_told(log):
    """Before anything is compiled there is a line; and iterations, E, seconds and memory are
    told as they go.
    """
    lines, clock = log

    def make(say):
        say("compiling the kernels, 1 of 57")
        assert lines == ["compiling the kernels, 1 of 57 (stored for later runs), 0 s"]

    rows = [
        IterationRecord(number, 1.0 - 0.1 * number, 2.0, 1.0, 0.1, False, 48, 504, 3.0)
        for number in (0, 1)
    ]

    def optimized(max_seconds, callback, stop):
        callback(rows[0])
        for second in (5, 11, 12):
            clock[0] = float(second)
            assert not stop()
        callback(rows[1])
        return MeshingResult(LATTICE, rows, "iterations", LATTICE)

    with closing(cli_run.Display(lambda: None)) as display, listen_with(display):
        start_stage("kernels")
        make(progress)
        lines.clear()
        start_stage("optimise", "optimising", 1)
        watch_run(optimized, LATTICE, 1, None, display.is_over)
    memory = r"\d+(\.\d+)? [GM]B"
    assert len(lines) == 3
    assert re.fullmatch(rf"iteration   0/1  E 1\.0000  E_G 1.* cells  3\.0 s, ({memory})", lines[0])
    assert re.fullmatch(rf"  in iteration 1, 11\.0 s, ({memory})", lines[1])
    assert lines[2].startswith("iteration   1/1  E 0.9000")


def records(*seconds):
    """Records of iterations that ended at these times."""
    return [
        IterationRecord(n, 1.0, 1.0, 1.0, 0.1, False, 48, 504, at) for n, at in enumerate(seconds)
    ]


def test_the_time_left_is_told_from_the_third_iteration_on():
    """At the pace of the last two iterations, within the time that is allowed; after the last
    there is none.
    """
    assert left_words(records(1.0, 9.0, 15.0), 10, None) == ""
    for most, seconds, words in (
        (10, None, ", about 35 s left, then measuring"),
        (10, 25.0, ", about 6 s left, then measuring"),
        (10, 18.0, ", about 0 s left, then measuring"),
        (103, None, ", about 8 min left, then measuring"),
        (3, None, ""),
    ):
        assert left_words(records(1.0, 9.0, 15.0, 19.0), most, seconds) == words


def test_the_log_tells_nodes_memory_and_time(here):
    """The nodes of sizes and the memory, as in run.json, come before the first iteration."""
    tetopt.save_image("a.nii.gz", sample_image(3))
    words = "mesh a.nii.gz -o a.vtu --json a.json --edge-size 9 --iterations 5"
    before, *lines = re.split(r"iteration +\d+/5", run_command(words).err.replace("\n", " "))
    numbers = numbers_in("a.json")
    assert f"sizes require about {numbers['nodes_of_sizes']} nodes" in before
    bound = numbers["memory"]["predicted_bytes"]
    stated = float(re.search(r"about (\S+) GB of memory", before)[1])
    assert stated == pytest.approx(bound / 1e9, rel=0.05)
    assert numbers["memory"]["peak_bytes"] < 1.2 * bound
    is_told = ["s left" in line for line in lines]
    assert is_told == [False, False, False, True, True, False][: len(lines)]


def test_warm_up_tells_how_compiling_goes(monkeypatch, capsys):
    def link(kernels, progress=None):
        assert kernels
        progress("compiling the kernels, 1 of 2")
        raise InterruptedError

    monkeypatch.setattr(warm_up, "link", link)
    with pytest.raises(InterruptedError):
        warm_up.warm_up_command()
    assert "compiling the kernels, 1 of 2 (stored for later runs)" in capsys.readouterr().err


LAYERS = np.linalg.norm(np.indices((16, 16, 16)) - 7.5, axis=0)
CONTENTS = {
    "plain": {},
    "labels": {"labels": "l.nii.gz"},
    "thick slices": {"labels": "z.nii.gz", "images": "z.nii.gz"},
    "a thin wall": {"mask": "m.nii.gz"},
}


@pytest.mark.full
@pytest.mark.parametrize("kind", CONTENTS)
def test_a_run_writes_the_same_bytes_in_half_of_the_memory_or_is_refused(here, monkeypatch, kind):
    thick = np.diag([1.0, 1.0, 3.0, 1.0])
    tetopt.save_image("a.nii.gz", tetopt.Image(LAYERS))
    tetopt.save_image("l.nii.gz", tetopt.Image(1.0 * (LAYERS < 6.0)))
    tetopt.save_image("z.nii.gz", tetopt.Image(1.0 * (LAYERS < 6.0), thick))
    tetopt.save_image("m.nii.gz", tetopt.Image(1.0 * (abs(LAYERS - 5.0) < 1.0)))
    options = {"images": "a.nii.gz", "nodes": 80, "iterations": 1, "force": True, **CONTENTS[kind]}
    made, n_refused = set(), 0
    for free in (1e12, 4e8, 2e8):
        monkeypatch.setattr(budget, "available_bytes", lambda free=free: int(free))
        with warnings.catch_warnings(action="ignore"):
            try:
                tetopt.run(tetopt.Job(output="a.vtu", **options))
            except budget.MemoryShortage:
                n_refused += 1
            else:
                made.add(Path("a.vtu").read_bytes())
    assert (len(made), n_refused) == (1, 1)
