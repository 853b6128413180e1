// Clause 3: preamble and chunk frames. Offsets in faults count from the first of the bytes that are given.

import { crc32, hex } from "./digests.js";
import { DecodeError, limitExceeded, malformed, unsupported } from "./errors.js";
import { LAYER_TYPES, SCENE_ID_SIZE } from "./header.js";
import { MAX_PAYLOAD } from "./limits.js";
/** @import { ListedChunk } from "./header.js" */

const SIGNATURE = /* @__PURE__ */ Uint8Array.of(0x89, 0x50, 0x44, 0x34, 0x0d, 0x0a, 0x1a, 0x0a);
const MAJOR = 5;
const MAX_HEADER = 2 ** 14;
export const PREAMBLE_SIZE = 20;
const CHUNK_HEAD = 16;
/** Bytes of a chunk around its payload. */
export const CHUNK_OVERHEAD = CHUNK_HEAD + 4;
const ANCILLARY = 1;
const MORE = 2;
/** Bits 2..5. */
const RESERVED = 0x3c;
const NUMBER_SHIFT = 6;

/** @param {Uint8Array} bytes */
const viewOf = (bytes) => new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);

/** The header's bytes out of a file's first bytes; what follows them is not looked at.
 * @param {Uint8Array} bytes
 * @returns {Uint8Array} */
export function readPreamble(bytes) {
  const begin = bytes.subarray(0, SIGNATURE.length);
  if (begin.some((byte, i) => byte !== SIGNATURE[i])) {
    const message = `not a .pd4 file: it begins with ${hex(begin)}, expected ${hex(SIGNATURE)}`;
    throw new DecodeError("BadSignature", message, { offset: 0 });
  }
  need(bytes, PREAMBLE_SIZE, "the preamble");
  const view = viewOf(bytes);
  const major = view.getUint16(8, true);
  if (major !== MAJOR) {
    const older = major < MAJOR ? ": drafts before it are no longer read, the scene has to be encoded again" : "";
    const message = `format version ${major}.${view.getUint16(10, true)}, this decoder reads ${MAJOR}.x${older}`;
    throw new DecodeError("UnsupportedVersion", message, { offset: 8 });
  }
  const length = view.getUint32(12, true);
  if (length > MAX_HEADER) throw limitExceeded(`a header of ${length} bytes, limit ${MAX_HEADER}`, 12);
  need(bytes, PREAMBLE_SIZE + length, "the header");
  const header = bytes.subarray(PREAMBLE_SIZE, PREAMBLE_SIZE + length);
  checkCrc(view, 16, crc32(header, crc32(bytes.subarray(0, 16))));
  return header;
}

/** The chunk that `bytes` begin with; what follows is not looked at.
 * @param {Uint8Array} bytes @param {ListedChunk} listed as the header says @param {string} sceneId that of the file
 * @returns more: whether the layer has further slices; number: of the slice (3.6); payload: not copied */
export function readChunk(bytes, listed, sceneId) {
  need(bytes, CHUNK_HEAD, "a chunk's head");
  const view = viewOf(bytes);
  const length = view.getUint32(4, true);
  if (length > MAX_PAYLOAD) throw limitExceeded(`a payload of ${length} bytes, limit ${MAX_PAYLOAD}`, 4);
  if (length !== listed.length) throw malformed(`payload length ${length}, the header says ${listed.length}`, 4);
  const end = CHUNK_HEAD + length;
  need(bytes, end + 4, "a chunk");
  checkCrc(view, end, crc32(bytes.subarray(0, end)));
  const flags = view.getUint16(2, true);
  if (flags & (flags & ANCILLARY ? ~ANCILLARY : RESERVED)) {
    throw malformed(`flags ${flags}, reserved bits must be zero`, 2);
  }
  const type = view.getUint16(0, true);
  if (type !== listed.type) throw malformed(`chunk type ${type}, the header says ${listed.type}`, 0);
  const found = hex(bytes.subarray(8, 8 + SCENE_ID_SIZE));
  if (found !== sceneId) throw malformed(`the chunk belongs to scene ${found}, this file is ${sceneId}`, 8);
  if (type < LAYER_TYPES && flags & ANCILLARY) throw malformed(`layer ${type} is flagged ancillary`);
  if (type >= LAYER_TYPES && !(flags & ANCILLARY)) throw unsupported(`critical chunk of unknown type ${type}`);
  return { more: (flags & MORE) !== 0, number: flags >> NUMBER_SHIFT, payload: bytes.subarray(CHUNK_HEAD, end) };
}

/** @param {Uint8Array} bytes @param {number} needs so many of them @param {string} what */
function need(bytes, needs, what) {
  const { length } = bytes;
  if (length >= needs) return;
  const message = `truncated in ${what} after ${length} of ${needs} bytes`;
  throw new DecodeError("Truncated", message, { offset: length, needs });
}

/** @param {DataView} view @param {number} at @param {number} computed */
function checkCrc(view, at, computed) {
  const stored = view.getUint32(at, true);
  if (stored === computed) return;
  const message = `CRC-32 ${computed.toString(16)}, stored ${stored.toString(16)}`;
  throw new DecodeError("ChecksumMismatch", message, { offset: at });
}
