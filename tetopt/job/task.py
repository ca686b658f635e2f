"""What the stages of a run hand on: the task as read, and what came of it."""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

from tetopt.engine.cost import RunSize
from tetopt.engine.loop import MeshingResult
from tetopt.job.in_parts import StoredSource
from tetopt.job.plan import Plan
from tetopt.job.source import Source
from tetopt.measure.quality import Quality
from tetopt.mesh import Mesh
from tetopt.model.file import MeshFile
from tetopt.start.sizes import Sizes

Shapes = tuple[Quality | None, Quality | None]
"""Of the initial mesh and of the result, if they could be measured."""


class Task(NamedTuple):
    """What a run works on: the plan, and the files that it names, as read."""

    plan: Plan
    source: Source | StoredSource
    started: MeshFile | None  # the mesh to start from
    sizes: Sizes | None
    size: RunSize  # by which time and memory are predicted
    request: dict[str, Any]  # what decides the outputs, as `requested` has it

    @property
    def start_name(self) -> str:
        """What the initial mesh is called."""
        return {"graded": "octree", "start": "start"}.get(self.plan.mode, "lattice")


class Meshed(NamedTuple):
    """What came of the optimisation."""

    result: MeshingResult
    initial: Mesh
    seconds: dict[str, float]  # up to the optimisation, and of it
    predicted_bytes: float  # of memory, at most, before it began; in parts of each worker's largest task
    fields: dict[str, NDArray] | None  # of the cells, if they are known
