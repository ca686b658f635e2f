"""The comparison's page: its numbers are the report's, failures are named, names are harmless."""

import html
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import browser, copied, document
from markupsafe import escape

import tetopt
from tetopt.cli import console
from tetopt.cli.compare import compare_command
from tetopt.fem.reference import Errors, OwnError
from tetopt.io.text import plain
from tetopt.measure.fidelity import LabelFidelity
from tetopt.measure.quality import Quality, QualityErrors
from tetopt.report.figures import save_figure
from tetopt.study import compare_files
from tetopt.study import compare_report as records
from tetopt.study.compare_figures import (
    histograms_figure,
    labels_figure,
    slices_figure,
    timing_figure,
)
from tetopt.study.compare_page import save_compare_page
from tetopt.study.compare_report import as_json
from tetopt.study.compare_table import columns_of, number_text, rows_of
from tetopt.study.options import CompareOptions
from tetopt.study.pipelines import PIPELINES


def fake_run(seed, scale, order=1, has_labels=False):
    """A run of plausible numbers; errors go with `scale`, and are half as large with quadratic
    cells.
    """
    random = np.random.default_rng(seed)

    def some(low, high):
        return float(random.uniform(low, high))

    rho, angles = random.dirichlet(np.arange(1, 21)), random.dirichlet(np.bincount(range(36)) + 3)
    quality = Quality(
        ndim=3,
        n_nodes=5000 + seed,
        n_cells=27000 + 5 * seed,
        volume=1e6,
        smallest_volume=0.1,
        mean_rho=some(0.2, 0.3),
        p1_rho=some(0.05, 0.2),
        min_rho=some(0.001, 0.1),
        errors=QualityErrors(*(some(0.1, 3.0) for _ in range(4))),
        min_dihedral=some(1.0, 30.0),
        p1_dihedral=some(10.0, 40.0),
        max_dihedral=some(110.0, 178.0),
        n_under_10_degrees=int(random.integers(0, 50)),
        kinds={"needle": 0, "wedge": 1, "cap": 0, "spade": 2, "sliver": int(random.integers(0, 9))},
        min_edge=0.5,
        max_edge=20.0,
    )
    fem = {nu: simulation_of(random, scale / order) for nu in ("0.3", "0.45")}
    seconds = {"lattice": some(0.1, 1.0), "optimise": some(1.0, 20.0)}
    measurement = records.Measurement(
        order=order,
        n_nodes=5000 + seed,
        n_corners=(5000 + seed) // (1, 7)[order - 1],
        n_cells=27000 + 5 * seed,
        E_D=1e9 * scale,
        E_D_fraction=0.04 * scale,
        n_missed_voxels=0,
        n_empty_cells=0,
        quality=quality,
        rho_histogram=records.Histogram(np.linspace(0, 1 / 3, 21).tolist(), rho.tolist()),
        dihedral_histogram=records.Histogram(list(range(0, 181, 5)), angles.tolist()),
        labels=[label_of(random, k) for k in range(4)],
        own_labels=[label_of(random, k) for k in range(4)] if has_labels else [],
        fem=fem,
    )
    return records.PipelineRun(
        {"kernels": 3.0, **seconds}, sum(seconds.values()), int(9e8 * scale), measurement
    )


def label_of(random, k):
    """Fidelity to label `k`, of 9000, 2250, 562 and 140 voxels; the last is lost."""
    voxels, is_lost = 9000 // 4**k, k == 3
    fields = dict.fromkeys(LabelFidelity._fields, None) | {
        "label": k,
        "voxels": voxels,
        "volume": 8.0 * voxels,
        "dice": 0.0 if is_lost else random.uniform(0.7, 0.98),
        "mesh_volume": 0.0 if is_lost else 8.0 * voxels * random.uniform(0.8, 1.1),
        "is_lost": is_lost,
        "distance_mean": math.nan if is_lost else random.uniform(0.4, 2.0),
    }
    return LabelFidelity(**fields)


def simulation_of(random, scale):
    eigenvalues = random.uniform(1e2, 1e3), random.uniform(1e3, 1e5), int(random.integers(80, 300))
    return records.Simulation(*eigenvalues, random.uniform(1.0, 2.0), errors_of(scale), 0.5 / scale)


def errors_of(scale):
    return Errors(0.03 * scale, 0.1 * scale, 0.2 * scale)


