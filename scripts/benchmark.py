"""How fast tetopt is on this machine, beside the library call it replaces; a table and a JSON file.

    python scripts/benchmark.py -o bench.json [IMAGE]

IMAGE is the MNI152 T1 that nilearn carries unless another is named. Compare ratios within one run: absolute times
depend on the machine and on what else it does.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
from scipy.spatial import Delaunay

import tetopt
from tetopt.contents.content import plain
from tetopt.energy.sampling import from_ticks, moment_sums, sampling_grid, to_ticks
from tetopt.engine.fast import Run, prepare_kernels
from tetopt.engine.flips import flip
from tetopt.engine.loop import GRADED_K_D
from tetopt.geometry.simplex import dihedral_angles, oriented, rho, volumes
from tetopt.geometry.topology import facets
from tetopt.io.mni import mni_path, mni_tissue
from tetopt.report.summary import versions
from tetopt.start.delaunay import delaunay
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
        image = tetopt.load_image(path)
    except tetopt.InputError as error:
        print(f"benchmark: {error}", file=sys.stderr)
        return 2
    sizes = (300, 600) if options.quick else (5_000, 20_000)
    rows: dict[str, Any] = {
        "image": path.name,
        "cores": os.cpu_count(),
        "threads": numba.get_num_threads(),
        "versions": versions(),
    }
    rows["first_calls"] = first_calls(300)
    rows["peers"] = peers(path, 400 if options.quick else 15_000, options.cgal, 1 if options.quick else 3)
    rows |= sampling(image, 2_000 if options.quick else 37_000)
    rows["sampling_by_size"] = [sampling_by_size(image, n) for n in ((300, 600) if options.quick else (4_000, 145_000))]
    rows["graded"] = [graded(image, n) for n in ((400,) if options.quick else (5_000, 15_000, 40_000))]
    rows["graded_large"] = graded_large(path, 400 if options.quick else 176_000)
    rows["paper"] = [paper(image, nodes, iterations=2 if options.quick else 6) for nodes in sizes]
    rows["bar"] = bar(image, 300 if options.quick else 5_000)
    rows["engine"] = engine(image, path, (300, 500, 700, 900) if options.quick else (5_000, 14_000, 37_000, 145_000))
    rows["peak_memory_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    save_json(output, rows)
    show(rows)
    print(f"\nall numbers in {output}")
    return 0


def best_seconds(task: Callable[[], Any], repeats: int = 5) -> float:
    """Shortest wall time of several runs, after one that is not counted."""
    task()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        task()
        times.append(time.perf_counter() - begin)
    return min(times)


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


def sampling(image: tetopt.Image, nodes: int) -> dict[str, Any]:
    """Voxels per second of the sampler and of scipy's find_simplex, on the same tessellation and volume."""
    lattice = tetopt.lattice_mesh(image, nodes=nodes)
    index = image.to_index(lattice.points)
    inside = (index > -0.5 + 1e-9) & (index < np.array(image.shape) - 0.5 - 1e-9)
    shaken = image.to_world(index + inside * np.random.default_rng(0).normal(0.0, 0.3, index.shape))
    tessellation = Delaunay(shaken)
    cells = oriented(shaken, tessellation.simplices)
    cells = cells[volumes(shaken, cells) > 1e-9]
    cells = cells[np.lexsort(np.sort(cells, axis=1).T[::-1])]  # as tetopt's own meshes are: neighbours near each other
    sides = facets(cells)
    grid = sampling_grid(image, shaken)
    ticks = to_ticks(image.to_index(shaken), grid)
    ours = best_seconds(lambda: moment_sums(grid, ticks, cells, sides))
    ours_and_facets = best_seconds(lambda: moment_sums(grid, ticks, cells))
    ours_at_once = best_seconds(lambda: tetopt.cell_moments(image, tetopt.Mesh(shaken, cells)))

    centres = image.to_world(np.stack(np.meshgrid(*map(np.arange, image.shape), indexing="ij"), -1).reshape(-1, 3))
    theirs = best_seconds(lambda: tessellation.find_simplex(centres), repeats=2)
    # In raster order each search starts next to its end; in no order, as for scattered points, it walks far.
    some = np.random.default_rng(0).permutation(centres)[:200_000]
    scattered = best_seconds(lambda: tessellation.find_simplex(some), repeats=1) * len(centres) / len(some)
    total = best_seconds(lambda: (image.data.sum(), (image.data * image.data).sum()))
    return {
        "sampling_cells": len(cells),
        "sampling_voxels_per_second": image.data.size / ours,
        "find_simplex_voxels_per_second": image.data.size / theirs,
        "find_simplex_scattered_voxels_per_second": image.data.size / scattered,
        "sampling_over_find_simplex": theirs / ours,
        "sampling_over_find_simplex_scattered": scattered / ours,
        "sampling_and_facets_over_find_simplex": theirs / ours_and_facets,
        "cell_moments_over_find_simplex": theirs / ours_at_once,
        "sampling_over_numpy_sums": ours / total,
    }


