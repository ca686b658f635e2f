"""The command with masks, backgrounds, labels and several contrasts."""

import contextlib
import re
import threading
from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import assert_done, assert_refused, exit_code, in_copy_of, numbers_in
from shapes import OBLIQUE, distance, grid, shaped

import tetopt
from tetopt import Image, check_mesh, load_mesh, quality, save_image
from tetopt.cli import run as cli_run
from tetopt.model.sets import nodes_of

pytestmark = pytest.mark.full


here = in_copy_of("inputs")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """An image with a mask, labels and a contrast on grids of their own; and what goes wrong."""
    folder = tmp_path_factory.mktemp("domains")
    image, mask = shaped("ball", OBLIQUE)
    save_image(folder / "image.nii.gz", image)
    save_image(folder / "mask.nii.gz", mask)
    labels = np.where(grid(image.shape)[..., 0] > 14, 4.0, 2.0)
    labels[13:15, 8:15, 8:15] = 9.0  # a plate thinner than two cells
    shift = OBLIQUE.copy()
    shift[:3, 3] = image.to_world([2.0, 1.0, 3.0])
    save_image(folder / "labels.nii.gz", Image(labels[2:, 1:, 3:], shift))
    twice = OBLIQUE @ np.diag([0.5, 0.5, 0.5, 1.0])
    twice[:3, 3] = image.to_world([-0.25, -0.25, -0.25])
    fine = np.repeat(np.repeat(np.repeat(image.data**2, 2, 0), 2, 1), 2, 2)
    save_image(folder / "square.nii.gz", Image(fine, twice))
    head = np.where(distance(image.shape, 13, 14, 15) < 10, 500.0, 0.0) + 0.2 * image.data
    head[10:14, 12:15, 12:15] = 0.0  # a dark cavity
    save_image(folder / "head.nii.gz", Image(head))
    far = OBLIQUE.copy()
    far[:3, 3] += 500.0
    save_image(folder / "far.nii.gz", Image(mask.data, far))
    save_image(folder / "empty.nii.gz", Image(0.0 * mask.data, OBLIQUE))
    save_image(folder / "parts.nii.gz", Image(labels, OBLIQUE))
    save_image(folder / "half.nii.gz", Image(labels + 0.5, OBLIQUE))
    return folder


