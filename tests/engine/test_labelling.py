"""Labels of cells: energy, fragments, manifold interfaces, and which cells may change without
changing topology.
"""

from functools import partial
from typing import NamedTuple

import naive
import numpy as np
import pytest
from meshes import both_dimensions, delaunay_box
from numpy.testing import assert_array_equal
from scipy.sparse import csr_array, vstack
from shapes import ball_image

from tetopt import Image, lattice_mesh
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


def dual_of(mesh, counts):
    """What moves of labels need, of a mesh (points, cells) and the voxels in its cells."""
    points, cells = mesh
    return labelling._dual(points, cells, across_of(cells, len(points)), Contents(counts))


def faults_of(dual, labels):
    """All places that are not manifold, and which of them are of two labels."""
    return labelling._nonmanifold(dual, labels, np.ones(len(dual.scale), dtype=bool))


def random_counts(rng, mesh, power=1):
    """Counts of three labels in the cells of a mesh (points, cells)."""
    size = volumes(*mesh)
    return csr_array(rng.random((len(size), 3)) ** power * size[:, None])


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


def solved(mesh, counts, components=None):
    """`label_cells` of a mesh (points, cells), and its defects."""
    points, cells = mesh
    n_labels = counts.shape[1]
    components = [np.array([1])] * n_labels if components is None else components
    across = across_of(cells, len(points))
    labels = label_cells(points, cells, across, Contents(counts), components, False)
    return Labelling(
        labels,
        int((labels != counts.toarray().argmax(axis=1)).sum()),
        int(faults_of(dual_of(mesh, counts), labels)[1].sum()),
        np.bincount(components_of(across, labels)[1], minlength=n_labels).tolist(),
        np.setdiff1d(counts.indices[counts.data > 0.0], labels).tolist(),
    )


def lattice(n, cubes):
    """A small lattice: cells numbered as they come."""
    mesh = lattice_mesh(Image(np.zeros((cubes,) * n)), blocks=(cubes,) * n)
    return mesh.points, mesh.cells


def box(n, count, seed):
    points, cells = delaunay_box(np.random.default_rng(seed), (6, 5, 7)[:n], count)
    return points, orient_cells(points, cells)


@both_dimensions
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


@both_dimensions
def test_what_is_not_manifold_as_the_twin(n):
    rng = np.random.default_rng(3)
    for seed in range(3):
        points, cells = mesh = box(n, 20, seed) if seed else lattice(n, 2)
        labels = rng.integers(0, 2 + seed, len(cells))
        dual = dual_of(mesh, whole(labels, 4, volumes(points, cells)))
        bad = {
            frozenset(int(i) for i in face if i >= 0): two
            for face, two in zip(*faults_of(dual, labels), strict=True)
        }
        twin = naive.nonmanifold(cells, labels)
        assert bad == {face: len(there) == 2 for face, there in twin.items()}
        assert len(bad) > 1


@both_dimensions
def test_a_cell_that_would_pinch_two_labels_as_all_places_have_it(n):
    """At the cell's own nodes and edges; the labels stay."""
    rng, answers = np.random.default_rng(5), []
    for seed in range(2):
        points, cells = mesh = box(n, 20, seed) if seed else lattice(n, 2)
        labels = rng.integers(0, 2, len(cells))
        labels[points[cells].mean(axis=1)[:, 0] > np.median(points[:, 0])] = 2
        dual = dual_of(mesh, whole(labels, 3, volumes(points, cells)))
        for cell in range(len(cells)):
            tried = labels.copy()
            tried[cell] = 2
            faces, is_two = faults_of(dual, tried)
            own = set(cells[cell].tolist()) | {-1}
            expected = not any(set(face) <= own for face in faces[is_two].tolist())
            answers.append(expected)
            tried[cell] = labels[cell]
            assert labelling._is_manifold(dual, tried, cell, 2, labelling._work(dual)) == expected
            assert (tried == labels).all()
    assert 0.1 < np.mean(answers) < 0.9


def dual_and_energy(rng, mesh):
    """The dual of random content, the labels of most voxels, and the energy of labels by the
    twin.
    """
    counts = random_counts(rng, mesh)
    dual, voxels = dual_of(mesh, counts), counts.toarray()
    voxels *= volumes(*mesh).sum() / voxels.sum()
    energy = partial(naive.labelling_energy, voxels, dual.tension, mesh[1])
    return dual, voxels.argmax(axis=1), energy


def with_label(labels, cell, label):
    return np.where(np.arange(len(labels)) == cell, label, labels)


