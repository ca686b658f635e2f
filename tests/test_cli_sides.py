"""Walls of vessels and hearts as sets, and labels left out before and after meshing: areas
against closed forms.
"""

import re

import numpy as np
import pytest
from commands import assert_refused, exit_code, numbers_in

import tetopt
from tetopt.geometry.quadratic import of_order, quadratic
from tetopt.model.sets import Sets, area_vectors, boundary_rows, facet_triples

RADII, HALF_LENGTH = (7.0, 11.0), 16.0  # of a tube, mm; its ends are faces of the box
BLOOD, WALL = 2, 1


def area(loaded, name):
    return float(np.linalg.norm(area_vectors(loaded.mesh, loaded.sets.facets[name]), axis=1).sum())


def inward(loaded, name, middle):
    """Fraction of a set's area that faces a line or place."""
    rows = loaded.sets.facets[name]
    vectors = area_vectors(loaded.mesh, rows)
    towards = middle - loaded.mesh.points[facet_triples(loaded.mesh.cells, rows)].mean(axis=1)
    towards[:, 2] *= 0.0
    return float(np.mean((vectors * towards).sum(axis=1) > 0.0))


@pytest.fixture(scope="module")
def vessel(tmp_path_factory):
    """A tube of blood in its wall along z, as labels and meshed without the rest."""
    folder = tmp_path_factory.mktemp("vessel")
    x, y, _ = np.indices((26, 26, 32)) - np.array([12.5, 12.5, 15.5]).reshape(3, 1, 1, 1)
    far = np.hypot(x, y)
    labels = np.where(far <= RADII[0], BLOOD, np.where(far <= RADII[1], WALL, 0))
    affine = np.eye(4)
    affine[:3, 3] = -12.5, -12.5, -15.5
    tetopt.save_image(folder / "l.nii.gz", tetopt.Image(labels, affine))
    (folder / "names.csv").write_text("label,name\n1,wall\n2,blood\n", encoding="utf-8")
    words = [
        "mesh",
        folder / "l.nii.gz",
        "-o",
        folder / "v.vtu",
        "--labels",
        folder / "l.nii.gz",
        "--nodes",
        "1500",
    ]
    words += [
        "--label-names",
        folder / "names.csv",
        "--drop-labels",
        "0",
        "--json",
        folder / "v.json",
    ]
    assert exit_code(*words) in (0, 1)
    return folder


def test_the_wall_of_a_vessel_without_its_ends(vessel):
    """Inlet and outlet are planes; what is left of the boundary is the wall, and that of the
    wall alone two walls.
    """
    ends = ["--set", "inlet=plane:0,0,-16:0,0,1:0.01", "--set", "outlet=plane:0,0,16:0,0,1:0.01"]
    words = [
        "convert",
        vessel / "v.vtu",
        vessel / "w.vtu",
        *ends,
        "--set",
        "side=boundary-inlet-outlet",
        "--force",
    ]
    assert exit_code(*words) == 0
    loaded = tetopt.load_mesh(vessel / "w.vtu")
    length = 2.0 * HALF_LENGTH
    assert area(loaded, "inlet") == pytest.approx(np.pi * RADII[1] ** 2, rel=0.02)
    assert area(loaded, "side") == pytest.approx(2.0 * np.pi * RADII[1] * length, rel=0.02)
    interface = area(loaded, "interface_wall_blood")
    assert interface == pytest.approx(2.0 * np.pi * RADII[0] * length, rel=0.02)
    sides = [
        "--set",
        "lumen=inner:boundary-inlet-outlet",
        "--set",
        "outside=outer:boundary-inlet-outlet",
    ]
    kept = [
        "convert",
        vessel / "v.vtu",
        vessel / "k.vtu",
        *ends,
        *sides,
        "--keep-labels",
        "wall",
        "--force",
    ]
    assert exit_code(*kept) == 0
    wall = tetopt.load_mesh(vessel / "k.vtu")
    assert set(np.unique(wall.cell_data["label"])) == {WALL}
    assert area(wall, "lumen") == pytest.approx(interface, rel=1e-12)
    assert area(wall, "interface_wall_blood") == pytest.approx(interface, rel=1e-12)
    assert (
        exit_code(
            "convert", vessel / "v.vtu", vessel / "c.vtu", "--keep-labels", "blood", "--force"
        )
        == 0
    )
    core = tetopt.load_mesh(vessel / "c.vtu")  # its side of the interface, too
    assert area(core, "interface_wall_blood") == pytest.approx(interface, rel=1e-12)
    assert inward(core, "interface_wall_blood", np.zeros(3)) == 0.0
    assert area(wall, "outside") == pytest.approx(area(loaded, "side"), rel=1e-12)
    assert inward(wall, "lumen", np.zeros(3)) == 1.0
    assert inward(wall, "outside", np.zeros(3)) == 0.0
    assert area(wall, "inlet") == pytest.approx(np.pi * (RADII[1] ** 2 - RADII[0] ** 2), rel=0.03)


