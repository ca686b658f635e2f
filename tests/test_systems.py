"""Other systems than the one that the suite runs on."""

import os
import sys

import pytest

from tetopt.system import kernels

pytestmark = pytest.mark.deep


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
