"""A mesh cut open: the cells shown are those that should be, in their own greys and colours."""

import numpy as np
import PIL.Image
import pytest
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
    monkeypatch.setattr(cut_open, "photograph", lambda draw: stages.append(Stage(draw)) or white)
    monkeypatch.setattr(cut_open, "save_figure", lambda figure, path, dpi: figures.append(figure))
    cut_open.save_cutaway(path, *arguments)
    return [stage.meshes[0][0] for stage in stages], figures[0]


def test_a_cutaway_is_without_background_and_its_octant(monkeypatch, tmp_path):
    labels = halves()
    mesh = tetopt.lattice_mesh(labels, nodes=2000)
    (grey, coloured), figure = photographed(monkeypatch, tmp_path / "a.png", labels, mesh, labels)
    of_cell = cell_labels(labels, mesh)
    facets = np.sort(mesh.cells[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]], axis=2)
    node = {tuple(place): number for number, place in enumerate(mesh.points.astype(np.float32))}
    cells_of = {}
    for cell, around in enumerate(facets):
        for facet in around:
            cells_of.setdefault(tuple(facet), []).append(cell)
    points = np.asarray(coloured.points, dtype=np.float32)
    colours = np.rint(255.0 * label_colours(np.arange(3)))
    means = tetopt.cell_moments(labels, mesh).mean
    kept = mesh.points[mesh.cells[of_cell > 0]]
    centre = (kept.min(axis=(0, 1)) + kept.max(axis=(0, 1))) / 2.0
    is_kept = (of_cell > 0) & ~(mesh.points[mesh.cells].mean(axis=1) > centre).all(axis=1)
    expected = {facet: cells for facet, cells in cells_of.items() if is_kept[cells].sum() == 1}
    assert 0 < is_kept.sum() < (of_cell > 0).sum() < len(of_cell)
    drawn = [
        tuple(sorted(node[tuple(points[p])] for p in triangle))
        for triangle in coloured.regular_faces
    ]
    assert sorted(drawn) == sorted(expected)
    for facet, colour, grey_value in zip(
        drawn, coloured.cell_data["colour"], grey.cell_data["h"], strict=True
    ):
        (owner,) = (cell for cell in expected[facet] if is_kept[cell])
        np.testing.assert_array_equal(colour, colours[of_cell[owner]])
        assert grey_value == means[owner]
    assert [axes.get_title() for axes in figure.axes] == [
        "mean of the image in each cell",
        "label of each cell",
    ]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["1", "2"]
    table = tetopt.LabelTable({2: "right half"}, {2: (0.25, 0.5, 0.75)})
    (_, coloured), figure = photographed(
        monkeypatch, tmp_path / "a.png", labels, mesh, labels, table
    )
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["1", "2 right half"]
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


def test_nothing_but_background_is_refused(tmp_path):
    labels = halves()
    mesh = tetopt.lattice_mesh(labels, nodes=200)
    with pytest.raises(tetopt.InputError, match="background alone"):
        cut_open.save_cutaway(
            tmp_path / "a.png", labels, mesh, tetopt.Image(np.zeros(labels.shape), TILTED)
        )
    flat = tetopt.Image(np.zeros((6, 7)))
    with pytest.raises(tetopt.InputError, match="tetrahedra"):
        cut_open.save_cutaway(tmp_path / "a.png", flat, tetopt.lattice_mesh(flat, nodes=20))


def test_names_are_those_in_the_mesh_s_file(monkeypatch, tmp_path):
    """Or those of a table that is given."""
    labels, tables = halves(), []
    tetopt.save_image(tmp_path / "a.nii.gz", labels)
    mesh = tetopt.lattice_mesh(labels, nodes=200)
    model = tetopt.build_model(
        mesh, labels, about={"label_table": tetopt.LabelTable({1: "left half"}, {})}
    )
    tetopt.save_model(tmp_path / "a.vtu", model)
    (tmp_path / "names.csv").write_text("label,name\n1,other half\n")
    monkeypatch.setattr(
        cut_open, "save_cutaway", lambda *arguments: tables.append(arguments[-1].names)
    )
    image, mesh, picture, names = (
        str(tmp_path / name) for name in ("a.nii.gz", "a.vtu", "a.png", "names.csv")
    )
    command = [mesh, "--image", image, "--labels", image, "-o", picture]
    assert cut_open.main(command) == cut_open.main([*command, "--label-names", names]) == 0
    assert tables == [{1: "left half"}, {1: "other half"}]


def test_the_script(tmp_path, capsys, opengl):
    labels = halves()
    tetopt.save_image(tmp_path / "a.nii.gz", labels)
    tetopt.save_mesh(tmp_path / "a.vtu", tetopt.lattice_mesh(labels, nodes=200))
    image, mesh, picture = (str(tmp_path / f"a.{suffix}") for suffix in ("nii.gz", "vtu", "png"))
    assert cut_open.main([mesh, "--image", image, "--labels", image, "-o", picture]) == 0
    assert capsys.readouterr().out == f"{picture}: a.vtu, cut open\n"
    assert np.asarray(PIL.Image.open(picture).convert("L")).std() > 20.0
    assert cut_open.main([mesh, "--image", image, "-o", picture]) == 2
    assert "already exists" in capsys.readouterr().err
