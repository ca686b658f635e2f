"""What commands do with files, called from Python: the same numbers, files and refusals, and
nothing printed.
"""

import subprocess
import sys

import numpy as np
import pytest
from commands import exit_code, numbers_in

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
def place(tmp_path):
    """A folder with an image, labels, and a mesh of them."""
    phantom = tetopt.load_phantom("sphere")
    image, labels = phantom.image(voxel_mm=6), phantom.label_image(voxel_mm=6)
    tetopt.save_image(tmp_path / "image.nii.gz", image)
    mesh = tetopt.lattice_mesh(image, nodes=200)
    tetopt.save_mesh(
        tmp_path / "a.vtu",
        mesh,
        {"label": tetopt.cell_labels(labels, mesh), **tetopt.cell_fields(mesh, image)},
    )
    return tmp_path


def test_python_has_the_numbers_of_the_commands(place, capfd):
    mesh, image = place / "a.vtu", place / "image.nii.gz"
    load = {"young": "0=1,1=5", "loads": ["compress:5%"]}
    with listen_with(lambda event: None):
        numbers = [
            judge(mesh, image).numbers,
            solve_file(mesh, model=ModelOptions(**load), part=LabelledPart()).numbers,
            convert_file(
                mesh, place / "b.inp", solver=SolverOptions(**load), part=LabelledPart()
            ).numbers,
            write_surface(mesh, place / "b.stl", SurfacePart(label="1")).numbers,
        ]
    assert capfd.readouterr() == ("", "")
    first = (place / "b.inp").read_bytes(), (place / "b.stl").read_bytes()
    model = ("--young", load["young"], "--load", "compress:5%")
    commands = [
        ("quality", mesh, "--image", image),
        ("fem", mesh, *model),
        ("convert", mesh, place / "b.inp", *model),
        ("surface", mesh, "-o", place / "b.stl", "--label", "1"),
    ]
    for words, ours in zip(commands, numbers, strict=True):
        assert exit_code(*words, "--force", "--json", place / "command.json") == 0
        save_json(place / "python.json", ours)
        assert numbers_in(place / "python.json") == numbers_in(place / "command.json")
    assert ((place / "b.inp").read_bytes(), (place / "b.stl").read_bytes()) == first


def test_refusals_name_arguments(place):
    mesh = place / "a.vtu"
    with pytest.raises(InputError, match=r"^`labels`: needs `image`"):
        judge(mesh, labels=place / "image.nii.gz")
    with pytest.raises(InputError, match=r"moduli: pass `young`"):
        solve_file(mesh, model=ModelOptions(), part=LabelledPart())
    with pytest.raises(InputError, match=r"^`mask`: needs `image`"):
        convert_file(mesh, place / "b.inp", solver=SolverOptions(), part=LabelledPart(mask=mesh))
    with pytest.raises(InputError, match=r"give exactly one of `below`, `label`, `cell_set`"):
        write_surface(mesh, place / "b.stl", SurfacePart())


def test_a_violated_requirement_is_told(place):
    """As by `tetopt quality`, whose exit code is 1 then."""
    cells = np.array([[0, 1, 2, 3], [0, 1, 2, 4]])
    points = np.array([[0, 0, 0], [30, 0, 0], [0, 30, 0], [5, 5, 20], [6, 6, 30]])
    tetopt.save_mesh(place / "overlapping.vtu", tetopt.Mesh(points, cells))
    events = []
    with listen_with(events.append):
        wrong = judge(place / "overlapping.vtu", check=True).tell()
    assert wrong == [event.text for event in events if event.kind == "violated"]
    assert wrong[0].startswith(str(place / "overlapping.vtu"))


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
def test_an_image_is_meshed_as_by_the_command(tmp_path, given):
    """With its defaults: the same mesh and labels, to the last bit."""
    phantom = tetopt.load_phantom("sphere")
    image, labels = phantom.image(voxel_mm=6), phantom.label_image(voxel_mm=6)
    near = np.linalg.norm(np.indices(image.shape).T - (np.array(image.shape) - 1) / 2, axis=-1).T
    files = {
        "image": image,
        "labels": labels,
        "mask": tetopt.Image(1.0 * (near < 5.2), image.affine),
    }
    for name, each in files.items():
        tetopt.save_image(tmp_path / f"{name}.nii.gz", each)
    words = [word for name in given for word in (f"--{name}", tmp_path / f"{name}.nii.gz")]
    code = exit_code("mesh", tmp_path / "image.nii.gz", "-o", tmp_path / "a.vtu", *words)
    result = tetopt.mesh_image(
        tetopt.load_image(tmp_path / "image.nii.gz"), **{name: files[name] for name in given}
    )
    assert (code == 1) == bool(result.violated)
    written = tetopt.load_mesh(tmp_path / "a.vtu")
    np.testing.assert_array_equal(result.mesh.points, written.mesh.points)
    np.testing.assert_array_equal(result.mesh.cells, written.mesh.cells)
    if given:
        np.testing.assert_array_equal(result.labels, written.cell_data["label"])
        with pytest.raises(InputError, match=r"give labels and mask to tetopt\.content"):
            tetopt.mesh_image(tetopt.content(image, labels), labels=labels)


def test_a_result_comes_with_its_mask_and_labels(place):
    """To the model that its content and labels give; of a plain image, with curved cells of
    order 2.
    """
    phantom = tetopt.load_phantom("sphere")
    image, labels = phantom.image(voxel_mm=6), phantom.label_image(voxel_mm=6)
    mask = tetopt.Image(1.0 * (np.indices(image.shape)[0] < 8), image.affine)
    result = tetopt.mesh_image(image, 200, labels=labels, mask=mask, iterations=2, order=2)
    content = tetopt.content(image, labels, mask)
    data = tetopt.cell_fields(result.mesh, content) | {"label": result.labels}
    model = tetopt.build_model(result, young="1 + h", bins=4)
    other = tetopt.build_model(result.mesh, content, young="1 + h", bins=4, cell_data=data, order=2)
    assert model.order == 2
    for name in ("a.vtu", "b.vtu"):
        tetopt.save_model(place / name, model if name == "a.vtu" else other)
    assert (place / "a.vtu").read_bytes() == (place / "b.vtu").read_bytes()
    assert not np.array_equal(
        model.cell_data["mean"], tetopt.cell_fields(result.mesh, image)["mean"]
    )
    straight = tetopt.mesh_image(image, 300, iterations=0, order=2)
    assert (straight.mesh.midpoints, tetopt.build_model(straight).order) == (None, 2)
    with pytest.raises(InputError, match="a result of `mesh_image` without an image"):
        tetopt.build_model(result, image)
