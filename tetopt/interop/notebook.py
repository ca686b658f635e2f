"""What a notebook shows of meshes, images and results: numbers, a small picture, and the progress of a run.

All of plain arrays, so that any class can use it. Pictures are drawn by Pillow: they take some kilobytes however many
cells there are.
"""

from __future__ import annotations

import base64
import functools
import html
import inspect
import io
import sys
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tetopt.geometry.cut import plane_cut
from tetopt.geometry.simplex import dihedral_angles, rho

if TYPE_CHECKING:
    import PIL.Image

R = TypeVar("R")

PICTURE_PIXELS = 320  # the longer side of a picture: beside a table of numbers
DRAWN_SCALE = 2  # drawn so many times larger, and made smaller: smooth edges
PICTURE_COLOURS = 32  # in its palette, half of the bytes of 256
MARGIN_PIXELS = 4  # around the cells
MANY_SECTIONED = 4000  # cells of a section beyond which their edges would hide them
# Cells without values; edges that stand out from all greys, on a page in light as in dark.
CELL_COLOUR, EDGE_COLOUR = (150, 190, 225, 255), (40, 90, 160, 255)
DARKEST_GREY, BRIGHTEST_GREY = 30, 245  # of values: neither is the page's black or white
GREY_QUANTILES = (0.01, 0.99)  # of values, drawn as those two: single cells do not take the contrast away
TABLE_STYLE = "border-collapse:collapse;margin:0;color:inherit"
CELL_STYLE = "text-align:left;padding:0.15em 0.8em 0.15em 0;vertical-align:top;background:none;color:inherit"


def card_html(title: str, rows: Iterable[tuple[str, str]], picture: str = "") -> str:
    """A title, rows of names and values, and markup of a picture beside them, in the colours of the page.

    Title and rows are texts of any kind, which are escaped.
    """
    lines = "".join(
        f'<tr><th style="{CELL_STYLE}">{_escaped(name)}</th><td style="{CELL_STYLE}">{_escaped(value)}</td></tr>'
        for name, value in rows
    )
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start">'
        f'<div><strong>{_escaped(title)}</strong><table style="{TABLE_STYLE}">{lines}</table></div>{picture}</div>'
    )


def _escaped(text: str) -> str:
    """A text on one line, for HTML."""
    return html.escape("".join(sign if sign.isprintable() else " " for sign in text))


def mesh_rows(points: NDArray[np.float64], cells: NDArray[np.int64]) -> list[tuple[str, str]]:
    """Numbers of a mesh in words: its size, its extent, how its cells are shaped."""
    n = points.shape[1]
    shape = rho(points, cells)
    angles = dihedral_angles(points, cells)
    return [
        ("nodes", f"{len(points):,}"),
        ("tetrahedra" if n == 3 else "triangles", f"{len(cells):,}"),
        ("extent", extent_words(points)),
        ("mean rho", f"{shape.mean():.3f} (1/{n} is regular)"),
        ("dihedral angles" if n == 3 else "angles", f"{angles.min():.1f} to {angles.max():.1f} degrees"),
    ]


def extent_words(points: NDArray[np.float64]) -> str:
    """The sides of the box around points, mm."""
    return f"{' x '.join(f'{side:.4g}' for side in np.ptp(points, axis=0))} mm"


# --- pictures


def section_html(points: NDArray[np.float64], cells: NDArray[np.int64], values: NDArray | None = None) -> str:
    """A picture of a mesh: in 3-D the cells that the middle plane across z cuts, x to the right and y upwards.

    With a number for each cell, (M,), cells are grey by it, else all have one colour.
    """
    values = None if values is None or values.shape != (len(cells),) else values.astype(np.float64)
    if points.shape[1] == 3:
        middle = 0.5 * (points[:, 2].min() + points[:, 2].max())
        cut = plane_cut(points, cells, points[:, 2] - middle)
        corners, owner, where = cut.corners[:, :, :2], cut.cells, f"the section at z = {middle:.4g} mm"
    else:
        corners, owner, where = points[cells], np.arange(len(cells)), "the mesh"
    if len(owner) == 0:  # of pieces on both sides
        return ""
    return _picture_html(_drawn(corners, None if values is None else values[owner]), f"{where}: its cells")


