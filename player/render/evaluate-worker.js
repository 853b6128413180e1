// The worker of the evaluator without a GPU.

import { evaluate } from "./evaluate.js";
import { texelsFor } from "./level.js";
import { serve } from "./remote.js";
import { SplatEvaluator } from "./splats.js";
/** @import { Scene } from "../kinds/index.js" */
/** @import { Texels } from "./level.js" */

/** What evaluates the newest scene.
 * @type {(level: number, t: number, eye: number[], spare: Float32Array | null) => Texels} */
let texelsAt;

serve({
  /** @param {number} level @param {number} t @param {number[]} eye @param {Scene | null} next a new scene
   * @param {Float32Array | null} spare data of an earlier result, to overwrite */
  evaluate(level, t, eye, next, spare) {
    if (next) texelsAt = evaluatorOf(next);
    const result = texelsAt(level, t, eye, spare);
    const means = result.data.slice(0, 4 * result.count);
    return { result: { ...result, means }, transfer: [result.data.buffer, means.buffer] };
  },
});

/** @param {Scene} scene @returns {typeof texelsAt} */
function evaluatorOf(scene) {
  if (scene.kind === "splats") {
    const evaluator = new SplatEvaluator(scene);
    return (...state) => evaluator.evaluate(...state);
  }
  return (level, t, eye, spare) => {
    const { count, records } = evaluate(scene, level, t, eye);
    const texels = texelsFor(count, spare);
    const block = texels.data.length / 4;
    for (let i = 0; i < count; i++) {
      for (let k = 0; k < 16; k++) texels.data[(k >> 2) * block + 4 * i + (k & 3)] = records[16 * i + k];
    }
    return { ...texels, count };
  };
}
