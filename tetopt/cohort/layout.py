"""Layout of a cohort's files, with names of BIDS derivatives.

- OUT/dataset_description.json identifies the folder as a cohort's
- OUT/cohort.tsv, cohort.html: all subjects
- OUT/sub-X[/ses-Y]/KEY_desc-tetopt_mesh.vtu, with the run's numbers in a JSON file of the same name
- OUT/sub-X[/ses-Y]/figures/: its pictures
- OUT/logs/KEY.log, KEY.failed.json: events of the last run, and why it failed
- OUT/logs/KEY.notes.json: what the table of subjects says of it beside options
- OUT/.work/: unfinished outputs (`tetopt.system.work_directory`)
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tetopt
from tetopt.errors import InputError
from tetopt.system import work_directory
from tetopt.system.files import save_json
from tetopt.system.incoming import json_of, text_of

DESCRIPTION_NAME = "dataset_description.json"
WORK_NAME, LOGS_NAME, FIGURES_NAME = ".work", "logs", "figures"
TABLE_NAME, PAGE_NAME = "cohort.tsv", "cohort.html"
# files that runs write to OUT
OWN_NAMES = (DESCRIPTION_NAME, ".bidsignore", TABLE_NAME, "cohort.json", PAGE_NAME)
BIDS_VERSION = "1.10.0"  # of the specification that names follow
KEY_PATTERN = re.compile(r"(sub-[A-Za-z0-9]+)(?:_(ses-[A-Za-z0-9]+))?")


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


def notes_path(out: Path, key: str) -> Path:
    """Return the path of what the table of subjects says of one beside its options."""
    return out / LOGS_NAME / f"{key}.notes.json"


def thumbnail_path(out: Path, key: str) -> Path:
    """Return the path of a subject's picture for the page."""
    return subject_folder(out, key) / FIGURES_NAME / "thumbnail.png"


def check_out(out: Path) -> None:
    """Raise InputError for a folder with anything but a cohort of tetopt's, or with links where
    runs write.
    """
    if not os.path.lexists(out):
        if not out.absolute().parent.is_dir():
            raise InputError(f"{out}: its parent folder does not exist; create it first")
        return
    if not out.is_dir():
        raise InputError(f"{out}: expected a folder for the cohort, got a file")
    if any(out.iterdir()) and not is_cohort(out):
        raise InputError(
            f"{out} is not a cohort folder; choose an empty folder, or that of a cohort"
        )
    for path in (*(out / name for name in (*OWN_NAMES, LOGS_NAME)), *(out / LOGS_NAME).glob("*")):
        if path.is_symlink():
            raise InputError(
                f"{path}: expected no link; replace it with what it leads to, or remove it"
            )
    if os.path.lexists(out / WORK_NAME):
        work_directory.check(out / WORK_NAME)


def linked_place(out: Path, key: str) -> str | None:
    """Return the problem of a subject's folder that is a link, as a run would write to another
    place.
    """
    place = subject_folder(out, key)
    for each in (place / FIGURES_NAME, place, place.parent):
        if each != out and each.is_symlink():
            return (
                f"{each}: expected the subject's folder, got a link to {os.readlink(each)}; a "
                "run would write "
                "there: move that folder back, or remove the link"
            )
    return None


def is_cohort(out: Path) -> bool:
    """Return whether `begin` made a folder."""
    makers = (table_in(out / DESCRIPTION_NAME) or {}).get("GeneratedBy")
    return isinstance(makers, list) and any(
        isinstance(each, dict) and each.get("Name") == "tetopt" for each in makers
    )


def begin(out: Path, sources: Sequence[str] = ()) -> None:
    """Make the folder if it is new, and describe its origin and data as a derivative of BIDS
    1.10.
    """
    out.mkdir(exist_ok=True)
    (out / LOGS_NAME).mkdir(exist_ok=True)
    work_directory.create(out / WORK_NAME)
    if (out / DESCRIPTION_NAME).exists():
        return
    description = {
        "Name": "Tetrahedral meshes by tetopt",
        "BIDSVersion": BIDS_VERSION,
        "DatasetType": "derivative",
        "GeneratedBy": [{"Name": "tetopt", "Version": tetopt.__version__}],
        "SourceDatasets": [{"URL": source} for source in sources],
    }
    save_json(out / DESCRIPTION_NAME, description)
    # BIDS does not yet name meshes of volumes, pages and logs; its patterns of folders have no "/".
    (out / ".bidsignore").write_text(
        "*_mesh.*\n*.html\ncohort.*\nlogs/\nfigures\n", encoding="utf-8"
    )


def publish(work: Path, out: Path, key: str) -> None:
    """Replace a subject's outputs by those in `work`; the user's own files, such as notes or
    results, are kept.

    Its numbers are removed first and come last: a subject without them is missing, and is run
    again.
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


def clean(out: Path, keys: list[str] | None) -> None:
    """Remove unfinished outputs of these subjects, or, if None, of all: runs that go on
    elsewhere then end.
    """
    for path in (out / WORK_NAME).glob("sub-*.run-*"):
        if (
            (keys is None or path.name.partition(".")[0] in keys)
            and path.is_dir()
            and not path.is_symlink()
        ):
            shutil.rmtree(path, ignore_errors=True)


def table_in(path: Path) -> dict[str, Any] | None:
    """Return the object in a JSON file; None if there is no such file, or something else in it."""
    try:
        table = json_of(text_of(path, "JSON file"))
    except (InputError, ValueError):
        return None
    return table if isinstance(table, dict) else None
