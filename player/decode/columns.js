// Arrays that grow at their end: the rows of a scene as slices bring them (clause 12.2), and the visible Gaussians.

/** An array is allocated for so many times its rows at most, however many are to come. */
const MOST_GROWTH = 4;

/** @typedef {Int32Array | Uint32Array | Float32Array | Uint8Array} Values */

/** Rows of an array [.., width]. It stays as it is; one with more rows may share the array. @template {Values} A */
export class Column {
  /** @param {new (length: number) => A} type @param {number} width @param {A} [room] @param {number} [rows] of it */
  constructor(type, width, room = new type(0), rows = 0) {
    this._type = type;
    this._width = width;
    this._room = room;
    this.rows = rows;
  }

  /** @returns {A} */
  get values() {
    return /** @type {A} */ (this._room.subarray(0, this.rows * this._width));
  }

  /** With more rows behind these; those of an earlier call are lost. @param {ArrayLike<number>} values of whole rows
   * @param {number} growth about how many times as many rows there will be; of 1 an empty column takes the array itself,
   * which nobody may write to then */
  with(values, growth) {
    const rows = this.rows + values.length / this._width;
    let room = this._room;
    if (rows * this._width > room.length) {
      room = this.rows || growth > 1 ? this._grown(rows, growth, this.values) : /** @type {A} */ (values);
    }
    if (room !== values) room.set(values, this.rows * this._width);
    return new Column(this._type, this._width, room, rows);
  }

  /** With the rows from `first` on in another order. @param {number} first @param {Uint32Array} order
   * @param {number} growth as in `with` */
  reordered(first, order, growth) {
    const { _width: width, values } = this;
    let at = first * width;
    const room = this._grown(this.rows, growth, values.subarray(0, at));
    for (const row of order) {
      const from = (first + row) * width;
      for (let k = 0; k < width; k++) room[at++] = values[from + k];
    }
    return new Column(this._type, width, room, this.rows);
  }

  /** @param {number} rows @param {number} growth @param {Values} values that come along */
  _grown(rows, growth, values) {
    const room = new this._type(Math.floor(rows * Math.min(growth, MOST_GROWTH)) * this._width);
    room.set(values);
    return room;
  }
}
