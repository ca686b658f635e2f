"""What a run tells of its mesh: requirements that it violates, and what is allowed but hardly
meant.
"""

import re

import numpy as np
import pytest
from commands import numbers_in, run_command
from label_rows import label_row, surface_of, with_numbers

import tetopt
from tetopt.contents.labels import LostComponent
from tetopt.engine.label_state import crowded_nodes
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.job.advice import (
    beyond_requirements,
    of_empty,
    of_result,
    of_sizes,
    order_problems,
    required_of,
    sentences,
    tell,
    tell_label_sizes,
)
from tetopt.job.advice import unmet_requirements as unmet_of
from tetopt.job.events import listen_with
from tetopt.measure.fidelity import LabelPieces, MaskFidelity
from tetopt.measure.judge import LABEL_REMEDY, PIECES_REMEDY, MaskComponents, judge
from tetopt.start.label_sizes import sizes_by_label
from tetopt.start.sizes import EdgeRatios, Sizes

NEAR = MaskFidelity(9, 9.0, 9.0, 0.99, 0.1, 0.3, 0.1, 0.3, 0.1, 0.3, 0.1, 0.3, 1, 1, 2, 2)
MESH = tetopt.Mesh([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[0, 1, 2]])


def unmet(violated, word="mask", **measured):
    """Yield what is unmet, with the verdict on the measured labels."""
    rows = {name: each for name, each in measured.items() if name == "labels"}
    required = required_of(word, measured.get("label_names", {}))
    return unmet_of({**violated, **judge(rows, required)}, measured, required)


def told(*problems):
    """Tell problems, as one list; return those that have a name, and a line for each event."""
    events = []
    with listen_with(events.append):
        tell(order_problems(problems))
    return sentences(problems), "".join(event.text + "\n" for event in events)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, ""),
        (
            {"distance_p95": 8.0, "distance_mean": 2.0},
            "8.0 voxels apart at the 95th percentile, 2.0 on average",
        ),
        ({"reverse_p95": 8.0}, "8.0 voxels apart"),
        ({"distance_p95": np.nan, "reverse_p95": np.nan}, ""),
        ({"mesh_euler": -47}, ""),  # a row of the table
        ({"mesh_components": 3}, ""),  # a requirement of its own
        ({"components": 3}, "the mask has 3 connected components, the mesh 1"),
    ],
)
def test_a_mask_that_the_mesh_does_not_show(change, words):
    named, text = told(*unmet({}, mask=NEAR._replace(**change)))
    assert named == {}
    assert words in text
    assert text.count("\n") == bool(words)


def test_what_background_leaves_is_no_mask():
    words = "the mesh and the foreground overlap with a Dice of only 0.5"
    far = NEAR._replace(distance_p95=8.0, components=3, mesh_euler=99)
    named, text = told(*unmet({"mask": words}, "foreground", mask=far, dropped_components=2))
    assert named == {"mask": words}
    assert "the mask" not in text
    assert text.count("foreground") >= text.count("\n") == 4


def test_components_that_were_dropped_are_told():
    assert told(*unmet({}, mask=NEAR, dropped_components=0)) == ({}, "")
    named, text = told(*unmet({}, mask=NEAR, dropped_components=2))
    assert named == {}
    words = "dropped 2 small connected components of the mesh that are not separate in the mask"
    assert words in text
    volumes = {"mask": NEAR, "dropped_components": 2, "dropped_volumes": {"3": 1.5, "0": 2.0}}
    assert "as large as 3.5 voxels; " in told(*unmet({}, **volumes))[1]
    volumes |= {"labels": [label_of(3)], "label_names": {3: "gland"}}
    words = "as large as 3.5 voxels (label 3 (gland) 1.5, label 0 2); "
    assert words in told(*unmet({}, **volumes))[1]


def label_of(label, mesh_volume=9.0, is_lost=False, voxels=9):
    counts = {"voxels": voxels, "covered_voxels": voxels, "components": 1, "mesh_components": 1}
    numbers = {"volume": 9.0, "mesh_volume": mesh_volume, "is_lost": is_lost}
    return label_row(label, dice=0.0 if is_lost else 0.9, **counts, **numbers)


def test_labels_of_twice_or_half_their_volume_are_named_the_worst_first():
    volumes = {1: 9.0, 2: 18.5, 5: 2.0, 7: 17.9, 8: 4.6}
    rows = [label_of(*each, voxels=99) for each in volumes.items()]
    _, text = told(*unmet({}, labels=[*rows, label_of(9, 0.0, True)]))
    (line,) = (line for line in text.splitlines() if "ratio" in line)
    assert line.startswith("2 labels with more than 2 times the volume")
    assert "(ratio in brackets): 5 (0.222), 2 (2.06); allow more nodes" in line


