"""What the longest edge of a graded mesh, over that of a uniform one, does to a simulation: volumes
and organs in them.

Each volume, averaged to 2 mm where it is finer, is compressed in its box beside a voxel grid, as by
`choose_sizes.py`. An organ is a volume within a label (`--within`): nodes on its surface in the
lowest and the highest sixth of its height are held and pushed, beside quadratic cells of a uniform
mesh with four times the linear cells' corners. An error of displacement is the root mean square
over voxels, over that of the reference less the same with one modulus everywhere. The last rows are
geometric means over all, relative to the first ratio.

    python benchmarks/default_sizes.py -o sizes.json T1.nii.gz CT.nii.gz --within CT.nii.gz
    LABELS.nii.gz 5
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from choose_k_d import cases

import tetopt
from tetopt.energy.sampling import cell_of_voxel
from tetopt.fem.elasticity import box_faces, compression, elements_of, push_of
from tetopt.fem.reference import _displacements, _places, compare
from tetopt.geometry.topology import facets
from tetopt.model.averages import element_young, young_image
from tetopt.study.compare import default_mapping, prepare_references
from tetopt.study.compare_report import Settings
from tetopt.system.files import check_output, save_json

UNIFORM, NUS, FINER = "uniform", (0.3, 0.45), 4
# a mesh, order and nu; the error of displacement
Judge = Callable[[tetopt.Mesh, int, float], float]


def boxed(image: tetopt.Image, labels: tetopt.Image) -> Judge:
    """Compression of the box, beside that of voxels."""
    settings = Settings(nodes=0, reference_dofs=300_000, nus=NUS)
    standard = prepare_references(image, labels, default_mapping(image)[0], settings)

    def error(mesh: tetopt.Mesh, order: int, nu: float) -> float:
        bottom, top = box_faces(image, mesh)
        young, push = (
            element_young(standard.modulus_fine, mesh, None, "mean", order),
            push_of(image, settings.percent),
        )
        made = compression(
            mesh, young, nu, fixed_nodes=top, pushed_nodes=bottom, displacement=push, order=order
        )
        found = compare(
            standard.references[f"{nu:g}"], mesh, made.u, made.strain_energy, standard.coarse_labels
        )
        return float(found.displacement or 0.0)

    return error


def within(image: tetopt.Image, mask: tetopt.Image, corners: int) -> Judge:
    """Compression of what is within a mask, beside a finer mesh of quadratic cells."""
    inside = mask.data > 0.0
    modulus = young_image(image, default_mapping(tetopt.Image(image.data[inside][:, None]))[0])
    heights = image.to_world(np.argwhere(inside).astype(float))[:, 2]
    low, high = heights.min() + np.ptp(heights) / 6.0, heights.max() - np.ptp(heights) / 6.0
    push = np.array([0.0, 0.0, 0.01 * np.ptp(heights)])

    def solved(mesh: tetopt.Mesh, order: int, nu: float, is_even: bool = False) -> np.ndarray:
        """Displacement at each voxel's centre, NaN outside of the mesh."""
        made = facets(mesh.cells)
        outer = np.unique(made.nodes[made.cells[:, 1] < 0])
        top, bottom = outer[mesh.points[outer, 2] > high], outer[mesh.points[outer, 2] < low]
        young = (
            np.ones(len(mesh.cells))
            if is_even
            else element_young(modulus, mesh, None, "mean", order)
        )
        u = compression(
            mesh, young, nu, fixed_nodes=top, pushed_nodes=bottom, displacement=push, order=order
        ).u
        owner, elements = cell_of_voxel(image, mesh).ravel(), elements_of(mesh, order)
        at, values = np.flatnonzero(owner >= 0), np.full((len(owner), 3), np.nan)
        values[at] = _displacements(
            elements, order, u, owner[at], _places(image, elements, owner[at], at)
        )
        return values

    fine = tetopt.mesh_image(tetopt.content(image, mask=mask), corners, mode="uniform").mesh
    references = {nu: (solved(fine, 2, nu), solved(fine, 2, nu, is_even=True)) for nu in NUS}

    def error(mesh: tetopt.Mesh, order: int, nu: float) -> float:
        exact, even = references[nu]
        return float(
            np.sqrt(
                np.nanmean((solved(mesh, order, nu) - exact) ** 2) / np.nanmean((exact - even) ** 2)
            )
        )

    return error


def subjects(options: argparse.Namespace) -> Iterator[tuple[str, Any, int, Judge]]:
    """Name, what is meshed, number of nodes, and what judges a mesh of it."""
    for path, labels, number in options.within:
        image = tetopt.load_image(path)
        is_inside = np.isin(
            tetopt.load_image(labels).data, [int(each) for each in number.split(",")]
        )
        mask = tetopt.Image(is_inside * 1.0, image.affine)
        nodes = min(options.nodes, int(mask.data.sum()) // 2)
        yield (
            f"{Path(path).name} within {number}",
            tetopt.content(image, mask=mask),
            nodes,
            within(image, mask, FINER * nodes),
        )
    for name, image, labels in cases([], options.images):
        yield name, image, options.nodes, boxed(image, labels)


def main() -> None:
    """Mesh each at each ratio, print a row for it, and write all of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("images", type=Path, nargs="*")
    parser.add_argument(
        "--within", nargs=3, action="append", default=[], metavar=("IMAGE", "LABELS", "NUMBERS")
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="JSON file for every number"
    )
    parser.add_argument("--ratios", type=float, nargs="+", default=[1.4, 1.0, 1.1, 1.15, 1.2, 1.3])
    parser.add_argument("--orders", type=int, nargs="+", choices=(1, 2), default=[1, 2])
    parser.add_argument(
        "--nodes", type=int, default=5000, help="at most one for two voxels of a mask (%(default)s)"
    )
    options = parser.parse_args()
    ratios = (*options.ratios, UNIFORM)
    path, rows = check_output(options.output, (".json",), True), list[dict[str, Any]]()
    for name, content, nodes, judge in subjects(options):
        for order in options.orders:
            for ratio in ratios:
                how = (
                    {"mode": UNIFORM}
                    if ratio == UNIFORM
                    else {"sizes": tetopt.Sizes(coarsest=ratio)}
                )
                result = tetopt.mesh_image(content, nodes, order=order, **how)
                mesh = tetopt.Mesh(result.mesh.points, result.mesh.cells)
                numbers = {"corners": len(mesh.points), "E_D": result.fraction} | {
                    f"nu {nu}": judge(mesh, order, nu) for nu in NUS
                }
                rows.append({"image": name, "order": order, "ratio": ratio} | numbers)
                words = "  ".join(f"{key} {value:.4g}" for key, value in numbers.items())
                print(f"{name}, order {order}, {ratio}: {words}", flush=True)
        save_json(path, rows)
    for order in options.orders:
        base, *others = (
            [row for row in rows if (row["order"], row["ratio"]) == (order, k)] for k in ratios
        )
        for mine in others:
            logs = {
                k: [np.log(one[k] / other[k]) for one, other in zip(mine, base, strict=True)]
                for k in numbers
            }
            words = "  ".join(
                f"{key} x{np.exp(np.mean(values)):.3f}" for key, values in logs.items()
            )
            print(f"all, order {order}, {mine[0]['ratio']}: {words}")


if __name__ == "__main__":
    main()
