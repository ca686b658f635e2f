"""`check_mesh` finds each fault that it says it asks about, and nothing on sound meshes."""

import numpy as np
import pytest

import tetopt
from tetopt.geometry.check import check_unfolded
from tetopt.measure.fidelity import cell_labels
from tetopt.start.carve import part_of

IMAGE = tetopt.Image(np.zeros((8, 9, 10)), np.diag([1.0, 2.0, 0.5, 1.0]))


@pytest.fixture
def mesh():
    return tetopt.lattice_mesh(IMAGE, blocks=(3, 3, 3))


def problems(points, cells, image=IMAGE):
    return " | ".join(tetopt.check_mesh(tetopt.Mesh(points, cells), image))


@pytest.mark.parametrize("n", [2, 3])
def test_sound(n):
    image = tetopt.Image(np.zeros((8, 9, 10)[:n]))
    assert tetopt.check_mesh(tetopt.lattice_mesh(image, nodes=60), image) == []


def test_faults(mesh):
    points, cells = mesh.points, mesh.cells
    assert (
        problems(np.vstack([points, [[0, 0, 0]]]), cells)
        == f"unused nodes: 1, the first [{len(points)}]"
    )
    split = np.where(
        np.arange(len(cells))[:, None] < 1,
        np.where(cells == cells[0, 0], len(points), cells),
        cells,
    )
    assert "pairs of nodes at the same position: 1" in problems(
        np.vstack([points, points[cells[0, 0]]]), split
    )
    assert "duplicate cells: 1, the first [0]" in problems(points, np.vstack([cells, cells[0]]))
    holed = cells[1:]
    assert "boundary facets off the faces" in problems(points, holed) or "open" in problems(
        points, holed
    )
    assert "box" in problems(points * 1.1, cells)
    far = np.vstack([points, points[cells[0]] + 100.0])
    assert "components that share no facet: 2" in problems(
        far, np.vstack([cells, len(points) + np.arange(4)])
    )
    # A cell put on top of another one across a facet.
    apex = np.vstack([points, points[cells[0]].mean(axis=0)])
    on_top = np.vstack([cells, [cells[0, 0], cells[0, 1], cells[0, 2], len(points)]])
    assert "more than two cells" in problems(apex, on_top)


def test_beyond_the_box(mesh):
    """A mesh that need not fill the box still lies in it."""
    part = tetopt.Mesh(mesh.points, mesh.cells)
    shrunk = tetopt.Mesh(part.points * 0.9 + 0.1, part.cells)
    assert tetopt.check_mesh(shrunk, IMAGE, is_filled=False) == []
    index = IMAGE.to_index(part.points)
    corner = int(np.flatnonzero((index == -0.5).all(axis=1))[0])
    index[corner] -= (0.0, 0.25, 0.125)
    out = tetopt.Mesh(IMAGE.to_world(index), part.cells)
    words = f"nodes up to 0.25 voxels beyond the image's box: 1, the first [{corner}]"
    assert tetopt.check_mesh(out, IMAGE, is_filled=False) == [words]
    assert words in tetopt.check_mesh(out, IMAGE)
    assert tetopt.check_mesh(out) == []


def cubes(labels):
    """A block of cells for each voxel, and which of them have label 1."""
    image = tetopt.Image(labels)
    mesh = tetopt.lattice_mesh(
        image, "criss-cross" if image.ndim == 2 else "five-tet", blocks=image.shape
    )
    return mesh, cell_labels(image, mesh)


@pytest.mark.parametrize(
    ("corner", "words"),
    [
        ((1, 1, 0), "edges where {} has more than two facets{}; nodes: 1, the first [[{}, {}]]"),
        ((1, 1, 1), "nodes where {} touches itself{}; nodes: 1, the first [[{}]]"),
        ((1, 1), "nodes where {} has more than two facets{}; nodes: 1, the first [[{}]]"),
        ((1, 0, 0), None),
    ],
)
def test_two_cubes_that_touch(corner, words):
    """As a mesh of their own its boundary is no manifold; within a mesh the interface is not."""
    labels = np.zeros((4,) * len(corner))
    first = (1,) * len(corner)
    labels[first] = labels[tuple(np.add(first, corner))] = 1
    mesh, of_cell = cubes(labels)
    assert tetopt.check_mesh(mesh) == []
    used, alone = np.unique(mesh.cells[of_cell == 1]), part_of(mesh, of_cell == 1)
    here = np.flatnonzero(
        (alone.points[:, :2] == 1.5).all(axis=1) & (len(corner) < 3 or corner[-1] == 0)
    )
    here = np.flatnonzero((alone.points == 1.5).all(axis=1)) if corner == (1, 1, 1) else here
    problems = [] if words is None else [words.format("the boundary", "", *here)]
    assert tetopt.check_mesh(alone, is_whole=False) == problems
    assert tetopt.check_mesh(alone, is_whole=False, is_manifold=False) == []
    check_unfolded(alone)  # what an optimisation asks for
    assert (
        tetopt.check_mesh(
            alone, is_whole=False, is_manifold=False, of_cell=np.ones(len(alone.cells))
        )
        == []
    )
    inner = (
        []
        if words is None
        else [words.format("the interface of two labels", " (0 and 1 at 1)", *used[here])]
    )
    assert tetopt.check_mesh(mesh, of_cell=of_cell) == inner
    with pytest.raises(tetopt.InputError, match="whole number >= 0 for each of the mesh's"):
        tetopt.check_mesh(mesh, of_cell=of_cell[1:])
    with pytest.raises(tetopt.InputError, match="whole number >= 0 for each of the mesh's"):
        tetopt.check_mesh(mesh, of_cell=of_cell - 0.5)


def test_where_three_labels_meet_interfaces_end():
    labels = np.zeros((4, 4, 4))
    labels[1, 1, 1] = labels[2, 2, 1] = 1
    labels[1, 2, 1] = 2
    mesh, of_cell = cubes(labels)
    assert tetopt.check_mesh(mesh, of_cell=of_cell) == []
    labels[1, 2, 1] = 0
    labels[0, 0, 0] = labels[1, 1, 0] = 3
    mesh, of_cell = cubes(labels)
    (line,) = tetopt.check_mesh(mesh, of_cell=of_cell)
    assert line.startswith(
        "edges where the interface of two labels has more than two facets (0 and 1 at 1, 0 and 3 "
        "at 1)"
    )
