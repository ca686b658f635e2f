"""`tetopt compare` and `tetopt baseline`: files, numbers recomputed, failures, resuming, one line for bad input."""

import json
import pipes
import shutil
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from attacks import content, outside, planted
from commands import assert_refused

import tetopt
from tetopt.cli import main
from tetopt.fem.budget import Budget
from tetopt.fem.elasticity import box_faces, compression, push_of
from tetopt.fem.reference import Errors, averaged, nearest, reference, refined
from tetopt.fem.reference import compare as reference_errors
from tetopt.geometry.quadratic import quadratic
from tetopt.job.events import listened
from tetopt.model.averages import element_young, young_image
from tetopt.model.mappings import parse_mapping
from tetopt.report.figures import save_figure
from tetopt.study import compare, compare_files, tradeoff
from tetopt.study.child import Outcome
from tetopt.study.compare_files import COMPARE_PICTURES
from tetopt.study.compare_report import Attempt, ImageSource, LabelSource, Settings, as_json, from_json
from tetopt.study.pipelines import PIPELINES
from tetopt.study.program import Program
from tetopt.system.work_directory import create

REFERENCE_DOFS = 2000
SMALL = ["--nodes", "400", "--repeats", "2", "--reference-dofs", str(REFERENCE_DOFS)]


LABEL_KEYS = {  # of the report, and what the library calls it
    "label": "label", "mesh_volume_mm3": "mesh_volume", "surface_mean_mm": "distance_mean",
    "surface_p95_mm": "distance_p95", "components": "components", "mesh_components": "mesh_components",
    "is_lost": "is_lost",
}  # fmt: skip


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
    """Pictures of one pixel but of the trade-off: `test_files` is of the others."""

    def saved(*drawn):
        *_, path = drawn
        if path.name == "tradeoff.png":
            save_figure(*drawn)
        else:
            PIL.Image.new("L", (1, 1)).save(path)

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
        assert main(["compare", *inputs, "-o", str(out), *SMALL, "--pipelines", "tetopt,bcc", "--curve", "0.5"]) == 0
    return out


def test_files(run):
    pictures = set(COMPARE_PICTURES) - {"tradeoff.png"}
    assert {p.name for p in run.iterdir()} == {"report.json", "report.html", "runs", *pictures}
    names = {p.stem for p in (run / "runs").iterdir()}
    assert names == {"tetopt-manifest", "lock"} | {
        f"{name}-{nodes}{order}-1" for name in ("tetopt", "bcc") for nodes in (400, 200) for order in ("", "-quadratic")
    }


def test_numbers_are_those_of_the_meshes(run, head):
    """E_D and Dice, recomputed voxel by voxel from the mesh file, and the library's measures of its labels."""
    report = json.loads((run / "report.json").read_text())
    image, labels = (tetopt.load_image(head / name) for name in ("image.nii.gz", "labels.nii.gz"))
    h, true = image.data.astype(float).ravel(), labels.data.astype(int).ravel()
    for pipeline in report["pipelines"]:
        loaded = tetopt.load_mesh(run / "runs" / f"{pipeline['name']}-400-1.vtu")
        mesh, own = loaded.mesh, loaded.cell_data.get("label")  # its pipeline's, if that gives any
        owner = tetopt.cell_of_voxel(image, mesh).ravel()
        assert (owner >= 0).all()
        means = np.bincount(owner, weights=h) / np.maximum(np.bincount(owner), 1)
        within = ((h - means[owner]) ** 2).sum()
        median = pipeline["median"]
        assert median["E_D_fraction"] == pytest.approx(within / ((h - h.mean()) ** 2).sum(), rel=1e-9)
        assert median["n_missed_voxels"] == 0
        votes = np.zeros((owner.max() + 1, true.max() + 1), dtype=int)
        np.add.at(votes, (owner, true), 1)
        painted = (votes.argmax(axis=1) if own is None else own.astype(int))[owner]
        fidelity = tetopt.measure.fidelity.label_fidelity(labels, mesh, own)
        for row, of_label in zip(median["labels"], fidelity, strict=True):
            k = row["label"]
            both = ((painted == k) & (true == k)).sum()
            assert row["voxels"] == (true == k).sum()
            assert row["mesh_voxels"] == (painted == k).sum()
            assert row["dice"] == pytest.approx(2 * both / (row["voxels"] + row["mesh_voxels"]))
            assert row["volume_mm3"] == pytest.approx(row["voxels"] * 4.0**3)
            assert [row[name] for name in LABEL_KEYS] == pytest.approx(
                [getattr(of_label, k) for k in LABEL_KEYS.values()]
            )
        of_cell = tetopt.measure.fidelity.cell_labels(labels, mesh) if own is None else own.astype(int)
        surfaces = tetopt.measure.interfaces.label_interfaces(labels, mesh, of_cell)
        for row, surface in zip(median["labels"], surfaces, strict=True):
            for name in ("area_ratio", "folded", "nonmanifold_edges", "nonmanifold_edges_two_labels"):
                value = getattr(surface, name)
                assert row[name] == (None if np.isnan(value) else pytest.approx(value))  # nan where no cell has it
        contacts = tetopt.label_contacts(labels, mesh, of_cell)
        for row, of_label in zip(median["labels"], tetopt.label_fidelity(labels, mesh, of_cell), strict=True):
            part = of_label.one_layer_fraction
            assert row["one_layer_fraction"] == (None if np.isnan(part) else pytest.approx(part))
            own = [each for each in contacts if row["label"] in each.labels]
            excess = sum(max(each.mesh_mm2 - 1.2 * each.voxels_mm2, 0.0) for each in own)
            assert row["excess_contact_mm2"] == pytest.approx(excess)
        assert sum(row["E_D_fraction"] for row in median["labels"]) == pytest.approx(median["E_D_fraction"], rel=1e-9)


