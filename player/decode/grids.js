// Clauses 8.6, 8.7 and 11.3: grids in stages, and samples from their residuals.

import { channelsOf, groupByClass } from "./channels.js";
import { checked, dequantise } from "./rows.js";
/** @import { ChannelReader } from "./channels.js" */
/** @import { Grid, Plane } from "./tensors.js" */

/** Classes of a plane channel that is split. */
const CLASSES = 8;
const SAMPLE = "a plane sample"; // in messages

/** Fills the planes of all grids, the first stage of each before the second of any. @param {ChannelReader} reader
 * @param {Grid[]} grids */
export function decodeGrids(reader, grids) {
  let planes = grids.flatMap(({ planes, step }) => planes.map((plane) => stagesOf(reader, plane, step)));
  while (planes.length) planes = planes.filter((stages) => !stages.next().done);
}

/** Reads one stage of a plane at a time, then fills it. @param {ChannelReader} reader @param {Plane} plane
 * @param {number} step */
function* stagesOf(reader, plane, step) {
  const { channels, height, width } = plane;
  const samples = new Int32Array(channels * height * width);
  const all = channelsOf(samples, channels);
  const magnitudes = new Float64Array(channels > 2 ? height * width : 0); // sums over the stages before
  for (let first = 0, end = 2; first < channels; first = end, end *= 2) {
    const stage = all.slice(first, end);
    const groups = first ? groupByActivity(sumOfThree(sumOfThree(magnitudes, width, 1), height, width)) : null;
    for (const channel of stage) reader.fill(channel, groups);
    if (end < channels) for (const residuals of stage) addRelativeMagnitudes(residuals, magnitudes);
    yield;
  }
  for (const channel of all) restore(channel, plane);
  plane.data = dequantise(samples, step);
}

/** Adds the relative magnitude of each cell in one channel to `sums`. @param {Int32Array} residuals
 * @param {Float64Array} sums */
function addRelativeMagnitudes(residuals, sums) {
  const n = residuals.length;
  let total = 1;
  for (let p = 0; p < n; p++) total += Math.abs(residuals[p]);
  const factor = 256 * n;
  for (let p = 0; p < n; p++) {
    const product = Math.abs(residuals[p]) * factor;
    // The floor is exact: the quotient of two integers below 2^53, rounded to binary64, is below the next integer.
    if (product <= Number.MAX_SAFE_INTEGER) sums[p] += Math.floor(product / total);
    else sums[p] += Number((BigInt(Math.abs(residuals[p])) * BigInt(factor)) / BigInt(total));
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
  checked(samples[0], SAMPLE);
  // both predictors give W in row 0 and N in column 0
  for (let at = 1; at < width; at++) checked((samples[at] += samples[at - 1]), SAMPLE);
  for (let row = width; row < samples.length; row += width) {
    checked((samples[row] += samples[row - width]), SAMPLE);
    let w = samples[row];
    let nw = samples[row - width];
    for (let at = row + 1; at < row + width; at++) {
      const n = samples[at - width];
      samples[at] = w = checked(samples[at] + (predictor ? median(w, n, w + n - nw) : n), SAMPLE);
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
