// Adapts to slow machines: fewer pixels if drawing is slow, a lower level if evaluation is.

/** Sizes of the picture relative to the element's, each side. */
export const SCALES = [1, 0.75, 0.5, 0.35];
/** A draw may take this long on average, milliseconds; with half of it there is room for more. */
const DRAW_MS = 45;
/** An evaluation of a level may take this long while the scene plays: a level that stands still is the last resort. */
const EVALUATE_MS = [Infinity, 400, 120];
/** Draws between two changes of the size, at least. */
const SETTLE = 6;
/** After so long a level that was too slow is tried again, twice as long each time, at most. */
const RETRY_MS = [5_000, 60_000];
/** Of a moving average, the share of its latest value. */
const WEIGHT = 0.3;

export class Pace {
  /** @param {number} [step] of SCALES to begin with */
  constructor(step = 0) {
    this._step = step;
    this._draws = 0;
    this._drawMs = 0;
    /** The highest level that keeps up. */
    this.level = 2;
    this._evaluations = 0;
    this._evaluateMs = 0;
    this._retryMs = RETRY_MS[0];
    this._retryAt = Infinity;
  }

  /** Of the picture's sides, while it moves. */
  get scale() {
    return SCALES[this._step];
  }

  /** Records a draw at the current scale. @param {number} ms from its start to its end on the GPU */
  drew(ms) {
    this._drawMs = this._draws ? this._drawMs + WEIGHT * (ms - this._drawMs) : ms;
    if (++this._draws < SETTLE) return;
    let step = this._step;
    if (this._drawMs > DRAW_MS) step = Math.min(step + 1, SCALES.length - 1);
    else if (step && this._drawMs * (SCALES[step - 1] / SCALES[step]) ** 2 < DRAW_MS / 2) step--;
    if (step === this._step) return;
    this._step = step;
    this._draws = 0;
  }

  /**
   * Records an evaluation while the scene plays.
   *
   * @param {number} level @param {number} ms @param {number} now milliseconds
   */
  evaluated(level, ms, now) {
    if (level <= this.level) {
      this._evaluateMs = this._evaluations ? this._evaluateMs + WEIGHT * (ms - this._evaluateMs) : ms;
      this._evaluations++;
    }
    if (this._evaluations >= 3 && this._evaluateMs > EVALUATE_MS[level]) {
      this.level = level - 1;
      this._evaluations = 0;
      this._retryAt = now + this._retryMs;
      this._retryMs = Math.min(2 * this._retryMs, RETRY_MS[1]);
    } else if (this.level < 2 && now > this._retryAt) {
      this.level++;
      this._evaluations = 0;
      this._retryAt = now + this._retryMs;
    }
  }
}
