"""Benchmark tetopt on this machine, in whole processes and next to other meshers; prints a table,
writes JSON.

    python scripts/benchmark.py -o bench.json [IMAGE]

IMAGE defaults to the MNI152 T1 from nilearn. Compare ratios within one run: absolute times depend
on the machine and its load. For single kernels, see `benchmarks/benchmark_kernels.py`.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from paper.tissue import mni_tissue

import tetopt
from tetopt.io.mni import mni_path
from tetopt.report.summary import versions
from tetopt.start.label_sizes import parse_label_sizes
from tetopt.system.files import check_output, save_json

HEAD_NODES = 130_000
# by tissue and thickness
HEAD_SIZES = "1=0.7t[1:4],2=0.9t[1.5:6],3=1t[1.2:6],4=1.3t[1.5:7],*=1t[2:10]"

# pytetwild as `tetopt compare` runs it: on an image's labels, for a number of nodes
WILD = """
import sys, tetopt
from tetopt.study.pipelines import PipelineInput, pytetwild
image, labels = map(tetopt.load_image, sys.argv[1:3])
pytetwild(PipelineInput(image, labels, int(sys.argv[3])))
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmarks, print a table and write a JSON file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("image", type=Path, nargs="?", help="volume to measure on")
    parser.add_argument("-o", "--output", type=Path, required=True, help="JSON file")
    parser.add_argument("--cgal", help="program that meshes labels with CGAL's Mesh_3, see `peers`")
    parser.add_argument("--cgal-sized", help="the same with a sizing field, see `head`")
    parser.add_argument("--head", type=Path, help="labels of a whole head, see `head`")
    parser.add_argument(
        "--quick", action="store_true", help="small meshes, to test the script itself"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    options = parser.parse_args(argv)
    try:
        output = check_output(options.output, (".json",), options.force)
        path = mni_path("t1") if options.image is None else options.image
        tetopt.load_image(path)
    except tetopt.InputError as error:
        print(f"benchmark: {error}", file=sys.stderr)
        return 2
    rows: dict[str, Any] = {"image": path.name, "cores": os.cpu_count(), "versions": versions()}
    rows["first_calls"] = first_calls(300)
    counts = (400,) if options.quick else (5_000, 15_000)
    rows["peers"] = [
        peers(path, nodes, options.cgal, 1 if options.quick else 3) for nodes in counts
    ]
    rows["labelled"] = labelled(path, counts[-1])
    rows["masked_start"] = masked_start(path, 2_000 if options.quick else 500_000)
    rows["stopped"] = stopped(5.0)
    if options.head is not None:
        rows["head"] = head(
            options.head, 2_000 if options.quick else HEAD_NODES, options.cgal_sized
        )
    sizes = (400,) if options.quick else (5_000, 15_000, 40_000)
    rows["graded"] = [graded(path, nodes) for nodes in sizes]
    rows["graded_large"] = graded(path, 400 if options.quick else 176_000, edge=256)
    save_json(output, rows)
    show(rows)
    print(f"\nall numbers in {output}")
    return 0


def first_calls(nodes: int) -> dict[str, dict[str, float]]:
    """Time the first `tetopt mesh` of each kind with an empty kernel cache, less the second: wall
    and CPU seconds.

    The image is a ball in 24^3 voxels; `again` is the wall time of the second process.
    """
    radius = np.sqrt(((np.indices((24, 24, 24)) - 11.5) ** 2).sum(axis=0))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tetopt.save_image(
            folder / "ball.nii.gz", tetopt.Image(np.rint(100.0 * np.exp(-((radius / 8.0) ** 2))))
        )
        tetopt.save_image(folder / "mask.nii.gz", tetopt.Image((radius < 10.0).astype(float)))
        tetopt.save_image(
            folder / "labels.nii.gz", tetopt.Image((radius < 9.0) + 1.0 * (radius < 5.0))
        )
        kinds = {
            "default": [],
            "uniform": ["--uniform"],
            "mask": ["--mask", str(folder / "mask.nii.gz")],
            "labels": ["--labels", str(folder / "labels.nii.gz")],
            "paper": ["--method", "paper"],
        }
        rows = {}
        for kind, words in kinds.items():
            output = [
                "-o",
                str(folder / "out.vtu"),
                "--force",
                "--nodes",
                str(nodes),
                "--iterations",
                "4",
            ]
            command = [
                sys.executable,
                "-m",
                "tetopt",
                "mesh",
                str(folder / "ball.nii.gz"),
                *output,
                *words,
            ]
            environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / kind)}
            first, again = (process_seconds(command, environment) for _ in range(2))
            rows[kind] = {
                "wall": first[0] - again[0],
                "cpu": first[1] - again[1],
                "again": again[0],
            }
    return rows


