"""The mesh: points and the simplices between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from tetopt.errors import InputError, prefix_errors
from tetopt.geometry.quadratic import curved_volumes, numbered_edges, quadratic, straight_pieces
from tetopt.geometry.simplex import volumes
from tetopt.interop import conversions, notebook
from tetopt.interop.conversions import MESHIO_KINDS, VTK_KINDS, Fields
from tetopt.system.arrays import Floats, Ints, plain_array, simplex_arrays

if TYPE_CHECKING:
    import meshio
    import pyvista
    import skfem
    import trimesh


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in the plane (n = 2) or tetrahedra in space (n = 3).

    Parameters
    ----------
    points : (N, n) array of float64
        Node positions in world coordinates, mm (RAS+ in 3-D). Read-only.
    cells : (M, n+1) array of int64
        Node indices of each cell, positively oriented: the vectors from the first node to the
        others form a right-handed frame. Read-only.
    midpoints : (E, n) array of float64, optional
        Mid-edge nodes, mm, of quadratic cells whose edges may be curved, in the order of
        `tetopt.geometry.quadratic.numbered_edges`, sorted by their ends. Without them edges are
        straight. Linear cells, sampling of images and conversions use only the corners
        (docs/understand/order.md). Read-only.

    Raises
    ------
    InputError
        Wrong shapes, non-finite points, masked values, no cells, indices out of range, or flat or
        inverted cells (`tetopt.geometry.simplex.orient_cells` turns inverted ones).

    See Also
    --------
    load_mesh : Read a mesh from a file, with its data.
    mesh_image : Mesh an image.
    check_mesh : List the defects of a mesh.

    Examples
    --------
    >>> mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    >>> mesh.ndim, len(mesh.points), len(mesh.cells)
    (2, 3, 1)
    """

    points: Floats
    cells: Ints
    midpoints: Floats | None

    def __init__(
        self, points: ArrayLike, cells: ArrayLike, midpoints: ArrayLike | None = None
    ) -> None:
        points, cells = simplex_arrays("mesh", points, cells)
        n = points.shape[1]
        v = volumes(points, cells)
        if (v <= 0.0).any():
            bad = np.flatnonzero(v <= 0.0)
            raise InputError(
                f"mesh cells: {len(bad)} of {len(cells)} are flat or inverted, such as "
                f"{bad[:5].tolist()}; "
                "orient them or repair the mesh"
            )
        points.setflags(write=False)
        cells.setflags(write=False)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "cells", cells)
        object.__setattr__(
            self,
            "midpoints",
            None if midpoints is None else _check_midpoints(midpoints, cells, n),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Check and lock the arrays of a copy, or of an unpickled mesh, again: pickle keeps
        neither.
        """
        return Mesh, (self.points, self.cells, self.midpoints)

    @property
    def ndim(self) -> int:
        """Number of space dimensions n, 2 or 3."""
        return self.points.shape[1]

    @cached_property
    def cell_volumes(self) -> Floats:
        """Volumes of the cells (areas in 2-D), (M,) float64, mm^n; exact, also with curved
        edges. Read-only.
        """
        if self.midpoints is None:
            sizes = volumes(self.points, self.cells)
        else:
            sizes = curved_volumes(*quadratic(self.points, self.cells, self.midpoints))
        sizes.setflags(write=False)
        return sizes

    def straight_pieces(self) -> tuple[Mesh, int]:
        """Split cells with curved edges into straight ones, for surfaces and overlaps.

        Returns
        -------
        mesh : Mesh
            The mesh itself if its edges are straight. Otherwise each cell becomes 8 (in 2-D 4), in
            its place, with the midpoints as nodes after the corners; a cell that is folded becomes
            straight.
        n_pieces : int
            Number of pieces of each cell: piece ``k`` belongs to cell ``k // n_pieces``.

        Examples
        --------
        >>> middles = [[0.5, -0.1], [0, 0.5], [0.5, 0.5]]
        >>> mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]], middles)
        >>> pieces, n_pieces = mesh.straight_pieces()
        >>> n_pieces, [round(float(each.cell_volumes.sum()), 4) for each in (mesh, pieces)]
        (4, [0.5667, 0.55])
        """
        return (self, 1) if self.midpoints is None else self._pieces

    @cached_property
    def _pieces(self) -> tuple[Mesh, int]:
        assert self.midpoints is not None, (
            "a straight mesh is its own pieces: no reference to itself"
        )
        points, cells = straight_pieces(self.points, self.cells, self.midpoints)
        return Mesh(points, cells), len(cells) // len(self.cells)

    def moved(self, transform: Callable[[Floats], ArrayLike] | ArrayLike) -> Mesh:
        """Move the nodes, with mid-edge nodes, by a map; cells and numbers of nodes stay.

        Parameters
        ----------
        transform : callable or (n+1, n+1) array
            A map of points (K, n), mm, such as `tetopt.load_transform` reads, or an affine matrix.
            By a registration, nodes of the fixed image's mesh move to the moving image by the map
            that resamples images from the moving to the fixed one.

        Returns
        -------
        Mesh
            With the same cells.

        Raises
        ------
        InputError
            A matrix of another shape; places of another shape or not finite; cells that the map
            inverts (`tetopt convert --transform` untangles them).

        See Also
        --------
        load_transform : Read a transform of ITK, ANTs, FSL, AFNI or SPM.

        Examples
        --------
        >>> mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
        >>> mesh.moved([[2, 0, 5], [0, 1, 0], [0, 0, 1]]).points.tolist()
        [[5.0, 0.0], [7.0, 0.0], [5.0, 1.0]]
        >>> mesh.moved(lambda points: points + 1).points.tolist()
        [[1.0, 1.0], [2.0, 1.0], [1.0, 2.0]]
        """
        move = transform if callable(transform) else _affine_map(transform, self.ndim)
        midpoints = None if self.midpoints is None else _places_by(move, self.midpoints)
        with prefix_errors("Mesh.moved"):
            return Mesh(_places_by(move, self.points), self.cells, midpoints)

    def __repr__(self) -> str:
        kind = "tetrahedra" if self.ndim == 3 else "triangles"
        return (
            f"Mesh({len(self.points)} nodes, {len(self.cells)} {kind}, "
            f"{notebook.extent_words(self.points)})"
        )

    def _repr_html_(self) -> str:
        """Numbers and the middle section, for a notebook."""
        pieces = self.straight_pieces()[0]
        picture = notebook.section_html(pieces.points, pieces.cells)
        return notebook.card_html("Mesh", notebook.mesh_rows(self.points, self.cells), picture)

    def plot(
        self,
        values: ArrayLike | None = None,
        *,
        cut: bool = True,
        name: str = "values",
        screenshot: str | Path | None = None,
        off_screen: bool | None = None,
        **look: Any,
    ) -> Any:
        """Show the mesh in 3-D, with straight edges: in a window, in a notebook, or as a picture.

        Parameters
        ----------
        values : (M,) or (N,) array, optional
            A number for each cell, or for each node, to colour the mesh by.
        cut : bool
            Remove the cells of the right, front, upper octant of a 3-D mesh to show its inside.
        name : str
            Name of the values, shown at the colour bar.
        screenshot : str or Path, optional
            Picture file to write, such as ".png"; no window opens.
        off_screen : bool, optional
            If True, open no window and return a picture. By default pyvista's setting, and True on
            Linux without a display.
        **look
            Further options of `pyvista.Plotter.add_mesh`, such as `cmap="gray"` or
            `show_edges=False`.

        Returns
        -------
        (height, width, 3) array of uint8, or None
            The picture, if no window opened. A notebook shows an interactive view if trame is
            installed, else a picture.

        Raises
        ------
        InputError
            Values that match neither the number of cells nor that of nodes.

        Examples
        --------
        >>> mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
        >>> mesh.plot([2.5], off_screen=True).shape  # doctest: +SKIP
        (768, 1024, 3)
        """
        colours = {} if values is None else {name: np.asarray(values)}
        rows = len(self.cells) if values is None else (np.shape(values) or (1,))[0]
        if rows not in (len(self.cells), len(self.points)):
            raise InputError(
                f"plot: expected a number for each of {len(self.cells)} cells or "
                f"{len(self.points)} nodes, got {rows}"
            )
        on_cells = rows == len(self.cells)
        grid = self.to_pyvista(colours) if on_cells else self.to_pyvista(point_data=colours)
        if cut and self.ndim == 3:
            centres = self.points[self.cells].mean(axis=1)
            is_beyond = (centres > 0.5 * (self.points.min(axis=0) + self.points.max(axis=0))).all(
                axis=1
            )
            grid = grid if is_beyond.all() else grid.extract_cells(np.flatnonzero(~is_beyond))
        return conversions.show_grid(grid, next(iter(colours), None), screenshot, off_screen, look)

    def to_pyvista(
        self, cell_data: Fields | None = None, point_data: Fields | None = None
    ) -> pyvista.UnstructuredGrid:
        """Convert the mesh to pyvista, with straight edges and data; in 2-D at z = 0.

        Parameters
        ----------
        cell_data, point_data : dict of arrays, optional
            Numbers by name, one row per cell or per node; the first of each is active. Rows of more
            than one axis are flattened; True and False become 1 and 0.

        Returns
        -------
        pyvista.UnstructuredGrid
            A copy, with VTK cells of kind triangle or tetra. Nodes and cells keep their order.

        Raises
        ------
        InputError
            Data that are not numbers, or with the wrong number of rows.

        Examples
        --------
        >>> mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
        >>> grid = mesh.to_pyvista({"mean": [3.5]})
        >>> grid.n_points, grid.cell_data["mean"].tolist()
        (3, [3.5])
        """
        return conversions.to_pyvista(
            self.points, self.cells, VTK_KINDS[self.ndim, 1], cell_data, point_data
        )

    @classmethod
    def from_pyvista(cls, grid: pyvista.DataSet) -> Mesh:
        """Make a mesh of the tetrahedra of a pyvista or VTK grid; if it has none, of its triangles.

        Cells keep their order, and inverted ones are reoriented (two of their nodes are swapped).
        Unused nodes, vertices, lines, and triangles next to tetrahedra are dropped. Quadratic cells
        keep only their corners, so that curved edges become straight. Data are not copied:
        `grid.cell_data` fits if the grid has no other cells, `grid.point_data` if each of its nodes
        is a corner of a cell.

        Parameters
        ----------
        grid : pyvista.DataSet
            For example an `UnstructuredGrid`, or a `PolyData` of triangles in the plane z = 0.

        Returns
        -------
        Mesh

        Raises
        ------
        InputError
            Other kinds of cells, cells of both orders, no cells, flat cells, triangles off the
            plane z = 0.

        Examples
        --------
        >>> mesh = tetopt.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
        >>> tetopt.Mesh.from_pyvista(mesh.to_pyvista()).cells.tolist()
        [[0, 1, 2, 3]]
        """
        picked = conversions.from_pyvista(grid)
        return cls(picked.points, picked.cells)

    def to_meshio(
        self, cell_data: Fields | None = None, point_data: Fields | None = None
    ) -> meshio.Mesh:
        """Convert the mesh to meshio, with data, as one block of cells with straight edges.

        Parameters
        ----------
        cell_data, point_data : dict of arrays, optional
            Numbers by name, one row per cell or per node.

        Returns
        -------
        meshio.Mesh
            A copy; points of a 2-D mesh have two coordinates. Nodes and cells keep their order.

        Raises
        ------
        InputError
            Data that are not numbers, or with the wrong number of rows.

        Examples
        --------
        >>> mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
        >>> mesh.to_meshio({"mean": [3.5]}).cells_dict["triangle"].tolist()
        [[0, 1, 2]]
        """
        return conversions.to_meshio(
            self.points, self.cells, MESHIO_KINDS[self.ndim, 1], cell_data, point_data
        )

    @classmethod
    def from_meshio(cls, mesh: meshio.Mesh) -> Mesh:
        """Make a mesh of the tetrahedra of a meshio mesh or, if it has none, of its triangles.

        Cells are chosen, reoriented and dropped as in `from_pyvista`.

        Parameters
        ----------
        mesh : meshio.Mesh
            Coordinates in mm.

        Returns
        -------
        Mesh

        Raises
        ------
        InputError
            As for `from_pyvista`.

        Examples
        --------
        >>> mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
        >>> tetopt.Mesh.from_meshio(mesh.to_meshio()).points.tolist()
        [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
        """
        picked = conversions.from_meshio(mesh)
        return cls(picked.points, picked.cells)

    def to_skfem(self) -> skfem.Mesh:
        """Convert the mesh to scikit-fem, with straight edges; `Model.to_skfem` includes the sets.

        Returns
        -------
        skfem.MeshTri or skfem.MeshTet
            A copy. Nodes and cells keep their order; scikit-fem sorts the three nodes of a
            triangle.

        Raises
        ------
        InputError
            scikit-fem is not installed.

        Examples
        --------
        >>> mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
        >>> mesh.to_skfem().p.tolist()
        [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        """
        return conversions.to_skfem(self.points, self.cells)

    @classmethod
    def from_skfem(cls, mesh: skfem.Mesh) -> Mesh:
        """Make a mesh of a scikit-fem mesh; quadratic cells keep only their corners.

        Cells are reoriented and nodes dropped as in `from_pyvista`.

        Parameters
        ----------
        mesh : skfem.MeshTri or skfem.MeshTet
            Coordinates in mm.

        Returns
        -------
        Mesh

        Raises
        ------
        InputError
            Another kind of mesh, flat cells, or scikit-fem is not installed.

        Examples
        --------
        >>> import skfem
        >>> len(tetopt.Mesh.from_skfem(skfem.MeshTet()).cells)
        5
        """
        picked = conversions.from_skfem(mesh)
        return cls(picked.points, picked.cells)

    def to_trimesh(self) -> trimesh.Trimesh:
        """Convert the boundary of a 3-D mesh to trimesh, as it is in the mesh, with straight edges.

        Where cells touch only in an edge or a node, it is not a manifold; `tetopt.extract_surface`
        parts them.

        Returns
        -------
        trimesh.Trimesh
            The boundary's nodes, in the mesh's order, and triangles with outward normals.

        Raises
        ------
        InputError
            A 2-D mesh, whose boundary consists of edges.

        Examples
        --------
        >>> mesh = tetopt.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
        >>> boundary = mesh.to_trimesh()
        >>> bool(boundary.is_watertight), round(float(boundary.volume), 6)
        (True, 0.166667)
        """
        if self.ndim != 3:
            raise InputError(
                "to_trimesh: expected tetrahedra, got triangles, whose boundary consists of edges"
            )
        from tetopt.geometry.topology import boundary_facets

        return conversions.to_trimesh(self.points, boundary_facets(self.cells))


def _affine_map(matrix: ArrayLike, n: int) -> Callable[[Floats], Floats]:
    try:
        A = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"transform: expected a callable or a matrix ({error})") from error
    if A.shape != (n + 1, n + 1) or not np.array_equal(A[n], np.eye(n + 1)[n]):
        raise InputError(
            f"transform: expected a callable, or an affine matrix of {n + 1} x {n + 1} numbers "
            f"with the last row {np.eye(n + 1)[n].tolist()}, got an array of shape {A.shape}"
        )
    # without BLAS, whose rounding depends on the number of threads
    return lambda points: (points[:, None, :] * A[:n, :n]).sum(axis=2) + A[:n, n]


def _places_by(move: Callable[[Floats], ArrayLike], points: Floats) -> Floats:
    places = np.asarray(move(points), dtype=np.float64)
    if places.shape != points.shape:
        raise InputError(
            f"transform: expected {points.shape} coordinates of the points, got {places.shape}"
        )
    return places


def _check_midpoints(midpoints: ArrayLike, cells: Ints, n: int) -> Floats:
    try:
        places = np.array(plain_array("mesh midpoints", midpoints), dtype=np.float64, order="C")
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(f"mesh midpoints: expected an array of numbers ({error})") from error
    expected = (len(numbered_edges(cells)[0]), n)
    if places.shape != expected or not np.isfinite(places).all():
        raise InputError(
            f"mesh midpoints: expected {expected[0]} x {n} finite coordinates, one row per edge, "
            f"got {places.shape}"
        )
    places.setflags(write=False)
    return places
