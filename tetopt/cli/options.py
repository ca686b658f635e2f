"""Arguments and options that several commands take."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Method(StrEnum):  # noqa: D101
    fast = "fast"
    paper = "paper"


ImageArgument = Annotated[
    Path,
    typer.Argument(metavar="IMAGE", help="NIfTI, MGZ, NRRD, MetaImage, a DICOM folder, or a 2-D picture."),
]
ImagesArgument = Annotated[
    list[Path],
    typer.Argument(metavar="IMAGE...", help="As for the other commands; further contrasts go to the first one's grid."),
]
MaskOption = Annotated[
    Path | None,
    typer.Option(metavar="MASK", help="Mesh this region only (0/1, or 0 to 1), its boundary on the mask's surface."),
]
LabelsOption = Annotated[
    Path | None, typer.Option("--labels", metavar="LABELS", help="Label image: each cell is to be of one label.")
]
VolumeOption = Annotated[int | None, typer.Option("--volume", metavar="K", help="Volume of a 4-D file, from 0.")]
CropOption = Annotated[
    str | None,
    typer.Option("--crop", metavar="A:B,C:D,E:F", help="Keep these voxels, half open; an end may be empty."),
]
SliceOption = Annotated[
    str | None, typer.Option("--slice", metavar="AXIS=INDEX", help="One slice, in 2-D; for example k=90.")
]
JsonOption = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write every number here.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace existing outputs.")]
ThreadsOption = Annotated[
    int | None, typer.Option("--threads", metavar="N", help="Threads; the result is the same for any number.")
]