def process_seconds(
    command: Sequence[str], environment: dict[str, str] | None = None, allowed: Sequence[int] = (0,)
) -> tuple[float, float]:
    """Return the wall and CPU seconds of a process and its children; its exit code must be one
    of those allowed.
    """
    before, begin = os.times(), time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True)
    if done.returncode not in allowed:
        done.check_returncode()
    wall, after = time.perf_counter() - begin, os.times()
    cpu = (
        after.children_user + after.children_system - before.children_user - before.children_system
    )
    return wall, cpu


def peers(path: Path, nodes: int, cgal: str | None, turns: int) -> dict[str, Any]:
    """Time tetopt, pytetwild (once) and CGAL in turns, at about equal numbers of nodes: minimum
    over whole processes.

    The others mesh the tissue labels of the MNI152 T1, or two classes of another image. CGAL is a
    program `cgal LABELS.raw nx ny nz sx sy sz OUT.bin SIZE` that prints JSON with `nodes`; SIZE is
    chosen to give about the same number of nodes.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        labels = _tissues(path)
        tetopt.save_image(folder / "labels.nii.gz", labels)
        ours = [
            sys.executable,
            "-m",
            "tetopt",
            "mesh",
            str(path),
            "-o",
            str(folder / "ours.vtu"),
            "--force",
        ]
        commands = {"tetopt": [*ours, "--nodes", str(nodes)]}
        rows: dict[str, Any] = {"nodes": nodes}
        if importlib.util.find_spec("pytetwild") is None:
            rows["pytetwild"] = "not installed"
        else:
            inputs = [str(path), str(folder / "labels.nii.gz"), str(nodes)]
            commands["pytetwild"] = [sys.executable, "-c", WILD, *inputs]
        if cgal is None:
            rows["cgal"] = "no program given (--cgal)"
        else:
            commands["cgal"], rows["cgal_nodes"] = cgal_command(cgal, labels, nodes, folder)
        seconds: dict[str, list[tuple[float, float]]] = {}
        for turn in range(turns):
            for name, command in commands.items():
                if turn > 0 and name == "pytetwild":
                    continue  # once is enough: it takes ten times as long
                seconds.setdefault(name, []).append(process_seconds(command))
        for name, times in seconds.items():
            wall, cpu = (min(column) for column in zip(*times, strict=True))
            rows[name] = {"wall": wall, "cpu": cpu}
        for name in ("pytetwild", "cgal"):
            if name in seconds:
                rows[f"over_{name}"] = rows["tetopt"]["wall"] / rows[name]["wall"]
    return rows


def cgal_command(
    program: str, labels: tetopt.Image, nodes: int, folder: Path
) -> tuple[list[str], int]:
    """Return `_sized` for the program with one cell size."""
    # CGAL skips label 0, so all labels are raised by one. Padding by a voxel keeps the outer labels
    # whole.
    raised = np.pad(labels.data.astype(np.uint8) + np.uint8(1), 1, mode="edge")
    grid = written_labels(folder / "labels.raw", raised, labels)

    def command(size: float) -> list[str]:
        return [program, str(folder / "labels.raw"), *grid, str(folder / "mesh.bin"), str(size)]

    return _sized(command, 1.8 * (labels.volume / nodes) ** (1 / 3), nodes)


def written_labels(path: Path, padded: NDArray, image: tetopt.Image) -> list[str]:
    """Write voxels in the order that CGAL's programs read; return the arguments that describe
    their grid.
    """
    padded.transpose(2, 1, 0).tofile(path)
    return [*map(str, padded.shape), *map(str, image.spacing)]


def _sized(command: Callable[[float], list[str]], size: float, nodes: int) -> tuple[list[str], int]:
    """Return the command whose size gives about `nodes` nodes, and their number; searches in at
    most six runs.
    """
    for _ in range(6):
        words = command(size)
        done = subprocess.run(words, check=True, capture_output=True, text=True)
        n_nodes = int(json.loads(done.stdout)["nodes"])
        if abs(n_nodes / nodes - 1.0) < 0.03:
            break
        size *= (n_nodes / nodes) ** (1 / 2.2)
    return words, n_nodes


def labelled(path: Path, nodes: int) -> dict[str, Any]:
    """Time the whole process with tissues as labels and background removed, and without, in
    turns: minimum of two.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tetopt.save_image(folder / "labels.nii.gz", _tissues(path))
        plain = [
            sys.executable,
            "-m",
            "tetopt",
            "mesh",
            str(path),
            "-o",
            str(folder / "out.vtu"),
            "--force",
        ]
        plain += ["--nodes", str(nodes)]
        named = [*plain, "--labels", str(folder / "labels.nii.gz"), "--background", "0"]
        times = [(process_seconds(plain), process_seconds(named)) for _ in range(2)]
        without, within = (
            tuple(map(min, zip(*each, strict=True))) for each in zip(*times, strict=True)
        )
    return {
        "nodes": nodes,
        "wall": within[0],
        "cpu": within[1],
        "over_plain": within[0] / without[0],
    }


