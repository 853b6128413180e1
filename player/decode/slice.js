// Clauses 6.4, 11 and 12.1: one slice's payload to symbols, and those of grids and chains to float32 values.

import { ChannelReader } from "./channels.js";
import { decodePlanes } from "./grids.js";
import { MAX_SYMBOL } from "./limits.js";
import { readParameters } from "./parameters.js";
import { decodePositions } from "./positions.js";
import { STEP_CLASSES, decodeRows, dequantise } from "./rows.js";
/** @import { Header } from "./header.js" */
/** @import { Declared, Parameters } from "./parameters.js" */
/** @import { Prior } from "./tables.js" */
/** @import { RowTensor } from "./tensors.js" */

/**
 * What earlier slices leave to those behind them. classes: the step classes of all rows so far, null if rows have none.
 * layer: what the slices of the same layer before left, null if there are none.
 *
 * @typedef {{declared: Declared, classes: Uint8Array | null, layer: Known | null}} Before
 * @typedef {{rowTensors: RowTensor[], priors: Prior[]}} Known
 *
 * The symbols of a slice with n rows of its own and E earlier ones, none in a later slice of its layer. Of rows they are
 * the values in steps (11.2), of planes the samples (11.3).
 *
 * @typedef {object} Slice
 * @property {number} layer
 * @property {Parameters} parameters
 * @property {Int32Array} voxels [n, 3]
 * @property {Int32Array} rises of the earlier rows' mask codes
 * @property {Int32Array} codes [n] of the mask
 * @property {Int32Array | null} stepClasses [n], null if rows have none
 * @property {Int32Array} rows [W, n]
 * @property {Int32Array} layerRows [channels, E + n] of the layer's own tensors of rows, one behind the other
 * @property {Int32Array[]} planes [C, H, W] each, grid by grid
 * @property {Int32Array[]} weights weight, bias, weight, bias and so on, chain by chain
 * @property {Prior[]} priors of the layer so far (8)
 */

/** Entries of a layer's windows beyond one per symbol of the file so far. */
const FREE_ENTRIES = 2 ** 18;
export const LEAST_OWN_CODE = 3;
export const MOST_CODE = 255;

/**
 * The symbols of a slice's payload, each in the range that 11 allows.
 *
 * @param {Uint8Array} payload @param {number} layer @param {Header} header @param {Before} before
 * @returns {Slice}
 */
export function decodeSlice(payload, layer, header, before) {
  const known = before.layer;
  const parameters = readParameters(payload, header, before.declared, known?.rowTensors ?? null, layer);
  const { rows: n, rises: earlier, grids, chains, codes: bytes, stream, declared } = parameters;
  const priors = [...(known?.priors ?? [])];
  const reader = new ChannelReader(bytes, stream, priors, declared.symbols + FREE_ENTRIES);
  const voxels = n ? decodePositions(reader, n) : new Int32Array(0);
  const rises = reader.read(earlier, 0, layer ? MOST_CODE : 1, "a rise of a mask code");
  const codes = reader.read(n, LEAST_OWN_CODE, MOST_CODE, "a mask code");
  const stepClasses = header.centres && reader.read(n, 0, STEP_CLASSES - 1, "a step class");
  const rows = decodeRows(reader, header.rows, n, stepClasses, header.centres);
  const classes = stepClasses && new Uint8Array(earlier + n);
  if (earlier && before.classes) classes?.set(before.classes);
  if (stepClasses) classes?.set(stepClasses, earlier);
  const base = known ? 0 : header.base?.rows;
  const layerRows = decodeRows(reader, parameters.layerRows, earlier + n, classes, null, base);
  const planes = decodePlanes(reader, grids.list.flatMap((grid) => grid.planes));
  const linears = chains.list.flatMap((chain) => chain.linears);
  const lengths = linears.flatMap(({ inputs, outputs }) => [inputs * outputs, outputs]);
  const weights = lengths.map((length) => reader.read(length, -MAX_SYMBOL, MAX_SYMBOL, "a symbol of a chain"));
  reader.finish();
  return { layer, parameters, voxels, rises, codes, stepClasses, rows, layerRows, planes, weights, priors };
}

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
