"""Tables of the keys of a JSON file, made of its JSON Schema when the site is built.

The directive `schema` has the name of a schema next to the page: tables of its keys, with their
meanings, their types and units (the annotation "unit"); a section for each object at the top, and
for each of the definitions.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from command_pages import marked
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

Schema = dict[str, Any]


def tables(schema: Schema, page: str) -> list[str]:
    """Lines of Markdown: a table of the keys at the top, and a section for each object there and
    each definition.
    """
    of_objects = {key: each for key, each in schema["properties"].items() if _keys(each)}
    lines = ["## Top level", "", *_table(_top_rows(schema, page)), ""]
    for key, each in of_objects.items():
        about = each.get("description", "").rstrip(".")
        lines += [
            f"({page}-{key})=",
            f"## {key}",
            "",
            f"{marked(about)}.",
            "",
            *_table(_rows(each, "", page)),
            "",
        ]
    for name, each in schema.get("$defs", {}).items():
        about = each.get("description", "").rstrip(".")
        lines += [f"({page}-def-{name})=", f"## Keys of {name}", "", f"{marked(about)}.", ""]
        lines += [*_table(_rows(each, "", page)), ""]
    return lines


def _table(rows: Iterator[tuple[str, str]]) -> list[str]:
    return ["| key | what it is |", "|---|---|", *(f"| {key} | {text} |" for key, text in rows)]


def _top_rows(schema: Schema, page: str) -> Iterator[tuple[str, str]]:
    for key, each in schema["properties"].items():
        if _keys(each):
            yield _name(schema, key, ""), f"{_words(each, page)} See [its keys](#{page}-{key})."
        else:
            yield _name(schema, key, ""), _words(each, page)


def _rows(schema: Schema, prefix: str, page: str) -> Iterator[tuple[str, str]]:
    """The keys of an object and of those in it, joined by dots; a list's end in []."""
    inner, suffix = _inner(schema)
    prefix += suffix
    for key, each in inner.get("properties", {}).items():
        yield _name(inner, key, prefix), _words(each, page)
        if _keys(each):
            yield from _rows(each, f"{prefix}{key}.", page)
    for example, each in [("KEY", inner.get("additionalProperties")), *_patterns(inner)]:
        if isinstance(each, dict) and each:
            yield f"`{prefix}{example}`", _words(each, page)
            if _keys(each):
                yield from _rows(each, f"{prefix}{example}.", page)


def _patterns(schema: Schema) -> list[tuple[str, Schema]]:
    return [("NU", each) for each in schema.get("patternProperties", {}).values()]


def _inner(schema: Schema) -> tuple[Schema, str]:
    """The object that a schema is of, itself, in a list or beside null; and what stands for
    being in a list.
    """
    if schema.get("type") == "array" and isinstance(schema.get("items"), dict):
        inner, suffix = _inner(schema["items"])
        return inner, f"[].{suffix}"
    if "anyOf" in schema:
        return _inner(schema["anyOf"][0])
    return schema, ""


def _keys(schema: Schema) -> bool:
    """Whether it has keys of its own, or any keys that are told apart."""
    inner, _ = _inner(schema)
    more = inner.get("additionalProperties")
    of_any = isinstance(more, dict) and bool(_inner(more)[0].get("properties"))
    return bool(inner.get("properties")) or "patternProperties" in inner or of_any


def _name(schema: Schema, key: str, prefix: str) -> str:
    optional = "" if key in schema.get("required", ()) else ", not always"
    return f"`{prefix}{key}`{optional}"


def _words(schema: Schema, page: str) -> str:
    """What a key is: description, type and unit."""
    text = schema.get("description", "").rstrip(".")
    unit = f", {schema['unit']}" if "unit" in schema else ""
    return f"{marked(text)}. *{_type(schema, page)}{unit}.*"


def _type(schema: Schema, page: str) -> str:
    if "$ref" in schema:
        path, _, name = schema["$ref"].rpartition("/")
        other = page if path.startswith("#") else path.split(".")[0]
        return f"[{name}](#{other}-def-{name})"
    if "anyOf" in schema:
        return f"{_type(schema['anyOf'][0], page)} or null"
    if "enum" in schema or "const" in schema:
        words = schema.get("enum", [schema.get("const")])
        return "one of " + ", ".join(f"`{json.dumps(word)}`" for word in words)
    kind = schema.get("type", "any")
    if isinstance(kind, list):
        return " or ".join(kind)
    if kind == "array":
        return f"list of {_type(schema['items'], page)}" if "items" in schema else "list"
    return kind


class SchemaDirective(SphinxDirective):
    """The tables of one schema."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The nodes in the page's place."""
        path = Path(self.env.doc2path(self.env.docname)).with_name(self.arguments[0])
        self.env.note_dependency(str(path))
        lines = tables(json.loads(path.read_text(encoding="utf-8")), path.name.split(".")[0])
        return self.parse_text_to_nodes("\n".join(lines), allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, bool]:
    """The directive."""
    app.add_directive("schema", SchemaDirective)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
