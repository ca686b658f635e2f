"""Spatial transforms of registrations: files of ITK and ANTs, FSL, AFNI and SPM, as maps of points.

A transform maps points of the fixed image to the moving image, in world coordinates: it is the map
by which images are resampled from the moving to the fixed image. Files are read here, not by
nitransforms 25.1, whose maps differ from ITK's: cubic instead of linear between the voxels of a
dense field (by 0.6 mm on a rough one), identity outside of it without a word, 32-bit numbers from
text, and no single transform in HDF5.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import nibabel
import numpy as np
import scipy
from numpy.typing import NDArray

from tetopt.errors import InputError, prefix_errors
from tetopt.image import Image, transform_vectors
from tetopt.io.apart import read_apart
from tetopt.model.fields import HALF_TURN
from tetopt.system.arrays import Floats
from tetopt.system.extras import install_hint
from tetopt.system.incoming import regular_file

LPS_AXES = np.diag([*HALF_TURN, 1.0])  # from RAS+, or back
MATLAB_SUFFIX, HDF5_SUFFIXES, NIFTI_SUFFIXES = ".mat", (".h5", ".hdf5"), (".nii", ".nii.gz")
TEXT_HEAD = "#Insight Transform File"
FIELD_KIND = "DisplacementFieldTransform"
# of ITK's kinds: the number of parameters (of a field, per voxel), and those of fixed parameters
ITK_COUNTS = {
    FIELD_KIND: (3, (18,)),
    "AffineTransform": (12, (3,)),
    "MatrixOffsetTransformBase": (12, (3,)),
    "Euler3DTransform": (6, (3, 4)),
    "VersorRigid3DTransform": (6, (3,)),
    "Similarity3DTransform": (7, (3,)),
    "TranslationTransform": (3, (0, 3)),
}
TEXT_ROUNDING = 1e-6  # of numbers in text: a versor's length, the last row of a matrix
VECTOR_AXES = {1007: HALF_TURN, 1006: np.ones(3)}  # of ITK's vectors, displacements
NIFTYREG_NAME = "NREG_TRANS"  # of the intent: values are of many kinds, in RAS+
# of SPM's deformations, whose values are places: in the description, and of the file's name
SPM_WORD, SPM_PREFIXES = "eformation", ("y_", "iy_")
FIELD_EDGE_VOXELS = 0.5 + 1e-6  # beyond the outer voxel centres, to the field's end
LEAST_DETERMINANT = 1e-9  # of a linear transform, over the product of its columns' lengths
INVERSE_MM = 1e-9  # of a coordinate: an inverse is exact to this
INVERSE_STEPS = 60  # at most, by Newton's method

Step = Callable[[Floats], Floats]
"""A map of points (K, 3) in RAS+ mm."""


class Linear(NamedTuple):
    """An affine map of points."""

    matrix: NDArray[np.floating]  # (4, 4), RAS+ mm

    def __call__(self, points: Floats) -> Floats:
        """Map points (K, 3), mm."""
        return transform_vectors(points, self.matrix[:3, :3]) + self.matrix[:3, 3]

    def inverse(self) -> Linear:
        """Return the inverse map."""
        return Linear(np.linalg.inv(self.matrix))


class Dense(NamedTuple):
    """A field of displacements, linear between voxel centres."""

    shifts: Floats  # (i, j, k, 3), RAS+ mm
    affine: NDArray[np.floating]  # (4, 4), from voxel index to RAS+ mm

    def __call__(self, points: Floats) -> Floats:
        """Map points (K, 3), mm; InputError for points that the field does not cover."""
        index = Linear(self.affine).inverse()(points)
        most = np.array(self.shifts.shape[:3]) - 1.0 + FIELD_EDGE_VOXELS
        moved = self._moved(points)
        is_out = ((index < -FIELD_EDGE_VOXELS) | (index > most)).any(axis=1)
        is_out |= ~np.isfinite(moved).all(axis=1)
        if is_out.any():
            raise InputError(
                f"its field does not cover {int(is_out.sum())} of {len(points)} points, such as "
                f"{np.round(points[is_out][0], 1).tolist()} mm; is it the transform of another "
                "space, or in another place of the order?"
            )
        return moved

    def _moved(self, points: Floats) -> Floats:
        """Map points; those beyond the field have the shift of its nearest place."""
        index = Linear(self.affine).inverse()(points).T
        parts = np.moveaxis(self.shifts, -1, 0)
        shifts = [
            scipy.ndimage.map_coordinates(part, index, order=1, mode="nearest") for part in parts
        ]
        return points + np.column_stack(shifts)

    def inverse(self) -> Step:
        """Return the inverse map, by Newton's method; it raises InputError where it finds none."""
        if not np.isfinite(self.shifts).all():
            raise InputError("its field has NaN, so no inverse; pass the file of the inverse")
        steps = 0.5 * np.diag(np.linalg.norm(self.affine[:3, :3], axis=0))

        def solve(points: Floats) -> Floats:
            places = points
            for _ in range(INVERSE_STEPS):
                rest = self._moved(places) - points
                is_left = (np.abs(rest) > INVERSE_MM).any(axis=1)
                if not is_left.any():
                    self(places)  # that the field covers
                    return places
                slopes = [
                    (self._moved(places + step) - self._moved(places - step)) / (2.0 * step.sum())
                    for step in steps
                ]
                ways = np.linalg.pinv(np.stack(slopes, axis=-1)) @ rest[..., None]
                places = places - ways[..., 0]
            raise InputError(
                f"its field has no inverse at {int(is_left.sum())} of {len(points)} points: it "
                "folds, or ends there; pass the file of the inverse (ANTs: 1InverseWarp.nii.gz) "
                "instead"
            )

        return solve


