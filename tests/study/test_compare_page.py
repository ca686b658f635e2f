"""The comparison's page: its numbers are the report's, winners and losses are right, failures are named."""

import html
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import browser, copied, document
from markupsafe import escape

import tetopt
from tetopt.fem.reference import Errors, OwnError
from tetopt.io.text import plain
from tetopt.measure.quality import Quality, QualityErrors
from tetopt.report.figures import save_figure
from tetopt.study import compare_report as records
from tetopt.study.compare import elementwise
from tetopt.study.compare_criteria import CriterionEntry, criteria, entry, number_text, winners
from tetopt.study.compare_figures import curves_figure, histograms_figure, slices_figure, timing_figure
from tetopt.study.compare_headline import headline
from tetopt.study.compare_page import save_compare_page
from tetopt.study.compare_report import as_json
from tetopt.study.pipelines import PIPELINES


def fake_run(seed, scale, order=1):
    """A run of plausible numbers; errors go with `scale`, and are half as large with quadratic cells."""
    random = np.random.default_rng(seed)

    def some(low, high):
        return float(random.uniform(low, high))

    rho, angles = random.dirichlet(np.arange(1, 21)), random.dirichlet(np.bincount(range(36)) + 3)
    quality = Quality(
        ndim=3, n_nodes=5000 + seed, n_cells=27000 + 5 * seed, volume=1e6, smallest_volume=0.1,
        mean_rho=some(0.2, 0.3), p1_rho=some(0.05, 0.2), min_rho=some(0.001, 0.1),
        errors=QualityErrors(*(some(0.1, 3.0) for _ in range(4))),
        min_dihedral=some(1.0, 30.0), p1_dihedral=some(10.0, 40.0), max_dihedral=some(110.0, 178.0),
        n_under_10_degrees=int(random.integers(0, 50)),
        kinds={"needle": 0, "wedge": 1, "cap": 0, "spade": 2, "sliver": int(random.integers(0, 9))},
        min_edge=0.5, max_edge=20.0,
    )  # fmt: skip
    labels = [
        records.LabelRow(
            label=k, voxels=9000 // (4**k), mesh_voxels=round(9000 // 4**k * some(0.8, 1.1)) * (k < 3),
            dice=some(0.7, 0.98) * (k < 3), E_D_fraction=0.02 * scale, is_lost=k == 3,
            volume_mm3=72000.0 / 4**k, mesh_volume_mm3=72000.0 / 4**k * some(0.8, 1.1) * (k < 3),
            surface_mean_mm=some(0.4, 2.0) if k < 3 else None, surface_p95_mm=some(3.0, 5.0) if k < 3 else None,
            components=1, mesh_components=int(random.integers(1, 4)) * (k < 3),
            area_ratio=some(0.9, 1.8) if k < 3 else None, folded=some(0.0, 0.5) if k < 3 else None,
            nonmanifold_edges=10 * k, nonmanifold_edges_two_labels=5 * k,
            one_layer_fraction=some(0.1, 0.9) if k < 3 else None, excess_contact_mm2=some(0.0, 200.0),
        )
        for k in range(4)
    ]  # fmt: skip
    fem = {nu: simulation_of(random, scale / order) for nu in ("0.3", "0.45")}
    seconds = {"lattice": some(0.1, 1.0), "optimise": some(1.0, 20.0)}
    measurement = records.Measurement(
        order=order, n_nodes=5000 + seed, n_corners=(5000 + seed) // (1, 7)[order - 1],
        n_cells=27000 + 5 * seed, E_D=1e9 * scale, E_D_fraction=0.04 * scale, n_missed_voxels=0,
        n_empty_cells=0, quality=quality,
        rho_histogram=records.Histogram(np.linspace(0, 1 / 3, 21).tolist(), rho.tolist()),
        dihedral_histogram=records.Histogram(list(range(0, 181, 5)), angles.tolist()), labels=labels, fem=fem,
    )  # fmt: skip
    return records.PipelineRun({"kernels": 3.0, **seconds}, sum(seconds.values()), int(9e8 * scale), measurement)


def simulation_of(random, scale):
    """The default average errs a fifth less than Eq. (2)'s."""
    averages = {
        name: records.Solved(random.uniform(1.0, 2.0), errors_of(factor * scale), 0.5 / scale)
        for name, factor in (("mean", 1.0), ("gauss", 0.8))
    }
    return records.Simulation(
        random.uniform(1e2, 1e3), random.uniform(1e3, 1e5), int(random.integers(80, 300)), averages
    )


def errors_of(scale):
    return Errors(0.03 * scale, 0.1 * scale, 0.2 * scale)


def with_runs(pipeline, runs):
    """The pipeline with other runs, summed up."""
    median, low, high = (elementwise(runs, of) if runs else None for of in (np.median, np.min, np.max))
    return pipeline._replace(runs=runs, median=median, low=low, high=high)


def with_measured(report, number, **values):
    """Change what all runs of the pipeline at this place measured, with cells of both orders."""
    for pipelines in (report.pipelines, report.quadratic):
        pipeline = pipelines[number]
        runs = [run._replace(measurement=run.measurement._replace(**values)) for run in pipeline.runs]
        pipelines[number] = with_runs(pipeline, runs)


def finished(report):
    return [pipeline for pipeline in report.pipelines if pipeline.median is not None]


