// Of what things are drawn: what a graphics card does well, or what a processor still does in time.
import { MeshLambertMaterial, MeshStandardMaterial } from "three";

let plain = false;

/** From now on draw for the processor: shading a pixel costs half of it there. */
export function drawPlainly() {
  plain = true;
}

export function surface({ roughness = 1, ...rest }) {
  return plain ? new MeshLambertMaterial(rest) : new MeshStandardMaterial({ roughness, metalness: 0, ...rest });
}
