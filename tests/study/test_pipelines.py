"""What tetopt's own pipelines are given to represent."""

import numpy as np
import pytest

import tetopt
from tetopt.contents.content import content
from tetopt.study.pipelines import PIPELINES, PipelineInput

IMAGE = tetopt.load_phantom("sphere").image(voxel_mm=4.0)
LABELS = tetopt.Image((IMAGE.data > 50) + 2 * (np.indices(IMAGE.shape)[0] > 12), IMAGE.affine)
BOTH, ALONE = content(IMAGE, labels=LABELS), content(LABELS, labels=LABELS, weights=[0.0])
EQUAL, AS_LABELS = (
    "meshed from the image and the given labels, equally weighted",
    "the image is a label map: meshed as labels",
)


@pytest.mark.parametrize(
    ("image", "labels", "content", "notes"),
    [
        (IMAGE, LABELS, BOTH, [EQUAL]),
        (LABELS, LABELS, ALONE, [AS_LABELS]),
        (IMAGE, None, IMAGE, []),
    ],
)
def test_labels_that_are_given_are_meshed(image, labels, content, notes):
    """Besides the image, alone if the image is the labels; without any the image alone."""
    made = PIPELINES["tetopt-uniform"].function(PipelineInput(image, labels, 200, iterations=2))
    expected = tetopt.optimize(
        content, tetopt.lattice_mesh(image, nodes=200), k_D=0.2, iterations=2
    )
    assert made.mesh.points.tobytes() == expected.mesh.points.tobytes()
    assert made.mesh.cells.tobytes() == expected.mesh.cells.tobytes()
    assert made.notes == [f"ended by: {expected.ended}", *notes]


def test_the_graded_mesh_is_that_of_mesh_image():
    made = PIPELINES["tetopt"].function(PipelineInput(IMAGE, LABELS, 300))
    assert made.mesh.points.tobytes() == tetopt.mesh_image(BOTH, 300).mesh.points.tobytes()
    assert made.notes[1:] == [EQUAL]


def test_the_other_pipelines_do_not_see_labels():
    for name in ("tetopt-paper", "bcc"):
        with_labels, without = (
            PIPELINES[name].function(PipelineInput(IMAGE, labels, 100, iterations=1))
            for labels in (LABELS, None)
        )
        assert with_labels.mesh.points.tobytes() == without.mesh.points.tobytes()


def test_a_peer_that_is_not_installed_is_known_before_it_runs():
    absent = PIPELINES["pytetwild"]._replace(packages=("no_such_package",))
    assert absent.missing.startswith("pytetwild: not installed; install it with: pip install")
    assert PIPELINES["tetopt"].missing is None
    assert PIPELINES["bcc"]._replace(packages=("numpy",)).missing is None