def fake_report():
    """Five pipelines: the second of three runs, the third failed."""
    results = {1: [], 2: []}
    for number, name in enumerate(("tetopt", "pytetwild", "mine", "bcc", "odt")):
        title, kind = (PIPELINES[name].title, PIPELINES[name].kind) if name in PIPELINES else (name, "peer")
        n_runs = (1, 3, 0, 1, 1)[number]
        for order, pipelines in results.items():
            runs = [fake_run(10 * number + k, 1.0 + 0.3 * number, order) for k in range(n_runs)]
            failure = None if runs else "twice crashed: signal 11, SIGSEGV"
            about, notes = f"{title}, its options", [f"a note on {title}"]
            reason, crashes = (None, []) if runs else ("crash", ["crashed: signal 11, SIGSEGV"] * 2)
            result = records.PipelineResult(name, title, kind, about, failure, reason, crashes, notes, runs)
            pipelines.append(with_runs(result, runs))
    random = np.random.default_rng(0)
    curves = [
        records.Curve(p.name, p.title, order, [
            records.CurvePoint(nodes, 0.04 * scale, {
                nu: simulation_of(random, scale * (1.0 + k * 0.4) / order) for nu in ("0.3", "0.45")
            })
            for nodes, scale in ((1250, 2.2), (2500, 1.5), (5000, 1.0), (10000, 0.7))
        ])
        for order, pipelines in results.items() for k, p in enumerate(pipelines) if p.runs
    ]  # fmt: skip
    source = records.ImageSource("T1.nii.gz", "ab" * 32, None, None)
    return records.Report(
        command="tetopt compare T1.nii.gz -o out --nodes 5000",
        image=records.ImageFacts(source, (197, 233, 189), [1, 1, 1], 2841.2),
        labels=records.LabelSource("labels.nii.gz", "given", "cd" * 32), mapping="1 kPa at 0, 10 kPa at 255",
        versions={"tetopt": "0.1.0", "numpy": "2.0"}, machine={"cores": 2, "system": "Linux"},
        options=records.Settings(5000),
        reference=records.ReferenceGrid(
            (49, 58, 47), 435000, "averaged", {"0.3": records.ReferenceEnergy(1.234, OwnError(0.01, 0.02), 17)}
        ),
        date="2026-11-22", pipelines=results[1], quadratic=results[2], tradeoff=[], curves=curves, seconds=812.0,
    )  # fmt: skip


def meshes_of(image, nodes, iterations):
    """A lattice and an optimised mesh of the image."""
    lattice = tetopt.lattice_mesh(image, nodes=nodes)
    mesh = tetopt.optimize(image, lattice, k_D=0.3, iterations=iterations).mesh
    return [("tetopt", mesh), ("BCC lattice", lattice)]


class Tables(HTMLParser):
    """Rows of every table: for each cell its classes and its text, parts that stand apart divided by |; its caption."""

    def __init__(self, page):
        super().__init__()
        self.tables, self.kinds, self.captions, self.cell = [], [], [], None
        self.feed(page)

    def of_kind(self, kind):
        return [table for table, own in zip(self.tables, self.kinds, strict=True) if own == kind]

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.tables.append([])
            self.kinds.append(dict(attrs).get("class"))
            self.captions.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag == "caption":
            self.cell = [set(), self.captions[-1]]
        if tag in ("td", "th"):
            self.cell = [set((dict(attrs).get("class") or "").split()), []]
            self.tables[-1][-1].append(self.cell)

    def handle_endtag(self, tag):
        if tag in ("td", "th", "caption"):
            self.cell = None

    def handle_data(self, data):
        if self.cell is not None:
            self.cell[1].append(data.strip())


def page_of(tmp_path, report, pictures=()):
    save_compare_page(tmp_path / "report.html", report, pictures)
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def flowing(page):
    """The page with one space for each white space, as a browser shows its texts."""
    return " ".join(page.split())


def measures(page):
    """Rows of the groups' tables by their heading and the row's title; each cell (classes, texts)."""
    parsed = Tables(page)
    rows_by_title = {}
    for table, kind, caption in zip(parsed.tables, parsed.kinds, parsed.captions, strict=True):
        if kind == "measures":
            part = re.match(r"Table \d+\. (\w+):", "".join(caption))[1]
            for row in table[1:]:
                if len(row) == 1:
                    part = "".join(row[0][1])
                else:
                    rows_by_title[part, row[0][1][0].rstrip(" ↓↑")] = row[1:]
    return rows_by_title


def claims(page):
    """Rows of the first section's tables by the measure: the texts of each cell."""
    tables = Tables(page).of_kind("claims")
    return [{row[0][1][1].rstrip(" ↓↑"): [texts for _, texts in row] for row in table[1:]} for table in tables]


# --------------------------------------------------------------------------------------------------
# Numbers


