"""The solution of a model: displacements, strains, stresses, energies, reactions.

Each step of a model is one linear problem, from the undeformed state. Loads on facets act on nodes
by the weights of `tetopt.model.loads.facet_weights`, which files for other solvers use, too, so
that all of them solve the same equations.

Body and springs store half the product of all forces and their displacements (Clapeyron's theorem):

    strain energy + energy of the springs = 1/2 (forces . u + reactions . prescribed u).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tetopt.errors import InputError
from tetopt.fem.elasticity import (
    RESIDUAL_FRACTION,
    Method,
    Outside,
    System,
    cell_means,
    constrain_nodes,
    fibre_tensor,
    gauss_strains,
    gauss_volumes,
    lame_constants,
    on_one_blas_thread,
    solve_in_steps,
)
from tetopt.geometry.quadratic import cell_edges, gauss_rule, of_order, on_curved_rule, shape_values
from tetopt.geometry.simplex import volumes
from tetopt.mesh import Mesh
from tetopt.model.averages import gauss_young
from tetopt.model.loads import Load, count_of_steps, facet_forces, in_step, spring_constants
from tetopt.model.materials import along_of, density_of
from tetopt.model.model import Model, element_facets, elements, in_units
from tetopt.system.arrays import Bools, Floats

KG_PER_MM3 = 1e-9  # in a kg/m3
# of a matrix's row times its displacements: rounding error in a sum of forces
BALANCE_ROUNDING = 1e-12


class Solution(NamedTuple):
    """Solution of one step of a model in its axes; mm, kPa, mN and uJ (in 2-D per mm of thickness).

    Parameters
    ----------
    u : (N, n) float64
        Displacement, mm, one row per node of the model's order.
    young : (M, Q) float64
        Young's modulus at the Gauss points, kPa.
    strain : (M, Q, n, n) float64
        Strain at the Gauss points.
    stress : (M, Q, n, n) float64
        Stress at the Gauss points, kPa, in 2-D in the plane.
    strain_energy : float
        Energy in the cells, uJ.
    spring_energy : float
        Energy in the springs, uJ.
    work : float
        Half the product of forces, including reactions, and displacements, uJ: the sum of the two
        energies.
    reactions : dict of (n,) float64
        Force of the support or springs on each set that has any, mN.
    applied : (n,) float64
        Sum of pressures, tractions and gravity, mN; the reactions balance it.
    n_iterations : int
        Number of conjugate gradient steps, 0 if the matrix was factorised.
    system : System
        The solved system, for `tetopt.fem.conditioning`.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> loads = ["hold:inferior", "pressure:superior:0.1"]
    >>> model = tetopt.build_model(mesh, image, young="0.1*h", nu=0.45, loads=loads)
    >>> solution = tetopt.solve(model)
    >>> (solution.reactions["inferior"] + solution.applied).round(6).tolist()  # they balance
    [...0.0, ...0.0, ...0.0]
    """

    u: Floats
    young: Floats
    strain: Floats
    stress: Floats
    strain_energy: float
    spring_energy: float
    work: float
    reactions: dict[str, Floats]
    applied: Floats
    n_iterations: int
    system: System


class _Task(NamedTuple):
    """The loads of one step on the nodes of the model's order."""

    is_prescribed: Bools  # (N, n)
    prescribed: Floats  # (N, n) mm
    of_set: dict[str, Bools]  # (N, n) mask of the dofs that a set prescribes
    outside: Outside
    springs: dict[str, Floats]  # (N,) mN/mm, by set


