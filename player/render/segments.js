// The files that the time at hand needs of a scene that is cut in time. For the worker that loads.

import { SceneSource } from "../decode/fetch.js";
import { Base, Stream } from "../decode/index.js";
import { MOST_BYTES, parseIndex, segmentsAt } from "./timeline.js";
/** @import { Scene } from "../kinds/index.js" */
/** @import { Index } from "./timeline.js" */

/** A decoder that keeps what it was fed, of which a `Base` is made. */
class Keeping extends Stream {
  /** @type {Uint8Array[]} */
  _kept = [];
  _length = 0;

  /** @param {Uint8Array} bytes */
  feed(bytes) {
    this._kept.push(bytes.slice());
    this._length += bytes.length;
    return super.feed(bytes);
  }

  rewind() {
    const bytes = this.bytes().slice(0, this.consumed);
    this._kept = [bytes];
    this._length = bytes.length;
    super.rewind();
  }

  bytes() {
    const whole = new Uint8Array(this._length);
    let at = 0;
    for (const part of this._kept) {
      whole.set(part, at);
      at += part.length;
    }
    return whole;
  }
}

/**
 * What a load tells. `part` is the segment's number, or -1 - b for what base b holds of it; `problem` says in words why
 * a segment does not come.
 *
 * @typedef {{scene?: Scene, part: number, problem?: string}} Part
 */

/** The segments at one address. Of the files it keeps one base. */
export class Segments {
  /** @param {string} url @param {typeof globalThis.fetch} fetch @param {(part: Part) => void} told
   * @param {() => void} progress called as bytes arrive */
  constructor(url, fetch, told, progress) {
    this._url = url;
    this._fetch = fetch;
    this._told = told;
    this._progress = progress;
    /** Bytes that have arrived. */
    this.received = 0;
    /** @type {Index | null} */
    this.index = null;
    /** @type {{number: number, base: Base} | null} */
    this._base = null;
    /** The segments that were told of, of those that are near. @type {Set<number>} */
    this._have = new Set();
    this._level = -1;
    this._run = new AbortController();
  }

  /**
   * Brings the segments at a time, and the next one; bases first. A later call ends an earlier one. What cannot be brought
   * is told of, and the rest goes on.
   *
   * @param {{time?: number | null, maxLayer?: number, bytes?: number}} budget bytes: of bases and segments
   * @returns {Promise<boolean>} whether it was not ended
   */
  async load({ time, maxLayer = Infinity, bytes = Infinity }) {
    this._run.abort();
    const run = (this._run = new AbortController());
    try {
      this.index ??= parseIndex(await this._text(run.signal));
      const { segments } = this.index;
      const shown = segmentsAt(segments, time ?? -Infinity);
      const [now] = shown;
      const near = [...shown, now + 1].filter((k) => k < segments.length);
      this._have = new Set(near.filter((k) => this._have.has(k) && maxLayer <= this._level));
      this._level = maxLayer;
      const based = new Set();
      for (const k of near) {
        const { base } = segments[k];
        if (base !== null && !based.has(base)) bytes -= this.index.bases[base].bytes;
        based.add(base);
        if (bytes < segments[k].bytes && k > now) break;
        if (!this._have.has(k)) await this._bring(k, { maxLayer, bytes }, run.signal);
        bytes -= segments[k].bytes;
      }
    } catch (error) {
      if (!run.signal.aborted) throw error;
    }
    return run === this._run;
  }

  /** @param {number} k @param {import("../decode/fetch.js").Budget} budget @param {AbortSignal} signal */
  async _bring(k, budget, signal) {
    const { segments, bases } = /** @type {Index} */ (this.index);
    const { file, base: number, range } = segments[k];
    try {
      if (number !== null && this._base?.number !== number) {
        const own = new Keeping();
        const scene = await this._scene(bases[number].file, { maxLayer: 0 }, signal, () => own);
        this._told({ scene, part: -1 - number });
        this._base = { number, base: new Base(own.bytes()) };
      }
      const base = number === null ? null : this._base?.base;
      const scene = await this._scene(file, budget, signal, () => new Stream({ base }));
      const [start, end] = scene.info.timeRange;
      if (Math.abs(start - range[0]) > 1e-3 || Math.abs(end - range[1]) > 1e-3) {
        throw new Error(`${file}: shows ${start} to ${end} s, expected ${range[0]} to ${range[1]} s`);
      }
      this._told({ scene, part: k });
      this._have.add(k);
    } catch (error) {
      signal.throwIfAborted();
      const { message } = /** @type {Error} */ (error);
      this._told({ part: k, problem: message.includes(file) ? message : `${file}: ${message}` });
    }
  }

  /** The whole scene of a file, as far as the budget goes. @param {string} file
   * @param {import("../decode/fetch.js").Budget} budget @param {AbortSignal} signal @param {() => Stream} stream
   * @returns {Promise<Scene>} */
  async _scene(file, budget, signal, stream) {
    let before = 0;
    const progress = (/** @type {number} */ received) => {
      this.received += Math.max(received - before, 0);
      before = received;
      this._progress();
    };
    const url = new URL(file, this._url);
    const source = new SceneSource(url, { fetch: this._fetch, signal, progress, stream });
    /** @type {Scene | null} */
    let newest = null;
    for await (const scene of source.scenes(budget)) newest = scene;
    if (!newest) throw new Error(`${file}: its first slice is larger than what may be loaded`);
    return newest;
  }

  /** The bytes of the index, as text. @param {AbortSignal} signal */
  async _text(signal) {
    const response = await this._fetch(this._url, { signal });
    if (!response.ok) throw new Error(`${this._url}: the server answered ${response.status}`);
    const blob = await response.blob();
    this.received += blob.size;
    if (blob.size > MOST_BYTES) throw new Error(`${this._url}: has more than ${MOST_BYTES} bytes`);
    return blob.text();
  }
}