# Where report.json holds what a row shows, written down here once more.
PATHS = {
    ("Image", "E_D, fraction of the image's variance"): ("E_D_fraction",),
    ("Image", "voxels outside the mesh"): ("n_missed_voxels",),
    ("Cost", "nodes"): ("n_nodes",),
    ("Cost", "tetrahedra"): ("n_cells",),
    ("Shape", "mean rho"): ("quality", "mean_rho"),
    ("Shape", "p1 rho"): ("quality", "p1_rho"),
    ("Shape", "min rho"): ("quality", "min_rho"),
    ("Shape", "error (i) mean"): ("quality", "errors", "mean"),
    ("Shape", "error (ii) harmonic mean"): ("quality", "errors", "harmonic_mean"),
    ("Shape", "error (iii) L2"): ("quality", "errors", "l2"),
    ("Shape", "error (iv) worst"): ("quality", "errors", "worst"),
    ("Shape", "smallest dihedral angle, °"): ("quality", "min_dihedral"),
    ("Shape", "dihedral angle p1, °"): ("quality", "p1_dihedral"),
    ("Shape", "largest dihedral angle, °"): ("quality", "max_dihedral"),
    ("Shape", "cells under 10°"): ("quality", "n_under_10_degrees"),
    **{("Shape", f"{kind}s"): ("quality", "kinds", kind) for kind in ("sliver", "cap", "needle", "wedge", "spade")},
    **{
        (f"Compression, ν = {nu}, {cells} cells", title): ("fem", nu, *keys)
        for nu in ("0.3", "0.45")
        for cells in ("linear", "quadratic")
        for title, keys in (
            ("strain-energy error", ("averages", "gauss", "errors", "strain_energy")),
            ("displacement error", ("averages", "gauss", "errors", "displacement")),
            ("interface-strain error", ("averages", "gauss", "errors", "interface_strain")),
            *(
                (f"{title} error, moduli by mean", ("averages", "mean", "errors", name))
                for title, name in (
                    ("strain-energy", "strain_energy"),
                    ("displacement", "displacement"),
                    ("interface-strain", "interface_strain"),
                )
            ),
            ("λ max", ("lambda_max",)),
            ("condition number", ("cond",)),
            ("CG iterations", ("cg_iterations",)),
        )
    },
    ("Shape", "bad cells (3 rho < 0.3), %"): ("bad",),
    ("Cost", "wall time, s"): ("seconds_total",),
    ("Cost", "peak memory, MB"): ("peak_bytes",),
}


def pipelines_of(report, title):
    """The pipelines that a row of the headline is of."""
    return report.quadratic if "quadratic" in title[0] else report.pipelines


JUDGED = "Labels above 500 voxels, without background 0"  # of the fake ones 1 and 2
DERIVED = {
    (JUDGED, "mean label Dice"): lambda rows: np.mean([r.dice for r in rows[1:3]]),
    (JUDGED, "smallest label Dice"): lambda rows: min(r.dice for r in rows[1:3]),
    (JUDGED, "mean label surface distance, mm"): lambda rows: np.mean([r.surface_mean_mm for r in rows[1:3]]),
    (JUDGED, "label surface distance p95, mm"): lambda rows: np.mean([r.surface_p95_mm for r in rows[1:3]]),
    (JUDGED, "largest label volume error"): lambda rows: max(
        abs(r.mesh_volume_mm3 / r.volume_mm3 - 1) for r in rows[1:3]
    ),
    (JUDGED, "label area over smoothed voxels', weighted mean"): lambda rows: np.average(
        [r.area_ratio for r in rows[1:3]], weights=[r.voxels for r in rows[1:3]]
    ),
    (JUDGED, "label edges folded over 60°, weighted mean"): lambda rows: np.average(
        [r.folded for r in rows[1:3]], weights=[r.voxels for r in rows[1:3]]
    ),
    (JUDGED, "label edges in more than two facets"): lambda rows: sum(r.nonmanifold_edges for r in rows[1:3]),
    (JUDGED, "of these, where two labels meet"): lambda rows: sum(r.nonmanifold_edges_two_labels for r in rows[1:3]),
    (JUDGED, "labels with more or fewer components"): lambda rows: sum(r.mesh_components != 1 for r in rows[1:3]),
    (JUDGED, "labels lost (of any size)"): lambda rows: 1,
}


def dug(run, keys):
    value = as_json(run)
    if keys == ("bad",):
        return 100.0 * sum(value["quality"]["kinds"].values()) / value["quality"]["n_cells"]
    for key in keys:
        value = value[key]
    return value / 1e6 if keys == ("peak_bytes",) else value


def close(text, value):
    """Whether the printed number is the value, to four digits."""
    return abs(float(text) - value) <= 5.1e-4 * abs(value)


def test_every_number_is_the_reports(tmp_path):
    report = fake_report()
    rows = measures(page_of(tmp_path, report))
    assert set(rows) == set(PATHS) | set(DERIVED)
    for title, keys in PATHS.items():
        for pipeline, (_, texts) in zip(pipelines_of(report, title), rows[title], strict=True):
            if pipeline.median is None:
                assert texts == ["failed"]
                continue
            assert close(texts[0], np.median([dug(run, keys) for run in pipeline.runs])), title
            if len(pipeline.runs) > 1:
                low, high = texts[1].split(" to ")
                each = [dug(run, keys) for run in pipeline.runs]
                assert close(low, min(each))
                assert close(high, max(each))
            else:
                assert not any(" to " in text for text in texts)


def test_the_best_of_orders_and_averages_is_said(tmp_path):
    report = fake_report()
    page = flowing(page_of(tmp_path, report))
    best = report.quadratic[0].median.measurement.fem["0.3"].averages["gauss"].errors
    line = (
        "At about 5000 nodes in all and ν = 0.3, the displacement's error is smallest with tetopt, quadratic "
        f"cells, gauss: {number_text(best.displacement)} (strain energy {number_text(best.strain_energy)})."
    )
    assert line in page
    assert "</strong> The best with linear cells, and of the others: tetopt, linear cells, gauss: 0.08;" in page
    assert page.index("ν = 0.45, the displacement") > page.index(line)


def equal_time_table(page):
    return next(table for table in Tables(page).tables if [cell[1] for cell in table[0][1:3]] == [["ν"], ["seconds"]])


