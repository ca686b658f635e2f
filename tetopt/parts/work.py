"""The work directory of a run in parts: all that there is of it, so that a rerun goes on where another one ended.

volume.json, voxels.npy       where the voxels are: of an image that is in memory, in the folder itself
state.json                    what was asked, and what is known after the last complete round
mesh-R.npz                    the mesh after round R; of the rounds only the last
round-R/part-P.npz            what a part of the next round is to be made of
round-R/done-P.npz            and what came of it
logs/                         what dask and a batch system's jobs say

`tetopt.system.work_directory` says what else may not lie there.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.images import Bounds
from tetopt.io.stored_images import open_stored, stored_checksum
from tetopt.io.text import plain
from tetopt.system import work_directory
from tetopt.system.files import save_json, written_whole
from tetopt.system.incoming import json_of, own_bytes
from tetopt.system.work_directory import LOCK_NAME, Layout, create, discard

VOXELS_NAME, VOLUME_NAME, STATE_NAME, INITIAL_NAME = "voxels.npy", "volume.json", "state.json", "initial.npz"
LOGS_NAME = "logs"
LAYOUT = Layout(
    "a mesh in parts",
    rf"{LOCK_NAME}|voxels\.npy|(volume|state)\.json|(initial|mesh-\d+)\.npz|seen-\d+",
    {r"round-\d+": r"(part|done)-\d+\.npz", LOGS_NAME: ".+", "dask": None},
)
TEXT_NAME = "text"  # of the entry of a file of arrays that has what else is to be known, in JSON


# What zipfile and numpy say of files with other bytes than were written. A number of a length may stand for any memory.
DAMAGE_ERRORS = (
    OSError, EOFError, ValueError, KeyError, TypeError, MemoryError, OverflowError, RuntimeError, struct.error,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip


class VolumeFile(NamedTuple):
    """Where the voxels of a run in parts are."""

    path: Path
    volume: int | None = None  # which of several, as of `tetopt.io.stored_images.open_stored`
    crop: Bounds | None = None  # likewise

    def opened(self) -> Image:
        """The image; InputError as `open_stored`."""
        with warnings.catch_warnings():  # which were said when the image was first opened
            warnings.simplefilter("ignore")
            return open_stored(self.path, volume=self.volume, crop=self.crop)


def locked(folder: Path) -> AbstractContextManager[None]:
    """The work directory, for one run alone; see `tetopt.system.work_directory.locked`."""
    return work_directory.locked(folder, LAYOUT, folder)


def removed(folder: Path) -> list[str]:
    """Remove the work directory; the names of what stays, which is not tetopt's."""
    return discard(folder, LAYOUT)


