// Shared code of the 3-D views: lists of triangles on the graphics card, a camera that turns about the middle, and its
// control by pointers, wheel and keys. A view's own script follows in the same scope.

const VERTEX = `#version 300 es
  precision highp float; precision highp int;
  in vec3 place; in uint tag; in float value; in vec3 origin;
  uniform mat3 turn; uniform vec3 scale; uniform vec2 shift;
  centroid out vec3 world; centroid out vec3 rest;
  out vec3 seen; out vec3 corner; out float level; flat out uint cell; flat out uint sides;
  void main() {
    int k = gl_VertexID % 3;  // vertices are not shared, so this is the corner's number in its triangle
    corner = vec3(k == 0, k == 1, k == 2);
    world = place;
    rest = origin;
    level = value;
    seen = turn * place;
    cell = tag >> 3;
    sides = tag & 7u;
    gl_Position = vec4((seen.xy + shift) * scale.xy, -seen.z * scale.z, 1.0);
  }`;
// The beginning of a view's fragment shader: the line along the drawn sides, 0 to 1, and the light on a facet.
const SHADING = `#version 300 es
  precision highp float; precision highp int; precision highp sampler3D;
  // Positions within the triangle: at a pixel's centre beside a steep facet, they would be those of the kept side.
  centroid in vec3 world; centroid in vec3 rest;
  in vec3 seen; in vec3 corner; in float level; flat in uint cell; flat in uint sides;
  out vec4 colour;
  float edge() {
    vec3 step = fwidth(corner);
    vec3 away = smoothstep(vec3(0.0), 1.3 * step, corner);
    for (int k = 0; k < 3; k++) if ((sides & (1u << k)) == 0u) away[k] = 1.0;
    // Lines would cover triangles that are only a few pixels wide: they fade there.
    return (1.0 - min(min(away.x, away.y), away.z)) * clamp(0.25 / max(max(step.x, step.y), step.z), 0.0, 1.0);
  }
  float light(float least) {
    vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
    return least + (1.0 - least) * max(dot(normal, normalize(vec3(-0.35, 0.5, 0.8))), 0.0);
  }`;

function bytes(text) {
  const letters = atob(text);
  const numbers = new Uint8Array(letters.length);
  for (let i = 0; i < numbers.length; i++) numbers[i] = letters.charCodeAt(i);
  return numbers.buffer;
}

// Triangles with three corners of their own; a tag is the cell's number and the drawn sides, as bits; a value is that of
// a field at the nodes; an origin, if the list has them, is the undeformed position of the corner.
class Triangles {
  constructor(capacity, hasOrigins = false) {
    this.places = new Float32Array(9 * capacity);
    this.tags = new Uint32Array(3 * capacity);
    this.values = new Float32Array(3 * capacity);
    this.origins = hasOrigins ? new Float32Array(9 * capacity) : null;
    this.count = 0;
  }
  add(cell, sides, ...corners) {
    if (3 * this.count === this.tags.length) this.grow();
    corners.forEach((corner, k) => this.set(3 * this.count + k, cell, sides, ...corner));
    this.count++;
  }
  set(vertex, cell, sides, x, y, z, value = 0, origin = null) {
    this.places[3 * vertex] = x;
    this.places[3 * vertex + 1] = y;
    this.places[3 * vertex + 2] = z;
    this.tags[vertex] = cell * 8 + sides;
    this.values[vertex] = value;
    if (origin) this.origins.set(origin, 3 * vertex);
  }
  grow() {
    const more = new Triangles(Math.max(64, 2 * this.count), this.origins !== null);
    more.places.set(this.places);
    more.tags.set(this.tags);
    more.values.set(this.values);
    if (this.origins) more.origins.set(this.origins);
    [this.places, this.tags, this.values, this.origins] = [more.places, more.tags, more.values, more.origins];
  }
}

// The canvas's WebGL 2 context, or null; the buffer is preserved, so that the view is visible in print.
function webgl(canvas) {
  return canvas.getContext("webgl2", { alpha: false, antialias: true, preserveDrawingBuffer: true });
}

// A program of the shared vertex shader and a view's fragment shader, with its uniforms, its lists of triangles and its
// camera.
function painter(gl, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(1, 1, 1, 1);
  const at = (name) => gl.getUniformLocation(program, name);
  return {
    at,
    part: (hasOrigins = false) => part(gl, program, hasOrigins),
    // Clears a frame of `size` pixels, whose shorter side shows `radius` to either side of the middle at zoom 1.
    clear(size, camera, radius, depth) {
      gl.viewport(0, 0, ...size);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const zoom = camera.zoom * Math.min(...size) / radius;
      gl.uniformMatrix3fv(at("turn"), false, turned(camera));
      gl.uniform3f(at("scale"), zoom / size[0], zoom / size[1], 1 / depth);
      gl.uniform2fv(at("shift"), camera.shift);
    },
  };
}

