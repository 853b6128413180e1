// The evaluator without a GPU, in a worker: for machines that cannot render to float textures, for networks that
// shaders do not take, and for other programs' renderers. Of splats it evaluates what sorting needs in any case.

import { Remote } from "./remote.js";
import { WORKERS } from "./workers.js";
/** @import { Scene, SplatScene } from "../kinds/index.js" */
/** @import { Packed } from "./ext-splats.js" */
/** @import { State, Texels } from "./level.js" */
/** @import { Parts } from "./splats.js" */

export class CpuEvaluator extends Remote {
  constructor() {
    super(WORKERS.evaluate);
    /** What the worker has. @type {Scene | null} */
    this._scene = null;
    /** The latest result. @type {Texels | null} */
    this._spare = null;
    /** The packed one before the latest, and the latest. @type {(Packed | null)[]} */
    this._packed = [null, null];
  }

  /**
   * The Gaussians of a state. The next call takes `data` back, so that memory stays as it is.
   *
   * @param {State} state @returns {Promise<Texels & {means: Float32Array}>} means: [count, 4], mean and opacity
   */
  async evaluate({ scene, level, t, eye }) {
    const { _spare: spare } = this;
    this._spare = null;
    const args = [level, t, eye, spare];
    const { means, ...texels } = await this._of("evaluate", scene, args, spare ? [spare.data.buffer] : []);
    this._spare = texels;
    return { ...texels, means };
  }

  /** The Gaussians of a state as Spark holds them. The next call takes back those before these. @param {State} state
   * @returns {Promise<Packed>} */
  async pack({ scene, level, t, eye }) {
    const [spare, latest] = this._packed;
    const transfer = spare?.extArrays.map(({ buffer }) => buffer);
    const found = await this._of("pack", scene, [level, t, eye, spare], transfer);
    this._packed = [latest, found];
    return found;
  }

  /** See SplatEvaluator. @param {SplatScene} scene @param {number} level @param {number} t
   * @returns {Promise<Float32Array>} */
  means(scene, level, t) {
    return this._of("means", scene, [level, t]);
  }

  /** See SplatEvaluator. @param {SplatScene} scene @param {number} level @returns {Promise<Parts>} */
  parts(scene, level) {
    return this._of("parts", scene, [level]);
  }

  /** Calls a function of the worker, which gets the scene if it does not have it. @param {string} name
   * @param {Scene} scene @param {unknown[]} args @param {Transferable[]} [transfer] */
  _of(name, scene, args, transfer) {
    const next = scene === this._scene ? null : scene;
    this._scene = scene;
    return this.call(name, [next, ...args], transfer);
  }
}
