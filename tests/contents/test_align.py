"""Masks, labels and contrasts land on the image's voxels by the affines; the foreground is what
it should be.
"""

import re

import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose, assert_array_equal
from shapes import distance, grid

import tetopt
from tetopt import Image, content
from tetopt.contents.align import (
    background_level,
    divide_voxels,
    divisions,
    foreground_mask,
    resample_contrast,
    resample_labels,
    resample_mask,
)

SHAPE, OTHER = (7, 9, 6), (8, 6, 7)


def turned(spacing, angles=(0, 0, 0), flips=(1, 1, 1)):
    """Affine of voxels of that spacing, turned about each axis and flipped; the grids' middles
    are close.
    """
    linear = np.eye(3)
    for axis, angle in enumerate(angles):
        i, k = (a for a in range(3) if a != axis)
        turn = np.eye(3)
        turn[i, i] = turn[k, k] = np.cos(angle)
        turn[i, k], turn[k, i] = -np.sin(angle), np.sin(angle)
        linear = turn @ linear
    return centred(linear * np.multiply(spacing, flips))


def centred(linear):
    affine = np.eye(4)
    affine[:3, :3] = linear
    affine[:3, 3] = np.array([3.3, 3.6, 2.7]) - linear @ ((np.array(OTHER) - 1) / 2)
    return affine


# Affines of the image and of the other.
PAIRS = {
    "shifted": (np.eye(4), turned((1, 1, 1))),
    "anisotropic": (np.diag([1.0, 0.9, 1.1, 1.0]), turned((0.8, 1.3, 0.7))),
    "flipped": (np.eye(4), turned((1.1, 1.1, 1.1), flips=(-1, 1, -1))),
    "oblique": (np.eye(4), turned((1.2, 1.0, 1.3), (-0.2, 0.4, 0.3), (1, -1, 1))),
    "permuted": (np.eye(4), centred(np.array([[0, 0, -1.0], [1.1, 0, 0], [0, 1.2, 0]]))),
}
MOVE = turned((0.7, 1.6, 1.2), (0.3, -0.5, 0.8))  # both at once: the image is oblique as well
PAIRS["both oblique"] = (MOVE @ PAIRS["oblique"][0], MOVE @ PAIRS["oblique"][1])
PAIRS["in a plane"] = (np.eye(3), np.array([[0.0, -2.0, 9.3], [1.0, 0.0, 0.8], [0, 0, 1]]))


def nearest_twin(other, image):
    """Voxel by voxel: through the world, into the box around the voxel it falls in, lower face
    included.
    """
    values = np.zeros(image.shape)
    for voxel in np.ndindex(image.shape):
        # ties go up
        index = np.floor(other.to_index(image.to_world(voxel)) + 0.5 + 1e-6).astype(int)
        if (index >= 0).all() and (index < other.shape).all():
            values[voxel] = other.data[tuple(index)]
    return values


def linear_twin(other, image):
    """Voxel by voxel: the eight (four) voxels around, the index held to the centres of the
    border.
    """
    values = np.zeros(image.shape)
    for voxel in np.ndindex(image.shape):
        index = np.clip(other.to_index(image.to_world(voxel)), 0, np.array(other.shape) - 1)
        low = np.minimum(np.floor(index).astype(int), np.array(other.shape) - 2)
        part = index - low
        for corner in np.ndindex((2,) * image.ndim):
            weight = np.prod(np.where(corner, part, 1 - part))
            values[voxel] += weight * other.data[tuple(low + corner)]
    return values


def pair(which, values):
    image_affine, affine = PAIRS[which]
    rng, n = np.random.default_rng(3), len(affine) - 1
    return Image(np.zeros(SHAPE[:n]), image_affine), Image(values(rng, OTHER[:n]), affine)


def align(function, other, image, name="x", **options):
    """An image's data on the voxels of another one, of whose affine they are."""
    aligned = function(other, image, name, **options)
    assert_array_equal(aligned.affine, image.affine)
    return aligned.data


