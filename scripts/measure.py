"""Measure every number of docs/measured and of the README's table, and write them: `make measured`.

    python scripts/measure.py DATA [--only NAME ...]
    python scripts/measure.py --pages

DATA is a folder with the images of `FILES`. Each measurement runs its commands one after the other,
in a folder of its own, and replaces its entry in docs/measured/measured.json, with version, commit,
date and machine. Pages are written from scripts/templates and that file (`--pages`: without
measuring). Leave the machine idle: the whole takes an two hours on two cores, with CGAL.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import reduce
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import jinja2
import psutil

import tetopt
from tetopt.measure.thin import TOLERATED_CONTACT
from tetopt.system.files import save_json

ROOT = Path(__file__).parents[1]
DATA = ROOT / "docs" / "measured" / "measured.json"
PAGES = ROOT / "docs" / "measured"
TEMPLATES = ROOT / "scripts" / "templates"
# documents of which a template of the same name makes the part between MARKS
DOCUMENTS = (ROOT / "README.md", ROOT / "docs" / "understand" / "order.md")
LOG = "log.txt"  # in the folder of a measurement: what its commands print
MARKS = ("<!-- from make measured -->", "<!-- end of make measured -->")
PROGRAMS = {
    "CGAL": "program that meshes labels with CGAL's Mesh_3, see scripts/benchmark.py",
    "CGAL_SIZED": "the same with a sizing field",
    "CGAL_LABELS": "Python script that runs it, for `tetopt compare --pipeline`",
}
# of a measurement: its file, and the name in docs/pictures
PICTURES = {"mni152": ("compared/slices.png", "demo.png")}

FILES = {
    "T1": "mni_icbm152_t1_tal_nlin_sym_09a_converted.nii.gz",
    "TISSUES": "mni_icbm152_tissue_labels_derived.nii.gz",
    "HEAD": "head_tissues_b2m_40-44.nii.gz",
    "COLIN27": "brain_t1_colin27.nii.gz",
    "FLAIR": "brain_flair_oblique_aniso.nii.gz",
    "PROSTATE": "prostate_t2_tra_prostatex0001.nii.gz",
    "CT": "ct_abdomen_3mm.nii.gz",
    "CT_SLAB": "ct_abdomen_slab_3mm.nii.gz",
    "CT_LABELS": "ct_abdomen_slab_3mm_labels.nii.gz",
    "LUNG": "ct_lung_small.mha",
    "MR_SLAB": "mr_abdomen_slab_3mm.nii.gz",
    "HIPPOCAMPUS": "hippocampus_001_label.nii.gz",
}


def runs(folder: Path) -> dict[str, Any]:
    """Summaries of the runs whose `run.json` files are in a folder, by name."""
    return {
        path.stem: run_summary(json.loads(path.read_text()))
        for path in sorted(folder.glob("*.json"))
    }


def run_summary(run: dict[str, Any]) -> dict[str, Any]:
    """Numbers that pages quote of one run of `tetopt mesh`."""
    quality, labels = run["quality"], {}
    for row, surface in zip(run.get("labels") or [], run.get("interfaces") or [], strict=True):
        labels[str(row["label"])] = {
            "voxels": row["voxels"],
            "dice": row["dice"],
            "volume_ratio": row["mesh_volume"] / row["volume"],
            "one_layer": row["one_layer_fraction"],
            "folded": surface["folded"],
            "is_lost": row["is_lost"],
        }
    contacts = [
        c for c in run.get("contacts") or [] if c["ratio"] is None or c["ratio"] > TOLERATED_CONTACT
    ]
    return {
        "nodes": run["size"]["n_nodes_in_all"],
        "cells": quality["n_cells"],
        "E_D": run["energies"]["E_D_fraction_of_variance"],
        "E_D_initial": run["energies"]["E_D_fraction_of_variance_initial"],
        "mean_rho": quality["mean_rho"],
        "p1_rho": quality["p1_rho"],
        "min_dihedral": quality["min_dihedral"],
        "p1_dihedral": quality["p1_dihedral"],
        "slivers": quality["kinds"]["sliver"],
        "initial": {
            key: run["quality_initial"][key] for key in ("mean_rho", "p1_rho", "min_dihedral")
        },
        "seconds": run["seconds"]["all"],
        "peak_gb": run["memory"]["peak_bytes"] / 1e9,
        "mask": run.get("mask"),
        "labels": labels,
        "contacts": contacts,
        "violated": sorted(run["violated"]),
    }


def listed(name: str) -> Callable[[Path], Any]:
    """Everything in a JSON file that a benchmark wrote."""
    return lambda folder: json.loads((folder / name).read_text())


def comparison(folder: Path) -> dict[str, Any]:
    """Reference, and meshes by pipeline and order, of the comparison in `compared`."""
    report = json.loads((folder / "compared" / "report.json").read_text())
    meshes: dict[str, dict[str, Any]] = {}
    for order, results in (("1", report["pipelines"]), ("2", report["quadratic"])):
        for result in results:
            if result["median"] is None:
                raise SystemExit(f"measure: {result['name']}: {result['failure']}")
            run = result["median"]
            times = {"seconds": run["seconds_total"], "peak_gb": run["peak_bytes"] / 1e9}
            meshes.setdefault(result["name"], {})[order] = (
                mesh_summary(run, report["options"]["average"]) | times
            )
    return {"reference": report["reference"], "meshes": meshes}


def mesh_summary(measured: dict[str, Any], average: str) -> dict[str, Any]:
    """Numbers that pages quote of one mesh of a comparison; errors by nu and average."""
    quality = measured["quality"]
    return {
        "nodes": measured["n_nodes"],
        "cells": measured["n_cells"],
        "E_D": measured["E_D_fraction"],
        **{key: quality[key] for key in ("mean_rho", "p1_rho", "min_dihedral", "p1_dihedral")},
        "bad": sum(quality["kinds"].values()) / quality["n_cells"],
        "cond": {nu: solution["cond"] for nu, solution in measured["fem"].items()},
        "cg_iterations": {
            nu: solution["cg_iterations"] for nu, solution in measured["fem"].items()
        },
        "errors": {nu: {average: solution["errors"]} for nu, solution in measured["fem"].items()},
        "labels": {str(row["label"]): {"dice": row["dice"]} for row in measured["labels"]},
    }


def benchmark(folder: Path) -> dict[str, Any]:
    """Rows of scripts/benchmark.py, with a summary of the head's run."""
    rows = json.loads((folder / "bench.json").read_text())
    rows["head"]["run"] = run_summary(rows["head"]["run"])
    return rows


