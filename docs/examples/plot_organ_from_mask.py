"""
Mesh an organ from a mask
=========================

With a mask, cells fill only the organ, and the boundary is smooth although the mask's voxels form
stairs. The organ here is the brain of MNI152.
"""

import numpy as np
import pyvista
from nilearn.datasets import load_mni152_template

import tetopt

# %% Use every third voxel of the T1 in nilearn's wheel, to save time. The mask is 1 in the brain
# and 0 outside. For a mask on another grid, use ``tetopt.resample_mask``.

template = load_mni152_template(resolution=1)
image = tetopt.Image(template.get_fdata()[::3, ::3, ::3], template.affine @ np.diag([3, 3, 3, 1]))
mask = tetopt.Image(1.0 * (image.data > 0), image.affine)

# %%
# ``tetopt.content`` combines image and mask, and replaces the image in the call.

organ = tetopt.content(image, mask=mask)
mesh = tetopt.mesh_image(organ, nodes=3000).mesh

# %% Dice compares the voxels inside the mesh with the mask. The distance is from the mesh boundary
# to the surface halfway between the mask's voxels.

fidelity = tetopt.mask_fidelity(mask, mesh)
dice = fidelity.dice
print(f"Dice {dice:.4f}, boundary off by {fidelity.distance_mean:.2f} voxels on average")

# %%
# The mesh without one octant, each cell in the grey of its mean.

grid = mesh.to_pyvista({"mean": tetopt.cell_fields(mesh, organ)["mean"]})
middle = np.array([0.0, -18.0, 10.0])
is_cut = (grid.cell_centers().points > middle).all(axis=1)
opened = grid.extract_cells(np.flatnonzero(~is_cut))

plotter = pyvista.Plotter(window_size=(1000, 700))
plotter.set_background("#171a21")
plotter.add_mesh(
    opened,
    scalars="mean",
    cmap="bone",
    clim=(0.1, 0.95),
    show_edges=True,
    edge_color="#2a3140",
    line_width=1,
    show_scalar_bar=False,
)
plotter.view_vector((0.9, 1.1, 0.75), viewup=(0, 0, 1))
plotter.camera.zoom(1.35)
plotter.show()
