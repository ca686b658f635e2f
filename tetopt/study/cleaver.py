"""Cleaver's lattice stuffing (Bronson, Levine, Whitaker 2014) through itk-cleaver, on the same labels.

Cleaver meshes a cube of 2^k voxels. The labels are put into the smallest such cube, isotropic, and continued by their
border values, so that the box's faces are no interfaces and cost no nodes. Cells with their centroid outside the box
are removed, and the remaining boundary is moved onto the box's faces as for fTetWild (`tetwild.put_on_box`).

Each run is a separate process, because Cleaver exits on some inputs ("Degenerate Tet found"), and itk-cleaver 1.3.1
exits on import with every ITK 5.4 tried (5.4.0, 5.4.2, 5.4.7); it works with ITK 5.3.0, which needs numpy < 2.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.box import box_sides
from tetopt.geometry.quadratic import node_count
from tetopt.geometry.simplex import oriented
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.study.endings import NotInstalled, last_line
from tetopt.study.search import corners_for, is_near, tries
from tetopt.study.tetwild import TETWILD_RESPONSE, Filled, inside_box, node_spacing, put_on_box
from tetopt.system.child import signal_words
from tetopt.system.extras import pip_install
from tetopt.system.interpreter import python_command

CLEAVER_RUNS = 8  # of one search, at most, including those that crash
FIRST_SCALING = 2.0  # of features, in the first run: coarse, where runs are fastest
VOXELS_PER_SPACING = 3.0  # of Cleaver's cube, at least, unless the image itself is coarser
CUBE_VOXELS = 256  # along an edge of the cube, at most: the next power of two takes eight times the memory
LIPSCHITZ_BOUND = 0.5  # growth of cells with the distance from the interfaces
# With ITK 5.4, importing it ends Python.
INSTALL_HINT = f"install it with: {pip_install('itk-cleaver', 'itk==5.3.0', 'numpy<2')}"


class Cube(NamedTuple):
    """Labels in Cleaver's cube, and its place in the box frame."""

    labels: NDArray[np.int16]  # (n, n, n), from 0
    voxel: float  # edge length of its voxels, mm
    origin: NDArray[np.float64]  # (3,) mm, its corner


class _RunError(RuntimeError):
    """Cleaver's process ended without a mesh; the text is the reason."""


def stuffed(image: Image, labels: Image, nodes: int, order: int = 1) -> Filled:
    """Cleaver's tetrahedra in the image's box, with about `nodes` nodes.

    The feature scaling is searched until the number of nodes is within 5 % of the requested one, in at most 8 runs;
    the closest is used.

    Parameters
    ----------
    image : Image
        3-D image; its box is filled.
    labels : Image
        Whole numbers, on the image's voxels.
    nodes : int
        Requested number of nodes, 8 or more.
    order : {1, 2}
        Order of the cells whose nodes are counted.

    Returns
    -------
    Filled
        Mesh in the world, positively oriented. Notes report cells removed outside the box, crashed runs, a missed
        number of nodes, and a box that is not filled exactly.

    Raises
    ------
    InputError
        itk-cleaver is missing or cannot be loaded; the labels do not fit the image or have only one value; fewer
        than 8 nodes are requested; no run gave a mesh.
    """
    _check(image, labels, nodes)
    cube = labels_in_cube(image, labels, node_spacing(image, corners_for(nodes, order)) / VOXELS_PER_SPACING)
    low, high = box_sides(image.shape).T * image.spacing
    notes: list[str] = []

    def run(factor: float) -> tuple[NDArray[np.float64], NDArray[np.int64], int] | None:
        """Return nodes and cells in the box, and the number of cells outside."""
        try:
            points, cells = _run(cube, factor)
        except _RunError as error:
            notes.append(f"Cleaver, feature scaling {factor:.3g}: {error}")
            return None
        points, inside = inside_box(points, cells, low, high)
        return points, inside, len(cells) - len(inside)

    begin = time.perf_counter()
    runs = tries(
        run, lambda made: node_count(made[0], made[1], order), nodes, TETWILD_RESPONSE,
        first=FIRST_SCALING, most=CLEAVER_RUNS,
    )  # fmt: skip
    if not runs:
        raise InputError(f"itk-cleaver: no run gave a mesh ({notes[-1]}); request more nodes, or {INSTALL_HINT}")
    points, cells, n_removed = runs[0].result
    search = time.perf_counter() - begin - runs[0].seconds
    try:
        points, cells, _ = put_on_box(points, cells, low, high)
    except InputError as error:
        notes.append(f"its boundary is not on the box's faces: {error}")
    if n_removed:
        notes.append(f"removed {n_removed} cells outside the box")
    n_nodes = node_count(points, cells, order)
    if not is_near(n_nodes, nodes):
        notes.append(f"{n_nodes} nodes after {len(runs)} runs of Cleaver; requested: {nodes}")
    world = image.to_world(points / image.spacing)
    return Filled(Mesh(world, oriented(world, cells)), len(runs), search, notes)