@pytest.fixture(scope="module")
def run(inputs, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    command = [
        "mesh",
        inputs / "image.nii.gz",
        inputs / "square.nii.gz",
        "--weights 1,0.5 --mask",
        inputs / "mask.nii.gz",
        "--labels",
        inputs / "labels.nii.gz",
        "--nodes 600 -o",
        out / "mesh.vtu",
        "--json",
        out / "run.json",
        "--figures",
        out,
        "--young 2 --load compress:2%",
    ]
    assert_done(*command)
    return out


def test_the_mesh_file(run):
    for name in ("slice", "rho", "energies", "boundary", "labels"):
        assert (run / f"{name}.png").is_file()
    loaded = load_mesh(run / "mesh.vtu")
    image, mask = shaped("ball", OBLIQUE)
    assert check_mesh(loaded.mesh) == []
    size = mask.data.sum() * image.voxel_volume
    assert loaded.cell_data["volume"].sum() == pytest.approx(size, rel=0.04)
    assert {"label", "mean", "variance", "mean_2", "variance_2"} <= set(loaded.cell_data)
    assert set(loaded.cell_data["label"].tolist()) <= {2, 4, 9}
    middle = image.to_index(loaded.mesh.points[loaded.mesh.cells].mean(axis=1))
    far = np.abs(middle[:, 0] - 14.5) > 2.5
    expected = np.where(middle[:, 0] > 14.5, 4, 2)
    assert (loaded.cell_data["label"] == expected)[far].mean() > 0.99
    # The second contrast is the first one's square, on voxels of half the size.
    squares = loaded.cell_data["mean"] ** 2 + loaded.cell_data["variance"]
    assert np.corrcoef(squares, loaded.cell_data["mean_2"])[0, 1] > 0.97


def test_the_numbers(run):
    numbers = numbers_in(run / "run.json")
    assert numbers["inputs"]["images"] == ["image.nii.gz", "square.nii.gz"]
    assert numbers["inputs"]["weights"] == [1.0, 0.5]
    assert numbers["inputs"]["mask"] == "mask.nii.gz"
    assert set(numbers["inputs"]["sha256"]) == {"square.nii.gz", "mask.nii.gz", "labels.nii.gz"}
    assert numbers["mask"]["voxels"] == shaped("ball")[1].data.sum()
    assert numbers["mask"]["dice"] > 0.98
    assert numbers["mask"]["distance_mean"] < 0.25
    rows = {row["label"]: row for row in numbers["labels"]}
    assert set(rows) == {2, 4, 9}
    assert rows[2]["dice"] > 0.95
    assert [row["weight"] for row in numbers["contrasts"]] == [1.0, 0.5]
    assert 0.0 < numbers["contrasts"][1]["E_D_fraction_of_variance"] < 0.5
    assert 0.0 < numbers["energies"]["E_D_fraction_of_variance"] < 0.5


def test_the_wait_for_a_start_is_said(monkeypatch, capsys):
    """Where there is no terminal a line from time to time, of what is read and of the mesh that
    a run begins with.
    """
    waiting, say, is_said = cli_run.waiting, cli_run.log.print, threading.Event()

    def print_line(*words, **options):
        say(*words, **options)
        is_said.set()

    @contextlib.contextmanager
    def until_a_line(words):  # however quick the machine is
        is_said.clear()
        with waiting(words):
            yield
            assert is_said.wait(60.0)

    monkeypatch.setattr(cli_run, "LINE_SECONDS", 0.01)
    monkeypatch.setattr(cli_run.log, "print", print_line)
    monkeypatch.setattr(cli_run, "waiting", until_a_line)
    assert_done("mesh image.nii.gz --mask mask.nii.gz --nodes 600 --iterations 0 -o a.vtu")
    begun, octree, rest = capsys.readouterr().err.partition("octree of ")
    assert octree
    assert "reading and preparing the image" in begun
    assert "building the initial mesh, " in begun
    assert "building the initial mesh" not in rest


def test_an_organ_is_compressed_between_its_own_top_and_bottom(run, capsys):
    """By `mesh`, `convert` and `fem` alike, though nothing of it lies on the box's faces."""
    loaded = load_mesh(run / "mesh.vtu")
    push = 0.02 * np.ptp(loaded.mesh.points[:, 2])
    assert_done("convert", run / "mesh.vtu", "a.inp --young 3 --load compress:2%")
    assert re.search(r"\ninferior +\d+ +[\d.]+ +\d+ *\n", capsys.readouterr().out)
    for words in ("", "--load compress:2% -o solved.vtu"):  # first the loads that `mesh` wrote
        assert_done("fem", run / "mesh.vtu", f"{words} --json a.json --force")
        (step,) = numbers_in("a.json")["steps"]
        assert step["largest_displacement"] == pytest.approx(push, rel=0.1)
        assert step["reactions"]["superior"][2] < 0.0 < step["reactions"]["inferior"][2]
    solved = load_mesh("solved.vtu")
    pressed = nodes_of(solved.mesh, solved.sets.facets["inferior"])
    assert solved.mesh.points[pressed, 2].max() < np.percentile(loaded.mesh.points[:, 2], 25)
    assert exit_code("convert", run / "mesh.vtu", "b.inp --load hold:top") == 2
    names = (
        "boundary, left, right, posterior, anterior, inferior, superior, mask_surface, interface"
    )
    assert f'no set of facets "top"; known sets are {names}' in capsys.readouterr().err


def test_measured_again(run, capsys):
    """`quality` finds the same of the file as the run of the mesh."""
    words = "--image image.nii.gz --check --mask mask.nii.gz --labels labels.nii.gz --all"
    assert_done("quality", run / "mesh.vtu", f"{words} --json q.json")
    first, again = (numbers_in(path) for path in (run / "run.json", "q.json"))
    assert again["mask"].pop("lost_components") == first["mask"].pop("lost_components") == []
    assert again["mask"] == pytest.approx(first["mask"])
    for name in ("labels", "interfaces"):
        assert [row["label"] for row in first[name]] == [2, 4, 9]
        for one, other in zip(first[name], again[name], strict=True):
            assert one.pop("lost_components", None) == other.pop("lost_components", None)
            for key in ("thickness_voxels", "thickness_mesh") if name == "labels" else ():
                assert one.pop(key) == pytest.approx(other.pop(key))
            assert one == pytest.approx(other, nan_ok=True)
    assert again["contact_totals"] == pytest.approx(first["contact_totals"])
    assert [each["labels"] for each in again["contacts"]] == [
        each["labels"] for each in first["contacts"]
    ]
    said = capsys.readouterr().out
    assert "boundary to the mask's surface, mean, 95 %" in said
    for words in ("volume, mm3", "majority", "contact beyond 1.2 times that"):
        assert words in said
    assert re.search(r"cells +% +Dice", said)
    assert again["labels"][2]["cells_across"] < 2.0
    assert "layer, %" in said
    assert f"{again['interfaces'][0]['area_ratio']:.3f}" in said
    assert (
        f"{again['labels'][0]['volume_dice']:.4f}    {again['labels'][0]['dice_majority']:.4f}"
        in said
    )


@pytest.mark.parametrize("more", ["--background 60", "--labels labels.nii.gz"])
def test_quality_and_mesh_judge_alike(capsys, more):
    """One name and one value of E_D's fraction, the same verdicts, and the same exit code."""
    image, again = ("head.nii.gz", "") if "background" in more else ("image.nii.gz", more)
    sizes = "--target-error 0.02 --size-min 5 --iterations 2"
    assert exit_code(f"mesh {image} {more} {sizes} -o a.vtu --json a.json") == 1
    said = capsys.readouterr()
    assert exit_code(f"quality a.vtu --image {image} {again} --check --json q.json") == 1
    judged = capsys.readouterr()
    first, second = numbers_in("a.json"), numbers_in("q.json")
    fraction = second["fit"]["E_D_fraction_of_variance"]
    assert fraction == pytest.approx(first["energies"]["E_D_fraction_of_variance"], rel=1e-9)
    assert set(second["violated"]) == set(first["violated"]) >= {"error"}
    assert [line for line in said.err.splitlines() if "variance is unexplained" in line] == [
        line for line in judged.err.splitlines() if "variance is unexplained" in line
    ]
    name = re.search("E_D, fraction of .* variance(?= )", said.out)[0]
    assert f"{name} " in judged.out
    assert f"{fraction:.5f}" in judged.out
    assert re.findall("fraction of its variance.*", said.out) == re.findall(
        "fraction of its variance.*", judged.out
    )


def test_background(capsys):
    command = "mesh head.nii.gz --background auto --uniform --nodes 400"
    assert_done(f"{command} --iterations 2 -o a.vtu --json a.json")
    mesh = load_mesh("a.vtu").mesh
    ball = (distance((28, 30, 32), 13, 14, 15) < 10).sum()
    numbers = numbers_in("a.json")
    assert 0.0 < numbers["inputs"]["background"] < 400.0
    # the cavity stays in
    assert quality(mesh.points, mesh.cells).volume == pytest.approx(ball, rel=0.05)
    captured = capsys.readouterr()
    assert "E_D, fraction of the image's variance" in captured.out
    assert "boundary to the foreground's surface" in captured.out
    assert "mask" not in captured.out + captured.err


def test_labels_alone(capsys):
    """An image that is its own labels: whatever numbers they have, each counts as itself."""
    assert_done(
        "mesh parts.nii.gz --labels parts.nii.gz --nodes 300 --iterations 3 -o a.vtu --json a.json"
    )
    assert numbers_in("a.json")["inputs"]["weights"] == [0.0]
    captured = capsys.readouterr()
    assert "only the labels are used" in captured.err
    assert "E_D, fraction of the labels' variance" in captured.out
    assert_done("view a.vtu --html a.html")
    first = re.search(r'"fields": \[\{"name": "(\w+)"', Path("a.html").read_text())[1]
    assert first == "label"  # not the means of their numbers


def test_a_label_never_vanishes_silently(capsys):
    labels = np.zeros((30, 30, 30))
    labels[10:20, 10:20, 14] = 1.0
    labels[10:20, 10:20, 15] = 2.0
    labels[10:20, 10:20, 16] = 1.0
    labels[4:24, 4:24, 22] = 3.0
    save_image("labels.nii.gz", Image(labels))
    # The lattice itself, much coarser than the sheets.
    command = "mesh labels.nii.gz --labels labels.nii.gz --uniform --nodes 60 --iterations 0"
    assert exit_code(f"{command} -o a.vtu --free-volumes") == 1
    said = capsys.readouterr().err
    assert (
        "no voxel of label 1, 3, of 200 voxels or more, lies in a cell with that label; "
        "components of labels" in said
    )
    assert (
        "of 50 voxels or more without a cell: 100 voxels of label 2 at (14, 14, 15) mm; allow "
        "more nodes" in said
    )
    # Labels whose volumes are kept have cells there, too, if not of all their volume.
    assert exit_code(f"{command} -o b.vtu --json b.json") == 1
    said = capsys.readouterr().err
    assert (
        "the volume of cells is not 0.6 to 1.5 times that of voxels: 0.312 for label 3; allow more"
        in said
    )
    assert all(row["n_cells"] > 0 for row in numbers_in("b.json")["labels"])


def test_a_slice_of_all():
    command = [
        "mesh image.nii.gz --mask mask.nii.gz --slice k=15",
        "--labels parts.nii.gz --nodes 150 -o a.vtu",
    ]
    assert_done(*command)
    mesh = load_mesh("a.vtu").mesh
    assert mesh.ndim == 2
    assert check_mesh(mesh) == []


def test_a_slice_of_a_mask_that_is_stored_upside_down():
    """The same mask in the same place of the world, its last axis turned: the same slice of it."""
    image, mask = shaped("touching", OBLIQUE)
    turned = OBLIQUE.copy()
    turned[:3, 3] = image.to_world([0.0, 0.0, image.shape[2] - 1.0])
    turned[:3, 2] *= -1.0
    save_image("turned.nii.gz", Image(mask.data[..., ::-1], turned))
    command = [
        "mesh image.nii.gz --slice k=12 --mask turned.nii.gz",
        "--nodes 60 --iterations 0 --json a.json -o a.vtu",
    ]
    assert_done(*command)
    assert numbers_in("a.json")["mask"]["voxels"] == mask.data[..., 12].sum()


def test_files_on_other_grids_are_told(capsys):
    """And so are a mask of which half lies elsewhere, and one of the image's shape that is a
    little off.
    """
    image, mask = shaped("ball", OBLIQUE)
    moved = OBLIQUE.copy()
    moved[:3, 3] = image.to_world([14.0, 0.0, 0.0])
    save_image("half.nii.gz", Image(mask.data, moved))
    command = ["mesh image.nii.gz square.nii.gz --mask half.nii.gz"]
    assert exit_code(*command, "--nodes 300 --iterations 0 -o a.vtu") in (0, 1)
    said = capsys.readouterr().err
    assert "square.nii.gz: resampled to the image's grid (linear)" in said
    assert "half.nii.gz: resampled to the image's grid (nearest neighbour)" in said
    assert (
        "half.nii.gz: 48.7% of it lies outside the image; its box covers 50.0% of the image" in said
    )
    assert "(same shape, different affine); is it from the same scan?" in said
    moved[:3, 3] = image.to_world([1.5, 0.0, 0.0])
    save_image("near.nii.gz", Image(mask.data, moved))
    command = ["mesh image.nii.gz --nodes 300 --iterations 0 --force -o a.vtu"]
    exit_code(*command, "--mask near.nii.gz")
    assert "near.nii.gz: 0.0% of it lies outside the image" in capsys.readouterr().err
    wide = OBLIQUE.copy()  # the same space: more of it, and its axes the other way
    wide[:3, 3] = image.to_world([-3.0, -3.0, -3.0])
    save_image("wide.nii.gz", Image(np.pad(mask.data, 3, constant_values=1.0), wide))
    turned = OBLIQUE @ np.diag([-1.0, 1.0, 1.0, 1.0])
    turned[:3, 3] = image.to_world([image.shape[0] - 1.0, 0.0, 0.0])
    save_image("turned.nii.gz", Image(mask.data[::-1], turned))
    # and elsewhere, as labels of FreeSurfer
    turned[:3, 3] = image.to_world([image.shape[0] + 0.5, 0.0, 0.0])
    save_image("aside.nii.gz", Image(mask.data[::-1], turned))
    for name in ("wide", "turned", "aside"):
        exit_code(*command, f"--mask {name}.nii.gz")
        said = capsys.readouterr().err
        assert f"{name}.nii.gz: resampled" in " ".join(said.split())
        assert "same scan" not in said


def test_a_crop_is_no_other_scan(capsys):
    """What a crop leaves out of labels on the same voxels is no fault, and they are not
    resampled.
    """
    mask = shaped("ball", OBLIQUE)[1]
    save_image("m.nii.gz", mask)
    assert exit_code(
        "mesh image.nii.gz --crop 14:,:,2:30 --nodes 300 --iterations 0 --mask m.nii.gz -o a.vtu"
    ) in (0, 1)
    said = capsys.readouterr().err
    assert "m.nii.gz" not in said
    assert f"within a mask of {int(mask.data[14:, :, 2:30].sum())} voxels" in said


def test_a_mesh_of_a_mask_is_checked_as_one(run, capsys):
    """Without the mask at hand, too: the file says that there was one."""
    assert_done("quality", run / "mesh.vtu", "--image image.nii.gz --check")
    assert "checked: conforming, oriented; meshed within a mask" in capsys.readouterr().out


def test_intensities_are_no_labels(capsys):
    rng = np.random.default_rng(0)
    save_image("noise.nii.gz", Image(np.rint(3.0 * rng.random((24, 24, 24)))))
    command = "mesh noise.nii.gz --labels noise.nii.gz --nodes 200 --iterations 0 -o a.vtu"
    exit_code(command)
    assert "check that these are labels, not intensities" in capsys.readouterr().err


def test_a_volume_of_a_4d_file(capsys):
    """FILE:K; without it the line says so."""
    image, mask = shaped("ball", OBLIQUE)
    both = np.stack([np.ones(image.shape), mask.data], axis=-1).astype(np.float32)
    nibabel.Nifti1Image(both, OBLIQUE).to_filename("four.nii.gz")
    command = "mesh image.nii.gz --uniform --nodes 300 --iterations 0 -o a.vtu --json a.json --mask"
    assert_refused(
        capsys, f"{command} four.nii.gz", "the file has 2 volumes; choose one from 0 to 1"
    )
    assert_done(f"{command} four.nii.gz:1")
    assert numbers_in("a.json")["mask"]["voxels"] == mask.data.sum()
    mesh = load_mesh("a.vtu").mesh
    assert quality(mesh.points, mesh.cells).volume < 0.3 * image.volume


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ("--background dark", '--background: expected a number, got "dark"'),
        ("--label-weight 2", "--label-weight: needs --labels"),
        ("--weights 1,2", "weights: expected one for each of 1 images, 0 or 0.001 to 1000, got"),
        ("--mask empty.nii.gz", "empty.nii.gz: "),
        ("--mask far.nii.gz", "far.nii.gz: "),
        ("--mask parts.nii.gz", "parts.nii.gz: expected a mask"),
        ("--labels half.nii.gz", "half.nii.gz: labels must be whole numbers"),
        ("--labels far.nii.gz", "far.nii.gz: "),
        ("--method paper --mask mask.nii.gz", "--method paper: needs one IMAGE and its whole box"),
    ],
)
def test_refused(capfd, options, match):
    assert_refused(capfd, f"mesh image.nii.gz {options} --nodes 100 -o a.vtu", match)


