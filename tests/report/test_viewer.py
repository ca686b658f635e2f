"""The 3-D view: the surface is that of the opened mesh, the data arrive, a browser draws them."""

import base64
import json
import re

import numpy as np
import PIL.Image
import pytest
from browser import BLIND, browser, copied, document

import tetopt
from tetopt.errors import InputError
from tetopt.report.colours import grey_limits
from tetopt.report.page import package_text, write_page
from tetopt.report.viewer import View, view_of, views_html


@pytest.fixture(scope="module")
def opened():
    image = tetopt.load_phantom("two_spheres").image(voxel_mm=4.0)
    mesh = tetopt.lattice_mesh(image, nodes=400)
    means = np.random.default_rng(0).normal(size=len(mesh.cells))
    return mesh, means, view_of(mesh, means, "a lattice")


def kept_cells(mesh):
    middle = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2
    return np.flatnonzero(~(mesh.points[mesh.cells].mean(axis=1) > middle).all(axis=1))


def test_the_surface_encloses_the_kept_cells(opened):
    """Its volume by the divergence theorem is theirs: closed, and turned outwards."""
    mesh, _, view = opened
    corners = view.points[view.triangles]
    enclosed = np.linalg.det(corners).sum() / 6.0
    cells = mesh.points[mesh.cells[kept_cells(mesh)]]
    assert enclosed == pytest.approx(np.linalg.det(cells[:, 1:] - cells[:, :1]).sum() / 6.0)
    assert len(kept_cells(mesh)) < len(mesh.cells)


def test_a_triangle_has_the_value_of_its_cell(opened):
    mesh, means, view = opened
    cell_of = {}
    for cell in kept_cells(mesh):
        for left_out in range(4):
            corners = np.delete(mesh.points[mesh.cells[cell]], left_out, axis=0)
            cell_of.setdefault(tuple(sorted(map(tuple, corners))), []).append(cell)
    for triangle, value in zip(view.triangles, view.values, strict=True):
        (cell,) = cell_of[tuple(sorted(map(tuple, view.points[triangle])))]
        assert value == means[cell]


def test_view_of_refuses(opened):
    mesh, means, _ = opened
    with pytest.raises(InputError, match="one mean for each"):
        view_of(mesh, means[:-1], "t")
    with pytest.raises(InputError, match="tetrahedra"):
        view_of(tetopt.Mesh([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]]), np.zeros(1), "t")


def unpacked(text):
    data = re.search(r'id="views-data">(.*?)</script>', text, re.DOTALL).group(1)
    kinds = {"points": "<i2", "triangles": "<u4", "tones": "u1"}
    return [
        {key: np.frombuffer(base64.b64decode(view[key]), kind) for key, kind in kinds.items()}
        for view in json.loads(data)
    ]


def test_the_data_are_the_surfaces_in_one_box(opened):
    _, _, view = opened
    moved = View("moved", view.points + 5.0, view.triangles[:7], view.values[:7])
    packed = unpacked(views_html([view, moved]))
    both = np.concatenate([view.points, moved.points])
    low, high = both.min(axis=0), both.max(axis=0)
    low_grey, high_grey = grey_limits([view.values, moved.values])
    for each, data in zip((view, moved), packed, strict=True):
        places = data["points"].reshape(-1, 3) / 32767.0 * np.linalg.norm(high - low) / 2.0 + (low + high) / 2.0
        np.testing.assert_allclose(places, each.points, atol=np.linalg.norm(high - low) / 60000.0)
        np.testing.assert_array_equal(data["triangles"].reshape(-1, 3), each.triangles)
        expected = np.clip((each.values - low_grey) / (high_grey - low_grey), 0.0, 1.0) * 255
        np.testing.assert_allclose(data["tones"], expected, atol=0.51)


def test_titles_are_escaped_and_no_views_are_nothing(opened):
    _, _, view = opened
    text = views_html([view._replace(title='</script><b>"')])
    assert "</script><b>" not in text
    assert 'aria-label="3-D view of &lt;/script&gt;&lt;b&gt;&#34;, opened' in text
    assert views_html([]) == ""


@pytest.fixture(scope="module")
def page(tmp_path_factory, opened):
    folder = tmp_path_factory.mktemp("viewer")
    mesh, _, view = opened
    views = views_html([view, view_of(mesh, np.zeros(len(mesh.cells)), "flat")])
    write_page(folder / "a.html", "t", views, package_text("report/viewer.css"))
    return folder / "a.html"


PROBE = """<script>addEventListener("load", () => setTimeout(() => {
  const canvases = [...document.querySelectorAll("canvas")];
  const shot = () => canvases.map((c) => c.toDataURL());
  const first = shot(), said = [];
  const after = (act, then) => { act(); requestAnimationFrame(() => setTimeout(then, 50)); };
  const send = (name, type, more) => canvases[0].dispatchEvent(
    new type(name, { bubbles: true, cancelable: true, ...more }));
  const changed = () => shot().map((s, i) => s !== first[i]).join();
  canvases[0].setPointerCapture = () => {};
  after(() => { send("pointerdown", PointerEvent, { pointerId: 1, clientX: 50, clientY: 50 });
                send("pointermove", PointerEvent, { pointerId: 1, clientX: 90, clientY: 60 });
                send("pointerup", PointerEvent, { pointerId: 1 }); }, () => {
    said.push("drag " + changed());
    after(() => document.querySelectorAll(".viewer-buttons button")[2].click(), () => {
      said.push("reset " + changed());
      after(() => send("keydown", KeyboardEvent, { key: "ArrowLeft" }), () => {
        said.push("key " + changed());
        after(() => { send("keydown", KeyboardEvent, { key: "0" });
                      send("wheel", WheelEvent, { deltaY: 200 }); }, () => {
          said.push("wheel elsewhere " + changed());
          after(() => { canvases[0].focus(); send("wheel", WheelEvent, { deltaY: 200 }); }, () => {
            said.push("wheel " + changed());
            document.documentElement.dataset.said = said.join("; ");
          });
        });
      });
    });
  });
}, 200))</script>"""


@pytest.mark.deep
def test_views_turn_together(page, tmp_path):
    """Drag, keys, wheel and buttons change every view; reset brings the first picture back."""
    shown = document(copied(page.read_text(encoding="utf-8"), tmp_path / "copy.html", last=PROBE))
    said = re.search(r'data-said="([^"]*)"', shown)
    assert shown.count('data-drawn="1"') == 2
    assert said.group(1) == (
        "drag true,true; reset false,false; key true,true; wheel elsewhere false,false; wheel true,true"
    )


@pytest.mark.deep
def test_a_browser_draws_cells_and_edges(page, tmp_path):
    flags = ["--window-size=800,700", "--virtual-time-budget=2000", f"--screenshot={tmp_path / 'a.png'}"]
    browser(tmp_path / "profile", *flags, page.as_uri())
    pixels = np.asarray(PIL.Image.open(tmp_path / "a.png").convert("RGB")).astype(int)[250:550]
    left, right = pixels[:, 100:330], pixels[:, 480:710]
    grey = [np.ptp(part, axis=2) < 12 for part in (left, right)]
    assert np.std(left[grey[0]]) > 30.0  # cells of many means
    assert all((part[..., 0] - part[..., 2] > 80).mean() > 0.02 for part in (left, right))  # orange edges


@pytest.mark.deep
def test_without_webgl_it_is_said(page, tmp_path):
    shown = document(copied(page.read_text(encoding="utf-8"), tmp_path / "copy.html", BLIND))
    assert shown.count("This browser does not support WebGL 2, so the 3-D view cannot be shown") >= 2
    assert "<canvas" not in shown
