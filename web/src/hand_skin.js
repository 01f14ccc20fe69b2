// The skin of a hand, made once from its joints and radii: a closed low-poly surface with weights for 26 bones.
//
// Each finger is a chain of round cones, as thick as the flesh around its joints; where fingers meet the palm they
// grow together (polynomial smooth minimum). The surface is found by naive surface nets in the hand's rest pose:
// fingers straight and spread.
import { add, apply, distance, dot, invert, mix, pose, rotate, scale, sub, unit } from "./math.js";
import { nearestShare } from "./shapes.js";
import { BONES, FINGERS, JOINTS, ROW, ROWS, WRIST } from "./skeleton.js";

/** Edge of a grid cell, metres: a finger has about ten faces around it. */
const CELL = 0.0042;
const BLOCK = 4;
/** Chains that come nearer than this grow together, metres. */
const WEB = 0.009;
/** Over this distance from a bone its pull falls to 1/e, metres: joints bend within their own thickness. */
const PULL = 0.0032;
/** The stub of the forearm behind the wrist, metres: length, half distance of its two cones, share of the radius. */
const STUB = { length: 0.045, apart: 0.009, share: 0.78 };
const MOST_WEIGHTS = 4;

/** Round cones of a hand as [from, to, radius, radius, joint row it moves with, finger]. */
export function cones(poses, radii) {
  const found = BONES.map(([from, to, finger]) => [poses[from].p, poses[to].p, radii[from], radii[to], from, finger]);
  const radius = radii[WRIST] * STUB.share;
  for (const side of [-1, 1]) {
    const edge = add(poses[WRIST].p, rotate(poses[WRIST].q, [side * STUB.apart, 0, 0]));
    const back = add(edge, rotate(poses[WRIST].q, [0, 0, STUB.length]));
    const little = side * dot(sub(poses[ROW.little_metacarpal].p, poses[WRIST].p), rotate(poses[WRIST].q, [1, 0, 0])) > 0;
    const base = ROW[little ? "little_metacarpal" : "index_metacarpal"];
    found.push([edge, back, radius, radius * 0.92, WRIST, -1]);
    found.push([edge, poses[base].p, radius, radii[base], WRIST, -1]);
  }
  return found;
}

/** Distance of a point to a round cone; without a single array, because a skin asks a million times. */
function coneDistance(point, cone) {
  const a = cone[0];
  const b = cone[1];
  const bx = b[0] - a[0];
  const by = b[1] - a[1];
  const bz = b[2] - a[2];
  const x = point[0] - a[0];
  const y = point[1] - a[1];
  const z = point[2] - a[2];
  const square = bx * bx + by * by + bz * bz;
  const share = square > 0 ? Math.min(1, Math.max(0, (x * bx + y * by + z * bz) / square)) : 0;
  const dx = x - share * bx;
  const dy = y - share * by;
  const dz = z - share * bz;
  return Math.sqrt(dx * dx + dy * dy + dz * dz) - (cone[2] + (cone[3] - cone[2]) * share);
}

/** Chains of cones: within one the plain minimum, between them the smooth one. */
function chainsOf(all) {
  const chains = ROWS.map((rows) => all.filter((cone) => rows.includes(cone[4])));
  for (const cone of all.slice(BONES.length)) chains.push([cone]);
  return chains;
}

function surface(chains) {
  return (point) => {
    let result = Infinity;
    for (const chain of chains) {
      let d = Infinity;
      for (const cone of chain) d = Math.min(d, coneDistance(point, cone));
      const h = Math.max(WEB - Math.abs(result - d), 0) / WEB;
      result = (result === Infinity ? d : Math.min(result, d) - (h * h * WEB) / 4);
    }
    return result;
  };
}

