// The evaluator without a GPU, in a worker: for machines that cannot render to float textures, for networks that
// shaders do not take, for scenes of splats, and for other programs' renderers.

import { Remote } from "./remote.js";
import { WORKERS } from "./workers.js";
/** @import { Scene } from "../kinds/index.js" */
/** @import { State, Texels } from "./level.js" */

export class CpuEvaluator extends Remote {
  constructor() {
    super(WORKERS.evaluate);
    /** What the worker has. @type {Scene | null} */
    this._scene = null;
    /** The data of the latest result. @type {Float32Array | null} */
    this._data = null;
  }

  /**
   * The Gaussians of a state. The next call takes `data` back, so that memory stays as it is.
   *
   * @param {State} state @returns {Promise<Texels & {means: Float32Array}>} means: [count, 4], mean and opacity
   */
  async evaluate({ scene, level, t, eye }) {
    const next = scene === this._scene ? null : scene;
    const { _data: spare } = this;
    this._scene = scene;
    this._data = null;
    const texels = await this.call("evaluate", [level, t, eye, next, spare], spare ? [spare.buffer] : []);
    this._data = texels.data;
    return texels;
  }
}
