"""Measures of curved cells: of a ball whose cells are straight or curved, beside the ball
itself.
"""

import numpy as np
import pytest

import tetopt
from tetopt.geometry.quadratic import numbered_edges
from tetopt.measure.judge import Requirements, judge, measure
from tetopt.measure.measures import fidelity

RADIUS = 20.0
VOLUME, AREA = 4.0 / 3.0 * np.pi * RADIUS**3, 4.0 * np.pi * RADIUS**2


@pytest.fixture(scope="module")
def ball():
    """A ball of 20 mm as label 1 of 1 mm voxels in a box, in cells of order 2; the labels and
    the result.
    """
    labels = tetopt.load_phantom("sphere").label_image(voxel_mm=1)
    return labels, tetopt.mesh_image(tetopt.content(labels, labels), 2000, order=2, iterations=8)


def straight(mesh):
    return tetopt.Mesh(mesh.points, mesh.cells)


@pytest.fixture(scope="module")
def measured(ball):
    """Measures of the curved cells, and of straight ones with the same corners."""
    labels, (mesh, labels_of_cells) = ball[0], (ball[1].mesh, ball[1].labels)
    return [fidelity(labels, None, each, labels_of_cells) for each in (mesh, straight(mesh))]


def test_volumes_are_exact(ball, measured):
    """Straight cells lose 5 % of the ball or more, curved ones less than 0.5 %; together they
    fill the box.
    """
    labels, result = ball
    curved, straight = (each["labels"][1].extent.mesh_volume for each in measured)
    assert abs(curved / VOLUME - 1.0) < 0.005
    assert straight / VOLUME < 0.95
    assert curved == pytest.approx(result.mesh.cell_volumes[result.labels == 1].sum())
    assert sum(row.extent.mesh_volume for row in measured[0]["labels"]) == pytest.approx(
        labels.volume, rel=1e-12
    )
    np.testing.assert_array_equal(
        tetopt.cell_fields(result.mesh)["volume"], result.mesh.cell_volumes
    )


def test_overlaps_distances_and_areas_are_of_the_pieces(ball, measured):
    """They are off by a quarter of what straight cells are, as are the pieces' facets."""
    labels, result = ball
    pieces, n_pieces = result.mesh.straight_pieces()
    of_pieces = fidelity(labels, None, pieces, np.repeat(result.labels, n_pieces))
    curved, straight = (each["labels"][1] for each in measured)
    own = of_pieces["labels"][1]
    for name in (
        "dice",
        "volume_dice",
        "distance_mean",
        "distance_p95",
        "distance_max",
        "thickness_mesh",
    ):
        assert curved.as_json()[name] == own.as_json()[name], name
    assert curved.extent.n_cells == straight.extent.n_cells == own.extent.n_cells // 8
    assert 1.0 - curved.overlap.dice < 0.4 * (1.0 - straight.overlap.dice)
    assert 1.0 - curved.overlap.volume_dice < 0.6 * (1.0 - straight.overlap.volume_dice)
    assert curved.distance.mean < 0.6 * straight.distance.mean
    sides = [each["interfaces"][1] for each in measured]
    assert abs(sides[0].area / AREA - 1.0) < 0.3 * abs(sides[1].area / AREA - 1.0)
    assert measured[0]["contacts"][0].mesh_mm2 == pytest.approx(sides[0].area)
    topology = [side._replace(area=0.0, area_ratio=0.0, folded=0.0) for side in sides]
    assert topology[0] == topology[1]


def test_folds_are_counted_at_the_edges_of_cells():
    """A square's corners are turned as much with straight midpoints; its sides have no new
    edges.
    """
    labels = tetopt.Image(np.pad(np.ones((6, 6), dtype=np.uint8), 3))
    mesh = tetopt.lattice_mesh(labels, blocks=(4, 4))
    of_cell = tetopt.cell_labels(labels, mesh)
    quadratic = tetopt.Mesh(
        mesh.points, mesh.cells, mesh.points[numbered_edges(mesh.cells)[0]].mean(axis=1)
    )
    rows = [tetopt.label_interfaces(labels, each, of_cell)[1] for each in (mesh, quadratic)]
    assert rows[0].folded > 0.2
    assert rows[0]._replace(area=0.0, area_ratio=0.0) == rows[1]._replace(area=0.0, area_ratio=0.0)
    assert rows[0].area == pytest.approx(rows[1].area)


def test_a_mask_is_filled_by_curved_cells():
    labels = tetopt.load_phantom("sphere").label_image(voxel_mm=2)
    mask = tetopt.Image(labels.data == 1, labels.affine)
    mesh = tetopt.mesh_image(tetopt.content(mask, mask=mask), 900, order=2, iterations=6).mesh
    curved, flat = (tetopt.mask_fidelity(mask, each) for each in (mesh, straight(mesh)))
    assert curved.mesh_volume == pytest.approx(mesh.cell_volumes.sum())
    assert abs(curved.mesh_volume / VOLUME - 1.0) < 0.3 * abs(flat.mesh_volume / VOLUME - 1.0)
    assert curved.dice > flat.dice + 0.01
    assert curved.distance_mean < 0.7 * flat.distance_mean
    assert (curved.mesh_euler, curved.mesh_components) == (2, 1)


def test_a_run_is_judged_by_its_curved_cells(monkeypatch):
    """The same number as in the table of its labels, below which straight cells are by a tenth."""
    labels = tetopt.load_phantom("sphere").label_image(voxel_mm=4)
    target = tetopt.content(labels, labels)
    monkeypatch.setattr("tetopt.measure.judge.LEAST_VOLUME", 0.95)
    result = tetopt.mesh_image(target, 600, order=2, iterations=4)
    straight = tetopt.Mesh(result.mesh.points, result.mesh.cells)
    assert "labels" in judge(measure(straight, target, result.labels), Requirements())
    assert result.violated == {}
    assert (
        tetopt.label_fidelity(labels, result.mesh, result.labels)[1].extent.mesh_volume
        > 0.95 * (labels.data == 1).sum() * 64
    )
