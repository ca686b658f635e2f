"""Fields in mappings: images on grids of their own, by name; ranges; images linear in between."""

import json
import warnings

import numpy as np
import pytest
from models import young_of
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal
from shapes import grid

import tetopt
from tetopt.energy.sampling import cell_of_voxel, linear_values, nearest_values
from tetopt.geometry.quadratic import QUADRATIC_EDGES, STRAIGHT_PIECES
from tetopt.geometry.simplex import volumes
from tetopt.model.averages import cell_values, cell_young
from tetopt.model.build import build_model
from tetopt.model.file import MASK_TEXT, MeshFile

AVERAGES = ["mean", "geometric", "harmonic", "hill", "power:2", "gauss", "nodes", "linear"]
TURN = np.array([[0.8, -0.6, 0.0], [0.48, 0.64, -0.6], [0.36, 0.48, 0.8]])
IMAGE = tetopt.Image(np.random.default_rng(1).uniform(1.0, 9.0, (10, 9, 8)), np.diag([2, 2, 3, 1]))
VECTORS = tetopt.Field(np.ones((*IMAGE.shape, 3)), IMAGE.affine, "direction")
MESH = tetopt.lattice_mesh(IMAGE, nodes=200)


def oblique(value, shape=(17, 18, 16), spacing=(3.0, 2.5, 2.0)):
    """A function of world points on a turned grid around `IMAGE`."""
    affine = np.eye(4)
    affine[:3, :3] = TURN * spacing
    affine[:3, 3] = np.array([9.0, 8.0, 10.5]) - affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    empty = tetopt.Image(np.zeros(shape), affine)
    return tetopt.Image(value(empty.to_world(grid(shape))), affine)


def slope(x):
    return 30.0 + x @ [0.5, -0.3, 0.2]


@pytest.mark.parametrize("average", AVERAGES)
def test_a_field_on_the_image_s_grid_is_the_image(average):
    """The same bits, at Gauss points, nodes and in bins, without an image."""
    options = {"average": average, "order": 2, "bins": None if average == "nodes" else 3}
    law = "0.5*{0}**2 + 1 MPa"
    for each in (options, options | {"bins": None}):
        one = build_model(MESH, IMAGE, young=law.format("h"), nu="0.04*h", density="9+h", **each)
        of_field = {"young": law.format("mu"), "nu": "0.04*mu", "density": "9+mu"}
        other = build_model(MESH, fields={"mu": IMAGE}, **of_field, **each)
        for a, b in zip(one.materials, other.materials, strict=True):
            assert_array_equal(a, b)
        for name in ("node_young", "gauss_young"):
            assert_array_equal(getattr(one, name), getattr(other, name))
        assert not set(other.cell_data) & {"mean", "n_voxels"}


@pytest.mark.parametrize("average", AVERAGES)
def test_the_finest_grid_counts_and_others_are_linear_there(average):
    """A linear field on a coarser oblique grid is exact at the voxels of the image."""
    fields = {"s": oblique(slope), "unused": oblique(lambda x: x[..., 0] ** 2)}
    young = build_model(MESH, IMAGE, young="h*s", fields=fields, average=average, order=2)
    product = tetopt.Image(IMAGE.data * slope(IMAGE.to_world(grid(IMAGE.shape))), IMAGE.affine)
    if average == "linear":  # the product is not linear between voxels
        at = np.einsum("qa,cad->cqd", many_places(3, 4), MESH.points[MESH.cells])
        expected = linear_values(IMAGE, at.reshape(-1, 3)) * slope(at.reshape(-1, 3))
        assert_allclose(young_of(young), expected.reshape(len(at), -1).mean(axis=1), rtol=5e-3)
        return
    expected = build_model(MESH, product, young="h", average=average, order=2)
    assert_allclose(young_of(young), young_of(expected), rtol=1e-12)
    for name in ("node_young", "gauss_young"):
        if (other := getattr(expected, name)) is not None:
            assert_allclose(getattr(young, name), other, rtol=1e-12)


