import assert from "node:assert/strict";
import { test } from "node:test";
import { makeSkin, skinned } from "../src/hand_skin.js";
import { compose, distance, fromAxis, invert, poseOfMatrix, qmul, qunit, rotate, toVector } from "../src/math.js";
import { MOST_AHEAD_MS, RigClock, Track } from "../src/motion.js";
import { Pace, isSoftware } from "../src/pace.js";
import { Body, halfHeight } from "../src/shapes.js";
import { Rig } from "../src/rig.js";
import { BONES, FINGERS, JOINTS } from "../src/skeleton.js";
import { Timing } from "../src/timing.js";
import { HANDS, bent, placed, radii, random, rest } from "./hands.js";

const near = (a, b, by, what) => assert.ok(Math.abs(a - b) <= by, `${what ?? ""} ${a} is not ${b} ± ${by}`);

test("poses compose, invert and come from matrices", () => {
  const next = random(3);
  for (let i = 0; i < 50; i++) {
    const a = { p: [next(), next(), next()], q: qunit([next() - 0.5, next() - 0.5, next() - 0.5, next() - 0.5]) };
    near(distance(compose(a, invert(a)).p, [0, 0, 0]), 0, 1e-12);
    const columns = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((v) => rotate(a.q, v));
    const m = [0, 1, 2].flatMap((row) => [...columns.map((c) => c[row]), a.p[row]]);
    const back = poseOfMatrix(m);
    near(Math.abs(back.q.reduce((sum, x, k) => sum + x * a.q[k], 0)), 1, 1e-9);
    near(distance(back.p, a.p), 0, 1e-12);
  }
  near(toVector(fromAxis([0, 1, 0], 0.7))[1], 0.7, 1e-12);
});

test("distances to shapes are Euclidean outside and negative inside", () => {
  const at = { p: [1, 2, 3], q: fromAxis([0, 0, 1], Math.PI / 2) };
  const box = new Body({ kind: "box", size: [0.2, 0.4, 0.6] }, at);
  near(box.distance([1, 2, 3]), -0.1, 1e-9);
  near(box.distance([1.3, 2, 3]), 0.1, 1e-9, "y of the box lies along −x");
  const cylinder = new Body({ kind: "cylinder", radius: 0.1, height: 1 }, { p: [0, 0, 0], q: [0, 0, 0, 1] });
  near(cylinder.distance([0.4, 0, 0.9]), 0.5, 1e-9);
  near(cylinder.distance([0, 0, 0.45]), -0.05, 1e-9);
  near(cylinder.normal([0.3, 0, 0])[0], 1, 1e-6);
  near(halfHeight({ kind: "cylinder", radius: 0.03, height: 0.1 }, fromAxis([1, 0, 0], Math.PI / 2)), 0.05, 1e-9);
  near(halfHeight({ kind: "box", size: [0.1, 0.2, 0.3] }, [0, 0, 0, 1]), 0.1, 1e-9);
});

test("a mesh is met at its planes", () => {
  const half = [0.1, 0.2, 0.3];
  const planes = half.flatMap((d, k) => [1, -1].map((side) => [0, 1, 2].map((axis) => (axis === k ? side : 0)).concat(d)));
  const at = { p: [1, 2, 3], q: fromAxis([0, 1, 0], 0.4) };
  const mesh = new Body({ kind: "mesh", file: "brick.glb", size: [0.2, 0.4, 0.6], planes }, at);
  const box = new Body({ kind: "box", size: [0.2, 0.4, 0.6] }, at);
  const next = random(5);
  let edges = 0;
  for (let i = 0; i < 300; i++) {
    const local = half.map((h) => (next() < 0.5 ? h * (2 * next() - 1) : h + 0.03 * next()));
    const beyond = local.filter((x, k) => Math.abs(x) > half[k]).length;
    edges += beyond === 2;
    const point = compose(at, { p: local, q: [0, 0, 0, 1] }).p;
    // Beyond a corner it is the distance to the nearest edge's line: less than 1.23 times too small.
    const [a, b] = [mesh.distance(point), box.distance(point)];
    assert.ok(beyond < 3 ? Math.abs(a - b) < 1e-9 : a <= b && b < 1.23 * a, `${beyond} ${a} ${b}`);
  }
  assert.ok(edges > 50);
  near(mesh.reach, Math.hypot(...half), 1e-9);
});

test("a steady motion is carried on to the display's time, and not further than trusted", () => {
  const track = new Track();
  const at = (t) => [{ p: [0.5e-3 * t, 0, 0], q: fromAxis([0, 1, 0], 1e-3 * t) }];
  for (let t = 1000; t <= 1048; t += 16) track.put(t, at(t));
  const ahead = track.at(1068)[0];
  near(ahead.p[0], 0.534, 1e-9);
  near(toVector(qmul(ahead.q, invert(at(1068)[0]).q)).reduce((s, x) => s + Math.abs(x), 0), 0, 1e-6);
  near(track.at(5000)[0].p[0], 0.5e-3 * (1048 + MOST_AHEAD_MS), 1e-9);
  track.put(10, at(10));
  assert.equal(track.at(20)[0].p[0], 0.005, "another session starts over");
});

test("the rig's clock is that of the quickest answer", () => {
  const clock = new RigClock();
  clock.put(0, 40, 5020 + 9);
  clock.put(100, 102, 5101);
  clock.put(200, 260, 5205);
  near(clock.rig(300), 5300, 1e-9);
  near(clock.uncertainty, 1, 1e-9);
});

