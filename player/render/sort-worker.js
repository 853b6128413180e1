// The worker that makes lists and orders.

import { serve } from "./remote.js";
import { DepthSort, listGaussians } from "./sort.js";

const sorter = new DepthSort();
/** @type {Float32Array} */
let means = new Float32Array(0);

serve({
  /** @param {Parameters<typeof listGaussians>} args */
  list(...args) {
    return listGaussians(...args);
  },
  /** @param {Float32Array} next [n, 4], mean and opacity */
  setMeans(next) {
    means = next;
  },
  /** @param {ArrayLike<number>} row @param {number} near */
  sort(row, near) {
    const order = sorter.sort(means, row, near);
    return { result: order, transfer: [order.buffer] };
  },
});
