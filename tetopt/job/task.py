"""What the stages of a run hand on: the task as read, and what came of it."""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

from tetopt.engine.cost import RunSize
from tetopt.engine.loop import MeshingResult
from tetopt.job.plan import Plan
from tetopt.job.source import Source
from tetopt.measure.quality import Quality
from tetopt.mesh import Mesh
from tetopt.model.file import MeshFile
from tetopt.start.label_sizes import SizesByLabel
from tetopt.start.sizes import Sizes

Shapes = tuple[Quality | None, Quality | None]
"""Of the initial mesh and of the result, if they could be measured."""


class Task(NamedTuple):
    """What a run works on, as `read` returns it: the plan, and the files that it names.

    Parameters
    ----------
    plan : Plan
        With all defaults, also those that depend on the image.
    source : Source
        What is meshed: `content` of the contrasts, labels and mask, and the files that it comes from.
    started : MeshFile or None
        The mesh to start from.
    sizes : Sizes or None
        Targets and limits for the cells' edges.
    size : RunSize
        Numbers of voxels, nodes and iterations, by which time and memory are predicted.
    request : dict
        What decides the outputs: options, checksums of files, the version.
    by_label : SizesByLabel, optional
        What sizes labels get, if sizes by label are asked for.

    Examples
    --------
    >>> tetopt.save_image("small.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=8))
    >>> task = tetopt.read(tetopt.Job(images="small.nii.gz", output="other.vtu", nodes=60))
    >>> task.plan.mode, task.source.content.image.shape, task.size.n_nodes
    ('graded', (8, 8, 8), 60)
    """

    plan: Plan
    source: Source
    started: MeshFile | None
    sizes: Sizes | None
    size: RunSize
    request: dict[str, Any]
    by_label: SizesByLabel | None = None

    @property
    def start_name(self) -> str:
        """What the initial mesh is called."""
        return {"graded": "octree", "start": "start"}.get(self.plan.mode, "lattice")


class Meshed(NamedTuple):
    """What came of the optimisation of a run.

    Parameters
    ----------
    result : MeshingResult
        The mesh and its history.
    initial : Mesh
        The mesh that it began with.
    seconds : dict of str to float
        `load`, up to the optimisation, and `optimize`.
    predicted : dict
        What was expected before it began, as run.json states it: `prediction`, and in `memory` the bytes at most.
    fields : dict of str to array, optional
        Of the cells, if they came with the mesh.
    is_kept : bool
        Whether the mesh is in a folder of work until the run is complete.

    Examples
    --------
    >>> tetopt.save_image("small.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=8))
    >>> meshed = tetopt.run(tetopt.Job(images="small.nii.gz", output="small.vtu", nodes=60, iterations=1)).meshed
    >>> sorted(meshed.seconds), meshed.result.history[-1].iteration, meshed.is_kept
    (['load', 'optimize'], 1, False)
    """

    result: MeshingResult
    initial: Mesh
    seconds: dict[str, float]
    predicted: dict[str, dict[str, Any]]
    fields: dict[str, NDArray] | None = None
    is_kept: bool = False
