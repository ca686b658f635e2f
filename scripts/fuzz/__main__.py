"""`python -m fuzz`, with `scripts` on the path. What starts threads is told not to, before it
is imported.
"""

import os
import sys

for name in (
    "NUMBA_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS",
):
    os.environ[name] = "1"
os.environ["NUMBA_THREADING_LAYER"] = "workqueue"  # the one that outlives a fork
os.environ["MPLBACKEND"] = "agg"

from fuzz.campaign import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
