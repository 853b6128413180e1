// Clauses 6, 11 and 12.1: one slice's payload, to its parameters, its symbols, and the values of its grids and chains.

import { ChannelReader } from "./channels.js";
import { limitExceeded, malformed } from "./errors.js";
import { anything, id, integer, kind, list, map, optional, record, registered } from "./fields.js";
import { rows, step, tensors, widthOf } from "./fields.js";
import { decodePlanes } from "./grids.js";
import { MAX_CHANNELS, MAX_PAYLOAD, MAX_ROWS, MAX_SYMBOL } from "./limits.js";
import { unpack } from "./msgpack.js";
import { decodePositions } from "./positions.js";
import { STEP_CLASSES, decodeRows, dequantise } from "./rows.js";
/** @import { Read } from "./fields.js" */
/** @import { Header } from "./header.js" */
/** @import { Prior } from "./tables.js" */
/** @import { Chain, Grid, RowTensor } from "./tensors.js" */

/** Totals of slices (6.5): rows, symbols, bytes of payloads. @typedef {{rows: number, symbols: number, bytes: number}}
 * Declared */

const NONE = new Float32Array(0); // until symbols are decoded
/** The format's limit is 2^28, the least 2^25: a page allocates about a gigabyte at most. */
const MAX_PLANE_CELLS = 2 ** 26;
/** Entries of a layer's windows beyond one per symbol of the file so far. */
const FREE_ENTRIES = 2 ** 18;
export const LEAST_OWN_CODE = 3;
export const MOST_CODE = 255;

const GRID = record({
  id,
  channels: integer(1, MAX_CHANNELS),
  sides: list(integer(1, 4096), 1, 4),
  predictors: list(registered(2), 0, Infinity),
});

/** @type {Read<Grid>} */
const grid = (value, where) => {
  const { id, channels, sides, predictors } = GRID(value, where);
  // a grid of one side is a plane of one row
  const pairs = sides.length === 1 ? [[sides[0], 1]] : sides.flatMap((a, i) => sides.slice(i + 1).map((b) => [a, b]));
  if (predictors.length !== pairs.length) {
    throw malformed(`${where}: ${predictors.length} predictors, expected ${pairs.length}`);
  }
  const planes = pairs.map(([width, height], i) => {
    return { data: NONE, channels, height, width, predictor: predictors[i] };
  });
  return { id, channels, sides, planes };
};

/** @type {Read<Chain>} */
const chain = (value, where) => {
  const [first, ...rest] = list(anything, 3, 18)(value, where);
  const widths = rest.map((width) => integer(1, 4096)(width, `${where}: width`));
  const network = widths.slice(1).map((outputs, i) => ({ weight: NONE, bias: NONE, inputs: widths[i], outputs }));
  return { id: id(first, where), network };
};

/** Tensors behind the step of all of them. @template {{id: number}} T @param {Read<T>} read @param {number} limit
 * @returns {Read<{step: number, list: T[]}>} */
const stepped = (read, limit) => (value, where) => {
  const [first, ...rest] = list(anything, 2, 1 + limit)(value, where);
  return { step: step(first, where), list: tensors(read, limit)(rest, where) };
};

const PARAMETERS = map([1, 2, 3, 4, 5, 6, 7], {
  rows: integer(0, MAX_ROWS),
  size: integer(0, MAX_PAYLOAD), // of the codes
  fill: optional(list(integer(0, 255), 3, 4), null), // of a prefix that ends here: colour behind it, spread in 1/64
  grids: optional(stepped(grid, 16), { step: 1, list: [] }),
  chains: optional(stepped(chain, 64), { step: 1, list: [] }),
  kind: optional(kind, null), // of the deformation
  layerRows: optional(rows, []),
});

/** The parameters of a slice's payload, with all counts held against the limits and the payload, and what follows them.
 * rises: one for each row of the layers before, in a later slice none. layerRows: those of the layer, with a row for
 * each rise and each own row. declared: by the slices so far, this one included.
 * @param {Uint8Array} payload @param {number} layer @param {Header} header @param {Before} before */
