"""The front door: each mode is what its parts make, and so is a search by several runs."""

import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product

import numpy as np
import pytest
from shapes import distance, shaped
from states import ball, on_lattice
from test_labelled_cells import CASES as LABELS
from test_labelled_cells import labels_alone
from threads import assert_same_bits

import tetopt
from tetopt import Image, InputError, Sizes, lattice_mesh, mesh_image, optimize_paper
from tetopt.contents.content import plain
from tetopt.engine.aim import Aim, needed_corners
from tetopt.engine.meshing import search_mesh, sizes_of_order
from tetopt.errors import Note
from tetopt.geometry.quadratic import node_count
from tetopt.start.clip import lattice_within

IMAGE = tetopt.load_phantom("sphere").image(voxel_mm=4.0)
MASK = Image((IMAGE.data > 50).astype(np.uint8), IMAGE.affine)


def assert_same(result, expected):
    """To the last bit."""
    for one, other in (
        (result.mesh.points, expected.mesh.points),
        (result.mesh.cells, expected.mesh.cells),
    ):
        assert one.tobytes() == other.tobytes()
    assert result.ended == expected.ended


def masked_labels():
    image, mask = shaped("touching")
    labels = Image(np.rint(distance(image.shape, 0, 14, 16) / 5.0))
    return tetopt.content([image, Image(image.data**2)], labels, mask)


def noisy_ball():
    image = ball((48, 40, 44))
    noise = np.random.default_rng(0).normal(0.0, 3.0, image.shape)
    return Image(image.data + noise)


def from_lattice(optimize, k_D, iterations):
    image = ball((40, 44, 36))
    lattice = lattice_mesh(image, nodes=1500)
    return optimize(image, lattice, k_D=k_D, iterations=iterations)


def test_graded():
    result, initial = mesh_image(IMAGE, 200, iterations=4), tetopt.octree_mesh(IMAGE, 200)
    assert_same(result, tetopt.optimize(IMAGE, initial, nodes=200, k_D=0.85, iterations=4))
    assert result.initial.points.tobytes() == initial.points.tobytes()
    assert result.nodes == 200
    assert min(result.seconds_start, result.seconds_run) > 0.0


@pytest.mark.full
@pytest.mark.parametrize(
    "run",
    [
        lambda: from_lattice(tetopt.optimize, 0.4, 6),
        lambda: from_lattice(optimize_paper, 0.3, 4),
        lambda: mesh_image(noisy_ball(), 1500, iterations=4),
        lambda: mesh_image(labels_alone(LABELS["balls"]), 400, iterations=4),
        lambda: mesh_image(masked_labels(), 400, iterations=3),
    ],
    ids=["lattice", "paper", "octree", "labels", "labels and contrasts in a mask"],
)
def test_same_bits_on_any_number_of_threads(run):
    def arrays():
        result = run()
        rows = [row[:-1] for row in result.history]
        labels = [] if result.labels is None else result.labels
        return result.mesh.points, result.mesh.cells, labels, rows

    assert_same_bits(arrays)


@pytest.mark.full
def test_threads_of_python_mesh_at_once():
    """Each to the bits of a run alone; what nobody catches (`sys.unraisablehook`) stays the
    user's to see.
    """
    hook, counts = sys.unraisablehook, [150, 200, 150, 200]
    begin = threading.Barrier(len(counts))

    def meshed(nodes):
        begin.wait()
        return mesh_image(IMAGE, nodes, iterations=3)

    with ThreadPoolExecutor(len(counts)) as pool:
        results = list(pool.map(meshed, counts))
    alone = [mesh_image(IMAGE, nodes, iterations=3) for nodes in counts[:2]] * 2
    for result, expected in zip(results, alone, strict=True):
        assert_same(result, expected)
    assert sys.unraisablehook is hook


@pytest.mark.parametrize("mask", [None, MASK])
def test_uniform(mask):
    content = tetopt.content(IMAGE, mask=mask)
    options = {"iterations": 2, "shape_power": 2.0}
    result = mesh_image(content, 150, mode="uniform", kind="five-tet", **options)
    initial = lattice_within(content.image, content.region, "five-tet", nodes=150)
    assert_same(result, tetopt.optimize(content, initial, k_D=0.2, **options))


