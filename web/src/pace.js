// How often the page draws: as the screen does, or less where drawing is slow, so that tracking keeps its processor.

/** Without a graphics card the processor draws; on two cores that also track, poses per second fell from 110 to 15
 * while a browser drew as fast as it could. */
export const SOFTWARE_HZ = 10;
const SLOWEST_HZ = 2;
/** Drawing may take this share of a moment. A processor draws on two of its cores at once. */
const SHARE = 0.2;
/** Widths of the picture that the processor draws, pixels: the coarser one where the finer one leaves less than so many
 * pictures per second, and back where it would leave more than twice as many. */
const WIDTHS = [900, 640, 480];
const COARSER_HZ = 4;
/** After a change, so many pictures pass before the next. */
const STEADY = 20;
/** The first pictures of a size are not counted: what draws them is being made. */
const FIRST = 2;
/** In periods. */
const PATIENCE = 1.5;
/** A question takes two milliseconds, and the screen comes round every 17. */
const ASK_MS = 8;

/** Answers take 2 to 10 ms, and poses come every 9 to 33: what is older has waited for the browser. */
const OLD_MS = 50;

export const isSoftware = (name) => /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);

export class Pace {
  #last = -Infinity;
  #cost = 0;
  #since = 0;
  #step = 0;

  constructor(software) {
    this.software = software;
    this.rate = software ? SOFTWARE_HZ : Infinity;
  }

  /** Width of the picture, pixels, at most. */
  get width() {
    return this.software ? WIDTHS[this.#step] : Infinity;
  }

  /** Whether to draw at a moment, milliseconds. Who draws seldom waits a little for a pose that is on its way. */
  due(ms, fresh = true) {
    // A little early is early enough: screens do not come in exact steps.
    return ms - this.#last >= (this.software && !fresh ? PATIENCE : 1) * (1000 / this.rate) - 3;
  }

  /** How long to wait before asking for the next pose, so that it is new when it is drawn: milliseconds. */
  rest(ms) {
    return this.software ? Math.max(0, this.#last + 1000 / this.rate - ASK_MS - ms) : 0;
  }

  /** Whether a pose that came at `ms` should be asked for again: it waited behind other work, or the picture is far off. */
  stale(ageMs, ms) {
    return ageMs > OLD_MS || this.rest(ms) > ASK_MS;
  }

  /** A frame was drawn: begun at `ms`, it took so long. */
  drawn(ms, tookMs) {
    this.#last = ms;
    if (!this.software) return;
    this.#since++;
    if (this.#since <= FIRST) return;
    this.#cost += (this.#cost ? 0.15 : 1) * (tookMs - this.#cost);
    const rate = (1000 * SHARE) / Math.max(this.#cost, 1);
    this.rate = Math.max(SLOWEST_HZ, Math.min(SOFTWARE_HZ, rate));
    if (this.#since < STEADY) return;
    const finer = this.#step > 0 ? rate * (WIDTHS[this.#step] / WIDTHS[this.#step - 1]) ** 2 : 0;
    if (rate < COARSER_HZ && this.#step + 1 < WIDTHS.length) this.#coarser(1);
    else if (finer > 2 * COARSER_HZ) this.#coarser(-1);
  }

  #coarser(by) {
    this.#step += by;
    this.#since = 0;
    this.#cost = 0;
  }
}
