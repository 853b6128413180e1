// Arrays that grow at their end: the rows of a scene as slices bring them (clause 12.2), and the visible Gaussians.

/** An array is allocated for so many times its rows at most, however many are to come. */
const MOST_GROWTH = 4;

/** @typedef {Int32Array | Uint32Array | Float32Array | Uint8Array} Values */

/** An array [rows, width] that grows. What was read from it before stays as it is. @template {Values} A */
export class Column {
  /** @param {new (length: number) => A} type @param {number} width */
  constructor(type, width) {
    this._type = type;
    this._width = width;
    this._room = new type(0);
    this.rows = 0;
  }

  /** The rows so far. @returns {A} */
  get values() {
    return /** @type {A} */ (this._room.subarray(0, this.rows * this._width));
  }

  /** Makes room for these rows too. @param {ArrayLike<number>} values @param {number} growth about how many times as
   * many as with these there will be; of 1 an empty column takes the array itself, which nobody may write to then */
  reserve(values, growth) {
    const rows = this.rows + values.length / this._width;
    if (rows * this._width <= this._room.length) return;
    if (!this.rows && growth === 1) this._room = /** @type {A} */ (values);
    else this._grow(rows, growth, this.values);
  }

  /** @param {ArrayLike<number>} values of whole rows @param {number} growth as in reserve */
  append(values, growth) {
    this.reserve(values, growth);
    if (this._room !== values) this._room.set(values, this.rows * this._width);
    this.rows += values.length / this._width;
  }

  /** Sorts the rows from `first` on, in a copy. @param {number} first @param {Uint32Array} order
   * @param {number} growth as in reserve */
  reorder(first, order, growth) {
    const { _width: width, values } = this;
    this._grow(this.rows, growth, values.subarray(0, first * width));
    let at = first * width;
    for (const row of order) {
      const from = (first + row) * width;
      for (let k = 0; k < width; k++) this._room[at++] = values[from + k];
    }
  }

  /** @param {number} rows @param {number} growth @param {Values} values that come along */
  _grow(rows, growth, values) {
    this._room = new this._type(Math.floor(rows * Math.min(growth, MOST_GROWTH)) * this._width);
    this._room.set(values);
  }
}
