"""Import of CalculiX's results (.frd) onto their mesh, read by pyvista-frd-reader.

The reader does not tell the step of a result, gives 0 to nodes without a line, and reads truncated
files without an error. Steps, numbers of nodes and the end are therefore taken from the lines
around the blocks: "1PSTEP" (number, increment, step), "100C" (time, number of nodes) and "9999",
which binary files have, too.
"""

from __future__ import annotations

import importlib.util
import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tetopt.errors import InputError
from tetopt.fem.solution import von_mises
from tetopt.geometry.quadratic import of_order, quadratic
from tetopt.io.apart import read_apart
from tetopt.mesh import Mesh
from tetopt.model.fields import half_turned_fields, scaled_fields
from tetopt.model.model import SPACES, STRESS_UNITS, half_turn
from tetopt.system.arrays import Arrays, Floats, Ints
from tetopt.system.budget import check_memory, memory_words
from tetopt.system.extras import install_hint
from tetopt.system.incoming import regular_file

# Relative, of a coordinate: half a unit of the sixth digit, which is the last that CalculiX writes,
# is 5e-6 at most.
WRITTEN_DIGITS = 6e-6
HEAD_BYTES = 4096  # the second line has the heading of the .inp, with units and coordinates
LINES_BEFORE = re.compile(
    rb" {4}1PSTEP *\d+ +(\d{1,9}) +(\d{1,9})| {2}100C.{18}(.{12})"
)  # anywhere: binary blocks do not end with a line break
# indices into xx, yy, zz, xy, yz, zx, row by row
TENSOR_ROWS = np.array([0, 3, 5, 3, 1, 4, 5, 4, 2])


KNOWN_ARRAYS = ("DISP", "TOSTRAIN", "STRESS")  # the file's names of arrays


class Results(NamedTuple):
    """Solver results at the nodes of a mesh.

    Parameters
    ----------
    point_data : dict of arrays
        By name, one row per node of the mesh (order 1) or of its
        `tetopt.geometry.quadratic.quadratic` (order 2). "displacement" (mm), "strain_nodes",
        "stress_nodes" (9 columns, row by row; kPa) and "von_mises_nodes" (kPa), RAS+; later steps
        have the suffix "_step2" and so on.
    order : {1, 2}
        Order of the cells.
    notes : tuple of str
        Assumptions and omissions, one line each.

    Examples
    --------
    >>> mesh = tetopt.load_mesh("bar.vtu").mesh
    >>> results = tetopt.read_frd("bar.frd", mesh)  # which CalculiX wrote for bar.inp
    >>> results.order, results.point_data["stress_nodes"].shape == (len(mesh.points), 9)
    (1, True)
    """

    point_data: dict[str, Floats]
    order: int
    notes: tuple[str, ...]


class _Grid(NamedTuple):
    """The contents of the file."""

    points: Floats  # (N, 3)
    ids: Ints  # (N,)
    cells: list[Ints]  # by kind
    n_times: int
    arrays: list[Arrays]  # for each requested time, by the file's names


class _Stage(NamedTuple):
    """An increment of a step with results, and their number of nodes."""

    step: int
    increment: int
    n_nodes: int  # the minimum over its results


