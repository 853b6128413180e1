// The conformance vectors, and what an ans-only decoder must answer to each.

import { readFileSync } from "node:fs";

import { readPreamble } from "../decode/container.js";
import { unpack } from "../decode/msgpack.js";

const FOLDER = new URL("../../spec/vectors/", import.meta.url);
const MODE = 2;
const DEFORMATION = 3;
const WIDTHS = 15;
const CENTRES = 16;

/**
 * error: the kind that is due, null if the file decodes. layers: the hashes of all layers that decode.
 *
 * @typedef {object} Vector
 * @property {string} file
 * @property {Uint8Array} bytes
 * @property {string | null} error
 * @property {number | null} chunk
 * @property {number | null} offset null if it is not fixed
 * @property {import("../decode/hashes.js").LayerHashes[]} layers
 */

/** Whether the header asks for mode lzma or float32 values. @param {Uint8Array} bytes */
function isUnsupported(bytes) {
  let fields;
  try {
    fields = unpack(readPreamble(bytes), "header").value;
  } catch {
    return false;
  }
  return fields instanceof Map && (fields.get(MODE) === 1 || fields.get(DEFORMATION) === 1);
}

/** Whether the header's widths and centres are legal, but not what this decoder takes yet. @param {Uint8Array} bytes */
function hasOtherWidths(bytes) {
  let fields;
  try {
    fields = unpack(readPreamble(bytes), "header").value;
  } catch {
    return false;
  }
  const widths = fields instanceof Map ? fields.get(WIDTHS) : null;
  if (!Array.isArray(widths) || widths.length !== 2 || !widths.every(Number.isInteger)) return false;
  const [feature, slots] = /** @type {number[]} */ (widths);
  if (feature < 1 || feature > 64 || slots < 1 || slots > 16) return false;
  const centres = /** @type {Map<number, any>} */ (fields).get(CENTRES);
  if (centres === undefined) return feature !== 32 || slots !== 10;
  if (!Array.isArray(centres) || centres.length !== feature + 6 + 3 * slots) return false;
  return centres.every((m) => Number.isInteger(m) && Math.abs(m) <= 2 ** 23);
}

/** @returns {Vector[]} */
export function readVectors() {
  const manifest = JSON.parse(readFileSync(new URL("manifest.json", FOLDER), "utf8"));
  return manifest.vectors.map((/** @type {any} */ row) => {
    const bytes = new Uint8Array(readFileSync(new URL(row.file, FOLDER)));
    const unsupported = isUnsupported(bytes);
    if ("ans_only" in row && unsupported !== (row.ans_only === "UnsupportedFeature")) {
      throw new Error(`${row.file}: the manifest says ${row.ans_only} of an ans-only decoder`);
    }
    const { file, error = null, chunk = null, offset = null, layers } = row;
    if (!unsupported && !hasOtherWidths(bytes)) return { file, bytes, error, chunk, offset, layers };
    return { file, bytes, error: "UnsupportedFeature", chunk: null, offset: null, layers: [] };
  });
}

/** One vector's bytes. @param {string} name without the ending */
export function readVector(name) {
  return new Uint8Array(readFileSync(new URL(`${name}.pd4`, FOLDER)));
}

/** Recursively equal, typed arrays by type and content. @param {unknown} a @param {unknown} b @returns {boolean} */
export function same(a, b) {
  if (ArrayBuffer.isView(a) && ArrayBuffer.isView(b)) {
    const [x, y] = [a, b].map((v) => Buffer.from(v.buffer, v.byteOffset, v.byteLength));
    return a.constructor === b.constructor && x.equals(y);
  }
  if (typeof a !== "object" || typeof b !== "object" || a === null || b === null) return Object.is(a, b);
  const [left, right] = [Object.entries(a), Object.entries(b)];
  return left.length === right.length && left.every(([key, value]) => same(value, /** @type {any} */ (b)[key]));
}
