"""How the error of a simulation depends on the largest cell of a graded mesh: the evidence behind
its default.

Phantoms, and volumes of yours, are meshed uniformly, graded with several largest edges, and once
for the simulation itself: graded by the reference's own strain, sqrt(E) times its part along the
push, which no mesher knows. That mesh says what nodes in other places could do at most. Each is
compressed and compared with a voxel grid's solution.

    python benchmarks/choose_sizes.py -o sizes.json [T1.nii.gz ...]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from choose_k_d import PHANTOM_NAMES, SHOWN_ERRORS, cases, error_of

import tetopt
from tetopt.fem.reference import at_centres
from tetopt.job.events import listen_with
from tetopt.start.sizes import COARSEST_RATIO
from tetopt.study.compare import Standard, default_mapping, measure_mesh, prepare_references
from tetopt.study.compare_report import Settings
from tetopt.system.files import check_output, save_json

STANDARD_NU = "0.3"


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
        "--largest", type=float, nargs="+", default=[1.0, 1.2, COARSEST_RATIO, 2.0, np.inf]
    )
    parser.add_argument("--nodes", type=int, default=2000)
    parser.add_argument(
        "--dofs", type=int, default=150_000, help="size of the reference grid (%(default)s)"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing output")
    options = parser.parse_args(argv)
    try:
        return _run(options)
    except tetopt.InputError as error:
        print(f"choose_sizes: {error}", file=sys.stderr)
        return 2


def _run(options: argparse.Namespace) -> int:
    path = check_output(options.output, (".json",), options.force)
    settings = Settings(
        nodes=0, reference_dofs=options.dofs, nus=(float(STANDARD_NU),), average="mean"
    )
    rows = []
    for name, image, labels in cases(options.phantoms, options.images):
        mapping, _ = default_mapping(image)
        with listen_with(lambda event, name=name: print(f"{name}: {event.text}", flush=True)):
            standard = prepare_references(image, labels, mapping, settings)
        for kind, mesh in _meshes(image, standard, options.nodes, options.largest):
            numbers = measure_mesh(standard, mesh, settings.percent)
            rows.append({"image": name, "mesh": kind, "measured": numbers})
            print(_line(rows[-1]), flush=True)
    save_json(path, {"rows": rows})
    return 0


def _meshes(
    image: tetopt.Image, standard: Standard, nodes: int, largest: Sequence[float]
) -> Iterator[tuple[str, tetopt.Mesh]]:
    """Name and mesh, one after the other."""
    lattice = tetopt.lattice_mesh(image, nodes=nodes)
    yield "lattice", lattice
    yield "uniform", tetopt.optimize(image, lattice).mesh
    edge = tetopt.Sizes().longest_edge(image, nodes) / COARSEST_RATIO
    for factor in largest:
        sizes = tetopt.Sizes(longest=factor * edge)
        yield f"graded, largest {factor:g}", tetopt.mesh_image(image, nodes, sizes=sizes).mesh
    strained = _strained(standard)
    yield (
        "uniform, by the strain",
        tetopt.optimize(strained, tetopt.lattice_mesh(strained, nodes=nodes)).mesh,
    )
    for k_D in (0.5, 0.85):
        yield f"graded by the strain, k_D {k_D:g}", tetopt.mesh_image(strained, nodes, k_D=k_D).mesh
        mesh = tetopt.optimize(
            strained, tetopt.lattice_mesh(strained, nodes=nodes), k_D=k_D, nodes=nodes
        ).mesh
        yield f"lattice graded by the strain, k_D {k_D:g}", mesh


def _strained(standard: Standard) -> tetopt.Image:
    """sqrt(E) times the strain along the push, of the reference: E_D of it is about the error of
    a mesh's energy.
    """
    modulus, reference = standard.modulus, standard.references[STANDARD_NU]
    strain = at_centres(modulus, reference.u, np.arange(modulus.data.size))[1].reshape(
        *modulus.shape, 3, 3
    )
    push = int(np.argmax([abs(strain[..., d, d].mean()) for d in range(modulus.ndim)]))
    return tetopt.Image(np.sqrt(modulus.data) * strain[..., push, push], modulus.affine)


def _line(row: dict[str, Any]) -> str:
    mesh = row["measured"]
    errors = " ".join(f"{error_of(mesh.fem[STANDARD_NU], e):.4f}" for e in SHOWN_ERRORS)
    size = f"{mesh.n_nodes} nodes, E_D {mesh.E_D_fraction:.4f}, rho {mesh.quality.mean_rho:.3f}"
    return f"{row['image']}, {row['mesh']}: {size}; errors {errors}"


if __name__ == "__main__":
    sys.exit(main())
