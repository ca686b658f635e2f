"""Trade-offs of a graded mesh's options: runs around the defaults, one option at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tetopt.engine.loop import GRADED_K_D, QUADRATIC_GRADATION, QUADRATIC_RATIO, SHAPE_POWER
from tetopt.engine.meshing import mesh_image
from tetopt.image import Image
from tetopt.job.events import note
from tetopt.mesh import Mesh
from tetopt.start.sizes import COARSEST_RATIO, Sizes
from tetopt.study.compare_report import ORDER_WORDS, Measurement, TradeoffRow

# An option, its defaults and values around them by order of the cells, and the arguments of `mesh_image` for a value.
SweptOption = tuple[str, dict[int, float | None], dict[int, tuple[float, ...]], Callable[[float], dict[str, Any]]]
SWEPT_OPTIONS: tuple[SweptOption, ...] = (
    ("k_D", dict.fromkeys((1, 2), GRADED_K_D), dict.fromkeys((1, 2), (0.3, 0.5, 0.7, GRADED_K_D, 0.93)),
     lambda value: {"k_D": value}),
    ("shape power p", dict.fromkeys((1, 2), SHAPE_POWER), dict.fromkeys((1, 2), (2.0, SHAPE_POWER, 4.0, 6.0)),
     lambda value: {"shape_power": value}),
    ("gradation", {1: 1.0, 2: QUADRATIC_GRADATION}, {1: (0.2, 0.5, 1.0), 2: (0.2, QUADRATIC_GRADATION, 0.9)},
     lambda value: {"sizes": Sizes(gradation=value)}),
    ("largest edge, of a uniform mesh's", {1: COARSEST_RATIO, 2: QUADRATIC_RATIO},
     {1: (1.0, 1.15, COARSEST_RATIO, 2.0, 3.0), 2: (0.9, 1.0, QUADRATIC_RATIO, 1.3, 1.6)},
     lambda value: {"sizes": Sizes(coarsest=value)}),
    ("uniform, k_D", dict.fromkeys((1, 2)), dict.fromkeys((1, 2), (0.0, 0.2, 0.5, 0.8)),
     lambda value: {"mode": "uniform", "k_D": value}),
)  # fmt: skip


def tradeoff(image: Image, nodes: int, order: int, measure: Callable[[Mesh, int], Measurement]) -> list[TradeoffRow]:
    """Mesh and measure `SWEPT_OPTIONS`, with about `nodes` nodes in total for cells of this order.

    The default's mesh is built once.
    """
    measurements: dict[tuple[str, float] | None, Measurement] = {}  # by the changed option; None: the defaults
    rows = []
    for option, defaults, values, arguments in SWEPT_OPTIONS:
        for value in values[order]:
            changed = None if value == defaults[order] else (option, value)
            if changed not in measurements:
                note(f"trade-off, {ORDER_WORDS[order]} cells: {option} = {value:g}")
                mesh = mesh_image(image, nodes, order=order, **arguments(value)).mesh
                measurements[changed] = measure(mesh, order)
            rows.append(TradeoffRow(order, option, value, changed is None, measurements[changed]))
    return rows