@pytest.mark.full
@both_dimensions
def test_moves_lower_the_energy(n):
    """By cells of random content: each time cells settle it falls, and no move of one cell is
    left that lowers it.
    """
    dual, labels, energy = dual_and_energy(np.random.default_rng(5), box(n, 40, 1))
    assert_array_equal(labelling._majority(dual), labels)
    before = energy(labels)
    labelling._settle(dual, labels, np.zeros(3), False)
    after = energy(labels)
    assert after < before
    for cell in range(0, len(labels), 3):
        for other in dual.across[cell][dual.across[cell] >= 0]:
            assert energy(with_label(labels, cell, labels[other])) >= after - 1e-6


@both_dimensions
def test_faults_that_are_skipped_are_none(monkeypatch, n):
    """The same labels if each pass tries all places anew, with nothing known of others, for random
    content.
    """
    mend_places, n_known = labelling._mend_places, np.zeros(2, dtype=int)

    def with_marks(dual, labels, room, is_kept, faces, has_pairs, marks):
        n_known[0] += np.count_nonzero(~marks.is_sound) - len(np.unique(faces[faces >= 0]))
        mend_places(dual, labels, room, is_kept, faces, has_pairs, marks)
        n_known[1] += np.count_nonzero(np.isfinite(marks.rise))

    def without_marks(dual, labels, room, is_kept, faces, has_pairs, marks):
        for f in range(len(faces)):
            new = labelling._marks(dual)._replace(is_near=marks.is_near, is_due=marks.is_due)
            mend_places(dual, labels, room, is_kept, faces[f : f + 1], has_pairs, new)

    for seed in range(8):
        mesh = box(n, 60, seed)
        counts = random_counts(np.random.default_rng(seed), mesh, 4)
        with monkeypatch.context() as patched:
            patched.setattr(labelling, "_mend_places", with_marks)
            own = solved(mesh, counts).labels
            patched.setattr(labelling, "_mend_places", without_marks)
            patched.setattr(labelling, "mend", lambda *pass_of: mend(*pass_of[:5]))
            assert_array_equal(solved(mesh, counts).labels, own)
    assert (n_known > 0).all()


@pytest.mark.full
def test_a_bridge_is_the_cheapest():
    """Between two components of a label, by the energy of each cell that it takes."""
    mesh = box(3, 8, 4)
    dual, labels, energy = dual_and_energy(np.random.default_rng(9), mesh)
    cells = range(len(labels))
    number, of_component = components_of(dual.across, labels)
    way, before, bridge = np.full(len(cells), np.inf), np.empty_like(labels), np.empty_like(labels)
    n_bridges = 0
    for component, label in enumerate(of_component):
        sources = np.flatnonzero(number == component)
        ends = np.flatnonzero((labels == label) & (number != component))
        if len(ends) == 0 or len(sources) > 4:
            continue
        costs = np.array([energy(with_label(labels, cell, label)) for cell in cells])
        costs = np.maximum(costs - energy(labels), 0.0)
        least = naive.cheapest_way(mesh[1], costs, set(sources.tolist()), set(ends.tolist()))
        find = partial(labelling._bridge, bridge, way, before, dual, labels, sources)
        assert find(0.99 * least) == 0
        count = find(1.01 * least + 1e-6)
        assert costs[bridge[:count]].sum() == pytest.approx(least, abs=1e-6)
        linked = labels.copy()
        linked[bridge[:count]] = label
        after = components_of(dual.across, linked)[0]
        assert np.isin(after[ends], after[sources]).any()
        assert np.isinf(way).all()
        n_bridges += 1
    assert n_bridges > 2


def with_noise(image, blocks, seed, fraction):
    """A lattice of an image of two labels, and the voxels of each in its cells, of some of which
    they are exchanged.
    """
    mesh = lattice_mesh(image, blocks=blocks)
    owner, n_cells = cell_of_voxel(image, mesh).ravel(), len(mesh.cells)
    counts = np.zeros((n_cells, 2))
    np.add.at(counts, (owner, image.data.ravel().astype(int)), 1.0)
    loose = np.random.default_rng(seed).random(n_cells) < fraction
    counts[loose] = counts[loose][:, ::-1]
    counts[counts.sum(axis=1) == 0.0, 0] = 0.1
    return (mesh.points, mesh.cells), image, csr_array(counts)


def ball(n_blocks=7, radius=7.5, seed=None):
    """A lattice and the labels of a ball in it, with some cells of noise."""
    image = ball_image((24, 24, 24), (11.5, 11.6, 11.7), radius)
    return with_noise(image, (n_blocks,) * 3, seed, 0.0 if seed is None else 0.03)


def disc():
    return with_noise(ball_image((30, 28), (14.2, 13.1), 8.0), (9, 9), 2, 0.05)


