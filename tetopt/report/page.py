"""HTML pages in a single file: sections, tables, pictures, data and scripts, without external
references.
"""

from __future__ import annotations

import base64
import hashlib
import json
import struct
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from tetopt.io.text import plain
from tetopt.system.files import save_text

# The script files of each page, in this folder.
PAGE_SCRIPTS = {
    "explorer": ("webgl.js", "explore_mesh.js", "explore_gl.js", "explore.js"),
    "cohort": ("cohort.js",),
}
# width over height beyond which a picture keeps a readable width on a phone, and scrolls
BROAD_RATIO = 1.4


@cache
def _environment() -> Environment:
    return Environment(
        loader=FunctionLoader(package_text),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )


def package_text(name: str) -> str:
    """Return the text of a file in the package, such as "report/page.css"."""
    return resources.files("tetopt").joinpath(name).read_text(encoding="utf-8")


def render_page(template: str | Path, **values: Any) -> Markup:
    """Render a template in the package, or that of a file; all values except markup are escaped.

    See https://jinja.palletsprojects.com/ for the language of the templates.
    """
    environment = _environment()
    source = (
        environment.get_template(template)
        if isinstance(template, str)
        else environment.from_string(template.read_text(encoding="utf-8"))
    )
    return Markup(source.render(values, picture=picture_html))


def write_page(path: Path, title: str, content: str, style: str = "") -> None:
    """Write markup under a heading as one HTML file, whole or not at all.

    `content` and `style` (CSS after the page's own) are inserted unchanged, except for unprintable
    characters, such as marks that reverse the direction of writing, which are shown as Python
    escapes; `title` is text. See `policy_html`.
    """
    page = render_page(
        "report/page.html",
        policy=policy_html(),
        title=plain(title),
        style=Markup(style),
        content=Markup(content),
    )
    save_text(path, escape_unprintable(f"{page}\n"))


def picture_html(path: str | Path, caption: str) -> Markup:
    """Embed a PNG as markup, with its caption as text and as alternative text for screen
    readers.
    """
    png = Path(path).read_bytes()
    width, height = struct.unpack(">II", png[16:24])  # in the IHDR chunk, which always comes first
    data = base64.b64encode(png).decode("ascii")
    shape = "wide broad" if width > BROAD_RATIO * height else "wide"
    return Markup(
        '<figure><div class="{}" tabindex="0">'
        '<img alt="{}" width="{}" height="{}" src="data:image/png;base64,{}"></div>'
        "<figcaption>{}</figcaption></figure>"
    ).format(shape, caption, width, height, data, caption)


def encode_numbers(numbers: NDArray, kind: str) -> str:
    """Encode an array as Base64, as numbers of a `kind` such as "<f4"."""
    return base64.b64encode(numbers.astype(kind).tobytes()).decode("ascii")


def data_html(name: str, data: Any) -> Markup:
    """Return data for a script as markup: JSON in the element `name`."""
    # An HTML parser ends a script at any "</script", even within a string.
    text = json.dumps(_plain_texts(data), allow_nan=False).replace("<", "\\u003c")
    return Markup(f'<script type="application/json" id="{name}">{text}</script>')


def _plain_texts(data: Any) -> Any:
    """Make all texts in the data `plain`: a page shows names literally."""
    if isinstance(data, dict):
        return {plain(str(key)): _plain_texts(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain_texts(value) for value in data]
    return plain(data) if isinstance(data, str) else data


def script_html(name: str) -> Markup:
    """Return one of `PAGE_SCRIPTS` as markup."""
    return Markup(f"<script>{_script(name)}</script>")


@cache
def _script(name: str) -> str:
    """Return a script, concatenated from its files, in its own scope."""
    texts = [package_text(f"report/{part}") for part in PAGE_SCRIPTS[name]]
    return "\n".join(["", '"use strict";', "(() => {", *texts, "})();", ""])


def policy_html() -> Markup:
    """Return the markup by which a page forbids itself the network, forms, and all scripts except
    tetopt's.

    Scripts are allowed by the hash of their text, so that code injected through a name is neither
    run nor fetched. W3C, Content Security Policy Level 3, https://www.w3.org/TR/CSP3/, 6.7.3 and
    8.3.
    """
    digests = (hashlib.sha256(_script(name).encode()).digest() for name in PAGE_SCRIPTS)
    scripts = " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)
    rules = [
        "default-src 'none'",
        "img-src data:",
        "style-src 'unsafe-inline'",
        f"script-src {scripts}",
    ]
    rules += ["base-uri 'none'", "form-action 'none'"]
    return Markup(f'<meta http-equiv="Content-Security-Policy" content="{"; ".join(rules)}">')


def escape_unprintable(markup: str) -> str:
    """Replace unprintable characters in markup, except line breaks, by Python escapes."""
    return "\n".join(map(plain, markup.split("\n")))
