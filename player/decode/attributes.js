// Clauses 8.5 to 8.7: the attributes section, to step classes and the channels of 11.2. layer.js checks their range.

import { ByteReader } from "./bytes.js";
import { decodeChannels } from "./channels.js";
import { malformed, unsupported } from "./errors.js";
import { channelCount } from "./header.js";
import { MAX_CODED } from "./limits.js";
import {
  activityBounds,
  addRelativeMagnitudes,
  channelsOf,
  decodeStage,
  groupByActivity,
  groupByClass,
  readClassCount,
  readStages,
  referenceOf,
} from "./stages.js";

/** Bounds of stages 0 to 4, in 38ths of the predicted channels. */
const STAGE_BOUNDS = [0, 6, 12, 20, 29, 38];
/** The stage of the offsets' x. */
const X_STAGE = 5;
const STEP_CLASSES = 7;
const STAGES = 8;
/** Number of distance classes of a Gaussian's y and z. */
const DISTANCES = [5, 7];

/** A linear prediction. @typedef {{channel: number, weight: number}[]} Terms */
/** split: bit 0 for y, bit 1 for z. @typedef {{split: number, a: number, b: number}} Split */

/**
 * A prediction block (8.6).
 *
 * @typedef {object} Block
 * @property {Terms[]} terms of each predicted channel
 * @property {number[]} classCounts number of activity classes of stages 0 to 5
 * @property {Split[]} splits of each slot
 * @property {Map<number | "step classes", import("./stages.js").Reference>} references of the block's slice, by channel
 * @property {number[][]} bounds of the block's slice, by stage
 */

/**
 * @param {Uint8Array} bytes the section @param {number} rows at least 1
 * @param {import("./parameters.js").LayerKind} kind
 * @param {import("./slices.js").Continuation} continuation of the layer
 * @returns {{stepClasses: Int32Array, attributes: Int32Array}} [rows], empty without step classes; [D + 6 + 3·G, rows]
 */
export function decodeAttributes(bytes, rows, kind, continuation) {
  const reader = new ByteReader(bytes);
  const form = reader.byte("the form of the attributes");
  const stepClasses = kind.stepClasses ? readStepClasses(reader, rows) : new Int32Array(0);
  const count = channelCount(kind.widths);
  const attributes = new Int32Array(count * rows);
  const channels = channelsOf(attributes, count);
  if (form === 0) {
    const groups = stepClasses.length ? groupByClass(stepClasses, STEP_CLASSES) : null;
    decodeStage(reader.rest(), channels, channels.map(() => groups), continuation.definitions("plain"));
  } else if (form === 1 || form === 2) {
    const own = form === 1;
    const block = own ? readBlock(reader, kind) : continuation.block;
    if (!block) throw malformed("attributes continue a prediction block, but no earlier slice has one");
    decodeStaged(reader, stepClasses, kind.widths, block, own, continuation, channels);
    continuation.block = block;
  } else throw unsupported(`form ${form} of the attributes`);
  return { stepClasses, attributes };
}

/** The step class of each row. Later slices do not use its priors. @param {ByteReader} reader @param {number} rows */
function readStepClasses(reader, rows) {
  const length = reader.varint(reader.remaining, "the length of the step classes");
  const classes = new Int32Array(rows);
  decodeChannels(reader.take(length, "the end of the step classes"), [rows], classes);
  for (const c of classes) {
    if (c < 0 || c >= STEP_CLASSES) throw malformed(`a step class of ${c}, expected 0..${STEP_CLASSES - 1}`);
  }
  return classes;
}

/** 8.6. @param {ByteReader} reader @param {import("./parameters.js").LayerKind} kind @returns {Block} */
function readBlock(reader, { widths: { feature, slots }, stepClasses }) {
  const predicted = feature + 6;
  /** @type {Terms[]} */
  const terms = [[]];
  for (let c = 1; c < predicted; c++) terms.push(readTerms(reader, c, predicted));
  const classCounts = stepClasses ? [] : [1];
  while (classCounts.length <= X_STAGE) classCounts.push(readClassCount(reader));
  const splits = Array.from({ length: slots }, () => readSplit(reader));
  return { terms, classCounts, splits, references: new Map(), bounds: [] };
}

/** 8.7. @param {ByteReader} reader @param {Int32Array} stepClasses @param {import("./header.js").Widths} widths
 * @param {Block} block @param {boolean} own whether the block stands in this slice, which then sets its references and
 * bounds @param {import("./slices.js").Continuation} continuation @param {Int32Array[]} all the channels */
