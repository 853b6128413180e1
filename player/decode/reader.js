// Clause 12: a file's chunks in order, slice by slice, to tensors.

import { Column } from "./columns.js";
import { CHUNK_OVERHEAD, PREAMBLE_SIZE, readChunk, readPreamble } from "./container.js";
import { hex, sha256 } from "./digests.js";
import { DecodeError, limitExceeded, malformed } from "./errors.js";
import { LAYER_TYPES, readHeader } from "./header.js";
import { decodeSlice } from "./slice.js";
import { VoxelTable, mortonOrder } from "./voxels.js";
/** @import { Header } from "./header.js" */
/** @import { Prior } from "./tables.js" */
/** @import { LayerTensors, Tensors } from "./tensors.js" */

/** The rules of kinds, which tensors do not need: raise where the header or the last one of these layers, if there is
 * one, breaks one. @typedef {(header: Header, layers: LayerTables[]) => void} Rules */

/** @typedef {Omit<LayerTensors, "codes" | "fill" | "spread" | "rows">} LayerTables */

/**
 * A layer as far as it has been read: `first` row of its own; in columns of all rows up to its own the mask codes and
 * its tensors; `fill` if its last slice has one.
 *
 * @typedef {Omit<LayerTensors, "codes" | "fill" | "rows"> & {fill: number[] | null, slices: number, first: number,
 *   columns: Column<any>[], priors: Prior[]}} Layer
 */

/** @typedef {Base | Uint8Array | ArrayBuffer | null} GivenBase a file's bytes, or what was read of them */

/** @param {Uint8Array | ArrayBuffer} bytes */
const viewOf = (bytes) => (bytes instanceof Uint8Array ? bytes : new Uint8Array(bytes));

/**
 * Reads a whole file, or its layers up to maxLayer; of a cut file, if allowPartial, the slices that are there, at least
 * one, or without any those of its base. Raises DecodeError.
 *
 * @param {Uint8Array | ArrayBuffer} bytes
 * @param {{maxLayer?: number | null, allowPartial?: boolean, base?: GivenBase}} options
 * @param {Rules | null} rules null: tensors of any kind are taken @returns {Tensors}
 */
export function readAll(bytes, { maxLayer = null, allowPartial = false, base = null }, rules) {
  const reader = new TensorReader(maxLayer, rules, base);
  try {
    reader.read(viewOf(bytes));
  } catch (error) {
    const cut = error instanceof DecodeError && error.kind === "Truncated";
    if (!cut || !allowPartial || !reader.layers.length) throw error;
    reader.sort();
  }
  return reader.tensors();
}

