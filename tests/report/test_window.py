"""The window to explore a mesh with, off screen: what its sliders and keys leave to be seen is what numpy finds."""

import os
import sys

import numpy as np
import PIL.Image
import pytest

from tetopt.errors import InputError
from tetopt.geometry.cut import plane_cut
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import boundary_facets, facets
from tetopt.io.text import plain
from tetopt.model.labels import LabelTable
from tetopt.report.exhibit import exhibit, opened_on
from tetopt.report.window import has_display, plane_slice, plotter, save_screenshot, show


@pytest.fixture(scope="module")
def cell_data(mesh):
    random = np.random.default_rng(1)
    return {"mean": random.normal(50.0, 20.0, len(mesh.cells)), "label": random.integers(0, 4, len(mesh.cells))}


@pytest.fixture
def window(opengl, mesh, cell_data, image):
    shown = exhibit(mesh, cell_data, image, facet_sets={"outside": boundary_facets(mesh.cells)})
    opened = plotter(shown, off_screen=True)
    yield opened
    opened.close()


def slide(window, number, value):
    slider = window.widgets.slider_widgets[number]
    slider.GetRepresentation().SetValue(value)
    slider.InvokeEvent("InteractionEvent")


def press(window, key):
    window.iren.interactor.SetKeySym(key)
    window.iren.interactor.InvokeEvent("KeyPressEvent")


def drawn(window, name):
    mapper = window.actors[name].mapper
    mapper.GetInputAlgorithm().Update()  # as a frame would, which are not drawn before the window is shown
    return mapper.dataset


def section_area(mesh, cells, axis, at):
    corners = plane_cut(mesh.points, cells, mesh.points[:, axis] - at).corners
    diagonals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return np.linalg.norm(diagonals, axis=1).sum() / 2


def test_limits_leave_the_cells_within(window, mesh, cell_data):
    """Their number, their volume, and the part of their surface that the plane leaves."""
    slide(window, 1, 45.0)
    slide(window, 2, 60.0)
    within = (cell_data["mean"] >= 45) & (cell_data["mean"] <= 60)
    volume = volumes(mesh.points, mesh.cells)[within].sum()
    text = window.actors["count"].get_text(2)
    assert text == f"{within.sum():,} of {len(mesh.cells):,} cells, {volume:,.7g} mm³; world RAS, mm"
    slide(window, 0, mesh.points.max(axis=0)[np.argmin(np.ptp(mesh.points, axis=0))])
    surface = drawn(window, "surface")
    assert surface.n_cells == len(boundary_facets(mesh.cells[within]))
    assert within[surface.cell_data["cell"]].all()
    slide(window, 1, 70.0)  # takes the upper one along
    assert window.actors["count"].get_text(2).startswith("0 of ")
    assert "surface" not in window.actors
    assert window.widgets.slider_widgets[2].GetRepresentation().GetValue() == pytest.approx(70.0)


def test_the_plane_cuts_and_its_keys_turn_it(window, mesh):
    middle = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2
    for axis, key in enumerate("xyz"):
        press(window, key)
        slide(window, 0, middle[axis] + 1.3)
        section = drawn(window, "section")
        np.testing.assert_allclose(section.points[:, axis], middle[axis] + 1.3)
        assert section.area == pytest.approx(section_area(mesh, mesh.cells, axis, middle[axis] + 1.3))
        assert drawn(window, "surface").points[:, axis].max() == pytest.approx(middle[axis] + 1.3, abs=1e-4)
        press(window, "k")
        assert drawn(window, "surface").points[:, axis].min() == pytest.approx(middle[axis] + 1.3, abs=1e-4)
        press(window, "k")


def test_a_field_colours_the_cells(window, mesh, cell_data):
    surface = drawn(window, "surface")
    of_cell = surface.cell_data["cell"]
    np.testing.assert_allclose(surface.cell_data["value"], cell_data["mean"][of_cell], rtol=1e-6)
    assert list(window.scalar_bars.keys()) == ["mean\n(intensity)\n"]
    slide(window, 3, 1.0)
    surface = drawn(window, "surface")
    colours = {(k, *c) for k, c in zip(cell_data["label"][of_cell], surface.cell_data["colour"], strict=True)}
    assert len(colours) == len({c[1:] for c in colours}) == 4
    assert len(window.scalar_bars.keys()) == 0
    assert window.legend.GetNumberOfEntries() == 4
    low = window.widgets.slider_widgets[1].GetRepresentation()
    assert (low.GetMinimumValue(), low.GetMaximumValue(), low.GetValue()) == (0.0, 3.0, 0.0)
    press(window, "n")
    assert "value" in drawn(window, "surface").cell_data


