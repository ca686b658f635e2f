"""Octrees of stored images: those of the same voxels in memory, to the last bit, from boxes of
bounded size.
"""

import sys

import naive
import numpy as np
import pytest
from shapes import channels as all_channels

import tetopt
from tetopt.contents.content import Content, content, plain
from tetopt.contents.statistics import statistics
from tetopt.start.octree import nearest_octree, octree_mesh
from tetopt.start.sums import _add_rows, block_sums, channels_of

OBLIQUE = np.array(
    [[0.9, 0.3, 0.2, -7.0], [-0.25, 1.1, 0.1, 3.0], [0.0, 0.4, -1.5, 11.0], [0.0, 0.0, 0.0, 1.0]]
)
THICK = np.diag([0.7, 0.8, 2.5, 1.0])


class Recorded:
    """Voxels of an array, and how many each read was of."""

    def __init__(self, data, chunks=None):
        self.data, self.shape, self.dtype, self.chunks, self.reads = (
            data,
            data.shape,
            data.dtype,
            chunks,
            [],
        )

    def __getitem__(self, box):
        part = self.data[box]
        self.reads.append(part.nbytes)
        return part


def noisy(shape, dtype, noise=6.0):
    place = np.stack(
        np.meshgrid(*[np.arange(s) for s in shape], indexing="ij"), -1
    ) - 0.4 * np.array(shape)
    data = 100.0 + 300.0 * ((place**2).sum(-1) < (0.25 * min(shape)) ** 2)
    return (data + np.random.default_rng(4).normal(0.0, noise, shape)).astype(dtype)


def assert_same(mesh, expected):
    np.testing.assert_array_equal(mesh.points, expected.points)
    np.testing.assert_array_equal(mesh.cells, expected.cells)


# Bytes of a read, and voxels of a piece, so that boxes are cut along one axis, and along both.
@pytest.mark.full
@pytest.mark.parametrize("most", [(3_000, 700), (50_000, 20_000)])
@pytest.mark.parametrize(
    ("shape", "dtype", "affine", "chunks"),
    [
        ((47, 39, 31), np.uint16, None, (7, 8, 9)),
        ((40, 33, 45), np.float32, THICK, (1, 33, 45)),
        ((31, 37, 43), np.float64, OBLIQUE, None),
        ((36, 30, 40), np.uint8, None, ((20, 16), (30,), (13, 27))),
    ],
)
def test_octree_is_that_of_voxels_in_memory(shape, dtype, affine, chunks, most, monkeypatch):
    image = tetopt.Image(noisy(shape, dtype), affine)
    expected = octree_mesh(image, 700)
    monkeypatch.setattr("tetopt.image.READ_BYTES", most[0])
    monkeypatch.setattr("tetopt.image.PIECE_VOXELS", most[1])
    voxels = Recorded(noisy(shape, dtype), chunks)
    stored = tetopt.Image.stored(voxels, affine)
    assert_same(octree_mesh(stored, 700), expected)
    assert_same(octree_mesh(image, 700), expected)
    assert max(voxels.reads) <= most[0]
    n_reads = len(voxels.reads)
    assert_same(octree_mesh(Content(stored, statistics=statistics(stored)), 700), expected)
    assert len(voxels.reads) == 2 * n_reads  # its own statistics, which are the octree's


def test_layouts_are_the_same():
    """As NIfTI has it in its files, the first axis fastest: read by rows of all planes."""
    data = noisy((20, 24, 22), np.float32)
    stored = tetopt.Image.stored(np.asfortranarray(data), OBLIQUE)
    boxes = list(stored.boxes())
    assert [box[0] for box in boxes] == [slice(0, 20)] * len(boxes)
    assert_same(octree_mesh(stored, 300), octree_mesh(tetopt.Image(data, OBLIQUE), 300))


@pytest.mark.parametrize(
    ("shape", "itemsize", "chunks", "expected"),
    [
        ((1024, 1024, 1024), 2, (128, 128, 128), (128, 1024)),
        ((2048, 2048, 2048), 2, (128, 128, 128), (128, 512)),
        ((300, 30000, 30000), 2, (1, 512, 512), (1, 4096)),
        ((300, 30000, 30000), 2, None, (1, 4473)),
        ((100, 4, 10**9), 1, (50, 4, 10), (1, 1)),
    ],
)
def test_boxes_are_of_whole_chunks_within_what_may_be_read(shape, itemsize, chunks, expected):
    class Voxels:
        dtype = np.dtype(f"u{itemsize}")

    Voxels.shape, Voxels.chunks = shape, chunks
    boxes = list(tetopt.Image.stored(Voxels).boxes())
    sizes = {tuple(s.stop - s.start for s in box[:2]) for box in boxes}
    assert max(sizes) == expected
    assert sum((i.stop - i.start) * (j.stop - j.start) for i, j, _ in boxes) == shape[0] * shape[1]


@pytest.mark.parametrize(
    "sizes", [tetopt.Sizes(smallest=3.0), tetopt.Sizes(longest=9.0, gradation=0.4)]
)
def test_limits_on_sizes(sizes):
    data = noisy((40, 33, 45), np.uint16)
    stored = tetopt.Image.stored(data, OBLIQUE)
    assert_same(
        nearest_octree(stored, 500, sizes), nearest_octree(tetopt.Image(data, OBLIQUE), 500, sizes)
    )


