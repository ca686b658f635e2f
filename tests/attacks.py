"""What may lie where tetopt keeps its own files, and what lies outside and is to stay as it is."""

import os
import shutil
import stat
from contextlib import suppress

KINDS = ("file link", "folder link", "hanging link", "device link", "pipe", "file", "folder")


def outside(folder):
    """A folder that no command has to do with, and that links lead to."""
    place = folder / "outside"
    (place / "deep").mkdir(parents=True)
    (place / "notes.txt").write_text("years of work")
    (place / "deep" / "more.txt").write_text("and more")
    # as root: a device of its own, which code that follows links may ruin
    with suppress(PermissionError):
        os.mknod(place / "zero", stat.S_IFCHR | 0o666, os.makedev(1, 5))
    return place


def planted(kind, place, elsewhere):
    """Put something else in the place of what is there."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    targets = {
        "file link": elsewhere / "notes.txt",
        "folder link": elsewhere,
        "hanging link": elsewhere / "new",
        "device link": elsewhere / "zero" if (elsewhere / "zero").exists() else "/dev/zero",
    }
    if kind in targets:
        place.symlink_to(targets[kind])
    elif kind == "hard link":
        os.link(elsewhere / "notes.txt", place)
    elif kind == "pipe":
        os.mkfifo(place)
    elif kind == "file":
        place.write_text("mine")
    else:
        place.mkdir()
        (place / "mine.txt").write_text("mine")


def content(folder):
    """All that is in a folder by name: of links where they lead, of files what they hold."""
    found = {}
    for path in sorted(folder.rglob("*")):
        mode = path.lstat().st_mode
        name = str(path.relative_to(folder))
        if stat.S_ISLNK(mode):
            found[name] = os.readlink(path)
        else:
            found[name] = path.read_bytes() if stat.S_ISREG(mode) else stat.S_IFMT(mode)
    return found
