"""All writers that tell points, cells, sets and materials alike: read by rules of the formats' own
into one record, which is compared with the model to the last bit.
"""

import json
import re
from itertools import pairwise
from typing import NamedTuple

import meshio
import numpy as np
import pytest
import pyvista
from models import (
    ABOUT,
    SAMPLES,
    all_nodes,
    bytes_of,
    each_once,
    labelled_model,
    quadratic_model,
    sample_model,
    unlabelled,
    young_of,
)
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal
from test_abaqus import FACES, blocks_of, read_by_meshio
from test_abaqus import named as named_blocks
from test_febio import Feb
from test_gmsh import SWAPPED
from test_gmsh import Read as Gmsh
from test_medit import KEYWORD
from test_medit import Read as Medit
from test_mfem import Read as Mfem
from test_xdmf import facet_set, fields, grids, item, named

import tetopt.io.gmsh
from tetopt.io.formats import save_model
from tetopt.io.meshes import load_mesh
from tetopt.io.tags import named_materials
from tetopt.model.loads import load_words
from tetopt.model.materials import materials
from tetopt.model.model import element_facets, elements, in_units
from tetopt.model.sets import Sets, facet_triples


class Contents(NamedTuple):
    """What a file holds."""

    points: np.ndarray
    cells: np.ndarray  # of MFEM corners alone
    facets: dict  # nodes of each set's facets
    cell_sets: dict
    moduli: np.ndarray  # (M, 2): Young's modulus and Poisson's ratio
    cell_data: dict | None  # None where the format has no place for them
    every_facet: np.ndarray
    numbers: np.ndarray | None  # of each cell's entity, reference, attribute or tag


def moduli_by_comments(comments, members, n_cells):
    """What comments tell of each material, on its cells."""
    moduli = np.full((n_cells, 2), np.nan)
    for line in comments:
        if match := re.fullmatch(r"(material_\d+): young (\S+) \w+, nu (\S+)", line):
            moduli[members(match[1])] = float(match[2]), float(match[3])
    return moduli


def of_gmsh(raw, model):
    read, n = Gmsh(raw), model.mesh.ndim
    kinds = {k: len(nodes) for k, (_, _, nodes) in read.elements.items()}
    width = max(kinds.values())
    numbers = [k for k in sorted(kinds) if kinds[k] == width]
    assert numbers == list(range(1, len(model.mesh.cells) + 1))
    sides = [k for k in kinds if kinds[k] != width]

    def members(name):
        group = read.groups.get((n, name))  # whole, as that of a label
        return np.sort([k - 1 for k in group] if group else read.cells_of_set(name))

    views = {name: [view[k] for k in numbers] for name, view in read.views.items()}
    if "young" in views:
        moduli = np.column_stack([views.pop("young"), views.pop("nu")])
    else:
        moduli = moduli_by_comments(read.comments, members, len(numbers))
    return Contents(
        read.points,
        read.nodes(numbers)[:, SWAPPED if width == 10 else slice(None)],
        {name: read.nodes(read.elements_of_set(name, "facets")) for name in model.sets.facets},
        {name: members(name) for name in model.sets.cells},
        moduli,
        views if read.version == "4.1" else None,
        read.nodes(sides) if sides else np.empty((0, n)),
        np.array([read.elements[k][1] for k in numbers]),
    )


def of_medit(raw, model):
    read, n = Medit(raw), model.mesh.ndim
    assert (read.n, read.refs["Vertices"].any()) == (n, False)
    assert set(read.nodes) == {KEYWORD[n], KEYWORD[n - 1]}
    return Contents(
        read.points,
        read.nodes[KEYWORD[n]],
        {name: read.facets_of(name) for name in model.sets.facets},
        {name: read.cells_of(name) for name in model.sets.cells},
        moduli_by_comments(read.comments, read.cells_of, len(model.mesh.cells)),
        None,
        read.nodes[KEYWORD[n - 1]],
        read.refs[KEYWORD[n]],
    )


def of_mfem(raw, model):
    read = Mfem(raw)
    assert read.n == model.mesh.ndim
    assert list(read.facet_sets) == list(model.sets.facets)
    return Contents(
        np.concatenate([read.points, read.middles]),
        read.cells,
        {name: read.facets_of(name) for name in read.facet_sets},
        {name: read.cells_of(name) for name in model.sets.cells},
        moduli_by_comments(read.comments, read.cells_of, len(read.cells)),
        None,
        read.facets,
        read.attributes,
    )


