"""`tetopt fem` on models: what it prints and writes is what `solve` finds; bad input is one
line.
"""

import json

import meshio
import numpy as np
import pytest
from models import sample_image, sample_model

import tetopt
from tetopt.cli.app import main
from tetopt.fem.solution import solution_fields, solve
from tetopt.io.formats import save_model
from tetopt.model.build import build_model
from tetopt.model.loads import parse_loads

pytestmark = pytest.mark.full

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
def path(tmp_path):
    """A file with moduli, densities, sets, and two steps of loads."""
    save_model(tmp_path / "model.vtu", model_with(LOADS))
    return str(tmp_path / "model.vtu")


def run(capsys, *words):
    """The numbers of the JSON file, and what was printed."""
    assert main(["fem", *words]) == 0
    printed = capsys.readouterr()
    return printed.out, printed.err


@pytest.mark.parametrize("order", [1, 2])
def test_a_file_with_moduli_and_loads_needs_no_options(order, path, tmp_path, capsys):
    model = model_with(LOADS, order=order)
    solved, numbers = str(tmp_path / "solved.vtu"), str(tmp_path / "numbers.json")
    out, _ = run(capsys, path, "--order", str(order), "-o", solved, "--json", numbers)
    written, grid = json.loads((tmp_path / "numbers.json").read_text()), meshio.read(solved)
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
            np.testing.assert_allclose(reactions[name], force, rtol=1e-8, atol=1e-9)
        found = solution_fields(model.mesh, solution, step)
        for name, values in found.cell_data.items():
            np.testing.assert_allclose(
                grid.cell_data[name][0], values, atol=1e-9 * np.abs(values).max()
            )
        for name, values in found.point_data.items():
            np.testing.assert_allclose(
                grid.point_data[name], values, atol=1e-9 * np.abs(values).max()
            )
    assert written["n_nodes_in_all"] == len(solution.u)
    assert written["order"] == order


def test_what_was_solved_can_be_solved_again(path, tmp_path, capsys):
    """The order is the file's, so are loads, moduli and densities; results are new ones."""
    first, second = str(tmp_path / "first.vtu"), str(tmp_path / "second.vtk")
    run(capsys, path, "--order", "2", "-o", first)
    run(capsys, first, "-o", second)
    one, other = (tetopt.load_mesh(each) for each in (first, second))
    assert other.order == 2
    for name in ("displacement", "displacement_step2", "von_mises_nodes"):
        np.testing.assert_allclose(other.point_data[name], one.point_data[name], atol=1e-12)
    run(capsys, first, "-o", str(tmp_path / "third.vtu"), "--load", "compress:5%")
    third = tetopt.load_mesh(tmp_path / "third.vtu")
    assert not any(
        "step2" in name for name in [*third.point_data, *third.cell_data, *third.field_data]
    )


def test_options_instead_of_what_the_file_holds(path, tmp_path, capsys):
    numbers = str(tmp_path / "numbers.json")
    run(
        capsys,
        path,
        "--json",
        numbers,
        "--compress",
        "2",
        "--young",
        "3",
        "--nu",
        "0.3",
        "--no-conditioning",
    )
    model = sample_model()
    loads = parse_loads(["compress:2%"], model.mesh, model.sets)
    ours = solve(
        build_model(model.mesh, young=3.0, nu=0.3, known_sets=model.sets)._replace(loads=loads)
    )
    written = json.loads((tmp_path / "numbers.json").read_text())
    assert written["strain_energy"] == pytest.approx(ours.strain_energy, rel=1e-10)
    assert "cond" not in written


def test_an_image_with_loads_of_the_user_s(path, tmp_path, capsys):
    """Its intensities are what the mapping is of; the conditioning is for the paper's test, or
    on demand.
    """
    image, model = sample_image(), sample_model()
    tetopt.save_image(tmp_path / "image.nii", image)
    numbers = str(tmp_path / "numbers.json")
    words = [
        "--load",
        "hold:left",
        "--load",
        "pressure:right:0.2",
        "--young",
        "1+0.02*h",
        "--average",
        "harmonic",
    ]
    out, _ = run(
        capsys,
        str(tmp_path / "image.nii"),
        path,
        *words,
        "--json",
        numbers,
        "--conditioning",
        "--nu",
        "0.4",
    )
    loaded, loads = tetopt.load_image(tmp_path / "image.nii"), ["hold:left", "pressure:right:0.2"]
    about = {
        "young": "1+0.02*h",
        "nu": 0.4,
        "average": "harmonic",
        "loads": loads,
        "known_sets": model.sets,
    }
    ours = solve(build_model(model.mesh, loaded, **about))
    written = json.loads((tmp_path / "numbers.json").read_text())
    assert written["strain_energy"] == pytest.approx(ours.strain_energy, rel=1e-9)
    assert f"{written['cond']:.6g}" in out


