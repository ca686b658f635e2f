"""tetopt: from a medical volume straight to an image-aligned tetrahedral mesh, without segmentation."""

__version__ = "0.1.0"

from importlib import import_module
from inspect import isfunction
from itertools import chain
from typing import Any

from tetopt.cache import place_cache

place_cache()  # before numba is loaded

_NAMES_OF = {  # by module
    "check": ("check_mesh",),
    "cohort.cohort": ("run_cohort",),
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
    "image": ("Image", "VoxelGrid"),
    "io.formats": ("save_mesh", "save_model"),
    "io.frd": ("Results", "read_frd"),
    "io.images": ("load_image", "save_image"),
    "io.label_tables": ("load_label_table",),
    "io.meshes": ("load_mesh",),
    "io.stored_images": ("open_stored",),
    "io.surfaces": ("save_surface",),
    "job.events": ("Event",),
    "job.job": ("Job",),
    "job.run": ("Result", "run"),
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
    "stored": ("StoredImage",),
}
__all__ = sorted(["__version__", *chain(*_NAMES_OF.values())])


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
