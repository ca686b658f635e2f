"""DICOM to images: frames lie where they say, whatever their order, file or kind; or are refused
for the true reason.

Files are made by pydicom, segmentations by highdicom, which is also the oracle for them.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from commands import assert_done, exit_code
from numpy.testing import assert_allclose, assert_array_equal
from readers import read_warned
from refusals import assert_refused

import tetopt
from tetopt.io.images import image_files, load_image, sha256
from tetopt.io.label_tables import load_label_table
from tetopt.io.read_dicom import _unevenness

pydicom = pytest.importorskip("pydicom")
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset  # noqa: E402

pytestmark = pytest.mark.usefixtures("here")

CT, ENHANCED_CT, MR = (
    "1.2.840.10008.5.1.4.1.1.2",
    "1.2.840.10008.5.1.4.1.1.2.1",
    "1.2.840.10008.5.1.4.1.1.4",
)
EXPLICIT = "1.2.840.10008.1.2.1"
AXES = np.array([[0.8, 0.6, 0.0], [-0.36, 0.48, 0.8]])  # of rows and columns: oblique
NORMAL = np.cross(*AXES)
AXIAL = [1, 0, 0, 0, 1, 0]
ORIGIN, BETWEEN_ROWS, BETWEEN_COLUMNS, STEP = np.array([10.0, -20.0, 30.0]), 0.5, 0.75, 3.0
# slices, rows, columns: every voxel another value
RAMP = np.arange(6 * 4 * 5, dtype=np.int16).reshape(6, 4, 5)


def tagged(**tags):
    data = Dataset()
    for name, value in tags.items():
        setattr(data, name, value)
    return data


def group(name, **tags):
    """A functional group: a sequence of one item."""
    return {f"{name}Sequence": [tagged(**tags)]}


def file_of(kind, pixels, **tags):
    """A file of 16-bit pixels (rows, columns), or (frames, rows, columns)."""
    rows, columns = pixels.shape[-2:]
    data = tagged(
        SOPClassUID=kind,
        SOPInstanceUID=pydicom.uid.generate_uid(),
        SeriesInstanceUID="1.2.3",
        Rows=rows,
        Columns=columns,
        SamplesPerPixel=1,
        PhotometricInterpretation="MONOCHROME2",
        BitsAllocated=16,
        BitsStored=16,
        HighBit=15,
        PixelRepresentation=1,
        PixelData=np.ascontiguousarray(pixels, "<i2").tobytes(),
        **tags,
    )
    if pixels.ndim == 3:
        data.NumberOfFrames = len(pixels)
    return data


def saved(data, path="a.dcm", syntax=EXPLICIT):
    data.file_meta = FileMetaDataset()
    data.file_meta.MediaStorageSOPClassUID = data.SOPClassUID
    data.file_meta.MediaStorageSOPInstanceUID = data.get("SOPInstanceUID") or "1.2.9"
    data.file_meta.TransferSyntaxUID = syntax
    pydicom.dcmwrite(path, data, enforce_file_format=True)
    return Path(path).absolute()


def places(n=6, step=STEP * NORMAL):
    return ORIGIN + np.arange(n)[:, None] * step


def enhanced(frames, where, *, own=None, axes=AXES, **measures):
    """An Enhanced CT of frames at these places; `own` are further functional groups of each
    frame.
    """
    measures = {
        "PixelSpacing": [BETWEEN_ROWS, BETWEEN_COLUMNS],
        "SpacingBetweenSlices": STEP,
    } | measures
    data = file_of(ENHANCED_CT, frames)
    shared = group("PlaneOrientation", ImageOrientationPatient=axes.ravel().tolist())
    data.SharedFunctionalGroupsSequence = [tagged(**shared | group("PixelMeasures", **measures))]
    data.PerFrameFunctionalGroupsSequence = [
        tagged(
            **group("PlanePosition", ImagePositionPatient=place.round(9).tolist()),
            **({} if own is None else own[k]),
        )
        for k, place in enumerate(where)
    ]
    return data


def one_slice(pixels, place, kind=CT, **tags):
    where = {
        "ImagePositionPatient": place.round(9).tolist(),
        "ImageOrientationPatient": AXES.ravel().tolist(),
    }
    return file_of(kind, pixels, PixelSpacing=[BETWEEN_ROWS, BETWEEN_COLUMNS], **where | tags)


def slices_of(folder, pixels=RAMP, where=None, **tags):
    """A series of single slices, named in another order than they lie."""
    folder.mkdir(exist_ok=True)
    for k, place in enumerate(places(len(pixels)) if where is None else where):
        saved(one_slice(pixels[k], place, **tags), folder / f"s{(k * 7) % 11}.dcm")
    return folder


def affine_of(step=STEP * NORMAL):
    affine = np.eye(4)
    affine[:3] = np.column_stack([AXES[0] * BETWEEN_COLUMNS, AXES[1] * BETWEEN_ROWS, step, ORIGIN])
    return np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine


def assert_placed(path, pixels=RAMP, affine=None, said=None, **options):
    """The file's voxels (slices, rows, columns) and their place; and one warning, or none."""
    image, heard = read_warned(path, **options)
    assert_array_equal(image.data, pixels.T)
    assert_allclose(image.affine, affine_of() if affine is None else affine, rtol=0, atol=1e-7)
    assert heard == [] if said is None else re.search(said, "\n".join(heard)), heard


