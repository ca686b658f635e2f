"""Units of headers, and headers that state two places, sides or sizes: one is used, both are
told.
"""

from pathlib import Path

import nibabel
import numpy as np
import pytest
from numpy.testing import assert_allclose
from readers import OBLIQUE, ramp, read_warned
from refusals import assert_refused, refusal

from tetopt.io.units import mm_of_unit

pytest.importorskip("SimpleITK")
pytestmark = pytest.mark.usefixtures("here")

VOXELS = np.arange(3 * 4 * 500, dtype=np.uint8)  # 3 x 4 x 500: 10 mm long at 0.02 mm
LPS = (
    "space: left-posterior-superior\nspace directions: (20,0,0) (0,20,0) (0,0,20)\nspace "
    "origin: (100,0,-50)\n"
)


def nrrd(fields, sizes="3 4 500"):
    n_axes = len(sizes.split())
    head = f"NRRD0004\ntype: uint8\ndimension: {n_axes}\nsizes: {sizes}\nencoding: raw\n{fields}\n"
    Path("a.nrrd").write_bytes(head.encode() + VOXELS.tobytes())
    return Path("a.nrrd")


def mha(fields, data=VOXELS):
    head = f"ObjectType = Image\nNDims = 3\nDimSize = 3 4 500\n{fields}ElementType = MET_UCHAR\n"
    Path("a.mha").write_bytes(f"{head}ElementDataFile = LOCAL\n".encode() + data.tobytes())
    return Path("a.mha")


# Units


UNITS = {  # mm, and words
    1e-3: ["microns", "um", "µm", "\u03bcm", r"\u00B5m", "Micrometres"],
    1.0: ["mm", "MM", "millimeter"],
    10.0: ["cm"],
    1000.0: ["m", "metre"],
    1e-6: ["nm"],
    25.4: ["inches", " in "],
    304.8: ["feet"],
    None: ["", "pixels", "Unknown"],
}


@pytest.mark.parametrize("mm", UNITS)
def test_words_of_units(mm):
    assert {mm_of_unit(word) for word in UNITS[mm]} == {mm}


@pytest.mark.parametrize("word", ["second", "furlong", "s", "Hz", "mm2", "mms m"])
def test_words_of_no_length_are_refused(word):
    with refusal(f'unit: expected a length such as "mm" or "um", got "{word}"'):
        mm_of_unit(word)


UNITS_OF_NRRD = {  # fields, voxel edges in mm, first voxel in RAS mm
    "of a space": (
        LPS + 'space units: "microns" "microns" "microns"\n',
        [0.02] * 3,
        [-0.1, 0.0, -0.05],
    ),
    "µm": (LPS + 'space units: "µm" "µm" "µm"\n', [0.02] * 3, [-0.1, 0.0, -0.05]),
    "that differ": (
        LPS + 'space units: "mm" "mm" "cm"\n',
        [20.0, 20.0, 200.0],
        [-100.0, 0.0, -500.0],
    ),
    "of RAS": (
        LPS.replace("left-posterior", "right-anterior") + 'space units: "um" "um" "um"\n',
        [0.02] * 3,
        [0.1, 0.0, -0.05],
    ),
    "of axes": ('spacings: 20 20 40\nunits: "um" "um" "um"\n', [0.02, 0.02, 0.04], [0.0, 0.0, 0.0]),
    "none": (LPS, [20.0] * 3, [-100.0, 0.0, -50.0]),
}


@pytest.mark.parametrize("name", UNITS_OF_NRRD)
def test_units_of_nrrd(name):
    fields, steps, corner = UNITS_OF_NRRD[name]
    image, said = read_warned(nrrd(fields))
    assert_allclose(image.spacing, steps, rtol=1e-12)
    assert_allclose(image.to_world([0, 0, 0]), corner, rtol=1e-12, atol=1e-12)
    assert ("or in another unit?" in "".join(said)) == (name == "none")  # 10 m long
    assert len(said) == (name in ("none", "of axes"))
    assert ("it has no space" in "".join(said)) == (name == "of axes")


def test_unit_of_no_length_in_nrrd():
    for units, words in (
        ('"mm" "mm" "furlong"', 'expected a length such as "mm" or "um", got "furlong"'),
        ("um um um", "expected a unit in quotation marks per axis, got um um um"),
    ):
        path = nrrd(f"{LPS}space units: {units}\n")
        assert_refused(path, f"space units: {words}")
    image, said = read_warned(nrrd(LPS + 'space units: "um" "um" ""\n'))
    assert image.spacing.tolist() == pytest.approx([0.02, 0.02, 20.0])
    assert said == ['space units: expected a unit of length, got none for axis 2: ""; assuming mm']


