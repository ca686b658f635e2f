"""Runs in parts that end on the way, by whatever, and go on: the same bits as in one go, or one
clear line.
"""

import errno
import shutil
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from parted import balls, one_thread, request

from tetopt.errors import InputError
from tetopt.parts import part, work
from tetopt.parts.part import work_on
from tetopt.parts.rounds import in_turn, mesh_in_parts
from tetopt.parts.work import save_volume
from tetopt.system.work_directory import locked

REQUEST = request(300, 4, iterations=6)
N_PARTS = 4 + 4 + 9 + 4  # measured, two rounds, fields


class Interruption(Exception):
    """What is not tetopt's."""


@pytest.fixture(autouse=True)
def _few_threads():
    with one_thread():
        yield


@pytest.fixture(scope="module")
def voxels():
    return balls((20, 18, 16))


@pytest.fixture
def folder(tmp_path, voxels):
    save_volume(tmp_path, voxels)
    return tmp_path


@pytest.fixture(scope="module")
def in_one_go(voxels, tmp_path_factory):
    folder = tmp_path_factory.mktemp("in_one_go")
    save_volume(folder, voxels)
    with one_thread():
        return content(run(folder))


def run(folder, runner=in_turn, asked_for=REQUEST, **options):
    return mesh_in_parts(asked_for, folder, crew=lambda *_: nullcontext(runner), **options)


def content(parted):
    """All of a result but the times."""
    result = parted.result
    arrays = [
        result.mesh.points,
        result.mesh.cells,
        result.initial.points,
        parted.part,
        *parted.fields.values(),
    ]
    return (
        [array.tobytes() for array in arrays],
        [row._replace(seconds=0.0) for row in result.history],
        result.ended,
    )


def test_it_does_not_matter_in_which_order_parts_are_run(folder, in_one_go):
    """Nor whether their numbers come back: what counts is in files."""
    assert content(run(folder, lambda names: (None for _ in in_turn(names[::-1])))) == in_one_go


@pytest.mark.full
def test_a_run_that_ends_after_each_part_goes_on(folder, in_one_go, monkeypatch):
    made, ends, result = [], 0, None
    improved = part._improved
    monkeypatch.setattr(
        part, "_improved", lambda *arguments: made.append(1) or improved(*arguments)
    )
    while result is None:
        try:
            result = run(folder, ending_at_new)
        except Interruption:
            ends += 1
    assert content(result) == in_one_go
    assert ends == N_PARTS
    assert len(made) == 4 + 4 + 9  # none twice


def ending_at_new(names):
    """A runner that ends when a part is done that was not."""
    for name in names:
        is_new = not work.done_path(Path(name)).exists()
        yield work_on(name)
        if is_new:
            raise Interruption


@pytest.mark.deep
def test_a_disk_that_is_full_at_each_file_once_loses_nothing(folder, in_one_go, monkeypatch):
    """Each file of the run fails to be written the first time; so does each step between two of
    them.
    """
    full, result = set(), None
    write = work.written_whole

    def written_whole(path, size):
        is_state = path.name == work.STATE_NAME and path.exists()
        # a state is written again in each round
        key = (path, path.stat().st_mtime_ns if is_state else 0)
        if key not in full:
            full.add(key)
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return write(path, size)

    monkeypatch.setattr(work, "written_whole", written_whole)
    while result is None:
        before = len(full)
        try:
            result = run(folder)
        except OSError as error:
            assert error.errno == errno.ENOSPC  # noqa: PT017 (there are many of them)
            assert len(full) == before + 1
    assert content(result) == in_one_go
    assert len(full) == 2 * N_PARTS + 1 + 4  # parts and what came of them, the initial mesh, states


def test_a_run_that_is_stopped_gives_the_last_round_and_goes_on(folder, in_one_go):
    parts = []
    first = run(
        folder, is_over=lambda: len(parts) >= 6, watch=lambda now, history: parts.append(now)
    )
    assert (first.result.ended, first.result.history[-1].iteration) == ("stopped", 0)
    # Again at once, where what the end of the first left is not taken for parts of the round.
    second = run(folder, is_over=lambda: True)
    assert content(second) == content(first)
    assert content(run(folder)) == in_one_go


