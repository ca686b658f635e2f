"""``tetopt baseline``, ``compare`` and ``paper``: beside the conventional pipelines, and beside the paper."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

import tetopt
from tetopt import Image, InputError, save_mesh
from tetopt.cli.console import log, out, print_wide, say
from tetopt.cli.options import (
    AverageOption,
    ForceOption,
    ImageArgument,
    LabelNamesOption,
    NumberOptions,
    option,
)
from tetopt.io.images import sha256
from tetopt.io.mni import mni_path, mni_tissue
from tetopt.job.inputs import checked_outputs, label_table, read_labels, read_volume
from tetopt.job.options import DEFAULT_NODES, WHOLE_BOX, BoxPart
from tetopt.measure.fidelity import image_fit
from tetopt.measure.quality import quality
from tetopt.model.averages import parse_average
from tetopt.model.fields import cell_fields
from tetopt.model.labels import table_of_labels
from tetopt.model.mappings import parse_mapping
from tetopt.report.tables import add_quality, new_table
from tetopt.study.compare_criteria import number_text
from tetopt.study.compare_headline import Headline, headline
from tetopt.study.compare_report import ImageSource, LabelSource, Settings
from tetopt.study.pipelines import PIPELINES, PipelineInput
from tetopt.study.program import Program, parse_program
from tetopt.system.budget import BYTES_PER_GB
from tetopt.system.files import checked_output, results_folder, save_json

ClassesOption = Annotated[int, option("K", "Classes of the segmentation (multi-Otsu).", min=2)]


DEFAULT_SETTINGS = Settings(nodes=DEFAULT_NODES[3])


@dataclass(frozen=True, kw_only=True)
class ComparedOptions:
    """What is compared."""

    panel: ClassVar[str] = "What is compared"
    nodes: Annotated[int, option("N", "Wanted number of nodes, of every mesh.", min=20)] = DEFAULT_SETTINGS.nodes
    labels: Annotated[Path | None, option("LABELS", "Label image, for tetopt and the pipelines that segment.")] = None
    label_names: LabelNamesOption = None
    repeats: Annotated[int, option("R", "Runs of a mesher whose result varies.", min=1)] = DEFAULT_SETTINGS.repeats
    pipelines: Annotated[str, option("A,B,...", f"Of {', '.join(PIPELINES)}: which, in order.")] = ",".join(PIPELINES)
    programs: Annotated[
        list[str] | None,
        option(
            "NAME=COMMAND",
            "A program as one more pipeline: 'NAME=program {image} {labels} {nodes} {output}'.",
            "--pipeline",
        ),
    ] = None
    k_D: Annotated[float, option("K", "Weight of the image on uniform meshes.", "--k-d")] = DEFAULT_SETTINGS.k_D
    classes: ClassesOption = DEFAULT_SETTINGS.classes
    curve: Annotated[str, option("F,...", "Node counts of the error curves, as parts of N; empty for none.")] = (
        ",".join(f"{factor:g}" for factor in DEFAULT_SETTINGS.curve)
    )
    tradeoff: Annotated[
        bool, typer.Option("--tradeoff", help="Sweep tetopt's options around its defaults: some 20 more runs.")
    ] = False
    part: BoxPart = WHOLE_BOX


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """The simulation that meshes are measured by."""

    panel: ClassVar[str] = "The simulation"
    young: Annotated[
        str | None, option("MAPPING", "Modulus by intensity, as for `fem`. Default: 1 to 10 kPa over its range.")
    ] = None
    average: AverageOption = DEFAULT_SETTINGS.average
    reference_seconds: Annotated[
        float | None, option("S", "Time for the voxel grid that is the truth; it is as fine as fits. Default: 120.")
    ] = None
    reference_dofs: Annotated[int | None, option("D", "Size of that grid exactly, instead of a time.", min=1000)] = (
        DEFAULT_SETTINGS.reference_dofs
    )


@dataclass(frozen=True, kw_only=True)
class LimitOptions:
    """What one run of a pipeline may take."""

    panel: ClassVar[str] = "Limits"
    max_seconds: Annotated[float, option("S", "Time limit of one run of a pipeline.")] = DEFAULT_SETTINGS.max_seconds
    max_gb: Annotated[float | None, option("GB", "Memory limit of one run of a pipeline.")] = None


def paper_command(
    output: Annotated[Path, option("DIR", "Folder for the results.", "-o", "--output")],
    image_path: Annotated[
        Path | None, option("T1", "Brain MR volume (default: nilearn's MNI152 T1).", "--image")
    ] = None,
    labels_path: Annotated[Path | None, option("LABELS", "Tissue labels of IMAGE, for Dice.", "--labels")] = None,
    seeds: Annotated[int, option("N", "Random meshes for Fig. 1.")] = 200,
    force: ForceOption = False,
) -> int:
    """Run the paper's figures and table again: paper.json, pictures, a page with each printed number beside ours."""
    from tetopt.study import paper_files

    if seeds < 1:
        raise InputError(f"--seeds: expected 1 or more, got {seeds}")
    source = mni_path("t1") if image_path is None else image_path
    volume = read_volume(source)
    tissue, labels_name = None, None
    if labels_path is not None:
        tissue, labels_name = read_labels(labels_path, volume), labels_path.name
    elif image_path is None:
        tissue, labels_name = mni_tissue(), "MNI152 tissue"
    paper_files.check_inputs(volume, tissue)
    if tissue is None:
        log.print("no --labels: the section on approximate segmentation is left out")
    paths = checked_outputs(results_folder(output), paper_files.PAPER_FILES, force)
    about = {"image": source.name, "image_sha256": sha256(source), "labels": labels_name}
    results = paper_files.run(paths, about, volume, tissue, seeds, say)
    out.print(escape(f"{paths['paper.html']}: the paper's numbers beside ours, in {results['seconds']:.0f} s"))
    return 0


