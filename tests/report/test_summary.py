"""A run in numbers: each one recomputed from the meshes and the image."""

import hashlib
import json

import numpy as np
import pytest

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
def initial(image):
    return lattice_mesh(image, blocks=(3, 4))


@pytest.fixture(scope="module")
def result(image, initial):
    return optimize_paper(image, initial, iterations=3)


@pytest.fixture(scope="module")
def summary(image, initial, result):
    about = {"image": "a.nii", "image_sha256": "00", "options": {"k_D": 0.2}}
    return run_summary(image, initial, result, about, {"all": 1.5})


def test_energies_are_those_of_the_meshes(summary, image, initial, result):
    energies = summary["energies"]
    shape = E_G(result.mesh.points, result.mesh.cells) / E_G(initial.points, initial.cells)
    fit, fit_initial = E_D(image, result.mesh), E_D(image, initial)
    total = ((image.data - image.data.mean()) ** 2).sum() * 3.0
    assert energies["E_G_relative"] == pytest.approx(shape, rel=1e-9)
    assert energies["E_D_relative"] == pytest.approx(fit / fit_initial, rel=1e-9)
    assert energies["E"] == pytest.approx(0.8 * shape + 0.2 * fit / fit_initial, rel=1e-9)
    assert energies["E_D_fraction_of_variance"] == pytest.approx(fit / total, rel=1e-9)
    assert energies["E_D_fraction_of_variance_initial"] == pytest.approx(
        fit_initial / total, rel=1e-9
    )
    assert energies["E_D_relative"] < 0.9  # so that before and after differ


def test_the_summary_is_json(tmp_path, summary, initial, result):
    """And holds what it was given; its keys are those of run.schema.json."""
    save_json(tmp_path / "run.json", summary)
    back = json.loads((tmp_path / "run.json").read_text())
    assert back["options"] == {"k_D": 0.2}
    assert back["seconds"] == {"all": 1.5}
    assert (back["iterations_done"], back["ended"]) == (3, "iterations")
    assert [row["E"] for row in back["history"]] == [row.E for row in result.history]
    for name, mesh in (("quality_initial", initial), ("quality", result.mesh)):
        shape = quality(mesh.points, mesh.cells)
        assert (back[name]["errors"]["worst"], back[name]["kinds"]) == (
            shape.errors.worst,
            shape.kinds,
        )
    assert back["image_properties"]["affine"] == AFFINE.tolist()
    assert list(back["versions"]) == ["tetopt", "python", *SHOWN_VERSIONS]
    assert (back["versions"]["tetopt"], back["versions"]["numpy"]) == (
        tetopt.__version__,
        np.__version__,
    )


def test_image_properties(image):
    properties = image_summary(image)
    assert properties["shape"] == (12, 15)
    np.testing.assert_allclose(properties["spacing_mm"], [1.5, np.sqrt(4.25)])
    np.testing.assert_array_equal(properties["affine"], AFFINE)
    assert properties["volume_mm"] == pytest.approx(180 * 3.0)
    assert (properties["min"], properties["max"]) == (image.data.min(), image.data.max())
    assert properties["mean"] == pytest.approx(image.data.mean())
    assert properties["total_variation"] == pytest.approx(
        ((image.data - image.data.mean()) ** 2).sum() * 3.0
    )


def test_total_variation_is_E_D_of_one_cell_around_everything():
    image = Image(np.random.default_rng(0).normal(size=(5, 6, 7)), np.diag([0.5, 2.0, 3.0, 1.0]))
    mesh = Mesh(
        [[-99, -99, -99], [500, -99, -99], [-99, 500, -99], [-99, -99, 500]], [[0, 1, 2, 3]]
    )
    assert image_summary(image)["total_variation"] == pytest.approx(E_D(image, mesh), rel=1e-9)


def test_a_constant_image_has_no_fractions(tmp_path):
    image = Image(np.full((8, 9), 7.0))
    initial = lattice_mesh(image, blocks=(2, 2))
    summary = run_summary(image, initial, optimize_paper(image, initial, iterations=1), {}, {})
    fractions = ["E_D_relative", "E_D_fraction_of_variance", "E_D_fraction_of_variance_initial"]
    assert [summary["energies"][name] for name in fractions] == [None] * 3
    save_json(tmp_path / "run.json", summary)
    assert json.loads((tmp_path / "run.json").read_text())["energies"]["E_D_relative"] is None


def test_hash_is_over_points_and_cells(result):
    points, cells = result.mesh.points, result.mesh.cells
    assert mesh_hash(result.mesh) == hashlib.sha256(points.tobytes() + cells.tobytes()).hexdigest()
    assert mesh_hash(Mesh(points.copy(), cells.copy())) == mesh_hash(result.mesh)
    moved = points.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], np.inf)
    assert mesh_hash(Mesh(moved, cells)) != mesh_hash(result.mesh)
    assert mesh_hash(Mesh(points, np.roll(cells, 1, axis=1))) != mesh_hash(result.mesh)
    assert mesh_hash(Mesh(points, cells[::-1])) != mesh_hash(result.mesh)
