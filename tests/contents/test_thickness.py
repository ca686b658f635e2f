"""The local thickness of labels: slabs, shells and balls of known size, in voxels of several
shapes.
"""

import numba
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from shapes import distance

from tetopt.contents import thickness as thickness_module
from tetopt.contents.memberships import finer, memberships, supersampling
from tetopt.contents.thickness import _chords, _cosine, _Labels, local_thickness, rows_within
from tetopt.image import Image

MOST = 12.0


def thickness_of(data, spacing=(1.0, 1.0, 1.0), inside=None):
    image = Image(data.astype(float), np.diag([*spacing[: data.ndim], 1.0]))
    members = memberships(image)
    return local_thickness(rows_within(members.partition, inside), members, image.spacing, MOST)


@pytest.mark.parametrize("size", [1.5, 2.0, 3.0, 5.0])
def test_a_shell_is_as_thick_as_it_is(size):
    r = distance((44,) * 3, *[21.37] * 3)
    shell = (r >= 14.0) & (r < 14.0 + size)
    thickness = thickness_of(np.where(shell, 2, r < 14.0))
    assert np.median(thickness[shell]) == pytest.approx(size, rel=0.04)
    assert np.percentile(thickness[shell], 95) < 1.1 * size
    assert np.median(thickness[r < 14.0]) == MOST  # what lies within is thicker than is looked at


@pytest.mark.parametrize(
    ("shape", "normal", "start", "spacing", "expected"),
    [
        ((30, 20, 12), (0, 1, 0), 8, (1.0, 2.0, 1.0), pytest.approx(8.0, abs=0.1)),
        ((30, 20, 12), (1, 1, 0), 20, (1.0, 1.0, 1.0), pytest.approx(8.0**0.5, rel=0.06)),
        ((30, 30), (0, 1), 10, (1.0, 1.0), pytest.approx(4.0, abs=0.05)),
    ],
)
def test_a_slab_of_four_voxels(shape, normal, start, spacing, expected):
    """Of long voxels, with a sloping side, and in the plane."""
    along = np.tensordot(normal, np.indices(shape), 1)
    is_in = (along >= start) & (along < start + 4)
    assert np.median(thickness_of(is_in, spacing)[is_in]) == expected


def test_near_the_surface_of_a_ball_it_is_as_thick_as_in_the_middle():
    r = distance((24,) * 3, *[11.37] * 3)
    thickness = thickness_of(r < 4.0)
    assert np.percentile(thickness[(r > 2.5) & (r < 3.5)], 10) > 7.0
    assert thickness[r < 4.0].max() == pytest.approx(8.0, rel=0.06)


@pytest.mark.parametrize(
    ("step", "expected"),
    [((0, -1, 0), 1.0), ((0, 0, 1), 1.0), ((1, 0, 0), 1.0), ((1, 1, 0), 0.8**0.5)],
)
def test_a_way_that_leaves_the_grid_or_the_region_has_no_angle(step, expected):
    """Sums of two ways may be rounded to below one that leaves the grid: nothing is read there."""
    partition = np.zeros((4, 5, 6), dtype=np.int16)
    partition[:, :, 5], partition[3] = -1, 1
    levels, edges = np.indices((4, 5, 6))[:1].astype(np.float32), np.array([2.0, 1.0, 1.0])
    labels = _Labels(
        partition, levels, np.zeros(2, dtype=np.int64), np.zeros((0, 1, 1, 1), dtype=np.uint16)
    )
    found = _cosine(labels, (1, 2, 3), (0, np.array(step)), np.linalg.norm(step * edges), edges)
    assert found == pytest.approx(expected)


