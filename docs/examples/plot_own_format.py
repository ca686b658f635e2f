"""
Write a format of your own
==========================

To support another solver, write a function from a model to text and register it with one call. The
examples are openCARP: the mesh with a region for each label; and SOFA: a scene with the mesh, a
modulus per element, supports, forces and springs. Not yet verified in SOFA.
"""

import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pyvista

import tetopt
from tetopt.model.loads import facet_forces, spring_constants

# %% openCARP reads a mesh from three text files: the nodes, in micrometres, the cells with a
# region each, here their label, and a direction of fibres in each cell, 0 0 0 where there is none.
# Each is a format of its own. Not yet verified in openCARP.


def pts(model):
    """The nodes' file."""
    rows = (" ".join(map(repr, row)) for row in (1000.0 * model.mesh.points).tolist())
    return "\n".join([str(len(model.mesh.points)), *rows, ""])


def elem(model):
    """The tetrahedra's file."""
    rows = np.column_stack([model.mesh.cells, model.cell_data["label"]]).tolist()
    return "\n".join([str(len(rows)), *(f"Tt {' '.join(map(str, row))}" for row in rows), ""])


def lon(model):
    """The file of fibres."""
    rows = (" ".join(map(repr, row)) for row in model.cell_data["fibre"].tolist())
    return "\n".join(["1", *rows, ""])


tetopt.register_format(".lon", lon, "openCARP fibres")
tetopt.register_format(".pts", pts, "openCARP nodes")
tetopt.register_format(".elem", elem, "openCARP cells")
phantom = tetopt.load_phantom("sphere")
image, labels = phantom.image(voxel_mm=4), phantom.label_image(voxel_mm=4)
result = tetopt.mesh_image(image, 300, labels=labels, iterations=3)
x, y, _ = result.mesh.points[result.mesh.cells].mean(axis=1).T  # fibres run around the z axis
around = np.stack([-y, x, 0.0 * x], axis=1) * (result.labels == 1)[:, None]
around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-9)
with tempfile.TemporaryDirectory() as folder:
    for suffix in (".pts", ".elem", ".lon"):
        data = {"label": result.labels, "fibre": around}
        tetopt.save_mesh(Path(folder) / f"heart{suffix}", result.mesh, data)
    fibre = np.loadtxt(Path(folder) / "heart.lon", skiprows=1)
    points = np.loadtxt(Path(folder) / "heart.pts", skiprows=1) / 1000.0
    cells = np.loadtxt(Path(folder) / "heart.elem", skiprows=1, usecols=range(1, 6), dtype=int)
counts = np.bincount(cells[:, 4])
extent_mm = np.ptp(points, axis=0).round(1)
print(f"openCARP: {len(points)} nodes over {extent_mm} mm, {counts.tolist()} cells by region")
print(f"openCARP: {int(fibre.any(axis=1).sum())} cells with fibres")

# %%
# SOFA takes a scene of objects.
# A model has points in mm, cells, facet sets as rows (cell, node opposite), materials and loads.
# `repr` writes a number without losing a digit. Each load becomes one SOFA object; anything that a
# scene cannot represent is rejected.


def listed(numbers):
    """Numbers as text."""
    return " ".join(map(repr, np.asarray(numbers).ravel().tolist()))


def nodes_of(model, name):
    """The nodes of a set of facets."""
    cell, opposite = model.sets.facets[name].T
    is_other = np.arange(4) != opposite[:, None]
    return np.unique(model.mesh.cells[cell][is_other])


def load_of(model, load):
    """The SOFA component of a load, and its values."""
    if load.kind == "spring":
        nodes, stiffness = spring_constants(model.mesh, model.sets, load)
        return "RestShapeSpringsForceField", {
            "points": listed(nodes),
            "stiffness": listed(stiffness),
        }
    if load.kind != "displacement":
        nodes, forces = facet_forces(model.mesh, model.sets, load)
        return "ConstantForceField", {"indices": listed(nodes), "forces": listed(forces)}
    indices = listed(nodes_of(model, load.set_name))
    if np.isnan(load.numbers).any():
        raise tetopt.InputError(
            "sofa: a set moves in all directions or in none; give numbers instead of free"
        )
    if not load.numbers.any():
        return "FixedProjectiveConstraint", {"indices": indices}
    path = listed([[0, 0, 0], load.numbers, load.numbers])  # from 0 to 1 s, then fixed
    return "LinearMovementProjectiveConstraint", {
        "indices": indices,
        "keyTimes": "0 1 1e9",
        "movements": path,
    }


