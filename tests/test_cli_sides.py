"""Walls of vessels and hearts as sets, and labels left out before and after meshing: areas
against closed forms.
"""

import re

import numpy as np
import pytest
from commands import assert_done, in_copy_of, numbers_in, refusals, run_command
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt import Image, build_model, load_image, load_mesh, mesh_image, save_image, save_model
from tetopt.geometry.quadratic import of_order, quadratic
from tetopt.model.sets import Sets, area_vectors, boundary_rows, facet_triples

RADII, HALF_LENGTH = (7.0, 11.0), 16.0  # of a tube, mm; its ends are faces of the box
BLOOD, WALL = 2, 1


def area(loaded, name):
    return np.linalg.norm(area_vectors(loaded.mesh, loaded.sets.facets[name]), axis=1).sum()


def inward(loaded, name):
    """Fraction of a set's area that faces the axis x = y = 0."""
    rows = loaded.sets.facets[name]
    towards = -loaded.mesh.points[facet_triples(loaded.mesh.cells, rows)].mean(axis=1)
    towards[:, 2] = 0.0
    return np.mean((area_vectors(loaded.mesh, rows) * towards).sum(axis=1) > 0.0)


def labels_in(loaded):
    return set(np.unique(loaded.cell_data["label"]))


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
    words = f"mesh {folder}/l.nii.gz -o {folder}/v.vtu --labels {folder}/l.nii.gz --nodes 1500"
    names = f"--label-names {folder}/names.csv"
    run_command(f"{words} {names} --drop-labels 0 --json {folder}/v.json", code=None)
    return folder


def test_the_wall_of_a_vessel_without_its_ends():
    """Inlet and outlet are planes; what is left of the boundary is the wall, and that of the
    wall alone two walls.
    """
    ends = "--set inlet=plane:0,0,-16:0,0,1:0.01 --set outlet=plane:0,0,16:0,0,1:0.01"
    more = "--set side=boundary-inlet-outlet --set from_blood=interface_blood_wall"
    assert_done(f"convert v.vtu w.vtu {ends} {more}")
    sides = "--set lumen=inner:boundary-inlet-outlet --set outside=outer:boundary-inlet-outlet"
    assert_done(f"convert v.vtu k.vtu {ends} {sides} --keep-labels wall")
    assert_done("convert v.vtu c.vtu --keep-labels blood")
    whole, wall, core = (load_mesh(f"{name}.vtu") for name in "wkc")
    length = 2.0 * HALF_LENGTH
    assert area(whole, "inlet") == pytest.approx(np.pi * RADII[1] ** 2, rel=0.02)
    assert area(whole, "side") == pytest.approx(2.0 * np.pi * RADII[1] * length, rel=0.02)
    interface = area(whole, "interface_wall_blood")
    assert interface == pytest.approx(2.0 * np.pi * RADII[0] * length, rel=0.025)
    # An interface is seen from either side.
    label = whole.cell_data["label"]
    for name, holder in (("interface_wall_blood", WALL), ("from_blood", BLOOD)):
        assert set(label[whole.sets.facets[name][:, 0]]) == {holder}
    assert area(whole, "from_blood") == interface
    assert labels_in(wall) == {WALL}
    for part, name in (
        (wall, "lumen"),
        (wall, "interface_wall_blood"),
        (core, "interface_wall_blood"),  # its side of the interface, too
    ):
        assert area(part, name) == pytest.approx(interface, rel=1e-12)
    assert area(wall, "outside") == pytest.approx(area(whole, "side"), rel=1e-12)
    assert inward(wall, "lumen") == 1.0
    assert inward(wall, "outside") == inward(core, "interface_wall_blood") == 0.0
    ring = np.pi * (RADII[1] ** 2 - RADII[0] ** 2)
    assert area(wall, "inlet") == pytest.approx(ring, rel=0.03)


