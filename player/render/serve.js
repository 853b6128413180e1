// Calls across a worker's border: the worker's side. The page's is remote.js.

/**
 * What a worker's function may return to hand buffers over.
 *
 * @typedef {{result: unknown, transfer: Transferable[]}} Handed
 */

/**
 * Answers calls by name.
 *
 * @param {Record<string, (...args: any[]) => unknown>} functions they return a value, a promise or `Handed`
 */
export function serve(functions) {
  addEventListener("message", async ({ data: { call, name, args } }) => {
    try {
      const value = /** @type {any} */ (await functions[name](...args));
      const handed = value && typeof value === "object" && "transfer" in value;
      tell({ call, result: handed ? value.result : value }, handed ? value.transfer : []);
    } catch (error) {
      const { message, name: kind, ...rest } = /** @type {Error} */ (error);
      tell({ call, error: { ...rest, message: String(message), name: kind } }, []);
    }
  });
}

/** Sends a message from a worker. @param {unknown} message @param {Transferable[]} [transfer] */
export function tell(message, transfer = []) {
  postMessage(message, { transfer });
}
