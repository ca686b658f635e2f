"""An octree's leaves joined by templates: whole meshes of the box, Delaunay where blocks are
cubes.
"""

import numpy as np
import pytest
from hypothesis import given
from meshes import dimensions, random_affine, seeds
from naive import circumcentres
from scipy.spatial import cKDTree
from shapes import ball_image

import tetopt
from tetopt import Image, check_mesh, quality
from tetopt.start import leaves
from tetopt.start.leaves import FACE_RING, leaf_cells, leaf_nodes
from tetopt.start.octree import _Blocks, _divide_blocks, octree_mesh


def random_leaves(rng, n):
    """Roots along each axis, and which blocks are divided: at random, and what 2:1 makes of it."""
    roots, depth = tuple(rng.integers(1, 4, n).tolist()), int(rng.integers(0, 4))
    shapes = [tuple(root << d for root in roots) for d in range(depth + 1)]
    blocks = [_Blocks(rng.random(shape), np.zeros(shape, dtype=bool), None) for shape in shapes]
    return roots, _divide_blocks(blocks, 1.0 - float(rng.choice([0.02, 0.1, 0.3])), 1)


def joined(roots, divided, to_world=lambda places: places):
    """The leaves' mesh; `to_world` takes places in units of an undivided block."""
    nodes = leaf_nodes(divided, roots)
    points = to_world(nodes.places())
    return tetopt.Mesh(points, leaf_cells(divided, roots, nodes, points))


@given(seeds, dimensions)
def test_cells_fill_the_box(seed, n):
    """Conforming, positive, every node used, whatever the affine; the same in however many
    pieces they are made.
    """
    rng = np.random.default_rng(seed)
    roots, divided = random_leaves(rng, n)
    image = Image(np.zeros(rng.integers(3, 9, n)), random_affine(rng, n))

    def made():
        scale = np.array(image.shape) / roots
        return joined(roots, divided, lambda places: image.to_world(places * scale - 0.5))

    mesh = made()
    assert check_mesh(mesh, image) == []
    assert mesh.cell_volumes.sum() == pytest.approx(image.volume, rel=1e-12)
    assert np.unique(mesh.cells).tolist() == list(range(len(mesh.points)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(leaves, "LEAVES_AT_A_TIME", 7)
        again = made()
    assert set(map(tuple, again.cells.tolist())) == set(map(tuple, mesh.cells.tolist()))


@given(seeds, dimensions)
def test_cells_of_cubes_are_delaunay(seed, n):
    """No sphere through a cell's nodes holds another; no angle is below 30 degrees, in 2-D 45."""
    roots, divided = random_leaves(np.random.default_rng(seed), n)
    mesh = joined(roots, divided)
    centres = circumcentres(mesh.points, mesh.cells)
    radii = np.linalg.norm(mesh.points[mesh.cells[:, 0]] - centres, axis=1)
    assert (cKDTree(mesh.points).query(centres)[0] >= radii * (1.0 - 1e-9)).all()
    numbers = quality(mesh.points, mesh.cells)
    assert numbers.min_rho >= (0.4142 if n == 2 else 0.2058)
    if n == 3:
        assert numbers.min_dihedral >= 30.0 - 1e-9


@given(seeds)
def test_blocks_that_are_no_cubes(seed):
    """Half as long again along one axis as along another, and sheared by a fifth: no angle comes
    near 12 degrees.
    """
    rng = np.random.default_rng(seed)
    roots, divided = random_leaves(rng, 3)
    stretched = np.diag(rng.uniform(1.0, 1.5, 3)) + np.triu(rng.uniform(-0.2, 0.2, (3, 3)), 1)
    mesh = joined(roots, divided, lambda places: places @ stretched)
    assert quality(mesh.points, mesh.cells).min_dihedral > 17.0


@pytest.mark.parametrize(("kind", "blocks"), [("criss-cross", (5, 4)), ("bcc", (4, 3, 5))])
def test_undivided_blocks_are_a_lattice(kind, blocks):
    lattice = tetopt.lattice_mesh(Image(np.zeros(blocks)), kind, blocks=blocks)
    mesh = joined(blocks, [], lambda places: places - 0.5)
    ours, theirs = (
        {tuple(sorted(map(tuple, cell))) for cell in each.points[each.cells].tolist()}
        for each in (mesh, lattice)
    )
    assert ours == theirs


def test_a_square_between_two_leaves_is_cut_along_their_face():
    """No cell has both of their centres, where smaller leaves on two sides put nodes on opposite
    edges of the face.
    """
    divided = np.zeros((3, 1, 2), dtype=bool)
    divided[[0, 2], 0, 0] = True
    mesh = joined((3, 1, 2), [divided])
    corners = mesh.points[mesh.cells]
    has_node = [
        (corners == node).all(axis=2).any(axis=1) for node in ([1.5, 0.5, 0.5], [1.5, 0.5, 1.5])
    ]
    assert all(map(np.any, has_node))
    assert not np.logical_and(*has_node).any()


@pytest.mark.parametrize("mask", range(16))
def test_triangles_of_a_square(mask):
    """They fill it, use every node around it, and have no angle below atan(1/2)."""
    triangles = FACE_RING[np.array(list(leaves._triangles(mask)))].astype(float)
    sides = np.roll(triangles, -1, axis=1) - triangles
    back = -np.roll(sides, 1, axis=1)
    cross = sides[..., 0] * back[..., 1] - sides[..., 1] * back[..., 0]
    assert 0.5 * cross[:, 0].sum() == 4.0
    assert len(triangles) == 2 + mask.bit_count()
    assert np.arctan2(cross, (sides * back).sum(axis=2)).min() >= np.arctan(0.5) - 1e-9


@pytest.mark.parametrize("n", [2, 3])
def test_within_a_mask_one_octree_is_enough(monkeypatch, n):
    """The nodes of the leaves that a mask touches foretell those of the mesh; all its cells lie
    within.
    """
    made = []
    monkeypatch.setattr(
        "tetopt.start.octree.leaf_cells", lambda *args: made.append(args) or leaf_cells(*args)
    )
    affine = random_affine(np.random.default_rng(5), n, is_sheared=False)
    ball, mask = (ball_image((40,) * n, (18.0,) * n, radius, affine) for radius in (8.0, 16.0))
    content, nodes = tetopt.content(ball, mask=mask), 2500 if n == 3 else 400
    mesh = octree_mesh(content, nodes)
    assert len(made) == 1
    assert len(mesh.points) == pytest.approx(nodes, rel=0.1)
    assert check_mesh(mesh, is_whole=False) == []
    assert mesh.cell_volumes.sum() == pytest.approx(mask.data.sum() * ball.voxel_volume, rel=0.02)