def baseline_command(
    image_path: ImageArgument,
    output: Annotated[Path, option("MESH.vtu", "The mesh to write.", "-o", "--output")],
    pipeline: Annotated[
        Literal["pytetwild", "cleaver"], typer.Option(help="The mesher of the conventional pipeline.")
    ] = "pytetwild",
    nodes: Annotated[int, option("N", "Wanted number of nodes.", min=20)] = DEFAULT_NODES[3],
    labels_path: Annotated[
        Path | None, option("LABELS", "Label image instead of a segmentation of IMAGE.", "--labels")
    ] = None,
    classes: ClassesOption = DEFAULT_SETTINGS.classes,
    *,
    part: BoxPart,
    numbers: NumberOptions,
) -> int:
    """Mesh an image the conventional way, to compare with: segment, extract surfaces, tetrahedralise."""
    from tetopt.study.child import run_in_child

    output = checked_output(output, (".vtu",), numbers.force)
    json_path = numbers.checked()
    image, labels = _image_and_labels(image_path, labels_path, part)
    title, function = PIPELINES[pipeline].title, PIPELINES[pipeline].function
    job = PipelineInput(image, labels, nodes, classes)
    made = run_in_child(function, job, say=lambda line: say(f"{title}: {line}"))
    if made.mesh is None:
        raise InputError(f"{title}: {(made.failure or '').removeprefix(f'{title}: ')}")
    shape = quality(made.mesh.points, made.mesh.cells)
    options = {"pipeline": pipeline, "nodes": nodes, "classes": classes}
    about = {"image": image_path.name, "image_sha256": sha256(image_path), "options": options}
    save_mesh(output, made.mesh, cell_fields(made.mesh, image), {"tetopt": tetopt.__version__, **about})
    if json_path is not None:
        fit = image_fit(image, made.mesh)
        save_json(json_path, about | {"seconds": made.seconds, "notes": made.notes, "fit": fit, "quality": shape})
    for note in made.notes:
        say(f"note: {note}")
    table = new_table("", escape(output.name))
    add_quality(table, shape)
    for step, seconds in made.seconds.items():
        table.add_row(f"seconds, {step}", f"{seconds:.1f}")
    out.print(table)
    return 0


def compare_command(
    context: typer.Context,
    image_path: ImageArgument,
    output: Annotated[Path, option("DIR", "Folder for the results.", "-o", "--output")],
    compared: ComparedOptions,
    simulation: SimulationOptions,
    limits: LimitOptions,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep the finished runs of an interrupted comparison.")
    ] = False,
    force: ForceOption = False,
) -> int:
    """Set tetopt beside the conventional pipelines on a volume: fidelity, shape, simulation accuracy, time."""
    from tetopt.study import compare, compare_files

    settings = _settings(compared, simulation, limits)
    part, labels_path, young = compared.part, compared.labels, simulation.young
    image, labels = _image_and_labels(image_path, labels_path, part)
    mapping, mapping_words = compare.default_mapping(image) if young is None else (parse_mapping(young), young)
    comparison = compare.Comparison(
        image, labels, mapping, settings, ImageSource(image_path.name, sha256(image_path), part.volume, part.crop),
        _label_source(labels_path, labels, compared.label_names), mapping_words,
        command=f"tetopt {' '.join(map(shlex.quote, context.obj))}",
    )  # fmt: skip
    paths = checked_outputs(results_folder(output), compare_files.COMPARE_FILES, force or resume)
    if (output / "runs").is_dir() and not (resume or force):
        raise InputError(f"{output / 'runs'}: finished runs are there; --resume keeps them, --force starts over")
    try:
        report = compare_files.run(paths, comparison, say, resume=resume)
    except KeyboardInterrupt:
        log.print(f"interrupted: {escape(str(output / 'runs'))} keeps the finished runs, --resume goes on from there")
        return 130
    _print_headline(headline(report))
    out.print(escape(f"{paths['report.html']}: {len(settings.pipelines)} pipelines, {report.seconds:.0f} s"))
    return 0


