"""How the error of a simulation depends on the average over a cell's voxels: the evidence behind
the default.

Phantoms, and volumes of yours, are meshed uniformly and graded, for linear and for quadratic cells
with as many nodes in all; each mesh is compressed with each average and compared with the voxels'
solution, as in `tetopt compare`. "points" is no average, but the modulus of the voxel at each Gauss
point of a cell: what a solver could have that reads the image itself. The last rows are geometric
means over images, meshes and nu, relative to the first average.

    python benchmarks/choose_average.py -o averages.json [T1.nii.gz ...]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from choose_k_d import PHANTOM_NAMES, SHOWN_ERRORS, cases
from numpy.typing import NDArray

import tetopt
from tetopt.energy.sampling import nearest_values
from tetopt.fem.elasticity import box_faces, compression, push_of
from tetopt.fem.reference import compare
from tetopt.geometry.quadratic import gauss_rule, quadratic
from tetopt.job.events import listen_with
from tetopt.model.averages import element_young, parse_average
from tetopt.study.compare import Standard, default_mapping, prepare_references
from tetopt.study.compare_report import Settings
from tetopt.system.files import check_output, save_json

POINTS = "points"
AVERAGES = (
    "mean",
    "power:0.5",
    "geometric",
    "power:-0.5",
    "harmonic",
    "hill",
    "gauss",
    "nodes",
    POINTS,
)
CORNER_FRACTION = 1 / 7.2  # of all nodes of quadratic tetrahedra, before a mesh has shown its own
COUNT_TOLERANCE = 0.03  # of the requested number of nodes


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
        "--averages", nargs="+", default=AVERAGES, help="the first is what others are relative to"
    )
    parser.add_argument("--orders", type=int, nargs="+", choices=(1, 2), default=(1, 2))
    parser.add_argument(
        "--modes", nargs="+", choices=("uniform", "graded"), default=("uniform", "graded")
    )
    parser.add_argument(
        "--nodes",
        type=int,
        default=5000,
        help="of each mesh, in the middle of edges too (%(default)s)",
    )
    parser.add_argument(
        "--dofs", type=int, default=4_000_000, help="size of the reference grid (%(default)s)"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    options = parser.parse_args(argv)
    try:
        return _run(options)
    except tetopt.InputError as error:
        print(f"choose_average: {error}", file=sys.stderr)
        return 2


def _run(options: argparse.Namespace) -> int:
    for word in options.averages:
        if word != POINTS:
            parse_average(word)
    path = check_output(options.output, (".json",), options.force)
    settings = Settings(nodes=0, reference_dofs=options.dofs)
    rows: list[dict[str, Any]] = []
    for name, image, labels in cases(options.phantoms, options.images):
        mapping, _ = default_mapping(image)
        with listen_with(lambda event, name=name: print(f"{name}: {event.text}", flush=True)):
            standard = prepare_references(image, labels, mapping, settings)
        for order in options.orders:
            for mode in options.modes:
                mesh = _mesh(image, mode, options.nodes, order)
                about = {"image": name, "mesh": mode, "order": order, "n_corners": len(mesh.points)}
                print(
                    f"{name}, {mode}, order {order}, {len(mesh.points)} corners: errors of "
                    f"{', '.join(SHOWN_ERRORS)}"
                )
                for average in options.averages:
                    rows += [
                        about | row
                        for row in _measured(standard, mesh, order, average, settings.percent)
                    ]
                    print(_line(rows[-len(settings.nus) :]), flush=True)
    summary = _summary(rows, options.averages)
    save_json(path, {"rows": rows, f"relative_to_{options.averages[0]}": summary})
    for which, ratios in summary.items():
        print(f"all, {which}: " + "  ".join(f"{key} x{value:.3f}" for key, value in ratios.items()))
    return 0


def _mesh(image: tetopt.Image, mode: str, nodes: int, order: int) -> tetopt.Mesh:
    """A mesh of about so many nodes of the order."""
    mesh = tetopt.mesh_image(
        image, nodes if order == 1 else round(CORNER_FRACTION * nodes), mode=mode
    ).mesh
    for _ in range(3 if order == 2 else 0):
        count = len(quadratic(mesh.points, mesh.cells)[0])
        if abs(count / nodes - 1.0) <= COUNT_TOLERANCE:
            break
        mesh = tetopt.mesh_image(image, round(len(mesh.points) * nodes / count), mode=mode).mesh
    return mesh


def _moduli(
    image: tetopt.Image, mesh: tetopt.Mesh, order: int, average: str
) -> NDArray[np.float64]:
    """Of the cells, or at their Gauss points, from the image of the modulus."""
    if average == POINTS:
        places = np.einsum("qa,cai->cqi", gauss_rule(mesh.ndim, order)[0], mesh.points[mesh.cells])
        return nearest_values(image, places.reshape(-1, mesh.ndim)).reshape(places.shape[:2])
    return element_young(image, mesh, average=average, order=order)


def _measured(
    standard: Standard, mesh: tetopt.Mesh, order: int, average: str, percent: float
) -> Iterator[dict[str, Any]]:
    """The errors of a mesh's compression with an average, one row for each nu."""
    young = _moduli(standard.modulus_fine, mesh, order, average)
    bottom, top = box_faces(standard.image, mesh)
    push = push_of(standard.image, percent)
    for nu, exact in standard.references.items():
        pressed = compression(
            mesh,
            young,
            exact.nu,
            fixed_nodes=top,
            pushed_nodes=bottom,
            displacement=push,
            order=order,
        )
        errors = compare(exact, mesh, pressed.u, pressed.strain_energy, standard.coarse_labels)
        stiffer = pressed.strain_energy / exact.strain_energy - 1.0
        yield {
            "average": average,
            "nu": nu,
            "n_nodes": len(pressed.u),
            "stiffer": stiffer,
            "errors": errors,
        }


def _line(rows: Sequence[dict[str, Any]]) -> str:
    each = [
        f"nu {row['nu']}: {row['stiffer']:+.4f} {row['errors'].displacement:.4f} "
        f"{row['errors'].interface_strain:.4f}"
        for row in rows
    ]
    return f"  {rows[0]['average']:10}  " + "  ".join(each)


def _summary(
    rows: Sequence[dict[str, Any]], averages: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Geometric mean over images, meshes and nu of each error, relative to that with the first
    average, by order.
    """
    summary = {}
    for order in sorted({row["order"] for row in rows}):
        for average in averages:
            mine, first = (
                [row["errors"] for row in rows if (row["order"], row["average"]) == (order, each)]
                for each in (average, averages[0])
            )
            pairs = list(zip(mine, first, strict=True))
            summary[f"order {order}, {average}"] = {
                e: float(np.exp(np.mean([np.log(getattr(a, e) / getattr(b, e)) for a, b in pairs])))
                for e in SHOWN_ERRORS
            }
    return summary


if __name__ == "__main__":
    sys.exit(main())
