"""How fast the kernels are on this machine, beside the library call that each replaces; a table and
a JSON file.

    python benchmarks/benchmark_kernels.py -o bench_kernels.json [IMAGE]

IMAGE is the MNI152 T1 that nilearn carries unless another is named. Compare ratios within one run.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
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
from tetopt.geometry.simplex import orient_cells, rho, volumes
from tetopt.geometry.topology import facets
from tetopt.io.mni import mni_path
from tetopt.report.summary import versions
from tetopt.start.delaunay import delaunay
from tetopt.system.files import check_output, save_json


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("image", type=Path, nargs="?", help="volume to measure on")
    parser.add_argument("-o", "--output", type=Path, required=True, help="JSON file")
    parser.add_argument(
        "--quick", action="store_true", help="small meshes, to try the program itself"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    options = parser.parse_args(argv)
    try:
        output = check_output(options.output, (".json",), options.force)
        path = mni_path("t1") if options.image is None else options.image
        image = tetopt.load_image(path)
    except tetopt.InputError as error:
        print(f"benchmark_kernels: {error}", file=sys.stderr)
        return 2
    sizes = (300, 600) if options.quick else (5_000, 20_000)
    rows: dict[str, Any] = {
        "image": path.name,
        "cores": os.cpu_count(),
        "threads": numba.get_num_threads(),
        "versions": versions(),
    }
    rows |= sampling(image, 2_000 if options.quick else 37_000)
    rows["sampling_by_size"] = [
        sampling_by_size(image, n) for n in ((300, 600) if options.quick else (4_000, 145_000))
    ]
    rows["paper"] = [paper(image, nodes, iterations=2 if options.quick else 6) for nodes in sizes]
    rows["bar"] = bar(image, 300 if options.quick else 5_000)
    rows["engine"] = engine(
        image, path, (300, 500, 700, 900) if options.quick else (5_000, 14_000, 37_000, 145_000)
    )
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


def sampling(image: tetopt.Image, nodes: int) -> dict[str, Any]:
    """Voxels per second of the sampler and of scipy's find_simplex, on the same tessellation and
    volume.
    """
    lattice = tetopt.lattice_mesh(image, nodes=nodes)
    index = image.to_index(lattice.points)
    inside = (index > -0.5 + 1e-9) & (index < np.array(image.shape) - 0.5 - 1e-9)
    shaken = image.to_world(index + inside * np.random.default_rng(0).normal(0.0, 0.3, index.shape))
    tessellation = Delaunay(shaken)
    cells = orient_cells(shaken, tessellation.simplices)
    cells = cells[volumes(shaken, cells) > 1e-9]
    # as tetopt's own meshes are: neighbours near each other
    cells = cells[np.lexsort(np.sort(cells, axis=1).T[::-1])]
    sides = facets(cells)
    grid = sampling_grid(image, shaken)
    ticks = to_ticks(image.to_index(shaken), grid)
    ours = best_seconds(lambda: moment_sums(grid, ticks, cells, sides))
    ours_and_facets = best_seconds(lambda: moment_sums(grid, ticks, cells))
    ours_at_once = best_seconds(lambda: tetopt.cell_moments(image, tetopt.Mesh(shaken, cells)))

    centres = image.to_world(
        np.stack(np.meshgrid(*map(np.arange, image.shape), indexing="ij"), -1).reshape(-1, 3)
    )
    theirs = best_seconds(lambda: tessellation.find_simplex(centres), repeats=2)
    # In raster order each search starts next to its end; in no order, as for scattered points, it
    # walks far.
    some = np.random.default_rng(0).permutation(centres)[:200_000]
    scattered = (
        best_seconds(lambda: tessellation.find_simplex(some), repeats=1) * len(centres) / len(some)
    )
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
    """The sampler alone on a mesh of that many nodes: tetrahedra a second, and beside numpy's
    two sums.
    """
    mesh = tetopt.optimize(
        image, tetopt.lattice_mesh(image, nodes=nodes), k_D=0.0, iterations=1
    ).mesh
    grid = sampling_grid(image, mesh.points)
    ticks, sides = to_ticks(image.to_index(mesh.points), grid), facets(mesh.cells)
    seconds = best_seconds(lambda: moment_sums(grid, ticks, mesh.cells, sides))
    total = best_seconds(lambda: (image.data.sum(), (image.data * image.data).sum()))
    return {
        "cells": len(mesh.cells),
        "cells_per_second": len(mesh.cells) / seconds,
        "over_numpy": seconds / total,
    }


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
    """The fast engine against the paper's scheme, at k_D = 0.5; how time and memory grow; a flip
    pass alone.
    """
    mesh = tetopt.lattice_mesh(image, nodes=sizes[0])
    prepare_kernels(image, 0.5)
    reference = tetopt.optimize_paper(image, mesh, k_D=0.5, iterations=20).history
    same = tetopt.optimize(
        image, mesh, k_D=0.5, iterations=20, shape_power=1.0, min_dihedral=0.0
    ).history
    reached = next((row.seconds for row in same if row.E <= reference[-1].E), None)
    numbers: dict[str, Any] = {
        "nodes": len(mesh.points),
        "paper_E": reference[-1].E,
        "paper_seconds": reference[-1].seconds,
        "fast_E": same[-1].E,
        "fast_seconds": same[-1].seconds,
        "fast_seconds_to_paper_E": reached,
        "faster_by": None if reached is None else reference[-1].seconds / reached,
    }
    numbers["runs"] = [in_a_child(path, nodes) for nodes in sizes[1:]]
    first, last = numbers["runs"][1], numbers["runs"][-1]
    numbers["time_grows_as_nodes_to_the"] = float(
        np.log(last["seconds_per_iteration"] / first["seconds_per_iteration"])
        / np.log(last["nodes"] / first["nodes"])
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
        "print(json.dumps({'nodes': q.n_nodes, 'cells': q.n_cells, 'seconds': seconds, "
        "'iterations': last.iteration,\n"
        "    'seconds_per_iteration': (last.seconds - first.seconds) / last.iteration,\n"
        "    'E_D_of_initial': last.E_D / first.E_D, 'mean_rho': q.mean_rho, 'min_dihedral': "
        "q.min_dihedral,\n"
        "    'gb_more_per_mtet': (after - before) / q.n_cells * 1e6, 'peak_gb': after}))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(path), str(nodes)], check=True, capture_output=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def flip_pass(image: tetopt.Image, nodes: int) -> float:
    """Seconds per million tetrahedra to look at every facet and edge of a mesh that is good
    already.
    """
    mesh = tetopt.optimize(image, tetopt.lattice_mesh(image, nodes=nodes), k_D=0.5).mesh
    state, _ = flip(Run(plain(image), mesh, 0.5).state)
    return best_seconds(lambda: flip(state)) / len(mesh.cells) * 1e6


def show(rows: dict[str, Any]) -> None:
    """Print the table."""
    print(f"{rows['image']}, {rows['cores']} cores, {rows['threads']} threads")
    per_second = rows["sampling_voxels_per_second"] / 1e6
    print(f"  sampling, {rows['sampling_cells']:7d} tets          {per_second:10.1f} Mvoxel/s")
    raster, scattered = (
        rows["find_simplex_voxels_per_second"],
        rows["find_simplex_scattered_voxels_per_second"],
    )
    print(f"  scipy find_simplex, raster order  {raster / 1e6:10.2f} Mvoxel/s")
    print(f"  scipy find_simplex, random order  {scattered / 1e6:10.2f} Mvoxel/s")
    print(f"  ratio to raster order             {rows['sampling_over_find_simplex']:10.0f}")
    print(
        f"  ratio to random order             {rows['sampling_over_find_simplex_scattered']:10.0f}"
    )
    print(
        f"  to raster order, with facets      {rows['sampling_and_facets_over_find_simplex']:10.0f}"
    )
    print(f"  to raster order, cell_moments     {rows['cell_moments_over_find_simplex']:10.0f}")
    print(f"  sampling over numpy's two sums    {rows['sampling_over_numpy_sums']:10.1f}")
    for row in rows["sampling_by_size"]:
        print(
            f"  sampling alone, {row['cells']} tets: {row['cells_per_second'] / 1e6:.1f} Mtet/s, "
            f"{row['over_numpy']:.1f} times numpy's two sums"
        )
    _show_paper(rows["paper"], rows["bar"])
    _show_engine(rows["engine"])
    print(f"  peak memory                       {rows['peak_memory_gb']:10.2f} GB")


def _show_paper(rows: Sequence[dict[str, Any]], result: dict[str, Any]) -> None:
    for row in rows:
        print(
            f"  --method paper, {row['nodes']:6d} nodes      "
            f"{row['seconds_per_iteration']:10.2f} s an iteration, "
            f"Delaunay {100 * row['delaunay_fraction']:.0f} % of it"
        )
    print(
        f"  {result['nodes']} nodes, k_D = 0.2, 20 iterations: E_D "
        f"{result['E_D_of_initial']:.3f} of initial, "
        f"mean rho {result['mean_rho']:.4f}, {result['seconds']:.1f} s"
    )


def _show_engine(fast: dict[str, Any]) -> None:
    if fast["faster_by"] is not None:
        print(
            f"  --method fast, {fast['nodes']} nodes, k_D = 0.5, p = 1, to E "
            f"{fast['paper_E']:.4f} of 20 paper "
            f"iterations: {fast['fast_seconds_to_paper_E']:.2f} s against "
            f"{fast['paper_seconds']:.1f} s, "
            f"{fast['faster_by']:.0f} times faster; ends at {fast['fast_E']:.4f}"
        )
    for row in fast["runs"]:
        print(
            f"  --method fast, {row['nodes']} nodes, {row['cells']} tets, k_D = 0.5: "
            f"{row['seconds']:.1f} s, "
            f"{row['iterations']} iterations; E_D {row['E_D_of_initial']:.3f} of initial, mean rho "
            f"{row['mean_rho']:.4f}, angles from {row['min_dihedral']:.1f}; "
            f"{row['seconds'] / row['cells'] * 1e6:.0f} s and {row['gb_more_per_mtet']:.2f} GB "
            "more per Mtet"
        )
    print(f"  time of an iteration grows as nodes^{fast['time_grows_as_nodes_to_the']:.2f}")
    print(f"  flip pass over a good mesh        {fast['flip_seconds_per_mtet']:10.2f} s per Mtet")


if __name__ == "__main__":
    sys.exit(main())
