// The worker that loads and decodes: bytes in, one scene per completed layer out.

import { openStream } from "../decode/index.js";
import { serve, tell } from "./remote.js";

/** Attempts to go on after a connection broke, and the wait before each, milliseconds. */
const RETRIES_MS = [300, 1000, 3000];
/** Between two messages about progress, milliseconds. */
const PROGRESS_MS = 100;

/** Budgets, beyond the first layer. @typedef {{level?: number | null, bytes?: number | null, seconds?: number | null}} Budgets */

serve({
  /**
   * @param {string | Blob} source @param {Budgets} budgets
   * @returns {Promise<{bytes: number, complete: boolean}>}
   */
  async load(source, { level = null, bytes: mostBytes = null, seconds = null }) {
    const started = performance.now();
    const stream = openStream({ maxLayer: level });
    let count = 0;
    let shown = false;
    let told = 0;
    for await (const { piece, total } of typeof source === "string" ? download(source) : pieces(source)) {
      count += piece.length;
      const scenes = stream.feed(piece);
      const ends = stream.layerEnds;
      for (const scene of scenes) tell({ told: { scene, bytes: count, total, ends } });
      shown ||= scenes.length > 0;
      const now = performance.now();
      if (!scenes.length && now - told > PROGRESS_MS) {
        tell({ told: { bytes: count, total, ends } });
        told = now;
      }
      if (stream.complete) break;
      const spent = (mostBytes !== null && count >= mostBytes) || (seconds !== null && now - started >= 1000 * seconds);
      if (shown && spent) return { bytes: count, complete: false };
    }
    stream.finish();
    return { bytes: count, complete: true };
  },
});

/** @typedef {{piece: Uint8Array, total: number | null}} Piece */

/** @param {Blob} file @returns {AsyncGenerator<Piece>} */
async function* pieces(file) {
  const reader = file.stream().getReader();
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    yield { piece: value, total: file.size };
  }
}

/**
 * The bytes of an address, in order, each once. Where the connection breaks, a range request goes on from there, if the
 * file is still the same.
 *
 * @param {string} url @returns {AsyncGenerator<Piece>}
 */
async function* download(url) {
  let count = 0;
  let tag = "";
  for (let attempt = 0; ; attempt++) {
    try {
      /** @type {Record<string, string>} */
      const headers = count ? { Range: `bytes=${count}-`, ...(tag && { "If-Range": tag }) } : {};
      const response = await fetch(url, { headers });
      if (!response.ok) throw new HttpError(`the server answers ${response.status} to ${url}`);
      let skip = response.status === 206 ? 0 : count;
      const etag = response.headers.get("ETag") ?? "";
      if (skip && etag !== tag) throw new HttpError(`${url} changed while it was loaded`);
      if (!etag.startsWith("W/")) tag = etag;
      const length = Number(response.headers.get("Content-Length") ?? NaN);
      const encoded = response.headers.has("Content-Encoding");
      const total = Number.isFinite(length) && !encoded ? length + count - skip : null;
      const reader = /** @type {ReadableStream<Uint8Array>} */ (response.body).getReader();
      for (;;) {
        const { value, done } = await reader.read();
        if (done) return;
        const piece = value.subarray(Math.min(skip, value.length));
        skip -= value.length - piece.length;
        count += piece.length;
        attempt = 0;
        if (piece.length) yield { piece, total };
      }
    } catch (error) {
      if (!(error instanceof TypeError) || attempt >= RETRIES_MS.length) {
        throw error instanceof TypeError ? new Error(`${url} cannot be loaded: ${error.message}`) : error;
      }
      await new Promise((resolve) => setTimeout(resolve, RETRIES_MS[attempt]));
    }
  }
}

class HttpError extends Error {}
