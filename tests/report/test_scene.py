"""Pictures in 3-D: what stands in them is where the image says it is."""

import numpy as np
import PIL.Image
import pytest

import tetopt
from tetopt.measure.fidelity import cell_labels
from tetopt.report import scene
from tetopt.report.colours import label_colours
from tetopt.report.scene import (
    STRUCTURE_COLOUR,
    _slice_sheet,
    dark_structure_surface,
    save_cutaway,
    save_scenes,
    slices_in_mesh,
    structure_before_slices,
)

TILTED = np.array([[1.8, -0.5, 0.0, 7.0], [0.5, 1.8, 0.0, -20.0], [0.0, 0.0, 2.5, 3.0], [0.0, 0.0, 0.0, 1.0]])


def dark_ball(shape=(30, 32, 28), centre=(13.0, 15.0, 12.0), radius=7.0):
    """A dark ball in a bright volume, and a thin dark sheet that touches it."""
    index = np.stack(np.meshgrid(*(np.arange(s) for s in shape), indexing="ij"), axis=-1)
    distance = np.linalg.norm(index - centre, axis=-1)
    data = 100.0 / (1.0 + np.exp(-2.0 * (distance - radius)))
    data[:, :, 12] = np.where(distance[:, :, 12] > radius, 20.0, data[:, :, 12])
    return tetopt.Image(data, TILTED), distance < radius


def test_dark_structure_surface_is_the_ball_without_the_sheet():
    image, inside = dark_ball()
    surface = dark_structure_surface(image, 50.0, inside)
    distance = np.linalg.norm(image.to_index(np.asarray(surface.points)) - [13.0, 15.0, 12.0], axis=1)
    assert np.median(np.abs(distance - 7.0)) < 0.05
    assert distance.max() < 10.0  # two voxels of the sheet grow back, no more
    assert surface.volume == pytest.approx(
        4 / 3 * np.pi * 7.0**3 * abs(np.linalg.det(TILTED[:3, :3])), rel=0.08
    )  # the sheet adds 6 %


def test_no_structure_is_an_empty_surface():
    image, inside = dark_ball()
    assert dark_structure_surface(image, -1.0, inside).n_points == 0


