// The evaluator without a GPU, in a worker: for machines that cannot render to float textures, for networks that
// shaders do not take, and for other programs' renderers.

import { Remote } from "./remote.js";
import { WORKERS } from "./workers.js";
/** @import { Scene } from "../kinds/index.js" */
/** @import { State } from "./level.js" */

/**
 * Gaussians as texels, [4, height, width, 4], of which the first `count` are filled: columns 4·b to 4·b + 3 of a record
 * in block b.
 *
 * @typedef {{count: number, data: Float32Array, width: number, height: number}} Packed
 */

export class CpuEvaluator extends Remote {
  constructor() {
    super(WORKERS.evaluate);
    /** What the worker has. @type {Scene | null} */
    this._scene = null;
  }

  /** @param {State} state @returns {Promise<Packed>} */
  evaluate({ scene, level, t, eye }) {
    const next = scene === this._scene ? null : scene;
    this._scene = scene;
    return this.call("evaluate", [level, t, eye, next]);
  }
}
