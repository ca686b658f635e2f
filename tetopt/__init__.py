"""tetopt: from a medical volume straight to an image-aligned tetrahedral mesh, without segmentation."""

__version__ = "0.1.0"

from tetopt.check import check_mesh
from tetopt.energy.discretization import E_D
from tetopt.energy.geometric import E_G
from tetopt.energy.sampling import cell_moments, cell_of_voxel
from tetopt.engine.fast import optimize
from tetopt.engine.meshing import mesh_image
from tetopt.engine.paper import optimize_paper
from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.formats import save_model
from tetopt.io.images import load_image, save_image
from tetopt.io.label_tables import load_label_table
from tetopt.io.meshes import load_mesh, save_mesh
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
