"""
Solve with CalculiX and read the results
========================================

Write a mesh with moduli and loads for CalculiX, solve it, and read displacements and stresses back
onto the mesh.
"""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pyvista

import tetopt

# %% The phantom's intensities are Young's moduli in kPa. Cells are grouped into twelve materials.
# The top is fixed, and the bottom is pushed in by 5 % of the height.

image = tetopt.load_phantom("two_spheres").image(voxel_mm=2.0)
mesh = tetopt.mesh_image(image, nodes=400).mesh
model = tetopt.build_model(mesh, image, young="h", nu=0.4, bins=12, loads=["compress:5%"])

# %%
# The input file is complete: run ``ccx -i block``. If ``ccx`` is not installed, this program reads
# ``plot_calculix.frd`` instead, which CalculiX 2.20 computed from the same file.
#
# ``tetopt.read_frd`` compares nodes and cells with the mesh and rejects results of another mesh.

kept = Path("plot_calculix.frd").absolute()
with tempfile.TemporaryDirectory() as folder:
    tetopt.save_model(Path(folder) / "block.inp", model)
    if shutil.which("ccx"):
        subprocess.run(["ccx", "-i", "block"], cwd=folder, check=True, capture_output=True)
        results = tetopt.read_frd(Path(folder) / "block.frd", mesh)
    else:
        results = tetopt.read_frd(kept, mesh)

# %%
# Displacements are in mm and stresses in kPa, one row per node.

displacement = results.point_data["displacement"]
stress_kPa = results.point_data["von_mises_nodes"]
largest_stress = stress_kPa.max()
print(f"largest displacement {np.linalg.norm(displacement, axis=1).max():.2f} mm")
print(f"largest von Mises stress {largest_stress:.2f} kPa")

# %% The deformed block, cut along the middle, with displacements doubled. The small sphere is
# twelve times as stiff as its surroundings and carries the highest stress.

grid = mesh.to_pyvista(
    point_data={"displacement": displacement, "von Mises stress, kPa": stress_kPa}
)
half = grid.clip("y", crinkle=True).warp_by_vector("displacement", factor=2.0)
plotter = pyvista.Plotter(window_size=(1000, 700))
plotter.set_background("#171a21")
bar = {"title": "von Mises stress, kPa\n", "color": "#e6e6e6", "fmt": "%.1f", "vertical": False}
bar |= {"width": 0.5, "position_x": 0.25, "position_y": 0.03}
plotter.add_mesh(
    half,
    scalars="von Mises stress, kPa",
    cmap="inferno",
    show_edges=True,
    edge_color="#30343d",
    scalar_bar_args=bar,
    ambient=0.2,
)
plotter.add_mesh(grid.outline(), color="#8a93a3", line_width=2)
plotter.view_vector((0.25, 1.0, 0.3), viewup=(0, 0, 1))
plotter.camera.zoom(1.15)
plotter.show()
