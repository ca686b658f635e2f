"""Outputs that appear whole or not at all, and never replace other files by accident.

tetopt writes all its files by `written_whole`: under a temporary name in the same folder,
synchronised to disk, and then renamed in one step.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from tetopt.errors import InputError

COMPARED_BYTES = 2**24  # compared at a time, which limits additional memory
# letters of an output's name in its temporary name: the name may have the maximum length
TEMPORARY_LETTERS = 40
NUMBERED_LETTERS = 200  # the same in the name of an output whose own is taken
# Errors of folders that cannot be synchronised at all, as on some network file systems.
UNSYNCHRONISED = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS, errno.EACCES, errno.EPERM, errno.EBADF)


class Outputs(NamedTuple):
    """The outputs of one command."""

    named: list[Path]  # all files and folders that its options name, including inputs
    places: dict[Path, Path]  # for each checked output, its real place with links followed
    new: set[Path]  # outputs that had no file: one that appears in their place stays
    moved: dict[Path, Path]  # where these are then
    written: list[Path]  # checked outputs that have been written
    made: list[Path]  # folders created for the outputs


_OUTPUTS: ContextVar[Outputs | None] = ContextVar("outputs", default=None)


@contextmanager
def outputs_of_command() -> Iterator[Outputs]:
    """Treat the outputs checked by `check_output` within a block as those of one command.

    An output must not be one of the inputs, nor the same as another output. Folders made by
    `results_folder` that are empty at the end are removed.
    """
    outputs = Outputs([], {}, set(), {}, [], [])
    token = _OUTPUTS.set(outputs)
    try:
        yield outputs
    finally:
        _OUTPUTS.reset(token)
        for folder in reversed(outputs.made):
            # it is not empty, has been replaced, or has an invalid name
            with suppress(OSError, ValueError):
                folder.rmdir()


def output_place(path: Path) -> Path:
    """Return where an output is: elsewhere if a file has appeared in its place during the run."""
    outputs = _OUTPUTS.get()
    return path if outputs is None else outputs.moved.get(_absolute(path), path)


def check_places(outputs: Outputs) -> None:
    """Raise InputError if files have appeared in places of checked outputs, which are beside
    them.
    """
    moved = {path: place for path, place in outputs.moved.items() if path in outputs.places}
    if moved:
        raise InputError(
            "; ".join(
                f"{place}: written here, as another file appeared as {path.name} during the run "
                "and stays"
                for path, place in moved.items()
            )
        )


def present_outputs() -> Outputs | None:
    """Return the outputs of the command that runs; None outside of one."""
    return _OUTPUTS.get()


@contextmanager
def outputs_of_run(values: Iterable[Any]) -> Iterator[None]:
    """Do the same as `outputs_of_command` for a run with these options outside a command."""
    if _OUTPUTS.get() is not None:
        yield
        return
    with outputs_of_command() as outputs:
        name_files(values)
        yield
        check_places(outputs)


def name_files(values: Iterable[Any]) -> None:
    """Record the paths among the values of a command's options; no output may be named twice."""
    if (outputs := _OUTPUTS.get()) is not None:
        flat = (
            each for value in values for each in (value if isinstance(value, list) else [value])
        )
        outputs.named.extend(each for each in flat if isinstance(each, Path))


def results_folder(path: Path) -> Path:
    """Return `path`, created with its parents if missing; InputError for a file, or if it cannot be
    created.

    A command that is rejected afterwards leaves no empty folder.
    """
    if os.path.lexists(path) and not path.is_dir():
        raise InputError(f"{path}: expected a folder for the results, found a file")
    new = [each for each in (path, *path.parents) if not os.path.lexists(each)][::-1]
    if (outputs := _OUTPUTS.get()) is not None:
        outputs.made.extend(new)
    try:
        path.mkdir(parents=True, exist_ok=True)
    # a name too long, or with letters that the file system does not allow
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot create the folder for the results: {reason}") from error
    return path


