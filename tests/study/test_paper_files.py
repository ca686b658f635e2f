"""`scripts/reproduce_paper.py` and `tetopt fem`: files, page, and one line for bad input."""

import json
import re

import meshio
import numpy as np
import PIL.Image
import pytest
from browser import browser, copied, document
from numpy.testing import assert_allclose
from paper import experiments as paper
from paper.report import PAPER_PICTURES
from reproduce_paper import main as reproduce

import tetopt
from tetopt.cli import main


@pytest.fixture(scope="module")
def run(tmp_path_factory, opengl):
    """The whole command, small: few seeds, places and nodes, on the head phantom in the place of
    a brain volume.
    """
    folder = tmp_path_factory.mktemp("paper")
    phantom = tetopt.load_phantom("ellipsoids_brain")
    tetopt.save_image(folder / "head.nii.gz", phantom.image(voxel_mm=4.0))
    tetopt.save_image(folder / "tissue.nii.gz", phantom.label_image(voxel_mm=4.0))
    out = folder / "out"
    inputs = ["--image", str(folder / "head.nii.gz"), "--labels", str(folder / "tissue.nii.gz")]
    lattice, landscape = paper.lattice_mesh, paper.figure_2b

    def fewer(image, *kind, nodes=None, **options):
        return lattice(image, *kind, nodes=nodes and 1500, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "figure_2b", lambda k_D: landscape(k_D, n_places=9))
        patch.setattr(paper, "lattice_mesh", fewer)
        assert reproduce(["-o", str(out), *inputs, "--seeds", "2"]) == 0
    return out


@pytest.mark.deep
@pytest.mark.drawn
def test_files(run):
    assert {path.name for path in run.iterdir()} == {"paper.json", "paper.html", *PAPER_PICTURES}
    for name in PAPER_PICTURES:
        assert np.std(np.asarray(PIL.Image.open(run / name).convert("L"))) > 10.0, name


@pytest.mark.deep
def test_page_holds_every_number(run):
    """Each printed number and each of ours stands in the page as the JSON has it; nothing points
    outside.
    """
    numbers = json.loads((run / "paper.json").read_text())
    page = (run / "paper.html").read_text(encoding="utf-8")
    rows = [row for section in numbers["sections"] for row in section.get("errors", ())]
    assert len(rows) == 9  # rows 1 to 7, the last at three noise levels
    assert json.loads((run / "paper.json").read_text())["image"] == "head.nii.gz"
    assert "head.nii.gz" in page
    for row in rows:
        assert f"<td>{row['errors'][1]:.4f}</td><td>{row['geometric_mean']:.4f}</td>" in page
    for row in rows:
        for printed, ours in zip(row["errors"], row["ours"], strict=True):
            difference = f"{ours - printed:+.4f}".replace("-0.0000", "+0.0000")
            assert f"<td>{printed:.4f}</td><td>{ours:.4f}</td><td>{difference}</td>" in page
    assert page.count("data:image/png;base64,") == len(PAPER_PICTURES)
    assert not re.search(r"(src|href)=[\"'](?!data:)", page)


@pytest.mark.deep
def test_every_other_number_is_on_the_page(run):
    """E_D, minima, Dice and changes of the JSON are in the page; changes are after over before;
    rows are their own.
    """
    sections = {s["title"]: s for s in json.loads((run / "paper.json").read_text())["sections"]}
    page = (run / "paper.html").read_text(encoding="utf-8")
    printed = paper.printed_numbers()["change"]
    for section in sections.values():
        for value in section.get("E_D_relative", {}).values():
            assert f"<td>{value:.4f}</td>" in page
        for row in section.get("minima", ()):
            assert f"<td>{row['lowest']:.4f}</td><td>{row['found']:.4f}</td>" in page
        for overlaps in section.get("dice", {}).values():
            assert "".join(f"<td>{value:.3f}</td>" for value in overlaps.values()) in page
        for case in section.get("simulation", ()):
            for name, change in case["change"].items():
                assert change == pytest.approx(case["after"][name] / case["before"][name] - 1.0)
                if name in printed:
                    points = f"{100 * (change - printed[name]):+.1f} points"
                    assert (
                        f"<td>{100 * printed[name]:+.0f} %</td><td>{100 * change:+.1f} "
                        f"%</td><td>{points}</td>" in page
                    )
    (figure_2,) = [s for title, s in sections.items() if title == "Fig. 2: synthetic phantom"]
    for row, k_D in zip(figure_2["errors"][1:], (0.05, 0.3), strict=True):
        assert row["ours"] == pytest.approx(paper.errors_of(paper.figure_2(k_D).result.mesh))
    assert figure_2["dice"]["initial mesh"]["3"] < figure_2["dice"]["k_D = 0.3"]["3"] - 0.2
    (figure_1,) = [s for title, s in sections.items() if title.startswith("Fig. 1")]
    spread = paper.figure_1_spread(2)
    for row in figure_1["errors"]:
        assert_allclose(
            [row["p5"], row["p95"]], np.percentile(spread[row["name"]], [5, 95], axis=0)
        )