def of_xdmf(raw, model):
    parts = grids(raw)
    assert set(parts) == {"mesh"} | {k for k in ("facets", "cells") if getattr(model.sets, k)}
    points, cells = (
        item(parts["mesh"].find(f"{each}/DataItem")) for each in ("Geometry", "Topology")
    )
    place = {tuple(cell): k for k, cell in enumerate(cells.tolist())}
    columns, moduli = fields(parts["mesh"]), np.full((len(cells), 2), np.nan)
    numbers, of_set = 0, {}
    if "material" in columns:
        assert next(iter(columns)) == "material"  # the one that dolfinx reads as tags
        of_cell, lists = columns.pop("material") - 1, named(parts["mesh"])
        moduli = np.column_stack([columns.pop("young"), columns.pop("nu")])
        table = np.array([lists["young"], lists["nu"]], dtype=float).T
        assert of_cell.min() == 0
        assert_array_equal(table[of_cell], moduli)
    if "cells" in parts:
        tags, tags_of = fields(parts["cells"])["cells"], named(parts["cells"])
        rows = item(parts["cells"].find("Topology/DataItem")).tolist()
        of_tags = np.array([place[tuple(row)] for row in rows])
        assert list(tags_of) == list(model.sets.cells)
        of_set = {
            name: of_tags[np.isin(tags, np.array(each, dtype=int))]
            for name, each in tags_of.items()
        }
        numbers = np.zeros(len(cells), dtype=int)
        numbers[of_tags] = tags
    facets = parts.get("facets")
    return Contents(
        points,
        cells,
        {name: facet_set(facets, name) for name in model.sets.facets},
        of_set,
        moduli,
        columns,
        np.empty((0, 3)) if facets is None else item(facets.find("Topology/DataItem")),
        numbers,
    )


def of_abaqus(raw, model):
    file, blocks = read_by_meshio(raw), blocks_of(raw)
    (block,) = file.cells
    assert block.type == {1: "tetra", 2: "tetra10"}[model.order]
    surfaces, elements_of = named_blocks(raw, "*SURFACE"), named_blocks(raw, "*ELSET")
    assert list(surfaces) == list(model.sets.facets)
    assert {face for rows in surfaces.values() for _, face in rows} <= set(FACES)
    moduli = np.full((len(block.data), 2), np.nan)
    for (_, parameters, _), (word, _, data) in pairwise(blocks):
        if word == "*ELASTIC":
            cells = [int(cell) - 1 for line in elements_of[parameters["NAME"]] for cell in line]
            assert np.isnan(moduli[cells]).all()
            ((young, nu),) = data
            moduli[cells] = float(young), float(nu)
    links = [parameters for word, parameters, _ in blocks if word == "*SOLID SECTION"]
    assert all(each["ELSET"] == each["MATERIAL"] for each in links)
    assert [each["MATERIAL"] for each in links] == named_materials(model)
    # Faces are listed as seen from outside, clockwise.
    outward = {face: np.array(corners[::-1]) - 1 for face, corners in FACES.items()}
    return Contents(
        file.points,
        block.data,
        {
            name: np.array([block.data[int(cell) - 1, outward[face]] for cell, face in rows])
            for name, rows in surfaces.items()
        },
        {name: file.cell_sets[name][0] for name in model.sets.cells},
        moduli,
        None,
        np.empty((0, 3)),
        None,
    )


def of_febio(raw, model):
    feb = Feb(raw)
    assert feb.type == {1: "tet4", 2: "tet10"}[model.order]
    assert_array_equal(feb.node_ids, np.arange(1, len(feb.points) + 1))
    assert list(feb.surfaces) == list(feb.node_sets) == list(model.sets.facets)
    for name, nodes in feb.node_sets.items():
        assert_array_equal(nodes, np.unique(feb.surfaces[name]))
    moduli = np.column_stack([feb.moduli("E"), feb.moduli("v")])
    empty = np.empty((0, 3))
    return Contents(feb.points, feb.cells, feb.surfaces, feb.cell_sets, moduli, None, empty, None)


