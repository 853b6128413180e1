// Clause 12: a file's chunks in order, slice by slice, to scenes.

import { Column } from "./columns.js";
import { CHUNK_OVERHEAD, PREAMBLE_SIZE, readChunk, readPreamble } from "./container.js";
import { DecodeError, limitExceeded, malformed, unsupported } from "./errors.js";
import { LAYER_TYPES, readHeader } from "./header.js";
import { MOST_CODE, decodeLayer, dequantise, transposed } from "./layer.js";
import { layerKind } from "./parameters.js";
import { VoxelTable, mortonOrder } from "./voxels.js";
/** @import { Header } from "./header.js" */
/** @import { Continuation, LayerSymbols } from "./layer.js" */
/** @import { Declared, NetworkShape, PlaneShape } from "./parameters.js" */
/** @import { Deformation, Network, Scale, Scene, Steps } from "./scene.js" */

/**
 * Reads a whole file, or its layers up to maxLayer; of a cut file, if allowPartial, the slices that are there, at least
 * one. Raises DecodeError.
 *
 * @param {Uint8Array} bytes @param {number | null} maxLayer @param {boolean} allowPartial
 * @param {(slice: LayerSymbols) => void} [take] is given each slice
 * @returns {Scene}
 */
export function readAll(bytes, maxLayer, allowPartial, take) {
  const reader = new LayerReader(maxLayer);
  try {
    for (let slice; (slice = reader.next(bytes.subarray(reader.offset))); ) take?.(slice);
  } catch (error) {
    const cut = error instanceof DecodeError && error.kind === "Truncated";
    if (!cut || !allowPartial || !reader.count) throw error;
  }
  reader.sort();
  return reader.scene();
}

/** Reads a file slice by slice. It keeps no bytes but the header's: every call gets what follows those it consumed. */
export class LayerReader {
  /** @param {number | null} maxLayer layers above it are not read; null: all are */
  constructor(maxLayer) {
    if (maxLayer !== null && !(Number.isInteger(maxLayer) && maxLayer >= 0)) {
      throw new RangeError(`maxLayer is ${maxLayer}, expected 0 or more`);
    }
    this.maxLayer = maxLayer;
    /** @type {Header | null} */
    this.header = null;
    /** Each slice's layer with the end of its chunk in the file, in file order; empty until the header is there.
     * @type {{layer: number, end: number}[]} */
    this.layerEnds = [];
    /** Bytes of the file as its header has them, null until it is there. @type {number | null} */
    this.end = null;
    /** Of the next chunk, or of the header before it is read. */
    this.offset = 0;
    /** What the layers read so far hold. @type {LayerParts[]} */
    this._layers = [];
    /** What all rows hold. @type {Record<string, Column<any>>} */
    this._columns = {};
    this._index = 0;
    /** By chunk, the layer of the first slice behind those before it; null if there is none. @type {(number | null)[]} */
    this._following = [];
    /** By chunk, the part of all slices' bytes that has come with it. @type {number[]} */
    this._share = [];
    /** How many slices have been read. */
    this.count = 0;
    /** By those slices. @type {Declared} */
    this._declared = { rows: 0, symbols: 0, bytes: 0, scales: [] };
    this._voxels = new VoxelTable();
    /** Voxels that are not in the table yet: of one slice nothing is looked up. @type {Int32Array[]} */
    this._loose = [];
  }

  /** Whether every layer that was asked for has been read, and without maxLayer every chunk. */
  get complete() {
    if (!this.header) return false;
    if (this.maxLayer === null) return this._index === this.header.chunks.length;
    return (this._following[this._index] ?? Infinity) > this.maxLayer;
  }

