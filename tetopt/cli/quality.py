"""``tetopt quality``: measure a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from tetopt.cli.console import out, print_fidelity
from tetopt.cli.options import NumberOptions, option
from tetopt.job.judge import Judgement, judge
from tetopt.job.options import ImagePart, LabelNamesOption
from tetopt.job.source import Source, whose_variance
from tetopt.measure.fidelity import ImageFit
from tetopt.report.tables import add_quality, new_table
from tetopt.system.files import save_json


def quality_command(
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="VTU, VTK or MSH file of tetrahedra or triangles.")],
    image_path: Annotated[Path | None, option("IMAGE", "Measure E_D against this image, too.", "--image")] = None,
    mask_path: Annotated[
        Path | None, option("MASK", "How well the boundary follows it; with --image.", "--mask")
    ] = None,
    labels_path: Annotated[
        Path | None, option("LABELS", "How well cells keep to them; with --image.", "--labels")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Is it a mesh, with a manifold boundary? With --image, does it fill the box, and meet what its "
            "run was asked for? Exit 1 if not.",
        ),
    ] = False,
    label_names: LabelNamesOption = None,
    *,
    part: ImagePart,
    numbers: NumberOptions,
) -> int:
    """Measure a mesh: shape, angles, bad cells, and how well its cells fit an image."""
    json_path = numbers.checked()
    came = judge(mesh_path, image_path, mask_path, labels_path, part=part, label_names=label_names, check=check)
    if json_path is not None:
        save_json(json_path, came.numbers)
    size, source = came.numbers["size"], came.source
    table = new_table("", escape(mesh_path.name))
    add_quality(table, came.shape, in_all=[size["n_nodes_in_all"]] if came.loaded.order == 2 else [])
    if source is not None and came.fit is not None:
        _add_fit(table, came.fit, source, came.left_out)
    out.print(table)
    print_fidelity(came.measured, came.loaded.mesh.ndim, "mask" if source is None else source.mask_word)
    if check and not came.numbers["problems"]:
        out.print(f"checked: conforming, oriented{_checked_words(came)}")
    return int(bool(came.tell()))


def _checked_words(came: Judgement) -> str:
    """What a mesh that is sound was looked at for besides."""
    if came.is_masked:
        return "; made within a mask, which may have several components"
    return ", in one piece" + (", fills the box" if came.source is not None and came.is_filled else "")


def _add_fit(table: Table, fit: ImageFit, source: Source, left_out: list[str]) -> None:
    """Rows of how well cells fit an image, without what the run that made the mesh had besides."""
    table.add_row("E_D", f"{fit.E_D:.6g}")
    if fit.E_D_fraction_of_variance is not None:
        words = f", without its {' and '.join(left_out)}" if left_out else ""
        table.add_row(
            f"E_D, fraction of {whose_variance(source.content)}{words}", f"{fit.E_D_fraction_of_variance:.5f}"
        )
    table.add_row("voxels inside", f"{fit.n_voxels} of {source.contrasts[0].data.size}")
    table.add_row("cells without a voxel", str(fit.n_empty_cells))
