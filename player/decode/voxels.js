// Clauses 10.1, 12.1 and 12.2: the order of voxels, and a hash table of those that hold an anchor.

/** Random, so that no file can be made whose voxels all collide. */
const SEEDS = Int32Array.from({ length: 3 }, () => (Math.random() * 2 ** 32) | 1);
/** No coordinate. */
const EMPTY = -(2 ** 31);

/** A set of voxels. */
export class VoxelTable {
  constructor() {
    /** [capacity, 3] by hash, EMPTY where there is none. */
    this._slots = new Int32Array(0);
    this._count = 0;
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
      if (this._slots[this._slot(voxels, i)] !== EMPTY) return voxels.subarray(i, i + 3);
    }
    return null;
  }

  /** Where the voxel at `i` is in the slots, or would be. @param {Int32Array} voxels @param {number} i */
  _slot(voxels, i) {
    const slots = this._slots;
    const x = voxels[i], y = voxels[i + 1], z = voxels[i + 2];
    let h = Math.imul(x, SEEDS[0]) + Math.imul(y, SEEDS[1]) + Math.imul(z, SEEDS[2]);
    h = Math.imul(h ^ (h >>> 15), 0x2c1b3c6d);
    const mask = slots.length / 3 - 1;
    for (let slot = (h ^ (h >>> 13)) & mask; ; slot = (slot + 1) & mask) {
      const at = 3 * slot;
      if (slots[at] === EMPTY || (slots[at] === x && slots[at + 1] === y && slots[at + 2] === z)) return at;
    }
  }

  /** @param {Int32Array} voxels [n, 3] */
  _enter(voxels) {
    this._count += voxels.length / 3;
    const old = this._slots;
    if (6 * this._count > old.length) {
      // at most half full: most look-ups find nothing
      this._slots = new Int32Array(3 * 2 ** Math.ceil(Math.log2(2 * this._count))).fill(EMPTY);
      this._put(old);
    }
    this._put(voxels);
  }

  /** @param {Int32Array} voxels [n, 3] */
  _put(voxels) {
    for (let i = 0; i < voxels.length; i += 3) {
      if (voxels[i] === EMPTY) continue;
      const at = this._slot(voxels, i);
      for (let k = 0; k < 3; k++) this._slots[at + k] = voxels[i + k];
    }
  }
}

/** Whether the highest bit of a is lower than that of b, both below 2^31. @param {number} a @param {number} b */
const isLower = (a, b) => a < b && a < (a ^ b);

/** The rows in the order of the codes (10.1) of their voxels. @param {Int32Array} voxels [n, 3] */
export function mortonOrder(voxels) {
  const least = [Infinity, Infinity, Infinity];
  for (let i = 0; i < voxels.length; i++) if (voxels[i] < least[i % 3]) least[i % 3] = voxels[i];
  const offsets = voxels.map((v, i) => v - least[i % 3]);
  return Uint32Array.from({ length: voxels.length / 3 }, (_, i) => i).sort((a, b) => {
    // Codes differ first in the highest bit in which a coordinate does; of equally high ones, z's is the highest.
    let axis = 2;
    let highest = offsets[3 * a + 2] ^ offsets[3 * b + 2];
    for (let k = 1; k >= 0; k--) {
      const difference = offsets[3 * a + k] ^ offsets[3 * b + k];
      if (!isLower(highest, difference)) continue;
      axis = k;
      highest = difference;
    }
    return offsets[3 * a + axis] - offsets[3 * b + axis];
  });
}