def test_runs_are_read_back_as_they_were_written(run):
    for path in (run / "runs").glob("*.json"):
        row = json.loads(path.read_text())["content"]
        attempt = from_json(Attempt, row)
        assert as_json(attempt) == row
        assert sum(attempt.run.measurement.rho_histogram.fraction) == pytest.approx(1.0)
        assert attempt.run.measurement.fem["0.3"].averages["mean"].errors == Errors(
            **row["fem"]["0.3"]["averages"]["mean"]["errors"]
        )


def test_the_image_helps_and_the_reference_is_one(run):
    """tetopt has less E_D than the control; all are judged by one reference; curves have two points."""
    report = json.loads((run / "report.json").read_text())
    ours, lattice = (pipeline["median"]["E_D_fraction"] for pipeline in report["pipelines"])
    assert ours < 0.5 * lattice
    for pipeline in [*report["pipelines"], *report["quadratic"]]:
        for nu, fem in pipeline["median"]["fem"].items():
            energy = report["reference"][nu]["strain_energy"]
            for solved in fem["averages"].values():
                error = abs(solved["strain_energy"] / energy - 1.0)
                assert solved["errors"]["strain_energy"] == pytest.approx(error, rel=1e-9)
                assert solved["seconds"] > 0.0
    assert [len(curve["points"]) for curve in report["curves"]] == [2] * 4
    assert {row["other_kind"] for row in report["headline"]["behind"]} <= {"control"}


def test_the_quadratic_mesh_is_a_coarser_one(run, head):
    """About as many nodes in all; its errors are those of the library, solved anew from its file."""
    report = json.loads((run / "report.json").read_text())
    image = tetopt.load_image(head / "image.nii.gz")
    mapping, _ = compare.default_mapping(image)
    settings = Settings(400, reference_dofs=REFERENCE_DOFS)
    modulus = averaged(young_image(image, mapping), compare.reference_shape(image.shape, image.spacing, REFERENCE_DOFS))
    exact = reference(modulus, 0.45)
    labels = nearest(tetopt.load_image(head / "labels.nii.gz"), modulus).data
    for pipeline in report["quadratic"]:
        mesh = tetopt.load_mesh(run / "runs" / f"{pipeline['name']}-400-quadratic-1.vtu").mesh
        median = pipeline["median"]
        assert median["order"] == 2
        assert median["n_corners"] == len(mesh.points) < 100
        assert median["n_nodes"] == len(quadratic(mesh.points, mesh.cells)[0])
        assert 0.75 < median["n_nodes"] / 400 < 1.25  # of a lattice there are few so coarse
        bottom, top = box_faces(image, mesh)
        for average in ("mean", "gauss"):
            young = element_young(refined(modulus, image.shape), mesh, None, average, 2)
            pressed = compression(
                mesh, young, 0.45, fixed_nodes=top, pushed_nodes=bottom, order=2,
                displacement=push_of(image, settings.percent),
            )  # fmt: skip
            errors = reference_errors(exact, mesh, pressed.u, pressed.strain_energy, labels)
            assert median["fem"]["0.45"]["averages"][average]["errors"] == pytest.approx(errors._asdict(), rel=1e-6)


