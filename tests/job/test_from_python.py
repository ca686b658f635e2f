"""What commands do with files, called from Python: the same numbers, files and refusals, and
nothing printed.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import assert_done, exit_code, numbers_in

import tetopt
from tetopt import InputError
from tetopt.commands.boundary import SurfacePart, write_surface
from tetopt.commands.conversion import convert_file
from tetopt.commands.judgement import judge
from tetopt.commands.simulation import solve_file
from tetopt.job.events import listen_with
from tetopt.job.options import LabelledPart, ModelOptions, SolverOptions
from tetopt.system.files import save_json


@pytest.fixture
def phantom():
    """An image of 6 mm and its labels."""
    sphere = tetopt.load_phantom("sphere")
    return sphere.image(voxel_mm=6), sphere.label_image(voxel_mm=6)


@pytest.fixture
def files(here, phantom):
    """The image, and a mesh of it with labels."""
    image, labels = phantom
    tetopt.save_image("image.nii.gz", image)
    mesh = tetopt.lattice_mesh(image, nodes=200)
    fields = {"label": tetopt.cell_labels(labels, mesh), **tetopt.cell_fields(mesh, image)}
    tetopt.save_mesh("a.vtu", mesh, fields)


MESH, IMAGE, OUT = Path("a.vtu"), Path("image.nii.gz"), Path("b.inp")


@pytest.mark.usefixtures("files")
def test_python_has_the_numbers_of_the_commands(capfd):
    load = {"young": "0=1,1=5", "loads": ["compress:5%"]}
    solver, part = SolverOptions(**load), LabelledPart()
    with listen_with(lambda event: None):
        results = [
            judge(MESH, IMAGE),
            solve_file(MESH, model=ModelOptions(**load), part=part),
            convert_file(MESH, OUT, solver=solver, part=part),
            write_surface(MESH, Path("b.stl"), SurfacePart(label="1")),
        ]
    assert capfd.readouterr() == ("", "")
    first = [Path(name).read_bytes() for name in ("b.inp", "b.stl")]
    model = "--young 0=1,1=5 --load compress:5%"
    commands = (
        "quality a.vtu --image image.nii.gz",
        f"fem a.vtu {model}",
        f"convert a.vtu b.inp {model}",
        "surface a.vtu -o b.stl --label 1",
    )
    for words, result in zip(commands, results, strict=True):
        assert_done(f"{words} --force --json command.json")
        save_json("python.json", result.numbers)
        assert numbers_in("python.json") == numbers_in("command.json")
    assert [Path(name).read_bytes() for name in ("b.inp", "b.stl")] == first


@pytest.mark.usefixtures("files")
def test_refusals_name_arguments():
    solver, part = SolverOptions(), LabelledPart(mask=MESH)
    for call, words in (
        (lambda: judge(MESH, labels=IMAGE), "^`labels`: needs `image`"),
        (lambda: solve_file(MESH, model=ModelOptions(), part=LabelledPart()), "pass `young`"),
        (lambda: convert_file(MESH, OUT, solver=solver, part=part), "^`mask`: needs `image`"),
        (lambda: write_surface(MESH, OUT, SurfacePart()), "one of `below`, `label`, `cell_set`"),
    ):
        with pytest.raises(InputError, match=words):
            call()


def test_a_violated_requirement_is_told(here):
    """As by `tetopt quality`, whose exit code is 1 then."""
    points = [[0, 0, 0], [30, 0, 0], [0, 30, 0], [5, 5, 20], [6, 6, 30]]
    tetopt.save_mesh("overlapping.vtu", tetopt.Mesh(points, [[0, 1, 2, 3], [0, 1, 2, 4]]))
    events = []
    with listen_with(events.append):
        wrong = judge(Path("overlapping.vtu"), check=True).tell()
    assert wrong == [event.text for event in events if event.kind == "violated"]
    assert wrong[0].startswith("overlapping.vtu")


@pytest.mark.deep
def test_a_pool_of_new_processes_works_after_a_run(tmp_path):
    """As the page on processes says; one that forks waits for ever."""
    (tmp_path / "program.py").write_text(
        "import multiprocessing\n"
        "import numpy as np\n"
        "import tetopt\n\n\n"
        "def voxels(size):\n"
        "    image = tetopt.Image(np.ones((size,) * 3))\n"
        "    return int(tetopt.cell_moments(image, tetopt.lattice_mesh(image, "
        "nodes=60)).n_voxels.sum())\n\n\n"
        "if __name__ == '__main__':\n"
        "    print(voxels(4))\n"
        "    with multiprocessing.get_context('spawn').Pool(1) as pool:\n"
        "        print(pool.map(voxels, [4, 5]))\n"
    )
    command = [sys.executable, str(tmp_path / "program.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.split("\n")[:2] == ["64", "[64, 125]"]


@pytest.mark.parametrize("given", [(), ("labels",), ("labels", "mask")])
def test_an_image_is_meshed_as_by_the_command(here, phantom, given):
    """With its defaults: the same mesh and labels, to the last bit."""
    image, labels = phantom
    index = np.moveaxis(np.indices(image.shape), 0, -1)
    near = np.linalg.norm(index - (np.array(image.shape) - 1) / 2, axis=-1) < 5.2
    files = {"image": image, "labels": labels, "mask": tetopt.Image(1.0 * near, image.affine)}
    for name, each in files.items():
        tetopt.save_image(f"{name}.nii.gz", each)
    words = [f"--{name} {name}.nii.gz" for name in given]
    code = exit_code("mesh image.nii.gz -o a.vtu", *words)
    options = {name: files[name] for name in given}
    result = tetopt.mesh_image(tetopt.load_image("image.nii.gz"), **options)
    assert (code == 1) == bool(result.violated)
    written = tetopt.load_mesh("a.vtu")
    np.testing.assert_array_equal(result.mesh.points, written.mesh.points)
    np.testing.assert_array_equal(result.mesh.cells, written.mesh.cells)
    if given:
        np.testing.assert_array_equal(result.labels, written.cell_data["label"])
        with pytest.raises(InputError, match=r"give labels and mask to tetopt\.content"):
            tetopt.mesh_image(tetopt.content(image, labels), labels=labels)


def test_a_result_comes_with_its_mask_and_labels(here, phantom):
    """To the model that its content and labels give; of a plain image, with curved cells of
    order 2.
    """
    image, labels = phantom
    mask = tetopt.Image(1.0 * (np.indices(image.shape)[0] < 8), image.affine)
    result = tetopt.mesh_image(image, 200, labels=labels, mask=mask, iterations=2, order=2)
    content, mapped = tetopt.content(image, labels, mask), {"young": "1 + h", "bins": 4}
    data = tetopt.cell_fields(result.mesh, content) | {"label": result.labels}
    model = tetopt.build_model(result, **mapped)
    other = tetopt.build_model(result.mesh, content, **mapped, cell_data=data, order=2)
    assert model.order == 2
    tetopt.save_model("a.vtu", model)
    tetopt.save_model("b.vtu", other)
    assert Path("a.vtu").read_bytes() == Path("b.vtu").read_bytes()
    means = tetopt.cell_fields(result.mesh, image)["mean"]
    assert not np.array_equal(model.cell_data["mean"], means)
    straight = tetopt.mesh_image(image, 300, iterations=0, order=2)
    assert (straight.mesh.midpoints, tetopt.build_model(straight).order) == (None, 2)
    with pytest.raises(InputError, match="a result of `mesh_image` without an image"):
        tetopt.build_model(result, image)
