"""Runs in parts for their tests, with what went into each part and what came of it."""

from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np

import tetopt
from tetopt.engine.loop import GRADED_ITERATIONS, GRADED_K_D
from tetopt.parts.part import work_on
from tetopt.parts.rounds import PartsRequest, mesh_in_parts
from tetopt.parts.work import done_path, load_arrays, save_volume

# Oblique, sheared, anisotropic and mirrored.
SKEW = np.array(
    [[-0.9, 0.3, 0.2, -7.0], [-0.25, 1.1, 0.1, 3.0], [0.0, 0.4, 1.6, 11.0], [0.0, 0.0, 0.0, 1.0]]
)


def balls(shape, affine=None, seed=3):
    """Two balls of whole numbers, and a little noise."""
    index = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, s) for s in shape], indexing="ij"), -1)
    large, small = (
        np.linalg.norm(index - place, axis=-1) for place in ([0.0, 0.0, 0.0], [0.2, 0.1, -0.1])
    )
    data = 100 * (large < 0.75) + 60 * (small < 0.35)
    return tetopt.Image(data + np.random.default_rng(seed).integers(0, 9, shape), affine)


def shared_nodes(mesh):
    """Nodes of more than one part, (N,)."""
    first = np.full(len(mesh.ticks), -1, dtype=np.int64)
    first[mesh.cells.ravel()] = np.repeat(mesh.part, mesh.cells.shape[1])
    is_shared = np.zeros(len(mesh.ticks), dtype=bool)
    other = first[mesh.cells] != mesh.part[:, None]
    is_shared[mesh.cells[other]] = True
    return is_shared


class Recorded(NamedTuple):
    """What went into a part, and what came of it."""

    before: dict
    text: dict
    after: dict
    numbers: dict


def request(nodes, n_parts, **changes):
    asked_for = PartsRequest(
        nodes, n_parts, GRADED_K_D, GRADED_ITERATIONS, 3.0, 12.0, 5e-4, None, "of this test"
    )
    return asked_for._replace(**changes)


def recording(rounds):
    """A runner of parts one after the other, and what it keeps of each by round."""

    def runner(names):
        rounds.append([])
        for name in names:
            yield work_on(name)
            rounds[-1].append(
                Recorded(*load_arrays(Path(name)), *load_arrays(done_path(Path(name))))
            )

    return runner


@contextmanager
def one_thread():
    """Kernels on one thread: on parts as small as those of tests others are a hindrance."""
    number = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(number)


def recorded_run(folder, image, asked_for):
    """A run in parts, and its parts by round."""
    save_volume(folder, image)
    rounds = []
    return mesh_in_parts(asked_for, folder, crew=lambda *_: nullcontext(recording(rounds))), rounds
