"""Abaqus input files, which CalculiX also reads: mesh, sets, materials and static steps."""

from __future__ import annotations

import textwrap

import numpy as np
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.io.tags import check_apart, named_materials, without_data
from tetopt.io.text import blocks, comment_lines, plain, rows
from tetopt.model.fields import node_field
from tetopt.model.loads import (
    Load,
    count_of_steps,
    in_step,
    load_words,
    spring_constants,
)
from tetopt.model.materials import (
    Materials,
    axes_across,
    cells_of,
    engineering_constants,
    is_fibrous,
    without_moduli,
)
from tetopt.model.model import (
    Model,
    element_facets,
    elements,
    header_lines,
    mass_densities,
    traction_forces,
)
from tetopt.system.arrays import Floats, Ints

ALL_ELEMENTS = "all_cells"  # the set for which results are requested
FIBRES_PREFIX = "fibres-"  # of orientations, and of the sets of cells that have them
SPRING_PREFIX = "spring-"  # of sets of one spring each; springs are elements after the cells
# for the largest modulus; CalculiX rounds temperatures to about 1e-8 degrees
HOTTEST_DEGREES = 1000.0
# Between adjacent temperatures, where 1 / modulus is interpolated linearly: an error of at most
# 5e-5.
TEMPERATURE_RATIO = 1.02
# The number of the face opposite each local node: S1 is 1-2-3, S2 is 1-4-2, S3 is 2-4-3, S4 is
# 3-4-1.
FACE_NUMBERS = np.array([3, 4, 2, 1])
# In a number: Abaqus allows no more, and CalculiX reads only the first 20, so that
# 1.234567890123456e-05 becomes 1.23.
NUMBER_CHARACTERS = 20
COMMENT_CHARACTERS = 120  # in a comment line; Abaqus reads lines of up to 256

# Requests that both solvers know. Only CalculiX has TOTALS=ONLY, which would omit the energy of
# each cell.
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
    """Return an Abaqus input file (.inp), for Abaqus/Standard and CalculiX.

    Linear (C3D4) or quadratic (C3D10) tetrahedra. Each facet set becomes a surface and a node set
    of its name, the latter including midside nodes; each cell set becomes an element set.
    "all_cells" contains all elements. Materials and their element sets are named after labels
    (`tetopt.io.tags.named_materials`). A modulus that varies within cells becomes a material with a
    temperature-dependent modulus: the temperature at each node is the modulus in thousandths of the
    largest; both solvers interpolate it linearly between corners, and there is no expansion.

    A material with fibres has engineering constants, and a section with an *ORIENTATION for each
    direction among its cells, which both solvers read (CalculiX knows no *DISTRIBUTION).

    Each step of the loads becomes a static step, a separate load case, whose strain energy and
    reaction forces both solvers print: pressure on faces, tractions as nodal forces and springs
    from nodes to the ground by `tetopt.model.loads.facet_weights`, and gravity on all cells. Steps
    of a nonlinear model request large deformation with a neo-Hookean material, because linear
    elasticity in Green's strain collapses under pressure.

    Numbers read back unchanged, except those of more than 20 characters, which neither solver
    reads: they are rounded to the 13 to 16 digits that fit. Among coordinates, this affects some of
    those within 0.1 mm of 0.

    Raises
    ------
    InputError
        The model is 2-D; loads have no materials; springs are in only some steps; a set has a name
        that the file uses itself; a nonlinear model has fibres.
    """
    if model.materials is not None and model.node_young is not None:
        model = model._replace(materials=without_moduli(model.materials))
    _check(model)
    parts = [_head(model), *_mesh(model)]
    parts += [f"*ELSET, ELSET={name}\n{_list(cells)}" for name, cells in model.sets.cells.items()]
    parts += [
        f"*SURFACE, NAME={name}, TYPE=ELEMENT\n{_faces(members)}"
        for name, members in model.sets.facets.items()
    ]
    parts += _materials(model)
    if model.loads:
        parts += _springs(model)
        for step in range(1, count_of_steps(model.loads) + 1):
            parts += _step(model, step)
    return "".join(parts).encode()


def _check(model: Model) -> None:
    if model.mesh.ndim == 2:
        raise InputError("abaqus: expected a tetrahedral mesh, got triangles; use .vtu")
    if model.loads and model.materials is None:
        raise InputError(
            "abaqus: loads need materials; give a modulus mapping (`young`) or omit the loads"
        )
    if count_of_steps(model.loads) > 1 and (
        some := [x for x in model.loads if x.kind == "spring" and x.step]
    ):
        raise InputError(
            f"abaqus: expected springs in all steps, got {load_words(some[0])}; omit the step or "
            "write several files"
        )
    if model.is_nonlinear and (count := count_of_steps(model.loads)) > 1:
        raise InputError(
            f"abaqus: expected one nonlinear step, got {count} (each would continue from the "
            "previous one); write a file for each"
        )
    has_fibres = model.materials is not None and model.materials.along is not None
    if model.is_nonlinear and has_fibres:
        raise InputError("abaqus: materials with fibres are linear; omit `nonlinear`")
    others = {
        name: cells for name, cells in model.sets.cells.items() if name not in _shared_sets(model)
    }
    own = [ALL_ELEMENTS, *named_materials(model)]
    if has_fibres:
        own += [name for name in others if name.lower().startswith(FIBRES_PREFIX)]
    check_apart(own, others)


