"""Measures taken at the same time."""

import time
import weakref
from functools import partial

import numba
import numpy as np
import pytest

import tetopt
from tetopt.measure import interfaces
from tetopt.measure.fidelity import cell_labels, label_fidelity, mask_fidelity
from tetopt.measure.interfaces import label_interfaces
from tetopt.measure.measures import fidelity, measure_each
from tetopt.measure.thin import label_contacts


def test_measures_keep_to_the_number_of_threads():
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        assert measure_each({"a": numba.get_num_threads, "b": numba.get_num_threads}, None) == {
            "a": 1,
            "b": 1,
        }
    finally:
        numba.set_num_threads(before)


def test_the_first_error_ends_the_measures(monkeypatch):
    """Those that were not begun are not; with a place for reasons, all others are taken."""
    monkeypatch.setattr(numba, "get_num_threads", lambda: 1)
    begun, broken, failed = [], {"a": lambda: 1 // 0}, {}
    others = {name: partial(begun.append, name) for name in "bcdefgh"}
    with pytest.raises(ZeroDivisionError):
        measure_each(broken | {"slow": partial(time.sleep, 0.3)} | others, None)
    assert begun == []
    assert measure_each(broken | others, failed) == dict.fromkeys(others)
    assert failed["a"].startswith("ZeroDivisionError")


def close(one, other):
    """True if two rows, or lists of rows, have the same numbers but for rounding."""
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(close, one, other))
    return one is other or np.isclose(one, other, rtol=1e-9, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("shape", [(30, 40, 36), (50, 44)])
def test_what_lies_far_from_a_mask_counts_for_no_measure(shape):
    """A mask that reaches one side of the image, a mesh that reaches beyond it, two labels with
    a loose voxel.
    """
    place = np.indices(shape)
    middle = np.array([0, 14, 16][: len(shape)]).reshape(-1, *[1] * len(shape))
    far = np.sqrt(((place - middle) ** 2).sum(axis=0))
    numbers = np.where(place[1] > 14, 2, 1)
    numbers[(4, 6, 16)[: len(shape)]] = 2
    affine = np.diag([*(1.1, 0.9, 1.3)[: len(shape)], 1.0])
    affine[:-1, -1] = 20.0
    labels, mask = tetopt.Image(numbers, affine), tetopt.Image((far <= 9).astype(float), affine)
    wide = tetopt.Image((far <= 11).astype(float), affine)
    result = tetopt.mesh_image(tetopt.content(labels, labels, wide), 250, iterations=3)
    measured = fidelity(labels, mask, result.mesh, result.labels)
    rest = result.mesh, result.labels, mask
    assert close(measured["mask"], mask_fidelity(mask, result.mesh))
    for row, whole in zip(measured["labels"], label_fidelity(labels, *rest), strict=True):
        assert close(row[:-2], whole[:-2])
        assert row.extent.voxels < 0.3 * numbers.size  # the image is larger
    surfaces = label_interfaces(labels, *rest)
    assert close(measured["interfaces"], surfaces)
    assert close([row.surface for row in measured["labels"]], surfaces)
    assert close(measured["contacts"], label_contacts(labels, *rest))
    assert len(shape) == 2 or any(row.pieces.lost_components for row in measured["labels"])


def test_what_the_voxels_are_is_measured_once(monkeypatch):
    """For several meshes of the same labels, and anew within a mask or another one."""
    labels = tetopt.load_phantom("sphere").label_image(voxel_mm=4)
    meshes = [tetopt.lattice_mesh(labels, nodes=nodes) for nodes in (100, 300)]
    nets, smooth = [], interfaces.smooth_surface
    monkeypatch.setattr(interfaces, "smooth_surface", lambda *of: nets.append(of) or smooth(*of))

    def areas(mask=None):
        found = [fidelity(labels, mask, mesh, None)["interfaces"] for mesh in meshes]
        assert found[0][1].area != found[1][1].area
        return [row.smooth_area for row in found[0]], len(nets)

    whole, n_nets = areas()
    assert (whole, n_nets) == (areas()[0], 2)
    half = tetopt.Image(np.indices(labels.shape)[0] < 8, labels.affine)
    assert label_interfaces(labels, meshes[0], cell_labels(labels, meshes[0]), half)[1].euler == 2
    assert len(nets) == 4
    assert areas()[0] == whole


def test_an_image_that_was_measured_ends_with_its_last_name():
    """Not when Python next looks for cycles, which large arrays do not bring about."""
    labels = tetopt.load_phantom("sphere").label_image(voxel_mm=8)
    mesh = tetopt.lattice_mesh(labels, nodes=60)
    of_cell = cell_labels(labels, mesh)
    label_interfaces(labels, mesh, of_cell)
    label_contacts(labels, mesh, of_cell)
    held = weakref.ref(labels)
    del labels
    assert held() is None
