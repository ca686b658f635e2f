"""Options of a cohort, in addition to those of its runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tetopt.io.formats import FORMATS
from tetopt.job.options import Option


@dataclass(frozen=True, kw_only=True)
class CohortOptions:
    """Selection of subjects, outputs and workers of a cohort."""

    panel: ClassVar[str] = "Cohort"
    output: Annotated[
        Path, Option("OUT", "Folder for all outputs; an earlier run there is resumed.", letter="o")
    ]
    suffix: Annotated[
        str, Option("WORD", "Suffix of images in a BIDS folder, such as acq-mprage_T1w.")
    ] = "T1w"
    participants: Annotated[
        list[str] | None,
        Option("LABEL", "Run only this subject. May be repeated.", "participant-label"),
    ] = None
    sessions: Annotated[
        list[str] | None,
        Option("LABEL", "Run only this session. May be repeated.", "session-label"),
    ] = None
    mesh_format: Annotated[
        str, Option("SUFFIX", f"Suffix of meshes: {', '.join(FORMATS)}.", "format")
    ] = ".vtu"
    write_table: Annotated[
        Path | None,
        Option("TABLE", "Write the subjects to run as a .tsv or .csv table; run nothing."),
    ] = None
    dry_run: Annotated[
        bool, Option(None, "Show subjects to run, with reasons and cost; run nothing.")
    ] = False
    retry_failed: Annotated[
        bool, Option(None, "Run only failed subjects; skip out-of-date ones.")
    ] = False
    collect: Annotated[
        bool, Option(None, "Write the table and page of existing results; run nothing.")
    ] = False
    workers: Annotated[
        int | None, Option("N", "Maximum number of simultaneous tasks on this machine.", least=1)
    ] = None
    scheduler: Annotated[
        str | None, Option("ADDRESS", "A running dask scheduler with its workers: tcp://host:8786.")
    ] = None
