"""The page to explore a mesh with: its data are the mesh's, and a browser shows what numpy says
is there.
"""

import base64
import html
import io
import json
import re

import numpy as np
import PIL.Image
import pytest
from browser import BLIND, FRAMES, copied, document
from meshes import with_bent_edges
from numpy.testing import assert_allclose, assert_array_equal
from scipy import ndimage
from scipy.spatial import Delaunay

import tetopt
from tetopt.contents.labels import LABEL_PALETTE
from tetopt.errors import InputError
from tetopt.geometry.cut import plane_cut
from tetopt.geometry.simplex import centroids, orient_cells
from tetopt.geometry.topology import boundary_facets, facets
from tetopt.model.label_names import LabelTable
from tetopt.report import explore
from tetopt.report.exhibit import exhibit, first_axis, loaded_side, opened_on, warp_factors
from tetopt.report.explore import colour_table, explorer_html, save_explorer


@pytest.fixture(scope="module")
def cell_data(mesh):
    random = np.random.default_rng(1)
    mean = random.normal(50.0, 20.0, len(mesh.cells))
    mean[::9] = np.nan
    return {
        "mean": mean,
        "strain": np.zeros((len(mesh.cells), 6)),
        "label": random.integers(0, 4, len(mesh.cells)),
    }


def test_directions_are_colours(mesh):
    """Red, green and blue are x, y and z, whatever the sign and length; cells without one have no
    value.
    """
    vectors = np.tile([0.0, 3.0, -4.0], (len(mesh.cells), 1))
    vectors[::2] *= -0.5
    vectors[1] = [2.0, 0.0, 0.0]
    vectors[4] = np.nan
    (field,) = exhibit(mesh, {"v1": vectors}).fields[-1:]
    colours = dict(field.categories)
    assert field.name == "v1"
    assert np.isnan(field.values[4])
    assert colours[int(field.values[1])] == "#ff0000"
    assert {colours[int(each)] for each in np.delete(field.values, [1, 4])} == {"#0099cc"}
    assert sorted(field.names.values()) == ["0.00 -0.60 0.80", "1.00 0.00 0.00"]


def packed(*shown, **more):
    """The data block of the page of what `exhibit` makes of these."""
    page = explorer_html(exhibit(*shown, **more))
    return json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))


def array(text, kind, *shape):
    return np.frombuffer(base64.b64decode(text), kind).reshape(shape or -1)


def test_volumes_of_curved_cells_are_theirs(mesh):
    """The page computes volumes of straight cells itself."""
    curved = with_bent_edges(mesh, 0.05)
    assert_allclose(array(packed(curved, {})["volumes"], "<f4"), curved.cell_volumes, rtol=1e-6)
    assert packed(mesh, {})["volumes"] is None


def test_fields_are_labels_or_quantities(mesh, cell_data):
    mean, label = exhibit(mesh, cell_data).fields
    assert (mean.name, mean.unit, mean.categories) == ("mean", "intensity", [])
    limits = np.nanpercentile(cell_data["mean"].astype(np.float32), [1, 99])
    assert_allclose(mean.limits, limits, rtol=1e-6)
    assert label.categories[0][0] == 0
    assert label.categories[1:] == list(enumerate(LABEL_PALETTE[:3], 1))  # as in every picture
    # Not all whole numbers are labels.
    n = len(mesh.cells)
    for others in ({"n_voxels": np.full(n, 8)}, {"depth": np.full(n, -1)}, {"many": np.arange(n)}):
        assert exhibit(mesh, others).fields[0].categories == []


def test_a_field_is_the_first_within_limits(mesh, cell_data):
    shown = exhibit(mesh, cell_data)
    assert opened_on(shown) == shown
    mean, label = shown.fields
    assert opened_on(shown, "label").fields[0] == label
    within = opened_on(shown, "mean", (-5.0, 120.0)).fields
    assert within == [mean._replace(limits=(-5.0, 120.0)), label]
    for words, match in (
        (("rho",), "show`: .* it has mean, label"),
        (("mean", (3.0, 3.0)), "range: .* got 3,3"),
        (("mean", (np.nan, 3.0)), "range: expected LOW,HIGH"),
        (("label", (0.0, 3.0)), 'range: "label"'),
    ):
        with pytest.raises(InputError, match=match):
            opened_on(shown, *words)


def test_a_field_without_range_or_values_has_limits(mesh):
    n = len(mesh.cells)
    data = [np.full(n, 0.5), np.full(n, np.nan), np.append(np.arange(n - 1) + 0.5, np.inf)]
    constant, none, infinite = exhibit(mesh, dict(zip("abc", data, strict=True))).fields
    assert constant.limits[0] < 0.5 < constant.limits[1]
    assert none.limits == (0.0, 1.0)
    assert infinite.limits[1] < n
    assert np.isnan(infinite.values[-1])