def test_quality_of_a_mask_beside_the_mesh(capsys):
    """Exit 1, as of a run, and no distances of a boundary that is not there."""
    image = Image(np.random.default_rng(0).uniform(0.0, 50.0, (10, 10, 10)))
    save_image("a.nii.gz", image)
    tetopt.save_mesh("a.vtu", tetopt.lattice_mesh(image, nodes=150))
    for first, last, expected in ((4, 6, 1), (0, 10, 0)):
        mask = np.zeros(image.shape)
        mask[first:last] = 1.0
        save_image("m.nii.gz", Image(mask))
        words = "quality a.vtu --image a.nii.gz --mask m.nii.gz"
        assert exit_code(words) == expected
        said = capsys.readouterr()
        assert ("overlap with a Dice of only 0.333" in said.err) == bool(expected)
        assert "nan voxels" not in said.out
        assert "one surface is missing" in said.out


def test_the_background_takes_no_label(capsys):
    """A gland of 123 voxels beside a body of 14,000 has cells, and no piece is left out."""
    body = distance((44, 36, 36), 16, 18, 18)
    labels = np.where(body < 15, 1.0, 0.0) + (body < 6)
    labels[distance(labels.shape, 38, 6, 6) < 3.1] = 3.0
    labels[6:9, 17:19, 17:19] = 0.0  # enclosed: cells of label 0
    save_image("l.nii.gz", Image(labels))
    assert_done(
        "mesh l.nii.gz --labels l.nii.gz --background 0 --nodes 900 -o a.vtu --iterations 2"
    )
    loaded = load_mesh("a.vtu")
    assert (
        loaded.cell_data["volume"][loaded.cell_data["label"] == 3].sum() > 0.5 * (labels == 3).sum()
    )
    assert "bright ones are removed" not in capsys.readouterr().err


