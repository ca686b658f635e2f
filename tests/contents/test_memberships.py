import naive
import numpy as np
import pytest
from meshes import box_corners
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates
from scipy.ndimage import label as components
from shapes import OBLIQUE, distance, grid
from threads import assert_same_bits

import tetopt
from tetopt import Image
from tetopt.contents.align import divide_voxels
from tetopt.contents.memberships import (
    finer,
    finer_affine,
    labels_at,
    memberships,
    number_labels,
    supersampling,
)
from tetopt.contents.smoothing import FARTHEST_DISTANCE, raw_level


def between(members, first, second):
    """The level that is 0 on the interface of two labels, below 0 in the first."""
    rows = [int(np.flatnonzero(members.labels == value)[0]) for value in (first, second)]
    return members.levels[members.channel[rows[0]]] - members.levels[members.channel[rows[1]]]


def steps_to(level, start, way):
    """On each line start + step * way the step at which the level turns positive."""
    steps = np.linspace(-0.95, 0.95, 191)
    at = (start[:, None] + steps[:, None] * way[:, None]).reshape(-1, 3).T
    values = map_coordinates(level, at, order=1).reshape(len(start), -1)
    assert (values[:, 0] < 0.0).all()
    assert (values[:, -1] > 0.0).all()
    return steps[np.argmax(values > 0.0, axis=1)]


def bumpy(points):
    """Labels of an organ with bumps and a sphere in it, at points (..., 3), mm; and the distance
    to the sphere.
    """
    r = np.linalg.norm(points, axis=-1) + 1e-9
    x, y, z = np.moveaxis(points / r[..., None], -1, 0)
    outer = 28.0 + 7.5 * (4.0 * x * y * (x * x - y * y)) + 6.0 * (x * x - y * y) * z
    inner = np.linalg.norm(points - [3.0, -2.0, 4.0], axis=-1) - 12.0
    return np.where(inner < 0.0, 8.0, np.where(r < outer, 3.0, 0.0)), inner


def voxelised(spacing, shape):
    """The labels of `bumpy` on voxels of these edges, mm."""
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = 0.37 - 0.5 * (np.array(shape) - 1.0) * spacing
    return Image(bumpy(grid(shape) * spacing + affine[:3, 3])[0], affine)


def dice(first, second):
    return 2.0 * (first & second).sum() / (first.sum() + second.sum())


def test_every_voxel_keeps_its_label():
    rng = np.random.default_rng(0)
    for shape in [(9, 10, 11), (17, 16)]:
        labels = rng.choice([0, 3, 4, 90], size=shape)
        members = memberships(Image(labels))
        assert_array_equal(members.labels, [0, 3, 4, 90])
        assert_array_equal(members.labels[members.partition], labels)
        assert_array_equal(members.levels.argmin(axis=0), members.channel[members.partition])


@pytest.mark.parametrize("n_labels", [180, 181])
def test_numbers_of_labels_leave_room_for_those_of_pairs(n_labels):
    labels = np.arange(200).reshape(10, 20) % n_labels * 3
    values, rows = number_labels(Image(labels))
    assert_array_equal(values[rows], labels)
    of_pairs = [(n_labels + 1) * each + n_labels for each in (rows, rows.astype(np.int64))]
    assert_array_equal(*of_pairs)


@pytest.mark.parametrize("shape", [(19, 5, 4), (22, 9)])
def test_a_level_as_by_its_plain_twin(shape):
    at = grid(shape)
    inside = at[..., 0] < 9.3 + 0.2 * at[..., 1]
    inside[14, 2], inside[3, 1] = True, False
    members = memberships(Image(1.0 * inside))
    assert_allclose(members.levels[members.channel[1]], naive.smooth_level(inside), atol=2e-5)


@pytest.mark.parametrize("shape", [(19, 5, 4), (22, 9), (3, 40, 2), (1, 7, 30)])
def test_distances_are_scipys_to_the_last_bit(shape):
    rng = np.random.default_rng(0)
    for fraction in (0.5, 0.97, 0.995):
        inside = rng.random(shape) < fraction
        inside.flat[3] = False
        near, far = (
            np.minimum(distance_transform_edt(side), FARTHEST_DISTANCE)
            for side in (inside, ~inside)
        )
        twin = np.where(inside, 0.5 - near.astype(np.float32), far.astype(np.float32) - 0.5)
        assert raw_level(inside).tobytes() == twin.tobytes()