def test_a_label_is_shown_alone(opengl, mesh, cell_data):
    """Its surface, in its colour, among the others' interfaces as glass; each in its turn, and then all."""
    label, sides = cell_data["label"], facets(mesh.cells)
    table = LabelTable({1: "left lung"}, {1: (1.0, 0.0, 0.0)})
    window = plotter(exhibit(mesh, cell_data, table=table), off_screen=True)
    slide(window, 0, mesh.points.max(axis=0)[np.argmin(np.ptp(mesh.points, axis=0))])
    assert "glass" not in window.actors
    for k in range(4):
        press(window, "l")
        text, surface = window.actors["count"].get_text(2), drawn(window, "surface")
        assert text.startswith(f"{(label == k).sum():,} of")
        assert text.splitlines()[-1] == ("label 1 left lung" if k == 1 else f"label {k}")
        assert surface.n_cells == len(boundary_facets(mesh.cells[label == k]))
        if k == 1:
            assert (surface.cell_data["colour"] == [255, 0, 0]).all()
        inner = label[sides.cells[sides.n_cells == 2]]
        is_glass = (inner[:, 0] != inner[:, 1]) & ~(inner == k).any(axis=1)
        glass = drawn(window, "glass")
        assert glass.n_cells == is_glass.sum()
        assert (label[glass.cell_data["cell"]] == inner[is_glass].max(axis=1)).all()
    press(window, "l")
    assert "glass" not in window.actors
    assert window.actors["count"].get_text(2).startswith(f"{len(label):,} of")
    window.close()


def test_the_plane_shows_mesh_image_or_both(window):
    def seen():
        return {name for name in ("section", "lines", "slice", "set") if name in window.actors}

    assert seen() == {"section", "lines", "slice"}
    press(window, "m")
    assert seen() == {"section"}
    press(window, "m")
    assert seen() == {"slice"}
    press(window, "h")
    assert seen() == {"slice", "set"}
    press(window, "h")
    assert seen() == {"slice"}


def test_it_draws(window):
    first = window.screenshot(return_img=True)
    press(window, "m")
    second = window.screenshot(return_img=True)
    assert (np.ptp(first.astype(int), axis=2) > 60).mean() > 0.02  # colours and orange lines
    assert (first != second).any(axis=2).mean() > 0.05


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_slice_has_the_voxel_at_every_place(image, axis):
    middle = image.to_world((np.array(image.shape) - 1) / 2)
    sheet = plane_slice(image, axis, middle[axis] + 0.7)
    places = sheet.cell_centers().points
    np.testing.assert_allclose(places[:, axis], middle[axis] + 0.7)
    index = image.to_index(places)
    nearest = np.rint(index).astype(int)
    inside = ((nearest >= 0) & (nearest < image.shape)).all(axis=1)
    np.testing.assert_array_equal(np.isnan(sheet.cell_data["h"]), ~inside)
    np.testing.assert_array_equal(sheet.cell_data["h"][inside], image.data[tuple(nearest[inside].T)])
    assert inside.sum() * sheet.spacing[0] ** 2 > 200  # mm^2


def test_without_an_image_or_a_second_field(opengl, mesh):
    window = plotter(exhibit(mesh, {"rho": np.linspace(0, 0.3, len(mesh.cells))}), off_screen=True)
    press(window, "m")
    press(window, "n")
    press(window, "h")
    assert "section" in window.actors
    assert len(window.widgets.slider_widgets) == 3
    window.close()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only X says whether there is a display")
@pytest.mark.parametrize("display", [None, ":7654"])
def test_without_a_display_it_is_said(monkeypatch, mesh, display):
    if display is None:
        monkeypatch.delenv("DISPLAY", raising=False)
    else:
        monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(InputError, match="no display to open a window on; use `html`") as caught:
        show(exhibit(mesh, {}))
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(not os.environ.get("DISPLAY"), reason="no display to be found")
def test_a_display_is_found():
    assert has_display()


@pytest.fixture
def bent(opengl, mesh, cell_data):
    """A window of the mesh bent in one step and sheared in another, and what its nodes move by."""
    z = (mesh.points[:, 2] - mesh.points[:, 2].min()) / np.ptp(mesh.points[:, 2])
    steps = [np.outer(z**2, [1.0, 0.5, 0.0]), np.outer(z, [0.0, -2.0, 0.3])]
    data = {"displacement": steps[0], "displacement_step2": steps[1], "von_mises_nodes": z, "von_mises_nodes_step2": -z}
    sets, forces = {"outside": boundary_facets(mesh.cells)}, {2: {"outside": [1.5, 0.0, -2.0]}}
    opened = plotter(exhibit(mesh, cell_data, None, "bent", sets, data, forces), off_screen=True)
    yield opened, steps
    opened.close()