def message(function, *args):
    """What a function says of its arguments."""
    with pytest.raises(tetopt.InputError) as caught:
        function(*args)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("which", PAIRS)
def test_nearest_is_its_twin(which):
    """Labels, a 0/255 mask and a probability map, each voxel the one whose box it lies in, 0
    outside all of them.
    """
    image, labels = pair(which, lambda rng, shape: rng.integers(1, 9, shape))
    expected = nearest_twin(labels, image)
    assert 0 < np.count_nonzero(expected == 0) < expected.size  # both inside and outside are tried
    assert_array_equal(align(resample_labels, labels, image), expected)
    for values, unit in ((255 * (labels.data > 4), 255), (labels.data / 16, 1)):
        mask = Image(values, labels.affine)
        assert_array_equal(align(resample_mask, mask, image), nearest_twin(mask, image) / unit)


@pytest.mark.parametrize("which", PAIRS)
def test_linear_is_its_twin(which):
    image, other = pair(which, lambda rng, shape: rng.normal(size=shape).astype(np.float32))
    moved = align(resample_contrast, other, image)
    assert_allclose(moved, linear_twin(other, image), atol=1e-6)


def _translation(*shift):
    return np.vstack([np.column_stack([np.eye(3), shift]), [0, 0, 0, 1]])


def test_same_grid_is_taken_as_it_is():
    """Up to 1e-4 voxel, and not beyond: there a value near a voxel's border comes from its
    neighbour.
    """
    affine, data = PAIRS["both oblique"][0], np.random.default_rng(0).normal(size=SHAPE)
    image, data = Image(np.zeros(SHAPE), affine), data.astype(np.float32)
    near, far = (
        align(resample_contrast, Image(data, affine @ _translation(x, 0, 0)), image)
        for x in (9e-5, 2e-3)
    )
    assert_array_equal(near, data)
    assert 1e-4 < np.abs(far - data).max() < 2e-2
    numbers = np.arange(1, 1 + data.size).reshape(SHAPE)
    moved = align(resample_labels, Image(numbers, affine @ _translation(0, 2, 0)), image)
    assert_array_equal(moved, np.pad(numbers, ((0, 0), (2, 0), (0, 0)))[:, :-2])


@pytest.mark.parametrize("spacing", [1.0, 0.1, 0.7])
@pytest.mark.parametrize("sign", [1, -1])
def test_grid_shifted_by_half_a_voxel(spacing, sign):
    """Every centre lies halfway between two voxels: all take the upper one, and the box is half
    open.
    """
    affine = np.diag([spacing] * 3 + [1.0])
    affine[:3, 3] = 17.3
    numbers = np.arange(1, 361).reshape(40, 3, 3)
    labels = Image(numbers, affine @ _translation(-0.5 * sign, 0, 0))
    moved = align(resample_labels, labels, Image(np.zeros(labels.shape), affine))
    # index i + 1/2: the upper is i + 1, the last is on the upper face, outside; index i - 1/2: the
    # upper is i, the first on the lower face, inside
    expected = np.pad(numbers, ((0, 1), (0, 0), (0, 0)))[1:] if sign > 0 else numbers
    assert_array_equal(moved, expected)


def test_labels_without_a_voxel_in_the_image_or_mask_are_named(recwarn):
    """The largest first; neither 0 nor what the image's voxels keep in part, nor a label lost
    between larger ones.
    """
    labels = np.zeros((20, 12))
    labels[:12, :6], labels[10:, 9:] = 3.0, 50.0
    labels[14:, :8] = np.arange(48).reshape(6, 8) // 8 + 20.0
    labels[15, 1], labels[3, 9] = 3.0, 8.0
    whole, image = Image(labels), Image(np.zeros((11, 12)))
    tetopt.resample_labels(whole, image, "l")
    tetopt.resample_labels(whole, Image(np.zeros((20, 12))), "l")
    tetopt.resample_labels(whole, image, "left out on purpose", may_miss=True)
    mask = Image(np.arange(20)[:, None] + np.zeros((20, 12)) < 15)
    content(whole, whole, mask)
    content(whole, whole, Image(labels > 0.0))
    sizes = ", ".join(f"{label} (8 voxels)" for label in (20, 22, 23, 24, 25))
    assert [str(each.message) for each in recwarn] == [
        f"l: labels without a voxel in the image: {sizes} and 1 more",
        f"labels without a voxel in the mask: {sizes.removeprefix('20 (8 voxels), ')}, 21 (7 "
        "voxels)",
    ]


