"""The user's own mesher in the comparison: a program that reads NIfTI files and writes a mesh.

Its command line is split into arguments as by a shell, and their placeholders are replaced; no
shell is involved. It runs in the current folder of `tetopt`; image, labels and mesh are in a
temporary folder.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tetopt.errors import InputError
from tetopt.geometry.box import ON_SIDE_VOXELS, box_sides, is_on_sides
from tetopt.geometry.quadratic import node_count
from tetopt.geometry.simplex import orient_cells
from tetopt.geometry.topology import boundary_facets
from tetopt.image import Image
from tetopt.io.images import save_image
from tetopt.io.meshes import MESH_SUFFIXES, load_mesh
from tetopt.io.text import last_line
from tetopt.mesh import Mesh
from tetopt.model.file import MeshFile
from tetopt.model.label_names import LABEL_FIELD
from tetopt.study.endings import Crashed
from tetopt.study.isosurfaces import class_labels
from tetopt.study.pipelines import PIPELINES, Pipeline, PipelineInput, Produced
from tetopt.study.search import LEAST_REQUEST, REQUEST_RESPONSE, corners_for, is_near, tries
from tetopt.study.tetwild import node_spacing, put_on_box
from tetopt.system.arrays import Ints
from tetopt.system.child import signal_words
from tetopt.system.interpreter import others_environment

# of one search, at most; the first requests the target, and the second is usually close
PROGRAM_RUNS = 5
# distance from the box's sides below which a mesh's boundary is moved onto them
NEAR_BOX_VOXELS = 1.0
# a node this near to a side is on it: CGAL finds the points of a surface to 1e-4 voxel
ROUGH_SIDE_VOXELS = 1e-3
PLACEHOLDERS = ("image", "labels", "nodes", "size", "output")
PROGRAM_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")


class Program(NamedTuple):
    """A program, and its name in the comparison."""

    name: str
    command: str  # as given, with placeholders


def parse_program(text: str) -> Program:
    """Parse and check a program such as "cgal=cgal_mesh {labels} --size {size} -o {output}".

    Placeholders: ``{image}`` and ``{labels}``, paths of NIfTI files (without labels, of multi-Otsu
    classes); ``{nodes}``, the requested number of nodes; ``{size}``, the edge length, mm, at which
    regular tetrahedra fill the box with that many; ``{output}``, the path of the mesh to write,
    which ends in .vtu unless a suffix follows, as in ``{output}.msh``.

    Raises
    ------
    InputError
        The name is missing or not a plain word; the command cannot be split, has an unknown
        placeholder, lacks ``{output}``, or has neither ``{image}`` nor ``{labels}``; the program
        does not exist, or cannot be run.
    """
    name, equals, command = text.partition("=")
    if not equals or not PROGRAM_NAME.fullmatch(name):
        raise InputError(
            f"`pipeline`: expected NAME='program {{image}} {{nodes}} {{output}}' with a name of "
            "letters, digits, - and "
            f'_, got "{text}"'
        )
    where = f"`pipeline` {name}"
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise InputError(f"{where}: unbalanced quotes ({error}): {command}") from error
    used = {key for word in words for key in re.findall(r"\{(\w*)\}", word)}
    if unknown := sorted(used - set(PLACEHOLDERS)):
        raise InputError(
            f"{where}: unknown placeholder {{{unknown[0]}}}; use {_brace_names(PLACEHOLDERS)}"
        )
    if "output" not in used or not used & {"image", "labels"}:
        raise InputError(
            f"{where}: expected {{output}}, and {{image}} or {{labels}} or both, got: {command}"
        )
    for word in words:
        suffix = _suffix(word)
        if suffix is not None and suffix not in MESH_SUFFIXES:
            raise InputError(
                f"{where}: the mesh's name must end in {', '.join(MESH_SUFFIXES)}, got "
                f"{{output}}{suffix}"
            )
    if shutil.which(words[0]) is None:
        raise InputError(
            f'{where}: found no executable program "{words[0]}"; give its path, or add its '
            "folder to PATH"
        )
    return Program(name, command)


def _brace_names(names: tuple[str, ...]) -> str:
    return ", ".join(f"{{{name}}}" for name in names)


def _suffix(word: str) -> str | None:
    """Return the suffix of the mesh's name, if the word contains it."""
    match = re.search(r"\{output\}(\.\w+)?", word)
    return None if match is None else match[1] or ".vtu"


def by_program(job: PipelineInput, program: Program) -> Produced:
    """Return the program's mesh with about the job's number of nodes, its boundary on the box if it
    lies close.

    The request is corrected up to four times until the number of nodes is within 5 %.

    Raises
    ------
    InputError
        The program's exit code is not 0, or it wrote no readable mesh; the message has the last
        line of its standard error.
    """
    words = shlex.split(program.command)
    suffix = next(suffix for word in words if (suffix := _suffix(word)) is not None)
    is_steered = any(f"{{{key}}}" in program.command for key in ("nodes", "size"))
    notes: list[str] = []
    sizes: list[int] = []
    with tempfile.TemporaryDirectory(prefix="program-") as name:
        paths = _inputs(Path(name), job, program.command)

        def run(factor: float) -> MeshFile | None:
            request = max(round(factor * job.nodes), LEAST_REQUEST)
            values = paths | {
                "nodes": str(request),
                "size": f"{node_spacing(job.image, request):.6g}",
            }
            try:
                loaded = _run(
                    program.name,
                    [_fill_argument(word, values) for word in words],
                    Path(values["output"] + suffix),
                )
            except InputError as error:
                if not sizes:
                    raise
                notes.append(f"request for {request} nodes: {error}")
                return None
            sizes.append(node_count(loaded.mesh.points, loaded.mesh.cells, job.order))
            return loaded

        most = PROGRAM_RUNS if is_steered else 1
        first = corners_for(job.nodes, job.order) / job.nodes
        runs = tries(run, lambda _: sizes[-1], job.nodes, REQUEST_RESPONSE, first=first, most=most)
    loaded = runs[0].result
    if not is_near(runs[0].n_nodes, job.nodes):
        counts = ", ".join(map(str, sizes))
        notes.append(f"{runs[0].n_nodes} nodes instead of {job.nodes}; the runs gave {counts}")
    mesh, kept, on_box = put_on_sides(job.image, loaded.mesh)
    labels, of_labels = _own_labels(loaded, kept, job)
    seconds = {"program": runs[0].seconds, "search": sum(each.seconds for each in runs[1:])}
    return Produced(mesh, seconds, [f"{len(runs)} runs", *notes, *on_box, *of_labels], labels)


