// The page Grasp: from the rig's messages to the picture, on a desktop or in a headset.
import { Box3, PCFSoftShadowMap, PerspectiveCamera, Vector2, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { Grip, VirtualThing } from "./grasp.js";
import { HandView } from "./hand_view.js";
import { Headset } from "./headset.js";
import { Labels, Signs } from "./labels.js";
import { Link } from "./link.js";
import { IDENTITY, add, apply, compose, invert, sub } from "./math.js";
import { Pace, isSoftware } from "./pace.js";
import { restrained } from "./proxy.js";
import { Rig } from "./rig.js";
import { World } from "./scene.js";
import { Body, UNKNOWN, halfHeight } from "./shapes.js";
import { BENDING, FINGERS, PALM, WRIST } from "./skeleton.js";
import { drawPlainly } from "./surfaces.js";
import { Timing } from "./timing.js";

const BALL = { kind: "sphere", radius: 0.028 };
/** Beside the middle of the desk, on the thumb's side of a right hand. */
const BALL_FROM_MIDDLE = [-0.13, 0, -0.1];
/** From the thumb's side, over the hand: thumb and fingers are both seen. */
const VIEW_FROM = { hand: [-0.27, 0.25, 0.33], body: [1.6, 1.1, 2.6] };
const WIDE = 0.8;
const FOLLOW_S = 0.7;
const GREEN = 0x62c987;
const $ = (id) => document.getElementById(id);

const rig = new Rig();
const canvas = $("view");
const pace = new Pace(isSoftware(rendererName()));
if (pace.software) drawPlainly();
const renderer = makeRenderer();
if (pace.software) renderer.xr.setFramebufferScaleFactor(0.5);
renderer.shadowMap.enabled = !pace.software;
renderer.shadowMap.type = PCFSoftShadowMap;
const world = new World(!pace.software);
const camera = new PerspectiveCamera(42, 1, 0.02, 20);
const controls = new OrbitControls(camera, canvas);
controls.enableDamping = true;
controls.minDistance = 0.12;
controls.maxDistance = 6;
const labels = new Labels($("tags"));
const signs = new Signs();
world.root.add(signs);
const link = new Link(hear);
const timing = new Timing();
/** Whether a pose has come that is not drawn yet. */
let fresh = false;
const headset = new Headset(renderer, link);
const views = new Map();
const ghosts = new Map();
const grips = new Map();
let hello = null;
let models = "";
let ball = null;
let deskHeight = 0;
let framed = false;
let lastMs = 0;

/** For tests, and for whoever is curious at the console. */
const seen = (window.rhot = {
  frames: 0, drawn: {}, twins: {}, t: null, held: {}, T_webxr_rig: null, rig, link, pace, headset, timing, signs,
  get ball() { return ball?.at; },
  /** The 26 joints of a hand as they are drawn, in the space of desktop or headset. */
  bones: (side) => views.get(side)?.bones.map((bone) => bone.getWorldPosition(new Vector3()).toArray()),
  /** Where a thing is drawn: its middle and its edges along the axes of desktop or headset; null while it is not. */
  drawnThing(name) {
    const mesh = world.drawn(name);
    if (!mesh) return null;
    const box = new Box3().setFromObject(mesh);
    return { middle: box.getCenter(new Vector3()).toArray(), size: box.getSize(new Vector3()).toArray(), model: mesh.isGroup ?? false };
  },
  software: pace.software,
});

function makeRenderer() {
  try {
    return new WebGLRenderer({ canvas, antialias: !pace.software, powerPreference: "high-performance" });
  } catch (error) {
    $("state").textContent = "This browser draws no 3D (WebGL): switch its hardware acceleration on, or use another one.";
    throw error;
  }
}

/** Who draws, asked before there is anything to draw with. */
function rendererName() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return name;
}

function hear(message) {
  if (message.type === "hello") {
    hello = message;
    rig.hello(message);
    begin();
  } else if (message.type === "frame") {
    rig.frame(message.keys);
    timing.came(message.bus);
    // Who draws seldom asks for the next pose when it is time, and again where it was late: it is as new as can be.
    const age = message.bus === undefined || !link.clock.ready ? 0 : link.clock.rig(performance.now()) - message.bus;
    fresh = !pace.software || !pace.stale(age, performance.now());
    if (!pace.software) link.taken();
    else if (!fresh) askInTime();
  }
}

