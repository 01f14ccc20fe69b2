// When a hand holds a thing: from joints, radii and the thing's shape alone, the same for the same input.
//
// A finger touches where the flesh of its last two segments is at the surface. A thing is taken when the thumb and a
// finger touch it from opposite sides, have just closed on it, and do not slide past it. It then follows the hand, and
// is let go when the fingers have opened again by more than it took to close.
import { compose, distance, dot, invert, mix, sub } from "./math.js";
import { BENDING, FINGERS, PALM } from "./skeleton.js";

/** All lengths in metres, all times in milliseconds. The lengths are multiples of how well a fingertip is known: 1.2 to
 * 1.6 mm (median, `rhot evaluate tracking` and `pictures`). */
export const SETTINGS = {
  /** A finger this near touches: three such errors. */
  touch: 0.004,
  /** Cosine between the surface's directions under thumb and finger, at most: 120° apart. */
  opposed: -0.5,
  /** Thumb and finger have come together by so much before they took it: four errors; a stiff hand that passes by has
   * not closed. */
  closed: 0.006,
  closedWithin: 800,
  /** They stay so for so long … */
  dwell: 60,
  /** … and slide by less than this meanwhile: slower than 0.15 m/s. A hand that reaches past something moves at 0.5. */
  slide: 0.009,
  /** It is let go when thumb and finger are so much further apart than when they took it, … */
  open: 0.008,
  /** … or than at their closest, for fingers that sank into a thing that is not there. */
  reopened: 0.02,
  letGo: 50,
  /** A hand that is not seen for so long holds nothing. */
  lost: 400,
};

/** Where each finger is nearest to a body: gap (negative inside), point of the finger's middle line, normal there. */
export function contacts(poses, radii, body) {
  return FINGERS.map((_, finger) => {
    const rows = BENDING[finger].slice(1);
    let best = { gap: Infinity };
    for (let i = 0; i + 1 < rows.length; i++) {
      for (const share of [0, 0.5, 1]) {
        const point = mix(poses[rows[i]].p, poses[rows[i + 1]].p, share);
        const radius = radii[rows[i]] + (radii[rows[i + 1]] - radii[rows[i]]) * share;
        const gap = body.distance(point) - radius;
        if (gap < best.gap) best = { gap, point };
      }
    }
    return { ...best, normal: body.normal(best.point) };
  });
}

const tip = (poses, finger) => poses[BENDING[finger].at(-1)].p;
const aperture = (poses, finger) => distance(tip(poses, 0), tip(poses, finger));

/** The frame that a held thing is fixed in: between thumb and finger, turned as the palm is. */
const gripFrame = (poses, finger) => ({ p: mix(tip(poses, 0), tip(poses, finger), 0.5), q: poses[PALM].q });

/** One hand and one thing. */
export class Grip {
  #settings;
  #history = [];
  #since = null;
  #openSince = null;
  #start = null;
  #lastSeen = -Infinity;

  constructor(settings = {}) {
    this.#settings = { ...SETTINGS, ...settings };
    /** Whether the hand holds it. */
    this.held = false;
    /** Fingers beside the thumb that hold it. */
    this.fingers = [];
    /** Which fingers touch it. */
    this.touching = [];
    this.#clear();
  }

  #clear() {
    this.held = false;
    this.fingers = [];
    this.#since = this.#openSince = this.#start = null;
  }

  /** Take a moment of the hand (null = not seen) and of the thing; milliseconds of any steady clock. */
  step(t, poses, radii, body) {
    if (!poses) {
      this.touching = [];
      if (t - this.#lastSeen > this.#settings.lost) this.#clear();
      return this.held;
    }
    this.#lastSeen = t;
    this.#remember(t, poses);
    const near = distance(poses[PALM].p, body.at.p) < body.reach + 0.25;
    const found = near ? contacts(poses, radii, body) : [];
    this.touching = found.flatMap((contact, finger) => (contact.gap < this.#settings.touch ? [finger] : []));
    if (this.held) this.#hold(t, poses);
    else this.#wait(t, poses, body, found);
    return this.held;
  }

  #remember(t, poses) {
    if (this.#history.length && t < this.#history.at(-1).t) this.#history = [];
    this.#history.push({ t, apart: FINGERS.map((_, finger) => aperture(poses, finger)) });
    while (t - this.#history[0].t > this.#settings.closedWithin) this.#history.shift();
  }

  #wait(t, poses, body, found) {
    const { opposed, closed, dwell, slide } = this.#settings;
    const pairs = this.touching.filter(
      (finger) =>
        finger > 0 && this.touching[0] === 0 && dot(found[0].normal, found[finger].normal) < opposed,
    );
    const closing = pairs.filter(
      (finger) => Math.max(...this.#history.map((moment) => moment.apart[finger])) - aperture(poses, finger) >= closed,
    );
    if (!closing.length) {
      this.#since = null;
      return;
    }
    // In the thing's own frame: whoever carries it in the other hand brings it to the fingers.
    const inside = compose(invert(body.at), gripFrame(poses, closing[0])).p;
    if (this.#since === null || distance(inside, this.#start) > slide) {
      this.#since = t;
      this.#start = inside;
    } else if (t - this.#since >= dwell) {
      this.held = true;
      this.fingers = closing.map((finger) => {
        const apart = aperture(poses, finger);
        return { finger, taken: apart, least: apart };
      });
      this.inHand = compose(invert(gripFrame(poses, this.fingers[0].finger)), body.at);
    }
  }

  #hold(t, poses) {
    const { open, reopened, letGo } = this.#settings;
    let all = true;
    for (const one of this.fingers) {
      const apart = aperture(poses, one.finger);
      one.least = Math.min(one.least, apart);
      all &&= apart > one.taken + open || apart > one.least + reopened;
    }
    if (!all) this.#openSince = null;
    else if (this.#openSince === null) this.#openSince = t;
    else if (t - this.#openSince >= letGo) {
      this.#clear();
      // Opening is no closing: it is not taken again by the same fingers without that.
      this.#history = this.#history.slice(-1);
    }
  }

  /** Where a held thing is that has no place of its own. */
  carried(poses) {
    return compose(gripFrame(poses, this.fingers[0].finger), this.inHand);
  }
}

const GRAVITY = 9.81;
const STEP_MS = 4;
const STRAY_M = 0.7;

/** A thing that exists only here: held, falling or at rest on the desk; frame with y up, metres. */
export class VirtualThing {
  constructor(home, half) {
    this.home = home;
    this.half = half;
    this.at = home;
    this.fall = 0;
    this.t = null;
  }

  /** One moment: the pose that a hand gives it, or none, and how high the desk is. */
  step(t, carried, deskHeight) {
    const elapsed = this.t === null ? 0 : Math.min(Math.max(t - this.t, 0), 100);
    this.t = t;
    if (carried) {
      this.at = carried;
      this.fall = 0;
      return;
    }
    const rest = deskHeight + this.half(this.at.q);
    for (let left = elapsed; left > 0 && this.at.p[1] > rest; left -= STEP_MS) {
      const dt = Math.min(left, STEP_MS) / 1000;
      this.fall += GRAVITY * dt;
      this.at = { ...this.at, p: sub(this.at.p, [0, this.fall * dt, 0]) };
    }
    if (this.at.p[1] <= rest) {
      this.fall = 0;
      this.at = { ...this.at, p: [this.at.p[0], rest, this.at.p[2]] };
      const away = Math.hypot(this.at.p[0] - this.home.p[0], this.at.p[2] - this.home.p[2]);
      if (away > STRAY_M) this.at = this.home;
    }
  }
}
