// Clauses 8.1 to 8.5: coded channels, of which some are split by the class of each place.

import { AnsDecoder } from "./ans.js";
import { ByteReader, MAX_VARINT } from "./bytes.js";
import { limitExceeded, malformed, unsupported } from "./errors.js";
import { Prior, normTable } from "./tables.js";

/** The family of two Gaussians; family 1 has one, family 0 none. */
const MIXTURE = 2;
const FIRST_REUSE = 8;
/** Symbols of a window. */
const MAX_WINDOW = 2 ** 14;
/** K: the largest coded symbol. */
const MAX_CODED = 2 ** 24;

/** The places in the order in which a split channel holds them, class by class, and how many each class has.
 * @typedef {{order: Int32Array, sizes: Int32Array}} Groups */

/** The channels of a slice, one after the other. */
export class ChannelReader {
  /** @param {Uint8Array} codes @param {Uint8Array} stream @param {Prior[]} priors of the layer so far, in order; new
   * ones are added @param {number} entries that their windows may have at most */
  constructor(codes, stream, priors, entries) {
    /** What is read besides channels stands in the codes between theirs. */
    this.codes = new ByteReader(codes);
    this._stream = new AnsDecoder(stream);
    this._priors = priors;
    this._most = entries;
    this._entries = priors.reduce((sum, { n }) => sum + n, 0);
  }

  /** The symbols of the next channel, each in its range. @param {number} length @param {number} least
   * @param {number} most @param {string} what names a symbol in messages */
  read(length, least, most, what) {
    const out = new Int32Array(length);
    this._take(out, 0, length);
    checkRange(out, least, most, what);
    return out;
  }

  /** Reads the next channel into `out`, split if there are groups. @param {Int32Array} out
   * @param {Groups | null} groups */
  fill(out, groups) {
    if (!groups) return this._take(out, 0, out.length);
    const { order, sizes } = groups;
    const sorted = new Int32Array(out.length);
    let at = 0;
    for (const size of sizes) this._take(sorted, at, (at += size));
    for (let i = 0; i < order.length; i++) out[order[i]] = sorted[i];
  }

  /** Codes and stream end here, else Malformed. */
  finish() {
    const { bytes, offset } = this.codes;
    if (offset < bytes.length) throw malformed(`${bytes.length - offset} bytes of codes follow the last channel`);
    this._stream.finish();
  }

  /** A channel: its code, then its symbols between the exceptions. @param {Int32Array} out @param {number} at
   * @param {number} end */
  _take(out, at, end) {
    if (at === end) return;
    const { codes } = this;
    const token = codes.varint(2 * (2 ** 26 + FIRST_REUSE), "a channel's prior");
    const prior = this._prior(token >> 1);
    const exceptions = token & 1 ? 1 + codes.varint(MAX_VARINT, "the number of exceptions") : 0;
    if (exceptions > end - at) throw malformed(`${exceptions} exceptions, expected at most ${end - at}`);
    const { kmin, n } = prior;
    let from = at;
    for (let i = 0; i < exceptions; i++) {
      const place = from + codes.varint(MAX_VARINT, "an exception's position");
      const code = codes.varint(4 * MAX_CODED + 2, "an exception's value");
      const value = code & 1 ? kmin - 1 - (code >> 1) : kmin + n + (code >> 1);
      if (place >= end || value > MAX_CODED || value < -MAX_CODED) {
        throw malformed(`exception ${value} at symbol ${place - at} of ${end - at}, limit ±${MAX_CODED}`);
      }
      this._stream.symbols(prior, out, from, place);
      out[place] = value;
      from = place + 1;
    }
    this._stream.symbols(prior, out, from, end);
  }

  /** 8.1. @param {number} family */
  _prior(family) {
    const priors = this._priors;
    if (family < FIRST_REUSE) {
      const prior = readPrior(this.codes, family);
      priors.push(prior);
      this._entries += prior.n;
      if (this._entries <= this._most) return prior;
      throw limitExceeded(`tables of ${this._entries} entries in one layer, limit ${this._most}`);
    }
    const prior = priors[priors.length - 1 - (family - FIRST_REUSE)];
    if (!prior) throw malformed("a channel reuses a prior before the first");
    return prior;
  }
}

/** 8.2. @param {ByteReader} codes @param {number} family @returns {Prior} */
function readPrior(codes, family) {
  if (family > MIXTURE) throw unsupported(`a prior of family ${family}`);
  const kmin = codes.zigzag(MAX_CODED, "the start of a window");
  if (!family) return new Prior(kmin);
  const n = 2 + codes.varint(MAX_WINDOW - 2, "the length of a window");
  const last = kmin + n - 1;
  if (last > MAX_CODED) throw malformed(`a window up to symbol ${last}, limit ${MAX_CODED}`);
  const [first, second] = Array.from({ length: family }, () => {
    const mean = codes.zigzag(2 ** 31, "the mean of a prior");
    return { mu8: mean + 128 * (n - 1), si: codes.varint(1920, "the width of a prior") - 640 };
  });
  const weight = second && codes.byte("the weight of a mixture");
  if (weight === 0) throw malformed("a mixture of weight 0");
  return new Prior(kmin, normTable(n, first, second, weight));
}

/** @param {Uint8Array | Int32Array} classes @param {number} count of classes @returns {Groups} */
export function groupByClass(classes, count) {
  const sizes = new Int32Array(count);
  for (let p = 0; p < classes.length; p++) sizes[classes[p]]++;
  const next = new Int32Array(count);
  for (let c = 1; c < count; c++) next[c] = next[c - 1] + sizes[c - 1];
  const order = new Int32Array(classes.length);
  for (let p = 0; p < classes.length; p++) order[next[classes[p]]++] = p;
  return { order, sizes };
}

/** Views of the channels, one behind the other. @param {Int32Array} values @param {number} count of channels */
export const channelsOf = (values, count) => {
  const places = values.length / count;
  return Array.from({ length: count }, (_, c) => values.subarray(c * places, (c + 1) * places));
};

/** Raises if a symbol is out of its range. @param {Int32Array} symbols @param {number} least @param {number} most
 * @param {string} what */
export function checkRange(symbols, least, most, what) {
  for (let i = 0; i < symbols.length; i++) {
    if (symbols[i] < least || symbols[i] > most) throw malformed(`${what}: ${symbols[i]}, expected ${least}..${most}`);
  }
}
