// Clause 4: canonical msgpack, in which each value has one valid form.

import { malformed } from "./errors.js";

/** A float 32, which differs in type from an integer of the same value. */
export class Real {
  /** @param {number} value */
  constructor(value) {
    this.value = value;
  }
}

/** An integer is a number. Beyond ±2^53 it is rounded, which is above every limit.
 * @typedef {number | boolean | string | Real | Uint8Array | Value[] | Map<number, any>} Value */

const UTF8 = /* @__PURE__ */ new TextDecoder("utf-8", { fatal: true, ignoreBOM: true });

/** By first byte: what follows, the bytes of the number before it, and the least number that has no shorter form; of
 * integers below 0, the least of -1 - n. @type {Record<number, {kind: string, size: number, least: number}>} */
const FORMS = {};
for (const [kind, first, sizes, bits] of /** @type {[string, number, number[], number[]][]} */ ([
  ["bytes", 0xc4, [1, 2, 4], [0, 8, 16]],
  ["integer", 0xcc, [1, 2, 4, 8], [7, 8, 16, 32]],
  ["negative", 0xd0, [1, 2, 4, 8], [5, 7, 15, 31]],
  ["text", 0xd9, [1, 2, 4], [5, 8, 16]],
  ["list", 0xdc, [2, 4], [4, 16]],
  ["map", 0xde, [2, 4], [4, 16]],
])) {
  sizes.forEach((size, i) => (FORMS[first + i] = { kind, size, least: bits[i] && 2 ** bits[i] }));
}

/** The one value that `bytes` hold. firstEntryEnd: the offset behind the first entry of the outermost map, 0 if none
 * is there. @param {Uint8Array} bytes @param {string} where names the value in messages */
export function unpack(bytes, where) {
  const reader = new Reader(bytes, where);
  const value = reader.value(0);
  if (reader.at !== bytes.length) throw reader.fault(`${bytes.length - reader.at} bytes follow the value`);
  return { value, firstEntryEnd: reader.firstEntryEnd };
}

class Reader {
  /** @param {Uint8Array} bytes @param {string} where */
  constructor(bytes, where) {
    this.bytes = bytes;
    this.where = where;
    this.at = 0;
    this.firstEntryEnd = 0;
  }

  /** @param {string} reason */
  fault(reason) {
    return malformed(`${this.where}: ${reason}, at byte ${this.at}`);
  }

  /** The next `size` bytes. @param {number} size */
  take(size) {
    if (size > this.bytes.length - this.at) throw this.fault("the value is truncated");
    return this.bytes.subarray(this.at, (this.at += size));
  }

  /** A big-endian integer of `size` bytes. @param {number} size @param {boolean} [signed] */
  integer(size, signed = false) {
    const [first, ...rest] = this.take(size);
    return rest.reduce((n, byte) => 256 * n + byte, signed && first > 127 ? first - 256 : first);
  }

  /** @param {number} depth number of lists and maps around the value @returns {Value} */
  value(depth) {
    const b = this.integer(1);
    if (b < 0x80 || b >= 0xe0) return b < 0x80 ? b : b - 256;
    if (b < 0xa0) return this.items(b < 0x90 ? "map" : "list", b & 15, depth);
    if (b < 0xc0) return this.text(b & 31);
    if (b === 0xc2 || b === 0xc3) return b === 0xc3;
    if (b === 0xca) {
      const { buffer, byteOffset } = this.take(4);
      const real = new DataView(buffer, byteOffset).getFloat32(0);
      if (!Number.isFinite(real)) throw this.fault(`${real}, expected a finite real`);
      return new Real(real);
    }
    if (!FORMS[b]) throw this.fault(`type byte 0x${b.toString(16)}, which canonical msgpack does not have`);
    const { kind, size, least } = FORMS[b];
    const n = this.integer(size, kind === "negative");
    if ((kind === "negative" ? -1 - n : n) < least) throw this.fault("a number or length not in its shortest form");
    if (kind === "integer" || kind === "negative") return n;
    if (kind === "bytes") return this.take(n).slice();
    return kind === "text" ? this.text(n) : this.items(kind, n, depth);
  }

  /** @param {number} size bytes */
  text(size) {
    const bytes = this.take(size);
    try {
      return UTF8.decode(bytes);
    } catch {
      throw this.fault("a string that is not UTF-8");
    }
  }

  /** A list, or a map. @param {string} kind @param {number} size @param {number} depth */
  items(kind, size, depth) {
    if (depth >= 4) throw this.fault(`lists and maps nested more than 4 deep`);
    /** @type {Value[]} */
    const list = [];
    /** @type {Map<number, Value>} */
    const map = new Map();
    for (let i = 0, last = -1; i < size; i++) {
      const item = this.value(depth + 1); // raises at the end of the bytes
      if (kind === "list") list.push(item);
      else if (typeof item !== "number" || item <= last || item > 0xffffffff) {
        throw this.fault("a key, expected ascending integers from 0 to 2^32 - 1");
      } else map.set((last = item), this.value(depth + 1));
      if (depth === 0 && i === 0) this.firstEntryEnd = this.at;
    }
    return kind === "list" ? list : map;
  }
}
