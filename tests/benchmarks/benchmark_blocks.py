"""What a volume by blocks and a mesh by parts take: time of each stage, memory of each process; a
table and a file.

    python tests/benchmarks/benchmark_blocks.py 1024 --folder /scratch -o bench_blocks.json

Of EDGE^3 voxels of 16 bits, painted chunk by chunk if the folder has none yet: 400 ellipsoids of
all sizes, whose radii are such that small ones have as much surface as large ones, and noise. Nodes
are in proportion to EDGE^2, as surfaces are, 500,000 for 1024. The largest takes 1.3 GB of disk and
three quarters of an hour, 256 a minute.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tetopt import Image, InputError, load_phantom
from tetopt.engine.loop import IterationRecord
from tetopt.io.zarr_images import save_zarr
from tetopt.parts.part import work_on
from tetopt.parts.rounds import PartsRequest, Round, Runner, mesh_in_parts
from tetopt.parts.work import VolumeFile, save_volume
from tetopt.system.budget import peak_bytes
from tetopt.system.files import checked_output, save_json
from tetopt.workers import Share, run_tasks, workers

BOX_MM = 204.8
N_BALLS = 400
BALL_RADII = 1.5, 45.0  # mm: 8 to 225 voxels of 0.2 mm
NODES_OF_1024 = 500_000
NOISE_SD = 30.0  # of intensities from 0 to 1000


def main(argv: Sequence[str] | None = None) -> int:
    """Paint, measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("edge", type=int, help="voxels along each axis")
    parser.add_argument("--nodes", type=int, help="of the mesh")
    parser.add_argument("--parts", type=int, default=1, help="at the least")
    parser.add_argument(
        "--workers", type=int, default=2, help="processes of dask's; 0: this one runs all parts"
    )
    parser.add_argument(
        "--worker-gb", type=float, default=3.0, help="of memory for each worker, enforced"
    )
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path(),
        help="where the volume and the folder of work are made",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="JSON file")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    options = parser.parse_args(argv)
    nodes = options.nodes or round(NODES_OF_1024 * (options.edge / 1024) ** 2)
    try:
        output = checked_output(options.output, (".json",), options.force)
        volume, begin = options.folder / f"balls-{options.edge}.zarr", time.perf_counter()
        if not volume.exists():
            paint(volume, options.edge)
        painted = time.perf_counter() - begin
        measured = measure(volume, nodes, options.parts, options.workers, options.worker_gb * 1e9)
    except InputError as error:
        print(f"benchmark_blocks: {error}", file=sys.stderr)
        return 2
    rows = {
        "edge": options.edge,
        "nodes": nodes,
        "painted_seconds": painted,
        "cores": os.cpu_count(),
        **measured,
    }
    save_json(output, rows)
    show(rows)
    print(f"\nall numbers in {output}")
    return 0


def balls(edge: int) -> str:
    """The phantom's file."""
    random, (least, most) = np.random.default_rng(21), BALL_RADII
    # Of radius r there are in proportion to r^-2.5: number times surface, in steps of a factor, is
    # about the same.
    fraction = random.random(N_BALLS)
    radii = np.sort((least**-1.5 + fraction * (most**-1.5 - least**-1.5)) ** (-1 / 1.5))[::-1]
    text = f"""
name = "balls"
description = "{N_BALLS} ellipsoids of all sizes, the large first"
size_mm = [{BOX_MM}, {BOX_MM}, {BOX_MM}]
voxel_mm = {BOX_MM / edge}
noise_sd = {NOISE_SD}
background = {{ intensity = 200 }}
"""
    for number, radius in enumerate(radii, 1):
        center, axes = (random.random(3) - 0.5) * BOX_MM, radius * random.uniform(0.5, 1.0, 3)
        turn, intensity = random.uniform(0.0, 180.0, 3), random.uniform(0.0, 1000.0)
        text += f"""
[[shape]]
kind = "ellipsoid"
center_mm = {center.round(3).tolist()}
radii_mm = {axes.round(3).tolist()}
rotation_deg = {turn.round(3).tolist()}
intensity = {intensity:.1f}
label = {number}
"""
    return text


def paint(volume: Path, edge: int) -> None:
    """Write the volume, chunk by chunk."""
    table = volume.with_suffix(".toml")
    table.write_text(balls(edge), encoding="utf-8")
    voxels = load_phantom(table).voxels()
    save_zarr(volume, Image.stored(voxels, voxels.affine), voxels, np.int16)