def test_an_interface_is_seen_from_either_side(vessel):
    words = [
        "convert",
        vessel / "v.vtu",
        vessel / "s.vtu",
        "--set",
        "from_blood=interface_blood_wall",
        "--force",
    ]
    assert exit_code(*words) == 0
    loaded = tetopt.load_mesh(vessel / "s.vtu")
    label = loaded.cell_data["label"]
    assert set(label[loaded.sets.facets["interface_wall_blood"][:, 0]]) == {WALL}
    assert set(label[loaded.sets.facets["from_blood"][:, 0]]) == {BLOOD}
    assert area(loaded, "from_blood") == area(loaded, "interface_wall_blood")


def test_what_is_left_out_is_gone_with_its_nodes(vessel):
    """Of either order, fields stay with their cells and nodes; a set on both sides keeps the
    part that is left.
    """
    loaded = tetopt.load_mesh(vessel / "v.vtu")
    mesh = loaded.mesh
    for order in (1, 2):
        nodes = mesh.points if order == 1 else quadratic(mesh.points, mesh.cells)[0]
        model = tetopt.build_model(mesh, order=order)._replace(
            point_data={"place": nodes}, cell_data=loaded.cell_data
        )
        path = vessel / f"o{order}.vtu"
        tetopt.save_model(path, model)
        out = vessel / f"p{order}.vtu"
        assert exit_code("convert", path, out, "--drop-labels", BLOOD, "--force") == 0
        part = tetopt.load_mesh(out)
        np.testing.assert_array_equal(
            part.point_data["place"], of_order(part.mesh.points, part.mesh.cells, order)[0]
        )
        is_kept = loaded.cell_data["label"] != BLOOD
        np.testing.assert_array_equal(part.cell_data["mean"], loaded.cell_data["mean"][is_kept])
        assert len(np.unique(part.mesh.cells)) == len(part.mesh.points)
        np.testing.assert_allclose(part.mesh.cell_volumes, mesh.cell_volumes[is_kept], rtol=1e-12)


def test_only_the_labels_that_stay_are_meshed(vessel):
    loaded, numbers = tetopt.load_mesh(vessel / "v.vtu"), numbers_in(vessel / "v.json")
    assert set(np.unique(loaded.cell_data["label"])) == {WALL, BLOOD}
    assert numbers["inputs"]["kept_labels"] == [WALL, BLOOD]
    volume = np.pi * RADII[1] ** 2 * 2.0 * HALF_LENGTH
    assert loaded.mesh.cell_volumes.sum() == pytest.approx(volume, rel=0.02)
    words = [
        "mesh",
        vessel / "l.nii.gz",
        "-o",
        vessel / "b.vtu",
        "--labels",
        vessel / "l.nii.gz",
        "--nodes",
        "300",
    ]
    names = ["--label-names", vessel / "names.csv", "--iterations", "2"]
    assert exit_code(*words, *names, "--keep-labels", "blood", "--force") in (0, 1)
    blood = tetopt.load_mesh(vessel / "b.vtu")
    assert set(np.unique(blood.cell_data["label"])) == {BLOOD}
    assert blood.label_table.names[BLOOD] == "blood"
    seg = tetopt.load_image(vessel / "l.nii.gz")
    half = tetopt.Image(1.0 * (np.indices(seg.shape)[2] < 16), seg.affine)
    tetopt.save_image(vessel / "half.nii.gz", half)
    masked = [*words, *names, "--keep-labels", "blood", "--mask", vessel / "half.nii.gz", "--force"]
    assert exit_code(*masked) in (0, 1)
    expected = np.pi * RADII[0] ** 2 * HALF_LENGTH
    assert tetopt.load_mesh(vessel / "b.vtu").mesh.cell_volumes.sum() == pytest.approx(
        expected, rel=0.03
    )


