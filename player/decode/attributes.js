// Clause 8.5: the attributes section, to step classes and the channels of 11.2. layer.js checks their range.

import { ByteReader } from "./bytes.js";
import { decodeChannels } from "./channels.js";
import { channelsOf, decodeSplit, groupByClass } from "./classes.js";
import { malformed } from "./errors.js";
import { channelCount } from "./header.js";

const STEP_CLASSES = 7;

/**
 * @param {Uint8Array} bytes the section @param {number} rows at least 1
 * @param {import("./parameters.js").LayerKind} kind
 * @param {import("./channels.js").Prior[]} known see decodeChannels
 * @returns {{stepClasses: Int32Array, attributes: Int32Array}} [rows], empty without step classes; [D + 6 + 3·G, rows]
 */
export function decodeAttributes(bytes, rows, kind, known) {
  const count = channelCount(kind.widths);
  if (!kind.stepClasses) {
    const attributes = decodeChannels(bytes, new Array(count).fill(rows), known);
    return { stepClasses: new Int32Array(0), attributes };
  }
  const attributes = new Int32Array(count * rows);
  const reader = new ByteReader(bytes);
  const stepClasses = readStepClasses(reader, rows);
  const groups = groupByClass(stepClasses, STEP_CLASSES);
  const channels = channelsOf(attributes, count);
  decodeSplit(reader.rest(), channels, channels.map(() => groups), known);
  return { stepClasses, attributes };
}

/** The step class of each row. Later slices do not use its priors. @param {ByteReader} reader @param {number} rows */
function readStepClasses(reader, rows) {
  const length = reader.varint(reader.remaining, "the length of the step classes");
  const classes = decodeChannels(reader.take(length, "the end of the step classes"), [rows]);
  for (const c of classes) {
    if (c < 0 || c >= STEP_CLASSES) throw malformed(`a step class of ${c}, expected 0..${STEP_CLASSES - 1}`);
  }
  return classes;
}
