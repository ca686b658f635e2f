"""Subjects: what a table says, what is wrong with one, and what patterns mean."""

from pathlib import Path

import pytest

from tetopt.cohort.subjects import (
    Problems,
    Subject,
    key,
    matching,
    name_problems,
    read_table,
    write_table,
)
from tetopt.errors import InputError
from tetopt.job.options import RunOptions
from tetopt.job.texts import with_options


def table(path, *lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def subject(name, session="", **others):
    values = {"images": (Path("/a.nii"),), "options": {}, "place": f"row {name}"}
    return Subject(name, session, **(values | others))


def test_a_table_says_what_is_meshed(tmp_path):
    path = table(
        tmp_path / "s.tsv",
        "subject\tsession\timage\timage_2\tmask\tnodes\tk-d\t#note",
        "sub-01\tses-a\ta.nii\tb.nii\tn/a\t500\t\told",
        "02\t\t/c.nii\tn/a\tm.nii\tn/a\t0.3\t",
    )
    images = tmp_path / "a.nii", tmp_path / "b.nii"
    first = Subject("01", "a", images, {"nodes": "500"}, f"{path}, line 2")
    options = {"mask": str(tmp_path / "m.nii"), "k_d": "0.3"}
    second = Subject("02", "", (Path("/c.nii"),), options, f"{path}, line 3")
    assert read_table(path) == [first, second]
    assert [key(first), key(second)] == ["sub-01_ses-a", "sub-02"]


def test_transforms_are_relative_to_the_table_and_come_back(tmp_path):
    files = "warp.nii.gz;../affine.mat"
    path = table(
        tmp_path / "s.tsv", "subject\timage\tstart\ttransform", f"1\ta.nii\tt.vtu\t{files}"
    )
    (row,) = read_table(path)
    places = [str(tmp_path / "warp.nii.gz"), str(tmp_path.parent / "affine.mat")]
    assert row.options == {"start": str(tmp_path / "t.vtu"), "transform": ";".join(places)}
    options = with_options(RunOptions(), row.options)
    assert [str(each) for each in options.transform] == places
    write_table(tmp_path / "again.tsv", [row])
    (again,) = read_table(tmp_path / "again.tsv")
    assert again.options == row.options


def test_files_of_mappings_are_relative_to_the_table(tmp_path):
    path = table(
        tmp_path / "s.tsv",
        "subject\timage\tyoung\tnu\tdensity",
        "1\ta.nii\tmapping.csv\t0.3\t../rho.TOML",
    )
    (row,) = read_table(path)
    assert row.options == {
        "young": str(tmp_path / "mapping.csv"),
        "nu": "0.3",
        "density": str(tmp_path.parent / "rho.TOML"),
    }
    labels = table(
        tmp_path / "l.tsv", "subject\timage\tmerge\tlabel_size", "1\ta.nii\tgroups.csv\tsizes.csv"
    )
    (other,) = read_table(labels)
    files = {"merge": "groups.csv", "label_size": "sizes.csv"}
    assert other.options == {name: str(tmp_path / file) for name, file in files.items()}
    (tmp_path / "inner").mkdir()
    write_table(tmp_path / "inner" / "u.tsv", [row])
    assert "\t../../rho.TOML\t0.3\t../mapping.csv\n" in (tmp_path / "inner" / "u.tsv").read_text()


@pytest.mark.parametrize(
    ("suffix", "lines"),
    [
        (".csv", ["subject,image", '"a, b",x.nii']),
        (".csv", ["subject;image", '"a, b";x.nii']),
        (".csv", ["\ufeffparticipant_id,image", '"a, b",x.nii']),
        (".tsv", ["subject\timage", "a, b\tx.nii", "", "\t"]),
    ],
)
def test_tables_as_programs_write_them(tmp_path, suffix, lines):
    (row,) = read_table(table(tmp_path / f"t{suffix}", *lines))
    assert (row.subject, key(row), row.images) == ("a, b", "sub-ab", (tmp_path / "x.nii",))


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["subject,file"], "missing image"),
        (["subject,image,image"], "occurs 2 times"),
        (["subject,image"], "a line for each subject"),
        ([""], "an empty file"),
        (["subject,image", '"a,b'], "correct"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path, lines, words):
    with pytest.raises(InputError, match=words):
        read_table(table(tmp_path / "t.csv", *lines))