def of_vtk(path, model):
    grid, n = pyvista.read(path), model.mesh.ndim
    cells = grid.cells.reshape(grid.n_cells, -1)[:, 1:]
    columns = {name: np.asarray(values) for name, values in grid.cell_data.items()}
    moduli = np.full((len(cells), 2), np.nan)
    if model.materials is not None:
        moduli = np.column_stack([columns.pop("young"), columns.pop("nu")])
        assert_array_equal(columns.pop("material"), model.materials.of_cell + 1)
    sets = {"facets": {}, "cells": {}}
    for key in grid.field_data:
        kind, _, name = key.partition(":")
        if kind in sets and name:
            sets[kind][name] = np.asarray(grid.field_data[key])
    return Contents(
        grid.points[:, :n],
        cells,
        {name: element_facets(cells, rows) for name, rows in sets["facets"].items()},
        sets["cells"],
        moduli,
        columns,
        np.empty((0, n)),
        None,
    )


NUMBERED = {
    ".msh": of_gmsh,
    ".msh2": of_gmsh,
    ".mesh": of_medit,
    ".mfem": of_mfem,
    ".xdmf": of_xdmf,
}
READERS = NUMBERED | {".inp": of_abaqus, ".feb": of_febio}
SUFFIXES = [*READERS, ".vtu", ".vtk"]


def contents(path, model):
    path.write_bytes(bytes_of(path, model))
    if path.suffix in READERS:
        return READERS[path.suffix](path.read_bytes(), model)
    return of_vtk(path, model)


def oriented_rows(rows):
    """The facets' corners with the smallest first and the same side out, sorted."""
    if rows.shape[1] == 3:
        start = rows.argmin(axis=1)[:, None]
        rows = np.take_along_axis(rows, (start + np.arange(3)) % 3, axis=1)
    return sorted(map(tuple, rows.tolist()))


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", SAMPLES)
def test_all_of_the_model_is_in_the_file(name, suffix, tmp_path):
    """Facets face out of their cells: where a set has facets of its own those of each, elsewhere
    the boundary's, which are there once. Abaqus has 20 characters for a number.
    """
    model = SAMPLES[name]()
    if suffix in (".inp", ".feb") and (
        model.mesh.ndim == 2 or (suffix == ".feb" and model.materials is None)
    ):
        pytest.skip("refused")
    n, n_corners = model.mesh.ndim, len(model.mesh.points)
    read, (points, cells) = contents(tmp_path / f"a{suffix}", model), elements(model)
    assert read.points[:n_corners, :n].tobytes() == model.mesh.points.tobytes()
    assert len(read.points) == len(points)
    if suffix == ".mfem":  # with the middles in an order of its own
        assert_array_equal(np.unique(read.points, axis=0), np.unique(points, axis=0))
    else:
        rounding = 1e-15 if suffix == ".inp" else 0.0
        assert_allclose(read.points[:, :n], points, rtol=rounding, atol=0.01 * rounding)
    assert_array_equal(read.cells, cells[:, : n + 1] if suffix == ".mfem" else cells)
    assert set(read.cell_sets) == set(model.sets.cells)
    for each, members in model.sets.cells.items():
        assert_array_equal(read.cell_sets[each], members)
    assert len(set(each_once(read.every_facet))) == len(read.every_facet)
    assert set(read.facets) == set(model.sets.facets)
    for each, rows in model.sets.facets.items():
        nodes, expected = read.facets[each], element_facets(cells, rows)
        assert each_once(nodes) == each_once(expected[:, : nodes.shape[1]])
        if each == "boundary" or suffix not in (".msh", ".msh2", ".mesh", ".mfem"):
            assert oriented_rows(nodes[:, :n]) == oriented_rows(expected[:, :n])
    table = model.materials
    if table is None:
        assert np.isnan(read.moduli).all()
    else:
        assert_array_equal(read.moduli, np.column_stack([table.young, table.nu])[table.of_cell])
    if read.cell_data is not None:
        assert list(read.cell_data) == list(model.cell_data)
        for each, values in model.cell_data.items():
            assert_array_equal(read.cell_data[each], values)
            if suffix == ".xdmf":
                assert read.cell_data[each].dtype.kind == values.dtype.kind


