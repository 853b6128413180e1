// Clauses 6.4, 8.5, 11 and 12.1: one slice's payload to symbols, and symbols to float32 values.

import { ByteReader } from "./bytes.js";
import { channelsOf, decodeChannels, decodeSplit, groupByClass } from "./channels.js";
import { malformed } from "./errors.js";
import { channelCount } from "./header.js";
import { MAX_SYMBOL } from "./limits.js";
import { readParameters } from "./parameters.js";
import { decodePlanes } from "./planes.js";
import { decodePositions } from "./positions.js";
/** @import { Prior } from "./channels.js" */
/** @import { Declared, LayerKind, NetworkShape, Parameters } from "./parameters.js" */

/** What later slices of a layer may refer to (8): the priors of each section, in their order.
 * @typedef {Record<"positions" | "masks" | "attributes", Prior[]>} Continuation */

/**
 * The symbols of a slice with n rows of its own.
 *
 * @typedef {object} LayerSymbols
 * @property {LayerKind} kind
 * @property {Parameters} parameters
 * @property {Int32Array} voxels [n, 3]
 * @property {Int32Array} rises of the earlier rows' mask codes
 * @property {Int32Array} codes [n] of the mask
 * @property {Int32Array} stepClasses [n], empty if anchors have none
 * @property {Int32Array} attributes [D + 6 + 3·G, n]
 * @property {Int32Array[]} planes per scale six [C, H, W]
 * @property {Int32Array[]} weights weight, bias, weight, bias and so on, network by network
 */

const STEP_CLASSES = 7;
const LEAST_OWN_CODE = 3;
export const MOST_CODE = 255;

/**
 * The symbols of a slice's payload, each in the range that 11.1 and 11.2 allow.
 *
 * @param {Uint8Array} payload @param {LayerKind} kind
 * @param {Declared} before by the slices before
 * @param {Continuation} continuation what the slices of the layer before left
 * @param {boolean} later whether there are such
 * @returns {LayerSymbols}
 */
export function decodeLayer(payload, kind, before, continuation, later) {
  const earlierRows = later ? 0 : before.rows;
  const parameters = readParameters(payload, kind, before, later);
  const { rows, sections, scales, networks } = parameters;
  const { positions, masks, attributes: section, planes, weights } = sections;
  const empty = new Int32Array(0);
  const voxels = positions ? decodePositions(positions, rows, continuation.positions) : empty;
  const codes = masks ? decodeChannels(masks, [earlierRows, rows], continuation.masks) : empty;
  checkRange(codes.subarray(0, earlierRows), 0, MOST_CODE, "a rise of a mask code");
  checkRange(codes.subarray(earlierRows), LEAST_OWN_CODE, MOST_CODE, "a mask code");
  const none = { stepClasses: empty, attributes: empty };
  const { stepClasses, attributes } = section ? decodeAttributes(section, rows, kind, continuation.attributes) : none;
  checkRange(attributes, -MAX_SYMBOL, MAX_SYMBOL, "a symbol of an attribute");
  return {
    kind,
    parameters,
    voxels,
    rises: codes.subarray(0, earlierRows),
    codes: codes.subarray(earlierRows),
    stepClasses,
    attributes,
    planes: planes ? decodePlanes(planes, scales.flat()) : [],
    weights: weights ? decodeWeights(weights, networks) : [],
  };
}

/**
 * @param {Uint8Array} bytes the section @param {number} rows at least 1
 * @param {LayerKind} kind
 * @param {Prior[]} known see decodeChannels
 * @returns {{stepClasses: Int32Array, attributes: Int32Array}} [rows], empty without step classes; [D + 6 + 3·G, rows]
 */
