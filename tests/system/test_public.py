"""Whatever is given to `tetopt.NAME`: one line that says what is expected, or it is taken."""

import inspect
import re
from pathlib import Path

import nibabel
import numpy as np
import pytest

import tetopt
from tetopt.io.images import load_image
from tetopt.system.public import check_arguments

IMAGE = tetopt.Image(np.random.default_rng(0).normal(size=(6, 7, 8)))
MESH = tetopt.Mesh([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4]], [[0, 1, 2, 3]])
MODEL = tetopt.build_model(MESH, young=3.0)
LABELS = tetopt.Image(np.arange(6 * 7 * 8).reshape(6, 7, 8) % 3)
# Right arguments of each function, by name; those of files are made by the tests of `tetopt.io`.
RIGHT = {
    "E_D": {"image": IMAGE, "mesh": MESH},
    "E_G": {"points": MESH.points, "cells": MESH.cells},
    "resample_contrast": {"other": IMAGE, "image": IMAGE},
    "resample_labels": {"labels": LABELS, "image": IMAGE},
    "resample_mask": {"mask": LABELS, "image": IMAGE},
    "cell_fields": {"mesh": MESH, "image": IMAGE},
    "field_on_image": {"mesh": MESH, "values": MESH.points, "image": IMAGE},
    "warped_image": {"mesh": MESH, "displacement": 0.0 * MESH.points, "image": IMAGE},
    "cell_labels": {"labels": LABELS, "mesh": MESH},
    "cell_moments": {"image": IMAGE, "mesh": MESH},
    "cell_of_voxel": {"image": IMAGE, "mesh": MESH},
    "check_mesh": {"mesh": MESH, "image": None},
    "content": {"images": [IMAGE], "weights": [1.0]},
    "foreground_mask": {"image": IMAGE, "level": 0.5, "labels": LABELS},
    "label_contacts": {"labels": LABELS, "mesh": MESH, "of_cell": [1], "mask": None},
    "label_fidelity": {"labels": LABELS, "mesh": MESH, "mask": None},
    "label_interfaces": {"labels": LABELS, "mesh": MESH, "of_cell": [1], "mask": None},
    "label_thickness": {"what": tetopt.content(LABELS, LABELS), "mesh": MESH, "of_cell": [1]},
    "lattice_mesh": {"image": IMAGE, "nodes": 100, "spacing": None},
    "load_image": {"path": "a.nii", "volume": 0},
    "load_label_table": {"path": "a.txt"},
    "load_mesh": {"path": "a.vtu"},
    "load_phantom": {"name_or_path": "a.toml"},
    "mask_fidelity": {"mask": LABELS, "mesh": MESH},
    "merge_labels": {"labels": LABELS, "merge": "a=1; b=*", "names": {1: "c"}},
    "mesh_image": {
        "image": IMAGE,
        "nodes": 100,
        "target_error": None,
        "nodes_max": None,
        "start": None,
        "spacing": None,
        "sizes": None,
        "mode": "graded",
    },
    "build_model": {"mesh": MESH, "image": IMAGE, "sets": ["a=x<1"], "bins": 3, "order": 1},
    "octree_mesh": {"image": IMAGE, "nodes": 100, "sizes": None},
    "optimize": {
        "image": IMAGE,
        "mesh": MESH,
        "k_D": 0.2,
        "iterations": 1,
        "nodes": None,
        "boundary": "slide",
    },
    "optimize_paper": {"image": IMAGE, "mesh": MESH, "k_D": 0.2, "iterations": 1},
    "plan": {"job": tetopt.Job(images="a.nii", output="a.vtu")},
    "quality": {"points": MESH.points, "cells": MESH.cells},
    "read_frd": {"path": "a.frd", "mesh": MESH},
    "register_format": {"suffix": ".a", "write": str, "what": "a", "runs": True},
    "read": {"job": tetopt.Job(images="a.nii", output="a.vtu")},
    "resample_tissue": {"tissue": IMAGE, "image": IMAGE},
    "run": {"job": tetopt.Job(images="a.nii", output="a.vtu")},
    "run_cohort": {"subjects": "t.tsv", "output": "out"},
    "save_image": {"path": "a.nii", "image": IMAGE},
    "save_mesh": {"path": "a.vtu", "mesh": MESH, "cell_data": {}, "order": 1},
    "save_model": {"path": "a.inp", "model": MODEL, "space": "ras"},
    "save_surface": {"path": "a.stl", "about": "", "space": "ras"},
    "segment": {"image": IMAGE, "mesh": MESH, "classes": 2},
    "sizes_by_label": {
        "sizes": tetopt.Sizes(cells_across=1),
        "image": tetopt.content(LABELS, LABELS),
        "nodes": 100,
    },
    "solution_fields": {"mesh": MESH, "step": 1},
    "solve": {"model": MODEL, "step": 1},
    "tissue_labels": {"tissues": [IMAGE]},
    "extract_surface": {"points": MESH.points, "cells": MESH.cells, "chosen": [True]},
}
WRONG = {
    "a text": "x.nii.gz",
    "a path": Path("x.nii.gz"),
    "an array": np.zeros((3, 4, 5)),
    "no axis": np.array(1.0),
    "nibabel's": nibabel.Nifti1Image(np.zeros((3, 4, 5), np.float32), np.eye(4)),
    "None": None,
    "a list": [1, 2, 3],
    "lists": [[1, 2], [3]],
    "a number": 500,
    "a fraction": 0.5,
    "NaN": float("nan"),
    "a bool": True,
    "digits": 10**5000,
    "a class": dict,
    "a set": {1},
}


