"""The number of nodes that was asked for, from meshers that take none: run after run with another factor.

Nodes are counted as the cells' order has them: quadratic cells also have one in the middle of each edge.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from tetopt.engine.meshing import QUADRATIC_NODES

Result = TypeVar("Result")

NODE_TOLERANCE = 0.05  # of the requested number of nodes, within which a search for it ends


class Response(NamedTuple):
    """How the number of nodes answers to a mesher's factor: d log nodes / d log factor, and how far to go at once."""

    guess: float  # before two runs have shown it
    low: float  # limits to what two runs may show
    high: float
    step: float  # by how much a factor may change from one run to the next, up or down
    after_failure: float  # what it is multiplied by after a run without a mesh


# Of nodes to the number that is asked for: proportional, or nearly so. What fails is rather too coarse than too fine.
REQUEST_RESPONSE = Response(1.0, 0.3, 3.0, step=4.0, after_failure=1.25)
LEAST_REQUEST = 8  # nodes: a box has as many corners


class Try(NamedTuple, Generic[Result]):
    """One run."""

    factor: float
    n_nodes: int
    seconds: float
    result: Result


def tries(
    run: Callable[[float], Result | None],
    count: Callable[[Result], int],
    nodes: int,
    response: Response,
    *,
    first: float = 1.0,
    most: int,
) -> list[Try[Result]]:
    """Run with one factor after the other until the number of nodes is within 5 % of `nodes`; the nearest run first.

    Parameters
    ----------
    run : callable
        Takes a factor; None says that there is no mesh, and another try beside follows.
    count : callable
        The nodes of what `run` returned.
    nodes : int
    response : Response
    first : float
        Factor of the first run.
    most : int
        Runs at most, those without a mesh included.
    """
    done: list[Try[Result]] = []
    factor = first
    for _ in range(most):
        begin = time.perf_counter()
        result = run(factor)
        if result is None:
            factor *= response.after_failure
            continue
        done.append(Try(factor, count(result), time.perf_counter() - begin, result))
        if is_near(done[-1].n_nodes, nodes):
            break
        factor = next_factor([(each.factor, each.n_nodes) for each in done], nodes, response)
    return sorted(done, key=lambda each: abs(np.log(each.n_nodes / nodes)))


def corners_for(nodes: int, order: int) -> int:
    """About how many corners a mesh has whose cells of this order have `nodes` nodes in all."""
    return max(nodes if order == 1 else round(nodes / QUADRATIC_NODES[3]), LEAST_REQUEST)


def is_near(count: int, nodes: int) -> bool:
    """Whether a number of nodes is the requested one, within `NODE_TOLERANCE`."""
    return abs(count / nodes - 1.0) <= NODE_TOLERANCE


def next_factor(tried: list[tuple[float, int]], nodes: int, response: Response) -> float:
    """The factor at which the secant of log nodes over log factor meets `nodes`, no farther than a step away."""
    x, y = np.log(np.array(tried, dtype=np.float64)).T
    goal = np.log(nodes)
    slope = response.guess
    order = np.argsort(np.abs(y - goal))
    if len(tried) > 1:
        a = order[0]
        # The other end on the far side of the goal, if there is one, so that the secant brackets.
        across = [b for b in order[1:] if (y[b] - goal) * (y[a] - goal) < 0.0]
        b = across[0] if across else order[1]
        if x[a] != x[b]:
            slope = float(np.clip((y[a] - y[b]) / (x[a] - x[b]), response.low, response.high))
    step = (goal - y[order[0]]) / slope
    return float(np.exp(x[order[0]] + np.clip(step, -np.log(response.step), np.log(response.step))))
