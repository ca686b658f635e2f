"""The geometric energy E_G: the interpolation error of the paraboloid x^2, Eq. (1) of the paper.

The printed form, 1/(n+1) sum_i x_i^2 |Omega_i| - integral of x^2, subtracts two large numbers. For
each cell it is the integral over the simplex of the linear interpolant of x^2 minus x^2 itself.
With barycentric coordinates b_i that difference is sum_{i<k} b_i b_k |x_i - x_k|^2, and the mean of
b_i b_k over a simplex is 1/((n+1)(n+2)), so

    E_G = sum_j v_j / ((n+1)(n+2)) * sum over the edges of cell j of its squared length,

which needs no origin and cannot cancel. E_G scales as s^(n+2) with the mesh's size s.
"""

from __future__ import annotations

from numpy.typing import NDArray

from tetopt.geometry.simplex import Cells, Points, squared_edges, volumes
from tetopt.geometry.vectors import cross, difference, dot
from tetopt.system.arrays import Floats, simplex_arrays
from tetopt.system.kernel_cache import njit


def cell_E_G(points: Points, cells: Cells) -> Floats:
    """Each cell's contribution to E_G, (M,) float64, mm^(n+2), for points (N, n) in mm and cells
    (M, n+1).
    """
    n = points.shape[1]
    return volumes(points, cells) * squared_edges(points, cells).sum(axis=1) / ((n + 1) * (n + 2))


def E_G(points: Points, cells: Cells) -> float:
    """The geometric energy of equation (1), mm^(n+2).

    The sum over cells of the volume times the squared lengths of all edges, over (n + 1) (n + 2).
    It is small if cells are round and uniform, and independent of the image.

    Parameters
    ----------
    points : (N, n) array of float64
        Node positions, mm, n = 2 or 3.
    cells : (M, n+1) array of int64
        Node indices of each cell.

    Returns
    -------
    float
        mm^(n+2).

    Raises
    ------
    InputError
        Points or cells that are not 2-D arrays of numbers.

    Examples
    --------
    >>> equilateral = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])
    >>> flatter = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, np.sqrt(0.75)]])  # of the same area
    >>> [round(tetopt.E_G(points, np.array([[0, 1, 2]])), 3) for points in (equilateral, flatter)]
    [0.108, 0.126]
    """
    return float(cell_E_G(*simplex_arrays("E_G:", points, cells)).sum())


@njit(cache=True)
def volume_and_E_G(x: NDArray, n_corners: int) -> tuple[float, float]:
    """Unsigned volume and E_G of a cell with corners x (4, 3) in mm; a triangle lies in
    coordinates 1 and 2.
    """
    edges = 0.0
    for i in range(n_corners):
        for k in range(i + 1, n_corners):
            for d in range(4 - n_corners, 3):
                edges += (x[i, d] - x[k, d]) ** 2
    u, v = difference(x, 1, 0), difference(x, 2, 0)
    if n_corners == 4:
        volume = abs(dot(u, cross(v, difference(x, 3, 0)))) / 6.0
    else:
        volume = abs(cross(u, v)[0]) / 2.0
    return volume, volume * edges / (n_corners * (n_corners + 1))


@njit(cache=True)
def volume_gradient(x: NDArray, at: int, n_corners: int) -> tuple:
    """Derivative of the unsigned volume of the cell with corners x (4, 3) by its corner `at`.

    It points from the opposite face to the corner, as long as the face's area over n.
    """
    if n_corners == 4:
        a, b, c = (at + 1) & 3, (at + 2) & 3, (at + 3) & 3
        n = cross(difference(x, b, a), difference(x, c, a))
        v = (n[0] / 6.0, n[1] / 6.0, n[2] / 6.0)
    else:
        a, b = (at + 1) % 3, (at + 2) % 3
        v = (0.0, (x[b, 2] - x[a, 2]) / 2.0, (x[a, 1] - x[b, 1]) / 2.0)
    return v if dot(v, difference(x, at, a)) > 0.0 else (-v[0], -v[1], -v[2])
