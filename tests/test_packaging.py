"""What a release says of itself: one version, an archive of sources with what it needs, what is
run on which system.
"""

import itertools
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from order import LONGEST_FILES

import tetopt

pytestmark = pytest.mark.full

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
WORKFLOW = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))


def test_there_is_one_version():
    assert PROJECT["project"]["dynamic"] == ["version"]
    assert PROJECT["tool"]["hatch"]["version"]["path"] == "tetopt/__init__.py"
    assert CITATION["version"] == tetopt.__version__
    first = re.search(
        r"^## (\S+), (\S+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M
    )
    assert first[1] == tetopt.__version__
    # A release has its day in both; what is not released has none.
    assert (first[2] == "unreleased") == ("date-released" not in CITATION)
    assert first[2] in ("unreleased", str(CITATION.get("date-released")))


def test_what_is_said_twice_is_said_alike():
    assert CITATION["title"] == PROJECT["project"]["name"] == "tetopt"
    assert CITATION["license"] == PROJECT["project"]["license"]
    assert [each["name"] for each in CITATION["authors"]] == [
        each["name"] for each in PROJECT["project"]["authors"]
    ]


def test_each_bound_of_a_package_is_one():
    """A package that several extras name has one lower bound, so that a mesh's reader needs what
    was tested.
    """
    bounds = {}
    extras = PROJECT["project"]["optional-dependencies"].values()
    for line in itertools.chain(PROJECT["project"]["dependencies"], *extras):
        name, _, bound = line.partition(";")[0].partition(">=")
        if not name.startswith("tetopt["):
            assert re.fullmatch(r"[0-9.]+", bound), line
            bounds.setdefault(name.lower(), set()).add(bound)
    assert [(name, versions) for name, versions in bounds.items() if len(versions) > 1] == []


def test_the_recipe_for_conda_says_what_the_project_says():
    recipe = yaml.safe_load((ROOT / "docs" / "develop" / "recipe.yaml").read_text(encoding="utf-8"))
    project = PROJECT["project"]
    run = recipe["requirements"]["run"]
    assert run[0] == "python >=${{ python_min }}"
    assert [each.replace(" ", "").replace("_", "-") for each in run[1:]] == project["dependencies"]
    assert project["requires-python"] == f">={recipe['context']['python_min']}"
    assert recipe["context"]["version"] == tetopt.__version__
    assert recipe["about"]["license"] == project["license"]
    assert recipe["about"]["summary"] == project["description"]
    entries = dict(each.split(" = ") for each in recipe["build"]["python"]["entry_points"])
    assert entries == project["scripts"]
    built = [each.replace(" ", "") for each in recipe["requirements"]["host"][2:]]
    assert built == PROJECT["build-system"]["requires"]


def test_the_archive_of_sources_has_what_git_has():
    """Each file of the repository is in one of the archive's folders, or is there without being
    named.
    """
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("no git repository here")
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, encoding="utf-8", check=True
    ).stdout
    included = {
        each.strip("/") for each in PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    }
    unnamed = {"README.md", "LICENSE", "pyproject.toml", ".gitignore"}  # hatch's own
    assert {each.split("/")[0] for each in listed.splitlines()} == included | unnamed


def test_the_workflow_runs_what_there_is():
    """Linux as `.ci/run` does; the steps elsewhere, where there is no make, run what its targets
    run.
    """
    jobs = WORKFLOW["jobs"]
    words = "\n".join(step.get("run", "") for job in jobs.values() for step in job["steps"])
    assert "\n.ci/run\n" in f"\n{words}\n"
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"make ([\w-]+)", words):
        assert re.search(rf"^{target}:", makefile, re.M), target
    for name in re.findall(r"\b(?:tests|benchmarks|scripts|docs)/[\w./]+", words):
        assert (ROOT / name).exists() or name.startswith("docs/_build"), name
    systems = {job["runs-on"] for job in jobs.values() if "matrix" not in str(job["runs-on"])}
    systems |= {
        each
        for job in jobs.values()
        for each in job.get("strategy", {}).get("matrix", {}).get("os", [])
    }
    assert systems >= {"ubuntu-latest", "macos-latest", "windows-latest"}
    for job in jobs.values():  # by the major version, which its makers keep compatible
        assert all(
            re.fullmatch(r"[\w/-]+@v\d+", step["uses"]) for step in job["steps"] if "uses" in step
        )


def test_long_files_begin_first():
    """Each is there, and each run on several processes keeps the order."""
    assert [name for name in LONGEST_FILES if not (ROOT / "tests" / name).exists()] == []
    for path in (ROOT / "Makefile", ROOT / ".github" / "workflows" / "ci.yml"):
        lines = [
            line
            for line in path.read_text(encoding="utf-8").splitlines()
            if "--dist loadfile" in line
        ]
        assert lines
        assert all("--no-loadscope-reorder" in line for line in lines)


@pytest.mark.slow
def test_wheel_and_sources_install_and_run(tmp_path):
    """As `make dist`: built, checked, installed into fresh environments, and run there. Needs an
    index of packages.
    """
    subprocess.run(
        [sys.executable, ROOT / ".ci" / "dist.py", tmp_path / "dist"], cwd=tmp_path, check=True
    )