def test_a_slider_deforms_the_mesh(bent, mesh):
    window, steps = bent
    first = window.widgets.slider_widgets[4].GetRepresentation()
    assert first.GetMinimumValue() == 0.0
    assert first.GetMaximumValue() == 5.0 * first.GetValue() > 5.0
    text = window.actors["count"].get_text(2)
    assert text.endswith(f"\ndeformation x {first.GetValue():g}, step 1")
    for factor in (0.0, 2.5):
        slide(window, 4, factor)
        points = mesh.points + factor * steps[0]
        axis = 2  # across which nothing moves
        slide(window, 0, points[:, axis].mean() + 0.3)
        deformed = type(mesh)(points, mesh.cells)
        expected = section_area(deformed, mesh.cells, axis, points[:, axis].mean() + 0.3)
        assert drawn(window, "section").area == pytest.approx(expected)
        slide(window, 0, points[:, axis].max())
        surface = drawn(window, "surface")
        np.testing.assert_allclose(np.array(surface.bounds)[1::2], points.max(axis=0), rtol=1e-6)


def test_a_field_of_the_nodes_is_interpolated_and_goes_with_the_step(bent, mesh):
    window, steps = bent
    slide(window, 4, 1.0)
    z = (mesh.points[:, 2] - mesh.points[:, 2].min()) / np.ptp(mesh.points[:, 2])
    section = drawn(window, "section")
    assert list(window.scalar_bars.keys()) == ["displacement\n(mm)\n"]
    lengths = np.linalg.norm(steps[0], axis=1)
    assert lengths.min() < section.point_data["value"].min() < section.point_data["value"].max() < lengths.max()
    press(window, "n")
    assert list(window.scalar_bars.keys()) == ["von_mises_nodes\n(kPa)\n"]
    press(window, "z")
    slide(window, 0, 0.5 * (mesh.points[:, 2].max() + mesh.points[:, 2].min()))
    np.testing.assert_allclose(drawn(window, "section").point_data["value"], 0.5, atol=1e-6)  # z where it is cut
    press(window, "s")
    assert window.actors["count"].get_text(2).endswith("deformation x 1, step 2")
    surface = drawn(window, "surface")
    assert list(window.scalar_bars.keys()) == ["von_mises_nodes\n(kPa)\n"]
    height = np.array(surface.points)[:, 2]
    at_rest = (height - mesh.points[:, 2].min()) / (np.ptp(mesh.points[:, 2]) + 0.3)  # linear in z, and so is the field
    np.testing.assert_allclose(surface.point_data["value"], -at_rest, atol=1e-6)
    slide(window, 1, -0.5)  # cells by the mean of their nodes
    within = int((-z[mesh.cells].astype(np.float32).mean(axis=1) >= -0.5 - 1e-6).sum())
    assert window.actors["count"].get_text(2).startswith(f"{within:,} of ")
    press(window, "h")
    held = "deformation x 1, step 2\noutside is held by R 1.5, A 0, S -2 mN"
    assert window.actors["count"].get_text(2).endswith(held)
    press(window, "s")
    assert window.actors["count"].get_text(2).endswith("deformation x 1, step 1")


def test_hostile_names_are_drawn_letter_by_letter(opengl, mesh, capfd):
    """VTK takes what is between dollars for a formula, and fails at bytes that are no UTF-8."""
    outside = boundary_facets(mesh.cells)
    for name in ("$\\frac{", "$x^2$", "a\x1b[31m\nb\udcff\u202e\0c", "%s%n <b>"):
        shown = exhibit(mesh, {name: np.arange(len(mesh.cells)) + 0.5}, None, name, {name: outside})
        window = plotter(shown._replace(reactions={0: {name: [1.0, 2.0, 3.0]}}), off_screen=True)
        press(window, "h")
        assert f"\n{plain(name)} is held by" in window.actors["count"].get_text(2).replace(r"\$", "$")
        window.screenshot(return_img=True)
        window.close()
    assert "MathText" not in capfd.readouterr().err


def test_a_picture_of_it_is_in_the_colours_asked_for(opengl, mesh, tmp_path):
    """All cells in the colour of 50, at the ends of two ranges; no slider and no text about keys is in it."""
    shown = exhibit(mesh, {"mean": np.full(len(mesh.cells), 50.0)})
    bright = []
    for name, limits in (("a", (50.0, 80.0)), ("b", (20.0, 50.0))):
        save_screenshot(tmp_path / f"{name}.png", opened_on(shown, "mean", limits))
        with PIL.Image.open(tmp_path / f"{name}.png") as picture:
            pixels = np.asarray(picture.convert("RGB")).astype(int)
        height, width = pixels.shape[:2]
        assert (pixels[int(0.88 * height) :, : width // 5] == 255).all()
        middle = pixels[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3]
        bright.append(np.median(middle[..., 1]))
    assert bright[0] < 80 < 150 < bright[1]  # viridis runs from dark violet to yellow
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.png", "b.png"]
