// The mesh of the page: neighbours of cells, its surface and its sections. Positions are mm relative to its middle, in
// single precision.

const FACETS = [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]];  // facet k of a cell lies opposite its node k

// For each node of each cell, the cell across the opposite facet, -1 on the boundary: (4 M).
function neighbours(cells, nNodes) {
  const first = new Int32Array(nNodes).fill(-1);  // half facets, chained by their smallest node
  const next = new Int32Array(cells.length).fill(-1);
  const middle = new Uint32Array(cells.length);
  const largest = new Uint32Array(cells.length);
  const across = new Int32Array(cells.length).fill(-1);
  for (let half = 0; half < cells.length; half++) {
    const start = half - half % 4;
    const [i, j, k] = FACETS[half % 4];
    const a = cells[start + i], b = cells[start + j], c = cells[start + k];
    const low = Math.min(a, b, c), high = Math.max(a, b, c);
    const between = a + b + c - low - high;
    let other = first[low];
    while (other >= 0 && (middle[other] !== between || largest[other] !== high)) other = next[other];
    if (other >= 0) {
      across[half] = other >> 2;
      across[other] = half >> 2;
    } else {
      middle[half] = between;
      largest[half] = high;
      next[half] = first[low];
      first[low] = half;
    }
  }
  return across;
}

function centroidsAndVolumes(points, cells) {
  const n = cells.length / 4;
  const centroids = new Float32Array(3 * n), volumes = new Float64Array(n);
  for (let cell = 0; cell < n; cell++) {
    const start = 4 * cell;
    const p = 3 * cells[start], q = 3 * cells[start + 1], r = 3 * cells[start + 2], s = 3 * cells[start + 3];
    const ax = points[q] - points[p], ay = points[q + 1] - points[p + 1], az = points[q + 2] - points[p + 2];
    const bx = points[r] - points[p], by = points[r + 1] - points[p + 1], bz = points[r + 2] - points[p + 2];
    const cx = points[s] - points[p], cy = points[s + 1] - points[p + 1], cz = points[s + 2] - points[p + 2];
    volumes[cell] = (ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)) / 6;
    for (let i = 0; i < 3; i++) {
      centroids[3 * cell + i] = (points[p + i] + points[q + i] + points[r + i] + points[s + i]) / 4;
    }
  }
  return { centroids, volumes };
}

function extremes(values) {
  let min = Infinity, max = -Infinity;
  for (const value of values) {
    if (value < min) min = value;
    if (value > max) max = value;
  }
  return [min, max];
}

// The values of cells range from `min` to `max`; drawn values, which may be those of nodes, from `least` to `most`.
function unpackedField(packed) {
  const values = new Float32Array(bytes(packed.values));
  const nodes = packed.nodes && new Float32Array(bytes(packed.nodes));
  const [min, max] = extremes(values);
  const [least, most] = nodes ? extremes(nodes) : [min, max];
  return { ...packed, values, nodes, min, max, least, most };
}

function boxOf(points) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  points.forEach((value, i) => {
    low[i % 3] = Math.min(low[i % 3], value);
    high[i % 3] = Math.max(high[i % 3], value);
  });
  return { low, high };
}

// The undeformed mesh; `deform` moves its points, box and centroids, but keeps its volumes.
function unpackedMesh(data) {
  const rest = new Float32Array(bytes(data.points));
  const cells = new Uint32Array(bytes(data.cells));
  return {
    rest, points: rest, cells, count: cells.length / 4, neighbours: neighbours(cells, rest.length / 3),
    ...boxOf(rest), ...centroidsAndVolumes(rest, cells),
    ...(data.volumes ? { volumes: new Float32Array(bytes(data.volumes)) } : {}),
  };
}

function deform(mesh, displacement, factor) {
  mesh.points = mesh.rest.map((value, i) => value + factor * displacement[i]);
  Object.assign(mesh, boxOf(mesh.points));
  mesh.centroids = centroidsAndVolumes(mesh.points, mesh.cells).centroids;
}

// The largest distance of a box from the middle.
const reach = ({ low, high }) => Math.hypot(...low.map((value, k) => Math.max(-value, high[k])));

// The facets of exactly one shown cell; with `levels`, one per node, also the values at their corners.
function surface(mesh, isShown, levels) {
  const { points, cells } = mesh;
  const isOuter = (half) => isShown[half >> 2] && !(mesh.neighbours[half] >= 0 && isShown[mesh.neighbours[half]]);
  let count = 0;
  for (let half = 0; half < cells.length; half++) if (isOuter(half)) count++;
  const triangles = new Triangles(count);
  for (let half = 0; half < cells.length; half++) {
    if (!isOuter(half)) continue;
    const start = half - half % 4;
    for (let k = 0; k < 3; k++) {
      const number = cells[start + FACETS[half % 4][k]], node = 3 * number;
      triangles.set(3 * triangles.count + k, half >> 2, 7, points[node], points[node + 1], points[node + 2],
        levels ? levels[number] : 0);
    }
    triangles.count++;
  }
  return triangles;
}