@pytest.mark.parametrize("order", [1, 2])
def test_what_is_left_out_is_gone_with_its_nodes(order):
    """Fields stay with their cells and nodes; a set on both sides keeps the part that is left."""
    loaded = load_mesh("v.vtu")
    mesh, is_kept = loaded.mesh, loaded.cell_data["label"] != BLOOD
    nodes = mesh.points if order == 1 else quadratic(mesh.points, mesh.cells)[0]
    model = build_model(mesh, order=order)._replace(
        point_data={"place": nodes}, cell_data=loaded.cell_data
    )
    save_model("o.vtu", model)
    assert_done(f"convert o.vtu p.vtu --drop-labels {BLOOD}")
    part = load_mesh("p.vtu")
    places = of_order(part.mesh.points, part.mesh.cells, order)[0]
    assert_array_equal(part.point_data["place"], places)
    assert_array_equal(part.cell_data["mean"], loaded.cell_data["mean"][is_kept])
    assert len(np.unique(part.mesh.cells)) == len(part.mesh.points)
    assert_allclose(part.mesh.cell_volumes, mesh.cell_volumes[is_kept], rtol=1e-12)


def test_only_the_labels_that_stay_are_meshed():
    loaded = load_mesh("v.vtu")
    assert labels_in(loaded) == {WALL, BLOOD}
    assert numbers_in("v.json")["inputs"]["kept_labels"] == [WALL, BLOOD]
    volume = np.pi * RADII[1] ** 2 * 2.0 * HALF_LENGTH
    assert loaded.mesh.cell_volumes.sum() == pytest.approx(volume, rel=0.02)
    seg = load_image("l.nii.gz")
    save_image("half.nii.gz", Image(1.0 * (np.indices(seg.shape)[2] < 16), seg.affine))
    words = "mesh l.nii.gz -o b.vtu --labels l.nii.gz --nodes 300 --label-names names.csv"
    run_command(f"{words} --iterations 2 --keep-labels blood --mask half.nii.gz", code=None)
    blood = load_mesh("b.vtu")
    assert labels_in(blood) == {BLOOD}
    assert blood.label_table.names[BLOOD] == "blood"
    expected = np.pi * RADII[0] ** 2 * HALF_LENGTH
    assert blood.mesh.cell_volumes.sum() == pytest.approx(expected, rel=0.03)


def test_loads_and_the_mask_of_what_is_left_out_go():
    """The sets of the same names are others now."""
    words = "--young 2 --nu 0.3 --load pressure:boundary:1 --load hold:inferior"
    assert_done(f"convert v.vtu l.vtu {words}")
    said = run_command("convert l.vtu m.vtu --drop-labels blood").err
    assert "left out: pressure:boundary:1" in said
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

    def sets_of(inside, nodes, *words):
        image = Image(1.0 * inside)
        mesh = mesh_image(image, nodes, mask=image, iterations=2).mesh
        box = tetopt.Box(image.shape, image.affine)
        return mesh, build_model(mesh, box=box, sets=words).sets.facets

    tubes = ((far > 4) & (far <= 7)) | ((far > 10) & (far <= 14))
    sides = "in=inner:boundary-inferior-superior", "out=outer:mask_surface"
    mesh, sets = sets_of(tubes, 1500, *sides)
    for name, radii in {"in": (4, 10), "out": (7, 14)}.items():
        places = mesh.points[facet_triples(mesh.cells, sets[name])].mean(axis=1)
        radius = np.hypot(*(places[:, :2] - 14.5).T)
        off = np.abs(radius[:, None] - radii)
        assert off.min(axis=1).max() < 1.3  # of radii that are 3 apart
        assert set(off.argmin(axis=1)) == {0, 1}
    _, lumen = sets_of(far > 5, 800, "lumen=inner:mask_surface")
    assert_array_equal(lumen["lumen"], lumen["mask_surface"])


@pytest.fixture(scope="module")
def skull(tmp_path_factory):
    """A ball of bone with two rooms of air, and a canal from the outside into a third."""
    folder = tmp_path_factory.mktemp("skull")
    index = np.indices((30, 30, 30))

    def ball(radius, *middle):
        return np.linalg.norm(index - np.reshape(middle, (3, 1, 1, 1)), axis=0) < radius

    rooms = ball(4, 10, 15, 15), ball(3, 20, 15, 15)
    canal = (np.hypot(index[0] - 15, index[1] - 15) < 2) & (index[2] > 22)
    air = rooms[0] | rooms[1] | ball(3, 15, 15, 22) | canal
    labels = np.where(ball(13, 15, 15, 15) & ~air, BLOOD, 0)
    labels[1, 1, 1] = WALL
    save_image(folder / "l.nii.gz", Image(labels.astype(np.uint8), np.diag([1.0, 1.0, 2.0, 1.0])))
    (folder / "names.csv").write_text("label,name\n1,speck\n2,bone\n", encoding="utf-8")
    return folder, 2 * (labels == BLOOD).sum(), [2 * room.sum() for room in rooms]


