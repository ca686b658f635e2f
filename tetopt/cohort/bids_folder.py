"""The raw images of a BIDS folder, as rows of a cohort.

pybids, the field's own library, finds and parses the files; names that are not BIDS's are ignored.
Only file names are used: a broken or hostile JSON next to an image is never opened.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tetopt.cohort.subjects import NO_VALUES, Problems, Subject, table_cells
from tetopt.errors import InputError, warn
from tetopt.io.text import plain
from tetopt.system.extras import install_hint

BIDS_ENDINGS = [".nii.gz", ".nii"]  # the first is read if both exist
# of a file's place, not of its kind
PLACE_ENTITIES = ("subject", "session", "datatype", "extension")
NAMED_SUBJECTS = 5  # subjects without an image that a message names


def bids_subjects(
    folder: str | Path,
    suffix: str = "T1w",
    participants: Sequence[str] = (),
    sessions: Sequence[str] = (),
) -> list[Subject]:
    """Find the raw images of a BIDS folder, one for each subject and session.

    Between .nii and .nii.gz the latter is used, and among several images the one without entities
    beyond those of `suffix`. Subjects without an image are left out with a warning.

    Parameters
    ----------
    folder : str or Path
        Folder with a `dataset_description.json`; its `derivatives` and `sourcedata` are ignored.
    suffix : str, default "T1w"
        End of the images' names; entities before it select among several, as in `acq-mprage_T1w`.
    participants, sessions : sequence of str
        Only these, with or without `sub-` and `ses-`; all if empty.

    Returns
    -------
    list of Subject
        By subject and session, in the order of their labels.

    Raises
    ------
    InputError
        The folder is not a BIDS folder; pybids is not installed; there is no image.
    Problems
        All missing participants or sessions, and several images for one row. The images are not
        read.

    References
    ----------
    K. J. Gorgolewski et al., The brain imaging data structure, Scientific Data 3, 160044 (2016).
    """
    folder = Path(folder).absolute()
    labels = [label.removeprefix("sub-") for label in participants]
    visits = sorted({label.removeprefix("ses-") for label in sessions})
    rows: dict[tuple[str, str], list[Any]] = {}
    for image in sorted(_images(folder, suffix, labels), key=lambda image: str(image.path)):
        if not visits or image.entities.get("session") in visits:
            rows.setdefault(
                (image.entities["subject"], image.entities.get("session", "")), []
            ).append(image)
    problems = [
        f"sub-{label}: no image _{suffix}"
        for label in labels
        if label not in {key[0] for key in rows}
    ]
    problems += [
        f"ses-{visit}: no image _{suffix}"
        for visit in visits
        if visit not in {key[1] for key in rows}
    ]
    paths = {key: _simplest(images) for key, images in sorted(rows.items())}
    problems += [_ambiguity(each, folder) for each in paths.values() if len(each) > 1]
    if problems:
        raise Problems([f"{_path_text(folder)}: {plain(problem)}" for problem in problems])
    if not paths:
        raise InputError(
            f"{_path_text(folder)}: no subject has an image _{suffix}.nii.gz; use `suffix` for "
            "another kind"
        )
    if not labels:
        what = (
            f"_{suffix} in {', '.join(f'ses-{visit}' for visit in visits)}"
            if visits
            else f"_{suffix}"
        )
        _warn_of_others(folder, what, {subject for subject, _ in paths})
    notes = _notes(folder / "participants.tsv")
    return [
        Subject(
            subject,
            session,
            (path,),
            {},
            plain(str(path.relative_to(folder))),
            notes.get(subject, {}),
        )
        for (subject, session), (path,) in paths.items()
    ]


def _notes(path: Path) -> dict[str, dict[str, str]]:
    """Return what a table of participants says of each, by subject; nothing without one."""
    if not path.is_file():
        return {}
    try:
        (_, names), *lines = table_cells(path)
    except InputError as error:
        warn(f"{error}; its columns are left out")
        return {}
    rows = [dict(zip(names, cells, strict=False)) for _, cells in lines]
    return {
        row.pop("participant_id", "").removeprefix("sub-"): {
            name: cell for name, cell in row.items() if cell not in NO_VALUES
        }
        for row in rows
    }


def _images(folder: Path, suffix: str, labels: Sequence[str]) -> list[Any]:
    """Return the raw images with a suffix and its entities, of all subjects or of some, as
    pybids finds them.
    """
    try:
        from bids import BIDSLayout
        from bids.layout import BIDSLayoutIndexer, parse_file_entities
    except ImportError:
        raise InputError(
            f"BIDS folders need pybids: {install_hint('pybids')}, or give a table"
        ) from None
    *entities, word = suffix.split("_")
    kind = parse_file_entities(f"/sub-x/anat/sub-x_{suffix}.nii.gz")
    kind = {name: value for name, value in kind.items() if name not in PLACE_ENTITIES}
    if kind.get("suffix") != word or len(kind) != len(entities) + 1:
        raise InputError(
            f"`suffix` {plain(suffix)}: expected the end of a BIDS name, like T1w or "
            "acq-mprage_T1w, without .nii.gz; "
            "`participant_label` and `session_label` select subjects and sessions"
        )
    ignored = [
        "^/(?!sub-)",
        "^(/[^/]*){5}",  # circular links have endless paths
        rf"\.[^/]*$(?<!_{word}\.nii)(?<!_{word}\.nii\.gz)",
        # names with invalid UTF-8 are not BIDS names, and the index cannot store them
        "[\ud800-\udfff]",
    ]
    if some := "|".join(map(re.escape, labels)):
        ignored.append(f"^/sub-(?!({some})(/|$))")
    # A folder's own settings would be untrusted patterns.
    options: dict[str, Any] = {"index_metadata": False, "config_filename": ".no-layout_config.json"}
    indexer = BIDSLayoutIndexer(
        validate=True, ignore=[re.compile(each) for each in ignored], **options
    )
    try:
        layout = BIDSLayout(str(folder), validate=True, indexer=indexer)
    except (OSError, ValueError, RecursionError) as error:
        words = plain(str(error).partition("\n")[0])
        raise InputError(
            f"{_path_text(folder)}: expected a BIDS dataset, or a table ({words})"
        ) from error
    return list(layout.get(extension=BIDS_ENDINGS, invalid_filters="allow", **kind))


def _simplest(images: Sequence[Any]) -> list[Path]:
    """Return the paths of the images with the fewest entities, each with one ending."""
    fewest = min(len(image.entities) for image in images)
    paths = [Path(image.path) for image in images if len(image.entities) == fewest]
    # name.nii.gz comes after name.nii
    return list({path.name.removesuffix(".gz"): path for path in paths}.values())


def _ambiguity(paths: Sequence[Path], folder: Path) -> str:
    """Describe several images of one row."""
    places = ", ".join(plain(str(path.relative_to(folder))) for path in paths)
    stem = paths[0].name.partition(".")[0]
    word = "_".join(part for part in stem.split("_") if not part.startswith(("sub-", "ses-")))
    select = f"select by entities, such as `suffix` {word}, or give a table of images"
    return f"{len(paths)} images for one row, {places}: {select}"


def _warn_of_others(folder: Path, what: str, subjects: set[str]) -> None:
    others = sorted(
        path.name
        for path in folder.glob("sub-*")
        if path.is_dir() and path.name[4:] not in subjects
    )
    if others:
        some = ", ".join(others[:NAMED_SUBJECTS]) + (
            ", ..." if len(others) > NAMED_SUBJECTS else ""
        )
        warn(
            f"{_path_text(folder)}: left out subjects without {plain(what)}: {len(others)} "
            f"({plain(some)})"
        )


def _path_text(path: Path) -> str:
    return plain(str(path))
