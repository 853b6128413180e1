// Clause 12.3: bytes as they arrive, to scenes.

import { checkKinds, sceneOf } from "../kinds/index.js";
import { Column } from "./columns.js";
import { PREAMBLE_SIZE } from "./container.js";
import { DecodeError } from "./errors.js";
import { TensorReader } from "./reader.js";
/** @import { Scene } from "../kinds/index.js" */

/** @type {Column<Uint8Array>} */
const NONE = new Column(Uint8Array, 1);

/** A decoder that takes a file in pieces of any size. Its scenes do not depend on where the pieces are cut. */
export class Stream extends TensorReader {
  /** @param {Omit<import("./index.js").Options, "allowPartial">} [options] layers above maxLayer are not looked at */
  constructor({ maxLayer = null, base = null } = {}) {
    super(maxLayer, checkKinds, base);
    /** Bytes of the file before which nothing is found out. */
    this.needs = PREAMBLE_SIZE;
    /** @type {DecodeError | null} */
    this._error = null;
    /** Bytes of the file from `consumed` on. */
    this._held = NONE;
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
    if (this.complete && this.maxLayer !== null) return [];
    const { _held: held, consumed } = this;
    const alone = !held.rows; // nothing is copied before it is known to be needed again
    const all = alone ? bytes : (this._held = held.with(bytes, 2)).values;
    /** @type {Scene[]} */
    const scenes = [];
    let pending = false;
    try {
      if (consumed + all.length >= this.needs) {
        this.read(all, () => {
          pending = !this.whole;
          if (!pending) scenes.push(sceneOf(this.tensors()));
        });
      }
    } catch (error) {
      if (!(error instanceof DecodeError)) throw error;
      this.needs = error.needs;
      if (error.kind !== "Truncated") {
        this._error = error;
        if (!scenes.length && !pending) throw error;
      }
    }
    if (alone || this.consumed > consumed) this._held = NONE.with(all.slice(this.consumed - consumed), 1);
    if (pending) scenes.push(sceneOf(this.tensors()));
    return scenes;
  }

  /** Says that no bytes follow: raises the pending fault, or Truncated if a slice is missing. */
  finish() {
    if (this._error) throw this._error;
    this.read(this._held.values);
  }

  /** Forgets a fault and the bytes that are not decoded: feed the file from byte `consumed` on next. */
  rewind() {
    this._error = null;
    this.needs = PREAMBLE_SIZE;
    this._held = NONE;
  }
}
