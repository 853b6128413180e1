// A scene that plays as arrays of Gaussians, for renderers of other programs. They own the drawing context, so Gaussians
// are evaluated in a worker.

import { centreOf } from "./camera.js";
import { startWorker } from "./cpu.js";
import { levelOf, sameState, stateOf, timeAfter } from "./level.js";
import { Emitter, startLoader } from "./loader.js";
/** @import { Camera, Scene } from "../decode/scene.js" */
/** @import { State } from "./level.js" */

/**
 * @typedef {object} PlaybackOptions
 * @property {number} [level] the highest to load, default all
 * @property {number} [time] seconds of the scene's time to start at
 * @property {number} [bytes] how much of the file to load at most
 * @property {number} [seconds] how long to load beyond the first layer
 * @property {boolean} [loop] whether playing begins anew at the end, default true
 */

/**
 * The Gaussians of a state, each array [count, 4]: mean and opacity; scales, scene units; quaternions w x y z; colours,
 * RGB in display space. All are finite and can be seen.
 *
 * @typedef {{count: number, means: Float32Array, scales: Float32Array, quaternions: Float32Array,
 *   colors: Float32Array}} Gaussians
 */

/**
 * A camera's pose as renderers of y-up worlds take it: camera to scene, column-major, axes right, up and backwards.
 *
 * @param {Camera} view @returns {number[]}
 */
export function poseOf(view) {
  const { viewmat: v } = view;
  return [v[0], v[1], v[2], 0, -v[4], -v[5], -v[6], 0, -v[8], -v[9], -v[10], 0, ...centreOf(view), 1];
}

/**
 * Loads a scene, keeps its time, and hands Gaussians to a renderer whenever they change.
 *
 * Events: `upgrade` {level, anchors, gaussians} when a higher level, or more anchors of it, is with the renderer;
 * `loaded` {bytes, complete}; `error` {message, kind}, after which what was valid stays.
 */
export class Playback extends Emitter {
  /** @param {PlaybackOptions} options @param {(gaussians: Gaussians) => void | Promise<void>} fill takes Gaussians;
   * the next ones come when it is done */
  constructor({ time, loop = true }, fill) {
    super();
    this._fill = fill;
    /** The highest level to show of what is loaded, null: all. @type {number | null} */
    this.level = null;
    /** Whether playing begins anew at the end. */
    this.loop = loop;
    /** @type {Scene | null} */
    this._scene = null;
    this._time = time;
    this._playing = false;
    /** Whether `play` was called since the last `advance`. */
    this._resumed = false;
    this._resolve = () => {};
    this._loader = startLoader((news) => this._told(news));
    this._evaluator = startWorker();
    /** What the evaluator has. @type {Scene | null} */
    this._evaluatorScene = null;
    /** @type {State | null} */
    this._wanted = null;
    /** What the renderer has. @type {State | null} */
    this._shown = null;
    this._evaluating = false;
    this._closed = false;
  }

  /**
   * Begins to load, once.
   *
   * @param {string | URL | Blob} source @param {PlaybackOptions} options
   * @returns {Promise<this>} as soon as the first layer, or slice of it, is there
   * @throws {Error} with `kind`, a name of clause 15 or FetchError, if it never is
   */
  load(source, options) {
    return new Promise((resolve, reject) => {
      this._resolve = () => resolve(this);
      this._load(source, options).catch((error) => {
        if (this._scene) this._fail(error);
        else {
          this.close();
          reject(error);
        }
      });
    });
  }

  /** @param {string | URL | Blob} source @param {PlaybackOptions} options */
  async _load(source, { level, bytes, seconds }) {
    const from = source instanceof Blob ? source : new URL(source, document.baseURI).href;
    await this._loader.call("open", [from]);
    const result = await this._loader.call("load", [{ maxLayer: level ?? Infinity, bytes, seconds }]);
    this._loader.close();
    this._emit("loaded", result);
  }

  /** @param {import("./loader-worker.js").News} news */
  _told({ scene }) {
    if (!scene) return;
    this._scene = scene;
    this.time = this.time; // into the scene's range
    this._resolve();
  }

