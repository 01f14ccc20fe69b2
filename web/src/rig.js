// What the rig has said: tracks of hands and things, in stage axes at any moment.
import { IDENTITY, compose, distance, invert, mix, pose, poseOfMatrix } from "./math.js";
import { Track } from "./motion.js";
import { BENDING, JOINTS } from "./skeleton.js";

/** What is so much older than the newest of all is not shown, milliseconds … */
const GONE_MS = 600;
/** … and nothing is when nothing has come for so long; longer, because a slow browser takes frames late. */
const SILENT_MS = 5000;
const TRUTHS = 16;
/** Objects that are remembered once they have gone; a rig has about ten, but anybody may make up names. */
const MOST_THINGS = 64;

export class Rig {
  constructor() {
    this.hands = new Map();
    this.objects = new Map();
    this.feet = new Map();
    this.body = null;
    this.head = null;
    this.truths = [];
    this.stage = null;
    this.guessed = true;
    this.webxr = null;
    /** Rig time of the newest of all, milliseconds. */
    this.latest = -Infinity;
    this.errors = [];
    this.waiting = new Map();
  }

  get T_stage_rig() {
    return this.stage ? invert(this.stage) : IDENTITY;
  }

  /** Take the first message: the floor as the rig folder has it. */
  hello(message) {
    this.stage = poseOfMatrix(message.stage.T);
    this.guessed = message.stage.source.startsWith("a guess");
    this.webxr = message.webxr ? poseOfMatrix(message.webxr) : null;
  }

  /** Take a frame. */
  frame(keys) {
    for (const [key, value] of Object.entries(keys)) {
      const [kind, name] = key.slice("rhot/".length).split("/");
      if (value.t !== undefined && kind !== "truth") this.latest = Math.max(this.latest, value.t);
      if (kind === "hand") this.#hand(name, value);
      else if (kind === "object") this.#put(this.objects, name, value);
      else if (kind === "foot") this.#put(this.feet, name, value);
      else if (kind === "head") this.head = value;
      else if (kind === "body") this.body = value;
      else if (kind === "truth") this.#truth(value);
      else if (kind === "space" && name === "stage") {
        this.stage = poseOfMatrix(value.T);
        this.guessed = false;
      } else if (kind === "space" && name === "webxr") this.webxr = poseOfMatrix(value.T);
    }
  }

  #put(things, name, value) {
    if (!things.has(name) && things.size >= MOST_THINGS) {
      for (const [other, { track }] of things) if (track.age(this.latest) > GONE_MS) things.delete(other);
    }
    const thing = things.get(name) ?? { track: new Track() };
    thing.track.put(value.t, [pose(value.pose)]);
    things.set(name, Object.assign(thing, { shape: value.shape ?? null, state: value.state }));
  }

  #hand(side, value) {
    const hand = this.hands.get(side) ?? { track: new Track() };
    hand.track.put(value.t, JOINTS.map((_, row) => pose(value.joints, 7 * row)));
    this.hands.set(side, Object.assign(hand, { radii: value.radii, predicted: value.predicted, state: value.state }));
    this.#compare(side, value);
  }

  #truth(value) {
    const hands = Object.fromEntries(
      Object.entries(value.hands).map(([side, numbers]) => [side, JOINTS.map((_, row) => pose(numbers, 7 * row))]),
    );
    this.truths.push({ t: value.t, hands });
    if (this.truths.length > TRUTHS) this.truths.shift();
  }

  /** Fingertip errors of a hand against the truth of its own moment. */
  #compare(side, value) {
    const after = this.truths.findIndex(({ t }) => t >= value.t);
    // The truth of this very moment may still be on its way: then that of the hand before is compared.
    const moment = after > 0 ? value : this.waiting.get(side);
    this.waiting.set(side, value);
    const next = moment ? this.truths.findIndex(({ t }) => t >= moment.t) : -1;
    if (next <= 0) return;
    const [a, b] = [this.truths[next - 1], this.truths[next]];
    if (!a.hands[side] || !b.hands[side]) return;
    const share = (moment.t - a.t) / (b.t - a.t);
    for (const rows of BENDING) {
      const row = rows.at(-1);
      const true_ = mix(a.hands[side][row].p, b.hands[side][row].p, share);
      this.errors.push(distance(pose(moment.joints, 7 * row).p, true_));
    }
    if (this.errors.length > 300) this.errors.splice(0, this.errors.length - 300);
  }

  get medianError() {
    if (!this.errors.length) return null;
    return [...this.errors].sort((a, b) => a - b)[this.errors.length >> 1];
  }

  /** The true hand, stage axes; null where no truth is known. */
  trueHand(side) {
    const joints = this.truths.at(-1)?.hands[side];
    const T = this.T_stage_rig;
    return joints ? joints.map((one) => compose(T, one)) : null;
  }

  /** Hands that are there at rig time t: side → {poses, radii, …}, stage axes. */
  handsAt(t) {
    return this.#at(this.hands, t, (hand, poses) => ({ ...hand, poses }));
  }

  /** Objects or feet at rig time t: name → {at, shape, state}. */
  thingsAt(things, t) {
    return this.#at(things, t, (thing, [at]) => ({ ...thing, at }));
  }

  #at(things, t, make) {
    const T = this.T_stage_rig;
    const found = new Map();
    if (t - this.latest > SILENT_MS) return found;
    for (const [name, thing] of things) {
      if (thing.track.age(this.latest) > GONE_MS) continue;
      found.set(name, make(thing, thing.track.at(t).map((one) => compose(T, one))));
    }
    return found;
  }

  /** Joints of the body, stage axes; null where none are known. */
  bodyAt(t) {
    if (!this.body || t - this.latest > SILENT_MS || this.latest - this.body.t > GONE_MS) return null;
    const T = this.T_stage_rig;
    return Object.fromEntries(
      Object.entries(this.body.joints).map(([name, p]) => [name, compose(T, { p, q: [0, 0, 0, 1] }).p]),
    );
  }

  forget() {
    this.hands.clear();
    this.objects.clear();
    this.feet.clear();
    this.body = this.head = null;
    this.truths = [];
    this.latest = -Infinity;
  }
}
