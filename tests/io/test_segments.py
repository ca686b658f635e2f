"""Segmentations of 3D Slicer: layers, names, numbers and overlaps."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from readers import read_warned
from refusals import assert_refused

import tetopt
from tetopt.commands.beside import voxels_of
from tetopt.io.images import load_image
from tetopt.io.label_tables import load_label_table
from tetopt.job.options import MaskedPart
from tetopt.study.compare_files import _label_source

sitk = pytest.importorskip("SimpleITK")
pytestmark = pytest.mark.usefixtures("here")

HEAD = (
    "NRRD0004\ntype: uint8\ndimension: 4\nspace: left-posterior-superior\nsizes: {sizes}\nspace "
    "directions: none "
    "(1,0,0) (0,2,0) (0,0,3)\nkinds: list domain domain domain\nencoding: raw\nspace origin: "
    "(5,6,7)\n"
)
LAYERS = np.zeros((2, 6, 5, 4), np.uint8)
LAYERS[0, 1:5, 1:4, 1:3] = 1  # liver, 24 voxels
LAYERS[0, 0, 0, 0] = 2  # bone
LAYERS[1, 3:6, 1:4, 1:3] = 1  # tumour, 18 voxels, 12 of them in the liver
SEGMENTS = [("liver", 1, 0), ("bone", 2, 0), ("tumour", 1, 1)]


def seg_nrrd(layers=LAYERS, segments=SEGMENTS, more="", name="a.seg.nrrd"):
    """A file of layers (L, x, y, z) and segments (name, value, layer)."""
    text = HEAD.format(sizes=" ".join(map(str, layers.shape))) + more
    for k, (segment, value, layer) in enumerate(segments):
        text += f"Segment{k}_Name:={segment}\nSegment{k}_ID:=Segment_{k}\n"
        text += (
            "" if value is None else f"Segment{k}_LabelValue:={value}\nSegment{k}_Layer:={layer}\n"
        )
    Path(name).write_bytes(text.encode() + b"\n" + layers.tobytes(order="F"))
    return Path(name)


def test_layers_that_share_values():
    """The numbers are the segments' order; the later layer wins; both are told."""
    path = seg_nrrd(more="Segment2_Color:=1 0.5 0\n")
    image, said = read_warned(path)
    expected = LAYERS[0].copy()
    expected[LAYERS[1] == 1] = 3
    assert_array_equal(image.data, expected)
    assert_array_equal(
        image.affine, np.array([[-1, 0, 0, -5], [0, -2, 0, -6], [0, 0, 3, 7], [0, 0, 0, 1.0]])
    )
    assert said == [
        "its segments share label values; they are numbered in order: 1 liver, 2 bone, 3 tumour",
        'segment "tumour" covers 12 of the 24 voxels of "liver"; later layers win',
    ]
    assert load_label_table(path) == ({1: "liver", 2: "bone", 3: "tumour"}, {3: (1.0, 0.5, 0.0)})


def test_values_of_the_file_are_kept():
    """In one layer, and where each segment has a value of its own."""
    layer = np.where(LAYERS[:1] == 2, np.uint8(77), LAYERS[:1])
    path = seg_nrrd(layer, [("liver", 1, 0), ("bone", 77, 0)])
    image, said = read_warned(path)
    assert_array_equal(image.data, layer[0])
    assert (said, load_label_table(path).names) == ([], {1: "liver", 77: "bone"})
    layers = LAYERS * np.array([1, 9], np.uint8)[:, None, None, None]
    segments = [("liver", 1, 0), ("bone", 2, 0), ("tumour", 9, 1)]
    image, said = read_warned(seg_nrrd(layers, segments))
    values, counts = np.unique(image.data, return_counts=True)
    assert values.tolist() == [0, 1, 2, 9]
    assert counts.tolist() == [120 - 24 - 1 - 6, 12, 1, 18]
    assert len(said) == 1


def test_files_of_older_programs():
    """Each segment is a layer of ones, in order."""
    segments = [(name, None, None) for name in ("liver", "tumour")]
    image, said = read_warned(seg_nrrd(LAYERS & 1, segments))
    assert np.unique(image.data, return_counts=True)[1].tolist() == [120 - 30, 12, 18]
    assert "1 liver, 2 tumour" in said[0]


def test_what_cannot_be_told_apart():
    image, said = read_warned(seg_nrrd(LAYERS[:1], [("liver", 1, 0), ("lobe", 1, 0)]))
    assert said == [
        'segments of one layer share a label value and cannot be told apart: "liver / lobe"',
        "1 voxels have values of no segment ([2]) and get label 0",
    ]
    assert image.data[0, 0, 0] == 0


@pytest.mark.parametrize(
    ("segment", "match"),
    [
        (("liver", 1, 2), 'segment "liver" is in layer 2, but the file has 2'),
        (("liver", 0, 0), "from 1 as its LabelValue"),
        (("liver", "x", 0), 'its LabelValue, got "x"'),
        (("liver", 10**10, 0), "its LabelValue"),
    ],
)
def test_segments_that_are_not_there(segment, match):
    assert_refused(seg_nrrd(segments=[segment]), match)


def test_an_nrrd_without_segments():
    path = seg_nrrd(segments=[])
    assert_refused(path, "the file has 2 volumes")
    assert_refused(path, "expected names of segments in this file, found none", load_label_table)


def test_names_come_with_the_labels():
    """Without --label-names, a run takes the names of the segmentation itself; a table replaces
    them.
    """
    path = seg_nrrd()
    Path("t.csv").write_text("label,name\n1,a\n2,b\n3,c\n")
    seg_nrrd(segments=[("A", 1, 0), ("B", 2, 0), ("C", 1, 1)], name="b.seg.nrrd")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for table, names in (
            (None, ["liver", "bone", "tumour"]),
            ("t.csv", ["a", "b", "c"]),
            ("b.seg.nrrd", ["A", "B", "C"]),
        ):
            job = tetopt.Job(images=path, labels=path, output="a.vtu", label_names=table)
            assert tetopt.read(job).source.table.names == dict(enumerate(names, 1))


def test_names_come_with_the_labels_of_another_mesh(here):
    """The cells of a mesh's file that take their labels from a segmentation take its names."""
    path = seg_nrrd(LAYERS[:1], SEGMENTS[:2])
    mesh = tetopt.lattice_mesh(load_image(path), nodes=60)
    tetopt.save_mesh("a.vtu", mesh)
    loaded = tetopt.load_mesh("a.vtu")
    loaded = voxels_of(loaded, here / "a.vtu", None, MaskedPart(), path).loaded
    assert loaded.label_table.names == {1: "liver", 2: "bone"}


@pytest.mark.full
def test_real_overlapping_segments(data_dir):
    path = data_dir / "SegmentationOverlapping.seg.nrrd"
    image, said = read_warned(path)
    raw = sitk.GetArrayFromImage(sitk.ReadImage(str(path))).T
    assert_array_equal(image.data, np.where(raw[1] == 1, 8, raw[0]))
    assert 'segment "overlapping sphere" covers 491 of the 8487 voxels of "ribs", 118' in said[1]
    assert load_label_table(path).names[8] == "overlapping sphere"


def test_a_comparison_names_labels_as_the_file_does():
    """Its figures and report.json have these names, unless another table is given."""
    path, names = seg_nrrd(), Path("names.csv")
    names.write_text("label,name\n1,hepar\n")
    image, _ = read_warned(path)
    assert _label_source(path, image, None).names == {1: "liver", 2: "bone", 3: "tumour"}
    assert _label_source(path, image, names).names == {1: "hepar"}