def without_seconds(fem):
    return {
        nu: each | {"averages": {name: solved | {"seconds": 0} for name, solved in each["averages"].items()}}
        for nu, each in fem.items()
    }


@pytest.mark.full
def test_tradeoff(head, undrawn, tmp_path, monkeypatch):
    """The defaults' row is the pipeline's own mesh; more of the image costs shape; the picture is on the page."""
    few = [  # of two options the first value and the default, which is another one
        (name, defaults, {order: (some[0], defaults[order]) for order, some in values.items()}, arguments)
        for name, defaults, values, arguments in tradeoff.SWEPT_OPTIONS
        if name in ("k_D", "gradation")
    ]
    monkeypatch.setattr(tradeoff, "SWEPT_OPTIONS", few)
    monkeypatch.setattr(compare, "run_in_child", in_this_process)
    out = tmp_path / "out"
    words = [str(head / "image.nii.gz"), "-o", str(out), *SMALL, "--nodes", "150", "--curve", ""]
    assert main(["compare", *words, "--pipelines", "tetopt", "--tradeoff"]) == 0
    report = json.loads((out / "report.json").read_text())
    rows = report["tradeoff"]
    for order, results in ((1, report["pipelines"]), (2, report["quadratic"])):
        defaults = [row["measured"] for row in rows if row["is_default"] and row["order"] == order]
        assert len(defaults) == 2
        assert all(measured == defaults[0] for measured in defaults)
        own = results[0]["median"]
        assert {k: own[k] for k in ("E_D_fraction", "quality", "n_nodes")} == {
            k: defaults[0][k] for k in ("E_D_fraction", "quality", "n_nodes")
        }
        assert without_seconds(own["fem"]) == without_seconds(defaults[0]["fem"])
    by_k_D = [row["measured"] for row in rows if row["option"] == "k_D" and row["order"] == 1]
    assert by_k_D[0]["E_D_fraction"] > by_k_D[-1]["E_D_fraction"]
    assert by_k_D[0]["quality"]["mean_rho"] > by_k_D[-1]["quality"]["mean_rho"]
    assert np.asarray(PIL.Image.open(out / "tradeoff.png").convert("L")).std() > 20.0
    assert "Trade-offs of tetopt&#39;s options" in (out / "report.html").read_text()
    assert main(["compare", *words, "--pipelines", "bcc", "--force"]) == 0
    assert not (out / "tradeoff.png").exists()
    assert "Trade-offs" not in (out / "report.html").read_text()


@pytest.mark.deep
def test_resume_keeps_what_is_done(run, head, undrawn, tmp_path, capsys):
    """Finished runs of the same settings are kept; a run taken away, or other settings, are run again, in children."""
    out = Path(shutil.copytree(run, tmp_path / "out"))
    inputs = [str(head / "image.nii.gz"), "--labels", str(head / "labels.nii.gz")]
    again = ["compare", *inputs, "-o", str(out), *SMALL, "--pipelines", "tetopt,bcc", "--curve", "0.5", "--resume"]
    before = json.loads((out / "report.json").read_text())
    (out / "runs" / "bcc-400-1.json").unlink()
    capsys.readouterr()
    assert main(again) == 0
    assert capsys.readouterr().err.count("already finished") == 7
    after = json.loads((out / "report.json").read_text())
    assert [p["median"]["E_D"] for p in after["pipelines"]] == [p["median"]["E_D"] for p in before["pipelines"]]
    assert main([*again, "--k-d", "0.3", "--pipelines", "bcc", "--curve", ""]) == 0
    assert "already finished" not in capsys.readouterr().err
    assert main([word for word in again if word != "--resume"]) == 2
    assert "already exists" in capsys.readouterr().err
    kept = (out / "report.json").read_bytes()
    assert main(["compare", inputs[0], "-o", str(out), "--nodes", "99", "--resume"]) == 2
    assert "belongs to another comparison" in capsys.readouterr().err
    assert (out / "report.json").read_bytes() == kept


