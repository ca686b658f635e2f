"""Phantoms: the exact h(x), its rendering to voxels, the files, and every message."""

import math
import tracemalloc
from functools import partial

import numpy as np
import pytest
from meshes import both_dimensions, box_corners
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import ndtr
from shapes import grid

import tetopt.contents.phantom
from tetopt.contents.phantom import (
    Shape,
    load_phantom,
    phantom_folder,
    phantom_names,
    signed_distance,
)
from tetopt.errors import InputError


def head(n=2, **values):
    """The top of a file: a box of 20 mm of voxels of 1 mm, with other values."""
    lines = {
        "name": '"test"',
        "description": '"of a test"',
        "size_mm": [20] * n,
        "voxel_mm": 1,
        "background": "{ intensity = 10, label = 0 }",
    }
    return "".join(f"{key} = {value}\n" for key, value in (lines | values).items())


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


def centres(image):
    """Places of all voxels, (*shape, n)."""
    return image.to_world(grid(image.shape))


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
    lines = {"kind": f'"{kind}"', "intensity": 50, "label": 1, **values}
    return "\n[[shape]]\n" + "".join(f"{key} = {value}\n" for key, value in lines.items())


def centred(radii, **values):
    """An ellipsoid in the middle of the plane."""
    return shape_text("ellipsoid", center_mm=[0, 0], radii_mm=radii, **values)


DISC = centred(5)


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
    place = {"center_mm": rng.uniform(-3, 3, n).tolist()}
    lengths = rng.uniform(1, 9, n)
    angles = rng.uniform(-180, 180, 3).tolist() if n == 3 else float(rng.uniform(-180, 180))
    R = rotation(angles)
    directions = rng.normal(size=(500, n))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    place["rotation_deg"] = angles
    if kind == "ellipsoid":
        values = place | {"radii_mm": lengths.tolist()}
        surface, normals = directions * lengths, directions / lengths
    elif kind == "box":
        values = place | {"size_mm": lengths.tolist()}
        local = rng.uniform(-1, 1, (500, n))
        rows, axis = np.arange(500), rng.integers(n, size=500)
        normals = np.zeros((500, n))
        normals[rows, axis] = local[rows, axis] = rng.choice([-1.0, 1.0], 500)
        surface = local * lengths / 2
    else:
        normal = directions[0]
        offset, thickness = float(rng.uniform(-5, 5)), float(rng.uniform(0.05, 4))
        values = {"normal": (7 * normal).tolist(), "offset_mm": offset, "thickness_mm": thickness}
        side = rng.choice([-1.0, 1.0], 500)[:, None]
        along = rng.uniform(-20, 20, (500, n))
        along -= (along @ normal)[:, None] * normal
        surface, normals = along + (offset + side * thickness / 2) * normal, side * normal
    if kind != "layer":
        surface, normals = surface @ R.T + place["center_mm"], normals @ R.T
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return made(head(n) + shape_text(kind, **values)).shapes[0], surface, normals


# --- the exact h(x)


def test_exact_intensities_at_points(made):
    phantom = made(
        head()
        + shape_text("ellipsoid", center_mm=[1, 2], radii_mm=[4, 2], rotation_deg=90)
        + shape_text("box", center_mm=[-5, -5], size_mm=[4, 2], intensity=70, label=2)
        + shape_text("layer", normal=[0, 3], offset_mm=-9, thickness_mm=1, intensity=0.5, label=3)
    )
    rows = [
        ([1, 5.99], 50, 1),
        ([1, 6.01], 10, 0),
        ([2.99, 2], 50, 1),
        ([3.01, 2], 10, 0),
        ([-7, -6], 70, 2),
        ([-7.01, -6], 10, 0),
        ([1e6, -9.5], 0.5, 3),
        ([1e6, -9.51], 10, 0),
    ]
    points, intensities, labels = (list(column) for column in zip(*rows, strict=True))
    assert phantom.intensity(points).tolist() == intensities
    assert phantom.labels(points).tolist() == labels


def test_later_shapes_are_painted_over_earlier(made):
    big, small, points = DISC, centred(2, intensity=90, label=2), [[0, 0], [3, 0], [6, 0]]
    assert made(head() + big + small).intensity(points).tolist() == [90, 50, 10]
    covered = made(head() + small + big)
    assert covered.intensity(points).tolist() == [50, 50, 10]
    assert covered.image().data[10, 10] == 50


@pytest.mark.parametrize("shape", [(2,), (7, 2), (3, 4, 2), (0, 2)])
def test_points_keep_their_leading_shape(shape):
    phantom, points = load_phantom("disc_2d"), np.zeros(shape)
    assert phantom.intensity(points).shape == phantom.labels(points).shape == shape[:-1]