function begin() {
  const wanted = JSON.stringify([hello.hands, hello.paint]);
  if (wanted !== models) {
    models = wanted;
    for (const view of [...views.values(), ...ghosts.values()]) {
      world.root.remove(view);
      view.dispose();
    }
    views.clear();
    ghosts.clear();
  }
  const middle = apply(rig.T_stage_rig, hello.desk.middle);
  deskHeight = hello.desk.shown ? middle[1] : 0;
  world.placeDesk(middle, hello.desk.shown);
  world.models.tell(hello.meshes);
  const at = add(middle, BALL_FROM_MIDDLE);
  ball = new VirtualThing({ p: [at[0], deskHeight + BALL.radius, at[2]], q: [0, 0, 0, 1] }, (q) => halfHeight(BALL, q));
  headset.published = hello.may_publish && hello.devices.length > 0;
  $("simulated").hidden = !hello.simulated;
  const [what, by] = hello.desk.shown ? ["hand", "cameras"] : ["person's feet and legs", "the camera on the head"];
  $("tagline").textContent = hello.simulated
    ? `a simulated ${what}, followed by the real tracker: each joint, as it moves`
    : `a real ${what}, followed by ${by}: each joint, as it moves`;
  for (const part of document.querySelectorAll(".of-hands")) part.hidden = !hello.desk.shown;
  for (const part of document.querySelectorAll(".of-feet")) part.hidden = hello.desk.shown;
  // Its address is that of the rig's own machine.
  $("other").hidden = !hello.other_page || !["localhost", "127.0.0.1", "[::1]"].includes(location.hostname);
  if (hello.other_page) $("other").href = hello.other_page;
  if (!framed) {
    framed = true;
    const from = hello.desk.shown ? VIEW_FROM.hand : VIEW_FROM.body;
    controls.target.set(middle[0], hello.desk.shown ? middle[1] + 0.1 : 0.9, middle[2]);
    // A window that is higher than wide shows as much from further away.
    const further = Math.min(2, Math.max(1, WIDE / (innerWidth / innerHeight)));
    camera.position.copy(controls.target).add(new Vector3(...from).multiplyScalar(further));
  }
}

function viewOf(side) {
  if (!views.has(side)) {
    const view = new HandView(side, hello.hands[side], hello.paint[side]);
    world.root.add(view);
    views.set(side, view);
  }
  return views.get(side);
}

function ghostOf(side) {
  if (!ghosts.has(side)) {
    const ghost = new HandView(side, hello.hands[side], {});
    ghost.ghost(GREEN);
    world.root.add(ghost);
    ghosts.set(side, ghost);
  }
  return ghosts.get(side);
}

/** The twin is where its tracker says, held or not: a hand that has closed on it lights it up. Cups and boxes are also
 * held over an edge, so directions 60° apart count. */
const TWIN_GRIP = { touch: 0.008, opposed: 0.5, closed: 0.003 };

/** Whether a hand holds a body; what it was last time is kept by the pair's name. */
function gripOf(side, name) {
  const key = `${side} ${name}`;
  if (!grips.has(key)) grips.set(key, new Grip(name ? TWIN_GRIP : {}));
  return grips.get(key);
}

function placeInHeadset() {
  const registered = rig.webxr !== null;
  const T = headset.on && registered ? compose(invert(rig.webxr), rig.stage ?? IDENTITY) : IDENTITY;
  world.root.position.set(...T.p);
  world.root.quaternion.set(...T.q);
  seen.T_webxr_rig = headset.on ? compose(T, rig.T_stage_rig) : null;
}

function frame(nowMs, xrFrame) {
  if (!xrFrame && headset.on) return;
  const begun = performance.now();
  // A headset says when to draw; only one that is emulated without a graphics card is held back.
  if ((!xrFrame || pace.software) && !pace.due(begun, fresh)) return;
  fresh = false;
  if (link.clock.ready) timing.begins(begun, link.clock.rig(begun));
  const displayMs = xrFrame ? Headset.displayMs(xrFrame) : begun + 8;
  if (xrFrame) headset.publish(xrFrame, displayMs);
  if (hello && link.clock.ready) update(link.clock.rig(displayMs), displayMs, (nowMs - lastMs) / 1000);
  lastMs = nowMs;
  placeInHeadset();
  if (!xrFrame) fit();
  renderer.render(world.scene, camera);
  // Without a graphics card the drawing goes on after `render`: reading a pixel waits for it.
  if (pace.software && !xrFrame) renderer.getContext().readPixels(0, 0, 1, 1, 6408, 5121, new Uint8Array(4));
  const done = performance.now();
  pace.drawn(begun, done - begun);
  seen.frames++;
  if (link.owes) askInTime();
}

let asking = null;
/** Ask for the next pose so that it comes just before it is drawn. */
function askInTime() {
  clearTimeout(asking);
  asking = setTimeout(() => link.taken(), pace.rest(performance.now()));
}

