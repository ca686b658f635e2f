"""Processes that the command starts: none of them runs modules of the folder that it is called
in.
"""

import shutil
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest
from models import sample_image

from tetopt.io.images import save_image
from tetopt.system.interpreter import others_environment

pytestmark = pytest.mark.deep

MODULES = sorted(
    name
    for name in sys.stdlib_module_names | packages_distributions().keys()
    if name.isidentifier()
)
PLANTED = "import os\nopen({path!r}, 'a').write(__name__ + ' ')\n"
COMMANDS = {  # and the kernels' compilers: tests/test_kernels.py
    "a file read by a compiled library": "mesh a.nrrd -o {out}/a.vtu --nodes 60 --iterations 0",
    "a pipeline": "compare a.nii -o {out}/compared --nodes 60 --pipelines mine --pipeline "
    "mine={program}",
    "workers whose tasks are processes": "cohort subjects.tsv -o {out}/cohort --nodes 60 "
    "--iterations 0 --workers 1",
}
NRRD = """NRRD0004
type: float
dimension: 3
sizes: 9 8 7
space: left-posterior-superior
space directions: (1,0,0) (0,1,0) (0,0,1)
encoding: raw
endian: little

"""


@pytest.fixture(scope="module")
def untrusted(tmp_path_factory):
    """A folder with images, and a module of each name that Python or what is installed here has."""
    folder = tmp_path_factory.mktemp("untrusted")
    save_image(folder / "a.nii", sample_image(3))
    (folder / "a.nrrd").write_bytes(NRRD.encode() + np.arange(504, dtype="<f4").tobytes())
    (folder / "subjects.tsv").write_text("subject\timage\n1\ta.nii\n")
    for name in MODULES:
        (folder / f"{name}.py").write_text(PLANTED.format(path=str(folder / "executed")))
    return folder


@pytest.mark.parametrize("name", COMMANDS)
def test_modules_of_the_current_folder_are_not_run(untrusted, tmp_path, name):
    """A user's own program imports what lies beside it all the same."""
    (tmp_path / "program.py").write_text("import sys, beside")
    (tmp_path / "beside.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')")
    command = shutil.which("tetopt", path=Path(sys.executable).parent)
    words = [
        word.format(
            out=tmp_path, program=f"{sys.executable} {tmp_path / 'program.py'} {{image}} {{output}}"
        )
        for word in COMMANDS[name].split()
    ]
    done = subprocess.run(
        [command, *words], cwd=untrusted, env=others_environment(), capture_output=True, text=True
    )
    executed = untrusted / "executed"
    assert not executed.exists(), executed.read_text()
    assert (
        (tmp_path / "imported").exists() if name == "a pipeline" else done.returncode in (0, 1)
    ), done.stderr
