"""Pictures, judged by what they hold before they become pixels: sides, places, sections, curves,
titles.
"""

from itertools import permutations, product

import numpy as np
import PIL.Image
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb, to_rgba, to_rgba_array
from matplotlib.figure import Figure
from meshes import with_bent_edges
from numpy.testing import assert_allclose, assert_array_equal

from tetopt.contents.labels import BACKGROUND_COLOUR, LABEL_PALETTE
from tetopt.energy.sampling import cell_moments, cell_of_voxel
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.engine.paper import optimize_paper
from tetopt.errors import InputError
from tetopt.geometry.quadratic import node_count
from tetopt.image import Image
from tetopt.measure.fidelity import cell_labels
from tetopt.measure.quality import rho_histogram
from tetopt.mesh import Mesh
from tetopt.model.label_names import LabelTable, colour_labels, table_words
from tetopt.report import figures
from tetopt.report.colours import LISTED_LABELS, UNCOVERED_COLOUR, label_colours, legend_patches
from tetopt.report.figures import (
    DETAIL_VOXELS,
    SliceView,
    boundary_figure,
    energy_figure,
    histogram_figure,
    label_figure,
    save_figure,
    save_run_figures,
    slice_figure,
)
from tetopt.report.scene import save_scenes
from tetopt.report.tables import nodes_in_words
from tetopt.report.thumbnail import thumbnail_png
from tetopt.start.lattice import lattice_mesh

SHAPE = (5, 7, 9)
SPACING = (2.0, 1.0, 3.0)
OBLIQUE = np.array(
    [[-0.75, 0.31, 1.1, 12.5], [0.12, 0.68, -0.9, -33.0], [0.05, -0.22, 5.1, 7.25], [0, 0, 0, 1.0]]
)
WORLD_LETTERS = ["LR", "PA", "IS"]
# of 48: the world axis that each voxel axis runs along, and in which direction
ORIENTATIONS = [(w, s) for w in permutations(range(3)) for s in product((1, -1), repeat=3)][::5]
some_orientations = pytest.mark.parametrize(("worlds", "signs"), ORIENTATIONS[::3])
each_dimension = pytest.mark.parametrize("n", [2, 3])


def noise(shape, affine=None):
    """An image no two of whose voxels are alike."""
    return Image(np.random.default_rng(0).normal(size=shape), affine)


def spaced(n):
    return noise(SHAPE[:n], np.diag([*SPACING[:n], 1.0]))


def oriented_image(worlds, signs):
    """Noise whose voxel axis a runs along world axis worlds[a], in the direction signs[a]."""
    n = len(worlds)
    affine = np.zeros((n + 1, n + 1))
    affine[worlds, range(n)] = np.multiply(signs, SPACING[:n])
    affine[:, n] = [*(11.0, -22.0, 33.0)[:n], 1.0]
    return noise(SHAPE[:n], affine)


def middle_view(image):
    return SliceView(image, None, None)


def lattice(image, blocks=(2, 2, 2), *kind):
    return lattice_mesh(image, *kind, blocks=blocks[: image.ndim])


def bent(image, blocks=(2, 3, 2)):
    """A lattice of the image's box with its inner nodes moved; the box stays covered."""
    mesh = lattice(image, blocks)
    index = image.to_index(mesh.points)
    is_inside = ((index > -0.4) & (index < np.array(image.shape) - 0.6)).all(axis=1)
    index[is_inside] += np.random.default_rng(1).uniform(-0.2, 0.2, (is_inside.sum(), image.ndim))
    return Mesh(image.to_world(index), mesh.cells)


def areas(polygons):
    """Of convex polygons (K, c, 2), by the shoelace formula."""
    x, y = polygons[..., 0], polygons[..., 1]
    return 0.5 * np.abs((x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1))


