"""Printed numbers of small images."""

import io
from types import SimpleNamespace

import numpy as np
from rich.console import Console

from tetopt.measure.quality import quality
from tetopt.report.tables import add_quality, contacts_in_words, mask_table, new_table


def printed(table):
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


def test_micro_ct_keeps_three_digits():
    """A cell of 0.05 mm, a mask of 0.0579 mm3, and its distances."""
    table = new_table("", "mesh")
    add_quality(
        table, quality(0.05 * np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 1, 2, 3]]))
    )
    assert "2.08e-05" in printed(table)
    mask = SimpleNamespace(
        volume=0.0579,
        mesh_volume=0.0558,
        dice=0.98,
        distance_mean=0.1,
        distance_p95=0.2,
        distance_mean_mm=0.00211,
        distance_p95_mm=0.00422,
        reverse_mean=0.1,
        reverse_p95=0.2,
        reverse_mean_mm=0.00211,
        reverse_p95_mm=12.3456,
        components=1,
        mesh_components=1,
        euler=2,
        mesh_euler=2,
    )
    text = printed(mask_table(mask, 3, "mask"))
    for number in ("0.0579", "0.0558 (-3.6 %)", "0.00211, 0.00422 mm", "0.00211, 12.346 mm"):
        assert number in text
    assert "0.0123 mm2, including 0.0 mm2" in contacts_in_words(
        {"excess_mm2": 0.0123, "false_mm2": 0.0}, 3
    )