def read_frd(path: str | Path, mesh: Mesh) -> Results:
    """Read CalculiX's results for a mesh, at its nodes, in RAS+, mm and kPa.

    Returns the last increment of each step. Strains and stresses at nodes are CalculiX's:
    extrapolated from integration points and averaged over the surrounding cells. Nodes are matched
    by number, and their positions and cells are compared. Units and axes come from the header that
    tetopt writes to the input file and CalculiX copies; without it, kPa and the axes that fit are
    assumed.

    Parameters
    ----------
    path : str or Path
        .frd, ASCII or binary.
    mesh : Mesh
        The tetrahedra of the input file, which may have either order.

    Returns
    -------
    Results
        Displacements, strains and stresses by name.

    Raises
    ------
    InputError
        The file is missing, not CalculiX's, truncated, or belongs to another mesh; it has no
        displacements; it has results at only some nodes, or results that are not numbers;
        pyvista-frd-reader is not installed.

    See Also
    --------
    save_model : Write the input file.
    solve : Solve a model without CalculiX.

    Examples
    --------
    >>> mesh = tetopt.load_mesh("bar.vtu").mesh
    >>> results = tetopt.read_frd("bar.frd", mesh)  # which CalculiX wrote for bar.inp
    >>> list(results.point_data)[:4]
    ['displacement', 'strain_nodes', 'stress_nodes', 'von_mises_nodes']
    >>> tetopt.save_mesh("solved.vtu", mesh, point_data=results.point_data)
    """
    path = Path(path)
    whole = _check_bytes(path)
    stages = _stages(path, whole)
    # the last increment of each
    of_steps = {stage.step: number for number, stage in enumerate(stages)}
    try:
        grid = _Grid(
            *read_apart(_grid_of, path, sorted(of_steps.values()), library="pyvista-frd-reader")
        )
    except InputError as error:
        raise InputError(f"{path}: cannot be read as CalculiX's results ({error})") from error
    if len(stages) != grid.n_times:
        raise InputError(
            f"{path}: expected one time for each increment, found {len(stages)} increments and "
            f"{grid.n_times} times"
        )
    head = whole[:HEAD_BYTES].decode("latin-1")
    spaces = re.findall(r"coordinates: (RAS|LPS)\+", head)
    stated = re.findall(rf"units: m+, ({'|'.join(STRESS_UNITS)}),", head)
    units = STRESS_UNITS[stated[0] if stated else "kPa"]
    grid = grid._replace(points=grid.points * units.mm)
    order, space = _check_mesh(
        path, mesh, grid, tuple(each.lower() for each in spaces[:1]) or SPACES
    )
    notes = [] if stated else [f"{path.name} does not state its units: assuming mm and kPa"]
    point_data: dict[str, Floats] = {}
    for (step, number), of_step in zip(sorted(of_steps.items()), grid.arrays, strict=True):
        if stages[number].n_nodes != len(grid.points):
            raise InputError(
                f"{path}: has results at {stages[number].n_nodes} of {len(grid.points)} nodes in "
                f"step {step}; request them at all nodes (*NODE FILE and *EL FILE without NSET)"
            )
        suffix = "" if step == 1 else f"_step{step}"
        fields = _fields_of_step(path, of_step, step)
        point_data |= {f"{name}{suffix}": values for name, values in fields.items()}
        if stages[number].increment > 1:
            notes.append(f"step {step}: increment {stages[number].increment}, the last in the file")
    point_data = scaled_fields(point_data, units.kPa, units.mm, mesh.ndim)
    return Results(
        half_turned_fields(point_data) if space == "lps" else point_data, order, tuple(notes)
    )


def _check_bytes(path: Path) -> bytes:
    regular_file(path, "file of CalculiX's results (.frd)")
    with path.open("rb") as stream:
        if stream.read(6) != b"    1C":
            raise InputError(f"{path}: expected CalculiX's results (.frd), found something else")
    size = path.stat().st_size
    check_memory(
        size, f"{path}: its {memory_words(size)} of results", "write fewer steps or fields"
    )
    whole = path.read_bytes()
    if not whole.rstrip().endswith(b"9999"):
        raise InputError(
            f"{path}: the file is truncated; is CalculiX still running, or did it abort?"
        )
    if importlib.util.find_spec("pyvista_frd") is None:  # an extra: few have CalculiX
        hint = install_hint("pyvista-frd-reader")
        raise InputError(f"{path}: reading it needs pyvista-frd-reader; {hint}")
    return whole


