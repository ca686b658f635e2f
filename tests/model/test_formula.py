"""Formulas of h: the arithmetic of Python and numpy, and nothing else let in."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

import tetopt
from tetopt.model.formula import parse_formula
from tetopt.model.mappings import parse_mapping, young_from

H = np.array([[0.5, 1.0, 2.0], [3.0, 10.0, 250.0]])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("h", H),
        (" 3 ", np.full_like(H, 3.0)),
        ("0.5 + 0.01*h", 0.5 + 0.01 * H),
        ("-h**2 / 4 - +1", -(H**2) / 4 - 1),
        ("2**-h", 2.0**-H),
        ("(1 + h) * exp(-h/10)", (1 + H) * np.exp(-H / 10)),
        (
            "max(min(h, 5), abs(h - 3)) + sqrt(h) * log(h)",
            np.maximum(np.minimum(H, 5), abs(H - 3)) + H**0.5 * np.log(H),
        ),
        ("1/2*h", 0.5 * H),
        ("where(h < 1.5, 2*h**2.5, 3*h**1.64)", np.where(H < 1.5, 2 * H**2.5, 3 * H**1.64)),
        ("(h < 1.5)*2*h + (1.5 <= h)*3", np.where(H < 1.5, 2 * H, 3)),
        (
            "2 * where(1 < h <= 3 or h == 250, where(h >= 2 and h != 3, -h, 0), 7)",
            2.0 * np.choose(np.isin(H, [2, 250]) + 2 * np.isin(H, [0.5, 1, 10]), [0 * H, -H, 7]),
        ),
    ],
)
def test_values(text, expected):
    values = parse_formula(text)(H)
    assert values.shape == H.shape
    assert values.dtype == np.float64
    assert_allclose(values, expected, rtol=1e-15)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "h +",
        "x",
        "__import__('os')",
        "h.size",
        "h[0]",
        "lambda: 1",
        "[h]",
        "'h'",
        "True",
        "1j",
        "h if h else 1",
        "h < 2",
        "h @ h",
        "h // 2",
        "h & 1",
        "~h",
        "not h",
        "sum(h)",
        "max(h)",
        "abs(h, 2)",
        "max(h, 1, 2)",
        "where(h < 1, 2)",
        "where(h in 1, 2, 3)",
        "abs(x=h)",
        "min(*h)",
        "h; h",
        "h = 1",
        "(h := 2)",
        "f'{h}'",
        "abs",
        "...",
        "None",
        "(" * 300 + "h" + ")" * 300,
        "\0",
        "h" + "+h" * 20000,
        "h" + "+h" * 983,
        "-" * 983 + "h",
        "1" + "0" * 400,
        "1if h else 2",
        "h +\n x",
    ],
)
def test_refuses(text):
    with refusal("formula") as caught:
        parse_formula(text)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("2*HU", "write h "),
        ("h^2", r"write \*\* "),
        ("2*HU^3", r"write h .*write \*\* "),
        ("h < 2", "where"),
    ],
)
def test_other_programs_words_are_named(text, said):
    with refusal(said):
        parse_formula(text)


def test_a_negative_base_is_named():
    with refusal("nan at intensity -8 .*negative"):
        young_from(parse_formula("h**1.64"), np.array([-8.0, 1.0]))


@pytest.mark.parametrize(("text", "value"), [("10**20", 1e20), ("9**9**9**9", np.inf)])
def test_powers_are_floats(text, value):
    assert parse_formula(text)(np.array([1.0])) == value


@given(st.text(alphabet="h0123456789.+-*/()absqrtexplogminmaxwhere<>=!d, ", max_size=24))
def test_any_text_is_a_mapping_or_an_input_error(text):
    try:
        mapping = parse_formula(text)
    except tetopt.InputError:
        return
    assert mapping(H).shape == H.shape


def test_no_value_is_refused_with_the_intensity():
    with refusal("inf at intensity 0"):
        young_from(parse_formula("1/h"), np.array([0.0, 1.0]))


def test_mapping_is_a_table_or_a_formula():
    assert_array_equal(young_from(parse_mapping("0:1,100:5"), [50.0]), [3.0])
    assert_array_equal(young_from(parse_mapping("max(h, 60)"), [50.0]), [60.0])


@pytest.mark.parametrize(
    "text", ["h" * 10**6, "+".join("h" * 10**5), "(" * 5000 + "h" + ")" * 5000, "9" * 10_001]
)
def test_formulas_without_end(text):
    with refusal("expected at most 10000 characters"):
        parse_formula(text)
