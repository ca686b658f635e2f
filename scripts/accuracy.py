"""Nodes and seconds that meshers need for the same error: prints and writes JSON.

    python scripts/accuracy.py -o accuracy.json [IMAGE] --cgal CGAL --head LABELS --cgal-sized
    CGAL_SIZED

tetopt meshes IMAGE, by default the MNI152 T1, with 5,000 nodes. pytetwild and CGAL mesh its
classes, with more nodes until they leave as little of the variance unexplained. Then CGAL meshes
the labels of a head, and tetopt the same with fewer nodes, as long as no label's Dice is below
CGAL's. For the programs, see `scripts/benchmark.py`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import HEAD_NODES, cgal_command, head_command, process_seconds, sized_head
from numpy.typing import NDArray

import tetopt
from tetopt.io.mni import mni_path
from tetopt.measure.segmentation import threshold_image
from tetopt.study import tetwild
from tetopt.study.pipelines import PIPELINES, PipelineInput
from tetopt.system.files import check_output, save_json

NODES = 5_000
# of tetopt on the head, until its Dice suffices
HEAD_COUNTS = (30_000, 40_000, 60_000, 90_000, HEAD_NODES)
ERROR_TOLERANCE = 0.03  # of the error: a search ends this close below it
MOST_RUNS = 8
# of a number of nodes to the mesh and its seconds
Mesher = Callable[[float], tuple[tetopt.Mesh, float]]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print each row and write a JSON file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("image", type=Path, nargs="?", help="volume to measure on")
    parser.add_argument("-o", "--output", type=Path, required=True, help="JSON file")
    parser.add_argument(
        "--cgal", required=True, help="program that meshes labels with CGAL's Mesh_3"
    )
    parser.add_argument("--cgal-sized", help="the same with a sizing field")
    parser.add_argument("--head", type=Path, help="labels of a whole head")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    options = parser.parse_args(argv)
    output = check_output(options.output, (".json",), options.force)
    path = mni_path("t1") if options.image is None else options.image
    rows: dict[str, Any] = {"image": path.name, "error": same_error(path, options.cgal)}
    if options.head is not None:
        rows["dice"] = same_dice(options.head, options.cgal_sized)
    save_json(output, rows)
    print(json.dumps(rows, indent=1))
    return 0


def same_error(path: Path, cgal: str) -> dict[str, Any]:
    """Nodes and seconds of tetopt, and of the others at its unexplained fraction of the
    variance.
    """
    image = tetopt.load_image(path)
    variance = float(np.var(image.data, dtype=np.float64)) * image.volume
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ours = [
            sys.executable,
            "-m",
            "tetopt",
            "mesh",
            str(path),
            "-o",
            str(folder / "ours.vtu"),
            "--force",
        ]
        seconds = min(process_seconds([*ours, "--nodes", str(NODES)])[0] for _ in range(2))
        error = tetopt.E_D(image, tetopt.load_mesh(folder / "ours.vtu").mesh) / variance
        rows: dict[str, Any] = {"tetopt": {"nodes": NODES, "seconds": seconds, "error": error}}
        for peer, mesher in {
            "cgal": _cgal(cgal, image, folder),
            "pytetwild": _pytetwild(image),
        }.items():
            rows[peer] = _at_error(mesher, lambda mesh: tetopt.E_D(image, mesh) / variance, error)
            print(peer, rows[peer], flush=True)
    return rows


def _at_error(
    mesher: Mesher, error_of: Callable[[tetopt.Mesh], float], goal: float
) -> dict[str, Any]:
    """Return the run with the fewest nodes whose error is at most the goal, by secants of log
    error over log nodes.
    """
    runs: list[tuple[int, float, float]] = []
    request, slope = 3.0 * NODES, -0.6
    for _ in range(MOST_RUNS):
        mesh, seconds = mesher(request)
        runs.append((len(mesh.points), seconds, error_of(mesh)))
        print(f"  {runs[-1]}", flush=True)
        if (1.0 - ERROR_TOLERANCE) * goal <= runs[-1][2] <= goal:
            break
        if len(runs) > 1:
            (n, _, e), (m, _, f) = sorted(runs, key=lambda run: abs(np.log(run[2] / goal)))[:2]
            slope = float(np.clip(np.log(e / f) / np.log(n / m), -1.5, -0.2)) if n != m else slope
        near = min(runs, key=lambda run: abs(np.log(run[2] / goal)))
        aim = (1.0 - ERROR_TOLERANCE / 2) * goal
        request *= float(
            np.clip((aim / near[2]) ** (1.0 / slope) * near[0] / runs[-1][0], 0.25, 4.0)
        )
    fewest = min((run for run in runs if run[2] <= goal), default=min(runs, key=lambda run: run[2]))
    return {"nodes": fewest[0], "seconds": fewest[1], "error": fewest[2], "runs": runs}


def _pytetwild(image: tetopt.Image) -> Mesher:
    """Return pytetwild as a mesher of the image's classes, in one run: the number of nodes need
    not be met.
    """
    tetwild.TETWILD_RUNS = 1

    def mesher(nodes: float) -> tuple[tetopt.Mesh, float]:
        produced = PIPELINES["pytetwild"].function(PipelineInput(image, None, round(nodes)))
        return produced.mesh, sum(
            each for step, each in produced.seconds.items() if step != "search"
        )

    return mesher


def _cgal(program: str, image: tetopt.Image, folder: Path) -> Mesher:
    """Return CGAL as a mesher of the image's classes, with one cell size."""
    labels = threshold_image(image, 4)

    def mesher(nodes: float) -> tuple[tetopt.Mesh, float]:
        command, _ = cgal_command(program, labels, round(nodes), folder)
        seconds = min(process_seconds(command)[0] for _ in range(2))  # as of tetopt
        return mesh_of(folder / "mesh.bin", labels)[0], seconds

    return mesher


