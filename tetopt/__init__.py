"""tetopt: from a medical volume straight to an image-aligned tetrahedral mesh, without segmentation."""

__version__ = "0.1.0"

from importlib import import_module
from inspect import isfunction
from typing import Any

import lazy_loader

from tetopt.system.cache import place_cache

place_cache()  # before numba is loaded

_loaded, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # the names are in __init__.pyi


def __getattr__(name: str) -> Any:
    """Return a public name, loading its module on first use: `tetopt --help` needs no kernels."""
    value = _loaded(name)
    if isfunction(value):  # whoever calls it by this name may give it anything
        value = import_module("tetopt.system.public").checked(value)
    globals()[name] = value
    return value
