"""``tetopt mesh --predict``: what a run takes, in words."""

from __future__ import annotations

import numba

from tetopt.cli.console import log, out, show_warning
from tetopt.cluster.crew import Need, counted
from tetopt.engine.cost import calibrated_speed, cost_model, predicted
from tetopt.job.task import Task
from tetopt.start.octree import OCTREE_NODE_BYTES
from tetopt.system.budget import BYTES_PER_GB, available_bytes, memory_words


def print_prediction(task: Task) -> None:
    """Say what the run takes on this machine, and how sure that is; warn where there is less memory."""
    size = task.size
    log.print("measuring this machine, about a second")
    threads, model = numba.get_num_threads(), cost_model()
    prediction = predicted(size, threads, calibrated_speed())
    seconds, factor = prediction.seconds, model.seconds_factor
    out.print(
        f"{_seconds(seconds)} on {threads} thread{'s' if threads > 1 else ''}, in nine of ten cases "
        f"{_seconds(seconds / factor)} to {_seconds(seconds * factor)}, if nothing else runs and the kernels are "
        "compiled"
    )
    n_bytes, fraction = prediction.peak_bytes, model.bytes_fraction
    out.print(f"{memory_words(n_bytes)} of memory at its peak, in nine of ten cases {fraction:.0%} less or more")
    if task.plan.job.target_error is not None:
        out.print(f"of {size.runs} runs with {size.n_nodes} nodes: how many an error takes shows only in the run")
    free = available_bytes()
    if n_bytes > free:
        show_warning(f"{memory_words(free)} of memory are free, less than this run takes; ask for fewer nodes, or crop")


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if value < 100.0 else f"{value:.0f} s"


def print_parts(task: Task) -> None:
    """Say how many parts there will be, and what each takes."""
    job, nodes = task.plan.job, task.size.n_nodes
    number, n_bytes = task.plan.division.expected(task.source.contrasts[0], nodes)
    need = Need(number, n_bytes, job.threads, is_within=True)
    own = OCTREE_NODE_BYTES * nodes
    out.print(
        f"about {counted(number, 'part')} in a round, each of up to {memory_words(n_bytes)} of memory, a worker "
        f"{memory_words(need.limit_for(n_bytes))} in all; about {memory_words(own)} for this command, whose octree is "
        "made in one piece"
    )
    free = available_bytes()
    if own > free:
        show_warning(f"{memory_words(free)} of memory are free, less than the octree takes; ask for fewer nodes")
    if job.worker_gb is not None and job.worker_gb * BYTES_PER_GB < need.limit_for(n_bytes):
        show_warning(f"--worker-gb {job.worker_gb:g}: less than a worker takes; give more, or ask for more --parts")
