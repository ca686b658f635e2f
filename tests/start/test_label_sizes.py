"""Sizes by label: what texts say, and the targets that labels get."""

import numpy as np
import pytest
from shapes import labels_alone

import tetopt
from tetopt import Image, Sizes, mesh_image
from tetopt.errors import InputError
from tetopt.start.label_sizes import LabelSize, parse_label_size, parse_label_sizes, sizes_by_label


@pytest.fixture(scope="module")
def slabs():
    """A slab of 3 mm, label 2, and one of 8 mm, label 3, in 1; and the labels of voxels."""
    x = np.indices((40, 16, 16))[0]
    labels = np.select([(x >= 6) & (x < 9), (x >= 20) & (x < 28)], [2, 3], 1)
    return labels_alone(Image(labels.astype(float))), labels


def sizes_of(content, labels, **sizes):
    """Sizes by label, and a function of the median target of a label's voxels."""
    made = sizes_by_label(Sizes(edge_size=9.0, **sizes), content)
    target = made.sizes.on_voxels(content.image)
    return made, lambda label: float(np.median(target[labels == label]))


def test_a_label_is_as_many_cells_across_as_asked_for(slabs):
    made, target = sizes_of(*slabs, cells_across=2)
    assert target(2) == pytest.approx(1.5, abs=0.05)
    assert target(3) == pytest.approx(4.0, abs=0.1)
    thinnest = made.layers[0]
    assert (thinnest.label, thinnest.below, made.scale) == (2, 0.0, 1.0)
    assert thinnest.cells_across == pytest.approx(2.0, abs=0.01)


def test_no_size_is_below_the_smallest_which_is_said(slabs):
    made, target = sizes_of(*slabs, smallest=2.0, cells_across=2)
    assert target(2) == 2.0
    row = next(row for row in made.layers if row.label == 2)
    assert row.below == 1.0
    assert row.cells_across == pytest.approx(1.5, abs=0.05)


def test_lengths_and_slopes_by_label(slabs):
    by_label = {2: 1.2, 3: "0.25t[2.5:4]", "*": LabelSize(7.0)}
    target = sizes_of(*slabs, by_label=by_label)[1]
    assert [target(label) for label in (2, 3, 1)] == pytest.approx([1.2, 2.5, 7.0])
    target = sizes_of(*slabs, by_label={3: "0.25t"})[1]
    assert target(3) == pytest.approx(2.0, abs=0.05)
    assert target(2) == 9.0


def test_background_has_no_cells_across_but_where_it_has_a_size(slabs):
    labels = np.where(slabs[1] == 2, 0, slabs[1])  # a gap of 3 mm
    content = labels_alone(Image(labels.astype(float)))
    made, target = sizes_of(content, labels, cells_across=2)
    assert target(0) == 9.0
    assert target(3) == pytest.approx(4.0, abs=0.1)
    assert [row.label for row in made.layers] == [3, 1, 0]
    assert made.layers[-1].cells_across < 1.0
    assert made.layers[-1].below == 0.0
    for by_label, expected in (({0: "0.5t"}, 1.5), ({"*": 5.0}, 5.0)):
        target = sizes_of(content, labels, cells_across=2, by_label=by_label)[1]
        assert target(0) == pytest.approx(expected, abs=0.05)


def test_fewer_nodes_make_all_sizes_larger(slabs):
    content, _ = slabs
    asked = Sizes(edge_size=9.0, cells_across=2)
    enough = sizes_by_label(asked, content)
    fewer = sizes_by_label(asked, content, enough.nodes // 2)
    assert fewer.nodes == enough.nodes
    assert fewer.scale > 1.2
    result = mesh_image(content, enough.nodes // 2, sizes=asked, iterations=10)
    assert len(result.mesh.points) == pytest.approx(enough.nodes // 2, rel=0.03)


def test_without_a_largest_size_what_is_thick_has_no_target(slabs):
    content, labels = slabs
    sizes = sizes_by_label(Sizes(cells_across=1), content, 600).sizes
    assert sizes.edge_size is None
    assert 0.0 < sizes.field.data[labels == 2].max() <= 3.1
    assert (sizes.field.data[32:36] == 0.0).all()  # 12 mm thick
    assert sizes_by_label(Sizes(edge_size=3.0), content) is None


def test_a_field_of_the_users_counts_too(slabs):
    field = Image(np.where(slabs[1] == 3, 1.5, 0.0))
    target = sizes_of(*slabs, cells_across=1, field=field)[1]
    assert target(3) == 1.5
    assert target(2) == pytest.approx(3.0, abs=0.1)


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
        mesh_image(slabs[0], 600, sizes=Sizes(**sizes))


def test_no_labels_no_sizes_by_label():
    image = Image(np.random.default_rng(0).uniform(size=(8, 8, 8)))
    with pytest.raises(InputError, match="give labels"):
        mesh_image(image, 100, sizes=Sizes(cells_across=1))
    with pytest.raises(InputError, match="sizes_by_label"):
        tetopt.octree_mesh(image, 100, Sizes(cells_across=1))
    labels = Image(np.round(image.data), image.affine)
    stepped = tetopt.content(image, labels, smooth_interfaces=False)
    with pytest.raises(InputError, match="smooth_interfaces"):
        mesh_image(stepped, 100, sizes=Sizes(cells_across=1))
