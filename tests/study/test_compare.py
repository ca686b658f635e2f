"""`tetopt compare`: files, numbers recomputed, failures, one line for bad input."""

import pipes
from types import SimpleNamespace

import numpy as np
import PIL.Image
import pytest
from commands import exit_code, numbers_in

import tetopt
from tetopt.fem.elasticity import box_faces, compression, push_of
from tetopt.fem.reference import average_voxels, nearest, reference, refine_voxels
from tetopt.fem.reference import compare as reference_errors
from tetopt.geometry.quadratic import quadratic
from tetopt.model.averages import element_young, young_image
from tetopt.study import compare, compare_files
from tetopt.study.compare_files import COMPARE_PICTURES
from tetopt.study.compare_report import Settings
from tetopt.study.endings import AFTER_CRASHES
from tetopt.study.pipeline_process import Outcome
from tetopt.study.pipelines import PIPELINES

REFERENCE_DOFS = 2000
SMALL = f"--nodes 400 --repeats 2 --reference-dofs {REFERENCE_DOFS}"


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    """A small two-sphere volume with its true labels, their files, and a comparison of it."""
    folder = tmp_path_factory.mktemp("compare")
    phantom = tetopt.load_phantom("two_spheres")
    tetopt.save_image(folder / "image.nii.gz", phantom.image(voxel_mm=4.0))
    tetopt.save_image(folder / "labels.nii.gz", phantom.label_image(voxel_mm=4.0))
    image, labels = (tetopt.load_image(folder / f"{name}.nii.gz") for name in ("image", "labels"))
    command = f"compare {folder}/image.nii.gz {SMALL}"
    return SimpleNamespace(folder=folder, image=image, labels=labels, compare=command)


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
    out = head.folder / "out"
    options = f"--labels {head.folder}/labels.nii.gz -o {out} --pipelines tetopt,bcc"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare, "run_in_child", in_this_process)
        assert exit_code(head.compare, options) == 0
    return out


@pytest.fixture(scope="module")
def report(run):
    return numbers_in(run / "report.json")


def test_files(run):
    meshes = [f"{name}{order}.vtu" for name in ("tetopt", "bcc") for order in ("", ".quadratic")]
    names = {"report.json", "report.html", *COMPARE_PICTURES, *meshes}
    assert {path.name for path in run.iterdir()} == names


def assert_rows(rows, of_cell, mesh, owner, true):
    """Dice and volumes of each label, where the cells have these."""
    painted = of_cell.astype(int)[owner]
    assert [row["label"] for row in rows] == [0, 1, 2]
    for k, row in enumerate(rows):
        n_true = (true == k).sum()
        n_both = ((painted == k) & (true == k)).sum()
        assert row["dice"] == pytest.approx(2 * n_both / ((painted == k).sum() + n_true))
        assert row["mesh_volume"] == pytest.approx(mesh.cell_volumes[of_cell == k].sum())
        assert row["volume"] == pytest.approx(n_true * 4.0**3)


def test_numbers_are_those_of_the_meshes(run, report, head):
    """E_D, Dice and volumes, recomputed voxel by voxel from the mesh file: of labels of most
    voxels, and of its own.
    """
    h, true = head.image.data.astype(float).ravel(), head.labels.data.astype(int).ravel()
    for pipeline in report["pipelines"]:
        loaded = tetopt.load_mesh(run / f"{pipeline['name']}.vtu")
        mesh, own = loaded.mesh, loaded.cell_data.get("label")
        owner = tetopt.cell_of_voxel(head.image, mesh).ravel()
        assert (owner >= 0).all()
        means = np.bincount(owner, weights=h) / np.maximum(np.bincount(owner), 1)
        median = pipeline["median"]
        fraction = ((h - means[owner]) ** 2).sum() / ((h - h.mean()) ** 2).sum()
        assert median["E_D_fraction"] == pytest.approx(fraction, rel=1e-9)
        assert median["n_missed_voxels"] == 0
        votes = np.zeros((len(mesh.cells), 3), dtype=int)
        np.add.at(votes, (owner, true), 1)
        # a cell without a voxel has the label of the nearest one
        nearest = tetopt.cell_labels(head.labels, mesh)
        of_most = np.where(votes.any(axis=1), votes.argmax(axis=1), nearest)
        assert_rows(median["labels"], of_most, mesh, owner, true)
        if pipeline["name"] == "bcc":
            assert (own, median["own_labels"]) == (None, [])
        else:
            assert_rows(median["own_labels"], own, mesh, owner, true)