@pytest.mark.parametrize("has_materials", [False, True])
@pytest.mark.parametrize("suffix", NUMBERED)
def test_the_number_of_a_cell_is_its_label(suffix, n, has_materials, tmp_path):
    """What divides a label has numbers behind all others: sets, and materials where the format has
    no other place for them.
    """
    model = labelled_model(n)
    labels = model.cell_data["label"]
    expected, divided = np.where(labels == 0, 8, labels), np.flatnonzero(labels == 3)
    if not has_materials:
        assert_array_equal(contents(tmp_path / f"a{suffix}", model).numbers, expected)
        if suffix != ".xdmf":
            assert re.search(
                r"label 0 is (reference |attribute )?8", (tmp_path / f"a{suffix}").read_text()
            )
    sets = model.sets._replace(cells=model.sets.cells | {"within": divided[::3]})
    table = materials(1.0 + np.arange(len(labels)) % 2, 0.3, len(labels))
    model = model._replace(materials=table if has_materials else None, sets=sets)
    read = contents(tmp_path / f"a{suffix}", model)
    assert read.numbers[divided].min() > 1000
    if has_materials and suffix in (".msh2", ".mesh", ".mfem"):
        assert read.numbers.min() > 1000
        assert len(np.unique(read.numbers[divided])) == 4
    else:
        assert_array_equal(np.delete(read.numbers, divided), np.delete(expected, divided))
        assert len(np.unique(read.numbers[divided])) == 2
    for name, members in sets.cells.items():
        assert_array_equal(read.cell_sets[name], members)


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".xdmf", ".msh", ".msh2", ".mesh"])
@pytest.mark.parametrize(("n", "bins", "order"), [(3, 3, 1), (2, None, 1), (3, 3, 2), (2, None, 2)])
def test_meshio_reads_it(suffix, n, bins, order, tmp_path):
    """In the files of gmsh it drops the numbers of elements; there the order of cells is another,
    and that of their nodes gmsh's.
    """
    if suffix == ".mesh" and order == 2:
        pytest.skip("meshio has no P2")
    model = (sample_model if order == 1 else quadratic_model)(n, bins)
    (points, own), path = elements(model), tmp_path / f"a{suffix}"
    path.write_bytes(bytes_of(path, model))
    read = meshio.read(path, "gmsh" if suffix == ".msh2" else None)
    assert_array_equal(read.points[:, :n], points)
    kind = {3: "triangle", 4: "tetra", 6: "triangle6", 10: "tetra10"}[own.shape[1]]
    blocks = [k for k, block in enumerate(read.cells) if block.type == kind]
    cells = np.concatenate([read.cells[k].data for k in blocks])
    ours, theirs = np.arange(len(own)), np.arange(len(own))
    if suffix == ".msh":
        ours, theirs = np.lexsort(own.T), np.lexsort(cells.T)
    assert_array_equal(cells[theirs], own[ours])
    has_data = suffix not in (".msh2", ".mesh")
    expected = model.cell_data | {"young": young_of(model)} if has_data else {}
    if suffix.startswith(".msh"):
        labels = model.cell_data["label"]
        expected["gmsh:physical"] = np.where(labels == 0, 2, labels)
    if suffix == ".mesh":
        medit = Medit(path.read_bytes())
        expected["medit:ref"] = medit.refs[KEYWORD[n]]
        assert_array_equal(read.cells[1].data, medit.nodes[KEYWORD[n - 1]])
        assert_array_equal(read.cell_data["medit:ref"][1], medit.refs[KEYWORD[n - 1]])
    for name, values in expected.items():
        assert len(read.cell_data[name]) == len(read.cells)
        found = np.concatenate([read.cell_data[name][k] for k in blocks])
        assert_array_equal(found.ravel()[theirs], values[ours])
    if order == 2 and has_data:
        warmth = all_nodes(model.point_data["warmth"], model.mesh)
        assert_array_equal(read.point_data["warmth"], warmth)
    if suffix == ".msh":
        for name, rows in model.sets.facets.items():
            members = [
                block.data[chosen]
                for block, chosen in zip(read.cells, read.cell_sets[name], strict=True)
            ]
            nodes = np.concatenate([each for each in members if len(each)])
            assert each_once(nodes) == each_once(element_facets(own, rows))


