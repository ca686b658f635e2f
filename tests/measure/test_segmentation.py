"""Approximate segmentation: the classes are optimal, and painted back where they belong."""

from itertools import combinations

import numpy as np
import pytest

import tetopt
from tetopt.contents import otsu
from tetopt.contents.otsu import class_thresholds
from tetopt.measure.segmentation import dice, segment, threshold_image


def within(values, weights, thresholds):
    group = np.digitize(values, thresholds)
    total = 0.0
    for g in np.unique(group):
        v, w = values[group == g], weights[group == g]
        total += (w * (v - (w * v).sum() / w.sum()) ** 2).sum()
    return total


@pytest.mark.parametrize("classes", [2, 3, 4])
def test_thresholds_leave_the_least_variance(classes):
    """Against every way to cut 9 different values, each in a bin of its own."""
    rng = np.random.default_rng(classes)
    for _ in range(10):
        values = np.sort(rng.choice(256, 9, replace=False)).astype(float)
        values[0], values[-1] = 0.0, 255.0
        weights = rng.uniform(0.1, 5.0, 9)
        cuts = combinations(range(1, 9), classes - 1)
        best = min(within(values, weights, values[list(cut)]) for cut in cuts)
        thresholds = class_thresholds(values, classes, weights)
        assert np.all(np.diff(thresholds) > 0.0)
        # a bin's centre stands for its values
        assert within(values, weights, thresholds) == pytest.approx(best, rel=0.03)


def test_clear_clusters_are_found():
    values = np.repeat([10.0, 12.0, 50.0, 90.0, 91.0], [5, 5, 7, 3, 9])
    thresholds = class_thresholds(values, 3)
    assert 12.0 < thresholds[0] < 50.0 < thresholds[1] < 90.0


def test_a_bright_voxel_leaves_the_classes_as_they_are(monkeypatch):
    """One that is a million times brighter than the rest; values of ordinary spread have the
    bins of all of them.
    """
    rng, clusters = (
        np.random.default_rng(0),
        ((10.0, 1.0, 4000), (20.0, 1.0, 3000), (40.0, 2.0, 3000)),
    )
    values = np.concatenate([rng.normal(*each) for each in clusters])
    thresholds = class_thresholds(values, 3)
    assert 12.0 < thresholds[0] < 18.0
    assert 23.0 < thresholds[1] < 35.0
    for outliers in ([4e7], [-3e5, 2e6], [1e3, 1e6]):
        found = class_thresholds(np.append(values, outliers), 3)
        np.testing.assert_allclose(found, thresholds, atol=1.5)
    rare = np.append(np.zeros(10_000), [7.0])
    assert class_thresholds(rare, 2) == pytest.approx([3.5], abs=0.01)
    monkeypatch.setattr(otsu, "FEWEST_BINS", 1)
    np.testing.assert_array_equal(class_thresholds(values, 3), thresholds)
    with pytest.raises(tetopt.InputError, match="only 2 of 256 bins"):  # without narrower ones
        class_thresholds(np.append(values, 4e7), 3)


@pytest.mark.parametrize(
    ("values", "classes", "words"),
    [
        ([1.0, 2.0], 1, "2 or more, got 1"),
        ([1.0, 2.0], 3, "3 requested, but the values fill only 2"),
        ([1.0, np.nextafter(1.0, 2.0)], 2, "256 bins can separate, got 1.0 to 1.0000000000000002"),
    ],
)
def test_bad_classes(values, classes, words):
    with pytest.raises(tetopt.InputError, match=words):
        class_thresholds(np.array(values), classes)


def test_optimising_the_mesh_improves_the_segmentation():
    """On the sphere phantom the painted classes come nearer to the true labels, in both label
    and background.
    """
    phantom = tetopt.load_phantom("sphere")
    image, truth = phantom.image(voxel_mm=2.0), phantom.label_image(voxel_mm=2.0)
    mesh = tetopt.lattice_mesh(image, nodes=800)
    better = tetopt.optimize(image, mesh, k_D=0.5, iterations=8).mesh
    before, after = (dice(segment(image, m, 2), truth) for m in (mesh, better))
    assert after[1] > before[1] + 0.03
    assert after[0] > before[0]
    assert after[1] > 0.9
    assert dice(threshold_image(image, 2), truth)[1] > after[1]  # the voxels themselves know more


def test_mesh_that_resolves_every_voxel_thresholds_it():
    """Cells that each hold one voxel give the voxels' own classes."""
    rng = np.random.default_rng(0)
    image = tetopt.Image(rng.integers(0, 4, (6, 5)) * 10.0)
    mesh = tetopt.lattice_mesh(image, blocks=(24, 20))
    np.testing.assert_array_equal(segment(image, mesh, 4).data, image.data / 10.0)


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        ([[0, 0, 0], [0, 2, 2]], {0: 6 / 7, 1: 4 / 5}),
        ([[0, 0, 1], [0, 1, 1]], {0: 1.0, 1: 1.0}),
        ([[0, 0, 0], [0, 0, 0]], {0: 6 / 9, 1: 0.0}),
    ],
)
def test_dice_by_hand(labels, expected):
    truth = tetopt.Image([[0, 0, 1], [0, 1, 1]])
    assert dice(tetopt.Image(labels), truth) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        (np.zeros((3, 2)), r"shape, got \(2, 2\) and \(3, 2\)"),
        (np.full((2, 2), 0.5), "truth: labels must be whole numbers"),
    ],
)
def test_dice_bad_input(truth, words):
    with pytest.raises(tetopt.InputError, match=words):
        dice(tetopt.Image(np.zeros((2, 2))), tetopt.Image(truth))
