"""Every public function of a mesh and an image, on meshes that are none: an answer or one
refusal, never garbage.
"""

import inspect

import numpy as np
import pytest

import tetopt
from tetopt.energy.sampling import cell_moments_and_ranges, overlap_of
from tetopt.fem.reference import compare, reference
from tetopt.image import Image
from tetopt.mesh import Mesh
from tetopt.model.averages import cell_values, cell_young, element_young, node_young


def image_of(n):
    """A bright half, on an affine that is not the identity."""
    data = np.where(np.arange(8) < 4, 20.0, 100.0) * np.ones((8,) * n) + np.arange(8)
    return Image(data, np.diag([2.0] * n + [1.0]))


def joined(one, other):
    return Mesh(
        np.vstack([one.points, other.points]), np.vstack([one.cells, other.cells + len(one.points)])
    )


def moved(mesh, by):
    return Mesh(mesh.points + by, mesh.cells)


def folded(mesh):
    """With cells on the other side of a facet as well: each is mirrored across its first one."""
    n, cells = mesh.ndim, mesh.cells[:3]
    corners = mesh.points[cells]
    apex = corners[:, 1:].mean(axis=1) + 0.7 * (corners[:, 0] - corners[:, 1:].mean(axis=1))
    added = np.column_stack([len(mesh.points) + np.arange(3), cells[:, 1:]])
    assert n + 1 == added.shape[1]
    return Mesh(np.vstack([mesh.points, apex]), np.vstack([mesh.cells, added]))