def test_loads_and_the_mask_of_what_is_left_out_go(vessel, capsys):
    """The sets of the same names are others now."""
    words = [
        "convert",
        vessel / "v.vtu",
        vessel / "l.vtu",
        "--young",
        "2",
        "--nu",
        "0.3",
        "--load",
        "pressure:boundary:1",
    ]
    assert exit_code(*words, "--load", "hold:inferior", "--force") == 0
    capsys.readouterr()
    assert (
        exit_code(
            "convert", vessel / "l.vtu", vessel / "m.vtu", "--drop-labels", "blood", "--force"
        )
        == 0
    )
    assert "left out: pressure:boundary:1" in " ".join(capsys.readouterr().err.split())
    before, after = tetopt.load_mesh(vessel / "l.vtu"), tetopt.load_mesh(vessel / "m.vtu")
    # no voxel outside counts afterwards, either
    assert before.text("mask") == after.text("mask") is not None
    assert "loads" in before.field_data
    assert "loads" not in after.field_data


def test_separate_bodies_and_a_lumen_alone():
    """A tube in a tube has two lumens and two outsides; a tunnel's wall is inner with nothing
    around it.
    """
    x, y = np.indices((30, 30, 8))[:2] - 14.5
    far = np.hypot(x, y)
    image = tetopt.Image(1.0 * (((far > 4) & (far <= 7)) | ((far > 10) & (far <= 14))), np.eye(4))
    mesh = tetopt.mesh_image(image, 1500, mask=image, iterations=2).mesh
    box = tetopt.Box(image.shape, image.affine)
    sides = ["in=inner:boundary-inferior-superior", "out=outer:mask_surface"]
    sets = tetopt.build_model(mesh, box=box, sets=sides).sets.facets
    radius = {
        name: np.hypot(
            *(mesh.points[facet_triples(mesh.cells, sets[name])].mean(axis=1)[:, :2] - 14.5).T
        )
        for name in ("in", "out")
    }
    for name, (near, farther) in {"in": (4, 10), "out": (7, 14)}.items():
        off = np.minimum(np.abs(radius[name] - near), np.abs(radius[name] - farther))
        assert off.max() < 1.3  # of radii that are 3 apart
        assert len(np.unique(radius[name] > 8.5)) == 2
    block = tetopt.Image(1.0 * (far > 5), np.eye(4))
    tunnel = tetopt.mesh_image(block, 800, mask=block, iterations=2).mesh
    lumen = tetopt.build_model(tunnel, box=box, sets=["lumen=inner:mask_surface"]).sets.facets
    np.testing.assert_array_equal(lumen["lumen"], lumen["mask_surface"])


@pytest.fixture(scope="module")
def skull(tmp_path_factory):
    """A ball of bone with two rooms of air, and a canal from the outside into a third."""
    folder = tmp_path_factory.mktemp("skull")
    index = np.indices((30, 30, 30))
    far = [
        np.linalg.norm(index - np.reshape(middle, (3, 1, 1, 1)), axis=0)
        for middle in ((15, 15, 15), (10, 15, 15), (20, 15, 15), (15, 15, 22))
    ]
    canal = (np.hypot(index[0] - 15, index[1] - 15) < 2) & (index[2] > 22)
    labels = np.where(
        (far[1] < 4) | (far[2] < 3) | (far[3] < 3) | canal, 0, np.where(far[0] < 13, BLOOD, 0)
    )
    labels[1, 1, 1] = WALL
    tetopt.save_image(
        folder / "l.nii.gz", tetopt.Image(labels.astype(np.uint8), np.diag([1.0, 1.0, 2.0, 1.0]))
    )
    (folder / "names.csv").write_text("label,name\n1,speck\n2,bone\n", encoding="utf-8")
    return folder, labels, [int((far[k] < radius).sum()) for k, radius in ((1, 4), (2, 3))]


