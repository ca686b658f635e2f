"""SOFA scenes: mesh, sets, a modulus for each cell, mass, solver and constraints.

Written from SOFA's sources and documentation and read back as XML; no SOFA has run one of them here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.tags import check_kinds
from tetopt.io.text import blocks, rows, xml_comment
from tetopt.model.loads import Load
from tetopt.model.materials import Materials
from tetopt.model.model import STRESS_UNITS, Model, described
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
SCENE_NOTES = (
    "for SOFA v24.12 and v25; before v24.12 poissonRatio was one number for all cells",
    "no gravity; loads grow from t = 0 to 1 s; at 2 s the solid rests in static equilibrium",
)
FOREVER_SECONDS = "1e9"  # past its last key time a LinearMovementProjectiveConstraint lets go


def sofa(model: Model) -> bytes:
    """The bytes of a SOFA scene (.scn), for SOFA v24.12 and v25.

    The node "solid" has the topology "mesh", the state "dofs", a mass of water's density, and corotational linear
    elasticity (TetrahedronFEMForceField) with `youngModulus` for each cell, and `poissonRatio` for each cell where it
    varies, else one number, which SOFA v24.06 takes, too. Below it, "sets" has a node for each set, named like it: of
    facets, "nodes" (PointsFromIndices) and "facets" (TriangleSetTopologyContainer); of cells, "cells"
    (TetrahedronSetTopologyContainer); all by the numbers of the mesh's nodes, from 0.

    Held sets are FixedProjectiveConstraint, moved ones LinearMovementProjectiveConstraint, from 0 to 1 s and held from
    then on. The solver is EulerImplicitSolver with a direct linear solver and steps of 0.1 s, whose damping leaves the
    static solution: with tetopt's own matrices, 180 mm of 0.5 kPa are within 1e-4 of it at 2 s, stiffer ones sooner.
    (SOFA's StaticSolver has changed what it needs, so that no scene with it suits old and new versions.) Cell data has
    no place in a scene; a comment names what is left out.

    Raises
    ------
    InputError
        A 2-D or quadratic model, no materials, or a ratio below 0, in whose place SOFA takes another.
    """
    materials = _checked(model)
    mesh = model.mesh
    scene = [
        f'<?xml version="1.0" encoding="UTF-8"?>\n{_comment(model)}<Node name="root" gravity="0 0 0" dt="0.1">\n',
        *(f'<RequiredPlugin name="{name}"/>\n' for name in REQUIRED_PLUGINS),
        '<VisualStyle displayFlags="showBehaviorModels showForceFields"/>\n<DefaultAnimationLoop/>\n',
        '<Node name="solid">\n<EulerImplicitSolver/>\n',
        '<SparseLDLSolver template="CompressedRowSparseMatrixMat3x3"/>\n',
        f'<TetrahedronSetTopologyContainer name="mesh"\nposition="\n{rows(mesh.points)}"\n',
        f'tetrahedra="\n{rows(mesh.cells)}"/>\n',
        '<TetrahedronSetGeometryAlgorithms template="Vec3"/>\n',
        '<MechanicalObject name="dofs" template="Vec3" position="@mesh.position"/>\n',
        f'<DiagonalMass massDensity="{STRESS_UNITS[model.units].water!r}" topology="@mesh"/>\n',
        _force_field(materials),
        *(_constraint(load, nodes_of(mesh, model.sets.facets[load.set_name])) for load in model.loads),
        *_sets(model),
        "</Node>\n</Node>\n",
    ]
    return "".join(scene).encode("utf-8", "replace")


def _checked(model: Model) -> Materials:
    if model.mesh.ndim == 2:
        raise InputError("sofa: expected a mesh of tetrahedra, got triangles; .vtu holds them")
    if model.order != 1:
        raise InputError("sofa: expected linear cells, got quadratic ones; leave out --order 2")
    if model.materials is None:
        raise InputError("sofa: a scene needs materials; give a law of the modulus (--young)")
    if (model.materials.nu < 0.0).any():
        raise InputError(
            f"sofa: expected 0 <= nu < 0.5, got {model.materials.nu.min():g}, which SOFA would replace; give another"
        )
    check_kinds(model, "sofa", ("displacement",), 1)
    if any(np.isnan(load.numbers).any() for load in model.loads):
        raise InputError("sofa: a set moves in all directions or in none; give numbers instead of free, or take .inp")
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


def _constraint(load: Load, nodes: NDArray[np.int64]) -> str:
    """The indices are written out: a link to those of a set could only lead to what SOFA makes later."""
    indices = f'template="Vec3" topology="@mesh" indices="\n{blocks(nodes)}"'
    if (load.numbers == 0.0).all():
        return f'<FixedProjectiveConstraint name="hold_{load.set_name}" {indices}/>\n'
    whole = " ".join(map(repr, load.numbers.tolist()))
    return (
        f'<LinearMovementProjectiveConstraint name="move_{load.set_name}" {indices}\n'
        f'keyTimes="0 1 {FOREVER_SECONDS}" movements="0 0 0  {whole}  {whole}"/>\n'
    )


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
