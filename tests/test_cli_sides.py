"""Walls of vessels and hearts as sets, and labels left out before and after meshing: areas
against closed forms.
"""

import re

import numpy as np
import pytest
from commands import assert_done, assert_refused, exit_code, in_copy_of, numbers_in
from numpy.testing import assert_array_equal

import tetopt
from tetopt import Image, build_model, load_image, load_mesh, mesh_image, save_image, save_model
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


here = in_copy_of("vessel")


@pytest.fixture(scope="module")
def vessel(tmp_path_factory):
    """A tube of blood in its wall along z, as labels and meshed without the rest."""
    folder = tmp_path_factory.mktemp("vessel")
    x, y, _ = np.indices((26, 26, 32)) - np.array([12.5, 12.5, 15.5]).reshape(3, 1, 1, 1)
    far = np.hypot(x, y)
    labels = np.where(far <= RADII[0], BLOOD, np.where(far <= RADII[1], WALL, 0))
    affine = np.eye(4)
    affine[:3, 3] = -12.5, -12.5, -15.5
    save_image(folder / "l.nii.gz", Image(labels, affine))
    (folder / "names.csv").write_text("label,name\n1,wall\n2,blood\n", encoding="utf-8")
    words = [
        "mesh",
        folder / "l.nii.gz",
        "-o",
        folder / "v.vtu",
        "--labels",
        folder / "l.nii.gz",
        "--nodes 1500 --label-names",
        folder / "names.csv",
        "--drop-labels 0 --json",
        folder / "v.json",
    ]
    assert exit_code(*words) in (0, 1)
    return folder


def test_the_wall_of_a_vessel_without_its_ends():
    """Inlet and outlet are planes; what is left of the boundary is the wall, and that of the
    wall alone two walls.
    """
    ends = "--set inlet=plane:0,0,-16:0,0,1:0.01 --set outlet=plane:0,0,16:0,0,1:0.01"
    assert_done(f"convert v.vtu w.vtu {ends} --set side=boundary-inlet-outlet")
    loaded = load_mesh("w.vtu")
    length = 2.0 * HALF_LENGTH
    assert area(loaded, "inlet") == pytest.approx(np.pi * RADII[1] ** 2, rel=0.02)
    assert area(loaded, "side") == pytest.approx(2.0 * np.pi * RADII[1] * length, rel=0.02)
    interface = area(loaded, "interface_wall_blood")
    assert interface == pytest.approx(2.0 * np.pi * RADII[0] * length, rel=0.025)
    sides = "--set lumen=inner:boundary-inlet-outlet --set outside=outer:boundary-inlet-outlet"
    assert_done(f"convert v.vtu k.vtu {ends} {sides} --keep-labels wall")
    wall = load_mesh("k.vtu")
    assert set(np.unique(wall.cell_data["label"])) == {WALL}
    assert area(wall, "lumen") == pytest.approx(interface, rel=1e-12)
    assert area(wall, "interface_wall_blood") == pytest.approx(interface, rel=1e-12)
    assert_done("convert v.vtu c.vtu --keep-labels blood --force")
    core = load_mesh("c.vtu")  # its side of the interface, too
    assert area(core, "interface_wall_blood") == pytest.approx(interface, rel=1e-12)
    assert inward(core, "interface_wall_blood", np.zeros(3)) == 0.0
    assert area(wall, "outside") == pytest.approx(area(loaded, "side"), rel=1e-12)
    assert inward(wall, "lumen", np.zeros(3)) == 1.0
    assert inward(wall, "outside", np.zeros(3)) == 0.0
    assert area(wall, "inlet") == pytest.approx(np.pi * (RADII[1] ** 2 - RADII[0] ** 2), rel=0.03)


def test_an_interface_is_seen_from_either_side():
    words = "convert v.vtu s.vtu --set from_blood=interface_blood_wall --force"
    assert_done(words)
    loaded = load_mesh("s.vtu")
    label = loaded.cell_data["label"]
    assert set(label[loaded.sets.facets["interface_wall_blood"][:, 0]]) == {WALL}
    assert set(label[loaded.sets.facets["from_blood"][:, 0]]) == {BLOOD}
    assert area(loaded, "from_blood") == area(loaded, "interface_wall_blood")


