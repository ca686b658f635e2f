import numpy as np
import pytest
from meshes import both_dimensions, box_corners
from numpy.testing import assert_allclose, assert_array_equal
from shapes import OBLIQUE, channels, grid, labels_alone, shaped

import tetopt
from tetopt import Image
from tetopt.contents.content import content, continue_image, plain
from tetopt.contents.noise import noise_level
from tetopt.energy.sampling import cell_of_voxel, channel_grid, moment_sums, to_ticks
from tetopt.start.sums import channels_of


def variances(target):
    """Of each channel, in the image's unit."""
    return [target.unit * variance(values) for values in channels(target)]


def variance(values):
    return float(np.var(values, dtype=np.float64))


def contrasts(shape=(12, 13, 14)):
    """Three of different scales: two of noise, one of blocks."""
    rng = np.random.default_rng(0)
    blocks = np.kron(rng.integers(0, 5, (3, 4, 4)), np.ones((4, 4, 4)))[tuple(map(slice, shape))]
    first, second = 1000.0 + 300.0 * rng.normal(size=shape), 1e-3 * rng.normal(size=shape)
    return [Image(data) for data in (first, second, blocks)]


def test_an_image_alone_is_itself():
    image = contrasts()[0]
    for target in (content(image), content([image]), plain(image), plain(content(image))):
        assert target.is_plain
        assert target.image is image
        assert np.shares_memory(target.channel(0), image.data)
        assert target.variance == pytest.approx(variance(image.data), rel=1e-12)
        assert (target.n_voxels, target.volume) == (image.data.size, image.volume)


@pytest.mark.parametrize("weights", [None, [1.0, 1.0, 1.0], [1.0, 4.0, 0.25], [0.0, 2.0, 1.0]])
def test_contrasts_count_by_their_weights_not_their_scales(weights):
    images = contrasts()
    target, unit = content(images, weights=weights), variance(images[0].data)
    kept = [(image, w) for image, w in zip(images, weights or [1.0] * 3, strict=True) if w > 0.0]
    assert_allclose(variances(target), [w * unit for _, w in kept], rtol=2e-3)
    for values, (image, _) in zip(channels(target), kept, strict=True):
        assert np.corrcoef(values.ravel(), image.data.ravel())[0, 1] > 0.99999
    assert np.issubdtype(channels(target).dtype, np.integer)


def test_a_rare_label_or_a_bright_voxel_leaves_the_image_its_levels():
    """What is rounded away is far below what is represented."""
    data = np.random.default_rng(0).normal(size=(40, 40, 40))
    labels, rest = np.zeros(data.shape), np.ones(data.shape, dtype=bool)
    labels[20, 20, 20], rest[5, 5, 5], data[5, 5, 5] = 1.0, False, 1e4
    target = content(Image(data), Image(labels))
    rounded = target.channel(0)[rest] * np.sqrt(target.unit) + data.mean()
    off = float(np.std(rounded - data[rest]))
    assert off < 0.01 * data.std()  # the image's, of which the one voxel makes nearly all
    assert np.abs(channels(target)).max() < 2**31 - 1


