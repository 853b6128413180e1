// Adapts to machines that draw slowly: fewer pixels. What a picture shows stays the same.

/** Sizes of the picture relative to the element's, each side, and their names. */
export const SCALES = [1, 0.75, 0.5, 1 / 3];
export const SIZE_NAMES = ["full", "three-quarter", "half", "third"];
/** A draw may take this long on average, milliseconds; with half of it there is room for more. */
const DRAW_MS = 45;
/** Draws between two changes of the size, at least, if they are not very slow. */
const SETTLE = 6;
/** Of a moving average, the share of its latest value. */
const WEIGHT = 0.3;

export class Pace {
  /** @param {number} [step] of SCALES to begin with */
  constructor(step = 0) {
    this._step = step;
    this._draws = 0;
    this._drawMs = 0;
  }

  /** Of the picture's sides, while it moves. */
  get scale() {
    return SCALES[this._step];
  }

  /** Records a draw at the current scale. @param {number} ms from its start to its end on the GPU */
  drew(ms) {
    this._drawMs = this._draws ? this._drawMs + WEIGHT * (ms - this._drawMs) : ms;
    if (++this._draws < SETTLE && ms < 8 * DRAW_MS) return;
    let step = this._step;
    if (this._drawMs > DRAW_MS) step = Math.min(step + 1, SCALES.length - 1);
    else if (step && this._drawMs * (SCALES[step - 1] / SCALES[step]) ** 2 < DRAW_MS / 2) step--;
    if (step === this._step) return;
    this._step = step;
    this._draws = 0;
  }
}
