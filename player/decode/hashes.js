// Clause 12.4: digests of what a file decodes to.

import { channelsOf } from "./channels.js";
import { joined } from "./columns.js";
import { hex, sha256 } from "./digests.js";
import { widthOf } from "./fields.js";
import { readAll } from "./reader.js";
import { mortonOrder } from "./voxels.js";
/** @import { Slice } from "./slice.js" */
/** @import { Tensors } from "./tensors.js" */

/** In hexadecimal. @typedef {{layer: number, symbols: string, tensors: string}} LayerHashes */

const LITTLE_ENDIAN = new Uint8Array(Uint16Array.of(1).buffer)[0] === 1;

/** @param {(Int32Array | Float32Array)[]} arrays */
function digest(arrays) {
  const bytes = joined(Uint8Array, arrays.map(({ buffer, byteOffset, byteLength }) => {
    return new Uint8Array(buffer, byteOffset, byteLength);
  }));
  if (!LITTLE_ENDIAN) for (let at = 0; at < bytes.length; at += 4) bytes.subarray(at, at + 4).reverse();
  return hex(sha256(bytes));
}

/** Per layer the SHA-256 of its integers and of its float32 values, of a complete file, of its layers up to maxLayer,
 * or, if allowPartial, of the slices that a cut file has. Raises as `decodeTensors` does.
 * @param {Uint8Array} bytes @param {import("./index.js").Options} [options]
 * @returns {LayerHashes[]} */
export function hashes(bytes, options = {}) {
  /** @type {Slice[]} */
  const slices = [];
  const tensors = readAll(bytes, options, null, (slice) => slices.push(slice));
  let first = tensors.header.base?.rows ?? 0;
  return tensors.layers.map(({ layer, codes: { length: end } }, i) => {
    const symbols = symbolsOf(tensors, i, first, slices.filter((slice) => slice.layer === layer));
    const values = valuesOf(tensors, i, first, end);
    first = end;
    return { layer, symbols: digest(symbols), tensors: digest(values) };
  });
}

/** @param {Tensors} tensors @param {number} i index of the layer @param {number} first row of its own
 * @param {Slice[]} slices of it */
function symbolsOf({ header: { width }, voxels, layers }, i, first, slices) {
  const order = slices.length > 1 ? mortonOrder(joined(Int32Array, slices.map((slice) => slice.voxels))) : null;
  /** Channels of all slices, which first have so many rows of earlier layers. @param {number} count
   * @param {(slice: Slice) => Int32Array} of @param {number} [earlier] */
  const channels = (count, of, earlier = 0) => {
    const parts = slices.map((slice) => channelsOf(of(slice), count));
    return Array.from({ length: count }, (_, c) => {
      const came = joined(Int32Array, parts.map((part) => part[c]));
      return order ? came.map((v, k) => (k < earlier ? v : came[earlier + order[k - earlier]])) : came;
    });
  };
  const [{ rises, stepClasses, planes, weights }] = slices;
  const { codes, rowTensors } = layers[i];
  const classes = stepClasses ? channels(1, (slice) => /** @type {Int32Array} */ (slice.stepClasses)) : [];
  const rows = channels(width, (slice) => slice.rows);
  const layerRows = channels(widthOf(rowTensors), (slice) => slice.layerRows, first);
  const own = [voxels.subarray(3 * first, 3 * codes.length), rises, Int32Array.from(codes.subarray(first))];
  return [...own, ...classes, ...rows, ...layerRows, ...planes, ...weights];
}

/** @param {Tensors} tensors @param {number} i index of the layer @param {number} first row of its own
 * @param {number} end behind its rows */
function valuesOf({ header, positions, rows, layers }, i, first, end) {
  const { rows: layerRows, grids, chains } = layers[i];
  const own = rows.map((values, k) => {
    const { channels } = header.rows[k];
    return values.subarray(channels * first, channels * end);
  });
  if (header.base && !i) return [positions.subarray(3 * first, 3 * end), ...own]; // the rest is the base's
  const planes = grids.flatMap((grid) => grid.planes.map(({ data }) => data));
  const weights = chains.flatMap(({ network }) => network.flatMap(({ weight, bias }) => [weight, bias]));
  return [positions.subarray(3 * first, 3 * end), ...own, ...layerRows, ...planes, ...weights];
}