ORDER = np.array([3, 0, 5, 1, 4, 2])


@pytest.mark.apart
def test_frames_in_any_order():
    """The reader sorts them; rows and columns have spacings of their own, and the world is
    oblique.
    """
    assert_placed(saved(enhanced(RAMP[ORDER], places()[ORDER])))


@pytest.mark.parametrize("is_series", [False, True])
def test_slices_of_a_tilted_gantry_keep_their_shear(tmp_path, is_series):
    where = places(step=STEP * NORMAL + 0.8 * AXES[1])
    path = tmp_path / "a.dcm"
    if is_series:
        slices_of(path, where=where)
        assert_refused(path, "expected a volume from 0 to 0", volume=1)
    else:
        saved(enhanced(RAMP[ORDER], where[ORDER]), path)
    assert_placed(path, affine=affine_of(where[1] - where[0]), volume=0)


def test_several_files_of_one_series_are_one_volume(tmp_path):
    """Files of many frames and of one, whose frames interleave (a concatenation)."""
    for name, frames in (("b", [4, 0, 2]), ("a", [1, 5]), ("c", [3])):
        saved(enhanced(RAMP[frames], places()[frames]), f"{name}.dcm")
    assert_placed(tmp_path)
    saved(enhanced(RAMP[3:4], places()[3:4]), "again.dcm")
    assert_refused(
        tmp_path,
        "7 slices of this DICOM series have 6 positions: .* several volumes .* separate folder",
    )


def test_several_volumes_in_files_of_their_own(tmp_path):
    for name in "ab":
        saved(enhanced(RAMP, places()), f"{name}.dcm")
    assert_refused(
        tmp_path, "12 slices of this DICOM series have 6 positions: .* give one of its files"
    )


@pytest.mark.parametrize("is_series", [False, True])
@pytest.mark.parametrize(
    ("where", "match"),
    [
        (
            places(7)[[0, 1, 2, 3, 6, 5]],
            r"not evenly spaced \(a step of 6 mm between slices 3 and 4, counted from 0, and 3 mm "
            "elsewhere: one is missing",
        ),
        (places()[[0, 1, 2, 3, 4, 4]], "6 slices of .* have 5 positions: it has several volumes"),
        (places(1)[[0] * 6], "6 slices of .* have 1 position: it has several volumes"),
        (places(step=AXES[0]), "beside each other|not evenly spaced"),
    ],
)
def test_places_that_are_no_volume(tmp_path, where, match, is_series):
    """Frames and files are refused alike."""
    if is_series:
        assert_refused(slices_of(tmp_path, where=where), match)
    else:
        assert_refused(saved(enhanced(RAMP, where)), f"{match}.*; |{match}")


def test_uneven_slices_in_words():
    # even, but not on a line
    points = np.column_stack([np.zeros(5), [0.0, 1.0, 2.0, 1.0, 0.0], 3.0 * np.arange(5)])
    off = np.abs(points[:, 1])
    said = _unevenness(points, off)
    assert said == "slice 2, counted from 0, is 2 mm off its even place between first and last"
    points = np.outer([0.0, 3.0, 6.0, 9.0, 15.0, 24.0, 27.0], [0.0, 0.0, 1.0])
    said = _unevenness(points, off)
    assert "9 mm between slices 4 and 5, counted from 0, and 3 mm at most places" in said


def turned(k):
    own = [{}] * 6
    own[k] = group("PlaneOrientation", ImageOrientationPatient=AXIAL)
    return own


SQUARE = group("PixelMeasures", PixelSpacing=[1, 1])


