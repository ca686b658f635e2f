"""A page of HTML in one file: sections, tables, pictures, data and scripts, without outside references."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import struct
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from tetopt.io.text import plain
from tetopt.system.files import save_text

# Of pages: the files beside this one that each is made of.
PAGE_SCRIPTS = {
    "viewer": ("webgl.js", "viewer.js"),
    "explorer": ("webgl.js", "explore_mesh.js", "explore_gl.js", "explore.js"),
    "cohort": ("cohort.js",),
}
BROAD_RATIO = 1.4  # A picture wider than this many times its height keeps a readable width on a phone, and scrolls.


def save_page(path: Path, title: str, sections: Sequence[dict[str, Any]]) -> None:
    """Write one HTML file without outside references, whole or not at all.

    Each section has a `title`, a `text`, optionally `tables` (rows of cells, the first the heading) and `pictures`
    (PNG paths with captions).
    """
    parts = []
    for section in sections:
        tables = [table_html(rows) for rows in section.get("tables", ()) if rows]
        pictures = [picture_html(picture, caption) for picture, caption in section.get("pictures", ())]
        parts.append(section_html(section["title"], [paragraph_html(section["text"]), *tables, *pictures]))
    write_page(path, title, parts)


def write_page(path: Path, title: str, parts: Sequence[str], style: str = "") -> None:
    """Write markup `parts` under a heading as one HTML file, whole or not at all.

    `parts` and `style` (CSS after the page's own) go in as they are, but for what is not printed, such as marks that
    turn the direction of writing, which is shown as Python escapes it; `title` is text. See `policy_html`.
    """
    head = _HEAD.replace("POLICY", policy_html()).replace("STYLE", style).replace("TITLE", html.escape(plain(title)))
    save_text(path, printed("\n".join([head, *parts, "</main></body></html>\n"])))


def section_html(title: str, parts: Sequence[str]) -> str:
    """Markup of a section: `title` is text, `parts` are markup."""
    return "\n".join([f"<section><h2>{html.escape(title)}</h2>", *parts, "</section>"])


def paragraph_html(text: str) -> str:
    """Markup of a paragraph of text."""
    return f"<p>{html.escape(text)}</p>"


def table_html(rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """Markup of a table of text, the first row its heading; it scrolls sideways on a narrow screen."""
    head, *body = rows
    title = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    lines = [
        f"<div class='wide'><table>{title}<thead><tr>",
        *(f"<th>{html.escape(c)}</th>" for c in head),
        "</tr></thead><tbody>",
    ]
    for row in body:
        lines += ["<tr>", *(f"<td>{html.escape(c)}</td>" for c in row), "</tr>"]
    return "".join([*lines, "</tbody></table></div>"])


def picture_html(path: str | Path, caption: str) -> str:
    """Markup of a PNG, embedded, with its caption as text and as what a screen reader says."""
    png = Path(path).read_bytes()
    width, height = struct.unpack(">II", png[16:24])  # of the IHDR chunk, which is always the first
    data = base64.b64encode(png).decode("ascii")
    alt = html.escape(caption)
    shape = "wide broad" if width > BROAD_RATIO * height else "wide"
    return (
        f'<figure><div class="{shape}"><img alt="{alt}" width="{width}" height="{height}" '
        f'src="data:image/png;base64,{data}"></div><figcaption>{alt}</figcaption></figure>'
    )


def packed(numbers: NDArray, kind: str) -> str:
    """Base64 of an array's bytes, as numbers of a `kind` such as "<f4"."""
    return base64.b64encode(numbers.astype(kind).tobytes()).decode("ascii")


def data_html(name: str, data: Any) -> str:
    """Markup of data for a script, as JSON in the element `name`."""
    # An HTML parser ends a script at "</script" wherever it stands, also in a string.
    text = json.dumps(_shown(data), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>'


def _shown(data: Any) -> Any:
    """The data with all its texts `plain`: a page shows names as they are."""
    if isinstance(data, dict):
        return {plain(str(key)): _shown(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_shown(value) for value in data]
    return plain(data) if isinstance(data, str) else data


def script_html(name: str) -> str:
    """Markup of one of `PAGE_SCRIPTS`."""
    return f"<script>{_script(name)}</script>"


@cache
def _script(name: str) -> str:
    """A script in a scope of its own: files beside this one, one after the other."""
    folder = resources.files("tetopt.report")
    texts = [folder.joinpath(part).read_text(encoding="utf-8") for part in PAGE_SCRIPTS[name]]
    return "\n".join(["", '"use strict";', "(() => {", *texts, "})();", ""])


def policy_html() -> str:
    """Markup by which a page forbids itself the network, forms, and all scripts but our own.

    What slipped in with a name neither runs nor is fetched: scripts are let in by the hash of their text.
    W3C, Content Security Policy Level 3, https://www.w3.org/TR/CSP3/, 6.7.3 and 8.3.
    """
    digests = (hashlib.sha256(_script(name).encode()).digest() for name in PAGE_SCRIPTS)
    scripts = " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)
    rules = ["default-src 'none'", "img-src data:", "style-src 'unsafe-inline'", f"script-src {scripts}"]
    rules += ["base-uri 'none'", "form-action 'none'"]
    return f'<meta http-equiv="Content-Security-Policy" content="{"; ".join(rules)}">'


def printed(markup: str) -> str:
    """Markup in which all that is not printed, but line breaks, is shown as Python escapes it."""
    return "\n".join(map(plain, markup.split("\n")))


_HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
POLICY
<title>TITLE</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #222; margin: 0; }
main { max-width: 1100px; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; border-top: 1px solid #ddd; padding-top: 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.92rem; }
caption { text-align: left; font-weight: 600; padding: 0.6rem 0 0.2rem; }
th, td { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #eee; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } td:last-child { white-space: normal; }
figure { margin: 1rem 0; } img { max-width: 100%; height: auto; } figcaption { color: #555; font-size: 0.9rem; }
@media screen and (max-width: 700px) { .broad img { max-width: none; width: 900px; } }
@media print {
  body { font-size: 10pt; } main { max-width: none; padding: 0; } h2 { break-after: avoid; }
  figure, tr { break-inside: avoid; } img { max-height: 24cm; width: auto; }
}
STYLE</style></head><body><main><h1>TITLE</h1>"""