function update(t, displayMs, elapsed) {
  const hands = rig.handsAt(t);
  const objects = rig.thingsAt(rig.objects, t);
  objects.delete("controller");
  const tags = new Map();
  const bodies = new Map([...objects].map(([name, { shape, at }]) => [name, new Body(shape ?? UNKNOWN, at)]));
  let carried = null;
  const virtual = new Body(BALL, ball.at);
  for (const side of ["left", "right"]) {
    const hand = hands.get(side);
    const grip = gripOf(side, "");
    grip.step(displayMs, hand?.poses ?? null, hand?.radii, virtual);
    if (grip.held && hand) carried ??= grip.carried(hand.poses);
    else if (grip.held) carried ??= ball.at;
    for (const [name, body] of bodies) gripOf(side, name).step(displayMs, hand?.poses ?? null, hand?.radii, body);
  }
  ball.step(displayMs, carried, deskHeight);
  const holds = (name) => ["left", "right"].some((side) => grips.get(`${side} ${name}`)?.held);
  seen.held = Object.fromEntries(["", ...bodies.keys()].map((name) => [name || "ball", holds(name)]));
  const surfaces = [...bodies.values(), new Body(BALL, ball.at)];
  for (const [side, view] of views) if (!hands.has(side)) view.visible = false;
  seen.drawn = {};
  seen.t = t;
  seen.twins = Object.fromEntries([...objects].map(([name, { at }]) => [name, at.p]));
  for (const [side, hand] of hands) {
    const poses = $("proxy").checked ? restrained(hand.poses, hand.radii, surfaces) : hand.poses;
    const view = viewOf(side);
    view.visible = true;
    view.show(poses, hand.predicted, hand.state);
    seen.drawn[side] = { tracked: hand.poses, drawn: poses };
    world.shade(side, poses[PALM].p, 0.09, deskHeight);
    tags.set(side, [hand.state === "predicted" ? `${side} hand, predicted` : `tracked ${side} hand`, poses[WRIST].p]);
    if (hand.predicted.length && hand.state !== "predicted") {
      const row = BENDING[FINGERS.indexOf(hand.predicted.at(-1))][1];
      tags.set(`${side} predicted`, [`not seen, predicted: ${hand.predicted.join(", ")}`, add(poses[row].p, [0, 0.05, 0])]);
    }
  }
  for (const side of ["left", "right"]) if (!hands.has(side)) world.shade(side, null);
  for (const [name, { shape, state, at }] of objects) {
    world.shade(name, at.p, 1.3 * bodies.get(name).reach, deskHeight);
    world.thing(name, shape, at, { predicted: state === "predicted", lit: holds(name) });
    const note = shape ? "" : " (shape not known: a 6 cm box)";
    tags.set(`thing ${name}`, [`${name}: twin of the tracked object${holds(name) ? ", held" : note}`, sub(at.p, [0, halfHeight(shape ?? UNKNOWN, at.q) + 0.01, 0])]);
  }
  for (const name of bodiesGone(bodies)) {
    world.thing(name, null, null);
    world.shade(name, null);
  }
  world.shade(" ball", hello.desk.shown ? ball.at.p : null, 1.6 * BALL.radius, deskHeight);
  world.thing(" ball", BALL, hello.desk.shown ? ball.at : null, { virtual: true, lit: holds("") });
  if (hello.desk.shown) tags.set("ball", [holds("") ? "virtual ball · held" : "a ball that exists only here", ball.at.p]);
  const feet = rig.thingsAt(rig.feet, t);
  for (const side of ["left", "right"]) world.foot(side, feet.get(side)?.at ?? null, feet.get(side)?.state === "predicted");
  world.body(rig.bodyAt(t), rig.body?.predicted ?? []);
  showTruth(hands);
  follow(hands, elapsed);
  if (!headset.on) labels.set(tags, camera, innerWidth, innerHeight);
  signs.set(tags, headset.on && labels.shown);
  say(hands, t);
}

let known = [];
function bodiesGone(bodies) {
  const gone = known.filter((name) => !bodies.has(name));
  known = [...bodies.keys()];
  return gone;
}

function showTruth(hands) {
  $("truth-label").hidden = false;
  const wanted = $("truth").checked;
  document.querySelector(".truth-key").hidden = !wanted;
  for (const side of ["left", "right"]) {
    const poses = wanted && hands.has(side) ? rig.trueHand(side) : null;
    if (poses) ghostOf(side).show(poses, [], "measured");
    if (ghosts.has(side)) ghosts.get(side).visible = Boolean(poses);
  }
}

/** Keep hands in the middle, with the camera moving along; who has turned the view keeps the turn. */
function follow(hands, elapsed) {
  if (!$("follow").checked || !hands.size || headset.on || !hello.desk.shown) return;
  let middle = [0, 0, 0];
  for (const { poses } of hands.values()) middle = add(middle, poses[BENDING[2][0]].p);
  const wanted = new Vector3(...middle).multiplyScalar(1 / hands.size);
  const step = wanted.sub(controls.target).multiplyScalar(1 - Math.exp(-Math.min(elapsed, 0.5) / FOLLOW_S));
  controls.target.add(step);
  camera.position.add(step);
}