@pytest.mark.deep
def test_counts_and_row_3(run):
    numbers = json.loads((run / "paper.json").read_text())
    meshes = [row for section in numbers["sections"] for row in section.get("meshes", ())]
    assert [row["name"] for row in meshes] == ["fig2a", "fig3a", "fig3c", "fig3e"]
    assert all(row["paper"] == row["ours"] for row in meshes)


@pytest.mark.deep
def test_segmentation_improves_on_the_lattice(run):
    """Every label's Dice against the truth is in the JSON, and the mean of an optimised mesh
    beats the lattice's.
    """
    sections = json.loads((run / "paper.json").read_text())["sections"]
    (overlaps,) = [s["dice"] for s in sections if s["title"].startswith("Section 5")]
    labels = set(map(str, range(9)))  # of the phantom
    assert all(set(row) == labels for row in overlaps.values())
    mean = {name: np.mean(list(row.values())) for name, row in overlaps.items()}
    assert (
        mean["4 classes, lattice"]
        < mean["4 classes, optimised"]
        <= mean["4 classes, voxels"] + 1e-9
    )


@pytest.mark.deep
def test_page_in_a_browser(run, tmp_path):
    """Headless Chromium draws the page and reports no script or image error; it is short on a
    wide screen.
    """
    picture = f"--screenshot={tmp_path / 'page.png'}"
    browser(tmp_path / "profile", "--window-size=1000,3000", picture, (run / "paper.html").as_uri())
    assert np.std(np.asarray(PIL.Image.open(tmp_path / "page.png").convert("L"))) > 20.0
    height = (
        "<script>onload = ({target: {documentElement: e}}) => { e.dataset.height = "
        "e.scrollHeight; }</script>"
    )
    copy = copied(
        (run / "paper.html").read_text(encoding="utf-8"), tmp_path / "copy.html", last=height
    )
    head = document(copy, "--window-size=1280,900")[:400]
    assert int(re.search(r'data-height="(\d+)"', head)[1]) <= 5000


@pytest.mark.deep
def test_paper_refuses(tmp_path, capsys):
    tetopt.save_image(tmp_path / "flat.nii", tetopt.load_phantom("disc_2d").image(voxel_mm=4.0))
    assert reproduce(["-o", str(tmp_path / "o"), "--image", str(tmp_path / "flat.nii")]) == 2
    assert "expected a volume, got a 2-D image" in capsys.readouterr().err
    assert reproduce(["-o", str(tmp_path / "o"), "--seeds", "0"]) == 2
    assert "--seeds: expected 1 or more, got 0" in capsys.readouterr().err
    head, small = (tetopt.load_phantom("sphere").label_image(voxel_mm=size) for size in (4.0, 5.0))
    tetopt.save_image(tmp_path / "head.nii", head)
    tetopt.save_image(tmp_path / "small.nii", small)
    inputs = ["--image", str(tmp_path / "head.nii"), "--labels", str(tmp_path / "small.nii")]
    assert reproduce(["-o", str(tmp_path / "o"), *inputs]) == 2
    assert "expected labels on the image's grid" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


@pytest.fixture
def block(tmp_path):
    """A uniform block of intensity 50 and its mesh."""
    tetopt.save_image(tmp_path / "block.nii", tetopt.Image(np.full((8, 8, 8), 50.0)))
    with pytest.warns(UserWarning, match="everywhere"):
        image = tetopt.load_image(tmp_path / "block.nii")
    tetopt.save_mesh(tmp_path / "block.vtu", tetopt.lattice_mesh(image, blocks=(2, 2, 2)))
    return [str(tmp_path / "block.nii"), str(tmp_path / "block.vtu")]