def test_a_finer_field_counts_instead_of_the_image():
    fine = oblique(slope, (60, 60, 60), (0.7, 0.7, 0.7))
    young = build_model(MESH, IMAGE, young="h*s", fields={"s": fine}, average="mean")
    owner = cell_of_voxel(fine, MESH)
    values = fine.data * linear_values(
        IMAGE, fine.to_world(grid(fine.shape)).reshape(-1, 3)
    ).reshape(fine.shape)
    inside = owner >= 0
    sums = np.bincount(owner[inside], values[inside], len(MESH.cells))
    assert_allclose(young_of(young), sums / np.bincount(owner[inside]), rtol=1e-12)


def test_the_mean_of_the_formula_is_not_the_formula_of_means():
    young = build_model(MESH, young="mu**3", fields={"mu": IMAGE}, average="mean")
    means = tetopt.cell_moments(IMAGE, MESH).mean
    assert (young_of(young) > 1.05 * means**3).sum() > 100


def test_the_data_type_and_order_of_fields_do_not_matter():
    fields = {"a": oblique(slope), "b": IMAGE}
    one = build_model(MESH, young="a/b", fields=fields)
    other = build_model(MESH, young="a/b", fields=dict(reversed(fields.items())))
    assert_array_equal(young_of(one), young_of(other))


# Voxels without a value, and beside the mesh


def test_voxels_without_a_value_take_the_nearest_one_s():
    gaps = np.zeros(IMAGE.shape, dtype=bool)
    gaps[3:5, 2:4, 6:] = gaps[0, 0, 0] = True
    holed = tetopt.Image(np.where(gaps, np.nan, 7.0), IMAGE.affine)
    share = gaps.sum() / gaps.size
    with pytest.warns(UserWarning, match=f"field mu: {share:.1%} of the voxels .* no value"):
        young = build_model(MESH, young="3*mu", fields={"mu": holed})
    assert (young_of(young) == 21.0).all()


@pytest.mark.filterwarnings("ignore:.*(mask|lie outside)")
def test_voxels_outside_the_mask_do_not_count():
    """As of a stiffness map that is 0 outside the organ, on a grid of its own."""
    ball = ((grid(IMAGE.shape) - [4.5, 4.0, 3.5]) ** 2).sum(axis=-1) < 9.0
    what = tetopt.content(IMAGE, mask=tetopt.Image(ball, IMAGE.affine))

    def value(x):
        index = np.rint(IMAGE.to_index(x)).astype(int)
        is_in_box = ((index >= 0) & (index < IMAGE.shape)).all(axis=-1)
        index = np.clip(index, 0, np.array(IMAGE.shape) - 1)
        return np.where(is_in_box & ball[tuple(np.moveaxis(index, -1, 0))], 5.0, 0.0)

    fields = {"mu": oblique(value, (30, 30, 30), (1.5, 1.5, 1.5))}
    with pytest.raises(tetopt.InputError, match="above 0"):
        build_model(MESH, IMAGE, young="2*mu", fields=fields)
    model = build_model(MESH, what, young="2*mu", fields=fields)
    assert (young_of(model) == 10.0).all()
    read = MeshFile(
        MESH, {}, {MASK_TEXT: np.array([json.dumps(model.about[MASK_TEXT])])}, n_turned=0
    )
    assert (young_of(build_model(read, young="2*mu", fields=fields)) == 10.0).all()


@pytest.mark.parametrize(
    ("field", "words"),
    [
        (
            tetopt.Image(np.ones((4, 4, 4)), np.diag([1, 1, 1, 1.0]) + 900 * np.eye(4, k=3)),
            "field mu: the mesh lies outside the image",
        ),
        (tetopt.Image(np.ones((4, 4))), "field mu: expected a 2-D mesh like the image"),
        (
            tetopt.Image(
                np.where(grid(IMAGE.shape)[..., 0] == 0, 1.0, np.nan)[:9].repeat(2, axis=0),
                np.diag([2, 2, 3, 1]) - [[0, 0, 0, 4], [0] * 4, [0] * 4, [0] * 4],
            ),
            "field mu: no voxel with data lies in the mesh",
        ),
    ],
)
def test_fields_that_are_refused(field, words):
    with refusal(words):
        build_model(MESH, young="3*mu", fields={"mu": field})
    with refusal(words):  # whose values cells get, even if no mapping names it
        build_model(MESH, young="3", fields={"mu": field})


