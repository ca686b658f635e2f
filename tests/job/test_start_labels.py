"""A mesh to start from with labels and sets of cells: what comes of them, and what is refused."""

import numpy as np
import pytest
from commands import run_command
from models import sample_image
from numpy.testing import assert_array_equal
from shapes import ball_image, grid

import tetopt
from tetopt.geometry.topology import facets
from tetopt.model.label_names import TABLE_TEXT, LabelTable, table_words
from tetopt.model.sets import Sets

pytestmark = pytest.mark.usefixtures("here")


def save_start(n, suffix, order=1):
    """The mesh of the sample's image with labels 1 and 2, and sets of which none is a label's."""
    image = sample_image(n)
    tetopt.save_image("a.nii.gz", image)
    tetopt.save_image("l.nii.gz", tetopt.Image(1.0 * (image.data > 30), image.affine))
    mesh = tetopt.lattice_mesh(image, nodes=260 if n == 3 else 60)
    middle = mesh.points[mesh.cells].mean(axis=1) - mesh.points.mean(axis=0)
    labels = np.where(np.linalg.norm(middle, axis=1) < 5.5, 2, 1)
    sets = Sets({}, {"low": np.flatnonzero(middle[:, -1] < 0.0)})
    model = tetopt.build_model(mesh, cell_data={"label": labels}, known_sets=sets, order=order)
    about = {TABLE_TEXT: table_words(LabelTable({2: "core"}, {}))}
    tetopt.save_model(f"s{suffix}", model._replace(about=about))
    return mesh, labels, sets.cells["low"]


def faces_between(mesh, labels):
    """Facets between two labels, each as the positions of its nodes."""
    shared = facets(mesh.cells)
    pair = labels[shared.cells[shared.n_cells == 2]]
    nodes = shared.nodes[shared.n_cells == 2][pair[:, 0] != pair[:, 1]]
    return {frozenset(map(tuple, mesh.points[face].tolist())) for face in nodes}


@pytest.mark.parametrize("boundary", ["fixed", "slide"])
@pytest.mark.parametrize(("n", "suffix", "order"), [(3, ".vtu", 1), (2, ".vtu", 1), (3, ".msh", 2)])
def test_labels_and_cell_sets_of_a_start_stay(n, suffix, order, boundary):
    """Volumes, facets between them to the last bit, names and sets, while nodes within move."""
    before, labels, low = save_start(n, suffix, order)
    made = tetopt.run(
        tetopt.Job(images="a.nii.gz", start=f"s{suffix}", output="b.vtu", boundary=boundary)
    )
    back = tetopt.load_mesh("b.vtu")
    assert_array_equal(back.labels, made.optimized.labels)
    assert back.label_table.names == {2: "core"}
    for label in (1, 2):
        volumes = [mesh.cell_volumes[of == label].sum() for mesh, of in pairs(before, labels, back)]
        assert volumes[1] == pytest.approx(volumes[0], rel=1e-9)
    assert faces_between(back.mesh, back.labels) == faces_between(before, labels)
    volume = back.mesh.cell_volumes[back.sets.cells["low"]].sum()
    assert volume == pytest.approx(before.cell_volumes[low].sum(), rel=1e-9)
    assert len(back.mesh.points) == len(before.points)
    assert (back.mesh.points != before.points).any()
    assert made.violated == {}


def pairs(before, labels, back):
    return (before, labels), (back.mesh, back.labels)


def test_labels_of_the_image_replace_those_of_a_start():
    save_start(3, ".vtu")
    said = run_command("mesh a.nii.gz -o b.vtu --start s.vtu --labels l.nii.gz")
    assert "dropped" in said[1]
    assert "low" in said[1]
    assert set(tetopt.load_mesh("b.vtu").labels) == {0, 1}


def test_labels_of_a_start_are_kept_when_a_run_is_stopped():
    mesh, labels, _ = save_start(3, ".vtu")
    job = tetopt.Job(images="a.nii.gz", start="s.vtu", output="b.vtu")
    result = tetopt.run(job, stop=lambda: True)
    assert result.optimized.ended == "stopped"
    back = tetopt.load_mesh("b.vtu")
    assert faces_between(back.mesh, back.labels) == faces_between(mesh, labels)


def test_labels_of_cells_from_python():
    mesh, labels, _ = save_start(3, ".vtu")
    image = sample_image(3)
    made = tetopt.mesh_image(image, start=mesh, cell_labels=7 * labels, iterations=2)
    assert faces_between(made.mesh, made.labels) == faces_between(mesh, labels)
    assert set(made.labels) == {7, 14}
    content = tetopt.content(image, tetopt.Image(1.0 * (image.data > 30), image.affine))
    for start, of_cells, target in ((mesh, labels[:-1], image), (mesh, labels, content)):
        with pytest.raises(tetopt.InputError, match="cell_labels"):
            tetopt.mesh_image(target, start=start, cell_labels=of_cells)


def test_labels_of_a_start_within_a_mask_need_a_fixed_boundary():
    """Nodes that slide on the mask's surface could not tell it from that of a label."""
    ball = ball_image((12,) * 3, (5.5,) * 3, 4.5)
    half = tetopt.Image(ball.data * (1.0 + (grid((12,) * 3)[..., 0] > 5)))
    tetopt.save_image("m.nii.gz", ball)
    words = "mesh m.nii.gz --start m.vtu -o b.vtu --iterations 1 --force"
    for labels in (ball, half):
        tetopt.save_image("l.nii.gz", labels)
        made = "mesh m.nii.gz --mask m.nii.gz --labels l.nii.gz -o m.vtu --iterations 3 --force"
        run_command(f"{made} --nodes 80", code=None)
        run_command(words, code=None)
        assert set(tetopt.load_mesh("b.vtu").labels) == set(tetopt.load_mesh("m.vtu").labels)
        is_refused = labels is half
        _, err = run_command(f"{words} --boundary slide", code=2 if is_refused else None)
        assert ("--labels" in err) == is_refused
