// How often the page draws: as the screen does, or less where drawing is slow, so that tracking keeps its processor.

/** Without a graphics card the processor draws; on two cores that also track, poses per second fell from 110 to 15
 * while a browser drew as fast as it could. */
export const SOFTWARE_HZ = 10;
const SLOWEST_HZ = 5;
/** Drawing may take this share of a moment. */
const SHARE = 0.25;

export const isSoftware = (name) => /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);

export class Pace {
  #last = -Infinity;
  #cost = 0;

  constructor(software) {
    this.software = software;
    this.rate = software ? SOFTWARE_HZ : Infinity;
  }

  /** Whether to draw at a moment, milliseconds. */
  due(ms) {
    // A little early is early enough: screens do not come in exact steps.
    return ms - this.#last >= 1000 / this.rate - 3;
  }

  /** A frame was drawn: begun at `ms`, it took so long. */
  drawn(ms, tookMs) {
    this.#last = ms;
    this.#cost += 0.1 * (tookMs - this.#cost);
    if (this.software) this.rate = Math.max(SLOWEST_HZ, Math.min(SOFTWARE_HZ, (1000 * SHARE) / Math.max(this.#cost, 1)));
  }
}
