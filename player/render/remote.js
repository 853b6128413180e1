// Calls across a worker's border: the page's side. The worker's is serve.js.

/**
 * A worker whose functions are called by name, or one made from the module at a URL.
 */
export class Remote {
  /** @param {URL | Worker} from @param {(message: any) => void} [told] takes what the worker says unasked */
  constructor(from, told = () => {}) {
    /** @type {Map<number, {resolve: (value: any) => void, reject: (error: Error) => void}>} */
    this._waiting = new Map();
    this._calls = 0;
    this._worker = from instanceof Worker ? from : start(from);
    this._worker.onmessage = ({ data }) => {
      const waiting = this._waiting.get(data.call);
      if (!waiting) {
        if (data.told && !this._failed) told(data.told); // else a reply to a call that was given up
        return;
      }
      this._waiting.delete(data.call);
      if (data.error) waiting.reject(Object.assign(new Error(data.error.message), data.error));
      else waiting.resolve(data.result);
    };
    this._worker.onerror = (event) => {
      event.preventDefault();
      this._fail(new Error(`a worker stopped: ${event.message || "it could not be loaded"}`));
    };
  }

  /**
   * Calls a function of the worker.
   *
   * @param {string} name @param {unknown[]} args @param {Transferable[]} [transfer]
   * @returns {Promise<any>}
   */
  call(name, args, transfer = []) {
    if (this._failed) return Promise.reject(this._failed);
    return new Promise((resolve, reject) => {
      const call = ++this._calls;
      this._waiting.set(call, { resolve, reject });
      this._worker.postMessage({ call, name, args }, transfer);
    });
  }

  /** @param {Error} error */
  _fail(error) {
    /** @type {Error | undefined} */
    this._failed = error;
    for (const { reject } of this._waiting.values()) reject(error);
    this._waiting.clear();
  }

  /** Ends the worker; calls under way are rejected. */
  close() {
    this._worker.terminate();
    this._fail(new Error("closed"));
  }
}

/**
 * What early.js began: a worker that asks `url` for a scene, null if it could not. begin: gives it the address of the
 * loader's code, which counts once.
 *
 * @typedef {{url: string, worker: Worker | null, begin: (code: string) => void}} Early
 */

/**
 * The worker that fetches and decodes.
 *
 * @param {(news: import("./loader-worker.js").News) => void} told
 * @param {string | Blob} [from] what it will be asked to open
 */
export function startLoader(told, from) {
  const code = new URL("./loader-worker.js", import.meta.url);
  const { early } = /** @type {{early?: Early}} */ (globalThis);
  const worker = early?.worker;
  if (!worker || early.url !== from) return new Remote(code, told);
  early.worker = null; // its answer serves once
  early.begin(code.href);
  return new Remote(worker, told);
}

/** @param {URL} url @returns {Worker} */
function start(url) {
  if (url.protocol === "blob:") return new Worker(url); // packed: no module, which a page from a file cannot load
  if (url.origin === location.origin) return new Worker(url, { type: "module" });
  // a browser starts no worker of another origin, but one that imports from there
  const source = new Blob([`import ${JSON.stringify(url.href)};`], { type: "text/javascript" });
  const local = URL.createObjectURL(source);
  const worker = new Worker(local, { type: "module" });
  setTimeout(() => URL.revokeObjectURL(local), 10_000);
  return worker;
}
