// Clause 5: the header.

import { sceneIdOf } from "./container.js";
import { malformed, unsupported } from "./errors.js";
import { Fields, asInteger, asList, asRegistered, checkBytes, checkStep } from "./fields.js";
import { MAX_CHUNKS, MAX_FEATURE, MAX_PAYLOAD, MAX_SLOTS, MAX_SYMBOL } from "./limits.js";
import { unpack } from "./msgpack.js";
/** @import { Value } from "./msgpack.js" */

/** @typedef {{type: number, length: number}} ListedChunk */

/** D, scalars of a feature, G, Gaussians of an anchor, and V, bit i: network i of layer 0 takes the view direction.
 * @typedef {{feature: number, slots: number, views: number}} Widths */

/**
 * @typedef {object} Header
 * @property {ListedChunk[]} chunks
 * @property {[number, number, number]} steps of feature, scaling_log and offset
 * @property {import("./scene.js").Info} info
 * @property {Map<number, number>} bounds the error bound of each class of 5.4 that has one
 * @property {Widths} widths
 * @property {number[] | null} centres of the attributes' channels; null if anchors have no step classes
 * @property {string} sceneId hexadecimal (3.3)
 */

/** The channels of an anchor (11.2). @param {Pick<Widths, "feature" | "slots">} widths */
export const channelCount = ({ feature, slots }) => feature + 6 + 3 * slots;

/** How many layer types there are: 0, 1 and 2. */
export const LAYER_TYPES = 3;

/** The keys of a header (5.1), and of a camera. */
const KEYS = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];
const CAMERA_KEYS = [1, 2, 3, 4];
const CLASSES = [0, 1, 2, 3, 4, 5, 6, 7];
/** The error bounds that every file has: of the attributes and of layer 0's weights. */
const REQUIRED_CLASSES = 4;
const DIGEST_SIZE = 16;
const MAX_CAMERA_SIDE = 65535;
const MAX_VIEWS = 7;

/** @param {Uint8Array} bytes @returns {Header} */
export function readHeader(bytes) {
  const { value, firstEntryEnd } = unpack(bytes, "header");
  const fields = new Fields(value, "header", KEYS);
  const chunks = readChunkList(fields);
  const mode = asRegistered(fields.get(2), 2, "header: mode");
  const [feature, scalingLog, offset] = fields.reals(4, 3, "steps").map((step) => checkStep(step, "header: step"));
  const voxelSize = checkStep(fields.real(5, "voxel size"), "header: voxel size");
  const [x0, y0, z0, x1, y1, z1] = fields.reals(6, 6, "box");
  if (x0 > x1 || y0 > y1 || z0 > z1) throw malformed("header: a lower corner of the box lies above the upper one");
  const [start, end] = fields.reals(7, 2, "times");
  if (end < start) throw malformed(`header: times ${start} and ${end}, expected ascending ones`);
  const [red, green, blue] = fields.reals(8, 3, "background");
  if (![red, green, blue].every((c) => c >= 0 && c <= 1)) {
    throw malformed(`header: background ${red} ${green} ${blue}, expected 0..1`);
  }
  const [near, far] = fields.reals(9, 2, "near and far");
  if (!(near >= 0 && near < far)) throw malformed(`header: near ${near} and far ${far}, expected 0 <= near < far`);
  const [upX, upY, upZ] = fields.reals(10, 3, "up");
  const unit = fields.real(11, "unit");
  if (unit < 0) throw malformed(`header: unit ${unit}, expected 0 or more`);
  const camera = fields.has(12) ? readCamera(fields.get(12)) : null;
  const bounds = readBounds(fields.get(13));
  checkBytes(fields.get(14), DIGEST_SIZE, "header: digest"); // of all layers, so that a decoder of some cannot check it
  const [width, count, views] = asList(fields.get(15), "header: widths", 3);
  const widths = {
    feature: asInteger(width, 1, MAX_FEATURE, "header: feature width"),
    slots: asInteger(count, 1, MAX_SLOTS, "header: slots"),
    views: asInteger(views, 0, MAX_VIEWS, "header: networks that take the view direction"),
  };
  const centres = fields.has(3) ? readCentres(fields.get(3), channelCount(widths)) : null;
  const layers = chunks.filter(({ type }) => type < LAYER_TYPES).map(({ type }) => type);
  if (mode === 1 && new Set(layers).size < layers.length) throw malformed("header: mode lzma, and a layer in slices");
  if (mode === 1) throw unsupported("header: mode lzma, expected mode ans"); // an ans-only decoder (clause 16)
  return {
    chunks,
    steps: [feature, scalingLog, offset],
    info: {
      voxelSize,
      box: [[x0, y0, z0], [x1, y1, z1]],
      timeRange: [start, end],
      background: [red, green, blue],
      near,
      far,
      up: [upX, upY, upZ],
      unit,
      camera,
    },
    bounds,
    widths,
    centres,
    sceneId: sceneIdOf(bytes.subarray(firstEntryEnd)),
  };
}

/** @param {Fields} header @returns {ListedChunk[]} */
function readChunkList(header) {
  const rows = asList(header.get(1), "header: chunk list");
  asInteger(rows.length, 1, MAX_CHUNKS, "header: number of chunks");
  const chunks = rows.map((row) => {
    const [type, length] = asList(row, "header: a chunk of the list", 2);
    return {
      type: asInteger(type, 0, 65535, "header: type of a chunk"),
      length: asInteger(length, 0, MAX_PAYLOAD, "header: length of a chunk"),
    };
  });
  let last = -1;
  for (const { type } of chunks) {
    if (type >= LAYER_TYPES) continue;
    if (type < last) throw malformed(`header: layer ${type} after layer ${last}, expected ascending ones`);
    last = type;
  }
  if (chunks[0].type !== 0) throw malformed(`header: the first chunk is of type ${chunks[0].type}, expected layer 0`);
  return chunks;
}

/** @param {Value} value @returns {import("./scene.js").Camera} */
function readCamera(value) {
  const fields = new Fields(value, "header: camera", CAMERA_KEYS);
  const rows = fields.reals(1, 12, "matrix");
  const [fx, fy, cx, cy] = fields.reals(2, 4, "intrinsics");
  if (!(fx > 0 && fy > 0)) throw malformed(`header: camera: focal lengths ${fx} and ${fy}, expected positive ones`);
  return {
    viewmat: Float32Array.from([...rows, 0, 0, 0, 1]),
    K: Float32Array.from([fx, 0, cx, 0, fy, cy, 0, 0, 1]),
    width: asInteger(fields.get(3), 1, MAX_CAMERA_SIDE, "header: camera: width"),
    height: asInteger(fields.get(4), 1, MAX_CAMERA_SIDE, "header: camera: height"),
  };
}

/** @param {Value} value @param {number} count */
function readCentres(value, count) {
  const centres = asList(value, "header: centres", count);
  return centres.map((m) => asInteger(m, -MAX_SYMBOL, MAX_SYMBOL, "header: a channel's centre"));
}

/** @param {Value} value @returns {Map<number, number>} */
function readBounds(value) {
  const fields = new Fields(value, "header: error bounds", CLASSES);
  /** @type {Map<number, number>} */
  const bounds = new Map();
  for (const i of CLASSES) {
    if (i >= REQUIRED_CLASSES && !fields.has(i)) continue;
    const bound = fields.real(i, `class ${i}`);
    if (bound < 0) throw malformed(`header: error bound ${bound} of class ${i}, expected 0 or more`);
    bounds.set(i, bound);
  }
  return bounds;
}
