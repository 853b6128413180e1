/**
 * A decoder of `.pd4` files: bytes in, typed arrays out. It follows the specification clause by clause and trusts no
 * byte; every fault is a DecodeError with the name that clause 15 gives it. It decodes mode ans; mode lzma is
 * UnsupportedFeature (clause 16).
 *
 * @module
 */

import { readAll } from "./reader.js";
import { Stream } from "./stream.js";

export { DecodeError } from "./errors.js";
export { hashes } from "./hashes.js";
export { Stream } from "./stream.js";

/** @typedef {import("./scene.js").Scene} Scene */
/** @typedef {import("./scene.js").Info} Info */
/** @typedef {import("./scene.js").Camera} Camera */
/** @typedef {import("./scene.js").Steps} Steps */
/** @typedef {import("./scene.js").Network} Network */
/** @typedef {import("./scene.js").Deformation} Deformation */
/** @typedef {import("./scene.js").Plane} Plane */
/** @typedef {import("./errors.js").ErrorKind} ErrorKind */

/**
 * The scene of a file, or of its layers up to maxLayer (bytes behind them are not looked at).
 *
 * A cut file raises Truncated, or yields its longest prefix of complete slices if allowPartial, which still needs the
 * first; the scene then ends early. Other faults raise the other kinds of DecodeError.
 *
 * @param {Uint8Array | ArrayBuffer} bytes
 * @param {{maxLayer?: number | null, allowPartial?: boolean}} [options]
 * @returns {Scene}
 */
export function decode(bytes, { maxLayer = null, allowPartial = false } = {}) {
  const data = bytes instanceof Uint8Array ? bytes : new Uint8Array(bytes);
  return readAll(data, maxLayer, allowPartial);
}

/**
 * A decoder that takes a file in pieces: `feed(bytes)` gives the newest scene of each layer that they
 * complete a slice of.
 *
 * @param {{maxLayer?: number | null}} [options]
 * @returns {Stream}
 */
export function openStream(options) {
  return new Stream(options);
}