def test_every_public_function_is_in_the_table():
    functions = {name for name in tetopt.__all__ if inspect.isfunction(getattr(tetopt, name))}
    assert functions == set(RIGHT)
    for name in functions:
        assert set(RIGHT[name]) <= set(inspect.signature(getattr(tetopt, name)).parameters)


# Classes in the fields of public records that the package alone looks into: they are handed on as
# they are.
INNER = {"Continuation", "Memberships", "PhantomVoxels", "Region", "System"}
INNER |= {"JobOptions", "SmoothLabels", "Source", "Spread"}  # of runs and contents


def classes():
    """The names of all classes of the package."""
    texts = [
        path.read_text(encoding="utf-8") for path in Path(tetopt.__file__).parent.rglob("*.py")
    ]
    return {name for text in texts for name in re.findall(r"^class (\w+)", text, re.M)}


def annotations_of(thing):
    """What a function takes and returns; what a class's fields are, and its public methods take
    and return.
    """
    if inspect.isfunction(thing):
        return thing.__annotations__
    methods = inspect.getmembers(
        thing, lambda member: inspect.isfunction(member) or isinstance(member, property)
    )
    functions = [
        getattr(member, "fget", member) for name, member in methods if not name.startswith("_")
    ]
    return getattr(thing, "__annotations__", {}) | {
        f"{function.__name__}.{key}": value
        for function in functions
        for key, value in function.__annotations__.items()
    }


def test_every_type_of_a_public_name_is_public():
    """Whatever class an annotation of a public function, record, or method names."""
    names, missing = classes(), set()
    for name in sorted({*tetopt.__all__} - {"__version__"}):
        for what, annotation in annotations_of(getattr(tetopt, name)).items():
            text = getattr(annotation, "__forward_arg__", str(annotation))
            kinds = set(re.findall(r"[A-Za-z_]\w*", text)) & names
            missing |= {f"{kind}, of {name}: {what}" for kind in kinds - {*tetopt.__all__, *INNER}}
    assert missing == set()