def of_times(*times):
    return [group("FrameContent", TemporalPositionIndex=time) for time in times]


@pytest.mark.parametrize(
    ("frames", "options", "match"),
    [
        (6, {"own": turned(2)}, "not parallel .*frame 3 of the file"),
        (6, {"own": [*[{}] * 5, SQUARE]}, "frame 6 .*different sizes"),
        (5, {}, "6 frames, but states where 5 lie"),
        (6, {"axes": np.ones((2, 3))}, "orthogonal"),
        (6, {"own": of_times(1, 2, 1, 2, 1, 2)}, "2 volumes"),
    ],
)
def test_frames_that_are_no_volume(frames, options, match):
    data = enhanced(RAMP, places(frames), **options)
    assert_refused(saved(data), match)


def with_axial(folder):
    saved(one_slice(RAMP[0], places(7)[6], ImageOrientationPatient=AXIAL), folder / "a.dcm")


def with_two_series(folder):
    data = one_slice(RAMP[0], ORIGIN)
    data.SeriesInstanceUID = "1.2.5"
    saved(data, folder / "a.dcm")


def cut(folder):
    (folder / "s7.dcm").write_bytes((folder / "s7.dcm").read_bytes()[:-20])


def of_two_frames_of_reference(folder):
    for name, number in (("s", 5), ("t", 7)):
        data = one_slice(RAMP[0], places(8)[number], FrameOfReferenceUID=f"1.2.{number}")
        saved(data, folder / f"{name}.dcm")


@pytest.mark.parametrize(
    ("edit", "match"),
    [
        (with_axial, "not parallel"),
        (with_two_series, r"expected one DICOM series, got 2; .*1\.2\.5 \(1 files\), 1\.2\.3 \(6 "),
        pytest.param(cut, r"s7\.dcm is truncated or damaged", marks=pytest.mark.apart),
        (
            of_two_frames_of_reference,
            r"t\.dcm and .*s\.dcm have different frames of reference \(1\.2\.7 and 1\.2\.5\)",
        ),
    ],
)
def test_files_of_no_series(tmp_path, edit, match):
    edit(slices_of(tmp_path))
    assert_refused(tmp_path, match)


def test_a_folder_above_series_lists_them(tmp_path, capfd):
    assert_refused(tmp_path, "no DICOM series")
    (tmp_path / "scan").mkdir()
    for name, count in (("t1", 4), ("flair", 3)):
        for file in slices_of(tmp_path / "scan" / name, RAMP[:count]).iterdir():
            data = pydicom.dcmread(file)
            data.SeriesInstanceUID = f"1.{count}"
            data.save_as(file)
    (tmp_path / "report.txt").write_text("nothing to see")
    words = r"choose one of its subfolders: scan.flair \(3 files\), scan.t1 \(4 files\)$"
    assert_refused(tmp_path, words)
    assert capfd.readouterr().err == ""  # no library's own warning


def test_one_series_in_subfolders_is_read_together(tmp_path):
    slices_of(tmp_path / "x")
    before = sorted((tmp_path / "x").iterdir())
    for k, file in enumerate(before):
        folder = tmp_path / "a" / f"b{k % 3}"
        folder.mkdir(parents=True, exist_ok=True)
        file.rename(folder / f"IM{k // 3}")
    (tmp_path / "x").rmdir()
    assert_placed(tmp_path / "a")
    assert len(image_files(tmp_path / "a")) == len(before)
    first = sha256(tmp_path / "a")
    (tmp_path / "a/b0/IM0").write_bytes(b"")
    assert sha256(tmp_path / "a") != first


