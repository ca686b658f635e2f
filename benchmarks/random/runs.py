"""Random whole runs of `mesh_image`: the requirements are checked on the mesh by other means than
the engine's own.

    python benchmarks/random/runs.py --seed 1 --runs 500
    python benchmarks/random/runs.py --seed 1 --runs 500 --labelled

A run may refuse its input, and may violate a requirement, if it says so; it may not do so silently.
Labelled runs are of volumes with labels, about half of them within a mask, by the default options:
they may miss no angle of 12 degrees.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numba
import numpy as np
import scipy
from worlds import random_world, sharpest_edge

import tetopt
from tetopt.contents.content import plain
from tetopt.measure.fidelity import mask_fidelity
from tetopt.report.summary import mesh_hash
from tetopt.start.octree import nearest_octree

MODES = ("graded", "graded", "graded", "uniform", "paper", "start")
# degrees, of labelled worlds: no mesh has larger angles at an edge of the box than the box
LEAST_BOX_ANGLE = 24.0
THREADED_FRACTION = 0.1  # of the runs: made again on another number of threads


def random_request(rng, world):
    """Arguments of `mesh_image` for a world: the mode, how many nodes or which error, the
    engine's options.
    """
    target, n = world.content(), world.image.ndim
    mode = str(rng.choice(MODES))
    if mode == "paper":
        target = world.image
    k_D = float(rng.choice([0.0, 0.02, 0.2, 0.5, 0.85, 0.97]))
    request = {"mode": mode, "k_D": k_D, "iterations": int(rng.integers(0, 9))}
    min_dihedral = 12.0
    if mode != "paper":
        min_dihedral = request["min_dihedral"] = float(
            rng.choice([0.0, 5.0, 12.0, 12.0, 20.0, 40.0])
        )
        request["shape_power"] = float(rng.choice([1.0, 3.0, 3.0, 5.0]))
    if mode == "start":
        request["start"] = nearest_octree(target, int(rng.integers(60, 200)))
        request["boundary"] = str(rng.choice(["fixed", "slide"]))
    elif mode == "graded" and rng.random() < 0.15:
        request["target_error"] = float(rng.choice([0.02, 0.1, 0.3, 0.7]))
    else:
        request["nodes"] = int(rng.integers(60, 220))
    if mode == "graded" and rng.random() < 0.3:
        size = float((world.image.volume / 150.0) ** (1.0 / n))
        request["sizes"] = tetopt.Sizes(
            smallest=float(rng.choice([0.0, 0.3])) * size,
            gradation=float(rng.choice([1.0, 0.3])),
            longest=float(rng.choice([2.0, 4.0])) * size,
        )
    return target, request, 0.0 if mode == "paper" else min_dihedral


def labelled_world(rng):
    """A volume with labels in a box whose own edges are not sharp."""
    while True:
        world = random_world(rng, 3, needs_labels=True)
        if world.labels is not None and sharpest_edge(world.image.affine) > LEAST_BOX_ANGLE:
            return world


def labelled_request(rng, world):
    """Likewise by the defaults, for worlds with labels."""
    return world.content(), {"nodes": int(rng.integers(100, 500))}, 12.0


def angles_under(mesh, degrees):
    """How many tetrahedra have a dihedral angle under so many degrees, from the normals of their
    faces.
    """
    corners = mesh.points[mesh.cells]
    n_below = np.zeros(len(corners), dtype=bool)
    for i in range(4):
        for j in range(i + 1, 4):
            k, m = (d for d in range(4) if d not in (i, j))
            axis = corners[:, j] - corners[:, i]
            one, other = (
                np.cross(axis, corners[:, k] - corners[:, i]),
                np.cross(axis, corners[:, m] - corners[:, i]),
            )
            size = np.linalg.norm(np.cross(one, other), axis=1)
            n_below |= np.degrees(np.arctan2(size, (one * other).sum(axis=1))) < degrees - 1e-6
    return int(n_below.sum())


def times_inside(image, mesh):
    """In how many cells each voxel's centre lies, and how many are too near to a facet to tell:
    plain arithmetic.
    """
    centres = image.to_world(np.indices(image.shape).reshape(image.ndim, -1).T.astype(float))
    counts, is_unsure = np.zeros(len(centres), dtype=np.int64), np.zeros(len(centres), dtype=bool)
    for cell in mesh.points[mesh.cells]:
        near = np.flatnonzero(
            ((centres >= cell.min(axis=0)) & (centres <= cell.max(axis=0))).all(axis=1)
        )
        fraction = np.linalg.solve((cell[1:] - cell[0]).T, (centres[near] - cell[0]).T)
        least = np.minimum(fraction.min(axis=0), 1.0 - fraction.sum(axis=0))
        counts[near] += least > 1e-7
        is_unsure[near[np.abs(least) <= 1e-7]] = True
    return counts, is_unsure


def faults_of(world, target, request, min_dihedral, result):
    """What the mesh of a run is that it should not be, and does not say."""
    mesh, violated, region = result.mesh, set(result.violated), plain(target).region
    is_filled = region is None
    wrong = tetopt.check_mesh(
        mesh, world.image, is_whole=is_filled, is_filled=is_filled, is_manifold=is_filled
    )
    counts, is_unsure = times_inside(world.image, mesh)
    if (counts > 1).any() != ("overlap" in violated) and plain(
        target
    ).image.shape == world.image.shape:
        wrong.append(f"{(counts > 1).sum()} voxels lie in two cells, violated: {sorted(violated)}")
    if is_filled and ((counts != 1) & ~is_unsure).any():
        wrong.append(f"{((counts != 1) & ~is_unsure).sum()} voxels are not in one cell")
    moved = result.history[-1].iteration > 0
    if (
        mesh.ndim == 3
        and moved
        and (angles_under(mesh, min_dihedral) > 0) != ("min_dihedral" in violated)
    ):
        wrong.append(
            f"{angles_under(mesh, min_dihedral)} cells under {min_dihedral} degrees, violated: "
            f"{sorted(violated)}"
        )
    if "target_error" in request:
        fraction = result.history[-1].E_D / (plain(target).variance * plain(target).volume or 1.0)
        if (fraction > request["target_error"]) != ("error" in violated):
            wrong.append(
                f"error {fraction} of {request['target_error']}, violated: {sorted(violated)}"
            )
    if not is_filled and world.labels is None and mask_fidelity(world.mask, mesh).dice < 0.9 - 1e-9:
        wrong += [] if "mask" in violated else ["the mask is hardly covered"]
    if request.get("boundary") == "fixed" and len(mesh.points) and moved:
        outer = np.unique(tetopt.geometry.topology.boundary_facets(request["start"].cells))
        kept = {tuple(place) for place in mesh.points.tolist()}
        wrong += (
            []
            if all(tuple(p) in kept for p in request["start"].points[outer].tolist())
            else ["a boundary moved"]
        )
    problems = [] if is_filled else tetopt.geometry.check.manifold_problems(mesh)
    problems += (
        []
        if result.labels is None
        else tetopt.geometry.check.manifold_problems(mesh, result.labels)
    )
    if bool(problems) != ("manifold" in violated):
        wrong.append(f"{problems}, violated: {sorted(violated)}")
    n_pieces = 1 if is_filled else scipy.ndimage.label(region.inside)[1]
    if (np.unique(tetopt.geometry.topology.components(mesh.cells)).size > n_pieces) != (
        "components" in violated
    ):
        wrong.append(f"more components than {n_pieces}, violated: {sorted(violated)}")
    wrong += [f"promise violated: {name}" for name in ("box", "cover") if name in violated]
    return wrong


def one_run(seed, number, is_labelled=False):
    """What came of a run: "done" or "refused", its faults, its violated requirements, what it
    was.
    """
    rng = np.random.default_rng([21, seed, number])
    world = labelled_world(rng) if is_labelled else random_world(rng)
    words = world.words
    try:
        target, request, min_dihedral = (labelled_request if is_labelled else random_request)(
            rng, world
        )
        words = f"{words}; { ({k: v for k, v in request.items() if k != 'start'}) }"
        result = tetopt.mesh_image(target, **request)
    except tetopt.InputError as error:
        return "refused", [], [str(error).split(":")[0]], words
    faults = faults_of(world, target, request, min_dihedral, result)
    if is_labelled and "min_dihedral" in result.violated:
        faults.append(result.violated["min_dihedral"])
    if rng.random() < THREADED_FRACTION:
        threads = numba.get_num_threads()
        numba.set_num_threads(1 if threads > 1 else min(2, numba.config.NUMBA_NUM_THREADS))
        again = tetopt.mesh_image(target, **request)
        numba.set_num_threads(threads)
        if mesh_hash(again.mesh) != mesh_hash(result.mesh):
            faults.append("other bits on another number of threads")
    return "done", faults, list(result.violated), words


def runs(seed, n_runs, report=print, is_labelled=False):
    """Outcomes, violated requirements and faults of so many runs."""
    outcomes, violations, faults = Counter(), Counter(), []
    for number in range(n_runs):
        outcome, wrong, violated, words = one_run(seed, number, is_labelled)
        outcomes[outcome] += 1
        violations.update(f"{outcome}: {name}" for name in violated)
        if wrong:
            faults.append(f"run {number} ({words}): {'; '.join(wrong)}")
            report(faults[-1], flush=True)
    return outcomes, violations, faults


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--labelled", action="store_true")
    options = parser.parse_args()
    begin = time.perf_counter()
    outcomes, violations, faults = runs(options.seed, options.runs, is_labelled=options.labelled)
    print(
        f"seed {options.seed}: {dict(outcomes)}, {len(faults)} with faults, "
        f"{time.perf_counter() - begin:.0f} s"
    )
    for name, number in sorted(violations.items()):
        print(f"  {number} {name}")
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
