"""From a mesh to a file for a solver: what `tetopt mesh` and `tetopt convert` have in common."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape

import tetopt
from tetopt import Image, InputError, Mesh
from tetopt.cli.console import log, out, print_wide
from tetopt.fem.materials import parse_any_law
from tetopt.io.formats import FORMATS, format_of, save_model
from tetopt.model.build import NU, model_of
from tetopt.model.materials import Spacing
from tetopt.model.model import SPACES, UNITS, Model
from tetopt.model.sets import nodes_of
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
        return self != Wishes(None, None, None, [], [], 1, "kPa", "ras")


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
    if wishes.units not in UNITS:
        raise InputError(f"--units: expected {' or '.join(UNITS)}, got {wishes.units}")
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
    mesh: Mesh, image: Image | None, wishes: Wishes, cell_data: dict[str, NDArray], about: dict[str, Any], **known: Any
) -> Model:
    """The model that the options ask for; `known` as of `tetopt.model.build.model_of`."""
    young: Any = wishes.young
    nu: Any = NU if wishes.nu is None else wishes.nu
    if young is None and "young" in cell_data:  # painted before
        young = np.asarray(cell_data["young"], dtype=np.float64)
        nu = np.asarray(cell_data.get("nu", np.full(len(young), NU))) if wishes.nu is None else nu
    fields = {name: values for name, values in cell_data.items() if name not in ("young", "nu", "material")}
    bins, spacing = parsed_bins(wishes.bins)
    return model_of(
        mesh, image, young=young, nu=nu, sets=wishes.sets, loads=wishes.loads, bins=bins, spacing=spacing,
        order=wishes.order, cell_data=fields, about={"tetopt": tetopt.__version__, **about}, **known,
    )  # fmt: skip


def save_wished(output: Path, model: Model, wishes: Wishes) -> None:
    """Write the file."""
    if model.materials is not None and len(model.materials.young) > MANY and output.suffix.lower() == ".inp":
        log.print(f"{len(model.materials.young)} materials, as many as cells have moduli; --bins 32 groups them")
    save_model(output, model, space=wishes.space, units=wishes.units)


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
        yield f"{len(young)} materials, Young's modulus {young.min():.4g} to {young.max():.4g} kPa, nu {ratios}"
    if made is not None and made.binning is not None:
        yield f"bins: modulus off by {made.binning.mean:.2%} in the mean by volume, {made.binning.largest:.2%} at most"
    for load in model.loads:
        where = ", ".join(f"{x:.6g}" for x in load.displacement)
        yield f"load: {load.set_name} {'held' if not load.displacement.any() else f'moved by {where} mm'}"
    if model.loads and not format_of(output).runs:
        yield "the format has no place for loads: they are in its comments"
    yield (
        f"{output}: {format_of(output).what}, {wishes.space.upper()}+ mm, {wishes.units}, "
        f"{len(model.mesh.points)} nodes, {len(model.mesh.cells)} cells"
    )
