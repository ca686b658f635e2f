"""A result says which requirements its mesh violates; each is violated by hand, one at a time."""

import numpy as np
import pytest
from shapes import shaped

import tetopt
from tetopt.contents.content import content, plain
from tetopt.engine.requirements import checked, requested
from tetopt.geometry.check import manifold_problems
from tetopt.start.carve import part_of


def violated(target, result, min_dihedral=0.0, start=None):
    return checked(result, plain(target), min_dihedral, result.mesh if start is None else start).violated


def violated_request(image, result, target_error, is_filled):
    return requested(result, plain(image), target_error, is_filled).violated


@pytest.fixture(scope="module")
def whole():
    image, _ = shaped("ball")
    return image, tetopt.mesh_image(image, 300, iterations=2)


def test_a_run_that_meets_all_violates_nothing(whole):
    assert whole[1].violated == {}


@pytest.mark.full
def test_the_minimum_dihedral_angle(whole):
    image, result = whole
    words = violated(image, result, 60.0)
    assert list(words) == ["min_dihedral"]
    angles = tetopt.geometry.simplex.dihedral_angles(result.mesh.points, result.mesh.cells).min(axis=1)
    assert words["min_dihedral"].startswith(
        f"{(angles < 60.0).sum()} of {len(angles)} cells have a dihedral angle below 60 degrees"
    )
    unmoved = result._replace(history=result.history[:1])
    # The floor holds for meshes without iterations, too.
    assert list(violated(image, unmoved, 60.0)) == ["min_dihedral"]
    # No mesh of tetrahedra has all angles so large: the run itself says so. Of few nodes, since it tries them all.
    assert list(tetopt.mesh_image(image, 60, iterations=2, min_dihedral=65.0).violated) == ["min_dihedral"]


def test_the_box_and_the_cover(whole):
    image, result = whole
    larger = result._replace(mesh=tetopt.Mesh(result.mesh.points * 1.01, result.mesh.cells))
    assert list(violated(image, larger, start=result.mesh)) == ["box", "cover"]
    assert list(violated(image, larger, start=larger.mesh)) == []  # as the user's own was
    assert "0 voxels are outside" in violated_request(image, larger, None, True)["cover"]
    last = result.history[-1]
    fewer = result._replace(history=[*result.history, last._replace(n_voxels=last.n_voxels - 1)])
    assert "-1 voxels" in violated(image, fewer)["cover"]
    assert "1 voxels are outside" in violated_request(image, fewer, None, True)["cover"]
    assert violated_request(image, fewer, None, False) == {}


@pytest.mark.full
def test_the_error(whole):
    image, result = whole
    fraction = result.history[-1].E_D / (plain(image).variance * image.volume)
    assert violated_request(image, result, 1.01 * fraction, True) == {}
    assert list(violated_request(image, result, 0.99 * fraction, True)) == ["error"]
    short = tetopt.mesh_image(image, target_error=0.3, iterations=3, k_D=0.0)
    assert ("error" in short.violated) == (short.history[-1].E_D > 0.3 * plain(image).variance * image.volume)