def test_all_lines_that_are_wrong_are_said(tmp_path):
    path = table(tmp_path / "t.csv", "subject,image", "a", ",x.nii", "b,n/a", "c,y.nii")
    with pytest.raises(Problems) as raised:
        read_table(path)
    assert [line.removeprefix(f"{path}, ") for line in raised.value.lines] == [
        "line 2: expected 2 cells as in the first line, got 1",
        "line 3: missing subject",
        "line 4: missing image",
    ]


def test_names_that_come_to_the_same_are_said():
    rows = [subject("a-1"), subject("a1"), subject("--"), subject("b"), subject("b", "x")]
    words = list(name_problems(rows))
    assert [line.partition(":")[0] for line in words] == ["row a1", "row --", "row b"]
    assert "sub-a1 is also used by row a-1" in words[0]
    assert "sub-b_ses-x has a session, but sub-b (row b) has none" in words[2]


def test_names_that_no_file_can_have_are_refused():
    assert list(name_problems([subject("n" * 196)])) == []
    (line,) = name_problems([subject("n" * 100, "s" * 100)])
    assert "has 209 characters" in line


def test_a_table_that_was_written_reads_the_same(tmp_path):
    images = (tmp_path / "x.nii", Path("/far/y.nii")), (tmp_path / "z\tz.nii",)
    rows = [
        subject("01", "a", images=images[0], options={"background": "-5"}, place=""),
        subject("02", "b", images=images[1], options={"labels": str(tmp_path / "l.nii")}, place=""),
    ]
    for name in ("t.tsv", "t.csv"):
        write_table(tmp_path / name, rows)
        assert [each._replace(place="") for each in read_table(tmp_path / name)] == rows


PATTERN = "sub-{subject}/ses-{session}/sub-{subject}_ses-{session}_mask.nii"


@pytest.mark.parametrize(
    ("pattern", "session", "name"),
    [
        (PATTERN, "b", "sub-01/ses-b/sub-01_ses-b_mask.nii"),
        (PATTERN, "", "sub-01/sub-01_mask.nii"),
        ("sub-{subject}/**/*_mask.nii", "b", "sub-01/sub-01_mask.nii"),
        ("atlas.nii", "", "atlas.nii"),
    ],
)
def test_a_pattern_means_one_file(tmp_path, monkeypatch, pattern, session, name):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    assert matching(pattern, subject("0-1", session)) == tmp_path / name


def test_a_pattern_of_two_files_is_refused(tmp_path):
    """One of none is itself, whose run fails."""
    assert not matching(f"{tmp_path}/*.nii", subject("01")).exists()
    for name in ("a.nii", "b.nii"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=r"expected one file, got 2: a\.nii, b\.nii"):
        matching(f"{tmp_path}/*.nii", subject("01"))


def test_columns_that_are_no_options_are_notes_and_slips_are_not(tmp_path):
    path = table(
        tmp_path / "s.tsv",
        "participant_id\timage\tage\tsex\tsite\tdiagnosis\tlables\tmaks\tk_d",
        "sub-01\ta.nii\t31\tF\tn/a\tAD, MCI\t\t\t0.3",
    )
    (row,) = read_table(path)
    assert row.notes == {"age": "31", "sex": "F", "diagnosis": "AD, MCI"}
    assert row.options == {"k_d": "0.3"}
    path.write_text(path.read_text().replace("AD, MCI\t\t\t", "AD\tl.nii\tm.nii\t"))
    (row,) = read_table(path)
    assert set(row.options) == {"lables", "maks", "k_d"}  # which their plan refuses
    write_table(tmp_path / "t.csv", [row])
    assert read_table(tmp_path / "t.csv")[0].notes == row.notes