def test_large_labels_of_another_volume_violate_a_requirement_by_name():
    """With a part of the label in the mesh, the volume is that of the part."""
    volumes = {1: 9.0, 2: 13.6, 5: 5.3, 7: 13.4, 8: 5.5}
    words = (
        "the volume of cells is not 0.6 to 1.5 times that of voxels: 0.589 for label 5 "
        f"(wall), 1.51 for label 2; {LABEL_REMEDY}"
    )
    for voxels, expected in ((200, {"labels": words}), (199, {})):
        rows = [label_of(*each, voxels=voxels) for each in volumes.items()]
        parts = [
            with_numbers(row, voxels=2 * voxels, mesh_volume=0.5 * row.extent.mesh_volume)
            for row in rows
        ]
        for each in (rows, parts):
            violated = {"labels": "by numbers"} if expected else {}
            named, text = told(*unmet(violated, labels=each, label_names={5: "wall"}))
            assert named == expected
            assert expected or "labels: " not in text


def test_components_without_a_cell_violate_a_requirement_the_largest_first():
    lost = tuple(LostComponent(n, (1.0, 2.5, 1234.56)) for n in (99, 60, 50, 50))
    rows = [
        with_numbers(label_of(3), lost_components=lost),
        with_numbers(label_of(4, is_lost=True), lost_components=lost[:2]),
    ]
    named, text = told(*unmet({}, labels=rows))
    words = named["labels"]
    assert words.startswith(
        "components of labels of 50 voxels or more without a cell, as large as 2 cells around or "
        "more: 99 voxels of label 3 at (1, 2.5,"
    )
    assert words.endswith(f"50 voxels of label 3 at (1, 2.5, 1235) mm and 1 more; {PIECES_REMEDY}")
    assert "label_weight" not in words
    assert "no cell has label" not in text  # named above
    for small in ({"voxels": 49}, {"size_in_cells": 1.9}):
        few = tuple(each._replace(**small) for each in lost)
        assert told(*unmet({}, labels=[with_numbers(rows[0], lost_components=few)]))[0] == {}
    large = [with_numbers(label_of(4, is_lost=True, voxels=200), lost_components=lost[:2])]
    assert "components" not in told(*unmet({}, labels=large))[0]["labels"]


def test_what_requirements_allow_is_counted_over_all_labels_the_worst_first():
    lost = tuple(LostComponent(n, (1.0, 2.5, 3.0)) for n in (40, 3))
    rows = [
        label_of(k, 9.0 * ratio)
        for k, ratio in enumerate((0.5, 0.86, 0.8, 1.14, 1.3, 0.1, 0.84, 1.2))
    ]
    assert beyond_requirements({"labels": [rows[1], rows[3]]}) == {}
    assert beyond_requirements({}) == {}
    for k, pieces in {
        1: LabelPieces(9, 7, lost),
        3: LabelPieces(2, 2, lost[:1]),
        5: LabelPieces(1, 1, lost[1:]),  # its cell is elsewhere
        7: LabelPieces(1, 3),
        0: LabelPieces(1, 5, lost),  # the space between tissues
    }.items():
        rows[k] = rows[k]._replace(pieces=pieces)
    assert beyond_requirements({"labels": rows, "label_names": {5: "rib"}}) == {
        "not all labels fit: 5 (rib), 0, 4, 2, 7 and 3 more": "labels: of 7 and label 0, 6 with "
        "less than 0.85 or more than 1.15 times the volume of "
        "voxels (matters for stiffness and mass): "
        "5 (rib) (0.1), 0 (0.5), 4 (1.3), 2 (0.8), 7 (1.2) and 1 more; "
        "3 with components without a cell (matters if these carry load): "
        "1 (2 of 9, voxels: 43), 3 (1 of 2, voxels: 40), 5 (rib) (1 of 1, voxels: 3); "
        "1 with more pieces of cells than of voxels (matters for what is connected): 7 (3 for 1)"
    }
    crumbs = tuple(each._replace(size_in_cells=1.9) for each in lost)
    rows = [rows[1]._replace(pieces=LabelPieces(154, 14, crumbs, 9))]
    assert beyond_requirements({"labels": rows}) == {}  # the table has both numbers


