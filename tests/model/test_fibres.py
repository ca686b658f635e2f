"""Models with fibres: their choices, groups of directions, files in every format."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from models import fibre_model, sample_image
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

import tetopt
from tetopt.fem.solution import solve
from tetopt.io.formats import FORMATS, save_model
from tetopt.model.materials import Along, along_of, bin_moduli, group_directions, materials


@pytest.fixture
def mesh():
    return tetopt.lattice_mesh(sample_image(), nodes=60)


def directions(mesh):
    return np.random.default_rng(1).normal(size=(len(mesh.cells), 3))


def test_directions_are_given_or_named(mesh):
    fibre = directions(mesh)
    moduli = {"young": 3.0, "nu": 0.4, "young_along": "0.009 MPa", "shear_along": 2.5}
    table = tetopt.build_model(mesh, fibre=7.0 * fibre, **moduli).materials
    assert_allclose(
        table.along.fibre, fibre / np.linalg.norm(fibre, axis=1, keepdims=True), rtol=1e-14
    )
    own = (table.young, table.nu, table.along.young_along, table.along.shear_along)
    assert_allclose(np.ravel(own), [3.0, 0.4, 9.0, 2.5], rtol=1e-14)
    named = tetopt.build_model(mesh, fibre="v1", cell_data={"v1": fibre}, **moduli).materials
    assert_allclose(named.along.fibre, table.along.fibre, rtol=1e-14)


def test_moduli_along_follow_intensity_and_labels(mesh):
    image, fibre = sample_image(), directions(mesh)
    young = "1 + 0.01*h"
    model = tetopt.build_model(mesh, image, young=young, fibre=fibre, young_along="3 + 0.03*h")
    along = along_of(model.materials)
    across = model.materials.young[model.materials.of_cell]
    assert np.ptp(across) > 0.1
    assert_allclose(along.young_along, 3.0 * across, rtol=1e-12)
    assert_allclose(along.shear_along, across / 2.9, rtol=1e-12)  # of the default nu
    labels = (model.cell_data["mean"] > 25.0).astype(int)
    by_label = {"young_along": "0=5,1=6", "shear_along": "*=2", "cell_data": {"label": labels}}
    table = tetopt.build_model(mesh, young=2.0, fibre=fibre, **by_label).materials
    assert_array_equal(along_of(table).young_along, np.where(labels == 1, 6.0, 5.0))
    # quadratic cells have one modulus, too
    quadratic = tetopt.build_model(
        mesh, image, young=young, fibre=fibre, young_along="3 + 0.03*h", order=2
    )
    assert quadratic.gauss_young is None
    assert np.isfinite(solve(quadratic._replace(loads=fibre_model().loads)).u).all()


def test_cells_without_a_direction_are_told_and_isotropic(mesh):
    fibre = directions(mesh)
    fibre[3] = 0.0
    fibre[5, 1] = np.nan
    with pytest.warns(UserWarning, match=r"fibre: 2 of \d+ cells, .*% of the volume, have no dir"):
        model = tetopt.build_model(mesh, young=3.0, nu=0.4, fibre=fibre, young_along=9.0)
    along = along_of(model.materials)
    assert_array_equal(along.fibre[[3, 5]], 0.0)
    assert_allclose(along.young_along[[3, 4, 5]], [3.0, 9.0, 3.0])


REFUSED = {
    "no modulus along": ({"young_along": None}, "fibre: needs a modulus along"),
    "no direction": ({"fibre": None}, "young_along: needs the direction of fibres"),
    "no modulus": ({"young": None}, "fibre: a material also needs a modulus"),
    "unknown name": ({"fibre": "v2"}, "fibre: expected data of cells with three numbers, .*v1"),
    "at nodes": ({"average": "nodes"}, "fibre: moduli along fibres are constant within cells"),
    "too soft along": ({"young_along": 0.5}, "young_along: expected moduli above 2 nu"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_refused(mesh, case):
    changed, words = REFUSED[case]
    choices = {"young": 3.0, "nu": 0.4, "fibre": "v1", "young_along": 9.0} | changed
    with refusal(words):
        tetopt.build_model(mesh, cell_data={"v1": directions(mesh)}, **choices)


def test_triangles_are_refused():
    flat = tetopt.lattice_mesh(sample_image(2), nodes=30)
    with refusal("fibre: expected a tetrahedral mesh"):
        tetopt.build_model(flat, young=3.0, fibre=np.ones((len(flat.cells), 3)), young_along=9.0)


# Groups of directions


def test_groups_of_directions_and_their_error():
    """Every cell has the nearest of the groups, whatever the sign; means and largest angles are
    those of the cells.
    """
    rng = np.random.default_rng(2)
    fibre = rng.normal(size=(500, 3))
    fibre /= np.linalg.norm(fibre, axis=1, keepdims=True)
    fibre[7] = 0.0
    volumes = rng.uniform(1.0, 2.0, 500)
    grouped, angle = group_directions(fibre, 12)
    is_along = np.arange(500) != 7
    kinds = np.unique(grouped[is_along], axis=0)
    assert len(kinds) == 12
    assert_array_equal(grouped[7], 0.0)
    expected = np.degrees(np.arccos(np.abs(fibre @ kinds.T).max(axis=1).clip(max=1.0)))
    assert_allclose(angle[is_along], expected[is_along], atol=1e-4)
    # a sphere's half, divided among 12, is discs of 23.6 degrees at best
    assert 23.6 < angle.max() < 2.0 * 23.6
    assert_allclose(group_directions(-fibre, 12)[1], angle, atol=1e-12)
    exact = materials(np.full(500, 3.0), 0.4, 500, along=Along(9.0, 2.5, fibre))
    binned = bin_moduli(exact, volumes, 12)
    mean = (angle * volumes).sum() / volumes.sum()
    assert_allclose(binned.fibre_binning, (mean, angle.max()), rtol=1e-12)
    assert binned.binning.largest == 0.0


def test_few_directions_stay():
    kinds = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]])
    fibre = np.vstack([kinds, -kinds, kinds])
    grouped, angle = group_directions(fibre, 2)
    assert_array_equal(angle, 0.0)
    assert_array_equal(grouped, np.vstack([kinds] * 3))
    assert group_directions(fibre, 1)[1].max() == pytest.approx(90.0)


# Files

WITH_FIBRES = (".vtu", ".vtk", ".xdmf", ".msh", ".inp", ".feb")


@pytest.mark.parametrize("bins", [None, 8])
@pytest.mark.parametrize("suffix", WITH_FIBRES[:4])
def test_fibres_are_read_back_and_solved(suffix, bins, here):
    """In other axes and units: the same moduli, directions and solution."""
    model = fibre_model(bins)
    save_model(f"a{suffix}", model, space="lps", units="MPa")
    loaded = tetopt.load_mesh(f"a{suffix}")
    words = ["hold:superior", "traction:inferior:0.02,0.05,0.04"]
    with warnings.catch_warnings(action="ignore"):  # of cells without a direction
        back = tetopt.build_model(loaded, loads=words)
    if suffix in (".vtu", ".vtk"):
        assert back.materials.fibre_binning == model.materials.fibre_binning
    own, other = along_of(model.materials), along_of(back.materials)
    for mine, theirs in zip(own, other, strict=True):
        assert_allclose(theirs, mine, rtol=1e-12, atol=1e-13)
    assert_allclose(solve(back).u, solve(model).u, atol=1e-9 * np.abs(solve(model).u).max())
    named = {"fibre", "young_along", "shear_along"} & set(back.cell_data)
    assert not named  # they are the materials'
    with pytest.warns(UserWarning, match="dropped the fibres of the mesh's file"):
        assert tetopt.build_model(loaded, young=2.0).materials.along is None


@pytest.mark.parametrize("suffix", WITH_FIBRES[4:])
def test_solvers_files_are_read_without_moduli(suffix, here):
    """And not with those across alone."""
    model = fibre_model()
    save_model(f"a{suffix}", model)
    loaded = tetopt.load_mesh(f"a{suffix}")
    assert not {"young", "nu", "fibre"} & set(loaded.cell_data)
    assert set(loaded.sets.cells) == set(model.sets.cells)


@pytest.mark.parametrize("suffix", [".msh2", ".mfem", ".mesh"])
def test_formats_without_fibres_refuse_them(suffix, here):
    with refusal("support fibres"):
        save_model(f"a{suffix}", fibre_model())
    assert not Path(f"a{suffix}").exists()
    assert set(WITH_FIBRES) == {s for s, f in FORMATS.items() if f.has_fibres}


def test_a_users_own_directions_stay(mesh, here):
    """Data of cells named as the material's are a user's, until there is a material with fibres."""
    fibre = directions(mesh)
    tetopt.save_mesh("a.vtu", mesh, {"fibre": fibre})
    loaded = tetopt.load_mesh("a.vtu")
    assert_array_equal(tetopt.build_model(loaded, young=2.0).cell_data["fibre"], fibre)
    model = tetopt.build_model(loaded, young=2.0, fibre="fibre", young_along=5.0)
    assert model.materials.along is not None


def test_a_set_with_the_name_of_a_groups_set_is_refused(here):
    model = fibre_model()
    sets = model.sets._replace(cells=model.sets.cells | {"Fibres-3": np.array([1])})
    with refusal('the file uses the name "Fibres-3"'):
        save_model("a.inp", model._replace(sets=sets))


def test_a_nonlinear_step_is_refused(here):
    with refusal("abaqus: materials with fibres are linear"):
        save_model("a.inp", fibre_model()._replace(is_nonlinear=True))
