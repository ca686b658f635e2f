"""The command with masks, backgrounds, labels and several contrasts."""

import contextlib
import itertools
import re
import threading
import time
from pathlib import Path

import nibabel
import numpy as np
import pytest
from commands import assert_done, in_copy_of, numbers_in, refusals, run_command
from numpy.testing import assert_array_equal
from shapes import OBLIQUE, distance, grid, shaped

import tetopt
from tetopt import Image, check_mesh, load_mesh, quality, save_image
from tetopt.cli import run as cli_run
from tetopt.model.sets import nodes_of

pytestmark = pytest.mark.full


here = in_copy_of("inputs")


def moved_to(affine, image, *corner):
    """The affine with the first voxel where an image has a place."""
    affine = affine.copy()
    affine[:3, 3] = image.to_world(np.array(corner, dtype=float))
    return affine


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """An image with a mask, labels and a contrast on grids of their own, and the run of all; and
    what goes wrong.
    """
    folder = tmp_path_factory.mktemp("domains")
    image, mask = shaped("ball", OBLIQUE)
    labels = np.where(grid(image.shape)[..., 0] > 14, 4.0, 2.0)
    labels[13:15, 8:15, 8:15] = 9.0  # a plate thinner than two cells
    twice = OBLIQUE @ np.diag([0.5, 0.5, 0.5, 1.0])
    fine = np.repeat(np.repeat(np.repeat(image.data**2, 2, 0), 2, 1), 2, 2)
    head = np.where(distance(image.shape, 13, 14, 15) < 10, 500.0, 0.0) + 0.2 * image.data
    head[10:14, 12:15, 12:15] = 0.0  # a dark cavity
    far = OBLIQUE.copy()
    far[:3, 3] += 500.0
    both = np.stack([np.ones(image.shape), mask.data], axis=-1).astype(np.float32)
    for name, data, affine in (
        ("image", image.data, OBLIQUE),
        ("mask", mask.data, OBLIQUE),
        ("labels", labels[2:, 1:, 3:], moved_to(OBLIQUE, image, 2, 1, 3)),
        ("square", fine, moved_to(twice, image, -0.25, -0.25, -0.25)),
        ("head", head, np.eye(4)),
        ("far", mask.data, far),
        ("empty", 0.0 * mask.data, OBLIQUE),
        ("parts", labels, OBLIQUE),
        ("half", labels + 0.5, OBLIQUE),
    ):
        save_image(f"{folder}/{name}.nii.gz", Image(data, affine))
    nibabel.Nifti1Image(both, OBLIQUE).to_filename(f"{folder}/four.nii.gz")
    (folder / "run").mkdir()
    assert_done(
        f"mesh {folder}/image.nii.gz {folder}/square.nii.gz --weights 1,0.5",
        f"--mask {folder}/mask.nii.gz --labels {folder}/labels.nii.gz --nodes 600",
        f"-o {folder}/run/mesh.vtu --json {folder}/run/run.json --figures {folder}/run",
        "--young 2 --load compress:2%",
    )
    return folder


def test_the_mesh_file():
    for name in ("slice", "rho", "energies", "boundary", "labels"):
        assert Path(f"run/{name}.png").is_file()
    loaded = load_mesh("run/mesh.vtu")
    fields, (image, mask) = loaded.cell_data, shaped("ball", OBLIQUE)
    assert check_mesh(loaded.mesh) == []
    size = mask.data.sum() * image.voxel_volume
    assert fields["volume"].sum() == pytest.approx(size, rel=0.04)
    assert {"label", "mean", "variance", "mean_2", "variance_2"} <= set(fields)
    assert set(fields["label"]) <= {2, 4, 9}
    x = image.to_index(loaded.mesh.points[loaded.mesh.cells].mean(axis=1))[:, 0] - 14.5
    assert (fields["label"] == np.where(x > 0.0, 4, 2))[np.abs(x) > 2.5].mean() > 0.99
    # The second contrast is the first one's square, on voxels of half the size.
    squares = fields["mean"] ** 2 + fields["variance"]
    assert np.corrcoef(squares, fields["mean_2"])[0, 1] > 0.97


