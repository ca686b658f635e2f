"""
A first mesh
============

Two stiff spheres in a soft block become a mesh of 800 nodes, with small cells where the image varies and large ones
where it does not. One number says how much of the image the cells still miss.
"""

import pyvista

import tetopt

# %%
# An image is an array of voxels and the affine that says where they lie. This one is a phantom;
# ``tetopt.load_image("T1.nii.gz")`` reads a file of yours.

image = tetopt.load_phantom("two_spheres").image(voxel_mm=2.0)
print(image.shape, "voxels, intensities", image.data.min(), "to", image.data.max())

# %%
# One call makes the mesh. It needs the image and the number of nodes, and no segmentation.

result = tetopt.mesh_image(image, nodes=800)
mesh = result.mesh
print(len(mesh.points), "nodes,", len(mesh.cells), "tetrahedra")

# %%
# Each cell stands for one value, the mean of its voxels. What varies around these means is lost to a simulation: E_D is
# that variance times the volume, and it is given as a fraction of the variance of the whole image. 0.01 means that the
# cells keep 99 % of it.

fraction = tetopt.E_D(image, mesh) / (image.data.var() * image.volume)
print(f"{fraction:.5f} of the variance is left inside the cells")

# %%
# The mesh cut through the middle of both spheres, each cell in the colour of its mean. Whole cells are shown, so that
# the cut is as rough as they are.

grid = mesh.to_pyvista({"mean": tetopt.cell_moments(image, mesh).mean})
half = grid.clip("y", crinkle=True)

plotter = pyvista.Plotter(window_size=(1000, 700))
plotter.set_background("#171a21")
plotter.add_mesh(
    half, scalars="mean", cmap="RdYlBu_r", show_edges=True, edge_color="#171a21", line_width=1, ambient=0.2,
    show_scalar_bar=False,
)  # fmt: skip
plotter.view_vector((0.25, 1.0, 0.35), viewup=(0, 0, 1))
plotter.camera.zoom(1.35)
plotter.show()
