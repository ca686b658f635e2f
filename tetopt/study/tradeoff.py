"""What each option of a graded mesh trades: runs around the defaults, one option at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tetopt.engine.loop import GRADED_K_D, SHAPE_POWER
from tetopt.engine.meshing import mesh_image
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.start.sizes import COARSEST_SHARE, Sizes
from tetopt.study.compare_report import ORDER_WORDS, Measurement, TradeoffRow
from tetopt.study.pipelines import with_nodes
from tetopt.study.search import corners_for

# An option, its default on a graded mesh, values around it, and what `mesh_image` gets for a value; that may depend on
# the longest edge of a uniform mesh with as many nodes, mm.
SweptOption = tuple[str, float | None, tuple[float, ...], Callable[[float, float], dict[str, Any]]]
SWEPT_OPTIONS: tuple[SweptOption, ...] = (
    ("k_D", GRADED_K_D, (0.3, 0.5, 0.7, GRADED_K_D, 0.93), lambda value, _: {"k_D": value}),
    ("shape power p", SHAPE_POWER, (2.0, SHAPE_POWER, 4.0, 6.0), lambda value, _: {"shape_power": value}),
    ("gradation", 1.0, (0.2, 0.5, 1.0), lambda value, _: {"sizes": Sizes(gradation=value)}),
    (
        "largest edge, of a uniform mesh's", COARSEST_SHARE, (1.0, 1.15, COARSEST_SHARE, 2.0, 3.0),
        lambda value, longest: {"sizes": Sizes(largest=longest * value)},
    ),
    ("uniform, k_D", None, (0.0, 0.2, 0.5, 0.8), lambda value, _: {"mode": "uniform", "k_D": value}),
)  # fmt: skip


def tradeoff(
    image: Image, nodes: int, order: int, measure: Callable[[Mesh, int], Measurement], say: Callable[[str], None]
) -> list[TradeoffRow]:
    """Meshes over `SWEPT_OPTIONS` whose cells of this order have about `nodes` nodes in all, each with its measurement.

    The default's mesh is made once.
    """
    longest = Sizes().longest_edge(image, corners_for(nodes, order)) / COARSEST_SHARE
    measurements: dict[tuple[str, float] | None, Measurement] = {}  # by what is changed; None: nothing
    rows = []
    for option, default, values, arguments in SWEPT_OPTIONS:
        for value in values:
            changed = None if value == default else (option, value)
            if changed not in measurements:
                say(f"trade-off, {ORDER_WORDS[order]} cells: {option} = {value:g}")
                measurements[changed] = measure(_meshed(image, nodes, order, arguments(value, longest)), order)
            rows.append(TradeoffRow(order, option, value, changed is None, measurements[changed]))
    return rows


def _meshed(image: Image, nodes: int, order: int, options: dict[str, Any]) -> Mesh:
    return with_nodes(lambda corners: mesh_image(image, corners, **options).mesh, lambda mesh: mesh, nodes, order)