@pytest.mark.parametrize("name", RIGHT)
def test_right_kinds_are_taken_and_wrong_ones_are_one_line(name):
    """Each argument is replaced by all that it can hardly be: no error but InputError, on one
    line that names it.
    """
    function = inspect.unwrap(getattr(tetopt, name))
    check_arguments(function, RIGHT[name])
    for argument in RIGHT[name]:
        lines = []
        for value in WRONG.values():
            try:
                check_arguments(function, {argument: value})
            except tetopt.InputError as error:
                lines.append(str(error))
        assert len(lines) >= 8
        assert all(line.startswith(f"{name}: {argument}: expected ") for line in lines)
        assert all("\n" not in line and len(line) < 300 for line in lines)


@pytest.mark.parametrize("what", ["a text", "nibabel's", "None"])
def test_what_is_no_image_is_told_how_to_become_one(what):
    with pytest.raises(
        tetopt.InputError, match=r"expected (an )?(Image|Mesh).*, got .*; use tetopt\.(load|Image)"
    ):
        tetopt.mesh_image(WRONG[what], 500)


def test_records_are_looked_into():
    with pytest.raises(
        tetopt.InputError, match=r"mesh_image: sizes\.edge_size: expected a number or None, got '5'"
    ):
        tetopt.mesh_image(IMAGE, 100, sizes=tetopt.Sizes(edge_size="5"))
    with pytest.raises(
        tetopt.InputError, match=r"sizes\.field: expected Image or None, got 'a\.nii'"
    ):
        tetopt.octree_mesh(IMAGE, 100, tetopt.Sizes(field="a.nii"))
    words = r"cell_moments: image: expected Image, got .*Content; use .* image of a Content"
    with pytest.raises(tetopt.InputError, match=words):
        tetopt.cell_moments(tetopt.content(IMAGE), MESH)


@pytest.mark.parametrize(
    "arrays",
    [("x", [[0, 1, 2]]), ([[0, 0], [1]], [[0, 1, 2]]), (None, None), ({}, set()), (dict, 1)],
)
def test_a_mesh_of_anything(arrays):
    with pytest.raises(tetopt.InputError, match="mesh"):
        tetopt.Mesh(*arrays)


def test_tables_are_looked_into_as_records_are():
    """Sizes by label that are no table, and names of labels that are none."""
    with pytest.raises(
        tetopt.InputError,
        match=r"^sizes_by_label: sizes\.by_label: expected dict.* or None, got 5$",
    ):
        tetopt.sizes_by_label(tetopt.Sizes(by_label=5), tetopt.content(LABELS, LABELS))
    with pytest.raises(
        tetopt.InputError, match=r"^merge_labels: names: expected dict.* or None, got 500$"
    ):
        tetopt.merge_labels(LABELS, "a=foo; b=*", 500)


def test_an_image_of_anything():
    for value in (each for what, each in WRONG.items() if what != "an array"):
        with pytest.raises(tetopt.InputError, match="image data: "):
            tetopt.Image(value)


def test_a_decorated_function_is_looked_at():
    with pytest.raises(
        tetopt.InputError, match=r"^solve: model: expected Model, got .*; use tetopt\.build_model"
    ):
        tetopt.solve("x.vtu")


def warning_calls(folder):
    """Calls that warn, at several depths within tetopt."""
    tetopt.save_image(folder / "even.nii", tetopt.Image(np.ones((3, 4, 5))))
    tetopt.save_image(
        folder / "large.nii", tetopt.Image(IMAGE.data, np.diag([900.0, 900.0, 900.0, 1.0]))
    )
    sets, loads = ["low=plane:0,0,0:0,0,1:0.1"], ["hold:low"]
    tetopt.save_model(folder / "a.vtu", tetopt.build_model(MESH, young=3.0, sets=sets, loads=loads))
    loaded = tetopt.load_mesh(folder / "a.vtu")
    own = loaded._replace(sets=loaded.sets._replace(facets={}))
    return {
        "save_model": lambda: tetopt.save_model(
            folder / "a.inp", tetopt.build_model(MESH, young=3.0, nu=0.46)
        ),
        "save_mesh": lambda: tetopt.save_mesh(folder / "b.vtk", MESH, {"a\nb": np.ones(1)}),
        "load_image": lambda: tetopt.load_image(folder / "even.nii"),
        "load_image, of a large one": lambda: tetopt.load_image(folder / "large.nii"),
        "build_model": lambda: tetopt.build_model(own),
    }