def test_the_numbers():
    numbers = numbers_in("run/run.json")
    inputs, mask = numbers["inputs"], numbers["mask"]
    assert inputs["images"] == ["image.nii.gz", "square.nii.gz"]
    assert (inputs["weights"], inputs["mask"]) == ([1.0, 0.5], "mask.nii.gz")
    assert set(inputs["sha256"]) == {"square.nii.gz", "mask.nii.gz", "labels.nii.gz"}
    assert mask["voxels"] == shaped("ball")[1].data.sum()
    assert mask["dice"] > 0.98
    assert mask["distance_mean"] < 0.25
    dice = {row["label"]: row["dice"] for row in numbers["labels"]}
    assert list(dice) == [2, 4, 9]
    assert dice[2] > 0.95
    contrasts = numbers["contrasts"]
    assert [row["weight"] for row in contrasts] == [1.0, 0.5]
    for one in (contrasts[1], numbers["energies"]):
        assert 0.0 < one["E_D_fraction_of_variance"] < 0.5


def test_the_wait_for_a_start_is_said(monkeypatch):
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
    said = run_command("mesh image.nii.gz --mask mask.nii.gz --nodes 300 --iterations 0 -o a.vtu")
    begun, octree, rest = said.err.partition("octree of ")
    assert octree
    assert "reading and preparing the image" in begun
    assert "building the initial mesh, " in begun
    assert "building the initial mesh" not in rest
    assert "preparing the optimisation, " in rest


def test_log_files_get_few_lines(monkeypatch, capsys):
    """Each line of a stage waits twice as long as the one before."""
    monkeypatch.setattr(cli_run, "LINE_SECONDS", 0.02)
    with cli_run.waiting("reading"):
        time.sleep(0.5)
    assert 1 <= capsys.readouterr().err.count("reading, ") <= 5
    now = itertools.count()
    monkeypatch.setattr(cli_run.time, "perf_counter", lambda: 0.01 * next(now))
    say = cli_run.rare_lines()
    for _ in range(100):
        say("compiling")
    assert 4 <= capsys.readouterr().err.count("compiling") <= 6


def noisy_head(folder):
    """A ball in noise above 0."""
    rng, grid = np.random.default_rng(1), np.indices((30, 30, 30)) - 14.5
    data = np.abs(rng.normal(0.0, 8.0, (30, 30, 30))) + 0.1
    data[rng.uniform(size=data.shape) < 0.09] = 0.0
    data[(grid**2).sum(axis=0) < 100.0] += 100.0
    tetopt.save_image(folder / "noisy.nii.gz", tetopt.Image(data))


@pytest.mark.parametrize(("level", "is_told"), [("0", True), ("auto", False), ("40", False)])
def test_a_background_of_noise_asks_for_auto_not_for_nodes(level, is_told):
    noisy_head(Path())
    words = "mesh noisy.nii.gz --nodes 200 --iterations 0 -o noisy.vtu --background"
    said = run_command(f"{words} {level}", code=None).err
    lines = [line for line in said.splitlines() if "use --background auto" in line]
    assert bool(lines) == is_told
    assert not is_told or "noise" in lines[0]
    assert not is_told or "allow more nodes" not in said


