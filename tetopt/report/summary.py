"""The numbers of a run, as written by `tetopt mesh --json`."""

from __future__ import annotations

import hashlib
import os
import platform
from importlib.metadata import version
from typing import Any

import numba
import numpy as np

from tetopt.contents.content import Content, plain
from tetopt.engine.loop import MeshingResult
from tetopt.geometry.quadratic import node_count
from tetopt.image import Image
from tetopt.measure.judge import unexplained_by
from tetopt.measure.quality import Quality
from tetopt.mesh import Mesh
from tetopt.model.loads import load_words
from tetopt.model.model import Model

SHOWN_VERSIONS = ("numpy", "scipy", "numba", "nibabel", "pyvista")


def versions() -> dict[str, str]:
    """Return the versions of tetopt, Python and the libraries that affect the numbers."""
    ours = {"tetopt": version("tetopt"), "python": platform.python_version()}
    return ours | {name: version(name) for name in SHOWN_VERSIONS}


def mesh_hash(mesh: Mesh) -> str:
    """Return the SHA-256 of points, cells and midpoints, if any: equal for bitwise identical
    meshes.
    """
    digest = hashlib.sha256(np.ascontiguousarray(mesh.points).tobytes())
    digest.update(np.ascontiguousarray(mesh.cells).tobytes())
    if mesh.midpoints is not None:
        digest.update(mesh.midpoints.tobytes())
    return digest.hexdigest()


def image_summary(image: Image | Content) -> dict[str, Any]:
    """Return shape and position of an image, and the spread and volume of its voxels to cover.

    `total_variation` is E_D of a single cell around these voxels.
    """
    what = plain(image)
    grid, (mean, low, high, variance) = what.given, what.spread
    volume = (
        grid.volume
        if what.continuation is None
        else what.continuation.inside.sum() * grid.voxel_volume
    )
    return {
        "shape": grid.shape,
        "spacing_mm": grid.spacing,
        "affine": grid.affine,
        "min": low,
        "max": high,
        "mean": mean,
        "volume_mm": float(volume),
        "total_variation": variance * float(volume),
    }


def run_summary(
    image: Image | Content,
    initial: Mesh,
    result: MeshingResult,
    about: dict[str, Any],
    seconds: dict[str, float],
    shapes: tuple[Quality | None, Quality | None],
) -> dict[str, Any]:
    """Return all numbers of a run: options and file (`about`), versions, energies by iteration,
    quality (both meshes).

    `shapes` are these qualities, initial first; None for one that could not be measured.
    """
    first, last = result.history[0], result.history[-1]
    own = plain(image)
    is_varied = own.variance > 0.0
    known = result.fraction
    fractions = (
        unexplained_by(own, result.mesh, *last.counted) if known is None else known,
        unexplained_by(own, initial, *first.counted),
    )
    left, left_first = (fraction if is_varied else None for fraction in fractions)
    return {
        **about,
        "versions": versions(),
        "machine": {
            "cores": os.cpu_count(),
            "threads": numba.get_num_threads(),
            "system": platform.platform(),
        },
        "image_properties": image_summary(own),
        "ended": result.ended,
        "iterations_done": last.iteration,
        "energies": {
            "E": last.E,
            "E_G_relative": last.E_G / first.E_G,
            "E_D_relative": last.E_D / first.E_D if first.E_D > 0.0 else None,
            "E_D_fraction_of_variance": left,
            "E_D_fraction_of_variance_initial": left_first,
        },
        "quality_initial": shapes[0],
        "quality": shapes[1],
        "history": result.history,
        "seconds": seconds,
        "mesh_sha256": mesh_hash(result.mesh),
        "violated": dict(result.violated),
        **({} if result.curving is None else {"curving": result.curving}),
    }


def size_summary(mesh: Mesh, order: int) -> dict[str, Any]:
    """Return the numbers of nodes, of nodes including those of order 2 ("n_nodes_in_all"), and
    of cells of a mesh.
    """
    n_nodes = node_count(mesh.points, mesh.cells, order)
    return {
        "order": order,
        "n_nodes": len(mesh.points),
        "n_nodes_in_all": n_nodes,
        "n_cells": len(mesh.cells),
    }


def model_summary(model: Model) -> dict[str, Any]:
    """Return the sizes of mesh and sets, and the materials of cells, moduli in kPa."""
    of_facets = {name: len(rows) for name, rows in model.sets.facets.items()}
    of_cells = {name: len(cells) for name, cells in model.sets.cells.items()}
    summary: dict[str, Any] = {
        "size": size_summary(model.mesh, model.order),
        "sets": {"facets": of_facets, "cells": of_cells},
    }
    if (table := model.materials) is not None:
        young, nu = table.young, table.nu
        summary["materials"] = {
            "count": len(young),
            "young_kPa": young,
            "nu": nu,
            "binning": table.binning,
        }
        if (along := table.along) is not None:
            own = {"young_along_kPa": along.young_along, "shear_along_kPa": along.shear_along}
            summary["materials"] |= {**own, "fibre_binning": table.fibre_binning}
        if table.density is not None:
            summary["materials"]["density_kg_m3"] = table.density
    if model.loads:
        summary["loads"] = [load_words(load) for load in model.loads]
    return summary
