"""Pictures in 3-D: what stands in them is where the image says it is."""

import numpy as np
import PIL.Image
import pytest
import pyvista

import tetopt
from tetopt.geometry.cut import plane_cut
from tetopt.model.labels import LabelTable
from tetopt.report.exhibit import exhibit, opened_on, warp_factors
from tetopt.report.scene import (
    STRUCTURE_COLOUR,
    _slice_sheet,
    dark_structure_surface,
    opened_mesh,
    plane_slice,
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
    mesh = tetopt.lattice_mesh(image, nodes=300)
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


# How `tetopt view` opens


def drawn(shown):
    """The parts of the scene, in the order in which they are drawn."""
    plotter = pyvista.Plotter(off_screen=True)
    opened_mesh(shown)(plotter)
    mappers = [actor.mapper for actor in plotter.actors.values() if isinstance(actor, pyvista.Actor)]
    for mapper in mappers:
        mapper.GetInputAlgorithm().Update()  # as a frame would
    return plotter, [mapper.dataset for mapper in mappers]


def section_area(points, cells, axis, at):
    corners = plane_cut(points, cells, points[:, axis] - at).corners
    diagonals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return np.linalg.norm(diagonals, axis=1).sum() / 2


def test_the_mesh_is_cut_across_its_middle(opengl, mesh, image):
    values = np.random.default_rng(1).normal(50.0, 20.0, len(mesh.cells))
    plotter, (behind, section, sheet) = drawn(exhibit(mesh, {"mean": values}, image))
    axis, middle = int(np.argmin(np.ptp(mesh.points, axis=0))), (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2
    # Of two parts equally near to the camera, rounding decides which is seen.
    above = section.points[:, axis] - middle[axis]
    assert 0.0 < above.min() <= above.max() < 2e-3 * np.ptp(mesh.points, axis=0).max()
    assert section.area == pytest.approx(section_area(mesh.points, mesh.cells, axis, middle[axis]), rel=1e-5)
    assert behind.points[:, axis].max() == pytest.approx(middle[axis], abs=1e-4)
    assert behind.points[:, axis].min() == pytest.approx(mesh.points[:, axis].min(), abs=1e-4)
    np.testing.assert_allclose(sheet.bounds[2 * axis : 2 * axis + 2], middle[axis], atol=1e-6)
    assert set(np.float32(section.cell_data["value"])) <= set(np.float32(values))
    assert list(plotter.scalar_bars.keys()) == ["mean (intensity)"]
    plotter.close()


def test_labels_have_their_colours_and_names(opengl, mesh):
    label = np.random.default_rng(1).integers(0, 4, len(mesh.cells))
    table = LabelTable({1: "left $x$ lung"}, {1: (1.0, 0.0, 0.0)})
    plotter, (behind, _) = drawn(exhibit(mesh, {"label": label}, table=table))
    assert len(np.unique(behind.cell_data["value"], axis=0)) == 4
    assert (behind.cell_data["value"] == [255, 0, 0]).all(axis=1).any()
    assert len(plotter.scalar_bars.keys()) == 0
    assert plotter.legend.GetNumberOfEntries() == 4
    assert plotter.legend.GetEntryString(1).replace("\\$", "$") == " 1 left $x$ lung"
    plotter.close()


def test_a_mesh_with_displacements_is_deformed_and_the_image_is_left_out(opengl, mesh, image):
    z = (mesh.points[:, 2] - mesh.points[:, 2].min()) / np.ptp(mesh.points[:, 2])
    u = np.outer(z, [1.0, 0.5, 0.0])
    shown = exhibit(mesh, {"rho": z[mesh.cells[:, 0]]}, image, point_data={"displacement": u})
    plotter, (_, section) = drawn(shown)
    points = mesh.points + warp_factors(shown)[0] * u
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    assert section.area == pytest.approx(section_area(points, mesh.cells, 2, middle[2]), rel=1e-5)
    lengths = np.linalg.norm(u, axis=1)
    value = section.point_data["value"]  # of the nodes, interpolated
    assert lengths.min() < value.min() <= value.max() < lengths.max()
    plotter.close()


def test_a_picture_is_in_the_colours_asked_for(opengl, mesh, tmp_path):
    """All cells in the colour of 50, at the ends of two ranges."""
    shown = exhibit(mesh, {"mean": np.full(len(mesh.cells), 50.0)})
    bright = []
    for name, limits in (("a", (50.0, 80.0)), ("b", (20.0, 50.0))):
        save_scenes(tmp_path / f"{name}.png", [("", opened_mesh(opened_on(shown, "mean", limits)))])
        with PIL.Image.open(tmp_path / f"{name}.png") as picture:
            pixels = np.asarray(picture.convert("RGB")).astype(int)
        height, width = pixels.shape[:2]
        middle = pixels[2 * height // 5 : 3 * height // 5, 2 * width // 5 : 3 * width // 5]
        bright.append(np.median(middle[..., 1]))
    assert bright[0] < 80 < 150 < bright[1]  # viridis runs from dark violet to yellow


def test_hostile_names_are_drawn_letter_by_letter(opengl, mesh, tmp_path, capfd):
    """VTK takes what is between dollars for a formula, and fails at bytes that are no UTF-8."""
    for name in ("$\\frac{", "$x^2$", "a\x1b[31m\nb\udcff\u202e\0c", "%s%n <b>"):
        save_scenes(tmp_path / "a.png", [("", opened_mesh(exhibit(mesh, {name: np.arange(len(mesh.cells)) + 0.5})))])
    assert "MathText" not in capfd.readouterr().err


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("affine", [None, np.diag([-2.0, 1.0, 3.0, 1.0])], ids=["tilted", "upright"])
def test_a_slice_has_the_voxel_at_every_place(image, affine, axis):
    """Also where it lies between two layers of voxels, as the middle of an upright volume may."""
    image = image if affine is None else tetopt.Image(image.data, affine)
    at = image.to_world((np.array(image.shape) - 1) / 2)[axis]
    sheet = plane_slice(image, axis, at)
    np.testing.assert_allclose(sheet.points[:, axis], at, atol=1e-5)
    index = image.to_index(np.asarray(sheet.cell_centers().points))
    is_inside = np.abs(index - np.rint(index)).max(axis=1) < (0.49 if affine is None else 0.51)
    nearest = np.floor(index + 0.5 + 1e-4).astype(int)[is_inside]
    assert np.isin(sheet.cell_data["h"][is_inside] - image.data[tuple(nearest.T)], 0.0).all()
    box = pyvista.ImageData(dimensions=(2, 2, 2), spacing=image.shape, origin=(-0.5,) * 3).cast_to_structured_grid()
    whole = box.transform(image.affine, inplace=False).slice(normal=np.eye(3)[axis], origin=np.full(3, at))
    assert sheet.area == pytest.approx(whole.area, rel=1e-4)
