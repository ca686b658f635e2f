// The page: shows the mesh in #data cut by a plane, coloured by a field, within limits, with its image. Positions are mm
// relative to the middle of the mesh; only printed ones are world coordinates. Runs after webgl.js, explore_mesh.js
// and explore_gl.js in the same scope.

const SIDES = ["RL", "AP", "SI"];  // at the upper and the lower end of each axis
const FROM = { R: [0, 0], L: [2, 0], A: [1, 0], P: [-1, 0], S: [-1, 1], I: [-1, -1] };  // yaw and pitch, quarters
const WHOLE = { zoom: 1, shift: [0, 0] };

const $ = (id) => document.getElementById(id);
const canvas = document.querySelector("canvas");
const number = (value, digits = 5) => value.toLocaleString("en-US", {
  maximumSignificantDigits: digits, notation: value !== 0 && Math.abs(value) < 1e-3 ? "scientific" : "standard",
});
const whole = (value) => value.toLocaleString("en-US");
const called = (field, value) => [value, field.names[value]].filter((word) => word !== undefined).join(" ");
const heading = (field) => (field.unit ? `${field.name} (${field.unit})` : field.name);

function say(words) {
  $("busy").textContent = words;
  $("busy").hidden = false;
}

function start() {
  const data = JSON.parse($("data").textContent);
  const gl = webgl(canvas);
  if (!gl) {
    canvas.remove();
    say("This browser does not support WebGL 2, so the mesh cannot be shown; try another browser or machine.");
    return;
  }
  const notes = data.skipped.length
    ? [`Not shown, because they are not one number per cell or node: ${data.skipped.join(", ")}.`] : [];
  const most = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
  if (data.image && Math.max(...data.image.shape) > most) {
    notes.push(`This graphics card supports at most ${most} voxels along an axis, so the image is not shown.`);
    data.image = null;
  }
  explore(gl, data, notes);
  $("busy").hidden = true;
}

