"""A mesh is judged in one place; each requirement is violated by hand, one at a time, and all who
ask get the same answer.
"""

import functools
import re

import numpy as np
import pytest
import scipy
from commands import exit_code, numbers_in
from shapes import labels_alone, shaped

import tetopt
import tetopt.engine.meshing
import tetopt.measure.judge
from tetopt.cohort.layout import mesh_name, numbers_path, subject_folder
from tetopt.cohort.numbers import row_of
from tetopt.contents.content import content, plain
from tetopt.energy.discretization import content_E_D
from tetopt.engine.loop import IterationRecord, MeshingResult
from tetopt.geometry.check import manifold_problems
from tetopt.geometry.simplex import centroids
from tetopt.geometry.topology import components
from tetopt.measure.judge import (
    Cover,
    MaskComponents,
    Requirements,
    judge,
    measure,
)
from tetopt.start.carve import part_of


def judged(mesh, target, labels=None, required=Requirements(), **options):  # noqa: B008 - a tuple
    return judge(measure(mesh, plain(target), labels, **options), required)


def violated(target, result, min_dihedral=0.0, start=None, **required):
    first, last = result.history[0], result.history[-1]
    return judged(
        result.mesh,
        target,
        result.labels,
        Requirements(min_dihedral, **required),
        initial=result.mesh if start is None else start,
        n_initial=first.n_voxels,
        counted=last.counted,
    )


SIDE = 12  # voxels of the images that follow, of 1 mm, whose sides are at -0.5 and 11.5