function gradient(f, p) {
  const e = 2e-4;
  return unit([
    f([p[0] + e, p[1], p[2]]) - f([p[0] - e, p[1], p[2]]),
    f([p[0], p[1] + e, p[2]]) - f([p[0], p[1] - e, p[2]]),
    f([p[0], p[1], p[2] + e]) - f([p[0], p[1], p[2] - e]),
  ]);
}

/** Vertices and triangles of f = 0 inside a box; naive surface nets (S. F. Gibson, 1998). */
function surfaceNets(f, low, high) {
  const n = [0, 1, 2].map((axis) => Math.ceil((high[axis] - low[axis]) / CELL) + 1);
  const at = (i, j, k) => i + n[0] * (j + n[1] * k);
  const values = new Float32Array(n[0] * n[1] * n[2]).fill(1);
  // Blocks far from the surface are of one sign: f changes no faster than distance does.
  const far = (CELL * BLOCK * Math.sqrt(3)) / 2 + WEB;
  for (let kb = 0; kb < n[2]; kb += BLOCK)
    for (let jb = 0; jb < n[1]; jb += BLOCK)
      for (let ib = 0; ib < n[0]; ib += BLOCK) {
        const middle = f(add(low, scale([ib + BLOCK / 2, jb + BLOCK / 2, kb + BLOCK / 2], CELL)));
        for (let k = kb; k < Math.min(kb + BLOCK, n[2]); k++)
          for (let j = jb; j < Math.min(jb + BLOCK, n[1]); j++)
            for (let i = ib; i < Math.min(ib + BLOCK, n[0]); i++)
              values[at(i, j, k)] = Math.abs(middle) > far ? middle : f([low[0] + CELL * i, low[1] + CELL * j, low[2] + CELL * k]);
      }
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((c) => [c & 1, (c >> 1) & 1, (c >> 2) & 1]);
  const edges = [];
  for (let a = 0; a < 8; a++) for (const bit of [1, 2, 4]) if (!(a & bit)) edges.push([a, a | bit]);
  const vertexOf = new Int32Array(values.length).fill(-1);
  const vertices = [];
  for (let k = 0; k + 1 < n[2]; k++)
    for (let j = 0; j + 1 < n[1]; j++)
      for (let i = 0; i + 1 < n[0]; i++) {
        const v = corners.map(([x, y, z]) => values[at(i + x, j + y, k + z)]);
        const inside = v.filter((d) => d < 0).length;
        if (inside === 0 || inside === 8) continue;
        let sum = [0, 0, 0];
        let count = 0;
        for (const [a, b] of edges) {
          if (v[a] < 0 === v[b] < 0) continue;
          sum = add(sum, mix(corners[a], corners[b], v[a] / (v[a] - v[b])));
          count++;
        }
        vertexOf[at(i, j, k)] = vertices.length;
        vertices.push(add(low, scale(add([i, j, k], scale(sum, 1 / count)), CELL)));
      }
  const triangles = [];
  const quad = (a, b, c, d, flip) => {
    if ([a, b, c, d].some((vertex) => vertex < 0)) return;
    triangles.push(...(flip ? [a, c, b, a, d, c] : [a, b, c, a, c, d]));
  };
  for (let k = 1; k + 1 < n[2]; k++)
    for (let j = 1; j + 1 < n[1]; j++)
      for (let i = 1; i + 1 < n[0]; i++) {
        const here = values[at(i, j, k)] < 0;
        const cell = (x, y, z) => vertexOf[at(i + x, j + y, k + z)];
        if (here !== values[at(i + 1, j, k)] < 0) quad(cell(0, -1, -1), cell(0, 0, -1), cell(0, 0, 0), cell(0, -1, 0), !here);
        if (here !== values[at(i, j + 1, k)] < 0) quad(cell(-1, 0, -1), cell(-1, 0, 0), cell(0, 0, 0), cell(0, 0, -1), !here);
        if (here !== values[at(i, j, k + 1)] < 0) quad(cell(-1, -1, 0), cell(0, -1, 0), cell(0, 0, 0), cell(-1, 0, 0), !here);
      }
  return { vertices, triangles };
}

