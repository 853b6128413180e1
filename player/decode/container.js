// Clause 3: preamble and chunk frames.

import { DecodeError } from "./errors.js";
import { crc32, hex } from "./digests.js";
import { SCENE_ID_SIZE } from "./header.js";
import { MAX_HEADER, MAX_PAYLOAD } from "./limits.js";

const SIGNATURE = [0x89, 0x50, 0x44, 0x34, 0x0d, 0x0a, 0x1a, 0x0a];
const MAJOR = 5;
export const PREAMBLE_SIZE = 20;
/** Bytes of preamble and the longest header. */
export const LONGEST_HEADER = PREAMBLE_SIZE + MAX_HEADER;
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

/** H, unchecked. @param {Uint8Array} preamble all of it */
export const headerLength = (preamble) => viewOf(preamble).getUint32(12, true);

/**
 * The header's bytes out of a file's first bytes; what follows them is not looked at.
 *
 * @param {Uint8Array} bytes
 * @returns {Uint8Array}
 */
export function readPreamble(bytes) {
  const known = Math.min(bytes.length, SIGNATURE.length);
  for (let i = 0; i < known; i++) {
    if (bytes[i] !== SIGNATURE[i]) {
      const found = hex(bytes.subarray(0, known));
      const message = `not a .pd4 file: it begins with ${found}, expected ${hex(Uint8Array.from(SIGNATURE))}`;
      throw new DecodeError("BadSignature", message, { offset: 0 });
    }
  }
  need(bytes, PREAMBLE_SIZE, "the preamble", 0, null);
  const view = viewOf(bytes);
  const major = view.getUint16(8, true);
  if (major !== MAJOR) {
    const older = major < MAJOR ? ": drafts before it are no longer read, the scene has to be encoded again" : "";
    const message = `format version ${major}.${view.getUint16(10, true)}, this decoder reads ${MAJOR}.x${older}`;
    throw new DecodeError("UnsupportedVersion", message, { offset: 8 });
  }
  const length = headerLength(bytes);
  if (length > MAX_HEADER) {
    throw new DecodeError("LimitExceeded", `a header of ${length} bytes, limit ${MAX_HEADER}`, { offset: 12 });
  }
  need(bytes, PREAMBLE_SIZE + length, "the header", 0, null);
  const header = bytes.subarray(PREAMBLE_SIZE, PREAMBLE_SIZE + length);
  checkCrc(view, 16, crc32(header, crc32(bytes.subarray(0, 16))), 0, null);
  return header;
}

/**
 * The chunk that `bytes` begin with, of the listed type and length; what follows is not looked at. sceneId: that of the
 * file. offset and index: of the chunk in the file.
 *
 * @param {Uint8Array} bytes
 * @param {{listed: import("./header.js").ListedChunk, sceneId: string, offset: number, index: number}} expected
 * @returns more: whether the layer has further slices; number: of the slice (3.6); payload: not copied
 */
export function readChunk(bytes, { listed, sceneId, offset, index }) {
  /** @param {import("./errors.js").ErrorKind} kind @param {string} message @param {number} at */
  const fault = (kind, message, at) => new DecodeError(kind, message, { offset: offset + at, chunk: index });
  need(bytes, CHUNK_HEAD, "a chunk's head", offset, index);
  const view = viewOf(bytes);
  const length = view.getUint32(4, true);
  if (length > MAX_PAYLOAD) throw fault("LimitExceeded", `a payload of ${length} bytes, limit ${MAX_PAYLOAD}`, 4);
  if (length !== listed.length) {
    throw fault("Malformed", `payload length ${length}, the header says ${listed.length}`, 4);
  }
  const end = CHUNK_HEAD + length;
  need(bytes, end + 4, "a chunk", offset, index);
  checkCrc(view, end, crc32(bytes.subarray(0, end)), offset, index);
  const flags = view.getUint16(2, true);
  const reserved = flags & ANCILLARY ? ~ANCILLARY : RESERVED;
  if (flags & reserved) throw fault("Malformed", `flags ${flags}, reserved bits must be zero`, 2);
  const type = view.getUint16(0, true);
  if (type !== listed.type) throw fault("Malformed", `chunk type ${type}, the header says ${listed.type}`, 0);
  const found = hex(bytes.subarray(8, 8 + SCENE_ID_SIZE));
  if (found !== sceneId) {
    throw fault("Malformed", `the chunk belongs to scene ${found}, this file is ${sceneId}`, 8);
  }
  return {
    ancillary: (flags & ANCILLARY) !== 0,
    more: (flags & MORE) !== 0,
    number: flags >> NUMBER_SHIFT,
    payload: bytes.subarray(CHUNK_HEAD, end),
  };
}

/** @param {Uint8Array} bytes @param {number} size @param {string} what @param {number} offset
 * @param {number | null} chunk */
function need(bytes, size, what, offset, chunk) {
  if (bytes.length >= size) return;
  const end = offset + bytes.length;
  const message = `truncated in ${what}: ${end} bytes, expected ${offset + size}`;
  throw new DecodeError("Truncated", message, { offset: end, chunk, needs: offset + size });
}

/** @param {DataView} view @param {number} at @param {number} computed @param {number} offset
 * @param {number | null} chunk */
function checkCrc(view, at, computed, offset, chunk) {
  const stored = view.getUint32(at, true);
  if (stored === computed) return;
  const message = `CRC-32 ${computed.toString(16)}, stored ${stored.toString(16)}`;
  throw new DecodeError("ChecksumMismatch", message, { offset: offset + at, chunk });
}
