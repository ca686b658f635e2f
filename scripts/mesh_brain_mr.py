"""Mesh a brain MR volume, draw it and extract the ventricles, as in Fig. 3(e, f) of the paper.

The structure is the largest facet-connected set of tetrahedra whose mean intensity is below a
threshold. Sets that touch the box are excluded: they are the dark air around the head.

    python scripts/mesh_brain_mr.py T1.nii.gz -o OUT
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from paper.scenes import structure_before_slices

import tetopt
from tetopt.engine.loop import IterationRecord
from tetopt.geometry.topology import boundary_facets, components, facets
from tetopt.io.images import sha256
from tetopt.report.figures import save_run_figures
from tetopt.report.scene import save_scenes
from tetopt.report.summary import run_summary
from tetopt.system.files import check_output, save_json, written_whole


def main(argv: Sequence[str] | None = None) -> int:
    """Run the workflow; return 0 on success, 2 after a one-line message about an invalid input."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("image", type=Path, help="T1-weighted volume, with dark CSF")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the results")
    parser.add_argument(
        "--nodes", type=int, default=10_000, help="target number of nodes (%(default)s)"
    )
    parser.add_argument("--k-d", type=float, default=0.3, help="weight of the image (%(default)s)")
    parser.add_argument(
        "--iterations", type=int, default=15, help="sweeps over all nodes (%(default)s)"
    )
    parser.add_argument(
        "--below", type=float, help="threshold; default: 0.7 x the median of the brighter half"
    )
    parser.add_argument("--force", action="store_true", help="replace existing outputs")
    options = parser.parse_args(argv)
    try:
        return _run(options)
    except tetopt.InputError as error:
        print(f"mesh_brain_mr: {error}", file=sys.stderr)
        return 2


def _run(options: argparse.Namespace) -> int:
    folder = options.output
    image = tetopt.load_image(options.image)
    if image.ndim != 3:
        raise tetopt.InputError(f"{options.image}: expected a volume, got a {image.ndim}-D image")
    folder.mkdir(parents=True, exist_ok=True)
    names = (
        "mesh.vtu",
        "run.json",
        "slice.png",
        "rho.png",
        "energies.png",
        "structure.stl",
        "structure.png",
    )
    mesh_path, json_path, *figures, surface_path, picture_path = (
        check_output(folder / name, (Path(name).suffix,), options.force) for name in names
    )
    result = tetopt.mesh_image(
        image,
        options.nodes,
        mode="uniform",
        k_D=options.k_d,
        iterations=options.iterations,
        callback=_say,
    )
    mesh, initial = result.mesh, result.initial
    fields = tetopt.cell_fields(mesh, image)
    below = _default_threshold(image) if options.below is None else options.below
    structure = inner_structure(mesh, fields["mean"] < below)
    fields["is_structure"] = np.isin(np.arange(len(mesh.cells)), structure).astype(np.uint8)

    used = {
        "nodes": options.nodes,
        "k_D": options.k_d,
        "iterations": options.iterations,
        "below": below,
    }
    about = {"image": options.image.name, "image_sha256": sha256(options.image), "options": used}
    tetopt.save_mesh(mesh_path, mesh, fields, about)
    surface = trimesh.Trimesh(mesh.points, boundary_facets(mesh.cells[structure]), process=True)
    with written_whole(surface_path) as temporary:
        surface.export(temporary, file_type="stl")
    save_run_figures(figures, image, initial, result)
    save_scenes(picture_path, [("", structure_before_slices(image, mesh, structure))])
    volume = float(fields["volume"][structure].sum())
    shapes = tuple(tetopt.quality(each.points, each.cells) for each in (initial, mesh))
    seconds = {"all": result.history[-1].seconds}
    summary = run_summary(image, initial, result, about, seconds, shapes)
    pinches = int((np.unique(surface.edges_sorted, axis=0, return_counts=True)[1] > 2).sum())
    summary["structure"] = {
        "n_cells": len(structure),
        "volume_mm3": volume,
        "surface_mm2": float(surface.area),
        "is_watertight": surface.is_watertight,
        "n_edges_in_more_than_two_facets": pinches,
    }
    save_json(json_path, summary)
    print(f"structure below {below:.4g}: {len(structure)} tets, {volume:.0f} mm^3; all in {folder}")
    if pinches:
        print(
            f"note: {pinches} edges of its surface lie in more than two facets, where tets touch "
            "only along an edge"
        )
    if len(structure) < 10:
        print("note: the structure is very small; look at structure.png and adjust --below")
    return 0


def _say(row: IterationRecord) -> None:
    print(f"iteration {row.iteration:3d}  E {row.E:.4f}  {row.seconds:.1f} s", file=sys.stderr)


def _default_threshold(image: tetopt.Image) -> float:
    """Return 0.7 x the median of the voxels brighter than the mean: between CSF and grey matter
    on a T1.
    """
    return 0.7 * float(np.median(image.data[image.data > image.data.mean()]))


def inner_structure(mesh: tetopt.Mesh, is_chosen: np.ndarray) -> np.ndarray:
    """Return the cells, ascending, of the largest connected set of chosen cells that does not
    touch the boundary.
    """
    chosen = np.flatnonzero(is_chosen)
    if len(chosen) == 0:
        raise tetopt.InputError("no cell is below the threshold; raise --below")
    number = components(mesh.cells[chosen])
    sides = facets(mesh.cells)
    is_outer = np.isin(chosen, sides.cells[sides.n_cells == 1, 0])
    sizes = np.bincount(number)
    sizes[np.unique(number[is_outer])] = 0
    if sizes.max() == 0:
        raise tetopt.InputError(
            "every set of cells below the threshold touches the box; lower --below"
        )
    return chosen[number == sizes.argmax()]


if __name__ == "__main__":
    sys.exit(main())
