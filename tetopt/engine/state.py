"""Construction of the state of a content and a mesh for the kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content
from tetopt.energy.sampling import SamplingGrid, check_orientations, to_ticks, volume_of
from tetopt.engine.complex import Objective, Sides, State, build, energies
from tetopt.engine.loop import E_D_ROUNDING, SHAPE_POWER, Boundary, frozen_axes, side_ticks
from tetopt.errors import InputError
from tetopt.geometry.check import check_unfolded
from tetopt.geometry.topology import boundary_facets, facets
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.system.arrays import Floats, Ints


def state_of(
    content: Content,
    mesh: Mesh,
    grid: SamplingGrid,
    k_D: float,
    power: float = SHAPE_POWER,
    boundary: Boundary = "slide",
    is_graded: bool = False,
) -> State:
    """The state of an initial mesh, which normalises the two energies, without angle limit; `grid`
    is the content's.

    Raises
    ------
    InputError
        A mesh that is invalid for sampling, is folded or has a cell too flat for a shape energy; or
        energies that overflow.
    """
    state = unweighted_state(content, mesh, grid, power, boundary, is_graded)
    flat = np.flatnonzero(~np.isfinite(state.complex.E_shape[: len(mesh.cells)]))
    if len(flat):
        raise InputError(
            f"mesh: {len(flat)} cells are too flat to optimise, such as {flat[:5].tolist()}; "
            "remove them or move their nodes apart"
        )
    E_G0, squares0 = content_energies(state, content)
    weight = k_D / squares0 if squares0 > 0.0 else 0.0
    if not (0.0 < E_G0 < np.inf and np.isfinite(squares0) and np.isfinite(weight)):
        raise InputError(
            "mesh and image: their energies overflow; are lengths in mm and intensities in a "
            "usual range?"
        )
    geometry, surface = float((1.0 - k_D) / E_G0), float(weight * state.objective.wrong_side)
    return weigh_state(state, geometry, float(weight), surface)


def unweighted_state(
    content: Content,
    mesh: Mesh,
    grid: SamplingGrid,
    power: float,
    boundary: Boundary,
    is_graded: bool = False,
) -> State:
    """The state of a mesh with weight 1 for both energies. Raise InputError like `state_of`, but
    accept flat cells.
    """
    image, region = content.image, content.region
    ticks = to_ticks(image.to_index(mesh.points), grid)
    check_orientations(image, ticks, mesh.cells)
    shared = facets(mesh.cells)
    check_unfolded(mesh, shared)
    matrix = matrix_of(image)
    own_sides = side_ticks(grid)
    is_frozen = frozen_axes(
        ticks, boundary_facets(mesh.cells, shared), own_sides, boundary, region is not None
    )
    sides = sides_of(
        grid, matrix, own_sides, boundary == "fixed", None if region is None else region.level
    )
    # If every cell is uniform, the rounding error of E_D must not become its unit.
    rounding = float(E_D_ROUNDING * content.variance / content.unit * content.n_voxels)
    wrong_side = 0.0 if region is None else float(content.wrong_side)
    objective = objective_of(grid, matrix, power, is_graded)
    objective = objective._replace(rounding=rounding, wrong_side=wrong_side)
    return build(mesh.cells, ticks, is_frozen, objective, sides)


def weigh_state(state: State, geometry: float, image: float, surface: float = 0.0) -> State:
    """The state with other weights of E_G, squares and voxels on the wrong side."""
    return state._replace(
        objective=state.objective._replace(geometry=geometry, image=image, surface=surface)
    )


def content_energies(
    state: State, content: Content, n_means: int | None = None
) -> tuple[float, float]:
    """Shape energy and sum of squares, with the mask's misfit; squares that are only rounding count
    as 0.

    Squares are around the cells' values, as in `tetopt.engine.complex.image_energy`; if `n_means`
    is all channels, they are around means, as in Eq. (3).
    """
    E_G, squares = energies(state, n_means)
    if content.region is not None:
        # Voxels of the mask outside the mesh, and others inside it.
        n_misfits = content.n_voxels + int(
            state.complex.sums[: int(state.complex.n_cells[0]), -1].sum()
        )
        squares += state.objective.wrong_side * n_misfits
    return E_G, squares if squares > state.objective.rounding else 0.0


def matrix_of(image: Image) -> Floats:
    """The map from index vectors to mm, (3, 3); a 2-D image gets a leading axis."""
    matrix = np.eye(3)
    matrix[3 - image.ndim :, 3 - image.ndim :] = image.affine[:-1, :-1]
    return matrix


def sides_of(
    grid: SamplingGrid,
    matrix: Floats,
    own_sides: Ints,
    is_fixed: bool,
    level: NDArray[np.float32] | None,
) -> Sides:
    """`Sides` from a box's sides (3, 2) in ticks, `matrix` (3, 3) from index to mm, and a
    surface's level function.
    """
    low, high = np.ascontiguousarray(own_sides.T)
    has_surface = level is not None
    level = np.zeros((1, 1, 1), dtype=np.float32) if level is None else level.reshape(grid.shape)
    inverse = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    levels, channel = np.zeros((1, 1, 1, 1), dtype=np.float32), np.zeros(0, dtype=np.int64)
    return Sides(
        low, high, is_fixed, has_surface, level, levels, channel, free_projections(matrix), inverse
    )


def free_projections(matrix: Floats) -> Floats:
    """For each set of frozen axes (bit d: axis d), the (3, 3) map from a vector in mm to the index
    vector along the free axes that comes nearest to it: least squares in mm, so it is correct for
    oblique and sheared axes.
    """
    maps = np.zeros((8, 3, 3))
    for frozen in range(8):
        free = [d for d in range(3) if not frozen >> d & 1]
        maps[frozen, free] = np.linalg.pinv(matrix[:, free])
    return maps


def objective_of(
    grid: SamplingGrid, matrix: Floats, power: float, is_graded: bool = False
) -> Objective:
    """An objective of plain numbers, as the kernels require, with weights 1 and without an angle
    limit.
    """
    return Objective(
        volume=volume_of(grid),
        bits=int(grid.bits),
        hand=1 if np.linalg.det(matrix) > 0.0 else -1,
        matrix=matrix,
        geometry=1.0,
        image=1.0,
        surface=0.0,
        n_channels=int(grid.n_channels),
        power=float(power),
        is_graded=bool(is_graded),
        angle_limit=-1.0,
        safe=np.inf,
        rounding=0.0,
        wrong_side=0.0,
        n_means=int(grid.n_channels),
        own_column=np.zeros(0, dtype=np.int64),
        own_value=np.zeros(0),
    )


def with_min_dihedral(state: State, degrees: float) -> State:
    """The state in which no move may leave a dihedral angle below `degrees`, or lower one that
    is below it already.
    """
    angle_limit, safe = angle_limit_of(degrees)
    return state._replace(objective=state.objective._replace(angle_limit=angle_limit, safe=safe))


def angle_limit_of(degrees: float) -> tuple[float, float]:
    """`angle_limit` and `safe` of an `Objective`, for a minimum dihedral angle; 0 for none.

    Among tetrahedra with a dihedral angle t up to a regular one's, eta is least for the one that is
    symmetric about that edge and the opposite one: eta^3 = ((1 + s^2) / (s c))^2 / 8 with s, c =
    sin, cos(t / 2), which falls as t grows. In terms of S and the determinant, eta^3 = S^3 / (432
    det^2).
    """
    if degrees <= 0.0:
        return -1.0, np.inf
    s, c = np.sin(np.radians(degrees) / 2.0), np.cos(np.radians(degrees) / 2.0)
    return -float(np.cos(np.radians(degrees))), float(
        432.0 / 8.0 * ((1.0 + s * s) / (s * c)) ** 2 * (1.0 - 1e-9)
    )
