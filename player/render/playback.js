// A scene that plays as arrays of Gaussians, for renderers of other programs. They own the drawing context, so Gaussians
// are evaluated in a worker.

import { centreOf } from "./camera.js";
import { CpuEvaluator } from "./cpu.js";
import { levelOf, sameState, stateOf } from "./level.js";
import { Clip } from "./loader.js";
/** @import { Camera } from "../decode/tensors.js" */
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
 * RGB in display space. All are finite and can be seen. changed: of each array, whether it differs from that before.
 *
 * @typedef {{count: number, means: Float32Array, scales: Float32Array, quaternions: Float32Array,
 *   colors: Float32Array, changed: boolean[]}} Gaussians
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
 * Takes centres, [count, 3], out of means, and returns the box around them.
 *
 * @param {Float32Array} means @param {number} count @param {Float32Array} centres
 */
export function takeCentres(means, count, centres) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < count; i++) {
    for (let axis = 0; axis < 3; axis++) {
      const value = (centres[3 * i + axis] = means[4 * i + axis]);
      if (value < low[axis]) low[axis] = value;
      if (value > high[axis]) high[axis] = value;
    }
  }
  return { low, high };
}

/**
 * Loads a scene, keeps its time, and hands Gaussians to a renderer whenever they change.
 *
 * Events: those of `Clip`, of which `error` leaves what was valid; `upgrade` {level, anchors, gaussians} when a higher
 * level, or more anchors of it, is with the renderer.
 *
 * @template {{count: number}} [G=Gaussians]
 */
export class Playback extends Clip {
  /** @param {PlaybackOptions} options @param {(gaussians: G & {fill: number[]}) => void | Promise<void>} fill takes
   * Gaussians, and the colour behind them, RGB; the next ones come when it is done */
  constructor({ time, loop = true }, fill) {
    super({ time, loop });
    this._fill = fill;
    /** The highest level to show of what is loaded, null: all. @type {number | null} */
    this.level = null;
    this._resolve = () => {};
    this._reject = (/** @type {unknown} */ _reason) => {};
    this._evaluator = new CpuEvaluator();
    /** As in Texels, of the latest Gaussians. */
    this._still = 0;
    /** @type {State | null} */
    this._wanted = null;
    /** What the renderer has. @type {State | null} */
    this._shown = null;
    this._evaluating = false;
  }

  /**
   * Begins to load, once.
   *
   * @param {string | URL | Blob} source @param {PlaybackOptions} options
   * @returns {Promise<this>} as soon as the first layer, or slice of it, is there
   * @throws {Error} with `kind`, a name of clause 15 or FetchError, if it never is
   */
  load(source, { level, bytes, seconds }) {
    this._open(source);
    this._load({ maxLayer: level ?? Infinity, bytes, seconds }).then(() => this._segments || this.stopLoading());
    return new Promise((resolve, reject) => {
      this._resolve = () => resolve(this);
      this._reject = reject;
    });
  }

  /** The colour behind the Gaussians that the renderer has, or will have first, RGB. */
  get fill() {
    const { scene, level } = this._shown ?? { scene: this._sceneThere(), level: this.level ?? Infinity };
    return levelOf(scene, level).fill;
  }

  /** The layers that have arrived. */
  get levels() {
    return this._scene?.layers ?? [];
  }

  /**
   * Advances time if the scene plays, and brings the Gaussians of time, level and eye to the renderer as soon as they
   * are evaluated. A slow evaluation skips frames, not time.
   *
   * @param {number} elapsed seconds since the last call, of which the first after `play` has none @param {number[]} eye
   * the camera's centre, scene units
   */
  advance(elapsed, eye) {
    this._advance(elapsed);
    const scene = this._sceneThere();
    this._wanted = stateOf(scene, Math.max(this.level ?? Infinity, 0), this.time, eye);
    this._evaluate();
  }

  /** Whether the renderer has what the last `advance` asked for. */
  get settled() {
    return !!this._wanted && !!this._shown && sameState(this._shown, this._wanted);
  }

  /** Ends the workers. */
  close() {
    super.close();
    this._evaluator.close();
    this._reject(new Error("the scene is closed"));
    this._wanted = this._shown = null;
  }

  _sceneThere() {
    if (!this._scene) throw new Error("the scene is closed");
    return this._scene;
  }

  /** @param {import("./loader-worker.js").News} news */
  _told(news) {
    const first = super._told(news);
    if (first) this._resolve();
    return first;
  }

  /** @param {unknown} error */
  _fail(error) {
    if (this._scene) super._fail(error);
    else {
      this._reject(error);
      this.close();
    }
  }

  /** Evaluates until the renderer has the wanted state; intermediate ones are skipped. */
  async _evaluate() {
    if (this._evaluating) return;
    this._evaluating = true;
    try {
      while (this._wanted && !this.settled) {
        const state = this._wanted;
        const gaussians = await this._gaussians(state);
        if (this.closed) return;
        await this._fill({ ...gaussians, fill: levelOf(state.scene, state.level).fill });
        if (this.closed) return;
        this._tell(state, gaussians.count);
        this._shown = state;
      }
      this._evaluating = false;
    } catch (error) {
      if (!this.closed) this._fail(error); // and nothing is evaluated any more
    }
  }

  /** @param {State} state @returns {Promise<G>} */
  async _gaussians(state) {
    const { count, data, still, changing } = await this._evaluator.evaluate(state);
    const changed = [0, 1, 2, 3].map((block) => !still || still !== this._still || changing.includes(block));
    this._still = still;
    const at = data.length / 4;
    const [means, scales, quaternions, colors] = [0, 1, 2, 3].map((b) => data.subarray(b * at, b * at + 4 * count));
    return /** @type {any} */ ({ count, means, scales, quaternions, colors, changed });
  }

  /** @param {State} state which the renderer now has @param {number} gaussians */
  _tell({ scene, level }, gaussians) {
    const had = this._shown;
    const { rows: anchors } = levelOf(scene, level);
    if (had && level <= had.level && anchors <= levelOf(had.scene, had.level).rows) return;
    this._emit("upgrade", { level, anchors, gaussians });
  }
}
