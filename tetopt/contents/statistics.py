"""Statistics of an image's voxels from one pass over boxes, so that the volume need not fit into
memory.

Sums run along rows of the last axis first, and rows are added in their order, so that results are
the same to the last bit however the volume is divided into boxes, and whether it is stored or in
memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.noise import NoiseSample, noise_places, sampled_noise
from tetopt.image import Image, check_finite, check_intensities, check_kind, pieces
from tetopt.system.budget import check_memory

# Per voxel of the noise's planes: three doubles, and temporaries for their second differences.
NOISE_PLANE_BYTES = 120.0


class Statistics(NamedTuple):
    """Statistics of all voxels of a volume; made by `tetopt.contents.statistics.statistics`.

    Parameters
    ----------
    mean, low, high : float
        Mean, smallest and largest intensity.
    variance : float
        Variance, normalised by the number of voxels.
    noise : float
        Variance of the noise, equal to `Content.noise` of the image in memory to the last bit.
    scaled_noise : float
        The same for intensities minus their mean, divided by the largest deviation from the mean.
    is_whole : bool
        True if all intensities are whole numbers.

    Examples
    --------
    >>> from tetopt.contents.statistics import statistics
    >>> voxels = np.arange(4096, dtype=np.int16).reshape(16, 16, 16)
    >>> numbers = statistics(tetopt.Image.stored(voxels))
    >>> numbers.low, numbers.high, numbers.mean, numbers.is_whole
    (0.0, 4095.0, 2047.5, True)
    """

    mean: float
    low: float
    high: float
    variance: float
    noise: float
    scaled_noise: float
    is_whole: bool

    @property
    def scale(self) -> float:
        """The largest deviation from the mean; 1 for a constant image."""
        return max(abs(self.low - self.mean), abs(self.high - self.mean)) or 1.0


def statistics(image: Image) -> Statistics:
    """Compute statistics of a volume, for `octree_mesh` and parts, in one pass over its voxels.

    Parameters
    ----------
    image : Image
        A 3-D image, read box by box.

    Returns
    -------
    Statistics
        In units of intensity, or its square.

    Raises
    ------
    InputError
        Voxels that are invalid for an `Image`: not real numbers, NaN, infinite, or too large to be
        squared.
    """
    shape = image.shape
    check_kind(image.voxels.dtype)
    stride, middles = noise_places(shape)
    n_voxels, need = (
        float(np.prod(shape, dtype=np.float64)),
        NOISE_PLANE_BYTES * len(middles) * shape[1] * shape[2],
    )
    check_memory(
        need + image.box_bytes, f"image: {n_voxels:.3g} voxels", "make its shortest axis the last"
    )
    sums, squares = np.empty(shape[:2]), np.empty(shape[:2])
    near = np.empty((3, len(middles), *shape[1:]))
    places = np.unravel_index(np.arange(0, int(n_voxels), stride), shape)
    sample = np.empty(len(places[0]))
    low, high, is_whole, n_bad, first_bad = np.inf, -np.inf, True, 0, shape
    for box in image.boxes():
        values = image.read([s.start for s in box], [s.stop for s in box])
        for k in range(3):
            for number in np.flatnonzero(
                (middles + k - 1 >= box[0].start) & (middles + k - 1 < box[0].stop)
            ):
                near[k, number, box[1]] = values[middles[number] + k - 1 - box[0].start]
        is_here = (places[0] >= box[0].start) & (places[0] < box[0].stop)
        is_here &= (places[1] >= box[1].start) & (places[1] < box[1].stop)
        sample[is_here] = values[
            tuple(axis[is_here] - s.start for axis, s in zip(places, box, strict=True))
        ]
        for piece in pieces(values.shape):
            part = np.array(values[piece], dtype=np.float64, order="C")
            is_bad = ~np.isfinite(part)
            if is_bad.any():
                n_bad += int(np.count_nonzero(is_bad))
                place = np.argwhere(is_bad)[0] + [
                    a.start + b.start for a, b in zip(box, piece, strict=True)
                ]
                first_bad = min(first_bad, tuple(int(i) for i in place))
                continue
            low, high = min(low, float(part.min())), max(high, float(part.max()))
            is_whole = is_whole and (
                values.dtype.kind in "bui" or bool((part == np.rint(part)).all())
            )
            rows = tuple(
                slice(a.start + b.start, a.start + b.stop)
                for a, b in zip(box[:2], piece[:2], strict=True)
            )
            with np.errstate(over="ignore", invalid="ignore"):
                sums[rows] = row_sums(part)
                part -= sums[rows][..., None] / shape[2]
                squares[rows] = row_sums(np.square(part, out=part))
    check_finite(n_bad, first_bad)
    check_intensities(low, high)
    mean = mean_of(sums, n_voxels)
    # Variance of all voxels: within rows, and between the rows' means (Chan, Golub & LeVeque 1983).
    variance = (squares.sum() + shape[2] * ((sums / shape[2] - mean) ** 2).sum()) / n_voxels
    of_voxels = NoiseSample(sample, near)
    result = Statistics(
        mean, low, high, float(variance), sampled_noise(of_voxels) ** 2, 0.0, is_whole
    )
    scaled = NoiseSample(*((each - mean) / result.scale for each in of_voxels))
    return result._replace(scaled_noise=sampled_noise(scaled) ** 2)


def row_sums(part: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums along the last axis of a contiguous box of voxels, (P, R, K) to (P, R)."""
    return np.asarray(part.sum(axis=-1))


def mean_of(sums: NDArray[np.float64], n_voxels: float) -> float:
    """The mean of `n_voxels` voxels from the sums of all rows, (s_0, s_1)."""
    return float(sums.sum() / n_voxels)
