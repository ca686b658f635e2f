"""Thresholds between the classes of an image: Otsu's method (1979), for any number of classes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.system.arrays import Floats

HISTOGRAM_BINS = 256  # bins of the histogram, as many as the values of 8-bit images
# of the weight at either end, which may be a few voxels far brighter than all others
TAIL_FRACTION = 0.0005
# least number of bins for all but the tails: with fewer, thresholds are too coarse
FEWEST_BINS = 64


def class_thresholds(values: NDArray, classes: int, weights: NDArray | None = None) -> Floats:
    """Thresholds between classes that minimise the variance within them (Otsu 1979, for any
    number).

    Exact on a histogram of 256 bins, by dynamic programming over the last bin of each class (Fisher
    1958). The bins span the least to the greatest value. If all but a thousandth of the weight lies
    in fewer than 64 of them, as where one voxel is far brighter than the rest, they span these
    alone, and the end bins take the remaining values.

    Parameters
    ----------
    values : (K,) float
        Intensities.
    classes : int
        Number of classes, 2 or more.
    weights : (K,) float, optional
        Weight of each value, 1 by default.

    Returns
    -------
    (classes - 1,) float64
        Ascending; class c holds the values v with ``np.digitize(v, thresholds) == c``.

    Raises
    ------
    InputError
        Fewer than 2 classes, fewer filled bins than classes, or values that bins cannot separate.
    """
    if classes < 2:
        raise InputError(f"classes: expected 2 or more, got {classes}")
    counts, edges = _histogram(values, weights)
    is_filled = counts > 0
    if is_filled.sum() < classes:
        raise InputError(
            f"classes: {classes} requested, but the values fill only {is_filled.sum()} of "
            f"{HISTOGRAM_BINS} bins"
        )
    centres = 0.5 * (edges[1:] + edges[:-1])[is_filled]
    counts = counts[is_filled].astype(np.float64)
    within = _within_class_sums(counts, centres - centres.mean())
    n = len(counts)
    cost = within[0, 1:]  # cost of one class over bins 0 .. b
    last_cut = []
    for _ in range(classes - 1):
        candidates = np.full((n, n), np.inf)  # [first bin of the last class, its last bin]
        candidates[1:] = cost[:-1, None] + within[1:n, 1:]
        last_cut.append(candidates.argmin(axis=0))
        cost = candidates.min(axis=0)
    cuts, end = [], n - 1
    for cut in reversed(last_cut):
        cuts.append(cut[end])
        end = cut[end] - 1
    first = np.array(cuts[::-1])
    # Halfway between the last filled bin of one class and the first of the next.
    return 0.5 * (centres[first - 1] + centres[first])


def _histogram(values: NDArray, weights: NDArray | None) -> tuple[NDArray, Floats]:
    """Counts and edges of the bins, see `class_thresholds`."""
    low, high = values.min(), values.max()
    steps = np.linspace(low, high, HISTOGRAM_BINS + 1, dtype=values.dtype)  # like numpy's bins
    if low < high and not (steps[:-1] < steps[1:]).all():
        raise InputError(
            f"classes: expected intensities that {HISTOGRAM_BINS} bins can separate, got {low} "
            f"to {high}; subtract "
            "their common offset"
        )
    counts, edges = np.histogram(values, bins=HISTOGRAM_BINS, weights=weights)
    fraction = np.cumsum(counts) / counts.sum()
    first, last = np.searchsorted(fraction, [TAIL_FRACTION, 1.0 - TAIL_FRACTION])
    if last - first + 1 >= FEWEST_BINS:
        return counts, edges
    order = np.argsort(values)
    fraction = np.cumsum(np.ones(len(values)) if weights is None else weights[order])
    ends = np.searchsorted(fraction, fraction[-1] * np.array([TAIL_FRACTION, 1.0 - TAIL_FRACTION]))
    low, high = values[order[np.minimum(ends, len(values) - 1)]]
    if not low < high:
        return counts, edges
    narrow = np.histogram(np.clip(values, low, high), bins=HISTOGRAM_BINS, weights=weights)
    # With few values, such as two of which one is rare, there may be no more bins than before.
    return narrow if (narrow[0] > 0).sum() > (counts > 0).sum() else (counts, edges)


def _within_class_sums(counts: Floats, centres: Floats) -> Floats:
    """Sum of squares around the mean over bins a .. b-1, entry [a, b]; infinite for empty runs,
    (n, n+1).
    """
    n = len(counts)
    sums = [np.concatenate([[0.0], np.cumsum(counts * centres**power)]) for power in range(3)]
    weight, first, second = (s[None, :] - s[:-1, None] for s in sums)
    is_run = np.arange(n + 1)[None, :] > np.arange(n)[:, None]
    spread = second - np.divide(first**2, weight, out=np.zeros_like(first), where=is_run)
    return np.where(is_run, np.maximum(spread, 0.0), np.inf)
