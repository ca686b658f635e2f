"""Fields of cells, and solver results on cells and nodes."""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tetopt.contents.content import Content, own_image
from tetopt.energy.sampling import cell_moments_and_ranges
from tetopt.errors import InputError
from tetopt.geometry.check import outside_fraction
from tetopt.geometry.quadratic import cell_edges, quadratic
from tetopt.geometry.simplex import dihedral_angles, rho
from tetopt.image import Image
from tetopt.measure.judge import warn_of_other_mask
from tetopt.mesh import Mesh
from tetopt.model.formula import FORMULA_FUNCTIONS, INTENSITY, formula_text
from tetopt.system.arrays import Arrays
from tetopt.system.incoming import json_of

# Fields that depend on the world's axes or on the unit of stress, by name; a suffix such as _step2
# may follow.
VECTOR_FIELDS = ("displacement",)
DIRECTION_FIELDS = ("fibre",)
TENSOR_FIELDS = ("strain", "stress", "strain_nodes", "stress_nodes")
NODE_MODULI = "young_nodes"  # point data in tetopt's files: moduli that are linear within cells
# cell data in tetopt's files: moduli at Gauss points of quadratic cells, one per column
GAUSS_MODULI = "young_gauss"
STRESS_FIELDS = (
    "young",
    NODE_MODULI,
    GAUSS_MODULI,
    "young_along",
    "shear_along",
    "stress",
    "von_mises",
    "stress_nodes",
    "von_mises_nodes",
)
# cell data of tetopt's files beside those
STANDARD_FIELDS = (
    *("mean", "variance", "n_voxels", "min", "max", "volume", "rho", "min_dihedral"),
    *("label", "material", "nu", "density", "facets", "cells"),
)
COHERENCE_SUFFIX = "_coherence"  # after a name of directions
KINDS_TEXT = "field_kinds"  # text of a mesh's file: the kinds of fields from files, by name
HALF_TURN = np.array([-1.0, -1.0, 1.0])  # about z, from RAS+ to LPS+ or back


def cell_fields(mesh: Mesh, image: Image | Content | None = None) -> Arrays:
    """Return the standard fields of each cell, as written to mesh files.

    Parameters
    ----------
    mesh : Mesh
        Points in world coordinates, mm. Of curved cells only the volume is theirs, all else is of
        straight ones.
    image : Image or Content, optional
        Without it, the fields of the image are omitted. For a mesh of a content, pass the content:
        voxels outside its mask take the value of the nearest voxel inside.

    Returns
    -------
    dict of (M,) arrays
        "volume", mm^n; "rho", the radius ratio; "min_dihedral", the smallest angle, degrees; with
        an image, in its unit, "mean", "variance" (unit squared), "n_voxels", "min" and "max".

    Raises
    ------
    InputError
        For the reasons of `cell_moments`.

    Warns
    -----
    UserWarning
        The mesh hardly overlaps with the content's mask.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> fields = tetopt.cell_fields(mesh, image)
    >>> sorted(fields)
    ['max', 'mean', 'min', 'min_dihedral', 'n_voxels', 'rho', 'variance', 'volume']
    >>> tetopt.save_mesh("ball.vtu", mesh, fields)
    """
    fields: Arrays = {}
    if isinstance(image, Content):
        warn_of_other_mask(mesh, image.own_mask)
    if image is not None:
        own = own_image(image)
        outside_fraction(mesh, own)
        moments, (low, high) = cell_moments_and_ranges(own, mesh)
        fields |= {"mean": moments.mean, "variance": moments.variance, "n_voxels": moments.n_voxels}
        fields |= {"min": low, "max": high}
    fields["volume"] = mesh.cell_volumes
    fields["rho"] = rho(mesh.points, mesh.cells)
    fields["min_dihedral"] = dihedral_angles(mesh.points, mesh.cells).min(axis=1)
    return fields


