"""Fields on their own voxels in the cells of a mesh, against the definitions voxel by voxel."""

from itertools import permutations, product

import numba
import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt.fields.field import COLUMNS, NINE_OF_SIX, ROWS, axes_of, parse_kind, world_field
from tetopt.geometry.quadratic import numbered_edges

SHAPE = (7, 8, 9)
KINDS = {"scalar": 1, "vector": 3, "direction": 3, "tensor": 6}


def six_of(tensors):
    return tensors[..., ROWS, COLUMNS]


def sheared():
    """An oblique, anisotropic, sheared grid over most of the mesh's box."""
    affine = np.eye(4)
    turn = scipy.spatial.transform.Rotation.from_euler("xyz", [20, -15, 30], degrees=True)
    affine[:3, :3] = turn.as_matrix() @ [[2.1, 0.3, 0.0], [0.0, 2.4, 0.2], [0.0, 0.0, 1.9]]
    affine[:3, 3] = affine[:3, :3] @ (-0.5 * np.array(SHAPE)) + [0.1, 0.2, 0.3]
    return affine


@pytest.fixture(scope="module")
def mesh():
    """Cells of a few voxels and less, none of them along the grid, that leave voxels outside."""
    image = tetopt.Image(np.zeros((12, 12, 12)), np.diag([1.1, 1.2, 1.3, 1.0]))
    affine = image.affine.copy()
    affine[:3, 3] = [-6.05, -6.6, -7.15]
    return tetopt.lattice_mesh(tetopt.Image(image.data, affine), nodes=150)


@pytest.fixture(scope="module")
def components():
    """World components of each kind on SHAPE, whose tensors are positive."""
    draw = np.random.default_rng(0)
    a = draw.normal(size=(*SHAPE, 3, 3))
    tensors = six_of(a @ np.swapaxes(a, -1, -2) + 0.3 * np.eye(3))
    rows = {name: draw.normal(size=(*SHAPE, n)) for name, n in KINDS.items()}
    return rows | {"tensor": tensors}


def field_of(rows, affine, kind):
    return (
        tetopt.Image(rows[..., 0], affine) if kind == "scalar" else tetopt.Field(rows, affine, kind)
    )


def naive(rows, affine, kind, mesh):
    """Values of the cells with voxels, and which these are, one cell after the other."""
    owner = tetopt.cell_of_voxel(tetopt.Image(np.zeros(SHAPE), affine), mesh).ravel()
    rows = rows.reshape(-1, rows.shape[-1])
    cells = np.unique(owner[owner >= 0])
    values = []
    for cell in cells:
        own = rows[owner == cell]
        if kind == "tensor":
            logs = [scipy.linalg.logm(each[NINE_OF_SIX].reshape(3, 3)) for each in own]
            values.append(scipy.linalg.expm(np.mean(logs, axis=0)).ravel())
        elif kind == "direction":
            unit = own / np.linalg.norm(own, axis=1, keepdims=True)
            values.append(np.linalg.eigh(unit.T @ unit)[1][:, -1])
        else:
            values.append(own.mean(axis=0))
    return np.squeeze(values), cells