def test_pieces_that_merge_and_cavities_that_open_are_counted():
    """Components that are lost do not merge; of a label partly beyond the mesh, and of label 0,
    nothing is known.
    """
    lost = tuple(LostComponent(n, (1.0, 2.5, 3.0)) for n in (40, 3))
    counts = {
        0: (9, 1, ()),
        1: (3, 1, lost),
        2: (3, 2, ()),
        3: (9, 3, lost),
        4: (9, 2, ()),
        5: (9, 0, ()),
        6: (1, 1, ()),
    }
    rows = [label_of(k)._replace(pieces=LabelPieces(*count)) for k, count in counts.items()]
    rows[4] = with_numbers(rows[4], voxels=18, mesh_volume=4.5)
    cavities = {0: (5, 1), 2: (1, 1), 3: (1, 2), 4: (1, 0), 5: (1, 0), 6: (3, 1)}
    for k, (n, left) in cavities.items():
        rows[k] = rows[k]._replace(surface=surface_of(k, cavities=n, mesh_cavities=left))
    (line,) = beyond_requirements({"labels": rows}).values()
    assert line == (
        "labels: of 6 and label 0, 2 with components without a cell (matters if these carry load): "
        "1 (2 of 3, voxels: 43), 3 (2 of 9, voxels: 43); "
        "2 with fewer pieces of cells than of voxels (matters for what is connected): "
        "3 (3 for 7 of 9), 2 (2 for 3); "
        "1 with fewer cavities in cells than in voxels (matters for fluid in them): 6 (1 of 3)"
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mesh_volume": 8.6}, ""),
        (
            {"mesh_volume": 8.5},
            "with less than 0.95 or more than 1.05 times the volume of voxels (matters for "
            "stiffness and mass) (0.944)",
        ),
        (
            {"mesh_volume": 9.5},
            "with less than 0.95 or more than 1.05 times the volume of voxels (matters for "
            "stiffness and mass) (1.06)",
        ),
        (
            {
                "components": 4,
                "lost_components": (LostComponent(7, (0.0, 0.0)), LostComponent(2, (1.0, 0.0))),
            },
            "with components without a cell (matters if these carry load) (2 of 4, voxels: 9); "
            "with fewer pieces of cells than of voxels (matters for what is connected) "
            "(1 for 2 of 4)",
        ),
    ],
)
def test_what_requirements_allow_of_a_mask(change, words):
    beyond = beyond_requirements({"mask": NEAR._replace(**change)}, "foreground")
    assert beyond == ({"not all of the foreground fits": f"foreground: {words}"} if words else {})


@pytest.mark.parametrize("word", ["foreground", "mask"])
@pytest.mark.parametrize("numbers", [{"mesh_volume": 2.0}, {"dice": 0.1}, {"dice": 0.0}])
def test_voxels_without_a_label_in_a_foreground_violate_nothing(word, numbers):
    """They are no tissue; what is lost is told, with the options that leave them out."""
    air = with_numbers(label_of(0, voxels=300), **numbers)
    named, text = told(*unmet({}, word, labels=[air]))
    is_mask = word == "mask"
    assert ("labels" in named) == (is_mask and numbers != {"dice": 0.1})
    assert ("allow more nodes" in text) == is_mask
    assert ("0 (voxels without a label, enclosed or bright)" in text) == (
        not is_mask and "dice" in numbers
    )
    options = "`keep_labels` names the tissues, `background` auto"
    assert (options in text) == (not is_mask and "dice" in numbers)


def test_labels_that_cells_cannot_show_violate_nothing():
    """Smaller than two mean cells around them, or in such pieces: their row tells it."""
    lost = label_of(3, 0.0, True, voxels=300)
    for size, expected in ((1.9, []), (2.0, ["labels"])):
        row = with_numbers(lost, size_in_cells=size)
        assert list(told(*unmet({}, labels=[row]))[0]) == expected


def test_labels_that_lie_outside_the_mesh_are_told_once():
    """They need no cell, and more nodes would not help; nor does label 0, the space around it."""
    rows = [label_of(k, 0.0, k > 1, voxels=1000) for k in range(7)]
    for covered, names, n_told in ((499, [], 1), (500, ["labels"], 0)):
        outside = [with_numbers(row, covered_voxels=covered) for row in rows[:1]]
        named, text = told(*unmet({}, labels=outside))
        assert list(named) == names
        outside = [with_numbers(row, covered_voxels=covered * (covered > 499)) for row in rows]
        named, text = told(*unmet({}, labels=outside))
        assert list(named) == names
        part = "the mesh covers a part of the labels' image: of 6 labels, less than half lies in it"
        assert text.count(f"{part}: 1, 2, 3, 4, 5 and 1 more\n") == n_told
        assert text.count("\n") == 1
    assert beyond_requirements({"labels": [with_numbers(rows[3], covered_voxels=499)]}) == {}


