"""A page of HTML in one file: sections, tables, pictures, data and scripts, without outside references."""

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

# Of pages: the files beside this one that each is made of.
PAGE_SCRIPTS = {
    "viewer": ("webgl.js", "viewer.js"),
    "explorer": ("webgl.js", "explore_mesh.js", "explore_gl.js", "explore.js"),
    "cohort": ("cohort.js",),
}
BROAD_RATIO = 1.4  # A picture wider than this many times its height keeps a readable width on a phone, and scrolls.


@cache
def _environment() -> Environment:
    return Environment(
        loader=FunctionLoader(package_text), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=StrictUndefined,
    )  # fmt: skip


def package_text(name: str) -> str:
    """Return the text of a file in the package, such as "report/page.css"."""
    return resources.files("tetopt").joinpath(name).read_text(encoding="utf-8")


def rendered(template: str, **values: Any) -> Markup:
    """Markup of a template in the package; all values but markup are escaped.

    See https://jinja.palletsprojects.com/ for the language of the templates.
    """
    return Markup(_environment().get_template(template).render(values, picture=picture_html))


def write_page(path: Path, title: str, content: str, style: str = "") -> None:
    """Write markup under a heading as one HTML file, whole or not at all.

    `content` and `style` (CSS after the page's own) go in as they are, but for what is not printed, such as marks that
    turn the direction of writing, which is shown as Python escapes it; `title` is text. See `policy_html`.
    """
    page = rendered(
        "report/page.html", policy=policy_html(), title=plain(title), style=Markup(style), content=Markup(content)
    )  # fmt: skip
    save_text(path, printed(f"{page}\n"))


def picture_html(path: str | Path, caption: str) -> Markup:
    """Markup of a PNG, embedded, with its caption as text and as what a screen reader says."""
    png = Path(path).read_bytes()
    width, height = struct.unpack(">II", png[16:24])  # of the IHDR chunk, which is always the first
    data = base64.b64encode(png).decode("ascii")
    shape = "wide broad" if width > BROAD_RATIO * height else "wide"
    return Markup(
        '<figure><div class="{}"><img alt="{}" width="{}" height="{}" src="data:image/png;base64,{}"></div>'
        "<figcaption>{}</figcaption></figure>"
    ).format(shape, caption, width, height, data, caption)


def packed(numbers: NDArray, kind: str) -> str:
    """Base64 of an array's bytes, as numbers of a `kind` such as "<f4"."""
    return base64.b64encode(numbers.astype(kind).tobytes()).decode("ascii")


def data_html(name: str, data: Any) -> Markup:
    """Markup of data for a script, as JSON in the element `name`."""
    # An HTML parser ends a script at "</script" wherever it stands, also in a string.
    text = json.dumps(_shown(data), allow_nan=False).replace("<", "\\u003c")
    return Markup(f'<script type="application/json" id="{name}">{text}</script>')


def _shown(data: Any) -> Any:
    """The data with all its texts `plain`: a page shows names as they are."""
    if isinstance(data, dict):
        return {plain(str(key)): _shown(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_shown(value) for value in data]
    return plain(data) if isinstance(data, str) else data


def script_html(name: str) -> Markup:
    """Markup of one of `PAGE_SCRIPTS`."""
    return Markup(f"<script>{_script(name)}</script>")


@cache
def _script(name: str) -> str:
    """A script in a scope of its own: files beside this one, one after the other."""
    texts = [package_text(f"report/{part}") for part in PAGE_SCRIPTS[name]]
    return "\n".join(["", '"use strict";', "(() => {", *texts, "})();", ""])


def policy_html() -> Markup:
    """Markup by which a page forbids itself the network, forms, and all scripts but our own.

    What slipped in with a name neither runs nor is fetched: scripts are let in by the hash of their text.
    W3C, Content Security Policy Level 3, https://www.w3.org/TR/CSP3/, 6.7.3 and 8.3.
    """
    digests = (hashlib.sha256(_script(name).encode()).digest() for name in PAGE_SCRIPTS)
    scripts = " ".join(f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)
    rules = ["default-src 'none'", "img-src data:", "style-src 'unsafe-inline'", f"script-src {scripts}"]
    rules += ["base-uri 'none'", "form-action 'none'"]
    return Markup(f'<meta http-equiv="Content-Security-Policy" content="{"; ".join(rules)}">')


def printed(markup: str) -> str:
    """Markup in which all that is not printed, but line breaks, is shown as Python escapes it."""
    return "\n".join(map(plain, markup.split("\n")))