@pytest.mark.parametrize(
    ("shape", "spacing"), [((14, 12, 13), (1.0, 1.0, 1.0)), ((10, 9, 12), (1.0, 1.2, 2.0))]
)
def test_chords_at_the_sides_of_the_grid_are_the_shortest_that_end_inside(shape, spacing):
    """A way that leaves the grid ends no chord: with its bound in place of it, rounding once
    made it the shortest.
    """
    field = gaussian_filter(np.random.default_rng(1).normal(size=(3, *shape)), (0.0, 1.5, 1.5, 1.5))
    members = memberships(Image(field.argmax(axis=0).astype(float), np.diag([*spacing, 1.0])))
    rays = thickness_module._rays(np.array(spacing), 8.0)
    steps, lengths = rays[0], rays[1][:, 1]
    partition, nothing = members.partition.astype(np.int16), np.empty((0,) * 4, np.uint16)
    labels = _Labels(partition, members.levels, members.channel, nothing)
    chords, best, is_middle = _chords(labels, rays, 8.0, 0, (0, shape[0]))
    assert 0 < is_middle.sum() < (best >= 0).sum() < best.size
    for place in np.ndindex(shape):
        ways = [
            sum(_walk(members, place, sign * step, length) for sign in (1, -1))
            for step, length in zip(steps, lengths, strict=True)
        ]
        d = int(np.argmin(ways))
        size = ways[d]
        assert best[place] == (d if size < 8.0 else -1)
        assert chords[place] == pytest.approx(min(size, 8.0), abs=1e-5)


@pytest.mark.parametrize(
    ("shape", "spacing"),
    [((40, 31, 26), (1.0, 1.0, 1.0)), ((18, 19, 22), (1.0, 1.2, 1.9)), ((90, 41), (0.8, 1.1))],
)
def test_it_is_the_same_in_slabs_and_in_a_wider_grid(shape, spacing, monkeypatch):
    """To the last bit, on any number of threads; far from other labels it is the limit."""
    rng, n = np.random.default_rng(3), len(shape)
    field = gaussian_filter(rng.normal(size=(4, *shape)), (0.0, *[3.0] * n))
    labels = np.pad(field[(slice(None), *[slice(3, -3)] * n)].argmax(axis=0), 3)
    inside, spacing = rng.random(shape) < 0.999, np.array(spacing)
    members = memberships(Image(labels.astype(float)))
    rows = rows_within(members.partition, inside)
    whole = local_thickness(rows, members, spacing, 6.0)
    assert len(np.unique(whole)) > 100
    monkeypatch.setattr(thickness_module, "SLAB_PLANES", 2)
    for n_threads in (1, 3):
        monkeypatch.setattr(numba, "get_num_threads", lambda n_threads=n_threads: n_threads)
        np.testing.assert_array_equal(local_thickness(rows, members, spacing, 6.0), whole)
    wider = members._replace(
        levels=np.pad(members.levels, [(0, 0), *[(9, 9)] * n], mode="edge"),
        partition=np.pad(members.partition, 9),
    )
    wide_rows = np.pad(rows, 9)
    wide_rows[(0,) * n] = 1  # far away, so that no part of the grid is left out
    around = local_thickness(wide_rows, wider, spacing, 6.0)
    own = (slice(9, -9),) * n
    np.testing.assert_array_equal(around[own][whole < 5.9], whole[whole < 5.9])
    around[own] = 6.0
    assert (around == 6.0).mean() > 0.95


def _walk(members, place, step, length):
    """Distance to the surface along steps: infinite if the grid ends."""
    here, way = np.array(place), 0.0
    while (here + step >= 0).all() and (here + step < members.partition.shape).all():
        own, other = members.partition[tuple(here)], members.partition[tuple(here + step)]
        if own != other:
            one, two = (members.levels[members.channel[row]] for row in (own, other))
            near = two[tuple(here)] - one[tuple(here)]
            far = one[tuple(here + step)] - two[tuple(here + step)]
            return way + length * near / max(near + far, 1e-6)
        here, way = here + step, way + length
    return np.inf


def test_a_region_ends_labels():
    data, inside = np.ones((20, 16, 16)), np.zeros((20, 16, 16), dtype=bool)
    data[:10] = 2
    inside[7:17] = True
    thickness = thickness_of(data, inside=inside)
    assert np.unique(thickness[8]).tolist() == pytest.approx([3.0], abs=0.1)
    assert np.median(thickness[12]) == pytest.approx(7.0, abs=0.1)
    assert (thickness[~inside] == 0.0).all()


def test_divided_slices():
    is_slab = np.indices((24, 24, 6))[0] // 6 == 1
    thick_slices = Image(is_slab.astype(float), np.diag([1.0, 1.0, 5.0, 1.0]))
    factors = supersampling(thick_slices.spacing)
    fine = finer(thick_slices, factors)
    members = memberships(thick_slices, factors)
    thickness = local_thickness(members.partition, members, fine.spacing, MOST)
    assert np.median(thickness[fine.data == 1.0]) == pytest.approx(6.0, abs=0.1)
