"""The order of the gallery's programs: from an image to a mesh, what it is worth, and on to solvers."""

ORDER = (
    "first_mesh",
    "ventricles",
    "organ_from_mask",
    "tissues_from_labels",
    "nested_shells",
    "calculix",
    "two_contrasts",
    "target_error",
    "k_d",
    "slice_2d",
    "quadratic_cells",
    "elastography",
    "scikit_fem",
    "fenicsx",
    "improve_pytetwild",
    "own_phantom",
    "fields_on_voxels",
    "other_libraries",
    "own_format",
)


def position(file: str) -> int:
    """Of a program, for sphinx-gallery."""
    return ORDER.index(file.removeprefix("plot_").removesuffix(".py"))