def contains(polygon, point):
    """Whether the convex polygon holds the point well inside."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    to = point - polygon
    side = (edges[:, 0] * to[:, 1] - edges[:, 1] * to[:, 0])[np.abs(edges).sum(axis=1) > 0.0]
    return bool((side > 1e-9).all() or (side < -1e-9).all())


def collections_in(axes, kind=PolyCollection):
    return [each for each in axes.collections if isinstance(each, kind)]


def assert_drawn(collection, polygons):
    middles = [path.vertices[:-1].mean(axis=0) for path in collection.get_paths()]
    assert_allclose(middles, polygons.mean(axis=1))


def assert_pixels(axes, view):
    """The slice of the view, as large as it is."""
    assert_array_equal(axes.images[0].get_array(), view.pixels.T)
    assert axes.images[0].get_extent() == [0.0, view.size[0], 0.0, view.size[1]]
    assert axes.images[0].origin == "lower"


def texts(parts):
    return [part.get_text() for part in parts]


# --------------------------------------------------------------------------------------------------
# Sides and places


def assert_in_place(view, horizontal, vertical):
    """Pixels are the slice's voxels in rising order of two coordinates of their world places."""
    image = view.image
    index = np.array(list(np.ndindex(image.shape)))
    if view.across is not None:
        index = index[index[:, view.across] == view.index]
    x, y = image.to_world(index).T[[horizontal, vertical]]
    assert_array_equal(view.pixels.ravel(), image.data[tuple(index[np.lexsort((y, x))].T)])
    assert_allclose(view.size, [np.ptp(x), np.ptp(y)] + image.spacing[view.axes])


