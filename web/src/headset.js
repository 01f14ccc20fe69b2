// The WebXR session: who wears the headset, where it and a controller are, whose floor was moved.

const seven = ({ position: p, orientation: o }) => ({ position: [p.x, p.y, p.z], orientation: [o.x, o.y, o.z, o.w] });

export class Headset {
  #renderer;
  #link;
  #space = null;

  constructor(renderer, link) {
    this.#renderer = renderer;
    this.#link = link;
    renderer.xr.enabled = true;
    renderer.xr.setReferenceSpaceType("local-floor");
    this.on = false;
    /** Whether the rig wants to know where it is; the first message says so. */
    this.published = false;
    this.started = () => {};
    this.ended = () => {};
  }

  static async modes() {
    if (!navigator.xr) return [];
    const modes = [];
    for (const mode of ["immersive-vr", "immersive-ar"]) {
      if (await navigator.xr.isSessionSupported(mode).catch(() => false)) modes.push(mode);
    }
    return modes;
  }

  async enter(mode) {
    const session = await navigator.xr.requestSession(mode, { requiredFeatures: ["local-floor"] });
    session.addEventListener("end", () => {
      this.on = false;
      this.#space = null;
      this.#tell({ type: "left" });
      this.ended();
    });
    await this.#renderer.xr.setSession(session);
    this.#space = this.#renderer.xr.getReferenceSpace();
    this.#space.addEventListener?.("reset", () => this.#tell({ type: "moved" }));
    this.on = true;
    this.started(mode);
  }

  /** When the frame that is drawn now will be seen, milliseconds of `performance.now()`. */
  static displayMs(frame) {
    return frame.predictedDisplayTime ?? performance.now();
  }

  /** Tell the rig where headset and controller are. */
  publish(frame, displayMs) {
    if (!this.on || !this.#space || !this.published || !this.#link.clock.ready) return;
    const told = { type: "devices", t_ms: this.#link.clock.rig(displayMs) };
    const head = frame.getViewerPose(this.#space);
    // An emulated position is a guess of the headset's: it tracks rotation alone at this moment.
    if (head && !head.emulatedPosition) told.head = seven(head.transform);
    const sources = [...frame.session.inputSources].filter((source) => source.gripSpace && !source.hand);
    const source = sources.find(({ handedness }) => handedness === "right") ?? sources[0];
    const grip = source && frame.getPose(source.gripSpace, this.#space);
    if (grip && !grip.emulatedPosition) told.controller = seven(grip.transform);
    if (told.head || told.controller) this.#tell(told);
  }

  #tell(message) {
    if (this.published) this.#link.send(message);
  }
}
