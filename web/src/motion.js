// Poses at the moment they are shown: a straight line through the last samples, not further than trusted.
import { add, fromVector, qconj, qmul, qunit, scale, sub, toVector } from "./math.js";

/** Furthest that a pose is carried on, milliseconds; a hand turns back within about 100. */
export const MOST_AHEAD_MS = 60;
/** The two samples that tell the velocity are at least so far apart: nearer ones tell mostly noise. */
const APART_MS = 14;
const FORGET_MS = 200;

/** Poses {p, q} of one thing, N at a time, by rig time in milliseconds. */
export class Track {
  #samples = [];

  /** Keep a sample; an older one than the last is of another session and starts over. */
  put(t, poses) {
    const last = this.#samples.at(-1);
    if (last && (t < last.t || t - last.t > FORGET_MS || poses.length !== last.poses.length)) this.#samples = [];
    if (last && t === last.t) return;
    this.#samples.push({ t, poses });
    if (this.#samples.length > 4) this.#samples.shift();
  }

  get newest() {
    return this.#samples.at(-1);
  }

  /** Milliseconds since the newest sample; infinite without one. */
  age(t) {
    const last = this.#samples.at(-1);
    return last ? t - last.t : Infinity;
  }

  /** Poses at a moment, at most `MOST_AHEAD_MS` after the newest sample; null without one. */
  at(t) {
    const last = this.#samples.at(-1);
    if (!last) return null;
    const ahead = Math.min(Math.max(t - last.t, 0), MOST_AHEAD_MS);
    let before = null;
    for (let i = this.#samples.length - 2; i >= 0 && !before; i--) {
      if (last.t - this.#samples[i].t >= APART_MS) before = this.#samples[i];
    }
    if (!before || ahead === 0) return last.poses;
    const share = ahead / (last.t - before.t);
    return last.poses.map((pose, i) => {
      const was = before.poses[i];
      const turned = toVector(qmul(pose.q, qconj(was.q)));
      return {
        p: add(pose.p, scale(sub(pose.p, was.p), share)),
        q: qunit(qmul(fromVector(scale(turned, share)), pose.q)),
      };
    });
  }
}

/** Rig time from this browser's clock, by questions and answers: the quickest answer of the last ones counts. */
export class RigClock {
  #answers = [];

  put(askedMs, answeredMs, rigMs) {
    this.#answers.push({ trip: answeredMs - askedMs, offset: rigMs - (askedMs + answeredMs) / 2 });
    if (this.#answers.length > 16) this.#answers.shift();
  }

  get ready() {
    return this.#answers.length > 0;
  }

  get offset() {
    return this.#answers.reduce((best, one) => (one.trip < best.trip ? one : best)).offset;
  }

  /** How far the offset may be wrong, milliseconds. */
  get uncertainty() {
    return Math.min(...this.#answers.map((one) => one.trip)) / 2;
  }

  /** Rig time, milliseconds, of a moment of `performance.now()`. */
  rig(ms) {
    return ms + this.offset;
  }

  clear() {
    this.#answers = [];
  }
}
