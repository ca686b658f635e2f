"""A window to explore a mesh with, beside its image: what `tetopt.report.explore` puts into a page, by pyvista."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyvista
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from tetopt.errors import InputError
from tetopt.geometry.box import box_sides
from tetopt.geometry.cut import plane_cut
from tetopt.geometry.simplex import volumes
from tetopt.geometry.topology import facets
from tetopt.image import Image
from tetopt.io.files import check_suffix, written_whole
from tetopt.io.text import plain
from tetopt.report.colours import LISTED_LABELS, grey_limits, plain_text
from tetopt.report.exhibit import COLOUR_MAP, LABEL_FIELD, NO_VALUE, Exhibit, Field, first_axis, warp_factors
from tetopt.report.figures import FIGURE_SUFFIXES, MESH_LINE

KEYS_TEXT = "x y z: plane   k: side kept   m: mesh, image, both   n: next field   h: next set of facets   q: close"
LABEL_KEY_TEXT = "   l: next label alone"  # likewise
STEP_KEY_TEXT = "   s: next step"  # where there are several
PLANE_CHOICES = ("mesh", "image", "both")  # what the plane shows
AXIS_LETTERS = "RAS"  # the sides to which the world's axes run
# Where the eye is at first, RAS, for the cut across each axis: before the cut, a little aside.
CUT_VIEWPOINTS = ((1.6, 0.9, 0.7), (0.9, 1.6, 0.7), (0.4, -1.0, 1.6))
OTHERS_OPACITY = 0.14  # of the interfaces of labels that are not shown: the one that is shines through several
GLASS_OPACITY = 0.35  # of the cells' colours over the image: enough to tell them, and the voxels show through
MAX_PIXELS = 1024  # of the image's slice along either side: about the window's


def show(shown: Exhibit) -> None:
    """Open the window of `plotter` and return when it is closed.

    Raises
    ------
    InputError
        No display to open it on.
    """
    if not has_display():
        raise InputError(
            "view: no display to open a window on; use `html` to write the same view as a page, or "
            "`screenshot` for a picture"
        )
    plotter(shown).show()


def save_screenshot(path: str | Path, shown: Exhibit) -> None:
    """Write what the window shows at first as PNG, without its sliders, whole or not at all; no display is needed."""
    with written_whole(check_suffix(path, FIGURE_SUFFIXES)) as temporary:
        window = plotter(shown, off_screen=True)
        with pyvista.vtk_verbosity("off"):
            window.clear_slider_widgets()
            window.remove_actor("keys", render=False)
            window.camera.SetWindowCenter(0.0, 0.0)
            window.screenshot(temporary)
            window.close()


def has_display() -> bool:
    """Whether VTK can open a window: on Linux, whether the X server in DISPLAY answers; elsewhere it is assumed."""
    if not sys.platform.startswith("linux"):
        return True
    library = ctypes.util.find_library("X11")
    if not os.environ.get("DISPLAY") or library is None:
        return False
    # VTK asks the same; without an answer it goes on without a window, or ends the process.
    x11 = ctypes.CDLL(library)
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    connection = x11.XOpenDisplay(None)
    if connection is None:
        return False
    x11.XCloseDisplay(connection)
    return True


def plotter(shown: Exhibit, off_screen: bool = False) -> pyvista.Plotter:
    """The window, not yet shown: the mesh cut by a plane, coloured by a field within limits, the image in the plane.

    Sliders move the plane (world mm) and the limits, choose the field, and multiply displacements, where there are any;
    the keys in `KEYS_TEXT` the rest. With `off_screen` it is to be photographed instead of shown.
    """
    shown = _printable(shown)
    with pyvista.vtk_verbosity("off"):
        window = pyvista.Plotter(off_screen=off_screen, window_size=(1280, 850), title=f"tetopt: {shown.title}")
        window.set_background("white")
        _Scene(window, shown).open()
    return window


def _printable(shown: Exhibit) -> Exhibit:
    """With names as VTK draws them letter by letter: it, too, takes what is between dollars for a formula."""
    fields = [
        field._replace(
            name=plain_text(field.name), names={label: plain_text(name) for label, name in field.names.items()}
        )
        for field in shown.fields
    ]
    sets = {plain_text(name): nodes for name, nodes in shown.sets.items()}
    reactions = {
        step: {plain_text(name): force for name, force in by_set.items()} for step, by_set in shown.reactions.items()
    }
    return shown._replace(title=plain(shown.title), fields=fields, sets=sets, reactions=reactions)


class _Scene:
    """What the window shows, and the actors that show it."""

    def __init__(self, window: pyvista.Plotter, shown: Exhibit) -> None:
        self.window, self.every_field, self.sets = window, shown.fields, shown.sets
        mesh, image = self.mesh, self.image = shown.mesh, shown.image
        self.sides = facets(mesh.cells)
        self.volumes = volumes(mesh.points, mesh.cells)
        self.displacements, self.reactions = shown.displacements, shown.reactions
        self.step = next(iter(self.displacements), 0)  # of the loads
        self.warp, self.most_warp = warp_factors(shown)
        self.deform()
        self.greys = (0.0, 1.0) if image is None else grey_limits([image.data.astype(np.float64)])
        self.axis = first_axis(shown)
        self.at = float((self.low + self.high)[self.axis] / 2.0)
        self.is_turned = False
        # Behind a mesh that is deformed the image, which is not, would mislead at first sight.
        self.inside = PLANE_CHOICES[0] if image is None or self.displacements else PLANE_CHOICES[2]
        self.set = 0  # none, then those in `sets`
        of_labels = [field for field in shown.fields if field.name == LABEL_FIELD and len(field.categories) > 1]
        self.labels = of_labels[0] if of_labels else None
        self.label = 0  # all, then each of them alone
        self.number = 0  # of the field
        self.limits = self._range()
        self.sliders: dict[str, Any] = {}  # of VTK
        self.is_open = False  # a slider calls back as soon as it is added

    def deform(self) -> None:
        """Put the points where the displacements of the step, multiplied, take them."""
        u = self.displacements.get(self.step)
        self.points = self.mesh.points if u is None else self.mesh.points + self.warp * u
        self.low, self.high = self.points.min(axis=0), self.points.max(axis=0)

    @property
    def fields(self) -> list[Field]:
        """Those of the step, and of none."""
        return [field for field in self.every_field if field.step in (0, self.step)]

    @property
    def field(self) -> Field:
        return self.fields[self.number]

    def _range(self) -> tuple[float, float]:
        """The field's least and largest value, apart so that a slider can go from one to the other."""
        values = self.field.values[np.isfinite(self.field.values)].astype(np.float64)
        if len(values) == 0:
            return 0.0, 1.0
        low, high = float(values.min()), float(values.max())
        return (low, high) if high > low else grey_limits([values])

    # -- actors

    def open(self) -> None:
        self._add_sliders()
        text = KEYS_TEXT + (LABEL_KEY_TEXT if self.labels else "")
        text += STEP_KEY_TEXT if len(self.displacements) > 1 else ""
        self.window.add_text(text, name="keys", font_size=8, color="#555555", position="lower_left")
        self.window.add_axes(xlabel="R", ylabel="A", zlabel="S", color="black", viewport=(0.0, 0.2, 0.15, 0.4))
        for key, act in (
            ("x", lambda: self.cut_across(0)), ("y", lambda: self.cut_across(1)), ("z", lambda: self.cut_across(2)),
            ("k", self.turn), ("m", self.next_inside), ("n", self.next_field), ("h", self.next_set),
            ("s", self.next_step), ("l", self.next_label),
        ):  # fmt: skip
            self.window.add_key_event(key, act)
        self.is_open = True
        self._add_key()
        self._changed()
        self.window.enable_parallel_projection()
        self.window.view_vector(CUT_VIEWPOINTS[self.axis], viewup=(0.0, 0.0, 1.0))
        self.window.camera.zoom(0.95)
        self.window.camera.SetWindowCenter(0.0, -0.1)  # above the sliders

    def draw(self) -> None:
        """Draw everything that depends on the plane, the limits and the field."""
        is_within = self.is_within()
        origin = np.where(np.arange(3) == self.axis, self.at, 0.0)
        normal = np.eye(3)[self.axis] * (-1.0 if self.is_turned else 1.0)

        def before_plane(data: pyvista.PolyData) -> pyvista.DataSet:
            return data.clip(normal=normal, origin=origin, invert=True) if data.n_cells else data

        self._add_cells("surface", before_plane(self._surface(is_within)), lighting=True)
        self._add_section(is_within)
        self._add_slice()
        self._add_cells("glass", before_plane(self._others()), lighting=True, show_edges=False, opacity=OTHERS_OPACITY)
        self._add("set", before_plane(self._marked()), color="#ff00c0", show_edges=True, ambient=0.3)
        count, volume = int(np.count_nonzero(is_within)), float(self.volumes[is_within].sum())
        text = f"{count:,} of {len(self.mesh.cells):,} cells, {volume:,.7g} mm³; world RAS, mm"
        if self.labels and self.label:
            label = self.labels.categories[self.label - 1][0]
            text += f"\nlabel {label} {self.labels.names.get(label, '')}".rstrip()
        if self.displacements:
            text += f"\ndeformation x {self.warp:.4g}" + (f", step {self.step}" if self.step else "")
            text += "; the image is at rest" if self.image is not None and self.inside != "mesh" else ""
        name = list(self.sets)[self.set - 1] if self.set else ""
        if force := self.reactions.get(self.step, {}).get(name):
            parts = ", ".join(f"{letter} {value:.4g}" for letter, value in zip(AXIS_LETTERS, force, strict=True))
            text += f"\n{name} is held by {parts} mN"
        self.window.add_text(text, name="count", font_size=10, color="black", position="upper_left", render=False)
        self.window.render()

    def is_within(self) -> NDArray[np.bool_]:
        """Cells of the label whose value lies within the limits; with the full range also those without one, (M,)."""
        # Sliders hold single precision, so that a limit at one of their ends may miss the field's own by rounding.
        low, high = self._range()
        slack = 1e-6 * (high - low)
        is_of_label = self._is_of_label()
        if self.limits[0] <= low + slack and self.limits[1] >= high - slack:
            return is_of_label
        values = self.field.values
        return is_of_label & (values >= self.limits[0] - slack) & (values <= self.limits[1] + slack)

    def _is_of_label(self) -> NDArray[np.bool_]:
        """Cells of the label that is shown alone, or all, (M,)."""
        if self.labels is None or self.label == 0:
            return np.full(len(self.mesh.cells), True)
        return self.labels.values == self.labels.categories[self.label - 1][0]

    def _others(self) -> pyvista.PolyData:
        """The facets between cells of two labels neither of which is shown, with the cell of the larger one."""
        if self.labels is None or self.label == 0:
            return pyvista.PolyData()
        values, is_hidden = self.labels.values, ~self._is_of_label()
        inner = np.flatnonzero(self.sides.n_cells == 2)
        sides = self.sides.cells[inner]
        is_between = (values[sides[:, 0]] != values[sides[:, 1]]) & is_hidden[sides].all(axis=1)
        surface = pyvista.PolyData.from_regular_faces(self.points, self.sides.nodes[inner[is_between]])
        larger = np.where(values[sides[:, 0]] > values[sides[:, 1]], *sides.T)
        surface.cell_data["cell"] = larger[is_between]
        if self.field.nodes is not None:
            surface.point_data["value"] = self.field.nodes
        return surface

    def _surface(self, is_within: NDArray[np.bool_]) -> pyvista.PolyData:
        """The facets that exactly one shown cell has, with that cell as cell data."""
        first, second = self.sides.cells.T
        is_first, is_second = is_within[first], (second >= 0) & is_within[second]
        is_outer = is_first != is_second
        surface = pyvista.PolyData.from_regular_faces(self.points, self.sides.nodes[is_outer])
        surface.cell_data["cell"] = np.where(is_first, first, second)[is_outer]
        if self.field.nodes is not None:
            surface.point_data["value"] = self.field.nodes
        return surface

    def _add_section(self, is_within: NDArray[np.bool_]) -> None:
        """Draw the polygons in which the plane cuts the shown cells; over the image like glass, with lines on top."""
        polygons = pyvista.PolyData()
        if self.inside != "image":
            shown = np.flatnonzero(is_within)
            nodal = self.field.nodes
            columns = self.points if nodal is None else np.column_stack([self.points, nodal])
            cut = plane_cut(columns, self.mesh.cells[shown], self.points[:, self.axis] - self.at)
            corners = np.arange(4 * len(cut.cells)).reshape(-1, 4)
            if len(corners):
                places = cut.corners.reshape(-1, columns.shape[1])
                polygons = pyvista.PolyData.from_regular_faces(places[:, :3], corners)
                polygons.cell_data["cell"] = shown[cut.cells]
                if nodal is not None:
                    polygons.point_data["value"] = places[:, 3]
        is_glass = self.inside == "both"
        lines = polygons.extract_all_edges() if is_glass and polygons.n_cells else pyvista.PolyData()
        self._add_cells(
            "section", polygons, lighting=False, show_edges=not is_glass, opacity=GLASS_OPACITY if is_glass else 1.0
        )
        self._add("lines", lines, color=MESH_LINE, line_width=1, lighting=False)

    def _add_slice(self) -> None:
        sheet = pyvista.PolyData()
        if self.image is not None and self.inside != "mesh":
            sheet = plane_slice(self.image, self.axis, self.at)
            # The slice is put behind the cells' edges, which lie in the same plane.
            behind = np.zeros(3)
            behind[self.axis] = (1.0 if self.is_turned else -1.0) * 2e-4 * float(np.linalg.norm(self.high - self.low))
            sheet.origin = np.asarray(sheet.origin) + behind
        self._add(
            "slice", sheet, scalars="h", cmap="gray", clim=self.greys, nan_opacity=0.0,
            show_scalar_bar=False, lighting=False,
        )  # fmt: skip

    def _marked(self) -> pyvista.PolyData:
        if self.set == 0:
            return pyvista.PolyData()
        return pyvista.PolyData.from_regular_faces(self.points, list(self.sets.values())[self.set - 1])

    def _add_cells(self, name: str, polygons: pyvista.PolyData, **drawn: Any) -> None:
        """Draw facets or polygons in the colours of their cells, or of what is interpolated on them."""
        if polygons.n_cells == 0:
            self._add(name, polygons)
            return
        drawn = {"show_edges": True, "edge_color": "#303030", "ambient": 0.3, "show_scalar_bar": False} | drawn
        values = self.field.values[np.asarray(polygons.cell_data["cell"])]
        if self.field.categories:
            polygons.cell_data["colour"] = _label_colours(self.field, values)
            # Light would make them other colours than those of the legend and of the other pictures.
            self._add(name, polygons, scalars="colour", rgb=True, **drawn | {"lighting": False})
            return
        if self.field.nodes is None:
            polygons.cell_data["value"] = values
        limits = self.field.limits
        self._add(name, polygons, scalars="value", cmap=COLOUR_MAP, clim=limits, nan_color=NO_VALUE, **drawn)

    def _add(self, name: str, data: pyvista.DataSet, **drawn: Any) -> None:
        """Draw `data` in place of what had this name before; if it is empty, nothing."""
        if data.n_cells:
            self.window.add_mesh(data, name=name, reset_camera=False, render=False, **drawn)
        else:
            self.window.remove_actor(name, reset_camera=False, render=False)

    def _add_key(self) -> None:
        """Draw the colour bar of a quantity, or the list of labels' colours."""
        field = self.field
        for title in list(self.window.scalar_bars.keys()):
            self.window.remove_scalar_bar(title, render=False)
        self.window.remove_legend(render=False)
        if field.categories:
            # As in the pictures' legends, the labels of most cells are listed, ascending.
            by_size = sorted(field.categories, key=lambda entry: -np.count_nonzero(field.values == entry[0]))
            listed = sorted(by_size[:LISTED_LABELS])
            entries = [[f" {label} {field.names.get(label, '')}".rstrip(), colour] for label, colour in listed]
            if len(field.categories) > LISTED_LABELS:
                entries.append([f" and {len(field.categories) - LISTED_LABELS} more", "#555555"])
            height = 0.03 * len(entries)
            width = 0.11 if not field.names else 0.2
            legend = self.window.add_legend(entries, bcolor="white", face="rectangle", size=(width, height))
            legend.SetPosition(0.99 - width, 0.95 - height)
            return
        mapper = pyvista.DataSetMapper()
        mapper.lookup_table = pyvista.LookupTable(COLOUR_MAP, scalar_range=field.limits)
        self.window.add_scalar_bar(
            title=f"{field.name}\n({field.unit})\n" if field.unit else field.name, mapper=mapper, color="black",
            vertical=True, position_x=0.89, position_y=0.35, height=0.5, width=0.06, title_font_size=16,
            label_font_size=14, fmt="%.4g", render=False,
        )  # fmt: skip

    # -- what sliders and keys do

    def _add_sliders(self) -> None:
        along = (self.low[self.axis], self.high[self.axis])
        self._add_slider("at", self.cut_at, along, self.at, (0.03, 0.23))
        self._add_slider("low", lambda value: self.limit(low=value), self._range(), self.limits[0], (0.28, 0.48))
        self._add_slider("high", lambda value: self.limit(high=value), self._range(), self.limits[1], (0.53, 0.73))
        if len(self.fields) > 1:
            last = float(len(self.fields) - 1)
            self._add_slider("field", lambda value: self.colour_by(round(value)), (0.0, last), 0.0, (0.78, 0.97))
            self.sliders["field"].GetRepresentation().ShowSliderLabelOff()
        if self.displacements:
            self._add_slider("warp", self.warp_by, (0.0, self.most_warp), self.warp, (0.78, 0.97), 0.24)

    def _add_slider(
        self, name: str, act: Callable[[float], None], ends: tuple[float, float], value: float,
        x: tuple[float, float], y: float = 0.1,
    ) -> None:  # fmt: skip
        self.sliders[name] = self.window.add_slider_widget(
            act, rng=ends, value=value, title=name, pointa=(x[0], y), pointb=(x[1], y), color="#333333",
            style="modern", interaction_event="always", title_height=0.02, fmt="%.5g",
        )  # fmt: skip

    def _set_slider(self, name: str, title: str, value: float, ends: tuple[float, float]) -> None:
        if name not in self.sliders:
            return
        slider = self.sliders[name].GetRepresentation()
        # An end that passes the other one would be refused.
        slider.SetMinimumValue(min(ends[0], slider.GetMinimumValue()))
        slider.SetMaximumValue(ends[1])
        slider.SetMinimumValue(ends[0])
        slider.SetValue(value)
        slider.SetTitleText(title)

    def _set_sliders(self) -> None:
        letter = AXIS_LETTERS[self.axis]
        self._set_slider("at", f"plane at {letter}, mm", self.at, (self.low[self.axis], self.high[self.axis]))
        self._set_slider("low", f"{self.field.name} from", self.limits[0], self._range())
        self._set_slider("high", f"{self.field.name} to", self.limits[1], self._range())
        self._set_slider("field", f"field: {self.field.name}", self.number, (0, len(self.fields) - 1))
        self._set_slider("warp", "deformation x", self.warp, (0.0, self.most_warp))

    def _changed(self) -> None:
        if self.is_open:
            self._set_sliders()
            self.draw()

    def cut_at(self, at: float) -> None:
        self.at = float(at)
        self._changed()

    def cut_across(self, axis: int) -> None:
        self.axis, self.at = axis, float((self.low + self.high)[axis] / 2.0)
        self._changed()

    def limit(self, low: float | None = None, high: float | None = None) -> None:
        """Set a limit; one that passes the other takes it along."""
        if low is not None:
            self.limits = (low, max(low, self.limits[1]))
        if high is not None:
            self.limits = (min(high, self.limits[0]), high)
        self._changed()

    def colour_by(self, number: int) -> None:
        if number == self.number:
            return
        self.number = number
        self.limits = self._range()
        self._add_key()
        self._changed()

    def warp_by(self, factor: float) -> None:
        self.warp = float(factor)
        self.deform()
        self._changed()

    def next_step(self) -> None:
        """Show the next step's deformation and field; the limits are then the field's whole range."""
        if len(self.displacements) < 2:
            return
        name, steps = self.field.name, list(self.displacements)
        self.step = steps[(steps.index(self.step) + 1) % len(steps)]
        names = [field.name for field in self.fields]
        self.number = names.index(name) if name in names else 0
        self.limits = self._range()
        self.deform()
        self._add_key()
        self._changed()

    def turn(self) -> None:
        self.is_turned = not self.is_turned
        self._changed()

    def next_inside(self) -> None:
        if self.image is not None:
            self.inside = PLANE_CHOICES[(PLANE_CHOICES.index(self.inside) + 1) % len(PLANE_CHOICES)]
            self._changed()

    def next_field(self) -> None:
        self.colour_by((self.number + 1) % len(self.fields))

    def next_label(self) -> None:
        """Show the next label alone, or after the last one all, the cells in the colours of their labels."""
        if self.labels is None:
            return
        self.label = (self.label + 1) % (len(self.labels.categories) + 1)
        if self.label:
            self.colour_by(next(number for number, field in enumerate(self.fields) if field is self.labels))
        self._changed()

    def next_set(self) -> None:
        self.set = (self.set + 1) % (len(self.sets) + 1)
        self._changed()


