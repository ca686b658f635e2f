"""Read the files that a command names; what is wrong with them is refused or said."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from tetopt.contents.align import is_same_grid, resample_contrast
from tetopt.contents.content import SMOOTH_INTERFACES
from tetopt.contents.labels import check_labels
from tetopt.contents.probabilities import resample_tissue
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.images import file_shape, load_image, parse_crop, parse_slice, part_of, sha256
from tetopt.io.label_tables import LabelTable, load_label_table
from tetopt.io.meshes import load_mesh
from tetopt.job.events import note, warning
from tetopt.job.options import WHOLE_BOX, BoxPart, ImagePart, SourceOptions
from tetopt.measure.fidelity import cell_labels
from tetopt.model.file import MeshFile
from tetopt.model.labels import NO_TABLE, labels_of
from tetopt.model.mappings import named_file
from tetopt.start.label_sizes import EVERY_LABEL, LabelSize, parse_label_sizes
from tetopt.system.files import checked_output
from tetopt.system.incoming import json_of, rows_of

IN_IMAGE_FRACTION = 0.95  # of a mask's or labels' volume: less of it in the image is more than the grids' difference
SIZE_HEADS = ("size", "size_mm", "mm", "edge", "length")  # of the column of sizes in a table
NAMES_LISTED = 8  # a line's worth
AFFINE_MM = 1e-4  # affines that differ by less are the same: files round them to 32 bits


def read_image(path: Path, part: BoxPart = WHOLE_BOX) -> Image:
    """The image as the options ask for it."""
    slice_ = part.slice_ if isinstance(part, ImagePart) else None
    return load_image(
        path,
        volume=part.volume,
        slice_=None if slice_ is None else parse_slice(slice_),
        crop=None if part.crop is None else parse_crop(part.crop),
    )


def read_volume(path: Path, part: BoxPart = WHOLE_BOX) -> Image:
    """A 3-D image; InputError for a picture."""
    image = read_image(path, part)
    if image.ndim != 3:
        raise InputError(f"{path}: expected a volume, got a {image.ndim}-D image")
    return image


def read_labels(path: Path, image: Image, part: BoxPart = WHOLE_BOX) -> Image:
    """A label image, cut as the image was; InputError unless it lies on the image's voxels."""
    labels = read_image(path, replace(part, volume=None))
    if labels.shape != image.shape or not np.allclose(labels.affine, image.affine, atol=AFFINE_MM):
        raise InputError(
            f"{path}: expected labels on the image's own voxels, {image.shape} with its affine, got {labels.shape}; "
            "resample them to the image first"
        )
    check_labels(str(path), labels)
    return labels


def image_and_labels(path: Path, labels_path: Path | None, part: BoxPart) -> tuple[Image, Image | None]:
    """The volume, and labels on its voxels, if they are given."""
    image = read_volume(path, part)
    return image, None if labels_path is None else read_labels(labels_path, image, part)


def image_and_others(
    path: Path, part: ImagePart
) -> tuple[Image, Callable[[Path, Callable[[Image, Image, str], Image]], Image]]:
    """The image as the options ask for it, and a function that reads files beside it and aligns them to its voxels."""
    image = read_image(path, part)
    # A slice has lost its place across it: what goes with it is aligned to the whole image and sliced like that.
    whole = image if part.slice_ is None else read_image(path, ImagePart(volume=part.volume))

    def beside(other: Path, aligned: Callable[[Image, Image, str], Image]) -> Image:
        original = read_companion(other)
        moved = aligned(original, whole, str(other))
        is_cropped = part.slice_ is None and part.crop is not None
        if not is_same_grid(original, whole, is_cropped=is_cropped):
            is_linear = aligned in (resample_contrast, resample_tissue)
            _say_resampled(other, original, moved, is_contrast=is_linear, is_cropped=is_cropped)
        if part.slice_ is None:
            return moved
        return part_of(moved, parse_slice(part.slice_), None if part.crop is None else parse_crop(part.crop))

    return image, beside


