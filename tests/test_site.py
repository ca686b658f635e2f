"""The check of the built site finds what leads nowhere."""

import importlib.util
from pathlib import Path

import pytest

pytestmark = pytest.mark.full

ROOT = Path(__file__).resolve().parents[1]
_spec = importlib.util.spec_from_file_location("check_site", ROOT / "docs" / "check_site.py")
check_site = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(check_site)

PAGE = (
    '<html><head><link rel="stylesheet" href="look.css?v=1"></head><body id="top">{}</body></html>'
)


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        ('<a href="other.html#there">x</a><a href="#top">x</a>', None),
        ('<a href="https://example.org">x</a><img src="a%20b.png">', None),
        ('<a href="gone.html">x</a>', "index.html: gone.html is not there"),
        (
            '<a href="other.html#gone">x</a>',
            "index.html: other.html#gone has no such place on its page",
        ),
        ('<img src="gone.png">', "index.html: gone.png is not there"),
        (
            '<script src="https://x.org/x"></script>',
            "index.html: loads https://x.org/x, which is not in the site",
        ),
        (
            '<script src="//x.org/x"></script>',
            "index.html: loads //x.org/x, which is not in the site",
        ),
    ],
)
def test_what_leads_nowhere(tmp_path, body, fault):
    (tmp_path / "index.html").write_text(PAGE.format(body))
    (tmp_path / "other.html").write_text(PAGE.format('<p id="there"></p>'))
    (tmp_path / "look.css").touch()
    (tmp_path / "a b.png").touch()
    assert check_site.faults_of(tmp_path) == ([] if fault is None else [fault])


def test_a_site_has_pages(tmp_path):
    assert check_site.faults_of(tmp_path) == [f"{tmp_path}: no page"]