@pytest.mark.parametrize(("worlds", "signs"), ORIENTATIONS)
@pytest.mark.parametrize("normal", [0, 1, 2])
def test_pixels_lie_where_the_letters_say(worlds, signs, normal):
    """Sagittal, coronal, axial: right of the patient's left, up from posterior or inferior; by
    default the axial slice in the middle.
    """
    image = oriented_image(worlds, signs)
    view = SliceView(image, worlds.index(normal), index=3)
    horizontal, vertical = np.delete(range(3), normal)
    assert view.letters == [WORLD_LETTERS[horizontal], WORLD_LETTERS[vertical]]
    assert_in_place(view, horizontal, vertical)
    default, across = middle_view(image), worlds.index(2)
    assert (default.across, default.index) == (across, SHAPE[across] // 2)


def test_an_oblique_image_is_laid_out_by_its_nearest_axes():
    image = noise(SHAPE, OBLIQUE)
    view = middle_view(image)
    assert (view.across, view.axes, view.letters) == (2, [0, 1], ["LR", "PA"])
    # the first axis runs to the left
    assert_array_equal(view.pixels, image.data[::-1, :, 4])
    assert_allclose(view.size, image.spacing[:2] * SHAPE[:2])


@pytest.mark.parametrize("signs", list(product((1, -1), repeat=2)))
@pytest.mark.parametrize("worlds", [(0, 1), (1, 0)])
def test_a_2d_image_has_x_to_the_right_and_y_up(worlds, signs):
    view = middle_view(oriented_image(worlds, signs))
    assert_in_place(view, 0, 1)
    assert view.letters == ["", ""]


@some_orientations
def test_cells_and_pixels_share_their_places(worlds, signs):
    """The polygon around a pixel's centre is of the cell that holds the voxel."""
    image = oriented_image(worlds, signs)
    mesh = bent(image, (3, 3, 2))
    view = middle_view(image)
    polygons, cells = view.section(mesh)
    is_wide = areas(polygons) > 1e-9
    owner = middle_view(Image(cell_of_voxel(image, mesh), image.affine)).pixels
    n_inside = 0
    for pixel in np.ndindex(owner.shape):
        point = (np.array(pixel) + 0.5) * image.spacing[view.axes]
        around = cells[is_wide][[contains(polygon, point) for polygon in polygons[is_wide]]]
        if len(around):
            n_inside += 1
            assert around.tolist() == [owner[pixel]]
    assert n_inside > 0.9 * owner.size


# --------------------------------------------------------------------------------------------------
# Sections


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("kind", ["bcc", "five-tet", "bent"])
@pytest.mark.parametrize(
    "affine", [np.diag([-1.0, 2.0, 3.0, 1.0]), OBLIQUE], ids=["flip", "oblique"]
)
def test_a_section_tiles_the_slice(affine, kind, axis):
    image = noise((8, 9, 10), affine)
    # 9 voxels in 3 blocks: the planes of nodes at index 2.5 and 5.5; 8 and 10 in 2: at 3.5 and 4.5.
    mesh = bent(image) if kind == "bent" else lattice(image, (2, 3, 2), kind)
    for index in range(image.shape[axis]):
        view = SliceView(image, axis, index)
        polygons, cells = view.section(mesh)
        assert areas(polygons).sum() == pytest.approx(np.prod(view.size), rel=1e-12)
        assert polygons.min() >= -1e-9
        assert (polygons.max(axis=(0, 1)) <= np.array(view.size) + 1e-9).all()
        assert len(np.unique(cells)) == len(cells)


@pytest.mark.parametrize("kind", ["bcc", "five-tet"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_section_through_a_plane_of_nodes_tiles_it_once(kind, axis):
    """7 voxels in 2 blocks: the middle voxel's plane is a plane of nodes, and of facets."""
    image = noise((7, 7, 7))
    polygons, _ = SliceView(image, axis, 3).section(lattice(image, (2, 2, 2), kind))
    assert areas(polygons).sum() == pytest.approx(49.0, rel=1e-12)


def test_a_2d_mesh_is_shown_whole():
    image = noise((6, 7), np.array([[-2.0, 0.5, 1.0], [0.3, 1.0, 5.0], [0, 0, 1.0]]))
    mesh = bent(image)
    polygons, cells = middle_view(image).section(mesh)
    assert_array_equal(cells, np.arange(len(mesh.cells)))
    assert areas(polygons).sum() == pytest.approx((image.spacing * image.shape).prod(), rel=1e-12)


# --------------------------------------------------------------------------------------------------
# The slice figure


@each_dimension
def test_slice_figure_holds_each_mesh_under_its_title(n):
    image = spaced(n)
    meshes = [("first", lattice(image)), ("second", bent(image))]
    view = middle_view(image)
    grid = np.array(slice_figure(image, meshes).axes).reshape(2, 2)
    for (over, flat), (title, mesh) in zip(grid.T, meshes, strict=True):
        polygons, cells = view.section(mesh)
        assert over.get_title() == title
        assert_pixels(over, view)
        for axes in (over, flat):
            assert_drawn(collections_in(axes)[0], polygons)
        means = collections_in(flat)[0]
        assert_array_equal(means.get_array(), cell_moments(image, mesh).mean[cells])
        assert means.get_clim() == over.images[0].get_clim()


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, 1), (1, -1, -1)])
@pytest.mark.parametrize("worlds", [(0, 1, 2), (2, 0, 1)])
def test_directions_are_lines_across_cells(worlds, signs):
    """Through the middle of a section, towards where the section of a moved mesh lies."""
    image = oriented_image(worlds, signs)
    mesh = lattice(image)
    vectors = np.tile([0.6, -0.48, 0.64], (len(mesh.cells), 1))
    vectors[:3] = np.nan
    figure = figures.slice_figure(image, [("one", mesh)], fibre=2.0 * vectors)
    lines = collections_in(figure.axes[1], LineCollection)
    segments = np.array(lines[-1].get_segments())
    view = SliceView(image, None, None)
    polygons, cells = view.section(mesh)
    assert_allclose(segments.mean(axis=1), polygons.mean(axis=1), atol=1e-9)
    places = np.array([[0.0, 0.0, 0.0], [0.6, -0.48, 0.64]])
    way = np.diff(view._flat(image.to_index(places)), axis=0)
    half = np.diff(segments, axis=1)[:, 0]
    lengths = np.linalg.norm(half, axis=1)
    assert (lengths[cells < 3] == 0.0).all()
    is_drawn = lengths > 1e-6  # and no section of a mere edge
    assert is_drawn.sum() > 0.5 * (cells >= 3).sum()
    ways = half[is_drawn] / lengths[is_drawn, None]
    assert_allclose(ways, np.tile(way / np.linalg.norm(way), (is_drawn.sum(), 1)))
    assert_allclose(lines[-1].get_colors()[is_drawn][:, :3], [[0.6, 0.48, 0.64]] * is_drawn.sum())


def test_letters_stand_on_their_sides():
    image = oriented_image((2, 0, 1), (-1, 1, -1))
    over, flat = slice_figure(image, [("", lattice(image))]).axes
    for axes in (over, flat):
        sides = {text.get_text(): text.get_position() for text in axes.texts}
        assert sides == {"L": (0.02, 0.5), "R": (0.98, 0.5), "P": (0.5, 0.02), "A": (0.5, 0.98)}
        # x is the second axis, of 1 mm; y the third, of 3
        assert (axes.get_xlim(), axes.get_ylim()) == ((0.0, 7.0), (0.0, 27.0))
        assert axes.get_aspect() == 1.0


def lower_part(image, axis, count):
    """A lattice that covers the first `count` voxels along an axis only."""
    return lattice(Image(np.take(image.data, range(count), axis=axis), image.affine))