def test_an_organ_is_compressed_between_its_own_top_and_bottom():
    """By `mesh`, `convert` and `fem` alike, though nothing of it lies on the box's faces."""
    height = load_mesh("run/mesh.vtu").mesh.points[:, 2]
    said = run_command("convert run/mesh.vtu a.inp --young 3 --load compress:2%").out
    assert re.search(r"\ninferior +\d+ +[\d.]+ +\d+ *\n", said)
    for words in ("", "--load compress:2% -o solved.vtu"):  # first the loads that `mesh` wrote
        assert_done(f"fem run/mesh.vtu {words} --json a.json --force")
        (step,) = numbers_in("a.json")["steps"]
        assert step["largest_displacement"] == pytest.approx(0.02 * np.ptp(height), rel=0.1)
        assert step["reactions"]["superior"][2] < 0.0 < step["reactions"]["inferior"][2]
    solved = load_mesh("solved.vtu")
    pressed = nodes_of(solved.mesh, solved.sets.facets["inferior"])
    assert solved.mesh.points[pressed, 2].max() < np.percentile(height, 25)


def test_measured_again():
    """`quality` finds the same of the file as the run of the mesh."""
    words = "--image image.nii.gz --check --mask mask.nii.gz --labels labels.nii.gz --all"
    said = run_command(f"quality run/mesh.vtu {words} --json q.json").out
    first, again = (numbers_in(path) for path in ("run/run.json", "q.json"))

    def assert_alike(one, other):
        if isinstance(one, dict | list):
            for key in one if isinstance(one, dict) else range(len(one)):
                assert_alike(one[key], other[key])
        else:
            assert one == pytest.approx(other, nan_ok=True)

    for name in ("mask", "labels", "interfaces", "contact_totals"):
        assert_alike(first[name], again[name])
        assert_alike(again[name], first[name])
    for name, key in (("contacts", "labels"), ("labels", "label"), ("interfaces", "label")):
        assert [row[key] for row in again[name]] == [row[key] for row in first[name]]
    labels, area_ratio = again["labels"], again["interfaces"][0]["area_ratio"]
    assert [row["label"] for row in labels] == [2, 4, 9]
    assert labels[2]["cells_across"] < 2.0
    for words in (
        "boundary to the mask's surface, mean, 95 %",
        "volume, mm3",
        "majority",
        "contact beyond 1.2 times that",
        "layer, %",
        f"{area_ratio:.3f}",
        f"{labels[0]['volume_dice']:.4f}    {labels[0]['dice_majority']:.4f}",
    ):
        assert words in said
    assert re.search(r"cells +% +Dice", said)
    # Without the mask at hand, too: the file says that there was one.
    said = run_command("quality run/mesh.vtu --image image.nii.gz --check").out
    assert "checked: conforming, oriented; meshed within a mask" in said


@pytest.mark.parametrize("more", ["--background 60", "--labels labels.nii.gz"])
def test_quality_and_mesh_judge_alike(more):
    """One name and one value of E_D's fraction, the same verdicts, and the same exit code."""
    image, again = ("head.nii.gz", "") if "background" in more else ("image.nii.gz", more)
    sizes = "--target-error 0.02 --size-min 5 --iterations 2"
    said = run_command(f"mesh {image} {more} {sizes} -o a.vtu --json a.json", code=1)
    check = f"quality a.vtu --image {image} {again} --check --json q.json"
    judged = run_command(check, code=1)
    first, second = numbers_in("a.json"), numbers_in("q.json")
    fraction = second["fit"]["E_D_fraction_of_variance"]
    assert fraction == pytest.approx(first["energies"]["E_D_fraction_of_variance"], rel=1e-9)
    assert set(second["violated"]) == set(first["violated"]) >= {"error"}
    for pattern in (".*variance is unexplained.*", "E_D, fraction of .* variance(?= )"):
        first, second = (re.findall(pattern, "".join(each)) for each in (said, judged))
        assert first == second != []
    assert f"{fraction:.5f}" in judged.out
    first, second = (re.findall("fraction of its variance.*", each.out) for each in (said, judged))
    assert first == second


