"""
Transfer fields between mesh and image
======================================

Put simulation results onto the image's voxels and save them as NIfTI, for imaging software. Voxel
values return to cells exactly, or to nodes by interpolation.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import nibabel
import numpy as np
from scipy.ndimage import map_coordinates

import tetopt

# %% A block with two stiff spheres, compressed by 5 %: displacements at the nodes, stresses in the
# cells.

image = tetopt.load_phantom("two_spheres").image(voxel_mm=2.0)
mesh = tetopt.mesh_image(image, nodes=1000).mesh
model = tetopt.build_model(mesh, image, young="h", nu=0.4, loads=["compress:5%"])
solution = tetopt.solve(model)
fields = tetopt.solution_fields(mesh, solution)

# %% Every voxel lies in exactly one cell and takes its value. The mean over a cell's voxels
# recovers it; cells without voxels take the nearest voxel's value.

stress = tetopt.Image(
    tetopt.field_on_image(mesh, fields.cell_data["von_mises"], image), image.affine
)
cells = tetopt.cell_moments(stress, mesh)
has_voxels = cells.n_voxels > 0
difference = np.abs(cells.mean - fields.cell_data["von_mises"])[has_voxels].max()
print(f"stress: off by {difference:.1e} kPa after voxels and back")

# %% Displacements are evaluated at voxel centres by the cells' shape functions, here linear, and
# nibabel writes them as an image of three volumes. ``tetopt convert pressed.vtu u.nii.gz --like
# T1.nii.gz --fields displacement`` does both.

on_voxels = tetopt.field_on_image(mesh, solution.u, image)
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "displacement.nii.gz"
    nibabel.save(nibabel.Nifti1Image(on_voxels, image.affine), path)
    read = nibabel.load(path).get_fdata()

# %% Linear interpolation between voxels returns them to the nodes. Variation within a 2 mm voxel is
# lost, mostly at the edges of the spheres.

index = image.to_index(mesh.points).T
back = np.stack(
    [map_coordinates(read[..., axis], index, order=1, mode="nearest") for axis in range(3)], axis=1
)
# between voxels' centres
is_inside = ((index >= 0) & (index.T <= np.array(image.shape) - 1).T).all(axis=0)
off_mm = np.linalg.norm(back - solution.u, axis=1)[is_inside].mean()
print(
    f"displacement: off by {off_mm:.4f} mm on average, of up to {np.abs(solution.u).max():.1f} mm"
)

# %% The image moves with the tissue: each voxel of the deformed block takes the value of the place
# that moved there.

moved = tetopt.warped_image(mesh, solution.u, image)
print(
    f"volume of the spheres: {(image.data > 25).sum()} voxels before, {(moved.data > 25).sum()} "
    "after"
)

# %%
# Stress and displacement on the voxels of the middle slice, with contours of the image.

middle = image.shape[1] // 2 - 1
extent = (-40, 40, -30, 30)  # mm, the block
panels = (
    ("von Mises stress, kPa", stress.data, "inferno"),
    ("upward displacement, mm", read[..., 2], "viridis"),
)
for title, data, colours in panels:
    figure, ax = plt.subplots(figsize=(5.5, 4.4), layout="constrained")
    drawn = ax.imshow(data[:, middle].T, origin="lower", extent=extent, cmap=colours)
    ax.contour(image.data[:, middle].T, [25], extent=extent, colors="w", linewidths=1)
    figure.colorbar(drawn, ax=ax, label=title, shrink=0.85)
    ax.axis("off")
plt.show()