def sampling_by_size(image: tetopt.Image, nodes: int) -> dict[str, float]:
    """The sampler alone on a mesh of that many nodes: tetrahedra a second, and beside numpy's two sums."""
    mesh = tetopt.optimize(image, tetopt.lattice_mesh(image, nodes=nodes), k_D=0.0, iterations=1).mesh
    grid = sampling_grid(image, mesh.points)
    ticks, sides = to_ticks(image.to_index(mesh.points), grid), facets(mesh.cells)
    seconds = best_seconds(lambda: moment_sums(grid, ticks, mesh.cells, sides))
    total = best_seconds(lambda: (image.data.sum(), (image.data * image.data).sum()))
    return {"cells": len(mesh.cells), "cells_per_second": len(mesh.cells) / seconds, "over_numpy": seconds / total}


def graded(image: tetopt.Image, nodes: int) -> dict[str, Any]:
    """`tetopt.mesh_image` with its defaults."""
    prepare_kernels(image, GRADED_K_D, is_graded=True)
    begin = time.perf_counter()
    mesh = tetopt.mesh_image(image, nodes).mesh
    seconds = time.perf_counter() - begin
    shape = tetopt.quality(mesh.points, mesh.cells)
    smallest = dihedral_angles(mesh.points, mesh.cells).min(axis=1)
    variance = float(np.var(image.data, dtype=np.float64)) * image.data.size * image.voxel_volume
    return {
        "nodes": shape.n_nodes, "cells": shape.n_cells, "seconds": seconds, "mean_rho": shape.mean_rho,
        "E_D_fraction": tetopt.E_D(image, mesh) / variance, "min_dihedral": shape.min_dihedral,
        "dihedral_1st_percentile": float(np.percentile(smallest, 1)),
    }  # fmt: skip


