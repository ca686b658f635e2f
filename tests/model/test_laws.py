"""Laws from intensity to modulus."""

import numpy as np
import pytest

from tetopt import InputError
from tetopt.model.laws import young_from

TABLE = [(-50.0, 2.0), (0.0, 1.0), (100.0, 5.0)]


def test_a_table_is_linear_between_its_pairs_and_constant_beyond_them():
    moduli = young_from(TABLE, [[-1e9, -50.0, -25.0], [50.0, 100.0, 1e9]])
    np.testing.assert_array_equal(moduli, [[2.0, 2.0, 1.5], [3.0, 5.0, 5.0]])
    np.testing.assert_array_equal(young_from(np.array(TABLE), [0.0]), [1.0])
    np.testing.assert_array_equal(young_from([(7.0, 3.0)], [-1.0, 7.0, 8.0]), [3.0, 3.0, 3.0])


def test_no_law_takes_the_intensity_itself_and_a_copy_of_it():
    intensities = np.array([0.0, 1.5, 7.0])
    moduli = young_from(None, intensities)
    np.testing.assert_array_equal(moduli, intensities)
    moduli[0] = 9.0
    assert intensities[0] == 0.0


def test_a_function_sees_float64_and_may_return_whole_numbers():
    seen = []

    def law(h):
        seen.append(h.dtype)
        return np.full(h.shape, 3)

    moduli = young_from(law, np.array([1, 2], dtype=np.uint8))
    assert seen == [np.float64]
    assert moduli.dtype == np.float64
    np.testing.assert_array_equal(moduli, [3.0, 3.0])


def test_a_function_equal_to_a_table_gives_the_same():
    h = np.linspace(-50.0, 100.0, 31)
    np.testing.assert_allclose(
        young_from(TABLE, h), young_from(lambda x: np.where(x < 0, 1.0 - x / 50.0, 1.0 + x / 25.0), h), rtol=1e-14
    )


# Messages


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (
            [(0, 1), (0, 2)],
            "law: intensities must increase, got 0 and then 0; sort the pairs and give each intensity once",
        ),
        (
            [(0, 1), (9, 2), (5, 3)],
            "law: intensities must increase, got 9 and then 5; sort the pairs and give each intensity once",
        ),
        ([], "law: expected pairs (intensity, kPa), got an array of shape (0,)"),
        ([1.0, 2.0], "law: expected pairs (intensity, kPa), got an array of shape (2,)"),
        ([(1, 2, 3)], "law: expected pairs (intensity, kPa), got an array of shape (1, 3)"),
        ("soft", "law: expected pairs (intensity, kPa), got 'soft'"),
        ([(0, 1), (1,)], "law: expected pairs (intensity, kPa), got [(0, 1), (1,)]"),
        ([(0, 1), (5, np.nan)], "law: every intensity and modulus must be finite, got [[0.0, 1.0], [5.0, nan]]"),
        (
            [(0, -1), (10, 9)],
            "modulus: expected 0 kPa or more, got 1 others, such as -1 at intensity 0; "
            "give a law (--young) that is positive over the image's range",
        ),
        (
            lambda h: 4.0 - h,
            "modulus: expected 0 kPa or more, got 2 others, such as -1 at intensity 5, -6 at intensity 10; "
            "give a law (--young) that is positive over the image's range",
        ),
        (
            lambda h: np.where(h > 5, np.inf, 1.0),
            "modulus: expected 0 kPa or more, got 1 others, such as inf at intensity 10; "
            "give a law (--young) that is positive over the image's range",
        ),
        (
            lambda h: h.sum(),
            "law: expected a function that returns one value for each intensity, got shape () for shape (3,)",
        ),
    ],
)
def test_messages_of_laws(law, message):
    with pytest.raises(InputError) as error:
        young_from(law, [0, 5, 10])
    assert str(error.value) == message
