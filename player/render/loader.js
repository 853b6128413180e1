// What Player and Playback share: the worker that fetches and decodes, and the scene's time.

import { Remote } from "./remote.js";
import { WORKERS } from "./workers.js";
/** @import { Scene } from "../kinds/index.js" */
/** @import { News } from "./loader-worker.js" */

/**
 * What early.js began: a worker that requests `url`, null if it could not. begin: gives it the address of the loader's
 * code; only the first call counts.
 *
 * @typedef {{url: string, worker: Worker | null, begin: (code: string) => void}} Early
 */

/** @param {(news: News) => void} told @param {string | Blob} [from] what it will be asked to open */
export function startLoader(told, from) {
  const code = WORKERS.loader;
  const { early } = /** @type {{early?: Early}} */ (globalThis);
  const worker = early?.worker;
  if (!worker || early.url !== from) return new Remote(code, told);
  early.worker = null; // its response serves once
  early.begin(code.href);
  return new Remote(worker, told);
}

/**
 * A scene that loads and plays. Events: `loaded` {bytes, complete}, `timeupdate` {time}, `statechange` (play or pause),
 * `error` {message, kind}.
 */
export class Clip extends EventTarget {
  /** @param {{time?: number | null, loop?: boolean, speed?: number | null}} options */
  constructor({ time, loop, speed }) {
    super();
    /** Seconds of the scene's time per second. */
    this.speed = speed ?? 1;
    /** Whether playing begins anew at the end. */
    this.loop = !!loop;
    /** As far as it has arrived. @type {Scene | null} */
    this._scene = null;
    /** Seconds of the scene's time, null: its start. @type {number | null} */
    this._time = time ?? null;
    this._playing = false;
    /** Whether `play` was called since the last `_advance`. */
    this._resumed = false;
    /** @type {Remote | null} */
    this._loader = null;
    this.closed = false;
  }

  /** The scene's global properties (clause 5.1), null before the first layer. */
  get info() {
    return this._scene?.info ?? null;
  }

  /** Seconds of the scene's time at its start and end. @returns {[number, number]} */
  get timeRange() {
    return this._scene?.info.timeRange ?? [0, 0];
  }

  /** Seconds of the scene's time. */
  get time() {
    return this._time ?? this.timeRange[0];
  }

  set time(seconds) {
    this.seek(seconds);
  }

  /** Goes to a time; what is no number changes nothing. @param {number} seconds of the scene's time */
  seek(seconds) {
    if (isNaN(seconds)) return;
    const [start, end] = this.timeRange;
    this._time = this._scene ? Math.min(Math.max(seconds, start), Math.max(start, end)) : seconds;
    this._changed();
    this._emit("timeupdate", { time: this.time });
  }

  get paused() {
    return !this._playing;
  }

  play() {
    if (this._playing) return;
    this._playing = this._resumed = true;
    if (this._scene && this.time >= this.timeRange[1]) this._time = this.timeRange[0];
    this._changed();
    this._emit("statechange", {});
  }

  pause() {
    if (!this._playing) return;
    this._playing = false;
    this._changed();
    this._emit("statechange", {});
  }

  /** Stops loading; layers that have arrived stay. */
  stopLoading() {
    this._loader?.close();
    this._loader = null;
  }

  /** Ends its worker and forgets the scene. */
  close() {
    this.closed = true;
    this._playing = false;
    this.stopLoading();
    this._scene = null;
  }

  /** Time, or whether it advances, is another. */
  _changed() {}

  /** Advances time if the scene plays. @param {number} elapsed seconds, of which the first after `play` has none */
  _advance(elapsed) {
    if (this._playing) {
      const [start, end] = this.timeRange;
      const next = this.time + (this._resumed ? 0 : elapsed) * this.speed;
      const again = this.loop && end > start;
      this._time = next < end ? next : again ? start + ((next - start) % (end - start)) : end;
      if (next >= end && !again) this.pause();
      this._emit("timeupdate", { time: this._time });
    }
    this._resumed = false;
  }

  /** Begins with another file. @param {string | URL | Blob} source */
  _open(source) {
    this.stopLoading();
    const from = source instanceof Blob ? source : new URL(source, document.baseURI).href;
    const loader = startLoader((news) => {
      if (loader === this._loader) this._told(news);
    }, from);
    this._loader = loader;
    loader.call("open", [from]).catch(() => {}); // a worker that fails says so to the next call as well
  }

  /** Loads as much as a budget allows. @param {import("../decode/fetch.js").Budget} budget */
  async _load(budget) {
    const loader = /** @type {Remote} */ (this._loader);
    try {
      const result = await loader.call("load", [budget]);
      if (loader !== this._loader) return;
      if (result.complete) this.stopLoading();
      this._emit("loaded", result);
    } catch (error) {
      if (loader !== this._loader) return;
      this.stopLoading();
      this._fail(error);
    }
  }

  /** Takes what has arrived of the scene. @param {News} news @returns {boolean} whether it is the first */
  _told({ scene }) {
    const first = !this._scene && !!scene;
    if (scene) this._scene = scene;
    if (first) this.seek(this.time); // into the scene's range
    return first;
  }

  /** @param {string} name @param {object} detail */
  _emit(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  /** Emits `error`. @param {unknown} error */
  _fail(error) {
    const { message, name, kind = name } = /** @type {Error & {kind?: string}} */ (error);
    this._emit("error", { message, kind });
  }
}