def masked_start(path: Path, nodes: int) -> dict[str, Any]:
    """Measure seconds and memory of the octree within a mask and a sizing field, in its own
    process.
    """
    program = (
        "import json, sys, time, numpy as np, tetopt\n"
        "from tetopt.system.budget import peak_bytes\n"
        "image, mask, nodes = tetopt.load_image(sys.argv[1]), tetopt.load_image(sys.argv[2]), "
        "int(sys.argv[3])\n"
        "from tetopt.start.octree import nearest_octree\n"
        "content = tetopt.content(image, mask=mask)\n"
        "ramp = np.linspace(1.2, 3.6, image.shape[0])[:, None, None] + np.zeros(image.shape)\n"
        "sizes = tetopt.Sizes(field=tetopt.Image(ramp, image.affine))\n"
        "begin, cpu = time.perf_counter(), time.process_time()\n"
        "mesh = nearest_octree(content, nodes, sizes)\n"
        "print(json.dumps({'nodes': len(mesh.points), 'wall': time.perf_counter() - begin,\n"
        "    'cpu': time.process_time() - cpu,\n"
        "    'peak_gb': peak_bytes() / 1e9}))\n"
    )
    with tempfile.TemporaryDirectory() as name:
        mask = Path(name) / "mask.nii.gz"
        tissues = _tissues(path)
        tetopt.save_image(mask, tetopt.Image(1.0 * (tissues.data > 0), tissues.affine))
        return _told_by(program, path, mask, nodes)


def stopped(seconds: float) -> dict[str, float]:
    """Time runs with a time limit: labels in a mask, slabs of 575 voxels, and cells far smaller
    than voxels.
    """
    rows = {}
    for shape, nodes in (((1, 5, 115), 30_000), ((5, 23, 5), 10_000)):
        image = tetopt.Image(np.random.default_rng(0).integers(0, 1000, shape).astype(float))
        middle = [(size - 1) / 2 for size in shape]
        radius = sum(
            ((x - c) / max(c, 0.5)) ** 2 for x, c in zip(np.indices(shape), middle, strict=True)
        )
        labels = tetopt.Image((radius < 0.3) + 1.0 * (radius < 1.0))
        content = tetopt.content(image, labels=labels, mask=tetopt.Image(1.0 * (labels.data > 0)))
        tetopt.mesh_image(content, 100, mode="uniform", iterations=2)  # loads the kernels
        begin = time.perf_counter()
        tetopt.mesh_image(content, nodes, mode="uniform", min_dihedral=40.0, max_seconds=seconds)
        rows[" x ".join(map(str, shape))] = time.perf_counter() - begin
    return {"asked": seconds, **rows}


def head(path: Path, nodes: int, cgal: str | None) -> dict[str, Any]:
    """Time a head of five tissues within its mask, and then CGAL.

    CGAL is a program `cgal LABELS.raw SIZES.raw nx ny nz sx sy sz OUT.bin 1` that perturbs and
    exudes, and prints JSON with `nodes`; its sizes are tetopt's target sizes by tissue and
    thickness, times a factor that gives about the same number of nodes.
    """
    image = tetopt.load_image(path)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # A mesh that violates a requirement (exit code 1) is timed like any other; the row names
        # the requirement.
        wall, cpu = process_seconds(head_command(path, folder, nodes), allowed=(0, 1))
        run = json.loads((folder / "run.json").read_text())
        rows = {"nodes": nodes, "cells": run["quality"]["n_cells"], "wall": wall, "cpu": cpu}
        rows |= {
            "peak_gb": run["memory"]["peak_bytes"] / 1e9,
            "violated": [*run["violated"]],
            "run": run,
        }
        if cgal is not None:
            command, rows["cgal_nodes"] = sized_head(cgal, image, nodes, folder)
            rows["cgal"] = dict(zip(("wall", "cpu"), process_seconds(command), strict=True))
            rows["over_cgal"] = {
                clock: rows[clock] / rows["cgal"][clock] for clock in ("wall", "cpu")
            }
    return rows


def head_command(path: Path, folder: Path, nodes: int) -> list[str]:
    """Return the command for a head's mesh out.vtu and its run.json, by tissue and thickness."""
    command = [
        sys.executable,
        "-m",
        "tetopt",
        "mesh",
        str(path),
        "-o",
        str(folder / "out.vtu"),
        "--labels",
        str(path),
    ]
    command += [
        "--background",
        "0",
        "--size-min",
        "1",
        "--nodes",
        str(nodes),
        "--label-size",
        HEAD_SIZES,
    ]
    return [*command, "--json", str(folder / "run.json"), "--force"]


