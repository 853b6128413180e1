// Cameras: pinhole, axes x right, y down, z forward, as the format has them.

/** @import { Camera, Info } from "../decode/tensors.js" */
/** @import { Scene } from "../kinds/index.js" */

/** @typedef {[number, number, number]} Vector */

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b @returns {Vector} */
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** a + f · b. @param {ArrayLike<number>} a @param {ArrayLike<number>} b @param {number} f @returns {Vector} */
export const plus = (a, b, f = 1) => [a[0] + f * b[0], a[1] + f * b[1], a[2] + f * b[2]];

/** Of length 1; `otherwise` if it has no direction. @param {ArrayLike<number>} a @param {Vector} otherwise
 * @returns {Vector} */
export function unit(a, otherwise = [0, 0, 1]) {
  const n = Math.hypot(a[0], a[1], a[2]);
  return n > 1e-9 && n < Infinity ? [a[0] / n, a[1] / n, a[2] / n] : otherwise;
}

/** `v` turned about `axis`, of length 1. @param {Vector} v @param {Vector} axis @param {number} angle radians
 * @returns {Vector} */
export function turn(v, axis, angle) {
  const c = Math.cos(angle);
  return plus(plus([c * v[0], c * v[1], c * v[2]], cross(axis, v), Math.sin(angle)), axis, dot(axis, v) * (1 - c));
}

/** The centre of a camera. @param {Camera} camera @returns {Vector} */
export function centreOf({ viewmat: v }) {
  const [a, b, c] = [0, 1, 2].map((k) => -(v[k] * v[3] + v[4 + k] * v[7] + v[8 + k] * v[11]));
  return [a, b, c];
}

/** Where a camera looks. @param {Camera} camera @returns {Vector} */
export const forwardOf = ({ viewmat: v }) => [v[8], v[9], v[10]];

/** Downwards in a camera's picture. @param {Camera} camera @returns {Vector} */
export const downOf = ({ viewmat: v }) => [v[4], v[5], v[6]];

/**
 * A camera at `eye` that looks along `forward`.
 *
 * @param {Vector} eye @param {Vector} forward of length 1 @param {Vector} down roughly
 * @param {Pick<Camera, "K" | "width" | "height">} like
 * @returns {Camera}
 */
export function lookAlong(eye, forward, down, { K, width, height }) {
  const right = unit(cross(down, forward), unit(cross([forward[1], forward[2], forward[0]], forward)));
  const y = cross(forward, right);
  const rows = [right, y, forward].flatMap((axis) => [...axis, -dot(axis, eye)]);
  return { viewmat: new Float32Array([...rows, 0, 0, 0, 1]), K, width, height };
}

/** Where a camera shows a point, in pixels, and its depth. @param {Camera} camera @param {ArrayLike<number>} points
 * @param {number} i of the point's x @returns {Vector} */
export function project({ viewmat: v, K }, points, i) {
  const [x, y, z] = [0, 4, 8].map(
    (r) => v[r] * points[i] + v[r + 1] * points[i + 1] + v[r + 2] * points[i + 2] + v[r + 3],
  );
  return [(K[0] * x) / z + K[2], (K[4] * y) / z + K[5], z];
}

/** Strips along the left, right and upper side of a picture, as shares of it, and how densely anchors lie there at least
 * where a scene goes on beyond it, relative to all of the picture. */
const STRIP = 0.1;
const DENSITY = 0.25;

/**
 * Whether a scene goes on beyond its camera's picture, as a place does; a thing ends within it, and was seen from all
 * around more likely. The ground below says nothing.
 *
 * @param {Scene} scene @param {Camera} camera @returns {boolean}
 */
export function goesOn({ anchor, mask, info: { near } }, camera) {
  const codes = mask[mask.length - 1];
  const strips = [0, 0, 0];
  let inside = 0;
  for (let i = 0; i < codes.length; i++) {
    if (!codes[i]) continue;
    const [x, y, z] = project(camera, anchor, 3 * i);
    const [px, py] = [x / camera.width, y / camera.height];
    if (!(z > near && px >= 0 && px <= 1 && py >= 0 && py <= 1)) continue;
    inside++;
    [px, 1 - px, py].forEach((share, k) => (strips[k] += Number(share < STRIP)));
  }
  return Math.max(...strips) > DENSITY * STRIP * inside;
}

/** The middle of a scene's box. @param {Info} info @returns {Vector} */
export const middleOf = ({ box: [low, high] }) => plus(plus([0, 0, 0], low, 0.5), high, 0.5);

/**
 * The camera that shows a scene first: its own, or one that looks at the box's middle from outside.
 *
 * @param {Info} info @returns {Camera}
 */
export function defaultCamera(info) {
  const { camera, box: [low, high], up } = info;
  if (camera) return camera;
  const size = Math.hypot(...plus(high, low, -1)) || 1;
  const worldUp = unit(up, [0, 1, 0]);
  const side = unit(cross(worldUp, [worldUp[1], worldUp[2], worldUp[0]]), [1, 0, 0]);
  const forward = unit(plus(side, worldUp, -0.3));
  const K = new Float32Array([600, 0, 320, 0, 600, 240, 0, 0, 1]);
  const eye = plus(middleOf(info), forward, -1.2 * size);
  return lookAlong(eye, forward, plus([0, 0, 0], worldUp, -1), { K, width: 640, height: 480 });
}

/** What a window shows of a camera's picture: all, or as much as fills it. @typedef {"contain" | "cover"} Fit */

/**
 * How much larger than a camera's picture a window shows it.
 *
 * @param {Pick<Camera, "width" | "height">} camera @param {number} width @param {number} height of the window, pixels
 * @param {Fit} [fit]
 */
export function magnification(camera, width, height, fit = "contain") {
  return Math[fit === "cover" ? "max" : "min"](width / camera.width, height / camera.height);
}

/**
 * The camera for a picture of another size, its own in the middle.
 *
 * @param {Camera} camera @param {number} width @param {number} height pixels @param {Fit} [fit]
 * @returns {Camera}
 */
export function fitted(camera, width, height, fit) {
  if (camera.width === width && camera.height === height) return camera;
  const { viewmat, K } = camera;
  const scale = magnification(camera, width, height, fit);
  return {
    viewmat,
    K: new Float32Array([
      ...[K[0] * scale, 0, width / 2 + scale * (K[2] - camera.width / 2)],
      ...[0, K[4] * scale, height / 2 + scale * (K[5] - camera.height / 2)],
      ...[0, 0, 1],
    ]),
    width,
    height,
  };
}