@pytest.mark.parametrize(("word", "label"), [("bone", BLOOD), ("300", 300)])
def test_enclosed_air_gets_a_label(skull, capsys, word, label):
    """Told by volume; an open cavity stays, and a number beyond those of the file's type is one,
    too.
    """
    folder, labels, sizes = skull
    words = [
        "mesh",
        folder / "l.nii.gz",
        "--labels",
        folder / "l.nii.gz",
        "--label-names",
        folder / "names.csv",
    ]
    words += [
        "--nodes",
        "1200",
        "--iterations",
        "2",
        "--background",
        "0",
        "-o",
        folder / f"{word}.vtu",
        "--force",
    ]
    assert exit_code(*words, "--fill-holes", word) in (0, 1)
    told, said = (
        f"2 holes of {2 * sum(sizes)} mm3, the largest {2 * sizes[0]}",
        " ".join(capsys.readouterr().err.split()),
    )
    assert told in said
    assert f"labels around most of each hole: 2 (bone) {2 * sum(sizes)} mm3" in said
    loaded = tetopt.load_mesh(folder / f"{word}.vtu")
    of_cell, volume = loaded.cell_data["label"], loaded.mesh.cell_volumes
    assert set(np.unique(of_cell)) - {0} == {WALL, BLOOD, label} - (
        {WALL} - set(np.unique(of_cell))
    )
    if label == 300:
        assert (
            np.median(loaded.cell_data["mean"][of_cell == 300]) == 300.0
        )  # the image, of labels alone, is filled, too
        assert volume[of_cell == 300].sum() == pytest.approx(2 * sum(sizes), rel=0.1)
    bone = 2 * ((labels == BLOOD).sum() + (sum(sizes) if label == BLOOD else 0))
    assert volume[of_cell == BLOOD].sum() == pytest.approx(bone, rel=0.02)
    check = [
        "quality",
        folder / f"{word}.vtu",
        "--image",
        folder / "l.nii.gz",
        "--labels",
        folder / "l.nii.gz",
    ]
    assert exit_code(*check, "--json", folder / "q.json", "--force") in (0, 1)
    rows = {row["label"]: row for row in numbers_in(folder / "q.json")["labels"]}
    assert rows[label]["dice"] > 0.85  # against the filled labels
    assert rows[BLOOD]["dice"] > 0.97


def test_probabilities_are_not_filled(tmp_path):
    """A hole of tissues gets a label; the image that is one of them keeps its values."""
    far = np.linalg.norm(np.indices((14, 14, 14)) - 6.5, axis=0)
    for name, data in {"g": 0.8 * ((far < 6) & (far > 2)), "w": 0.6 * (far >= 6)}.items():
        tetopt.save_image(tmp_path / f"{name}.nii.gz", tetopt.Image(data))
    words = [
        "mesh",
        tmp_path / "g.nii.gz",
        "--tissues",
        f"{tmp_path / 'g.nii.gz'},{tmp_path / 'w.nii.gz'}",
    ]
    words += ["--nodes", "400", "--iterations", "2", "--fill-holes", "7", "-o", tmp_path / "a.vtu"]
    assert exit_code(*words) in (0, 1)
    loaded = tetopt.load_mesh(tmp_path / "a.vtu")
    assert 7 in loaded.cell_data["label"]
    assert loaded.cell_data["mean"].max() <= 0.8 + 1e-6