def test_a_label_that_falls_between_voxels_of_its_size_is_told():
    """A voxel in the middle of a cell of the grid turned by 45 degrees."""
    labels, affine = np.ones((5, 5)), np.eye(3)
    labels[2, 2] = 3.0
    affine[:2, :2] = np.sqrt(0.5) * np.array([[1.0, -1.0], [1.0, 1.0]])
    affine[:2, 2] = 2.0 - affine[:2, :2] @ [3.5, 3.5]
    with pytest.warns(UserWarning, match=r"label 3 keeps 0% .*\(1 mm2\), in 0 pieces"):
        moved = resample_labels(Image(labels), Image(np.zeros((8, 8)), affine), "l")
    assert set(moved.data.ravel()) == {0.0, 1.0}


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([[True, False]], [[1, 0]]),
        ([[0, 255]], [[0, 1]]),
        ([[0, 0.25]], [[0, 1]]),  # two values, whatever the other is
        ([[3, 3]], [[1, 1]]),  # the whole box
        ([[0.25, 0.5]], [[0.25, 0.5]]),
        ([[0.0, 0.25, 1.0]], [[0.0, 0.25, 1.0]]),
        ([[0.1, 0.7]], np.float32([[0.1, 0.7]])),
    ],
)
def test_what_a_mask_may_hold(values, expected):
    mask = Image(values)
    moved = align(resample_mask, mask, Image(np.zeros(mask.shape)))
    assert_array_equal(moved, expected)
    assert moved.dtype == np.float32


IMAGE = Image(np.zeros((4, 3, 2)), np.diag([2.0, 1.0, 1.0, 1.0]))
NUMBERS = np.arange(24).reshape(4, 3, 2)


@pytest.mark.parametrize(
    ("function", "data", "steps", "words"),
    [
        (resample_mask, NUMBERS[0], 0, r"3 axes .*\(3, 2\)"),
        (resample_mask, NUMBERS, 0, r"mask .*24 values .*\(0, 1, 2, 3, 4, \.\.\.\).*`mask_label`"),
        (resample_mask, NUMBERS % 2 - 1, 0, "mask .*2 values from -1 to 0"),
        (resample_mask, NUMBERS % 2 + 1, 0, "mask .*2 values from 1 to 2"),
        (resample_mask, NUMBERS * 0 - 1, 0, "mask .*1 values from -1 to -1"),
        (resample_mask, NUMBERS * 0, 0, "empty: .*0 in every voxel"),
        (resample_mask, NUMBERS / 64, 0, r"empty: .*up to 0\.359375"),
        (resample_mask, NUMBERS % 2, 10, r"outside .* 19\.0\.\.27\.0 x .* -1\.0\.\.7\.0 x"),
        # the boxes overlap, but only where the mask is 0, or a fraction under the half
        (resample_mask, (NUMBERS >= 12) * 1, 2, "outside"),
        (resample_mask, np.where(NUMBERS >= 12, 1.0, 0.25), 2, "outside"),
        (resample_labels, NUMBERS[0], 0, r"3 axes .*\(3, 2\)"),
        (resample_labels, NUMBERS + 0.5, 0, "from 0 to 2147483647; .* 0.5 at"),
        (resample_labels, NUMBERS - 1, 0, "-1 at"),
        (resample_labels, NUMBERS + 2**31, 0, "2147483648 at"),
        (resample_labels, NUMBERS * 0, 0, "0 in every voxel"),
        (resample_labels, NUMBERS, 4, r"7\.0\.\.15\.0 x .* -1\.0\.\.7\.0 x"),
        (resample_contrast, NUMBERS[0], 0, r"3 axes .*\(3, 2\)"),
        (resample_contrast, NUMBERS, 3, r"half .* 25.0 %; it spans 5\.0\.\.13\.0 x"),
    ],
)
def test_images_that_are_none(function, data, steps, words):
    other = Image(data, IMAGE.affine @ _translation(steps, 0, 0) if data.ndim == 3 else None)
    assert re.match(rf"n\.nii: .*{words}", message(function, other, IMAGE, "n.nii"))