/** Reads a file as far as it is there. It keeps no bytes: each call gets what follows those it consumed. */
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
    /** @type {Header | null} */
    this.header = null;
    /** Each slice's layer with its chunk's place in the file, in file order; empty until the header is there.
     * @type {{layer: number, start: number, end: number}[]} */
    this.layerEnds = [];
    /** Bytes of the file as its header has them, null until it is there. @type {number | null} */
    this.end = null;
    /** How many bytes of the file are decoded: what is read next stands behind them. */
    this.consumed = 0;
    this._chunks = 0;
    /** By the slices read so far. */
    this._declared = { rows: 0, symbols: 0, bytes: 0 };
    /** @type {Layer[]} */
    this.layers = [];
    /** What all rows hold: voxels, positions, the header's tensors, step classes if there are. @type {Column<any>[]} */
    this._columns = [];
    /** The voxels of this file, then those of its base. */
    this._taken = [new VoxelTable()];
  }

  /** The slice that is read next, if the header is there and one is left. */
  get next() {
    return this.layerEnds.find(({ end }) => end > this.consumed);
  }

  /** Whether every layer that was asked for has been read, and without maxLayer every chunk. */
  get complete() {
    if (this.maxLayer === null || !this.header) return this.consumed === this.end;
    return (this.next?.layer ?? Infinity) > this.maxLayer;
  }

  /** Whether the layer of the latest slice has no further ones. */
  get whole() {
    return this.next?.layer !== this.layers[this.layers.length - 1].layer;
  }

  /**
   * Reads the slices that `bytes` hold, the file from byte `consumed` on.
   *
   * Raises Truncated if they end before all that were asked for: whole chunks are consumed then. Of a file that is read
   * whole, bytes behind the last chunk are Malformed.
   *
   * @param {Uint8Array} bytes @param {() => void} [told] is called behind each slice
   */
  read(bytes, told) {
    const start = this.consumed;
    const header = this.header ?? this._begin(bytes);
    while (!this.complete) {
      if (this._readChunk(bytes.subarray(this.consumed - start), header)) told?.();
    }
    const left = start + bytes.length - this.consumed;
    if (this.maxLayer !== null || left <= 0) return;
    throw malformed(`${left} bytes follow the last chunk, expected none`, this.consumed);
  }

  /** Reads the header. @param {Uint8Array} bytes */
  _begin(bytes) {
    const packed = readPreamble(bytes);
    const header = readHeader(packed);
    const base = this._baseOf(header);
    this._rules?.(header, base?.layers ?? []);
    this.header = header;
    let end = (this.consumed = PREAMBLE_SIZE + packed.length);
    for (const { type, length } of header.chunks) {
      const start = end;
      end += CHUNK_OVERHEAD + length;
      if (type < LAYER_TYPES) this.layerEnds.push({ layer: type, start, end });
    }
    this.end = end;
    const { rows, width, centres } = header;
    this._columns = [new Column(Int32Array, 3), new Column(Float32Array, 3), ...floats(rows)];
    if (centres) this._columns.push(new Column(Uint8Array, 1));
    if (!base) return header;
    this._taken.push(...base._taken);
    this._declared = { rows: base.rows, symbols: (width + (centres ? 5 : 4)) * base.rows, bytes: base.bytes };
    this._columns = this._columns.map((column, i) => column.with(base._columns[i].values, 1));
    this.layers = base.layers.map((layer) => ({ ...layer, slices: 0 }));
    return header;
  }

  /** The base that a header names, null if it names none. Raises DecodeError if none or another one is given.
   * @param {Header} header @returns {Base | null} */
  _baseOf({ base: named, kind, rows, centres, info: { voxelSize } }) {
    if (!named) return null;
    const { _given: given } = this;
    const wanted = `the file adds to layer 0 of scene ${hex(named.sceneId)}`;
    if (!given) throw new DecodeError("BaseMissing", `${wanted}, and no base is given`);
    let base;
    try {
      base = given instanceof Base ? given : new Base(viewOf(given));
    } catch (error) {
      if (!(error instanceof DecodeError)) throw error; // its place is none in this file, of which no bytes are missing
      throw new DecodeError(error.kind === "Truncated" ? "BaseMismatch" : error.kind, `the base: ${error.message}`);
    }
    const header = /** @type {Header} */ (base.header);
    if (hex(named.sceneId) !== header.sceneId || hex(named.digest) !== base.digest) {
      throw new DecodeError("BaseMismatch", `${wanted}, the base given is another one, of scene ${header.sceneId}`);
    }
    const said = [kind, rows, centres, voxelSize, named.rows, named.bytes];
    const same = [header.kind, header.rows, header.centres, header.info.voxelSize, base.rows, base.bytes];
    if (JSON.stringify(said) !== JSON.stringify(same)) {
      throw malformed("header: kind, rows, centres, voxel size or counts, expected those of the base");
    }
    return base;
  }

  /** Reads the next chunk: whether it has a slice. @param {Uint8Array} bytes from it on @param {Header} header */
  _readChunk(bytes, header) {
    const { consumed, _chunks: chunk } = this;
    const { type, length } = header.chunks[chunk];
    const sliced = type < LAYER_TYPES;
    try {
      const read = readChunk(bytes, header.chunks[chunk], header.sceneId);
      if (sliced) this._readSlice(read, type, header);
    } catch (error) {
      // What an engine says where it cannot allocate an array.
      const full = error instanceof RangeError && /allocation|array length|buffer length/i.test(error.message);
      const fault = full ? limitExceeded(`layer ${type} takes more memory than there is`) : error;
      if (!(fault instanceof DecodeError)) throw fault;
      const place = { offset: consumed + (fault.offset ?? 0), chunk, needs: consumed + fault.needs };
      throw new DecodeError(fault.kind, fault.reason, place);
    }
    this._chunks++;
    this.consumed += CHUNK_OVERHEAD + length;
    return sliced;
  }

  /** Reads a slice and adds it to its layer, under the rules of 12.1 that need earlier slices and those of kinds. If it
   * is refused, nothing is added: it may be fetched again. @param {ReturnType<typeof readChunk>} chunk
   * @param {number} number of the layer @param {Header} header */
  _readSlice({ more, number: place, payload }, number, header) {
    const latest = this.layers[this.layers.length - 1];
    const had = latest?.layer === number && latest.slices ? latest : null; // its layer
    const [{ start }, { end: last }] = [this.layerEnds[0], this.layerEnds[this.layerEnds.length - 1]];
    const [{ end }, next] = this.layerEnds.filter((slice) => slice.end > this.consumed);
    if (place !== (had?.slices ?? 0)) throw malformed(`slice ${place}, expected ${had?.slices ?? 0}`, 2);
    if (next && more !== (next.layer === number)) {
      const says = more ? "announces a further slice" : "ends";
      throw malformed(`layer ${number} ${says}, but layer ${next.layer} follows`, 2);
    }
    const before = {
      declared: this._declared,
      codes: latest ? latest.columns[0].values : new Uint8Array(0), // of a whole layer, in order, where they matter
      classes: header.centres && this._columns[this._columns.length - 1].values,
      layer: had,
    };
    const slice = decodeSlice(payload, number, header, before);
    for (const table of this._taken) table.refuse(slice.voxels);
    const { kind, rowTensors, priors, fill, spread } = slice;
    const { grids, chains } = (!number && this.layers[0]) || slice; // layer 0 over a base has the base's
    const own = [new Column(Uint8Array, 1), ...floats(rowTensors)];
    const begun = had ?? { layer: number, kind, grids, chains, rowTensors, columns: own, first: this._declared.rows };
    const layer = { ...begun, slices: place + 1, priors, fill, spread };
    if (!had) this._rules?.(header, [...this.layers, layer]);
    const growth = next ? Math.max(1.5, (1.25 * (last - start)) / (end - start)) : 1;
    const columns = [...this._columns, ...layer.columns].map((column, i) => column.with(slice.columns[i], growth));
    // from here on nothing fails, but for want of memory to sort
    layer.columns = columns.splice(this._columns.length);
    this._columns = columns;
    this.layers = [...this.layers.filter((other) => other.layer !== number), layer];
    this._taken[0].add(slice.voxels);
    this._declared = slice.declared;
    if (next?.layer !== number) this.sort(growth);
  }

  /** Puts the rows of the latest layer, of which those of each slice are, in the order of 12.2.
   * @param {number} [growth] as in Column */
  sort(growth = 1) {
    const layer = this.layers[this.layers.length - 1];
    if (layer.slices < 2) return;
    const order = mortonOrder(this._columns[0].values.subarray(3 * layer.first));
    [this._columns, layer.columns] = [this._columns, layer.columns].map((columns) => {
      return columns.map((column) => column.reordered(layer.first, order, growth));
    });
  }

  /** The tensors of the slices read so far, at least one, or of the base. Arrays of rows are views of those of later
   * tensors, which leave these rows as they are; those of a layer that is not whole stand as they came, unless `sort`
   * was called.
   * @returns {Tensors} */
  tensors() {
    if (!this.header || !this.layers.length) throw new TypeError("no layer has been read");
    const { background } = this.header.info;
    const layers = this.layers.map(({ layer, columns, spread, grids, chains, kind, rowTensors, ...rest }) => {
      const [codes, ...rows] = columns.map(({ values }) => values);
      const fill = rest.fill ?? background; // that of this file, also behind the base's layer 0
      return { layer, codes, rows, fill, spread, grids, chains, kind, rowTensors };
    });
    const [voxels, positions, ...rows] = this._columns.map(({ values }) => values);
    const classes = this.header.centres ? rows.pop() : null;
    return { header: this.header, layers, voxels, positions, rows, classes };
  }
}

/** The layer 0 of a file, decoded once for all files whose base it is (5.6). */
export class Base extends TensorReader {
  /** Raises DecodeError, Malformed if the file cannot be a base. @param {Uint8Array} bytes of the file, up to the end
   * of its layer 0 or more */
  constructor(bytes) {
    super(0, null);
    this.read(bytes);
    const [{ rowTensors }] = this.layers;
    if (rowTensors.length) throw malformed("the base has layer rows in layer 0, expected none");
    const { identity, described } = /** @type {Header} */ (this.header);
    const chunks = this.layerEnds.filter(({ layer }) => !layer).map(({ start, end }) => bytes.subarray(start, end));
    this.digest = hex(sha256(identity, ...chunks.map((chunk) => sha256(chunk))));
    /** That the digest is of. */
    this.bytes = chunks.reduce((sum, { length }) => sum + length, described);
    this.rows = this._declared.rows;
  }

  /** @param {Header} header @returns {null} */
  _baseOf({ base }) {
    if (base) throw malformed("the base names a base itself");
    return null;
  }
}

/** @param {{channels: number}[]} tensors */
const floats = (tensors) => tensors.map(({ channels }) => new Column(Float32Array, channels));
