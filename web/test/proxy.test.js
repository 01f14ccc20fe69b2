import assert from "node:assert/strict";
import { test } from "node:test";
import { makeSkin, skinned } from "../src/hand_skin.js";
import { distance, qunit } from "../src/math.js";
import { depthIn, restrained, YIELDS } from "../src/proxy.js";
import { Body } from "../src/shapes.js";
import { HANDS, bent, pebble, placed, radii, random, rest } from "./hands.js";

const SHAPES = [
  { kind: "box", size: [0.06, 0.06, 0.06] },
  { kind: "cylinder", radius: 0.035, height: 0.12 },
  { kind: "sphere", radius: 0.04 },
  { kind: "box", size: [0.2, 0.02, 0.15] },
  pebble(0.045, 0.6),
];

/** Hands that reach into a thing near the palm, as tracking errors and virtual things make them. */
function* cases(count) {
  const next = random(7);
  for (let i = 0; i < count; i++) {
    const angles = [next() * 1.3, next() * 1.5, next()];
    const hand = bent(rest(), angles, [next() * 0.6, next() * 0.6, next() * 0.8]);
    const at = { p: [0.03 * (next() - 0.5), -0.03 - 0.05 * next(), -0.07 - 0.06 * next()], q: qunit([next() - 0.5, next() - 0.5, next() - 0.5, next() - 0.5]) };
    yield { hand, body: new Body(SHAPES[i % SHAPES.length], at) };
  }
}

test("the flesh around the bones stops at surfaces", () => {
  let inside = 0;
  for (const { hand, body } of cases(200)) {
    const before = depthIn(hand, radii(), body);
    inside += before > 0.005;
    const after = depthIn(restrained(hand, radii(), [body]), radii(), body);
    assert.ok(after < 0.003, `${JSON.stringify(body.shape)}: ${(1e3 * before).toFixed(1)} → ${(1e3 * after).toFixed(1)} mm`);
  }
  assert.ok(inside > 100, `${inside} hands reached in`);
});

test("the skin that is drawn goes in by 3 mm at most", () => {
  const skin = makeSkin(HANDS.right.joints, HANDS.right.radii);
  let worst = 0;
  for (const { hand, body } of cases(40)) {
    for (const point of skinned(skin, restrained(hand, radii(), [body]))) worst = Math.max(worst, -body.distance(point));
  }
  console.log(`skin: ${(1e3 * worst).toFixed(2)} mm`);
  assert.ok(worst < 0.003, `${(1e3 * worst).toFixed(2)} mm`);
});

test("a hand that touches nothing is drawn as it is tracked", () => {
  const hand = bent(rest(), [0.5, 0.7, 0.4]);
  const far = new Body(SHAPES[0], { p: [0.4, 0, 0], q: [0, 0, 0, 1] });
  assert.equal(restrained(hand, radii(), [far]), hand);
});

test("a small motion of the hand moves the proxy by little", () => {
  const body = new Body(SHAPES[2], { p: [0, -0.055, -0.1], q: [0, 0, 0, 1] });
  let before = null;
  for (let i = 0; i <= 60; i++) {
    const hand = restrained(bent(rest(), [0.02 * i, 0.02 * i, 0.01 * i], [0.008 * i, 0.008 * i, 0.008 * i]), radii(), [body]);
    if (before) hand.forEach(({ p }, row) => assert.ok(distance(p, before[row].p) < 0.012, `row ${row}, step ${i}`));
    before = hand;
  }
});

test("flesh yields less than the bound", () => assert.ok(YIELDS < 0.003));
