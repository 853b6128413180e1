// What kinds demand of tensors.

import { malformed } from "../decode/errors.js";
/** @import { Chain, RowTensor } from "../decode/tensors.js" */

/** Components of what deformations may add to Gaussians: position, rotation (w x y z), scale, opacity and color. */
export const COMPONENTS = [3, 4, 3, 1, 3];

/** Malformed at the first of these descriptions that is not as expected. @param {string} where @param {string[]} found
 * @param {string[]} expected */
export function checkAlike(where, found, expected) {
  for (let i = 0; i < Math.max(found.length, expected.length); i++) {
    const [is, should] = [found[i] ?? "nothing", expected[i] ?? "nothing"];
    if (is !== should) throw malformed(`${where}: ${is}, expected ${should}`);
  }
}

/** @param {number} id @param {number} channels */
export const rowsOf = (id, channels) => `tensor ${id} of ${channels} channels`;

/** @param {RowTensor} tensor */
export const describedRows = ({ id, channels }) => rowsOf(id, channels);

/** @param {number} id @param {number} inputs @param {number} outputs */
export const chainOf = (id, inputs, outputs) => `chain ${id} of ${inputs} inputs and ${outputs} outputs`;

/** @param {Chain} chain */
export const described = ({ id, network }) => chainOf(id, network[0].inputs, network[network.length - 1].outputs);
