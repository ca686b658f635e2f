"""A solver's results on a mesh, as a user gets and looks at them: `tetopt convert --results`,
`tetopt view`.
"""

import json
import re
import warnings

import nibabel
import numpy as np
import pytest
from commands import assert_refused, exit_code, numbers_in
from results import FOLDER, our_displacement, solved_model

import tetopt
from tetopt.io.abaqus import input_sets

pytestmark = pytest.mark.full


@pytest.fixture(params=[1, 2])
def order(request):
    return request.param


@pytest.fixture
def folder(order, tmp_path):
    """The mesh that was solved, with results of an earlier run on it, and CalculiX's file."""
    mesh = solved_model(order).mesh
    rest = np.zeros_like(mesh.points)
    cells = {"mean": np.arange(float(len(mesh.cells))), "stress": np.ones((len(mesh.cells), 9))}
    tetopt.save_mesh(
        tmp_path / "a.vtu", mesh, cells, point_data={"displacement_step7": rest, "heat": rest[:, 0]}
    )
    (tmp_path / "a.frd").write_bytes((FOLDER / f"order_{order}.frd").read_bytes())
    return tmp_path


@pytest.mark.parametrize(
    ("suffix", "options"), [(".vtu", []), (".vtk", ["--space", "lps", "--units", "MPa"])]
)
def test_results_are_in_the_file_in_place_of_earlier_ones(folder, order, suffix, options, capsys):
    out = folder / f"b{suffix}"
    words = [
        "convert",
        folder / "a.vtu",
        out,
        "--results",
        folder / "a.frd",
        "--json",
        folder / "b.json",
        *options,
    ]
    assert exit_code(*words) == 0
    loaded = tetopt.load_mesh(out)
    assert loaded.order == order
    assert list(loaded.cell_data) == ["mean"]
    names = ["heat", "displacement", "strain_nodes", "stress_nodes", "von_mises_nodes"]
    second = [f"{name}_step2" for name in names[1:]] if order == 1 else []
    assert set(loaded.point_data) == {*names, *second}
    u = our_displacement(order, 1)
    np.testing.assert_allclose(
        loaded.point_data["displacement"], u, rtol=0.0, atol=6e-6 * np.abs(u).max()
    )
    said = capsys.readouterr().out
    largest = np.linalg.norm(loaded.point_data["displacement"], axis=1).max()
    assert f"a.frd: displacement up to {largest:.4g} mm\n" in said
    assert (
        f"a.frd: von_mises_nodes up to {loaded.point_data['von_mises_nodes'].max():.4g} kPa\n"
        in said
    )
    assert numbers_in(folder / "b.json")["results"] == "a.frd"


def test_results_too_large_are_told(folder, order, monkeypatch, capsys):
    """As by `tetopt fem`: with small numbers for large ones here."""
    words = [
        "convert",
        folder / "a.vtu",
        folder / "b.vtu",
        "--results",
        folder / "a.frd",
        "--force",
    ]
    monkeypatch.setattr("tetopt.job.model.SMALL_FRACTION", 10.0)
    assert exit_code(*words) == 0
    assert "the largest displacement" not in capsys.readouterr().err
    monkeypatch.setattr("tetopt.job.model.SMALL_FRACTION", 1e-9)
    assert exit_code(*words) == 0
    assert re.search(
        r"warning: .*a.frd: displacement: the largest displacement, .* mm, is",
        capsys.readouterr().err,
    )


def test_the_page_shows_them(folder, order):
    assert (
        exit_code("convert", folder / "a.vtu", folder / "b.vtu", "--results", folder / "a.frd") == 0
    )
    assert exit_code("view", folder / "b.vtu", "--html", folder / "b.html") == 0
    page = (folder / "b.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))
    assert [each["step"] for each in data["displacements"]] == ([1, 2] if order == 1 else [0])
    assert {field["name"] for field in data["fields"]} >= {
        "displacement",
        "von_mises_nodes",
        "mean",
        "heat",
    }


def test_the_page_has_the_reactions_of_the_file(tmp_path):
    mesh = solved_model(1).mesh
    about = {
        "reactions": {"superior": [1, 2, 3.5]},
        "reactions_step2": [1],
        "reactions_step3": {"a": ["x", 1, 2]},
    }
    about |= {"reactions_step4": {"superior": [0.0, float("nan"), 1.0]}}
    rest = {"displacement": 0.1 * mesh.points}
    tetopt.save_mesh(tmp_path / "a.vtu", mesh, {"mean": np.ones(len(mesh.cells))}, about, rest)
    assert exit_code("view", tmp_path / "a.vtu", "--html", tmp_path / "a.html") == 0
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))
    assert data["reactions"] == {"0": {"superior": [1.0, 2.0, 3.5]}}


