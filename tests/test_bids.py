"""The BIDS app's arguments, as those of `tetopt cohort`."""

import pytest

import tetopt
from tetopt import InputError
from tetopt.bids import cohort_words, main

PLACES = ["/data", "/out", "participant"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (PLACES, []),
        ([*PLACES, "--participant_label", "01", "sub-02"], ["--participant-label=01", "--participant-label=sub-02"]),
        (["--participant-label=01", *PLACES, "--nodes", "9"], ["--participant-label=01", "--nodes", "9"]),
        (
            [*PLACES, "--session_label", "a", "--max_gb=8", "--k-d", "-1"],
            ["--session-label=a", "--max-gb=8", "--k-d", "-1"],
        ),
        ([*PLACES, "--skip_bids_validation", "--skip-bids-validator"], []),
        ([*PLACES, "--mask", "der_iv/sub-{subject}_m.nii"], ["--mask", "der_iv/sub-{subject}_m.nii"]),
        (["/data", "/out", "group", "--suffix", "T2w"], ["--collect", "--suffix", "T2w"]),
    ],
)
def test_arguments(arguments, words):
    assert cohort_words(arguments) == ["cohort", "/data", "--output=/out", *words]


def test_folders_may_have_the_names_of_levels():
    assert cohort_words(["group", "participant", "group"]) == ["cohort", "group", "--output=participant", "--collect"]


@pytest.mark.parametrize(
    "arguments",
    [[], ["/data"], ["/data", "/out"], ["/data", "/out", "grop"], ["--nodes", "9", *PLACES],
     ["participant", "/a", "/b"], [*PLACES, "--participant-label"], ["/data", "/out", "x", "participant"]],
)  # fmt: skip
def test_arguments_that_are_none(arguments, capsys):
    with pytest.raises(InputError, match="expected: python -m tetopt"):
        cohort_words(arguments)
    assert main(arguments) == 2
    assert capsys.readouterr().err.count("\n") >= 1


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
