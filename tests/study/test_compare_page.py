"""The comparison's page: its numbers are the report's, failures are named, names are harmless."""

import html
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import browser, copied, document
from label_rows import label_row, with_numbers
from markupsafe import escape

import tetopt
from tetopt.cli import console
from tetopt.cli.compare import compare_command
from tetopt.fem.reference import Errors, OwnError
from tetopt.io.text import plain
from tetopt.measure.quality import Quality
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
from tetopt.study.compare_table import columns_of, number_text, rows_of
from tetopt.study.options import CompareOptions
from tetopt.study.pipelines import PIPELINES
from tetopt.system.files import as_json


def filled(random, record, **given):
    """A record of random numbers, but for what is given."""
    return record(**{name: random.uniform() for name in record._fields} | given)


def fake_run(seed, order, has_labels):
    """A run of numbers, all different, and labels of 9000, 2250, 562 and 140 voxels, the last of
    which is lost.
    """
    random = np.random.default_rng(seed)
    sizes = {"n_nodes": 5000 + seed, "n_cells": 27000 + 5 * seed}
    kinds = dict(
        zip(("needle", "wedge", "sliver"), random.integers(1, 50, 3).tolist(), strict=True)
    )
    labels, own_labels = ([label_of(random, k, 9000 // 4**k) for k in range(4)] for _ in range(2))
    labels[3], own_labels[3] = map(lost, (labels[3], own_labels[3]))
    measurement = filled(
        random,
        records.Measurement,
        order=order,
        **sizes,
        quality=filled(random, Quality, ndim=3, errors=[], kinds=kinds, **sizes),
        rho_histogram=histogram(random, np.linspace(0, 1 / 3, 21)),
        dihedral_histogram=histogram(random, np.arange(0, 181, 5)),
        labels=labels,
        own_labels=own_labels if has_labels else [],
        fem={
            nu: filled(random, records.Simulation, errors=filled(random, Errors))
            for nu in ("0.3", "0.45")
        },
        not_compressed=None,
    )
    seconds = {"kernels": 3.0, "lattice": random.uniform(), "optimise": 9.0 + random.uniform()}
    return filled(random, records.PipelineRun, seconds=seconds, measurement=measurement)


def histogram(random, edges):
    return records.Histogram(edges.tolist(), random.dirichlet(np.ones(len(edges) - 1)).tolist())


def label_of(random, label, voxels, **given):
    sizes = {"voxels": voxels, "volume": 8.0 * voxels, "mesh_volume": 7.5 * voxels}
    numbers = {"dice": random.uniform(), "distance_mean": random.uniform()}
    return label_row(label, **numbers | sizes | given)


def lost(row):
    return with_numbers(row, is_lost=True, dice=0.0, distance_mean=math.nan, mesh_volume=0.0)


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
    return [pipeline for pipeline in report.pipelines if pipeline.runs]


def fake_report():
    """Five pipelines: the first has labels of its own, the second three runs, the third failed."""
    results = {1: [], 2: []}
    n_runs = {"tetopt": 1, "pytetwild": 3, "mine": 0, "bcc": 1, "tetopt-paper": 1}
    for number, (name, n) in enumerate(n_runs.items()):
        title, kind = PIPELINES[name][:2] if name in PIPELINES else (name, "peer")
        for order, pipelines in results.items():
            runs = [fake_run(10 * number + k, order, number == 0) for k in range(n)]
            failure = None if runs else "twice crashed: signal 11, SIGSEGV; try another number"
            about, notes = f"{title}, its options", [f"a note on {title}"]
            result = records.PipelineResult(name, title, kind, about, failure, notes, runs, None)
            pipelines.append(with_runs(result, runs))
    source = records.ImageSource("T1.nii.gz", "ab" * 32, None, None)
    energy = records.ReferenceEnergy(1.234, OwnError(0.01, 0.02), 17)
    return records.Report(
        command="tetopt compare T1.nii.gz -o out --nodes 5000",
        image=records.ImageFacts(source, (197, 233, 189), [1, 1, 1], 2841.2),
        labels=records.LabelSource("labels.nii.gz", "cd" * 32),
        mapping="1 kPa at 0, 10 kPa at 255",
        versions={"tetopt": "0.1.0", "numpy": "2.0"},
        machine={"cores": 2, "system": "Linux"},
        options=records.Settings(5000),
        reference=records.ReferenceGrid((49, 58, 47), 435000, "averaged", {"0.3": energy}),
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


def page_of(tmp_path, report, pictures=()):
    save_compare_page(tmp_path / "report.html", report, pictures)
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def texts_of(page, tag):
    """Of each element of a table's row, or of its cells, what is in it."""
    return re.findall(rf"<{tag}[ >].*?</{tag}>", page, re.DOTALL)


def numbers_of(page, report):
    """The page's first tables, one or two: of each mesh, by its title, the texts of each cell by
    group and title of the column.
    """
    columns = columns_of(report)
    groups, titles, rows = [], [], {}
    for table in texts_of(page, "table"):
        if len(titles) == len(columns):
            break
        above, heads, *lines = (
            [
                [
                    html.unescape(text).strip()
                    for text in re.findall(r">([^<]+)", cell)
                    if text.strip()
                ]
                for cell in texts_of(row, "t[hd]")
            ]
            for row in texts_of(table, "tr")
        )
        assert len(heads) <= 17
        groups, titles = groups + above[1:], titles + heads[1:]
        for title, *cells in lines:
            known = rows.setdefault(title[0], [title])
            known += [] if len(cells) == 1 and len(known) > 1 else cells
    rows = rows.values()
    assert [texts[0] for texts in titles] == [column.heading for column in columns]
    assert [texts[0] for texts in groups] == [*dict.fromkeys(each.group for each in columns)]
    keys = [(column.group, column.title) for column in columns]
    return {
        title: dict(zip(keys, cells, strict=True)) if len(cells) > 1 else cells[0]
        for (title, *_), *cells in rows
    }


# --------------------------------------------------------------------------------------------------
# Numbers


OF_LABELS = (
    "mean Dice",
    "smallest Dice",
    "surface distance, mm",
    "largest volume error, %",
    "labels lost",
)


def values_of(run):
    """What the columns show, computed here once more from a run as report.json has it."""
    quality = run["quality"]
    bad = 100.0 * sum(quality["kinds"].values()) / quality["n_cells"]
    values = {
        ("Fidelity", "E_D, of the variance"): run["E_D_fraction"],
        ("Fidelity", "voxels outside"): run["n_missed_voxels"],
        ("Shape", "mean rho"): quality["mean_rho"],
        ("Shape", "p1 rho"): quality["p1_rho"],
        ("Shape", "smallest angle, °"): quality["min_dihedral"],
        ("Shape", "bad cells, %"): bad,
        ("Cost", "seconds"): run["seconds_total"],
        ("Cost", "MB"): run["peak_bytes"] / 1e6,
        ("Cost", "nodes"): run["n_nodes"],
        ("Cost", "cells"): run["n_cells"],
    }
    for nu, solved in run["fem"].items():
        for title in ("energy", "displacement", "interface strain"):
            name = {"energy": "strain_energy"}.get(title, title.replace(" ", "_"))
            values[f"Error of the compression, ν = {nu}", title] = solved["errors"][name]
    for group, name in (
        ("Labels of most voxels", "labels"),
        ("Labels of the mesh itself", "own_labels"),
    ):
        rows = run[name][1:3]  # those that count: above 500 voxels, and not the background
        of_rows = [None] * 5
        if rows:
            dice, distance = ([row[key] for row in rows] for key in ("dice", "distance_mean"))
            off = max(100.0 * abs(row["mesh_volume"] / row["volume"] - 1.0) for row in rows)
            of_rows = [np.mean(dice), min(dice), np.mean(distance), off, 1]
        values |= {(group, title): value for title, value in zip(OF_LABELS, of_rows, strict=True)}
    return values


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
        expected, *runs = (values_of(as_json(run)) for run in (pipeline.median, *pipeline.runs))
        assert set(shown) == set(expected)
        for key, (text, *ends) in shown.items():
            assert close(text, expected[key]), key
            known = sorted({number_text(run[key]) for run in runs} - {"–"}, key=float)
            assert ends == ([f"{known[0]} to {known[-1]}"] if len(known) > 1 else [])


def test_a_lost_label_is_not_averaged_away(tmp_path):
    """Its surface has no distance: the mean over the other labels would make losing it pay."""
    report = fake_report()
    labels = report.pipelines[0].runs[0].measurement.labels
    labels[2] = lost(labels[2])
    shown = numbers_of(page_of(tmp_path, report), report)["tetopt"]
    of_labels = [shown["Labels of most voxels", title] for title in OF_LABELS[1:]]
    assert of_labels == [["0"], ["–"], ["100"], ["2"]]


def test_labels_of_any_size_count_where_none_is_large(tmp_path):
    """And of classes of intensities also the first, which is no background."""
    report = fake_report()
    rows = [label_of(np.random.default_rng(k), k, 9, dice=0.4 + 0.2 * k) for k in range(2)]
    for number in range(5):
        with_measured(report, number, labels=rows, own_labels=[])
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


def test_arrows_point_to_better_values():
    arrows = {
        column.title: column.heading[len(column.title) :] for column in columns_of(fake_report())
    }
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
    words = [report.command, "a note on tetopt", "197 × 233 × 189", "ab" * 32, report.mapping]
    for word in [*words, "0.1.0", "435000", *(p.about for p in report.pipelines)]:
        assert escape(word) in page
    assert not re.search(r"<details|hidden", page)  # whatever tetopt is behind in is in sight


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A page with pictures of real meshes, and their names."""
    folder = tmp_path_factory.mktemp("compare")
    image = tetopt.load_phantom("two_spheres").image(voxel_mm=2.0)
    meshes = meshes_of(image, nodes=800, iterations=5)
    means = [tetopt.cell_moments(image, mesh).mean for _, mesh in meshes]
    report = fake_report()
    slices = slices_figure(image, meshes, means)
    figures = {"slices": slices, "quadratic": slices} | {
        each.__name__: each(report) for each in (labels_figure, histograms_figure, timing_figure)
    }
    pictures = [(folder / f"{name}.png", name) for name in figures]
    for (path, _), figure in zip(pictures, figures.values(), strict=True):
        save_figure(figure, path, dpi=80)
    page_of(folder, report, pictures)
    return folder / "report.html", list(figures)


@pytest.mark.full
@pytest.mark.drawn
def test_nothing_points_outside(whole):
    page = whole[0].read_text(encoding="utf-8")
    assert not re.search(
        r"(src|href|url)\s*[=(]\s*[\"']?(?!data:)[a-z./]+", re.sub(r"base64,[^\"]*", "", page)
    )
    assert not re.search("https?:", page)
    assert re.findall(r'alt="([^"]*)"', page) == whole[1]


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
    copy = copied(whole[0].read_text(encoding="utf-8"), tmp_path / "copy.html", last=probe)
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


@pytest.mark.deep
def test_it_can_be_printed(whole, tmp_path):
    browser(tmp_path / "profile", f"--print-to-pdf={tmp_path / 'a.pdf'}", whole[0].as_uri())
    assert (tmp_path / "a.pdf").read_bytes()[:5] == b"%PDF-"


def test_the_table_in_the_terminal_fits_into_80_columns(tmp_path, monkeypatch, capsys, wide_lines):
    """Headings are broken between words, and no word or number is cut."""
    report = fake_report()
    monkeypatch.setattr(compare_files, "compare_image", lambda *_, **__: report)
    monkeypatch.setattr(console, "LINE_WIDTH", 80)
    called = SimpleNamespace(obj=["compare"])
    assert compare_command(called, Path("T1.nii.gz"), tmp_path, CompareOptions()) == 0
    lines = capsys.readouterr().out.splitlines()
    table = lines[: next(k for k, line in enumerate(lines) if line.startswith("* E_D"))]
    assert max(map(len, table)) <= 80
    text = "\n".join(table)
    assert "…" not in text
    assert "\\" not in text
    columns = [column for column in columns_of(report) if column.is_short]
    assert len(columns) == 7  # of each group one or two
    heads = text[: text.index("tetopt")].split()
    assert sorted(heads) == sorted(word for column in columns for word in column.heading.split())
    numbers = [text for row in rows_of(report, columns) for text, _ in row.cells]
    assert all({number, f"{number}*"} & set(text.split()) for number in numbers)


@pytest.mark.parametrize(("times", "n_blank"), [(1.0, 0), (1.0 + 1e-9, 1)])
def test_the_printed_table_ranks_nothing_below_the_reference_s_own_error(
    tmp_path, monkeypatch, capsys, wide_lines, times, n_blank
):
    """And marks the E_D of peers that did not see the image."""
    report = fake_report()
    nu, of_nu = next(iter(report.reference.by_nu.items()))
    shown = [each.median for _, each in report.meshes() if each.median is not None]
    error = min(run.measurement.fem[nu].errors.displacement for run in shown)
    of_nu = of_nu._replace(own_error=OwnError(0.01, times * error))
    by_nu = report.reference.by_nu | {nu: of_nu}
    report = report._replace(reference=report.reference._replace(by_nu=by_nu))
    monkeypatch.setattr(compare_files, "compare_image", lambda *_, **__: report)
    called = SimpleNamespace(obj=["compare"])
    compare_command(called, Path("T1.nii.gz"), tmp_path, CompareOptions())
    said = capsys.readouterr().out
    assert (number_text(error) in said.split()) == (n_blank == 0)
    assert said.count("reference's own error") == n_blank
    for title, each in report.meshes():
        (line,) = (row for row in said.splitlines() if row.startswith(f"{title} "))
        is_blind = each.kind == "peer" and each.median is not None
        assert ("*" in line) == is_blind, line
