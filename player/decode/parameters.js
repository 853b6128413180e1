// Clause 6: the parameters of a slice and the sections behind them.

import { limitExceeded, malformed } from "./errors.js";
import { Fields, asInteger, asList, asRegistered, checkStep } from "./fields.js";
import { channelCount } from "./header.js";
import { headsOf } from "./heads.js";
import { INSTANTS, MAX_CHANNELS, MAX_FIELDS, MAX_LINEAR_LAYERS, MAX_PAYLOAD } from "./limits.js";
import { MAX_PLANE_CELLS, MAX_ROWS, MAX_SCALES, MAX_SIDE, MAX_WIDTH } from "./limits.js";
import { unpack } from "./msgpack.js";
import { PREDICTORS } from "./planes.js";
import { PLANES } from "./scene.js";

/**
 * The properties of a layer that follow from its number and the header.
 *
 * @typedef {object} LayerKind
 * @property {number} layer
 * @property {[string, number | null][]} networks name and outputs by id; null: any number of outputs
 * @property {number[]} inputs by id, of layer 0's networks
 * @property {number[]} classes of the error bounds of its steps, in their order (5.4)
 * @property {import("./header.js").Widths} widths
 * @property {boolean} stepClasses whether anchors have step classes (11.2)
 */

/** @param {number} layer @param {import("./header.js").Header} header @returns {LayerKind} */
export function layerKind(layer, { widths, centres }) {
  const { feature: D, slots: G, views } = widths;
  /** @type {[string, number | null][]} */
  const networks = [["trunk", null]];
  if (layer === 0) networks.splice(0, 1, ["opacity", G], ["covariance", 7 * G], ["color", 3 * G]);
  else for (const { name, outputs } of headsOf(widths)) networks.push([name, outputs]);
  const classes = layer ? [2 + 2 * layer, 3 + 2 * layer] : [3];
  const inputs = [0, 1, 2].map((id) => D + (views & (1 << id) ? 3 : 0));
  return { layer, networks, inputs, classes, widths, stepClasses: centres !== null };
}

/** Sections of mode ans by number (6.4). */
const SECTIONS = /** @type {const} */ (["positions", "masks", "attributes", "planes", "weights", "symbols"]);
/** The keys of a layer's parameters (6.1). */
const KEYS = [1, 2, 3, 4, 5, 6];

/** @typedef {{name: string, channels: number, height: number, width: number, predictor: number}} PlaneShape */
/** Layers from the input side. @typedef {{name: string, layers: {inputs: number, outputs: number}[]}} NetworkShape */

/**
 * @typedef {object} Parameters
 * @property {number} rows
 * @property {number[]} steps of the weights in layer 0, else of planes and weights; empty without a deformation
 * @property {PlaneShape[][]} scales each with its planes
 * @property {NetworkShape[]} networks
 * @property {number | null} key instant of the deformation, normalised time, if there is one
 * @property {Partial<Record<(typeof SECTIONS)[number], Uint8Array>>} sections
 * @property {Declared} declared by the slices so far, this one included
 */

/** Totals of slices: rows, symbols, bytes of payloads (6.5). scales: the channels of each scale of their planes.
 * @typedef {{rows: number, symbols: number, bytes: number, scales: number[]}} Declared */

/**
 * The parameters of a slice's payload, with its sections; all counts are held against the limits and the payload.
 *
 * @param {Uint8Array} payload @param {LayerKind} kind @param {Declared} before by the slices before
 * @param {boolean} later whether slices of the layer came before: this one holds anchors alone
 * @returns {Parameters}
 */