def _say_resampled(path: Path, original: Image, moved: Image, *, is_contrast: bool, is_cropped: bool) -> None:
    """That a file lay on another grid, and how much of a mask or of labels is in the image unless that is cropped."""
    if is_contrast:
        note(f"{path}: taken to the image's voxels, linearly")
        return
    whole, inside = (np.count_nonzero(each.data) * each.voxel_volume for each in (original, moved))
    note(f"{path}: taken to the image's voxels, nearest neighbour")
    if not is_cropped and inside < IN_IMAGE_FRACTION * whole:
        warning(f"{path}: only {inside / whole:.0%} of it lies in the image; is it of the same scan?")


def read_companion(path: Path) -> Image:
    """A file beside the image; one value everywhere, which would be odd in an image, is not in sizes or a mask."""
    file, volume = file_and_volume(path)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "(?s).* everywhere, so E_D is 0")
        return load_image(file, volume=volume)


def file_and_volume(path: Path) -> tuple[Path, int | None]:
    """A file beside the first image, and the volume of it that `FILE:K` names."""
    name, colon, volume = str(path).rpartition(":")
    if colon and re.fullmatch("[0-9]{1,18}", volume) and not path.exists():
        return Path(name), int(volume)
    return path, None


def tissue_files(path: Path | None) -> list[Path]:
    """The files of tissues that an option names between commas."""
    return [] if path is None else [Path(name.strip()) for name in str(path).split(",")]


def tissue_volumes(path: Path) -> dict[str, Path]:
    """The files of tissues, or `FILE:K` for each volume of one, by what the tissues are called; InputError."""
    files = tissue_files(path)
    if Path() in files or len(set(files)) < len(files):
        raise InputError(f"`tissues`: expected different files, separated by commas, got {path}")
    shape = file_shape(files[0]) if len(files) == 1 else None
    if shape is not None and len(shape) > 3 and shape[3] > 1 and file_and_volume(files[0])[1] is None:
        return {f"tissue {k + 1}": Path(f"{path}:{k}") for k in range(shape[3])}
    names = [file_and_volume(file)[0].name.split(".")[0] for file in files]
    numbered = [name if names.count(name) == 1 else f"{name} {k}" for k, name in enumerate(names, 1)]
    return dict(zip(numbered, files, strict=True))


def number_of(name: str, text: str) -> float:
    """The number that an option's text is; InputError, with the option's name, if it is none."""
    try:
        return float(text)
    except ValueError:
        raise InputError(f'{name}: expected a number, got "{text}"') from None


class Balance(NamedTuple):
    """How much images and labels count beside one another, and how tense surfaces between labels are."""

    weights: list[float]
    label_weight: float = 1.0
    smooth_interfaces: float = SMOOTH_INTERFACES


def balance_of(options: SourceOptions) -> Balance:
    """The balance that is asked for, with its defaults."""
    weights = [1.0] * len(options.images)
    if options.weights is not None:
        weights = [number_of("`weights`", part) for part in options.weights.split(",")]
    names = ("label_weight", "smooth_interfaces")
    return Balance(weights, **{name: each for name in names if (each := getattr(options, name)) is not None})


def read_mesh(path: Path) -> MeshFile:
    """A mesh of the user's; what had to be turned, left out or renamed is said."""
    loaded = load_mesh(path)
    if loaded.n_turned:
        warning(f"{path}: {loaded.n_turned} cells were inverted in the file and have been turned")
    if loaded.n_left:
        note(f"{path}: {loaded.n_left} cells of lower dimension are left out")
    for line in loaded.notes:
        note(f"{path}: {line}")
    return loaded


