"""How what is not installed with tetopt itself, but some of its work needs, can be installed."""

from __future__ import annotations

import re
from importlib import metadata

# A line of the metadata: "name>=1.0; extra == 'itk'", or with a condition on Python before the extra.
REQUIREMENT = re.compile(
    r"(?P<name>[\w.-]+) *(?P<versions>[^;\[]*?) *;(?:[^;]+ and)? *extra *== *['\"](?P<extra>[\w.-]+)['\"]"
)


def install_hint(extra: str, *packages: str) -> str:
    """The command that installs packages of one of tetopt's extras, of the versions that tetopt's metadata states.

    The packages themselves are named, as ``pip install "tetopt[...]"`` works only where an index has tetopt.

    Parameters
    ----------
    extra : str
        Whose versions are taken; packages that it does not name are asked for in any version.
    *packages : str

    Returns
    -------
    str
        To be pasted into any shell: in double quotes, within which neither bash nor Windows' takes > for a file.

    Examples
    --------
    >>> install_hint("itk", "SimpleITK")  # doctest: +ELLIPSIS
    'pip install "SimpleITK>=..."'
    """
    try:
        stated = metadata.requires("tetopt") or []
    except metadata.PackageNotFoundError:  # run from its sources
        stated = []
    matches = [match for line in stated if (match := REQUIREMENT.fullmatch(line)) and match["extra"] == extra]
    versions = {_normal(match["name"]): match["versions"] for match in matches}
    return pip_install(*(f"{package}{versions.get(_normal(package), '')}" for package in packages))


def pip_install(*requirements: str) -> str:
    """The command that installs these, quoted for any shell.

    Examples
    --------
    >>> pip_install("itk-cleaver", "numpy<2")
    'pip install "itk-cleaver" "numpy<2"'
    """
    return " ".join(["pip install", *(f'"{requirement}"' for requirement in requirements)])


def _normal(name: str) -> str:
    """A package's name as the metadata may spell it (PyPA's name normalisation)."""
    return re.sub(r"[-_.]+", "-", name).lower()