/** Make the skin of a hand in its rest pose.
 *
 * joints: 26 × 7 numbers (position, quaternion), radii: 26, both metres, as the page's first message has them.
 */
export function makeSkin(joints, radii) {
  const poses = JOINTS.map((_, row) => pose(joints, 7 * row));
  const all = cones(poses, radii);
  const f = surface(chainsOf(all));
  const low = [0, 1, 2].map((axis) => Math.min(...all.flatMap(([a, b, r0, r1]) => [a[axis] - r0, b[axis] - r1])) - 2 * CELL);
  const high = [0, 1, 2].map((axis) => Math.max(...all.flatMap(([a, b, r0, r1]) => [a[axis] + r0, b[axis] + r1])) + 2 * CELL);
  const { vertices, triangles } = surfaceNets(f, low, high);
  const count = vertices.length;
  const skin = {
    poses,
    triangles: new Uint32Array(triangles),
    positions: new Float32Array(3 * count),
    normals: new Float32Array(3 * count),
    bones: new Uint16Array(MOST_WEIGHTS * count),
    weights: new Float32Array(MOST_WEIGHTS * count),
    /** Per vertex how much it belongs to each finger. */
    fingers: new Float32Array(FINGERS.length * count),
    /** Per vertex how much of it is painted: 1 on the last part of a finger. */
    paint: new Float32Array(count),
  };
  vertices.forEach((start, vertex) => {
    let p = start;
    const normal = gradient(f, p);
    p = sub(p, scale(normal, f(p)));
    skin.positions.set(p, 3 * vertex);
    skin.normals.set(normal, 3 * vertex);
    weigh(skin, all, p, vertex);
  });
  return skin;
}

function weigh(skin, all, p, vertex) {
  const pull = new Map();
  let total = 0;
  for (const cone of all) {
    const weight = Math.exp(-Math.max(coneDistance(p, cone), 0) / PULL);
    pull.set(cone[4], (pull.get(cone[4]) ?? 0) + weight);
  }
  const most = [...pull].sort((a, b) => b[1] - a[1]).slice(0, MOST_WEIGHTS);
  for (const [, weight] of most) total += weight;
  most.forEach(([row, weight], i) => {
    skin.bones[MOST_WEIGHTS * vertex + i] = row;
    skin.weights[MOST_WEIGHTS * vertex + i] = weight / total;
    const finger = ROWS.findIndex((rows, which) => rows.includes(row) && (which === 0 || rows[0] !== row));
    if (finger >= 0) skin.fingers[FINGERS.length * vertex + finger] += weight / total;
  });
  ROWS.forEach((rows) => {
    const [last, tip] = rows.slice(-2);
    const along = nearestShare(p, skin.poses[last].p, skin.poses[tip].p);
    const near = distance(p, mix(skin.poses[last].p, skin.poses[tip].p, along)) < 0.014;
    // Painted over the last three quarters of the segment, as `CAP_SHARE` of the hand's model says.
    if (near && along > 0.25) skin.paint[vertex] = 1;
  });
}

/** Where the skin's vertices are when the joints are at `poses`, as the graphics card computes it; for tests. */
export function skinned(skin, poses) {
  const moves = skin.poses.map((rest, row) => {
    const back = invert(rest);
    return (v) => apply(poses[row], apply(back, v));
  });
  const count = skin.positions.length / 3;
  return Array.from({ length: count }, (_, vertex) => {
    const rest = [...skin.positions.subarray(3 * vertex, 3 * vertex + 3)];
    let p = [0, 0, 0];
    for (let i = 0; i < MOST_WEIGHTS; i++) {
      const weight = skin.weights[MOST_WEIGHTS * vertex + i];
      if (weight > 0) p = add(p, scale(moves[skin.bones[MOST_WEIGHTS * vertex + i]](rest), weight));
    }
    return p;
  });
}
