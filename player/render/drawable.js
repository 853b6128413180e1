// What a scene takes to be drawn: its Gaussians of a state on the GPU, and their order for a camera.

import { drawing } from "../kinds/drawing.js";
import { CpuEvaluator } from "./cpu.js";
import { SPLAT_BLOCKS } from "./evaluator.js";
import { sameState } from "./level.js";
import { Remote } from "./remote.js";
import { WORKERS } from "./workers.js";
/** @import { Scene } from "../kinds/index.js" */
/** @import { Evaluated, Splats } from "./evaluator.js" */
/** @import { Gpu } from "./gl.js" */
/** @import { State } from "./level.js" */
/** @import { Order, Painter } from "./painter.js" */

export class Drawable {
  /** @param {"gpu" | "cpu" | null} [evaluator] default: the faster one of the machine */
  constructor(evaluator) {
    this._asked = evaluator;
    this._sorter = new Remote(WORKERS.sort);
    /** @type {import("../kinds/drawing.js").OnGpu | null} */
    this._evaluator = null;
    /** @type {CpuEvaluator | null} */
    this._cpu = null;
    /** Whether shaders do not take the file's networks. */
    this._unfit = false;
    /** The Gaussians to draw, and their state. @type {{splats: Splats, state: State} | null} */
    this.front = null;
    /** @type {Splats | null} */
    this._spare = null;
    /** @type {Order | null} */
    this.order = null;
    /** Row of the view matrix that the order is for. @type {ArrayLike<number> | null} */
    this._sortedRow = null;
    this.evaluating = false;
    this.sorting = false;
    /** What began with another number has no result, and its fault is none. */
    this._epoch = 0;
    /** What holds all this. @type {Gpu | null} */
    this._gpu = null;
  }

  /** The scene whose Gaussians are there. */
  get scene() {
    return this.front?.state.scene ?? null;
  }

  /** Starts what a scene needs without a GPU. */
  prepare() {
    this._cpu ??= new CpuEvaluator();
  }

  /** @param {State} state */
  isEvaluated(state) {
    return !!this.front && sameState(this.front.state, state);
  }

  /** @param {ArrayLike<number>} row */
  isSorted(row) {
    return !!this._sortedRow && Array.prototype.every.call(row, (value, k) => value === this._sortedRow?.[k]);
  }

  /**
   * Brings the Gaussians to a state. Throws what is wrong with the scene.
   *
   * @param {Gpu} gpu @param {Painter} painter @param {State} state
   * @param {() => ArrayLike<number>} row of the camera's view matrix then
   * @returns {Promise<boolean>} whether it did
   */
  async evaluate(gpu, painter, state, row) {
    const epoch = this._epoch;
    const stale = () => epoch !== this._epoch || gpu.gl.isContextLost();
    const { _spare: spare } = this;
    this._spare = null;
    this._gpu = gpu;
    this.evaluating = true;
    try {
      const { splats, means } = await this._gaussians(gpu, state, spare);
      if (gpu === this._gpu) this._spare = splats;
      if (stale()) return false;
      if (means || !this.isSorted(row())) await this._order(painter, state.scene, row(), means);
      if (stale()) return false;
      this._spare = this.front?.splats ?? null;
      this.front = { splats, state };
      return true;
    } catch (error) {
      if (stale()) return false;
      if (this._onCpu(gpu, state.scene)) throw error;
      this._unfit = true; // networks that shaders cannot hold, or a driver that cannot compile them
      this._freeEvaluator();
      return false;
    } finally {
      this.evaluating = false;
      if (epoch !== this._epoch && gpu === this._gpu) this._free();
    }
  }

  /** Brings the order to a camera. @param {Painter} painter @param {ArrayLike<number>} row of its view matrix */
  async sort(painter, row) {
    if (!this.front) return;
    this.sorting = true;
    try {
      await this._order(painter, this.front.state.scene, row, null);
    } finally {
      this.sorting = false;
    }
  }

  /**
   * Sorts Gaussians for the camera: others than before, or the sorter's. It answers calls in their order, so that an
   * order on its way is for the Gaussians that are on show when it arrives.
   *
   * @param {Painter} painter @param {Scene} scene @param {ArrayLike<number>} row @param {Float32Array | null} means
   */
  async _order(painter, { info }, row, means) {
    const { _gpu: gpu, _epoch: epoch } = this;
    const order = await this._sorter.call("sort", [row, info.near, means], means ? [means.buffer] : []);
    if (gpu !== this._gpu || epoch !== this._epoch) return;
    this.order = painter.ordered(this.order, order);
    this._sortedRow = row;
  }

  /** @param {Gpu} gpu @param {Scene} scene */
  _onCpu(gpu, scene) {
    const kind = drawing(scene);
    if (this._asked === "cpu" || this._unfit || !gpu.floats || !kind.gpu) return true;
    return this._asked !== "gpu" && gpu.software && scene.anchor.length <= 3 * kind.few;
  }

  /** @param {Gpu} gpu @param {State} state @param {Splats | null} into what may be overwritten
   * @returns {Promise<Evaluated>} */
  async _gaussians(gpu, state, into) {
    const { scene, level, t, eye } = state;
    const { gpu: evaluatorOn } = drawing(scene);
    const onCpu = !evaluatorOn || this._onCpu(gpu, scene);
    if (onCpu || this._evaluator?.scene !== scene) this._freeEvaluator();
    if (onCpu) {
      const cpu = (this._cpu ??= new CpuEvaluator());
      const { count, data, means, width, height, still, changing } = await cpu.evaluate(state);
      const field = gpu.renewed(into?.field, width, height, SPLAT_BLOCKS);
      const blocks = into?.field === field && still && into.still === still ? changing : [0, 1, 2, 3];
      for (const block of blocks) gpu.write(field, data, Math.ceil(count / width), block, 1);
      return { splats: { field, still }, means };
    }
    this._evaluator ??= evaluatorOn(gpu, scene, (this._cpu ??= new CpuEvaluator()));
    return this._evaluator.evaluate(level, t, eye, into, (opacities, ...rest) =>
      this._sorter.call("list", [opacities, ...rest], [opacities.buffer]),
    );
  }

  _freeEvaluator() {
    this._evaluator?.free();
    this._evaluator = null;
  }

  _free() {
    this._freeEvaluator();
    this._gpu?.free(this.front?.splats.field, this._spare?.field);
    this.front = this._spare = null;
  }

  /** Forgets its scene. */
  clear() {
    this._epoch++;
    this._unfit = false;
    this._sortedRow = null;
    if (!this.evaluating) return this._free();
    this._gpu?.free(this.front?.splats.field); // what is being made is freed at its end
    this.front = null;
  }

  /** Forgets a GPU whose context is lost, and with it all that it held. */
  drop() {
    this._epoch++;
    this._gpu = this._evaluator = this.front = this._spare = this.order = this._sortedRow = null;
  }

  /** Ends its workers. */
  close() {
    this._epoch++;
    this._sorter.close();
    this._cpu?.close();
  }
}
