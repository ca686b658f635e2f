"""What can be asked of a cohort, beside the options of its runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tetopt.io.formats import FORMATS
from tetopt.job.options import ClusterOption, Option, SchedulerOption


@dataclass(frozen=True, kw_only=True)
class CohortOptions:
    """What of a cohort is run, where, and by whom."""

    panel: ClassVar[str] = "The cohort"
    output: Annotated[Path, Option("OUT", "The folder of all outputs; that of an earlier run goes on.", letter="o")]
    suffix: Annotated[
        str, Option("WORD", 'Of a BIDS folder: the images\' suffix, with entities before it "acq-mprage_T1w".')
    ] = "T1w"
    participants: Annotated[
        list[str] | None, Option("LABEL", "Of the subjects only this one. May be repeated.", "participant-label")
    ] = None
    sessions: Annotated[
        list[str] | None, Option("LABEL", "Of the sessions only this one. May be repeated.", "session-label")
    ] = None
    mesh_format: Annotated[str, Option("SUFFIX", f"Of the meshes' files: {', '.join(FORMATS)}.", "format")] = ".vtu"
    write_table: Annotated[
        Path | None, Option("TABLE", "Write what would be run as a table, .tsv or .csv, and run nothing.")
    ] = None
    dry_run: Annotated[bool, Option(None, "Tell what would be run, why, and what it takes; run nothing.")] = False
    retry_failed: Annotated[bool, Option(None, "Run only those that failed; what has changed stays as it is.")] = False
    collect: Annotated[bool, Option(None, "Write the table and the page of what is there; run nothing.")] = False
    workers: Annotated[
        int | None, Option("N", "So many subjects at a time, or jobs of a `cluster`, at most.", least=1)
    ] = None
    scheduler: SchedulerOption = None
    cluster: ClusterOption = None