def test_a_warning_names_the_line_of_who_called(tmp_path):
    """Whichever of tetopt's functions issued it, and also without the one that checks arguments."""
    calls = warning_calls(tmp_path) | {"not checked": lambda: load_image(tmp_path / "even.nii")}
    for name, call in calls.items():
        with pytest.warns(UserWarning, match=r"\w: ") as caught:
            call()
        assert {Path(each.filename) for each in caught} == {Path(__file__)}, name


@pytest.mark.parametrize(
    ("points", "cells", "message"),
    [
        (
            np.where(MESH.points == 4.0, np.nan, MESH.points),
            MESH.cells,
            "points: expected finite coordinates",
        ),
        (
            np.where(MESH.points == 4.0, np.inf, MESH.points),
            MESH.cells,
            "points: expected finite coordinates",
        ),
        (MESH.points, MESH.cells + 1, r"cells: expected indices in 0\.\.3, got 1\.\.4"),
        (MESH.points, MESH.cells - 1, r"cells: expected indices in 0\.\.3, got -1\.\.2"),
        (MESH.points, MESH.cells.astype(float), "cells: expected integers, got float64"),
        (MESH.points, MESH.cells == 1, "cells: expected integers, got bool"),
        (MESH.points, MESH.cells[:0], r"cells: expected shape \(M, 4\) with M > 0, got \(0, 4\)"),
        (MESH.points, MESH.cells[:, :3], r"cells: expected shape \(M, 4\)"),
        (
            MESH.points[:, :1],
            MESH.cells,
            r"points: expected shape \(N, 2\) or \(N, 3\), got \(4, 1\)",
        ),
        (MESH.points[:0], MESH.cells, r"cells: expected indices in 0\.\.-1"),
    ],
)
def test_points_and_cells_that_do_not_fit_are_refused(points, cells, message):
    for name in ("quality", "E_G", "extract_surface"):
        chosen = {"chosen": [True]} if name == "extract_surface" else {}
        with pytest.raises(tetopt.InputError, match=f"^{name}: {message}") as caught:
            getattr(tetopt, name)(points=points, cells=cells, **chosen)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "kind", [np.int8, np.uint8, np.int16, np.uint64, np.float16, np.float32, np.longdouble]
)
def test_numbers_of_any_width_are_the_same_number(kind):
    """As 100 * 100 overflows 8 bits."""
    plain = tetopt.lattice_mesh(IMAGE, nodes=100)
    assert np.array_equal(tetopt.lattice_mesh(IMAGE, nodes=kind(100)).cells, plain.cells)
    tree = tetopt.octree_mesh(IMAGE, 120, tetopt.Sizes(gradation=1.0))
    other = tetopt.octree_mesh(IMAGE, nodes=kind(120), sizes=tetopt.Sizes(gradation=kind(1)))
    assert np.array_equal(other.points, tree.points)
    assert tetopt.lattice_mesh(IMAGE, blocks=[kind(2), kind(3), kind(4)]).cells.shape == (288, 4)
    job = tetopt.Job(images="a.nii", output="a.vtu", nodes=kind(100), max_seconds=kind(2))
    assert (type(job.nodes), type(job.max_seconds)) == (int, float)


@pytest.mark.parametrize("value", [True, np.True_, np.float32(0.5), np.array(7)])
def test_what_is_no_whole_number_is_refused(value):
    with pytest.raises(tetopt.InputError, match="nodes: expected a whole number"):
        tetopt.lattice_mesh(IMAGE, nodes=value)
