"""Approximate segmentation by an optimised mesh: cells grouped by their means, painted back to voxels.

Section 5 of the paper: "such an optimized discretization can further be used for a fast approximate segmentation since
optimized elements represent an image using far fewer degrees-of-freedom than the underlying pixels".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.content import check_labels
from tetopt.energy.sampling import cell_moments, cell_of_voxel
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.mesh import Mesh

BINS = 256  # of the histogram whose classes are found


def class_thresholds(values: NDArray, classes: int, weights: NDArray | None = None) -> NDArray[np.float64]:
    """Thresholds between the classes that leave the least variance within them (Otsu 1979, for any number).

    Exact on a histogram of 256 bins, by dynamic programming over the last bin of each class (Fisher 1958).

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
        Fewer than 2 classes, or fewer different bins than classes.
    """
    if classes < 2:
        raise InputError(f"classes: expected 2 or more, got {classes}")
    counts, edges = np.histogram(values, bins=BINS, weights=weights)
    is_filled = counts > 0
    if is_filled.sum() < classes:
        raise InputError(f"classes: {classes} asked for, but the values fill only {is_filled.sum()} of {BINS} bins")
    centres = 0.5 * (edges[1:] + edges[:-1])[is_filled]
    counts = counts[is_filled].astype(np.float64)
    within = _within_class_sums(counts, centres - centres.mean())
    n = len(counts)
    cost = within[0, 1:]  # of one class over bins 0 .. b
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


def _within_class_sums(counts: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of squares around the mean over bins a .. b-1, entry [a, b]; infinite for empty runs, (n, n+1)."""
    n = len(counts)
    sums = [np.concatenate([[0.0], np.cumsum(counts * centres**power)]) for power in range(3)]
    weight, first, second = (s[None, :] - s[:-1, None] for s in sums)
    is_run = np.arange(n + 1)[None, :] > np.arange(n)[:, None]
    spread = second - np.divide(first**2, weight, out=np.zeros_like(first), where=is_run)
    return np.where(is_run, np.maximum(spread, 0.0), np.inf)


def segmented(image: Image, mesh: Mesh, classes: int) -> Image:
    """Label image, 0 to classes - 1 by rising mean: the cells' classes painted back to their voxels.

    Cells are grouped by their means, each weighted by its number of voxels; voxels outside the mesh get class 0.

    Raises
    ------
    InputError
        As `class_thresholds` and `tetopt.energy.sampling.cell_moments`.
    """
    moments = cell_moments(image, mesh)
    thresholds = class_thresholds(moments.mean, classes, moments.n_voxels)
    class_of_cell = np.digitize(moments.mean, thresholds)
    owner = cell_of_voxel(image, mesh)
    return Image(np.where(owner >= 0, class_of_cell[owner], 0), image.affine)


def thresholded(image: Image, classes: int) -> Image:
    """Label image, 0 to classes - 1: the same classes from the voxels themselves, no mesh between."""
    thresholds = class_thresholds(image.data.ravel(), classes)
    return Image(np.digitize(image.data, thresholds), image.affine)


def stands_for(labels: Image, truth: Image) -> dict[int, int]:
    """For each class the true label that most of its voxels carry; arguments as for `dice`."""
    table = _table(labels, truth)
    return {int(c): int(table[c].argmax()) for c in np.flatnonzero(table.sum(axis=1))}


def dice(labels: Image, truth: Image) -> dict[int, float]:
    """Dice overlap of each true label with the classes that stand for it, 0 to 1.

    A class stands for the true label that most of its voxels carry (`stands_for`); a true label for which no class
    stands has 0. The truth chooses that, so more classes tend to overlap better.

    Raises
    ------
    InputError
        Images of different shapes, or labels that are not whole numbers from 0.
    """
    table = _table(labels, truth)
    chosen = table.argmax(axis=1)
    overlaps = {}
    for label in np.flatnonzero(table.sum(axis=0)):
        rows = table[(chosen == label) & (table.sum(axis=1) > 0)]
        overlaps[int(label)] = float(2 * rows[:, label].sum() / (rows.sum() + table[:, label].sum()))
    return overlaps


def _table(labels: Image, truth: Image) -> NDArray[np.int64]:
    """Number of voxels of each class (rows) and true label (columns)."""
    if labels.shape != truth.shape:
        raise InputError(f"dice: expected images of one shape, got {labels.shape} and {truth.shape}")
    for name, image in (("labels", labels), ("truth", truth)):
        check_labels(name, image)
    found, true = labels.data.astype(np.int64).ravel(), truth.data.astype(np.int64).ravel()
    shape = (int(found.max()) + 1, int(true.max()) + 1)
    return np.bincount(found * shape[1] + true, minlength=shape[0] * shape[1]).reshape(shape)
