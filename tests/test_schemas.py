"""The schemas of run.json, report.json and the numbers of a mesh's quality.

Files that tests write are held against them by `described_numbers` in conftest.py.
"""

import json
import sys
import tomllib
from pathlib import Path

import jsonschema
import pytest
from schemas import KINDS, REFERENCE, assert_described, kind_of

import tetopt
from tetopt.cli import main
from tetopt.system.files import save_json

pytestmark = pytest.mark.full

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs" / "_extensions"))


def schema(kind):
    return json.loads((REFERENCE / f"{kind}.schema.json").read_text(encoding="utf-8"))


def leaves(part, path=""):
    """The schemas in a schema, with the keys that lead to them."""
    yield path, part
    for key, each in {**part.get("properties", {}), **part.get("$defs", {})}.items():
        yield from leaves(each, f"{path}.{key}".lstrip("."))
    for key in ("additionalProperties", "items"):
        if isinstance(part.get(key), dict):
            yield from leaves(part[key], path)
    for each in (*part.get("patternProperties", {}).values(), *part.get("anyOf", [])):
        yield from leaves(each, path)


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_is_described(kind):
    """A schema is one of draft 2020-12, each key has its words, and no object takes other keys
    than it names.
    """
    jsonschema.Draft202012Validator.check_schema(schema(kind))
    for path, part in leaves(schema(kind)):
        for key, each in part.get("properties", {}).items():
            assert each.get("description"), f"{path}.{key}"
        if "properties" in part:
            assert part["additionalProperties"] is False, path


@pytest.fixture(scope="module")
def numbers(tmp_path_factory):
    """run.json of the smallest run, and the quality of its mesh."""
    folder = tmp_path_factory.mktemp("schemas")
    image = tetopt.load_phantom("disc_2d").image(voxel_mm=4.0)
    tetopt.save_image(folder / "a.nii", image)
    words = ["mesh", folder / "a.nii", "-o", folder / "a.vtu", "--nodes", "30", "--iterations", "0"]
    assert main([*map(str, words), "--uniform", "--json", str(folder / "run.json")]) == 0
    assert main(["quality", str(folder / "a.vtu"), "--json", str(folder / "q.json")]) == 0
    return [json.loads((folder / name).read_text()) for name in ("run.json", "q.json")]


def test_kinds(numbers):
    """What the commands write is known for what it is, so that it is looked at; anything else is
    not.
    """
    assert [kind_of(each) for each in numbers] == ["run", "quality"]
    assert kind_of({"pipelines": [], "quadratic": [], "reference": {}, "seconds": 1.0}) == "report"
    assert kind_of([1, 2]) is None
    assert kind_of({"quality": 1}) is None


def test_a_key_without_description_is_seen(numbers, tmp_path):
    """Whatever is written by tests goes through the schemas: a new key, one that is gone,
    another type.
    """
    run = numbers[0]
    assert_described(run)
    for wrong in (
        run | {"news": 1},
        run | {"options": run["options"] | {"news": 1}},
        {key: each for key, each in run.items() if key != "ended"},
        run | {"iterations_done": "three"},
    ):
        with pytest.raises(AssertionError, match=r"run\.schema\.json"):
            save_json(tmp_path / "a.json", wrong)
    assert not list(tmp_path.iterdir())
    with pytest.raises(AssertionError, match=r"quality\.schema\.json: quality: "):
        assert_described(numbers[1] | {"quality": numbers[1]["quality"] | {"news": 1}})


def test_the_tables_have_every_key(numbers):
    """A row for each key of the schema, and so of the run."""
    from schema_pages import tables

    lines = "\n".join(tables(schema("run"), "run"))
    for key in numbers[0]:
        assert f"| `{key}`" in lines
    for key in ("errors.worst", "kinds.sliver", "[].E_G", "KEY.colour"):
        assert f"| `{key}`" in lines
    assert "| `E_D_fraction_of_variance` |" in lines
    assert "| `label_weight` | " in lines
    assert "*number, mm^(n+2).*" in lines


def test_units_are_those_of_the_cohort():
    """A column of cohort.tsv that is a number of run.json has the same unit there."""
    columns = tomllib.loads(
        (ROOT / "tetopt" / "cohort" / "columns.toml").read_text(encoding="utf-8")
    )
    units = {path: part.get("unit", "") for path, part in leaves(schema("run"))}
    parts = ("quality.", "mask.", "size.", "seconds.", "energies.", "memory.")
    shared = {name: words[1] for name, words in columns.items() if name.startswith(parts)}
    assert len(shared) > 20
    for name, unit in shared.items():
        assert units[name] == unit, name