  /** Reads the header. Raises Truncated, with nothing consumed, if `bytes` end before. @param {Uint8Array} bytes */
  _begin(bytes) {
    const packed = readPreamble(bytes);
    const header = readHeader(packed);
    this.header = header;
    this.offset = PREAMBLE_SIZE + packed.length;
    this._following = [null];
    for (const { type } of [...header.chunks].reverse()) {
      this._following.unshift(type < LAYER_TYPES ? type : this._following[0]);
    }
    let end = this.offset;
    let come = 0;
    const sums = header.chunks.map(({ type, length }) => {
      end += CHUNK_OVERHEAD + length;
      if (type >= LAYER_TYPES) return come;
      this.layerEnds.push({ layer: type, end });
      return (come += length);
    });
    this.end = end;
    this._share = sums.map((sum) => sum / come);
    const { feature, slots } = header.widths;
    const widths = { anchor: 3, feature, scalingLog: 6, offset: 3 * slots };
    this._columns = { voxels: new Column(Int32Array, 3) };
    for (const [name, width] of Object.entries(widths)) this._columns[name] = new Column(Float32Array, width);
    return header;
  }

  /** Whether the layer of the latest slice has no further ones. */
  get whole() {
    return this._following[this._index] !== this._layers[this._layers.length - 1].layer;
  }

  /**
   * Reads on to the end of one more slice; null if the file has no more that were asked for.
   *
   * Raises Truncated if the bytes end before: what was consumed until then stays so. Of a file that is read whole,
   * bytes behind the last chunk are Malformed.
   *
   * @param {Uint8Array} bytes the file from byte `offset` of it on, where this reader stands
   * @returns {LayerSymbols | null}
   */
  next(bytes) {
    const start = this.offset;
    const header = this.header ?? this._begin(bytes);
    while (!this.complete) {
      const slice = this._readChunk(bytes.subarray(this.offset - start), header);
      if (slice) return slice;
    }
    const left = start + bytes.length - this.offset;
    if (this.maxLayer === null && left > 0) {
      const message = `${left} bytes follow the last chunk, expected none`;
      throw new DecodeError("Malformed", message, { offset: this.offset });
    }
    return null;
  }

  /** @param {Uint8Array} bytes from the chunk on @param {Header} header */
  _readChunk(bytes, header) {
    const { offset, _index: index } = this;
    const listed = header.chunks[index];
    const chunk = readChunk(bytes, { listed, sceneId: header.sceneId, offset, index });
    const undo = this._mark();
    let slice = null;
    try {
      if (listed.type < LAYER_TYPES) slice = this._readSlice(chunk, listed.type, header);
      else if (!chunk.ancillary) throw unsupported(`critical chunk of unknown type ${listed.type}`);
    } catch (error) {
      undo();
      // What an engine says where it cannot allocate an array.
      const full = error instanceof RangeError && /allocation|array length|buffer length/i.test(error.message);
      const fault = full ? limitExceeded(`layer ${listed.type} takes more memory than there is`) : error;
      if (!(fault instanceof DecodeError)) throw fault;
      throw new DecodeError(fault.kind, fault.reason, { offset: offset + (fault.offset ?? 0), chunk: index });
    }
    this._index++;
    this.offset += CHUNK_OVERHEAD + listed.length;
    return slice;
  }

  /** A slice, which is added to its layer. Offsets in its faults count from the chunk.
   * @param {ReturnType<typeof readChunk>} chunk @param {number} layer @param {Header} header */
  _readSlice({ ancillary, more, number, payload }, layer, header) {
    if (ancillary) throw malformed(`layer ${layer} is flagged ancillary`);
    const latest = this._layers[this._layers.length - 1];
    const later = latest?.layer === layer;
    const expected = later ? latest.slices : 0;
    const next = this._following[this._index + 1];
    const flagged = (/** @type {string} */ reason) => new DecodeError("Malformed", reason, { offset: 2 });
    if (number !== expected) throw flagged(`slice ${number}, expected ${expected}`);
    if (next !== null && more !== (next === layer)) {
      throw flagged(`layer ${layer} ${more ? "announces a further slice" : "ends"}, but layer ${next} follows`);
    }
    const continuation = later ? latest.continuation : { positions: [], masks: [], attributes: [] };
    const symbols = decodeLayer(payload, layerKind(layer, header), this._declared, continuation, later);
    this._accept(symbols, continuation, later, header);
    this._declared = symbols.parameters.declared;
    this.count++;
    return symbols;
  }

