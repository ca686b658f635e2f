"""The model: a mesh with everything that a solver needs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tetopt.errors import InputError
from tetopt.geometry.quadratic import of_order, quadratic_facet_nodes
from tetopt.interop import conversions, notebook
from tetopt.interop.conversions import MESHIO_KINDS, VTK_KINDS
from tetopt.mesh import Mesh
from tetopt.model.fields import (
    GAUSS_MODULI,
    HALF_TURN,
    KINDS_TEXT,
    NODE_MODULI,
    field_kinds,
    half_turned_fields,
    node_field,
    scaled_fields,
)
from tetopt.model.label_names import TABLE_TEXT, labels_of, table_of_words
from tetopt.model.loads import FACET_FORCES, SHOWN_LOAD_DIGITS, Load, facet_forces, load_words
from tetopt.model.mappings import MODULUS_UNITS
from tetopt.model.materials import Materials, scale_moduli
from tetopt.model.sets import Sets, facet_triples, label_set_names
from tetopt.model.skfem import skfem_mesh
from tetopt.system.arrays import Arrays, Floats, Ints, Json

if TYPE_CHECKING:
    import meshio
    import pyvista
    import skfem


class Units(NamedTuple):
    """A consistent system of units with s."""

    kPa: float  # per unit of stress
    length: str
    mm: float  # per unit of length
    force: str
    energy: str
    mass: str
    water: float  # density


STRESS_UNITS = {
    "kPa": Units(MODULUS_UNITS["kPa"], "mm", 1.0, "mN", "uJ", "kg", 1e-6),
    "MPa": Units(MODULUS_UNITS["MPa"], "mm", 1.0, "N", "mJ", "t", 1e-9),
    "Pa": Units(MODULUS_UNITS["Pa"], "m", 1e3, "N", "J", "kg", 1e3),
}
WATER_DENSITY = 1000.0  # kg/m3
# Values a thousand times off from any tissue are most likely in another unit. Soft tissue has 0.1
# to a few hundred kPa: in Pa it lies within the first range, where otherwise only cartilage does,
# and in MPa it lies below the third number.
PASCAL_RANGE = (1e3, 1e5)
MEGAPASCAL_MOST = 0.05
NAME_UNIT = 'if it is in another unit, name it, as in `young` "3.5 kPa"'
GRAM_DENSITY_MOST = 20.0  # kg/m3: gold has about this many g/cm3, and only gases have so few kg/m3
# mm/s2: from the moon's to ten times the earth's gravity if taken as m/s2
METRE_GRAVITY = (1.0, 100.0)
# above this, linear cells are far worse than quadratic ones, see docs/understand/order.md
LOCKING_NU = 0.45
SPACES = ("ras", "lps")  # conventions of the world's axes
# prefixes of data that are 1 on the nodes of a facet set, in the cells of a set
ON_PREFIX, IN_PREFIX = "on_", "in_"


class Model(NamedTuple):
    """A mesh with everything that is written for a solver.

    Parameters
    ----------
    mesh : Mesh
        Points in mm, with `units` "Pa" in m, in the axes of `space`.
    cell_data : dict of arrays
        By name, one row per cell.
    sets : Sets
        Sets of facets and cells, by name.
    materials : Materials, optional
        The distinct materials, and the material of each cell.
    loads : tuple of Load
        Supports, displacements, pressures, tractions, springs, gravity.
    order : {1, 2}
        2: quadratic cells, with straight edges unless the mesh has midpoints, see
        `tetopt.geometry.quadratic`.
    units : {"kPa", "MPa", "Pa"}
        Unit of moduli and pressures, see `STRESS_UNITS`.
    space : {"ras", "lps"}
        "lps": the signs of x and y are reversed.
    node_young : (N,) float64, optional
        A modulus at each corner, linear within cells, instead of those of the materials.
    gauss_young : (M, Q) float64, optional
        A modulus at each Gauss point of the order, for `tetopt.fem`.
    is_nonlinear : bool
        True if steps are solved with large deformation.
    about : dict
        Strings, or values in JSON's types, by name, for the file's header.
    point_data : dict of arrays
        By name, one row per mesh point, or per node of order 2.

    Examples
    --------
    >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
    >>> mesh = tetopt.lattice_mesh(image, nodes=300)
    >>> loads = ["hold:inferior", "pressure:superior:0.1"]
    >>> model = tetopt.build_model(mesh, image, young="0.1*h", nu=0.45, loads=loads)
    >>> len(model.materials.young), [load.kind for load in model.loads]
    (21, ['displacement', 'pressure'])
    """

    mesh: Mesh
    cell_data: Arrays
    sets: Sets
    materials: Materials | None = None
    loads: tuple[Load, ...] = ()
    order: int = 1
    units: str = "kPa"
    space: str = "ras"
    node_young: Floats | None = None
    gauss_young: Floats | None = None
    is_nonlinear: bool = False
    about: Json = {}  # noqa: RUF012 - never changed
    point_data: Arrays = {}  # noqa: RUF012 - never changed

    @property
    def labels(self) -> Ints | None:
        """Labels of the cells, (M,), if there are any."""
        return labels_of(self.cell_data, len(self.mesh.cells))

    @property
    def label_names(self) -> dict[int, str]:
        """Names of labels."""
        return table_of_words(self.about.get(TABLE_TEXT)).names

    def _repr_html_(self) -> str:
        """Show the model in a notebook, with the middle section shaded by mean or modulus."""
        mesh = self.mesh
        table = self.materials
        moduli = []
        if table is not None:
            young = f"{table.young.min():.4g} to {table.young.max():.4g} {self.units}"
            moduli = [
                ("materials", str(len(table.young))),
                ("Young's modulus", young),
                ("Poisson's ratio", f"{table.nu.min():.4g} to {table.nu.max():.4g}"),
            ]
        loads = ", ".join(load_words(load, SHOWN_LOAD_DIGITS) for load in self.loads)
        rows = [
            *notebook.mesh_rows(mesh.points, mesh.cells),
            ("order", str(self.order)),
            ("sets of facets", ", ".join(self.sets.facets) or "none"),
            ("sets of cells", ", ".join(self.sets.cells) or "none"),
            *moduli,
            ("loads", loads or "none"),
        ]
        values = self.cell_data.get("mean") if table is None else table.young[table.of_cell]
        return notebook.card_html(
            "Model", rows, notebook.section_html(mesh.points, mesh.cells, values)
        )

    def to_skfem(self) -> skfem.Mesh:
        """Convert the mesh and its sets for scikit-fem; see `tetopt.model.skfem.skfem_mesh`.

        Returns
        -------
        skfem.MeshTri or skfem.MeshTet
            Facet sets become its boundaries, cell sets its subdomains.

        Raises
        ------
        InputError
            The model is quadratic (choose the order of elements in scikit-fem), or scikit-fem is
            not installed.

        Examples
        --------
        >>> image = tetopt.load_phantom("sphere").image(voxel_mm=4)
        >>> mesh = tetopt.lattice_mesh(image, nodes=300)
        >>> loads = ["hold:inferior", "pressure:superior:0.1"]
        >>> model = tetopt.build_model(mesh, image, young="0.1*h", nu=0.45, loads=loads)
        >>> skfem_mesh = model.to_skfem()
        >>> len(skfem_mesh.boundaries["superior"])
        40
        """
        if self.order != 1:
            raise InputError(
                "to_skfem: expected linear cells, got order 2; omit the order and use P2 "
                "elements in scikit-fem"
            )
        return skfem_mesh(self.mesh, self.sets)

    def to_pyvista(self) -> pyvista.UnstructuredGrid:
        """Convert the mesh for pyvista, with all data of its cells and nodes.

        Returns
        -------
        pyvista.UnstructuredGrid
            Cells of the model's order with `cell_data` and `point_data`; for materials "young", in
            `units`, "nu", "material" (from 1) and "density" (kg/m3); and for each set "in_NAME" (1
            in its cells) or "on_NAME" (1 on its nodes).

        Examples
        --------
        >>> import tetopt
        >>> mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
        >>> tetopt.build_model(mesh, young=3.0).to_pyvista().cell_data["young"].tolist()
        [3.0]
        """
        on_cells, on_nodes = grid_fields(self)
        for name, members in self.sets.cells.items():
            on_cells[f"{IN_PREFIX}{name}"] = np.isin(np.arange(len(self.mesh.cells)), members)
        return conversions.to_pyvista(
            *elements(self), VTK_KINDS[self.mesh.ndim, self.order], on_cells, on_nodes
        )

    def to_meshio(self) -> meshio.Mesh:
        """Convert the mesh for meshio, with all data of its cells and nodes.

        Returns
        -------
        meshio.Mesh
            One block of cells of the model's order, with the same data as `to_pyvista`; sets of
            cells become `cell_sets`, the nodes of sets of facets `point_sets`.

        Examples
        --------
        >>> import tetopt
        >>> mesh = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
        >>> tetopt.build_model(mesh).to_meshio().point_sets["x_min"].tolist()
        [0, 2]
        """
        on_cells, on_nodes = grid_fields(self)
        sets = {
            name: np.flatnonzero(on_nodes.pop(f"{ON_PREFIX}{name}")) for name in self.sets.facets
        }
        other = conversions.to_meshio(
            *elements(self), MESHIO_KINDS[self.mesh.ndim, self.order], on_cells, on_nodes
        )
        other.point_sets = sets
        other.cell_sets = {name: [members.copy()] for name, members in self.sets.cells.items()}
        return other


def in_space(model: Model, space: str) -> Model:
    """Convert the model to the world axes "ras" (NIfTI) or "lps" (DICOM, ITK), by a half turn about
    z.

    Raises
    ------
    InputError
        The space is unknown, or the model is 2-D, in an arbitrary plane.
    """
    if space not in SPACES:
        raise InputError(f"space: expected ras or lps, got {space}")
    if space == model.space:
        return model
    if model.mesh.ndim == 2:
        raise InputError("space: a triangle mesh has coordinates in its own plane; omit `space`")
    loads = tuple(half_turned(load) for load in model.loads)
    middles = None if model.mesh.midpoints is None else half_turn(model.mesh.midpoints)
    mesh = Mesh(half_turn(model.mesh.points), model.mesh.cells, middles)
    cell_data, point_data = (
        half_turned_fields(each, field_kinds(model.about.get(KINDS_TEXT)))
        for each in (model.cell_data, model.point_data)
    )
    table = model.materials
    if table is not None and (along := table.along) is not None:
        table = table._replace(along=along._replace(fibre=half_turn(along.fibre)))
    model = model._replace(cell_data=cell_data, point_data=point_data, materials=table)
    return model._replace(mesh=mesh, loads=loads, space=space)


def half_turn(vectors: Floats) -> Floats:
    """Turn vectors (..., 3) about z, from RAS+ to LPS+ or back."""
    return vectors * HALF_TURN + 0.0  # + 0.0: no -0


def half_turned(load: Load) -> Load:
    """Convert a load from RAS+ to LPS+ or back."""
    return load._replace(numbers=half_turn(load.numbers)) if len(load.numbers) == 3 else load


def in_units(model: Model, units: str, *, with_lengths: bool = True) -> Model:
    """Convert lengths, unless `with_lengths` is false, moduli and loads to other units, see
    `STRESS_UNITS`.

    Raises
    ------
    InputError
        The unit is unknown.
    """
    if units not in STRESS_UNITS:
        raise InputError(f"units: expected one of {', '.join(STRESS_UNITS)}, got {units}")
    if units == model.units:
        return model
    old = STRESS_UNITS[model.units]
    new = STRESS_UNITS[units]
    mesh = model.mesh
    table = model.materials
    stress = old.kPa / new.kPa
    length = old.mm / new.mm if with_lengths else 1.0
    if length != 1.0:
        middles = None if mesh.midpoints is None else mesh.midpoints * length
        mesh = Mesh(mesh.points * length, mesh.cells, middles)
    return model._replace(
        mesh=mesh,
        materials=None if table is None else scale_moduli(table, stress),
        loads=tuple(scale_load(load, stress, length) for load in model.loads),
        node_young=None if model.node_young is None else model.node_young * stress,
        gauss_young=None if model.gauss_young is None else model.gauss_young * stress,
        cell_data=scaled_fields(model.cell_data, stress, length, mesh.ndim),
        point_data=scaled_fields(model.point_data, stress, length, mesh.ndim),
        units=units,
    )


def scale_load(load: Load, stress: float, length: float) -> Load:
    """Convert a load to other units; `stress` and `length` are the numbers of new units per
    present unit.
    """
    factor = stress if load.kind in FACET_FORCES else length
    return load._replace(
        numbers=load.numbers * (factor / length if load.kind == "spring" else factor)
    )


def odd_units(model: Model) -> Iterator[str]:
    """Yield a line for each quantity of a model in kPa that seems to be in a wrong unit."""
    if (table := model.materials) is not None:
        low = float(table.young.min())
        high = float(table.young.max())
        if PASCAL_RANGE[0] <= low and high <= PASCAL_RANGE[1]:
            yield (
                f"young is {low:.4g} to {high:.4g} kPa, stiffer than soft tissue (0.1 to a few "
                f"hundred kPa): {NAME_UNIT}"
            )
        elif high < MEGAPASCAL_MOST:
            yield (
                f"young is at most {high:.4g} kPa, softer than any tissue (0.1 kPa or more): "
                f"{NAME_UNIT}"
            )
        if (
            table.density is not None
            and (densest := float(table.density.max())) < GRAM_DENSITY_MOST
        ):
            yield (
                f"density is at most {densest:.4g} kg/m3 (water: 1000): if it is in g/cm3, "
                "multiply it by 1000"
            )
    for load in model.loads:
        size = float(np.sqrt((load.numbers**2).sum()))
        if load.kind == "gravity" and METRE_GRAVITY[0] <= size <= METRE_GRAVITY[1]:
            yield (
                f"gravity is {size:.4g} mm/s2 (the earth's: 9810): if it is in m/s2, multiply "
                "it by 1000"
            )


def locking_words(model: Model) -> str:
    """Return a warning if linear cells are too stiff for the Poisson's ratios, else an empty
    text.
    """
    largest = 0.0 if model.materials is None else float(model.materials.nu.max())
    if model.order != 1 or largest < LOCKING_NU:
        return ""
    return (
        f"nu = {largest:g}: linear elements are too stiff near incompressibility; use quadratic "
        "elements (order 2), or choose them in the solver"
    )


def header_lines(model: Model) -> list[str]:
    """Return lines for a file's header: the writer, coordinates, units and inputs."""
    units = STRESS_UNITS[model.units]
    space = f"{model.space.upper()}+" if model.mesh.ndim == 3 else "of the slice's plane"
    lines = [
        f"tetopt {model.about.get('tetopt', '')}".strip(),
        f"coordinates: {space}, {units.length}",
        f"units: {units.length}, {model.units}, {units.force}, {units.energy}, {units.mass}, s",
    ]
    if "image" in model.about:
        lines.append(
            f"image: {model.about['image']}, sha256 {model.about.get('image_sha256', 'unknown')}"
        )
    if model.materials is not None and (error := model.materials.binning) is not None:
        lines.append(
            f"materials: bins, error of the modulus {error.mean:.3%} (mean by volume), "
            f"{error.largest:.3%} (largest)"
        )
        if (angle := model.materials.fibre_binning) is not None:
            lines[-1] += f"; of fibres {angle.mean:.3f} and {angle.largest:.3f} degrees"
    if model.materials is not None and model.materials.along is not None:
        lines.append(
            "transversely isotropic: young and nu across the fibres; nu is also the ratio of the "
            "strain across to that along under tension along"
        )
    if (labels := model.labels) is not None:
        names = label_set_names(np.unique(labels).tolist(), model.label_names)
        lines += [f"label {label}: {name}" for label, name in names.items()]
    # A line break in a file's name would end the comment.
    return [" ".join(line.split()) for line in lines]


