// What Player and Playback share: the worker that fetches and decodes, and the scene's time.

import { Remote } from "./remote.js";
import { segmentsAt, weightAt } from "./timeline.js";
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
    this._forget();
  }

  /** Forgets the parts of a scene that is cut in time. */
  _forget() {
    /** @type {import("./timeline.js").Segment[] | null} */
    this._segments = null;
    /** What has arrived of the segment at hand and the next, by number, and of bases, by -1 - number.
     * @type {Map<number, Scene>} */
    this._parts = new Map();
    /** Why segments do not come. @type {Map<number, string>} */
    this._problems = new Map();
    /** The segments that show the time at hand, the later one first. @type {number[]} */
    this._needed = [];
    /** Where two segments overlap and both are there: the earlier one, and its share of the picture.
     * @type {{scene: Scene, share: number} | null} */
    this.fading = null;
    /** @type {import("../decode/fetch.js").Budget} */
    this._budget = {};
  }

  /** Why a segment at hand does not come, "" if it is there or on its way. */
  get problem() {
    return this._needed.map((k) => this._problems.get(k)).find(Boolean) ?? "";
  }

  /** The range of time, seconds, of a segment at hand while it is on its way. */
  get awaited() {
    const lacking = this._needed.find((k) => !this._parts.has(k) && !this._problems.has(k));
    return lacking === undefined ? null : /** @type {import("./timeline.js").Segment[]} */ (this._segments)[lacking].range;
  }

  /** Shows the part that belongs to the time at hand, or its base, and sees to what comes next. */
  _follow() {
    const segments = this._segments;
    if (!segments) return;
    const shown = segmentsAt(segments, this.time);
    const [now] = shown;
    if (shown.join() !== this._needed.join()) {
      const moved = this._needed.length && shown.some((k) => !this._needed.includes(k));
      this._needed = shown;
      const near = [...shown, now + 1];
      const kept = near.flatMap((k) => [k, -1 - (segments[k]?.base ?? NaN)]);
      for (const k of [...this._parts.keys()]) if (!kept.includes(k)) this._parts.delete(k);
      for (const k of [...this._problems.keys()]) if (moved || !shown.includes(k)) this._problems.delete(k);
      if (moved && this._loader) this._load(this._budget);
    }
    const [scene = this._parts.get(-1 - (segments[now].base ?? NaN)), earlier] = shown.flatMap((k) => this._parts.get(k) ?? []);
    const before = this.fading?.share;
    this.fading = scene && earlier ? { scene: earlier, share: 1 - weightAt(segments, now, this.time) } : null;
    if (!scene || (scene === this._scene && this.fading?.share === before)) return;
    this._scene = scene;
    this._changed();
  }

  /** The scene's global properties (clause 5.1), null before the first layer. */
  get info() {
    return this._scene?.info ?? null;
  }

  /** Seconds of the scene's time at its start and end. @returns {[number, number]} */
  get timeRange() {
    if (this._segments) return [this._segments[0].range[0], this._segments[this._segments.length - 1].range[1]];
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
    this._go(seconds);
    this._changed();
  }

  /** @param {number} seconds as `seek` */
  _go(seconds) {
    const [start, end] = this.timeRange;
    this._time = this._scene ? Math.min(Math.max(seconds, start), Math.max(start, end)) : seconds;
    this._follow();
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
    this._forget();
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
      this._follow();
      this._emit("timeupdate", { time: this._time });
    }
    this._resumed = false;
  }

  /** Begins with another file. @param {string | URL | Blob} source */
  _open(source) {
    this.stopLoading();
    this._forget();
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
    this._budget = budget;
    try {
      const { superseded, ...result } = await loader.call("load", [{ ...budget, time: this._time }]);
      if (loader !== this._loader || superseded) return;
      if (result.complete) this.stopLoading();
      this._emit("loaded", result);
    } catch (error) {
      if (loader !== this._loader) return;
      this.stopLoading();
      this._fail(error);
    }
  }

  /** Takes what has arrived of the scene. @param {News} news @returns {boolean} whether it is the first */
  _told({ scene, segments, part, problem }) {
    const first = !this._scene && !!scene;
    if (segments) this._segments = segments;
    if (part !== undefined) {
      if (scene) this._parts.set(part, scene);
      if (problem) {
        this._problems.set(part, problem);
        this._emit("error", { message: problem, kind: "SegmentError", segment: part });
      }
      this._follow();
    } else if (scene) this._scene = scene;
    if (first) this._go(this.time); // into the scene's range
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
