"""A solver's results on a mesh, as a user gets and looks at them: `tetopt convert --results`,
`tetopt view`.
"""

import json
import re
import warnings
from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import assert_done, assert_refused, numbers_in
from numpy.testing import assert_allclose, assert_array_equal
from results import FOLDER, our_displacement, solved_model

import tetopt
from tetopt import Image, build_model, load_image, load_mesh, save_image, save_mesh, save_model
from tetopt.io.abaqus import input_sets

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("here")]


@pytest.fixture(params=[1, 2])
def order(request):
    return request.param


@pytest.fixture(autouse=True)
def folder(here, order):
    """The mesh that was solved, with results of an earlier run on it, and CalculiX's file."""
    mesh = solved_model(order).mesh
    rest = np.zeros_like(mesh.points)
    cells = {"mean": np.arange(float(len(mesh.cells))), "stress": np.ones((len(mesh.cells), 9))}
    save_mesh("a.vtu", mesh, cells, point_data={"displacement_step7": rest, "heat": rest[:, 0]})
    Path("a.frd").write_bytes((FOLDER / f"order_{order}.frd").read_bytes())


@pytest.mark.parametrize(("suffix", "options"), [(".vtu", ""), (".vtk", "--space lps --units MPa")])
def test_results_are_in_the_file_in_place_of_earlier_ones(order, suffix, options, capsys):
    out = f"b{suffix}"
    assert_done(f"convert a.vtu {out} --results a.frd --json b.json {options}")
    loaded = load_mesh(out)
    assert loaded.order == order
    assert list(loaded.cell_data) == ["mean"]
    names = ["heat", "displacement", "strain_nodes", "stress_nodes", "von_mises_nodes"]
    second = [f"{name}_step2" for name in names[1:]] if order == 1 else []
    assert set(loaded.point_data) == {*names, *second}
    u = our_displacement(order, 1)
    assert_allclose(loaded.point_data["displacement"], u, rtol=0.0, atol=6e-6 * np.abs(u).max())
    said = capsys.readouterr().out
    largest = np.linalg.norm(loaded.point_data["displacement"], axis=1).max()
    assert f"a.frd: displacement up to {largest:.4g} mm\n" in said
    assert (
        f"a.frd: von_mises_nodes up to {loaded.point_data['von_mises_nodes'].max():.4g} kPa\n"
        in said
    )
    assert numbers_in("b.json")["results"] == "a.frd"


def test_results_too_large_are_told(order, monkeypatch, capsys):
    """As by `tetopt fem`: with small numbers for large ones here."""
    words = "convert a.vtu b.vtu --results a.frd --force"
    monkeypatch.setattr("tetopt.job.solver_files.SMALL_FRACTION", 10.0)
    assert_done(words)
    assert "the largest displacement" not in capsys.readouterr().err
    monkeypatch.setattr("tetopt.job.solver_files.SMALL_FRACTION", 1e-9)
    assert_done(words)
    assert re.search(
        r"warning: .*a.frd: displacement: the largest displacement, .* mm, is",
        capsys.readouterr().err,
    )