@pytest.mark.parametrize("suffix", [".msh", ".msh2", ".vtu", ".vtk"])
@pytest.mark.parametrize(("n", "space"), [(2, "ras"), (3, "ras"), (3, "lps")])
@pytest.mark.parametrize(("bins", "order"), [(3, 1), ("none", 1), ("many", 1), (3, 2)])
def test_our_reader_finds_the_model(suffix, n, space, bins, order, tmp_path, monkeypatch):
    """Points, cells, sets, moduli in their units, where the file came from; gmsh's 4.1 has another
    order of cells.
    """
    model, path = (sample_model if order == 1 else quadratic_model)(n), tmp_path / f"a{suffix}"
    if bins == "none":
        model = model._replace(materials=None)
    if bins == "many" and suffix == ".msh":  # then they are no groups
        monkeypatch.setattr(tetopt.io.gmsh, "MOST_MATERIAL_GROUPS", 2)
    save_model(path, model, space=space, units="MPa")
    back, is_vtk = load_mesh(path), suffix.startswith(".vt")
    assert (back.space, back.n_turned, back.notes, back.order) == (space, 0, (), order)
    assert back.n_left == 0 or not is_vtk
    if order == 2 and suffix != ".msh2":
        warmth = all_nodes(model.point_data["warmth"], model.mesh)
        assert_array_equal(back.point_data["warmth"], warmth)
        if n == 3 or is_vtk:
            assert_array_equal(back.point_data["displacement"], model.point_data["displacement"])
    assert back.mesh.points.tobytes() == model.mesh.points.tobytes()
    texts = {"units": "MPa", "image": ABOUT["image"], "image_sha256": ABOUT["image_sha256"]}
    assert {name: back.text(name) for name in texts} == texts
    if is_vtk:
        turn = [-1, -1, 1] if space == "lps" else 1
        loads = [load._replace(numbers=load.numbers * turn + 0.0) for load in model.loads]
        assert back.text("loads") == json.dumps([load_words(load) for load in loads])
        assert (back.text("tetopt"), back.text("space")) == (ABOUT["tetopt"], space)
    place = {tuple(cell): k for k, cell in enumerate(model.mesh.cells.tolist())}
    of_cell = np.array([place[tuple(cell)] for cell in back.mesh.cells.tolist()])
    assert sorted(of_cell) == list(range(len(place)))
    assert is_vtk <= (of_cell == np.arange(len(of_cell))).all()
    expected = {"label": model.cell_data["label"]} if suffix == ".msh2" else dict(model.cell_data)
    if bins != "none":
        table = in_units(model, "MPa").materials
        expected |= {"young": table.young[table.of_cell] * 1000.0, "nu": table.nu[table.of_cell]}
        expected |= {"material": table.of_cell + 1} if is_vtk else {}
    assert set(back.cell_data) == set(expected)
    for name, values in expected.items():
        assert_array_equal(back.cell_data[name], values[of_cell])
    assert [set(each) for each in back.sets] == [set(each) for each in model.sets]
    for name, members in model.sets.cells.items():
        assert_array_equal(back.sets.cells[name], np.flatnonzero(np.isin(of_cell, members)))
    for name, rows in model.sets.facets.items():
        triples = facet_triples(back.mesh.cells, back.sets.facets[name])
        assert each_once(triples) == each_once(facet_triples(model.mesh.cells, rows))
        if is_vtk:
            assert_array_equal(back.sets.facets[name], rows)


@pytest.mark.parametrize(
    ("suffix", "kind", "name"),
    [
        *((suffix, kind, "Material_2") for suffix in (".msh", ".msh2") for kind in Sets._fields),
        (".mesh", "cells", "material_1"),
        *((".inp", "cells", name) for name in ("all_cells", "Material_2")),
    ],
)
def test_names_that_are_taken(suffix, kind, name):
    model = unlabelled(sample_model())  # whose names materials would have
    members = getattr(model.sets, kind)
    sets = members | {name: next(iter(members.values()))}
    with refusal(f'set {name}: the file uses the name "{name}"'):
        bytes_of(f"a{suffix}", model._replace(sets=model.sets._replace(**{kind: sets})))
