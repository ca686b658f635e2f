"""Work in slabs: results are the same to the last bit however many there are."""

import numba
import numpy as np
import pytest
from scipy.ndimage import correlate1d, gaussian_filter, maximum_filter

import tetopt
from tetopt.contents import smoothing
from tetopt.contents.thickness import local_thickness
from tetopt.energy.sampling import cell_moments_and_ranges, cell_of_voxel
from tetopt.system import slabs


@pytest.fixture(params=[1, 3])
def many_slabs(request, monkeypatch):
    """Slabs of a plane or so even in small arrays, on one or several threads."""
    before = numba.get_num_threads()
    numba.set_num_threads(min(request.param, before))
    monkeypatch.setattr(slabs, "SLAB_ELEMENTS", 1)
    monkeypatch.setattr(slabs, "SLABS_PER_THREAD", 7)
    yield
    numba.set_num_threads(before)


def noise(shape, seed=0):
    return gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2.0)


def results(shape, factors):
    """What is computed in slabs, of a mask and labels of this shape, as bytes."""
    field, n = noise(shape), len(shape)
    inside, labels = (
        field > 0.0,
        tetopt.Image(np.digitize(field, [-0.02, 0.02]).astype(float), np.eye(n + 1)),
    )
    off = None if max(factors) == 1 else np.full(shape, 0.5, dtype=np.float32)
    mesh, image = tetopt.lattice_mesh(labels, nodes=200), tetopt.Image(field, labels.affine)
    mask = tetopt.Image((noise(shape, 1) > -0.05).astype(float), labels.affine)
    what = tetopt.content([image, image], labels, mask)
    moments, ranges = cell_moments_and_ranges(image, mesh)
    result = tetopt.mesh_image(what, nodes=150, iterations=4)
    arrays = [
        smoothing.smooth_level(inside, inside, off, factors),
        what.memberships.levels,
        cell_of_voxel(image, mesh),
        moments.mean,
        *ranges,
        local_thickness(what.memberships.partition, what.memberships, labels.spacing, 9.0),
        result.mesh.points,
        result.labels,
    ]
    return [array.tobytes() for array in arrays]


CASES = [((17, 20, 18), (1, 1, 1)), ((17, 20, 18), (1, 1, 3)), ((31, 26), (1, 1))]


@pytest.fixture(scope="module")
def whole():
    return {case: results(*case) for case in CASES}


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_number_of_slabs_changes_no_bit(whole, many_slabs, case):
    assert results(*case) == whole[case]


def test_slabs_follow_each_other_and_come_back_in_order(many_slabs):
    assert slabs.over_slabs(lambda first, stop: list(range(first, stop)), 5, 10**9) == [
        [0],
        [1],
        [2],
        [3],
        [4],
    ]
    assert slabs.over_slabs(lambda first, stop: (first, stop), 100, 10**9, 3) == [
        (0, 33),
        (33, 66),
        (66, 100),
    ]


def test_smoothing_kernels_equal_scipy():
    data, weights = noise((9, 14, 11)).astype(np.float32), np.array([0.4, 0.2, 0.07, 0.03])
    for n, part in ((3, data), (2, data[:1])):
        result = np.empty_like(part)
        smoothing._fill_correlated(result, part, weights, 0, n)
        for axis in range(3 - n, 3):
            part = correlate1d(
                part, np.concatenate([weights[:0:-1], weights]), axis, mode="nearest"
            )
        assert result.tobytes() == part.tobytes()
    bits = data > 0.02
    for reach in (1, 2, 6):
        assert np.array_equal(
            smoothing.largest_around(bits, reach), maximum_filter(bits, 2 * reach + 1)
        )


@pytest.mark.parametrize("n_counts", [1, 20, 10**6])
def test_counts_are_summed_within_a_byte_per_element(many_slabs, n_counts):
    sizes = []

    def count(first, stop):
        sizes.append(8 * n_counts)
        return np.full(n_counts, stop - first)

    total = slabs.sum_over_slabs(count, 40, 4000, n_counts)
    assert (total == 40).all()
    assert len(sizes) == 1 or sum(sizes) <= 4000
    assert n_counts > 20 or len(sizes) > 1


def test_pairs_are_counted():
    """As by numpy; negative numbers are outside, and rows without a pair stay empty."""
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(-1, 6, (9, 8, 7)), rng.integers(-1, 4, (9, 8, 7)).astype(np.int16)
    is_in = (rows >= 0) & (columns >= 0)
    expected = np.zeros((8, 4))
    np.add.at(expected, (rows[is_in], columns[is_in]), 1.0)
    counts = slabs.count_pairs(rows, columns, (8, 4))
    assert counts.toarray().tolist() == expected.tolist()
    assert counts.has_sorted_indices
    assert slabs.count_pairs(rows[:0], columns[:0], (2, 3)).nnz == 0
