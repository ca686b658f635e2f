"""CalculiX's results (.frd) brought back onto the mesh that they are of, read by pyvista-frd-reader.

The reader does not say of which step a result is, gives 0 to nodes that have no line, and reads a file that was cut off
as far as it goes. Steps, numbers of nodes and the end are therefore taken from the lines around the blocks: "1PSTEP"
(number, increment, step), "100C" (time, number of nodes) and "9999", which stand there in binary files, too.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyvista
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.fem.solution import von_mises
from tetopt.geometry.quadratic import quadratic
from tetopt.mesh import Mesh
from tetopt.model.fields import half_turned_fields, stresses_times
from tetopt.model.model import SPACES, STRESS_UNITS, half_turn

# Relative, of a coordinate: half a unit of the sixth digit, which is the last that CalculiX writes, is 5e-6 at most.
WRITTEN_DIGITS = 6e-6
HEAD_BYTES = 4096  # The heading of the .inp, which says units and coordinates, is in the second line.
LINES_BEFORE = re.compile(rb" {4}1PSTEP *\d+ +(\d+) +(\d+)| {2}100C.{18}(.{12})")  # anywhere: binary blocks end no line
TENSOR_ROWS = np.array([0, 3, 5, 3, 1, 4, 5, 4, 2])  # of xx, yy, zz, xy, yz, zx, row by row


class Results(NamedTuple):
    """What a solver found, at the nodes of a mesh."""

    # By name, a row for each node of the mesh (order 1) or of `quadratic` of it (order 2). "displacement" (mm),
    # "strain_nodes", "stress_nodes" (9 columns, row by row; kPa) and "von_mises_nodes" (kPa), RAS+; of the second and
    # further steps with "_step2" and so on behind.
    point_data: dict[str, NDArray[np.float64]]
    order: int
    notes: tuple[str, ...]  # what was assumed or left out, a line each


class _Stage(NamedTuple):
    """An increment of a step of which there are results, and at how many nodes."""

    step: int
    increment: int
    n_nodes: int  # the fewest of its results


def read_frd(path: str | Path, mesh: Mesh) -> Results:
    """The results that CalculiX has written for a mesh, at its nodes, in RAS+, mm and kPa.

    Of each step the last increment that there is. Strains and stresses at the nodes are CalculiX's: its mean, over the
    cells around, of what it carries there from their integration points. Nodes are matched by their numbers, and places
    and cells are compared. Units and convention of the axes are those that the input file, if tetopt wrote it, says in
    its head, which CalculiX copies; otherwise kPa, and whichever axes fit.

    Parameters
    ----------
    path : str or Path
        .frd, ASCII or binary.
    mesh : Mesh
        Tetrahedra: those of the input file, which may be of either order.

    Raises
    ------
    InputError
        A file that is missing, not CalculiX's, cut off, or of another mesh; without displacements; with results at some
        nodes only, or that are no numbers; or pyvista-frd-reader is not installed.
    """
    path = Path(path)
    whole = _checked_bytes(path)
    reader = _reader(path)
    grid = _read(path, reader)
    head = whole[:HEAD_BYTES].decode("latin-1")
    spaces = re.findall(r"coordinates: (RAS|LPS)\+", head)
    order, space = _checked_mesh(path, mesh, grid, tuple(each.lower() for each in spaces[:1]) or SPACES)
    units = re.findall(rf"units: mm, ({'|'.join(STRESS_UNITS)}),", head)
    notes = [] if units else [f"{path.name} does not say its units: stresses are taken for kPa"]
    stages = _stages(path, whole, reader.number_time_points)
    point_data: dict[str, NDArray[np.float64]] = {}
    for step in sorted({stage.step for stage in stages}):
        number = max(k for k, stage in enumerate(stages) if stage.step == step)
        reader.set_active_time_point(number)
        if stages[number].n_nodes != grid.n_points:
            raise InputError(
                f"{path}: has results at {stages[number].n_nodes} of {grid.n_points} nodes in step {step}; ask for "
                "them at all nodes (*NODE FILE and *EL FILE without NSET)"
            )
        suffix = "" if step == 1 else f"_step{step}"
        arrays = _on_mesh(_results_of_step(path, _read(path, reader), step))
        point_data |= {f"{name}{suffix}": values for name, values in arrays.items()}
        if stages[number].increment > 1:
            notes.append(f"step {step}: increment {stages[number].increment}, the last that is in the file")
    point_data = stresses_times(STRESS_UNITS[units[0] if units else "kPa"].kPa, point_data)
    return Results(half_turned_fields(point_data) if space == "lps" else point_data, order, tuple(notes))


def _checked_bytes(path: Path) -> bytes:
    if not path.is_file():
        raise InputError(f"{path}: no such file of results")
    whole = path.read_bytes()
    if not whole.startswith(b"    1C"):
        raise InputError(f"{path}: expected CalculiX's results (.frd), found something else")
    if not whole.rstrip().endswith(b"9999"):
        raise InputError(f"{path}: is cut off; is CalculiX still running, or did it break off?")
    return whole


def _reader(path: Path) -> Any:
    try:
        import pyvista_frd  # an extra: few have CalculiX
    except ImportError as error:
        raise InputError(f"{path}: reading it needs pyvista-frd-reader: pip install 'tetopt[calculix]'") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of cells that it does not know; the mesh's are compared
            return pyvista_frd.FRDReader(path)
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as CalculiX's results ({error})") from error


def _read(path: Path, reader: Any) -> pyvista.UnstructuredGrid:
    """Mesh and results of the reader's time, nodes ascending by their numbers."""
    try:
        return reader.read()
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as CalculiX's results ({error})") from error


