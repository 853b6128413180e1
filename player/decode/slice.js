// Clauses 6 and 11: one slice's payload, to its parameters and the values of its tensors.

import { ChannelReader } from "./channels.js";
import { limitExceeded, malformed } from "./errors.js";
import { anything, id, integer, kind, list, map, optional, record, registered } from "./fields.js";
import { rows, step, tensors, widthOf } from "./fields.js";
import { decodeGrids } from "./grids.js";
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
const LEAST_OWN_CODE = 3;
const MOST_CODE = 255;

const GRID = record({
  id,
  channels: integer(1, MAX_CHANNELS),
  sides: list(integer(1, 4096), 1, 4),
  predictors: list(registered(2), 0, Infinity),
});

/** @type {Read<Omit<Grid, "step">>} */
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

/** @type {Read<Omit<Chain, "step">>} */
const chain = (value, where) => {
  const [first, ...rest] = list(anything, 3, 18)(value, where);
  const widths = rest.map((width) => integer(1, 4096)(width, `${where}: width`));
  const network = widths.slice(1).map((outputs, i) => ({ weight: NONE, bias: NONE, inputs: widths[i], outputs }));
  return { id: id(first, where), network };
};

/** Tensors behind the step of all of them. @template {{id: number}} T @param {Read<T>} read @param {number} limit
 * @returns {Read<(T & {step: number})[]>} */
const stepped = (read, limit) => (value, where) => {
  const [first, ...rest] = list(anything, 2, 1 + limit)(value, where);
  const common = { step: step(first, where) };
  return tensors(read, limit)(rest, where).map((one) => ({ ...one, ...common }));
};

const PARAMETERS = map([1, 2, 3, 4, 5, 6, 7], {
  rows: integer(0, MAX_ROWS),
  size: integer(0, MAX_PAYLOAD), // of the codes
  fill: optional(list(integer(0, 255), 3, 4), null), // of a prefix that ends here: colour behind it, spread in 1/64
  grids: optional(stepped(grid, 16), []),
  chains: optional(stepped(chain, 64), []),
  kind: optional(kind, null), // of the deformation: its number, then its parameters
  layerRows: optional(rows, []),
});

/**
 * What earlier slices leave to those behind them. codes: the mask codes of the layers before. classes: the step classes
 * of all rows so far, null if rows have none. layer: what the slices of the same layer before left, null if there are
 * none.
 *
 * @typedef {{declared: Declared, codes: Uint8Array, classes: Uint8Array | null, layer: Known | null}} Before
 * @typedef {{rowTensors: RowTensor[], priors: Prior[]}} Known
 */

/** The parameters of a slice's payload, with all counts held against the limits and the payload, and what follows them.
 * earlier: rows of the layers before, in a later slice none. rowTensors: those of the layer, with a row for each of
 * these and each own one. declared: by the slices so far, this one included.
 * @param {Uint8Array} payload @param {number} layer @param {Header} header @param {Before} before */