def _drawn(corners: NDArray[np.float64], values: NDArray | None) -> PIL.Image.Image:
    """Polygons (K, 3 or 4, 2) as a picture, grey by their values (K,)."""
    import PIL.Image
    import PIL.ImageDraw

    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    scale = DRAWN_SCALE * (PICTURE_PIXELS - 2 * MARGIN_PIXELS) / float((high - low).max())
    margin = DRAWN_SCALE * MARGIN_PIXELS
    width, height = (int(side) + 2 * margin for side in np.ceil((high - low) * scale))
    places = (corners - low) * scale + margin
    places[..., 1] = height - places[..., 1]
    picture = PIL.Image.new("RGBA", (width, height), (0, 0, 0, 0))
    pen = PIL.ImageDraw.Draw(picture)
    edge = EDGE_COLOUR if len(corners) <= MANY_SECTIONED or values is None else None
    colours = [CELL_COLOUR] * len(corners) if values is None else [(k, k, k, 255) for k in greys(values).tolist()]
    for place, colour in zip(places.reshape(len(places), -1).tolist(), colours, strict=True):
        pen.polygon(place, fill=colour, outline=edge)
    return picture.resize((max(width // DRAWN_SCALE, 1), max(height // DRAWN_SCALE, 1)), PIL.Image.Resampling.BOX)


def greys(values: NDArray) -> NDArray[np.int64]:
    """Numbers as greys between the darkest and the brightest; NaN is the darkest."""
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite, GREY_QUANTILES) if finite.size else (0.0, 0.0)
    fraction = np.clip((values - low) / (high - low), 0.0, 1.0) if high > low else np.full(values.shape, 0.5)
    fraction = np.where(np.isfinite(fraction), fraction, 0.0)
    return np.rint(DARKEST_GREY + fraction * (BRIGHTEST_GREY - DARKEST_GREY)).astype(np.int64)


def slice_html(data: NDArray, affine: NDArray[np.float64]) -> str:
    """A picture of an image's voxels: in 3-D its middle slice along the last axis, in 2-D all of it."""
    import PIL.Image

    flat = data[:, :, data.shape[2] // 2] if data.ndim == 3 else data
    sides = np.sqrt((affine[:2, :2] ** 2).sum(axis=0) if data.ndim == 2 else (affine[:3, :2] ** 2).sum(axis=0))
    size = np.array(flat.shape) * sides
    width, height = np.maximum(np.rint(PICTURE_PIXELS * size / size.max()), 1).astype(int).tolist()
    step = np.maximum(np.array(flat.shape) // PICTURE_PIXELS, 1)
    grey = greys(np.asarray(flat[:: step[0], :: step[1]], dtype=np.float64))
    pixels = np.ascontiguousarray(grey.T[::-1].astype(np.uint8))  # the first axis to the right, the second upwards
    picture = PIL.Image.fromarray(pixels).resize((width, height), PIL.Image.Resampling.NEAREST)
    where = f"slice k = {data.shape[2] // 2}" if data.ndim == 3 else "the image"
    return _picture_html(picture, f"{where}: i to the right, j upwards")


def _picture_html(picture: PIL.Image.Image, words: str) -> str:
    """A picture of few colours within the page, transparent where nothing is."""
    file = io.BytesIO()
    few = picture.quantize(PICTURE_COLOURS) if picture.mode == "RGBA" else picture
    few.save(file, "PNG", optimize=True)
    data = base64.b64encode(file.getvalue()).decode("ascii")
    return f'<img alt="{_escaped(words)}" title="{_escaped(words)}" src="data:image/png;base64,{data}">'


# --- the kernel


def in_kernel() -> bool:
    """Whether this runs in a notebook: IPython with a kernel, and not in a terminal."""
    ipython = sys.modules.get("IPython")  # nobody else has loaded it, if it is not there
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


class Bar:
    """The progress of a run in a notebook, as a callback of records."""

    def __init__(self, iterations: int) -> None:
        from IPython.display import display  # type: ignore[import-not-found, unused-ignore]

        self.iterations = iterations
        self.handle = display(self._shown("begins"), display_id=True, raw=True)

    def __call__(self, record: Any) -> None:
        """Show a row of the history."""
        words = f"iteration {record.iteration} of {self.iterations}, E {record.E:.3f}, {record.seconds:.1f} s"
        self._update(words, record.iteration)

    def end(self, record: Any, ended: str) -> None:
        """Show how the run ended, with its last row."""
        words = f"ended after {record.iteration} iterations ({ended}), E {record.E:.3f}, {record.seconds:.1f} s"
        self._update(words, self.iterations)

    def _update(self, words: str, iteration: int) -> None:
        if self.handle is not None:  # where nothing can be displayed
            self.handle.update(self._shown(words, iteration), raw=True)

    def _shown(self, words: str, iteration: int = 0) -> dict[str, str]:
        most = max(self.iterations, 1)
        bar = f'<progress value="{iteration}" max="{most}" style="width:20em"></progress>'
        return {"text/plain": f"tetopt: {words}", "text/html": f"<div>{bar} {_escaped(words)}</div>"}


def with_bar(function: Callable[..., R]) -> Callable[..., R]:
    """A function of a `callback` of records that in a notebook, without another callback, shows a bar.

    It takes `iterations` and `callback` by name, and returns what has `history` and `ended`.
    """
    default = inspect.signature(function).parameters["iterations"].default

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> R:
        if options.get("callback") is not None or not in_kernel():
            return function(*args, **options)
        bar = Bar(options.get("iterations", default))
        result: Any = function(*args, **(options | {"callback": bar}))
        bar.end(result.history[-1], result.ended)
        return result

    return call
