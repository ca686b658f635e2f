"""``tetopt mesh`` and ``tetopt demo``."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Annotated

from tetopt.cli.console import print_fidelity, print_line, print_table, print_verdict
from tetopt.cli.ending import is_ended, mesh_kept, tell_end
from tetopt.cli.options import ForceOption
from tetopt.cli.run import Display
from tetopt.cli.solver import print_model
from tetopt.engine.loop import DEFAULT_NODES, TARGET_NODES_MAX
from tetopt.engine.meshing import process_bytes
from tetopt.io.mni import mni_path
from tetopt.job.job import Job
from tetopt.job.options import Option, given_options, has_model
from tetopt.job.plan import expected_nodes, stated_options
from tetopt.job.read import read
from tetopt.job.run import Result, run
from tetopt.job.source import whose_variance
from tetopt.job.task import Task
from tetopt.report.summary import size_summary
from tetopt.report.tables import add_quality, new_table, nodes_in_words
from tetopt.system.budget import memory_words
from tetopt.system.files import results_folder


def mesh_command(
    job: Job,
    dry_run: Annotated[
        bool, Option(None, "Read the files and show the plan and its memory; mesh nothing.")
    ] = False,
) -> int:
    """Mesh an image with optimised elements, smaller where it has detail (or uniform), as VTU or
    for a solver.
    """
    if dry_run:
        _print_plan(read(job))
        return 0
    with mesh_kept() as begin_keeping, closing(Display(begin_keeping)) as display:
        result = run(job, display, display.is_over)
        display.end_stage()
        _print(result)
        display.close()  # the mesh's problems, before the last line
        size = f"{nodes_in_words(result.mesh, result.model.order)}, {len(result.mesh.cells)} cells"
        code = tell_end() if is_ended() else int(bool(result.violated))
        print_verdict(
            result.violated, f"{job.output}: {size}", result.measured, result.task.source.mask_word
        )
        return code


def _print_plan(task: Task) -> None:
    """Print what a run would read, do and write, with its memory."""
    plan, content = task.plan, task.source.content
    job, image = plan.job, task.source.contrasts[0]
    nodes = expected_nodes(plan, content) if task.started is None else len(task.started.mesh.points)
    shape = " x ".join(map(str, image.shape))
    spacing = " x ".join(f"{each:.4g}" for each in image.spacing)
    if job.target_error is not None:
        nodes = job.nodes_max or TARGET_NODES_MAX
    most = "" if job.target_error is None else f"up to, for an error of {job.target_error:g}: "
    files = (*task.request["files"].items(),)
    options = stated_options(plan, image.ndim)
    known = {name.lower() for name in options}
    left_out = {name for name, _ in files} | {"output", "json", "figures", "force", "nodes"}
    for name, value in given_options(plan.bare).items():
        if name.replace("-", "_") not in known:
            options[name] = value
    lines = {
        "reads": "; ".join(f"{name} {', '.join(each for each, _ in rows)}" for name, rows in files),
        "voxels": f"{shape} of {spacing} mm, {content.n_voxels} to mesh",
        "nodes": f"{most}{nodes}",
        "memory": f"about {memory_words(process_bytes(content, nodes))}",
        "time": "unknown; a run tells it from its third iteration on",
        "options": ", ".join(
            f"{name} {value}"
            for name, value in options.items()
            if value is not None and name not in left_out
        ),
        "writes": ", ".join(
            str(path) for path in (job.output, job.json_path, *plan.pictures) if path is not None
        ),
    }
    for name, words in lines.items():
        print_line(f"{name}: {words}")


def _print(result: Result) -> None:
    """Print the comparison.

    All files are written before, as standard output may be a pipe that closes.
    """
    task = result.task
    model = result.model
    measured = result.measured
    job = task.plan.job
    _print_comparison(result, measured.get("cells_without_voxel", 0))
    print_fidelity(measured, model.mesh.ndim, task.source.mask_word)
    if has_model(job) or job.output.suffix.lower() != ".vtu":
        print_model(job.output, model, job)
    if job.json_path is not None:
        print_line(f"{job.json_path}: every number of the run")
    for path in task.plan.pictures:
        print_line(str(path))


def _print_comparison(result: Result, n_empty: int) -> None:
    content = result.task.source.content
    order = result.model.order
    first = result.optimized.history[0]
    table = new_table("", result.task.start_name, "optimised")
    names = ("E_D_fraction_of_variance_initial", "E_D_fraction_of_variance")
    left = [result.numbers["energies"][name] for name in names]
    if first.E_D > 0.0 and None not in left:
        table.add_row(
            f"E_D, fraction of {whose_variance(content)}", *(f"{fraction:.5f}" for fraction in left)
        )
    meshes = (result.meshed.initial, result.mesh)
    in_all = [size_summary(each, order)["n_nodes_in_all"] for each in meshes] if order == 2 else []
    first_shape, last_shape = result.shapes
    if first_shape is not None and last_shape is not None:
        add_quality(
            table,
            first_shape,
            last_shape,
            in_all=in_all,
            is_curved=result.mesh.midpoints is not None,
        )
    if n_empty:
        table.add_row("cells without a voxel centre", "", str(n_empty))
    print_table(table)


def demo_command(
    output: Annotated[Path, Option("DIR", "Folder for the results.", letter="o")] = Path("demo"),
    nodes: Annotated[int, Option("N", "Target number of nodes.")] = DEFAULT_NODES[3],
    iterations: Annotated[int | None, Option("I", "Sweeps over all nodes.", least=0)] = None,
    force: ForceOption = False,
) -> int:
    """Mesh the MNI152 T1 that comes with nilearn; write mesh, numbers and pictures to a folder."""
    folder = results_folder(output)
    return mesh_command(
        Job(
            images=[mni_path("t1")],
            output=folder / "mesh.vtu",
            json_path=folder / "run.json",
            figures=folder,
            nodes=nodes,
            iterations=iterations,
            force=force,
        )
    )