class Measurement(NamedTuple):
    """Commands, run in a folder of their own, and the function that reads the rows from their
    files.
    """

    # $NAME: an image's path, or a program's; as words of a shell, which is not used
    commands: tuple[str, ...]
    rows: Callable[[Path], Any]


COMPARED = "-o compared --repeats 1"
WILD = "compared/pytetwild.vtu"  # its mesh
CGAL = "--pipeline 'cgal=$PYTHON $CGAL_LABELS {labels} -o {output} --size {size}'"
MEASUREMENTS = {
    "mni152": Measurement(
        (
            f"tetopt compare $T1 {COMPARED} --nodes 5000 --pipelines "
            f"tetopt,tetopt-uniform,pytetwild,bcc {CGAL} "
            "--reference-dofs 1000000",
        ),
        comparison,
    ),
    "tissues": Measurement(
        (
            f"tetopt compare $T1 --labels $TISSUES {COMPARED} --nodes 5000 --pipelines "
            f"tetopt,pytetwild {CGAL} "
            "--reference-dofs 1000000",
        ),
        comparison,
    ),
    "images": Measurement(
        tuple(
            f"tetopt mesh ${name} -o {name}.vtu --json {name}.json --nodes 5000 --force"
            for name in ("T1", "COLIN27", "FLAIR", "PROSTATE", "CT", "LUNG", "MR_SLAB")
        ),
        runs,
    ),
    "counts": Measurement(
        (
            "tetopt mesh $T1 -o n15000.vtu --json n15000.json --nodes 15000 --force",
            "tetopt mesh $T1 -o n40000.vtu --json n40000.json --nodes 40000 --force",
        ),
        runs,
    ),
    "improved": Measurement(
        (
            f"tetopt compare $CT {COMPARED} --nodes 5000 --pipelines pytetwild "
            "--reference-dofs 1000",
            f"tetopt mesh $CT -o better.vtu --start {WILD} --json better.json --force",
            f"tetopt mesh $CT -o closer.vtu --start {WILD} --k-d 0.2 --json closer.json --force",
        ),
        runs,
    ),
    "labels": Measurement(
        (
            "tetopt mesh $TISSUES --labels $TISSUES -o tissues.vtu --json tissues.json --nodes "
            "15000 --force",
            "tetopt mesh $TISSUES --labels $TISSUES --background 0 -o within.vtu --json "
            "within.json --nodes 15000 "
            "--force",
            "tetopt mesh $CT_SLAB --labels $CT_LABELS -o organs.vtu --json organs.json --nodes "
            "5000 --force",
        ),
        runs,
    ),
    "masks": Measurement(
        (
            "tetopt mesh $HIPPOCAMPUS --background 0 -o hippocampus.vtu --json hippocampus.json "
            "--nodes 1500 --force",
            "tetopt mesh $T1 --background 0 -o brain.vtu --json brain.json --nodes 15000 --force",
        ),
        runs,
    ),
    "edges": Measurement(
        (
            "python benchmarks/default_sizes.py $CT $PROSTATE -o edges.json --orders 1 "
            "--ratios 1.4 1.15 1.0",
        ),
        listed("edges.json"),
    ),
    "averages": Measurement(
        (
            "python benchmarks/choose_average.py -o averages.json --dofs 150000 $T1 $CT_SLAB "
            "--phantoms ellipsoids_brain --averages mean geometric harmonic hill gauss --force",
        ),
        listed("averages.json"),
    ),
    "curved": Measurement(
        ("python benchmarks/curved_cells.py -o curved.json $HIPPOCAMPUS",),
        listed("curved.json"),
    ),
    "accuracy": Measurement(
        (
            "python scripts/accuracy.py -o accuracy.json $T1 --cgal $CGAL --head $HEAD "
            "--cgal-sized $CGAL_SIZED --force",
        ),
        listed("accuracy.json"),
    ),
    "speed": Measurement(
        (
            "python scripts/benchmark.py -o bench.json --cgal $CGAL --cgal-sized $CGAL_SIZED "
            "--head $HEAD --force",
        ),
        benchmark,
    ),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, keep the rows, and write the pages; 2 with one line if an image or a program is
    missing.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, nargs="?", help="folder with the images")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=[*MEASUREMENTS],
        default=[*MEASUREMENTS],
        help="what to measure",
    )
    parser.add_argument(
        "--pages", action="store_true", help="write the pages from the numbers in measured.json"
    )
    parser.add_argument(
        "--folder",
        type=Path,
        default=ROOT / "measured",
        help="where runs write files (%(default)s)",
    )
    for name, words in PROGRAMS.items():
        parser.add_argument(f"--{name.lower().replace('_', '-')}", type=Path, dest=name, help=words)
    options = parser.parse_args(argv)
    if not options.pages:
        if options.data is None:
            parser.error("expected the folder with the images, got none; give it, or use --pages")
        given = {name: options.data / file for name, file in FILES.items()}
        given |= {
            name: getattr(options, name) for name in PROGRAMS if getattr(options, name) is not None
        }
        paths = {name: str(path.resolve()) for name, path in given.items() if path.is_file()}
        needed = {name: words_of(name) for name in options.only}
        paths["PYTHON"] = sys.executable
        missing = {each for words in needed.values() for each in words} - set(paths)
        if missing:
            print(
                f"measure: expected a file for each of {', '.join(sorted(missing))}, got none",
                file=sys.stderr,
            )
            return 2
        for name in options.only:
            measure(name, paths, options.folder / name)
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
    return 0


