"""Where a cohort's files lie, by the names of BIDS derivatives, and who may write there.

OUT/dataset_description.json                   by which the folder is known to be a cohort's
OUT/cohort.tsv, cohort.html                    all subjects
OUT/sub-X[/ses-Y]/KEY_desc-tetopt_mesh.vtu     and the numbers of the run beside it, in a file of the same name in JSON
OUT/sub-X[/ses-Y]/figures/                     its pictures
OUT/logs/KEY.log, KEY.failed.json              what the last run said, and why it failed
OUT/.work/                                     what is under way (`tetopt.system.work_directory`)
"""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import tetopt
from tetopt.errors import InputError
from tetopt.system import work_directory
from tetopt.system.files import save_json
from tetopt.system.incoming import irregular, json_of, own_bytes, text_of
from tetopt.system.work_directory import LOCK_NAME, MANIFEST_NAME, Layout, check_files, create, opened

DESCRIPTION_NAME = "dataset_description.json"
WORK_NAME, LOGS_NAME, FIGURES_NAME = ".work", "logs", "figures"
TABLE_NAME, PAGE_NAME = "cohort.tsv", "cohort.html"
OWN_NAMES = (DESCRIPTION_NAME, ".bidsignore", TABLE_NAME, "cohort.json", PAGE_NAME)  # files that runs write into OUT
BIDS_VERSION = "1.10.0"  # of the specification whose names are followed
KEY_PATTERN = re.compile(r"(sub-[A-Za-z0-9]+)(?:_(ses-[A-Za-z0-9]+))?")
# Of a subject before its new outputs take their place, with what users put there; its outputs under way; what dask
# leaves. Nothing in these is opened, it is moved or removed.
WORK = Layout(
    "cohort",
    rf"{LOCK_NAME}|{KEY_PATTERN.pattern}\.lock|run-\w+|seen-\d+",
    {rf"{KEY_PATTERN.pattern}\.before": None, rf"{KEY_PATTERN.pattern}\.run-\w+\.\d+": None, "dask": None},
)


def subject_folder(out: Path, key: str) -> Path:
    """Where the outputs of a subject lie."""
    subject, _, session = key.partition("_")
    return out / subject / session if session else out / subject


def mesh_name(key: str, suffix: str) -> str:
    """What the file of a subject's mesh is called; its numbers are in that of the suffix ".json"."""
    return f"{key}_desc-tetopt_mesh{suffix}"


def numbers_path(out: Path, key: str) -> Path:
    """The numbers of a subject's run, as `tetopt mesh --json` writes them."""
    return subject_folder(out, key) / mesh_name(key, ".json")


def log_path(out: Path, key: str) -> Path:
    """What the last run of a subject said."""
    return out / LOGS_NAME / f"{key}.log"


def failure_path(out: Path, key: str) -> Path:
    """Why the last run of a subject failed; not there if it did not."""
    return out / LOGS_NAME / f"{key}.failed.json"


def thumbnail_path(out: Path, key: str) -> Path:
    """The picture of a subject that the page has."""
    return subject_folder(out, key) / FIGURES_NAME / "thumbnail.png"


def check_out(out: Path) -> None:
    """InputError for a folder that holds anything but a cohort of ours, or links where runs write."""
    if not os.path.lexists(out):
        if not out.absolute().parent.is_dir():
            raise InputError(f"{out}: its folder does not exist; make it first")
        return
    if not out.is_dir():
        raise InputError(f"{out}: expected a folder for the cohort, got a file")
    if any(out.iterdir()) and not is_cohort(out):
        raise InputError(f"{out}: holds files that are no cohort's; name a new folder, or one that a cohort is in")
    for name in OWN_NAMES:
        if (wrong := not_our_file(out / name)) is not None:
            raise InputError(wrong)
    if os.path.lexists(out / LOGS_NAME):
        check_files(out / LOGS_NAME, "cohort")
    if os.path.lexists(out / WORK_NAME):
        with opened(out / WORK_NAME, WORK) as work:
            work.check()


def not_our_file(path: Path) -> str | None:
    """What is wrong with a file of ours, if it is there and a link, a pipe or the like."""
    other = irregular(path, follow=False) if os.path.lexists(path) else None
    return other and f"{path}: expected a regular file, got {other}; put the file itself there, or remove it"


def not_our_files(out: Path, key: str) -> str | None:
    """The same of what is read of a subject's outputs."""
    return not_our_file(numbers_path(out, key)) or not_our_picture(out, key)


