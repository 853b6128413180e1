// Clause 11.6: low bits of attributes, which come after everything else.

import { decodeChannels } from "./channels.js";
import { checkRange } from "./layer.js";
import { MAX_SYMBOL } from "./limits.js";

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
  const counts = [];
  let all = 0;
  for (let c = 0; c < channels; c++) {
    let zeros = 0;
    let others = 0;
    for (const symbols of rowsOf(c)) for (const s of symbols) s ? others++ : zeros++;
    counts.push(zeros, others);
    all += zeros + others;
  }
  const rests = new Int32Array(all);
  decodeChannels(section, counts, rests);
  const most = 2 ** (lowBits - 1);
  checkRange(rests, -most, most, "low bits of a symbol");
  let at = 0;
  for (let c = 0; c < channels; c++) {
    let other = at + counts[2 * c];
    for (const symbols of rowsOf(c)) {
      for (let i = 0; i < symbols.length; i++) {
        const s = symbols[i];
        symbols[i] += s ? Math.sign(s) * rests[other++] : rests[at++];
      }
    }
    at = other;
  }
  for (const symbols of slices) checkRange(symbols, -MAX_SYMBOL, MAX_SYMBOL, "a refined symbol of an attribute");
  return slices;
}
