"""Every public name and every record that comes back from one is documented, in numpydoc's form,
with an example; and all examples of the package run.
"""

import doctest
import importlib
import inspect
import pydoc
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpydoc.docscrape import ClassDoc, FunctionDoc
from numpydoc.validate import validate
from results import FOLDER, solved_model

import tetopt
from tetopt.io import formats

ROOT = Path(__file__).resolve().parents[1]
NAMES = [name for name in tetopt.__all__ if name != "__version__"]
MODULES = sorted(
    path for path in (ROOT / "tetopt").rglob("*.py") if ">>> " in path.read_text(encoding="utf-8")
)
# Of numpydoc's: a summary is missing or not one line, or without its full stop; parameters that are
# not documented, or not there, in another order, or without type or words; no Returns; no words
# there; no Examples; sections out of order.
FAULTS = {
    "GL07",
    "GL08",
    "SS01",
    "SS03",
    "SS06",
    "PR01",
    "PR02",
    "PR03",
    "PR04",
    "PR07",
    "RT01",
    "RT03",
    "EX01",
}


def dotted(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def listed():
    """The names on the API page, without the package's: some records with their modules."""
    text = (ROOT / "docs" / "reference" / "api" / "index.md").read_text(encoding="utf-8")
    return re.findall(r"^   ~?([\w.]+)$", text, re.M)


RECORDS = sorted({name for name in listed() if "." in name})


def methods(name):
    """The public methods of a public class that are the package's own, without properties."""
    for each, member in inspect.getmembers(thing(name)):
        function = getattr(member, "__func__", member)
        if (
            inspect.isfunction(function)
            and not each.startswith("_")
            and function.__module__.startswith("tetopt.")
        ):
            yield f"{name}.{each}"


def thing(name):
    """Whatever has this name."""
    return pydoc.locate(f"tetopt.{name}")


DOCUMENTED = [
    *(NAMES + RECORDS),
    *(each for name in NAMES + RECORDS if inspect.isclass(thing(name)) for each in methods(name)),
]


@pytest.mark.full
@pytest.mark.parametrize("name", DOCUMENTED)
def test_public_names_are_documented(name):
    """Summary, parameters in order, what comes back, an example; of functions what they refuse,
    too.
    """
    faults = {code: text for code, text in validate(f"tetopt.{name}")["errors"] if code in FAULTS}
    assert faults == {}
    value = thing(name)
    if inspect.isfunction(value) and "." not in name:  # whose arguments are checked
        assert "InputError" in [each.type for each in FunctionDoc(value)["Raises"]]
    elif inspect.isclass(value):
        assert list(getattr(value, "_fields", [])) == fields_of(value)


def test_public_names_are_on_the_site():
    """Once each, and records that come back from them."""
    assert sorted(listed()) == sorted(NAMES + RECORDS)
    assert all(inspect.isclass(thing(name)) for name in RECORDS)


def fields_of(record):
    """The fields of a NamedTuple that its docstring lists, in its order; none of another class."""
    names = (
        [each.name for each in ClassDoc(record)["Parameters"]] if hasattr(record, "_fields") else []
    )
    return [name for group in names for name in group.split(", ")]


@pytest.mark.deep
@pytest.mark.parametrize("path", MODULES, ids=dotted)
def test_examples_run(path, tmp_path, monkeypatch):
    """Each docstring's by itself, in a folder of its own, with numpy as np and tetopt at hand."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(formats, "FORMATS", dict(formats.FORMATS))
    if path.name == "frd.py":  # what CalculiX has written
        shutil.copy(FOLDER / "order_1.frd", "bar.frd")
        tetopt.save_mesh("bar.vtu", solved_model(1).mesh)
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    runner, output = doctest.DocTestRunner(optionflags=flags), []
    module = importlib.import_module(dotted(path))
    examples = doctest.DocTestFinder().find(module, extraglobs={"np": np, "tetopt": tetopt})
    for each in examples:
        runner.run(each, out=output.append)
    if output:
        pytest.fail("".join(output), pytrace=False)
    # Each example that the file has is in a docstring that was run.
    assert sum(len(each.examples) for each in examples) == len(
        re.findall(r"^ *>>> ", path.read_text("utf-8"), re.M)
    )