def test_a_run_that_ends_when_it_has_converged_does_not_go_on_with_rounds(
    folder, voxels, tmp_path_factory
):
    lenient = REQUEST._replace(k_D=0.0, tolerance=0.5)
    other = tmp_path_factory.mktemp("other")
    save_volume(other, voxels)
    expected = content(run(other, asked_for=lenient))
    assert expected[2] == "converged"
    assert len(expected[1]) == 2
    kinds = []

    def ending_at_fields(names):
        if kinds[-1] == "fields":
            raise Interruption
        yield from in_turn(names)

    with pytest.raises(Interruption):
        run(folder, ending_at_fields, lenient, watch=lambda now, history: kinds.append(now.kind))
    assert content(run(folder, asked_for=lenient)) == expected


@pytest.fixture(scope="module")
def ended(voxels, tmp_path_factory):
    """A folder of a run that ended when three parts of its first round were done."""
    folder, rounds = tmp_path_factory.mktemp("ended"), []
    save_volume(folder, voxels)

    def runner(names):
        rounds.append(names)
        yield from in_turn(names if len(rounds) == 1 else names[:3])
        if len(rounds) > 1:
            raise Interruption

    with one_thread(), pytest.raises(Interruption):
        run(folder, runner)
    return folder


@pytest.fixture
def copy(ended, tmp_path):
    return Path(shutil.copytree(ended, tmp_path / "copy"))


def damaged(path, way):
    raw = bytearray(path.read_bytes())
    if way == "a bit":
        raw[len(raw) // 2] ^= 1
    path.write_bytes(raw[: len(raw) // 2] if way == "cut short" else raw)


@pytest.mark.full
def test_what_came_of_a_part_is_made_again_if_it_is_damaged(copy, in_one_go):
    done = sorted((copy / "round-1").glob("done-*"))
    assert len(done) == 3
    damaged(done[0], "a bit")
    damaged(done[1], "cut short")
    done[2].write_bytes(b"")
    damaged(copy / "round-1" / "part-0.npz", "a bit")
    assert content(run(copy)) == in_one_go


@pytest.mark.parametrize(
    ("name", "way"),
    [("state.npz", "a bit")]
    + [(name, "cut short") for name in ("state.npz", "initial.npz", "volume.json", "voxels.npy")],
)
def test_a_damaged_state_is_said_in_a_line(copy, name, way):
    damaged(copy / name, way)
    with pytest.raises(
        InputError,
        match=rf"^[^\n]*{name}: the file is damaged [^\n]*; remove {copy} and run this again$",
    ):
        run(copy)


@pytest.mark.deep
def test_no_bit_of_a_file_of_arrays_changes_unseen(tmp_path):
    path, arrays, text = (
        tmp_path / "a.npz",
        {"ticks": np.arange(6), "cells": np.eye(2)},
        {"kind": "measure"},
    )
    work.save_arrays(path, arrays, text)
    raw = path.read_bytes()
    n_seen = 0
    for at in range(0, len(raw), 3):
        path.write_bytes(raw[:at] + bytes([raw[at] ^ (1 << at % 8)]) + raw[at + 1 :])
        try:
            there = work.load_arrays(path)
        except InputError:
            n_seen += 1
        else:  # the archive's dates, say
            assert there[1] == text
            assert {name: array.tolist() for name, array in there[0].items()} == {
                name: array.tolist() for name, array in arrays.items()
            }
    assert n_seen > 0.7 * len(raw) / 3


@pytest.mark.parametrize("words", [b"", b"{}", b"\xff"])
def test_a_state_of_other_words_is_said_in_a_line(folder, words):
    (folder / "state.npz").write_bytes(words)
    with pytest.raises(InputError, match=r"^[^\n]*: the file is damaged [^\n]*$"):
        run(folder)


def test_a_folder_of_another_run_is_refused(folder):
    with (
        locked(folder),
        pytest.raises(InputError, match=f"^{folder}: another run is writing there [^\n]*$"),
    ):
        run(folder)


@pytest.mark.full
def test_what_a_killed_run_has_left_is_not_in_the_way(copy, in_one_go):
    names = (".state.npz.abcd_123.npz", "round-1/.done-3.npz.abcd_123.npz")
    for name in names:
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_text("half")
    assert content(run(copy)) == in_one_go
    assert work.removed(copy) == []


@pytest.mark.full
def test_fields_that_a_runner_leaves_as_its_time_is_over_are_taken_all_the_same(folder, in_one_go):
    def runner(names):
        kind = work.load_arrays(Path(names[0]))[1]["kind"]
        yield from in_turn(names[:1] if kind == "fields" else names)

    assert content(run(folder, runner)) == in_one_go
