"""The MNI152 template that nilearn's wheel carries: a brain to try things on, without a download."""

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
    """File of the T1, or of the grey or white matter's probability times 255; InputError without nilearn."""
    package = importlib.util.find_spec("nilearn")
    name = f"datasets/data/mni_icbm152_{contrast}_tal_nlin_sym_09a_converted.nii.gz"
    path = Path(package.origin).parent / name if package is not None and package.origin else Path(name)
    if not path.is_file():
        raise InputError(f"the MNI152 brain is in nilearn's wheel: {install_hint('demo', 'nilearn')}, or give an image")
    return path


def mni_tissue() -> Image:
    """Tissue labels of the MNI152 brain: 0 background, 1 CSF and other, 2 grey matter, 3 white matter.

    Each voxel where the T1 is not 0 gets the likeliest of the three, CSF being what the other two leave.

    Raises
    ------
    InputError
        As `mni_path`.
    """
    t1, grey, white = (load_image(mni_path(contrast)) for contrast in ("t1", "gm", "wm"))
    g, w = grey.data.astype(np.int64), white.data.astype(np.int64)
    return Image(np.where(t1.data > 0, 1 + np.argmax([255 - g - w, g, w], axis=0), 0), t1.affine)