def words_of(name: str) -> set[str]:
    """Names of the images and programs in a measurement's commands."""
    return set(re.findall(r"\$([A-Z0-9_]+)", " ".join(MEASUREMENTS[name].commands)))


# Measuring.


def measure(name: str, paths: dict[str, str], folder: Path) -> None:
    """Run a measurement's commands, and replace its entry in `DATA`."""
    # of an earlier measurement, whose outputs would be rejected or read again
    if (folder / LOG).exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    entry: dict[str, Any] = {
        "version": tetopt.__version__,
        "commit": commit(),
        "date": f"{datetime.date.today()}",
    }
    entry |= {"machine": machine(), "load": os.getloadavg()[0], "commands": []}
    for command in MEASUREMENTS[name].commands:
        words = [Template(word).substitute(paths) for word in shlex.split(command)]
        print(f"{name}: {command}", flush=True)
        before, begin = os.times(), time.perf_counter()
        with (folder / LOG).open("a") as log:
            code = subprocess.run(runnable(words), cwd=folder, stdout=log, stderr=log).returncode
        # A mesh that violates a requirement (1) is measured, and its row names it; a program that
        # failed is not.
        if code != 0 and not (code == 1 and words[:2] == ["tetopt", "mesh"]):
            raise SystemExit(
                f"measure: {name}: exit code {code} of {shlex.join(words)}; see {folder / LOG}"
            )
        after, wall = os.times(), time.perf_counter() - begin
        cpu = sum(after[2:4]) - sum(before[2:4])
        entry["commands"].append({"command": command, "wall": wall, "cpu": cpu})
    entry["rows"] = MEASUREMENTS[name].rows(folder)
    everything = json.loads(DATA.read_text()) if DATA.exists() else {}
    save_json(DATA, rounded(everything | {name: entry}))
    if name in PICTURES:
        save_picture(folder, *PICTURES[name])


