// Clause 12.4: digests of what a file decodes to.

import { hex, sha256 } from "./digests.js";
import { channelCount } from "./header.js";
import { readAll } from "./reader.js";
import { mortonOrder } from "./voxels.js";
/** @import { LayerSymbols } from "./layer.js" */
/** @import { Scene } from "./scene.js" */

/** In hexadecimal. @typedef {{layer: number, symbols: string, tensors: string}} LayerHashes */

const LITTLE_ENDIAN = new Uint8Array(Uint16Array.of(1).buffer)[0] === 1;

/** @param {(Int32Array | Float32Array)[]} arrays */
function digest(arrays) {
  const bytes = joined(arrays.map((array) => new Uint8Array(array.buffer, array.byteOffset, array.byteLength)));
  if (!LITTLE_ENDIAN) for (let at = 0; at < bytes.length; at += 4) bytes.subarray(at, at + 4).reverse();
  return hex(sha256(bytes));
}

/** One behind the other. @template {Uint8Array | Int32Array} A @param {A[]} arrays at least one @returns {A} */
function joined(arrays) {
  const type = /** @type {new (length: number) => A} */ (arrays[0].constructor);
  const all = new type(arrays.reduce((sum, { length }) => sum + length, 0));
  let at = 0;
  for (const array of arrays) {
    all.set(array, at);
    at += array.length;
  }
  return all;
}

/**
 * Per layer the SHA-256 of its integers and of its float32 values, of a complete file, of its layers up to maxLayer,
 * or, if allowPartial, of the slices that a cut file has. Raises as `decode` does.
 *
 * @param {Uint8Array} bytes @param {{maxLayer?: number | null, allowPartial?: boolean}} [options]
 * @returns {LayerHashes[]}
 */
export function hashes(bytes, { maxLayer = null, allowPartial = false } = {}) {
  /** @type {LayerSymbols[]} */
  const slices = [];
  const scene = readAll(bytes, maxLayer, allowPartial, (slice) => slices.push(slice));
  return scene.layers.map((layer, i) => ({
    layer,
    symbols: digest(symbolsOf(scene, i, slices.filter(({ kind }) => kind.layer === layer))),
    tensors: digest(tensorsOf(scene, i)),
  }));
}

/** @param {Scene} scene @param {number} i index of the layer @param {LayerSymbols[]} slices of it */
function symbolsOf(scene, i, slices) {
  const [{ kind, rises, planes, weights }] = slices;
  const order = slices.length > 1 ? mortonOrder(joined(slices.map(({ voxels }) => voxels))) : null;
  /** A channel of all slices. @param {(slice: LayerSymbols) => Int32Array} of */
  const rows = (of) => {
    const all = joined(slices.map(of));
    return order ? Int32Array.from(order, (row) => all[row]) : all;
  };
  const first = scene.rows[i - 1] ?? 0;
  const codes = Int32Array.from(scene.mask[i].subarray(first));
  const classes = kind.stepClasses ? [rows((slice) => slice.stepClasses)] : [];
  const channels = Array.from({ length: channelCount(kind.widths) }, (_, c) =>
    rows((slice) => slice.attributes.subarray(c * slice.codes.length, (c + 1) * slice.codes.length)),
  );
  const voxels = scene.anchorQ.subarray(3 * first, 3 * scene.rows[i]);
  return [voxels, rises, codes, ...classes, ...channels, ...planes, ...weights];
}

/** @param {Scene} scene @param {number} i index of the layer */
function tensorsOf(scene, i) {
  const deformation = [null, scene.globalDeformation, scene.localDeformation][scene.layers[i]];
  const networks = scene.layers[i] ? (deformation?.networks ?? {}) : scene.networks;
  const all = scene.rows[scene.rows.length - 1];
  const rows = [scene.anchor, scene.feature, scene.scalingLog, scene.offset].map((values) => {
    const width = values.length / all;
    return values.subarray(width * (scene.rows[i - 1] ?? 0), width * scene.rows[i]);
  });
  const planes = deformation?.planes.flatMap((scale) => Object.values(scale).map(({ data }) => data)) ?? [];
  return [...rows, ...planes, ...Object.values(networks).flat().flatMap(({ weight, bias }) => [weight, bias])];
}
