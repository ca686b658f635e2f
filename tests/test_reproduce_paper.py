"""`scripts/reproduce_paper.py`: one small run of all, its files and page, and one line for bad
input.
"""

import re
from types import SimpleNamespace

import numpy as np
import PIL.Image
import pytest
from browser import browser, copied, document
from commands import numbers_in
from numpy.testing import assert_allclose
from paper import experiments as paper
from paper.report import PAPER_PICTURES
from reproduce_paper import main

import tetopt

pytestmark = pytest.mark.deep


@pytest.fixture(scope="module")
def run(tmp_path_factory, opengl):
    """The whole command, small: few seeds, places and nodes, on the head phantom in the place of
    a brain volume.
    """
    folder = tmp_path_factory.mktemp("paper")
    phantom = tetopt.load_phantom("ellipsoids_brain")
    tetopt.save_image(folder / "head.nii.gz", phantom.image(voxel_mm=4.0))
    tetopt.save_image(folder / "tissue.nii.gz", phantom.label_image(voxel_mm=4.0))
    lattice, landscape = paper.lattice_mesh, paper.figure_2b

    def fewer(image, *kind, nodes=None, **options):
        return lattice(image, *kind, nodes=nodes and 1500, **options)

    words = (
        f"-o {folder}/out --image {folder}/head.nii.gz --labels {folder}/tissue.nii.gz --seeds 2"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "figure_2b", lambda k_D: landscape(k_D, n_places=9))
        patch.setattr(paper, "lattice_mesh", fewer)
        assert main(words.split()) == 0
    out = folder / "out"
    numbers, page = numbers_in(out / "paper.json"), (out / "paper.html").read_text(encoding="utf-8")
    return SimpleNamespace(out=out, numbers=numbers, sections=numbers["sections"], page=page)


@pytest.mark.drawn
def test_files(run):
    names = {"paper.json", "paper.html", *PAPER_PICTURES}
    assert {path.name for path in run.out.iterdir()} == names
    for name in PAPER_PICTURES:
        assert np.std(np.asarray(PIL.Image.open(run.out / name).convert("L"))) > 10.0, name
    assert run.page.count("data:image/png;base64,") == len(PAPER_PICTURES)
    assert not re.search(r"(src|href)=[\"'](?!data:)", run.page)


def cells(*texts):
    return "".join(f"<td>{text}</td>" for text in texts)


def texts_of(section):
    """What the page is to show of a section of the JSON."""
    for row in section.get("errors", ()):
        yield cells(f"{row['errors'][1]:.4f}", f"{row['geometric_mean']:.4f}")
        for printed, ours in zip(row["errors"], row["ours"], strict=True):
            difference = f"{ours - printed:+.4f}".replace("-0.0000", "+0.0000")
            yield cells(f"{printed:.4f}", f"{ours:.4f}", difference)
    for value in section.get("E_D_relative", {}).values():
        yield cells(f"{value:.4f}")
    for row in section.get("minima", ()):
        yield cells(f"{row['lowest']:.4f}", f"{row['found']:.4f}")
    for overlaps in section.get("dice", {}).values():
        yield cells(*(f"{value:.3f}" for value in overlaps.values()))
    for case in section.get("simulation", ()):
        for name, printed in paper.printed_numbers()["change"].items():
            change = case["change"][name]
            points = f"{100 * (change - printed):+.1f} points"
            yield cells(f"{100 * printed:+.0f} %", f"{100 * change:+.1f} %", points)


def test_page_holds_every_number(run):
    """As the JSON has it, beside what the paper prints."""
    texts = [text for section in run.sections for text in texts_of(section)]
    assert [text for text in ["head.nii.gz", *texts] if text not in run.page] == []
    assert run.numbers["image"] == "head.nii.gz"


def test_numbers_are_those_of_the_experiments(run):
    """Changes are after over before, counts the printed ones, rows their own; an optimised mesh
    segments better than the lattice.
    """
    rows, meshes, cases = (
        [row for section in run.sections for row in section.get(name, ())]
        for name in ("errors", "meshes", "simulation")
    )
    assert len(rows) == 9  # rows 1 to 7, the last at three noise levels
    assert [row["name"] for row in meshes] == ["fig2a", "fig3a", "fig3c", "fig3e"]
    assert all(row["paper"] == row["ours"] for row in meshes)
    assert len(cases) == 3
    for case in cases:
        before, after, change = (
            np.array([*case[name].values()]) for name in ("before", "after", "change")
        )
        assert_allclose(change, after / before - 1.0)
    for row, k_D in zip(rows[3:5], (0.05, 0.3), strict=True):
        assert row["ours"] == pytest.approx(paper.errors_of(paper.figure_2(k_D).result.mesh))
    spread = paper.figure_1_spread(2)
    for row in rows[:2]:
        ends = np.percentile(spread[row["name"]], [5, 95], axis=0)
        assert_allclose([row["p5"], row["p95"]], ends)
    figure_2, section_5 = (section["dice"] for section in run.sections if "dice" in section)
    assert figure_2["initial mesh"]["3"] < figure_2["k_D = 0.3"]["3"] - 0.2
    labels = set(map(str, range(9)))  # of the phantom
    assert all(set(row) == labels for row in section_5.values())
    lattice, mesh, voxels = (
        np.mean([*section_5[f"4 classes, {name}"].values()])
        for name in ("lattice", "optimised", "voxels")
    )
    assert lattice < mesh <= voxels + 1e-9


def test_page_in_a_browser(run, tmp_path):
    """Headless Chromium draws the page and reports no script or image error; it is short on a
    wide screen.
    """
    picture = tmp_path / "page.png"
    page = (run.out / "paper.html").as_uri()
    browser(tmp_path / "profile", "--window-size=1000,3000", f"--screenshot={picture}", page)
    assert np.std(np.asarray(PIL.Image.open(picture).convert("L"))) > 20.0
    height = (
        "<script>onload = ({target: {documentElement: e}}) => { e.dataset.height = "
        "e.scrollHeight; }</script>"
    )
    copy = copied(run.page, tmp_path / "copy.html", last=height)
    head = document(copy, "--window-size=1280,900")[:400]
    assert int(re.search(r'data-height="(\d+)"', head)[1]) <= 5000


def test_paper_refuses(here, capsys):
    tetopt.save_image("flat.nii", tetopt.load_phantom("disc_2d").image(voxel_mm=4.0))
    for name, size in (("head.nii", 4.0), ("small.nii", 5.0)):
        tetopt.save_image(name, tetopt.load_phantom("sphere").label_image(voxel_mm=size))
    for words, said in (
        ("--image flat.nii", "expected a volume, got a 2-D image"),
        ("--seeds 0", "--seeds: expected 1 or more, got 0"),
        ("--image head.nii --labels small.nii", "expected labels on the image's grid"),
    ):
        assert main(["-o", "o", *words.split()]) == 2
        assert said in capsys.readouterr().err
    assert not (here / "o").exists()
