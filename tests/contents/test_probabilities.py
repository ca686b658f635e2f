"""Levels of tissues from their probabilities, against shapes whose surfaces are known."""

import numba
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from shapes import distance, grid

import tetopt
from tetopt.contents.memberships import memberships
from tetopt.contents.probabilities import fractions, probable_memberships
from tetopt.errors import InputError

WAY = np.random.default_rng(0).normal(size=(3000, 3))
WAY /= np.linalg.norm(WAY, axis=1)[:, None]
PARTS = 6  # samples of a voxel's fraction along each axis


def ball_fractions(shape, centre, radius):
    """The fraction of each voxel in a ball."""
    axes = [((np.arange(n * PARTS) + 0.5) / PARTS - 0.5 - c) ** 2 for n, c in zip(shape, centre, strict=True)]
    inside = axes[0][:, None, None] + axes[1][:, None] + axes[2] < radius**2
    for axis, n in enumerate(shape):
        inside = np.mean(inside.reshape(*inside.shape[:axis], n, PARTS, *inside.shape[axis + 1 :]), axis=axis + 1)
    return inside


def images(*arrays):
    return [tetopt.Image(np.asarray(array, dtype=np.float32)) for array in arrays]


def interface(members, one, other):
    """The level that is 0 on the interface of two labels, below 0 in the first."""
    rows = [members.channel[np.flatnonzero(members.labels == label)[0]] for label in (one, other)]
    return members.levels[rows[0]] - members.levels[rows[1]]


def off_sphere(level, centre, radius):
    """How far, along many ways out of the centre, the level is 0 beyond the sphere."""
    steps = np.linspace(-0.95, 0.95, 381)
    at = (centre + (radius + steps)[:, None] * WAY[:, None]).reshape(-1, 3).T
    return steps[np.argmax(map_coordinates(level, at, order=1).reshape(len(WAY), -1) > 0.0, axis=1)]


@pytest.mark.parametrize("shift", [(0.2, -0.3, 0.4), (0.0, 0.0, 0.0), (0.5, 0.1, -0.2)])
def test_a_ball_s_fractions_give_its_surface_within_voxels(shift):
    """To 1 % of radius and volume, and smoother than from its labels, whose voxels may lie well by chance."""
    centre, radius = np.array([11.0, 11.0, 11.0]) + shift, 6.0
    ball = ball_fractions((23, 23, 23), centre, radius)
    off = off_sphere(interface(probable_memberships(images(ball), (1, 1, 1)), 1, 0), centre, radius)
    of_labels = off_sphere(interface(memberships(tetopt.Image(1.0 * (ball > 0.5))), 1, 0), centre, radius)
    assert abs(off.mean()) < 0.01 * radius
    assert ((radius + off) ** 3).mean() / radius**3 == pytest.approx(1.0, abs=0.01)
    assert off.std() < 0.035
    assert off.std() < 0.8 * of_labels.std() or not any(shift)
    assert np.abs(off).max() < 0.2


@pytest.mark.parametrize("width", [0.3, 1.0, 3.0])
def test_gentle_probabilities_have_their_surface_where_two_are_as_probable(width):
    centre = np.array([11.2, 10.8, 11.4])
    p = 1.0 / (1.0 + np.exp((distance((23, 23, 23), *centre) - 6.0) / width))
    off = off_sphere(interface(probable_memberships(images(p), (1, 1, 1)), 1, 0), centre, 6.0)
    assert abs(off.mean()) < 0.04
    assert off.std() < 0.03


def test_a_plane_between_two_tissues_is_exact():
    """To 0.03 voxels between centres, and so are distances to it; along a slant to 0.15, far away to 0.6."""
    x = grid((24, 6, 5))[..., 0]
    for at in (9.1, 9.5, 9.93):
        left = np.clip(0.5 - 0.3 * (x - at), 0.0, 1.0)
        members = probable_memberships(images(0.7 * left, 0.7 - 0.7 * left), (1, 1, 1))  # 0.3 are left, never most
        assert members.labels.tolist() == [1, 2]
        level = interface(members, 1, 2)
        beside = np.abs(x - at) < 2.7
        np.testing.assert_allclose(level[beside], 2.0 * (x - at)[beside], atol=0.06)
    d = grid((24, 24, 5)) @ [0.6, 0.8, 0.0] - 16.3
    slanted = np.clip(0.5 - 0.2 * d, 0.0, 1.0)
    level = probable_memberships(images(slanted, 1.0 - slanted), (1, 1, 1)).levels[0]
    inner = np.s_[8:16, 8:16, 1:4]
    level, d = level[inner], d[inner]
    np.testing.assert_allclose(level[np.abs(d) < 2.7], d[np.abs(d) < 2.7], atol=0.15)
    np.testing.assert_allclose(level, d, atol=0.6)


