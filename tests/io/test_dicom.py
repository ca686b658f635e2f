"""DICOM to images: frames lie where they say, whatever their order, file or kind; or are refused
for the true reason.

Files are made by pydicom, segmentations by highdicom, which is also the oracle for them.
"""

import warnings

import numpy as np
import pytest
from commands import exit_code
from numpy.testing import assert_allclose, assert_array_equal

import tetopt
from tetopt.errors import InputError
from tetopt.io.images import load_image
from tetopt.io.label_tables import load_label_table

pydicom = pytest.importorskip("pydicom")
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset  # noqa: E402

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


def saved(path, data, syntax=EXPLICIT):
    data.file_meta = FileMetaDataset()
    data.file_meta.MediaStorageSOPClassUID = data.SOPClassUID
    data.file_meta.MediaStorageSOPInstanceUID = data.get("SOPInstanceUID") or "1.2.9"
    data.file_meta.TransferSyntaxUID = syntax
    pydicom.dcmwrite(path, data, enforce_file_format=True)
    return path


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


def one_slice(pixels, place, **tags):
    where = {
        "ImagePositionPatient": place.round(9).tolist(),
        "ImageOrientationPatient": AXES.ravel().tolist(),
    }
    return file_of(CT, pixels, PixelSpacing=[BETWEEN_ROWS, BETWEEN_COLUMNS], **where, **tags)


def slices_of(folder, pixels=RAMP, where=None, **tags):
    """A series of single slices, named in another order than they lie."""
    folder.mkdir(exist_ok=True)
    for k, place in enumerate(places(len(pixels)) if where is None else where):
        saved(folder / f"s{(k * 7) % 11}.dcm", one_slice(pixels[k], place, **tags))
    return folder


def affine_of(step=STEP * NORMAL):
    affine = np.eye(4)
    affine[:3] = np.column_stack([AXES[0] * BETWEEN_COLUMNS, AXES[1] * BETWEEN_ROWS, step, ORIGIN])
    return np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine


def assert_placed(image, pixels=RAMP, affine=None):
    assert_array_equal(image.data, pixels.T)
    assert_allclose(image.affine, affine_of() if affine is None else affine, rtol=0, atol=1e-7)


def assert_refused(path, match, **options):
    with pytest.raises(InputError, match=match) as caught:
        load_image(path, **options)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    assert "\n" not in said
    return said


ORDER = np.array([3, 0, 5, 1, 4, 2])


@pytest.mark.apart
def test_frames_in_any_order(tmp_path):
    """The reader sorts them; rows and columns have spacings of their own, and the world is
    oblique.
    """
    assert_placed(load_image(saved(tmp_path / "a.dcm", enhanced(RAMP[ORDER], places()[ORDER]))))


def test_frames_of_a_tilted_gantry_keep_their_shear(tmp_path):
    step = STEP * NORMAL + 0.8 * AXES[1]
    path = saved(tmp_path / "a.dcm", enhanced(RAMP[ORDER], places(step=step)[ORDER]))
    assert_placed(load_image(path), affine=affine_of(step))


def test_several_files_of_one_series_are_one_volume(tmp_path):
    """Files of many frames and of one, whose frames interleave (a concatenation)."""
    saved(tmp_path / "b.dcm", enhanced(RAMP[[4, 0, 2]], places()[[4, 0, 2]]))
    saved(tmp_path / "a.dcm", enhanced(RAMP[[1, 5]], places()[[1, 5]]))
    saved(tmp_path / "c.dcm", enhanced(RAMP[3:4], places()[3:4]))
    assert_placed(load_image(tmp_path))
    assert_refused(tmp_path / "a.dcm", "volume from 0 to 0", volume=1)
    saved(tmp_path / "again.dcm", enhanced(RAMP[3:4], places()[3:4]))
    assert_refused(
        tmp_path,
        "7 slices of this DICOM series have 6 positions: .* several volumes .* separate folder",
    )