function decodeAttributes(bytes, rows, kind, known) {
  const count = channelCount(kind.widths);
  if (!kind.stepClasses) {
    const attributes = decodeChannels(bytes, new Array(count).fill(rows), known);
    return { stepClasses: new Int32Array(0), attributes };
  }
  const attributes = new Int32Array(count * rows);
  const reader = new ByteReader(bytes);
  const stepClasses = readStepClasses(reader, rows);
  const groups = groupByClass(stepClasses, STEP_CLASSES);
  const channels = channelsOf(attributes, count);
  decodeSplit(reader.rest(), channels, channels.map(() => groups), known);
  return { stepClasses, attributes };
}

/** The step class of each row. Later slices do not use its priors. @param {ByteReader} reader @param {number} rows */
function readStepClasses(reader, rows) {
  const length = reader.varint(reader.remaining, "the length of the step classes");
  const classes = decodeChannels(reader.take(length, "the end of the step classes"), [rows]);
  for (const c of classes) {
    if (c < 0 || c >= STEP_CLASSES) throw malformed(`a step class of ${c}, expected 0..${STEP_CLASSES - 1}`);
  }
  return classes;
}

/** @param {Uint8Array} bytes @param {NetworkShape[]} networks */
function decodeWeights(bytes, networks) {
  const counts = networks.flatMap(({ layers }) => layers.flatMap(({ inputs, outputs }) => [inputs * outputs, outputs]));
  const all = decodeChannels(bytes, counts);
  checkRange(all, -MAX_SYMBOL, MAX_SYMBOL, "a symbol of a weight");
  let at = 0;
  return counts.map((count) => all.subarray(at, (at += count)));
}

/** @param {Int32Array} symbols @param {number} least @param {number} most @param {string} what */
function checkRange(symbols, least, most, what) {
  for (let i = 0; i < symbols.length; i++) {
    if (symbols[i] < least || symbols[i] > most) throw malformed(`${what}: ${symbols[i]}, expected ${least}..${most}`);
  }
}

/**
 * 11.5: symbols times their step, rounded to binary32. Malformed if a result is not finite.
 *
 * @param {Int32Array} symbols @param {number} step
 * @returns {Float32Array}
 */
export function dequantise(symbols, step) {
  return transposed(symbols, symbols.length, 1, step, null);
}

/** Rows that are transposed at a time, so few that they stay in the cache. */
const BLOCK = 128;

/** centres: [columns]. stepClasses: [rows]. @typedef {{centres: number[], stepClasses: Int32Array}} Grading */

/** @param {number} centre @param {number} symbol at most 2^23 in magnitude @param {number} stepClass 0..6 */
function levelOf(centre, symbol, stepClass) {
  const level = centre + (symbol << stepClass);
  if (level > MAX_SYMBOL || level < -MAX_SYMBOL) throw malformed(`an attribute of ${level} steps, limit ${MAX_SYMBOL}`);
  return level;
}

/**
 * As dequantise, of [columns, rows] symbols to [rows, columns] values. Malformed if a graded one is out of its range.
 *
 * @param {Int32Array} symbols @param {number} rows @param {number} columns @param {number} step
 * @param {Grading | null} grading null without step classes
 * @returns {Float32Array}
 */
export function transposed(symbols, rows, columns, step, grading) {
  const values = new Float32Array(symbols.length);
  for (let first = 0; first < rows; first += BLOCK) {
    const end = Math.min(first + BLOCK, rows);
    for (let c = 0; c < columns; c++) {
      // The product is exact: 24 bits by 24 bits.
      if (grading) {
        const { centres, stepClasses } = grading;
        for (let r = first; r < end; r++) {
          values[r * columns + c] = levelOf(centres[c], symbols[c * rows + r], stepClasses[r]) * step;
        }
      } else for (let r = first; r < end; r++) values[r * columns + c] = symbols[c * rows + r] * step;
    }
  }
  // Rounding is monotone, so that where the largest symbol stays finite all do.
  if (!Number.isFinite(Math.fround(MAX_SYMBOL * step))) {
    for (const value of values) if (!Number.isFinite(value)) throw malformed("a reconstructed value is not finite");
  }
  return values;
}