function readParameters(payload, layer, { width, centres, base }, { declared: before, layer: known }) {
  const where = `layer ${layer}`;
  if (payload.length < 4) throw malformed(`${where}: a payload of ${payload.length} bytes, expected at least 4`);
  const length = new DataView(payload.buffer, payload.byteOffset).getUint32(0, true);
  if (length > 4096) throw limitExceeded(`${where}: parameters of ${length} bytes, limit 4096`);
  const rest = payload.subarray(4 + length);
  if (payload.length < 4 + length) throw malformed(`${where}: the payload ends before ${length} bytes of parameters`);
  const fields = PARAMETERS(unpack(payload.subarray(4, 4 + length), where).value, where);
  const { rows, size, fill, grids, chains, kind } = fields;
  integer(0, MAX_ROWS - before.rows)(rows, `${where}: rows`);
  if (size > rest.length) throw malformed(`${where}: codes of ${size} bytes, expected at most ${rest.length}`);
  if ((known || (!layer && base)) && (grids.length || chains.length || kind || fields.layerRows.length)) {
    throw malformed(`${where}: tables or a kind in ${known ? "a later slice" : "a file with a base"}`);
  }
  const rowTensors = known?.rowTensors ?? fields.layerRows;
  let cells = 0;
  for (const { planes } of grids) for (const { channels, height, width } of planes) cells += channels * height * width;
  if (cells > MAX_PLANE_CELLS) throw limitExceeded(`${where}: ${cells} plane samples, limit ${MAX_PLANE_CELLS}`);
  let weights = 0;
  for (const { network } of chains) for (const { inputs, outputs } of network) weights += (inputs + 1) * outputs;
  const earlier = known ? 0 : before.rows;
  const own = widthOf(rowTensors);
  const ofRows = (width + (centres ? 5 : 4) + own) * rows + (1 + own) * earlier;
  const bytes = before.bytes + payload.length;
  const declared = { rows: before.rows + rows, symbols: before.symbols + ofRows + cells + weights, bytes };
  integer(0, 2 ** 13 + 2 * bytes)(declared.rows, `${where}: rows in ${bytes} bytes`); // 6.5
  integer(0, 2 ** 22 + 256 * bytes)(declared.symbols, `${where}: symbols in ${bytes} bytes`);
  const [red, green, blue, spread = 0] = fill ?? [];
  const look = { fill: fill && [red, green, blue].map((c) => c / 255), spread: 1 + spread / 64 };
  const packed = /** @type {const} */ ([rest.subarray(0, size), rest.subarray(size)]); // codes and stream
  return { rows, earlier, ...look, kind, grids, chains, rowTensors, declared, packed };
}

/** A slice's payload: its parameters, with filled grids and chains, and its columns.
 *
 * priors: of the layer so far (8). columns: voxels, positions, the header's tensors of its own rows and their step
 * classes if there are; then for the earlier rows too, of which later slices of a layer have none, the mask codes and
 * the layer's own tensors.
 * @param {Uint8Array} payload @param {number} layer @param {Header} header @param {Before} before */
export function decodeSlice(payload, layer, header, before) {
  const { packed, ...parameters } = readParameters(payload, layer, header, before);
  const { rows: n, earlier, grids, chains, rowTensors, declared } = parameters;
  const priors = [...(before.layer?.priors ?? [])];
  const reader = new ChannelReader(...packed, priors, declared.symbols + FREE_ENTRIES);
  const voxels = n ? decodePositions(reader, n) : new Int32Array(0);
  const rises = reader.read(earlier, 0, layer ? MOST_CODE : 1, "a rise of a mask code");
  const masks = reader.read(n, LEAST_OWN_CODE, MOST_CODE, "a mask code");
  const classes = header.centres && new Uint8Array(earlier + n);
  if (classes) {
    classes.set(/** @type {Uint8Array} */ (before.classes).subarray(0, earlier));
    classes.set(reader.read(n, 0, STEP_CLASSES - 1, "a step class"), earlier);
  }
  const own = classes?.subarray(earlier) ?? null;
  const rows = decodeRows(reader, header.rows, n, own, header.centres);
  const base = before.layer ? 0 : header.base?.rows;
  const layerRows = decodeRows(reader, rowTensors, earlier + n, classes, null, base);
  decodeGrids(reader, grids);
  for (const { network, step } of chains) {
    for (const linear of network) {
      const sizes = [linear.inputs * linear.outputs, linear.outputs];
      [linear.weight, linear.bias] = sizes.map((size) => {
        return dequantise(reader.read(size, -MAX_SYMBOL, MAX_SYMBOL, "a symbol of a chain"), step);
      });
    }
  }
  reader.finish();
  const codes = new Uint8Array(earlier + n);
  for (let i = 0; i < earlier; i++) {
    const code = layer ? before.codes[i] + rises[i] : before.codes[i] * (1 - rises[i]);
    if (code > MOST_CODE || (code && code < LEAST_OWN_CODE)) {
      throw malformed(`layer ${layer}: a mask code of ${code}, expected 0 or ${LEAST_OWN_CODE}..${MOST_CODE}`);
    }
    codes[i] = code;
  }
  codes.set(masks, earlier);
  const positions = dequantise(voxels, header.info.voxelSize);
  const columns = [voxels, positions, ...rows, ...(own ? [own] : []), codes, ...layerRows];
  return { ...parameters, priors, voxels, columns };
}
