// A VMC receiver of @pixiv/three-vrm's humanoid and an OSC parser of npm's.
// argv: a JSON file with the avatar: {bone: {parent, position, rest}} in three.js's world axes (VRM 1: +z forward, +x left).
// It prints the port that it listens on, then for each frame one JSON line: where every bone and fingertip is.
import { readFileSync } from "node:fs";
import { createSocket } from "node:dgram";
import * as osc from "osc-min";
import { Object3D, Quaternion, Vector3 } from "three";
import { VRMHumanoid } from "@pixiv/three-vrm";

const avatar = JSON.parse(readFileSync(process.argv[2], "utf8"));
const scene = new Object3D();
const nodes = {};
for (const [name, bone] of Object.entries(avatar)) {
  const node = (nodes[name] = new Object3D());
  const parent = bone.parent ? avatar[bone.parent] : { position: [0, 0, 0], rest: [0, 0, 0, 1] };
  const back = new Quaternion(...parent.rest).invert();
  node.position.fromArray(bone.position).sub(new Vector3(...parent.position)).applyQuaternion(back);
  node.quaternion.copy(back).multiply(new Quaternion(...bone.rest));
  (bone.parent ? nodes[bone.parent] : scene).add(node);
}
scene.updateWorldMatrix(true, true);
const humanBones = {};
for (const name of Object.keys(avatar)) if (!name.endsWith("Tip")) humanBones[name] = { node: nodes[name] };
const humanoid = new VRMHumanoid(humanBones);
scene.add(humanoid.normalizedHumanBonesRoot);

// VMC names the thumb's bones as VRM 0 did.
const THUMB = { Proximal: "Metacarpal", Intermediate: "Proximal", Distal: "Distal" };
const boneOf = (name) =>
  name[0].toLowerCase() + name.slice(1).replace(/Thumb(\w+)$/, (_, segment) => "Thumb" + THUMB[segment]);

function show() {
  humanoid.update();
  scene.updateWorldMatrix(true, true);
  const seen = {};
  for (const name of Object.keys(avatar)) {
    const turned = humanoid.getNormalizedBoneNode(name)?.getWorldQuaternion(new Quaternion()).toArray() ?? null;
    seen[name] = { position: nodes[name].getWorldPosition(new Vector3()).toArray(), rotation: turned };
  }
  console.log(JSON.stringify(seen));
}

const socket = createSocket("udp4");
socket.on("message", (packet) => {
  for (const { address, args } of osc.fromBuffer(packet).elements) {
    const values = args.map((arg) => arg.value);
    if (address === "/VMC/Ext/Bone/Pos") {
      const [name, , , , x, y, z, w] = values;
      // Unity's axes to those of VRM 1 in three.js: x is mirrored.
      humanoid.getNormalizedBoneNode(boneOf(name))?.quaternion.set(x, -y, -z, w);
    } else if (address === "/test/show") show();
    else if (address === "/test/end") socket.close();
  }
});
socket.bind(0, "127.0.0.1", () => console.log(socket.address().port));
