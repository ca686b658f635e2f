"""What came of a hostile input, by code that shares nothing with tetopt's own checks."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple

import meshio
import nibabel
import numpy as np
import trimesh
from fuzz.cases import Case

GOOD = ("done", "refused", "requirement violated")
BAD = (
    "traceback",
    "signal",
    "hang",
    "memory",
    "invalid output",
    "half-written",
    "stray file",
    "let in",
    "refused badly",
    "wrong exit code",
)
LONGEST_LINE = 500  # characters of a refusal
SHORTEST_LINE = 24  # "tetopt: " and less than two words say nothing
# of memory beyond the libraries: a reader in its own process may take 2 GiB
MOST_BYTES = 2_200_000_000
OUTSIDE_VOXELS = 1e-3  # of digits that a text leaves out
MOST_CONDITION = 1e6  # of an affine whose inverse tells where a node is
# What a library has said itself, past tetopt.
RAW_TEXT = re.compile(
    r"0x[0-9a-f]{8}|\.cxx|itk::|vtk\w+ \(|Generic Warning|^Warning|^ERROR|\.py:\d+|Traceback|"
    r"terminate called|libpng|TIFF|RuntimeWarning|UserWarning|DeprecationWarning|^WARNING"
)
# outputs before the one that failed
SAID_WRITTEN = re.compile("^written before the error: |is kept", re.MULTILINE)
CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]")
TRACED = re.compile(r'File "[^"]*?(tetopt/[\w/]+\.py)", line (\d+), in (\w+)')


class Ending(NamedTuple):
    """How a command ended."""

    code: int  # below 0: by that signal
    is_killed: bool  # for its time
    seconds: float
    n_bytes: int  # of memory at most, beyond what it began with
    output: str
    errors: str


class Verdict(NamedTuple):
    """An outcome, why, and what makes it the same as another one."""

    outcome: str
    why: str
    key: str


def verdict(case: Case, folder: Path, before: dict[str, tuple], ending: Ending) -> Verdict:
    """The outcome of a case that ran in a folder, in which these files lay before."""
    outcome, why = _verdict(case, folder, before, ending)
    key = re.sub(r"'[^']*'|\"[^\"]*\"|\d+", "#", why)[:160]
    if outcome == "traceback":
        key = why
    elif outcome in ("signal", "hang", "memory"):
        key = f"{case.kind} {case.words[:1]} {key if outcome == 'signal' else ''} {_suffixes(case)}"
    return Verdict(outcome, why, f"{outcome}: {key}")


def _suffixes(case: Case) -> str:
    return " ".join(
        sorted({Path(name.encode("utf-8", "replace").decode()).suffix for name in case.files})
    )


def _verdict(case: Case, folder: Path, before: dict[str, tuple], ending: Ending) -> tuple[str, str]:
    if ending.is_killed:
        return "hang", f"killed after {ending.seconds:.0f} s"
    if ending.code == -24:  # SIGXCPU
        return "hang", "CPU time used up"
    if ending.code < 0:
        return "signal", f"signal {-ending.code}: {ending.errors.strip()[-200:]}"
    if ending.code == 70 or "Traceback (most recent call last)" in ending.errors:
        last = ending.errors.strip().splitlines()[-1][:160]
        frames = TRACED.findall(ending.errors)
        where = f"{frames[-1][0]}:{frames[-1][1]} {frames[-1][2]}" if frames else "?"
        return "traceback", f"{re.sub(r'[0-9]+', '#', last)[:90]} at {where}"
    if ending.n_bytes > MOST_BYTES:
        return "memory", f"{ending.n_bytes / 1e9:.1f} GB"
    return _of_files(case, folder, before, ending) or _of_words(case, ending)


def _of_files(
    case: Case, folder: Path, before: dict[str, tuple], ending: Ending
) -> tuple[str, str] | None:
    """What is wrong with the files that are there now, if anything is."""
    after = listing(folder)
    changed = [name for name, stamp in before.items() if after.get(name) != stamp]
    if any(name not in case.outputs for name in changed):
        return "stray file", f"changed: {changed[:3]}"
    new = {name for name in after if name not in before}
    outputs = {os.path.normpath(f"cwd/{name}") for name in case.outputs}
    strays = sorted(
        name
        for name in new
        if not any(name == each or name.startswith(each + "/") for each in outputs)
    )
    if strays:
        return "stray file", f"left behind: {strays[:3]}"
    if ending.code == 2 and new and not SAID_WRITTEN.search(ending.errors):
        return "half-written", f"refused, but wrote {sorted(new)[:3]}: {_last(ending)[:100]}"
    for name in sorted(new):
        path = folder / name
        if path.is_file() and (problem := output_problem(path, case)):
            return "invalid output", f"{Path(name).suffix}: {problem}"
    if ending.code == 0 and case.is_forbidden:
        return "let in", f"{case.what[:80]} was taken"
    is_help = any(word in ("--help", "-h", "--version") for word in case.words)
    is_due = outputs and not is_help and case.kind not in ("command lines", "special files")
    if ending.code == 0 and is_due and not new:
        return "wrong exit code", f"0, but nothing was written: {ending.output[-60:]!r}"
    return None


def _of_words(case: Case, ending: Ending) -> tuple[str, str]:
    """What is wrong with what was said, if anything is, and the exit code."""
    lines = ending.errors.splitlines()
    text = ending.errors + ending.output
    if match := CONTROL.search(text):
        return (
            "refused badly",
            f"control character {match[0]!r} in "
            f"{text[max(match.start() - 30, 0) : match.end() + 10]!r}",
        )
    raw = [line for line in lines if RAW_TEXT.search(line) and not line.startswith("tetopt:")]
    if raw:
        return "refused badly", f"raw text: {raw[0][:120]}"
    if ending.code not in (0, 1, 2):
        return "wrong exit code", f"{ending.code}: {_last(ending)[:120]}"
    mistakes = [
        line
        for line in lines
        if line.startswith("tetopt: ") and not line.startswith("tetopt: warning:")
    ]
    if ending.code == 0:
        return ("done", "") if not mistakes else ("wrong exit code", f"0, but {mistakes[0][:120]}")
    if not mistakes:
        is_help = ending.code == 2 and not case.words  # a bare `tetopt` prints its help
        return (
            ("refused", "")
            if is_help
            else ("refused badly", f"exit {ending.code} without a line: {_last(ending)[:100]!r}")
        )
    if ending.code == 1:
        return "requirement violated", mistakes[0][:120]
    if len(mistakes) > 1:
        return "refused badly", f"{len(mistakes)} lines: {mistakes[0][:80]} / {mistakes[1][:80]}"
    if (
        not lines[-1].startswith(("tetopt: ", "written before the error: "))
        or len(mistakes[0]) < SHORTEST_LINE
        or mistakes[0].endswith(": ")
    ):
        return "refused badly", f"the line: {lines[-1][:120]}"
    if len(mistakes[0]) > LONGEST_LINE + sum(len(word) for word in case.words if len(word) > 60):
        return "refused badly", f"{len(mistakes[0])} characters: {mistakes[0][:90]}"
    return "refused", mistakes[0]


def _last(ending: Ending) -> str:
    lines = ending.errors.strip().splitlines()
    return lines[-1] if lines else ""


def listing(folder: Path) -> dict[str, tuple]:
    """All files below a folder, with what tells whether they are the same."""
    found = {}
    for root, folders, names in os.walk(folder):
        for name in [
            *names,
            *(each for each in folders if os.path.islink(os.path.join(root, each))),
        ]:
            path = os.path.join(root, name)
            stamp = os.lstat(path)
            found[os.path.relpath(path, folder)] = (
                stamp.st_size,
                stamp.st_mtime_ns,
                stamp.st_mode,
                stamp.st_ino,
            )
    return found


# Outputs


def output_problem(path: Path, case: Case) -> str:
    """What is wrong with a file that was written; nothing if it is sound."""
    suffix = "".join(path.suffixes[-2:]) if path.name.endswith(".gz") else path.suffix
    try:
        return _problem(path, suffix.lower(), case)
    except (Exception, SystemExit) as error:  # which meshio raises
        return f"cannot be parsed: {type(error).__name__} {str(error)[:100]}"


def _problem(path: Path, suffix: str, case: Case) -> str:
    data = path.read_bytes()
    if not data:
        return "empty"
    if suffix in (".vtu", ".feb", ".xdmf", ".vtp"):
        ET.fromstring(data)
    if suffix in (".html", ".feb", ".vtu", ".xdmf") and b"<script>hostile()" in data:
        return "markup let in"
    if suffix in (".inp", ".feb", ".msh", ".msh2", ".mesh", ".html") and re.search(
        rb"[\x00-\x08\x0b\x0c\x0e-\x1f]", data
    ):
        return "control characters in a text"
    if suffix == ".json":
        json.loads(data, parse_constant=lambda name: 1 / 0)
        return ""
    if suffix in (".nii", ".nii.gz"):
        image = nibabel.load(path)
        return (
            ""
            if np.isfinite(np.asarray(image.dataobj)).all() and np.isfinite(image.affine).all()
            else "not finite"
        )
    if suffix in (".ply", ".stl"):
        surface = trimesh.load(path, process=False)
        sound = (
            len(surface.faces)
            and np.isfinite(surface.vertices).all()
            and surface.faces.max() < len(surface.vertices)
        )
        return "" if sound else "no triangles, or nodes that are not finite"
    if suffix == ".vtk" and b"POLYDATA" in data[:400]:  # which meshio does not read
        return ""
    if suffix in (".vtu", ".vtk", ".msh", ".msh2", ".inp", ".mesh", ".xdmf"):
        return _mesh_problem(path, suffix, case)
    return ""


def _mesh_problem(path: Path, suffix: str, case: Case) -> str:
    if suffix == ".xdmf":
        points, blocks = _xdmf_parts(path)
    elif suffix == ".mesh" and b"\nTetrahedraP2\n" in path.read_bytes():
        points, blocks = _medit_parts(path)
    else:
        points, blocks = _meshio_parts(path, suffix)
    if not np.isfinite(points).all():
        return "nodes are not finite"
    corners = {"tetra": 4, "tetra10": 4, "triangle": 3, "triangle6": 3}
    kind = next((kind for kind in corners if kind in blocks), None)
    if kind is None or len(blocks[kind]) == 0:
        return "no cells"
    nodes = blocks[kind]
    if nodes.min() < 0 or nodes.max() >= len(points):
        return "cells of nodes that are not there"
    if len(np.setdiff1d(np.arange(len(points)), nodes)):
        return "nodes without a cell"
    cells = nodes[:, : corners[kind]]
    problem = cells_problem(points, cells)
    return problem or (box_problem(points, path.parent, case) if len(cells[0]) == 4 else "")


def _meshio_parts(path: Path, suffix: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Nodes, and cells by kind."""
    kinds = {".msh2": "gmsh", ".msh": "gmsh", ".inp": "abaqus", ".mesh": "medit"}
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        mesh = meshio.read(path, kinds.get(suffix))
    by_kind: dict[str, list] = {}
    for block in mesh.cells:
        by_kind.setdefault(block.type, []).append(np.asarray(block.data, dtype=np.int64))
    blocks = {kind: np.concatenate(parts) for kind, parts in by_kind.items()}
    return np.asarray(mesh.points, dtype=np.float64), blocks


