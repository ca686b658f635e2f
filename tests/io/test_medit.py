"""medit files: read by a parser after INRIA's description, by meshio and by gmsh; points bit by
bit.
"""

import re

import numpy as np
from models import quadratic_model, sample_model
from test_gmsh import SWAPPED, read_by_gmsh

from tetopt.io.medit import medit
from tetopt.model.sets import Sets

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
            keyword = keyword.removesuffix("P2")
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
        lines = [re.fullmatch(rf"{keyword}(?:P2)? ref (\d+): (.*)", line) for line in self.comments]
        return [int(line[1]) for line in lines if line and name in line[2].split()]

    def cells_of(self, name):
        keyword = KEYWORD[self.n]
        return np.flatnonzero(np.isin(self.refs[keyword], self.refs_of(keyword, name)))

    def facets_of(self, name):
        keyword = KEYWORD[self.n - 1]
        return self.nodes[keyword][np.isin(self.refs[keyword], self.refs_of(keyword, name))]


def test_what_the_comments_tell():
    """Data that the format has no place for; and a boundary has its number whatever the mesh."""
    model = quadratic_model()
    raw = medit(model._replace(sets=Sets({"boundary": model.sets.facets["boundary"]}, {})))
    for keyword in (b"Tetrahedra", b"Triangles"):
        assert b"\n" + keyword + b"P2\n" in raw
    read = Read(raw)
    assert "point data (not supported by this format): displacement, warmth" in read.comments
    assert set(read.refs["Triangles"]) == {1999}


# Others' readers


def test_gmsh_reads_it(n, order, tmp_path):
    model = (sample_model if order == 1 else quadratic_model)(n)
    path = tmp_path / "model.mesh"
    path.write_bytes(medit(model))
    *_, entities = read_by_gmsh(path, model)
    read, expected = Read(path.read_bytes()), {}
    for dim in (n - 1, n):
        nodes, refs = read.nodes[KEYWORD[dim]], read.refs[KEYWORD[dim]]
        if nodes.shape[1] == 10:
            nodes = nodes[:, SWAPPED]
        for ref in np.unique(refs):
            expected[str((dim, int(ref)))] = (nodes[refs == ref] + 1).ravel().tolist()
    assert entities == expected
