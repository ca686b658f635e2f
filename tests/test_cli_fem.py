"""`tetopt fem` on models: what it prints and writes is what `solve` finds; bad input is one
line.
"""

import json
from pathlib import Path

import meshio
import numpy as np
import pytest
from commands import assert_done, assert_refused, exit_code, files_here, numbers_in
from models import sample_image, sample_model
from numpy.testing import assert_allclose

import tetopt
from tetopt import Image, load_image, load_mesh, save_image, save_mesh
from tetopt.fem.solution import solution_fields, solve
from tetopt.io.formats import save_model
from tetopt.model.build import build_model
from tetopt.model.loads import parse_loads

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("here")]

STEP_2 = ["2/traction:left:0.1,0,0", "2/spring:right:0.4", "2/gravity:0,0,-9810"]
LOADS = ["hold:superior", "1/pressure:inferior:0.3", *STEP_2]


def model_with(loads, **changes):
    model = sample_model()
    density = np.linspace(900.0, 1100.0, len(model.materials.young))
    table = model.materials._replace(density=density)
    return model._replace(
        loads=parse_loads(loads, model.mesh, model.sets), materials=table, **changes
    )


@pytest.fixture
def path(here):
    """A file with moduli, densities, sets, and two steps of loads."""
    save_model("model.vtu", model_with(LOADS))
    return "model.vtu"


def run_fem(capsys, *words):
    """What the command prints, as output and errors."""
    assert_done("fem", *words)
    return capsys.readouterr()


@pytest.mark.parametrize("order", [1, 2])
def test_a_file_with_moduli_and_loads_needs_no_options(order, path, capsys):
    model = model_with(LOADS, order=order)
    out, _ = run_fem(capsys, f"{path} --order {order} -o solved.vtu --json numbers.json")
    written, grid = numbers_in("numbers.json"), meshio.read("solved.vtu")
    assert [each["iterations"] for each in written["steps"]] == [0, 0]
    for step in (1, 2):
        solution = solve(model, step)
        row, suffix = written["steps"][step - 1], "" if step == 1 else "_step2"
        for name in ("strain_energy", "spring_energy", "work"):
            assert row[name] == pytest.approx(getattr(solution, name), rel=1e-9, abs=1e-12)
        assert f"{row['strain_energy']:.8g}" in out
        assert row["largest_displacement"] == pytest.approx(
            np.linalg.norm(solution.u, axis=1).max(), rel=1e-9
        )
        reactions = json.loads(bytes(grid.field_data[f"reactions{suffix}"]).decode())
        assert reactions == row["reactions"]
        assert set(reactions) == ({"superior"} if step == 1 else {"superior", "right"})
        for name, force in solution.reactions.items():
            assert_allclose(reactions[name], force, rtol=1e-8, atol=1e-9)
        found = solution_fields(model.mesh, solution, step)
        for name, values in found.cell_data.items():
            assert_allclose(grid.cell_data[name][0], values, atol=1e-9 * np.abs(values).max())
        for name, values in found.point_data.items():
            assert_allclose(grid.point_data[name], values, atol=1e-9 * np.abs(values).max())
    assert written["n_nodes_in_all"] == len(solution.u)
    assert written["order"] == order


def test_what_was_solved_can_be_solved_again(path, capsys):
    """The order is the file's, so are loads, moduli and densities; results are new ones."""
    run_fem(capsys, f"{path} --order 2 -o first.vtu")
    run_fem(capsys, "first.vtu -o second.vtk")
    one, other = (load_mesh(each) for each in ("first.vtu", "second.vtk"))
    assert other.order == 2
    for name in ("displacement", "displacement_step2", "von_mises_nodes"):
        assert_allclose(other.point_data[name], one.point_data[name], atol=1e-12)
    run_fem(capsys, "first.vtu -o third.vtu --load compress:5%")
    third = load_mesh("third.vtu")
    assert not any(
        "step2" in name for name in [*third.point_data, *third.cell_data, *third.field_data]
    )


def test_options_instead_of_what_the_file_holds(path, capsys):
    run_fem(
        capsys,
        f"{path} --json numbers.json --compress 2 --young 3 --nu 0.3 --no-conditioning",
    )
    model = sample_model()
    loads = parse_loads(["compress:2%"], model.mesh, model.sets)
    ours = solve(
        build_model(model.mesh, young=3.0, nu=0.3, known_sets=model.sets)._replace(loads=loads)
    )
    written = numbers_in("numbers.json")
    assert written["strain_energy"] == pytest.approx(ours.strain_energy, rel=1e-10)
    assert "cond" not in written