def test_background():
    command = "mesh head.nii.gz --background auto --uniform --nodes 400"
    said = run_command(f"{command} --iterations 2 -o a.vtu --json a.json")
    ball = (distance((28, 30, 32), 13, 14, 15) < 10).sum()
    assert 0.0 < numbers_in("a.json")["inputs"]["background"] < 400.0
    # the cavity stays in
    assert load_mesh("a.vtu").mesh.cell_volumes.sum() == pytest.approx(ball, rel=0.05)
    assert "E_D, fraction of the image's variance" in said.out
    assert "boundary to the foreground's surface" in said.out
    assert "mask" not in said.out + said.err


def test_labels_alone():
    """An image that is its own labels: whatever numbers they have, each counts as itself."""
    words = "--nodes 300 --iterations 3 -o a.vtu --json a.json"
    said = run_command(f"mesh parts.nii.gz --labels parts.nii.gz {words}")
    assert numbers_in("a.json")["inputs"]["weights"] == [0.0]
    assert "only the labels are used" in said.err
    assert "E_D, fraction of the labels' variance" in said.out
    assert_done("view a.vtu --html a.html")
    # not the means of their numbers
    assert '"fields": [{"name": "label"' in Path("a.html").read_text()


def test_a_label_never_vanishes_silently():
    labels = np.zeros((30, 30, 30))
    labels[10:20, 10:20, 14] = 1.0
    labels[10:20, 10:20, 15] = 2.0
    labels[10:20, 10:20, 16] = 1.0
    labels[4:24, 4:24, 22] = 3.0
    save_image("labels.nii.gz", Image(labels))
    # The lattice itself, much coarser than the sheets.
    command = "mesh labels.nii.gz --labels labels.nii.gz --uniform --nodes 60 --iterations 0"
    said = run_command(f"{command} -o a.vtu --free-volumes", code=1).err
    assert "no voxel of label 3, of 200 voxels or more, lies in a cell with that label" in said
    # smaller than two cells, in two pieces and in one
    assert "no cell has label 1, 2, of fewer" in said
    # Labels whose volumes are kept have cells there, too, if not of all their volume.
    said = run_command(f"{command} -o b.vtu --json b.json", code=1).err
    assert (
        "the volume of cells is not 0.6 to 1.5 times that of voxels: 0.312 for label 3; allow more"
        in said
    )
    assert all(row["n_cells"] > 0 for row in numbers_in("b.json")["labels"])


def test_a_slice_of_all():
    """Also of a mask that is stored upside down: the same mask in the same place of the world,
    its last axis turned.
    """
    image, mask = shaped("touching", OBLIQUE)
    turned = moved_to(OBLIQUE @ np.diag([1, 1, -1, 1]), image, 0, 0, image.shape[2] - 1)
    save_image("turned.nii.gz", Image(mask.data[..., ::-1], turned))
    words = "mesh image.nii.gz --slice k=12 --mask turned.nii.gz --labels parts.nii.gz --nodes 150"
    assert_done(f"{words} -o a.vtu --json a.json")
    mesh = load_mesh("a.vtu").mesh
    assert mesh.ndim == 2
    assert check_mesh(mesh) == []
    assert numbers_in("a.json")["mask"]["voxels"] == mask.data[..., 12].sum()


