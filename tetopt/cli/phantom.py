"""``tetopt phantom``: write a phantom as an image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from tetopt import load_phantom, save_image
from tetopt.cli.console import out
from tetopt.cli.options import ForceOption, option
from tetopt.io.files import checked_output


def phantom_command(
    name: Annotated[str, typer.Argument(metavar="NAME_OR_TOML", help="A phantom's name, or a TOML file of your own.")],
    output: Annotated[Path, option("IMAGE.nii.gz", "The image to write.", "-o", "--output")],
    voxel_mm: Annotated[float | None, option("MM", "Voxel size instead of the phantom's.")] = None,
    blur_mm: Annotated[float | None, option("MM", "Standard deviation of a Gaussian blur.")] = None,
    noise_sd: Annotated[float | None, option("SD", "Standard deviation of added noise.")] = None,
    seed: Annotated[int | None, option("N", "Seed of the noise.")] = None,
    labels: Annotated[Path | None, option("LABELS.nii.gz", "Write the label of each voxel's centre, too.")] = None,
    force: ForceOption = False,
) -> int:
    """Write a phantom as an image: known shapes, known intensities."""
    suffixes = (".nii", ".nii.gz")
    output = checked_output(output, suffixes, force)
    if labels is not None:
        labels = checked_output(labels, suffixes, force)
    phantom = load_phantom(name)
    image = phantom.image(voxel_mm=voxel_mm, blur_mm=blur_mm, noise_sd=noise_sd, seed=seed)
    save_image(output, image)
    if labels is not None:
        save_image(labels, phantom.label_image(voxel_mm=voxel_mm))
    size = " x ".join(str(s) for s in image.shape)
    out.print(escape(f"{output}: {phantom.name}, {size} voxels, {image.data.min():g} to {image.data.max():g}"))
    return 0
