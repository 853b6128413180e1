// Clause 12.4: digests of what a file decodes to.

import { hex, sha256 } from "./digests.js";
import { readAll } from "./reader.js";

/** In hexadecimal. @typedef {{layer: number, symbols: string, tensors: string}} LayerHashes */

const LITTLE_ENDIAN = new Uint8Array(Uint16Array.of(1).buffer)[0] === 1;

/** @param {(Int32Array | Float32Array)[]} arrays */
function digest(arrays) {
  return hex(sha256(...arrays.map(({ buffer, byteOffset, byteLength }) => {
    const bytes = new Uint8Array(buffer, byteOffset, byteLength);
    return LITTLE_ENDIAN ? bytes : bytes.map((_, i) => bytes[i ^ 3]);
  })));
}

/** Per layer the SHA-256 of its integers and of its float32 values, of a complete file, of its layers up to maxLayer,
 * or, if allowPartial, of the slices that a cut file has. Raises as `decodeTensors` does.
 * @param {Uint8Array} bytes @param {import("./index.js").Options} [options]
 * @returns {LayerHashes[]} */
export function hashes(bytes, options = {}) {
  const { header, layers, voxels, positions, rows, classes } = readAll(bytes, options, null);
  let first = header.base?.rows ?? 0;
  return layers.map(({ layer, codes, rowTensors, rows: layerRows, grids, chains }, i) => {
    const end = codes.length;
    const before = layers[i - 1]?.codes; // those of a base are above 0
    const rises = codes.subarray(0, first).map((code, row) => (before ? code - before[row] : Number(code === 0)));
    const symbols = [voxels.subarray(3 * first, 3 * end), symbolsOf(rises), symbolsOf(codes.subarray(first))];
    if (classes) symbols.push(symbolsOf(classes.subarray(first, end)));
    const tensors = [positions.subarray(3 * first, 3 * end)];
    /** @param {Float32Array} values @param {number} step @param {number} [channels] */
    const add = (values, step, channels) => {
      symbols.push(symbolsOf(values, step, channels));
      tensors.push(values);
    };
    for (const [k, { step, channels }] of header.rows.entries()) {
      add(rows[k].subarray(channels * first, channels * end), step, channels);
    }
    for (const [k, { step, channels }] of rowTensors.entries()) add(layerRows[k], step, channels);
    const own = i || !header.base; // else grids and chains are the base's
    for (const { step, planes } of own ? grids : []) for (const { data } of planes) add(data, step);
    for (const { step, network } of own ? chains : []) {
      for (const { weight, bias } of network) for (const values of [weight, bias]) add(values, step);
    }
    first = end;
    return { layer, symbols: digest(symbols), tensors: digest(tensors) };
  });
}

/** The symbols, channel by channel, of values [rows, channels]. Each is the nearest integer to its value in steps, of
 * which rounding to binary32 took less than 1/2: symbols have 24 bits. @param {Float32Array | Uint8Array} values
 * @param {number} [step] @param {number} [channels] */
function symbolsOf(values, step = 1, channels = 1) {
  const symbols = new Int32Array(values.length);
  let at = 0;
  for (let c = 0; c < channels; c++) {
    for (let i = c; i < values.length; i += channels) symbols[at++] = Math.round(values[i] / step);
  }
  return symbols;
}
