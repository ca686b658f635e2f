"""What a mask would win as two labels: its own way against labels inside and outside, with the
outside's cells dropped at the end, at the same number of inner nodes.

    python benchmarks/masks_as_labels.py [--labels CT_LABELS --image CT] [--brain T1] [CASE ...]

Outside, the image is constant, the mean of the inside, so exchanges spend few nodes there. Measures
use neither the surface nor the sampling of the package: voxel centres in cells, one by one. The
table is in benchmarks/README.md.
"""

from __future__ import annotations

import argparse
import resource
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

import tetopt

NEAR = 0.03  # of the inner nodes of the mask's way: a run of the labels' way this near counts
TRIALS = 5  # numbers of nodes in the box, at most
FIRST_RATIO = 1.6  # nodes in the box over inner ones, in the first trial
MARGIN = 4  # voxels around a mask
LIVER, SPLEEN = 5, 1  # labels of the CT
FINE_MM, THICK_MM = 1.0, 5.0  # voxel edges within and across thick slices


class Case(NamedTuple):
    """A mask and the image in it."""

    image: tetopt.Image
    mask: tetopt.Image  # 0 to 1
    nodes: int


class Numbers(NamedTuple):
    """Measures of a mesh."""

    nodes: int
    dice: float
    unexplained: float  # of the variance within the mask; voxels in no cell count in full
    angle: float  # smallest dihedral, degrees
    pieces: int
    euler: int  # Euler number of the boundary
    seconds: float  # CPU


def textured(mask: np.ndarray, affine: np.ndarray) -> tetopt.Image:
    """Waves along the three axes, as intensities of a phantom."""
    at = np.indices(mask.shape)
    h = sum(np.sin(0.35 * (k + 1) * along) for k, along in enumerate(at))
    return tetopt.Image(np.asarray(h), affine)


def wall(thickness: int, is_tube: bool, nodes: int = 1500) -> Case:
    """A hollow sphere, or a tube open at both sides of the box, of outer radius 18 voxels."""
    at = np.indices((44, 44, 44)) - np.array([21.7, 21.4, 21.2])[:, None, None, None]
    radius = np.sqrt((at[1:] if is_tube else at).__pow__(2).sum(axis=0))
    mask = (radius < 18.0) & (radius >= 18.0 - thickness)
    return Case(textured(mask, np.eye(4)), tetopt.Image(mask.astype(float)), nodes)


def fractions() -> Case:
    """A bent ellipsoid, blurred."""
    at = np.indices((48, 48, 48)) - 23.6
    level = (at[0] / 18) ** 2 + (at[1] / 12 + 0.02 * at[0]) ** 2 + (at[2] / 9) ** 2
    mask = scipy.ndimage.gaussian_filter((level < 1.0).astype(float), 1.2)
    return Case(textured(mask, np.eye(4)), tetopt.Image(np.clip(mask, 0.0, 1.0)), 1500)


def organ(image: Path, labels: Path, label: int, nodes: int) -> Case:
    """An organ of a CT, with its intensities."""
    mask = tetopt.load_image(labels)
    return Case(
        tetopt.load_image(image),
        tetopt.Image((np.rint(mask.data) == label).astype(float), mask.affine),
        nodes,
    )


def thick_slices(image: Path, labels: Path, label: int, nodes: int) -> Case:
    """An organ of a CT on voxels of 1 mm in slices of 5 mm."""
    case = organ(image, labels, label, nodes)
    zoom = case.image.spacing / [FINE_MM, FINE_MM, THICK_MM]
    box = scipy.ndimage.find_objects(case.mask.data.astype(int))[0]
    part = tuple(slice(max(s.start - 3, 0), s.stop + 3) for s in box)
    soft = scipy.ndimage.gaussian_filter(case.mask.data[part], 0.7)
    mask = scipy.ndimage.zoom(soft, zoom, order=1, grid_mode=True, mode="nearest") >= 0.5
    h = scipy.ndimage.zoom(case.image.data[part], zoom, order=1, grid_mode=True, mode="nearest")
    affine = np.diag([FINE_MM, FINE_MM, THICK_MM, 1.0])
    return Case(tetopt.Image(h, affine), tetopt.Image(mask.astype(float), affine), nodes)


def brain(image: Path, nodes: int) -> Case:
    """The brain of a T1 that is 0 around it."""
    t1 = tetopt.load_image(image)
    return Case(t1, tetopt.Image((t1.data > 0).astype(float), t1.affine), nodes)


def as_mask(case: Case) -> tuple[tetopt.Mesh, float]:
    """The mesh of today's way, and CPU seconds."""
    begin = cpu_seconds()
    result = tetopt.mesh_image(tetopt.content(case.image, mask=case.mask), case.nodes)
    return result.mesh, cpu_seconds() - begin


def as_labels(case: Case, inner: int) -> Iterator[tuple[tetopt.Mesh, float]]:
    """Meshes of the labels' way with nearly so many inner nodes, the last one nearest, and the CPU
    seconds of each.
    """
    inside = case.mask.data >= 0.5
    box = scipy.ndimage.find_objects(inside.astype(int))[0]
    low = [max(s.start - MARGIN, 0) for s in box]
    high = [min(s.stop + MARGIN, n) for s, n in zip(box, inside.shape, strict=True)]
    image, mask = case.image.box(low, high), case.mask.box(low, high)
    data, inside = image.data.astype(float), mask.data >= 0.5
    data[~inside] = data[inside].mean()
    image, labels = (
        tetopt.Image(data, image.affine),
        tetopt.Image(inside.astype(float), image.affine),
    )
    nodes = FIRST_RATIO * inner
    for _ in range(TRIALS):
        begin = cpu_seconds()
        result = tetopt.mesh_image(tetopt.content(image, labels), int(nodes))
        kept = result.mesh.cells[np.asarray(result.labels) == 1]
        used, cells = np.unique(kept, return_inverse=True)
        mesh = tetopt.Mesh(result.mesh.points[used], cells.reshape(kept.shape))
        yield mesh, cpu_seconds() - begin
        if abs(len(used) / inner - 1.0) <= NEAR:
            return
        nodes *= inner / len(used)


