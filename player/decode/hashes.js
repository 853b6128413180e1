// Clause 12.4: digests of what a file decodes to.

import { Sha256, hex } from "./digests.js";
import { LayerReader } from "./reader.js";

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
 * Per layer the SHA-256 of its integers and of its float32 values, of a complete file or of its layers up to maxLayer.
 * Raises as `decode` does.
 *
 * @param {Uint8Array} bytes @param {{maxLayer?: number | null}} [options]
 * @returns {LayerHashes[]}
 */
export function hashes(bytes, { maxLayer = null } = {}) {
  const reader = new LayerReader();
  const rows = [];
  for (;;) {
    const layer = reader.next(bytes.subarray(reader.offset), maxLayer);
    if (!layer) return rows;
    const { kind, voxels, rises, codes, attributes, planes, weights } = layer.symbols;
    const { anchor, feature, scalingLog, offset, ...networks } = layer.tensors;
    rows.push({
      layer: kind.layer,
      symbols: digest([voxels, rises, codes, attributes, ...planes, ...weights]),
      tensors: digest([anchor, feature, scalingLog, offset, ...networks.planes, ...networks.weights]),
    });
  }
}