@both_dimensions
@pytest.mark.parametrize("kind", ["ellipsoid", "box", "layer"])
def test_signed_distance(kind, n, made):
    """0 on the surface, its sign the side. No pair of points, near or far, changes it faster than
    their distance, and some pairs reach that; of boxes and layers, stepping off a face along its
    normal, by less than half the shape, costs exactly the step.
    """
    rng, steepest = np.random.default_rng(1), 0.0
    for _ in range(20):
        shape, surface, normals = random_shape(kind, n, rng, made)
        at = partial(signed_distance, shape)
        assert_allclose(at(surface), 0.0, atol=1e-13)
        assert (at(surface + 1e-6 * normals) > 0).all()
        assert (at(surface - 1e-6 * normals) < 0).all()
        a = rng.uniform(-12, 12, (2000, n))
        b = a + rng.normal(size=a.shape) * 10.0 ** rng.uniform(-3, 1, (2000, 1))
        change, length = np.abs(at(a) - at(b)), np.linalg.norm(a - b, axis=1)
        assert (change <= length * (1 + 1e-9) + 1e-13).all()
        steepest = max(steepest, (change / length).max())
        if kind != "ellipsoid":
            assert_allclose(at(surface + 3 * normals), 3, atol=1e-12)
        if kind == "layer":
            depth = 0.9 * shape.half[0]
            assert_allclose(at(surface - depth * normals), -depth, atol=1e-12)
    assert steepest > 0.99


def test_signed_distance_of_a_corner():
    corner = Shape("box", np.zeros(2), np.eye(2), np.array([1.0, 2.0]), 1.0, 1)
    assert signed_distance(corner, [4.0, 6.0]) == 5.0


# --- signed distances


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
    assert_allclose(image.data, blocks, rtol=1e-12, atol=1e-12)


def test_a_whole_voxel_is_exact_even_when_its_intensity_is_no_binary_fraction(made):
    """The plain mean of 7 x 7 times 0.7 is off by a rounding; that would be variance in a
    constant region.
    """
    assert np.full((1, 49), 0.7).mean(axis=1) != 0.7, "the numbers no longer show the difference"
    text = head(background="{ intensity = 0.7, label = 0 }") + centred([9, 0.5], intensity=0.7)
    assert np.unique(made(text).image(supersample=7).data).tolist() == [0.7]


@both_dimensions
def test_a_surface_that_cuts_off_no_more_than_a_corner_is_not_missed(n, made):
    """A diagonal half-space takes one of 16^n sub-voxels from [0, 1]^n, the last, its midpoint
    at 31/32.
    """
    start = (n * 31 / 32 - 0.002) / math.sqrt(n)
    layer = shape_text("layer", normal=[1] * n, offset_mm=start + 50, thickness_mm=100)
    image = made(head(n) + layer).image(supersample=16)
    beyond = centres(image).sum(axis=-1)
    assert np.unique(image.data[np.abs(beyond - n / 2) < 0.1]).tolist() == [10 + 40 / 16**n]
    assert (image.data[beyond < n / 2 - 0.1] == 10).all()


def test_a_midpoint_on_the_surface_is_inside(made):
    """The layer |x| <= 1/8 ends on the midpoints of the sub-voxels next to x = 0; they belong to
    it.
    """
    phantom = made(head() + shape_text("layer", normal=[1, 0], offset_mm=0, thickness_mm=0.25))
    assert phantom.intensity([0.125, 3]) == 50
    assert phantom.image().data[:, 0].tolist() == [10] * 9 + [20, 20] + [10] * 9


@both_dimensions
def test_oblique_sheared_image_has_the_sphere_where_the_file_says(n, made):
    """Its centroid is right to 0.01 mm; the affine's columns are the file's rows; the box is
    covered.
    """
    axes = np.array([[0.9, 0.4, 0.1], [-0.5, 0.8, 0.0], [0.1, -0.3, 1.0]])[:n, :n]
    center, world_center = np.array([2.5, -1.5, 0.7])[:n], np.array([40.0, -30.0, 12.0])[:n]
    top = head(
        n,
        voxel_mm=[0.5, 0.7, 1.7][:n],
        axes=(3 * axes).tolist(),
        center_mm=world_center.tolist(),
    )
    place = center + world_center
    image = made(top + shape_text("ellipsoid", center_mm=place.tolist(), radii_mm=5)).image()
    assert image.shape == (40, 29, 12)[:n]
    unit = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    linear = unit.T * (20 / np.array(image.shape))
    assert_allclose(image.affine[:-1, :-1], linear, rtol=1e-14, atol=1e-15)
    middle = image.to_world((np.array(image.shape) - 1) / 2)
    assert_allclose(middle, world_center, rtol=1e-14)
    assert image.volume == pytest.approx(20**n * abs(np.linalg.det(unit)), rel=1e-13)
    weight = image.data.astype(np.float64) - 10
    centroid = np.tensordot(weight, centres(image), n) / weight.sum()
    assert_allclose(centroid, place, atol=0.01)