def test_files_on_other_grids_are_told():
    """And so are a mask of which half lies elsewhere, and one of the image's shape that is a
    little off.
    """
    image, mask = shaped("ball", OBLIQUE)
    turned, last = OBLIQUE @ np.diag([-1.0, 1.0, 1.0, 1.0]), image.shape[0] - 1.0
    for name, data, affine in (
        ("half", mask.data, moved_to(OBLIQUE, image, 14, 0, 0)),
        ("near", mask.data, moved_to(OBLIQUE, image, 1.5, 0, 0)),
        # the same space: more of it, and its axes the other way
        ("wide", np.pad(mask.data, 3, constant_values=1.0), moved_to(OBLIQUE, image, -3, -3, -3)),
        ("turned", mask.data[::-1], moved_to(turned, image, last, 0, 0)),
        # and elsewhere, as labels of FreeSurfer
        ("aside", mask.data[::-1], moved_to(turned, image, last + 1.5, 0, 0)),
    ):
        save_image(f"{name}.nii.gz", Image(data, affine))
        command = "mesh image.nii.gz square.nii.gz --nodes 300 --iterations 0 --force -o a.vtu"
        said = run_command(f"{command} --mask {name}.nii.gz", code=None).err
        assert "square.nii.gz: resampled to the image's grid (linear)" in said
        assert f"{name}.nii.gz: resampled to the image's grid (nearest neighbour)" in said
        words = {
            "half": "48.7% of it lies outside the image; its box covers 50.0% of the image (same "
            "shape, different affine); is it from the same scan?",
            "near": "0.0% of it lies outside the image",
        }
        assert f"{name}.nii.gz: {words.get(name, '')}" in said
        assert ("same scan" in said) == (name in words)


def test_a_crop_is_no_other_scan():
    """What a crop leaves out of labels on the same voxels is no fault, and they are not
    resampled.
    """
    words = "--crop 14:,:,2:30 --nodes 300 --iterations 0 --mask mask.nii.gz -o a.vtu"
    said = run_command(f"mesh image.nii.gz {words}", code=None).err
    assert "mask.nii.gz" not in said
    n_voxels = int(shaped("ball")[1].data[14:, :, 2:30].sum())
    assert f"within a mask of {n_voxels} voxels" in said


def test_intensities_are_no_labels():
    rng = np.random.default_rng(0)
    save_image("noise.nii.gz", Image(np.rint(3.0 * rng.random((24, 24, 24)))))
    command = "mesh noise.nii.gz --labels noise.nii.gz --nodes 200 --iterations 0 -o a.vtu"
    assert "check that these are labels, not intensities" in run_command(command, code=None).err


def test_a_volume_of_a_4d_file():
    """FILE:K; without it the line says so."""
    image, mask = shaped("ball", OBLIQUE)
    command = "mesh image.nii.gz --uniform --nodes 300 --iterations 0 -o a.vtu --json a.json"
    assert_done(f"{command} --mask four.nii.gz:1")
    assert numbers_in("a.json")["mask"]["voxels"] == mask.data.sum()
    mesh = load_mesh("a.vtu").mesh
    assert quality(mesh.points, mesh.cells).volume < 0.3 * image.volume


test_refused = refusals(
    """
convert run/mesh.vtu b.inp --load hold:top
    no set of facets "top"; known sets are boundary, left, right, .*, superior, mask_surface, interf
mesh image.nii.gz -o a.vtu --mask four.nii.gz
    the file has 2 volumes; choose one from 0 to 1
mesh image.nii.gz -o a.vtu --background dark
    --background: expected a number, got "dark"
mesh image.nii.gz -o a.vtu --label-weight 2
    --label-weight: needs --labels
mesh image.nii.gz -o a.vtu --weights 1,2
    weights: expected one for each of 1 images, 0 or 0.001 to 1000, got
mesh image.nii.gz -o a.vtu --mask empty.nii.gz
    empty.nii.gz:
mesh image.nii.gz -o a.vtu --mask far.nii.gz
    far.nii.gz:
mesh image.nii.gz -o a.vtu --mask parts.nii.gz
    parts.nii.gz: expected a mask
mesh image.nii.gz -o a.vtu --labels half.nii.gz
    half.nii.gz: labels must be whole numbers
mesh image.nii.gz -o a.vtu --labels far.nii.gz
    far.nii.gz:
mesh image.nii.gz -o a.vtu --method paper --mask mask.nii.gz
    --method paper: needs one IMAGE and its whole box
mesh image.nii.gz -o b.vtu --mask parts.nii.gz --mask-label 7
    no voxel with label "7"; it has 2, 4, 9
mesh image.nii.gz -o b.vtu --mask parts.nii.gz
    got 3 values from 2 to 9 .*; choose labels with --mask-label
mesh image.nii.gz -o b.vtu --mask-label 5
    --mask-label: needs --mask
"""
)


