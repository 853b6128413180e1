// A hash table of voxels: which row has these coordinates.

/** Random, so that nobody can prepare voxels that all fall into one place. */
const SEEDS = Int32Array.from({ length: 3 }, () => (Math.random() * 2 ** 32) | 1);

/** Rows by their voxels. */
export class VoxelTable {
  /** @param {number} capacity rows that may be added @param {Int32Array[]} axes the coordinates of all rows along x, y, z,
   * each set before its row is added */
  constructor(capacity, [x, y, z]) {
    this._x = x;
    this._y = y;
    this._z = z;
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

  /** The row with this voxel among those added, or -1. @param {number} x @param {number} y @param {number} z */
  find(x, y, z) {
    const rows = this._rows;
    for (let slot = this._slot(x, y, z); ; slot = (slot + 1) & this._mask) {
      const row = rows[slot];
      if (row < 0 || (this._x[row] === x && this._y[row] === y && this._z[row] === z)) return row;
    }
  }

  /** Adds a row whose voxel is not there yet. @param {number} row */
  add(row) {
    let slot = this._slot(this._x[row], this._y[row], this._z[row]);
    while (this._rows[slot] >= 0) slot = (slot + 1) & this._mask;
    this._rows[slot] = row;
  }
}
