"""Scenes of the paper's script: what stands in them is where the image says it is."""

import numpy as np
import PIL.Image
import pytest
from matplotlib.colors import to_rgb
from paper.scenes import (
    STRUCTURE_COLOUR,
    _slice_sheet,
    dark_structure_surface,
    slices_in_mesh,
    structure_before_slices,
)

import tetopt
from tetopt.report.scene import save_scenes

TILTED = np.array(
    [[1.8, -0.5, 0.0, 7.0], [0.5, 1.8, 0.0, -20.0], [0.0, 0.0, 2.5, 3.0], [0.0, 0.0, 0.0, 1.0]]
)
CENTRE, RADIUS = [13.0, 15.0, 12.0], 7.0  # voxels


@pytest.fixture(scope="module")
def dark_ball():
    """A dark ball in a bright volume, and a thin dark sheet that touches it; what is inside."""
    distance = np.linalg.norm(np.moveaxis(np.indices((30, 32, 28)), 0, -1) - CENTRE, axis=-1)
    data = 100.0 / (1.0 + np.exp(-2.0 * (distance - RADIUS)))
    data[:, :, 12] = np.where(distance[:, :, 12] > RADIUS, 20.0, data[:, :, 12])
    return tetopt.Image(data, TILTED), distance < RADIUS


def test_dark_structure_surface_is_the_ball_without_the_sheet(dark_ball):
    image, inside = dark_ball
    surface = dark_structure_surface(image, 50.0, inside)
    distance = np.linalg.norm(image.to_index(np.asarray(surface.points)) - CENTRE, axis=1)
    assert np.median(np.abs(distance - RADIUS)) < 0.05
    assert distance.max() < 10.0  # two voxels of the sheet grow back, no more
    ball = 4 / 3 * np.pi * RADIUS**3 * image.voxel_volume
    assert surface.volume == pytest.approx(ball, rel=0.08)  # the sheet adds 6 %
    assert dark_structure_surface(image, -1.0, inside).n_points == 0


def test_scenes_are_drawn_side_by_side(dark_ball, tmp_path, opengl):
    image, _ = dark_ball
    mesh = tetopt.lattice_mesh(image, nodes=300)
    cells = np.flatnonzero(tetopt.cell_moments(image, mesh).mean < 50.0)
    before = structure_before_slices(image, mesh, cells)
    save_scenes(tmp_path / "a.png", [("one", slices_in_mesh(image, mesh)), ("two", before)])
    pixels = np.asarray(PIL.Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    # shaded: the colour's direction, any brightness
    along = pixels @ (to_rgb(STRUCTURE_COLOUR) / np.linalg.norm(to_rgb(STRUCTURE_COLOUR)))
    is_orange = along > 0.99 * (np.linalg.norm(pixels, axis=-1) + 1e-9)
    assert is_orange[:, 1100:].mean() > 0.01
    assert is_orange[:, :1100].mean() < 0.001
    left = pixels[:, :1100]
    assert (left[..., 2] > left[..., 0] + 60).mean() > 0.005  # the blue edges


@pytest.mark.parametrize(("axis", "at"), [(0, 4.5), (1, 3.0), (2, -0.5)])
def test_slice_sheet_shows_the_middle_slice_at_its_place(axis, at):
    image = tetopt.Image(np.random.default_rng(0).normal(size=(5, 8, 6)), TILTED)
    sheet = _slice_sheet(image, axis, at)
    centre = image.to_index(np.asarray(sheet.cell_centers().points))
    np.testing.assert_allclose(centre[:, axis], at, atol=1e-4)
    centre[:, axis] = image.shape[axis] // 2
    pixels = image.data[tuple(np.rint(centre).astype(int).T)]
    np.testing.assert_allclose(sheet.cell_data["h"], pixels)