def test_a_cell_without_a_label_of_its_own_has_that_of_most_voxels(head):
    image, labels = head.image, head.labels
    mapping, _ = compare.default_mapping(image)
    settings = Settings(200, nus=(0.3,), reference_dofs=1000)
    standard = compare.prepare_references(image, labels, mapping, settings)
    mesh = tetopt.lattice_mesh(image, nodes=200)
    none, half = np.full(len(mesh.cells), -1), tetopt.measure.fidelity.cell_labels(labels, mesh)
    half[: len(half) // 2] = 0
    of_none, of_half = (compare.measure_mesh(standard, mesh, 1.0, own=own) for own in (none, half))
    assert repr(of_none.own_labels) == repr(of_none.labels) == repr(of_half.labels)
    expected = repr(tetopt.label_fidelity(labels, mesh, half))
    assert repr(of_half.own_labels) == expected != repr(of_half.labels)


def test_the_image_helps_and_the_reference_is_one(report):
    """tetopt has less E_D than the control; all are judged by one reference."""
    ours, lattice = (pipeline["median"]["E_D_fraction"] for pipeline in report["pipelines"])
    assert ours < 0.5 * lattice
    for pipeline in [*report["pipelines"], *report["quadratic"]]:
        for nu, fem in pipeline["median"]["fem"].items():
            energy = report["reference"][nu]["strain_energy"]
            error = abs(fem["strain_energy"] / energy - 1.0)
            assert fem["errors"]["strain_energy"] == pytest.approx(error, rel=1e-9)
            assert fem["seconds"] > 0.0


def test_the_quadratic_mesh_is_a_coarser_one(run, report, head):
    """About as many nodes in all; its errors are those of the library, solved anew from its
    file.
    """
    image = head.image
    mapping, _ = compare.default_mapping(image)
    shape = compare.reference_shape(image.shape, image.spacing, REFERENCE_DOFS)
    modulus = average_voxels(young_image(image, mapping), shape)
    exact, labels = reference(modulus, 0.45), nearest(head.labels, modulus).data
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
            displacement=push_of(image, 1.0),
        )
        errors = reference_errors(exact, mesh, pressed.u, pressed.strain_energy, labels)
        assert median["fem"]["0.45"]["errors"] == pytest.approx(errors._asdict(), rel=1e-6)


@pytest.mark.full
def test_when_all_fail_nothing_is_replaced(head, tmp_path, monkeypatch, capsys):
    """One line, exit 2, no report: without time for anything, and where no mesh can be measured."""
    command = f"{head.compare} -o {tmp_path}/out --pipelines bcc"
    assert exit_code(f"{command} --max-seconds 0.1") == 2
    assert "all pipelines failed" in capsys.readouterr().err

    def breaks(system):
        raise RuntimeError("no convergence")

    monkeypatch.setattr(compare, "conditioning", breaks)
    monkeypatch.setattr(compare, "run_in_child", in_this_process)
    assert exit_code(f"{command} --force") == 2
    assert "its mesh cannot be measured: no convergence" in capsys.readouterr().err
    assert not (tmp_path / "out" / "report.json").exists()


@pytest.mark.deep
def test_pytetwild_in_the_comparison(head, undrawn, tmp_path):
    """The conventional pipeline beside one that never varies, repeated: node counts near the
    wish, the range.
    """
    pytest.importorskip("pytetwild", reason="the conventional pipeline needs pytetwild")
    options = f"-o {tmp_path} --nodes 120 --classes 3 --pipelines bcc,pytetwild"
    assert exit_code(head.compare, options) == 0
    lattice, theirs = numbers_in(tmp_path / "report.json")["pipelines"]
    assert len(lattice["runs"]) == 1
    assert len(theirs["runs"]) == 2
    assert theirs["median"] == min(theirs["runs"], key=lambda run: run["E_D"])  # the lower of two
    assert abs(theirs["median"]["n_nodes"] / 120 - 1) < 0.2
    assert set(theirs["median"]["seconds"]) == {"surfaces", "tetrahedra", "search"}
    mesh = tetopt.load_mesh(tmp_path / "pytetwild.vtu").mesh
    assert tetopt.check_mesh(mesh, head.image) == []
    assert (tmp_path / "report.html").read_text(encoding="utf-8").count("pytetwild") > 3


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
    crash, out = "crashed: signal 11, SIGSEGV", tmp_path / "out"
    assert exit_code(head.compare, f"-o {out} --pipelines pytetwild,bcc") == 0
    said = capsys.readouterr()
    # of the second also with quadratic cells
    assert said.err.count(f"{crash}; running it again") == 3
    again = f"the first run {crash}; this is the second, with surfaces 2 times as smooth"
    failed = f"twice {crash}; {AFTER_CRASHES}"
    page = (out / "report.html").read_text(encoding="utf-8")
    assert f"<li>pytetwild: {again}</li>" in page
    assert f"BCC lattice: {failed}" in said.out
    assert f">{failed}</td>" in page
    once, twice = numbers_in(out / "report.json")["pipelines"]
    assert (once["failure"], once["median"] == once["runs"][0]) == (None, True)
    assert (twice["failure"], twice["median"]) == (failed, None)


def test_a_missing_peer_is_no_failure_of_it(head, tmp_path, monkeypatch, capsys):
    """Its own line names it once."""
    missing = Outcome(None, {}, 0, [], "pytetwild: not installed")
    monkeypatch.setattr(compare, "run_in_child", lambda *_, **__: missing)
    assert exit_code(head.compare, f"-o {tmp_path} --pipelines pytetwild") == 2
    assert capsys.readouterr().err.rstrip().endswith(": pytetwild: not installed")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--pipelines tetopt,gmsh", "pipelines: expected some of"),
        ("--pipelines ''", "pipelines: expected some of"),
        ("--pipelines bcc,bcc", "each once"),
        ("--k-d 1", "--k-d"),
        ("--max-seconds 0", "--max-seconds"),
        ("--max-seconds nan", "--max-seconds: expected more than 0"),
        ("--reference-dofs 999", "--reference-dofs: expected 1000 or more"),
        ("--young h-1000", "--young: expected 0 kPa or more"),
        ("--average voigt", "average: expected mean, geometric, harmonic, hill"),
    ],
)
def test_bad_input(head, here, options, words, capsys):
    assert exit_code(head.compare, "-o o", options) == 2
    assert words in capsys.readouterr().err.strip().splitlines()[-1]
