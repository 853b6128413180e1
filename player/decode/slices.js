// Clauses 3.6, 8 and 12.2: state from slice to slice of a layer, and the order of their rows.

/** What later slices of a layer may refer to: the priors of each section, in their order.
 * @typedef {Record<"positions" | "masks" | "attributes", import("./channels.js").Prior[]>} Continuation */

/** Whether the highest bit of a is lower than that of b, both below 2^31. @param {number} a @param {number} b */
const isLower = (a, b) => a < b && a < (a ^ b);

/**
 * The rows in the order of the codes (10.1) of their voxels.
 *
 * @param {Int32Array} voxels [n, 3]
 * @returns {Uint32Array} [n]
 */
export function mortonOrder(voxels) {
  const n = voxels.length / 3;
  const least = [Infinity, Infinity, Infinity];
  for (let i = 0; i < voxels.length; i++) if (voxels[i] < least[i % 3]) least[i % 3] = voxels[i];
  const offsets = voxels.map((v, i) => v - least[i % 3]);
  return Uint32Array.from({ length: n }, (_, i) => i).sort((a, b) => {
    // Codes differ first in the highest bit in which a coordinate does; of equally high ones, z's is the highest.
    let axis = 2;
    let highest = offsets[3 * a + 2] ^ offsets[3 * b + 2];
    for (let k = 1; k >= 0; k--) {
      const difference = offsets[3 * a + k] ^ offsets[3 * b + k];
      if (isLower(highest, difference)) {
        axis = k;
        highest = difference;
      }
    }
    return offsets[3 * a + axis] - offsets[3 * b + axis];
  });
}
