"""Masks, labels and contrasts land on the image's voxels by the affines; the foreground is what
it should be.
"""

import re
from functools import partial

import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
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
    return tetopt.Image(np.zeros(SHAPE[:n]), image_affine), tetopt.Image(
        values(rng, OTHER[:n]), affine
    )


def message(function, *args):
    """What a function says of its arguments; a name that messages begin with may come first."""
    args = (*args[1:], args[0]) if isinstance(args[0], str) else args
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
    aligned = resample_labels(labels, image, "l")
    assert_array_equal(aligned.data, expected)
    assert_array_equal(aligned.affine, image.affine)
    mask = tetopt.Image(255 * (labels.data > 4), labels.affine)
    aligned = resample_mask(mask, image, "m")
    assert_array_equal(aligned.data, nearest_twin(mask, image) / 255)
    assert_array_equal(aligned.affine, image.affine)
    chance = tetopt.Image(labels.data / 16, labels.affine)
    assert_array_equal(resample_mask(chance, image, "m").data, nearest_twin(chance, image))


@pytest.mark.parametrize("which", PAIRS)
def test_linear_is_its_twin(which):
    image, other = pair(which, lambda rng, shape: rng.normal(size=shape).astype(np.float32))
    aligned = resample_contrast(other, image, "c")
    assert_allclose(aligned.data, linear_twin(other, image), atol=1e-6)
    assert_array_equal(aligned.affine, image.affine)


def _translation(*shift):
    return np.vstack([np.column_stack([np.eye(3), shift]), [0, 0, 0, 1]])


def test_same_grid_is_taken_as_it_is():
    """Up to 1e-4 voxel, and not beyond: there a value near a voxel's border comes from its
    neighbour.
    """
    rng = np.random.default_rng(0)
    affine = PAIRS["both oblique"][0]
    image = tetopt.Image(np.zeros(SHAPE), affine)
    data = rng.normal(size=SHAPE).astype(np.float32)
    near = tetopt.Image(data, affine @ _translation(9e-5, 0, 0))
    assert_array_equal(resample_contrast(near, image, "c").data, data)
    assert_array_equal(resample_contrast(near, image, "c").affine, affine)
    far = tetopt.Image(data, affine @ _translation(2e-3, 0, 0))
    assert 1e-4 < np.abs(resample_contrast(far, image, "c").data - data).max() < 2e-2
    shape_only = tetopt.Image(
        np.arange(1, 1 + np.prod(SHAPE)).reshape(SHAPE), affine @ _translation(0, 2, 0)
    )
    moved = resample_labels(shape_only, image, "l").data
    assert_array_equal(moved[:, 2:], shape_only.data[:, :-2])
    assert_array_equal(moved[:, :2], 0)


@pytest.mark.parametrize("spacing", [1.0, 0.1, 0.7])
@pytest.mark.parametrize("sign", [1, -1])
def test_grid_shifted_by_half_a_voxel(spacing, sign):
    """Every centre lies halfway between two voxels: all take the upper one, and the box is half
    open.
    """
    affine = np.diag([spacing] * 3 + [1.0])
    affine[:3, 3] = 17.3
    image = tetopt.Image(np.zeros((40, 3, 3)), affine)
    labels = tetopt.Image(
        np.arange(1, 361).reshape(40, 3, 3), affine @ _translation(-0.5 * sign, 0, 0)
    )
    aligned = resample_labels(labels, image, "l").data
    if sign > 0:  # index i + 1/2: the upper is i + 1, the last is on the upper face, outside
        assert_array_equal(aligned[:-1], labels.data[1:])
        assert_array_equal(aligned[-1], 0)
    else:  # index i - 1/2: the upper is i, the first on the lower face, inside
        assert_array_equal(aligned, labels.data)


