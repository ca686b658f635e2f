"""``tetopt segment``: segment an image by its mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from rich.table import Table

import tetopt
from tetopt import Content, InputError, Mesh, save_image
from tetopt.cli.console import print_line, print_table, show_warning
from tetopt.cli.options import FilesArgument, NumberOptions, mesh_and_image
from tetopt.commands.beside import image_voxels, read_labels
from tetopt.io.images import OUTPUT_SUFFIXES
from tetopt.job.mesh_file import check_overlap, read_mesh
from tetopt.job.options import MaskedPart, Option
from tetopt.report.tables import new_table
from tetopt.system.arrays import Bools, Json
from tetopt.system.files import check_output


def segment_command(
    paths: FilesArgument,
    output: Annotated[
        Path,
        Option("LABELS.nii.gz", "The classes to write; voxels outside the mesh get 0.", letter="o"),
    ],
    classes: Annotated[
        int, Option("K", "Number of classes, in order of increasing mean.", least=2)
    ] = 4,
    truth_path: Annotated[
        Path | None, Option("LABELS", "True labels; prints the Dice overlap with them.", "truth")
    ] = None,
    image_path: Annotated[Path | None, Option("IMAGE", "The image to segment.", "image")] = None,
    *,
    part: MaskedPart,
    numbers: NumberOptions,
) -> int:
    """Segment an image by its mesh, quickly and roughly: group cells by mean into K classes and
    label their voxels.
    """
    from tetopt.measure.segmentation import dice, segment, stands_for, threshold_image

    output = check_output(output, OUTPUT_SUFFIXES, numbers.force)
    numbers.check()
    mesh_path, image_path = mesh_and_image(paths, image_path)
    if image_path is None:
        raise InputError(f"{mesh_path}: which image is to be segmented? pass `image`")
    loaded = read_mesh(mesh_path, part)
    what, _ = image_voxels(loaded, mesh_path, image_path, part)
    image = what.given
    mesh = loaded.mesh
    truth = None if truth_path is None else read_labels(truth_path, image, part)
    inside = _voxels_in(mesh, what, mesh_path, image_path)
    labels = segment(what, mesh, classes)
    of_class = labels.data[inside].astype(np.int64)
    h = image.data[inside]
    fractions = np.bincount(of_class, minlength=classes) / len(of_class)
    means = [
        float(h[of_class == number].mean()) if fraction else None
        for number, fraction in enumerate(fractions)
    ]
    report: Json = {
        "image": image_path.name,
        "mesh": mesh_path.name,
        "classes": classes,
        "fraction_of_voxels": fractions,
        "mean_intensity": means,
    }
    names = {} if truth is None else stands_for(labels, truth)  # labels by class
    table = new_table(
        "class",
        "fraction of voxels",
        "mean intensity",
        *([] if truth is None else ["matched label"]),
    )
    for number, (fraction, mean) in enumerate(zip(fractions, means, strict=True)):
        last = [] if truth is None else [str(names.get(number, "none"))]
        table.add_row(str(number), f"{fraction:.4f}", "" if mean is None else f"{mean:.4g}", *last)
    tables = [table]
    if truth_path is not None and truth is not None:
        overlap = {
            "mesh": dice(labels, truth),
            "voxels": dice(threshold_image(image, classes, inside), truth),
        }
        report |= {"truth": truth_path.name, "stands_for": names, "dice": overlap}
        tables.append(_overlaps_table(overlap, names))
    save_image(output, labels)
    numbers.save(report)
    for each in tables:
        print_table(each)
    print_line(f"{output}: {classes} classes on {labels.data.size} voxels")
    return 0


def _overlaps_table(overlap: dict[str, dict[int, float]], names: dict[int, int]) -> Table:
    """Return a table of Dice by true label; warn of labels that no class matches."""
    by_mesh = overlap["mesh"]
    by_voxels = overlap["voxels"]
    if lost := [str(label) for label in by_mesh if label not in names.values()]:
        show_warning(f"no class matches label {', '.join(lost)}: its Dice is 0; try more --classes")
    table = new_table("label", "Dice, mesh", "Dice, thresholded voxels")
    for label in by_mesh:
        table.add_row(str(label), f"{by_mesh[label]:.4f}", f"{by_voxels[label]:.4f}")
    return table


def _voxels_in(mesh: Mesh, what: Content, path: Path, image_path: Path) -> Bools:
    """Return which voxels lie in the mesh and its mask; warn of those outside.

    Raises InputError if one lies in several cells, or all outside.
    """
    image = what.given
    check_overlap(path, mesh, image)
    inside = tetopt.cell_of_voxel(image, mesh) >= 0
    outside = int((~inside).sum())
    if outside == image.data.size:
        raise InputError(
            f"{path}: the mesh contains no voxel of {image_path}; was it built from another image?"
        )
    if outside:
        show_warning(f"{outside} of {image.data.size} voxels lie outside the mesh and get class 0")
    if what.continuation is not None:
        masked = np.zeros_like(inside)
        masked[what.continuation.part] = what.continuation.inside
        inside &= masked
    return inside
