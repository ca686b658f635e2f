"""Abaqus input files, which CalculiX reads, too: mesh, sets, materials and a static step."""

from __future__ import annotations

import textwrap

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.tags import check_apart, check_kinds, material_names, without_data
from tetopt.io.text import blocks, rows
from tetopt.model.materials import cells_of
from tetopt.model.model import Model, described, element_facets, elements

ALL_ELEMENTS = "all_cells"  # the set that results are asked for
# The number of the face opposite each local node: S1 is 1-2-3, S2 is 1-4-2, S3 is 2-4-3, S4 is 3-4-1.
FACE_NUMBERS = np.array([3, 4, 2, 1])
# Of a number: Abaqus takes no more, and CalculiX reads the first 20, so that 1.234567890123456e-05 becomes 1.23.
NUMBER_CHARACTERS = 20
COMMENT_CHARACTERS = 120  # of a comment line; Abaqus reads lines of up to 256

# Requests that both solvers know. CalculiX alone has TOTALS=ONLY, which would leave out the energy of each cell.
OUTPUT_REQUESTS = f"""\
** Displacement, stress and strain (CalculiX .frd, Abaqus .fil)
*NODE FILE
U
*EL FILE
S, E
** Strain energy of each cell and their total (.dat)
*EL PRINT, ELSET={ALL_ELEMENTS}, TOTALS=YES
ELSE
"""


def abaqus(model: Model) -> bytes:
    """The bytes of an Abaqus input file (.inp), for Abaqus/Standard and CalculiX.

    Linear (C3D4) or quadratic (C3D10) tetrahedra. Each facet set is a surface and a node set of its name, the latter
    with midside nodes if there are; each cell set is an element set. "all_cells" are all elements, "material_1", ...
    those of each material. With loads there is a linear static step, whose strain energy and reaction forces both
    solvers print. Cell data has no place in such a file; a comment names what is left out.

    Numbers read back the same, but for those that take more than 20 characters, which neither solver reads: they are
    rounded to the 13 to 16 digits that fit. Of coordinates these are some of those within 0.1 mm of 0.

    Raises
    ------
    InputError
        A 2-D model, loads without materials, or a cell set with the name of one of the file's own.
    """
    _check(model)
    parts = [_head(model), *_mesh(model)]
    parts += [f"*ELSET, ELSET={name}\n{_list(cells)}" for name, cells in model.sets.cells.items()]
    parts += [f"*SURFACE, NAME={name}, TYPE=ELEMENT\n{_faces(members)}" for name, members in model.sets.facets.items()]
    parts += _materials(model)
    if model.loads:
        parts += _step(model)
    return "".join(parts).encode("utf-8", "replace")


def _check(model: Model) -> None:
    if model.mesh.ndim == 2:
        raise InputError("abaqus: expected a mesh of tetrahedra, got triangles; .vtu holds them")
    if model.loads and model.materials is None:
        raise InputError(
            "abaqus: loads, but no materials to press on; give a law of the modulus (--young) or leave out the loads"
        )
    check_kinds(model, "abaqus", ("displacement",), 1)
    check_apart([ALL_ELEMENTS, *material_names(model, {})], model.sets.cells)


def _head(model: Model) -> str:
    lines = described(model) + without_data(model)
    comments = [f"** {part}\n" for line in lines for part in textwrap.wrap(line, COMMENT_CHARACTERS)]
    return "".join([*comments, "*HEADING\n", "; ".join(lines[:3]), "\n"])


def _mesh(model: Model) -> list[str]:
    """Nodes, node sets and elements."""
    points, cells = elements(model)
    return [
        f"*NODE\n{_numbered(_fitting(points))}",
        *(
            f"*NSET, NSET={name}\n{_list(np.unique(element_facets(cells, members)))}"
            for name, members in model.sets.facets.items()
        ),
        f"*ELEMENT, TYPE=C3D{cells.shape[1]}, ELSET={ALL_ELEMENTS}\n{_numbered(cells + 1)}",
    ]


def _materials(model: Model) -> list[str]:
    if model.materials is None:
        return []
    materials = model.materials
    constants = rows(_fitting(materials.young), _fitting(materials.nu), separator=", ").splitlines()
    return [
        f"*ELSET, ELSET={name}\n{_list(members)}"
        f"*MATERIAL, NAME={name}\n*ELASTIC\n{pair}\n*SOLID SECTION, ELSET={name}, MATERIAL={name}\n"
        for name, members, pair in zip(material_names(model, {}), cells_of(materials), constants, strict=True)
    ]


def _step(model: Model) -> list[str]:
    dofs = np.arange(1, 4)
    conditions = [
        f"{load.set_name}, {line}\n"
        for load in model.loads
        for each in [~np.isnan(load.numbers)]
        for line in rows(dofs[each], dofs[each], _fitting(load.numbers[each]), separator=", ").splitlines()
    ]
    reactions = [f"*NODE PRINT, NSET={load.set_name}, TOTALS=YES\nRF\n" for load in model.loads]
    return [
        "*STEP\n*STATIC\n*BOUNDARY\n",
        *conditions,
        OUTPUT_REQUESTS,
        "** Reaction forces and their sums\n",
        *reactions,
        "*END STEP\n",
    ]


def _list(numbers: NDArray[np.int64]) -> str:
    return blocks(numbers + 1, separator=", ")


def _numbered(array: NDArray) -> str:
    return rows(np.arange(1, len(array) + 1), array, separator=", ")


def _faces(members: NDArray[np.int64]) -> str:
    return rows(members[:, 0] + 1, FACE_NUMBERS[members[:, 1]], separator=", S")


def _fitting(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """`values`, each rounded so that it is not longer than `NUMBER_CHARACTERS`."""
    return np.array([_shortened(x) for x in values.ravel().tolist()]).reshape(values.shape)


def _shortened(value: float) -> float:
    if len(repr(value)) <= NUMBER_CHARACTERS:
        return value
    texts = (f"{value:.{digits}g}" for digits in range(16, 0, -1))
    return float(next(text for text in texts if len(text) <= NUMBER_CHARACTERS))
