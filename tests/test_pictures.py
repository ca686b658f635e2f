"""The documents' pictures: each has its page and its command, and a script that draws it."""

import re
from pathlib import Path

import PIL.Image
import pytest
from test_scripts import script

ROOT = Path(__file__).resolve().parents[1]
PICTURES = sorted((ROOT / "docs" / "pictures").glob("*.png"))
PAGES = {
    path: path.read_text(encoding="utf-8")
    for path in [
        ROOT / "README.md",
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "docs" / "examples").glob("*.py"),
    ]
    if "_build" not in path.parts
}
drawing = script("draw_documents")


@pytest.mark.parametrize("path", PICTURES, ids=lambda path: path.name)
def test_a_picture_has_its_page_and_its_command(path):
    """The page's command is a line of code with the picture's name; the script's tables have
    those of the rest.
    """
    assert any(f"pictures/{path.name}" in text for text in PAGES.values()), "no page shows it"
    is_in_table = path.stem in drawing.PICTURES or path.name in drawing.COMMANDS
    line = re.compile(rf"^.*(tetopt|python|make|chromium) .*\b{re.escape(path.name)}", re.MULTILINE)
    assert is_in_table or any(line.search(text) for text in PAGES.values()), (
        "nothing tells how it was made"
    )
    assert path.stat().st_size <= drawing.LARGEST_BYTES, (
        "it loads slowly; see --shrink of docs/draw_documents.py"
    )


def test_every_drawing_is_on_a_page():
    names = {path.stem for path in PICTURES}
    assert set(drawing.PICTURES) <= names
    assert {Path(name).stem for name in drawing.COMMANDS} <= names


def test_figures_have_captions_and_words_for_those_who_cannot_see_them():
    """Each `figure` of a page has an alt text, and a caption of a sentence at least."""
    n_figures = 0
    for path, text in PAGES.items():
        for target, body in re.findall(
            r"^[`:]{3,}\{figure\} (\S+)\n(.*?)^[`:]{3,}$", text, re.MULTILINE | re.DOTALL
        ):
            n_figures += 1
            assert re.search(r"^:alt: \S+ \S+", body, re.MULTILINE), (path.name, target)
            caption = re.sub(r"^:.*$", "", body, flags=re.MULTILINE).strip()
            assert len(caption.split()) > 5, (path.name, target)
            assert caption.endswith("."), (path.name, target)
    assert n_figures >= len(drawing.PICTURES)


@pytest.mark.drawn
def test_a_drawing_is_written_once(tmp_path, capsys):
    """An existing picture is replaced only by --force; what is written is a picture of a few
    colours.
    """
    arguments = ["-o", str(tmp_path), "--only", "shapes"]
    assert drawing.main(arguments) == 0
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'shapes.png'}: ")
    with PIL.Image.open(tmp_path / "shapes.png") as picture:
        assert picture.mode == "P"
        assert len(picture.convert("RGB").getcolors(256)) > 10
    before = (tmp_path / "shapes.png").read_bytes()
    assert drawing.main(arguments) == 2
    assert "already exists; pass `force`" in capsys.readouterr().err
    assert (tmp_path / "shapes.png").read_bytes() == before
    assert drawing.main([*arguments, "--force"]) == 0
    assert (tmp_path / "shapes.png").read_bytes() == before


def test_a_wide_picture_is_kept_small(tmp_path):
    """Noise of 1500 x 150 pixels is kept no wider than a page, in fewer bytes."""
    noise = PIL.Image.effect_noise((1500, 150), 12.0).convert("RGB")
    noise.save(tmp_path / "noise.png")
    (tmp_path / "kept").mkdir()
    assert (
        drawing.main(["-o", str(tmp_path / "kept"), "--shrink", str(tmp_path / "noise.png")]) == 0
    )
    with PIL.Image.open(tmp_path / "kept" / "noise.png") as picture:
        assert picture.size == (drawing.LARGEST_WIDTH, 140)
    assert (tmp_path / "kept" / "noise.png").stat().st_size < (
        tmp_path / "noise.png"
    ).stat().st_size / 2
