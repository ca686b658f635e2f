"""What is not installed is asked for by packages that an index has."""

import re
import tomllib
from pathlib import Path

import pytest

pytestmark = pytest.mark.full

PYPROJECT = tomllib.loads(
    (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
)
EXTRAS = {
    name: [each for each in requirements if not each.startswith("tetopt[")]
    for name, requirements in PYPROJECT["project"]["optional-dependencies"].items()
}


def test_hints_name_packages_of_extras():
    """An extra with an upper bound would need it in the hint as well."""
    root, named = Path(__file__).parents[1] / "tetopt", set()
    for path in root.glob("*/*.py"):
        calls = re.findall(r"""install_hint\((["'][^)]+)\)""", path.read_text(encoding="utf-8"))
        named.update(name for words in calls for name in re.findall(r"[\w-]+", words))
    bounds = {each for those in EXTRAS.values() for each in those}
    assert len(named) >= 6
    assert named <= {re.split("[<>=~!]", each)[0] for each in bounds}
    assert not [each for each in bounds if re.search("[<~!]|==", each)]


def test_no_message_asks_for_tetopt_from_an_index():
    texts = [
        path.read_text(encoding="utf-8")
        for path in (Path(__file__).parents[1] / "tetopt").glob("*/*.py")
        if path.name != "extras.py"
    ]
    assert not any(re.search(r"pip install [^\n]{0,3}tetopt", text) for text in texts)
