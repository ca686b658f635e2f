"""Optimisation in rounds of parts: the mesh is cut, optimised part by part, joined, and cut
elsewhere.

Each round moves and exchanges everything except shared nodes, a fifth of the nodes in parts of
5,000; the planes of the next round lie elsewhere. Each part is normalised by the whole initial
mesh, so that its gain is the decrease of E, and keeps its number of nodes, or gets its fraction of
those still to be added. The result of a round does not depend on which workers run its parts, or on
how many run at a time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content
from tetopt.contents.statistics import Statistics, statistics
from tetopt.energy.sampling import grid_bits
from tetopt.engine.fast import EXCHANGING_FRACTION
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.engine.requirements import checked_in_box
from tetopt.errors import InputError
from tetopt.geometry.simplex import volumes
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.parts.cut import ROUND_SHIFTS, Piece, Shared, counts_of, cut, joined, pieces
from tetopt.parts.part import Kind, Numbers, PartSettings, box_of_ticks, work_on
from tetopt.parts.work import (
    INITIAL_NAME,
    STATE_NAME,
    VolumeFile,
    WorkState,
    done_path,
    gone_if_refused,
    load_arrays,
    load_state,
    open_volume,
    round_folder,
    save_arrays,
    save_state,
    save_volume,
)
from tetopt.start.memory import part_bytes
from tetopt.start.octree import octree_mesh
from tetopt.start.sizes import Sizes
from tetopt.system.work_directory import locked

# in a part: 17,000 nodes, a tenth to a fifth of them shared, and some seconds per round
MOST_CELLS = 100_000
MOST_VOXELS = 2**25  # in the cells of a part, 34 million: with sums less than 1.5 GB
# Sweeps in a round. Four rounds of 4 left 3.5 % more E_D than one piece of 16 sweeps (MNI152,
# 40,000 nodes, 4 parts), six rounds of 3 left 2.4 %: nodes that are shared, and fixed, in the last
# round have had more sweeps before.
ROUND_SWEEPS = 3
# ratio of the largest box of any round to that of the first cut: 1.08 was measured
BOX_EXCESS = 1.25

Runner = Callable[[Sequence[str]], Iterator[Any]]
"""Runs `work_on` for each part's file, and yields as they end."""


class PartsRequest(NamedTuple):
    """The settings of a run in parts."""

    nodes: int
    n_parts: int  # minimum
    k_D: float
    iterations: int  # rounded up to whole rounds
    shape_power: float
    min_dihedral: float  # degrees
    tolerance: float  # the run ends when E decreases by less per sweep, averaged over a round
    sizes: Sizes | None
    checksum: str  # of all these and the image; a run with the same one is resumed


class Round(NamedTuple):
    """The state of a round, for progress reports."""

    number: int  # from 0, which measures the initial mesh
    n_rounds: int  # at most, including the last one, which computes cell fields
    kind: Kind
    n_parts: int
    done: int  # number of finished parts


class Parted(NamedTuple):
    """The results of a run in parts."""

    result: MeshingResult  # with a record for each round
    fields: dict[str, NDArray]  # the image in each cell: n_voxels, mean, variance, min, max
    part: NDArray[np.int64]  # (M,) of each cell, ascending


def in_turn(names: Sequence[str]) -> Iterator[Any]:
    """Work on one part after the other, in this process."""
    for name in names:
        yield work_on(name)