def test_other_labels_are_measured_by_those_that_they_have(vessel, tmp_path):
    """Another rater's, without a label that the mesh kept."""
    seg = tetopt.load_image(vessel / "l.nii.gz")
    other = tetopt.Image(np.where(seg.data == WALL, 0.0, seg.data), seg.affine)
    tetopt.save_image(tmp_path / "o.nii.gz", other)
    words = [
        "quality",
        vessel / "v.vtu",
        "--image",
        vessel / "l.nii.gz",
        "--labels",
        tmp_path / "o.nii.gz",
    ]
    assert exit_code(*words, "--json", tmp_path / "q.json") in (0, 1)
    assert BLOOD in {row["label"] for row in numbers_in(tmp_path / "q.json")["labels"]}


def test_no_hole_is_told(vessel, capsys):
    words = [
        "mesh",
        vessel / "l.nii.gz",
        "--labels",
        vessel / "l.nii.gz",
        "-o",
        vessel / "h.vtu",
        "--iterations",
        "0",
    ]
    assert exit_code(*words, "--nodes", "300", "--fill-holes", "2", "--force") in (0, 1)
    assert "no voxel of label 0 is enclosed" in " ".join(capsys.readouterr().err.split())


def test_crumbs_go_with_what_held_them(tmp_path, capsys):
    """A cell of a label that only hung on another one; a small label of its own stays. Sets that
    shrink are told.
    """
    mesh = tetopt.lattice_mesh(tetopt.Image(np.zeros((20, 8, 8)), np.eye(4)), nodes=300)
    x = mesh.points[mesh.cells].mean(axis=1)[:, 0]
    labels = np.where(x < 10.0, WALL, np.where(x < 17.0, BLOOD, 3))
    crumb = int(np.abs(x - 13.5).argmin())
    labels[crumb] = WALL
    rows = boundary_rows(mesh)
    sets = Sets({"skin": rows[x[rows[:, 0]] > 8.0]}, {"core": np.flatnonzero(x > 8.0)})
    tetopt.save_model(tmp_path / "a.vtu", tetopt.Model(mesh, {"label": labels}, sets))
    assert exit_code("convert", tmp_path / "a.vtu", tmp_path / "b.vtu", "--drop-labels", BLOOD) == 0
    said, part = " ".join(capsys.readouterr().err.split()), tetopt.load_mesh(tmp_path / "b.vtu")
    volume = mesh.cell_volumes[crumb]
    assert volume < 0.01 * mesh.cell_volumes[labels == WALL].sum()
    assert f"1 component (1 cell, {volume:.4g} mm3), less than 1% of any label" in said
    kept = (labels != BLOOD) & (np.arange(len(labels)) != crumb)
    assert len(part.mesh.cells) == kept.sum()
    assert re.search(
        r'set "skin" keeps \d+ of its \d+ facets; the others are of labels left out', said
    )
    assert f'set "core" keeps {(kept & (x > 8.0)).sum()} of its {(x > 8.0).sum()} cells' in said


def test_labels_left_out_are_not_measured_as_lost(vessel):
    """Neither of a mesh built without them, nor after `convert`."""
    assert (
        exit_code(
            "convert", vessel / "v.vtu", vessel / "k.vtu", "--keep-labels", "blood", "--force"
        )
        == 0
    )
    labels = [
        "--image",
        vessel / "l.nii.gz",
        "--labels",
        vessel / "l.nii.gz",
        "--json",
        vessel / "q.json",
        "--force",
    ]
    for name, kept in (("v.vtu", {WALL, BLOOD}), ("k.vtu", {BLOOD})):
        assert exit_code("quality", vessel / name, *labels) in (0, 1)
        numbers = numbers_in(vessel / "q.json")
        assert {row["label"] for row in numbers["labels"]} - {0} == kept
        assert all(row["dice"] > 0.9 for row in numbers["labels"] if row["label"])


