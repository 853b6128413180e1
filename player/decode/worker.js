// The worker of worker-decoder.js: a Stream whose answers carry its state.

import { serve } from "./remote.js";
import { Stream } from "./stream.js";

let stream = new Stream();

/** @param {() => import("./scene.js").Scene[] | void} call */
function answer(call) {
  const state = () => ({ consumed: stream.consumed, complete: stream.complete, layerEnds: stream.layerEnds });
  try {
    return { scenes: call() ?? [], ...state() };
  } catch (error) {
    throw Object.assign(/** @type {Error} */ (error), { state: state() });
  }
}

serve({
  /** @param {{maxLayer?: number | null}} options */
  open: (options) => answer(() => void (stream = new Stream(options))),
  /** @param {Uint8Array} bytes */
  feed: (bytes) => answer(() => stream.feed(bytes)),
  rewind: () => answer(() => stream.rewind()),
  finish: () => answer(() => stream.finish()),
});
