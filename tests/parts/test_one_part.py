"""A part of a mesh on its own box of voxels: it is measured as in the whole, and leaves what it
shares as it was.
"""

from itertools import pairwise

import numpy as np
import pytest
from parted import SKEW, balls

import tetopt
from tetopt.contents.content import plain
from tetopt.energy.sampling import grid_bits
from tetopt.engine.fast import Run
from tetopt.engine.loop import Whole
from tetopt.engine.state import content_energies
from tetopt.geometry.topology import boundary_facets
from tetopt.model.fields import cell_fields
from tetopt.parts.cut import Shared, joined, pieces
from tetopt.parts.part import PartSettings, work_on
from tetopt.parts.work import done_path, load_arrays, round_folder, save_arrays, save_volume

AFFINES = {
    "voxels of 1 mm": np.eye(4),
    "anisotropic": np.diag([0.7, 0.9, 3.1, 1.0]),
    "flipped": np.diag([-1.0, 1.0, 1.3, 1.0]),
    "oblique, sheared, mirrored": SKEW,
}


def seam(ticks, cells, settings):
    """The facets of a part that are on no side of the whole box, by the places of their nodes."""
    low = -(1 << (settings["bits"] - 1))
    high = low + (np.array(settings["shape"]) << settings["bits"])
    corners = ticks[boundary_facets(cells)]
    is_side = ((corners == low) | (corners == high)).all(axis=1).any(axis=1)
    return sorted(map(sorted, corners[~is_side].tolist()))


def in_order(mesh):
    """The places of a mesh in their order, and its cells in theirs."""
    order = np.lexsort(mesh.ticks.T)
    rank = np.argsort(order)
    cells = np.sort(rank[mesh.cells], axis=1)
    return mesh.ticks[order], cells[np.lexsort(cells.T)]


def rounds_of(run, kind):
    return [parts for parts in run[1] if parts[0].text["kind"] == kind]


def whole_mesh(parts, key):
    return joined(
        [getattr(part, key)["ticks"] for part in parts],
        [getattr(part, key)["cells"] for part in parts],
    )


def measured_whole(image, mesh, settings):
    """A run of the whole mesh in one piece, as it stands, with the normalisation of its parts."""
    whole = Whole(
        (0, 0, 0),
        image.shape,
        settings["bits"],
        settings["E_G"],
        settings["squares"],
        settings["noise"],
    )
    points = image.to_world(mesh.ticks * 2.0 ** -settings["bits"])
    return Run(
        plain(image), tetopt.Mesh(points, mesh.cells), settings["k_D"], is_graded=True, whole=whole
    )


def slabs_done(folder, image, ticks, cells, kind, bits):
    """Three parts of a mesh, across the first axis: each, and what came of it."""
    save_volume(folder, image)
    settings = PartSettings(0.85, 3.0, 12.0, 5e-4, 9, 4, 0.0, 99.0, None, image.shape, bits, 0.0)
    place = ticks[cells].mean(axis=1)[:, 0] / 2.0**bits / image.shape[0]
    round_folder(folder, 0).mkdir()
    for number, piece in enumerate(pieces(Shared(ticks, cells, np.digitize(place, [0.3, 0.6])))):
        path = round_folder(folder, 0) / f"part-{number}.npz"
        text = {
            "kind": kind,
            "settings": settings._asdict(),
            "iterations": (1, 0),
            "nodes": len(piece.ticks),
        }
        save_arrays(path, {"ticks": piece.ticks, "cells": piece.cells}, text)
        work_on(str(path))
        yield piece, *load_arrays(done_path(path))


@pytest.mark.parametrize("name", list(AFFINES))
def test_ticks_of_a_part_are_those_of_the_whole_to_the_last_one(name, tmp_path):
    """Each part of a mesh is measured on its own box of voxels, and comes back as it went."""
    image, bits = balls((21, 17, 19), AFFINES[name]), 20
    mesh = tetopt.octree_mesh(image, 300)
    ticks = np.rint(image.to_index(mesh.points) * 2.0**bits).astype(np.int64)
    # Not on a lattice: what a part's own origin and the world's mm leave of them has to be all.
    inner = ((ticks > 0) & (ticks < (np.array(image.shape) - 1) << bits)).all(axis=1)
    ticks[inner] += np.random.default_rng(2).integers(-99_999, 99_999, (inner.sum(), 3))
    n_voxels = []
    for piece, after, numbers in slabs_done(tmp_path, image, ticks, mesh.cells, "measure", bits):
        np.testing.assert_array_equal(after["ticks"], piece.ticks)
        np.testing.assert_array_equal(after["cells"], piece.cells)
        n_voxels.append(numbers["n_voxels"])
    assert len(n_voxels) == 3
    assert sum(n_voxels) == image.data.size


