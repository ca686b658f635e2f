"""Estimates of the memory of meshing, from sizes that are known before it begins.

The bytes per channel and cell were fitted to the peaks of 60 measured runs; with `BOUND_MARGIN`,
they exceed these peaks. A run with labels of 7 million voxels has taken 23 % more.
"""

from __future__ import annotations

from math import prod

from tetopt.contents.content import Content

KERNEL_BYTES = 2.5e8  # numba's compiler, all kernels if not yet loaded, and buffers: at most 220 MB
CHANNEL_BYTES = 8.266  # per voxel and channel, in the octree, later in prefix sums
MESHED_CELL_BYTES = 617.8  # with fluxes and sums
BOUND_MARGIN = 1.5  # so that estimates exceed the peaks of the runs that they were fitted to
# Of a whole process, besides meshing: Python and libraries, and by voxel the image, its mask, its
# labels' levels.
PROCESS_BYTES = 1.6e8
READ_BYTES, REGION_BYTES, LABEL_BYTES = 12.0, 33.0, 85.0
# of the cells' memory: the additional memory of an exchange or the end of a run
NEXT_FRACTION = 0.3
CELLS_PER_NODE = {2: 2, 3: 6}  # in large meshes, by dimension


def meshing_bytes(n_voxels: int, n_channels: int, n_nodes: int, ndim: int = 3) -> float:
    """Estimate of the peak memory of meshing beyond that in use once files are read.

    Parameters
    ----------
    n_voxels, n_channels : int
        Numbers of meshed voxels and channels.
    n_nodes : int
        Number of nodes of the mesh of order 1; 0 for the memory of the image alone.
    ndim : int
        Dimension of the image.
    """
    n_bytes = CHANNEL_BYTES * (n_voxels * n_channels) + MESHED_CELL_BYTES * (
        CELLS_PER_NODE[ndim] * n_nodes
    )
    return KERNEL_BYTES + BOUND_MARGIN * n_bytes


def bytes_of(content: Content, nodes: int) -> float:
    """Additional memory for meshing a content with `nodes` nodes; see `meshing_bytes`."""
    image = content.image
    return meshing_bytes(
        prod(image.shape), content.n_channels + (content.region is not None), nodes, image.ndim
    )


def next_bytes(n_nodes: int, ndim: int = 3) -> float:
    """Estimate of the additional memory of the next steps of a run with `n_nodes` nodes."""
    return NEXT_FRACTION * (meshing_bytes(0, 0, n_nodes, ndim) - KERNEL_BYTES)