function readParameters(payload, layer, { width, centres, base }, { declared: before, layer: known }) {
  const where = `layer ${layer}`;
  if (payload.length < 4) throw malformed(`${where}: a payload of ${payload.length} bytes, expected at least 4`);
  const length = new DataView(payload.buffer, payload.byteOffset).getUint32(0, true);
  if (length > 4096) throw limitExceeded(`${where}: parameters of ${length} bytes, limit 4096`);
  const rest = payload.subarray(4 + length);
  if (payload.length < 4 + length) throw malformed(`${where}: the payload ends before ${length} bytes of parameters`);
  const fields = PARAMETERS(unpack(payload.subarray(4, 4 + length), where).value, where);
  const { rows, size, grids, chains, kind } = fields;
  integer(0, MAX_ROWS - before.rows)(rows, `${where}: rows`);
  if (size > rest.length) throw malformed(`${where}: codes of ${size} bytes, expected at most ${rest.length}`);
  const planes = grids.list.flatMap((grid) => grid.planes);
  const linears = chains.list.flatMap(({ network }) => network);
  if ((known || (!layer && base)) && (planes.length || linears.length || kind || fields.layerRows.length)) {
    throw malformed(`${where}: tables or a kind in ${known ? "a later slice" : "a file with a base"}`);
  }
  const layerRows = known?.rowTensors ?? fields.layerRows;
  const cells = planes.reduce((sum, plane) => sum + plane.channels * plane.height * plane.width, 0);
  if (cells > MAX_PLANE_CELLS) throw limitExceeded(`${where}: ${cells} plane samples, limit ${MAX_PLANE_CELLS}`);
  const weights = linears.reduce((sum, { inputs, outputs }) => sum + (inputs + 1) * outputs, 0);
  const rises = known ? 0 : before.rows;
  const symbols = rises + (width + (centres ? 5 : 4)) * rows + widthOf(layerRows) * (rises + rows) + cells + weights;
  const bytes = before.bytes + payload.length;
  const declared = { rows: before.rows + rows, symbols: before.symbols + symbols, bytes };
  integer(0, 2 ** 13 + 2 * bytes)(declared.rows, `${where}: rows in ${bytes} bytes`); // 6.5
  integer(0, 2 ** 22 + 256 * bytes)(declared.symbols, `${where}: symbols in ${bytes} bytes`);
  const parts = { codes: rest.subarray(0, size), stream: rest.subarray(size) };
  return { ...fields, planes, linears, layerRows, rises, declared, ...parts };
}

/**
 * What earlier slices leave to those behind them. classes: the step classes of all rows so far, null if rows have none.
 * layer: what the slices of the same layer before left, null if there are none.
 *
 * @typedef {{declared: Declared, classes: Uint8Array | null, layer: Known | null}} Before
 * @typedef {{rowTensors: RowTensor[], priors: Prior[]}} Known
 */

/**
 * With n rows of its own and E earlier ones, none in a later slice of its layer. Symbols of rows are the values in
 * steps (11.2), those of planes the samples (11.3).
 *
 * @typedef {object} Slice
 * @property {number} layer
 * @property {number[] | null} fill
 * @property {number[] | null} kind of the deformation: its number, then its parameters
 * @property {Grid[]} grids
 * @property {Chain[]} chains
 * @property {RowTensor[]} rowTensors of its layer
 * @property {Declared} declared by the slices so far, this one included
 * @property {Int32Array} voxels [n, 3]
 * @property {Int32Array} rises [E] of the earlier rows' mask codes
 * @property {Int32Array} codes [n] of the mask
 * @property {Int32Array | null} stepClasses [n], null if rows have none
 * @property {Int32Array} rows [W, n]
 * @property {Int32Array} layerRows [channels, E + n] of the layer's own tensors of rows, one behind the other
 * @property {Int32Array[]} planes [C, H, W] each, grid by grid
 * @property {Int32Array[]} weights weight, bias, weight, bias and so on, chain by chain
 * @property {Prior[]} priors of the layer so far (8)
 */

/** A slice's payload, each symbol in the range that 11 allows. @param {Uint8Array} payload @param {number} layer
 * @param {Header} header @param {Before} before @returns {Slice} */
export function decodeSlice(payload, layer, header, before) {
  const parameters = readParameters(payload, layer, header, before);
  const { rows: n, rises: earlier, layerRows: rowTensors, fill, kind, grids, chains, declared } = parameters;
  const priors = [...(before.layer?.priors ?? [])];
  const reader = new ChannelReader(parameters.codes, parameters.stream, priors, declared.symbols + FREE_ENTRIES);
  const voxels = n ? decodePositions(reader, n) : new Int32Array(0);
  const rises = reader.read(earlier, 0, layer ? MOST_CODE : 1, "a rise of a mask code");
  const codes = reader.read(n, LEAST_OWN_CODE, MOST_CODE, "a mask code");
  const stepClasses = header.centres && reader.read(n, 0, STEP_CLASSES - 1, "a step class");
  const rows = decodeRows(reader, header.rows, n, stepClasses, header.centres);
  const classes = stepClasses && new Uint8Array(earlier + n);
  if (earlier && before.classes) classes?.set(before.classes);
  if (stepClasses) classes?.set(stepClasses, earlier);
  const base = before.layer ? 0 : header.base?.rows;
  const layerRows = decodeRows(reader, rowTensors, earlier + n, classes, null, base);
  const planes = decodePlanes(reader, parameters.planes);
  const weights = parameters.linears.flatMap(({ inputs, outputs }) => {
    const sizes = [inputs * outputs, outputs];
    return sizes.map((size) => reader.read(size, -MAX_SYMBOL, MAX_SYMBOL, "a symbol of a chain"));
  });
  reader.finish();
  parameters.planes.forEach((plane, i) => (plane.data = dequantise(planes[i], grids.step)));
  parameters.linears.forEach((linear, i) => {
    [linear.weight, linear.bias] = weights.slice(2 * i).map((symbols) => dequantise(symbols, chains.step));
  });
  const tables = { fill, kind, grids: grids.list, chains: chains.list, rowTensors, declared };
  return { layer, ...tables, voxels, rises, codes, stepClasses, rows, layerRows, planes, weights, priors };
}