def with_runs(pipeline, runs):
    """The pipeline with other runs."""
    return pipeline._replace(runs=runs, median=runs[(len(runs) - 1) // 2] if runs else None)


def with_measured(report, number, **values):
    """Change what all runs of the pipeline at this place measured, with cells of both orders."""
    for pipelines in (report.pipelines, report.quadratic):
        pipeline = pipelines[number]
        runs = [
            run._replace(measurement=run.measurement._replace(**values)) for run in pipeline.runs
        ]
        pipelines[number] = with_runs(pipeline, runs)


def finished(report):
    return [pipeline for pipeline in report.pipelines if pipeline.median is not None]


def fake_report():
    """Five pipelines: the first has labels of its own, the second three runs, the third failed."""
    results = {1: [], 2: []}
    for number, name in enumerate(("tetopt", "pytetwild", "mine", "bcc", "tetopt-paper")):
        title, kind = (
            (PIPELINES[name].title, PIPELINES[name].kind) if name in PIPELINES else (name, "peer")
        )
        n_runs = (1, 3, 0, 1, 1)[number]
        for order, pipelines in results.items():
            runs = [
                fake_run(10 * number + k, 1.0 + 0.3 * number, order, number == 0)
                for k in range(n_runs)
            ]
            failure = (
                None if runs else "twice crashed: signal 11, SIGSEGV; try another number of classes"
            )
            about, notes = f"{title}, its options", [f"a note on {title}"]
            result = records.PipelineResult(name, title, kind, about, failure, notes, runs, None)
            pipelines.append(with_runs(result, runs))
    source = records.ImageSource("T1.nii.gz", "ab" * 32, None, None)
    return records.Report(
        command="tetopt compare T1.nii.gz -o out --nodes 5000",
        image=records.ImageFacts(source, (197, 233, 189), [1, 1, 1], 2841.2),
        labels=records.LabelSource("labels.nii.gz", "cd" * 32),
        mapping="1 kPa at 0, 10 kPa at 255",
        versions={"tetopt": "0.1.0", "numpy": "2.0"},
        machine={"cores": 2, "system": "Linux"},
        options=records.Settings(5000),
        reference=records.ReferenceGrid(
            (49, 58, 47),
            435000,
            "averaged",
            {"0.3": records.ReferenceEnergy(1.234, OwnError(0.01, 0.02), 17)},
        ),
        date="2026-11-22",
        pipelines=results[1],
        quadratic=results[2],
        seconds=812.0,
    )


def meshes_of(image, nodes, iterations):
    """A lattice and an optimised mesh of the image."""
    lattice = tetopt.lattice_mesh(image, nodes=nodes)
    mesh = tetopt.optimize(image, lattice, k_D=0.3, iterations=iterations).mesh
    return [("tetopt", mesh), ("BCC lattice", lattice)]


class Tables(HTMLParser):
    """Rows of every table: the texts of each cell."""

    def __init__(self, page):
        super().__init__()
        self.tables, self.cell = [], None
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.cell = []
            self.tables[-1][-1].append(self.cell)

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self.cell = None

    def handle_data(self, data):
        if self.cell is not None:
            self.cell.append(data.strip())


def page_of(tmp_path, report, pictures=()):
    save_compare_page(tmp_path / "report.html", report, pictures)
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def numbers_of(page, report):
    """The page's first table: of each mesh, by its title, the texts of each cell by group and
    title of the column.
    """
    groups, titles, *rows = Tables(page).tables[0]
    columns = columns_of(report)
    assert [texts[0] for texts in titles[1:]] == [column.heading for column in columns]
    assert [texts[0] for texts in groups[1:]] == list(
        dict.fromkeys(column.group for column in columns)
    )
    keys = [(column.group, column.title) for column in columns]
    return {
        row[0][0]: dict(zip(keys, row[1:], strict=True)) if len(row) > 2 else row[1] for row in rows
    }


# --------------------------------------------------------------------------------------------------
# Numbers


def judged(rows):
    """The labels that count: above 500 voxels, and not the background."""
    return rows[1:3]


# What a column shows, computed here once more from a run as report.json has it.
VALUES = {
    ("Fidelity", "E_D, of the variance"): lambda run: run["E_D_fraction"],
    ("Fidelity", "voxels outside"): lambda run: run["n_missed_voxels"],
    ("Shape", "mean rho"): lambda run: run["quality"]["mean_rho"],
    ("Shape", "p1 rho"): lambda run: run["quality"]["p1_rho"],
    ("Shape", "smallest angle, °"): lambda run: run["quality"]["min_dihedral"],
    ("Shape", "bad cells, %"): lambda run: (
        100.0 * sum(run["quality"]["kinds"].values()) / run["quality"]["n_cells"]
    ),
    **{
        (group, title): lambda run, key=key, value=value: (
            value(judged(run[key])) if run[key] else None
        )
        for group, key in (
            ("Labels of most voxels", "labels"),
            ("Labels of the mesh itself", "own_labels"),
        )
        for title, value in (
            ("mean Dice", lambda rows: np.mean([row["dice"] for row in rows])),
            ("smallest Dice", lambda rows: min(row["dice"] for row in rows)),
            ("surface distance, mm", lambda rows: np.mean([row["distance_mean"] for row in rows])),
            (
                "largest volume error, %",
                lambda rows: max(100 * abs(row["mesh_volume"] / row["volume"] - 1) for row in rows),
            ),
            ("labels lost", lambda rows: 1),
        )
    },
    **{
        (f"Error of the compression, ν = {nu}", title): lambda run, nu=nu, name=name: run["fem"][
            nu
        ]["errors"][name]
        for nu in ("0.3", "0.45")
        for title, name in (
            ("energy", "strain_energy"),
            ("displacement", "displacement"),
            ("interface strain", "interface_strain"),
        )
    },
    ("Cost", "seconds"): lambda run: run["seconds_total"],
    ("Cost", "MB"): lambda run: run["peak_bytes"] / 1e6,
    ("Cost", "nodes"): lambda run: run["n_nodes"],
    ("Cost", "cells"): lambda run: run["n_cells"],
}


def close(text, value):
    """Whether the printed number is the value, to four digits."""
    return text == "–" if value is None else abs(float(text) - value) <= 5.1e-4 * abs(value)


def test_every_number_is_the_reports(tmp_path):
    """A row for each mesh, of linear and then of quadratic cells: the median run's numbers, and
    the range of all.
    """
    report = fake_report()
    meshes = numbers_of(page_of(tmp_path, report), report)
    titles = [each.title for each in report.pipelines]
    assert list(meshes) == [*titles, *(f"{title}, quadratic" for title in titles)]
    for shown, pipeline in zip(
        meshes.values(), [*report.pipelines, *report.quadratic], strict=True
    ):
        if pipeline.median is None:
            assert shown == [pipeline.failure]
            continue
        assert set(shown) == set(VALUES)
        for key, value in VALUES.items():
            text, *ends = shown[key]
            assert close(text, value(as_json(pipeline.median))), key
            each = [number_text(value(as_json(run))) for run in pipeline.runs]
            if len(set(each)) > 1:
                (ends,) = (end.split(" to ") for end in ends)
                assert set(ends) <= set(each)
                assert float(ends[0]) == min(map(float, each))
                assert float(ends[1]) == max(map(float, each))
            else:
                assert ends == []


def test_a_lost_label_is_not_averaged_away(tmp_path):
    """Its surface has no distance: the mean over the other labels would make losing it pay."""
    report = fake_report()
    labels = report.pipelines[0].runs[0].measurement.labels
    labels[2] = labels[2]._replace(is_lost=True, dice=0.0, distance_mean=math.nan, mesh_volume=0.0)
    shown = numbers_of(page_of(tmp_path, report), report)["tetopt"]
    assert shown["Labels of most voxels", "surface distance, mm"] == ["–"]
    assert shown["Labels of most voxels", "smallest Dice"] == ["0"]
    assert shown["Labels of most voxels", "largest volume error, %"] == ["100"]
    assert shown["Labels of most voxels", "labels lost"] == ["2"]


def test_labels_of_any_size_count_where_none_is_large(tmp_path):
    """And of classes of intensities also the first, which is no background."""
    report = fake_report()
    rows = [
        LabelFidelity(*[None] * 22)._replace(
            label=k, voxels=9, volume=9.0, mesh_volume=9.0, is_lost=False
        )
        for k in range(2)
    ]
    for number in range(5):
        fidelity = [
            row._replace(dice=dice, distance_mean=1.0)
            for row, dice in zip(rows, (0.4, 0.6), strict=True)
        ]
        with_measured(report, number, labels=fidelity, own_labels=[])
    key = ("Labels of most voxels", "mean Dice")
    assert numbers_of(page_of(tmp_path, report), report)["tetopt"][key] == ["0.6"]
    report = report._replace(labels=None)
    assert numbers_of(page_of(tmp_path, report), report)["tetopt"][key] == ["0.5"]


def test_columns_without_numbers_are_left_out(tmp_path):
    report = fake_report()._replace(labels=None)
    for number in range(5):
        with_measured(report, number, labels=[], own_labels=[], fem={}, E_D_fraction=None)
    shown = numbers_of(page_of(tmp_path, report), report)["tetopt"]
    assert {group for group, _ in shown} == {"Fidelity", "Shape", "Cost"}
    assert ("Fidelity", "E_D, of the variance") not in shown


def test_the_terminal_has_a_column_of_each_kind():
    report = fake_report()
    columns = [column for column in columns_of(report) if column.is_short]
    assert [column.group for column in columns] == [
        "Fidelity",
        "Shape",
        "Shape",
        "Labels of most voxels",
        "Error of the compression, ν = 0.3",
        "Cost",
        "Cost",
    ]
    assert [len(row.cells) for row in rows_of(report, columns)] == [7, 7, 0, 7, 7] * 2
    arrows = {column.title: column.heading[len(column.title) :] for column in columns_of(report)}
    assert {title for title, arrow in arrows.items() if not arrow} == {"nodes", "cells"}
    assert (arrows["mean rho"], arrows["mean Dice"]) == (" ↑", " ↑")
    assert (arrows["seconds"], arrows["displacement"]) == (" ↓", " ↓")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (math.nan, "–"),
        (0.0, "0"),
        (5012.0, "5012"),
        (0.0421234, "0.04212"),
        (123456.7, "123457"),
        (3.2e12, "3.2e+12"),
    ],
)
def test_number_text(value, text):
    assert number_text(value) == text


