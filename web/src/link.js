// The connection to the rig: comes back by itself, says when a frame was taken, keeps the rig's clock.
import { RigClock } from "./motion.js";

const AGAIN_MS = [250, 500, 1000, 2000];
const ASK_MS = 1000;

export class Link {
  #socket = null;
  #tries = 0;
  #owed = 0;
  #wish = { rate_hz: 90, truth: false };
  #hear;

  /** hear(message) is called with each message but those about time. */
  constructor(hear) {
    this.#hear = hear;
    this.clock = new RigClock();
    this.connected = false;
    this.connections = 0;
    setInterval(() => this.#ask(), ASK_MS);
    this.#open();
  }

  #open() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/`);
    this.#socket = socket;
    socket.onopen = () => {
      this.connected = true;
      this.connections++;
      this.#owed = 0;
      this.#tries = 0;
      this.clock.clear();
      this.send({ type: "wish", ...this.#wish });
      this.#ask();
    };
    socket.onmessage = ({ data }) => {
      const arrivedMs = performance.now();
      const message = JSON.parse(data);
      if (message.type === "time") {
        if (message.rig_ms !== null) this.clock.put(message.at_ms, arrivedMs, message.rig_ms);
        return;
      }
      if (message.type === "frame") this.#owed++;
      this.#hear(message);
    };
    socket.onclose = () => {
      this.connected = false;
      setTimeout(() => this.#open(), AGAIN_MS[Math.min(this.#tries++, AGAIN_MS.length - 1)]);
    };
  }

  #ask() {
    this.send({ type: "time", at_ms: performance.now() });
  }

  send(message) {
    if (this.connected && this.#socket.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(message));
  }

  /** Say that the frames which have come are taken; the next ones come then. */
  taken() {
    for (; this.#owed > 0; this.#owed--) this.send({ type: "taken" });
  }

  /** Whether frames have come that were not said to be taken. */
  get owes() {
    return this.#owed > 0;
  }

  /** Tell how long poses took to be seen: what `rhot status` and `rhot bench --part page` show. */
  shown(told) {
    this.send({ type: "shown", clock_ms: this.clock.uncertainty, ...told });
  }

  wish(changes) {
    this.#wish = { ...this.#wish, ...changes };
    this.send({ type: "wish", ...this.#wish });
  }
}
