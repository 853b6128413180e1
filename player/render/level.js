// The parts of a scene that a level shows (clauses 13.4 and 13.6), in the forms that both evaluators take.

import { columnsOf, quantitiesOf } from "./record.js";
/** @import { AnchorScene, Deformation, Scale, Scene } from "../kinds/index.js" */

/**
 * One level of a scene: the highest layer that is there and at most the requested one. It has the first `rows` anchors.
 * codes: their gates times 255. fill: the colour behind the Gaussians. spread: the factor on their scales. motion: what
 * moves it, null if nothing does.
 *
 * @template {Scene} S
 * @typedef {{number: number, rows: number, codes: Uint8Array, fill: number[], spread: number,
 *   motion: S["motion"][number]}} Level
 */

/** Columns of a Gaussian's record: mean and opacity; scale, 0; quaternion w x y z; colour, 0. In scene units. */
export const GAUSSIAN_COLUMNS = 16;

/**
 * Gaussians as texels, [4, height, width, 4], of which the first `count` are filled: columns 4·b to 4·b + 3 of a record
 * in block b. changing: the blocks in which those of equal `still` differ; 0 equals none.
 *
 * @typedef {{count: number, data: Float32Array, width: number, height: number, still: number, changing: number[]}} Texels
 */

/** Room for Gaussians. @param {number} most @param {Texels | null} spare others, whose room is taken if it fits
 * @returns {Texels} */
export function texelsFor(most, spare) {
  const width = 2 ** Math.max(4, Math.ceil(Math.log2(Math.sqrt(most + 1))));
  const height = Math.max(1, Math.ceil(most / width));
  const length = GAUSSIAN_COLUMNS * width * height;
  const own = { count: 0, width, height, changing: [0, 1, 2, 3] };
  if (spare?.data.length === length) return { ...own, data: spare.data, still: spare.still };
  return { ...own, data: new Float32Array(length), still: 0 };
}

/** Lower opacities never reach a pixel: a picture has 255 steps. */
export const MIN_OPACITY = 1 / 255;

/** @template {Scene} S @param {S} scene @param {number} level 0, 1 or 2 @returns {Level<S>} */
export function levelOf(scene, level) {
  const i = scene.layers.filter((layer) => layer <= level).length - 1;
  const { layers, rows, mask, fill, spread, motion } = scene;
  const own = { fill: fill[i], spread: spread[i], motion: motion[i] };
  return { number: layers[i], rows: rows[i], codes: mask[i], ...own };
}

/** The unit of the head position: a quarter of the longest side of the box, scene units. @param {Scene} scene */
export function deformationUnit({ info: { box } }) {
  return 0.25 * Math.max(...[0, 1, 2].map((k) => box[1][k] - box[0][k]));
}

/** The heads that a deformation has, with the columns of an anchor's record that they add to, and the unit of their
 * outputs. @param {Deformation} deformation @param {AnchorScene} scene */
export function headsIn({ heads }, scene) {
  const unit = deformationUnit(scene);
  return quantitiesOf(scene.widths).flatMap((quantity, i) => {
    const network = heads[i];
    return network ? [{ network, columns: columnsOf(quantity), unit: quantity.length ? unit : 1 }] : [];
  });
}

/**
 * Calls `put` for each attribute of the anchors.
 *
 * @param {AnchorScene} scene @param {(values: Float32Array, width: number, columns: number[]) => void} put values:
 * [anchors, width]. columns: those of an anchor's record that take them
 */
export function eachAttribute(scene, put) {
  for (const quantity of quantitiesOf(scene.widths)) put(scene[quantity.values], quantity.outputs, columnsOf(quantity));
}

/** Planes without time, and their two axes. */
export const SPATIAL = /** @type {const} */ ([
  ["xy", 0, 1],
  ["xz", 0, 2],
  ["yz", 1, 2],
]);

/** Cells of a scale along x, y and z. @param {Scale} scale */
export const cellsOf = ({ xy, xz }) => [xy.width, xy.height, xz.height];

/**
 * What a scale's spatial planes are multiplied by at time t: a row of cells along each axis.
 *
 * @param {Scale} scale @param {number} axis of the row, 0..2 @param {number} t 0..1
 * @param {(channel: number, cell: number, value: number) => void} put takes each sample
 */
export function sliceAt(scale, axis, t, put) {
  const { data, channels, height, width } = [scale.xt, scale.yt, scale.zt][axis];
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

/**
 * The state on which Gaussians depend. t: normalised time. eye: the camera's centre, scene units.
 *
 * @typedef {{scene: Scene, level: number, t: number, eye: number[]}} State
 */

/** A camera's centre that moves by less, in units of a quarter of the box, changes nothing that is seen. */
const EYE_TOLERANCE = 1e-5;

/**
 * @param {Scene} scene @param {number} level the highest to show @param {number} seconds of the scene's time
 * @param {number[]} eye the camera's centre, scene units
 * @returns {State} with a time only where something moves, and a centre only where colours or shapes depend on it
 */
export function stateOf(scene, level, seconds, eye) {
  const { number, motion } = levelOf(scene, level);
  const [start, end] = scene.info.timeRange;
  const t = (seconds - start) / (end - start); // clause 13.4; no number where the range is empty
  return { scene, level: number, t: motion && t > 0 ? Math.min(t, 1) : 0, eye: scene.sees ? eye : [0, 0, 0] };
}

/** @param {State} a @param {State} b */
export function sameState(a, b) {
  const tolerance = EYE_TOLERANCE * deformationUnit(a.scene);
  const eyes = () => [0, 1, 2].every((k) => Math.abs(a.eye[k] - b.eye[k]) <= tolerance);
  return a.scene === b.scene && a.level === b.level && a.t === b.t && eyes();
}