@pytest.mark.parametrize("more", ["--background 0", "--mask l.nii.gz", "--mask m.nii.gz", ""])
def test_a_map_of_one_label(capsys, more):
    """Also with one value in every voxel, where there is no label 0."""
    ball = distance((20, 20, 20), 9, 10, 9) < 7
    data = np.where(ball, 5.0, 0.0) if more and "m.nii" not in more else np.full(ball.shape, 5.0)
    save_image("l.nii.gz", Image(data))
    save_image("m.nii.gz", Image(1.0 * ball))
    assert_done(
        f"mesh l.nii.gz --labels l.nii.gz {more} --nodes 150 --iterations 1 -o a.vtu --json a.json"
    )
    assert np.unique(load_mesh("a.vtu").cell_data["label"]).tolist() == [5]
    (row,) = numbers_in("a.json")["labels"]
    assert (row["label"], row["voxels"], row["is_lost"]) == (
        5,
        ball.sum() if more else ball.size,
        False,
    )
    capsys.readouterr()


def test_label_zero_within_a_mask_has_a_row(capsys):
    """A cavity of 123 voxels in a label, within a mask; voxels of label 0 outside do not count."""
    ball = distance((24, 24, 24), 11, 12, 11)
    labels = np.where(ball < 9, 2.0, 0.0) * (ball >= 4)
    save_image("l.nii.gz", Image(labels))
    save_image("m.nii.gz", Image(1.0 * (ball < 9)))
    command = "mesh l.nii.gz --labels l.nii.gz --mask m.nii.gz --nodes 500 --iterations 3"
    assert_done(f"{command} -o a.vtu --json a.json")
    zero, two = numbers_in("a.json")["labels"]
    assert (zero["label"], zero["voxels"], two["label"]) == (0, int((ball < 4).sum()), 2)
    assert zero["dice"] > 0.9
    numbers = [row["mesh_cavities"] for row in numbers_in("a.json")["interfaces"]]
    assert numbers == [0, 1]
    capsys.readouterr()


