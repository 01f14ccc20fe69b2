// A hand that stops at surfaces: what is drawn in place of a tracked hand that reaches into a thing.
//
// A finger that would go in is opened about its knuckle until it does not; where that is not enough, and for the palm,
// the whole hand is moved out along the surface's direction. Nothing is remembered: the same hand gives the same proxy.
import { add, mix, qmul, rotate, scale, sub, fromAxis } from "./math.js";
import { cones } from "./hand_skin.js";
import { BENDING, FINGERS, PALM } from "./skeleton.js";

/** So deep may the flesh around the bones go, metres; the skin that is drawn bulges by up to 2 mm more at joints. */
export const YIELDS = 0.0005;
const MOST_OPEN = (80 * Math.PI) / 180;
const STEP = (4 * Math.PI) / 180;
const HALVINGS = 5;
const ROUNDS = 4;
/** Where that does not end, as with a plate through the hand: out in one direction, at most so far, metres. */
const MOST_OUT = 0.4;
const OUT_STEP = 0.01;
/** A bone is felt at so many places: less than 6 mm apart on the longest. */
const FEELERS = 9;
const PALM_BONES = -1;

/** The deepest point of a hand's flesh in a body: depth (negative outside) and where. One finger's, or all's. */
function deepest(poses, radii, body, part = null) {
  let best = { depth: -Infinity };
  for (const [from, to, r0, r1, , finger] of cones(poses, radii)) {
    if (part !== null && finger !== part) continue;
    for (let i = 0; i < FEELERS; i++) {
      const share = i / (FEELERS - 1);
      const point = mix(from, to, share);
      const depth = r0 + (r1 - r0) * share - body.distance(point);
      if (depth > best.depth) best = { depth, point };
    }
  }
  return best;
}

/** How deep a hand is in a body, metres; negative outside. */
export const depthIn = (poses, radii, body) => deepest(poses, radii, body).depth;

function opened(poses, finger, angle) {
  const rows = BENDING[finger];
  const knuckle = poses[rows[0]];
  // Flexion turns about −X of the joint, so opening is a turn about +X.
  const turn = fromAxis(rotate(knuckle.q, [1, 0, 0]), angle);
  const result = poses.slice();
  for (const row of rows) {
    const { p, q } = poses[row];
    result[row] = { p: add(knuckle.p, rotate(turn, sub(p, knuckle.p))), q: qmul(turn, q) };
  }
  return result;
}

function openUntilOut(poses, radii, finger, body) {
  const deep = (angle) => deepest(opened(poses, finger, angle), radii, body, finger).depth;
  if (deep(0) <= YIELDS) return poses;
  let best = { angle: 0, depth: deep(0) };
  let angle = STEP;
  for (; angle <= MOST_OPEN; angle += STEP) {
    const depth = deep(angle);
    if (depth < best.depth) best = { angle, depth };
    if (depth <= YIELDS) break;
  }
  if (angle > MOST_OPEN) return opened(poses, finger, best.angle);
  let low = angle - STEP;
  for (let i = 0; i < HALVINGS; i++) {
    const middle = (low + angle) / 2;
    if (deep(middle) <= YIELDS) angle = middle;
    else low = middle;
  }
  return opened(poses, finger, angle);
}

const moved = (poses, by) => poses.map(({ p, q }) => ({ p: add(p, by), q }));

/** The hand (26 poses) that stops at the surfaces of bodies. */
export function restrained(poses, radii, bodies) {
  let hand = poses;
  for (const body of bodies) {
    const reached = hand.some(({ p }) => body.distance(p) < 0.03);
    if (!reached) continue;
    let base = hand;
    for (let round = 0; round < ROUNDS; round++) {
      const palm = deepest(base, radii, body, PALM_BONES);
      let push = palm;
      if (palm.depth <= YIELDS) {
        hand = base;
        for (let finger = 0; finger < FINGERS.length; finger++) hand = openUntilOut(hand, radii, finger, body);
        push = deepest(hand, radii, body);
      }
      if (push.depth <= YIELDS) break;
      if (round === ROUNDS - 1) hand = out(hand, radii, body);
      else base = hand = moved(base, scale(body.normal(push.point), push.depth - 0.8 * YIELDS));
    }
  }
  return hand;
}

/** The nearest place at which the hand is out of a body, in the direction that leads out at its palm. */
function out(hand, radii, body) {
  const way = body.normal(hand[PALM].p);
  const deep = (far) => deepest(moved(hand, scale(way, far)), radii, body).depth;
  let far = OUT_STEP;
  while (far < MOST_OUT && deep(far) > YIELDS) far += OUT_STEP;
  let low = far - OUT_STEP;
  for (let i = 0; i < HALVINGS; i++) {
    const middle = (low + far) / 2;
    if (deep(middle) <= YIELDS) far = middle;
    else low = middle;
  }
  return moved(hand, scale(way, far));
}
