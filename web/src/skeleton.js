// The hand's joints in OpenXR's order (XR_EXT_hand_tracking), as `rhot.anatomy.skeleton` has them.

export const FINGERS = ["thumb", "index", "middle", "ring", "little"];
const SEGMENTS = ["metacarpal", "proximal", "intermediate", "distal", "tip"];

export const CHAINS = Object.fromEntries(
  FINGERS.map((finger) => [
    finger,
    SEGMENTS.filter((segment) => finger !== "thumb" || segment !== "intermediate").map((s) => `${finger}_${s}`),
  ]),
);
export const JOINTS = ["palm", "wrist", ...FINGERS.flatMap((finger) => CHAINS[finger])];
export const ROW = Object.fromEntries(JOINTS.map((name, row) => [name, row]));
export const PALM = ROW.palm;
export const WRIST = ROW.wrist;

/** Rows of each finger's joints from the palm outwards. */
export const ROWS = FINGERS.map((finger) => CHAINS[finger].map((name) => ROW[name]));
/** Rows of the joints that bend, from the knuckle to the tip. */
export const BENDING = ROWS.map((rows, finger) => (finger === 0 ? rows : rows.slice(1)));

/** Bones as [from, to, finger]; finger −1 is the palm. A bone moves with its nearer joint. */
export const BONES = ROWS.flatMap((rows, finger) =>
  rows.slice(1).map((to, i) => [rows[i], to, i === 0 && finger > 0 ? -1 : finger]),
);