def test_the_page_shows_them(order):
    assert_done("convert a.vtu b.vtu --results a.frd")
    assert_done("view b.vtu --html b.html")
    page = Path("b.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))
    assert [each["step"] for each in data["displacements"]] == ([1, 2] if order == 1 else [0])
    assert {field["name"] for field in data["fields"]} >= {
        "displacement",
        "von_mises_nodes",
        "mean",
        "heat",
    }


def test_the_page_has_the_reactions_of_the_file():
    mesh = solved_model(1).mesh
    about = {
        "reactions": {"superior": [1, 2, 3.5]},
        "reactions_step2": [1],
        "reactions_step3": {"a": ["x", 1, 2]},
    }
    about |= {"reactions_step4": {"superior": [0.0, float("nan"), 1.0]}}
    rest = {"displacement": 0.1 * mesh.points}
    save_mesh("a.vtu", mesh, {"mean": np.ones(len(mesh.cells))}, about, rest)
    assert_done("view a.vtu --html a.html")
    page = Path("a.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))
    assert data["reactions"] == {"0": {"superior": [1.0, 2.0, 3.5]}}


@pytest.mark.parametrize("order", [1], indirect=True)
def test_refusals_write_nothing(capsys):
    Path("c.vtu").write_bytes(Path("a.frd").read_bytes())
    for words, said in (
        ("b.inp --results a.frd", "--results: expected an output file .vtu or .vtk"),
        ("b.vtu --results c.frd", "no such file"),
        (f"b.vtu --results {FOLDER}/order_2.frd", "belongs to another mesh"),
        ("b.vtu --results a.vtu", "expected CalculiX's results"),
        ("c.vtu --results c.vtu --force", "is also an input"),
    ):
        assert_refused(capsys, f"convert a.vtu {words}", said)


def test_sets_of_the_solver_s_file_are_in_the_mesh_with_results(order, capsys):
    corner = ",".join(f"{x:.3f}" for x in solved_model(order).mesh.points[0])
    asked = f"--young 2 --set tip=point:{corner}:40 --set soft=below:2.5 --order {order}"
    results = "--results a.frd --force"
    assert_done(f"convert a.vtu b.vtu {results}")
    assert "a.inp: missing, or not the input file of this mesh" in capsys.readouterr().err
    assert "tip" not in load_mesh("b.vtu").sets.facets
    assert_done(f"convert a.vtu a.inp {asked}")
    assert_done(f"convert a.vtu b.vtu {results}")
    given, sets = input_sets("a.inp", solved_model(order).mesh), load_mesh("b.vtu").sets
    assert_array_equal(sets.facets["tip"], given.facets["tip"])
    assert_array_equal(sets.cells["soft"], given.cells["soft"])
    assert set(sets.cells) == {"soft"}


@pytest.mark.parametrize(
    ("suffix", "nu"), [(".inp", 0.45), (".inp", 0.44), (".xdmf", 0.45), (".vtu", 0.45)]
)
def test_stiff_linear_cells_are_warned_of_where_a_solver_s_file_is_written(suffix, nu, capsys):
    mesh = solved_model(1).mesh
    save_mesh("a.vtu", mesh)
    out, is_said = f"b{suffix}", suffix != ".vtu" and nu == 0.45
    assert_done(f"convert a.vtu {out} --young 2 --nu", str(nu))
    said = capsys.readouterr().err
    assert said.count("linear elements are too stiff") == is_said
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        save_model(out, build_model(mesh, young=2.0, nu=nu))
        save_model(out, build_model(mesh, young=2.0, nu=nu, order=2))
    assert ["linear elements are too stiff" in str(each.message) for each in caught] == [
        True
    ] * is_said


def test_fem_warns_of_stiff_linear_cells_once_in_the_same_words(capsys):
    save_mesh("a.vtu", solved_model(1).mesh)
    assert_done("fem a.vtu --young 2 --nu 0.45 --load compress:2% -o b.vtu")
    assert capsys.readouterr().err.count("linear elements are too stiff") == 1


def test_a_displacement_goes_onto_the_voxels_of_an_image(order, capsys):
    """As NIfTI's vectors along the world's axes, from the mesh's file or straight from the
    solver's results.
    """
    mesh, u = solved_model(order).mesh, our_displacement(order, 1)
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    affine = np.diag([*(1.2 * (high - low) / [7, 6, 5]), 1.0])
    affine[:3, 3] = low - 0.1 * (high - low)
    image = Image(np.arange(210.0).reshape(7, 6, 5) % 97, affine)
    save_image("i.nii.gz", image)
    assert_done(
        "convert a.vtu u.nii.gz --results a.frd --field displacement --like i.nii.gz --json u.json"
    )
    expected = tetopt.field_on_image(mesh, u, image)
    file = nibabel.load("u.nii.gz")
    assert file.header.get_intent()[0] == "vector"
    assert file.shape == (7, 6, 5, 1, 3)
    values = file.get_fdata()[:, :, :, 0]
    assert_allclose(values, expected, rtol=0.0, atol=6e-6 * np.abs(u).max(), equal_nan=True)
    assert 0 < np.isnan(values).sum() < values.size
    said = " ".join(capsys.readouterr().out.split())
    assert f"on {np.isfinite(values[..., 0]).sum()} of 210 voxels" in said
    assert numbers_in("u.json")["n_voxels"] == np.isfinite(values[..., 0]).sum()
    assert_done("convert a.vtu b.vtu --results a.frd")
    assert_done("convert i.nii.gz b.vtu t.nii --field displacement --space lps --outside 0")
    lps = nibabel.load("t.nii").get_fdata()[:, :, :, 0]
    assert_array_equal(lps, np.nan_to_num(values * [-1, -1, 1]))
    moved = "convert b.vtu w.nii.gz --field displacement --warp i.nii.gz"
    assert_done(moved)
    found = load_image("w.nii.gz")
    field = load_mesh("b.vtu").point_data["displacement"]
    again = tetopt.warped_image(mesh, field, image)
    assert_done(f"{moved} --nearest --force")
    nearest = load_image("w.nii.gz").data
    assert set(nearest.ravel()) <= {*image.data.ravel(), 0.0}
    assert_allclose(found.data, again.data, atol=1e-5)


def test_an_image_of_a_field_needs_the_field_and_the_voxels(order, capfd):
    save_image("i.nii.gz", Image(np.zeros((3, 3, 3)), np.eye(4)))
    words = "convert a.vtu u.nii.gz"
    like = "--like i.nii.gz"
    assert_refused(capfd, [words, like], "which field")
    assert_refused(
        capfd,
        f"{words} {like} --field displacment",
        'no field "displacment"; it has .*displacement_step7',
    )
    assert_refused(capfd, f"{words} --field heat", "which image")
    assert_refused(capfd, f"{words} {like} --field heat --young 3", "--young: has no effect")
    warp = "--warp i.nii.gz"
    assert_refused(
        capfd,
        f"{words} --field mean {warp}",
        "displacement of nodes, but mean in .* is a field of cells",
    )
    assert_refused(
        capfd, f"{words} --field displacement_step7 {warp} --outside nan", "--outside: expected a"
    )
    assert_refused(
        capfd, f"{words} --field displacement_step7 {warp} --space lps", "--space: has no effect"
    )
    twice = "convert i.nii.gz a.vtu u.nii.gz --field heat"
    assert_refused(capfd, [twice, like], "give only one image")
    assert_refused(capfd, f"{words} {like} --field heat --nearest", "--nearest: needs --warp")
    assert_refused(capfd, f"convert a.vtu u.inp {like}", "--like: has no effect")
    far = np.eye(4)
    far[:3, 3] = 1e4
    save_image("far.nii.gz", Image(np.zeros((3, 3, 3)), far))
    assert_refused(capfd, f"{words} --field heat --like far.nii.gz", "no voxel centre is inside")
