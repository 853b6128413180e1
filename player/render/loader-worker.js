// The worker that fetches and decodes: bytes in, scenes out as slices complete.

import { SceneSource } from "../decode/fetch.js";
import { serve, tell } from "./remote.js";
import { Segments } from "./segments.js";
import { isIndex } from "./timeline.js";
/** @import { Scene } from "../kinds/index.js" */

/** Between two messages about progress, milliseconds. */
const PROGRESS_MS = 100;
/** A scene is copied to the page, and prepared there. So after one of them the next waits for so many times as long. */
const REST = 4;

/**
 * A message while a scene loads. arrived and decoded: milliseconds since the epoch.
 *
 * @typedef {object} News
 * @property {import("../kinds/index.js").Scene} [scene]
 * @property {number} arrived when the last byte of the scene came
 * @property {number} decoded when it was decoded
 * @property {number} consumed bytes that the scene is made of
 * @property {number} bytes that have arrived
 * @property {number | null} total
 * @property {{layer: number, end: number}[]} ends where in the file each slice ends, empty until the header is there
 * @property {import("./timeline.js").Segment[]} [segments] of a scene that is cut in time, once
 * @property {number} [part] of such a scene, see `Part` @property {string} [problem]
 */

/** The answer that early.js asked for, which serves once. */
/** @typedef {{url: string, answer: Promise<Response>, controller: AbortController}} Early */
let { early } = /** @type {{early?: Early}} */ (globalThis);

/** As fetch. @param {RequestInfo | URL} url @param {RequestInit} [options] */
function ask(url, options) {
  if (!early || url !== early.url) return fetch(url, options);
  const { answer, controller } = early;
  early = undefined;
  const signal = options?.signal;
  signal?.addEventListener("abort", () => controller.abort(signal.reason));
  return answer;
}

/** @type {SceneSource} */
let source;
/** @type {Segments | null} */
let segments = null;
let told = 0;
let arrived = 0;
const epochNow = () => performance.timeOrigin + performance.now();
/** @typedef {Pick<News, "arrived" | "decoded" | "consumed">} Origin */
/** @param {number} consumed @returns {Origin} of what is decoded now */
const origin = (consumed) => ({ arrived, decoded: epochNow(), consumed });

/** The newest scene, until it is told. @type {({scene: Scene} & Origin) | null} */
let newest = null;
/** When the next scene may be told, performance.now(), and what will tell it. */
let free = 0;
let timer = /** @type {ReturnType<typeof setTimeout> | 0} */ (0);

/** Tells the scene now, or the newest one as soon as the last one is dealt with. @param {Scene} scene */
function offer(scene) {
  newest = { scene, ...origin(source.decoder.consumed) };
  const wait = free - performance.now();
  if (wait <= 0) flush();
  else if (!timer) timer = setTimeout(flush, wait);
}

/** Tells the newest scene, if it is not told yet. */
function flush() {
  clearTimeout(timer);
  timer = 0;
  if (!newest) return;
  const start = performance.now();
  const { scene, ...from } = newest;
  newest = null;
  /** @type {Transferable[]} */
  const transfer = [];
  report(own(scene, transfer), transfer, from);
  const now = performance.now();
  free = now + REST * (now - start);
}

/** The scene with arrays that are its own, where messages copy all that a view is a part of; their buffers go to
 * `transfer`. @param {Scene} scene @param {Transferable[]} transfer @returns {Scene} */
function own(scene, transfer) {
  /** @type {Map<object, any>} */
  const made = new Map(); // levels share what moves them
  /** @param {any} value @returns {any} */
  const copy = (value) => {
    if (typeof value !== "object" || value === null) return value;
    if (!made.has(value)) made.set(value, anew(value));
    return made.get(value);
  };
  /** @param {any} value */
  const anew = (value) => {
    if (Array.isArray(value)) return value.map(copy);
    if (!ArrayBuffer.isView(value)) return Object.fromEntries(Object.entries(value).map(([k, part]) => [k, copy(part)]));
    const whole = value.byteLength === value.buffer.byteLength;
    const part = whole ? value : /** @type {Float32Array} */ (value).slice();
    if (!whole) transfer.push(part.buffer);
    return part;
  };
  return copy(scene);
}

/** @param {Scene} [scene] @param {Transferable[]} [transfer] of it @param {Origin} [from] */
function report(scene, transfer, from = origin(source.decoder.consumed)) {
  const { received: bytes, total, decoder } = source;
  tell({ told: { ...(scene && { scene }), bytes, total, ends: decoder.layerEnds, ...from } }, transfer);
  told = performance.now();
}

/** Tells of a part of a scene that is cut in time. @param {Partial<import("./segments.js").Part>} part */
function hand({ scene, ...part }) {
  const { received: bytes, index } = /** @type {Segments} */ (segments);
  /** @type {Transferable[]} */
  const transfer = [];
  const own_ = scene && own(scene, transfer);
  const first = index && !told && { segments: index.segments };
  const from = { bytes, total: null, ends: [], ...origin(bytes) };
  tell({ told: { ...(own_ && { scene: own_ }), ...part, ...first, ...from } }, transfer);
  if (index) told = performance.now();
}

serve({
  /** @param {string | Blob} from */
  open(from) {
    if (isIndex(from)) {
      segments = new Segments(/** @type {string} */ (from), ask, hand, () => {
        arrived = epochNow();
        if (told && performance.now() - told > PROGRESS_MS) hand({});
      });
      return;
    }
    source = new SceneSource(typeof from === "string" ? from : "the file", {
      fetch: typeof from === "string" ? ask : async () => new Response(from), // no address that a policy may forbid
      progress: () => {
        arrived = epochNow();
        if (performance.now() - told > PROGRESS_MS) report();
      },
    });
  },

  /**
   * Loads on within a budget.
   *
   * @param {import("../decode/fetch.js").Budget & {time?: number | null}} budget time: seconds, of a scene that is cut
   * in time
   * @returns {Promise<{bytes: number, complete: boolean, superseded?: boolean}>} complete: whether nothing is left to
   * load. superseded: whether a later call took its place
   */
  async load(budget) {
    if (segments) {
      const last = await segments.load(budget);
      if (last) hand({});
      return { bytes: segments.received, complete: false, superseded: !last };
    }
    try {
      for await (const scene of source.scenes(budget)) offer(scene);
    } finally {
      flush();
      report();
    }
    const { layerEnds: ends, consumed } = source.decoder;
    return { bytes: source.received, complete: ends.length > 0 && consumed >= ends[ends.length - 1].end };
  },
});
