// What is drawn around the hand: light, desk, floor, things by their shape, feet and body. Stage axes: y up, metres.
import {
  BoxGeometry, CanvasTexture, CapsuleGeometry, Color, CylinderGeometry, DirectionalLight, Fog, Group, HemisphereLight,
  Mesh, MeshBasicMaterial, PlaneGeometry, Quaternion, RepeatWrapping, SRGBColorSpace, Scene, SphereGeometry, Vector3,
} from "three";
import { Models, tint } from "./models.js";
import { UNKNOWN } from "./shapes.js";
import { isPlain, levelSurface, surface } from "./surfaces.js";

const BACKGROUND = 0x46525e;
const TWIN = 0xd6a03c;
const PREDICTED = 0x4f93e0;
const VIRTUAL = 0xb06bd6;
const LIT = 0x4a3a10;
const LIMB = 0xb4bac2;
const DESK_SIZE = [1.3, 0.03, 0.75];
const FOOT = { size: [0.09, 0.06, 0.26], middle: [0, -0.04, 0.03] };
const LEG_RADIUS = 0.045;
// Bones of the body: from, to, and the limb whose state colours it. Neck and head are not drawn: the camera is in them.
const BONES = ["left", "right"].flatMap((side) => {
  const named = (joint) => (joint === "hips" || joint === "chest" ? joint : `${side}_${joint}`);
  const bones = (limb, joints) => joints.slice(1).map((to, k) => [named(joints[k]), named(to), limb]);
  return [
    ...bones(side, ["hips", "hip", "knee", "ankle", "foot"]),
    ...bones(`${side}_arm`, ["chest", "shoulder", "elbow", "wrist"]),
  ];
}).concat([["hips", "spine_lower", ""], ["spine_lower", "chest", ""]]);
const UP = new Vector3(0, 1, 0);

function matTexture() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 256;
  const draw = canvas.getContext("2d");
  draw.fillStyle = "#52626f";
  draw.fillRect(0, 0, 256, 256);
  draw.strokeStyle = "#74899a";
  draw.lineWidth = 3;
  draw.strokeRect(0, 0, 256, 256);
  const texture = new CanvasTexture(canvas);
  texture.wrapS = texture.wrapT = RepeatWrapping;
  texture.colorSpace = SRGBColorSpace;
  // Sharper at the far end of the desk, for a tenth of the picture's time on a processor.
  if (!isPlain()) texture.anisotropy = 4;
  return texture;
}

function shadeTexture() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 128;
  const draw = canvas.getContext("2d");
  const fade = draw.createRadialGradient(64, 64, 0, 64, 64, 64);
  fade.addColorStop(0, "#000000ff");
  fade.addColorStop(0.5, "#00000090");
  fade.addColorStop(1, "#00000000");
  draw.fillStyle = fade;
  draw.fillRect(0, 0, 128, 128);
  return new CanvasTexture(canvas);
}

export function geometryOf(shape) {
  if (shape.kind === "sphere") return new SphereGeometry(shape.radius, 40, 24);
  // Its axis is the object's z; three.js has it along y.
  if (shape.kind === "cylinder") return new CylinderGeometry(shape.radius, shape.radius, shape.height, 48).rotateX(Math.PI / 2);
  return new BoxGeometry(...shape.size);
}

/** What a thing's drawing depends on: the planes of a mesh are many, and its file and size tell it. */
const keyOf = (shape) => (shape.kind === "mesh" ? `mesh ${shape.file} ${shape.size}` : JSON.stringify(shape));

export class World {
  #things = new Map();
  #feet = new Map();
  #bones = new Map();
  #shades = new Map();
  #shadeMap = null;

  constructor(shadows) {
    this.scene = new Scene();
    this.models = new Models(TWIN);
    this.background = new Color(BACKGROUND);
    this.scene.background = this.background;
    this.scene.fog = new Fog(BACKGROUND, 2.5, 7);
    /** Everything of the rig, in stage axes; a headset's space moves it as a whole. */
    this.root = new Group();
    this.scene.add(this.root);
    const sky = new HemisphereLight(0xe8f1fa, 0x6b6259, 1.9);
    this.root.add(sky);
    this.sun = new DirectionalLight(0xfff2e0, 2.6);
    this.root.add(this.sun, this.sun.target);
    if (shadows) {
      this.sun.castShadow = true;
      this.sun.shadow.mapSize.set(2048, 2048);
      Object.assign(this.sun.shadow.camera, { left: -0.5, right: 0.5, top: 0.5, bottom: -0.5, near: 0.2, far: 2.5 });
      this.sun.shadow.bias = -0.0004;
      this.sun.shadow.normalBias = 0.004;
    }
    const fill = new DirectionalLight(0x9fc3ff, 0.7);
    fill.position.set(-1, 0.6, 0.8);
    this.root.add(fill);
    this.aimLight([0, 0, 0]);
    const level = (settings) => levelSurface(settings, [sky, this.sun, fill]);
    this.floor = new Mesh(new PlaneGeometry(14, 14).rotateX(-Math.PI / 2), level({ color: 0x4a555f, roughness: 1 }));
    this.floor.receiveShadow = true;
    this.desk = new Mesh(new BoxGeometry(...DESK_SIZE), level({ color: 0x8a7561, roughness: 0.8 }));
    const texture = matTexture();
    texture.repeat.set(18, 10);
    this.mat = new Mesh(new PlaneGeometry(0.9, 0.5).rotateX(-Math.PI / 2), level({ map: texture, roughness: 0.95 }));
    this.mat.receiveShadow = this.desk.receiveShadow = true;
    this.surroundings = new Group();
    this.surroundings.add(this.floor, this.desk, this.mat);
    this.root.add(this.surroundings);
  }

