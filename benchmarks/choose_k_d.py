"""How the error of a simulation depends on k_D: the evidence behind the default weight of the
image.

Phantoms, and volumes of yours, are meshed at several k_D and node counts; each mesh is compressed
and compared with a voxel grid's solution, as in `tetopt compare`. The last rows are geometric means
over everything, relative to k_D = 0.

    python benchmarks/choose_k_d.py -o k_d.json [T1.nii.gz ...]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import tetopt
from tetopt.fem.reference import average_voxels
from tetopt.job.events import listen_with
from tetopt.measure.segmentation import threshold_image
from tetopt.study.compare import default_mapping, measure_mesh, prepare_references
from tetopt.study.compare_report import Settings, Simulation
from tetopt.system.files import check_output, save_json

PHANTOM_NAMES = ("sphere", "two_spheres", "ellipsoids_brain")
SHOWN_ERRORS = ("strain_energy", "displacement", "interface_strain")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the sweep; 0 when all is written, 2 with one line on an input to mend."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("images", type=Path, nargs="*", help="volumes, besides the phantoms")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="JSON file for every number"
    )
    parser.add_argument(
        "--phantoms", nargs="*", default=PHANTOM_NAMES, help="phantoms to take (%(default)s)"
    )
    parser.add_argument(
        "--k-d", type=float, nargs="+", default=[0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 0.85]
    )
    parser.add_argument("--nodes", type=int, nargs="+", default=[1200, 5000])
    parser.add_argument(
        "--dofs", type=int, default=300_000, help="size of the reference grid (%(default)s)"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    options = parser.parse_args(argv)
    try:
        return _run(options)
    except tetopt.InputError as error:
        print(f"choose_k_d: {error}", file=sys.stderr)
        return 2


def _run(options: argparse.Namespace) -> int:
    path = check_output(options.output, (".json",), options.force)
    settings = Settings(nodes=0, reference_dofs=options.dofs, average="mean")
    rows = []
    for name, image, labels in cases(options.phantoms, options.images):
        mapping, _ = default_mapping(image)
        with listen_with(lambda event, name=name: print(f"{name}: {event.text}", flush=True)):
            standard = prepare_references(image, labels, mapping, settings)
        for nodes in options.nodes:
            initial = tetopt.lattice_mesh(image, nodes=nodes)
            for k_D in options.k_d:
                mesh = tetopt.optimize(image, initial, k_D=k_D).mesh
                numbers = measure_mesh(standard, mesh, settings.percent)
                rows.append(
                    {"image": name, "nodes": len(mesh.points), "k_D": k_D, "measured": numbers}
                )
                print(_line(rows[-1]), flush=True)
    summary = _summary(rows, options.k_d)
    save_json(path, {"rows": rows, "relative_to_k_D_0": summary})
    for k_D, ratios in summary.items():
        print(
            f"all, k_D {k_D}: " + "  ".join(f"{key} x{value:.3f}" for key, value in ratios.items())
        )
    return 0


def cases(
    phantoms: Sequence[str], paths: Sequence[Path]
) -> list[tuple[str, tetopt.Image, tetopt.Image]]:
    """Name, image and materials; a volume of the user's is averaged to 2 mm where it is finer."""
    cases = []
    for name in phantoms:
        phantom = tetopt.load_phantom(name)
        cases.append((name, phantom.image(), phantom.label_image()))
    for path in paths:
        image = tetopt.load_image(path)
        shape = tuple(
            int(s)
            for s in np.maximum(
                1, np.rint(np.array(image.shape) * np.minimum(1, image.spacing / 2))
            )
        )
        coarse = average_voxels(image, shape)
        cases.append((path.name, coarse, threshold_image(coarse, 4)))
    return cases


def error_of(simulation: Simulation, name: str) -> float:
    """One of a simulation's errors, moduli by Eq. (2)'s mean."""
    return float(getattr(simulation.errors, name))


def _line(row: dict[str, Any]) -> str:
    mesh = row["measured"]
    errors = [
        f"nu {nu}: " + " ".join(f"{error_of(f, e):.4f}" for e in SHOWN_ERRORS)
        for nu, f in mesh.fem.items()
    ]
    shape = f"E_D {mesh.E_D_fraction:.4f} rho {mesh.quality.mean_rho:.3f}"
    return f"{row['image']} {row['nodes']} nodes k_D {row['k_D']:g}: {shape}  " + "  ".join(errors)


def _summary(
    rows: Sequence[dict[str, Any]], weights: Sequence[float]
) -> dict[str, dict[str, float]]:
    """Geometric mean over images, node counts and nu of each error, relative to that of the
    first k_D.
    """
    summary = {}
    for k_D in weights:
        mine, first = ([row for row in rows if row["k_D"] == k] for k in (k_D, weights[0]))
        pairs = [
            (a["measured"].fem[nu], b["measured"].fem[nu])
            for a, b in zip(mine, first, strict=True)
            for nu in a["measured"].fem
        ]
        ratios = {
            e: float(np.exp(np.mean([np.log(error_of(a, e) / error_of(b, e)) for a, b in pairs])))
            for e in SHOWN_ERRORS
        }
        ratios["cond"] = float(np.exp(np.mean([np.log(a.cond / b.cond) for a, b in pairs])))
        summary[f"{k_D:g}"] = ratios
    return summary


if __name__ == "__main__":
    sys.exit(main())