def _checked_mesh(path: Path, mesh: Mesh, grid: pyvista.UnstructuredGrid, spaces: tuple[str, ...]) -> tuple[int, str]:
    """Order of the cells and convention of the axes; InputError if the mesh is another one."""
    if mesh.ndim != 3:
        raise InputError(f"{path}: expected a mesh of tetrahedra beside CalculiX's results, got one of triangles")
    nodes_of_order = {1: (mesh.points, mesh.cells), 2: quadratic(mesh.points, mesh.cells)}
    order = next((k for k, (points, _) in nodes_of_order.items() if len(points) == grid.n_points), None)
    if order is None or grid.n_cells != len(mesh.cells):
        raise InputError(
            f"{path}: is of another mesh: expected {len(mesh.cells)} cells and {len(mesh.points)} nodes, or "
            f"{len(nodes_of_order[2][0])} of quadratic cells; it has {grid.n_cells} and {grid.n_points}"
        )
    points, cells = nodes_of_order[order]
    if not np.array_equal(grid.point_data["original_node_ids"], np.arange(1, len(points) + 1)):
        raise InputError(f"{path}: is of another mesh: its nodes are not numbered from 1 to {len(points)}")
    distances = {space: np.abs(grid.points - (half_turn(points) if space == "lps" else points)) for space in spaces}
    space = min(spaces, key=lambda each: float(distances[each].max()))
    is_off = (distances[space] > WRITTEN_DIGITS * np.abs(points)).any(axis=1)
    if is_off.any():
        raise InputError(
            f"{path}: is of another mesh: {int(is_off.sum())} of {len(points)} nodes are elsewhere, by up to "
            f"{float(distances[space].max()):.3g} mm"
        )
    theirs = next(iter(grid.cells_dict.values()))
    if not np.array_equal(np.sort(theirs, axis=1), np.sort(cells, axis=1)):
        raise InputError(f"{path}: is of another mesh: its nodes are connected otherwise")
    return order, space


def _stages(path: Path, whole: bytes, n_times: int) -> list[_Stage]:
    """The increments in the order of the reader's times."""
    stages: dict[tuple[int, int], int] = {}
    present = (1, 1)
    for match in LINES_BEFORE.finditer(whole):
        increment, step, count = match.groups()
        if count is None:
            present = (int(step), int(increment))
        elif count.strip().isdigit():
            stages[present] = min(int(count), stages.get(present, int(count)))
    if not stages:
        raise InputError(f"{path}: has no results; did CalculiX break off?")
    if len(stages) != n_times:
        raise InputError(
            f"{path}: expected one time for each increment, found {len(stages)} increments and {n_times} times"
        )
    return [_Stage(*key, count) for key, count in sorted(stages.items())]


def _results_of_step(path: Path, grid: pyvista.UnstructuredGrid, step: int) -> dict[str, NDArray[np.float64]]:
    """The file's own arrays of this step that are known here, by its names."""
    known = [name for name in ("DISP", "TOSTRAIN", "STRESS") if name in grid.point_data]
    arrays = {name: np.asarray(grid.point_data[name]) for name in known}
    if "DISP" not in arrays:
        raise InputError(f"{path}: has no displacements in step {step}; ask for U (*NODE FILE)")
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise InputError(f"{path}: {name} of step {step} is not a number at some nodes; the solution broke down")
    return arrays


def _on_mesh(arrays: dict[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """CalculiX's arrays under our names, in the file's axes and units."""
    point_data = {"displacement": arrays["DISP"]}
    if "TOSTRAIN" in arrays:
        point_data["strain_nodes"] = arrays["TOSTRAIN"][:, TENSOR_ROWS]
    if "STRESS" in arrays:
        stress = arrays["STRESS"][:, TENSOR_ROWS]
        point_data |= {"stress_nodes": stress, "von_mises_nodes": von_mises(stress.reshape(-1, 3, 3))}
    return point_data