def test_label_files_of_floats():
    labels = np.array([[0.0, 32_767.0], [2.0, 1.0]])
    moved = align(resample_labels, Image(labels), Image(np.zeros((2, 2))))
    assert_array_equal(moved, labels)
    # One value in its own box, but a box smaller than the image: label and background.
    moved = align(resample_labels, Image([[4.0]]), Image(np.zeros((1, 2))))
    assert_array_equal(moved, [[4, 0]])


def test_a_contrast_covers_half_of_the_image():
    moved = align(resample_contrast, Image(NUMBERS, IMAGE.affine @ _translation(2, 0, 0)), IMAGE)
    assert_array_equal(moved, NUMBERS[[0, 0, 0, 1]])  # the border goes on


def ball(shape, radius, centre=None):
    return distance(shape, *((np.array(shape) - 1) / 2 if centre is None else centre)) <= radius


@pytest.mark.parametrize("shape", [(30, 32), (30, 32, 28)])
def test_foreground_by_hand(shape):
    """A ball with a dark cavity, a speck dropped, a piece kept, and a dark pocket cut by the box
    kept inside.
    """
    n = len(shape)
    body, piece = ball(shape, 10), ball(shape, 3, [5] * n)
    body[-5:, 8:-8] = True
    bright, pocket = (body | piece) & ~ball(shape, 4), (-1, 15, *[14] * (n - 2))
    bright[(-2,) * n], bright[pocket] = True, False  # a speck
    image = Image(np.where(bright, 50.0, 3.0), np.diag([2.0] * n + [1.0]))
    for level in (3.0, None):
        front = foreground_mask(image, level)
        assert_array_equal(front.data, body | piece)
        assert_array_equal(front.affine, image.affine)
    assert background_level(image) == 3.0
    # A channel to the cavity: face neighbours leak, voxels that touch in an edge do not.
    channel, middle = image.data.copy(), tuple((s - 1) // 2 for s in shape)
    channel[(slice(0, middle[0]), *middle[1:])] = 3.0
    leaking = foreground_mask(Image(channel), 3.0).data
    expected = (body | piece) & ~ball(shape, 4) & (channel > 3.0)
    expected[pocket] = True
    assert_array_equal(leaking, expected)
    diagonal = Image([[9.0, 9, 9, 9], [9, 9, 9, 9], [9, 9, 1, 9], [9, 9, 9, 1]])
    assert_array_equal(foreground_mask(diagonal, 1.0).data == 0, np.diag([0, 0, 0, 1]))


@pytest.mark.parametrize("air", [-1000.0, 0.0, 20.0])
def test_level_of_noisy_air(air):
    """Median and 4 sigma of the air, though body and faint rods lie on the faces; the outline is
    the body's.
    """
    shape = (40, 40, 20)
    body = np.broadcast_to(ball(shape[:2], 14)[:, :, None], shape)
    data = np.where(body, air + 500.0, air) + np.random.default_rng(5).normal(0.0, 10.0, shape)
    for start in (3, 15, 27):
        data[0, start : start + 5] = air + 150.0  # all three 6 % of the dark voxels on the faces
    image = Image(data)
    assert background_level(image) == pytest.approx(air + 42.0, abs=4.0)
    assert_array_equal(foreground_mask(image).data, body)


@pytest.mark.parametrize(("value", "is_air"), [(-1000.0, True), (-870.0, False)])
def test_air_of_a_ct_beside_padding_is_background(value, is_air):
    """The padding has the least value; lungs that were cut out stay."""
    shape, rng = (40, 40, 20), np.random.default_rng(5)
    body, round_view = (
        np.broadcast_to(ball(shape[:2], radius)[:, :, None], shape) for radius in (10, 19)
    )
    data = np.where(body, 40.0, value) + rng.normal(0.0, 10.0, shape)
    image = Image(np.where(round_view, np.maximum(data, -1024.0), -1024.0))
    assert_array_equal(foreground_mask(image).data, body if is_air else image.data > -1024.0)


def test_background_of_one_value_is_exact():
    """As around an extracted brain: the faintest voxel beside it is foreground."""
    body = ball((20, 20, 20), 7)
    values = np.random.default_rng(2).uniform(1e-3, 100.0, body.shape)
    image = Image(np.where(body, values, 0.0))
    assert background_level(image) == 0.0
    assert_array_equal(foreground_mask(image).data, body)


SMALL_BALL = ball((20, 20), 5)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (
            np.random.default_rng(7).normal(100.0, 20.0, (20, 20, 20)),
            "dark voxels on the faces .* range up to",
        ),
        (np.full((5, 5), 4.0), "every voxel has the value 4"),
        (np.where(SMALL_BALL, np.nextafter(1.0, 2.0), 1.0), "256 bins"),
        (np.where(SMALL_BALL, 0.0, 9.0), r"no voxel on the faces .* \(4.5 or less\)"),
    ],
)
def test_images_without_background(image, words):
    said = message(foreground_mask, Image(image))
    assert re.search(f"^`background` auto: no background found, as .*{words}", said)