def test_unit_of_metaimage():
    image, said = read_warned(mha("ElementSpacing = 20 20 20\nDistanceUnits = um\n"))
    assert (image.spacing.tolist(), said) == (pytest.approx([0.02] * 3), [])


@pytest.mark.parametrize(
    ("unit", "said"), [("micron", None), ("mm", "0.1 mm, in the unit that"), ("unknown", "or in")]
)
def test_small_box_of_a_stated_unit(unit, said):
    step = 20.0 if unit == "micron" else 0.02
    file = nibabel.Nifti1Image(ramp(3, 4, 5), np.diag([step] * 3 + [1.0]))
    file.header.set_xyzt_units(unit)
    nibabel.save(file, "a.nii")
    image, heard = read_warned("a.nii")
    assert image.spacing.tolist() == pytest.approx([0.02] * 3)
    assert heard == [] if said is None else said in heard[0]


# Headers that contradict themselves


def nifti(sform, qform, codes=(1, 1), **fields):
    header = nibabel.Nifti1Image(ramp(3, 4, 5), None).header
    header.set_qform(qform, codes[1])
    header.set_sform(sform, codes[0])
    header.set_xyzt_units("mm")
    for name, value in ({"vox_offset": 352} | fields).items():
        header[name] = value
    # Saved by nibabel, a file would get one affine.
    raw = header.binaryblock + bytes(4) + ramp(3, 4, 5).tobytes(order="F")
    Path("a.nii").write_bytes(raw)
    return Path("a.nii")


def moved(by, affine=None):
    out = np.diag([1.0, 2.0, 3.0, 1.0]) if affine is None else affine.copy()
    out[:3, 3] += by
    return out


STEPS = moved([0, 0, 0])
TURN = np.eye(4)
TURN[:2, :2] = [[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]]
PLACES = {  # sform, qform, codes, what is told; None for nothing
    "moved": (
        STEPS,
        moved([0, 0, 7.5]),
        (1, 1),
        "place it differently, by up to 7.5 mm; the sform is used",
    ),
    "half a voxel": (STEPS, moved([0.5, 0, 0]), (1, 1), "by up to 0.5 mm"),
    "mirrored": (
        STEPS,
        np.diag([-1.0, 2.0, 3.0, 1.0]),
        (1, 1),
        "are mirror images of each other (left/right)",
    ),
    "sizes": (
        STEPS,
        np.diag([1.0, 2.0, 3.3, 1.0]),
        (2, 2),
        "place it differently, by up to 1.2 mm",
    ),
    "turned": (STEPS, TURN @ STEPS, (1, 1), "place it differently, by up to 0.6"),
    "spaces": (
        moved([5, 0, 0]),
        STEPS,
        (4, 1),
        "the sform (MNI space) and the qform (scanner space) place it",
    ),
    "equal": (STEPS, STEPS, (1, 1), None),
    "rounded": (moved(1e-3), STEPS, (1, 1), None),
    "half a turn": (
        moved(0, np.diag([-1.0, -2.0, 3.0, 1.0])),
        np.diag([-1.0, -2.0, 3.0, 1.0]),
        (4, 1),
        None,
    ),
    "no qform": (STEPS, moved([50, 0, 0]), (1, 0), None),
    "no sform": (moved([50, 0, 0]), TURN @ STEPS, (0, 1), None),
    "neither": (STEPS, STEPS, (0, 0), "has no orientation: position and left/right are"),
}


@pytest.mark.parametrize("name", PLACES)
def test_two_places_of_nifti(name):
    sform, qform, codes, told = PLACES[name]
    image, said = read_warned(nifti(sform, qform, codes))
    assert said == [] if told is None else told in said[-1]
    if any(codes):
        expected = sform if codes[0] else qform
        assert_allclose(image.affine, expected.astype(np.float32), rtol=0, atol=1e-6)


def test_shear_that_a_qform_cannot_have():
    file = nibabel.Nifti1Image(np.zeros((200, 200, 90), np.uint8), OBLIQUE)
    file.header.set_qform(OBLIQUE, 1, strip_shears=True)
    file.header.set_sform(OBLIQUE, 1)
    nibabel.save(file, "a.nii.gz")
    assert not any("sform" in line for line in read_warned("a.nii.gz")[1])


