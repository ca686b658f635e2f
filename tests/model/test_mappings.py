"""Mappings from intensity to modulus: of arrays, in words, in files."""

import numpy as np
import pytest
from models import sample_model
from numpy.testing import assert_array_equal
from refusals import refusal

from tetopt import InputError
from tetopt.model.build import build_model
from tetopt.model.mappings import (
    ByLabel,
    has_column,
    load_mapping,
    parse_any_mapping,
    parse_mapping,
    young_from,
)

TABLE = [(-50.0, 2.0), (0.0, 1.0), (100.0, 5.0)]


def test_a_table_is_linear_between_its_pairs_and_constant_beyond_them():
    moduli = young_from(TABLE, [[-1e9, -50.0, -25.0], [50.0, 100.0, 1e9]])
    assert_array_equal(moduli, [[2.0, 2.0, 1.5], [3.0, 5.0, 5.0]])
    assert_array_equal(young_from(np.array(TABLE), [0.0]), [1.0])
    assert_array_equal(young_from([(7.0, 3.0)], [-1.0, 7.0, 8.0]), [3.0, 3.0, 3.0])


def test_no_mapping_takes_the_intensity_itself_and_a_copy_of_it():
    intensities = np.array([0.0, 1.5, 7.0])
    moduli = young_from(None, intensities)
    assert_array_equal(moduli, intensities)
    moduli[0] = 9.0
    assert intensities[0] == 0.0


def test_a_function_sees_float64_and_may_return_whole_numbers():
    seen = []

    def mapping(h):
        seen.append(h.dtype)
        return np.full(h.shape, 3)

    moduli = young_from(mapping, np.array([1, 2], dtype=np.uint8))
    assert seen == [np.float64]
    assert moduli.dtype == np.float64
    assert_array_equal(moduli, [3.0, 3.0])


# Messages


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ([(0, 1), (0, 2)], "intensities must increase, got 0 and then 0"),
        ([1.0, 2.0], "mapping: expected pairs (intensity, kPa), got an array of shape (2,)"),
        ("soft", "mapping: expected pairs (intensity, kPa), got 'soft'"),
        ([(0, 1), (1,)], "mapping: expected pairs (intensity, kPa), got [(0, 1), (1,)]"),
        (
            [(0, 1), (5, np.nan)],
            "expected finite intensities and moduli, got [[0.0, 1.0], [5.0, nan]]",
        ),
        (
            [(0, -1), (10, 9)],
            "0 kPa or more, got 1 invalid values, such as -1 at intensity 0",
        ),
        (lambda h: 4.0 - h, "got 2 invalid values, such as -1 at intensity 5, -6 at intensity 10"),
        (lambda h: h.sum(), "got shape () for shape (3,)"),
    ],
)
def test_messages_of_mappings(mapping, message):
    with pytest.raises(InputError) as error:
        young_from(mapping, [0, 5, 10])
    assert message in str(error.value)
    assert "\n" not in str(error.value)


# From text and files


@pytest.mark.parametrize(
    "text", ["1=", "=2", "1=2,1=3", "1=2;2=3", "a=1,a=2", "1.5=2", "1=x", "*=1,*=2"]
)
def test_labels_that_are_none(text):
    with refusal("by label"):
        parse_any_mapping(text)


def test_a_mapping_of_the_intensity_alone():
    with refusal("expected a mapping of the intensity"):
        parse_mapping("1=2")


TOML = "intensity = [0, 50, 200]\nyoung = [0.5, 1, 6.0]\nnu = [0.45, 0.4, 0.49]\n"
CSV = "intensity, young, nu\n0,0.5,0.45\n50,1,0.4\n200,6.0,0.49\n"


