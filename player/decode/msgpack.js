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
  let at = 0;
  let firstEntryEnd = 0;
  const value = read(0);
  if (at !== bytes.length) throw fault(`${bytes.length - at} bytes follow the value`);
  return { value, firstEntryEnd };

  /** @param {string} reason */
  function fault(reason) {
    return malformed(`${where}: ${reason}, at byte ${at}`);
  }

  /** The next `size` bytes. @param {number} size */
  function take(size) {
    if (size > bytes.length - at) throw fault("the value is truncated");
    return bytes.subarray(at, (at += size));
  }

  /** A big-endian integer of `size` bytes. @param {number} size @param {boolean} [signed] */
  function integer(size, signed = false) {
    const [first, ...rest] = take(size);
    return rest.reduce((n, byte) => 256 * n + byte, signed && first > 127 ? first - 256 : first);
  }

  /** @param {number} depth number of lists and maps around the value @returns {Value} */
  function read(depth) {
    const b = integer(1);
    if (b < 0x80 || b >= 0xe0) return b < 0x80 ? b : b - 256;
    if (b < 0xa0) return items(b < 0x90 ? "map" : "list", b & 15, depth);
    if (b < 0xc0) return text(b & 31);
    if (b === 0xc2 || b === 0xc3) return b === 0xc3;
    if (b === 0xca) {
      const { buffer, byteOffset } = take(4);
      const real = new DataView(buffer, byteOffset).getFloat32(0);
      if (!Number.isFinite(real)) throw fault(`${real}, expected a finite real`);
      return new Real(real);
    }
    if (!FORMS[b]) throw fault(`type byte 0x${b.toString(16)}, which canonical msgpack does not have`);
    const { kind, size, least } = FORMS[b];
    const n = integer(size, kind === "negative");
    if ((kind === "negative" ? -1 - n : n) < least) throw fault("a number or length not in its shortest form");
    if (kind === "integer" || kind === "negative") return n;
    if (kind === "bytes") return take(n).slice();
    return kind === "text" ? text(n) : items(kind, n, depth);
  }

  /** @param {number} size bytes */
  function text(size) {
    const encoded = take(size);
    try {
      return UTF8.decode(encoded);
    } catch {
      throw fault("a string that is not UTF-8");
    }
  }

  /** A list, or a map. @param {string} kind @param {number} size @param {number} depth */
  function items(kind, size, depth) {
    if (depth >= 4) throw fault("lists and maps nested more than 4 deep");
    /** @type {Value[]} */
    const list = [];
    /** @type {Map<number, Value>} */
    const map = new Map();
    for (let i = 0, last = -1; i < size; i++) {
      const item = read(depth + 1); // raises at the end of the bytes
      if (kind === "list") list.push(item);
      else if (typeof item !== "number" || item <= last || item > 0xffffffff) {
        throw fault("a key, expected ascending integers from 0 to 2^32 - 1");
      } else map.set((last = item), read(depth + 1));
      if (depth === 0 && i === 0) firstEntryEnd = at;
    }
    return kind === "list" ? list : map;
  }
}
