"""Masks whose pieces, holes and handles are known."""

import numpy as np

import tetopt

OBLIQUE = np.array([[0.9, 0.2, -0.1, -20.0], [-0.2, 1.1, 0.3, 7.0], [0.1, -0.2, 1.4, 3.0], [0.0, 0.0, 0.0, 1.0]])


def grid(shape):
    """Index of every voxel, (*shape, n)."""
    return np.stack(np.meshgrid(*[np.arange(s) for s in shape], indexing="ij"), axis=-1).astype(float)


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
    image = tetopt.Image(50.0 + 20.0 * np.sin(0.5 * at[..., 0]) + 15.0 * np.cos(0.4 * at[..., 1] + at[..., 2]), affine)
    return image, tetopt.Image(1.0 * mask, affine)
