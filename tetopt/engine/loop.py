"""Common parts of both engines: history and clock of a run, and the freedom and movement of
nodes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tetopt.contents.content import Content
from tetopt.contents.labels import colours_by_number
from tetopt.energy.sampling import SamplingGrid
from tetopt.engine.curving import Curving
from tetopt.errors import InputError
from tetopt.geometry.box import facets_on_sides
from tetopt.image import Image, transform_vectors
from tetopt.interop import notebook
from tetopt.measure.fidelity import LabelFidelity
from tetopt.mesh import Mesh
from tetopt.system.arrays import Bools, Floats, Ints

# The defaults of all entry points, with their evidence (docs/measured/sizes.md,
# docs/understand/k_d.md).
DEFAULT_NODES = {2: 500, 3: 5000}  # by dimension; a graded mesh of a small image has fewer
# runs that ended before their last iteration, not converged
CUT_SHORT = ("stopped", "max_seconds", "max_gb")
TARGET_NODES_MAX = 50_000  # for a target error, by default
# nearly all of the image's benefit for the displacement, at hardly any cost in shape
UNIFORM_K_D = 0.2
UNIFORM_ITERATIONS = 20  # sweeps over all nodes, as in the paper's figures
# on the MNI152 T1 with 15,000 nodes: a third of the uniform mesh's E_D, mean rho 0.255
GRADED_K_D = 0.85
GRADED_ITERATIONS = 16  # sweeps; four more would lower E_D by 2 % there
# A mesh that follows the image already has a small initial E_D. With 0.02 pytetwild's meshes of
# MNI152 and of a CT improve in E_D, mean and 1st percentile of rho and smallest angle; with 0.05
# MNI152's 165 slivers become 552.
START_K_D = 0.02
SHAPE_POWER = 3.0  # p: from 3 the energy itself keeps angles above the minimum at the uniform k_D
MIN_DIHEDRAL = 12.0  # degrees: the smallest dihedral angle of a cell
# Longest edge over a uniform mesh's for cells of order 2 (docs/understand/order.md): there are
# seven times fewer cells, and the displacement suffers sooner from large ones where the image is
# uniform.
QUADRATIC_RATIO = 1.15
# of sizes, also for order 2: gentler changes lower errors of displacement and interfaces
QUADRATIC_GRADATION = 0.5
# Time for lifting flat cells after the time limit: a fraction of the run's time, and at least this.
# Without the bound slabs of 575 voxels took 27 to 200 s for a limit of one.
GRACE_FRACTION, GRACE_SECONDS = 0.1, 0.5
E_D_ROUNDING = 1e-12  # of the image's variance x volume: a smaller E_D is rounding

Boundary = Literal["slide", "fixed"]


class IterationRecord(NamedTuple):
    """One row of the history; row 0 is the initial mesh.

    Parameters
    ----------
    iteration : int
        Number of the iteration; 0 is the initial mesh.
    E : float
        Energy normalised by the initial mesh, Eq. (4) and Section 4.
    E_G : float
        Geometric energy, mm^(n+2).
    E_D : float
        Discretization energy, intensity^2 mm^n.
    movement : float
        `|x^t - x^(t-1)| / |x^(t-1)|`, with x relative to the box's centre.
    is_retessellated : bool
        True if the connectivity changed in this iteration.
    n_cells : int
        Number of triangles or tetrahedra.
    n_voxels : int
        Number of voxel centres inside the cells; the same in every row.
    seconds : float
        Time since the run began.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> result = tetopt.optimize(image, mesh, k_D=0.5, iterations=3)
    >>> [f"{record.iteration}: {record.E:.2f}" for record in result.history]
    ['0: 1.00', '1: 0.68', '2: 0.61', '3: 0.58']
    """

    iteration: int
    E: float
    E_G: float
    E_D: float
    movement: float
    is_retessellated: bool
    n_cells: int
    n_voxels: int
    seconds: float

    @property
    def counted(self) -> tuple[float, int]:
        """E_D and the number of voxels."""
        return self.E_D, self.n_voxels


class MeshingResult(NamedTuple):
    """Result of `optimize` and, with all fields, of `mesh_image`.

    Parameters
    ----------
    mesh : Mesh
        The optimised mesh.
    history : list of Record
        One row per iteration, starting with the initial mesh.
    ended : {"iterations", "converged", "risen", "max_seconds", "stopped"}
        Reason for the end of the run.
    initial : Mesh
        The mesh at the start of the run.
    nodes : int, optional
        The requested number of nodes, or the number for the target error.
    seconds_start : float
        Time for initial meshes, over all runs towards a target error.
    seconds_run : float
        Time for optimisations, over all runs.
    labels : (M,) int64, optional
        Label of each cell, for a content with memberships.
    violated : mapping of str to str
        Requirements that the mesh violates, by name, one sentence each
        (`tetopt.measure.judge`), judged by `mesh_image`; empty if none.
    extents : sequence of LabelFidelity
        Volumes, components and Dice of the labels, as they were judged.
    fraction : float, optional
        Unexplained fraction of the content's variance: E_D over variance times volume. Only from
        `mesh_image`.
    n_dropped : int
        Connected components that were dropped, since the mask does not have them.
    curving : Curving, optional
        For order 2 with a mask or smooth labels: numbers of edges with their mid-edge node on the
        smooth level.
    dropped : mapping of int to float
        Volume of the dropped components by label, mm^n; all of label 0 without labels.
    content : Content, optional
        What the mesh represents. Only from `mesh_image`.
    order : {1, 2}
        The order that was requested from `mesh_image`.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> result = tetopt.mesh_image(image, 300, iterations=8)
    >>> len(result.mesh.points), result.ended, len(result.violated)
    (300, 'iterations', 0)
    >>> result.history[-1].E < result.history[0].E
    True
    """

    mesh: Mesh
    history: list[IterationRecord]
    ended: str
    initial: Mesh
    nodes: int | None = None
    seconds_start: float = 0.0
    seconds_run: float = 0.0
    labels: Ints | None = None
    violated: Mapping[str, str] = MappingProxyType({})
    extents: Sequence[LabelFidelity] = ()
    fraction: float | None = None
    n_dropped: int = 0
    curving: Curving | None = None
    dropped: Mapping[int, float] = MappingProxyType({})
    content: Content | None = None
    order: int = 1

    def plot(self, values: ArrayLike | None = None, **options: Any) -> Any:
        """Show the mesh in 3-D with pyvista, like `Mesh.plot`; labels in their colours.

        A label has the colour of its number, as in all pictures and files; ``plot(result.labels,
        cmap="tab20")`` uses a colour map instead.

        Parameters
        ----------
        values : (M,) or (N,) array, optional
            A number for each cell, or for each node, to colour the mesh by.
        **options
            Further options of `Mesh.plot`.

        Returns
        -------
        (height, width, 3) array of uint8, or None
            The picture, if no window opened.

        Raises
        ------
        InputError
            As for `Mesh.plot`.

        Examples
        --------
        >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
        >>> result = tetopt.mesh_image(image, 300, iterations=0)
        >>> result.plot(off_screen=True).shape  # doctest: +SKIP
        (768, 1024, 3)
        """
        if values is None and self.labels is not None:
            values, options = colours_by_number(self.labels), {"rgb": True} | options
        return self.mesh.plot(values, **options)

    def _repr_html_(self) -> str:
        """Numbers of the run and of its mesh, with the middle section, for a notebook."""
        last, mesh = self.history[-1], self.mesh
        fraction = (
            "" if self.fraction is None else f", {self.fraction:.4g} of the variance is unexplained"
        )
        rows = [
            (
                "E",
                f"{last.E:.4g} of the initial mesh's, after {last.iteration} iterations "
                f"({self.ended})",
            ),
            ("E_D", f"{last.E_D:.4g} intensity^2 mm^{mesh.ndim}{fraction}"),
            ("time", f"{self.seconds_start + (self.seconds_run or last.seconds):.1f} s"),
            *notebook.mesh_rows(mesh.points, mesh.cells),
            *(("violates", f"{name}: {words}") for name, words in self.violated.items()),
        ]
        pieces = mesh.straight_pieces()[0]
        return notebook.card_html(
            "MeshingResult", rows, notebook.section_html(pieces.points, pieces.cells)
        )


def deadline(
    begin: float, max_seconds: float | None, stop: Callable[[], bool] | None
) -> Callable[[], bool]:
    """Make a function that returns True once the time is over or `stop` returns True."""

    def is_over() -> bool:
        if max_seconds is not None and time.perf_counter() - begin > max_seconds:
            return True
        return stop is not None and stop()

    return is_over


def grace(begin: float, is_over: Callable[[], bool]) -> Callable[[], bool]:
    """Make a function that returns True a tenth of a run's time, or half a second, after the run
    was over.
    """
    ended: list[float] = []

    def is_late() -> bool:
        now = time.perf_counter()
        if not ended and is_over():
            ended.append(now)
        return bool(ended) and now - ended[0] > max(
            GRACE_SECONDS, GRACE_FRACTION * (ended[0] - begin)
        )

    return is_late


def frozen_axes(
    ticks: Ints,
    facets_out: Ints,
    sides: Ints,
    boundary: Boundary,
    has_surface: bool,
) -> Bools:
    """Index axes along which each node must stay, (N, 4) bool; the leading axis of a 2-D image
    counts as free.

    A node on a face of the box, index -0.5 or shape - 0.5, keeps its coordinate across it. A node
    of a boundary facet off the box's faces keeps all coordinates, like every boundary node with
    "fixed"; with a surface on which such nodes slide, it is marked in the last column instead.
    `facets_out` (B, n) are the boundary's facets, `sides` (3, 2) the box's sides, in ticks.
    """
    is_frozen = np.zeros((len(ticks), 4), dtype=bool)
    if boundary == "fixed":
        is_frozen[facets_out.ravel(), :3] = True
        return is_frozen
    is_across = np.any(facets_on_sides(ticks, facets_out, sides, tolerance=0), axis=2)  # (B, 3)
    for axis in range(3):
        is_frozen[facets_out[is_across[:, axis]].ravel(), axis] = True
    elsewhere = facets_out[~np.any(is_across, axis=1)].ravel()
    is_frozen[elsewhere, 3 if has_surface else slice(3)] = True
    return is_frozen


def check_common_options(k_D: float, iterations: int, boundary: str) -> None:
    """Raise InputError for a common option of both engines out of range."""
    if not 0.0 <= k_D < 1.0:
        raise InputError(f"k_D: expected 0 <= k_D < 1, got {k_D}")
    if iterations < 0:
        raise InputError(f"iterations: expected 0 or more, got {iterations}")
    if boundary not in ("slide", "fixed"):
        raise InputError(f"boundary: expected slide or fixed, got {boundary!r}")


def side_ticks(grid: SamplingGrid) -> Ints:
    """`tetopt.geometry.box.box_sides` in ticks, (3, 2), which are whole numbers; a slice is one
    voxel thick.
    """
    half = 1 << (grid.bits - 1)
    return np.array([(-half, (size << grid.bits) - half) for size in grid.shape], dtype=np.int64)


def relative_movement(
    before: Ints,
    after: Ints,
    image: Image,
    grid: SamplingGrid,
    matrix: Floats,
) -> float:
    """|x^t - x^(t-1)| / |x^(t-1)| over all nodes, in mm, with x from the box's centre; Fig.
    1(c).
    """
    centre = np.array([(s - 1) * 0.5 for s in grid.shape]) * 2.0**grid.bits
    moved = transform_vectors((after - before).astype(np.float64), matrix)
    place = transform_vectors(before - centre, matrix)
    return float(np.sqrt((moved**2).sum() / (place**2).sum()))