def graded_large(path: Path, nodes: int) -> dict[str, Any]:
    """The same in a process of its own on a volume of 256^3 voxels, padded by zeros and cut: loading, time, memory."""
    program = (
        "import json, resource, sys, time, numpy as np, tetopt\n"
        "from tetopt.engine.fast import prepare_kernels\n"
        "from tetopt.engine.loop import GRADED_K_D\n"
        "image = tetopt.load_image(sys.argv[1])\n"
        "data = np.pad(image.data, [(0, max(256 - s, 0)) for s in image.shape])[:256, :256, :256]\n"
        "image = tetopt.Image(data, image.affine)\n"
        "prepare_kernels(image, GRADED_K_D, is_graded=True)\n"
        "begin = time.perf_counter()\n"
        "mesh = tetopt.mesh_image(image, int(sys.argv[2])).mesh\n"
        "seconds = time.perf_counter() - begin\n"
        "q = tetopt.quality(mesh.points, mesh.cells)\n"
        "share = tetopt.E_D(image, mesh) / (float(np.var(image.data, dtype=np.float64)) * image.volume)\n"
        "print(json.dumps({'nodes': q.n_nodes, 'cells': q.n_cells, 'seconds': seconds, 'mean_rho': q.mean_rho,\n"
        "    'min_dihedral': q.min_dihedral, 'E_D_fraction': share,\n"
        "    'peak_gb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6}))\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(path), str(nodes)], check=True, capture_output=True)
    return json.loads(done.stdout.splitlines()[-1])


def paper(image: tetopt.Image, nodes: int, iterations: int) -> dict[str, Any]:
    """Seconds per iteration of the paper's scheme, and how much of one Delaunay takes."""
    mesh = tetopt.lattice_mesh(image, nodes=nodes)
    fixed = tetopt.optimize_paper(image, mesh, k_D=0.2, iterations=iterations, retessellate="never")
    per_iteration = (fixed.history[-1].seconds - fixed.history[0].seconds) / iterations
    grid = sampling_grid(image, fixed.mesh.points)
    index = from_ticks(to_ticks(image.to_index(fixed.mesh.points), grid), grid, image.ndim)
    connect = best_seconds(lambda: delaunay(index, image.affine), repeats=2)
    return {
        "nodes": len(mesh.points),
        "cells": len(mesh.cells),
        "seconds_per_iteration": per_iteration + connect,
        "delaunay_fraction": connect / (per_iteration + connect),
    }


def bar(image: tetopt.Image, nodes: int) -> dict[str, Any]:
    """What 20 iterations at k_D = 0.2 reach."""
    mesh = tetopt.lattice_mesh(image, nodes=nodes)
    result = tetopt.optimize_paper(image, mesh, k_D=0.2, iterations=20)
    last = result.history[-1]
    return {
        "nodes": len(mesh.points),
        "seconds": last.seconds,
        "E_D_of_initial": last.E_D / result.history[0].E_D,
        "mean_rho": float(rho(result.mesh.points, result.mesh.cells).mean()),
    }


def engine(image: tetopt.Image, path: Path, sizes: Sequence[int]) -> dict[str, Any]:
    """The fast engine against the paper's scheme, at k_D = 0.5; how time and memory grow; a flip pass alone."""
    mesh = tetopt.lattice_mesh(image, nodes=sizes[0])
    prepare_kernels(image, 0.5)
    reference = tetopt.optimize_paper(image, mesh, k_D=0.5, iterations=20).history
    same = tetopt.optimize(image, mesh, k_D=0.5, iterations=20, shape_power=1.0, min_dihedral=0.0).history
    reached = next((row.seconds for row in same if row.E <= reference[-1].E), None)
    numbers: dict[str, Any] = {
        "nodes": len(mesh.points), "paper_E": reference[-1].E, "paper_seconds": reference[-1].seconds,
        "fast_E": same[-1].E, "fast_seconds": same[-1].seconds, "fast_seconds_to_paper_E": reached,
        "faster_by": None if reached is None else reference[-1].seconds / reached,
    }  # fmt: skip
    numbers["runs"] = [in_a_child(path, nodes) for nodes in sizes[1:]]
    first, last = numbers["runs"][1], numbers["runs"][-1]
    numbers["time_grows_as_nodes_to_the"] = float(
        np.log(last["seconds_per_iteration"] / first["seconds_per_iteration"]) / np.log(last["nodes"] / first["nodes"])
    )
    numbers["flip_seconds_per_mtet"] = flip_pass(image, sizes[1])
    return numbers


def in_a_child(path: Path, nodes: int) -> dict[str, Any]:
    """Defaults at k_D = 0.5 in a process of its own, for its peak of memory."""
    program = (
        "import json, resource, sys, time, numpy as np, tetopt\n"
        "from tetopt.engine.fast import prepare_kernels\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6\n"
        "image = tetopt.load_image(sys.argv[1])\n"
        "prepare_kernels(image, 0.5)\n"
        "mesh = tetopt.lattice_mesh(image, nodes=int(sys.argv[2]))\n"
        "before = int(open('/proc/self/statm').read().split()[1]) * resource.getpagesize() / 1e9\n"
        "begin = time.perf_counter()\n"
        "result = tetopt.optimize(image, mesh, k_D=0.5)\n"
        "seconds, after = time.perf_counter() - begin, peak()\n"
        "first, last = result.history[0], result.history[-1]\n"
        "q = tetopt.quality(result.mesh.points, result.mesh.cells)\n"
        "print(json.dumps({'nodes': q.n_nodes, 'cells': q.n_cells, 'seconds': seconds, 'iterations': last.iteration,\n"
        "    'seconds_per_iteration': (last.seconds - first.seconds) / last.iteration,\n"
        "    'E_D_of_initial': last.E_D / first.E_D, 'mean_rho': q.mean_rho, 'min_dihedral': q.min_dihedral,\n"
        "    'gb_more_per_mtet': (after - before) / q.n_cells * 1e6, 'peak_gb': after}))\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(path), str(nodes)], check=True, capture_output=True)
    return json.loads(done.stdout.splitlines()[-1])


def flip_pass(image: tetopt.Image, nodes: int) -> float:
    """Seconds per million tetrahedra to look at every facet and edge of a mesh that is good already."""
    mesh = tetopt.optimize(image, tetopt.lattice_mesh(image, nodes=nodes), k_D=0.5).mesh
    state, _ = flip(Run(plain(image), mesh, 0.5).state)
    return best_seconds(lambda: flip(state)) / len(mesh.cells) * 1e6


def show(rows: dict[str, Any]) -> None:
    """Print the table."""
    print(f"{rows['image']}, {rows['cores']} cores, {rows['threads']} threads")
    for kind, seconds in rows["first_calls"].items():
        print(
            f"  first call, {kind:22s}{seconds['wall']:10.1f} s of compiling ({seconds['cpu']:.0f} of CPU); whole "
            f"process with the kernels in the cache {seconds['again']:.1f} s"
        )
    for name, row in rows["peers"].items():
        words = f"{row['wall']:.1f} s, {row['cpu']:.1f} of CPU" if isinstance(row, dict) else row
        print(f"  peers, whole process: {name} {words}")
    per_second = rows["sampling_voxels_per_second"] / 1e6
    print(f"  sampling, {rows['sampling_cells']:7d} tets          {per_second:10.1f} Mvoxel/s")
    raster, scattered = rows["find_simplex_voxels_per_second"], rows["find_simplex_scattered_voxels_per_second"]
    print(f"  scipy find_simplex, raster order  {raster / 1e6:10.2f} Mvoxel/s")
    print(f"  scipy find_simplex, random order  {scattered / 1e6:10.2f} Mvoxel/s")
    print(f"  ratio to raster order             {rows['sampling_over_find_simplex']:10.0f}")
    print(f"  ratio to random order             {rows['sampling_over_find_simplex_scattered']:10.0f}")
    print(f"  to raster order, with facets      {rows['sampling_and_facets_over_find_simplex']:10.0f}")
    print(f"  to raster order, cell_moments     {rows['cell_moments_over_find_simplex']:10.0f}")
    print(f"  sampling over numpy's two sums    {rows['sampling_over_numpy_sums']:10.1f}")
    for row in rows["sampling_by_size"]:
        print(
            f"  sampling alone, {row['cells']} tets: {row['cells_per_second'] / 1e6:.1f} Mtet/s, "
            f"{row['over_numpy']:.1f} times numpy's two sums"
        )
    _show_graded(rows["graded"], rows["graded_large"])
    _show_paper(rows["paper"], rows["bar"])
    _show_engine(rows["engine"])
    print(f"  peak memory                       {rows['peak_memory_gb']:10.2f} GB")


def _show_graded(rows: Sequence[dict[str, Any]], large: dict[str, Any]) -> None:
    for row in rows:
        print(
            f"  mesh_image, {row['nodes']} nodes, {row['cells']} tets: {row['seconds']:.1f} s; E_D "
            f"{row['E_D_fraction']:.5f} of the image's variance, mean rho {row['mean_rho']:.4f}, angles from "
            f"{row['min_dihedral']:.1f}, 1st percentile {row['dihedral_1st_percentile']:.1f}"
        )
    print(
        f"  mesh_image, 256^3 voxels, {large['nodes']} nodes, {large['cells']} tets: {large['seconds']:.0f} s, peak "
        f"{large['peak_gb']:.2f} GB; E_D {large['E_D_fraction']:.6f}, mean rho {large['mean_rho']:.4f}, angles from "
        f"{large['min_dihedral']:.1f}"
    )


def _show_paper(rows: Sequence[dict[str, Any]], result: dict[str, Any]) -> None:
    for row in rows:
        print(
            f"  --method paper, {row['nodes']:6d} nodes      {row['seconds_per_iteration']:10.2f} s an iteration, "
            f"Delaunay {100 * row['delaunay_fraction']:.0f} % of it"
        )
    print(
        f"  {result['nodes']} nodes, k_D = 0.2, 20 iterations: E_D {result['E_D_of_initial']:.3f} of initial, "
        f"mean rho {result['mean_rho']:.4f}, {result['seconds']:.1f} s"
    )


def _show_engine(fast: dict[str, Any]) -> None:
    if fast["faster_by"] is not None:
        print(
            f"  --method fast, {fast['nodes']} nodes, k_D = 0.5, p = 1, to E {fast['paper_E']:.4f} of 20 paper "
            f"iterations: {fast['fast_seconds_to_paper_E']:.2f} s against {fast['paper_seconds']:.1f} s, "
            f"{fast['faster_by']:.0f} times faster; ends at {fast['fast_E']:.4f}"
        )
    for row in fast["runs"]:
        print(
            f"  --method fast, {row['nodes']} nodes, {row['cells']} tets, k_D = 0.5: {row['seconds']:.1f} s, "
            f"{row['iterations']} iterations; E_D {row['E_D_of_initial']:.3f} of initial, mean rho "
            f"{row['mean_rho']:.4f}, angles from {row['min_dihedral']:.1f}; "
            f"{row['seconds'] / row['cells'] * 1e6:.0f} s and {row['gb_more_per_mtet']:.2f} GB more per Mtet"
        )
    print(f"  time of an iteration grows as nodes^{fast['time_grows_as_nodes_to_the']:.2f}")
    print(f"  flip pass over a good mesh        {fast['flip_seconds_per_mtet']:10.2f} s per Mtet")


if __name__ == "__main__":
    sys.exit(main())
