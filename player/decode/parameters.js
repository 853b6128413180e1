// Clause 6: the parameters of a slice, and the shapes of the tensors that it codes.

import { limitExceeded, malformed } from "./errors.js";
import { anything, id, integer, kind, list, map, optional, record, registered } from "./fields.js";
import { rows, step, tensors, widthOf } from "./fields.js";
import { MAX_AXES, MAX_CHAINS, MAX_CHANNELS, MAX_FIELDS, MAX_GRIDS } from "./limits.js";
import { MAX_LINEAR_LAYERS, MAX_PAYLOAD, MAX_PLANE_CELLS, MAX_ROWS, MAX_SIDE, MAX_WIDTH } from "./limits.js";
import { unpack } from "./msgpack.js";
/** @import { Read } from "./fields.js" */
/** @import { Header } from "./header.js" */
/** @import { RowTensor } from "./tensors.js" */

/** @typedef {{channels: number, height: number, width: number, predictor: number}} PlaneShape */
/** @typedef {{id: number, channels: number, sides: number[], planes: PlaneShape[]}} GridShape */
/** linears: from the input side. @typedef {{id: number, linears: {inputs: number, outputs: number}[]}} ChainShape */

/** Totals of slices (6.5): rows, symbols, bytes of payloads. @typedef {{rows: number, symbols: number, bytes: number}}
 * Declared */

/** How many predictors of planes 11.3 has. */
const PREDICTORS = 2;

const GRID = record({
  id,
  channels: integer(1, MAX_CHANNELS),
  sides: list(integer(1, MAX_SIDE), 1, MAX_AXES),
  predictors: list(registered(PREDICTORS), 0, Infinity),
});

/** @type {Read<GridShape>} */
const grid = (value, where) => {
  const { predictors, ...shape } = GRID(value, where);
  const { channels, sides } = shape;
  // a grid of one side is a plane of one row
  const pairs = sides.length === 1 ? [[sides[0], 1]] : sides.flatMap((a, i) => sides.slice(i + 1).map((b) => [a, b]));
  if (predictors.length !== pairs.length) {
    throw malformed(`${where}: ${predictors.length} predictors, expected ${pairs.length}`);
  }
  const planes = pairs.map(([width, height], i) => ({ channels, height, width, predictor: predictors[i] }));
  return { ...shape, planes };
};

const CHAIN = list(integer(-Infinity, Infinity), 3, 2 + MAX_LINEAR_LAYERS);

/** @type {Read<ChainShape>} */
const chain = (value, where) => {
  const [first, ...rest] = CHAIN(value, where);
  const widths = rest.map((width) => integer(1, MAX_WIDTH)(width, `${where}: a width`));
  return { id: id(first, where), linears: widths.slice(1).map((outputs, i) => ({ inputs: widths[i], outputs })) };
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
  fill: optional(list(integer(0, 255), 3), null), // the colour behind a prefix that ends here
  grids: optional(stepped(grid, MAX_GRIDS), { step: 0, list: [] }),
  chains: optional(stepped(chain, MAX_CHAINS), { step: 0, list: [] }),
  kind: optional(kind, null), // of the deformation
  layerRows: optional(rows, []),
});

/** @typedef {ReturnType<typeof readParameters>} Parameters */

/**
 * The parameters of a slice's payload; all counts are held against the limits and the payload. rises: one for each row
 * of the layers before, in a later slice none. layerRows: those of the layer, with a row for each rise and own row.
 * declared: by the slices so far, this one included.
 *
 * @param {Uint8Array} payload @param {Pick<Header, "width" | "centres" | "base">} header
 * @param {Declared} before by the slices before @param {RowTensor[] | null} known the layer's own tensors of rows if
 * slices of it came before: this one holds rows alone @param {number} layer
 */
export function readParameters(payload, { width, centres, base }, before, known, layer) {
  const where = `layer ${layer}`;
  if (payload.length < 4) throw malformed(`${where}: a payload of ${payload.length} bytes, expected at least 4`);
  const length = new DataView(payload.buffer, payload.byteOffset).getUint32(0, true);
  if (length > MAX_FIELDS) throw limitExceeded(`${where}: parameters of ${length} bytes, limit ${MAX_FIELDS}`);
  const rest = payload.length - 4 - length;
  if (rest < 0) throw malformed(`${where}: parameters of ${length} bytes, expected at most ${payload.length - 4}`);
  const { size, layerRows: own, ...fields } = PARAMETERS(unpack(payload.subarray(4, 4 + length), where).value, where);
  const { rows, grids, chains, kind } = fields;
  integer(0, MAX_ROWS - before.rows)(rows, `${where}: rows`);
  if (size > rest) throw malformed(`${where}: codes of ${size} bytes, expected at most ${rest}`);
  if ((known || (!layer && base)) && (grids.list.length || chains.list.length || kind || own.length)) {
    const place = known ? "a later slice" : "a file with a base";
    throw malformed(`${where}: grids, chains, a kind or layer rows in ${place}`);
  }
  const layerRows = known ?? own;
  const cells = grids.list.reduce((sum, { planes }) => {
    return planes.reduce((cells, plane) => cells + plane.channels * plane.height * plane.width, sum);
  }, 0);
  const linears = chains.list.flatMap((chain) => chain.linears);
  if (cells > MAX_PLANE_CELLS) throw limitExceeded(`${where}: ${cells} plane samples, limit ${MAX_PLANE_CELLS}`);
  const weights = linears.reduce((sum, { inputs, outputs }) => sum + (inputs + 1) * outputs, 0);
  const rises = known ? 0 : before.rows;
  const symbols = rises + (width + (centres ? 5 : 4)) * rows + widthOf(layerRows) * (rises + rows) + cells + weights;
  const declared = {
    rows: before.rows + rows,
    symbols: before.symbols + symbols,
    bytes: before.bytes + payload.length,
  };
  // 6.5
  integer(0, 2 ** 13 + 2 * declared.bytes)(declared.rows, `${where}: rows in ${declared.bytes} bytes`);
  integer(0, 2 ** 22 + 256 * declared.bytes)(declared.symbols, `${where}: symbols in ${declared.bytes} bytes`);
  const codes = payload.subarray(4 + length, 4 + length + size);
  return { ...fields, rises, layerRows, codes, stream: payload.subarray(4 + length + size), declared };
}
