"""The MNI152 template in nilearn's wheel: a brain for examples, without a download."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Literal

import numpy as np

from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.images import load_image
from tetopt.system.extras import install_hint


def mni_path(contrast: Literal["t1", "gm", "wm"]) -> Path:
    """Return the file of the T1, or of grey or white matter's probability times 255; InputError
    without nilearn.
    """
    package = importlib.util.find_spec("nilearn")
    name = f"datasets/data/mni_icbm152_{contrast}_tal_nlin_sym_09a_converted.nii.gz"
    path = (
        Path(package.origin).parent / name if package is not None and package.origin else Path(name)
    )
    if not path.is_file():
        raise InputError(
            f"the MNI152 brain comes with nilearn: {install_hint('nilearn')}, or give an image"
        )
    return path


def mni_tissue() -> Image:
    """Return tissue labels of the MNI152 brain: 0 background, 1 CSF and other, 2 grey matter, 3
    white matter.

    Each voxel where the T1 is not 0 gets the most probable of the three; CSF gets the remaining
    probability.

    Raises
    ------
    InputError
        For the reasons of `mni_path`.
    """
    t1, grey, white = (load_image(mni_path(contrast)) for contrast in ("t1", "gm", "wm"))
    g = grey.data.astype(np.int64)
    w = white.data.astype(np.int64)
    return Image(np.where(t1.data > 0, 1 + np.argmax([255 - g - w, g, w], axis=0), 0), t1.affine)
