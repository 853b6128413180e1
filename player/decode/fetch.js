// A file on a web server, slice by slice: bytes are decoded as they arrive, and a download that is cut resumes.

import { DecodeError } from "./errors.js";
import { Stream } from "./stream.js";
/** @import { Scene } from "../kinds/index.js" */

/** The file is not available, as opposed to one that cannot be decoded. */
export class FetchError extends Error {
  /** @param {string} message in which a server's words are made harmless for a terminal */
  constructor(message) {
    super(message.replace(/[^ -~]/g, (c) => `\\u${c.charCodeAt(0).toString(16).padStart(4, "0")}`));
    this.name = "FetchError";
  }
}

/** Limits of a download: highest layer, bytes from the first of the file, seconds from the first slice's arrival or a
 * later call. The first slice is fetched if it ends within `bytes`, a later one only if it would also arrive in time at
 * the connection's rate so far.
 * @typedef {{maxLayer?: number, bytes?: number, seconds?: number}} Budget */

/**
 * @typedef {object} SourceOptions
 * @property {AbortSignal} [signal]
 * @property {number} [stall] seconds without a byte after which a connection counts as cut
 * @property {number} [attempts] consecutive failures, without a byte between them, before giving up
 * @property {number} [pause] seconds before the second attempt, doubled for each further one
 * @property {(received: number, total: number | null) => void} [progress] called as bytes arrive
 * @property {typeof globalThis.fetch} [fetch]
 * @property {() => Stream} [stream] makes what decodes the file, anew if it changes
 */

/** Limit of layer 0 without a budget of bytes: bytes are held until their slice is complete. */
const MOST_BYTES = 2 ** 28;
/** HTTP status codes of temporary errors. */
const TEMPORARY = [408, 425, 429, 500, 502, 503, 504];
/** After so many changes the file counts as never stable. */
const MOST_CHANGES = 4;

/** The connection ended early, or the response is invalid: a new request may help. */
class Cut extends Error {}

/**
 * The scenes of one URL. `scenes()` yields them as slices arrive; called again, with another budget, it continues after
 * the last one. A damaged slice is fetched once more and never yielded.
 */
export class SceneSource {
  /** @param {string | URL} url @param {SourceOptions} [options] */
  constructor(url, { stall = 10, attempts = 5, pause = 0.2, stream = () => new Stream(), ...options } = {}) {
    this.url = String(url);
    this._options = { stall, attempts, pause, stream, ...options };
    this._fetch = options.fetch ?? globalThis.fetch.bind(globalThis);
    /** Connections that ended early, and changes of the file, so far. */
    this.cuts = 0;
    this.changes = 0;
    /** Bytes of the file that have arrived from its first one on. */
    this.received = 0;
    /** What a server says that the file has, for progress alone: it may be the length of a compressed response.
     * @type {number | null} */
    this._announced = null;
    /** Whether the server has no byte behind those received. */
    this._ended = false;
    /** What decodes the bytes; another one if the file changes. */
    this.decoder = stream();
    /** The file's ETag, or its date; null where the server does not show them. @type {string | null} */
    this._tag = null;
    /** The open connection. @type {AbortController | null} */
    this._controller = null;
    /** Its response. piece: the latest; at: where that begins in the file.
     * @type {{reader: ReadableStreamDefaultReader<Uint8Array>, at: number, piece: Uint8Array} | null} */
    this._body = null;
    /** Ends the wait for the connection: not every body notices that it was aborted. */
    this._giveUp = (/** @type {unknown} */ _reason) => {};
    /** When the request was sent, and how many bytes were here then. */
    this._requested = { at: 0, received: 0 };
    /** Where the file was fetched anew after damage. */
    this._repairedAt = -1;
    const { signal } = options;
    signal?.addEventListener("abort", () => this._abort(signal.reason), { once: true });
  }

  /** Bytes of the file: as its header says, before it is there as the server does; null if neither is known. */
  get total() {
    return this.decoder.end ?? this._announced;
  }

  /** @param {unknown} [reason] */
  _abort(reason) {
    this._giveUp(reason);
    this._controller?.abort(reason);
  }

  /** Ends the connection. `scenes` may be called again. */
  close() {
    this._abort();
    this._controller = this._body = null;
  }

