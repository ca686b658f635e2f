"""Other systems than the one that the suite runs on: the package without what Windows lacks."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tetopt.system import kernels

pytestmark = pytest.mark.deep

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.skipif(sys.platform != "linux", reason="files in use are told by /proc")
def test_commands_run_without_posix_and_replace_nothing_in_use(tmp_path):
    """Every module is imported, commands read and write, a child is ended: see `windows`, which
    does it.
    """
    done = subprocess.run(
        [sys.executable, "-m", "windows", tmp_path],
        env=os.environ | {"PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "tests")))},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]


def test_kernels_are_compiled_beneath_a_launcher(tmp_path, monkeypatch):
    """Windows' environments start Python by a program in between; elsewhere another parent means
    that ours ended.
    """
    compiled = []

    class Kernel:
        compiled = property(lambda self: compiled.append(self))

    monkeypatch.setattr(kernels, "import_module", lambda _: Kernel)
    monkeypatch.setattr(kernels, "ALL_KERNELS", [])
    monkeypatch.setattr(Kernel, "kernel", Kernel(), raising=False)
    foreign = os.getppid() + 1
    kernels.compile_named(["module:kernel"], str(tmp_path), foreign)
    assert compiled == []
    monkeypatch.setattr(sys, "platform", "win32")
    kernels.compile_named(["module:kernel"], str(tmp_path), foreign)
    assert compiled == [Kernel.kernel]
