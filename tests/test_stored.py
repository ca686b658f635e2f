"""An image whose voxels stay where they are: boxes of it are images in their own place."""

from types import SimpleNamespace

import numpy as np
import pytest

from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.io.volumes import VoxelsInFile
from tetopt.system import budget

AFFINE = np.array(
    [[0.0, -2.0, 0.5, 3.0], [1.0, 0.0, 0.0, -7.0], [0.0, 0.25, 3.0, 11.0], [0.0, 0.0, 0.0, 1.0]]
)


def ramp(*shape):
    return np.arange(np.prod(shape), dtype=np.int16).reshape(shape)


def test_a_box_keeps_its_place():
    stored, whole = Image.stored(ramp(5, 6, 7), AFFINE), Image(ramp(5, 6, 7), AFFINE)
    box = stored.box((1, 2, 3), (4, 4, 7))
    np.testing.assert_array_equal(box.data, whole.data[1:4, 2:4, 3:7])
    np.testing.assert_array_equal(box.to_world([0, 0, 0]), whole.to_world([1, 2, 3]))
    assert (stored.shape, stored.volume) == (whole.shape, whole.volume)
    assert stored.read((0, 0, 0), (1, 1, 2)).dtype == np.int16


@pytest.mark.parametrize("shape", [(5, 6), (5, 6, 7, 2), (5, 0, 7)])
def test_other_than_three_axes_are_refused(shape):
    with pytest.raises(InputError, match="expected three non-empty axes"):
        Image.stored(ramp(*shape))


def test_values_that_no_image_takes_are_seen_in_their_box():
    voxels = np.zeros((4, 4, 4))
    voxels[3, 0, 0] = np.nan
    stored = Image.stored(voxels)
    stored.box((0, 0, 0), (3, 4, 4))
    with pytest.raises(InputError, match="NaN"):
        stored.box((2, 0, 0), (4, 4, 4))


def test_three_axes_of_more(tmp_path):
    """A box of a box, of axes in the midst of others."""
    array = ramp(2, 5, 3, 6, 7)
    voxels = VoxelsInFile(
        tmp_path, array, (1, slice(0, 5), 2, slice(1, 6), slice(0, 7)), (1, 4, 1, 3, 2)
    )
    assert (voxels.shape, voxels.chunks, voxels.dtype) == ((5, 5, 7), (4, 3, 2), np.int16)
    part = voxels.within([(1, 4), (2, 5), (0, 6)])
    assert (part.shape, part.chunks) == ((3, 3, 6), (4, 3, 2))
    np.testing.assert_array_equal(
        part[slice(1, 3), slice(None), slice(2, -1)], array[1, 2:4, 2, 3:6, 2:5]
    )


class Counted:
    """Voxels of an array, and how often they were read."""

    def __init__(self, data):
        self.data, self.shape, self.dtype, self.n_reads = data, data.shape, data.dtype, 0

    def __getitem__(self, box):
        self.n_reads += 1
        return self.data[box]


def test_the_whole_is_read_when_it_is_asked_for(monkeypatch):
    """Once, and not to show what the image is; it is refused where there is no memory for it."""
    voxels = Counted(ramp(5, 6, 7))
    stored = Image.stored(voxels, AFFINE)
    assert "5 x 6 x 7 voxels" in repr(stored)
    assert "5 x 6 x 7 voxels" in stored._repr_html_()
    assert (stored.is_stored, stored.in_memory, voxels.n_reads) == (True, None, 0)
    monkeypatch.setattr(budget, "available_bytes", lambda: 1000)
    with pytest.raises(
        InputError, match=r"image: 5 x 6 x 7 voxels .* needs about .* of memory.*read it box by box"
    ):
        _ = stored.data
    monkeypatch.undo()
    np.testing.assert_array_equal(stored.data, Image(ramp(5, 6, 7)).data)
    assert stored.data is stored.data
    assert (stored.is_stored, stored.in_memory, voxels.n_reads) == (False, stored, 1)


def test_what_has_been_read_as_a_whole_is_not_read_again():
    voxels = Counted(ramp(4, 5, 6))
    image = Image.stored(voxels)
    whole = image.data
    assert voxels.n_reads == 1
    assert np.shares_memory(image.read((0, 0, 0), (2, 2, 2)), whole)
    assert image.box((1, 1, 1), (4, 5, 6)).data.tolist() == whole[1:, 1:, 1:].tolist()
    del voxels.data  # as of a file that was closed
    assert image.shape == (4, 5, 6)
    assert "4 x 5 x 6 voxels" in repr(image)


def test_the_whole_of_what_no_image_takes_is_refused():
    with pytest.raises(
        InputError, match=r"1 voxels are NaN or infinite, the first at index \(0, 1, 0\)"
    ):
        _ = Image.stored(np.array([[[1.0], [np.nan]]])).data


def test_boxes_are_as_the_voxels_lie(monkeypatch):
    """Of what NIfTI has mapped all planes and some rows, else some planes; of chunks whole ones,
    dask's largest.
    """
    monkeypatch.setattr("tetopt.image.READ_BYTES", 2 * 4 * 6 * 8)
    voxels = np.zeros((8, 6, 8), dtype=np.int16)
    chunked = SimpleNamespace(shape=(8, 6, 8), dtype=voxels.dtype, chunks=((3, 4, 1), (6,), (8,)))
    zarr = SimpleNamespace(shape=(8, 6, 8), dtype=voxels.dtype, chunks=(2, 3, 8))
    first = {
        name: next(Image.stored(each).boxes())[:2]
        for name, each in {
            "C": voxels,
            "F": np.asfortranarray(voxels),
            "dask": chunked,
            "zarr": zarr,
        }.items()
    }
    assert first == {
        "C": (slice(0, 4), slice(0, 6)),
        "F": (slice(0, 8), slice(0, 3)),
        "dask": (slice(0, 4), slice(0, 6)),
        "zarr": (slice(0, 2), slice(0, 6)),
    }


def test_boxes_cover_every_voxel_once_in_memory_and_stored(monkeypatch):
    """Those in memory are small whatever the image, also of a plane; a stored one takes memory
    for a box.
    """
    monkeypatch.setattr("tetopt.image.PIECE_VOXELS", 84)
    monkeypatch.setattr("tetopt.image.READ_BYTES", 2 * 50)
    for image, most in (
        (Image(ramp(5, 6, 7)), 84),
        (Image.stored(ramp(5, 6, 7)), 50),
        (Image(ramp(30, 7)), 210),
    ):
        count = np.zeros((1,) * (3 - image.ndim) + image.shape, dtype=int)
        for box in image.boxes():
            count[box] += 1
            assert count[box].size <= most
        assert (count == 1).all()
        assert image.box_bytes == 200.0 * image.is_stored
