"""The reference's pages say what the code does: examples of files, keys and names."""

import re
from pathlib import Path

import pytest

import tetopt
from tetopt.cli import main
from tetopt.contents import phantom

pytestmark = pytest.mark.full

REFERENCE = Path(__file__).resolve().parents[1] / "docs" / "reference"


def page(name):
    return (REFERENCE / f"{name}.md").read_text(encoding="utf-8")


def first_column(text, heading):
    """The names in the first column of the table under a heading."""
    rows = (
        re.search(rf"^## {heading}$(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
        .group(1)
        .splitlines()
    )
    return [
        name
        for row in rows
        if row.startswith("| `")
        for name in re.findall(r"`([^`]+)`", row.split("|")[1])
    ]


def test_phantom_example(tmp_path):
    """The TOML table is rendered by the command beside it; intensities and the ellipsoid's
    volume are as written.
    """
    (table,) = re.findall(r"```toml\n(.*?)```", page("phantom_file"), re.DOTALL)
    (tmp_path / "tissue.toml").write_text(table, encoding="utf-8")
    assert "tetopt phantom tissue.toml -o tissue.nii.gz" in page("phantom_file")
    assert (
        main(["phantom", str(tmp_path / "tissue.toml"), "-o", str(tmp_path / "tissue.nii.gz")]) == 0
    )
    image = tetopt.load_image(tmp_path / "tissue.nii.gz")
    assert image.shape == (40, 40, 30)
    volume = (image.data - 10.0).sum() / 50.0
    assert volume == pytest.approx(4.0 / 3.0 * 3.141592653589793 * 9 * 6 * 6, rel=2e-3)


def test_phantom_keys():
    """The page's keys are those that the reader takes, and its phantoms those that there are."""
    top = [*phantom._TOP_KEYS, *phantom._TOP_OPTIONS]
    text = page("phantom_file")
    assert sorted(name.strip("[]") for name in first_column(text, "Top level")) == sorted(top)
    of_kinds = {key for keys in phantom._SHAPE_KEYS.values() for key in keys}
    assert set(first_column(text, "Each shape")) == {
        "kind",
        "intensity",
        "label",
        "name",
        "rotation_deg",
        *of_kinds,
    }
    assert first_column(text, "Built-in phantoms") == phantom.phantom_names()
