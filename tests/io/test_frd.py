"""CalculiX's results come back onto the mesh: displacements are our own, and strains and
stresses follow from them.
"""

import re
import sys
from itertools import product

import numpy as np
import pytest
import pyvista_frd
from models import young_of
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal
from results import CASES, FOLDER, NU, our_displacement, solved_model

from tetopt import Mesh
from tetopt.geometry.quadratic import quadratic
from tetopt.io.frd import read_frd

PRINTED = 6e-6  # half a unit of the sixth digit, which is the last that CalculiX writes


def path_of(order):
    return FOLDER / f"order_{order}.frd"


def assert_printed(values, expected, digits=PRINTED):
    """Equal as far as printed: relative to the largest."""
    assert_allclose(values, expected, rtol=0.0, atol=digits * np.abs(expected).max())


def slopes_at(places, u, degree):
    """Derivatives (A, 3, 3), by component and axis, at places (A, 3) of the polynomial that is u
    (A, 3) there.
    """
    x = places - places.mean(axis=0)
    powers = np.array([p for p in product(range(degree + 1), repeat=3) if sum(p) <= degree])
    weights = np.linalg.solve((x[:, None] ** powers).prod(axis=2), u)
    lower = np.maximum(powers[:, None] - np.eye(3, dtype=int), 0)  # (powers, axis, 3)
    derivatives = powers * (x[:, None, None] ** lower).prod(axis=3)
    return np.einsum("apd,pc->acd", derivatives, weights)


def nodal_means(order, u):
    """Strain and stress (K, 9), kPa, at the nodes: the plain mean over the cells around, each of
    its own there.
    """
    model = solved_model(order)
    mesh = model.mesh
    points, cells = quadratic(mesh.points, mesh.cells) if order == 2 else (mesh.points, mesh.cells)
    sums, count = np.zeros((2, len(points), 3, 3)), np.zeros(len(points))
    for nodes, young in zip(cells, young_of(model), strict=True):
        slopes = slopes_at(points[nodes], u[nodes], order)
        strain = (slopes + np.swapaxes(slopes, 1, 2)) / 2
        pressure = NU / (1 - 2 * NU) * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        sums[:, nodes] += strain, young / (1 + NU) * (strain + pressure)
        count[nodes] += 1
    return (sums / count[:, None, None]).reshape(2, -1, 9)


