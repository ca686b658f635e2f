"""SOFA scenes: mesh, sets, a modulus for each cell, mass, solver and constraints.

Written from SOFA's sources and documentation and read back as XML; no SOFA has run one of them here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.simplex import volumes
from tetopt.io.tags import check_one_step
from tetopt.io.text import blocks, rows, xml_comment
from tetopt.model.loads import Load, facet_forces, spring_constants
from tetopt.model.materials import Materials, density_of
from tetopt.model.model import Model, described, mass_densities
from tetopt.model.sets import facet_triples, nodes_of

REQUIRED_PLUGINS = (
    "Sofa.Component.Constraint.Projective",
    "Sofa.Component.Engine.Select",
    "Sofa.Component.LinearSolver.Direct",
    "Sofa.Component.Mass",
    "Sofa.Component.ODESolver.Backward",
    "Sofa.Component.SolidMechanics.FEM.Elastic",
    "Sofa.Component.StateContainer",
    "Sofa.Component.Topology.Container.Dynamic",
    "Sofa.Component.Visual",
)
LOAD_PLUGINS = {  # by kind of load
    "pressure": "Sofa.Component.MechanicalLoad",
    "traction": "Sofa.Component.MechanicalLoad",
    "spring": "Sofa.Component.SolidMechanics.Spring",
}
SCENE_NOTES = (
    "for SOFA v24.12 and v25; before v24.12 poissonRatio was one number for all cells",
    "displacements grow from t = 0 to 1 s, forces act from the start; at 2 s the solid rests in static equilibrium",
)
FOREVER_SECONDS = "1e9"  # past its last key time a LinearMovementProjectiveConstraint lets go


def sofa(model: Model) -> bytes:
    """The bytes of a SOFA scene (.scn), for SOFA v24.12 and v25.

    The node "solid" has the topology "mesh", the state "dofs", the mass of the cells' density, a quarter of a cell's at
    each of its nodes (water's density, if there is none), and corotational linear elasticity
    (TetrahedronFEMForceField) with `youngModulus` for each cell, and `poissonRatio` for each cell where it varies, else
    one number, which SOFA v24.06 takes, too. Below it, "sets" has a node for each set, named like it: of facets,
    "nodes" (PointsFromIndices) and "facets" (TriangleSetTopologyContainer); of cells, "cells"
    (TetrahedronSetTopologyContainer); all by the numbers of the mesh's nodes, from 0.

    Held sets are FixedProjectiveConstraint, or PartialFixedProjectiveConstraint where components are free, moved ones
    LinearMovementProjectiveConstraint, from 0 to 1 s and held from then on. Pressures (along undeformed normals) and
    tractions are ConstantForceField, springs RestShapeSpringsForceField, with `tetopt.model.loads.facet_weights`;
    gravity is the scene's. The solver is EulerImplicitSolver with a direct linear solver and steps of 0.1 s, whose
    damping leaves the static solution: with tetopt's own matrices, 180 mm of 0.5 kPa are within 1e-4 of it at 2 s,
    stiffer ones sooner. (SOFA's StaticSolver has changed what it needs, so that no scene with it suits old and new
    versions.) Cell data has no place in a scene; a comment names what is left out.

    Raises
    ------
    InputError
        A 2-D or quadratic model, no materials, several steps, a set that moves in some directions and is free in
        others, or a ratio below 0, in whose place SOFA takes another.
    """
    materials = _checked(model)
    mesh = model.mesh
    gravity = sum((load.numbers for load in model.loads if load.kind == "gravity"), np.zeros(3))
    scene = [
        f'<?xml version="1.0" encoding="UTF-8"?>\n{_comment(model)}',
        f'<Node name="root" gravity="{_listed(gravity)}" dt="0.1">\n',
        *(f'<RequiredPlugin name="{name}"/>\n' for name in _plugins(model)),
        '<VisualStyle displayFlags="showBehaviorModels showForceFields"/>\n<DefaultAnimationLoop/>\n',
        '<Node name="solid">\n<EulerImplicitSolver/>\n',
        '<SparseLDLSolver template="CompressedRowSparseMatrixMat3x3"/>\n',
        f'<TetrahedronSetTopologyContainer name="mesh"\nposition="\n{rows(mesh.points)}"\n',
        f'tetrahedra="\n{rows(mesh.cells)}"/>\n',
        '<TetrahedronSetGeometryAlgorithms template="Vec3"/>\n',
        '<MechanicalObject name="dofs" template="Vec3" position="@mesh.position"/>\n',
        f'<DiagonalMass {_mass(model)} topology="@mesh"/>\n',
        _force_field(materials),
        *(_load(model, load) for load in model.loads),
        *_sets(model),
        "</Node>\n</Node>\n",
    ]
    return "".join(scene).encode()


def _checked(model: Model) -> Materials:
    if model.mesh.ndim == 2:
        raise InputError("sofa: expected a mesh of tetrahedra, got triangles; .vtu holds them")
    if model.order != 1:
        raise InputError("sofa: expected linear cells, got quadratic ones; leave out `order` 2")
    if model.materials is None:
        raise InputError("sofa: a scene needs materials; give a law of the modulus (`young`)")
    if (model.materials.nu < 0.0).any():
        raise InputError(
            f"sofa: expected 0 <= nu < 0.5, got {model.materials.nu.min():g}, which SOFA would replace; give another"
        )
    check_one_step(model, "sofa")
    if any(np.isnan(load.numbers).any() and np.nansum(np.abs(load.numbers)) > 0.0 for load in model.loads):
        raise InputError("sofa: a set moves in all directions or in none; give numbers instead of free, or take .inp")
    if any(load.kind == "gravity" for load in model.loads):
        density_of(model.materials)  # or it is refused
    return model.materials


def _comment(model: Model) -> str:
    lines = [*described(model), *SCENE_NOTES]
    if model.cell_data:
        lines.append(f"cell data that this format has no place for: {', '.join(model.cell_data)}")
    return xml_comment(lines)


def _force_field(materials: Materials) -> str:
    young, nu, of_cell = materials.young, materials.nu, materials.of_cell
    ratios = nu[of_cell] if np.ptp(nu) > 0.0 else nu[:1]
    return (
        '<TetrahedronFEMForceField name="elasticity" template="Vec3" topology="@mesh" method="large"\n'
        f'youngModulus="\n{blocks(young[of_cell])}"\npoissonRatio="\n{blocks(ratios)}"/>\n'
    )


def _plugins(model: Model) -> list[str]:
    return sorted({*REQUIRED_PLUGINS, *(LOAD_PLUGINS[load.kind] for load in model.loads if load.kind in LOAD_PLUGINS)})


def _mass(model: Model) -> str:
    """One density, or the mass of each node."""
    assert model.materials is not None
    density, mesh = mass_densities(model), model.mesh
    if model.materials.density is None:
        return f'massDensity="{float(density[0])!r}"'
    of_cell = density[model.materials.of_cell] * volumes(mesh.points, mesh.cells)
    of_node = np.bincount(mesh.cells.ravel(), weights=np.repeat(of_cell / 4.0, 4), minlength=len(mesh.points))
    return f'vertexMass="\n{blocks(of_node)}"'


def _load(model: Model, load: Load) -> str:
    """The constraint or force field of a load; nothing for gravity, which is the scene's.

    The indices are written out: a link to those of a set could only lead to what SOFA makes later.
    """
    name = f"{load.kind}_{load.set_name}"
    if load.kind == "gravity":
        return ""
    if load.kind == "spring":
        nodes, constants = spring_constants(model.mesh, model.sets, load)
        return (
            f'<RestShapeSpringsForceField name="{name}" template="Vec3" points="\n{blocks(nodes)}"\n'
            f'stiffness="\n{blocks(constants)}"/>\n'
        )
    if load.kind != "displacement":
        nodes, forces = facet_forces(model.mesh, model.sets, load)
        return (
            f'<ConstantForceField name="{name}" template="Vec3" indices="\n{blocks(nodes)}"\n'
            f'forces="\n{rows(forces)}"/>\n'
        )
    nodes = nodes_of(model.mesh, model.sets.facets[load.set_name])
    indices = f'template="Vec3" topology="@mesh" indices="\n{blocks(nodes)}"'
    if not np.nan_to_num(load.numbers).any():
        kind, directions = "Fixed", ""
        if (is_free := np.isnan(load.numbers)).any():
            kind, directions = "PartialFixed", f' fixedDirections="{_listed((~is_free).astype(np.int64))}"'
        return f'<{kind}ProjectiveConstraint name="hold_{load.set_name}" {indices}{directions}/>\n'
    whole = _listed(load.numbers)
    return (
        f'<LinearMovementProjectiveConstraint name="move_{load.set_name}" {indices}\n'
        f'keyTimes="0 1 {FOREVER_SECONDS}" movements="0 0 0  {whole}  {whole}"/>\n'
    )


def _listed(numbers: NDArray) -> str:
    return " ".join(map(repr, numbers.tolist()))


def _sets(model: Model) -> list[str]:
    cells = model.mesh.cells
    facet_sets = (
        f'<Node name="{name}">\n'
        '<PointsFromIndices name="nodes" template="Vec3" position="@../../mesh.position"\n'
        f'indices="\n{blocks(nodes_of(model.mesh, members))}"/>\n'
        '<TriangleSetTopologyContainer name="facets" position="@../../mesh.position"\n'
        f'triangles="\n{rows(facet_triples(cells, members))}"/>\n</Node>\n'
        for name, members in model.sets.facets.items()
    )
    cell_sets = (
        f'<Node name="{name}">\n<TetrahedronSetTopologyContainer name="cells" position="@../../mesh.position"\n'
        f'tetrahedra="\n{rows(cells[members])}"/>\n</Node>\n'
        for name, members in model.sets.cells.items()
    )
    return ['<Node name="sets">\n', *facet_sets, *cell_sets, "</Node>\n"]
