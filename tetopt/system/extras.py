"""Commands that install the optional libraries of tetopt."""

from __future__ import annotations

import re
from importlib import metadata

# A line of the metadata: "name>=1.0; extra == 'itk'", or with a condition on Python before the extra.
REQUIREMENT = re.compile(
    r"(?P<name>[\w.-]+) *(?P<versions>[^;\[]*?) *;(?:[^;]+ and)? *extra *== *['\"](?P<extra>[\w.-]+)['\"]"
)


def install_hint(extra: str, *packages: str) -> str:
    """Return the command that installs packages of one of tetopt's extras, in the versions that tetopt requires.

    The command names the packages, because ``pip install "tetopt[...]"`` works only where an index has tetopt.

    Parameters
    ----------
    extra : str
        The extra that gives the versions; packages that it does not name get no version.
    *packages : str

    Returns
    -------
    str
        A command for any shell: double quotes keep both bash and Windows from reading > as a redirection.

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
    """Return the command that installs these requirements, quoted for any shell.

    Examples
    --------
    >>> pip_install("pytetwild", "numpy<2")
    'pip install "pytetwild" "numpy<2"'
    """
    return " ".join(["pip install", *(f'"{requirement}"' for requirement in requirements)])


def _normal(name: str) -> str:
    """Normalise a package's name (PyPA's rules), as metadata may spell it differently."""
    return re.sub(r"[-_.]+", "-", name).lower()
