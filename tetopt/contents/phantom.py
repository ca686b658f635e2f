"""Phantoms: images described by a table of shapes, so that h(x) is known exactly everywhere.

A phantom is a TOML file, for example ::

    name = "cyst"
    description = "A soft cyst in a stiff plate"
    size_mm = [40, 30]                     # the box; two entries make a 2-D phantom
    voxel_mm = 0.5                         # a number, or one per axis
    background = { intensity = 80, label = 0 }

    [[shape]]                              # painted in order, later over earlier
    kind = "ellipsoid"
    center_mm = [5, 0]
    radii_mm = [8, 5]                      # a number, or one per axis
    rotation_deg = 30
    intensity = 10
    label = 1

Top level
    ``name``, ``description``, ``size_mm``, ``voxel_mm`` and ``background`` are required. Optional
    are ``center_mm`` (world position of the box's centre, by default the origin), ``axes``,
    ``blur_mm`` and ``noise_sd`` (standard deviations, default 0), ``seed`` (default 0) and the
    shapes. ``axes`` has one *row* for each voxel axis: its direction in the world, of any length
    (it is normalised); rows need not be orthogonal. They are the directions of the affine's
    *columns*, and the domain is the parallelepiped that they span with the lengths ``size_mm``.
Shapes
    All shapes are in world millimetres, whatever ``axes`` is. Each has a ``kind``, an
    ``intensity``, a ``label`` (an integer, 0 or more) and optionally a ``name``:

    - ``ellipsoid``: ``center_mm``, ``radii_mm`` and optionally ``rotation_deg``;
    - ``box``: ``center_mm``, ``size_mm`` and optionally ``rotation_deg``;
    - ``layer``: the slab ``|normal . x - offset_mm| <= thickness_mm / 2``; ``normal`` has any
      length (it is normalised first).

    In 2-D ``rotation_deg`` is one counter-clockwise angle; in 3-D it is three angles, about the
    fixed world axes x, then y, then z. A shape contains its own surface, up to rounding.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from tetopt.errors import InputError
from tetopt.image import SINGULAR_DETERMINANT, Image, transform_vectors
from tetopt.system.arrays import Floats, Ints
from tetopt.system.budget import check_memory
from tetopt.system.incoming import toml_of

# intensities, noise or blur, labels, and the data written; 17 were measured
PHANTOM_VOXEL_BYTES = 30.0
MAX_PHANTOM_VOXELS = 2**31  # 1290^3
# sub-voxels along an axis: 262,144 per voxel in 3-D, which fit into one chunk of points
MAX_SUPERSAMPLE = 64
BLUR_SIGMAS = 4.0  # reach of a blur, in standard deviations: less than 1e-4 of it lies beyond
POINTS_PER_CHUNK = 2**18  # evaluated at once, with a few tens of MB of temporaries

_TOP_KEYS = ("name", "description", "size_mm", "voxel_mm", "background")
_TOP_OPTIONS = ("center_mm", "axes", "blur_mm", "noise_sd", "seed", "shape")
_SHAPE_KEYS = {
    "ellipsoid": ("center_mm", "radii_mm"),
    "box": ("center_mm", "size_mm"),
    "layer": ("normal", "offset_mm", "thickness_mm"),
}


def _lock(record: Any, state: dict[str, Any]) -> None:
    """Set the fields of a copied or unpickled record, with read-only arrays: pickle does not
    keep that.
    """
    for value in state.values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
    vars(record).update(state)


@dataclass(frozen=True, eq=False)
class Shape:
    """One painted shape: an ellipsoid, a box or a layer.

    A layer is a box with a single axis, so the three share two formulas (see `signed_distance`).

    Parameters
    ----------
    kind : {"ellipsoid", "box", "layer"}
        Kind of the shape.
    center : (n,) float64
        World coordinates, mm.
    frame : (m, n) float64
        Unit rows, the shape's own axes in the world; m = n, or 1 for a layer.
    half : (m,) float64
        Radii, or half the edge lengths, along those axes, mm.
    intensity : float
        Intensity inside.
    label : int
        Label inside.
    name : str
        Empty if the file gives none.

    Examples
    --------
    >>> ball = tetopt.load_phantom("sphere").shapes[0]
    >>> ball.kind, ball.half.tolist(), ball.intensity, ball.label
    ('ellipsoid', [20.0, 20.0, 20.0], 100.0, 1)
    """

    kind: str
    center: Floats
    frame: Floats
    half: Floats
    intensity: float
    label: int
    name: str = ""

    def __setstate__(self, state: dict[str, Any]) -> None:
        _lock(self, state)


def signed_distance(shape: Shape, points: ArrayLike) -> Floats:
    """Lower bound of the distance from the shape's surface, negative inside, with the exact zero
    set.

    Its Lipschitz constant is 1, so a ball of radius r about x can meet the surface only if the
    absolute value at x is at most r. For a layer and a box it is the distance itself. For an
    ellipsoid with radii D it is ``(|D^-1 (x - c)| - 1) min(D)``: the gradient of ``|D^-1 y|`` is no
    longer than ``1 / min(D)``.

    Parameters
    ----------
    shape : Shape
    points : (..., n) float64, mm

    Returns
    -------
    (...) float64, mm
    """
    points = np.asarray(points, dtype=np.float64)
    # One axis at a time instead of a matrix product: the rounding of BLAS depends on the batch's
    # size, and a point on a surface must fall on the same side in every batch.
    shifted = [points[..., i] - c for i, c in enumerate(shape.center)]
    local = [
        sum(r * x for r, x in zip(row, shifted, strict=True) if r != 0.0) for row in shape.frame
    ]
    if shape.kind == "ellipsoid":
        square = sum((x / radius) ** 2 for x, radius in zip(local, shape.half, strict=True))
        return (np.sqrt(square) - 1.0) * shape.half.min()
    excess = [np.abs(x) - half for x, half in zip(local, shape.half, strict=True)]
    deepest = np.max(excess, axis=0)
    outside = np.sqrt(sum(np.maximum(q, 0.0) ** 2 for q in excess))
    return outside + np.minimum(deepest, 0.0)


@dataclass(frozen=True, eq=False)
class Phantom:
    """A box with a background and shapes painted over it in order, as a file describes it.

    `load_phantom` makes phantoms and checks everything. Arrays are read-only.

    Parameters
    ----------
    name, description : str
        Name and description from the file.
    size_mm : (n,) float64
        Edge lengths of the box along the voxel axes, n = 2 or 3.
    voxel_mm : (n,) float64
        Default voxel edges of `image`.
    center_mm : (n,) float64
        World position of the box's centre.
    axes : (n, n) float64
        Unit rows: world direction of each voxel axis.
    background_intensity : float
        Intensity outside all shapes.
    background_label : int
        Label outside all shapes.
    shapes : tuple of Shape
        Shapes in painting order.
    blur_mm, noise_sd : float
        Standard deviations of the rendered image's blur and noise.
    seed : int
        Seed of the noise.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("sphere")
    >>> phantom.ndim, phantom.size_mm.tolist(), phantom.background_intensity
    (3, [64.0, 64.0, 64.0], 20.0)
    """

    name: str
    description: str
    size_mm: Floats
    voxel_mm: Floats
    center_mm: Floats
    axes: Floats
    background_intensity: float
    background_label: int
    shapes: tuple[Shape, ...]
    blur_mm: float = 0.0
    noise_sd: float = 0.0
    seed: int = 0

    def __setstate__(self, state: dict[str, Any]) -> None:
        _lock(self, state)

    @property
    def ndim(self) -> int:
        """Number of axes n, 2 or 3."""
        return len(self.size_mm)

    def intensity(self, points: ArrayLike) -> Floats:
        """The exact intensity at points inside and outside the box.

        Parameters
        ----------
        points : (..., n) array
            World coordinates, mm.

        Returns
        -------
        (...) float64
            h of the top shape there.

        Raises
        ------
        InputError
            Points that are not finite, or not n numbers each.

        Examples
        --------
        >>> tetopt.load_phantom("sphere").intensity([[0.0, 0.0, 19.9], [0.0, 0.0, 20.1]]).tolist()
        [100.0, 20.0]
        """
        return self._intensities()[self._top_shape(self._checked_points(points))]

    def labels(self, points: ArrayLike) -> Ints:
        """The label at points inside and outside the box.

        Parameters
        ----------
        points : (..., n) array
            World coordinates, mm.

        Returns
        -------
        (...) int64
            Label of the top shape there.

        Raises
        ------
        InputError
            Points that are not finite, or not n numbers each.

        Examples
        --------
        >>> tetopt.load_phantom("sphere").labels([[0.0, 0.0, 19.9], [0.0, 0.0, 20.1]]).tolist()
        [1, 0]
        """
        return self._labels()[self._top_shape(self._checked_points(points))]

    def image(
        self,
        voxel_mm: ArrayLike | None = None,
        blur_mm: float | None = None,
        noise_sd: float | None = None,
        seed: int | None = None,
        supersample: int = 4,
    ) -> Image:
        """Render the phantom as voxels; options default to the file's.

        A voxel that a surface may cut (its centre is no farther from it than half the voxel's
        longest diagonal, by the bound of `signed_distance`) holds the mean over the
        ``supersample**n`` midpoints of its sub-voxels; any other voxel lies in one shape and holds
        its value exactly. Then the blur and the noise are applied. A layer thinner than a sub-voxel
        shows only where it meets a midpoint: raise `supersample`.

        Parameters
        ----------
        voxel_mm : float or (n,) floats, optional
            Voxel edges. An axis gets ``round(size / voxel)`` voxels, at least one, and the edge is
            then adjusted so that they cover the box exactly.
        blur_mm : float, optional
            Standard deviation of a Gaussian along each voxel axis, so on sheared axes it is not
            isotropic in the world. The image is continued by its border values.
        noise_sd : float, optional
            Standard deviation of white Gaussian noise, in units of intensity. It may make values
            negative.
        seed : int, optional
            Seed of the noise; the same seed gives the same bits.
        supersample : int
            Sub-voxels along each axis, 1 to 64; 1 gives the intensity at the voxel centres.

        Returns
        -------
        Image
            float64, in the phantom's box.

        Raises
        ------
        InputError
            An option out of range, more than ``2**31`` voxels, or more than fit into memory.

        Examples
        --------
        >>> phantom = tetopt.load_phantom("sphere")
        >>> phantom.image(voxel_mm=4).shape
        (16, 16, 16)
        >>> noisy = phantom.image(voxel_mm=4, noise_sd=5, seed=1)
        >>> print(f"{(noisy.data - phantom.image(voxel_mm=4).data).std():.1f}")
        5.0
        """
        where = f"phantom {self.name!r}"
        blur = _number(self.blur_mm if blur_mm is None else blur_mm, f"{where}: blur_mm", 0.0)
        # a wider blur leaves only the mean, and its filter would be as long
        if blur > self.size_mm.max():
            raise InputError(
                f"{where}: blur_mm: expected at most the box's {self.size_mm.max():g} mm, got "
                f"{blur:g}"
            )
        sd = _number(self.noise_sd if noise_sd is None else noise_sd, f"{where}: noise_sd", 0.0)
        seed = _integer(self.seed if seed is None else seed, f"{where}: seed")
        supersample = _integer(supersample, f"{where}: supersample", 1, MAX_SUPERSAMPLE)
        shape, affine = self._grid(voxel_mm)
        linear, n = affine[:-1, :-1], len(shape)
        offsets = ((_index_block((supersample,) * n) + 0.5) / supersample - 0.5) @ linear.T
        corners = _index_block((2,) * n) - 0.5
        # The 1e-9 includes a voxel that just touches a surface, however distances are rounded.
        reach = np.linalg.norm(corners @ linear.T, axis=1).max() * (1.0 + 1e-9)
        values = np.empty(shape)
        for part, centers in _voxel_centers(shape, affine):
            values[part] = self._voxel_means(centers, offsets, reach).reshape(values[part].shape)
        if blur > 0.0:
            sigmas = blur / np.linalg.norm(linear, axis=0)
            values = scipy.ndimage.gaussian_filter(
                values, sigmas, mode="nearest", truncate=BLUR_SIGMAS
            )
        if sd > 0.0:
            values += np.random.default_rng(seed).normal(0.0, sd, shape)
        return Image(values, affine)

    def label_image(self, voxel_mm: ArrayLike | None = None) -> Image:
        """The label at every voxel's centre, on the same voxels as `image`.

        Parameters
        ----------
        voxel_mm : float or (n,) floats, optional
            Voxel edges, as for `image`.

        Returns
        -------
        Image
            Whole numbers.

        Raises
        ------
        InputError
            As for `image`.

        Examples
        --------
        >>> labels = tetopt.load_phantom("sphere").label_image(voxel_mm=4)
        >>> int(labels.data.sum())  # voxels whose centre lies in the ball
        552
        """
        shape, affine = self._grid(voxel_mm)
        data = np.empty(shape, dtype=np.int64)
        for part, centers in _voxel_centers(shape, affine):
            data[part] = self._labels()[self._top_shape(centers)].reshape(data[part].shape)
        return Image(data, affine)

    def _intensities(self) -> Floats:
        """Intensities in painting order, the background's first."""
        return np.array(
            [self.background_intensity, *(s.intensity for s in self.shapes)], dtype=np.float64
        )

    def _labels(self) -> Ints:
        """Labels in painting order, the background's first."""
        return np.array([self.background_label, *(s.label for s in self.shapes)], dtype=np.int64)

    def _checked_points(self, points: ArrayLike) -> Floats:
        """Points as float64; raise InputError unless they are (..., n) finite numbers."""
        try:
            checked = np.asarray(points, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"phantom {self.name!r}: points: expected numbers of shape (..., {self.ndim}), "
                f"got {points!r}"
            ) from error
        if checked.ndim == 0 or checked.shape[-1] != self.ndim:
            raise InputError(
                f"phantom {self.name!r}: points: expected shape (..., {self.ndim}), got "
                f"{checked.shape}; "
                f"give {self.ndim} world coordinates in mm for each"
            )
        if not np.isfinite(checked).all():
            raise InputError(
                f"phantom {self.name!r}: points: some are NaN or infinite; remove those points"
            )
        return checked

    def _top_shape(self, points: Floats) -> Ints:
        """Position in painting order of the last shape at each point: 1 is the first, 0 the
        background.
        """
        top = np.zeros(points.shape[:-1], dtype=np.int64)
        for k, shape in enumerate(self.shapes, start=1):
            top[signed_distance(shape, points) <= 0.0] = k
        return top

    def _grid(self, voxel_mm: ArrayLike | None) -> tuple[tuple[int, ...], Floats]:
        """Number of voxels along each axis and the affine, for voxels of about `voxel_mm`; raise
        InputError unless they and their temporaries fit into memory.
        """
        where = f"phantom {self.name!r}"
        voxel = self.voxel_mm if voxel_mm is None else _voxel_edges(voxel_mm, self.size_mm, where)
        with np.errstate(over="ignore"):
            counts = np.maximum(1.0, np.rint(self.size_mm / voxel))
            n_voxels = counts.prod()
        if n_voxels > MAX_PHANTOM_VOXELS:
            power = MAX_PHANTOM_VOXELS.bit_length() - 1
            raise InputError(
                f"{where}: voxel_mm: expected at most 2**{power} voxels, got "
                f"{' x '.join(f'{count:.6g}' for count in counts)} of {voxel.tolist()} mm; use "
                "larger ones"
            )
        linear = self.axes.T * (self.size_mm / counts)
        affine = np.eye(self.ndim + 1)
        affine[:-1, :-1] = linear
        affine[:-1, -1] = self.center_mm - linear @ ((counts - 1) / 2)
        try:
            # checks the voxels' size before they are rendered
            Image(np.zeros((1,) * self.ndim), affine)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
        shape = tuple(int(c) for c in counts)
        what = f"{where}: {' x '.join(map(str, shape))} voxels"
        check_memory(PHANTOM_VOXEL_BYTES * math.prod(shape), what, "use larger voxels")
        return shape, affine

    def _voxel_means(self, centers: Floats, offsets: Floats, reach: float) -> Floats:
        """Mean intensity, (M,), over voxels with these centres (M, n).

        `offsets` (S, n) lead from a centre to its sub-voxels' midpoints; no point of a voxel is
        farther from its centre than `reach`.
        """
        top = np.zeros(len(centers), dtype=np.int64)  # last shape that contains the centre
        base = np.zeros(len(centers), dtype=np.int64)  # last shape that contains the whole voxel
        is_cut = np.zeros((len(self.shapes), len(centers)), dtype=bool)
        for k, shape in enumerate(self.shapes, start=1):
            distance = signed_distance(shape, centers)
            top[distance <= 0.0] = k
            base[distance < -reach] = k
            is_cut[k - 1] = np.abs(distance) <= reach
        # A surface under a shape that contains the whole voxel is hidden. Testing the sub-voxels
        # only against the shapes that cut their voxel, instead of all, renders ellipsoids_brain in
        # 0.7 s instead of 3.3 s.
        is_cut &= np.arange(1, len(self.shapes) + 1)[:, None] > base
        intensities = self._intensities()
        means = intensities[top]
        cut = np.flatnonzero(is_cut.any(axis=0))
        step = max(1, POINTS_PER_CHUNK // len(offsets))
        for start in range(0, len(cut), step):
            voxels = cut[start : start + step]
            paint = np.repeat(base[voxels, None], len(offsets), axis=1)
            for k, shape in enumerate(self.shapes, start=1):
                rows = np.flatnonzero(is_cut[k - 1, voxels])
                if rows.size == 0:
                    continue
                is_inside = signed_distance(shape, centers[voxels[rows], None] + offsets) <= 0.0
                paint[rows] = np.where(is_inside, k, paint[rows])
            values = intensities[paint]
            # Relative to the first sub-voxel, so that a uniform voxel keeps its value to the last
            # bit.
            means[voxels] = values[:, 0] + (values - values[:, :1]).mean(axis=1)
        return means


def phantom_folder() -> Path:
    """Folder of the project's own phantoms: inside the installed package, or next to it in a
    checkout.
    """
    package = Path(__file__).resolve().parents[1]
    inside = package / "phantoms"
    return inside if inside.is_dir() else package.parent / "phantoms"


def phantom_names() -> list[str]:
    """Names, sorted, of the project's own phantoms."""
    return sorted(path.stem for path in phantom_folder().glob("*.toml"))


def load_phantom(name_or_path: str | Path) -> Phantom:
    """Load a phantom by its name, or from a file.

    Parameters
    ----------
    name_or_path : str or Path
        One of `phantom_names`, or the path of a ``.toml`` file.

    Returns
    -------
    Phantom
        A box with shapes and exactly known intensity.

    Raises
    ------
    InputError
        No such phantom or file, or a file that does not describe a phantom; the message says where
        and why.

    Examples
    --------
    >>> phantom = tetopt.load_phantom("two_spheres")
    >>> phantom.size_mm.tolist(), [shape.name for shape in phantom.shapes]
    ([80.0, 60.0, 60.0], ['large inclusion', 'small inclusion'])
    >>> tetopt.contents.phantom.phantom_names()[:3]
    ['constant', 'disc_2d', 'ellipsoids_brain']
    """
    path = Path(name_or_path)
    if isinstance(name_or_path, str) and path.suffix != ".toml":
        if name_or_path not in phantom_names():
            raise InputError(
                f"phantom {name_or_path!r}: no such phantom; use one of "
                f"{', '.join(phantom_names())}, "
                "or the path of a .toml file"
            )
        path = phantom_folder() / f"{name_or_path}.toml"
    try:
        table = toml_of(path, "phantom's file")
    except InputError as error:
        known = (
            f"; or use one of the names {', '.join(phantom_names())}" if not path.exists() else ""
        )
        raise InputError(f"phantom {error}{known}") from error
    return _phantom(table, f"phantom {path}")


def _phantom(table: dict[str, Any], where: str) -> Phantom:
    """The phantom of a parsed file; raise InputError, starting with `where`, for invalid
    entries.
    """
    _check_keys(table, _TOP_KEYS, _TOP_OPTIONS, where)
    size = table["size_mm"]
    if not isinstance(size, list) or len(size) not in (2, 3):
        raise InputError(
            f"{where}: size_mm: expected a list of 2 or 3 numbers, one per axis, got {size!r}"
        )
    n = len(size)
    size_mm = _positive(_numbers(size, n, f"{where}: size_mm"), f"{where}: size_mm")
    background = table["background"]
    if not isinstance(background, dict):
        raise InputError(
            f"{where}: background: expected a table, got {background!r}; "
            "for example: background = { intensity = 20, label = 0 }"
        )
    _check_keys(background, ("intensity",), ("label",), f"{where}: background")
    shapes = table.get("shape", [])
    if not isinstance(shapes, list) or not all(isinstance(shape, dict) for shape in shapes):
        raise InputError(
            f"{where}: shape: expected tables, got {shapes!r}; start each shape with [[shape]]"
        )
    return Phantom(
        name=_text(table["name"], f"{where}: name"),
        description=_text(table["description"], f"{where}: description"),
        size_mm=size_mm,
        voxel_mm=_voxel_edges(table["voxel_mm"], size_mm, where),
        center_mm=_numbers(table.get("center_mm", [0.0] * n), n, f"{where}: center_mm"),
        axes=_axes(table.get("axes", np.eye(n).tolist()), n, f"{where}: axes"),
        background_intensity=_number(background["intensity"], f"{where}: background: intensity"),
        background_label=_integer(background.get("label", 0), f"{where}: background: label"),
        shapes=tuple(
            _shape(shape, n, f"{where}: shape {k}") for k, shape in enumerate(shapes, start=1)
        ),
        blur_mm=_number(table.get("blur_mm", 0.0), f"{where}: blur_mm", 0.0),
        noise_sd=_number(table.get("noise_sd", 0.0), f"{where}: noise_sd", 0.0),
        seed=_integer(table.get("seed", 0), f"{where}: seed"),
    )


def _shape(table: dict[str, Any], n: int, where: str) -> Shape:
    """The shape of one [[shape]] table."""
    if "name" in table:
        where += f" {_text(table['name'], f'{where}: name')!r}"
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in _SHAPE_KEYS:
        raise InputError(f"{where}: kind: expected one of {', '.join(_SHAPE_KEYS)}, got {kind!r}")
    needed = ("kind", "intensity", "label", *_SHAPE_KEYS[kind])
    _check_keys(
        table,
        needed,
        ("name",) if kind == "layer" else ("name", "rotation_deg"),
        f"{where}: {kind}",
    )
    if kind == "layer":
        normal = _numbers(table["normal"], n, f"{where}: normal")
        if not normal.any():
            raise InputError(
                f"{where}: normal: expected a direction, got all zeros; make at least one entry "
                "non-zero"
            )
        frame = _unit(normal)[None]
        center = frame[0] * _number(table["offset_mm"], f"{where}: offset_mm")
        thickness = np.array([_number(table["thickness_mm"], f"{where}: thickness_mm")])
        half = _positive(thickness, f"{where}: thickness_mm") / 2
    else:
        key = _SHAPE_KEYS[kind][1]
        lengths = _positive(
            _numbers(table[key], n, f"{where}: {key}", is_one_enough=True), f"{where}: {key}"
        )
        frame = _rotation(table.get("rotation_deg"), n, f"{where}: rotation_deg").T
        center = _numbers(table["center_mm"], n, f"{where}: center_mm")
        half = lengths if kind == "ellipsoid" else lengths / 2
    for array in (center, frame, half):
        array.setflags(write=False)
    intensity = _number(table["intensity"], f"{where}: intensity")
    label = _integer(table["label"], f"{where}: label")
    return Shape(kind, center, frame, half, intensity, label, table.get("name", ""))


def _rotation(angles: Any, n: int, what: str) -> Floats:
    """Rotation matrix (n, n) of `rotation_deg`."""
    if angles is None:
        return np.eye(n)
    if n == 2:
        return scipy.spatial.transform.Rotation.from_euler(
            "z", _number(angles, what), degrees=True
        ).as_matrix()[:2, :2]
    return scipy.spatial.transform.Rotation.from_euler(
        "xyz", _numbers(angles, n, what), degrees=True
    ).as_matrix()


def _axes(rows: Any, n: int, what: str) -> Floats:
    """Unit rows (n, n), read-only."""
    if not isinstance(rows, list) or len(rows) != n:
        raise InputError(
            f"{what}: expected {n} rows, the directions of the voxel axes, got {rows!r}"
        )
    with np.errstate(invalid="ignore"):  # a row of zeros becomes NaN, and with it the determinant
        axes = np.array(
            [_unit(_numbers(row, n, f"{what}: row {i}")) for i, row in enumerate(rows, start=1)]
        )
    if not abs(np.linalg.det(axes)) >= SINGULAR_DETERMINANT:
        raise InputError(
            f"{what}: the directions {rows!r} do not span {n}-D space; make them linearly "
            "independent"
        )
    axes.setflags(write=False)
    return axes


def _unit(vector: Floats) -> Floats:
    """The vector at length 1, exact for an axis-aligned one."""
    vector = vector / np.abs(vector).max()
    return vector / np.linalg.norm(vector)


def _voxel_edges(voxel_mm: Any, size_mm: Floats, where: str) -> Floats:
    """Voxel edges (n,); raise InputError unless they are positive and no larger than the box."""
    what = f"{where}: voxel_mm"
    voxel = _positive(_numbers(voxel_mm, len(size_mm), what, is_one_enough=True), what)
    if (voxel > size_mm).any():
        raise InputError(
            f"{what}: expected voxels no larger than the box of {size_mm.tolist()} mm, got "
            f"{voxel.tolist()}; "
            "use smaller voxels"
        )
    return voxel


def _index_block(shape: Sequence[int]) -> Floats:
    """Index coordinates, (product of shape, n), of all voxels in C order."""
    return np.stack(np.unravel_index(np.arange(math.prod(shape)), shape), axis=-1).astype(
        np.float64
    )


def _voxel_centers(
    shape: Sequence[int], affine: Floats
) -> Iterator[tuple[tuple[slice, ...], Floats]]:
    """Iterate over parts of a grid of voxels, with the world centres (M, n) of these in C order.

    Centres are summed term by term, not by BLAS, whose rounding depends on the number of rows.
    """
    edge = round(POINTS_PER_CHUNK ** (1 / len(shape)))
    for corner in itertools.product(*(range(0, size, edge) for size in shape)):
        ends = [min(at + edge, size) for at, size in zip(corner, shape, strict=True)]
        index = _index_block([b - a for a, b in zip(corner, ends, strict=True)]) + corner
        yield (
            tuple(map(slice, corner, ends)),
            transform_vectors(index, affine[:-1, :-1]) + affine[:-1, -1],
        )


def _check_keys(
    table: dict[str, Any], needed: Iterable[str], optional: Iterable[str], where: str
) -> None:
    """Raise InputError if a required key is missing, or a key is neither required nor optional."""
    missing = [key for key in needed if key not in table]
    if missing:
        raise InputError(f"{where}: missing {', '.join(missing)}; {', '.join(needed)} are required")
    unknown = [key for key in table if key not in {*needed, *optional}]
    if unknown:
        raise InputError(
            f"{where}: unknown {', '.join(map(repr, unknown))}; the keys allowed here are "
            f"{', '.join([*needed, *optional])}"
        )


def _is_number(value: Any) -> bool:
    """True for a finite int or float; the comparison also rejects NaN and integers beyond
    float64.
    """
    return isinstance(value, int | float) and not isinstance(value, bool) and -1e300 < value < 1e300


def _number(value: Any, what: str, low: float = -np.inf) -> float:
    """A finite number, `low` or more, as float."""
    value = _plain(value)
    if not _is_number(value) or value < low:
        limit = f", {low:g} or more" if low > -np.inf else ""
        raise InputError(f"{what}: expected a finite number{limit}, got {value!r}")
    return float(value)


def _integer(value: Any, what: str, low: int = 0, high: int = 2**31 - 1) -> int:
    """An integer from low to high."""
    value = _plain(value)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise InputError(f"{what}: expected an integer from {low} to {high}, got {value!r}")
    return value


def _numbers(value: Any, n: int, what: str, is_one_enough: bool = False) -> Floats:
    """(n,) finite float64, read-only; a single number stands for n of them if `is_one_enough`."""
    value = _plain(value)
    row = [value] * n if is_one_enough and _is_number(value) else value
    if not isinstance(row, list | tuple) or len(row) != n or not all(map(_is_number, row)):
        expected = f"a number or a list of {n}" if is_one_enough else f"a list of {n} numbers"
        raise InputError(f"{what}: expected {expected}, all finite, got {value!r}")
    numbers = np.array(row, dtype=np.float64)
    numbers.setflags(write=False)
    return numbers


def _positive(values: Floats, what: str) -> Floats:
    """Return the values; raise InputError unless all are above 0."""
    if not (values > 0.0).all():
        raise InputError(f"{what}: expected lengths above 0 mm, got {values.tolist()}")
    return values


def _text(value: Any, what: str) -> str:
    """A non-empty string."""
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"{what}: expected a quoted string, got {value!r}")
    return value


def _plain(value: Any) -> Any:
    """Convert NumPy arrays and scalars to Python lists and numbers; return other values
    unchanged.
    """
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
