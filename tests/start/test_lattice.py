"""Lattices: the paper's counts, and what holds for every box and every affine."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import random_affine, seeds
from numpy.testing import assert_array_equal

from tetopt import Image, InputError, lattice_mesh
from tetopt.geometry.box import box_sides, is_on_sides
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import facets

KINDS = [(2, "criss-cross"), (3, "bcc"), (3, "five-tet")]
kinds = st.sampled_from(KINDS)


def random_lattice(seed, n, kind):
    rng = np.random.default_rng(seed)
    shape = tuple(int(s) for s in rng.integers(1, 12, n))
    image = Image(np.zeros(shape), random_affine(rng, n))
    blocks = tuple(int(b) for b in rng.integers(1, 5, n))
    return image, blocks, lattice_mesh(image, kind, blocks=blocks)


# The paper's meshes


@pytest.mark.parametrize(
    ("shape", "kind", "nodes", "counts"),
    [
        ((70, 70), "criss-cross", 113, (113, 196)),
        ((80, 70), "criss-cross", 128, (128, 224)),
        ((130, 100, 60), "five-tet", 1078, (1078, 3900)),
    ],
)
def test_the_paper_s_node_counts_find_its_meshes(shape, kind, nodes, counts):
    """Fig. 2(a) and 3(c): 113 nodes, 196 triangles; Fig. 3(a): 128, 224; Fig. 3(e): 1078, 3900."""
    mesh = lattice_mesh(Image(np.zeros(shape, dtype=np.uint8)), kind, nodes=nodes)
    assert (len(mesh.points), len(mesh.cells)) == counts


# Smallest lattices


def test_one_square():
    mesh = lattice_mesh(Image(np.zeros((3, 5))), blocks=(1, 1))
    assert mesh.points.tolist() == [[-0.5, -0.5], [-0.5, 4.5], [2.5, -0.5], [2.5, 4.5], [1, 2]]
    assert sorted(map(sorted, mesh.cells.tolist())) == [[0, 1, 4], [0, 2, 4], [1, 3, 4], [2, 3, 4]]
    assert volumes(mesh.points, mesh.cells) == pytest.approx([15 / 4] * 4)


# For every box


@given(seeds, kinds)
def test_every_lattice_is_a_mesh_of_its_box(seed, dimension_and_kind):
    """Volume, conformity, boundary on the box, no unused node, no flat cell."""
    n, kind = dimension_and_kind
    image, blocks, mesh = random_lattice(seed, n, kind)
    v = volumes(mesh.points, mesh.cells)
    assert v.sum() == pytest.approx(image.volume, rel=1e-12)
    per_block, n_blocks = {"criss-cross": 4, "five-tet": 5, "bcc": 12}[kind], np.prod(blocks)
    assert v.min() > 0.3 * image.volume / n_blocks / per_block
    n_centres = 0 if kind == "five-tet" else n_blocks
    assert len(mesh.points) == np.prod(np.array(blocks) + 1) + n_centres
    if kind != "bcc":
        assert len(mesh.cells) == per_block * n_blocks
    assert np.unique(mesh.cells).tolist() == list(range(len(mesh.points)))
    assert len(np.unique(np.sort(mesh.cells, axis=1), axis=0)) == len(mesh.cells)
    sides = facets(mesh.cells)
    assert sides.n_cells.max() <= 2
    index = image.to_index(mesh.points)
    is_on_box = is_on_sides(index, box_sides(image.shape), 1e-9)[sides.nodes[sides.n_cells == 1]]
    assert is_on_box.all(axis=1).any(axis=(1, 2)).all()
    assert index.min(axis=0) == pytest.approx([-0.5] * n, abs=1e-9)
    assert index.max(axis=0) == pytest.approx(np.array(image.shape) - 0.5, abs=1e-9)


# Shapes on cubes


# Sizes


@given(seeds, st.integers(1000, 6000), st.sampled_from(["bcc", "five-tet"]))
def test_node_counts_on_boxes_like_brains(seed, nodes, kind):
    """Voxels of unequal edges; counts within 6 %, and blocks stay near cubes."""
    rng = np.random.default_rng(seed)
    lengths = np.array([180.0, 218, 182]) * rng.uniform(0.85, 1.15, 3)
    shape = rng.integers(20, 40, 3)
    image = Image(np.zeros(shape, dtype=np.uint8), np.diag([*(lengths / shape), 1.0]))
    mesh = lattice_mesh(image, kind, nodes=nodes)
    assert abs(len(mesh.points) - nodes) <= 0.06 * nodes
    number = len(mesh.points) if kind == "five-tet" else -(-len(mesh.points) // 2)
    corners = mesh.points[: number + 1]  # all are corners, the last ones may be left out
    edges = [np.diff(np.unique(np.round(corners[:, d], 6))).max() for d in range(3)]
    assert max(edges) / min(edges) < 1.4


@given(seeds, kinds)
def test_the_count_asked_for_is_found_where_cubes_have_it(seed, dimension_and_kind):
    """A box of b blocks that are exact cubes is cut into them when asked for their number of
    nodes.
    """
    n, kind = dimension_and_kind
    blocks = tuple(int(b) for b in np.random.default_rng(seed).integers(3, 12, n))
    image = Image(np.zeros(tuple(2 * b for b in blocks), dtype=np.uint8))
    exact = lattice_mesh(image, kind, blocks=blocks).points
    assert_array_equal(lattice_mesh(image, kind, nodes=len(exact)).points, exact)


@pytest.mark.parametrize(("n", "kind"), KINDS)
def test_fewest_nodes(n, kind):
    image = Image(np.zeros((5,) * n))
    fewest = {"criss-cross": 5, "bcc": 9, "five-tet": 8}[kind]
    assert len(lattice_mesh(image, kind, nodes=fewest).points) == fewest
    with pytest.raises(InputError, match=f"expected {fewest} to 50000000 nodes"):
        lattice_mesh(image, kind, nodes=fewest - 1)


@pytest.mark.parametrize(
    ("spacing", "blocks"),
    [
        (5.0, (4, 2, 6)),
        (4.0, (5, 2, 8)),
        (7.0, (3, 1, 4)),
        (100.0, (1, 1, 1)),
        (9.9, (2, 1, 3)),
    ],
)
def test_spacing_is_in_mm_and_the_nearest_that_divides_the_box(spacing, blocks):
    image = Image(np.zeros((10, 20, 6)), np.diag([-2.0, 0.5, 5.0, 1.0]))  # 20 x 10 x 30 mm
    mesh, expected = (
        lattice_mesh(image, "five-tet", **size)
        for size in ({"spacing": spacing}, {"blocks": blocks})
    )
    assert_array_equal(mesh.points, expected.points)


@pytest.mark.parametrize(("n", "kind"), [(2, "criss-cross"), (3, "bcc")])
def test_default_kinds(n, kind):
    image, blocks = Image(np.zeros((4,) * n)), (2,) * n
    own, stated = (lattice_mesh(image, each, blocks=blocks) for each in (None, kind))
    assert_array_equal(own.cells, stated.cells)


# Messages


@pytest.mark.parametrize(
    ("n", "kind", "size", "message"),
    [
        (2, "bcc", {"nodes": 50}, "criss-cross in 2-D, got 'bcc'"),
        (3, "criss-cross", {"nodes": 50}, "bcc, five-tet in 3-D, got 'criss-cross'"),
        (3, None, {}, "exactly one of nodes, spacing and blocks"),
        (3, None, {"nodes": 50, "spacing": 1.0}, "exactly one"),
        (3, None, {"nodes": 0}, "9 to 50000000 nodes"),
        (3, None, {"nodes": 10**9}, "9 to 50000000 nodes"),
        (3, None, {"spacing": 0.0}, "a spacing above 0 mm"),
        (3, None, {"spacing": np.nan}, "a spacing above 0 mm"),
        (3, None, {"spacing": 1e-3}, "more than 50000000; use fewer"),
        (3, None, {"blocks": (2, 2)}, "3 whole numbers >= 1 for blocks"),
        (3, None, {"blocks": (2, 2, 0)}, "3 whole numbers >= 1 for blocks"),
        (3, None, {"blocks": (2, 2, 1.5)}, "3 whole numbers >= 1 for blocks"),
        (3, None, {"blocks": (1000, 1000, 1000)}, "more than 50000000"),
        (3, None, {"blocks": 7}, "lattice.*blocks"),
        (3, None, {"spacing": 1e-320}, "lattice.*spacing"),
    ],
)
def test_sizes_and_kinds_that_no_lattice_has_are_refused(n, kind, size, message):
    with pytest.raises(InputError, match=message):
        lattice_mesh(Image(np.zeros((4,) * n)), kind, **size)