def test_without_fields_there_are_those_of_the_mesh(mesh, image):
    tensors = {"strain": np.zeros((len(mesh.cells), 6))}
    names = [field.name for field in exhibit(mesh, tensors, image).fields]
    assert names == list(tetopt.cell_fields(mesh, image))


def test_the_data_are_the_meshs(mesh, cell_data, image):
    top = boundary_facets(mesh.cells)[:5]
    data = packed(mesh, cell_data, image, facet_sets={"top": top})
    points = array(data["points"], "<f4", -1, 3) + data["centre"]
    assert_allclose(points, mesh.points, atol=1e-5)
    assert_array_equal(array(data["cells"], "<u4", -1, 4), mesh.cells)
    assert [field["name"] for field in data["fields"]] == ["mean", "label"]
    assert_allclose(array(data["fields"][0]["values"], "<f4"), cell_data["mean"], rtol=1e-6)
    assert data["skipped"] == ["strain"]
    assert_array_equal(array(data["sets"][0]["triangles"], "<u4", -1, 3), top)


def greys_of(image, index=...):
    """Of 255, of all voxels, or of those at places in index coordinates."""
    low, high = np.percentile(image.data, [0.5, 99.5])
    where = index if index is ... else tuple(np.rint(index).astype(int).T)
    return 255 * np.clip((image.data[where] - low) / (high - low), 0, 1)


def test_the_image_is_where_its_affine_puts_it(mesh, image):
    data = packed(mesh, {}, image)
    index = np.random.default_rng(0).uniform(0, 13, (9, 3))
    relative = np.append(image.to_world(index) - data["centre"], np.ones((9, 1)), axis=1)
    to_index = np.reshape(data["image"]["toIndex"], (4, 4))
    assert_allclose((relative @ to_index)[:, :3], index, atol=1e-9)
    voxels = array(data["image"]["voxels"], "u1")
    assert_allclose(voxels, greys_of(image).ravel(order="F"), atol=0.51)


def test_a_large_image_is_averaged_over_the_same_box(mesh, image, monkeypatch):
    whole = packed(mesh, {}, image)["image"]
    monkeypatch.setattr(explore, "PAGE_IMAGE_VOXELS", 600)
    averaged = packed(mesh, {}, image)["image"]
    assert np.prod(averaged["shape"]) <= 600
    assert averaged["original"] == list(image.shape)
    assert_allclose(averaged["box"], whole["box"], atol=1e-9)


def test_the_page_is_one_file(mesh, cell_data, here):
    labels = {"</script>": cell_data["label"]}
    assert packed(mesh, labels)["fields"][0]["name"] == "</script>"
    for title, shown in (
        ('</script><b>"$DATA', "&lt;/script&gt;&lt;b&gt;&#34;$DATA"),
        ("\udce9", "\\udce9"),  # as a name that is not UTF-8 comes
    ):
        save_explorer(here / "a.html", exhibit(mesh, labels, title=title))
        text = (here / "a.html").read_text(encoding="utf-8")
        assert not re.search(r"https?://|src=|href=|url\(|import ", text)
        assert "default-src 'none'" in text
        assert f"<title>{shown}</title>" in text
        assert "needs JavaScript" in text


def test_refusals(mesh):
    plane = tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    with pytest.raises(InputError, match="got triangles"):
        exhibit(plane, {})
    with pytest.raises(InputError, match="got a 2-D one"):
        exhibit(mesh, {}, tetopt.Image(np.eye(3)))


