// Labels beside what they explain, as HTML over the picture.
import { Vector3 } from "three";

export class Labels {
  #box;
  #tags = new Map();
  #at = new Vector3();

  constructor(box) {
    this.#box = box;
    this.shown = true;
  }

  /** Show exactly these: name → [text, point in the world]. */
  set(labels, camera, width, height) {
    for (const [name, tag] of this.#tags) if (!this.shown || !labels.has(name)) tag.hidden = true;
    if (!this.shown) return;
    const taken = [];
    for (const [name, [text, point]] of labels) {
      let tag = this.#tags.get(name);
      if (!tag) {
        tag = document.createElement("span");
        tag.className = "tag";
        this.#box.append(tag);
        this.#tags.set(name, tag);
      }
      this.#at.set(...point).project(camera);
      tag.hidden = this.#at.z > 1 || Math.abs(this.#at.x) > 1 || Math.abs(this.#at.y) > 1;
      if (tag.hidden) continue;
      if (tag.textContent !== text) tag.textContent = text;
      const x = Math.min(((this.#at.x + 1) / 2) * width + 12, width - 8 - tag.offsetWidth);
      let y = ((1 - this.#at.y) / 2) * height - 10;
      // Labels do not cover one another.
      while (taken.some(([left, top]) => Math.abs(left - x) < 220 && Math.abs(top - y) < 24)) y += 24;
      taken.push([x, y]);
      tag.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    }
  }
}
