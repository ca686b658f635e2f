"""Pictures of a comparison, judged by what they hold."""

import numpy as np
import PIL.Image
import pytest
from matplotlib.collections import PolyCollection
from numpy.testing import assert_array_equal
from test_compare_page import fake_report, finished, meshes_of, with_runs

import tetopt
from tetopt.energy.discretization import cell_E_D
from tetopt.geometry.simplex import volumes
from tetopt.report.figures import SliceView
from tetopt.study.compare_figures import (
    cutaways,
    histograms_figure,
    labels_figure,
    slices_figure,
    timing_figure,
)


@pytest.fixture(scope="module")
def small():
    image = tetopt.load_phantom("two_spheres").image(voxel_mm=4.0)
    return image, meshes_of(image, nodes=200, iterations=2)


def painted(axes):
    return next(c for c in axes.collections if isinstance(c, PolyCollection))


@pytest.mark.parametrize("n_meshes", [1, 6])
def test_slices_hold_means_and_losses(small, n_meshes):
    image, both = small
    meshes = [(f"mesh {k}", both[k % 2][1]) for k in range(n_meshes)]
    means = [tetopt.cell_moments(image, mesh).mean + k for k, (_, mesh) in enumerate(meshes)]
    figure = slices_figure(image, meshes, means)
    grid = np.array(figure.axes[: 3 * (n_meshes + 1)]).reshape(3, n_meshes + 1)
    view = SliceView(image, None, None)
    assert_array_equal(grid[0, 0].images[0].get_array(), view.pixels.T)
    for column, ((title, mesh), mean) in enumerate(zip(meshes, means, strict=True), 1):
        polygons, cells = view.section(mesh)
        assert grid[0, column].get_title() == title
        assert len(painted(grid[0, column]).get_paths()) == len(polygons)
        assert_array_equal(painted(grid[1, column]).get_array(), mean[cells])
        density = cell_E_D(image, mesh) / volumes(mesh.points, mesh.cells)
        assert_array_equal(painted(grid[2, column]).get_array(), density[cells])
    # one scale for all
    assert len({painted(grid[2, column]).get_clim() for column in range(1, n_meshes + 1)}) == 1
    assert {painted(grid[1, c]).get_clim() for c in range(1, n_meshes + 1)} == {
        grid[0, 0].images[0].get_clim()
    }


def test_label_marks_are_those_of_the_report():
    """A column for each label, the largest first; the lost have Dice 0 and no distance."""
    report = fake_report()
    done = finished(report)
    for pipeline in done:
        pipeline.median.measurement.labels.reverse()
    dice, distance = labels_figure(report).axes
    assert [text.get_text() for text in distance.get_xticklabels()] == [
        "0 (9000)",
        "1 (2250)",
        "2 (562)",
        "3 (140)",
    ]
    for axes, name, n in ((dice, "dice", 4), (distance, "distance_mean", 3)):
        marks = {
            line.get_label(): line.get_xydata()
            for line in axes.lines
            if line.get_markerfacecolor() != "none"
        }
        assert list(marks) == [p.title for p in done]
        for pipeline in done:
            values = {row.label: getattr(row, name) for row in pipeline.median.measurement.labels}
            assert_array_equal(marks[pipeline.title][:n, 1], [values[k] for k in range(n)])
            assert_array_equal(np.rint(marks[pipeline.title][:n, 0]), np.arange(n))
        is_open = [
            line.get_markerfacecolor() == "none" and len(line.get_xdata()) > 0
            for line in axes.lines
        ]
        own = axes.lines[is_open.index(True)].get_xydata()
        assert sum(is_open) == 1  # of all meshes but the first
        own_rows = {row.label: getattr(row, name) for row in done[0].median.measurement.own_labels}
        assert_array_equal(own[:n, 1], [own_rows[k] for k in range(n)])


def test_histograms_are_those_of_the_report():
    report = fake_report()
    for axes, name in zip(
        histograms_figure(report).axes, ("rho_histogram", "dihedral_histogram"), strict=True
    ):
        outlines = {p.get_label(): p.get_data() for p in axes.patches if p.get_label()}
        assert list(outlines) == [p.title for p in finished(report)]
        for pipeline in finished(report):
            histogram = getattr(pipeline.median.measurement, name)
            assert_array_equal(outlines[pipeline.title].values, histogram.fraction)
            assert_array_equal(outlines[pipeline.title].edges, histogram.edges)


def test_bars_are_the_steps():
    report = fake_report()
    (axes,) = timing_figure(report).axes
    assert [tick.get_text() for tick in axes.get_yticklabels()] == [
        p.title for p in report.pipelines
    ]
    texts = {round(text.get_position()[1]): text.get_text().strip() for text in axes.texts}
    for row, pipeline in enumerate(report.pipelines):
        bars = [b for b in axes.patches if round(b.get_y() + b.get_height() / 2) == row]
        if pipeline.median is None:
            assert not bars
            assert texts[row] == "failed"
            continue
        seconds = pipeline.median.seconds
        assert [b.get_width() for b in bars] == pytest.approx(
            [seconds["lattice"], seconds["optimise"]]
        )
        assert texts[row] == f"{pipeline.median.seconds_total:.3g} s"


@pytest.mark.full
def test_cutaways_are_drawn(small, tmp_path, opengl):
    image, both = small
    meshes = [both[0], both[1], both[0], both[1]]
    cutaways(
        meshes, [tetopt.cell_moments(image, mesh).mean for _, mesh in meshes], tmp_path / "a.png"
    )
    pixels = np.asarray(PIL.Image.open(tmp_path / "a.png").convert("L"))
    assert pixels.shape == (2000, 2200)
    for part in (
        pixels[:1000, :1100],
        pixels[:1000, 1100:],
        pixels[1000:, :1100],
        pixels[1000:, 1100:],
    ):
        assert part[200:800, 200:900].std() > 15.0


def test_colours_do_not_depend_on_what_failed():
    """A pipeline keeps its colour in every picture, whichever others have no line."""
    report = fake_report()
    first, *others = report.pipelines
    fewer = report._replace(pipelines=[with_runs(first, []), *others])
    whole, part = (
        {line.get_label(): line.get_color() for line in labels_figure(each).axes[0].lines}
        for each in (report, fewer)
    )
    for each in finished(fewer):
        assert part[each.title] == whole[each.title]
    assert first.title not in part