@pytest.mark.parametrize(
    ("case", "tolerance"),
    [(ball(), 0.12), (ball(seed=0), 0.12), (ball(seed=1), 0.12), (disc(), 0.1)],
)
def test_a_ball_is_one_component_with_a_manifold_surface(case, tolerance):
    """In space and in the plane, noise or not: one component, the Euler number of a ball and of its
    surface, and most of its volume.
    """
    mesh, image, counts = case
    result = solved(mesh, counts)
    inside = mesh[1][result.labels == 1]
    assert (result.components, result.n_nonmanifold, result.lost) == ([1, 1], 0, [])
    assert naive.euler(naive.faces_of(inside)) == 1
    assert volumes(mesh[0], inside).sum() == pytest.approx(image.data.sum(), rel=tolerance)
    if image.ndim == 2:
        assert naive.nonmanifold(mesh[1], result.labels) == {}


def test_tension_takes_half_of_a_label_at_most(tension):
    """A ball smaller than three times the tension in radius would wither away; here it and its
    noise would.
    """
    tension(3.0)
    mesh, image, counts = ball(11, 3.0, seed=0)
    result = solved(mesh, counts)
    assert result.n_moved > 200
    assert volumes(*mesh)[result.labels == 1].sum() / image.data.sum() > 0.45


def two_balls(gap):
    """A lattice with a large and a small ball, each cell full of one label but for a fraction
    `gap` along a line; which cells are the small ball, and the balls' voxels.
    """
    mesh, image, counts = ball(radius=5.0)
    centre, full = mesh[0][mesh[1]].mean(axis=1), counts.toarray()
    is_small = np.linalg.norm(centre - 3.0, axis=1) < 4.0
    is_between = (np.ptp(centre, axis=1) < 4.0) & (centre.mean(axis=1) < 9.0) & ~is_small
    for chosen, fraction in ((is_small, 1.0), (is_between, gap)):
        full[chosen] = full[chosen].sum(axis=1)[:, None] * [1.0 - fraction, fraction]
    return mesh, csr_array(full), is_small, np.array([image.data.sum(), full[is_small, 1].sum()])


@pytest.mark.parametrize(
    ("gap", "sizes", "n_pieces", "is_kept"),
    [
        (0.0, [[1, 0], [0, 1]], 2, True),
        (0.0, [[1, 0]], 1, False),
        (0.0, [[1, 0], [0, 0.25]], 1, False),
        (0.45, [[1, 0], [0, 1]], 2, True),
        (0.45, [[1, 1]], 1, True),
    ],
)
def test_fragments_go_and_components_stay(gap, sizes, n_pieces, is_kept):
    """Two balls are two components where voxels have two; the smaller goes where they have one,
    or a speck besides. Where nearly half of the voxels between them have the label they are
    linked, if voxels have one component.
    """
    mesh, counts, is_small, n_voxels = two_balls(gap)
    pieces = [np.array([9000]), (sizes @ n_voxels).astype(int)]
    result = solved(mesh, counts, pieces)
    assert (result.components, result.n_nonmanifold) == ([1, n_pieces], 0)
    in_small = (result.labels[is_small] == 1).mean()
    assert in_small > 0.5 if is_kept else in_small == 0.0