  /** Put the desk so that the middle of its top is there. */
  placeDesk(middle, shown) {
    this.desk.visible = this.mat.visible = shown;
    // Beyond a desk the floor looks like the background, and fills half of the picture.
    this.floor.visible = !(isPlain() && shown);
    // What is in front is drawn first: what it hides then costs nothing.
    [this.mat, this.desk, this.floor].forEach((mesh, place) => (mesh.renderOrder = 1 + place));
    this.desk.position.set(middle[0], middle[1] - DESK_SIZE[1] / 2 - 0.001, middle[2]);
    this.mat.position.set(middle[0], middle[1] + 0.0005, middle[2]);
    this.aimLight(middle);
  }

  aimLight(at) {
    this.sun.target.position.set(...at);
    this.sun.position.set(at[0] - 0.35, at[1] + 1.1, at[2] + 0.35);
  }

  /** Show a thing by its shape; null hides it. */
  thing(name, shape, at, { virtual = false, predicted = false, lit = false } = {}) {
    let mesh = this.#things.get(name);
    if (!at) {
      if (mesh) mesh.visible = false;
      return;
    }
    const model = shape?.kind === "mesh" ? this.models.of(name, shape) : null;
    const key = (model ? "model " : "") + keyOf(shape ?? UNKNOWN);
    if (mesh?.userData.shape !== key) {
      if (mesh) this.#drop(mesh);
      mesh = model ?? new Mesh(geometryOf(shape ?? UNKNOWN), surface({ roughness: 0.5, transparent: !shape && !virtual, opacity: !shape && !virtual ? 0.85 : 1 }));
      mesh.castShadow = mesh.receiveShadow = true;
      mesh.userData.shape = key;
      this.#things.set(name, mesh);
      this.root.add(mesh);
    }
    mesh.visible = true;
    mesh.position.set(...at.p);
    mesh.quaternion.set(...at.q);
    if (model) {
      tint(model, predicted ? PREDICTED : null, lit ? LIT : 0);
      return;
    }
    mesh.material.color.set(virtual ? VIRTUAL : predicted ? PREDICTED : TWIN);
    mesh.material.emissive.set(lit ? LIT : 0);
  }

  /** What is drawn of a thing; null where it is not shown. */
  drawn(name) {
    const mesh = this.#things.get(name);
    return mesh?.visible ? mesh : null;
  }

  #drop(thing) {
    this.root.remove(thing);
    thing.traverse((part) => {
      part.geometry?.dispose();
      part.material?.dispose();
    });
  }

  /** A soft shadow on the desk, straight below: it tells how high a thing is, at the cost of two triangles. */
  shade(name, p, radius, desk) {
    let mesh = this.#shades.get(name);
    if (!p) {
      if (mesh) mesh.visible = false;
      return;
    }
    if (!mesh) {
      this.#shadeMap ??= shadeTexture();
      mesh = new Mesh(new PlaneGeometry(2, 2).rotateX(-Math.PI / 2), new MeshBasicMaterial({ map: this.#shadeMap, transparent: true, depthWrite: false }));
      this.#shades.set(name, mesh);
      this.surroundings.add(mesh);
    }
    const above = Math.max(0, p[1] - desk);
    mesh.visible = above < 0.6;
    mesh.position.set(p[0], desk + 0.001, p[2]);
    mesh.scale.setScalar(radius * (1 + 1.5 * above));
    mesh.material.opacity = 0.6 / (1 + 5 * above);
  }

  foot(side, at, predicted) {
    let mesh = this.#feet.get(side);
    if (!mesh && at) {
      mesh = new Mesh(new BoxGeometry(...FOOT.size).translate(...FOOT.middle), surface({ roughness: 0.7 }));
      mesh.castShadow = true;
      this.#feet.set(side, mesh);
      this.root.add(mesh);
    }
    if (!mesh) return;
    mesh.visible = Boolean(at);
    if (!at) return;
    mesh.position.set(...at.p);
    mesh.quaternion.set(...at.q);
    mesh.material.color.set(predicted ? PREDICTED : 0x5c80ac);
  }

  /** Show the body from joint positions by name; null hides it. `predicted` names legs (by side) and arms. */
  body(joints, predicted) {
    for (const [from, to, limb] of BONES) {
      const key = `${from} ${to}`;
      let mesh = this.#bones.get(key);
      const a = joints?.[from];
      const b = joints?.[to];
      if (!a || !b) {
        if (mesh) mesh.visible = false;
        continue;
      }
      if (!mesh) {
        mesh = new Mesh(new CapsuleGeometry(LEG_RADIUS, 1, 6, 16), surface({ roughness: 0.8 }));
        mesh.castShadow = true;
        this.#bones.set(key, mesh);
        this.root.add(mesh);
      }
      const start = new Vector3(...a);
      const along = new Vector3(...b).sub(start);
      mesh.visible = true;
      mesh.position.copy(start).addScaledVector(along, 0.5);
      mesh.scale.set(1, along.length(), 1);
      mesh.quaternion.copy(new Quaternion().setFromUnitVectors(UP, along.normalize()));
      mesh.material.color.set(predicted.includes(limb) ? PREDICTED : LIMB);
    }
  }
}
