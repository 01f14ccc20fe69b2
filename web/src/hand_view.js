// A hand in the scene: the skin that was made of its model, moved by 26 joints; predicted fingers are blue.
import { Bone, BufferAttribute, BufferGeometry, Color, CylinderGeometry, Group, Matrix4, Mesh, Quaternion, SRGBColorSpace, Skeleton, SkinnedMesh, Vector3 } from "three";
import { makeSkin } from "./hand_skin.js";
import { FINGERS, WRIST } from "./skeleton.js";
import { surface } from "./surfaces.js";

const SKIN = { right: new Color(0xdca988), left: new Color(0xcfa49a) };
const PREDICTED = new Color(0x4f93e0);
/** A sleeve over the stub of the forearm, metres in the wrist's frame: half width, half height, length. */
const SLEEVE = { across: 0.036, up: 0.028, from: 0.018, length: 0.09 };
const ONE = new Vector3(1, 1, 1);

export class HandView extends Group {
  #skin;
  #mesh;
  #sleeve;
  #side;
  #paint;
  #shown = "";

  constructor(side, model, paint) {
    super();
    this.#side = side;
    this.#paint = paint;
    const skin = (this.#skin = makeSkin(model.joints, model.radii));
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(skin.positions, 3));
    geometry.setAttribute("normal", new BufferAttribute(skin.normals, 3));
    geometry.setAttribute("skinIndex", new BufferAttribute(skin.bones, 4));
    geometry.setAttribute("skinWeight", new BufferAttribute(skin.weights, 4));
    geometry.setAttribute("color", new BufferAttribute(new Float32Array(skin.positions.length), 3));
    geometry.setIndex(new BufferAttribute(skin.triangles, 1));
    const material = surface({ vertexColors: true, roughness: 0.62 });
    this.#mesh = new SkinnedMesh(geometry, material);
    this.#mesh.frustumCulled = false;
    this.#mesh.castShadow = true;
    this.bones = skin.poses.map(() => new Bone());
    const back = skin.poses.map(({ p, q }) =>
      new Matrix4().compose(new Vector3(...p), new Quaternion(...q), ONE).invert(),
    );
    this.add(this.#mesh, ...this.bones);
    this.#sleeve = new Mesh(
      new CylinderGeometry(1, 0.93, 1, 28, 1).rotateX(Math.PI / 2).translate(0, 0, 0.5),
      surface({ color: 0x2f4a66, roughness: 0.95 }),
    );
    const scale = model.radii[WRIST] / 0.022;
    this.#sleeve.scale.set(scale * SLEEVE.across, scale * SLEEVE.up, SLEEVE.length);
    this.#sleeve.position.z = SLEEVE.from;
    this.#sleeve.castShadow = true;
    this.bones[WRIST].add(this.#sleeve);
    this.#mesh.bind(new Skeleton(this.bones, back), new Matrix4());
  }

  /** Show joints (26 poses in the parent's frame); `predicted` names fingers. */
  show(poses, predicted, state) {
    poses.forEach(({ p, q }, row) => {
      this.bones[row].position.set(...p);
      this.bones[row].quaternion.set(...q);
    });
    const key = state + predicted.join();
    if (key === this.#shown) return;
    this.#shown = key;
    this.#color(predicted, state);
  }

  /** Show it in one colour, to be seen through. */
  ghost(color) {
    this.#mesh.material.setValues({ vertexColors: false, color, transparent: true, opacity: 0.45, depthWrite: false });
    this.#mesh.castShadow = this.#sleeve.visible = false;
  }

  #color(predicted, state) {
    const { fingers, paint, positions } = this.#skin;
    const colors = this.#mesh.geometry.getAttribute("color");
    const base = SKIN[this.#side];
    const guessed = FINGERS.map((finger) => predicted.includes(finger) || state === "predicted");
    const painted = FINGERS.map((finger) =>
      finger in this.#paint ? new Color().setRGB(...this.#paint[finger].map((c) => c / 255), SRGBColorSpace) : null,
    );
    const color = new Color();
    for (let vertex = 0; vertex < positions.length / 3; vertex++) {
      color.copy(base);
      let palm = 1;
      FINGERS.forEach((_, finger) => {
        const share = fingers[FINGERS.length * vertex + finger];
        palm -= share;
        if (share < 0.02) return;
        if (guessed[finger]) color.lerp(PREDICTED, share);
        if (paint[vertex] && share > 0.5 && painted[finger]) color.lerp(painted[finger], guessed[finger] ? 0.35 : 0.85);
      });
      if (state === "predicted") color.lerp(PREDICTED, Math.max(0, palm));
      colors.setXYZ(vertex, color.r, color.g, color.b);
    }
    colors.needsUpdate = true;
  }

  dispose() {
    this.#mesh.geometry.dispose();
    this.#mesh.material.dispose();
    this.#mesh.skeleton.dispose();
    this.#sleeve.geometry.dispose();
    this.#sleeve.material.dispose();
  }
}
