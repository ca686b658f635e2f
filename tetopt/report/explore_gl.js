// Draws the mesh's parts in the colours of their cells or the image's greys, and finds the cell in a pixel.

const NO_LEVEL = -1e6;  // of a node without a value
const FRAGMENT = `${SHADING}
  const float NO_LEVEL = ${NO_LEVEL.toFixed(1)};
  uniform int kind; uniform vec4 plane; uniform float fraction; uniform bool isPicking; uniform uint picked;
  uniform bool isNodal; uniform vec3 noValue; uniform sampler2D table; uniform sampler2D colours;
  uniform sampler3D voxels; uniform mat4 toIndex; uniform vec3 shape;
  const int SURFACE = 0, SECTION = 1, SLICE = 2, SET = 3, GLASS = 4;
  vec4 grey(vec3 place) {  // of the voxel around a place; transparent outside the image
    vec3 index = (toIndex * vec4(place, 1.0)).xyz + 0.5;
    if (any(lessThan(index, vec3(0.0))) || any(greaterThanEqual(index, shape))) return vec4(0.0);
    return vec4(vec3(texelFetch(voxels, ivec3(index), 0).r), 1.0);
  }
  vec3 atNodes() {  // the colour of an interpolated field
    if (level < 0.1 * NO_LEVEL) return noValue;
    return texelFetch(table, ivec2(int(255.0 * clamp(level, 0.0, 1.0) + 0.5), 0), 0).rgb;
  }
  void main() {
    float line = edge();  // before any pixel is discarded: its neighbours' slopes need it
    float lit = kind == SECTION ? 1.0 : light(0.55);
    if (kind != SECTION && kind != SLICE && dot(plane.xyz, world) > plane.w) discard;
    if (kind == SLICE) {
      colour = grey(world);
      if (colour.a == 0.0) discard;
      return;
    }
    if (isPicking) {
      uint number = cell + 1u;
      colour = vec4(number & 255u, (number >> 8) & 255u, (number >> 16) & 255u, number >> 24) / 255.0;
      return;
    }
    if (kind == SET) {
      colour = vec4(mix(vec3(1.0, 0.0, 0.75) * lit, vec3(0.35, 0.0, 0.25), 0.6 * line), 0.3);
      return;
    }
    if (kind == GLASS) {  // of hidden labels
      colour = vec4(isNodal ? vec3(0.6) : texelFetch(colours, ivec2(cell % 2048u, cell / 2048u), 0).rgb, 0.14);
      colour.rgb *= lit;
      return;
    }
    vec3 own = isNodal ? atNodes() : texelFetch(colours, ivec2(cell % 2048u, cell / 2048u), 0).rgb;
    vec4 below = kind == SECTION ? grey(rest) : vec4(0.0);  // the image is deformed with the mesh
    float seenOwn = mix(1.0, fraction, below.a);
    vec3 fill = mix(below.rgb, own, seenOwn) * lit;
    // Lines that are visible on any cell: dark, light on dark cells, orange over the image.
    vec3 ink = mix(vec3(0.5), vec3(0.05), smoothstep(0.1, 0.3, dot(fill, vec3(0.3, 0.6, 0.1))));
    ink = mix(vec3(1.0, 0.69, 0.0), ink, smoothstep(0.4, 0.6, seenOwn));
    if (cell + 1u == picked) fill = mix(fill, vec3(1.0, 0.1, 0.1), 0.7);
    colour = vec4(mix(fill, ink, mix(0.5, 0.65, seenOwn) * line), 1.0);
  }`;
// The parts in the order of drawing, with their numbers in the shader.
const KINDS = { surface: 0, section: 1, slice: 2, set: 3, glass: 4 };
const WIDE = 2048;  // cells in a row of the texture of their colours

const hex = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16));

function cellColours(field, table, noValue) {
  const colours = new Uint8Array(4 * WIDE * Math.ceil(field.values.length / WIDE));
  const ofLabel = new Map(field.categories.map(([value, colour]) => [value, hex(colour)]));
  const [low, high] = field.limits;
  field.values.forEach((value, cell) => {
    let colour = noValue;
    if (ofLabel.size) {
      colour = ofLabel.get(value) || noValue;
    } else if (!Number.isNaN(value)) {
      const step = Math.round(255 * Math.max(0, Math.min(1, (value - low) / (high - low))));
      colour = table.subarray(3 * step, 3 * step + 3);
    }
    colours.set(colour, 4 * cell);
    colours[4 * cell + 3] = 255;
  });
  return colours;
}

// The values of a field at the nodes relative to its limits, from 0 to 1.
function nodeLevels(field) {
  const [low, high] = field.limits;
  return field.nodes.map((value) => (Number.isNaN(value) ? NO_LEVEL : (value - low) / (high - low)));
}

