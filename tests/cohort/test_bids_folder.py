"""Rows of a cohort from a BIDS folder, and what a cohort's folder says of itself."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tetopt import InputError
from tetopt.cohort.bids_folder import bids_subjects
from tetopt.cohort.layout import begin
from tetopt.cohort.subjects import Problems, Subject, matching


@pytest.fixture
def raw(tmp_path):
    return tmp_path / "raw"


def filled(folder, *names):
    """A BIDS folder with these empty files."""
    for name in ("dataset_description.json", *names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (folder / "dataset_description.json").write_text('{"Name": "x", "BIDSVersion": "1.8.0"}')
    return folder


def rows(folder, *wanted, **sessions):
    """Subjects and sessions, and where their images are."""
    return [
        (each.subject, each.session, str(each.images[0].relative_to(folder)))
        for each in bids_subjects(folder, *wanted, **sessions)
    ]


def test_raw_images_of_the_suffix_by_subject_and_session(tmp_path):
    folder = filled(
        tmp_path / "raw[1].v2",
        "sub-02/anat/sub-02_T1w.nii.gz",
        "sub-02/anat/sub-02_T1w.nii",
        "sub-02/anat/sub-02_T1w.json",
        "sub-02/anat/sub-02_T2w.nii.gz",
        "sub-01/ses-b/anat/sub-01_ses-b_T1w.nii",
        "sub-01/ses-a/anat/sub-01_ses-a_T1w.nii.gz",
        "derivatives/fmriprep/sub-02/anat/sub-02_desc-preproc_T1w.nii.gz",
        "sourcedata/sub-07/anat/sub-07_T1w.nii.gz",
    )
    (folder / "sub-02/anat/sub-02_T1w.json").write_text('{"a":')  # never opened
    # nor pybids's own settings of an untrusted folder
    (folder / "sub-02" / "layout_config.json").write_text("[")
    # as where a DataLad dataset's content is not fetched
    link = folder / "sub-01/ses-b/anat/sub-01_ses-b_T1w.nii"
    link.unlink()
    link.symlink_to("../../../.git/annex/objects/none")
    (folder / "sub-02" / "loop").symlink_to(folder / "sub-02")
    second = ("01", "b", "sub-01/ses-b/anat/sub-01_ses-b_T1w.nii")
    assert rows(folder) == [
        ("01", "a", "sub-01/ses-a/anat/sub-01_ses-a_T1w.nii.gz"),
        second,
        ("02", "", "sub-02/anat/sub-02_T1w.nii.gz"),
    ]
    last = bids_subjects(folder)[2]
    assert (last.place, last.options) == ("sub-02/anat/sub-02_T1w.nii.gz", {})
    t2 = ("02", "", "sub-02/anat/sub-02_T2w.nii.gz")
    assert rows(folder, "T2w", ["sub-02"]) == [t2]
    with pytest.warns(UserWarning, match=r"left out subjects without _T1w in ses-b: 1 \(sub-02\)"):
        assert rows(folder, sessions=["ses-b"]) == [second]


def test_entities_choose_among_several(raw):
    folder = filled(
        raw,
        "sub-1/anat/sub-1_acq-mprage_run-01_T1w.nii.gz",
        "sub-1/anat/sub-1_acq-mprage_run-02_T1w.nii.gz",
        "sub-2/anat/sub-2_T1w.nii.gz",
        "sub-2/anat/sub-2_rec-norm_T1w.nii.gz",
    )
    with pytest.raises(InputError) as caught:
        bids_subjects(folder)
    message = str(caught.value)
    assert "run-01_T1w.nii.gz, sub-1/anat/sub-1_acq-mprage_run-02_T1w.nii.gz" in message
    assert "`suffix` acq-mprage_run-01_T1w" in message
    assert "sub-2" not in message  # of two images that without entities is what T1w says
    with pytest.warns(UserWarning, match=r"left out subjects without _run-2_T1w: 1 \(sub-2\)"):
        assert rows(folder, "run-2_T1w") == [
            ("1", "", "sub-1/anat/sub-1_acq-mprage_run-02_T1w.nii.gz")
        ]
    normalised = ("2", "", "sub-2/anat/sub-2_rec-norm_T1w.nii.gz")
    assert rows(folder, "rec-norm_T1w", ["2"]) == [normalised]


def test_all_that_is_wrong_is_told_at_once(raw):
    folder = filled(
        raw,
        "sub-1/anat/sub-1_T1w.nii.gz",
        "sub-2/anat/sub-3_T1w.nii.gz",
        "sub-2/anat/\x1b_T1w.nii",
    )
    with pytest.raises(Problems) as caught:
        bids_subjects(folder, participants=["1", "2", "8", "9"])
    message = str(caught.value)
    # Names that are not BIDS's, such as another subject's, are no images.
    assert [line for line in caught.value.lines if "no image" in line] == [
        f"{folder}: sub-{label}: no image _T1w" for label in (2, 8, 9)
    ]
    assert "sub-1" not in message
    assert message.isprintable()
    with pytest.raises(InputError, match="ses-x: no image _T1w"):
        bids_subjects(folder, participants=["1"], sessions=["x"])


def test_columns_of_participants_are_notes(raw):
    folder = filled(raw, "sub-1/anat/sub-1_T1w.nii.gz", "sub-2/anat/sub-2_T1w.nii.gz")
    table = folder / "participants.tsv"
    table.write_text("participant_id\tage\tsex\nsub-2\t34\tn/a\n")
    assert [row.notes for row in bids_subjects(folder)] == [{}, {"age": "34"}]
    table.write_bytes(b"\xff\xfe\x00")
    with pytest.warns(UserWarning, match="participants"):
        assert [row.notes for row in bids_subjects(folder)] == [{}, {}]


PATTERNS = {  # by words of them: a session, and what matches
    "aseg_dseg": ("a", "fmriprep/sub-1/ses-a/anat/sub-1_ses-a_desc-aseg_dseg.nii.gz"),
    "{session}_desc-brain_mask": ("", "fmriprep/sub-1/anat/sub-1_desc-brain_mask.nii.gz"),
    "{subject}_desc-brain_mask": ("b", "fmriprep/sub-1/anat/sub-1_desc-brain_mask.nii.gz"),
    "aparc": ("b", "freesurfer/sub-1/mri/aparc+aseg.mgz"),
    "{session}/mri/aseg": ("b", "freesurfer/sub-1_ses-b/mri/aseg.mgz"),
    ".long": ("b", "freesurfer/sub-1_ses-b.long.sub-1/mri/aseg.mgz"),
    "synthseg": ("", "synthseg/sub-1_T1w_synthseg.nii.gz"),
}


def test_patterns_of_the_documents_find_what_programs_write(tmp_path, monkeypatch):
    """One file each, in folders as fMRIPrep, FreeSurfer and SynthSeg leave them, with other
    subjects and spaces.
    """
    words = (Path(__file__).parents[2] / "docs" / "howto" / "cohorts.md").read_text()
    written = re.findall(r"^--(?:mask|labels) (\S+)$", words, re.M)
    others = [name.replace("sub-1", "sub-10") for _, name in PATTERNS.values()]
    others += [name.replace("_desc", "_space-MNI152_desc") for _, name in PATTERNS.values()]
    filled(tmp_path / "derivatives", *others, *(name for _, name in PATTERNS.values()))
    monkeypatch.chdir(tmp_path)
    assert len(written) == len(PATTERNS)
    for pattern in written:
        ((session, name),) = [each for part, each in PATTERNS.items() if part in pattern]
        subject = Subject("1", session, (), {}, "")
        assert matching(pattern, subject) == tmp_path / "derivatives" / name
        assert matching(pattern, subject).is_file()


def test_folders_that_are_none(tmp_path):
    with pytest.raises(InputError, match="root does not exist"):
        bids_subjects(tmp_path / "none")
    file = tmp_path / "dataset_description.json"
    for text, words in (
        (None, r"expected a BIDS dataset, or a table \('dataset_description\.json' is missing"),
        ('{"a":', "not a valid json"),
        ("[" * 10**5, "recursion"),
        ("{}", "'Name' field missing"),
        ('{"Name": "x", "BIDSVersion": "1.8.0"}', r"no subject has an image _T1w\.nii\.gz"),
    ):
        if text is not None:
            file.write_text(text)
        with pytest.raises(InputError, match=words) as caught:
            bids_subjects(tmp_path)
        assert str(caught.value).isprintable()


@pytest.mark.parametrize("suffix", ["", "T1w.nii.gz", "acq-_T1w", "sub-01_T1w", ".*", "T1w\n"])
def test_suffixes_that_are_none(raw, suffix):
    with pytest.raises(InputError, match="expected the end of a BIDS name") as caught:
        bids_subjects(filled(raw), suffix)
    assert str(caught.value).isprintable()


@pytest.mark.skipif(os.name != "posix", reason="names of any bytes")
def test_names_that_are_no_text_are_no_images(tmp_path, raw):
    folder = filled(raw, "sub-1/anat/sub-1_T1w.nii.gz")
    (folder / "sub-1" / "anat" / os.fsdecode(b"sub-1_acq-\xff_T1w.nii.gz")).touch()
    assert len(bids_subjects(folder)) == 1
    odd = tmp_path / os.fsdecode(b"\xff")
    shutil.copytree(folder, odd)
    with pytest.raises(InputError, match="expected a BIDS dataset"):
        bids_subjects(odd)


def test_without_the_library_one_line_says_what_to_install(raw, monkeypatch):
    monkeypatch.setitem(sys.modules, "bids", None)
    with pytest.raises(InputError, match=r'pip install "pybids(>=[0-9.]+)?"'):
        bids_subjects(filled(raw))


@pytest.mark.full
def test_a_cohort_folder_passes_the_validator_of_bids(tmp_path):
    """The field's own validator, with what BIDS has no names for told apart: no error, only
    advice.
    """
    validator = shutil.which("bids-validator-deno", path=str(Path(sys.executable).parent))
    if validator is None:
        pytest.skip("no bids-validator-deno")
    out = tmp_path / "out"
    begin(out, [tmp_path.as_uri()])
    mesh = "sub-1/ses-a/sub-1_ses-a_desc-tetopt_mesh"
    figures = "sub-1/ses-a/figures/slice.png", "sub-2/figures/slice.png"
    logs = "logs/sub-1_ses-a.log", "logs/sub-2.failed.json"
    meshes = f"{mesh}.vtu", f"{mesh}.json", "sub-2/sub-2_desc-tetopt_mesh.inp"
    for name in ("cohort.tsv", "cohort.html", *logs, *meshes, *figures):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("x")

    def codes():
        run = subprocess.run(
            [validator, "--format", "json", out], capture_output=True, text=True, check=False
        )
        issues = json.loads(run.stdout)["issues"]["issues"]
        return {(issue["severity"], issue["code"]) for issue in issues}

    assert codes() == {("warning", "README_FILE_MISSING"), ("warning", "TOO_FEW_AUTHORS")}
    (out / ".bidsignore").unlink()
    assert ("error", "NOT_INCLUDED") in codes()
