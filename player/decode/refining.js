// Clause 11.6: low bits of attributes, which come after everything else.

import { decodeChannels } from "./channels.js";
import { checkRange } from "./layer.js";
import { MAX_SYMBOL, MORE_ENTRIES } from "./limits.js";

/**
 * The attributes of some slices with their low bits; those given stay as they are.
 *
 * @param {Uint8Array} section @param {Int32Array[]} coarse of each slice, [channels, rows]
 * @param {number} channels @param {number} lowBits
 * @returns {Int32Array[]}
 */
export function refined(section, coarse, channels, lowBits) {
  const slices = coarse.map((symbols) => symbols.slice());
  /** One channel of each slice. @param {number} c */
  const rowsOf = (c) => slices.map((all) => all.subarray((c * all.length) / channels, ((c + 1) * all.length) / channels));
  /** Which of its three channels holds a symbol's rest: coarse symbols that are 0, odd, others. @param {number} s */
  const classOf = (s) => (s === 0 ? 0 : (s >> lowBits) & 1 ? 1 : 2);
  const counts = new Array(3 * channels).fill(0);
  for (let c = 0; c < channels; c++) {
    for (const symbols of rowsOf(c)) for (const s of symbols) counts[3 * c + classOf(s)]++;
  }
  const rests = new Int32Array(counts.reduce((a, b) => a + b));
  decodeChannels(section, counts, rests, undefined, MORE_ENTRIES);
  const most = 2 ** (lowBits - 1);
  checkRange(rests, -most, most, "low bits of a symbol");
  let end = 0;
  const next = counts.map((count) => (end += count) - count);
  for (let c = 0; c < channels; c++) {
    for (const symbols of rowsOf(c)) {
      for (let i = 0; i < symbols.length; i++) {
        const s = symbols[i];
        const r = rests[next[3 * c + classOf(s)]++];
        symbols[i] = s < 0 ? s - r : s + r;
      }
    }
  }
  for (const symbols of slices) checkRange(symbols, -MAX_SYMBOL, MAX_SYMBOL, "a refined symbol of an attribute");
  return slices;
}
