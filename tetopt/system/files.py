"""Outputs that appear whole or not at all, and never over something else by accident.

All files that tetopt leaves come to be in `written_whole`: on a temporary name beside their own, synchronised to the
disk, and from there in one step to their name.
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
from typing import Any, NamedTuple

import numpy as np

from tetopt.errors import InputError

TEMPORARY_LETTERS = 40  # of an output's name that its temporary one begins with: names may be as long as they can be
# What a folder answers that cannot be synchronised at all, as those of some network file systems.
UNSYNCHRONISED = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS, errno.EACCES, errno.EPERM, errno.EBADF)


class TakenError(InputError):
    """An output's name was taken by another program during the run; what was to be written is kept beside it."""


class Outputs(NamedTuple):
    """The outputs of one command."""

    named: list[Path]  # all files and folders that its options name, inputs as well
    may_replace: dict[Path, bool]  # of each output that was checked, whether what lies there by now may go
    places: dict[Path, Path]  # where it really lies, links followed
    written: list[Path]  # of those checked
    made: list[Path]  # folders for the outputs that were not there before


_OUTPUTS: ContextVar[Outputs | None] = ContextVar("outputs", default=None)


@contextmanager
def outputs_of_command() -> Iterator[Outputs]:
    """Within it, outputs checked by `checked_output` are a command's.

    None of them may be one of its inputs, nor two of them the same; one that was not there when it was checked is not
    replaced if it is there when it is written, unless by `force`. Of the folders that `results_folder` made none stays
    that is empty at the end.
    """
    outputs = Outputs([], {}, {}, [], [])
    token = _OUTPUTS.set(outputs)
    try:
        yield outputs
    finally:
        _OUTPUTS.reset(token)
        for folder in reversed(outputs.made):
            with suppress(OSError, ValueError):  # it holds something, is another's by now, or has no such name
                folder.rmdir()


@contextmanager
def outputs_of_run(values: Iterable[Any]) -> Iterator[None]:
    """As `outputs_of_command`, for a run with these options that no command has begun."""
    if _OUTPUTS.get() is not None:
        yield
        return
    with outputs_of_command():
        name_files(values)
        yield


def name_files(values: Iterable[Any]) -> None:
    """Note the paths among the values of a command's options, of which none may be named twice if one is an output."""
    if (outputs := _OUTPUTS.get()) is not None:
        flat = (each for value in values for each in (value if isinstance(value, list) else [value]))
        outputs.named.extend(each for each in flat if isinstance(each, Path))


def results_folder(path: Path) -> Path:
    """`path`, made with the folders above it if it is not there; InputError for a file, or where none can be made.

    Of a command that is refused afterwards no empty folder is left.
    """
    if os.path.lexists(path) and not path.is_dir():
        raise InputError(f"{path}: expected a folder for the results, found a file")
    new = [each for each in (path, *path.parents) if not os.path.lexists(each)][::-1]
    if (outputs := _OUTPUTS.get()) is not None:
        outputs.made.extend(new)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:  # a name too long, or with letters that the file system does not take
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: the folder for the results cannot be made: {reason}") from error
    return path


def checked_output(
    path: str | Path, suffixes: tuple[str, ...], force: bool = False, is_ours: Callable[[Path], bool] | None = None
) -> Path:
    """`path` if a file may be written there, asked before the work starts; a file is made in its folder, and removed.

    With `force` the file that a symbolic link points to is what is written, and the link stays. `is_ours` is of an
    output that is a folder: whether a folder is of its kind, as which alone `force` replaces it.

    Raises
    ------
    InputError
        A suffix not among `suffixes` (of any case), a missing or read-only folder, a folder or a device in the file's
        place, an existing file without `force`, an input of the command or another of its outputs.
    """
    path = check_suffix(path, suffixes)
    if os.path.isdir(path) and (is_ours is None or not is_ours(path)):
        raise InputError(f"{path}: expected a file to write, found a folder{'' if is_ours is None else ' of others'}")
    try:
        place = Path(os.path.realpath(path))
        before = _state(place)
    except (OSError, ValueError) as error:  # a name too long, or with letters that the file system does not take
        raise InputError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error
    through = f"is a link to {place}: " if path.is_symlink() else ""
    if not place.parent.is_dir():
        raise InputError(f"{path}: {through}its folder does not exist; make it first")
    if before is not None and is_ours is not None and not stat.S_ISDIR(before.st_mode):
        raise InputError(f"{path}: {through}expected a folder to write, found something else; remove it first")
    if before is not None and is_ours is None and not stat.S_ISREG(before.st_mode):
        raise InputError(f"{path}: {through}expected a file to write, found a device, a pipe or a link in a circle")
    if os.path.lexists(path) and not force:
        raise InputError(f"{path}: exists already; pass `force` to replace it")
    _check_once(path, place)
    _check_folder(path, place.parent)
    if (outputs := _OUTPUTS.get()) is not None:
        outputs.may_replace[_absolute(path)] = force
        outputs.places[_absolute(path)] = place
    return path


