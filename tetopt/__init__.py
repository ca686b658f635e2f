"""tetopt: from a medical volume straight to an image-aligned tetrahedral mesh, without
segmentation.
"""

__version__ = "0.1.0"

import os

import lazy_loader

from tetopt.system.cache import place_cache

# Before numba, and OpenMP with it, is loaded. Threads sleep while they wait, rather than spin: two
# runs at a time on two cores take 1.5 s each instead of 11 (500 nodes, labels); alone, one of
# 15,000 nodes 15.3 instead of 19 CPU s.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
place_cache()

# the names are in __init__.pyi
# and loaded on first use: `tetopt --help` needs no kernels
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
