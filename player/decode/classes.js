// Clauses 8.5 and 8.6: channels that are split by the class of each place, and coded as one channel per class.

import { decodeChannels } from "./channels.js";

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
 * @param {(Groups | null)[]} groups @param {import("./channels.js").Prior[]} [known] see decodeChannels
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
