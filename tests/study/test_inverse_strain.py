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


def test_refusals():
    for floor in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match=f"expected a strain above 0, such as 0.001, got {floor}"):
            inverse_strain([0.1], floor)
    with pytest.raises(InputError, match="2 values are NaN or infinite"):
        inverse_strain([0.1, np.nan, np.inf], 1e-3)
