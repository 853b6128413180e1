// Clauses 8.8 and 11.3: the planes section, and samples from its residuals.

import { ByteReader } from "./bytes.js";
import { malformed, unsupported } from "./errors.js";
import { MAX_SYMBOL } from "./limits.js";
import {
  activityBounds,
  addRelativeMagnitudes,
  channelsOf,
  decodeStage,
  groupByActivity,
  readClassCount,
  readStages,
} from "./stages.js";
/** @import { PlaneShape } from "./parameters.js" */

/** How many predictors 11.3 has. */
export const PREDICTORS = 4;

/**
 * The samples of each plane.
 *
 * @param {Uint8Array} bytes the section @param {PlaneShape[]} shapes at least one, of equally many channels
 * @returns {Int32Array[]} [channels, height, width] each
 */
export function decodePlanes(bytes, shapes) {
  const reader = new ByteReader(bytes);
  const form = reader.byte("the form of the planes");
  const planes = shapes.map(({ channels, height, width }) => new Int32Array(channels * height * width));
  const all = planes.map((plane, i) => channelsOf(plane, shapes[i].channels));
  if (form === 0) decodeStage(reader.rest(), all.flat(), all.flat().map(() => null));
  else if (form === 1) decodeStaged(reader, shapes, all);
  else throw unsupported(`form ${form} of the planes`);
  planes.forEach((plane, i) => restore(plane, shapes[i]));
  return planes;
}

/** @param {ByteReader} reader @param {PlaneShape[]} shapes @param {Int32Array[][]} all the channels of each plane */
function decodeStaged(reader, shapes, all) {
  const { channels } = shapes[0];
  const count = Math.max(1, 32 - Math.clz32(channels - 1));
  const classCounts = [1];
  for (let stage = 1; stage < count; stage++) classCounts.push(readClassCount(reader));
  const stages = readStages(reader, count);
  const magnitudes = shapes.map(({ height, width }) => new Float64Array(height * width));
  for (let stage = 0; stage < count; stage++) {
    const first = stage ? 2 ** stage : 0;
    const end = Math.min(2 ** (stage + 1), channels);
    const classCount = classCounts[stage];
    /** @type {Int32Array[]} */
    const targets = [];
    /** @type {(import("./stages.js").Groups | null)[]} */
    const groups = [];
    shapes.forEach(({ height, width }, i) => {
      const activity = classCount > 1 ? sumOfNine(magnitudes[i], height, width) : null;
      const own = activity && groupByActivity(activity, activityBounds(activity, classCount));
      for (const target of all[i].slice(first, end)) {
        targets.push(target);
        groups.push(own);
      }
    });
    decodeStage(stages[stage], targets, groups);
    if (!classCounts.slice(stage + 1).some((later) => later > 1)) continue;
    all.forEach((plane, i) => {
      for (const residuals of plane.slice(first, end)) addRelativeMagnitudes(residuals, magnitudes[i]);
    });
  }
}

/** Per cell the sum over the nine cells around it; beyond the border the border's cells count again.
 * @param {Float64Array} values @param {number} height @param {number} width */
function sumOfNine(values, height, width) {
  const rows = new Float64Array(values.length);
  for (let i = 0, at = 0; i < height; i++) {
    for (let j = 0; j < width; j++, at++) {
      rows[at] = values[at] + values[j ? at - 1 : at] + values[j + 1 < width ? at + 1 : at];
    }
  }
  const sums = new Float64Array(values.length);
  for (let i = 0, at = 0; i < height; i++) {
    const up = i ? width : 0;
    const down = i + 1 < height ? width : 0;
    for (let j = 0; j < width; j++, at++) sums[at] = rows[at] + rows[at - up] + rows[at + down];
  }
  return sums;
}

/** 11.3, in place: residuals become samples. @param {Int32Array} plane @param {PlaneShape} shape */
function restore(plane, { channels, height, width, predictor }) {
  const cells = height * width;
  for (let from = 0; from < channels * cells; from += cells) {
    if (predictor) restoreChannel(plane, from, from + cells, width, predictor);
    else for (let at = from; at < from + cells; at++) check(plane[at]);
  }
}

/** Each sample is checked before others are predicted from it, so that a sum stays small. @param {Int32Array} plane
 * @param {number} from @param {number} end @param {number} width @param {number} predictor 1..3 */
function restoreChannel(plane, from, end, width, predictor) {
  check(plane[from]);
  // every predictor gives W in row 0 and N in column 0
  for (let at = from + 1; at < from + width; at++) check((plane[at] += plane[at - 1]));
  for (let row = from + width; row < end; row += width) {
    check((plane[row] += plane[row - width]));
    let w = plane[row];
    let nw = plane[row - width];
    for (let at = row + 1; at < row + width; at++) {
      const n = plane[at - width];
      let k = plane[at];
      if (predictor === 1) k += w;
      else if (predictor === 2) k += n;
      else k += median(w, n, w + n - nw);
      check(k);
      plane[at] = w = k;
      nw = n;
    }
  }
}

/** The median of three numbers below 2^30 in magnitude, without branches, which a processor would mispredict.
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