@on_one_blas_thread
def solve(model: Model, step: int = 1, method: Method = "auto") -> Solution:
    """Solve one step for displacements, strains, stresses, energies and reactions.

    Parameters
    ----------
    model : Model
        A model with moduli: those of its materials, or, if given, those at the nodes, linear within
        each cell.
    step : int
        Number of the step, from 1. Loads without a step belong to all steps.
    method : {"auto", "direct", "amg"}
        See `tetopt.fem.elasticity.solve_system`.

    Returns
    -------
    Solution
        Displacements, strains, stresses, energies, reactions.

    Raises
    ------
    InputError
        No moduli, no such step, gravity without a density, an unknown kind of load, or a part that
        can move without strain, as no load constrains it.
    RuntimeError
        No solution, or forces and reactions do not balance, as may happen if moduli differ too
        much.

    See Also
    --------
    build_model : Make a model.
    solution_fields : Convert a solution to fields for a mesh's file.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> loads = ["hold:inferior", "pressure:superior:0.1"]
    >>> model = tetopt.build_model(mesh, image, young="0.1*h", nu=0.45, loads=loads)
    >>> solution = tetopt.solve(model)
    >>> print(f"The top sinks by {-solution.u[:, 2].min():.1f} mm under 0.1 kPa.")
    The top sinks by 2.7 mm under 0.1 kPa.

    A bar of 2 mm, 1 kPa of traction at one end, 10 kPa stiff: it grows by a tenth.

    >>> from tetopt.model.sets import standard_sets
    >>> bar = tetopt.Mesh([[0, 0], [2, 0], [2, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> words = ["hold:x_min", "traction:x_max:1,0"]
    >>> sets = standard_sets(bar)
    >>> model = tetopt.build_model(bar, young=10.0, nu=0.0, known_sets=sets, loads=words)
    >>> solution = tetopt.solve(model)
    >>> [(each.round(12) + 0.0).tolist() for each in (solution.u[1], solution.reactions["x_min"])]
    [[0.2, 0.0], [-1.0, 0.0]]
    """
    model = in_units(model, "kPa")
    n_steps = count_of_steps(model.loads)
    if not 1 <= step <= n_steps:
        raise InputError(f"step: expected 1 to {n_steps}, got {step}")
    if model.materials is None:
        raise InputError("model: the cells have no moduli; give `young`")
    task = _task(model, in_step(model.loads, step))
    young = gauss_moduli(model)
    nu = model.materials.nu[model.materials.of_cell]
    along = along_of(model.materials)
    system = constrain_nodes(
        model.mesh,
        young,
        nu,
        task.is_prescribed,
        task.prescribed,
        order=model.order,
        outside=task.outside,
        along=along,
    )
    u, n_iterations = solve_in_steps(system, method)
    strain = gauss_strains(model.mesh, u)
    if along is None:
        stress = _stress(strain, young, nu)
    else:
        stress = np.einsum("cijkl,cqkl->cqij", fibre_tensor(young[:, 0], nu, along), strain)
    strain_energy = 0.5 * float(
        (gauss_volumes(model.mesh, model.order) * (strain * stress).sum(axis=(2, 3))).sum()
    )
    pull = -task.outside.springs[:, None] * u
    # K includes the springs, so their forces count as the body's, and the remainder is the
    # supports'.
    reaction = (system.K @ u.ravel()).reshape(u.shape) - task.outside.forces
    _check_balance(system, task, reaction, pull, u)
    reactions = {
        name: np.where(where, reaction, 0.0).sum(axis=0) for name, where in task.of_set.items()
    }
    for name, springs in task.springs.items():
        reactions[name] = reactions.get(name, 0.0) - (springs[:, None] * u).sum(axis=0)
    by_supports = np.where(task.is_prescribed, reaction * task.prescribed, 0.0).sum()
    return Solution(
        u,
        young,
        strain,
        stress,
        strain_energy,
        -0.5 * float((pull * u).sum()),
        0.5 * float((task.outside.forces * u).sum() + by_supports),
        reactions,
        task.outside.forces.sum(axis=0),
        n_iterations,
        system,
    )


def gauss_moduli(model: Model) -> Floats:
    """Modulus at the Gauss points of the model's order, (M, Q), in its unit of stress.

    From each cell's material, from linear interpolation of moduli at the nodes, or from the model's
    own Gauss values.
    """
    is_curved = model.mesh.midpoints is not None and model.order == 2
    if model.gauss_young is not None:
        return on_curved_rule(model.gauss_young) if is_curved else model.gauss_young
    if model.node_young is not None:
        return gauss_young(model.node_young, model.mesh, model.order)
    assert model.materials is not None, "callers check that the model has moduli"
    of_cell = model.materials.young[model.materials.of_cell]
    return np.repeat(
        of_cell[:, None], len(gauss_rule(model.mesh.ndim, model.order, is_curved)[1]), axis=1
    )


def _stress(strain: Floats, young: Floats, nu: Floats) -> Floats:
    """Stress (M, Q, n, n), kPa, from strains, moduli (M, Q) and ratios (M,); in 2-D plane
    stress.
    """
    n = strain.shape[-1]
    lame, mu = lame_constants(young, nu[:, None], n)
    spread = lame * np.einsum("cqii->cq", strain)
    return 2.0 * mu[:, :, None, None] * strain + spread[:, :, None, None] * np.eye(n)


# Loads on nodes


