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

  /** Bytes not read yet. */
  get remaining() {
    return this.bytes.length - this.offset;
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
    let scale = 1;
    for (let i = 0; i < 5; i++) {
      const byte = this.byte(what);
      value += (byte & 127) * scale;
      if (byte < 128) {
        if (byte === 0 && i > 0) throw malformed(`${what}: a varint that is not in its shortest form`);
        if (value > limit) throw limitExceeded(`${what}: ${value}, limit ${limit}`);
        return value;
      }
      scale *= 128;
    }
    throw malformed(`${what}: a varint of more than five bytes`);
  }

  /** A zigzag integer of magnitude at most `limit`. @param {number} limit @param {string} what */
  zigzag(limit, what) {
    const code = this.varint(MAX_VARINT, what);
    const value = code % 2 ? -(code + 1) / 2 : code / 2;
    if (value > limit || -value > limit) throw limitExceeded(`${what}: ${value}, limit ${limit} in magnitude`);
    return value;
  }
}
