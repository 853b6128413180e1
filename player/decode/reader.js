// Clause 12: a file's chunks in order, layer by layer, to scenes.

import { CHUNK_OVERHEAD, PREAMBLE_SIZE, readChunk, readPreamble } from "./container.js";
import { DecodeError, limitExceeded, malformed, unsupported } from "./errors.js";
import { LAYER_TYPES, readHeader } from "./header.js";
import { MOST_CODE, decodeLayer, dequantise, transposed } from "./layer.js";
import { layerKind } from "./parameters.js";
import { PLANES } from "./scene.js";
import { VoxelTable } from "./voxels.js";

/** @typedef {import("./layer.js").LayerSymbols} LayerSymbols */
/** @typedef {import("./scene.js").Scene} Scene */

/**
 * The float32 values of one layer's own rows and networks, in the order of 12.4.
 *
 * @typedef {object} LayerTensors
 * @property {Float32Array} anchor
 * @property {Float32Array} feature
 * @property {Float32Array} scalingLog
 * @property {Float32Array} offset
 * @property {Float32Array[]} planes
 * @property {Float32Array[]} weights
 */

/** Reads a file layer by layer. It keeps no bytes but the header's: every call gets what follows those it consumed. */
export class LayerReader {
  constructor() {
    /** @type {import("./header.js").Header | null} */
    this.header = null;
    /** Of the next chunk, or of the header before it is read. */
    this.offset = 0;
    /** What the layers read so far hold. @type {LayerParts[]} */
    this._layers = [];
    this._index = 0;
    /** The mask codes of all rows so far. */
    this._codes = new Uint8Array(0);
    /** By those layers. @type {import("./parameters.js").Declared} */
    this._declared = { rows: 0, symbols: 0, bytes: 0 };
  }

  /** Whether every chunk that the header lists has been read. */
  get complete() {
    return this.header !== null && this._index === this.header.chunks.length;
  }

  /** How many layers have been read. */
  get count() {
    return this._layers.length;
  }

  /** The rows of the layers read so far. */
  get rows() {
    return this._codes.length;
  }

  /**
   * Reads the header, unless it has been read. Raises Truncated, with nothing consumed, if `bytes` end before.
   *
   * @param {Uint8Array} bytes from offset on
   * @returns {import("./header.js").Header}
   */
  readHeader(bytes) {
    if (this.header) return this.header;
    const packed = readPreamble(bytes);
    this.header = readHeader(packed);
    this.offset = PREAMBLE_SIZE + packed.length;
    return this.header;
  }

  /**
   * Reads on to the end of one more layer of at most maxLayer; null if the file has no more.
   *
   * Raises Truncated if the bytes end before: what was consumed until then stays so. Of a file that is read whole
   * (maxLayer null), bytes behind the last chunk are Malformed.
   *
   * @param {Uint8Array} bytes the file from byte `offset` of it on, where this reader stands @param {number | null} maxLayer
   * @returns {{symbols: LayerSymbols, tensors: LayerTensors} | null}
   */
  next(bytes, maxLayer) {
    const start = this.offset;
    const { chunks } = this.readHeader(bytes);
    while (this._index < chunks.length) {
      if (maxLayer !== null && !chunks.slice(this._index).some(({ type }) => type < LAYER_TYPES && type <= maxLayer)) {
        return null;
      }
      const layer = this._readChunk(bytes.subarray(this.offset - start), chunks[this._index]);
      if (layer) return layer;
    }
    const left = start + bytes.length - this.offset;
    if (maxLayer === null && left > 0) {
      const message = `${left} bytes follow the last chunk, expected none`;
      throw new DecodeError("Malformed", message, { offset: this.offset });
    }
    return null;
  }