def _task(model: Model, loads: tuple[Load, ...]) -> _Task:
    points, cells = elements(model)
    of_set: dict[str, Bools] = {}
    springs: dict[str, Floats] = {}
    task = _Task(
        np.zeros(points.shape, dtype=bool),
        np.zeros(points.shape),
        of_set,
        Outside(np.zeros(points.shape), np.zeros(len(points))),
        springs,
    )
    for load in loads:
        if load.kind == "displacement":
            where = np.zeros(points.shape, dtype=bool)
            # By facets, not by pairs of nodes, as an edge between two nodes of a set may leave it.
            where[np.unique(element_facets(cells, model.sets.facets[load.set_name]))] = ~np.isnan(
                load.numbers
            )
            task.is_prescribed[where] = True
            task.prescribed[where] = np.broadcast_to(load.numbers, where.shape)[where]
            of_set[load.set_name] = where | of_set.get(load.set_name, False)
        elif load.kind == "spring":
            nodes, constants = spring_constants(model.mesh, model.sets, load, model.order)
            task.outside.springs[nodes] += constants
            springs.setdefault(load.set_name, np.zeros(len(points)))[nodes] += constants
        elif load.kind in ("pressure", "traction"):
            nodes, forces = facet_forces(model.mesh, model.sets, load, model.order)
            task.outside.forces[nodes] += forces
        elif load.kind == "gravity":
            table = model.materials
            # or it was rejected
            density = density_of(table)[table.of_cell]  # type: ignore[union-attr]
            task.outside.forces[:] += weight_forces(model.mesh, density, load.numbers, model.order)
        else:
            raise InputError(
                "load: expected displacement, pressure, traction, spring or gravity, got "
                f'"{load.kind}"'
            )
    return task


def weight_forces(mesh: Mesh, density: Floats, acceleration: Floats, order: int) -> Floats:
    """Forces on nodes, (N, n) mN, from a uniform acceleration (n,), mm/s2, of cells with a density
    (M,), kg/m3.

    Each node of a cell gets the integral of its shape function. For order 1 all nodes get the same;
    for order 2 a triangle's weight goes only to its mid-edge nodes, and a tetrahedron's to these
    (1/5 each) and its corners (-1/20 each) (Zienkiewicz and Taylor, The Finite Element Method,
    volume 1, on consistent nodal forces). A curved cell is integrated at its Gauss points.
    """
    n = mesh.ndim
    points, cells = of_order(mesh.points, mesh.cells, order)
    if order == 1:
        fractions = np.full(n + 1, 1.0 / (n + 1))
    else:
        corner, edge = (0.0, 1.0 / 3.0) if n == 2 else (-1.0 / 20.0, 1.0 / 5.0)
        fractions = np.array([corner] * (n + 1) + [edge] * len(cell_edges(n)))
    mass = KG_PER_MM3 * density * volumes(mesh.points, mesh.cells)
    weights = mass[:, None] * fractions
    if order == 2 and mesh.midpoints is not None:
        shapes = shape_values(gauss_rule(n, 2, is_curved=True)[0], 2)
        weights = (KG_PER_MM3 * density)[:, None] * np.einsum(
            "cq,qa->ca", gauss_volumes(mesh, 2), shapes
        )
    at_node = np.bincount(cells.ravel(), weights=weights.ravel(), minlength=len(points))
    return at_node[:, None] * acceleration


def _check_balance(
    system: System,
    task: _Task,
    reaction: Floats,
    pull: Floats,
    u: Floats,
) -> None:
    """Raise RuntimeError unless reactions, forces and springs cancel in their sum and moments about
    any axis.

    Their total work on each rigid motion, of root mean square 1, is that of the residual at the
    free nodes.
    """
    total = np.where(task.is_prescribed, reaction, 0.0) + task.outside.forces + pull
    left = float(np.abs(system.modes.T @ total.ravel()).max())
    residual = (
        10.0 * RESIDUAL_FRACTION * np.sqrt(len(system.free)) * float(np.linalg.norm(system.load))
    )
    size = float(np.abs(system.modes).max())
    allowed = size * (residual + BALANCE_ROUNDING * float(system.K.diagonal() @ np.abs(u.ravel())))
    if not left <= allowed:
        raise RuntimeError(
            f"elasticity: forces and reactions do not balance: the remainder {left:.3g} mN "
            f"exceeds {allowed:.3g} mN"
        )


# Fields on the mesh


