"""Records that stages of a run pass on: the task as read, and its result."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from tetopt.engine.loop import MeshingResult
from tetopt.fields.field import Field
from tetopt.image import Image
from tetopt.job.plan import Plan
from tetopt.job.source import Source
from tetopt.measure.quality import Quality
from tetopt.mesh import Mesh
from tetopt.model.file import MeshFile
from tetopt.start.label_sizes import SizesByLabel
from tetopt.start.sizes import Sizes
from tetopt.system.arrays import Ints

Shapes = tuple[Quality | None, Quality | None]
"""Quality of the initial mesh and of the result, if measured."""


class Task(NamedTuple):
    """The work of a run, as `read` returns it: the plan, and its files.

    Parameters
    ----------
    plan : Plan
        The plan with all defaults, including those that depend on the image.
    source : Source
        The inputs: `content` of the contrasts, labels and mask, and their files.
    started : MeshFile or None
        The mesh to start from.
    sizes : Sizes or None
        Targets and limits for the cells' edges.
    request : dict
        Everything that determines the outputs: options, checksums of files, the version.
    by_label : SizesByLabel, optional
        Sizes of labels, if sizes by label are requested.
    regions : (M,) int64, optional
        Regions of the mesh to start from that the run keeps (`tetopt.model.sets.regions_of`):
        those of its labels and cell sets, unless the job has labels.
    fields : dict of str to Image or Field, optional
        The job's fields, as read.

    Examples
    --------
    >>> tetopt.save_image("small.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=8))
    >>> task = tetopt.read(tetopt.Job(images="small.nii.gz", output="other.vtu", nodes=60))
    >>> task.plan.mode, task.source.content.image.shape, task.plan.job.nodes
    ('graded', (8, 8, 8), 60)
    """

    plan: Plan
    source: Source
    started: MeshFile | None
    sizes: Sizes | None
    request: dict[str, Any]
    by_label: SizesByLabel | None = None
    regions: Ints | None = None
    fields: Mapping[str, Image | Field] = {}

    @property
    def kept_labels(self) -> Ints | None:
        """Labels of the cells of the mesh to start from, (M,), if there are any."""
        return None if self.started is None else self.started.labels

    def labels_of(self, regions: Ints | None) -> Ints | None:
        """Return the labels of regions of the mesh to start from, (M,); None without labels.

        Parameters
        ----------
        regions : (M,) int64, optional
            Numbers of the start's cells.

        Returns
        -------
        (M,) int64, optional
            Their labels.

        Examples
        --------
        >>> task.labels_of(np.array([0, 5]))  # doctest: +SKIP
        array([1, 2])
        """
        of_start = self.kept_labels
        return None if regions is None or of_start is None else of_start[regions]

    @property
    def start_name(self) -> str:
        """Name of the initial mesh."""
        return {"graded": "octree", "start": "start"}.get(self.plan.mode, "lattice")


class Meshed(NamedTuple):
    """The result of a run's optimisation.

    Parameters
    ----------
    result : MeshingResult
        The mesh and its history.
    initial : Mesh
        The initial mesh.
    seconds : dict of str to float
        `load`, until the optimisation, and `optimize`.
    memory : dict of str to float
        Bounds of the memory, in bytes, as in run.json.
    early : Path, optional
        The file that has the mesh already, without measurements, if the run was cut short.
    regions : (M,) int64, optional
        The region of each cell, if the task has regions.

    Examples
    --------
    >>> tetopt.save_image("small.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=8))
    >>> job = tetopt.Job(images="small.nii.gz", output="small.vtu", nodes=60, iterations=1)
    >>> meshed = tetopt.run(job).meshed
    >>> sorted(meshed.seconds), meshed.result.history[-1].iteration
    (['load', 'optimize'], 1)
    """

    result: MeshingResult
    initial: Mesh
    seconds: dict[str, float]
    memory: dict[str, float]
    early: Path | None = None
    regions: Ints | None = None