# What a user does, and what the page then says or shows.
PROBE = """<script>
const said = {};
const $ = (id) => document.getElementById(id);
const canvas = document.querySelector("canvas");
const press = (group, value) =>
  [...$(group).children].find((b) => b.dataset.value === String(value)).click();
const put = (id, value) => { $(id).value = value; $(id).dispatchEvent(new Event("change")); };
const slide = (id, value) => { $(id).value = value; $(id).dispatchEvent(new Event("input")); };
const frame = () => new Promise((done) => setTimeout(done, 60));
const grid = () => {  // every ninth pixel
  const [width, height] = [canvas.width, canvas.height];
  const copy = Object.assign(document.createElement("canvas"), { width, height });
  const context = copy.getContext("2d");
  context.drawImage(canvas, 0, 0);
  const all = context.getImageData(0, 0, width, height).data;
  const colours = [];
  for (let y = 3; y < height; y += 9) {
    for (let x = 3; x < width; x += 9)
      colours.push([x, y, ...all.subarray(4 * (y * width + x)).slice(0, 3)]);
  }
  return colours;
};
const send = (type, x, y) => canvas.dispatchEvent(
  new PointerEvent(type, { pointerId: 1, clientX: x, clientY: y, bubbles: true }));
const steps = {
  first() {},
  whole() { press("style", true); put("at-number", AT_0); }, turned() { press("side", true); },
  uncut() { press("axis", -1); },
  within() { put("low-number", 45); put("high-number", 60); }, crossed() { put("low-number", 70); },
  cut() { put("low-number", 45); put("high-number", 60); press("style", false); press("axis", 1);
    put("at-number", AT_1); },
  label() { slide("low", 0); slide("high", 1000); put("field", 1); put("low-number", 2); },
};
const warped = async () => {
  canvas.setPointerCapture = () => {};
  const names = (id) => [...$(id).children].map((option) => option.textContent);
  const state = () => [$("warp-number").value, $("warped").textContent,
    $("field").selectedOptions[0].textContent,
    $("extremes").textContent, Number(canvas.dataset.section)];
  said.about = $("about").textContent;
  said.names = [names("field"), names("by"), names("step")];
  said.first = state();
  press("axis", 2); put("at-number", AT_2); put("warp-number", 0);
  await frame();
  said.rest = state();
  slide("warp", 1000);
  await frame();
  said.most = state();
  put("step", 2); put("warp-number", 1.5); press("from", "S");
  await frame();
  said.second = state();
  said.size = [canvas.width, canvas.height];
  said.cells = grid();
  press("inside", "both"); slide("fraction", 0);
  await frame();
  said.carried = grid();
  press("inside", "cells");
  send("pointerdown", ...CLICKS[0]);
  send("pointerup", ...CLICKS[0]);
  said.picked = $("picked").innerText;
  put("field", $("field").children[1].value);
  await frame();
  put("set", 0);
  said.reactions = [$("reaction").textContent];
  put("step", 1);
  said.reactions.push($("reaction").textContent);
  put("set", 1);
  said.reactions.push($("reaction").textContent);
  said.grey = grid().some(([, , ...rgb]) => rgb.join() === "170,170,170");
  return said;
};
const run = async () => {
  if (document.title === "warped") return warped();
  if (!canvas.isConnected) return { words: document.body.innerText };
  said.over = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  if (document.title === "narrow") return said;
  canvas.setPointerCapture = () => {};
  for (const [name, act] of Object.entries(steps)) {
    act();
    await frame();
    said[name] = [$("count").textContent, Number(canvas.dataset.surface),
      Number(canvas.dataset.section), $("low-number").value, $("high-number").value];
  }
  said.labels = [...$("labels").children].map((entry) =>
    [entry.textContent, entry.firstChild.style.background]);
  slide("low", 0); put("field", 0); press("side", false); press("axis", 2); put("at-number", AT_2);
  press("from", "S");
  await frame();
  said.size = [canvas.width, canvas.height];
  said.cells = grid();
  press("inside", "image");
  await frame();
  said.slice = grid();
  said.picked = [];
  for (const [x, y] of CLICKS) {
    send("pointerdown", x, y);
    send("pointerup", x, y);
    said.picked.push($("picked").innerText);
  }
  send("pointerdown", 2, 2);
  send("pointerup", 2, 2);
  await frame();
  const before = canvas.toDataURL();
  const changes = {
    drag() { send("pointerdown", 100, 100); send("pointermove", 160, 120);
      send("pointerup", 160, 120); },
    back() { press("from", "S"); },
    wheel() { canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: 200, cancelable: true })); },
    backAgain() { press("from", "S"); },
    key() { canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft" })); },
    backOnceMore() { press("from", "S"); },
    set() { put("set", 0); },
    insideSet() { put("set", 1); },
  };
  said.changed = [];
  for (const act of Object.values(changes)) {
    act();
    await frame();
    said.changed.push(canvas.toDataURL() !== before);
  }
  const labels = async () => {
    await frame();
    return [$("count").textContent, Number(canvas.dataset.surface), Number(canvas.dataset.glass),
      $("field").selectedOptions[0].textContent,
      [...$("labels").children].map((entry) => entry.textContent),
      canvas.toDataURL()];
  };
  put("set", -1); press("inside", "cells"); press("axis", -1); press("from", "S");
  const rows = [...$("label-list").children];
  said.rows = rows.map((row) => row.firstChild.textContent);
  said.every = await labels();
  rows[2].lastChild.click();
  said.only = await labels();
  $("glass").click();
  said.unglazed = await labels();
  rows[0].querySelector("input").click();
  said.two = await labels();
  press("label-all", "none");
  said.none = await labels();
  press("label-all", "all");
  said.again = await labels();
  press("axis", 2); put("at-number", AT_2);
  said.lines = [];
  for (const lines of ["cells", "labels"]) {
    press("lines", lines);
    said.lines.push(Number(canvas.dataset.lines), (await labels())[5]);
  }
  return said;
};
addEventListener("load", () => setTimeout(async () => {
  const said = await run().catch((error) => ({ error: String(error) }));
  parent.postMessage({ name: document.title, said }, "*");
}, 400));
</script>"""
FRAME = """<body><script>addEventListener("message", (event) => {
  document.documentElement.dataset[event.data.name] = JSON.stringify(event.data.said);
});</script>
<iframe src="page.html" width="1000" height="700"></iframe>
<iframe src="warped.html" width="1000" height="700"></iframe><iframe src="blind.html"></iframe>
<iframe src="narrow.html" width="380" height="600"></iframe></body>"""
TABLE = LabelTable({2: "left <lung>", 9: "not there"}, {2: (0.0, 1.0, 0.2)})
# mm from the middle: the coronal cut, the axial one, and the one the page begins with
AT = (0.23, -1.37, 3.1)
CLICKS = [[300, 300], [340, 390], [420, 280]]


