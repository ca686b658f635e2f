"""Interfaces lie where the classes meet, conform, and reach the box's faces."""

import numpy as np
import pytest

import tetopt
from tetopt.contents.otsu import class_thresholds
from tetopt.study.isosurfaces import Surfaces, class_labels, interfaces

PHANTOM = tetopt.load_phantom("sphere")  # radius 20 mm about the origin
IMAGE, LABELS = PHANTOM.image(voxel_mm=2.0), PHANTOM.label_image(voxel_mm=2.0)


def inner(surfaces: Surfaces):
    return surfaces.triangles[: -surfaces.n_box]


def edge_counts(triangles):
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


@pytest.mark.parametrize("classes", [2, 3, 4])
def test_thresholds_are_multi_otsu(classes):
    filters = pytest.importorskip(
        "skimage.filters", reason="scikit-image is the oracle of multi-Otsu"
    )
    rng = np.random.default_rng(classes)
    values = np.concatenate([rng.normal(40.0 * k, 6.0, 400 * (k + 1)) for k in range(5)])
    # Theirs are the centres of the classes' last bins; a class ends where that bin ends.
    theirs = filters.threshold_multiotsu(values, classes) + 0.5 * np.ptp(values) / 256
    classes_of = [np.digitize(values, each) for each in (class_thresholds(values, classes), theirs)]
    assert np.array_equal(*classes_of)


@pytest.mark.parametrize(("labels", "tolerance"), [(None, 0.5), (LABELS, 1.0)])
def test_sphere(labels, tolerance):
    """Nodes and triangle centres near the true sphere: well under half a voxel, and the chord's
    depth.
    """
    surfaces = interfaces(IMAGE, 5.0, classes=2, labels=labels)
    corners = surfaces.points[inner(surfaces)] - IMAGE.to_index(np.zeros(3)) * IMAGE.spacing
    for places, near in ((corners, tolerance), (corners.mean(axis=1), tolerance + 0.2)):
        assert np.abs(np.linalg.norm(places, axis=-1) - 20.0).max() < near
    _, count = edge_counts(inner(surfaces))
    assert (count == 2).all()  # closed
    assert surfaces.notes == []


def test_labels_conform_where_three_meet():
    """Two halves of the box and a block across them: every edge inside the box is shared, three
    sheets meet.
    """
    data = np.zeros((24, 20, 20))
    data[12:] = 1
    data[6:18, 5:15, 5:15] = 2
    image = tetopt.Image(data)
    surfaces = interfaces(image, 3.0, labels=image)
    edges, count = edge_counts(inner(surfaces))
    assert set(np.unique(count)) == {1, 2, 3}
    rim = surfaces.points[edges[count == 1]]
    is_low, is_high = rim == surfaces.low, rim == surfaces.high
    assert (is_low | is_high).any(axis=2).all()  # open only on the box
    assert is_low[..., 1].any()
    assert is_high[..., 1].any()


def test_isosurfaces_reach_the_box_and_nest():
    """A ramp: three parallel planes, each cutting the box's four other faces."""
    ramp = np.broadcast_to(np.arange(40.0)[:, None, None], (40, 12, 16))
    image = tetopt.Image(ramp, np.diag([1.0, 2.0, 1.5, 1.0]))
    surfaces = interfaces(image, 4.0, classes=4)
    points = surfaces.points[np.unique(inner(surfaces))]
    planes = np.unique(np.round(points[:, 0], 2))
    assert np.allclose(planes, class_thresholds(ramp.ravel(), 4), atol=0.3)
    assert len(planes) == 3
    assert np.array_equal(points[:, 1:].min(axis=0), surfaces.low[1:])
    assert np.array_equal(points[:, 1:].max(axis=0), surfaces.high[1:])


def test_lost_labels_and_specks_get_a_note():
    data = np.zeros((30, 30, 30))
    data[5:20, 5:20, 5:20] = 1
    data[24:26, 24:26, 24:26] = 7
    image = tetopt.Image(data)
    surfaces = interfaces(image, 6.0, labels=image)
    assert surfaces.notes == [
        "labels: dropped 1 specks of surface",
        "lost labels, as every piece of their surface is a speck: 7",
    ]


def test_nothing_left_is_the_box():
    image = tetopt.Image(np.zeros((6, 7, 8)))
    surfaces = interfaces(image, 3.0, labels=image)
    assert len(surfaces.triangles) == surfaces.n_box == 12
    assert surfaces.notes == ["no interface remains: only the box is meshed"]


def test_class_labels_are_the_classes_of_the_surfaces():
    assert np.mean(class_labels(IMAGE, 2).data == LABELS.data) > 0.99


def test_an_image_without_classes():
    with pytest.raises(tetopt.InputError, match="fill only 1 of 256 bins"):
        interfaces(tetopt.Image(np.zeros((5, 6, 7))), 5.0, classes=3)
