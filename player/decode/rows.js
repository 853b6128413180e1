// Clauses 8.5, 11.2 and 11.5: tensors of rows, from symbols to values.

import { channelsOf, checkRange, groupByClass } from "./channels.js";
import { malformed } from "./errors.js";
import { MAX_SYMBOL } from "./limits.js";
/** @import { ChannelReader } from "./channels.js" */
/** @import { RowTensor } from "./tensors.js" */

/** The predictor that step classes do not concern. */
const WHOLE = 2;
export const STEP_CLASSES = 7;

/** Tensors of rows, [count, channels] each. @param {ChannelReader} reader @param {RowTensor[]} tensors
 * @param {number} count of rows @param {Uint8Array | null} classes [count] step classes, null if rows have none
 * @param {number[] | null} centres of the channels of all tensors, null if they are 0
 * @param {number} [base] rows of a base, the first ones, which are channels of their own */
export function decodeRows(reader, tensors, count, classes, centres, base = 0) {
  const parts = base ? new Uint8Array(count).fill(STEP_CLASSES, base) : classes;
  if (base) classes?.forEach((c, i) => (/** @type {Uint8Array} */ (parts)[i] += c));
  const groups = parts && groupByClass(parts, 2 * STEP_CLASSES);
  let c = 0;
  return tensors.map(({ channels, predictor, step }) => {
    const values = new Int32Array(channels * count);
    for (const channel of channelsOf(values, channels)) {
      reader.fill(channel, groups);
      restore(channel, classes, centres?.[c++] ?? 0, predictor);
    }
    return dequantise(values, step, count, channels);
  });
}

/** 11.2, in place: symbols become values in steps. @param {Int32Array} values @param {Uint8Array | null} classes
 * @param {number} centre @param {number} predictor */
function restore(values, classes, centre, predictor) {
  checkRange(values, -MAX_SYMBOL, MAX_SYMBOL, "a symbol of a row");
  if (!predictor) {
    if (classes) for (let i = 0; i < values.length; i++) values[i] = checked(centre + (values[i] << classes[i]));
    return;
  }
  const last = new Int32Array(STEP_CLASSES).fill(centre);
  for (let i = 0; i < values.length; i++) {
    const c = classes && predictor < WHOLE ? classes[i] : 0;
    values[i] = checked(last[c] + (values[i] << c));
    for (let j = c; j < STEP_CLASSES; j++) last[j] = values[i];
  }
}

/** A value in steps, in its range. @param {number} v below 2^30 in magnitude @param {string} what */
export function checked(v, what = "a row's value") {
  if ((v + MAX_SYMBOL) >>> 0 > 2 * MAX_SYMBOL) throw malformed(`${what} of ${v} steps, limit ±${MAX_SYMBOL}`);
  return v;
}

/** Rows that are transposed at a time, so few that they stay in the cache. */
const BLOCK = 128;

/** 11.5: symbols times their step, rounded to binary32, of [columns, rows] symbols to [rows, columns] values. Malformed
 * if a result is not finite. @param {Int32Array} symbols @param {number} step @param {number} [rows]
 * @param {number} [columns] */
export function dequantise(symbols, step, rows = symbols.length, columns = 1) {
  const values = new Float32Array(symbols.length);
  for (let first = 0; first < rows; first += BLOCK) {
    const end = Math.min(first + BLOCK, rows);
    for (let c = 0; c < columns; c++) {
      // The product is exact: 24 bits by 24 bits.
      for (let r = first; r < end; r++) values[r * columns + c] = symbols[c * rows + r] * step;
    }
  }
  // Rounding is monotone, so that where the largest symbol stays finite all do.
  const finite = Number.isFinite(Math.fround(MAX_SYMBOL * step)) || values.every(Number.isFinite);
  if (!finite) throw malformed("a reconstructed value is not finite");
  return values;
}