def test_an_image_with_loads_of_the_user_s(path, capsys):
    """Its intensities are what the mapping is of; the conditioning is for the paper's test, or
    on demand.
    """
    image, model = sample_image(), sample_model()
    save_image("image.nii", image)
    words = "--load hold:left --load pressure:right:0.2 --young 1+0.02*h --average harmonic"
    out, _ = run_fem(
        capsys,
        f"image.nii {path} {words} --json numbers.json --conditioning --nu 0.4",
    )
    loaded, loads = load_image("image.nii"), ["hold:left", "pressure:right:0.2"]
    about = {
        "young": "1+0.02*h",
        "nu": 0.4,
        "average": "harmonic",
        "loads": loads,
        "known_sets": model.sets,
    }
    ours = solve(build_model(model.mesh, loaded, **about))
    written = numbers_in("numbers.json")
    assert written["strain_energy"] == pytest.approx(ours.strain_energy, rel=1e-9)
    assert f"{written['cond']:.6g}" in out


@pytest.mark.parametrize("n", [2, 3])
def test_labels_of_an_image_for_a_mesh_that_has_none(n, capsys):
    """Each cell has the modulus of the label that most of its voxels have; by number and by
    name, and in convert.
    """
    image, mesh = sample_image(n), sample_model(n).mesh
    labels = Image(np.where(image.data > 25.0, 4, 7), image.affine)
    save_mesh("bare.vtu", mesh)
    save_image("image.nii", image)
    save_image("labels.nii", labels)
    Path("names.csv").write_text("label,name\n4,stiff part\n7,rest\n")
    named = "--label-names names.csv"
    of_cell = tetopt.cell_labels(load_image("labels.nii"), mesh)
    assert set(of_cell.tolist()) == {4, 7}
    for words, names in (
        ("fem bare.vtu -o out.vtu --young 4=2.1,*=0.1", ""),
        ("fem bare.vtu -o out.vtu --young 'stiff part=2.1,*=0.1'", named),
        ("fem image.nii bare.vtu -o out.vtu --young 'stiff part=2.1,rest=0.1'", named),
        ("convert bare.vtu out.vtu --young 'stiff part=2.1,*=0.1'", named),
    ):
        assert_done(f"{words} --labels labels.nii {names} --load hold:boundary --force")
        loaded = load_mesh("out.vtu")
        np.testing.assert_array_equal(loaded.cell_data["label"], of_cell)
        assert_allclose(loaded.cell_data["young"], np.where(of_cell == 4, 2.1, 0.1), rtol=1e-12)
        assert ("rest" if names else "label_7") in loaded.sets.cells
        assert "average over a cell" not in capsys.readouterr().out  # each cell has one label


def test_triangles(capsys):
    save_model("plane.vtu", sample_model(2))
    for order in (1, 2):
        run_fem(
            capsys,
            f"plane.vtu --order {order} --json {order}.json",
        )
    one, two = (numbers_in(f"{order}.json")["strain_energy"] for order in (1, 2))
    assert 0.8 * one < two < one


