"""Labels of cells: energy, fragments, manifold interfaces, and which cells may change without
changing topology.
"""

from typing import NamedTuple

import naive
import numpy as np
import pytest
from meshes import delaunay_box
from scipy.sparse import csr_array, vstack
from shapes import distance

import tetopt
from tetopt.energy.sampling import cell_of_voxel
from tetopt.engine import labelling
from tetopt.engine.complex import fill_across
from tetopt.engine.labelling import (
    FINAL_PASSES,
    LAST_PASSES,
    Contents,
    Pass,
    components_of,
    keeps_topology,
    label_cells,
    label_voxels,
    mend,
    mend_labels,
    unfit_labels,
)
from tetopt.geometry.simplex import orient_cells, volumes
from tetopt.geometry.topology import stars


def across_of(cells, n_nodes):
    across = np.full(cells.shape, -1, dtype=np.int64)
    fill_across(across, np.ascontiguousarray(cells), len(cells), n_nodes)
    return across


def whole(labels, n_labels, size):
    """Counts of a mesh whose cells each hold their volume in voxels of one label."""
    return csr_array((size, (np.arange(len(labels)), labels)), shape=(len(labels), n_labels))


class Labelling(NamedTuple):
    """The label of each cell, and remaining defects."""

    labels: np.ndarray  # (M,)
    n_moved: int  # cells whose label is not that of most of their voxels
    n_nonmanifold: int  # edges and nodes where only two labels meet
    components: list[int]  # of the cells of each label, linked by facets
    lost: list[int]  # labels with voxels but without cells


@pytest.fixture
def tension(monkeypatch):
    """A function that sets the fraction of the local edge that is the tension."""
    return lambda fraction: monkeypatch.setattr(labelling, "TENSION_FRACTION", fraction)


def solved(points, cells, labels, n_labels=2, components=None, counts=None):
    """`label_cells`, by default of cells that are full of one label each, and its defects."""
    counts = whole(labels, n_labels, volumes(points, cells)) if counts is None else counts
    components = [np.array([1])] * n_labels if components is None else components
    across = across_of(cells, len(points))
    labels = label_cells(points, cells, across, Contents(counts), components, False)
    return Labelling(
        labels,
        int((labels != counts.toarray().argmax(axis=1)).sum()),
        int(
            labelling._nonmanifold(
                labelling._dual(points, cells, across, Contents(counts)), labels
            )[1].sum()
        ),
        np.bincount(components_of(across, labels)[1], minlength=n_labels).tolist(),
        np.setdiff1d(counts.indices[counts.data > 0.0], labels).tolist(),
    )


def lattice(n, cubes):
    """A small lattice: cells numbered as they come."""
    mesh = tetopt.lattice_mesh(tetopt.Image(np.zeros((cubes,) * n)), blocks=(cubes,) * n)
    return mesh.points, mesh.cells


def box(n, count, seed):
    points, cells = delaunay_box(np.random.default_rng(seed), (6, 5, 7)[:n], count)
    return points, orient_cells(points, cells)


@pytest.mark.parametrize("n", [2, 3])
def test_keeps_topology_as_its_twin(n):
    """On random labels: the twin's answer; where it is yes neither Euler numbers nor components
    change.
    """
    rng, n_kept, n_asked = np.random.default_rng(7), 0, 0
    for seed in range(2):
        points, cells = box(n, 25, seed) if seed % 2 else lattice(n, 2)
        across, star = across_of(cells, len(points)), stars(cells, len(points))
        for _ in range(3):
            # Half spaces with noise: few cells of pure noise may change.
            place = points[cells].mean(axis=1) @ rng.normal(size=n)
            labels = np.digitize(place, np.quantile(place, [0.3, 0.6]))
            labels = np.where(rng.random(len(cells)) < 0.1, rng.integers(0, 3, len(cells)), labels)
            for cell in rng.choice(len(cells), 12):
                for label in {0, 1, 2} - {int(labels[cell])}:
                    keeps = keeps_topology(
                        cells, across, labels, star.start, star.cells, cell, label
                    )
                    assert keeps == naive.keeps_topology(cells, labels, cell, label)
                    n_asked, n_kept = n_asked + 1, n_kept + keeps
                    if keeps:
                        assert_same_topology(cells, labels, cell, label)
    assert n_asked >= 100
    assert n_kept > 0.05 * n_asked


