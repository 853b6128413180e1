// The conformance vectors, with the results of an ans-only decoder.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";

import { decode, openStream } from "../decode/index.js";

const FOLDER = new URL("../../spec/vectors/", import.meta.url);

/**
 * error: the expected kind, null if the tensors decode. scene: that of making a scene of them, null if one is made.
 * layers: the hashes of all layers that decode. slices: the layer of each slice that decodes.
 *
 * @typedef {object} Vector
 * @property {string} file
 * @property {Uint8Array} bytes
 * @property {Uint8Array | null} base that is given with the file
 * @property {string | null} error
 * @property {string | null} scene
 * @property {number | null} chunk
 * @property {number | null} offset null if it is not fixed
 * @property {import("../decode/hashes.js").LayerHashes[]} layers
 * @property {number[]} slices
 */

/** @returns {Vector[]} */
export function readVectors() {
  const manifest = JSON.parse(readFileSync(new URL("manifest.json", FOLDER), "utf8"));
  return manifest.vectors.map((/** @type {any} */ row) => {
    const { file, error = null, scene = null, chunk = null, offset = null, layers } = row;
    const [bytes, base] = [file, row.base].map((name) => name && new Uint8Array(readFileSync(new URL(name, FOLDER))));
    if (row.ans_only === "UnsupportedFeature") {
      const nothing = { scene: null, chunk: null, offset: null, layers: [], slices: [] };
      return { file, bytes, base, error: row.ans_only, ...nothing };
    }
    const slices = row.slices ?? layers.map((/** @type {{layer: number}} */ { layer }) => layer);
    return { file, bytes, base, error, scene, chunk, offset, layers, slices };
  });
}

/** One vector's bytes. @param {string} name without the ending */
export function readVector(name) {
  return new Uint8Array(readFileSync(new URL(`${name}.pd4`, FOLDER)));
}

/** The scene of a vector that is a scaffold. @param {string} name */
export function readScaffold(name) {
  const scene = decode(readVector(name));
  assert.ok(scene.kind === "scaffold");
  return scene;
}

/** Each slice's layer with its end in a whole file. @param {Uint8Array} bytes */
export function endsOf(bytes) {
  const stream = openStream();
  stream.feed(bytes);
  assert.ok(stream.complete && stream.consumed === bytes.length);
  return stream.layerEnds;
}

/** An address of these bytes. @param {Uint8Array} bytes */
export const addressOf = (bytes) => `data:;base64,${Buffer.from(bytes).toString("base64")}`;

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
