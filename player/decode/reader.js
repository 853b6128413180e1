// Clause 12: a file's chunks in order, slice by slice, to tensors.

import { Column } from "./columns.js";
import { CHUNK_OVERHEAD, PREAMBLE_SIZE, readChunk, readPreamble } from "./container.js";
import { hex, sha256 } from "./digests.js";
import { DecodeError, limitExceeded, malformed, unsupported } from "./errors.js";
import { LAYER_TYPES, readHeader } from "./header.js";
import { unpack } from "./msgpack.js";
import { dequantise, rowsOf } from "./rows.js";
import { LEAST_OWN_CODE, MOST_CODE, chainsOf, decodeSlice, gridsOf } from "./slice.js";
import { VoxelTable, mortonOrder } from "./voxels.js";
/** @import { Values } from "./columns.js" */
/** @import { Header } from "./header.js" */
/** @import { Declared } from "./parameters.js" */
/** @import { Slice } from "./slice.js" */
/** @import { Prior } from "./tables.js" */
/** @import { LayerTensors, Tensors } from "./tensors.js" */

/**
 * The rules of kinds, which tensors do not need: raise where the header, or the last one of these layers, breaks one.
 *
 * @typedef {object} Rules
 * @property {(header: Header) => void} checkHeader
 * @property {(header: Header, layers: LayerTables[]) => void} checkLayer
 */

/** @typedef {Omit<LayerTensors, "codes" | "fill" | "spread" | "rows">} LayerTables */

/**
 * A layer as far as it has been read: `first` row of its own; codes of the mask, of all rows up to its own, and its own
 * tensors of rows; `sorted`, whether its rows are.
 *
 * @typedef {Omit<LayerTensors, "codes" | "rows"> & {slices: number, first: number, sorted: boolean,
 *   codes: Column<Uint8Array>, rows: Column<Float32Array>[], priors: Prior[]}} Layer
 */

/**
 * Reads a whole file, or its layers up to maxLayer; of a cut file, if allowPartial, the slices that are there, at least
 * one, or without any those of its base. Raises DecodeError.
 *
 * @param {Uint8Array} bytes @param {{maxLayer?: number | null, allowPartial?: boolean, base?: GivenBase}} options
 * @param {Rules | null} rules null: tensors of any kind are taken
 * @param {(slice: Slice) => void} [take] is given each slice
 * @returns {Tensors}
 */
export function readAll(bytes, { maxLayer = null, allowPartial = false, base = null }, rules, take) {
  const reader = new TensorReader(maxLayer, rules, base);
  try {
    for (let slice; (slice = reader.next(bytes.subarray(reader.offset))); ) take?.(slice);
  } catch (error) {
    const cut = error instanceof DecodeError && error.kind === "Truncated";
    if (!cut || !allowPartial || !reader.showable) throw error;
  }
  reader.sort();
  return reader.tensors();
}

/** @typedef {Base | Uint8Array | ArrayBuffer | null} GivenBase a file's bytes, or what was read of them */

/** The layer 0 of a file, decoded once for all files whose base it is (5.6). */
export class Base {
  /** Raises DecodeError, Malformed if the file cannot be a base. @param {Uint8Array} bytes of the file, up to the end of
   * its layer 0 or more */
  constructor(bytes) {
    const packed = readPreamble(bytes);
    if (readHeader(packed).base) throw malformed("the base names a base itself");
    this.reader = new TensorReader(0, null);
    while (this.reader.next(bytes.subarray(this.reader.offset)));
    const [layer] = this.reader.tensors().layers;
    if (layer.rowTensors.length) throw malformed("the base has layer rows in layer 0, expected none");
    this.header = /** @type {Header} */ (this.reader.header);
    const parts = [packed.subarray(unpack(packed, "header").firstEntryEnd)];
    let at = PREAMBLE_SIZE + packed.length;
    for (const { type, length } of this.header.chunks) {
      if (type === 0) parts.push(bytes.subarray(at, at + CHUNK_OVERHEAD + length));
      at += CHUNK_OVERHEAD + length;
    }
    const digests = new Uint8Array(32 * parts.length);
    parts.forEach((part, i) => digests.set(sha256(part), 32 * i));
    this.digest = hex(sha256(digests));
    this.bytes = parts.reduce((sum, { length }) => sum + length, 0);
    this.rows = layer.codes.length;
    this.taken = new VoxelTable();
    this.taken.add(this.reader.tensors().voxels);
  }