// A list of triangles on the graphics card.
function part(gl, program, hasOrigins) {
  const array = gl.createVertexArray();
  const buffers = {};
  gl.bindVertexArray(array);
  for (const [name, numbers] of [["place", 3], ["tag", 1], ["value", 1], ["origin", 3]]) {
    const at = gl.getAttribLocation(program, name);
    if (at < 0) continue;  // the fragment shader does not use it
    buffers[name] = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
    if (name !== "origin" || hasOrigins) gl.enableVertexAttribArray(at);
    if (name === "tag") gl.vertexAttribIPointer(at, numbers, gl.UNSIGNED_INT, 0, 0);
    else gl.vertexAttribPointer(at, numbers, gl.FLOAT, false, 0, 0);
  }
  let count = 0;
  return {
    fill(triangles) {
      count = triangles.count;
      const lists = {
        place: [triangles.places, 9], tag: [triangles.tags, 3], value: [triangles.values, 3],
        origin: [triangles.origins, 9],
      };
      for (const [name, buffer] of Object.entries(buffers)) {
        const [list, size] = lists[name];
        if (!list) continue;
        gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
        gl.bufferData(gl.ARRAY_BUFFER, list.subarray(0, size * count), gl.DYNAMIC_DRAW);
      }
    },
    draw() {
      if (!count) return;
      gl.bindVertexArray(array);
      gl.drawArrays(gl.TRIANGLES, 0, 3 * count);
    },
  };
}

// Rotation of world axes to the screen's right, up and towards the viewer; by columns, as WebGL expects.
function turned(camera) {
  const [cy, sy] = [Math.cos(camera.yaw), Math.sin(camera.yaw)];
  const [cp, sp] = [Math.cos(camera.pitch), Math.sin(camera.pitch)];
  return [-sy, -sp * cy, cp * cy, cy, -sp * sy, cp * sy, 0, cp, sp];
}

// The canvas's pixels, at most two along each of the page's.
function pixels(canvas) {
  const dense = Math.min(window.devicePixelRatio || 1, 2);
  return [canvas.clientWidth, canvas.clientHeight].map((length) => Math.max(1, Math.round(length * dense)));
}

// Resize the canvas to its displayed size, and return that size.
function fitted(canvas) {
  const size = pixels(canvas);
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  return size;
}

// Request a frame: `draw` is called once, however many requests come before it.
function redrawing(draw) {
  let isWaiting = false;
  return () => {
    if (isWaiting) return;
    isWaiting = true;
    requestAnimationFrame(() => {
      isWaiting = false;
      draw();
    });
  };
}

// Turn the camera by angles, up to looking straight down or up.
function turning(camera, redraw) {
  return (right, up) => {
    camera.yaw -= right;
    camera.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, camera.pitch + up));
    redraw();
  };
}

function cameraKeys(turn, zoom) {
  return {
    ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0),
    ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1),
    "+": () => zoom(1.15), "=": () => zoom(1.15), "-": () => zoom(1 / 1.15),
  };
}

// Pointers, wheel and keys of a canvas. `turn` takes angles, `zoom` a factor and the pixel, relative to the
// middle, that stays in place, `move` (if the camera can move) and `pick` (if cells can be clicked) pixels; `wheels` tells
// whether the wheel belongs to the view or to the page.
function listen(canvas, { turn, zoom, move, pick, keys, wheels = () => true }) {
  const fingers = new Map();
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  let travelled = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    travelled = fingers.size ? Infinity : 0;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const before = fingers.size === 2 ? spread() : 0;
    const [x, y] = [event.clientX - last.x, event.clientY - last.y];
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    travelled += Math.hypot(x, y);
    if (fingers.size === 2) {
      zoom(spread() / Math.max(before, 1));
      if (move) move(x / 2, y / 2);
    } else if (move && (event.shiftKey || event.buttons === 2)) {
      move(x, y);
    } else {
      const length = Math.min(canvas.clientWidth, canvas.clientHeight);
      turn(x / length * 4, y / length * 4);
    }
  });
  canvas.addEventListener("pointerup", (event) => {
    const box = canvas.getBoundingClientRect();
    if (pick && fingers.size === 1 && travelled < 4 && event.button === 0) {
      pick(event.clientX - box.left, event.clientY - box.top);
    }
  });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
    canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("wheel", (event) => {
    if (!wheels()) return;
    event.preventDefault();
    const box = canvas.getBoundingClientRect();
    zoom(Math.exp(-0.0015 * event.deltaY * (event.deltaMode ? 30 : 1)),
      event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2);
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    if (!(event.key in keys) || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    keys[event.key]();
  });
}
