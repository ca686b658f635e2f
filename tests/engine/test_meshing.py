"""The front door: each mode is what its parts make, and so is a search by several runs."""

import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import tetopt
from tetopt.contents.content import plain
from tetopt.engine.aim import Aim, needed_corners
from tetopt.engine.meshing import search_mesh, sizes_of_order
from tetopt.geometry.quadratic import node_count, quadratic
from tetopt.start.clip import lattice_within

IMAGE = tetopt.load_phantom("sphere").image(voxel_mm=4.0)
MASK = tetopt.Image((IMAGE.data > 50).astype(np.uint8), IMAGE.affine)


def assert_same(result, expected):
    assert result.mesh.points.tobytes() == expected.mesh.points.tobytes()
    assert result.mesh.cells.tobytes() == expected.mesh.cells.tobytes()
    assert result.ended == expected.ended


def test_graded():
    result, initial = tetopt.mesh_image(IMAGE, 200, iterations=4), tetopt.octree_mesh(IMAGE, 200)
    assert_same(result, tetopt.optimize(IMAGE, initial, nodes=200, k_D=0.85, iterations=4))
    assert result.initial.points.tobytes() == initial.points.tobytes()
    assert result.nodes == 200
    assert min(result.seconds_start, result.seconds_run) > 0.0


@pytest.mark.full
def test_threads_of_python_mesh_at_once():
    """Each to the bits of a run alone; what nobody catches (`sys.unraisablehook`) stays the
    user's to see.
    """
    hook, nodes = sys.unraisablehook, [150, 200, 150, 200]
    begin = threading.Barrier(len(nodes))

    def meshed(number):
        begin.wait()
        return tetopt.mesh_image(IMAGE, number, iterations=3)

    with ThreadPoolExecutor(len(nodes)) as pool:
        results = list(pool.map(meshed, nodes))
    for number, result in zip(nodes, results, strict=True):
        assert_same(result, tetopt.mesh_image(IMAGE, number, iterations=3))
    assert sys.unraisablehook is hook


@pytest.mark.parametrize("mask", [None, MASK])
def test_uniform(mask):
    image = IMAGE if mask is None else tetopt.content(IMAGE, mask=mask)
    result = tetopt.mesh_image(
        image, 150, mode="uniform", kind="five-tet", iterations=2, shape_power=2.0
    )
    region = None if mask is None else image.region
    initial = lattice_within(IMAGE if mask is None else image.image, region, "five-tet", nodes=150)
    assert_same(result, tetopt.optimize(image, initial, k_D=0.2, iterations=2, shape_power=2.0))


@pytest.mark.full
@pytest.mark.parametrize("n", [2, 3])
def test_nodes_of_order_2_are_counted_in_all(n):
    """Corners and midpoints together; the same run as with these corners and this longest edge
    from the start.
    """
    image = IMAGE if n == 3 else tetopt.Image(IMAGE.data[15].copy(), np.diag([4.0, 4.0, 1.0]))
    nodes = 900 if n == 3 else 300
    result = tetopt.mesh_image(image, nodes, order=2, iterations=16)
    points, cells = result.mesh.points, result.mesh.cells
    assert abs(len(quadratic(points, cells)[0]) - nodes) <= 0.01 * nodes
    assert result.nodes == nodes
    sizes = sizes_of_order(plain(image), nodes, None, 2)
    assert_same(tetopt.mesh_image(image, len(points), sizes=sizes, iterations=16), result)


def test_a_lattice_for_order_2():
    """As near as the steps of lattices allow, over all runs."""
    result = tetopt.mesh_image(IMAGE, 1200, mode="uniform", order=2, iterations=1)
    assert len(result.mesh.points) < 250
    assert abs(len(quadratic(result.mesh.points, result.mesh.cells)[0]) / 1200 - 1.0) < 0.2


