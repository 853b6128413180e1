// Typed, bounded access to what msgpack held. Every getter checks type and range (clauses 4 and 15).

import { limitExceeded, malformed, unsupported } from "./errors.js";
import { MAX_ID } from "./limits.js";
import { Real } from "./msgpack.js";
/** @import { Value } from "./msgpack.js" */

/** Unknown keys from here on are ignored; unknown ones below change what the file means. */
const FIRST_IGNORED_KEY = 64;
const SMALLEST_NORMAL = 2 ** -126;

/**
 * An integer in least..limit.
 *
 * @param {Value | undefined} value @param {number} least @param {number} limit @param {string} where
 */
export function asInteger(value, least, limit, where) {
  if (typeof value !== "number") throw malformed(`${where}: ${nameOf(value)}, expected an integer`);
  if (value > limit) throw limitExceeded(`${where}: ${value}, limit ${limit}`);
  if (value < least) throw malformed(`${where}: ${value}, expected at least ${least}`);
  return value;
}

/**
 * An integer out of a registry that has 0..count - 1.
 *
 * @param {Value | undefined} value @param {number} count @param {string} where
 */
export function asRegistered(value, count, where) {
  const number = asInteger(value, -Infinity, Infinity, where);
  if (number < 0 || number >= count) throw unsupported(`${where}: ${number}, expected 0..${count - 1}`);
  return number;
}

/**
 * A list, of `length` items if given.
 *
 * @param {Value | undefined} value @param {string} where @param {number} [length]
 * @returns {Value[]}
 */
export function asList(value, where, length) {
  if (!Array.isArray(value)) throw malformed(`${where}: ${nameOf(value)}, expected a list`);
  if (length !== undefined && value.length !== length) {
    throw malformed(`${where}: a list of ${value.length}, expected ${length}`);
  }
  return value;
}

/** A list of least..limit items. @param {Value | undefined} value @param {number} least @param {number} limit
 * @param {string} where */
export function asItems(value, least, limit, where) {
  const list = asList(value, where);
  asInteger(list.length, least, limit, `${where}: length`);
  return list;
}

/** @param {Value[]} list @param {number} least @param {number} limit @param {string} where */
export const asIntegers = (list, least, limit, where) => list.map((item) => asInteger(item, least, limit, where));

/**
 * What `read` makes of each tensor of a table, a list that begins with an id; ids ascend.
 *
 * @template T
 * @param {Value[]} table @param {string} where @param {(id: number, rest: Value[], where: string) => T} read
 */
export function asTensors(table, where, read) {
  let last = -1;
  return table.map((tensor) => {
    const [id, ...rest] = asItems(tensor, 1, Infinity, where);
    if (asInteger(id, 0, MAX_ID, `${where}: id`) <= last) throw malformed(`${where}: id ${id} after ${last}`);
    last = /** @type {number} */ (id);
    return read(last, rest, where);
  });
}

/** @param {Value | undefined} value @param {string} where @returns {number} an exact binary32 value */
function asReal(value, where) {
  if (!(value instanceof Real)) throw malformed(`${where}: ${nameOf(value)}, expected a real`);
  return value.value;
}

/** These bytes; raises if they are not `size` bytes. @param {Value | undefined} value @param {number} size
 * @param {string} where */
export function checkBytes(value, size, where) {
  if (!(value instanceof Uint8Array)) throw malformed(`${where}: ${nameOf(value)}, expected bytes`);
  if (value.length !== size) throw malformed(`${where}: ${value.length} bytes, expected ${size}`);
  return value;
}

/** A step: a real that is positive and normal. @param {Value | undefined} value @param {string} where */
export function asStep(value, where) {
  const step = asReal(value, where);
  if (!(step >= SMALLEST_NORMAL)) throw malformed(`${where}: ${step}, expected a positive normal binary32 value`);
  return step;
}

/** @param {Value | undefined} value */
function nameOf(value) {
  if (value === undefined) return "nothing";
  if (value instanceof Real) return "a real";
  if (value instanceof Uint8Array) return "bytes";
  if (value instanceof Map) return "a map";
  if (Array.isArray(value)) return "a list";
  return typeof value === "number" ? "an integer" : `a ${typeof value}`;
}

/** A map of registered keys, with a name for messages. */
export class Fields {
  /** @param {Value | undefined} value @param {string} where @param {number[]} known keys */
  constructor(value, where, known) {
    if (!(value instanceof Map)) throw malformed(`${where}: ${nameOf(value)}, expected a map`);
    for (const key of value.keys()) {
      if (key < FIRST_IGNORED_KEY && !known.includes(key)) throw unsupported(`${where}: unknown key ${key}`);
    }
    this.where = where;
    /** @type {Map<number, Value>} */
    this.map = value;
  }

  /** @param {number} key */
  has(key) {
    return this.map.has(key);
  }

  /** The value of a key that must be there. @param {number} key @returns {Value} */
  get(key) {
    const value = this.map.get(key);
    if (value === undefined) throw malformed(`${this.where}: key ${key} is missing`);
    return value;
  }

  /** @param {number} key @param {string} what */
  real(key, what) {
    return asReal(this.get(key), `${this.where}: ${what}`);
  }

  /** @param {number} key @param {number} length @param {string} what */
  reals(key, length, what) {
    const where = `${this.where}: ${what}`;
    return asList(this.get(key), where, length).map((item) => asReal(item, where));
  }
}