def mesh_in_parts(
    request: PartsRequest,
    folder: Path,
    known: Statistics | None = None,
    *,
    volume: VolumeFile | Image | None = None,
    crew: Callable[[int, float], AbstractContextManager[Runner]] = lambda n_parts, task_bytes: (
        nullcontext(in_turn)
    ),
    is_over: Callable[[], bool] = lambda: False,
    watch: Callable[[Round, list[IterationRecord]], None] = lambda now, history: None,
    check: Callable[[Mesh], None] = lambda initial: None,
) -> Parted:
    """Create a graded mesh of an image's box in parts, as `mesh_image` does in one piece.

    Parameters
    ----------
    request : PartsRequest
    folder : Path
        The work directory. It keeps all results, so that the same request resumes after any
        interruption, unless it is rejected before the first part begins.
    known : Statistics, optional
        Statistics of the image, if a pass over it has computed them.
    volume : VolumeFile or Image, optional
        The image, unless `tetopt.parts.work.save_volume` has recorded the location of its voxels in
        the folder.
    crew : callable
        Takes the number of parts and the bytes of the largest; returns a context manager that gives
        a function to run them.
    is_over : callable
        Called after each part. Once it returns True, the result is the mesh of the last complete
        round.
    watch : callable
        Called after each part.
    check : callable
        Called with the initial mesh before the first part; may raise InputError.

    Returns
    -------
    Parted
        Identical to the last bit, whatever runs the parts.

    Raises
    ------
    InputError
        For the reasons of `octree_mesh`; the folder belongs to another request or another run;
        errors of `crew` and the parts; the run ends before the initial mesh is measured.
    """
    with locked(folder), gone_if_refused(folder) as keep:
        state = load_state(folder, request.checksum)
        # an earlier run without a state may have recorded another image
        if state is None and volume is not None:
            save_volume(folder, volume)
        image = open_volume(folder)
        state = state or _begun(request, folder, image, known)
        run = _Run(
            request, folder, image, time.perf_counter() - state.known["seconds"], is_over, watch
        )
        check(_initial(run, state))
        counts = _counts(run, state)
        largest = max(part_bytes(*sizes) for sizes in _part_sizes(run, state, counts))
        with crew(int(np.prod(counts)), largest) as runner:
            keep()
            ended = "iterations"
            # Checked before each round, also in a resumed run, which may have converged already.
            while not _is_converged(request, state) and state.n_rounds <= _n_rounds(request):
                after = _round(run, state, counts, runner)
                if after is None:
                    ended = "stopped"
                    break
                state = after
            if _is_converged(request, state):
                ended = "converged"
            return _finished(run, state, counts, in_turn if ended == "stopped" else runner, ended)


class _Run(NamedTuple):
    request: PartsRequest
    folder: Path
    image: Image
    begin: float
    is_over: Callable[[], bool]
    watch: Callable[[Round, list[IterationRecord]], None]


def _n_rounds(request: PartsRequest) -> int:
    """Return the number of rounds that improve the mesh."""
    return ceil(request.iterations / ROUND_SWEEPS)


def _begun(
    request: PartsRequest, folder: Path, image: Image, known: Statistics | None
) -> WorkState:
    """Create the state before the first round: the octree on the grid of ticks."""
    begin = time.perf_counter()
    of_image = statistics(image) if known is None else known
    mesh = octree_mesh(Content(image, statistics=of_image), request.nodes, request.sizes)
    bits = grid_bits(image, mesh.points)
    ticks = np.rint(image.to_index(mesh.points) * 2.0**bits).astype(np.int64)
    sizes = (Sizes() if request.sizes is None else request.sizes).prepared(3)
    settings = PartSettings(
        request.k_D,
        request.shape_power,
        request.min_dihedral,
        request.tolerance,
        _n_rounds(request) * ROUND_SWEEPS,
        int(EXCHANGING_FRACTION * request.iterations) if request.k_D > 0.0 else 0,
        sizes.smallest,
        sizes.longest_edge(image, request.nodes),
        sizes.gradation,
        image.shape,
        bits,
        of_image.noise,
    )
    noted = {"settings": settings._asdict(), "history": [], "seconds": time.perf_counter() - begin}
    state = WorkState(request.checksum, 0, noted)
    arrays = {"ticks": ticks, "cells": mesh.cells}
    save_arrays(folder / INITIAL_NAME, arrays, {})
    save_state(folder, state, arrays)
    return state


def _settings(state: WorkState) -> PartSettings:
    return PartSettings(**state.known["settings"])


def _history(state: WorkState) -> list[IterationRecord]:
    return [IterationRecord(*row) for row in state.known["history"]]


