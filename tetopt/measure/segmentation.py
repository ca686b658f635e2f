"""Approximate segmentation by an optimised mesh: cells are classified by their means, and voxels by
their cells.

Section 5 of the paper: "such an optimized discretization can further be used for a fast approximate
segmentation since optimized elements represent an image using far fewer degrees-of-freedom than the
underlying pixels".
"""

from __future__ import annotations

import numpy as np

from tetopt.contents.content import Content, own_image
from tetopt.contents.labels import check_labels
from tetopt.contents.otsu import class_thresholds
from tetopt.energy.sampling import cell_moments, cell_of_voxel
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.measure.judge import warn_of_other_mask
from tetopt.mesh import Mesh
from tetopt.system.arrays import Bools, Ints


def segment(image: Image | Content, mesh: Mesh, classes: int) -> Image:
    """Segment an image into classes, numbered by increasing mean from 0, by its cells.

    Parameters
    ----------
    image : Image or Content
        The intensities h. For a mesh of a content, pass the content: voxels outside its mask do not
        count.
    mesh : Mesh
        Mesh of the image's box or a part of it; curved edges count as straight.
    classes : int
        Number of classes, 2 or more.

    Returns
    -------
    Image
        Class of each voxel, whole numbers; 0 outside the mesh.

    Raises
    ------
    InputError
        As for `class_thresholds` and `tetopt.energy.sampling.cell_moments`, or a mesh without voxel
        centres.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> labels = tetopt.segment(image, tetopt.mesh_image(image, 300, iterations=4).mesh, 2)
    >>> truth = tetopt.load_phantom("sphere").label_image(voxel_mm=4)
    >>> int((labels.data != truth.data).sum())  # voxels that differ from the phantom
    20
    """
    if isinstance(image, Content):
        warn_of_other_mask(mesh, image.own_mask)
    moments = cell_moments(own_image(image), mesh)
    if not moments.n_voxels.any():
        raise InputError(
            "mesh and image: no voxel centre is inside the mesh; do both use the same world "
            "coordinates?"
        )
    thresholds = class_thresholds(moments.mean, classes, moments.n_voxels)
    class_of_cell = np.digitize(moments.mean, thresholds)
    whole = image if isinstance(image, Image) else image.given
    owner = cell_of_voxel(whole, mesh)
    return Image(np.where(owner >= 0, class_of_cell[owner], 0), whole.affine)


def threshold_image(image: Image, classes: int, inside: Bools | None = None) -> Image:
    """Segment an image's voxels, by default all, into the same classes without a mesh; those not
    `inside` get 0.
    """
    inside = np.ones(image.shape, dtype=bool) if inside is None else inside
    thresholds = class_thresholds(image.data[inside], classes)
    return Image(np.where(inside, np.digitize(image.data, thresholds), 0), image.affine)


def stands_for(labels: Image, truth: Image) -> dict[int, int]:
    """The most frequent true label of each class's voxels; arguments as for `dice`."""
    classes, true, table = _table(labels, truth)
    return dict(zip(classes.tolist(), true[table.argmax(axis=1)].tolist(), strict=True))


def dice(labels: Image, truth: Image) -> dict[int, float]:
    """Dice overlap of each true label with the classes that represent it, 0 to 1.

    A class represents the most frequent true label of its voxels (`stands_for`); a true label
    without any class has 0. As the truth determines this assignment, more classes tend to overlap
    better.

    Raises
    ------
    InputError
        Images of different shapes, or labels that are not whole numbers from 0.
    """
    _, true, table = _table(labels, truth)
    chosen = table.argmax(axis=1)
    overlaps = {}
    for column, label in enumerate(true.tolist()):
        rows = table[chosen == column]
        overlaps[label] = float(2 * rows[:, column].sum() / (rows.sum() + table[:, column].sum()))
    return overlaps


def _table(labels: Image, truth: Image) -> tuple[Ints, Ints, Ints]:
    """The classes, the true labels, and the number of voxels of each class (rows) and true label
    (columns).
    """
    if labels.shape != truth.shape:
        raise InputError(
            f"dice: expected images of the same shape, got {labels.shape} and {truth.shape}"
        )
    named = {"labels": labels, "truth": truth}
    of_each = [
        np.unique(check_labels(name, image).data, return_inverse=True)
        for name, image in named.items()
    ]
    (classes, row), (true, column) = of_each
    shape = (len(classes), len(true))
    counts = np.bincount(
        row.ravel() * shape[1] + column.ravel(), minlength=shape[0] * shape[1]
    ).reshape(shape)
    return classes.astype(np.int64), true.astype(np.int64), counts
