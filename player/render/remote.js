// Calls of functions in a worker: `Remote` on the page's side, `serve` and `tell` on the worker's.

/** A worker whose functions are called by name. */
export class Remote {
  /** @param {URL | Worker} from the worker, or its module @param {(message: any) => void} [told] receives `tell` */
  constructor(from, told = () => {}) {
    /** @type {Map<number, {resolve: (value: any) => void, reject: (error: Error) => void}>} */
    this._waiting = new Map();
    this._calls = 0;
    /** @type {Error | null} */
    this._failed = null;
    try {
      this._worker = from instanceof Worker ? from : start(from);
    } catch (error) {
      this._fail(new Error(`this page may start no worker: ${/** @type {Error} */ (error).message}`));
      return;
    }
    this._worker.onmessage = ({ data }) => {
      const waiting = this._waiting.get(data.call);
      this._waiting.delete(data.call);
      if (!waiting) {
        if (data.told && !this._failed) told(data.told); // else a reply to an abandoned call
      } else if (data.error) waiting.reject(Object.assign(new Error(data.error.message), data.error));
      else waiting.resolve(data.result);
    };
    this._worker.onerror = (event) => {
      event.preventDefault();
      const why = "it was not found, or the page's policy forbids it (Content-Security-Policy: worker-src)";
      this._fail(new Error(`a worker stopped: ${event.message || why}`));
    };
  }

  /**
   * Calls a function of the worker. Rejects with its error, whose own properties are kept.
   *
   * @param {string} name @param {unknown[]} args @param {Transferable[]} [transfer]
   * @returns {Promise<any>}
   */
  call(name, args, transfer = []) {
    if (this._failed) return Promise.reject(this._failed);
    return new Promise((resolve, reject) => {
      const call = ++this._calls;
      this._waiting.set(call, { resolve, reject });
      this._worker?.postMessage({ call, name, args }, transfer);
    });
  }

  /** @param {Error} error */
  _fail(error) {
    this._failed ??= error;
    for (const { reject } of this._waiting.values()) reject(this._failed);
    this._waiting.clear();
  }

  /** Ends the worker. Unanswered and later calls are rejected. */
  close() {
    this._worker?.terminate();
    this._fail(new Error("the worker was closed"));
  }
}

/** @param {URL} url @returns {Worker} */
function start(url) {
  if (url.protocol === "blob:") return new Worker(url); // packed: a page from a file cannot load modules
  if (url.origin === globalThis.origin) return new Worker(url, { type: "module" });
  // a browser starts no worker from another origin, but one that imports from there
  const source = new Blob([`import ${JSON.stringify(url.href)};`], { type: "text/javascript" });
  const local = URL.createObjectURL(source);
  const worker = new Worker(local, { type: "module" });
  setTimeout(() => URL.revokeObjectURL(local), 10_000);
  return worker;
}

/**
 * Answers calls by name.
 *
 * @param {Record<string, (...args: any[]) => unknown>} functions they return a value or a promise of it; `{result,
 * transfer}` transfers buffers
 */
export function serve(functions) {
  addEventListener("message", async ({ data: { call, name, args } }) => {
    try {
      const value = /** @type {any} */ (await functions[name](...args));
      tell({ call, result: value?.transfer ? value.result : value }, value?.transfer);
    } catch (error) {
      const { message, name: kind, ...rest } = /** @type {Error} */ (error);
      tell({ call, error: { ...rest, message: String(message), name: kind } });
    }
  });
}

/** Sends a message from a worker. @param {unknown} message @param {Transferable[]} [transfer] */
export function tell(message, transfer = []) {
  postMessage(message, { transfer });
}
