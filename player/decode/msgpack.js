// Clause 4: canonical msgpack, in which each value has one valid form.

import { malformed } from "./errors.js";
import { MAX_NESTING } from "./limits.js";

/** A float 32, which differs in type from an integer of the same value. */
export class Real {
  /** @param {number} value */
  constructor(value) {
    this.value = value;
  }
}

/**
 * An integer is a number. Beyond ±2^53 it is rounded, which is above every limit.
 *
 * @typedef {number | boolean | string | Real | Uint8Array | Value[] | Map<number, any>} Value
 */

const UTF8 = /* @__PURE__ */ new TextDecoder("utf-8", { fatal: true, ignoreBOM: true });

/**
 * The one value that `bytes` hold. firstEntryEnd: the offset behind the first entry of the outermost map, 0 if there is
 * none.
 *
 * @param {Uint8Array} bytes @param {string} where names the value in messages
 * @returns {{value: Value, firstEntryEnd: number}}
 */
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

  /**
   * An unsigned integer that would not fit in a shorter form.
   *
   * @param {number} size bytes: `smallest`, or twice or four times or eight times as many
   * @param {number} least integer that does not fit in a form without a size @param {number} [smallest]
   */
  shortest(size, least, smallest = 1) {
    const n = this.integer(size);
    if (n < (size > smallest ? 2 ** (4 * size) : least)) {
      throw this.fault("a number or length that is not in its shortest form");
    }
    return n;
  }

  /** @param {number} depth number of lists and maps around the value @returns {Value} */
  value(depth) {
    const b = this.integer(1);
    if (b < 0x80) return b;
    if (b < 0x90) return this.map(b & 15, depth);
    if (b < 0xa0) return this.list(b & 15, depth);
    if (b < 0xc0) return this.text(b & 31);
    if (b >= 0xe0) return b - 256;
    if (b === 0xc2 || b === 0xc3) return b === 0xc3;
    if (b >= 0xc4 && b <= 0xc6) return this.take(this.shortest(1 << (b - 0xc4), 0)).slice();
    if (b === 0xca) return this.real();
    if (b >= 0xcc && b <= 0xcf) return this.shortest(1 << (b - 0xcc), 128);
    if (b >= 0xd0 && b <= 0xd3) return this.negative(1 << (b - 0xd0));
    if (b >= 0xd9 && b <= 0xdb) return this.text(this.shortest(1 << (b - 0xd9), 32));
    if (b === 0xdc || b === 0xdd) return this.list(this.shortest(2 << (b - 0xdc), 16, 2), depth);
    if (b >= 0xde) return this.map(this.shortest(2 << (b - 0xde), 16, 2), depth);
    throw this.fault(`type byte 0x${b.toString(16)}, which canonical msgpack does not have`);
  }

  real() {
    const { buffer, byteOffset } = this.take(4);
    const real = new DataView(buffer, byteOffset).getFloat32(0);
    if (!Number.isFinite(real)) throw this.fault(`${real}, expected a finite real`);
    return new Real(real);
  }

  /** A negative integer that would not fit in a shorter form. @param {number} size bytes */
  negative(size) {
    const n = this.integer(size, true);
    const least = size > 1 ? -(2 ** (4 * size - 1)) : -32; // of a shorter form
    if (n >= least) throw this.fault("an integer that is not in its shortest form");
    return n;
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

  /** @param {number} depth */
  enter(depth) {
    if (depth >= MAX_NESTING) throw this.fault(`lists and maps nested more than ${MAX_NESTING} deep`);
  }

  /** @param {number} size @param {number} depth */
  list(size, depth) {
    this.enter(depth);
    /** @type {Value[]} */
    const list = [];
    for (let i = 0; i < size; i++) list.push(this.value(depth + 1)); // raises at the end of the bytes
    return list;
  }

  /** @param {number} size @param {number} depth */
  map(size, depth) {
    this.enter(depth);
    /** @type {Map<number, Value>} */
    const map = new Map();
    let last = -1;
    for (let i = 0; i < size; i++) {
      const key = this.value(depth + 1);
      if (typeof key !== "number" || key <= last || key > 0xffffffff) {
        throw this.fault("a key, expected ascending integers from 0 to 2^32 - 1");
      }
      last = key;
      map.set(key, this.value(depth + 1));
      if (depth === 0 && i === 0) this.firstEntryEnd = this.at;
    }
    return map;
  }
}
