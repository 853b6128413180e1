// Clauses 8.7 to 8.9: stages, class counts, relative magnitudes and classes by activity.

import { decodeChannels } from "./channels.js";
import { malformed } from "./errors.js";
import { MAX_CLASSES } from "./limits.js";
/** @import { ByteReader } from "./bytes.js" */

/** @param {ByteReader} reader */
export function readClassCount(reader) {
  const count = reader.varint(MAX_CLASSES, "a class count");
  if (!count) throw malformed("a class count of 0");
  return count;
}

/**
 * The stages of a section: the lengths of all but the last, then their bytes, to the section's end.
 *
 * @param {ByteReader} reader @param {number} count
 * @returns {Uint8Array[]} [count]
 */
export function readStages(reader, count) {
  const lengths = [];
  let sum = 0;
  for (let i = 1; i < count; i++) {
    const length = reader.varint(reader.remaining, "the length of a stage");
    lengths.push(length);
    sum += length;
  }
  const rest = reader.rest();
  if (sum > rest.length) throw malformed(`stages of ${sum} bytes or more, ${rest.length} bytes are left`);
  let at = 0;
  const stages = lengths.map((length) => rest.subarray(at, (at += length)));
  return [...stages, rest.subarray(at)];
}

/** Relative magnitudes below this one come from a table. */
const LOOKED_UP = 256;

/** Number of places and sum of their magnitudes. @typedef {{places: number, sum: number}} Reference */

/** @param {Int32Array} residuals one per place @returns {Reference} */
export function referenceOf(residuals) {
  let sum = 0;
  for (let p = 0; p < residuals.length; p++) sum += Math.abs(residuals[p]);
  return { places: residuals.length, sum };
}

/**
 * Adds the relative magnitude of each place in one channel to `sums`.
 *
 * @param {Int32Array} residuals one per place @param {Float64Array} sums @param {Reference} [reference] by default that
 * of these residuals
 */
export function addRelativeMagnitudes(residuals, sums, reference = referenceOf(residuals)) {
  const n = residuals.length;
  const most = reference.sum;
  const total = 1 + most;
  const factor = 256 * reference.places;
  let largest = 0;
  for (let p = 0; p < n; p++) largest = Math.max(largest, Math.abs(residuals[p]));
  largest = Math.min(largest, most);
  if (largest * factor > Number.MAX_SAFE_INTEGER) {
    for (let p = 0; p < n; p++) {
      const e = Math.min(Math.abs(residuals[p]), most);
      sums[p] += Number((BigInt(e) * BigInt(factor)) / BigInt(total));
    }
    return;
  }
  // The quotient of two integers below 2^53, rounded to binary64, does not reach the next integer: the floor is exact.
  const known = new Float64Array(Math.min(largest + 1, LOOKED_UP));
  for (let e = 0; e < known.length; e++) known[e] = Math.floor((e * factor) / total);
  for (let p = 0; p < n; p++) {
    const e = Math.min(Math.abs(residuals[p]), most);
    sums[p] += e < LOOKED_UP ? known[e] : Math.floor((e * factor) / total);
  }
}

/** Bounds of equally large classes, about. @param {Float64Array} activity @param {number} count of classes, 1..8 */
export function activityBounds(activity, count) {
  if (count === 1) return [];
  const n = activity.length;
  const ascending = activity.slice().sort();
  return Array.from({ length: count - 1 }, (_, i) => ascending[Math.floor(((i + 1) * n) / count)]);
}

/**
 * The places in the order in which a split channel holds them: class by class, in each as they come.
 *
 * @typedef {{order: Int32Array, sizes: Int32Array}} Groups sizes: places per class
 */

/**
 * Groups places by the number of bounds that are at most their activity.
 *
 * @param {Float64Array} activity @param {number[]} bounds
 * @returns {Groups | null} null without bounds
 */
export function groupByActivity(activity, bounds) {
  if (!bounds.length) return null;
  const n = activity.length;
  const classes = new Uint8Array(n);
  for (const bound of bounds) for (let p = 0; p < n; p++) if (activity[p] >= bound) classes[p]++;
  return groupByClass(classes, bounds.length + 1);
}

/** @param {Uint8Array | Int32Array} classes @param {number} count of classes @returns {Groups} */
export function groupByClass(classes, count) {
  const sizes = new Int32Array(count);
  for (let p = 0; p < classes.length; p++) sizes[classes[p]]++;
  const next = new Int32Array(count);
  for (let c = 1; c < count; c++) next[c] = next[c - 1] + sizes[c - 1];
  const order = new Int32Array(classes.length);
  for (let p = 0; p < classes.length; p++) order[next[classes[p]]++] = p;
  return { order, sizes };
}

/** Views of the channels, one behind the other. @param {Int32Array} values @param {number} count of channels */
export function channelsOf(values, count) {
  const places = values.length / count;
  return Array.from({ length: count }, (_, c) => values.subarray(c * places, (c + 1) * places));
}

/**
 * Decodes one stage into its channels. groups: per channel how its rows are split, null if they are not.
 *
 * @param {Uint8Array} bytes @param {Int32Array[]} targets
 * @param {(Groups | null)[]} groups @param {import("./channels.js").Prior[]} [known] see decodeChannels
 */
export function decodeStage(bytes, targets, groups, known) {
  /** @type {number[]} */
  const counts = [];
  let all = 0;
  targets.forEach((target, i) => {
    all += target.length;
    const split = groups[i];
    if (split) for (const size of split.sizes) counts.push(size);
    else counts.push(target.length);
  });
  const coded = new Int32Array(all);
  decodeChannels(bytes, counts, coded, known);
  let at = 0;
  targets.forEach((target, i) => {
    const split = groups[i];
    if (split) for (const place of split.order) target[place] = coded[at++];
    else {
      target.set(coded.subarray(at, at + target.length));
      at += target.length;
    }
  });
}