def test_labels_without_a_voxel_in_the_image_or_mask_are_named(recwarn):
    """The largest first; neither 0 nor what the image's voxels keep in part, nor a label lost
    between larger ones.
    """
    labels = np.zeros((20, 12))
    labels[:12, :6], labels[10:, 9:] = 3.0, 50.0
    labels[14:, :8] = np.arange(48).reshape(6, 8) // 8 + 20.0
    labels[15, 1], labels[3, 9] = 3.0, 8.0
    whole, image = tetopt.Image(labels), tetopt.Image(np.zeros((11, 12)))
    tetopt.resample_labels(whole, image, "l")
    tetopt.resample_labels(whole, tetopt.Image(np.zeros((20, 12))), "l")
    tetopt.resample_labels(whole, image, "left out on purpose", may_miss=True)
    mask = tetopt.Image(np.arange(20)[:, None] + np.zeros((20, 12)) < 15)
    tetopt.content(whole, whole, mask)
    tetopt.content(whole, whole, tetopt.Image(labels > 0.0))
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
    with pytest.warns(
        UserWarning, match=r"label 3 keeps 0% of its volume \(1 mm2\), in 0 pieces in"
    ):
        moved = resample_labels(tetopt.Image(labels), tetopt.Image(np.zeros((8, 8)), affine), "l")
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
    ],
)
def test_what_a_mask_may_hold(values, expected):
    mask = tetopt.Image(values)
    aligned = resample_mask(mask, tetopt.Image(np.zeros(mask.shape)), "m")
    assert_array_equal(aligned.data, expected)
    assert aligned.data.dtype == np.float32
    doubles = resample_mask(tetopt.Image([[0.1, 0.7]]), tetopt.Image(np.zeros((1, 2))), "m").data
    assert doubles.dtype == np.float32


IMAGE = tetopt.Image(np.zeros((4, 3, 2)), np.diag([2.0, 1.0, 1.0, 1.0]))
NUMBERS = np.arange(24).reshape(4, 3, 2)
MASK = r"m\.nii: expected a mask .*"


@pytest.mark.parametrize(
    ("data", "steps", "words"),
    [
        (NUMBERS[0], 0, r"m\.nii: expected 3 axes .*\(3, 2\)"),
        (NUMBERS, 0, MASK + r"24 values from 0 to 23 \(0, 1, 2, 3, 4, \.\.\.\).*`mask_label`"),
        (NUMBERS % 2 - 1, 0, MASK + "2 values from -1 to 0"),
        (NUMBERS % 2 + 1, 0, MASK + "2 values from 1 to 2"),
        (NUMBERS * 0 - 1, 0, MASK + "1 values from -1 to -1"),
        (NUMBERS * 0, 0, r"m\.nii: .*empty: .*0 in every voxel"),
        (NUMBERS / 64, 0, r"m\.nii: .*empty: .*up to 0\.359375"),
        (NUMBERS % 2, 10, r"m\.nii: .*outside .* 19\.0\.\.27\.0 x .* -1\.0\.\.7\.0 x"),
        # the boxes overlap, but only where the mask is 0, or a fraction under the half
        ((NUMBERS >= 12) * 1, 2, r"m\.nii: .*outside"),
        (np.where(NUMBERS >= 12, 1.0, 0.25), 2, r"m\.nii: .*outside"),
    ],
)
def test_masks_that_are_none(data, steps, words):
    mask = tetopt.Image(data, IMAGE.affine @ _translation(steps, 0, 0) if data.ndim == 3 else None)
    assert re.match(words, message(resample_mask, "m.nii", mask, IMAGE))


@pytest.mark.parametrize(
    ("data", "steps", "words"),
    [
        (NUMBERS[0], 0, r"l\.nrrd: expected 3 axes .*\(3, 2\)"),
        (NUMBERS + 0.5, 0, r"l\.nrrd: .* whole numbers from 0 to 2147483647; .* 0\.5 at"),
        (NUMBERS - 1, 0, r"l\.nrrd: .* -1 at"),
        (NUMBERS + 2**31, 0, r"l\.nrrd: .* 2147483648 at"),
        (NUMBERS * 0, 0, r"l\.nrrd: .*0 in every voxel"),
        (NUMBERS, 4, r"l\.nrrd: .* 7\.0\.\.15\.0 x .* -1\.0\.\.7\.0 x"),
    ],
)
def test_labels_that_are_none(data, steps, words):
    labels = tetopt.Image(
        data, IMAGE.affine @ _translation(steps, 0, 0) if data.ndim == 3 else None
    )
    assert re.match(words, message(resample_labels, "l.nrrd", labels, IMAGE))


