"""`tetopt compare` and `tetopt baseline`: files, numbers recomputed, failures, one line for bad
input.
"""

import json
import pipes

import numpy as np
import PIL.Image
import pytest

import tetopt
from tetopt.cli import main
from tetopt.fem.elasticity import box_faces, compression, push_of
from tetopt.fem.reference import average_voxels, nearest, reference, refine_voxels
from tetopt.fem.reference import compare as reference_errors
from tetopt.geometry.quadratic import quadratic
from tetopt.model.averages import element_young, young_image
from tetopt.study import baseline, compare, compare_files
from tetopt.study.compare_files import COMPARE_PICTURES
from tetopt.study.compare_report import Settings
from tetopt.study.endings import AFTER_CRASHES
from tetopt.study.pipeline_process import Outcome
from tetopt.study.pipelines import PIPELINES

REFERENCE_DOFS = 2000
SMALL = ["--nodes", "400", "--repeats", "2", "--reference-dofs", str(REFERENCE_DOFS)]


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    """A small two-sphere volume with its true labels."""
    folder = tmp_path_factory.mktemp("compare")
    phantom = tetopt.load_phantom("two_spheres")
    tetopt.save_image(folder / "image.nii.gz", phantom.image(voxel_mm=4.0))
    tetopt.save_image(folder / "labels.nii.gz", phantom.label_image(voxel_mm=4.0))
    return folder


@pytest.fixture
def undrawn(monkeypatch):
    """Pictures of one pixel: `test_files` is of the others."""

    def saved(*drawn):
        PIL.Image.new("L", (1, 1)).save(drawn[-1])

    monkeypatch.setattr(compare_files, "save_figure", saved)
    monkeypatch.setattr(compare_files, "cutaways", saved)


def in_this_process(pipeline, job, *_, **__):
    """What a child makes of a pipeline, without its start; children are tested in test_child.py."""
    made = pipeline(job)
    return Outcome(made.mesh, made.seconds, 10**8, made.notes, None, labels=made.labels)


@pytest.fixture(scope="module")
def run(head, opengl):
    out = head / "out"
    inputs = [str(head / "image.nii.gz"), "--labels", str(head / "labels.nii.gz")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare, "run_in_child", in_this_process)
        assert main(["compare", *inputs, "-o", str(out), *SMALL, "--pipelines", "tetopt,bcc"]) == 0
    return out


def test_files(run):
    meshes = {f"{name}{order}.vtu" for name in ("tetopt", "bcc") for order in ("", ".quadratic")}
    assert {p.name for p in run.iterdir()} == {
        "report.json",
        "report.html",
        *COMPARE_PICTURES,
        *meshes,
    }


def dice_of(painted, true):
    return [
        2 * ((painted == k) & (true == k)).sum() / ((painted == k).sum() + (true == k).sum())
        for k in range(3)
    ]


def test_numbers_are_those_of_the_meshes(run, head):
    """E_D, Dice and volumes, recomputed voxel by voxel from the mesh file: of labels of most
    voxels, and of its own.
    """
    report = json.loads((run / "report.json").read_text())
    image, labels = (tetopt.load_image(head / name) for name in ("image.nii.gz", "labels.nii.gz"))
    h, true = image.data.astype(float).ravel(), labels.data.astype(int).ravel()
    for pipeline in report["pipelines"]:
        loaded = tetopt.load_mesh(run / f"{pipeline['name']}.vtu")
        mesh, own = loaded.mesh, loaded.cell_data.get("label")
        assert (own is None) == (pipeline["name"] == "bcc")
        owner = tetopt.cell_of_voxel(image, mesh).ravel()
        assert (owner >= 0).all()
        means = np.bincount(owner, weights=h) / np.maximum(np.bincount(owner), 1)
        within = ((h - means[owner]) ** 2).sum()
        median = pipeline["median"]
        assert median["E_D_fraction"] == pytest.approx(
            within / ((h - h.mean()) ** 2).sum(), rel=1e-9
        )
        assert median["n_missed_voxels"] == 0
        votes = np.zeros((len(mesh.cells), true.max() + 1), dtype=int)
        np.add.at(votes, (owner, true), 1)
        assert [row["dice"] for row in median["labels"]] == pytest.approx(
            dice_of(votes.argmax(axis=1)[owner], true)
        )
        majority = tetopt.measure.fidelity.cell_labels(labels, mesh)
        for of_cell, key in ((majority, "labels"), (own, "own_labels")):
            if of_cell is None:
                assert median[key] == []
                continue
            assert [row["dice"] for row in median[key]] == pytest.approx(
                dice_of(of_cell.astype(int)[owner], true)
            )
            volumes = np.abs(np.linalg.det(np.diff(mesh.points[mesh.cells], axis=1))) / 6.0
            for row in median[key]:
                assert row["mesh_volume"] == pytest.approx(volumes[of_cell == row["label"]].sum())
                assert row["volume"] == pytest.approx((true == row["label"]).sum() * 4.0**3)