def test_failures_are_named(tmp_path):
    """In place of numbers, also of quadratic cells alone; a failed repeat beside them; what is
    not compressed.
    """
    report = fake_report()
    report.quadratic[1] = with_runs(report.quadratic[1]._replace(failure="timed out"), [])
    report.pipelines[1] = report.pipelines[1]._replace(failure="out of time: killed after 4 s")
    with_measured(report, 3, fem={}, not_compressed="the mesh does not fill the box")
    page = page_of(tmp_path, report)
    meshes = numbers_of(page, report)
    assert meshes["pytetwild, quadratic"] == ["timed out"]
    assert close(meshes["pytetwild"]["Cost", "nodes"][0], 5011)
    assert "<li>pytetwild: a run failed: out of time: killed after 4 s</li>" in page
    assert "<li>BCC lattice: not compressed: the mesh does not fill the box</li>" in page
    assert "<li>BCC lattice, quadratic: not compressed: the mesh does not fill the box</li>" in page
    assert meshes["BCC lattice"]["Error of the compression, ν = 0.3", "energy"] == ["–"]


# --------------------------------------------------------------------------------------------------
# The page as a file


def with_names(report, evil):
    return report._replace(
        command=evil,
        mapping=evil,
        labels=report.labels._replace(name=evil, names={1: evil, 3: evil}),
        options=report.options._replace(k_D=evil),
        image=report.image._replace(source=report.image.source._replace(name=evil)),
        pipelines=[
            p._replace(title=evil, about=evil, notes=[evil], failure=evil) for p in report.pipelines
        ],
    )