function explore(gl, data, notes) {
  const { image, centre } = data;
  const mesh = unpackedMesh(data);
  const fields = data.fields.map(unpackedField);
  const table = new Uint8Array(bytes(data.colours));
  const sets = data.sets.map((set) => ({ ...set, triangles: new Uint32Array(bytes(set.triangles)) }));
  const size = [0, 1, 2].map((k) => mesh.high[k] - mesh.low[k]);
  const displacements = data.displacements.map(({ step, u }) => ({ step, u: new Float32Array(bytes(u)) }));
  const [firstWarp, mostWarp] = data.factors;
  let depth = image ? reach({ low: image.box[0], high: image.box[1] }) : 0;
  for (const { u } of displacements) {
    deform(mesh, u, mostWarp);
    depth = Math.max(depth, reach(mesh));
  }
  if (displacements.length) deform(mesh, displacements[0].u, firstWarp);
  const radius = Math.max(Math.hypot(...size) / 2, reach(mesh));
  const drawn = renderer(gl, image, radius, 1.05 * Math.max(radius, depth), table, hex(data.noValue));

  const state = {
    field: 0, by: 0, low: fields[0].min, high: fields[0].max, axis: data.axis, at: 0, isTurned: false, isWhole: false,
    inside: "cells", fraction: 0.35, set: -1, picked: -1, warp: firstWarp, lines: "cells",
    step: displacements.length ? displacements[0].step : 0,
  };
  const camera = { ...facing(), ...WHOLE };
  const isWithin = new Uint8Array(mesh.count).fill(1);
  // The field by which labels are selected, and the hidden labels.
  const labelling = fields.findIndex((field) => field.name === data.labelField && field.categories.length > 1);
  const hidden = new Set();

  // The initial, oblique view of the cut; of a deformation, from the loaded side.
  function facing() {
    const { axis, isTurned } = state;
    const [x, y, z] = data.loaded;
    if (axis === 2) return { yaw: x || y ? Math.atan2(y, x) + 0.4 : -1.2, pitch: isTurned ? -0.85 : 0.85 };
    const [up, left] = [z < -0.5 ? -1 : 1, (axis === 1 ? x : y) < -0.5 ? -1 : 1];
    if (axis === 1) return { yaw: (isTurned ? -1 : 1) * (Math.PI / 2 - 0.57 * left), pitch: 0.4 * up };
    return { yaw: isTurned && axis === 0 ? Math.PI - 0.6 * left : 0.6 * left, pitch: 0.35 * up };
  }

  // -- drawing

  const way = () => (state.isTurned ? -1 : 1);  // nothing is shown beyond the plane, along its axis

  // The hidden half space: positions whose product with the first three numbers is above the fourth.
  function plane() {
    if (state.axis < 0 || state.isWhole) return [0, 0, 0, 1];
    return [...[0, 1, 2].map((k) => (k === state.axis ? way() : 0)), way() * state.at];
  }

  function within() {
    const { values, min, max } = fields[state.by];
    const isAll = state.low <= min && state.high >= max;  // then cells without a value are also shown
    const labels = hidden.size ? fields[labelling].values : null;
    let count = 0, volume = 0;
    for (let cell = 0; cell < mesh.count; cell++) {
      isWithin[cell] = isAll || (values[cell] >= state.low && values[cell] <= state.high) ? 1 : 0;
      if (labels && hidden.has(labels[cell])) isWithin[cell] = 0;
      count += isWithin[cell];
      volume += isWithin[cell] * mesh.volumes[cell];
    }
    $("count").textContent = `${whole(count)} of ${whole(mesh.count)} cells, ${number(volume, 7)}\u00a0mm³`;
  }

  function shown() {
    if (state.axis < 0 || !state.isWhole) return isWithin;
    return isWithin.map((is, cell) => (
      is && way() * mesh.centroids[3 * cell + state.axis] <= way() * state.at ? 1 : 0
    ));
  }

  function build() {
    const { axis, at } = state;
    const nothing = new Triangles(0, true);
    const hasSlice = axis >= 0 && image && state.inside !== "cells";
    const field = fields[state.field];
    const levels = field.nodes && nodeLevels(field);
    const lines = labelling >= 0 && state.lines === "labels" ? fields[labelling].values : null;
    const outside = surface(mesh, shown(), levels);
    // If only the image is shown, the cells of the section are drawn invisibly, so that they can be clicked.
    const cut = axis >= 0 && (hasSlice || !state.isWhole) ? section(mesh, isWithin, axis, at, levels, lines) : nothing;
    drawn.parts.surface.fill(outside);
    drawn.parts.section.fill(cut);
    // Deformed cells deform the image; around them it would be undeformed.
    const isAlone = state.inside === "image" || !displacements.length || state.warp === 0;
    drawn.parts.slice.fill(hasSlice && isAlone ? slice(image.box, axis, at) : nothing);
    const isGlass = hidden.size && $("glass").checked;
    const glass = isGlass ? interfaces(mesh, fields[labelling].values, (label) => hidden.has(label)) : nothing;
    drawn.parts.glass.fill(glass);
    canvas.dataset.glass = glass.count;
    drawn.parts.set.fill(state.set < 0 ? nothing : setTriangles(mesh, sets[state.set].triangles));
    canvas.dataset.surface = outside.count;
    canvas.dataset.section = cut.nPolygons || 0;
    canvas.dataset.lines = cut.nLines || 0;
    redraw();
  }

  const redraw = redrawing(() => {
    const fraction = state.inside === "image" ? -1 : state.inside === "cells" || !image ? 1 : state.fraction;
    drawn.frame(fitted(canvas), camera, plane(), fraction, state.picked, false);
    drawTriad();
    canvas.dataset.drawn = "1";
  });

  // -- the axes' letters

  function drawTriad() {
    const turn = turned(camera);
    const lines = [], letters = [];
    for (const axis of [0, 1, 2]) {
      const [x, y, z] = turn.slice(3 * axis, 3 * axis + 3);
      const colour = ["#c0392b", "#1e8449", "#1f5fbf"][axis];
      lines.push(`<line x1="${-30 * x}" y1="${30 * y}" x2="${30 * x}" y2="${-30 * y}" stroke="${colour}"
        stroke-width="2"/>`);
      for (const [sign, letter] of [[1, SIDES[axis][0]], [-1, SIDES[axis][1]]]) {
        letters.push([sign * z, `<text x="${43 * sign * x}" y="${-43 * sign * y}" fill="${colour}"
          opacity="${(0.75 + 0.25 * sign * z).toFixed(2)}">${letter}</text>`]);
      }
    }
    letters.sort((a, b) => a[0] - b[0]);
    $("triad").innerHTML = lines.join("") + letters.map(([, text]) => text).join("");
  }

  // -- the key to the colours

  function showKey() {
    const field = fields[state.field];
    const [low, high] = field.limits;
    document.querySelector("#key b").textContent = heading(field);
    $("scale").hidden = field.categories.length > 0;
    $("labels").hidden = !field.categories.length;
    const stops = Array.from({ length: 18 }, (_, i) => `rgb(${table.subarray(45 * i, 45 * i + 3).join()})`);
    $("bar").style.background = `linear-gradient(to right, ${stops.join()})`;
    const rounded = (value, digits) => number(Math.abs(value) < 1e-6 * (high - low) ? 0 : value, digits);
    const texts = [low, (low + high) / 2, high].map((value) => rounded(value, 3));
    if (field.least < low) texts[0] = `≤ ${texts[0]}`;
    if (field.most > high) texts[2] = `≥ ${texts[2]}`;
    $("ticks").replaceChildren(...texts.map((text) => element("span", text)));
    $("labels").classList.toggle("named", Object.keys(field.names).length > 0);
    const seen = field.categories.filter(([value]) => state.field !== labelling || !hidden.has(value));
    $("labels").replaceChildren(...seen.map(([value, colour]) => {
      const entry = element("span", "");
      entry.append(swatch(colour), called(field, value));
      return entry;
    }));
    const hasNone = !(field.least <= field.most) || (field.nodes || field.values).some(Number.isNaN);
    const range = field.least <= field.most ? `least ${rounded(field.least)}, most ${rounded(field.most)}` : "";
    $("extremes").textContent = [range, hasNone ? "grey: no value" : ""].filter(Boolean).join("; ");
  }

  // -- controls

  function element(kind, text) {
    return Object.assign(document.createElement(kind), { textContent: text });
  }

  function swatch(colour) {
    const square = element("i", "");
    square.className = "swatch";
    square.style.background = colour;
    return square;
  }

  function choose(place, options, act) {
    $(place).replaceChildren(...options.map(([text, value, title]) => {
      const button = element("button", text);
      Object.assign(button, { type: "button", title: title || "" });
      button.dataset.value = value;
      button.addEventListener("click", () => act(value));
      return button;
    }));
  }

  function press(place, value) {
    for (const button of $(place).children) {
      button.setAttribute("aria-pressed", button.dataset.value === String(value));
    }
  }

  function fill(place, names, act) {
    $(place).replaceChildren(...names.map(([text, value]) => Object.assign(element("option", text), { value })));
    $(place).onchange = () => act(Number($(place).value));
  }

  // A slider of 1000 steps between two ends, and the number beside it, which takes any value between.
  function couple(name, act) {
    const [slider, box] = [$(name), $(`${name}-number`)];
    Object.assign(slider, { min: 0, max: 1000, step: 1 });
    let ends = [0, 1];
    slider.addEventListener("input", () => {
      const part = slider.value / 1000;
      act(part === 1 ? ends[1] : ends[0] + part * (ends[1] - ends[0]));
    });
    box.addEventListener("change", () => {
      const value = box.value === "" ? NaN : Number(box.value);
      if (Number.isFinite(value)) act(Math.max(ends[0], Math.min(ends[1], value)));
      else act(null);
    });
    return (value, low, high) => {
      ends = [low, high];
      slider.value = high > low ? 1000 * (value - low) / (high - low) : 0;
      slider.disabled = box.disabled = !(high > low);
      const digits = high > low ? Math.min(20, Math.max(0, 4 - Math.floor(Math.log10(high - low)))) : 6;
      box.value = Number.isFinite(value) ? Number(value.toFixed(digits)) : "";
    };
  }

  const showAt = couple("at", (value) => cutAt(value === null ? state.at : value - centre[state.axis]));
  const showLow = couple("low", (value) => limit(value === null ? state.low : value, null));
  const showHigh = couple("high", (value) => limit(null, value === null ? state.high : value));
  const showFactor = couple("warp", (value) => warp(value === null ? state.warp : value));

  function cutAt(at) {
    state.at = Math.max(mesh.low[state.axis], Math.min(mesh.high[state.axis], at));
    showCut();
    build();
  }

  function limit(low, high) {
    const { min, max, categories } = fields[state.by];
    const near = (value) => (categories.length && value > min && value < max ? Math.round(value) : value);
    if (low !== null) state.low = near(low);
    if (high !== null) state.high = near(high);
    if (low !== null) state.high = Math.max(state.low, state.high);
    else state.low = Math.min(state.low, state.high);
    showLimits();
    within();
    build();
  }

  function showLimits() {
    const { min, max } = fields[state.by];
    showLow(state.low, min, max);
    showHigh(state.high, min, max);
    $("by").value = state.by;
  }

  function chooseBy(by) {
    Object.assign(state, { by, low: fields[by].min, high: fields[by].max });
    showLimits();
    within();
    build();
  }

  function chooseField(field) {
    const { min, max } = fields[state.by];
    state.field = field;
    $("field").value = field;
    drawn.paint(fields[field].nodes ? null : cellColours(fields[field], table, hex(data.noValue)));
    showKey();
    // Limits that exclude nothing follow the shown field.
    if (state.low <= min && state.high >= max) chooseBy(field);
    else build();
  }

  function warp(factor) {
    state.warp = factor;
    showWarp();
    build();
  }

  function showWarp() {
    if (!displacements.length) return;
    deform(mesh, displacements.find((each) => each.step === state.step).u, state.warp);
    showCut();
    showFactor(state.warp, 0, mostWarp);
    $("warped").textContent = state.warp ? `Deformation × ${number(state.warp)}` : "At rest";
  }

  // The fields of the step, and those without a step; the shown field is kept from step to step.
  function chooseStep(step) {
    const counterpart = (k) => {
      const same = fields.findIndex((field) => field.name === fields[k].name && [0, step].includes(field.step));
      return same < 0 ? fields.findIndex((field) => [0, step].includes(field.step)) : same;
    };
    state.step = step;
    showWarp();
    const options = fields.map((field, i) => [heading(field), i]).filter(([, i]) => [0, step].includes(fields[i].step));
    fill("field", options, chooseField);
    fill("by", options, chooseBy);
    const [field, by] = [counterpart(state.field), counterpart(state.by)];
    if (by !== state.by) chooseBy(by);
    else $("by").value = by;
    chooseField(field);
    showPicked();
    showReaction();
  }

  // Labels are shown or hidden; the first choice also colours the cells by them.
  function chooseLabels(isShown) {
    const { categories } = fields[labelling];
    for (const [value] of categories) {
      const is = isShown(value);
      if (is) hidden.delete(value);
      else if (is === false) hidden.add(value);
    }
    for (const box of $("label-list").querySelectorAll("input")) box.checked = !hidden.has(Number(box.value));
    within();
    if (state.field !== labelling && hidden.size) chooseField(labelling);
    else build();
    showKey();
  }

  function listLabels() {
    $("labelling").hidden = labelling < 0;
    if (labelling < 0) return;
    const field = fields[labelling];
    choose("label-all", [["all", "all"], ["none", "none"]], (which) => chooseLabels(() => which === "all"));
    $("glass").addEventListener("change", build);
    $("label-list").replaceChildren(...field.categories.map(([value, colour]) => {
      const [row, label, only] = [element("div", ""), element("label", ""), element("button", "only")];
      const box = Object.assign(element("input", ""), { type: "checkbox", value, checked: true });
      box.addEventListener("change", () => chooseLabels((each) => (each === value ? box.checked : null)));
      Object.assign(only, { type: "button", title: `show ${called(field, value)} alone` });
      only.addEventListener("click", () => chooseLabels((each) => each === value));
      label.append(box, swatch(colour), called(field, value));
      row.append(label, only);
      return row;
    }));
  }

  function showReaction() {
    const force = state.set < 0 ? null : (data.reactions[state.step] || {})[sets[state.set].name];
    const parts = force && force.map((value, k) => `${SIDES[k][0]} ${number(value, 4)}`).join(", ");
    $("reaction").textContent = force ? `reaction ${number(Math.hypot(...force), 4)} mN: ${parts}` : "";
  }

  function showCut() {
    const { axis, at } = state;
    press("axis", axis);
    $("cutting").hidden = axis < 0;
    if (axis < 0) return;
    const [upper, lower] = SIDES[axis];
    showAt(at + centre[axis], mesh.low[axis] + centre[axis], mesh.high[axis] + centre[axis]);
    $("at-name").textContent = `${upper}, mm`;
    [lower, upper].forEach((letter, i) => { $("side").children[i].textContent = `keep ${letter}`; });
    press("side", state.isTurned);
    press("style", state.isWhole);
    press("inside", state.inside);
    press("lines", state.lines);
    $("sharing").hidden = state.inside !== "both";
    $("fraction").value = state.fraction;
    $("fraction-text").textContent = `${Math.round(100 * state.fraction)} %`;
  }

  function change(changes) {
    const { axis, isTurned } = state;
    Object.assign(state, changes);
    if (state.axis >= 0 && state.axis !== axis) state.at = 0;
    if (state.axis >= 0 && (state.axis !== axis || state.isTurned !== isTurned)) Object.assign(camera, facing());
    showCut();
    build();
  }

  function showPicked() {
    const { picked } = state;
    const legend = element("legend", picked < 0 ? "Cell" : `Cell ${picked}`);
    if (picked < 0) {
      const hint = element("div", "Click on a cell to read its values.");
      hint.className = "quiet";
      $("picked").replaceChildren(legend, hint);
      return;
    }
    const table = element("table", "");
    const nodes = [...mesh.cells.subarray(4 * picked, 4 * picked + 4)];
    const middle = [0, 1, 2].map((k) => (
      nodes.reduce((sum, node) => sum + mesh.rest[3 * node + k], 0) / 4 + centre[k]
    ).toFixed(1)).join(", ");
    const rows = fields.filter((field) => [0, state.step].includes(field.step)).map((field) => [
      field.nodes ? `${heading(field)}, mean of its nodes` : heading(field),
      Number.isNaN(field.values[picked]) ? "no value"
        : field.names[field.values[picked]] ? called(field, field.values[picked]) : number(field.values[picked], 6),
    ]);
    for (const texts of [...rows, ["centroid (RAS, mm)", middle], ["nodes", nodes.join(", ")]]) {
      const row = element("tr", "");
      row.append(...texts.map((text) => element("td", text)));
      table.append(row);
    }
    $("picked").replaceChildren(legend, table);
  }

  function pick(x, y) {
    const size = pixels(canvas);
    const dense = size[0] / canvas.clientWidth;
    state.picked = drawn.cellAt(Math.floor(x * dense), size[1] - 1 - Math.floor(y * dense), size, camera, plane());
    showPicked();
    redraw();
  }

  // -- the camera

  const turn = turning(camera, redraw);
  const perPixel = () => 2 * radius / (camera.zoom * Math.min(canvas.clientWidth, canvas.clientHeight));

  // Zoom about the pixel (x, y), relative to the view's middle, which stays in place.
  function zoom(factor, x = 0, y = 0) {
    const before = perPixel();
    camera.zoom = Math.max(0.3, Math.min(100, camera.zoom * factor));
    move(x * (1 - before / perPixel()), y * (1 - before / perPixel()));
  }

  function move(x, y) {
    camera.shift = [camera.shift[0] + x * perPixel(), camera.shift[1] - y * perPixel()];
    redraw();
  }

  function look(from) {
    Object.assign(camera, WHOLE, from);
    redraw();
  }

  function step(fraction) {
    if (state.axis >= 0) cutAt(state.at + fraction * size[state.axis]);
  }

  const keys = {
    ...cameraKeys(turn, zoom),
    "0": () => look(facing()), PageUp: () => step(0.01), PageDown: () => step(-0.01),
  };

  // -- start

  function about() {
    const volume = mesh.volumes.reduce((sum, one) => sum + one, 0);
    const corners = mesh.points.length / 3;
    const nodes = data.nNodes > corners ? `${whole(corners)} corner nodes (of ${whole(data.nNodes)})`
      : `${whole(corners)} nodes`;
    const words = [`World coordinates: RAS, mm. Mesh: ${nodes}, ${whole(mesh.count)} cells, ${number(volume, 7)} mm³.`];
    if (data.volumes) words.push("Its cells are curved: volumes are theirs, but edges are drawn straight.");
    if (image) {
      const coarser = image.shape.join() === image.original.join() ? "" : `, averaged to ${image.shape.join(" × ")}`;
      words.push(`Image: ${image.original.join(" × ")} voxels${coarser}; black is ${number(image.limits[0])},
        white ${number(image.limits[1])}.`);
    }
    $("about").textContent = [...words, ...notes].join(" ");
  }

  fill("set", [["none", -1], ...sets.map((set, i) => [`${set.name} (${set.triangles.length / 3})`, i])],
    (set) => { change({ set }); showReaction(); });
  $("marking").hidden = !sets.length;
  $("imaging").hidden = !image;
  choose("axis", [["none", -1], ["sagittal", 0, "across R-L"], ["coronal", 1, "across A-P"],
    ["axial", 2, "across S-I"]], (axis) => change({ axis }));
  choose("side", [["", false], ["", true]], (isTurned) => change({ isTurned }));
  choose("style", [["through cells", false], ["whole cells", true, "cells whose centroids lie beyond the cut are hidden"]],
    (isWhole) => change({ isWhole }));
  choose("inside", [["mesh", "cells"], ["image", "image"], ["both", "both"]], (inside) => change({ inside }));
  choose("lines", [["lines of cells", "cells"], ["of labels", "labels"]], (lines) => change({ lines }));
  $("lines").hidden = labelling < 0;
  $("fraction").addEventListener("input", () => change({ fraction: Number($("fraction").value) }));
  choose("from", Object.keys(FROM).map((letter) => [letter, letter]), (letter) => {
    const [yaw, pitch] = FROM[letter].map((quarters) => quarters * Math.PI / 2);
    look({ yaw, pitch });
  });
  fill("step", displacements.map(({ step }) => [`${step}`, step]), chooseStep);
  $("deforming").hidden = !displacements.length;
  $("stepping").hidden = displacements.length < 2;
  about();
  listLabels();
  chooseStep(state.step);
  showCut();
  listen(canvas, { turn, zoom, move, pick, keys });
  canvas.addEventListener("pointerdown", () => canvas.focus());
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  new ResizeObserver(redraw).observe(canvas);
  $("controls").hidden = false;
}

// Starts after the first paint, so that the page shows its status: a large mesh takes seconds.
setTimeout(() => {
  try {
    start();
  } catch (error) {
    console.error(error);
    say(`The mesh cannot be shown: ${error.message}`);
  }
}, 30);