def kind_lines(model: Model) -> list[str]:
    """Return a line on the kinds of fields among the data of cells, for a header of a file that has
    these; empty without.
    """
    kinds = field_kinds(model.about.get(KINDS_TEXT))
    kinds = {name: kind for name, kind in kinds.items() if name in model.cell_data}
    return [f"{KINDS_TEXT}: {json.dumps(kinds)}"] if kinds else []


def elements(model: Model) -> tuple[Floats, Ints]:
    """Return points and cells of the model's order: the mesh's own, or those of `quadratic`."""
    return of_order(model.mesh.points, model.mesh.cells, model.order, model.mesh.midpoints)


def traction_forces(model: Model, loads: Iterable[Load]) -> Floats:
    """Return the nodal forces of the tractions among some loads, (N, n)."""
    total = np.zeros_like(elements(model)[0])
    for load in loads:
        if load.kind == "traction":
            nodes, forces = facet_forces(model.mesh, model.sets, load, model.order)
            total[nodes] += forces
    return total


def mass_densities(model: Model) -> Floats:
    """Return the density of each material, (K,), in the model's units of mass and length;
    water's if there is none.
    """
    assert model.materials is not None
    density = model.materials.density
    water = STRESS_UNITS[model.units].water
    return (
        np.full(len(model.materials.young), water)
        if density is None
        else density / WATER_DENSITY * water
    )


def grid_fields(model: Model) -> tuple[Arrays, Arrays]:
    """Return the fields of cells and of nodes of the model's order: data, sets of facets, and
    materials.
    """
    on_cells = dict(model.cell_data)
    on_nodes = {
        name: node_field(values, model.mesh, model.order)
        for name, values in model.point_data.items()
    }
    points, cells = elements(model)
    for name, rows in model.sets.facets.items():
        is_on = np.zeros(len(points), dtype=np.uint8)
        is_on[element_facets(cells, rows)] = 1
        on_nodes[f"{ON_PREFIX}{name}"] = is_on
    if model.materials is not None:
        on_cells |= model.materials.fields()
    if model.gauss_young is not None:
        on_cells[GAUSS_MODULI] = model.gauss_young
    if model.node_young is not None:
        on_nodes[NODE_MODULI] = node_field(model.node_young, model.mesh, model.order)
    return on_cells, on_nodes


def element_facets(cells: Ints, rows: Ints) -> Ints:
    """Return the nodes of facets (K, 2) for either order: `facet_triples` or
    `quadratic_facet_nodes`.
    """
    return (quadratic_facet_nodes if cells.shape[1] in (6, 10) else facet_triples)(cells, rows)