@contextmanager
def gone_if_refused(folder: Path) -> Iterator[Callable[[], None]]:
    """A work directory without a state goes again with an InputError, unless what is yielded has been called by then.

    Otherwise what was refused would stand in the way of the request that is mended.
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
    """What shows that an image is the same one, and where it is if it is left in its file, which is not read here."""
    if file is None:
        return sha256, None
    return stored_checksum(file.path), str(file.path.resolve())


def save_volume(folder: Path, volume: VolumeFile | Image) -> None:
    """Note where the voxels are, or leave those of an image in memory in the folder, from where they are mapped."""
    create(folder, LAYOUT)
    if isinstance(volume, Image):
        with written_whole(folder / VOXELS_NAME, volume.data.nbytes) as temporary, temporary.open("wb") as stream:
            np.save(stream, volume.data)
        words: dict[str, Any] = {"path": None, "affine": volume.affine.tolist()}
    else:
        words = {"path": str(volume.path.resolve()), "volume": volume.volume, "crop": volume.crop}
    save_json(folder / VOLUME_NAME, words)


def open_volume(folder: Path) -> Image:
    """The image whose voxels a work directory is about; InputError as `open_stored`, or the folder is damaged."""
    path = folder / VOLUME_NAME
    try:
        words = json_of(own_bytes(path).decode())
        if words["path"] is None:
            path = folder / VOXELS_NAME
            return Image.stored(np.load(path, mmap_mode="r"), words["affine"])
        crop = None if words["crop"] is None else [tuple(each) for each in words["crop"]]
        volume = VolumeFile(Path(words["path"]), words["volume"], crop)
    except DAMAGE_ERRORS as error:
        raise _damaged(path, error) from error
    return volume.opened()


def save_arrays(path: Path, arrays: dict[str, NDArray], text: dict[str, Any]) -> None:
    """Write arrays and what else is to be known of them, whole or not at all; each with its checksum (CRC-32)."""
    words = np.frombuffer(json.dumps(text, sort_keys=True).encode(), dtype=np.uint8)
    size = sum(array.nbytes for array in arrays.values())
    with written_whole(path, size) as temporary, temporary.open("wb") as stream:
        # The text last: a length that is damaged may swallow what comes behind, and without the text is noticed.
        np.savez(stream, **arrays, **{TEXT_NAME: words})  # type: ignore[arg-type]


def load_arrays(path: Path) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """What `save_arrays` wrote; InputError if the file is damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        text = json.loads(arrays.pop(TEXT_NAME).tobytes())
    except DAMAGE_ERRORS as error:
        raise _damaged(path, error) from error
    return arrays, text


def _damaged(path: Path, error: Exception) -> InputError:
    """What is done without a file: a part is made again, and without the mesh or the state there is no way on."""
    words = plain(" ".join(str(error).split()))
    return InputError(f"{path}: the file is damaged ({words}); remove {path.parent}, and run this again")


def checksum(arrays: dict[str, NDArray], text: dict[str, Any]) -> str:
    """SHA-256 of arrays and what else is to be known of them."""
    digest = hashlib.sha256(json.dumps(text, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


class WorkState(NamedTuple):
    """What is known after a round that is complete."""

    request: str  # checksum of what was asked
    n_rounds: int  # that are complete; the first one measures the initial mesh
    known: dict[str, Any]  # numbers by name


def save_state(folder: Path, state: WorkState, mesh: dict[str, NDArray]) -> None:
    """Note that a round is complete: its mesh first, then the state, by which alone it counts, then the rest goes."""
    save_arrays(mesh_path(folder, state.n_rounds), mesh, {})
    save_json(folder / STATE_NAME, {"state": state._asdict(), "checksum": checksum({}, state._asdict())})
    for old in folder.glob("mesh-*.npz"):
        if old != mesh_path(folder, state.n_rounds):
            old.unlink()
    for old in folder.glob("round-*"):
        if old != round_folder(folder, state.n_rounds):
            shutil.rmtree(old)


def load_state(folder: Path, request: str) -> WorkState | None:
    """What is known after the last complete round of a run of this request; None if there is none.

    Raises
    ------
    InputError
        The folder is that of another request, or the file is damaged.
    """
    path = folder / STATE_NAME
    if not path.exists():
        return None
    try:
        words = json_of(own_bytes(path).decode())
        state = WorkState(**words["state"])
        if words["checksum"] != checksum({}, state._asdict()):
            raise ValueError("its checksum is another one")
    except DAMAGE_ERRORS as error:
        raise _damaged(path, error) from error
    if state.request != request:
        raise InputError(
            f"{folder}: work directory of another run that has not finished; continue it with the same options and "
            "image, or remove it"
        )
    return state


def mesh_path(folder: Path, number: int) -> Path:
    """Where the mesh after so many rounds is."""
    return folder / f"mesh-{number}.npz"


def round_folder(folder: Path, number: int) -> Path:
    """Where the parts of a round are, by how many rounds are complete."""
    return folder / f"round-{number}"


def done_path(part: Path) -> Path:
    """Where what comes of a part is, by where it is itself."""
    return part.with_name(part.name.replace("part-", "done-"))