def test_a_volume_of_several_is_chosen():
    """By stack and time; or by another dimension, such as the echo, where frames have one
    position.
    """
    both = np.concatenate([RAMP, RAMP[::-1] + 500])
    where = np.concatenate([places(), places()[::-1]])
    path = saved(enhanced(both, where, own=of_times(*[2] * 6, *[1] * 6)), "t.dcm")
    assert_placed(path, volume=1)
    assert_placed(path, RAMP + 500, volume=0)
    own = [group("FrameContent", DimensionIndexValues=[k % 6 + 1, 1 + k // 6]) for k in range(12)]
    data = enhanced(both, where, own=own)
    data.DimensionIndexSequence = [
        tagged(DimensionIndexPointer=tag) for tag in (0x00200032, 0x00189082)
    ]
    assert_placed(saved(data, "e.dcm"), RAMP + 500, volume=1)


def test_each_frame_has_its_own_scale():
    scales = [(1, 0), (0.5, 3), (2, -1024), (1, 0), (1.25, 0), (3, 7)]
    own = [
        group("PixelValueTransformation", RescaleSlope=scales[k][0], RescaleIntercept=scales[k][1])
        for k in ORDER
    ]
    path = saved(enhanced(RAMP[ORDER], places()[ORDER], own=own))
    assert_placed(
        path, np.array([a * plane + b for (a, b), plane in zip(scales, RAMP, strict=True)])
    )


@pytest.mark.parametrize(
    "tags",
    [{"PixelPaddingValue": -2000}, {"PixelPaddingValue": -2000, "PixelPaddingRangeLimit": -1990}],
)
def test_padding_that_a_ct_states(tmp_path, tags):
    pixels = RAMP.copy()
    pixels[:, 0, :3] = -2000
    if len(tags) > 1:
        pixels[2, 0, 0] = -1995
    slices_of(tmp_path, pixels, Modality="CT", RescaleIntercept=-1024, RescaleSlope=1, **tags)
    image, said = read_warned(tmp_path)
    assert "padding" in said[0]
    assert image.range[0] > -1024
    is_padding = pixels.T < -1000
    assert_array_equal(image.data[~is_padding], pixels.T[~is_padding] - 1024.0)
    slices_of(tmp_path, pixels, Modality="MR", RescaleIntercept=0, RescaleSlope=1, **tags)


def test_slices_have_their_own_scales(tmp_path):
    """As PET has; SimpleITK converts all to the first one's type, which may have no fractions."""
    for k, place in enumerate(places()):
        data = one_slice(RAMP[k], place, RescaleSlope=1 + k / 4, RescaleIntercept=-k)
        saved(data, f"{k * 7 % 11}.dcm")
    k = np.arange(6)[:, None, None]
    assert_placed(tmp_path, RAMP * (1 + k / 4) - k)


def test_contradicting_distance_is_told():
    path = saved(enhanced(RAMP, places(), SpacingBetweenSlices=1))
    assert_placed(path, said="3 mm apart by their .*, which are used; SpacingBetweenSlices is 1 mm")


# --------------------------------------------------------------------------------------------------
# Files of many frames without functional groups


def stack(kind, **tags):
    return one_slice(RAMP, ORIGIN, kind, **tags)


def test_dose_is_placed_by_its_offsets():
    dose = "1.2.840.10008.5.1.4.1.1.481.2"
    offsets = STEP * np.arange(6)
    down = (-offsets).tolist()
    affine = affine_of()
    affine[:3, 3] -= 5 * affine[:3, 2]
    data = stack(dose, GridFrameOffsetVector=down, DoseGridScaling="0.25")
    assert_placed(saved(data), 0.25 * RAMP[::-1], affine)
    data = stack(dose, ImageOrientationPatient=AXIAL)
    data.GridFrameOffsetVector = (30.0 + offsets).tolist()
    assert load_image(saved(data)).to_world([0, 0, 5]) == pytest.approx([-10, 20, 45])
    data.GridFrameOffsetVector = (5.0 + offsets).tolist()
    assert_refused(saved(data), "GridFrameOffsetVector that is not of its position")


def test_distance_that_a_file_states_is_used():
    """With its sign, as nuclear medicine has it; and told."""
    nm = stack(
        "1.2.840.10008.5.1.4.1.1.20", SpacingBetweenSlices=-STEP, FrameIncrementPointer=0x00540080
    )
    nm.SliceVector = [1, 2, 3, 4, 5, 6]
    where = {each: nm[each].value for each in ("ImagePositionPatient", "ImageOrientationPatient")}
    nm.DetectorInformationSequence = [tagged(**where)]
    del nm.ImagePositionPatient, nm.ImageOrientationPatient
    affine = affine_of()
    affine[:3, 3] -= 5 * affine[:3, 2]
    said = "-3 mm apart along the slices' normal, as SpacingBetweenSlices states"
    assert_placed(saved(nm), RAMP[::-1], affine, said)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {"SpacingBetweenSlices": 0},
        {"SpacingBetweenSlices": STEP, "FrameIncrementPointer": 0x00181063},  # a time
        {"SpacingBetweenSlices": STEP, "ImagePositionPatient": None},
    ],
)
def test_frames_that_lie_nowhere(tags):
    data = stack("1.2.840.10008.5.1.4.1.1.7.3", **tags)
    assert_refused(saved(data), "does not state where its 6")


# --------------------------------------------------------------------------------------------------
# One slice, and files that are no volumes


@pytest.mark.parametrize(
    ("tags", "mm", "said"),
    [
        ({"SliceThickness": 5}, 5, None),
        ({"SpacingBetweenSlices": 4, "SliceThickness": 5}, 4, None),
        ({}, 1, "no thickness: 1 mm is assumed"),
    ],
)
def test_one_slice_has_the_thickness_that_it_states(tmp_path, tags, mm, said):
    for path in (slices_of(tmp_path, RAMP[:1], **tags) / "s0.dcm", tmp_path):
        assert_placed(path, RAMP[:1], affine_of(mm * NORMAL), said)


def test_a_picture_without_place(tmp_path):
    path = saved(file_of("1.2.840.10008.5.1.4.1.1.7", RAMP[0]))
    affine = np.diag([-1.0, -1.0, 1.0, 1.0])
    for said in ("no size of pixels: 1 mm", "no position"):
        assert_placed(path, RAMP[:1], affine, said)
    saved(file_of("1.2.840.10008.5.1.4.1.1.7", RAMP[1]), "b.dcm")
    assert_refused(tmp_path, r"DICOM file a\.dcm does not state where it lies")


def test_a_localizer_of_another_size_is_named(tmp_path):
    saved(one_slice(np.zeros((9, 8)), ORIGIN), slices_of(tmp_path) / "loc.dcm")
    words = r"the DICOM file loc\.dcm has 8 x 9 pixels, and 6 others of its series have 5 x 4"
    assert "damaged" not in assert_refused(tmp_path, words)


def without_voxels(kind="1.2.840.10008.5.1.4.1.1.481.3", **tags):
    return tagged(SOPClassUID=kind, SOPInstanceUID="1.2.7", SeriesInstanceUID="1.2.77", **tags)


def changed(**tags):
    data = file_of(CT, RAMP[0])
    data.update(tagged(**tags))
    return data


INDEX = without_voxels("1.2.840.10008.1.3.10", DirectoryRecordSequence=[])


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (
            without_voxels(ROIContourSequence=[]),
            "RT Structure Set Storage: contours, no voxels; convert them",
        ),
        (without_voxels("1.2.840.10008.5.1.4.1.1.88.11"), "Basic Text SR Storage, without voxels"),
        (INDEX, "DICOMDIR, a list of files"),
        (without_voxels(CT, Rows=4, Columns=5), "has no pixel data"),
        (changed(SamplesPerPixel=3), "3 numbers per voxel"),
        (changed(PhotometricInterpretation="PALETTE COLOR"), "colours from a palette"),
        (changed(ImageType=["ORIGINAL", "PRIMARY", "M", "MOSAIC"]), "is a mosaic"),
        (
            changed(ImageOrientationPatient=[1, 0, 0]),
            "expected 6 finite numbers for its ImageOrientationPatient",
        ),
        (changed(Rows=400), "declares 1 x 400 x 5 voxels"),
        (changed(NumberOfFrames=10**9), "declares 1000000000 x 4 x 5 voxels"),
        (changed(Rows=0), "declares 1 x 0 x 5 voxels"),
        (changed(PixelSpacing=[0, 1]), "expected pixels larger than 0, got 0 x 1 mm"),
    ],
    ids=lambda value: value[:12] if isinstance(value, str) else "",
)
def test_true_reasons(data, match):
    said = assert_refused(saved(data), match)
    assert ("damaged" in said) == ("declares" in said)