def test_quality_of_a_mask_beside_the_mesh():
    """Exit 1, as of a run, and no distances of a boundary that is not there."""
    image = Image(np.random.default_rng(0).uniform(0.0, 50.0, (10, 10, 10)))
    save_image("a.nii.gz", image)
    tetopt.save_mesh("a.vtu", tetopt.lattice_mesh(image, nodes=150))
    for first, last, code in ((4, 6, 1), (0, 10, 0)):
        mask = np.zeros(image.shape)
        mask[first:last] = 1.0
        save_image("m.nii.gz", Image(mask))
        said = run_command("quality a.vtu --image a.nii.gz --mask m.nii.gz", code=code)
        assert ("overlap with a Dice of only 0.333" in said.err) == bool(code)
        assert "nan voxels" not in said.out
        assert "one surface is missing" in said.out


def test_the_background_takes_no_label():
    """A gland of 123 voxels beside a body of 14,000 has cells, and no piece is left out."""
    body = distance((44, 36, 36), 16, 18, 18)
    labels = np.where(body < 15, 1.0, 0.0) + (body < 6)
    labels[distance(labels.shape, 38, 6, 6) < 3.1] = 3.0
    labels[6:9, 17:19, 17:19] = 0.0  # enclosed: cells of label 0
    save_image("l.nii.gz", Image(labels))
    words = "--background 0 --nodes 900 -o a.vtu --iterations 2"
    said = run_command(f"mesh l.nii.gz --labels l.nii.gz {words}").out
    fields = load_mesh("a.vtu").cell_data
    assert fields["volume"][fields["label"] == 3].sum() > 0.5 * (labels == 3).sum()
    assert "bright ones are removed" not in said


@pytest.mark.parametrize("more", ["--background 0", "--mask l.nii.gz", "--mask m.nii.gz", ""])
def test_a_map_of_one_label(more):
    """Also with one value in every voxel, where there is no label 0."""
    ball = distance((20, 20, 20), 9, 10, 9) < 7
    data = np.where(ball, 5.0, 0.0) if more and "m.nii" not in more else np.full(ball.shape, 5.0)
    save_image("l.nii.gz", Image(data))
    save_image("m.nii.gz", Image(1.0 * ball))
    words = "--nodes 150 --iterations 1 -o a.vtu --json a.json"
    assert_done(f"mesh l.nii.gz --labels l.nii.gz {more} {words}")
    assert np.unique(load_mesh("a.vtu").cell_data["label"]).tolist() == [5]
    (row,) = numbers_in("a.json")["labels"]
    n_voxels = ball.sum() if more else ball.size
    assert (row["label"], row["voxels"], row["is_lost"]) == (5, n_voxels, False)


def test_label_zero_within_a_mask_has_a_row():
    """A cavity of 123 voxels in a label, within a mask; voxels of label 0 outside do not count."""
    ball = distance((24, 24, 24), 11, 12, 11)
    save_image("l.nii.gz", Image(np.where(ball < 9, 2.0, 0.0) * (ball >= 4)))
    save_image("m.nii.gz", Image(1.0 * (ball < 9)))
    command = "mesh l.nii.gz --labels l.nii.gz --mask m.nii.gz --nodes 500 --iterations 3"
    assert_done(f"{command} -o a.vtu --json a.json")
    numbers = numbers_in("a.json")
    zero, two = numbers["labels"]
    assert (zero["label"], zero["voxels"], two["label"]) == (0, (ball < 4).sum(), 2)
    assert zero["dice"] > 0.9
    assert [row["mesh_cavities"] for row in numbers["interfaces"]] == [0, 1]


