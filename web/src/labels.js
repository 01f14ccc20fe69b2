// Labels beside what they explain: as HTML over the picture, and as signs in the scene for a headset, which shows no HTML.
import { CanvasTexture, Group, SRGBColorSpace, Sprite, SpriteMaterial, Vector3 } from "three";

/** Pixels of the page's edge below which its own controls lie. */
const FOOT = 60;
/** Of a sign: metres high, as read at half a metre; above its point by so much; pixels of its letters. */
const SIGN = { height: 0.016, above: 0.03, font: 32 };

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
      const low = ((1 - this.#at.y) / 2) * height > height - FOOT;
      tag.hidden = low || this.#at.z > 1 || Math.abs(this.#at.x) > 1 || Math.abs(this.#at.y) > 1;
      if (tag.hidden) continue;
      if (tag.textContent !== text) tag.textContent = text;
      const x = Math.max(8, Math.min(((this.#at.x + 1) / 2) * width + 12, width - 8 - tag.offsetWidth));
      let y = ((1 - this.#at.y) / 2) * height - 10;
      // Labels do not cover one another.
      while (taken.some(([left, top]) => Math.abs(left - x) < 220 && Math.abs(top - y) < 24)) y += 24;
      taken.push([x, y]);
      tag.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    }
  }
}

/** The same labels in space: each turns to whoever looks. */
export class Signs extends Group {
  #signs = new Map();

  /** Show exactly these: name → [text, point in this group's frame]; nothing while `shown` is false. */
  set(labels, shown) {
    for (const [name, sign] of this.#signs) sign.visible = shown && labels.has(name);
    if (!shown) return;
    for (const [name, [text, [x, y, z]]] of labels) {
      let sign = this.#signs.get(name);
      if (!sign) {
        sign = new Sprite(new SpriteMaterial({ transparent: true, depthTest: false, fog: false }));
        sign.renderOrder = 1;
        this.#signs.set(name, sign);
        this.add(sign);
      }
      if (sign.userData.text !== text) this.#write(sign, text);
      sign.visible = true;
      sign.position.set(x, y + SIGN.above, z);
    }
  }

  /** The texts that are shown, in order. */
  get texts() {
    return [...this.#signs.values()].filter((sign) => sign.visible).map((sign) => sign.userData.text);
  }

  #write(sign, text) {
    const canvas = document.createElement("canvas");
    const draw = canvas.getContext("2d");
    const font = `${SIGN.font}px system-ui, sans-serif`;
    draw.font = font;
    canvas.width = Math.ceil(draw.measureText(text).width) + SIGN.font;
    canvas.height = Math.ceil(1.5 * SIGN.font);
    draw.font = font;
    draw.fillStyle = "#0d1216d0";
    draw.fillRect(0, 0, canvas.width, canvas.height);
    draw.fillStyle = "#e9edf0";
    draw.textBaseline = "middle";
    draw.fillText(text, SIGN.font / 2, canvas.height / 2);
    sign.material.map?.dispose();
    sign.material.map = new CanvasTexture(canvas);
    sign.material.map.colorSpace = SRGBColorSpace;
    sign.material.needsUpdate = true;
    sign.scale.set((SIGN.height * canvas.width) / canvas.height, SIGN.height, 1);
    sign.userData.text = text;
  }
}
