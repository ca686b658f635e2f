"""Tags: one for each combination of sets; names of materials."""

from xml.etree import ElementTree

import numpy as np
from models import sample_model
from numpy.testing import assert_array_equal

from tetopt.io.abaqus import abaqus
from tetopt.io.febio import febio
from tetopt.io.tags import named_materials, tag_sets
from tetopt.model.build import build_model
from tetopt.model.label_names import TABLE_TEXT, LabelTable


def test_tags_say_which_sets_an_item_is_in():
    for sets in (sample_model().sets.facets, sample_model().sets.cells):
        tags = tag_sets(sets)
        assert tags.tags.min() == 1
        assert len(np.unique(tags.items, axis=0)) == len(tags.items)
        for name, members in sets.items():
            chosen = tags.items[np.isin(tags.tags, tags.tags_of[name])]
            assert_array_equal(chosen, members)
        together = {
            tuple(name for name in sets if tag in tags.tags_of[name])
            for tag in np.unique(tags.tags)
        }
        assert len(together) == tags.tags.max()  # no two tags for one combination
        # as they first occur
        assert list(dict.fromkeys(tags.tags.tolist())) == list(range(1, tags.tags.max() + 1))
    assert tag_sets({}).tags_of == {}


def named_model(young, names):
    """Cells of the labels 0, 2, 3 and 5 by their height, with these moduli of theirs and names."""
    mesh = sample_model()._replace(materials=None).mesh
    height = mesh.points[mesh.cells].mean(axis=1)[:, 2]
    labels = np.array([0, 2, 3, 5])[np.searchsorted(np.quantile(height, [0.25, 0.5, 0.75]), height)]
    about = {TABLE_TEXT: LabelTable(names, {})}
    return build_model(mesh, young=young(labels), nu=0.3, cell_data={"label": labels}, about=about)


def test_materials_are_called_as_their_labels_are():
    names = {0: "Fat", 2: "left kidney", 3: "right kidney"}
    each = named_model(lambda labels: 1.0 + labels, names)
    assert named_materials(each) == ["Fat", "left_kidney", "right_kidney", "label_5"]
    some = named_model(
        lambda labels: np.where(labels == 0, 1.0, np.where(labels == 5, 3.0, 2.0)), names
    )
    assert named_materials(some) == ["Fat", "left_kidney_right_kidney", "label_5"]
    divided = named_model(
        lambda labels: np.where(labels == 0, 1.0, np.arange(len(labels)) % 2 + 2.0), names
    )
    assert named_materials(divided) == ["Fat", "material_2", "material_3"]
    of_one = named_model(
        lambda labels: np.where(labels == 0, np.arange(len(labels)) % 2 + 1.0, labels + 1.0), names
    )
    assert named_materials(of_one) == ["Fat_1", "Fat_2", "left_kidney", "right_kidney", "label_5"]
    long = named_model(lambda labels: 1.0 + (labels > 0), {2: "a" * 40, 3: "b" * 40})
    assert named_materials(long) == ["label_0", "material_2"]


def test_input_files_of_solvers_have_these_names():
    model = named_model(lambda labels: 1.0 + labels, {2: "left kidney"})
    lines = abaqus(model).decode().splitlines()
    assert {line for line in lines if line.startswith("*SOLID")} == {
        f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"
        for name in ("label_0", "left_kidney", "label_3", "label_5")
    }
    assert lines.count("*ELSET, ELSET=left_kidney") == 1  # which is the set of the label, too
    root = ElementTree.fromstring(febio(model))
    assert [each.get("name") for each in root.findall("Material/material")] == [
        "label_0",
        "left_kidney",
        "label_3",
        "label_5",
    ]
    domains = {
        each.get("name"): each.get("mat") for each in root.findall("MeshDomains/SolidDomain")
    }
    assert domains["cells of left_kidney"] == "left_kidney"
    assert set(domains) == {each.get("name") for each in root.findall("Mesh/Elements")}
