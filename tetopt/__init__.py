"""tetopt: from a medical volume straight to an image-aligned tetrahedral mesh, without segmentation."""

__version__ = "0.1.0"

from importlib import import_module
from inspect import isfunction
from typing import TYPE_CHECKING, Any

from tetopt.cache import place_cache

place_cache()  # before numba is loaded

if TYPE_CHECKING:
    from tetopt.check import check_mesh
    from tetopt.contents.align import foreground_mask, resample_contrast, resample_labels, resample_mask
    from tetopt.contents.content import Content, content
    from tetopt.contents.statistics import Statistics
    from tetopt.energy.discretization import E_D
    from tetopt.energy.geometric import E_G
    from tetopt.energy.sampling import CellMoments, cell_moments, cell_of_voxel
    from tetopt.engine.fast import optimize
    from tetopt.engine.loop import IterationRecord, MeshingResult
    from tetopt.engine.meshing import mesh_image
    from tetopt.engine.paper import optimize_paper
    from tetopt.errors import InputError
    from tetopt.fem.solution import Solution, SolutionFields, solution_fields, solve
    from tetopt.geometry.surface import Surface, extract_surface
    from tetopt.image import Image
    from tetopt.io.formats import save_mesh, save_model
    from tetopt.io.frd import Results, read_frd
    from tetopt.io.images import load_image, save_image
    from tetopt.io.label_tables import load_label_table
    from tetopt.io.meshes import load_mesh
    from tetopt.io.stored_images import open_stored
    from tetopt.io.surfaces import save_surface
    from tetopt.job.events import Event
    from tetopt.job.job import Job
    from tetopt.job.plan import Plan, plan
    from tetopt.job.read import read
    from tetopt.job.run import Result, run
    from tetopt.job.task import Meshed, Task
    from tetopt.measure.fidelity import LabelFidelity, MaskFidelity, cell_labels, label_fidelity, mask_fidelity
    from tetopt.measure.interfaces import LabelInterface, label_interfaces
    from tetopt.measure.quality import Quality, QualityErrors, quality
    from tetopt.measure.segmentation import segment
    from tetopt.mesh import Mesh
    from tetopt.model.build import build_model
    from tetopt.model.fields import cell_fields
    from tetopt.model.file import MeshFile
    from tetopt.model.labels import LabelTable
    from tetopt.model.laws import ByLabel
    from tetopt.model.loads import Load
    from tetopt.model.materials import BinningError, Materials
    from tetopt.model.model import Model
    from tetopt.model.sets import Box, Sets
    from tetopt.phantom import Phantom, Shape, load_phantom
    from tetopt.start.lattice import lattice_mesh
    from tetopt.start.octree import octree_mesh
    from tetopt.start.sizes import Sizes

_NAMES_OF = {  # by module
    "check": ("check_mesh",),
    "contents.align": ("resample_contrast", "resample_labels", "resample_mask", "foreground_mask"),
    "contents.content": ("Content", "content"),
    "contents.statistics": ("Statistics",),
    "energy.discretization": ("E_D",),
    "energy.geometric": ("E_G",),
    "energy.sampling": ("CellMoments", "cell_moments", "cell_of_voxel"),
    "engine.fast": ("optimize",),
    "engine.loop": ("MeshingResult", "IterationRecord"),
    "engine.meshing": ("mesh_image",),
    "engine.paper": ("optimize_paper",),
    "errors": ("InputError",),
    "fem.solution": ("Solution", "SolutionFields", "solution_fields", "solve"),
    "geometry.surface": ("Surface", "extract_surface"),
    "image": ("Image",),
    "io.formats": ("save_mesh", "save_model"),
    "io.frd": ("Results", "read_frd"),
    "io.images": ("load_image", "save_image"),
    "io.label_tables": ("load_label_table",),
    "io.meshes": ("load_mesh",),
    "io.stored_images": ("open_stored",),
    "io.surfaces": ("save_surface",),
    "job.events": ("Event",),
    "job.job": ("Job",),
    "job.plan": ("Plan", "plan"),
    "job.read": ("read",),
    "job.run": ("Result", "run"),
    "job.task": ("Meshed", "Task"),
    "measure.fidelity": ("LabelFidelity", "MaskFidelity", "cell_labels", "label_fidelity", "mask_fidelity"),
    "measure.interfaces": ("LabelInterface", "label_interfaces"),
    "measure.quality": ("Quality", "QualityErrors", "quality"),
    "measure.segmentation": ("segment",),
    "mesh": ("Mesh",),
    "model.build": ("build_model",),
    "model.fields": ("cell_fields",),
    "model.file": ("MeshFile",),
    "model.labels": ("LabelTable",),
    "model.laws": ("ByLabel",),
    "model.loads": ("Load",),
    "model.materials": ("BinningError", "Materials"),
    "model.model": ("Model",),
    "model.sets": ("Box", "Sets"),
    "phantom": ("Phantom", "Shape", "load_phantom"),
    "start.lattice": ("lattice_mesh",),
    "start.octree": ("octree_mesh",),
    "start.sizes": ("Sizes",),
}
__all__ = [
    "E_D",
    "E_G",
    "BinningError",
    "Box",
    "ByLabel",
    "CellMoments",
    "Content",
    "Event",
    "Image",
    "InputError",
    "IterationRecord",
    "Job",
    "LabelFidelity",
    "LabelInterface",
    "LabelTable",
    "Load",
    "MaskFidelity",
    "Materials",
    "Mesh",
    "MeshFile",
    "Meshed",
    "MeshingResult",
    "Model",
    "Phantom",
    "Plan",
    "Quality",
    "QualityErrors",
    "Result",
    "Results",
    "Sets",
    "Shape",
    "Sizes",
    "Solution",
    "SolutionFields",
    "Statistics",
    "Surface",
    "Task",
    "__version__",
    "build_model",
    "cell_fields",
    "cell_labels",
    "cell_moments",
    "cell_of_voxel",
    "check_mesh",
    "content",
    "extract_surface",
    "foreground_mask",
    "label_fidelity",
    "label_interfaces",
    "lattice_mesh",
    "load_image",
    "load_label_table",
    "load_mesh",
    "load_phantom",
    "mask_fidelity",
    "mesh_image",
    "octree_mesh",
    "open_stored",
    "optimize",
    "optimize_paper",
    "plan",
    "quality",
    "read",
    "read_frd",
    "resample_contrast",
    "resample_labels",
    "resample_mask",
    "run",
    "save_image",
    "save_mesh",
    "save_model",
    "save_surface",
    "segment",
    "solution_fields",
    "solve",
]


def __getattr__(name: str) -> Any:
    """A public name, whose module is loaded when it is first used: `tetopt --help` needs none of the kernels."""
    for module, names in _NAMES_OF.items():
        if name in names:
            value = getattr(import_module(f"tetopt.{module}"), name)
            if isfunction(value):  # whoever calls it by this name may give it anything
                value = import_module("tetopt.public").checked(value)
            globals()[name] = value
            return value
    raise AttributeError(f"module 'tetopt' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
