"""Runs of order 2 with labels: what they tell and write, and what `tetopt quality` says of
folded cells.
"""

import numpy as np
import pytest
import schemas
from commands import numbers_in, run_command
from meshes import with_bent_edges
from models import sample_image, sample_model
from numpy.testing import assert_array_equal

import tetopt
from tetopt.geometry.quadratic import numbered_edges
from tetopt.geometry.topology import boundary_facets

pytestmark = pytest.mark.usefixtures("here")


def save_bent(folded=False):
    """The sample's mesh with bent edges, one of them folded over, as a.vtu."""
    mesh = with_bent_edges(sample_model().mesh, 0.05)
    if folded:
        midpoints, (a, b) = mesh.midpoints.copy(), numbered_edges(mesh.cells)[0][3]
        midpoints[3] = mesh.points[a] + 1.2 * (mesh.points[b] - mesh.points[a])
        mesh = tetopt.Mesh(mesh.points, mesh.cells, midpoints)
    sizes = {"volume": mesh.cell_volumes, "rho": mesh.cell_volumes}
    tetopt.save_mesh("a.vtu", mesh, sizes, order=2)
    return mesh


@pytest.mark.full
def test_a_run_counts_and_writes_curved_edges():
    labels = tetopt.load_phantom("sphere").label_image(voxel_mm=4)
    tetopt.save_image("l.nii.gz", labels)
    job = tetopt.Job(
        images="l.nii.gz",
        labels="l.nii.gz",
        output="ball.vtu",
        nodes=600,
        order=2,
        iterations=6,
        json_path="run.json",
        young="2",
        nu=0.3,
        loads=["hold:inferior", "pressure:superior:0.1"],
    )
    told = []
    result = tetopt.run(job, on=told.append)
    curving, mesh = result.optimized.curving, result.mesh
    (words,) = [event.text for event in told if "edges on smooth surfaces" in event.text]
    counts = f"{curving.n_on_level} of {curving.n_edges}"
    assert words.startswith(f"{counts} edges on smooth surfaces have their mid-edge node")
    assert curving.n_on_level > 50
    written = numbers_in("run.json")
    schemas.assert_described(written)
    assert written["curving"] == curving._asdict()
    volumes = np.bincount(result.optimized.labels, mesh.cell_volumes)
    assert [row["mesh_volume"] for row in written["labels"]] == pytest.approx(volumes)
    assert written["quality"]["volume"] == pytest.approx(labels.volume, rel=1e-12)
    assert written["quality"]["smallest_volume"] == pytest.approx(mesh.cell_volumes.min())
    back = tetopt.load_mesh("ball.vtu")
    assert_array_equal(back.mesh.midpoints, mesh.midpoints)
    straight = tetopt.Mesh(mesh.points, mesh.cells)
    solved, again, other = (
        tetopt.solve(tetopt.build_model(back._replace(mesh=each))).u
        for each in (back.mesh, mesh, straight)
    )
    assert_array_equal(solved, again)
    assert np.abs(solved - other).max() > 1e-4


@pytest.mark.parametrize("iterations", [1, 0])
def test_a_start_with_curved_edges_loses_them_without_labels(iterations):
    image = sample_image()
    tetopt.save_image("a.nii.gz", image)
    mesh = with_bent_edges(tetopt.lattice_mesh(image, nodes=60), 0.05)
    tetopt.save_mesh("s.vtu", mesh, order=2)
    told, options = [], {"order": 2, "iterations": iterations}
    job = tetopt.Job(images="a.nii.gz", start="s.vtu", output="b.vtu", **options)
    result = tetopt.run(job, on=told.append)
    is_lost = any("curved edges become straight" in event.text for event in told)
    assert is_lost == (result.mesh.midpoints is None) == (iterations == 1)


def test_volumes_of_converted_cells_are_those_of_the_written_order():
    """Straight cells have the volume that their surface encloses, and keep it with order 2
    again.
    """
    mesh = save_bent()
    surface = mesh.points[boundary_facets(mesh.cells)]
    for source, output, order in (("a", "1", 1), ("1", "again", 2)):
        run_command(f"convert {source}.vtu {output}.vtu --order {order}")
        back = tetopt.load_mesh(f"{output}.vtu")
        assert (back.order, back.mesh.midpoints) == (order, None)
        assert back.cell_data["volume"].sum() == pytest.approx(np.linalg.det(surface).sum() / 6.0)
        assert_array_equal(back.cell_data["volume"], back.mesh.cell_volumes)
        assert_array_equal(back.cell_data["rho"], mesh.cell_volumes)
    assert np.abs(mesh.cell_volumes / back.cell_data["volume"] - 1.0).max() > 1e-3


@pytest.mark.parametrize("is_folded", [False, True])
def test_quality_of_curved_cells(is_folded):
    volume = save_bent(is_folded).cell_volumes.sum()
    out, err = run_command("quality a.vtu --check --json a.json", code=int(is_folded))
    assert "scaled Jacobian of curved cells, smallest" in out
    assert "Sizes are those of the curved cells; shapes, E_D and" in out
    assert f"{volume:.2f}" in out
    assert ("quadratic cells folded by their mid-edge nodes" in err) == is_folded
    written = numbers_in("a.json")
    schemas.assert_described(written)
    assert (written["min_scaled_jacobian"] <= 0.0) == is_folded
    assert written["quality"]["volume"] == pytest.approx(volume)


def test_a_surface_of_curved_cells_is_told_to_be_flat():
    volume = save_bent().cell_volumes.sum()
    out, err = run_command("surface a.vtu --boundary -o a.stl")
    assert "its cells are curved; the triangles are flat, between the corners of cells" in err
    assert f"{volume:.6g}" in out
