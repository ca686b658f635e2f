"""The small picture of a subject: which side is which, proportions, what is drawn, and that it
is small.
"""

import io

import numpy as np
import PIL.Image
import pytest

from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.label_names import LabelTable
from tetopt.report import thumbnail
from tetopt.report.thumbnail import SIDE_PIXELS, thumbnail_png
from tetopt.start.lattice import lattice_mesh

LETTER_ROWS = 12  # lowest, with the letters of the sides
SHAPE, SPACING = (40, 50, 15), np.array([1.0, 1.0, 3.0])


def pixels(image, mesh=None, **others):
    """Red, green and blue (height, width, 3) of the picture, its upper row first; by default with
    a mesh of a few cells.
    """
    png = thumbnail_png(image, mesh or coarse(image), **others)
    with PIL.Image.open(io.BytesIO(png)) as picture:
        assert (picture.format, picture.mode) == ("PNG", "P")
        return np.asarray(picture.convert("RGB")).astype(int)


def views_of(image):
    """The axial and the sagittal one."""
    rgb = pixels(image)
    assert rgb.shape == (SIDE_PIXELS, 2 * SIDE_PIXELS, 3)
    return np.split(rgb, 2, axis=1)


def is_grey(rgb, least):
    grey = (np.ptp(rgb, axis=-1) < 40) & (rgb.min(axis=-1) >= least)
    grey[-LETTER_ROWS:] = False
    return grey


def bright_place(rgb):
    """Pixels to the right of the middle, and below it."""
    y, x = np.nonzero(is_grey(rgb, 150))
    return x.mean() - SIDE_PIXELS / 2, y.mean() - SIDE_PIXELS / 2


def ball(centre=(20.0, 25.0, 21.0), radius=8.0, bright=100.0):
    """A bright ball in mm of the world, x to the right, y to the front, z up."""
    affine = np.diag([*SPACING, 1.0])
    world = np.moveaxis(np.indices(SHAPE), 0, -1) * SPACING
    return Image(bright * (((world - centre) ** 2).sum(axis=-1) <= radius**2), affine)


def coarse(image):
    """A mesh of the image's box of a few cells."""
    return lattice_mesh(image, blocks=(1,) * image.ndim)


def reordered(image, order, signs):
    """The same image with its voxels in another order."""
    data = np.transpose(image.data, order)
    affine = image.affine[:, [*order, 3]].copy()
    for axis, sign in enumerate(signs):
        if sign < 0:
            affine[:3, 3] += affine[:3, axis] * (data.shape[axis] - 1)
            affine[:3, axis] *= -1.0
            data = np.flip(data, axis)
    return Image(np.ascontiguousarray(data), affine)


def test_left_is_left_and_front_is_up():
    """Of balls in the plane of one view each."""
    axial, _ = views_of(ball(centre=(8.0, 38.0, 21.0), radius=7.0))
    assert max(bright_place(axial)) < -10  # left, in front
    _, sagittal = views_of(ball(centre=(20.0, 38.0, 32.0), radius=7.0))
    x, y = bright_place(sagittal)
    assert x > 10  # in front
    assert y < -10  # above


def test_letters_say_which_side_is_which(monkeypatch):
    """In the lower corners of the views of a volume."""
    image = ball()
    is_letter = pixels(image)[-LETTER_ROWS:].min(axis=-1) > 60  # the mesh's orange has no blue
    corners = np.add.outer([0, SIDE_PIXELS], np.r_[0:12, -12:0] % SIDE_PIXELS).ravel()
    assert (is_letter[:, corners].reshape(-1, 4, 12).sum(axis=(0, 2)) >= 5).all()
    assert not np.delete(is_letter, corners, axis=1).any()
    figures = []
    monkeypatch.setattr(thumbnail, "_png", figures.append)
    plane = Image(image.data[:, :, 7], np.diag([1.0, 1.0, 1.0]))
    for each in (image, plane):
        thumbnail_png(each, coarse(each))
    sides = [[text.get_text() for text in axes.texts] for axes in figures[0].axes]
    assert sides == [["L", "R"], ["P", "A"]]
    for axes in figures[0].axes:
        assert [text.get_position() for text in axes.texts] == [(0.04, 0.05), (0.96, 0.05)]
    assert [axes.texts[:] for axes in figures[1].axes] == [[]]