def test_what_is_left_out_is_gone_with_its_nodes():
    """Of either order, fields stay with their cells and nodes; a set on both sides keeps the
    part that is left.
    """
    loaded = load_mesh("v.vtu")
    mesh = loaded.mesh
    for order in (1, 2):
        nodes = mesh.points if order == 1 else quadratic(mesh.points, mesh.cells)[0]
        model = build_model(mesh, order=order)._replace(
            point_data={"place": nodes}, cell_data=loaded.cell_data
        )
        path = f"o{order}.vtu"
        save_model(path, model)
        out = f"p{order}.vtu"
        assert_done(f"convert {path} {out} --drop-labels {BLOOD} --force")
        part = load_mesh(out)
        assert_array_equal(
            part.point_data["place"], of_order(part.mesh.points, part.mesh.cells, order)[0]
        )
        is_kept = loaded.cell_data["label"] != BLOOD
        assert_array_equal(part.cell_data["mean"], loaded.cell_data["mean"][is_kept])
        assert len(np.unique(part.mesh.cells)) == len(part.mesh.points)
        np.testing.assert_allclose(part.mesh.cell_volumes, mesh.cell_volumes[is_kept], rtol=1e-12)


def test_only_the_labels_that_stay_are_meshed():
    loaded, numbers = load_mesh("v.vtu"), numbers_in("v.json")
    assert set(np.unique(loaded.cell_data["label"])) == {WALL, BLOOD}
    assert numbers["inputs"]["kept_labels"] == [WALL, BLOOD]
    volume = np.pi * RADII[1] ** 2 * 2.0 * HALF_LENGTH
    assert loaded.mesh.cell_volumes.sum() == pytest.approx(volume, rel=0.02)
    words = "mesh l.nii.gz -o b.vtu --labels l.nii.gz --nodes 300"
    names = "--label-names names.csv --iterations 2"
    assert exit_code(f"{words} {names} --keep-labels blood --force") in (0, 1)
    blood = load_mesh("b.vtu")
    assert set(np.unique(blood.cell_data["label"])) == {BLOOD}
    assert blood.label_table.names[BLOOD] == "blood"
    seg = load_image("l.nii.gz")
    half = Image(1.0 * (np.indices(seg.shape)[2] < 16), seg.affine)
    save_image("half.nii.gz", half)
    masked = "--keep-labels blood --mask half.nii.gz --force"
    assert exit_code(words, names, masked) in (0, 1)
    expected = np.pi * RADII[0] ** 2 * HALF_LENGTH
    assert load_mesh("b.vtu").mesh.cell_volumes.sum() == pytest.approx(expected, rel=0.03)


def test_loads_and_the_mask_of_what_is_left_out_go(capsys):
    """The sets of the same names are others now."""
    words = "convert v.vtu l.vtu --young 2 --nu 0.3 --load pressure:boundary:1"
    assert_done(f"{words} --load hold:inferior --force")
    capsys.readouterr()
    assert_done("convert l.vtu m.vtu --drop-labels blood --force")
    assert "left out: pressure:boundary:1" in capsys.readouterr().err
    before, after = load_mesh("l.vtu"), load_mesh("m.vtu")
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
    image = Image(1.0 * (((far > 4) & (far <= 7)) | ((far > 10) & (far <= 14))), np.eye(4))
    mesh = mesh_image(image, 1500, mask=image, iterations=2).mesh
    box = tetopt.Box(image.shape, image.affine)
    sides = ["in=inner:boundary-inferior-superior", "out=outer:mask_surface"]
    sets = build_model(mesh, box=box, sets=sides).sets.facets
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
    block = Image(1.0 * (far > 5), np.eye(4))
    tunnel = mesh_image(block, 800, mask=block, iterations=2).mesh
    lumen = build_model(tunnel, box=box, sets=["lumen=inner:mask_surface"]).sets.facets
    assert_array_equal(lumen["lumen"], lumen["mask_surface"])


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
    save_image(folder / "l.nii.gz", Image(labels.astype(np.uint8), np.diag([1.0, 1.0, 2.0, 1.0])))
    (folder / "names.csv").write_text("label,name\n1,speck\n2,bone\n", encoding="utf-8")
    return folder, labels, [int((far[k] < radius).sum()) for k, radius in ((1, 4), (2, 3))]


