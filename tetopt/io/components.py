"""Reading of vectors, directions and tensors, with all their components at a time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError, warn
from tetopt.fields.field import (
    AXES,
    COLUMNS,
    N_COMPONENTS,
    ROWS,
    Convention,
    Field,
    axes_of,
    frame_words,
    parse_kind,
    world_field,
)
from tetopt.image import Image
from tetopt.io.images import READERS, errors_named, load_image, reader_of
from tetopt.io.volumes import collect_notes
from tetopt.system.arrays import Floats

SYMMETRIC_TO = 1e-4  # relative: of tensors in single precision
SAME_AXES = 1e-3  # components of unit vectors, chosen: headers in text have few digits


def load_field(path: str | Path, kind: str = "scalar") -> Image | Field:
    """Read a field from a NIfTI, MGH, NRRD or MetaImage file, in world axes (RAS+).

    Components are volumes of a 4-D or 5-D file, NRRD's axis of another kind than space, or channels
    of MetaImage. What they mean must be known: NRRD may state axes by its `measurement frame` and
    an order of the six by the kind of their axis, NIfTI an order by its intent (1005); what is not
    stated must be given.

    Parameters
    ----------
    path : str or Path
        The file.
    kind : str
        KIND or KIND@FRAME. KIND is scalar, vector, direction (without sign) or tensor (symmetric; 6
        components, or 9 row by row). FRAME is a program's: fsl (axes of the array, x flipped where
        the affine's determinant is positive; xx xy xz yy yz zz), dipy (RAS+; xx xy yy xz yz zz),
        mrtrix (RAS+; xx yy zz xy xz yz), itk (LPS+; xx xy xz yy yz zz); or the axes voxel, fsl, ras
        or lps, for tensors with an order: ras-upper, ras-lower, ras-diagonal, as the first three
        programs have them.

    Returns
    -------
    Image or Field
        An image for a scalar.

    Raises
    ------
    InputError
        ``"<path>: ..."``: the reasons of `load_image`; another number of components, or axes or an
        order that are not known; no voxel has data.

    See Also
    --------
    cell_field : Its values in the cells of a mesh.

    Examples
    --------
    >>> import nibabel
    >>> file = nibabel.Nifti1Image(np.ones((4, 5, 6, 3), np.float32), np.diag([2.0, 2.0, 3.0, 1.0]))
    >>> nibabel.save(file, "V1.nii.gz")
    >>> tetopt.load_field("V1.nii.gz", "direction@fsl").data[0, 0, 0].tolist()
    [-1.0, 1.0, 1.0]
    """
    path = Path(path)
    word, frame = parse_kind(kind)
    if word == "scalar":
        return load_image(path)
    with errors_named(path), collect_notes() as notes:
        reader = reader_of(path)
        if reader.components is None:
            able = ", ".join(
                suffix for each in READERS if each.components for suffix in each.suffixes
            )
            raise InputError(f"expected one of {able} for a {word}")
        data, affine, of_file = reader.components(path)
        data, of_file = _six(data, of_file) if word == "tensor" else (data, of_file)
        if data.ndim != 4 or data.shape[-1] != N_COMPONENTS[word]:
            n_components = data.shape[-1] if data.ndim == 4 else "a plane's"
            raise InputError(
                f"expected {N_COMPONENTS[word]} components for a {word}, got {n_components}"
            )
        convention = _whole_convention(kind, frame, of_file, affine)
        field = world_field(data, affine, word, convention)
    for words in notes:
        warn(f"{path}: {words}")
    return field


def _six(data: NDArray, of_file: Convention) -> tuple[NDArray, Convention]:
    """Return the six components of tensors row by row; others as they are."""
    if data.shape[-1] != 9:
        return data, of_file
    rows = data.reshape(*data.shape[:-1], 3, 3)
    if not np.allclose(rows, np.swapaxes(rows, -1, -2), rtol=SYMMETRIC_TO, equal_nan=True):
        raise InputError("expected symmetric tensors, got 9 components that are not")
    return rows[..., ROWS, COLUMNS], of_file._replace(order="upper")


def _whole_convention(
    text: str, frame: Convention, of_file: Convention, affine: Floats
) -> Convention:
    """Return what components mean, of the words and the file; raise InputError for what neither
    states, for axes other than the file's, or for a program's order in a file that states another.
    """
    kind = text.partition("@")[0]
    same = [
        name
        for name in AXES
        if of_file.turn is None or np.allclose(axes_of(name, affine), of_file.turn, atol=SAME_AXES)
    ]
    if frame.axes is not None and frame.axes not in same:
        raise InputError(
            f"its header states other axes by its measurement frame than {text}; give {kind} "
            "without axes, or mend the header"
        )
    axes, turn = frame.axes, None if frame.axes else of_file.turn
    order = frame.order or of_file.order
    if axes is None and turn is None:
        raise InputError(
            f"the axes of its components are not stated; give them, as {kind}@FRAME: "
            f"{frame_words(kind)}"
        )
    if kind == "tensor" and order is None:
        raise InputError(
            "the order of its six components is not stated; give it, as "
            f"tensor@{axes or ''.join(same[:1]) or 'AXES'}-ORDER: upper (xx xy xz yy yz zz), "
            "lower (xx xy yy xz yz zz), diagonal (xx yy zz xy xz yz)"
        )
    if of_file.order not in (None, order) and "-" not in text:
        raise InputError(
            f"its header states the order {of_file.order}, but {text} is {order}; give both, as "
            f"tensor@{axes}-{of_file.order}"
        )
    return Convention(axes, order, turn)
