// What Player and Pd4Splats share: events, and the worker that fetches and decodes.

import { Remote } from "./remote.js";

/**
 * What early.js began: a worker that requests `url`, null if it could not. begin: gives it the address of the loader's
 * code; only the first call counts.
 *
 * @typedef {{url: string, worker: Worker | null, begin: (code: string) => void}} Early
 */

/**
 * @param {(news: import("./loader-worker.js").News) => void} told
 * @param {string | Blob} [from] what it will be asked to open
 */
export function startLoader(told, from) {
  const code = new URL("./loader-worker.js", import.meta.url);
  const { early } = /** @type {{early?: Early}} */ (globalThis);
  const worker = early?.worker;
  if (!worker || early.url !== from) return new Remote(code, told);
  early.worker = null; // its response serves once
  early.begin(code.href);
  return new Remote(worker, told);
}

/** An EventTarget whose events have a detail. */
export class Emitter extends EventTarget {
  /** @param {string} name @param {object} detail */
  _emit(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  /** Emits `error`. @param {unknown} error */
  _fail(error) {
    const { message, name, kind = name } = /** @type {Error & {kind?: string}} */ (error);
    this._emit("error", { message, kind });
  }
}
