// Clause 6: the parameters of a slice, and the shapes of the tensors that it codes.

import { limitExceeded, malformed } from "./errors.js";
import { Fields, asInteger, asIntegers, asItems, asList, asRegistered, asStep, asTensors } from "./fields.js";
import { readKind, readRows } from "./header.js";
import { MAX_AXES, MAX_CHAINS, MAX_CHANNELS, MAX_FIELDS, MAX_GRIDS } from "./limits.js";
import { MAX_LINEAR_LAYERS, MAX_PAYLOAD, MAX_PLANE_CELLS, MAX_ROWS, MAX_SIDE, MAX_WIDTH } from "./limits.js";
import { unpack } from "./msgpack.js";
import { PREDICTORS } from "./grids.js";
import { widthOf } from "./rows.js";
/** @import { Value } from "./msgpack.js" */
/** @import { RowTensor } from "./tensors.js" */

/** The keys of a slice's parameters (6.2), and those that a later slice of a layer lacks, and layer 0 over a base. */
const KEYS = [1, 2, 3, 4, 5, 6, 7];
const FIRST_KEYS = [4, 5, 6, 7];

/** @typedef {{channels: number, height: number, width: number, predictor: number}} PlaneShape */
/** @typedef {{id: number, channels: number, sides: number[], planes: PlaneShape[]}} GridShape */
/** linears: from the input side. @typedef {{id: number, linears: {inputs: number, outputs: number}[]}} ChainShape */

/** Tensors of one form and their step. @template T @typedef {{step: number, list: T[]}} Stepped */

/** Totals of slices (6.5): rows, symbols, bytes of payloads. @typedef {{rows: number, symbols: number, bytes: number}}
 * Declared */

/**
 * @typedef {object} Parameters
 * @property {number} rows
 * @property {number} rises one for each row of the layers before, in a later slice none
 * @property {number[] | null} fill the colour behind a prefix that ends here, 0..255, and its spread in units of 1/64
 * @property {Stepped<GridShape>} grids
 * @property {Stepped<ChainShape>} chains
 * @property {number[] | null} kind of the deformation: its number, then its parameters
 * @property {RowTensor[]} layerRows those of the layer, with a row for each rise and each own row
 * @property {Uint8Array} codes
 * @property {Uint8Array} stream
 * @property {Declared} declared by the slices so far, this one included
 */

/**
 * The parameters of a slice's payload; all counts are held against the limits and the payload.
 *
 * @param {Uint8Array} payload @param {Pick<import("./header.js").Header, "width" | "centres" | "base">} header
 * @param {Declared} before by the slices before @param {RowTensor[] | null} known the layer's own tensors of rows if slices
 * of it came before: this one holds rows alone @param {number} layer
 * @returns {Parameters}
 */
