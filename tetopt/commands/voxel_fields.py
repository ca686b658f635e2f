"""A field of a mesh's file, or an image moved by it, on the voxels of an image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tetopt.commands.conversion import with_results
from tetopt.contents.labels import is_label_map
from tetopt.errors import InputError, prefix_errors
from tetopt.image import Image
from tetopt.io.images import OUTPUT_SUFFIXES, save_image, save_voxels
from tetopt.job.aligned import read_companion
from tetopt.job.events import note, progress, warning
from tetopt.job.mesh_file import check_overlap, read_mesh
from tetopt.job.options import MaskPart, VoxelOptions
from tetopt.model.fields import KINDS_TEXT, field_kinds, half_turned_fields
from tetopt.model.file import MeshFile, words_of_other_box
from tetopt.model.on_image import At, field_on_image, warped_image
from tetopt.report.summary import versions
from tetopt.system.arrays import Json


def is_image_name(path: Path) -> bool:
    """Return whether a file of this name is an image rather than a mesh."""
    return path.name.lower().endswith(OUTPUT_SUFFIXES)


def write_on_image(
    mesh: Path,
    output: Path,
    options: VoxelOptions,
    *,
    field: str | None,
    like: Path | None,
    results: Path | None,
    space: str,
    part: MaskPart,
) -> Json:
    """Write a field of a mesh's file on the voxels of an image or, with `options.warp`, that image
    moved by it.

    Parameters
    ----------
    mesh : Path
    output : Path
        NIfTI, MGZ or NRRD.
    options : VoxelOptions
    field : str, optional
        Its name.
    like : Path, optional
        The image whose voxels get the field, unless `options` name one.
    results : Path, optional
        CalculiX's results for this mesh, which have the field.
    space : {"ras", "lps"}
        Axes of vectors and tensors in the file.
    part : MaskPart
        How the mesh is read, and whether the image may be another than the mesh's.

    Returns
    -------
    dict
        Numbers of the file: field, image, voxels inside, least and greatest value.

    Raises
    ------
    InputError
        No field or image is named; files cannot be read, or do not belong together; no voxel lies
        in the mesh, or one lies in several cells.
    """
    path = options.like or like or options.warp
    _check(output, options, like, space)
    assert path is not None, "the check requires one"
    loaded = read_mesh(mesh, part)
    loaded = loaded if results is None else with_results(loaded, results)
    name, values, at = _field_of(loaded, mesh, field, options, space)
    is_grid = path is not options.warp
    image = _read(loaded, mesh, path, part.registered, is_grid=is_grid)
    check_overlap(mesh, loaded.mesh, image)
    numbers: Json = {"mesh": mesh.name, "output": output.name, "field": name, "at": at}
    if options.warp is None:
        kinds = field_kinds(loaded.text(KINDS_TEXT))
        turned = half_turned_fields({name: values}, kinds)[name]
        has_axes = turned is not values  # of a vector or tensor in RAS+
        values = turned if space == "lps" else values
        outside = np.nan if options.outside is None else options.outside
        with prefix_errors(f"{mesh} and {path}"):
            on_voxels = field_on_image(loaded.mesh, values, image, at=at)
        inside = np.isfinite(on_voxels.reshape(*image.shape, -1)[..., 0])
        on_voxels[~inside] = outside
        save_voxels(output, on_voxels, image)
        words = name
        space_of = space if has_axes else None
        words += f", {values[0].size} components" if values.ndim > 1 else ""
        words += "" if space_of is None else f" ({space.upper()}+)"
    else:
        outside = 0.0 if options.outside is None else options.outside
        other = _read(loaded, mesh, options.warp, part.registered)
        words = f"{options.warp} moved by {name}"
        space_of = None
        if not options.nearest and is_label_map(other):
            warning(
                f"{options.warp}: seems to be a label image, whose values are interpolated; "
                "`nearest` keeps them"
            )
        nothing = Image(np.ones_like(other.data), other.affine)
        inside = warped_image(loaded.mesh, values, nothing, image).data > 0.0
        moved = warped_image(
            loaded.mesh, values, other, image, is_nearest=options.nearest, outside=outside
        )
        save_image(output, moved)
        on_voxels = moved.data.astype(np.float64)
        inside &= ~np.isnan(on_voxels)
        words += ", nearest voxels" if options.nearest else ", linear between voxels"
        numbers["warp"] = options.warp.name
    least = float(on_voxels[inside].min())
    most = float(on_voxels[inside].max())
    rest = "NaN" if np.isnan(outside) else f"{outside:g}"
    where = f"on {np.count_nonzero(inside)} of {inside.size} voxels of {path}, {rest} elsewhere"
    progress(f"{output}: {words}; {least:.4g} to {most:.4g} {where}")
    return numbers | {
        "like": path.name,
        "n_voxels": int(np.count_nonzero(inside)),
        "least": least,
        "greatest": most,
        "outside": None if np.isnan(outside) else outside,
        "space": space_of,
        "versions": versions(),
    }


def _check(output: Path, options: VoxelOptions, like: Path | None, space: str) -> None:
    """Raise InputError for options that contradict one another."""
    if options.like is not None and like is not None:
        raise InputError(
            f"`like`: {options.like} and {like}: give only one image whose voxels get the field"
        )
    if (options.like or like or options.warp) is None:
        raise InputError(f"{output}: on the voxels of which image? pass `like`")
    if options.warp is None and options.nearest:
        raise InputError("`nearest`: needs `warp`")
    if options.warp is not None and space != "ras":
        raise InputError("`space`: has no effect on an image that is moved")
    outside = options.outside
    if outside is not None and (
        np.isinf(outside) or (np.isnan(outside) and options.warp is not None)
    ):
        raise InputError(f"`outside`: expected a finite number, got {outside}")


def _read(
    loaded: MeshFile, mesh: Path, path: Path, is_registered: bool, is_grid: bool = False
) -> Image:
    """Read an image in the mesh's world; raise InputError for another dimension or, unless
    registered, another box.
    """
    image = read_companion(path, is_grid=is_grid)
    if image.ndim != loaded.mesh.ndim:
        raise InputError(
            f"{path}: expected a {loaded.mesh.ndim}-D image like the mesh, got a {image.ndim}-D one"
        )
    if not is_registered and (words := words_of_other_box(loaded, image)):
        remedy = "if it is in the same world, pass `registered`"
        raise InputError(f"{path}: expected the box of {mesh}'s image, {words}; {remedy}")
    return image


def _field_of(
    loaded: MeshFile, mesh: Path, name: str | None, options: VoxelOptions, space: str
) -> tuple[str, NDArray, At]:
    """Return a field of nodes or cells, and which; raise InputError with the known fields if
    there is none.
    """
    fields: dict[str, tuple[NDArray, At]] = {
        each: (rows, "cells") for each, rows in loaded.cell_data.items()
    }
    fields |= {each: (rows, "nodes") for each, rows in loaded.point_data.items()}
    if name is None or name not in fields:
        known = ", ".join(fields) or "none"
        problem = "which field? pass `written_fields`" if name is None else f'has no field "{name}"'
        raise InputError(f"{mesh}: {problem}; it has {known}")
    if name in loaded.cell_data and name in loaded.point_data:
        note(f'{mesh}: has "{name}" at nodes and in cells; that at nodes is written')
    values, at = fields[name]
    # as VTK stores vectors
    if at == "nodes" and loaded.mesh.ndim == 2 and values.shape[1:] == (3,):
        values = values[:, :2]
    is_bad = np.isinf if options.warp is None else lambda rows: ~np.isfinite(rows)
    if values.dtype.kind not in "biuf" or is_bad(values).any():  # NaN: no value there
        raise InputError(f"{mesh}: expected finite numbers in {name}")
    kinds = field_kinds(loaded.text(KINDS_TEXT))
    is_unknown = half_turned_fields({name: values}, kinds)[name] is values and values.ndim > 1
    if is_unknown and "lps" in (space, loaded.space):
        what = "its file" if loaded.space == "lps" else "`space`"
        raise InputError(
            f"{mesh}: the axes of {name} are unknown, and {what} is lps; rename it displacement "
            "if it is one"
        )
    if options.warp is not None and (at != "nodes" or values.shape[1:] != (loaded.mesh.ndim,)):
        kind = f"a field of {at} with {values[0].size} number{'s' * (values[0].size > 1)} each"
        raise InputError(
            f"`warp`: expected a displacement of nodes, but {name} in {mesh} is {kind}"
        )
    return name, values, at
