"""Fixtures shared by all tests."""

import json
import os
import signal
import subprocess
import sys
import time
import warnings
from contextlib import chdir
from functools import cache, lru_cache
from io import BytesIO
from pathlib import Path

import numba
import PIL.Image
import pytest
import schemas
import typer
from hypothesis import settings
from matplotlib.figure import Figure
from order import LONGEST_FILES

import tetopt.system.files
from tetopt.cli import app
from tetopt.io import apart
from tetopt.report import summary
from tetopt.system import budget

# The same examples in every run; few where the kernels run as plain Python.
settings.register_profile(
    "tetopt", deadline=None, derandomize=True, max_examples=4 if numba.config.DISABLE_JIT else 12
)
settings.load_profile("tetopt")
# As in a terminal, here and in all processes that tests start: in the background of a script SIGINT
# is ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The tests of the longest files first, which `--no-loadscope-reorder` keeps so; the others
    as they were.
    """
    folder = Path(__file__).resolve().parent
    ranks = {folder / name: rank for rank, name in enumerate(LONGEST_FILES)}
    items.sort(key=lambda item: ranks.get(item.path, len(ranks)))


@pytest.fixture(autouse=True)
def wide_lines(monkeypatch):
    """Sentences on one line, as tests look for parts of them; `test_cli_width.py` has lines as
    users see them.
    """
    monkeypatch.setattr("tetopt.cli.console.LINE_WIDTH", 1000)


@pytest.fixture(params=[2, 3])
def n(request):
    """The number of dimensions, one after the other."""
    return request.param


@pytest.fixture(params=[1, 2])
def order(request):
    """The order of cells, one after the other."""
    return request.param


@pytest.fixture
def here(tmp_path):
    """The folder that a test works in, so that its files have names as users type them."""
    with chdir(tmp_path):
        yield tmp_path


@pytest.fixture(scope="session", autouse=True)
def built_once():
    """The line of each command is built once, versions are looked up once, and control groups once
    a second.

    Together they take longer than most commands.
    """
    build, built = app._app, {}
    group_bytes, true_folder = budget._group_bytes, budget.GROUP_FOLDER

    def kept(arguments):
        name = next((word for word in arguments if not word.startswith("-")), None)
        if name in built and name in app.COMMANDS:
            app._check_environment()
        elif name not in built:
            built[name] = typer.main.get_command(build(arguments))
        return built[name]

    @lru_cache(1)
    def of_second(_second):
        return group_bytes()

    def group_room():
        is_true = budget.GROUP_FOLDER == true_folder
        return of_second(int(time.monotonic())) if is_true else group_bytes()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(budget, "_group_bytes", group_room)
        patch.setattr(app, "_app", kept)
        patch.setattr(summary, "version", cache(summary.version))
        yield


# Of the test that runs, or whose fixtures are made, those of a module among them.
marks: set[str] = set()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    marks.clear()
    marks.update(mark.name for mark in item.iter_markers())


@pytest.fixture(scope="session", autouse=True)
def blank_pictures():
    """Figures are composed, and written blank where no test looks at them, as drawing one takes
    half a second.

    Tests marked `drawn` look at them.
    """
    drawn = Figure.savefig

    def saved(figure, path, **options):
        if marks & {"drawn", "deep", "slow"}:
            drawn(figure, path, **options)
        else:
            PIL.Image.new("RGB", (8, 6)).save(path, "png")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", saved)
        yield


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real volumes: TETOPT_DATA, else ../shared/data beside the repository."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TETOPT_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real test volumes in {folder}; set TETOPT_DATA")
    return folder


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skips where VTK finds no OpenGL that draws without a display; asked in a child, since it
    may end the process.
    """
    program = (
        "import numpy as np, pyvista as p; q = p.Plotter(off_screen=True); q.add_mesh(p.Sphere()); "
        "assert np.ptp(q.screenshot(return_img=True)) > 0"
    )
    if (
        subprocess.run([sys.executable, "-c", program], capture_output=True, check=False).returncode
        != 0
    ):
        pytest.skip("no OpenGL that renders off screen")


@pytest.fixture(scope="session", autouse=True)
def described_numbers():
    """Whatever JSON a test has tetopt write in this process keeps to its schema, if its kind has
    one.
    """
    save_text = tetopt.system.files.save_text

    def checked(path, text):
        if Path(path).suffix == ".json":
            schemas.assert_described(json.loads(text))
        save_text(path, text)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tetopt.system.files, "save_text", checked)
        yield


@pytest.fixture(scope="session")
def scheduler():
    """The address of one with a worker in this process: a cohort there starts no other, and
    loads no kernels again.
    """
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol="tcp://",
        dashboard_address="127.0.0.1:0",
        silence_logs=50,
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="session", autouse=True)
def read_here():
    """Files are read in this process, where a test is not of the child that reads them, which takes
    half a second.

    Marked `apart` are tests of the child, and of files at which libraries may end the process.
    """
    of_child = apart._of_child

    def answered(job, seconds):
        if marks & {"apart", "deep", "slow"}:
            return of_child(job, seconds)
        # its readers' words go where they went before
        vtk = sys.modules.get("vtkmodules.vtkCommonCore")
        window = None if vtk is None else vtk.vtkOutputWindow.GetInstance()
        stream = BytesIO()
        with warnings.catch_warnings(action="ignore"):  # which nobody hears in a child
            apart._sent(stream, apart._answer(job))
        if window is not None:
            vtk.vtkOutputWindow.SetInstance(window)
        stream.seek(0)
        return apart._receive_answer(stream), 0

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(apart, "_of_child", answered)
        patch.setattr(apart, "limit_self", lambda *_: None)
        yield