def middle_of(mesh):
    return (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2


def inner_facets(mesh, below):
    """Facets without a node on the surface and under a level: from above, other cells hide them
    all.
    """
    nodes = facets(mesh.cells).nodes
    is_outer = np.isin(nodes, boundary_facets(mesh.cells)).any(axis=1)
    return nodes[~is_outer & (mesh.points[nodes][..., 2].max(axis=1) < below)]


def pressed(mesh):
    """Results of two steps at the nodes of order 2 (those in the middles of edges are not
    drawn), and a temperature.
    """
    x, y, z = (mesh.points - mesh.points.min(axis=0)).T / np.ptp(mesh.points, axis=0).max()
    data = {
        "on_top": np.zeros((len(x), 2)),
        "displacement": np.column_stack([0.6 * (x - 0.3) * z, -0.4 * y * z, 1.0 - z]),
        "displacement_step2": np.column_stack([1.5 * z**2, 0.4 * x, 0.0 * x]),
        "heat": np.where(np.arange(len(x)) % 17 == 0, np.nan, x),
        "von_mises_nodes": z,
        "von_mises_nodes_step2": 2.0 * z,
        "strain_nodes": np.zeros((len(x), 9)),
        "strain_nodes_step2": np.ones((len(x), 9)),
    }
    return {
        name: np.concatenate([values, np.full_like(values, 1e9)]) for name, values in data.items()
    }


@pytest.fixture(scope="module")
def shown(tmp_path_factory, mesh, cell_data, image):
    """What the page says and shows, in one run of a browser: as it is, deformed, without WebGL,
    in a narrow window.
    """
    folder = tmp_path_factory.mktemp("explore")
    middle = middle_of(mesh)
    thin = np.argmin(np.ptp(mesh.points, axis=0))
    places = zip((thin, 1, 2), (AT[2], AT[0], AT[1]), strict=True)
    words = {f"AT_{k}": middle[axis] + at for k, (axis, at) in enumerate(places)}
    probe = PROBE
    for word, value in (words | {"CLICKS": CLICKS}).items():
        probe = probe.replace(word, str(value))
    inner = inner_facets(mesh, below=words["AT_2"] - 5.0)
    sets = {"outer": boundary_facets(mesh.cells), "inner": inner}
    forces = {1: {"outer": [3.0, -4.0, 0.0]}, 2: {"outer": [0.0, 0.5, 1234.56]}}
    results = pressed(mesh)
    of_one_step = {name: results[name] for name in results if name != "displacement_step2"}
    for title, of_nodes in {
        "page": {},
        "warped": results,
        "blind": {},
        "narrow": of_one_step,
    }.items():
        text = explorer_html(exhibit(mesh, cell_data, image, title, sets, of_nodes, forces, TABLE))
        first = FRAMES + BLIND if title == "blind" else FRAMES
        copied(text, folder / f"{title}.html", first, probe)
    frame = copied(FRAME, folder / "frame.html")
    said = re.findall(
        r'data-(page|warped|blind|narrow)="([^"]*)"', document(frame, "--window-size=1500,2300")
    )
    return {name: json.loads(html.unescape(text)) for name, text in said}


@pytest.mark.deep
def test_counts_and_surfaces(shown, mesh, cell_data):
    """Cells and volume within the limits, facets of what is left and polygons of the cut are
    those numpy finds.
    """
    page, mean, label = shown["page"], cell_data["mean"], cell_data["label"]
    middle = middle_of(mesh)
    thin = int(np.argmin(np.ptp(mesh.points, axis=0)))
    beyond = centroids(mesh.points, mesh.cells)[:, thin] - middle[thin]
    every = np.full(len(mesh.cells), True)
    within = (mean >= 45) & (mean <= 60)

    def expected(is_counted, is_drawn, axis=None, at=0.0):
        n_polygons = 0
        if axis is not None:
            height = mesh.points[:, axis] - middle[axis] - at
            assert np.abs(height).min() > 1e-4  # else single precision decides
            n_polygons = len(plane_cut(mesh.points, mesh.cells[is_counted], height).cells)
        n_facets = len(boundary_facets(mesh.cells[is_drawn]))
        return is_counted.sum(), mesh.cell_volumes[is_counted].sum(), n_facets, n_polygons

    for name, (count, volume, n_facets, n_polygons) in {
        "first": expected(every, every, thin),
        "whole": expected(every, beyond <= AT[2]),
        "turned": expected(every, beyond >= AT[2]),
        "uncut": expected(every, every),
        "within": expected(within, within),
        "cut": expected(within, within, 1, AT[0]),
        "label": expected(label >= 2, label >= 2, 1, AT[0]),
    }.items():
        text, *drawn = page[name][:3]
        numbers = re.fullmatch(r"([\d,]+) of ([\d,]+) cells, ([\d,.]+)\u00a0mm³", text).groups()
        shown_count, all_cells, shown_volume = (float(part.replace(",", "")) for part in numbers)
        assert (shown_count, all_cells) == (count, len(mesh.cells)), name
        assert shown_volume == pytest.approx(volume, rel=2e-6), name
        assert drawn == [n_facets, n_polygons], name
    assert page["crossed"][3:] == ["70", "70"]  # the upper limit went along


def places_of(page, mesh, pixels, radius=None):
    """World places (K, 3), mm, of pixels (K, 2) seen from above in the axial cut, and how many mm
    a pixel is.
    """
    size = np.array(page["size"])
    extent = np.linalg.norm(np.ptp(mesh.points, axis=0)) if radius is None else 2 * radius
    mm = extent / size.min()
    away = (np.array(pixels) + 0.5 - size / 2) * [mm, -mm]
    return np.column_stack([away, np.full(len(away), AT[1])]) + middle_of(mesh), mm


def cells_at(mesh, xyz):
    """The cell around each place (K, 3), -1 for none, and how far the nearest of its facets is
    in the axial plane.
    """
    corners = mesh.points[mesh.cells]
    # columns are the gradients of three barycentric functions
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    gradients = np.concatenate([-inverse.sum(axis=2, keepdims=True), inverse], axis=2)  # (M, 3, 4)
    cells, distances = np.full(len(xyz), -1), np.zeros(len(xyz))
    for k, place in enumerate(xyz):
        fraction = np.einsum("mij,mi->mj", gradients, place - corners[:, 0]) + np.eye(4)[0]
        inside = fraction.min(axis=1)
        if inside.max() > 0:
            cells[k] = inside.argmax()
            slopes = np.linalg.norm(gradients[cells[k], :2], axis=0)
            distances[k] = (fraction[cells[k]] / slopes).min()
    return cells, distances


def clear_cells(page, mesh, shape, n_least, radius=None):
    """Which places of the grid are well within a cell of the shape, and which cell it is."""
    places, mm = places_of(page, mesh, np.array(page["cells"])[:, :2], radius)
    cells, distances = cells_at(shape, places)
    clear = np.flatnonzero((distances > 2.5 * mm) & (cells >= 0))  # of lines
    assert len(clear) > n_least
    return clear, places[clear], cells[clear]


def colours_of(field, values):
    """Of the colour table, grey where there is no value."""
    low, high = field.limits
    step = np.rint(255 * np.clip((values - low) / (high - low), 0, 1))
    colours = colour_table()[np.nan_to_num(step).astype(int)].astype(int)
    return np.where(np.isnan(step)[:, None], 0xAA, colours)


def assert_greys(colours, image, places, margin, n_least):
    """Pixels are grey as the voxels at these places, but for those at voxels' sides, where
    rounding decides, and within the margin, clear of smoothed outlines.
    """
    index = image.to_index(places)
    is_clear = (np.abs(index - np.rint(index)) < 0.48).all(axis=1)
    is_clear &= ((index + 0.5 > margin) & (index + 0.5 < np.array(image.shape) - margin)).all(
        axis=1
    )
    assert is_clear.sum() > n_least
    greys = greys_of(image, index[is_clear])
    assert_allclose(
        np.array(colours)[is_clear, 2:], np.repeat(greys[:, None], 3, axis=1), atol=1.01
    )


@pytest.mark.deep
def test_the_section_shows_the_cells_it_cuts(shown, mesh, cell_data):
    page = shown["page"]
    clear, _, cells = clear_cells(page, mesh, mesh, 400)
    field, _ = exhibit(mesh, cell_data).fields
    expected = colours_of(field, field.values[cells])
    assert_allclose(np.array(page["cells"])[clear, 2:], expected, atol=2)


@pytest.mark.deep
def test_the_slice_shows_the_voxel_at_every_place(shown, mesh, image):
    page = shown["page"]
    places, _ = places_of(page, mesh, np.array(page["cells"])[:, :2])
    assert_greys(page["slice"], image, places, 0.15, 800)


@pytest.mark.deep
def test_a_click_reads_a_cell(shown, mesh, cell_data):
    page = shown["page"]
    cells, _ = cells_at(mesh, places_of(page, mesh, CLICKS)[0])
    for cell, text in zip(cells, page["picked"], strict=True):
        assert text.startswith(f"Cell {cell}\n")
        assert re.search(rf"label\t{cell_data['label'][cell]}( left <lung>)?\n", text)
        mean = float(re.search(r"mean \(intensity\)\t(\S+)", text)[1])
        assert mean == pytest.approx(cell_data["mean"][cell], rel=1e-5)


def moved(mesh, factor, name="displacement"):
    return tetopt.Mesh(mesh.points + factor * pressed(mesh)[name][: len(mesh.points)], mesh.cells)


def test_results_at_the_nodes_are_fields_and_deformations(mesh, cell_data):
    shown = exhibit(mesh, cell_data, point_data=pressed(mesh))
    names = [
        (field.name, field.unit, field.step, field.nodes is not None) for field in shown.fields
    ]
    assert names == [
        ("displacement", "mm", 1, True),
        ("displacement", "mm", 2, True),
        ("heat", "", 0, True),
        ("von_mises_nodes", "kPa", 1, True),
        ("von_mises_nodes", "kPa", 2, True),
        ("mean", "intensity", 0, False),
        ("label", "", 0, False),
    ]
    assert shown.skipped == ["strain", "on_top", "strain_nodes"]
    lengths = np.linalg.norm(pressed(mesh)["displacement_step2"][: len(mesh.points)], axis=1)
    second = shown.fields[1]
    assert_allclose(second.nodes, lengths, rtol=1e-6)
    assert_allclose(second.values, lengths[mesh.cells].mean(axis=1), rtol=1e-6)
    assert_allclose(second.limits, np.percentile(lengths, [1, 99]), rtol=1e-6)
    assert list(shown.displacements) == [1, 2]

    def with_displacement(values):
        return exhibit(mesh, cell_data, point_data={"displacement": values})

    alone = with_displacement(pressed(mesh)["displacement"])
    assert (list(alone.displacements), alone.fields[0].step) == ([0], 0)
    for odd in (np.full((len(mesh.points), 3), np.nan), np.zeros((len(mesh.points), 2))):
        assert with_displacement(odd).skipped == ["strain", "displacement"]


@pytest.mark.parametrize(
    ("times", "first"), [(1.0, 1.0), (0.1, 1.0), (1e-3, 50.0), (2.4e-3, 20.0), (0.0, 1.0)]
)
def test_a_displacement_is_drawn_so_that_it_is_seen(mesh, times, first):
    """Its largest is some twentieth of the diagonal, by a round factor that is never less than
    1.
    """
    along = np.zeros_like(mesh.points)
    along[3, 1] = -times * np.linalg.norm(np.ptp(mesh.points, axis=0))
    factors = warp_factors(exhibit(mesh, {}, point_data={"displacement": along}))
    assert factors == pytest.approx((first, 5.0 * first), rel=1e-12)


def test_the_first_cut_shows_the_most(mesh):
    extent = np.ptp(mesh.points, axis=0)
    assert first_axis(exhibit(mesh, {})) == np.argmin(extent)
    for across in range(3):
        u = np.full((len(mesh.points), 3), -2.0)
        u[:, across] = 1.0
        shown = exhibit(mesh, {}, point_data={"displacement": u})
        assert first_axis(shown) == across
    assert loaded_side(exhibit(mesh, {})) == [0.0, 0.0, 0.0]
    pressed = np.zeros((len(mesh.points), 3))
    pressed[mesh.points[:, 2] == mesh.points[:, 2].min(), 2] = 1.0
    side = loaded_side(exhibit(mesh, {}, point_data={"displacement": pressed}))
    assert side[2] == -1.0


@pytest.mark.deep
def test_a_slider_deforms_the_mesh(shown, mesh):
    """At rest, and as far as it goes, the plane cuts the cells that it cuts in numpy."""
    page = shown["warped"]
    fields = ["displacement (mm)", "heat", "von_mises_nodes (kPa)", "mean (intensity)", "label"]
    assert page["names"] == [fields, fields, ["1", "2"]]
    assert f"{len(mesh.points)} corner nodes (of {2 * len(mesh.points)})" in page["about"]
    first, most = warp_factors(exhibit(mesh, {}, point_data=pressed(mesh)))
    assert page["first"][:3] == [f"{first:g}", f"Deformation × {first:g}", "displacement (mm)"]
    at = middle_of(mesh)[2] + AT[1]
    for name, factor in (("rest", 0.0), ("most", most)):
        points = moved(mesh, factor).points
        assert np.abs(points[:, 2] - at).min() > 1e-4  # else single precision decides
        polygons = plane_cut(points, mesh.cells, points[:, 2] - at).cells
        words = f"Deformation × {factor:g}" if factor else "At rest"
        assert page[name][:2] + page[name][4:] == [f"{factor:g}", words, len(polygons)]
    assert page["rest"][4] != page["most"][4]


@pytest.mark.deep
def test_the_second_step_is_drawn_interpolated_and_picked(shown, mesh, image):
    page = shown["warped"]
    shape = moved(mesh, 1.5, "displacement_step2")
    middle, first = middle_of(mesh), warp_factors(exhibit(mesh, {}, point_data=pressed(mesh)))[0]
    farthest = np.abs(moved(mesh, first).points - middle).max(axis=0)
    radius = max(np.linalg.norm(np.ptp(mesh.points, axis=0)) / 2, np.linalg.norm(farthest))
    clear, places, cells = clear_cells(page, mesh, shape, 300, radius)
    corners = shape.points[mesh.cells[cells]]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    last = np.linalg.solve(edges, (places - corners[:, 0])[..., None])[..., 0]
    fractions = np.column_stack([1.0 - last.sum(axis=1), last])

    def interpolated(at_nodes):
        return np.einsum("kc,kc...->k...", fractions, at_nodes[mesh.cells[cells]])

    field = exhibit(mesh, {}, point_data=pressed(mesh)).fields[1]
    expected = colours_of(field, interpolated(field.nodes))
    assert_allclose(np.array(page["cells"])[clear, 2:], expected, atol=3)
    carried = np.array(page["carried"])[clear]
    assert_greys(carried, image, interpolated(mesh.points), 0.05, 200)
    assert page["second"][1:3] == ["Deformation × 1.5", "displacement (mm)"]
    numbers = [float(text) for text in re.findall(r"[\d.]+", page["second"][3])]
    assert_allclose(numbers, [field.nodes.min(), field.nodes.max()], rtol=1e-4)
    cell = cells_at(shape, places_of(page, mesh, CLICKS[:1], radius)[0])[0][0]
    picked = page["picked"]
    assert picked.startswith(f"Cell {cell}\n")
    length = float(re.search(r"displacement \(mm\), mean of its nodes\t(\S+)", picked)[1])
    assert length == pytest.approx(field.values[cell], rel=1e-5)
    centroid = re.search(r"centroid \(RAS, mm\)\t(\S+), (\S+), (\S+)", picked).groups()
    # at rest
    assert_allclose([*map(float, centroid)], mesh.points[mesh.cells[cell]].mean(axis=0), atol=0.051)
    assert page["grey"]  # nodes without a value
    assert page["reactions"] == [
        "reaction 1,235 mN: R 0, A 0.5, S 1,235",
        "reaction 5 mN: R 3, A -4, S 0",
        "",
    ]


NAMES = ["0", "1", "2 left <lung>", "3"]


@pytest.mark.deep
def test_labels_have_a_legend(shown, mesh, cell_data):
    _, field = exhibit(mesh, cell_data, table=TABLE).fields
    assert (field.names, field.categories[2][1]) == ({2: "left <lung>"}, "#00ff33")
    rgb = [tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5)) for _, colour in field.categories]
    legend = [[name, f"rgb{colour}"] for name, colour in zip(NAMES, rgb, strict=True)]
    assert shown["page"]["labels"] == legend
    assert shown["page"]["rows"] == NAMES


