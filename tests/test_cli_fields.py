"""Fields on grids of their own, as a user brings them: `--field` on mesh, convert, fem and view."""

import json
import re
from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import assert_done, refusals, run_command
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt.model.averages import cell_young
from tetopt.start.carve import part_of

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("here")]
FIELDS = "--field V=v.nii.gz:direction@fsl --field D=d.nii.gz:tensor@ras-lower --field mu=m.nii.gz"


@pytest.fixture(autouse=True)
def files(here):
    """A mesh, its image, and fields on a coarser grid that is turned."""
    image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    tetopt.save_image("i.nii.gz", image)
    tetopt.save_mesh("a.vtu", tetopt.lattice_mesh(image, nodes=80))
    affine = np.eye(4)
    affine[:3, :3] = [[0.0, 8.0, 0.0], [0.0, 0.0, -8.0], [-8.0, 0.0, 0.0]]
    affine[:3, 3] = [-40.0, 40.0, 40.0]
    draw = np.random.default_rng(0)
    a = draw.normal(size=(11, 11, 11, 3, 3))
    tensors = a @ np.swapaxes(a, -1, -2) + np.eye(3)
    i, j = np.tril_indices(3)
    arrays = {
        "v": draw.normal(size=(11, 11, 11, 3)),
        "d": tensors[..., i, j],
        "m": draw.uniform(1.0, 3.0, (11, 11, 11)),
        "nan": np.full((11, 11, 11, 3), np.nan),
    }
    for name, data in arrays.items():
        nibabel.save(nibabel.Nifti1Image(data.astype(np.float32), affine), f"{name}.nii.gz")
    affine[:3, 3] += 400.0
    nibabel.save(nibabel.Nifti1Image(arrays["v"].astype(np.float32), affine), "far.nii.gz")


def expected(mesh):
    kinds = {"V": ("v", "direction@fsl"), "D": ("d", "tensor@ras-lower"), "mu": ("m", "scalar")}
    return {
        name: tetopt.cell_field(tetopt.load_field(f"{file}.nii.gz", kind), mesh)
        for name, (file, kind) in kinds.items()
    }


@pytest.mark.parametrize(
    "output",
    ["b.vtu", "b.vtu --space lps", "b.vtk --space lps", "b.xdmf --space lps", "b.msh --fields all"],
)
def test_a_file_has_the_values_and_their_kinds(output):
    """Directions and tensors are along the axes of the file, and come back in RAS+."""
    said = run_command(f"convert a.vtu {output} {FIELDS}").err
    loaded = tetopt.load_mesh(output.split()[0])
    own = expected(loaded.mesh)
    for name, each in own.items():
        assert_allclose(loaded.cell_data[name], each.values, rtol=1e-12, err_msg=name)
        assert f"field {name}: {each.n_interpolated} cells" in said
    assert_allclose(loaded.cell_data["V_coherence"], own["V"].coherence, rtol=1e-12)
    assert loaded.table("field_kinds") == {"V": "direction", "D": "tensor", "mu": "scalar"}
    name = output.split()[0]
    assert_done(f"convert {name} again{Path(name).suffix} --fields all --space lps")
    again = tetopt.load_mesh(f"again{Path(name).suffix}")
    assert_array_equal(again.cell_data["D"], loaded.cell_data["D"])
    assert again.table("field_kinds") == loaded.table("field_kinds")


@pytest.mark.parametrize("name", ["b.inp", "b.feb", "b.msh2", "b.mesh"])
def test_a_file_without_data_of_cells_has_no_kinds_of_them(name):
    run_command(f"convert a.vtu {name} {FIELDS} --young 3")
    assert "field_kinds" not in Path(name).read_text(encoding="utf-8")


def test_vtk_sees_the_axes_of_the_file():
    import pyvista

    for space in ("ras", "lps"):
        assert_done(f"convert a.vtu {space}.vtu {FIELDS} --space {space}")
    ras, lps = (pyvista.read(f"{space}.vtu").cell_data for space in ("ras", "lps"))
    sides = np.diag([-1.0, -1.0, 1.0])
    assert_allclose(lps["V"], ras["V"] @ sides, rtol=1e-12)
    turned = sides @ ras["D"].reshape(-1, 3, 3) @ sides
    assert_allclose(lps["D"].reshape(-1, 3, 3), turned, rtol=1e-12)
    assert np.linalg.eigvalsh(turned).min() > 0.0


def test_a_run_has_fields_and_a_mapping_of_one():
    run = "mesh i.nii.gz -o c.vtu --nodes 120 --iterations 1 --json c.json --young 2*mu"
    assert_done(f"{run} {FIELDS}")
    loaded = tetopt.load_mesh("c.vtu")
    for name, each in expected(loaded.mesh).items():
        assert_allclose(loaded.cell_data[name], each.values, rtol=1e-12, err_msg=name)
    request = json.loads(Path("c.json").read_text())["request"]
    assert request["options"]["field"] == ["V:direction@fsl", "D:tensor@ras-lower", "mu:scalar"]
    assert [name for name, _ in request["files"]["field"]] == ["v.nii.gz", "d.nii.gz", "m.nii.gz"]
    assert loaded.cell_data["young"].max() < 6.0


def test_fem_and_view_take_fields():
    assert_done(
        "fem a.vtu --young 2*mu --load compress:1% --field mu=m.nii.gz -o solved.vtu "
        "--field D=d.nii.gz:tensor@dipy"
    )
    solved = tetopt.load_mesh("solved.vtu")
    assert_allclose(solved.cell_data["D"], expected(solved.mesh)["D"].values, rtol=1e-12)
    assert_done("view a.vtu --html a.html --field mu=m.nii.gz --show mu")
    page = re.search(r'id="data">(.*?)</script>', Path("a.html").read_text(), re.DOTALL)[1]
    assert json.loads(page)["fields"][0]["name"].startswith("mu")