// The facets between cells of two hidden labels, as facets of the cell with the larger one.
function interfaces(mesh, labels, isHidden) {
  const { points, cells } = mesh;
  const triangles = new Triangles(64);
  for (let half = 0; half < cells.length; half++) {
    const [cell, other] = [half >> 2, mesh.neighbours[half]];
    if (other < 0 || !(labels[cell] > labels[other]) || !isHidden(labels[cell]) || !isHidden(labels[other])) continue;
    const corners = FACETS[half % 4].map((k) => 3 * cells[4 * cell + k]);
    triangles.add(cell, 0, ...corners.map((node) => points.subarray(node, node + 3)));
  }
  return triangles;
}

// The sections of shown cells with the plane axis = at: triangles, or quadrilaterals in two triangles. With `labels`,
// one per cell, only sides between two labels, or on the boundary, are lines.
function section(mesh, isShown, axis, at, levels, labels) {
  const { points, rest, cells } = mesh;
  const triangles = new Triangles(64, true);
  const between = (i, j) => {
    const fraction = (at - points[3 * i + axis]) / (points[3 * j + axis] - points[3 * i + axis]);
    const along = (list) => [0, 1, 2].map((k) => list[3 * i + k] + fraction * (list[3 * j + k] - list[3 * i + k]));
    const place = along(points);
    place[axis] = at;
    return [...place, levels ? levels[i] + fraction * (levels[j] - levels[i]) : 0, rest === points ? place : along(rest)];
  };
  let [nPolygons, nLines] = [0, 0];
  for (let cell = 0; cell < mesh.count; cell++) {
    if (!isShown[cell]) continue;
    let above = 0;
    for (let k = 0; k < 4; k++) if (points[3 * cells[4 * cell + k] + axis] >= at) above++;
    if (above === 0 || above === 4) continue;
    nPolygons++;
    const up = [], down = [], isLine = new Map();  // whether the side in the facet opposite a node is drawn
    for (let k = 0; k < 4; k++) {
      const [node, other] = [cells[4 * cell + k], mesh.neighbours[4 * cell + k]];
      (points[3 * node + axis] >= at ? up : down).push(node);
      isLine.set(node, !labels || other < 0 || labels[other] !== labels[cell] ? 1 : 0);
    }
    // The facet opposite a node is cut, unless that node is alone on its side.
    for (const side of [up, down]) if (side.length > 1) nLines += side.reduce((sum, node) => sum + isLine.get(node), 0);
    // Bit k is the side opposite corner k.
    const sides = (...nodes) => nodes.reduce((sum, node, k) => sum + (node < 0 ? 0 : isLine.get(node) << k), 0);
    if (up.length === 2) {
      const [a, b, c, d] = [[0, 0], [0, 1], [1, 1], [1, 0]].map(([i, j]) => between(up[i], down[j]));
      triangles.add(cell, sides(down[0], -1, up[1]), a, b, c);  // the diagonal from a to c is not an edge of the cell
      triangles.add(cell, sides(up[0], down[1], -1), a, c, d);
    } else {
      const [alone, others] = up.length === 1 ? [up[0], down] : [down[0], up];
      triangles.add(cell, sides(...others), ...others.map((node) => between(alone, node)));
    }
  }
  Object.assign(triangles, { nPolygons, nLines });
  return triangles;
}

// The rectangle of the plane that covers the image's box.
function slice(box, axis, at) {
  const triangles = new Triangles(2);
  const [u, v] = [0, 1, 2].filter((k) => k !== axis);
  const corner = (i, j) => {
    const place = [at, at, at];
    [place[u], place[v]] = [box[i][u], box[j][v]];
    return place;
  };
  triangles.add(0, 0, corner(0, 0), corner(1, 0), corner(1, 1));
  triangles.add(0, 0, corner(0, 0), corner(1, 1), corner(0, 1));
  return triangles;
}

function setTriangles(mesh, nodes) {
  const triangles = new Triangles(nodes.length / 3);
  for (let i = 0; i < nodes.length; i += 3) {
    triangles.add(0, 7, ...[0, 1, 2].map((k) => mesh.points.subarray(3 * nodes[i + k], 3 * nodes[i + k] + 3)));
  }
  return triangles;
}