def _grid_of(path: str, numbers: list[int]) -> tuple[Any, ...]:
    """Return a `_Grid` with the results at some times; runs in a child, as the reader is
    compiled code.
    """
    import pyvista_frd

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about unknown cells; those of the mesh are compared
        reader = pyvista_frd.FRDReader(path)
    grid = reader.read()
    n_times = reader.number_time_points
    arrays = []
    for number in numbers:
        if number < n_times:  # otherwise the times do not match the increments, which is reported
            reader.set_active_time_point(number)
            at = reader.read()
            arrays.append(
                {
                    name: np.asarray(at.point_data[name])
                    for name in KNOWN_ARRAYS
                    if name in at.point_data
                }
            )
    cells = [np.asarray(each) for each in grid.cells_dict.values()]
    ids = np.asarray(grid.point_data["original_node_ids"])
    return np.asarray(grid.points), ids, cells, n_times, arrays


def _check_mesh(path: Path, mesh: Mesh, grid: _Grid, spaces: tuple[str, ...]) -> tuple[int, str]:
    """Return the order of cells and the convention of axes; InputError for another mesh."""
    if mesh.ndim != 3:
        raise InputError(
            f"{path}: expected a tetrahedral mesh for CalculiX's results, got triangles"
        )
    points, cells = quadratic(mesh.points, mesh.cells, mesh.midpoints)
    counts = (len(mesh.points), len(points))
    n_cells = sum(map(len, grid.cells))
    if len(grid.points) not in counts or n_cells != len(mesh.cells):
        raise InputError(
            f"{path}: belongs to another mesh: expected {len(mesh.cells)} cells and {counts[0]} "
            f"nodes (order 2: {counts[1]}), got {n_cells} cells and {len(grid.points)} nodes"
        )
    order = 1 + counts.index(len(grid.points))
    points, cells = of_order(mesh.points, mesh.cells, order, mesh.midpoints)
    if not np.array_equal(grid.ids, np.arange(1, len(points) + 1)):
        raise InputError(
            f"{path}: belongs to another mesh: its nodes are not numbered from 1 to {len(points)}"
        )
    distances = {
        space: np.abs(grid.points - (half_turn(points) if space == "lps" else points))
        for space in spaces
    }
    space = min(spaces, key=lambda each: float(distances[each].max()))
    is_off = (distances[space] > WRITTEN_DIGITS * np.abs(points)).any(axis=1)
    if is_off.any():
        raise InputError(
            f"{path}: belongs to another mesh: {int(is_off.sum())} of {len(points)} nodes are "
            f"displaced by up to {float(distances[space].max()):.3g} mm"
        )
    theirs = grid.cells[0]
    if theirs.shape != cells.shape or not np.array_equal(
        np.sort(theirs, axis=1), np.sort(cells, axis=1)
    ):
        raise InputError(f"{path}: belongs to another mesh: its nodes are connected differently")
    return order, space


def _stages(path: Path, whole: bytes) -> list[_Stage]:
    """Return the increments in the order of the reader's times."""
    stages: dict[tuple[int, int], int] = {}
    present = (1, 1)
    for match in LINES_BEFORE.finditer(whole):
        increment, step, count = match.groups()
        if count is None:
            present = (int(step), int(increment))
        elif count.strip().isdigit():
            stages[present] = min(int(count), stages.get(present, int(count)))
    if not stages:
        raise InputError(f"{path}: has no results; did CalculiX abort?")
    return [_Stage(*key, count) for key, count in sorted(stages.items())]


def _fields_of_step(path: Path, arrays: Arrays, step: int) -> dict[str, Floats]:
    """Return the file's arrays of a step under tetopt's names, in the file's axes and units;
    InputError unless they are usable.
    """
    if "DISP" not in arrays:
        raise InputError(f"{path}: has no displacements in step {step}; request U (*NODE FILE)")
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise InputError(
                f"{path}: {name} of step {step} is not finite at some nodes; the solution diverged"
            )
    fields = {"displacement": arrays["DISP"]}
    if "TOSTRAIN" in arrays:
        fields["strain_nodes"] = arrays["TOSTRAIN"][:, TENSOR_ROWS]
    if "STRESS" in arrays:
        stress = arrays["STRESS"][:, TENSOR_ROWS]
        fields |= {
            "stress_nodes": stress,
            "von_mises_nodes": von_mises(stress.reshape(-1, 3, 3)),
        }
    return fields