def test_numbers_that_are_none():
    path = saved(changed(ImagePositionPatient=["1.25", "2", "3"]))
    whole = path.read_bytes()
    assert whole.count(b"1.25\\2\\3") == 1
    path.write_bytes(whole.replace(b"1.25\\2\\3", b"x.25\\2\\3"))
    assert_refused(path, "expected 3 finite numbers for its ImagePositionPatient")


def test_objects_beside_a_series_are_skipped(tmp_path):
    saved(without_voxels(ROIContourSequence=[]), slices_of(tmp_path) / "rs.dcm")
    for name in ("DICOMDIR", "notes.txt"):
        (tmp_path / name).write_bytes(b"anything")
    assert_placed(tmp_path, said=r"skipped rs\.dcm, which is of the kind RT Structure Set Storage")


def test_a_file_without_first_part(tmp_path):
    """As older programs wrote them: no mark, and no transfer syntax."""
    for path in list(slices_of(tmp_path).iterdir()):
        data = pydicom.dcmread(path)
        data.file_meta, data.preamble = FileMetaDataset(), None
        pydicom.dcmwrite(path, FileDataset(path, data), implicit_vr=True, little_endian=True)
        path.rename(path.with_suffix(""))
    assert_placed(tmp_path)


def test_a_file_without_suffix():
    assert_placed(saved(enhanced(RAMP, places()), "IM000001"))
    assert_refused(saved(INDEX, "DICOMDIR"), "give the folder with one series")


