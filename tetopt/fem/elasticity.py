"""Linear elasticity on the mesh: linear or quadratic displacements in each cell, of order 1 or 2.

The strain energy of a cell is 1/2 u^T B^T C' B u E v, with E the mean of the modulus field over the
cell and v its volume, Eq. (2). In terms of the gradients g_a of the cell's shape functions and the
two Lame constants, the block of the stiffness matrix between nodes a and b is

    K_ab = sum over Gauss points of w v (lambda g_a g_b^T + mu g_b g_a^T + mu (g_a . g_b) I),

which is B_a^T C B_b multiplied out; in two dimensions lambda is that of plane stress. With fibres
the elasticity tensor is `fibre_tensor`. Linear cells have one point; quadratic ones have n + 1,
which integrate it exactly, and the modulus may differ between them. If the mesh has midpoints,
cells are isoparametric: gradients and volumes are those at each point of the curved cell
(Zienkiewicz and Taylor, The Finite Element Method, volume 1, chapter 5), and there are more points.
This takes fewer lines than scikit-fem's forms, is three to six times faster, and makes K symmetric
to the last bit; the tests use scikit-fem as the oracle.

Units: lengths in mm and moduli in kPa = mN/mm^2 give forces in mN and energies in mN mm = uJ. A
two-dimensional mesh is a plate 1 mm thick, in plane stress.

Degrees of freedom are ordered by node: component d of node i is number i n + d. Nodes of order 2
are those of `tetopt.geometry.quadratic.quadratic`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import wraps
from typing import Literal, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import bsr_array, bsr_matrix, csr_array, diags_array, eye_array, kron
from scipy.sparse.linalg import LinearOperator, cg, splu
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from tetopt.errors import InputError
from tetopt.fem.rigidity import check_held, rigid_modes
from tetopt.geometry.box import box_sides, is_on_sides, upright_axis
from tetopt.geometry.check import check_unfolded, facets_on_box, filled_fraction
from tetopt.geometry.quadratic import (
    CURVED_POINTS,
    cell_edges,
    curved_rule,
    gauss_rule,
    jacobian_ratios,
    mapped_slopes,
    of_order,
    on_curved_rule,
    shape_slopes,
)
from tetopt.geometry.simplex import determinants, volume_gradients, volumes
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.mappings import check_nu, check_young
from tetopt.model.materials import Along, check_along
from tetopt.system.arrays import Bools, Floats, Ints, Json
from tetopt.system.budget import check_memory

Method = Literal["auto", "direct", "amg"]
Entries = Callable[[int, int], Floats]
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# Free dofs up to which the matrix is factorised. The cost of a factorisation is its fill-in: in 3-D
# 14 k dofs take 3 s and 57 k take 140 s and 4 GB, whereas multigrid takes 0.3 s and 2 s; in 2-D 100
# k take 1 s.
DIRECT_DOFS = {2: 200_000, 3: 10_000}
# of memory per pair of a cell's nodes: numbers, entries, their sorting, and the matrix
PAIR_BYTES = 160.0
# target residual over load of an iterative solution; ten times as much is an error
RESIDUAL_FRACTION = 1e-10


def on_one_blas_thread(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Wrap a function so that BLAS and LAPACK use one thread, as their rounding depends on the
    sharing of work.

    So results are the same to the last bit on any number of threads. This costs no time: assembly,
    sparse products and relaxation are serial anyway, and inner products and the coarsest grid are
    too small; on a busy machine two threads took four times as long as one.
    """

    @wraps(function)
    def serial(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return serial


class Outside(NamedTuple):
    """External forces and springs on the nodes."""

    forces: Floats  # (N, n) mN, world
    # (N,) mN/mm, from the node to the ground, the same in all directions
    springs: Floats


class System(NamedTuple):
    """K u = f, with some displacements prescribed, and known forces (usually none) on the
    others.
    """

    # (N*n, N*n) of all dofs, including springs; dofs are components along the columns of `frame`
    K: csr_array
    free: Ints  # (F,) dofs that are not prescribed, ascending
    K_ff: csr_array  # (F, F) block of the free dofs: symmetric, positive definite
    # (F,) mN, f - K_fc u_c: the forces, plus those of the prescribed dofs on the free ones
    load: Floats
    prescribed: Floats  # (N*n,) mm, 0 at the free dofs
    modes: Floats  # (N*n, 3 or 6) rigid motions
    # (n, n) a rotation; the identity if dofs are components along the world's axes
    frame: Floats
    # (N, corners) for order 2: linear displacements at its nodes from the corners'
    of_corners: csr_array | None = None


class Compression(NamedTuple):
    """Result of `compression`."""

    u: Floats  # (N, n) displacement, mm, world
    strain_energy: float  # E_strain = 1/2 u^T K u, uJ (per mm of thickness in 2-D)
    reaction: Floats  # (n,) force that holds the pushed nodes, mN, world
    system: System  # the solved system, for `tetopt.fem.conditioning`


def stiffness(
    mesh: Mesh, young: ArrayLike, nu: ArrayLike, order: int = 1, along: Along | None = None
) -> csr_array:
    """Stiffness matrix, (N*n, N*n), mN/mm, of the N nodes of the order; in 2-D plane stress, per mm
    of thickness.

    Parameters
    ----------
    mesh : Mesh
    young : (M,) or (M, Q) array of real numbers, or one for all
        Young's modulus of each cell, kPa, above 0: in Eq. (2) the mean over the cell. Or moduli at
        its Gauss points (`tetopt.geometry.quadratic.gauss_rule`); n + 1 moduli of a curved cell
        belong to its parts nearest to each corner.
    nu : (M,) array, or one number for all
        Poisson's ratio, -1 < nu < 0.5. Near 0.5 linear cells lock, that is, they are far too stiff.
    order : {1, 2}
        Order of the displacements in a cell.
    along : Along, optional
        Fibres of a 3-D mesh, across which `young`, one for each cell, and `nu` hold.

    Returns
    -------
    csr_array
        Exactly symmetric, positive semi-definite; its null space consists of the rigid motions of
        each component.

    Raises
    ------
    InputError
        A modulus that is not above 0, a wrong number of moduli, nu out of range, an invalid order,
        or fibres for the reasons of `tetopt.model.materials.check_along`.

    Examples
    --------
    >>> K = stiffness(Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]]), 2.0, 0.0)
    >>> K.toarray()[0, :3]
    array([ 1.5,  0.5, -1. ])
    """
    elements = elements_of(mesh, order)
    young = _check_young(young, elements)
    nu = _check_nu(nu, mesh)
    return _stiffness(elements, _law(elements, young, nu, np.eye(mesh.ndim), along))


class Elements(NamedTuple):
    """The cells of a mesh as elements of one order; made by `elements_of`."""

    points: Floats  # (N, n) nodes of the order, mm
    cells: Ints  # (M, A) their nodes
    volumes: Floats  # (M,) mm^n
    gradients: Floats  # (M, n+1, n) gradients of the barycentric coordinates, 1/mm
    # (Q, A, n+1) of the shape functions by these coordinates, at the Gauss points
    slopes: Floats
    weights: Floats  # (Q,) weights of the Gauss points
    is_curved: bool = False  # volumes and gradients are always those of straight cells

    def at_points(self, frame: Floats | None = None) -> Iterator[tuple[Floats, ...]]:
        """For each Gauss point, the shape functions' gradients (M, A, n) in a frame (n, n) and
        its volume (M,).
        """
        n = self.points.shape[1]
        turned = self.gradients if frame is None or self.is_curved else self.gradients @ frame
        for slopes, weight in zip(self.slopes, self.weights, strict=True):
            # For linear cells one term is 1 and all others are 0, so their gradients stay exact to
            # the last bit.
            g = sum(slopes[:, k, None] * turned[:, None, k] for k in range(n + 1))
            volume = weight * self.volumes
            if self.is_curved:
                moved = mapped_slopes(self.points[self.cells], g)
                g = g @ (np.linalg.inv(moved) if frame is None else np.linalg.inv(moved) @ frame)
                volume = volume * determinants(moved)
            yield g, volume


def elements_of(mesh: Mesh, order: int) -> Elements:
    """The mesh's cells as elements of order 1 or 2; raise InputError for another order or folded
    cells.
    """
    points, cells = of_order(mesh.points, mesh.cells, order, mesh.midpoints)
    is_curved = mesh.midpoints is not None and order == 2
    places, weights = gauss_rule(mesh.ndim, order, is_curved)
    v, gradients = _gradients(mesh)
    if is_curved and (
        n_folded := int((jacobian_ratios(points, cells, places) <= 0.0).any(axis=1).sum())
    ):
        raise InputError(
            f"mesh: {n_folded} of {len(cells)} quadratic cells are folded by their mid-edge "
            "nodes; use order 1"
        )
    return Elements(points, cells, v, gradients, shape_slopes(places, order), weights, is_curved)


def _law(
    elements: Elements, young: Floats, nu: Floats, frame: Floats, along: Along | None
) -> Entries:
    """The entries (i, j) of the blocks between the nodes of each cell, (M, A, A), with dofs along
    the columns of `frame`, into which gradients and fibres are rotated.

    `young` (M, Q), `nu` (M,).
    """
    n = elements.points.shape[1]
    # Gauss points: gradients of the shape functions, (M, A, n), and the constants there
    points = []
    if along is not None:
        if (young != young[:, :1]).any():
            raise InputError("young: expected one modulus for each cell with fibres, got several")
        along = check_along(along, young[:, 0], nu)
        fibre = _sum(along.fibre[:, k, None] * frame[k] for k in range(3))
        tensor = fibre_tensor(young[:, 0], nu, along._replace(fibre=fibre))

        def of_fibres(i: int, j: int) -> Floats:
            forces = (
                (g, np.einsum("ckl,cbl->cbk", tensor[:, i, :, j], g) * v[:, None, None])
                for g, v in elements.at_points(frame)
            )
            entries = _sum(np.einsum("cak,cbk->cab", *each) for each in forces)
            return 0.5 * (entries + entries.swapaxes(1, 2)) if i == j else entries

        return of_fibres
    for (g, volume), moduli in zip(elements.at_points(frame), young.T, strict=True):
        lame, mu = (constant * volume for constant in lame_constants(moduli, nu, n))
        points.append((g, lame[:, None, None], mu[:, None, None]))
    shear = _sum(
        mu * _sum(g[:, :, None, k] * g[:, None, :, k] for k in range(n)) for g, _, mu in points
    )

    def isotropic(i: int, j: int) -> Floats:
        entries = _sum(
            lame * (g[:, :, None, i] * g[:, None, :, j])
            + mu * (g[:, :, None, j] * g[:, None, :, i])
            for g, lame, mu in points
        )
        if i == j:
            entries += shear
        return entries

    return isotropic


def fibre_tensor(young: Floats, nu: Floats, along: Along) -> Floats:
    """Elasticity tensors (M, 3, 3, 3, 3), kPa, of cells with fibres, across which `young` and `nu`
    (M,) hold; isotropic where the fibre is 0.

    In the fibres' axes they are the inverse of the compliance in `tetopt.model.materials`. With the
    shear moduli mu across and mu + delta along the unit vector f, the stress of a strain e is
    lambda tr(e) I + 2 mu e + alpha (f.e.f I + tr(e) f f^T) + beta f.e.f f f^T
    + 2 delta (f (e f)^T + (e f) f^T) (A.J.M. Spencer, Continuum Theory of the Mechanics of
    Fibre-Reinforced Composites, 1984, chapter 1).
    """
    nu_across = nu**2 * young / along.young_along
    m = 1.0 - nu - 2.0 * nu_across
    c_12 = young * nu / m
    c_22, lame = (young * x / ((1.0 + nu) * m) for x in (1.0 - nu_across, nu + nu_across))
    beta = along.young_along * (1.0 - nu) / m + c_22 - 2.0 * c_12 - 4.0 * along.shear_along
    mu = young / (2.0 * (1.0 + nu))
    eye = np.broadcast_to(np.eye(3), (len(young), 3, 3))
    dyad = along.fibre[:, :, None] * along.fibre[:, None, :]
    tensor = np.zeros((len(young), 3, 3, 3, 3))
    for factor, a, b in (
        (lame, eye, eye),
        (c_12 - lame, eye, dyad),
        (c_12 - lame, dyad, eye),
        (beta, dyad, dyad),
    ):
        tensor += np.einsum("c,cij,ckl->cijkl", factor, a, b)
    delta = along.shear_along - mu
    for factor, a, b in ((mu, eye, eye), (delta, eye, dyad), (delta, dyad, eye)):
        for axes in ("cik,cjl", "cil,cjk"):
            tensor += np.einsum(f"c,{axes}->cijkl", factor, a, b)
    return tensor


def _stiffness(elements: Elements, law: Entries) -> csr_array:
    """`stiffness` of the entries of `_law`."""
    n_nodes, n = elements.points.shape
    n_cells, n_corners = elements.cells.shape
    what = f"elasticity: the stiffness of {n_cells} cells with {n_corners} nodes each"
    check_memory(PAIR_BYTES * n_cells * n_corners**2, what, "use a coarser mesh, or order 1")
    pairs, slot = np.unique(
        elements.cells[:, :, None] * n_nodes + elements.cells[:, None, :], return_inverse=True
    )
    slot = slot.ravel()
    blocks = np.empty((len(pairs), n, n))
    for i in range(n):
        for j in range(i, n):
            entries = law(i, j)
            # (a, b) and (b, a) are summed in the same order of cells, so that K is symmetric to the
            # last bit.
            blocks[:, i, j] = np.bincount(slot, weights=entries.ravel(), minlength=len(pairs))
            if i != j:
                blocks[:, j, i] = np.bincount(
                    slot, weights=entries.swapaxes(1, 2).ravel(), minlength=len(pairs)
                )
    start = np.searchsorted(pairs, np.arange(n_nodes + 1) * n_nodes)
    return bsr_array((blocks, pairs % n_nodes, start), shape=(n_nodes * n, n_nodes * n)).tocsr()


def _sum(arrays: Iterable[Floats]) -> Floats:
    """Sum arrays made one by one, from first to last, in the memory of the first."""
    iterator = iter(arrays)
    total = next(iterator)
    for array in iterator:
        total += array
    return total


def _gradients(mesh: Mesh) -> tuple[Floats, Floats]:
    """Volumes v (M,) and gradients of barycentric coordinates (M, n+1, n), 1/mm: derivatives of
    v by nodes, over v.
    """
    v = volumes(mesh.points, mesh.cells)
    return v, volume_gradients(mesh.points, mesh.cells) / v[:, None, None]


def lame_constants(young: Floats, nu: float | Floats, n: int) -> tuple[Floats, Floats]:
    """Lame's lambda (in 2-D that of plane stress) and mu, kPa."""
    narrowing = 1.0 - nu**2 if n == 2 else (1.0 + nu) * (1.0 - 2.0 * nu)
    return young * (nu / narrowing), young / (2.0 * (1.0 + nu))


def gauss_strains(mesh: Mesh, u: Floats) -> Floats:
    """Strain at the Gauss points of each cell, (M, Q, n, n) float64, symmetric, from displacements
    `u`, (N, n) mm.

    `u` has a row for each node of the mesh (Q = 1), or of order 2 (Q = n + 1, or the number for
    curved cells).
    """
    elements = elements_of(mesh, order_of(mesh, u))
    if elements.is_curved:
        slope = np.stack(
            [np.einsum("cai,caj->cij", u[elements.cells], g) for g, _ in elements.at_points()],
            axis=1,
        )
        return 0.5 * (slope + slope.swapaxes(2, 3))
    slope = np.einsum(
        "cai,qak,ckj->cqij", u[elements.cells], elements.slopes, elements.gradients, optimize=True
    )
    return 0.5 * (slope + slope.swapaxes(2, 3))


def strains(mesh: Mesh, u: Floats) -> Floats:
    """Mean strain in each cell, (M, n, n) float64, symmetric, from displacements `u` as in
    `gauss_strains`.
    """
    return cell_means(gauss_strains(mesh, u))


def cell_means(values: Floats) -> Floats:
    """Mean over each cell, (M, ...), of values at its Gauss points (M, Q, ...); curved cells
    count as straight.
    """
    if (n_points := values.shape[1]) not in CURVED_POINTS:
        return values.mean(axis=1)
    return np.tensordot(values, curved_rule(CURVED_POINTS[n_points])[1], axes=(1, 0))


def gauss_volumes(mesh: Mesh, order: int) -> Floats:
    """The volume of each Gauss point of a cell, (M, Q), mm^n."""
    return np.stack([volume for _, volume in elements_of(mesh, order).at_points()], axis=1)


def order_of(mesh: Mesh, u: Floats) -> int:
    """Order of the displacements `u`: 1 with a row for each node of the mesh, else 2."""
    return 1 if len(u) == len(mesh.points) else 2


# Boundary conditions


def box_faces(image: Image, mesh: Mesh) -> tuple[Ints, Ints]:
    """Nodes on the bottom and the top of the image's box, int64, ascending.

    These are the faces across the index axis nearest to the last world axis: z in 3-D, inferior to
    superior, and y in 2-D.

    Parameters
    ----------
    image : Image
        Its box runs from index -0.5 to shape - 0.5; the affine may be oblique or sheared.
    mesh : Mesh
        Nodes within 1e-6 voxel of a face are on it.

    Returns
    -------
    low_nodes, high_nodes
        Nodes on either face; high is the side of larger z (y in 2-D).

    Raises
    ------
    InputError
        Different dimensions, or a face without nodes.
    """
    n = image.ndim
    if mesh.ndim != n:
        raise InputError(
            f"mesh and image: expected the same dimension, got a {mesh.ndim}-D mesh and a {n}-D "
            "image"
        )
    axis = upright_axis(image.affine)
    index = image.to_index(mesh.points)
    sides = box_sides(image.shape)
    is_on = is_on_sides(index, sides)[:, axis].T  # (2, N)
    place = index[:, axis]
    for side, is_there in zip(sides[axis], is_on, strict=True):
        if not is_there.any():
            raise InputError(
                f"mesh: no node lies on the image's face at index {side:g} of axis {axis}; the "
                f"mesh extends from {place.min():g} to {place.max():g}, not the whole box; is it "
                "of the same image, crop and slice?"
            )
    low, high = (
        np.flatnonzero(is_there)
        for is_there in (is_on if image.affine[n - 1, axis] > 0.0 else is_on[::-1])
    )
    return low, high


def push_of(image: Image, percent: float) -> Floats:
    """Displacement of the bottom in a compression by `percent`, (n,) mm, along the faces' normal
    towards the top.

    `percent` refers to the distance between the two faces of `box_faces`, so that a rotated or
    oblique image is compressed by as much.
    """
    n = image.ndim
    axis = upright_axis(image.affine)
    # normal of the faces, with length 1 over a voxel's thickness
    normal = np.linalg.inv(image.affine[:n, :n])[axis]
    towards_top = 1.0 if image.affine[n - 1, axis] > 0.0 else -1.0
    return 0.01 * percent * image.shape[axis] * towards_top * normal / float(normal @ normal)


def check_fills_box(image: Image, mesh: Mesh) -> None:
    """Raise InputError unless every boundary facet lies on a face of the image's box and the box is
    filled.

    This rejects meshes with cracks, several components, overlaps, or parts joined without shared
    nodes.
    """
    check_unfolded(mesh)
    outer, on_box = facets_on_box(mesh, image)
    if not on_box.all():
        inner = np.flatnonzero(~on_box)
        raise InputError(
            f"mesh: {len(inner)} of its boundary facets lie off the faces of the image's box; the "
            f"first has nodes {outer[inner[0]].tolist()}; the mesh has a crack or several "
            "components, or is of another image or crop"
        )
    filled = filled_fraction(mesh, image)
    if abs(filled - 1.0) > 1e-5:
        raise InputError(
            f"mesh: its cells fill {filled:.6g} of the image's box, so they overlap or leave gaps"
        )


def constrain_nodes(
    mesh: Mesh,
    young: ArrayLike,
    nu: ArrayLike,
    is_prescribed: Bools,
    prescribed: Floats,
    *,
    order: int = 1,
    frame: Floats | None = None,
    outside: Outside | None = None,
    along: Along | None = None,
) -> System:
    """Set up the equations of the mesh with some prescribed displacements.

    Parameters
    ----------
    mesh, young, nu, order, along
        As for `stiffness`.
    is_prescribed : (N, n) bool
        Mask of prescribed components at the nodes of the order.
    prescribed : (N, n) float64
        Displacements, mm; used only where prescribed.
    frame : (n, n) float64, optional
        A rotation. The two arrays, and the system's dofs, are then components along its columns.
    outside : Outside, optional
        Forces and springs on the nodes of the order, in the world. A spring holds its node in all
        directions.

    Raises
    ------
    InputError
        As for `stiffness`; wrong shapes; displacements that are not finite; cells that overlap at a
        common facet; or a part of the mesh that can move without strain, as it has no prescribed
        node or spring, or is connected by too few nodes.
    """
    n = mesh.ndim
    frame = np.eye(n) if frame is None else frame
    elements = elements_of(mesh, order)
    young = _check_young(young, elements)
    nu = _check_nu(nu, mesh)
    is_prescribed = np.asarray(is_prescribed, dtype=bool)
    prescribed = np.asarray(prescribed, dtype=np.float64)
    for name, array in (("is_prescribed", is_prescribed), ("prescribed", prescribed)):
        if array.shape != elements.points.shape:
            raise InputError(
                f"{name}: expected shape {elements.points.shape}, one row per node, got "
                f"{array.shape}"
            )
    values = np.where(is_prescribed, prescribed, 0.0)
    if not np.isfinite(values).all():
        node = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
        raise InputError(
            f"prescribed: displacements must be finite, but node {node} has {values[node].tolist()}"
        )
    check_unfolded(mesh)
    points = elements.points @ frame
    is_sprung = np.zeros(len(points), dtype=bool) if outside is None else outside.springs > 0.0
    check_held(points, elements.cells, is_prescribed | is_sprung[:, None])
    K = _stiffness(elements, _law(elements, young, nu, frame, along))
    if outside is not None and is_sprung.any():
        K = (K + diags_array(np.repeat(outside.springs, n))).tocsr()
    free = np.flatnonzero(~is_prescribed.ravel())
    rows = K[free]
    load = -(rows @ values.ravel())
    if outside is not None:
        load += (outside.forces @ frame).ravel()[free]
    of_corners = None if order == 1 else _of_corners(elements, len(mesh.points))
    return System(
        K, free, rows[:, free], load, values.ravel(), rigid_modes(points), frame, of_corners
    )


def _of_corners(elements: Elements, n_corners: int) -> csr_array:
    """Interpolation of linear displacements at the nodes of order 2, (N, corners): the ends'
    mean on an edge.
    """
    n_nodes, n = elements.points.shape
    ends = np.empty((n_nodes - n_corners, 2), dtype=np.int64)
    ends[elements.cells[:, n + 1 :] - n_corners] = elements.cells[:, cell_edges(n)]
    column = np.concatenate([np.arange(n_corners), ends.ravel()])
    values = np.concatenate([np.ones(n_corners), np.full(ends.size, 0.5)])
    starts = np.concatenate(
        [np.arange(n_corners), np.arange(n_corners, n_corners + ends.size + 1, 2)]
    )
    return csr_array((values, column, starts), shape=(n_nodes, n_corners))


@on_one_blas_thread
def compression(
    mesh: Mesh,
    young: ArrayLike,
    nu: ArrayLike,
    *,
    fixed_nodes: ArrayLike,
    pushed_nodes: ArrayLike,
    displacement: ArrayLike,
    order: int = 1,
    is_bonded: bool = True,
    method: Method = "auto",
) -> Compression:
    """Fix one side of the mesh and push the other: the paper's test of conditioning and strain
    energy (Section 3).

    Parameters
    ----------
    mesh, young, nu, order
        As for `stiffness`.
    fixed_nodes, pushed_nodes : (K,) arrays of integers
        Nodes of the mesh, such as from `box_faces`. The paper fixes the top and pushes the bottom.
        For order 2, nodes between two of them are included.
    displacement : (n,) array
        Displacement of the pushed nodes, mm, world.
    is_bonded : bool
        True: the tissue sticks to both plates; fixed nodes do not move and pushed ones move by
        `displacement`. False: it slides along them without friction; only the displacement along
        the push is prescribed, 0 at the fixed nodes. The remaining rigid motions (sliding across
        and turning about the push) are suppressed at one fixed node and, in 3-D, at the one
        farthest from it; no force acts there, but the matrix is far worse conditioned than that of
        a bonded mesh. Disconnected components could slide apart, and are rejected.
    method : {"auto", "direct", "amg"}
        See `solve_system`.

    Raises
    ------
    InputError
        As for `constrain_nodes`; a side without nodes or with invalid node numbers; a node on both
        sides; or a displacement that is 0 or not n finite numbers.
    RuntimeError
        As for `solve_system`.

    Examples
    --------
    A bar of 2 mm under 1 % of strain: 1/2 E strain^2 volume.

    >>> bar = Mesh([[0, 0], [1, 0], [1, 2], [0, 2]], [[0, 1, 2], [0, 2, 3]])
    >>> pressed = compression(
    ...     bar,
    ...     10.0,
    ...     0.3,
    ...     fixed_nodes=[2, 3],
    ...     pushed_nodes=[0, 1],
    ...     displacement=[0.0, 0.02],
    ...     is_bonded=False,
    ... )
    >>> round(pressed.strain_energy, 12)
    0.001
    """
    n = mesh.ndim
    fixed = _check_nodes("fixed_nodes", fixed_nodes, mesh)
    pushed = _check_nodes("pushed_nodes", pushed_nodes, mesh)
    push = _check_displacement(displacement, n)
    both = np.intersect1d(fixed, pushed)
    if len(both):
        raise InputError(
            f"fixed_nodes and pushed_nodes: {len(both)} nodes are in both, the first "
            f"{both[:5].tolist()}; a node cannot be both fixed and displaced"
        )
    points, cells = of_order(mesh.points, mesh.cells, order, mesh.midpoints)
    if order == 2:
        fixed, pushed = (_with_midpoints(mesh, cells, nodes) for nodes in (fixed, pushed))
    is_prescribed = np.zeros(points.shape, dtype=bool)
    prescribed = np.zeros(points.shape)
    if is_bonded:
        frame = np.eye(n)
        is_prescribed[fixed] = is_prescribed[pushed] = True
        prescribed[pushed] = push
    else:
        frame, partner = _sliding_frame(points[fixed], push)
        is_prescribed[fixed, 0] = is_prescribed[pushed, 0] = True
        is_prescribed[fixed[0]] = True
        is_prescribed[fixed[partner], 2:] = True
        prescribed[pushed, 0] = np.linalg.norm(push)
    system = constrain_nodes(mesh, young, nu, is_prescribed, prescribed, order=order, frame=frame)
    u = solve_system(system, method)
    dofs = (u @ frame).ravel()
    force = system.K @ dofs
    reaction = force.reshape(-1, n)[pushed].sum(axis=0) @ frame.T
    return Compression(u, 0.5 * float(dofs @ force), reaction, system)


def _with_midpoints(mesh: Mesh, cells: Ints, nodes: Ints) -> Ints:
    """Nodes of order 2, with cells `cells`: the given nodes of the mesh, and the mid-edge nodes
    between them.
    """
    is_chosen = np.zeros(len(mesh.points), dtype=bool)
    is_chosen[nodes] = True
    is_between = is_chosen[mesh.cells[:, cell_edges(mesh.ndim)]].all(axis=2)
    return np.union1d(nodes, cells[:, mesh.ndim + 1 :][is_between])


def _sliding_frame(fixed: Floats, push: Floats) -> tuple[Floats, int]:
    """A rotation with the push as first column; the second points from the first fixed point to the
    farthest across.

    The farthest point's number is returned, too. Fixing its third component prevents rotation about
    the push.
    """
    first = push / np.linalg.norm(push)
    if len(push) == 2:
        return np.column_stack([first, [-first[1], first[0]]]), 0
    across = fixed - fixed[0]
    across = across - np.outer(across @ first, first)
    partner = int(np.argmax((across**2).sum(axis=1)))
    second = (
        across[partner]
        if across[partner].any()
        else np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
    )
    second = second - (second @ first) * first
    second = second / np.linalg.norm(second)
    return np.column_stack([first, second, np.cross(first, second)]), partner


# Solution


def solve_system(system: System, method: Method = "auto") -> Floats:
    """Solve for the displacement of every node, (N, n) float64, mm, in world components.

    Parameters
    ----------
    system : System
    method : {"auto", "direct", "amg"}
        Factorisation, or conjugate gradients preconditioned by algebraic multigrid, to a residual
        of 1e-10 of the load. "auto" factorises up to `DIRECT_DOFS` free dofs.

    Raises
    ------
    InputError
        Unknown method.
    RuntimeError
        The residual stayed above ten times that, as it may if moduli differ by more than 9 orders
        of magnitude.
    """
    return solve_in_steps(system, method)[0]


@on_one_blas_thread
def solve_in_steps(system: System, method: Method = "auto") -> tuple[Floats, int]:
    """The result of `solve_system`, and the number of conjugate gradient steps: 0 if the matrix was
    factorised.
    """
    n = len(system.frame)
    n_steps = 0

    def count(_: Floats) -> None:
        nonlocal n_steps
        n_steps += 1

    dofs = system.prescribed.copy()
    if len(system.free):
        if is_direct(system, method):
            solution = factorize_matrix(system.K_ff)(system.load)
        else:
            options: Json = {
                "rtol": RESIDUAL_FRACTION,
                "maxiter": 1000,
                "callback": count,
            }
            solution, _ = cg(system.K_ff, system.load, M=multigrid(system), **options)
        residual = float(np.linalg.norm(system.K_ff @ solution - system.load))
        allowed = 10.0 * RESIDUAL_FRACTION * float(np.linalg.norm(system.load))
        if not residual <= allowed:
            raise RuntimeError(
                f"elasticity: not solved: the residual {residual:.3g} mN exceeds {allowed:.3g} mN"
            )
        dofs[system.free] = solution
    return dofs.reshape(-1, n) @ system.frame.T, n_steps


def is_direct(system: System, method: Method) -> bool:
    """True if the method factorises K_ff; raise InputError for an unknown method."""
    if method not in ("auto", "direct", "amg"):
        raise InputError(f"method: expected auto, direct or amg, got {method!r}")
    return method == "direct" or (
        method == "auto" and len(system.free) <= DIRECT_DOFS[len(system.frame)]
    )


def factorize_matrix(K_ff: csr_array):  # type: ignore[no-untyped-def]
    """The solution of K_ff x = b as a function of b, by sparse factorisation of the positive
    definite K_ff.
    """
    return splu(
        K_ff.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    ).solve


def multigrid(system: System) -> LinearOperator:
    """One V-cycle on K_ff, (F, F), symmetric and deterministic.

    For linear cells it uses smoothed aggregation of nodes, not dofs, which reproduces the rigid
    motions. For that, the prescribed dofs remain as separate, uncoupled equations.

    For quadratic cells the first coarse level consists of the linear displacements, with the K of
    linear cells, and aggregation continues from there. With 333,000 dofs on a BCC lattice, moduli
    of 1 : 10 and nu 0.3, conjugate gradients then take 27 steps and 10 s instead of 49 and 30 s
    with aggregation of all nodes of order 2; with 1 : 10^4 38 and 14 s instead of 292 and 144 s; at
    nu 0.45 41 and 14 s instead of 45 and 25 s, and 66 and 21 s instead of 83 and 44 s.
    """
    # half a second: only when needed
    from pyamg import smoothed_aggregation_solver  # type: ignore[import-untyped]
    from pyamg.multilevel import MultilevelSolver  # type: ignore[import-untyped]
    from pyamg.relaxation.smoothing import change_smoothers  # type: ignore[import-untyped]

    n = len(system.frame)
    n_dofs = system.K.shape[0]
    is_free = np.zeros(n_dofs)
    is_free[system.free] = 1.0
    alone = system.K.diagonal().mean()  # diagonal entry of a prescribed dof
    K = _with_held(system.K, is_free, alone)
    levels = []
    modes = system.modes * is_free[:, None]
    if system.of_corners is not None:
        down = kron(system.of_corners, eye_array(n)).tocsr()
        is_free_corner = is_free[: down.shape[1]]
        down = (diags_array(is_free) @ down @ diags_array(is_free_corner)).tocsr()
        top = MultilevelSolver.Level()
        top.A, top.P, top.R = (
            bsr_matrix(matrix.tobsr((n, n))) for matrix in (K, down, down.T.tocsr())
        )
        levels.append(top)
        K = _with_held((down.T @ K @ down).tocsr(), is_free_corner, alone)
        modes = modes[: len(is_free_corner)]
    hierarchy = smoothed_aggregation_solver(
        bsr_matrix(K.tobsr((n, n))),
        B=modes,
        strength=("symmetric", {"theta": 0.1}),
        smooth=("jacobi", {"weighting": "local"}),  # other weightings start from random vectors
        improve_candidates=None,
        max_coarse=50,
    )
    whole = MultilevelSolver(levels + hierarchy.levels)
    # One sweep over quadratic cells before and one backwards after take more steps, but less time,
    # than two each.
    for_all = [("block_gauss_seidel", {"sweep": "symmetric"})]
    before, after = (
        [("block_gauss_seidel", {"sweep": way})] * len(levels) for way in ("forward", "backward")
    )
    change_smoothers(whole, before + for_all, after + for_all)
    cycle = whole.aspreconditioner(cycle="V")

    def apply(residual: Floats) -> Floats:
        padded = np.zeros(n_dofs)
        padded[system.free] = residual.ravel()
        return (cycle @ padded)[system.free]

    return LinearOperator((len(system.free),) * 2, matvec=apply, dtype=np.float64)


def _with_held(K: csr_array, is_free: Floats, alone: float) -> csr_array:
    """K with the prescribed dofs uncoupled, and `alone` on their diagonal."""
    keep = diags_array(is_free)
    return (keep @ K @ keep + diags_array((1.0 - is_free) * alone)).tocsr()


# Checks of the arguments


def _check_young(young: ArrayLike, elements: Elements) -> Floats:
    """Moduli at the Gauss points, (M, Q)."""
    try:
        young = np.asarray(young, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"young: expected one modulus for each cell, got {young!r}") from error
    n_cells = len(elements.cells)
    n_places = len(elements.weights)
    if young.ndim == 0:
        young = np.full(n_cells, float(young))
    if young.shape == (n_cells,):
        return np.broadcast_to(check_young(young)[:, None], (n_cells, n_places))
    if elements.is_curved and young.shape == (n_cells, elements.points.shape[1] + 1):
        young = on_curved_rule(young)
    if young.shape != (n_cells, n_places):
        raise InputError(
            f"young: expected one modulus for each of {n_cells} cells, got shape {young.shape}"
        )
    check_young(young.min(axis=1))  # any NaN makes this NaN
    check_young(young.max(axis=1))
    return young


def _check_nu(nu: ArrayLike, mesh: Mesh) -> Floats:
    """Poisson's ratios of the cells, (M,)."""
    ratios = np.asarray(nu, dtype=np.float64)
    if ratios.shape not in ((), (len(mesh.cells),)):
        raise InputError(
            f"nu: expected one ratio or one for each of {len(mesh.cells)} cells, got shape "
            f"{ratios.shape}"
        )
    return check_nu(np.broadcast_to(ratios, (len(mesh.cells),)))


def _check_nodes(name: str, nodes: ArrayLike, mesh: Mesh) -> Ints:
    """Distinct node numbers, ascending."""
    nodes = np.asarray(nodes)
    if nodes.size == 0:
        raise InputError(f"{name}: expected at least one node, got none")
    if nodes.ndim != 1 or not np.issubdtype(nodes.dtype, np.integer):
        raise InputError(
            f"{name}: expected a list of node numbers, got {nodes.dtype} of shape {nodes.shape}"
        )
    if nodes.min() < 0 or nodes.max() >= len(mesh.points):
        raise InputError(
            f"{name}: node numbers must lie in 0..{len(mesh.points) - 1}, got "
            f"{nodes.min()}..{nodes.max()}"
        )
    return np.unique(nodes).astype(np.int64)


def _check_displacement(displacement: ArrayLike, n: int) -> Floats:
    vector = np.asarray(displacement, dtype=np.float64)
    if vector.shape != (n,) or not np.isfinite(vector).all() or not vector.any():
        raise InputError(
            f"displacement: expected {n} finite numbers in mm, not all 0, got {vector.tolist()}"
        )
    return vector
