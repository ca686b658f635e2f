"""Which cells within a mask stay: connected components as the mask has them."""

import numpy as np
import pytest
import scipy
from shapes import distance, shaped

import tetopt
from tetopt.contents.content import content
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import components
from tetopt.start.carve import carve_mesh, part_of


@pytest.fixture(scope="module")
def pieces():
    """Two balls, and a mesh of them."""
    image, mask = shaped("pieces")
    target = content(image, mask=mask)
    return target, mask, tetopt.mesh_image(target, 300, iterations=1)


def test_each_component_of_the_mask_keeps_its_largest(pieces):
    target, _, result = pieces
    assert (
        components(result.mesh.cells).max() + 1 == scipy.ndimage.label(target.region.inside)[1] == 2
    )
    assert result.n_dropped == 0
    assert carve_mesh(result.mesh, target.image, target.region).is_kept.all()


def test_components_that_the_mask_does_not_have_are_dropped_unless_they_are_kept(pieces):
    """Loose cells beside the ball: single ones go, a half of the ball stays, and so does a
    twentieth.
    """
    image, _ = shaped("ball")
    mask = tetopt.Image(1.0 * (distance(image.shape, 13.3, 14.1, 15.7) < 11.0))
    target = content(image, mask=mask)
    whole = tetopt.mesh_image(target, 300, iterations=1).mesh
    cut = np.abs(whole.points[whole.cells].mean(axis=1)[:, 2] - 12.0)  # a slab of cells is left out
    halves = part_of(whole, cut > 1.5)
    number = components(halves.cells)
    sizes = np.sort(np.bincount(number))[::-1]
    assert len(sizes) >= 2
    kept = carve_mesh(halves, target.image, target.region)
    left = part_of(halves, kept.is_kept)
    large = sizes[sizes > 0.2 * sizes[0]]
    assert components(left.cells).max() + 1 == len(large) == 2
    assert kept.n_dropped == len(sizes) - len(large)
    capped = part_of(whole, np.abs(whole.points[whole.cells].mean(axis=1)[:, 2] - 22.5) > 1.5)
    left = part_of(capped, carve_mesh(capped, target.image, target.region).is_kept)
    size = np.sort(np.bincount(components(left.cells), volumes(left.points, left.cells)))
    assert len(size) == 2
    assert 0.01 * size[1] < size[0] < 0.05 * size[1]
    every = carve_mesh(halves, target.image, target.region, keeps_components=True)
    assert every.n_dropped == 0
    assert every.is_kept.sum() >= kept.is_kept.sum()


@pytest.mark.full
def test_what_a_mesh_tears_off_is_kept_and_told():
    """A ball with a bulb at a thin winding tail, which octree cells of that size tear."""
    image, _ = shaped("ball")
    inside = (distance(image.shape, 13.3, 14.1, 9.7) < 8.0) | (
        distance(image.shape, 10.5, 16.6, 24.5) < 2.3
    )
    for k in range(7):
        i, j = k // 2, (k + 1) // 2
        inside[13 - j, 14 + i, 16 + k] = inside[13 - i, 14 + i, 16 + k] = inside[
            13 - j, 14 + j, 16 + k
        ] = True
    mask = tetopt.Image(1.0 * inside)
    target = content(image, mask=mask)
    assert scipy.ndimage.label(target.region.inside)[1] == 1
    result = tetopt.mesh_image(target, 400, iterations=3)
    assert result.n_dropped == 0
    assert components(result.mesh.cells).max() == 1
    assert list(result.violated) == ["components"]
    labels = tetopt.Image(np.where(distance(image.shape, 10.5, 16.6, 24.5) < 2.3, 7.0, 3.0))
    # the bulb is a label of its own
    named = tetopt.mesh_image(content(image, labels, mask), 400, iterations=1)
    assert (named.n_dropped, set(named.labels.tolist())) == (0, {3, 7})
    kept = tetopt.mesh_image(content(image, mask=mask, keep_components=True), 400, iterations=3)
    assert kept.n_dropped == 0
    assert components(kept.mesh.cells).max() == 1
    assert list(kept.violated) == ["components"]
