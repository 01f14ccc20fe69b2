// How long it takes from a pose on the rig's bus to the picture that shows it, measured here: the rig stamps when the bus
// handed the pose over, and the browser knows the rig's clock from questions and answers.

const KEPT = 600;

export class Timing {
  #bus = null;
  #begun = [];
  #untold = [];

  constructor() {
    /** Milliseconds of the newest pictures that showed a new pose. */
    this.waits = [];
  }

  /** A pose came; a newer one takes the place of one that was never drawn. Rig clock, milliseconds. */
  came(busMs) {
    if (busMs !== undefined) this.#bus = busMs;
  }

  /** A picture is begun now: `performance.now()`, and the same moment by the rig's clock. */
  begins(ms, rigMs) {
    this.#begun.push(ms);
    this.#trim(ms);
    if (this.#bus === null) return;
    const wait = rigMs - this.#bus;
    this.#bus = null;
    this.#untold.push(wait);
    this.waits.push(wait);
    if (this.waits.length > KEPT) this.waits.shift();
  }

  #trim(ms) {
    while (this.#begun.length && this.#begun[0] < ms - 2000) this.#begun.shift();
  }

  /** Pictures per second over the last two seconds; 0 before there are any. */
  get rate() {
    const begun = this.#begun;
    return begun.length > 1 ? (1000 * (begun.length - 1)) / (begun.at(-1) - begun[0]) : 0;
  }

  /** A share (0…1) of the waits is not longer than this, milliseconds; null before there are any. */
  within(share) {
    if (!this.waits.length) return null;
    const sorted = [...this.waits].sort((a, b) => a - b);
    return sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
  }

  /** What has not been told yet, for the rig; `ms` is now. */
  told(ms, most = 240) {
    this.#trim(ms);
    const waits_ms = this.#untold.splice(0).slice(-most).map((wait) => Math.round(100 * wait) / 100);
    return { pictures_hz: Math.min(this.rate, 1000), waits_ms };
  }

  /** What came before is of another connection, with another clock. */
  clear() {
    this.#bus = null;
    this.waits = [];
    this.#untold = [];
  }
}
