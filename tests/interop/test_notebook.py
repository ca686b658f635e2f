"""What a notebook shows: numbers, a picture in the page, a bar while a run goes on."""

import base64
import io
import re

import numpy as np
import PIL.Image
import pytest
from models import quadratic_model, sample_model
from refusals import refusal

import tetopt
from tetopt.engine.loop import MeshingResult
from tetopt.interop import notebook
from tetopt.report.colours import label_colours


def picture_in(markup):
    data = re.search(r'src="data:image/png;base64,([^"]+)"', markup)[1]
    return PIL.Image.open(io.BytesIO(base64.b64decode(data)))


@pytest.fixture(scope="module")
def ball():
    image = tetopt.load_phantom("sphere").image(voxel_mm=8.0)
    return image, tetopt.mesh_image(image, 200, iterations=2)


def test_a_mesh_is_one_line_and_a_card(n):
    mesh = sample_model(n).mesh
    kind = {2: "triangles", 3: "tetrahedra"}[n]
    counts = f"{len(mesh.points)} nodes, {len(mesh.cells)} {kind}"
    assert re.fullmatch(rf"Mesh\({counts}, [\d.]+( x [\d.]+)+ mm\)", repr(mesh))
    card = mesh._repr_html_()
    assert "<td" in card
    assert f"{len(mesh.cells):,}" in card
    assert "mean rho" in card
    picture = picture_in(card).convert("RGBA")
    assert max(picture.size) <= notebook.PICTURE_PIXELS
    alphas = np.asarray(picture)[..., 3]
    assert alphas.max() == 255
    assert alphas[0, 0] == 0  # transparent where there are no cells: a page in light or in dark


def test_a_section_is_grey_by_its_values():
    """The right half of a square is bright, the left one dark, and y points upwards."""
    mesh = tetopt.lattice_mesh(tetopt.Image(np.zeros((8, 8))), blocks=(4, 4))
    where = mesh.points[mesh.cells].mean(axis=1)
    for axis, low, high in ((0, (50, 100), (270, 100)), (1, (100, 270), (100, 50))):
        picture = picture_in(
            notebook.section_html(mesh.points, mesh.cells, np.sign(where[:, axis] - 3.5))
        )
        grey = picture.convert("RGBA")
        assert sum(grey.getpixel(low)[:3]) < sum(grey.getpixel(high)[:3])


def test_pictures_are_small_however_many_cells_there_are():
    rng = np.random.default_rng(0)
    mesh = tetopt.lattice_mesh(tetopt.Image(np.zeros((40, 40, 40))), nodes=5000)
    assert (
        len(notebook.section_html(mesh.points, mesh.cells, rng.normal(size=len(mesh.cells))))
        < 60_000
    )
    assert len(mesh._repr_html_()) < 60_000
    assert len(tetopt.Image(rng.normal(size=(900, 700)))._repr_html_()) < 200_000


def test_values_that_are_no_numbers_are_dark():
    assert (
        notebook.greys(np.array([np.nan, 0.0, -np.inf, 1.0]))[[0, 2]].tolist()
        == [notebook.DARKEST_GREY] * 2
    )
    assert len(set(notebook.greys(np.full(4, np.nan)).tolist())) == 1
    assert len(set(notebook.greys(np.ones(4)).tolist())) == 1


def test_data_of_any_kind_are_no_reason_for_a_card_to_fail():
    """As another program's file may call them "mean"."""
    model = sample_model()
    n_cells = len(model.mesh.cells)
    for values in (
        np.arange(n_cells) < 3,
        np.zeros((n_cells, 3)),
        np.arange(n_cells, dtype=np.uint64),
    ):
        assert "<img" in model._replace(materials=None, cell_data={"mean": values})._repr_html_()


def test_a_plane_between_two_pieces_has_no_picture():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    mesh = tetopt.Mesh(
        np.vstack([points, points + np.array([0.0, 0.0, 9.0])]), [[0, 1, 2, 3], [4, 5, 6, 7]]
    )
    assert "<img" not in mesh._repr_html_()
    assert "<table" in mesh._repr_html_()


def test_an_image_is_one_line_and_a_card():
    image = tetopt.Image(np.arange(24.0).reshape(2, 3, 4), np.diag([1.0, 2.0, 0.5, 1.0]))
    assert repr(image) == "Image(2 x 3 x 4 voxels of 1 x 2 x 0.5 mm, float32, 0 to 23)"
    card = image._repr_html_()
    assert "mean 11.5" in card
    width, height = picture_in(card).size
    assert (width, height) == (round(320 / 3), 320)  # 2 mm wide, 6 mm high


def test_a_result_tells_what_is_left_and_what_it_violates(ball):
    image, result = ball
    fraction = tetopt.E_D(image, result.mesh) / (image.data.var(dtype=np.float64) * image.volume)
    assert result.fraction == pytest.approx(fraction, rel=1e-9)
    card = result._repr_html_()
    assert f"{result.fraction:.4g} of the variance" in card
    assert f"{result.history[-1].E:.4g} of the initial" in card
    assert "violates" not in card
    assert "<b>" not in result._replace(violated={"min_dihedral": "<b>3</b> cells"})._repr_html_()
    assert (
        "min_dihedral: &lt;b&gt;3"
        in result._replace(violated={"min_dihedral": "<b>3</b> cells"})._repr_html_()
    )
    assert "left within" not in result._replace(fraction=None)._repr_html_()  # of `optimize`