def _shared_sets(model: Model) -> set[str]:
    """Return the names of materials that equal the name of a set of the same cells."""
    if model.materials is None:
        return set()
    of_material = zip(named_materials(model), cells_of(model.materials), strict=True)
    return {
        name for name, cells in of_material if np.array_equal(model.sets.cells.get(name, -1), cells)
    }


def _head(model: Model) -> str:
    lines = header_lines(model) + without_data(model)
    short = (part for line in lines for part in textwrap.wrap(plain(line), COMMENT_CHARACTERS))
    return f"{comment_lines(short, '** ')}*HEADING\n{comment_lines(['; '.join(lines[:3])])}"


def _mesh(model: Model) -> list[str]:
    """Return nodes, node sets and elements."""
    points, cells = elements(model)
    return [
        f"*NODE\n{_number_rows(_fitting(points))}",
        *(
            f"*NSET, NSET={name}\n{_list(np.unique(element_facets(cells, members)))}"
            for name, members in model.sets.facets.items()
        ),
        f"*ELEMENT, TYPE=C3D{cells.shape[1]}, ELSET={ALL_ELEMENTS}\n{_number_rows(cells + 1)}",
    ]


def _materials(model: Model) -> list[str]:
    if model.materials is None:
        return []
    parts = []
    densities = [] if model.materials.density is None else mass_densities(model).tolist()
    names = named_materials(model)
    shared = _shared_sets(model)
    for k, (name, members) in enumerate(zip(names, cells_of(model.materials), strict=True)):
        parts += [] if name in shared else [f"*ELSET, ELSET={name}\n{_list(members)}"]
        parts.append(f"*MATERIAL, NAME={name}\n{_law(model, model.materials, k)}")
        if densities:
            parts.append(f"*DENSITY\n{_number(densities[k])}\n")
        if is_fibrous(model.materials, members):
            parts += _oriented_sections(model.materials, name, members)
        else:
            parts.append(f"*SOLID SECTION, ELSET={name}, MATERIAL={name}\n")
    if model.node_young is not None:
        temperatures = _temperatures(model, node_field(model.node_young, model.mesh, model.order))
        parts.append(
            f"*INITIAL CONDITIONS, TYPE=TEMPERATURE\n{_number_rows(_fitting(temperatures))}"
        )
    return parts


