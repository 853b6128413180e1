// The conformance vectors, and what an ans-only decoder must answer to each.

import { readFileSync } from "node:fs";

import { readPreamble } from "../decode/container.js";
import { unpack } from "../decode/msgpack.js";

const FOLDER = new URL("../../spec/vectors/", import.meta.url);
const MODE = 2;

/**
 * error: the kind that is due, null if the file decodes. layers: the hashes of all layers that decode. slices: the layer
 * of each slice that does.
 *
 * @typedef {object} Vector
 * @property {string} file
 * @property {Uint8Array} bytes
 * @property {string | null} error
 * @property {number | null} chunk
 * @property {number | null} offset null if it is not fixed
 * @property {import("../decode/hashes.js").LayerHashes[]} layers
 * @property {number[]} slices
 */

/** What the header has under a key, if it can be read. @param {Uint8Array} bytes @param {number} key */
function headerHas(bytes, key) {
  try {
    const fields = unpack(readPreamble(bytes), "header").value;
    return fields instanceof Map ? fields.get(key) : undefined;
  } catch {
    return undefined;
  }
}

/** @returns {Vector[]} */
export function readVectors() {
  const manifest = JSON.parse(readFileSync(new URL("manifest.json", FOLDER), "utf8"));
  return manifest.vectors.map((/** @type {any} */ row) => {
    const bytes = new Uint8Array(readFileSync(new URL(row.file, FOLDER)));
    // an ans-only decoder's answer, where the manifest does not name it
    const unsupported = row.ans_only ? row.ans_only === "UnsupportedFeature" : headerHas(bytes, MODE) === 1;
    const { file, error = null, chunk = null, offset = null, layers } = row;
    const slices = row.slices ?? layers.map((/** @type {{layer: number}} */ { layer }) => layer);
    if (!unsupported) return { file, bytes, error, chunk, offset, layers, slices };
    return { file, bytes, error: "UnsupportedFeature", chunk: null, offset: null, layers: [], slices: [] };
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
