// Clause 12.4: digests of what a file decodes to.

import { Sha256, hex } from "./digests.js";
import { channelCount } from "./header.js";
import { readAll } from "./reader.js";
import { joined, mortonOrder, reordered } from "./slices.js";

/** In hexadecimal. @typedef {{layer: number, symbols: string, tensors: string}} LayerHashes */

const LITTLE_ENDIAN = new Uint8Array(Uint16Array.of(1).buffer)[0] === 1;

/** @param {(Int32Array | Float32Array)[]} arrays */
function digest(arrays) {
  const hash = new Sha256();
  for (const { buffer, byteOffset, byteLength } of arrays) {
    let bytes = new Uint8Array(buffer, byteOffset, byteLength);
    if (!LITTLE_ENDIAN) {
      bytes = bytes.slice();
      for (let at = 0; at < bytes.length; at += 4) bytes.subarray(at, at + 4).reverse();
    }
    hash.update(bytes);
  }
  return hex(hash.digest());
}

/**
 * Per layer the SHA-256 of its integers and of its float32 values, of a complete file, of its layers up to maxLayer,
 * or, if allowPartial, of the slices that a cut file has. Raises as `decode` does.
 *
 * @param {Uint8Array} bytes @param {{maxLayer?: number | null, allowPartial?: boolean}} [options]
 * @returns {LayerHashes[]}
 */
export function hashes(bytes, { maxLayer = null, allowPartial = false } = {}) {
  /** @type {import("./reader.js").Slice[][]} */
  const layers = [];
  readAll(bytes, maxLayer, allowPartial, (slice) => {
    if (slice.later) layers[layers.length - 1].push(slice);
    else layers.push([slice]);
  });
  return layers.map(hashesOf);
}

/** @param {import("./reader.js").Slice[]} slices of one layer @returns {LayerHashes} */
function hashesOf(slices) {
  const [{ symbols, tensors }] = slices;
  const voxels = joined(slices.map((slice) => slice.symbols.voxels));
  const order = slices.length > 1 ? mortonOrder(voxels) : null;
  /** The rows of all slices. @template {Int32Array | Float32Array} A @param {A[]} arrays */
  const sorted = (arrays) => (order ? reordered(joined(arrays), order) : arrays[0]);
  const channels = channelCount(symbols.kind.widths);
  const attributes = Array.from({ length: channels }, (_, c) =>
    sorted(
      slices.map(({ symbols: { attributes: all, parameters } }) =>
        all.subarray(c * parameters.rows, (c + 1) * parameters.rows),
      ),
    ),
  );
  /** @param {"anchor" | "feature" | "scalingLog" | "offset"} name */
  const values = (name) => sorted(slices.map((slice) => slice.tensors[name]));
  const codes = sorted(slices.map((slice) => slice.symbols.codes));
  const classes = symbols.kind.stepClasses ? [sorted(slices.map((slice) => slice.symbols.stepClasses))] : [];
  const rows = [sorted([voxels]), symbols.rises, codes, ...classes, ...attributes];
  const own = [values("anchor"), values("feature"), values("scalingLog"), values("offset")];
  return {
    layer: symbols.kind.layer,
    symbols: digest([...rows, ...symbols.planes, ...symbols.weights]),
    tensors: digest([...own, ...tensors.planes, ...tensors.weights]),
  };
}
