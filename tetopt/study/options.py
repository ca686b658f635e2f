"""Options of a comparison, and the resulting settings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tetopt.engine.loop import DEFAULT_NODES
from tetopt.errors import InputError
from tetopt.job.options import AVERAGE_OPTION, WHOLE_BOX, BoxPart, LabelNamesOption, Option
from tetopt.model.averages import parse_average
from tetopt.study.compare_report import Settings
from tetopt.study.pipelines import PIPELINES
from tetopt.study.program import Program, parse_program
from tetopt.system.budget import BYTES_PER_GB

DEFAULT_SETTINGS = Settings(nodes=DEFAULT_NODES[3])


@dataclass(frozen=True, kw_only=True)
class ComparedOptions:
    """The compared pipelines, and their inputs."""

    panel: ClassVar[str] = "Comparison"
    nodes: Annotated[int, Option("N", "Target number of nodes of every mesh.", least=20)] = (
        DEFAULT_SETTINGS.nodes
    )
    labels: Annotated[
        Path | None, Option("LABELS", "Label image, for tetopt and the pipelines that segment.")
    ] = None
    label_names: LabelNamesOption = None
    repeats: Annotated[
        int, Option("R", "Number of runs for meshers whose result varies.", least=1)
    ] = DEFAULT_SETTINGS.repeats
    pipelines: Annotated[
        str, Option("A,B,...", f"Pipelines, in order: some of {', '.join(PIPELINES)}.")
    ] = ",".join(PIPELINES)
    programs: Annotated[
        list[str] | None,
        Option(
            "NAME=COMMAND",
            "Add a program as a pipeline: 'NAME=program {image} {labels} {nodes} {output}'.",
            "pipeline",
        ),
    ] = None
    k_D: Annotated[float, Option("K", "Weight of the image on uniform meshes.", "k-d")] = (
        DEFAULT_SETTINGS.k_D
    )
    classes: Annotated[
        int, Option("K", "Number of segmentation classes (multi-Otsu).", least=2)
    ] = DEFAULT_SETTINGS.classes
    part: BoxPart = WHOLE_BOX


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """The simulation on all meshes."""

    panel: ClassVar[str] = "Simulation"
    young: Annotated[
        str | None,
        Option(
            "MAPPING",
            "Modulus by intensity, as for `fem`. Default: 1 to 10 kPa over the image's range.",
        ),
    ] = None
    average: Annotated[str, AVERAGE_OPTION] = DEFAULT_SETTINGS.average
    reference_dofs: Annotated[
        int | None,
        Option(
            "D",
            "Most unknowns of the voxel reference: 0.5 GB and a minute per 100,000. Default: "
            "300,000, or what fits.",
            least=1000,
        ),
    ] = DEFAULT_SETTINGS.reference_dofs


@dataclass(frozen=True, kw_only=True)
class LimitOptions:
    """Limits of one run of a pipeline."""

    panel: ClassVar[str] = "Limits"
    max_seconds: Annotated[float, Option("S", "Time limit of one run of a pipeline.")] = (
        DEFAULT_SETTINGS.max_seconds
    )
    max_gb: Annotated[float | None, Option("GB", "Memory limit of one run of a pipeline.")] = None


@dataclass(frozen=True, kw_only=True)
class CompareOptions(LimitOptions, SimulationOptions, ComparedOptions):
    """All options of a comparison."""

    def settings(self) -> Settings:
        """Return the settings; raise InputError for a number out of range."""
        if not 0.0 <= self.k_D < 1.0:
            raise InputError(f"`k_D`: expected 0 <= k_D < 1, got {self.k_D}")
        _check_limit("max_seconds", self.max_seconds)
        _check_limit("max_gb", self.max_gb)
        parse_average(self.average)
        programs = _programs(self.programs or [])
        names = [name.strip() for name in self.pipelines.split(",")]
        names += [each.name for each in programs if each.name not in names]
        return Settings(
            nodes=self.nodes,
            pipelines=tuple(names),
            programs=programs,
            repeats=self.repeats,
            classes=self.classes,
            k_D=self.k_D,
            reference_dofs=self.reference_dofs,
            average=self.average,
            max_seconds=self.max_seconds,
            max_bytes=None if self.max_gb is None else int(self.max_gb * BYTES_PER_GB),
        )


def _check_limit(name: str, limit: float | None) -> None:
    if limit is not None and not 0.0 < limit < float("inf"):
        raise InputError(f"`{name}`: expected more than 0, got {limit}")


def _programs(texts: list[str]) -> tuple[Program, ...]:
    """Parse the user's own pipelines; raise InputError for one that cannot be run, or a
    duplicate name.
    """
    programs = tuple(map(parse_program, texts))
    names = [*PIPELINES, *(each.name for each in programs)]
    if twice := [name for number, name in enumerate(names) if name in names[:number]]:
        raise InputError(
            f'`pipeline`: expected unique names, got "{twice[0]}" again; use another name'
        )
    return programs