def test_errors_at_equal_times(tmp_path):
    """Between two meshes of the curve, on logarithms; nothing beyond its ends."""
    report = fake_report()
    _, *rows = equal_time_table(page_of(tmp_path, report))
    shown = {(row[0][1][0], row[1][1][0]): [cell[1][0] for cell in row[2:]] for row in rows}
    assert len(shown) == 2 * len(finished(report))
    linear = report.pipelines[0].median.measurement.fem["0.3"].averages["gauss"]
    points = [point.fem["0.3"].averages["gauss"] for point in report.curves[4].points]
    assert report.curves[4].order == 2
    # Of the fake report: error x seconds is the same for all, so that the line is straight on logarithms.
    expected = points[0].errors.displacement * points[0].seconds / linear.seconds
    seconds, own, theirs = shown["tetopt", "0.3"]
    assert close(seconds, linear.seconds)
    assert close(own, linear.errors.displacement)
    assert close(theirs, expected)
    report.pipelines[0].median.measurement.fem["0.3"].averages["gauss"] = linear._replace(seconds=5.0)
    _, row, *_ = equal_time_table(page_of(tmp_path, report))
    assert [cell[1][0] for cell in row[2:]] == ["5", number_text(linear.errors.displacement), "–"]


def test_quadratic_failures_are_named(tmp_path):
    report = fake_report()
    report.quadratic[1] = with_runs(report.quadratic[1]._replace(failure="timed out"), [])
    page = page_of(tmp_path, report)
    assert "pytetwild, quadratic cells: failed: timed out." in page
    assert measures(page)["Compression, ν = 0.3, quadratic cells", "displacement error"][1][1] == ["failed"]
    assert measures(page)["Compression, ν = 0.3, linear cells", "displacement error"][1][1] != ["failed"]


def test_label_rows_are_computed_from_the_runs(tmp_path):
    report = fake_report()
    rows = measures(page_of(tmp_path, report))
    for title, value in DERIVED.items():
        for pipeline, (_, texts) in zip(report.pipelines, rows[title], strict=True):
            if pipeline.runs:
                values = [value(run.measurement.labels) for run in pipeline.runs]
                assert close(texts[0], np.median(values)), title


def test_a_lost_label_is_not_averaged_away(tmp_path):
    """Its surface has no distance: the mean over the other labels would make losing it pay."""
    report = fake_report()
    lose(report.pipelines[0].runs[0], 2)
    for title in ("mean label surface distance, mm", "label edges folded over 60°, weighted mean"):
        cell = measures(page_of(tmp_path, report))[JUDGED, title][0]
        assert cell == [{"tetopt", "lost"}, ["–", "no value"]]


def folded_tables(parsed):
    """Of the labels' connected components, single layers and contact, and of their fractions of E_D."""
    return [
        table
        for table in parsed.tables
        if table[0][0][1] == ["label"] and table[0][1][1][0] in ("in the image", "voxels")
    ]


def lose(run, label):
    labels = run.measurement.labels
    labels[label] = labels[label]._replace(
        is_lost=True, dice=0.0, surface_mean_mm=None, surface_p95_mm=None, mesh_volume_mm3=0.0, area_ratio=None,
        folded=None, one_layer_fraction=None,
    )  # fmt: skip


def test_labels_are_tabled_and_the_vanished_named(tmp_path):
    """A row a label, the one on which tetopt is worst first; Dice, distances and volume of each pipeline."""
    report = fake_report()
    lose(report.pipelines[1].runs[2], 1)
    page = page_of(tmp_path, report)
    assert "<li>tetopt: label 3 (140 voxels)</li>" in page
    assert "<li>pytetwild: label 1 (2250 voxels, in 1 of 3 runs), label 3 (140 voxels)</li>" in page
    parsed = Tables(page)
    head, *rows = parsed.of_kind("labels")[0]
    done = finished(report)
    assert [cell[1][0] for cell in head] == ["label", *(p.title for p in done)]
    own = {row.label: row.dice for row in done[0].median.measurement.labels}
    assert [int(row[0][1][0]) for row in rows] == sorted(own, key=own.get)
    for label, *cells in rows:
        k = int(label[1][0])
        dice = []
        for pipeline, (_, texts) in zip(done, cells, strict=True):
            of_runs = [run.measurement.labels[k] for run in pipeline.runs]
            if k == 3:
                assert texts == ["lost"]
                continue
            known = [row for row in of_runs if not row.is_lost]
            dice.append(np.median([row.dice for row in of_runs]))
            mean, p95 = np.median([(row.surface_mean_mm, row.surface_p95_mm) for row in known], axis=0)
            percent = 100 * np.median([row.mesh_volume_mm3 / row.volume_mm3 - 1 for row in of_runs])
            expected = [f"{dice[-1]:.3f}", f"{mean:.2f} / {p95:.2f} mm", f"vol. {percent:+.1f} %".replace("-", "−")]
            area, folded = np.median([(row.area_ratio, row.folded) for row in known], axis=0)
            expected.append(f"area {area:.2f}, folded {100 * folded:.0f} %")
            assert texts == expected + ["lost in 1 of 3 runs"] * (len(known) == 2)
        if dice:
            assert [("best" in classes) for classes, _ in cells] == [d == max(dice) for d in dice]
    pieces, layers, contacts, fractions = folded_tables(parsed)
    assert "straight cells" in page
    for k in range(4):
        for column, pipeline in enumerate(done, 2):
            of_runs = [run.measurement.labels[k] for run in pipeline.runs]
            assert float(pieces[k + 1][column][1][0]) == np.median([row.mesh_components for row in of_runs])
            assert close(fractions[k + 1][column][1][0], np.median([row.E_D_fraction for row in of_runs]))
            assert close(contacts[k + 1][column][1][0], np.median([row.excess_contact_mm2 for row in of_runs]))
            known = [row.one_layer_fraction for row in of_runs if not row.is_lost]
            text = layers[k + 1][column][1][0]
            assert close(text, np.median(known)) if known else text == "–"


