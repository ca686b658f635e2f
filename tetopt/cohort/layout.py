"""Layout of a cohort's files, with names of BIDS derivatives, and locks for writing.

OUT/dataset_description.json                   identifies the folder as a cohort's
OUT/cohort.tsv, cohort.html                    all subjects
OUT/sub-X[/ses-Y]/KEY_desc-tetopt_mesh.vtu     with the run's numbers in a JSON file of the same name
OUT/sub-X[/ses-Y]/figures/                     its pictures
OUT/logs/KEY.log, KEY.failed.json              events of the last run, and why it failed
OUT/.work/                                     unfinished outputs (`tetopt.system.work_directory`)
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
from tetopt.system.work_directory import LOCK_NAME, Layout, check_files, create, opened

DESCRIPTION_NAME = "dataset_description.json"
WORK_NAME, LOGS_NAME, FIGURES_NAME = ".work", "logs", "figures"
TABLE_NAME, PAGE_NAME = "cohort.tsv", "cohort.html"
OWN_NAMES = (DESCRIPTION_NAME, ".bidsignore", TABLE_NAME, "cohort.json", PAGE_NAME)  # files that runs write to OUT
BIDS_VERSION = "1.10.0"  # of the specification that names follow
KEY_PATTERN = re.compile(r"(sub-[A-Za-z0-9]+)(?:_(ses-[A-Za-z0-9]+))?")
# Locks, and the unfinished outputs of subjects, which are not opened, only moved or removed.
WORK = Layout("cohort", rf"{LOCK_NAME}|{KEY_PATTERN.pattern}\.lock", {rf"{KEY_PATTERN.pattern}\.run-[\w-]+": None})


def subject_folder(out: Path, key: str) -> Path:
    """Return the folder of a subject's outputs."""
    subject, _, session = key.partition("_")
    return out / subject / session if session else out / subject


def mesh_name(key: str, suffix: str) -> str:
    """Return the file name of a subject's mesh; with the suffix ".json", that of its numbers."""
    return f"{key}_desc-tetopt_mesh{suffix}"


def numbers_path(out: Path, key: str) -> Path:
    """Return the path of the numbers of a subject's run, as from `tetopt mesh --json`."""
    return subject_folder(out, key) / mesh_name(key, ".json")


def log_path(out: Path, key: str) -> Path:
    """Return the path of the events of a subject's last run."""
    return out / LOGS_NAME / f"{key}.log"


def failure_path(out: Path, key: str) -> Path:
    """Return the path of the failure of a subject's last run, which exists only if it failed."""
    return out / LOGS_NAME / f"{key}.failed.json"


def thumbnail_path(out: Path, key: str) -> Path:
    """Return the path of a subject's picture for the page."""
    return subject_folder(out, key) / FIGURES_NAME / "thumbnail.png"


def check_out(out: Path) -> None:
    """Raise InputError for a folder with anything but a cohort of tetopt's, or with links where runs write."""
    if not os.path.lexists(out):
        if not out.absolute().parent.is_dir():
            raise InputError(f"{out}: its parent folder does not exist; create it first")
        return
    if not out.is_dir():
        raise InputError(f"{out}: expected a folder for the cohort, got a file")
    if any(out.iterdir()) and not is_cohort(out):
        raise InputError(f"{out} is not a cohort folder; choose an empty folder, or that of a cohort")
    for name in OWN_NAMES:
        if (wrong := not_our_file(out / name)) is not None:
            raise InputError(wrong)
    if os.path.lexists(out / LOGS_NAME):
        check_files(out / LOGS_NAME, "cohort")
    if os.path.lexists(out / WORK_NAME):
        with opened(out / WORK_NAME, WORK) as work:
            work.check()


def not_our_file(path: Path) -> str | None:
    """Return the problem of a file of tetopt's, if it is a link, a pipe or the like."""
    other = irregular(path, follow=False) if os.path.lexists(path) else None
    return other and f"{path}: expected a regular file, got {other}; replace it with the file itself, or remove it"


def not_our_files(out: Path, key: str) -> str | None:
    """Return the problem of a subject's outputs that are read."""
    return not_our_file(numbers_path(out, key)) or not_our_picture(out, key)


def not_our_picture(out: Path, key: str) -> str | None:
    """Return the problem of a subject's thumbnail, and of its folder, which tetopt makes inside the subject's."""
    path = thumbnail_path(out, key)
    if path.parent.is_symlink():
        return f"{path.parent}: expected a folder, got a link; replace it with the folder itself, or remove the link"
    return not_our_file(path)


def linked_place(out: Path, key: str) -> str | None:
    """Return the problem of a subject's folder that is a link, as a run would write to another place."""
    place = subject_folder(out, key)
    for each in (place, place.parent):
        if each != out and each.is_symlink():
            return (
                f"{each}: expected the subject's folder, got a link to {os.readlink(each)}; a run would write "
                "there: move that folder back, or remove the link"
            )
    return None


def is_cohort(out: Path) -> bool:
    """Return whether `begin` made a folder."""
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
    """Make the folder if it is new, and describe its origin and data as a derivative of BIDS 1.10."""
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
    # BIDS does not yet name meshes of volumes, pages and logs; its patterns of folders have no "/".
    (out / ".bidsignore").write_text("*_mesh.*\n*.html\ncohort.*\nlogs/\nfigures\n", encoding="utf-8")


def locked(out: Path, keys: list[str] | None = None) -> AbstractContextManager[None]:
    """Lock the folder against other runs, or, with `keys`, against runs that write the whole or these subjects."""
    return work_directory.locked(out / WORK_NAME, WORK, out, keys)


def publish(work: Path, out: Path, key: str) -> None:
    """Replace a subject's outputs by those in `work`; the user's own files, such as notes or results, are kept.

    Its numbers are removed first and come last: a subject without them is missing, and is run again.
    """
    if (wrong := linked_place(out, key)) is not None:
        raise InputError(wrong)
    place, numbers = subject_folder(out, key), numbers_path(out, key)
    place.mkdir(parents=True, exist_ok=True)
    if numbers.exists():  # then the pictures are tetopt's, too
        numbers.unlink()
        shutil.rmtree(place / FIGURES_NAME, ignore_errors=True)
    for path in place.glob(mesh_name(key, "*")):
        path.unlink()
    files = [path.relative_to(work) for path in work.rglob("*") if path.is_file()]
    for name in sorted(files, key=lambda name: name.name == numbers.name):
        (place / name).parent.mkdir(exist_ok=True)
        os.replace(work / name, place / name)


def clean(out: Path, keys: list[str] | None = None) -> None:
    """Remove unfinished outputs of these subjects, or, without `keys`, of all: runs that go on elsewhere then end."""
    with opened(out / WORK_NAME, WORK) as work:
        for name, mode in work.own().items():
            if stat.S_ISDIR(mode) and (keys is None or name.partition(".")[0] in keys):
                work.remove(name, mode)


def numbers_of(path: Path) -> dict[str, Any] | None:
    """Read a file of numbers; return None if it is missing, or was not written by a run of tetopt."""
    try:
        table = json.loads(own_bytes(path))
    except (OSError, ValueError, RecursionError):
        return None
    return table if isinstance(table, dict) else None