  /** @param {Uint8Array} bytes from the chunk on @param {import("./header.js").ListedChunk} listed */
  _readChunk(bytes, listed) {
    const { header, offset } = this;
    const index = this._index;
    if (!header) throw new TypeError("no header");
    const chunk = readChunk(bytes, { listed, sceneId: header.sceneId, offset, index });
    /** @param {DecodeError} error @param {number} at */
    const located = (error, at) => new DecodeError(error.kind, error.reason, { offset: offset + at, chunk: index });
    const isLayer = listed.type < LAYER_TYPES;
    if (!isLayer && !chunk.ancillary) throw located(unsupported(`critical chunk of unknown type ${listed.type}`), 0);
    if (isLayer && chunk.ancillary) throw located(malformed(`layer ${listed.type} is flagged ancillary`), 0);
    let layer = null;
    if (isLayer) {
      try {
        const symbols = decodeLayer(chunk.payload, layerKind(listed.type, header.widths), this._declared);
        layer = { symbols, tensors: this._accept(symbols) };
        this._declared = symbols.parameters.declared;
      } catch (error) {
        // What an engine says where it cannot allocate an array.
        const full = error instanceof RangeError && /allocation|array length|buffer length/i.test(error.message);
        const fault = full ? limitExceeded(`layer ${listed.type} takes more memory than there is`) : error;
        throw fault instanceof DecodeError ? located(fault, 0) : fault;
      }
    }
    this._index++;
    this.offset += CHUNK_OVERHEAD + listed.length;
    return layer;
  }

  /** The rules of 12.1 that need header and earlier layers, then dequantisation. @param {LayerSymbols} symbols */
  _accept(symbols) {
    const { kind, parameters, voxels, rises, codes } = symbols;
    const header = /** @type {import("./header.js").Header} */ (this.header);
    const where = `layer ${kind.layer}`;
    const all = new Uint8Array(rises.length + codes.length);
    for (let i = 0; i < rises.length; i++) {
      const code = this._codes[i] + rises[i];
      if (code > MOST_CODE) throw malformed(`${where}: a mask code of ${code}, limit ${MOST_CODE}`);
      all[i] = code;
    }
    all.set(codes, rises.length);
    this._checkVoxels(voxels);
    const tensors = this._tensorsOf(symbols, header);
    if (parameters.steps.length) {
      for (const number of kind.classes) {
        if (!header.bounds.has(number)) throw malformed(`${where}: the header has no error bound of class ${number}`);
      }
    }
    this._codes = all;
    const { steps, planes, networks } = parameters;
    this._layers.push({ layer: kind.layer, steps, planes, networks, voxels, tensors, mask: all });
    return tensors;
  }

  /** @param {Int32Array} voxels of the next layer, distinct among themselves */
  _checkVoxels(voxels) {
    const parts = [...this._layers.map((layer) => layer.voxels), voxels].filter((part) => part.length);
    if (parts.length < 2 || !voxels.length) return;
    const count = parts.reduce((sum, part) => sum + part.length, 0) / 3;
    const axes = [0, 1, 2].map(() => new Int32Array(count));
    const table = new VoxelTable(count, axes);
    let row = 0;
    for (const part of parts) {
      for (let i = 0; i < part.length; i += 3, row++) {
        const x = part[i], y = part[i + 1], z = part[i + 2];
        if (table.find(x, y, z) >= 0) throw malformed(`voxel ${x} ${y} ${z} holds more than one anchor`);
        axes[0][row] = x;
        axes[1][row] = y;
        axes[2][row] = z;
        table.add(row);
      }
    }
  }

  /** @param {LayerSymbols} symbols @param {import("./header.js").Header} header @returns {LayerTensors} */
  _tensorsOf({ parameters, voxels, attributes, planes, weights }, header) {
    const { rows, steps } = parameters;
    const { feature: D, slots: G } = header.widths;
    let at = 0;
    const [feature, scalingLog, offset] = [D, 6, 3 * G].map((width, i) =>
      transposed(attributes.subarray(at, (at += width * rows)), rows, width, header.steps[i]),
    );
    return {
      anchor: dequantise(voxels, header.info.voxelSize),
      feature,
      scalingLog,
      offset,
      planes: planes.map((plane) => dequantise(plane, steps[0])),
      weights: weights.map((weight) => dequantise(weight, steps[steps.length - 1])),
    };
  }