def check_suffix(path: str | Path, suffixes: tuple[str, ...]) -> Path:
    """The path, if its name ends in one of the suffixes, of any case; else InputError."""
    path = Path(path)
    if not path.name.lower().endswith(suffixes):
        raise InputError(f"{path}: expected a name that ends in {' or '.join(suffixes)}")
    return path


def _check_once(path: Path, place: Path) -> None:
    """InputError if the command names the file a second time: as an input, or as another output."""
    if (outputs := _OUTPUTS.get()) is None:
        return
    others = list(outputs.named)
    if path in others:
        others.remove(path)  # the option that names the output itself
    if any(os.path.realpath(other) == str(place) for other in others) or (
        place.exists() and any(other.exists() and place.samefile(other) for other in others)
    ):
        raise InputError(f"{path}: is an input of this command too, or another output; write somewhere else")


def _check_folder(path: Path, folder: Path) -> None:
    """InputError unless the folder takes a new file: rights alone do not tell."""
    try:
        handle, name = tempfile.mkstemp(prefix=".tetopt-", dir=folder)
        os.close(handle)
        os.unlink(name)
    except OSError as error:
        raise InputError(f"{path}: its folder cannot be written to: {error.strerror}") from error


def check_space(path: Path, n_bytes: int) -> None:
    """InputError if the disk of `path` has not so many bytes free, as far as it tells."""
    free = shutil.disk_usage(os.path.realpath(path.parent)).free
    if free < n_bytes:
        raise InputError(f"{path}: takes some {n_bytes} bytes or more, {free} are free; make room first")


