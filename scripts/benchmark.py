"""How fast tetopt is on this machine, in whole processes and beside other meshers; a table and a JSON file.

    python scripts/benchmark.py -o bench.json [IMAGE]

IMAGE is the MNI152 T1 that nilearn carries unless another is named. Compare ratios within one run: absolute times
depend on the machine and on what else it does. Kernels by themselves: `tests/benchmarks/benchmark_kernels.py`.
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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import tetopt
from tetopt.io.mni import mni_path, mni_tissue
from tetopt.report.summary import versions
from tetopt.system.files import checked_output, save_json


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("image", type=Path, nargs="?", help="volume to measure on")
    parser.add_argument("-o", "--output", type=Path, required=True, help="JSON file")
    parser.add_argument("--cgal", help="a program that meshes labels by CGAL's Mesh_3, see `peers`")
    parser.add_argument("--quick", action="store_true", help="small meshes, to try the script itself")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    options = parser.parse_args(argv)
    try:
        output = checked_output(options.output, (".json",), options.force)
        path = mni_path("t1") if options.image is None else options.image
        tetopt.load_image(path)
    except tetopt.InputError as error:
        print(f"benchmark: {error}", file=sys.stderr)
        return 2
    rows: dict[str, Any] = {"image": path.name, "cores": os.cpu_count(), "versions": versions()}
    rows["first_calls"] = first_calls(300)
    rows["peers"] = peers(path, 400 if options.quick else 15_000, options.cgal, 1 if options.quick else 3)
    sizes = (400,) if options.quick else (5_000, 15_000, 40_000)
    rows["graded"] = [graded(path, nodes) for nodes in sizes]
    rows["graded_large"] = graded(path, 400 if options.quick else 176_000, edge=256)
    save_json(output, rows)
    show(rows)
    print(f"\nall numbers in {output}")
    return 0


def first_calls(nodes: int) -> dict[str, dict[str, float]]:
    """Wall and CPU seconds of the first `tetopt mesh` of each kind with an empty cache of kernels, less the second's.

    Of a ball in 24^3 voxels; `again` is the second's wall time, of a whole process.
    """
    radius = np.sqrt(((np.indices((24, 24, 24)) - 11.5) ** 2).sum(axis=0))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tetopt.save_image(folder / "ball.nii.gz", tetopt.Image(np.rint(100.0 * np.exp(-((radius / 8.0) ** 2)))))
        tetopt.save_image(folder / "mask.nii.gz", tetopt.Image((radius < 10.0).astype(float)))
        tetopt.save_image(folder / "labels.nii.gz", tetopt.Image((radius < 9.0) + 1.0 * (radius < 5.0)))
        kinds = {
            "default": [],
            "uniform": ["--uniform"],
            "mask": ["--mask", str(folder / "mask.nii.gz")],
            "labels": ["--labels", str(folder / "labels.nii.gz")],
            "paper": ["--method", "paper"],
        }
        rows = {}
        for kind, words in kinds.items():
            output = ["-o", str(folder / "out.vtu"), "--force", "--nodes", str(nodes), "--iterations", "4"]
            command = [sys.executable, "-m", "tetopt", "mesh", str(folder / "ball.nii.gz"), *output, *words]
            environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / kind)}
            first, again = (process_seconds(command, environment) for _ in range(2))
            rows[kind] = {"wall": first[0] - again[0], "cpu": first[1] - again[1], "again": again[0]}
    return rows


def process_seconds(command: Sequence[str], environment: dict[str, str] | None = None) -> tuple[float, float]:
    """Wall and CPU seconds of a process and of those that it starts."""
    before, begin = os.times(), time.perf_counter()
    subprocess.run(command, env=environment, check=True, capture_output=True)
    wall, after = time.perf_counter() - begin, os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return wall, cpu


def peers(path: Path, nodes: int, cgal: str | None, turns: int) -> dict[str, Any]:
    """Whole processes in turns at about equal numbers of nodes, the least seconds of each: tetopt, pytetwild, CGAL.

    The others mesh the tissue labels that come with the MNI152 T1, or two classes of another image. CGAL is a program
    `cgal LABELS.raw nx ny nz sx sy sz OUT.bin SIZE` that prints JSON with `nodes`, run alone at the size that gives
    about as many nodes.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        image = tetopt.load_image(path)
        two_classes = tetopt.Image(1.0 * (image.data > image.data.mean()), image.affine)
        labels = mni_tissue() if path.name == mni_path("t1").name else two_classes
        tetopt.save_image(folder / "labels.nii.gz", labels)
        ours = [sys.executable, "-m", "tetopt", "mesh", str(path), "-o", str(folder / "ours.vtu"), "--force"]
        commands = {"tetopt": [*ours, "--nodes", str(nodes)]}
        rows: dict[str, Any] = {}
        if importlib.util.find_spec("pytetwild") is None:
            rows["pytetwild"] = "not installed"
        else:
            base = [sys.executable, "-m", "tetopt", "baseline", str(path), "-o", str(folder / "wild.vtu"), "--force"]
            commands["pytetwild"] = [*base, "--nodes", str(nodes), "--labels", str(folder / "labels.nii.gz")]
        if cgal is None:
            rows["cgal"] = "no program named (--cgal)"
        else:
            commands["cgal"], rows["cgal_nodes"] = _cgal_command(cgal, labels, nodes, folder)
        seconds: dict[str, list[tuple[float, float]]] = {}
        for _ in range(turns):
            for name, command in commands.items():
                seconds.setdefault(name, []).append(process_seconds(command))
        for name, times in seconds.items():
            wall, cpu = (min(column) for column in zip(*times, strict=True))
            rows[name] = {"wall": wall, "cpu": cpu}
        for name in ("pytetwild", "cgal"):
            if name in seconds:
                rows[f"over_{name}"] = rows["tetopt"]["wall"] / rows[name]["wall"]
    return rows