def mesh_of(path: Path, image: tetopt.Image) -> tuple[tetopt.Mesh, NDArray[np.int64]]:
    """Read the mesh that CGAL's program wrote for an image padded by a voxel, and its cells'
    labels.
    """
    data = path.read_bytes()
    n_points, n_cells = np.frombuffer(data, np.int32, 2)
    points = np.frombuffer(data, np.float64, 3 * n_points, 8).reshape(-1, 3) / image.spacing - 1.0
    rows = np.frombuffer(data, np.int32, 5 * n_cells, 8 + 24 * int(n_points)).reshape(-1, 5)
    points, cells = image.to_world(points), rows[:, :4].astype(np.int64)
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    turned = np.linalg.det(edges) < 0.0
    cells[turned] = cells[turned][:, [0, 1, 3, 2]]
    used, cells = np.unique(cells, return_inverse=True)
    return tetopt.Mesh(points[used], cells.reshape(-1, 4)), rows[:, 4].astype(np.int64)


def same_dice(path: Path, cgal: str) -> dict[str, Any]:
    """Nodes, seconds and Dice of CGAL on a head, and of tetopt with the fewest nodes that reach
    CGAL's Dice.
    """
    labels = tetopt.load_image(path)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command, _ = sized_head(cgal, labels, HEAD_NODES, folder)
        seconds, _ = process_seconds(command)
        mesh, of_cell = mesh_of(folder / "mesh.bin", labels)
        rows: dict[str, Any] = {
            "counts": HEAD_COUNTS,
            "cgal": {"nodes": len(mesh.points), "seconds": seconds},
        }
        rows["cgal"]["dice"] = dice = _dice(labels, mesh, of_cell)
        for nodes in HEAD_COUNTS:
            seconds, _ = process_seconds(head_command(path, folder, nodes), allowed=(0, 1))
            ours: dict[str, Any] = {"nodes": nodes, "seconds": seconds}
            loaded = tetopt.load_mesh(folder / "out.vtu")
            ours["dice"] = _dice(labels, loaded.mesh, loaded.cell_data["label"].astype(np.int64))
            rows["tetopt"] = ours
            print(ours, dice, flush=True)
            if all(ours["dice"][label] >= value for label, value in dice.items()):
                break
    return rows


def _dice(labels: tetopt.Image, mesh: tetopt.Mesh, of_cell: NDArray[np.int64]) -> dict[str, float]:
    """Return the Dice of each label but 0."""
    rows = tetopt.label_fidelity(labels, mesh, of_cell)
    return {str(row.label): row.overlap.dice for row in rows if row.label != 0}


if __name__ == "__main__":
    sys.exit(main())