@contextmanager
def written_whole(path: Path, n_bytes: int | None = None) -> Iterator[Path]:
    """A temporary path beside `path`, with its suffix, that takes its place when the block ends without error.

    Left behind by an error or an interruption is nothing but what was there before; by a killed process or a power cut
    the whole file, old or new, and perhaps the temporary one, whose name begins with a dot. The new file has the rights
    of the one that it replaces, and its group, where that is allowed; a file that is new those of any other.

    Raises
    ------
    TakenError
        `checked_output` saw no file there, and now there is one.
    OSError
        Any other reason, with the path and, on a full disk, the number of bytes (`n_bytes`) if it is known.
    """
    # not `path.suffixes`, which passes over dots that lead: of "..nii.gz" it knows .gz alone
    suffix = "".join(f".{part}" for part in path.name.split(".")[1:][-2:])[-20:]
    with _output(path, n_bytes) as (place, may_replace):
        handle, name = tempfile.mkstemp(prefix=_hidden(path), suffix=suffix, dir=place.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            _on_disk(temporary, place)
            if may_replace:
                os.replace(temporary, place)
            elif not _linked(temporary, place):
                kept = _beside(temporary, path)
                raise TakenError(
                    f"{path}: another program has written it in the meantime, and without `force` it stays as it is; "
                    f"what was to be written is in {kept}"
                )
            _synchronise_folder(place.parent)
        finally:
            with suppress(OSError):  # then a hidden file stays, and what is told is what went wrong before
                os.unlink(temporary)


@contextmanager
def _output(path: Path, n_bytes: int | None = None) -> Iterator[tuple[Path, bool]]:
    """Where an output really lies, and whether it may replace what is there by now; noted as written after the block.

    Errors of the system within it are those of writing `path`.
    """
    outputs, key = _OUTPUTS.get(), _absolute(path)
    place = Path(os.path.realpath(path)) if outputs is None else outputs.places.get(key, Path(os.path.realpath(path)))
    with telling(path, n_bytes, place.parent):
        yield place, outputs is None or outputs.may_replace.get(key, True)
    if outputs is not None and key in outputs.places:
        outputs.may_replace[key] = True
        outputs.written.append(path)


def _hidden(path: Path) -> str:
    """The start of the names of an output's temporary files and folders."""
    return f".{path.name[:TEMPORARY_LETTERS]}."


def _temporary_folder(stack: ExitStack, path: Path, folder: Path, suffix: str = "") -> Path:
    """A folder beside an output until the stack is unwound; what cannot be removed then stays, hidden."""
    temporary = Path(tempfile.mkdtemp(prefix=_hidden(path), suffix=suffix, dir=folder))
    stack.callback(shutil.rmtree, temporary, ignore_errors=True)
    return temporary


@contextmanager
def folder_written_whole(path: Path) -> Iterator[Path]:
    """As `written_whole`, an output that is a folder: a temporary one beside it, which takes its place in the end.

    A folder that is there is moved aside for that; between the two moves, and if the process is killed there, its
    name is free.

    Raises
    ------
    TakenError
        `checked_output` saw nothing there, and now there is something.
    OSError
        As `written_whole`.
    """
    with ExitStack() as stack, _output(path) as (place, may_replace):
        temporary = _temporary_folder(stack, path, place.parent, path.suffix[-20:])
        yield temporary
        for folder, _, names in os.walk(temporary):
            for name in names:
                _on_disk(Path(folder) / name)
        _take_rights(temporary, place)
        if not may_replace and os.path.lexists(place):
            raise TakenError(f"{path}: another program has written it in the meantime, and without `force` it stays")
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
    """Errors of the system as those of writing `path`, on a full disk with the number of bytes, if it is known.

    `folder` is where the file really lies, that of `path` by default.
    """
    try:
        yield
    except OSError as error:
        reason = _reason(error, folder or path.parent, n_bytes)
        raise OSError(error.errno or errno.EIO, reason, str(path)) from error


def save_bytes(path: str | Path, whole: bytes) -> None:
    """Write a file, whole or not at all; errors as `written_whole`."""
    with written_whole(Path(path), len(whole)) as temporary:
        temporary.write_bytes(whole)


def save_text(path: str | Path, text: str) -> None:
    """Write text as UTF-8, whole or not at all; letters that are none, of names that are not UTF-8, as escapes."""
    save_bytes(path, text.encode("utf-8", "backslashreplace"))


def save_json(path: Path, value: Any) -> None:
    """Write `value` as JSON, whole or not at all; numpy numbers and arrays, NamedTuples and paths are taken."""
    save_text(path, json.dumps(_plain(value), indent=1, allow_nan=False) + "\n")


def kept_places(path: Path, suffix: str) -> Iterator[Path]:
    """Free names where what `path` cannot take may be kept: beside it, then in temporary folders of one's own."""
    names = chain([path.stem], (f"{path.stem}_optimised_{number}" for number in count(1)))
    places = (path.with_name(f"{name}{suffix}") for name in names)
    yield next(place for place in places if place != path and not os.path.lexists(place))
    for folder in (tempfile.gettempdir(), os.getcwd(), os.path.expanduser("~")):
        with suppress(OSError):  # the next one
            yield Path(tempfile.mkdtemp(prefix="tetopt-", dir=folder)) / f"{path.stem}{suffix}"


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


def _state(place: Path) -> os.stat_result | None:
    """What is at a place, None for nothing."""
    try:
        return os.lstat(place)
    except (FileNotFoundError, NotADirectoryError):
        return None


def _take_rights(temporary: Path, place: Path) -> None:
    """Give the new file the rights and the group of the one that it replaces; a new one those that the umask leaves."""
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
        except OSError:  # not one of our groups: the one that it has now may do what all others may
            mode = (mode & ~0o070) | (mode & 0o007) << 3
    os.chmod(temporary, mode)


def _on_disk(path: Path, place: Path | None = None) -> None:
    """Have a file on the disk itself, with the rights of what is in its `place`.

    A power cut after the renaming would else leave an empty one. It is opened before it takes the rights, with which
    nobody may perhaps write it.
    """
    handle = os.open(path, os.O_RDWR)
    try:
        if place is not None:
            _take_rights(path, place)
        os.fsync(handle)
    finally:
        os.close(handle)


def _synchronise_folder(folder: Path) -> None:
    """Have the renaming on the disk, where folders can be synchronised."""
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


def _linked(temporary: Path, place: Path) -> bool:
    """Give the file its name if that is free; whether it was."""
    try:
        os.link(temporary, place)
    except FileExistsError:  # a network file system says so, too, where an answer was lost on the way
        return os.path.samefile(temporary, place)
    except OSError:  # FAT and some network file systems have no links: the name is taken first, and then replaced
        try:
            os.close(os.open(place, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        except FileExistsError:
            return False
        try:
            os.replace(temporary, place)
        except OSError:
            os.unlink(place)
            raise
    return True


def _beside(temporary: Path, path: Path) -> Path:
    """Give the file a free name beside its own; the name."""
    end = next((path.name[-len(each) :] for each in (".nii.gz",) if path.name.lower().endswith(each)), path.suffix)
    stem = path.name[: len(path.name) - len(end)]
    return next(kept for number in count(1) if _linked(temporary, kept := path.with_name(f"{stem}_kept_{number}{end}")))


def _reason(error: OSError, folder: Path, n_bytes: int | None) -> str:
    """Why a file cannot be written, on a full disk with the bytes that it takes."""
    reason = f"cannot be written: {error.strerror or error}"
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) and n_bytes is not None:
        reason += f"; it takes {n_bytes} bytes"
        with suppress(OSError):
            reason += f", {shutil.disk_usage(folder).free} are free"
    return reason


def _plain(value: Any) -> Any:
    """`value` in JSON's own types; what is not finite becomes null, which JSON has no number for."""
    if hasattr(value, "_asdict"):
        return {key: _plain(item) for key, item in value._asdict().items()}
    if isinstance(value, dict):
        return {_plain(str(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, str | Path):
        return str(value).encode("utf-8", "backslashreplace").decode()  # lone surrogates, of names, are not JSON
    return value
