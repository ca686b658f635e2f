"""
Mesh two contrasts
==================

Some structures are visible in only one contrast. A mesh of two contrasts follows both; weights set
how much each counts.
"""

import matplotlib.pyplot as plt
import numpy as np

import tetopt

# %% Two contrasts of one phantom on the same voxels. The disc and the ellipse are visible only in
# the first, the box only in the second. For a contrast on another grid, use
# ``tetopt.resample_contrast``.

labels = tetopt.load_phantom("fig2_2d").label_image()
shape = labels.data.astype(int)
first = tetopt.Image(np.array([100, 200, 20, 100])[shape], labels.affine)
second = tetopt.Image(np.array([0.5, 0.5, 0.5, 0.9])[shape], labels.affine)

# %% Three meshes of 250 nodes: of the first contrast, of the second, and of both. Contrasts are
# normalised by their variance, so their scales do not matter; ``weights=[1, 0.5]`` would halve the
# second.

meshes = {
    "of the first": tetopt.mesh_image(first, nodes=250).mesh,
    "of the second": tetopt.mesh_image(second, nodes=250).mesh,
    "of both": tetopt.mesh_image(tetopt.content([first, second]), nodes=250).mesh,
}


def fraction(image, mesh):
    """Return the unexplained fraction of the image's variance."""
    return tetopt.E_D(image, mesh) / (image.data.var() * image.volume)


for name, mesh in meshes.items():
    print(
        f"mesh {name:13}: {fraction(first, mesh):.4f} of the first, {fraction(second, mesh):.4f} "
        "of the second is left"
    )

# %% For each contrast, the mesh of both is nearly as good as the mesh of that contrast, and much
# better for the other.

both = meshes["of both"]
worst = max(fraction(first, both), fraction(second, both))
print(f"at most {worst:.4f} is left of either contrast")

# %%
# Cell means of the first contrast (top) and the second (bottom).

# sphinx_gallery_thumbnail_number = 5
for name, mesh in meshes.items():
    for shown, image, colours in (("first", first, "gray"), ("second", second, "magma")):
        figure, ax = plt.subplots(figsize=(4.4, 4.4), layout="constrained")
        ax.set_title(f"mesh {name}, {shown} image")
        means = tetopt.cell_moments(image, mesh).mean
        ax.tripcolor(
            *mesh.points.T, mesh.cells, means, cmap=colours, edgecolors="#7f8fa6", linewidth=0.4
        )
        ax.set_aspect("equal")
        ax.axis("off")
plt.show()