def test_sizes_of_nifti():
    path = nifti(STEPS, STEPS, dim=[3, 3, 4, 4, 1, 1, 1, 1])
    assert read_warned(path)[1] == [
        "its header declares 3 x 4 x 4 voxels, but the file has 24 more bytes after them; check "
        "its sizes"
    ]


TURNED = "0 1 0 0 0 1 1 0 0"
METAIMAGES = {  # fields, what is told, voxel edges, RAS direction of the first axis
    "sizes": (
        "ElementSize = 2 2 2\nElementSpacing = 1 1 3\n",
        None,
        [1, 1, 3],
        [-1, 0, 0],
    ),
    "size alone": ("ElementSize = 2 2 3\n", None, [2, 2, 3], [-1, 0, 0]),
    "no size": ("Comment = x\n", "has no voxel size: assuming 1 mm", [1, 1, 1], [-1, 0, 0]),
    "directions": (
        f"Orientation = 1 0 0 0 1 0 0 0 1\nTransformMatrix = {TURNED}\n",
        None,
        None,
        [0, -1, 0],
    ),
    "twice": ("ElementSpacing = 2 2 2\nElementSpacing = 1 1 3\n", None, [1, 1, 3], None),
    "lengths": ("TransformMatrix = 2 0 0 0 2 0 0 0 1\n", None, [2, 2, 1], None),
    "letters": (
        "AnatomicalOrientation = LAI\n",
        "states directions LxPxS, which are used, and AnatomicalOrientation LAI, which has other",
        None,
        [-1, 0, 0],
    ),
    "letters of ITK": ("AnatomicalOrientation = RAI\n", None, None, [-1, 0, 0]),
    "letters of MetaIO": (
        f"AnatomicalOrientation = PSL\nTransformMatrix = {TURNED}\n",
        None,
        None,
        [0, -1, 0],
    ),
    "letters unset": ("AnatomicalOrientation = ???\n", None, None, None),
}


@pytest.mark.parametrize("name", METAIMAGES)
def test_two_statements_of_metaimage(name):
    fields, told, steps, first = METAIMAGES[name]
    has_size = "Element" in fields or name == "no size"
    image, said = read_warned(mha(fields if has_size else f"{fields}ElementSpacing = 1 1 1\n"))
    assert said == [] if told is None else told in said[0], said
    if steps is not None:
        assert image.spacing.tolist() == pytest.approx(steps)
    if first is not None:
        assert_allclose(image.affine[:3, 0] / image.spacing[0], first)


def test_more_voxels_than_metaimage_declares():
    path = mha("ElementSpacing = 1 1 1\n", data=np.zeros(3 * 4 * 501, np.uint8))
    assert "declares 3 x 4 x 500 voxels, but the file has 12 more bytes" in read_warned(path)[1][0]


NRRDS = {
    "mins and maxs beside spacings": (
        "spacings: 2 2 2\naxis mins: 0 0 0\naxis maxs: 6 8 1000\n",
        "it has no space, which leaves left and right open",
    ),
    "mins and maxs alone": (
        "axis mins: 0 0 0\naxis maxs: 6 8 1000\n",
        "has no voxel size: assuming 1 mm",
    ),
    "no size": ("", "has no voxel size: assuming 1 mm"),
    "unknown sizes": ("spacings: nan NaN nan\n", "has no voxel size: assuming 1 mm"),
    "an unknown size": (
        "spacings: 2 2 nan\n",
        "has no voxel size along 1 of 3 axes: assuming 1 mm",
    ),
    "space": (
        LPS.replace("left-posterior-superior", "3D-right-handed"),
        'its space "3D-right-handed" does not tell',
    ),
    "no space": (
        LPS.replace("space: left-posterior-superior", "space dimension: 3"),
        "it has no space, which",
    ),
}


@pytest.mark.parametrize("name", NRRDS)
def test_two_statements_of_nrrd(name):
    fields, told = NRRDS[name]
    said = read_warned(nrrd(fields))[1]
    assert said == [] if told is None else told in said[0]


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        (
            LPS + "spacings: 1 1 1\n",
            r'both "spacedirections" .* and "spacings" \(1 1 1\)',
        ),
        (
            LPS + "space dimension: 3\n",
            r'both "space" \(left-posterior-superior\) and "spacedimension" \(3\)',
        ),
        ("space: LPS\nspacings: 1 1 1\n", 'has the space "LPS" but no "space directions"'),
    ],
)
def test_statements_that_nrrd_excludes(fields, told):
    assert_refused(nrrd(fields), told)