def lattice(low=(0, 0, 0), high=(SIDE, SIDE, SIDE), step=2):
    """Mesh a box of whole voxels."""
    low, high = np.array(low), np.array(high)
    mesh = tetopt.lattice_mesh(
        tetopt.Image(np.zeros(high - low)), blocks=tuple((high - low) // step)
    )
    return mesh.points + low, mesh.cells


def joined(*parts):
    """Make one mesh of several, which share no node."""
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    cells = [cells + start for (_, cells), start in zip(parts, starts, strict=False)]
    return tetopt.Mesh(np.concatenate([points for points, _ in parts]), np.concatenate(cells))


def moved(points, is_moved, by):
    return points + np.where(is_moved[:, None], by, 0.0)


def block(*boxes):
    """Return a mask, 1 in boxes of whole voxels."""
    data = np.zeros((SIDE, SIDE, SIDE))
    for low, high in boxes or [((0, 0, 0), (SIDE,) * 3)]:
        data[tuple(map(slice, low, high))] = 1.0
    return data


def flat_cells():
    points, cells = lattice()
    off = ((points - 5.5) ** 2).sum(axis=1)
    return joined((moved(points, off == off.min(), (1.75, 0.0, 0.0)), cells)), {}


def beyond_the_box():
    points, cells = lattice()
    along = points.sum(axis=1)
    return joined((moved(points, along == along.min(), -0.1), cells)), {"mask": block()}


def without_a_cell():
    points, cells = lattice()
    return part_of(tetopt.Mesh(points, cells), np.arange(len(cells)) > 0), {}


def twice_the_voxels():
    """A block whose left side is stretched through a gap into another block."""
    one = lattice((0, 0, 0), (6, 12, 12))
    points, cells = lattice((8, 0, 0), (12, 12, 12))
    points = moved(points, points[:, 0] < 8.0, (-2.9, 0.0, 0.0))
    mask = block(((0, 0, 0), (4, 12, 12)), ((5, 0, 0), (12, 12, 12)))
    return joined(one, (points, cells)), {"mask": mask}


def beyond_the_mask():
    return joined(lattice((0, 0, 0), (10, 10, 10))), {"mask": block(((0, 0, 0), (8, 8, 8)))}


def parts_of_a_block():
    one, (points, cells) = lattice((0, 0, 0), (6, 12, 12)), lattice((6, 0, 0), (12, 12, 12))
    return joined(one, (moved(points, points[:, 0] < 6.0, (0.01, 0.0, 0.0)), cells)), {
        "mask": block()
    }


def a_tunnel_through_a_block():
    points, cells = lattice()
    is_inner = np.abs(points[:, :2] - 5.5).max(axis=1) < 0.1
    return part_of(tetopt.Mesh(points, cells), ~is_inner[cells].any(axis=1)), {"mask": block()}


def blocks_that_share_an_edge():
    points, cells = lattice()
    at = points[cells].mean(axis=1) - 5.5
    mesh = part_of(tetopt.Mesh(points, cells), at[:, 0] * at[:, 1] > 0.0)
    return mesh, {"mask": block(((0, 0, 0), (6, 6, 12)), ((6, 6, 0), (12, 12, 12)))}


def a_label_without_a_cell():
    return joined(lattice()), {"labels": block(((0, 0, 0), (6, 12, 12)))}


def large_cells():
    return joined(lattice(step=6)), {"target_error": 0.01}


CASES = {
    "min_dihedral": flat_cells,
    "box": beyond_the_box,
    "cover": without_a_cell,
    "overlap": twice_the_voxels,
    "mask": beyond_the_mask,
    "components": parts_of_a_block,
    "euler": a_tunnel_through_a_block,
    "manifold": blocks_that_share_an_edge,
    "labels": a_label_without_a_cell,
    "error": large_cells,
}


@pytest.mark.parametrize("name", CASES)
def test_all_who_ask_about_a_mesh_get_the_same_answer(name, tmp_path, monkeypatch):
    """From Python, in run.json, by `quality --check` and in a cohort's table: of a small mesh that
    violates this requirement alone, as if the engine had made it.
    """
    mesh, given = CASES[name]()
    engine = tetopt.engine.meshing.optimize

    @functools.wraps(engine)
    def optimize(target, initial, **_):
        rows = [
            IterationRecord(at, 1.0, 1.0, E_D, 0.0, False, len(each.cells), n_voxels, 0.0)
            for at, each in enumerate((initial, mesh))
            for E_D, n_voxels in (content_E_D(target, each),)
        ]
        labels = None if target.memberships is None else np.zeros(len(mesh.cells), dtype=np.int64)
        return MeshingResult(mesh, rows, "iterations", initial, labels=labels)

    monkeypatch.setattr(tetopt.engine.meshing, "optimize", optimize)
    target_error = given.pop("target_error", None)
    images = {kind: tetopt.Image(data) for kind, data in given.items()}
    images["images"] = tetopt.Image(np.indices((SIDE,) * 3).sum(axis=0) ** 2.0)
    for kind, image in images.items():
        tetopt.save_image(tmp_path / f"{kind}.nii.gz", image)
    files = {kind: str(tmp_path / f"{kind}.nii.gz") for kind in images}
    options = {"spacing": 3.0} if target_error is None else {"target_error": target_error}
    target = tetopt.content(images["images"], images.get("labels"), images.get("mask"))
    mode = {} if target_error is not None else {"mode": "uniform"}
    expected = dict(tetopt.mesh_image(target, iterations=1, **options, **mode).violated)
    assert list(expected) == [name]

    subject_folder(tmp_path, "sub-1").mkdir(parents=True)
    out = subject_folder(tmp_path, "sub-1") / mesh_name("sub-1", ".vtu")
    numbers = numbers_path(tmp_path, "sub-1")
    job = tetopt.Job(**files, output=out, json_path=numbers, iterations=1, **options)
    with pytest.warns(UserWarning, match="."):
        assert tetopt.run(job).violated == expected
    assert numbers_in(numbers)["violated"] == expected
    words = [word for kind in given for word in (f"--{kind}", files[kind])]
    check = ["quality", out, "--image", files["images"], *words, "--check"]
    assert exit_code(*check, "--json", tmp_path / "q.json") == 1
    assert numbers_in(tmp_path / "q.json")["violated"] == expected
    row = row_of(tmp_path, "sub-1")
    assert (row.violated, row.reason) == ((name,), expected[name])


@pytest.fixture(scope="module")
def whole():
    image, _ = shaped("ball")
    return image, tetopt.mesh_image(image, 300, iterations=2)


@pytest.mark.parametrize(
    ("rows", "required", "words"),
    [
        ({"min_dihedral": np.array([59.0, 60.0])}, {"min_dihedral": 60.0}, "1 of 2 cells .* 59.00"),
        (
            {"min_dihedral": np.array([59.0])},
            {"min_dihedral": 60.0, "is_initial": True},
            "more `iterations`, as none was made",
        ),
        ({"min_dihedral": np.array([60.0])}, {"min_dihedral": 60.0}, None),
        ({"box": (0.1, 0.0)}, {}, "up to 0.1 voxels"),
        ({"box": (0.1, 0.1)}, {}, "so do those of the initial mesh"),
        (
            {"cover": Cover("the image", 0, 1.01, 1.0, 3, 1e-9)},
            {},
            r"the image: \+0 voxels, .*1.01",
        ),
        ({"cover": Cover("its initial domain", -1, 1.0, 1.0, 3, 1e-6)}, {}, "domain: -1 voxels"),
        ({"cover": Cover("the image", 0, 1.0, 1.0, 3, 1e-9)}, {}, None),
        ({"overlap": 2}, {}, "2 voxels lie in two cells"),
        ({"mask": 0.5}, {"region": "brain"}, "the brain overlap .* 0.500: cells .*more nodes$"),
        ({"mask": 0.09}, {}, "0.090: the mesh is of another mask, .*; use the mask"),
        (
            {"components": MaskComponents(1, (9, 2), (), ())},
            {},
            "2 .* components, the mask 1; .* 2, 9",
        ),
        ({"euler": (9, 1)}, {"region": "tube"}, "has 9 holes minus cavities, the tube 1: holes"),
        ({"euler": (2, -2, 0, 1)}, {}, "has 2 .* mask -2 to 1 with"),
        ({"euler": (0, -2, 0, 2)}, {}, None),
        ({"manifold": (["b"], ["i"], True)}, {}, "^b; i; mend the initial mesh"),
        ({"error": 0.03}, {"target_error": 0.02}, "0.03 .* more than 0.02, .*`nodes_max`"),
        (
            {"error": 0.03},
            {"target_error": 0.02, "cut_short": "stopped"},
            r"as the run was cut short \(stopped\); allow more time or memory, or raise",
        ),
        ({"error": 0.02}, {"target_error": 0.02}, None),
        ({"error": 0.03}, {}, None),
    ],
)
def test_words_on_a_violated_requirement(rows, required, words):
    found = judge(rows, Requirements(**required))
    if words is None:
        assert found == {}
    else:
        assert list(found) == list(rows)
        assert re.search(words, *found.values())


def test_of_another_mask_only_that_is_told():
    rows = {"components": MaskComponents(1, (9, 2), (), ()), "euler": (9, 1)}
    assert list(judge(rows | {"mask": 0.6}, Requirements())) == ["mask", *rows]
    assert list(judge(rows | {"mask": 0.0}, Requirements())) == ["mask"]


def test_the_box_and_the_cover(whole):
    image, result = whole
    assert result.violated == {}
    last, (E_D, n_voxels) = result.history[-1], result.history[-1].counted
    larger = tetopt.Mesh(result.mesh.points * 1.01, result.mesh.cells)
    grown = result._replace(mesh=larger)
    assert list(violated(image, grown, start=result.mesh)) == ["box", "cover"]
    assert list(violated(image, grown, start=larger)) == ["box"]  # as the user's own does
    assert "+0 voxels" in judged(larger, image, is_filled=True, counted=(E_D, n_voxels))["cover"]
    fewer = result._replace(history=[*result.history, last._replace(n_voxels=n_voxels - 1)])
    assert "initial domain: -1 voxels" in violated(image, fewer)["cover"]
    one_less = {"counted": (E_D, n_voxels - 1)}
    filled = judged(result.mesh, image, is_filled=True, **one_less)
    assert "the image: -1 voxels" in filled["cover"]
    assert judged(result.mesh, image, **one_less) == {}


@pytest.mark.full
def test_what_a_run_cannot_reach_it_says(whole):
    """No mesh of tetrahedra has all angles so large; of few nodes, since it tries them all."""
    image, _ = whole
    steep = tetopt.mesh_image(image, 60, iterations=2, min_dihedral=65.0)
    assert list(steep.violated) == ["min_dihedral"]
    short = tetopt.mesh_image(image, target_error=0.3, iterations=3, k_D=0.0)
    is_left = short.history[-1].E_D > 0.3 * plain(image).variance * image.volume
    assert ("error" in short.violated) == is_left


def drilled(hole, n=3):
    """A block of a mask with a hole through it, or a cavity in it, of so many voxels a side."""
    data = np.ones((SIDE,) * n)
    at = slice((SIDE - hole) // 2, (SIDE + hole) // 2)
    data[(at, at)] = 0.0
    return tetopt.Image(data)


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize(("hole", "is_violated"), [(1, False), (4, True)])
def test_a_hole_that_cells_fill_is_no_fault_where_it_is_smaller_than_they_are(n, hole, is_violated):
    mask = drilled(hole, n)
    mesh = tetopt.lattice_mesh(mask, blocks=(SIDE // 2,) * n)
    assert ("euler" in judged(mesh, content(mask, mask=mask))) == is_violated
    alike = measure(mesh, content(mask, mask=drilled(0, n)))["euler"]
    assert alike == (0, 0)


@pytest.mark.parametrize("is_torn", [False, True])
def test_a_wall_is_no_detail_smaller_than_cells(is_torn):
    """Opening would take all of the wall from the mask, and its cavity with it."""
    mask, (points, cells) = block(), lattice()
    mask[2:10, 2:10, 2:10] = 0.0
    is_wall = (np.abs(points - 5.5).max(axis=1) > 3.9)[cells].all(axis=1)
    hole = np.flatnonzero((points == (0.5, 6.5, 6.5)).all(axis=1))
    mesh = part_of(tetopt.Mesh(points, cells), is_wall & ~(is_torn & (cells == hole).any(axis=1)))
    mesh, image = tetopt.Mesh(mesh.points + 2.0, mesh.cells), tetopt.Image(np.pad(mask, 2))
    target = content(image, mask=image)
    found = tetopt.mask_fidelity(image, mesh)
    assert (found.euler, found.mesh_euler) == (4, 2 if is_torn else 4)
    assert ("euler" in judged(mesh, target)) == is_torn


def test_a_gap_that_closing_fills_is_no_hole():
    """Two blocks, apart by less than a cell, one of them with a tunnel as narrow."""
    mask = block(((0, 0, 0), (4, 12, 12)), ((5, 0, 0), (12, 12, 12)))
    mask[8, 6] = 0.0
    mesh = joined(lattice(high=(4, 12, 12)), lattice(low=(5, 0, 0)))
    rows = measure(mesh, content(tetopt.Image(mask), mask=tetopt.Image(mask)))
    assert rows["components"].mask == len(rows["components"].n_cells) == 2
    assert rows["euler"] == (0, 1, 0, 1, 0)


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "requirements"),
    [
        ("dihedral_angles", ["min_dihedral"]),
        ("beyond_box", ["box"]),
        ("voxel_cells", ["overlap", "mask", "components"]),
        ("hole_numbers", ["euler"]),
        ("manifold_problems", ["manifold"]),
    ],
)
def test_a_requirement_that_cannot_be_checked_is_violated_and_the_mesh_is_there(
    name, requirements, monkeypatch
):
    def fail(*_):
        raise MemoryError

    image, mask = shaped("ball")
    target = content(image, mask=mask)
    result = tetopt.mesh_image(target, 400, iterations=1)
    assert result.violated == {}
    monkeypatch.setattr(tetopt.measure.judge, name, fail)
    words = {each: f"{each} could not be checked: MemoryError" for each in requirements}
    assert violated(target, result) == words


def test_an_interface_that_touches_itself():
    image, _ = shaped("ball")
    target = content(image, tetopt.Image(1.0 * (image.data > 50.0)))
    result = tetopt.mesh_image(target, 400, iterations=4)
    assert result.violated == {}
    cells = result.mesh.cells
    node = int(np.bincount(cells.ravel()).argmax())
    star = np.flatnonzero((cells == node).any(axis=1))
    shared = (cells[star][:, :, None, None] == cells[star]).any(axis=1).sum(axis=2)
    labels = np.zeros_like(result.labels)
    labels[star[np.argwhere(shared == 1)[0]]] = 1  # two cells with the node alone in common
    words = violated(target, result._replace(labels=labels))
    assert list(words) == ["manifold", "labels"]
    assert "0.0" in words["labels"]
    assert f"[[{node}]]" in words["manifold"]


@pytest.mark.full
def test_labels_without_cells():
    image, _ = shaped("ball")
    labels, box = np.zeros(image.shape), np.zeros(image.shape)
    labels[4:10, 4:10, 4:10], labels[20, 20, 20:24], labels[14:, :8] = 7.0, 9.0, 3.0
    box[15:25, 1:7] = 1.0
    labels = tetopt.Image(labels)
    target, within, inside = (
        content(image, labels, mask)
        for mask in (None, tetopt.Image(np.ones(image.shape)), tetopt.Image(box))
    )
    result = tetopt.mesh_image(target, 400, iterations=4)
    assert "labels" not in result.violated

    def words(changed, content=target):
        return violated(content, result._replace(labels=changed)).get("labels", "")

    none = np.where(np.isin(result.labels, (7, 9)), 0, result.labels)
    assert words(none) == (
        "no voxel of label 7, of 200 voxels or more, lies in a cell with that label; allow more "
        "nodes, more `cells_across`, or a higher `label_weight`"
    )
    elsewhere = none.copy()
    elsewhere[np.flatnonzero(result.labels == 3)[0]] = 7
    assert words(elsewhere) == words(none)
    assert words(None) == ""
    # Within a mask label 0 is a label like the others, and that of voxels outside does not count.
    no_zero = np.where(result.labels == 0, 3, result.labels)
    for each in (target, within):
        assert "no voxel of label 0" in words(no_zero, each)
    of_box = tetopt.mesh_image(inside, 100, iterations=1)
    assert set(of_box.labels.tolist()) == {3}
    assert "labels" not in of_box.violated


@pytest.mark.parametrize("is_masked", [False, True])
@pytest.mark.parametrize("n", [2, 3])
def test_labels_are_judged_as_they_are_measured(n, is_masked):
    """On the voxels of the labels, also of thick slices, in a mesh of a part of the image: the
    one truth of both.
    """
    rng = np.random.default_rng(n)
    data = np.kron(rng.integers(0, 12, (3, 4, 5)[-n:]), np.ones((6, 8, 7)[-n:]))
    data[..., -1] = 19.0
    labels = tetopt.Image(data, np.diag([*(1.0, 1.3, 3.2)[-n:], 1.0]))
    mask = tetopt.Image(rng.random(data.shape) < 0.9, labels.affine) if is_masked else None
    target = content(labels, labels, mask)
    mesh = tetopt.lattice_mesh(labels, nodes=200)
    along = centroids(mesh.points, mesh.cells)[:, 0]
    is_kept = along < np.quantile(along, 0.8)
    mesh, along = part_of(mesh, is_kept), along[is_kept]
    of_cell = np.where(along < np.median(along), 13, tetopt.cell_labels(labels, mesh))
    fits = measure(mesh, target, of_cell)["labels"]
    rows = tetopt.label_fidelity(labels, mesh, of_cell, mask)
    assert [fit.label for fit in fits] == [row.label for row in rows]
    assert any(fit.pieces.lost_components for fit in fits)
    for fit, row in zip(fits, rows, strict=True):
        assert fit.extent[:-1] == row.extent[:-1]  # but for the layers
        assert fit.extent.ratio == pytest.approx(
            row.extent.mesh_volume / (row.extent.covered_voxels * labels.voxel_volume)
        )
        assert fit.pieces._replace(lost_components=()) == row.pieces._replace(lost_components=())
        assert fit.overlap.dice == row.overlap.dice
        assert [each.voxels for each in fit.pieces.lost_components] == [
            each.voxels for each in row.pieces.lost_components
        ]
        for one, other in zip(fit.pieces.lost_components, row.pieces.lost_components, strict=True):
            np.testing.assert_allclose(one.place, other.place)
            assert data[tuple(np.rint(labels.to_index(one.place)).astype(int))] == fit.label


def test_volumes_of_labels():
    """At the limits, of labels of 200 voxels or more alone."""
    labels = np.zeros((12, 12, 12))
    labels[:6, :6, :6], labels[8:, 8:, 8:] = 1.0, 2.0
    image = tetopt.Image(labels)
    target, mesh = content(image, image), tetopt.lattice_mesh(image, blocks=(12, 12, 12))
    of_cell = tetopt.cell_labels(image, mesh)
    assert "labels" not in judged(mesh, target, of_cell)
    rng = np.random.default_rng(5)
    own, other = (rng.permutation(np.flatnonzero(of_cell == label)) for label in (1, 0))
    of_cell[np.flatnonzero(of_cell == 2)[::2]] = 0  # it has 64 voxels
    ratios = []
    for n_own, n_other in ((0.55, 0.0), (0.65, 0.0), (1.0, 0.35), (1.0, 0.7)):
        changed = of_cell.copy()
        changed[own[round(n_own * len(own)) :]] = 0
        changed[other[: round(n_other * len(own))]] = 1
        ratio = mesh.cell_volumes[changed == 1].sum() / 216.0
        said = judged(mesh, target, changed).get("labels", "")
        assert (f"0.6 to 1.5 times that of voxels: {ratio:.3g} for label 1; " in said) == (
            not 0.6 <= ratio <= 1.5
        )
        assert bool(said) == (not 0.6 <= ratio <= 1.5)
        ratios.append(ratio)
    assert ratios[0] < 0.6 < ratios[1] < ratios[2] < 1.5 < ratios[3]


def test_components_of_a_mask_without_a_cell():
    image, mask = shaped("pieces")
    target = content(image, mask=mask)
    result = tetopt.mesh_image(target, 300, iterations=1)
    assert "components" not in result.violated
    one = part_of(result.mesh, components(result.mesh.cells) == 0)
    number, _ = scipy.ndimage.label(mask.data)
    met = np.unique(number[(tetopt.cell_of_voxel(mask, one) >= 0) & (number > 0)])
    gone = number == 3 - met.item()
    words = judged(one, target)["components"]
    found = re.match(r".* of 50 voxels or more without a cell: (\d+) voxels at \(([^)]*)\)", words)
    assert int(found[1]) == gone.sum()
    place = [float(each) for each in found[2].split(", ")]
    assert gone[tuple(np.rint(mask.to_index(place)).astype(int))]
    (row,) = tetopt.mask_fidelity(mask, one).lost_components
    assert row.voxels == gone.sum()
    np.testing.assert_allclose(row.place, place, atol=1e-3 * np.abs(place).max())


def test_a_part_of_a_mask_without_cells_is_named_with_its_place():
    """A plate that sticks out of a block, and a mesh of the block alone: what is near its cells
    does not count.
    """
    data = np.zeros((40, 16, 16))
    box = tetopt.lattice_mesh(tetopt.Image(data), blocks=(20, 8, 8))
    part = part_of(box, (np.abs(centroids(box.points, box.cells) - 6.5) < 5.0).all(axis=1))
    found = []
    for voxels in (np.s_[2:12, 2:12, 2:12], np.s_[12:38, 2:12, 6:8]):
        data[voxels] = 1.0
        mask = tetopt.Image(data.copy())
        found.append(judged(part, content(mask, mask=mask)).get("components"))
    assert found[0] is None
    count, x = re.match(r"parts .* no cell near: (\d+) voxels at \(([\d.]+), ", found[1]).groups()
    assert 400 < int(count) < 520
    assert 20.0 < float(x) < 30.0


def test_small_components_of_a_mask_may_be_lost_and_are_counted():
    mask = tetopt.Image(block(((2, 2, 2), (8, 8, 8)), ((9, 9, 9), (12, 12, 12))))
    mesh = tetopt.lattice_mesh(mask, blocks=(6, 6, 6))
    mesh = part_of(mesh, (centroids(mesh.points, mesh.cells) < 8.0).all(axis=1))
    assert "components" not in judged(mesh, content(mask, mask=mask))
    assert [each.voxels for each in tetopt.mask_fidelity(mask, mesh).lost_components] == [27]


@pytest.mark.full
@pytest.mark.parametrize(
    "options", [{"k_D": 0.0}, {"iterations": 0}, {"iterations": 1, "stop": lambda: True}]
)
def test_labels_are_given_and_judged_however_few_iterations_there_are(options):
    image, mask = shaped("ball")
    labels = tetopt.Image(1.0 * (image.data > 50.0) + 1.0 * (image.data > 65.0), image.affine)
    result = tetopt.mesh_image(content(image, labels, mask), 300, **({"iterations": 4} | options))
    assert set(result.labels.tolist()) == {0, 1, 2}
    assert manifold_problems(result.mesh, result.labels) == []
    assert "manifold" not in result.violated
    assert "no voxel of label" not in result.violated.get("labels", "")


@pytest.mark.full
def test_a_label_outside_of_a_start_is_none_that_it_lost():
    image, mask = shaped("ball")
    start = tetopt.mesh_image(content(image, mask=mask), 300, iterations=1).mesh
    result = tetopt.mesh_image(labels_alone(mask), start=start, iterations=1)
    assert "labels" not in result.violated


@pytest.mark.full
def test_the_paper_s_scheme_and_a_start_say_theirs_too(whole):
    image, _ = whole
    assert tetopt.mesh_image(image, 200, mode="paper", iterations=2).violated == {}
    start = tetopt.mesh_image(image, 60, iterations=1).mesh
    kept = tetopt.mesh_image(image, start=start, iterations=1, min_dihedral=65.0)
    assert list(kept.violated) == ["min_dihedral"]


def test_the_boundary_of_the_user_s_mesh_is_judged():
    """Two blocks that meet in an edge alone, as in a mesh that lost cells; the check of its file
    says the same.
    """
    image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    lattice = tetopt.lattice_mesh(image, nodes=400)
    at = centroids(lattice.points, lattice.cells) - lattice.points.mean(axis=0)
    halves = part_of(lattice, at[:, 0] * at[:, 1] > 0.0)
    for start in (halves, lattice):
        result = tetopt.mesh_image(image, start=start, iterations=1)
        assert ("manifold" in result.violated) == (start is halves)