@pytest.mark.parametrize(
    ("name", "text"), [("a.toml", TOML), ("a.csv", CSV), ("A.CSV", "\ufeff" + CSV + "\n")]
)
def test_tables_from_files(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    assert parse_any_mapping(str(path)) == [(0.0, 0.5), (50.0, 1.0), (200.0, 6.0)]
    assert load_mapping(path, "nu") == [(0.0, 0.45), (50.0, 0.4), (200.0, 0.49)]


def test_labels_from_a_file(tmp_path):
    (tmp_path / "a.csv").write_text("label,young\n3,2.5\n0,1\n")
    assert load_mapping(tmp_path / "a.csv") == ByLabel({3: 2.5, 0: 1.0})
    for head in ("name", "label"):
        (tmp_path / "n.csv").write_text(f"{head},young\nleft lung,2.5\n7,1\n*,3\n")
        assert load_mapping(tmp_path / "n.csv") == ByLabel({"left lung": 2.5, 7: 1.0}, 3.0)
    (tmp_path / "n.toml").write_text('name = ["liver", "*"]\nyoung = [5, 20]\n')
    assert load_mapping(tmp_path / "n.toml") == ByLabel({"liver": 5.0}, 20.0)
    (tmp_path / "b.csv").write_text("Label,Young,Nu\n3,2.5,0.3\n*,1,0.45\n")
    assert load_mapping(tmp_path / "b.csv") == ByLabel({3: 2.5}, 1.0)
    assert has_column(str(tmp_path / "b.csv"), "nu")
    assert not has_column(str(tmp_path / "a.csv"), "nu")
    table = build_model(
        sample_model().mesh, young=str(tmp_path / "b.csv"), cell_data={"label": np.full(192, 3)}
    ).materials
    assert (table.young.tolist(), table.nu.tolist()) == ([2.5], [0.3])


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("a.toml", "intensity = [0, 50]\nyoung = [1]", "2 of intensity and 1 of young"),
        ("a.toml", "intensity = [0, 50, 50]\nyoung = [1, 2, 3]", "must increase"),
        ("a.toml", "intensity = [0, 'x']\nyoung = [1, 2]", "columns of numbers"),
        ("a.toml", "not toml", "expected TOML"),
        (
            "a.toml",
            "h = [1]\nyoung = [1]",
            'expected columns "young" and one of "intensity", "label" and "name", found h, young',
        ),
        ("a.csv", "intensity,nu\n1,2\n", "found intensity, nu"),
        ("a.csv", "intensity,young\n", "got an array of shape|expected pairs"),
        ("a.csv", "intensity,young\n1,2,3\n", "row of names"),
        ("a.csv", "intensity,young\n1,x\n", "columns of numbers"),
        ("a.csv", "intensity;young\n1;2,1\n", "write 2.1 for 2,1"),
        ("a.csv", "intensity,young\n1,nan\n", "expected finite"),
        ("a.csv", "label,young\n1,2\n1,3\n", "label 1 has two values"),
        ("a.csv", "label,young\n1.5,2\n", "columns of numbers"),
        ("a.csv", "label,young,young\n1,2,3\n", "each column once"),
        ("a.toml", "label = [1, nan]\nyoung = [1, 2]", "columns of numbers"),
        ("a.toml", "young = " + 3000 * "[" + 3000 * "]", "nested too deeply"),
        ("a.csv", "label,intensity,young\n1,2,3\n", "one of"),
    ],
)
def test_files_that_are_none(tmp_path, name, text, match):
    (tmp_path / name).write_text(text)
    with refusal(match):
        load_mapping(tmp_path / name)
    with refusal("no such file"):
        load_mapping(tmp_path / "no.csv")


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_separators_of_csv(tmp_path, separator):
    (tmp_path / "a.csv").write_text(CSV.replace(",", separator))
    assert load_mapping(tmp_path / "a.csv", "nu") == [(0.0, 0.45), (50.0, 0.4), (200.0, 0.49)]


def test_csv_of_another_encoding(tmp_path):
    (tmp_path / "a.csv").write_bytes("name,young\nMäuse,2\n".encode("latin-1"))
    with refusal(r'expected UTF-8 text, .* in Excel as "CSV UTF-8"'):
        load_mapping(tmp_path / "a.csv")


def test_a_table_must_increase():
    with refusal("must increase, got 5 and then 3"):
        parse_any_mapping("5:1,3:2")


def test_other_names_than_h():
    with refusal('cannot use "x"'):
        parse_any_mapping("1 + x")