  /**
   * The newest scene whenever a slice completes, with all slices so far, until the budget or the file ends.
   *
   * Raises FetchError if the file is not available, DecodeError if it is invalid, and the signal's reason if it is
   * aborted; scenes yielded before stay valid. If the file changes, its scenes restart with layer 0. Without a budget
   * in bytes, a layer 0 that ends behind byte 2^28 is LimitExceeded.
   *
   * @param {Budget} [budget]
   * @returns {AsyncGenerator<Scene, void, void>}
   */
  async *scenes({ maxLayer = Infinity, bytes, seconds = Infinity } = {}) {
    const { attempts, pause, signal } = this._options;
    const begun = () => this.decoder.consumed >= (this.decoder.layerEnds[0]?.end ?? Infinity);
    let until = now() + seconds;
    let failures = 0;
    try {
      for (;;) {
        signal?.throwIfAborted();
        if (!begun()) until = Infinity; // also of a file that has changed
        const end = this._end(maxLayer, bytes, until);
        if (end === null || now() >= until) return;
        const before = this.received;
        let scenes;
        try {
          scenes = await this._load(end, until);
        } catch (error) {
          this.close();
          signal?.throwIfAborted();
          if (!(error instanceof Cut)) throw error;
          if (now() >= until) return;
          this.cuts++;
          failures = this.received > before ? 1 : failures + 1;
          if (failures >= attempts) {
            throw new FetchError(`${this.url}: ${error.message} (${this.received} bytes received)`);
          }
          const wait = failures > 1 ? Math.min(pause * 2 ** (failures - 2), until - now()) : 0;
          await new Promise((resolve) => setTimeout(resolve, 1000 * wait));
          continue;
        }
        if (this.received > before) failures = 0;
        if (this._ended) return this.decoder.finish(); // the file ends within this layer: Truncated
        if (until === Infinity && begun()) until = now() + seconds;
        yield* scenes;
      }
    } finally {
      this.close();
    }
  }

  /** Where to stop next: behind preamble, header or a slice; null where the budget ends.
   * @param {number} maxLayer @param {number | undefined} bytes @param {number} until */
  _end(maxLayer, bytes, until) {
    const { layerEnds: ends, next } = this.decoder;
    if (!ends.length) return this.decoder.needs; // nothing behind the header is decoded before the budget is checked
    const limit = bytes ?? MOST_BYTES;
    if (ends[0].end > limit && bytes === undefined && maxLayer >= 0) {
      throw new DecodeError("LimitExceeded", `layer 0 ends at byte ${ends[0].end}, limit ${MOST_BYTES}`);
    }
    if (!next || next.layer > maxLayer || next.end > limit) return null;
    const { at, received } = this._requested;
    const rate = (this.received - received) / (now() - at);
    const late = until < Infinity && rate > 0 && next.end - this.received > rate * (until - now());
    return late ? null : next.end;
  }

  /** Feeds the decoder up to byte `end`, before which it completes nothing: the scenes that it makes. Ends earlier,
   * without any, where the response is of no use, or the server has no more. Raises Cut or FetchError.
   * @param {number} end @param {number} until seconds
   * @returns {Promise<Scene[]>} */
  async _load(end, until) {
    if (!this._body && !this._ended) await this._request(until);
    while (this._body && this.received < end) {
      const body = this._body;
      const piece = body.piece.subarray(this.received - body.at, end - body.at);
      if (!piece.length) {
        const { done, value } = await this._wait(() => body.reader.read(), until, "the connection broke");
        if (done) {
          this.close();
          // the header says that more follows, so that it is asked for; a response without a new byte is the answer
          const came = this.received > this._requested.received;
          if (came) throw new Cut(`ended at byte ${this.received} of ${this.total}`);
          this._ended = true;
          return [];
        }
        body.at += body.piece.length;
        body.piece = value;
        continue;
      }
      this.received += piece.length;
      this._options.progress?.(this.received, this.total);
      const scenes = this._feed(piece);
      if (scenes.length) return scenes;
    }
    return [];
  }

  /** The scenes that a piece completes. After damage the download goes back to the last valid chunk, once.
   * @param {Uint8Array} piece @returns {Scene[]} */
  _feed(piece) {
    try {
      return this.decoder.feed(piece);
    } catch (error) {
      const damaged = error instanceof DecodeError && !["BadSignature", "UnsupportedVersion"].includes(error.kind);
      const good = this.decoder.consumed;
      if (!damaged || this._repairedAt === good) throw error;
      this._repairedAt = good;
      this.close();
      if (this._tag === null && this._requested.received) this._restart(); // perhaps the rest of another file
      else {
        this.received = good;
        this.decoder.rewind();
      }
      return [];
    }
  }

