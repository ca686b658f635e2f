"""
Mesh to a target error
======================

Instead of a number of nodes, set the unexplained variance (as a fraction). tetopt finds the number
of nodes.
"""

import matplotlib.pyplot as plt
import numpy as np
from nilearn.datasets import load_mni152_template

import tetopt

# %%
# An axial slice of MNI152, to save time; 3-D works the same way.

template = load_mni152_template(resolution=1)
k = 90
image = tetopt.Image(template.get_fdata()[:, :, k], template.affine[np.ix_([0, 1, 3], [0, 1, 3])])

# %% First, the error as a function of the number of nodes, each mesh from its own octree (in 2-D, a
# quadtree).


def fraction(mesh):
    """Return the unexplained fraction of the image's variance."""
    return tetopt.E_D(image, mesh) / (image.data.var() * image.volume)


numbers = [100, 200, 400, 800, 1600]
errors = [fraction(tetopt.mesh_image(image, nodes=number).mesh) for number in numbers]
for number, error in zip(numbers, errors, strict=True):
    print(f"{number:5} nodes leave {error:.4f}")

# %%
# Then the inverse. The result's ``nodes`` is the number that was needed.

result = tetopt.mesh_image(image, target_error=0.03)
needed = result.nodes
print(f"{needed} nodes leave {fraction(result.mesh):.4f}, requested: 0.03 at most")

# %%
# The mesh with an error of 0.03, and its place on the curve.

figure, left = plt.subplots(figsize=(5, 5), layout="constrained")
means = tetopt.cell_moments(image, result.mesh).mean
left.tripcolor(
    *result.mesh.points.T,
    result.mesh.cells,
    means,
    cmap="gray",
    edgecolors="#2f6db5",
    linewidth=0.25,
)
left.set_aspect("equal")
left.axis("off")
left.set_title(f"{needed} nodes")
figure, right = plt.subplots(figsize=(5, 5), layout="constrained")
right.loglog(numbers, errors, "o-", color="#2f6db5", label="mesh_image(image, nodes=...)")
right.loglog(
    [needed],
    [fraction(result.mesh)],
    "*",
    color="#d95f02",
    markersize=16,
    label="target_error=0.03",
)
right.axhline(0.03, color="#d95f02", linewidth=0.8)
right.set(xlabel="nodes", ylabel="unexplained variance")
right.legend()
plt.show()