@pytest.mark.parametrize("order", [1], indirect=True)
def test_refusals_write_nothing(folder, capsys):
    def refused(words, *arguments):
        before = {path.name for path in folder.iterdir()}
        assert exit_code("convert", folder / "a.vtu", *arguments) == 2
        said = capsys.readouterr().err
        assert words in re.sub(r"\s+", " ", said)
        assert {path.name for path in folder.iterdir()} == before

    refused(
        "--results: expected an output file .vtu or .vtk",
        folder / "b.inp",
        "--results",
        folder / "a.frd",
    )
    refused("no such file", folder / "b.vtu", "--results", folder / "c.frd")
    refused("belongs to another mesh", folder / "b.vtu", "--results", FOLDER / "order_2.frd")
    refused("expected CalculiX's results", folder / "b.vtu", "--results", folder / "a.vtu")
    (folder / "c.vtu").write_bytes((folder / "a.frd").read_bytes())
    refused("is also an input", folder / "c.vtu", "--results", folder / "c.vtu", "--force")


def test_sets_of_the_solver_s_file_are_in_the_mesh_with_results(folder, order, capsys):
    corner = ",".join(f"{x:.3f}" for x in solved_model(order).mesh.points[0])
    asked = [
        "--young",
        "2",
        "--set",
        f"tip=point:{corner}:40",
        "--set",
        "soft=below:2.5",
        "--order",
        str(order),
    ]
    results = ["--results", folder / "a.frd", "--force"]
    assert exit_code("convert", folder / "a.vtu", folder / "b.vtu", *results) == 0
    assert "a.inp: missing, or not the input file of this mesh" in capsys.readouterr().err
    assert "tip" not in tetopt.load_mesh(folder / "b.vtu").sets.facets
    assert exit_code("convert", folder / "a.vtu", folder / "a.inp", *asked) == 0
    assert exit_code("convert", folder / "a.vtu", folder / "b.vtu", *results) == 0
    given, sets = (
        input_sets(folder / "a.inp", solved_model(order).mesh),
        tetopt.load_mesh(folder / "b.vtu").sets,
    )
    np.testing.assert_array_equal(sets.facets["tip"], given.facets["tip"])
    np.testing.assert_array_equal(sets.cells["soft"], given.cells["soft"])
    assert set(sets.cells) == {"soft"}


@pytest.mark.parametrize(
    ("suffix", "nu"), [(".inp", 0.45), (".inp", 0.44), (".xdmf", 0.45), (".vtu", 0.45)]
)
def test_stiff_linear_cells_are_warned_of_where_a_solver_s_file_is_written(
    tmp_path, suffix, nu, capsys
):
    mesh = solved_model(1).mesh
    tetopt.save_mesh(tmp_path / "a.vtu", mesh)
    out, is_said = tmp_path / f"b{suffix}", suffix != ".vtu" and nu == 0.45
    assert exit_code("convert", tmp_path / "a.vtu", out, "--young", "2", "--nu", str(nu)) == 0
    said = capsys.readouterr().err
    assert said.count("linear elements are too stiff") == is_said
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tetopt.save_model(out, tetopt.build_model(mesh, young=2.0, nu=nu))
        tetopt.save_model(out, tetopt.build_model(mesh, young=2.0, nu=nu, order=2))
    assert ["linear elements are too stiff" in str(each.message) for each in caught] == [
        True
    ] * is_said


def test_fem_warns_of_stiff_linear_cells_once_in_the_same_words(tmp_path, capsys):
    tetopt.save_mesh(tmp_path / "a.vtu", solved_model(1).mesh)
    words = ["--young", "2", "--nu", "0.45", "--load", "compress:2%"]
    assert exit_code("fem", tmp_path / "a.vtu", *words, "-o", tmp_path / "b.vtu") == 0
    assert capsys.readouterr().err.count("linear elements are too stiff") == 1


