"""Lines as users see them: none wider than 100 columns, in a pipe or a wide terminal; long
tables end in a count.
"""

import numpy as np
import pytest
from commands import run_command
from label_rows import label_row, surface_of, with_numbers
from models import sample_image

import tetopt
import tetopt.cli.console as console
from tetopt.measure.fidelity import LabelInterface, Thickness
from tetopt.report.tables import worst_labels

N_LABELS = 300


@pytest.fixture(autouse=True)
def real_width(monkeypatch, wide_lines):
    monkeypatch.setattr(console, "LINE_WIDTH", 100)


@pytest.fixture
def labels():
    thick = Thickness(10.25, 12.34, 23.45, 30.0)
    number = {
        name: 1.0 if name.endswith("o") or name == "folded" else 7
        for name in LabelInterface._fields[1:]
    }
    rows = [
        label_row(
            100000 + k,
            voxels=12345678,
            covered_voxels=12345678,
            volume=1234567.89,
            mesh_volume=1234567.89,
            n_cells=123456,
            dice=1.0 - 0.001 * k,
            volume_dice=0.9,
            dice_majority=0.8,
            distance_mean=123.456,
            distance_p95=123.456,
            distance_max=123.4,
            components=12,
            mesh_components=11,
            one_layer_fraction=0.5,
            thickness_voxels=thick,
            thickness_mesh=thick,
            edge=12.34,
            cells_across=1.234,
        )._replace(surface=surface_of(100000 + k, **number))
        for k in range(N_LABELS)
    ]
    names = {row.label: f"left superior temporal gyrus, part {row.label}" for row in rows}
    return {"labels": rows, "interfaces": [row.surface for row in rows], "label_names": names}


@pytest.mark.parametrize("every", [False, True])
def test_tables_of_hundreds_of_labels(labels, capsys, every):
    console.print_fidelity(labels, 3, every=every)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    table = lines[
        : next(k for k, line in enumerate(lines) if "area" in line or "thickness of" in line)
    ]
    shown = [line for line in table if " left superior" in line]
    assert all("12345678" in line for line in shown)  # numbers are whole
    if every:
        assert len(shown) == N_LABELS
    else:
        assert len(shown) == 12
        assert shown[-1].startswith(f"{100000 + N_LABELS - 1} left")  # the worst
        assert any("12 of 300 labels that fit worst, by Dice or volume" in line for line in lines)


def test_narrow_terminals_cut_no_number(labels, capsys, monkeypatch):
    rows = []
    for width in (60, 200):
        monkeypatch.setattr(console, "LINE_WIDTH", width)
        console.print_fidelity(labels, 3, every=True)
        lines = capsys.readouterr().out.splitlines()
        rows.append([line.split() for line in lines if " left superior" in line])
    assert rows[0] == rows[1]
    assert len(rows[0]) > 2 * N_LABELS


def test_a_label_of_another_volume_is_among_the_worst(labels):
    """Its Dice by voxels may be 1: its one voxel lies in its one cell, of a tenth of the voxel's
    volume.
    """
    rows = labels["labels"]
    rows[3] = with_numbers(rows[3], mesh_volume=0.1 * rows[3].extent.volume)
    assert 3 in worst_labels(rows)
    assert len(worst_labels(rows)) == 12
    rows[3] = with_numbers(rows[3], covered_voxels=0)  # outside the mesh
    assert 3 not in worst_labels(rows)


def test_a_run_prints_ten_rows_and_quality_all_of_them(here):
    tetopt.save_image("a.nii.gz", sample_image(3))
    said = run_command("mesh a.nii.gz -o a.vtu --spacing 6 --iterations 0")
    table = said.out.partition("\nall requirements")[0].splitlines()[1:]
    assert 8 <= len(table) <= 10
    assert not [line for line in table if "error (" in line or "bad cells" in line]
    assert max(map(len, "".join(said).splitlines())) <= 100
    words = "rho error (iv), worst", "bad cells: slivers"
    for option, is_shown in (("", False), ("--all", True)):
        out = run_command(f"quality a.vtu --image a.nii.gz {option}").out
        assert [word in out for word in words] == [is_shown] * 2


def test_messages_wrap_between_words_and_errors_stay_on_a_line(capsys):
    path = "/long/" + 12 * "directory/" + "a.nii.gz"
    console.show_warning(f"{path}: " + 30 * "word ")
    warning = capsys.readouterr().err.splitlines()
    assert len(warning) > 2
    assert all(len(line) <= 100 or path in line for line in warning)
    assert all(line.startswith("  ") for line in warning[1:])
    console.show_error(f"{path}: " + 30 * "word ")
    assert capsys.readouterr().err.count("\n") == 1  # for programs
    console.print_line(20 * "seven, ")
    assert np.max([len(line) for line in capsys.readouterr().out.splitlines()]) <= 100