@pytest.mark.parametrize(
    ("options", "is_advised"),
    [
        ("--nu 0.45", True),
        ("--nu 0.49", True),
        ("--nu 0.44", False),
        ("--nu 0.49 --order 2", False),
    ],
)
def test_advice_where_linear_cells_lock(options, is_advised, path, capsys):
    _, err = run_fem(capsys, f"{path} --young 3 --density 1000 {options}")
    assert ("linear elements are too stiff" in err) == is_advised


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "mesh.vtu --young 3",
            "the mesh's file has no loads: pass --load, such as --load compress:5%",
        ),
        (
            "mesh.vtu --load compress:5%",
            "the mesh's file has no moduli: pass --young, such as --young 3.5",
        ),
        ("mesh.vtu mesh.vtu mesh.vtu", "expected MESH and one image (--image), got 3 files"),
        (
            "model.vtu --compress 5 --load hold:left",
            "--compress and --load: combine them as --load compress:5% --load pressure:left:1.5",
        ),
        (
            "model.vtu --compress 51",
            "--compress: expected a percentage above 0 and up to 50, got 51",
        ),
        ("model.vtu --crop 0:2,0:2,0:2", "--crop: needs --image"),
        ("model.vtu --registered", "--registered: needs --image"),
        (
            "mesh.vtu --young 1=2,*=1 --load compress:5%",
            "the mesh has no labels; give the label image",
        ),
        ("model.vtu --labels half.nii", "half.nii: labels must be whole numbers from 0"),
        (
            "model.vtu --labels plane.nii",
            "plane.nii: expected 3-D labels like the mesh, got a 2-D image",
        ),
        (
            "model.vtu --average gauss",
            "--average: averages over an image's voxels; pass --image",
        ),
        ("model.vtu --young 3", "gravity: the cells have no density; give --density"),
        ("model.vtu --load hold:inferor", "did you mean inferior?"),
        (
            "model.vtu --load pressure:left:1",
            "mesh: no displacement or spring constrains it, so it can move",
        ),
        ("model.vtu --load move:left:0,free,free", "can still rotate or slide as a whole"),
        ("model.vtu -o model.vtu --force", "is also an input"),
        ("model.vtu -o out.inp", "out.inp: expected a name ending in .vtu or .vtk"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(words, message, path, capsys):
    save_mesh("mesh.vtu", sample_model().mesh)
    save_image("half.nii", Image(np.arange(24.0).reshape(2, 3, 4) / 2))
    save_image("plane.nii", Image(np.arange(6.0).reshape(2, 3)))
    before = Path("model.vtu").read_bytes()
    files = files_here()
    output = "" if "-o" in words else "-o out.vtu"
    assert exit_code(f"fem {words} {output} --json out.json") == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert message in err[-1]
    assert sum(line.startswith("tetopt:") for line in err) == 1
    assert files_here() == files
    assert Path("model.vtu").read_bytes() == before


def test_moduli_too_far_apart_are_one_line(capsys):
    """Stone on the softest of beds."""
    model = sample_model()
    loads = parse_loads(["spring:inferior:1e-6", "pressure:superior:1"], model.mesh, model.sets)
    stone = build_model(model.mesh, young=1e12, known_sets=model.sets)._replace(loads=loads)
    save_model("model.vtu", stone)
    assert_refused(
        capsys,
        "fem model.vtu -o solved.vtu",
        "for this mesh the moduli differ too much, or nu is too close to 0.5",
    )


def test_moduli_at_nodes_go_through_the_file(capsys):
    """A modulus that is linear between nodes, written by --average nodes and solved from the
    file.
    """
    image, model = sample_image(), sample_model()
    words = {
        "young": "1+0.02*h",
        "nu": 0.4,
        "average": "nodes",
        "loads": ["compress:5%"],
        "known_sets": model.sets,
    }
    nodal = build_model(model.mesh, image, **words)._replace(order=2)
    save_model("nodal.vtu", nodal)
    run_fem(capsys, "nodal.vtu --json numbers.json")
    written = numbers_in("numbers.json")["strain_energy"]
    assert written == pytest.approx(solve(nodal).strain_energy, rel=1e-12)
    assert abs(written / solve(nodal._replace(node_young=None)).strain_energy - 1.0) > 1e-4


@pytest.mark.parametrize("units", ["--space lps --units MPa", ""])
def test_moduli_at_gauss_points_go_through_the_file(units, capsys):
    """What was solved with them is solved again from its file, to the same numbers, but not on
    other moduli.
    """
    image, model = sample_image(), sample_model()
    save_image("a.nii.gz", image)
    save_mesh("mesh.vtu", model.mesh)
    out, _ = run_fem(
        capsys, "a.nii.gz mesh.vtu --young 1+0.02*h --order 2 -o solved.vtu --json 1.json"
    )
    assert "modulus mapping" in out
    assert "1+0.02*h" in out
    assert "one per Gauss point" in out
    assert_done(f"convert solved.vtu again.vtu {units}")
    run_fem(capsys, "again.vtu --json 2.json")
    run_fem(capsys, "again.vtu --bins 1000000 --json 3.json")
    energies = [numbers_in(f"{k}.json")["strain_energy"] for k in (1, 2, 3)]
    assert energies[1] == pytest.approx(energies[0], rel=1e-12)
    assert abs(energies[2] / energies[0] - 1.0) > 1e-5
    loaded = load_mesh("solved.vtu")
    fields = dict(loaded.cell_data) | {"young": 2.0 * loaded.cell_data["young"]}
    save_mesh(
        "changed.vtu",
        loaded.mesh,
        fields,
        {"loads": ["compress:5%"], "units": "kPa"},
        order=2,
    )
    _, err = run_fem(capsys, "changed.vtu --load compress:1%")
    assert "dropped young_gauss from the mesh's file" in err