def _cut(run: _Run, state: WorkState, counts: tuple[int, ...], shift: float) -> list[Piece]:
    """Cut the current mesh into parts."""
    mesh = load_arrays(run.folder / STATE_NAME)[0]
    index = mesh["ticks"] * 2.0 ** -_settings(state).bits
    part = cut(index[mesh["cells"]].mean(axis=1), _weights(index, mesh["cells"]), counts, shift)
    return pieces(Shared(mesh["ticks"], mesh["cells"], part))


def _initial(run: _Run, state: WorkState) -> Mesh:
    arrays = load_arrays(run.folder / INITIAL_NAME)[0]
    return Mesh(
        run.image.to_world(arrays["ticks"] * 2.0 ** -_settings(state).bits), arrays["cells"]
    )


def _weights(index: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the weight of each cell as a fraction of a part's capacity, by cells and by voxels."""
    return 1.0 / MOST_CELLS + np.abs(volumes(index, cells)) / MOST_VOXELS


def _counts(run: _Run, state: WorkState) -> tuple[int, ...]:
    """Return the slabs along each axis that keep every part within its capacity, on any machine."""
    mesh = load_arrays(run.folder / INITIAL_NAME)[0]
    index = mesh["ticks"] * 2.0 ** -_settings(state).bits
    fewest = ceil(_weights(index, mesh["cells"]).sum())
    return counts_of(max(run.request.n_parts, fewest), tuple(run.image.spacing * run.image.shape))


def _part_sizes(run: _Run, state: WorkState, counts: tuple[int, ...]) -> Iterator[tuple[int, int]]:
    """Yield the voxels in the box and the cells of each part of the current mesh."""
    for piece in _cut(run, state, counts, ROUND_SHIFTS[0]):
        start, stop = box_of_ticks(piece.ticks, _settings(state))
        n_voxels = int(np.prod(np.subtract(stop, start)))
        yield int(BOX_EXCESS * n_voxels), len(piece.cells)


def _round(
    run: _Run, state: WorkState, counts: tuple[int, ...], runner: Runner
) -> WorkState | None:
    """Run one round; None if it was interrupted."""
    number = state.n_rounds
    kind: Kind = "measure" if number == 0 else "improve"
    parts = _cut(run, state, counts, ROUND_SHIFTS[max(number - 1, 0) % len(ROUND_SHIFTS)])
    paths = _prepared(run, state, parts, kind)
    now = Round(number, _n_rounds(run.request) + 2, kind, len(parts), 0)
    if not _is_run(run, state, now, parts, paths, runner):
        return None
    arrays, numbers = zip(*(load_arrays(done_path(path)) for path in paths), strict=True)
    mesh = joined([each["ticks"] for each in arrays], [each["cells"] for each in arrays])
    return _completed(run, state, mesh, [Numbers(**each) for each in numbers])


def _completed(run: _Run, state: WorkState, mesh: Shared, numbers: list[Numbers]) -> WorkState:
    """Save the state after a round and return it."""
    number, settings, history = state.n_rounds, _settings(state), _history(state)
    E_G, squares = sum(each.E_G for each in numbers), sum(each.squares for each in numbers)
    E_D = sum(each.E_D for each in numbers)
    if number == 0:
        settings = settings._replace(E_G=E_G, squares=squares)
        E = 1.0 if squares > 0.0 else 1.0 - settings.k_D
    else:
        E = sum(each.E for each in numbers)
    n_nodes = sum(each.n_nodes for each in numbers)
    movement = np.sqrt(sum(each.n_nodes * each.movement**2 for each in numbers) / n_nodes)
    seconds, n_voxels = time.perf_counter() - run.begin, sum(each.n_voxels for each in numbers)
    history.append(
        IterationRecord(
            number * ROUND_SWEEPS,
            float(E),
            float(E_G),
            float(E_D),
            float(movement),
            number > 0,
            len(mesh.cells),
            n_voxels,
            seconds,
        )
    )
    known = state.known | {
        "settings": settings._asdict(),
        "history": [list(row) for row in history],
    }
    after = WorkState(state.request, number + 1, known | {"seconds": seconds})
    save_state(run.folder, after, {"ticks": mesh.ticks, "cells": mesh.cells})
    return after


def _prepared(run: _Run, state: WorkState, parts: list[Piece], kind: Kind) -> list[Path]:
    """Write the input files of the parts and return their paths, in order."""
    number = state.n_rounds
    # Workers may still write parts of an interrupted round.
    folder = round_folder(run.folder, number + (kind == "fields"))
    folder.mkdir(exist_ok=True)
    n_nodes = 1 + max(int(piece.nodes[-1]) for piece in parts)
    first = (number - 1) * ROUND_SWEEPS + 1
    iterations = (first, first + ROUND_SWEEPS - 1) if kind == "improve" else (1, 0)
    paths = [folder / f"part-{at}.npz" for at in range(len(parts))]
    for path, piece in zip(paths, parts, strict=True):
        nodes = (
            round(len(piece.ticks) * run.request.nodes / n_nodes)
            if kind == "improve"
            else len(piece.ticks)
        )
        text = {
            "kind": kind,
            "settings": _settings(state)._asdict(),
            "iterations": iterations,
            "nodes": nodes,
        }
        save_arrays(path, {"ticks": piece.ticks, "cells": piece.cells}, text)
    return paths


def _is_run(
    run: _Run, state: WorkState, now: Round, parts: list[Piece], paths: list[Path], runner: Runner
) -> bool:
    """Run the parts; return False if they were interrupted before all were done."""
    # The largest first, as it takes longest.
    order = sorted(range(len(parts)), key=lambda at: (-len(parts[at].cells), at))
    run.watch(now, _history(state))
    n_done = 0
    for n_done, _ in enumerate(runner([str(paths[at]) for at in order]), 1):
        run.watch(now._replace(done=n_done), _history(state))
        if n_done < len(parts) and run.is_over():
            break
    # Count parts and not files, which may come from an earlier run that was stopped here and
    # computed its fields.
    return n_done == len(parts)


def _is_converged(request: PartsRequest, state: WorkState) -> bool:
    """Return whether E has decreased too little in the last round, once exchanges are over."""
    history, settings = _history(state), _settings(state)
    if len(history) < 2 or history[-2].iteration < settings.n_early or history[-2].E <= 0.0:
        return False
    return 1.0 - history[-1].E / history[-2].E < request.tolerance * ROUND_SWEEPS


def _finished(
    run: _Run, state: WorkState, counts: tuple[int, ...], runner: Runner, ended: str
) -> Parted:
    """Return the result of the complete rounds, with cells in the order of the parts that
    computed their fields.
    """
    history = _history(state)
    if not history:
        raise InputError(
            f"{run.folder}: ended before the first round was complete; run this again to resume"
        )
    parts = _cut(run, state, counts, ROUND_SHIFTS[0])
    whole = run._replace(is_over=lambda: False)
    paths = _prepared(run, state, parts, "fields")
    now = Round(state.n_rounds, _n_rounds(run.request) + 2, "fields", len(parts), 0)
    if not _is_run(whole, state, now, parts, paths, runner):  # interrupted, too
        _is_run(whole, state, now, parts, paths, in_turn)
    done = [load_arrays(done_path(path))[0] for path in paths]
    mesh = joined([piece.ticks for piece in parts], [piece.cells for piece in parts])
    scale = 2.0 ** -_settings(state).bits
    fields = {name: np.concatenate([each[name] for each in done]) for name in done[0]}
    result = MeshingResult(
        Mesh(run.image.to_world(mesh.ticks * scale), mesh.cells),
        history,
        ended,
        initial=_initial(run, state),
        nodes=run.request.nodes,
        seconds_run=time.perf_counter() - run.begin,
    )
    result = checked_in_box(result, run.image, run.request.min_dihedral)
    return Parted(result, fields, mesh.part)
