"""Each command runs, once and in turn, on what the one before has written."""

from commands import exit_code
from windows import COMMANDS

import tetopt


def test_each_command_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line in COMMANDS.splitlines():
        assert exit_code(*line.split()) == 0, line
    assert tetopt.load_mesh("f.vtu").mesh.cells.shape[1] == 4


def test_help_and_refusals(capsys):
    """The one on standard output, a line on standard error for the other."""
    assert exit_code("mesh", "--help") == 0
    assert "--nodes" in capsys.readouterr().out
    assert exit_code("mesh", "no.nii", "-o", "a.vtu", "--nodes", "many") == 2
    assert capsys.readouterr().err.startswith(
        "tetopt: --nodes: expected a whole number, got 'many'"
    )
