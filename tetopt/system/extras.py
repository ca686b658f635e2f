"""The command that installs optional libraries."""

from __future__ import annotations


def install_hint(*packages: str) -> str:
    """Return the command that installs packages; the newest of each fits tetopt's extras, which
    have lower bounds only.

    Packages are named, because ``pip install "tetopt[...]"`` works only where an index has tetopt.

    Examples
    --------
    >>> install_hint("pydicom", "python-gdcm")
    'pip install "pydicom" "python-gdcm"'
    """
    return " ".join(["pip install", *(f'"{package}"' for package in packages)])
