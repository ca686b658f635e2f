"""What the tests of the views look at: a tilted volume and a lattice of it."""

import numpy as np
import pytest

import tetopt

# Neither upright nor right-angled, one axis flipped: what is not taken through the affine comes out
# elsewhere.
TILTED = np.array(
    [[-1.9, 0.5, 0.3, 40.0], [0.4, 1.8, -0.5, -20.0], [0.3, 0.4, 2.6, 3.0], [0.0, 0.0, 0.0, 1.0]]
)


@pytest.fixture(scope="session")
def image():
    return tetopt.Image(
        np.random.default_rng(0).integers(0, 200, (16, 18, 14)).astype(float), TILTED
    )


@pytest.fixture(scope="session")
def mesh(image):
    return tetopt.lattice_mesh(image, nodes=300)
