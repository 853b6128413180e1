// Clauses 10.1, 12.1 and 12.2: the order of voxels, and a hash table of those that hold an anchor.

/** Random, so that no file can be made whose voxels all collide. */
const SEEDS = Int32Array.from({ length: 3 }, () => (Math.random() * 2 ** 32) | 1);

/** A set of voxels. */
export class VoxelTable {
  constructor() {
    /** [n, 3], with unused room at the end. */
    this._voxels = new Int32Array(0);
    this._count = 0;
    /** Index of the voxel of each slot, -1 where it is empty. */
    this._slots = new Int32Array(0);
    /** Those that are not in the table yet: nothing is looked up before a second slice. @type {Int32Array[]} */
    this._loose = [];
  }

  /** Adds voxels, none of which is there. @param {Int32Array} voxels [n, 3] */
  add(voxels) {
    this._loose.push(voxels);
  }

  /** The first of these voxels that is there, null if none is. @param {Int32Array} voxels [n, 3] */
  common(voxels) {
    if (voxels.length) for (const part of this._loose.splice(0)) this._enter(part);
    for (let i = 0; i < voxels.length && this._count; i += 3) {
      const slot = this._slot(voxels[i], voxels[i + 1], voxels[i + 2]);
      if (this._slots[slot] >= 0) return voxels.subarray(i, i + 3);
    }
    return null;
  }

  /** The slot that has this voxel, or would take it. @param {number} x @param {number} y @param {number} z */
  _slot(x, y, z) {
    const slots = this._slots;
    const voxels = this._voxels;
    let h = Math.imul(x, SEEDS[0]) + Math.imul(y, SEEDS[1]) + Math.imul(z, SEEDS[2]);
    h = Math.imul(h ^ (h >>> 15), 0x2c1b3c6d);
    const mask = slots.length - 1;
    for (let slot = (h ^ (h >>> 13)) & mask; ; slot = (slot + 1) & mask) {
      const at = 3 * slots[slot];
      if (at < 0 || (voxels[at] === x && voxels[at + 1] === y && voxels[at + 2] === z)) return slot;
    }
  }

  /** @param {Int32Array} voxels [n, 3] */
  _enter(voxels) {
    const first = this._count;
    this._count += voxels.length / 3;
    const grown = 3 * this._count > this._voxels.length;
    if (grown) {
      const old = this._voxels;
      this._voxels = new Int32Array(3 * 2 ** Math.ceil(Math.log2(this._count)));
      this._voxels.set(old.subarray(0, 3 * first));
      this._slots = new Int32Array((4 * this._voxels.length) / 3).fill(-1); // mostly empty: most look-ups find nothing
    }
    this._voxels.set(voxels, 3 * first);
    for (let i = grown ? 0 : first; i < this._count; i++) {
      const [x, y, z] = this._voxels.subarray(3 * i, 3 * i + 3);
      this._slots[this._slot(x, y, z)] = i;
    }
  }
}

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
