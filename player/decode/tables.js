// Clauses 7.2 to 7.4: frequency tables, lists cum of n + 1 integers from 0 to 2^24. All products stay below 2^53.

const TOTAL = 2 ** 24;
const FLOOR = 16;

/** T of 7.3. Appendix B: binary64 yields the same list, as no entry is near a rounding boundary. */
export const T = /* @__PURE__ */ (() => {
  const list = new Float64Array(258);
  for (let i = 0; i < 257; i++) {
    // Phi(x) - 1/2 = exp(-x^2/2) / sqrt(2 pi) (x + x^3/3 + x^5/(3 5) + ...); no term is negative.
    const x = i / 32;
    let sum = x;
    for (let k = 3, term = x; term > sum * 2 ** -60; k += 2) sum += term *= (x * x) / k;
    list[i] = Math.round((2 ** 28 * Math.exp((-x * x) / 2) * sum) / Math.sqrt(2 * Math.PI));
  }
  list[257] = list[256];
  return list;
})();

/** M of 7.3. */
export const M = /* @__PURE__ */ Float64Array.from({ length: 64 }, (_, j) => Math.round(2 ** (31 - j / 64)));

/** Mean mu8/256, standard deviation 2^(si/64), si -640..1280. @typedef {{mu8: number, si: number}} Normal */

/** The C(0..n-2) of 7.3, in units of 2^-28. @param {number} n @param {Normal} normal @returns {Float64Array} [n - 1] */
function distribution(n, { mu8, si }) {
  const out = new Float64Array(n - 1);
  const e = si >> 6;
  const narrow = Math.max(0, e - 8);
  const byNarrow = 2 ** -narrow;
  const m = M[si & 63];
  const scale = 2 ** -(23 + e - narrow);
  for (let k = 0; k < n - 1; k++) {
    const t = 256 * k + 128 - mu8;
    const a = Math.min(Math.floor(Math.abs(t) * byNarrow), 2 ** 21 - 1);
    const z = Math.min(Math.floor(a * m * scale), 2 ** 19);
    const i = z >> 11;
    const v = T[i] + Math.floor(((T[i + 1] - T[i]) * (z & 2047)) / 2048);
    out[k] = t < 0 ? 2 ** 27 - v : 2 ** 27 + v;
  }
  return out;
}

/** NormTable, 7.3, or the table of a mixture of two Gaussians, 7.4: cum [n + 1]. @param {number} n symbols
 * @param {Normal} first @param {Normal} [second] @param {number} [weight] of the second in 256 */
export function normTable(n, first, second, weight = 0) {
  const c = distribution(n, first);
  const other = second ? distribution(n, second) : c;
  const cum = new Int32Array(n + 1);
  const spread = TOTAL - n * FLOOR;
  for (let q = 1; q < n; q++) {
    const mixed = Math.floor(((256 - weight) * c[q - 1] + weight * other[q - 1]) / 256);
    cum[q] = Math.floor((mixed * spread) / 2 ** 28) + FLOOR * q;
  }
  cum[n] = TOTAL;
  return cum;
}

/** Bits of the state that select an entry of a table's index. */
const INDEX_BITS = 9;
export const INDEX_SHIFT = 24 - INDEX_BITS;

/** A frequency table for the symbols from kmin on. index: the entry at the first state of each value of the upper
 * INDEX_BITS bits. */
export class Prior {
  /** @param {number} kmin @param {Int32Array} [cum] [n + 1], 7.2, default: of one symbol */
  constructor(kmin, cum = Int32Array.of(0, TOTAL)) {
    this.kmin = kmin;
    this.n = cum.length - 1;
    this.cum = cum;
    this.index = new Uint16Array((1 << INDEX_BITS) + 1).fill(this.n - 1);
    for (let bucket = 0, s = 0; bucket < 1 << INDEX_BITS; bucket++) {
      while (cum[s + 1] <= bucket << INDEX_SHIFT) s++;
      this.index[bucket] = s;
    }
  }
}