  /** The base that a header names, null if it names none. Raises DecodeError if none or another one is given.
   * @param {Header} header @param {GivenBase} given */
  static of({ base: named, kind, rows, centres, info: { voxelSize } }, given) {
    if (!named) return null;
    const wanted = `the file adds to layer 0 of scene ${named.sceneId}`;
    if (!given) throw new DecodeError("BaseMissing", `${wanted}, and no base is given`);
    let base;
    try {
      base = given instanceof Base ? given : new Base(given instanceof Uint8Array ? given : new Uint8Array(given));
    } catch (error) {
      if (!(error instanceof DecodeError)) throw error; // its place is none in this file, of which no bytes are missing
      throw new DecodeError(error.kind === "Truncated" ? "BaseMismatch" : error.kind, `the base: ${error.message}`);
    }
    const { header } = base;
    if (named.sceneId !== header.sceneId || named.digest !== base.digest) {
      throw new DecodeError("BaseMismatch", `${wanted}, the base given is another one, of scene ${header.sceneId}`);
    }
    if (named.rows !== base.rows || named.bytes !== base.bytes) {
      throw malformed(`header: a base of ${named.rows} rows and ${named.bytes} bytes, not ${base.rows} and ${base.bytes}`);
    }
    const same = [header.kind, header.rows, header.centres, header.info.voxelSize];
    if (JSON.stringify([kind, rows, centres, voxelSize]) !== JSON.stringify(same)) {
      throw malformed("header: kind, rows, centres or voxel size, expected those of the base");
    }
    return base;
  }
}

/** Reads a file slice by slice. It keeps no bytes but the header's: every call gets what follows those it consumed. */
export class TensorReader {
  /** @param {number | null} maxLayer layers above it are not read; null: all are @param {Rules | null} rules
   * @param {GivenBase} [base] for a file that names one */
  constructor(maxLayer, rules, base = null) {
    if (maxLayer !== null && !(Number.isInteger(maxLayer) && maxLayer >= 0)) {
      throw new RangeError(`maxLayer is ${maxLayer}, expected 0 or more`);
    }
    this.maxLayer = maxLayer;
    this._rules = rules;
    this._given = base;
    /** The file's. @type {Base | null} */
    this._base = null;
    /** @type {Header | null} */
    this.header = null;
    /** Each slice's layer with the end of its chunk in the file, in file order; empty until the header is there.
     * @type {{layer: number, end: number}[]} */
    this.layerEnds = [];
    /** Bytes of the file as its header has them, null until it is there. @type {number | null} */
    this.end = null;
    /** Of the next chunk, or of the header before it is read. */
    this.offset = 0;
    /** How many slices have been read. */
    this.count = 0;
    this._index = 0;
    /** By chunk, the layer of the first slice behind those before it; null if there is none. @type {(number | null)[]} */
    this._following = [];
    /** By chunk, the part of all slices' bytes that has come with it. @type {number[]} */
    this._share = [];
    /** By the slices read so far. @type {Declared} */
    this._declared = { rows: 0, symbols: 0, bytes: 0 };
    /** @type {Layer[]} */
    this._layers = [];
    this._voxels = new Column(Int32Array, 3);
    this._positions = new Column(Float32Array, 3);
    /** By tensor of the header's. @type {Column<Float32Array>[]} */
    this._rows = [];
    this._classes = new Column(Uint8Array, 1);
    this._taken = new VoxelTable();
    /** Voxels that are not in the table yet: of one slice nothing is looked up. @type {Int32Array[]} */
    this._loose = [];
  }

  /** Whether every layer that was asked for has been read, and without maxLayer every chunk. */
  get complete() {
    if (!this.header) return false;
    if (this.maxLayer === null) return this._index === this.header.chunks.length;
    return (this._following[this._index] ?? Infinity) > this.maxLayer;
  }

  /** Whether there are tensors: of a slice, or of the base. */
  get showable() {
    return this._layers.length > 0;
  }

