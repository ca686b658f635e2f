"""tetopt: from a medical volume straight to an image-aligned tetrahedral mesh, without segmentation."""

__version__ = "0.1.0"

from importlib import import_module
from inspect import isfunction
from typing import TYPE_CHECKING, Any

from tetopt.cache import place_cache

place_cache()  # before numba is loaded

if TYPE_CHECKING:
    from tetopt.check import check_mesh
    from tetopt.energy.discretization import E_D
    from tetopt.energy.geometric import E_G
    from tetopt.energy.sampling import cell_moments, cell_of_voxel
    from tetopt.engine.fast import optimize
    from tetopt.engine.meshing import mesh_image
    from tetopt.engine.paper import optimize_paper
    from tetopt.errors import InputError
    from tetopt.image import Image
    from tetopt.io.formats import save_mesh, save_model
    from tetopt.io.images import load_image, save_image
    from tetopt.io.label_tables import load_label_table
    from tetopt.io.meshes import load_mesh
    from tetopt.measure.fidelity import cell_labels, label_fidelity, mask_fidelity
    from tetopt.measure.interfaces import label_interfaces
    from tetopt.measure.quality import quality
    from tetopt.mesh import Mesh
    from tetopt.model.build import model_of
    from tetopt.model.fields import cell_fields
    from tetopt.phantom import load_phantom
    from tetopt.start.lattice import lattice
    from tetopt.start.octree import octree
    from tetopt.start.sizes import Sizes
    from tetopt.target.align import aligned_contrast, aligned_labels, aligned_mask, foreground
    from tetopt.target.content import content

_NAMES_OF = {  # by module
    "check": ("check_mesh",),
    "energy.discretization": ("E_D",),
    "energy.geometric": ("E_G",),
    "energy.sampling": ("cell_moments", "cell_of_voxel"),
    "engine.fast": ("optimize",),
    "engine.meshing": ("mesh_image",),
    "engine.paper": ("optimize_paper",),
    "errors": ("InputError",),
    "image": ("Image",),
    "io.formats": ("save_mesh", "save_model"),
    "io.images": ("load_image", "save_image"),
    "io.label_tables": ("load_label_table",),
    "io.meshes": ("load_mesh",),
    "measure.fidelity": ("cell_labels", "label_fidelity", "mask_fidelity"),
    "measure.interfaces": ("label_interfaces",),
    "measure.quality": ("quality",),
    "mesh": ("Mesh",),
    "model.build": ("model_of",),
    "model.fields": ("cell_fields",),
    "phantom": ("load_phantom",),
    "start.lattice": ("lattice",),
    "start.octree": ("octree",),
    "start.sizes": ("Sizes",),
    "target.align": ("aligned_contrast", "aligned_labels", "aligned_mask", "foreground"),
    "target.content": ("content",),
}
__all__ = [
    "E_D",
    "E_G",
    "Image",
    "InputError",
    "Mesh",
    "Sizes",
    "__version__",
    "aligned_contrast",
    "aligned_labels",
    "aligned_mask",
    "cell_fields",
    "cell_labels",
    "cell_moments",
    "cell_of_voxel",
    "check_mesh",
    "content",
    "foreground",
    "label_fidelity",
    "label_interfaces",
    "lattice",
    "load_image",
    "load_label_table",
    "load_mesh",
    "load_phantom",
    "mask_fidelity",
    "mesh_image",
    "model_of",
    "octree",
    "optimize",
    "optimize_paper",
    "quality",
    "save_image",
    "save_mesh",
    "save_model",
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