def check_output(
    path: str | Path,
    suffixes: tuple[str, ...],
    force: bool = False,
    is_ours: Callable[[Path], bool] | None = None,
) -> Path:
    """Return `path` if an output may be written there; checks by creating and removing a file in
    its folder.

    Call it before the work starts. With `force` and a symbolic link, the file that the link points
    to is written and the link stays. `is_ours` is for outputs that are folders: it says whether an
    existing folder may be replaced.

    Raises
    ------
    InputError
        The suffix is not among `suffixes` (in any case); the folder is missing or read-only; a
        folder or device is in the place of the file; the file exists and `force` is not set; the
        command uses it as an input or output too.
    """
    path = check_suffix(path, suffixes)
    if os.path.isdir(path) and (is_ours is None or not is_ours(path)):
        raise InputError(
            f"{path}: expected a file to write, found "
            f"a{'' if is_ours is None else 'n unrelated'} folder"
        )
    try:
        place = Path(os.path.realpath(path))
        before = _state(place)
    # a name too long, or with letters that the file system does not allow
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}"
        ) from error
    through = f"is a link to {place}: " if path.is_symlink() else ""
    _check_parent(path, place, through)
    if before is not None and is_ours is not None and not stat.S_ISDIR(before.st_mode):
        raise InputError(
            f"{path}: {through}expected a folder to write, found something else; remove it first"
        )
    if before is not None and is_ours is None and not stat.S_ISREG(before.st_mode):
        raise InputError(
            f"{path}: {through}expected a file to write, found a device, a pipe or a circular link"
        )
    if os.path.lexists(path) and not force:
        raise InputError(f"{path}: already exists; pass `force` to replace it")
    _check_once(path, place)
    _check_folder(path, place.parent)
    if (outputs := _OUTPUTS.get()) is not None:
        outputs.places[_absolute(path)] = place
        if before is None:
            outputs.new.add(_absolute(path))
    return path


def _check_parent(path: Path, place: Path, through: str = "") -> None:
    if not place.parent.is_dir():
        raise InputError(f"{path}: {through}its folder does not exist; create it first")


def check_suffix(path: str | Path, suffixes: tuple[str, ...]) -> Path:
    """Return the path; InputError unless its name ends in one of the suffixes, in any case."""
    path = Path(path)
    if not path.name.lower().endswith(suffixes):
        raise InputError(f"{path}: expected a name ending in {' or '.join(suffixes)}")
    return path


def _check_once(path: Path, place: Path) -> None:
    """Raise InputError if the command names the file a second time, as an input or as another
    output.
    """
    if (outputs := _OUTPUTS.get()) is None:
        return
    others = list(outputs.named)
    if path in others:
        others.remove(path)  # the option that names the output itself
    if any(os.path.realpath(other) == str(place) for other in others) or (
        place.exists() and any(other.exists() and place.samefile(other) for other in others)
    ):
        raise InputError(
            f"{path}: is also an input or another output of this command; choose another name"
        )


def _check_folder(path: Path, folder: Path) -> None:
    """Raise InputError unless a file can be created in the folder: permissions alone do not
    tell.
    """
    try:
        handle, name = tempfile.mkstemp(prefix=".tetopt-", dir=folder)
        os.close(handle)
        os.unlink(name)
    except OSError as error:
        raise InputError(f"{path}: its folder is not writable: {error.strerror}") from error


def check_space(path: Path, n_bytes: int) -> None:
    """Raise InputError if the disk of `path` has fewer than `n_bytes` bytes free, as far as it
    reports them.
    """
    free = shutil.disk_usage(os.path.realpath(path.parent)).free
    if free < n_bytes:
        raise InputError(
            f"{path}: needs at least {n_bytes} bytes, but only {free} are free; free some space "
            "first"
        )


@contextmanager
def written_whole(path: Path, n_bytes: int | None = None) -> Iterator[Path]:
    """Give a temporary path next to `path`, with its suffix, that replaces `path` when the block
    ends without error.

    A file that has appeared since a command checked the output stays: this one is put beside it, as
    `output_place` tells, and `check_places` raises an error at the command's end.

    After an error or an interruption, the previous file is unchanged. After a kill or a power cut,
    the old or the new file is whole, and a temporary file, whose name begins with a dot, may
    remain. The new file keeps the permissions and, where allowed, the group of the file that it
    replaces; otherwise it gets the default permissions.

    Raises
    ------
    OSError
        Any failure, with the path and, on a full disk, the number of bytes (`n_bytes`) if known.
    """
    # Not `path.suffixes`, which skips leading dots: for "..nii.gz" it has only .gz.
    suffix = "".join(f".{part}" for part in path.name.split(".")[1:][-2:])[-20:]
    with _output(path, n_bytes) as place:
        handle, name = tempfile.mkstemp(
            prefix=_hidden_prefix(path), suffix=suffix, dir=place.parent
        )
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            _on_disk(temporary, place)
            if not _is_new(path):
                os.replace(temporary, place)
            else:
                _name_new(path, temporary, place, suffix, _link_file)
            _synchronise_folder(place.parent)
        finally:
            with suppress(OSError):  # then a hidden file remains, and the first error is reported
                os.unlink(temporary)


