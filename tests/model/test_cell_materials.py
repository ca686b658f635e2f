"""Materials of cells, bins and their error."""

import numpy as np
import pytest
from models import sample_image, sample_model, young_of
from numpy.testing import assert_allclose, assert_array_equal

from tetopt.errors import InputError
from tetopt.model.averages import cell_values
from tetopt.model.build import build_model
from tetopt.model.mappings import ByLabel
from tetopt.model.materials import bin_moduli, by_label, density_of, materials, without_moduli

YOUNG = np.array([3.0, 1.0, 3.0, 2.0, 8.0])


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
        (1.0, 0.5, "-1 < nu < 0.5, got other values in 3 cells"),
        (1.0, [0.3, -1.0, 0.3], "got other values in 1 cells, the first -1 in cell 1"),
        (1.0, [0.3, np.nan, 0.3], "-1 < nu < 0.5"),
        ([1.0, 2.0], 0.3, "expected one value for each of 3 cells"),
    ],
)
def test_values_out_of_range(young, nu, match):
    with pytest.raises(InputError, match=match):
        materials(young, nu, 3)


def test_bins_of_equal_width_hold_the_mean_by_volume():
    size = np.array([1.0, 1.0, 3.0, 1.0, 1.0])
    table = bin_moduli(
        materials([1.0, 2.0, 3.0, 7.0, 9.0], 0.3, 5), size, 2
    )  # halves: 1 to 5, 5 to 9
    assert table.young.tolist() == [(1.0 + 2.0 + 9.0) / 5.0, 8.0]
    assert table.of_cell.tolist() == [0, 0, 0, 1, 1]
    off = np.abs(table.young[table.of_cell] / [1.0, 2.0, 3.0, 7.0, 9.0] - 1.0)
    assert table.binning.largest == pytest.approx(off.max())
    assert table.binning.mean == pytest.approx((off * size).sum() / 7.0)
    # As stiff altogether as before.
    assert (table.young[table.of_cell] * size).sum() == pytest.approx(1.0 + 2.0 + 9.0 + 7.0 + 9.0)


def test_bins_by_number_and_by_logarithm():
    exact = materials([1.0, 2.0, 4.0, 8.0, 1024.0, 512.0], 0.3, 6)
    by_number = bin_moduli(exact, np.ones(6), 2, "quantile")
    assert by_number.of_cell.tolist() == [0, 0, 0, 1, 1, 1]
    by_log = bin_moduli(exact, np.ones(6), 2, "log")  # halves at 2^5
    assert by_log.of_cell.tolist() == [0, 0, 0, 0, 1, 1]
    assert by_log.young.tolist() == [3.75, 768.0]
    wide = materials([1.0, 9.0, 30.0, 100.0], 0.3, 4)
    # at 10; at 30.25 of square roots
    assert bin_moduli(wide, np.ones(4), 2, "log").of_cell.tolist() == [0, 0, 1, 1]
    equal = bin_moduli(exact, np.ones(6), 4)  # the third quarter is empty
    assert equal.young.tolist() == [3.75, 512.0, 1024.0]


def test_enough_bins_change_nothing():
    exact = materials(YOUNG, 0.3, 5)
    table = bin_moduli(exact, np.ones(5), 4)
    assert_array_equal(table.young, exact.young)
    assert table.binning == (0.0, 0.0)


def test_ratios_by_label_are_not_blended():
    table = bin_moduli(
        materials(np.arange(1.0, 11.0), np.repeat([0.3, 0.45], 5), 10), np.ones(10), 3
    )
    assert set(table.nu) == {0.3, 0.45}
    assert_array_equal(table.nu[table.of_cell], np.repeat([0.3, 0.45], 5))
    many = bin_moduli(materials(1.0, np.linspace(0.0, 0.4, 9), 9), np.ones(9), 2)
    assert len(many.nu) == 2


@pytest.mark.parametrize(
    ("count", "spacing", "match"), [(0, "equal", "1 or more"), (3, "cubic", "equal, quantile, log")]
)
def test_bins_that_are_none(count, spacing, match):
    with pytest.raises(InputError, match=match):
        bin_moduli(materials(YOUNG, 0.3, 5), np.ones(5), count, spacing)


# By label, from an image or from means


def test_values_by_label():
    assert by_label(ByLabel({1: 2.5, 0: 1.0}), np.array([0, 1, 1])).tolist() == [1.0, 2.5, 2.5]
    assert by_label(ByLabel({1: 2.5}, 7.0), np.array([0, 1, 9])).tolist() == [7.0, 2.5, 7.0]
    with pytest.raises(
        InputError, match=r"got 1, but the mesh also has 0, 3 \(2 more\); give values for these"
    ):
        by_label(ByLabel({1: 2.5}), np.array([0, 1, 3]))
    with pytest.raises(InputError, match="has no labels"):
        by_label(ByLabel({1: 2.5}), None)