def measure(
    volume: Path, nodes: int, n_parts: int, n_workers: int, worker_bytes: float
) -> dict[str, Any]:
    """A run in parts: its stages in their order, what each worker had at its peak, and the
    records of its rounds.
    """
    folder = volume.with_suffix(".work")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    save_volume(folder, VolumeFile(volume))
    stages: list[dict[str, Any]] = []
    done: list[Done] = []
    predicted = 0.0

    def stage(name: str) -> None:
        """What is begun now, when and with what; what was begun before ends."""
        now = {
            "name": name,
            "at": time.perf_counter(),
            "cpu": time.process_time(),
            "n_tasks": len(done),
        }
        sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
        stages.append({**now, "peak": peak_bytes(), "disk": sum(sizes), "load": os.getloadavg()[0]})

    @contextmanager
    def crew(n_parts: int, task_bytes: float) -> Iterator[Runner]:
        nonlocal predicted
        predicted = task_bytes
        if n_workers == 0:
            yield lambda names: _noted(map(_done, names), done)
            return
        stage("workers begin")
        with workers(Share(n_workers, 1, worker_bytes), None, 1) as pool:
            yield lambda names: _noted(_results(run_tasks(pool, _done, names, str(folder))), done)
            stage("the end")

    def watch(now: Round, history: list[IterationRecord]) -> None:
        if now.done == 0:
            stage(f"{now.kind} {now.number}, {now.n_parts} parts")
        elif now.done == now.n_parts:
            stage("join, cut")

    stage("statistics, octree")
    request = PartsRequest(nodes, n_parts, 0.85, 16, 3.0, 12.0, 5e-4, None, "benchmark")
    parted = mesh_in_parts(request, folder, crew=crew, watch=watch)
    stage("joined and checked")
    result, peaks = parted.result, dict.fromkeys((task.worker for task in done), 0)
    for task in done:
        peaks[task.worker] = max(peaks[task.worker], task.peak_bytes)
    shutil.rmtree(folder)
    tasks = [{**task._asdict(), "result": task.result._asdict()} for task in done]
    return {
        "stages": stages,
        "tasks": tasks,
        "worker_peaks": sorted(peaks.values()),
        "predicted_task_bytes": predicted,
        "client_peak": peak_bytes(),
        "n_nodes": len(result.mesh.points),
        "n_cells": len(result.mesh.cells),
        "violated": list(result.violated),
        "history": [record._asdict() for record in result.history],
    }


class Done(NamedTuple):
    """A part that is done, by which process, and what that had at its peak."""

    name: str
    result: Any
    seconds: float
    worker: int
    peak_bytes: int


def _done(name: str) -> Done:
    begin = time.perf_counter()
    return Done(name, work_on(name), time.perf_counter() - begin, os.getpid(), peak_bytes())


def _results(ended: Iterator[tuple[Any, Any, BaseException | None]]) -> Iterator[Done]:
    for _, result, error in ended:
        if error is not None:
            raise error
        yield result


def _noted(tasks: Iterator[Done], done: list[Done]) -> Iterator[Done]:
    for task in tasks:
        done.append(task)
        yield task


def show(rows: dict[str, Any]) -> None:
    """Print a table of the stages, and the peaks."""
    print(
        f"{rows['edge']}^3 voxels, {rows['n_nodes']} nodes, {rows['n_cells']} cells, "
        f"{rows['cores']} cores"
    )
    print(f"painted in {rows['painted_seconds']:.0f} s (0: it was there)")
    print(
        "| stage | s | CPU s of the client | of tasks, s | client's peak, GB | folder of work, "
        "MB | load |"
    )
    print("|---|---|---|---|---|---|---|")
    stages = rows["stages"]
    for this, after in pairwise(stages):
        tasks = sum(task["seconds"] for task in rows["tasks"][this["n_tasks"] : after["n_tasks"]])
        print(
            f"| {this['name']} | {after['at'] - this['at']:.1f} | "
            f"{after['cpu'] - this['cpu']:.1f} | {tasks:.0f} "
            f"| {after['peak'] / 1e9:.2f} | {after['disk'] / 1e6:.0f} | {after['load']:.1f} |"
        )
    print(
        f"| all | {stages[-1]['at'] - stages[0]['at']:.0f} | "
        f"{stages[-1]['cpu'] - stages[0]['cpu']:.0f} | | | | |"
    )
    words = ", ".join(f"{peak / 1e9:.2f}" for peak in rows["worker_peaks"])
    print(
        f"\npeaks of workers {words} GB; {rows['predicted_task_bytes'] / 1e9:.2f} predicted for "
        "the largest task"
    )


if __name__ == "__main__":
    sys.exit(main())