@pytest.mark.parametrize(("order", "signs"), [((2, 0, 1), (1, -1, 1)), ((1, 0, 2), (-1, -1, -1))])
def test_the_order_of_voxels_does_not_matter(order, signs):
    image = ball(centre=(20.0, 30.0, 21.0))
    mesh = coarse(image)
    change = np.abs(pixels(reordered(image, order, signs), mesh) - pixels(image, mesh)).max(axis=-1)
    assert np.mean(change > 40) < 0.01  # single pixels at the ball's edge, by rounding


def test_voxels_of_other_lengths_keep_a_ball_round():
    for view in views_of(ball(centre=(19.5, 24.5, 21.0), radius=12.0)):
        wide, tall = np.ptp(np.argwhere(view[:-LETTER_ROWS, :, 2] > 90), axis=0)[::-1]
        assert wide / tall == pytest.approx(1.0, abs=0.2)  # a fifth: voxels are 3 mm high
        # mm, of the side's
        assert wide / SIDE_PIXELS == pytest.approx(24.0 / (1.16 * 50.0), abs=0.06)


def test_mesh_mask_and_labels_are_drawn():
    labels = ball(centre=(19.5, 24.5, 21.0), radius=12.0, bright=1.0)
    mesh, dark = coarse(labels), Image(np.zeros(SHAPE), labels.affine)
    plain = pixels(dark)
    red, green, blue = np.moveaxis(plain, -1, 0)
    # the boundary, at least, in both views
    assert ((red > 200) & (green > 120) & (blue < 80)).sum() > 4 * 80
    masked = pixels(dark, mask=labels)
    assert (masked[..., 2] > 150).sum() > 60 > (blue > 150).sum()
    of_cell = np.arange(len(mesh.cells)) % 2
    coloured = pixels(dark, labels=labels, of_cell=of_cell)
    assert (np.abs(coloured - plain).max(axis=-1) > 40).sum() > 2000
    np.testing.assert_array_equal(pixels(dark, labels=labels, of_cell=0 * of_cell), plain)
    table = LabelTable({}, {1: (0.0, 1.0, 0.0)})  # blue by its number
    recoloured = pixels(dark, labels=labels, of_cell=of_cell, table=table)
    assert (recoloured[..., 1] - coloured[..., 1] > 40).sum() > 2000


def test_two_lungs_are_cut_through_one():
    """Where the middle is hollow, the sagittal view is not empty."""
    left = coarse(Image(np.zeros((10, 10, 10))))
    points = np.concatenate([left.points, left.points + np.array([40.0, 0.0, 0.0])])
    mesh = Mesh(points, np.concatenate([left.cells, left.cells + len(left.points)]))
    rgb = pixels(Image(np.zeros((50, 10, 10))), mesh)
    assert (rgb[:, SIDE_PIXELS:, 0] > 200).any()


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_an_image_in_the_plane_has_one_view(spread):
    image = Image(7.0 + spread * np.random.default_rng(0).normal(size=(20, 30)))
    assert pixels(image).shape == (SIDE_PIXELS, SIDE_PIXELS, 3)


def test_a_mesh_beside_the_image_is_drawn_alone():
    image = ball()
    mesh = coarse(image)
    rgb = pixels(image, Mesh(mesh.points + 1000.0, mesh.cells))
    assert rgb[..., 0].max() > 200
    assert is_grey(rgb, 100).sum() == 0


def test_its_bytes_are_few_and_always_the_same():
    image = Image(np.random.default_rng(0).normal(size=SHAPE), np.diag([*SPACING, 1.0]))
    mesh = lattice_mesh(image, nodes=2000)
    png = thumbnail_png(image, mesh)
    assert thumbnail_png(image, mesh) == png
    assert len(png) < 20_000  # of noise, which no method makes smaller