def unusual(n):
    """Meshes by name; all but "far" and "part" lie over themselves somewhere."""
    mesh = tetopt.lattice_mesh(image_of(n), blocks=(2,) * n)
    half = Mesh(mesh.points, mesh.cells[: len(mesh.cells) // 2])
    return {
        "shifted": joined(mesh, moved(mesh, 1.3)),
        "thrice": joined(mesh, joined(moved(mesh, 0.6), moved(mesh, -0.6))),
        "doubled cell": Mesh(mesh.points, np.vstack([mesh.cells, mesh.cells[:1]])),
        "folded": folded(mesh),
        "far": joined(mesh, moved(mesh, 500.0)),
        "part": moved(half, 3.1),
        "beside": moved(mesh, 900.0),
    }


pytestmark = [pytest.mark.full, pytest.mark.filterwarnings("error::RuntimeWarning")]
CASES = [(n, name) for n in (2, 3) for name in unusual(2)]


@pytest.mark.kernel
@pytest.mark.parametrize(("n", "name"), CASES)
def test_a_voxel_is_the_first_cell_s_that_holds_it(n, name):
    image, mesh = image_of(n), unusual(n)[name]
    parts = [Mesh(mesh.points[cell], np.arange(n + 1)[None]) for cell in mesh.cells]
    alone = np.array([tetopt.cell_of_voxel(image, part) == 0 for part in parts])
    count = alone.sum(axis=0)
    first = np.where(count > 0, alone.argmax(axis=0), -1)
    np.testing.assert_array_equal(tetopt.cell_of_voxel(image, mesh), first)
    moments, (low, high) = cell_moments_and_ranges(image, mesh)
    np.testing.assert_array_equal(moments.n_voxels, alone.sum(axis=tuple(range(1, n + 1))))
    for cell in np.flatnonzero(moments.n_voxels):
        h = image.data[alone[cell]]
        assert (low[cell], high[cell]) == (h.min(), h.max())

    overlap = overlap_of(image, mesh)
    assert (overlap is None) == (count <= 1).all() == (name in ("far", "part", "beside"))
    if overlap is not None:
        one, other = overlap.cells
        assert one < other
        assert alone[[one, other]][(slice(None), *overlap.voxel)].all()
        assert overlap.n_voxels == (count > 1).sum()
        assert f"cells {one} and {other} both contain voxel {list(overlap.voxel)}" in str(overlap)


def numbers_of(value):
    """All arrays of numbers in an answer."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        yield value
    elif isinstance(value, Image):
        yield value.data
    elif isinstance(value, dict):
        for each in value.values():
            yield from numbers_of(each)
    elif isinstance(value, list | tuple) and not hasattr(value, "mesh"):
        for each in value:
            yield from numbers_of(each)
    elif isinstance(value, int | float):
        yield np.array(value)


def labels_of(image):
    return Image(image.data > 60.0, image.affine)


def errors_on(image, mesh):
    exact = reference(Image(1.0 + image.data, image.affine), 0.3)
    return compare(exact, mesh, np.zeros(mesh.points.shape), 1.0, labels_of(image).data)


def of_label(function):
    """A function of labels, a mesh, and other labels of its cells."""
    return lambda image, mesh: function(labels_of(image), mesh, np.arange(len(mesh.cells)) % 2)


WITH_IMAGE = {
    "E_D": tetopt.E_D,
    "cell_fields": lambda image, mesh: tetopt.cell_fields(mesh, image),
    "field_on_image": lambda image, mesh: tetopt.field_on_image(
        mesh, mesh.points, image, at="nodes", outside=0.0
    ),
    "warped_image": lambda image, mesh: tetopt.warped_image(mesh, 0.0 * mesh.points, image),
    "cell_field": lambda image, mesh: tetopt.cell_field(image, mesh),
    "cell_labels": lambda image, mesh: tetopt.cell_labels(labels_of(image), mesh),
    "cell_moments": tetopt.cell_moments,
    "cell_of_voxel": tetopt.cell_of_voxel,
    "check_mesh": lambda image, mesh: tetopt.check_mesh(mesh, image),
    "label_contacts": of_label(tetopt.label_contacts),
    "label_fidelity": lambda image, mesh: tetopt.label_fidelity(labels_of(image), mesh),
    "label_interfaces": of_label(tetopt.label_interfaces),
    "mask_fidelity": lambda image, mesh: tetopt.mask_fidelity(labels_of(image), mesh),
    "mesh_image": lambda image, mesh: tetopt.mesh_image(image, start=mesh, iterations=1),
    "build_model": lambda image, mesh: tetopt.build_model(mesh, image, young=3.0),
    "optimize": lambda image, mesh: tetopt.optimize(image, mesh, iterations=1),
    "optimize_paper": lambda image, mesh: tetopt.optimize_paper(image, mesh, iterations=1),
    "segment": lambda image, mesh: tetopt.segment(image, mesh, 2),
}
MORE = {
    "label_thickness": lambda image, mesh: [
        each[:2]  # a label without a voxel in its cells has no edge
        for each in tetopt.label_thickness(
            tetopt.content(image, labels_of(image)), mesh, np.arange(len(mesh.cells)) % 2
        ).values()
    ],
    "labelled": lambda image, mesh: tetopt.optimize(
        tetopt.content(image, labels_of(image)), mesh, iterations=3, nodes=len(mesh.points)
    ),
    "masked": lambda image, mesh: tetopt.optimize(
        tetopt.content(image, mask=labels_of(image)), mesh, iterations=1
    ),
    "cell_young": cell_young,
    "node_young": node_young,
    "element_young": lambda image, mesh: element_young(image, mesh, average="gauss", order=2),
    "cell_values": lambda image, mesh: cell_values(image, mesh, lambda h: h - 50.0),
    "compare": errors_on,
}


def test_no_public_function_is_left_out():
    functions = {name: getattr(tetopt, name) for name in tetopt.__all__}
    known = {"start", "mesh"}, {"image", "labels", "mask"}
    taking = {
        name
        for name, function in functions.items()
        if inspect.isfunction(function)
        and all(kind & {*inspect.signature(function).parameters} for kind in known)
    }
    assert taking == set(WITH_IMAGE)


@pytest.mark.parametrize(
    ("n", "name"), [*CASES[: len(CASES) // 2], (3, "shifted"), (3, "folded"), (3, "part")]
)
@pytest.mark.parametrize("function", [*WITH_IMAGE, *MORE])
def test_an_answer_or_one_refusal(function, n, name):
    """Nan stands for what is not there, such as a distance from no surface; no other number is
    not finite.
    """
    image, mesh = image_of(n), unusual(n)[name]
    said, answer = "", None
    try:
        answer = (WITH_IMAGE | MORE)[function](image, mesh)
    except tetopt.InputError as error:
        said = str(error)
    assert answer is not None or len(said) > 20
    assert "\n" not in said
    for values in numbers_of(answer):
        assert not np.isinf(values).any()
        assert np.isfinite(values).all() or function.endswith(("fidelity", "interfaces"))
