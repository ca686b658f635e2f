"""Materials of cells, bins and their error."""

import numpy as np
import pytest
from models import sample_image, sample_model, young_of
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

from tetopt.model.averages import cell_values
from tetopt.model.build import build_model
from tetopt.model.mappings import ByLabel
from tetopt.model.materials import bin_moduli, by_label, density_of, materials, without_moduli

YOUNG = np.array([3.0, 1.0, 3.0, 2.0, 8.0])


def by_cell(table, name="young"):
    """A constant of each cell."""
    return getattr(table, name)[table.of_cell]


def test_equal_pairs_are_one_material():
    table = materials(YOUNG, [0.3, 0.3, 0.4, 0.3, 0.3], 5)
    assert table.young.tolist() == [1.0, 2.0, 3.0, 3.0, 8.0]
    assert table.nu.tolist() == [0.3, 0.3, 0.3, 0.4, 0.3]
    assert table.of_cell.tolist() == [2, 0, 3, 1, 4]
    assert table.binning is None
    assert materials(2.0, 0.3, 4).of_cell.tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize(
    ("young", "nu", "match"),
    [
        ([1.0, 0.0, 2.0], 0.3, "above 0 kPa, got 1 invalid values, the first 0 in cell 1"),
        ([1.0, np.nan, 2.0], 0.3, "above 0 kPa"),
        ([1.0, np.inf, 2.0], 0.3, "above 0 kPa"),
        (1.0, 0.5, "-1 < nu < 0.5, got 3 invalid values"),
        (1.0, [0.3, -1.0, 0.3], "got 1 invalid values, the first -1 in cell 1"),
        (1.0, [0.3, np.nan, 0.3], "-1 < nu < 0.5"),
        ([1.0, 2.0], 0.3, "expected one value for each of 3 cells"),
    ],
)
def test_values_out_of_range(young, nu, match):
    with refusal(match):
        materials(young, nu, 3)


def test_bins_of_equal_width_hold_the_mean_by_volume():
    size, young = np.array([1.0, 1.0, 3.0, 1.0, 1.0]), np.array([1.0, 2.0, 3.0, 7.0, 9.0])
    table = bin_moduli(materials(young, 0.3, 5), size, 2)  # halves: 1 to 5, 5 to 9
    assert table.young.tolist() == [(1.0 + 2.0 + 9.0) / 5.0, 8.0]
    assert table.of_cell.tolist() == [0, 0, 0, 1, 1]
    off = np.abs(by_cell(table) / young - 1.0)
    assert table.binning == pytest.approx(((off * size).sum() / 7.0, off.max()))
    # As stiff altogether as before.
    assert by_cell(table) @ size == pytest.approx(young @ size)


@pytest.mark.parametrize(
    ("moduli", "count", "spacing", "of_cell"),
    [
        ([1.0, 2.0, 4.0, 8.0, 1024.0, 512.0], 2, "quantile", [0, 0, 0, 1, 1, 1]),
        ([1.0, 2.0, 4.0, 8.0, 1024.0, 512.0], 2, "log", [0, 0, 0, 0, 1, 1]),  # halves at 2^5
        ([1.0, 9.0, 30.0, 100.0], 2, "log", [0, 0, 1, 1]),  # at 10; at 30.25 of square roots
        # the third quarter is empty
        ([1.0, 2.0, 4.0, 8.0, 1024.0, 512.0], 4, "equal", [0, 0, 0, 0, 2, 1]),
    ],
)
def test_bins_by_number_and_by_logarithm(moduli, count, spacing, of_cell):
    exact = materials(moduli, 0.3, len(moduli))
    table = bin_moduli(exact, np.ones(len(moduli)), count, spacing)
    assert table.of_cell.tolist() == of_cell
    means = [np.mean(np.array(moduli)[np.equal(of_cell, k)]) for k in range(max(of_cell) + 1)]
    assert table.young.tolist() == means


def test_enough_bins_change_nothing():
    exact = materials(YOUNG, 0.3, 5)
    table = bin_moduli(exact, np.ones(5), 4)
    assert_array_equal(table.young, exact.young)
    assert table.binning == (0.0, 0.0)