def labelled(shape=(24, 25, 26)):
    """Labels in slabs, of which only neighbours touch, and one voxel of another."""
    labels = (grid(shape)[..., 0] // 8).astype(int) * 3
    labels[12, 12, 12] = 17
    return Image(labels.astype(float))


def test_labels_are_one_hot():
    labels = labelled()
    target = labels_alone(labels)
    assert target.n_contrasts == 0
    codes = {}
    for label in np.unique(labels.data):
        rows = channels(target)[:, labels.data == label]
        assert (rows == rows[:, :1]).all()  # the same everywhere
        assert np.count_nonzero(rows[:, 0]) == 1  # in one channel
        codes[int(label)] = rows[:, 0]
    assert sum(variances(target)) == pytest.approx(variance(labels.data), rel=2e-3)
    # 0 and 6 are 8 voxels apart and share a channel; those that touch have different ones.
    assert np.argmax(codes[0]) == np.argmax(codes[6])
    assert len({int(np.argmax(codes[k])) for k in (0, 3, 17)}) == 3
    assert codes[17].max() > 3.0 * codes[3].max()  # by the voxel the rare one counts more


@pytest.mark.parametrize("weight", [0.25, 4.0])
def test_labels_count_by_their_weight(weight):
    labels = labelled()
    target = labels_alone(labels, label_weight=weight)
    assert sum(variances(target)) == pytest.approx(weight * variance(labels.data), rel=2e-3)


def test_labels_that_touch_only_in_a_point_are_told_apart():
    labels = np.zeros((8, 8, 8))
    labels[:4, :4, :4], labels[4:, 4:, 4:] = 1, 2
    target = labels_alone(Image(labels))
    assert len({tuple(channels(target)[:, labels == k][:, 0]) for k in (0, 1, 2)}) == 3
    assert len(channels(target)) == 3


def test_sums_of_a_rare_label():
    """One voxel among many is so large a number that squares along a row do not fit 32 bits."""
    data = np.zeros((20, 60, 20))
    data[10, 30, 10] = 1.0
    noise = Image(np.random.default_rng(0).normal(size=data.shape))
    target = content(noise, labels=Image(data), weights=[0.1])
    square = (channels(target).astype(np.float64) ** 2).sum(axis=0)
    assert square.sum(axis=-1).max() > 2**31
    prefix = channel_grid(target, box_corners(data.shape)).prefix
    assert_array_equal(np.diff(prefix[..., 1], axis=2), square)


@both_dimensions
def test_sums_of_channels(n):
    """Counts, sums and the squares of all channels against those over the voxels of each cell."""
    shape = (11, 12, 13)[:n]
    rng = np.random.default_rng(3)
    images, mask = [Image(rng.normal(size=shape)) for _ in range(3)], np.zeros(shape)
    mask[2:9, 2:10] = 1.0
    masked = content(images, mask=Image(mask))
    image, mesh = masked.image, tetopt.lattice_mesh(masked.image, nodes=120)
    owner = cell_of_voxel(image, mesh).ravel()
    flat = channels(masked).reshape(3, -1).astype(float)
    rows = [np.ones(len(owner)), flat[0], (flat**2).sum(axis=0), flat[1], flat[2]]
    rows.append(np.where(masked.region.inside.ravel(), -1.0, 1.0))
    expected = np.stack([np.bincount(owner, row, len(mesh.cells)) for row in rows], axis=1)
    for target, n_rows in ((masked, 6), (masked._replace(region=None), 5)):
        grid_ = channel_grid(target, mesh.points)
        assert grid_.n_channels == 3
        sums = moment_sums(grid_, to_ticks(image.to_index(mesh.points), grid_), mesh.cells)
        assert_array_equal(sums, expected[:, :n_rows])


def test_beyond_a_mask_the_nearest_value_inside_counts():
    image, mask = shaped("ball", OBLIQUE)
    within = mask.data > 0
    far = Image(np.where(within, image.data, -1e6), image.affine)
    target = content(far, mask=mask)
    own = target.image
    assert own.data.min() > -1e3
    for cover in (mask, target.continuation):
        assert_array_equal(continue_image(far, cover).data, own.data)
    # The same place in the world, and the same voxels inside.
    index = image.to_index(own.to_world(grid(own.shape)))
    start = np.rint(index[0, 0, 0]).astype(int)
    assert_allclose(index - start, grid(own.shape), atol=1e-9)
    part = tuple(slice(s, s + n) for s, n in zip(start, own.shape, strict=True))
    inside = within[part]
    assert_array_equal(own.data[inside], image.data[part][inside])
    assert_array_equal(target.region.inside, inside)
    assert target.variance == pytest.approx(variance(image.data[within]), rel=1e-9)
    assert target.n_voxels == inside.sum() == within.sum()
    assert target.volume == pytest.approx(within.sum() * image.voxel_volume)


def test_nearest_is_by_mm():
    """Of long voxels: three columns of 1 mm are nearer than one row of 10 mm."""
    mask, data = np.zeros((2, 6)), np.zeros((2, 6))
    mask[0, 2] = mask[1, 5] = 1.0
    data[0, 2], data[1, 5] = 7.0, 8.0
    affine = np.diag([10.0, 1.0, 1.0])
    assert continue_image(Image(data, affine), Image(mask, affine)).data[1, 2] == 8.0


def test_noise_within_a_mask():
    rng = np.random.default_rng(0)
    inside = np.zeros((40, 40, 40), dtype=bool)
    inside[10:30, 8:32, 8:32] = True
    data = np.where(inside, rng.normal(0.0, 3.0, inside.shape), 40.0 * rng.random(inside.shape))
    assert noise_level(data, inside) == pytest.approx(3.0, rel=0.1)


@pytest.mark.parametrize("shape", [(60, 70), (41, 30, 35)])
@pytest.mark.parametrize("has_mask", [False, True])
def test_noise_of_a_large_image_is_that_of_some_of_its_slices(monkeypatch, shape, has_mask):
    rng = np.random.default_rng(0)
    data = rng.normal(0.0, 3.0, shape) + 20.0 * (np.indices(shape)[0] > 25)
    inside = np.indices(shape)[1] > 6 if has_mask else None
    every = noise_level(data, inside)
    monkeypatch.setattr("tetopt.contents.noise.NOISE_VOXELS", data.size // 6)  # each fifth slice
    some = noise_level(data, inside)
    assert some == pytest.approx(every, rel=0.05)
    assert some != every
    middles = np.arange(1 + (shape[0] - 3) % 5 // 2, shape[0] - 1, 5)
    others = np.setdiff1d(np.arange(shape[0]), [middles - 1, middles, middles + 1])
    assert len(others) > shape[0] // 3
    data[others] *= 10.0
    assert noise_level(data, inside) == some  # those have no say


def test_float_labels_take_some_bytes_a_voxel():
    """Whole numbers in float32, as many tools write them."""
    data = np.zeros((64, 64, 64), dtype=np.float32)
    data[10:50, 10:50, 10:30], data[10:50, 10:50, 30:50] = 3.0, 7.0
    target = labels_alone(Image(data))
    assert channels(target).shape == (3, 64, 64, 64)
    assert target.rows.nbytes <= 4 * data.size  # nothing else is kept for the labels' channels
    assert target.contrasts.size == 0


def filled(value, shape=(12, 13, 14), affine=None):
    return Image(np.full(shape, float(value)), affine)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": []}, "images: expected one or more"),
        ({"weights": [1.0]}, "weights: expected one for each of 3 images"),
        ({"weights": [1.0, 1e200, 1.0]}, "weights: expected one for each of 3 images"),
        ({"weights": [0.0, 0.0, 0.0]}, "weights: every image or label that varies"),
        ({"images": contrasts()[0], "weights": [0.0]}, "weights: every image or label that varies"),
        ({"mask": filled(0)}, "mask: expected voxels of 0.5 or more"),
        (
            {"mask": filled(1, (12, 13, 15))},
            "mask: expected shape (12, 13, 14) like the first, got (12, 13, 15)",
        ),
        ({"mask": filled(1, affine=OBLIQUE)}, "mask: expected the same voxel grid"),
        ({"labels": filled(0)}, "labels: expected labels above 0"),
        ({"labels": filled(1.5)}, "labels: labels must be whole numbers from 0"),
        ({"label_weight": -1.0}, "label_weight: expected 0 or 0.001 to 1000, got -1.0"),
    ],
)
def test_refused(change, message):
    with pytest.raises(tetopt.InputError) as error:
        content(**{"images": contrasts()} | change)
    assert str(error.value).startswith(message)


@both_dimensions
def test_noise_is_of_planes_that_the_mask_has(monkeypatch, n):
    """Two flat lesions between the sampled slices, one of which has a few voxels of a third
    without neighbours.
    """
    shape = (60, 24, 20)[:n]
    data, inside = np.random.default_rng(0).normal(0.0, 2.0, shape), np.zeros(shape, dtype=bool)
    # slices 13 apart, from 3
    monkeypatch.setattr("tetopt.contents.noise.NOISE_VOXELS", data.size // 14)
    inside[8:14] = inside[20:25] = True
    for _ in range(2):
        assert noise_level(data, inside) == pytest.approx(2.0, rel=0.3)
        inside[3, 5] = True
    for thin in (0, 30, -1):
        inside[:] = False
        inside[thin] = True
        masked = content(Image(data), mask=Image(1.0 * inside))
        assert noise_level(data, inside) == masked.noise == channels_of(masked).noise == 0.0


def test_noise_needs_neighbours_within_the_mask_along_all_axes():
    data = np.random.default_rng(0).normal(size=(20, 20, 20))
    for thickness, expected in ((1, 0.0), (3, pytest.approx(1.0, rel=0.2))):
        inside = np.zeros(data.shape, dtype=bool)
        inside[10 : 10 + thickness] = True
        assert noise_level(data, inside) == expected


def test_both_estimates_of_the_noise_within_a_mask_are_one(monkeypatch):
    """That of the octree is of scaled values: for whole masks, for lesions between the slices,
    and for one voxel.
    """
    data = np.random.default_rng(0).normal(0.0, 2.0, (60, 24, 20))
    monkeypatch.setattr("tetopt.contents.noise.NOISE_VOXELS", data.size // 14)
    for part in (np.s_[:], np.s_[6:], np.s_[6:15], np.s_[14], np.s_[3, 4, 5]):
        inside = np.zeros(data.shape)
        inside[part] = 1.0
        masked = content(Image(data), mask=Image(inside))
        scaled = channels_of(masked)
        assert scaled.noise * scaled.scale**2 == pytest.approx(masked.noise, rel=1e-6)