@pytest.mark.parametrize("other", [(2, 2, 1), (2, 2, 2)])
def test_cubes_that_touch_at_an_edge_or_a_corner_are_linked_or_parted(tension, other):
    """A lattice of cubes, two of which have the label: what they share is no longer pinched."""
    tension(1e-6)
    mesh = lattice_mesh(Image(np.zeros((4, 4, 4))), "five-tet", blocks=(4, 4, 4))
    cube = np.floor(mesh.points[mesh.cells].mean(axis=1) + 0.5).astype(int)
    labels = ((cube == 1).all(axis=1) | (cube == other).all(axis=1)).astype(np.int64)
    assert len(naive.nonmanifold(mesh.cells, labels)) > 0
    result = solved(
        (mesh.points, mesh.cells),
        whole(labels, 2, volumes(mesh.points, mesh.cells)),
        [np.array([60]), np.array([1, 1])],
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
    by_one, dual = labels.copy(), dual_of((points, cells), contents.counts)
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
    the cell; and twice the same piece gets no more.
    """
    tension(1e-9)
    points, cells = lattice(3, 5)
    size, middle = volumes(points, cells), points[cells].mean(axis=1)
    labels = (middle[:, 0] < 1.5).astype(np.int64)
    full = whole(labels, 2, size).toarray()
    piece = np.argmin(np.abs(middle - 3.0).max(axis=1))
    full[piece] = size[piece] * np.array([1.0 - share, share])
    held = np.append(share, np.full(4, (n_voxels - share) / 4)) * size[piece]
    pieces = csr_array((held, (np.zeros(5, dtype=int), piece - np.arange(5))), (1, len(cells)))
    for count in (1, 2):
        contents = Contents(
            csr_array(full), None, vstack([pieces] * count).tocsr(), np.ones(count, dtype=int)
        )
        across = across_of(cells, len(points))
        made = label_cells(points, cells, across, contents, [np.array([1])] * 2)
        changed = [piece] if is_kept else []
        assert np.flatnonzero(made != labels).tolist() == changed
        assert naive.nonmanifold(cells, made) == {}


def random_labels(seed, n_labels):
    """A mesh whose cells are full of random labels: what `mend` needs, and the labels."""
    mesh = box(3, 24, seed)
    size = volumes(*mesh)
    labels = np.random.default_rng(seed).integers(0, n_labels, len(size))
    dual = dual_of(mesh, whole(labels, n_labels, size))
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
    assert faults_of(dual, labels)[1].any()
    run, narrow = partial(mend, dual, labels, labels < 0, targets), FINAL_PASSES[0]
    run(narrow)
    before = labels.copy()
    run(narrow)
    assert (labels == before).all()
    run(narrow._replace(is_wide=True))
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
    monkeypatch.setattr(
        labelling, "_mend_places", lambda dual, *_: counts.append(dual.contacts.is_apart.any())
    )
    for limits in (*LAST_PASSES, *FINAL_PASSES):
        mend(dual._replace(contacts=apart), labels, labels < 0, targets, limits)
    assert counts == [True] * (len(counts) - 1) + [False]


@pytest.mark.parametrize(("aim", "is_kept"), [(3.2, True), (3.5, False), (1e9, False)])
def test_a_label_with_next_to_nothing_of_its_volume_goes_from_finished_cells(aim, is_kept):
    """By its volume `aim` over that of its only cell, which is far smaller than a mean cell."""
    points, cells = box(3, 60, 1)
    size = volumes(points, cells)
    assert size.min() < 0.1 * size.mean()
    labels = np.zeros(len(cells), dtype=np.int64)
    labels[np.argmin(size)] = 1
    volume, contents = np.array([size.sum(), aim * size.min()]), Contents(whole(labels, 2, size))
    made = mend_labels(points, cells, across_of(cells, len(points)), contents, labels, volume)
    assert (made == labels).all() == is_kept
    assert unfit_labels(labels, size, volume).tolist() == [False, not is_kept]


def test_a_label_of_one_cell_stays_and_one_without_is_lost(tension):
    """However much tension there is."""
    tension(30.0)
    mesh, _, counts = ball()
    full = np.pad(counts.toarray(), ((0, 0), (0, 2)))
    full[100] = [0.0, 0.0, full[100].sum(), 0.0]
    full[200, 3] = 0.1
    result = solved(mesh, csr_array(full))
    assert (result.labels == 2).any()
    assert result.lost == [3]


def test_no_label_goes_for_a_bridge(tension):
    """Three triangles in a row: the way between the outer ones is the only cell of another
    label, and stays so.
    """
    tension(1e-9)
    points = np.array([[0.0, 0.0], [2.0, 0.0], [1.0, 1.5], [3.0, 1.5], [4.0, 0.0]])
    counts = csr_array([[1.0, 0.0], [0.08, 0.1], [1.0, 0.0]])
    mesh = points, np.array([[0, 1, 2], [1, 3, 2], [1, 4, 3]])
    result = solved(mesh, counts, [np.array([2])] * 2)
    assert (result.labels.tolist(), result.lost) == ([0, 1, 0], [])


def test_components_of_voxels():
    partition = np.array([[0, 0, 1, 1], [1, 0, 0, 1], [1, 1, 0, 3]])
    sizes = label_voxels(partition, np.ones(2), 4).components
    assert [s.tolist() for s in sizes] == [[5], [3, 3], [], [1]]


def test_pieces_of_labels_are_large_components_but_the_largest():
    """Of 64, 50, 49 and 75 voxels of one label: those of 64 and 50. One component of another
    label is none.
    """
    partition = np.zeros((12, 12, 12), dtype=np.int64)
    boxes = np.s_[:4, :4, :4], np.s_[5:10, 5:10, 5:7], np.s_[:3, :5, 6:11], np.s_[11, :7, :7]
    for box in boxes:
        partition[box] = 1
    partition[:, 11] = 2
    pieces = label_voxels(partition, np.ones(3), 3).pieces
    number = np.arange(partition.size).reshape(partition.shape)
    assert pieces.label.tolist() == [1, 1]
    for k, box in enumerate(boxes[:2]):
        assert pieces.voxels[pieces.piece == k].tolist() == number[box].ravel().tolist()
    # of 32 and 25 whole voxels
    assert label_voxels(partition, np.ones(3), 3, parts=2).pieces.label.tolist() == []
