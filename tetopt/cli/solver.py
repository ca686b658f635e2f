"""From a mesh to a file for a solver: what `tetopt mesh` and `tetopt convert` have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape

import tetopt
from tetopt import Image, InputError, Mesh
from tetopt.cli.console import log, out, print_wide
from tetopt.io.formats import FORMATS, file_bytes, format_of, save_model
from tetopt.model.build import labels_of, model_of
from tetopt.model.laws import parse_any_law
from tetopt.model.loads import known_set, parse_load
from tetopt.model.materials import DEFAULT_NU, Spacing
from tetopt.model.model import SPACES, STRESS_UNITS, Model
from tetopt.model.sets import Box, Sets, check_free_names, merged_sets, nodes_of, parse_set, standard_sets
from tetopt.report.tables import new_table

MANY = 30_000  # materials: CalculiX takes three times as long with as many as there are cells (tests/benchmarks)


class Wishes(NamedTuple):
    """What the options say of the file."""

    young: str | None
    nu: str | None
    bins: str | None
    sets: list[str]
    loads: list[str]
    order: int
    units: str
    space: str

    def are_any(self) -> bool:
        """Whether more is asked than the mesh."""
        return self != NOTHING


NOTHING = Wishes(None, None, None, [], [], 1, "kPa", "ras")


def checked_wishes(output: Path, wishes: Wishes, has_materials: bool = False) -> None:
    """InputError for what is wrong whatever the mesh may be, asked before the work starts.

    Raises
    ------
    InputError
        A suffix, law, number of bins, unit or convention that there is not; what needs moduli without any.
    """
    found = format_of(output)
    if found.is_surface and (wishes.young or wishes.bins or wishes.sets or wishes.loads):
        raise InputError(f"{output}: holds the boundary alone; leave out --young, --bins, --set and --load")
    for name, law in (("young", wishes.young), ("nu", wishes.nu)):
        if law is not None:
            parse_any_law(law, name)
    if wishes.nu is not None and wishes.young is None and not has_materials:
        raise InputError("--nu: there is no --young")
    parsed_bins(wishes.bins)
    if wishes.units not in STRESS_UNITS:
        raise InputError(f"--units: expected {' or '.join(STRESS_UNITS)}, got {wishes.units}")
    if wishes.space not in SPACES:
        raise InputError(f"--space: expected {' or '.join(SPACES)}, got {wishes.space}")
    if wishes.order not in (1, 2):
        raise InputError(f"--order: expected 1 or 2, got {wishes.order}")
    if wishes.order == 2 and not found.has_quadratic:
        raise InputError(
            f"{output}: --order 2 is for {', '.join(s for s, f in FORMATS.items() if f.has_quadratic)} only"
        )


def parsed_bins(text: str | None) -> tuple[int | None, Spacing]:
    """Number and spacing of bins, from "K", "K:quantile" or "K:log"."""
    if text is None:
        return None, "equal"
    count, _, spacing = text.partition(":")
    spacing = spacing or "equal"
    if not count.isdecimal() or int(count) < 1 or spacing not in get_args(Spacing):
        raise InputError(f'--bins: expected K, K:quantile or K:log with K of 1 or more, got "{text}"')
    return int(count), cast(Spacing, spacing)


def built(
    mesh: Mesh, image: Image | None, wishes: Wishes, cell_data: dict[str, NDArray], about: dict[str, Any], known: Sets
) -> Model:
    """The model that the options ask for, of a mesh with the sets `known`."""
    young: Any = wishes.young
    nu: Any = wishes.nu
    if young is None and "young" in cell_data:  # painted before
        young = np.asarray(cell_data["young"], dtype=np.float64)
        nu = np.asarray(cell_data["nu"], dtype=np.float64) if nu is None and "nu" in cell_data else nu
    elif nu is None and "nu" in cell_data:
        log.print(f"nu: of --young or {DEFAULT_NU}; what the mesh's file has is left")
    fields = {name: values for name, values in cell_data.items() if name not in ("young", "nu", "material")}
    bins, spacing = parsed_bins(wishes.bins)
    return model_of(
        mesh, image, young=young, nu=nu, sets=wishes.sets, loads=wishes.loads, bins=bins, spacing=spacing,
        order=wishes.order, cell_data=fields, about={"tetopt": tetopt.__version__, **about}, known_sets=known,
    )  # fmt: skip


def all_sets(mesh: Mesh, box: Box | None, fields: dict[str, NDArray], given: Sets, is_told: bool = True) -> Sets:
    """The standard sets and those that came with the mesh; told is which of the latter had to be called otherwise."""
    found, renamed = merged_sets(standard_sets(mesh, box, labels_of(fields, len(mesh.cells))), given)
    if is_told:
        for old, new in renamed.items():
            log.print(f'the mesh came with a set "{old}" of its own: it is {new} here')
    return found


def check_early(output: Path, wishes: Wishes, image: Image, build: Callable[[Wishes], Model]) -> None:
    """InputError for what would be refused after the optimisation, as far as the initial mesh can tell.

    `build` makes a model of the initial mesh. Further sets, and interfaces, may have members in the final one alone: of
    them, and of loads on them, only the words and names are looked at.
    """
    asked = [parse_set(text, image.ndim) for text in wishes.sets]
    for wish in asked:
        if wish.kind == "below" and wish.vectors[0][0] <= image.data.min():
            raise InputError(
                f"set {wish.name}: no cell can have a mean below {wish.vectors[0][0]:g}, the image begins at "
                f"{image.data.min():g}"
            )
    taken = {name for wish in asked for name in wish.names()}
    on = [parse_load(text, image.ndim).name for text in wishes.loads]
    is_certain = not any(name in taken or name.startswith("interface_") for name in on)
    model = build(wishes._replace(sets=[], loads=wishes.loads if is_certain else []))
    for wish in asked:
        check_free_names(wish, model.sets)
    for name in on:
        if name and name not in taken and not name.startswith("interface_"):
            known_set(name, model.sets)
    file_bytes(output, model, space=wishes.space, units=wishes.units)


def save_wished(output: Path, model: Model, wishes: Wishes) -> None:
    """Write the file."""
    if model.materials is not None and len(model.materials.young) > MANY and output.suffix.lower() == ".inp":
        log.print(
            f"{len(model.materials.young)} materials make CalculiX some three times slower; --bins 32 groups them"
        )
    save_model(output, model, space=wishes.space, units=wishes.units)


def save_anyway(output: Path, model: Model, error: InputError) -> InputError:
    """Keep an optimised mesh whose model was refused, as VTU; the error to raise, which says where it is."""
    names = chain([output.stem], (f"{output.stem}_optimised_{number}" for number in count(1)))
    kept = next(path for name in names if not (path := output.with_name(f"{name}.vtu")).exists())
    save_model(kept, model)
    return InputError(f"{error}; the optimised mesh is in {kept}: go on from there with tetopt convert")


def print_model(output: Path, model: Model, wishes: Wishes) -> None:
    """What is in the file: sets, materials and the error of binning, units, coordinates."""
    for line in _lines(output, model, wishes):
        out.print(escape(line))
    if format_of(output).is_surface:
        return
    table = new_table("set", "facets", "nodes", "cells")
    for name, rows in model.sets.facets.items():
        table.add_row(escape(name), str(len(rows)), str(len(nodes_of(model.mesh, rows))), "")
    for name, members in model.sets.cells.items():
        table.add_row(escape(name), "", "", str(len(members)))
    print_wide(table)


def _lines(output: Path, model: Model, wishes: Wishes) -> Iterator[str]:
    made = None if format_of(output).is_surface else model.materials
    if made is not None:
        young, nu = made.young, made.nu
        ratios = f"{nu.min():.4g}" if nu.min() == nu.max() else f"{nu.min():.4g} to {nu.max():.4g}"
        count = f"{len(young)} material{'s' * (len(young) > 1)}"
        yield f"{count}, Young's modulus {young.min():.4g} to {young.max():.4g} kPa, nu {ratios}"
    if made is not None and made.binning is not None:
        yield f"bins: modulus off by {made.binning.mean:.2%} in the mean by volume, {made.binning.largest:.2%} at most"
    for load in () if format_of(output).is_surface else model.loads:
        where = ", ".join(f"{x:.6g}" for x in load.displacement)
        yield f"load: {load.set_name} {'held' if not load.displacement.any() else f'moved by {where} mm'}"
    if model.loads and not (format_of(output).runs or format_of(output).is_surface):
        yield "the format runs no step: the loads are in the file as text"
    low, high = model.mesh.points.min(axis=0), model.mesh.points.max(axis=0)
    ranges = zip("xyz", low, high, strict=False)
    yield (
        "the mesh lies at "
        + ", ".join(f"{axis} {a:.6g} to {b:.6g}" for axis, a, b in ranges)
        + (" mm (RAS)" if model.mesh.ndim == 3 else " mm in its plane")
    )
    space = f"{wishes.space.upper()}+ mm" if model.mesh.ndim == 3 else "mm"
    if format_of(output).is_surface:
        yield f"{output}: {format_of(output).what}, {space}"
        return
    size = f"{len(model.mesh.points)} nodes, {len(model.mesh.cells)} cells"
    yield f"{output}: {format_of(output).what}, {space}, {wishes.units}, {size}"
