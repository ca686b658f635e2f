"""Memory of a cohort's subjects, known before they run."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import fields
from io import StringIO

from tetopt.cohort.cohort_plan import PlannedSubject
from tetopt.cohort.options import CohortOptions
from tetopt.engine.meshing import process_bytes
from tetopt.errors import InputError
from tetopt.io.images import file_shape
from tetopt.job.events import listen_with
from tetopt.job.options import SizeOptions
from tetopt.job.plan import expected_nodes
from tetopt.job.read import read_planned
from tetopt.system.budget import available_bytes
from tetopt.workers import MEMORY_MARGIN, Share, share_of

WORKER_BYTES = 1.5e8  # of a dask worker with its nanny: 65 MB each, and their messages
# subjects of a kind that are read for sizes not in headers: half a minute for large ones
LIKE_READS = 8


Estimate = dict[str, float]  # bytes by key


def estimate_memory(entries: Sequence[PlannedSubject]) -> Estimate:
    """Return the memory of subjects, by some subjects of each kind, which are read.

    A kind has the same options and number of files; if its images have several shapes, one of each
    shape is read, up to `LIKE_READS`, and others count as the largest.
    """
    known: dict[object, dict[object, float | None]] = {}  # by kind and shape; None if not readable
    shapes = {}
    for entry in entries:
        job = entry.plan.job
        files = len(job.images), job.mask is None, job.labels is None, job.tissues is None
        kind = (
            *files,
            job.background,
            *(getattr(job, field.name) for field in fields(SizeOptions)),
        )
        with contextlib.suppress(InputError):  # its run will report it
            shapes[entry.key] = kind, file_shape(job.images[0])
            of_kind, shape = known.setdefault(kind, {}), shapes[entry.key][1]
            if shape not in of_kind and len(of_kind) < LIKE_READS:
                of_kind[shape] = _read_bytes(entry)
    largest = {
        kind: max(filter(None, of_kind.values()), default=None) for kind, of_kind in known.items()
    }
    bytes_ = {key: known[kind].get(shape) or largest[kind] for key, (kind, shape) in shapes.items()}
    return {key: each for key, each in bytes_.items() if each is not None}


def _read_bytes(entry: PlannedSubject) -> float | None:
    """Return the memory of a run by its files; None if they cannot be read, which its run will
    report.
    """
    try:
        with listen_with(lambda event: None), contextlib.redirect_stderr(StringIO()):
            task = read_planned(entry.plan)
    except (InputError, OSError):
        return None
    return process_bytes(task.source.content, expected_nodes(task.plan, task.source.content))


def share_for(
    n_tasks: int, estimate: Estimate, cohort: CohortOptions, threads: int | None
) -> Share:
    """Divide this machine among subjects; those larger than its memory will not begin."""
    free = available_bytes()
    largest = max((each for each in estimate.values() if each <= free), default=0.0)
    return share_of(n_tasks, MEMORY_MARGIN * largest + WORKER_BYTES, cohort.workers, threads)
