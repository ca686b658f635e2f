"""Arguments and options that several commands take."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from tetopt.model.materials import DEFAULT_NU


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
MeshArgument = Annotated[
    Path, typer.Argument(metavar="MESH", help="VTU, VTK or gmsh MSH file of tetrahedra or triangles.")
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
YoungOption = Annotated[
    str | None,
    typer.Option(
        metavar="LAW",
        help='Young\'s modulus, kPa: a number, a formula of the intensity, "0.5 + 0.01*h", a table "0:1,100:5", '
        'by label "1=2.1,2=1.9", or a file .toml or .csv of such columns.',
    ),
]
NuOption = Annotated[str | None, typer.Option(metavar="LAW", help=f"Poisson's ratio, likewise (default {DEFAULT_NU}).")]
BinsOption = Annotated[
    str | None,
    typer.Option(metavar="K[:quantile|:log]", help="Group cells into K materials, of equal width, by number, or log."),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=...",
        help="A set more: NAME=below:T, NAME=point:X,Y,Z:D, NAME=plane:X,Y,Z:NX,NY,NZ:D (mm, RAS+). May be repeated.",
    ),
]
LoadOption = Annotated[
    list[str] | None,
    typer.Option(
        "--load",
        metavar="...",
        help="A step to run: compress:5%, or hold:SET and move:SET:X,Y,Z. May be repeated.",
    ),
]
OrderOption = Annotated[
    int, typer.Option(metavar="1|2", help="2: quadratic cells, straight-edged (.inp, .feb, .msh, .msh2).")
]
UnitsOption = Annotated[str, typer.Option(metavar="kPa|MPa", help="Unit of stress in the file; --young is in kPa.")]
SpaceOption = Annotated[str, typer.Option(metavar="ras|lps", help="Convention of the file's coordinates.")]
