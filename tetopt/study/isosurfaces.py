"""Interfaces between the classes of an image, cleaned for a surface mesher, in the closed box of
the image.

All coordinates are in the *box frame*: x = index * spacing, in mm, in which the box is
axis-aligned, from -spacing/2 to (shape - 1/2) * spacing. Without shear in the affine, lengths and
angles are those of the world. A sheared image is treated in the same frame and mapped by its affine
afterwards, so its cells are sheared along.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pyvista
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tetopt.contents.otsu import class_thresholds
from tetopt.geometry.box import box_sides
from tetopt.image import Image
from tetopt.system.arrays import Floats, Ints

# of the segmentation without labels: fewer lose interfaces (see `tetopt.study.tetwild`)
OTSU_CLASSES = 4
# of the Gaussian before thresholding: removes noise, moves no interface wider than a voxel
SIGMA_VOXELS = 0.75
# pieces of surface below this many size^2 are dropped: cells of that size cannot represent them
SPECK_AREA = 3.0
# of a surface triangle over `size`; coarser ones round off folds, finer ones only take time
EDGE_FRACTION = 0.7
SINC_ITERATIONS = 30  # of the smoothing; VTK's default is 20, and a narrower pass band needs more
PASS_BAND = 0.05  # of the smoothing; VTK's default is 0.1, and less is smoother
# padding of the volume, so that smoothing and decimation do not fray at the box's faces
PAD_VOXELS = 4


class Surfaces(NamedTuple):
    """A soup of triangles in the box frame: the interfaces, cut off at the box, and the box's
    own 12 triangles.
    """

    points: Floats  # (P, 3) mm
    triangles: Ints  # (T, 3), the box's last
    n_box: int  # number of the box's triangles
    low: Floats  # (3,) mm, the box's corner at index -0.5
    high: Floats  # (3,) mm, at index shape - 0.5
    notes: list[str]  # dropped parts


def interfaces(
    image: Image,
    size: float,
    *,
    classes: int = OTSU_CLASSES,
    labels: Image | None = None,
    smoothing: float = 1.0,
) -> Surfaces:
    """Extract all interfaces between classes or labels of an image, and the box around them.

    Without labels: the volume is smoothed by a Gaussian of 0.75 voxel, exact multi-Otsu gives the
    thresholds of the classes, and each threshold's isosurface is an interface. They are level sets
    of one field, so they nest. With labels: one conforming surface on which three or more labels
    may meet (surface nets). Then small pieces are dropped, and the surface is smoothed by a
    windowed sinc and decimated by quadrics to triangles of about 0.7 `size`.

    Parameters
    ----------
    image : Image
        3-D.
    size : float
        Edge length of the mesh in mm, above 0, near the interfaces.
    classes : int
        Number of classes without labels, 2 or more.
    labels : Image, optional
        Whole numbers, on the image's voxels.
    smoothing : float
        Factor on the Gaussian's width, and on the shortest wavelength that the windowed sinc keeps.

    Returns
    -------
    Surfaces

    Raises
    ------
    InputError
        The intensities do not have so many classes (see `tetopt.contents.otsu.class_thresholds`).
    """
    if labels is None:
        pieces, notes = _isosurfaces(image, size, classes, smoothing)
    else:
        pieces, notes = _label_surface(labels.data, image.spacing, size, smoothing)
    low, high = box_sides(image.shape).T * image.spacing
    cut = [_cut_by_box(_decimate_surface(piece, size), low, high) for piece in pieces]
    soup = [(points, triangles) for points, triangles in cut if len(triangles)]
    if not soup:
        notes.append("no interface remains: only the box is meshed")
    points, triangles = _stack_parts([*soup, _box(low, high)])
    return Surfaces(points, triangles, 12, low, high, notes)


def class_labels(image: Image, classes: int) -> Image:
    """Return the classes of `interfaces`, voxel by voxel, as a label image of 0 to classes - 1.

    Raises
    ------
    InputError
        As `tetopt.contents.otsu.class_thresholds`.
    """
    smooth, thresholds = _classes(image, classes)
    return Image(np.digitize(smooth, thresholds), image.affine)


def _classes(
    image: Image, classes: int, smoothing: float = 1.0
) -> tuple[NDArray[np.floating], Floats]:
    """Return the smoothed volume and the thresholds between its classes."""
    smooth = gaussian_filter(image.data, smoothing * SIGMA_VOXELS, mode="nearest")
    return smooth, class_thresholds(smooth.ravel(), classes)


def _isosurfaces(
    image: Image, size: float, classes: int, smoothing: float
) -> tuple[list[pyvista.PolyData], list[str]]:
    smooth, thresholds = _classes(image, classes, smoothing)
    grid = _padded_grid(smooth, image.spacing, size)
    pieces, notes = [], []
    for threshold in thresholds:
        surface = grid.contour(
            [threshold], method="flying_edges", compute_normals=False, compute_gradients=False
        )
        large, n_dropped = _without_specks(surface, size)
        if n_dropped:
            notes.append(f"threshold {threshold:.4g}: dropped {n_dropped} specks of surface")
        if large.n_cells == 0:
            notes.append(
                f"threshold {threshold:.4g}: dropped the whole surface, as every piece is a speck"
            )
            continue
        pieces.append(_smooth_surface(large, smoothing))
    return pieces, notes


def _label_surface(
    data: NDArray[np.floating], spacing: Floats, size: float, smoothing: float
) -> tuple[list[pyvista.PolyData], list[str]]:
    values, numbered = np.unique(data, return_inverse=True)
    if len(values) == 1:
        return [], []
    # Numbers from 1: 0 would be the filter's background, where it extracts no internal boundary.
    grid = _padded_grid((numbered.reshape(data.shape) + 1).astype(np.int16), spacing, size)
    surface = grid.contour_labels(
        "internal",
        background_value=0,
        pad_background=False,
        smoothing=True,
        output_mesh_type="triangles",
    )
    large, n_dropped = _without_specks(surface, size)
    notes = [f"labels: dropped {n_dropped} specks of surface"] if n_dropped else []
    seen = (
        np.unique(large.cell_data["boundary_labels"]) if large.n_cells else np.array([], dtype=int)
    )
    lost = [f"{value:g}" for number, value in enumerate(values, 1) if number not in seen]
    if lost and n_dropped:
        notes.append(f"lost labels, as every piece of their surface is a speck: {', '.join(lost)}")
    return ([_smooth_surface(large, smoothing)] if large.n_cells else []), notes


def _padded_grid(volume: NDArray, spacing: Floats, size: float) -> pyvista.ImageData:
    """Return the volume on its voxel centres, continued by its border values beyond the box's
    faces.
    """
    pad = np.maximum(PAD_VOXELS, np.ceil(size / spacing)).astype(int)
    padded = np.pad(volume, [(p, p) for p in pad], mode="edge")
    grid = pyvista.ImageData(dimensions=padded.shape, spacing=spacing, origin=-pad * spacing)
    grid.point_data["h"] = padded.ravel(order="F")
    return grid


def _without_specks(surface: pyvista.PolyData, size: float) -> tuple[pyvista.PolyData, int]:
    """Return the pieces of at least `SPECK_AREA` size^2, and the number of dropped ones."""
    if surface.n_cells == 0:
        return surface, 0
    triangles = surface.regular_faces
    region = surface.connectivity(largest=False).cell_data["RegionId"]
    a, b, c = np.asarray(surface.points, dtype=np.float64)[triangles.T]
    areas = np.bincount(region, 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    is_large = areas >= SPECK_AREA * size**2
    kept = is_large[region]
    points, triangles = compact_points(surface.points, triangles[kept])
    large = pyvista.PolyData.from_regular_faces(points, triangles)
    if "boundary_labels" in surface.cell_data:
        large.cell_data["boundary_labels"] = surface.cell_data["boundary_labels"][kept]
    return large, int((~is_large).sum())


def _smooth_surface(surface: pyvista.PolyData, smoothing: float) -> pyvista.PolyData:
    return surface.smooth_taubin(
        n_iter=SINC_ITERATIONS,
        pass_band=PASS_BAND / smoothing,
        boundary_smoothing=False,
        non_manifold_smoothing=True,
    )


def _decimate_surface(surface: pyvista.PolyData, size: float) -> pyvista.PolyData:
    n_triangles = surface.area / (np.sqrt(3.0) / 4.0 * (EDGE_FRACTION * size) ** 2)
    reduction = 1.0 - max(n_triangles, 4.0) / surface.n_cells
    bare = pyvista.PolyData.from_regular_faces(surface.points, surface.regular_faces)
    return bare.decimate(reduction, volume_preservation=True) if reduction > 0.0 else bare


def _cut_by_box(surface: pyvista.PolyData, low: Floats, high: Floats) -> tuple[Floats, Ints]:
    """Return the part of a surface inside the box; its rim lies exactly on the box's faces."""
    surface = pyvista.PolyData.from_regular_faces(
        np.asarray(surface.points, dtype=np.float64), surface.regular_faces
    )
    for axis in range(3):
        for place, sign in ((low, 1.0), (high, -1.0)):
            if surface.n_cells:
                normal = sign * np.eye(3)[axis]
                surface = surface.clip(normal, origin=place, invert=False).triangulate()
    if surface.n_cells == 0:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    points, triangles = compact_points(
        np.asarray(surface.points, dtype=np.float64), surface.regular_faces
    )
    near = 1e-6 * (high - low)
    for face in (low, high):
        points = np.where(np.abs(points - face) < near, face, points)
    return points, triangles


def _box(low: Floats, high: Floats) -> tuple[Floats, Ints]:
    box = pyvista.Box(np.stack([low, high], axis=1).ravel(), quads=False)
    corners, triangles = np.unique(
        np.asarray(box.points, dtype=np.float64), axis=0, return_inverse=True
    )
    # pyvista's points are single precision: each coordinate is moved to the nearer of the two
    # faces.
    corners = np.where(corners < 0.5 * (low + high), low, high)
    return corners, triangles.reshape(-1)[box.regular_faces].astype(np.int64)


def _stack_parts(
    parts: list[tuple[Floats, Ints]],
) -> tuple[Floats, Ints]:
    offsets = np.cumsum([0] + [len(points) for points, _ in parts])
    points = np.vstack([points for points, _ in parts])
    return points, np.vstack(
        [triangles + offset for (_, triangles), offset in zip(parts, offsets, strict=False)]
    )


def compact_points(points: NDArray, cells: NDArray) -> tuple[NDArray, Ints]:
    """Remove the points that no cell (or triangle) uses; the others keep their order."""
    used, compact = np.unique(cells, return_inverse=True)
    return points[used], compact.reshape(cells.shape).astype(np.int64)
