"""Checksums of meshes over the ground that tetopt covers: the same before and after a change that
is to change nothing.

    PYTHONPATH=scripts python benchmarks/fingerprints.py -o new.json
        [--against tests/fingerprints.json] [--only NAME ...]

Each row is one run of the command: the sha256 of its points and cells, and of its whole file. They
are the same on any number of threads. Between kinds of processors, or versions of numpy and scipy,
last digits may differ: then write the file to compare with from the version before, on the same
machine. The exit code is 1 if a row differs. All runs together take three minutes on 2 cores.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from llvmlite.binding import get_host_cpu_name
from paper.tissue import mni_tissue

import tetopt
from tetopt.io.mni import mni_path
from tetopt.report.summary import versions
from tetopt.system.files import check_output, save_json

# The words after `tetopt mesh`, by the name of the run; T1, GM, TISSUE, BRAIN, ... are files made
# below.
RUN_WORDS = {
    "graded": "T1 --nodes 5000",
    "graded_fine": "T1 --nodes 15000",
    "uniform": "T1 --uniform --nodes 5000",
    "uniform_one_thread": "T1 --uniform --nodes 2000 --threads 1",
    "uniform_two_threads": "T1 --uniform --nodes 2000 --threads 2",
    "target_error": "HALF --target-error 0.03",
    "sizes": "HALF --nodes 4000 --size-min 6 --edge-size 30 --gradation 0.3",
    "paper": "HALF --method paper --nodes 1000 --iterations 6",
    "paper_accept": "HALF --method paper --nodes 600 --iterations 4 --retessellate accept --k-d "
    "0.5",
    "paper_shape_only": "HALF --method paper --nodes 600 --iterations 4 --k-d 0",
    "mask": "HALF --mask BRAIN --nodes 3000",
    "mask_uniform": "HALF --mask BRAIN --uniform --nodes 2000",
    "background": "HALF --background auto --nodes 2000",
    "labels": "TISSUE --labels TISSUE --nodes 3000",
    "two_contrasts": "HALF GM --weights 1,0.5 --labels TISSUE --nodes 2500",
    "start": "HALF --start OUT/uniform_for_start.vtu --iterations 8",
    "slice": "T1 --slice k=90 --nodes 500",
    "slice_uniform": "T1 --slice k=90 --uniform --nodes 500",
    "slice_paper": "T1 --slice k=90 --method paper --nodes 300 --iterations 8",
    "slice_mask": "T1 --slice k=90 --background auto --nodes 400",
    "fractions": "FRACTIONS --nodes 1500",
    "oblique": "OBLIQUE --nodes 1200 --threads 1",
    "oblique_two_threads": "OBLIQUE --nodes 1200 --threads 2",
    "oblique_paper": "OBLIQUE --method paper --nodes 400 --iterations 4",
}
FIRST_RUNS = {
    "start": ("uniform_for_start", "HALF --uniform --nodes 1200 --iterations 2")
}  # runs that others begin with


def main(argv: Sequence[str] | None = None) -> int:
    """Run, print, write, compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="JSON file")
    parser.add_argument("--against", type=Path, help="JSON file of an earlier call")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=list(RUN_WORDS),
        default=list(RUN_WORDS),
        metavar="NAME",
        help="these runs",
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    options = parser.parse_args(argv)
    try:
        output = check_output(options.output, (".json",), options.force)
        earlier = {} if options.against is None else json.loads(options.against.read_text())["runs"]
        with tempfile.TemporaryDirectory() as folder:
            rows = dict(fingerprints(Path(folder), options.only))
    except (tetopt.InputError, OSError) as error:
        print(f"fingerprints: {error}", file=sys.stderr)
        return 2
    save_json(output, {"machine": machine(), "versions": versions(), "runs": rows})
    differing = [name for name, row in rows.items() if earlier.get(name, row) != row]
    missing = [name for name in rows if earlier and name not in earlier]
    for name in differing:
        parts = [part for part in rows[name] if rows[name][part] != earlier[name].get(part)]
        print(f"differs: {name}: {', '.join(parts)}")
    if options.against is not None:
        print(
            f"{len(rows) - len(differing) - len(missing)} of {len(rows)} runs as in "
            f"{options.against}"
        )
    return 1 if differing or missing else 0


def machine() -> str:
    """What last digits may depend on, beside versions: the system and the kind of processor."""
    return f"{platform.platform()} {get_host_cpu_name()}"


def fingerprints(folder: Path, names: Sequence[str]) -> Iterator[tuple[str, dict[str, str]]]:
    """The checksums of each run, one after the other."""
    files = {"T1": mni_path("t1"), "GM": mni_path("gm"), **made_images(folder)}
    for name in names:
        if name in FIRST_RUNS:
            run(*FIRST_RUNS[name], files, folder)
        begin = time.perf_counter()
        row = run(name, RUN_WORDS[name], files, folder)
        print(f"{name:22} {row['mesh'][:12]} {time.perf_counter() - begin:6.1f} s", flush=True)
        yield name, row


def made_images(folder: Path) -> dict[str, Path]:
    """A brain of half the resolution, its tissues and its mask; phantoms of fractions, and on
    sheared axes.
    """
    t1, tissue = tetopt.load_image(mni_path("t1")), mni_tissue()
    half = t1.affine @ np.diag([2.0, 2.0, 2.0, 1.0])
    turned = np.array(
        [
            [1.8, 0.3, 0.2, -20.0],
            [-0.2, 1.7, 0.4, 5.0],
            [0.0, -0.3, -2.5, 9.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    phantom = tetopt.load_phantom("ellipsoids_brain").image(voxel_mm=3.0)
    images = {
        "HALF": tetopt.Image(t1.data[::2, ::2, ::2], half),
        "TISSUE": tetopt.Image(tissue.data[::2, ::2, ::2], half),
        "BRAIN": tetopt.Image((tissue.data[::2, ::2, ::2] > 1).astype(np.uint8), half),
        "FRACTIONS": tetopt.Image(phantom.data / 7.0, phantom.affine),
        "OBLIQUE": tetopt.Image(
            tetopt.load_phantom("two_spheres").image(voxel_mm=2.0).data, turned
        ),
    }
    paths = {name: folder / f"{name.lower()}.nii.gz" for name in images}
    for name, image in images.items():
        tetopt.save_image(paths[name], image)
    return paths


def run(name: str, words: str, files: dict[str, Path], folder: Path) -> dict[str, str]:
    """One run of the command: the checksums of what it wrote."""
    path = folder / f"{name}.vtu"
    words_of_run = [
        str(files.get(word, word)).replace("OUT", str(folder)) for word in words.split()
    ]
    command = [sys.executable, "-m", "tetopt", "mesh", *words_of_run, "-o", str(path), "--force"]
    done = subprocess.run(
        command, env=os.environ | {"SOURCE_DATE_EPOCH": "0"}, capture_output=True, text=True
    )
    if done.returncode not in (0, 1):
        raise tetopt.InputError(f"{name}: {done.stderr.strip()}")
    mesh = tetopt.load_mesh(path).mesh
    points = hashlib.sha256(np.ascontiguousarray(mesh.points).tobytes())
    points.update(np.ascontiguousarray(mesh.cells).tobytes())
    return {"mesh": points.hexdigest(), "file": hashlib.sha256(path.read_bytes()).hexdigest()}


if __name__ == "__main__":
    sys.exit(main())
