"""`tetopt fem IMAGE MESH`: energies, files, and one line for bad input."""

import meshio
import numpy as np
import pytest
from commands import assert_refused, exit_code, numbers_in
from numpy.testing import assert_allclose

import tetopt


@pytest.fixture
def block(here):
    """A mesh of a uniform block of intensity 50, in block.nii and block.vtu."""
    tetopt.save_image("block.nii", tetopt.Image(np.full((8, 8, 8), 50.0)))
    with pytest.warns(UserWarning, match="everywhere"):
        image = tetopt.load_image("block.nii")
    mesh = tetopt.lattice_mesh(image, blocks=(2, 2, 2))
    tetopt.save_mesh("block.vtu", mesh)
    return mesh


def test_fem(block, capsys):
    """The strain energy scales with the modulus and the square of the compression; the printed
    is the written.
    """
    energies = []
    for options in ("", "--young 0:0,50:100", "--young 2*h", "--compress 2"):
        assert exit_code(f"fem block.nii block.vtu --nu .3 --json a.json --force {options}") == 0
        numbers = numbers_in("a.json")
        energies.append(numbers["strain_energy"])
        assert f"{numbers['cond']:.6g}" in capsys.readouterr().out
    one, *others = energies
    assert_allclose(others, [2.0 * one, 2.0 * one, 4.0 * one], rtol=1e-9)
    assert others[0] == others[1]
    # Between free sides, 1/2 E strain^2 V, and no sideways strain at all, (1 - nu) / ((1 + nu)(1 -
    # 2 nu)) times that.
    free = 0.5 * 50.0 * 0.01**2 * 512.0
    assert free < one < free * 0.7 / (1.3 * 0.4)


@pytest.mark.full
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--young '1:2;3'", "expected pairs intensity:value"),
        ("--young 'h - 100'", "such as -50 at intensity 50"),
        ("--young 0:1,100:1 --compress 200", "--compress: expected a percentage"),
        ("--young 0:0 --average mean", "young: expected moduli above 0 kPa"),
        ("--average power:20", 'such as power:0.5, got "power:20"'),
        ("--compress 0", "--compress"),
    ],
)
def test_fem_bad_input(block, options, words, capsys):
    assert exit_code(f"fem block.nii block.vtu {options}") == 2
    assert words in capsys.readouterr().err.splitlines()[-1]


def save_unchecked(points, cells):
    """A mesh file, other.vtu, with no checks between: what another program may have written."""
    meshio.Mesh(points, [meshio.CellBlock("tetra", cells)]).write("other.vtu")


@pytest.mark.full
def test_fem_bad_meshes(block, capsys):
    """Each refusal names the first offenders."""
    points, cells, n = block.points, block.cells, len(block.points)
    loose = np.vstack([points, points[cells[0]] * 0.1 + 4.0])
    nearly = np.vstack([points, points[cells[0]].mean(axis=0)])
    half = points[cells].mean(axis=1)[:, 2] < 3.5
    flat, folded = points.copy(), points.copy()
    flat[cells[3, 3]] = flat[cells[3, :3]].mean(axis=0)
    inner = np.flatnonzero(np.all(np.abs(folded - 3.5) < 3.9, axis=1))[0]
    folded[inner] = folded[cells[0]].mean(axis=0)
    # nodes at the same place would be merged
    cracked = np.vstack([points, points + 0.01 * (points == 3.5) * np.array([0.0, 0.0, 1.0])])
    for changed, joined, words in (
        (points * [1.0, 1.0, 0.5], cells, "no node lies on the image's face"),
        (loose, np.vstack([cells, n + np.arange(4)]), f"the first has nodes [{n + 1}, "),
        (cracked, cells + n * ~half[:, None], "a crack or several components"),
        (nearly, np.vstack([cells, np.append(cells[0, :3], n)]), "overlap"),
        (points + np.array([1.0, 0.0, 0.0]), cells, "lie off the faces"),
        (flat, cells, "flat or inverted, such as [3, "),
        (folded, cells, "facets cells overlap"),
    ):
        save_unchecked(changed, joined)
        assert exit_code("fem block.nii other.vtu") == 2
        assert words in capsys.readouterr().err


@pytest.mark.full
def test_fem_turns_inverted_cells_and_says_so(block, capsys):
    """A file of left-handed cells is turned when it is read; the numbers are those of the mesh
    as it should be.
    """
    save_unchecked(block.points, block.cells[:, [1, 0, 2, 3]])
    for name in ("block", "other"):
        assert exit_code(f"fem block.nii {name}.vtu --json {name}.json") == 0
        said = f"reoriented {len(block.cells)} inverted cells"
        assert (said in capsys.readouterr().err) == (name == "other")
    whole, turned = (numbers_in(f"{name}.json")["strain_energy"] for name in ("block", "other"))
    assert turned == pytest.approx(whole, rel=1e-12)


@pytest.mark.full
def test_fem_of_a_crop_and_its_output(here, capsys):
    """A mesh of a crop is pressed with the same --crop; the file written holds the displacements
    that were solved.
    """
    tetopt.save_image("a.nii", tetopt.load_phantom("sphere").image(voxel_mm=4.0))
    crop = "--crop 2:14,2:14,2:14"
    assert exit_code(f"mesh a.nii -o m.vtu {crop} --nodes 80 --iterations 1") == 0
    assert_refused(capsys, "fem a.nii m.vtu", "the same image, crop and slice?")
    assert exit_code(f"fem a.nii m.vtu {crop} --compress 2 -o p.vtu") == 0
    grid = meshio.read("p.vtu")
    u, z = grid.point_data["displacement"], grid.points[:, 2]
    assert_allclose(u[np.isclose(z, z.max())], 0.0, atol=1e-12)
    bottom = u[np.isclose(z, z.min())]
    assert_allclose(bottom, np.tile([0.0, 0.0, 0.02 * np.ptp(z)], (len(bottom), 1)), atol=1e-12)
    assert (grid.cell_data["young"][0] > 0).all()
    assert grid.cell_data["strain"][0].shape == (len(grid.cells[0].data), 9)
    assert_refused(capsys, f"fem a.nii m.vtu {crop} -o m.vtu --force", "is also an input")
