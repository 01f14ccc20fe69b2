// Vectors [x, y, z], quaternions [x, y, z, w], rigid poses {p, q}. Metres.

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
export const mix = (a, b, s) => [a[0] + (b[0] - a[0]) * s, a[1] + (b[1] - a[1]) * s, a[2] + (b[2] - a[2]) * s];
export const unit = (a) => {
  const l = length(a);
  return l > 1e-12 ? scale(a, 1 / l) : [0, 1, 0];
};
export const clamp = (x, low, high) => Math.min(high, Math.max(low, x));

/** Hamilton product: R(a·b) = R(a)·R(b). */
export const qmul = (a, b) => [
  a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
  a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
  a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
  a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
];
export const qconj = (q) => [-q[0], -q[1], -q[2], q[3]];
export const qunit = (q) => {
  const l = Math.hypot(q[0], q[1], q[2], q[3]);
  return [q[0] / l, q[1] / l, q[2] / l, q[3] / l];
};
export const rotate = (q, v) => {
  const u = [q[0], q[1], q[2]];
  const t = scale(cross(u, v), 2);
  return add(add(v, scale(t, q[3])), cross(u, t));
};
export const fromAxis = (axis, angle) => {
  const s = Math.sin(angle / 2);
  return [axis[0] * s, axis[1] * s, axis[2] * s, Math.cos(angle / 2)];
};
/** Rotation vector (axis times angle, radians) along the shorter way. */
export const toVector = (q) => {
  const sign = q[3] < 0 ? -1 : 1;
  const v = [q[0] * sign, q[1] * sign, q[2] * sign];
  const s = length(v);
  return s < 1e-9 ? scale(v, 2) : scale(v, (2 * Math.atan2(s, q[3] * sign)) / s);
};
export const fromVector = (v) => {
  const angle = length(v);
  return angle < 1e-9 ? qunit([v[0] / 2, v[1] / 2, v[2] / 2, 1]) : fromAxis(scale(v, 1 / angle), angle);
};

export const IDENTITY = { p: [0, 0, 0], q: [0, 0, 0, 1] };
/** T_a_c = T_a_b · T_b_c. */
export const compose = (a, b) => ({ p: add(a.p, rotate(a.q, b.p)), q: qmul(a.q, b.q) });
export const invert = (a) => {
  const q = qconj(a.q);
  return { p: scale(rotate(q, a.p), -1), q };
};
/** X_a = T_a_b · X_b. */
export const apply = (a, v) => add(a.p, rotate(a.q, v));
export const pose = (seven, at = 0) => ({
  p: [seven[at], seven[at + 1], seven[at + 2]],
  q: [seven[at + 3], seven[at + 4], seven[at + 5], seven[at + 6]],
});

/** Pose of a 4x4 matrix, row by row. */
export const poseOfMatrix = (m) => {
  const [r00, r01, r02, , r10, r11, r12, , r20, r21, r22] = m;
  const p = [m[3], m[7], m[11]];
  const trace = r00 + r11 + r22;
  let q;
  if (trace > 0) {
    const s = 2 * Math.sqrt(trace + 1);
    q = [(r21 - r12) / s, (r02 - r20) / s, (r10 - r01) / s, s / 4];
  } else if (r00 > r11 && r00 > r22) {
    const s = 2 * Math.sqrt(1 + r00 - r11 - r22);
    q = [s / 4, (r01 + r10) / s, (r02 + r20) / s, (r21 - r12) / s];
  } else if (r11 > r22) {
    const s = 2 * Math.sqrt(1 + r11 - r00 - r22);
    q = [(r01 + r10) / s, s / 4, (r12 + r21) / s, (r02 - r20) / s];
  } else {
    const s = 2 * Math.sqrt(1 + r22 - r00 - r11);
    q = [(r02 + r20) / s, (r12 + r21) / s, s / 4, (r10 - r01) / s];
  }
  return { p, q: qunit(q) };
};