@each_dimension
def test_nothing_is_drawn_where_a_mesh_leaves_the_image_uncovered(n):
    image = spaced(n)
    over, flat = slice_figure(image, [("part", lower_part(image, 0, 2))]).axes
    for axes in (over, flat):
        polygons = np.concatenate([path.vertices for path in collections_in(axes)[0].get_paths()])
        ends = polygons.min(axis=0), polygons.max(axis=0)
        assert_allclose(ends, [[0.0, 0.0], [4.0, 7.0]], atol=1e-9)
        assert axes.get_xlim() == pytest.approx((0.0, 4.7))  # a tenth of the mesh's side around it
        assert axes.get_ylim() == pytest.approx((0.0, 7.0))
    assert flat.get_facecolor() == to_rgba(UNCOVERED_COLOUR)


@each_dimension
def test_a_slice_of_a_label_map_has_the_labels_colours(n):
    """Not greys of means of numbers."""
    image = spaced(n)
    labels = Image(np.where(image.data > np.median(image.data), 7.0, 3.0), image.affine)
    mesh, table = lattice(labels), LabelTable({}, {3: (0.1, 0.2, 0.3), 7: (0.6, 0.7, 0.8)})
    over, flat = slice_figure(labels, [("", mesh)], table=table).axes
    own = [table.colours[3], table.colours[7]]
    pixels = over.images[0].get_array().reshape(-1, over.images[0].get_array().shape[-1])
    assert len(np.unique(pixels, axis=0)) == 2
    assert_allclose(np.unique(pixels, axis=0)[:, :3], own)
    cells = middle_view(labels).section(mesh)[1]
    faces = collections_in(flat)[0].get_facecolors()
    expected = np.where(cell_labels(labels, mesh)[cells] == 7, 0.6, 0.1)
    assert_allclose(faces[:, 0], expected)


# --------------------------------------------------------------------------------------------------
# Labels

# What red, green and blue of light, linear, become without red and without green cones (Machado et
# al. 2009).
NO_RED = [
    [0.152286, 1.052583, -0.204868],
    [0.114503, 0.786281, 0.099216],
    [-0.003882, -0.048116, 1.051998],
]
NO_GREEN = [
    [0.367322, 0.860646, -0.227968],
    [0.280085, 0.672501, 0.047413],
    [-0.011820, 0.042940, 0.968881],
]
TO_XYZ = [
    [0.4124564, 0.3575761, 0.1804375],
    [0.2126729, 0.7151522, 0.0721750],
    [0.0193339, 0.1191920, 0.9503041],
]


