"""
Extract the ventricles of MNI152
================================

Mesh the middle of a brain without a segmentation and extract the largest connected set of dark
cells: the ventricles, as a closed surface and as a named set for a solver.
"""

import numpy as np
import pyvista
from nilearn.datasets import load_mni152_template

import tetopt

# %% nilearn's wheel has the MNI152 T1. Every second voxel of a box around the ventricles is enough
# here. The affine moves the origin to the first voxel of the box.

template = load_mni152_template(resolution=1)
step, first, last = 2, (56, 92, 76), (142, 178, 116)
box = tuple(slice(a, b, step) for a, b in zip(first, last, strict=True))
affine = template.affine.copy()
affine[:3, 3] = template.affine[:3, :3] @ first + template.affine[:3, 3]
affine[:3, :3] *= step
image = tetopt.Image(template.get_fdata()[box], affine)
mesh = tetopt.mesh_image(image, nodes=3000).mesh

# %% ``below:0.6`` selects the largest connected set of cells with a mean below 0.6 (white matter is
# brighter, fluid darker). Its facets are a set, too, for loads like ``pressure:ventricles:1.5``.

model = tetopt.build_model(mesh, image, sets=["ventricles=below:0.6"])
chosen = model.sets.cells["ventricles"]
volume_ml = tetopt.cell_fields(mesh, image)["volume"][chosen].sum() / 1000.0
print(f"{len(chosen)} cells, {volume_ml:.2f} ml")

# %% The boundary of these cells is closed; ``tetopt.save_surface`` writes it as STL or PLY. Here it
# is drawn in front of image slices.

surface = tetopt.extract_surface(mesh.points, mesh.cells, chosen)
ventricles = pyvista.PolyData.from_regular_faces(surface.points, surface.triangles)
voxels = pyvista.ImageData(dimensions=image.shape, spacing=(step,) * 3, origin=affine[:3, 3])
voxels["T1"] = image.data.ravel(order="F")

plotter = pyvista.Plotter(window_size=(1000, 700))
plotter.set_background("#171a21")
low, high = affine[:3, 3], affine[:3, 3] + step * (np.array(image.shape) - 1)
for normal, origin in (("x", low), ("y", low), ("z", low)):
    plotter.add_mesh(
        voxels.slice(normal, origin=origin + 1e-3), cmap="gray", clim=(0, 1), show_scalar_bar=False
    )
plotter.add_mesh(ventricles, color="#f2913d", show_edges=True, edge_color="#7a3f0c", line_width=0.5)
plotter.view_vector((0.5, 1.0, 0.75), viewup=(0, 0, 1))
plotter.show()