@pytest.mark.parametrize(
    ("values", "high", "said"),
    [
        # signed numbers of 12 bits, below others' bits
        ((np.array([[[-5, 7, -2048]]]) & 0xFFF) | 0x5000, 11, None),
        # above 4 others, as HighBit states
        (
            np.array([[[-5, 7, -2048]]]) * 16 + 3,
            15,
            "HighBit is 15: the lowest 4 bits of its values are left out",
        ),
    ],
)
def test_bits_beyond_those_stored_are_ignored(values, high, said):
    data = one_slice(values[0], ORIGIN, SliceThickness=STEP)
    data.BitsStored, data.HighBit = 12, high
    assert_placed(saved(data), np.array([[[-5, 7, -2048]]]), said=said)
    data.HighBit = 9
    assert_refused(saved(data), "BitsStored 12 and HighBit 9, which contradict each other")


def test_compressed_voxels():
    data = enhanced(RAMP[ORDER], places()[ORDER])
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = EXPLICIT
    data.compress("1.2.840.10008.1.2.5", encoding_plugin="pydicom")  # RLE
    path = saved(data, syntax="1.2.840.10008.1.2.5")
    assert_placed(path)
    whole = path.read_bytes()
    saved(data, syntax="1.2.840.10008.1.2.4.100")
    said = assert_refused(path, "compressed as MPEG2 .*cannot be decoded here; .*gdcmconv")
    assert "damaged" not in said
    path.write_bytes(whole[:-40])
    assert_refused(path, "truncated or damaged")


def test_more_voxels_than_the_header_declares():
    data = one_slice(RAMP[0], ORIGIN, SliceThickness=STEP)
    data.PixelData = RAMP.tobytes()
    path = saved(data)
    assert_placed(path, RAMP[:1], said="more bytes of voxels than its header declares")


# --------------------------------------------------------------------------------------------------
# Segmentations


@pytest.fixture(scope="module")
def hd():
    return pytest.importorskip("highdicom")


def blobs(shape=(9, 8, 7)):
    """Voxels (slices, rows, columns, segments) of three segments: the second overlaps the first,
    the third is apart.
    """
    k, j, i = np.indices(shape)
    first, second = (k >= 1) & (k <= 3) & (j < 6), (k == 3) & (j >= 4) & (i < 5)
    return np.stack([first, second, (k == 7) & (i > 2)], axis=-1)


COLOURS = [(128, 174, 128), (255, 0, 0), (20, 60, 200)]
ABOUT = {
    "PatientName": "A^B",
    "PatientID": "1",
    "StudyInstanceUID": "1.2.4",
    "FrameOfReferenceUID": "1.2.5",
    "Modality": "CT",
    "SliceThickness": STEP,
} | dict.fromkeys(
    (
        "PatientBirthDate",
        "PatientSex",
        "StudyID",
        "StudyDate",
        "StudyTime",
        "AccessionNumber",
        "ReferringPhysicianName",
    ),
    "",
)


def segmentation(hd, voxels, kind="BINARY", path="a.dcm"):
    """A segmentation of an oblique CT of single slices, 3 mm apart, without its empty frames."""
    source = []
    for k, place in enumerate(places(len(voxels))):
        plane = np.zeros(voxels.shape[1:3])
        source.append(one_slice(plane, place, InstanceNumber=k + 1, **ABOUT))
        source[-1].file_meta = FileMetaDataset()
        source[-1].file_meta.TransferSyntaxUID = EXPLICIT
    tissue = hd.sr.CodedConcept("85756007", "SCT", "Tissue")
    segments = [
        hd.seg.SegmentDescription(
            number, label, tissue, tissue, "MANUAL", display_color=hd.color.CIELabColor.from_rgb(*c)
        )
        for number, (label, c) in enumerate(
            zip(("liver", "tumour", "tumour"), COLOURS, strict=True), 1
        )
    ]
    hd.seg.Segmentation(
        source, voxels, kind, segments, "1.2.6", 1, "1.2.8", 1, "m", "m", "1", "1"
    ).save_as(path)
    return Path(path).absolute()


