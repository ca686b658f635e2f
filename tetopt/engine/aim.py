"""The search for a mesh as numbers: the corners to request next, and the run that counts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from tetopt.engine.loop import CUT_SHORT
from tetopt.measure.judge import ERROR_AIM, ERROR_RATE, ERROR_REACHED, nodes_ratio
from tetopt.mesh import Mesh
from tetopt.start.sizes import Sizes

Mode = Literal["graded", "uniform", "paper", "start"]
# nodes of order 2 per corner, by dimension, in graded meshes of the MNI152 T1
QUADRATIC_NODES = {2: 3.9, 3: 7.2}
NODES_NEAR = 0.01  # of the number of nodes of order 2: a run this near is accepted
NODE_RUNS = 3  # towards a number of nodes of order 2, at most; the second usually meets it
# in the first run towards an error, by dimension: few enough to take hardly any time
FIRST_NODES = {2: 200, 3: 1500}
RATE_LIMITS = (0.3, 1.0)  # of a measured `ERROR_RATE`
LEAST_ERROR = 0.03  # of the error aimed at, as that of a run may be 0
ERROR_RUNS = 6  # towards an error, at most


class Aim(NamedTuple):
    """The mesh that `mesh_image` is to make, by its arguments; and what its image and sizes add."""

    nodes: int | None = None
    target_error: float | None = None
    sizes: Sizes | None = None
    order: int = 1
    mode: Mode | None = None
    start: Mesh | None = None
    spacing: float | None = None
    kind: str | None = None
    nodes_max: int | None = None
    ndim: int = 3
    fewest: int = 0  # corners that sizes require
    most: int = 2**62  # corners that the voxels allow


class SearchRun(NamedTuple):
    """The numbers of one run of a search."""

    requested: int  # corners
    reached: int  # corners
    nodes: int  # corners and, for order 2, mid-edge nodes
    error: float  # unexplained fraction of the variance, if it is the aim; else 0
    ended: str


def nodes_per_corner(ndim: int, order: int) -> float:
    """Usual number of nodes of an order per corner of a graded mesh."""
    return QUADRATIC_NODES[ndim] if order == 2 else 1.0


def next_corners(aim: Aim, runs: Sequence[SearchRun]) -> int | None:
    """Return the number of corners to request next, 0 if the aim has none; None ends the search.

    Only a target error, or a number of nodes of order 2, takes several runs. Sizes that require
    more corners than `nodes_max` end a search before its first run.
    """
    by_error, by_nodes = aim.target_error is not None, aim.order == 2 and aim.nodes is not None
    most_runs = ERROR_RUNS if by_error else NODE_RUNS if by_nodes else 1
    if len(runs) == most_runs or (runs and (runs[-1].ended in CUT_SHORT or _is_met(aim, runs))):
        return None
    if by_error:
        needed, most = needed_corners(aim, runs), most_corners(aim, runs)
        corners = max(int(min(needed, most)), aim.fewest)
        return None if corners > most or needed in {run.reached for run in runs} else corners
    if by_nodes:
        corners = round((aim.nodes or 0) / _measured_ratio(aim, runs))
        return max(corners, 2 ** (aim.ndim + 1))
    return aim.nodes or 0


def best_of(aim: Aim, runs: Sequence[SearchRun]) -> int:
    """Return the index of the run that counts.

    For a target error, the run with the fewest corners that meets it; if none does, that with the
    least error. Else the run with the nearest number of nodes. A run cut short does not replace a
    run that meets the target, or any run towards a number of nodes.
    """

    def rank(index: int) -> tuple[bool, bool, float]:
        run = runs[index]
        is_cut, is_missed = run.ended in CUT_SHORT, run.error > (aim.target_error or 0.0)
        if aim.target_error is None:
            return False, is_cut, _miss(aim, run)
        return (True, False, run.error) if is_missed else (False, is_cut, run.reached)

    return min(range(len(runs)), key=rank)


def may_differ(aim: Aim, run: SearchRun, corners: int) -> bool:
    """True if exchanges from the same initial mesh may come nearer to another number than in a
    run.
    """
    low = (1.0 - NODES_NEAR) * min(run.requested, corners)
    high = (1.0 + NODES_NEAR) * max(run.requested, corners)
    return aim.mode == "graded" and run.requested != corners and low <= run.reached <= high


def most_corners(aim: Aim, runs: Sequence[SearchRun]) -> float:
    """The number of corners that `nodes_max` allows, by the last run."""
    if aim.nodes_max is None:
        return np.inf
    return round(aim.nodes_max / _measured_ratio(aim, runs))


def needed_corners(aim: Aim, runs: Sequence[SearchRun]) -> int:
    """The number of corners that a target error requires by the runs so far, whatever `nodes_max`
    allows: between the nearest runs on either side of the target, or beyond the nearest.
    """
    if not runs:
        return FIRST_NODES[aim.ndim]
    errors, target = {run.reached: run.error for run in runs}, aim.target_error or 0.0
    above = max((n for n, error in errors.items() if error > target), default=None)
    below = min((n for n, error in errors.items() if error <= target), default=None)
    middle = ERROR_AIM * target
    least = LEAST_ERROR * middle
    if above is not None and below is not None and above < below:
        part = np.log(errors[above] / middle) / np.log(errors[above] / max(errors[below], least))
        return max(int(above * (below / above) ** part), aim.fewest)
    nearest = min(errors) if above is None else above
    rate, other = ERROR_RATE, max((n for n in errors if n < nearest), default=None)
    if above is not None and other is not None:  # the rate of this image, by its last two runs
        measured = np.log(errors[other] / errors[nearest]) / np.log(nearest / other)
        rate = float(np.clip(measured, *RATE_LIMITS))
    number = nearest * nodes_ratio(max(errors[nearest], least), target, rate)
    return max(int(np.clip(number, 2 ** (aim.ndim + 2), aim.most)), aim.fewest)


def _measured_ratio(aim: Aim, runs: Sequence[SearchRun]) -> float:
    """Nodes per corner in the last run, or the usual ones."""
    if not runs:
        return nodes_per_corner(aim.ndim, aim.order)
    return runs[-1].nodes / runs[-1].reached


def _is_met(aim: Aim, runs: Sequence[SearchRun]) -> bool:
    """True if a search ends with its last run: near enough to the aim, at the most nodes, or with
    the corners of an earlier run.
    """
    last, target = runs[-1], aim.target_error
    if target is None:
        return _miss(aim, last) <= NODES_NEAR
    is_most = last.nodes > (1.0 - NODES_NEAR) * (aim.nodes_max or np.inf) and last.error > target
    is_again = last.reached in {run.reached for run in runs[:-1]}
    return is_most or is_again or ERROR_REACHED * target <= last.error <= target


def _miss(aim: Aim, run: SearchRun) -> float:
    """The relative difference of a run's number of nodes from the aim's."""
    return abs(run.nodes / aim.nodes - 1.0) if aim.nodes else 0.0