@pytest.mark.full
@pytest.mark.parametrize("n", [2, 3])
def test_nodes_of_order_2_are_counted_in_all(n):
    """Corners and midpoints together; the same run as with these corners and this longest edge
    from the start.
    """
    image = IMAGE if n == 3 else Image(IMAGE.data[15].copy(), np.diag([4.0, 4.0, 1.0]))
    nodes = 900 if n == 3 else 300
    result = mesh_image(image, nodes, order=2, iterations=16)
    mesh = result.mesh
    assert abs(node_count(mesh.points, mesh.cells, 2) - nodes) <= 0.01 * nodes
    assert result.nodes == nodes
    sizes = sizes_of_order(plain(image), nodes, None, 2)
    assert_same(mesh_image(image, len(mesh.points), sizes=sizes, iterations=16), result)


def test_a_lattice_for_order_2():
    """As near as the steps of lattices allow, over all runs."""
    mesh = mesh_image(IMAGE, 1200, mode="uniform", order=2, iterations=1).mesh
    assert len(mesh.points) < 250
    assert abs(node_count(mesh.points, mesh.cells, 2) / 1200 - 1.0) < 0.2


@pytest.mark.parametrize(
    ("options", "n_runs"),
    [
        ({"nodes": 700, "sizes": Sizes(longest=20.0)}, 1),
        ({"nodes": 3000, "sizes": Sizes(smallest=12.0)}, 1),
        ({"nodes": 1200, "mode": "uniform"}, 2),
        ({"target_error": 0.5, "sizes": Sizes(longest=6.0), "order": 1}, 1),
    ],
)
def test_no_run_is_repeated(options, n_runs):
    """Where limits on sizes, or the steps of lattices, make the same mesh of another number,
    within a mask as well.
    """
    seen = []
    image = tetopt.content(IMAGE, mask=MASK) if "target_error" in options else IMAGE

    def attempt(run, *_):
        seen.append(run())
        return seen[-1]

    result = search_mesh(image, Aim(**{"order": 2} | options), attempt, iterations=2)
    assert len(seen) == n_runs
    assert result.mesh.points.tobytes() == seen[-1].mesh.points.tobytes()


def test_longest_edge_of_order_2():
    """1.15 times that of a uniform mesh with the corners; a longest edge that is asked for
    stays, and so are the limits of order 1.
    """
    of_order = partial(sizes_of_order, plain(IMAGE), 1000)
    uniform = Sizes(coarsest=1.0).longest_edge(IMAGE, round(1000 / 7.2))
    own = of_order(None, 2)
    assert (own.longest, own.gradation) == (pytest.approx(1.15 * uniform), 0.5)
    assert of_order(Sizes(longest=9.0), 2).longest == 9.0
    assert of_order(None, 1) is None
    stated = of_order(Sizes(gradation=1.0, coarsest=1.4), 2)
    assert (stated.longest, stated.gradation) == (pytest.approx(1.4 * uniform), 1.0)


@pytest.mark.parametrize(
    ("order", "nodes_max", "n_runs"), [(1, 150, 1), (1, 260, 2), (2, 400, 2), (2, 950, 2)]
)
def test_a_search_ends_at_the_most_nodes(order, nodes_max, n_runs):
    """With their mesh, and the error that it leaves, if the target takes more; no run has more."""
    x, y = np.indices((120, 100))
    image = Image(10.0 * np.sin(x / 9.0) * np.cos(y / 8.0) + x)
    aim, needed, counts = Aim(target_error=0.001, order=order, nodes_max=nodes_max), [], []

    def attempt(run, _, aim, runs):
        needed.append(needed_corners(aim, runs))
        result = run()
        counts.append(node_count(result.mesh.points, result.mesh.cells, order))
        return result

    result = search_mesh(image, aim, attempt, iterations=3)
    assert len(needed) == n_runs
    assert all(each > len(result.mesh.points) for each in needed[1:])
    assert abs(counts[-1] / nodes_max - 1.0) <= (0.01 if order == 2 else 0.0)
    assert counts == sorted(counts)
    assert result.fraction > 0.001
    assert result.violated["error"].startswith(f"{result.fraction:.4g} of the image's variance is")
    if order == 1:
        assert_same(result, mesh_image(image, nodes_max, iterations=3))


def test_by_the_paper():
    options = {"iterations": 2, "n_t": 1}
    result = mesh_image(IMAGE, mode="paper", spacing=16.0, **options)
    lattice = lattice_mesh(IMAGE, spacing=16.0)
    assert_same(result, optimize_paper(IMAGE, lattice, k_D=0.2, **options))


def test_a_mesh_to_start_from():
    """Its boundary stays, unless it is told to slide."""
    start = lattice_mesh(IMAGE, nodes=100)
    for stated, options in (
        ({}, {"k_D": 0.02, "boundary": "fixed"}),
        ({"k_D": 0.5, "boundary": "slide"}, {"k_D": 0.5}),
    ):
        result = mesh_image(IMAGE, start=start, iterations=2, **stated)
        assert_same(result, tetopt.optimize(IMAGE, start, iterations=2, **options))


