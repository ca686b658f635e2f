"""Pages of things with hostile names, in a browser: nothing runs or is fetched, and the names
can be read.
"""

import html
import http.server
import re
import threading

import numpy as np
import PIL.Image
import pytest
from browser import document
from paper.report import _write_page

from tetopt.geometry.topology import boundary_facets
from tetopt.io.text import plain
from tetopt.model.label_names import LabelTable
from tetopt.report.exhibit import exhibit
from tetopt.report.explore import save_explorer
from tetopt.report.page import PAGE_SCRIPTS, picture_html, policy_html, script_html, write_page

pytestmark = pytest.mark.deep
RAN = "document.documentElement.dataset.xss=1"


@pytest.fixture
def server():
    """The address of a server and the paths that it was asked for."""
    paths = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            paths.append(self.path)
            self.send_response(404)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{running.server_port}", paths
        running.shutdown()


def hostile(address):
    """Names that would run or fetch something, or mislead who reads them, if they were markup or
    script.
    """
    return [
        f"<img src={address}/x onerror={RAN}>.nii.gz",
        f'"><script>{RAN}</script>',
        f"</script><script>{RAN}</script>",
        f"';{RAN}//",
        f'" onmouseover="{RAN}" autofocus onfocus="{RAN}',
        "{{7*7}}${7*7}<%= 7*7 %>",
        "<!--",
        "]]>",
        "$DATA TITLE STYLE POLICY",
        f"<link rel=stylesheet href={address}/css>",
        "&lt;b&gt;",
        "constructor",
        "=1+2",
        f"<style>@import '{address}/style';</style>",
        f"<base href={address}/>",
        "__proto__",
        f"<svg onload={RAN}>",
        f"<meta http-equiv=refresh content='0;url={address}/new'>",
        f"<iframe srcdoc='<script>{RAN}</script>'>",
        "line\nbreak\r\ttab",
        "\x1b[31mred\x07\0",
        "\u202egnp.exe",
        "\u2028\u2029",
        "\udcff",
        "<\u200bscript>",
        "a" * 300,
    ]


def check_shown(page, paths, names):
    """All names are in the document as text, as `plain` shows them; nothing ran, and nothing was
    fetched.
    """
    # which fails where the console said something, as of anything that the policy forbids
    shown = document(page)
    assert "data-xss" not in shown
    assert paths == []
    texts = html.unescape(re.sub(r"<(script|style)[^>]*>.*?</\1>", " ", shown, flags=re.DOTALL))
    texts = " ".join(texts.split())
    for name in names:  # a line break may be a space
        assert any(
            " ".join(plain(each).split()) in texts for each in (name, name.replace("\n", " "))
        ), name


def test_the_page_to_explore(mesh, image, server, tmp_path):
    names = hostile(server[0])
    labels = np.arange(len(mesh.cells)) % len(names)
    fields = {
        name: np.random.default_rng(k).random(len(mesh.cells)) for k, name in enumerate(names)
    }
    fields |= {f"{name} 6": np.zeros((len(mesh.cells), 6)) for name in names}
    sets = {name: boundary_facets(mesh.cells)[:4] for name in names}
    table = LabelTable(dict(enumerate(names)), {})
    reactions = {1: {name: [1.0, 2.0, 3.0] for name in names}}
    shown = exhibit(
        mesh, {"label": labels, **fields}, image, names[0], sets, None, reactions, table
    )
    save_explorer(tmp_path / "a.html", shown)
    check_shown(tmp_path / "a.html", server[1], [*names, *(f"{name} 6" for name in names)])


def test_the_page_of_pictures(server, tmp_path):
    names = hostile(server[0])
    PIL.Image.fromarray(np.zeros((2, 2), dtype=np.uint8)).save(tmp_path / "p.png")
    pictures = [picture_html(tmp_path / "p.png", name) for name in names]
    write_page(tmp_path / "a.html", names[0], "".join(pictures))
    check_shown(tmp_path / "a.html", server[1], names)


def test_the_papers_page(server, tmp_path):
    names = hostile(server[0])
    PIL.Image.fromarray(np.zeros((2, 2), dtype=np.uint8)).save(tmp_path / "p.png")
    more = {
        "dice": {names[0]: {names[1]: 0.5}},
        "E_D_relative": {names[2]: 0.5},
        "pictures": [["p.png", names[3]]],
    }
    sections = [{"title": name, "text": name, **more} for name in names]
    results = {"sections": sections, "image": names[0], "versions": {"tetopt": names[1]}}
    _write_page({"paper.html": tmp_path / "a.html"}, results)
    check_shown(tmp_path / "a.html", server[1], names)


def leak(address):
    """Markup that would run scripts in all ways, and fetch and send in all ways."""
    return (
        f"<script>{RAN}</script><img src=x onerror='{RAN}'><svg onload='{RAN}'></svg><a "
        f"href='javascript:{RAN}'>x</a>"
        f"<img src='{address}/img'><link rel=stylesheet href='{address}/css'><script "
        f"src='{address}/js'></script>"
        f"<iframe src='{address}/frame'></iframe><object data='{address}/object'></object>"
        f"<form action='{address}/form'></form><base href='{address}/'><style>@import "
        f"'{address}/style';</style>"
        f"<video src='{address}/video'></video><script type=module>import '{address}/module'; "
        f"{RAN}</script>"
    )


def test_what_slips_in_neither_runs_nor_is_fetched(server, tmp_path):
    """The policy of a page is a second wall behind the escaping; without it the same markup does
    what it can.
    """
    address, paths = server
    write_page(tmp_path / "a.html", "t", leak(address))
    assert "data-xss" not in document(tmp_path / "a.html", is_silent=False)
    assert paths == []
    without = (tmp_path / "a.html").read_text(encoding="utf-8").replace(policy_html(), "")
    (tmp_path / "b.html").write_text(without, encoding="utf-8")
    assert "data-xss" in document(tmp_path / "b.html", is_silent=False)
    assert {"/img", "/css", "/js"} <= set(paths)


@pytest.mark.parametrize("name", PAGE_SCRIPTS)
def test_own_scripts_make_code_of_no_text(name):
    """Nothing by which a text becomes code or markup, or an address a request."""
    text = script_html(name)
    ways = (
        r"\beval\b",
        r"\bFunction\b",
        r"document\.write",
        "outerHTML",
        "insertAdjacentHTML",
        r"fetch\(",
        "XMLHttp",
    )
    assert re.findall("|".join(ways), text) == []
    # of the axes' letters
    own = ['innerHTML = lines.join("") + letters.map(([, text]) => text).join("")']
    assert re.findall(r"innerHTML = [^;]*", text) == (own if name == "explorer" else [])
    # or else its hash would be another
    assert plain(text.replace("\n", "")) == text.replace("\n", "")
