// A hand for tests: rest pose as the server sends it, bent by angles as `rhot.anatomy.hand` bends it.
import { readFileSync } from "node:fs";
import { add, compose, fromAxis, pose, qmul, rotate, sub } from "../src/math.js";
import { BENDING, JOINTS } from "../src/skeleton.js";

/** Made by `tests/viewer/grasp/test_page_logic.py`, which runs these tests. */
const path = process.env.RHOT_REST_HANDS;
if (!path) throw new Error("RHOT_REST_HANDS names no file: run these tests by pytest (tests/viewer/grasp)");
export const HANDS = JSON.parse(readFileSync(path));

export const rest = (side = "right") => JOINTS.map((_, row) => pose(HANDS[side].joints, 7 * row));
export const radii = (side = "right") => HANDS[side].radii;

/** Bend each finger's joints by the same flexion angles [knuckle, middle, last], radians; thumb by its own. */
export function bent(poses, angles, thumb = angles) {
  const result = poses.slice();
  BENDING.forEach((rows, finger) => {
    (finger === 0 ? thumb : angles).forEach((angle, i) => {
      const joint = result[rows[i]];
      const turn = fromAxis(rotate(joint.q, [1, 0, 0]), -angle);
      for (const row of rows.slice(i)) {
        const { p, q } = result[row];
        result[row] = { p: add(joint.p, rotate(turn, sub(p, joint.p))), q: qmul(turn, q) };
      }
    });
  });
  return result;
}

export const placed = (poses, at) => poses.map((one) => compose(at, one));

/** Deterministic random numbers, 0 to 1 (mulberry32). */
export function random(seed) {
  let a = seed;
  return () => {
    a = (a + 0x6d2b79f5) | 0;
    let t = Math.imul(a ^ (a >>> 15), 1 | a);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

/** A ball of `radius`, made slimmer by `slim` along x, between planes: what the rig sends of a mesh. */
export function pebble(radius, slim, count = 64) {
  const planes = [];
  for (let k = 0; k < count; k++) {
    const z = 1 - (2 * k + 1) / count;
    const across = Math.sqrt(1 - z * z);
    const n = [across * Math.cos(2.39996 * k), across * Math.sin(2.39996 * k), z];
    planes.push([...n, radius * Math.hypot(slim * n[0], n[1], n[2])]);
  }
  return { kind: "mesh", file: "pebble.glb", size: [2 * slim * radius, 2 * radius, 2 * radius], planes };
}
