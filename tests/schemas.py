"""The JSON Schemas of what tetopt writes, and whether a file keeps to its own."""

import json
from functools import cache
from pathlib import Path

import jsonschema
import referencing

REFERENCE = Path(__file__).resolve().parents[1] / "docs" / "reference"
# By schema, keys that only the files of its kind have all of.
KINDS = {
    "run": {"request", "history", "mesh_sha256"},
    "quality": {"quality", "n_turned"},
    "report": {"pipelines", "quadratic", "reference"},
}


@cache
def validators():
    """A validator for each kind of file."""
    schemas = {
        kind: json.loads((REFERENCE / f"{kind}.schema.json").read_text(encoding="utf-8"))
        for kind in KINDS
    }
    resources = [
        (each["$id"], referencing.Resource.from_contents(each)) for each in schemas.values()
    ]
    registry = referencing.Registry().with_resources(resources)
    return {
        kind: jsonschema.Draft202012Validator(each, registry=registry)
        for kind, each in schemas.items()
    }


def kind_of(value):
    """Of which kind a file's content is; None for another."""
    return next(
        (kind for kind, keys in KINDS.items() if isinstance(value, dict) and keys <= set(value)),
        None,
    )


def assert_described(value):
    """Every key of a run.json, a report.json or the numbers of a mesh's quality is in its
    schema, and as that says.
    """
    if (kind := kind_of(value)) is None:
        return
    wrong = [
        f"{'.'.join(map(str, each.absolute_path))}: {each.message[:200]}"
        for each in validators()[kind].iter_errors(value)
    ]
    assert not wrong, f"docs/reference/{kind}.schema.json: {'; '.join(wrong)}"
