"""What each option of a graded mesh trades: runs around the defaults, one option at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tetopt.engine.loop import GRADED_K_D, SHAPE_POWER
from tetopt.engine.meshing import mesh_image
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.start.sizes import COARSEST_SHARE, Sizes
from tetopt.study.compare_report import Measurement, TradeoffRow

SWEPT_OPTIONS: tuple[tuple[str, float | None, tuple[float, ...]], ...] = (  # option, its default, and values around it
    ("k_D", GRADED_K_D, (0.3, 0.5, 0.7, GRADED_K_D, 0.93)),
    ("shape power p", SHAPE_POWER, (2.0, SHAPE_POWER, 4.0, 6.0)),
    ("gradation", 1.0, (0.2, 0.5, 1.0)),
    ("largest edge, of a uniform mesh's", COARSEST_SHARE, (1.0, 1.15, COARSEST_SHARE, 2.0, 3.0)),
    ("uniform, k_D", None, (0.0, 0.2, 0.5, 0.8)),  # of another mesh than the graded one
)


def tradeoff(
    image: Image, nodes: int, measure: Callable[[Mesh], Measurement], say: Callable[[str], None]
) -> list[TradeoffRow]:
    """Meshes of about `nodes` nodes over `SWEPT_OPTIONS`, each with its measurement; the default's are made once."""
    measurements: dict[tuple[str, float] | None, Measurement] = {}  # by what is changed; None: nothing
    rows = []
    for option, default, values in SWEPT_OPTIONS:
        for value in values:
            changed = None if value == default else (option, value)
            if changed not in measurements:
                say(f"trade-off: {option} = {value:g}")
                measurements[changed] = measure(_mesh(image, nodes, option, value))
            rows.append(TradeoffRow(option, value, changed is None, measurements[changed]))
    return rows


def _mesh(image: Image, nodes: int, option: str, value: float) -> Mesh:
    """The mesh with one option changed."""
    if option == "uniform, k_D":
        return mesh_image(image, nodes, mode="uniform", k_D=value).mesh
    largest = Sizes().longest_edge(image, nodes) / COARSEST_SHARE
    changed: dict[str, dict[str, Any]] = {
        "k_D": {"k_D": value},
        "shape power p": {"shape_power": value},
        "gradation": {"sizes": Sizes(gradation=value)},
        "largest edge, of a uniform mesh's": {"sizes": Sizes(largest=largest * value)},
    }
    return mesh_image(image, nodes, **changed[option]).mesh
