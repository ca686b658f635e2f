"""`check_mesh` finds each fault that it says it asks about, and nothing on sound meshes."""

import re

import numpy as np
import pytest
from models import sample_image
from refusals import refusal

import tetopt
from tetopt import Image, Mesh, check_mesh, lattice_mesh
from tetopt.contents.content import content
from tetopt.geometry.check import check_unfolded
from tetopt.measure.fidelity import cell_labels
from tetopt.start.carve import part_of

IMAGE = Image(np.zeros((8, 9, 10)), np.diag([1.0, 2.0, 0.5, 1.0]))


MESH = lattice_mesh(IMAGE, blocks=(3, 3, 3))


FIRST = MESH.cells[0]


def put_in(points=(), cells=(), rest=MESH.cells):
    """A mesh with more nodes and cells; -1 stands for the last of the nodes."""
    points = np.vstack([MESH.points, np.reshape(points, (-1, 3))])
    cells = np.vstack([rest, np.reshape(cells, (-1, 4)).astype(int)])
    return Mesh(points, cells % len(points))


@pytest.mark.parametrize("n", [2, 3])
def test_sound(n):
    image = Image(np.zeros((8, 9, 10)[:n]))
    assert check_mesh(lattice_mesh(image, nodes=60), image) == []


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        (put_in([[0, 0, 0]]), rf"^unused nodes: 1, the first \[{len(MESH.points)}\]$"),
        (
            put_in(MESH.points[FIRST[:1]], [[-1, *FIRST[1:]]], MESH.cells[1:]),
            "pairs of nodes at the same position: 1",
        ),
        (put_in(cells=[FIRST]), r"duplicate cells: 1, the first \[0\]"),
        (put_in(rest=MESH.cells[1:]), "boundary facets off the faces|open"),
        (Mesh(MESH.points * 1.1, MESH.cells), "box"),
        (
            put_in(MESH.points[FIRST] + 100.0, [[-4, -3, -2, -1]]),
            "components that share no facet: 2",
        ),
        # a cell put on top of another one across a facet
        (put_in(MESH.points[FIRST].mean(axis=0), [[*FIRST[:3], -1]]), "more than two cells"),
    ],
)
def test_faults(mesh, words):
    assert re.search(words, " | ".join(check_mesh(mesh, IMAGE)))


def test_beyond_the_box():
    """A mesh that need not fill the box still lies in it."""
    shrunk = Mesh(MESH.points * 0.9 + 0.1, MESH.cells)
    assert check_mesh(shrunk, IMAGE, is_filled=False) == []
    index = IMAGE.to_index(MESH.points)
    corner = int(np.flatnonzero((index == -0.5).all(axis=1))[0])
    index[corner] -= (0.0, 0.25, 0.125)
    out = Mesh(IMAGE.to_world(index), MESH.cells)
    words = f"nodes up to 0.25 voxels beyond the image's box: 1, the first [{corner}]"
    assert check_mesh(out, IMAGE, is_filled=False) == [words]
    assert words in check_mesh(out, IMAGE)
    assert check_mesh(out) == []


@pytest.mark.parametrize(
    "use",
    [
        lambda image, mesh: tetopt.mesh_image(image, start=mesh, iterations=0),
        lambda image, mesh: tetopt.optimize(image, mesh, iterations=1),
        lambda image, mesh: tetopt.build_model(mesh, image, young="h+1"),
        lambda image, mesh: tetopt.build_model(mesh, content(image), young=3.0),
        lambda image, mesh: tetopt.cell_fields(mesh, image),
        lambda image, mesh: tetopt.cell_labels(Image(1.0 * (image.data > 0), image.affine), mesh),
        lambda image, mesh: tetopt.field_on_image(mesh, mesh.points, image),
    ],
)
def test_a_mesh_elsewhere_is_no_mesh_of_an_image(use, n):
    image = sample_image(n)
    mesh = tetopt.lattice_mesh(image, nodes=40)
    with refusal("same world coordinates"):
        use(image, Mesh(mesh.points + 1e3, mesh.cells))
    with refusal(f"{n}-D"):
        use(sample_image(5 - n), mesh)


def test_a_mesh_partly_elsewhere_violates_the_box_and_is_warned_of():
    """Where `check_mesh` says no, a run that begins with the mesh does, too."""
    image = sample_image()
    mesh = tetopt.lattice_mesh(image, nodes=40)
    half = Mesh(mesh.points + 0.5 * np.ptp(mesh.points, axis=0) * [1, 0, 0], mesh.cells)
    words = r"\d% of the nodes lie outside"
    with pytest.warns(UserWarning, match=words):
        result = tetopt.mesh_image(image, start=half, iterations=1, k_D=0.1)
    assert list(result.violated) == ["box"]
    assert any("beyond" in line for line in check_mesh(result.mesh, image, is_filled=False))
    with pytest.warns(UserWarning, match=words):
        tetopt.build_model(half, image, young=2.0)


def cubes(labels):
    """A block of cells for each voxel, and which of them have label 1."""
    image = Image(labels)
    mesh = lattice_mesh(image, "criss-cross" if image.ndim == 2 else "five-tet", blocks=image.shape)
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
    labels, first = np.zeros((4,) * len(corner)), (1,) * len(corner)
    labels[first] = labels[tuple(np.add(first, corner))] = 1
    mesh, of_cell = cubes(labels)
    used, alone = np.unique(mesh.cells[of_cell == 1]), part_of(mesh, of_cell == 1)
    shared = alone.points if corner == (1, 1, 1) else alone.points[:, :2]
    here = np.flatnonzero((shared == 1.5).all(axis=1))
    outer, inner = [], []
    if words is not None:
        outer = [words.format("the boundary", "", *here)]
        inner = [words.format("the interface of two labels", " (0 and 1 at 1)", *used[here])]
    assert check_mesh(mesh) == []
    assert check_mesh(alone, is_whole=False) == outer
    for of_one in (None, np.ones(len(alone.cells))):
        assert not check_mesh(alone, is_whole=False, is_manifold=False, of_cell=of_one)
    check_unfolded(alone)  # what an optimisation asks for
    assert check_mesh(mesh, of_cell=of_cell) == inner
    for wrong in (of_cell[1:], of_cell - 0.5):
        with pytest.raises(tetopt.InputError, match="whole number >= 0 for each"):
            check_mesh(mesh, of_cell=wrong)


def test_where_three_labels_meet_interfaces_end():
    labels = np.zeros((4, 4, 4))
    labels[1, 1, 1] = labels[2, 2, 1] = 1
    labels[1, 2, 1] = 2
    mesh, of_cell = cubes(labels)
    assert check_mesh(mesh, of_cell=of_cell) == []
    labels[1, 2, 1] = 0
    labels[0, 0, 0] = labels[1, 1, 0] = 3
    mesh, of_cell = cubes(labels)
    (line,) = check_mesh(mesh, of_cell=of_cell)
    assert "more than two facets (0 and 1 at 1, 0 and 3 at 1)" in line