def test_several_volumes_in_files_of_their_own(tmp_path):
    for name in "ab":
        saved(tmp_path / f"{name}.dcm", enhanced(RAMP, places()))
    assert_refused(
        tmp_path, "12 slices of this DICOM series have 6 positions: .* give one of its files"
    )


def turned(k):
    own = [{}] * 6
    own[k] = group("PlaneOrientation", ImageOrientationPatient=AXIAL)
    return own


SQUARE = group("PixelMeasures", PixelSpacing=[1, 1])


def of_times(*times):
    return [group("FrameContent", TemporalPositionIndex=time) for time in times]


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (
            lambda: enhanced(RAMP, places(7)[[0, 1, 2, 3, 6, 5]]),
            "a step of 6 mm between slices 3 and 4",
        ),
        (
            lambda: enhanced(RAMP, places()[[0, 1, 2, 3, 4, 4]]),
            "6 slices of .* have 5 positions: .*; convert it",
        ),
        (lambda: enhanced(RAMP, places(step=AXES[0])), "beside each other"),
        (lambda: enhanced(RAMP, places(), own=turned(2)), "not parallel .*frame 3 of the file"),
        (lambda: enhanced(RAMP, places(), own=[*[{}] * 5, SQUARE]), "frame 6 .*different sizes"),
        (lambda: enhanced(RAMP, places()[:5]), "6 frames, but states where 5 lie"),
        (lambda: enhanced(RAMP, places(), axes=np.ones((2, 3))), "orthogonal"),
        (lambda: enhanced(RAMP, places(), own=of_times(1, 2, 1, 2, 1, 2)), "2 volumes"),
    ],
    ids=["missing", "double", "beside", "turned", "pixels", "fewer", "axes", "times"],
)
def test_frames_that_are_no_volume(tmp_path, data, match):
    """The faults that a series of slices is refused for."""
    assert_refused(saved(tmp_path / "a.dcm", data()), match)