def test_thick_slices_are_divided_and_linear_between():
    """A slanted plane in slices of 5 mm: the surface is straight, not one of steps."""
    at = grid((12, 6, 7)) * [1.0, 1.0, 5.0]
    p = np.clip(0.5 - (at[..., 0] - 3.0 - 0.2 * at[..., 2]) / 12.0, 0.0, 1.0)
    members = probable_memberships(images(p), (1, 1, 5))
    assert members.parts == 5
    assert members.levels.shape[1:] == (12, 6, 35)
    fine = grid((12, 6, 35)) - [0.0, 0.0, 2.0]
    d = (fine[..., 0] - 3.0 - 0.2 * fine[..., 2]) / np.hypot(1.0, 0.2)
    inner = np.abs(d) < 1.0
    inner[:, :, :3] = inner[:, :, -3:] = inner[:, :1] = inner[:, -1:] = inner[:1] = inner[-1:] = False
    np.testing.assert_allclose(interface(members, 1, 0)[inner], 2.0 * d[inner], atol=0.1)


def test_each_voxel_has_the_most_probable_and_0_what_is_left():
    rng = np.random.default_rng(0)
    rows = rng.dirichlet(np.ones(5), size=(9, 8, 7)).transpose(3, 0, 1, 2)
    tissues = images(*rows[1:])
    expected = rows.argmax(axis=0)
    np.testing.assert_array_equal(tetopt.tissue_labels(tissues).data, expected)
    members = probable_memberships(tissues, (1, 1, 1))
    np.testing.assert_array_equal(members.labels[members.partition], expected)
    assert tetopt.tissue_labels(images([[0.5, 0.4]], [[0.5, 0.4]])).data.tolist() == [[1.0, 1.0]]
    assert tetopt.tissue_labels(images([[0.4, 0.5]])).data.tolist() == [[0.0, 0.0]]


def test_sums_above_1_are_told_and_divided():
    tissues = images(*np.array([[[[0.6, 0.005, 0.5]]], [[[0.6, 1.0, 0.2]]]]))
    rows = fractions(tissues)
    np.testing.assert_allclose(rows.sum(axis=0), 1.0, rtol=1e-6)
    np.testing.assert_allclose(rows[:, 0, 0, 0], [0.0, 0.5, 0.5])
    np.testing.assert_allclose(rows[:, 0, 0, 2], [0.3, 0.5, 0.2], rtol=1e-6)
    with pytest.warns(UserWarning, match=r"sum to more than 1 in 1 of 3 voxels \(up to 1.2\); they are divided"):
        tetopt.content(tetopt.Image(np.arange(3.0)[None, None]), tissues=tissues, smooth_interfaces=0)


def test_bytes_are_taken_as_such():
    image = tetopt.Image(np.zeros((2, 2)))
    with pytest.warns(UserWarning, match="grey: whole numbers up to 204 are read as probabilities times 255"):
        moved = tetopt.resample_tissue(tetopt.Image(np.array([[0.0, 51.0], [204.0, 3.0]])), image, "grey")
    np.testing.assert_allclose(moved.data, [[0.0, 0.2], [0.8, 3.0 / 255.0]], rtol=1e-6)


@pytest.mark.parametrize("high", [100.0, 2.0, 256.0, 200.5, 1.01])
def test_other_scales_are_refused(high):
    image = tetopt.Image(np.array([[0.0, high]]))
    with pytest.raises(InputError, match=f"c1: expected probabilities from 0 to 1, got 0 to {high:g}; first divide by"):
        tetopt.resample_tissue(image, image, "c1")


def test_on_another_grid_they_are_linear():
    coarse = tetopt.Image(np.array([[0.0, 1.0], [0.0, 1.0]]), np.diag([2.0, 2.0, 1.0]))
    fine = tetopt.Image(np.zeros((3, 3)))
    np.testing.assert_allclose(tetopt.resample_tissue(coarse, fine).data, [[0.0, 0.5, 1.0]] * 3)