def test_most_of_many_labels_are_folded(tmp_path):
    """Forty labels: a dozen open to see, the rest behind a line, every one once."""
    report = fake_report()
    for number, pipeline in enumerate(report.pipelines):
        for run in pipeline.runs[:1]:
            row = run.measurement.labels[1]
            with_measured(report, number, labels=[row._replace(label=k, dice=0.9 - 0.01 * k) for k in range(40)])
    page = page_of(tmp_path, report)
    open_, folded = ([int(row[0][1][0]) for row in table[1:]] for table in Tables(page).of_kind("labels"))
    assert open_ == list(range(39, 27, -1))
    assert folded == list(range(27, -1, -1))
    assert "<details><summary>The other 28 labels</summary>" in page


def with_dice(ours, theirs):
    """tetopt and pytetwild have these Dice on labels 0, 1, ..., and the larger the Dice, the nearer the surface."""
    report = fake_report()
    for number, values in ((0, ours), (1, theirs)):
        for run in report.pipelines[number].runs:
            labels = run.measurement.labels
            for k, dice in enumerate(values):
                labels[k] = labels[k]._replace(dice=dice, surface_mean_mm=2.0 - dice)
    return report


def test_who_keeps_the_labels_is_said(tmp_path):
    """Of the labels above 500 voxels, and without the background; those on which tetopt is worse are named."""
    page = flowing(page_of(tmp_path, with_dice((0.1, 0.9, 0.61), (0.99, 0.8, 0.62))))
    assert f"Of 2 {JUDGED[0].lower()}{JUDGED[1:]}, tetopt's Dice is at least pytetwild's on 1</strong>" in page
    assert "and its mean surface distance no larger on 1." in page
    assert "tetopt's Dice is below pytetwild's on label 2 (0.61 against 0.62)." in page
    assert "tetopt's mean surface distance is larger than pytetwild's on label 2." in page
    report = with_dice((0.1, 0.9, 0.61), (0.99, 0.8, 0.62))
    lose(report.pipelines[0].runs[0], 3)
    page = flowing(
        page_of(tmp_path, report._replace(labels=report.labels._replace(names={2: "left <lung>", 3: "dot"})))
    )
    assert "pytetwild's on label 2 left &lt;lung&gt; (0.61 against 0.62)." in page
    assert "larger than pytetwild's on label 2 left &lt;lung&gt;." in page
    assert "label 3 dot (140 voxels" in page
    parsed = Tables(page)
    for each in (*parsed.of_kind("labels"), *folded_tables(parsed)):
        assert {row[0][1][0] for row in each[1:]} == {"0", "1", "2 left <lung>", "3 dot"}
    page = flowing(page_of(tmp_path, with_dice((0.1, 0.9, 0.62), (0.99, 0.8, 0.62))))
    assert "Dice is at least pytetwild's on 2<" in page
    assert "is below" not in page
    assert "is larger than" not in page
    page = flowing(page_of(tmp_path, with_dice((0.1, 0.9, 0.62), (0.99, 0.8, 0.62))._replace(labels=None)))
    assert "Dice is at least" not in page
    assert "without background 0" not in page


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.0, "0"), (5012.0, "5012"), (0.0421234, "0.04212"), (123456.7, "123457"), (3.2e12, "3.2e+12")],
)
def test_number_text(value, text):
    assert number_text(value) == text


# --------------------------------------------------------------------------------------------------
# Winners


@pytest.mark.parametrize(
    ("better", "values", "expected"),
    [
        (-1, (3.0, 1.0, 2.0), [1]),
        (1, (3.0, 1.0, 2.0), [0]),
        (0, (3.0, 1.0, 2.0), []),
        (-1, (1.0, 1.0, 2.0), [0, 1]),
        (-1, (1.00001, 1.00002, 2.0), [0, 1]),  # equal as printed
        (-1, (0.0, 0.0, 0.0), []),
        (-1, (None, 1.0, 2.0), [1]),
        (-1, (None, 1.0, None), []),  # nothing to be better than
        (1, (-2.0, -1.0), [1]),
        (-1, (0.0, 5.0), [0]),
    ],
)
def test_winners(better, values, expected):
    assert winners(better, values) == expected


def with_values(**fractions):
    """A report in which the named pipelines have these fractions of E_D."""
    report = fake_report()
    for number, pipeline in enumerate(report.pipelines):
        if pipeline.name in fractions:
            with_measured(report, number, E_D_fraction=fractions[pipeline.name])
    return report


E_D_ROW = ("Image", "E_D, fraction of the image's variance")


def test_a_loss_is_marked_and_said(tmp_path):
    page = page_of(tmp_path, with_values(tetopt=0.07, pytetwild=0.05, bcc=0.09, odt=0.08))
    (tetopt_cell, peer, failed, control, _) = measures(page)[E_D_ROW]
    assert tetopt_cell == [{"tetopt", "lost"}, ["0.07", "1.4× the best"]]
    assert peer == [{"peer", "best"}, ["0.05", "0.05 to 0.05", "best"]]
    assert failed[0] == {"peer"}
    assert control == [{"control"}, ["0.09"]]
    first, behind, _ = claims(page)
    words = ["0.07"], ["0.05", "pytetwild"], ["1.4×", "worse", "nodes 5000 and 5011"]
    assert tuple(first[E_D_ROW[1]][1:]) == tuple(behind[E_D_ROW[1]][1:]) == words


