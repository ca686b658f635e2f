"""
Solve with scikit-fem in ten lines
==================================

``model.to_skfem()`` passes the mesh with its named sets to scikit-fem; the moduli of the elements
are an array. Linear elasticity then takes ten lines, and the energy equals that of tetopt's solver.
"""

import numpy as np
import pyvista
import skfem
from skfem.models.elasticity import lame_parameters, linear_elasticity

import tetopt

# %% A stiff sphere in a soft cube. The bottom is fixed; the top moves down by 3 mm and to the side
# by 6 mm.

image = tetopt.load_phantom("sphere").image(voxel_mm=2.0)
mesh = tetopt.mesh_image(image, nodes=900).mesh
model = tetopt.build_model(
    mesh, image, young="h", nu=0.4, loads=["hold:inferior", "move:superior:6,0,-3"]
)

# %%
# Boundaries have the names of the model's sets. Cells keep their order, so the materials match.

skmesh = model.to_skfem()
basis = skfem.Basis(skmesh, skfem.ElementVector(skfem.ElementTetP1()), intorder=1)
constant = basis.with_element(skfem.ElementTetP0())
materials = model.materials
moduli = lame_parameters(materials.young[materials.of_cell], materials.nu[materials.of_cell])
stiffness = linear_elasticity(*(constant.interpolate(modulus) for modulus in moduli)).assemble(
    basis
)

bottom, top = basis.get_dofs("inferior"), basis.get_dofs("superior")
u = basis.zeros()
for direction, move_mm in (("u^1", 6.0), ("u^3", -3.0)):
    u[top.nodal[direction]] = move_mm
u = skfem.solve(*skfem.condense(stiffness, x=u, D=np.concatenate([bottom.all(), top.all()])))

# %%
# The two solvers agree to rounding.

energy = 0.5 * u @ stiffness @ u
ours = tetopt.solve(model).strain_energy
print(f"strain energy {energy:.2f} uJ by scikit-fem, {ours:.2f} uJ by tetopt")

# %% The sphere rotates in the sheared cube and keeps its shape. Colours show the magnitude of the
# displacement.

displacement = u[basis.nodal_dofs].T
length = np.linalg.norm(displacement, axis=1)
grid = mesh.to_pyvista(
    {"young": materials.young[materials.of_cell]}, {"u": displacement, "displacement, mm": length}
)
deformed = grid.warp_by_vector("u", factor=2.0)
sphere = deformed.extract_cells(np.flatnonzero(deformed["young"] > 50))
shell = deformed.clip("y", crinkle=True)
plotter = pyvista.Plotter(window_size=(1000, 700))
plotter.set_background("#171a21")
bar = {"title": "displacement, mm\n", "color": "#e6e6e6", "fmt": "%.0f", "vertical": False}
bar |= {"width": 0.5, "position_x": 0.25, "position_y": 0.03}
look = {
    "scalars": "displacement, mm",
    "cmap": "viridis",
    "clim": (0, length.max()),
    "show_edges": True,
}
plotter.add_mesh(shell, edge_color="#20242c", scalar_bar_args=bar, ambient=0.2, **look)
plotter.add_mesh(
    sphere, edge_color="#ffffff", line_width=1.5, show_scalar_bar=False, ambient=0.2, **look
)
plotter.view_vector((0.35, 1.0, 0.3), viewup=(0, 0, 1))
plotter.camera.zoom(1.15)
plotter.show()
