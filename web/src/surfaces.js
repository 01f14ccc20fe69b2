// Of what things are drawn: what a graphics card does well, or what a processor still does in time.
import { Color, MeshBasicMaterial, MeshLambertMaterial, MeshStandardMaterial } from "three";

let plain = false;

/** From now on draw for the processor: shading a pixel costs half of it there. */
export function drawPlainly() {
  plain = true;
}

export function surface({ roughness = 1, ...rest }) {
  return plain ? new MeshLambertMaterial(rest) : new MeshStandardMaterial({ roughness, metalness: 0, ...rest });
}

/** Whether things are drawn for the processor. */
export const isPlain = () => plain;

/** Of what lies flat and fills much of the picture: a processor draws it as bright as light from above makes it, without
 * asking the lights at each pixel, which costs a third of a picture. */
export function levelSurface({ roughness, color = 0xffffff, ...rest }, lights) {
  if (!plain) return surface({ roughness, color, ...rest });
  const light = new Color(0);
  for (const { color: tint, intensity, position } of lights) {
    const upwards = position.y / position.length();
    light.add(tint.clone().multiplyScalar((intensity * Math.max(0, upwards)) / Math.PI));
  }
  return new MeshBasicMaterial({ color: new Color(color).multiply(light), ...rest });
}