def not_our_picture(out: Path, key: str) -> str | None:
    """The same of a subject's thumbnail, and of its folder, which tetopt makes inside the subject's."""
    path = thumbnail_path(out, key)
    if path.parent.is_symlink():
        return f"{path.parent}: expected a folder, got a link; put the folder itself there, or remove the link"
    return not_our_file(path)


def check_place(out: Path, key: str) -> None:
    """InputError for a subject's folder that is a link: a run gives it another content by renaming."""
    place = subject_folder(out, key)
    for each in (place, place.parent):
        if each != out and each.is_symlink():
            raise InputError(
                f"{each}: expected the subject's folder, got a link to {os.readlink(each)}; a run would replace what "
                "is there: move that folder back, or remove the link"
            )


def is_cohort(out: Path) -> bool:
    """Whether a folder is one that `begin` made."""
    path = out / DESCRIPTION_NAME
    if not path.is_file():
        return False
    try:
        table = json_of(text_of(path, "description of a dataset"))
    except ValueError:
        return False
    makers = table.get("GeneratedBy") if isinstance(table, dict) else None
    return isinstance(makers, list) and any(isinstance(each, dict) and each.get("Name") == "tetopt" for each in makers)


def begin(out: Path, sources: Sequence[str] = ()) -> None:
    """Make the folder, and set down whose it is and of which data, if it is new: BIDS 1.10, of a derivative."""
    out.mkdir(exist_ok=True)
    (out / LOGS_NAME).mkdir(exist_ok=True)
    create(out / WORK_NAME, WORK)
    if (out / DESCRIPTION_NAME).exists():
        return
    description = {
        "Name": "Tetrahedral meshes by tetopt", "BIDSVersion": BIDS_VERSION, "DatasetType": "derivative",
        "GeneratedBy": [{"Name": "tetopt", "Version": tetopt.__version__}],
        "SourceDatasets": [{"URL": source} for source in sources],
    }  # fmt: skip
    save_json(out / DESCRIPTION_NAME, description)
    # BIDS has no names for meshes of volumes yet, nor for pages and logs; its patterns of folders have no "/".
    (out / ".bidsignore").write_text("*_mesh.*\n*.html\ncohort.*\nlogs/\nfigures\n", encoding="utf-8")


def locked(out: Path, keys: list[str] | None = None) -> AbstractContextManager[None]:
    """Within it no other run writes to the folder, or, with `keys`, none that writes the whole or these subjects."""
    return work_directory.locked(out / WORK_NAME, WORK, out, keys)


def publish(work: Path, out: Path, key: str) -> None:
    """Give what lies in `work` the subject's place, in one step, instead of what is there; see `restore`."""
    check_place(out, key)
    place, aside = subject_folder(out, key), out / WORK_NAME / f"{key}.before"
    place.parent.mkdir(exist_ok=True)
    if place.exists():
        _clear(aside, place, key)
        os.rename(place, aside)
    os.rename(work, place)
    _clear(aside, place, key)


def _clear(aside: Path, place: Path, key: str) -> None:
    """Take away what was in a subject's place before; the user's own, as notes or results of a solver, stays there."""
    for each in aside.iterdir() if aside.exists() else ():
        if not each.name.startswith(mesh_name(key, "")) and not (place / each.name).exists():
            os.rename(each, place / each.name)
    shutil.rmtree(aside, ignore_errors=True)


def restore(out: Path, keys: list[str] | None = None) -> None:
    """Put back what a crash has left between the two renamings of `publish`, and take away what runs left behind.

    Of these subjects, or, without `keys`, of all.
    """
    with opened(out / WORK_NAME, WORK) as work:
        for name, mode in sorted(work.own().items()):
            if keys is not None and name.partition(".")[0] not in keys:
                continue
            if name.endswith(".before"):
                _put_back(out / WORK_NAME / name, out, name.removesuffix(".before"))
            # Without their files (run-..., seen-...) what a cluster still does for runs that were killed ends.
            if stat.S_ISDIR(mode) or (keys is None and name != MANIFEST_NAME and not name.endswith(LOCK_NAME)):
                work.remove(name, mode)


def _put_back(aside: Path, out: Path, key: str) -> None:
    """Give a subject its folder again, or only what the user had put there, if a new one has its place."""
    check_place(out, key)
    place = subject_folder(out, key)
    if place.exists():
        _clear(aside, place, key)
    else:
        place.parent.mkdir(exist_ok=True)
        os.rename(aside, place)


def numbers_of(path: Path) -> dict[str, Any] | None:
    """What a file of numbers holds; None if it is not there, or is not what a run of tetopt wrote."""
    try:
        table = json.loads(own_bytes(path))
    except (OSError, ValueError, RecursionError):
        return None
    return table if isinstance(table, dict) else None
