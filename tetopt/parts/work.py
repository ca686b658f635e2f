"""The work directory of a run in parts, which holds its whole state, so that a rerun resumes where
it ended.

volume.json, voxels.npy       the location of the voxels; for an image in memory, the voxels
themselves initial.npz                   the initial mesh state.npz                     the request,
and the state and the mesh after the last complete round round-R/part-P.npz            the input of
a part of the next round round-R/done-P.npz            its result

Other entries stay, see `tetopt.system.work_directory`.
"""

from __future__ import annotations

import hashlib
import json
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.images import Bounds
from tetopt.io.stored_images import open_stored, stored_checksum
from tetopt.io.text import plain
from tetopt.system.files import save_json, written_whole
from tetopt.system.work_directory import create, discard

VOXELS_NAME, VOLUME_NAME, STATE_NAME, INITIAL_NAME = (
    "voxels.npy",
    "volume.json",
    "state.npz",
    "initial.npz",
)
FILE_NAMES = (VOXELS_NAME, VOLUME_NAME, STATE_NAME, INITIAL_NAME)
PART_NAMES = ("part-*.npz", "done-*.npz")  # in the folder of a round
TEXT_NAME = "text"  # entry of a file of arrays with further information, in JSON


# Errors that zipfile and numpy raise for damaged files. A damaged length may ask for any amount of
# memory.
DAMAGE_ERRORS = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    MemoryError,
    OverflowError,
    RuntimeError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)


class VolumeFile(NamedTuple):
    """The location of the voxels of a run in parts."""

    path: Path
    volume: int | None = None  # one of several volumes, see `tetopt.io.stored_images.open_stored`
    crop: Bounds | None = None  # see there

    def opened(self) -> Image:
        """Open the image; InputError for the reasons of `open_stored`."""
        with warnings.catch_warnings():  # they were issued when the image was first opened
            warnings.simplefilter("ignore")
            return open_stored(self.path, volume=self.volume, crop=self.crop)


def removed(folder: Path) -> list[str]:
    """Remove the work directory; return the names of entries that are not tetopt's, which
    remain.
    """
    for each in folder.glob("round-*"):
        discard(each, PART_NAMES)
    return discard(folder, FILE_NAMES)


@contextmanager
def gone_if_refused(folder: Path) -> Iterator[Callable[[], None]]:
    """Remove a work directory without a state after an InputError, unless the yielded function was
    called before.

    Otherwise the remains of the rejected request would block the corrected one.
    """
    is_kept = (folder / STATE_NAME).exists()

    def keep() -> None:
        nonlocal is_kept
        is_kept = True

    try:
        yield keep
    except InputError:
        if not is_kept:
            removed(folder)
        raise


def identity(file: VolumeFile | None, sha256: str) -> tuple[str, str | None]:
    """Return a checksum that identifies an image, and its path if it is left in its file, which
    is not read here.
    """
    if file is None:
        return sha256, None
    return stored_checksum(file.path), str(file.path.resolve())


def save_volume(folder: Path, volume: VolumeFile | Image) -> None:
    """Record the location of the voxels, or save those of an image in memory to the folder, to
    be mapped from there.
    """
    create(folder)
    if isinstance(volume, Image):
        with (
            written_whole(folder / VOXELS_NAME, volume.data.nbytes) as temporary,
            temporary.open("wb") as stream,
        ):
            np.save(stream, volume.data)
        words: dict[str, Any] = {"path": None, "affine": volume.affine.tolist()}
    else:
        words = {"path": str(volume.path.resolve()), "volume": volume.volume, "crop": volume.crop}
    save_json(folder / VOLUME_NAME, words)


def open_volume(folder: Path) -> Image:
    """Open the image of a work directory; InputError for the reasons of `open_stored`, or if the
    folder is damaged.
    """
    path = folder / VOLUME_NAME
    try:
        words = json.loads(path.read_text("utf-8"))
        if words["path"] is None:
            path = folder / VOXELS_NAME
            return Image.stored(np.load(path, mmap_mode="r"), words["affine"])
        crop = None if words["crop"] is None else [tuple(each) for each in words["crop"]]
        volume = VolumeFile(Path(words["path"]), words["volume"], crop)
    except DAMAGE_ERRORS as error:
        raise _damaged(path, error) from error
    return volume.opened()


def save_arrays(path: Path, arrays: dict[str, NDArray], text: dict[str, Any]) -> None:
    """Write arrays and further information, whole or not at all; each with its checksum
    (CRC-32).
    """
    words = np.frombuffer(json.dumps(text, sort_keys=True).encode(), dtype=np.uint8)
    size = sum(array.nbytes for array in arrays.values())
    with written_whole(path, size) as temporary, temporary.open("wb") as stream:
        # The text last: a damaged length may swallow the following entries, and a missing text is
        # noticed.
        np.savez(stream, **arrays, **{TEXT_NAME: words})  # type: ignore[arg-type]


def load_arrays(path: Path) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Load a file of `save_arrays`; InputError if it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        text = json.loads(arrays.pop(TEXT_NAME).tobytes())
    except DAMAGE_ERRORS as error:
        raise _damaged(path, error) from error
    return arrays, text


def _damaged(path: Path, error: Exception) -> InputError:
    """Return the error for a damaged file that cannot be recreated."""
    words = plain(" ".join(str(error).split()))
    return InputError(
        f"{path}: the file is damaged ({words}); remove {path.parent} and run this again"
    )


def checksum(arrays: dict[str, NDArray], text: dict[str, Any]) -> str:
    """Return the SHA-256 of arrays and further information."""
    digest = hashlib.sha256(json.dumps(text, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


class WorkState(NamedTuple):
    """The state after a complete round."""

    request: str  # checksum of the request
    n_rounds: int  # number of complete rounds; the first one measures the initial mesh
    known: dict[str, Any]  # values by name


def save_state(folder: Path, state: WorkState, mesh: dict[str, NDArray]) -> None:
    """Save a complete round with its mesh; then remove the parts of older ones."""
    save_arrays(folder / STATE_NAME, mesh, state._asdict())
    for old in folder.glob("round-*"):
        if old != round_folder(folder, state.n_rounds):
            discard(old, PART_NAMES)


def load_state(folder: Path, request: str) -> WorkState | None:
    """Return the state after the last complete round of a run with this request; None if there is
    none.

    Raises
    ------
    InputError
        The folder belongs to another request, or the file is damaged.
    """
    path = folder / STATE_NAME
    if not path.exists():
        return None
    state = WorkState(**load_arrays(path)[1])
    if state.request != request:
        raise InputError(
            f"{folder}: work directory of another, unfinished run; resume it with the same "
            "options and "
            "image, or remove it"
        )
    return state


def round_folder(folder: Path, number: int) -> Path:
    """Return the folder of a round's parts, given the number of complete rounds."""
    return folder / f"round-{number}"


def done_path(part: Path) -> Path:
    """Return the path of a part's result, given that of its input."""
    return part.with_name(part.name.replace("part-", "done-"))