@pytest.mark.parametrize("axis", [0, 1])
def test_blurred_edge_is_the_error_function_along_either_axis(axis, made):
    """A half-plane blurred by sd 2 mm is 10 + 40 Phi(x / 2), along axes of 0.25 and of 0.5 mm.

    On voxels of edge d the integral becomes a midpoint sum, which is as if the variance were less
    by d^2 / 12. What remains is scipy's cut at 4 sd: 3e-5 of the step, or 0.0013.
    """
    normal = [1 - axis, axis]
    layer = shape_text("layer", normal=normal, offset_mm=50, thickness_mm=100)
    image = made(head() + layer).image([0.25, 0.5], blur_mm=2)
    x = centres(image)[..., axis]
    inner = np.abs(x) < 2  # farther out the border's continuation is felt
    expected = 10 + 40 * ndtr(x / math.sqrt(4 - image.spacing[axis] ** 2 / 12))
    assert_allclose(image.data[inner], expected[inner], atol=0.002, rtol=0)


def test_noise_is_seeded_white_and_added_last():
    """32,768 samples: mean and sd within five standard errors, neighbours uncorrelated likewise."""
    render = partial(load_phantom("sphere").image, 2, blur_mm=3)
    one, same, other = (render(noise_sd=7, seed=seed).data for seed in (1, 1, 2))
    assert_array_equal(one, same)
    assert (one != other).all()
    noise = one - render().data
    assert abs(noise.mean()) < 5 * 7 / math.sqrt(noise.size)
    assert noise.std() == pytest.approx(7, abs=5 * 7 / math.sqrt(2 * noise.size))
    for axis in range(3):
        a, b = np.delete(noise, -1, axis), np.delete(noise, 0, axis)
        assert abs((a * b).mean()) / 49 < 5 / math.sqrt(a.size)


def test_file_options_are_the_defaults_and_arguments_win(made):
    phantom = made(head(blur_mm=1, noise_sd=2, seed=3) + DISC)
    plain = made(head() + DISC)
    for ours, theirs in (
        (phantom.image(), plain.image(voxel_mm=1, blur_mm=1, noise_sd=2, seed=3)),
        (phantom.image(blur_mm=0, noise_sd=0), plain.image()),
    ):
        assert_array_equal(ours.data, theirs.data)
    assert phantom.image(np.array([2, 5])).shape == (10, 4)


@pytest.mark.parametrize(
    ("voxel", "count"), [(20, 1), (14, 1), (13, 2), (3, 7), (0.3, 67), (1, 20)]
)
def test_voxels_are_adjusted_to_cover_the_box_exactly(voxel, count, made):
    image = made(head() + DISC).image(voxel)
    assert image.shape == (count, count)
    corners = image.to_world(box_corners(image.shape)[[0, -1]])
    assert_allclose(corners, [[-10, -10], [10, 10]], rtol=1e-14)


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
    assert_array_equal(labels.affine, image.affine)
    assert_array_equal(labels.data, phantom.labels(centres(image)))
    assert_array_equal(image.data, phantom.intensity(centres(image)))
    assert set(np.unique(labels.data)) == {0, *(shape.label for shape in phantom.shapes)}
    assert all(shape.intensity > 0 for shape in phantom.shapes)
    assert (phantom.background_intensity > 0) == (name != "ellipsoids_brain")


def plane(**values):
    return head() + shape_text("layer", **values)


