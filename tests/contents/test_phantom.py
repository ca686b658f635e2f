"""Phantoms: the exact h(x), its rendering to voxels, the files, and every message."""

import math
import tracemalloc

import numpy as np
import pytest
from scipy.special import ndtr

import tetopt.contents.phantom
from tetopt.contents.phantom import (
    Shape,
    load_phantom,
    phantom_folder,
    phantom_names,
    signed_distance,
)
from tetopt.errors import InputError

HEAD_2D = """
name = "test"
description = "of a test"
size_mm = [20, 20]
voxel_mm = 1
background = { intensity = 10, label = 0 }
"""
HEAD_3D = HEAD_2D.replace("[20, 20]", "[20, 20, 20]")
DISC = """
[[shape]]
kind = "ellipsoid"
center_mm = [0, 0]
radii_mm = 5
intensity = 50
label = 1
"""
SHIPPED = [
    "constant",
    "disc_2d",
    "ellipsoids_brain",
    "fig2_2d",
    "layered_oblique",
    "prostate_2d",
    "sphere",
    "two_spheres",
]


@pytest.fixture
def made(tmp_path):
    """A function from a file's text to its phantom."""

    def phantom(text):
        path = tmp_path / "test.toml"
        path.write_text(text, encoding="utf-8")
        return load_phantom(path)

    return phantom


def shape_text(kind, **values):
    """One [[shape]] table of intensity 50 and label 1."""
    lines = {"intensity": 50, "label": 1, **values}
    return f'\n[[shape]]\nkind = "{kind}"\n' + "".join(
        f"{key} = {value}\n" for key, value in lines.items()
    )


def rotation(degrees):
    """The rotation matrix by hand: one angle in the plane, or about the fixed axes x, then y,
    then z.
    """
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    if np.ndim(degrees) == 0:
        return np.array([[c, -s], [s, c]])
    about_x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    about_y = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    about_z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def random_shape(kind, n, rng, made):
    """A shape in general position with points exactly on its surface and their outward normals."""
    center = rng.uniform(-3, 3, n).tolist()
    lengths = rng.uniform(1, 9, n)
    angles = rng.uniform(-180, 180, 3).tolist() if n == 3 else float(rng.uniform(-180, 180))
    R = rotation(angles)
    directions = rng.normal(size=(500, n))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    if kind == "ellipsoid":
        values = {"center_mm": center, "radii_mm": lengths.tolist(), "rotation_deg": angles}
        surface, normals = (directions * lengths) @ R.T + center, (directions / lengths) @ R.T
    elif kind == "box":
        values = {"center_mm": center, "size_mm": lengths.tolist(), "rotation_deg": angles}
        local = rng.uniform(-1, 1, (500, n))
        axis = rng.integers(n, size=500)
        normals = np.zeros((500, n))
        normals[np.arange(500), axis] = local[np.arange(500), axis] = rng.choice([-1.0, 1.0], 500)
        surface, normals = (local * lengths / 2) @ R.T + center, normals @ R.T
    else:
        normal = directions[0]
        offset, thickness = float(rng.uniform(-5, 5)), float(rng.uniform(0.05, 4))
        values = {"normal": (7 * normal).tolist(), "offset_mm": offset, "thickness_mm": thickness}
        side = rng.choice([-1.0, 1.0], 500)[:, None]
        along = rng.uniform(-20, 20, (500, n))
        along -= (along @ normal)[:, None] * normal
        surface, normals = along + (offset + side * thickness / 2) * normal, side * normal
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return (
        made((HEAD_2D if n == 2 else HEAD_3D) + shape_text(kind, **values)).shapes[0],
        surface,
        normals,
    )


# --- the exact h(x)


def test_exact_intensities_at_points(made):
    phantom = made(
        HEAD_2D
        + shape_text("ellipsoid", center_mm=[1, 2], radii_mm=[4, 2], rotation_deg=90)
        + shape_text("box", center_mm=[-5, -5], size_mm=[4, 2], intensity=70, label=2)
        + shape_text("layer", normal=[0, 3], offset_mm=-9, thickness_mm=1, intensity=0.5, label=3)
    )
    points = [
        [1, 5.99],
        [1, 6.01],
        [2.99, 2],
        [3.01, 2],
        [-7, -6],
        [-7.01, -6],
        [1e6, -9.5],
        [1e6, -9.51],
    ]
    assert phantom.intensity(points).tolist() == [50, 10, 50, 10, 70, 10, 0.5, 10]
    assert phantom.labels(points).tolist() == [1, 0, 1, 0, 2, 0, 3, 0]


