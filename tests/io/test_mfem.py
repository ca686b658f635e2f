"""MFEM files: read by a parser after MFEM's documentation and by PyMFEM; all of the model is
there, bit by bit.
"""

from collections import deque

import numpy as np
import pytest
from meshes import with_bent_edges
from models import each_once, labelled_model, quadratic_model, sample_model

from tetopt.geometry.quadratic import numbered_edges
from tetopt.io.mfem import mfem
from tetopt.model.materials import materials
from tetopt.model.sets import Sets, facet_triples

GEOMETRY = {1: "1", 2: "2", 3: "4"}  # segment, triangle, tetrahedron


class Read:
    """What a file holds; see https://mfem.org/mesh-format-v1.0 and Mesh::Printer."""

    def __init__(self, raw):
        lines = [line for line in raw.decode().split("\n") if line]
        self.comments = [line.removeprefix("# ") for line in lines if line.startswith("#")]
        self.lines = deque(line for line in lines if not line.startswith("#"))
        assert self.lines.popleft() == "MFEM mesh v1.3"
        self.expect("dimension")
        self.n = int(self.lines.popleft())
        self.attributes, self.cells = self.elements("elements", self.n)
        self.cell_sets = self.sets("attribute_sets")
        self.facet_attributes, self.facets = self.elements("boundary", self.n - 1)
        self.facet_sets = self.sets("bdr_attribute_sets")
        self.expect("vertices")
        count, self.middles = int(self.lines.popleft()), np.empty((0, self.n))
        if self.lines[0] != "nodes":
            assert int(self.lines.popleft()) == self.n
        else:  # a grid function that is saved node by node
            head = [
                "nodes",
                "FiniteElementSpace",
                f"FiniteElementCollection: H1_{self.n}D_P2",
                f"VDim: {self.n}",
            ]
            assert [self.lines.popleft() for _ in range(5)] == [*head, "Ordering: 1"]
            values = np.array(
                [self.lines.popleft().split() for _ in range(len(self.lines) - 1)], dtype=float
            )
            self.points, self.middles = values[:count], values[count:]
        if not len(self.middles):
            self.points = np.array(
                [self.lines.popleft().split() for _ in range(count)], dtype=float
            )
        assert list(self.lines) == ["mfem_mesh_end"]

    def expect(self, keyword):
        assert self.lines.popleft() == keyword

    def elements(self, keyword, dim):
        self.expect(keyword)
        rows = [self.lines.popleft().split() for _ in range(int(self.lines.popleft()))]
        assert {row[1] for row in rows} <= {GEOMETRY[dim]}
        table = np.array(rows, dtype=int).reshape(-1, dim + 3)
        return table[:, 0], table[:, 2:]

    def sets(self, keyword):
        """Attributes by name: a name in quotes, how many, and which on any number of lines."""
        self.expect(keyword)
        sets = {}
        for _ in range(int(self.lines.popleft())):
            name, count, attributes = self.lines.popleft().strip('"'), int(self.lines.popleft()), []
            while len(attributes) < count:
                attributes += map(int, self.lines.popleft().split())
            assert len(attributes) == count
            sets[name] = attributes
        return sets

    def cells_of(self, name):
        return np.flatnonzero(np.isin(self.attributes, self.cell_sets[name]))

    def facets_of(self, name):
        return self.facets[np.isin(self.facet_attributes, self.facet_sets[name])]


def test_labels_that_are_no_sets_are_named_all_the_same():
    """Also where materials divide them; parts by sets in comments; the boundary has its number
    whatever the mesh.
    """
    model = labelled_model()
    labels, boundary = model.cell_data["label"], model.sets.facets["boundary"]
    read = Read(mfem(model._replace(sets=Sets({"boundary": boundary}, {}))))
    assert read.cell_sets == {"label_0": [8], "label_2": [2], "label_3": [3], "Right_kidney": [7]}
    assert np.array_equal(read.attributes, np.where(labels == 0, 8, labels))
    assert read.facet_sets == {"boundary": [1999]}
    table = materials(1.0 + np.arange(len(labels)) % 2, 0.3, len(labels))
    divided = Read(mfem(model._replace(materials=table, sets=Sets({}, {}), order=2)))
    for name, label in (("label_0", 0), ("label_3", 3), ("Right_kidney", 7)):
        assert np.array_equal(divided.cells_of(name), np.flatnonzero(labels == label))
    assert not any(line.startswith("label 0 is") for line in divided.comments)  # two attributes are
    within = model.sets._replace(cells={"within": np.flatnonzero(labels == 3)[::3]})
    comments = Read(mfem(model._replace(sets=within))).comments
    assert any(" 2001 " in line and line.endswith("(label_3)") for line in comments)


@pytest.mark.parametrize(("n", "edges"), [(2, "01 12 20"), (3, "01 02 03 12 13 23")])
def test_middles_are_in_the_order_of_mfem_s_edges(n, edges):
    """That in which its elements first have them, by the local edges of MFEM's fem/geom.cpp."""
    model = quadratic_model(n)
    mesh = with_bent_edges(model.mesh, 0.05)
    ends = np.sort(
        [[[cell[int(k)] for k in edge] for edge in edges.split()] for cell in mesh.cells], axis=2
    )
    number = {tuple(pair): k for k, pair in enumerate(numbered_edges(mesh.cells)[0].tolist())}
    order = [number[pair] for pair in dict.fromkeys(map(tuple, ends.reshape(-1, 2).tolist()))]
    assert np.array_equal(Read(mfem(model._replace(mesh=mesh))).middles, mesh.midpoints[order])


@pytest.mark.parametrize(("n", "bins"), [(3, 3), (2, None)])
def test_pymfem_reads_it(n, bins, tmp_path):
    ser = pytest.importorskip("mfem.ser", reason="no PyMFEM (pip install mfem)")
    model = sample_model(n, bins)
    path = tmp_path / "model.mfem"
    path.write_bytes(mfem(model))
    read = ser.Mesh(str(path), 1, 0)  # with edges; not turned for refinement
    assert np.array_equal(np.array(read.GetVertexArray()), model.mesh.points)
    cells = [read.GetElementVertices(k) for k in range(read.GetNE())]
    assert np.array_equal(cells, model.mesh.cells)
    attributes = np.array([read.GetAttribute(k) for k in range(read.GetNE())])
    in_set = {name: read.attribute_sets.GetAttributeSet(name).ToList() for name in model.sets.cells}
    for name, members in model.sets.cells.items():
        assert np.array_equal(np.flatnonzero(np.isin(attributes, in_set[name])), members)
    for k in range(len(model.materials.young)):
        chosen = read.attribute_sets.GetAttributeSet(f"material_{k + 1}").ToList()
        assert np.array_equal(
            np.flatnonzero(np.isin(attributes, chosen)),
            np.flatnonzero(model.materials.of_cell == k),
        )
    sides = np.array([read.GetBdrElementVertices(k) for k in range(read.GetNBE())])
    attributes = np.array([read.GetBdrAttribute(k) for k in range(read.GetNBE())])
    assert set(read.bdr_attribute_sets.GetAttributeSetNames()) == set(model.sets.facets)
    for name, rows in model.sets.facets.items():
        chosen = np.isin(attributes, read.bdr_attribute_sets.GetAttributeSet(name).ToList())
        assert each_once(sides[chosen]) == each_once(facet_triples(model.mesh.cells, rows))
    # Nothing had to be turned, and the faces of each boundary element are those of the cells
    assert (read.CheckElementOrientation(False), read.CheckBdrElementOrientation(False)) == (0, 0)
