"""The README's program runs as printed, and its commands exist."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

import tetopt
from tetopt.cli import main

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_program(tmp_path, monkeypatch, capsys):
    """The Python program, in an empty folder; its numbers are what the text around it promises."""
    (program,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(program, "README.md", "exec"), names)
    printed = capsys.readouterr().out.splitlines()
    share, shape = re.fullmatch(r"(\S+) of the variance inside cells, mean rho (\S+)", printed[0]).groups()
    assert 0.0001 < float(share) < 0.01
    assert float(shape) > 0.24
    assert float(re.fullmatch(r"the stiffer sphere alone: Dice (\S+)", printed[2]).group(1)) > 0.97
    n_materials, error = re.fullmatch(r"(\d+) materials, modulus off by (\S+)% in the mean", printed[3]).groups()
    assert 8 <= int(n_materials) <= 16
    assert 0.0 < float(error) < 5.0
    assert "*MATERIAL" in Path("two_spheres.inp").read_text()
    written = tetopt.load_mesh("two_spheres.vtu")
    assert len(written.mesh.cells) == len(names["result"].mesh.cells)
    assert written.cell_data["mean"].max() == names["cells"].mean.max()


def test_commands(tmp_path, monkeypatch):
    """Each `tetopt` line of the README, on a phantom in the place of the T1, with fewer nodes and a larger error."""
    fewer = {"--nodes": "200", "--target-error": "0.1"}
    lines = [
        line
        for line in README.splitlines()
        if re.match("tetopt (mesh|cohort|quality|phantom|fem|segment|convert|surface|view) ", line)
    ]
    assert len(lines) == 21
    monkeypatch.chdir(tmp_path)
    assert main(["phantom", "sphere", "-o", "T1.nii.gz", "--voxel-mm", "2", "--labels", "mask.nii.gz"]) == 0
    shutil.copy("T1.nii.gz", "T2.nii.gz")
    shutil.copy("mask.nii.gz", "tissues.nii.gz")
    Path("tissues.csv").write_text("label,name\n1,grey matter\n")
    Path("subjects.tsv").write_text("subject\timage\n01\tT1.nii.gz\n02\tT2.nii.gz\n")
    for line in lines:
        words = shlex.split(line, comments=True)[1:]
        words = [fewer.get(before, word) for before, word in zip(["", *words], words, strict=False)]
        assert main(words) == 0, line
    files = {
        "T1.nii.gz",
        "T2.nii.gz",
        "mask.nii.gz",
        "tissues.nii.gz",
        "organ.vtu",
        "sagging.vtu",
        "head.vtu",
        "tissues.vtu",
        "tissues.csv",
        "named.vtu",
        "labels.nii.gz",
        "brain.vtu",
        "fine.vtu",
        "uniform.vtu",
        "tissues.inp",
        "tissues.feb",
        "T1.xdmf",
        "better.vtu",
        "dark.stl",
        "look.html",
        "run.json",
        "sphere.nii.gz",
        "subjects.tsv",
        "OUT",
        "slice.png",
        "rho.png",
        "energies.png",
        "thumbnail.png",
    }
    assert {path.name for path in tmp_path.iterdir()} == files


@pytest.mark.parametrize("target", ["demo", "test", "bench", "lint"])
def test_make_targets(target):
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert target == "lint" or f"make {target}" in README


def test_paths_named_exist():
    """Every relative link and file of the README is there."""
    for name in re.findall(r"\]\(([^)#:]+)\)|!\[[^\]]*\]\(([^)]+)\)", README):
        assert (ROOT / (name[0] or name[1])).exists(), name