@pytest.mark.parametrize("n", [2, 3])
def test_labels_of_an_image_for_a_mesh_that_has_none(n, tmp_path, capsys):
    """Each cell has the modulus of the label that most of its voxels have; by number and by
    name, and in convert.
    """
    image, mesh = sample_image(n), sample_model(n).mesh
    labels = tetopt.Image(np.where(image.data > 25.0, 4, 7), image.affine)
    tetopt.save_mesh(tmp_path / "bare.vtu", mesh)
    tetopt.save_image(tmp_path / "image.nii", image)
    tetopt.save_image(tmp_path / "labels.nii", labels)
    (tmp_path / "names.csv").write_text("label,name\n4,stiff part\n7,rest\n")
    bare, out = str(tmp_path / "bare.vtu"), str(tmp_path / "out.vtu")
    of_cell = tetopt.cell_labels(tetopt.load_image(tmp_path / "labels.nii"), mesh)
    assert set(of_cell.tolist()) == {4, 7}
    named = ["--labels", str(tmp_path / "labels.nii"), "--label-names", str(tmp_path / "names.csv")]
    for words in (
        ["fem", bare, "--young", "4=2.1,*=0.1", *named[:2]],
        ["fem", bare, "--young", "stiff part=2.1,*=0.1", *named],
        ["fem", str(tmp_path / "image.nii"), bare, "--young", "stiff part=2.1,rest=0.1", *named],
        ["convert", bare, out, "--young", "stiff part=2.1,*=0.1", *named],
    ):
        load = ["--load", "hold:boundary", "--force"]
        assert main([*words, *load, *(["-o", out] if words[0] == "fem" else [])]) == 0
        loaded = tetopt.load_mesh(out)
        np.testing.assert_array_equal(loaded.cell_data["label"], of_cell)
        np.testing.assert_allclose(
            loaded.cell_data["young"], np.where(of_cell == 4, 2.1, 0.1), rtol=1e-12
        )
        assert ("label_7" if words[-1] != named[-1] else "rest") in loaded.sets.cells
        assert "average over a cell" not in capsys.readouterr().out  # each cell has one label


def test_triangles(tmp_path, capsys):
    save_model(tmp_path / "plane.vtu", sample_model(2))
    for order in (1, 2):
        run(
            capsys,
            str(tmp_path / "plane.vtu"),
            "--order",
            str(order),
            "--json",
            str(tmp_path / f"{order}.json"),
        )
    one, two = (
        json.loads((tmp_path / f"{order}.json").read_text())["strain_energy"] for order in (1, 2)
    )
    assert 0.8 * one < two < one