def assert_same_topology(cells, labels, cell, label):
    after = labels.copy()
    after[cell] = label
    across = across_of(cells, int(cells.max()) + 1)
    for one in (labels[cell], label):
        assert naive.euler(naive.faces_of(cells[labels == one])) == naive.euler(
            naive.faces_of(cells[after == one])
        )
        n_pieces = [(components_of(across, of)[1] == one).sum() for of in (labels, after)]
        assert n_pieces[0] == n_pieces[1]
        assert naive.pinched(cells, after, one) == naive.pinched(cells, labels, one)


@pytest.mark.parametrize("n", [2, 3])
def test_what_is_not_manifold_as_the_twin(n):
    rng = np.random.default_rng(3)
    for seed in range(3):
        points, cells = box(n, 20, seed) if seed else lattice(n, 2)
        labels = rng.integers(0, 2 + seed, len(cells))
        counts = whole(labels, 4, volumes(points, cells))
        dual = labelling._dual(points, cells, across_of(cells, len(points)), Contents(counts))
        faces, is_two = labelling._nonmanifold(dual, labels)
        bad = {
            frozenset(int(i) for i in face if i >= 0): two
            for face, two in zip(faces, is_two, strict=True)
        }
        assert bad == {
            face: len(there) == 2 for face, there in naive.nonmanifold(cells, labels).items()
        }
        assert len(bad) > 1


@pytest.mark.full
@pytest.mark.parametrize("n", [2, 3])
def test_moves_lower_the_energy(n):
    """By cells of random content: each time cells settle it falls, and no move of one cell is
    left that lowers it.
    """
    rng = np.random.default_rng(5)
    points, cells = box(n, 40, 1)
    voxels = rng.random((len(cells), 3)) * volumes(points, cells)[:, None]
    dual = labelling._dual(
        points, cells, across_of(cells, len(points)), Contents(csr_array(voxels))
    )
    labels = voxels.argmax(axis=1)
    voxels *= volumes(points, cells).sum() / voxels.sum()

    def energy(labels):
        return naive.labelling_energy(voxels, dual.tension, cells, labels)

    np.testing.assert_array_equal(labelling._majority(dual), labels)
    before = energy(labels)
    moved = labelling._settle(dual, labels, np.zeros(3), False)
    after = energy(labels)
    assert moved > 0
    assert after < before
    for cell in range(0, len(cells), 3):
        for other in dual.across[cell][dual.across[cell] >= 0]:
            changed = labels.copy()
            changed[cell] = labels[other]
            assert energy(changed) >= after - 1e-6


@pytest.mark.parametrize("n", [2, 3])
def test_faults_that_are_skipped_are_none(monkeypatch, n):
    """The same labels whether or not sound nodes, and those where nothing changed, are skipped,
    for random content.
    """
    mend_places, n_skipped = labelling._mend_places, 0

    def without_marks(*arguments):
        nonlocal n_skipped
        *rest, marks, work = arguments
        n_skipped += np.count_nonzero(marks.is_sound)
        marks.is_due[:] = True
        mend_places(*rest, marks._replace(is_sound=np.zeros_like(marks.is_sound)), work)

    for seed in range(8):
        rng = np.random.default_rng(seed)
        points, cells = box(n, 60, seed)
        counts = csr_array(rng.random((len(cells), 3)) ** 4 * volumes(points, cells)[:, None])
        own = solved(points, cells, None, 3, counts=counts)
        with monkeypatch.context() as patched:
            patched.setattr(labelling, "_mend_places", without_marks)
            np.testing.assert_array_equal(
                solved(points, cells, None, 3, counts=counts).labels, own.labels
            )
    assert n_skipped > 0


