"""Which cells within a mask stay: connected components as the mask has them."""

import numpy as np
import pytest
import scipy
from shapes import distance, shaped

from tetopt import Image, mesh_image
from tetopt.contents.content import content
from tetopt.geometry.topology import components
from tetopt.start.carve import carve_mesh, part_of


def test_each_component_of_the_mask_keeps_its_largest():
    """Of two balls."""
    image, mask = shaped("pieces")
    target = content(image, mask=mask)
    result = mesh_image(target, 300, iterations=1)
    n_components = scipy.ndimage.label(target.region.inside)[1]
    assert components(result.mesh.cells).max() + 1 == n_components == 2
    assert result.n_dropped == 0
    assert carve_mesh(result.mesh, target.image, target.region).is_kept.all()


def test_components_that_the_mask_does_not_have_are_dropped_unless_they_are_kept():
    """Loose cells beside the ball: single ones go, a half of the ball stays, and so does a
    twentieth.
    """
    image, mask = shaped("ball")
    target = content(image, mask=mask)
    whole = mesh_image(target, 300, iterations=1).mesh
    height = whole.points[whole.cells].mean(axis=1)[:, 2]

    def carved(place, **options):
        """Without a slab of cells: the mesh, what is kept of it, and the carved mesh."""
        mesh = part_of(whole, np.abs(height - place) > 1.5)
        kept = carve_mesh(mesh, target.image, target.region, **options)
        return mesh, kept, part_of(mesh, kept.is_kept)

    halves, kept, left = carved(12.0)
    sizes = np.bincount(components(halves.cells))
    n_large = np.count_nonzero(sizes > 0.2 * sizes.max())
    assert components(left.cells).max() + 1 == n_large == 2
    assert kept.n_dropped == len(sizes) - n_large
    left = carved(22.5)[2]
    small, large = np.sort(np.bincount(components(left.cells), left.cell_volumes))
    assert 0.01 * large < small < 0.05 * large
    every = carved(12.0, keeps_components=True)[1]
    assert every.n_dropped == 0
    assert every.is_kept.sum() >= kept.is_kept.sum()


@pytest.mark.full
def test_what_a_mesh_tears_off_is_kept_and_told():
    """A ball with a bulb at a thin winding tail, which octree cells of that size tear."""
    image, _ = shaped("ball")
    bulb = distance(image.shape, 10.5, 16.6, 24.5) < 2.3
    inside = (distance(image.shape, 13.3, 14.1, 9.7) < 8.0) | bulb
    for k in range(7):
        i, j = k // 2, (k + 1) // 2
        inside[[13 - j, 13 - i, 13 - j], [14 + i, 14 + i, 14 + j], 16 + k] = True
    mask = Image(1.0 * inside)
    assert scipy.ndimage.label(inside)[1] == 1
    for keeps in (False, True):
        target = content(image, mask=mask, keep_components=keeps)
        result = mesh_image(target, 400, iterations=3)
        assert result.n_dropped == 0
        assert components(result.mesh.cells).max() == 1
        assert list(result.violated) == ["components"]
    labels = Image(np.where(bulb, 7.0, 3.0))  # the bulb is a label of its own
    named = mesh_image(content(image, labels, mask), 400, iterations=1)
    assert (named.n_dropped, set(named.labels.tolist())) == (0, {3, 7})