def test_a_volume_of_several_is_chosen(tmp_path):
    """By stack and time; or by another dimension, such as the echo, where frames have one
    position.
    """
    both = np.concatenate([RAMP, RAMP[::-1] + 500])
    where = np.concatenate([places(), places()[::-1]])
    path = saved(tmp_path / "t.dcm", enhanced(both, where, own=of_times(*[2] * 6, *[1] * 6)))
    assert_placed(load_image(path, volume=1))
    assert_placed(load_image(path, volume=0), RAMP + 500)
    own = [group("FrameContent", DimensionIndexValues=[k % 6 + 1, 1 + k // 6]) for k in range(12)]
    data = enhanced(both, where, own=own)
    data.DimensionIndexSequence = [
        tagged(DimensionIndexPointer=tag) for tag in (0x00200032, 0x00189082)
    ]
    assert_placed(load_image(saved(tmp_path / "e.dcm", data), volume=1), RAMP + 500)


def test_each_frame_has_its_own_scale(tmp_path):
    scales = [(1, 0), (0.5, 3), (2, -1024), (1, 0), (1.25, 0), (3, 7)]
    own = [group("PixelValueTransformation", RescaleSlope=a, RescaleIntercept=b) for a, b in scales]
    path = saved(
        tmp_path / "a.dcm", enhanced(RAMP[ORDER], places()[ORDER], own=[own[k] for k in ORDER])
    )
    assert_placed(
        load_image(path),
        np.array([a * plane + b for (a, b), plane in zip(scales, RAMP, strict=True)]),
    )


def test_slices_have_their_own_scales(tmp_path):
    """As PET has; SimpleITK converts all to the first one's type, which may have no fractions."""
    for k in range(6):
        slices_of(
            tmp_path / "d",
            RAMP[k:][:1],
            places()[k:][:1],
            RescaleSlope=1 + k / 4,
            RescaleIntercept=-k,
        )
        (tmp_path / "d" / "s0.dcm").rename(tmp_path / "d" / f"k{k}.dcm")
    k = np.arange(6)[:, None, None]
    assert_placed(load_image(tmp_path / "d"), RAMP * (1 + k / 4) - k)


def test_contradicting_distance_is_told(tmp_path):
    path = saved(tmp_path / "a.dcm", enhanced(RAMP, places(), SpacingBetweenSlices=1))
    with pytest.warns(
        UserWarning,
        match="3 mm apart by their positions, which are used; SpacingBetweenSlices is 1 mm",
    ):
        assert_placed(load_image(path))


# --------------------------------------------------------------------------------------------------
# Files of many frames without functional groups


def stack(kind, **tags):
    where = {
        "ImagePositionPatient": ORIGIN.tolist(),
        "ImageOrientationPatient": AXES.ravel().tolist(),
    }
    return file_of(kind, RAMP, PixelSpacing=[BETWEEN_ROWS, BETWEEN_COLUMNS], **where | tags)


def test_dose_is_placed_by_its_offsets(tmp_path):
    dose = "1.2.840.10008.5.1.4.1.1.481.2"
    offsets = (STEP * np.arange(6)).tolist()
    data = stack(dose, GridFrameOffsetVector=offsets[::-1], DoseGridScaling="0.25")
    data.GridFrameOffsetVector = [0.0] + [-each for each in offsets[1:]]  # downwards
    image = load_image(saved(tmp_path / "a.dcm", data))
    affine = affine_of()
    affine[:3, 3] -= 5 * affine[:3, 2]
    assert_placed(image, 0.25 * RAMP[::-1], affine)
    data = stack(
        dose, ImageOrientationPatient=AXIAL, GridFrameOffsetVector=[30.0 + each for each in offsets]
    )
    assert load_image(saved(tmp_path / "b.dcm", data)).to_world([0, 0, 5]) == pytest.approx(
        [-10, 20, 45]
    )
    data.GridFrameOffsetVector = [each + 5.0 for each in offsets]
    assert_refused(
        saved(tmp_path / "c.dcm", data), "GridFrameOffsetVector that is not of its position"
    )


def test_distance_that_a_file_states_is_used(tmp_path):
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
    with pytest.warns(
        UserWarning, match="-3 mm apart along the slices' normal, as SpacingBetweenSlices states"
    ):
        assert_placed(load_image(saved(tmp_path / "a.dcm", nm)), RAMP[::-1], affine)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {"SpacingBetweenSlices": 0},
        {"SpacingBetweenSlices": STEP, "FrameIncrementPointer": 0x00181063},  # a time
        {"SpacingBetweenSlices": STEP, "ImagePositionPatient": None},
    ],
)
def test_frames_that_lie_nowhere(tmp_path, tags):
    assert_refused(
        saved(tmp_path / "a.dcm", stack("1.2.840.10008.5.1.4.1.1.7.3", **tags)),
        "does not state where its 6",
    )


# --------------------------------------------------------------------------------------------------
# One slice, and files that are no volumes


def test_one_slice_has_the_thickness_that_it_states(tmp_path):
    for tags, expected in (
        ({"SliceThickness": 5}, 5),
        ({"SpacingBetweenSlices": 4, "SliceThickness": 5}, 4),
    ):
        path = slices_of(tmp_path / "d", RAMP[:1], **tags) / "s0.dcm"
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert_placed(load_image(path), RAMP[:1], affine_of(expected * NORMAL))
    path = slices_of(tmp_path / "d", RAMP[:1]) / "s0.dcm"
    with pytest.warns(UserWarning, match="no thickness: 1 mm is assumed"):
        assert_placed(load_image(path), RAMP[:1], affine_of(NORMAL))


def test_a_picture_without_place(tmp_path):
    path = saved(tmp_path / "a.dcm", file_of("1.2.840.10008.5.1.4.1.1.7", RAMP[0]))
    with pytest.warns(UserWarning, match="no size of pixels: 1 mm") as caught:
        assert_array_equal(load_image(path).affine, np.diag([-1.0, -1.0, 1.0, 1.0]))
    assert any("no position" in str(each.message) for each in caught)
    saved(tmp_path / "b.dcm", file_of("1.2.840.10008.5.1.4.1.1.7", RAMP[1]))
    assert_refused(tmp_path, r"DICOM file a\.dcm does not state where it lies")


def test_a_localizer_of_another_size_is_named(tmp_path):
    folder = slices_of(tmp_path / "d")
    saved(
        folder / "loc.dcm",
        file_of(
            CT, np.zeros((9, 8)), ImagePositionPatient=[0, 0, 0], ImageOrientationPatient=AXIAL
        ),
    )
    said = assert_refused(
        folder, r"the DICOM file loc\.dcm has 8 x 9 pixels, and 6 others of its series have 5 x 4"
    )
    assert "damaged" not in said


def without_voxels(kind="1.2.840.10008.5.1.4.1.1.481.3", **tags):
    return tagged(SOPClassUID=kind, SOPInstanceUID="1.2.7", SeriesInstanceUID="1.2.77", **tags)


def changed(**tags):
    data = file_of(CT, RAMP[0])
    for name, value in tags.items():
        setattr(data, name, value)
    return data


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (
            without_voxels(ROIContourSequence=[]),
            "RT Structure Set Storage: contours, no voxels; convert them",
        ),
        (without_voxels("1.2.840.10008.5.1.4.1.1.88.11"), "Basic Text SR Storage, without voxels"),
        (
            without_voxels("1.2.840.10008.1.3.10", DirectoryRecordSequence=[]),
            "DICOMDIR, a list of files",
        ),
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
def test_true_reasons(tmp_path, data, match):
    said = assert_refused(saved(tmp_path / "a.dcm", data), match)
    assert ("damaged" in said) == ("declares" in said)


def test_numbers_that_are_none(tmp_path):
    path = saved(tmp_path / "a.dcm", changed(ImagePositionPatient=["1.25", "2", "3"]))
    whole = path.read_bytes()
    assert whole.count(b"1.25\\2\\3") == 1
    path.write_bytes(whole.replace(b"1.25\\2\\3", b"x.25\\2\\3"))
    assert_refused(path, "expected 3 finite numbers for its ImagePositionPatient")


def test_objects_beside_a_series_are_skipped(tmp_path):
    folder = slices_of(tmp_path / "d")
    saved(folder / "rs.dcm", without_voxels(ROIContourSequence=[]))
    (folder / "DICOMDIR").write_bytes(b"anything")
    (folder / "notes.txt").write_text("anything")
    with pytest.warns(
        UserWarning, match=r"skipped rs\.dcm, which is of the kind RT Structure Set Storage"
    ):
        assert_placed(load_image(folder))


def test_a_file_without_first_part(tmp_path):
    """As older programs wrote them: no mark, and no transfer syntax."""
    folder = slices_of(tmp_path / "d")
    for path in folder.iterdir():
        data = pydicom.dcmread(path)
        data.file_meta, data.preamble = FileMetaDataset(), None
        pydicom.dcmwrite(path, FileDataset(path, data), implicit_vr=True, little_endian=True)
        path.rename(path.with_suffix(""))
    assert_placed(load_image(folder))


def test_a_file_without_suffix(tmp_path):
    assert_placed(load_image(saved(tmp_path / "IM000001", enhanced(RAMP, places()))))
    index = without_voxels("1.2.840.10008.1.3.10", DirectoryRecordSequence=[])
    assert_refused(saved(tmp_path / "DICOMDIR", index), "give the folder with one series")


def test_bits_beyond_those_stored_are_ignored(tmp_path):
    """Signed numbers of 12 bits, below others' bits."""
    data = one_slice((np.array([[-5, 7, -2048]]) & 0xFFF) | 0x5000, ORIGIN, SliceThickness=3)
    data.BitsStored, data.HighBit = 12, 11
    assert_array_equal(load_image(saved(tmp_path / "a.dcm", data)).data[:, 0, 0], [-5, 7, -2048])


def test_values_in_the_upper_bits(tmp_path):
    """As HighBit states: 12 bits above 4 others, with a sign."""
    data = one_slice(np.array([[-5, 7, -2048]]) * 16 + 3, ORIGIN, SliceThickness=3)
    data.BitsStored = 12
    with pytest.warns(
        UserWarning, match="HighBit is 15: the lowest 4 bits of its values are left out"
    ):
        image = load_image(saved(tmp_path / "a.dcm", data))
    assert_array_equal(image.data[:, 0, 0], [-5, 7, -2048])
    data.HighBit = 9
    assert_refused(
        saved(tmp_path / "a.dcm", data), "BitsStored 12 and HighBit 9, which contradict each other"
    )


def test_slices_of_two_frames_of_reference(tmp_path):
    folder = slices_of(tmp_path / "d", RAMP[:3], FrameOfReferenceUID="1.2.5")
    assert load_image(folder).shape == (5, 4, 3)
    for k in (1, 2):
        saved(
            folder / f"t{k}.dcm", one_slice(RAMP[k], places()[2 + k], FrameOfReferenceUID="1.2.7")
        )
    assert_refused(
        folder, r"t1\.dcm and .*s0\.dcm have different frames of reference \(1\.2\.7 and 1\.2\.5\)"
    )


def test_compressed_voxels(tmp_path):
    data = enhanced(RAMP[ORDER], places()[ORDER])
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = EXPLICIT
    data.compress("1.2.840.10008.1.2.5", encoding_plugin="pydicom")  # RLE
    path = saved(tmp_path / "a.dcm", data, "1.2.840.10008.1.2.5")
    assert_placed(load_image(path))
    whole = path.read_bytes()
    path = saved(tmp_path / "b.dcm", data, "1.2.840.10008.1.2.4.100")
    assert "damaged" not in assert_refused(
        path, "compressed as MPEG2 .*cannot be decoded here; .*gdcmconv"
    )
    path.write_bytes(whole[:-40])
    assert_refused(path, "truncated or damaged")


def test_more_voxels_than_the_header_declares(tmp_path):
    data = one_slice(RAMP[0], ORIGIN, SliceThickness=3)
    data.PixelData = RAMP.tobytes()
    with pytest.warns(UserWarning, match="more bytes of voxels than its header declares"):
        assert_array_equal(load_image(saved(tmp_path / "a.dcm", data)).data[:, :, 0], RAMP[0].T)


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


def segmentation(hd, path, voxels, kind="BINARY", **options):
    """A segmentation of an oblique CT of single slices, 3 mm apart, without its empty frames."""
    about = {
        "PatientName": "A^B",
        "StudyInstanceUID": "1.2.4",
        "FrameOfReferenceUID": "1.2.5",
        "Modality": "CT",
    }
    about |= dict.fromkeys(
        ("PatientBirthDate", "PatientSex", "StudyID", "StudyDate", "StudyTime"), ""
    )
    about |= {"AccessionNumber": "", "ReferringPhysicianName": "", "SliceThickness": STEP}
    source = []
    for k, place in enumerate(places(len(voxels))):
        source.append(
            one_slice(
                np.zeros(voxels.shape[1:3]), place, InstanceNumber=k + 1, PatientID="1", **about
            )
        )
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
        source, voxels, kind, segments, "1.2.6", 1, "1.2.8", 1, "m", "m", "1", "1", **options
    ).save_as(path)
    return path


