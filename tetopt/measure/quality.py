"""Quality of cells: the paper's four errors, histograms, angles and the kinds of bad cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.geometry.quadratic import curved_volumes, quadratic
from tetopt.geometry.simplex import Cells, Points, dihedral_angles, rho, squared_edges, volumes
from tetopt.interop import notebook
from tetopt.system.arrays import Floats, simplex_arrays

BAD_SHAPE = 0.3  # n rho below which a cell counts as bad: 1 is the regular simplex
SHORT_EDGE = 0.25  # of the longest: a shorter edge makes a flat cell a wedge
NEAR_EDGE = 0.1  # barycentric: a projected node nearer to an edge makes a cap a spade
BLOCK_CELLS = 2**18  # processed at a time: 160 MB


class QualityErrors(NamedTuple):
    """The four errors of Section 2.1; 0 for a mesh of regular simplices, smaller is better.

    Parameters
    ----------
    mean : float
        (i) mean of 1/n - rho.
    harmonic_mean : float
        (ii) harmonic mean of 1/n - rho.
    l2 : float
        (iii) sum of (1/n - rho)^2.
    worst : float
        (iv) largest 1/n - rho.

    Examples
    --------
    Table 1, third row:

    >>> mesh = tetopt.lattice_mesh(tetopt.Image(np.zeros((70, 70))), blocks=(7, 7))
    >>> errors = tetopt.quality(mesh.points, mesh.cells).errors
    >>> f"{errors.mean:.4f} {errors.worst:.4f}"
    '0.0858 0.0858'
    """

    mean: float
    harmonic_mean: float
    l2: float
    worst: float


def quality_errors(points: Points, cells: Cells) -> QualityErrors:
    """The paper's four errors of the radius ratio rho.

    The paper prints (ii) as 1 / sum(1 / err), but its Table 1 fits M / sum(1 / err), the harmonic
    mean, which is used here: in the table's third row, 196 congruent triangles, (ii) equals (i).
    (iii) is the plain sum of squares. An error that rounding makes negative is 0, and (ii) is 0 if
    any error is 0.
    """
    return _errors_of(rho(points, cells), points.shape[1])


def _errors_of(shape: Floats, n: int) -> QualityErrors:
    error = np.maximum(1.0 / n - shape, 0.0)
    harmonic = 0.0 if (error == 0.0).any() else len(error) / float((1.0 / error).sum())
    return QualityErrors(float(error.mean()), harmonic, float((error**2).sum()), float(error.max()))


def rho_histogram(points: Points, cells: Cells, bins: int = 40) -> tuple[Floats, Floats]:
    """Normalised histogram of rho over [0, 1/n] as in Fig. 1(d): fraction of cells, (bins,), and
    edges, (bins + 1,).
    """
    n = points.shape[1]
    counts, edges = np.histogram(
        np.minimum(rho(points, cells), 1.0 / n), bins=bins, range=(0.0, 1.0 / n)
    )
    return counts / len(cells), edges


def cell_kinds(points: Points, cells: Cells, shape: Floats) -> NDArray[np.str_]:
    """The kind of each cell of these `rho`, (M,) str: "good" if n rho >= 0.3, else the kind of bad
    shape.

    Bad tetrahedra (after Cheng, Dey, Edelsbrunner, Facello and Teng 2000) are thin or flat,
    depending on the spread of the four nodes along its principal axes: thin if the middle spread is
    nearer to the smallest than to the largest (geometric mean), flat otherwise. The projection onto
    their plane distinguishes flat ones:

    - ``needle``: thin; all nodes near a line, angles may be good.
    - ``wedge``: flat with two nodes close together (an edge below 1/4 of the longest).
    - ``cap``: flat, one node projected inside the triangle of the others.
    - ``spade``: flat, one node projected (nearly) onto an edge of that triangle.
    - ``sliver``: flat, the projections form a convex quadrilateral; no short edge, two angles near
      180 degrees.

    Triangles: ``needle`` has an edge below 1/4 of the longest, ``cap`` an angle near 180 degrees.
    """
    kinds = np.full(len(cells), "good", dtype="<U6")
    is_bad = points.shape[1] * shape < BAD_SHAPE
    if points.shape[1] == 2:
        edges = squared_edges(points, cells[is_bad])
        is_needle = edges.min(axis=1) < SHORT_EDGE**2 * edges.max(axis=1)
        kinds[is_bad] = np.where(is_needle, "needle", "cap")
    else:
        kinds[is_bad] = _tet_kinds(points[cells[is_bad]])
    return kinds


def _tet_kinds(corners: Floats) -> NDArray[np.str_]:
    """Kinds of bad tetrahedra, corners (B, 4, 3)."""
    centred = corners - corners.mean(axis=1, keepdims=True)
    _, spread, axes = np.linalg.svd(centred)
    is_thin = spread[:, 1] ** 2 <= spread[:, 0] * spread[:, 2]
    edges = squared_edges(corners.reshape(-1, 3), np.arange(4 * len(corners)).reshape(-1, 4))
    is_wedge = edges.min(axis=1) < SHORT_EDGE**2 * edges.max(axis=1)
    # The affine dependence of four points in a plane, sum c_k = 0 and sum c_k x_k = 0: its signs
    # are 3 + 1 if one point lies inside the triangle of the others, 2 + 2 for a convex
    # quadrilateral; a 0 is a point on an edge.
    flat = axes[:, :2] @ centred.swapaxes(1, 2)
    dependence = np.linalg.svd(np.concatenate([flat, np.ones((len(flat), 1, 4))], axis=1))[2][:, -1]
    size = np.abs(dependence)
    is_spade = size.min(axis=1) < NEAR_EDGE * size.max(axis=1)
    is_sliver = (dependence > 0).sum(axis=1) == 2
    return np.select(
        [is_thin, is_wedge, is_spade, is_sliver], ["needle", "wedge", "spade", "sliver"], "cap"
    )


class Quality(NamedTuple):
    """The shape of a mesh in numbers; angles in degrees, volumes in mm^n.

    Parameters
    ----------
    ndim : {2, 3}
        Dimension n.
    n_nodes, n_cells : int
        Numbers of nodes and cells.
    volume, smallest_volume : float
        Total volume, and that of the smallest cell, mm^n.
    mean_rho, p1_rho, min_rho : float
        Mean, 1st percentile and minimum of the radius ratio; a regular cell has 1/n.
    errors : QualityErrors
        The paper's four errors.
    min_dihedral, p1_dihedral, max_dihedral : float
        Smallest angle, 1st percentile of the cells' smallest angles, and largest angle, degrees.
    n_under_10_degrees : int
        Number of cells with a smallest angle below 10 degrees.
    kinds : dict of str to int
        Counts of bad cells by kind.
    min_edge, max_edge : float
        Shortest and longest edge, mm.

    Examples
    --------
    >>> mesh = tetopt.lattice_mesh(tetopt.Image(np.zeros((40, 40, 40))), nodes=300)
    >>> numbers = tetopt.quality(mesh.points, mesh.cells)
    >>> numbers.n_nodes, numbers.n_cells, numbers.kinds["sliver"]
    (280, 1200, 0)
    >>> print(f"{numbers.min_dihedral:.0f} to {numbers.max_dihedral:.0f} degrees")
    39 to 124 degrees
    >>> print(f"rho {numbers.mean_rho:.3f}")
    rho 0.285
    """

    ndim: int
    n_nodes: int
    n_cells: int
    volume: float
    smallest_volume: float
    mean_rho: float
    p1_rho: float
    min_rho: float
    errors: QualityErrors
    min_dihedral: float
    p1_dihedral: float
    max_dihedral: float
    n_under_10_degrees: int
    kinds: dict[str, int]
    min_edge: float
    max_edge: float

    def _repr_html_(self) -> str:
        """The numbers as a table, for a notebook."""
        rows = [
            ("nodes", f"{self.n_nodes:,}"),
            ("cells", f"{self.n_cells:,}"),
            ("volume", f"{self.volume:.6g} mm^{self.ndim}"),
            (
                "rho",
                f"mean {self.mean_rho:.3f}, 1st percentile {self.p1_rho:.3f}, smallest "
                f"{self.min_rho:.3f}",
            ),
            ("angles", f"{self.min_dihedral:.1f} to {self.max_dihedral:.1f} degrees"),
            ("below 10 degrees", f"{self.n_under_10_degrees:,} cells"),
            (
                "badly shaped",
                ", ".join(f"{count:,} {kind}s" for kind, count in self.kinds.items() if count)
                or "none",
            ),
            ("edges", f"{self.min_edge:.4g} to {self.max_edge:.4g} mm"),
        ]
        return notebook.card_html("Quality", rows)


def _of_cells(points: Points, cells: Cells) -> tuple[Floats, ...]:
    """Rho, volume, smallest and largest angle, and squares of the shortest and longest edge of
    cells, (M,) each.
    """
    angles, squares = dihedral_angles(points, cells), squared_edges(points, cells)
    extremes = angles.min(axis=1), angles.max(axis=1), squares.min(axis=1), squares.max(axis=1)
    return rho(points, cells), volumes(points, cells), *extremes


def quality(points: Points, cells: Cells, midpoints: Points | None = None) -> Quality:
    """Measure the shape of a mesh's cells.

    For rho and the four errors see Section 2.1 of the paper
    (`tetopt.measure.quality.quality_errors`), for the kinds of bad cells
    `tetopt.measure.quality.cell_kinds`, for angles `tetopt.geometry.simplex.dihedral_angles`.

    Parameters
    ----------
    points : (N, n) array of float64
        Node positions, mm, n = 2 or 3.
    cells : (M, n+1) array of int64
        Node indices of each cell.
    midpoints : (E, n) array of float64, optional
        Those of the mesh, if its edges are curved. Volumes are of these cells; all else is of the
        corners.

    Returns
    -------
    Quality
        Counts, volumes, rho, angles, bad cells by kind, edges.

    Raises
    ------
    InputError
        Points or cells that are not 2-D arrays of numbers, points that are not finite, or cells
        that do not index them.

    See Also
    --------
    check_mesh : List the defects of a mesh.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.mesh_image(image, 300, iterations=4).mesh
    >>> numbers = tetopt.quality(mesh.points, mesh.cells)
    >>> numbers.n_nodes, numbers.min_dihedral > 12
    (300, True)
    """
    points, cells = simplex_arrays("quality:", points, cells)
    n = points.shape[1]
    # Block by block, as the temporaries take 600 bytes per cell.
    blocks = [
        _of_cells(points, cells[at : at + BLOCK_CELLS]) for at in range(0, len(cells), BLOCK_CELLS)
    ]
    shape, v, smallest, largest, shortest, longest = (
        np.concatenate(each) for each in zip(*blocks, strict=True)
    )
    v = (
        v
        if midpoints is None
        else curved_volumes(*quadratic(points, np.asarray(cells, dtype=np.int64), midpoints))
    )
    names = ("needle", "wedge", "cap", "spade", "sliver") if n == 3 else ("needle", "cap")
    kinds = cell_kinds(points, cells, shape)
    return Quality(
        ndim=n,
        n_nodes=len(points),
        n_cells=len(cells),
        volume=float(v.sum()),
        smallest_volume=float(v.min()),
        mean_rho=float(shape.mean()),
        p1_rho=float(np.percentile(shape, 1)),
        min_rho=float(shape.min()),
        errors=_errors_of(shape, n),
        min_dihedral=float(smallest.min()),
        p1_dihedral=float(np.percentile(smallest, 1)),
        max_dihedral=float(largest.max()),
        n_under_10_degrees=int((smallest < 10.0).sum()),
        kinds={name: int((kinds == name).sum()) for name in names},
        min_edge=float(np.sqrt(shortest.min())),
        max_edge=float(np.sqrt(longest.max())),
    )