def test_models_files_and_qualities_show_what_they_hold(here):
    model = sample_model()
    tetopt.save_model("a.vtu", model)
    card = model._repr_html_()
    assert all(word in card for word in ("superior", "dark", "kPa", "Young", "hold:superior"))
    assert picture_in(card)
    card = tetopt.load_mesh("a.vtu")._replace(notes=("<script>\nno",))._repr_html_()
    assert "&lt;script&gt; no" in card
    assert "min_dihedral" in card
    assert "Materials" not in quadratic_model(2)._replace(materials=None)._repr_html_()
    card = tetopt.quality(model.mesh.points, model.mesh.cells)._repr_html_()
    assert f"{len(model.mesh.cells):,}" in card
    assert "1st percentile" in card


class FakeShell:
    """What IPython's shell is to `in_kernel`; its display hook is IPython's own in the test of a
    real kernel.
    """

    kernel = object()


def test_runs_show_a_bar_in_a_notebook_alone(monkeypatch, capsys, ball):
    shown = []

    class Handle:
        def update(self, data, raw):
            shown.append(data["text/plain"])

    def display(data, display_id, raw):
        shown.append(data["text/plain"])
        return Handle()

    image, result = ball
    tetopt.optimize(image, result.mesh, iterations=1)
    assert capsys.readouterr() == ("", "")
    ipython = type("IPython", (), {"get_ipython": staticmethod(FakeShell)})
    monkeypatch.setitem(__import__("sys").modules, "IPython", ipython)
    monkeypatch.setitem(
        __import__("sys").modules, "IPython.display", type("display", (), {"display": display})
    )
    records = []
    tetopt.optimize(image, result.mesh, iterations=1, callback=records.append)
    assert shown == []
    tetopt.optimize(image, result.mesh, iterations=1)
    assert shown[0] == "tetopt: begins"
    assert [words.split(",")[0] for words in shown[1:-1]] == [
        f"tetopt: iteration {k} of 1" for k in (0, 1)
    ]
    assert re.fullmatch(r"tetopt: ended after 1 iterations \(\w+\), E [\d.]+, [\d.]+ s", shown[-1])
    del shown[:]
    tetopt.optimize_paper(image, tetopt.lattice_mesh(image, blocks=(2, 2, 2)), iterations=1)
    assert shown[-1].startswith("tetopt: ended after 1 iterations")
    assert capsys.readouterr() == ("", "")


@pytest.mark.full
def test_a_mesh_is_plotted_off_screen(opengl, tmp_path):
    mesh = sample_model().mesh
    whole, opened = (mesh.plot(cut=cut, off_screen=True) for cut in (False, True))
    assert whole.shape == opened.shape
    assert (whole != opened).any()
    by_cells = mesh.plot(
        mesh.points[mesh.cells].mean(axis=(1, 2)), name="place", screenshot=tmp_path / "a.png"
    )
    assert (
        np.asarray(PIL.Image.open(tmp_path / "a.png").convert("RGB")) == by_cells[..., :3]
    ).all()
    assert np.ptp(mesh.plot(mesh.points[:, 0], off_screen=True, cmap="gray", show_edges=False)) > 0
    assert np.ptp(sample_model(2).mesh.plot(off_screen=True)) > 0
    result = MeshingResult(
        mesh,
        [],
        "iterations",
        mesh,
        labels=(mesh.points[mesh.cells].mean(axis=(1, 2)) > 40.0).astype(int),
    )
    shown = result.plot(off_screen=True, show_edges=False, lighting=False).reshape(-1, 3)
    for colour in label_colours(np.unique(result.labels)):  # as in other pictures
        assert (shown == np.rint(255.0 * colour)).all(axis=1).sum() > 1000
    assert (result._replace(labels=None).plot(cut=False, off_screen=True) == whole).all()
    line = r"^plot: expected a number for each of \d+ cells or \d+ nodes, got"
    for values in ([1.0, 2.0], 3.0, "mean"):
        with refusal(line):
            mesh.plot(values, off_screen=True)
    for path in (tmp_path / "no folder" / "a.png", tmp_path / "a.xyz"):
        with refusal(r"^plot: .*: cannot write the picture \(.*\)$"):
            mesh.plot(screenshot=path)


@pytest.mark.slow
def test_in_a_real_kernel():
    """A cell shows a card, a bar that ends, and a static picture without trame; nothing is
    printed.
    """
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    program = (
        "import numpy as np, tetopt\n"
        "image = tetopt.Image(np.random.default_rng(0).normal(size=(6, 7)))\n"
        "result = tetopt.optimize(image, tetopt.lattice_mesh(image, blocks=(3, 3)), "
        "iterations=2)\nresult"
    )
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(program)])
    nbclient.NotebookClient(book, timeout=300, kernel_name="python3").execute()
    outputs = book.cells[0].outputs
    assert [output.output_type for output in outputs] == ["display_data", "execute_result"]
    assert "ended after" in outputs[0].data["text/html"]
    assert "<img" in outputs[1].data["text/html"]
    assert "mean rho" in outputs[1].data["text/html"]
