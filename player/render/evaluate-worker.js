// The worker of the evaluator without a GPU.

import { evaluate } from "./evaluate.js";
import { serve } from "./remote.js";

/** @type {import("../kinds/index.js").Scene} */
let scene;

serve({
  /** @param {number} level @param {number} t @param {number[]} eye @param {typeof scene | null} next a new scene */
  evaluate(level, t, eye, next) {
    scene = next ?? scene;
    const result = texels(evaluate(scene, level, t, eye));
    return { result, transfer: [result.data.buffer] };
  },
});

/** @param {import("./evaluate.js").Gaussians} gaussians @returns {import("./cpu.js").Packed} */
function texels({ count, records }) {
  const width = 2 ** Math.max(4, Math.ceil(Math.log2(Math.sqrt(count + 1))));
  const height = Math.max(1, Math.ceil(count / width));
  const block = 4 * width * height;
  const data = new Float32Array(4 * block);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 16; k++) data[(k >> 2) * block + 4 * i + (k & 3)] = records[16 * i + k];
  }
  return { count, data, width, height };
}