  /** The rules of 12.1 that need header and earlier slices, then dequantisation.
   * @param {LayerSymbols} symbols @param {Continuation} continuation @param {boolean} later @param {Header} header */
  _accept(symbols, continuation, later, header) {
    const { kind, parameters, voxels, rises } = symbols;
    const { steps, scales, networks, key } = parameters;
    const where = `layer ${kind.layer}`;
    const latest = this._layers[this._layers.length - 1];
    const before = rises.length ? latest.codes.values : rises; // of a whole layer, in order
    const earlier = Uint8Array.from(rises);
    for (let i = 0; i < rises.length; i++) {
      const code = before[i] + rises[i];
      if (code > MOST_CODE) throw malformed(`${where}: a mask code of ${code}, limit ${MOST_CODE}`);
      earlier[i] = code;
    }
    this._checkVoxels(voxels);
    const rows = { voxels, anchor: dequantise(voxels, header.info.voxelSize), ...attributesOf(symbols, header) };
    const tensors = {
      planes: symbols.planes.map((plane) => dequantise(plane, steps[0])),
      weights: symbols.weights.map((weight) => dequantise(weight, steps[steps.length - 1])),
    };
    for (const number of steps.length ? kind.classes : []) {
      if (!header.bounds.has(number)) throw malformed(`${where}: the header has no error bound of class ${number}`);
    }
    this._loose.push(voxels);
    const following = this._following[this._index + 1];
    const growth = following === null ? 1 : Math.max(1.5, 1.25 / this._share[this._index]);
    if (!later) {
      const codes = new Column(Uint8Array, 1);
      codes.append(earlier, (growth * (earlier.length + symbols.codes.length)) / Math.max(1, earlier.length));
      const none = { slices: 0, first: this._columns.voxels.rows, sorted: true };
      this._layers.push({ layer: kind.layer, ...none, steps, scales, networks, key, tensors, codes, continuation });
    }
    const layer = this._layers[this._layers.length - 1];
    layer.slices++;
    layer.codes.append(symbols.codes, growth);
    for (const [name, values] of Object.entries(rows)) this._columns[name].append(values, growth);
    layer.sorted = !later || (layer.sorted && !voxels.length);
    if (following !== kind.layer) this.sort(growth);
  }

  /** Returns a function that undoes a slice, of which a part may have been added: it may be fetched again. */
  _mark() {
    const latest = this._layers[this._layers.length - 1];
    const lists = [this._layers, ...Object.values(latest?.continuation ?? {})];
    const lengths = lists.map(({ length }) => length);
    const columns = [...Object.values(this._columns), ...this._layers.map(({ codes }) => codes)];
    const counts = columns.map(({ rows }) => rows);
    const loose = [...this._loose];
    return () => {
      lists.forEach((list, i) => (list.length = lengths[i]));
      columns.forEach((column, i) => (column.rows = counts[i]));
      this._loose = loose;
    };
  }

  /** Puts the rows of the latest layer in the order of 12.2. @param {number} [growth] as in Column */
  sort(growth = 1) {
    const layer = this._layers[this._layers.length - 1];
    if (!layer || layer.sorted) return;
    const order = mortonOrder(this._columns.voxels.values.subarray(3 * layer.first));
    for (const column of [...Object.values(this._columns), layer.codes]) column.reorder(layer.first, order, growth);
    layer.sorted = true;
  }

  /** Malformed if an earlier slice has one of these voxels. @param {Int32Array} voxels of a slice, distinct */
  _checkVoxels(voxels) {
    if (!voxels.length) return;
    for (const part of this._loose) this._voxels.add(part);
    this._loose = [];
    for (let i = 0; i < voxels.length; i += 3) {
      const x = voxels[i], y = voxels[i + 1], z = voxels[i + 2];
      if (this._voxels.has(x, y, z)) throw malformed(`voxel ${x} ${y} ${z} holds more than one anchor`);
    }
  }