def _medit_parts(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """As `_meshio_parts`, of quadratic cells, which it does not read from this format."""
    tables: dict[str, np.ndarray] = {}
    lines = iter(
        [line for line in path.read_text().splitlines() if line and not line.startswith("#")]
    )
    for line in lines:
        if line in ("Vertices", "TetrahedraP2"):
            rows = [next(lines).split() for _ in range(int(next(lines)))]
            tables[line] = np.array(rows, dtype=np.float64)[:, :-1]
    return tables["Vertices"], {"tetra10": tables["TetrahedraP2"].astype(np.int64) - 1}


def _xdmf_parts(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """As `_meshio_parts`, of the grid "mesh", whose numbers are text."""
    grid = ET.parse(path).getroot().find(".//Grid[@Name='mesh']")
    arrays = []
    for item in (grid.find("Geometry/DataItem"), grid.find("Topology/DataItem")):
        shape = [int(size) for size in item.get("Dimensions").split()]
        arrays.append(np.array(item.text.split(), dtype=np.float64).reshape(shape))
    kind = {3: "triangle", 4: "tetra", 6: "triangle6", 10: "tetra10"}[arrays[1].shape[1]]
    return arrays[0], {kind: arrays[1].astype(np.int64)}


def cells_problem(points: np.ndarray, cells: np.ndarray) -> str:
    """Cells that are flat, inverted or there twice, facets of more than two."""
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    if cells.shape[1] == 3:
        sizes = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    else:
        sizes = np.einsum("ci,ci->c", edges[:, 0], np.cross(edges[:, 1], edges[:, 2]))
    if not (sizes > 0.0).all():
        return f"{int((~(sizes > 0.0)).sum())} of {len(cells)} cells are flat or inverted"
    ordered = np.sort(cells, axis=1)
    facets = np.concatenate([np.delete(ordered, k, axis=1) for k in range(cells.shape[1])])
    if np.unique(facets, axis=0, return_counts=True)[1].max() > 2:
        return "a facet of more than two cells"
    return ""


def box_problem(points: np.ndarray, folder: Path, case: Case) -> str:
    """Nodes outside of the box of the NIfTI image that was meshed, if that is what was done."""
    words = case.words
    is_whole = not any(
        word.startswith(("--crop", "--slice", "--space", "--volume", "--start")) for word in words
    )
    if words[0] != "mesh" or not is_whole or not words[1].endswith((".nii", ".nii.gz")):
        return ""
    near = folder / "cwd" / words[1]  # of what is written above the case's current folder
    image = nibabel.load(near if near.is_file() else folder / words[1])
    matrix, unit = np.array(image.affine, dtype=np.float64), int(image.header["xyzt_units"]) & 7
    # metres and micrometres; others are taken for mm
    matrix[:3] *= {1: 1000.0, 3: 0.001}.get(unit, 1.0)
    if len(image.shape) < 3 or np.linalg.cond(matrix[:3, :3]) > MOST_CONDITION:
        return ""
    index = np.linalg.solve(matrix[:3, :3], (points - matrix[:3, 3]).T).T
    beyond = float(np.maximum(-0.5 - index, index - np.array(image.shape[:3]) + 0.5).max())
    return f"nodes {beyond:.3g} voxels outside of the box" if beyond > OUTSIDE_VOXELS else ""


def page_words(text: str) -> str:
    """A text for a table or a file: no control characters, nothing that is not UTF-8."""
    return CONTROL.sub("?", text.encode("utf-8", "replace").decode())
