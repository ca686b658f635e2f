"""``tetopt quality``: measure a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rich.markup import escape
from rich.table import Table

from tetopt.cli.console import print_fidelity, print_line, print_table, print_verdict
from tetopt.cli.options import FilesArgument, NumberOptions, mesh_and_image
from tetopt.commands.judgement import Judgement, judge
from tetopt.job.options import LabelNamesOption, MaskedPart, Option
from tetopt.job.source import Source, whose_variance
from tetopt.measure.fidelity import ImageFit
from tetopt.report.tables import add_quality, new_table, nodes_in_words


def quality_command(
    paths: FilesArgument,
    image: Annotated[Path | None, Option("IMAGE", "Also measure E_D against this image.")] = None,
    labels: Annotated[
        Path | None, Option("LABELS", "Compare cells with these labels; needs `image`.")
    ] = None,
    check: Annotated[
        bool,
        Option(
            None,
            "Check that the mesh is valid with a manifold boundary and, with the `image` of its "
            "run, fills the box and meets the run's requirements; exit 1 if not.",
        ),
    ] = False,
    label_names: LabelNamesOption = None,
    every: Annotated[bool, Option(None, "Print all measures, and all labels.", "all")] = False,
    *,
    part: MaskedPart,
    numbers: NumberOptions,
) -> int:
    """Measure a mesh: shape, angles, bad cells, and how well its cells fit an image."""
    numbers.check()
    mesh, image = mesh_and_image(paths, image)
    judgement = judge(mesh, image, labels, part=part, label_names=label_names, check=check)
    numbers.save(judgement.numbers)
    size = judgement.numbers["size"]
    source = judgement.source
    table = new_table("", escape(mesh.name))
    in_all = [size["n_nodes_in_all"]] if judgement.loaded.order == 2 else []
    jacobian = judgement.numbers.get("min_scaled_jacobian")
    is_curved = judgement.loaded.mesh.midpoints is not None
    add_quality(
        table, judgement.shape, in_all=in_all, jacobian=jacobian, every=every, is_curved=is_curved
    )
    if source is not None and judgement.fit is not None:
        _add_fit(table, judgement.fit, source, judgement.left_out, every)
    print_table(table)
    print_fidelity(judgement.measured, judgement.loaded.mesh.ndim, judgement.mask_word, every)
    if labels is not None and judgement.loaded.labels is None:
        print_line(
            "labels of cells: by majority of voxels, as the mesh has none: what cells could follow"
        )
    if check and not judgement.numbers["problems"]:
        print_line(f"checked: conforming, oriented{_check_words(judgement)}")
    wrong = judgement.tell()
    if check:
        whole = (
            f"{nodes_in_words(judgement.loaded.mesh, judgement.loaded.order)}, "
            f"{size['n_cells']} cells"
        )
        which = "all requirements" if source is not None else "requirements that need no image"
        print_verdict(
            judgement.numbers["violated"],
            f"{mesh}: {whole}",
            judgement.measured,
            judgement.mask_word,
            which,
        )
    return int(bool(wrong))


def _check_words(judgement: Judgement) -> str:
    """Describe the other properties for which a valid mesh was checked."""
    if judgement.is_masked:
        return "; meshed within a mask, which may have several components"
    return ", in one piece" + (
        ", fills the box" if judgement.source is not None and judgement.is_filled else ""
    )


def _add_fit(table: Table, fit: ImageFit, source: Source, left_out: list[str], every: bool) -> None:
    """Add rows on how well cells fit an image, and name the inputs of the mesh's run that are
    left out.
    """
    if every:
        table.add_row("E_D", f"{fit.E_D:.6g}")
    if fit.E_D_fraction_of_variance is not None:
        whose = whose_variance(source.content) + (
            f", without its {' and '.join(left_out)}" if left_out else ""
        )
        table.add_row(f"E_D, fraction of {whose}", f"{fit.E_D_fraction_of_variance:.5f}")
    table.add_row("voxels inside", f"{fit.n_voxels} of {source.contrasts[0].data.size}")
    table.add_row("cells without a voxel centre", str(fit.n_empty_cells))
