"""The Dockerfile: what it copies is there; its steps run as a script, and what comes of them, as
another user.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from models import sample_image

import tetopt
from tetopt.job.events import KERNEL_WORDS

ROOT = Path(__file__).resolve().parents[1]
NOBODY = 65534  # the user's and the group's number on Debian


def instructions():
    """The Dockerfile's instructions: word and rest of each, its lines joined."""
    text = re.sub(r"^#.*\n", "", (ROOT / "Dockerfile").read_text(), flags=re.M).replace("\\\n", "")
    return [line.split(None, 1) for line in text.splitlines() if line.strip()]


def copied():
    return [path for word, rest in instructions() if word == "COPY" for path in rest.split()[:-1]]


def test_what_is_copied_is_there_and_not_ignored():
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    assert "*" in ignored
    for path in copied():
        assert (ROOT / path).exists()
        assert f"!{path}" in ignored
    project = (ROOT / "pyproject.toml").read_text()
    for needed in ("README.md", "LICENSE", "phantoms", "tetopt"):
        assert f'"{needed}"' in project
        assert needed in copied()


def test_the_entry_point_is_the_app():
    (entry,) = [json.loads(rest) for word, rest in instructions() if word == "ENTRYPOINT"]
    assert entry[2].endswith('exec python -P -m tetopt.bids "$@"')
    assert ["ENV", "NUMBA_CPU_NAME=generic"] in instructions()


@pytest.fixture
def base():
    """A folder that every user may enter, and a Python that every user may run."""
    python = shutil.which("python3", path="/usr/local/bin:/usr/bin") or sys.executable
    is_new = subprocess.run(
        [python, "-c", "import sys, ensurepip; sys.exit(sys.version_info < (3, 11))"], check=False
    )
    if os.geteuid() != 0 or is_new.returncode:
        pytest.skip(
            "needs root, to become another user, and a Python >= 3.11 of the system's with venv"
        )
    folder = Path(tempfile.mkdtemp(prefix="tetopt-container-"))
    folder.chmod(0o755)
    yield folder, python
    shutil.rmtree(folder)


@pytest.mark.slow
def test_its_steps_make_an_app_that_any_user_runs_and_that_only_reads(base):
    """Without apt-get's step; in a fresh venv, whose files are then read only; without HOME, as
    by --cleanenv.
    """
    folder, python = base
    subprocess.run([python, "-m", "venv", folder / "venv"], check=True)
    pip_settings = {
        name: value
        for name, value in os.environ.items()
        if name.startswith(("PIP_", "SSL_", "REQUESTS_"))
    }
    environment = {"PATH": f"{folder / 'venv' / 'bin'}:/usr/bin:/bin"}
    place = folder
    for word, rest in instructions():
        if word == "WORKDIR":
            place = folder / rest.lstrip("/")
            place.mkdir(parents=True, exist_ok=True)
        elif word == "ENV":
            environment |= dict([rest.split("=", 1)])
        elif word == "COPY":
            for path in rest.split()[:-1]:
                target = place / rest.split()[-1]
                if (ROOT / path).is_dir():
                    shutil.copytree(
                        ROOT / path, target, ignore=shutil.ignore_patterns("__pycache__")
                    )
                else:
                    shutil.copy(ROOT / path, target / path)
        elif word == "RUN" and not rest.startswith("apt-get"):
            subprocess.run(
                ["bash", "-ec", rest],
                cwd=place,
                env=environment | pip_settings,
                check=True,
                umask=0o022,
            )
        elif word == "ENTRYPOINT":
            entry = json.loads(rest.replace("/opt/", f"{folder}/opt/"))
    subprocess.run(["chmod", "-R", "a-w", folder / "venv", folder / "opt"], check=True)

    raw, out = folder / "raw", folder / "out"
    (raw / "sub-01" / "anat").mkdir(parents=True)
    (raw / "dataset_description.json").write_text('{"Name": "x", "BIDSVersion": "1.8.0"}')
    tetopt.save_image(raw / "sub-01" / "anat" / "sub-01_T1w.nii.gz", sample_image(3))
    out.mkdir()
    os.chown(out, NOBODY, NOBODY)

    def run(*words):
        ended = subprocess.run(
            [*entry, raw, out, *words],
            cwd="/",
            env=environment,
            user=NOBODY,
            group=NOBODY,
            extra_groups=[],
            capture_output=True,
            text=True,
            check=False,
        )
        log = (
            (out / "logs" / "sub-01.log").read_text()
            if (out / "logs" / "sub-01.log").exists()
            else ""
        )
        assert ended.returncode == 0, ended.stderr + log
        return ended.stderr + log

    said = run("participant", "--participant_label", "01", "--nodes", "200", "--iterations", "4")
    assert "compil" not in said.replace(KERNEL_WORDS, "")
    mesh = out / "sub-01" / "sub-01_desc-tetopt_mesh.vtu"
    assert mesh.stat().st_uid == NOBODY
    assert len(tetopt.load_mesh(mesh).mesh.cells) > 100
    (out / "cohort.html").unlink()
    run("group")
    assert (out / "cohort.html").exists()
