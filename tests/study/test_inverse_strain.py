"""1 / strain, in place of a modulus."""

import numpy as np
import pytest

from tetopt import Image, InputError
from tetopt.model.averages import young_image
from tetopt.study.paper import inverse_strain


def test_inverse_strain():
    modulus = inverse_strain(np.array([[0.02, -0.01], [0.0, 1e-9]], dtype=np.float32), floor=1e-3)
    np.testing.assert_allclose(modulus, [[50.0, 100.0], [1000.0, 1000.0]], rtol=1e-6)
    assert modulus.dtype == np.float64


def test_inverse_strain_is_a_mapping():
    image = Image(np.array([[0.01, -0.02], [0.0, 0.5]]))
    modulus = young_image(image, lambda strain: inverse_strain(strain, 0.005)).data
    np.testing.assert_allclose(modulus, [[100.0, 50.0], [200.0, 2.0]], rtol=1e-14)


@pytest.mark.parametrize("floor", [0.0, -1.0, np.nan, np.inf])
def test_message_of_the_floor(floor):
    with pytest.raises(InputError) as error:
        inverse_strain([0.1], floor)
    assert str(error.value) == f"floor: expected a strain above 0, such as 0.001, got {floor}"


def test_message_of_strains():
    with pytest.raises(InputError) as error:
        inverse_strain([0.1, np.nan, np.inf], 1e-3)
    assert str(error.value) == "strain: 2 values are NaN or infinite; replace them, 0 stands for stiff"