def test_a_mesh_partly_outside_a_field():
    with pytest.warns(UserWarning, match=r"% of the nodes lie outside field mu: cells there take"):
        build_model(MESH, young="3*mu", fields={"mu": IMAGE.box((0, 0, 0), (5, 9, 8))})


@pytest.mark.parametrize(
    ("young", "fields", "words"),
    [
        ("3*nu", {"mu": IMAGE, "b": IMAGE}, r"expected numbers, h, b, mu, .*cannot use \"nu\""),
        ("3*nu", {}, r"or give `fields` nu=FILE"),
        ("mu*h", {"mu": IMAGE}, "depends on the intensity h beside fields; give the image"),
        ("mu - 20", {"mu": IMAGE}, r"0 kPa or more, got \d+ invalid values, such as -.* mu = \d"),
        ("log(mu - 5)*2", {"mu": IMAGE}, r"such as (nan|-?\d.*) at mu = .*in the whole mesh"),
        ("3", {"h": IMAGE}, 'field: expected a name .* got "h"'),
        ("3", {"max": IMAGE}, 'got "max"'),
        ("3", {"for": IMAGE}, 'got "for"'),
        ("3", {"a b": IMAGE}, 'got "a b"'),
        ("3", {"fibre": VECTORS}, 'field: "fibre" is the name of other data'),
        ("3", {"V": VECTORS, "V_coherence": IMAGE}, "coherence of the directions V; choose"),
        ("3", {"V_coherence": IMAGE, "V": VECTORS}, "coherence of the directions V; choose"),
    ],
)
def test_formulas_that_are_refused(young, fields, words):
    with refusal(words):
        build_model(MESH, young=young, fields=fields)


def test_other_quantities_are_defined_everywhere():
    with refusal("no value at mu = 0"):
        field = tetopt.Image(IMAGE.data - IMAGE.range[0], IMAGE.affine)
        build_model(MESH, young=3.0, nu="0.1/mu", fields={"mu": field})


def test_a_formula_need_not_hold_beside_the_mesh():
    box = tetopt.Image(np.full((30, 30, 30), -7.0), np.diag([1, 1, 1, 1.0]))
    data = box.data.copy()
    data[:22, :22, :27] = 4.0
    young = build_model(MESH, young="sqrt(mu)", fields={"mu": tetopt.Image(data, box.affine)})
    assert (young_of(young) == 2.0).all()


# Ranges


@pytest.mark.parametrize(
    ("text", "is_inside"),
    [
        ("2017*h**2.5 MPa for 2 < h < 6", lambda h: (h > 2) & (h < 6)),
        ("1:5, 9:20 for h <= 6", lambda h: h <= 6),
        ("where(h < 5, 3*h, 9) for h < 3 or h > 4.5", lambda h: (h < 3) | (h > 4.5)),
        ("7 for 2 < h", lambda h: h > 2),
    ],
)
def test_a_run_warns_of_volume_outside_the_range(text, is_inside):
    """Its moduli are the same as without the range."""
    with pytest.warns(UserWarning, match="young: .* of the mesh's volume is outside") as caught:
        young = build_model(MESH, IMAGE, young=text, average="mean")
    share = float(str(caught[0].message).split()[1])
    volume = volumes(MESH.points, MESH.cells)
    fraction = cell_values(IMAGE, MESH, lambda h: 1.0 * ~is_inside(h))
    assert share == pytest.approx(100.0 * (volume * fraction).sum() / volume.sum(), rel=5e-3)
    assert 2.0 < share < 98.0
    law = text.partition(" for ")[0]
    assert_array_equal(
        np.broadcast_to(young_of(young), len(MESH.cells)),
        np.broadcast_to(
            young_of(build_model(MESH, IMAGE, young=law, average="mean")), len(MESH.cells)
        ),
    )


