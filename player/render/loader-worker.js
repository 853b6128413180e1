// The worker that fetches and decodes: bytes in, one scene per completed slice out.

import { SceneSource } from "../decode/fetch.js";
import { serve, tell } from "../decode/remote.js";
import { Stream } from "../decode/stream.js";

/** Between two messages about progress, milliseconds. */
const PROGRESS_MS = 100;

/**
 * A message while a scene loads. arrived and decoded: milliseconds since the epoch.
 *
 * @typedef {object} News
 * @property {import("../decode/scene.js").Scene} [scene]
 * @property {number} arrived when the last byte of the scene came
 * @property {number} decoded when it was decoded
 * @property {number} bytes
 * @property {number | null} total
 * @property {{layer: number, end: number}[]} ends where in the file each slice ends, empty until the header is there
 */

/** The answer that early.js asked for, which serves once. */
/** @typedef {{url: string, answer: Promise<Response>, controller: AbortController}} Early */
let { early } = /** @type {{early?: Early}} */ (globalThis);

/** As fetch. @param {RequestInfo | URL} url @param {RequestInit} [options] */
function ask(url, options) {
  if (!early || url !== early.url) return fetch(url, options);
  const { answer, controller } = early;
  early = undefined;
  options?.signal?.addEventListener("abort", () => controller.abort());
  return answer;
}

let decoder = new Stream();
/** @type {SceneSource} */
let source;
let told = 0;
let arrived = 0;
const epochNow = () => performance.timeOrigin + performance.now();

/** @param {News["scene"]} [scene] */
function report(scene) {
  const { received: bytes, total } = source;
  const times = { arrived, decoded: epochNow() };
  tell({ told: { ...(scene && { scene }), bytes, total, ends: decoder.layerEnds, ...times } });
  told = performance.now();
}

serve({
  /** @param {string | Blob} from */
  open(from) {
    source = new SceneSource(typeof from === "string" ? from : URL.createObjectURL(from), {
      fetch: ask,
      makeDecoder: () => (decoder = new Stream()),
      progress: () => {
        arrived = epochNow();
        if (performance.now() - told > PROGRESS_MS) report();
      },
    });
  },

  /**
   * Loads on within a budget.
   *
   * @param {import("../decode/fetch.js").Budget} budget
   * @returns {Promise<{bytes: number, complete: boolean}>} complete: whether nothing is left to load
   */
  async load(budget) {
    try {
      for await (const scene of source.scenes(budget)) report(scene);
    } finally {
      report();
    }
    const ends = decoder.layerEnds;
    return { bytes: source.received, complete: ends.length > 0 && decoder.consumed >= ends[ends.length - 1].end };
  },
});