def assert_segments(image, labels):
    """Labels (slices, rows, columns) lie where they were; slices from the first to the last
    frame, of 1 to 7.
    """
    affine = affine_of()
    affine[:3, 3] += affine[:3, 2]
    assert_placed(image, labels[1:8], affine)


NUMBERS = np.array([1, 2, 3])


@pytest.mark.apart
def test_segments_by_number(tmp_path, hd):
    """Empty slices between frames stay empty; of overlapping segments, the larger number is
    kept, and told.
    """
    voxels = blobs()
    path = segmentation(hd, tmp_path / "a.dcm", voxels)
    assert len(pydicom.dcmread(path).PerFrameFunctionalGroupsSequence) == 5
    with pytest.warns(
        UserWarning, match=r"larger number is kept: 1 \(liver\) and 2 \(tumour\) in 10 voxels$"
    ):
        assert_segments(load_image(path), (voxels * NUMBERS).max(axis=-1))


@pytest.mark.parametrize("shape", [(5, 7), (3, 9), (6, 6), (181, 217)])
def test_bits_of_frames_follow_each_other(tmp_path, hd, shape):
    """Frames that begin and end within a byte, in another order than they lie."""
    voxels = np.random.default_rng(0).integers(0, 2, (6, *shape, 3))
    path = segmentation(hd, tmp_path / "a.dcm", voxels.astype(bool))
    with pytest.warns(UserWarning, match="segments overlap"):
        assert_placed(load_image(path), (voxels * NUMBERS).max(axis=-1))
    data = pydicom.dcmread(path)
    data.PixelData = data.PixelData[: -(-18 * shape[0] * shape[1] // 8) - 2]
    assert_refused(saved(path, data), "truncated or damaged")


def test_label_map_of_segments(tmp_path, hd):
    """Padding is background; values without a segment are told."""
    labels = (blobs() * NUMBERS).max(axis=-1)
    path = segmentation(hd, tmp_path / "a.dcm", labels.astype(np.uint8), "LABELMAP")
    assert_segments(load_image(path), labels)
    data = pydicom.dcmread(path)
    data.PixelData = data.PixelData.replace(b"\0", b"\xff")
    data.PixelPaddingValue = 255
    assert_segments(load_image(saved(path, data)), labels)
    del data.PixelPaddingValue
    with pytest.warns(
        UserWarning, match=r"voxels have values of no segment \(\[255\]\) and get label 0"
    ):
        assert_segments(load_image(saved(path, data)), labels)


def test_fractions_of_segments(tmp_path, hd):
    """A voxel belongs to the largest fraction of a half or more."""
    voxels = blobs()
    path = segmentation(
        hd, tmp_path / "a.dcm", voxels * [0.8, 0.6, 0.49] + voxels[..., ::-1] * 0.01, "FRACTIONAL"
    )
    with pytest.warns(
        UserWarning, match=r"larger fraction, or number is kept: 1 \(liver\) and 2 .* in 10 voxels"
    ):
        image = load_image(path)
    labels = np.where(voxels[..., 0], 1, 2 * voxels[..., 1])
    assert_segments(image, labels)


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
    assert_allclose(
        image.to_world(np.argwhere(image.data > 0)).mean(axis=0), world, rtol=0, atol=1e-4
    )


def edited(hd, path, edit):
    data = pydicom.dcmread(segmentation(hd, path, blobs()))
    edit(data, [group.PlanePositionSequence[0] for group in data.PerFrameFunctionalGroupsSequence])
    return saved(path, data)


def test_segments_that_are_no_volume(tmp_path, hd):
    def uneven(data, where):
        where[-1].ImagePositionPatient = (places(9)[7] + 1.4 * NORMAL).round(9).tolist()

    def twice(data, where):
        where[1].ImagePositionPatient = where[0].ImagePositionPatient

    def nameless(data, where):
        data.SegmentSequence = data.SegmentSequence[:2]

    def doubled(data, where):
        data.SegmentSequence[2].SegmentNumber = 1

    for edit, match in (
        (uneven, "not at multiples of one distance"),
        (twice, "frame 1 of the file .*one segment and position"),
        (nameless, "frame 5 of the file states no segment"),
        (doubled, 'two segments 1, "liver" and "tumour"'),
    ):
        assert_refused(edited(hd, tmp_path / "a.dcm", edit), match)
    with pytest.raises(InputError, match="two segments 1"):
        load_label_table(tmp_path / "a.dcm")


def test_distance_of_segments_that_is_not_that_of_their_frames(tmp_path, hd):
    def half(data, where):
        data.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SpacingBetweenSlices = (
            STEP / 2
        )

    with pytest.warns(UserWarning, match="1.5 mm apart as it states, but its frames 3 mm"):
        assert load_image(edited(hd, tmp_path / "a.dcm", half)).shape == (7, 8, 13)

    def thin(data, where):
        del data.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SpacingBetweenSlices
        data.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SliceThickness = STEP / 2

    with pytest.warns(
        UserWarning, match="3 mm apart by their positions, which are used; SliceThickness is 1.5 mm"
    ):
        assert load_image(edited(hd, tmp_path / "a.dcm", thin)).shape == (7, 8, 7)


def test_frames_of_segments_that_lie_far_apart(tmp_path, hd):
    def far(data, where):
        frame = data.PerFrameFunctionalGroupsSequence[-1].PlanePositionSequence[0]
        others = data.PerFrameFunctionalGroupsSequence[0].PlanePositionSequence[0]
        # of 4 slices
        step = np.array(frame.ImagePositionPatient) - np.array(others.ImagePositionPatient)
        frame.ImagePositionPatient = [*map(float, np.array(frame.ImagePositionPatient) + 10 * step)]

    with pytest.warns(
        UserWarning, match="frames lie in 4 slices, far apart: 43 slices between them are empty"
    ):
        assert load_image(edited(hd, tmp_path / "a.dcm", far)).shape == (7, 8, 47)


def test_names_and_colours_of_segments(tmp_path, hd):
    """As `--label-names` reads them; from the folder, too. Names that two segments share get
    numbers.
    """
    path = segmentation(hd, tmp_path / "a.dcm", blobs())
    for source in (path, tmp_path):
        table = load_label_table(source)
        assert table.names == {1: "liver", 2: "tumour 2", 3: "tumour 3"}
        assert_allclose(list(table.colours.values()), np.array(COLOURS) / 255, rtol=0, atol=0.004)
    with pytest.raises(InputError, match="expected names of segments in this file, found none"):
        load_label_table(saved(tmp_path / "b.dcm", enhanced(RAMP, places())))


@pytest.mark.full
def test_mesh_of_a_scan_and_its_segmentation(tmp_path, hd, capsys):
    """Frames in another order, and a segmentation with fewer slices: labels lie where they were,
    with their names.
    """
    k, j, i = np.indices((16, 30, 20))
    world = (
        ORIGIN + i[..., None] * BETWEEN_COLUMNS * AXES[0] + j[..., None] * BETWEEN_ROWS * AXES[1]
    )
    world = world + k[..., None] * STEP * NORMAL
    centre = ORIGIN + 7 * AXES[0] + 7 * AXES[1] + 22 * NORMAL
    far = np.linalg.norm(world - centre, axis=-1)
    voxels = np.stack([far < 6, (k == 3) & (i < 4) & (j < 9), (k == 13) & (i > 15)], axis=-1)
    order = np.random.default_rng(0).permutation(16)
    data = enhanced(1000 * (far < 6)[order], places(16)[order])
    data.FrameOfReferenceUID = "1.2.5"
    scan = saved(tmp_path / "ct.dcm", data)
    labels = segmentation(hd, tmp_path / "seg.dcm", voxels)
    assert (
        exit_code("mesh", scan, "--labels", labels, "-o", tmp_path / "a.vtu", "--nodes", 900) == 0
    )
    loaded = tetopt.load_mesh(tmp_path / "a.vtu")
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
    other = saved(tmp_path / "other.dcm", data)
    words = ["-o", tmp_path / "b.vtu", "--nodes", 50, "--iterations", 0]
    assert exit_code("mesh", other, "--labels", labels, *words) in (0, 1)
    assert (
        "seg.dcm: its positions are in another frame of reference"
        in capsys.readouterr().err.replace("\n  ", " ")
    )
