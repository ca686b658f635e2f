"""A run in numbers: each one recomputed from the meshes and the image."""

import hashlib

import numpy as np
import pytest
from commands import numbers_in

import tetopt
from tetopt.energy.discretization import E_D
from tetopt.energy.geometric import E_G
from tetopt.engine.paper import optimize_paper
from tetopt.image import Image
from tetopt.measure.quality import quality
from tetopt.mesh import Mesh
from tetopt.report.summary import SHOWN_VERSIONS, image_summary, mesh_hash, run_summary
from tetopt.start.lattice import lattice_mesh
from tetopt.system.files import save_json

# 1.5 and sqrt(4.25) mm, 3 mm^2
AFFINE = np.array([[0.0, 2.0, 5.0], [-1.5, 0.5, 7.0], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def image():
    return Image(
        np.random.default_rng(0).normal(50.0, 9.0, (12, 15)) + 40.0 * (np.arange(12)[:, None] > 5),
        AFFINE,
    )


@pytest.fixture(scope="module")
def result(image):
    return optimize_paper(image, lattice_mesh(image, blocks=(3, 4)), iterations=3)


def summary_of(image, result, about):
    shapes = (quality(mesh.points, mesh.cells) for mesh in (result.initial, result.mesh))
    return run_summary(image, result.initial, result, about, {"all": 1.5}, tuple(shapes))


@pytest.fixture(scope="module")
def summary(image, result):
    return summary_of(image, result, {"image": "a.nii", "options": {"k_D": 0.2}})


def test_energies_are_those_of_the_meshes(summary, image, result):
    initial, mesh = result.initial, result.mesh
    shape = E_G(mesh.points, mesh.cells) / E_G(initial.points, initial.cells)
    fit, fit_initial = E_D(image, mesh), E_D(image, initial)
    total = ((image.data - image.data.mean()) ** 2).sum() * 3.0
    expected = {
        "E": 0.8 * shape + 0.2 * fit / fit_initial,
        "E_G_relative": shape,
        "E_D_relative": fit / fit_initial,
        "E_D_fraction_of_variance": fit / total,
        "E_D_fraction_of_variance_initial": fit_initial / total,
    }
    assert summary["energies"] == pytest.approx(expected, rel=1e-9)
    assert fit / fit_initial < 0.9  # so that before and after differ


def test_the_summary_is_json(tmp_path, summary, result):
    """And holds what it was given; its keys are those of run.schema.json."""
    save_json(tmp_path / "run.json", summary)
    back = numbers_in(tmp_path / "run.json")
    assert (back["options"], back["seconds"]) == ({"k_D": 0.2}, {"all": 1.5})
    assert (back["iterations_done"], back["ended"]) == (3, "iterations")
    assert [row["E"] for row in back["history"]] == [row.E for row in result.history]
    for name, mesh in (("quality_initial", result.initial), ("quality", result.mesh)):
        shape = quality(mesh.points, mesh.cells)
        assert back[name]["errors"]["worst"] == shape.errors.worst
        assert back[name]["kinds"] == shape.kinds
    assert back["image_properties"]["affine"] == AFFINE.tolist()
    assert list(back["versions"]) == ["tetopt", "python", *SHOWN_VERSIONS]
    ours = {"tetopt": tetopt.__version__, "numpy": np.__version__}
    assert back["versions"] | ours == back["versions"]


def test_image_properties(image):
    properties = image_summary(image)
    np.testing.assert_array_equal(properties.pop("affine"), AFFINE)
    assert properties.pop("shape") == (12, 15)
    np.testing.assert_allclose(properties.pop("spacing_mm"), [1.5, np.sqrt(4.25)])
    h = image.data
    assert properties == pytest.approx(
        {
            "min": h.min(),
            "max": h.max(),
            "mean": h.mean(),
            "volume_mm": 180 * 3.0,
            "total_variation": ((h - h.mean()) ** 2).sum() * 3.0,
        }
    )


def test_a_constant_image_has_no_fractions(tmp_path):
    image = Image(np.full((8, 9), 7.0))
    made = optimize_paper(image, lattice_mesh(image, blocks=(2, 2)), iterations=1)
    save_json(tmp_path / "run.json", summary_of(image, made, {}))
    energies = numbers_in(tmp_path / "run.json")["energies"]
    fractions = ("E_D_relative", "E_D_fraction_of_variance", "E_D_fraction_of_variance_initial")
    assert [energies[name] for name in fractions] == [None] * 3


def test_hash_is_over_points_and_cells(result):
    points, cells = result.mesh.points, result.mesh.cells
    assert mesh_hash(result.mesh) == hashlib.sha256(points.tobytes() + cells.tobytes()).hexdigest()
    assert mesh_hash(Mesh(points.copy(), cells.copy())) == mesh_hash(result.mesh)
    moved = points.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], np.inf)
    for other in ((moved, cells), (points, np.roll(cells, 1, axis=1)), (points, cells[::-1])):
        assert mesh_hash(Mesh(*other)) != mesh_hash(result.mesh)
