"""XDMF files: read back by an XML parser and by VTK, every number and every set the same;
dolfinx has its own test.
"""

from xml.etree import ElementTree

import numpy as np
import pytest
import pyvista
from models import (
    ABOUT,
    SAMPLES,
    all_nodes,
    bytes_of,
    quadratic_model,
    sample_model,
    with_two_sides,
)
from refusals import refusal

from tetopt.model.loads import load_words
from tetopt.model.model import elements, header_lines

XDMF = "a.xdmf"


@pytest.fixture(params=list(SAMPLES))
def model(request):
    return SAMPLES[request.param]()


def item(node):
    """A DataItem's array."""
    shape = [int(size) for size in node.get("Dimensions").split()]
    assert (node.get("Format"), node.get("Precision")) == ("XML", "8")
    kind = {"Float": np.float64, "Int": np.int64}[node.get("NumberType")]
    return np.array([kind(word) for word in node.text.split()], dtype=kind).reshape(shape)


def named(node):
    """What a node's Information tells, lists of words by name."""
    return {
        each.get("Name"): each.get("Value").split()
        for each in node.findall("Information")
        if each.get("Value")
    }


def grids(model):
    """The grids of a model's file, or of its bytes, by name."""
    root = ElementTree.fromstring(model if isinstance(model, bytes) else bytes_of(XDMF, model))
    inner = {grid.get("Name"): grid for grid in root.findall("./Domain/Grid/Information/Grid/Grid")}
    (whole,) = root.find("Domain")
    return {**inner, "mesh": whole}


def fields(grid, center="Cell"):
    of_kind = [each for each in grid.findall("Attribute") if each.get("Center") == center]
    return {each.get("Name"): item(each.find("DataItem")) for each in of_kind}


def turned_over(triples):
    return np.concatenate([triples[:, 1::-1], triples[:, 2:]], axis=1)


def facet_set(grid, name):
    """A set's facets from its tags, facing out of its own cells."""
    nodes, tags = item(grid.find("Topology/DataItem")), fields(grid)["facets"]
    tags_of = {each: np.array(words, dtype=int) for each, words in named(grid).items()}
    is_in = np.isin(tags, tags_of[name])
    is_turned = np.isin(tags, tags_of.get(f"{name} turned", []))
    nodes = nodes[:, : len(grid.find("Geometry").get("GeometryType"))]  # corners come first
    return np.where(is_turned[:, None], turned_over(nodes), nodes)[is_in]


def test_a_side_is_told_only_where_two_sets_differ():
    turned = {
        n: [name for name in named(grids(model)["facets"]) if "turned" in name]
        for n, model in enumerate([sample_model(), with_two_sides(sample_model())])
    }
    assert turned == {0: [], 1: ["bright turned"]}


def test_point_data_are_on_every_node(n, tmp_path):
    """Of corners alone they are interpolated; vectors of three columns stay together."""
    model = quadratic_model(n)
    columns, displacement = fields(grids(model)["mesh"], "Node"), model.point_data["displacement"]
    parts = (
        {"displacement": displacement}
        if n == 3
        else {f"displacement_{k}": displacement[:, k] for k in range(n)}
    )
    expected = parts | {"warmth": all_nodes(model.point_data["warmth"], model.mesh)}
    assert list(columns) == list(expected)
    (tmp_path / "model.xdmf").write_bytes(bytes_of(XDMF, model))
    read = pyvista.get_reader(tmp_path / "model.xdmf").read()["mesh"].point_data
    for name, values in expected.items():
        assert np.array_equal(columns[name], values), name
        assert np.array_equal(read[name], values), name


def test_loads_and_origin_are_told():
    model = sample_model()
    head = ElementTree.fromstring(bytes_of(XDMF, model)).findall("./Domain/Grid/Information")
    loads = [each.get("Value") for each in head if each.get("Name") == "load"]
    assert loads == [load_words(load) for load in model.loads]
    about = [each.get("Value") for each in head if each.get("Name") == "about"]
    assert about == header_lines(model)
    assert f"image: {ABOUT['image']}, sha256 {ABOUT['image_sha256']}" in about


def test_vtk_reads_the_same(model, tmp_path):
    path = tmp_path / "model.xdmf"
    path.write_bytes(bytes_of(XDMF, model))
    read = pyvista.get_reader(path).read()
    if not isinstance(read, pyvista.MultiBlock):  # of one grid
        read = pyvista.MultiBlock({"mesh": read})
    assert read.keys() == [
        "mesh",
        *(["facets"] if model.sets.facets else []),
        *(["cells"] if model.sets.cells else []),
    ]
    n, (points, cells) = model.mesh.ndim, elements(model)
    for name in read.keys():  # noqa: SIM118 - iterating over blocks gives the blocks
        assert np.array_equal(read[name].points[:, :n], points)
    assert np.array_equal(read["mesh"].cells.reshape(len(cells), -1)[:, 1:], cells)
    kinds = {3: "TRIANGLE", 4: "TETRA", 6: "QUADRATIC_TRIANGLE", 10: "QUADRATIC_TETRA"}
    assert set(read["mesh"].celltypes) == {pyvista.CellType[kinds[cells.shape[1]]]}
    for name, values in fields(grids(model)["mesh"]).items():
        assert np.array_equal(read["mesh"].cell_data[name], values), name
    if model.sets.facets:
        grid = grids(model)["facets"]
        nodes = item(grid.find("Topology/DataItem"))
        assert np.array_equal(read["facets"].cells.reshape(len(nodes), -1)[:, 1:], nodes)
        assert np.array_equal(read["facets"].cell_data["facets"], fields(grid)["facets"])


def test_cell_data_of_any_name_shape_and_kind(tmp_path):
    model = sample_model()
    rng, count = np.random.default_rng(0), len(model.mesh.cells)
    data = {
        'a "b" <c> & ä': rng.normal(size=count).astype(np.float32),
        "direction": rng.normal(size=(count, 3)),
        "pair": rng.normal(size=(count, 2)),
        "is_in": rng.random(count) < 0.5,
        "large": rng.integers(-(2**52), 2**52, count),
        "young": np.zeros(count),
    }
    model = model._replace(cell_data=data)
    columns = fields(grids(model)["mesh"])
    expected = {name: data[name] for name in list(data)[:2]}
    expected |= {f"pair_{k}": data["pair"][:, k] for k in range(2)} | {
        name: data[name] for name in ("is_in", "large")
    }
    assert list(columns) == ["material", "young", "nu", *expected]
    assert (columns["young"] > 0.0).all()
    (tmp_path / "model.xdmf").write_bytes(bytes_of(XDMF, model))
    read = pyvista.get_reader(tmp_path / "model.xdmf").read()["mesh"].cell_data
    for name, values in expected.items():
        assert np.array_equal(columns[name], values), name
        assert np.array_equal(read[name], values), name


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_vtk_cannot_read_are_refused(value):
    model = sample_model()
    for name, n_rows in (
        ("cell_data", len(model.mesh.cells)),
        ("point_data", len(model.mesh.points)),
    ):
        odd = {"odd": np.array([value] + [1.0] * (n_rows - 1))}
        with refusal(r"^a\.xdmf: .* 'odd'; .* use \.vtu$"):
            bytes_of(XDMF, model._replace(**{name: odd}))
