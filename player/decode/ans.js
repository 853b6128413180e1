// Clause 7.5: ANS streams.

import { malformed } from "./errors.js";
import { INDEX_SHIFT } from "./tables.js";

const LOW = 0xffffff;

/** Decodes one stream, symbol by symbol. The state x < 2^64 is held as th·2^48 + tl·2^24 + q with th < 2^16 and tl,
 * q < 2^24, so that every product with a frequency, at most 2^24, is exact in binary64 and its lowest 24 bits follow
 * from 32-bit products. */
export class AnsDecoder {
  /** @param {Uint8Array} bytes */
  constructor(bytes) {
    if (bytes.length % 4) throw malformed(`an ANS stream of ${bytes.length} bytes, expected a multiple of 4`);
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this._words = new Uint32Array(bytes.length / 4);
    for (let i = 0; i < this._words.length; i++) this._words[i] = view.getUint32(4 * i, true);
    if (this._words[0] === 0) throw malformed("an ANS stream begins with a zero word");
    this._at = Math.min(this._words.length, 2); // the state is one word, or two if there are
    const [low = 0, high = 0] = this._words.slice(0, 2).reverse();
    this._th = high >>> 16;
    this._tl = ((high & 0xffff) << 8) | (low >>> 24);
    this._q = low & LOW;
  }

  /** Writes the next symbols under a prior to out[start .. end - 1]. @param {import("./tables.js").Prior} prior
   * @param {Int32Array} out @param {number} start @param {number} end */
  symbols({ kmin, n, cum, index }, out, start, end) {
    if (n === 1) return void out.fill(kmin, start, end); // a table of one symbol does not change the state
    const words = this._words;
    let { _at: at, _th: th, _tl: tl, _q: q } = this;
    for (let i = start; i < end; i++) {
      const bucket = q >>> INDEX_SHIFT;
      let s = index[bucket];
      let last = index[bucket + 1];
      while (last - s > 8) {
        const middle = (s + last + 1) >> 1;
        if (cum[middle] <= q) s = middle;
        else last = middle - 1;
      }
      while (cum[s + 1] <= q) s++;
      out[i] = kmin + s;
      const f = cum[s + 1] - cum[s];
      const r = q - cum[s];
      q = (Math.imul(tl, f) + r) & LOW;
      const carry = (tl * f + r - q) / 16777216;
      const low = (Math.imul(th, f) + carry) & LOW;
      th = (th * f + carry - low) / 16777216;
      tl = low;
      if (th === 0 && tl < 256 && at < words.length) {
        const word = words[at++];
        th = (tl << 8) | (q >>> 16);
        tl = ((q << 8) | (word >>> 24)) & LOW;
        q = word & LOW;
      }
    }
    this._at = at;
    this._th = th;
    this._tl = tl;
    this._q = q;
  }

  /** The stream's end: Malformed unless the state is 0 and no word is left. */
  finish() {
    if (this._th || this._tl || this._q) throw malformed("an ANS stream does not end in state 0");
    const left = this._words.length - this._at;
    if (left) throw malformed(`an ANS stream has ${left} words left at its end`);
  }
}
