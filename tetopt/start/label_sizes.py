"""Sizes of cells by label: a number of cells across where a label is thin, a length, or a fraction
of its thickness.

The targets of `tetopt.start.sizes` by place follow from the local thickness of labels
(`tetopt.contents.thickness`), as in proximity sizing in Ansys, narrow regions in COMSOL, and the
slopes of SimNIBS' charm (Puonti et al. 2020, NeuroImage 219, 117044).
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content, plain
from tetopt.contents.labels import BACKGROUND_LABEL
from tetopt.contents.thickness import THICKNESS_PERCENTILES, local_thickness, rows_within
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.start.octree import nodes_of_sizes
from tetopt.start.sizes import LONGEST_IN_BLOCK, NO_BOUND_MM, USUAL_IN_BLOCK, Sizes
from tetopt.system.arrays import Floats

EVERY_LABEL = "*"  # all labels without their own size
SIZE_FORM = re.compile(
    r"(?P<length>[0-9.eE+-]+)(?P<t>t?)(\[(?P<least>[0-9.eE+-]*):(?P<most>[0-9.eE+-]*)\])?"
)
# of the uniform mesh that sets the largest targets if no nodes or lengths are given
DEFAULT_SIZED_NODES = 5000
BELOW_FRACTION = 0.98  # of the requested cells: a place with fewer across counts as below
# bisection steps for the factor that enlarges sizes to fit a number of nodes: to 1e-3
SCALE_STEPS = 12
LARGEST_SCALE = 64.0  # upper limit of that factor
MOST_ACROSS = 20.0  # cells across a label


class LabelSize(NamedTuple):
    """Size of a label's cells, mm: a length, or a bounded multiple of the local thickness.

    Parameters
    ----------
    length : float
        mm; with `is_slope`, mm per mm of thickness.
    is_slope : bool
        True if the size is proportional to the thickness.
    least, most : float
        Bounds of the size, mm.

    Examples
    --------
    >>> LabelSize(0.5, is_slope=True, least=1.0).at(np.array([1.0, 4.0]))
    array([1., 2.])
    """

    length: float
    is_slope: bool = False
    least: float = 0.0
    most: float = np.inf

    def at(self, thickness: NDArray) -> Floats:
        """Return the size of cells at a given thickness of the label.

        Parameters
        ----------
        thickness : array
            Local thickness, mm.

        Returns
        -------
        float64 array
            Sizes, mm, of the same shape.

        Examples
        --------
        >>> LabelSize(1.5).at(np.array([1.0, 4.0]))
        array([1.5, 1.5])
        """
        size = (
            self.length * thickness if self.is_slope else np.full(np.shape(thickness), self.length)
        )
        return np.asarray(np.clip(size, self.least, self.most), dtype=np.float64)


class LabelLayers(NamedTuple):
    """Thickness of a label, and the sizes of its cells.

    Parameters
    ----------
    label : int
        Number of the label.
    thickness : tuple of float
        Percentiles 5, 50 and 95 over its voxels, mm; clipped where sizes no longer depend on it.
    edge : float
        Median of its targets, mm.
    cells_across : float
        Median of thickness over target.
    below : float
        Fraction of its voxels with fewer cells across than requested; 0 if none is requested, as
        for label 0.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> content = tetopt.content(phantom.image(voxel_mm=4), phantom.label_image(voxel_mm=4))
    >>> made = tetopt.sizes_by_label(tetopt.Sizes(edge_size=20.0, by_label={1: 8.0}), content)
    >>> [(row.label, row.edge) for row in made.layers]
    [(1, 8.0), (0, 20.0)]
    """

    label: int
    thickness: tuple[float, float, float]
    edge: float
    cells_across: float
    below: float


class SizesByLabel(NamedTuple):
    """Result of `sizes_by_label`.

    Parameters
    ----------
    sizes : Sizes
        Sizes with a field of targets.
    nodes : int
        Approximate number of nodes that the requested sizes take; without `edge_size` more if there
        are more nodes, as cells outside thin labels become smaller.
    scale : float
        Factor by which they are larger than requested to meet a lower number of nodes; else 1.
    layers : list of LabelLayers
        A row for each label, the thinnest first, label 0 last.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> content = tetopt.content(phantom.image(voxel_mm=4), phantom.label_image(voxel_mm=4))
    >>> sizes = tetopt.Sizes(edge_size=20.0, by_label={1: 8.0})
    >>> made = tetopt.sizes_by_label(sizes, content, nodes=100)
    >>> made.nodes > 100, made.scale > 1.0
    (True, True)
    """

    sizes: Sizes
    nodes: int
    scale: float
    layers: list[LabelLayers]


def parse_label_sizes(text: str) -> dict[int | str, LabelSize]:
    """Parse sizes by label, or by labels' names, as written on a command line; `*` stands for all
    others.

    Parameters
    ----------
    text : str
        "NAME=SIZE, ...", where a size is in mm, or a fraction of the thickness t with optional
        bounds in mm.

    Returns
    -------
    dict of int or str to LabelSize
        The sizes, in that order.

    Raises
    ------
    InputError
        The text has another form, or names a label twice.

    Examples
    --------
    >>> sizes = parse_label_sizes("fluid=1.5, 4=0.6t[1:10], *=6")
    >>> sizes["fluid"].length, sizes[4].is_slope, sizes[4].most
    (1.5, True, 10.0)
    """
    sizes: dict[int | str, LabelSize] = {}
    for pair in text.split(","):
        name, equals, size = (part.strip() for part in pair.partition("="))
        if not (name and equals):
            raise InputError(f'label_size: expected "LABEL=SIZE, ...", got "{text}"')
        label = int(name) if name.isdecimal() else name
        if label in sizes:
            raise InputError(f"label_size: {name} has two sizes")
        sizes[label] = parse_label_size(size)
    return sizes


def parse_label_size(text: str | float) -> LabelSize:
    """Parse a size: "1.5", "0.6t", "0.6t[1:10]", or a number.

    Raises
    ------
    InputError
        The text has another form, or the size is not above 0.
    """
    match = SIZE_FORM.fullmatch(str(text).replace(" ", ""))
    try:
        if match is None:
            raise ValueError(text)
        size = LabelSize(
            float(match["length"]),
            bool(match["t"]),
            float(match["least"] or 0.0),
            float(match["most"] or np.inf),
        )
    except ValueError:
        raise InputError(
            "label_size: expected mm, or a fraction of the thickness t such as 0.6t or "
            f'0.6t[1:10], got "{text}"'
        ) from None
    if not (0.0 < size.length < np.inf and 0.0 <= size.least <= size.most and size.most > 0.0):
        raise InputError(
            f'label_size: expected lengths above 0 mm with increasing bounds, got "{text}"'
        )
    return size


def sizes_by_label(
    sizes: Sizes, image: Image | Content, nodes: int | None = None
) -> SizesByLabel | None:
    """Targets by place from `cells_across` and `by_label` of sizes; None without them.

    A place gets the smallest of its label's size; its local thickness over `cells_across`, except
    in label 0, which is not a tissue; `field`; and `edge_size`, but never less than `smallest`.
    Without `edge_size`, places that are not thin get no target if `nodes` is given, and otherwise
    the usual edge of a uniform mesh of 5,000 nodes.

    Parameters
    ----------
    sizes : Sizes
        The requested sizes.
    image : Image or Content
        A content with labels.
    nodes : int, optional
        Available number of nodes (corners of cells): if sizes take more, a common factor enlarges
        all.

    Returns
    -------
    SizesByLabel
        The sizes as a field, and the sizes of each label.

    Raises
    ------
    InputError
        No labels, a size for a label that does not exist, or a value out of range.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> content = tetopt.content(phantom.image(voxel_mm=4), phantom.label_image(voxel_mm=4))
    >>> made = tetopt.sizes_by_label(tetopt.Sizes(edge_size=30.0, cells_across=2), content)
    >>> [(row.label, round(row.cells_across, 1)) for row in made.layers]
    [(1, 2.0), (0, 2.0)]
    """
    if sizes.cells_across is None and not sizes.by_label:
        return None
    content = plain(image)
    rules = _rules(sizes, content)
    largest, is_everywhere = _largest(sizes, content, nodes)
    voxel = content.image.voxel_volume ** (1.0 / content.image.ndim)
    smallest = max(sizes.smallest, voxel)
    thickness = _thickness(sizes, content, rules, largest)
    wanted_target = _targets(sizes, content, rules, thickness, largest)
    bare = sizes._replace(cells_across=None, by_label=None, field=None, edge_size=largest)

    def scaled(scale: float) -> Sizes:
        larger = np.clip(scale * wanted_target, smallest, max(largest, smallest)).astype(np.float32)
        if content.inside is not None:
            larger[~content.inside] = 0.0
        return bare._replace(field=Image(larger, content.image.affine))

    needed, scale = nodes_of_sizes(content, scaled(1.0))[0], 1.0
    if nodes is not None and needed > nodes:
        low, high = 1.0, LARGEST_SCALE
        for _ in range(SCALE_STEPS):
            scale = float(np.sqrt(low * high))
            low, high = (
                (low, scale)
                if nodes_of_sizes(content, scaled(scale))[0] <= nodes
                else (scale, high)
            )
        scale = high
    made = scaled(scale)
    assert made.field is not None
    layers = _layers(sizes, content, thickness, made.field.data)
    if not is_everywhere:
        data = np.where(made.field.data < largest, made.field.data, 0.0)
        made = made._replace(
            edge_size=None, field=Image(data, content.image.affine) if data.any() else None
        )
    return SizesByLabel(made, needed, scale, layers)


def _rules(sizes: Sizes, content: Content) -> dict[int, LabelSize]:
    """The size of each label that has one, by row; raise InputError for unknown labels and
    invalid values.
    """
    members = content.memberships
    if members is None:
        raise InputError(
            "sizes: cells_across and by_label require labels with smooth interfaces; "
            + ("give labels" if content.rows is None else "smooth them (`smooth_interfaces`)")
        )
    if sizes.cells_across is not None and not 0.0 < sizes.cells_across <= MOST_ACROSS:
        raise InputError(
            f"cells_across: expected above 0 and up to {MOST_ACROSS:g} cells, got "
            f"{sizes.cells_across}"
        )
    by_label = {
        label: size if isinstance(size, LabelSize) else parse_label_size(size)
        for label, size in (sizes.by_label or {}).items()
    }
    rest = by_label.pop(EVERY_LABEL, None)
    rows = {int(label): row for row, label in enumerate(members.labels)}
    if missing := [label for label in by_label if label not in rows]:
        names = ", ".join(map(str, rows))
        raise InputError(
            f"label_size: no meshed voxel has label {missing[0]}; the labels are {names}"
        )
    rules = {rows[int(label)]: size for label, size in by_label.items()}
    return rules if rest is None else {row: rules.get(row, rest) for row in rows.values()}


def _largest(sizes: Sizes, content: Content, nodes: int | None) -> tuple[float, bool]:
    """The largest target, mm, and True if every place has one."""
    if sizes.edge_size is not None and sizes.edge_size < np.inf:
        return sizes.edge_size, True
    n = content.image.ndim
    longest = sizes.longest_edge(content.image, nodes or DEFAULT_SIZED_NODES, content.volume)
    return min(longest * USUAL_IN_BLOCK[n] / LONGEST_IN_BLOCK[n], NO_BOUND_MM), nodes is None


def _thickness(
    sizes: Sizes, content: Content, rules: dict[int, LabelSize], largest: float
) -> NDArray[np.float32]:
    """The local thickness by voxel, mm, clipped where sizes no longer depend on it."""
    assert content.memberships is not None
    spacing = content.image.spacing
    slopes = [min(rule.most, largest) / rule.length for rule in rules.values() if rule.is_slope]
    most = max([largest * (sizes.cells_across or 0.0), *slopes, float(spacing.min())])
    longest_side = float(np.linalg.norm(spacing * content.image.shape))
    rows = rows_within(content.memberships.partition, content.inside)
    return local_thickness(rows, content.memberships, spacing, min(most, longest_side))


def _targets(
    sizes: Sizes,
    content: Content,
    rules: dict[int, LabelSize],
    thickness: NDArray[np.float32],
    largest: float,
) -> Floats:
    """The smallest requested target at each voxel, mm."""
    assert content.memberships is not None
    target = np.minimum(sizes.on_voxels(content.image), largest).astype(np.float64)
    if sizes.cells_across is not None:
        background = np.flatnonzero(content.memberships.labels == BACKGROUND_LABEL)
        is_tissue = ~np.isin(content.memberships.partition, background)
        np.minimum(target, thickness / sizes.cells_across, out=target, where=is_tissue)
    for row, rule in rules.items():
        is_label = content.memberships.partition == row
        target[is_label] = np.minimum(target[is_label], rule.at(thickness[is_label]))
    return target


def _layers(
    sizes: Sizes, content: Content, thickness: NDArray[np.float32], target: NDArray
) -> list[LabelLayers]:
    """The thickness and sizes of each label, the thinnest first, the background last."""
    assert content.memberships is not None
    rows = []
    for row, label in enumerate(content.memberships.labels):
        is_label = content.memberships.partition == row
        if content.inside is not None:
            is_label &= content.inside
        if not is_label.any():
            continue
        thick, edge = thickness[is_label], target[is_label]
        low, middle, high = np.percentile(thick, THICKNESS_PERCENTILES)
        across = thick / edge
        number = (
            0.0 if sizes.cells_across is None or label == BACKGROUND_LABEL else sizes.cells_across
        )
        below = float((across < BELOW_FRACTION * number).mean())
        numbers = float(low), float(middle), float(high)
        rows.append(
            LabelLayers(
                int(label), numbers, float(np.median(edge)), float(np.median(across)), below
            )
        )
    return sorted(rows, key=lambda each: (each.label == BACKGROUND_LABEL, each.thickness))
