// The evaluator without a GPU, in a worker: for machines that cannot render to float textures, and for networks that
// shaders do not take.

import { SPLAT_BLOCKS } from "./evaluator.js";
import { Remote } from "./remote.js";
/** @import { Gpu } from "./gl.js" */

/** Gaussians in the layout of `Splats`. @typedef {{data: Float32Array, width: number, height: number}} Packed */

/** The worker, which may be started before there is a scene. */
export const startWorker = () => new Remote(new URL("./evaluate-worker.js", import.meta.url));

export class CpuEvaluator {
  /** @param {Gpu} gpu @param {import("../decode/scene.js").Scene} scene @param {Remote} [worker] which it then owns */
  constructor(gpu, scene, worker = startWorker()) {
    this._gpu = gpu;
    this._remote = worker;
    this.setScene(scene);
  }

  /** @param {import("../decode/scene.js").Scene} scene that is evaluated from now on */
  setScene(scene) {
    this.scene = scene;
    this._ready = this._remote.call("setScene", [scene]);
    this._ready.catch(() => {}); // a worker that fails says so to the next call as well
  }

  /**
   * As GpuEvaluator's.
   *
   * @param {number} level @param {number} t @param {number[]} eye
   * @param {import("./evaluator.js").Splats | null} into
   * @returns {Promise<import("./evaluator.js").Evaluated>}
   */
  async evaluate(level, t, eye, into) {
    await this._ready;
    const { data, width, height } = /** @type {Packed} */ (await this._remote.call("evaluate", [level, t, eye]));
    let field = into?.field;
    if (!field || field.width !== width || field.height !== height) {
      this._gpu.free(field);
      field = this._gpu.field(width, height, SPLAT_BLOCKS);
    }
    this._gpu.write(field, data);
    const texels = width * height;
    return { splats: { field, texels }, means: data.slice(0, 4 * texels) };
  }

  free() {
    this._remote.close();
  }
}