export function readParameters(payload, kind, before, later) {
  const rises = later ? 0 : before.rows;
  const where = `layer ${kind.layer}`;
  if (payload.length < 4) throw malformed(`${where}: a payload of ${payload.length} bytes, expected at least 4`);
  const length = new DataView(payload.buffer, payload.byteOffset).getUint32(0, true);
  if (length > MAX_FIELDS) throw limitExceeded(`${where}: parameters of ${length} bytes, limit ${MAX_FIELDS}`);
  if (length > payload.length - 4) {
    throw malformed(`${where}: parameters of ${length} bytes, expected at most ${payload.length - 4}`);
  }
  const fields = new Fields(unpack(payload.subarray(4, 4 + length), where).value, where, KEYS);
  const rows = asInteger(fields.get(1), 0, MAX_ROWS - before.rows, `${where}: own rows`);
  const lengths = new Fields(fields.get(2), `${where}: sections`, [...SECTIONS.keys()]);
  if (later) for (const key of [3, 4, 5, 6]) if (fields.has(key)) throw malformed(`${where}: key ${key} in a later slice`);
  const scales = readScales(fields, kind, where, before.scales);
  const networks = later ? [] : readNetworks(fields, kind, where, scales, before.scales);
  const steps = readSteps(fields, kind, where, networks.length > 0);
  const key = readKey(fields, kind, where, networks.length > 0);
  const planes = scales.flat();
  const sections = cutSections(payload, 4 + length, lengths, where);
  const cells = planes.reduce((sum, { channels, height, width }) => sum + channels * height * width, 0);
  const linears = networks.flatMap(({ layers }) => layers);
  const weights = linears.reduce((sum, { inputs, outputs }) => sum + (inputs + 1) * outputs, 0);
  const perRow = channelCount(kind.widths) + (kind.stepClasses ? 1 : 0);
  if (cells > MAX_PLANE_CELLS) throw limitExceeded(`${where}: ${cells} plane cells, limit ${MAX_PLANE_CELLS}`);
  const declared = {
    rows: before.rows + rows,
    symbols: before.symbols + rises + (perRow + 4) * rows + cells + weights,
    bytes: before.bytes + payload.length,
    scales: [...before.scales, ...scales.map(([{ channels }]) => channels)],
  };
  checkDeclared(where, "rows", declared.rows, 2 ** 13, 2, declared.bytes);
  checkDeclared(where, "symbols", declared.symbols, 2 ** 22, 256, declared.bytes);
  const counts = [rows, rises + rows, rows * perRow, cells, weights, 0];
  SECTIONS.forEach((name, i) => {
    if (name in sections !== counts[i] > 0) {
      const found = name in sections ? "present" : "missing";
      throw malformed(`${where}: section ${name} is ${found} for ${counts[i]} symbols`);
    }
  });
  return { rows, steps, scales, networks, key, sections, declared };
}

/** Clause 6.5. @param {string} where @param {string} what @param {number} count @param {number} free
 * @param {number} each @param {number} bytes */
function checkDeclared(where, what, count, free, each, bytes) {
  const most = free + each * bytes;
  if (count > most) throw limitExceeded(`${where}: ${count} ${what} in ${bytes} bytes, limit ${most}`);
}

/** @param {Uint8Array} payload @param {number} at @param {Fields} lengths @param {string} where */
function cutSections(payload, at, lengths, where) {
  /** @type {Parameters["sections"]} */
  const sections = {};
  SECTIONS.forEach((name, number) => {
    if (!lengths.has(number)) return;
    const start = at;
    at += asInteger(lengths.get(number), 1, MAX_PAYLOAD, `${where}: length of section ${name}`);
    sections[name] = payload.subarray(start, at); // shorter if the payload ends: the sum is checked below
  });
  if (at !== payload.length) throw malformed(`${where}: sections up to byte ${at} of a payload of ${payload.length}`);
  return sections;
}

/** Key 3. @param {Fields} fields @param {LayerKind} kind @param {string} where @param {boolean} expected */
function readSteps(fields, kind, where, expected) {
  if (fields.has(3) !== expected) throw malformed(`${where}: steps ${expected ? "are missing" : "without networks"}`);
  if (!expected) return [];
  return fields.reals(3, kind.classes.length, "steps").map((step) => checkStep(step, `${where}: step`));
}

