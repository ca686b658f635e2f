"""The public names of tetopt, and the modules that they are loaded from."""

from .geometry.check import check_mesh as check_mesh
from .cohort.cohort import run_cohort as run_cohort
from .contents.align import (
    foreground_mask as foreground_mask,
    resample_contrast as resample_contrast,
    resample_labels as resample_labels,
    resample_mask as resample_mask,
)
from .contents.content import Content as Content, content as content
from .contents.probabilities import (
    resample_tissue as resample_tissue,
    tissue_labels as tissue_labels,
)
from .energy.discretization import E_D as E_D
from .energy.geometric import E_G as E_G
from .energy.sampling import (
    cell_moments as cell_moments,
    cell_of_voxel as cell_of_voxel,
)
from .engine.fast import optimize as optimize
from .engine.loop import MeshingResult as MeshingResult
from .engine.meshing import mesh_image as mesh_image
from .engine.paper import optimize_paper as optimize_paper
from .errors import InputError as InputError
from .fem.solution import (
    Solution as Solution,
    solution_fields as solution_fields,
    solve as solve,
)
from .fields.field import Field as Field
from .fields.onto_cells import CellField as CellField, cell_field as cell_field
from .geometry.surface import extract_surface as extract_surface
from .image import Image as Image
from .io.components import load_field as load_field
from .io.formats import (
    register_format as register_format,
    save_mesh as save_mesh,
    save_model as save_model,
)
from .io.frd import read_frd as read_frd
from .io.images import load_image as load_image, save_image as save_image
from .io.label_tables import load_label_table as load_label_table
from .io.meshes import load_mesh as load_mesh
from .io.surfaces import save_surface as save_surface
from .io.transforms import load_transform as load_transform
from .job.job import Job as Job
from .job.plan import Plan as Plan, plan as plan
from .job.read import read as read
from .job.run import Result as Result, run as run
from .measure.fidelity import (
    LabelFidelity as LabelFidelity,
    MaskFidelity as MaskFidelity,
    cell_labels as cell_labels,
    label_fidelity as label_fidelity,
    mask_fidelity as mask_fidelity,
)
from .measure.interfaces import (
    label_interfaces as label_interfaces,
)
from .measure.quality import Quality as Quality, quality as quality
from .measure.segmentation import segment as segment
from .measure.thin import (
    label_contacts as label_contacts,
    label_thickness as label_thickness,
)
from .mesh import Mesh as Mesh
from .model.build import build_model as build_model
from .model.fields import cell_fields as cell_fields
from .model.file import MeshFile as MeshFile
from .model.label_names import LabelTable as LabelTable
from .model.mappings import ByLabel as ByLabel
from .model.on_image import field_on_image as field_on_image, warped_image as warped_image
from .model.loads import Load as Load
from .model.materials import Materials as Materials
from .model.model import Model as Model
from .model.tissues import merge_labels as merge_labels
from .model.sets import Box as Box, Sets as Sets
from .contents.phantom import Phantom as Phantom, load_phantom as load_phantom
from .start.label_sizes import (
    sizes_by_label as sizes_by_label,
)
from .start.lattice import lattice_mesh as lattice_mesh
from .start.octree import octree_mesh as octree_mesh
from .start.sizes import Sizes as Sizes

__version__: str
