"""`tetopt convert --transform`: a template's mesh moves to a subject, as a user types it."""

import re

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from commands import assert_done, assert_refuses, in_copy_of, numbers_in, refusals, run_command
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import binary_dilation

import tetopt
from tetopt import Image, load_image, load_mesh, save_image, save_mesh
from tetopt.geometry.simplex import volumes
from tetopt.model.file import loads_in

pytestmark = pytest.mark.full
TURN = np.array(sitk.Euler3DTransform((0, 0, 0), 0.2, -0.1, 0.3).GetMatrix()).reshape(3, 3)
A = np.eye(4)
A[:3] = np.column_stack([1.1 * TURN, [6.0, -4.0, 3.0]])  # from the template to the subject

here = in_copy_of("folder")


def of_itk(matrix, name):
    """A matrix in RAS+ as a file of ITK's."""
    lps = np.diag([-1.0, -1.0, 1.0])
    transform = sitk.AffineTransform(3)
    transform.SetMatrix((lps @ matrix[:3, :3] @ lps).ravel())
    transform.SetTranslation(lps @ matrix[:3, 3])
    sitk.WriteTransform(transform, str(name))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A ball within a mask, its mesh of both orders with labels, and the same ball in a subject,
    whose voxels the transform carries there.
    """
    path = tmp_path_factory.mktemp("moved")
    image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    image = Image(
        image.data + 0.1 * np.arange(image.data.size).reshape(image.shape) % 7, image.affine
    )
    mask = Image(1.0 * (image.data > 60), image.affine)
    for name, each in (("image", image), ("mask", mask)):
        save_image(path / f"{name}.nii.gz", each)
        save_image(path / f"{name}_s.nii.gz", Image(each.data, A @ image.affine))
    words = f"--mask {path}/mask.nii.gz --nodes 300 --iterations 2"
    assert_done(f"mesh {path}/image.nii.gz {words} -o {path}/bare.vtu")
    loaded = load_mesh(path / "bare.vtu")
    labels = (loaded.mesh.points[loaded.mesh.cells].mean(axis=1)[:, 0] > 0).astype(int)
    words = f"--set top=facing:0,0,1:30 --young 3 --order 2 {path}/template.vtu"
    save_mesh(
        path / "labelled.vtu",
        loaded.mesh,
        loaded.cell_data | {"label": labels, "dose": 1.0 * labels},
    )
    assert_done(f"convert {path}/labelled.vtu {words}")
    of_itk(A, path / "affine.mat")
    return path


def test_nodes_move_and_cells_labels_sets_and_scalars_stay():
    words = "--transform affine.mat --image image_s.nii.gz --mask mask_s.nii.gz"
    said = run_command(f"convert template.vtu moved.vtu {words} --json moved.json")
    before, after = load_mesh("template.vtu"), load_mesh("moved.vtu")
    expected = before.mesh.points @ A[:3, :3].T + A[:3, 3]
    assert_allclose(after.mesh.points, expected, rtol=0, atol=1e-5)
    assert_array_equal(after.mesh.cells, before.mesh.cells)
    assert_array_equal(after.labels, before.labels)
    for name in ("dose", "young"):
        assert_array_equal(after.cell_data[name], before.cell_data[name])
    for mine, theirs in zip(after.sets, before.sets, strict=True):
        assert mine.keys() - theirs.keys() <= {"mask_surface"}
        for name in theirs:
            assert_array_equal(mine[name], theirs[name])
    assert after.order == 2
    assert after.is_moved
    old, new = re.search(r"Dice of the mask (\S+) before .* (\S+) after", said.out).groups()
    assert float(old) < 0.8 < 0.9 < float(new)
    assert numbers_in("moved.json")["transforms"] == ["affine.mat"]


def test_means_are_of_the_new_image_and_the_old_ones_are_left_out():
    before = load_mesh("bare.vtu").cell_data
    said = run_command("convert bare.vtu moved.vtu --transform affine.mat")
    assert (
        "left out, as of the old image or its axes: mean, variance, n_voxels, min, max" in said.err
    )
    fields = load_mesh("moved.vtu").cell_data
    assert "mean" not in fields
    assert_allclose(fields["volume"], 1.1**3 * before["volume"], rtol=1e-4)
    words = "--transform affine.mat --image image_s.nii.gz --mask mask_s.nii.gz"
    assert_done(f"convert bare.vtu new.vtu {words}")
    new = load_mesh("new.vtu").cell_data["mean"]
    assert np.mean(np.abs(new - before["mean"]) < 0.5) > 0.9


def test_a_moved_mesh_asks_for_the_subject_s_mask(capfd):
    assert_done("convert bare.vtu moved.vtu --transform affine.mat")
    said = run_command("quality moved.vtu --image image_s.nii.gz", code=2).err
    assert "its nodes were moved after meshing, away from its mask" in said


@pytest.mark.parametrize("mask", ["--mask mask_s.nii.gz", ""])
def test_the_wrong_way_is_a_warning_that_names_the_other(mask):
    """By the mask, or by the means of cells."""
    mesh = "bare.vtu" if mask else "box.vtu"
    if not mask:
        image = load_image("image.nii.gz")
        mesh_of_box = tetopt.lattice_mesh(image, nodes=300)
        save_mesh("box.vtu", mesh_of_box, tetopt.cell_fields(mesh_of_box, image))
    words = f"convert {mesh} moved.vtu --image image_s.nii.gz {mask} --force --transform affine.mat"
    right, wrong = run_command(words), run_command(f"{words} --inverse")
    assert "worse" not in right.err
    assert ("Dice of the mask" if mask else "correlation of the cells' means") in right.out
    assert re.search(r"worse\. .*for the other way, pass --inverse", wrong.err)


def test_the_inverse_and_several_files_undo_each_other():
    assert_done("convert bare.vtu there.vtu --transform affine.mat")
    of_itk(np.linalg.inv(A), "back.mat")
    for words in (
        "there.vtu back.vtu --transform affine.mat --inverse",
        "bare.vtu back.vtu --transform affine.mat --transform back.mat",
    ):
        assert_done(f"convert {words} --force")
        assert_allclose(
            load_mesh("back.vtu").mesh.points, load_mesh("bare.vtu").mesh.points, atol=1e-4
        )


def test_inverted_cells_are_counted_and_untangled():
    """A field with a fold of 20 mm along each axis around the node nearest to the middle."""
    image, points = load_image("image.nii.gz"), load_mesh("bare.vtu").mesh.points
    node = np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1))
    shifts = np.zeros((*image.shape, 1, 3), dtype=np.float32)
    low = np.floor(image.to_index(points[node])).astype(int)
    shifts[tuple(slice(at, at + 2) for at in low)] = 20.0
    field = nibabel.Nifti1Image(shifts, image.affine)
    field.header.set_intent("vector")
    nibabel.save(field, "fold.nii.gz")
    said = run_command("convert template.vtu moved.vtu --transform fold.nii.gz").err
    before, after = load_mesh("template.vtu").mesh, load_mesh("moved.vtu").mesh
    move = tetopt.load_transform("fold.nii.gz")
    n_inverted = int((volumes(move(before.points), before.cells) <= 0).sum())
    assert n_inverted > 0
    assert f"the transform inverts {n_inverted} cell" in said
    off = np.linalg.norm(after.points - move(before.points), axis=1).max()
    assert float(re.search(r"off their places for it, up to (\S+) mm", said)[1]) == pytest.approx(
        off, rel=0.01
    )
    assert (after.cell_volumes > 0).all()
    assert_array_equal(after.cells, before.cells)


def test_vectors_and_results_are_left_out():
    loaded = load_mesh("bare.vtu")
    fibre = np.tile([1.0, 0, 0], (len(loaded.mesh.cells), 1))
    save_mesh("v.vtu", loaded.mesh, {"fibre": fibre, "von_mises": fibre[:, 0], "dose": fibre[:, 0]})
    said = run_command("convert v.vtu moved.vtu --transform affine.mat").err
    assert "left out, as of the old image or its axes: fibre, von_mises" in said
    assert {"dose"} == set(load_mesh("moved.vtu").cell_data) - {"material"}


def test_materials_with_fibres_are_left_out_as_one():
    loaded = load_mesh("bare.vtu")
    fibre = np.tile([1.0, 0, 0], (len(loaded.mesh.cells), 1))
    save_mesh("f.vtu", loaded.mesh, {"v": fibre, "dose": fibre[:, 0]})
    assert_done("convert f.vtu stiff.vtu --fibre v --young 3 --young-along 9")
    said = run_command("convert stiff.vtu moved.vtu --transform affine.mat").err
    words = re.search("left out, as of the old image or its axes: (.*)", said)[1].split(", ")
    assert {"fibre", "young", "nu", "young_along", "shear_along"} <= set(words)
    assert {"dose"} == set(load_mesh("moved.vtu").cell_data)
    save_mesh("lost.vtu", loaded.mesh, {"young_along": 9.0 * fibre[:, 0]})
    words = "convert lost.vtu o.vtu --fibre fibre --young 3 --young-along 9"
    assert_refuses(words, "--fibre: expected data of cells with three numbers")


@pytest.mark.parametrize(
    ("loads", "is_kept"),
    [
        ("compress:2%", False),
        ("hold:inferior gravity:0,0,-9810", False),
        ("hold:inferior traction:superior:0,0,1", False),
        ("hold:inferior pressure:superior:0.1", True),
    ],
)
def test_loads_of_the_template_s_axes_or_lengths_are_left_out(loads, is_kept):
    words = " ".join(f"--load {each}" for each in loads.split())
    assert_done(f"convert bare.vtu loaded.vtu --young 3 --density 1000 {words}")
    said = run_command("convert loaded.vtu moved.vtu --transform affine.mat").err
    before, after = (loads_in(load_mesh(name)) for name in ("loaded.vtu", "moved.vtu"))
    assert before
    assert after == (before if is_kept else [])
    lost = re.search("the file's loads .* left out: (.*); give .*--load", said)
    assert (lost is None) if is_kept else lost[1] == ", ".join(before)


def test_fsl_matrices_move_from_the_fixed_to_the_moving_image():
    """Both on the same voxels: the identity of flirt carries one grid onto the other."""
    np.savetxt("flirt.mat", np.linalg.inv(np.diag([1.1, 1.1, 1.1, 1.0])))
    words = "--transform flirt.mat --fixed image.nii.gz --image image_s.nii.gz --mask mask_s.nii.gz"
    assert_done(f"convert bare.vtu moved.vtu {words}")
    expected = load_mesh("bare.vtu").mesh.points @ A[:3, :3].T + A[:3, 3]
    assert_allclose(load_mesh("moved.vtu").mesh.points, expected, atol=1e-3)


def test_a_mesh_starts_from_a_moved_one_and_keeps_its_cells_labels_and_sets():
    """In one command; the subject's mask is a little larger than the moved ball."""
    image, mask = load_image("image_s.nii.gz"), load_image("mask_s.nii.gz")
    more = binary_dilation(mask.data > 0)
    save_image("larger.nii.gz", Image(1.0 * more, mask.affine))
    places = image.to_world(np.moveaxis(np.indices(image.shape), 0, -1).reshape(-1, 3))
    is_one = ((places - A[:3, 3]) @ A[:3, 0] > 0).reshape(image.shape)
    save_image("labels.nii.gz", Image(1.0 * is_one, mask.affine))
    words = "--start labelled.vtu --transform affine.mat --keep-connectivity --mask larger.nii.gz"
    words += " --labels labels.nii.gz -o s.vtu --json s.json"
    said = run_command(f"mesh image_s.nii.gz {words}", code=None)
    before, after = load_mesh("labelled.vtu"), load_mesh("s.vtu")
    assert "its cells, labels and sets stay, and nodes move" in said.err
    assert_array_equal(after.mesh.cells, before.mesh.cells)
    assert_array_equal(after.labels, before.labels)
    numbers = numbers_in("s.json")
    assert numbers["request"]["options"]["keep-connectivity"] is True
    assert [name for name, _ in numbers["request"]["files"]["transform"]] == ["affine.mat"]
    assert numbers["mask"]["dice"] > 0.9
    for name, rows in before.sets.facets.items():
        assert_array_equal(after.sets.facets[name], rows)


test_what_cannot_be_moved_is_refused = refusals("""
convert bare.vtu o.vtu --inverse
    --inverse: needs --transform
convert bare.vtu o.vtu --fixed image.nii.gz
    --fixed: needs --transform
convert bare.vtu o.vtu --transform none.mat
    none.mat: no such file; expected a transform
convert bare.vtu o.vtu --transform mask.nii.gz
    mask.nii.gz: expected a dense field
convert bare.vtu o.vtu --transform affine.mat --labels mask.nii.gz
    --transform and --labels: convert first with one
mesh image.nii.gz -o o.vtu --keep-connectivity
    --keep-connectivity: needs --start
mesh image.nii.gz -o o.vtu --transform affine.mat
    --transform: needs --start
mesh image.nii.gz -o o.vtu --start bare.vtu --keep-connectivity --nodes 300
    --start and --nodes: bare.vtu already has nodes
convert bare.vtu o.nii.gz --transform affine.mat --like image.nii.gz --fields mean
    --transform: has no effect on o.nii.gz, an image
""")