def test_scenes_are_drawn_side_by_side(tmp_path, opengl):
    image, _ = dark_ball()
    mesh = tetopt.lattice(image, nodes=300)
    cells = np.flatnonzero(tetopt.cell_moments(image, mesh).mean < 50.0)
    scenes = [("one", slices_in_mesh(image, mesh)), ("two", structure_before_slices(image, mesh, cells))]
    save_scenes(tmp_path / "a.png", scenes)
    pixels = np.asarray(PIL.Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    left, right = pixels[:, :1100], pixels[:, 1100:]
    colour = np.array([int(STRUCTURE_COLOUR[i : i + 2], 16) for i in (1, 3, 5)])

    def orange(part):  # shaded: the colour's direction, any brightness
        size = np.linalg.norm(part, axis=-1) + 1e-9
        return ((part @ colour) / (size * np.linalg.norm(colour)) > 0.99).mean()

    assert orange(right) > 0.01
    assert orange(left) < 0.001
    assert (left[..., 2] > left[..., 0] + 60).mean() > 0.005  # the blue edges


def test_slice_sheet_shows_the_middle_slice_at_its_place():
    rng = np.random.default_rng(0)
    image = tetopt.Image(rng.normal(size=(5, 8, 6)), TILTED)
    for axis, at in ((0, 4.5), (1, 3.0), (2, -0.5)):
        sheet = _slice_sheet(image, axis, at)
        centre = image.to_index(np.asarray(sheet.cell_centers().points))
        np.testing.assert_allclose(centre[:, axis], at, atol=1e-4)
        centre[:, axis] = image.shape[axis] // 2
        where = tuple(np.rint(centre).astype(int).T)
        np.testing.assert_allclose(sheet.cell_data["h"], image.data[where])


def halves():
    """Labels 1 and 2 on the two sides of a box's middle, and background around it."""
    data = np.zeros((16, 18, 14))
    data[3:8, 3:15, 3:11] = 1
    data[8:13, 3:15, 3:11] = 2
    return tetopt.Image(data, TILTED)


class Stage:
    """Stands for a plotter, and keeps what is put on it."""

    def __init__(self, draw):
        self.meshes = []
        draw(self)

    def add_mesh(self, surface, **options):
        self.meshes.append((surface, options))


def photographed(monkeypatch, path, *arguments):
    """The surfaces that `save_cutaway` has drawn, without drawing them, and its figure."""
    stages, figures = [], []
    white = np.full((30, 40, 3), 255, dtype=np.uint8)
    monkeypatch.setattr(scene, "_photograph", lambda draw: stages.append(Stage(draw)) or white)
    monkeypatch.setattr(scene, "save_figure", lambda figure, path, dpi: figures.append(figure))
    save_cutaway(path, *arguments)
    return [stage.meshes[0][0] for stage in stages], figures[0]


def test_a_cutaway_is_without_background_and_its_octant(monkeypatch, tmp_path):
    labels = halves()
    mesh = tetopt.lattice(labels, nodes=2000)
    (grey, coloured), figure = photographed(monkeypatch, tmp_path / "a.png", labels, mesh, labels)
    of_cell = cell_labels(labels, mesh)
    facets = np.sort(mesh.cells[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]], axis=2)
    node = {tuple(place): number for number, place in enumerate(mesh.points.astype(np.float32))}
    cells_of = {}
    for cell, around in enumerate(facets):
        for facet in around:
            cells_of.setdefault(tuple(facet), []).append(cell)
    points = np.asarray(coloured.points, dtype=np.float32)
    colours = np.rint(255.0 * label_colours(labels))
    means = tetopt.cell_moments(labels, mesh).mean
    kept = mesh.points[mesh.cells[of_cell > 0]]
    centre = (kept.min(axis=(0, 1)) + kept.max(axis=(0, 1))) / 2.0
    is_kept = (of_cell > 0) & ~(mesh.points[mesh.cells].mean(axis=1) > centre).all(axis=1)
    expected = {facet: cells for facet, cells in cells_of.items() if is_kept[cells].sum() == 1}
    assert 0 < is_kept.sum() < (of_cell > 0).sum() < len(of_cell)
    drawn = [tuple(sorted(node[tuple(points[p])] for p in triangle)) for triangle in coloured.regular_faces]
    assert sorted(drawn) == sorted(expected)
    for facet, colour, grey_value in zip(drawn, coloured.cell_data["colour"], grey.cell_data["h"], strict=True):
        (owner,) = (cell for cell in expected[facet] if is_kept[cell])
        np.testing.assert_array_equal(colour, colours[of_cell[owner]])
        assert grey_value == means[owner]
    assert [axes.get_title() for axes in figure.axes] == ["mean of the image in each cell", "label of each cell"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["1", "2"]


def test_a_cutaway_without_labels_shows_all_cells(monkeypatch, tmp_path):
    labels = halves()
    mesh = tetopt.lattice(labels, nodes=200)
    (grey,), figure = photographed(monkeypatch, tmp_path / "a.png", labels, mesh)
    np.testing.assert_allclose(np.ptp(np.asarray(grey.points), axis=0), np.ptp(mesh.points, axis=0), rtol=1e-5)
    assert len(figure.axes) == 1
    assert figure.legends == []


def test_a_cutaway_is_photographed_without_margins(tmp_path, opengl):
    labels = halves()
    save_cutaway(tmp_path / "a.png", labels, tetopt.lattice(labels, nodes=2000), labels)
    with PIL.Image.open(tmp_path / "a.png") as picture:
        assert picture.format == "PNG"
        pixels = np.asarray(picture.convert("RGB")).astype(float)
    right = pixels[:, int(0.48 * pixels.shape[1]) : int(0.9 * pixels.shape[1])]
    size = np.linalg.norm(right, axis=-1) + 1e-9
    for colour in label_colours(labels)[1:]:  # shaded: the colour's direction, any brightness
        assert (right @ colour / (size * np.linalg.norm(colour)) > 0.99).mean() > 0.05
    view = scene._photograph(lambda plotter: plotter.add_mesh(scene.pyvista.Sphere(), color="black", lighting=False))
    assert all((side < 255).any() for side in (view[0], view[-1], view[:, 0], view[:, -1]))


def test_nothing_but_background_is_refused(tmp_path):
    labels = halves()
    mesh = tetopt.lattice(labels, nodes=200)
    with pytest.raises(tetopt.InputError, match="background alone"):
        save_cutaway(tmp_path / "a.png", labels, mesh, tetopt.Image(np.zeros(labels.shape), TILTED))
    flat = tetopt.Image(np.zeros((6, 7)))
    with pytest.raises(tetopt.InputError, match="tetrahedra"):
        save_cutaway(tmp_path / "a.png", flat, tetopt.lattice(flat, nodes=20))