DAMAGES = {
    "empty": lambda text: "",
    "cut off": lambda text: text[: len(text) // 2],
    "deep": lambda text: "[" * 100_000,
    "null": lambda text: "null",
    "no run": lambda text: '{"content": {"run": 3}, "sha256": "ab"}',
    "edited": lambda text: text.replace('"n_nodes": ', '"n_nodes": 1', 1),  # a digit more: whole, and of the same mesh
    "other bytes": lambda text: text.encode("utf-16").decode("latin-1"),
    "digits": lambda text: text.replace('"order": 1', f'"order": {"9" * 5000}'),
}


@pytest.mark.full
def test_a_damaged_run_is_none(run, tmp_path):
    """It is run again, whatever its file holds; whole it is kept, but not with another mesh."""
    name, mesh_name = "bcc-400-1.json", "bcc-400-1.vtu"
    text = (run / "runs" / name).read_text()
    key = json.loads(text)["content"]["key"]
    (tmp_path / name).write_text(text)
    (tmp_path / mesh_name).write_bytes((run / "runs" / mesh_name).read_bytes())
    assert as_json(compare._kept(tmp_path / name, key)) == json.loads(text)["content"]
    assert compare._kept(tmp_path / name, "another") is None
    for damage in DAMAGES:
        (tmp_path / name).write_text(DAMAGES[damage](text))
        assert compare._kept(tmp_path / name, key) is None, damage
    (tmp_path / name).write_text(text)
    (tmp_path / mesh_name).write_bytes((run / "runs" / "bcc-200-1.vtu").read_bytes())
    assert compare._kept(tmp_path / name, key) is None
    (tmp_path / mesh_name).unlink()
    assert compare._kept(tmp_path / name, key) is None


OTHER_SETTINGS = {  # of each setting that numbers depend on another value
    "classes": 5, "k_D": 0.4, "iterations": 7, "nus": (0.3,), "percent": 2.0, "average": "hill", "reference_dofs": 7000,
}  # fmt: skip


def test_a_run_of_other_options_is_not_kept(head, tmp_path):
    """Every setting either changes what a finished run is known by, or is one that no run's numbers depend on."""
    image = tetopt.load_image(head / "image.nii.gz")
    mapping = tmp_path / "mapping.csv"
    mapping.write_text("intensity,young\n0,1\n100,10\n")

    def key(settings=Settings(nodes=400), image=image, crop=None, labels=None):  # noqa: B008
        source = ImageSource("image", "ab", None, crop)
        of_labels = labels and LabelSource("labels", "given", labels)
        comparison = compare.Comparison(
            image, None, parse_mapping(str(mapping)), settings, source, of_labels, str(mapping), ""
        )
        facts = compare._facts(comparison)
        return compare._key(compare.Bench(comparison, None, {}, tmp_path, True, facts), "bcc")

    assert set(Settings._fields) == set(OTHER_SETTINGS) | compare.FREE_SETTINGS
    first = key()
    assert key() == first
    keys = [key(Settings(nodes=400)._replace(**{name: value})) for name, value in OTHER_SETTINGS.items()]
    keys += [key(crop="0:5,:,:"), key(labels="cd"), key(labels="ef")]
    mapping.write_text("intensity,young\n0,1\n100,20\n")  # the same words, another mapping
    keys.append(key())
    assert len({first, *keys}) == len(keys) + 1
    program = Program("bcc", f"sh {mapping} {{image}} {{output}}")
    of_program = [
        key(Settings(400, programs=(program,))),
        key(Settings(400, programs=(program._replace(command="a"),))),
    ]
    mapping.write_text("intensity,young\n0,1\n100,30\n")
    of_program.append(key(Settings(400, programs=(program,))))
    assert len({key(), *of_program}) == 4


@pytest.mark.full
def test_when_all_fail_nothing_is_replaced(head, tmp_path, monkeypatch, capsys):
    """One line, exit 2, no report: without time for anything, and where no mesh can be measured."""
    words = [str(head / "image.nii.gz"), "-o", str(tmp_path / "out"), *SMALL, "--curve", "", "--pipelines", "bcc"]
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
@pytest.mark.parametrize(
    ("name", "kind"),
    [("", "folder link"), ("lock", "pipe"), ("reference.json", "device link"), ("bcc-400-1.json", "file link"),
     ("bcc-400-1.vtu", "folder"), ("thesis.txt", "file link")],
)  # fmt: skip
def test_what_lies_among_the_runs_and_is_not_tetopts_stays(head, tmp_path, capfd, name, kind):
    out, elsewhere = tmp_path / "out", outside(tmp_path)
    out.mkdir()
    create(out / "runs", compare.RUNS)
    planted(kind, out / "runs" / name, elsewhere)
    before = content(tmp_path)
    inputs = [head / "image.nii.gz", "--labels", head / "labels.nii.gz", "-o", out, *SMALL, "--pipelines", "bcc"]
    for option in ("--resume", "--force"):
        assert_refused(capfd, ["compare", *inputs, option], rf"{out / 'runs' / name}: [^\n]*; move it away")
    assert content(tmp_path) == before


@pytest.mark.deep
def test_pytetwild_in_the_comparison(head, undrawn, tmp_path):
    """The conventional pipeline beside one that never varies, repeated: node counts near the wish, the range."""
    pytest.importorskip("pytetwild", reason="the conventional pipeline needs pytetwild")
    words = [str(head / "image.nii.gz"), "-o", str(tmp_path), *SMALL, "--nodes", "250", "--curve", "", "--classes", "3"]
    assert main(["compare", *words, "--pipelines", "bcc,pytetwild"]) == 0
    lattice, theirs = json.loads((tmp_path / "report.json").read_text())["pipelines"]
    assert len(lattice["runs"]) == 1
    assert len(theirs["runs"]) == 2
    assert theirs["low"]["E_D"] <= theirs["median"]["E_D"] <= theirs["high"]["E_D"]
    assert abs(theirs["median"]["n_nodes"] / 250 - 1) < 0.2
    assert (tmp_path / "report.html").read_text(encoding="utf-8").count("pytetwild") > 3


@pytest.mark.full
def test_baseline(head, tmp_path, capsys):
    pytest.importorskip("pytetwild", reason="the conventional pipeline needs pytetwild")
    command = ["baseline", str(head / "image.nii.gz"), "-o", str(tmp_path / "b.vtu"), "--nodes", "150"]
    assert main([*command, "--classes", "3", "--json", str(tmp_path / "b.json")]) == 0
    numbers = json.loads((tmp_path / "b.json").read_text())
    mesh = tetopt.load_mesh(tmp_path / "b.vtu").mesh
    image = tetopt.load_image(head / "image.nii.gz")
    assert tetopt.check_mesh(mesh, image) == []
    assert numbers["fit"]["E_D"] == pytest.approx(tetopt.E_D(image, mesh), rel=1e-9)
    assert set(numbers["seconds"]) == {"surfaces", "tetrahedra", "search"}


@pytest.mark.deep
def test_a_peer_that_crashes(head, undrawn, tmp_path, monkeypatch, capsys):
    """At first: run again, and said in the terminal, in the files and on the page. Twice: it failed."""
    monkeypatch.setenv("PIPES_PID", str(tmp_path / "pid"))
    monkeypatch.setitem(PIPELINES, "tetopt", PIPELINES["tetopt"]._replace(function=pipes.fine))  # only beside them
    for name, pipe in (("pytetwild", pipes.crash_once), ("bcc", pipes.crash)):
        monkeypatch.setitem(PIPELINES, name, PIPELINES[name]._replace(function=pipe, is_random=False))
    crash, image = "crashed: signal 11, SIGSEGV", str(head / "image.nii.gz")
    out = tmp_path / "out"
    words = [image, "-o", str(out), *SMALL, "--curve", "", "--pipelines", "tetopt,pytetwild,bcc"]
    assert main(["compare", *words]) == 0
    said = capsys.readouterr()
    assert said.err.count(f"{crash}; running it again") == 3  # of the second also with quadratic cells
    title = "tetopt against pytetwild at 400 nodes"
    again = f"pytetwild: crashed once, and was run again ({crash})."
    report, page = json.loads((out / "report.json").read_text()), (out / "report.html").read_text(encoding="utf-8")
    assert report["headline"]["title"] == title
    assert again in report["headline"]["remarks"]
    for line in (title, again):
        assert line in said.out
        assert line in page
    _, once, twice = report["pipelines"]
    assert (once["crashes"], once["reason"], "median" in once) == ([crash], None, True)
    assert (twice["crashes"], twice["reason"], "median" in twice) == ([crash] * 2, "crash", False)


@pytest.mark.full
def test_a_missing_peer_is_no_failure_of_it(head, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(PIPELINES, "pytetwild", PIPELINES["pytetwild"]._replace(function=pipes.absent))
    assert main(["baseline", str(head / "image.nii.gz"), "-o", str(tmp_path / "b.vtu"), "--nodes", "150"]) == 2
    assert "tetopt: pytetwild: thing: not installed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--pipelines", "tetopt,gmsh"], "pipelines: expected some of"),
        (["--pipelines", ""], "pipelines: expected some of"),
        (["--pipelines", "bcc,bcc"], "each once"),
        (["--curve", "a"], "--curve: expected fractions"),
        (["--k-d", "1"], "--k-d"),
        (["--max-seconds", "0"], "--max-seconds"),
        (["--max-seconds", "nan"], "--max-seconds: expected more than 0"),
        (["--reference-seconds", "10"], "--reference-dofs already sets the size of the reference"),
        (["--young", "h-1000"], "--young: expected 0 kPa or more"),
        (["--average", "voigt"], "average: expected mean, geometric, harmonic, hill"),
    ],
)
def test_bad_input(head, tmp_path, options, words, capsys):
    assert main(["compare", str(head / "image.nii.gz"), "-o", str(tmp_path / "o"), *SMALL, *options]) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert words in err[-1]


