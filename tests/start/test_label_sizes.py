"""Sizes by label: what texts say, and the targets that labels get."""

import numpy as np
import pytest

import tetopt
from tetopt.errors import InputError
from tetopt.start.label_sizes import LabelSize, parse_label_size, parse_label_sizes, sizes_by_label


@pytest.fixture(scope="module")
def slabs():
    """A slab of 3 mm, label 2, and one of 8 mm, label 3, in 1."""
    x = np.indices((40, 16, 16))[0]
    labels = np.select([(x >= 6) & (x < 9), (x >= 20) & (x < 28)], [2, 3], 1)
    image = tetopt.Image(labels.astype(float))
    return tetopt.content(image, image, weights=[0.0]), labels


def target_of(made, labels, label):
    return float(
        np.median(made.sizes.on_voxels(tetopt.Image(labels.astype(float)))[labels == label])
    )


def test_a_label_is_as_many_cells_across_as_asked_for(slabs):
    content, labels = slabs
    made = sizes_by_label(tetopt.Sizes(edge_size=9.0, cells_across=2), content)
    assert target_of(made, labels, 2) == pytest.approx(1.5, abs=0.05)
    assert target_of(made, labels, 3) == pytest.approx(4.0, abs=0.1)
    assert (made.layers[0].label, made.layers[0].below) == (2, 0.0)
    assert made.layers[0].cells_across == pytest.approx(2.0, abs=0.01)
    assert made.scale == 1.0


def test_no_size_is_below_the_smallest_which_is_said(slabs):
    content, labels = slabs
    made = sizes_by_label(tetopt.Sizes(smallest=2.0, edge_size=9.0, cells_across=2), content)
    assert target_of(made, labels, 2) == 2.0
    row = next(row for row in made.layers if row.label == 2)
    assert row.below == 1.0
    assert row.cells_across == pytest.approx(1.5, abs=0.05)


def test_lengths_and_slopes_by_label(slabs):
    content, labels = slabs
    by_label = {2: 1.2, 3: "0.25t[2.5:4]", "*": LabelSize(7.0)}
    made = sizes_by_label(tetopt.Sizes(edge_size=9.0, by_label=by_label), content)
    assert [target_of(made, labels, label) for label in (2, 3, 1)] == pytest.approx([1.2, 2.5, 7.0])
    made = sizes_by_label(tetopt.Sizes(edge_size=9.0, by_label={3: "0.25t"}), content)
    assert target_of(made, labels, 3) == pytest.approx(2.0, abs=0.05)
    assert target_of(made, labels, 2) == 9.0


def test_background_has_no_cells_across_but_where_it_has_a_size(slabs):
    content, labels = slabs
    labels = np.where(labels == 2, 0, labels)  # a gap of 3 mm
    image = tetopt.Image(labels.astype(float))
    content = tetopt.content(image, image, weights=[0.0])
    made = sizes_by_label(tetopt.Sizes(edge_size=9.0, cells_across=2), content)
    assert target_of(made, labels, 0) == 9.0
    assert target_of(made, labels, 3) == pytest.approx(4.0, abs=0.1)
    assert [row.label for row in made.layers] == [3, 1, 0]
    assert made.layers[-1].cells_across < 1.0
    assert made.layers[-1].below == 0.0
    made = sizes_by_label(
        tetopt.Sizes(edge_size=9.0, cells_across=2, by_label={0: "0.5t"}), content
    )
    assert target_of(made, labels, 0) == pytest.approx(1.5, abs=0.05)
    made = sizes_by_label(tetopt.Sizes(edge_size=9.0, cells_across=2, by_label={"*": 5.0}), content)
    assert target_of(made, labels, 0) == 5.0


def test_fewer_nodes_make_all_sizes_larger(slabs):
    content, _ = slabs
    asked = tetopt.Sizes(edge_size=9.0, cells_across=2)
    enough = sizes_by_label(asked, content)
    fewer = sizes_by_label(asked, content, enough.nodes // 2)
    assert fewer.nodes == enough.nodes
    assert fewer.scale > 1.2
    result = tetopt.mesh_image(content, enough.nodes // 2, sizes=asked, iterations=10)
    assert len(result.mesh.points) == pytest.approx(enough.nodes // 2, rel=0.03)


def test_without_a_largest_size_what_is_thick_has_no_target(slabs):
    content, labels = slabs
    made = sizes_by_label(tetopt.Sizes(cells_across=1), content, 600)
    assert made.sizes.edge_size is None
    assert 0.0 < made.sizes.field.data[labels == 2].max() <= 3.1
    assert (made.sizes.field.data[32:36] == 0.0).all()  # 12 mm thick
    assert sizes_by_label(tetopt.Sizes(edge_size=3.0), content) is None


def test_a_field_of_the_users_counts_too(slabs):
    content, labels = slabs
    field = tetopt.Image(np.where(labels == 3, 1.5, 0.0))
    made = sizes_by_label(tetopt.Sizes(edge_size=9.0, cells_across=1, field=field), content)
    assert target_of(made, labels, 3) == 1.5
    assert target_of(made, labels, 2) == pytest.approx(3.0, abs=0.1)


def test_texts():
    assert parse_label_sizes("fluid=1.5, bone=0.6t[1:10], *=6") == {
        "fluid": LabelSize(1.5),
        "bone": LabelSize(0.6, True, 1.0, 10.0),
        "*": LabelSize(6.0),
    }
    assert parse_label_size("2t[:5]") == LabelSize(2.0, True, 0.0, 5.0)


@pytest.mark.parametrize(
    "text",
    [
        "fluid",
        "fluid=",
        "=1",
        "1=0",
        "1=-2",
        "1=1e999",
        "1=nan",
        "1=0.6x",
        "1=t",
        "1=1,1=2",
        "1=2t[5:1]",
        "1=[1:2]",
    ],
)
def test_other_texts_are_refused(text):
    with pytest.raises(InputError, match=r"^label_size: "):
        parse_label_sizes(text)


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ({"cells_across": 0.0}, "cells_across"),
        ({"cells_across": 1000.0}, "cells_across"),
        ({"by_label": {7: 2.0}}, "7"),
        ({"by_label": {"bone": 2.0}}, "bone"),
    ],
)
def test_other_sizes_are_refused(slabs, sizes, words):
    with pytest.raises(InputError, match=words):
        tetopt.mesh_image(slabs[0], 600, sizes=tetopt.Sizes(**sizes))


def test_no_labels_no_sizes_by_label():
    image = tetopt.Image(np.random.default_rng(0).uniform(size=(8, 8, 8)))
    with pytest.raises(InputError, match="give labels"):
        tetopt.mesh_image(image, 100, sizes=tetopt.Sizes(cells_across=1))
    with pytest.raises(InputError, match="sizes_by_label"):
        tetopt.octree_mesh(image, 100, tetopt.Sizes(cells_across=1))