def node_field(values: NDArray, mesh: Mesh, order: int) -> NDArray:
    """Return a field with one row per node of the order (1: the mesh's nodes; 2: those of
    `quadratic`).

    If there are rows only for the mesh's nodes, the middle of an edge gets the mean of its ends;
    rows beyond the nodes of the order are dropped.

    Raises
    ------
    InputError
        The number of rows is neither that of the mesh's nodes nor that of order 2.
    """
    values = np.asarray(values)
    n_corners = len(mesh.points)
    if order == 1 and len(values) == n_corners:
        return values
    cells = quadratic(mesh.points, mesh.cells)[1]
    n_nodes = int(cells.max()) + 1
    if len(values) not in (n_corners, n_nodes):
        raise InputError(
            f"point data: expected one row per corner node ({n_corners}) or per node "
            f"({n_nodes}), got {len(values)}"
        )
    if order == 1 or len(values) == n_nodes:
        return values[: n_corners if order == 1 else n_nodes]
    ends = mesh.cells[:, cell_edges(mesh.ndim)]
    filled = np.empty((n_nodes, *values.shape[1:]), dtype=np.result_type(values, np.float32))
    filled[:n_corners] = values
    filled[cells[:, mesh.ndim + 1 :]] = 0.5 * (filled[ends[:, :, 0]] + filled[ends[:, :, 1]])
    return filled


def half_turned_fields(fields: Arrays, kinds: Mapping[str, str] | None = None) -> Arrays:
    """Transform 3-D vectors and tensors (row by row) among named fields from RAS+ to LPS+ or back:
    those of a solver, and those of `kinds` (`field_kinds`).

    Fields with such a name but another shape come from other programs and are not changed.
    """
    turned = dict(fields)
    for name, values in fields.items():
        base = _base_name(name)
        kind = (kinds or {}).get(name)
        is_vector = base in (*VECTOR_FIELDS, *DIRECTION_FIELDS) or kind in ("vector", "direction")
        if is_vector and values.shape[1:] == (3,):
            turned[name] = values * HALF_TURN + 0.0  # + 0.0: no -0
        elif (base in TENSOR_FIELDS or kind == "tensor") and values.shape[1:] == (9,):
            turned[name] = values * np.outer(HALF_TURN, HALF_TURN).ravel() + 0.0
    return turned


def field_kinds(text: Any) -> dict[str, str]:
    """Return the kinds of fields by name, of the text `KINDS_TEXT` of a mesh's file or model; none
    for another program's.
    """
    try:
        table = json_of(text) if isinstance(text, str) else text
    except ValueError:
        return {}
    return {str(name): str(kind) for name, kind in table.items()} if isinstance(table, dict) else {}


def check_field_name(name: str) -> None:
    """Raise InputError for the name of a field that cells have anyway, or results, or that a
    formula could not use.
    """
    is_taken = name in (INTENSITY, *FORMULA_FUNCTIONS) or keyword.iskeyword(name)
    if is_taken or not (name.isidentifier() and name.isascii()):
        raise InputError(
            f"field: expected a name of letters, digits and _, other than h, of formulas and "
            f'of functions, got "{formula_text(name)}"'
        )
    own = STANDARD_FIELDS + STRESS_FIELDS + VECTOR_FIELDS + DIRECTION_FIELDS + TENSOR_FIELDS
    if _base_name(name) in own or re.fullmatch(r"(mean|variance)_\d+", name):
        raise InputError(f'field: "{name}" is the name of other data of cells; choose another')


def check_other_names(kinds: Mapping[str, str]) -> None:
    """Raise InputError for a field of the name of the coherence of another, of kinds by name."""
    for name, kind in kinds.items():
        if kind == "direction" and (other := f"{name}{COHERENCE_SUFFIX}") in kinds:
            raise InputError(
                f'field: "{other}" is the name of the coherence of the directions {name}; choose '
                "another"
            )


def is_result(name: str) -> bool:
    """Return whether a field of this name is a solver result."""
    return _base_name(name) in (*VECTOR_FIELDS, *TENSOR_FIELDS, "von_mises", "von_mises_nodes")


def is_stress(name: str) -> bool:
    """Return whether a field of this name is a modulus or a stress."""
    return _base_name(name) in STRESS_FIELDS


def scaled_fields(fields: Arrays, stress: float, length: float, ndim: int) -> Arrays:
    """Convert moduli, stresses, displacements and volumes among named fields to other units,
    given as the number of new units per present unit.
    """
    factors = (
        dict.fromkeys(STRESS_FIELDS, stress)
        | dict.fromkeys(VECTOR_FIELDS, length)
        | {"volume": length**ndim}
    )
    scales = {name: factors.get(_base_name(name), 1.0) for name in fields}
    return {
        name: values if scales[name] == 1.0 else values * scales[name]
        for name, values in fields.items()
    }


def _base_name(name: str) -> str:
    return re.sub(r"_step\d+$", "", name)
