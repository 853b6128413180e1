// The worker of the evaluator without a GPU.

import { drawing } from "../kinds/drawing.js";
import { packed } from "./ext-splats.js";
import { serve } from "./remote.js";
/** @import { Scene } from "../kinds/index.js" */
/** @import { SplatEvaluator } from "./splats.js" */
/** @import { Packed } from "./ext-splats.js" */
/** @import { Texels } from "./level.js" */

/** What evaluates the newest scene; only that of splats has means and parts. @type {SplatEvaluator} */
let evaluator;
/** The latest that were packed. @type {Texels | null} */
let kept = null;

/** @param {Scene | null} next */
function renew(next) {
  if (next) evaluator = /** @type {SplatEvaluator} */ (drawing(next).cpu(next));
}

serve({
  /** @param {Scene | null} next a new scene @param {number} level @param {number} t @param {number[]} eye
   * @param {Texels | null} spare an earlier result, to overwrite */
  evaluate(next, level, t, eye, spare) {
    renew(next);
    const result = evaluator.evaluate(level, t, eye, spare);
    const means = result.data.slice(0, 4 * result.count);
    return { result: { ...result, means }, transfer: [result.data.buffer, means.buffer] };
  },

  /** @param {Scene | null} next a new scene @param {number} level @param {number} t @param {number[]} eye
   * @param {Packed | null} spare an earlier result, to overwrite */
  pack(next, level, t, eye, spare) {
    renew(next);
    kept = evaluator.evaluate(level, t, eye, kept);
    const result = packed(kept, spare);
    return { result, transfer: result.extArrays.map(({ buffer }) => buffer) };
  },

  /** @param {Scene | null} next of splats @param {number} level @param {number} t */
  means(next, level, t) {
    renew(next);
    const result = evaluator.means(level, t);
    return { result, transfer: [result.buffer] };
  },

  /** @param {Scene | null} next of splats @param {number} level */
  parts(next, level) {
    renew(next);
    const result = evaluator.parts(level);
    const { rest, coefficients, windows } = result;
    return { result, transfer: [rest.buffer, coefficients.buffer, ...(windows ? [windows.buffer] : [])] };
  },
});