@pytest.mark.parametrize(
    ("at", "values", "percent"), [(0, (0.0, 9.0), "99.99"), (3790, (9.0, 0.0), "0.0125")]
)
def test_a_background_of_nearly_all_or_nothing(at, values, percent):
    image = np.where(np.arange(8000).reshape(20, 20, 20) == at, *values)
    said = message(foreground_mask, Image(image))
    assert said.startswith(f"`background` auto, 0: {percent} % of the ")


def test_levels_that_leave_nothing():
    image = Image(np.where(SMALL_BALL, 90.0, 10.0))
    labels = Image(SMALL_BALL, image.affine)
    for arguments, words in (
        ([5], "5: 100 % .* 10 to 90"),
        ([5, labels], "5: 100 % .*`mask_label`"),
        ([90, None], "90: 0 %"),
    ):
        assert re.match(f"`background` {words}", message(foreground_mask, image, *arguments))
    # A level given is taken at its word, however little it leaves.
    data = np.zeros((40, 40))
    data[20, 20] = 1.0
    assert_array_equal(foreground_mask(Image(data), 0.0).data, data)


def test_foreground_of_labels_by_hand():
    """A detached label of one voxel stays; a pocket at the side goes, however small; a cavity
    stays.
    """
    labels = 1.0 * (ball((30, 32, 28), 10) & ~ball((30, 32, 28), 4))
    labels[4, 4, 4], labels[20:, 10:20, 10:20], labels[-1, 15, 14] = 3.0, 2.0, 0.0
    labels[(slice(0, 2), 0, 0)] = 5.0  # at the side, too
    expected = (labels > 0) | ball(labels.shape, 4)
    # Labels of a grey image: dark labelled voxels stay, and bright specks without a label go.
    data = np.where(labels == 1, 100.0, 0.0)
    data[2, 28, 2] = 100.0
    image, grey = Image(labels), Image(data)
    for each in (image, grey):
        assert_array_equal(foreground_mask(each, 0.0, image).data, expected)
    said = message(foreground_mask, grey, 0.0, Image(labels[1:]))
    assert said.startswith("labels: expected the image's shape")


def test_a_large_bright_piece_is_not_removed_silently():
    """5 of radius against 25: 515 voxels of 65,000, as a gland beside a body."""
    data = 1.0 * (ball((60,) * 3, 24, (26, 30, 30)) | ball((60,) * 3, 5, (54, 6, 6)))
    with pytest.warns(UserWarning, match="1, 515 mm3 in all, the largest 515 mm3"):
        assert foreground_mask(Image(data), 0.0).data[54, 6, 6] == 0


