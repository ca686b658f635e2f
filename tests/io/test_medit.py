"""medit files: read by a parser after INRIA's description, by meshio and by gmsh; points bit by
bit.
"""

import importlib.util
import json
import re
import subprocess
import sys

import meshio
import numpy as np
import pytest
from models import each_once, labelled_model, quadratic_model, sample_model

from tetopt.errors import InputError
from tetopt.geometry.quadratic import quadratic
from tetopt.geometry.simplex import volumes
from tetopt.io.medit import medit
from tetopt.model.model import elements as model_elements
from tetopt.model.sets import Sets, facet_triples

MODELS = [(3, 3), (3, None), (2, 3), (2, None)]
WIDTH = {
    "Edges": 2,
    "Triangles": 3,
    "Tetrahedra": 4,
    "EdgesP2": 3,
    "TrianglesP2": 6,
    "TetrahedraP2": 10,
}
KEYWORD = {1: "Edges", 2: "Triangles", 3: "Tetrahedra"}


class Read:
    """What a file holds: words parted by any space; # begins a comment; entities end with a
    reference.
    """

    def __init__(self, raw):
        lines = raw.decode().split("\n")
        self.comments = [line.removeprefix("# ") for line in lines if line.startswith("#")]
        words = " ".join(line for line in lines if not line.startswith("#")).split()
        assert words[:3] == ["MeshVersionFormatted", "2", "Dimension"]  # 2: double precision
        self.n = int(words[3])
        self.points, self.nodes, self.refs = None, {}, {}
        at = 4
        while words[at] != "End":
            keyword, count = words[at], int(words[at + 1])
            width = (self.n if keyword == "Vertices" else WIDTH[keyword]) + 1
            table = np.array(words[at + 2 : at + 2 + count * width]).reshape(count, width)
            if keyword == "Vertices":
                self.points = table[:, :-1].astype(float)
            else:
                self.nodes[keyword] = table[:, :-1].astype(int) - 1
            self.refs[keyword] = table[:, -1].astype(int)
            at += 2 + count * width
        assert words[at:] == ["End"]

    def refs_of(self, keyword, name):
        """The references that the comments give a name."""
        lines = [re.fullmatch(rf"{keyword} ref (\d+): (.*)", line) for line in self.comments]
        return [int(line[1]) for line in lines if line and name in line[2].split()]

    def cells_of(self, name):
        keyword = KEYWORD[self.n]
        return np.flatnonzero(np.isin(self.refs[keyword], self.refs_of(keyword, name)))

    def facets_of(self, name):
        keyword = KEYWORD[self.n - 1]
        return self.nodes[keyword][np.isin(self.refs[keyword], self.refs_of(keyword, name))]


@pytest.mark.parametrize(("n", "bins"), MODELS)
def test_all_of_the_model_is_there(n, bins):
    model = sample_model(n, bins)
    read = Read(medit(model))
    assert read.n == n
    assert set(read.nodes) == {KEYWORD[n], KEYWORD[n - 1]}
    assert np.array_equal(read.points, model.mesh.points)
    assert not read.refs["Vertices"].any()
    assert np.array_equal(read.nodes[KEYWORD[n]], model.mesh.cells)
    for name, members in model.sets.cells.items():
        assert np.array_equal(read.cells_of(name), members)
    for k in range(len(model.materials.young)):
        assert np.array_equal(
            read.cells_of(f"material_{k + 1}"), np.flatnonzero(model.materials.of_cell == k)
        )
    facets = read.nodes[KEYWORD[n - 1]]
    for name, rows in model.sets.facets.items():
        assert each_once(read.facets_of(name)) == each_once(facet_triples(model.mesh.cells, rows))
    assert len(set(each_once(facets))) == len(facets)  # each once


@pytest.mark.parametrize("n", [3, 2])
def test_boundary_faces_out(n):
    model = sample_model(n)
    faces = facet_triples(model.mesh.cells, model.sets.facets["boundary"])
    assert sorted(Read(medit(model)).facets_of("boundary").tolist()) == sorted(faces.tolist())


@pytest.mark.parametrize("n", [3, 2])
def test_the_reference_is_the_label(n):
    """And that of each part of a label that a set divides has a number behind all others."""
    model = labelled_model(n)
    labels = model.cell_data["label"]
    read = Read(medit(model))
    assert np.array_equal(read.refs[KEYWORD[n]], np.where(labels == 0, 8, labels))
    assert any(line.startswith("label 0 is reference 8") for line in read.comments)
    assert read.refs[KEYWORD[n - 1]].min() > 1000
    within = np.flatnonzero(labels == 3)[::3]
    read = Read(
        medit(
            model._replace(
                sets=Sets({"boundary": model.sets.facets["boundary"]}, {"within": within})
            )
        )
    )
    refs = read.refs[KEYWORD[n]]
    assert np.array_equal(refs[labels != 3], np.where(labels == 0, 8, labels)[labels != 3])
    assert set(refs[labels == 3]) == {2001, 2002}
    assert np.array_equal(read.cells_of("label_3"), np.flatnonzero(labels == 3))
    assert set(read.refs[KEYWORD[n - 1]]) == {1999}