def test_ratios_by_label_are_not_blended():
    ratios = np.repeat([0.3, 0.45], 5)
    table = bin_moduli(materials(np.arange(1.0, 11.0), ratios, 10), np.ones(10), 3)
    assert set(table.nu) == {0.3, 0.45}
    assert_array_equal(by_cell(table, "nu"), ratios)
    many = bin_moduli(materials(1.0, np.linspace(0.0, 0.4, 9), 9), np.ones(9), 2)
    assert len(many.nu) == 2


@pytest.mark.parametrize(
    ("count", "spacing", "match"), [(0, "equal", "1 or more"), (3, "cubic", "equal, quantile, log")]
)
def test_bins_that_are_none(count, spacing, match):
    with refusal(match):
        bin_moduli(materials(YOUNG, 0.3, 5), np.ones(5), count, spacing)


# By label, from an image or from means


def test_values_by_label():
    for mapping, labels, expected in (
        (ByLabel({1: 2.5, 0: 1.0}), [0, 1, 1], [1.0, 2.5, 2.5]),
        (ByLabel({1: 2.5}, 7.0), [0, 1, 9], [7.0, 2.5, 7.0]),
    ):
        assert by_label(mapping, np.array(labels)).tolist() == expected
    for labels, words in (
        (np.array([0, 1, 3]), r"got 1, but the mesh also has 0, 3 \(2 more\); give values for"),
        (None, "has no labels"),
    ):
        with refusal(words):
            by_label(ByLabel({1: 2.5}), labels)


def test_values_by_name():
    names, labels = {0: "air", 3: "left lung", 5: "liver", 8: "liver"}, np.array([0, 3, 5, 8])
    for values, expected in (
        ({"Left_Lung": 2.5, "liver": 4.0}, [1.0, 2.5, 4.0, 4.0]),
        ({3: 2.5, "liver_8": 4.0}, [1.0, 2.5, 1.0, 4.0]),
    ):
        assert by_label(ByLabel(values, 1.0), labels, names).tolist() == expected
    for mapping, known, words in (
        (ByLabel({3: 2.5, "left lung": 4.0}), names, r"label 3 \(left lung\) has two values"),
        (
            ByLabel({"liver": 4.0}),
            names,
            r"got liver, but the mesh also has 0 \(air\), 3 \(left lung\)",
        ),
        (ByLabel({"left lnug": 4.0}, 1.0), names, "did you mean left lung"),
        (ByLabel({"liver": 4.0}, 1.0), {}, "labels have no names"),
    ):
        with refusal(words):
            by_label(mapping, labels, known)


def test_a_model_s_table_names_mappings_and_sets():
    model = sample_model()
    table = {"1": {"name": "bright/ball"}, "0": {"name": "rest"}, "9": {"name": "far"}}
    named = build_model(
        model.mesh,
        young="bright/ball=5,*=2",
        nu="rest=0.3,far=0.1,*=0.4",
        cell_data=model.cell_data,
        about={"label_table": table},
    )
    is_bright = model.cell_data["label"] == 1
    assert_array_equal(young_of(named), np.where(is_bright, 5.0, 2.0))
    assert_array_equal(by_cell(named.materials, "nu"), np.where(is_bright, 0.4, 0.3))
    assert set(named.sets.cells) == {"rest", "bright_ball"}
    interface = named.sets.facets["interface_rest_bright_ball"]
    assert_array_equal(interface, model.sets.facets["interface_0_1"])


def test_the_mean_of_the_mapping_and_the_mapping_of_the_mean():
    image, mesh = sample_image(), sample_model().mesh
    fields = sample_model().cell_data
    by_image = build_model(mesh, image, young="1 + h**2", average="mean")
    by_mean = build_model(mesh, young="1 + h**2", cell_data=fields)
    young = young_of(by_image)
    assert_allclose(young, cell_values(image, mesh, lambda h: 1.0 + h**2), rtol=1e-14)
    assert_allclose(young, 1.0 + fields["mean"] ** 2 + fields["variance"], rtol=1e-9)
    flat = young_of(by_mean)
    assert_allclose(flat, 1.0 + fields["mean"] ** 2, rtol=1e-14)
    assert (young > flat + 1.0).any()