def test_a_control_can_win(tmp_path):
    page = page_of(tmp_path, with_values(tetopt=0.07, pytetwild=0.09, bcc=0.01, odt=0.08))
    row = measures(page)[E_D_ROW]
    assert [("best" in classes) for classes, _ in row] == [False, False, False, True, False]
    first, behind_peers, behind_others = claims(page)
    assert first[E_D_ROW[1]][3] == ["0.778×", "better", "nodes 5000 and 5011"]
    assert E_D_ROW[1] not in behind_peers
    assert behind_others[E_D_ROW[1]][2:] == [["0.01", "BCC lattice"], ["7×", "worse", "nodes 5000 and 5030"]]


def test_a_tie_is_shared(tmp_path):
    row = measures(page_of(tmp_path, with_values(tetopt=0.05, pytetwild=0.05, bcc=0.09, odt=0.08)))[E_D_ROW]
    assert [texts[-1] for classes, texts in row if "best" in classes] == ["best, tied", "best, tied"]
    assert "lost" not in row[0][0]


@pytest.mark.parametrize(
    ("ours", "theirs", "texts"),
    [(0.07, 0.0, ["0.07", "0.07 from the best"]), (0.05004, 0.05, ["0.05004", "within 0.1% of the best"]),
     (None, 0.05, ["–", "no value"])],
)  # fmt: skip
def test_losses_without_a_ratio(tmp_path, ours, theirs, texts):
    row = measures(page_of(tmp_path, with_values(tetopt=ours, pytetwild=theirs)))[E_D_ROW]
    assert row[0] == [{"tetopt", "lost"}, texts]


def test_the_headline_is_a_handful_of_numbers(tmp_path):
    """Against the best peer: of every group, the kinds of bad cells as one; nowhere how many measures are won."""
    report = fake_report()
    page = page_of(tmp_path, report)
    first, behind, others = claims(page)
    assert [texts[0][0] for texts in first.values()] == ["Image", "Image", "Shape", "Simulation", "Simulation", "Cost"]
    assert all(texts[2][-1] == "pytetwild" for texts in [*first.values(), *behind.values()])
    assert {texts[2][-1] for texts in others.values()} <= {"BCC lattice", "ODT, image-blind"}
    assert all(re.match("does not capture .{10}", texts[0][2]) for texts in first.values())
    assert not re.search(r"(best|loses) in \d+", page)
    titles = {criterion.title for criterion in criteria(report) if criterion.better == 0}
    assert titles == {"nodes", "tetrahedra", "label area over smoothed voxels', weighted mean", "λ max"}
    assert all(row.blind for row in criteria(report) if not row.is_detail and row.better)


def test_what_is_behind_is_worst_first(tmp_path):
    """Group by group; and only what is worse than the runs' ranges and half a per cent."""
    report = fake_report()
    first = headline(report)
    groups = ["Image", "Shape", "Simulation", "Cost"]
    for rows in (first.behind_peers(), first.behind_others()):
        assert rows
        keys = [(groups.index(row.group), -row.factor) for row in rows]
        assert keys == sorted(keys)
    for row in first.behind:
        own, other = row.ours.value, row.other.value
        assert own is None or (own > other if row.smaller_is_better else own < other)
    assert {row.verdict for row in first.behind} == {"worse"}
    assert not [row for row in first.behind_others() if row.group == "Cost"]


@pytest.mark.parametrize(
    ("ours", "theirs", "verdict"),
    [
        (0.07, (0.04, 0.05, 0.06), "worse"),
        (0.055, (0.04, 0.05, 0.06), "no different"),  # within the range of its runs
        (0.045, (0.04, 0.05, 0.06), "no different"),
        (0.03, (0.04, 0.05, 0.06), "better"),
        (0.05002, (0.05, 0.05, 0.05), "no different"),  # by less than half a per cent
        (0.0504, (0.05, 0.05, 0.05), "worse"),
        (None, (0.05, 0.05, 0.05), "worse"),
        (0.0, (0.05, 0.05, 0.05), "better"),
    ],
)
def test_verdicts(tmp_path, ours, theirs, verdict):
    report = with_values(tetopt=ours)
    runs = [
        run._replace(measurement=run.measurement._replace(E_D_fraction=value))
        for run, value in zip(report.pipelines[1].runs, theirs, strict=True)
    ]
    report.pipelines[1] = with_runs(report.pipelines[1], runs)
    claim = next(row for row in headline(report).claims if row.measure == E_D_ROW[1])
    assert claim.verdict == verdict
    assert claim.ratio == (pytest.approx(ours / 0.05) if ours else None)


DISPLACEMENT = "displacement error, ν = 0.3, linear cells"


def claim_of(report, measure):
    return next(claim for claim in headline(report).claims if claim.measure == measure)