def test_later_shapes_are_painted_over_earlier(made):
    big = shape_text("ellipsoid", center_mm=[0, 0], radii_mm=5, intensity=50, label=1)
    small = shape_text("ellipsoid", center_mm=[0, 0], radii_mm=2, intensity=90, label=2)
    points = [[0, 0], [3, 0], [6, 0]]
    assert made(HEAD_2D + big + small).intensity(points).tolist() == [90, 50, 10]
    assert made(HEAD_2D + small + big).intensity(points).tolist() == [50, 50, 10]
    assert made(HEAD_2D + small + big).image().data[10, 10] == 50


@pytest.mark.parametrize("shape", [(2,), (7, 2), (3, 4, 2), (0, 2)])
def test_points_keep_their_leading_shape(shape):
    phantom = load_phantom("disc_2d")
    assert phantom.intensity(np.zeros(shape)).shape == shape[:-1]
    assert phantom.labels(np.zeros(shape)).shape == shape[:-1]


# --- signed distances


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("kind", ["ellipsoid", "box", "layer"])
def test_signed_distance_is_zero_on_the_surface_and_has_the_side_as_its_sign(kind, n, made):
    rng = np.random.default_rng(1)
    for _ in range(20):
        shape, surface, normals = random_shape(kind, n, rng, made)
        np.testing.assert_allclose(signed_distance(shape, surface), 0.0, atol=1e-13)
        assert (signed_distance(shape, surface + 1e-6 * normals) > 0).all()
        assert (signed_distance(shape, surface - 1e-6 * normals) < 0).all()


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("kind", ["ellipsoid", "box", "layer"])
def test_signed_distance_has_lipschitz_constant_one(kind, n, made):
    """No pair of points, near or far, changes it faster; and some pairs reach it."""
    rng = np.random.default_rng(2)
    steepest = 0.0
    for _ in range(20):
        shape, _, _ = random_shape(kind, n, rng, made)
        a = rng.uniform(-12, 12, (2000, n))
        b = a + rng.normal(size=a.shape) * 10.0 ** rng.uniform(-3, 1, (2000, 1))
        change = np.abs(signed_distance(shape, a) - signed_distance(shape, b))
        length = np.linalg.norm(a - b, axis=1)
        assert (change <= length * (1 + 1e-9) + 1e-13).all()
        steepest = max(steepest, (change / length).max())
    assert steepest > 0.99


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("kind", ["box", "layer"])
def test_signed_distance_of_box_and_layer_is_the_distance(kind, n, made):
    """Stepping off a face along its normal, by less than half the shape, costs exactly the step."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        shape, surface, normals = random_shape(kind, n, rng, made)
        np.testing.assert_allclose(signed_distance(shape, surface + 3 * normals), 3, atol=1e-12)
        if kind == "layer":
            depth = 0.9 * shape.half[0]
            np.testing.assert_allclose(
                signed_distance(shape, surface - depth * normals), -depth, atol=1e-12
            )
    corner = Shape("box", np.zeros(2), np.eye(2), np.array([1.0, 2.0]), 1.0, 1)
    assert signed_distance(corner, [4.0, 6.0]) == 5.0


# --- voxels


@pytest.mark.parametrize(
    ("name", "voxel", "supersample"),
    [
        ("constant", 4, 4),
        ("disc_2d", 2, 4),
        ("ellipsoids_brain", 6, 3),
        ("fig2_2d", 1, 4),
        ("layered_oblique", [2, 2, 6], 4),
        ("sphere", 2, 4),
        ("two_spheres", 2, 4),
    ],
)
def test_voxels_are_means_of_all_their_sub_voxels(name, voxel, supersample):
    """The slow twin: every voxel is supersampled, none is taken for whole. So no cut voxel is
    missed.

    The numbers are such that no midpoint lies on a surface, where the last bit would decide.
    """
    phantom = load_phantom(name)
    image = phantom.image(voxel, supersample=supersample)
    blocks = phantom.image(np.array(voxel) / supersample, supersample=1).data.astype(np.float64)
    for axis, size in enumerate(image.shape):
        blocks = np.stack(np.split(blocks, size, axis), axis).mean(axis + 1)
    np.testing.assert_allclose(image.data, blocks, rtol=1e-12, atol=1e-12)


def test_a_whole_voxel_is_exact_even_when_its_intensity_is_no_binary_fraction(made):
    """The plain mean of 7 x 7 times 0.7 is off by a rounding; that would be variance in a
    constant region.
    """
    assert np.full((1, 49), 0.7).mean(axis=1) != 0.7, "the numbers no longer show the difference"
    text = HEAD_2D.replace("intensity = 10", "intensity = 0.7")
    text += shape_text("ellipsoid", center_mm=[0, 0], radii_mm=[9, 0.5], intensity=0.7)
    assert np.unique(made(text).image(supersample=7).data).tolist() == [0.7]


@pytest.mark.parametrize("n", [2, 3])
def test_a_surface_that_cuts_off_no_more_than_a_corner_is_not_missed(n, made):
    """A diagonal half-space takes one of 16^n sub-voxels from [0, 1]^n, the last, its midpoint
    at 31/32.
    """
    start = (n * 31 / 32 - 0.002) / math.sqrt(n)
    layer = shape_text("layer", normal=[1] * n, offset_mm=start + 50, thickness_mm=100)
    image = made((HEAD_2D if n == 2 else HEAD_3D) + layer).image(supersample=16)
    beyond = image.to_world(np.stack(np.indices(image.shape), axis=-1)).sum(axis=-1)
    assert np.unique(image.data[np.abs(beyond - n / 2) < 0.1]).tolist() == [10 + 40 / 16**n]
    assert (image.data[beyond < n / 2 - 0.1] == 10).all()


def test_a_midpoint_on_the_surface_is_inside(made):
    """The layer |x| <= 1/8 ends on the midpoints of the sub-voxels next to x = 0; they belong to
    it.
    """
    phantom = made(HEAD_2D + shape_text("layer", normal=[1, 0], offset_mm=0, thickness_mm=0.25))
    assert phantom.intensity([0.125, 3]) == 50
    assert phantom.image().data[:, 0].tolist() == [10] * 9 + [20, 20] + [10] * 9


@pytest.mark.parametrize("n", [2, 3])
def test_oblique_sheared_image_has_the_sphere_where_the_file_says(n, made):
    """Its centroid is right to 0.01 mm; the affine's columns are the file's rows; the box is
    covered.
    """
    axes = np.array([[0.9, 0.4, 0.1], [-0.5, 0.8, 0.0], [0.1, -0.3, 1.0]])[:n, :n]
    center, world_center = [2.5, -1.5, 0.7][:n], [40.0, -30.0, 12.0][:n]
    place = (np.array(center) + world_center).tolist()
    text = (HEAD_2D if n == 2 else HEAD_3D).replace(
        "voxel_mm = 1", f"voxel_mm = {[0.5, 0.7, 1.7][:n]}"
    )
    text = text.replace(
        "background", f"axes = {(3 * axes).tolist()}\ncenter_mm = {world_center}\nbackground"
    )
    image = made(text + shape_text("ellipsoid", center_mm=place, radii_mm=5)).image()
    assert image.shape == (40, 29, 12)[:n]
    unit = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    np.testing.assert_allclose(
        image.affine[:-1, :-1], unit.T * (20 / np.array(image.shape)), rtol=1e-14, atol=1e-15
    )
    np.testing.assert_allclose(
        image.to_world((np.array(image.shape) - 1) / 2), world_center, rtol=1e-14
    )
    assert image.volume == pytest.approx(20**n * abs(np.linalg.det(unit)), rel=1e-13)
    weight = image.data.astype(np.float64) - 10
    index = np.stack(np.indices(image.shape), axis=-1)
    centroid = (weight[..., None] * image.to_world(index)).sum(axis=tuple(range(n))) / weight.sum()
    np.testing.assert_allclose(centroid, place, atol=0.01)


def test_blurred_edge_is_the_error_function_along_either_axis(made):
    """A half-plane blurred by sd 2 mm is 10 + 40 Phi(x / 2), along axes of 0.25 and of 0.5 mm.

    On voxels of edge d the integral becomes a midpoint sum, which is as if the variance were less
    by d^2 / 12. What remains is scipy's cut at 4 sd: 3e-5 of the step, or 0.0013.
    """
    for axis, normal in enumerate(([1, 0], [0, 1])):
        phantom = made(HEAD_2D + shape_text("layer", normal=normal, offset_mm=50, thickness_mm=100))
        image = phantom.image([0.25, 0.5], blur_mm=2)
        x = image.to_world(np.stack(np.indices(image.shape), axis=-1))[..., axis]
        spread = math.sqrt(4 - image.spacing[axis] ** 2 / 12)
        inner = np.abs(x) < 2  # farther out the border's continuation is felt
        np.testing.assert_allclose(
            image.data[inner], 10 + 40 * ndtr(x[inner] / spread), atol=0.002, rtol=0
        )


def test_noise_is_seeded_white_and_added_last():
    """32,768 samples: mean and sd within five standard errors, neighbours uncorrelated likewise."""
    phantom = load_phantom("sphere")
    clean = phantom.image(2, blur_mm=3).data
    noisy = [phantom.image(2, blur_mm=3, noise_sd=7, seed=seed).data for seed in (1, 1, 2)]
    np.testing.assert_array_equal(noisy[0], noisy[1])
    assert (noisy[0] != noisy[2]).all()
    noise = noisy[0] - clean
    assert abs(noise.mean()) < 5 * 7 / math.sqrt(noise.size)
    assert noise.std() == pytest.approx(7, abs=5 * 7 / math.sqrt(2 * noise.size))
    for axis in range(3):
        a, b = np.delete(noise, -1, axis), np.delete(noise, 0, axis)
        assert abs((a * b).mean()) / 49 < 5 / math.sqrt(a.size)


def test_file_options_are_the_defaults_and_arguments_win(made):
    text = HEAD_2D.replace("background", "blur_mm = 1\nnoise_sd = 2\nseed = 3\nbackground") + DISC
    phantom = made(text)
    plain = made(HEAD_2D + DISC)
    np.testing.assert_array_equal(
        phantom.image().data, plain.image(voxel_mm=1, blur_mm=1, noise_sd=2, seed=3).data
    )
    np.testing.assert_array_equal(phantom.image(blur_mm=0, noise_sd=0).data, plain.image().data)
    assert phantom.image(np.array([2, 5])).shape == (10, 4)


@pytest.mark.parametrize(
    ("voxel", "count"), [(20, 1), (14, 1), (13, 2), (3, 7), (0.3, 67), (1, 20)]
)
def test_voxels_are_adjusted_to_cover_the_box_exactly(voxel, count, made):
    image = made(HEAD_2D + DISC).image(voxel)
    assert image.shape == (count, count)
    np.testing.assert_allclose(image.to_world([-0.5, count - 0.5]), [-10, 10], rtol=1e-14)


def test_memory_stays_small():
    """The sub-voxels of the cut voxels, 18 million points, would be 425 MB at once."""
    tracemalloc.start()
    load_phantom("sphere").image(2, supersample=20)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6


# --- the folder


def test_names_are_those_of_the_folder():
    assert phantom_names() == SHIPPED
    assert phantom_folder().is_dir()


def test_folder_inside_the_installed_package_comes_first(tmp_path, monkeypatch):
    package = tmp_path / "site-packages" / "tetopt"
    (package / "phantoms").mkdir(parents=True)
    monkeypatch.setattr(
        tetopt.contents.phantom, "__file__", str(package / "contents" / "phantom.py")
    )
    assert phantom_folder() == (package / "phantoms").resolve()


@pytest.mark.full
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_phantom(name):
    """It is named as its file, and on every voxel its labels and unblurred centres are those of
    h(x).
    """
    phantom = load_phantom(name)
    assert phantom.name == name
    size = 4.0 if name == "ellipsoids_brain" else None
    labels = phantom.label_image(voxel_mm=size)
    image = phantom.image(voxel_mm=size, blur_mm=0, noise_sd=0, supersample=1)
    np.testing.assert_array_equal(labels.affine, image.affine)
    centers = labels.to_world(np.stack(np.indices(labels.shape), axis=-1))
    np.testing.assert_array_equal(labels.data, phantom.labels(centers))
    np.testing.assert_array_equal(image.data, phantom.intensity(centers))
    assert set(np.unique(labels.data)) == {0, *(shape.label for shape in phantom.shapes)}
    values = [phantom.background_intensity, *(shape.intensity for shape in phantom.shapes)]
    assert min(values[1:], default=1) > 0
    assert (values[0] > 0) == (name != "ellipsoids_brain")


# --- messages


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "name = ",
            "name ",
            "expected TOML, got Expected '=' after a key .*; correct the file there",
        ),
        ("size_mm = [20, 20]", "", "missing size_mm; name, description, size_mm, voxel_mm"),
        ('name = "test"\nd', 'd = "x"\nd', "missing name; "),
        (
            "voxel_mm = 1",
            "voxel_mm = 1\nvoxels = 3",
            "unknown 'voxels'; the keys allowed here are name, desc",
        ),
        ('"test"', "3", "name: expected a quoted string, got 3"),
        (
            "[20, 20]",
            "[20]",
            "size_mm: expected a list of 2 or 3 numbers, one per axis, got \\[20\\]",
        ),
        ("[20, 20]", "[20, 0]", "size_mm: expected lengths above 0 mm, got \\[20.0, 0.0\\]"),
        (
            "voxel_mm = 1",
            "voxel_mm = [1, 21]",
            "voxel_mm: expected voxels no larger than the box of",
        ),
        (
            "voxel_mm = 1",
            'voxel_mm = 1\nnoise_sd = "1"',
            "noise_sd: expected a finite number, 0 or more",
        ),
        (
            "voxel_mm = 1",
            "voxel_mm = 1\nseed = 1.5",
            "seed: expected an integer from 0 to 2147483647, got",
        ),
        (
            "voxel_mm = 1",
            "voxel_mm = 1\naxes = [[1, 0]]",
            "axes: expected 2 rows, the directions of the",
        ),
        (
            "voxel_mm = 1",
            "voxel_mm = 1\naxes = [[1, 1], [2, 2]]",
            "axes: the directions .* do not span 2-D",
        ),
        (
            "{ intensity = 10, label = 0 }",
            "10",
            "background: expected a table, got 10; for example",
        ),
        (
            "{ intensity = 10, label = 0 }",
            "{ label = 0 }",
            "background: missing intensity; intensity",
        ),
        (
            "[[shape]]",
            "[shape]",
            "shape: expected tables, got .*; start each shape with \\[\\[shape\\]\\]",
        ),
        (
            '"ellipsoid"',
            '"sphere"',
            "shape 1: kind: expected one of ellipsoid, box, layer, got 'sphere'",
        ),
        (
            'kind = "ellipsoid"',
            'kind = "layer"',
            "shape 1: layer: missing normal, offset_mm, thickness_mm;",
        ),
        (
            "label = 1",
            "label = 1\ncolor = 1",
            "shape 1: ellipsoid: unknown 'color'; the keys allowed here",
        ),
        (
            "= 1\n",
            "= 1\nrotation_deg = [1, 2, 3]\n",
            "shape 1: rotation_deg: expected a finite number, got",
        ),
        (
            "radii_mm = 5",
            'name = "a\\nb"\nradii_mm = 0',
            "shape 1 'a.nb': radii_mm: expected lengths above",
        ),
    ],
)
def test_messages_of_a_file(old, new, message, made, tmp_path):
    text = HEAD_2D + DISC
    # From the back where the change is one to the shape, from the front where it is one to the top.
    head, separator, tail = (
        text.rpartition(old) if message.startswith("shape") else text.partition(old)
    )
    assert separator, f"{old!r} is not in the file"
    with pytest.raises(InputError, match=message) as caught:
        made(head + new + tail)
    assert str(caught.value).startswith(f"phantom {tmp_path / 'test.toml'}: ")
    assert "\n" not in str(caught.value)


def test_message_of_an_unknown_name_lists_the_known():
    with pytest.raises(InputError) as caught:
        load_phantom("spere")
    assert str(caught.value) == (
        f"phantom 'spere': no such phantom; use one of {', '.join(SHIPPED)}, or the path of a "
        ".toml file"
    )


def test_messages_of_a_file_that_cannot_be_read(tmp_path):
    with pytest.raises(
        InputError, match=r"nothing.toml: no such file; .* or use one of the names constant"
    ):
        load_phantom(tmp_path / "nothing.toml")
    with pytest.raises(InputError, match=r"expected a \S+( \S+)*, got a folder"):
        load_phantom(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'name = "M\xfcller"')
    with pytest.raises(InputError, match=r"latin.toml: expected UTF-8 text"):
        load_phantom(tmp_path / "latin.toml")


@pytest.mark.parametrize(
    ("head", "kind", "values", "message"),
    [
        (HEAD_2D, "layer", {"normal": [0, 0], "offset_mm": 0, "thickness_mm": 1}, "normal"),
        (HEAD_2D, "layer", {"normal": [0, 1], "offset_mm": 0, "thickness_mm": 0}, "thickness_mm"),
        (HEAD_2D, "layer", {"normal": [0, 1], "offset_mm": "nan", "thickness_mm": 1}, "offset_mm"),
        (HEAD_2D, "layer", {"normal": [0, 1], "rotation_deg": 5}, "layer: missing offset_mm"),
        (
            HEAD_3D,
            "box",
            {"center_mm": [0, 0, 0], "size_mm": 1, "rotation_deg": 30},
            "rotation_deg",
        ),
    ],
)
def test_messages_of_a_shape(head, kind, values, message, made):
    with pytest.raises(InputError, match=f"shape 1: {message}"):
        made(head + shape_text(kind, **values))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"voxel_mm": "1"}, "voxel_mm: expected a number or a list of 3, all finite, got '1'"),
        (
            {"voxel_mm": 65},
            "voxel_mm: expected voxels no larger than the box of \\[64.0, 64.0, 64.0\\] mm",
        ),
        (
            {"voxel_mm": 0.001},
            "voxel_mm: expected at most 2\\*\\*31 voxels, got 64000 x 64000 x 64000 of",
        ),
        (
            {"voxel_mm": 1e-308},
            "voxel_mm: expected at most 2\\*\\*31 voxels, got inf x inf x inf of",
        ),
        ({"blur_mm": -1}, "blur_mm: expected a finite number, 0 or more, got -1"),
        ({"seed": -1}, "seed: expected an integer from 0 to 2147483647, got -1"),
        ({"supersample": 0}, "supersample: expected an integer from 1 to 64, got 0"),
    ],
)
def test_messages_of_rendering(options, message):
    with pytest.raises(InputError, match=f"^phantom 'sphere': {message}"):
        load_phantom("sphere").image(**options)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (
            [0.0, 0.0],
            "points: expected shape \\(..., 3\\), got \\(2,\\); give 3 world coordinates in mm",
        ),
        ([0.0, 0.0, math.nan], "points: some are NaN or infinite; remove those points"),
    ],
)
def test_messages_of_points(points, message):
    for method in (load_phantom("sphere").intensity, load_phantom("sphere").labels):
        with pytest.raises(InputError, match=f"^phantom 'sphere': {message}"):
            method(points)


def test_voxels_that_no_image_has_are_refused_before_they_are_painted(tmp_path, monkeypatch):
    text = "\n".join(
        [
            'name = "a"',
            'description = "b"',
            "size_mm = [9, 9]",
            "voxel_mm = [9, 1e-6]",
            "background = { intensity = 1 }",
        ]
    )
    (tmp_path / "a.toml").write_text(text)
    monkeypatch.setattr(tetopt.contents.phantom, "_voxel_centers", None)  # nothing may be painted
    with pytest.raises(InputError, match=r"phantom 'a': .*1000 times as long"):
        load_phantom(tmp_path / "a.toml").image()


def test_a_blur_wider_than_the_box_is_refused():
    phantom = load_phantom("disc_2d")
    assert np.ptp(phantom.image(voxel_mm=8, blur_mm=64).data) < 1.0
    with pytest.raises(InputError, match="blur_mm: expected at most the box's 64 mm, got 1e\\+20"):
        phantom.image(voxel_mm=8, blur_mm=1e20)
