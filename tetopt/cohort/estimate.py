"""Predicted time and memory of a cohort's subjects."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
from io import StringIO

from tetopt.cluster.workers import Need
from tetopt.cohort.options import CohortOptions
from tetopt.cohort.plan import PlannedSubject
from tetopt.engine.cost import Prediction, RunSize, calibrated_speed, predicted
from tetopt.errors import InputError
from tetopt.io.images import file_shape
from tetopt.job.events import listened
from tetopt.job.options import SizeOptions
from tetopt.job.predict import size_by_headers
from tetopt.job.read import read_planned
from tetopt.system.budget import available_bytes

LIKE_READS = 8  # subjects of a kind that are read for sizes not in headers: half a minute for large ones


Estimate = dict[str, Prediction]  # by key, each on one thread


def estimated(entries: Sequence[PlannedSubject]) -> Estimate:
    """Predict time and memory of subjects, each on one thread, from headers and from some subjects of each kind.

    A kind has the same options and number of files; if its images have several shapes, one of each shape is read, up to
    `LIKE_READS`, as the cost of labels varies more between shapes than within.
    """
    speed = calibrated_speed() if entries else 1.0
    like: dict[tuple[object, ...], dict[tuple[int, ...], RunSize]] = {}
    reads: Counter[tuple[object, ...]] = Counter()
    estimate = {}
    for entry in entries:
        job = entry.job
        files = len(job.images), job.mask is None, job.labels is None, job.tissues is None
        kind = (*files, job.background, *(getattr(job, field.name) for field in fields(SizeOptions)))
        known = like.setdefault(kind, {})
        try:
            shape = file_shape(job.images[0]) or ()
            if shape not in known and reads[kind] < LIKE_READS:
                reads[kind] += 1
                if (size := _read_size(entry)) is not None:
                    known[shape] = size
            nearest = known.get(shape) or next(iter(known.values()), None)
            estimate[entry.key] = predicted(size_by_headers(entry.plan, nearest), 1, speed)
        except InputError:  # its run will report it
            continue
    return estimate


def _read_size(entry: PlannedSubject) -> RunSize | None:
    """Return the sizes of a run from its files; None if they cannot be read, which its run will report."""
    try:
        with listened(lambda event: None), contextlib.redirect_stderr(StringIO()):
            return read_planned(entry.plan).size
    except (InputError, OSError):
        return None


def need_of(n_tasks: int, estimate: Estimate, cohort: CohortOptions, threads: int | None) -> Need:
    """Return the need of workers; on this machine, without tasks larger than its memory, which will not begin."""
    sizes = [each.peak_bytes for each in estimate.values()]
    if cohort.scheduler is None and cohort.cluster is None:
        free = available_bytes()
        sizes = [each for each in sizes if each <= free]
    return Need(n_tasks, max(sizes, default=0.0), threads)
