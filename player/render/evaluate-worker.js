// The worker of the evaluator in JavaScript.

import { evaluate } from "./evaluate.js";
import { serve } from "./serve.js";

/** @type {import("../decode/scene.js").Scene} */
let scene;

serve({
  /** @param {import("../decode/scene.js").Scene} next */
  setScene(next) {
    scene = next;
  },
  /** @param {number} level @param {number} t @param {number[]} eye */
  evaluate(level, t, eye) {
    const result = packed(evaluate(scene, level, t, eye));
    return { result, transfer: [result.data.buffer] };
  },
});

/** @param {import("./evaluate.js").Gaussians} gaussians @returns {import("./cpu.js").Packed} */
function packed({ count, mean, opacity, scale, quaternion, color }) {
  const width = 2 ** Math.max(4, Math.ceil(Math.log2(Math.sqrt(count + 1))));
  const height = Math.max(1, Math.ceil(count / width));
  const texels = width * height;
  const data = new Float32Array(16 * texels);
  for (let i = 0; i < texels; i++) {
    const at = 4 * i;
    data[at + 3] = i < count ? opacity[i] : -1;
    if (i >= count) continue;
    for (let k = 0; k < 3; k++) {
      data[at + k] = mean[3 * i + k];
      data[4 * texels + at + k] = scale[3 * i + k];
      data[12 * texels + at + k] = color[3 * i + k];
    }
    for (let k = 0; k < 4; k++) data[8 * texels + at + k] = quaternion[4 * i + k];
  }
  return { data, width, height };
}
