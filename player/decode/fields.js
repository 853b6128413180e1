// Readers of what msgpack held: each checks type and range (clauses 4 and 15). The tables of the header (5) and of a
// slice's parameters (6) are put together from them.

import { limitExceeded, malformed, unsupported } from "./errors.js";
import { MAX_CHANNELS } from "./limits.js";
import { Real } from "./msgpack.js";
/** @import { Value } from "./msgpack.js" */

/** Undefined, where a key is missing, has no type. where: names the value in messages.
 * @template T @typedef {(value: Value | undefined, where: string) => T} Read */

/** What the readers of a table make. @template {Record<string, Read<any>>} S
 * @typedef {{[K in keyof S]: ReturnType<S[K]>}} Made */

/** Unknown keys from here on are ignored; unknown ones below change what the file means. */
const FIRST_IGNORED_KEY = 64;

/** @param {Value | undefined} value @param {string} where @param {string} expected */
function mistyped(value, where, expected) {
  return malformed(`${where}: ${value === undefined ? "nothing" : value.constructor.name}, expected ${expected}`);
}

/** @param {number} least @param {number} limit @returns {Read<number>} */
export const integer = (least, limit) => (value, where) => {
  if (typeof value !== "number") throw mistyped(value, where, "an integer");
  if (value > limit) throw limitExceeded(`${where}: ${value}, limit ${limit}`);
  if (value < least) throw malformed(`${where}: ${value}, expected at least ${least}`);
  return value;
};

/** An integer out of a registry that has 0..count - 1. @param {number} count @returns {Read<number>} */
export const registered = (count) => (value, where) => {
  const number = integer(-Infinity, Infinity)(value, where);
  if (number < 0 || number >= count) throw unsupported(`${where}: ${number}, expected 0..${count - 1}`);
  return number;
};

/** An exact binary32 value. @param {number} [least] @param {number} [most] @returns {Read<number>} */
export const real = (least = -Infinity, most = Infinity) => (value, where) => {
  if (!(value instanceof Real)) throw mistyped(value, where, "a real");
  if (value.value >= least && value.value <= most) return value.value;
  throw malformed(`${where}: ${value.value}, expected ${least}..${most}`);
};

/** A step is positive and normal. */
export const step = real(2 ** -126);

/** @param {number} size @returns {Read<Uint8Array>} */
export const bytes = (size) => (value, where) => {
  if (!(value instanceof Uint8Array)) throw mistyped(value, where, "bytes");
  if (value.length !== size) throw malformed(`${where}: ${value.length} bytes, expected ${size}`);
  return value;
};

/** @type {Read<any>} */
export const anything = (value) => value;

/** A list of least..limit items, or of exactly `least`. @template T @param {Read<T>} read reads an item
 * @param {number} least @param {number} [limit] @returns {Read<T[]>} */
export const list = (read, least, limit = least) => (value, where) => {
  if (!Array.isArray(value)) throw mistyped(value, where, "a list");
  if (least < limit) integer(least, limit)(value.length, `${where}: length`);
  else if (value.length !== least) throw malformed(`${where}: a list of ${value.length}, expected ${least}`);
  return value.map((item) => read(item, where));
};

/** A list with an item for each name. @template {Record<string, Read<any>>} S @param {S} table
 * @returns {Read<Made<S>>} */
export const record = (table) => (value, where) => {
  const items = list(anything, Object.keys(table).length)(value, where);
  return made(table, (i) => items[i], where);
};

/** A map with registered keys. @template {Record<string, Read<any>>} S @param {number[]} keys one for each name
 * @param {S} table @returns {Read<Made<S>>} */
export const map = (keys, table) => (value, where) => {
  if (!(value instanceof Map)) throw mistyped(value, where, "a map");
  for (const key of value.keys()) {
    if (key < FIRST_IGNORED_KEY && !keys.includes(key)) throw unsupported(`${where}: unknown key ${key}`);
  }
  return made(table, (i) => value.get(keys[i]), where);
};

/** @template {Record<string, Read<any>>} S @param {S} table @param {(i: number) => Value | undefined} valueOf
 * @param {string} where */
function made(table, valueOf, where) {
  const entries = Object.entries(table).map(([name, read], i) => [name, read(valueOf(i), `${where}: ${name}`)]);
  return /** @type {Made<S>} */ (Object.fromEntries(entries));
}

/** What may be missing. @template T, D @param {Read<T>} read @param {D} missing what is taken then
 * @returns {Read<T | D>} */
export const optional = (read, missing) => (value, where) => (value === undefined ? missing : read(value, where));

/** A list of 1..limit tensors, whose ids ascend. @template {{id: number}} T @param {Read<T>} read
 * @param {number} limit @returns {Read<T[]>} */
export const tensors = (read, limit) => (value, where) => {
  const found = list(read, 1, limit)(value, where);
  found.forEach(({ id }, i) => {
    if (id <= found[i - 1]?.id) throw malformed(`${where}: id ${id} after ${found[i - 1].id}`);
  });
  return found;
};

export const id = integer(0, 255);

/** A kind's number and parameters, whatever they mean. */
export const kind = list(integer(0, 65535), 1, 16);

const ROW_TENSOR = { id, channels: integer(1, MAX_CHANNELS), step, predictor: registered(3) };

/** Tensors of rows of the header or of a layer. @type {Read<Made<typeof ROW_TENSOR>[]>} */
export const rows = (value, where) => {
  const found = tensors(record(ROW_TENSOR), 32)(value, where);
  integer(0, 512)(widthOf(found), `${where}: channels of all`);
  return found;
};

/** Channels of all these tensors. @param {{channels: number}[]} tensors */
export const widthOf = (tensors) => tensors.reduce((sum, { channels }) => sum + channels, 0);