def test_label_files_of_floats():
    labels = tetopt.Image(np.array([[0.0, 32_767.0], [2.0, 1.0]], dtype=np.float64))
    assert_array_equal(
        resample_labels(labels, tetopt.Image(np.zeros((2, 2))), "l").data, labels.data
    )
    # One value in its own box, but a box smaller than the image: label and background.
    crop = tetopt.Image([[4.0]])
    assert_array_equal(resample_labels(crop, tetopt.Image(np.zeros((1, 2))), "l").data, [[4, 0]])


def test_a_contrast_covers_half_of_the_image():
    image = tetopt.Image(np.zeros((4, 3, 2)))
    other = np.arange(24.0).reshape(4, 3, 2)
    aligned = resample_contrast(tetopt.Image(other, _translation(2, 0, 0)), image, "t2").data
    assert_array_equal(aligned, other[[0, 0, 0, 1]])  # the border goes on
    for bad, words in (
        (
            tetopt.Image(other, _translation(3, 0, 0)),
            r"t2: .* half .* 25.0 %; it spans 2\.5\.\.6\.5 x",
        ),
        (tetopt.Image(other[0]), r"t2: expected 3 axes .*\(3, 2\)"),
    ):
        assert re.match(words, message(resample_contrast, "t2", bad, image))


def ball(shape, radius, centre=None):
    centre = (np.array(shape) - 1) / 2 if centre is None else np.array(centre)
    return ((np.moveaxis(np.indices(shape), 0, -1) - centre) ** 2).sum(axis=-1) <= radius**2