def von_mises(stress: Floats) -> Floats:
    """Von Mises stress of stresses (..., n, n); in 2-D plane stress."""
    spread = np.einsum("...ii->...", stress)
    return np.sqrt(np.maximum(1.5 * ((stress**2).sum(axis=(-2, -1)) - spread**2 / 3.0), 0.0))


def node_means(mesh: Mesh, values: Floats) -> Floats:
    """Extrapolate values at Gauss points (M, Q, ...) to the nodes of the order with Q points, (N,
    ...).

    Within a cell they are linear, like strains of order 2, or fitted by least squares in a curved
    cell. A node has the mean over the cells around it, weighted by (straight) volume.
    """
    n = mesh.ndim
    n_places = values.shape[1]
    order = 1 if n_places == 1 else 2
    cells = of_order(mesh.points, mesh.cells, order)[1]
    if order == 2:
        # (n+1, Q): linear values are weighted means of those at the corners.
        places = gauss_rule(n, 2, is_curved=n_places > n + 1)[0]
        at_corners = np.linalg.inv(places) if len(places) == n + 1 else np.linalg.pinv(places)
        at_nodes = np.concatenate([at_corners, at_corners[cell_edges(n)].mean(axis=1)])
    else:
        at_nodes = np.ones((n + 1, 1))
    n_nodes = int(cells.max()) + 1
    flat = values.reshape(len(cells), n_places, -1)
    weight = np.repeat(volumes(mesh.points, mesh.cells)[:, None], cells.shape[1], axis=1)
    around = np.bincount(cells.ravel(), weights=weight.ravel(), minlength=n_nodes)
    columns = [
        np.bincount(
            cells.ravel(),
            weights=(weight * (flat[:, :, k] @ at_nodes.T)).ravel(),
            minlength=n_nodes,
        )
        / around
        for k in range(flat.shape[2])
    ]
    return np.stack(columns, axis=1).reshape(n_nodes, *values.shape[2:])


class SolutionFields(NamedTuple):
    """Fields of a solution for a mesh's file, by name.

    Parameters
    ----------
    cell_data : dict of (M, ...) float64
        Fields with one row per cell.
    point_data : dict of (N, ...) float64
        Fields with one row per node of the order.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> loads = ["hold:inferior", "pressure:superior:0.1"]
    >>> model = tetopt.build_model(mesh, image, young="0.1*h", nu=0.45, loads=loads)
    >>> fields = tetopt.solution_fields(mesh, tetopt.solve(model))
    >>> fields.point_data["displacement"].shape
    (280, 3)
    """

    cell_data: dict[str, Floats]
    point_data: dict[str, Floats]


@on_one_blas_thread
def solution_fields(mesh: Mesh, solution: Solution, step: int = 1) -> SolutionFields:
    """Convert displacement, strain and stress to fields on cells (means) and nodes of a mesh.

    Displacement is in mm; stress and von Mises stress are in kPa; tensors are stored row by row.
    Names for steps after the first end in "_step2" and so on.

    Parameters
    ----------
    mesh : Mesh
        The model's mesh.
    solution : Solution
        Solution of one of its steps.
    step : int
        Number of the step, from 1.

    Returns
    -------
    SolutionFields
        Fields by name, for `save_mesh`.

    Raises
    ------
    InputError
        An invalid mesh or step.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> loads = ["hold:inferior", "pressure:superior:0.1"]
    >>> model = tetopt.build_model(mesh, image, young="0.1*h", nu=0.45, loads=loads)
    >>> fields = tetopt.solution_fields(mesh, tetopt.solve(model))
    >>> tetopt.save_mesh("solved.vtu", mesh, fields.cell_data, point_data=fields.point_data)
    >>> sorted(fields.cell_data)
    ['strain', 'stress', 'von_mises']
    """
    suffix = "" if step == 1 else f"_step{step}"
    n = mesh.ndim
    strain_nodes = node_means(mesh, solution.strain)
    stress_nodes = node_means(mesh, solution.stress)
    cell_data = {
        "strain": cell_means(solution.strain).reshape(-1, n * n),
        "stress": cell_means(solution.stress).reshape(-1, n * n),
        "von_mises": cell_means(von_mises(solution.stress)),
    }
    point_data = {
        "displacement": solution.u,
        "strain_nodes": strain_nodes.reshape(-1, n * n),
        "stress_nodes": stress_nodes.reshape(-1, n * n),
        "von_mises_nodes": von_mises(stress_nodes),
    }
    return SolutionFields(
        {name + suffix: values for name, values in cell_data.items()},
        {name + suffix: values for name, values in point_data.items()},
    )
