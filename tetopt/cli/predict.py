"""``tetopt mesh --predict``: predicted time and memory of a run."""

from __future__ import annotations

import numba

from tetopt.cli.console import log, print_line, show_warning
from tetopt.cluster.crew import Need, counted
from tetopt.engine.cost import calibrated_speed, cost_model, predicted
from tetopt.job.task import Task
from tetopt.start.octree import OCTREE_NODE_BYTES
from tetopt.system.budget import BYTES_PER_GB, available_bytes, memory_words


def print_prediction(task: Task) -> None:
    """Print the predicted time and memory with their uncertainty; warn if there is less memory."""
    size = task.size
    log.print("measuring this machine, about a second")
    threads, model = numba.get_num_threads(), cost_model()
    prediction = predicted(size, threads, calibrated_speed())
    seconds, factor = prediction.seconds, model.seconds_factor
    print_line(
        f"{_seconds(seconds)} on {threads} thread{'s' if threads > 1 else ''}, in nine of ten cases "
        f"{_seconds(seconds / factor)} to {_seconds(seconds * factor)}, if the machine is idle and the kernels are "
        "compiled"
    )
    n_bytes, fraction = prediction.peak_bytes, model.bytes_fraction
    print_line(f"{memory_words(n_bytes)} of memory at peak, in nine of ten cases within {fraction:.0%}")
    if task.plan.job.target_error is not None:
        print_line(f"assuming {size.runs} runs with {size.n_nodes} nodes: only the run shows how many are needed")
    free = available_bytes()
    if n_bytes > free:
        show_warning(f"only {memory_words(free)} of memory is free, less than this run needs; reduce --nodes or crop")


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if value < 100.0 else f"{value:.0f} s"


def print_parts(task: Task) -> None:
    """Print the expected number of parts and the memory of each."""
    job, nodes = task.plan.job, task.plan.job.nodes or 0
    number, n_bytes = task.plan.division.expected(task.source.contrasts[0], nodes)
    need = Need(number, n_bytes, job.threads, is_within=True)
    own = OCTREE_NODE_BYTES * nodes
    print_line(
        f"about {counted(number, 'part')} per round, each up to {memory_words(n_bytes)} of memory "
        f"({memory_words(need.limit_for(n_bytes))} with its worker); about {memory_words(own)} for this command, "
        "which builds the octree in one piece"
    )
    free = available_bytes()
    if own > free:
        show_warning(f"only {memory_words(free)} of memory is free, less than the octree needs; reduce --nodes")
    if job.worker_gb is not None and job.worker_gb * BYTES_PER_GB < need.limit_for(n_bytes):
        show_warning(f"--worker-gb {job.worker_gb:g}: less than a worker needs; increase it, or increase --parts")
