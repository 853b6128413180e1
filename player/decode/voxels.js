// Clauses 10.1, 12.1 and 12.2: the order of voxels, and a hash table of those that hold an anchor.

import { malformed } from "./errors.js";

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

  /** Malformed if one of these voxels is there. @param {Int32Array} voxels [n, 3] */
  refuse(voxels) {
    if (voxels.length) this._enter();
    for (let i = 0; i < voxels.length && this._count; i += 3) {
      if (this._slots[this._slot(voxels, i)] === EMPTY) continue;
      throw malformed(`voxel ${voxels.subarray(i, i + 3).join(" ")} holds more than one anchor`);
    }
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

  /** Puts the loose ones into the table. */
  _enter() {
    const parts = this._loose.splice(0);
    for (const { length } of parts) this._count += length / 3;
    if (6 * this._count > this._slots.length) {
      parts.push(this._slots);
      // at most half full: most look-ups find nothing
      this._slots = new Int32Array(3 * 2 ** Math.ceil(Math.log2(2 * this._count))).fill(EMPTY);
    }
    for (const voxels of parts) {
      for (let i = 0; i < voxels.length; i += 3) {
        if (voxels[i] === EMPTY) continue;
        const at = this._slot(voxels, i);
        for (let k = 0; k < 3; k++) this._slots[at + k] = voxels[i + k];
      }
    }
  }
}

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
      if (highest >= difference || highest >= (highest ^ difference)) continue; // its highest bit is not higher
      axis = k;
      highest = difference;
    }
    return offsets[3 * a + axis] - offsets[3 * b + axis];
  });
}
