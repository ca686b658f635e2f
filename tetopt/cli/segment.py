"""``tetopt segment``: segment an image by its mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.markup import escape

import tetopt
from tetopt import Image, InputError, Mesh, save_image
from tetopt.cli.console import out, show_warning
from tetopt.cli.options import ImageArgument, NumberOptions
from tetopt.energy.sampling import overlap_of
from tetopt.job.inputs import read_image, read_labels, read_mesh, warn_of_other_image
from tetopt.job.options import ImagePart, Option
from tetopt.report.tables import new_table
from tetopt.system.files import checked_output


def segment_command(
    image_path: ImageArgument,
    mesh_path: Annotated[Path, Option("MESH", "VTU, VTK or MSH file of the image's mesh.", is_argument=True)],
    output: Annotated[Path, Option("LABELS.nii.gz", "The labels to write.", letter="o")],
    classes: Annotated[int, Option("K", "Number of classes, in order of increasing mean.", least=2)] = 4,
    truth_path: Annotated[
        Path | None, Option("LABELS", "True labels; prints the Dice overlap with them.", "truth")
    ] = None,
    *,
    part: ImagePart,
    numbers: NumberOptions,
) -> int:
    """Segment an image by its mesh, quickly and roughly: group cells by mean into K classes and label their voxels."""
    from tetopt.measure.segmentation import dice, segment, stands_for, thresholded

    output = checked_output(output, (".nii", ".nii.gz"), numbers.force)
    numbers.check()
    image = read_image(image_path, part)
    truth = None if truth_path is None else read_labels(truth_path, image, part)
    mesh = _mesh_over(mesh_path, image, image_path)
    labels = segment(image, mesh, classes)
    fractions = np.bincount(labels.data.astype(np.int64).ravel(), minlength=classes) / labels.data.size
    means = [
        float(image.data[labels.data == number].mean()) if fraction else None
        for number, fraction in enumerate(fractions)
    ]
    report: dict[str, Any] = {
        "image": image_path.name, "mesh": mesh_path.name, "classes": classes, "fraction_of_voxels": fractions,
        "mean_intensity": means,
    }  # fmt: skip
    names = {} if truth is None else stands_for(labels, truth)  # labels by class
    table = new_table("class", "fraction of voxels", "mean intensity", *([] if truth is None else ["matched label"]))
    for number, (fraction, mean) in enumerate(zip(fractions, means, strict=True)):
        last = [] if truth is None else [str(names.get(number, "none"))]
        table.add_row(str(number), f"{fraction:.4f}", "" if mean is None else f"{mean:.4g}", *last)
    overlaps = new_table("label", "Dice, mesh", "Dice, thresholded voxels")
    if truth_path is not None and truth is not None:
        by_mesh, by_voxels = dice(labels, truth), dice(thresholded(image, classes), truth)
        overlap = {"mesh": by_mesh, "voxels": by_voxels}
        report |= {"truth": truth_path.name, "stands_for": names, "dice": overlap}
        if lost := [str(label) for label in by_mesh if label not in names.values()]:
            show_warning(f"no class matches label {', '.join(lost)}: its Dice is 0; try more --classes")
        for label in by_mesh:
            overlaps.add_row(str(label), f"{by_mesh[label]:.4f}", f"{by_voxels[label]:.4f}")
    save_image(output, labels)
    numbers.save(report)
    out.print(table)
    if truth is not None:
        out.print(overlaps)
    out.print(escape(f"{output}: {classes} classes on {labels.data.size} voxels"))
    return 0


def _mesh_over(path: Path, image: Image, image_path: Path) -> Mesh:
    """Read a mesh whose cells contain each of the image's voxels at most once; warn of voxels outside."""
    loaded = read_mesh(path)
    warn_of_other_image(loaded, path, image_path)
    if (overlap := overlap_of(image, loaded.mesh)) is not None:
        raise InputError(f"{path}: {overlap}; remove one cell of each pair, or mesh the image again")
    outside = int((tetopt.cell_of_voxel(image, loaded.mesh) < 0).sum())
    if outside == image.data.size:
        raise InputError(f"{path}: the mesh contains no voxel of {image_path}; was it built from another image?")
    if outside:
        show_warning(f"{outside} of {image.data.size} voxels lie outside the mesh and get class 0")
    return loaded.mesh
