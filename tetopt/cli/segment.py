"""``tetopt segment``: segment an image by its mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.markup import escape

import tetopt
from tetopt import InputError, save_image
from tetopt.cli.console import out, show_warning
from tetopt.cli.inputs import check_no_input, read_image, read_labels, read_mesh, warn_of_other_image
from tetopt.cli.options import CropOption, ForceOption, ImageArgument, JsonOption, SliceOption, VolumeOption
from tetopt.io.files import checked_output, save_json
from tetopt.report.tables import new_table


def segment_command(
    image_path: ImageArgument,
    mesh_path: Annotated[Path, typer.Argument(metavar="MESH", help="VTU, VTK or MSH file over the image.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LABELS.nii.gz", help="The labels to write.")],
    classes: Annotated[int, typer.Option(metavar="K", min=2, help="Number of classes, by rising mean.")] = 4,
    truth_path: Annotated[
        Path | None, typer.Option("--truth", metavar="LABELS", help="True labels: print the Dice overlap with them.")
    ] = None,
    volume: VolumeOption = None,
    crop: CropOption = None,
    slice_: SliceOption = None,
    json_path: JsonOption = None,
    force: ForceOption = False,
) -> int:
    """Segment an image by its mesh, fast and roughly: cells grouped by mean into K classes, painted to the voxels."""
    from tetopt.measure.segmentation import dice, segmented, stands_for, thresholded

    output = checked_output(output, (".nii", ".nii.gz"), force)
    check_no_input(output, image_path, truth_path)
    if json_path is not None:
        json_path = checked_output(json_path, (".json",), force)
    image = read_image(image_path, volume, crop, slice_)
    truth = None if truth_path is None else (truth_path.name, read_labels(truth_path, image, crop, slice_))
    loaded = read_mesh(mesh_path)
    warn_of_other_image(loaded, mesh_path, image_path)
    if tetopt.cell_moments(image, loaded.mesh).n_voxels.sum() > image.data.size:
        raise InputError(f"{mesh_path}: its cells overlap: together they hold more voxels than there are")
    outside = int((tetopt.cell_of_voxel(image, loaded.mesh) < 0).sum())
    if outside == image.data.size:
        raise InputError(f"{mesh_path}: no voxel of {image_path} lies in it; was it made from another image?")
    if outside:
        show_warning(f"{outside} of {image.data.size} voxels lie outside the mesh and get class 0")
    labels = segmented(image, loaded.mesh, classes)
    share = np.bincount(labels.data.astype(np.int64).ravel(), minlength=classes) / labels.data.size
    content: dict[str, Any] = {
        "image": image_path.name, "mesh": mesh_path.name, "classes": classes, "share_of_voxels": share
    }  # fmt: skip
    means = [float(image.data[labels.data == number].mean()) if part else None for number, part in enumerate(share)]
    content["mean_intensity"] = means
    table = new_table(
        "class", "share of the voxels", "mean intensity", *([] if truth is None else ["stands for label"])
    )
    meaning = {} if truth is None else stands_for(labels, truth[1])
    for number, part in enumerate(share):
        mean = "" if means[number] is None else f"{means[number]:.4g}"
        table.add_row(str(number), f"{part:.4f}", mean, *([] if truth is None else [str(meaning.get(number, "none"))]))
    overlaps = new_table("label", "Dice, mesh", "Dice, thresholded voxels")
    if truth is not None:
        by_mesh, by_voxels = dice(labels, truth[1]), dice(thresholded(image, classes), truth[1])
        content |= {"truth": truth[0], "stands_for": meaning, "dice": {"mesh": by_mesh, "voxels": by_voxels}}
        lost = [str(label) for label in by_mesh if label not in meaning.values()]
        if lost:
            show_warning(f"no class stands for label {', '.join(lost)}: its Dice is 0; try more --classes")
        for label in by_mesh:
            overlaps.add_row(str(label), f"{by_mesh[label]:.4f}", f"{by_voxels[label]:.4f}")
    save_image(output, labels)
    if json_path is not None:
        save_json(json_path, content)
    out.print(table)
    if truth is not None:
        out.print(overlaps)
    out.print(escape(f"{output}: {classes} classes on {labels.data.size} voxels"))
    return 0
