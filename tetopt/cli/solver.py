"""Summary lines and tables for a solver's file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.markup import escape

from tetopt.cli.console import print_line, print_table
from tetopt.io.formats import format_of
from tetopt.io.gmsh import incomplete_groups
from tetopt.io.tags import (
    group_labels,
    group_of_zero,
    label_lines,
    number_parts,
    renumbered_labels,
)
from tetopt.io.text import count_text, list_names
from tetopt.io.vtk import VTK_SUFFIXES
from tetopt.job.options import SolverOptions
from tetopt.model.fields import GAUSS_MODULI
from tetopt.model.loads import SHOWN_LOAD_DIGITS, count_of_steps, load_words
from tetopt.model.materials import Materials
from tetopt.model.model import STRESS_UNITS, Model, element_facets, elements, in_units
from tetopt.model.sets import area_vectors, standard_names
from tetopt.report.tables import new_table, nodes_in_words, range_words

MOST_SETS = 32  # printed of facets, of cells, and of materials
GMSH_SUFFIXES = (".msh", ".msh2")
# the formats' word for the number of a cell
CELL_NUMBERS = {".mfem": "attribute", ".mesh": "reference"}
MOST_LABEL_LINES = 12  # about labels, of which a file may have hundreds


def print_model(output: Path, model: Model, solver: SolverOptions) -> None:
    """Print the contents of the file: sets, materials and the error of binning, units,
    coordinates.
    """
    for line in _lines(output, model, solver):
        print_line(line)

    size = "area, mm2" if model.mesh.ndim == 3 else "length, mm"
    table = new_table("set", "facets", size, "nodes", "cells")
    cells = elements(model)[1]
    sets = model.sets
    standard = standard_names(model.mesh.ndim)  # the user's sets first
    for name, rows in sorted(sets.facets.items(), key=lambda item: item[0] in standard)[:MOST_SETS]:
        area = np.linalg.norm(area_vectors(model.mesh, rows), axis=1).sum()
        n_nodes = len(np.unique(element_facets(cells, rows)))
        table.add_row(escape(name), str(len(rows)), f"{area:.5g}", str(n_nodes), "")
    for name, members in list(sets.cells.items())[:MOST_SETS]:
        table.add_row(escape(name), "", "", "", str(len(members)))
    print_table(table)
    if more := len(sets.facets) + len(sets.cells) - table.row_count:
        print_line(f"and {more} more sets")


def _materials_by_name(model: Model, materials: Materials) -> Iterator[str]:
    """Yield a line for each material with its labels, if labels have names and each has one
    material.
    """
    labels = model.labels
    names = model.label_names
    if labels is None or not names:
        return
    pairs = np.unique(np.column_stack([labels, materials.of_cell]), axis=0).tolist()
    if len(pairs) > len(np.unique(labels)):
        return
    for number, (young, nu) in enumerate(zip(materials.young, materials.nu, strict=True)):
        if number == MOST_SETS:
            yield f"  and {len(materials.young) - MOST_SETS} more materials"
            return
        made_of = [names.get(label, str(label)) for label, material in pairs if material == number]
        yield f"  {young:.4g} {model.units}, nu {nu:.4g}: {list_names(made_of)}"


def _gmsh_lines(model: Model, suffix: str) -> Iterator[str]:
    """Yield lines on what gmsh's formats cannot store: loads, label 0, and, in 2.2, a facet in
    several groups.
    """
    if model.loads:
        yield f"loads in {suffix} files are not read back; tetopt reads loads from VTK files only"
    labels = group_labels(model)
    if labels is not None and labels.min() == 0:
        yield f"label 0 is physical group {group_of_zero(labels)}, as gmsh has no group 0"
    if renumbered := [
        f"{number} is label {label}" for number, label in renumbered_labels(model).items()
    ]:
        yield (
            "physical groups number the labels, as large labels do not fit: "
            f"{list_names(renumbered)} (see $Comments)"
        )
    if suffix == ".msh2" and (short := incomplete_groups(model)):
        yield (
            "gmsh 2.2 has one group per facet: facets of smaller sets are missing from "
            f"{', '.join(short)} (use .msh)"
        )


def _moduli_lines(output: Path, model: Model) -> Iterator[str]:
    """Yield lines on the materials, and on moduli that vary within cells."""
    if (table := model.materials) is not None:
        moduli = (
            f"Young's modulus {range_words(table.young)} {model.units}, nu {range_words(table.nu)}"
        )
        yield f"{count_text(len(table.young), 'material')}, {moduli}"
        if (along := table.along) is not None:
            yield (
                f"along fibres: {range_words(along.young_along)} {model.units}, shear modulus "
                f"{range_words(along.shear_along)} {model.units}"
            )
        yield from _materials_by_name(model, table)
        if model.gauss_young is not None:
            yield (
                "one modulus per cell, its geometric mean, and, for tetopt fem, one per Gauss "
                f"point ({GAUSS_MODULI})"
                if output.suffix.lower() in VTK_SUFFIXES
                else "one modulus per cell, its geometric mean; VTK files also have one per Gauss "
                "point"
            )
        if table.binning is not None:
            mean, largest = table.binning
            yield f"bins: modulus error {mean:.2%} on average by volume, {largest:.2%} at most"
        if table.fibre_binning is not None:
            mean, largest = table.fibre_binning
            yield f"bins: fibres turned by {mean:.2f} degrees on average, {largest:.2f} at most"
    if model.node_young is not None:
        low = model.node_young.min()
        high = model.node_young.max()
        yield (
            f"the modulus is linear within cells, {low:.4g} to {high:.4g} {model.units} at their "
            "corners"
            if format_of(output).has_node_moduli
            else "the format has one modulus per cell: the mean of the linear modulus"
        )


def _load_lines(output: Path, model: Model) -> Iterator[str]:
    """Yield lines on the loads, and on what the format makes of them."""
    for load in model.loads:
        yield f"load: {load_words(load, SHOWN_LOAD_DIGITS, model.units)}"
    if (n_steps := count_of_steps(model.loads)) > 1:
        yield f"{n_steps} steps, each from the undeformed state"
    if model.loads and not format_of(output).runs:
        yield (
            "loads are kept as text, which tetopt convert and fem read"
            if output.suffix.lower() in VTK_SUFFIXES
            else "the format defines no analysis step: loads are written as text or not at all"
        )


def _lines(output: Path, model: Model, solver: SolverOptions) -> Iterator[str]:
    form = format_of(output)
    suffix = output.suffix.lower()
    in_unit = in_units(model, solver.units, with_lengths=False)
    yield from _moduli_lines(output, in_unit)
    yield from _load_lines(output, in_unit)
    if suffix in GMSH_SUFFIXES:
        yield from _gmsh_lines(model, suffix)
    elif suffix in CELL_NUMBERS:
        lines = label_lines(model, number_parts(model)[0], CELL_NUMBERS[suffix])
        yield from lines[:MOST_LABEL_LINES]
        if len(lines) > MOST_LABEL_LINES:
            yield f"and {len(lines) - MOST_LABEL_LINES} more; the file's header lists all"
    low = model.mesh.points.min(axis=0)
    high = model.mesh.points.max(axis=0)
    ranges = zip("xyz", low, high, strict=False)
    yield (
        "the mesh lies at "
        + ", ".join(f"{axis} {a:.6g} to {b:.6g}" for axis, a, b in ranges)
        + (" mm (RAS)" if model.mesh.ndim == 3 else " mm in its plane")
    )
    length = STRESS_UNITS[solver.units].length
    space = f"{solver.space.upper()}+ {length}" if model.mesh.ndim == 3 else length

    size = f"{nodes_in_words(model.mesh, model.order)}, {len(model.mesh.cells)} cells"
    yield f"{output}: {form.what}, {space}, {solver.units}, {size}"
