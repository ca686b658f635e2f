"""
Write your own phantom
======================

A phantom is a table of shapes with exactly known intensities: the quickest way to test a mesh, a
modulus mapping or a simulation against a known answer.
"""

import tempfile
from pathlib import Path

import numpy as np
import pyvista

import tetopt

# %% Shapes are painted in order, each over the previous ones. World axes are right, anterior and
# superior; the box is centred at 0, 0, 0.

TABLE = """
name = "breast"
description = "A lesion and a cyst under a layer of skin"
size_mm = [60, 60, 40]
voxel_mm = 1
background = { intensity = 20, label = 0 }

[[shape]]
name = "gland"
kind = "ellipsoid"
center_mm = [0, 0, -2]
radii_mm = [24, 22, 14]
rotation_deg = [0, 10, 0]
intensity = 45
label = 1

[[shape]]
name = "lesion"
kind = "ellipsoid"
center_mm = [-8, 0, 0]
radii_mm = [8, 6, 6]
intensity = 100
label = 2

[[shape]]
name = "cyst"
kind = "ellipsoid"
center_mm = [12, 0, -3]
radii_mm = 4.5
intensity = 0
label = 3
"""

with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "breast.toml"
    path.write_text(TABLE, encoding="utf-8")
    phantom = tetopt.load_phantom(path)

# %% Render the phantom as voxels, with labels on the same grid. With labels, the result has the
# label of each cell.

image = phantom.image()
labels = phantom.label_image()
result = tetopt.mesh_image(tetopt.content(image, labels), nodes=1200)
mesh, of_cell = result.mesh, result.labels

# %% The exact volume of the lesion is 4/3 pi a b c. The cells with its label have slightly
# less. Flat facets would cut off more of a curved surface, but nodes lie off it by what their
# facets cut off.

fields = tetopt.cell_fields(mesh, image)
exact_mm3 = 4.0 / 3.0 * np.pi * 8 * 6 * 6
volume_mm3 = fields["volume"][of_cell == 2].sum()
print(f"lesion: {volume_mm3:.1f} mm3 of cells, {exact_mm3:.0f} mm3 exactly")

# %%
# The gland, cut open, with the complete lesion and cyst.

grid = mesh.to_pyvista({"label": of_cell})
front = grid.clip("-y", origin=(0, 0, 0), crinkle=True)
plotter = pyvista.Plotter(window_size=(1000, 700))
plotter.set_background("#171a21")
look = {"show_edges": True, "edge_color": "#2b2326", "line_width": 0.8, "ambient": 0.25}
plotter.add_mesh(front.extract_cells(np.flatnonzero(front["label"] == 0)), color="#566072", **look)
plotter.add_mesh(front.extract_cells(np.flatnonzero(front["label"] == 1)), color="#e9b7a1", **look)
plotter.add_mesh(grid.extract_cells(np.flatnonzero(of_cell == 2)), color="#d1495b", **look)
plotter.add_mesh(grid.extract_cells(np.flatnonzero(of_cell == 3)), color="#4aa3df", **look)
plotter.view_vector((-0.2, -1.0, 0.45), viewup=(0, 0, 1))
plotter.camera.zoom(1.4)
plotter.show()
