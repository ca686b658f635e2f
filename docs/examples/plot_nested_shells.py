"""
Preserve a thin layer of fluid
==============================

If the layer of fluid around a brain is torn, brain and skull are coupled and a simulation is wrong.
Mesh nested shells with sizes from label thickness, and measure the thin layer.
"""

import numpy as np
import pyvista

import tetopt

# %% A brain of 9 mm radius lies in 3 mm of fluid, 3 mm of bone, and soft tissue. Only the labels
# count: the image has weight 0.

NAMES = {1: "brain", 2: "fluid", 3: "bone", 4: "soft"}
radius = np.linalg.norm(np.indices((36, 36, 36)) - 17.9, axis=0)
labels = tetopt.Image(1.0 + (radius > 9.0) + (radius > 12.0) + (radius > 15.0))
content = tetopt.content(labels, labels, weights=[0.0])

# %% `cells_across=2` requests edges of half the thickness. `sizes_by_label` predicts the number of
# nodes before meshing.

two_across = tetopt.Sizes(edge_size=8.0, cells_across=2)
planned = tetopt.sizes_by_label(two_across, content)
for row in planned.layers:
    print(f"{NAMES[row.label]}: {row.thickness[1]:.1f} mm thick, edges of {row.edge:.1f} mm")
print(f"that takes about {planned.nodes} nodes")

# %% Mesh the phantom with 500 nodes without sizes, and with them. Without sizes, the fluid is one
# cell thick: each node of its cells lies on its surface, and the displacement cannot vary across it
# properly. Voxels of brain and bone do not touch, so any contact would be false; neither mesh has
# any.


def judge(result):
    """Volume of the fluid over that of its voxels, its fraction in one layer, and the contact of
    brain and bone.
    """
    fluid = tetopt.label_fidelity(labels, result.mesh, result.labels)[1]
    contacts = tetopt.label_contacts(labels, result.mesh, result.labels)
    touching_mm2 = sum(each.mesh_mm2 for each in contacts if each.labels == (1, 3))
    volume_ratio = fluid.extent.mesh_volume / fluid.extent.volume
    return volume_ratio, fluid.extent.one_layer_fraction, touching_mm2


without = tetopt.mesh_image(content, nodes=500)
sized = tetopt.mesh_image(content, sizes=two_across)
for name, result in (("without sizes", without), ("two cells across", sized)):
    volume, one_layer, touching_mm2 = judge(result)
    print(
        f"{name}: {len(result.mesh.points)} nodes, fluid {volume:.3f} of its volume, "
        f"{one_layer:.3f} in one layer"
    )
    print(f"brain and bone touch in {touching_mm2:.1f} mm2")

# %% Compare the thickness of the fluid between its facets with that between the smooth surfaces of
# its voxels:

fluid = tetopt.label_thickness(content, sized.mesh, sized.labels)[2]
of_voxels, of_cells = fluid.of_voxels.p50, fluid.of_cells.p50
print(f"fluid: {of_voxels:.2f} mm of voxels, {of_cells:.2f} mm of cells")

# %%
# Both meshes, cut in the middle: without sizes, and two cells across.

COLOURS = {1: "#c9867b", 2: "#3f7fbf", 3: "#f4ead5", 4: "#566072"}
# sphinx_gallery_thumbnail_number = 2
for result in (without, sized):
    plotter = pyvista.Plotter(window_size=(600, 600))
    plotter.set_background("#171a21")
    half = result.mesh.to_pyvista({"label": result.labels}).clip(
        "y", origin=(18, 18, 18), crinkle=True
    )
    for label, colour in COLOURS.items():
        cells = half.extract_cells(np.flatnonzero(half["label"] == label))
        plotter.add_mesh(
            cells, color=colour, show_edges=True, edge_color="#2b2326", line_width=0.7, ambient=0.25
        )
    plotter.view_vector((0.0, 1.0, 0.0), viewup=(0, 0, 1))
    plotter.camera.zoom(1.3)
    plotter.show()