# --- messages


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (head(name="").replace("name = ", "name "), "expected TOML, got Expected '=' after a key"),
        (head().replace("size_mm = [20, 20]", ""), "missing size_mm; name, description, size_mm"),
        (head().replace("name", "d", 1), "missing name; "),
        (head(voxels=3), "unknown 'voxels'; .* name, desc"),
        (head(name=3), "name: .*, got 3"),
        (head(size_mm=[20]), r"size_mm: .*, got \[20\]"),
        (head(size_mm=[20, 0]), r"size_mm: .* above 0 mm, got \[20.0, 0.0\]"),
        (head(voxel_mm=[1, 21]), "voxel_mm: "),
        (head(noise_sd='"1"'), "noise_sd: .* 0 or more"),
        (head(seed=1.5), "seed: .* 0 to 2147483647"),
        (head(axes=[[1, 0]]), "axes: expected 2 rows"),
        (head(axes=[[1, 1], [2, 2]]), "axes: .* do not span 2-D"),
        (head(background=10), "background: .*, got 10"),
        (head(background="{ label = 0 }"), "background: missing intensity; intensity"),
        (head() + "[shape]", r"shape: .* \[\[shape\]\]"),
        (head() + shape_text("sphere"), "shape 1: kind: .* ellipsoid, box, layer, got 'sphere'"),
        (plane(center_mm=[0, 0]), "shape 1: layer: missing normal, offset_mm, thickness_mm;"),
        (head() + centred(5, color=1), "shape 1: ellipsoid: unknown 'color'; "),
        (head() + centred(5, rotation_deg=[1, 2, 3]), "shape 1: rotation_deg: .* finite number"),
        (head() + centred(0, name=r'"a\nb"'), "shape 1 'a.nb': radii_mm: "),
        (plane(normal=[0, 0], offset_mm=0, thickness_mm=1), "shape 1: normal"),
        (plane(normal=[0, 1], offset_mm=0, thickness_mm=0), "shape 1: thickness_mm"),
        (plane(normal=[0, 1], offset_mm="nan", thickness_mm=1), "shape 1: offset_mm"),
        (plane(normal=[0, 1], rotation_deg=5), "shape 1: layer: missing offset_mm"),
        (
            head(3) + shape_text("box", center_mm=[0, 0, 0], size_mm=1, rotation_deg=30),
            "shape 1: rotation_deg",
        ),
    ],
)
def test_messages_of_a_file(text, message, made, tmp_path):
    with pytest.raises(InputError, match=message) as caught:
        made(text)
    assert str(caught.value).startswith(f"phantom {tmp_path / 'test.toml'}: ")
    assert "\n" not in str(caught.value)


def test_messages_of_names_and_files_that_cannot_be_read(tmp_path):
    """An unknown name lists the known."""
    (tmp_path / "latin.toml").write_bytes(b'name = "M\xfcller"')
    for name, words in (
        ("spere", f"'spere': .* {', '.join(SHIPPED)}, or the path"),
        (tmp_path / "nothing.toml", "nothing.toml: no such file; .* constant"),
        (tmp_path, "got a folder"),
        (tmp_path / "latin.toml", "latin.toml: expected UTF-8"),
    ):
        with pytest.raises(InputError, match=words):
            load_phantom(name)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"voxel_mm": "1"}, "voxel_mm: .* list of 3, .* got '1'"),
        ({"voxel_mm": 65}, r"voxel_mm: .* \[64.0, 64.0, 64.0\] mm"),
        ({"voxel_mm": 0.001}, r"voxel_mm: .* 2\*\*31 voxels, got 64000 x 64000 x 64000 of"),
        ({"voxel_mm": 1e-308}, r"voxel_mm: .* 2\*\*31 voxels, got inf x inf x inf of"),
        # that no image has: refused before they are painted
        ({"voxel_mm": [64, 64, 1e-6]}, "1000 times as long"),
        ({"blur_mm": -1}, "blur_mm: .* 0 or more, got -1"),
        ({"blur_mm": 1e20}, r"blur_mm: .* the box's 64 mm, got 1e\+20"),
        ({"seed": -1}, "seed: .* 0 to 2147483647, got -1"),
        ({"supersample": 0}, "supersample: .* 1 to 64, got 0"),
    ],
)
def test_messages_of_rendering(options, message, monkeypatch):
    monkeypatch.setattr(tetopt.contents.phantom, "_voxel_centers", None)  # nothing may be painted
    with pytest.raises(InputError, match=f"^phantom 'sphere': .*{message}"):
        load_phantom("sphere").image(**options)


def test_a_blur_may_be_as_wide_as_the_box():
    assert np.ptp(load_phantom("disc_2d").image(voxel_mm=8, blur_mm=64).data) < 1.0


@pytest.mark.parametrize(
    ("points", "message"),
    [([0.0, 0.0], r"shape \(..., 3\), got \(2,\)"), ([0.0, 0.0, math.nan], "NaN or infinite")],
)
@pytest.mark.parametrize("method", ["intensity", "labels"])
def test_messages_of_points(points, message, method):
    with pytest.raises(InputError, match=f"^phantom 'sphere': points: .*{message}"):
        getattr(load_phantom("sphere"), method)(points)