@pytest.mark.deep
def test_labels_are_shown_by_name(shown, mesh, cell_data):
    """One alone, its surface among the others' interfaces as glass; two; none; and all again."""
    page, label, sides = shown["page"], cell_data["label"], facets(mesh.cells)
    inner = label[sides.cells[sides.n_cells == 2]]
    rows = [page[name] for name in ("every", "only", "unglazed", "two", "none", "again")]
    of_all = (inner[:, 0] != inner[:, 1]) & ~np.isin(inner, [2]).any(axis=1)
    glass = [0, np.count_nonzero(of_all), 0, 0, 0, 0]
    for row, labels, n_glass in zip(
        rows, [[0, 1, 2, 3], [2], [2], [0, 2], [], [0, 1, 2, 3]], glass, strict=True
    ):
        is_shown = np.isin(label, labels)
        n_facets = len(boundary_facets(mesh.cells[is_shown])) if labels else 0
        assert row[0].startswith(f"{is_shown.sum():,} of {len(label):,} cells")
        assert row[1:3] == [n_facets, n_glass]
        assert row[4] == ([NAMES[k] for k in labels] if row is not rows[0] else [])
    assert rows[0][3] == "mean (intensity)"
    assert {row[3] for row in rows[1:]} == {"label"}  # the choice colours the cells, too
    n_lines, picture, n_of_labels, picture_of_labels = page["lines"]
    height = mesh.points[:, 2] - middle_of(mesh)[2] - AT[1]
    is_above = height[mesh.cells] >= 0.0
    n_above = is_above.sum(axis=1)[:, None] - is_above  # of the three corners opposite to each
    is_cut = (n_above > 0) & (n_above < 3)
    of_side = sides.cells[sides.of_cell]
    other = np.where(
        of_side[..., 0] == np.arange(len(label))[:, None], of_side[..., 1], of_side[..., 0]
    )
    is_border = (other < 0) | (label[other] != label[:, None])
    assert (n_lines, n_of_labels) == (is_cut.sum(), (is_cut & is_border).sum())
    assert n_of_labels < n_lines
    assert picture != picture_of_labels
    assert len({row[5] for row in rows[:5]}) == 5  # the glass, too, is seen


