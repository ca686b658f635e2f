"""Sums over blocks: each block's own voxels, the same bits however the volume is divided."""

import naive
import numpy as np
import pytest
from meshes import mesh_edges
from numpy.testing import assert_array_equal
from shapes import OBLIQUE, grid
from shapes import channels as all_channels

import tetopt
from tetopt import Image
from tetopt.contents.content import content, plain
from tetopt.start.octree import nearest_octree, octree_mesh
from tetopt.start.sums import _add_rows, block_sums, channels_of


def noisy(shape, dtype, noise=6.0):
    place = grid(shape) - 0.4 * np.array(shape)
    data = 100.0 + 300.0 * ((place**2).sum(-1) < (0.25 * min(shape)) ** 2)
    return (data + np.random.default_rng(4).normal(0.0, noise, shape)).astype(dtype)


@pytest.mark.full
@pytest.mark.parametrize("most", [700, 20_000])
@pytest.mark.parametrize(
    ("shape", "dtype", "affine"),
    [
        ((47, 39, 31), np.uint16, None),
        ((31, 37, 43), np.float64, OBLIQUE),
    ],
)
def test_the_octree_does_not_depend_on_slabs(shape, dtype, affine, most, monkeypatch):
    """Slabs of several planes, of one, and of a plane cut into rows."""
    image = Image(noisy(shape, dtype), affine)
    expected = octree_mesh(image, 700)
    monkeypatch.setattr("tetopt.start.sums.PIECE_VOXELS", most)
    mesh = octree_mesh(image, 700)
    assert_array_equal(mesh.points, expected.points)
    assert_array_equal(mesh.cells, expected.cells)


@pytest.mark.parametrize(
    ("shape", "counts"), [((17, 20, 23), (4, 8, 5)), ((6, 5, 9), (12, 5, 16)), ((31, 25), (4, 9))]
)
@pytest.mark.parametrize("is_masked", [False, True])
def test_sums_are_those_of_each_block_s_voxels(shape, counts, is_masked, monkeypatch):
    """Two contrasts, in whole numbers, with and without a mask; also where blocks are smaller
    than voxels.
    """
    monkeypatch.setattr("tetopt.start.sums.PIECE_VOXELS", 3 * shape[-1])
    rng = np.random.default_rng(5)
    images = [Image(rng.integers(0, 50, shape)) for _ in range(2)]
    mask = Image(rng.random(shape) < 0.8) if is_masked else None
    source = plain(content(images, mask=mask))
    channels = channels_of(source)._replace(means=[3.0, -7.0], scale=1.0)
    sums = block_sums(source, channels, np.array(counts))
    h = np.moveaxis(all_channels(source), 0, -1) - channels.means
    inside = np.ones(shape, dtype=bool) if source.inside is None else source.inside
    of_axes = [
        ((np.arange(s) + 0.5) * n / s).astype(int) for s, n in zip(shape, counts, strict=True)
    ]
    for place in np.ndindex(*counts):
        part = np.ix_(*(of_axis == i for of_axis, i in zip(of_axes, place, strict=True)))
        within = h[part][inside[part]]
        assert sums.voxels(slice(None))[place] == inside[part].size
        assert sums.inside is None or sums.inside[place] == len(within)
        assert sums.second[place] == (within**2).sum()
        assert [first[place] for first in sums.firsts] == within.sum(axis=0).tolist()


@pytest.mark.kernel
def test_rows_are_added_as_the_twin_does():
    field = np.random.default_rng(6).normal(size=(2, 5, 7))
    rows, ends, totals = np.array([0, 0, 1, 1, 2]), np.array([0, 3, 3, 7]), np.full((2, 3, 3), 0.5)
    expected = naive.row_totals(field, rows, ends, totals)
    _add_rows(field, rows, ends, totals)
    assert_array_equal(totals, expected)


def test_blocks_are_bounded(monkeypatch):
    """Where the bound counts, leaves are larger."""
    image, shortest = Image(noisy((40, 40, 40), np.uint16)), []
    for most in (64, 2**24):
        monkeypatch.setattr("tetopt.start.octree.MOST_BLOCKS", most)
        mesh = nearest_octree(image, 1500, tetopt.Sizes(longest=np.inf))
        shortest.append(mesh_edges(mesh)[1].min())
    assert shortest[0] > 1.5 * shortest[1]
