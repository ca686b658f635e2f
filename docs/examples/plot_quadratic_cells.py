"""
Compare linear and quadratic elements
=====================================

Solve the same mesh with linear and with quadratic displacements. Quadratic elements have more
unknowns, but are much more accurate for the same number of unknowns.
"""

import matplotlib.pyplot as plt

import tetopt

# %% A gland with two stiff nodules; intensities are Young's moduli in kPa. The top is fixed, and
# the bottom is pushed in by 1 % of the height. In 2-D, this is plane stress.

image = tetopt.load_phantom("prostate_2d").image()


def solution(mesh, order):
    """Displacements and energy of the compression, and the model that was solved."""
    model = tetopt.build_model(mesh, image, young="h", nu=0.45, loads=["compress:1%"], order=order)
    return tetopt.solve(model)


# %% The reference solution is a fine mesh with quadratic elements. The strain energy of a
# compression converges to it from above, so its error is a fair comparison.

fine = tetopt.mesh_image(image, nodes=3000).mesh
exact = solution(fine, order=2).strain_energy

nodes = [60, 120, 240, 480]
meshes = [tetopt.mesh_image(image, nodes=number).mesh for number in nodes]
errors, unknowns = {1: [], 2: []}, {1: [], 2: []}
for mesh in meshes:
    for order in (1, 2):
        solved = solution(mesh, order)
        errors[order].append(abs(solved.strain_energy / exact - 1.0))
        unknowns[order].append(solved.u.size)
for order in (1, 2):
    row = ", ".join(
        f"{error:.4f} at {size}" for error, size in zip(errors[order], unknowns[order], strict=True)
    )
    print(f"order {order}: error of the energy {row} unknowns")

# %%
# On the coarsest mesh, quadratic elements are more accurate by this factor.

factor = errors[1][0] / errors[2][0]
print(f"{nodes[0]} nodes: the error of quadratic cells is {factor:.2f} times smaller")

# %%
# The errors, and the stress of quadratic elements on the mesh of 480 nodes.

figure, left = plt.subplots(figsize=(5.2, 4.8), layout="constrained")
for order, name, colour in ((1, "linear", "#2f6db5"), (2, "quadratic", "#d95f02")):
    left.loglog(unknowns[order], errors[order], "o-", color=colour, label=f"{name} cells")
left.set_xticks([200, 500, 1000, 2000], ["200", "500", "1000", "2000"])
left.set_xticks([], minor=True)
left.set(xlabel="unknowns", ylabel="relative error of the strain energy")
left.legend()
mesh = meshes[3]
stress = tetopt.solution_fields(mesh, solution(mesh, 2)).cell_data["von_mises"]
figure, right = plt.subplots(figsize=(5.2, 4.8), layout="constrained")
drawn = right.tripcolor(
    *mesh.points.T, mesh.cells, stress, cmap="inferno", edgecolors="#404a5a", linewidth=0.2
)
right.set_aspect("equal")
right.axis("off")
figure.colorbar(drawn, ax=right, label="von Mises stress, kPa", shrink=0.8)
plt.show()
