"""`tetopt fem` on models: what it prints and writes is what `solve` finds; bad input is one
line.
"""

import json
from pathlib import Path

import meshio
import numpy as np
import pytest
from commands import assert_done, numbers_in, refusals, run_command
from models import sample_image, sample_model
from numpy.testing import assert_allclose, assert_array_equal

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


def run_fem(words):
    """What the command prints, as output and errors."""
    return run_command(f"fem {words}")


@pytest.mark.parametrize("order", [1, 2])
def test_a_file_with_moduli_and_loads_needs_no_options(order, path):
    model = model_with(LOADS, order=order)
    out, _ = run_fem(f"{path} --order {order} -o solved.vtu --json numbers.json")
    written, grid = numbers_in("numbers.json"), meshio.read("solved.vtu")
    assert written["order"] == order
    for step, held in ((1, {"superior"}), (2, {"superior", "right"})):
        solution = solve(model, step)
        row, suffix = written["steps"][step - 1], "" if step == 1 else "_step2"
        assert row["iterations"] == 0
        for name in ("strain_energy", "spring_energy", "work"):
            assert row[name] == pytest.approx(getattr(solution, name), rel=1e-9, abs=1e-12)
        assert f"{row['strain_energy']:.8g}" in out
        largest = np.linalg.norm(solution.u, axis=1).max()
        assert row["largest_displacement"] == pytest.approx(largest, rel=1e-9)
        reactions = json.loads(bytes(grid.field_data[f"reactions{suffix}"]).decode())
        assert reactions == row["reactions"]
        assert set(reactions) == held
        for name, force in solution.reactions.items():
            assert_allclose(reactions[name], force, rtol=1e-8, atol=1e-9)
        found = solution_fields(model.mesh, solution, step)
        read = {name: values[0] for name, values in grid.cell_data.items()} | grid.point_data
        for name, values in (found.cell_data | found.point_data).items():
            assert_allclose(read[name], values, atol=1e-9 * np.abs(values).max())
    assert written["n_nodes_in_all"] == len(solution.u)


def test_what_was_solved_can_be_solved_again(path):
    """The order is the file's, so are loads, moduli and densities; results are new ones."""
    run_fem(f"{path} --order 2 -o first.vtu")
    run_fem("first.vtu -o second.vtk")
    run_fem("first.vtu -o third.vtu --load compress:5%")
    one, other, third = (load_mesh(each) for each in ("first.vtu", "second.vtk", "third.vtu"))
    assert other.order == 2
    for name in ("displacement", "displacement_step2", "von_mises_nodes"):
        assert_allclose(other.point_data[name], one.point_data[name], atol=1e-12)
    names = [*third.point_data, *third.cell_data, *third.field_data]
    assert not any("step2" in name for name in names)


@pytest.mark.parametrize(
    ("words", "about"),
    [
        (
            "--compress 2 --young 3 --nu 0.3 --no-conditioning",
            {"young": 3.0, "nu": 0.3, "loads": ["compress:2%"]},
        ),
        (
            "--load hold:left --load pressure:right:0.2 --young 1+0.02*h --average harmonic "
            "--conditioning --nu 0.4 --image image.nii",
            {
                "young": "1+0.02*h",
                "nu": 0.4,
                "average": "harmonic",
                "loads": ["hold:left", "pressure:right:0.2"],
            },
        ),
    ],
)
def test_options_instead_of_what_the_file_holds(words, about, path):
    """Intensities of an image are what the mapping is of; the conditioning is for the paper's
    test, or on demand.
    """
    save_image("image.nii", sample_image())
    out, _ = run_fem(f"{path} {words} --json numbers.json")
    image, model = load_image("image.nii") if "image" in words else None, sample_model()
    ours = solve(build_model(model.mesh, image, **about, known_sets=model.sets))
    written = numbers_in("numbers.json")
    assert written["strain_energy"] == pytest.approx(ours.strain_energy, rel=1e-9)
    assert ("cond" in written) == (image is not None)
    assert image is None or f"{written['cond']:.6g}" in out


@pytest.mark.parametrize("n", [2, 3])
def test_labels_of_an_image_for_a_mesh_that_has_none(n):
    """Each cell has the modulus of the label that most of its voxels have; by number and by
    name, and in convert.
    """
    image, mesh = sample_image(n), sample_model(n).mesh
    labels = Image(np.where(image.data > 25.0, 4, 7), image.affine)
    save_mesh("bare.vtu", mesh)
    save_image("image.nii", image)
    save_image("labels.nii", labels)
    Path("names.csv").write_text("label,name\n4,stiff part\n7,rest\n")
    of_cell = tetopt.cell_labels(load_image("labels.nii"), mesh)
    assert set(of_cell) == {4, 7}
    for words, rest in (
        ("fem bare.vtu -o out.vtu --young 4=2.1,*=0.1", "label_7"),
        ("fem bare.vtu -o out.vtu --young 'stiff part=2.1,*=0.1'", "rest"),
        ("fem image.nii bare.vtu -o out.vtu --young 'stiff part=2.1,rest=0.1'", "rest"),
        ("convert bare.vtu out.vtu --young 'stiff part=2.1,*=0.1'", "rest"),
    ):
        names = "--label-names names.csv" if rest == "rest" else ""
        said = run_command(f"{words} --labels labels.nii {names} --load hold:boundary --force")
        assert "average over a cell" not in said.out  # each cell has one label
        loaded = load_mesh("out.vtu")
        assert_array_equal(loaded.cell_data["label"], of_cell)
        assert_allclose(loaded.cell_data["young"], np.where(of_cell == 4, 2.1, 0.1), rtol=1e-12)
        assert rest in loaded.sets.cells


