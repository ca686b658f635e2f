"""A mesh's file of the user's, its labels' names and its image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tetopt.contents.align import SAME_BOX_VOXELS, SAME_GRID_VOXELS
from tetopt.energy.sampling import overlap_of
from tetopt.errors import InputError, prefix_errors
from tetopt.geometry.check import check_place
from tetopt.image import Image
from tetopt.io.images import sha256
from tetopt.io.label_tables import LabelTable, load_label_table, own_label_table
from tetopt.io.meshes import load_mesh
from tetopt.io.text import list_names
from tetopt.job.events import note, warning, warnings_heard
from tetopt.job.option_values import file_and_volume
from tetopt.job.options import MeshPart
from tetopt.mesh import Mesh
from tetopt.model.file import MeshFile, words_of_other_box
from tetopt.model.label_names import NO_TABLE


def read_mesh(path: Path, part: MeshPart) -> MeshFile:
    """Read a mesh of the user's; report inverted, dropped and renamed parts."""
    loaded = load_mesh(path, label_field=part.label_field, mesh_units=part.mesh_units)
    if loaded.n_turned:
        warning(f"{path}: reoriented {loaded.n_turned} inverted cells")
    if loaded.n_left:
        note(f"{path}: dropped {loaded.n_left} cells of lower dimension")
    for line in loaded.notes:
        note(f"{path}: {line}")
    if violated := loaded.table("violated"):
        warning(
            f"{path}: the run that built this mesh violated requirements: "
            f"{list_names(list(violated))}"
        )
    return loaded


def check_mesh_place(what: object, mesh: Mesh, image: Image) -> None:
    """Raise InputError for a mesh that does not meet the image; report one that meets it in part.
    `what` begins the error.
    """
    with prefix_errors(what), warnings_heard():
        check_place(mesh, image)


def check_overlap(path: Path, mesh: Mesh, image: Image) -> None:
    """Raise InputError for a mesh whose cells share voxels."""
    if (overlap := overlap_of(image, mesh)) is not None:
        raise InputError(
            f"{path}: {overlap}; remove one cell of each pair, or mesh the image again"
        )


def table_of_segmentation(path: Path | None) -> LabelTable:
    """Return the names and colours that the file of labels itself has, empty if it has none."""
    return NO_TABLE if path is None else own_label_table(file_and_volume(path)[0])


def label_table(
    path: Path | None, loaded: MeshFile | None = None, labels_path: Path | None = None
) -> LabelTable:
    """Return names and colours of labels: those of the file, else in the mesh's file, else in
    that of the labels.
    """
    if path is not None:
        table = load_label_table(path)
        labels = None if loaded is None else loaded.labels
        if labels is not None and not np.isin(labels, [*table.names, *table.colours]).any():
            warning(
                f"{path}: contains none of the mesh's labels, "
                f"{list_names(np.unique(labels).tolist())}"
            )
        return table
    table = NO_TABLE if loaded is None else loaded.label_table
    return table if table.names else table_of_segmentation(labels_path)


def warn_of_other_image(
    loaded: MeshFile,
    mesh_path: Path,
    image_path: Path,
    image: Image,
    *,
    is_registered: bool | None,
    is_exact: bool = False,
) -> bool:
    """Warn if the mesh's file names another source image than this one, which is not said to be
    registered; return whether it does.

    Reject such an image unless it is registered, or None, or has the source's box to a voxel; with
    `is_exact`, reject any image with another box.
    """
    made_from = loaded.text("image_sha256")
    words = ""
    is_other = made_from is not None and made_from != sha256(image_path)
    if is_exact or is_other:
        words = words_of_other_box(loaded, image, SAME_GRID_VOXELS if is_exact else SAME_BOX_VOXELS)
    if words and (is_exact or is_registered is False):
        remedy = "if it is registered to that image of the same subject, pass `registered`"
        remedy = "`check` needs that image, with its crop" if is_exact else remedy
        name = f"{mesh_path}'s image, {loaded.text('image')}"
        raise InputError(f"{image_path}: expected the box of {name}, {words}; {remedy}")
    if is_other and not is_registered:
        of_box = f": its box was {words}" if words else ""
        warning(f"{mesh_path} was built from a different image, not {image_path}{of_box}")
    return is_other