def test_a_displacement_goes_onto_the_voxels_of_an_image(folder, order, capsys):
    """As NIfTI's vectors along the world's axes, from the mesh's file or straight from the
    solver's results.
    """
    mesh, u = solved_model(order).mesh, our_displacement(order, 1)
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    affine = np.diag([*(1.2 * (high - low) / [7, 6, 5]), 1.0])
    affine[:3, 3] = low - 0.1 * (high - low)
    image = tetopt.Image(np.arange(210.0).reshape(7, 6, 5) % 97, affine)
    tetopt.save_image(folder / "i.nii.gz", image)
    words = [
        "convert",
        folder / "a.vtu",
        folder / "u.nii.gz",
        "--results",
        folder / "a.frd",
        "--field",
        "displacement",
    ]
    assert exit_code(*words, "--like", folder / "i.nii.gz", "--json", folder / "u.json") == 0
    expected = tetopt.field_on_image(mesh, u, image)
    file = nibabel.load(folder / "u.nii.gz")
    assert file.header.get_intent()[0] == "vector"
    assert file.shape == (7, 6, 5, 1, 3)
    values = file.get_fdata()[:, :, :, 0]
    np.testing.assert_allclose(
        values, expected, rtol=0.0, atol=6e-6 * np.abs(u).max(), equal_nan=True
    )
    assert 0 < np.isnan(values).sum() < values.size
    said = " ".join(capsys.readouterr().out.split())
    assert f"on {np.isfinite(values[..., 0]).sum()} of 210 voxels" in said
    assert numbers_in(folder / "u.json")["n_voxels"] == np.isfinite(values[..., 0]).sum()
    assert (
        exit_code("convert", folder / "a.vtu", folder / "b.vtu", "--results", folder / "a.frd") == 0
    )
    turned = [
        "convert",
        folder / "i.nii.gz",
        folder / "b.vtu",
        folder / "t.nii",
        "--field",
        "displacement",
    ]
    assert exit_code(*turned, "--space", "lps", "--outside", "0") == 0
    lps = nibabel.load(folder / "t.nii").get_fdata()[:, :, :, 0]
    np.testing.assert_array_equal(lps, np.nan_to_num(values * [-1, -1, 1]))
    moved = [
        "convert",
        folder / "b.vtu",
        folder / "w.nii.gz",
        "--field",
        "displacement",
        "--warp",
        folder / "i.nii.gz",
    ]
    assert exit_code(*moved) == 0
    found = tetopt.load_image(folder / "w.nii.gz")
    field = tetopt.load_mesh(folder / "b.vtu").point_data["displacement"]
    again = tetopt.warped_image(mesh, field, image)
    assert exit_code(*moved, "--nearest", "--force") == 0
    nearest = tetopt.load_image(folder / "w.nii.gz").data
    assert set(nearest.ravel()) <= {*image.data.ravel(), 0.0}
    np.testing.assert_allclose(found.data, again.data, atol=1e-5)


def test_an_image_of_a_field_needs_the_field_and_the_voxels(folder, order, capfd):
    tetopt.save_image(folder / "i.nii.gz", tetopt.Image(np.zeros((3, 3, 3)), np.eye(4)))
    words = ["convert", folder / "a.vtu", folder / "u.nii.gz"]
    like = ["--like", folder / "i.nii.gz"]
    assert_refused(capfd, [*words, *like], "which field")
    assert_refused(
        capfd,
        [*words, *like, "--field", "displacment"],
        'no field "displacment"; it has .*displacement_step7',
    )
    assert_refused(capfd, [*words, "--field", "heat"], "which image")
    assert_refused(
        capfd, [*words, *like, "--field", "heat", "--young", "3"], "--young: has no effect"
    )
    warp = ["--warp", folder / "i.nii.gz"]
    assert_refused(
        capfd,
        [*words, "--field", "mean", *warp],
        "displacement of nodes, but mean in .* is a field of cells",
    )
    assert_refused(
        capfd,
        [*words, "--field", "displacement_step7", *warp, "--outside", "nan"],
        "--outside: expected a",
    )
    assert_refused(
        capfd,
        [*words, "--field", "displacement_step7", *warp, "--space", "lps"],
        "--space: has no effect",
    )
    twice = [
        "convert",
        folder / "i.nii.gz",
        folder / "a.vtu",
        folder / "u.nii.gz",
        "--field",
        "heat",
    ]
    assert_refused(capfd, [*twice, *like], "give only one image")
    assert_refused(
        capfd, [*words, *like, "--field", "heat", "--nearest"], "--nearest: needs --warp"
    )
    assert_refused(
        capfd, ["convert", folder / "a.vtu", folder / "u.inp", *like], "--like: has no effect"
    )
    far = np.eye(4)
    far[:3, 3] = 1e4
    tetopt.save_image(folder / "far.nii.gz", tetopt.Image(np.zeros((3, 3, 3)), far))
    assert_refused(
        capfd,
        [*words, "--field", "heat", "--like", folder / "far.nii.gz"],
        "no voxel centre is inside",
    )
    assert not (folder / "u.nii.gz").exists()
