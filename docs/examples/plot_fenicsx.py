"""
Export to FEniCSx
=================

``tetopt.save_model`` writes XDMF with the moduli of the elements, and the sets as tags. This
program writes the file, shows its content, and prints the dolfinx code that reads it. It does not
run dolfinx, which need not be installed.
"""

import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pyvista

import tetopt

# %%
# A head of nested ellipsoids, compressed by 5 %, with a modulus that increases with intensity.

image = tetopt.load_phantom("ellipsoids_brain").image(voxel_mm=4.0)
mesh = tetopt.mesh_image(image, nodes=1500).mesh
model = tetopt.build_model(mesh, image, young="0.5 + 0.05*h", nu=0.4, loads=["compress:5%"])
folder = tempfile.TemporaryDirectory()
path = Path(folder.name) / "head.xdmf"
tetopt.save_model(path, model)

# %% This dolfinx code reads the mesh, the material number of each cell, and the facet tags. A tag
# stands for one combination of sets; the file lists the tags of each set. See
# :doc:`/reference/formats`.

PROGRAM = """
from xml.etree import ElementTree
import numpy as np
from dolfinx.io import XDMFFile
from mpi4py import MPI

with XDMFFile(MPI.COMM_WORLD, "head.xdmf", "r", encoding=XDMFFile.Encoding.ASCII) as file:
    mesh = file.read_mesh(name="mesh")
    mesh.topology.create_connectivity(2, 3)
    materials = file.read_meshtags(mesh, name="mesh")
    facets = file.read_meshtags(mesh, name="facets", xpath="/Xdmf/Domain/Grid/Information/Grid")

root = ElementTree.parse("head.xdmf").getroot()
tags = root.find(".//Grid[@Name='facets']/Information[@Name='superior']").get("Value")
superior = facets.indices[np.isin(facets.values, np.array(tags.split(), dtype=int))]
"""
print(PROGRAM)

# %%
# The file's XML lists its grids, sets and loads by name.

root = ET.parse(path).getroot()
for grid in root.findall("./Domain/Grid/Information/Grid/Grid"):
    print("grid", grid.get("Name"))
for load in root.findall("./Domain/Grid/Information[@Name='load']"):
    print("load", load.get("Value"))

# %%
# VTK and pyvista also read the file. The moduli are the model's.

read = pyvista.get_reader(path).read()["mesh"]
folder.cleanup()
young = read["young"]
largest_kPa = young.max()
print(f"Young's modulus from {young.min():.2f} to {largest_kPa:.2f} kPa in {read.n_cells} cells")

# %%
# The moduli from the file, on the mesh without its front left quarter.

grid = mesh.to_pyvista({"Young's modulus, kPa": young})
is_cut = (grid.cell_centers().points[:, :2] * (-1, 1) > 0).all(axis=1)
opened = grid.extract_cells(np.flatnonzero(~is_cut))
plotter = pyvista.Plotter(window_size=(1000, 700))
plotter.set_background("#171a21")
bar = {"title": "Young's modulus, kPa\n", "color": "#e6e6e6", "fmt": "%.0f", "vertical": False}
bar |= {"width": 0.5, "position_x": 0.25, "position_y": 0.03}
plotter.add_mesh(
    opened, cmap="YlGnBu_r", show_edges=True, edge_color="#20242c", scalar_bar_args=bar, ambient=0.2
)
plotter.view_vector((-0.8, 1.1, 0.6), viewup=(0, 0, 1))
plotter.camera.zoom(1.25)
plotter.show()