@pytest.mark.deep
def test_hostile_names_run_nothing_in_a_browser(tmp_path):
    ran = "document.documentElement.dataset.xss=1"
    evil = f"\"><img src=x onerror='{ran}'><script>{ran}</script>\u202e\x1b\udcff</title>"
    text = page_of(tmp_path, with_names(fake_report(), evil))
    shown = document(copied(text, tmp_path / "copy.html"))  # whose policy lets all scripts run
    assert "data-xss" not in shown
    assert html.unescape(shown).count(plain(evil)) > 10


def test_settings_are_shown(tmp_path):
    report = fake_report()
    page = page_of(tmp_path, report)
    words = [
        report.command,
        "a note on tetopt",
        "197 × 233 × 189",
        "ab" * 32,
        report.mapping,
        "0.1.0",
        "435000",
    ]
    for word in [*words, *(p.about for p in report.pipelines)]:
        assert escape(word) in page


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A page with pictures of real meshes."""
    folder = tmp_path_factory.mktemp("compare")
    image = tetopt.load_phantom("two_spheres").image(voxel_mm=2.0)
    meshes = meshes_of(image, nodes=800, iterations=5)
    means = [tetopt.cell_moments(image, mesh).mean for _, mesh in meshes]
    report = fake_report()
    figures = {
        "slices": slices_figure(image, meshes, means),
        "quadratic": slices_figure(image, meshes, means),
        "labels": labels_figure(report),
        "histograms": histograms_figure(report),
        "timing": timing_figure(report),
    }
    for name, figure in figures.items():
        save_figure(figure, folder / f"{name}.png", dpi=80)
    save_compare_page(
        folder / "report.html", report, [(folder / f"{name}.png", name) for name in figures]
    )
    return folder / "report.html"


@pytest.mark.full
def test_nothing_points_outside(whole):
    page = whole.read_text(encoding="utf-8")
    assert not re.search(
        r"(src|href|url)\s*[=(]\s*[\"']?(?!data:)[a-z./]+", re.sub(r"base64,[^\"]*", "", page)
    )
    assert "http:" not in page
    assert "https:" not in page
    order = [
        page.index(f'alt="{name}"')
        for name in ("slices", "quadratic", "labels", "histograms", "timing")
    ]
    assert order == sorted(order)


@pytest.mark.deep
@pytest.mark.parametrize("width", [1280, 500])  # Chromium has no narrower window
def test_the_page_in_a_browser(whole, tmp_path, width):
    """Pictures load, a clicked one is enlarged, the page never scrolls sideways, and is short on
    a wide screen.
    """
    probe = (
        "<script>addEventListener('load', () => setTimeout(() => { const d = "
        "document.documentElement; "
        "d.dataset.images = [...document.images].map((i) => i.naturalWidth).join(); "
        "d.dataset.over = d.scrollWidth - d.clientWidth; d.dataset.height = d.scrollHeight; "
        "const last = document.images[4], widths = [last.clientWidth]; last.parentNode.focus(); "
        "d.dataset.widths = [...widths, last.clientWidth].join(); }, 2000))</script>"
    )
    copy = copied(whole.read_text(encoding="utf-8"), tmp_path / "copy.html", last=probe)
    head = document(copy, f"--window-size={width},900")[:400]
    data = dict(re.findall(r'data-(images|over|height|widths)="([^"]*)"', head))
    assert len(data["images"].split(",")) == 5
    assert min(map(int, data["images"].split(","))) > 100, data
    assert int(data["over"]) <= 0
    before, after = map(int, data["widths"].split(","))
    if width > 1000:
        assert int(data["height"]) <= 5000
        assert after > 1.2 * before
    else:
        assert after == before


def test_nothing_is_folded(tmp_path):
    """Whatever tetopt is behind in is in sight: a row for each mesh, the controls' as well, and
    no part that opens.
    """
    report = fake_report()
    page = page_of(tmp_path, report)
    assert not re.search(r"<details|hidden", page)
    assert {"BCC lattice", "BCC lattice, quadratic"} <= numbers_of(page, report).keys()


@pytest.mark.deep
def test_it_can_be_printed(whole, tmp_path):
    browser(tmp_path / "profile", f"--print-to-pdf={tmp_path / 'a.pdf'}", whole.as_uri())
    assert (tmp_path / "a.pdf").read_bytes()[:5] == b"%PDF-"


def test_the_table_in_the_terminal_fits_into_80_columns(tmp_path, monkeypatch, capsys, wide_lines):
    """Headings are broken between words, and no word or number is cut."""
    report = fake_report()
    monkeypatch.setattr(compare_files, "compare_image", lambda *_, **__: report)
    monkeypatch.setattr(console, "LINE_WIDTH", 80)
    assert (
        compare_command(
            SimpleNamespace(obj=["compare"]), Path("T1.nii.gz"), tmp_path, CompareOptions()
        )
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    table = lines[: next(k for k, line in enumerate(lines) if line.startswith("mine: twice"))]
    assert max(map(len, table)) <= 80
    text = "\n".join(table)
    assert "…" not in text
    assert "\\" not in text
    columns = [column for column in columns_of(report) if column.is_short]
    heads = text[: text.index("tetopt")].split()
    assert sorted(heads) == sorted(word for column in columns for word in column.heading.split())
    numbers = [text for row in rows_of(report, columns) for text, _ in row.cells]
    assert all(number in text.split() for number in numbers)