  /**
   * The scene of the slices read so far, at least one. Its arrays are views of those of later scenes, which leave these
   * rows as they are; those of a layer that is not whole stand as they came, unless `sort` was called.
   *
   * @returns {Scene}
   */
  scene() {
    const header = this.header;
    if (!header || !this._layers.length) throw new TypeError("no layer has been read");
    const [first, ...later] = this._layers;
    const [feature, scalingLog, offset] = header.steps;
    /** @type {Steps} */
    const steps = { feature, scalingLog, offset, weightsScaffold: first.steps[0] };
    /** @type {(Deformation | null)[]} */
    const deformations = [null, null];
    for (const layer of later) {
      const [ofPlanes, ofWeights] = layer.steps;
      if (ofPlanes === undefined) continue;
      deformations[layer.layer - 1] = { planes: planesOf(layer), networks: networksOf(layer), key: layer.key };
      if (layer.layer === 1) Object.assign(steps, { planesGlobal: ofPlanes, weightsGlobal: ofWeights });
      else Object.assign(steps, { planesLocal: ofPlanes, weightsLocal: ofWeights });
    }
    const { voxels, ...columns } = this._columns;
    const masks = this._layers.map(({ codes }) => codes.values);
    return {
      info: header.info,
      widths: header.widths,
      steps,
      layers: this._layers.map(({ layer }) => layer),
      rows: masks.map(({ length }) => length),
      anchorQ: voxels.values,
      anchor: columns.anchor.values,
      feature: columns.feature.values,
      scalingLog: columns.scalingLog.values,
      offset: columns.offset.values,
      mask: masks,
      networks: /** @type {Scene["networks"]} */ (networksOf(first)),
      globalDeformation: deformations[0],
      localDeformation: deformations[1],
    };
  }
}

/**
 * A layer as far as it has been read.
 *
 * @typedef {object} LayerParts
 * @property {number} layer
 * @property {number} slices read so far
 * @property {number[]} steps
 * @property {PlaneShape[][]} scales
 * @property {NetworkShape[]} networks
 * @property {number | null} key
 * @property {{planes: Float32Array[], weights: Float32Array[]}} tensors
 * @property {number} first row of its own
 * @property {boolean} sorted whether its rows are
 * @property {Column<Uint8Array>} codes of the mask, of all rows up to its own
 * @property {Continuation} continuation
 */

/** The attributes of a slice's rows. @param {LayerSymbols} symbols @param {Header} header */
function attributesOf({ kind, parameters: { rows }, stepClasses, attributes }, header) {
  const { feature: D, slots: G } = kind.widths;
  let first = 0;
  const [feature, scalingLog, offset] = [D, 6, 3 * G].map((width, i) => {
    const centres = header.centres?.slice(first, first + width);
    const symbols = attributes.subarray(first * rows, (first += width) * rows);
    return transposed(symbols, rows, width, header.steps[i], centres ? { centres, stepClasses } : null);
  });
  return { feature, scalingLog, offset };
}

/** @param {LayerParts} layer */
function networksOf({ networks, tensors }) {
  let at = 0;
  /** @type {Record<string, Network>} */
  const named = {};
  for (const { name, layers } of networks) {
    named[name] = layers.map((shape) => ({ ...shape, weight: tensors.weights[at++], bias: tensors.weights[at++] }));
  }
  return named;
}

/** @param {LayerParts} layer */
function planesOf({ scales, tensors }) {
  let at = 0;
  return scales.map((scale) => {
    const planes = scale.map(({ name, predictor, ...sizes }) => [name, { data: tensors.planes[at++], ...sizes }]);
    return /** @type {Scale} */ (Object.fromEntries(planes));
  });
}
