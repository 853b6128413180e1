// A decoder in a Worker: the page's side.

import { DecodeError } from "./errors.js";

/** @typedef {import("./scene.js").Scene} Scene */
/** @typedef {import("./worker-protocol.js").Answer} Answer */
/** @typedef {import("./worker-protocol.js").Port} Port */
/** @typedef {import("./worker-protocol.js").State} State */

/**
 * As `Stream`, off the main thread: what a call gives comes as a promise, and the arrays of scenes are transferred, not
 * copied, to the page. Calls are answered in their order. One decoder decodes one file; close it when it is done.
 */
export class WorkerDecoder {
  /**
   * port: a Worker or MessagePort that serves (`worker-protocol.js`); by default a new Worker, which `close` ends.
   *
   * @param {{maxLayer?: number | null, port?: Port}} [options]
   */
  constructor({ maxLayer = null, port } = {}) {
    this._port = port ?? new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
    /** @type {Map<number, {resolve: (scenes: Scene[]) => void, reject: (error: Error) => void}>} */
    this._waiting = new Map();
    this._asked = 0;
    /** @type {Error | null} */
    this._failure = null;
    /** @type {State} */
    this._state = { consumed: 0, complete: false, layerEnds: [] };
    this._port.onmessage = (/** @type {{data: Answer}} */ { data }) => this._take(data);
    if ("onerror" in this._port) {
      this._port.onerror = (/** @type {ErrorEvent} */ event) =>
        this._fail(new Error(`the decoder's worker failed: ${event.message ?? "it could not be loaded"}`));
    }
    // A wrong maxLayer shows at the first feed.
    this._ask({ open: { maxLayer } }).catch((error) => this._fail(error));
  }

  /** As of the latest answer: whether every layer that was asked for has arrived. */
  get complete() {
    return this._state.complete;
  }

  /** As of the latest answer: how many bytes of the file are decoded. */
  get consumed() {
    return this._state.consumed;
  }

  /** As of the latest answer: each layer with the end of its chunk in the file; empty until the header is there. */
  get layerEnds() {
    return this._state.layerEnds;
  }

  /**
   * One scene per layer that `bytes` complete, as `Stream.feed` gives them. Rejects with its DecodeError.
   *
   * @param {Uint8Array} bytes @param {{transfer?: boolean}} [options] transfer: the buffer of `bytes` is given away
   * @returns {Promise<Scene[]>}
   */
  feed(bytes, { transfer = false } = {}) {
    return this._ask({ feed: bytes }, transfer ? [/** @type {ArrayBuffer} */ (bytes.buffer)] : []);
  }

  /** As `Stream.rewind`. */
  async rewind() {
    await this._ask({ rewind: true });
  }

  /** As `Stream.finish`: says that no bytes follow. */
  async finish() {
    await this._ask({ finish: true });
  }

  /** Ends the Worker. Calls that wait for an answer reject. */
  close() {
    this._fail(new Error("the decoder was closed"));
    if ("terminate" in this._port) /** @type {Worker} */ (this._port).terminate();
    else if ("close" in this._port) /** @type {MessagePort} */ (this._port).close();
  }

  /** @param {object} question @param {Transferable[]} [transfer] @returns {Promise<Scene[]>} */
  _ask(question, transfer = []) {
    if (this._failure) return Promise.reject(this._failure);
    return new Promise((resolve, reject) => {
      const id = this._asked++;
      this._waiting.set(id, { resolve, reject });
      this._port.postMessage({ id, ...question }, transfer);
    });
  }

  /** @param {Answer} answer */
  _take({ id, scenes, state, fault, crash }) {
    const waiting = this._waiting.get(id);
    if (!waiting) return;
    this._waiting.delete(id);
    this._state = state;
    if (fault) waiting.reject(new DecodeError(fault.kind, fault.reason, fault));
    else if (crash !== undefined) waiting.reject(new Error(crash));
    else waiting.resolve(scenes);
  }

  /** @param {Error} error */
  _fail(error) {
    this._failure ??= error;
    for (const { reject } of this._waiting.values()) reject(this._failure);
    this._waiting.clear();
  }
}