@pytest.mark.parametrize(
    ("options", "n_runs"),
    [
        ({"nodes": 700, "sizes": tetopt.Sizes(longest=20.0)}, 1),
        ({"nodes": 3000, "sizes": tetopt.Sizes(smallest=12.0)}, 1),
        ({"nodes": 1200, "mode": "uniform"}, 2),
        ({"target_error": 0.5, "sizes": tetopt.Sizes(longest=6.0), "order": 1}, 1),
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
    stays.
    """
    content = plain(IMAGE)
    uniform = tetopt.Sizes(coarsest=1.0).longest_edge(IMAGE, round(1000 / 7.2))
    assert sizes_of_order(content, 1000, None, 2).longest == pytest.approx(1.15 * uniform)
    assert sizes_of_order(content, 1000, None, 2).gradation == 0.5
    assert sizes_of_order(content, 1000, tetopt.Sizes(longest=9.0), 2).longest == 9.0
    assert sizes_of_order(content, 1000, None, 1) is None
    # those of order 1, asked for
    stated = sizes_of_order(content, 1000, tetopt.Sizes(gradation=1.0, coarsest=1.4), 2)
    assert stated.gradation == 1.0
    assert stated.longest == pytest.approx(1.4 * uniform)
    with pytest.raises(tetopt.InputError, match="expected order 1 or 2, got 3"):
        tetopt.mesh_image(IMAGE, 100, order=3)


@pytest.mark.parametrize(
    ("order", "nodes_max", "n_runs"), [(1, 150, 1), (1, 260, 2), (2, 400, 2), (2, 950, 2)]
)
def test_a_search_ends_at_the_most_nodes(order, nodes_max, n_runs):
    """With their mesh, and the error that it leaves, if the target takes more; no run has more."""
    x, y = np.indices((120, 100))
    image = tetopt.Image(10.0 * np.sin(x / 9.0) * np.cos(y / 8.0) + x)
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
        assert_same(result, tetopt.mesh_image(image, nodes_max, iterations=3))


def test_by_the_paper():
    result = tetopt.mesh_image(IMAGE, mode="paper", spacing=16.0, iterations=2, n_t=1)
    lattice = tetopt.lattice_mesh(IMAGE, spacing=16.0)
    assert_same(result, tetopt.optimize_paper(IMAGE, lattice, k_D=0.2, iterations=2, n_t=1))


def test_a_mesh_to_start_from():
    """Its boundary stays, unless it is told to slide."""
    start = tetopt.lattice_mesh(IMAGE, nodes=100)
    assert_same(
        tetopt.mesh_image(IMAGE, start=start, iterations=2),
        tetopt.optimize(IMAGE, start, k_D=0.02, iterations=2, boundary="fixed"),
    )
    slid = tetopt.mesh_image(IMAGE, start=start, k_D=0.5, iterations=2, boundary="slide")
    assert_same(slid, tetopt.optimize(IMAGE, start, k_D=0.5, iterations=2))


@pytest.mark.full
def test_a_search_by_several_runs():
    """Each run towards an error shows its initial mesh, and what it returns is what counts."""
    starts, rows = [], []

    def attempt(run, initial, *_):
        starts.append(initial)
        return run(callback=rows.append)

    result = search_mesh(IMAGE, Aim(target_error=0.2), attempt, iterations=3)
    assert_same(result, tetopt.mesh_image(IMAGE, target_error=0.2, iterations=3))
    assert sum(row.iteration == 0 for row in rows) == len(starts) > 1
    assert any(initial is result.initial for initial in starts)
    assert_same(result, tetopt.mesh_image(IMAGE, result.nodes, iterations=3))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"mode": "coarse"}, "expected mode graded, uniform, paper, start, got 'coarse'"),
        ({"nodes": 100, "kind": "bcc"}, "takes nodes, target_error, nodes_max, sizes, not kind"),
        (
            {"nodes": 100, "mode": "uniform", "sizes": tetopt.Sizes()},
            "takes nodes, spacing, kind, not sizes",
        ),
        ({"nodes": 100, "start": tetopt.lattice_mesh(IMAGE, nodes=60)}, "takes start, not nodes"),
        ({"mode": "paper", "nodes": 100, "spacing": 5.0}, "give only one of nodes and spacing"),
        ({"mode": "start"}, "requires a mesh to start from"),
        ({"nodes": 100, "nodes_max": 200}, "nodes_max needs target_error"),
        ({"nodes_max": 200}, "nodes_max needs target_error"),
        (
            {"target_error": 0.2, "nodes_max": 8},
            "nodes_max: expected a whole number, 9 or more in 3-D, got 8",
        ),
        (
            {"target_error": 0.2, "nodes_max": 64, "order": 2},
            "nodes_max: expected a whole number, 65 or more in 3-D",
        ),
        (
            {"target_error": 0.2, "nodes_max": 500, "sizes": tetopt.Sizes(edge_size=9.0)},
            r"nodes_max: sizes require about \d+ nodes, got 500; allow as many, or larger cells",
        ),
        (
            {"target_error": 0.2, "nodes_max": 500, "sizes": tetopt.Sizes(longest=9.0)},
            r"nodes_max: sizes require about \d+ nodes, got 500",
        ),
    ],
)
def test_contradictions(arguments, words):
    with pytest.raises(tetopt.InputError, match=words):
        tetopt.mesh_image(IMAGE, **arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"node": 300}, "'node'; did you mean 'nodes'"),
        ({"nodes": 300, "iteration": 3}, "'iteration'; did you mean 'iterations'"),
        ({"nodes": 300, "mode": "paper", "shape_power": 3.0}, "'shape_power'"),
    ],
)
def test_an_argument_of_another_name_is_named(arguments, words):
    with pytest.raises(
        TypeError, match=f"^mesh_image.* got an unexpected keyword argument {words}"
    ):
        tetopt.mesh_image(tetopt.Image(np.zeros((8, 8, 8))), **arguments)


def test_the_paper_takes_one_image():
    with pytest.raises(tetopt.InputError, match="one image, without labels or mask"):
        tetopt.mesh_image(tetopt.content(IMAGE, mask=MASK), 100, mode="paper")
