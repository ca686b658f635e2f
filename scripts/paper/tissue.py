"""Tissue labels of the MNI152 brain, from the maps in nilearn's wheel."""

from __future__ import annotations

import numpy as np

from tetopt.image import Image
from tetopt.io.images import load_image
from tetopt.io.mni import mni_path


def mni_tissue() -> Image:
    """Return tissue labels of the MNI152 brain: 0 background, 1 CSF and other, 2 grey matter, 3
    white matter.

    Each voxel where the T1 is not 0 gets the most probable of the three; CSF gets the remaining
    probability.

    Raises
    ------
    InputError
        Without nilearn.
    """
    t1, grey, white = (load_image(mni_path(contrast)) for contrast in ("t1", "gm", "wm"))
    g = grey.data.astype(np.int64)
    w = white.data.astype(np.int64)
    return Image(np.where(t1.data > 0, 1 + np.argmax([255 - g - w, g, w], axis=0), 0), t1.affine)