@pytest.mark.parametrize(("word", "label"), [("bone", BLOOD), ("300", 300)])
def test_enclosed_air_gets_a_label(skull, monkeypatch, word, label):
    """Told by volume; an open cavity stays, and a number beyond those of the file's type is one,
    too.
    """
    folder, bone, holes = skull
    monkeypatch.chdir(folder)
    words = "mesh l.nii.gz --labels l.nii.gz --label-names names.csv --nodes 1200 --iterations 2"
    fill = f"--background 0 -o {word}.vtu --fill-holes {word}"
    said = run_command(words, fill, code=None).err
    assert f"2 holes of {sum(holes)} mm3, the largest {holes[0]}" in said
    assert f"labels around most of each hole: 2 (bone) {sum(holes)} mm3" in said
    loaded = load_mesh(f"{word}.vtu")
    of_cell, volume = loaded.cell_data["label"], loaded.mesh.cell_volumes
    assert labels_in(loaded) - {0, WALL} == {BLOOD, label}
    if label == BLOOD:
        bone += sum(holes)
    else:
        # the image, of labels alone, is filled, too
        assert np.median(loaded.cell_data["mean"][of_cell == label]) == label
        assert volume[of_cell == label].sum() == pytest.approx(sum(holes), rel=0.1)
    assert volume[of_cell == BLOOD].sum() == pytest.approx(bone, rel=0.02)
    check = f"quality {word}.vtu --image l.nii.gz --labels l.nii.gz --json q.json --force"
    run_command(check, code=None)
    dice = {row["label"]: row["dice"] for row in numbers_in("q.json")["labels"]}
    assert dice[label] > 0.85  # against the filled labels
    assert dice[BLOOD] > 0.97


def test_probabilities_are_not_filled():
    """A hole of tissues gets a label; the image that is one of them keeps its values."""
    far = np.linalg.norm(np.indices((14, 14, 14)) - 6.5, axis=0)
    for name, data in {"g": 0.8 * ((far < 6) & (far > 2)), "w": 0.6 * (far >= 6)}.items():
        save_image(f"{name}.nii.gz", Image(data))
    words = "mesh g.nii.gz --tissues g.nii.gz,w.nii.gz --nodes 400 --iterations 2 -o a.vtu"
    run_command(f"{words} --fill-holes 7", code=None)
    loaded = load_mesh("a.vtu")
    assert 7 in loaded.cell_data["label"]
    assert loaded.cell_data["mean"].max() <= 0.8 + 1e-6


def test_no_hole_is_told():
    words = "mesh l.nii.gz --labels l.nii.gz -o h.vtu --iterations 0 --nodes 300 --fill-holes 2"
    assert "no voxel of label 0 is enclosed" in run_command(words, code=None).err


def test_crumbs_go_with_what_held_them():
    """A cell of a label that only hung on another one; a small label of its own stays. Sets that
    shrink are told.
    """
    mesh = tetopt.lattice_mesh(Image(np.zeros((20, 8, 8))), nodes=300)
    x = mesh.points[mesh.cells].mean(axis=1)[:, 0]
    labels = np.where(x < 10.0, WALL, np.where(x < 17.0, BLOOD, 3))
    crumb = np.abs(x - 13.5).argmin()
    labels[crumb] = WALL
    rows = boundary_rows(mesh)
    sets = Sets({"skin": rows[x[rows[:, 0]] > 8.0]}, {"core": np.flatnonzero(x > 8.0)})
    save_model("a.vtu", tetopt.Model(mesh, {"label": labels}, sets))
    said, volume = run_command(f"convert a.vtu b.vtu --drop-labels {BLOOD}").err, mesh.cell_volumes
    assert volume[crumb] < 0.01 * volume[labels == WALL].sum()
    words = f"1 component (1 cell, {volume[crumb]:.4g} mm3), less than 1% of any label"
    assert words in said
    kept = (labels != BLOOD) & (np.arange(len(labels)) != crumb)
    assert len(load_mesh("b.vtu").mesh.cells) == kept.sum()
    words = r'set "skin" keeps \d+ of its \d+ facets; the others are of labels left out'
    assert re.search(words, said)
    assert f'set "core" keeps {(kept & (x > 8.0)).sum()} of its {(x > 8.0).sum()} cells' in said