@pytest.mark.parametrize(("word", "label"), [("bone", BLOOD), ("300", 300)])
def test_enclosed_air_gets_a_label(skull, monkeypatch, capsys, word, label):
    """Told by volume; an open cavity stays, and a number beyond those of the file's type is one,
    too.
    """
    folder, labels, sizes = skull
    monkeypatch.chdir(folder)
    words = "mesh l.nii.gz --labels l.nii.gz --label-names names.csv --nodes 1200 --iterations 2"
    fill = f"--background 0 -o {word}.vtu --fill-holes {word}"
    assert exit_code(words, fill) in (0, 1)
    said = capsys.readouterr().err
    assert f"2 holes of {2 * sum(sizes)} mm3, the largest {2 * sizes[0]}" in said
    assert f"labels around most of each hole: 2 (bone) {2 * sum(sizes)} mm3" in said
    loaded = load_mesh(f"{word}.vtu")
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
    check = f"quality {word}.vtu --image l.nii.gz --labels l.nii.gz --json q.json --force"
    assert exit_code(check) in (0, 1)
    rows = {row["label"]: row for row in numbers_in("q.json")["labels"]}
    assert rows[label]["dice"] > 0.85  # against the filled labels
    assert rows[BLOOD]["dice"] > 0.97


def test_probabilities_are_not_filled():
    """A hole of tissues gets a label; the image that is one of them keeps its values."""
    far = np.linalg.norm(np.indices((14, 14, 14)) - 6.5, axis=0)
    for name, data in {"g": 0.8 * ((far < 6) & (far > 2)), "w": 0.6 * (far >= 6)}.items():
        save_image(f"{name}.nii.gz", Image(data))
    words = "mesh g.nii.gz --tissues g.nii.gz,w.nii.gz --nodes 400 --iterations 2 -o a.vtu"
    assert exit_code(f"{words} --fill-holes 7") in (0, 1)
    loaded = load_mesh("a.vtu")
    assert 7 in loaded.cell_data["label"]
    assert loaded.cell_data["mean"].max() <= 0.8 + 1e-6


def test_other_labels_are_measured_by_those_that_they_have():
    """Another rater's, without a label that the mesh kept."""
    seg = load_image("l.nii.gz")
    other = Image(np.where(seg.data == WALL, 0.0, seg.data), seg.affine)
    save_image("o.nii.gz", other)
    assert exit_code("quality v.vtu --image l.nii.gz --labels o.nii.gz --json q.json") in (0, 1)
    assert BLOOD in {row["label"] for row in numbers_in("q.json")["labels"]}


def test_no_hole_is_told(capsys):
    words = "mesh l.nii.gz --labels l.nii.gz -o h.vtu --iterations 0"
    assert exit_code(f"{words} --nodes 300 --fill-holes 2 --force") in (0, 1)
    assert "no voxel of label 0 is enclosed" in capsys.readouterr().err


def test_crumbs_go_with_what_held_them(capsys):
    """A cell of a label that only hung on another one; a small label of its own stays. Sets that
    shrink are told.
    """
    mesh = tetopt.lattice_mesh(Image(np.zeros((20, 8, 8)), np.eye(4)), nodes=300)
    x = mesh.points[mesh.cells].mean(axis=1)[:, 0]
    labels = np.where(x < 10.0, WALL, np.where(x < 17.0, BLOOD, 3))
    crumb = int(np.abs(x - 13.5).argmin())
    labels[crumb] = WALL
    rows = boundary_rows(mesh)
    sets = Sets({"skin": rows[x[rows[:, 0]] > 8.0]}, {"core": np.flatnonzero(x > 8.0)})
    save_model("a.vtu", tetopt.Model(mesh, {"label": labels}, sets))
    assert_done(f"convert a.vtu b.vtu --drop-labels {BLOOD}")
    said, part = capsys.readouterr().err, load_mesh("b.vtu")
    volume = mesh.cell_volumes[crumb]
    assert volume < 0.01 * mesh.cell_volumes[labels == WALL].sum()
    assert f"1 component (1 cell, {volume:.4g} mm3), less than 1% of any label" in said
    kept = (labels != BLOOD) & (np.arange(len(labels)) != crumb)
    assert len(part.mesh.cells) == kept.sum()
    assert re.search(
        r'set "skin" keeps \d+ of its \d+ facets; the others are of labels left out', said
    )
    assert f'set "core" keeps {(kept & (x > 8.0)).sum()} of its {(x > 8.0).sum()} cells' in said