@contextmanager
def _output(path: Path, n_bytes: int | None = None) -> Iterator[Path]:
    """Give an output's real place; record it as written after the block.

    System errors within the block are reported as errors of writing `path`.
    """
    outputs = _OUTPUTS.get()
    key = _absolute(path)
    place = Path(os.path.realpath(path))
    if outputs is not None:
        place = outputs.moved.get(key) or outputs.places.get(key, place)
    _check_parent(path, place)
    with telling(path, n_bytes, place.parent):
        yield place
    path = output_place(path)
    if outputs is not None and key in outputs.places and path not in outputs.written:
        # once: a mesh is written first, and again with its measurements
        outputs.written.append(path)


def _is_new(path: Path) -> bool:
    outputs = _OUTPUTS.get()
    return outputs is not None and _absolute(path) in outputs.new


def _name_new(
    path: Path,
    temporary: Path,
    place: Path,
    suffix: str,
    give_name: Callable[[Path, Path], None],
) -> None:
    """Give an output that had no file its name or, if another file has it by now, the next free
    one.
    """
    stem = place.name.removesuffix(suffix)[:NUMBERED_LETTERS]
    others = (place.with_name(f"{stem}_{number}{suffix}") for number in count(1))
    for each in chain([place], others):
        with suppress(FileExistsError):
            give_name(temporary, each)
            break
    outputs = cast(Outputs, _OUTPUTS.get())
    outputs.new.discard(_absolute(path))
    if each != place:
        outputs.moved[_absolute(path)] = path.with_name(each.name)


