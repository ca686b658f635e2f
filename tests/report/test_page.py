"""The page builder: one file, text escaped, nothing half written."""

import re

import jinja2
import numpy as np
import PIL.Image
import pytest

from tetopt.report.page import picture_html, rendered, save_page, write_page

EVIL = '<b onclick="x">&\''


def png(path, size):
    PIL.Image.fromarray(np.zeros((size[1], size[0]), dtype=np.uint8)).save(path)
    return path


def test_text_is_escaped(tmp_path):
    picture = png(tmp_path / "a.png", (30, 20))
    section = {"title": EVIL, "text": EVIL, "tables": [[[EVIL], [EVIL]], []], "pictures": [(picture, EVIL)]}
    save_page(tmp_path / "a.html", EVIL, [section])
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<b " not in page
    assert page.count("&lt;b onclick=&#34;x&#34;&gt;&amp;&#39;") == 8  # title twice, head, text, 2 cells, alt, caption


def test_a_picture_keeps_its_size_and_a_wide_one_scrolls(tmp_path):
    square, wide = png(tmp_path / "a.png", (30, 30)), png(tmp_path / "b.png", (300, 100))
    assert 'width="30" height="30"' in picture_html(square, "")
    assert 'class="wide"' in picture_html(square, "")
    assert 'class="wide broad"' in picture_html(wide, "")


def test_table_has_a_head_and_without_rows_there_is_none():
    section = {"title": "s", "text": "", "tables": [[["a", "b"], ["1", "2"]], []]}
    markup = re.sub(r"</?div[^>]*>|\s", "", rendered("report/sections.html", sections=[section]))
    assert markup.count("<table>") == 1
    assert (
        "<table><thead><tr><th>a</th><th>b</th></tr></thead><tbody><tr><td>1</td><td>2</td></tr></tbody></table>"
    ) in markup


def test_a_name_that_a_template_lacks_is_an_error():
    with pytest.raises(jinja2.UndefinedError):
        rendered("report/page.html", title="t")


def test_the_page_forbids_the_network(tmp_path):
    write_page(tmp_path / "a.html", "STYLE TITLE", "<p>x</p>", "p { color: red; }")
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "default-src 'none'" in page
    assert "<h1>STYLE TITLE</h1>" in page
    assert "p { color: red; }</style>" in page


def test_an_error_leaves_what_was_there(tmp_path):
    (tmp_path / "a.html").write_text("before")
    section = {"title": "", "text": "", "pictures": [(tmp_path / "missing.png", "")]}
    with pytest.raises(FileNotFoundError):
        save_page(tmp_path / "a.html", "t", [section])
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]
    assert (tmp_path / "a.html").read_text() == "before"
