// A file on a web server, slice by slice: bytes are decoded as they arrive, and a download that is cut resumes.

import { LONGEST_HEADER, PREAMBLE_SIZE, headerLength } from "./container.js";
import { DecodeError } from "./errors.js";
import { Stream } from "./stream.js";
/** @import { Scene } from "./scene.js" */

/** @typedef {{layer: number, end: number}} LayerEnd */

/** The file is not available, as opposed to one that cannot be decoded. */
export class FetchError extends Error {
  /** @param {string} message */
  constructor(message) {
    super(message);
    this.name = "FetchError";
  }
}

/**
 * Limits of a download: highest layer, bytes from the first of the file, seconds from the call. The first slice is
 * fetched if it ends within `bytes`, a later one only if it would also arrive in time at the recent rate.
 *
 * @typedef {{maxLayer?: number, bytes?: number, seconds?: number}} Budget
 */

/**
 * A Stream, or a WorkerDecoder.
 *
 * @typedef {object} Decoder
 * @property {(bytes: Uint8Array) => Scene[] | Promise<Scene[]>} feed
 * @property {() => void | Promise<void>} rewind
 * @property {() => void | Promise<void>} finish
 * @property {LayerEnd[]} layerEnds
 * @property {number} consumed
 */

/**
 * makeDecoder: called once, and again if the file changes; its decoder has no limit of layers. stall: seconds without a
 * byte after which a connection counts as cut. attempts: consecutive failures, without a byte between them, before giving
 * up. pause: seconds before the second attempt, doubled for each further one. progress: called as bytes arrive.
 *
 * @typedef {object} SourceOptions
 * @property {AbortSignal} [signal]
 * @property {() => Decoder} [makeDecoder]
 * @property {number} [stall]
 * @property {number} [attempts]
 * @property {number} [pause]
 * @property {(received: number, total: number | null) => void} [progress]
 * @property {typeof globalThis.fetch} [fetch]
 */

/** Limit of layer 0 without a budget of bytes: bytes are held until their slice is complete. */
const MOST_BYTES = 2 ** 28;
const RATE_SECONDS = 1;
/** Temporary errors. */
const TEMPORARY = [408, 425, 429, 500, 502, 503, 504];
/** After so many changes the file counts as never stable. */
const MOST_CHANGES = 4;

/** The connection ended early, or the response is invalid: a new request may help. */
class Cut extends Error {}
/** The file has changed, and none of its bytes are here yet. */
class Changed extends Error {}
/** The time budget is spent. */
class OutOfTime extends Error {}

/**
 * The scenes of one URL. `scenes()` yields one per slice; called again, with another budget, it continues after the last
 * one. A damaged slice is fetched once more and never yielded.
 */
export class SceneSource {
  /** @param {string | URL} url @param {SourceOptions} [options] */
  constructor(url, options = {}) {
    const { signal, makeDecoder = () => new Stream(), stall = 10, attempts = 5, pause = 0.2, progress } = options;
    this.url = String(url);
    /** How often each happened. */
    this.requests = 0;
    this.cuts = 0;
    this.changes = 0;
    /** Bytes of the file that have arrived from its first one on, and its length, null until it is told. */
    this.received = 0;
    /** @type {number | null} */
    this.total = null;
    this._signal = signal;
    this._makeDecoder = makeDecoder;
    this._decoder = makeDecoder();
    this._stall = stall;
    this._attempts = attempts;
    this._pause = pause;
    this._progress = progress;
    this._fetch = options.fetch ?? globalThis.fetch.bind(globalThis);
    /** @type {string | null} */
    this._validator = null;
    /** @type {Answer | null} */
    this._answer = null;
    /** Where the file was fetched anew after damage. */
    this._repairedAt = -1;
    /** Preamble of the file. */
    this._head = new Uint8Array(PREAMBLE_SIZE);
    /** When bytes came, and how many had come since the request. @type {[number, number][]} */
    this._marks = [];
  }

  /** Ends the connection. `scenes` may be called again. */
  close() {
    this._answer?.controller.abort();
    this._answer = null;
  }

  /**
   * One scene per slice that completes, each with all slices so far, until the budget or the file ends.
   *
   * Raises FetchError if the file is not available, DecodeError if it is invalid, and the signal's reason if it is
   * aborted; scenes yielded before stay valid. If the file changes, its scenes restart with layer 0. Without a budget in
   * bytes, a layer 0 that ends behind byte 2^28 is LimitExceeded.
   *
   * @param {Budget} [budget]
   * @returns {AsyncGenerator<Scene, void, void>}
   */
  async *scenes({ maxLayer = Infinity, bytes, seconds = Infinity } = {}) {
    const until = now() + seconds;
    try {
      for (;;) {
        const ends = this._decoder.layerEnds;
        const wanted = ends.filter(({ layer, end }) => layer <= maxLayer && end <= (bytes ?? MOST_BYTES));
        if (ends.length && !wanted.length && bytes === undefined && maxLayer >= 0) {
          throw new DecodeError("LimitExceeded", `layer 0 ends at byte ${ends[0].end}, limit ${MOST_BYTES}`);
        }
        const end = ends.length ? this._nextEnd(wanted, until) : this._headerEnd();
        if (end === null) return;
        let block;
        try {
          block = await this._read(end, until);
        } catch (error) {
          if (error instanceof Changed) continue;
          throw error;
        }
        if (block === null) {
          await this._decoder.finish(); // the file ends within this layer: Truncated
          return;
        }
        yield* await this._feed(block);
      }
    } catch (error) {
      if (!(error instanceof OutOfTime)) throw error;
    } finally {
      this.close();
    }
  }

