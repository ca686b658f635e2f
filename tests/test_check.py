"""`check_mesh` finds each fault that it says it asks about, and nothing on sound meshes."""

import numpy as np
import pytest

import tetopt

IMAGE = tetopt.Image(np.zeros((8, 9, 10)), np.diag([1.0, 2.0, 0.5, 1.0]))


@pytest.fixture
def mesh():
    return tetopt.lattice(IMAGE, blocks=(3, 3, 3))


def problems(points, cells, image=IMAGE):
    return " | ".join(tetopt.check_mesh(tetopt.Mesh(points, cells), image))


@pytest.mark.parametrize("n", [2, 3])
def test_sound(n):
    image = tetopt.Image(np.zeros((8, 9, 10)[:n]))
    assert tetopt.check_mesh(tetopt.lattice(image, nodes=60), image) == []


def test_faults(mesh):
    points, cells = mesh.points, mesh.cells
    assert problems(np.vstack([points, [[0, 0, 0]]]), cells) == f"nodes that no cell uses: 1, the first [{len(points)}]"
    split = np.where(np.arange(len(cells))[:, None] < 1, np.where(cells == cells[0, 0], len(points), cells), cells)
    assert "pairs of nodes in one place: 1" in problems(np.vstack([points, points[cells[0, 0]]]), split)
    assert "there more than once: 1, the first [0]" in problems(points, np.vstack([cells, cells[0]]))
    holed = cells[1:]
    assert "boundary facets off the faces" in problems(points, holed) or "open" in problems(points, holed)
    inner = np.flatnonzero((np.abs(IMAGE.to_index(points) - 3.5) < 2.0).all(axis=1))[0]
    assert "box" in problems(points * 1.1, cells)
    far = np.vstack([points, points[cells[0]] + 100.0])
    assert "pieces that share no facet: 2" in problems(far, np.vstack([cells, len(points) + np.arange(4)]))
    # A cell put on top of another one across a facet.
    apex = np.vstack([points, points[cells[0]].mean(axis=0)])
    on_top = np.vstack([cells, [cells[0, 0], cells[0, 1], cells[0, 2], len(points)]])
    assert "more than two cells" in problems(apex, on_top)
    assert inner >= 0
