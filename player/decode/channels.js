// Clauses 8.1 to 8.6: a section of coded channels, of which some may be split by the class of each place.

import { AnsDecoder } from "./ans.js";
import { ByteReader, MAX_VARINT } from "./bytes.js";
import { limitExceeded, malformed, unsupported } from "./errors.js";
import { FREE_ENTRIES, MAX_CODED, MAX_COUNT, MAX_WINDOW, MORE_ENTRIES } from "./limits.js";
import { CONSTANT, Table, mixtureTable, normTable } from "./tables.js";

const CONST = 0;
const GAUSS = 1;
const MIXTURE = 2;
const FIRST_REUSE = 8;

/** A table for the symbols kmin .. kmin + n - 1. @typedef {{kmin: number, n: number, table: Table}} Prior */

/** Symbols outside the window, at ascending positions. @typedef {{positions: number[], values: number[]}} Exceptions */

/**
 * The symbols of a section of coded channels of these lengths, one behind the other.
 *
 * @param {Uint8Array} bytes @param {number[]} counts
 * @param {Prior[]} [priors] defined by the slices before, in order; those of this section are added
 */
export function decodeChannels(bytes, counts, priors = []) {
  const reader = new ByteReader(bytes);
  const symbols = counts.reduce((sum, count) => sum + count, 0);
  const most = symbols + (priors.length ? MORE_ENTRIES : FREE_ENTRIES);
  let entries = 0;
  /** @type {{count: number, prior: Prior, exceptions: Exceptions | null}[]} */
  const channels = [];
  for (const count of counts) {
    if (!count) continue;
    const token = reader.varint(2 * (MAX_COUNT + FIRST_REUSE), "a channel's prior");
    const family = token >> 1;
    let prior;
    if (family < FIRST_REUSE) {
      prior = readPrior(reader, family);
      priors.push(prior);
      entries += prior.n;
      if (entries > most) throw limitExceeded(`tables of ${entries} entries for one section, limit ${most}`);
    } else {
      prior = priors[priors.length - 1 - (family - FIRST_REUSE)];
      if (!prior) throw malformed("a channel reuses a prior before the first");
    }
    channels.push({ count, prior, exceptions: token & 1 ? readExceptions(reader, count, prior) : null });
  }
  const stream = new AnsDecoder(reader.rest());
  const out = new Int32Array(symbols);
  let at = 0;
  for (const { count, prior, exceptions } of channels) {
    takeChannel(stream, prior, exceptions, out, at, count);
    at += count;
  }
  stream.finish();
  return out;
}

/** @param {AnsDecoder} stream @param {Prior} prior @param {Exceptions | null} exceptions @param {Int32Array} out
 * @param {number} at @param {number} count */
function takeChannel(stream, { kmin, table }, exceptions, out, at, count) {
  const coded = exceptions ? count - exceptions.positions.length : count;
  stream.symbols(table, out, at, coded);
  if (kmin) for (let i = at; i < at + coded; i++) out[i] += kmin;
  if (!exceptions) return;
  // From the last one on, symbols move up to make room for the exceptions.
  const { positions, values } = exceptions;
  let from = at + coded;
  let to = at + count;
  for (let i = positions.length - 1; i >= 0; i--) {
    const place = at + positions[i];
    while (to > place + 1) out[--to] = out[--from];
    out[--to] = values[i];
  }
}

/** 8.3. @param {ByteReader} reader @param {number} count @param {Prior} prior @returns {Exceptions} */
function readExceptions(reader, count, { kmin, n }) {
  const number = 1 + reader.varint(MAX_VARINT, "the number of exceptions");
  if (number > count) throw malformed(`${number} exceptions, expected at most ${count}`);
  const positions = [];
  const values = [];
  let position = -1;
  for (let i = 0; i < number; i++) {
    position += 1 + reader.varint(MAX_VARINT, "an exception's position");
    const code = reader.varint(4 * MAX_CODED + 2, "an exception's value");
    const value = code & 1 ? kmin - 1 - (code >> 1) : kmin + n + (code >> 1);
    if (position >= count || value > MAX_CODED || value < -MAX_CODED) {
      throw malformed(`exception ${value} at symbol ${position} of ${count}, limit ±${MAX_CODED}`);
    }
    positions.push(position);
    values.push(value);
  }
  return { positions, values };
}

/** 8.1 and 8.2. @param {ByteReader} reader @param {number} family @returns {Prior} */
function readPrior(reader, family) {
  if (family === CONST) return { kmin: reader.zigzag(MAX_CODED, "a constant"), n: 1, table: CONSTANT };
  if (family > MIXTURE) throw unsupported(`a prior of family ${family}`);
  const kmin = reader.zigzag(MAX_CODED, "the start of a window");
  const n = 2 + reader.varint(MAX_WINDOW - 2, "the length of a window");
  const last = kmin + n - 1;
  if (last > MAX_CODED) throw malformed(`a window up to symbol ${last}, limit ${MAX_CODED}`);
  const first = readNormal(reader, n);
  if (family === GAUSS) return { kmin, n, table: new Table(normTable(n, first.mu8, first.si)) };
  const second = readNormal(reader, n);
  const weight = reader.byte("the weight of a mixture");
  if (!weight) throw malformed("a mixture of weight 0");
  return { kmin, n, table: new Table(mixtureTable(n, first, second, weight)) };
}

/** @param {ByteReader} reader @param {number} n */
function readNormal(reader, n) {
  const mean = reader.zigzag(2 ** 31, "the mean of a prior");
  return { mu8: mean + 128 * (n - 1), si: reader.varint(1920, "the width of a prior") - 640 };
}

/**
 * The places in the order in which a split channel holds them: class by class, in each as they come.
 *
 * @typedef {{order: Int32Array, sizes: Int32Array}} Groups sizes: places per class
 */

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
export function channelsOf(values, count) {
  const places = values.length / count;
  return Array.from({ length: count }, (_, c) => values.subarray(c * places, (c + 1) * places));
}

/**
 * Decodes a section of coded channels into these. groups: how the places of each are split, null if they are not.
 *
 * @param {Uint8Array} bytes @param {Int32Array[]} channels
 * @param {(Groups | null)[]} groups @param {Prior[]} [known] see decodeChannels
 */
export function decodeSplit(bytes, channels, groups, known) {
  const counts = channels.flatMap(({ length }, i) => [...(groups[i]?.sizes ?? [length])]);
  const coded = decodeChannels(bytes, counts, known);
  let at = 0;
  channels.forEach((channel, i) => {
    const split = groups[i];
    if (split) for (const place of split.order) channel[place] = coded[at++];
    else {
      channel.set(coded.subarray(at, at + channel.length));
      at += channel.length;
    }
  });
}