def _label_colours(field: Field, values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Red, green and blue of labels (K, 3); `NO_VALUE` for values that are no label."""
    colours = np.tile(np.rint(255.0 * np.array(to_rgb(NO_VALUE))), (len(values), 1))
    for label, colour in field.categories:
        colours[values == label] = np.rint(255.0 * np.array(to_rgb(colour)))
    return colours.astype(np.uint8)


def plane_slice(image: Image, axis: int, at: float) -> pyvista.ImageData:
    """The image in a world plane, in pixels of half the voxels' shortest edge: each has the voxel around its centre.

    Parameters
    ----------
    image : Image
        Three-dimensional.
    axis : int
        World axis across the plane, 0 for R-L, 1 for A-P, 2 for S-I.
    at : float
        Where the plane crosses it, mm.

    Returns
    -------
    pyvista.ImageData
        One layer of cells with data `h`, float64, NaN outside of the image; up to `MAX_PIXELS` along a side.
    """
    corners = np.stack(np.meshgrid(*box_sides(image.shape), indexing="ij"), axis=-1)
    world = image.to_world(corners.reshape(-1, 3))
    low, high = world.min(axis=0), world.max(axis=0)
    pixel = max(float(image.spacing.min()) / 2.0, float(np.delete(high - low, axis).max()) / MAX_PIXELS)
    counts = np.maximum(np.ceil((high - low) / pixel - 1e-9).astype(np.int64), 1)
    counts[axis] = 1
    low[axis] = at
    centres = [low[k] + pixel * (np.arange(counts[k]) + 0.5) for k in range(3)]
    centres[axis] = np.array([at])
    index = image.to_index(np.stack(np.meshgrid(*centres, indexing="ij"), axis=-1))
    voxel = np.floor(index + 0.5).astype(np.int64)
    is_inside = ((voxel >= 0) & (voxel < image.shape)).all(axis=-1)
    h = np.full(voxel.shape[:3], np.nan)
    h[is_inside] = image.data[tuple(voxel[is_inside].T)]
    dimensions = counts + 1
    dimensions[axis] = 1
    sheet = pyvista.ImageData(dimensions=dimensions, spacing=(pixel,) * 3, origin=low)
    sheet.cell_data["h"] = h.ravel(order="F")
    return sheet
