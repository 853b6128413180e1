// Clauses 2.1 and 7.1: little-endian integers and varints from a run of bytes.

import { limitExceeded, malformed } from "./errors.js";

/** The largest varint: five bytes of seven bits. */
export const MAX_VARINT = 2 ** 35 - 1;

/** Reads codes front to back. Where they end early they are Malformed: the chunk around them is whole (clause 15). */
export class ByteReader {
  /** @param {Uint8Array} bytes */
  constructor(bytes) {
    this.bytes = bytes;
    /** Of the next byte. */
    this.offset = 0;
  }

  /** A u8. @param {string} what names it in messages */
  byte(what) {
    if (this.offset >= this.bytes.length) throw malformed(`the codes end before ${what}`);
    return this.bytes[this.offset++];
  }

  /** A varint of at most `limit`: LimitExceeded above it, Malformed if it is cut, over five bytes or not the shortest.
   * @param {number} limit @param {string} what */
  varint(limit, what) {
    let value = 0;
    for (let scale = 1; scale <= 2 ** 28; scale *= 128) {
      const byte = this.byte(what);
      value += (byte & 127) * scale;
      if (byte >= 128) continue;
      if (byte === 0 && scale > 1) break;
      if (value > limit) throw limitExceeded(`${what}: ${value}, limit ${limit}`);
      return value;
    }
    throw malformed(`${what}: a varint of more than five bytes or not in its shortest form`);
  }

  /** A zigzag integer of magnitude at most `limit`. @param {number} limit @param {string} what */
  zigzag(limit, what) {
    const code = this.varint(MAX_VARINT, what);
    const value = code % 2 ? -(code + 1) / 2 : code / 2;
    if (value > limit || -value > limit) throw limitExceeded(`${what}: ${value}, limit ${limit} in magnitude`);
    return value;
  }
}
