"""Pictures in 3-D: what stands in them is where the image says it is."""

import numpy as np
import PIL.Image
import pytest

import tetopt
from tetopt.errors import InputError
from tetopt.report.scene import (
    STRUCTURE_COLOUR,
    _slice_sheet,
    dark_structure_surface,
    save_scenes,
    slices_in_mesh,
    structure_before_slices,
    view_of,
)

TILTED = np.array(
    [[1.8, -0.5, 0.0, 7.0], [0.5, 1.8, 0.0, -20.0], [0.0, 0.0, 2.5, 3.0], [0.0, 0.0, 0.0, 1.0]]
)


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
    distance = np.linalg.norm(
        image.to_index(np.asarray(surface.points)) - [13.0, 15.0, 12.0], axis=1
    )
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
    scenes = [
        ("one", slices_in_mesh(image, mesh)),
        ("two", structure_before_slices(image, mesh, cells)),
    ]
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


# The opened mesh


@pytest.fixture(scope="module")
def opened():
    image = tetopt.load_phantom("two_spheres").image(voxel_mm=4.0)
    mesh = tetopt.lattice_mesh(image, nodes=400)
    means = np.random.default_rng(0).normal(size=len(mesh.cells))
    return mesh, means, view_of(mesh, means, "a lattice")


def kept_cells(mesh):
    middle = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2
    return np.flatnonzero(~(mesh.points[mesh.cells].mean(axis=1) > middle).all(axis=1))


def test_the_surface_encloses_the_kept_cells(opened):
    """Its volume by the divergence theorem is theirs: closed, and turned outwards."""
    mesh, _, view = opened
    corners = view.points[view.triangles]
    enclosed = np.linalg.det(corners).sum() / 6.0
    cells = mesh.points[mesh.cells[kept_cells(mesh)]]
    assert enclosed == pytest.approx(np.linalg.det(cells[:, 1:] - cells[:, :1]).sum() / 6.0)
    assert len(kept_cells(mesh)) < len(mesh.cells)


def test_a_triangle_has_the_value_of_its_cell(opened):
    mesh, means, view = opened
    cell_of = {}
    for cell in kept_cells(mesh):
        for left_out in range(4):
            corners = np.delete(mesh.points[mesh.cells[cell]], left_out, axis=0)
            cell_of.setdefault(tuple(sorted(map(tuple, corners))), []).append(cell)
    for triangle, value in zip(view.triangles, view.values, strict=True):
        (cell,) = cell_of[tuple(sorted(map(tuple, view.points[triangle])))]
        assert value == means[cell]


def test_view_of_refuses(opened):
    mesh, means, _ = opened
    with pytest.raises(InputError, match="one mean for each"):
        view_of(mesh, means[:-1], "t")
    with pytest.raises(InputError, match="tetrahedra"):
        view_of(tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]]), np.zeros(1), "t")
