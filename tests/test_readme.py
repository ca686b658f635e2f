"""The README's program and its commands run as printed, its paths exist, and it is short."""

import re
import shlex
import subprocess
import warnings
from pathlib import Path

import pytest

import tetopt
from tetopt.cli import main

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_it_is_short():
    """Somebody who has never seen tetopt reads it at a sitting."""
    assert len(README.splitlines()) <= 150
    (program,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len([line for line in program.splitlines() if line]) <= 15


@pytest.mark.full
def test_program(tmp_path, monkeypatch, capsys):
    """The Python program, in an empty folder; its numbers are what the text around it promises."""
    (program,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # no defaults that are warned of
        exec(compile(program, "README.md", "exec"), names)
    first, second, third = capsys.readouterr().out.splitlines()
    assert first == "all requirements are met"
    fraction, shape = re.fullmatch(r"unexplained variance (\S+), mean rho (\S+)", second).groups()
    assert 0.0001 < float(fraction) < 0.01
    assert float(shape) > 0.24
    n_materials, error = re.fullmatch(
        r"(\d+) materials, their moduli off by (\S+)% on average", third
    ).groups()
    assert 8 <= int(n_materials) <= 16
    assert 0.0 < float(error) < 5.0
    assert "*MATERIAL" in Path("two_spheres.inp").read_text()
    written = tetopt.load_mesh("two_spheres.vtu")
    assert len(written.mesh.cells) == len(names["result"].mesh.cells)
    assert (
        written.cell_data["mean"] == tetopt.cell_moments(names["image"], written.mesh).mean
    ).all()


@pytest.mark.full
def test_commands(tmp_path, monkeypatch, capsys):
    """The three `tetopt` commands, on a phantom in the place of the T1 and with fewer nodes."""
    lines = [
        line
        for line in README.replace("\\\n", " ").splitlines()
        if line.startswith("tetopt ") and "`" not in line
    ]
    commands = [line for line in lines if re.match(r"tetopt (mesh|quality|convert) \S+\.", line)]
    assert len(commands) == 3
    monkeypatch.chdir(tmp_path)
    assert main(["phantom", "sphere", "-o", "T1.nii.gz", "--voxel-mm", "2"]) == 0
    for line in commands:
        words = [{"5000": "200"}.get(word, word) for word in shlex.split(line)[1:]]
        assert main(words) == 0, line
        assert "warning" not in capsys.readouterr().err, line
    written = {"T1.nii.gz", "brain.vtu", "brain.inp", "run.json", "pictures"}
    assert {path.name for path in tmp_path.iterdir()} == written
    assert {path.name for path in (tmp_path / "pictures").iterdir()} >= {"slice.png", "rho.png"}


def test_the_demo_compiles_for_all_later_commands():
    """It keeps kernels where `tetopt` looks for them, not in the tests' folder."""
    words = ["make", "-n", "-o", ".venv/.demo", "demo"]
    made = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "tetopt demo" in made
    assert "NUMBA_CACHE_DIR" not in made


def test_paths_and_targets_named_exist():
    """Every relative link and picture of the README is there, and what it has make do."""
    for target in ("demo", "test", "docs"):
        assert re.search(
            rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE
        )
        assert f"make {target}" in README
    paths = re.findall(r"\]\(([^)#:]+)\)", README)
    assert len(paths) > 10
    for path in paths:
        assert (ROOT / path).exists(), path
