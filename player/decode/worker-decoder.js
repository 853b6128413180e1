// A decoder in a worker.

import { DecodeError } from "./errors.js";
import { Remote } from "./remote.js";
/** @import { Scene } from "./scene.js" */

/**
 * A `Stream` off the main thread: its methods return promises, answered in the order of the calls. One decoder decodes
 * one file; close it when it is done.
 */
export class WorkerDecoder {
  /** @param {{maxLayer?: number | null}} [options] */
  constructor({ maxLayer = null } = {}) {
    this._remote = new Remote(new URL("./worker.js", import.meta.url));
    /** As of the latest answer: bytes of the file that are decoded. */
    this.consumed = 0;
    /** As of the latest answer: whether every requested layer has arrived. */
    this.complete = false;
    /** As of the latest answer: each slice with its end in the file. @type {{layer: number, end: number}[]} */
    this.layerEnds = [];
    this._opened = this._call("open", [{ maxLayer }]);
    this._opened.catch(() => {}); // the first feed rejects
  }

  /**
   * The scenes that `Stream.feed` returns, copied. Rejects with its DecodeError.
   *
   * @param {Uint8Array} bytes @param {{transfer?: boolean}} [options] transfer: transfers the buffer of `bytes`
   * @returns {Promise<Scene[]>}
   */
  async feed(bytes, { transfer = false } = {}) {
    const answer = this._call("feed", [bytes], transfer ? [/** @type {ArrayBuffer} */ (bytes.buffer)] : []);
    const [, scenes] = await Promise.all([this._opened, answer]);
    return scenes;
  }

  /** As `Stream.rewind`. */
  async rewind() {
    await this._call("rewind", []);
  }

  /** As `Stream.finish`: no bytes follow. */
  async finish() {
    await this._call("finish", []);
  }

  /** Ends the worker. Unanswered and later calls are rejected. */
  close() {
    this._remote.close();
  }

  /** @param {string} name @param {unknown[]} args @param {Transferable[]} [transfer] @returns {Promise<Scene[]>} */
  async _call(name, args, transfer) {
    try {
      const { scenes, ...state } = await this._remote.call(name, args, transfer);
      Object.assign(this, state);
      return scenes;
    } catch (error) {
      const { state, kind, reason, ...place } = /** @type {any} */ (error);
      if (state) Object.assign(this, state);
      throw kind ? new DecodeError(kind, reason, place) : error;
    }
  }
}
