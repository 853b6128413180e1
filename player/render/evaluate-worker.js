// The worker of the evaluator without a GPU.

import { texelsOf } from "./evaluate.js";
import { packed } from "./ext-splats.js";
import { serve } from "./remote.js";
import { SplatEvaluator } from "./splats.js";
/** @import { Scene } from "../kinds/index.js" */
/** @import { Packed } from "./ext-splats.js" */
/** @import { Texels } from "./level.js" */

/** The newest scene. @type {Scene} */
let scene;
/** What evaluates it, if it is one of splats. @type {SplatEvaluator} */
let splats;
/** The latest that were packed. @type {Texels | null} */
let kept = null;

/** @param {Scene | null} next */
function renew(next) {
  if (!next) return;
  scene = next;
  if (scene.kind === "splats") splats = new SplatEvaluator(scene);
}

serve({
  /** @param {Scene | null} next a new scene @param {number} level @param {number} t @param {number[]} eye
   * @param {Texels | null} spare an earlier result, to overwrite */
  evaluate(next, level, t, eye, spare) {
    renew(next);
    const result = texelsAt(level, t, eye, spare);
    const means = result.data.slice(0, 4 * result.count);
    return { result: { ...result, means }, transfer: [result.data.buffer, means.buffer] };
  },

  /** @param {Scene | null} next a new scene @param {number} level @param {number} t @param {number[]} eye
   * @param {Packed | null} spare an earlier result, to overwrite */
  pack(next, level, t, eye, spare) {
    renew(next);
    kept = texelsAt(level, t, eye, kept);
    const result = packed(kept, spare);
    return { result, transfer: result.extArrays.map(({ buffer }) => buffer) };
  },

  /** @param {Scene | null} next of splats @param {number} level @param {number} t */
  means(next, level, t) {
    renew(next);
    const result = splats.means(level, t);
    return { result, transfer: [result.buffer] };
  },

  /** @param {Scene | null} next of splats @param {number} level */
  parts(next, level) {
    renew(next);
    const result = splats.parts(level);
    const { rest, coefficients, windows } = result;
    return { result, transfer: [rest.buffer, coefficients.buffer, ...(windows ? [windows.buffer] : [])] };
  },
});

/** The Gaussians of the scene. @param {number} level @param {number} t @param {number[]} eye @param {Texels | null} spare */
function texelsAt(level, t, eye, spare) {
  return scene.kind === "splats" ? splats.evaluate(level, t, eye, spare) : texelsOf(scene, level, t, eye, spare);
}
