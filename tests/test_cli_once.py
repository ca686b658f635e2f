"""Each command runs, once and in turn, on what the one before has written."""

from commands import exit_code

import tetopt

COMMANDS = """\
phantom sphere -o a.nii.gz --voxel-mm 8 --labels l.nii.gz
mesh a.nii.gz -o a.vtu --nodes 60 --iterations 1 --json a.json --young 0:1,255:6
mesh a.nii.gz -o a.vtu --nodes 60 --iterations 1 --labels l.nii.gz --force
convert a.vtu a.vtk
convert a.vtu a.vtk --force
convert a.vtu a.inp --young 3
convert a.vtu a.feb --young 3 --load compress:1%
convert a.vtu a.xdmf
quality a.vtu --image a.nii.gz --check --json q.json
segment a.nii.gz a.vtu -o s.nii.gz
surface a.vtu --boundary -o a.stl
fem a.vtu --young 3 --load compress:1% -o f.vtu
view a.vtu --html v.html
"""


def test_each_command_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line in COMMANDS.splitlines():
        assert exit_code(*line.split()) == 0, line
    assert tetopt.load_mesh("f.vtu").mesh.cells.shape[1] == 4
