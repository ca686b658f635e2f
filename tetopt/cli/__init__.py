"""The ``tetopt`` command: file in, file out. Thin: every number comes from the library."""

from tetopt.cli.app import main

__all__ = ["main"]