def test_labels_twice_finer_are_no_other_scan(capsys):
    """The voxels of the image, once divided, are as many as those of the labels, which begin
    elsewhere.
    """
    image = Image(np.random.default_rng(0).random((8, 8, 8)), np.diag([2.0, 2.0, 2.0, 1.0]))
    labels = np.zeros((16, 16, 16), np.uint8)
    labels[5:11, 5:11, 5:11] = 3
    affine = np.eye(4)
    affine[:3, 3] = 1.5
    save_image("a.nii.gz", image)
    save_image("l.nii.gz", Image(labels, affine))
    assert exit_code("mesh a.nii.gz --labels l.nii.gz -o a.vtu --nodes 100 --iterations 0") in (
        0,
        1,
    )
    said = capsys.readouterr().err
    assert "divided by 2 x 2 x 2" in said
    assert "same scan" not in said


def test_a_label_beyond_the_largest_is_refused():
    """Also in 32 bits, in which the largest is rounded to it."""
    labels = Image(np.full((4, 4, 4), 2**31, np.float32))
    with pytest.raises(
        tetopt.InputError, match="whole numbers from 0 to 2147483647; 64 voxels have other values"
    ):
        tetopt.resample_labels(labels, Image(np.zeros((4, 4, 4))))


def test_labels_and_a_mask_finer_than_the_image_keep_their_voxels():
    """Tables count the file's own voxels, one of a label 2^31 - 1 in a sheet as thin as they
    are.
    """
    fine = Image(np.zeros((24, 24, 24)), np.diag([1.0, 1.0, 1.0, 1.0]))
    labels = np.where(distance(fine.shape, 12, 12, 12) < 9, 5.0, 0.0)
    labels[12, 6:18, 6:18] = 2.0**31 - 1
    coarse = np.diag([2.0, 2.0, 2.0, 1.0])
    coarse[:3, 3] = 0.5
    rng = np.random.default_rng(0)
    save_image("i.nii.gz", Image(rng.normal(size=(12, 12, 12)), coarse))
    save_image("l.nii.gz", Image(labels))
    save_image("m.nii.gz", Image(labels > 0))
    save_image("two.nii.gz", Image(rng.normal(size=(12, 12, 12)), coarse))
    files = "--labels l.nii.gz --mask m.nii.gz"
    assert exit_code(
        f"mesh i.nii.gz two.nii.gz {files} --nodes 1500 --iterations 1 -o a.vtu --json a.json"
    ) in (0, 1)
    numbers = numbers_in("a.json")
    assert numbers["inputs"]["divided"] == [2, 2, 2]
    counts = {row["label"]: row["voxels"] for row in numbers["labels"]}
    assert counts == {label: np.count_nonzero(labels == label) for label in (5, 2**31 - 1)}
    assert numbers["mask"]["voxels"] == np.count_nonzero(labels)
    mesh = load_mesh("a.vtu")
    assert np.unique(mesh.cell_data["label"]).tolist() == [5, 2**31 - 1]
    assert "label_2147483647" in mesh.sets.cells
    assert_done(f"quality a.vtu --image i.nii.gz {files} --json q.json")
    again = numbers_in("q.json")
    assert {row["label"]: row["voxels"] for row in again["labels"]} == counts
    flat = "mesh i.nii.gz --labels l.nii.gz --slice k=6 --crop 2:10,:,:"
    assert exit_code(f"{flat} -o s.vtu --nodes 200 --iterations 0 --json s.json") in (0, 1)
    counted = {row["label"]: row["voxels"] for row in numbers_in("s.json")["labels"]}
    plane = labels[4:20, :, 13]  # the nearest above the middle of two
    assert counted == {label: np.count_nonzero(plane == label) for label in (0, 5, 2**31 - 1)}