def _cgal_command(program: str, labels: tetopt.Image, nodes: int, folder: Path) -> tuple[list[str], int]:
    """The command of the size that gives about so many nodes, and how many those are; at most six runs to find it."""
    # Label 0 is left out by CGAL: all are raised by one. Padded by a voxel, so that the outer ones are meshed whole.
    raised = np.pad(labels.data.astype(np.uint8) + np.uint8(1), 1, mode="edge")
    raised.transpose(2, 1, 0).tofile(folder / "labels.raw")
    spacing = np.sqrt((labels.affine[:3, :3] ** 2).sum(axis=0))
    size = 1.8 * (labels.volume / nodes) ** (1 / 3)
    for _ in range(6):
        numbers = [*map(str, raised.shape), *map(str, spacing)]
        command = [program, str(folder / "labels.raw"), *numbers, str(folder / "mesh.bin"), str(size)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        n_nodes = int(json.loads(done.stdout)["nodes"])
        if abs(n_nodes / nodes - 1.0) < 0.03:
            break
        size *= (n_nodes / nodes) ** (1 / 2.2)
    return command, n_nodes


def graded(path: Path, nodes: int, edge: int = 0) -> dict[str, Any]:
    """`tetopt.mesh_image` with its defaults, the second time in a process of its own: time, shape, fidelity, memory.

    Of the volume as it is, or of `edge`^3 voxels, padded by zeros and cut.
    """
    program = (
        "import json, resource, sys, time, numpy as np, tetopt\n"
        "image, nodes, edge = tetopt.load_image(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])\n"
        "if edge:\n"
        "    data = np.pad(image.data, [(0, max(edge - s, 0)) for s in image.shape])[:edge, :edge, :edge]\n"
        "    image = tetopt.Image(data, image.affine)\n"
        "tetopt.mesh_image(tetopt.load_phantom('sphere').image(voxel_mm=4), 300)\n"  # loads the kernels
        "begin = time.perf_counter()\n"
        "mesh = tetopt.mesh_image(image, nodes).mesh\n"
        "seconds = time.perf_counter() - begin\n"
        "shape = tetopt.quality(mesh.points, mesh.cells)\n"
        "variance = float(np.var(image.data, dtype=np.float64)) * image.volume\n"
        "print(json.dumps({'nodes': shape.n_nodes, 'cells': shape.n_cells, 'seconds': seconds,\n"
        "    'mean_rho': shape.mean_rho, 'min_dihedral': shape.min_dihedral,\n"
        "    'E_D_fraction': tetopt.E_D(image, mesh) / variance,\n"
        "    'peak_gb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6}))\n"
    )
    command = [sys.executable, "-c", program, str(path), str(nodes), str(edge)]
    done = subprocess.run(command, check=True, capture_output=True)
    return json.loads(done.stdout.splitlines()[-1])


def show(rows: dict[str, Any]) -> None:
    """Print the table."""
    print(f"{rows['image']}, {rows['cores']} cores")
    for kind, seconds in rows["first_calls"].items():
        print(
            f"  first call, {kind:22s}{seconds['wall']:10.1f} s of compiling ({seconds['cpu']:.0f} of CPU); whole "
            f"process with the kernels in the cache {seconds['again']:.1f} s"
        )
    for name, row in rows["peers"].items():
        words = f"{row['wall']:.1f} s, {row['cpu']:.1f} of CPU" if isinstance(row, dict) else row
        print(f"  peers, whole process: {name} {words}")
    for row in [*rows["graded"], rows["graded_large"]]:
        print(
            f"  mesh_image, {row['nodes']} nodes, {row['cells']} tets: {row['seconds']:.1f} s, peak "
            f"{row['peak_gb']:.2f} GB; E_D {row['E_D_fraction']:.6f} of the image's variance, mean rho "
            f"{row['mean_rho']:.4f}, angles from {row['min_dihedral']:.1f}"
        )


if __name__ == "__main__":
    sys.exit(main())
