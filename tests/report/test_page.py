"""The page builder: one file, text escaped, nothing half written."""

import jinja2
import numpy as np
import PIL.Image
import pytest

from tetopt.report.page import picture_html, render_page, write_page

EVIL = '<b onclick="x">&\''


def png(path, size):
    PIL.Image.fromarray(np.zeros((size[1], size[0]), dtype=np.uint8)).save(path)
    return path


def test_text_is_escaped_and_the_network_forbidden(tmp_path):
    picture = picture_html(png(tmp_path / "a.png", (30, 20)), EVIL)
    write_page(tmp_path / "a.html", EVIL, picture, "p { color: red; }")
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<b " not in page
    assert page.count("&lt;b onclick=&#34;x&#34;&gt;&amp;&#39;") == 4  # title twice, alt, caption
    assert "default-src 'none'" in page
    assert "p { color: red; }</style>" in page
    write_page(tmp_path / "a.html", "STYLE TITLE", "")
    assert "<h1>STYLE TITLE</h1>" in (tmp_path / "a.html").read_text(encoding="utf-8")


def test_a_picture_keeps_its_size_and_a_wide_one_scrolls(tmp_path):
    square, wide = png(tmp_path / "a.png", (30, 30)), png(tmp_path / "b.png", (300, 100))
    assert 'width="30" height="30"' in picture_html(square, "")
    assert 'class="wide"' in picture_html(square, "")
    assert 'class="wide broad"' in picture_html(wide, "")


def test_a_name_that_a_template_lacks_is_an_error():
    with pytest.raises(jinja2.UndefinedError):
        render_page("report/page.html", title="t")