@pytest.mark.parametrize(("change", "verdict"), [(0.02, "worse"), (0.03, "no verdict"), (None, "worse")])
def test_no_verdict_below_the_references_own_change(tmp_path, change, verdict):
    """The peer's displacement is off by 0.08, tetopt's by 0.104: nothing is decided if the reference is by 0.03."""
    report = fake_report()
    (own, *_), (peer, *_) = (report.pipelines[place].runs for place in (0, 1))
    for pipelines in (report.pipelines, report.quadratic):
        for place, run in ((0, peer), (1, own)):
            fem = pipelines[place].runs[0].measurement._replace(fem=run.measurement.fem)
            pipelines[place] = with_runs(pipelines[place], [run._replace(measurement=fem)])
    known = report.reference.by_nu["0.3"]._replace(own_error=OwnError(0.001, change))
    report = report._replace(reference=report.reference._replace(by_nu={"0.3": known}))
    claim = claim_of(report, DISPLACEMENT)
    assert (claim.verdict, claim.own_change) == (verdict, change)
    is_void, why = verdict == "no verdict", "less than the reference's own error, 0.03"
    known = why if is_void else f"reference's own error {change or 'not known'}"
    assert claim.beside == [known, "nodes 5000 and 5010"]
    first = headline(report)
    assert (DISPLACEMENT in {row.measure for row in first.behind_peers()}) != is_void
    assert is_void == any(f"{DISPLACEMENT} (1.3×, {why})" in line for line in first.remarks)
    page = page_of(tmp_path, report)
    (cell,) = (row[3] for row in Tables(page).of_kind("claims")[0][1:] if row[0][1][1].startswith(DISPLACEMENT))
    assert cell == [set() if is_void else {"lost"}, ["1.3×", verdict, *claim.beside]]
    cell = measures(page)["Compression, ν = 0.3, linear cells", "displacement error"][0]
    assert cell == [
        {"tetopt"} | set() if is_void else {"tetopt", "lost"},
        ["0.104", f"1.3× the best{f', {why}' * is_void}"],
    ]
    strain = next(row for row in first.behind_peers() if row.measure.startswith("interface-strain error, ν = 0.3, lin"))
    assert strain.beside[0] == "reference's own error not known"
    assert not next(row for row in first.claims if row.group == "Image").beside[0].startswith("reference")


@pytest.mark.parametrize(
    ("seconds", "verdict"),
    [
        ((5.26,), "no verdict"),
        ((5.2, 5.26, 5.3), "worse"),
        ((4.0, 5.26, 6.0), "no different"),
        ((4.4, 5.26, 5.3), "no different"),  # 5.98 is above all of these; 5.98 * 4.4 / 5.26 is not
    ],
)
def test_no_verdict_on_time_and_memory_of_one_run(tmp_path, seconds, verdict):
    """Of tetopt's single run it is taken that it scatters like the peer's repeats."""
    report = fake_report()
    for place, times in enumerate(((5.98,), seconds, (), (60.0,), (60.0,))):
        if not times:
            continue
        run = report.pipelines[place].runs[0]
        runs = [run._replace(seconds_total=each, peak_bytes=int(each * 1e8)) for each in times]
        report.pipelines[place] = with_runs(report.pipelines[place], runs)
    claim, first = claim_of(report, "wall time, s"), headline(report)
    assert claim.verdict == verdict
    assert claim.beside == ["one run each"] * (verdict == "no verdict") + ["nodes 5000 and 5010"]
    behind = {row.measure for row in first.behind_peers()}
    assert ({"wall time, s", "peak memory, MB"} <= behind) == (verdict == "worse")
    (remark,) = (
        (line for line in first.remarks if line.startswith("A peer is better")) if verdict == "no verdict" else ("",)
    )
    assert ("wall time, s (1.14×, one run each)" in remark) == (verdict == "no verdict")
    assert ("peak memory, MB (1.14×, one run each)" in remark) == (verdict == "no verdict")
    ours, theirs, *_ = measures(page_of(tmp_path, report))["Cost", "wall time, s"]
    assert ("lost" in ours[0]) == ("best" in theirs[0]) == (len(seconds) > 1)
    assert (theirs[1][-1] == "one run each") == (len(seconds) == 1)


def test_different_sizes_are_said(tmp_path):
    report = fake_report()
    assert "Nodes, linear cells: tetopt 5000, pytetwild 5011." in page_of(tmp_path, report)
    assert "differ in nodes" not in page_of(tmp_path, report)
    peer = report.quadratic[1]
    runs = [run._replace(measurement=run.measurement._replace(n_nodes=4000)) for run in peer.runs]
    report.quadratic[1] = with_runs(peer, runs)
    page = page_of(tmp_path, report)
    assert "Nodes, linear cells: tetopt 5000" in page
    assert "The meshes differ in nodes, quadratic cells: tetopt 5000, pytetwild 4000; more nodes alone" in page
    with_measured(report, 1, n_nodes=9000)
    assert "differ in nodes, linear cells: tetopt 5000, pytetwild 9000" in page_of(tmp_path, report)


# --------------------------------------------------------------------------------------------------
# Failures


def without(report, *places, reason="crash", failure="twice crashed: signal 11, SIGSEGV"):
    """The report in which the pipelines at these places failed."""
    for pipelines in (report.pipelines, report.quadratic):
        for place in places:
            failed = pipelines[place]._replace(failure=failure, reason=reason, crashes=[])
            pipelines[place] = with_runs(failed, [])
    return report


def test_without_a_peer_nothing_is_claimed(tmp_path):
    """The headline says why; what is not installed has not failed. The tables remain."""
    twice = "failed twice (signal 11, SIGSEGV)"
    title = f"tetopt against no peer: pytetwild {twice}; mine {twice}"
    report = without(fake_report(), 1)
    page = page_of(tmp_path, report)
    assert f"<strong>{title}</strong>" in page
    assert headline(report).claims == []
    assert "No peer is better" not in page
    assert measures(page)[E_D_ROW][1][1] == ["failed"]
    report = without(fake_report(), 1, 2, reason="missing", failure="not installed; install it")
    page = page_of(tmp_path, report)
    words = "tetopt against no peer: pytetwild is not installed; mine is not installed"
    assert f"<strong>{words}</strong>" in page
    assert measures(page)[E_D_ROW][1][1] == ["not installed"]
    assert "failed" not in headline(report).title
    report = without(fake_report(), 1, 2, reason="limit", failure="out of time: killed after 4 s")
    assert "pytetwild failed (out of time: killed after 4 s); " in headline(report).title
    report = fake_report()
    assert (
        headline(report._replace(pipelines=report.pipelines[:1])).title == "tetopt against no peer: none was requested"
    )


