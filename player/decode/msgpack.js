// Clause 4: canonical msgpack. The one form that it allows is checked while it is read.

import { malformed } from "./errors.js";
import { MAX_NESTING } from "./limits.js";

/** A float 32, so that a real is told from an integer of the same value. */
export class Real {
  /** @param {number} value */
  constructor(value) {
    this.value = value;
  }
}

/**
 * An integer is a number; one beyond ±2^53 is only near it, which is over every limit all the same.
 *
 * @typedef {number | boolean | string | Real | Uint8Array | Value[] | Map<number, any>} Value
 */
/** @typedef {{value: Value, firstEntryEnd: number}} Unpacked */

const UTF8 = /* @__PURE__ */ new TextDecoder("utf-8", { fatal: true, ignoreBOM: true });

/**
 * The one value that `bytes` hold. firstEntryEnd: the offset behind the first entry of the outermost map, 0 if there is
 * none.
 *
 * @param {Uint8Array} bytes @param {string} where names the value in messages
 * @returns {Unpacked}
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
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this.where = where;
    this.at = 0;
    this.firstEntryEnd = 0;
  }

  /** @param {string} reason */
  fault(reason) {
    return malformed(`${this.where}: ${reason}, at byte ${this.at}`);
  }

  /** The offset of the next `size` bytes, which are passed. @param {number} size */
  take(size) {
    const at = this.at;
    if (size > this.bytes.length - at) throw this.fault("the value is cut");
    this.at += size;
    return at;
  }

  /** A big-endian unsigned integer of 1, 2 or 4 bytes. @param {number} size */
  unsigned(size) {
    const at = this.take(size);
    return size === 1 ? this.bytes[at] : size === 2 ? this.view.getUint16(at) : this.view.getUint32(at);
  }

  /** An unsigned integer that would not fit in fewer bytes. @param {number} size @param {number} least */
  shortest(size, least) {
    const n = this.unsigned(size);
    if (n < least) throw this.fault("a number or length that is not in its shortest form");
    return n;
  }

  /** @param {number} depth lists and maps around the value @returns {Value} */
  value(depth) {
    const b = this.unsigned(1);
    if (b < 0x80) return b;
    if (b >= 0xe0) return b - 256;
    if (b < 0x90) return this.map(b & 15, depth);
    if (b < 0xa0) return this.list(b & 15, depth);
    if (b < 0xc0) return this.text(b & 31);
    switch (b) {
      case 0xc2:
        return false;
      case 0xc3:
        return true;
      case 0xc4:
        return this.binary(this.unsigned(1));
      case 0xc5:
        return this.binary(this.shortest(2, 256));
      case 0xc6:
        return this.binary(this.shortest(4, 65536));
      case 0xca: {
        const real = this.view.getFloat32(this.take(4));
        if (!Number.isFinite(real)) throw this.fault(`${real}, expected a finite real`);
        return new Real(real);
      }
      case 0xcc:
        return this.shortest(1, 128);
      case 0xcd:
        return this.shortest(2, 256);
      case 0xce:
        return this.shortest(4, 65536);
      case 0xcf: {
        const high = this.shortest(4, 1);
        return high * 2 ** 32 + this.unsigned(4);
      }
      case 0xd0:
        return this.negative(this.view.getInt8(this.take(1)), -32);
      case 0xd1:
        return this.negative(this.view.getInt16(this.take(2)), -128);
      case 0xd2:
        return this.negative(this.view.getInt32(this.take(4)), -32768);
      case 0xd3: {
        const high = this.view.getInt32(this.take(4));
        return this.negative(high * 2 ** 32 + this.unsigned(4), -(2 ** 31));
      }
      case 0xd9:
        return this.text(this.shortest(1, 32));
      case 0xda:
        return this.text(this.shortest(2, 256));
      case 0xdb:
        return this.text(this.shortest(4, 65536));
      case 0xdc:
        return this.list(this.shortest(2, 16), depth);
      case 0xdd:
        return this.list(this.shortest(4, 65536), depth);
      case 0xde:
        return this.map(this.shortest(2, 16), depth);
      case 0xdf:
        return this.map(this.shortest(4, 65536), depth);
    }
    throw this.fault(`type byte 0x${b.toString(16)}, which canonical msgpack does not have`);
  }

  /** @param {number} value @param {number} above what shorter forms hold */
  negative(value, above) {
    if (value >= above) throw this.fault("an integer that is not in its shortest form");
    return value;
  }

  /** @param {number} size */
  text(size) {
    const at = this.take(size);
    try {
      return UTF8.decode(this.bytes.subarray(at, at + size));
    } catch {
      throw this.fault("a string that is not UTF-8");
    }
  }

  /** @param {number} size */
  binary(size) {
    const at = this.take(size);
    return this.bytes.slice(at, at + size);
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
    for (let i = 0; i < size; i++) list.push(this.value(depth + 1)); // it is cut before it grows beyond the bytes
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