def assert_same(values, expected, kind):
    if kind == "direction":  # without sign
        values, expected = (x[..., :, None] * x[..., None, :] for x in (values, expected))
    assert_allclose(values, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_values_are_those_of_the_definition(kind, mesh, components):
    affine = sheared()
    result = tetopt.cell_field(field_of(components[kind], affine, kind), mesh)
    expected, cells = naive(components[kind], affine, kind, mesh)
    assert 20 < len(cells) < len(mesh.cells)
    assert_same(result.values[cells], expected, kind)
    assert result.n_interpolated + result.n_filled == len(mesh.cells) - len(cells)
    assert result.n_repaired == 0
    if kind == "tensor":
        assert np.linalg.eigvalsh(result.values.reshape(-1, 3, 3)).min() > 0.0


@pytest.mark.parametrize("axes", ["voxel", "fsl", "ras", "lps"])
@pytest.mark.parametrize("kind", KINDS)
def test_any_order_of_axes_gives_the_same(kind, axes, mesh, components):
    """The 48 permutations and flips of the array, with components in its axes or the world's."""
    if kind == "scalar" and axes != "voxel":
        pytest.skip("a scalar has no axes")
    affine, rows = sheared(), components[kind]
    expected = tetopt.cell_field(field_of(rows, affine, kind), mesh)
    for order, flips in product(permutations(range(3)), product((False, True), repeat=3)):
        moved, turned = rows.transpose(*order, 3), affine[:, [*order, 3]].copy()
        for axis in np.flatnonzero(flips):
            moved = np.flip(moved, axis)
            turned[:3, 3] += turned[:3, axis] * (moved.shape[axis] - 1)
            turned[:3, axis] *= -1.0
        if kind == "scalar":
            field = field_of(moved, turned, kind)
        else:
            back = np.linalg.inv(axes_of(axes, turned))
            if kind == "tensor":
                whole = moved[..., NINE_OF_SIX].reshape(*moved.shape[:3], 3, 3)
                moved = six_of(back @ whole @ back.T)
            else:
                moved = moved @ back.T
            text = f"{kind}@{axes}" + ("-upper" if kind == "tensor" else "")
            field = world_field(moved, turned, *parse_kind(text))
        result = tetopt.cell_field(field, mesh)
        assert_same(result.values, expected.values, kind)
        assert result[2:] == expected[2:]


def test_the_integral_is_that_of_the_voxels(components):
    """In a box: the sum over cells of mean times voxels is that over the voxels."""
    grid = tetopt.Image(components["scalar"][..., 0], sheared())
    mesh = tetopt.lattice_mesh(grid, nodes=60)
    owner = tetopt.cell_of_voxel(grid, mesh)
    assert owner.min() >= 0
    n_voxels = np.bincount(owner.ravel(), minlength=len(mesh.cells))
    values = tetopt.cell_field(grid, mesh).values
    assert_allclose((values * n_voxels).sum(), grid.data.sum(), rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_constant_stays(kind, mesh):
    constant = np.array(
        {"scalar": [1.7], "tensor": [1.7, 0.1, -0.2, 0.3, 0.05, 0.2]}.get(kind, [-0.8, 0.36, 0.48])
    )
    field = field_of(np.broadcast_to(constant, (*SHAPE, len(constant))), sheared(), kind)
    values = tetopt.cell_field(field, mesh).values
    expected = constant[NINE_OF_SIX] if kind == "tensor" else np.squeeze(constant)
    if kind == "direction":  # its largest component is positive
        expected = -expected if expected[np.abs(expected).argmax()] < 0.0 else expected
    expected = np.broadcast_to(expected, values.shape)
    assert_allclose(values, expected, rtol=1e-13, atol=1e-15)


def test_cells_without_a_voxel_are_interpolated():
    """Linear scalars exactly at centroids, others with an error of second order."""
    box = tetopt.Image(np.zeros((20, 20, 20)), np.diag([0.5, 0.5, 0.5, 1.0]))
    mesh = tetopt.lattice_mesh(box, nodes=2500)
    centroids = mesh.points[mesh.cells].mean(axis=1)
    errors = []
    for step in (3.1, 1.55):
        affine = np.diag([step, step, step, 1.0])
        affine[:3, 3] = -1.3 * step
        grid = tetopt.Image(np.zeros((8 if step > 2 else 14,) * 3), affine)
        places = grid.to_world(np.argwhere(np.ones(grid.shape))).reshape(*grid.shape, 3)
        small = np.setdiff1d(np.arange(len(mesh.cells)), tetopt.cell_of_voxel(grid, mesh))
        linear = tetopt.Image(places @ [1.0, -2.0, 0.5], affine)
        result = tetopt.cell_field(linear, mesh)
        assert (result.n_interpolated, result.n_filled) == (len(small), 0)
        assert_allclose(result.values[small], centroids[small] @ [1.0, -2.0, 0.5], atol=1e-12)
        wave = tetopt.cell_field(tetopt.Image(np.cos(places @ [0.5, 0.3, 0.2]), affine), mesh)
        error = wave.values[small] - np.cos(centroids[small] @ [0.5, 0.3, 0.2])
        errors.append(np.sqrt((error**2).mean()))
    assert np.log2(errors[0] / errors[1]) > 1.8


def test_cells_without_data_have_the_nearest_cell_s(mesh, components):
    affine, rows = sheared(), components["vector"].copy()
    grid = tetopt.Image(np.zeros(SHAPE), affine)
    owner = tetopt.cell_of_voxel(grid, mesh)
    is_lost = grid.to_world(np.argwhere(np.ones(SHAPE)))[:, 0].reshape(SHAPE) > 1.0
    rows[is_lost, 1] = np.nan
    result = tetopt.cell_field(tetopt.Field(rows, affine, "vector"), mesh)
    masked = tetopt.cell_field(
        tetopt.Field(components["vector"], affine, "vector"), mesh, tetopt.Image(~is_lost, affine)
    )
    assert_array_equal(result.values, masked.values)
    assert result[2:] == masked[2:]
    lost = np.setdiff1d(owner[is_lost], [*owner[~is_lost], -1])
    assert len(lost) > 3
    assert result.n_filled >= len(lost)
    centroids = mesh.points[mesh.cells].mean(axis=1)
    whole = np.setdiff1d(owner[~is_lost], [-1])
    for cell in lost:
        distances = np.linalg.norm(centroids - centroids[cell], axis=1)
        same = (result.values == result.values[cell]).all(axis=1)
        same[lost] = False
        assert distances[same].min() <= distances[whole].min() + 1e-12


def test_directions_have_no_sign_and_a_coherence(mesh):
    draw = np.random.default_rng(3)
    signs = draw.choice([-1.0, 1.0], size=(*SHAPE, 1)) * draw.uniform(0.1, 5.0, (*SHAPE, 1))
    parallel = tetopt.Field(signs * [2.0, -1.0, 2.0], sheared(), "direction")
    result = tetopt.cell_field(parallel, mesh)
    assert_allclose(result.values, np.full((len(mesh.cells), 3), [2 / 3, -1 / 3, 2 / 3]))
    assert_allclose(result.coherence, 1.0)
    turns = draw.integers(3, size=SHAPE)  # along each axis alike
    spread = tetopt.cell_field(tetopt.Field(np.eye(3)[turns], sheared(), "direction"), mesh)
    owner = tetopt.cell_of_voxel(parallel.grid, mesh)
    for cell in np.unique(owner[owner >= 0]):
        counts = np.bincount(turns[owner == cell], minlength=3)
        assert_allclose(spread.coherence[cell], counts.max() / counts.sum())


def test_tensors_that_are_not_positive_are_repaired(mesh, components):
    rows = components["tensor"].copy()
    rows[3, 3, 3] = [2.0, 0.0, 0.0, 1.0, 0.0, -0.5]
    rows[3, 4, 4] = [-2.0, 0.0, 0.0, -1.0, 0.0, -0.5]  # without a positive one: no data
    rows[4, 4, 4] = 0.0
    affine = sheared()
    owner = tetopt.cell_of_voxel(tetopt.Image(np.zeros(SHAPE), affine), mesh)
    assert owner[3, 3, 3] >= 0
    result = tetopt.cell_field(tetopt.Field(rows, affine, "tensor"), mesh)
    assert result.n_repaired == 1
    rows[3, 3, 3, 5] = 2e-3
    rows[3, 4, 4] = rows[4, 4, 4] = np.nan
    repaired = tetopt.cell_field(tetopt.Field(rows, affine, "tensor"), mesh)
    assert repaired.n_repaired == 0
    assert_allclose(result.values, repaired.values, rtol=1e-12)
    assert np.linalg.eigvalsh(result.values.reshape(-1, 3, 3)).min() > 0.0


@pytest.mark.parametrize("kind", ["vector", "direction", "tensor"])
def test_a_voxel_without_one_component_has_no_data(kind, mesh, components):
    rows = components[kind].copy()
    if kind == "tensor":  # diagonal ones, which need no rotation
        rows[..., ROWS != COLUMNS] = 0.0
    for component in range(KINDS[kind]):
        rows[component, ..., component] = np.nan
    whole = np.where(np.isnan(rows).any(axis=-1, keepdims=True), np.nan, rows)
    partly, wholly = (
        tetopt.cell_field(tetopt.Field(each, sheared(), kind), mesh) for each in (rows, whole)
    )
    assert np.isfinite(partly.values).all()
    assert_array_equal(partly.values, wholly.values)
    assert partly[2:] == wholly[2:]


def test_curved_cells_own_the_voxels_within_their_curves(mesh, components):
    """The mean over a curved cell is that over its straight pieces."""
    middles = mesh.points[numbered_edges(mesh.cells)[0]].mean(axis=1)
    bent = tetopt.Mesh(mesh.points, mesh.cells, middles + 0.25 * np.sin(middles[:, [1, 2, 0]]))
    image = tetopt.Image(components["scalar"][..., 0], sheared())
    pieces, n_pieces = bent.straight_pieces()
    owner = tetopt.cell_of_voxel(image, pieces) // n_pieces
    assert (owner != tetopt.cell_of_voxel(image, mesh)).any()
    values = tetopt.cell_field(image, bent).values
    cells = np.unique(owner[owner >= 0])
    assert_allclose(values[cells], [image.data[owner == cell].mean() for cell in cells])


def test_the_threads_do_not_matter(components):
    """Of enough voxels for several parts."""
    box = tetopt.Image(np.zeros((40, 40, 40)), np.eye(4))
    mesh = tetopt.lattice_mesh(box, nodes=300)
    rows = np.tile(components["tensor"], (6, 5, 5, 1))[:40, :40, :40]
    field = tetopt.Field(rows, np.eye(4), "tensor")
    n = numba.get_num_threads()
    values = []
    for threads in (1, numba.config.NUMBA_NUM_THREADS):
        numba.set_num_threads(threads)
        values.append(tetopt.cell_field(field, mesh).values)
    numba.set_num_threads(n)
    assert_array_equal(*values)


def test_fields_elsewhere_are_refused(mesh, components):
    affine = sheared()
    affine[:3, 3] += 40.0
    with pytest.raises(tetopt.InputError, match="no voxel with data lies in the mesh"):
        tetopt.cell_field(tetopt.Field(components["vector"], affine, "vector"), mesh)
    far = np.zeros(SHAPE)
    far[0, 0, 0] = 1.0
    with pytest.raises(tetopt.InputError, match="no voxel with data in the mask"):
        tetopt.cell_field(
            tetopt.Field(components["vector"], sheared(), "vector"),
            mesh,
            tetopt.Image(far, sheared()),
        )
    with pytest.raises(tetopt.InputError, match="3-D one like the mesh, got 2-D"):
        tetopt.cell_field(tetopt.Image(np.ones((3, 4))), mesh)
    with pytest.raises(TypeError, match="expected Image"):
        tetopt.cell_field(np.ones(SHAPE), mesh)


def test_there_and_back_is_nearer_than_nearest_and_trilinear(mesh):
    """A map like an elastogram: stiff inclusions in a soft, wavy background, noise; on a grid of
    its own. Errors are those of the voxels of the map itself.
    """
    n, steps = 40, np.diag([0.4, 0.4, 0.4, 1.0])
    steps[:3, 3] = -0.4 * (n - 1) / 2
    grid = tetopt.Image(np.zeros((n, n, n)), steps)
    places = grid.to_world(np.argwhere(np.ones(grid.shape))).reshape(n, n, n, 3)
    kpa = 3.0 + 0.5 * np.sin(places[..., 0]) * np.cos(0.7 * places[..., 1])
    kpa[np.linalg.norm(places - [2.0, 1.0, 0.0], axis=-1) < 2.5] = 9.0
    kpa[np.linalg.norm(places - [-3.0, -2.0, -1.0], axis=-1) < 1.8] = 12.0
    kpa += np.random.default_rng(5).normal(0.0, 0.3, kpa.shape)
    image = tetopt.Image(kpa, steps)
    inside = tetopt.cell_of_voxel(image, mesh) >= 0

    def error(values):
        back = tetopt.field_on_image(mesh, values, image)
        return np.sqrt(((back - kpa)[inside] ** 2).mean())

    def at(points, order):
        index = image.to_index(points).T
        return scipy.ndimage.map_coordinates(image.data, index, order=order, mode="nearest")

    own = error(tetopt.cell_field(image, mesh).values)
    nearest = error(at(mesh.points[mesh.cells].mean(axis=1), 0))
    trilinear = error(at(mesh.points, 1))
    assert own < min(nearest, trilinear), (own, nearest, trilinear)