def sofa(model):
    """A scene for SOFA v24.12, in equilibrium at t = 2 s."""
    if model.mesh.ndim != 3 or model.materials is None or any(load.step for load in model.loads):
        raise tetopt.InputError(
            "sofa: expected tetrahedra, a modulus mapping (`young`) and loads of one step"
        )
    mesh, materials = model.mesh, model.materials
    gravity = sum((load.numbers for load in model.loads if load.kind == "gravity"), np.zeros(3))
    root = ET.Element("Node", name="root", dt="0.1", gravity=listed(gravity))
    for plugin in (
        "Constraint.Projective",
        "LinearSolver.Direct",
        "Mass",
        "MechanicalLoad",
        "ODESolver.Backward",
        "SolidMechanics.FEM.Elastic",
        "SolidMechanics.Spring",
        "StateContainer",
        "Topology.Container.Dynamic",
    ):
        ET.SubElement(root, "RequiredPlugin", name=f"Sofa.Component.{plugin}")
    ET.SubElement(root, "DefaultAnimationLoop")
    solid = ET.SubElement(root, "Node", name="solid")
    ET.SubElement(solid, "EulerImplicitSolver")
    ET.SubElement(solid, "SparseLDLSolver", template="CompressedRowSparseMatrixMat3x3")
    ET.SubElement(
        solid,
        "TetrahedronSetTopologyContainer",
        name="mesh",
        position=listed(mesh.points),
        tetrahedra=listed(mesh.cells),
    )
    ET.SubElement(solid, "TetrahedronSetGeometryAlgorithms", template="Vec3")
    ET.SubElement(
        solid, "MechanicalObject", name="dofs", template="Vec3", position="@mesh.position"
    )
    # water's, kg/m3
    density = np.full(1, 1000.0) if materials.density is None else materials.density
    if np.ptp(density) > 0.0:
        raise tetopt.InputError("sofa: expected one density for all cells")
    in_mm = float(density[0]) * (1e-9 if model.units == "kPa" else 1e-12)  # kg, or t, in a mm3
    ET.SubElement(solid, "DiagonalMass", massDensity=repr(in_mm), topology="@mesh")
    ET.SubElement(
        solid,
        "TetrahedronFEMForceField",
        template="Vec3",
        topology="@mesh",
        method="large",
        youngModulus=listed(materials.young[materials.of_cell]),
        poissonRatio=listed(materials.nu[materials.of_cell]),
    )
    for load in model.loads:
        if load.kind != "gravity":
            kind, values = load_of(model, load)
            ET.SubElement(
                solid, kind, name=f"{load.kind}_{load.set_name}", template="Vec3", **values
            )
    ET.indent(root)
    return ET.tostring(root, encoding="unicode")


# %% From here on, this process knows the suffix `.scn`: `tetopt.save_model` writes it, whole or not
# at all, as do `tetopt.run` and the command (`from tetopt.cli import main`).

tetopt.register_format(".scn", sofa, "SOFA scene", runs=True)

mesh = tetopt.mesh_image(image, nodes=300, iterations=3).mesh
loads = ["hold:inferior", "pressure:superior:0.1"]
model = tetopt.build_model(mesh, image, young="0.5+0.02*h", nu=0.3, loads=loads)
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "ball.scn"
    tetopt.save_model(path, model)
    solid = ET.parse(path).find("Node[@name='solid']")

# %% Read the file back with an independent reader. The forces in the scene add up to the pressure,
# 0.1 kPa, times the area of the loaded side.

forces = np.array(solid.find("ConstantForceField").get("forces").split(), dtype=float).reshape(
    -1, 3
)
total_mN = -forces.sum(axis=0)[2]
print(f"force on the upper side: {total_mN:.1f} mN")

# %%
# Fixed nodes in red, loaded nodes in blue.

held_nodes = np.array(solid.find("FixedProjectiveConstraint").get("indices").split(), dtype=int)
pushed_nodes = np.array(solid.find("ConstantForceField").get("indices").split(), dtype=int)
plotter = pyvista.Plotter(window_size=(700, 600))
plotter.add_mesh(mesh.to_pyvista(), style="wireframe", color="#999999", line_width=1)
plotter.add_points(
    mesh.points[held_nodes], color="#c03030", point_size=9, render_points_as_spheres=True
)
plotter.add_points(
    mesh.points[pushed_nodes], color="#2060c0", point_size=9, render_points_as_spheres=True
)
plotter.show()
