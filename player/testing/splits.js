// Ways to decode the bytes of a file in pieces, and what one takes: in Node and in pages.

import { SceneSource } from "../decode/fetch.js";
import { decode, openStream } from "../decode/index.js";
/** @import { Scene } from "../decode/index.js" */

/** The scenes of a stream that is fed these pieces. @param {Uint8Array} bytes @param {Iterable<number>} cuts */
export function* fed(bytes, cuts) {
  const stream = openStream();
  let at = 0;
  for (const end of [...cuts, bytes.length]) yield* stream.feed(bytes.subarray(at, (at = end)));
  stream.finish();
}

/** An answer whose bytes come in pieces of `size`, as soon as they are asked for.
 * @param {Uint8Array} bytes @param {number} size */
function answer(bytes, size) {
  let at = 0;
  const body = new ReadableStream({
    pull: (to) => (at < bytes.length ? to.enqueue(bytes.slice(at, (at += size))) : to.close()),
  });
  return new Response(body, { headers: { "Content-Length": String(bytes.length), ETag: '"a"' } });
}

/** The scenes of a source whose bytes come in pieces of `size`. @param {Uint8Array} bytes @param {number} size */
export const fetched = (bytes, size) => new SceneSource("http://x/", { fetch: async () => answer(bytes, size) }).scenes();

/** Multiples of `size` below the length of `bytes`. @param {Uint8Array} bytes @param {number} size */
export const every = (bytes, size) => Array.from({ length: Math.ceil(bytes.length / size) - 1 }, (_, i) => (i + 1) * size);

/** The least time of `runs`, for a collection of garbage may fall into one. @param {() => unknown} work
 * @param {() => number} clock @param {number} runs */
export async function least(work, clock, runs) {
  let found = Infinity;
  for (let i = 0; i < runs; i++) {
    const start = clock();
    await work();
    found = Math.min(found, clock() - start);
  }
  return found;
}

/** Reads an answer to its end. @param {Response} answered */
async function drained({ body }) {
  const reader = /** @type {ReadableStream} */ (body).getReader();
  while (!(await reader.read()).done);
}

/** @typedef {"decode" | "stream" | "served" | "serverAlone" | "source" | "sourceAlone"} Way */

/** What one way does. "served" reads a URL; the ways "alone" read what "served" and "source" do and decode nothing.
 * @param {Uint8Array} bytes @param {Way} way @param {number} size of a piece @param {string} [url] */
export function working(bytes, way, size, url = "") {
  const cuts = way === "stream" ? every(bytes, size) : [];
  /** The newest one is held, as by a caller who draws it. @type {{scene?: Scene}} */
  const kept = {};
  const ways = {
    decode: () => void (kept.scene = decode(bytes)),
    stream: () => {
      for (kept.scene of fed(bytes, cuts));
    },
    served: async () => {
      for await (kept.scene of new SceneSource(url).scenes());
    },
    source: async () => {
      for await (kept.scene of fetched(bytes, size));
    },
    serverAlone: async () => drained(await fetch(url)),
    sourceAlone: () => drained(answer(bytes, size)),
  };
  return ways[way];
}