def cielab(colours, seen):
    """CIELAB (K, 3) of sRGB colours as seen with given cones."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    light = np.clip(linear @ np.transpose(seen), 0.0, 1.0)
    xyz = light @ np.transpose(TO_XYZ) / [0.95047, 1.0, 1.08883]
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0).T
    return np.column_stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


@pytest.mark.parametrize(
    "seen", [np.eye(3), NO_RED, NO_GREEN], ids=["all cones", "no red", "no green"]
)
def test_colours_are_told_apart_by_the_colour_blind(seen):
    lab = cielab(to_rgba_array([*LABEL_PALETTE, BACKGROUND_COLOUR])[:, :3], seen)
    apart = np.linalg.norm(lab[:, None] - lab, axis=2) + np.where(np.eye(len(lab)), np.inf, 0.0)
    assert apart[:-1, :-1].min() > 10.0
    assert apart[:20, :20].min() > 14.0
    assert apart[-1].min() > 20.0


def test_a_label_has_one_colour_whatever_else_is_there():
    """So that the cells' labels look as the voxels', and a subject's as another's; in the file's
    table, too. A label keeps a colour of its own, the background does not.
    """
    palette = to_rgba_array([BACKGROUND_COLOUR, *LABEL_PALETTE])[:, :3]
    for n in (8, 10):
        assert_array_equal(label_colours(np.arange(n)), palette[:n])
    own = {0: (0.0, 0.0, 0.0), 2: (0.1, 0.2, 0.3), 9: (1, 1, 1)}
    labels = np.array([0, 1, 2, 5, 7])
    expected = palette[labels]
    expected[2] = own[2]
    assert_array_equal(label_colours(labels, own), expected)
    table = LabelTable({}, {0: (0.0, 0.0, 0.0), 2: (1.0, 0.0, 0.0)})
    assert table_words(colour_labels(table, np.array([0, 7, 2, 7]))) == {
        "0": {"colour": BACKGROUND_COLOUR},
        "2": {"colour": "#ff0000"},
        "7": {"colour": LABEL_PALETTE[6]},
    }


def test_colours_begin_again_in_other_tints():
    n = len(LABEL_PALETTE)
    colours = label_colours(np.arange(3 * n + 2))
    assert len(np.unique(colours[: 3 * n + 1], axis=0)) == 3 * n + 1
    assert_array_equal(colours[3 * n + 1], to_rgb(LABEL_PALETTE[0]))
    assert_array_equal(label_colours(np.array([2**31 - 1]))[0], colours[1 + (2**31 - 2) % (3 * n)])


def test_a_legend_lists_the_largest_and_counts_the_others():
    shown = np.array([50, 0, *range(1, LISTED_LABELS + 2)])  # 0, 2 .. 14; the least are 2 and 3
    numbers, colours = np.arange(len(shown)), np.random.default_rng(0).uniform(size=(20, 3))
    names = {4: "left lung", 1: "not shown"}
    entries = legend_patches(numbers, colours, shown, names)
    labels = ["0", "4 left lung", *map(str, range(5, 15)), "and 2 more"]
    assert [entry.get_label() for entry in entries] == labels
    assert entries[1].get_facecolor() == (*colours[4], 1.0)
    entries = legend_patches(numbers[:-2], colours, shown[:-2], {})
    assert [entry.get_label() for entry in entries] == [str(k) for k in (0, *range(2, 13))]


def test_a_name_is_no_formula():
    labels, table = blocks_of_labels(2), LabelTable({1: r"5 $\frac$ and a_b"}, {})
    FigureCanvasAgg(label_figure(labels, lattice(labels), table=table)).draw()


def blocks_of_labels(n_labels, worlds=(0, 1, 2), signs=(1, 1, 1)):
    """Labels 0 to n_labels - 1 in slabs along the first axis, two voxels thick, on the oriented
    image's voxels.
    """
    affine = oriented_image(worlds, signs).affine
    return Image(np.repeat(np.arange(n_labels), 2)[:, None, None] + np.zeros((1, 7, 9)), affine)


@some_orientations
def test_voxels_and_cells_have_the_same_colours(worlds, signs):
    labels = blocks_of_labels(4, worlds, signs)
    mesh = bent(labels, (3, 3, 2))
    grid = np.array(label_figure(labels, mesh).axes).reshape(3, 2)
    colours, of_cell = label_colours(np.arange(4)), cell_labels(labels, mesh)
    for (left, right), normal in zip(grid, (2, 1, 0), strict=True):
        view = SliceView(labels, worlds.index(normal), None)
        assert_array_equal(left.images[0].get_array(), colours[view.pixels.T.astype(int)])
        assert left.images[0].get_extent() == [0.0, view.size[0], 0.0, view.size[1]]
        polygons, cells = view.section(mesh)
        (painted,) = collections_in(right)
        assert_drawn(painted, polygons)
        assert_array_equal(painted.get_facecolors()[:, :3], colours[of_cell[cells]])
        assert texts(left.texts) == texts(right.texts)
        assert len(left.texts) == 4  # sides alone
    (legend,) = left.figure.legends
    assert texts(legend.get_texts()) == ["0", "1", "2", "3"]


@some_orientations
def test_interfaces_are_drawn_over_the_image(worlds, signs):
    """Slabs whose borders the lattice's cells keep to: the lines lie on the borders, as long as
    these are.
    """
    labels = blocks_of_labels(4, worlds, signs)
    mesh = lattice(labels, (4, 3, 3), "five-tet")  # whose cells lie in its blocks
    image = noise(labels.shape, labels.affine)
    table = LabelTable({2: "left lung"}, {2: (0.0, 1.0, 0.5)})
    figure = label_figure(labels, mesh, image=image, table=table)
    colours, of_cell = label_colours(np.arange(4), table.colours), cell_labels(labels, mesh)
    n_cells = np.bincount(of_cell)
    for axes, normal in zip(figure.axes[2::3], (2, 1, 0), strict=True):
        view = SliceView(image, worlds.index(normal), None)
        assert_pixels(axes, view)
        under, over = (each.get_segments() for each in collections_in(axes, LineCollection))
        assert_array_equal(under, over)
        _, sides = view.interfaces(mesh, of_cell)
        rarer = np.where(n_cells[sides[:, 0]] <= n_cells[sides[:, 1]], sides[:, 0], sides[:, 1])
        assert_array_equal(
            collections_in(axes, LineCollection)[1].get_colors()[:, :3], colours[rarer]
        )
        if worlds.index(normal) != 0:
            along = view.axes.index(0)
            steps = np.abs(np.diff(over, axis=1))[:, 0]
            assert_allclose(steps[:, along], 0.0, atol=1e-9)
            assert steps.sum() == pytest.approx(3 * view.size[1 - along])
    assert "2 left lung" in texts(figure.legends[0].get_texts())


def test_labels_of_a_part_and_of_a_plane():
    labels = blocks_of_labels(4)
    (painted,) = collections_in(label_figure(labels, lower_part(labels, 0, 4)).axes[1])
    farthest = max(path.vertices[:, 0].max() for path in painted.get_paths())
    assert farthest == pytest.approx(8.0)  # of 16 mm
    flat = Image(labels.data[:, :, 0], np.diag([2.0, 1.0, 1.0]))
    assert len(label_figure(flat, lattice(flat)).axes) == 2


def test_numbers_stand_in_their_labels_where_a_legend_is_too_short():
    labels = blocks_of_labels(LISTED_LABELS + 3)
    figure = label_figure(labels, lattice(labels, (4, 2, 2)))
    assert figure.legends[0].get_texts()[-1].get_text() == "and 3 more"
    view = middle_view(labels)
    places = {
        int(text.get_text()): tuple((np.array(text.get_position()) / view.steps).astype(int))
        for text in figure.axes[0].texts
        if text.get_text().isdigit()
    }
    assert list(places) == list(range(1, LISTED_LABELS + 3))
    assert [view.pixels[pixel] for pixel in places.values()] == list(places)
    # In slabs of 0.1 mm, beside 7 mm, a number has no room.
    thin = Image(labels.data[::2], labels.affine @ np.diag([0.05, 1.0, 1.0, 1.0]))
    figure = label_figure(thin, lattice(thin, (4, 2, 2)))
    numbers = [list(filter(str.isdigit, texts(axes.texts))) for axes in figure.axes]
    assert numbers == [[], [], [], [], ["7"], []]  # the sagittal slice is one label alone


# --------------------------------------------------------------------------------------------------
# A mask's outline and a mesh's boundary


@some_orientations
def test_boundary_and_outline_lie_between_the_same_pixels(worlds, signs):
    """The mesh covers just the voxels of the mask, which ends in a plane: both lines are where
    the pixels change.
    """
    image = oriented_image(worlds, signs)
    axis = worlds.index(0)  # along the picture's horizontal
    is_inside = np.arange(SHAPE[axis]) < 3
    data = np.moveaxis(np.zeros(SHAPE), axis, -1) + is_inside
    mask = Image(np.moveaxis(data, -1, axis), image.affine)
    figure = boundary_figure(image, mask, lower_part(image, axis, 3), "mask")
    pixels, top = middle_view(mask).pixels, figure.axes[0].get_ylim()[1]
    place = SPACING[axis] * (np.flatnonzero(np.diff(pixels[:, 0]))[0] + 1)
    for axes in figure.axes:
        assert_pixels(axes, middle_view(image))
        for each in collections_in(axes, LineCollection):
            x, y = np.moveaxis(each.get_segments(), -1, 0)
            assert_allclose(x, place, atol=1e-4)
            assert_allclose([y.min(), y.max()], [0.0, top])
            assert np.abs(np.diff(y, axis=1)).sum() == pytest.approx(top)


@pytest.mark.parametrize("index", range(7))
def test_a_closed_boundary_is_closed_in_every_slice(index):
    """Also where nodes lie on the plane, as at index 3; and it holds what the cells' polygons
    hold.
    """
    image = Image(np.zeros((9, 9, 7)))
    mesh = (lattice if index == 3 else bent)(image, (3, 3, 2))
    on_box = (np.abs(image.to_index(mesh.points) - [4.0, 4.0, 3.0]) > [4.4, 4.4, 3.4]).any(axis=1)
    inner = Mesh(mesh.points, mesh.cells[~on_box[mesh.cells].any(axis=1)])
    view = SliceView(image, 2, index)
    segments, (polygons, _) = view.boundary(inner), view.section(inner)
    ends, times = np.unique(segments.reshape(-1, 2).round(7), axis=0, return_counts=True)
    assert (times % 2 == 0).all()
    assert (len(segments) > 0) == (len(polygons) > 0) == (1 < index < 5)
    if len(polygons):
        assert_allclose(ends.min(axis=0), polygons.min(axis=(0, 1)))
        assert_allclose(ends.max(axis=0), polygons.max(axis=(0, 1)))


def test_the_detail_is_where_the_outline_bends_most():
    """A half plane with a slot: the square of 25 voxels around the slot, marked in the whole
    slice.
    """
    image = Image(np.zeros((80, 90)), np.diag([2.0, 2.0, 1.0]))
    mask = np.zeros((80, 90))
    mask[:40] = 1.0
    mask[28:40, 60:64] = 0.0
    figure = boundary_figure(image, Image(mask, image.affine), lower_part(image, 0, 40), "mask")
    whole, detail = figure.axes
    low, high = np.transpose([detail.get_xlim(), detail.get_ylim()])
    assert_allclose(high - low, 2.0 * DETAIL_VOXELS)
    assert (low <= [56.0, 120.0]).all()
    assert (high >= [80.0, 128.0]).all()
    (frame,) = whole.patches
    assert_allclose([*frame.get_xy(), frame.get_width()], [*low, 2.0 * DETAIL_VOXELS])
    assert whole.get_xlim() == (0.0, 160.0)


def test_the_slice_is_in_the_middle_of_the_mask():
    image = noise((6, 7, 20))
    mask = np.zeros(image.shape)
    mask[1:4, 2:6, 12:17] = 1.0
    figure = boundary_figure(image, Image(mask), lattice(image), "mask")
    assert_pixels(figure.axes[0], SliceView(image, 2, 14))


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_a_mask_without_outline_can_be_drawn(tmp_path, value):
    image = noise(SHAPE)
    figure = boundary_figure(image, Image(np.full(SHAPE, value)), lattice(image), "mask")
    assert [each.get_segments() for each in collections_in(figure.axes[0], LineCollection)] == [
        [],
        [],
    ]
    save_figure(figure, tmp_path / "a.png", dpi=40)


def test_a_mask_of_another_shape_is_refused():
    image = noise(SHAPE)
    with pytest.raises(InputError, match="mask: expected the image's shape"):
        boundary_figure(image, Image(np.zeros((5, 7, 8))), lattice(image), "mask")


def test_curved_cells_are_drawn_as_straight_pieces():
    """Of a plane, as their interfaces are; titles say so, and no title of straight cells."""
    labels = Image(np.repeat([0, 3], 4)[:, None] + np.zeros((1, 6)), np.diag([2.0, 1.0, 1.0]))
    straight, view = lattice(labels), middle_view(labels)
    mesh, of_cell = with_bent_edges(straight, 0.1), cell_labels(labels, straight)
    polygons, cells = view.section(mesh)
    pieces, n_pieces = mesh.straight_pieces()
    assert_array_equal(cells, np.repeat(np.arange(len(mesh.cells)), n_pieces))
    assert_allclose(areas(polygons), pieces.cell_volumes)
    lines, sides = view.interfaces(straight, of_cell)
    assert_allclose(lines[..., 0], 8.0)
    assert np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum() == pytest.approx(6.0)
    assert {tuple(sorted(pair)) for pair in sides.tolist()} == {(0, 3)}
    assert len(view.interfaces(mesh, of_cell)[0]) == 2 * len(lines)
    size = f"{len(mesh.points)} corner nodes, {node_count(mesh.points, mesh.cells, 2)} in all"
    mask, thumbnails = Image(labels.data == 3, labels.affine), set()
    for each, words in ((mesh, "\ncurved cells drawn as 4 straight ones"), (straight, "")):
        linear, quadratic = (
            label_figure(labels, each, of_cell, order=order).axes[1].get_title() for order in (1, 2)
        )
        assert quadratic == f"labels of the cells, {size}{words}"
        assert slice_figure(labels, [("a", each)]).axes[0].get_title() == f"a{words}"
        (legend,) = boundary_figure(labels, mask, each, "mask").legends
        for text in (linear, legend.get_texts()[1].get_text()):
            assert text.partition("\n")[2] == words.strip()
        thumbnails.add(thumbnail_png(labels, each, labels=labels, of_cell=of_cell))
    assert len(thumbnails) == 2


# --------------------------------------------------------------------------------------------------
# Histograms and energies


@each_dimension
def test_histograms_are_fractions(n):
    image = spaced(n)
    meshes = {"first": lattice(image), "second": bent(image)}
    outlines = {
        patch.get_label().split(":")[0]: patch.get_data()
        for patch in histogram_figure(list(meshes.items())).axes[0].patches
        if patch.get_label()
    }
    assert list(outlines) == list(meshes)
    for name, (values, edges, _) in outlines.items():
        assert_array_equal(values, rho_histogram(meshes[name].points, meshes[name].cells)[0])
        assert values.sum() == pytest.approx(1.0, abs=1e-12)
        assert (edges[0], edges[-1]) == (0.0, 1.0 / n)


def history(*E_D):
    return [
        IterationRecord(
            k, 1.0 - 0.1 * k, 2.0 + 0.1 * k, value, 0.1**k * (k > 0), k == 2, 50, 99, float(k)
        )
        for k, value in enumerate(E_D)
    ]


def test_energy_lines_hold_the_history():
    top, bottom = energy_figure(history(8.0, 4.0, 2.0, 1.0)).axes
    energies = {"E": [1, 0.9, 0.8, 0.7], "E_G": [1, 1.05, 1.1, 1.15], "E_D": [1, 0.5, 0.25, 0.125]}
    assert [line.get_label().split(",")[0] for line in top.lines] == list(energies)
    for line, values in zip(top.lines, energies.values(), strict=True):
        assert_allclose(line.get_xydata(), np.column_stack([range(4), values]))
        assert line.get_label().endswith(f": {line.get_ydata()[-1]:.3f}")
    assert_allclose(bottom.lines[0].get_xydata(), [[1, 0.1], [2, 0.01], [3, 0.001]])
    # connected anew in 2
    assert [(p.get_x(), p.get_x() + p.get_width()) for p in top.patches] == [(1.5, 2.5)]


# --------------------------------------------------------------------------------------------------
# A run's three pictures


@pytest.fixture(scope="module")
def run():
    image = Image(np.where(np.arange(12) > 4, 9.0, 1.0)[:, None] + np.zeros((12, 11)))
    initial = lattice(image, (4, 4))
    return image, initial, optimize_paper(image, initial, iterations=2)


@pytest.mark.drawn
def test_pictures_are_written_and_not_blank(tmp_path, run):
    image, initial, result = run
    names = ("slice.png", "rho.png", "energies.png", "boundary.png", "labels.png")
    paths = [tmp_path / name for name in names]
    save_run_figures(paths[:3], image, initial, result)
    domain = Image(image.data / 9.0)
    save_figure(boundary_figure(image, domain, result.mesh, "mask"), paths[3])
    save_figure(label_figure(image, result.mesh, cell_labels(image, result.mesh)), paths[4])
    for path in paths:
        with PIL.Image.open(path) as picture:
            assert picture.format == "PNG"
            assert min(picture.size) > 500
            assert np.asarray(picture.convert("L")).std() > 10.0
    assert sorted(tmp_path.iterdir()) == sorted(paths)


def test_titles_say_how_many_nodes_and_how_good(monkeypatch, run):
    saved = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, path: saved.append(figure))
    image, initial, result = run
    flat = Image(np.full(image.shape, 7.0))
    unmoved = MeshingResult(initial, history(0.0), "iterations", initial)
    fraction = result.history[-1].E_D / result.history[0].E_D
    for shown, made, words, n_lines in (
        (image, result, f"{fraction:.3f} of the initial E_D", 3),
        (flat, unmoved, "constant image", 2),
    ):
        save_run_figures("abc", shown, initial, made)
        slices, _, energies = saved[-3:]
        titles = [f"lattice, {len(initial.points)} nodes", f"optimised, {words}"]
        for axes, title, mesh in zip(slices.axes, titles, (initial, made.mesh), strict=False):
            assert axes.get_title() == title
            assert len(collections_in(axes)[0].get_paths()) == len(mesh.cells)
        assert len(energies.axes[0].lines) == n_lines
    save_run_figures("abc", image, initial, result._replace(order=2))
    assert saved[-3].axes[0].get_title() == f"lattice, {nodes_in_words(initial, 2)}"


@pytest.mark.parametrize("name", ["a", "a.png.txt"])
def test_a_picture_is_a_png_or_refused(name, tmp_path):
    for save, shown in (
        (save_figure, (Figure(), tmp_path / name)),
        (save_scenes, (tmp_path / name, [("", lambda plotter: None)])),
    ):
        with pytest.raises(InputError, match=r"\.png"):
            save(*shown)
    assert list(tmp_path.iterdir()) == []
