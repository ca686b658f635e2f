"""Runs of order 2 with labels: what they tell and write, and what `tetopt quality` says of
folded cells.
"""

import numpy as np
import pytest
import schemas
from commands import exit_code, numbers_in
from meshes import with_bent_edges
from models import sample_image, sample_model
from numpy.testing import assert_array_equal

import tetopt
from tetopt.geometry.quadratic import numbered_edges
from tetopt.geometry.topology import boundary_facets


@pytest.mark.full
def test_a_run_counts_and_writes_curved_edges(tmp_path):
    labels = tetopt.load_phantom("sphere").label_image(voxel_mm=4)
    tetopt.save_image(tmp_path / "l.nii.gz", labels)
    output, numbers = tmp_path / "ball.vtu", tmp_path / "run.json"
    job = tetopt.Job(
        images=tmp_path / "l.nii.gz",
        labels=tmp_path / "l.nii.gz",
        output=output,
        nodes=600,
        order=2,
        iterations=6,
        json_path=numbers,
        young="2",
        nu=0.3,
        loads=["hold:inferior", "pressure:superior:0.1"],
    )
    told = []
    result = tetopt.run(job, on=told.append)
    curving = result.optimized.curving
    (words,) = [event.text for event in told if "edges on smooth surfaces" in event.text]
    assert words.startswith(
        f"{curving.n_on_level} of {curving.n_edges} edges on smooth surfaces have their mid-edge "
        "node"
    )
    written = numbers_in(numbers)
    schemas.assert_described(written)
    assert written["curving"] == curving._asdict()
    assert curving.n_on_level > 50
    volumes = np.bincount(result.optimized.labels, result.mesh.cell_volumes)
    assert [row["mesh_volume"] for row in written["labels"]] == pytest.approx(volumes)
    assert written["quality"]["volume"] == pytest.approx(labels.volume, rel=1e-12)
    assert written["quality"]["smallest_volume"] == pytest.approx(result.mesh.cell_volumes.min())
    back = tetopt.load_mesh(output)
    assert_array_equal(back.mesh.midpoints, result.mesh.midpoints)
    solved, again = (
        tetopt.solve(tetopt.build_model(mesh)) for mesh in (back, back._replace(mesh=result.mesh))
    )
    assert_array_equal(solved.u, again.u)
    straight = tetopt.Mesh(result.mesh.points, result.mesh.cells)
    assert (
        np.abs(solved.u - tetopt.solve(tetopt.build_model(back._replace(mesh=straight))).u).max()
        > 1e-4
    )


def test_a_start_with_curved_edges_loses_them_without_labels(tmp_path):
    image = sample_image()
    tetopt.save_image(tmp_path / "a.nii.gz", image)
    tetopt.save_mesh(
        tmp_path / "s.vtu", with_bent_edges(tetopt.lattice_mesh(image, nodes=60), 0.05), order=2
    )
    for iterations in (1, 0):
        told = []
        job = tetopt.Job(
            images=tmp_path / "a.nii.gz",
            start=tmp_path / "s.vtu",
            output=tmp_path / f"{iterations}.vtu",
            order=2,
            iterations=iterations,
        )
        result = tetopt.run(job, on=told.append)
        is_lost = any("curved edges become straight" in event.text for event in told)
        assert is_lost == (result.mesh.midpoints is None) == (iterations == 1)


def test_volumes_of_converted_cells_are_those_of_the_written_order(tmp_path):
    """Straight cells have the volume that their surface encloses, and keep it with order 2
    again.
    """
    mesh = with_bent_edges(sample_model().mesh, 0.05)
    tetopt.save_mesh(
        tmp_path / "2.vtu", mesh, {"volume": mesh.cell_volumes, "rho": mesh.cell_volumes}, order=2
    )
    surface = mesh.points[boundary_facets(mesh.cells)]
    for source, output, order in (("2", "1", 1), ("1", "again", 2)):
        paths = (tmp_path / f"{name}.vtu" for name in (source, output))
        assert exit_code("convert", *paths, "--order", order) == 0
        back = tetopt.load_mesh(tmp_path / f"{output}.vtu")
        assert (back.order, back.mesh.midpoints) == (order, None)
        assert back.cell_data["volume"].sum() == pytest.approx(np.linalg.det(surface).sum() / 6.0)
        assert_array_equal(back.cell_data["volume"], back.mesh.cell_volumes)
        assert_array_equal(back.cell_data["rho"], mesh.cell_volumes)
    assert np.abs(mesh.cell_volumes / back.cell_data["volume"] - 1.0).max() > 1e-3


@pytest.mark.parametrize("is_folded", [False, True])
def test_quality_of_curved_cells(is_folded, tmp_path, capfd):
    mesh = with_bent_edges(sample_model().mesh, 0.05)
    if is_folded:
        midpoints, (a, b) = mesh.midpoints.copy(), numbered_edges(mesh.cells)[0][3]
        midpoints[3] = mesh.points[a] + 1.2 * (mesh.points[b] - mesh.points[a])
        mesh = tetopt.Mesh(mesh.points, mesh.cells, midpoints)
    tetopt.save_mesh(tmp_path / "a.vtu", mesh, order=2)
    numbers = tmp_path / "a.json"
    assert exit_code("quality", tmp_path / "a.vtu", "--check", "--json", numbers) == int(is_folded)
    shown = capfd.readouterr()
    assert "scaled Jacobian of curved cells, smallest" in shown.out
    assert "Sizes are those of the curved cells; shapes, E_D and" in shown.out
    assert f"{mesh.cell_volumes.sum():.2f}" in shown.out
    assert ("quadratic cells folded by their mid-edge nodes" in shown.err) == is_folded
    written = numbers_in(numbers)
    schemas.assert_described(written)
    assert (written["min_scaled_jacobian"] <= 0.0) == is_folded
    assert written["quality"]["volume"] == pytest.approx(mesh.cell_volumes.sum())


def test_a_surface_of_curved_cells_is_told_to_be_flat(tmp_path, capfd):
    mesh = with_bent_edges(sample_model().mesh, 0.05)
    tetopt.save_mesh(tmp_path / "a.vtu", mesh, order=2)
    assert exit_code("surface", tmp_path / "a.vtu", "--boundary", "-o", tmp_path / "a.stl") == 0
    shown = capfd.readouterr()
    assert "its cells are curved; the triangles are flat, between the corners of cells" in shown.err
    assert f"{mesh.cell_volumes.sum():.6g}" in shown.out
