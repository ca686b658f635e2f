"""Runs that are stopped, wherever they ask: mesh, labels and voxels belong together, and all
measures take them.
"""

from pathlib import Path

import numpy as np
import pytest
from meshes import delaunay_box
from states import Engine, ball, random_case

import tetopt
import tetopt.engine.repair
from tetopt.energy.sampling import overlap_of
from tetopt.geometry.check import check_unfolded, manifold_problems
from tetopt.io.formats import file_bytes
from tetopt.measure.measures import fidelity

pytestmark = pytest.mark.full
SPREAD = 3  # of the asks of a run, those at which the quick test stops


def target(n, *parts):
    """A ball with what is named: labels (ball, core, rest), mask, second contrast."""
    image = ball((14,) * n if n == 3 else (24, 20))
    h = image.data
    index = np.stack(
        np.meshgrid(*[np.linspace(-1.0, 1.0, s) for s in image.shape], indexing="ij"), -1
    )
    radius = np.linalg.norm(index, axis=-1)
    of = lambda values: tetopt.Image(1.0 * values, image.affine)  # noqa: E731
    labels = of((radius < 0.7) + (radius < 0.4)) if "labels" in parts else None
    mask = of(radius < 0.9) if "mask" in parts else None
    images = [image, of(h * (index[..., 0] > 0))] if "contrasts" in parts else image
    return image, labels, mask, tetopt.content(images, labels, mask)


KINDS = {
    "plain": (target(3), {"nodes": 150}),
    "uniform": (target(3), {"nodes": 150, "mode": "uniform"}),
    "masked": (target(3, "mask"), {"nodes": 150}),
    "labelled": (target(3, "labels"), {"nodes": 150}),
    "masked labels of two contrasts": (target(3, "labels", "mask", "contrasts"), {"nodes": 150}),
    "plane": (target(2, "labels"), {"nodes": 120}),
    "order 2": (target(3), {"nodes": 500, "order": 2}),
    "start": (target(3, "labels"), {"start": tetopt.lattice_mesh(target(3)[0], nodes=150)}),
    "error": (target(3), {"target_error": 0.3}),
    "paper": (target(3), {"nodes": 150, "mode": "paper"}),
}


def meshed(kind, stop):
    (_, _, _, content), options = KINDS[kind]
    whole = content.image if options.get("mode") == "paper" else content
    return tetopt.mesh_image(whole, iterations=4, stop=stop, **options)


class Asked:
    """A `stop` that says so from an ask on, by number from 1; by default never."""

    def __init__(self, last=np.inf):
        self.number, self.last = 0, last

    def __call__(self):
        self.number += 1
        return self.number >= self.last


def assert_sound(result, image, labels, mask, order=1):
    """What came of a run: one thing, that all measures take, and that can be written."""
    mesh, last = result.mesh, result.history[-1]
    assert last.n_cells == len(mesh.cells)
    check_unfolded(mesh)
    owner = tetopt.cell_of_voxel(image, mesh)
    moments = tetopt.cell_moments(image, mesh)
    np.testing.assert_array_equal(
        np.bincount(owner.ravel() + 1, minlength=len(mesh.cells) + 1)[1:], moments.n_voxels
    )
    assert overlap_of(image, mesh) is None
    assert last.n_voxels == (owner >= 0).sum()
    if mask is None and labels is None:
        assert last.E_D == pytest.approx(tetopt.E_D(image, mesh), rel=1e-6)
    assert tetopt.quality(mesh.points, mesh.cells).n_cells == len(mesh.cells)
    fields = tetopt.cell_fields(mesh, image)
    if labels is not None:  # at whatever iteration it ended
        problems = manifold_problems(mesh, result.labels) + (
            [] if mask is None else manifold_problems(mesh)
        )
        assert bool(problems) == ("manifold" in result.violated)
        assert set(result.labels.tolist()) <= set(labels.data.astype(int).ravel().tolist())
        fields["label"] = result.labels
    measured = fidelity(labels, mask, mesh, result.labels)
    if labels is not None and mask is None:
        assert sum(row.n_cells for row in measured["labels"]) == len(mesh.cells)
        assert sum(row.mesh_volume for row in measured["labels"]) == pytest.approx(image.volume)
    assert all(len(values) == len(mesh.cells) for values in fields.values())
    model = tetopt.build_model(mesh, image, young=3.0, order=order, cell_data=fields)
    assert len(file_bytes(Path("a.vtu"), model)) > 1000


def assert_sound_however_stopped(run, asks, *parts):
    """Stopped at each of the numbers of asks; a search may then give what an earlier run of it
    came to.
    """
    for k in asks:
        result = run(Asked(k))
        assert result.ended == "stopped" or k > asks[0]
        assert_sound(result, *parts)


def asks_of(run):
    stop = Asked()
    run(stop)
    return stop.number


@pytest.mark.parametrize("kind", KINDS)
def test_a_stopped_run_is_sound(kind):
    (image, labels, mask, _), options = KINDS[kind]
    n = asks_of(lambda stop: meshed(kind, stop))
    asks = sorted({round(k) for k in np.linspace(1, n, SPREAD)})
    assert_sound_however_stopped(
        lambda stop: meshed(kind, stop), asks, image, labels, mask, options.get("order", 1)
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_run_stopped_anywhere_is_sound(kind):
    (image, labels, mask, _), options = KINDS[kind]
    n = asks_of(lambda stop: meshed(kind, stop))
    assert_sound_however_stopped(
        lambda stop: meshed(kind, stop),
        range(1, n + 1),
        image,
        labels,
        mask,
        options.get("order", 1),
    )


def test_cells_are_lifted_no_longer_than_a_run_has_time():
    """A question in each round, and for some cells at a time; once over, the round's splits are
    the last moves.
    """
    image = target(3)[0]
    mesh = tetopt.Mesh(*delaunay_box(np.random.default_rng(0), image.shape, 150))
    of = lambda: Engine(image, mesh)  # noqa: E731
    never = Asked()
    n_all = of().repair(15.0, never).n_moves
    assert never.number > 4
    n_moves = []
    for k in (1, 2, never.number // 2, never.number):
        engine, asked = of(), Asked(k)
        n_moves.append(engine.repair(15.0, asked).n_moves)
        assert k <= asked.number <= k + 2
        engine.assert_sound()
    assert n_moves == sorted(n_moves)
    assert n_moves[0] == 0 < n_moves[2] <= n_all


def test_lifting_skips_only_what_would_fail_again(monkeypatch):
    """An angle out of reach: without the marks all is tried again, many times over, and the same
    comes of it.
    """
    marked, every = (random_case(3, 3) for _ in range(2))
    lifted = marked.repair(40.0)
    tried, displace = [], tetopt.engine.repair._displace

    def unmarked(state, stars, bad, target, is_stuck):
        is_stuck[:] = False
        tried.append(len(bad))
        return displace(state, stars, bad, target, is_stuck)

    monkeypatch.setattr(tetopt.engine.repair, "_displace", unmarked)
    monkeypatch.setattr(tetopt.engine.repair, "DISPLACED_AT_ONCE", 1)
    again = every.repair(40.0)
    assert (lifted.n_below, lifted.n_moves) == (again.n_below, again.n_moves)
    assert again.n_below > 0
    assert len(tried) > 100
    np.testing.assert_array_equal(marked.complex.ticks, every.complex.ticks)
    np.testing.assert_array_equal(marked.cells, every.cells)