  /** Whether the layer of the latest slice has no further ones. */
  get whole() {
    return this._following[this._index] !== this._layers[this._layers.length - 1].layer;
  }

  /** What all rows hold. @returns {Column<any>[]} */
  get _columns() {
    return [this._voxels, this._positions, ...this._rows, ...(this.header?.centres ? [this._classes] : [])];
  }

  /** Reads the header. Raises Truncated, with nothing consumed, if `bytes` end before. @param {Uint8Array} bytes */
  _begin(bytes) {
    const packed = readPreamble(bytes);
    const header = readHeader(packed);
    const base = Base.of(header, this._given);
    this._rules?.checkHeader(header);
    if (base) this._rules?.checkLayer(header, base.reader._layers);
    this.header = header;
    this.offset = PREAMBLE_SIZE + packed.length;
    this._rows = header.rows.map(({ channels }) => new Column(Float32Array, channels));
    if (base) this._adopt(base, header);
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
    return header;
  }

  /** Begins with the rows of a base, whose arrays nobody writes to. @param {Base} base @param {Header} header */
  _adopt(base, { width, centres }) {
    const { rows, bytes, reader } = base;
    this._base = base;
    this._declared = { rows, symbols: (width + (centres ? 5 : 4)) * rows, bytes };
    this._columns.forEach((column, i) => column.become(reader._columns[i].values));
    this._layers = reader._layers.map((layer) => ({ ...layer, slices: 0 }));
  }

  /**
   * Reads on to the end of one more slice; null if the file has no more that were asked for.
   *
   * Raises Truncated if the bytes end before: what was consumed until then stays so. Of a file that is read whole,
   * bytes behind the last chunk are Malformed.
   *
   * @param {Uint8Array} bytes the file from byte `offset` of it on, where this reader stands
   * @returns {Slice | null}
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
    let slice = null;
    try {
      if (listed.type < LAYER_TYPES) slice = this._readSlice(chunk, listed.type, header);
      else if (!chunk.ancillary) throw unsupported(`critical chunk of unknown type ${listed.type}`);
    } catch (error) {
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

  /** A slice, which is added to its layer; if it is refused, nothing is: it may be fetched again. Offsets in its faults
   * count from the chunk. @param {ReturnType<typeof readChunk>} chunk @param {number} layer @param {Header} header */
  _readSlice({ ancillary, more, number, payload }, layer, header) {
    if (ancillary) throw malformed(`layer ${layer} is flagged ancillary`);
    const latest = this._layers[this._layers.length - 1];
    const had = latest?.layer === layer && latest.slices ? latest : null;
    const next = this._following[this._index + 1];
    const flagged = (/** @type {string} */ reason) => new DecodeError("Malformed", reason, { offset: 2 });
    if (number !== (had?.slices ?? 0)) throw flagged(`slice ${number}, expected ${had?.slices ?? 0}`);
    if (next !== null && more !== (next === layer)) {
      throw flagged(`layer ${layer} ${more ? "announces a further slice" : "ends"}, but layer ${next} follows`);
    }
    const known = had?.priors.length ?? 0;
    try {
      const before = { declared: this._declared, classes: this._classes.values, layer: had };
      const slice = decodeSlice(payload, layer, header, before);
      this._accept(slice, had, header);
      return slice;
    } catch (error) {
      if (had) had.priors.length = known;
      throw error;
    }
  }