test("without a graphics card the page draws less often, and with one as the screen does", () => {
  assert.ok(isSoftware("ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (LLVM 10.0.0)))"));
  assert.ok(!isSoftware("ANGLE (Intel, Mesa Intel(R) UHD Graphics 620)"));
  const drawn = (software, cost) => {
    const pace = new Pace(software);
    let count = 0;
    for (let ms = 0; ms < 10000; ms += 1000 / 60) if (pace.due(ms)) { pace.drawn(ms, cost); count++; }
    return count / 10;
  };
  near(drawn(false, 3), 60, 1);
  assert.ok(drawn(true, 5) <= 11);
  assert.ok(drawn(true, 80) <= 3, "a fifth of the time at most");
});

test("where pictures cost much, they become coarser, and finer again only where that is cheap", () => {
  const pace = new Pace(true);
  const draw = (cost) => {
    for (let i = 0; i < 60; i++) pace.drawn(i, cost(pace.width));
  };
  draw(() => 30);
  assert.equal(pace.width, 900);
  draw((width) => 90 * (width / 900) ** 2);
  assert.equal(pace.width, 640, "46 ms a picture: four a second");
  draw((width) => 200 * (width / 900) ** 2);
  assert.equal(pace.width, 480);
  draw(() => 400);
  assert.equal(pace.width, 480, "there is nothing coarser");
  assert.equal(pace.rate, 2);
  for (let i = 0; i < 4; i++) draw((width) => 10 * (width / 900) ** 2);
  assert.equal(pace.width, 900);
});

test("who draws seldom asks just before a picture is due, and waits a little for the answer", () => {
  const pace = new Pace(true);
  pace.drawn(1000, 5);
  near(pace.rest(1005), 87, 1e-9);
  assert.equal(pace.rest(5000), 0);
  assert.ok(!pace.due(1090) && pace.due(1100) && !pace.due(1100, false) && pace.due(1150, false));
  assert.equal(new Pace(false).rest(0), 0, "with a graphics card every pose is taken at once");
});

test("a pose that came too late for its picture is asked for again", () => {
  const pace = new Pace(true);
  pace.drawn(1000, 5);
  assert.ok(!pace.stale(12, 1097), "asked for just before the picture, and answered");
  assert.ok(pace.stale(12, 1010), "its answer came behind the picture that it was meant for");
  assert.ok(pace.stale(400, 1500), "it waited while a picture was drawn");
});

test("the time from the bus to the picture is that of the newest pose, told once", () => {
  const timing = new Timing();
  timing.begins(0, 5000);
  for (let i = 1; i <= 100; i++) {
    timing.came(5000 + 10 * i - 8);
    timing.came(5000 + 10 * i - 3);
    timing.begins(10 * i, 5000 + 10 * i);
    timing.begins(10 * i + 5, 5005 + 10 * i);
  }
  near(timing.within(0.5), 3, 1e-9);
  near(timing.rate, 200, 2);
  const told = timing.told(1005);
  assert.equal(told.waits_ms.length, 100, "a picture without a new pose is none");
  assert.deepEqual(timing.told(1005).waits_ms, []);
  assert.equal(timing.told(9000).pictures_hz, 0);
  timing.clear();
  assert.equal(timing.within(0.5), null);
});

test("the skin is closed, as thick as the flesh, and every finger moves its own part", () => {
  for (const side of ["right", "left"]) {
    const skin = makeSkin(HANDS[side].joints, HANDS[side].radii);
    const edges = new Map();
    for (let i = 0; i < skin.triangles.length; i += 3) {
      const corner = skin.triangles.subarray(i, i + 3);
      for (let k = 0; k < 3; k++) {
        const edge = `${corner[k]} ${corner[(k + 1) % 3]}`;
        edges.set(edge, (edges.get(edge) ?? 0) + 1);
      }
    }
    for (const edge of edges.keys()) {
      const [a, b] = edge.split(" ");
      assert.ok(edges.has(`${b} ${a}`), `${side}: an open edge`);
    }
    const points = skinned(skin, skin.poses);
    // At the middle of each finger's bones the skin is as far away as the flesh is thick.
    for (const [from, to, finger] of BONES.filter((bone) => bone[2] > 0)) {
      const middle = skin.poses[from].p.map((x, k) => (x + skin.poses[to].p[k]) / 2);
      const thick = (radii(side)[from] + radii(side)[to]) / 2;
      const found = Math.min(...points.map((p) => distance(p, middle)));
      near(found, thick, 0.0015, `${side} ${FINGERS[finger]} ${JOINTS[from]}`);
    }
  }
});

test("the skin goes where the joints go", () => {
  const skin = makeSkin(HANDS.right.joints, HANDS.right.radii);
  const at = { p: [0.3, 1, -0.2], q: fromAxis([0, 1, 0], 1) };
  const still = skinned(skin, placed(rest(), at));
  const moved = skinned(skin, placed(bent(rest(), [0.8, 1, 0.6], [0, 0, 0]), at));
  const rows = { thumb: [], index: [] };
  still.forEach((p, vertex) => {
    for (const name of Object.keys(rows)) {
      if (skin.fingers[FINGERS.length * vertex + FINGERS.indexOf(name)] > 0.98) rows[name].push(distance(p, moved[vertex]));
    }
  });
  assert.ok(Math.max(...rows.thumb) < 0.002, "a bent index pulls no thumb");
  assert.ok(Math.max(...rows.index) > 0.05);
});

test("names that somebody makes up fill no memory and push nothing out", () => {
  const rig = new Rig();
  const put = (name, t) => rig.frame({ [`rhot/object/${name}`]: { t, pose: [0, 0, 0, 0, 0, 0, 1], state: "measured" } });
  for (let number = 0; number < 1000; number++) {
    put("cup", 20 * number);
    put(`stranger${number}`, 20 * number);
  }
  assert.ok(rig.objects.size <= 64, `${rig.objects.size}`);
  assert.ok(rig.thingsAt(rig.objects, rig.latest).has("cup"));
});