@pytest.mark.full
def test_a_bridge_is_the_cheapest():
    """Between two components of a label, by the energy of each cell that it takes."""
    points, cells = box(3, 8, 4)
    voxels = np.random.default_rng(9).random((len(cells), 3)) * volumes(points, cells)[:, None]
    dual = labelling._dual(
        points, cells, across_of(cells, len(points)), Contents(csr_array(voxels))
    )
    voxels *= volumes(points, cells).sum() / voxels.sum()
    labels = voxels.argmax(axis=1)
    number, of_component = components_of(dual.across, labels)
    way, before, bridge = np.full(len(cells), np.inf), np.empty_like(labels), np.empty_like(labels)
    energy = naive.labelling_energy(voxels, dual.tension, cells, labels)
    n_bridges = 0
    for component, label in enumerate(of_component):
        sources, ends = (
            np.flatnonzero(number == component),
            np.flatnonzero((labels == label) & (number != component)),
        )
        if len(ends) == 0 or len(sources) > 4:
            continue
        changed = [
            np.where(np.arange(len(cells)) == cell, label, labels) for cell in range(len(cells))
        ]
        costs = [naive.labelling_energy(voxels, dual.tension, cells, of) - energy for of in changed]
        costs = np.maximum(costs, 0.0)
        least = naive.cheapest_way(cells, costs, set(sources.tolist()), set(ends.tolist()))
        assert labelling._bridge(bridge, way, before, dual, labels, sources, 0.99 * least) == 0
        count = labelling._bridge(bridge, way, before, dual, labels, sources, 1.01 * least + 1e-6)
        assert costs[bridge[:count]].sum() == pytest.approx(least, abs=1e-6)
        linked = labels.copy()
        linked[bridge[:count]] = label
        after = components_of(dual.across, linked)[0]
        assert np.isin(after[ends], after[sources]).any()
        assert np.isinf(way).all()
        n_bridges += 1
    assert n_bridges > 2


def ball(n_blocks=7, radius=7.5, seed=None):
    """A lattice and the labels of a ball in it, with some cells of noise."""
    shape = (24, 24, 24)
    image = tetopt.Image(1.0 * (distance(shape, 11.5, 11.6, 11.7) < radius))
    mesh = tetopt.lattice_mesh(image, blocks=(n_blocks,) * 3)
    owner, n_cells = cell_of_voxel(image, mesh).ravel(), len(mesh.cells)
    counts = np.zeros((n_cells, 2))
    np.add.at(counts, (owner, image.data.ravel().astype(int)), 1.0)
    if seed is not None:
        loose = np.random.default_rng(seed).random(n_cells) < 0.03
        counts[loose] = counts[loose][:, ::-1]
    counts[counts.sum(axis=1) == 0.0, 0] = 0.1
    return mesh, image, csr_array(counts)


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_a_ball_is_one_component_with_a_manifold_surface(seed):
    """Noise or not: one component, the Euler number of a ball and of its surface, and most of
    its volume.
    """
    mesh, image, counts = ball(seed=seed)
    result = solved(mesh.points, mesh.cells, None, counts=counts)
    inside = mesh.cells[result.labels == 1]
    assert result.components == [1, 1]
    assert result.n_nonmanifold == 0
    assert naive.euler(naive.faces_of(inside)) == 1
    assert volumes(mesh.points, inside).sum() == pytest.approx(image.data.sum(), rel=0.12)
    assert result.lost == []


def test_tension_takes_half_of_a_label_at_most(tension):
    """A ball smaller than three times the tension in radius would wither away; here it and its
    noise would.
    """
    tension(3.0)
    mesh, image, counts = ball(11, 3.0, seed=0)
    result = solved(mesh.points, mesh.cells, None, counts=counts)
    assert result.n_moved > 200
    assert volumes(mesh.points, mesh.cells[result.labels == 1]).sum() / image.data.sum() > 0.45


def test_a_disc_in_the_plane():
    shape = (30, 28)
    image = tetopt.Image(1.0 * (distance(shape, 14.2, 13.1) < 8.0))
    mesh = tetopt.lattice_mesh(image, blocks=(9, 9))
    counts = np.zeros((len(mesh.cells), 2))
    np.add.at(counts, (cell_of_voxel(image, mesh).ravel(), image.data.ravel().astype(int)), 1.0)
    loose = np.random.default_rng(2).random(len(counts)) < 0.05
    counts[loose] = counts[loose][:, ::-1]
    result = solved(mesh.points, mesh.cells, None, counts=csr_array(counts))
    assert result.components == [1, 1]
    assert result.n_nonmanifold == 0
    assert naive.nonmanifold(mesh.cells, result.labels) == {}
    assert volumes(mesh.points, mesh.cells[result.labels == 1]).sum() == pytest.approx(
        image.data.sum(), rel=0.1
    )