@pytest.mark.parametrize("average", ["mean", "linear"])
def test_a_range_of_several_fields(average):
    fields = {"a": IMAGE, "b": oblique(slope)}
    with pytest.warns(UserWarning, match=r"nu: .* % .* outside .* 3 < a and b < 35, which is"):
        build_model(MESH, young=3, nu="0.3 for 3 < a and b < 35", fields=fields, average=average)


@pytest.mark.parametrize("average", ["mean", "nodes", "linear"])
def test_a_range_of_a_finer_grid_leaves_the_law_as_it_is(average):
    fields = {"co": oblique(slope), "mu": oblique(slope, (60, 60, 60), (0.7, 0.7, 0.7))}
    with pytest.warns(UserWarning, match="young: .* outside of the range of the mapping, mu < 30"):
        ranged = build_model(MESH, young="2*co**2 for mu < 30", fields=fields, average=average)
    law = build_model(MESH, young="2*co**2", fields=fields, average=average)
    assert_array_equal(young_of(ranged), young_of(law))
    assert_array_equal(ranged.node_young, law.node_young)


def test_the_intensity_in_a_range_alone_needs_an_image():
    law = {"young": "2*co for h < 5", "fields": {"co": IMAGE}}
    with refusal("young depends on intensity, but the mesh has no cell means; give the image"):
        build_model(MESH, cell_data={}, **law)
    with pytest.warns(UserWarning, match="young: .* outside of the range of the mapping, h < 5"):
        build_model(MESH, IMAGE, **law)


def test_a_law_within_its_range_is_silent(recwarn):
    build_model(MESH, IMAGE, young="3*h for 0 < h < 10")
    means = {"mean": np.full(len(MESH.cells), 4.0)}
    build_model(MESH, young="3*h for 0 < h < 10", cell_data=means)
    assert len(recwarn) == 0
    with pytest.warns(UserWarning, match="young: 100 % of"):
        build_model(MESH, young="3*h for 0 < h < 1", cell_data=means)


@pytest.mark.parametrize(
    "text", ["3*h for h", "3*h for", "3*h for x < 2", "1=2 for h > 1", "for h"]
)
def test_ranges_that_are_none(text):
    with refusal("formula: expected|by label"):
        build_model(MESH, IMAGE, young=text)


# Images that are linear between voxel centres


def many_places(n, times):
    """Barycentric places (Q, n+1) of equal weight: centroids of a simplex split again and again."""
    corners = np.eye(n + 1)[None]
    for _ in range(times):
        middles = corners[:, QUADRATIC_EDGES[: 3 * (n - 1)]].mean(axis=2)
        corners = np.concatenate([corners, middles], axis=1)[:, STRAIGHT_PIECES[n]]
        corners = corners.reshape(-1, n + 1, n + 1)
    return corners.mean(axis=1)


def small_cells(n, blocks):
    """A mesh within the outermost voxel centres of an image of noise."""
    rng = np.random.default_rng(n)
    affine = np.diag([*[3.0, 2.0, 2.5][:n], 1.0])
    image = tetopt.Image(rng.uniform(1.0, 9.0, (7, 8, 6)[:n]), affine)
    inner = image.box((1,) * n, tuple(np.array(image.shape) - 1))
    return image, tetopt.lattice_mesh(inner, blocks=(blocks,) * n)


def test_linear_images_are_exact(n):
    """As is the square of one; and a constant to the last bit."""
    image, mesh = small_cells(n, 9)
    gradient = np.array([0.5, -0.3, 0.2])[:n]
    line = tetopt.Image(9.0 + image.to_world(grid(image.shape)) @ gradient, image.affine)
    corners = 9.0 + mesh.points[mesh.cells] @ gradient
    mean = corners.mean(axis=1)
    assert_allclose(cell_young(line, mesh, None, "linear"), mean, rtol=1e-13)
    square = (corners**2).sum(axis=1) + corners.sum(axis=1) ** 2
    square /= (n + 1) * (n + 2)
    assert_allclose(cell_young(line, mesh, np.square, "linear"), square, rtol=1e-12)
    assert (cell_young(image, mesh, lambda h: 0.7 + 0.0 * h, "linear") == 0.7).all()


