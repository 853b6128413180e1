// A hash table of voxels: which row has these coordinates.

/** Random, so that nobody can prepare voxels that all fall into one place. */
const SEEDS = Int32Array.from({ length: 3 }, () => (Math.random() * 2 ** 32) | 1);

/** Rows by their coordinates along three axes. The arrays are read, never written. */
export class VoxelTable {
  /** @param {number} capacity rows that may be added */
  constructor(capacity) {
    const size = 2 ** Math.max(4, 34 - Math.clz32(capacity)); // mostly empty: most look-ups find nothing
    this._rows = new Int32Array(size).fill(-1);
    this._mask = size - 1;
  }

  /** @param {number} x @param {number} y @param {number} z */
  _slot(x, y, z) {
    let h = Math.imul(x, SEEDS[0]) + Math.imul(y, SEEDS[1]) + Math.imul(z, SEEDS[2]);
    h = Math.imul(h ^ (h >>> 15), 0x2c1b3c6d);
    return (h ^ (h >>> 13)) & this._mask;
  }

  /**
   * The row added with these coordinates, or -1. `axes` holds the coordinates of all rows.
   *
   * @param {ArrayLike<number>[]} axes @param {number} x @param {number} y @param {number} z
   */
  find([xs, ys, zs], x, y, z) {
    for (let slot = this._slot(x, y, z); ; slot = (slot + 1) & this._mask) {
      const row = this._rows[slot];
      if (row < 0 || (xs[row] === x && ys[row] === y && zs[row] === z)) return row;
    }
  }

  /** Adds a row whose voxel is not there yet. @param {number} row @param {number} x @param {number} y @param {number} z */
  add(row, x, y, z) {
    let slot = this._slot(x, y, z);
    while (this._rows[slot] >= 0) slot = (slot + 1) & this._mask;
    this._rows[slot] = row;
  }
}