@pytest.mark.parametrize(
    ("options", "is_advised"),
    [
        (["--nu", "0.45"], True),
        (["--nu", "0.49"], True),
        (["--nu", "0.44"], False),
        (["--nu", "0.49", "--order", "2"], False),
    ],
)
def test_advice_where_linear_cells_lock(options, is_advised, path, capsys):
    _, err = run(capsys, path, "--young", "3", "--density", "1000", *options)
    assert ("linear elements are too stiff" in err) == is_advised


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["{mesh}", "--young", "3"],
            "the mesh's file has no loads: pass --load, such as --load compress:5%",
        ),
        (
            ["{mesh}", "--load", "compress:5%"],
            "the mesh's file has no moduli: pass --young, such as --young 3.5",
        ),
        (["{mesh}", "{mesh}", "{mesh}"], "expected MESH and one image (--image), got 3 files"),
        (
            ["{model}", "--compress", "5", "--load", "hold:left"],
            "--compress and --load: combine them as --load compress:5% --load pressure:left:1.5",
        ),
        (
            ["{model}", "--compress", "51"],
            "--compress: expected a percentage above 0 and up to 50, got 51",
        ),
        (["{model}", "--crop", "0:2,0:2,0:2"], "--crop: needs --image"),
        (["{model}", "--registered"], "--registered: needs --image"),
        (
            ["{mesh}", "--young", "1=2,*=1", "--load", "compress:5%"],
            "the mesh has no labels; give the label image",
        ),
        (["{model}", "--labels", "half.nii"], "half.nii: labels must be whole numbers from 0"),
        (
            ["{model}", "--labels", "plane.nii"],
            "plane.nii: expected 3-D labels like the mesh, got a 2-D image",
        ),
        (
            ["{model}", "--average", "gauss"],
            "--average: averages over an image's voxels; pass --image",
        ),
        (["{model}", "--young", "3"], "gravity: the cells have no density; give --density"),
        (["{model}", "--load", "hold:inferor"], "did you mean inferior?"),
        (
            ["{model}", "--load", "pressure:left:1"],
            "mesh: no displacement or spring constrains it, so it can move",
        ),
        (["{model}", "--load", "move:left:0,free,free"], "can still rotate or slide as a whole"),
        (["{model}", "-o", "{model}", "--force"], "is also an input"),
        (["{model}", "-o", "out.inp"], "out.inp: expected a name ending in .vtu or .vtk"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(
    words, message, path, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    tetopt.save_mesh(tmp_path / "mesh.vtu", sample_model().mesh)
    tetopt.save_image(tmp_path / "half.nii", tetopt.Image(np.arange(24.0).reshape(2, 3, 4) / 2))
    tetopt.save_image(tmp_path / "plane.nii", tetopt.Image(np.arange(6.0).reshape(2, 3)))
    before = (tmp_path / "model.vtu").read_bytes()
    words = [word.format(mesh="mesh.vtu", model="model.vtu") for word in words]
    output = [] if "-o" in words else ["-o", "out.vtu"]
    assert main(["fem", *words, *output, "--json", "out.json"]) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert message in err[-1]
    assert sum(line.startswith("tetopt:") for line in err) == 1
    assert sorted(each.name for each in tmp_path.iterdir()) == [
        "half.nii",
        "mesh.vtu",
        "model.vtu",
        "plane.nii",
    ]
    assert (tmp_path / "model.vtu").read_bytes() == before


def test_moduli_too_far_apart_are_one_line(tmp_path, capsys):
    """Stone on the softest of beds."""
    model = sample_model()
    loads = parse_loads(["spring:inferior:1e-6", "pressure:superior:1"], model.mesh, model.sets)
    stone = build_model(model.mesh, young=1e12, known_sets=model.sets)._replace(loads=loads)
    save_model(tmp_path / "model.vtu", stone)
    assert main(["fem", str(tmp_path / "model.vtu"), "-o", str(tmp_path / "solved.vtu")]) == 2
    assert (
        "for this mesh the moduli differ too much, or nu is too close to 0.5"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "solved.vtu").exists()


def test_moduli_at_nodes_go_through_the_file(tmp_path, capsys):
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
    save_model(tmp_path / "nodal.vtu", nodal)
    run(capsys, str(tmp_path / "nodal.vtu"), "--json", str(tmp_path / "numbers.json"))
    written = json.loads((tmp_path / "numbers.json").read_text())["strain_energy"]
    assert written == pytest.approx(solve(nodal).strain_energy, rel=1e-12)
    assert abs(written / solve(nodal._replace(node_young=None)).strain_energy - 1.0) > 1e-4


@pytest.mark.parametrize("units", [["--space", "lps", "--units", "MPa"], []])
def test_moduli_at_gauss_points_go_through_the_file(units, tmp_path, capsys):
    """What was solved with them is solved again from its file, to the same numbers, but not on
    other moduli.
    """
    image, model = sample_image(), sample_model()
    tetopt.save_image(tmp_path / "a.nii.gz", image)
    tetopt.save_mesh(tmp_path / "mesh.vtu", model.mesh)
    names = [
        str(tmp_path / name) for name in ("solved.vtu", "again.vtu", "1.json", "2.json", "3.json")
    ]
    words = [
        str(tmp_path / "a.nii.gz"),
        str(tmp_path / "mesh.vtu"),
        "--young",
        "1+0.02*h",
        "--order",
        "2",
    ]
    out, _ = run(capsys, *words, "-o", names[0], "--json", names[2])
    assert "modulus mapping" in out
    assert "1+0.02*h" in out
    assert "one per Gauss point" in out
    assert main(["convert", names[0], names[1], *units]) == 0
    run(capsys, names[1], "--json", names[3])
    run(capsys, names[1], "--bins", "1000000", "--json", names[4])
    energies = [
        json.loads((tmp_path / f"{k}.json").read_text())["strain_energy"] for k in (1, 2, 3)
    ]
    assert energies[1] == pytest.approx(energies[0], rel=1e-12)
    assert abs(energies[2] / energies[0] - 1.0) > 1e-5
    loaded = tetopt.load_mesh(names[0])
    fields = dict(loaded.cell_data) | {"young": 2.0 * loaded.cell_data["young"]}
    tetopt.save_mesh(
        tmp_path / "changed.vtu",
        loaded.mesh,
        fields,
        {"loads": ["compress:5%"], "units": "kPa"},
        order=2,
    )
    _, err = run(capsys, str(tmp_path / "changed.vtu"), "--load", "compress:1%")
    assert "dropped young_gauss from the mesh's file" in err
