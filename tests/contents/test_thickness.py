"""The local thickness of labels: slabs, shells and balls of known size, in voxels of several
shapes.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tetopt.contents import thickness as thickness_module
from tetopt.contents.memberships import finer, memberships, supersampling
from tetopt.contents.thickness import _cosine, _Labels, local_thickness
from tetopt.image import Image

MOST = 12.0


def thickness_of(data, spacing=(1.0, 1.0, 1.0), inside=None):
    image = Image(data.astype(float), np.diag([*spacing[: data.ndim], 1.0]))
    return local_thickness(memberships(image), image.spacing, MOST, inside)


def radius(n, centre=0.13):
    return np.linalg.norm(np.indices((n, n, n)) - 0.5 * (n - 1) + centre, axis=0)


@pytest.mark.parametrize("size", [1.5, 2.0, 3.0, 5.0])
def test_a_shell_is_as_thick_as_it_is(size):
    r = radius(44)
    shell = (r >= 14.0) & (r < 14.0 + size)
    thickness = thickness_of(np.where(shell, 2, r < 14.0))
    assert np.median(thickness[shell]) == pytest.approx(size, rel=0.04)
    assert np.percentile(thickness[shell], 95) < 1.1 * size
    assert np.median(thickness[r < 14.0]) == MOST  # what lies within is thicker than is looked at


def test_a_slab_of_a_sloping_side_and_long_voxels():
    x, y, _ = np.indices((30, 20, 12))
    is_in = (y >= 8) & (y < 11)
    assert np.median(thickness_of(is_in, (1.0, 2.0, 1.0))[is_in]) == pytest.approx(6.0, abs=0.1)
    is_in = (x + y >= 20) & (x + y < 24)  # 4 / sqrt 2 thick
    assert np.median(thickness_of(is_in)[is_in]) == pytest.approx(8.0**0.5, rel=0.06)


def test_near_the_surface_of_a_ball_it_is_as_thick_as_in_the_middle():
    r = radius(24)
    thickness = thickness_of(r < 4.0)
    near = (r > 2.5) & (r < 3.5)
    assert np.percentile(thickness[near], 10) > 7.0
    assert thickness[r < 4.0].max() == pytest.approx(8.0, rel=0.06)


def test_a_way_that_leaves_the_grid_or_the_region_has_no_angle():
    """Sums of two ways may be rounded to below one that leaves the grid: nothing is read there."""
    partition, levels = (
        np.zeros((4, 5, 6), dtype=np.int16),
        np.indices((4, 5, 6))[:1].astype(np.float32),
    )
    partition[:, :, 5], partition[3] = -1, 1
    labels = _Labels(
        partition, levels, np.zeros(2, dtype=np.int64), np.zeros((0, 1, 1, 1), dtype=np.uint16)
    )
    for step, expected in (
        ((0, -1, 0), 1.0),
        ((0, 0, 1), 1.0),
        ((1, 0, 0), 1.0),
        ((1, 1, 0), 0.8**0.5),
    ):
        edges = np.array([2.0, 1.0, 1.0])
        found = _cosine(labels, (1, 2, 3), (0, np.array(step)), np.linalg.norm(step * edges), edges)
        assert found == pytest.approx(expected)


@pytest.mark.parametrize(
    ("shape", "spacing"), [((14, 12, 13), (1.0, 1.0, 1.0)), ((10, 9, 12), (1.0, 1.2, 2.0))]
)
def test_chords_at_the_sides_of_the_grid_are_the_shortest_that_end_inside(
    shape, spacing, monkeypatch
):
    """A way that leaves the grid ends no chord: with its bound in place of it, rounding once
    made it the shortest.
    """
    field = gaussian_filter(np.random.default_rng(1).normal(size=(3, *shape)), (0.0, 1.5, 1.5, 1.5))
    members = memberships(Image(field.argmax(axis=0).astype(float), np.diag([*spacing, 1.0])))
    (steps, lengths), edges = thickness_module._rays(np.array(spacing))
    labels = _Labels(
        members.partition.astype(np.int16),
        members.levels,
        members.channel,
        np.empty((0,) * 4, np.uint16),
    )
    monkeypatch.setattr(thickness_module, "_spread_balls", lambda *_: None)
    chords = local_thickness(members, np.array(spacing), 8.0)
    for place in np.ndindex(shape):
        ways = [
            [_walk(members, place, sign * step, length) for sign in (1, -1)]
            for step, length in zip(steps, lengths, strict=True)
        ]
        d = int(np.argmin(np.sum(ways, axis=1)))
        size = sum(ways[d])
        if size < 8.0:
            up, down = (tuple((sign * steps[d]).tolist()) for sign in (1, -1))
            forth = _cosine(labels, place, (d, up), lengths[d], edges)
            size *= 0.5 * (forth + _cosine(labels, place, (-1 - d, down), lengths[d], edges))
        assert chords[place] == pytest.approx(min(size, 8.0), abs=1e-5)


def _walk(members, place, step, length):
    """The plain twin of `_way`: infinite if the grid ends."""
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


def test_triangles_and_divided_slices():
    y = np.indices((30, 30))[1]
    is_in = (y >= 10) & (y < 14)
    assert np.median(thickness_of(is_in)[is_in]) == pytest.approx(4.0, abs=0.05)
    thick_slices = Image(
        (np.indices((24, 24, 6))[0] // 6 == 1).astype(float), np.diag([1.0, 1.0, 5.0, 1.0])
    )
    factors = supersampling(thick_slices.spacing)
    fine = finer(thick_slices, factors)
    thickness = local_thickness(memberships(thick_slices, factors), fine.spacing, MOST)
    assert np.median(thickness[fine.data == 1.0]) == pytest.approx(6.0, abs=0.1)