def test_a_crash_that_was_repeated_is_said(tmp_path):
    report = fake_report()
    report.pipelines[1] = report.pipelines[1]._replace(crashes=["crashed: signal 11, SIGSEGV"])
    page = page_of(tmp_path, report)
    assert "pytetwild: crashed once, and was run again (crashed: signal 11, SIGSEGV)." in page
    assert "pytetwild: crashed once" not in page_of(tmp_path, fake_report())


def test_tetopt_can_fail(tmp_path):
    report = fake_report()
    report.pipelines[0] = with_runs(report.pipelines[0]._replace(failure="timed out", reason="limit"), [])
    page = page_of(tmp_path, report)
    assert "<strong>no tetopt mesh to compare: tetopt failed (timed out)</strong>" in page
    assert claims(page) == []


def test_tetopt_by_its_defaults_is_in_the_headline(tmp_path):
    """Also where another of its meshes comes first."""
    report = fake_report()
    uniform = report.pipelines[0]._replace(name="tetopt-uniform", title="tetopt, uniform")
    again = report._replace(
        pipelines=[uniform, *report.pipelines], quadratic=[report.quadratic[0], *report.quadratic]
    )  # fmt: skip
    assert headline(again).title.startswith("tetopt against pytetwild")
    assert headline(again._replace(pipelines=[uniform, *report.pipelines[1:]])).title.startswith(
        "tetopt, uniform against"
    )


def test_a_failed_repeat_is_named_beside_its_numbers(tmp_path):
    report = fake_report()
    report.pipelines[1] = report.pipelines[1]._replace(failure="timed out after 3600 s", reason="limit")
    page = page_of(tmp_path, report)
    assert "pytetwild: a run failed: timed out after 3600 s." in page
    assert measures(page)[E_D_ROW][1][1][0] == number_text(report.pipelines[1].median.measurement.E_D_fraction)


def test_without_labels_and_finite_elements(tmp_path):
    report = fake_report()._replace(labels=None)
    for number, pipeline in enumerate(report.pipelines):
        if pipeline.runs:
            with_measured(report, number, labels=[], fem={})
    rows = measures(page_of(tmp_path, report))
    assert set(rows) == {title for title in PATHS if not title[0].startswith("Compression")}
    assert entry(criteria(report)[0].value, report.pipelines[2]) == CriterionEntry(None, None, None)


# --------------------------------------------------------------------------------------------------
# The page as a file


def with_names(report, evil):
    return report._replace(
        command=evil, mapping=evil, labels=report.labels._replace(name=evil, names={1: evil, 3: evil}),
        options=report.options._replace(k_D=evil),
        image=report.image._replace(source=report.image.source._replace(name=evil)),
        pipelines=[p._replace(title=evil, about=evil, notes=[evil], failure=evil) for p in report.pipelines],
    )  # fmt: skip


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
    words = [report.command, "a note on tetopt", "197 × 233 × 189", "ab" * 32, report.mapping, "0.1.0", "435000"]
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
        "slices": slices_figure(image, meshes, means), "histograms": histograms_figure(report),
        "curves": curves_figure(report), "timing": timing_figure(report),
    }  # fmt: skip
    for name, figure in figures.items():
        save_figure(figure, folder / f"{name}.png", dpi=80)
    save_compare_page(folder / "report.html", report, [(folder / f"{name}.png", name) for name in figures])
    return folder / "report.html"


@pytest.mark.full
def test_nothing_points_outside(whole):
    page = whole.read_text(encoding="utf-8")
    assert not re.search(r"(src|href|url)\s*[=(]\s*[\"']?(?!data:)[a-z./]+", re.sub(r"base64,[^\"]*", "", page))
    assert "http:" not in page
    assert "https:" not in page
    for word in ("Table", "Figure"):  # numbered through, those that are folded away with them
        numbers = [int(number) for number in re.findall(rf"caption>{word} (\d+)\. ", page)]
        assert numbers == list(range(1, len(numbers) + 1))
        assert len(numbers) >= 4
    order = [page.index(f'alt="{name}"') for name in ("slices", "histograms", "curves", "timing")]
    assert order == sorted(order)


@pytest.mark.deep
@pytest.mark.parametrize("width", [1150, 500])  # Chromium has no narrower window
def test_the_page_in_a_browser(whole, tmp_path, width):
    """Pictures load, and the page itself never scrolls sideways."""
    probe = (
        "<script>addEventListener('load', () => setTimeout(() => { const d = document.documentElement; "
        "d.dataset.images = [...document.images].map((i) => i.naturalWidth).join(); "
        "d.dataset.over = d.scrollWidth - d.clientWidth; }, 300))</script>"
    )
    copy = copied(whole.read_text(encoding="utf-8"), tmp_path / "copy.html", last=probe)
    data = dict(re.findall(r'data-(images|over)="([^"]*)"', document(copy, f"--window-size={width},900")[:400]))
    assert len(data["images"].split(",")) == 4
    assert all(int(size) > 100 for size in data["images"].split(","))
    assert int(data["over"]) <= 0


@pytest.mark.deep
def test_it_can_be_printed(whole, tmp_path):
    browser(tmp_path / "profile", f"--print-to-pdf={tmp_path / 'a.pdf'}", whole.as_uri())
    assert (tmp_path / "a.pdf").read_bytes()[:5] == b"%PDF-"
