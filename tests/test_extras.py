"""What is not installed is asked for by packages that an index has."""

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from tetopt.system.extras import install_hint

pytestmark = pytest.mark.full

PYPROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS = {
    name: [each for each in requirements if not each.startswith("tetopt[")]
    for name, requirements in PYPROJECT["project"]["optional-dependencies"].items()
}


@pytest.fixture(autouse=True)
def _stated(monkeypatch):
    """The metadata as a wheel of these sources has it, the names spelt as PyPA normalises them."""
    lines = [
        f"{name.lower()}{f'{condition} and' if condition else ';'} extra == '{extra}'"
        for extra, those in EXTRAS.items()
        for name, condition in (re.fullmatch("([^;]+)(;.*)?", each).groups() for each in those)
    ]
    monkeypatch.setattr(metadata, "requires", lambda _: ["numpy>=1.26", *lines])


@pytest.mark.parametrize("extra", EXTRAS)
def test_packages_of_an_extra_with_their_versions(extra):
    packages = [re.split("[<>=]", each)[0] for each in EXTRAS[extra]]
    wanted = [each.partition(";")[0] for each in EXTRAS[extra]]
    assert install_hint(extra, *packages) == " ".join(["pip install", *(f'"{each}"' for each in wanted)])


def test_each_hint_names_an_extra_and_packages_of_it():
    """Of all hints in the sources; a name that the extra has not would be asked for in any version."""
    root, calls = Path(__file__).parents[1] / "tetopt", []
    for path in root.glob("*/*.py"):
        calls += re.findall(r"""install_hint\(["'](\w+)["'], (["'][^)]+)\)""", path.read_text(encoding="utf-8"))
    assert len(calls) >= 6
    for extra, words in calls:
        names = re.findall(r"[\w-]+", words)
        assert install_hint(extra, *names).count(">=") == len(names), (extra, names)


def test_no_message_asks_for_tetopt_from_an_index():
    texts = [
        path.read_text(encoding="utf-8")
        for path in (Path(__file__).parents[1] / "tetopt").glob("*/*.py")
        if path.name != "extras.py"
    ]
    assert not any(re.search(r"pip install [^\n]{0,3}tetopt", text) for text in texts)


def test_without_metadata_the_packages_are_named_all_the_same(monkeypatch):
    def missing(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "requires", missing)
    assert install_hint("itk", "SimpleITK") == 'pip install "SimpleITK"'