@pytest.mark.parametrize(("word", "is_told"), [("foreground", True), ("mask", False)])
def test_a_foreground_of_more_than_the_body_asks_for_a_higher_background(word, is_told):
    required = required_of(word, {})
    rows = {"components": MaskComponents(2, (90, 8, 3), (), ())}
    words = judge(rows, required)["components"]
    assert ("use a higher `background` or a `mask`" in words) == is_told
    assert words.endswith("allow more nodes")


def test_more_nodes_do_not_help_crumbs():
    few = label_of(3, 2.0)
    for components, n_remedies in ((1, 1), (5, 0)):
        row = with_numbers(few, voxels=90, covered_voxels=90, components=components)
        assert told(*unmet({}, labels=[row]))[1].count("allow more nodes") == n_remedies


def ended(E=0.5, E_D=0.5):
    history = [
        IterationRecord(0, 1.0, 1.0, 1.0, 0.0, False, 1, 1, 0.0),
        IterationRecord(1, E, 1.0, E_D, 0.1, False, 1, 1, 0.1),
    ]
    return MeshingResult(MESH, history, "iterations", MESH)


def started_only():
    return MeshingResult(MESH, ended().history[:1], "iterations", MESH)


@pytest.mark.parametrize(
    ("result", "mode", "nodes", "measured", "words"),
    [
        (ended(), "graded", 101, {}, ""),
        (ended(), "graded", 120, {}, "100 nodes instead of 120; use more iterations\n"),
        (ended()._replace(ended="converged"), "graded", 120, {}, "100 nodes instead of 120\n"),
        (
            started_only(),
            "graded",
            120,
            {},
            "100 nodes instead of 120, as no iteration was made; allow some",
        ),
        (
            ended(),
            "graded",
            80,
            {"nodes_of_sizes": 107},
            "the target sizes need about 107; set `nodes` to that",
        ),
        (ended(E_D=1.2), "start", None, {}, "E_D rose to 1.200 times its initial value"),
        (ended(E_D=1.2), "graded", None, {}, ""),
        (
            ended(),
            "graded",
            120,
            {"cells_without_voxel": 1},
            "nodes instead of 120: most cells contain no voxel centre",
        ),
        (
            ended(),
            "graded",
            None,
            {"nodes_of_many_labels": 3},
            "more than 4 labels meet at 3 nodes",
        ),
    ],
)
def test_what_is_hardly_meant(result, mode, nodes, measured, words):
    _, text = told(*of_result(result, "fast", mode, 100, nodes, measured))
    assert words in text
    assert text.count("\n") == bool(words)


@pytest.mark.parametrize(
    ("n_nodes", "nodes", "measured", "is_told"),
    [
        (200, 100, {"mask": NEAR}, True),
        (200, 100, {}, False),
        (400, 350, {"mask": NEAR}, False),
        (80, 100, {"mask": NEAR}, False),
    ],
)
def test_thin_walls_are_the_reason_of_a_large_initial_mesh(n_nodes, nodes, measured, is_told):
    many = tetopt.Mesh(np.vstack([MESH.points, np.zeros((497, 2))]), MESH.cells)
    result = ended()._replace(initial=many)
    _, text = told(*of_result(result, "fast", "graded", n_nodes, nodes, measured))
    reason = " (the initial mesh has 500, to keep thin walls of the mask)" * is_told
    assert text.startswith(f"{n_nodes} nodes instead of {nodes}{reason}; ")


def test_remedies_of_a_missed_number_of_nodes_are_those_that_apply():
    for k_D, has_sizes, nodes, words in (
        (0.0, True, 120, "use more iterations or a `k_D` above 0 or smaller sizes"),
        (0.85, True, 80, "use more iterations or larger sizes"),
        (0.0, False, 80, "use more iterations or a `k_D` above 0"),
    ):
        _, text = told(*of_result(ended(), "fast", "graded", 100, nodes, {}, k_D, has_sizes))
        assert text == f"100 nodes instead of {nodes}; {words}\n"


@pytest.mark.parametrize("words", ["", "--edge-max 40"])
def test_only_requested_sizes_are_a_remedy(here, words):
    """Order 2 has sizes of its own, which nobody asked for."""
    tetopt.save_image("a.nii.gz", tetopt.load_phantom("sphere").image(voxel_mm=4))
    few = "mesh a.nii.gz -o a.vtu --nodes 400 --order 2 --iterations 1"
    err = run_command(f"{few} {words}").err
    assert "nodes instead of 400; use more iterations" in err
    assert (" sizes" in err) == bool(words)