@pytest.mark.parametrize("order", CASES)
def test_displacement_strain_and_stress_of_each_step(order):
    """Whatever the units and axes of the file; without a word on where they come from."""
    results = read_frd(path_of(order), solved_model(order).mesh)
    assert (results.order, results.notes) == (order, ())
    names = ["displacement", "strain_nodes", "stress_nodes", "von_mises_nodes"]
    n_steps = len(CASES[order][2])
    ends = ["", *(f"_step{step}" for step in range(2, n_steps + 1))]
    assert list(results.point_data) == [f"{name}{end}" for end in ends for name in names]
    for step, end in enumerate(ends, start=1):
        u, strain, stress, von_mises = (results.point_data[f"{name}{end}"] for name in names)
        expected = our_displacement(order, step)
        assert_printed(u, expected)
        strain_means, stress_means = nodal_means(order, expected)
        # its constants that extrapolate from the Gauss points have six digits
        digits = 2e-5 if order == 2 else PRINTED
        assert_printed(strain, strain_means, digits)
        assert_printed(stress, stress_means, digits)
        xx, xy, xz, _, yy, yz, _, _, zz = stress_means.T
        squares = (xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2 + 6 * (xy**2 + yz**2 + xz**2)
        assert_printed(von_mises, np.sqrt(squares / 2), 2e-5)
    assert n_steps == 3 - order


def test_a_binary_file_is_read_as_well(tmp_path):
    pyvista_frd.convert(path_of(1), tmp_path / "b.frd", binary=True)
    text, binary = (
        read_frd(path, solved_model(1).mesh) for path in (path_of(1), tmp_path / "b.frd")
    )
    assert list(binary.point_data) == list(text.point_data)
    for name, values in text.point_data.items():
        assert_allclose(binary.point_data[name], values, rtol=1e-12, atol=1e-15)


def test_of_increments_the_last_is_taken(tmp_path):
    text = path_of(1).read_text().replace("           1           2 ", "           2           1 ")
    (tmp_path / "a.frd").write_text(text)
    results = read_frd(tmp_path / "a.frd", solved_model(1).mesh)
    assert results.notes == ("step 1: increment 2, the last in the file",)
    assert_printed(results.point_data["displacement"], our_displacement(1, 2))
    assert "displacement_step2" not in results.point_data


def test_what_the_head_does_not_say_is_assumed(tmp_path):
    """Stresses in kPa; the axes are those that fit."""
    (tmp_path / "a.frd").write_text(re.sub("1Utetopt; [^\n]*", "1Utest", path_of(2).read_text()))
    results, known = (
        read_frd(path, solved_model(2).mesh) for path in (tmp_path / "a.frd", path_of(2))
    )
    assert results.notes == ("a.frd does not state its units: assuming mm and kPa",)
    assert_array_equal(results.point_data["displacement"], known.point_data["displacement"])
    assert_allclose(
        1e3 * results.point_data["stress_nodes"], known.point_data["stress_nodes"], rtol=1e-12
    )


def refused(tmp_path, words, text=None, mesh=None):
    path = tmp_path / "a.frd"
    path.write_text(path_of(1).read_text() if text is None else text)
    with refusal(words) as caught:
        read_frd(path, solved_model(1).mesh if mesh is None else mesh)
    assert str(path) in str(caught.value)


def test_results_of_another_mesh_are_refused(tmp_path):
    mesh = solved_model(1).mesh
    other = Mesh(mesh.points * [1.0, 1.0, 1.001], mesh.cells)
    refused(
        tmp_path,
        "belongs to another mesh: 14 of 14 nodes are displaced by up to 0.121 mm",
        mesh=other,
    )
    refused(
        tmp_path,
        "expected 5 cells and 8 nodes .order 2: 26., got 24 cells and 14 nodes",
        mesh=solved_model(2).mesh,
    )
    refused(tmp_path, "expected 23 cells and 14 nodes", mesh=Mesh(mesh.points, mesh.cells[:-1]))
    refused(
        tmp_path, "its nodes are connected differently", mesh=Mesh(mesh.points, mesh.cells[::-1])
    )
    numbers = path_of(1).read_text().replace(" -1        14", " -1        99")
    refused(
        tmp_path, "its nodes are not numbered from 1 to 14", re.sub(r"(?<=\s)14\b", "99", numbers)
    )
    plane = Mesh([[0.0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    refused(
        tmp_path, "expected a tetrahedral mesh for CalculiX's results, got triangles", mesh=plane
    )


def test_files_without_whole_results_are_refused(tmp_path):
    text = path_of(1).read_text()
    refused(tmp_path, "expected CalculiX's results", "")
    refused(tmp_path, "expected CalculiX's results", "*NODE\n")
    refused(tmp_path, "the file is truncated; is CalculiX still running", text[: len(text) // 2])
    refused(tmp_path, "the file is truncated", text.replace(" 9999", ""))
    refused(tmp_path, "has no results", text[: text.index("    1PSTEP")] + " 9999\n")
    refused(tmp_path, "has no displacements in step 1; request U", text.replace("DISP  ", "DISPR "))
    refused(
        tmp_path,
        "has results at 13 of 14 nodes in step 1",
        text.replace("          14    ", "          13    "),
    )
    refused(tmp_path, "DISP of step 1 is not finite at some nodes", _nan(text))
    with refusal("no such file"):
        read_frd(tmp_path / "b.frd", solved_model(1).mesh)


def _nan(text):
    """The text with no number in the first line of results."""
    start = text.index(" -1 ", text.index("DISP"))
    return f"{text[: start + 13]}{'NaN':>12}{text[start + 25 :]}"


def test_without_the_reader_it_is_said_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista_frd", None)
    with refusal(r'pip install "pyvista-frd-reader(>=[0-9.]+)?"'):
        read_frd(path_of(1), solved_model(1).mesh)
