"""CalculiX's results of our own input files come back onto the mesh, as `tetopt fem` finds them."""

import shutil
import subprocess

import numpy as np
import pytest
from commands import exit_code
from results import CASES, FOLDER, input_file, solved_model

import tetopt
from tetopt.io.frd import read_frd

CCX = shutil.which("ccx")
pytestmark = pytest.mark.skipif(CCX is None, reason="no CalculiX: ccx is not on the PATH (apt install calculix-ccx)")


def run(folder, name):
    subprocess.run([CCX, "-i", name], cwd=folder, capture_output=True, timeout=120, check=True)


@pytest.mark.parametrize("order", CASES)
def test_the_files_that_reading_is_tested_with_are_what_it_writes(order, tmp_path):
    (tmp_path / "job.inp").write_bytes(input_file(order))
    run(tmp_path, "job")
    mesh = solved_model(order).mesh
    anew, kept = (read_frd(path, mesh) for path in (tmp_path / "job.frd", FOLDER / f"order_{order}.frd"))
    assert list(anew.point_data) == list(kept.point_data)
    for name, values in kept.point_data.items():
        np.testing.assert_allclose(anew.point_data[name], values, rtol=0.0, atol=1e-5 * np.abs(values).max())


def test_from_image_to_solver_and_back(tmp_path):
    """By the commands, in MPa and LPS there: the displacements are those of `tetopt fem`."""
    image = tetopt.load_phantom("two_spheres").image(voxel_mm=4.0)
    tetopt.save_image(tmp_path / "a.nii.gz", image)
    mapping = ["--young", "0.5 + h/7", "--nu", "0.3"]
    mesh = ["mesh", tmp_path / "a.nii.gz", "-o", tmp_path / "a.vtu", "--spacing", "12", "--iterations", "0"]
    assert exit_code(*mesh) == 0
    inp = ["convert", tmp_path / "a.vtu", tmp_path / "a.inp", "--image", tmp_path / "a.nii.gz", *mapping]
    assert exit_code(*inp, "--load", "compress:3%", "--units", "MPa", "--space", "lps") == 0
    run(tmp_path, "a")
    assert exit_code("convert", tmp_path / "a.vtu", tmp_path / "b.vtu", "--results", tmp_path / "a.frd") == 0
    fem = ["fem", tmp_path / "a.nii.gz", tmp_path / "a.vtu", *mapping, "--compress", "3", "-o", tmp_path / "c.vtu"]
    assert exit_code(*fem) == 0
    theirs, ours = (tetopt.load_mesh(tmp_path / name).point_data["displacement"] for name in ("b.vtu", "c.vtu"))
    np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=1e-5 * np.abs(ours).max())
    assert np.abs(ours).max() > 1.5
