// An anchor's record: an anchor as floats in blocks of four, the texels of the evaluator on the GPU.

/** @import { Widths } from "../kinds/index.js" */

/**
 * A quantity of anchors takes its columns in runs, each of which starts a block. values: the scene's array of it. outputs:
 * numbers of the quantity. run: of them in a run. at: its first column. length: whether a deformation's residuals are
 * lengths, in units of a quarter of the box.
 *
 * @typedef {{values: "anchor" | "feature" | "scalingLog" | "offset", outputs: number, run: number, at: number,
 *   length?: boolean}} Quantity
 */

/** The quantities in the order of a deformation's heads. @param {Widths} widths @returns {Quantity[]} */
export const quantitiesOf = ({ feature: D, slots: G }) => [
  { values: "anchor", outputs: 3, run: 3, at: 0, length: true },
  { values: "feature", outputs: D, run: D, at: 4 },
  { values: "scalingLog", outputs: 6, run: 3, at: 4 + 4 * Math.ceil(D / 4) },
  { values: "offset", outputs: 3 * G, run: 3, at: 12 + 4 * Math.ceil(D / 4) },
];

/** Columns of a record. @param {Widths} widths */
export const anchorColumns = ({ feature, slots }) => 12 + 4 * Math.ceil(feature / 4) + 4 * slots;

/** The column of each output. @param {Quantity} quantity @returns {number[]} */
export const columnsOf = ({ outputs, run, at }) =>
  Array.from({ length: outputs }, (_, k) => at + Math.floor(k / run) * 4 * Math.ceil(run / 4) + (k % run));