  /** The rules of 12.1 that need earlier slices, dequantisation, the rules of kinds; then the slice is added.
   * @param {Slice} slice @param {Layer | null} had its layer, null if this is the first slice @param {Header} header */
  _accept(slice, had, header) {
    const { layer: number, parameters, voxels, rises, stepClasses } = slice;
    const own = slice.codes.length;
    const earlier = Uint8Array.from(rises);
    const before = this._layers[this._layers.length - 1]?.codes.values; // of a whole layer, in order
    for (let i = 0; i < rises.length; i++) {
      const code = number ? before[i] + rises[i] : before[i] * (1 - rises[i]);
      if (code > MOST_CODE || (code && code < LEAST_OWN_CODE)) {
        throw malformed(`layer ${number}: a mask code of ${code}, expected 0 or ${LEAST_OWN_CODE}..${MOST_CODE}`);
      }
      earlier[i] = code;
    }
    this._checkVoxels(voxels);
    /** @type {Values[]} */
    const rows = [voxels, dequantise(voxels, header.info.voxelSize), ...rowsOf(header.rows, slice.rows, own)];
    if (stepClasses) rows.push(Uint8Array.from(stepClasses));
    const layerRows = rowsOf(parameters.layerRows, slice.layerRows, rises.length + own);
    const layer = had ?? this._begun(slice);
    if (!had) this._rules?.checkLayer(header, [...this._layers, layer]);
    const following = this._following[this._index + 1];
    const growth = following === null ? 1 : Math.max(1.5, 1.25 / this._share[this._index]);
    const alone = following === null && !this._voxels.rows;
    if (!alone) for (const column of this._columns) column.reserve(own, growth);
    for (const column of [layer.codes, ...layer.rows]) column.reserve(rises.length + own, growth);
    // from here on nothing fails, but for want of memory to sort
    if (!had) this._layers = [...this._layers.filter((other) => other.layer !== number), layer];
    this._columns.forEach((column, i) => (alone ? column.become(rows[i]) : column.append(rows[i])));
    layer.rows.forEach((column, i) => column.append(layerRows[i]));
    layer.codes.append(earlier);
    layer.codes.append(slice.codes);
    layer.slices++;
    layer.sorted = !had || (layer.sorted && !voxels.length);
    const [spread = 0] = parameters.fill?.slice(3) ?? [];
    layer.fill = parameters.fill?.slice(0, 3).map((c) => c / 255) ?? header.info.background;
    layer.spread = 1 + spread / 64;
    this._loose.push(voxels);
    this._declared = parameters.declared;
    this.count++;
    if (following !== number) this.sort(growth);
  }

  /** A layer without rows. @param {Slice} slice its first @returns {Layer} */
  _begun(slice) {
    const { layer, parameters: { kind, layerRows: rowTensors }, priors } = slice;
    const rows = rowTensors.map(({ channels }) => new Column(Float32Array, channels));
    const { grids, chains } = (!layer && this._layers[0]) || { grids: gridsOf(slice), chains: chainsOf(slice) };
    const made = { grids, chains, codes: new Column(Uint8Array, 1), rowTensors, rows };
    return { layer, kind, ...made, fill: [], spread: 1, slices: 0, first: this._voxels.rows, sorted: true, priors };
  }

  /** Puts the rows of the latest layer in the order of 12.2. @param {number} [growth] as in Column */
  sort(growth = 1) {
    const layer = this._layers[this._layers.length - 1];
    if (!layer || layer.sorted) return;
    const order = mortonOrder(this._voxels.values.subarray(3 * layer.first));
    for (const column of [...this._columns, layer.codes, ...layer.rows]) column.reorder(layer.first, order, growth);
    layer.sorted = true;
  }

  /** Malformed if an earlier slice has one of these voxels. @param {Int32Array} voxels of a slice, distinct */
  _checkVoxels(voxels) {
    if (!voxels.length) return;
    for (const part of this._loose) this._taken.add(part);
    this._loose = [];
    for (let i = 0; i < voxels.length; i += 3) {
      const x = voxels[i], y = voxels[i + 1], z = voxels[i + 2];
      if (!this._taken.has(x, y, z) && !this._base?.taken.has(x, y, z)) continue;
      throw malformed(`voxel ${x} ${y} ${z} holds more than one anchor`);
    }
  }

  /**
   * The tensors of the slices read so far, at least one, or of the base. Arrays of rows are views of those of later
   * tensors, which leave these rows as they are; those of a layer that is not whole stand as they came, unless `sort`
   * was called.
   *
   * @returns {Tensors}
   */
  tensors() {
    if (!this.header || !this._layers.length) throw new TypeError("no layer has been read");
    return {
      header: this.header,
      layers: this._layers.map(({ layer, codes, fill, spread, grids, chains, kind, rowTensors, rows }) => {
        const arrays = { codes: codes.values, rows: rows.map(({ values }) => values) };
        return { layer, ...arrays, fill, spread, grids, chains, kind, rowTensors };
      }),
      voxels: this._voxels.values,
      positions: this._positions.values,
      rows: this._rows.map(({ values }) => values),
    };
  }
}