export function readParameters(payload, { width, centres, base }, before, known, layer) {
  const where = `layer ${layer}`;
  if (payload.length < 4) throw malformed(`${where}: a payload of ${payload.length} bytes, expected at least 4`);
  const length = new DataView(payload.buffer, payload.byteOffset).getUint32(0, true);
  if (length > MAX_FIELDS) throw limitExceeded(`${where}: parameters of ${length} bytes, limit ${MAX_FIELDS}`);
  const rest = payload.length - 4 - length;
  if (rest < 0) throw malformed(`${where}: parameters of ${length} bytes, expected at most ${payload.length - 4}`);
  const fields = new Fields(unpack(payload.subarray(4, 4 + length), where).value, where, KEYS);
  const rows = asInteger(fields.get(1), 0, MAX_ROWS - before.rows, `${where}: own rows`);
  const size = asInteger(fields.get(2), 0, MAX_PAYLOAD, `${where}: length of the codes`);
  if (size > rest) throw malformed(`${where}: codes of ${size} bytes, expected at most ${rest}`);
  const place = known ? "a later slice" : !layer && base ? "a file with a base" : null;
  for (const key of FIRST_KEYS) if (place && fields.has(key)) throw malformed(`${where}: key ${key} in ${place}`);
  const grids = readStepped(fields, 4, MAX_GRIDS, `${where}: a grid`, readGrid);
  const chains = readStepped(fields, 5, MAX_CHAINS, `${where}: a chain`, readChain);
  const layerRows = known ?? (fields.has(7) ? readRows(fields.get(7), where) : []);
  const planes = grids.list.flatMap((grid) => grid.planes);
  const linears = chains.list.flatMap((chain) => chain.linears);
  const cells = planes.reduce((sum, plane) => sum + plane.channels * plane.height * plane.width, 0);
  if (cells > MAX_PLANE_CELLS) throw limitExceeded(`${where}: ${cells} plane samples, limit ${MAX_PLANE_CELLS}`);
  const weights = linears.reduce((sum, { inputs, outputs }) => sum + (inputs + 1) * outputs, 0);
  const rises = known ? 0 : before.rows;
  const own = (width + (centres ? 5 : 4)) * rows;
  const symbols = rises + own + widthOf(layerRows) * (rises + rows) + cells + weights;
  const declared = {
    rows: before.rows + rows,
    symbols: before.symbols + symbols,
    bytes: before.bytes + payload.length,
  };
  checkDeclared(where, "rows", declared.rows, 2 ** 13, 2, declared.bytes);
  checkDeclared(where, "symbols", declared.symbols, 2 ** 22, 256, declared.bytes);
  const fill = `${where}: fill`;
  return {
    rows,
    rises,
    fill: fields.has(3) ? asIntegers(asItems(fields.get(3), 3, 4, fill), 0, 255, fill) : null,
    grids,
    chains,
    kind: fields.has(6) ? readKind(fields.get(6), `${where}: kind of the deformation`) : null,
    layerRows,
    codes: payload.subarray(4 + length, 4 + length + size),
    stream: payload.subarray(4 + length + size),
    declared,
  };
}

/** Clause 6.5. @param {string} where @param {string} what @param {number} count @param {number} free
 * @param {number} each @param {number} bytes */
function checkDeclared(where, what, count, free, each, bytes) {
  const most = free + each * bytes;
  if (count > most) throw limitExceeded(`${where}: ${count} ${what} in ${bytes} bytes, limit ${most}`);
}

/**
 * A list of a step and shapes, which may be absent.
 *
 * @template T
 * @param {Fields} fields @param {number} key @param {number} limit of shapes @param {string} where
 * @param {(id: number, rest: Value[], where: string) => T} read
 * @returns {Stepped<T>}
 */
function readStepped(fields, key, limit, where, read) {
  if (!fields.has(key)) return { step: 0, list: [] };
  const [step, ...shapes] = asItems(fields.get(key), 2, 1 + limit, `${where} of key ${key}`);
  return { step: asStep(step, `${where}: step`), list: asTensors(shapes, where, read) };
}

/** @param {number} id @param {Value[]} rest @param {string} where @returns {GridShape} */
function readGrid(id, rest, where) {
  const [channelCount, sideList, predictorList] = asList(rest, where, 3);
  const channels = asInteger(channelCount, 1, MAX_CHANNELS, `${where}: channels`);
  const sides = asIntegers(asItems(sideList, 1, MAX_AXES, `${where}: sides`), 1, MAX_SIDE, `${where}: a side`);
  // a grid of one side is a plane of one row
  const pairs = sides.length === 1 ? [[sides[0], 1]] : sides.flatMap((a, i) => sides.slice(i + 1).map((b) => [a, b]));
  const predictors = asList(predictorList, `${where}: predictors`, pairs.length);
  const planes = pairs.map(([width, height], i) => {
    const predictor = asRegistered(predictors[i], PREDICTORS, `${where}: predictor`);
    return { channels, height, width, predictor };
  });
  return { id, channels, sides, planes };
}

/** @param {number} id @param {Value[]} rest @param {string} where @returns {ChainShape} */
function readChain(id, rest, where) {
  const widths = asIntegers(asItems(rest, 2, 1 + MAX_LINEAR_LAYERS, `${where}: widths`), 1, MAX_WIDTH, `${where}: a width`);
  return { id, linears: widths.slice(1).map((outputs, i) => ({ inputs: widths[i], outputs })) };
}
