"""CalculiX's results of our own input files come back onto the mesh, as `tetopt fem` finds them."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import assert_done, exit_code
from numpy.testing import assert_allclose
from results import CASES, FOLDER, input_file, solved_model

import tetopt
from tetopt.io.frd import read_frd

CCX = shutil.which("ccx")
pytestmark = pytest.mark.skipif(
    CCX is None, reason="no CalculiX: ccx is not on the PATH (apt install calculix-ccx)"
)


def run(folder, name):
    subprocess.run([CCX, "-i", name], cwd=folder, capture_output=True, timeout=120, check=True)


@pytest.mark.parametrize("order", CASES)
def test_the_files_that_reading_is_tested_with_are_what_it_writes(order, tmp_path):
    (tmp_path / "job.inp").write_bytes(input_file(order))
    run(tmp_path, "job")
    mesh = solved_model(order).mesh
    anew, kept = (
        read_frd(path, mesh) for path in (tmp_path / "job.frd", FOLDER / f"order_{order}.frd")
    )
    assert list(anew.point_data) == list(kept.point_data)
    for name, values in kept.point_data.items():
        assert_allclose(anew.point_data[name], values, rtol=0.0, atol=1e-5 * np.abs(values).max())


@pytest.mark.parametrize("units", ["MPa", "Pa"])
def test_from_image_to_solver_and_back(here, units):
    """By the commands, in other units and LPS there: the displacements are those of `tetopt
    fem`.
    """
    image = tetopt.load_phantom("two_spheres").image(voxel_mm=4.0)
    tetopt.save_image("a.nii.gz", image)
    mapping = '--young "0.5+h/7 kPa" --nu 0.3'
    loads = "--load compress:3% --space lps --units"
    assert_done("mesh a.nii.gz -o a.vtu --spacing 12 --iterations 0")
    assert_done("convert a.vtu a.inp --image a.nii.gz", mapping, loads, units)
    run(here, "a")
    assert_done("convert a.vtu b.vtu --results a.frd")
    assert_done("fem a.nii.gz a.vtu", mapping, "--compress 3 -o c.vtu")
    theirs, ours = (
        tetopt.load_mesh(name).point_data["displacement"] for name in ("b.vtu", "c.vtu")
    )
    assert_allclose(theirs, ours, rtol=0.0, atol=1e-5 * np.abs(ours).max())
    assert np.abs(ours).max() > 1.5


def test_an_organ_is_pressed_and_its_displacement_is_on_the_voxels(tmp_path, monkeypatch):
    """The four commands of docs/howto/organ.md, as they stand there, on a liver of two balls."""
    page = (Path(__file__).parents[2] / "docs" / "howto" / "organ.md").read_text(encoding="utf-8")
    (block,) = (each for each in re.findall(r"```bash\n(.*?)```", page, re.DOTALL) if "ccx" in each)
    lines = [shlex.split(line) for line in block.replace("\\\n", " ").splitlines()]
    assert [words[0] for words in lines] == ["tetopt", "tetopt", "ccx", "tetopt"]
    place = np.indices((36, 30, 32))
    near = [
        np.sqrt(sum((x - c) ** 2 for x, c in zip(place, at, strict=True)))
        for at in ((14, 14, 14), (22, 15, 17))
    ]
    seg = np.where(np.minimum(*near) <= 10, 5, np.where(place[2] > 26, 3, 0))
    affine = np.diag([-2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = 40.0, -70.0, 900.0
    tetopt.save_image(tmp_path / "seg.nii.gz", tetopt.Image(seg, affine))
    (tmp_path / "names.csv").write_text("label,name\n3,spleen\n5,liver\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for words in lines:
        if words[0] == "ccx":
            run(tmp_path, words[2])
        else:
            assert exit_code(*words[1:]) == 0
    u = nibabel.load("u.nii.gz")
    values, inside = u.get_fdata()[:, :, :, 0], np.isfinite(u.get_fdata()[:, :, :, 0, 0])
    assert_allclose(u.affine, affine)
    assert (inside == (seg == 5)).mean() > 0.995
    z = affine[2, 3] + affine[2, 2] * place[2][inside]
    height = z.max() - z.min()
    up, along = values[inside][:, 2], (z - z.min()) / height
    assert up[along < 0.05].mean() == pytest.approx(0.05 * height, rel=0.15)
    assert np.abs(up[along > 0.97]).max() < 0.01 * height
    assert np.corrcoef(up, along)[0, 1] < -0.6
