// Surfaces of objects, from the rig folder's own glTF files.
import { Group } from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { surface } from "./surfaces.js";

export class Models {
  #color;
  #meshes = {};
  #loaded = new Map();
  #loader = new GLTFLoader();

  /** `color` is that of what has none in its file. */
  constructor(color) {
    this.#color = color;
    /** What could not be loaded, and why. */
    this.problems = new Map();
  }

  /** Take what the rig has: name → {middle, scale, size}. */
  tell(meshes) {
    if (JSON.stringify(meshes) === JSON.stringify(this.#meshes)) return;
    this.#meshes = meshes;
    this.#loaded.clear();
    this.problems.clear();
  }

  /** The surface of an object in its own frame; null until it is here. */
  of(name, shape) {
    const mesh = this.#meshes[name];
    // A recording may be of another rig: what it says counts.
    if (!mesh || String(mesh.size) !== String(shape.size)) return null;
    if (!this.#loaded.has(name)) this.#load(name, mesh);
    return this.#loaded.get(name);
  }

  async #load(name, { middle, scale }) {
    const loaded = this.#loaded;
    loaded.set(name, null);
    try {
      const { scene } = await this.#loader.loadAsync(`mesh.${encodeURIComponent(name)}.glb`);
      scene.scale.multiplyScalar(scale);
      scene.position.set(...middle).multiplyScalar(-scale);
      const model = new Group();
      model.add(scene);
      scene.traverse((part) => {
        if (part.isMesh) this.#dress(part);
      });
      loaded.set(name, model);
    } catch (error) {
      this.problems.set(name, String(error.message ?? error));
    }
  }

  /** Give a part a surface that this scene's light suits: nothing here mirrors, so metal would be black. */
  #dress(part) {
    const { color, map, vertexColors, side, transparent, opacity } = [part.material].flat()[0];
    const plain = !map && !vertexColors && color?.getHex() === 0xffffff;
    part.material = surface({
      color: plain ? this.#color : (color ?? this.#color), map: map ?? null, vertexColors, side, transparent, opacity, roughness: 0.5,
    });
    part.userData.own = part.material.color.clone();
    part.castShadow = part.receiveShadow = true;
  }
}

/** Show a model in one colour, or null = in its own ones, and lit or not. */
export function tint(model, color, emissive) {
  model.traverse((part) => {
    if (!part.isMesh) return;
    if (color === null) part.material.color.copy(part.userData.own);
    else part.material.color.set(color);
    part.material.emissive.set(emissive);
  });
}
