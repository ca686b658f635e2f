"""Images that are read with their warnings."""

import warnings

import numpy as np

from tetopt.io.images import load_image

# Rotated, sheared, anisotropic and flipped (negative determinant), with an origin.
OBLIQUE = np.array(
    [
        [-0.75, 0.31, 1.10, 12.5],
        [0.12, 0.68, -0.90, -33.0],
        [0.05, -0.22, 5.10, 7.25],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def ramp(*shape, dtype=np.int16):
    """Every voxel another value, none 0, so that no swap of axes goes unseen."""
    return (np.arange(np.prod(shape)) + 1).reshape(shape).astype(dtype)


def read_warned(path, **options):
    """The image and the texts of `load_image`'s warnings, without the path."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        image = load_image(path, **options)
    return image, [
        str(each.message).removeprefix(f"{path}: ")
        for each in caught
        if issubclass(each.category, UserWarning)  # not nibabel's unclosed files
    ]