def _oriented_sections(materials: Materials, name: str, members: Ints) -> list[str]:
    """Return an orientation, a set and a section for each direction of fibres in a material; they
    are named after the first cell.
    """
    assert materials.along is not None
    directions, which = np.unique(materials.along.fibre[members], axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    groups = np.split(members[order], np.cumsum(np.bincount(which.ravel()))[:-1])
    axes = rows(_fitting(directions), _fitting(axes_across(directions)), separator=", ")
    return [
        f"*ORIENTATION, NAME={FIBRES_PREFIX}{cells[0] + 1}\n{axis}\n"
        f"*ELSET, ELSET={FIBRES_PREFIX}{cells[0] + 1}\n{_list(cells)}"
        f"*SOLID SECTION, ELSET={FIBRES_PREFIX}{cells[0] + 1}, MATERIAL={name}, "
        f"ORIENTATION={FIBRES_PREFIX}{cells[0] + 1}\n"
        for cells, axis in zip(groups, axes.splitlines(), strict=True)
    ]


def _law(model: Model, materials: Materials, k: int) -> str:
    """Return the elastic constants of a material, at several temperatures if it depends on them."""
    nu = float(materials.nu[k])
    if is_fibrous(materials, np.flatnonzero(materials.of_cell == k)):
        of = {name: values[k : k + 1] for name, values in engineering_constants(materials).items()}
        first = [of[name] for name in ("E1", "E2", "E2", "v", "v", "v", "G12", "G12")]
        lines = [rows(*map(_fitting, each), separator=", ") for each in (first, [of["G23"]])]
        return f"*ELASTIC, TYPE=ENGINEERING CONSTANTS\n{''.join(lines)}"
    if model.node_young is None:
        young = materials.young[k : k + 1]
    else:
        low = float(model.node_young.min())
        high = float(model.node_young.max())
        count = (
            1 + int(np.ceil(np.log(high / low) / np.log(TEMPERATURE_RATIO)))
            if model.is_nonlinear
            else 2
        )
        young = np.unique(np.geomspace(low, high, count).clip(low, high))
    temperatures = () if model.node_young is None else (_temperatures(model, young),)
    law, constants = "*ELASTIC", (young, np.full(len(young), nu))
    if model.is_nonlinear:
        # C10 = mu / 2 and D1 = 2 / bulk modulus, so that the response at small strains is the same.
        law = "*HYPERELASTIC, NEO HOOKE"
        constants = (young / (4.0 + 4.0 * nu), 6.0 * (1.0 - 2.0 * nu) / young)
    return f"{law}\n{rows(*map(_fitting, (*constants, *temperatures)), separator=', ')}"


def _temperatures(model: Model, young: Floats) -> Floats:
    """Return the temperatures that represent moduli."""
    assert model.node_young is not None
    return young * (HOTTEST_DEGREES / model.node_young.max())


def _springs(model: Model) -> list[str]:
    """Return three springs along the axes at each node of a set with springs."""
    parts = []
    number = len(model.mesh.cells)
    for load in model.loads:
        if load.kind != "spring":
            continue
        nodes, constants = spring_constants(model.mesh, model.sets, load, model.order)
        for node, constant in zip(nodes.tolist(), _fitting(constants).tolist(), strict=True):
            for dof in (1, 2, 3):
                number += 1
                name = f"{SPRING_PREFIX}{number}"
                parts.append(
                    f"*ELEMENT, TYPE=SPRING1, ELSET={name}\n{number}, {node + 1}\n"
                    f"*SPRING, ELSET={name}\n{dof}\n{constant!r}\n"
                )
    return parts


def _step(model: Model, step: int) -> list[str]:
    """Return a step, which first removes the loads of the previous one.

    Loads on the same node or face are added here: solvers treat repeated ones differently.
    """
    loads = in_step(model.loads, step)
    new = ", OP=NEW" if count_of_steps(model.loads) > 1 else ""
    cards = {
        "*BOUNDARY": _conditions(loads),
        "*CLOAD": _forces(model, loads),
        "*DLOAD": _weight(loads) + _pressures(model, loads),
    }
    displaced = dict.fromkeys(load.set_name for load in loads if load.kind == "displacement")
    return [
        "*STEP, NLGEOM, INC=1000\n*STATIC\n0.1, 1.0, 1e-05, 0.25\n"
        if model.is_nonlinear
        else "*STEP\n*STATIC\n",
        *(f"{card}{new}\n{lines}" for card, lines in cards.items() if lines or new),
        OUTPUT_REQUESTS,
        "** Reaction forces and their sums\n" if displaced else "",
        *(f"*NODE PRINT, NSET={name}, TOTALS=YES\nRF\n" for name in displaced),
        "*END STEP\n",
    ]


def _conditions(loads: tuple[Load, ...]) -> str:
    """Return displacements of sets, by component."""
    lines = []
    for load in loads:
        if load.kind == "displacement":
            dofs = np.flatnonzero(~np.isnan(load.numbers))
            values = rows(dofs + 1, dofs + 1, _fitting(load.numbers[dofs]), separator=", ")
            lines += [f"{load.set_name}, {line}\n" for line in values.splitlines()]
    return "".join(lines)


def _forces(model: Model, loads: tuple[Load, ...]) -> str:
    """Return nodal forces of tractions, by component."""
    total = traction_forces(model, loads)
    node, dof = np.nonzero(total)
    return rows(node + 1, dof + 1, _fitting(total[node, dof]), separator=", ")


def _pressures(model: Model, loads: tuple[Load, ...]) -> str:
    """Return pressures on faces of cells; CalculiX does not support OP=NEW for pressures on
    surfaces.
    """
    pressed = [load for load in loads if load.kind == "pressure"]
    if not pressed:
        return ""
    members = [model.sets.facets[load.set_name] for load in pressed]
    faces, which = np.unique(np.concatenate(members), axis=0, return_inverse=True)
    values = np.repeat(
        [float(load.numbers[0]) for load in pressed], [len(each) for each in members]
    )
    total: Floats = np.bincount(which.ravel(), weights=values).astype(np.float64)
    lines = zip(_faces(faces, "P").splitlines(), _fitting(total).tolist(), strict=True)
    return "".join(f"{face}, {value!r}\n" for face, value in lines)


def _weight(loads: tuple[Load, ...]) -> str:
    """Return gravity on all cells."""
    acceleration = sum((load.numbers for load in loads if load.kind == "gravity"), np.zeros(3))
    size = float(np.linalg.norm(acceleration))
    if size == 0.0:
        return ""
    return (
        f"{ALL_ELEMENTS}, GRAV, "
        f"{', '.join(_number(float(x)) for x in (size, *(acceleration / size)))}\n"
    )


def _list(numbers: Ints) -> str:
    return blocks(numbers + 1, separator=", ")


def _number_rows(array: NDArray) -> str:
    return rows(np.arange(1, len(array) + 1), array, separator=", ")


def _faces(members: Ints, letter: str = "S") -> str:
    return rows(members[:, 0] + 1, FACE_NUMBERS[members[:, 1]], separator=f", {letter}")


def _number(value: float) -> str:
    return repr(_shorten_number(value))


def _fitting(values: Floats) -> Floats:
    """Round values so that none is longer than `NUMBER_CHARACTERS`."""
    return np.array([_shorten_number(x) for x in values.ravel().tolist()]).reshape(values.shape)


def _shorten_number(value: float) -> float:
    if len(repr(value)) <= NUMBER_CHARACTERS:
        return value
    texts = (f"{value:.{digits}g}" for digits in range(16, 0, -1))
    return float(next(text for text in texts if len(text) <= NUMBER_CHARACTERS))
