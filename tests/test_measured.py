"""Pages of measured numbers: those that the data make, of this version, and no number beside
them.
"""

import json
import re

import pytest
from test_scripts import script

import tetopt

# Numbers that templates may hold: settings of the measurements, which their commands or texts name.
SETTINGS = {"0.02", "0.2", "0.3", "0.45", "1.2"}
CODE = re.compile(r"```.*?```|`[^`\n]*`|\{\{.*?\}\}|\{%.*?%\}", re.DOTALL)
DECIMAL = re.compile(r"(?<![\w.])\d+\.\d+")
# Numbers of three decimals or more that are not measured: of formulas and of the code.
CONSTANTS = {"0.001", "0.002", "0.0255", "1.155", "1.4826", "1.489"}
# What a page shows of programs; outputs (text) are none of it.
PROGRAM = re.compile(r"^(`{3,})(bash|python|toml)$.*?^\1$|`[^`\n]+`", re.DOTALL | re.MULTILINE)
LESSON = "start"  # a folder; `test_the_lesson_runs` compares its numbers


@pytest.fixture(scope="module")
def measure():
    return script("measure")


def test_pages_are_what_the_data_make(measure):
    for path, text in measure.pages().items():
        assert path.read_text(encoding="utf-8") == text, (
            f"{path.name}: run `python scripts/measure.py --pages`"
        )


def test_data_are_of_this_version_and_whole(measure):
    data = json.loads(measure.DATA.read_text(encoding="utf-8"))
    assert set(data) == set(measure.MEASUREMENTS)
    for name, entry in data.items():
        assert entry["version"].split(".")[:2] == tetopt.__version__.split(".")[:2], (
            f"{name}: run `make measured`"
        )
        assert [row["command"] for row in entry["commands"]] == list(
            measure.MEASUREMENTS[name].commands
        )


def test_no_number_is_typed_into_a_template(measure):
    for template in measure.TEMPLATES.glob("*.md"):
        assert (
            set(DECIMAL.findall(CODE.sub(" ", template.read_text(encoding="utf-8")))) <= SETTINGS
        ), template.name


def test_a_quoted_number_is_measured(measure):
    """A number of three decimals or more on a page stands on a page of Measured, which its line
    links to.
    """
    begin, end = map(re.escape, measure.MARKS)
    made = re.compile(f"{begin}.*?{end}", re.DOTALL)
    for path in [measure.ROOT / "README.md", *(measure.ROOT / "docs").rglob("*.md")]:
        parts = path.relative_to(measure.ROOT).parts
        if {LESSON, "measured", "_build", "gallery", "generated"} & set(parts):
            continue
        text = made.sub(" ", PROGRAM.sub(" ", path.read_text(encoding="utf-8")))
        for line in text.splitlines():
            sources = {
                digits
                for name in re.findall(r"measured/(\w+)\.md", line)
                for digits in DECIMAL.findall((measure.PAGES / f"{name}.md").read_text("utf-8"))
            }
            long = {each for each in DECIMAL.findall(line) if len(each.split(".")[1]) >= 3}
            assert long <= sources | CONSTANTS, path.name


def test_measuring_needs_its_images(measure, tmp_path, capsys):
    """One line names what is missing, and nothing is written."""
    before = measure.DATA.read_bytes()
    assert (
        measure.main([str(tmp_path), "--only", "labels", "--folder", str(tmp_path / "runs")]) == 2
    )
    assert capsys.readouterr().err == (
        "measure: expected a file for each of CT_LABELS, CT_SLAB, TISSUES, got none\n"
    )
    assert measure.DATA.read_bytes() == before
    assert not (tmp_path / "runs").exists()


@pytest.mark.deep
def test_a_measurement_replaces_its_entry(measure, tmp_path, monkeypatch):
    """A command runs in its folder, and its rows go into the data with version, commit and time."""
    monkeypatch.setattr(measure, "DATA", tmp_path / "measured.json")
    command = "tetopt phantom sphere --voxel-mm 8 -o $NAME"
    then = (
        "tetopt mesh sphere.nii.gz -o sphere.vtu --nodes 60 --iterations 1 --json "
        "sphere.json --force"
    )
    monkeypatch.setitem(
        measure.MEASUREMENTS, "small", measure.Measurement((command, then), measure.runs)
    )
    (tmp_path / "small").mkdir()
    # of an earlier run: not refused, and not read
    for name in (measure.LOG, "sphere.nii.gz", "old.json"):
        (tmp_path / "small" / name).write_text("{}", encoding="utf-8")
    measure.measure("small", {"NAME": "sphere.nii.gz"}, tmp_path / "small")
    entry = json.loads(measure.DATA.read_text(encoding="utf-8"))["small"]
    assert entry["version"] == tetopt.__version__
    assert [row["command"] for row in entry["commands"]] == [command, then]
    assert entry["rows"]["sphere"]["nodes"] == len(
        tetopt.load_mesh(tmp_path / "small" / "sphere.vtu").mesh.points
    )


def test_a_failed_program_is_no_measurement(measure, tmp_path, monkeypatch):
    """Exit code 1 is a violated requirement of `tetopt mesh` alone."""
    monkeypatch.setattr(measure, "DATA", tmp_path / "measured.json")
    monkeypatch.setitem(
        measure.MEASUREMENTS, "failed", measure.Measurement(("python -c 1/0",), measure.runs)
    )
    with pytest.raises(SystemExit, match="failed: exit code 1"):
        measure.measure("failed", {}, tmp_path / "failed")
    assert not measure.DATA.exists()