def test_labels_left_out_are_not_measured_as_lost():
    """Neither of a mesh built without them, nor after `convert`; nor those that another rater's
    labels lack.
    """
    seg = load_image("l.nii.gz")
    save_image("o.nii.gz", Image(np.where(seg.data == WALL, 0.0, seg.data), seg.affine))
    assert_done("convert v.vtu k.vtu --keep-labels blood")
    for name, labels, kept in (
        ("v.vtu", "l.nii.gz", {WALL, BLOOD}),
        ("k.vtu", "l.nii.gz", {BLOOD}),
        ("v.vtu", "o.nii.gz", {BLOOD}),
    ):
        words = f"--image l.nii.gz --labels {labels} --json q.json --force"
        run_command(f"quality {name} {words}", code=None)
        dice = {row["label"]: row["dice"] for row in numbers_in("q.json")["labels"]}
        assert kept <= dice.keys() - {0}
        if labels == "l.nii.gz":
            assert kept == dice.keys() - {0}
            assert all(dice[label] > 0.9 for label in kept)


test_refused = refusals(
    """
mesh l.nii.gz --labels l.nii.gz -o no.vtu --fill-holes 0
    expected one label from 1 to 2147483647, got "0"
mesh l.nii.gz --labels l.nii.gz -o no.vtu --fill-holes liver
    labels have no names
mesh l.nii.gz --labels l.nii.gz -o no.vtu --keep-labels 2 --drop-labels 1
    give only one of them
mesh l.nii.gz --labels l.nii.gz -o no.vtu --keep-labels 7
    there is no label "7"; there are 0, 1, 2
mesh l.nii.gz --labels l.nii.gz -o no.vtu --drop-labels 0,1,2
    no label would be left
convert v.vtu no.vtu --keep-labels liver
    no label has this name
convert v.vtu no.vtu --set side=boundary-inlett
    no set of facets begins "inlett"
convert v.vtu no.vtu --set side=outer:
    expected names of sets
convert v.vtu no.vtu --set cavity=inner:boundary
    inner boundary has no facet
convert v.vtu no.vtu --set none=boundary-boundary
    the difference boundary-boundary has no facet
"""
)


@pytest.fixture(scope="module")
def cup(tmp_path_factory):
    """A left ventricle: half an ellipsoid of blood in muscle, open at the top face of the box."""
    folder = tmp_path_factory.mktemp("cup")
    x, y, z = np.indices((40, 40, 30)) - np.array([19.5, 19.5, 29.5]).reshape(3, 1, 1, 1)
    blood, muscle = (
        (x / a) ** 2 + (y / a) ** 2 + (z / c) ** 2 <= 1.0 for a, c in ((11.0, 20.0), (17.0, 26.0))
    )
    labels = np.where(blood, BLOOD, np.where(muscle, WALL, 0))
    save_image(folder / "l.nii.gz", Image(labels))
    save_image(folder / "m.nii.gz", Image(1.0 * (labels == WALL)))
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
    run_command(f"{words} a.vtu --mask m.nii.gz {sides}", code=None)
    run_command(f"{words} b.vtu --labels l.nii.gz --drop-labels 0", code=None)
    assert_done(f"convert b.vtu c.vtu --drop-labels {BLOOD} {sides}")
    alone, dropped = load_mesh("a.vtu"), load_mesh("c.vtu")
    for name, axes in {"endo": (11.0, 20.5), "epi": (17.0, 26.5)}.items():
        assert area(alone, name) == pytest.approx(area(dropped, name), rel=0.03)
        assert area(alone, name) == pytest.approx(half_spheroid(*axes), rel=0.05)
    interface = area(dropped, f"interface_{WALL}_{BLOOD}")
    assert area(dropped, "endo") == pytest.approx(interface, rel=1e-12)
    rows = np.concatenate([dropped.sets.facets[name] for name in ("endo", "epi", "superior")])
    assert sorted(rows.tolist()) == sorted(boundary_rows(dropped.mesh).tolist())
