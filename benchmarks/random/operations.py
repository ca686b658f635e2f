"""Random operations of the fast engine on small random worlds, with everything checked after each
thousand of them.

    python benchmarks/random/operations.py --seed 1 --operations 1000000

Weights of shape and image, angle limits and numbers of nodes change at random between them, so that
nothing settles.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from itertools import count

import numpy as np
from worlds import random_world

import tetopt
from tetopt.contents.content import plain
from tetopt.energy.sampling import cell_of_voxel
from tetopt.engine.complex import build, remeasure
from tetopt.engine.fast import FAR_TICKS, Run
from tetopt.geometry.check import manifold_problems
from tetopt.start.sizes import Sizes

CHECKED_EVERY = 1000  # operations
WORLD_OPERATIONS = 10_000  # then another world
# on the surface of details as small as cells: a run says so (`MeshingResult.violated`)
OVERLAP = "overlap within a mask"
KINDS = ("moves", "flips", "splits and collapses", "lifts", "moves to interfaces")


def begun(rng):
    """A run on a random world, not yet moved; or None where the world is refused."""
    world = random_world(rng, largest=18)
    content = plain(world.content())
    try:
        start = tetopt.octree_mesh(content, int(rng.integers(60, 200)))
    except tetopt.InputError:
        return None
    run = Run(
        content,
        start,
        float(rng.choice([0.1, 0.5, 0.85])),
        float(rng.uniform(1.0, 4.0)),
        is_graded=True,
    )
    if content.memberships is not None:
        run.give_labels()
    return world, run


def operate(run, rng, made):
    """One random step; adds to `made` how many operations it was."""
    objective = run.state.objective
    fraction = 10.0 ** rng.uniform(-1.5, 1.5)
    run.state = run.state._replace(
        objective=objective._replace(geometry=objective.geometry * fraction)
    )
    if run.n == 3:
        run.keep_min_dihedral(float(rng.choice([0.0, 3.0, 8.0, 12.0, 20.0])))
    run.hope[:] = np.inf
    kind = str(rng.choice(KINDS, p=[0.35, 0.25, 0.2, 0.1, 0.1]))
    before = run.state.complex.ticks.copy()
    if kind == "moves":
        run.sweep()
        made[kind] += int((run.state.complex.ticks != before).any(axis=1).sum())
    elif kind == "flips":
        run.ticks_flipped[:] = FAR_TICKS
        made[kind] += run.flip()
    elif kind == "splits and collapses":
        made[kind] += run.exchange(int(rng.integers(60, 260)), Sizes())
    elif kind == "lifts" and run.n == 3:
        made[kind] += run.lift(float(rng.uniform(2.0, 30.0)))
    elif kind == "moves to interfaces" and run.has_labels:
        run.attract(float(rng.choice([0.0, 4.0, 12.0])))
        made[kind] += int((run.state.complex.ticks != before).any(axis=1).sum())
    run.state = run.state._replace(
        objective=run.state.objective._replace(geometry=objective.geometry)
    )


def problems(run, is_manifold, n_folds):
    """What is wrong with a state, a line each."""
    mesh, content = run.mesh(), run.content
    region, image = content.region, content.image
    wrong = tetopt.check_mesh(
        mesh, image, is_whole=region is None, is_filled=region is None, is_manifold=is_manifold
    )
    if (
        run.has_labels
        and len(manifold_problems(mesh, run.state.complex.labels[: run.n_cells])) > n_folds
    ):
        wrong.append("interfaces became no manifolds")
    state, cells = run.state, run.cells
    # where cells begin uniform: moves leave their sums alone, and say so
    if state.objective.image == 0.0:
        remeasure(state)
    fresh = build(
        cells, state.complex.ticks, state.complex.is_frozen, state.objective, state.sides
    ).complex
    for name in ("across", "fluxes", "sums", "E_shape"):
        if not np.array_equal(
            getattr(state.complex, name)[: len(cells)], getattr(fresh, name)[: len(cells)]
        ):
            wrong.append(f"{name} differ from those measured afresh")
    n_voxels, covered = (
        int(state.complex.sums[: len(cells), 0].sum()),
        int((cell_of_voxel(image, mesh) >= 0).sum()),
    )
    if region is None and n_voxels != image.data.size:
        wrong.append(f"{n_voxels} voxels of {image.data.size}")
    if n_voxels != covered:
        wrong.append(f"{OVERLAP}: {n_voxels - covered} voxels in two cells")
    return wrong


def operations(seed, n_operations, report=print):
    """Operations by kind, checks made, what was wrong, in words, and in how many worlds cells of
    a mask overlap.
    """
    made, n_checks, faults, overlaps = Counter(), 0, [], 0
    for number in count():
        if made.total() >= n_operations:
            break
        rng = np.random.default_rng([20, seed, number])
        if (pair := begun(rng)) is None:
            continue
        world, run = pair
        first = run.mesh()
        is_manifold = not manifold_problems(first)
        n_folds = (
            len(manifold_problems(first, run.state.complex.labels[: run.n_cells]))
            if run.has_labels
            else 0
        )
        end, checked = made.total() + min(WORLD_OPERATIONS, n_operations // 5), made.total()
        for step in range(400):
            operate(run, rng, made)
            is_last = made.total() >= end or step == 399
            if is_last or made.total() - checked >= CHECKED_EVERY:
                n_checks, checked = n_checks + 1, made.total()
                wrong = problems(run, is_manifold, n_folds)
                if (
                    world.mask is not None
                    and wrong
                    and all(words.startswith(OVERLAP) for words in wrong)
                ):
                    overlaps += 1
                    break
                if wrong:
                    faults.append(
                        f"world {number} ({world.words}), step {step}: {'; '.join(wrong)}"
                    )
                    report(faults[-1], flush=True)
                    break
            if is_last:
                break
    return made, n_checks, faults, overlaps


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--operations", type=int, default=1_000_000)
    options = parser.parse_args()
    begin = time.perf_counter()
    made, n_checks, faults, overlaps = operations(options.seed, options.operations)
    seconds = time.perf_counter() - begin
    print(
        f"seed {options.seed}: {made.total()} operations in {seconds:.0f} s, {n_checks} checks, "
        f"{len(faults)} faults,"
    )
    print(
        f"  {overlaps} worlds with overlaps; " + ", ".join(f"{made[kind]} {kind}" for kind in KINDS)
    )
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