@pytest.mark.full
def test_a_search_by_several_runs():
    """Each run towards an error shows its initial mesh, and what it returns is what counts."""
    starts, rows = [], []

    def attempt(run, initial, *_):
        starts.append(initial)
        return run(callback=rows.append)

    result = search_mesh(IMAGE, Aim(target_error=0.2), attempt, iterations=3)
    assert_same(result, mesh_image(IMAGE, target_error=0.2, iterations=3))
    assert sum(row.iteration == 0 for row in rows) == len(starts) > 1
    assert any(initial is result.initial for initial in starts)
    assert_same(result, mesh_image(IMAGE, result.nodes, iterations=3))


LIMITS = {"target_error": 0.2, "nodes_max": 500}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"mode": "coarse"}, "graded, uniform, paper, start, got 'coarse'"),
        ({"nodes": 100, "order": 3}, "order 1 or 2, got 3"),
        ({"nodes": 100, "kind": "bcc"}, "takes nodes, target_error, nodes_max, sizes, not kind"),
        (
            {"nodes": 100, "mode": "uniform", "sizes": Sizes()},
            "takes nodes, spacing, kind, not sizes",
        ),
        ({"nodes": 100, "start": lattice_mesh(IMAGE, nodes=60)}, "takes start, not nodes"),
        ({"mode": "paper", "nodes": 100, "spacing": 5.0}, "only one of nodes and spacing"),
        ({"mode": "start"}, "a mesh to start from"),
        ({"nodes": 100, "nodes_max": 200}, "nodes_max needs target_error"),
        ({"nodes_max": 200}, "nodes_max needs target_error"),
        (LIMITS | {"nodes_max": 8}, "nodes_max: .* 9 or more in 3-D, got 8"),
        (LIMITS | {"nodes_max": 64, "order": 2}, "nodes_max: .* 65 or more in 3-D"),
        (LIMITS | {"sizes": Sizes(edge_size=9.0)}, r"nodes_max: .* \d+ nodes, got 500; "),
        (LIMITS | {"sizes": Sizes(longest=9.0)}, r"nodes_max: .* \d+ nodes, got 500"),
    ],
)
def test_contradictions(arguments, words):
    with pytest.raises(InputError, match=words):
        mesh_image(IMAGE, **arguments)


def test_the_paper_takes_one_image():
    with pytest.raises(InputError, match="one image"):
        mesh_image(tetopt.content(IMAGE, mask=MASK), 100, mode="paper")


@pytest.mark.parametrize(
    ("optimize", "options"),
    [
        *product(
            (tetopt.optimize, optimize_paper),
            ({"k_D": 1.0}, {"k_D": np.nan}, {"iterations": -1}, {"boundary": "free"}),
        ),
        *product(
            [tetopt.optimize],
            ({"shape_power": 0.9}, {"min_dihedral": 71.0}, {"nodes": 0}, {"nodes": 189.5}),
        ),
        *product([optimize_paper], ({"n_t": -1}, {"retessellate": "often"}, {"step_ratio": 0.0})),
    ],
)
def test_options_that_cannot_be(optimize, options):
    ((name, value),) = options.items()
    with pytest.raises(InputError, match=rf"{name}: expected .*, got '?{value}"):
        optimize(*on_lattice(ball((12, 10)), 2, 2), **options)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"node": 300}, "'node'; did you mean 'nodes'"),
        ({"nodes": 300, "iteration": 3}, "'iteration'; did you mean 'iterations'"),
        ({"nodes": 300, "mode": "paper", "shape_power": 3.0}, "'shape_power'"),
    ],
)
def test_an_argument_of_another_name_is_named(arguments, words):
    with pytest.raises(TypeError, match=f"^mesh_image.* {words}"):
        mesh_image(IMAGE, **arguments)


@pytest.mark.parametrize("target_error", [0.5, 0.9])
def test_a_search_that_ends_far_below_its_error_says_so(target_error):
    """The coarsest mesh explains most of a ramp; not if the error is met as nearly as it may be."""
    ramp = tetopt.Image(np.indices((12, 12, 12))[0] * 1.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = mesh_image(ramp, target_error=target_error, iterations=2)
    said = [each for each in caught if "far below" in str(each.message)]
    assert [each.category for each in said] == [Note] * (result.fraction < 0.85 * target_error)
    assert len(said) == 1