@pytest.mark.parametrize(
    ("command", "options", "match"),
    [
        ("mesh", ["--fill-holes", "0"], 'expected one label from 1 to 2147483647, got "0"'),
        ("mesh", ["--fill-holes", "liver"], "labels have no names"),
        ("mesh", ["--keep-labels", "2", "--drop-labels", "1"], "give only one of them"),
        ("mesh", ["--keep-labels", "7"], 'there is no label "7"; there are 0, 1, 2'),
        ("mesh", ["--drop-labels", "0,1,2"], "no label would be left"),
        ("convert", ["--keep-labels", "liver"], "no label has this name"),
        ("convert", ["--set", "side=boundary-inlett"], 'no set of facets begins "inlett"'),
        ("convert", ["--set", "side=outer:"], "expected names of sets"),
        ("convert", ["--set", "cavity=inner:boundary"], "inner boundary has no facet"),
        (
            "convert",
            ["--set", "none=boundary-boundary"],
            "the difference boundary-boundary has no facet",
        ),
    ],
)
def test_other_labels_and_sets_are_rejected(vessel, capfd, command, options, match):
    capfd.readouterr()
    words = (
        [vessel / "l.nii.gz", "--labels", vessel / "l.nii.gz", "-o"]
        if command == "mesh"
        else [vessel / "v.vtu"]
    )
    assert_refused(capfd, [command, *words, vessel / "no.vtu", *options], match)
    assert not (vessel / "no.vtu").exists()


@pytest.fixture(scope="module")
def cup(tmp_path_factory):
    """A left ventricle: half an ellipsoid of blood in muscle, open at the top face of the box."""
    folder = tmp_path_factory.mktemp("cup")
    x, y, z = np.indices((40, 40, 30)) - np.array([19.5, 19.5, 29.5]).reshape(3, 1, 1, 1)
    blood, muscle = (
        (x / a) ** 2 + (y / a) ** 2 + (z / c) ** 2 <= 1.0 for a, c in ((11.0, 20.0), (17.0, 26.0))
    )
    labels = np.where(blood, BLOOD, np.where(muscle, WALL, 0))
    tetopt.save_image(folder / "l.nii.gz", tetopt.Image(labels, np.eye(4)))
    tetopt.save_image(folder / "m.nii.gz", tetopt.Image(1.0 * (labels == WALL), np.eye(4)))
    return folder


def half_spheroid(a, c):
    """Area of half a prolate spheroid without its base."""
    e = np.sqrt(1.0 - (a / c) ** 2)
    return np.pi * a**2 * (1.0 + c / (a * e) * np.arcsin(e))


def test_endocardium_and_epicardium_with_blood_and_without(cup):
    """Meshed without blood, or with a label of blood that is dropped afterwards: the same areas,
    those of spheroids.
    """
    sides = [
        "--set",
        "endo=inner:boundary-superior",
        "--set",
        "epi=outer:boundary-superior",
        "--nodes",
        "2500",
    ]
    words = ["mesh", cup / "l.nii.gz", "--force", "-o"]
    assert exit_code(*words, cup / "a.vtu", "--mask", cup / "m.nii.gz", *sides) in (0, 1)
    assert exit_code(
        *words, cup / "b.vtu", "--labels", cup / "l.nii.gz", "--drop-labels", "0", *sides[4:]
    ) in (0, 1)
    assert (
        exit_code(
            "convert", cup / "b.vtu", cup / "c.vtu", "--drop-labels", BLOOD, *sides[:4], "--force"
        )
        == 0
    )
    alone, dropped = tetopt.load_mesh(cup / "a.vtu"), tetopt.load_mesh(cup / "c.vtu")
    for name, (a, c) in {"endo": (11.0, 20.5), "epi": (17.0, 26.5)}.items():
        assert area(alone, name) == pytest.approx(area(dropped, name), rel=0.03)
        assert area(alone, name) == pytest.approx(half_spheroid(a, c), rel=0.05)
    assert area(dropped, "endo") == pytest.approx(
        area(dropped, f"interface_{WALL}_{BLOOD}"), rel=1e-12
    )
    rows = np.concatenate([dropped.sets.facets[name] for name in ("endo", "epi", "superior")])
    assert sorted(map(tuple, rows.tolist())) == sorted(
        map(tuple, boundary_rows(dropped.mesh).tolist())
    )
