import assert from "node:assert/strict";
import { test } from "node:test";
import { Grip, SETTINGS, VirtualThing, contacts } from "../src/grasp.js";
import { add, apply, distance, invert, mix, qunit } from "../src/math.js";
import { Body, halfHeight } from "../src/shapes.js";
import { BENDING, PALM } from "../src/skeleton.js";
import { bent, placed, radii, random, rest } from "./hands.js";

const BALL = { kind: "sphere", radius: 0.028 };
const FRAME_MS = 1000 / 60;
/** Tracking's own noise, metres: median of a fingertip's error. */
const NOISE = 0.0012;

/** A pinch: 0 = open, 1 = thumb and fingers meet. */
const pinch = (s) => bent(rest(), [0.15 + 0.75 * s, 0.3 + 0.5 * s, 0.2 + 0.3 * s], [0.1 + 0.35 * s, 0.25 * s, 0.3 * s]);

/** Where a ball lies between thumb and index of a pinch of so much. */
function between(hand) {
  return mix(hand[BENDING[0].at(-1)].p, hand[BENDING[1].at(-1)].p, 0.5);
}

/** How far a pinch is when both fingers are at a ball between them. */
function touchAt() {
  for (let s = 0; s <= 1; s += 0.005) {
    const hand = pinch(s);
    const body = new Body(BALL, { p: between(hand), q: [0, 0, 0, 1] });
    const found = contacts(hand, radii(), body);
    if (found[0].gap < 0 && found[1].gap < 0) return s;
  }
  throw new Error("this pinch never meets the ball");
}

const noisy = (hand, next) => hand.map(({ p, q }) => ({ p: add(p, [0, 1, 2].map(() => NOISE * (next() + next() - 1))), q }));

test("a virtual ball is picked up, carried and put down in 20 of 20 tries", () => {
  const touch = touchAt();
  for (let seed = 1; seed <= 20; seed++) {
    const next = random(seed);
    const base = { p: [next() - 0.5, 1, next() - 0.5], q: qunit([next() - 0.5, next() - 0.5, next() - 0.5, 2]) };
    const where = between(placed(pinch(touch), base));
    const desk = where[1] - BALL.radius;
    const home = { p: add(where, [0, 1, 2].map(() => 0.006 * (next() - 0.5))), q: [0, 0, 0, 1] };
    home.p[1] = where[1];
    const ball = new VirtualThing(home, (q) => halfHeight(BALL, q));
    const grip = new Grip();
    const closing = 0.4 + 0.6 * next();
    let taken = null, lifted = 0, drift = 0, inPalm = null, released = null;
    for (let t = 0; t < 4000; t += FRAME_MS) {
      const s = t < 500 ? 0 : t < 3200 ? Math.min(1, (t - 500) / (1000 * closing)) : Math.max(0, 1 - (t - 3200) / 300);
      const up = t < 1800 ? 0 : Math.min(0.15, ((t - 1800) / 700) * 0.15) - (t > 2600 ? Math.min(0.15, ((t - 2600) / 500) * 0.15) : 0);
      const hand = noisy(placed(pinch(Math.min(s, touch + 0.04)), { p: add(base.p, [0, up, 0]), q: base.q }), next);
      grip.step(t, hand, radii(), new Body(BALL, ball.at));
      ball.step(t, grip.held ? grip.carried(hand) : null, desk);
      if (grip.held && taken === null) taken = t;
      if (!grip.held && taken !== null && released === null) released = t;
      lifted = Math.max(lifted, ball.at.p[1] - where[1]);
      if (grip.held && t > 2000 && t < 3100) {
        const local = apply(invert(hand[PALM]), ball.at.p);
        inPalm ??= local;
        drift = Math.max(drift, distance(local, inPalm));
      }
    }
    assert.ok(taken !== null && taken < 1800, `try ${seed}: taken at ${taken}`);
    assert.ok(lifted > 0.13, `try ${seed}: lifted ${lifted}`);
    assert.ok(released !== null && released > 3200 && released < 3500, `try ${seed}: released at ${released}`);
    assert.ok(drift < 0.005, `try ${seed}: drift ${drift}`);
    assert.ok(Math.abs(ball.at.p[1] - where[1]) < 0.002, "it lies on the desk");
  }
});

test("a hand that passes never takes it, open, half closed or closing on the way", () => {
  const touch = touchAt();
  let touched = 0;
  for (let seed = 1; seed <= 60; seed++) {
    const next = random(100 + seed);
    const grip = new Grip();
    const stiff = seed % 3 !== 0;
    const shape = stiff ? touch + 0.1 * (next() - 0.5) : null;
    const middle = between(pinch(touch));
    const way = qunit([next() - 0.5, next() - 0.5, next() - 0.5, next() - 0.5]);
    const speed = 0.3 + 0.7 * next();
    const body = new Body(BALL, { p: add(middle, [0, 1, 2].map(() => 0.01 * (next() - 0.5))), q: [0, 0, 0, 1] });
    for (let t = -600; t < 600; t += FRAME_MS) {
      const far = (speed * t) / 1000;
      const direction = apply({ p: [0, 0, 0], q: way }, [1, 0, 0]);
      const s = stiff ? shape : Math.min(touch, Math.max(0, (t + 600) / 1200));
      const hand = noisy(placed(pinch(s), { p: direction.map((x) => x * far), q: [0, 0, 0, 1] }), next);
      grip.step(t, hand, radii(), body);
      touched += grip.touching.includes(0) && grip.touching.includes(1);
      assert.equal(grip.held, false, `pass ${seed} at ${t} ms`);
    }
  }
  assert.ok(touched > 60, `thumb and index touched in ${touched} frames`);
});

test("noise about the threshold neither takes nor drops", () => {
  const touch = touchAt();
  const next = random(5);
  const grip = new Grip();
  const body = new Body(BALL, { p: between(pinch(touch)), q: [0, 0, 0, 1] });
  let changes = 0;
  for (let t = 0; t < 6000; t += FRAME_MS) {
    const s = t < 500 ? 0 : Math.min((t - 500) / 600, 1) * touch;
    const before = grip.held;
    grip.step(t, noisy(pinch(s), next), radii(), body);
    changes += before !== grip.held;
  }
  assert.equal(grip.held, true);
  assert.equal(changes, 1);
});

test("a hand that is not seen for long holds nothing, and a short gap changes nothing", () => {
  const touch = touchAt();
  const grip = new Grip();
  const body = new Body(BALL, { p: between(pinch(touch)), q: [0, 0, 0, 1] });
  let t = 0;
  for (; t < 1500; t += FRAME_MS) grip.step(t, pinch(Math.min(t / 800, 1) * touch), radii(), body);
  assert.equal(grip.held, true);
  for (const end = t + SETTINGS.lost - 50; t < end; t += FRAME_MS) grip.step(t, null, null, body);
  assert.equal(grip.held, true);
  for (const end = t + 150; t < end; t += FRAME_MS) grip.step(t, null, null, body);
  assert.equal(grip.held, false);
});

test("the same hand gives the same result", () => {
  const run = () => {
    const grip = new Grip();
    const body = new Body({ kind: "box", size: [0.05, 0.05, 0.05] }, { p: between(pinch(0.5)), q: [0, 0, 0, 1] });
    const held = [];
    for (let t = 0; t < 2000; t += FRAME_MS) held.push(grip.step(t, pinch(Math.min(t / 1000, 0.8)), radii(), body));
    return held;
  };
  assert.deepEqual(run(), run());
});