@pytest.mark.parametrize("name", list(AFFINES))
def test_a_cell_without_a_voxel_has_the_value_that_it_has_in_the_whole(name, tmp_path):
    """Also where its middle lies between two voxels, and rounding to even numbers depends on the
    first one.
    """
    image = balls((12, 10, 11), AFFINES[name])
    mesh = tetopt.lattice_mesh(image, blocks=(8, 8, 8))
    bits = grid_bits(image, mesh.points)
    ticks = np.rint(image.to_index(mesh.points) * 2.0**bits).astype(np.int64)
    mesh = tetopt.Mesh(image.to_world(ticks * 2.0**-bits), mesh.cells)
    done = list(slabs_done(tmp_path, image, ticks, mesh.cells, "fields", bits))
    order = np.concatenate([_rows_of(mesh.cells, piece.nodes[piece.cells]) for piece, _, _ in done])
    expected = cell_fields(mesh, image)
    assert (expected["n_voxels"] == 0).mean() > 0.3
    for field in ("n_voxels", "mean", "min", "max"):
        ours = np.concatenate([after[field] for _, after, _ in done])
        np.testing.assert_array_equal(ours, expected[field][order], field)


def _rows_of(cells, some):
    """Which of the cells some are."""
    rows = {tuple(cell): row for row, cell in enumerate(cells.tolist())}
    return [rows[tuple(cell)] for cell in some.tolist()]


def test_what_parts_share_stays_node_for_node_and_facet_for_facet(run):
    n_facets = 0
    for parts in rounds_of(run, "improve"):
        for part in parts:
            settings = part.text["settings"]
            before, after = (
                seam(each["ticks"], each["cells"], settings) for each in (part.before, part.after)
            )
            assert before == after
            n_facets += len(before)
    assert n_facets > 1000


def test_nodes_that_are_not_shared_move_and_are_exchanged(run):
    for parts in rounds_of(run, "improve"):
        before, after = (
            set(map(tuple, whole_mesh(parts, key).ticks.tolist())) for key in ("before", "after")
        )
        assert len(before & after) < 0.7 * len(before)


def test_each_round_begins_with_the_mesh_that_the_one_before_left(run):
    for before, after in pairwise(run[1]):
        one, other = whole_mesh(before, "after"), whole_mesh(after, "before")
        for ours, theirs in zip(in_order(one), in_order(other), strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_parts_add_up_to_the_whole(run, image):
    """Voxels exactly, energies and their parts to rounding; of each round."""
    history = run[0].result.history
    for record, parts in zip(
        history, [*rounds_of(run, "measure"), *rounds_of(run, "improve")], strict=True
    ):
        mesh, settings = whole_mesh(parts, "after"), parts[0].text["settings"]
        whole = measured_whole(image, mesh, settings)
        E_G, squares = content_energies(whole.state, whole.content)
        row = whole.record(0, 0.0, False, 0.0)
        assert (
            sum(part.numbers["n_voxels"] for part in parts)
            == record.n_voxels
            == row.n_voxels
            == image.data.size
        )
        for name, number in (
            ("E_G", E_G),
            ("squares", squares),
            ("E_D", row.E_D),
            ("E", whole.E()),
        ):
            total = sum(part.numbers[name] for part in parts)
            assert total == pytest.approx(number, rel=1e-11), name
        assert record.E_D == pytest.approx(row.E_D, rel=1e-11)
        assert record.E_G == pytest.approx(E_G, rel=1e-11)
        assert record.n_cells == len(mesh.cells)


def test_a_part_sees_its_own_box_of_voxels_alone(run, image):
    sizes = [
        np.ptp(part.before["ticks"] >> part.text["settings"]["bits"], axis=0).prod()
        for part in run[1][1]
    ]
    assert max(sizes) < 0.5 * image.data.size