@pytest.mark.full
def test_a_mask_and_overlaps():
    image, mask = shaped("ball")
    target = content(image, mask=mask)
    result = tetopt.mesh_image(target, 400, iterations=3)
    assert result.violated == {}
    last = result.history[-1]
    twice = result._replace(history=[last._replace(n_voxels=last.n_voxels + 2)])
    assert "2 voxels lie in two cells" in violated(target, twice)["overlap"]
    n_cells = len(result.mesh.cells)
    part = part_of(result.mesh, np.arange(n_cells) < n_cells // 2)
    n_voxels = int(tetopt.cell_moments(target.image, part).n_voxels.sum())
    halved = result._replace(mesh=part, history=[last._replace(n_voxels=n_voxels)])
    assert set(violated(target, halved)) - {"components", "manifold"} == {"mask"}


@pytest.mark.full
def test_a_boundary_that_is_no_manifold_and_more_components_than_the_mask_has():
    """Two tetrahedra of the mesh that share a node, and two far apart, are all that is left."""
    image, mask = shaped("ball")
    target = content(image, mask=mask)
    result = tetopt.mesh_image(target, 400, iterations=1)
    cells = result.mesh.cells
    n_shared = (cells[:, :, None] == cells[0]).any(axis=2).sum(axis=1)
    for chosen, names in ((1, ["components", "manifold"]), (0, ["components"])):
        pair = [0, np.flatnonzero(n_shared == chosen)[0]]
        part = part_of(result.mesh, np.isin(np.arange(len(cells)), pair))
        n_voxels = int(tetopt.cell_moments(target.image, part).n_voxels.sum())
        row = result.history[-1]._replace(n_voxels=n_voxels)
        found = violated(target, result._replace(mesh=part, history=[row]))
        assert sorted(set(found) - {"mask"}) == names
        assert "2 connected components, the mask 1" in found["components"]


@pytest.mark.full
@pytest.mark.parametrize("name", ["dihedral_angles", "beyond_box", "cell_of_voxel", "manifold_problems"])
def test_a_requirement_that_cannot_be_checked_is_violated_and_the_mesh_is_there(name, monkeypatch):
    def fail(*_):
        raise MemoryError

    image, mask = shaped("ball")
    target = content(image, mask=mask)
    result = tetopt.mesh_image(target, 400, iterations=1)
    monkeypatch.setattr(tetopt.engine.requirements, name, fail)
    names = {
        "dihedral_angles": "min_dihedral",
        "beyond_box": "box",
        "cell_of_voxel": "mask",
        "manifold_problems": "manifold",
    }
    assert violated(target, result) == {names[name]: f"{names[name]} could not be checked: MemoryError"}


def test_an_interface_that_touches_itself():
    image, _ = shaped("ball")
    target = content(image, tetopt.Image(1.0 * (image.data > 50.0), image.affine))
    result = tetopt.mesh_image(target, 400, iterations=4)
    assert result.violated == {}
    cells = result.mesh.cells
    node = int(np.bincount(cells.ravel()).argmax())
    star = np.flatnonzero((cells == node).any(axis=1))
    shared = (cells[star][:, :, None, None] == cells[star]).any(axis=1).sum(axis=2)
    one, other = np.argwhere(shared == 1)[0]  # two cells with the node alone in common
    labels = np.zeros_like(result.labels)
    labels[star[[one, other]]] = 1
    words = violated(target, result._replace(labels=labels))
    assert list(words) == ["manifold"]
    assert f"[[{node}]]" in words["manifold"]


@pytest.mark.full
def test_labels_without_cells():
    image, _ = shaped("ball")
    labels = np.zeros(image.shape)
    labels[4:10, 4:10, 4:10], labels[20, 20, 20:24], labels[14:, :8] = 7.0, 9.0, 3.0
    target = content(image, tetopt.Image(labels, image.affine))
    result = tetopt.mesh_image(target, 400, iterations=4)
    assert result.labels is not None
    assert "labels" not in result.violated
    none = result._replace(labels=np.where(np.isin(result.labels, (7, 9)), 0, result.labels))
    assert violated(target, none) == {
        "labels": "no voxel of label 7, of more than 200 voxels, lies in a cell with that label; allow more nodes, or "
        "a higher `label_weight`"
    }
    elsewhere = none.labels.copy()
    elsewhere[np.flatnonzero(result.labels == 3)[0]] = 7
    assert violated(target, none._replace(labels=elsewhere)) == violated(target, none)
    assert violated(target, result._replace(labels=None)) == {}
    # Within a mask label 0 is a label like the others, and that of voxels outside does not count.
    within = content(image, tetopt.Image(labels, image.affine), tetopt.Image(np.ones(image.shape), image.affine))
    no_zero = result._replace(labels=np.where(result.labels == 0, 3, result.labels))
    assert "no voxel of label 0" in violated(target, no_zero)["labels"]
    assert "no voxel of label 0" in violated(within, no_zero)["labels"]
    box = np.zeros(image.shape)
    box[15:25, 1:7] = 1.0
    inside = content(image, tetopt.Image(labels, image.affine), tetopt.Image(box, image.affine))
    result = tetopt.mesh_image(inside, 100, iterations=1)
    assert set(result.labels.tolist()) == {3}
    assert "labels" not in result.violated


@pytest.mark.full
@pytest.mark.parametrize("options", [{"k_D": 0.0}, {"iterations": 0}, {"iterations": 1, "stop": lambda: True}])
def test_labels_are_given_and_judged_however_few_iterations_there_are(options):
    image, mask = shaped("ball")
    labels = tetopt.Image(1.0 * (image.data > 50.0) + 1.0 * (image.data > 65.0), image.affine)
    result = tetopt.mesh_image(content(image, labels, mask), 300, **({"iterations": 4} | options))
    assert set(result.labels.tolist()) == {0, 1, 2}
    assert manifold_problems(result.mesh, result.labels) == []
    assert not {"manifold", "labels"} & set(result.violated)


@pytest.mark.full
def test_a_label_outside_of_a_start_is_none_that_it_lost(whole):
    image, mask = shaped("ball")
    start = tetopt.mesh_image(content(image, mask=mask), 300, iterations=1).mesh
    target = content(mask, mask, weights=[0.0])
    result = tetopt.mesh_image(target, start=start, iterations=1)
    assert "labels" not in result.violated


@pytest.mark.full
def test_the_paper_s_scheme_and_a_start_say_theirs_too(whole):
    image, _ = whole
    assert tetopt.mesh_image(image, 200, mode="paper", iterations=2).violated == {}
    start = tetopt.mesh_image(image, 60, iterations=1).mesh
    kept = tetopt.mesh_image(image, start=start, iterations=1, min_dihedral=65.0)
    assert list(kept.violated) == ["min_dihedral"]


def test_the_boundary_of_the_user_s_mesh_is_judged():
    """Two blocks that meet in an edge alone, as in a mesh that lost cells; the check of its file says the same."""
    image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    lattice = tetopt.lattice_mesh(image, nodes=400)
    at = lattice.points[lattice.cells].mean(axis=1) - lattice.points.mean(axis=0)
    kept = lattice.cells[at[:, 0] * at[:, 1] > 0.0]
    nodes, cells = np.unique(kept, return_inverse=True)
    halves = tetopt.Mesh(lattice.points[nodes], cells.reshape(-1, 4))
    assert "manifold" in tetopt.mesh_image(image, start=halves, iterations=1).violated
    assert "manifold" not in tetopt.mesh_image(image, start=lattice, iterations=1).violated
