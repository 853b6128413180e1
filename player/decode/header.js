// Clause 5: the header.

import { SCENE_ID_SIZE, sceneIdOf } from "./container.js";
import { hex } from "./digests.js";
import { limitExceeded, malformed, unsupported } from "./errors.js";
import { Fields, asInteger, asIntegers, asItems, asList, asRegistered, asStep, asTensors, checkBytes } from "./fields.js";
import { MAX_CHANNELS, MAX_CHUNKS, MAX_KIND, MAX_PAYLOAD, MAX_ROWS } from "./limits.js";
import { MAX_ROW_CHANNELS, MAX_ROW_TENSORS, MAX_SYMBOL } from "./limits.js";
import { unpack } from "./msgpack.js";
import { ROW_PREDICTORS, widthOf } from "./rows.js";
/** @import { Value } from "./msgpack.js" */
/** @import { Camera, Info, RowTensor } from "./tensors.js" */

/** @typedef {{type: number, length: number}} ListedChunk */

/** What a file says of its base (5.6): its scene id and digest in hexadecimal, its rows, the bytes of the digest.
 * @typedef {{sceneId: string, digest: string, rows: number, bytes: number}} Reference */

/**
 * @typedef {object} Header
 * @property {ListedChunk[]} chunks
 * @property {number[]} kind of the scene: its number, then its parameters
 * @property {RowTensor[]} rows
 * @property {number} width W, the channels of all tensors of rows
 * @property {number[] | null} centres of these channels; null if anchors have no step classes
 * @property {Info} info
 * @property {string} sceneId hexadecimal (3.3)
 * @property {Reference | null} base null: the file holds its scene whole
 */

/** How many layer types there are: 0, 1 and 2. */
export const LAYER_TYPES = 3;

/** The keys of a header (5.1), and of a camera. */
const KEYS = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];
const CAMERA_KEYS = [1, 2, 3, 4];
const DIGEST_SIZE = 16;
const BASE_DIGEST_SIZE = 32;
const MAX_CAMERA_SIDE = 65535;

/** @param {Uint8Array} bytes @returns {Header} */
export function readHeader(bytes) {
  const { value, firstEntryEnd } = unpack(bytes, "header");
  const fields = new Fields(value, "header", KEYS);
  const chunks = readChunkList(fields.get(1));
  const mode = asRegistered(fields.get(2), 2, "header: mode");
  const kind = readKind(fields.get(3), "header: kind of the scene");
  const rows = readRows(fields.get(4), "header");
  const width = widthOf(rows);
  const where = "header: centres";
  const centres = fields.has(5) ? asIntegers(asList(fields.get(5), where, width), -MAX_SYMBOL, MAX_SYMBOL, where) : null;
  const info = readInfo(fields);
  checkBytes(fields.get(14), DIGEST_SIZE, "header: digest"); // of all layers, so that a decoder of some cannot check it
  const base = fields.has(15) ? readReference(fields.get(15)) : null;
  if (mode === 1) throw unsupported("header: mode lzma, expected mode ans"); // an ans-only decoder (clause 16)
  return { chunks, kind, rows, width, centres, info, sceneId: sceneIdOf(bytes.subarray(firstEntryEnd)), base };
}

/** @param {Value} value @returns {Reference} */
function readReference(value) {
  const [sceneId, digest, rows, bytes] = asList(value, "header: base", 4);
  return {
    sceneId: hex(checkBytes(sceneId, SCENE_ID_SIZE, "header: scene id of the base")),
    digest: hex(checkBytes(digest, BASE_DIGEST_SIZE, "header: digest of the base")),
    rows: asInteger(rows, 0, MAX_ROWS, "header: rows of the base"),
    bytes: asInteger(bytes, 1, MAX_PAYLOAD, "header: bytes of the base"),
  };
}

/** A kind's number and parameters, whatever they mean. @param {Value} value @param {string} where */
export const readKind = (value, where) => asIntegers(asItems(value, 1, MAX_KIND, where), 0, 65535, where);

/** @param {Value} value @returns {ListedChunk[]} */
function readChunkList(value) {
  const chunks = asItems(value, 1, MAX_CHUNKS, "header: chunk list").map((row) => {
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

/** Tensors of rows of the header or of a layer. @param {Value} value @param {string} place @returns {RowTensor[]} */
export function readRows(value, place) {
  const table = asItems(value, 1, MAX_ROW_TENSORS, `${place}: rows`);
  const rows = asTensors(table, `${place}: a tensor of rows`, (id, rest, where) => {
    const [channels, step, predictor] = asList(rest, where, 3);
    return {
      id,
      channels: asInteger(channels, 1, MAX_CHANNELS, `${where}: channels`),
      step: asStep(step, `${where}: step`),
      predictor: asRegistered(predictor, ROW_PREDICTORS, `${where}: predictor`),
    };
  });
  const width = widthOf(rows);
  if (width > MAX_ROW_CHANNELS) throw limitExceeded(`${place}: rows of ${width} channels, limit ${MAX_ROW_CHANNELS}`);
  return rows;
}

/** @param {Fields} fields @returns {Info} */
function readInfo(fields) {
  const voxelSize = asStep(fields.get(6), "header: voxel size");
  const [x0, y0, z0, x1, y1, z1] = fields.reals(7, 6, "box");
  if (x0 > x1 || y0 > y1 || z0 > z1) throw malformed("header: a lower corner of the box lies above the upper one");
  const [start, end] = fields.reals(8, 2, "times");
  if (end < start) throw malformed(`header: times ${start} and ${end}, expected ascending ones`);
  const [red, green, blue] = fields.reals(9, 3, "background");
  if (![red, green, blue].every((c) => c >= 0 && c <= 1)) {
    throw malformed(`header: background ${red} ${green} ${blue}, expected 0..1`);
  }
  const [near, far] = fields.reals(10, 2, "near and far");
  if (!(near >= 0 && near < far)) throw malformed(`header: near ${near} and far ${far}, expected 0 <= near < far`);
  const [upX, upY, upZ] = fields.reals(11, 3, "up");
  const unit = fields.real(12, "unit");
  if (unit < 0) throw malformed(`header: unit ${unit}, expected 0 or more`);
  return {
    voxelSize,
    box: [[x0, y0, z0], [x1, y1, z1]],
    timeRange: [start, end],
    background: [red, green, blue],
    near,
    far,
    up: [upX, upY, upZ],
    unit,
    camera: fields.has(13) ? readCamera(fields.get(13)) : null,
  };
}

/** @param {Value} value @returns {Camera} */
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