def test_outside_the_mask_of_the_mesh_there_is_no_data():
    image = tetopt.load_image("i.nii.gz")
    mask = tetopt.Image(image.data > 50.0, image.affine)
    tetopt.save_image("mask.nii.gz", mask)
    assert_done("mesh i.nii.gz -o m.vtu --mask mask.nii.gz --nodes 80 --iterations 0 " + FIELDS)
    loaded = tetopt.load_mesh("m.vtu")
    field = tetopt.load_field("d.nii.gz", "tensor@dipy")
    inside = tetopt.cell_field(field, loaded.mesh, mask)
    assert_allclose(loaded.cell_data["D"], inside.values, rtol=1e-12)
    assert (inside.values != tetopt.cell_field(field, loaded.mesh).values).any()


def test_elastography_from_a_map():
    """From image and map to a solution, in several steps or one, with moduli of the map alone."""
    law = "--field mu=m.nii.gz --young '3*mu for mu < 2.6' --nu 0.45 --average linear"
    said = run_command(f"mesh i.nii.gz -o e.vtu --nodes 80 --iterations 0 {law} --load compress:5%")
    assert re.search(r"young: [\d.]+ % of the mesh's volume is outside of the range", said.err)
    mu = tetopt.load_image("m.nii.gz")
    loaded = tetopt.load_mesh("e.vtu")
    young = cell_young(mu, loaded.mesh, lambda h: 3.0 * h, "linear")
    assert_allclose(loaded.cell_data["young"], young, rtol=1e-9)
    assert_done("fem e.vtu -o one.vtu --order 2")
    assert_done("convert e.vtu f.vtu --young 1")
    assert_done(f"fem f.vtu -o two.vtu --order 2 --load compress:5% {law}")
    one, two = (tetopt.load_mesh(f"{each}.vtu").point_data for each in ("one", "two"))
    assert_allclose(one["displacement"], two["displacement"], atol=1e-9)
    assert 0.05 < np.abs(one["displacement"][:, :2]).max() < 3.0


@pytest.mark.parametrize("mask", ["", "--image i.nii.gz --mask mask.nii.gz"])
def test_a_map_that_is_0_outside_the_mask(mask):
    """For another program's mesh the mask is given; the map's zeros would count in its cells."""
    image = tetopt.load_image("i.nii.gz")
    ball = tetopt.Image(image.data > 50.0, image.affine)
    tetopt.save_image("mask.nii.gz", ball)
    tetopt.save_image("map.nii.gz", tetopt.Image(5.0 * ball.data, image.affine))
    whole = tetopt.load_mesh("a.vtu").mesh
    centres = whole.points[whole.cells].mean(axis=1)
    tetopt.save_mesh("ball.vtu", part_of(whole, (centres**2).sum(axis=1) < 20.0**2))
    words = "convert ball.vtu b.vtu --field mu=map.nii.gz --young max(3*mu,1) --average mean"
    assert_done(f"{words} {mask}")
    young = tetopt.load_mesh("b.vtu").cell_data["young"]
    assert (young == 15.0).all() == bool(mask)


test_refused = refusals(
    """
convert a.vtu b.vtu --field V=v.nii.gz:direction@fsl --field mu=m.nii.gz --young 2*V
    --young: formula: expected numbers, h, mu, .* cannot use "V"
convert a.vtu b.vtu --young 3*mu
    --young: formula: .* cannot use "mu"; write h for the intensity, or give --field mu=FILE
convert a.vtu b.vtu --young 3*h --average linear
    --average: linear averages over voxels and needs an image; pass --image or --field
convert a.vtu b.vtu --field mu=m.nii.gz --young "3*mu for 7"
    --young: formula: expected a range, such as 0.1 < h <= 1.8
convert a.vtu b.vtu --field V=v.nii.gz:direction
    v.nii.gz: the axes of its components are not stated; give them, as direction@FRAME: @fsl
convert a.vtu b.vtu --field V=v.nii.gz:tensor@fsl
    v.nii.gz: expected 6 components for a tensor, got 3
convert a.vtu b.vtu --field V=far.nii.gz:direction@fsl
    field V: the mesh lies outside
mesh i.nii.gz -o b.vtu --nodes 80 --field V=far.nii.gz:direction@fsl
    field V: the mesh lies outside
view a.vtu --html b.html --field V=nan.nii.gz:vector@ras
    nan.nii.gz: field: expected data in some voxel, got NaN in all
fem a.vtu --young 3 --load compress:1% --field V=v.nii.gz:vector@lsp
    --field: kind: expected @fsl, @dipy, @mrtrix, @itk, @voxel, @ras, @lps, got "vector@lsp"
mesh i.nii.gz -o b.vtu --field v.nii.gz
    --field: expected NAME=FILE, NAME=FILE:KIND or NAME=FILE:KIND@FRAME
mesh i.nii.gz -o b.vtu --field stress=v.nii.gz:vector@ras
    --field: field: "stress" is the name of other data of cells
mesh i.nii.gz -o b.vtu --field a=v.nii.gz:vector@ras --field a=m.nii.gz
    --field: two are called "a"
mesh i.nii.gz -o b.vtu --field V=v.nii.gz:direction@fsl --field V_coherence=m.nii.gz
    --field: field: "V_coherence" is the name of the coherence of the directions V
convert a.vtu b.vtu --field a=v.nii.gz
    v.nii.gz: the file has 3 volumes; choose one
"""
)