def sized_head(cgal: str, image: tetopt.Image, nodes: int, folder: Path) -> tuple[list[str], int]:
    """Return `_sized` for the program with a head's target sizes, which it scales."""
    asked = tetopt.Sizes(smallest=1.0, by_label=parse_label_sizes(HEAD_SIZES))
    field = tetopt.sizes_by_label(asked, tetopt.content(image, image)).sizes.on_voxels(image)
    grid = written_labels(folder / "labels.raw", np.pad(image.data.astype(np.uint8), 1), image)

    def sized(factor: float) -> list[str]:
        written_labels(
            folder / "sizes.raw", np.pad(factor * field, 1, mode="edge").astype(np.float32), image
        )
        raw = str(folder / "labels.raw"), str(folder / "sizes.raw")
        return [cgal, *raw, *grid, str(folder / "mesh.bin"), "1"]

    return _sized(sized, 1.0, nodes)


def _tissues(path: Path) -> tetopt.Image:
    """Return the tissue labels of the MNI152 T1, or two classes of another image."""
    if path.name == mni_path("t1").name:
        return mni_tissue()
    image = tetopt.load_image(path)
    return tetopt.Image(1.0 * (image.data > image.data.mean()), image.affine)


def graded(path: Path, nodes: int, edge: int = 0) -> dict[str, Any]:
    """Measure the second `tetopt.mesh_image` of a new process, with defaults: time, shape,
    fidelity, memory.

    The image is the whole volume, or `edge`^3 voxels of it, zero-padded and cropped.
    """
    program = (
        "import json, sys, time, numpy as np, tetopt\n"
        "from tetopt.system.budget import peak_bytes\n"
        "image, nodes, edge = tetopt.load_image(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])\n"
        "if edge:\n"
        "    data = np.pad(image.data, [(0, max(edge - s, 0)) for s in image.shape])[:edge, "
        ":edge, :edge]\n"
        "    image = tetopt.Image(data, image.affine)\n"
        # loads the kernels
        "tetopt.mesh_image(tetopt.load_phantom('sphere').image(voxel_mm=4), 300)\n"
        "begin = time.perf_counter()\n"
        "mesh = tetopt.mesh_image(image, nodes).mesh\n"
        "seconds = time.perf_counter() - begin\n"
        "shape = tetopt.quality(mesh.points, mesh.cells)\n"
        "variance = float(np.var(image.data, dtype=np.float64)) * image.volume\n"
        "print(json.dumps({'nodes': shape.n_nodes, 'cells': shape.n_cells, 'seconds': seconds,\n"
        "    'mean_rho': shape.mean_rho, 'min_dihedral': shape.min_dihedral,\n"
        "    'E_D_fraction': tetopt.E_D(image, mesh) / variance,\n"
        "    'peak_gb': peak_bytes() / 1e9}))\n"
    )
    return _told_by(program, path, nodes, edge)


def _told_by(program: str, *words: object) -> dict[str, Any]:
    """Run a program in its own process; return the JSON in the last line that it prints."""
    command = [sys.executable, "-c", program, *map(str, words)]
    return json.loads(
        subprocess.run(command, check=True, capture_output=True).stdout.splitlines()[-1]
    )


def show(rows: dict[str, Any]) -> None:
    """Print the results as a table."""
    print(f"{rows['image']}, {rows['cores']} cores")
    for kind, seconds in rows["first_calls"].items():
        print(
            f"  first call, {kind:22s}{seconds['wall']:10.1f} s of compiling "
            f"({seconds['cpu']:.0f} of CPU); whole "
            f"process with the kernels in the cache {seconds['again']:.1f} s"
        )
    for peer in rows["peers"]:
        for name, row in peer.items():
            words = (
                f"{row['wall']:.1f} s, {row['cpu']:.1f} of CPU" if isinstance(row, dict) else row
            )
            print(f"  peers, whole process: {name} {words}")
    for name in ("labelled", "masked_start", "stopped", "head"):
        row = rows.get(name, {"": "no labels given (--head)"})
        print(f"  {name}: {json.dumps({key: value for key, value in row.items() if key != 'run'})}")
    for row in [*rows["graded"], rows["graded_large"]]:
        print(
            f"  mesh_image, {row['nodes']} nodes, {row['cells']} tets: {row['seconds']:.1f} s, "
            "peak "
            f"{row['peak_gb']:.2f} GB; E_D {row['E_D_fraction']:.6f} of the image's variance, "
            "mean rho "
            f"{row['mean_rho']:.4f}, smallest angle {row['min_dihedral']:.1f}"
        )


if __name__ == "__main__":
    sys.exit(main())
