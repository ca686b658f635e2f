"""Fibres on the command line: data of cells or a file of voxels, solved, written and refused."""

from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import assert_refuses, run_command
from models import sample_image
from numpy.testing import assert_allclose

import tetopt
from tetopt.fem.solution import solve
from tetopt.model.materials import along_of

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("here")]

LOADS = "--load hold:superior --load traction:inferior:0.02,0.05,0.04"


@pytest.fixture
def mesh(here):
    """A file of a mesh with directions "v1"."""
    image = sample_image()
    mesh = tetopt.lattice_mesh(image, nodes=60)
    v1 = np.random.default_rng(1).normal(size=(len(mesh.cells), 3))
    tetopt.save_image("i.nii.gz", image)
    tetopt.save_mesh("a.vtu", mesh, {"v1": v1})
    return mesh


def test_fem_solves_with_the_named_fibres(mesh):
    moduli = "--young 3 --nu 0.4 --young-along 9 --shear-along 0.0025MPa"
    out, _ = run_command(f"fem a.vtu --fibre v1 {moduli} {LOADS} -o solved.vtu")
    assert "along fibres, kPa" in out
    loaded = tetopt.load_mesh("a.vtu")
    words = LOADS.replace("--load ", "").split()
    moduli = {"young": 3, "nu": 0.4, "young_along": 9, "shear_along": 2.5}
    model = tetopt.build_model(loaded, fibre="v1", loads=words, **moduli)
    solved = tetopt.load_mesh("solved.vtu")
    assert_allclose(solved.point_data["displacement"], solve(model).u, rtol=1e-9, atol=1e-12)
    assert_allclose(solved.cell_data["fibre"], model.materials.along.fibre, rtol=1e-14)
    run_command(f"fem solved.vtu {LOADS} -o again.vtu")  # with the file's own material
    again = tetopt.load_mesh("again.vtu").point_data["displacement"]
    assert_allclose(again, solve(model).u, rtol=1e-9, atol=1e-12)


def test_convert_states_the_fibres_and_their_groups(mesh):
    moduli = "--young 3 --young-along 9 --bins 8"
    out, _ = run_command(f"convert a.vtu a.inp --fibre v1 {moduli}")
    assert "along fibres: 9 kPa, shear modulus 1.034 kPa" in out
    assert "bins: fibres turned by" in out
    assert Path("a.inp").read_text().count("*ORIENTATION") == 8


def test_a_field_of_directions_is_a_fibre(mesh):
    """As a file of voxels, in world axes."""
    image = tetopt.load_image("i.nii.gz")
    vectors = np.zeros((*image.shape, 3))
    vectors[:] = [0.6, 0.0, -0.8]
    nibabel.save(nibabel.Nifti1Image(vectors, image.affine), "v.nii.gz")
    field = "--field v=v.nii.gz:direction@ras --fibre v --young 3 --young-along 9"
    run_command(f"convert a.vtu b.vtu {field}")
    table = tetopt.build_model(tetopt.load_mesh("b.vtu")).materials
    along = along_of(table)
    cosine = np.abs(along.fibre @ [0.6, 0.0, -0.8])
    assert_allclose(cosine, 1.0, rtol=1e-12)
    assert_allclose(along.young_along, 9.0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--fibre v1 --young 3", "--fibre: needs a modulus along; give --young-along"),
        ("--young 3 --young-along 9", "--young-along: needs the direction of fibres"),
        ("--fibre v2 --young 3 --young-along 9", "--fibre: expected data of cells .*v1"),
        ("--fibre v1 --young 3 --young-along 1", "young-along: expected moduli above 2 nu"),
        ("--fibre v1 --young-along 9", "the mesh's file has no moduli: pass --young"),
    ],
)
def test_what_does_not_fit_is_refused(words, said, mesh):
    assert_refuses(f"fem a.vtu {words} {LOADS}", said)
