"""``python -m tetopt`` is the ``tetopt`` command."""

import sys

from tetopt.cli import main

sys.exit(main())
