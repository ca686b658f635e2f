"""Each program of the gallery, as it stands: it runs without a warning, leaves nothing, and
prints the number below.
"""

import contextlib
import io
import runpy
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import pyvista
from matplotlib import pyplot

import tetopt
from tetopt.io import formats

pytestmark = pytest.mark.deep

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
RESULT = EXAMPLES / "plot_calculix.frd"


# What a program computes: the variable, the form of its printing, what is printed, and how far it
# may be off.
NUMBERS = {
    "first_mesh": ("fraction", ".5f", "0.00061"),
    "ventricles": ("volume_ml", ".2f", "19.70"),
    "organ_from_mask": ("dice", ".4f", "0.9911"),
    "tissues_from_labels": ("white_dice", ".4f", "0.8473"),
    "nested_shells": ("volume", ".3f", "0.991"),
    "two_contrasts": ("worst", ".4f", "0.0050"),
    "target_error": ("needed", "d", "124"),
    "k_d": ("gain", ".1%", "50.5%"),
    "quadratic_cells": ("factor", ".2f", "7.72"),
    "calculix": ("largest_stress", ".2f", "2.31"),
    "scikit_fem": ("energy", ".2f", "17061.02"),
    "fenicsx": ("largest_kPa", ".2f", "7.71"),
    # its meshes are not the same everywhere
    "improve_pytetwild": ("remaining", ".2f", "0.30", 0.1),
    "elastography": ("contrast", ".2f", "3.72"),
    "own_phantom": ("volume_mm3", ".1f", "1184.0"),
    "other_libraries": ("volume_mm3", ".1f", "33727.4"),
    "fields_on_voxels": ("off_mm", ".4f", "0.0095"),
    "own_format": ("total_mN", ".1f", "409.6"),
    "slice_2d": ("left_of_lattice", ".3f", "0.243"),
}
PROGRAMS = sorted(path.stem.removeprefix("plot_") for path in EXAMPLES.glob("*.py"))


def test_every_program_has_its_number():
    """And its place in the gallery."""
    assert sorted(NUMBERS) == PROGRAMS


LONGEST = ("nested_shells", "tissues_from_labels")  # half a minute; `make docs` runs all


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name in LONGEST else ()) for name in PROGRAMS],
)
def test_program(name, tmp_path, monkeypatch, opengl):
    """Run in a folder with what lies beside it, the pictures drawn off screen."""
    names, printed = _run(name, tmp_path, monkeypatch)
    variable, form, expected, *tolerance = NUMBERS[name]
    value = format(names[variable], form)
    assert value in printed  # the page says it
    if tolerance:
        assert float(value) == pytest.approx(float(expected), abs=tolerance[0])
    else:  # meshes are the same bits everywhere, so that all digits are
        assert value == expected
    if name == "calculix":  # the kept result is of this mesh, whether or not ccx is here
        kept = tetopt.read_frd(RESULT, names["mesh"]).point_data
        assert np.abs(kept["displacement"] - names["displacement"]).max() < 1e-4
        assert np.abs(kept["von_mises_nodes"] - names["stress_kPa"]).max() < 1e-3


def _run(name, folder, monkeypatch):
    """The program's names, and what it prints."""
    beside = {
        path.name
        for path in EXAMPLES.iterdir()
        if path.suffix not in (".py", ".rst") and path.is_file()
    }
    for file in beside:
        shutil.copy(EXAMPLES / file, folder)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(pyvista, "OFF_SCREEN", True)
    monkeypatch.setattr(formats, "FORMATS", dict(formats.FORMATS))
    show, shown = pyvista.Plotter.show, []
    monkeypatch.setattr(
        pyvista.Plotter, "show", lambda *args, **look: shown.append(show(*args, **look))
    )
    output = io.StringIO()
    # Without a display VTK complains of the missing one before it renders off screen.
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(output),
        pyvista.vtk_verbosity("off"),
    ):
        warnings.simplefilter("error", UserWarning)
        warnings.simplefilter("error", RuntimeWarning)
        names = runpy.run_path(str(EXAMPLES / f"plot_{name}.py"))
    assert shown or pyplot.get_fignums(), "it draws no picture"
    pyplot.close("all")
    assert {path.name for path in folder.iterdir()} == beside
    return names, output.getvalue()
