"""``tetopt convert``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from tetopt import Image, InputError
from tetopt.align import aligned_mask
from tetopt.cli.inputs import check_no_input, image_and_others, read_mesh, warn_of_other_image
from tetopt.cli.options import (
    BinsOption,
    CropOption,
    ForceOption,
    JsonOption,
    LoadOption,
    MeshArgument,
    NuOption,
    OrderOption,
    SetOption,
    SliceOption,
    SpaceOption,
    UnitsOption,
    VolumeOption,
    YoungOption,
)
from tetopt.cli.solver import Wishes, built, checked_wishes, print_model, save_wished
from tetopt.content import continued
from tetopt.io.files import checked_output, save_json
from tetopt.io.formats import FORMATS, format_of
from tetopt.io.images import sha256
from tetopt.io.meshes import MeshFile
from tetopt.model.fields import cell_fields
from tetopt.model.model import UNITS
from tetopt.model.sets import box_of
from tetopt.report.summary import model_summary, versions

TEXTS = ("image", "image_sha256", "inputs", "options", "box")  # of a mesh's file that go on into the new one


def convert_command(
    mesh_path: MeshArgument,
    output: Annotated[
        Path, typer.Argument(metavar="OUT", help=f"The file to write: {', '.join(FORMATS)}.", show_default=False)
    ],
    image_path: Annotated[
        Path | None,
        typer.Option("--image", metavar="IMAGE", help="Take means and laws from this image, not from the mesh's file."),
    ] = None,
    mask_path: Annotated[
        Path | None, typer.Option("--mask", metavar="MASK", help="With --image: only what lies in it counts.")
    ] = None,
    young: YoungOption = None,
    nu: NuOption = None,
    bins: BinsOption = None,
    sets: SetOption = None,
    loads: LoadOption = None,
    order: OrderOption = 1,
    units: UnitsOption = "kPa",
    space: SpaceOption = "ras",
    volume: VolumeOption = None,
    crop: CropOption = None,
    slice_: SliceOption = None,
    json_path: JsonOption = None,
    force: ForceOption = False,
) -> int:
    """Write a mesh for a solver: materials, named sets, loads, in the format of OUT's suffix."""
    format_of(output)
    output = checked_output(output, tuple(FORMATS), force)
    if json_path is not None:
        json_path = checked_output(json_path, (".json",), force)
    check_no_input(output, mesh_path, image_path, mask_path)
    wishes = Wishes(young, nu, bins, list(sets or []), list(loads or []), order, units, space)
    if mask_path is not None and image_path is None:
        raise InputError("--mask: there is no --image")
    loaded = read_mesh(mesh_path)
    checked_wishes(output, wishes, has_materials="young" in loaded.cell_data)
    fields = _in_kPa(loaded)
    about: dict[str, Any] = {name: str(loaded.field_data[name][0]) for name in TEXTS if name in loaded.field_data}
    known: dict[str, Any] = {"box": loaded.box}
    image: Image | None = None
    if image_path is not None:
        whole, beside = image_and_others(image_path, volume, crop, slice_)
        image = continued(whole, None if mask_path is None else beside(mask_path, aligned_mask))
        warn_of_other_image(loaded, mesh_path, image_path)
        fields |= cell_fields(loaded.mesh, image)
        known["box"] = box_of(whole)
        about |= {"image": image_path.name, "image_sha256": sha256(image_path)}
    if image_path is None and (loaded.sets.facets or loaded.sets.cells):
        known["known_sets"] = loaded.sets
    model = built(loaded.mesh, image, wishes, fields, about, **known)
    save_wished(output, model, wishes)
    if json_path is not None:
        files = {"mesh": mesh_path.name, "output": output.name, "units": units, "space": space}
        save_json(json_path, files | {"versions": versions()} | model_summary(model))
    print_model(output, model, wishes)
    return 0


def _in_kPa(loaded: MeshFile) -> dict[str, Any]:
    """The file's cell data, moduli in kPa."""
    fields = dict(loaded.cell_data)
    units = str(loaded.field_data["units"][0]) if "units" in loaded.field_data else "kPa"
    if "young" in fields:
        if units not in UNITS:
            raise InputError(f'units of the mesh\'s moduli: expected {" or ".join(UNITS)}, found "{units}"')
        fields["young"] = np.asarray(fields["young"], dtype=np.float64) * UNITS[units][0]
    return fields