  /** The end of preamble or header: nothing behind them is decoded before the budget is checked. */
  _headerEnd() {
    if (this.received < PREAMBLE_SIZE) return PREAMBLE_SIZE;
    return Math.min(PREAMBLE_SIZE + headerLength(this._head), LONGEST_HEADER);
  }

  /** The end of the next slice to fetch, or null to stop. @param {LayerEnd[]} wanted @param {number} until */
  _nextEnd(wanted, until) {
    const next = wanted.find(({ end }) => end > this._decoder.consumed);
    const left = until - now();
    if (!next || left <= 0) return null;
    const rate = this._rate();
    const first = next.end === wanted[0].end;
    const inTime = left === Infinity || rate === null || next.end - this.received <= rate * left;
    return first || inTime ? next.end : null;
  }

  /** Bytes per second over the last second of transfer, null before any came. */
  _rate() {
    const first = this._marks[0];
    const last = this._marks[this._marks.length - 1];
    return this._marks.length > 1 && last[1] > first[1] ? (last[1] - first[1]) / Math.max(last[0] - first[0], 1e-6) : null;
  }

  /** The scenes that a block completes. After damage the download goes back to the last valid chunk, once.
   * @param {Uint8Array} block @returns {Promise<Scene[]>} */
  async _feed(block) {
    try {
      return await this._decoder.feed(block);
    } catch (error) {
      const damaged = error instanceof DecodeError && error.kind !== "BadSignature" && error.kind !== "UnsupportedVersion";
      const good = this._decoder.consumed;
      if (!damaged || this._repairedAt === good) throw error;
      this._repairedAt = good;
      this.close();
      this.received = good;
      await this._decoder.rewind();
      return [];
    }
  }

  /**
   * The next bytes to arrive, none beyond `end`; null if the file ends. Raises Changed, OutOfTime, FetchError or the
   * signal's reason.
   *
   * @param {number} end @param {number} until
   * @returns {Promise<Uint8Array | null>}
   */
  async _read(end, until) {
    for (let failures = 0; ; ) {
      this._signal?.throwIfAborted();
      if (now() >= until) throw new OutOfTime();
      if (this.total !== null && this.received >= this.total) return null;
      try {
        const { changes } = this;
        this._answer ??= await this._request(until);
        if (this.changes !== changes) throw new Changed();
        const block = await this._answer.take(end - this.received, this._waiting(until));
        if (block === null) {
          const { total } = this;
          this._answer = null;
          if (total !== null && this.received < total) throw new Cut(`ended at byte ${this.received} of ${total}`);
          this.total = this.received; // a length that was never told ends with the answer
        } else if (block.length) {
          if (this.received < PREAMBLE_SIZE) this._head.set(block, this.received);
          this._note(block.length);
          return block;
        }
      } catch (error) {
        if (error instanceof Changed) throw error;
        this.close();
        this._signal?.throwIfAborted();
        if (now() >= until) throw new OutOfTime();
        // fetch raises TypeError where there is no connection, or it ends
        if (!(error instanceof Cut || error instanceof TypeError || error instanceof DOMException)) throw error;
        this.cuts++;
        failures++;
        if (failures >= this._attempts) {
          throw new FetchError(`${this.url}: ${error.message} (${this.received} bytes are here)`);
        }
        if (failures > 1) await sleep(Math.min(this._pause * 2 ** (failures - 2), until - now()), this._signal);
      }
    }
  }

  /** Milliseconds to wait for a byte. @param {number} until */
  _waiting(until) {
    return Math.max(0, Math.min(this._stall, until - now())) * 1000;
  }

  /** @param {number} size */
  _note(size) {
    this.received += size;
    const marks = this._marks;
    marks.push([now(), marks[marks.length - 1][1] + size]);
    while (marks.length > 2 && marks[marks.length - 1][0] - marks[1][0] >= RATE_SECONDS) marks.shift();
    this._progress?.(this.received, this.total);
  }

