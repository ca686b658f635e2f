// Draws the surfaces in #views-data, one per canvas in .views, from a common camera.

const FRAGMENT = `${SHADING}
  void main() {
    float grey = float(cell) / 255.0;  // a view's tones belong to its cells
    colour = vec4(mix(vec3((0.2 + 0.8 * grey) * light(0.5)), vec3(1.0, 0.69, 0.0), 0.75 * edge()), 1.0);
  }`;
const START = { yaw: Math.atan2(1.25, 0.9), pitch: 0.43, zoom: 1.05, shift: [0, 0] };  // from the right, front and above
const camera = { ...START };
const drawers = [];
const redraw = redrawing(() => drawers.forEach((draw) => draw()));
const turn = turning(camera, redraw);

function zoom(factor) {
  camera.zoom = Math.max(0.4, Math.min(40, camera.zoom * factor));
  redraw();
}

function reset() {
  Object.assign(camera, START);
  redraw();
}

const keys = { ...cameraKeys(turn, zoom), "0": reset };

function surface(view) {
  const points = new Int16Array(bytes(view.points));
  const tones = new Uint8Array(bytes(view.tones));
  const triangles = new Triangles(tones.length);
  new Uint32Array(bytes(view.triangles)).forEach((node, i) => {
    const [x, y, z] = [0, 1, 2].map((k) => points[3 * node + k] / 32767);
    triangles.set(i, tones[Math.floor(i / 3)], 7, x, y, z);
  });
  triangles.count = tones.length;
  return triangles;
}

function drawer(canvas, view) {
  const gl = webgl(canvas);
  if (!gl) return null;
  const { clear, part } = painter(gl, FRAGMENT);
  const drawn = part();
  drawn.fill(surface(view));
  return () => {
    clear(fitted(canvas), camera, 1, 2);
    drawn.draw();
    canvas.dataset.drawn = "1";
  };
}

const views = JSON.parse(document.getElementById("views-data").textContent);
document.querySelectorAll(".views canvas").forEach((canvas, number) => {
  let draw = null;
  try {
    draw = drawer(canvas, views[number]);
  } catch (error) {
    console.error(error);
  }
  if (draw) {
    drawers.push(draw);
    // Only a clicked view zooms with the wheel: over the others the page scrolls.
    listen(canvas, { turn, zoom, keys, wheels: () => document.activeElement === canvas });
    new ResizeObserver(redraw).observe(canvas);
  } else {
    const note = document.createElement("p");
    note.className = "failure";
    note.textContent = "This browser does not support WebGL 2, so the 3-D view cannot be shown; see the cutaway picture.";
    canvas.replaceWith(note);
  }
});
if (drawers.length) {
  for (const [text, label, act] of [["−", "zoom out", keys["-"]], ["+", "zoom in", keys["+"]],
    ["reset", "reset the views", reset]]) {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: text, ariaLabel: label });
    button.addEventListener("click", act);
    document.querySelector(".viewer-buttons").append(button);
  }
}
drawers.forEach((draw) => draw());
