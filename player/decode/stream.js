// Clause 12.3: bytes as they arrive, to scenes.

import { RULES, sceneOf } from "../kinds/index.js";
import { DecodeError } from "./errors.js";
import { TensorReader } from "./reader.js";
/** @import { Scene } from "../kinds/index.js" */

const SMALLEST_BUFFER = 1 << 16;

/** A decoder that takes a file in pieces of any size. Its scenes do not depend on where the pieces are cut. */
export class Stream {
  /** @param {Omit<import("./index.js").Options, "allowPartial">} [options] layers above maxLayer are not looked at */
  constructor({ maxLayer = null, base = null } = {}) {
    this._reader = new TensorReader(maxLayer, RULES, base);
    this._buffer = new Uint8Array(0);
    /** The bytes of the file from `consumed` on stand here in the buffer. */
    this._start = 0;
    this._filled = 0;
    /** Bytes of the file before which nothing is to be found out. */
    this._needs = 0;
    /** @type {DecodeError | null} */
    this._error = null;
  }

  /** Whether every layer that was asked for has arrived. */
  get complete() {
    return this._reader.complete;
  }

  /** How many bytes of the file are decoded and no longer held: where a fetch that begins anew may go on. */
  get consumed() {
    return this._reader.offset;
  }

  /** Each slice's layer with the end of its chunk in the file, in file order; empty until the header is there. */
  get layerEnds() {
    return this._reader.layerEnds;
  }

  /** Bytes of the file as its header has them, null until it is there. */
  get end() {
    return this._reader.end;
  }

  /**
   * The newest scene of each layer that `bytes` complete a slice of, with all slices so far. The bytes are copied.
   *
   * The rows of a layer stand in the order in which its slices came until it is whole. Scenes share their arrays, which
   * nobody may write to. A fault raises its DecodeError now, or at the next call if this one completes a slice before
   * it, and at every later call. Scenes given before stay valid.
   *
   * @param {Uint8Array} bytes
   * @returns {Scene[]}
   */
  feed(bytes) {
    if (this._error) throw this._error;
    if (this.complete && this._reader.maxLayer !== null) return [];
    this._append(bytes);
    if (this.consumed + this._filled - this._start < this._needs) return [];
    /** @type {Scene[]} */
    const scenes = [];
    let pending = false;
    try {
      while (this._next()) {
        pending = !this._reader.whole;
        if (!pending) scenes.push(sceneOf(this._reader.tensors()));
      }
    } catch (error) {
      if (!(error instanceof DecodeError)) throw error;
      this._needs = error.needs;
      if (error.kind !== "Truncated") {
        this._error = error;
        if (!scenes.length && !pending) throw error;
      }
    }
    if (pending) scenes.push(sceneOf(this._reader.tensors()));
    return scenes;
  }

  /** Says that no bytes follow: raises the pending fault, or Truncated if a slice is missing. */
  finish() {
    if (this._error) throw this._error;
    this._next();
  }

  /** Forgets a fault and the bytes that are not decoded: feed the file from byte `consumed` on next. */
  rewind() {
    this._error = null;
    this._start = this._filled = this._needs = 0;
    this._buffer = new Uint8Array(0);
  }

  /** Whether one more slice was read. */
  _next() {
    const before = this._reader.offset;
    try {
      return this._reader.next(this._buffer.subarray(this._start, this._filled)) !== null;
    } finally {
      this._start += this._reader.offset - before;
      if (this._start === this._filled) {
        this._start = this._filled = 0;
        this._buffer = new Uint8Array(0);
      }
    }
  }

  /** @param {Uint8Array} bytes */
  _append(bytes) {
    if (this._filled + bytes.length > this._buffer.length) {
      const held = this._buffer.subarray(this._start, this._filled);
      const size = held.length + bytes.length;
      const doubled = Math.min(2 * this._buffer.length, size + (1 << 26));
      // where half of the buffer is free already, what it holds moves to its front
      const fits = size <= this._buffer.length / 2;
      const target = fits ? this._buffer : new Uint8Array(Math.max(SMALLEST_BUFFER, size, doubled));
      target.set(held);
      this._buffer = target;
      this._start = 0;
      this._filled = held.length;
    }
    this._buffer.set(bytes, this._filled);
    this._filled += bytes.length;
  }
}
