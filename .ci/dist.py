"""Build the wheel and the archive of sources, check them, install each into a fresh environment,
and run it there.

Usage: python .ci/dist.py FOLDER, which gets the two files. Needs an index of packages, as pip has
it.
"""

import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ("build>=1.2", "twine>=6.1")
SCRIPTS = "Scripts" if os.name == "nt" else "bin"


def run(*words: str | Path, folder: Path | None = None) -> str:
    """Run a program, in the folder; what it printed. Its failure is ours."""
    print("$", *words, flush=True)
    # Neither these sources nor kernels compiled of them.
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "NUMBA_CACHE_DIR")
    }
    return subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        env=environment | {"PYTHONUTF8": "1"},
        check=True,
        stdout=subprocess.PIPE,
        encoding="utf-8",
    ).stdout


def environment_of(folder: Path, *requirements: str | Path) -> Path:
    """A fresh environment with these packages; the folder of its programs."""
    venv.create(folder, with_pip=True)
    run(
        folder / SCRIPTS / "python",
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        *requirements,
    )
    return folder / SCRIPTS


def try_out(built: Path, folder: Path) -> None:
    """Install one of the two without extras; ask for its version, and make a mesh."""
    programs = environment_of(folder / "environment", built)
    run(programs / "python", "-m", "pip", "check")
    version = run(programs / "tetopt", "--version", folder=folder).split()[-1]
    if f"-{version}" not in built.name:
        raise SystemExit(f"{built.name}: expected its version, tetopt says that it is {version}")
    run(
        programs / "tetopt",
        "phantom",
        "sphere",
        "-o",
        "sphere.nii.gz",
        "--voxel-mm",
        "4",
        folder=folder,
    )
    run(
        programs / "tetopt",
        "mesh",
        "sphere.nii.gz",
        "-o",
        "sphere.vtu",
        "--nodes",
        "300",
        folder=folder,
    )
    print(
        run(
            programs / "tetopt",
            "quality",
            "sphere.vtu",
            "--image",
            "sphere.nii.gz",
            "--check",
            folder=folder,
        )
    )


def main(out: Path) -> None:
    """Build both into a folder, and try them."""
    with tempfile.TemporaryDirectory(prefix="tetopt-") as name:
        work = Path(name)
        programs = environment_of(work / "tools", *TOOLS)
        run(programs / "python", "-m", "build", "--outdir", work / "dist", ROOT)
        built = sorted((work / "dist").iterdir())
        print(run(programs / "python", "-m", "twine", "check", "--strict", *built))
        for number, each in enumerate(built):
            folder = work / str(number)
            folder.mkdir()
            try_out(each, folder)
        out.mkdir(parents=True, exist_ok=True)
        for each in built:
            (out / each.name).write_bytes(each.read_bytes())
            print(out / each.name)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