def test_values_by_name():
    names, labels = {0: "air", 3: "left lung", 5: "liver", 8: "liver"}, np.array([0, 3, 5, 8])
    mapping = ByLabel({"Left_Lung": 2.5, "liver": 4.0}, 1.0)
    assert by_label(mapping, labels, names).tolist() == [1.0, 2.5, 4.0, 4.0]
    assert by_label(ByLabel({3: 2.5, "liver_8": 4.0}, 1.0), labels, names).tolist() == [
        1.0,
        2.5,
        1.0,
        4.0,
    ]
    with pytest.raises(InputError, match=r"label 3 \(left lung\) has two values"):
        by_label(ByLabel({3: 2.5, "left lung": 4.0}), labels, names)
    with pytest.raises(
        InputError, match=r"got liver, but the mesh also has 0 \(air\), 3 \(left lung\)"
    ):
        by_label(ByLabel({"liver": 4.0}), labels, names)
    with pytest.raises(InputError, match="did you mean left lung"):
        by_label(ByLabel({"left lnug": 4.0}, 1.0), labels, names)
    with pytest.raises(InputError, match="labels have no names"):
        by_label(ByLabel({"liver": 4.0}, 1.0), labels)


def test_a_model_s_table_names_mappings_and_sets():
    model = sample_model(3)
    about = {
        "label_table": {"1": {"name": "bright/ball"}, "0": {"name": "rest"}, "9": {"name": "far"}}
    }
    named = build_model(
        model.mesh,
        young="bright/ball=5,*=2",
        nu="rest=0.3,far=0.1,*=0.4",
        cell_data=model.cell_data,
        about=about,
    )
    is_bright = model.cell_data["label"] == 1
    assert_array_equal(
        named.materials.young[named.materials.of_cell], np.where(is_bright, 5.0, 2.0)
    )
    assert_array_equal(named.materials.nu[named.materials.of_cell], np.where(is_bright, 0.4, 0.3))
    assert set(named.sets.cells) == {"rest", "bright_ball"}
    assert "interface_rest_bright_ball" in named.sets.facets
    assert_array_equal(
        named.sets.facets["interface_rest_bright_ball"], model.sets.facets["interface_0_1"]
    )


def test_the_mean_of_the_mapping_and_the_mapping_of_the_mean():
    image, mesh = sample_image(3), sample_model(3).mesh
    fields = sample_model(3).cell_data
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
    image, mesh = sample_image(3), sample_model(3).mesh
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
    image, mesh = sample_image(3), sample_model(3).mesh
    table = build_model(mesh, image, young=2.0, nu="-0.3 + h / 100").materials
    assert table.nu.min() < 0.0 < table.nu.max()
    with pytest.raises(InputError, match=r"-1 < nu < 0\.5"):
        build_model(mesh, image, young=2.0, nu="h")
    with pytest.raises(InputError, match="no value at intensity 0"):
        build_model(mesh, image, young=2.0, nu="1 / h")
    with pytest.raises(InputError, match="expected 0 kPa or more"):
        build_model(mesh, image, young="h - 10")
    with pytest.raises(InputError, match="the mesh has no cell means"):
        build_model(mesh, young="h")


def test_one_mapping_for_each_label_and_one_number_a_cell():
    model = sample_model(3)
    labels = model.cell_data["label"]
    table = build_model(
        model.mesh, young="0=1.5,1=4", nu="0=0.45,1=0.3", cell_data=model.cell_data
    ).materials
    assert_array_equal(table.young[table.of_cell], np.where(labels == 1, 4.0, 1.5))
    assert_array_equal(table.nu[table.of_cell], np.where(labels == 1, 0.3, 0.45))
    moduli = np.linspace(1.0, 2.0, len(labels))
    for values in (moduli, moduli.tolist()):
        table = build_model(model.mesh, young=values, nu=np.float32(0.25)).materials
        assert_array_equal(table.young[table.of_cell], moduli)
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
    with pytest.raises(
        InputError, match="density: expected kg/m3 above 0, got other values in 1 cells"
    ):
        materials(1.0, 0.3, 2, [1000.0, wrong])
    with pytest.raises(InputError, match="gravity: the cells have no density; give `density`"):
        density_of(materials(1.0, 0.3, 2))


def test_density_by_mapping_by_label_and_from_the_moduli_s_file(tmp_path):
    mesh = sample_model(3).mesh
    fields = sample_model(3).cell_data
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
        assert_allclose(table.density[table.of_cell], values, rtol=1e-14)
    assert build_model(mesh, young=2.0, cell_data=fields).materials.density is None
    with pytest.raises(InputError, match="a material also needs a modulus; give `young`"):
        build_model(mesh, density=1000.0)