  /** Requests the missing bytes. @param {number} until @returns {Promise<Answer>} */
  async _request(until) {
    const start = this.received;
    const resumes = start > 0 && this._validator !== null;
    /** @type {Record<string, string>} */
    const headers = {};
    if (resumes) {
      headers["Range"] = `bytes=${start}-`;
      headers["If-Range"] = /** @type {string} */ (this._validator);
    }
    const controller = new AbortController();
    const onAbort = () => controller.abort(this._signal?.reason);
    this._signal?.addEventListener("abort", onAbort, { once: true });
    this.requests++;
    this._marks = [[now(), 0]];
    try {
      // a request after a cut or damage bypasses caches
      const asked = this._fetch(this.url, { headers, signal: controller.signal, cache: start ? "no-store" : "default" });
      const response = await within(asked, this._waiting(until));
      const skip = this._accept(response, start, resumes);
      return new Answer(response, controller, skip, () => this._signal?.removeEventListener("abort", onAbort));
    } catch (error) {
      controller.abort();
      this._signal?.removeEventListener("abort", onAbort);
      throw error;
    }
  }

  /**
   * Checks a response; restarts if the file has changed. Returns how many of its bytes are here already.
   *
   * @param {Response} response @param {number} start @param {boolean} resumes
   */
  _accept(response, start, resumes) {
    const { status, headers } = response;
    if (status === 416 && resumes) {
      this._restart();
      throw new Changed("the file has become shorter");
    }
    if (status !== 200 && status !== 206) {
      const said = `the server answers ${status} ${response.statusText}`.trimEnd();
      if (TEMPORARY.includes(status)) throw new Cut(said);
      throw new FetchError(`${this.url}: ${said}`);
    }
    const tag = headers.get("ETag");
    const strong = tag && !tag.startsWith("W/") ? tag : null;
    const validator = strong ?? headers.get("Last-Modified");
    if (status === 206) {
      const part = /^bytes (\d{1,15})-(\d{1,15})\/(\d{1,15})$/.exec(headers.get("Content-Range") ?? "");
      const known = this.total;
      if (!resumes || !part || Number(part[1]) !== start) throw new Cut("the response is another part than requested");
      if ((validator !== null && validator !== this._validator) || (known !== null && Number(part[3]) !== known)) {
        this._restart();
        throw new Changed("an answer about another file");
      }
      this.total = Number(part[3]);
      return 0;
    }
    const same = strong !== null && strong === this._validator;
    if (start && !same) this._restart();
    // the length of a compressed response is not that of the file
    const length = headers.get("Content-Encoding") ? null : headers.get("Content-Length");
    this.total = length !== null && /^\d{1,15}$/.test(length) ? Number(length) : null;
    this._validator = validator;
    return this.received; // the same file, from a server without ranges
  }

  /** The file has changed. */
  _restart() {
    this.changes++;
    if (this.changes > MOST_CHANGES) throw new FetchError(`${this.url}: changed ${this.changes} times during the download`);
    const { _decoder: old } = this;
    if ("close" in old && typeof old.close === "function") old.close();
    this._decoder = this._makeDecoder();
    this._repairedAt = -1;
    this.received = 0;
    this.total = null;
    this._validator = null;
  }
}

/** The body of one response. */
class Answer {
  /** @param {Response} response @param {AbortController} controller @param {number} skip bytes that are here already
   * @param {() => void} ended */
  constructor(response, controller, skip, ended) {
    this.controller = controller;
    this._reader = response.body?.getReader();
    this._skip = skip;
    this._ended = ended;
    this._rest = new Uint8Array(0);
  }

  /** The next bytes, at most `limit`, empty while bytes are skipped; null at the end.
   * @param {number} limit @param {number} milliseconds to wait for them @returns {Promise<Uint8Array | null>} */
  async take(limit, milliseconds) {
    if (!this._rest.length) {
      if (!this._reader) return null;
      const { done, value } = await within(this._reader.read(), milliseconds);
      if (done) {
        this._ended();
        return null;
      }
      this._rest = value;
    }
    const skipped = Math.min(this._skip, this._rest.length);
    this._skip -= skipped;
    const block = this._skip ? new Uint8Array(0) : this._rest.subarray(skipped, skipped + limit);
    this._rest = this._rest.subarray(skipped + block.length);
    return block;
  }
}

const now = () => performance.now() / 1000;

/** The value of `promise`, or a Cut if that takes longer. @template T @param {Promise<T>} promise
 * @param {number} milliseconds @returns {Promise<T>} */
function within(promise, milliseconds) {
  return new Promise((resolve, reject) => {
    const patience = Math.min(Math.ceil(milliseconds) + 1, 2 ** 31 - 1); // more would fire at once
    const timer = setTimeout(() => reject(new Cut("no byte arrived for too long")), patience);
    promise.then(resolve, reject).finally(() => clearTimeout(timer));
  });
}

/** @param {number} seconds @param {AbortSignal | undefined} signal @returns {Promise<void>} */
function sleep(seconds, signal) {
  return new Promise((resolve, reject) => {
    const end = () => {
      clearTimeout(timer);
      reject(signal?.reason);
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener("abort", end);
      resolve();
    }, seconds * 1000);
    signal?.addEventListener("abort", end, { once: true });
  });
}
