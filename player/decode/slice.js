// Clauses 6.4, 8.5, 11 and 12.1: one slice's payload to symbols, and symbols to float32 values.

import { ChannelReader, channelsOf, checkRange, groupByClass } from "./channels.js";
import { malformed } from "./errors.js";
import { decodePlanes } from "./grids.js";
import { MAX_SYMBOL } from "./limits.js";
import { readParameters } from "./parameters.js";
import { decodePositions } from "./positions.js";
/** @import { Header } from "./header.js" */
/** @import { Declared, Parameters } from "./parameters.js" */
/** @import { Prior } from "./tables.js" */

/** The priors that a layer's slices define, which later ones may refer to (8): of positions, and of what rows hold.
 * @typedef {{positions: Prior[], rows: Prior[]}} Priors */

/**
 * The symbols of a slice with n rows of its own.
 *
 * @typedef {object} Slice
 * @property {number} layer
 * @property {Parameters} parameters
 * @property {Int32Array} voxels [n, 3]
 * @property {Int32Array} rises of the earlier rows' mask codes
 * @property {Int32Array} codes [n] of the mask
 * @property {Int32Array} stepClasses [n], empty if anchors have none
 * @property {Int32Array} rows [W, n]
 * @property {Int32Array[]} planes [C, H, W] each, grid by grid
 * @property {Int32Array[]} weights weight, bias, weight, bias and so on, chain by chain
 * @property {Priors} priors of the layer so far
 */

/** Entries of windows beyond one per symbol, of a first slice and of a later one. */
const FREE_ENTRIES = 2 ** 18;
const MORE_ENTRIES = 2 ** 10;
const STEP_CLASSES = 7;
const LEAST_OWN_CODE = 3;
export const MOST_CODE = 255;

/**
 * The symbols of a slice's payload, each in the range that 11 allows.
 *
 * @param {Uint8Array} payload @param {number} layer @param {Header} header
 * @param {Declared} before by the slices before
 * @param {Priors | null} known by the slices of the layer before, to which this one's are added; null if there are none
 * @returns {Slice}
 */
export function decodeSlice(payload, layer, header, before, known) {
  const parameters = readParameters(payload, header, before, known !== null, `layer ${layer}`);
  const { rows: n, rises: earlier, grids, chains, codes: bytes, stream, symbols } = parameters;
  const reader = new ChannelReader(bytes, stream, symbols + (known ? MORE_ENTRIES : FREE_ENTRIES));
  const priors = known ?? { positions: [], rows: [] };
  const voxels = n ? decodePositions(reader, n, priors.positions) : new Int32Array(0);
  const rises = reader.read([earlier], priors.rows, 0, MOST_CODE, "a rise of a mask code");
  const codes = reader.read([n], priors.rows, LEAST_OWN_CODE, MOST_CODE, "a mask code");
  const graded = header.centres ? [n] : [];
  const stepClasses = reader.read(graded, priors.rows, 0, STEP_CLASSES - 1, "a step class");
  const rows = new Int32Array(header.width * n);
  const groups = header.centres && groupByClass(stepClasses, STEP_CLASSES);
  for (const channel of channelsOf(rows, header.width)) reader.fill(channel, priors.rows, groups);
  checkRange(rows, -MAX_SYMBOL, MAX_SYMBOL, "a symbol of a row");
  /** @type {Prior[]} */
  const others = []; // of grids and chains
  const planes = decodePlanes(reader, grids.list.flatMap((grid) => grid.planes), others);
  const linears = chains.list.flatMap((chain) => chain.linears);
  const lengths = linears.flatMap(({ inputs, outputs }) => [inputs * outputs, outputs]);
  const weights = lengths.map((length) => reader.read([length], others, -MAX_SYMBOL, MAX_SYMBOL, "a symbol of a chain"));
  reader.finish();
  return { layer, parameters, voxels, rises, codes, stepClasses, rows, planes, weights, priors };
}

/** 11.5: symbols times their step, rounded to binary32. Malformed if a result is not finite. @param {Int32Array} symbols
 * @param {number} step */
export const dequantise = (symbols, step) => transposed(symbols, symbols.length, 1, step, null);

/** @param {Slice} slice @returns {import("./tensors.js").Grid[]} */
export function gridsOf({ parameters: { grids }, planes }) {
  let at = 0;
  return grids.list.map(({ planes: shapes, ...grid }) => {
    const made = shapes.map(({ predictor, ...sizes }) => ({ data: dequantise(planes[at++], grids.step), ...sizes }));
    return { ...grid, planes: made };
  });
}

/** @param {Slice} slice @returns {import("./tensors.js").Chain[]} */
export function chainsOf({ parameters: { chains }, weights }) {
  let at = 0;
  const next = () => dequantise(weights[at++], chains.step);
  return chains.list.map(({ id, linears }) => {
    return { id, network: linears.map((sizes) => ({ ...sizes, weight: next(), bias: next() })) };
  });
}

/** Each tensor of a slice's rows, [n, channels]. @param {Slice} slice @param {Header} header */
export function rowsOf({ codes: { length: n }, stepClasses, rows }, header) {
  let first = 0;
  return header.rows.map(({ channels, step }) => {
    const centres = header.centres?.slice(first, first + channels);
    const symbols = rows.subarray(first * n, (first += channels) * n);
    return transposed(symbols, n, channels, step, centres ? { centres, stepClasses } : null);
  });
}

/** Rows that are transposed at a time, so few that they stay in the cache. */
const BLOCK = 128;

/** centres: [columns]. stepClasses: [rows]. @typedef {{centres: number[], stepClasses: Int32Array}} Grading */

/** @param {number} centre @param {number} symbol at most 2^23 in magnitude @param {number} stepClass 0..6 */
function levelOf(centre, symbol, stepClass) {
  const level = centre + (symbol << stepClass);
  if (level > MAX_SYMBOL || level < -MAX_SYMBOL) throw malformed(`a value of ${level} steps, limit ${MAX_SYMBOL}`);
  return level;
}

/**
 * As dequantise, of [columns, rows] symbols to [rows, columns] values. Malformed if a graded one is out of its range.
 *
 * @param {Int32Array} symbols @param {number} rows @param {number} columns @param {number} step
 * @param {Grading | null} grading null without step classes
 * @returns {Float32Array}
 */
function transposed(symbols, rows, columns, step, grading) {
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