  /** Waits for the connection. @template T @param {() => Promise<T>} start @param {number} until
   * @param {string} lost says that it is gone @returns {Promise<T>} */
  async _wait(start, until, lost) {
    this._controller?.signal.throwIfAborted();
    const most = 1000 * Math.min(this._options.stall, until - now());
    const timer = setTimeout(() => this._abort(new Cut("timed out waiting for data")), Math.min(most, 2 ** 31 - 1));
    try {
      return await Promise.race([start(), new Promise((_, reject) => (this._giveUp = reject))]);
    } catch (error) {
      throw error instanceof TypeError || error instanceof DOMException ? new Cut(lost) : error;
    } finally {
      clearTimeout(timer);
    }
  }

  /** Requests the missing bytes. @param {number} until */
  async _request(until) {
    const start = this.received;
    if (this.url.startsWith("file:")) {
      const way = "open the page through a web server (pd4dgs-serve FOLDER), or drop the file onto it";
      throw new FetchError(`${this.url}: browsers do not let a page from a file read another file; ${way}`);
    }
    // without If-Range, for which browsers would ask another origin's permission: the answer tells if it is the file
    /** @type {Record<string, string>} */
    const headers = start ? { Range: `bytes=${start}-` } : {};
    const { signal } = (this._controller = new AbortController());
    this._requested = { at: now(), received: start };
    // a request after a cut or damage bypasses caches
    const request = () => this._fetch(this.url, { headers, signal, cache: start ? "no-store" : "default" });
    // browsers do not tell the two apart
    const response = await this._wait(request, until, "no connection, or no CORS permission of the server");
    const at = this._accept(response, "Range" in headers);
    if (at === null) this.close();
    else this._body = { reader: (response.body ?? new Blob().stream()).getReader(), at, piece: new Uint8Array(0) };
  }

  /** Checks a response; restarts if the file has changed. What does not say so is taken: slices have checksums. Returns
   * where its bytes begin in the file, null if it is of no use.
   * @param {Response} response @param {boolean} resumes whether a range was requested */
  _accept({ status, statusText, headers }, resumes) {
    const beyond = status === 416 && resumes; // there is no such byte
    if (status !== 200 && status !== 206 && !beyond) {
      const said = `the server answered ${status} ${statusText}`.trimEnd();
      if (TEMPORARY.includes(status)) throw new Cut(said);
      throw new FetchError(`${this.url}: ${said}`);
    }
    const tag = (headers.get("ETag") ?? headers.get("Last-Modified"))?.replace(/^W\//, "") ?? null;
    const length = lengthOf(headers.get("Content-Length"));
    // not shown to another origin unless the server exposes it; the length may be an asterisk
    const range = /^bytes (?:(\d{1,15})-\d{1,15}|\*)\/(\d{1,15}|\*)$/.exec(headers.get("Content-Range") ?? "");
    const total = lengthOf(range?.[2]);
    if (tag !== null && this._tag !== null && tag !== this._tag) return this._restart();
    const other = total !== null && (beyond ? total < this.received : total !== (this.decoder.end ?? total));
    if (other) return this._restart();
    this._tag ??= tag;
    if (beyond) {
      this._ended = true;
      return null;
    }
    if (status === 200 || (!range && length !== null && length === this._announced)) {
      this._announced = length;
      return 0; // the same file, from a server without ranges
    }
    const start = range ? Number(range[1]) : this.received;
    if (!(start <= this.received)) throw new Cut("the response holds other bytes than requested");
    this._announced ??= total;
    return start;
  }

  /** The file has changed. @returns {null} */
  _restart() {
    this.changes++;
    if (this.changes > MOST_CHANGES) throw new FetchError(`${this.url}: changed ${this.changes} times while it loaded`);
    this.decoder = this._options.stream();
    this.received = 0;
    this._requested.received = 0;
    this._announced = this._tag = null;
    this._ended = false;
    return null;
  }
}

/** @param {string | null | undefined} text */
const lengthOf = (text) => (/^\d{1,15}$/.test(text ?? "") ? Number(text) : null);

const now = () => performance.now() / 1000;