@pytest.mark.deep
def test_the_view_turns_and_zooms(shown):
    assert shown["page"]["changed"] == [True, False, True, False, True, False, True, True]


@pytest.mark.deep
def test_it_fits_a_narrow_window(shown):
    assert shown["narrow"] == {"over": 0}
    assert shown["page"]["over"] == 0


@pytest.mark.deep
def test_without_webgl_it_is_said(shown):
    assert (
        "This browser does not support WebGL 2, so the mesh cannot be shown"
        in shown["blind"]["words"]
    )


def ball(radius=30.0, n=600):
    """A mesh of a convex ball, of random nodes on its surface and inside."""
    random = np.random.default_rng(3)
    places = random.normal(size=(2 * n, 3))
    places /= np.linalg.norm(places, axis=1)[:, None]
    places[n:] *= 0.93 * random.random((n, 1)) ** (1 / 3)
    points = radius * places
    cells = Delaunay(points).simplices.astype(np.int64)
    return tetopt.Mesh(points, orient_cells(points, cells))


@pytest.mark.deep
def test_nothing_is_drawn_beside_a_cut_body(tmp_path):
    """Facets of the removed part, seen edge-on beside the kept one, leave no dots."""
    mesh = ball()
    heights = np.linspace(-15.0, 15.0, 13)
    probe = f"""<script>addEventListener("load", () => setTimeout(async () => {{
  const said = [], at = document.getElementById("at-number");
  for (const height of {heights.tolist()}) {{
    at.value = height;
    at.dispatchEvent(new Event("change"));
    await new Promise((done) => setTimeout(done, 60));
    said.push(document.querySelector("canvas").toDataURL());
  }}
  document.documentElement.dataset.said = said.join(" ");
}}, 400));</script>"""
    text = explorer_html(exhibit(mesh, {"label": np.ones(len(mesh.cells), dtype=np.int64)}))
    shown = document(copied(text, tmp_path / "page.html", last=probe), "--window-size=1000,700")
    urls = re.search(r'data-said="([^"]*)"', shown)[1].split(" ")
    bodies = []
    for url in urls:
        stream = io.BytesIO(base64.b64decode(url.partition(",")[2]))
        picture = np.asarray(PIL.Image.open(stream).convert("RGB"))
        bodies.append(ndimage.label(picture.min(axis=2) < 250, np.ones((3, 3)))[1])
    assert bodies == [1] * len(heights)
