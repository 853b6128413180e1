// Clause 5: the header.

import { hex, sha256 } from "./digests.js";
import { malformed, unsupported } from "./errors.js";
import { bytes, integer, kind, list, map, optional, real, record, registered, rows, step, widthOf } from "./fields.js";
import { MAX_PAYLOAD, MAX_ROWS, MAX_SYMBOL } from "./limits.js";
import { unpack } from "./msgpack.js";
/** @import { Made } from "./fields.js" */
/** @import { Info } from "./tensors.js" */

/** How many layer types there are: 0, 1 and 2. */
export const LAYER_TYPES = 3;
export const SCENE_ID_SIZE = 8;

const CHUNK = { type: integer(0, 65535), length: integer(0, MAX_PAYLOAD) };
/** What a file says of its base (5.6). bytes: those of the digest. */
const BASE = record({
  sceneId: bytes(SCENE_ID_SIZE),
  digest: bytes(32),
  rows: integer(0, MAX_ROWS),
  bytes: integer(1, MAX_PAYLOAD),
});
const CAMERA = map([1, 2, 3, 4], {
  matrix: list(real(), 12),
  intrinsics: list(real(), 4),
  width: integer(1, 65535),
  height: integer(1, 65535),
});
const HEADER = map([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15], {
  chunks: list(record(CHUNK), 1, 1024),
  mode: registered(2),
  kind,
  rows,
  centres: optional(list(integer(-MAX_SYMBOL, MAX_SYMBOL), 0, Infinity), null),
  voxelSize: step,
  box: list(real(), 6),
  timeRange: list(real(), 2),
  background: list(real(0, 1), 3),
  range: list(real(0), 2),
  up: list(real(), 3),
  unit: real(0),
  camera: optional(CAMERA, null),
  digest: bytes(16), // of all layers, so that a decoder of some cannot check it
  base: optional(BASE, null),
});

/** @typedef {ReturnType<typeof readHeader>} Header */
/** @typedef {Made<typeof CHUNK>} ListedChunk */

/** width: W, the channels of all tensors of rows. centres: of these channels; null if anchors have no step classes.
 * identity: SHA-256 of the `described` bytes behind the chunk list; it begins with the scene id (3.3), in hexadecimal.
 * base: null where the file holds its scene whole. @param {Uint8Array} packed */
export function readHeader(packed) {
  const { value, firstEntryEnd } = unpack(packed, "header");
  const { chunks, mode, kind, rows, centres, base, box, range, camera, digest, ...others } = HEADER(value, "header");
  const layers = chunks.map(({ type }) => type).filter((type) => type < LAYER_TYPES);
  const fall = layers.findIndex((layer, i) => layer < layers[i - 1]);
  if (fall > 0) throw malformed(`header: layer ${layers[fall]} after ${layers[fall - 1]}, expected ascending ones`);
  if (chunks[0].type !== 0) throw malformed(`header: the first chunk is of type ${chunks[0].type}, expected layer 0`);
  const width = widthOf(rows);
  if (centres && centres.length !== width) throw malformed(`header: ${centres.length} centres, expected ${width}`);
  const corners = [box.slice(0, 3), box.slice(3)];
  if (corners[0].some((low, axis) => low > corners[1][axis])) {
    throw malformed("header: a lower corner of the box lies above the upper one");
  }
  const [start, end] = others.timeRange;
  if (end < start) throw malformed(`header: times ${start} and ${end}, expected ascending ones`);
  const [near, far] = range;
  if (near >= far) throw malformed(`header: near ${near} and far ${far}, expected near < far`);
  const [fx, fy, cx, cy] = camera?.intrinsics ?? [1, 1];
  if (!(fx > 0 && fy > 0)) throw malformed(`header: camera: focal lengths ${fx} and ${fy}, expected positive ones`);
  const pinhole = camera && {
    viewmat: Float32Array.from([...camera.matrix, 0, 0, 0, 1]),
    K: Float32Array.from([fx, 0, cx, 0, fy, cy, 0, 0, 1]),
    width: camera.width,
    height: camera.height,
  };
  if (mode === 1) throw unsupported("header: mode lzma, expected mode ans"); // an ans-only decoder (clause 16)
  const info = /** @type {Info} */ ({ ...others, box: corners, near, far, camera: pinhole });
  const described = packed.subarray(firstEntryEnd);
  const identity = sha256(described);
  const sceneId = hex(identity.subarray(0, SCENE_ID_SIZE));
  return { chunks, kind, rows, width, centres, info, identity, described: described.length, sceneId, base };
}
