"""
Use meshio, pyvista and trimesh
===============================

The mesh file is VTU, which most programs read. In Python, convert a mesh to other libraries and
back without a file.
"""

import tempfile
from pathlib import Path

import meshio
import pyvista
import trimesh

import tetopt

# %%
# The file has the image mean of each cell, and more.

image = tetopt.load_phantom("sphere").image(voxel_mm=2.0)
mesh = tetopt.mesh_image(image, nodes=900).mesh
folder = tempfile.TemporaryDirectory()
path = Path(folder.name) / "sphere.vtu"
tetopt.save_mesh(path, mesh, tetopt.cell_fields(mesh, image))

# %%
# meshio and pyvista read it.

of_meshio = meshio.read(path)
of_pyvista = pyvista.read(path)
folder.cleanup()
print("meshio:", len(of_meshio.points), "nodes, cell data", ", ".join(of_meshio.cell_data))
print(
    "pyvista:",
    of_pyvista.n_cells,
    "cells of",
    f"{of_pyvista.compute_cell_sizes()['Volume'].sum():.0f} mm3",
)

# %% Without a file, ``to_meshio``, ``to_pyvista``, ``to_skfem`` and ``to_trimesh`` create such
# objects; ``tetopt.Mesh.from_pyvista`` and its siblings convert back.

again = tetopt.Mesh.from_pyvista(mesh.to_pyvista())
print("there and back:", (again.points == mesh.points).all() and (again.cells == mesh.cells).all())

# %% trimesh represents surfaces. ``to_trimesh`` returns the boundary of the whole mesh,
# ``tetopt.extract_surface`` the closed boundary of selected cells. A sphere of 20 mm radius has
# 33,510 mm3.

chosen = tetopt.cell_moments(image, mesh).mean > 60
closed = tetopt.extract_surface(mesh.points, mesh.cells, chosen)
surface = trimesh.Trimesh(closed.points, closed.triangles, process=False)
volume_mm3 = surface.volume
print(f"trimesh: watertight {surface.is_watertight}, {volume_mm3:.1f} mm3")

# %%
# The cells from pyvista, cut through the middle, and in front of them the surface from trimesh.

plotter = pyvista.Plotter(window_size=(1000, 700))
plotter.set_background("#171a21")
half = of_pyvista.clip("y", crinkle=True)
plotter.add_mesh(
    half.extract_cells(half["mean"] <= 60),
    color="#4a6fa5",
    show_edges=True,
    edge_color="#1d2a40",
    ambient=0.2,
)
plotter.add_mesh(
    pyvista.wrap(surface), color="#f2b13d", show_edges=True, edge_color="#5c4110", ambient=0.2
)
plotter.view_vector((0.45, 1.0, 0.4), viewup=(0, 0, 1))
plotter.camera.zoom(1.3)
plotter.show()
