"""The programs beside the package, through their main, on small inputs."""

import importlib.util
import json
import platform
from pathlib import Path

import nibabel
import numpy as np
import PIL.Image
import pytest
import trimesh

import tetopt
from tetopt.geometry.topology import components
from tetopt.report.summary import versions

pytestmark = pytest.mark.deep

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = [ROOT / "scripts", ROOT / "benchmarks", ROOT / "docs"]


def script(name):
    path = next(folder / f"{name}.py" for folder in FOLDERS if (folder / f"{name}.py").exists())
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_ventricles_of_a_phantom(tmp_path, capsys, opengl):
    """The dark structure inside a bright head is found, one connected set, near its true volume;
    the air is not.
    """
    axis = np.arange(40) - 19.5
    r = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2)
    data = np.where(r < 6.0, 30.0, np.where(r < 17.0, 150.0, 0.0))
    nibabel.save(
        nibabel.Nifti1Image(data.astype(np.float32), np.diag([2.0, 2.0, 2.0, 1.0])),
        tmp_path / "head.nii.gz",
    )
    out = tmp_path / "out"
    words = f"{tmp_path}/head.nii.gz -o {out} --nodes 2500 --iterations 6 --k-d 0.5"
    code = script("mesh_brain_mr").main(words.split())
    assert code == 0
    written = tetopt.load_mesh(out / "mesh.vtu")
    inside = np.flatnonzero(written.cell_data["is_structure"])
    assert components(written.mesh.cells[inside]).max() == 0
    assert (
        written.cell_data["mean"][inside].max()
        < json.loads((out / "run.json").read_text())["options"]["below"]
    )
    volume = written.cell_data["volume"][inside].sum()
    assert volume == pytest.approx(4 / 3 * np.pi * 12.0**3, rel=0.25)
    centre = (
        written.cell_data["volume"][inside, None]
        * written.mesh.points[written.mesh.cells[inside]].mean(1)
    ).sum(0)
    np.testing.assert_allclose(centre / volume, [39.0, 39.0, 39.0], atol=1.0)
    surface = trimesh.load(out / "structure.stl")
    assert surface.volume == pytest.approx(volume, rel=1e-4)  # STL holds float32
    assert np.std(np.asarray(PIL.Image.open(out / "structure.png").convert("L"))) > 20.0
    assert "structure below" in capsys.readouterr().out


