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
from commands import assert_done, numbers_in, refusals, run_command
from numpy.testing import assert_allclose, assert_array_equal
from results import FOLDER, our_displacement, solved_model

import tetopt
from tetopt import Image, build_model, load_image, load_mesh, save_image, save_mesh, save_model

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("here")]


@pytest.fixture(params=[1, 2])
def order(request):
    return request.param


@pytest.fixture(autouse=True)
def files(here, request):
    """The mesh that was solved, with results of an earlier run on it, CalculiX's file of both
    orders, the mesh alone, and images; of order 1 where a test takes none.
    """
    order = request.getfixturevalue("order") if "order" in request.fixturenames else 1
    mesh = solved_model(order).mesh
    rest = np.zeros_like(mesh.points)
    cells = {"mean": np.arange(float(len(mesh.cells))), "stress": np.ones((len(mesh.cells), 9))}
    save_mesh("a.vtu", mesh, cells, point_data={"displacement_step7": rest, "heat": rest[:, 0]})
    save_mesh("bare.vtu", mesh)
    for name, k in (("a.frd", order), ("c.vtu", order), ("other.frd", 3 - order)):
        Path(name).write_bytes((FOLDER / f"order_{k}.frd").read_bytes())
    for name, corner in (("i", 0.0), ("far", 1e4)):
        affine = np.eye(4)
        affine[:3, 3] = corner
        save_image(f"{name}.nii.gz", Image(np.zeros((3, 3, 3)), affine))


def page_data(path):
    """What a page holds of its mesh."""
    page = Path(path).read_text(encoding="utf-8")
    return json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))


@pytest.mark.parametrize(("suffix", "options"), [(".vtu", ""), (".vtk", "--space lps --units MPa")])
def test_results_are_in_the_file_in_place_of_earlier_ones(order, suffix, options):
    out = f"b{suffix}"
    said = run_command(f"convert a.vtu {out} --results a.frd --json b.json {options}").out
    loaded = load_mesh(out)
    assert loaded.order == order
    assert list(loaded.cell_data) == ["mean"]
    names = ["displacement", "strain_nodes", "stress_nodes", "von_mises_nodes"]
    steps = ("", "_step2") if order == 1 else ("",)
    assert set(loaded.point_data) == {"heat", *(name + step for name in names for step in steps)}
    u = our_displacement(order, 1)
    assert_allclose(loaded.point_data["displacement"], u, rtol=0.0, atol=6e-6 * np.abs(u).max())
    for name, unit in (("displacement", "mm"), ("von_mises_nodes", "kPa")):
        values = loaded.point_data[name]
        largest = np.linalg.norm(values.reshape(len(values), -1), axis=1).max()
        assert f"a.frd: {name} up to {largest:.4g} {unit}\n" in said
    assert numbers_in("b.json")["results"] == "a.frd"
    assert_done(f"view {out} --html b.html")
    data = page_data("b.html")
    assert [each["step"] for each in data["displacements"]] == ([1, 2] if order == 1 else [0])
    shown = {field["name"] for field in data["fields"]}
    assert shown >= {"displacement", "von_mises_nodes", "mean", "heat"}


def test_results_too_large_are_told(monkeypatch):
    """As by `tetopt fem`: with small numbers for large ones here."""
    for fraction, is_told in ((10.0, False), (1e-9, True)):
        monkeypatch.setattr("tetopt.job.solver_files.SMALL_FRACTION", fraction)
        said = run_command("convert a.vtu b.vtu --results a.frd --force").err
        words = r"warning: .*a.frd: displacement: the largest displacement, .* mm, is"
        assert bool(re.search(words, said)) == is_told


def test_the_page_has_the_reactions_of_the_file():
    mesh = solved_model(1).mesh
    about = {
        "reactions": {"superior": [1, 2, 3.5]},
        "reactions_step2": [1],
        "reactions_step3": {"a": ["x", 1, 2]},
        "reactions_step4": {"superior": [0.0, float("nan"), 1.0]},
    }
    rest = {"displacement": 0.1 * mesh.points}
    save_mesh("a.vtu", mesh, {"mean": np.ones(len(mesh.cells))}, about, rest)
    assert_done("view a.vtu --html a.html")
    assert page_data("a.html")["reactions"] == {"0": {"superior": [1.0, 2.0, 3.5]}}


