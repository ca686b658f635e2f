"""Pictures of a comparison, judged by what they hold."""

import numpy as np
import PIL.Image
import pytest
from matplotlib.collections import PolyCollection
from numpy.testing import assert_array_equal
from test_compare_page import fake_report, finished, meshes_of, with_runs

import tetopt
from tetopt.energy.discretization import cell_E_D
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
    voxels = grid[0, 0].images[0]
    assert_array_equal(voxels.get_array(), view.pixels.T)
    scales = set()
    for column, (title, mesh), mean in zip(grid.T[1:], meshes, means, strict=True):
        polygons, cells = view.section(mesh)
        assert column[0].get_title() == title
        over, of_means, of_losses = map(painted, column)
        assert len(over.get_paths()) == len(polygons)
        assert_array_equal(of_means.get_array(), mean[cells])
        assert of_means.get_clim() == voxels.get_clim()
        assert_array_equal(
            of_losses.get_array(), (cell_E_D(image, mesh) / mesh.cell_volumes)[cells]
        )
        scales.add(of_losses.get_clim())
    assert len(scales) == 1  # one for all


def test_label_marks_are_those_of_the_report():
    """A column for each label, the largest first; the lost have Dice 0 and no distance."""
    report = fake_report()
    done = finished(report)
    for pipeline in done:
        pipeline.median.measurement.labels.reverse()
    dice, distance = labels_figure(report).axes
    ticks = [text.get_text() for text in distance.get_xticklabels()]
    assert ticks == ["0 (9000)", "1 (2250)", "2 (562)", "3 (140)"]
    for axes, name, n in ((dice, "dice", 4), (distance, "distance_mean", 3)):

        def assert_marks(line, rows, name=name, n=n):
            values = {row.label: row.as_json()[name] for row in rows}
            assert_array_equal(line.get_ydata()[:n], [values[k] for k in range(n)])

        full = [line for line in axes.lines if line.get_markerfacecolor() != "none"]
        (own,) = (line for line in set(axes.lines) - set(full) if len(line.get_xdata()))
        assert_marks(own, done[0].median.measurement.own_labels)  # the others have none
        assert [line.get_label() for line in full] == [p.title for p in done]
        for line, pipeline in zip(full, done, strict=True):
            assert_marks(line, pipeline.median.measurement.labels)
            assert_array_equal(np.rint(line.get_xdata()[:n]), np.arange(n))


def test_histograms_are_those_of_the_report():
    report = fake_report()
    for axes, name in zip(
        histograms_figure(report).axes, ("rho_histogram", "dihedral_histogram"), strict=True
    ):
        outlines = [patch for patch in axes.patches if patch.get_label()]
        for patch, pipeline in zip(outlines, finished(report), strict=True):
            assert patch.get_label() == pipeline.title
            histogram = getattr(pipeline.median.measurement, name)
            assert_array_equal(patch.get_data().values, histogram.fraction)
            assert_array_equal(patch.get_data().edges, histogram.edges)


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
    image, meshes = small
    means = [tetopt.cell_moments(image, mesh).mean for _, mesh in meshes]
    cutaways(meshes * 2, means * 2, tmp_path / "a.png")
    pixels = np.asarray(PIL.Image.open(tmp_path / "a.png").convert("L"))
    assert pixels.shape == (2000, 2200)
    for part in pixels.reshape(2, 1000, 2, 1100).swapaxes(1, 2).reshape(4, 1000, 1100):
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
    assert [part[each.title] for each in finished(fewer)] == [
        whole[each.title] for each in finished(fewer)
    ]
    assert first.title not in part