  /** Whether there is something to show. */
  get begun() {
    return !!this._scene;
  }

  /** The scene's global properties (clause 5.1). */
  get info() {
    return this._sceneThere().info;
  }

  /** The layers that have arrived. */
  get levels() {
    return this._sceneThere().layers;
  }

  /** Seconds of the scene's time. */
  get time() {
    return this._time ?? this.info.timeRange[0];
  }

  set time(seconds) {
    const [start, end] = this.info.timeRange;
    this._time = Math.min(Math.max(seconds, start), Math.max(start, end));
  }

  get paused() {
    return !this._playing;
  }

  play() {
    if (this.time >= this.info.timeRange[1]) this.time = this.info.timeRange[0];
    this._playing = this._resumed = true;
  }

  pause() {
    this._playing = false;
  }

  /**
   * Advances time if the scene plays, and brings the Gaussians of time, level and eye to the renderer as soon as they
   * are evaluated. A slow evaluation skips frames, not time.
   *
   * @param {number} elapsed seconds since the last call, of which the first after `play` has none @param {number[]} eye the camera's centre, scene units
   */
  advance(elapsed, eye) {
    const scene = this._sceneThere();
    if (this._playing) {
      const { time, ended } = timeAfter(this.time, this._resumed ? 0 : elapsed, scene.info.timeRange, this.loop);
      this._time = time;
      this._playing = !ended;
    }
    this._resumed = false;
    this._wanted = stateOf(scene, Math.max(this.level ?? Infinity, 0), this.time, eye);
    this._evaluate();
  }

  /** Whether the renderer has what the last `advance` asked for. */
  get settled() {
    return !!this._wanted && !!this._shown && sameState(this._shown, this._wanted);
  }

  /** Ends the workers. */
  close() {
    this._closed = true;
    this._loader.close();
    this._evaluator.close();
    this._scene = this._evaluatorScene = this._wanted = this._shown = null;
  }

  _sceneThere() {
    if (!this._scene) throw new Error("the scene is closed");
    return this._scene;
  }

  /** Evaluates until the renderer has the wanted state; intermediate ones are skipped. */
  async _evaluate() {
    if (this._evaluating) return;
    this._evaluating = true;
    try {
      while (this._wanted && !this.settled) {
        const state = this._wanted;
        if (state.scene !== this._evaluatorScene) await this._evaluator.call("setScene", [state.scene]);
        this._evaluatorScene = state.scene;
        const gaussians = gaussiansOf(await this._evaluator.call("evaluate", [state.level, state.t, state.eye]));
        if (this._closed) return;
        await this._fill(gaussians);
        if (this._closed) return;
        this._tell(state, gaussians.count);
        this._shown = state;
      }
      this._evaluating = false;
    } catch (error) {
      if (!this._closed) this._fail(error); // and nothing is evaluated any more
    }
  }

  /** @param {State} state which the renderer now has @param {number} gaussians */
  _tell({ scene, level }, gaussians) {
    const had = this._shown;
    const { rows: anchors } = levelOf(scene, level);
    if (had && level <= had.level && anchors <= levelOf(had.scene, had.level).rows) return;
    this._emit("upgrade", { level, anchors, gaussians });
  }
}

/** Leaves out, in place, what cannot be seen. @param {import("./cpu.js").Packed} packed @returns {Gaussians} */
function gaussiansOf({ data, width, height }) {
  const block = 4 * width * height;
  let end = 0;
  for (let at = 0; at < block; at += 4) {
    let sum = 0;
    for (let k = 0; k < 16; k++) sum += data[(k >> 2) * block + at + (k & 3)];
    if (!(data[at + 3] > 0 && Number.isFinite(sum))) continue;
    for (let k = 0; k < 16; k++) data[(k >> 2) * block + end + (k & 3)] = data[(k >> 2) * block + at + (k & 3)];
    end += 4;
  }
  const [means, scales, quaternions, colors] = [0, 1, 2, 3].map((b) => data.subarray(b * block, b * block + end));
  return { count: end / 4, means, scales, quaternions, colors };
}