@pytest.mark.parametrize("shape", [(30, 32), (30, 32, 28)])
def test_foreground_by_hand(shape):
    """A ball with a dark cavity, a speck dropped, a piece kept, and a dark pocket cut by the box
    kept inside.
    """
    n = len(shape)
    body = ball(shape, 10)
    piece, speck = ball(shape, 3, [5] * n), np.zeros(shape, dtype=bool)
    speck[(-2,) * n] = True
    slab, pocket = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    slab[-5:, 8:-8] = body[-5:, 8:-8] = True
    pocket[(-1, 15, *[14] * (n - 2))] = True
    bright = (body | piece | speck) & ~ball(shape, 4) & ~pocket
    image = tetopt.Image(np.where(bright, 50.0, 3.0), np.diag([2.0] * n + [1.0]))
    front = foreground_mask(image, 3.0)
    assert_array_equal(front.data, body | piece)
    assert_array_equal(front.affine, image.affine)
    assert_array_equal(foreground_mask(image).data, body | piece)
    assert background_level(image) == 3.0
    # A channel to the cavity: face neighbours leak, voxels that touch in an edge do not.
    channel = image.data.copy()
    middle = tuple((s - 1) // 2 for s in shape)
    channel[(slice(0, middle[0]), *middle[1:])] = 3.0
    leaking = foreground_mask(tetopt.Image(channel), 3.0).data
    assert_array_equal(leaking, (body | piece) & ~ball(shape, 4) & (channel > 3.0) | pocket)
    assert leaking[middle] == 0
    diagonal = tetopt.Image([[9.0, 9, 9, 9], [9, 9, 9, 9], [9, 9, 1, 9], [9, 9, 9, 1]])
    assert_array_equal(foreground_mask(diagonal, 1.0).data == 0, np.diag([0, 0, 0, 1]))


@pytest.mark.parametrize("air", [-1000.0, 0.0, 20.0])
def test_level_of_noisy_air(air):
    """Median and 4 sigma of the air, though body and faint rods lie on the faces; the outline is
    the body's.
    """
    shape = (40, 40, 20)
    rng = np.random.default_rng(5)
    body = np.broadcast_to(ball(shape[:2], 14)[:, :, None], shape)
    data = np.where(body, air + 500.0, air) + rng.normal(0.0, 10.0, shape)
    for start in (3, 15, 27):
        data[0, start : start + 5] = air + 150.0  # all three 6 % of the dark voxels on the faces
    image = tetopt.Image(data)
    assert background_level(image) == pytest.approx(air + 42.0, abs=4.0)
    assert_array_equal(foreground_mask(image).data, body)


def test_background_of_one_value_is_exact():
    """As around an extracted brain: the faintest voxel beside it is foreground."""
    data = np.zeros((20, 20, 20))
    body = ball(data.shape, 7)
    data[body] = np.random.default_rng(2).uniform(1e-3, 100.0, body.sum())
    assert background_level(tetopt.Image(data)) == 0.0
    assert_array_equal(foreground_mask(tetopt.Image(data)).data, body)


def test_images_without_background():
    rng = np.random.default_rng(7)
    for image, words in (
        (
            rng.normal(100.0, 20.0, (20, 20, 20)),
            r"the dark voxels on the faces of the box range up to .*, which is not below",
        ),
        (np.full((5, 5), 4.0), "every voxel has the value 4"),
        (
            np.where(ball((20, 20), 5), np.nextafter(1.0, 2.0), 1.0),
            "classes: expected intensities that 256 bins can separate",
        ),
        (
            np.where(ball((20, 20), 5), 0.0, 9.0),
            r"no voxel on the faces of the box is dark \(4.5 or less\)",
        ),
    ):
        assert re.search(
            f"^`background` auto: no background found, as {words}.*; give a value or omit",
            message(foreground_mask, tetopt.Image(image)),
        )
    for at, values, percent in ((0, (0.0, 9.0), r"99\.99"), (3790, (9.0, 0.0), r"0\.0125")):
        image = np.where(np.arange(8000).reshape(20, 20, 20) == at, *values)
        words = message(foreground_mask, tetopt.Image(image))
        assert re.search(f"^`background` auto, 0: {percent} % of the .*; choose a level", words)


def test_levels_that_leave_nothing():
    image = tetopt.Image(np.where(ball((20, 20), 5), 90.0, 10.0))
    for level, labels, words in (
        (5, None, "`background` 5: 100 % .* 10 to 90"),
        (5, tetopt.Image(image.data > 50.0, image.affine), "`background` 5: 100 % .*`mask_label`"),
        (90, None, "`background` 90: 0 %"),
    ):
        assert re.match(words, message(foreground_mask, image, level, labels))
    # A level given is taken at its word, however little it leaves.
    data = np.zeros((40, 40))
    data[20, 20] = 1.0
    assert_array_equal(foreground_mask(tetopt.Image(data), 0.0).data, data)


def test_foreground_of_labels_by_hand():
    """A detached label of one voxel stays; a pocket at the side goes, however small; a cavity
    stays.
    """
    labels = np.zeros((30, 32, 28))
    labels[ball(labels.shape, 10)] = 1.0
    labels[ball(labels.shape, 4)] = 0.0
    labels[4, 4, 4], labels[20:, 10:20, 10:20], labels[-1, 15, 14] = 3.0, 2.0, 0.0
    labels[(slice(0, 2), 0, 0)] = 5.0  # at the side, too
    image = tetopt.Image(labels)
    front = foreground_mask(image, 0.0, image)
    cavity = ball(labels.shape, 4) & (labels == 0)
    assert_array_equal(front.data, (labels > 0) | cavity)
    # Labels of a grey image: dark labelled voxels stay, and bright specks without a label go.
    data = np.where(labels == 1, 100.0, 0.0)
    data[2, 28, 2] = 100.0
    grey = tetopt.Image(data)
    assert_array_equal(foreground_mask(grey, 0.0, image).data, (labels > 0) | cavity)
    assert message(foreground_mask, grey, 0.0, tetopt.Image(labels[1:])).startswith(
        "labels: expected the image's shape"
    )


def test_a_large_bright_piece_is_not_removed_silently():
    """5 of radius against 25: 515 voxels of 65,000, as a gland beside a body."""
    data = np.where(ball((60, 60, 60), 24, (26, 30, 30)), 1.0, 0.0)
    data[ball(data.shape, 5, (54, 6, 6))] = 1.0
    with pytest.warns(
        UserWarning, match=r"bright ones are removed: 1, 515 mm3 in all, the largest 515 mm3"
    ):
        assert foreground_mask(tetopt.Image(data), 0.0).data[54, 6, 6] == 0


def shell(n, spacing, shift=0.0):
    """A ball of 3 in a closed shell of 0.7 mm, 2, in a ball of 1, on n^3 voxels around the
    origin.
    """
    affine = np.diag([spacing] * 3 + [1.0])
    affine[:3, 3] = -0.5 * spacing * (n - 1) + shift
    labels = tetopt.Image(np.zeros((n,) * 3), affine)
    r = np.linalg.norm(labels.to_world(np.moveaxis(np.indices(labels.shape), 0, -1)), axis=-1)
    return tetopt.Image(np.where(r < 4.3, 3, np.where(r < 5, 2, np.where(r < 8, 1, 0))), affine)


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.1])
def test_voxels_divided_to_the_size_of_labels_keep_all_of_them(shift):
    """The shell stays closed: what it encloses is apart from what is around it, voxel by voxel."""
    labels, image = (
        shell(40, 0.5, shift),
        tetopt.Image(np.zeros((10,) * 3), np.diag([2.0, 2.0, 2.0, 1.0])),
    )
    image = tetopt.Image(image.data, image.affine @ _translation(-4.5, -4.5, -4.5))
    assert divisions(image, [labels]) == (4, 4, 4)
    moved = resample_labels(labels, divide_voxels(image, (4, 4, 4)), "l")
    for label in (0, 1, 2, 3):
        counts = [scipy.ndimage.label(each.data == label)[1] for each in (labels, moved)]
        assert counts == [1, 1]
    n_lost = [
        np.count_nonzero(moved.data == label) / np.count_nonzero(labels.data == label)
        for label in (1, 2, 3)
    ]
    assert_allclose(n_lost, 1.0)
    with pytest.warns(
        UserWarning,
        match=r"0.5 x 0.5 x 0.5 mm to 2 x 2 x 2 mm; label \d keeps \d+% .*in \d+ pieces",
    ):
        resample_labels(labels, image, "l")