@pytest.mark.parametrize(
    ("edge_size", "word", "is_more"), [(None, "at least", True), (6.0, "about", False)]
)
def test_nodes_that_do_not_suffice_are_called_the_least(edge_size, word, is_more):
    """More nodes make all other cells smaller, so that sizes take more; not if other cells have
    a size.
    """
    data = np.zeros((24, 24, 24))
    data[4:20, 4:20, 4:20], data[10:13, 4:20, 4:20] = 1.0, 2.0
    what = tetopt.content(tetopt.Image(data), tetopt.Image(data))
    sizes, events = Sizes(cells_across=1, edge_size=edge_size), []
    made = sizes_by_label(sizes, what, 100)
    assert (sizes_by_label(sizes, what, made.nodes).scale > 1.0) == is_more
    with listen_with(events.append):
        tell_label_sizes(made)
    assert f"sizes by label require {word} {made.nodes} nodes" in events[0].text


def test_cells_between_thick_slices_are_no_reason_for_fewer_nodes():
    _, text = told(*of_empty(ended(), True, 1, np.ones(3), is_masked=True))
    assert "nearest voxel's value, which is harmless unless moduli come from the image\n" in text
    _, text = told(*of_empty(ended(), True, 1, np.ones(3), is_masked=True, has_moduli=True))
    assert "moduli" in text
    assert "harmless" not in text
    for slices, words in ((1.5, "; reduce `nodes`"), (5.5, "slices are 5.5 mm apart")):
        _, text = told(*of_empty(ended(), True, 1, np.array([1.0, 1.0, slices])))
        assert "1 of 1 cells contain no voxel centre" in text
        assert words in text
        assert ("reduce `nodes`" in text) == (slices < 2.0)


@pytest.mark.parametrize(
    ("limits", "shortest", "longest", "above", "words"),
    [
        ({"longest": 24.0, "smallest": 2.0}, 2.0, 24.0, 0.05, ""),
        ({"longest": 24.0}, 1.0, 28.8, None, "the longest edge is 28.8 mm, 20% over `edge_max` 24"),
        ({"smallest": 2.0}, 1.5, 28.8, None, "the shortest edge is 1.5 mm, 25% under `size_min` 2"),
        (
            {"edge_size": 5.0},
            1.5,
            28.8,
            0.4,
            "40% of the edges are longer than 1.41 times their target size",
        ),
    ],
)
def test_limits_and_targets_that_edges_miss(limits, shortest, longest, above, words):
    edges = None if above is None else EdgeRatios(1.2, above, 0.0, (), [])
    _, text = told(*of_sizes(Sizes(**limits), shortest, longest, edges))
    assert words in text
    assert bool(text) == bool(words)
    assert "raise" not in text  # which makes all cells larger


def test_nodes_between_many_labels():
    fan = np.array([[0, k, k + 1] for k in range(1, 7)])
    assert crowded_nodes(fan, np.array([5, 4, 3, 2, 2, 1])) == 1
    assert crowded_nodes(fan, np.array([5, 4, 3, 2, 2, 2])) == 0


def test_every_cell_without_a_voxel_is_told(here):
    rng = np.random.default_rng(3)
    tetopt.save_image("noise.nii.gz", tetopt.Image(rng.normal(size=(20, 20))))
    tetopt.save_image("halves.nii.gz", tetopt.Image(np.indices((20, 20))[0] // 10 + 1.0))
    command = "mesh noise.nii.gz --nodes 200 -o a.vtu --json a.json --force"
    out, err = run_command(f"{command} --uniform")
    numbers = numbers_in("a.json")
    n_empty = (tetopt.load_mesh("a.vtu").cell_data["n_voxels"] == 0).sum()
    assert numbers["cells_without_voxel"] == n_empty > 0
    (row,) = re.findall("^cells without a voxel centre.*", out, re.MULTILINE)
    assert row.split()[-1] == str(n_empty)
    assert numbers["violated"] == {}
    assert "nearest voxel's value; reduce --nodes" in " ".join(err.split())
    for words in (
        "--uniform --labels halves.nii.gz",  # interfaces make such cells, and labels need nodes
        "--edge-size 1.6 --iterations 2",
    ):
        err = run_command(f"{command} {words}").err
        assert ("sizes require about 3" in err) == ("edge" in words)
        assert "contain no voxel centre" in err
        assert "reduce" not in err