function fit() {
  const { clientWidth: width, clientHeight: height } = canvas;
  const size = renderer.getSize(new Vector2());
  const ratio = pace.software ? Math.min(1, pace.width / width) : Math.min(devicePixelRatio, 2);
  if (size.x !== width || size.y !== height || renderer.getPixelRatio() !== ratio) {
    renderer.setPixelRatio(ratio);
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
  }
  controls.update();
}

let saidMs = 0;
function say(hands, t) {
  if (performance.now() - saidMs < 250) return;
  saidMs = performance.now();
  const parts = [];
  if (!hands.size && !rig.body) {
    const feet = hello.desk.shown ? 0 : rig.thingsAt(rig.feet, t).size;
    parts.push(hello.desk.shown ? "no hand in view" : feet ? `${feet === 1 ? "one foot" : "both feet"} followed` : "no foot in view");
  } else {
    for (const [side, { state, predicted, track }] of hands) {
      const age = Math.max(0, t - track.newest.t);
      parts.push(`${side} hand ${state}${predicted.length ? `, ${predicted.join(", ")} predicted` : ""} · ${age.toFixed(0)} ms old`);
    }
  }
  if ($("truth").checked) {
    const error = rig.medianError;
    parts.push(error === null ? "no truth here: only a simulation knows it" : `fingertips ${(1e3 * error).toFixed(1)} mm from the truth (median)`);
  }
  if (rig.guessed) parts.push("floor guessed");
  if ($("timing").checked && timing.waits.length) {
    parts.push(
      `seen ${timing.within(0.5).toFixed(1)} ms after it was on the bus (99 of 100 within ${timing.within(0.99).toFixed(1)} ms), ` +
        `one picture is ${(1000 / timing.rate).toFixed(1)} ms, clock ± ${link.clock.uncertainty.toFixed(1)} ms`,
    );
  }
  if (pace.software) parts.push(`no graphics card: ${pace.rate.toFixed(0)} pictures/s`);
  $("state").className = "";
  $("state").textContent = parts.join(" · ");
}

function watch() {
  if (!link.connected || !hello) {
    $("state").className = "bad";
    $("state").textContent = link.connections
      ? "The rig does not answer; this page reconnects automatically."
      : "connecting …";
    rig.forget();
    timing.clear();
  } else if (!link.clock.ready) {
    $("state").className = "bad";
    $("state").textContent = "The rig is not running: no clock (fusion). `rhot sim` or `rhot up` starts it.";
  }
  // Who asks for each pose by itself gets it at once.
  const rate_hz = pace.software ? 60 : headset.on ? 120 : 90;
  link.wish({ truth: $("truth").checked, rate_hz, ahead: pace.software ? 1 : 2 });
}
setInterval(watch, 500);
setInterval(() => {
  if (link.clock.ready) link.shown({ ...timing.told(performance.now()), graphics: !pace.software });
}, 1000);

$("what").onclick = () => {
  $("about").hidden = !$("about").hidden;
  $("what").setAttribute("aria-expanded", String(!$("about").hidden));
};
$("labels").onchange = () => (labels.shown = $("labels").checked);
$("truth").onchange = () => { rig.errors = []; rig.truths = []; watch(); };

function note(text) {
  $("note").hidden = !text;
  $("note").textContent = text;
}

headset.started = (entered) => {
  world.surroundings.visible = entered === "immersive-vr";
  world.scene.background = entered === "immersive-vr" ? world.background : null;
  $("tags").hidden = true;
  if (!hello?.may_publish) note("Looking only: this link does not let the headset tell the rig where it is.");
  else if (!hello.devices.length) note("To align headset and rig, rig.toml needs [objects.head] and [objects.controller] with source = \"webxr\"; see docs/grasp.md.");
  else if (!rig.webxr) note("Not aligned with the rig yet: `rhot calibrate objects --live --object controller` takes ten places.");
};
headset.ended = () => {
  world.surroundings.visible = true;
  world.scene.background = world.background;
  $("tags").hidden = false;
  note("");
};
Headset.modes().then((modes) => {
  const wanted = modes.includes("immersive-vr") ? "immersive-vr" : modes[0];
  $("headset").hidden = !wanted;
  $("headset").onclick = () => headset.enter(wanted).catch((error) => note(`The headset did not start: ${error.message}`));
  if (!wanted && !isSecureContext) note("Headsets need https here: `rhot keys make` on the rig, then open the page by https.");
});

renderer.setAnimationLoop(frame);
