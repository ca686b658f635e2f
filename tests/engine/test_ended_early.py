"""Runs that are stopped, wherever they ask: mesh, labels and voxels belong together, and all
measures take them.
"""

from pathlib import Path

import numpy as np
import pytest
from meshes import delaunay_box
from numpy.testing import assert_array_equal
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
    places = np.meshgrid(*[np.linspace(-1.0, 1.0, s) for s in image.shape], indexing="ij")
    radius = np.linalg.norm(places, axis=0)

    def of(values):
        return tetopt.Image(1.0 * values, image.affine)

    labels = of((radius < 0.7) + (radius < 0.4)) if "labels" in parts else None
    mask = of(radius < 0.9) if "mask" in parts else None
    images = [image, of(image.data * (places[0] > 0))] if "contrasts" in parts else image
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
    mesh, last, n_cells = result.mesh, result.history[-1], len(result.mesh.cells)
    check_unfolded(mesh)
    owner = tetopt.cell_of_voxel(image, mesh)
    n_voxels = np.bincount(owner.ravel() + 1, minlength=n_cells + 1)[1:]
    assert_array_equal(n_voxels, tetopt.cell_moments(image, mesh).n_voxels)
    assert overlap_of(image, mesh) is None
    assert (last.n_cells, last.n_voxels) == (n_cells, n_voxels.sum())
    if mask is None and labels is None:
        assert last.E_D == pytest.approx(tetopt.E_D(image, mesh), rel=1e-6)
    assert tetopt.quality(mesh.points, mesh.cells).n_cells == n_cells
    fields = tetopt.cell_fields(mesh, image)
    if labels is not None:  # at whatever iteration it ended
        problems = manifold_problems(mesh, result.labels) + (
            [] if mask is None else manifold_problems(mesh)
        )
        assert bool(problems) == ("manifold" in result.violated)
        assert set(result.labels) <= set(labels.data.ravel())
        fields["label"] = result.labels
    measured = fidelity(labels, mask, mesh, result.labels)
    if labels is not None and mask is None:
        assert sum(row.extent.n_cells for row in measured["labels"]) == n_cells
        volume = sum(row.extent.mesh_volume for row in measured["labels"])
        assert volume == pytest.approx(image.volume)
    assert {len(values) for values in fields.values()} == {n_cells}
    model = tetopt.build_model(mesh, image, young=3.0, order=order, cell_data=fields)
    assert len(file_bytes(Path("a.vtu"), model)) > 1000


def assert_sound_however_stopped(kind, asks_of):
    """Stopped at each of the numbers of asks, which `asks_of` chooses of as many; a search may
    then give what an earlier run of it came to.
    """
    (*parts, _), options = KINDS[kind]
    never = Asked()
    meshed(kind, never)
    asks = asks_of(never.number)
    for k in asks:
        result = meshed(kind, Asked(k))
        assert result.ended == "stopped" or k > asks[0]
        assert_sound(result, *parts, options.get("order", 1))


@pytest.mark.parametrize("kind", KINDS)
def test_a_stopped_run_is_sound(kind):
    assert_sound_however_stopped(
        kind, lambda n: sorted({round(k) for k in np.linspace(1, n, SPREAD)})
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_run_stopped_anywhere_is_sound(kind):
    assert_sound_however_stopped(kind, lambda n: range(1, n + 1))


def test_cells_are_lifted_no_longer_than_a_run_has_time():
    """A question in each round, and for some cells at a time; once over, the round's splits are
    the last moves.
    """
    image = target(3)[0]
    mesh = tetopt.Mesh(*delaunay_box(np.random.default_rng(0), image.shape, 150))
    never = Asked()
    n_all = Engine(image, mesh).repair(15.0, never).n_moves
    assert never.number > 4
    n_moves = []
    for k in (1, 2, never.number // 2, never.number):
        engine, asked = Engine(image, mesh), Asked(k)
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
    assert_array_equal(marked.complex.ticks, every.complex.ticks)
    assert_array_equal(marked.cells, every.cells)
