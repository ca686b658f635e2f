"""The MNI152 template in nilearn's wheel: a brain for examples, without a download."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Literal

from tetopt.errors import InputError
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