def test_fem(tmp_path, block, capsys):
    """The strain energy scales with the modulus and the square of the compression; the printed
    is the written.
    """
    energies = {}
    for name, options in (
        ("one", []),
        ("twice", ["--young", "0:0,50:100"]),
        ("deep", ["--compress", "2"]),
    ):
        assert (
            main(["fem", *block, "--nu", "0.3", "--json", str(tmp_path / f"{name}.json"), *options])
            == 0
        )
        numbers = json.loads((tmp_path / f"{name}.json").read_text())
        energies[name] = numbers["strain_energy"]
        assert f"{numbers['cond']:.6g}" in capsys.readouterr().out
    assert energies["twice"] == pytest.approx(2.0 * energies["one"], rel=1e-9)
    assert energies["deep"] == pytest.approx(4.0 * energies["one"], rel=1e-9)
    assert (
        main(["fem", *block, "--nu", "0.3", "--json", str(tmp_path / "f.json"), "--young", "2*h"])
        == 0
    )
    assert json.loads((tmp_path / "f.json").read_text())["strain_energy"] == energies["twice"]
    # Between free sides, 1/2 E strain^2 V, and no sideways strain at all, (1 - nu) / ((1 + nu)(1 -
    # 2 nu)) times that.
    free = 0.5 * 50.0 * 0.01**2 * 512.0
    assert free < energies["one"] < free * 0.7 / (1.3 * 0.4)


@pytest.mark.full
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--young", "1:2;3"], "expected pairs intensity:value"),
        (["--young", "h - 100"], "such as -50 at intensity 50"),
        (["--young", "0:1,100:1", "--compress", "200"], "--compress: expected a percentage"),
        (["--young", "0:0", "--average", "mean"], "young: expected moduli above 0 kPa"),
        (
            ["--average", "power:20"],
            'power:P with P from -10 to 10, such as power:0.5, got "power:20"',
        ),
        (["--compress", "0"], "--compress"),
    ],
)
def test_fem_bad_input(block, options, words, capsys):
    assert main(["fem", *block, *options]) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert words in err[-1]


def written(folder, points, cells):
    """A mesh file with no checks between: what another program may have written."""
    kind = meshio.CellBlock("tetra", np.asarray(cells))
    meshio.Mesh(np.asarray(points, dtype=float), [kind]).write(folder / "other.vtu")
    return str(folder / "other.vtu")


@pytest.mark.full
def test_fem_bad_meshes(tmp_path, block, capsys):
    """Each refusal names the first offenders."""
    mesh = tetopt.load_mesh(block[1]).mesh
    points, cells, n = mesh.points, mesh.cells, len(mesh.points)
    loose = points[cells[0]] * 0.1 + 4.0
    half = points[cells].mean(axis=1)[:, 2] < 3.5
    flat, folded = points.copy(), points.copy()
    flat[cells[3, 3]] = flat[cells[3, :3]].mean(axis=0)
    folded[np.flatnonzero(np.all(np.abs(folded - 3.5) < 3.9, axis=1))[0]] = folded[cells[0]].mean(
        axis=0
    )
    for changed, joined, words in (
        (points * [1.0, 1.0, 0.5], cells, "no node lies on the image's face"),
        (
            np.vstack([points, loose]),
            np.vstack([cells, n + np.arange(4)]),
            f"the first has nodes [{n + 1}, ",
        ),
        (
            np.vstack([points] * 2),
            np.where(half[:, None], cells, cells + n),
            "a crack or several components",
        ),  # doubled nodes
        (points, np.vstack([cells] * 2), "overlap"),
        (points + np.array([1.0, 0.0, 0.0]), cells, "lie off the faces"),
        (flat, cells, "flat or inverted, such as [3, "),
        (folded, cells, "facets cells overlap"),
    ):
        assert main(["fem", block[0], written(tmp_path, changed, joined)]) == 2
        assert words in capsys.readouterr().err


