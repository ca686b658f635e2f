"""States of the fast engine for its tests: small images, random meshes, moves, and what must
hold after them.
"""

import numpy as np
from hypothesis import assume
from meshes import delaunay_box

import tetopt
from tetopt.contents.content import plain
from tetopt.energy.sampling import channel_grid, from_ticks
from tetopt.engine.complex import build, energies, node_stars, remeasure
from tetopt.engine.flips import flip
from tetopt.engine.repair import repair
from tetopt.engine.smooth import blocks, sweep
from tetopt.engine.state import state_of, with_min_dihedral

OBLIQUE = np.array(
    [[0.9, 0.3, 0.2, -7.0], [-0.25, 1.1, 0.1, 3.0], [0.0, 0.4, -2.5, 11.0], [0.0, 0.0, 0.0, 1.0]]
)


def ball(shape, affine=None):
    index = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, s) for s in shape], indexing="ij"), -1)
    data = 100.0 * ((index**2).sum(-1) < 0.4) + 5.0 * index[..., 0] + np.round(3.0 * index[..., -1])
    return tetopt.Image(data, affine)


def on_lattice(image, *blocks):
    """An image and a lattice of so many blocks along each axis."""
    return image, tetopt.lattice_mesh(image, blocks=blocks)


CASES = {
    "2-D": on_lattice(ball((40, 30)), 6, 5),
    "3-D": on_lattice(ball((24, 20, 22)), 4, 3, 4),
    "oblique": on_lattice(ball((24, 20, 10), OBLIQUE), 4, 4, 4),
}


class Engine:
    """A state of an image and a mesh, and the engine's moves."""

    def __init__(self, image, mesh, k_D=0.5, power=3.0, is_graded=False):
        self.image, self.n = image, image.ndim
        self.grid = channel_grid(plain(image), mesh.points)
        self.state = state_of(plain(image), mesh, self.grid, k_D, power, is_graded=is_graded)

    @property
    def complex(self):
        return self.state.complex

    @property
    def objective(self):
        return self.state.objective

    @property
    def cells(self):
        return self.complex.cells[: int(self.complex.n_cells[0])]

    @property
    def E(self):
        E_G, squares = energies(self.state)
        return self.objective.geometry * E_G + self.objective.image * squares

    @property
    def mesh(self):
        return tetopt.Mesh(
            self.image.to_world(from_ticks(self.complex.ticks, self.grid, self.n)), self.cells
        )

    def change(self, **parts):
        """Replace arrays of the complex, or numbers of the objective."""
        arrays = {name: parts.pop(name) for name in list(parts) if name in self.complex._fields}
        self.state = self.state._replace(
            complex=self.complex._replace(**arrays), objective=self.objective._replace(**parts)
        )

    def keep_min_dihedral(self, degrees):
        self.state = with_min_dihedral(self.state, degrees)

    def fresh(self, cells=None):
        """The state of the mesh, or of other cells, measured from nothing."""
        cells = self.cells if cells is None else cells
        return build(
            cells, self.complex.ticks, self.complex.is_frozen, self.objective, self.state.sides
        )

    def sweep(self):
        everyone = np.ones(len(self.complex.ticks), dtype=bool)
        sweep(self.state, node_stars(self.state), blocks(self.complex.ticks), everyone)

    def flip(self, passes=50):
        self.state, n_flips = flip(self.state, passes=passes)
        return n_flips

    def repair(self, degrees, is_over=lambda: False):
        repaired = repair(self.state, degrees, is_over)
        self.state = repaired.state
        return repaired

    def remeasure(self):
        remeasure(self.state)

    def assert_sound(self):
        """A mesh of the box; neighbours, fluxes, sums and shapes as if measured afresh; every
        voxel in one cell.
        """
        assert tetopt.check_mesh(self.mesh, self.image) == []
        fresh, n_cells = self.fresh().complex, len(self.cells)
        for name in ("across", "fluxes", "sums", "E_shape"):
            np.testing.assert_array_equal(
                getattr(self.complex, name)[:n_cells], getattr(fresh, name)[:n_cells], name
            )
        assert self.complex.sums[:n_cells, 0].sum() == self.image.data.size


def random_case(seed, n, affine=None, power=3.0, k_D=0.5):
    """Noise on a few voxels, and a random mesh of them. InputError if that has a cell too flat."""
    rng = np.random.default_rng(seed)
    shape = (14, 12, 11)[:n]
    image = tetopt.Image(rng.integers(0, 50, shape), affine)
    index, cells = delaunay_box(rng, shape, 12 if n == 2 else 25)
    points = image.to_world(index)
    if affine is not None and np.linalg.det(affine[:-1, :-1]) < 0:
        cells = cells[:, [1, 0, *range(2, n + 1)]]
    return Engine(image, tetopt.Mesh(points, cells), k_D, power)


def assumed_case(*arguments):
    """`random_case` for hypothesis: a flat cell to begin with has no shape energy, and is not
    taken.
    """
    try:
        return random_case(*arguments)
    except tetopt.InputError as error:
        assume("flat" not in str(error))
        raise