def save_picture(folder: Path, drawn: str, name: str) -> None:
    """Put a picture that a measurement drew into docs/pictures, with few colours."""
    shrink = [
        ROOT / "docs" / "draw_documents.py",
        "-o",
        folder,
        "--force",
        "--shrink",
        folder / drawn,
    ]
    subprocess.run([sys.executable, *map(str, shrink)], check=True)
    shutil.copyfile(folder / Path(drawn).name, ROOT / "docs" / "pictures" / name)


def runnable(words: list[str]) -> list[str]:
    """The command with this Python, and with the project's own scripts by their whole paths."""
    first = {"tetopt": [sys.executable, "-m", "tetopt"], "python": [sys.executable]}[words[0]]
    return [
        *first,
        *(str(ROOT / word) if (ROOT / word).suffix == ".py" else word for word in words[1:]),
    ]


def commit() -> str:
    """The commit that is measured, with `+` where files differ from it, other than those that
    this script writes.
    """
    git, written = (
        ["git", "-C", str(ROOT)],
        (
            ":!docs/measured",
            ":!docs/pictures",
            *(f":!{path.relative_to(ROOT)}" for path in DOCUMENTS),
        ),
    )
    name = subprocess.run(
        [*git, "rev-parse", "--short", "HEAD"], check=True, capture_output=True, text=True
    ).stdout
    differs = (
        subprocess.run([*git, "diff", "--quiet", "HEAD", "--", ":/", *written]).returncode != 0
    )
    return name.strip() + "+" * differs