@pytest.mark.full
def test_fem_turns_inverted_cells_and_says_so(tmp_path, block, capsys):
    """A file of left-handed cells is turned when it is read; the numbers are those of the mesh
    as it should be.
    """
    mesh = tetopt.load_mesh(block[1]).mesh
    assert main(["fem", *block, "--json", str(tmp_path / "a.json")]) == 0
    capsys.readouterr()
    inverted = written(tmp_path, mesh.points, mesh.cells[:, [1, 0, 2, 3]])
    assert main(["fem", block[0], inverted, "--json", str(tmp_path / "b.json")]) == 0
    assert f"reoriented {len(mesh.cells)} inverted cells" in capsys.readouterr().err
    a, b = (json.loads((tmp_path / name).read_text()) for name in ("a.json", "b.json"))
    assert b["strain_energy"] == pytest.approx(a["strain_energy"], rel=1e-12)


@pytest.mark.full
def test_fem_of_a_crop_and_its_output(tmp_path, capsys):
    """A mesh of a crop is pressed with the same --crop; the file written holds the displacements
    that were solved.
    """
    tetopt.save_image(tmp_path / "a.nii", tetopt.load_phantom("sphere").image(voxel_mm=4.0))
    box = ["--crop", "2:14,2:14,2:14"]
    a, mesh = str(tmp_path / "a.nii"), str(tmp_path / "m.vtu")
    assert main(["mesh", a, "-o", mesh, *box, "--nodes", "80", "--iterations", "1"]) == 0
    assert main(["fem", a, mesh]) == 2
    assert "the same image, crop and slice?" in capsys.readouterr().err
    assert main(["fem", a, mesh, *box, "--compress", "2", "-o", str(tmp_path / "p.vtu")]) == 0
    grid = meshio.read(tmp_path / "p.vtu")
    u, z = grid.point_data["displacement"], grid.points[:, 2]
    assert_allclose(u[np.isclose(z, z.max())], 0.0, atol=1e-12)
    bottom = u[np.isclose(z, z.min())]
    assert_allclose(bottom, np.tile([0.0, 0.0, 0.02 * np.ptp(z)], (len(bottom), 1)), atol=1e-12)
    assert (grid.cell_data["young"][0] > 0).all()
    assert grid.cell_data["strain"][0].shape == (len(grid.cells[0].data), 9)
    assert main(["fem", a, mesh, *box, "-o", mesh, "--force"]) == 2
    assert "is also an input" in capsys.readouterr().err


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_simulate_is_the_compression_it_says(turn):
    """Eq. (2): the mean of the voxels; the high face held, the low one pushed."""
    rng = np.random.default_rng(1)
    affine = np.diag([2.0, 1.0, 1.5, 1.0])
    c, s = np.cos(turn), np.sin(turn)
    affine = np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]]) @ affine
    image = tetopt.Image(rng.uniform(1.0, 5.0, (6, 9, 8)), affine)
    mesh = tetopt.lattice_mesh(image, nodes=60)
    simulated, pressed = paper.simulate(image, mesh)
    owner = tetopt.cell_of_voxel(image, mesh)
    means = [
        image.data[owner == cell].mean() for cell in range(len(mesh.cells)) if (owner == cell).any()
    ]
    assert_allclose(
        np.sort(simulated.young[np.bincount(owner.ravel(), minlength=len(mesh.cells)) > 0]),
        np.sort(means),
    )
    k = image.to_index(mesh.points)[:, 2]
    normal = affine[:3, 2] / 1.5
    assert_allclose(pressed.u[k > 7.4], 0.0, atol=1e-12)
    low = pressed.u[k < -0.4]
    assert_allclose(low, np.tile(0.01 * 12.0 * normal, (len(low), 1)), atol=1e-12)


def test_turning_the_world_changes_nothing():
    """A body pressed along its own axis: the energy is the same however it lies in the scanner."""
    data = np.random.default_rng(2).uniform(1.0, 5.0, (6, 5, 7))
    energies = []
    for turn in (0.0, 0.7):
        affine = np.eye(4)
        affine[1:3, 1:3] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        image = tetopt.Image(data, affine)
        energies.append(
            paper.simulate(image, tetopt.lattice_mesh(image, blocks=(3, 3, 3)))[0].strain_energy
        )
    assert_allclose(energies, energies[0], rtol=1e-9)
