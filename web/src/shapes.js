// Signed distance to the shapes of `ObjectPose.shape`: negative inside, metres.
import { apply, clamp, dot, invert, rotate, scale, sub, unit } from "./math.js";

export const UNKNOWN = { kind: "box", size: [0.06, 0.06, 0.06] };
const STEP = 1e-4;

function local(shape, [x, y, z]) {
  if (shape.kind === "sphere") return Math.hypot(x, y, z) - shape.radius;
  if (shape.kind === "mesh") return hull(shape.planes, x, y, z);
  let outside, inside;
  if (shape.kind === "cylinder") {
    // Its axis is z.
    const across = Math.hypot(x, y) - shape.radius;
    const along = Math.abs(z) - shape.height / 2;
    outside = Math.hypot(Math.max(across, 0), Math.max(along, 0));
    inside = Math.min(Math.max(across, along), 0);
  } else {
    const d = [Math.abs(x) - shape.size[0] / 2, Math.abs(y) - shape.size[1] / 2, Math.abs(z) - shape.size[2] / 2];
    outside = Math.hypot(Math.max(d[0], 0), Math.max(d[1], 0), Math.max(d[2], 0));
    inside = Math.min(Math.max(d[0], d[1], d[2]), 0);
  }
  return outside + inside;
}

/** Where a thing is further away than this, its edges do not matter, metres. */
const EDGES_M = 0.05;

/** Distance to the planes [x, y, z, d] around a mesh; beyond a corner that to the nearest edge's line. */
function hull(planes, x, y, z) {
  let most = -Infinity;
  let first = null;
  for (const plane of planes) {
    const beyond = plane[0] * x + plane[1] * y + plane[2] * z - plane[3];
    if (beyond > most) {
      most = beyond;
      first = plane;
    }
  }
  if (most <= 0 || most > EDGES_M) return most;
  let squared = most * most;
  for (const plane of planes) {
    const cosine = plane[0] * first[0] + plane[1] * first[1] + plane[2] * first[2];
    const beside = plane[0] * x + plane[1] * y + plane[2] * z - plane[3] - cosine * most;
    const sine2 = 1 - cosine * cosine;
    if (beside > 0 && sine2 > 1e-6) squared = Math.max(squared, most * most + (beside * beside) / sine2);
  }
  return Math.sqrt(squared);
}

/** A body: a shape at a pose. */
export class Body {
  constructor(shape, at) {
    this.shape = shape;
    this.at = at;
    this.back = invert(at);
  }

  distance(point) {
    return local(this.shape, apply(this.back, point));
  }

  /** Direction out of the body at a point, unit. */
  normal(point) {
    const x = apply(this.back, point);
    const d = (axis) => {
      const a = [...x];
      const b = [...x];
      a[axis] += STEP;
      b[axis] -= STEP;
      return local(this.shape, a) - local(this.shape, b);
    };
    return rotate(this.at.q, unit([d(0), d(1), d(2)]));
  }

  /** Radius of a ball around the middle that holds all of it. */
  get reach() {
    const { shape } = this;
    if (shape.kind === "sphere") return shape.radius;
    if (shape.kind === "cylinder") return Math.hypot(shape.radius, shape.height / 2);
    return Math.hypot(...shape.size) / 2;
  }
}

/** The point of a segment that is nearest to another point, as share 0…1 of the way. */
export function nearestShare(point, from, to) {
  const along = sub(to, from);
  const square = dot(along, along);
  return square > 0 ? clamp(dot(sub(point, from), along) / square, 0, 1) : 0;
}

/** How high a shape stands when it lies on a level face: half its height, given its pose in a frame with y up. */
export function halfHeight(shape, q) {
  if (shape.kind === "sphere") return shape.radius;
  const up = rotate([-q[0], -q[1], -q[2], q[3]], [0, 1, 0]);
  if (shape.kind === "cylinder") {
    const z = Math.abs(up[2]);
    return (shape.height / 2) * z + shape.radius * Math.sqrt(Math.max(0, 1 - z * z));
  }
  const half = scale(shape.size, 0.5);
  return Math.abs(up[0]) * half[0] + Math.abs(up[1]) * half[1] + Math.abs(up[2]) * half[2];
}