def _print_headline(first: Headline) -> None:
    """The page's first section: who was compared, the few numbers, where tetopt is behind, and what to know of it."""
    out.print(escape(first.title))
    for title, claims in (("", first.claims), ("behind a peer", first.behind_peers())):
        if claims:
            table = Table(title=title, box=None, title_justify="left")
            for heading in ("", "tetopt", "best peer", "", "tetopt over it", "", "  "):
                table.add_column(heading, justify="left" if not heading.strip() else "right")
            for each in claims:
                numbers = (number_text(each.ours.value), number_text(each.other.value))
                words = (escape(each.other_title), each.ratio_words, each.verdict, escape("; ".join(each.beside)))
                table.add_row(escape(each.measure), *numbers, *words)
            print_wide(table)
    for line in first.remarks:
        out.print(escape(line))


def _image_and_labels(path: Path, labels_path: Path | None, part: BoxPart) -> tuple[Image, Image | None]:
    """The volume, and labels on its voxels, if they are given."""
    image = read_volume(path, part)
    return image, None if labels_path is None else read_labels(labels_path, image, part)


def _label_source(path: Path | None, labels: Image | None, names: Path | None) -> LabelSource | None:
    """The labels' file, and what those in it are called; InputError for names of labels that there are not."""
    if names is not None and labels is None:
        raise InputError("--label-names: there are no --labels")
    if path is None or labels is None:
        return None
    there = table_of_labels(label_table(names), np.unique(labels.data).astype(np.int64).tolist())
    return LabelSource(path.name, "given", sha256(path), there.names)


def _settings(compared: ComparedOptions, simulation: SimulationOptions, limits: LimitOptions) -> Settings:
    """What is compared and how; InputError for a number out of range."""
    if not 0.0 <= compared.k_D < 1.0:
        raise InputError(f"--k-d: expected 0 <= k_D < 1, got {compared.k_D}")
    for name, limit in (("--max-seconds", limits.max_seconds), ("--max-gb", limits.max_gb)):
        if limit is not None and not 0.0 < limit < float("inf"):
            raise InputError(f"{name}: expected more than 0, got {limit}")
    parse_average(simulation.average)
    seconds = simulation.reference_seconds
    if seconds is not None and simulation.reference_dofs is not None:
        raise InputError("--reference-seconds: --reference-dofs sets the size of the reference already; give one")
    if seconds is not None and not 0.0 < seconds < float("inf"):
        raise InputError(f"--reference-seconds: expected more than 0, got {seconds}")
    programs = _programs(compared.programs or [])
    names = [name.strip() for name in compared.pipelines.split(",")]
    names += [each.name for each in programs if each.name not in names]
    return Settings(
        nodes=compared.nodes, pipelines=tuple(names), programs=programs,
        repeats=compared.repeats, classes=compared.classes, k_D=compared.k_D,
        reference_dofs=simulation.reference_dofs,
        reference_seconds=DEFAULT_SETTINGS.reference_seconds if seconds is None else seconds,
        curve=_parse_curve(compared.curve), tradeoff=compared.tradeoff,
        average=simulation.average, max_seconds=limits.max_seconds,
        max_bytes=None if limits.max_gb is None else int(limits.max_gb * BYTES_PER_GB),
    )  # fmt: skip


def _programs(texts: list[str]) -> tuple[Program, ...]:
    """The user's own pipelines; InputError for one that cannot be run, or a name that there is already."""
    programs = tuple(map(parse_program, texts))
    names = [*PIPELINES, *(each.name for each in programs)]
    if twice := [name for number, name in enumerate(names) if name in names[:number]]:
        raise InputError(f'--pipeline: there is a pipeline named "{twice[0]}" already; give it another name')
    return programs


def _parse_curve(text: str) -> tuple[float, ...]:
    try:
        factors = tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        factors = (0.0,)
    if any(not 0.0 < factor < 100.0 for factor in factors):
        raise InputError(f'--curve: expected parts of the node count, such as "0.25,0.5,2", got "{text}"')
    return factors