function nearestTexture(gl, unit, target) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(target, gl.createTexture());
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, name, gl.NEAREST);
}

// Draws the view. Every change redraws everything; only the data of `fill` and `paint` stay on the graphics card.
function renderer(gl, image, radius, depth, table, noValue) {
  const { at, part, clear } = painter(gl, FRAGMENT);
  const parts = Object.fromEntries(Object.keys(KINDS).map((name) => [name, part(name === "section")]));
  gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
  nearestTexture(gl, 0, gl.TEXTURE_2D);
  nearestTexture(gl, 1, gl.TEXTURE_3D);
  nearestTexture(gl, 2, gl.TEXTURE_2D);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, table.length / 3, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, table);
  ["colours", "voxels", "table"].forEach((name, unit) => gl.uniform1i(at(name), unit));
  gl.uniform3fv(at("noValue"), noValue.map((tone) => tone / 255));
  gl.activeTexture(gl.TEXTURE1);
  const shape = image ? image.shape : [1, 1, 1];
  gl.texImage3D(gl.TEXTURE_3D, 0, gl.R8, ...shape, 0, gl.RED, gl.UNSIGNED_BYTE,
    image ? new Uint8Array(bytes(image.voxels)) : new Uint8Array(1));
  gl.uniform3fv(at("shape"), image ? shape : [0, 0, 0]);
  if (image) gl.uniformMatrix4fv(at("toIndex"), false, image.toIndex);

  const frame = (size, camera, plane, fraction, picked, isPicking) => {
    gl.clearColor(...(isPicking ? [0, 0, 0, 0] : [1, 1, 1, 1]));
    clear(size, camera, radius, depth);
    gl.uniform4fv(at("plane"), plane);
    gl.uniform1f(at("fraction"), fraction);
    gl.uniform1ui(at("picked"), picked + 1);
    gl.uniform1i(at("isPicking"), isPicking ? 1 : 0);
    for (const [name, kind] of Object.entries(KINDS)) {
      if (isPicking ? name === "slice" || name === "set" : name === "section" && fraction < 0) continue;
      if (name === "glass") continue;  // last
      // Cut cells lie before facets that end at their plane within the same pixel, which would break their rim into
      // dots; the slice lies behind them; a highlighted set before the facets it is made of: these have the same corners,
      // so a few steps of depth are enough, and steep ones do not come through others.
      const [slope, nearer] = { section: [-1, -1], slice: [1, 1], set: [0, -16] }[name] || [0, 0];
      if (nearer) gl.enable(gl.POLYGON_OFFSET_FILL);
      else gl.disable(gl.POLYGON_OFFSET_FILL);
      gl.polygonOffset(slope, nearer);
      gl.uniform1i(at("kind"), kind);
      parts[name].draw();
    }
    // Hidden parts of the set shine through other cells; then all of the glass is drawn over the parts behind it.
    if (isPicking) return;
    gl.enable(gl.BLEND);
    gl.depthFunc(gl.GREATER);
    parts.set.draw();
    gl.depthFunc(gl.LESS);
    gl.disable(gl.POLYGON_OFFSET_FILL);
    gl.depthMask(false);
    gl.uniform1i(at("kind"), KINDS.glass);
    parts.glass.draw();
    gl.depthMask(true);
    gl.disable(gl.BLEND);
  };

  return {
    parts,
    frame,
    // The colours of the cells, or null if they are interpolated from their corners.
    paint(colours) {
      gl.uniform1i(at("isNodal"), colours ? 0 : 1);
      if (!colours) return;
      gl.activeTexture(gl.TEXTURE0);
      const rows = colours.length / 4 / WIDE;
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, WIDE, rows, 0, gl.RGBA, gl.UNSIGNED_BYTE, colours);
    },
    // The number of the cell seen in a pixel, -1 if none: all cells drawn once more, each in its number.
    cellAt(x, y, size, camera, plane) {
      const buffer = gl.createFramebuffer();
      const [colour, depths] = [gl.createRenderbuffer(), gl.createRenderbuffer()];
      gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
      for (const [store, format, role] of [
        [colour, gl.RGBA8, gl.COLOR_ATTACHMENT0], [depths, gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT],
      ]) {
        gl.bindRenderbuffer(gl.RENDERBUFFER, store);
        gl.renderbufferStorage(gl.RENDERBUFFER, format, ...size);
        gl.framebufferRenderbuffer(gl.FRAMEBUFFER, role, gl.RENDERBUFFER, store);
      }
      frame(size, camera, plane, 1, -1, true);
      const pixel = new Uint8Array(4);
      gl.readPixels(x, y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.deleteFramebuffer(buffer);
      gl.deleteRenderbuffer(colour);
      gl.deleteRenderbuffer(depths);
      return pixel[0] + 256 * pixel[1] + 65536 * pixel[2] + 16777216 * pixel[3] - 1;
    },
  };
}
