"""A page to explore a mesh and its image: cut it, colour it, select cells; drawn by `explore*.js`
in WebGL.

A single file without external references, which needs only a browser.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from tetopt.fem.reference import average_voxels
from tetopt.geometry.box import box_sides
from tetopt.image import Image
from tetopt.io.text import plain
from tetopt.report.colours import grey_limits
from tetopt.report.exhibit import (
    COLOUR_MAP,
    LABEL_FIELD,
    NO_VALUE,
    Exhibit,
    ShownField,
    first_axis,
    loaded_side,
    warp_factors,
)
from tetopt.report.page import (
    data_html,
    encode_numbers,
    escape_unprintable,
    policy_html,
    render_page,
    script_html,
)
from tetopt.system.arrays import Floats
from tetopt.system.files import save_text

PAGE_IMAGE_VOXELS = 2**24  # 16 MB, one byte each: larger images are averaged
PAGE_SIDE_VOXELS = 2048  # along an axis, which nearly all graphics cards support


def colour_table() -> NDArray[np.uint8]:
    """Return the colour map of quantities, (256, 3) red, green and blue."""
    return np.rint(
        255.0 * matplotlib.colormaps[COLOUR_MAP](np.linspace(0.0, 1.0, 256))[:, :3]
    ).astype(np.uint8)


def save_explorer(path: str | Path, shown: Exhibit) -> None:
    """Write `explorer_html` as one file, whole or not at all.

    Replaces an existing file; call `tetopt.system.files.check_output` first.
    """
    save_text(path, explorer_html(shown))


def explorer_html(shown: Exhibit) -> str:
    """Return a page to turn, cut, colour and threshold a tetrahedral mesh, together with its image.

    The page contains everything, and forbids itself all network access. It shows a message in a
    browser without WebGL 2 or scripts. 1 M cells take 24 MB, each field 5 MB, and the image 1.3
    bytes per voxel. The image is drawn in grey from its 0.5 to its 99.5 percentile, with each voxel
    placed by the affine; above `PAGE_IMAGE_VOXELS` neighbouring voxels are averaged, and the page
    notes this.
    """
    mesh, fields, skipped, image, title, sets, displacements, n_nodes, reactions = shown
    centre = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2.0
    data = {
        "centre": centre.tolist(),
        "points": encode_numbers(mesh.points - centre, "<f4"),
        "cells": encode_numbers(mesh.cells, "<u4"),
        # of curved cells
        "volumes": None if mesh.midpoints is None else encode_numbers(mesh.cell_volumes, "<f4"),
        "labelField": LABEL_FIELD,
        "fields": [_packed_field(field) for field in fields],
        "skipped": skipped,
        "colours": encode_numbers(colour_table(), "u1"),
        "image": None if image is None else _packed_image(image, centre),
        "sets": [
            {"name": name, "triangles": encode_numbers(nodes, "<u4")}
            for name, nodes in sets.items()
        ],
        "noValue": NO_VALUE,
        "displacements": [
            {"step": step, "u": encode_numbers(u, "<f4")} for step, u in displacements.items()
        ],
        "nNodes": n_nodes,
        "reactions": reactions,
        "factors": warp_factors(shown),
        "axis": first_axis(shown),
        "loaded": loaded_side(shown),
    }
    markup = {
        "policy": policy_html(),
        "data": data_html("data", data),
        "script": script_html("explorer"),
    }
    return escape_unprintable(
        f"{render_page('report/explore.html', title=plain(title), **markup)}\n"
    )


def _packed_field(field: ShownField) -> dict[str, Any]:
    nodes = None if field.nodes is None else encode_numbers(field.nodes, "<f4")
    return {**field._asdict(), "values": encode_numbers(field.values, "<f4"), "nodes": nodes}


def _packed_image(image: Image, centre: Floats) -> dict[str, Any]:
    """Pack the image as bytes, the first axis fastest, with the map from places relative to
    `centre` to indices.
    """
    shape = _shown_shape(image.shape)
    shown = image if shape == image.shape else average_voxels(image, shape)
    low, high = grey_limits([shown.data.astype(np.float64)])
    greys = np.rint(255.0 * np.clip((shown.data - low) / (high - low), 0.0, 1.0)).astype(np.uint8)
    to_index = np.linalg.inv(shown.affine)
    to_index[:3, 3] = shown.to_index(centre)
    corners = np.array(np.meshgrid(*box_sides(shown.shape))).reshape(3, -1).T
    world = shown.to_world(corners) - centre
    return {
        "shape": shown.shape,
        "original": image.shape,
        "voxels": encode_numbers(greys.ravel(order="F"), "u1"),
        "toIndex": to_index.T.ravel().tolist(),  # by columns, as WebGL expects
        "box": [world.min(axis=0).tolist(), world.max(axis=0).tolist()],
        "limits": [low, high],
    }


def _shown_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the image's shape or, if that is too large for the page, a coarser one; the longest
    axes shrink first.
    """
    sizes = np.minimum(shape, PAGE_SIDE_VOXELS)
    longest = int(sizes.max())
    while np.prod(np.minimum(sizes, longest), dtype=np.int64) > PAGE_IMAGE_VOXELS:
        longest -= 1
    return tuple(np.minimum(sizes, longest).tolist())