def test_labels_left_out_are_not_measured_as_lost():
    """Neither of a mesh built without them, nor after `convert`."""
    assert_done("convert v.vtu k.vtu --keep-labels blood --force")
    for name, kept in (("v.vtu", {WALL, BLOOD}), ("k.vtu", {BLOOD})):
        assert exit_code(
            f"quality {name} --image l.nii.gz --labels l.nii.gz --json q.json --force"
        ) in (0, 1)
        numbers = numbers_in("q.json")
        assert {row["label"] for row in numbers["labels"]} - {0} == kept
        assert all(row["dice"] > 0.9 for row in numbers["labels"] if row["label"])


@pytest.mark.parametrize(
    ("command", "options", "match"),
    [
        ("mesh", "--fill-holes 0", 'expected one label from 1 to 2147483647, got "0"'),
        ("mesh", "--fill-holes liver", "labels have no names"),
        ("mesh", "--keep-labels 2 --drop-labels 1", "give only one of them"),
        ("mesh", "--keep-labels 7", 'there is no label "7"; there are 0, 1, 2'),
        ("mesh", "--drop-labels 0,1,2", "no label would be left"),
        ("convert", "--keep-labels liver", "no label has this name"),
        ("convert", "--set side=boundary-inlett", 'no set of facets begins "inlett"'),
        ("convert", "--set side=outer:", "expected names of sets"),
        ("convert", "--set cavity=inner:boundary", "inner boundary has no facet"),
        (
            "convert",
            "--set none=boundary-boundary",
            "the difference boundary-boundary has no facet",
        ),
    ],
)
def test_other_labels_and_sets_are_rejected(capfd, command, options, match):
    words = "l.nii.gz --labels l.nii.gz -o" if command == "mesh" else "v.vtu"
    assert_refused(capfd, f"{command} {words} no.vtu {options}", match)


@pytest.fixture(scope="module")
def cup(tmp_path_factory):
    """A left ventricle: half an ellipsoid of blood in muscle, open at the top face of the box."""
    folder = tmp_path_factory.mktemp("cup")
    x, y, z = np.indices((40, 40, 30)) - np.array([19.5, 19.5, 29.5]).reshape(3, 1, 1, 1)
    blood, muscle = (
        (x / a) ** 2 + (y / a) ** 2 + (z / c) ** 2 <= 1.0 for a, c in ((11.0, 20.0), (17.0, 26.0))
    )
    labels = np.where(blood, BLOOD, np.where(muscle, WALL, 0))
    save_image(folder / "l.nii.gz", Image(labels, np.eye(4)))
    save_image(folder / "m.nii.gz", Image(1.0 * (labels == WALL), np.eye(4)))
    return folder


def half_spheroid(a, c):
    """Area of half a prolate spheroid without its base."""
    e = np.sqrt(1.0 - (a / c) ** 2)
    return np.pi * a**2 * (1.0 + c / (a * e) * np.arcsin(e))


def test_endocardium_and_epicardium_with_blood_and_without(cup, monkeypatch):
    """Meshed without blood, or with a label of blood that is dropped afterwards: the same areas,
    those of spheroids.
    """
    monkeypatch.chdir(cup)
    sides = "--set endo=inner:boundary-superior --set epi=outer:boundary-superior"
    words = "mesh l.nii.gz --nodes 2500 -o"
    assert exit_code(f"{words} a.vtu --mask m.nii.gz {sides}") in (0, 1)
    assert exit_code(f"{words} b.vtu --labels l.nii.gz --drop-labels 0") in (0, 1)
    assert_done(f"convert b.vtu c.vtu --drop-labels {BLOOD} {sides}")
    alone, dropped = load_mesh("a.vtu"), load_mesh("c.vtu")
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