def test_a_cell_without_a_label_of_its_own_has_that_of_most_voxels(head):
    image, labels = (tetopt.load_image(head / name) for name in ("image.nii.gz", "labels.nii.gz"))
    mapping, _ = compare.default_mapping(image)
    standard = compare.prepare_references(
        image, labels, mapping, Settings(200, nus=(0.3,), reference_dofs=1000)
    )
    mesh = tetopt.lattice_mesh(image, nodes=200)
    none, first = np.full(len(mesh.cells), -1), tetopt.measure.fidelity.cell_labels(labels, mesh)
    made = compare.measure_mesh(standard, mesh, 1.0, own=none)
    assert repr(made.own_labels) == repr(made.labels)
    first[: len(first) // 2] = 0
    made = compare.measure_mesh(standard, mesh, 1.0, own=first)
    assert (
        repr(made.own_labels)
        == repr(tetopt.label_fidelity(labels, mesh, first))
        != repr(made.labels)
    )


def test_the_image_helps_and_the_reference_is_one(run):
    """tetopt has less E_D than the control; all are judged by one reference."""
    report = json.loads((run / "report.json").read_text())
    ours, lattice = (pipeline["median"]["E_D_fraction"] for pipeline in report["pipelines"])
    assert ours < 0.5 * lattice
    for pipeline in [*report["pipelines"], *report["quadratic"]]:
        for nu, fem in pipeline["median"]["fem"].items():
            energy = report["reference"][nu]["strain_energy"]
            error = abs(fem["strain_energy"] / energy - 1.0)
            assert fem["errors"]["strain_energy"] == pytest.approx(error, rel=1e-9)
            assert fem["seconds"] > 0.0


def test_the_quadratic_mesh_is_a_coarser_one(run, head):
    """About as many nodes in all; its errors are those of the library, solved anew from its
    file.
    """
    report = json.loads((run / "report.json").read_text())
    image = tetopt.load_image(head / "image.nii.gz")
    mapping, _ = compare.default_mapping(image)
    settings = Settings(400, reference_dofs=REFERENCE_DOFS)
    modulus = average_voxels(
        young_image(image, mapping),
        compare.reference_shape(image.shape, image.spacing, REFERENCE_DOFS),
    )
    exact = reference(modulus, 0.45)
    labels = nearest(tetopt.load_image(head / "labels.nii.gz"), modulus).data
    for pipeline in report["quadratic"]:
        mesh = tetopt.load_mesh(run / f"{pipeline['name']}.quadratic.vtu").mesh
        median = pipeline["median"]
        assert median["order"] == 2
        assert median["n_corners"] == len(mesh.points) < 100
        assert median["n_nodes"] == len(quadratic(mesh.points, mesh.cells)[0])
        assert 0.75 < median["n_nodes"] / 400 < 1.25  # of a lattice there are few so coarse
        bottom, top = box_faces(image, mesh)
        young = element_young(refine_voxels(modulus, image.shape), mesh, None, "gauss", 2)
        pressed = compression(
            mesh,
            young,
            0.45,
            fixed_nodes=top,
            pushed_nodes=bottom,
            order=2,
            displacement=push_of(image, settings.percent),
        )
        errors = reference_errors(exact, mesh, pressed.u, pressed.strain_energy, labels)
        assert median["fem"]["0.45"]["errors"] == pytest.approx(errors._asdict(), rel=1e-6)


@pytest.mark.full
def test_when_all_fail_nothing_is_replaced(head, tmp_path, monkeypatch, capsys):
    """One line, exit 2, no report: without time for anything, and where no mesh can be measured."""
    words = [str(head / "image.nii.gz"), "-o", str(tmp_path / "out"), *SMALL, "--pipelines", "bcc"]
    assert main(["compare", *words, "--max-seconds", "0.1"]) == 2
    assert "all pipelines failed" in capsys.readouterr().err

    def breaks(system):
        raise RuntimeError("no convergence")

    monkeypatch.setattr(compare, "conditioning", breaks)
    monkeypatch.setattr(compare, "run_in_child", in_this_process)
    assert main(["compare", *words, "--force"]) == 2
    assert "its mesh cannot be measured: no convergence" in capsys.readouterr().err
    assert not (tmp_path / "out" / "report.json").exists()


@pytest.mark.deep
def test_pytetwild_in_the_comparison(head, undrawn, tmp_path):
    """The conventional pipeline beside one that never varies, repeated: node counts near the
    wish, the range.
    """
    pytest.importorskip("pytetwild", reason="the conventional pipeline needs pytetwild")
    words = [
        str(head / "image.nii.gz"),
        "-o",
        str(tmp_path),
        *SMALL,
        "--nodes",
        "120",
        "--classes",
        "3",
    ]
    assert main(["compare", *words, "--pipelines", "bcc,pytetwild"]) == 0
    lattice, theirs = json.loads((tmp_path / "report.json").read_text())["pipelines"]
    assert len(lattice["runs"]) == 1
    assert len(theirs["runs"]) == 2
    assert theirs["median"] == min(theirs["runs"], key=lambda run: run["E_D"])  # the lower of two
    assert abs(theirs["median"]["n_nodes"] / 120 - 1) < 0.2
    assert (tmp_path / "report.html").read_text(encoding="utf-8").count("pytetwild") > 3


@pytest.mark.full
def test_baseline(head, tmp_path, capsys):
    pytest.importorskip("pytetwild", reason="the conventional pipeline needs pytetwild")
    command = [
        "baseline",
        str(head / "image.nii.gz"),
        "-o",
        str(tmp_path / "b.vtu"),
        "--nodes",
        "150",
    ]
    assert main([*command, "--classes", "3", "--json", str(tmp_path / "b.json")]) == 0
    numbers = json.loads((tmp_path / "b.json").read_text())
    mesh = tetopt.load_mesh(tmp_path / "b.vtu").mesh
    image = tetopt.load_image(head / "image.nii.gz")
    assert tetopt.check_mesh(mesh, image) == []
    assert numbers["fit"]["E_D"] == pytest.approx(tetopt.E_D(image, mesh), rel=1e-9)
    assert set(numbers["seconds"]) == {"surfaces", "tetrahedra", "search"}


@pytest.mark.deep
def test_a_peer_that_crashes(head, undrawn, tmp_path, monkeypatch, capsys):
    """At first: run again, and said on the page. Twice: it failed, and the line says what to
    try.
    """
    monkeypatch.setenv("PIPES_PID", str(tmp_path / "pid"))
    for name, pipe in (("pytetwild", pipes.crash_once), ("bcc", pipes.crash)):
        monkeypatch.setitem(
            PIPELINES, name, PIPELINES[name]._replace(function=pipe, is_random=False)
        )
    crash, image = "crashed: signal 11, SIGSEGV", str(head / "image.nii.gz")
    out = tmp_path / "out"
    words = [image, "-o", str(out), *SMALL, "--pipelines", "pytetwild,bcc"]
    assert main(["compare", *words]) == 0
    said = capsys.readouterr()
    # of the second also with quadratic cells
    assert said.err.count(f"{crash}; running it again") == 3
    again = f"the first run {crash}; this is the second, with surfaces 2 times as smooth"
    failed = f"twice {crash}; {AFTER_CRASHES}"
    report, page = (
        json.loads((out / "report.json").read_text()),
        (out / "report.html").read_text(encoding="utf-8"),
    )
    assert f"<li>pytetwild: {again}</li>" in page
    assert f"BCC lattice: {failed}" in said.out
    assert f">{failed}</td>" in page
    once, twice = report["pipelines"]
    assert (once["failure"], once["median"] == once["runs"][0]) == (None, True)
    assert (twice["failure"], twice["median"]) == (failed, None)


@pytest.mark.full
def test_a_missing_peer_is_no_failure_of_it(head, tmp_path, monkeypatch, capsys):
    missing = Outcome(None, {}, 0, [], "thing: not installed")
    monkeypatch.setattr(baseline, "run_in_child", lambda *_, **__: missing)
    assert (
        main(
            [
                "baseline",
                str(head / "image.nii.gz"),
                "-o",
                str(tmp_path / "b.vtu"),
                "--nodes",
                "150",
            ]
        )
        == 2
    )
    assert "tetopt: pytetwild: thing: not installed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--pipelines", "tetopt,gmsh"], "pipelines: expected some of"),
        (["--pipelines", ""], "pipelines: expected some of"),
        (["--pipelines", "bcc,bcc"], "each once"),
        (["--k-d", "1"], "--k-d"),
        (["--max-seconds", "0"], "--max-seconds"),
        (["--max-seconds", "nan"], "--max-seconds: expected more than 0"),
        (["--reference-dofs", "999"], "--reference-dofs: expected 1000 or more"),
        (["--young", "h-1000"], "--young: expected 0 kPa or more"),
        (["--average", "voigt"], "average: expected mean, geometric, harmonic, hill"),
    ],
)
def test_bad_input(head, tmp_path, options, words, capsys):
    assert (
        main(["compare", str(head / "image.nii.gz"), "-o", str(tmp_path / "o"), *SMALL, *options])
        == 2
    )
    err = capsys.readouterr().err.strip().splitlines()
    assert words in err[-1]