@pytest.mark.full
def test_the_reference_is_chosen_once(head, tmp_path, monkeypatch):
    """By its time the size differs from run to run: what was chosen is written down, and kept by --resume."""
    image = tetopt.load_image(head / "image.nii.gz")
    settings = Settings(nodes=150, reference_seconds=5.0)
    comparison = compare.Comparison(
        image, None, [(0.0, 1.0), (100.0, 10.0)], settings, ImageSource("image", "ab", None, None), None, "mapping", ""
    )
    sizes = iter(Budget(dofs, dofs == 6000) for dofs in range(5000, 10000, 1000))
    monkeypatch.setattr(compare, "affordable_dofs", lambda *arguments: next(sizes))
    lines = []

    def chosen(comparison=comparison, resume=True, **changes):
        settings = comparison.settings._replace(**changes)
        facts = compare._facts(comparison)
        with listened(lambda event: lines.append(event.text)):
            once = compare._settled(comparison._replace(settings=settings), facts, tmp_path, resume=resume)
        return once.settings.reference_dofs

    assert chosen(reference_dofs=4000) == 4000
    assert not (tmp_path / "reference.json").exists()
    assert [chosen(), chosen()] == [5000, 5000]
    assert chosen(resume=False) == 6000
    assert chosen() == 6000
    assert chosen(reference_seconds=9.0) == 7000
    assert len(lines) == 3
    assert "in 5 s; `reference_dofs` 5000" in lines[0]
    assert "in the free memory; `reference_dofs` 6000" in lines[1]
    # Of another part of the image, and with other moduli, the grid that fits is another.
    assert chosen(comparison._replace(image_source=ImageSource("image", "ab", None, "0:5,:,:"))) == 8000
    assert chosen(comparison._replace(mapping=[(0.0, 1.0), (100.0, 20.0)])) == 9000
    (tmp_path / "reference.json").write_text("{")
    with pytest.raises(StopIteration):
        chosen()


def test_elementwise():
    rows = [{"a": 1, "b": [1.0, 4.0], "c": "x", "d": None}, {"a": 2, "b": [3.0, 4.0], "c": "y", "d": None}]
    assert compare.elementwise(rows, np.median) == {"a": 1.5, "b": [2.0, 4.0], "c": "x", "d": None}
    assert compare.elementwise(rows, np.max)["a"] == 2