def test_labels_of_a_segmentation_are_the_mask(capfd):
    """By number or name, several together; the labels' own file may be the mask's."""
    labels = np.where(distance((20, 20, 20), 9, 9, 9) < 7, 5.0, 0.0)
    labels[:10][labels[:10] > 0] = 2.0
    save_image("l.nii.gz", Image(labels))
    Path("names.csv").write_text("label,name\n5,liver\n2,spleen\n")
    mesh = "mesh l.nii.gz --mask l.nii.gz --nodes 150 --iterations 0 --json a.json --force"
    for words, chosen in (
        ("5", [5]),
        ("liver,2 --label-names names.csv --labels l.nii.gz", [2, 5]),
    ):
        assert exit_code(f"{mesh} -o a.vtu --mask-label {words}") in (0, 1)
        numbers = numbers_in("a.json")
        assert numbers["mask"]["voxels"] == np.isin(labels, chosen).sum()
        assert numbers["inputs"]["mask_label"] == words.split()[0]
    assert_done(
        "quality a.vtu --image l.nii.gz --mask l.nii.gz --mask-label 2,5 --json q.json --force"
    )
    assert numbers_in("q.json")["mask"]["voxels"] == np.count_nonzero(labels)
    capfd.readouterr()
    assert_refused(
        capfd, f"{mesh} -o b.vtu --mask-label 7", 'no voxel with label "7"; it has 0, 2, 5$'
    )
    assert_refused(
        capfd, f"{mesh} -o b.vtu", "got 3 values from 0 to 5 .*; choose labels with --mask-label"
    )
    assert_refused(capfd, "mesh l.nii.gz -o b.vtu --mask-label 5", "--mask-label: needs --mask$")