@pytest.mark.parametrize("blocks", [3, 8, 20])
def test_the_rule_of_linear_images_has_converged(n, blocks):
    """For noise, and a law as of bone, against thousands of points in each cell; the nearest
    voxel's value is far off.
    """
    image, mesh = small_cells(n, blocks)
    mesh = tetopt.Mesh(mesh.points, mesh.cells[:: max(1, len(mesh.cells) // 60)])

    def law(h):
        return h**2.29

    at = np.einsum("qa,cad->cqd", many_places(n, 8 - n), mesh.points[mesh.cells])
    fine = law(linear_values(image, at.reshape(-1, n))).reshape(len(at), -1).mean(axis=1)
    errors = {
        each: np.sqrt(np.mean((cell_young(image, mesh, law, each) / fine - 1.0) ** 2))
        for each in ("linear", "mean")
    }
    assert errors["linear"] < 0.003
    assert errors["mean"] > 10.0 * errors["linear"]


def test_cells_far_wider_than_voxels(monkeypatch):
    """Their number of places has a bound; the mean is still that of their voxels."""
    image = tetopt.Image(np.random.default_rng(3).uniform(1.0, 3.0, (80, 80)))
    mesh = tetopt.lattice_mesh(image, blocks=(1, 1))
    means = cell_young(image, mesh, None, "mean")
    assert_allclose(cell_young(image, mesh, None, "linear"), means, rtol=0.02)
    monkeypatch.setattr("tetopt.model.averages.VOXELS_PER_CHUNK", 7)
    small, cells = small_cells(2, 3)
    parts = cell_young(small, cells, None, "linear")
    monkeypatch.undo()
    assert_array_equal(parts, cell_young(small, cells, None, "linear"))


def test_ratios_and_densities_are_linear_with_it():
    image, mesh = small_cells(3, 9)
    model = build_model(mesh, image, young=3, nu="0.04*h", density="h", average="linear")
    expected = cell_values(image, mesh, None, is_linear=True)
    assert_allclose(model.materials.density[model.materials.of_cell], expected, rtol=1e-14)
    assert_allclose(model.materials.nu[model.materials.of_cell], 0.04 * expected, rtol=1e-12)


def test_onto_cells_and_back():
    """A noisy map with a stiff lesion, on an oblique grid, is nearer after its averages over
    voxels than after the voxel nearest to a cell, or values at nodes.
    """

    def stiffness(x):
        distance = np.sqrt(((x - [9, 8, 10]) ** 2).sum(axis=-1))
        noise = np.random.default_rng(0).normal(1.0, 0.1, distance.shape)
        return (3.0 + 0.1 * x[..., 0] + np.where(distance < 5.0, 9.0, 0.0)) * noise

    field = oblique(stiffness, (36, 36, 36), (1.2, 1.0, 0.8))
    young = build_model(MESH, young="mu", fields={"mu": field}, average="mean")
    at_nodes = linear_values(field, MESH.points)
    ways = [
        young_of(young),
        nearest_values(field, MESH.points[MESH.cells].mean(axis=1)),
        at_nodes[MESH.cells].mean(axis=1),
        at_nodes,
    ]
    errors = [np.nanstd(tetopt.field_on_image(MESH, way, field) - field.data) for way in ways]
    assert errors[0] < 0.95 * min(errors[1:])


def test_a_grid_coarser_than_cells_is_told():
    """By the finest grid that the formula names, unless it is linear."""
    coarse = {"mu": oblique(slope, (5, 5, 5), (9.0, 9.0, 9.0))}
    with pytest.warns(UserWarning, match=r"\d\d% of the cells .* of field mu .*`average` linear"):
        build_model(MESH, young="mu", fields=coarse)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*voxel centre")
        build_model(MESH, young="mu", fields=coarse, average="linear")
        fine = oblique(slope, (60, 60, 60), (0.7, 0.7, 0.7))
        build_model(MESH, young="mu*s", fields=coarse | {"s": fine})