def assert_segments(path, labels, said=None):
    """Labels (slices, rows, columns) lie where they were; slices from the first to the last
    frame, of 1 to 7.
    """
    affine = affine_of()
    affine[:3, 3] += affine[:3, 2]
    assert_placed(path, labels[1:8], affine, said)


NUMBERS = np.array([1, 2, 3])
LABELS = (blobs() * NUMBERS).max(axis=-1)


@pytest.mark.apart
def test_segments_by_number(hd):
    """Empty slices between frames stay empty; of overlapping segments, the larger number is
    kept, and told.
    """
    path = segmentation(hd, blobs())
    assert len(pydicom.dcmread(path).PerFrameFunctionalGroupsSequence) == 5
    said = r"larger number is kept: 1 \(liver\) and 2 \(tumour\) in 10 voxels$"
    assert_segments(path, LABELS, said)


@pytest.mark.parametrize("shape", [(5, 7), (3, 9), (6, 6), (181, 217)])
def test_bits_of_frames_follow_each_other(hd, shape):
    """Frames that begin and end within a byte, in another order than they lie."""
    voxels = np.random.default_rng(0).integers(0, 2, (6, *shape, 3))
    path = segmentation(hd, voxels.astype(bool))
    assert_placed(path, (voxels * NUMBERS).max(axis=-1), said="segments overlap")
    data = pydicom.dcmread(path)
    data.PixelData = data.PixelData[: -(-18 * shape[0] * shape[1] // 8) - 2]
    assert_refused(saved(data), "truncated or damaged")


def test_label_map_of_segments(hd):
    """Padding is background; values without a segment are told."""
    path = segmentation(hd, LABELS.astype(np.uint8), "LABELMAP")
    assert_segments(path, LABELS)
    data = pydicom.dcmread(path)
    data.PixelData = data.PixelData.replace(b"\0", b"\xff")
    data.PixelPaddingValue = 255
    assert_segments(saved(data), LABELS)
    del data.PixelPaddingValue
    said = r"voxels have values of no segment \(\[255\]\) and get label 0"
    assert_segments(saved(data), LABELS, said)


def test_fractions_of_segments(hd):
    """A voxel belongs to the largest fraction of a half or more."""
    voxels = blobs()
    fractions = voxels * [0.8, 0.6, 0.49] + voxels[..., ::-1] * 0.01
    path = segmentation(hd, fractions, "FRACTIONAL")
    said = r"larger fraction, or number is kept: 1 \(liver\) and 2 .* in 10 voxels"
    assert_segments(path, np.where(voxels[..., 0], 1, 2 * voxels[..., 1]), said)


@pytest.mark.parametrize(
    ("name", "counts", "slices"), [("overlap", [48, 16], 165), ("single_frame", [1832], 1)]
)
def test_public_segmentations(data_dir, hd, name, counts, slices):
    """Of highdicom's tests: 64 and 16 voxels, 16 of them in both; the first frame is 162 slices
    from the second.
    """
    path = data_dir / f"seg_image_ct_binary_{name}.dcm"
    image = load_image(path)
    there = hd.seg.segread(path).get_volume(combine_segments=False, allow_missing_positions=True)
    assert image.shape[2] == there.spatial_shape[0] == slices
    assert_array_equal(np.bincount(image.data.astype(int).ravel())[1:], counts)
    is_in = there.array.any(axis=-1)
    world = there.map_indices_to_reference(np.argwhere(is_in)).mean(axis=0) * [-1, -1, 1]
    found = image.to_world(np.argwhere(image.data > 0)).mean(axis=0)
    assert_allclose(found, world, rtol=0, atol=1e-4)


def edited(hd, edit):
    data = pydicom.dcmread(segmentation(hd, blobs()))
    edit(
        data,
        [group.PlanePositionSequence[0] for group in data.PerFrameFunctionalGroupsSequence],
        data.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0],
    )
    return saved(data)


def uneven(data, where, measures):
    where[-1].ImagePositionPatient = (places(9)[7] + 1.4 * NORMAL).round(9).tolist()


def twice(data, where, measures):
    where[1].ImagePositionPatient = where[0].ImagePositionPatient


def nameless(data, where, measures):
    data.SegmentSequence = data.SegmentSequence[:2]


def doubled(data, where, measures):
    data.SegmentSequence[2].SegmentNumber = 1


@pytest.mark.parametrize(
    ("edit", "match"),
    [
        (uneven, "not at multiples of one distance"),
        (twice, "frame 1 of the file .*one segment and position"),
        (nameless, "frame 5 of the file states no segment"),
        (doubled, 'two segments 1, "liver" and "tumour"'),
    ],
)
def test_segments_that_are_no_volume(hd, edit, match):
    path = edited(hd, edit)
    assert_refused(path, match)
    if edit is doubled:
        assert_refused(path, "two segments 1", load_label_table)


def half(data, where, measures):
    measures.SpacingBetweenSlices = STEP / 2


def thin(data, where, measures):
    del measures.SpacingBetweenSlices
    measures.SliceThickness = STEP / 2


def far(data, where, measures):
    # by ten times 4 slices
    where[-1].ImagePositionPatient = (places(48)[47]).round(9).tolist()


@pytest.mark.parametrize(
    ("edit", "slices", "said"),
    [
        (half, 13, "1.5 mm apart as it states, but its frames 3 mm"),
        (thin, 7, "3 mm apart by their positions, which are used; SliceThickness is 1.5 mm"),
        (far, 47, "frames lie in 4 slices, far apart: 43 slices between them are empty"),
    ],
)
def test_distances_of_segments_that_are_told(hd, edit, slices, said):
    image, heard = read_warned(edited(hd, edit))
    assert image.shape == (7, 8, slices)
    assert said in "\n".join(heard)


def test_names_and_colours_of_segments(tmp_path, hd):
    """As `--label-names` reads them; from the folder, too. Names that two segments share get
    numbers.
    """
    path = segmentation(hd, blobs())
    for source in (path, tmp_path):
        table = load_label_table(source)
        assert table.names == {1: "liver", 2: "tumour 2", 3: "tumour 3"}
        assert_allclose(list(table.colours.values()), np.array(COLOURS) / 255, rtol=0, atol=0.004)
    path = saved(enhanced(RAMP, places()), "b.dcm")
    assert_refused(path, "expected names of segments in this file, found none", load_label_table)


@pytest.mark.full
def test_mesh_of_a_scan_and_its_segmentation(here, hd, capsys):
    """Frames in another order, and a segmentation with fewer slices: labels lie where they were,
    with their names.
    """
    k, j, i = np.indices((16, 30, 20))
    steps = [AXES[0] * BETWEEN_COLUMNS, AXES[1] * BETWEEN_ROWS, NORMAL * STEP]
    world = ORIGIN + np.stack([i, j, k], axis=-1) @ np.array(steps)
    centre = ORIGIN + 7 * AXES[0] + 7 * AXES[1] + 22 * NORMAL
    far = np.linalg.norm(world - centre, axis=-1)
    voxels = np.stack([far < 6, (k == 3) & (i < 4) & (j < 9), (k == 13) & (i > 15)], axis=-1)
    order = np.random.default_rng(0).permutation(16)
    data = enhanced(1000 * (far < 6)[order], places(16)[order])
    data.FrameOfReferenceUID = "1.2.5"
    scan = saved(data, "ct.dcm")
    labels = segmentation(hd, voxels, path="seg.dcm")
    words = ["--labels", labels, "-o", here / "a.vtu", "--nodes"]
    assert_done("mesh", scan, *words, 900)
    loaded = tetopt.load_mesh("a.vtu")
    assert loaded.label_table.names == {1: "liver", 2: "tumour 2", 3: "tumour 3"}
    assert "frame of reference" not in capsys.readouterr().err
    points = loaded.mesh.points[loaded.mesh.cells]
    volume = np.abs(np.linalg.det(points[:, 1:] - points[:, :1])) / 6
    is_in = loaded.cell_data["label"] == 1
    expected = np.count_nonzero(voxels[..., 0]) * BETWEEN_COLUMNS * BETWEEN_ROWS * STEP
    assert volume[is_in].sum() == pytest.approx(expected, rel=0.03)
    at = np.average(points[is_in].mean(axis=1), axis=0, weights=volume[is_in])
    assert_allclose(at, centre * [-1, -1, 1], rtol=0, atol=0.2)
    data.FrameOfReferenceUID = "1.2.99"
    other = saved(data, "other.dcm")
    assert exit_code("mesh", other, *words, 50, "--iterations 0 --force") in (0, 1)
    said = capsys.readouterr().err.replace("\n  ", " ")
    assert "seg.dcm: its positions are in another frame of reference" in said
