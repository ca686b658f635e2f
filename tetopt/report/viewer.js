// Draws the surfaces in #views-data, one for each canvas in .views, from one common camera.
"use strict";
(() => {
  const VERTEX = `#version 300 es
    in vec3 place; in float tone;
    uniform mat3 turn; uniform vec2 zoom;
    out vec3 seen; out vec3 corner; flat out float grey;
    void main() {
      int k = gl_VertexID % 3;  // vertices are not shared, so this is the corner's number in its triangle
      corner = vec3(k == 0, k == 1, k == 2);
      seen = turn * place;
      grey = tone;
      gl_Position = vec4(seen.xy * zoom, -0.5 * seen.z, 1.0);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 seen; in vec3 corner; flat in float grey;
    out vec4 colour;
    void main() {
      vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
      float light = 0.5 + 0.5 * max(dot(normal, normalize(vec3(-0.35, 0.5, 0.8))), 0.0);
      vec3 step = fwidth(corner);
      vec3 away = smoothstep(vec3(0.0), 1.3 * step, corner);
      // Where a triangle is only a few pixels wide, lines would cover it: they fade.
      float edge = (1.0 - min(min(away.x, away.y), away.z)) * clamp(0.25 / max(max(step.x, step.y), step.z), 0.0, 1.0);
      colour = vec4(mix(vec3((0.2 + 0.8 * grey) * light), vec3(1.0, 0.69, 0.0), 0.75 * edge), 1.0);
    }`;
  const START = { yaw: Math.atan2(1.25, 0.9), pitch: 0.43, zoom: 1.05 };  // from the right, front and above
  const camera = { ...START };
  const drawers = [];

  function bytes(text) {
    return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  }

  // Each triangle with its own three corners, as flat values and lines along its sides need.
  function unshared(view) {
    const points = new Int16Array(bytes(view.points));
    const triangles = new Uint32Array(bytes(view.triangles));
    const tones = new Uint8Array(bytes(view.tones));
    const places = new Int16Array(4 * triangles.length);  // the fourth only keeps them aligned
    const greys = new Uint8Array(triangles.length);
    triangles.forEach((node, i) => {
      places.set(points.subarray(3 * node, 3 * node + 3), 4 * i);
      greys[i] = tones[Math.floor(i / 3)];
    });
    return { places, greys, count: triangles.length };
  }

  function program(gl) {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return made;
  }

  function attribute(gl, made, name, data, size, kind, stride) {
    const at = gl.getAttribLocation(made, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, kind, true, stride, 0);
  }

  // World axes to the screen's right, up and towards the eye; column by column, as WebGL takes it.
  function turned() {
    const [cy, sy] = [Math.cos(camera.yaw), Math.sin(camera.yaw)];
    const [cp, sp] = [Math.cos(camera.pitch), Math.sin(camera.pitch)];
    return [-sy, -sp * cy, cp * cy, cy, -sp * sy, cp * sy, 0, cp, sp];
  }

  function drawer(canvas, view) {
    // A kept buffer, so that the view is also there when the page is printed.
    const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
    if (!gl) return null;
    const made = program(gl);
    const { places, greys, count } = unshared(view);
    attribute(gl, made, "place", places, 3, gl.SHORT, 8);
    attribute(gl, made, "tone", greys, 1, gl.UNSIGNED_BYTE, 1);
    gl.useProgram(made);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(1, 1, 1, 1);
    return () => {
      const dense = Math.min(window.devicePixelRatio || 1, 2);
      const size = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.max(1, Math.round(length * dense)));
      if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
      gl.viewport(0, 0, size[0], size[1]);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.uniformMatrix3fv(gl.getUniformLocation(made, "turn"), false, turned());
      const short = Math.min(size[0], size[1]);
      gl.uniform2f(gl.getUniformLocation(made, "zoom"), camera.zoom * short / size[0], camera.zoom * short / size[1]);
      gl.drawArrays(gl.TRIANGLES, 0, count);
      canvas.dataset.drawn = "1";
    };
  }

  let isWaiting = false;
  function redraw() {
    if (isWaiting) return;
    isWaiting = true;
    requestAnimationFrame(() => {
      isWaiting = false;
      drawers.forEach((draw) => draw());
    });
  }

  function turn(right, up) {
    camera.yaw -= right;
    camera.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, camera.pitch + up));
    redraw();
  }

  function zoom(factor) {
    camera.zoom = Math.max(0.4, Math.min(40, camera.zoom * factor));
    redraw();
  }

  function reset() {
    Object.assign(camera, START);
    redraw();
  }

  const KEYS = {
    ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0),
    ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1),
    "+": () => zoom(1.15), "=": () => zoom(1.15), "-": () => zoom(1 / 1.15), "0": reset,
  };

  function listen(canvas) {
    const fingers = new Map();
    const spread = () => {
      const [a, b] = [...fingers.values()];
      return Math.hypot(a.x - b.x, a.y - b.y);
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      const before = fingers.size === 2 ? spread() : 0;
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (fingers.size === 2) zoom(spread() / Math.max(before, 1));
      else turn((event.clientX - last.x) / canvas.clientWidth * 4, (event.clientY - last.y) / canvas.clientHeight * 4);
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
      canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    }
    // Only a view that was clicked takes the wheel: the others let the page scroll by.
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      zoom(Math.exp(-0.0015 * event.deltaY * (event.deltaMode ? 30 : 1)));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      if (!(event.key in KEYS) || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      KEYS[event.key]();
    });
  }

  function addButtons(place) {
    const made = [["−", "zoom out", KEYS["-"]], ["+", "zoom in", KEYS["+"]], ["reset", "reset the views", reset]];
    for (const [text, label, act] of made) {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: text, ariaLabel: label });
      button.addEventListener("click", act);
      place.append(button);
    }
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
      listen(canvas);
      new ResizeObserver(redraw).observe(canvas);
    } else {
      const note = document.createElement("p");
      note.className = "failure";
      note.textContent = "This browser has no WebGL 2, so the 3-D view cannot be shown; see the cutaway picture.";
      canvas.replaceWith(note);
    }
  });
  if (drawers.length) addButtons(document.querySelector(".viewer-buttons"));
  drawers.forEach((draw) => draw());
})();