/** Key 6. @param {Fields} fields @param {LayerKind} kind @param {string} where @param {boolean} deformed */
function readKey(fields, kind, where, deformed) {
  if (!fields.has(6)) return null;
  if (!deformed || kind.layer === 0) throw malformed(`${where}: a key instant, expected only in a deformation`);
  return Math.fround(asInteger(fields.get(6), 0, INSTANTS, `${where}: key instant`) / INSTANTS);
}

/** Key 4: the planes of each scale. @param {Fields} fields @param {LayerKind} kind @param {string} where
 * @param {number[]} below channels of each scale of the layers before */
function readScales(fields, kind, where, below) {
  if (!fields.has(4)) return [];
  if (kind.layer === 0) throw malformed(`${where}: planes, expected none`);
  const rows = asList(fields.get(4), `${where}: scales`);
  asInteger(rows.length, 1, MAX_SCALES, `${where}: number of scales`);
  let [expected] = below;
  return rows.map((row) => {
    const entry = asList(row, `${where}: a scale`, 11);
    const channels = asInteger(entry[0], 1, MAX_CHANNELS, `${where}: channels of a scale`);
    const [x, y, z, t] = entry.slice(1, 5).map((side) => asInteger(side, 1, MAX_SIDE, `${where}: side of a plane`));
    const predictors = entry.slice(5).map((p) => asRegistered(p, PREDICTORS, `${where}: predictor`));
    expected ??= channels;
    if (channels !== expected) {
      throw malformed(`${where}: a scale of ${channels} channels, expected ${expected} as in the first scale`);
    }
    const side = { x, y, z, t };
    return PLANES.map((name, i) => ({
      name,
      channels,
      height: side[/** @type {keyof typeof side} */ (name[1])],
      width: side[/** @type {keyof typeof side} */ (name[0])],
      predictor: predictors[i],
    }));
  });
}

/** Key 5. @param {Fields} fields @param {LayerKind} kind @param {string} where @param {PlaneShape[][]} scales
 * @param {number[]} below as in readScales @returns {NetworkShape[]} */
function readNetworks(fields, kind, where, scales, below) {
  const deformation = kind.layer > 0;
  if (!fields.has(5)) {
    if (!deformation || scales.length) throw malformed(`${where}: networks are missing`);
    return [];
  }
  const rows = asList(fields.get(5), `${where}: networks`);
  if (!rows.length) throw malformed(`${where}: an empty list of networks`);
  if (deformation && !scales.length) throw malformed(`${where}: a deformation without planes`);
  let inputs = scales.length && (below.length + scales.length) * scales[0][0].channels;
  let last = -1;
  const networks = rows.map((row) => {
    const [id, ...widths] = asList(row, `${where}: a network`);
    const number = asRegistered(id, kind.networks.length, `${where}: id of a network`);
    if (number <= last) throw malformed(`${where}: network ${number} after ${last}, expected ascending ids`);
    const [name, outputs] = kind.networks[number];
    if (deformation && last < 0 && number > 0) throw malformed(`${where}: no trunk, expected one`);
    last = number;
    asInteger(widths.length, 1, MAX_LINEAR_LAYERS, `${where}: linear layers of ${name}`);
    let width = deformation ? inputs : kind.inputs[number];
    const layers = widths.map((value) => {
      const layer = { inputs: width, outputs: asInteger(value, 1, MAX_WIDTH, `${where}: width of ${name}`) };
      width = layer.outputs;
      return layer;
    });
    if (outputs === null) inputs = width; // the heads take the trunk's outputs
    else if (width !== outputs) throw malformed(`${where}: ${width} outputs of ${name}, expected ${outputs}`);
    return { name, layers };
  });
  const least = deformation ? 2 : kind.networks.length;
  if (networks.length < least) throw malformed(`${where}: ${networks.length} networks, expected at least ${least}`);
  return networks;
}
