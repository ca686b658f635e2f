"""Masks whose pieces, holes and handles are known; and the numbers of a watertight surface."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import tetopt

OBLIQUE = np.array(
    [[0.9, 0.2, -0.1, -20.0], [-0.2, 1.1, 0.3, 7.0], [0.1, -0.2, 1.4, 3.0], [0.0, 0.0, 0.0, 1.0]]
)


def grid(shape):
    """Index of every voxel, (*shape, n)."""
    return np.stack(np.meshgrid(*[np.arange(s) for s in shape], indexing="ij"), axis=-1).astype(
        float
    )


def distance(shape, *centre):
    return np.linalg.norm(grid(shape) - np.array(centre), axis=-1)


def shaped(kind, affine=None):
    """An image of smooth content, and a mask of 0 and 1."""
    shape = (28, 30, 32)
    at = grid(shape)
    if kind == "ball":
        mask = distance(shape, 13.3, 14.1, 15.7) < 11.0
    elif kind == "pieces":
        mask = (distance(shape, 7.2, 8.0, 8.0) < 5.5) | (distance(shape, 20.0, 20.6, 22.0) < 6.5)
    elif kind == "hole":
        r = distance(shape, 13.3, 14.1, 15.7)
        mask = (r < 12.0) & (r > 5.5)
    elif kind == "handle":  # a torus
        ring = np.hypot(at[..., 0] - 13.6, at[..., 1] - 14.4) - 8.5
        mask = np.hypot(ring, at[..., 2] - 15.2) < 4.2
    elif kind == "touching":
        mask = distance(shape, 0.0, 14.1, 15.7) < 11.0
    elif kind == "sheet":
        mask = np.zeros(shape, dtype=bool)
        mask[4:24, 5:25, 16] = True
    else:
        raise ValueError(kind)
    image = tetopt.Image(
        50.0 + 20.0 * np.sin(0.5 * at[..., 0]) + 15.0 * np.cos(0.4 * at[..., 1] + at[..., 2]),
        affine,
    )
    return image, tetopt.Image(1.0 * mask, affine)


def volume_and_area(surface):
    """Enclosed volume in mm^3, cavities left out, by the divergence theorem, and area in mm^2
    with their walls.
    """
    # far from the origin its digits would cancel
    centred = surface.points - surface.points.mean(axis=0)
    a, b, c = centred[surface.triangles.T]
    across = np.cross(b - a, c - a)
    return float((a * across).sum() / 6.0), float(np.linalg.norm(across, axis=1).sum() / 2.0)


def n_pieces(surface):
    """Number of closed surfaces that are not connected; a cavity's wall counts as one."""
    first, second, third = surface.triangles.T
    one, other = np.append(first, first), np.append(second, third)
    graph = coo_array((np.ones(len(one)), (one, other)), shape=(len(surface.points),) * 2)
    return len(np.unique(connected_components(graph, directed=False)[1][first]))


def channels(content):
    """All channels of a content, (C, *shape)."""
    return np.stack([content.channel(number) for number in range(content.n_channels)])


def labels_alone(labels, **options):
    """Content of labels without a contrast."""
    return tetopt.content(labels, labels, weights=[0.0], **options)


def ball_image(shape, centre, radius, affine=None):
    """1 in a ball, 0 around it."""
    return tetopt.Image(1.0 * (distance(shape, *centre) < radius), affine)
