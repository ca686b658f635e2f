"""The order of the gallery's programs: what most users do first, then method, solvers and other
libraries.
"""

ORDER = (
    "first_mesh",
    "organ_from_mask",
    "tissues_from_labels",
    "target_error",
    "calculix",
    "fields_on_voxels",
    "nested_shells",
    "two_contrasts",
    "ventricles",
    "slice_2d",
    "k_d",
    "quadratic_cells",
    "elastography",
    "scikit_fem",
    "fenicsx",
    "improve_pytetwild",
    "own_phantom",
    "other_libraries",
    "own_format",
)


def position(file: str) -> int:
    """Return the place of a program, for sphinx-gallery."""
    return ORDER.index(file.removeprefix("plot_").removesuffix(".py"))
