"""`tetopt baseline`: one mesh by a conventional pipeline, and its numbers."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import tetopt
from tetopt.commands.beside import image_and_labels
from tetopt.errors import InputError
from tetopt.io.formats import save_mesh
from tetopt.io.images import sha256
from tetopt.job.events import note
from tetopt.measure.fidelity import image_fit
from tetopt.measure.quality import Quality, quality
from tetopt.model.fields import cell_fields
from tetopt.study.options import BaselineOptions
from tetopt.study.pipeline_process import run_in_child
from tetopt.study.pipelines import PIPELINES, PipelineInput
from tetopt.system.files import check_output, save_json


class Baseline(NamedTuple):
    """The result of a baseline."""

    output: Path
    quality: Quality
    seconds: dict[str, float]  # by step


def baseline(
    image_path: Path,
    output: Path,
    options: BaselineOptions,
    json_path: Path | None = None,
    force: bool = False,
) -> Baseline:
    """Segment, extract surfaces, tetrahedralise; write the mesh, and its numbers if requested.

    Raises
    ------
    InputError
        An output may not be written, a file cannot be read, or the pipeline fails or is not
        installed.
    """
    output = check_output(output, (".vtu",), force)
    json_path = None if json_path is None else check_output(json_path, (".json",), force)
    image, labels = image_and_labels(image_path, options.labels, options.part)
    title, function = PIPELINES[options.pipeline].title, PIPELINES[options.pipeline].function
    made = run_in_child(
        function, PipelineInput(image, labels, options.nodes, options.classes), title
    )
    if made.mesh is None:
        raise InputError(f"{title}: {(made.failure or '').removeprefix(f'{title}: ')}")
    shape = quality(made.mesh.points, made.mesh.cells)
    chosen = {"pipeline": options.pipeline, "nodes": options.nodes, "classes": options.classes}
    about = {"image": image_path.name, "image_sha256": sha256(image_path), "options": chosen}
    save_mesh(
        output, made.mesh, cell_fields(made.mesh, image), {"tetopt": tetopt.__version__, **about}
    )
    if json_path is not None:
        fit = image_fit(image, made.mesh)
        save_json(
            json_path,
            about | {"seconds": made.seconds, "notes": made.notes, "fit": fit, "quality": shape},
        )
    for each in made.notes:
        note(f"note: {each}")
    return Baseline(output, shape, made.seconds)