def test_mesh_brain_mr_bad_input(tmp_path, capsys):
    main = script("mesh_brain_mr").main
    assert main([str(tmp_path / "none.nii"), "-o", str(tmp_path / "out")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_benchmark(tmp_path, capsys):
    """It runs, and what it prints is what it writes."""
    image = tetopt.load_phantom("sphere").image(voxel_mm=2.0)
    # background 0
    tetopt.save_image(
        tmp_path / "b.nii.gz", tetopt.Image(image.data - image.data.min(), image.affine)
    )
    words = [str(tmp_path / "b.nii.gz"), "--quick", "-o"]
    assert script("benchmark").main([*words, str(tmp_path / "b.json")]) == 0
    rows = json.loads((tmp_path / "b.json").read_text())
    assert f"{rows['graded'][0]['seconds']:.1f} s, peak" in capsys.readouterr().out
    assert script("benchmark_kernels").main([*words, str(tmp_path / "k.json")]) == 0
    rows = json.loads((tmp_path / "k.json").read_text())
    printed = capsys.readouterr().out
    assert f"E_D {rows['bar']['E_D_of_initial']:.3f} of initial" in printed
    assert rows["sampling_over_find_simplex"] > 0.0
    assert [row["nodes"] for row in rows["paper"]] == sorted(row["nodes"] for row in rows["paper"])
    assert all(0.0 < row["delaunay_fraction"] < 1.0 for row in rows["paper"])


def test_fingerprints(tmp_path, monkeypatch, capsys):
    """The same run has the same checksums; another one is named, and is exit code 1."""
    module, first, second = (
        script("fingerprints"),
        tmp_path / "first.json",
        tmp_path / "second.json",
    )
    module.RUN_WORDS["small"] = "OBLIQUE --nodes 100 --iterations 1"
    images = module.made_images(tmp_path)  # once for all calls
    monkeypatch.setattr(module, "made_images", lambda _: images)
    main = module.main
    assert main(["-o", str(first), "--only", "small"]) == 0
    assert main(["-o", str(second), "--only", "small", "--against", str(first)]) == 0
    assert "1 of 1 runs as in" in capsys.readouterr().out
    written = json.loads(first.read_text())
    written["runs"]["small"]["mesh"] = "0" * 64
    first.write_text(json.dumps(written))
    assert main(["-o", str(second), "--only", "small", "--against", str(first), "--force"]) == 1
    assert "differs: small: mesh\n" in capsys.readouterr().out
    assert main(["-o", str(second), "--only", "small"]) == 2
    assert "exists" in capsys.readouterr().err


def test_a_plain_mesh_is_still_the_same(tmp_path):
    """To the last bit that of the version that wrote the file, where processor and libraries are
    those of the file.
    """
    stated = ROOT / "tests" / "fingerprints.json"
    earlier = json.loads(stated.read_text())
    module = script("fingerprints")
    kinds = {
        text.partition(platform.machine())[2] for text in (earlier["machine"], module.machine())
    }
    now = versions() | {"tetopt": earlier["versions"]["tetopt"]}
    if len(kinds) > 1 or now != earlier["versions"]:
        pytest.skip("fingerprints of another machine, or of other libraries")
    words = ["-o", str(tmp_path / "now.json"), "--against", str(stated), "--only", "oblique"]
    assert module.main(words) == 0


def test_choose_sizes(tmp_path, monkeypatch, capsys):
    """Every mesh is measured; a tighter largest edge leaves more E_D and follows the
    displacement better.
    """
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    out = tmp_path / "sizes.json"
    words = f"-o {out} --phantoms two_spheres --nodes 300 --dofs 8000 --largest 1 inf".split()
    assert script("choose_sizes").main(words) == 0
    rows = {row["mesh"]: row["measured"] for row in json.loads(out.read_text())["rows"]}
    assert len(rows) == 2 + 2 + 5
    tight, free = rows["graded, largest 1"], rows["graded, largest inf"]
    assert free["E_D_fraction"] < tight["E_D_fraction"] < rows["uniform"]["E_D_fraction"]
    displacement = {name: row["fem"]["0.3"]["errors"]["displacement"] for name, row in rows.items()}
    assert displacement["graded, largest 1"] < displacement["graded, largest inf"]
    assert script("choose_sizes").main(words) == 2
    assert "exists" in capsys.readouterr().err


def test_curved_cells(tmp_path, monkeypatch):
    """Curved facets are nearer to the sphere, and the volume of its label to that of the voxels."""
    module, out, labels = (
        script("curved_cells"),
        tmp_path / "curved.json",
        tmp_path / "labels.nii.gz",
    )
    monkeypatch.setattr(module, "NODES", (1_500,))
    monkeypatch.setattr(module, "NODES_OF_LABELS", 1_500)
    tetopt.save_image(labels, module.sphere())
    module.main([str(labels), "-o", str(out)])
    off, volumes = json.loads(out.read_text()).values()
    assert 2.0 * off["curved"] < off["straight"] < 1.0
    assert 2.0 * abs(volumes["curved"][0]) < abs(volumes["straight"][0]) < 0.1


def test_choose_average(tmp_path, monkeypatch, capsys):
    """Every average is solved on every mesh; the stiffer it is, the more energy there is."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    out = tmp_path / "averages.json"
    words = f"-o {out} --phantoms two_spheres --nodes 400 --dofs 20000 --modes uniform".split()
    assert script("choose_average").main(words) == 0
    written = json.loads(out.read_text())
    assert len(written["rows"]) == 9 * 2 * 2
    for order in (1, 2):
        rows = {
            row["average"]: row
            for row in written["rows"]
            if (row["order"], row["nu"]) == (order, "0.3")
        }
        stiffer = [
            rows[each]["stiffer"]
            for each in ("mean", "power:0.5", "geometric", "power:-0.5", "harmonic")
        ]
        assert stiffer == sorted(stiffer, reverse=True)
        assert rows["harmonic"]["stiffer"] < rows["hill"]["stiffer"] < rows["mean"]["stiffer"]
        assert rows["mean"]["n_nodes"] == pytest.approx(400, rel=0.25)
        for each, row in rows.items():
            assert abs(row["stiffer"]) == pytest.approx(row["errors"]["strain_energy"], rel=1e-9), (
                each
            )
    assert set(written["relative_to_mean"]["order 2, mean"].values()) == {1.0}
    assert "order 2, nodes" in written["relative_to_mean"]
    assert "all, order 1, hill: strain_energy x" in capsys.readouterr().out
    assert script("choose_average").main(words) == 2
    assert "exists" in capsys.readouterr().err
    assert script("choose_average").main([*words, "--force", "--averages", "voigt"]) == 2
    assert "average: expected mean" in capsys.readouterr().err
