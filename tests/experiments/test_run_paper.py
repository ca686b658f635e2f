"""`tetopt paper` and `tetopt fem`: files, numbers, page, and one line for bad input."""

import json
import re
import shutil
import subprocess

import numpy as np
import PIL.Image
import pytest

import tetopt
from tetopt.cli import main
from tetopt.experiments.run_paper import PICTURES


@pytest.fixture(scope="module")
def run(tmp_path_factory, opengl):
    """The whole command, few seeds, on the head phantom in the place of a brain volume."""
    folder = tmp_path_factory.mktemp("paper")
    tetopt.save_image(folder / "head.nii.gz", tetopt.load_phantom("ellipsoids_brain").image(voxel_mm=3.0))
    out = folder / "out"
    assert main(["paper", "-o", str(out), "--image", str(folder / "head.nii.gz"), "--seeds", "3"]) == 0
    return out


def test_files(run):
    assert {path.name for path in run.iterdir()} == {"paper.json", "paper.html", *PICTURES}
    for name in PICTURES:
        assert np.std(np.asarray(PIL.Image.open(run / name).convert("L"))) > 10.0, name


def test_page_holds_every_number(run):
    """Each printed number and each of ours stands in the page as the JSON has it; nothing points outside."""
    numbers = json.loads((run / "paper.json").read_text())
    page = (run / "paper.html").read_text(encoding="utf-8")
    rows = [row for section in numbers["sections"] for row in section.get("errors", ())]
    assert len(rows) == 9  # rows 1 to 7, the last at three noise levels
    for row in rows:
        for printed, ours in zip(row["errors"], row["ours"], strict=True):
            assert f"<td>{printed:.4f}</td><td>{ours:.4f}</td>" in page
    assert page.count("data:image/png;base64,") == len(PICTURES)
    assert not re.search(r"(src|href)=[\"'](?!data:)", page)


def test_counts_and_row_3(run):
    numbers = json.loads((run / "paper.json").read_text())
    meshes = [row for section in numbers["sections"] for row in section.get("meshes", ())]
    assert [row["name"] for row in meshes] == ["fig2a", "fig3a", "fig3c", "fig3e"]
    assert all(row["paper"] == row["ours"] for row in meshes)
    (row,) = [r for section in numbers["sections"] for r in section.get("errors", ()) if r["name"] == "fig2a"]
    assert [round(value, 4) for value in row["ours"]] == row["errors"]


def test_page_in_a_browser(run, tmp_path):
    """Headless Chromium draws the page and reports no script or image error."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium on this machine")
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-background-networking",
        "--enable-logging=stderr",
    ]
    command = [browser, *flags, f"--user-data-dir={tmp_path}", "--window-size=1000,3000"]
    command += [f"--screenshot={tmp_path / 'page.png'}", (run / "paper.html").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert "CONSOLE" not in done.stderr
    assert np.std(np.asarray(PIL.Image.open(tmp_path / "page.png").convert("L"))) > 20.0


def test_paper_refuses(tmp_path, capsys):
    tetopt.save_image(tmp_path / "flat.nii", tetopt.load_phantom("disc_2d").image(voxel_mm=4.0))
    assert main(["paper", "-o", str(tmp_path / "o"), "--image", str(tmp_path / "flat.nii")]) == 2
    assert "expected a volume, got a 2-D image" in capsys.readouterr().err
    assert main(["paper", "-o", str(tmp_path / "o"), "--seeds", "0"]) == 2
    assert "--seeds: expected 1 or more, got 0" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


@pytest.fixture
def block(tmp_path):
    """A uniform block of intensity 50 and its mesh."""
    tetopt.save_image(tmp_path / "block.nii", tetopt.Image(np.full((8, 8, 8), 50.0)))
    with pytest.warns(UserWarning, match="everywhere"):
        image = tetopt.load_image(tmp_path / "block.nii")
    tetopt.save_mesh(tmp_path / "block.vtu", tetopt.lattice(image, blocks=(2, 2, 2)))
    return [str(tmp_path / "block.nii"), str(tmp_path / "block.vtu")]


def test_fem(tmp_path, block, capsys):
    """The strain energy scales with the modulus and the square of the compression; the printed is the written."""
    energies = {}
    for name, options in (("one", []), ("twice", ["--young", "0:0,50:100"]), ("deep", ["--compress", "2"])):
        assert main(["fem", *block, "--nu", "0.3", "--json", str(tmp_path / f"{name}.json"), *options]) == 0
        numbers = json.loads((tmp_path / f"{name}.json").read_text())
        energies[name] = numbers["strain_energy"]
        assert f"{numbers['cond']:.6g}" in capsys.readouterr().out
    assert energies["twice"] == pytest.approx(2.0 * energies["one"], rel=1e-9)
    assert energies["deep"] == pytest.approx(4.0 * energies["one"], rel=1e-9)
    # Between free sides, 1/2 E strain^2 V, and no sideways strain at all, (1 - nu) / ((1 + nu)(1 - 2 nu)) times that.
    free = 0.5 * 50.0 * 0.01**2 * 512.0
    assert free < energies["one"] < free * 0.7 / (1.3 * 0.4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--young", "1;2"], "expected pairs intensity:kPa"),
        (["--young", "0:0"], "expected"),
        (["--nu", "0.5"], "nu"),
        (["--compress", "0"], "displacement"),
    ],
)
def test_fem_bad_input(block, options, words, capsys):
    assert main(["fem", *block, *options]) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert words in err[-1]