@dataclass(frozen=True)
class Chain:
    """Maps, one after the other, with their files."""

    steps: Sequence[Any]
    names: Sequence[str]

    def __call__(self, points: Floats) -> Floats:
        """Map points (K, 3), mm; InputError for points that a dense field does not cover."""
        for step, name in zip(self.steps, self.names, strict=True):
            with prefix_errors(name):
                points = step(points)
        return points


def load_transform(
    *paths: str | Path,
    inverse: bool = False,
    fixed: Image | None = None,
    moving: Image | None = None,
) -> Chain:
    """Read the transform of a registration: one file, or several as antsApplyTransforms has them.

    Parameters
    ----------
    *paths : str or Path
        ITK and ANTs (`.tfm`, `.txt`, `.mat`, `.h5`; a dense field as NIfTI with the intent
        "vector", LPS), FSL's matrix of flirt, AFNI's `.aff12.1D` (DICOM axes; of images that are
        not oblique) or SPM's deformation (`y_*.nii`). Points of the fixed image pass the first file
        first.
    inverse : bool
        Return the inverse of the whole: from the moving to the fixed image.
    fixed, moving : Image, optional
        The two images, whole, for FSL's matrix, which is of their voxels.

    Returns
    -------
    callable
        A map of points (K, 3), RAS+ mm; it raises InputError for points that a dense field does not
        cover.

    Raises
    ------
    InputError
        A file is missing, damaged, of another kind, or singular; h5py is not installed; an image
        is missing for FSL's matrix.

    See Also
    --------
    Mesh.moved : Move a mesh by it.

    Examples
    --------
    >>> move = tetopt.load_transform("1Warp.nii.gz", "0GenericAffine.mat")  # doctest: +SKIP
    >>> moved = mesh.moved(move)  # doctest: +SKIP
    """
    steps: list[Any] = []
    names: list[str] = []
    for path in map(Path, paths):
        regular_file(path, "transform")
        with prefix_errors(path):
            made = _steps_of(path, fixed, moving)
        steps += made
        names += [str(path)] * len(made)
    if not inverse:
        return Chain(steps, names)
    return Chain([step.inverse() for step in reversed(steps)], names[::-1])


def _steps_of(path: Path, fixed: Image | None, moving: Image | None) -> list[Any]:
    name = path.name.lower()
    if name.endswith(NIFTI_SUFFIXES):
        return [_dense_of(path)]
    if name.endswith(HDF5_SUFFIXES) and importlib.util.find_spec("h5py") is None:
        raise InputError(f"transforms in HDF5 need h5py; {install_hint('h5py')}")
    items = read_apart(_read_items, path, library="h5py or SciPy")
    if items and not items[0][0]:
        return [_matrix_of(items[0][1], fixed, moving)]
    if is_composite := bool(items) and items[0][0].startswith("CompositeTransform"):
        items = items[1:]
    if not items or (len(items) > 1 and not is_composite):
        raise InputError(f"expected one transform or a composite one, got {len(items)}")
    # ITK's composite applies the transform that was added last to points first
    return [_itk_step(*item) for item in reversed(items)]


