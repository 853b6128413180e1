// The residual heads of a deformation (6.3, 13.3), and an anchor's record, to which they add: one row a head.

/** @import { Widths } from "./header.js" */

/**
 * The record is an anchor as floats in blocks of four, the texels of the evaluator on the GPU. A quantity takes its
 * columns in runs, each of which starts a block.
 *
 * outputs: numbers of the quantity. run: of them in a run. at: its first column. length: whether the head's outputs are
 * lengths, in units of a quarter of the box.
 *
 * @typedef {{name: string, outputs: number, run: number, at: number, length?: boolean}} Head
 */

/** The heads by id. @param {Widths} widths @returns {Head[]} */
export const headsOf = ({ feature: D, slots: G }) => [
  { name: "position", outputs: 3, run: 3, at: 0, length: true },
  { name: "feature", outputs: D, run: D, at: 12 },
  { name: "offset", outputs: 3 * G, run: 3, at: 12 + 4 * Math.ceil(D / 4) },
  { name: "scaling", outputs: 6, run: 3, at: 4 },
];

/** Columns of an anchor's record. @param {Widths} widths */
export const anchorColumns = ({ feature, slots }) => 12 + 4 * Math.ceil(feature / 4) + 4 * slots;

/** The column of each output. @param {Head} head @returns {number[]} */
export const columnsOf = ({ outputs, run, at }) =>
  Array.from({ length: outputs }, (_, k) => at + Math.floor(k / run) * 4 * Math.ceil(run / 4) + (k % run));
