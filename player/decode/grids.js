// Clauses 8.6, 8.7 and 11.3: grids in stages, and samples from their residuals.

import { channelsOf, groupByClass } from "./channels.js";
import { malformed } from "./errors.js";
import { MAX_SYMBOL } from "./limits.js";
/** @import { ChannelReader } from "./channels.js" */
/** @import { Plane } from "./tensors.js" */

/** Classes of a plane channel that is split. */
const CLASSES = 8;
/** Relative magnitudes of residuals below this come from a table. */
const LOOKED_UP = 256;

/** The samples of each plane of all grids, [channels, height, width]. @param {ChannelReader} reader
 * @param {Plane[]} shapes */
export function decodePlanes(reader, shapes) {
  const planes = shapes.map(({ channels, height, width }) => new Int32Array(channels * height * width));
  const all = planes.map((plane, i) => channelsOf(plane, shapes[i].channels));
  /** @type {Float64Array[]} */
  const magnitudes = shapes.map(() => new Float64Array(0)); // sums over the stages before, per plane
  const most = Math.max(0, ...shapes.map(({ channels }) => channels));
  for (let first = 0, end = 2; first < most; first = end, end *= 2) {
    shapes.forEach(({ channels, height, width }, i) => {
      const stage = all[i].slice(first, end);
      if (!stage.length) return;
      const groups = first ? groupByActivity(sumOfThree(sumOfThree(magnitudes[i], width, 1), height, width)) : null;
      for (const channel of stage) reader.fill(channel, groups);
      if (end >= channels) return;
      if (!first) magnitudes[i] = new Float64Array(height * width);
      for (const residuals of stage) addRelativeMagnitudes(residuals, magnitudes[i]);
    });
  }
  all.forEach((plane, i) => plane.forEach((channel) => restore(channel, shapes[i])));
  return planes;
}

/** Adds the relative magnitude of each cell in one channel to `sums`. @param {Int32Array} residuals
 * @param {Float64Array} sums */
function addRelativeMagnitudes(residuals, sums) {
  const n = residuals.length;
  let total = 1;
  for (let p = 0; p < n; p++) total += Math.abs(residuals[p]);
  const factor = 256 * n;
  /** The floor is exact: the quotient of two integers below 2^53, rounded to binary64, does not reach the next integer.
   * @param {number} e */
  const relative = (e) => {
    if (e * factor <= Number.MAX_SAFE_INTEGER) return Math.floor((e * factor) / total);
    return Number((BigInt(e) * BigInt(factor)) / BigInt(total));
  };
  const known = new Float64Array(LOOKED_UP);
  for (let e = 0; e < LOOKED_UP; e++) known[e] = relative(e);
  for (let p = 0; p < n; p++) {
    const e = Math.abs(residuals[p]);
    sums[p] += e < LOOKED_UP ? known[e] : relative(e);
  }
}

/** Groups cells by activity into classes of about equal size. @param {Float64Array} activity */
function groupByActivity(activity) {
  const n = activity.length;
  const ascending = activity.slice().sort();
  const classes = new Uint8Array(n);
  for (let i = 1; i < CLASSES; i++) {
    const bound = ascending[Math.floor((i * n) / CLASSES)];
    for (let p = 0; p < n; p++) if (activity[p] >= bound) classes[p]++;
  }
  return groupByClass(classes, CLASSES);
}

/** Per cell the sum of it and the cells beside it along an axis of `length` cells, `stride` apart; beyond the border
 * the border's cells count again. @param {Float64Array} values @param {number} length @param {number} stride */
function sumOfThree(values, length, stride) {
  const sums = new Float64Array(values.length);
  for (let at = 0, i = 0; at < sums.length; i = (i + 1) % length) {
    const back = i ? stride : 0;
    const on = i + 1 < length ? stride : 0;
    for (const end = at + stride; at < end; at++) sums[at] = values[at] + values[at - back] + values[at + on];
  }
  return sums;
}

/** 11.3, in place: residuals of a channel become samples. Each is checked before others are predicted from it, so that
 * a sum stays small. @param {Int32Array} samples @param {Plane} shape */
function restore(samples, { width, predictor }) {
  check(samples[0]);
  // both predictors give W in row 0 and N in column 0
  for (let at = 1; at < width; at++) check((samples[at] += samples[at - 1]));
  for (let row = width; row < samples.length; row += width) {
    check((samples[row] += samples[row - width]));
    let w = samples[row];
    let nw = samples[row - width];
    for (let at = row + 1; at < row + width; at++) {
      const n = samples[at - width];
      const k = samples[at] + (predictor ? median(w, n, w + n - nw) : n);
      check(k);
      samples[at] = w = k;
      nw = n;
    }
  }
}

/** Of three numbers below 2^30 in magnitude, without branches, which a processor would mispredict.
 * @param {number} a @param {number} b @param {number} c */
function median(a, b, c) {
  let step = (a - b) & ((a - b) >> 31);
  const least = b + step;
  const most = a - step;
  step = most - c;
  const below = most - (step & ~(step >> 31));
  step = below - least;
  return least + (step & ~(step >> 31));
}

/** @param {number} k */
function check(k) {
  if ((k + MAX_SYMBOL) >>> 0 > 2 * MAX_SYMBOL) throw malformed(`a plane sample of ${k}, limit ±${MAX_SYMBOL}`);
}
