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


def save_explored(path, names, mesh, image):
    """The page to explore a mesh of these fields, labels and sets; what it is to show."""
    numbers, n = np.arange(len(mesh.cells)), len(names)
    tensors = {f"{name} 6": np.zeros((len(numbers), 6)) for name in names}
    fields = {name: np.random.default_rng(k).random(len(numbers)) for k, name in enumerate(names)}
    sets = dict.fromkeys(names, boundary_facets(mesh.cells)[:4])
    table = LabelTable(dict(enumerate(names)), {})
    reactions = {1: dict.fromkeys(names, (1.0, 2.0, 3.0))}
    data = {"label": numbers % n, **fields, **tensors}
    save_explorer(path, exhibit(mesh, data, image, names[0], sets, None, reactions, table))
    return [*names, *tensors]


def save_pictures(path, names, *_):
    write_page(path, names[0], "".join(picture_html(path.parent / "p.png", name) for name in names))
    return names


def save_paper(path, names, *_):
    more = {
        "dice": {names[0]: {names[1]: 0.5}},
        "E_D_relative": {names[2]: 0.5},
        "pictures": [["p.png", names[3]]],
    }
    sections = [{"title": name, "text": name, **more} for name in names]
    results = {"sections": sections, "image": names[0], "versions": {"tetopt": names[1]}}
    _write_page({"paper.html": path}, results)
    return names


@pytest.mark.parametrize("save", [save_explored, save_pictures, save_paper])
def test_names_are_shown_as_text(save, server, tmp_path, mesh, image):
    """All of them, as `plain` shows them; nothing runs, and nothing is fetched."""
    address, paths = server
    PIL.Image.new("L", (2, 2)).save(tmp_path / "p.png")
    names = save(tmp_path / "a.html", hostile(address), mesh, image)
    # which fails where the console said something, as of anything that the policy forbids
    shown = document(tmp_path / "a.html")
    assert "data-xss" not in shown
    assert paths == []
    texts = html.unescape(re.sub(r"<(script|style)[^>]*>.*?</\1>", " ", shown, flags=re.DOTALL))
    texts = " ".join(texts.split())
    for name in names:  # a line break may be a space
        ways = (" ".join(plain(each).split()) for each in (name, name.replace("\n", " ")))
        assert any(way in texts for way in ways), name


def leak(address):
    """Markup that would run scripts in all ways, and fetch and send in all ways."""
    return f"""<script>{RAN}</script><img src=x onerror='{RAN}'><svg onload='{RAN}'></svg>
        <a href='javascript:{RAN}'>x</a><img src='{address}/img'>
        <link rel=stylesheet href='{address}/css'><script src='{address}/js'></script>
        <iframe src='{address}/frame'></iframe><object data='{address}/object'></object>
        <form action='{address}/form'></form><base href='{address}/'>
        <style>@import '{address}/style';</style><video src='{address}/video'></video>
        <script type=module>import '{address}/module'; {RAN}</script>"""


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
    ways = r"\beval\b|\bFunction\b|document\.write|outerHTML|insertAdjacentHTML|fetch\(|XMLHttp"
    assert re.findall(ways, text) == []
    # of the axes' letters
    own = ['innerHTML = lines.join("") + letters.map(([, text]) => text).join("")']
    assert re.findall(r"innerHTML = [^;]*", text) == (own if name == "explorer" else [])
    # or else its hash would be another
    assert plain(text.replace("\n", "")) == text.replace("\n", "")