def _read_items(path: str) -> list[tuple[str, NDArray, NDArray]]:
    """Return the kind, parameters and fixed parameters of each of ITK's transforms, or the numbers
    of a plain matrix, of no kind; runs in a child.
    """
    if path.lower().endswith(HDF5_SUFFIXES):
        return _read_hdf5(path)
    raw = Path(path).read_bytes()
    if path.lower().endswith(MATLAB_SUFFIX) and b"\0" in raw:
        table = {name: each for name, each in scipy.io.loadmat(path).items() if name[0] != "_"}
        centre = np.asarray(table.pop("fixed", []), dtype=np.float64).ravel()
        return [(kind, np.ravel(each), centre) for kind, each in table.items()]
    text = raw.decode()
    if not text.startswith(TEXT_HEAD):
        lines = [line for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
        return [("", np.array(" ".join(lines).split(), dtype=np.float64), np.empty(0))]
    rows = [line.partition(":") for line in text.splitlines() if line[:1] != "#" and line.strip()]
    kinds = [value.strip() for key, _, value in rows if key == "Transform"]
    values = {
        name: [np.array(value.split(), dtype=np.float64) for key, _, value in rows if key == name]
        for name in ("Parameters", "FixedParameters")
    }
    return list(zip(kinds, *values.values(), strict=True))


def _read_hdf5(path: str) -> list[tuple[str, NDArray, NDArray]]:
    import h5py

    with h5py.File(path) as file:
        of = file["TransformGroup"]
        groups = [of[number] for number in sorted(of, key=int)]
        return [
            (
                group["TransformType"][0].decode(),
                *(
                    # older versions of ITK misspelt the names
                    np.asarray(group.get(f"Transform{what}", group.get(f"Tranform{what}", [])))
                    for what in ("Parameters", "FixedParameters")
                ),
            )
            for group in groups
        ]


def _itk_step(kind: str, values: NDArray, fixed: NDArray) -> Linear | Dense:
    """Return a transform of ITK's, in LPS, as one in RAS+."""
    name, _, axes = kind.partition("_")
    values, fixed = np.asarray(values, dtype=np.float64), np.asarray(fixed, dtype=np.float64)
    if not axes.endswith("3_3"):
        raise InputError(f"expected a transform in 3-D, got {kind}")
    _check_counts(name, values, fixed)
    if name == FIELD_KIND:
        shape, origin = fixed[:3].astype(np.int64), fixed[3:6]
        affine = np.eye(4)
        affine[:3, :3] = fixed[9:18].reshape(3, 3) * fixed[6:9]
        affine[:3, 3] = origin
        shifts = values.reshape(*shape[::-1], 3).transpose(2, 1, 0, 3)
        return Dense(shifts * HALF_TURN, _check_linear(LPS_AXES @ affine).matrix)
    if name in ("AffineTransform", "MatrixOffsetTransformBase"):
        turn, shift = values[:9].reshape(3, 3), values[9:12]
    elif name == "Euler3DTransform":
        x, y, z = values[:3]
        is_zyx = len(fixed) > 3 and fixed[3] != 0.0
        order, angles = ("ZYX", [z, y, x]) if is_zyx else ("ZXY", [z, x, y])
        turn, shift = (
            scipy.spatial.transform.Rotation.from_euler(order, angles).as_matrix(),
            values[3:6],
        )
    elif name in ("VersorRigid3DTransform", "Similarity3DTransform"):
        if not (square := (values[:3] ** 2).sum()) <= 1.0 + TEXT_ROUNDING:
            raise InputError(
                f"{name}: expected a versor of norm up to 1, got {np.sqrt(square):.4g}; write the "
                "transform again"
            )
        w = np.sqrt(max(1.0 - square, 0.0))
        size = values[6] if name == "Similarity3DTransform" else 1.0
        turn, shift = (
            size * scipy.spatial.transform.Rotation.from_quat([*values[:3], w]).as_matrix(),
            values[3:6],
        )
    else:
        turn, shift, fixed = np.eye(3), values, np.zeros(3)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    matrix[:3, 3] = shift + fixed[:3] - transform_vectors(fixed[:3], turn)
    return _check_linear(LPS_AXES @ matrix @ LPS_AXES)


def _check_counts(name: str, values: NDArray, fixed: NDArray) -> None:
    """Refuse a kind that is not in `ITK_COUNTS`, or has other numbers of parameters."""
    if name not in ITK_COUNTS:
        raise InputError(
            f"{name}: no such transform is read; write it as a dense field (antsApplyTransforms "
            "-o [field.nii.gz,1], or 3D Slicer's Convert)"
        )
    count, fixed_counts = ITK_COUNTS[name]
    is_good, each = len(fixed) in fixed_counts, ""
    if name == FIELD_KIND:
        size, each = fixed[:3], " per voxel"
        is_good &= bool(((size >= 1.0) & (size == np.rint(size))).all())
        is_good &= count * size.prod() == len(values)
    else:
        is_good &= count == len(values)
    if not is_good:
        raise InputError(
            f"{name}: expected {count} parameters{each} and "
            f"{' or '.join(map(str, fixed_counts))} fixed ones, got {len(values)} and "
            f"{len(fixed)}; write the transform again"
        )


def _matrix_of(numbers: NDArray, fixed: Image | None, moving: Image | None) -> Linear:
    """Return AFNI's 12 numbers or FSL's 16 as a map from the fixed to the moving image."""
    if len(numbers) == 12:
        return _check_linear(LPS_AXES @ np.vstack([numbers.reshape(3, 4), np.eye(4)[3]]) @ LPS_AXES)
    if len(numbers) != 16:
        raise InputError(
            f"expected a transform of ITK, ANTs, FSL (16 numbers), AFNI (12) or SPM, got "
            f"{len(numbers)} numbers"
        )
    if not np.allclose(numbers[12:], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=TEXT_ROUNDING):
        raise InputError(
            f"expected a matrix whose last row is 0 0 0 1, got {numbers[12:].tolist()}; is it "
            "transposed, or no matrix of flirt's?"
        )
    if fixed is None or moving is None or {fixed.ndim, moving.ndim} != {3}:
        raise InputError("FSL's matrix is of two volumes' voxels: pass `fixed` and `image`")
    # of flirt: from the moving to the fixed image
    to_fixed = _world_of_fsl(fixed) @ numbers.reshape(4, 4) @ np.linalg.inv(_world_of_fsl(moving))
    return _check_linear(to_fixed).inverse()


def _world_of_fsl(image: Image) -> Floats:
    """Return the map from FSL's mm, whose x is flipped if the determinant is positive, to RAS+."""
    axes = np.diag([*image.spacing, 1.0])
    if np.linalg.det(image.affine) > 0.0:
        axes[0, 3] = axes[0, 0] * (image.shape[0] - 1)
        axes[0, 0] *= -1.0
    return image.affine @ np.linalg.inv(axes)


def _check_linear(matrix: Floats) -> Linear:
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    size = np.linalg.det(matrix[:3, :3])
    if not (np.isfinite(matrix).all() and abs(size) > LEAST_DETERMINANT * lengths.prod() > 0.0):
        raise InputError("its matrix is singular or has NaN; no map between two images has such")
    return Linear(np.asarray(matrix, dtype=np.float64))


def _dense_of(path: Path) -> Dense:
    """Return the dense field in a NIfTI file: displacements of ITK's, or SPM's deformation."""
    values, affine, intent, name, about = read_apart(_read_nifti, path, library="nibabel")
    if values.ndim != 5 or values.shape[3:] != (1, 3) or min(values.shape) < 1:
        raise InputError(
            f"expected a dense field, (i, j, k, 1, 3) values, got {values.shape}; of fnirt, write "
            "one with convertwarp and ITK's tools"
        )
    if name == NIFTYREG_NAME:
        raise InputError(
            f"expected displacements of ITK's or SPM's deformation, got NiftyReg's ({name}); write "
            "its displacements by reg_transform -disp, negate their x and y, and clear intent_name"
        )
    values = np.asarray(values[..., 0, :], dtype=np.float64)
    index = np.moveaxis(np.indices(values.shape[:3], dtype=np.float64), 0, -1)
    shifts = values - Linear(affine)(index)
    if SPM_WORD in about:
        return Dense(shifts, affine)
    if path.name.startswith(SPM_PREFIXES):
        if _spread(shifts) < _spread(values):
            return Dense(shifts, affine)
        raise InputError(
            "named as SPM's deformation (y_, iy_), whose values are places, but its values vary as "
            "displacements do; give a file of displacements another name"
        )
    if intent not in VECTOR_AXES:
        raise InputError(
            f"its vectors' axes are not stated: expected the intent 1007 of ITK's fields, or SPM's "
            f"y_*.nii, got intent {intent}"
        )
    return Dense(values * VECTOR_AXES[intent], affine)


def _spread(vectors: Floats) -> float:
    """Return the median distance of vectors (..., 3) from their median, without those of NaN."""
    rows = vectors[np.isfinite(vectors).all(axis=-1)]
    return (
        float(np.median(np.linalg.norm(rows - np.median(rows, axis=0), axis=1)))
        if len(rows)
        else 0.0
    )


def _read_nifti(path: str) -> tuple[NDArray, NDArray, int, str, str]:
    """Return values, affine, intent, its name, and the description; runs in a child."""
    image: Any = nibabel.load(path)
    texts = [bytes(image.header[key]).decode("latin-1") for key in ("intent_name", "descrip")]
    name, about = (text.strip("\0 ") for text in texts)
    return np.asanyarray(image.dataobj), image.affine, int(image.header["intent_code"]), name, about
