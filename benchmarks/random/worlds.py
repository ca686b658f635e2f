"""Random images, masks and labels on random grids: sheared, flipped, with thick slices; one
seed, one world.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

import tetopt

KINDS_OF_IMAGE = ("noise", "smooth", "steps", "spike", "whole")
KINDS_OF_MASK = ("none", "none", "blob", "blob", "ball", "half", "corner", "all")


class World(NamedTuple):
    """What a run is about."""

    image: tetopt.Image
    more: list[tetopt.Image]  # further contrasts
    mask: tetopt.Image | None
    labels: tetopt.Image | None
    words: str

    def content(self, **options):
        """The content of a mesh; the image alone where there is nothing else."""
        if not self.more and self.mask is None and self.labels is None:
            return self.image
        return tetopt.content([self.image, *self.more], self.labels, self.mask, **options)


def random_affine(rng, n):
    """Voxels to mm: axes permuted and flipped, mostly turned and sheared, up to four times as
    thick as wide.
    """
    steps = rng.uniform(0.5, 2.0) * rng.uniform(0.5, 2.0, n)
    matrix = np.eye(n)[rng.permutation(n)] * rng.choice([-1.0, 1.0], n)
    if rng.random() < 0.7:
        matrix = matrix @ np.linalg.qr(rng.normal(size=(n, n)))[0]
    if rng.random() < 0.6:
        matrix = matrix @ (
            np.eye(n) + np.triu(rng.uniform(-1.2, 1.2, (n, n)), 1)[rng.permutation(n)]
        )
        if abs(np.linalg.det(matrix)) < 0.2:  # a grid so flat has no voxels to speak of
            matrix = np.eye(n) + np.triu(rng.uniform(-1.2, 1.2, (n, n)), 1)
    affine = np.eye(n + 1)
    affine[:n, :n], affine[:n, n] = matrix * steps, rng.uniform(-100.0, 100.0, n)
    return affine


def sharpest_edge(affine):
    """The smallest dihedral angle of a grid's box, degrees: no mesh of it has a larger one."""
    inward = np.linalg.inv(affine[:-1, :-1])
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    cosines = np.abs(inward @ inward.T)[np.triu_indices(len(inward), 1)]
    return float(np.degrees(np.arccos(np.clip(cosines, 0.0, 1.0))).min())


def field(rng, shape, sigma):
    """A smooth random function, of variance 1."""
    data = scipy.ndimage.gaussian_filter(rng.normal(size=shape), sigma, mode="nearest")
    return (data - data.mean()) / (data.std() or 1.0)


def random_data(rng, shape, kind):
    """Intensities of a kind."""
    if kind == "noise":
        return rng.normal(100.0, 20.0, shape)
    if kind == "smooth":
        return 50.0 + 10.0 * field(rng, shape, 3.0)
    if kind == "steps":
        return 40.0 * (field(rng, shape, 2.5) > 0.0) + 20.0 * (field(rng, shape, 4.0) > 0.5)
    if kind == "spike":
        data = field(rng, shape, 2.0)
        data[tuple(rng.integers(0, shape))] = 1e4
        return data
    return rng.integers(0, 12, shape).astype(float)


def random_mask(rng, shape, kind):
    """Voxels of a kind; a blob, a ball and a half mostly touch several of the box's sides."""
    n, index = len(shape), np.indices(shape)
    size = np.array(shape).reshape(-1, *(1,) * len(shape))
    if kind == "all":
        return np.ones(shape, dtype=bool)
    if kind == "blob":
        data = field(rng, shape, rng.uniform(2.0, 4.0))
        return data > np.quantile(data, rng.uniform(0.2, 0.8))
    if kind == "ball":
        centre = rng.uniform(-0.1, 1.1, n).reshape(size.shape) * size
        return (((index - centre) / size) ** 2).sum(axis=0) < rng.uniform(0.3, 0.7) ** 2
    if kind == "half":
        normal = rng.normal(size=n).reshape(size.shape)
        height = (normal * (index / size - 0.5)).sum(axis=0)
        return height < rng.uniform(-0.2, 0.3)
    axes = rng.random(n) < 0.7  # "corner": a cube that touches some of the sides
    low = np.where(axes, 0, np.array(shape) // 4)
    high = np.where(rng.random(n) < 0.2, shape, np.array(shape) * 2 // 3)
    return np.all([(index[d] >= low[d]) & (index[d] < high[d]) for d in range(n)], axis=0)


def random_labels(rng, shape):
    """Whole numbers: pieces around random places, on a background of label 0."""
    count = int(rng.integers(2, 9))
    places = rng.uniform(0.0, 1.0, (count, len(shape))) * shape
    index = np.indices(shape).reshape(len(shape), -1).T
    warped = index + 1.5 * np.column_stack([field(rng, shape, 3.0).ravel() for _ in shape])
    nearest = ((warped[:, None] - places) ** 2).sum(axis=2).argmin(axis=1).reshape(shape)
    numbers = np.append(0, rng.choice(np.arange(1, 60), count - 1, replace=False))
    labels = numbers[nearest]
    if rng.random() < 0.4:
        labels[field(rng, shape, 3.0) > rng.uniform(0.0, 1.0)] = 0
    return labels.astype(float)


def random_world(rng, n=None, largest=22, needs_mask=False, needs_labels=False):
    """A world of 2 or 3 dimensions."""
    n = int(rng.choice([2, 3, 3])) if n is None else n
    shape = tuple(rng.integers(9, (largest if n == 3 else 2 * largest) + 1, n).tolist())
    affine = random_affine(rng, n)
    kind = str(rng.choice(KINDS_OF_IMAGE))
    image = tetopt.Image(random_data(rng, shape, kind), affine)
    more = [
        tetopt.Image(random_data(rng, shape, "smooth"), affine)
        for _ in range(int(rng.random() < 0.2))
    ]
    of_mask = str(rng.choice(KINDS_OF_MASK[2:] if needs_mask else KINDS_OF_MASK))
    mask = None
    if of_mask != "none" and (inside := random_mask(rng, shape, of_mask)).sum() > 200:
        mask = tetopt.Image(1.0 * inside, affine)
    labels = (
        tetopt.Image(random_labels(rng, shape), affine)
        if needs_labels or rng.random() < 0.35
        else None
    )
    if (
        labels is not None
        and len(np.unique(labels.data if mask is None else labels.data[inside])) < 2
    ):
        labels = None
    words = f"{n}-D {shape} {kind}, mask {of_mask if mask is not None else 'none'}"
    words += f", {1 + len(more)} contrasts" + ("" if labels is None else ", labels")
    return World(image, more, mask, labels, words)