def test_voxels_are_divided_only_where_others_are_finer():
    image = tetopt.Image(np.zeros((4, 5, 6)), np.diag([1.0, 1.0, 5.0, 1.0]))
    other = partial(tetopt.Image, np.zeros((8, 8, 8)))
    assert divisions(image, [other(np.diag([2.0, 1.0005, 1.0, 1.0]))]) == (1, 1, 5)
    assert divisions(image, [other(np.diag([1.0, 0.98, 5.0, 1.0])), other(np.eye(4))]) == (1, 2, 5)
    turned = np.eye(4)[[2, 0, 1, 3]] @ np.diag([1.0, 0.5, 0.25, 1.0])
    assert divisions(image, [other(turned)]) == (4, 1, 10)
    data = np.arange(120.0).reshape(4, 5, 6)
    parts = divide_voxels(tetopt.Image(data, image.affine), (1, 2, 5))
    assert parts.volume == pytest.approx(image.volume)
    for place in ((0, 0, 0), (3, 4, 5), (1, 2, 3)):
        i, j, k = place
        assert_array_equal(parts.data[i, 2 * j : 2 * j + 2, 5 * k : 5 * k + 5], data[place])
    assert_allclose(parts.to_world([1, 4.5, 17.0]), image.to_world([1, 2, 3]))


def test_values_near_whole_numbers_are_rounded():
    image = tetopt.Image(np.zeros((4, 3, 2)))
    labels = np.arange(24).reshape(4, 3, 2) % 5
    with pytest.warns(
        UserWarning, match=r"l: 19 voxels were rounded to whole numbers \(by up to 0.00061\)"
    ):
        moved = resample_labels(tetopt.Image(labels * 1.000152), image, "l")
    assert_array_equal(moved.data, labels)
    assert "the first 0.002 at (0, 0, 0)" in message(
        resample_labels, "l", tetopt.Image(labels + 0.002), image
    )
    assert (
        resample_labels(tetopt.Image(labels * (2**31 - 1) // 4), image, "l").data.max() == 2**31 - 1
    )


@pytest.mark.parametrize("levels", [None, 32, 100])
def test_a_grey_image_is_no_label_image(levels):
    rng = np.random.default_rng(0)
    grey = scipy.ndimage.gaussian_filter(rng.normal(size=(24, 24, 24)), 4.0)
    grey = np.rint((grey - grey.min()) / np.ptp(grey) * (levels or 4000)) + 1
    image, words = (
        tetopt.Image(np.zeros((24, 24, 24))),
        r"l.*: expected a label image, got \d+ values, .* a label",
    )
    assert re.match(words, message(resample_labels, "l", tetopt.Image(grey), image))
    assert re.match(words, message(tetopt.content, image, tetopt.Image(grey)))
    cubes = rng.permutation(512).reshape(8, 8, 8).repeat(3, 0).repeat(3, 1).repeat(3, 2)
    assert_array_equal(resample_labels(tetopt.Image(cubes), image, "l").data, cubes)