def two_balls(gap):
    """A lattice with a large and a small ball, each cell full of one label but for a fraction
    `gap` along a line.
    """
    mesh, image, counts = ball(radius=5.0)
    centre, full = mesh.points[mesh.cells].mean(axis=1), counts.toarray()
    is_small = np.linalg.norm(centre - 3.0, axis=1) < 4.0
    is_between = (np.ptp(centre, axis=1) < 4.0) & (centre.mean(axis=1) < 9.0) & ~is_small
    for chosen, fraction in ((is_small, 1.0), (is_between, gap)):
        full[chosen] = full[chosen].sum(axis=1)[:, None] * [1.0 - fraction, fraction]
    return mesh, csr_array(full), is_small, (int(image.data.sum()), int(full[is_small, 1].sum()))


def test_fragments_go_and_components_stay():
    """Two balls are two components where voxels have two; the smaller goes where they have one,
    or a speck besides.
    """
    mesh, counts, is_small, (large, small) = two_balls(0.0)
    ends = {}
    for name, sizes in (("two", [large, small]), ("one", [large]), ("speck", [large, small // 4])):
        ends[name] = solved(
            mesh.points,
            mesh.cells,
            None,
            counts=counts,
            components=[np.array([9000]), np.array(sizes)],
        )
    assert ends["two"].components == [1, 2]
    assert ends["one"].components == ends["speck"].components == [1, 1]
    assert (ends["one"].labels[is_small] == 0).all()
    assert (ends["two"].labels[is_small] == 1).mean() > 0.5


def test_what_hangs_together_in_the_voxels_is_bridged():
    """Between the balls nearly half of the voxels have the label: they are linked, where voxels
    have one component.
    """
    mesh, counts, is_small, (large, small) = two_balls(0.45)
    for sizes, n_pieces in (([large, small], 2), ([large + small], 1)):
        result = solved(
            mesh.points,
            mesh.cells,
            None,
            counts=counts,
            components=[np.array([9000]), np.array(sizes)],
        )
        assert result.components == [1, n_pieces]
        assert result.n_nonmanifold == 0
        assert (result.labels[is_small] == 1).mean() > 0.5


def test_cubes_that_touch_at_an_edge_or_a_corner_are_linked_or_parted(tension):
    """A lattice of cubes, two of which have the label: what they share is no longer pinched."""
    tension(1e-6)
    image = tetopt.Image(np.zeros((4, 4, 4)))
    mesh = tetopt.lattice_mesh(image, "five-tet", blocks=(4, 4, 4))
    cube = np.floor(mesh.points[mesh.cells].mean(axis=1) + 0.5).astype(int)
    for other in ((2, 2, 1), (2, 2, 2)):
        labels = ((cube == 1).all(axis=1) | (cube == other).all(axis=1)).astype(np.int64)
        assert len(naive.nonmanifold(mesh.cells, labels)) > 0
        result = solved(
            mesh.points,
            mesh.cells,
            labels,
            components=[np.array([60]), np.array([1, 1])],
        )
        assert naive.nonmanifold(mesh.cells, result.labels) == {}
        assert result.n_nonmanifold == 0
        assert 0 < result.n_moved < 10


@pytest.mark.parametrize("seed", [5, 77, 80])
def test_two_cells_mend_what_one_cell_or_a_fan_does_not(seed):
    points, cells = box(3, 60, seed)
    rng, middle = np.random.default_rng(seed), points[cells].mean(axis=1)
    labels = np.sin(middle @ rng.normal(size=3)) + np.sin(middle @ rng.normal(size=3) * 1.3) > 0.0
    labels, across = labels.astype(np.int64), across_of(cells, len(points))
    contents = Contents(whole(labels, 2, volumes(points, cells)))
    by_one, dual = labels.copy(), labelling._dual(points, cells, across, contents)
    aim = np.full(2, dual.size.sum())
    one_cell = FINAL_PASSES[0]._replace(has_pairs=False)
    mend(dual, by_one, labels < 0, labelling._targets(dual, aim), one_cell)
    by_two = mend_labels(points, cells, across, contents, labels, aim)
    assert len(naive.nonmanifold(cells, by_one)) > len(naive.nonmanifold(cells, by_two)) == 0


@pytest.mark.parametrize(
    ("share", "n_voxels", "is_kept"), [(0.35, 1.0, True), (0.25, 1.0, False), (0.35, 0.6, False)]
)
def test_a_piece_of_a_label_gets_the_cell_that_it_fits(tension, share, n_voxels, is_kept):
    """One that fills a third of a cell, but not one that fills a quarter, or is far smaller than
    the cell.
    """
    tension(1e-9)
    points, cells = lattice(3, 5)
    size, labels = volumes(points, cells), (points[cells].mean(axis=1)[:, 0] < 1.5).astype(np.int64)
    full = whole(labels, 2, size).toarray()
    piece = np.argmin(np.abs(points[cells].mean(axis=1) - 3.0).max(axis=1))
    full[piece] = size[piece] * np.array([1.0 - share, share])
    held = np.append(share, np.full(4, (n_voxels - share) / 4)) * size[piece]
    pieces = csr_array((held, (np.zeros(5, dtype=int), piece - np.arange(5))), (1, len(cells)))
    contents = Contents(csr_array(full), None, pieces, np.array([1]))
    rest = points, cells, across_of(cells, len(points))
    made = label_cells(*rest, contents, [np.array([1])] * 2)
    assert (made[piece] == 1) == is_kept
    assert (made != labels).sum() == is_kept
    twice = Contents(csr_array(full), None, vstack([pieces, pieces]).tocsr(), np.array([1, 1]))
    again = label_cells(*rest, twice, [np.array([1])] * 2)
    assert again.tolist() == made.tolist()
    assert naive.nonmanifold(cells, made) == {}


def random_labels(seed, n_labels, **contacts):
    """A mesh whose cells are full of random labels: what `mend` needs, and the labels."""
    points, cells = box(3, 24, seed)
    labels = np.random.default_rng(seed).integers(0, n_labels, len(cells))
    size = volumes(points, cells)
    contents = Contents(whole(labels, n_labels, size), **contacts)
    dual = labelling._dual(points, cells, across_of(cells, len(points)), contents)
    return dual, labels, labelling._targets(dual, np.full(n_labels, size.sum()))


def test_limits_of_a_pass():
    """Fractions of the volume near the surface, but never less than a fit cell."""
    targets = labelling.Targets(np.array([10.0, 1.0]), np.array([4.0, 1.0]), np.array([0.5, 0.2]))
    assert targets.bounds(Pass(0.25, 0.5)).tolist() == [[9.0, 0.75], [12.0, 1.5]]
    assert targets.bounds(Pass(0.9, 0.0))[0] == pytest.approx([6.4, 0.2])
    assert targets.bounds(FINAL_PASSES[0])[0].tolist() == [0.5, 0.2]


def test_a_narrow_pass_mends_two_labels_only():
    """Places of three labels are left to a wide one."""
    dual, labels, targets = random_labels(3, 3)
    is_kept, narrow = np.zeros(len(labels), dtype=bool), FINAL_PASSES[0]
    assert labelling._nonmanifold(dual, labels)[1].any()
    mend(dual, labels, is_kept, targets, narrow)
    before = labels.copy()
    mend(dual, labels, is_kept, targets, narrow)
    assert (labels == before).all()
    mend(dual, labels, is_kept, targets, narrow._replace(is_wide=True))
    assert (labels != before).any()


def test_kept_cells_stay():
    dual, labels, targets = random_labels(5, 2)
    before, is_kept = labels.copy(), np.random.default_rng(0).random(len(labels)) < 0.7
    mend(dual, labels, is_kept, targets, FINAL_PASSES[0])
    assert (labels[is_kept] == before[is_kept]).all()
    assert (labels != before).any()


def test_false_contact_counts_but_in_the_last_pass(monkeypatch):
    dual, labels, targets = random_labels(5, 2)
    apart = labelling.Contacts(~np.eye(2, dtype=bool), np.zeros(len(labels), dtype=bool))
    counts = []

    def record(dual, *_):
        counts.append(bool(dual.contacts.is_apart.any()))

    monkeypatch.setattr(labelling, "_mend_places", record)
    for limits in (*LAST_PASSES, *FINAL_PASSES):
        mend(dual._replace(contacts=apart), labels, labels < 0, targets, limits)
    assert counts == [True] * (len(counts) - 1) + [False]


@pytest.mark.parametrize(("aim", "is_kept"), [(3.2, True), (3.5, False), (1e9, False)])
def test_a_label_with_next_to_nothing_of_its_volume_goes_from_finished_cells(aim, is_kept):
    """By its volume `aim` over that of its only cell, which is far smaller than a mean cell."""
    points, cells = box(3, 60, 1)
    size, labels = volumes(points, cells), np.zeros(len(cells), dtype=np.int64)
    labels[np.argmin(size)] = 1
    assert size.min() < 0.1 * size.mean()
    volume = np.array([size.sum(), aim * size.min()])
    made = mend_labels(
        points,
        cells,
        across_of(cells, len(points)),
        Contents(whole(labels, 2, size)),
        labels,
        volume,
    )
    assert (made == labels).all() == is_kept
    assert unfit_labels(labels, size, volume).tolist() == [False, not is_kept]


def test_a_label_of_one_cell_stays_and_one_without_is_lost(tension):
    """However much tension there is."""
    tension(30.0)
    mesh, _, counts = ball()
    full = np.column_stack([counts.toarray(), np.zeros((len(mesh.cells), 2))])
    full[100] = [0.0, 0.0, full[100].sum(), 0.0]
    full[200, 3] = 0.1
    result = solved(mesh.points, mesh.cells, None, 4, counts=csr_array(full))
    assert (result.labels == 2).any()
    assert result.lost == [3]


def test_no_label_goes_for_a_bridge(tension):
    """Three triangles in a row: the way between the outer ones is the only cell of another
    label, and stays so.
    """
    tension(1e-9)
    points = np.array([[0.0, 0.0], [2.0, 0.0], [1.0, 1.5], [3.0, 1.5], [4.0, 0.0]])
    cells = np.array([[0, 1, 2], [1, 3, 2], [1, 4, 3]])
    counts = csr_array([[1.0, 0.0], [0.08, 0.1], [1.0, 0.0]])
    result = solved(points, cells, None, counts=counts, components=[np.array([2])] * 2)
    assert result.labels.tolist() == [0, 1, 0]
    assert result.lost == []


def test_components_of_voxels():
    partition = np.array([[0, 0, 1, 1], [1, 0, 0, 1], [1, 1, 0, 3]])
    sizes = label_voxels(partition, np.ones(2), 4).components
    assert [s.tolist() for s in sizes] == [[5], [3, 3], [], [1]]


def test_pieces_of_labels_are_large_components_but_the_largest():
    """Of 64, 50, 49 and 75 voxels of one label: those of 64 and 50. One component of another
    label is none.
    """
    partition = np.zeros((12, 12, 12), dtype=np.int64)
    partition[:4, :4, :4] = partition[5:10, 5:10, 5:7] = partition[:3, :5, 6:11] = partition[
        11, :7, :7
    ] = 1
    partition[:, 11] = 2
    pieces = label_voxels(partition, np.ones(3), 3).pieces
    number = np.arange(partition.size).reshape(partition.shape)
    assert pieces.label.tolist() == [1, 1]
    for k, box in enumerate((np.s_[:4, :4, :4], np.s_[5:10, 5:10, 5:7])):
        assert pieces.voxels[pieces.piece == k].tolist() == number[box].ravel().tolist()
    # of 32 and 25 whole voxels
    assert label_voxels(partition, np.ones(3), 3, parts=2).pieces.label.tolist() == []