test_refused = refusals(
    """
convert a.vtu b.inp --results a.frd
    --results: expected an output file .vtu or .vtk
convert a.vtu b.vtu --results no.frd
    no such file
convert a.vtu b.vtu --results other.frd
    belongs to another mesh
convert a.vtu b.vtu --results a.vtu
    expected CalculiX's results
convert a.vtu c.vtu --results c.vtu --force
    is also an input
convert a.vtu u.nii.gz --like i.nii.gz
    which field
convert a.vtu u.nii.gz --like i.nii.gz --fields displacment
    no field "displacment"; it has .*displacement_step7
convert a.vtu u.nii.gz --fields heat
    which image
convert a.vtu u.nii.gz --like i.nii.gz --fields heat --young 3
    --young: has no effect
convert a.vtu u.nii.gz --fields mean --warp i.nii.gz
    displacement of nodes, but mean in .* is a field of cells
convert a.vtu u.nii.gz --fields displacement_step7 --warp i.nii.gz --outside nan
    --outside: expected a
convert a.vtu u.nii.gz --fields displacement_step7 --warp i.nii.gz --space lps
    --space: has no effect
convert i.nii.gz a.vtu u.nii.gz --fields heat --like i.nii.gz
    give only one image
convert a.vtu u.nii.gz --like i.nii.gz --fields heat --nearest
    --nearest: needs --warp
convert a.vtu u.inp --like i.nii.gz
    --like: has no effect
convert a.vtu u.nii.gz --fields heat --like far.nii.gz
    no voxel centre is inside
"""
)


def test_sets_of_the_solver_s_file_are_in_the_mesh_with_results(order):
    corner = ",".join(f"{x:.3f}" for x in solved_model(order).mesh.points[0])
    results = "convert a.vtu b.vtu --results a.frd --force"
    assert "a.inp: missing, or not the input file of this mesh" in run_command(results).err
    assert "tip" not in load_mesh("b.vtu").sets.facets
    asked = f"--young 2 --set tip=point:{corner}:40 --set soft=below:2.5 --order {order}"
    assert_done(f"convert a.vtu a.inp {asked}")
    assert_done(results)
    given, sets = load_mesh("a.inp").sets, load_mesh("b.vtu").sets
    assert_array_equal(sets.facets["tip"], given.facets["tip"])
    assert_array_equal(sets.cells["soft"], given.cells["soft"])
    assert set(sets.cells) == {"soft"}


@pytest.mark.parametrize(
    ("suffix", "nu"), [(".inp", 0.45), (".inp", 0.44), (".xdmf", 0.45), (".vtu", 0.45)]
)
def test_stiff_linear_cells_are_warned_of_where_a_solver_s_file_is_written(suffix, nu):
    mesh, out, n_told = solved_model(1).mesh, f"b{suffix}", int(suffix != ".vtu" and nu == 0.45)
    words = "linear elements are too stiff"
    assert run_command(f"convert bare.vtu {out} --young 2 --nu {nu}").err.count(words) == n_told
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for order in (1, 2):
            save_model(out, build_model(mesh, young=2.0, nu=nu, order=order))
    assert [words in str(each.message) for each in caught] == [True] * n_told


def test_a_displacement_goes_onto_the_voxels_of_an_image(order):
    """As NIfTI's vectors along the world's axes, from the mesh's file or straight from the
    solver's results.
    """
    mesh, u = solved_model(order).mesh, our_displacement(order, 1)
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    affine = np.diag([*(1.2 * (high - low) / [7, 6, 5]), 1.0])
    affine[:3, 3] = low - 0.1 * (high - low)
    image = Image(np.arange(210.0).reshape(7, 6, 5) % 97, affine)
    save_image("i.nii.gz", image)
    field = "--results a.frd --fields displacement --like i.nii.gz --json u.json"
    said = run_command(f"convert a.vtu u.nii.gz {field}").out
    file = nibabel.load("u.nii.gz")
    assert file.header.get_intent()[0] == "vector"
    assert file.shape == (7, 6, 5, 1, 3)
    values, atol = file.get_fdata()[:, :, :, 0], 6e-6 * np.abs(u).max()
    expected = tetopt.field_on_image(mesh, u, image)
    assert_allclose(values, expected, rtol=0.0, atol=atol, equal_nan=True)
    n_voxels = np.isfinite(values[..., 0]).sum()
    assert 0 < n_voxels < 210
    assert f"on {n_voxels} of 210 voxels" in " ".join(said.split())
    assert numbers_in("u.json")["n_voxels"] == n_voxels
    assert_done("convert a.vtu b.vtu --results a.frd")
    assert_done("convert i.nii.gz b.vtu t.nii --fields displacement --space lps --outside 0")
    lps = nibabel.load("t.nii").get_fdata()[:, :, :, 0]
    assert_array_equal(lps, np.nan_to_num(values * [-1, -1, 1]))
    moved = "convert b.vtu w.nii.gz --fields displacement --warp i.nii.gz"
    assert_done(moved)
    again = tetopt.warped_image(mesh, load_mesh("b.vtu").point_data["displacement"], image)
    assert_allclose(load_image("w.nii.gz").data, again.data, atol=1e-5)
    assert_done(f"{moved} --nearest --force")
    assert set(load_image("w.nii.gz").data.ravel()) <= {*image.data.ravel(), 0.0}
