"""What labels are: whole numbers; and which of them can be kept in one channel."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.image import Image

LARGEST_LABEL = 32_767  # the largest of 16 bits with a sign, in which many programs keep labels
APART_VOXELS = 4  # labels that come no nearer to one another may share a channel


def check_labels(name: str, labels: Image) -> None:
    """InputError unless the voxels are whole numbers from 0 to `LARGEST_LABEL`."""
    data = labels.data
    wrong = np.argwhere((data < 0) | (data > LARGEST_LABEL) | (np.rint(data) != data))
    if len(wrong):
        first = tuple(int(i) for i in wrong[0])
        raise InputError(
            f"{name}: labels must be whole numbers from 0 to {LARGEST_LABEL}, {len(wrong)} voxels have others, the "
            f"first {data[first]:g} at {first}; is it a label image?"
        )


def label_channels(number: NDArray[np.int64], n_labels: int) -> NDArray[np.int64]:
    """A channel for each label: labels within `APART_VOXELS` voxels of one another have different ones."""
    shape = tuple(-(-s // APART_VOXELS) for s in number.shape)
    block = np.ravel_multi_index(
        np.meshgrid(*[np.arange(s) // APART_VOXELS for s in number.shape], indexing="ij"), shape
    )
    is_in = np.zeros((n_labels, int(np.prod(shape))), dtype=bool)
    is_in[number.ravel(), block.ravel()] = True
    is_beside = np.stack([scipy.ndimage.maximum_filter(row.reshape(shape), size=3).ravel() for row in is_in])
    touches = is_beside.astype(np.float32) @ is_in.T.astype(np.float32) > 0.0
    channel = np.full(n_labels, -1, dtype=np.int64)
    for label in np.argsort(-touches.sum(axis=1), kind="stable"):
        taken = set(channel[touches[label]].tolist())
        channel[label] = next(c for c in range(n_labels) if c not in taken)
    return channel