def _check(image: Image, labels: Image, nodes: int) -> None:
    if find_spec("itk") is None or find_spec("itk.CleaverPython") is None:
        raise NotInstalled(f"itk-cleaver: not installed; {INSTALL_HINT}")
    if image.ndim != 3 or labels.shape != image.shape:
        raise InputError(f"labels: expected 3 axes and the image's shape {image.shape}, got {labels.shape}")
    if not labels.is_whole:
        raise InputError("labels: expected whole numbers, got fractions; is this the label volume?")
    if labels.range[0] == labels.range[1]:
        raise InputError("labels: expected two or more, got one, which has no interface to mesh")
    if nodes < 8:
        raise InputError(f"nodes: a box needs 8 or more, got {nodes}")
    probe = _python("from itk import CleaverImageToMeshFilter")
    if probe.returncode != 0:
        raise InputError(f"itk-cleaver: importing it crashes Python ({_ending(probe)}); {INSTALL_HINT}")


def labels_in_cube(image: Image, labels: Image, voxel: float) -> Cube:
    """Sample labels (nearest voxel) on a cube of 2^k isotropic voxels around the box, of about `voxel` mm or less."""
    lengths = image.spacing * image.shape
    n_across = lengths.max() / max(voxel, image.spacing.min())
    n = int(min(2 ** np.ceil(np.log2(max(n_across, 16.0))), CUBE_VOXELS))
    edge = float(lengths.max() / n)
    origin = -0.5 * image.spacing + 0.5 * (lengths - lengths.max())
    index = [
        np.clip(np.rint((origin[axis] + (np.arange(n) + 0.5) * edge) / image.spacing[axis]), 0, image.shape[axis] - 1)
        for axis in range(3)
    ]
    numbered = np.unique(labels.data, return_inverse=True)[1].reshape(labels.shape).astype(np.int16)
    return Cube(numbered[np.ix_(*[i.astype(int) for i in index])], edge, origin)


def _run(cube: Cube, feature_scaling: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Run Cleaver in a separate process; return points in the box frame, and cells."""
    with tempfile.TemporaryDirectory(prefix="tetopt-") as name:
        folder = Path(name)
        np.savez(folder / "job.npz", labels=cube.labels, feature_scaling=feature_scaling, lipschitz=LIPSCHITZ_BOUND)
        # The script itself, not the package: ITK 5.3 and tetopt may need different versions of numpy.
        done = _python(Path(__file__).with_name("cleaver_run.py").read_text(encoding="utf-8"), str(folder))
        if not (folder / "mesh.npz").is_file():
            raise _RunError(_ending(done))
        with np.load(folder / "mesh.npz") as arrays:
            points, cells = arrays["points"].astype(np.float64), arrays["cells"].astype(np.int64)
    points = cube.origin + points * cube.voxel
    cells = oriented(points, cells)
    return points, cells


def _python(program: str, *arguments: str) -> subprocess.CompletedProcess[Any]:
    return subprocess.run(python_command("-c", program, *arguments), capture_output=True, text=True, check=False)


def _ending(done: subprocess.CompletedProcess[Any]) -> str:
    """Describe the end of a process: its signal, or its last line."""
    return signal_words(done.returncode) or last_line(done.stderr) or last_line(done.stdout) or "no message"