def blurred(n=20):
    """A contrast, and a ball in a ball as probabilities."""
    r = distance((n, n, n), 9.3, 9.6, 9.2)
    inner, outer = (1.0 / (1.0 + np.exp(2.0 * (r - radius))) for radius in (4.0, 7.5))
    return tetopt.Image(100.0 * inner + 50.0 * outer), images(outer - inner, inner), r


@pytest.mark.full
def test_a_mesh_of_tissues_goes_with_mask_weights_contrasts_and_order():
    image, tissues, r = blurred()
    mask = tetopt.Image(1.0 * (r < 8.5))
    what = tetopt.content([image, image], mask=mask, tissues=tissues, weights=[1, 0], label_weight=2.0)
    assert what.n_contrasts == 1
    twin = tetopt.content([image, image], tetopt.tissue_labels(tissues), mask, weights=[1, 0], label_weight=2.0)
    volumes = []
    for each in (what, twin):
        result = tetopt.mesh_image(each, 6000, iterations=6, order=2)
        assert not dict(result.violated)
        assert set(result.labels) == {0, 1, 2}
        size = np.abs(np.linalg.det(np.diff(result.mesh.points[result.mesh.cells[:, :4]], axis=1))) / 6.0
        volumes.append(size[result.labels == 2].sum() / (4.0 / 3.0 * np.pi * 4.0**3))
    assert volumes[0] == pytest.approx(1.0, abs=0.12)  # of cells as large as a third of it
    assert abs(volumes[0] - 1.0) < abs(volumes[1] - 1.0) - 0.02


def test_without_tension_tissues_are_their_labels():
    image, tissues, _ = blurred()
    stairs = tetopt.content(image, tissues=tissues, smooth_interfaces=0.0)
    assert stairs.memberships is None
    twin = tetopt.content(image, tetopt.tissue_labels(tissues), smooth_interfaces=0.0)
    np.testing.assert_array_equal(stairs.channels, twin.channels)


def test_beyond_a_mask_the_nearest_inside_counts():
    image, tissues, r = blurred()
    mask = tetopt.Image(1.0 * (r < 6.0))
    members = tetopt.content(image, mask=mask, tissues=tissues).memberships
    assert members.labels.tolist() == [1, 2]  # what is left is outside


def test_the_same_on_any_number_of_threads():
    _, tissues, _ = blurred()
    before, levels = numba.get_num_threads(), []
    for threads in {1, before}:
        numba.set_num_threads(threads)
        levels.append(probable_memberships(tissues, (1, 1, 3)).levels.tobytes())
    numba.set_num_threads(before)
    assert len(set(levels)) == 1


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"labels": True}, "labels and tissues: expected at most one"),
        ({"tissues": []}, "tissues: expected one image or more, got 0"),
        ({"tissues": (2.0, 1.0)}, "tissues, number 1: expected probabilities from 0 to 1, got 0 to 2"),
        ({"tissues": (1.0, -1.0)}, "tissues, number 2: expected probabilities from 0 to 1, got -1 to"),
    ],
)
def test_refused(change, match):
    image, tissues, _ = blurred(12)
    given = {"tissues": tissues}
    if change.get("labels"):
        given["labels"] = tetopt.tissue_labels(tissues)
    elif not (scales := change["tissues"]):
        given["tissues"] = []
    else:
        given["tissues"] = [
            tetopt.Image(scale * (tissue.data > 0.5)) for scale, tissue in zip(scales, tissues, strict=True)
        ]
    with pytest.raises(InputError, match=match):
        tetopt.content(image, **given)


def test_tissues_of_another_shape_or_place_are_refused():
    image, tissues, _ = blurred(12)
    with pytest.raises(InputError, match=r"number 2: expected shape \(12, 12, 12\) like the first, got \(11, 12, 12\)"):
        tetopt.content(image, tissues=[tissues[0], tetopt.Image(tissues[1].data[1:])])
    moved = [tetopt.Image(tissue.data, np.diag([1.0, 1.0, 1.1, 1.0])) for tissue in tissues]
    with pytest.raises(InputError, match="number 1: expected the same voxel grid"):
        tetopt.content(image, tissues=moved)


def test_a_tissue_that_is_nowhere_the_most_probable_is_named():
    image, tissues, _ = blurred(12)
    with pytest.warns(UserWarning, match="no cell gets label 3, which is not the most probable in any voxel"):
        tetopt.content(image, tissues=[*tissues, tetopt.Image(0.1 * tissues[0].data)])