def machine() -> str:
    """The machine in words."""
    models = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text()) or [
        platform.processor()
    ]
    memory = psutil.virtual_memory().total / 1e9
    return (
        f"{os.cpu_count()} cores ({models[0]}), {memory:.0f} GB, Python {platform.python_version()}"
    )


def rounded(value: Any) -> Any:
    """The same with floats of six digits."""
    if isinstance(value, dict):
        return {key: rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [rounded(one) for one in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


# Writing.


def pages() -> dict[Path, str]:
    """Text of each page, and of `DOCUMENTS`, from the templates and `DATA`."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= STYLES
    measured = json.loads(DATA.read_text())
    environment.globals |= {
        "m": measured,
        "about": lambda *names: about(measured, names),
        "head": head,
        "line": line,
    }
    documents = {path.name: path for path in DOCUMENTS}
    texts = {}
    for template in sorted(TEMPLATES.glob("*.md")):
        text = environment.get_template(template.name).render()
        path = documents.get(template.name, PAGES / template.name)
        if path in DOCUMENTS:
            before, rest = path.read_text(encoding="utf-8").split(MARKS[0])
            text = f"{before}{MARKS[0]}\n\n{text}\n{MARKS[1]}{rest.split(MARKS[1])[1]}"
        texts[path] = text
    return texts


def about(measured: dict[str, Any], names: Sequence[str]) -> str:
    """Where the numbers of these measurements come from: a line, then their commands."""
    entries = [measured[name] for name in names]
    commits = ", ".join(dict.fromkeys(entry["commit"] for entry in entries))
    stamps = dict.fromkeys(f"{long_date(entry['date'])}; {entry['machine']}" for entry in entries)
    versions = ", ".join(dict.fromkeys(entry["version"] for entry in entries))
    origin = f"Written by `make measured`: tetopt {versions} ({commits}), {'; '.join(stamps)}."
    commands = [broken(row["command"]) for entry in entries for row in entry["commands"]]
    return "\n".join([origin, "", "```bash", *commands, "```"])


def broken(command: str) -> str:
    """A command in lines of at most 95 characters."""
    lines, line = [], ""
    for word in shlex.split(command):
        word = shlex.quote(word) if not re.fullmatch(r"[$\w./,:=-]+", word) else word
        if len(line) + len(word) > 90:
            lines, line = [*lines, line + " \\"], "   "
        line = f"{line} {word}" if line else word
    return "\n".join([*lines, line])


def long_date(date: str) -> str:
    """The date as the documents write it."""
    day = datetime.date.fromisoformat(date)
    return f"{day.day} {day:%B %Y}"


def head(*titles: str) -> str:
    """The first two lines of a table."""
    return f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}"


def line(
    title: str,
    rows: dict[str, Any],
    names: Sequence[str],
    path: str,
    style: str = "f",
    *digits: int,
) -> str:
    """A row of a table: of each of the named rows, the value at a path of keys with slashes
    between.

    A mesh that could not be compressed has empty `errors` and `cond`, and a dash.
    """
    values = [
        reduce(lambda value, key: value and value[key], path.split("/"), rows[name])
        for name in names
    ]
    words = ["–" if value == {} else STYLES[style](value, *digits) for value in values]
    return f"| {title} | {' | '.join(words)} |"


def fixed(value: float | None, digits: int = 3) -> str:
    """A number with so many decimals; empty for none."""
    return "" if value is None else f"{value:.{digits}f}"


def percent(value: float | None, digits: int = 0) -> str:
    """A fraction in per cent."""
    return "" if value is None else f"{100.0 * value:.{digits}f} %"


def thousands(value: float) -> str:
    """A whole number with commas."""
    return f"{round(value):,}"


STYLES: dict[str, Callable[..., str]] = {"f": fixed, "p": percent, "n": thousands}


if __name__ == "__main__":
    sys.exit(main())
