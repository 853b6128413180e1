// The residual heads of both deformations (6.3, 13.3), and the records to which they add: one row a head.

/** @import { Widths } from "./header.js" */

/**
 * A record is an anchor or a Gaussian as floats in blocks of four, the texels of the evaluator on the GPU. A quantity
 * takes its columns in runs, each of which starts a block.
 *
 * outputs: numbers of the quantity. run: of them in a run. at: its first column. length: whether the head's outputs are
 * lengths, in units of a quarter of the box. then: how a sum is brought into its range.
 *
 * @typedef {object} Head
 * @property {string} name
 * @property {number} outputs
 * @property {number} run
 * @property {number} at
 * @property {boolean} [length]
 * @property {"clip" | "positive" | "unit"} [then]
 */

/**
 * Heads of the global deformation by id; the same quantities make up the record of an anchor.
 *
 * @param {Widths} widths
 * @returns {Head[]}
 */
export const globalHeads = ({ feature: D, slots: G }) => [
  { name: "position", outputs: 3, run: 3, at: 0, length: true },
  { name: "feature", outputs: D, run: D, at: 12 },
  { name: "offset", outputs: 3 * G, run: 3, at: 12 + 4 * Math.ceil(D / 4) },
  { name: "scaling", outputs: 6, run: 3, at: 4 },
];

/** Columns of an anchor's record. @param {Widths} widths */
export const anchorColumns = ({ feature, slots }) => 12 + 4 * Math.ceil(feature / 4) + 4 * slots;

/**
 * Heads of the local deformation by id. A Gaussian's record: mean and opacity, scale, quaternion w x y z, colour.
 *
 * @type {Head[]}
 */
export const LOCAL_HEADS = [
  { name: "mean", outputs: 3, run: 3, at: 0, length: true },
  { name: "scale", outputs: 3, run: 3, at: 4, length: true, then: "positive" },
  { name: "quat", outputs: 4, run: 4, at: 8, then: "unit" },
  { name: "opacity", outputs: 1, run: 1, at: 3, then: "clip" },
  { name: "color", outputs: 3, run: 3, at: 12, then: "clip" },
];

/** Columns of a Gaussian's record. */
export const GAUSSIAN_COLUMNS = 16;

/** The column of each output. @param {Head} head @returns {number[]} */
export const columnsOf = ({ outputs, run, at }) =>
  Array.from({ length: outputs }, (_, k) => at + Math.floor(k / run) * 4 * Math.ceil(run / 4) + (k % run));