def shell(n, spacing, shift=0.0):
    """A ball of 3 in a closed shell of 0.7 mm, 2, in a ball of 1, on n^3 voxels around the
    origin.
    """
    affine = np.diag([spacing] * 3 + [1.0])
    affine[:3, 3] = -0.5 * spacing * (n - 1) + shift
    r = np.linalg.norm(grid((n,) * 3) * spacing + affine[:3, 3], axis=-1)
    return Image(np.select([r < 4.3, r < 5, r < 8], [3, 2, 1]), affine)


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.1])
def test_voxels_divided_to_the_size_of_labels_keep_all_of_them(shift):
    """The shell stays closed: what it encloses is apart from what is around it, voxel by voxel."""
    labels = shell(40, 0.5, shift)
    image = Image(
        np.zeros((10,) * 3), np.diag([2.0, 2.0, 2.0, 1.0]) @ _translation(-4.5, -4.5, -4.5)
    )
    assert divisions(image, [labels]) == (4, 4, 4)
    moved = resample_labels(labels, divide_voxels(image, (4, 4, 4)), "l")
    for label in range(4):
        own, there = (each.data == label for each in (labels, moved))
        assert [scipy.ndimage.label(each)[1] for each in (own, there)] == [1, 1]
        if label:
            assert np.count_nonzero(there) == pytest.approx(np.count_nonzero(own))
    with pytest.warns(
        UserWarning, match=r"0.5 x 0.5 x 0.5 mm to 2 x 2 x 2 mm; label \d keeps \d+% .*\d+ pieces"
    ):
        resample_labels(labels, image, "l")


def test_voxels_are_divided_only_where_others_are_finer():
    data = np.arange(120.0).reshape(4, 5, 6)
    image = Image(data, np.diag([1.0, 1.0, 5.0, 1.0]))
    turned = np.eye(4)[[2, 0, 1, 3]] @ np.diag([1.0, 0.5, 0.25, 1.0])
    for affines, expected in (
        ([np.diag([2.0, 1.0005, 1.0, 1.0])], (1, 1, 5)),
        ([np.diag([1.0, 0.98, 5.0, 1.0]), np.eye(4)], (1, 2, 5)),
        ([turned], (4, 1, 10)),
    ):
        others = [Image(np.zeros((8, 8, 8)), affine) for affine in affines]
        assert divisions(image, others) == expected
    parts = divide_voxels(image, (1, 2, 5))
    assert parts.volume == pytest.approx(image.volume)
    assert_array_equal(parts.data, data.repeat(2, axis=1).repeat(5, axis=2))
    assert_allclose(parts.to_world([1, 4.5, 17.0]), image.to_world([1, 2, 3]))


def test_values_near_whole_numbers_are_rounded():
    labels = NUMBERS % 5
    with pytest.warns(UserWarning, match=r"l: 19 voxels .* \(by up to 0.00061\)"):
        moved = resample_labels(Image(labels * 1.000152), Image(NUMBERS), "l")
    assert_array_equal(moved.data, labels)
    image, off = Image(NUMBERS), Image(labels + 0.002)
    assert "the first 0.002 at (0, 0, 0)" in message(resample_labels, off, image, "l")
    most = Image(labels * (2**31 - 1) // 4)
    assert align(resample_labels, most, image).max() == 2**31 - 1


@pytest.mark.parametrize("levels", [None, 32, 100])
def test_a_grey_image_is_no_label_image(levels):
    rng = np.random.default_rng(0)
    grey = scipy.ndimage.gaussian_filter(rng.normal(size=(24, 24, 24)), 4.0)
    grey = Image(np.rint((grey - grey.min()) / np.ptp(grey) * (levels or 4000)) + 1)
    image = Image(np.zeros(grey.shape))
    for said in (message(resample_labels, grey, image, "l"), message(content, image, grey)):
        assert re.match(r"l.*: expected a label image, got \d+ values", said)
    cubes = rng.permutation(512).reshape(8, 8, 8).repeat(3, 0).repeat(3, 1).repeat(3, 2)
    assert_array_equal(align(resample_labels, Image(cubes), image), cubes)
