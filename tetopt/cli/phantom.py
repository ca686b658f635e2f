"""``tetopt phantom``: write a phantom as an image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tetopt import load_phantom, save_image
from tetopt.cli.console import print_line
from tetopt.cli.options import ForceOption
from tetopt.io.images import OUTPUT_SUFFIXES
from tetopt.io.zarr_images import ZARR_SUFFIX, is_node
from tetopt.job.options import Option
from tetopt.system.files import check_output


def phantom_command(
    name: Annotated[
        str, Option("NAME_OR_TOML", "A phantom's name, or your own TOML file.", is_argument=True)
    ],
    output: Annotated[
        Path,
        Option("IMAGE.nii.gz", "The image to write, as NIfTI or a folder X.zarr.", letter="o"),
    ],
    voxel_mm: Annotated[float | None, Option("MM", "Voxel size instead of the phantom's.")] = None,
    blur_mm: Annotated[float | None, Option("MM", "Standard deviation of a Gaussian blur.")] = None,
    noise_sd: Annotated[float | None, Option("SD", "Standard deviation of added noise.")] = None,
    seed: Annotated[int | None, Option("N", "Seed of the noise.")] = None,
    labels: Annotated[
        Path | None, Option("LABELS.nii.gz", "Also write the label of each voxel's centre.")
    ] = None,
    force: ForceOption = False,
) -> int:
    """Write a phantom as an image of known shapes and intensities."""
    if labels is not None:
        labels = check_output(labels, OUTPUT_SUFFIXES, force)
    is_folder = output.name.lower().endswith(ZARR_SUFFIX)
    output = check_output(
        output, (*OUTPUT_SUFFIXES, ZARR_SUFFIX), force, is_node if is_folder else None
    )
    phantom = load_phantom(name)
    image = phantom.image(voxel_mm=voxel_mm, blur_mm=blur_mm, noise_sd=noise_sd, seed=seed)
    save_image(output, image)
    if labels is not None:
        save_image(labels, phantom.label_image(voxel_mm=voxel_mm))
    size, (low, high) = " x ".join(map(str, image.shape)), image.range
    print_line(f"{output}: {phantom.name}, {size} voxels, {low:g} to {high:g}")
    return 0