def measured(mesh: tetopt.Mesh, case: Case, seconds: float) -> Numbers:
    """The measures of a mesh of a mask."""
    inside = case.mask.data >= 0.5
    owner = owners(mesh, case.mask)
    dice = 2.0 * (inside & (owner >= 0)).sum() / (inside.sum() + (owner >= 0).sum())
    h, of = case.image.data[inside].astype(float), owner[inside] + 1
    count = np.maximum(np.bincount(of), 1)
    mean = np.bincount(of, h) / count
    mean[0] = h.mean()
    facet, count = np.unique(
        np.sort(
            np.concatenate([np.delete(mesh.cells, corner, axis=1) for corner in range(4)]), axis=1
        ),
        axis=0,
        return_counts=True,
    )
    skin = facet[count == 1]
    edges = np.unique(np.sort(skin[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1), axis=0)
    numbers = tetopt.quality(mesh.points, mesh.cells)
    return Numbers(
        len(mesh.points),
        dice,
        float(((h - mean[of]) ** 2).sum() / ((h - h.mean()) ** 2).sum()),
        numbers.min_dihedral,
        pieces(mesh.cells),
        len(np.unique(skin)) - len(edges) + len(skin),
        seconds,
    )


def owners(mesh: tetopt.Mesh, image: tetopt.Image) -> np.ndarray:
    """The cell of each voxel's centre, -1 outside."""
    owner, at = np.full(image.shape, -1), image.to_index(mesh.points)
    for number, cell in enumerate(mesh.cells):
        x = at[cell]
        low = np.maximum(np.ceil(x.min(axis=0)), 0).astype(int)
        high = np.minimum(np.floor(x.max(axis=0)) + 1, image.shape).astype(int)
        if (high <= low).any():
            continue
        grid = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1)
        weights = (grid - x[0]) @ np.linalg.inv(x[1:] - x[0])
        is_in = (weights >= 0.0).all(axis=-1) & (weights.sum(axis=-1) <= 1.0)
        owner[tuple(map(slice, low, high))][is_in] = number
    return owner


def pieces(cells: np.ndarray) -> int:
    """Number of sets of cells that are connected by facets."""
    facet = np.sort(
        np.concatenate([np.delete(cells, corner, axis=1) for corner in range(4)]), axis=1
    )
    _, first, number = np.unique(facet, axis=0, return_index=True, return_inverse=True)
    n = len(cells)
    pairs = np.arange(4 * n) % n, first[number.ravel()] % n
    graph = scipy.sparse.coo_array((np.ones(4 * n), pairs), shape=(n, n))
    return int(scipy.sparse.csgraph.connected_components(graph)[0])


def cpu_seconds() -> float:
    """User and system time of this process so far."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def cases(
    image: Path | None, labels: Path | None, t1: Path | None
) -> dict[str, Callable[[], Case]]:
    """The cases by name."""
    known: dict[str, Callable[[], Case]] = {
        **{f"wall {t}": (lambda t=t: wall(t, False)) for t in (2, 3, 5)},
        "tube 2": lambda: wall(2, True),
        "tube 3": lambda: wall(3, True),
        "fractions": fractions,
    }
    if image is not None and labels is not None:
        known |= {
            "liver": lambda: organ(image, labels, LIVER, 2000),
            "spleen": lambda: organ(image, labels, SPLEEN, 1000),
            "thick liver": lambda: thick_slices(image, labels, LIVER, 2000),
            "thick spleen": lambda: thick_slices(image, labels, SPLEEN, 1000),
        }
    if t1 is not None:
        known["brain"] = lambda: brain(t1, 5000)
    return known


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--image", type=Path)
    parser.add_argument("--labels", type=Path)
    parser.add_argument("--brain", type=Path)
    parser.add_argument("--only", choices=["mask", "labels"])
    parser.add_argument("cases", nargs="*")
    options = parser.parse_args()
    known = cases(options.image, options.labels, options.brain)
    tiny = wall(5, False)
    tetopt.mesh_image(tiny.image, 100, labels=tiny.mask, iterations=6)  # loads the kernels
    tetopt.mesh_image(tiny.image, 100, mask=tiny.mask, iterations=6)
    heads = "case", "way", "nodes", "Dice", "unexplained", "angle", "pieces", "Euler", "CPU"
    print(f"| {' | '.join(heads)} |\n|" + 9 * "---|")
    for name in options.cases or known:
        case = known[name]()
        mesh, seconds = as_mask(case)
        own = measured(mesh, case, seconds)
        show(name, "mask", own)
        if options.only == "mask":
            continue
        for mesh, seconds in as_labels(case, own.nodes):
            show(name, "labels", measured(mesh, case, seconds))


def show(name: str, way: str, n: Numbers) -> None:
    """Print a row of the table."""
    print(
        f"| {name} | {way} | {n.nodes} | {n.dice:.4f} | {n.unexplained:.4f} | {n.angle:.1f} | "
        f"{n.pieces} | {n.euler} | {n.seconds:.1f} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
