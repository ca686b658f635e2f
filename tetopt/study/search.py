"""Search for a requested number of nodes with meshers that do not accept one: repeated runs with
other factors.

Nodes are counted by the cells' order: quadratic cells also have mid-edge nodes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from tetopt.engine.aim import QUADRATIC_NODES

Result = TypeVar("Result")

NODE_TOLERANCE = 0.05  # of the requested number of nodes: the tolerance that ends a search


class Response(NamedTuple):
    """Response of the number of nodes to a mesher's factor: d log nodes / d log factor, and the
    step limits.
    """

    guess: float  # before two runs measure it
    low: float  # limits of the measured slope
    high: float
    step: float  # maximum change of the factor between runs, up or down
    after_failure: float  # multiplier of the factor after a run without a mesh


# Response to the requested number: about proportional. Failed runs are more often too coarse than
# too fine.
REQUEST_RESPONSE = Response(1.0, 0.3, 3.0, step=4.0, after_failure=1.25)
LEAST_REQUEST = 8  # nodes: the corners of a box


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
    """Run with successive factors until the number of nodes is within 5 % of `nodes`; return the
    closest run first.

    Parameters
    ----------
    run : callable
        Takes a factor; returns None without a mesh, and a nearby factor is tried.
    count : callable
        Counts the nodes of a result of `run`.
    nodes : int
    response : Response
    first : float
        Factor of the first run.
    most : int
        Maximum number of runs, including those without a mesh.
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
    """Estimate the number of corners of a mesh whose cells of this order have `nodes` nodes in
    total.
    """
    return max(nodes if order == 1 else round(nodes / QUADRATIC_NODES[3]), LEAST_REQUEST)


def is_near(count: int, nodes: int) -> bool:
    """Return whether a number of nodes is the requested one, within `NODE_TOLERANCE`."""
    return abs(count / nodes - 1.0) <= NODE_TOLERANCE


def next_factor(tried: list[tuple[float, int]], nodes: int, response: Response) -> float:
    """Return the factor at which the secant of log nodes over log factor reaches `nodes`, at
    most one step away.
    """
    x, y = np.log(np.array(tried, dtype=np.float64)).T
    goal = np.log(nodes)
    slope = response.guess
    order = np.argsort(np.abs(y - goal))
    if len(tried) > 1:
        a = order[0]
        # The other end is on the far side of the goal if possible, so that the secant brackets.
        across = [b for b in order[1:] if (y[b] - goal) * (y[a] - goal) < 0.0]
        b = across[0] if across else order[1]
        if x[a] != x[b]:
            slope = float(np.clip((y[a] - y[b]) / (x[a] - x[b]), response.low, response.high))
    step = (goal - y[order[0]]) / slope
    return float(np.exp(x[order[0]] + np.clip(step, -np.log(response.step), np.log(response.step))))
