"""What is known of each cell."""

from __future__ import annotations

from numpy.typing import NDArray

from tetopt.energy.sampling import cell_moments, cell_ranges
from tetopt.geometry.simplex import dihedral_angles, rho, volumes
from tetopt.image import Image
from tetopt.mesh import Mesh


def cell_fields(mesh: Mesh, image: Image | None = None) -> dict[str, NDArray]:
    """What the mesh file holds of each cell: volume, rho, min_dihedral, and what the image is there.

    Of the image: mean, variance, n_voxels, min, max, in its unit. Volumes in mm^n, angles in degrees.
    """
    fields: dict[str, NDArray] = {}
    if image is not None:
        moments = cell_moments(image, mesh)
        fields |= {"mean": moments.mean, "variance": moments.variance, "n_voxels": moments.n_voxels}
        fields["min"], fields["max"] = cell_ranges(image, mesh)
    fields["volume"] = volumes(mesh.points, mesh.cells)
    fields["rho"] = rho(mesh.points, mesh.cells)
    fields["min_dihedral"] = dihedral_angles(mesh.points, mesh.cells).min(axis=1)
    return fields