@pytest.mark.parametrize("n", [3, 2])
def test_order_2(n):
    """Corners, then the middles of the edges 01 12 20 03 13 23, of cells and of facets."""
    model = quadratic_model(n)
    read, linear = Read(medit(model)), Read(medit(sample_model(n)))
    points = quadratic(model.mesh.points, model.mesh.cells)[0]
    assert np.array_equal(read.points, points)
    assert set(read.nodes) == {f"{KEYWORD[n]}P2", f"{KEYWORD[n - 1]}P2"}
    for dim in (n, n - 1):
        nodes = read.nodes[f"{KEYWORD[dim]}P2"]
        assert np.array_equal(nodes[:, : dim + 1], linear.nodes[KEYWORD[dim]])
        assert np.array_equal(read.refs[f"{KEYWORD[dim]}P2"], linear.refs[KEYWORD[dim]])
        for at, edge in enumerate(
            [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)][: dim * (dim + 1) // 2], dim + 1
        ):
            assert np.array_equal(points[nodes[:, at]], points[nodes[:, edge]].mean(axis=1))
    assert "point data (not supported by this format): displacement, warmth" in read.comments
    named = [line.replace("P2 ref", " ref") for line in read.comments if " ref " in line]
    assert named == [line for line in linear.comments if " ref " in line]


def test_refused():
    model = sample_model()
    with pytest.raises(InputError, match=r'^set material_1: the file uses the name "material_1"'):
        medit(model._replace(sets=Sets({}, {"material_1": np.array([0])})))


# Others' readers


@pytest.mark.parametrize(("n", "bins"), [(3, 3), (2, None)])
def test_meshio_reads_it(n, bins, tmp_path):
    model = sample_model(n, bins)
    path = tmp_path / "model.mesh"
    path.write_bytes(medit(model))
    read, ours = meshio.read(path), Read(path.read_bytes())
    assert np.array_equal(read.points, model.mesh.points)
    cells, sides = read.cells
    assert np.array_equal(cells.data, model.mesh.cells)
    assert np.array_equal(sides.data, ours.nodes[KEYWORD[n - 1]])
    for refs, keyword in zip(
        read.cell_data["medit:ref"], (KEYWORD[n], KEYWORD[n - 1]), strict=True
    ):
        assert np.array_equal(refs, ours.refs[keyword])


# gmsh is GPL: its library is loaded by a process of its own
GMSH = """
import json, sys
import gmsh
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.logger.start()
gmsh.open(sys.argv[1])
mesh = gmsh.model.mesh
order, points, _ = mesh.getNodes()
entities = gmsh.model.getEntities()
elements = {str(entity): mesh.getElements(*entity)[2][0].tolist() for entity in entities}
determinants = []
for kind in mesh.getElementTypes(gmsh.model.getDimension()):
    places, _ = mesh.getIntegrationPoints(kind, "Gauss3")
    determinants += mesh.getJacobians(kind, places)[1].tolist()
said = [line for line in gmsh.logger.get() if not line.startswith("Info")]
print(json.dumps([order.tolist(), points.tolist(), elements, said, determinants]))
"""


@pytest.mark.skipif(importlib.util.find_spec("gmsh") is None, reason="no gmsh (pip install gmsh)")
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("n", [3, 2])
def test_gmsh_reads_it(n, order, tmp_path):
    """And finds cells of order 2 as large as ours, anywhere within, so that their edges are
    where it has them.
    """
    model = (sample_model if order == 1 else quadratic_model)(n)
    path = tmp_path / "model.mesh"
    path.write_bytes(medit(model))
    child = subprocess.run(
        [sys.executable, "-c", GMSH, str(path)], capture_output=True, text=True, check=True
    )
    numbers, points, elements, said, determinants = json.loads(child.stdout.splitlines()[-1])
    assert said == []
    points, own_points = (
        np.array(points).reshape(-1, 3)[np.argsort(numbers)],
        model_elements(model)[0],
    )
    assert np.array_equal(points[:, :n], own_points)
    sizes = np.sort(np.reshape(determinants, (len(model.mesh.cells), -1)) / [0, 0, 2, 6][n], axis=0)
    ours = np.sort(volumes(model.mesh.points, model.mesh.cells))
    np.testing.assert_allclose(sizes, np.broadcast_to(ours[:, None], sizes.shape), rtol=1e-10)
    read, expected = Read(path.read_bytes()), {}
    for dim in (n - 1, n):
        keyword = KEYWORD[dim] + ("P2" if order == 2 else "")
        nodes, refs = read.nodes[keyword], read.refs[keyword]
        if nodes.shape[1] == 10:
            nodes = nodes[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]  # gmsh's own order
        for ref in np.unique(refs):
            expected[str((dim, int(ref)))] = (nodes[refs == ref] + 1).ravel().tolist()
    assert elements == expected
