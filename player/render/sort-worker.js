// The worker that makes lists and orders.

import { serve } from "./remote.js";
import { DepthSort, listGaussians } from "./sort.js";

const sorter = new DepthSort();
/** @type {Float32Array} */
let means = new Float32Array(0);

serve({
  list: listGaussians,
  /** @param {ArrayLike<number>} row @param {number} near @param {Float32Array | null} next new means */
  sort(row, near, next) {
    means = next ?? means;
    const order = sorter.sort(means, row, near);
    return { result: order, transfer: [order.buffer] };
  },
});