def _inputs(folder: Path, job: PipelineInput, command: str) -> dict[str, str]:
    """Return paths by placeholder, and write the input files that the command names."""
    paths = {"image": str(folder / "image.nii.gz"), "labels": str(folder / "labels.nii.gz")}
    if "{image}" in command:
        save_image(paths["image"], job.image)
    if "{labels}" in command:
        save_image(
            paths["labels"],
            class_labels(job.image, job.classes) if job.labels is None else job.labels,
        )
    return paths | {"output": str(folder / "mesh")}


def _fill_argument(word: str, values: dict[str, str]) -> str:
    """Replace the placeholders in an argument; the mesh is a VTU file unless a suffix follows
    its placeholder.
    """
    word = re.sub(r"\{output\}(?!\.\w)", "{output}.vtu", word)
    return re.sub(r"\{(\w+)\}", lambda match: values[match[1]], word)


def _own_labels(loaded: MeshFile, kept: Ints, job: PipelineInput) -> tuple[Ints | None, list[str]]:
    """Return the labels of the kept cells from the field "label" of a program's file; -1 for labels
    not in the image.

    A label that all cells share is the number of a file's only part.
    """
    labels = loaded.cell_data.get(LABEL_FIELD)
    if labels is None or job.labels is None or labels.ndim != 1 or len(np.unique(labels)) == 1:
        return None, []
    is_known = np.isin(labels[kept], np.unique(job.labels.data))
    note = f'{is_known.sum()} of {len(kept)} cells use the "label" in their file'
    return np.where(is_known, labels[kept], -1).astype(np.int64), [note]


def _run(name: str, command: list[str], output: Path) -> MeshFile:
    """Run the program once; return its 3-D mesh with positively oriented cells."""
    output.unlink(missing_ok=True)
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            check=False,
            env=others_environment(),
        )
    except OSError as error:
        raise InputError(f"{name}: cannot be run ({error})") from error
    line = last_line(done.stderr.decode(errors="replace"))
    said = f": {line}" if line else ", with nothing on its standard error"
    if (crash := signal_words(done.returncode)) is not None:
        raise Crashed(f"{name} crashed ({crash}){said}")
    if done.returncode != 0:
        raise InputError(f"{name} ended with exit code {done.returncode}{said}")
    if not output.is_file():
        raise InputError(f"{name} wrote no mesh{said}")
    loaded = load_mesh(output)
    if loaded.mesh.ndim != 3:
        raise InputError(f"{name}: expected tetrahedra, got triangles")
    return loaded


def put_on_sides(image: Image, mesh: Mesh) -> tuple[Mesh, Ints, list[str]]:
    """Move a mesh's boundary onto the sides of the image's box if close; return the mesh, its
    cells, and notes.

    A mesh whose boundary is farther away than `NEAR_BOX_VOXELS`, or which would not fill the box,
    is unchanged.
    """
    sides, every = box_sides(image.shape), np.arange(len(mesh.cells))
    index = image.to_index(mesh.points)
    facets = boundary_facets(mesh.cells)
    # of each of the six sides
    off = np.abs(index[facets][..., None] - sides).max(axis=1).reshape(len(facets), -1)
    distance = float(off.min(axis=1).max())
    if distance <= ON_SIDE_VOXELS:
        return mesh, every, []
    if distance > NEAR_BOX_VOXELS:
        return (
            mesh,
            every,
            [f"its boundary lies up to {distance:.3g} voxels from the sides of the image's box"],
        )
    # Stretched onto the box first, which inverts no cell: a mesh of padded labels is half a voxel
    # too wide.
    low, high = index.min(axis=0), index.max(axis=0)
    index = sides[:, 0] + (index - low) * (sides[:, 1] - sides[:, 0]) / (high - low)
    # Nodes that belong on a side may lie under flat cells, where `put_on_box` does not find them.
    for side in (0, 1):
        index = np.where(np.abs(index - sides[:, side]) <= ROUGH_SIDE_VOXELS, sides[:, side], index)
    is_flat = np.any(np.all(is_on_sides(index, sides, 0.0)[mesh.cells], axis=1), axis=(1, 2))
    try:
        points, cells, kept = put_on_box(
            index * image.spacing, mesh.cells[~is_flat], *(sides.T * image.spacing)
        )
    except InputError as error:
        return mesh, every, [f"its boundary is not on the box's faces: {error}"]
    world = image.to_world(points / image.spacing)
    note = (
        f"its boundary was moved by up to {distance:.2g} voxels onto the sides of the image's box"
    )
    return Mesh(world, orient_cells(world, cells)), every[~is_flat][kept], [note]


def pipelines_with(programs: Sequence[Program]) -> dict[str, Pipeline]:
    """Return all pipelines by name, the user's programs last."""
    return PIPELINES | {
        each.name: Pipeline(
            each.name, "peer", f"a program: {each.command}", partial(by_program, program=each)
        )
        for each in programs
    }