@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
def test_statistics(dtype):
    data = noisy((31, 37, 43), dtype)
    image, known = tetopt.Image(data), statistics(tetopt.Image.stored(Recorded(data, (7, 5, 9))))
    assert known.noise == plain(image).noise > 1.0
    assert (known.low, known.high) == (data.min(), data.max())
    assert known.mean == pytest.approx(data.mean(dtype=np.float64), rel=1e-14)
    assert known.variance == pytest.approx(plain(image).variance, rel=1e-13)
    assert known.scaled_noise == channels_of(plain(image)).noise
    assert known.is_whole == (dtype is np.uint16)
    assert statistics(tetopt.Image.stored(np.rint(data))).is_whole
    constant = statistics(tetopt.Image.stored(np.full((4, 4, 4), 3, dtype=np.uint8)))
    assert constant == (3.0, 3.0, 3.0, 0.0, 0.0, 0.0, True)
    assert constant.scale == 1.0


@pytest.mark.parametrize(
    ("shape", "counts"), [((17, 20, 23), (4, 8, 5)), ((6, 5, 9), (12, 5, 16)), ((31, 25), (4, 9))]
)
@pytest.mark.parametrize("is_masked", [False, True])
def test_sums_are_those_of_each_block_s_voxels(shape, counts, is_masked, monkeypatch):
    """Two contrasts, in whole numbers, with and without a mask; also where blocks are smaller
    than voxels.
    """
    monkeypatch.setattr("tetopt.image.PIECE_VOXELS", 3 * shape[-1])
    rng = np.random.default_rng(5)
    images = [tetopt.Image(rng.integers(0, 50, shape)) for _ in range(2)]
    mask = tetopt.Image(rng.random(shape) < 0.8) if is_masked else None
    source = plain(content(images, mask=mask))
    channels = channels_of(source)._replace(means=[3.0, -7.0], scale=1.0)
    sums = block_sums(source, channels, np.array(counts))
    h = np.stack(
        [values - mean for values, mean in zip(all_channels(source), channels.means, strict=True)]
    )
    inside = np.ones(shape, dtype=bool) if source.inside is None else source.inside
    for place in np.ndindex(*counts):
        part = tuple(
            (np.floor((np.arange(s) + 0.5) * n / s) == i).nonzero()[0]
            for s, n, i in zip(shape, counts, place, strict=True)
        )
        of_block, within = h[:, *np.ix_(*part)], inside[np.ix_(*part)]
        assert sums.voxels(slice(None))[place] == within.size
        assert sums.inside is None or sums.inside[place] == within.sum()
        assert sums.second[place] == (of_block**2 * within).sum()
        assert [first[place] for first in sums.firsts] == [
            (each * within).sum() for each in of_block
        ]


@pytest.mark.kernel
def test_rows_are_added_as_the_twin_does():
    field = np.random.default_rng(6).normal(size=(2, 5, 7))
    rows, ends, totals = np.array([0, 0, 1, 1, 2]), np.array([0, 3, 3, 7]), np.full((2, 3, 3), 0.5)
    expected = naive.row_totals(field, rows, ends, totals)
    _add_rows(field, rows, ends, totals)
    np.testing.assert_array_equal(totals, expected)


def spoiled(value, dtype=np.float32):
    data = noisy((12, 12, 12), dtype)
    data[7, 3, 5] = data[9, 1, 1] = value
    return data


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (spoiled(np.nan), r"2 voxels are NaN or infinite, the first at index \(7, 3, 5\)"),
        (spoiled(1e160, np.float64), "squares would overflow"),
        (noisy((12, 12, 12), np.complex64), "complex"),
        (np.zeros((12, 12, 12), dtype=[("R", "u1"), ("G", "u1")]), "RGB"),
    ],
)
def test_voxels_that_no_image_takes(data, words, monkeypatch):
    monkeypatch.setattr("tetopt.image.READ_BYTES", 3 * 12 * data.itemsize)
    with pytest.raises(tetopt.InputError, match=words) as stored:
        octree_mesh(tetopt.Image.stored(Recorded(data, (12, 4, 12))), 100)
    with pytest.raises(tetopt.InputError) as in_memory:
        octree_mesh(tetopt.Image(data), 100)
    assert str(stored.value) == str(in_memory.value)


@pytest.mark.parametrize(
    "sizes", [tetopt.Sizes(edge_size=5.0), tetopt.Sizes(field=tetopt.Image(np.ones((2, 2, 2))))]
)
def test_targets_take_voxels_in_memory(sizes):
    voxels = Recorded(noisy((12, 12, 12), np.uint8))
    with pytest.raises(
        tetopt.InputError, match=r"largest and field .* this image is stored; use smallest, longest"
    ):
        octree_mesh(tetopt.Image.stored(voxels), 100, sizes)
    assert voxels.reads == []


def test_blocks_are_bounded(monkeypatch):
    """The bound is the same in memory and stored, and where it bounds, leaves are larger."""
    data, sizes, shortest = noisy((40, 40, 40), np.uint16), tetopt.Sizes(longest=np.inf), []
    for most in (64, 2**24):
        monkeypatch.setattr(sys.modules["tetopt.start.octree"], "MOST_BLOCKS", most)
        mesh = nearest_octree(tetopt.Image.stored(data), 1500, sizes)
        assert_same(mesh, nearest_octree(tetopt.Image(data), 1500, sizes))
        shortest.append(
            np.linalg.norm(
                mesh.points[mesh.cells[:, 1]] - mesh.points[mesh.cells[:, 0]], axis=1
            ).min()
        )
    assert shortest[0] > 1.5 * shortest[1]