  /** The scene of the layers read so far, at least one. @returns {Scene} */
  scene() {
    const header = this.header;
    if (!header || !this._layers.length) throw new TypeError("no layer has been read");
    const [first, ...later] = this._layers;
    const networks = networksOf(first);
    const [feature, scalingLog, offset] = header.steps;
    /** @type {import("./scene.js").Steps} */
    const steps = { feature, scalingLog, offset, weightsScaffold: first.steps[0] };
    /** @type {(import("./scene.js").Deformation | null)[]} */
    const deformations = [null, null];
    for (const layer of later) {
      const [ofPlanes, ofWeights] = layer.steps;
      if (ofPlanes === undefined) continue;
      deformations[layer.layer - 1] = { planes: planesOf(layer), networks: networksOf(layer) };
      if (layer.layer === 1) Object.assign(steps, { planesGlobal: ofPlanes, weightsGlobal: ofWeights });
      else Object.assign(steps, { planesLocal: ofPlanes, weightsLocal: ofWeights });
    }
    const layers = this._layers;
    return {
      info: header.info,
      steps,
      layers: layers.map(({ layer }) => layer),
      rows: layers.map(({ mask }) => mask.length),
      anchorQ: joined(layers.map(({ voxels }) => voxels), Int32Array),
      anchor: joined(layers.map(({ tensors }) => tensors.anchor), Float32Array),
      feature: joined(layers.map(({ tensors }) => tensors.feature), Float32Array),
      scalingLog: joined(layers.map(({ tensors }) => tensors.scalingLog), Float32Array),
      offset: joined(layers.map(({ tensors }) => tensors.offset), Float32Array),
      mask: layers.map(({ mask }) => mask),
      networks: { opacity: networks.opacity, covariance: networks.covariance, color: networks.color },
      globalDeformation: deformations[0],
      localDeformation: deformations[1],
    };
  }
}

/**
 * What is kept of a layer. mask: the codes of all rows so far.
 *
 * @typedef {object} LayerParts
 * @property {number} layer
 * @property {number[]} steps
 * @property {import("./parameters.js").PlaneShape[]} planes
 * @property {import("./parameters.js").NetworkShape[]} networks
 * @property {Int32Array} voxels
 * @property {LayerTensors} tensors
 * @property {Uint8Array} mask
 */

/** @param {LayerParts} layer */
function networksOf({ networks, tensors }) {
  let at = 0;
  /** @type {Record<string, import("./scene.js").Network>} */
  const named = {};
  for (const { name, layers } of networks) {
    named[name] = layers.map((shape) => ({ ...shape, weight: tensors.weights[at++], bias: tensors.weights[at++] }));
  }
  return named;
}

/** @param {LayerParts} layer @returns {Record<import("./scene.js").PlaneName, import("./scene.js").Plane>[]} */
function planesOf({ planes, tensors }) {
  const scales = [];
  for (let i = 0; i < planes.length; i += PLANES.length) {
    const named = PLANES.map((name, p) => {
      const { channels, height, width } = planes[i + p];
      return [name, { data: tensors.planes[i + p], channels, height, width }];
    });
    scales.push(Object.fromEntries(named));
  }
  return scales;
}

/**
 * The arrays one behind the other; the only one that is not empty as it is.
 *
 * @template {Int32Array | Float32Array} A
 * @param {A[]} arrays @param {new (length: number) => A} type
 * @returns {A}
 */
function joined(arrays, type) {
  const filled = arrays.filter((array) => array.length);
  if (filled.length === 1) return filled[0];
  const all = new type(filled.reduce((sum, array) => sum + array.length, 0));
  let at = 0;
  for (const array of filled) {
    all.set(array, at);
    at += array.length;
  }
  return all;
}