def test_constants_are_one_material():
    """Whatever the means over many voxels would round to; also where a mapping is constant in a
    cell.
    """
    image, mesh = sample_image(), sample_model().mesh
    for young, nu in (
        ("0.7", "0.49"),
        (0.7, 0.49),
        ("0.7 + 0*h", "0.49 + 0*h"),
        ([(0, 0.7), (1, 0.7)], 0.49),
    ):
        table = build_model(mesh, image, young=young, nu=nu).materials
        assert (table.young.tolist(), table.nu.tolist()) == ([0.7], [0.49])
    assert build_model(mesh, young="3").materials.young.tolist() == [3.0]  # needs no image
    assert len(build_model(mesh, image, young="1 + h/7", nu="0.49", bins=4).materials.young) == 4


def test_ratios_may_be_negative_and_mappings():
    mesh, image = sample_model().mesh, sample_image()
    table = build_model(mesh, image, young=2.0, nu="-0.3 + h / 100").materials
    assert table.nu.min() < 0.0 < table.nu.max()
    for young, nu, source, words in (
        (2.0, "h", image, r"-1 < nu < 0\.5"),
        (2.0, "1 / h", image, "no value at intensity 0"),
        ("h - 10", 0.45, image, "expected 0 kPa or more"),
        ("h", 0.45, None, "the mesh has no cell means"),
    ):
        with refusal(words):
            build_model(mesh, source, young=young, nu=nu)


def test_one_mapping_for_each_label_and_one_number_a_cell():
    model = sample_model()
    labels = model.cell_data["label"]
    table = build_model(
        model.mesh, young="0=1.5,1=4", nu="0=0.45,1=0.3", cell_data=model.cell_data
    ).materials
    assert_array_equal(by_cell(table), np.where(labels == 1, 4.0, 1.5))
    assert_array_equal(by_cell(table, "nu"), np.where(labels == 1, 0.3, 0.45))
    moduli = np.linspace(1.0, 2.0, len(labels))
    for values in (moduli, moduli.tolist()):
        table = build_model(model.mesh, young=values, nu=np.float32(0.25)).materials
        assert_array_equal(by_cell(table), moduli)
        assert set(table.nu) == {0.25}


# Densities


def test_cells_of_another_density_are_of_another_material():
    table = materials([2.0, 1.0, 1.0, 2.0], 0.3, 4, [1000.0, 1000.0, 1500.0, 1000.0])
    assert table.young.tolist() == [1.0, 1.0, 2.0]
    assert table.density.tolist() == [1000.0, 1500.0, 1000.0]
    assert table.of_cell.tolist() == [2, 0, 1, 2]
    alone = without_moduli(table)
    assert (alone.young.tolist(), alone.density.tolist()) == ([1.0, 1.0], [1000.0, 1500.0])
    assert materials(1.0, 0.3, 2).density is None
    fewer = bin_moduli(materials([1.0, 2.0, 3.0], 0.3, 3, [900.0, 1000.0, 2000.0]), np.ones(3), 2)
    assert np.unique(fewer.density).tolist() == [950.0, 2000.0]


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.nan, np.inf])
def test_densities_that_are_none(wrong):
    with refusal("density: expected kg/m3 above 0, got 1 invalid values"):
        materials(1.0, 0.3, 2, [1000.0, wrong])
    with refusal("gravity: the cells have no density; give `density`"):
        density_of(materials(1.0, 0.3, 2))


def test_density_by_mapping_by_label_and_from_the_moduli_s_file(tmp_path):
    mesh = sample_model().mesh
    fields = sample_model().cell_data
    labels, mean = fields["label"], fields["mean"]
    path = tmp_path / "tissues.csv"
    path.write_text("label,young,nu,density\n0,1,0.45,1000\n1,9,0.3,1900\n")
    expected = np.where(labels == 1, 1900.0, 1000.0)
    for young, density, values in (
        (str(path), None, expected),
        (2.0, "0=1000,1=1900", expected),
        (2.0, "1000 + 2*h", 1000.0 + 2.0 * mean),
        (2.0, 1060, np.full(len(mean), 1060.0)),
    ):
        table = build_model(mesh, young=young, density=density, cell_data=fields).materials
        assert_allclose(by_cell(table, "density"), values, rtol=1e-14)
    assert build_model(mesh, young=2.0, cell_data=fields).materials.density is None
    with refusal("a material also needs a modulus; give `young`"):
        build_model(mesh, density=1000.0)