def test_labels_twice_finer_are_no_other_scan():
    """The voxels of the image, once divided, are as many as those of the labels, which begin
    elsewhere.
    """
    affine, labels = np.eye(4), np.zeros((16, 16, 16))
    affine[:3, 3] = 1.5
    labels[5:11, 5:11, 5:11] = 3
    save_image("l.nii.gz", Image(labels, affine))
    image = np.random.default_rng(0).random((8, 8, 8))
    save_image("a.nii.gz", Image(image, np.diag([2.0, 2.0, 2.0, 1.0])))
    words = "mesh a.nii.gz --labels l.nii.gz -o a.vtu --nodes 100 --iterations 0"
    said = run_command(words, code=None).err
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
    largest = 2**31 - 1
    labels = np.where(distance((24, 24, 24), 12, 12, 12) < 9, 5.0, 0.0)
    labels[12, 6:18, 6:18] = largest
    coarse = np.diag([2.0, 2.0, 2.0, 1.0])
    coarse[:3, 3] = 0.5
    rng = np.random.default_rng(0)
    for name, data, affine in (
        ("i", rng.normal(size=(12, 12, 12)), coarse),
        ("two", rng.normal(size=(12, 12, 12)), coarse),
        ("l", labels, np.eye(4)),
        ("m", labels > 0, np.eye(4)),
    ):
        save_image(f"{name}.nii.gz", Image(data, affine))

    def counts_in(path):
        return {row["label"]: row["voxels"] for row in numbers_in(path)["labels"]}

    def counted(values, *numbers):
        return {label: np.count_nonzero(values == label) for label in numbers}

    files, mesh = "--labels l.nii.gz --mask m.nii.gz", "--nodes 1500 --iterations 1 -o a.vtu"
    run_command(f"mesh i.nii.gz two.nii.gz {files} {mesh} --json a.json", code=None)
    numbers = numbers_in("a.json")
    assert numbers["inputs"]["divided"] == [2, 2, 2]
    assert numbers["mask"]["voxels"] == np.count_nonzero(labels)
    loaded = load_mesh("a.vtu")
    assert_array_equal(np.unique(loaded.cell_data["label"]), [5, largest])
    assert f"label_{largest}" in loaded.sets.cells
    assert_done(f"quality a.vtu --image i.nii.gz {files} --json q.json")
    assert counts_in("a.json") == counts_in("q.json") == counted(labels, 5, largest)
    flat = "mesh i.nii.gz --labels l.nii.gz --slice k=6 --crop 2:10,:,:"
    run_command(f"{flat} -o s.vtu --nodes 200 --iterations 0 --json s.json", code=None)
    plane = labels[4:20, :, 13]  # the nearest above the middle of two
    assert counts_in("s.json") == counted(plane, 0, 5, largest)


def test_labels_of_a_segmentation_are_the_mask():
    """By number or name, several together; the labels' own file may be the mask's."""
    labels = np.where(distance((20, 20, 20), 9, 9, 9) < 7, 5.0, 0.0)
    labels[:10][labels[:10] > 0] = 2.0
    save_image("l.nii.gz", Image(labels))
    Path("names.csv").write_text("label,name\n5,liver\n2,spleen\n")
    mesh = "mesh l.nii.gz --mask l.nii.gz --nodes 150 --iterations 0 -o a.vtu --json a.json --force"
    for words, chosen in (
        ("5", [5]),
        ("liver,2 --label-names names.csv --labels l.nii.gz", [2, 5]),
    ):
        run_command(f"{mesh} --mask-label {words}", code=None)
        numbers = numbers_in("a.json")
        assert numbers["mask"]["voxels"] == np.isin(labels, chosen).sum()
        assert numbers["inputs"]["mask_label"] == words.split()[0]
    words = "--image l.nii.gz --mask l.nii.gz --mask-label 2,5 --json q.json"
    assert_done(f"quality a.vtu {words}")
    assert numbers_in("q.json")["mask"]["voxels"] == np.count_nonzero(labels)