def _link_file(temporary: Path, place: Path) -> None:
    """Give a file its name; raise FileExistsError if another has it."""
    try:
        os.link(temporary, place)
    except FileExistsError:
        # network file systems may answer so after a link that succeeded
        if os.stat(temporary).st_nlink == 1:
            raise
    except OSError:  # a file system without hard links: an empty file keeps the name
        os.close(os.open(place, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        try:
            os.replace(temporary, place)
        except BaseException:
            os.unlink(place)
            raise


def _rename_folder(temporary: Path, place: Path) -> None:
    """Give a folder its name; raise FileExistsError if another file or folder with files has it."""
    try:
        os.rename(temporary, place)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.ENOTDIR):
            raise FileExistsError(error.errno, error.strerror) from error
        raise


def _hidden_prefix(path: Path) -> str:
    """Return the prefix of an output's temporary files and folders."""
    return f".{path.name[:TEMPORARY_LETTERS]}."


def _temporary_folder(stack: ExitStack, path: Path, folder: Path, suffix: str = "") -> Path:
    """Create a folder next to an output until the stack is unwound; files that cannot be removed
    remain, hidden.
    """
    temporary = Path(tempfile.mkdtemp(prefix=_hidden_prefix(path), suffix=suffix, dir=folder))
    stack.callback(shutil.rmtree, temporary, ignore_errors=True)
    return temporary


@contextmanager
def folder_written_whole(path: Path) -> Iterator[Path]:
    """Do the same as `written_whole` for a folder: give a temporary folder, which replaces `path`
    at the end.

    An existing folder is first moved aside. Between the two moves, also if the process is killed
    then, no folder has the name.

    Raises
    ------
    OSError
        As `written_whole`.
    """
    with ExitStack() as stack, _output(path) as place:
        temporary = _temporary_folder(stack, path, place.parent, path.suffix[-20:])
        yield temporary
        for folder, _, names in os.walk(temporary):
            for name in names:
                _on_disk(Path(folder) / name)
        _take_rights(temporary, place)
        if _is_new(path):
            _name_new(path, temporary, place, path.suffix, _rename_folder)
            return
        old = None
        if place.is_dir():
            old = _temporary_folder(stack, path, place.parent) / "old"
            os.rename(place, old)
        try:
            os.rename(temporary, place)
        except OSError:
            if old is not None and not os.path.lexists(place):
                os.rename(old, place)
            raise
        _synchronise_folder(place.parent)


@contextmanager
def telling(path: Path, n_bytes: int | None = None, folder: Path | None = None) -> Iterator[None]:
    """Report system errors as errors of writing `path`; on a full disk with the number of bytes, if
    known.

    `folder` is the real folder of the file, by default that of `path`.
    """
    try:
        yield
    except OSError as error:
        reason = _reason(error, folder or path.parent, n_bytes)
        raise OSError(error.errno or errno.EIO, reason, str(path)) from error


def save_bytes(path: str | Path, whole: bytes) -> None:
    """Write a file, whole or not at all, and compare it with what reads back before it takes its
    name.

    Raises
    ------
    OSError
        For the reasons of `written_whole`; the file reads back differently.
    """
    with written_whole(Path(path), len(whole)) as temporary:
        temporary.write_bytes(whole)
        with temporary.open("rb") as file:
            starts = range(0, len(whole) + 1, COMPARED_BYTES)
            is_same = all(
                file.read(COMPARED_BYTES) == whole[at : at + COMPARED_BYTES] for at in starts
            )
        if not is_same:
            raise OSError(
                errno.EIO, "the file reads back differently from what was written; check the disk"
            )


def save_text(path: str | Path, text: str) -> None:
    """Write text as UTF-8, whole or not at all; invalid characters, from names that are not
    UTF-8, are escaped.
    """
    save_bytes(path, text.encode("utf-8", "backslashreplace"))


def save_json(path: Path, value: Any) -> None:
    """Write `value` as JSON, whole or not at all; may contain numpy numbers and arrays,
    NamedTuples and paths.
    """
    save_text(path, json.dumps(as_json(value), indent=1, allow_nan=False) + "\n")


def kept_places(path: Path) -> Iterator[Path]:
    """Yield free names of VTU files for a mesh that cannot be written to `path`: next to it, then
    in new temporary folders.
    """
    names = chain([path.stem], (f"{path.stem}_optimised_{number}" for number in count(1)))
    places = (path.with_name(f"{name}.vtu") for name in names)
    beside = next(place for place in places if place != path and not os.path.lexists(place))
    if (outputs := _OUTPUTS.get()) is not None:
        outputs.new.add(_absolute(beside))
    yield beside
    for folder in (tempfile.gettempdir(), os.getcwd(), os.path.expanduser("~")):
        with suppress(OSError):  # the next one
            yield Path(tempfile.mkdtemp(prefix="tetopt-", dir=folder)) / f"{path.stem}.vtu"


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


def _state(place: Path) -> os.stat_result | None:
    """Return the status of a place, None if nothing is there."""
    try:
        return os.lstat(place)
    except (FileNotFoundError, NotADirectoryError):
        return None


def _take_rights(temporary: Path, place: Path) -> None:
    """Give the new file the permissions and group of the file that it replaces, or those that
    the umask leaves.
    """
    before = _state(place)
    if before is None:
        mask = os.umask(0)
        os.umask(mask)
        # mkstemp's 0600 would keep colleagues out, and mkdtemp's 0700
        os.chmod(temporary, (0o777 if temporary.is_dir() else 0o666) & ~mask)
        return
    mode = stat.S_IMODE(before.st_mode) & 0o777
    if hasattr(os, "chown") and os.stat(temporary).st_gid != before.st_gid:
        try:
            os.chown(temporary, -1, before.st_gid)
        # not one of our groups: the present group gets the permissions of all others
        except OSError:
            mode = (mode & ~0o070) | (mode & 0o007) << 3
    os.chmod(temporary, mode)


def _on_disk(path: Path, place: Path | None = None) -> None:
    """Synchronise a file to disk, with the permissions of the file in its `place`.

    Without this, a power cut after the renaming would leave an empty file. The file is opened
    before its permissions change, as they may not allow writing.
    """
    handle = os.open(path, os.O_RDWR)
    try:
        if place is not None:
            _take_rights(path, place)
        os.fsync(handle)
    finally:
        os.close(handle)


def _synchronise_folder(folder: Path) -> None:
    """Synchronise the renaming to disk, where folders can be synchronised."""
    if os.name == "nt":
        return
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        if error.errno not in UNSYNCHRONISED:
            raise


def _reason(error: OSError, folder: Path, n_bytes: int | None) -> str:
    """Return why a file cannot be written; on a full disk with the bytes that it needs."""
    reason = f"cannot be written: {error.strerror or error}"
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) and n_bytes is not None:
        reason += f"; it needs {n_bytes} bytes"
        with suppress(OSError):
            reason += f", {shutil.disk_usage(folder).free} are free"
    return reason


def as_json(value: Any) -> Any:
    """Convert `value` to JSON's own types, records by their method `as_json` or by their fields;
    numbers that are not finite become null, as JSON cannot express them.
    """
    if hasattr(value, "as_json"):
        value = value.as_json()
    if hasattr(value, "_asdict"):
        return {key: as_json(item) for key, item in value._asdict().items()}
    if isinstance(value, dict):
        return {as_json(str(key)): as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    if isinstance(value, np.ndarray):
        return as_json(value.tolist())
    if isinstance(value, np.generic):
        return as_json(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, str | Path):
        # lone surrogates from names: no valid JSON
        return str(value).encode("utf-8", "backslashreplace").decode()
    return value


def check_outputs(folder: Path, names: Iterable[str], force: bool) -> dict[str, Path]:
    """Return files in a folder by name; raise InputError as `check_output`."""
    return {name: check_output(folder / name, (Path(name).suffix,), force) for name in names}
