"""The BIDS app's arguments, as those of `tetopt cohort`."""

import pytest
from models import sample_image

import tetopt
from tetopt import InputError
from tetopt.bids import cohort_words, main
from tetopt.cohort.layout import begin
from tetopt.system.work_directory import lock_directory

PLACES = ["/data", "/out", "participant"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (PLACES, []),
        (
            [*PLACES, "--participant_label", "01", "sub-02"],
            ["--participant-label=01", "--participant-label=sub-02"],
        ),
        (
            ["--participant-label=01", *PLACES, "--nodes", "9"],
            ["--participant-label=01", "--nodes", "9"],
        ),
        (
            [*PLACES, "--session_label", "a", "--max_gb=8", "--k-d", "-1"],
            ["--session-label=a", "--max-gb=8", "--k-d", "-1"],
        ),
        ([*PLACES, "--skip_bids_validation", "--skip-bids-validator"], []),
        (
            [*PLACES, "--mask", "der_iv/sub-{subject}_m.nii"],
            ["--mask", "der_iv/sub-{subject}_m.nii"],
        ),
        (["/data", "/out", "group", "--suffix", "T2w"], ["--collect", "--suffix", "T2w"]),
    ],
)
def test_arguments(arguments, words):
    assert cohort_words(arguments) == ["cohort", "/data", "--output=/out", *words]


def test_folders_may_have_the_names_of_levels():
    assert cohort_words(["group", "participant", "group"]) == [
        "cohort",
        "group",
        "--output=participant",
        "--collect",
    ]


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["/data"],
        ["/data", "/out"],
        ["/data", "/out", "grop"],
        ["--nodes", "9", *PLACES],
        ["participant", "/a", "/b"],
        [*PLACES, "--participant-label"],
        ["/data", "/out", "x", "participant"],
    ],
)
def test_arguments_that_are_none(arguments, capsys):
    with pytest.raises(InputError, match="expected: python -m tetopt"):
        cohort_words(arguments)
    assert main(arguments) == 2
    assert capsys.readouterr().err.count("\n") >= 1


@pytest.mark.full
def test_runs_beside_others_and_the_group_after_them(tmp_path, capsys, scheduler, read_here):
    """One subject while another run has another's lock; the group waits for that, and tells of
    it.
    """
    raw, out = tmp_path / "raw", tmp_path / "out"
    for label in ("01", "02"):
        (raw / f"sub-{label}" / "anat").mkdir(parents=True)
        tetopt.save_image(raw / f"sub-{label}" / "anat" / f"sub-{label}_T1w.nii", sample_image(3))
    (raw / "dataset_description.json").write_text('{"Name": "x", "BIDSVersion": "1.8.0"}')
    begin(out)
    with lock_directory(out / ".work", ["sub-02"]):
        options = ["--nodes", "60", "--iterations", "0", "--scheduler", scheduler]
        assert main([str(raw), str(out), "participant", "--participant_label", "02", *options]) == 2
        assert "sub-02: another run is writing there" in capsys.readouterr().err
        assert main([str(raw), str(out), "participant", "--participant_label", "01", *options]) == 0
        capsys.readouterr()
        assert main([str(raw), str(out), "group"]) == 2
        assert "another run is writing there" in capsys.readouterr().err
    (out / "cohort.tsv").unlink()
    assert main([str(raw), str(out), "group"]) == 1
    assert "1 done, 1 not run" in capsys.readouterr().out
    assert [line.split("\t")[0] for line in (out / "cohort.tsv").read_text().splitlines()[1:]] == [
        "sub-01",
        "sub-02",
    ]
    assert (out / "sub-01" / "sub-01_desc-tetopt_mesh.vtu").exists()
    assert main([str(raw), str(out), "group", "--dry-run"]) == 2
    assert "--collect runs no subjects" in capsys.readouterr().err


def test_help_and_version(capsys):
    for words, said in (
        (["--help"], "tetopt cohort"),
        (["-v"], f"tetopt {tetopt.__version__}"),
        (["--version"], "tetopt"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 0
        assert said in capsys.readouterr().out
