// Clauses 13.2 and 13.3: a plane's one time slice, in the layout of both evaluators.

/** @typedef {import("../decode/scene.js").Deformation} Deformation */
/** @typedef {import("../decode/scene.js").PlaneName} PlaneName */

/** Planes without time, and their two axes. @type {[PlaneName, number, number][]} */
export const SPATIAL = [
  ["xy", 0, 1],
  ["xz", 0, 2],
  ["yz", 1, 2],
];

/** Planes with time, and their other axis. @type {[PlaneName, number][]} */
export const TEMPORAL = [
  ["xt", 0],
  ["yt", 1],
  ["zt", 2],
];

/** Heads whose outputs are lengths in units of a quarter of the box. */
export const LENGTH_HEADS = ["position", "mean", "scale"];

/**
 * What remains of a plane with time at time t.
 *
 * @param {import("../decode/scene.js").Plane} plane @param {number} t 0..1
 * @param {(channel: number, cell: number, value: number) => void} put takes each sample
 */
export function sliceAt({ data, channels, height, width }, t, put) {
  const at = t * (height - 1);
  const low = Math.floor(at);
  const high = Math.min(low + 1, height - 1);
  const f = at - low;
  for (let c = 0; c < channels; c++) {
    const start = c * height * width;
    for (let i = 0; i < width; i++) {
      const a = data[start + low * width + i];
      put(c, i, a + f * (data[start + high * width + i] - a));
    }
  }
}