def test_triangles():
    save_model("plane.vtu", sample_model(2))
    energies = []
    for order in (1, 2):
        run_fem(f"plane.vtu --order {order} --json {order}.json")
        energies.append(numbers_in(f"{order}.json")["strain_energy"])
    assert 0.8 * energies[0] < energies[1] < energies[0]


@pytest.mark.parametrize(
    ("options", "is_advised"),
    [("--nu 0.45", 1), ("--nu 0.49", 1), ("--nu 0.44", 0), ("--nu 0.49 --order 2", 0)],
)
def test_advice_where_linear_cells_lock(options, is_advised, path):
    said = run_fem(f"{path} --young 3 --density 1000 {options}").err
    assert said.count("linear elements are too stiff") == is_advised


@pytest.fixture(autouse=True)
def _files_to_refuse(path):
    model = sample_model()
    save_mesh("mesh.vtu", model.mesh)
    save_image("half.nii", Image(np.arange(24.0).reshape(2, 3, 4) / 2))
    save_image("plane.nii", Image(np.arange(6.0).reshape(2, 3)))
    loads = ["spring:inferior:1e-6", "pressure:superior:1"]
    stone = build_model(model.mesh, young=1e12, known_sets=model.sets, loads=loads)
    save_model("stone.vtu", stone)  # on the softest of beds


def test_gravity_needs_densities(path):
    said = run_command(f"fem {path} --young 3", code=2).err
    assert "gravity: the cells have no density; give --density" in said


test_refused = refusals(
    """
fem mesh.vtu --young 3 -o out.vtu --json out.json
    the mesh's file has no loads, or its format keeps none: pass --load, such as --load compress:5%
fem mesh.vtu --load compress:5% -o out.vtu --json out.json
    the mesh's file has no moduli: pass --young, such as --young 3.5
fem mesh.vtu mesh.vtu mesh.vtu -o out.vtu --json out.json
    expected MESH and one image (--image), got 3 files
fem model.vtu --compress 5 --load hold:left -o out.vtu --json out.json
    --compress and --load: combine them as --load compress:5% --load pressure:left:1.5
fem model.vtu --compress 51 -o out.vtu --json out.json
    --compress: expected a percentage above 0 and up to 50, got 51
fem model.vtu --crop 0:2,0:2,0:2 -o out.vtu --json out.json
    --crop: needs --image
fem model.vtu --registered -o out.vtu --json out.json
    --registered: needs --image
fem mesh.vtu --young 1=2,*=1 --load compress:5% -o out.vtu --json out.json
    the mesh has no labels; give the label image
fem model.vtu --labels half.nii -o out.vtu --json out.json
    half.nii: labels must be whole numbers from 0
fem model.vtu --labels plane.nii -o out.vtu --json out.json
    plane.nii: expected 3-D labels like the mesh, got a 2-D image
fem model.vtu --average gauss -o out.vtu --json out.json
    --average: averages over an image's voxels; pass --image
fem model.vtu --load hold:inferor -o out.vtu --json out.json
    did you mean inferior?
fem model.vtu --load pressure:left:1 -o out.vtu --json out.json
    mesh: no displacement or spring constrains it, so it can move
fem model.vtu --load move:left:0,free,free -o out.vtu --json out.json
    can still rotate or slide as a whole
fem model.vtu -o model.vtu --force --json out.json
    is also an input
fem model.vtu -o out.inp --json out.json
    out.inp: expected a name ending in .vtu or .vtk
fem stone.vtu -o solved.vtu
    for this mesh the moduli differ too much, or nu is too close to 0.5
"""
)


def test_moduli_at_nodes_go_through_the_file():
    """A modulus that is linear between nodes, written by --average nodes and solved from the
    file.
    """
    image, model = sample_image(), sample_model()
    words = {"young": "1+0.02*h", "nu": 0.4, "average": "nodes", "loads": ["compress:5%"]}
    nodal = build_model(model.mesh, image, **words, known_sets=model.sets)._replace(order=2)
    save_model("nodal.vtu", nodal)
    run_fem("nodal.vtu --json numbers.json")
    written = numbers_in("numbers.json")["strain_energy"]
    assert written == pytest.approx(solve(nodal).strain_energy, rel=1e-12)
    assert abs(written / solve(nodal._replace(node_young=None)).strain_energy - 1.0) > 1e-4


@pytest.mark.parametrize("units", ["--space lps --units MPa", ""])
def test_moduli_at_gauss_points_go_through_the_file(units):
    """What was solved with them is solved again from its file, to the same numbers, but not on
    other moduli.
    """
    save_image("a.nii.gz", sample_image())
    said = run_fem("a.nii.gz mesh.vtu --young 1+0.02*h --order 2 -o solved.vtu --json 1.json").out
    for words in ("modulus mapping", "1+0.02*h", "one per Gauss point"):
        assert words in said
    assert_done(f"convert solved.vtu again.vtu {units}")
    run_fem("again.vtu --json 2.json")
    run_fem("again.vtu --bins 1000000 --json 3.json")
    energies = [numbers_in(f"{k}.json")["strain_energy"] for k in (1, 2, 3)]
    assert energies[1] == pytest.approx(energies[0], rel=1e-12)
    assert abs(energies[2] / energies[0] - 1.0) > 1e-5
    loaded = load_mesh("solved.vtu")
    fields = loaded.cell_data | {"young": 2.0 * loaded.cell_data["young"]}
    about = {"loads": ["compress:5%"], "units": "kPa"}
    save_mesh("changed.vtu", loaded.mesh, fields, about, order=2)
    said = run_fem("changed.vtu --load compress:1%").err
    assert "dropped young_gauss from the mesh's file" in said
