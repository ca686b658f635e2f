"""Display of meshes, images and results in notebooks: numbers, a small picture, and the progress of
a run.

Functions take plain arrays, so that any class can use them. Pillow draws the pictures, which take a
few kilobytes whatever the number of cells.
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
from tetopt.system.arrays import Floats, Ints

if TYPE_CHECKING:
    import PIL.Image

R = TypeVar("R")

PICTURE_PIXELS = 320  # the longer side of a picture, shown next to a table of numbers
DRAWN_SCALE = 2  # pictures are drawn at this scale and reduced, for smooth edges
PICTURE_COLOURS = 32  # size of the palette: half of the bytes that 256 colours take
MARGIN_PIXELS = 4  # around the cells
MANY_SECTIONED = 4000  # cells in a section beyond which edges would hide them
# The colour of cells without values, and an edge colour that stands out from all greys on light and
# dark pages.
CELL_COLOUR, EDGE_COLOUR = (150, 190, 225, 255), (40, 90, 160, 255)
# range of drawn values, distinct from the page's black and white
DARKEST_GREY, BRIGHTEST_GREY = 30, 245
# quantiles drawn as these two greys, so that single cells do not reduce the contrast
GREY_QUANTILES = (0.01, 0.99)
TABLE_STYLE = "border-collapse:collapse;margin:0;color:inherit"
CELL_STYLE = (
    "text-align:left;padding:0.15em 0.8em 0.15em 0;vertical-align:top;background:none;color:inherit"
)


def card_html(title: str, rows: Iterable[tuple[str, str]], picture: str = "") -> str:
    """Return HTML with a title, rows of names and values, and a picture next to them, in the
    colours of the page.

    Title and rows may be any text; they are escaped. `picture` is HTML.
    """
    lines = "".join(
        f'<tr><th style="{CELL_STYLE}">{_escape_html(name)}</th><td '
        f'style="{CELL_STYLE}">{_escape_html(value)}</td></tr>'
        for name, value in rows
    )
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start">'
        f"<div><strong>{_escape_html(title)}</strong><table "
        f'style="{TABLE_STYLE}">{lines}</table></div>{picture}</div>'
    )


def _escape_html(text: str) -> str:
    """Escape a text for HTML, on one line."""
    return html.escape("".join(sign if sign.isprintable() else " " for sign in text))


def mesh_rows(points: Floats, cells: Ints) -> list[tuple[str, str]]:
    """Return rows that describe a mesh: its size, its extent and the shape of its cells."""
    n = points.shape[1]
    shape = rho(points, cells)
    angles = dihedral_angles(points, cells)
    return [
        ("nodes", f"{len(points):,}"),
        ("tetrahedra" if n == 3 else "triangles", f"{len(cells):,}"),
        ("extent", extent_words(points)),
        ("mean rho", f"{shape.mean():.3f} (1/{n} is regular)"),
        (
            "dihedral angles" if n == 3 else "angles",
            f"{angles.min():.1f} to {angles.max():.1f} degrees",
        ),
    ]


def extent_words(points: Floats) -> str:
    """Format the sides of the bounding box of points, mm."""
    return f"{' x '.join(f'{side:.4g}' for side in np.ptp(points, axis=0))} mm"


# --- pictures


def section_html(points: Floats, cells: Ints, values: NDArray | None = None) -> str:
    """Return a picture of a mesh as HTML: in 3-D its section at half height in z, x to the right
    and y upwards.

    With one value per cell, (M,), cells are shaded by it; otherwise all have one colour.
    """
    values = None if values is None or values.shape != (len(cells),) else values.astype(np.float64)
    if points.shape[1] == 3:
        middle = 0.5 * (points[:, 2].min() + points[:, 2].max())
        cut = plane_cut(points, cells, points[:, 2] - middle)
        corners = cut.corners[:, :, :2]
        owner = cut.cells
        where = f"the section at z = {middle:.4g} mm"
    else:
        corners = points[cells]
        owner = np.arange(len(cells))
        where = "the mesh"
    if len(owner) == 0:  # separate components on both sides of the plane
        return ""
    return _picture_html(
        _draw_polygons(corners, None if values is None else values[owner]), f"{where}: its cells"
    )


def _draw_polygons(corners: Floats, values: NDArray | None) -> PIL.Image.Image:
    """Draw polygons (K, 3 or 4, 2), shaded by their values (K,)."""
    import PIL.Image
    import PIL.ImageDraw

    low = corners.min(axis=(0, 1))
    high = corners.max(axis=(0, 1))
    scale = DRAWN_SCALE * (PICTURE_PIXELS - 2 * MARGIN_PIXELS) / float((high - low).max())
    margin = DRAWN_SCALE * MARGIN_PIXELS
    width, height = (int(side) + 2 * margin for side in np.ceil((high - low) * scale))
    places = (corners - low) * scale + margin
    places[..., 1] = height - places[..., 1]
    picture = PIL.Image.new("RGBA", (width, height), (0, 0, 0, 0))
    pen = PIL.ImageDraw.Draw(picture)
    edge = EDGE_COLOUR if len(corners) <= MANY_SECTIONED or values is None else None
    colours = (
        [CELL_COLOUR] * len(corners)
        if values is None
        else [(k, k, k, 255) for k in greys(values).tolist()]
    )
    for place, colour in zip(places.reshape(len(places), -1).tolist(), colours, strict=True):
        pen.polygon(place, fill=colour, outline=edge)
    return picture.resize(
        (max(width // DRAWN_SCALE, 1), max(height // DRAWN_SCALE, 1)), PIL.Image.Resampling.BOX
    )


def greys(values: NDArray) -> Ints:
    """Map numbers to greys between the darkest and the brightest; NaN becomes the darkest."""
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite, GREY_QUANTILES) if finite.size else (0.0, 0.0)
    fraction = (
        np.clip((values - low) / (high - low), 0.0, 1.0)
        if high > low
        else np.full(values.shape, 0.5)
    )
    fraction = np.where(np.isfinite(fraction), fraction, 0.0)
    return np.rint(DARKEST_GREY + fraction * (BRIGHTEST_GREY - DARKEST_GREY)).astype(np.int64)


def slice_html(data: NDArray, affine: Floats) -> str:
    """Return a picture of an image's voxels as HTML: in 3-D the middle slice along the last
    axis.
    """
    import PIL.Image

    flat = data[:, :, data.shape[2] // 2] if data.ndim == 3 else data
    sides = np.sqrt(
        (affine[:2, :2] ** 2).sum(axis=0) if data.ndim == 2 else (affine[:3, :2] ** 2).sum(axis=0)
    )
    size = np.array(flat.shape) * sides
    width, height = np.maximum(np.rint(PICTURE_PIXELS * size / size.max()), 1).astype(int).tolist()
    step = np.maximum(np.array(flat.shape) // PICTURE_PIXELS, 1)
    grey = greys(np.asarray(flat[:: step[0], :: step[1]], dtype=np.float64))
    # the first axis to the right, the second upwards
    pixels = np.ascontiguousarray(grey.T[::-1].astype(np.uint8))
    picture = PIL.Image.fromarray(pixels).resize((width, height), PIL.Image.Resampling.NEAREST)
    where = f"slice k = {data.shape[2] // 2}" if data.ndim == 3 else "the image"
    return _picture_html(picture, f"{where}: i to the right, j upwards")


def _picture_html(picture: PIL.Image.Image, words: str) -> str:
    """Embed a picture in a page, with few colours and a transparent background."""
    file = io.BytesIO()
    few = picture.quantize(PICTURE_COLOURS) if picture.mode == "RGBA" else picture
    few.save(file, "PNG", optimize=True)
    data = base64.b64encode(file.getvalue()).decode("ascii")
    return (
        f'<img alt="{_escape_html(words)}" title="{_escape_html(words)}" '
        f'src="data:image/png;base64,{data}">'
    )


# --- the kernel


def in_kernel() -> bool:
    """Return whether this runs in a notebook: IPython with a kernel, not in a terminal."""
    ipython = sys.modules.get("IPython")  # a notebook has loaded it already
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


class Bar:
    """A progress bar for a run in a notebook; a callback that takes records."""

    def __init__(self, iterations: int) -> None:
        from IPython.display import display  # type: ignore[import-not-found, unused-ignore]

        self.iterations = iterations
        self.handle = display(self._shown("begins"), display_id=True, raw=True)

    def __call__(self, record: Any) -> None:
        """Show one row of the history."""
        words = (
            f"iteration {record.iteration} of {self.iterations}, E {record.E:.3f}, "
            f"{record.seconds:.1f} s"
        )
        self._update(words, record.iteration)

    def end(self, record: Any, ended: str) -> None:
        """Show why the run ended, with its last row."""
        words = (
            f"ended after {record.iteration} iterations ({ended}), E {record.E:.3f}, "
            f"{record.seconds:.1f} s"
        )
        self._update(words, self.iterations)

    def _update(self, words: str, iteration: int) -> None:
        if self.handle is not None:  # None where nothing can be displayed
            self.handle.update(self._shown(words, iteration), raw=True)

    def _shown(self, words: str, iteration: int = 0) -> dict[str, str]:
        most = max(self.iterations, 1)
        bar = f'<progress value="{iteration}" max="{most}" style="width:20em"></progress>'
        return {
            "text/plain": f"tetopt: {words}",
            "text/html": f"<div>{bar} {_escape_html(words)}</div>",
        }


def with_bar(function: Callable[..., R]) -> Callable[..., R]:
    """Decorate a function that takes a `callback` so that it shows a progress bar in a notebook by
    default.

    The function takes `iterations` and `callback` by name, and its result has `history` and
    `ended`.
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