def test_an_interface_of_two_labels_is_that_of_each():
    """Inside a ball cut by a plane: a sphere outside, and the plane where they meet, without a
    gap between them.
    """
    centre, normal = np.array([19.6, 20.2, 19.8]), np.array([0.31, 0.42, 0.85])
    normal /= np.linalg.norm(normal)
    at = grid((40, 40, 40)) - centre
    in_ball = np.linalg.norm(at, axis=-1) < 15.0
    members = memberships(Image(np.where(in_ball, np.where(at @ normal < 0, 1, 2), 0)))
    side = np.linalg.svd(normal[None])[2][1:]
    start = centre + np.random.default_rng(0).uniform(-8.0, 8.0, size=(2000, 2)) @ side
    off = steps_to(between(members, 1, 2), start, np.tile(normal, (2000, 1)))
    assert np.abs(off).mean() < 0.08
    assert np.abs(off).max() < 0.3
    there = (start + off[:, None] * normal).T
    others = map_coordinates(members.levels[members.channel[0]], there, order=1)
    assert others.min() > 1.0  # the background does not come between them
    way = np.random.default_rng(0).normal(size=(3000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    for label, is_part in ((1, way @ normal < -0.3), (2, way @ normal > 0.3)):
        level = between(members, label, 0)
        off = steps_to(level, centre + 15.0 * way[is_part], way[is_part])
        assert np.abs(off).mean() < 0.08


@pytest.mark.parametrize(
    ("spacing", "factors"),
    [((0.9, 0.9, 5.0), (1, 1, 5)), ((6.5, 1.0, 1.0), (7, 1, 1)), ((1.0, 1.4), (1, 1))],
)
def test_supersampling(spacing, factors):
    assert supersampling(np.array(spacing)) == factors


@pytest.mark.parametrize("factors", [(1, 1, 1), (1, 1, 5), (2, 1, 3)])
def test_finer_voxels_fill_the_same_box(factors):
    image = Image(grid((4, 5, 6)) @ [1.0, -2.0, 3.0], OBLIQUE)
    fine = finer(image, factors)
    assert fine.shape == tuple(np.multiply(image.shape, factors))
    corners, there = (each.to_world(box_corners(each.shape)) for each in (image, fine))
    assert_allclose(there, corners, atol=1e-9)
    at = np.clip(image.to_index(fine.to_world(grid(fine.shape))), 0.0, np.array(image.shape) - 1.0)
    assert_allclose(fine.data, at @ [1.0, -2.0, 3.0], atol=1e-5)


@pytest.mark.full
@pytest.mark.parametrize(
    ("spacing", "shape"), [((0.9, 0.9, 5.0), (80, 80, 16)), ((0.9, 5.0, 0.9), (80, 16, 80))]
)
def test_thick_slices_do_not_show(spacing, shape):
    image = voxelised(spacing, shape)
    factors = supersampling(image.spacing)
    members = memberships(image, factors)
    labels = members.labels[members.partition]
    planes = tuple(slice(factor // 2, None, factor) for factor in factors)
    assert_array_equal(labels[planes], image.data)  # each slice keeps what it has
    affine = finer_affine(image.affine, factors)
    true, inner = bumpy(grid(labels.shape) * np.diag(affine)[:3] + affine[:3, 3])
    nearest = divide_voxels(image, factors).data
    for value in (3, 8):
        own, expected, steps = (each == value for each in (labels, true, nearest))
        assert 1.0 - dice(own, expected) < min(0.03, 0.35 * (1.0 - dice(steps, expected)))
        assert own.sum() == pytest.approx(steps.sum(), rel=0.02)
        assert components(own)[1] == 1
    beside = (np.abs(between(members, 8, 3)) < 0.5) & (members.levels[members.channel[1]] < 1.0)
    assert np.abs(inner[beside]).mean() < 0.4


def thick_memberships(labels, spacing=5):
    """Of slices several times as thick as voxels are wide."""
    affine = np.diag([1.0, 1.0, spacing, 1.0])
    return memberships(Image(labels, affine), (1, 1, spacing)).partition


def test_a_piece_that_ends_between_slices_is_rounded():
    """A disc on one slice of five voxels keeps its height and nearly its volume, and its rims
    are round.
    """
    labels = np.zeros((30, 30, 5))
    labels[..., 2] = distance((30, 30), 14.6, 14.2) < 10.0
    area, disc = (thick_memberships(labels) == 1).sum(axis=(0, 1)), labels.sum()
    assert area[12] == disc
    assert np.flatnonzero(area).tolist() == [10, 11, 12, 13, 14]
    assert 0.6 * disc < area[10] < 0.9 * disc
    assert area[10] < area[11] <= disc
    assert_allclose(area, area[::-1], atol=2)
    assert area.sum() == pytest.approx(5.0 * disc, rel=0.1)


def test_labels_get_no_pieces_between_slices():
    """What two slices have in common stays between them, and nothing is there that no slice has."""
    fields = np.random.default_rng(2).normal(size=(6, 40, 40, 9))
    labels = gaussian_filter(fields, (0.0, 2.0, 2.0, 0.4)).argmax(axis=0)
    partition = thick_memberships(labels)
    for k in range(8):
        same = labels[..., k] == labels[..., k + 1]
        for fine in range(5 * k + 2, 5 * k + 8):
            assert_array_equal(partition[same][:, fine], labels[same][:, k])
    for row in range(6):
        piece, n = components(partition == row)
        assert set(piece[..., 2::5].ravel()) | {0} == set(range(n + 1))


def test_the_same_on_any_number_of_threads():
    image = voxelised((1.5, 1.5, 4.5), (44, 44, 16))
    assert_same_bits(lambda: memberships(image, (1, 1, 3)))


def test_labels_must_be_whole_numbers():
    with pytest.raises(tetopt.InputError, match="labels must be whole numbers from 0"):
        memberships(Image(np.array([[0.0, 1.5], [2.0, 3.0]])))


def test_a_rod_of_one_voxel_between_two_labels_keeps_its_volume():
    """Each of its neighbours' levels is right for its neighbour alone, and together they leave
    less for the rod.
    """
    i, j, k = np.indices((24, 24, 24))
    labels = np.where(i + j < 23, 1, 2)
    # diagonal, where the two others meet
    labels[(i + j >= 22) & (i + j <= 23) & (abs(i - j - k + 12) <= 2)] = 3
    members = memberships(Image(labels.astype(float)))
    assert (members.labels[members.partition] == labels).all()
    place = 0.25 * grid((96, 96, 96)).reshape(-1, 3) - 0.375
    cells = np.repeat(np.arange(len(place))[:, None], 4, axis=1)
    row = labels_at(members, place, cells, np.eye(1, 4))
    fractions = np.bincount(row.ravel()) / 64.0 / np.bincount(labels.ravel())[1:]
    assert_allclose(fractions[:2], 1.0, atol=0.01)
    assert fractions[2] == pytest.approx(1.0, abs=0.05)