function decodeStaged(reader, stepClasses, { feature, slots }, block, own, continuation, all) {
  const { terms, classCounts, splits, references } = block;
  const predicted = feature + 6; // features and log-scalings are predicted from each other
  const firsts = STAGE_BOUNDS.map((part) => Math.floor((predicted * part) / 38));
  const stages = readStages(reader, STAGES);

  const activity = new Float64Array(all[0].length);
  if (stepClasses.length) {
    // a row with finer steps has larger symbols
    const fineness = stepClasses.map((c) => 1 << (STEP_CLASSES - 1 - c));
    if (own) references.set("step classes", referenceOf(fineness));
    addRelativeMagnitudes(fineness, activity, references.get("step classes"));
    for (let p = 0; p < activity.length; p++) activity[p] *= 4;
  }
  for (let stage = 0; stage <= X_STAGE; stage++) {
    if (own) block.bounds.push(activityBounds(activity, classCounts[stage]));
    const groups = groupByActivity(activity, block.bounds[stage]);
    const channels = [];
    if (stage === X_STAGE) for (let i = 0; i < slots; i++) channels.push(predicted + 3 * i);
    else for (let c = firsts[stage]; c < firsts[stage + 1]; c++) channels.push(c);
    const targets = channels.map((c) => all[c]);
    decodeStage(stages[stage], targets, channels.map(() => groups), continuation.definitions(stage));
    if (stage < X_STAGE && classCounts.slice(stage + 1).some((later) => later > 1)) {
      channels.forEach((c, i) => {
        if (own) references.set(c, referenceOf(targets[i]));
        addRelativeMagnitudes(targets[i], activity, references.get(c));
      });
    }
  }
  for (let coordinate = 1; coordinate <= 2; coordinate++) {
    const targets = splits.map((_, i) => all[predicted + 3 * i + coordinate]);
    const groups = splits.map(({ split, a, b }, i) => {
      if (!(split & coordinate)) return null;
      const x = all[predicted + 3 * i];
      const y = coordinate === 2 ? all[predicted + 3 * i + 1] : null;
      return groupByClass(classesByDistance(x, a, y, b), DISTANCES[coordinate - 1]);
    });
    const stage = X_STAGE + coordinate;
    decodeStage(stages[stage], targets, groups, continuation.definitions(stage));
  }
  for (let c = 1; c < predicted; c++) predict(all[c], terms[c], all);
}

/** Item 1 of 8.6. @param {ByteReader} reader @param {number} c @param {number} predicted @returns {Terms} */
function readTerms(reader, c, predicted) {
  /** @type {Terms} */
  const terms = [];
  let channel = -1;
  for (let left = reader.varint(c, "a number of terms"); left > 0; left--) {
    channel += 1 + reader.varint(predicted, "a term's channel");
    const weight = reader.zigzag(2 ** 15, "a term's weight");
    if (channel >= c) throw malformed(`channel ${c} is predicted from channel ${channel}, expected one below it`);
    terms.push({ channel, weight });
  }
  return terms;
}

/** Item 3 of 8.6. @param {ByteReader} reader @returns {Split} */
function readSplit(reader) {
  const split = reader.varint(3, "a split");
  const a = split ? reader.zigzag(MAX_CODED, "the centre of x") : 0;
  const b = split & 2 ? reader.zigzag(MAX_CODED, "the centre of y") : 0;
  return { split, a, b };
}

/** @param {Int32Array} x @param {number} a @param {Int32Array | null} y @param {number} b */
function classesByDistance(x, a, y, b) {
  const classes = new Uint8Array(x.length);
  const last = (y ? DISTANCES[1] : DISTANCES[0]) - 1;
  for (let p = 0; p < x.length; p++) {
    const distance = Math.abs(x[p] - a) + (y ? Math.abs(y[p] - b) : 0);
    classes[p] = Math.min(distance, last);
  }
  return classes;
}

/** Residuals to symbols by the sum of 8.7, in place. @param {Int32Array} symbols @param {Terms} terms
 * @param {Int32Array[]} all the channels */
function predict(symbols, terms, all) {
  if (!terms.length) return;
  const sums = new Float64Array(symbols.length).fill(512);
  for (const { channel, weight } of terms) {
    const known = all[channel];
    for (let p = 0; p < sums.length; p++) sums[p] += weight * known[p];
  }
  for (let p = 0; p < sums.length; p++) {
    const k = symbols[p] + Math.floor(sums[p] / 1024);
    if (k > MAX_CODED || k < -MAX_CODED) throw malformed(`a predicted symbol of ${k}, limit ${MAX_CODED}`);
    symbols[p] = k;
  }
}
