"""A mesh cut open: the cells shown are those that should be, in their own greys and colours."""

from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from naive import facets
from test_scripts import script

import tetopt
from tetopt.measure.fidelity import cell_labels
from tetopt.report.colours import label_colours

pytestmark = [pytest.mark.full, pytest.mark.drawn]

TILTED = np.array(
    [[1.8, -0.5, 0.0, 7.0], [0.5, 1.8, 0.0, -20.0], [0.0, 0.0, 2.5, 3.0], [0.0, 0.0, 0.0, 1.0]]
)
cut_open = script("cut_open")


def halves():
    """Labels 1 and 2 on the two sides of a box's middle, and background around it."""
    data = np.zeros((16, 18, 14))
    data[3:8, 3:15, 3:11] = 1
    data[8:13, 3:15, 3:11] = 2
    return tetopt.Image(data, TILTED)


def drawn(monkeypatch, *arguments):
    """The surfaces that `save_cutaway` draws, without drawing them, and its figure's titles and
    legend.
    """
    surfaces, figures = [], []

    class Stage:
        """Stands for a plotter, and keeps what is put on it."""

        def add_mesh(self, surface, **_):
            surfaces.append(surface)

    def photograph(draw):
        draw(Stage())
        return np.full((30, 40, 3), 255, dtype=np.uint8)

    monkeypatch.setattr(cut_open, "photograph", photograph)
    monkeypatch.setattr(cut_open, "save_figure", lambda figure, path, dpi: figures.append(figure))
    cut_open.save_cutaway("a.png", *arguments)
    titles = [axes.get_title() for axes in figures[0].axes]
    return surfaces, titles, [text.get_text() for text in figures[0].legends[0].get_texts()]


def test_a_cutaway_is_without_background_and_its_octant(monkeypatch):
    labels = halves()
    mesh = tetopt.lattice_mesh(labels, nodes=2000)
    of_cell, means = cell_labels(labels, mesh), tetopt.cell_moments(labels, mesh).mean
    corners = mesh.points[mesh.cells]
    kept = corners[of_cell > 0]
    centre = (kept.min(axis=(0, 1)) + kept.max(axis=(0, 1))) / 2.0
    is_kept = (of_cell > 0) & ~(corners.mean(axis=1) > centre).all(axis=1)
    assert 0 < is_kept.sum() < (of_cell > 0).sum() < len(of_cell)
    colours = np.rint(255.0 * label_colours(np.arange(3)))
    expected = {}
    for facet, cells in facets(mesh.cells).items():
        own = [cell for cell in cells if is_kept[cell]]
        if len(own) == 1:
            expected[facet] = (*colours[of_cell[own[0]]], means[own[0]])
    (grey, coloured), titles, names = drawn(monkeypatch, labels, mesh, labels)
    places = mesh.points.astype(np.float32)
    node = {tuple(place): number for number, place in enumerate(places)}
    points = np.asarray(coloured.points, dtype=np.float32)
    shown = {
        tuple(sorted(node[tuple(points[p])] for p in triangle)): (*colour, value)
        for triangle, colour, value in zip(
            coloured.regular_faces, coloured.cell_data["colour"], grey.cell_data["h"], strict=True
        )
    }
    assert shown == expected
    assert titles == ["mean of the image in each cell", "label of each cell"]
    assert names == ["1", "2"]
    table = tetopt.LabelTable({2: "right half"}, {2: (0.25, 0.5, 0.75)})
    (_, coloured), _, names = drawn(monkeypatch, labels, mesh, labels, table)
    assert names == ["1", "2 right half"]
    assert np.unique(coloured.cell_data["colour"], axis=0).tolist() == [
        colours[1].tolist(),
        [64, 128, 191],
    ]


def test_a_cutaway_is_photographed_without_margins(tmp_path, opengl):
    labels = halves()
    cut_open.save_cutaway(
        tmp_path / "a.png", labels, tetopt.lattice_mesh(labels, nodes=2000), labels
    )
    with PIL.Image.open(tmp_path / "a.png") as picture:
        assert picture.format == "PNG"
        pixels = np.asarray(picture.convert("RGB")).astype(float)
    right = pixels[:, int(0.48 * pixels.shape[1]) : int(0.9 * pixels.shape[1])]
    size = np.linalg.norm(right, axis=-1) + 1e-9
    for colour in label_colours(np.arange(3))[1:]:  # shaded: the colour's direction, any brightness
        assert (right @ colour / (size * np.linalg.norm(colour)) > 0.99).mean() > 0.05
    view = cut_open.photograph(
        lambda plotter: plotter.add_mesh(cut_open.pyvista.Sphere(), color="black", lighting=False)
    )
    assert all((side < 255).any() for side in (view[0], view[-1], view[:, 0], view[:, -1]))


def test_nothing_but_background_is_refused():
    labels, flat = halves(), tetopt.Image(np.zeros((6, 7)))
    empty = tetopt.Image(np.zeros(labels.shape), TILTED)
    for image, of, words in ((labels, [empty], "background alone"), (flat, [], "tetrahedra")):
        mesh = tetopt.lattice_mesh(image, nodes=20)
        with pytest.raises(tetopt.InputError, match=words):
            cut_open.save_cutaway("a.png", image, mesh, *of)


@pytest.fixture
def command(here):
    """The script's words for an image that is its own labels, and a mesh's file with a name."""
    labels = halves()
    tetopt.save_image("a.nii.gz", labels)
    about = {"label_table": tetopt.LabelTable({1: "left half"}, {})}
    mesh = tetopt.lattice_mesh(labels, nodes=200)
    tetopt.save_model("a.vtu", tetopt.build_model(mesh, labels, about=about))
    return ["a.vtu", "--image", "a.nii.gz", "--labels", "a.nii.gz", "-o", "a.png"]


def test_names_are_those_in_the_mesh_s_file(monkeypatch, command):
    """Or those of a table that is given."""
    tables = []
    Path("names.csv").write_text("label,name\n1,other half\n")
    monkeypatch.setattr(
        cut_open, "save_cutaway", lambda *arguments: tables.append(arguments[-1].names)
    )
    for more in ([], ["--label-names", "names.csv"]):
        assert cut_open.main([*command, *more]) == 0
    assert tables == [{1: "left half"}, {1: "other half"}]


def test_the_script(command, capsys, opengl):
    assert cut_open.main(command) == 0
    assert capsys.readouterr().out == "a.png: a.vtu, cut open\n"
    assert np.asarray(PIL.Image.open("a.png").convert("L")).std() > 20.0
    assert cut_open.main(command) == 2
    assert "already exists" in capsys.readouterr().err