def with_labels(loaded: MeshFile, path: Path | None) -> MeshFile:
    """The mesh with the labels of an image on its cells, those of most of their voxels, instead of its file's own."""
    if path is None:
        return loaded
    labels = read_companion(path)
    check_labels(str(path), labels)
    if labels.ndim != loaded.mesh.ndim:
        raise InputError(f"{path}: expected {loaded.mesh.ndim}-D labels, as the mesh is, got a {labels.ndim}-D image")
    try:
        return loaded._replace(cell_data={**loaded.cell_data, "label": cell_labels(labels, loaded.mesh)})
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def label_table(path: Path | None, loaded: MeshFile | None = None) -> LabelTable:
    """Names and colours of labels: those of the file, else those that the mesh's file keeps, else none."""
    if path is not None:
        table = load_label_table(path)
        labels = None if loaded is None else labels_of(loaded.cell_data, len(loaded.mesh.cells))
        if labels is not None and not np.isin(labels, [*table.names, *table.colours]).any():
            warning(f"{path}: names none of the mesh's labels, {listed(np.unique(labels).tolist())}")
        return table
    return NO_TABLE if loaded is None else loaded.label_table


def label_sizes_of(text: str, table: LabelTable | None = None) -> dict[int | str, LabelSize]:
    """Sizes by label, as an option or a file has them; names become numbers by a table of labels, if there is one."""
    file = named_file(text)
    if file is not None:
        text = ",".join(f"{name}={''.join(cells[:1])}" for name, cells in rows_of(file, "table of sizes", SIZE_HEADS))
    try:
        sizes = parse_label_sizes(text)
        return sizes if table is None else _by_number(sizes, table)
    except InputError as error:
        raise error if file is None else InputError(f"{file}: {error}") from error


def _by_number(sizes: dict[int | str, LabelSize], table: LabelTable) -> dict[int | str, LabelSize]:
    """The sizes with labels' numbers for their names."""
    numbers = {name: label for label, name in table.names.items()}
    known = {name: size for name, size in sizes.items() if isinstance(name, int) or name in (*numbers, EVERY_LABEL)}
    if unknown := [name for name in sizes if name not in known]:
        raise InputError(
            f'label_size: no label is called "{unknown[0]}"; {listed([*numbers]) or "the labels have no names"}'
        )
    by_label: dict[int | str, LabelSize] = {}
    for name, size in known.items():
        label = numbers.get(str(name), name)
        if label in by_label:
            raise InputError(f"label_size: label {label} has two sizes")
        by_label[label] = size
    return by_label


def listed(names: Sequence[object], most: int = NAMES_LISTED) -> str:
    """The first of some names in words, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(map(str, names[:most])) + more


def table_in(loaded: MeshFile, name: str) -> dict[str, Any]:
    """A table among the texts of a mesh's file; empty without one, or if it is another program's."""
    try:
        table = json_of(loaded.text(name) or "{}")
    except ValueError:
        return {}
    return table if isinstance(table, dict) else {}


def warn_of_other_image(loaded: MeshFile, mesh_path: Path, image_path: Path) -> bool:
    """A warning if the mesh's file names another image than this one as its source; whether it does."""
    made_from = loaded.text("image_sha256")
    is_other = made_from is not None and made_from != sha256(image_path)
    if is_other:
        warning(f"{mesh_path} was made from another image than {image_path}")
    return is_other


def checked_outputs(folder: Path, names: Iterable[str], force: bool) -> dict[str, Path]:
    """Files in a folder by their names; InputError as `checked_output`."""
    return {name: checked_output(folder / name, (Path(name).suffix,), force) for name in names}


def set_threads(threads: int | None) -> None:
    """Compute on so many threads, or as before; InputError for more than there are."""
    if threads is None:
        return
    most = int(numba.config.NUMBA_NUM_THREADS)
    if not 1 <= threads <= most:
        raise InputError(f"`threads`: expected 1 to {most} on this machine, got {threads}")
    numba.set_num_threads(threads)


def cell_field(loaded: MeshFile, path: Path, name: str) -> NDArray:
    """A field of a mesh's file, one number a cell; InputError, with those that there are, if it is not there."""
    known = [each for each, values in loaded.cell_data.items() if values.ndim == 1]
    if name not in known:
        raise InputError(f'{path}: has no "{name}" on its cells; it has {", ".join(known) or "nothing"}')
    return loaded.cell_data[name]
